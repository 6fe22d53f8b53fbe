"""Ball bars, stations, spheres, R-tests and squares: what their nuisance parameters explain, and fits to their
readings.

The truth is distances between points that the tests choose; machines and kinematics are of :mod:`foreign_machines`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import calibration_helpers as small
import foreign_machines
import numpy as np
import pytest
from calibration_helpers import FEW, virtual_machine
from foreign_machines import Errors, Machine, aligned_rms, goes_to, rotation, tool_errors
from helpers import long_test
from scipy.spatial.transform import Rotation

from hexapod_comp.calibration.estimator import Estimation
from hexapod_comp.calibration.fit import fit_model, unseen_errors
from hexapod_comp.calibration.observations import Distances, MeanReadings
from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import save_model
from hexapod_comp.measurements.campaign import Campaign, circle_run, line_run, template
from hexapod_comp.measurements.readings import AXES, CHANNELS, KINDS, LENGTH, UNKNOWN, MeasurementSet, Reading
from hexapod_comp.measurements.runs import assemble
from hexapod_comp.pose import Pose

pytestmark = pytest.mark.usefixtures("unsuspected")
UM, MM = 1e-6, 1e-3


def ball(points: int, radius: float, centre: np.ndarray) -> np.ndarray:
    """Return random points on a sphere."""
    n = np.random.default_rng(1).standard_normal((points, 3))
    return centre + radius * n / np.linalg.norm(n, axis=1)[:, None]


def left_of(lengths: Distances, displacement: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the residuals of lengths, m, after their nuisance parameters are projected out."""
    scale = np.full(len(value), 1.0 / UM)
    expected, _, unknowns = lengths.linearise(displacement, value, scale)
    left = scale * (value - expected)
    for unknown in unknowns:
        left[unknown.members] -= unknown.explained(left)
    return left / scale


@pytest.mark.parametrize("known", [False, True])
def test_a_centre_millimetres_off_explains_all_of_its_lengths(known: bool) -> None:
    """A centre 3 mm off explains the lengths of a bar of 100 mm. Second order is 45 µm; the centre's prior of 5 mm adds
    at most 1 µm² / (5 mm)² of 3 mm, 0.001 µm."""
    centre, off = np.array([0.1, -0.2, 0.5]), np.array([2.0, -1.0, 2.0]) * MM
    points, moved = ball(40, 0.1, centre), 50.0 * UM * np.random.default_rng(2).standard_normal((40, 3))
    read = np.linalg.norm(points + moved - centre - off, axis=1) + (0.0 if known else 17.0 * MM)
    lengths = Distances("bar", np.arange(40), points, np.tile(centre, (40, 1)), known)
    assert np.abs(left_of(lengths, moved, read - 0.1)).max() < 1e-9
    assert lengths.count == (3 if known else 4)


def test_the_balls_of_a_plate_move_together() -> None:
    """A plate turned by 5 mrad and shifted by millimetres explains its lengths; one ball that moved alone does not."""
    balls = np.array([[0.0, 0.0, 0.4], [0.1, 0.0, 0.4], [0.0, 0.1, 0.42]])
    points = np.vstack([ball(15, 0.02, centre) for centre in balls])
    of_each = np.repeat(balls, 15, axis=0)
    turned = Rotation.from_rotvec([3e-3, -4e-3, 2e-3]).apply(of_each) + np.array([1.0, 2.0, -1.0]) * MM
    lengths = Distances("plate", np.arange(45), points, of_each, False)
    still = np.zeros((45, 3))
    assert np.abs(left_of(lengths, still, np.linalg.norm(points - turned, axis=1) - 0.02)).max() < 1e-8
    assert lengths.count == 7
    turned[30:] += [0.0, 0.0, 20.0 * UM]
    assert np.abs(left_of(lengths, still, np.linalg.norm(points - turned, axis=1) - 0.02)).max() > 1.0 * UM


