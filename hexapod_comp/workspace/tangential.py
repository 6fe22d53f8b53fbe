"""The iteration of v. Daake et al. (chapter 1) for the effect of one error, kept as a check and as a yardstick.

Tangents to the motion that one active leg causes are followed in small steps. Each needs the motion relations
of all legs, which virtual displacements of the tool give through the inverse kinematics alone. Nothing is
shared with the compiled exact solution but the machine's numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import KinematicsError, NotConvergedError, SingularError
from ..machine.geometry import HexapodGeometry
from ..pose import Pose
from .sources import BASE_JOINT, LENGTH, PLATFORM_JOINT, TOOL, SingleErrors

STEP = 1e-5
"""Travel of the active leg per step, m (v. Daake et al.: 0.01 mm)."""

TOLERANCE = 1e-9
"""ε: legs that are off by more, m, are corrected."""

VIRTUAL = 1e-7
"""Virtual displacement, m and rad: small beside any curvature, large beside rounding."""

MOST_CORRECTIONS = 20
"""A step that needs more leads nowhere."""


@dataclass(frozen=True)
class TangentialResult:
    """Where the iteration ends.

    Attributes
    ----------
    vector : ndarray, shape (6,)
        Displacement of the tool and its rotation vector, actual minus nominal, along the axes of the work frame;
        m, rad.
    drift : float
        Largest length error of a passive leg that any step left before correction, m.
    active : float
        Largest length error of the active leg likewise, m.
    travel : float
        How far the active leg went, m.
    steps, corrections : int
        How many of each.
    """

    vector: np.ndarray
    drift: float
    active: float
    travel: float
    steps: int
    corrections: int


@dataclass
class _State:
    """Tool tip and platform orientation in ``base``, and the machine as it is in this step."""

    base: np.ndarray
    platform: np.ndarray
    tool: np.ndarray
    tip: np.ndarray
    rotation: np.ndarray

    def lengths(self, motion: np.ndarray | None = None) -> np.ndarray:
        """Return the leg lengths after a motion (x, y, z, a, b, c) of the tool, shape (6,), m."""
        tip, rotation = self.moved(np.zeros(6) if motion is None else motion)
        return np.linalg.norm(tip + (self.platform - self.tool) @ rotation.T - self.base, axis=1)

    def moved(self, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tip and orientation after a motion about the tip."""
        return self.tip + motion[:3], Rotation.from_rotvec(motion[3:]).as_matrix() @ self.rotation

    def motion_matrix(self) -> np.ndarray:
        """Return V: leg lengths per virtual displacement of the tool, one after another (v. Daake et al., eq. 1–2)."""
        here = self.lengths()
        columns = [(self.lengths(VIRTUAL * axis) - here) / VIRTUAL for axis in np.eye(6)]
        return np.stack(columns, axis=1)

    def follow(self, change: np.ndarray) -> None:
        """Move the tool along the tangent on which the legs change by so much (v. Daake et al., eq. 3–4: V·R = A)."""
        try:
            motion = np.linalg.solve(self.motion_matrix(), change)
        except np.linalg.LinAlgError:
            raise SingularError("the motion matrix is singular: no leg can move alone") from None
        self.tip, self.rotation = self.moved(motion)


