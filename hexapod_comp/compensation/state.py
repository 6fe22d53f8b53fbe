"""One command's record, and a compensator's state by name: what its snapshot holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core import Struct
from ..errors import ModelError
from ..pose import Pose

PARTS = {
    "motion_low": 9,
    "motion_sense": 9,
    "nominal": 6,
    "correction": 6,
    "command": 6,
    "ramp": 6,
    "time": 1,
    "platform_position": 3,
    "platform_rotation": 9,
    "model_position": 3,
    "model_rotation": 9,
    "enabled": 1,
    "changed": 1,
    "resumes": 1,
    "ramp_rate": 1,
    "received": 1,
    "published": 1,
    "ahead_by_stamp": 6,
    "ahead_by_receipt": 6,
    "smooth_speed": 6,
}
"""Parts of a snapshot, and how many numbers each is: the members of ``hc_last``, and the ramp's rate. A recording holds
them under these names, so a new meaning needs a new name."""

PLACES = ("platform_", "model_")
"""Beginnings of the names of parts that are poses."""

BESIDE_NUMBERS = ("temperatures", "lags", "tool")
"""What a compensator's snapshot holds beside the numbers of its state."""


@dataclass(frozen=True)
class Correction:
    """Everything about one compensated command.

    Attributes
    ----------
    tool : str
        Name of the tool in use.
    tool_pose : Pose
        Commanded ``pose_tool_in_work``.
    platform_pose : Pose
        The same as ``pose_platform_in_base``.
    model_pose : Pose
        Pose q with q ∘ E(q) = platform_pose, for which the real structure's lengths were taken.
    sense : ndarray, shape (9,)
        Directions of motion used: x, y, z of the measured point, six struts.
    temperatures : dict of str to float
        Readings used, °C; parts without one are at 20 °C. ``humidity``, a fraction, is 0.5 without one.
    nominal : ndarray, shape (6,)
        Strut lengths of the nominal machine, m.
    correction : ndarray, shape (6,)
        command − nominal, m.
    command : ndarray, shape (6,)
        What the struts are told, m.
    predicted_error : ndarray, shape (6,)
        Displacement (m) and rotation (rad) of the tool along the axes of ``base`` that nominal lengths
        would leave, to first order in the corrections: J⁻¹ times minus the model's correction.
    condition : float
        Condition number of the nominal pose.
    enabled : bool
        Compensation was on.
    ramping : bool
        A change of model, temperature or enabling has not been fully taken up yet.
    outside_field : bool
        The field's value was held at the boundary of its box.
    outside_box : bool
        The command is outside the region in which the model was measured.
    """

    tool: str
    tool_pose: Pose
    platform_pose: Pose
    model_pose: Pose
    sense: np.ndarray
    temperatures: dict[str, float]
    nominal: np.ndarray
    correction: np.ndarray
    command: np.ndarray
    predicted_error: np.ndarray
    condition: float
    enabled: bool
    ramping: bool
    outside_field: bool
    outside_box: bool


def pack_pose(pose: Pose) -> Struct:
    """Return a pose as the core takes it."""
    return Struct("hc_pose", {"position": pose.position, "rotation": pose.rotation})


def named_parts(state: Struct) -> dict[str, np.ndarray]:
    """Return the parts of a compensator's state by their names in a snapshot, each in the state's memory."""
    last = state.view["last"]
    parts = {}
    for name in PARTS:
        body, _, part = name.partition("_")
        if name == "ramp_rate":
            parts[name] = state.view[name]
        else:
            parts[name] = last[body][part] if body in ("platform", "model") else last[name]
    return parts


def read_parts(snapshot: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the numbers of a compensator's snapshot by name.

    Raises
    ------
    ModelError
        A name is missing or unknown, or has not as many numbers as it should.
    """
    for name in sorted({*PARTS} ^ ({*snapshot} - {*BESIDE_NUMBERS})):
        raise ModelError(f"snapshot.{name}", "is missing" if name in PARTS else "is unknown to this release")
    parts = {name: np.asarray(snapshot[name], dtype=float) for name in PARTS}
    for name, size in PARTS.items():
        if parts[name].shape != (size,):
            raise ModelError(f"snapshot.{name}", f"must be {size} numbers", parts[name].size)
    return parts