def test_a_centre_at_another_place_is_refused() -> None:
    centre = np.array([0.0, 0.0, 0.5])
    points = ball(30, 0.2, centre)
    lengths = Distances("bar 3", np.arange(30), points, np.tile(centre, (30, 1)), False)
    left_of(lengths, np.zeros((30, 3)), np.linalg.norm(points - centre - [0.0, 0.0249, 0.0], axis=1) - 0.2)
    read = np.linalg.norm(points - centre - [0.0251, 0.0, 0.0], axis=1)
    with pytest.raises(
        CalibrationError, match=r"^centre: .* run bar 3 place the centre 25\.1, 0\.0, 0\.0 mm .* at most 25 mm is"
    ):
        left_of(lengths, np.zeros((30, 3)), read - 0.2)


def lengths_from(machine: Machine, name: str, tips: np.ndarray, tools: np.ndarray, centre: np.ndarray) -> list[Reading]:
    """Return a run of lengths, with values of zero, from a centre in the work frame."""
    at = tuple(centre.round(9).tolist())
    poses = [Pose(*pose) for pose in zip(tips.round(9), tools, strict=True)]
    return [Reading(name, 1, UNKNOWN, pose, "length", 0.0, UM, centre=at) for pose in poses]


def planned(machine: Machine, what: str) -> list[Reading]:
    """Return lengths from four stations, or circles and R-tests, with tools up to 6° off level."""
    rng, half = np.random.default_rng(5), np.array(machine.half)
    tools = np.stack([rotation(*rng.uniform(-6.0, 6.0, 3)) for _ in range(45)])
    if what == "stations":
        tips = machine.middle + rng.uniform(-1.0, 1.0, (45, 3)) * half
        corners = np.array([[1, 1, 1], [-1, 1, -1], [-1, -1, 1], [1, -1, -1]])
        places = [machine.middle + 4.0 * corner * half for corner in corners]
        return [r for n, place in enumerate(places) for r in lengths_from(machine, f"station {n}", tips, tools, place)]
    readings, radius = [], half.min()
    for n, place in enumerate(machine.middle + np.array([[0.3, 0, 0], [-0.3, 0.3, 0], [0, -0.3, 0]]) * half):
        for plane, axes in (("xy", [0, 1]), ("yz", [1, 2]), ("zx", [2, 0])):
            run = circle_run(f"{n} {plane}", place.round(9), radius, 25, np.eye(3)[axes], np.eye(3))
            readings += lengths_from(machine, run.name, run.positions[:-1], run.rotations[:-1], place)
    for n, place in enumerate(machine.middle + np.array([[1, 1, 1], [-1, 1, -1], [0, -1, 0]]) * 0.6 * half):
        for tool in tools[:20]:
            pose = Pose(place.round(9), tool)
            readings += [Reading(f"R {n}", 1, UNKNOWN, pose, f"displacement_{a}", 0.0, UM) for a in AXES]
    return readings


def measured(machine: Machine, truth: Errors, path: Path, what: str) -> MeasurementSet:
    """Return readings with 0.5 µm of noise, and centres 0.2 mm off, of a machine commanded with nominal lengths."""
    m = assemble(load_geometry(machine.write(path)), planned(machine, what))
    rng = np.random.default_rng(8)
    poses = m.stations.positions, m.stations.rotations
    error = (machine.tips(*goes_to(machine, truth, machine.lengths(*poses), *poses)) - machine.tips(*poses))[m.station]
    tips = machine.tips(*poses)[m.station]
    centres = (m.centre - machine.work.position) @ machine.work.matrix
    off = 0.2 * MM * rng.standard_normal((len(m.runs), 3))[m.run]
    change = np.linalg.norm(tips + error - centres - off, axis=1) - np.linalg.norm(tips - centres, axis=1)
    axis = np.maximum(m.channel - LENGTH - 1, 0)
    value = np.where(m.channel == LENGTH, change, np.take_along_axis(error, axis[:, None], 1)[:, 0])
    zeros = MM * rng.standard_normal((len(m.runs), 4))[m.run, m.channel - LENGTH]
    return m.with_values(value + zeros + 0.5 * UM * rng.standard_normal(len(value)))


