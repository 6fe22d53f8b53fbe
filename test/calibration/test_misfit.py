"""Errors in readings that no parameter describes, and how they widen the predicted interval.

The test adds each misfit, of known size, to the readings of a machine of the model's class. The machine itself has 0.3
µm of tool error after the fit; a reading has 1 µm or 1 µrad of noise.
"""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_helpers import BOX, FEW, SETTINGS, campaign, measured, virtual_machine
from scipy.stats import f as f_distribution

from hexapod_comp.calibration.estimator import Estimation, NotSettled, Posterior, influence, iterate
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.fit import _about_inputs, _check_backlash, fit_model
from hexapod_comp.calibration.lead import ScrewLead
from hexapod_comp.calibration.mistakes import family_of_run
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import box_errors, expected_error, stations_of
from hexapod_comp.calibration.promise import Scatter, Unexplained
from hexapod_comp.calibration.report import fit_report
from hexapod_comp.calibration.sensitivity import derivatives, predict
from hexapod_comp.calibration.trust import (
    Residuals,
    _of_priors,
    held_by_priors,
    note_on_unstated,
    stated_scale,
    variance_ratio,
)
from hexapod_comp.errors import CalibrationError, ModelError
from hexapod_comp.machine.kinematics import Structure, strut_lengths_batch
from hexapod_comp.machine.passes import random_passes
from hexapod_comp.machine.trial import Trial
from hexapod_comp.measurements.readings import CHANNELS, KINDS, UNKNOWN, MeasurementSet, Stations
from hexapod_comp.measurements.stations import station_errors

pytestmark = pytest.mark.usefixtures("unsuspected")  # the search for mix-ups is tested in test_mixed_up

LINEAR, STRAIGHTNESS, ROTATION = (KINDS.index(kind) for kind in ("linear", "straightness", "rotation"))


@pytest.fixture(scope="module")
def readings() -> MeasurementSet:
    """Return the readings of a machine that the model describes."""
    return measured(virtual_machine(3), campaign(), 3)


def test_what_is_described_is_promised_as_before(readings):
    """The laser's stated scale, 0.5 ppm over 0.2 m, and the finite degrees of freedom of the covariance widen the
    interval by at most 1.6 times; priors add below 0.001."""
    fit = fit_model(readings, FEW)
    beyond = fit.unexplained
    assert (beyond.factor, beyond.drift) == (1.0, 0.0)
    assert beyond.displacement == beyond.rotation == Scatter()
    assert (fit.misfit, fit.doubts) == ("", ())
    before = expected_error(box_errors(fit.space, fit.solution.x), fit.covariance)
    assert beyond.prior < 1e-3
    assert fit.level.low == pytest.approx(before.low, rel=1e-4)
    assert before.high < fit.level.high < 1.6 * before.high
    assert beyond.averaged < 1.1, "no block that was left out is likely to be there"
    assert beyond.ratio < 1.5, "runs show no more than a right covariance lets them"
    assert fit.level.rotation_high is None, "nothing reads the roll"


def test_the_upper_end_holds_what_a_variance_may_be():
    """Closed forms: χ² with 2 degrees of freedom is exponential; with infinite belief the interval is not widened.

    Draws that are normal along one axis become Student's t, whose square is Fisher's F.
    """
    places, one, tail = np.zeros((2, 3)), np.full(100_001, 1e-6), -2.0 * np.log(0.975)  # P(χ² > tail) = 0.975

    def high(left: np.ndarray = one, **of: float) -> float:
        return 1e6 * Unexplained(**of).promised(left, places).high

    assert high(believed=2.0) == pytest.approx(np.sqrt(2.0 / tail), rel=1e-3)
    assert high(believed=1.0, freedom=1.0, ratio=5.0) == pytest.approx(np.sqrt(6.0 / tail), rel=1e-3)
    assert high(believed=1e9, freedom=20.0, ratio=4.0) == pytest.approx(1.0, abs=1e-3)
    assert high(believed=12.0, freedom=1e9, ratio=4.0) == pytest.approx(2.0, rel=1e-3)
    assert high(believed=4.0, freedom=8.0, ratio=0.5) == high(believed=12.0), "agreeing well narrows nothing"
    normal = 1e-6 * np.abs(np.random.default_rng(1).standard_normal(100_001))
    assert high(normal, believed=5.0) == pytest.approx(np.sqrt(f_distribution.ppf(0.975, 1, 5)), rel=0.03)


