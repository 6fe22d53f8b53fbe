"""A calibration does not move the tool at the datum, unless the readings show where the machine stands.

The truth is the foreign machines' own kinematics (:mod:`foreign_machines`), and the effect of a rigid motion of the
whole machine on an instrument, written out by hand.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest
from foreign_machines import Errors, commands, machine_names, machines, rotation

from hexapod_comp.calibration.datum import unseen_part
from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.fit import ModelFit, fit_model
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import ErrorPredictor
from hexapod_comp.calibration.posterior_file import load_posterior, save_with_posterior
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import Datum, RealMachine, tool_move
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.instruments import measure

pytestmark = pytest.mark.usefixtures("unsuspected")  # the search for mix-ups is tested in test_mixed_up
STILL = 1e-9  # largest motion at the datum, m and rad; a model file is rounded to 0.01 nm


@pytest.mark.parametrize("name", machine_names())
def test_switching_compensation_on_does_not_move_the_tool_at_home(name: str, tmp_path: Path) -> None:
    """After a fit to laser lines, the tests' own kinematics of the model give the nominal lengths at home."""
    machine = machines()[name]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    truth = Errors.drawn(machine, 5)
    real = RealMachine(geometry, load_model(truth.write(tmp_path / "truth.yaml", machine), geometry))
    side = float(np.ptp(machine.box, axis=0).min())
    campaign = Campaign(machine.box, side, side / 3.0, "5-D", 4)
    fit = fit_model(measure(template(campaign, geometry), campaign, real, 1), FitSettings(blocks=("pitch",)))
    save_model(fit.model, tmp_path / "model.yaml")
    believed = Errors.read(tmp_path / "model.yaml")
    home = np.array([machine.home]), np.eye(3)[None]
    told, nominal = commands(machine, believed, *home), machine.lengths(*home)
    np.testing.assert_allclose(told, nominal, rtol=0.0, atol=STILL / 10.0)
    by_the_model, _, _ = RealMachine(geometry, fit.model).commands_for(geometry.home)
    np.testing.assert_allclose(by_the_model, nominal[0], rtol=0.0, atol=STILL / 10.0)
    datum = fit.model.origin.datum
    assert datum == replace(Datum(machine.home, (0.0, 0.0, 0.0), 6), position=datum.position)
    assert datum.position == pytest.approx(machine.home)


@cache
def laser_fit() -> ModelFit:
    return fit_model(small.measured(small.virtual_machine(4), small.campaign(), 4), small.FEW)


def projection(readings, tracker_frame: str = "known") -> np.ndarray:
    """Return the projection on motions at home that readings do not show, at a tolerance of 0.1 mm."""
    space = laser_fit().space
    space = ParameterSpace((space.geometry, space.region), replace(space.settings, tracker_frame=tracker_frame))
    estimation = Estimation(readings, space, check_count=False)
    problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(readings)))
    return unseen_part(estimation, problem, 1e-4, np.ones(len(KINDS)), small.paper().home)


def test_a_tracker_is_believed_and_one_pose_of_it_shows_no_more_than_its_place() -> None:
    far = Pose(np.array([0.1, 0.05, 0.45]), np.eye(3))
    poses = [far, Pose(np.array([-0.1, 0.0, 0.4]), np.eye(3)), Pose(np.array([0.0, 0.1, 0.5]), np.eye(3))]
    full = small.scattered(small.paper(), poses)
    positions = full.select(full.kind == KINDS.index("position"))
    assert np.abs(projection(full)).max() == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(projection(full, "free"), np.eye(6), atol=1e-9)
    assert np.abs(projection(positions)).max() == pytest.approx(0.0, abs=1e-12)
    one = positions.select(positions.station == 0)
    part = projection(one)
    assert np.trace(part) == pytest.approx(3.0)
    # Each motion in the projection is a rotation about the one place that was measured.
    moved = part[:3].T + np.cross(part[3:].T, far.position - small.paper().home.position)
    np.testing.assert_allclose(moved, 0.0, atol=1e-10)


def test_another_datum_can_be_given_and_one_out_of_reach_is_refused() -> None:
    pose = Pose(np.array([0.05, -0.04, 0.42]), rotation(3.0, -2.0, 5.0))
    readings = laser_fit().measurements
    model = fit_model(readings, replace(small.FEW, blocks=()), datum=pose).model
    assert np.abs(tool_move(small.paper(), model, pose)).max() < STILL
    assert np.abs(tool_move(small.paper(), model, small.paper().home)).max() > 1e-6
    with pytest.raises(CalibrationError, match="a pose that the machine cannot reach"):
        fit_model(readings, replace(small.FEW, blocks=()), datum=Pose(np.array([0.0, 0.0, 2.0]), np.eye(3)))


def test_holding_the_datum_leaves_the_deviations_as_they_were_but_for_what_it_moved(tmp_path: Path) -> None:
    fit, home = laser_fit(), small.paper().home
    fitted = fit.parameters
    save_with_posterior(fit.model, fitted, tmp_path / "model.yaml")
    model = load_model(tmp_path / "model.yaml", small.paper())
    stored, _ = load_posterior(model, small.paper(), tmp_path / "model.yaml")
    positions = home.position + np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.02]])
    poses = positions, np.tile(np.eye(3), (2, 1, 1))
    machine = RealMachine(small.paper(), model)
    standing, aligned = ErrorPredictor(machine, stored).predict(poses)
    assert np.abs(standing.values[0]).max() < STILL
    unheld = RealMachine(small.paper(), fit.space.model(fit.solution.x))
    free, before = ErrorPredictor(unheld, replace(fitted, held=None)).predict(poses)
    moved = free.values - standing.values
    assert np.abs(moved).max() > 1e-6
    wanted = free.covariance + moved[:, :, None] * moved[:, None, :]
    scale = np.sqrt(np.diagonal(wanted, axis1=1, axis2=2))
    np.testing.assert_allclose((standing.covariance - wanted) / scale[:, :, None] / scale[:, None, :], 0.0, atol=1e-3)
    np.testing.assert_allclose(aligned.deviations, before.deviations, rtol=1e-3)


def test_the_datum_of_a_hanging_machine_has_no_rounding_errors() -> None:
    """α, β, γ = 180°, 0°, 25° are 0°, -180°, -155°; the sine of π leaves 1e-14° of α in a double."""
    hanging = Pose.from_angles([0.0, 0.0, -0.5842], np.radians([180.0, 0.0, 25.0]))
    assert str(Datum.at(hanging, 6)).endswith("platform at 0, 0, -584.2 mm, 0, -180, -155° in base")
