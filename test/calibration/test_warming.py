"""Heat and humidity: fits of machines with known growth, and the smoothed courses of noisy sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import calibration_helpers as small
import numpy as np
import pytest
from foreign_machines import machines

from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.calibration.thermal import warming_text, with_courses
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth
from hexapod_comp.measurements.campaign import Campaign, CampaignRun, template
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.virtual.instruments import measure

PLAN = template(small.campaign("1-D"), small.paper())
COUNT = len(PLAN.stations)


def course(times: np.ndarray, temperatures: np.ndarray) -> np.ndarray:
    """Return the smoothed courses of all parts' sensors, (COUNT, 8), °C, read at times of the plan's stations, s."""
    return with_courses(
        replace(PLAN, stations=replace(PLAN.stations, times=times, temperatures=temperatures))
    ).stations.temperatures


def test_what_sensors_add_within_a_burst_is_taken_off() -> None:
    """Noise within a burst is smoothed: fifty stations every ten minutes, 4 s apart, on parts that warm by 3 K.

    A filter of 30 s makes eight readings alike: six of fifty are independent, and level and slope are two of these.
    From reading to reading the course changes by no more than a slope known from half of the noise over a minute.
    """
    left, times = 0.0065, 600.0 * (np.arange(COUNT) // 50) + 4.0 * (np.arange(COUNT) % 50)
    true = np.tile(20.0 - 3.0 * np.expm1(-times / 1500.0)[:, None], 8)
    white = np.random.default_rng(7).standard_normal((COUNT + 30, 8))
    alike = np.array([white[n : n + 8].mean(axis=0) for n in range(COUNT)])
    found = course(times, true + left * alike / alike.std(axis=0))
    assert ((found - true).std(axis=0) < left * np.sqrt(2.0 / 6.0) * 1.3).all()
    jitter = np.diff(found - true, axis=0)[np.diff(times) < 5.0]
    assert np.abs(jitter).max() < 4.0 * 0.5 * left / 60.0 * 4.0


def test_without_times_each_run_has_a_course() -> None:
    """Without times, a temperature that changes from run to run stays constant within each run."""
    run = np.zeros(COUNT, dtype=int)
    run[PLAN.station] = PLAN.run
    steps = np.tile(20.0 + 0.5 * (run[:, None] % 3), 8)
    np.testing.assert_allclose(course(np.full(COUNT, np.nan), steps), steps, atol=1e-9)


pytestmark = pytest.mark.usefixtures("unsuspected")
TAU = 1500.0
SETTINGS = FitSettings(blocks=("expansion", "late"))


def rounds(box: np.ndarray, count: int) -> Campaign:
    """Return lines of five points along x, y and z through a box's middle, read again in each round."""
    runs = []
    for number in range(count):
        for axis in range(3):
            positions = np.tile(box.mean(axis=0), (5, 1))
            positions[:, axis] = np.linspace(*box[:, axis], 5)
            runs.append(CampaignRun(f"{axis} {number}", "5-D", positions, np.tile(np.eye(3), (5, 1, 1))))
    side = float(np.ptp(box, axis=0).min())
    return Campaign(box, side, side, None, 0, runs=tuple(runs), noise=(2e-7,) * len(KINDS))


def truth(thermometer: str = "base") -> RealMachine:
    """Return a machine whose only error is growth: struts lead the base's thermometer, the platform lags behind it."""
    expansion = np.array([[-20e-6]] * 6 + [[0.0], [8e-6]])
    model = MachineModel(
        "paper", "warm", struts=StrutErrors(expansion=np.full(6, 15e-6)), base_expansion=11e-6,
        platform_expansion=14e-6, late_growth=LateGrowth((TAU,), expansion, thermometer),
    )  # fmt: skip
    return RealMachine(small.paper(), model)


@cache
def measured(rise: float = 3.0, timed: bool = True, parts: tuple[int, ...] = (6,)) -> MeasurementSet:
    """Return lines read in eight rounds over two hours, while the thermometers of some parts rise."""
    plan = rounds(small.BOX, 8)
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
    """Expansions and time constant are within three stated deviations; the struts' mean is within 1 ppm/K."""
    warming = fit().warming
    wanted = {"struts": (15e-6, -20e-6), "base": (11e-6, 0.0), "platform": (14e-6, 8e-6)}
    assert [growth.part for growth in warming.growths] == list(wanted)
    for growth in warming.growths:
        assert abs(growth.found - wanted[growth.part][0]) < 3.0 * growth.deviation, growth
    assert warming.growths[0].found == pytest.approx(15e-6, abs=1e-6)
    ((constant, deviation),) = warming.time_constants
    assert abs(np.log(constant / TAU)) < 3.0 * deviation < 0.6
    model, text = fit().model.late_growth, warming_text(warming)
    assert (model.thermometer, model.time_constants) == ("base", (constant,))
    assert "base represents all parts" in text
    assert "struts: 1" in text