def test_an_interval_is_widened_by_each_cause_in_its_way():
    """All draws are 1 µm; each cause widens the interval by its closed form. Two places 2 m apart have arms of 1 m."""
    one, places = np.full(9, 1e-6), np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert Unexplained().promised(one, places) == pytest.approx((1e-6, 1e-6, 1e-6))
    assert Unexplained(factor=3.0, averaged=4.0).promised(one, places) == pytest.approx((3e-6, 1e-6, 4e-6))
    priors = Unexplained(prior=0.5 * np.log(2.0)).promised(one, places)
    assert priors == pytest.approx((1e-6, 0.5e-6, 2e-6))
    scaled = Unexplained(scale=1e-6).promised(one, places)
    assert scaled == pytest.approx((np.sqrt(2.0) * 1e-6, 1e-6, np.sqrt(5.0) * 1e-6))
    drifted = Unexplained(drift=2e-6).promised(one, places)
    assert drifted == pytest.approx(scaled), "1 ppm at either end of the campaign"
    both = Unexplained(displacement=Scatter(lack=1e-6), assumed_backlash=np.sqrt(2.0) * 1e-6).promised(one, places)
    assert both == pytest.approx((2e-6, 1e-6, np.sqrt(1.0 + 2.25 * 3.0) * 1e-6))
    stops = Unexplained(displacement=Scatter(stops=np.sqrt(3.0) * 1e-6, most_stops=np.sqrt(8.0) * 1e-6))
    assert stops.promised(one, places) == pytest.approx((2e-6, 1e-6, 3e-6))
    assert stops.promised_rotation(one) == pytest.approx((1e-6, 1e-6, 1e-6))
    turned = Unexplained(rotation=Scatter(lack=np.sqrt(3.0) * 1e-6))
    assert turned.promised_rotation(one) == pytest.approx((2e-6, 1e-6, np.sqrt(1.0 + 2.25 * 3.0) * 1e-6))


DOWN = 0.0, 0.0, -9.80665
LOADS = [(10.0, 0.0, 0.0, 0.0, *DOWN), (2.5, 0.0, 0.0, 0.0, *DOWN), (4.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0)]


@pytest.mark.parametrize(
    ("given", "note"),
    [
        (
            {"loads": LOADS[:1]},
            "the readings were taken with a tool of 10 kg and one direction of gravity: .* for these loads alone, ",
        ),
        ({"loads": LOADS}, ".*no struts' stiffness is stated .*; deflections that differ between these loads appear"),
        (
            {"loads": LOADS, "elsewhere": "so"},
            "the readings were taken with tools of 2.5 to 10 kg and 2 directions of .* loads; so",
        ),
        ({"lead": ScrewLead(9e-3, 10e-3, 1e-6, 50.0)}, ".*repeat every 10 mm: is the given lead of 9 mm right."),
        ({"lead": ScrewLead(None, None, np.inf, 0.0)}, "the screws' lead is not known, .* errors are not fitted"),
        (
            {"warmth": 0.3},
            "the readings were taken at up to 0.3 K from 20 °C, but no thermal expansion is stated or fitted: thermal "
            "growth appears as other errors",
        ),
        ({"strut_moisture": 0.0}, "the struts swell, but some readings have no humidity_percent: 50 % is assumed"),
        ({"warmth": 0.3, "strut_expansion": 1e-5}, ""),
        ({"warmth": 0.19, "lead": ScrewLead(10e-3, 10e-3, 1e-6, 50.0)}, ""),
    ],
)
def test_notes_on_what_was_stated_or_is_missing(readings, given: dict, note: str):
    """The temperature of one part at one station is `warmth`, K, below 20 °C."""
    defaults = {"loads": (), "lead": None, "elsewhere": "", "warmth": 0.0}
    loads, lead, elsewhere, warmth = (given.get(name, default) for name, default in defaults.items())
    temperatures = readings.stations.temperatures.copy()
    temperatures[7, 2] -= warmth
    read = replace(readings, stations=replace(readings.stations, temperatures=temperatures))
    space = ParameterSpace(read, replace(FEW, **{name: given[name] for name in given.keys() - defaults.keys()}))
    notes = list(_about_inputs(read, space, lead, loads, elsewhere))
    assert len(notes) == bool(note)
    assert re.match(note, "".join(notes))


