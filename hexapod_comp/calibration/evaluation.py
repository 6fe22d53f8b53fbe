"""What a model is worth: the virtual machine told what the model says, seen where nothing was fitted.

Two measures. The honest one is the error vector of the tool in space at random points of the workspace,
passed in random directions. The paper's own (001) is the mean absolute displacement error along lines
parallel to the grid, which is all that a linear laser sees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .. import kernels
from ..errors import ModelError, NotConvergedError
from ..field import CROSS_AXES
from ..geometry import HexapodGeometry
from ..kinematics import Structure, forward_error, strut_lengths_batch
from ..machine import MachineModel, RealMachine, Temperatures
from ..machine_kernels import command_one
from ..motion import FOLLOWED
from ..pose import rotation_from_angles

INCH = 0.0254

LEAST_SPEED = 1e-9
"""Below this share of the travel an axis or a strut stands still (as in :mod:`..measurement`)."""

BOTH_WAYS = (1.0, -1.0)
"""Forward, backward."""


@dataclass(frozen=True)
class Passes:
    """Platform poses that a machine is sent through, each in a direction; what a run of it starts from.

    Attributes
    ----------
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        Commanded ``pose_platform_in_base``, m.
    directions : ndarray, shape (N, 3)
        Directions of travel in ``base``; length does not matter.
    """

    positions: np.ndarray
    rotations: np.ndarray
    directions: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    @staticmethod
    def of_tool(
        geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, directions: np.ndarray
    ) -> Passes:
        """Return the passes that bring the tool to poses in the work frame.

        Parameters
        ----------
        geometry : HexapodGeometry
            With its tool and work frames.
        positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
            ``pose_tool_in_work``, m.
        directions : ndarray, shape (N, 3)
            Directions of travel in the work frame.
        """
        work, tool = geometry.work, geometry.tool
        platform = work.rotation @ rotations @ tool.rotation.T
        tips = work.position + positions @ work.rotation.T
        return Passes(tips - platform @ tool.position, platform, directions @ work.rotation.T)

    def points(self, probe: np.ndarray) -> np.ndarray:
        """Return where a point of ``platform``, shape (3,), is told to be, shape (N, 3), m in ``base``."""
        return self.positions + self.rotations @ probe

    def senses(self, geometry: HexapodGeometry) -> np.ndarray:
        """Return the directions of motion of axes and struts, shape (N, 9), each −1, 0 or 1.

        All passes at once what :func:`hexapod_comp.measurement.senses` says of one.
        """
        struts = self.positions[:, None] + geometry.platform_joints @ np.swapaxes(self.rotations, 1, 2)
        struts -= geometry.base_joints
        struts /= np.linalg.norm(struts, axis=2, keepdims=True)
        speeds = np.einsum("nij,nj->ni", struts, self.directions)
        moving = np.concatenate([self.directions, speeds], axis=1)
        return np.sign(moving) * (np.abs(moving) > LEAST_SPEED)


def run(
    truth: RealMachine, passes: Passes, model: MachineModel | None, sensed: Temperatures | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return where the machine really goes, positions (N, 3), m, and rotations (N, 3, 3) in ``base``.

    Parameters
    ----------
    truth : RealMachine
        The hidden truth, at its real temperatures.
    passes : Passes
        What it is told.
    model : MachineModel or None
        What the compensator believes; None: it is told nominal lengths.
    sensed : Temperatures, optional
        What the compensator believes the temperatures to be; 20 °C by default.

    Raises
    ------
    ModelError
        The model is another machine's.
    NotConvergedError
        The model's field is no small correction.
    KinematicsError
        As :func:`hexapod_comp.kinematics.solve_pose`.
    """
    senses = passes.senses(truth.geometry)
    if model is None:
        commands = strut_lengths_batch(Structure.of(truth.geometry), passes.positions, passes.rotations)
    else:
        commands = _commands(RealMachine(truth.geometry, model, sensed), passes, senses)
    positions, rotations = np.empty((len(passes), 3)), np.empty((len(passes), 3, 3))
    for n in range(len(passes)):
        guess = passes.positions[n].copy(), passes.rotations[n].copy()
        outcome, _, condition, _ = truth.forward(commands[n], senses[n], *guess, positions[n], rotations[n])
        if outcome != kernels.OK:
            raise forward_error(outcome, condition, truth.structure.max_condition)
    return positions, rotations


