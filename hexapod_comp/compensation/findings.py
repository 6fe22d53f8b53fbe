"""What the core found wrong with a command, as errors in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import QUATERNION_NORM_TOLERANCE, Status, ffi
from ..errors import HexapodError, LimitError, NotConvergedError, OutsideFieldError, PoseError
from ..machine.field import GridField
from ..machine.geometry import HexapodGeometry, pose_text
from ..machine.limits import STRUT_NAMES
from ..machine.model import MachineModel
from ..pose import Pose

SAME_PLACE = 1e-5
"""Nominal lengths that differ by no more, m, are the same place: what a controller's decimals round; the core's."""


def refusal(
    answer: Any,
    geometry: HexapodGeometry,
    model: MachineModel,
    numbers: Sequence[float] = (),
    stands: Pose | None = None,
) -> HexapodError:
    """Return what was found wrong with a command.

    Parameters
    ----------
    answer : hc_answer
        The core's.
    geometry, model : HexapodGeometry, MachineModel
        For which.
    numbers : sequence of seven float
        Position and quaternion, where the command was given so.
    stands : Pose, optional
        ``pose_platform_in_base`` of the last command.

    Returns
    -------
    PoseError, NotConvergedError, OutsideFieldError, LimitError or NotFiniteError
    """
    status = answer.status
    if status == Status.QUATERNION or (status == Status.NOT_FINITE and answer.strut < 0):
        return _pose_error(status, numbers)
    if status == Status.NOT_CONVERGED:
        return NotConvergedError("the error field is too steep to be undone at this pose")
    if status == Status.OUTSIDE_FIELD:
        return _outside_error(pose_of(answer.platform), model.field)
    if status == Status.TOOL_CHANGED:
        return _tool_error(answer.strut, answer.value, geometry, stands or geometry.home)
    return geometry.limits.error(status, answer.strut, answer.compensated, answer.value)


def pose_of(pose: Any) -> Pose:
    """Return an ``hc_pose`` as a pose."""
    numbers = np.frombuffer(ffi.buffer(ffi.addressof(pose)), dtype=float)
    return Pose(numbers[:3], numbers[3:].reshape(3, 3))


def _tool_error(strut: int, way: float, geometry: HexapodGeometry, stands: Pose) -> LimitError:
    problem = (
        f"since the change to tool {geometry.tool_name!r} no command was where the struts are: "
        f"{STRUT_NAMES[strut]} would move by {way * 1e3:.4f} mm, allowed {SAME_PLACE * 1e3:g} mm; in "
        f"{geometry.work_name} the tool is at {pose_text(geometry.tool_pose(stands))}"
    )
    return LimitError("tool_changed", problem, way, SAME_PLACE, strut, "nominal")


def _pose_error(status: int, numbers: Sequence[float]) -> PoseError:
    if status == Status.NOT_FINITE:
        return PoseError("pose must be finite", list(numbers), "not_finite")
    norm = math.hypot(*numbers[3:])
    problem = f"quaternion must have norm 1 within {QUATERNION_NORM_TOLERANCE:g}, not {norm:.6g}"
    return PoseError(problem, list(numbers[3:]), "quaternion")


def _outside_error(platform: Pose, field: GridField) -> OutsideFieldError:
    box = field.box * 1e3
    point = (platform.position + platform.rotation @ field.probe) * 1e3
    low, high = (", ".join(f"{v:g}" for v in corner) for corner in box)
    problem = f"the measured point ({point[0]:.3f}, {point[1]:.3f}, {point[2]:.3f}) mm is outside the field's box"
    return OutsideFieldError(f"{problem} ({low})…({high}) mm, in base", point, box)
