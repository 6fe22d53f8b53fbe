"""The state of a compensator, by name, and the vectors in which machine and state reach the kernels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import ModelError
from ..kernels.compensation import SIZES, STATE_SIZE, State, state_of
from ..machine.geometry import HexapodGeometry
from ..machine.model import RealMachine
from ..machine.motion import MotionState
from ..pose import Pose


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
    """Return the vector that holds the numbers of a :meth:`CommandState.snapshot`.

    Raises
    ------
    ModelError
        A name is missing or unknown, or has not as many numbers as it should.
    """
    for name in sorted({*State._fields} ^ {*snapshot}):
        raise ModelError(f"snapshot.{name}", "is missing" if name in State._fields else "is unknown to this release")
    parts = [np.asarray(snapshot[name], dtype=float) for name in State._fields]
    for name, part, size in zip(State._fields, parts, SIZES, strict=True):
        if part.shape != (size,):
            raise ModelError(f"snapshot.{name}", f"must be {size} numbers", part.size)
    return np.concatenate(parts)