def _commands(believed: RealMachine, passes: Passes, senses: np.ndarray) -> np.ndarray:
    """Return the strut commands of a model for some passes, shape (N, 6), m.

    :meth:`RealMachine.commands_for` without its objects: a study asks for millions.
    """
    commands = np.empty((len(passes), 6))
    low, sense = np.empty(FOLLOWED), np.empty(FOLLOWED)
    position, rotation = np.empty(3), np.empty((3, 3))
    arrays = believed.body, believed.strut_arrays, believed.field_arrays
    for n in range(len(passes)):
        low[:], sense[:] = np.nan, senses[n]  # no window yet: the direction is the one given
        at = np.ascontiguousarray(passes.positions[n]), np.ascontiguousarray(passes.rotations[n])
        solved, _ = command_one(*at, believed.thresholds, low, sense, *arrays, position, rotation, commands[n])
        if not solved:
            raise NotConvergedError("the error field is too steep to be undone at this pose")
    return commands


@dataclass(frozen=True)
class HeldOut:
    """Error of the tool at points that nothing was fitted to, both ways through each.

    Attributes
    ----------
    points : int
        How many.
    raw_rms : float
        RMS length of the error vector, m.
    aligned_rms, aligned_max : float
        RMS and largest length after the datum has been aligned: one rotation and one shift for everything.
    rotation_rms : float
        RMS angle of the platform's rotation error after the common rotation has been taken out, rad.
    """

    points: int
    raw_rms: float
    aligned_rms: float
    aligned_max: float
    rotation_rms: float


def held_out(
    truth: RealMachine,
    model: MachineModel | None,
    box: np.ndarray,
    points: int = 1000,
    seed: int = 0,
    repeatability: float = 0.0,
    tilt: float = 0.0,
    sensed: Temperatures | None = None,
) -> HeldOut:
    """Return the error of the tool at random points of a box, passed there and back in random directions.

    Parameters
    ----------
    truth : RealMachine
        The hidden truth.
    model : MachineModel or None
        What the compensator believes; None for the machine as it is.
    box : ndarray, shape (2, 3)
        Lowest and highest position of the tool in the work frame, m.
    points : int
        How many, at least three: fewer do not tell a rotation.
    seed : int
        Picks points, directions and tilts; equal seeds give equal passes, whatever the model.
    repeatability : float
        Standard deviation, along each axis, of where the machine really stops, m.
    tilt : float
        Largest tilt of the tool about x and y, rad.
    sensed : Temperatures, optional
        What the compensator believes the temperatures to be; 20 °C by default.

    Raises
    ------
    ModelError
        Fewer than three points, or as :func:`run`.
    """
    if points < 3:
        raise ModelError("points", "must be at least three", points)
    rng = np.random.default_rng(seed)
    passes = random_passes(truth.geometry, box, points, tilt, rng)
    positions, rotations = run(truth, passes, model, sensed)
    tool = truth.geometry.tool.position
    actual = positions + rotations @ tool + repeatability * rng.standard_normal(positions.shape)
    wanted = passes.points(tool)
    left = _length(align(actual, wanted) - wanted)
    turned = Rotation.from_matrix(rotations @ np.swapaxes(passes.rotations, 1, 2))
    rotation = _length((turned.mean().inv() * turned).as_rotvec())
    return HeldOut(points, _rms(_length(actual - wanted)), _rms(left), float(left.max()), _rms(rotation))


