"""What a fit tells of heat, on machines whose expansions and time constants are known."""

from dataclasses import replace
from functools import cache

import calibration_helpers as small
import numpy as np
import pytest

from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.calibration.thermal import warming_json, warming_text
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth
from hexapod_comp.measurements.campaign import Campaign, CampaignRun, template
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.virtual.instruments import measure

pytestmark = pytest.mark.usefixtures("unsuspected")

TAU = 1500.0
SETTINGS = FitSettings(blocks=("expansion", "late"))


def truth(thermometer: str = "base") -> RealMachine:
    """Return a machine without errors but growth; struts run ahead of their thermometer, the platform lags."""
    expansion = np.array([[-20e-6]] * 6 + [[0.0], [8e-6]])
    model = MachineModel(
        "paper", "warm", struts=StrutErrors(expansion=np.full(6, 15e-6)), base_expansion=11e-6,
        platform_expansion=14e-6, late_growth=LateGrowth((TAU,), expansion, thermometer),
    )  # fmt: skip
    return RealMachine(small.paper(), model)


@cache
def measured(rise: float = 3.0, timed: bool = True, parts: tuple[int, ...] = (6,)) -> MeasurementSet:
    """Return x, y and z lines read in eight rounds, a quarter of an hour apart, while thermometers rise."""
    runs = []
    for number in range(8):
        for axis in range(3):
            positions = np.tile(small.BOX.mean(axis=0), (5, 1))
            positions[:, axis] = np.linspace(*small.BOX[:, axis], 5)
            runs.append(CampaignRun(f"{axis} {number}", "5-D", positions, np.tile(np.eye(3), (5, 1, 1))))
    plan = Campaign(small.BOX, 0.2, 0.05, None, 0, runs=tuple(runs), noise=(2e-7,) * len(KINDS))
    planned = template(plan, small.paper())
    times = 30.0 * np.arange(len(planned.stations))
    temperatures = np.full((len(times), 8), 20.0)
    temperatures[:, parts] -= rise * np.expm1(-times / 5400.0)[:, None]
    stations = replace(planned.stations, temperatures=temperatures, times=times)
    machine = truth("base" if parts == (6,) else "")
    read = measure(replace(planned, stations=stations), plan, machine, seed=3)
    known = stations.times if timed else np.full(len(times), np.nan)
    return replace(read, stations=replace(stations, times=known))


@cache
def fit() -> ModelFit:
    return fit_model(measured(), SETTINGS)


def test_expansions_and_time_constant_come_back():
    """Within three of the standard deviations that the fit states; the struts' mean to 1 ppm/K besides."""
    warming = fit().warming
    wanted = {"struts": (15e-6, -20e-6), "base": (11e-6, 0.0), "platform": (14e-6, 8e-6)}
    assert [p.part for p in warming.parts] == list(wanted)
    for part in warming.parts:
        assert abs(part.expansion - wanted[part.part][0]) < 3.0 * part.deviation, part
    assert warming.parts[0].expansion == pytest.approx(15e-6, abs=1e-6)
    (constant,), (deviation,) = warming.time_constants.values, warming.time_constants.deviations
    assert abs(np.log(constant / TAU)) < 3.0 * deviation < 0.6


def test_the_noise_of_sensors_is_not_taken_for_growth():
    """Struts with sensors of their own that read 0.02 K beside, one kelvin in 150: within three of the deviations that
    the same readings have without that noise. Fitted to what is read, 19.7 ± 0.3 ppm/K would be 1.4 ± 0.2."""
    quiet = measured(parts=tuple(range(8)))
    noise = 0.02 * np.random.default_rng(5).standard_normal(quiet.stations.temperatures.shape)
    stations = replace(quiet.stations, temperatures=quiet.stations.temperatures + noise)
    settings = replace(SETTINGS, blocks=("expansion",))
    noisy, known = (fit_model(replace(quiet, stations=s), settings).warming.parts for s in (stations, quiet.stations))
    for part, undisturbed in zip(noisy, known, strict=True):
        assert abs(part.expansion - undisturbed.expansion) < 3.0 * undisturbed.deviation, part
        assert part.deviation > 0.9 * undisturbed.deviation, part


