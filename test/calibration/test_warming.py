"""Heat and humidity: fits of machines with known growth, and the smoothed courses of noisy sensors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import calibration_helpers as small
import numpy as np
import pytest
from calibration_helpers import assert_recorded
from foreign_machines import machines
from scipy.linalg import null_space

from hexapod_comp.calibration.assumptions import ASSUMED
from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.thermal import (
    Growth,
    SensorRange,
    ThermalEvidence,
    TimeConstant,
    _Scan,
    _stairs,
    warming_text,
    with_courses,
)
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth
from hexapod_comp.measurements.campaign import Campaign, CampaignRun, template
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.virtual.instruments import measure

PLAN = small.blank(small.campaign("1-D"))
COUNT = len(PLAN.stations)


def course(times: np.ndarray, temperatures: np.ndarray) -> np.ndarray:
    """Return the smoothed courses of all parts' sensors, (COUNT, 8), °C, read at times of the plan's stations, s."""
    return with_courses(
        replace(PLAN, stations=replace(PLAN.stations, times=times, temperatures=temperatures))
    ).stations.temperatures


NUMBERS = np.arange(400)


@pytest.mark.parametrize(
    ("pause", "values", "width", "variance"),
    [
        (10.0, NUMBERS // 40, 399.0, 0.01 / 12.0),  # 9 steps in 3990 s
        (10.0, NUMBERS // 2 % 2, 60.0, 0.01 / 12.0 * 19.95 / 60.0),  # 199 steps: stairs are shorter than a bin
        (10.0, np.sqrt(NUMBERS // 40), 60.0, 0.0),  # steps of different sizes
        (1000.0, NUMBERS // 40, 2394.0, 0.01 / 12.0),  # of a long pause, 60 s count; 400 bins would be 997.5 s wide
        (1000.0, NUMBERS, 997.5, 0.01 / 12.0 * 59.85 / 997.5),
    ],
)
def test_a_sensor_that_rounds_gets_bins_as_long_as_its_stairs(pause, values, width, variance) -> None:
    """The display has steps of 0.1 K; rounding has the variance of an even distribution over a step."""
    assert _stairs(pause * NUMBERS, 20.0 + 0.1 * values) == pytest.approx((width, variance), rel=1e-9)


def test_without_times_each_run_has_a_course() -> None:
    run = np.zeros(COUNT, dtype=int)
    run[PLAN.station] = PLAN.run
    steps = np.tile(20.0 + 0.5 * (run[:, None] % 3), 8)
    np.testing.assert_allclose(course(np.full(COUNT, np.nan), steps), steps, atol=1e-9)


def test_a_course_is_the_mean_of_a_gaussian_process() -> None:
    """The truth is the posterior mean by dense matrices, with the covariance as a double integral of e^-|u-v|.

    Bins of 60 s then hold one reading each; the ratio of rate to noise maximises the restricted likelihood.
    """
    hour, times = ASSUMED.rate_persistence, 120.0 * np.arange(30.0)
    read = 20.0 + np.random.default_rng(2).normal(0.0, 0.02, 30) + 0.3 * np.sin(times / 1500.0)
    grid = (np.arange(len(times) * 8) + 0.5) * (times[1] / 8.0) / hour
    before = grid < times[:, None] / hour
    covariance = before @ np.exp(-np.abs(grid[:, None] - grid)) @ before.T * (times[1] / 8.0 / hour) ** 2
    away = null_space(np.ones((1, 30)))

    def unlikely(ratio: float) -> float:
        whole = np.eye(29) + ratio * away.T @ covariance @ away
        return 29.0 * np.log(read @ away @ np.linalg.solve(whole, away.T @ read)) + np.linalg.slogdet(whole)[1]

    ratio = min(np.geomspace(1e-4, 1e10, 43), key=unlikely)
    inverse = np.linalg.inv(np.eye(30) + ratio * covariance)
    level = inverse.sum(axis=0) @ read / inverse.sum()
    wanted = level + ratio * covariance @ inverse @ (read - level)
    stations = PLAN.stations.select(np.arange(30))
    of_all = replace(stations, times=times, temperatures=np.tile(read[:, None], 8))
    first = PLAN.select(np.isin(PLAN.station, np.arange(30)))
    found = with_courses(replace(first, stations=of_all)).stations.temperatures
    np.testing.assert_allclose(found, np.tile(wanted[:, None], 8), atol=2e-5)
    assert 1e-3 < ratio < 1e9
    assert np.abs(wanted - read).max() > 0.01


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
def measured(rise: float = 3.0, parts: tuple[int, ...] = (6,)) -> MeasurementSet:
    """Return lines read in eight rounds over two hours, while the thermometers of some parts rise.

    A line is read at one time, as each temperature of a fit is a machine of its own.
    """
    plan = rounds(small.BOX, 8)
    planned = template(plan, small.paper())
    times = np.empty(len(planned.stations))
    times[planned.station] = 300.0 * planned.run
    temperatures = np.full((len(times), 8), 20.0)
    temperatures[:, parts] -= rise * np.expm1(-times / 5400.0)[:, None]
    stations = replace(planned.stations, temperatures=temperatures, times=times)
    machine = truth("base" if parts == (6,) else "")
    return measure(replace(planned, stations=stations), plan, machine, seed=3)


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
    model = fit().model.late_growth
    assert (model.thermometer, model.time_constants) == ("base", (constant,))


def test_late_growth_keeps_the_expansion_in_the_fit():
    """The stated expansions are right, so the evidence is against a deviation, but growth is still estimated."""
    stated = replace(SETTINGS, strut_expansion=15e-6, base_expansion=11e-6, platform_expansion=14e-6)
    found = fit_model(measured(), stated)
    assert {d.block: (d.kept, d.evidence > ASSUMED.least_evidence) for d in found.decisions} == {
        "expansion": (True, False), "late": (True, True),
    }  # fmt: skip
    assert [growth.part for growth in found.warming.growths] == ["struts", "base", "platform"]


def test_gross_errors_do_not_hide_the_time_constant():
    """One reading in twenty is wrong by 20 to 60 µm, and the instrument slips by 30 µm in one run."""
    rng, read = np.random.default_rng(8), measured()
    wrong = rng.uniform(20e-6, 60e-6, len(read)) * rng.choice([-1.0, 1.0], len(read)) * (rng.random(len(read)) < 0.05)
    wrong += 30e-6 * ((read.run == 7) & (read.channel == read.channel[read.run == 7][0]) & (read.along() > 0.0))
    ((constant, deviation),) = fit_model(read.with_values(read.value + wrong), SETTINGS).warming.time_constants
    assert abs(np.log(constant / TAU)) < 3.0 * deviation < 0.6


def test_the_noise_of_sensors_is_not_taken_for_growth():
    """Sensors on the struts have 0.02 K of noise, and every strut's growth stays within three stated deviations.

    A fit to the raw readings would find 0.7 ± 0.4 in place of 21.0 ± 1.0 ppm/K."""
    quiet = measured(parts=tuple(range(8)))
    noise = 0.02 * np.random.default_rng(5).standard_normal(quiet.stations.temperatures.shape)
    stations = replace(quiet.stations, temperatures=quiet.stations.temperatures + noise)
    settings = replace(SETTINGS, blocks=("expansion",))
    noisy, known = (fit_model(replace(quiet, stations=s), settings).warming.growths for s in (stations, quiet.stations))
    for part, undisturbed in zip(noisy, known, strict=True):
        assert abs(part.found - undisturbed.found) < 3.0 * undisturbed.deviation, part
        assert part.deviation > 0.9 * undisturbed.deviation, part


EXPANSION = np.array([15e-6] * 6 + [11e-6, 14e-6])


def read_at(planned: MeasurementSet, plan: Campaign) -> MeasurementSet:
    """Return the readings of a machine whose only error is EXPANSION, at the temperatures in `planned`."""
    model = MachineModel("paper", struts=StrutErrors(expansion=EXPANSION[:6]), base_expansion=EXPANSION[6],
                         platform_expansion=EXPANSION[7])  # fmt: skip
    return measure(planned, plan, RealMachine(small.paper(), model), seed=4)


def test_errors_of_thermometers_that_last_a_round_are_in_the_standard_error():
    """Thermometers err by 0.05 K (1 σ), alike in a round: the platform's growth is 2.4 standard errors off.

    With independent errors of the readings it would be 3.3 standard errors off.
    """
    plan, shown = rounds(small.BOX, 8), measured(parts=tuple(range(8)))
    number = np.empty(len(shown.stations), dtype=int)
    number[shown.station] = shown.run // 3
    off = np.random.default_rng([9, 2]).normal(0.0, 0.05, (8, 8))[number]
    true = replace(shown.stations, temperatures=shown.stations.temperatures + off)
    read = replace(read_at(replace(shown, stations=true), plan), stations=shown.stations)
    growths = fit_model(read, replace(SETTINGS, blocks=("expansion",))).warming.growths
    for growth, wanted in zip(growths, EXPANSION[5:], strict=True):
        assert abs(growth.found - wanted) < 2.6 * growth.deviation, growth


def test_thermometers_that_are_rounded_do_not_override_what_is_stated():
    """Taken as exact, a step of 0.1 K would move a strut by 0.9 µm although it does not move, and give 1 ppm/K."""
    exact = measured(rise=1.0, parts=tuple(range(8)))
    read = read_at(exact, Campaign(small.BOX, 0.2, 0.05, "5-D", 0, noise=(2e-7,) * len(KINDS)))
    rounded = replace(read.stations, temperatures=read.stations.temperatures.round(1))
    names = ("strut_expansion", "base_expansion", "platform_expansion")
    stated = dict(zip(names, EXPANSION[5:].tolist(), strict=True))
    found = fit_model(replace(read, stations=rounded), replace(SETTINGS, **stated)).model
    np.testing.assert_allclose(found.struts.expansion, 15e-6, rtol=0.1)
    np.testing.assert_allclose([found.base_expansion, found.platform_expansion], EXPANSION[6:], rtol=0.1)


@pytest.mark.parametrize(("ends", "sure"), [(2.0, True), (1.0, False)])
def test_time_constants_of_a_quadratic_gain_are_refined_exactly(ends: float, sure: bool):
    """By hand: the inverse of [[2, 1.5], [1.5, 2]] has 2/1.75 on its diagonal; [[1, 1.5], [1.5, 1]] has no maximum.

    Along the second axis, a quarter of a step beside the first axis' best place, the best place is 0.375/`ends` away.
    """
    scan, curved = object.__new__(_Scan), np.array([[ends, 1.5], [1.5, ends]])
    scan._grid = 100.0 * 2.0 ** np.arange(9.0)
    scan.gain = lambda chosen: -0.5 * (np.array(chosen) - [2.25, 6.0]) @ curved @ (np.array(chosen) - [2.25, 6.0])
    deviation = np.log(2.0) * np.sqrt(2.0 / 1.75) if sure else np.inf
    wanted = [(400.0 * 2.0**0.25, deviation), (6400.0 * 2.0 ** (0.375 / ends), deviation)]
    assert scan.refined((2, 6)) == tuple(map(pytest.approx, wanted))
    for chosen in ((0, 8), (3, 4)):
        assert scan.refined(chosen) == tuple((scan._grid[n], np.inf) for n in chosen)


def test_parameters_keep_their_names_in_a_fit_without_delays():
    """Delayed growth stands before the compliance, so a vector without it is not the beginning of one with it."""
    settings = FitSettings(load=Load(stiffness=np.full(6, 20e6)).numbers(), time_constants=(100.0, 500.0))
    lagging, plain = (ParameterSpace(measured(), s) for s in (settings, replace(settings, time_constants=None)))
    x, tolerances = 1.0 + np.arange(lagging.size), 1.0 + np.arange(len(lagging.blocks))
    carried, sizes = plain.carried_over(lagging, x, tolerances)
    assert dict(zip(plain.labels, carried, strict=True)).items() <= dict(zip(lagging.labels, x, strict=True)).items()
    names = [block.name for block in lagging.blocks]
    assert names.index("late") < names.index("compliance")
    assert sizes.tolist() == [tolerances[names.index(block.name)] for block in plain.blocks]
    back, sizes = lagging.carried_over(plain, carried, sizes)
    assert not back[lagging.block("late").part].any()
    assert sizes[names.index("late")] == lagging.start_tolerances()[names.index("late")]


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


def test_standard_errors_grow_with_the_jackknife_factor() -> None:
    """At factors so large that the jackknife over time is smaller, three times the factor is three times the error."""
    found = fit()
    estimation = Estimation(found.measurements, found.space)
    small, large = (
        ThermalEvidence.of(found.measurements, estimation, found.solution, found.warming.time_constants, factor)
        for factor in (100.0, 300.0)
    )
    for before, after in zip(small.growths, large.growths, strict=True):
        assert after.deviation == pytest.approx(3.0 * before.deviation)


def test_without_a_warm_up_nothing_is_invented():
    """A warm-up of 0.35 K may be a sensor's drift: stated expansions stay."""
    cold = fit_model(measured(rise=0.35), replace(SETTINGS, strut_expansion=12e-6))
    assert cold.warming.growths == ()
    assert cold.model.late_growth.time_constants == ()
    np.testing.assert_array_equal(cold.model.struts.expansion, 12e-6)