def random_passes(
    geometry: HexapodGeometry, box: np.ndarray, points: int, tilt: float, rng: np.random.Generator
) -> Passes:
    """Return passes through random points of a box of the work frame: all one way, then all back."""
    positions = rng.uniform(box[0], box[1], (points, 3))
    directions = rng.standard_normal((points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tilts = np.append(rng.uniform(-tilt, tilt, (points, 2)), np.zeros((points, 1)), axis=1)
    there_and_back = np.concatenate([way * directions for way in BOTH_WAYS])
    rotations = rotation_from_angles(tilts)
    return Passes.of_tool(geometry, np.tile(positions, (2, 1)), np.tile(rotations, (2, 1, 1)), there_and_back)


def align(actual: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return points (N, 3) after the rotation and shift that bring them nearest to others, m."""
    centre, mean = wanted.mean(axis=0), actual.mean(axis=0)
    turn, _ = Rotation.align_vectors(wanted - centre, actual - mean)
    return turn.apply(actual - mean) + centre


@dataclass(frozen=True)
class PaperMetric:
    """001's own measure, without and with a model.

    Attributes
    ----------
    before, after : float
        Mean absolute displacement error along lines, m.
    lines, readings : int
        How many.
    """

    before: float
    after: float
    lines: int
    readings: int

    @property
    def reduction(self) -> float:
        """Share removed, 0…1."""
        return 1.0 - self.after / self.before


def paper_metric(
    truth: RealMachine,
    model: MachineModel,
    box: np.ndarray,
    step: float = INCH,
    lines: int = 20,
    seed: int = 0,
    sensed: Temperatures | None = None,
) -> PaperMetric:
    """Return the mean absolute displacement error along lines parallel to the grid, without and with a model.

    001: the predicted values "were compared with the laser interferometer readings at various points within
    the selected workspace". So: lines along x, y and z at random places between the grid's, from end to end of
    the box, forward and backward, each with its zero where an interferometer is zeroed: at the first reading,
    the line's start. That reading, zero by definition, does not count. The others stand every `step`, half a
    step off those that a fit has seen. The laser that checks is perfect.

    Parameters
    ----------
    truth : RealMachine
        The hidden truth.
    model : MachineModel
        What the compensator believes.
    box : ndarray, shape (2, 3)
        Lowest and highest position of the tool in the work frame, m.
    step : float
        Distance of the readings along a line, m.
    lines : int
        Lines along each axis.
    seed : int
        Picks the lines.
    sensed : Temperatures, optional
        What the compensator believes the temperatures to be; 20 °C by default.

    Raises
    ------
    ModelError
        A line has fewer than two readings, or as :func:`run`.
    """
    rng = np.random.default_rng(seed)
    errors: list[list[np.ndarray]] = [[], []]
    for axis in range(3):
        passes = _check_lines(truth.geometry, box, axis, step, lines, rng)
        for found, told in zip(errors, (None, model), strict=True):
            found.append(_laser_readings(truth, passes, told, lines, sensed))
    before, after = (np.abs(np.concatenate(found)) for found in errors)
    return PaperMetric(float(before.mean()), float(after.mean()), 3 * lines, len(before))


def _check_lines(
    geometry: HexapodGeometry, box: np.ndarray, axis: int, step: float, lines: int, rng: np.random.Generator
) -> Passes:
    """Return passes along lines parallel to an axis of the work frame: line by line, forward, then back."""
    box = np.asarray(box, dtype=float)
    between = np.arange(box[0, axis] + 0.5 * step, box[1, axis], step)
    if not len(between):
        raise ModelError("step", "leaves no reading on a line of the box, m", step)
    along = np.concatenate([box[:1, axis], between, between[::-1]])  # zeroed at the start, there and back
    across = list(CROSS_AXES[axis])
    points = np.empty((lines, len(along), 3))
    points[..., axis] = along
    points[..., across] = rng.uniform(box[0, across], box[1, across], (lines, 2))[:, None]
    directions = np.zeros_like(points)
    directions[..., axis] = np.where(np.arange(len(along)) <= len(between), *BOTH_WAYS)
    level = np.broadcast_to(np.eye(3), (lines * len(along), 3, 3))
    return Passes.of_tool(geometry, points.reshape(-1, 3), level, directions.reshape(-1, 3))


def _laser_readings(
    truth: RealMachine, passes: Passes, model: MachineModel | None, lines: int, sensed: Temperatures | None
) -> np.ndarray:
    """Return what a laser reads on :func:`_check_lines`, m, without the first reading of each, its zero."""
    positions, rotations = run(truth, passes, model, sensed)
    tool = truth.geometry.tool.position
    errors = (positions + rotations @ tool - passes.points(tool)).reshape(lines, -1, 3)
    forward = passes.directions[0]
    readings = errors @ forward
    return (readings[:, 1:] - readings[:, :1]).ravel()


@dataclass(frozen=True)
class Worth:
    """Everything that is said about what a model is worth on a virtual machine.

    Attributes
    ----------
    before, after : HeldOut
        The tool's error in space without and with the model.
    paper : PaperMetric
        001's own measure.
    """

    before: HeldOut
    after: HeldOut
    paper: PaperMetric

    @property
    def raw_reduction(self) -> float:
        """Share of the RMS error in space that is removed, 0…1."""
        return 1.0 - self.after.raw_rms / self.before.raw_rms

    @property
    def aligned_reduction(self) -> float:
        """The same after the datum has been aligned, without and with the model."""
        return 1.0 - self.after.aligned_rms / self.before.aligned_rms

    @property
    def rotation_reduction(self) -> float:
        """Share of the RMS rotation error that is removed, 0…1."""
        return 1.0 - self.after.rotation_rms / self.before.rotation_rms


def worth(
    truth: RealMachine,
    model: MachineModel,
    box: np.ndarray,
    points: int = 1000,
    seed: int = 0,
    repeatability: float = 0.0,
    sensed: Temperatures | None = None,
) -> Worth:
    """Return what a model is worth on a virtual machine; parameters as :func:`held_out` has them.

    `repeatability` spoils the points in space; the paper's metric does without.
    """
    before = held_out(truth, None, box, points, seed, repeatability)
    after = held_out(truth, model, box, points, seed, repeatability, sensed=sensed)
    return Worth(before, after, paper_metric(truth, model, box, seed=seed, sensed=sensed))


def _length(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of (N, 3) vectors."""
    return np.linalg.norm(vectors, axis=1)


def _rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
