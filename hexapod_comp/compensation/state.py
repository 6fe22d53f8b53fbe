"""A compensator's state by name, the vectors in which machine and state reach the kernels, one command's record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import ModelError
from ..kernels.compensation import SIZES, STATE_SIZE, State, state_of
from ..machine.geometry import HexapodGeometry
from ..machine.model import RealMachine
from ..machine.motion import MotionState
from ..pose import Pose

TOOL_CHANGED = 2.0
"""Value of ``resumes`` in a state: the tool has changed since the last command."""

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
        The platform is outside the box for which the model was measured.
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


def pack_fixed(machine: RealMachine) -> tuple:
    """Return what the kernels take of a machine: its numbers, the nominal ones, and the arrays whose size varies."""
    varied = (*machine.strut_arrays[1:], *machine.field_arrays[1:])
    return pack_machine(machine), pack_nominal(machine.geometry), varied


def pack_machine(machine: RealMachine) -> np.ndarray:
    """Return what :func:`~hexapod_comp.kernels.compensation.machine_views` takes apart."""
    return _joined(*machine.body, machine.strut_arrays[0], machine.field_arrays[0], machine.thresholds, machine.solver)


def pack_nominal(geometry: HexapodGeometry) -> np.ndarray:
    """Return what :func:`~hexapod_comp.kernels.compensation.nominal_views` takes apart."""
    tool = geometry.tool.inverse()
    return _joined(*geometry.kernel_joints, tool.position, tool.rotation, *geometry.limit_numbers)


def pack_pose(pose: Pose) -> np.ndarray:
    """Return position, then rotation matrix by rows, shape (12,)."""
    return _joined(pose.position, pose.rotation)


def _joined(*parts: Any) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in parts])


class CommandState:
    """What one command leaves behind.

    Parameters
    ----------
    ramp_rate : float
        Largest speed of the ramp, m/s.

    Attributes
    ----------
    numbers : ndarray, shape (STATE_SIZE,)
        All of it, as the kernels take it.
    state : State
        Its parts by name.
    motion : MotionState
        Directions of motion, parts of it too.
    """

    __slots__ = ("motion", "numbers", "state")

    def __init__(self, ramp_rate: float) -> None:
        self.numbers = np.full(STATE_SIZE, math.nan)
        self.state = state_of(self.numbers)
        self.motion = MotionState(self.state.motion_low, self.state.motion_sense)
        self.state.ramp[:], self.state.ramp_rate[:] = 0.0, ramp_rate
        self.state.enabled[:], self.state.changed[:], self.state.ahead_by_receipt[:] = 1.0, 0.0, 0.0
        self.clear()

    @property
    def platform(self) -> Pose:
        """Commanded ``pose_platform_in_base``."""
        return Pose(self.state.platform_position, self.state.platform_rotation.reshape((3, 3)))

    @property
    def model(self) -> Pose:
        """The model pose."""
        return Pose(self.state.model_position, self.state.model_rotation.reshape((3, 3)))

    def clear(self) -> None:
        """Forget lengths and motion.

        The correction stays, as what the struts stand at, and so does when they were told so, and how far ahead of
        their largest speed: a reset must not make them faster.
        """
        state = self.state
        state.motion_low[:], state.motion_sense[:] = math.nan, 0.0
        state.nominal[:], state.command[:], state.time[:], state.resumes[:] = math.nan, math.nan, math.nan, 0.0
        state.ahead_by_stamp[:], state.smooth_speed[:] = 0.0, 0.0
        self.must_ramp()

    def must_ramp(self) -> None:
        """Let the next command start from the correction that the struts stand at, if there is one."""
        self.state.changed[:] = float(not math.isnan(self.state.correction[0]))

    def snapshot(self) -> dict[str, list[float]]:
        """Return each part's numbers by name."""
        return {name: part.tolist() for name, part in self.state._asdict().items()}


def read_state(snapshot: Mapping[str, Any]) -> np.ndarray:
    """Return the vector that holds the numbers of a compensator's snapshot.

    Raises
    ------
    ModelError
        A name is missing or unknown, or has not as many numbers as it should.
    """
    for name in sorted({*State._fields} ^ ({*snapshot} - {*BESIDE_NUMBERS})):
        raise ModelError(f"snapshot.{name}", "is missing" if name in State._fields else "is unknown to this release")
    parts = [np.asarray(snapshot[name], dtype=float) for name in State._fields]
    for name, part, size in zip(State._fields, parts, SIZES, strict=True):
        if part.shape != (size,):
            raise ModelError(f"snapshot.{name}", f"must be {size} numbers", part.size)
    return np.concatenate(parts)
