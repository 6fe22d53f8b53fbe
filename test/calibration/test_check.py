"""Check readings against a fitted model, after a change of the machine that the test itself has made.

The readings come from the virtual instruments, which never see the fit. Sizes may differ by four of the standard
deviations that the check states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_helpers import BOX, assert_recorded, blank, campaign, fitted, measured, paper
from helpers import long_test
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from hexapod_comp.calibration.changes import (
    AGEING,
    DATUM,
    FAMILIES,
    STRUT,
    TEMPERATURE,
    Change,
    CheckReadings,
    Evidence,
    consistency,
    payload_changes,
    possible_changes,
    widened,
)
from hexapod_comp.calibration.check import (
    NAMED,
    UNDECIDED,
    UNEXPLAINED,
    VALID,
    Verification,
    refusal,
    update_model,
    update_report,
    verification_json,
    verification_report,
    verify_model,
)
from hexapod_comp.calibration.design import _contrasts, propose_check
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.model import MachineModel, RealMachine, tool_move
from hexapod_comp.measurements.readings import CHANNELS, FORWARD, KINDS, MeasurementSet
from hexapod_comp.measurements.stations import compensated
from hexapod_comp.virtual.instruments import measure

RUNS = ("diagonal 1", "diagonal 2", "diagonal 4", "x line at y 0.0, z 350.0", "y line at x 0.0, z 350.0")


@pytest.fixture(scope="module", autouse=True)
def one_payload() -> Iterator[None]:
    """Compute the changes by a payload once, because they depend on the fit alone if no reading states a load."""
    with pytest.MonkeyPatch.context() as patch:
        found = payload_changes(widened(fitted().known).space)
        patch.setattr("hexapod_comp.calibration.changes.payload_changes", lambda space: found)
        yield


def check(truth: MachineModel, seed: int = 9, places: str = "ends") -> MeasurementSet:
    """Return readings at the ends of three diagonals (linear) and of two lines (linear, pitch, yaw)."""
    whole = measured(RealMachine(paper(), truth), campaign(), seed)
    run, along = np.array([run.name for run in whole.runs])[whole.run], whole.along()
    chosen = np.zeros(len(whole), dtype=bool)
    for name in RUNS:
        there = run == name
        ends = np.isclose(along, along[there].min()) | np.isclose(along, along[there].max())
        chosen |= there & (ends if places == "ends" else np.isclose(along, along[there].min()))
    straight = np.array([CHANNELS[c].startswith("straightness") for c in whole.channel])
    return whole.select(chosen & ~straight & (whole.direction == FORWARD))


def crashed(strut: int, size: float) -> MachineModel:
    """Return the true machine with the offset of one strut changed by a size, m."""
    offset = fitted().truth.struts.offset.copy()
    offset[strut] += size
    return replace(fitted().truth, struts=replace(fitted().truth.struts, offset=offset))


def left(truth: MachineModel, model: MachineModel) -> float:
    """Return the RMS tool error after best-fit alignment, m, that a model leaves at points not measured."""
    return held_out(RealMachine(paper(), truth), model, BOX, 100).aligned.rms


def test_twelve_proposed_readings_name_the_strut() -> None:
    """At least two readings share each zero; straightness readings come in threes, as a slope is unknown as well."""
    straight = propose_check(fitted().known, 6, ("straightness",))
    assert set(straight.kind) == {KINDS.index("straightness")}
    threes = np.unique(np.stack([straight.run, straight.channel], axis=1), axis=0, return_counts=True)[1]
    assert set(threes) == {3}
    same = measure(straight, campaign(), RealMachine(paper(), fitted().truth), 9)
    assert verify_model(fitted().model, fitted().known, same).verdict == VALID
    proposed = propose_check(fitted().known)
    assert len(proposed) == 12
    assert np.isnan(proposed.value).all()
    shared = np.unique(np.stack([proposed.run, proposed.channel], axis=1), axis=0, return_counts=True)[1]
    assert shared.min() >= 2
    readings = measure(proposed, campaign(), RealMachine(paper(), crashed(2, 20e-6)), 9)
    result = verify_model(fitted().model, fitted().known, readings)
    assert (result.verdict, result.candidates[0].family, result.candidates[0].name) == (NAMED, STRUT, "strut_3")
    # The six unknowns of a tracker's frame leave 30 independent values of 36
    assert len(propose_check(fitted().known, 36, ("tracker",))) == 36
    with pytest.raises(CalibrationError, match=r"readings: must be 6…60, not 5"):
        propose_check(fitted().known, 5)
    with pytest.raises(CalibrationError, match=r"instruments: must be .*, not 'ruler'"):
        propose_check(fitted().known, instruments=("ruler",))


def test_contrasts_of_readings_contain_no_zeros_and_no_slopes() -> None:
    """Weights along a line sum to zero, those of straightness also against a slope; their sum of squares is 1."""
    every = blank(campaign(poses=2))
    m = every.select((every.run % 9 == 0) | (every.kind == KINDS.index("position")))
    for rows, members, before in _contrasts(m):
        np.testing.assert_allclose((rows**2).sum(axis=1), 1.0)
        if m.runs[m.run[members[0]]].is_line:
            np.testing.assert_allclose(rows.sum(axis=1), 0.0, atol=1e-12)
            if CHANNELS[m.channel[members[0]]].startswith("straightness"):
                np.testing.assert_allclose(rows @ m.along(), 0.0, atol=1e-12)
            else:
                assert np.count_nonzero(rows) == (2 if before < 0 else 3)


def test_evidence_is_the_ratio_of_two_normal_densities() -> None:
    """The truth is scipy's densities; their logarithms are about 100, with 1e-9 of rounding."""
    rng = np.random.default_rng(1)
    root, effect, z = rng.standard_normal((5, 5)), rng.standard_normal((5, 2)), rng.standard_normal(5)
    covariance = root @ root.T + np.eye(5)
    scales = np.array([0.5, 3.0])
    evidence = Evidence(covariance, iter([(Change(STRUT, "it", scales), effect)]))
    densities = [
        multivariate_normal.logpdf(z, cov=covariance + s**2 * effect @ effect.T)
        - multivariate_normal.logpdf(z, cov=covariance)
        for s in scales
    ]
    found = evidence.log_weights(z[None])[0][0] - evidence.hypotheses[0].log_prior
    np.testing.assert_allclose(found, densities, atol=1e-9)