def some_posterior(covariance: np.ndarray, **values: np.ndarray) -> Posterior:
    """Return a posterior with all parameters in use; what is not given is NaN."""
    unknown = dict.fromkeys(("y", "tolerances", "noise", "determined", "spread"), np.full(len(covariance), np.nan))
    return Posterior(np.arange(len(covariance)), covariance=covariance, log_determinant=np.nan, **(unknown | values))


def test_negative_backlashes_are_noted_or_refused(readings):
    """Estimates below −4 σ are noted for up to three struts; four mean that forward and backward are swapped."""
    space = ParameterSpace(readings, FEW)
    x = np.zeros(space.size)
    x[space.block("backlash").part] = 1e-6 * np.array([-4.1, -3.9, -5.0, 0.0, 2.0, -6.0])
    posterior = some_posterior(1e-12 * np.eye(space.size), y=x)
    solution = SimpleNamespace(x=x, posterior=posterior)
    found = {"strut_1": "-4.10", "strut_3": "-5.00", "strut_6": "-6.00"}
    notes = [f"{strut}: backlash was estimated as {value} µm; the model has 0" for strut, value in found.items()]
    assert _check_backlash(space, solution) == notes
    assert _check_backlash(ParameterSpace(readings, replace(FEW, blocks=())), solution) == []
    x[space.block("backlash").part.start + 3] = -4.5e-6
    with pytest.raises(
        CalibrationError, match=r"^direction: .*: the struts would have .* -4\.10, -3\.90, .*, -6\.00 µm$"
    ):
        _check_backlash(space, solution)


@pytest.mark.parametrize(
    ("unexplained", "doubts", "notes"),
    [
        (Unexplained(), "", ""),
        (Unexplained(factor=3.0), "", "leaving out .* multiplied by 3.0; the expected tool error allows for it"),
        (Unexplained(factor=3.01), "leaving out .* multiplied by 3.0: runs, or their instruments, contradict", ""),
        (Unexplained(drift=2.9e-6, drift_error=1e-6), "", ""),
        (Unexplained(drift=23e-6, drift_error=7e-6), "the scale .* 23 ppm .as steel does if warmed by 2 K., from", ""),
        (
            Unexplained(displacement=Scatter(1.234e-6, 2e-6, 3e-6), rotation=Scatter(5e-6)),
            "",
            "no parameter describes 1.23 µm RMS of the tool's displacement and 5.00 µrad RMS of its rotation .* it, "
            "repeated readings scatter by 2.00 µm RMS of the tool's displacement beyond the stated σ: ",
        ),
        (
            Unexplained(assumed_backlash=5e-6),
            "",
            "no reading states its direction .* an assumed backlash, 5.00 µm RMS of ",
        ),
    ],
)
def test_findings_on_unexplained_errors(unexplained: Unexplained, doubts: str, notes: str):
    for found, wanted in zip(unexplained.findings(), (doubts, notes), strict=True):
        assert re.match(wanted, ", ".join(found))
        assert bool(found) == bool(wanted)


def test_noise_beyond_the_stated_is_promised(readings):
    """Four times the stated noise puts a fit in doubt (from 3), but it is written (below 10). Without repeats the upper
    end contains the scatter, as instrument or machine may cause it; the lower end does not."""
    noise = 4e-6 * np.random.default_rng(2).standard_normal(len(readings))
    fit = fit_model(readings.with_values(readings.value + noise), FEW)
    beyond = fit.unexplained
    for part in (beyond.displacement, beyond.rotation):
        assert part == Scatter(lack=pytest.approx(4e-6 * np.sqrt(3.0), rel=0.1))
    plain = expected_error(box_errors(fit.space, fit.solution.x), fit.covariance)
    before = [np.hypot(plain.before, beyond.displacement.lack), np.hypot(plain.rotation_before, beyond.rotation.lack)]
    assert [fit.level.before, fit.level.rotation_before] == pytest.approx(before), "no compensation removes it"
    assert fit.level.low < 1e-6
    assert fit.level.high > 4e-6 * np.sqrt(3.0)
    assert fit.misfit == ""
    assert fit_report(fit).startswith("IN DOUBT:\n  readings scatter by more than 3 times their noise")