def tangential_effect(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    index: int,
    pose: Pose,
    step: float = STEP,
    tolerance: float = TOLERANCE,
) -> TangentialResult:
    """Return the effect of one single error at one pose by the paper's iteration.

    A leg of wrong length travels to it in steps, all other legs held. A joint travels to its wrong place in
    steps; its leg is active and takes back the length that the joint's travel gives it.

    Parameters
    ----------
    geometry : HexapodGeometry
        The nominal machine.
    errors : SingleErrors
        Errors.
    index : int
        Which of them.
    pose : Pose
        Nominal ``pose_platform_in_base``.
    step : float
        Largest travel of leg or joint per step, m.
    tolerance : float
        ε, m.

    Raises
    ------
    KinematicsError
        Step or tolerance not above zero; SingularError, NotConvergedError.
    """
    for name, value in (("step", step), ("tolerance", tolerance)):
        if not 0.0 < value < math.inf:
            raise KinematicsError(f"{name} must be above zero, m, not {value}", value)
    if errors.part[index] == TOOL:
        shift = geometry.work.rotation.T @ pose.rotation @ errors.vector[index]
        return TangentialResult(np.concatenate([shift, np.zeros(3)]), 0.0, 0.0, 0.0, 0, 0)
    tip = pose.position + pose.rotation @ geometry.tool.position
    joints = geometry.base_joints.copy(), geometry.platform_joints.copy()
    state = _State(*joints, geometry.tool.position, tip, pose.rotation)
    path = _path(geometry, errors, index, state.lengths(), step)
    return _walk(geometry.work.rotation, state, int(errors.strut[index]), path, tolerance)


Waypoint = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Leg lengths to hold, and the base and platform joints of the active leg."""


def _path(
    geometry: HexapodGeometry, errors: SingleErrors, index: int, nominal: np.ndarray, step: float
) -> list[Waypoint]:
    """Return how the error grows from nothing to its size."""
    part, strut, vector = errors.part[index], int(errors.strut[index]), errors.vector[index]
    stretch = _length_error(geometry, vector, strut, nominal[strut]) if part == LENGTH else 0.0
    size = abs(stretch) if part == LENGTH else float(np.linalg.norm(vector))
    leg = np.eye(6)[strut]
    path = []
    for share in np.linspace(0.0, 1.0, max(1, math.ceil(size / step - 1e-9)) + 1)[1:]:
        base = geometry.base_joints[strut] + (share * vector if part == BASE_JOINT else 0.0)
        platform = geometry.platform_joints[strut] + (share * vector if part == PLATFORM_JOINT else 0.0)
        path.append((nominal + share * stretch * leg, base, platform))
    return path


def _walk(
    work_rotation: np.ndarray, state: _State, strut: int, path: list[Waypoint], tolerance: float
) -> TangentialResult:
    """Follow a path with one active leg and see where the tool gets to."""
    start_tip, start_rotation, leg = state.tip, state.rotation, np.eye(6)[strut]
    drift = active = travel = 0.0
    corrections = 0
    for target, base, platform in path:
        state.base[strut], state.platform[strut] = base, platform
        wanted = (target - state.lengths()) * leg
        state.follow(wanted)
        off = np.abs(state.lengths() - target)
        drift, active = max(drift, float(np.delete(off, strut).max())), max(active, float(off[strut]))
        travel += abs(float(wanted[strut]))
        corrections += _correct(state, target, tolerance)
    turn = Rotation.from_matrix(state.rotation @ start_rotation.T).as_rotvec()
    vector = np.concatenate([work_rotation.T @ (state.tip - start_tip), work_rotation.T @ turn])
    return TangentialResult(vector, drift, active, travel, len(path), corrections)


def _length_error(geometry: HexapodGeometry, vector: np.ndarray, strut: int, length: float) -> float:
    """Return a strut's length error at a length, m: a + b·(L − L_home) + c·L."""
    arms = geometry.platform_joints[strut] @ geometry.home.rotation.T
    home = float(np.linalg.norm(geometry.home.position + arms - geometry.base_joints[strut]))
    return float(vector[0] + vector[1] * (length - home) + vector[2] * length)


def _correct(state: _State, target: np.ndarray, tolerance: float) -> int:
    """Bring the legs that are off by more than ε back by the same algorithm; return how often it took."""
    for count in range(MOST_CORRECTIONS):
        off = target - state.lengths()
        outside = np.abs(off) > tolerance
        if not outside.any():
            return count
        state.follow(np.where(outside, off, 0.0))
    raise NotConvergedError(f"legs stay off by more than {tolerance:g} m", limit=tolerance)