@pytest.mark.parametrize("what", ["stations", "circles and R-tests"])
@pytest.mark.parametrize("name", foreign_machines.machine_names())
def test_instruments_mend_machines_of_all_kinds(name: str, what: str, tmp_path: Path) -> None:
    """Errors of 50 µm, readings of 0.5 µm, tips not measured. Circles of about the same size do not show the machine's
    size; most of their residual error is this size."""
    machine = foreign_machines.machines()[name]
    truth = Errors.drawn(machine, 3)
    readings = measured(machine, truth, tmp_path / "machine.yaml", what)
    fit = fit_model(readings, FitSettings(blocks=("pitch",)))  # the only errors of these machines beside structure
    save_model(fit.model, tmp_path / "model.yaml")
    tips = machine.middle + np.random.default_rng(9).uniform(-0.8, 0.8, (100, 3)) * np.array(machine.half)
    error = partial(tool_errors, machine, truth)
    before = aligned_rms(tips, error(None, tips))
    after = aligned_rms(tips, error(Errors.read(tmp_path / "model.yaml"), tips))
    assert after < 0.25 * before  # 45 poses, for speed; benchmarks.calibration evaluates whole campaigns
    assert all(0.7 < c.chi_square < 1.3 or c.stated == UM for c in fit.channels)


def test_folds_are_circles_and_single_poses() -> None:
    """Nine circles; R-tests of 3 · 20 poses, where each pose is one place; lengths from four stations to 45 poses."""
    machine = foreign_machines.machines()["paper"]
    for what, folds in (("circles", 9 + 3 * 20), ("stations", 45)):
        cells = MeanReadings.of(assemble(small.paper(), planned(machine, what)))
        assert len(np.unique(cells.fold)) == folds


def test_what_circles_and_lengths_cannot_see() -> None:
    """Circles of one unknown radius do not show the machine's size; lengths with a known zero do."""
    machine = foreign_machines.machines()["paper"]
    readings = [r for r in planned(machine, "circles") if r.channel == "length"]
    seen = {}
    for known in (False, True):
        chosen = [reading._replace(known_zero=known) for reading in readings]
        measured = assemble(small.paper(), chosen)
        space, problem = small.linearised(measured, FitSettings())
        seen[known] = {error.name for error in unseen_errors(Estimation(measured, space), problem)}
    assert "size" in seen[False]
    assert "size" not in seen[True]
    assert {"roll of x", "roll of y", "roll of z"} <= set(seen[True])


def in_frame(m: MeasurementSet, shift: np.ndarray, turn: Rotation) -> MeasurementSet:
    """Return a tracker's poses in a frame that is shifted by d and rotated by R: p′ = Rᵀ·(p − d), A′ = Rᵀ·A."""
    work, points = m.geometry.work.rotation, m.points()
    read = np.zeros((len(m.stations), 6))
    place = m.channel - CHANNELS.index("position_x")  # columns: position x, y, z, attitude x, y, z
    read[m.station, place] = m.value
    actual = points + read[:, :3] @ work.T
    attitude = turn.inv() * Rotation.from_rotvec(read[:, 3:] @ work.T)
    shown = np.hstack([(turn.inv().apply(actual - shift) - points) @ work, attitude.as_rotvec() @ work])
    return m.with_values(shown[m.station, place])


