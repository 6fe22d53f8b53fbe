"""What a model is worth: the virtual machine told what the model says, seen where nothing was fitted.

Two measures. The honest one is the error vector of the tool in space at random points of the workspace,
passed in random directions. That of Mou & King (1998) is the mean absolute displacement error along lines
parallel to the grid, which is all that a linear laser sees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import ModelError
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.passes import BOTH_WAYS, Passes, random_passes
from ..machine.size import Size
from ..machine.temperatures import Temperatures
from ..virtual.trial import Trial

INCH = 0.0254


@dataclass(frozen=True)
class HeldOut:
    """Error of the tool at points that nothing was fitted to, both ways through each.

    Attributes
    ----------
    points : int
        How many.
    raw, aligned : Size
        The error vector, m, as it is, and after the datum has been aligned: one rotation and one shift for everything.
    rotation : Size
        The platform's rotation error after the common rotation has been taken out, rad.
    """

    points: int
    raw: Size
    aligned: Size
    rotation: Size


def held_out(
    truth: RealMachine,
    model: MachineModel | None,
    box: np.ndarray,
    points: int = 1000,
    seed: int = 0,
    repeatability: float = 0.0,
    tilt: float = 0.0,
    sensed: Temperatures | None = None,
    level: np.ndarray | None = None,
) -> HeldOut:
    """Return the error of the tool at random points of a box, passed there and back in random directions.

    Parameters
    ----------
    truth, model : RealMachine, MachineModel or None
        The machine, and what the compensator believes; None for the machine as it is.
    box : ndarray, shape (2, 3)
        Lowest and highest position of the tool in the work frame, m.
    points, seed : int
        How many, at least three: fewer do not tell a rotation. Equal seeds give equal passes, whatever the model.
    repeatability : float
        Standard deviation, along each axis, of where the machine really stops, m.
    tilt : float
        Largest tilt of the tool about x and y, rad.
    sensed : Temperatures, optional
        What the compensator believes the temperatures to be; 20 °C by default.
    level : ndarray, shape (3, 3), optional
        Attitude of a level tool in the work frame; parallel to it by default.

    Raises
    ------
    ModelError
        Fewer than three points, or as :meth:`hexapod_comp.virtual.trial.Trial.commands`.
    """
    if points < 3:
        raise ModelError("points", "must be at least three", points)
    rng = np.random.default_rng(seed)
    trial = Trial(truth, random_passes(truth.geometry, box, points, tilt, rng, level))
    errors = trial.errors(trial.commands(model, sensed))
    stopped = repeatability * rng.standard_normal(errors.displacement.shape)
    errors = replace(errors, displacement=errors.displacement + stopped)
    aligned = errors.aligned()
    return HeldOut(points, Size.of(errors.displacement), Size.of(aligned.displacement), Size.of(aligned.rotation))


@dataclass(frozen=True)
class PaperMetric:
    """Mou & King's own measure, without and with a model.

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


def paper_metric(
    truth: RealMachine,
    model: MachineModel,
    box: np.ndarray,
    step: float = INCH,
    lines: int = 20,
    seed: int = 0,
    sensed: Temperatures | None = None,
    level: np.ndarray | None = None,
) -> PaperMetric:
    """Return the mean absolute displacement error along lines parallel to the grid, without and with a model.

    Mou & King: the predicted values "were compared with the laser interferometer readings at various points within
    the selected workspace". So: lines along x, y and z at random places between the grid's, from end to end of
    the box, forward and backward, each with its zero where an interferometer is zeroed: at the first reading,
    the line's start. That reading, zero by definition, does not count. The others stand every `step`, half a
    step off those that a fit has seen. The laser that checks is perfect.

    Parameters
    ----------
    truth, model, box, seed, sensed, level
        As for :func:`held_out`.
    step : float
        Distance of the readings along a line, m.
    lines : int
        Lines along each axis.

    Raises
    ------
    ModelError
        A line has fewer than two readings, or as for :func:`held_out`.
    """
    rng = np.random.default_rng(seed)
    errors: list[list[np.ndarray]] = [[], []]
    for axis in range(3):
        passes = _check_lines(truth.geometry, box, axis, step, lines, rng, np.eye(3) if level is None else level)
        for readings, applied in zip(errors, (None, model), strict=True):
            readings.append(_laser_readings(truth, passes, applied, lines, sensed))
    before, after = (np.abs(np.concatenate(readings)) for readings in errors)
    return PaperMetric(float(before.mean()), float(after.mean()), 3 * lines, len(before))


def _check_lines(
    geometry: HexapodGeometry,
    box: np.ndarray,
    axis: int,
    step: float,
    lines: int,
    rng: np.random.Generator,
    level: np.ndarray,
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
    rotations = np.broadcast_to(level, (lines * len(along), 3, 3))
    return Passes.of_tool(geometry, points.reshape(-1, 3), rotations, directions.reshape(-1, 3))


def _laser_readings(
    truth: RealMachine, passes: Passes, model: MachineModel | None, lines: int, sensed: Temperatures | None
) -> np.ndarray:
    """Return what a laser reads on :func:`_check_lines`, m, without the first reading of each, its zero."""
    trial = Trial(truth, passes)
    errors = trial.errors(trial.commands(model, sensed)).displacement
    readings = errors.reshape(lines, -1, 3) @ passes.directions[0]
    return (readings[:, 1:] - readings[:, :1]).ravel()


@dataclass(frozen=True)
class Worth:
    """Everything that is said about what a model is worth on a virtual machine.

    Attributes
    ----------
    before, after : HeldOut
        The tool's error in space without and with the model.
    paper : PaperMetric
        Mou & King's own measure.
    promised : (float, float) or None
        Where a fit expects the RMS error in space with the model, the datum aligned, m.
    """

    before: HeldOut
    after: HeldOut
    paper: PaperMetric
    promised: tuple[float, float] | None = None

    @property
    def kept(self) -> bool | None:
        """Whether what a fit promised is so; None where it promised nothing."""
        return None if self.promised is None else self.promised[0] <= self.after.aligned.rms <= self.promised[1]


def worth(
    truth: RealMachine,
    model: MachineModel,
    box: np.ndarray,
    points: int = 1000,
    seed: int = 0,
    repeatability: float = 0.0,
    sensed: Temperatures | None = None,
    level: np.ndarray | None = None,
) -> Worth:
    """Return what a model is worth on a virtual machine; parameters as :func:`held_out` has them.

    `repeatability` spoils the points in space; the paper's metric does without.
    """
    before = held_out(truth, None, box, points, seed, repeatability, level=level)
    after = held_out(truth, model, box, points, seed, repeatability, sensed=sensed, level=level)
    return Worth(before, after, paper_metric(truth, model, box, seed=seed, sensed=sensed, level=level))
