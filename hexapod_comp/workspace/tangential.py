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

from ..errors import KinematicsError, SingularError
from ..machine.geometry import HexapodGeometry
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
    """Where the iteration ends at each of N poses."""

    # (N, 6): displacement of the tool and its rotation vector, actual minus nominal, along the axes of the work frame;
    # m, rad. NaN where the legs could not be brought back within the tolerance
    vectors: np.ndarray
    drift: np.ndarray  # (N,): largest length error of a passive leg that any step left before correction, m
    travel: np.ndarray  # (N,): how far the active legs went, m
    steps: int  # How many steps
    corrections: np.ndarray  # (N,): how many corrections


@dataclass
class _State:
    """Tool tips (N, 3) and platform orientations (N, 3, 3) in ``base``, and the machine as it is in this step."""

    base: np.ndarray
    platform: np.ndarray
    tool: np.ndarray
    tips: np.ndarray
    rotations: np.ndarray

    def select(self, chosen: np.ndarray) -> _State:
        """Return the same machine at some of the poses."""
        return _State(self.base, self.platform, self.tool, self.tips[chosen], self.rotations[chosen])

    def lengths(self, motions: np.ndarray | None = None) -> np.ndarray:
        """Return the leg lengths, shape (N, 6), m, after motions (x, y, z, a, b, c) of the tool, shape (6,)."""
        tips, rotations = self.moved(np.zeros(6) if motions is None else motions)
        arms = (self.platform - self.tool) @ np.swapaxes(rotations, 1, 2)
        return np.linalg.norm(tips[:, None] + arms - self.base, axis=2)

    def moved(self, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tips and orientations after motions, shape (6,) or (N, 6), about the tips."""
        turns = Rotation.from_rotvec(motions[..., 3:]).as_matrix()
        return self.tips + motions[..., :3], turns @ self.rotations

    def motion_matrices(self) -> np.ndarray:
        """Return V: leg lengths per virtual displacement of the tool, one after another (v. Daake et al., eq. 1–2)."""
        here = self.lengths()
        columns = [(self.lengths(VIRTUAL * axis) - here) / VIRTUAL for axis in np.eye(6)]
        return np.stack(columns, axis=2)

    def follow(self, change: np.ndarray) -> None:
        """Move the tools along the tangents on which the legs change by so much, shape (N, 6).

        v. Daake et al., eq. 3–4: V·R = A.
        """
        try:
            motions = np.linalg.solve(self.motion_matrices(), change[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            raise SingularError("the motion matrix is singular: no leg can move alone") from None
        self.tips, self.rotations = self.moved(motions)


def tangential_effects(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    index: int,
    positions: np.ndarray,
    rotations: np.ndarray,
    step: float = STEP,
    tolerance: float = TOLERANCE,
) -> TangentialResult:
    """Return the effect of one single error at some poses by the paper's iteration.

    A leg of wrong length travels to it in steps, all other legs held. A joint travels to its wrong place in
    steps; its legs are active and take back the length that the joint's travel gives them.
    """
    for name, value in (("step", step), ("tolerance", tolerance)):
        if not 0.0 < value < math.inf:
            raise KinematicsError(f"{name} must be above zero, m, not {value}", value)
    count, none = len(positions), np.zeros(len(positions))
    if errors.part[index] == TOOL:
        shifts = rotations @ errors.vector[index] @ geometry.work.rotation
        return TangentialResult(np.hstack([shifts, np.zeros((count, 3))]), none, none, 0, none.astype(int))
    tips = positions + rotations @ geometry.tool.position
    state = _State(geometry.base_joints, geometry.platform_joints, geometry.tool.position, tips, rotations)
    path = _path(geometry, errors, index, state.lengths(), step)
    return _walk(geometry.work.rotation, state, errors.struts[index], path, tolerance)


Waypoint = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Leg lengths to hold, shape (N, 6), and the base and platform joints."""


def _path(
    geometry: HexapodGeometry, errors: SingleErrors, index: int, nominal: np.ndarray, step: float
) -> list[Waypoint]:
    """Return how the error grows from nothing to its size, in as many steps wherever the machine stands."""
    part, struts, vector = errors.part[index], errors.struts[index], errors.vector[index]
    stretch, size, shift = np.zeros_like(nominal), float(np.linalg.norm(vector)), {}
    if part == LENGTH:
        home = _State(
            geometry.base_joints,
            geometry.platform_joints,
            geometry.tool.position,
            geometry.home.position[None] + geometry.home.rotation @ geometry.tool.position,
            geometry.home.rotation[None],
        ).lengths()[0]
        stretch[:, struts] = vector[0] + vector[1] * (nominal - home)[:, struts] + vector[2] * nominal[:, struts]
        longest = geometry.limits.stroke.max()
        size = abs(vector[0]) + (abs(vector[1]) + abs(vector[2])) * longest
    else:
        shift[part] = struts[:, None] * vector
    path = []
    for share in np.linspace(0.0, 1.0, max(1, math.ceil(size / step - 1e-9)) + 1)[1:]:
        base = geometry.base_joints + share * shift.get(BASE_JOINT, 0.0)
        platform = geometry.platform_joints + share * shift.get(PLATFORM_JOINT, 0.0)
        path.append((nominal + share * stretch, base, platform))
    return path


def _walk(
    work_rotation: np.ndarray, state: _State, struts: np.ndarray, path: list[Waypoint], tolerance: float
) -> TangentialResult:
    """Follow a path with the active legs and see where the tool gets to."""
    start_tips, start_rotations = state.tips, state.rotations
    drift, travel = np.zeros((2, len(start_tips)))
    corrections = np.zeros(len(start_tips), dtype=int)
    for target, state.base, state.platform in path:
        wanted = (target - state.lengths()) * struts
        state.follow(wanted)
        off = np.abs(state.lengths() - target)
        drift = np.maximum(drift, off[:, ~struts].max(axis=1, initial=0.0))
        travel += np.abs(wanted).max(axis=1)
        corrections += _correct(state, target, tolerance)
    turns = Rotation.from_matrix(state.rotations @ np.swapaxes(start_rotations, 1, 2)).as_rotvec()
    vectors = np.hstack([(state.tips - start_tips) @ work_rotation, turns @ work_rotation])
    vectors[(np.abs(state.lengths() - path[-1][0]) > tolerance).any(axis=1)] = np.nan
    return TangentialResult(vectors, drift, travel, len(path), corrections)


def _correct(state: _State, target: np.ndarray, tolerance: float) -> np.ndarray:
    """Bring the legs that are off by more than ε back by the same algorithm; return how often it took, shape (N,)."""
    counts, off = np.zeros(len(target), dtype=int), target - state.lengths()
    for _ in range(MOST_CORRECTIONS):
        poses = np.flatnonzero((np.abs(off) > tolerance).any(axis=1))
        if not len(poses):
            return counts
        some = state.select(poses)
        some.follow(np.where(np.abs(off[poses]) > tolerance, off[poses], 0.0))
        state.tips[poses], state.rotations[poses] = some.tips, some.rotations
        off[poses] = target[poses] - some.lengths()
        counts[poses] += 1
    return counts