@pytest.mark.parametrize(("cycles", "widest"), [(1, 1.6), (2, 1.3)])
def test_the_machine_s_repeatability_stays_in_use(cycles: int, widest: float):
    """Stops within ±1 µm along each axis are √3 µm RMS off; 600 readings or as many repeats show it to 10 %.

    With repeats it is called repeatability; without repeats it may also be a lack of fit.
    """
    fit = fit_model(measured(virtual_machine(3), campaign(cycles=cycles, repeatability=1e-6), 3), FEW)
    scatter, found = fit.unexplained.displacement, pytest.approx(1e-6 * np.sqrt(3.0), rel=0.1)
    assert (scatter.lack, scatter.stops) == ((found, 0.0) if cycles == 1 else (0.0, found))
    left = held_out(virtual_machine(3), fit.model, BOX, repeatability=1e-6).aligned.rms
    assert fit.level.low < left < fit.level.high < widest * left
    assert fit.level.after == pytest.approx(left, rel=0.1)


def test_lines_of_unknown_direction_do_not_scatter(readings):
    """Forward and backward readings of these lines differ by the whole backlash, 3…5 µm of each strut, which the other
    lines show. The truth is the difference of the machine's own errors forward and backward, and its tool error.
    """
    unsaid = readings.run % 5 == 0
    key = np.hstack([readings.run[:, None], readings.stations.positions[readings.station].round(9)])
    key = np.hstack([key, np.where(unsaid, 0, readings.station)[:, None]])
    _, first, station = np.unique(key, axis=0, return_index=True, return_inverse=True)
    kept, station = readings.stations.select(readings.station[first]), station.ravel()
    sense, direction = np.where(unsaid[first, None], 0.0, kept.sense), np.where(unsaid, UNKNOWN, readings.direction)
    m = replace(readings, station=station, direction=direction, stations=replace(kept, sense=sense))
    fit = fit_model(m, FEW)

    ways = [replace(m, stations=replace(kept, sense=np.full(sense.shape, way))) for way in (1.0, -1.0)]
    half = 0.5 * np.subtract(*(station_errors(way, virtual_machine(3)) for way in ways))
    off = (m.directions() * half[m.station]).sum(axis=1)
    along_z, found = unsaid & (m.directions()[:, 2] > 0.99), fit.solution.problem.uncertainty
    ratio = found[along_z] / np.hypot(1e-6, off[along_z])
    assert 1.0 <= ratio.min() < 1.2, "near the middle of the box all struts lengthen along z, and all lags add up"
    assert ratio.max() < 2.0
    assert (found[~unsaid] == m.uncertainty[~unsaid]).all()
    left = held_out(virtual_machine(3), fit.model, BOX).aligned.rms
    assert fit.level.low < left < fit.level.high < 3.0 * left
    assert fit.unexplained.displacement.stops == 0.0
    assert fit.misfit == ""


def lost_motion(stations: Stations, structure: Structure) -> np.ndarray:
    """Return each strut's lost motion by friction, (N, 6), m: by the sign of its speed, varying along it."""
    lengths = strut_lengths_batch(structure, stations.positions, stations.rotations)
    return 4e-6 * stations.sense[:, 3:] * np.cos(2.0 * np.pi * lengths / 0.06 + np.arange(6))