@pytest.mark.parametrize("attitudes", [pytest.param(True, marks=long_test), False])
def test_a_trackers_frame_may_stand_anywhere(attitudes: bool) -> None:
    """Estimating the frame leaves at most 15 % more than knowing it: its six unknowns, of 480 or 240 numbers, cost
    1 % if they affected all directions alike."""
    truth = small.virtual_machine(3)
    poses = small.measured(truth, small.campaign(None, 0, poses=80, tilt=0.14), 3)
    poses = poses if attitudes else poses.select(poses.kind == KINDS.index("position"))

    def left(m: MeasurementSet, **options: str) -> float:
        fit = fit_model(m, FitSettings(lead=small.LEAD, blocks=FEW.blocks, **options))
        assert fit.held.held == (0 if options else 6)
        return small.tool_error(truth, fit.model)[0]

    known, right = left(poses, tracker_frame="known"), left(poses)
    assert right < 1.15 * known
    for shift, turn in ((0.5 * MM, 1e-3), (4.0, 2.7)):
        turned = Rotation.from_rotvec(turn * np.array([1.0, -0.5, 0.3]))
        assert left(in_frame(poses, shift * np.array([1.0, -0.6, 0.4]), turned)) == pytest.approx(right, rel=0.02)


def test_the_uncertainty_of_a_coordinate_turns_with_the_trackers_frame() -> None:
    """A frame turned by 90° about z has its x along the work frame's y, and its −y along x; 1 % for the machine's
    errors, which turn the best-fit frame by 0.1 mrad."""
    poses = small.measured(small.virtual_machine(3), small.campaign(None, 0, poses=12), 3)
    poses = poses.select(poses.kind == KINDS.index("position"))
    axis = poses.channel - CHANNELS.index("position_x")
    turned = in_frame(poses, np.zeros(3), Rotation.from_rotvec([0.0, 0.0, np.pi / 2.0]))
    turned = replace(turned, uncertainty=np.array([2.0, 5.0, 11.0])[axis] * UM)
    seen = Estimation(turned, ParameterSpace(turned, FEW), check_count=False).uncertainty
    assert seen == pytest.approx(np.array([5.0, 2.0, 11.0])[axis] * UM, rel=0.01)


SQUARE_BOX = np.array([[-0.1, -0.1, 0.4], [0.1, 0.1, 0.5]])
ENDS = {"x": [[-0.1, 0.0, 0.45], [0.1, 0.0, 0.45]], "y": [[0.0, -0.1, 0.45], [0.0, 0.1, 0.45]]}


def faces(slope: str) -> Campaign:
    """Return straightness along x and y, read with one square (`slope`: its name) or with separate slopes ("")."""
    runs = [line_run(f"face {a}", "straightness", np.array(ends), 9, np.eye(3)) for a, ends in ENDS.items()]
    for run in runs:
        object.__setattr__(run, "slope", slope)
    return Campaign(SQUARE_BOX, 0.1, 0.05, None, 0, runs=tuple(runs), noise=(0.0,) * 7)


def left_beside(m: MeasurementSet, values: np.ndarray) -> float:
    """Return the largest residual of a straightness, m, after the nuisance parameters are projected out."""
    estimation = Estimation(m, ParameterSpace(m, FEW), check_count=False)
    cells = estimation.means
    mean = np.bincount(cells.of_reading, values) / np.bincount(cells.of_reading)
    problem, _ = estimation.linearise(np.zeros(estimation.space.size), np.ones(len(m)))
    left = problem.free_of_nuisance(mean[:, None])[:, 0] / np.sqrt(np.bincount(cells.of_reading))
    return 1e-6 * float(np.abs(left).max())


@pytest.mark.parametrize(("slope", "seen"), [("square", True), ("", False)])
def test_squareness_shows_where_two_faces_share_a_slope(slope, seen):
    """A square turned by 1 mrad adds x to dy and −y to dx, and leaves nothing. Axes 1 mrad off square add +x and +y:
    the square explains half of it on each face, ±0.1 mm is left at the ends."""
    m = template(faces(slope), virtual_machine(3).geometry)
    point = m.points()[m.station]
    dx, dy = (m.directions()[:, a] * 1e-3 for a in (0, 1))
    assert left_beside(m, dy * point[:, 0] - dx * point[:, 1]) < 1e-12
    assert left_beside(m, dy * point[:, 0] + dx * point[:, 1]) == pytest.approx(1e-4 if seen else 0.0, abs=1e-12)