def test_densities_of_readings_are_those_of_a_normal_distribution() -> None:
    """The truth is scipy's density of the readings after the unknown zero of each channel of a run is projected out."""
    known, readings = widened(fitted().known), check(fitted().truth)
    found = CheckReadings.of(known, readings)
    covariance = found.noise + found.rows @ known.covariance @ found.rows.T
    expected = multivariate_normal.logpdf(found.residuals, cov=covariance)
    assert found.log_density(known.covariance) == pytest.approx(expected, abs=1e-9)
    zeros = np.unique(np.stack([readings.run, readings.channel]), axis=1)[1]
    kinds = [CHANNELS[channel].partition("_")[0] for channel in zeros]
    places = [int((readings.kind == k).sum()) - kinds.count(name) for k, name in enumerate(KINDS)]
    np.testing.assert_allclose(found.freedom, places, atol=1e-9)
    # Changing the values must give the same residuals as new readings with these values.
    anew = CheckReadings.of(known, readings.with_values(-readings.value)).residuals
    np.testing.assert_allclose(found.changed_by(-2.0 * readings.value).residuals, anew, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_the_effect_of_a_payload_is_exact_at_its_most_probable_size(bend: float) -> None:
    """Readings are those of θ = (2, −1), with 1 % of its effect as noise; without a bend nothing changes."""
    slope = np.random.default_rng(3).standard_normal((8, 2))

    def exact(theta: np.ndarray) -> np.ndarray:
        return slope @ theta + bend * theta[0] ** 2 * slope[:, 0] ** 2

    theta, change = np.array([2.0, -1.0]), Change(STRUT, "payload", np.array([1.0, 30.0]))
    check = SimpleNamespace(residuals=exact(theta))
    found = CheckReadings._secant(check, change, slope, 1e-4 * np.eye(8), exact)
    allowed = 1e-9 + 0.05 * np.abs(exact(theta)).max() * (bend > 0.0)
    np.testing.assert_allclose(found @ theta, exact(theta), atol=allowed)
    assert (np.abs(found - slope).max() > 1e-3) == (bend > 0.0)


def test_the_cut_of_outliers_does_not_make_the_noise_smaller() -> None:
    """Clipping a normal variable at 2.5 σ leaves 0.978 of its variance, by the integral of its density."""
    cut = 2.5
    inside = quad(lambda z: z * z * norm.pdf(z), -cut, cut)[0]
    assert consistency(cut) == pytest.approx(inside + 2.0 * cut**2 * norm.sf(cut), rel=1e-9)
    assert consistency(cut) == pytest.approx(0.978, abs=5e-4)


def test_a_moved_datum_moves_the_tool_as_a_rigid_body_does() -> None:
    """The truth is a shift and a turn about the box's centre in closed form; second order is below 1 nm."""
    space = widened(fitted().known).space
    columns = next(c for c in possible_changes(space, ()) if c.family == DATUM).columns
    size = 0.5 * np.linalg.norm(np.ptp(space.work_box, axis=0))
    home = paper().home
    for n in range(6):
        base = 1e-5 * columns[:18, n].reshape(6, 3)
        move = tool_move(paper(), MachineModel("paper", base_deviation=base), home)
        axis = np.eye(3)[n % 3]
        turn = axis * 1e-5 / size if n >= 3 else np.zeros(3)
        shift = axis * 1e-5 if n < 3 else np.cross(turn, home.position - space.work_box.mean(axis=0))
        np.testing.assert_allclose(move, np.concatenate([shift, turn]), atol=1e-9)


@pytest.mark.parametrize(("strut", "size"), [(0, 20e-6), pytest.param(3, -20e-6, marks=long_test)])
def test_a_crashed_strut_is_named_measured_and_repaired(strut: int, size: float) -> None:
    """At home neither model moves the tool: lines do not show where the machine stands."""
    truth = crashed(strut, size)
    readings = check(truth)
    result = verify_model(fitted().model, fitted().known, readings)
    best = result.candidates[0]
    assert (result.verdict, best.family, best.name) == (NAMED, STRUT, f"strut_{strut + 1}")
    assert abs(best.coefficients[0] - size) < 4.0 * best.deviations[0] < 12e-6
    assert not result.doubts
    renewed = update_model(fitted().model, fitted().known, readings, result)
    assert left(truth, fitted().model) > 4.0 * left(truth, renewed.model)
    assert left(truth, renewed.model) < 1.5 * left(fitted().truth, fitted().model)
    again = verify_model(renewed.model, renewed.fitted, check(truth, seed=10))
    assert again.verdict == VALID
    if strut == 0:
        at_the_limit = dict.fromkeys((DATUM, STRUT, TEMPERATURE), 1e-3)  # of what counts as always detected
        assert_recorded("check_of_a_renewed_model", verification_report(replace(again, visible=at_the_limit)))
        assert_recorded("renewed_model", update_report(renewed, "renewed.yaml"))
    assert np.abs(tool_move(paper(), renewed.model, paper().home)).max() < 1e-9
    assert renewed.fitted.held.held == 6


def test_a_strut_changed_by_the_stated_size_is_detected() -> None:
    """The truth is a simulation of 1000 checks by numpy's normal distribution, after a change of the strut that the
    readings show worst; three standard deviations of a share of 99 % are 0.9 %. A change of two thirds of this size
    must be missed more often: the stated size is no bound without use."""
    readings = check(fitted().truth)
    size = verify_model(fitted().model, fitted().known, readings).visible[STRUT]
    wide = widened(fitted().known, readings=readings)
    seen = CheckReadings.of(wide, readings)
    covariance = seen.covariance(wide.covariance)
    changes = possible_changes(wide.space, [block.name for block in fitted().known.space.blocks])
    evidence = Evidence(covariance, seen.effects(changes, wide.covariance))
    effects = [(seen.rows @ c.columns)[:, 0] for c in changes if c.family == STRUT and len(c.shown) == 1]
    worst = min(effects, key=lambda effect: float(effect @ np.linalg.solve(covariance, effect)))
    noise = np.random.default_rng(3).multivariate_normal(np.zeros(len(worst)), covariance, 1000)
    found = [np.mean([evidence.p_value(one + s * worst) <= 0.01 for one in noise]) for s in (size, size / 1.5)]
    assert found[0] > 0.981
    assert found[1] < 0.95


def test_the_tool_error_by_a_worn_screw_is_that_of_the_machine() -> None:
    """The truth is the virtual machine with the old model at 100 points, passed in both directions; 10 % for so few."""
    struts = fitted().truth.struts
    worn = replace(fitted().truth, struts=replace(struts, backlash=struts.backlash + 30e-6 * np.eye(6)[2]))
    result = verify_model(fitted().model, fitted().known, check(worn))
    assert result.candidates[0].name == "backlash of strut_3"
    assert result.tool[1] == pytest.approx(left(worn, fitted().model), rel=0.1)


def test_growth_of_all_struts_is_a_temperature() -> None:
    """40 ppm on every strut, the growth of steel by three kelvin, is named as a temperature."""
    struts = fitted().truth.struts
    grown = replace(struts, offset=struts.offset + 40e-6 * struts.reference_length, pitch=struts.pitch + 40e-6)
    result = verify_model(fitted().model, fitted().known, check(replace(fitted().truth, struts=grown)))
    best = result.candidates[0]
    assert (result.verdict, best.family) == (NAMED, TEMPERATURE)
    if best.name == "struts":
        assert abs(best.coefficients[0] - 40e-6) < 4.0 * best.deviations[0]


def with_one_wrong(number: int) -> Verification:
    """Return the check of an unchanged machine with one reading wrong by 50 µm or 50 µrad."""
    readings = check(fitted().truth)
    value = readings.value.copy()
    value[number] += 50e-6
    return verify_model(fitted().model, fitted().known, readings.with_values(value))


def test_what_readings_cannot_tell_stays_open_and_says_what_would_settle_it() -> None:
    """A wrong reading is named if others contradict it. A wrong pitch at one end of the only line with pitch stays
    undecided: a moved joint explains it as well."""
    named, undecided = with_one_wrong(8), with_one_wrong(1)
    assert (named.verdict, undecided.verdict) == (NAMED, UNDECIDED)
    assert refusal(named).startswith("a single reading is probably wrong: campaign: rotation_z of run y line at x 0.0")
    assert refusal(undecided).startswith("the change is not identified")
    assert_recorded("check_with_a_wrong_reading", verification_report(named))
    # The report's limits: 0.1 % of checks, 0.1 % probability of a kind, odds of a million
    first, second, third = undecided.settling
    odds = (replace(first, odds=np.log(1e6)), replace(second, odds=np.log(9.9e5)), third)
    rare = {**undecided.families, AGEING: 0.001, STRUT: 0.00099}
    assert_recorded(
        "check_that_is_undecided", verification_report(replace(undecided, p_value=1e-3, families=rare, settling=odds))
    )
    assert_recorded("check_that_is_undecided", verification_json(undecided))


def test_readings_of_an_unchanged_machine_taken_for_something_else_are_recognised() -> None:
    """Each mistake made in reading an unchanged machine is named, and stops an update. 1 arcsec is 4.848137 µrad."""
    readings, known = check(fitted().truth), fitted().known
    angular = np.isin(readings.channel, [CHANNELS.index(name) for name in ("rotation_x", "rotation_y", "rotation_z")])

    def multiplied(lengths: float, angles: float) -> MeasurementSet:
        return readings.with_values(readings.value * np.where(angular, angles, lengths))

    mistaken = {
        "rotation: arcsec in place of µrad": multiplied(1.0, 1.0 / 4.848137),
        "linear: µm in place of mm": multiplied(1e3, 1.0),
        "all readings: sign reversed": readings.with_values(-readings.value),
        "taken with the compensation off": compensated(readings, fitted().model),
    }
    # A strut moved by 2 mm, more than any expected change, is not taken for a mistake in reading.
    assert not verify_model(fitted().model, known, check(crashed(1, 2e-3))).doubts
    for name, taken in mistaken.items():
        result = verify_model(fitted().model, known, taken)
        assert result.doubts[0].startswith(name)
        assert verification_report(result).startswith(f"IN DOUBT:\n  {name}")


def test_what_is_in_no_hypothesis_is_not_named() -> None:
    """A platform joint moved by 60 µm across its struts is not named as a strut, the datum or a temperature."""
    moved = fitted().truth.platform_deviation.copy()
    moved[2:4] += [30e-6, -40e-6, 30e-6]
    result = verify_model(fitted().model, fitted().known, check(replace(fitted().truth, platform_deviation=moved)))
    assert result.verdict == UNEXPLAINED
    assert "fit again" in refusal(result)
    assert_recorded("check_without_explanation", verification_report(result))
    assert abs(sum(result.families.values()) - 1.0) < 1e-9
    assert set(result.families) == set(FAMILIES)


def test_readings_that_tell_nothing_are_refused() -> None:
    """With one place per run, the run's unknown zero explains any value."""
    with pytest.raises(CalibrationError, match="determine nothing"):
        verify_model(fitted().model, fitted().known, check(fitted().truth, places="start"))