@pytest.mark.parametrize("cycles", [1, 3])
def test_friction_in_the_struts_is_no_repeatability(cycles: int):
    """A lost motion that varies along the struts is in no block: it is a lack of fit, and repeats except for 1 µm.

    The truth is the machine itself, moved through random points in both directions.
    """
    truth, plan = virtual_machine(3), campaign(cycles=cycles, repeatability=1e-6)
    structure, ours = Structure.of(truth.geometry), measured(truth, plan, 3)

    def lost(stations: Stations, commands: np.ndarray) -> Stations:
        return replace(stations, commands=commands + lost_motion(stations, structure))

    rubbing = replace(ours, stations=lost(ours.stations, ours.stations.commands))
    added = (station_errors(rubbing, truth) - station_errors(ours, truth))[ours.station]
    added = (ours.directions() * added).sum(axis=1)
    group = ours.run * len(CHANNELS) + ours.channel
    first = np.unique(group, return_index=True)
    added -= added[first[1]][np.searchsorted(first[0], group)]
    fit = fit_model(ours.with_values(ours.value + added), FEW)

    passes = random_passes(truth.geometry, BOX, 300, 0.0, np.random.default_rng(5))
    trial, stations = Trial(truth, passes), stations_of(passes)
    errors = trial.errors(lost(stations, trial.commands(fit.model)).commands).aligned().displacement
    errors = errors + 1e-6 * np.random.default_rng(6).standard_normal(errors.shape)
    left, scatter = float(np.sqrt((errors**2).sum(axis=1).mean())), fit.unexplained.displacement
    assert fit.level.low < left < fit.level.high < 2.2 * left
    assert scatter.stops == (0.0 if cycles == 1 else pytest.approx(1e-6 * np.sqrt(3.0), rel=0.15))
    assert scatter.lack > 2.0 * scatter.stops


def test_a_scale_that_drifts_is_measured(readings):
    """A scale that drifts by 30 ppm from the first to the last reading is measured; its standard error is 3 ppm."""
    time = np.linspace(-0.5, 0.5, len(readings))
    growth = 30e-6 * time * readings.along() * (readings.kind == LINEAR)
    fit = fit_model(readings.with_values(readings.value + growth), FEW)
    assert fit.unexplained.drift == pytest.approx(30e-6, rel=0.3)
    assert fit.unexplained.drift_error == pytest.approx(3e-6, rel=0.1)
    assert any("scale of the linear readings" in doubt for doubt in fit.doubts)


def test_lines_that_differ_from_each_other_widen_the_promise(readings):
    """Each run's laser has a scale error of its own, ±30 ppm, which is 6 µm on lines read to 1 µm."""
    scale = 30e-6 * np.random.default_rng(4).standard_normal(len(readings.runs))
    spoilt = readings.value + scale[readings.run] * readings.along() * (readings.kind == LINEAR)
    fit = fit_model(readings.with_values(spoilt), FEW)
    assert fit.unexplained.factor > 1.5
    plain = replace(fit, unexplained=replace(fit.unexplained, factor=1.0))
    assert fit.level.high > 1.5 * expected_error(box_errors(fit.space, fit.solution.x), plain.covariance).high
    np.testing.assert_allclose(fit.standard_errors, fit.unexplained.factor * plain.standard_errors)


def test_chi_square_is_told_by_lines_and_direction(readings):
    """Noise of 5 µm on the y-lines' straightness gives this part alone a χ² of 25, minus what the fit absorbs."""
    spoilt = (family_of_run(readings)[readings.run] == 1) & (readings.kind == STRAIGHTNESS)
    noise = 5e-6 * np.random.default_rng(5).standard_normal(len(readings)) * spoilt
    fit = fit_model(readings.with_values(readings.value + noise), replace(FEW, robust=False))
    values = {(c.kind, c.part): c.value for c in fit.chi_squares}
    assert values["straightness", "y lines"] == pytest.approx(26.0, rel=0.25)
    assert max(values["straightness", "x lines"], values["linear", "y lines"]) < 2.0
    worst = fit.chi_squares_of_runs[0]
    assert (worst.kind, worst.part[:6]) == ("straightness", "y line")


def test_one_run_is_held_by_the_priors(readings):
    fit = fit_model(readings.select(readings.run == 0), SETTINGS)
    assert re.search("larger than the tool error without it.*; 90 readings do not determine", fit.misfit)
    assert fit.misfit in "; ".join(fit.refusals)


