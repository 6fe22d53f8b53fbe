"""What the kernel found wrong with a command, as errors in words."""

from __future__ import annotations

import math

import numpy as np

from ..errors import LimitError, NotConvergedError, OutsideFieldError, PoseError
from ..kernels.compensation import NO_POSE, OUTSIDE, UNSOLVED
from ..kernels.limits import WITHIN
from ..kernels.pose import POSE_NOT_FINITE, QUATERNION_NORM_TOLERANCE
from ..machine.field import GridField
from ..machine.frames import pose_text
from ..machine.geometry import HexapodGeometry
from ..machine.limits import STRUT_NAMES
from ..machine.model import RealMachine
from .state import CommandState

SAME_PLACE = 1e-5
"""Nominal lengths that differ by no more, m, are the same place: what a controller's decimals round."""


def refuse(outcome: tuple, command: CommandState, machine: RealMachine, numbers: tuple[float, ...] = ()) -> None:
    """Raise what was found wrong with a command; return when nothing was.

    Parameters
    ----------
    outcome : tuple
        As :func:`~hexapod_comp.kernels.compensation.compensate_one` returns it.
    command : CommandState
        What it wrote.
    machine : RealMachine
        For which.
    numbers : tuple of seven float
        Position and quaternion, where the command was given so.

    Raises
    ------
    PoseError, NotConvergedError, OutsideFieldError, LimitError, NotFiniteError
        What was found.
    """
    status, finding, strut, stage, value, _ = outcome
    if status == NO_POSE:
        raise _pose_error(finding, numbers)
    if status == UNSOLVED:
        raise NotConvergedError("the error field is too steep to be undone at this pose")
    if status == OUTSIDE and machine.model.field.outside == "refuse":
        raise _outside_error(command, machine.model.field)
    if finding != WITHIN:
        raise machine.geometry.limits.error(finding, strut, stage, value)


def refuse_motion(outcome: tuple, last: CommandState, command: CommandState, geometry: HexapodGeometry) -> None:
    """Raise where the first command after a change of tool would move a nominal strut.

    Raises
    ------
    LimitError
        ``tool_changed``, with the strut that would move furthest, and where the tool is.
    """
    if outcome[0] == NO_POSE:
        return  # for :func:`refuse`
    ways = command.state.nominal - last.state.nominal
    strut = int(np.abs(ways).argmax())
    way = float(ways[strut])
    if not abs(way) <= SAME_PLACE:
        problem = (
            f"since the change to tool {geometry.tool_name!r} no command was where the struts are: "
            f"{STRUT_NAMES[strut]} would move by {way * 1e3:.4f} mm, allowed {SAME_PLACE * 1e3:g} mm; in "
            f"{geometry.work_name} the tool is at {pose_text(geometry.tool_pose(last.platform))}"
        )
        raise LimitError("tool_changed", problem, way, SAME_PLACE, strut, "nominal")


def _pose_error(outcome: int, numbers: tuple[float, ...]) -> PoseError:
    if outcome == POSE_NOT_FINITE:
        return PoseError("pose must be finite", list(numbers), "not_finite")
    norm = math.hypot(*numbers[3:])
    problem = f"quaternion must have norm 1 within {QUATERNION_NORM_TOLERANCE:g}, not {norm:.6g}"
    return PoseError(problem, list(numbers[3:]), "quaternion")


def _outside_error(command: CommandState, field: GridField) -> OutsideFieldError:
    box = field.box * 1e3
    platform = command.platform
    point = (platform.position + platform.rotation @ field.probe) * 1e3
    low, high = (", ".join(f"{v:g}" for v in corner) for corner in box)
    problem = f"the measured point ({point[0]:.3f}, {point[1]:.3f}, {point[2]:.3f}) mm is outside the field's box"
    return OutsideFieldError(f"{problem} ({low})…({high}) mm, in base", point, box)