def test_thermometers_that_are_rounded_do_not_override_what_is_stated():
    """Struts of 15 ppm/K, so stated, with displays of 0.1 K, while they warm by 1 K: they keep that to a tenth.

    Taken as read, a stair of 0.1 K is 0.9 µm on a strut that does not move: that is said to grow by 1 ppm/K.
    """
    exact = measured(rise=1.0, parts=tuple(range(8)))
    expansion = np.array([15e-6] * 6 + [11e-6, 14e-6])
    model = MachineModel("paper", struts=StrutErrors(expansion=expansion[:6]), base_expansion=11e-6,
                         platform_expansion=14e-6)  # fmt: skip
    plan = Campaign(small.BOX, 0.2, 0.05, "5-D", 0, noise=(2e-7,) * len(KINDS))
    read = measure(exact, plan, RealMachine(small.paper(), model), seed=4)
    rounded = replace(read.stations, temperatures=read.stations.temperatures.round(1))
    stated = dict(zip(("strut_expansion", "base_expansion", "platform_expansion"), expansion[5:].tolist(), strict=True))
    found = fit_model(replace(read, stations=rounded), replace(SETTINGS, **stated)).model
    np.testing.assert_allclose(found.struts.expansion, 15e-6, rtol=0.1)
    np.testing.assert_allclose([found.base_expansion, found.platform_expansion], expansion[6:], rtol=0.1)


def test_expansions_are_known_no_better_than_the_time_constant():
    """Truth: fits with the time constant a tenth up and down; sizes of priors follow it too, by a little."""
    (constant,), (deviation,) = fit().warming.time_constants.values, fit().warming.time_constants.deviations
    ends = [
        fit_model(measured(), replace(SETTINGS, time_constants=(constant * np.exp(way),))).warming.parts
        for way in (-0.1, 0.1)
    ]
    for part, shorter, longer in zip(fit().warming.parts, *ends, strict=True):
        moved = deviation * abs(longer.expansion - shorter.expansion) / 0.2
        alone = 0.5 * (shorter.deviation + longer.deviation)
        assert part.deviation == pytest.approx(np.hypot(alone, moved), rel=0.1), part


def test_the_model_follows_the_one_thermometer():
    model = fit().model.late_growth
    assert (model.thermometer, model.time_constants) == ("base", fit().warming.time_constants.values)


def test_the_report_says_what_came_out_and_which_thermometers_were_read():
    text = warming_text(fit().warming)
    assert "base 2." in text.splitlines()[0]
    assert "base stands for all parts" in text
    assert "struts: 1" in text
    assert "(stated 0)" in text
    assert "with 95 %" in text
    assert warming_json(fit().warming)["time_constants_s"] == fit().warming.time_constants.values


def test_without_a_warm_up_nothing_is_invented():
    """0.3 K are below what a sensor's drift may be: stated expansions stay, and the report says so."""
    cold = fit_model(measured(rise=0.35), replace(SETTINGS, strut_expansion=12e-6))
    assert cold.warming.parts == ()
    assert cold.model.late_growth.time_constants == ()
    np.testing.assert_array_equal(cold.model.struts.expansion, 12e-6)
    assert "expansion is not determined" in warming_text(cold.warming)


def test_a_part_that_stayed_cold_keeps_what_was_stated():
    """Struts alone warm, by sensors of their own: base and platform stay at 20 °C, and show nothing."""
    struts = fit_model(measured(parts=tuple(range(6))), replace(SETTINGS, base_expansion=11e-6))
    assert struts.model.base_expansion == pytest.approx(11e-6, abs=1e-12)
    assert "base: 11.00" in warming_text(struts.warming)
    assert warming_text(struts.warming).count("these readings do not determine it") == 2


@pytest.mark.parametrize(
    "wrong", [{"time_constants": (5.0,)}, {"time_constants": (90.0, 30.0)}, {"thermometer": "spindle"}]
)
def test_settings_in_doubt_are_refused(wrong: dict):
    with pytest.raises(ModelError, match="thermal"):
        FitSettings(**wrong)