def test_a_fit_that_does_not_settle_names_the_runs_that_pull(readings, monkeypatch):
    """A fit that does not converge with run 3 omits it; if it does not converge without it either, it is refused."""
    always = False

    def unsettled(estimation, *start):
        solution = iterate(estimation, *start)
        if always or (estimation.measurements.run == 3).any():
            raise NotSettled("did not settle", solution)
        return solution

    monkeypatch.setattr("hexapod_comp.calibration.fit.iterate", unsettled)
    along, name = readings.along() / np.abs(readings.along()).max(), readings.runs[3].name
    pull = np.where(readings.run == 3, 50e-6 * along + 20e-6 * along**2, 0.0)  # as from another state of the machine
    # Without run 0, the numbers of the runs are no indices of the runs that are left.
    pulled = readings.with_values(readings.value + pull).select(readings.run != 0)
    fit = fit_model(pulled, FEW)
    assert fit.doubts[0] == f"left out because the fit does not converge otherwise: run {name}"
    assert 3 not in fit.measurements.run
    always = True
    named = "; it also fails without the runs that influence it most: "
    assert f"did not settle{named}{name}" in fit_model(pulled, FEW).misfit
    assert named not in fit_model(readings.select(readings.run == 0), FEW).misfit, "the only run cannot be left out"


def test_influence_is_what_leaving_a_run_out_does(readings):
    """The truth is the normal equations without the run's rows."""
    space = ParameterSpace(readings, FEW)
    estimation = Estimation(readings, space)
    start = np.zeros(space.size), space.start_tolerances(), np.ones(len(KINDS))
    solution = iterate(estimation, *start, lambda _: None)
    run = readings.run[estimation.means.first]
    p, scale = solution.posterior, 1.0 / solution.posterior.noise[solution.problem.kind]
    rows = scale[:, None] * solution.problem.rows.dense()[:, p.used]
    prior, target = np.diag(p.spread**-2.0), scale * solution.problem.target
    everything = rows.T @ rows + prior
    others = run != 3
    change = np.linalg.solve(rows[others].T @ rows[others] + prior, rows[others].T @ target[others])
    change -= np.linalg.solve(everything, rows.T @ target)
    assert influence(run, solution)[3] == pytest.approx(np.sqrt(change @ everything @ change), rel=1e-6)


def test_fitted_parameters_zeros_and_slopes_correlate_residuals(readings):
    """The truth is the covariance σ²·K⁻¹·σ² of residuals, with K the readings' dense covariance: noise, parameters, and
    zeros and slopes of 1 cm and 1 cm/m, 10⁴ times the noise."""
    m = readings.select(readings.run % 5 == 0)
    estimation = Estimation(m, ParameterSpace(m, replace(FEW, robust=False)), check_count=False)
    cells, space = estimation.means, estimation.space
    start = np.zeros(space.size), space.start_tolerances(), np.ones(len(KINDS))
    r = Residuals(estimation, iterate(estimation, *start, lambda text: None))
    posterior = r.solution.posterior
    sigma = m.stated[cells.first] * posterior.noise[cells.kind]
    slopes = derivatives(space, predict(space, r.solution.x, m.stations), m.stations)[cells.station]
    columns = np.einsum("ci,cip->cp", cells.directions, slopes)
    group = (cells.group[:, None] == np.unique(cells.group)).astype(float)
    straight = np.where(cells.kind == STRAIGHTNESS, m.along()[cells.first], 0.0)
    beams = 1e-2 * np.hstack([group, group * straight[:, None]])
    covariance = columns @ space.prior_covariance(posterior.tolerances) @ columns.T + beams @ beams.T
    wanted = np.eye(len(sigma)) - sigma[:, None] * np.linalg.inv(covariance + np.diag(sigma**2)) * sigma
    every = np.arange(len(sigma))
    np.testing.assert_allclose(r.absorbed, np.diag(wanted), atol=1e-4)
    np.testing.assert_allclose(r.leverage(every, every[::-1]), wanted[every, every[::-1]], atol=1e-4)
    same = np.flatnonzero(np.diff(cells.group) == 0)
    np.testing.assert_allclose(r.leverage(same, same + 1), wanted[same, same + 1], atol=1e-4)


def test_ratio_of_the_jackknife_by_hand():
    """Observed over expected squares, and Satterthwaite's degrees of freedom, at most one less than the folds."""
    folds = [(np.array([1.0, 2.0]), np.diag([1.0, 2.0])), (np.array([2.0, 0.0]), np.diag([3.0, 1.0]))]
    omitted = [SimpleNamespace(moved=moved, covariance=covariance) for moved, covariance in folds]
    assert variance_ratio(SimpleNamespace(expected=1.0, omitted=omitted * 3)) == pytest.approx((27.0 / 21.0, 5.0))
    large = [SimpleNamespace(moved=np.array([30.0, 0.0]), covariance=np.diag([100.0, 0.0]))]
    ratio = variance_ratio(SimpleNamespace(expected=1.0, omitted=omitted + large))
    assert ratio == pytest.approx((909.0 / 107.0, 107.0**2 / (15.0 + 100.0**2)))
    for expected, folds in ((0.0, omitted), (1.0, large)):
        assert variance_ratio(SimpleNamespace(expected=expected, omitted=folds)) == (1.0, 0.0)


