"""Calibration under weight: a stated stiffness predicts the error with other tools; readings at two loads refine it.

The truth is one virtual machine with struts of 18 to 22 N/µm, a platform of 20 kg and a spindle of 10 kg, driven with
tools that were not mounted during the readings.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_helpers import SETTINGS, blank, campaign, joined, paper, tool_error, virtual_machine

from hexapod_comp.calibration import posterior
from hexapod_comp.calibration.blocks.load import refuse_half_stated
from hexapod_comp.calibration.changes import CheckReadings, payload_changes, widened
from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.mistakes import Mistake
from hexapod_comp.calibration.mixups import _Fitted
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import FirstOrder, box_errors, box_stations, expected_error
from hexapod_comp.calibration.posterior_file import load_posterior, save_with_posterior
from hexapod_comp.calibration.sensitivity import derivatives, predict
from hexapod_comp.cli import main
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.load import Load, Loading, Payload
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.measurements.stations import station_errors
from hexapod_comp.measurements.tidy import write_measurements
from hexapod_comp.virtual.instruments import measure

pytestmark = pytest.mark.usefixtures("unsuspected")  # the search for mix-ups is tested in test_mixed_up
SPINDLE, LIGHT = Payload(10.0, (0.01, 0.0, 0.08)), Payload(5.0, (0.0, 0.0, 0.06))
HEAVY = Payload(20.0, (0.01, 0.0, 0.1))
TRUE = Load(stiffness=1e6 * np.array([18.0, 20.0, 22.0, 19.0, 21.0, 20.0]), mass=20.0)
STATED = Load(stiffness=np.full(6, 20e6), mass=20.0)
BLOCKS = ("pitch", "wave", "backlash", "field displacement", "field rotation", "compliance")
BLIND = replace(SETTINGS, blocks=BLOCKS)
TOLD = replace(BLIND, load=STATED.numbers())
DOWN = (0.0, 0.0, -9.80665)


@cache
def truth() -> RealMachine:
    drawn = virtual_machine(3)
    return RealMachine(drawn.geometry, replace(drawn.model, load=TRUE))


def under(payload: Payload, seed: int, gravity: tuple[float, ...] = (np.nan,) * 3) -> MeasurementSet:
    """Return the readings of a 5-D laser on the machine with a payload."""
    plan = campaign()
    laid = blank(plan)
    row = payload.mass, *payload.centre, *gravity
    told = replace(laid, stations=replace(laid.stations, loads=np.tile(row, (len(laid.stations), 1))))
    return measure(told, plan, truth(), seed)


@cache
def fit(settings: FitSettings, two: bool = False) -> ModelFit:
    readings = [under(SPINDLE, 1), under(Payload(), 2)] if two else [under(SPINDLE, 1)]
    return fit_model(joined(readings), settings)


def left(fitted: ModelFit, payload: Payload) -> float:
    """Return the RMS tool error, m, that compensation leaves with a payload that the model is given."""
    geometry = truth().geometry.carrying(payload)
    return tool_error(RealMachine(geometry, truth().model), fitted.model)[0]


def test_a_stated_stiffness_holds_for_tools_that_no_reading_has_seen() -> None:
    """With other tools the error is at most 1.3 times that with the calibrated tool, without a stated stiffness at
    least three times. Readings at one load refine a stiffness, as forces differ from place to place."""
    told, blind = fit(TOLD), fit(BLIND)
    as_calibrated = left(told, SPINDLE)
    for payload in (LIGHT, HEAVY):
        promise = told.under(payload)
        assert left(told, payload) < min(1.3 * as_calibrated, promise.high)
        assert left(blind, payload) > 3.0 * as_calibrated
    block = told.space.block("compliance")
    assert (np.abs(told.model.load.compliance - TRUE.compliance) < 4.0 * told.standard_errors[block.part]).all()
    elsewhere = {"no tool": Payload(), "20 kg": Payload(20.0, (0.005, 0.0, 0.04))}
    promised = [(name, told.under(payload, DOWN)) for name, payload in elsewhere.items()]
    texts = [f"{n} {1e6 * e.after:.2g} µm (95 %: up to {1e6 * e.high:.2g})" for n, e in promised if e is not None]
    said = f"under other loads, if the compensator knows them: {', '.join(texts)}, gravity turned"
    assert any(said in note for note in told.notes)
    assert any("no struts' stiffness is stated" in note for note in blind.notes)


def test_an_expected_error_of_100_um_under_another_load_has_no_exponent(monkeypatch) -> None:
    """Two digits of 100.6 and 152.4 µm by hand."""
    large = SimpleNamespace(after=100.6e-6, high=152.4e-6)
    monkeypatch.setattr(posterior, "expected_error", lambda *_, **__: large)
    told = fit(TOLD)
    note = posterior.about_other_loads(told.space, told.solution.x, told.covariance, posterior.Unexplained())
    assert "no tool 100 µm (95 %: up to 150)" in note


def test_a_fit_promises_for_another_load_what_the_machines_of_its_posterior_err_there() -> None:
    """The truth is forty machines drawn from the posterior, driven with 20 kg; their mean square is known to 10 %."""
    space, x, covariance = fit(TOLD).space, fit(TOLD).solution.x, fit(TOLD).covariance
    load = HEAVY.mass, *HEAVY.centre, *DOWN
    stations, rng, squares = box_stations(space, load=load), np.random.default_rng(1), []
    np.testing.assert_array_equal(stations.loads, np.tile(load, (len(stations), 1)))
    fitted = predict(space, x, stations).errors
    for other in rng.multivariate_normal(x, covariance, 40):
        columns = (predict(space, other, stations).errors - fitted)[..., None]
        aligned = FirstOrder(stations.positions + stations.rotations @ space.probe, columns).aligned()
        squares.append((aligned.values[:, :3] ** 2).sum(axis=1).mean())
    promise = expected_error(box_errors(space, x, load=load), covariance)
    assert np.sqrt(np.mean(squares)) == pytest.approx(promise.after, rel=0.2)
    assert expected_error(box_errors(space, x), covariance).after < promise.after


def test_a_correction_that_changes_nothing_gains_nothing() -> None:
    """Mix-ups of a machine with lost motion: equal readings have equal probabilities, up to rounding."""
    loose = Load(stiffness=np.full(6, 20e6), mass=2.0, lost_motion=np.full(6, 4e-6), take_up=60.0)
    m = under(Payload(), 1)
    space = ParameterSpace(m, replace(SETTINGS, blocks=("pitch", "wave", "backlash"), load=loose.numbers()))
    file = _Fitted(Estimation(m, space, check_count=False))
    same = Mistake("nothing", lambda: replace(m, channel=m.channel.copy()))  # as if channels were exchanged
    for mistake, problem in file._corrected_problems([same]):
        assert abs(file._compared(mistake, problem, file.components).gain) < 1e-6


def test_readings_at_two_loads_refine_the_stiffness() -> None:
    """Six compliances, stated to ±10 %, come nearer to the true ones in the mean, and within their standard errors."""
    fitted = fit(TOLD, two=True)
    block = fitted.space.block("compliance")
    off = fitted.model.load.compliance - TRUE.compliance
    assert np.abs(off).mean() < 0.75 * np.abs(STATED.compliance - TRUE.compliance).mean()
    assert (np.abs(off) < 4.0 * fitted.standard_errors[block.part]).all()
    assert left(fitted, HEAVY) < 1.3 * left(fitted, SPINDLE)
    note = next(note for note in fitted.notes if note.startswith("the readings were taken with tools of 0 to 10 kg"))
    assert " knows them: 20 kg " in note, "the tools of the readings are no other loads"


@pytest.mark.parametrize("axes", [None, np.roll(np.eye(3), 1, 0)[[0, 1, 0, 1, 0, 1]]], ids=["ball", "cardan"])
def test_the_blocks_of_load_have_the_slopes_that_the_core_has(axes: np.ndarray | None) -> None:
    """The truth is finite differences of the core's prediction, with tilted gravity and a payload off the middle.

    A lost motion is taken up within 30 N, so many readings are on its slope, and few at its ends.
    """
    readings = joined([under(SPINDLE, 1), under(HEAVY, 2, (1.0, -2.0, -9.5))])
    readings = replace(readings, geometry=replace(readings.geometry, base_axes=axes))
    stated = replace(TRUE, friction=np.full(6, 0.5), lost_motion=np.full(6, 4e-6), take_up=30.0)
    told = replace(TOLD, load=stated.numbers(), blocks=("compliance", "lost motion", "friction"))
    space, stations = ParameterSpace(readings, told), readings.stations
    x = np.zeros(space.size)
    rows = derivatives(space, predict(space, x, stations), stations)
    for name, step in (("compliance", 1e-9), ("lost motion", 1e-7), ("friction", 1e-3)):
        block = space.block(name)
        size = np.abs(rows[:, :, block.part]).max()
        for n in range(block.part.start, block.part.stop):
            h = step * (np.arange(space.size) == n)
            slopes = (predict(space, x + h, stations).errors - predict(space, x - h, stations).errors) / (2.0 * step)
            np.testing.assert_allclose(rows[:, :, n], slopes, rtol=2e-3, atol=2e-3 * size, err_msg=name)
    prior, c = space.block("compliance"), stated.compliance  # 10 % of each compliance, correlated by 0.75
    wanted = 0.01 * np.outer(c, c) * (0.75 + 0.25 * np.eye(6))
    np.testing.assert_allclose(prior.tolerance**2 * prior.root @ prior.root.T, wanted)


def test_the_model_says_for_which_loads_and_the_compensator_warns_outside(tmp_path: Path) -> None:
    fitted = fit(TOLD, two=True)
    assert fitted.model.origin.loads == ((0, 0, 0, 0, 0, 0, -9.807), (10, 0.01, 0, 0.08, 0, 0, -9.807))
    save_with_posterior(fitted.model, fitted.parameters, tmp_path / "model.yaml")
    geometry = truth().geometry
    model = load_model(tmp_path / "model.yaml", geometry)
    assert model.origin.loads == fitted.model.origin.loads
    known, why = load_posterior(model, geometry, tmp_path / "model.yaml")
    assert known is not None, why
    np.testing.assert_array_equal(known.space.model(known.x).load.mass, 20.0)
    assert Compensator(geometry.carrying(SPINDLE), model).outside_load == ""
    heavy = Compensator(geometry.carrying(HEAVY), model)
    assert heavy.outside_load == "the tool weighs 20 kg, but the model was measured with tools of 0…10 kg"
    heavy.set_load(Loading.of([0.0, 9.8 * np.sin(0.5), -9.8 * np.cos(0.5)]))
    assert heavy.outside_load.endswith("; gravity is 29° from the nearest measured direction, allowed at most 5°")


@pytest.mark.parametrize("gravity", [(np.nan,) * 3, (9.0, 3.9, 0.0)], ids=["of the load file", "of the readings"])
def test_a_payload_moves_the_tool_as_the_core_says(gravity: tuple[float, ...]) -> None:
    """The parameters that represent 3 kg more at the tool's centre of mass move the tool at the readings' poses as the
    core does with 3 kg more."""
    readings = under(SPINDLE, 1, gravity)
    space = widened(fit(TOLD).parameters, readings=readings).space
    heavier = replace(readings.stations, loads=readings.stations.loads + np.eye(7)[0] * 3.0)
    x = np.zeros(space.size)
    prediction = predict(space, x, readings.stations)
    moved = predict(space, x, heavier).errors - prediction.errors
    mass, change = payload_changes(space)
    radius, at = space.geometry.characteristic_length, f"{STATED.stiffness[0] * 1e-6:g} N/µm"
    at, moment = f"kg at {at}", f"kg m at {at}"
    assert change.shown == (("mass", 1.0, at), ("moment 1", radius, moment), ("moment 2", radius, moment))
    slopes, wanted = derivatives(space, prediction, readings.stations), moved.reshape(-1)
    for columns in (mass.columns, change.columns):
        design = (slopes @ columns).reshape(-1, columns.shape[1])
        theta = np.linalg.lstsq(design, wanted, rcond=None)[0]
        assert theta[0] == pytest.approx(3.0, rel=0.05)
        assert np.linalg.norm(design @ theta - wanted) < 0.12 * np.linalg.norm(wanted), "at the corners of the box"


def test_fit_takes_the_stated_load_by_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_measurements(under(SPINDLE, 1), tmp_path / "one.csv")
    (tmp_path / "load.yaml").write_text("format: hexapod_comp/load\nversion: 1\nstiffness_N_per_um: 20\nmass_kg: 20\n")
    words = ["fit", tmp_path / "one.csv", "--load", tmp_path / "load.yaml", "--out", tmp_path / "model.yaml"]
    short = "--lead-mm", "10", "--blocks", "pitch,wave,backlash,compliance"
    assert main([*map(str, words), *short]) == 0
    assert "the readings were taken with a tool of 10 kg and one direction of gravity" in capsys.readouterr().out
    assert load_model(tmp_path / "model.yaml", truth().geometry).load.mass == 20.0
    (tmp_path / "load.yaml").write_text("format: hexapod_comp/load\nversion: 1\nstiffness_N_per_mm: 20\nmass_kg: 20\n")
    assert main(list(map(str, words))) == 2
    assert "stiffness_N_per_mm: must be 0, which means rigid, or at least 0.1 N/µm" in capsys.readouterr().err


def test_readings_of_which_half_state_a_payload_are_refused() -> None:
    half = joined([under(SPINDLE, 1), replace(under(Payload(), 2), stations=blank(campaign()).stations)])
    with pytest.raises(CalibrationError, match="no payload_kg, but other readings state a payload, and the geometry"):
        fit_model(half, TOLD)
    refuse_half_stated(replace(half, geometry=paper().carrying(LIGHT)))
    refuse_half_stated(under(SPINDLE, 1))


def test_lost_motion_and_friction_are_fitted_where_forces_change_their_sign() -> None:
    """The truth is six clearances and frictions. Struts pull at the sides of the box that push in its middle.

    Without these blocks the fit explains them by a field.
    """
    clearance, friction = 1e-6 * np.array([3.0, 5.0, 2.0, 6.0, 4.0, 1.0]), np.array([0.4, 1.0, 0.6, 0.8, 0.3, 0.7])
    loose = RealMachine(paper(), replace(truth().model, load=replace(TRUE, lost_motion=clearance, friction=friction)))
    plan, laid = campaign(), under(SPINDLE, 1)
    readings = measure(laid, plan, loose, 4)
    told = replace(TOLD, blocks=(*BLOCKS, "lost motion", "friction"))
    fitted, without = fit_model(readings, told), fit_model(readings, replace(told, blocks=BLOCKS))
    for name, error, most in (
        ("lost motion", fitted.model.load.lost_motion - clearance, 1e-6),
        ("friction", fitted.model.load.friction - friction, 0.5),
    ):
        block = fitted.space.block(name)
        assert (np.abs(error) < 4.0 * fitted.standard_errors[block.part]).all()
        assert np.abs(error).max() < most
    carrying = RealMachine(loose.geometry.carrying(SPINDLE), loose.model)
    assert tool_error(carrying, fitted.model)[0] < 0.5 * tool_error(carrying, without.model)[0]
    high = Campaign(np.array([[-0.05, -0.05, 0.45], [0.05, 0.05, 0.55]]), 0.1, 0.05)
    still = replace(laid, stations=replace(laid.stations, sense=0.0 * laid.stations.sense))
    rigid = replace(told, load=replace(STATED, stiffness=np.zeros(6)).numbers())
    for settings, read, hidden in (
        (told, readings, set()),
        (told, template(high, paper()), {"lost motion"}),
        (told, still, {"friction"}),
        (rigid, readings, {"compliance", "friction"}),
        (replace(told, load=()), readings, {"compliance", "lost motion", "friction"}),
    ):
        fitted_blocks = {block.name for block in ParameterSpace(read, settings).blocks}
        assert {"compliance", "lost motion", "friction"} - fitted_blocks == hidden

    # The same machine with a take-up of 1 mN: its clearances are at their ends where the model is between them. A
    # check must not call it changed; without the clearances' variance χ² is 5 per number.
    lost_motion = fitted.space.block("lost motion")
    known, x = fitted.parameters, fitted.solution.x.copy()
    x[lost_motion.part] = 20e-6
    wide = widened(replace(known, x=x))
    model = wide.space.model(wide.x)
    at_once = RealMachine(paper(), replace(model, load=replace(model.load, take_up=1e-3)))
    away = station_errors(laid, at_once) - station_errors(laid, RealMachine(paper(), model))
    near = np.flatnonzero(np.linalg.norm(away[:, :3], axis=1) > 1e-6)
    checked = laid.select(np.isin(laid.station, near) | (np.arange(len(laid)) % 20 == 0))
    check = CheckReadings.of(wide, measure(checked, plan, at_once, 5))
    assert len(near) >= 5
    there = FirstOrder.of(wide.space, predict(wide.space, wide.x, laid.stations), laid.stations)
    size = np.sqrt((away[:, :3] ** 2).sum(axis=1).mean())
    assert size < there.unsettled[0] < 2.0 * size, "√2 more, if the force's sign were known: the mean of (1 − |t|)²"
    estimation, ones = Estimation(laid, wide.space), np.ones(len(laid))
    weighed, all_alike = (estimation.linearise(wide.x, ones, unsettled)[0].scale for unsettled in (True, False))
    at_its_end = np.isin(estimation.means.station, near)
    assert (weighed[at_its_end] < 0.3 * all_alike[at_its_end]).mean() > 0.6, "the fit hardly counts what they move"
    assert (weighed == all_alike).mean() > 0.7
    assert check.chi_square(wide.covariance) < 1.0 + 4.0 * np.sqrt(2.0 / len(check.residuals))