def test_the_report_states_what_a_fit_found_and_what_it_did_not():
    """The share of the readings in the base's growth is exactly the limit: it does not count as determined."""
    ranges = (SensorRange("strut_1", 20.0, 23.0, "degC"), SensorRange("humidity", 0.45, 0.7, "1"))
    heat = Growth("struts", "1/K", 11e-6, 15.126e-6, 2e-7, 0.99, (-2e-5, 1e-6))
    late = (TimeConstant(1500.0, 0.05), TimeConstant(9000.0, 1.0), TimeConstant(600.0, 0.0))
    humid = Growth("struts", "m/m", 1e-4, 3e-4, 1e-5, 0.4)
    growths = (heat._replace(late=()), Growth("base", "1/K", 0.0, 1e-6, 2e-6, 0.5), humid)
    found = ThermalEvidence(ranges, "base", growths, (), False)
    lagging = replace(found, thermometer="", growths=(heat, humid._replace(deviation=np.nan)), time_constants=late[:2])
    nothing = ThermalEvidence(ranges[:1], "", (), late[2:], True)
    assert_recorded("heat_and_humidity", "\n\n".join(map(warming_text, (found, lagging, nothing))) + "\n")
    assert warming_text(replace(nothing, ranges=())) == ""


def test_two_given_time_constants_share_the_delayed_growth():
    """The truth has one of 1500 s, with -20 ppm/K on the struts: most of it goes to the first constant."""
    warming = fit_model(measured(), replace(SETTINGS, time_constants=(TAU, 6.0 * TAU))).warming
    assert warming.time_constants == ((TAU, 0.0), (6.0 * TAU, 0.0))
    assert warming.growths[0].late == pytest.approx((-20e-6, 0.0), abs=4e-6)
    assert sum(warming.growths[0].late) == pytest.approx(-20e-6, abs=1e-6)


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
    (swing,), (growth,) = fitted.warming.ranges, fitted.warming.growths
    assert swing == ("humidity", pytest.approx(0.4), pytest.approx(0.65), "1")
    assert abs(growth.found - MOISTURE) < 3.0 * growth.deviation < 0.3 * MOISTURE
    assert growth.determined > 0.9
    np.testing.assert_allclose(fitted.model.struts.moisture, growth.found, atol=1e-11)  # rounding in a file is 1e-11


def test_missing_humidity_is_said_and_counts_as_50_percent(geometry: HexapodGeometry) -> None:
    dry = damp(geometry)
    dry = replace(dry, stations=replace(dry.stations, humidity=np.full(len(dry.stations), np.nan)))
    unknown = fit_model(dry, DAMP)
    assert any("some readings have no humidity_percent" in note for note in unknown.notes)
    assert unknown.warming.ranges == (("humidity", 0.5, 0.5, "1"),)