def test_uncertainty_by_estimated_tolerances_by_hand():
    """Each block's share of the squared error by its prior, times 1/√(2n); for a field also 0.3 of the share."""
    covariance, spread, metric = np.array([[0.5, 0.2, 0.1, 0.3], [1.0, 1.0, 0.4, 0.6], [1.0, 2.0, 3.0, 1.0]])
    blocks = [SimpleNamespace(name="pitch", part=slice(0, 3)), SimpleNamespace(name="field rotation", part=slice(3, 5))]
    posterior = some_posterior(np.diag(covariance), spread=spread, determined=np.array([0.5, 0.8, 0.9, 0.5]))
    residuals = SimpleNamespace(
        solution=SimpleNamespace(posterior=posterior), estimation=SimpleNamespace(space=SimpleNamespace(blocks=blocks))
    )
    squares = covariance**2 * metric / spread**2 / (covariance * metric).sum()
    pitch, field = squares[:3].sum(), squares[3]
    wanted = np.sqrt(0.5 * pitch**2 / 2.2 + 0.5 * field**2 + (0.3 * field) ** 2)
    assert _of_priors(residuals, np.diag(metric)) == pytest.approx(wanted)
    assert _of_priors(residuals, np.zeros((4, 4))) == 0.0


def test_what_counts_as_held_by_the_priors():
    """More than half of the priors' 1 µm, and more than the median noise of lengths, if any are read."""
    posterior = SimpleNamespace(spread=np.array([1.0]), noise=np.full(len(KINDS), 2.0))
    residuals = SimpleNamespace(solution=SimpleNamespace(posterior=posterior), metrics=(np.eye(1), np.zeros((1, 1))))
    for left, kind, noise, held in ((0.55, LINEAR, 0.5, True), (0.45, LINEAR, 0.1, False), (0.55, LINEAR, 0.6, False),
                                    (0.55, ROTATION, 0.6, True)):  # fmt: skip
        posterior.covariance = np.array([[left**2]])
        read, stated = SimpleNamespace(kind=np.full(3, kind)), noise * np.array([0.05, 0.5, 15.0])
        residuals.estimation = SimpleNamespace(measurements=read, uncertainty=stated)
        assert held_by_priors(residuals) == held


def test_stated_scale(readings):
    """A laser has 0.5 ppm, and 0.5 mrad, whose half square is 0.125 ppm; 2 ppm and 2 mrad are 2 ppm twice."""
    assert stated_scale(readings, FEW) == pytest.approx(np.hypot(0.5e-6, 0.125e-6), rel=1e-12)
    assert stated_scale(readings, replace(FEW, scale=2e-6, alignment=2e-3)) == pytest.approx(np.sqrt(8.0) * 1e-6)
    for kinds, scale in ((("rotation",), 0.0), (("position", "rotation"), 10e-6), (("position", "length"), 0.5e-6)):
        read = SimpleNamespace(kind=np.array([KINDS.index(kind) for kind in kinds]))
        assert stated_scale(read, replace(FEW, alignment=0.1)) == scale, "the best instrument; no beam"
    for options in ({"alignment": np.nan}, {"scale": -1e-6}, {"tolerances": (("wave5", 1e-6),)}):
        with pytest.raises(ModelError, match=next(iter(options))):
            FitSettings(**options)


def test_readings_without_stated_uncertainty_are_noted(readings):
    blank = replace(readings, uncertainty=np.where(readings.kind == LINEAR, np.nan, readings.uncertainty))
    assert note_on_unstated(blank) == (
        "no uncertainty is stated (linear 1 µm assumed): the expected tool error omits scatter of the machine's stops "
        "below this uncertainty"
    )
    assert note_on_unstated(readings) == note_on_unstated(blank.select(blank.kind == ROTATION)) == ""