def test_the_noise_of_sensors_is_not_taken_for_growth():
    """Sensors on the struts have 0.02 K of noise, and every strut's growth stays within three stated deviations.

    A fit to the raw readings would find 1.4 ± 0.2 in place of 19.7 ± 0.3 ppm/K."""
    quiet = measured(parts=tuple(range(8)))
    noise = 0.02 * np.random.default_rng(5).standard_normal(quiet.stations.temperatures.shape)
    stations = replace(quiet.stations, temperatures=quiet.stations.temperatures + noise)
    settings = replace(SETTINGS, blocks=("expansion",))
    noisy, known = (fit_model(replace(quiet, stations=s), settings).warming.growths for s in (stations, quiet.stations))
    for part, undisturbed in zip(noisy, known, strict=True):
        assert abs(part.found - undisturbed.found) < 3.0 * undisturbed.deviation, part
        assert part.deviation > 0.9 * undisturbed.deviation, part


def test_thermometers_that_are_rounded_do_not_override_what_is_stated():
    """A stated 15 ppm/K changes by at most a tenth if the displays have steps of 0.1 K and the struts warm by 1 K.

    Taken as exact, a step of 0.1 K would move a strut by 0.9 µm although it does not move, and give 1 ppm/K.
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
    """The truth is fits with a time constant 10 % smaller and larger; the sizes of priors change a little, too."""
    ((constant, deviation),) = fit().warming.time_constants
    ends = [
        fit_model(measured(), replace(SETTINGS, time_constants=(constant * np.exp(way),))).warming.growths
        for way in (-0.1, 0.1)
    ]
    for part, shorter, longer in zip(fit().warming.growths, *ends, strict=True):
        moved = deviation * abs(longer.found - shorter.found) / 0.2
        alone = 0.5 * (shorter.deviation + longer.deviation)
        assert part.deviation == pytest.approx(np.hypot(alone, moved), rel=0.1), part


def test_without_a_warm_up_nothing_is_invented():
    """A warm-up of 0.35 K may be a sensor's drift: stated expansions stay, and the report says so."""
    cold = fit_model(measured(rise=0.35), replace(SETTINGS, strut_expansion=12e-6))
    assert cold.warming.growths == ()
    assert cold.model.late_growth.time_constants == ()
    np.testing.assert_array_equal(cold.model.struts.expansion, 12e-6)
    assert "expansion is not determined" in warming_text(cold.warming)


MOISTURE = 3e-4  # 3 ppm of length per % of humidity
DAMP = FitSettings(blocks=("moisture",), strut_moisture=1e-4)


@pytest.fixture(scope="module")
def geometry(tmp_path_factory: pytest.TempPathFactory) -> HexapodGeometry:
    return load_geometry(machines()["framed"].write(tmp_path_factory.mktemp("machine") / "framed.yaml"))


def damp(geometry: HexapodGeometry) -> MeasurementSet:
    """Return lines of a 6-6 machine with turned frames, read in four rounds while humidity rises from 40 % to 65 %."""
    plan = rounds(machines()["framed"].box, 4)
    planned = template(plan, geometry)
    humidity = 0.4 + 0.25 * np.linspace(0.0, 1.0, len(planned.stations))
    planned = replace(planned, stations=replace(planned.stations, humidity=humidity.round(6)))
    model = MachineModel(geometry.name, struts=StrutErrors(moisture=np.full(6, MOISTURE)))
    return measure(planned, plan, RealMachine(geometry, model), seed=5)


def test_what_humidity_does_to_struts_comes_back(geometry: HexapodGeometry) -> None:
    fitted = fit_model(damp(geometry), DAMP)
    (change,), (growth,) = fitted.warming.changes, fitted.warming.growths
    assert change == ("humidity", pytest.approx(0.25), "1")
    assert abs(growth.found - MOISTURE) < 3.0 * growth.deviation < 0.3 * MOISTURE
    assert growth.determined > 0.9
    np.testing.assert_allclose(fitted.model.struts.moisture, growth.found, atol=1e-11)  # rounding in a file is 1e-11


def test_missing_humidity_is_said_and_counts_as_50_percent(geometry: HexapodGeometry) -> None:
    dry = damp(geometry)
    dry = replace(dry, stations=replace(dry.stations, humidity=np.full(len(dry.stations), np.nan)))
    unknown = fit_model(dry, DAMP)
    assert any("some readings have no humidity_percent" in note for note in unknown.notes)
    assert unknown.warming.changes == (("humidity", 0.0, "1"),)
