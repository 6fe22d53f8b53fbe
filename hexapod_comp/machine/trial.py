"""Drives a real machine through poses and computes its tool errors at these poses; all reports use this module.

The nominal machine, a model or the caller gives the strut commands. A `RealMachine` then gives the actual poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from ..core import Status
from ..core.batch import backwards
from ..errors import ModelError, NotConvergedError
from ..pose import attitude_error, best_motion, nearest_rotation, rotation_from_vector, rotation_vector
from .kinematics import forward_error
from .load import FREE, Loading
from .model import MachineModel, RealMachine
from .passes import Passes, Poses, at
from .temperatures import Temperatures

NameOf = Callable[[int], str]  # A function that returns the name, in an error message, of the pose with an index


@dataclass(frozen=True)
class ToolErrors:
    """Errors of a point of the platform, usually the tool's tip, at N poses; all vectors are in ``base``."""

    points: np.ndarray  # (N, 3): commanded positions of the point, m
    displacement: np.ndarray  # (N, 3): actual − commanded position, m
    rotation: np.ndarray  # (N, 3): rotation vector from commanded to actual attitude, rad
    field_share: np.ndarray  # (N, 3): the part of the displacement that comes from the machine's error field, m

    def as_array(self) -> np.ndarray:
        """Return displacements, m, and rotation vectors, rad, side by side, (N, 6)."""
        return np.hstack([self.displacement, self.rotation])

    def aligned(self) -> ToolErrors:
        """Return the errors after best-fit alignment: a rigid motion minimises the displacements' sum of squares.

        The mean rotation error is removed from each rotation error.
        """
        actual = self.points + self.displacement
        motion = best_motion(actual, self.points)
        if motion is None:
            raise ModelError("points", "must be three or more, not in a line, for a best-fit alignment", len(actual))
        turned = rotation_from_vector(self.rotation)
        displacement = motion.transform(actual) - self.points
        return replace(
            self, displacement=displacement, rotation=rotation_vector(nearest_rotation(turned.sum(axis=0)).T @ turned)
        )


@dataclass(frozen=True)
class Driven:
    """Actual platform poses of a machine at N commands."""

    actual: Poses  # (N, 3), m, and (N, 3, 3): ``pose_platform_in_base``
    without_field: Poses  # (N, 3), m, and (N, 3, 3): actual poses without the error field's part

    def errors(self, commanded: Poses, point: np.ndarray) -> ToolErrors:
        """Return the errors, actual − commanded, of a `point` (3,) of the platform, m, at N commanded poses."""
        (positions, rotations), (modelled, turned) = self.actual, self.without_field
        return ToolErrors(
            points=commanded[0] + commanded[1] @ point,
            displacement=positions - commanded[0] + (rotations - commanded[1]) @ point,
            rotation=attitude_error(rotations, commanded[1]),
            field_share=positions - modelled + (rotations - turned) @ point,
        )


def drive(
    machines: Sequence[RealMachine],
    starts: Poses,
    senses: np.ndarray,
    commands: np.ndarray,
    name_of: NameOf | None = None,
    advance: Callable[[int], object] = lambda rows: None,
) -> Driven:
    """Return the actual pose of each of N machines at its command, (N, 6), m; report progress to `advance`."""
    commands, senses = np.ascontiguousarray(commands, dtype=float), np.ascontiguousarray(senses, dtype=float)
    modelled = np.array(starts[0], order="C"), np.array(starts[1], order="C")
    actual = np.empty_like(modelled[0]), np.empty_like(modelled[1])
    outcomes, conditions = np.empty(len(commands), np.intc), np.empty(len(commands))
    arrays, done = (commands, senses, *modelled, *actual, outcomes, conditions), 0
    for machine, alike in groupby(machines):
        rows = slice(done, done + len(list(alike)))
        machine.forward_many(*(each[rows] for each in arrays))
        failed = np.flatnonzero(outcomes[rows] != Status.OK)
        if len(failed):
            row = done + int(failed[0])
            error = forward_error(outcomes[row], conditions[row], machine.structure.max_condition)
            where = at(machine.geometry, starts[0][row], starts[1][row]) if name_of is None else name_of(row)
            raise type(error)(f"{where}: {error}", error.value, error.limit)
        advance(rows.stop - done)
        done = rows.stop
    return Driven(actual, modelled)


def model_commands(
    machines: Sequence[RealMachine], targets: Poses, senses: np.ndarray, name_of: NameOf | None = None
) -> tuple[np.ndarray, Poses]:
    """Run :meth:`RealMachine.commands_for` for N machines and poses: strut commands (N, 6), m, and model poses."""
    positions, rotations = np.ascontiguousarray(targets[0]), np.ascontiguousarray(targets[1])
    senses, no_window = np.array(senses, dtype=float), np.full((len(positions), 9), np.nan)
    commands, modelled = np.empty((len(positions), 6)), (np.empty_like(positions), np.empty_like(rotations))
    outcomes, done = np.empty(len(positions), np.intc), 0
    for machine, alike in groupby(machines):
        rows = slice(done, done + len(list(alike)))
        of_rows = positions[rows], rotations[rows], no_window[rows], senses[rows]
        modelled[0][rows], modelled[1][rows], commands[rows], outcomes[rows] = backwards(machine.state, *of_rows)
        done = rows.stop
    if (outcomes == Status.NOT_CONVERGED).any():
        n = int((outcomes == Status.NOT_CONVERGED).argmax())
        where = at(machines[n].geometry, positions[n], rotations[n]) if name_of is None else name_of(n)
        raise NotConvergedError(f"{where}: {NotConvergedError()}")
    return commands, modelled


@dataclass(frozen=True)
class Trial:
    """A real machine and the poses that it passes through."""

    machine: RealMachine  # the machine with its true errors, at its true temperatures
    passes: Passes  # commanded poses, and directions of travel

    def commands(
        self, model: MachineModel | None, sensed: Temperatures | None = None, loading: Loading = FREE
    ) -> np.ndarray:
        """Return a model's strut commands (N, 6), m, at `sensed` temperatures and loads; nominal ones without model."""
        if model is None:
            return self.passes.nominal_commands()
        believed = RealMachine(self.passes.geometry, model, sensed, loading)
        return model_commands([believed] * len(self.passes), self.passes.poses, self.passes.senses())[0]

    def drive(self, commands: np.ndarray) -> Driven:
        return drive([self.machine] * len(self.passes), self.passes.poses, self.passes.senses(), commands)

    def errors(self, commands: np.ndarray) -> ToolErrors:
        """Return the errors of the tool's tip that result from strut commands, (N, 6), m."""
        return self.drive(commands).errors(self.passes.poses, self.passes.geometry.tool.position)
