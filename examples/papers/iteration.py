"""The iteration of v. Daake et al. (chapter 1), compared with the exact effects of single errors.

The iteration uses no code of the core. In small steps it follows the tangent of the motion that one active leg causes.
At each step, virtual displacements of the tool give the motions of all legs by the inverse kinematics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.errors import SingularError
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.pose import attitude_error
from hexapod_comp.workspace.budget import BASE_JOINT, LENGTH, PLATFORM_JOINT, TOOL, SingleErrors
from hexapod_comp.workspace.effects import EXACT, LINEAR, effects
from hexapod_comp.workspace.reach import Reach
from hexapod_comp.workspace.study import random_poses

STEP = 1e-5  # Travel of the active leg per step, m (v. Daake et al.: 0.01 mm)
TOLERANCE = 1e-9  # ε: a leg with a larger length error, m, is corrected
VIRTUAL = 1e-7  # Virtual displacement, m and rad: the errors by curvature and by rounding are small
MOST_CORRECTIONS = 20  # Largest number of corrections in one step


@dataclass(frozen=True)
class TangentialResult:
    """Result of the iteration at each of N poses."""

    # (N, 6): displacement, m, and rotation vector, rad, of the tool, actual minus nominal, along the axes of the work
    # frame. NaN if the length errors of the legs did not come below the tolerance
    vectors: np.ndarray
    drift: np.ndarray  # (N,): largest length error of a passive leg after a step, before its correction, m
    travel: np.ndarray  # (N,): travel of the active legs, m
    steps: int  # number of steps
    corrections: np.ndarray  # (N,): number of corrections


@dataclass
class _State:
    """Tool tips (N, 3) and platform orientations (N, 3, 3) in ``base``, and the joint positions at this step."""

    base: np.ndarray
    platform: np.ndarray
    tool: np.ndarray
    tips: np.ndarray
    rotations: np.ndarray

    def select(self, chosen: np.ndarray) -> _State:
        """Return the state at the chosen poses only."""
        return _State(self.base, self.platform, self.tool, self.tips[chosen], self.rotations[chosen])

    def lengths(self, motions: np.ndarray | None = None) -> np.ndarray:
        """Return the leg lengths, (N, 6), m, after a motion of the tool (translation, rotation vector), shape (6,)."""
        tips, rotations = self.moved(np.zeros(6) if motions is None else motions)
        arms = (self.platform - self.tool) @ np.swapaxes(rotations, 1, 2)
        return np.linalg.norm(tips[:, None] + arms - self.base, axis=2)

    def moved(self, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tips and orientations after motions (translation, rotation vector about the tip), (6,) or (N, 6)."""
        turns = Rotation.from_rotvec(motions[..., 3:]).as_matrix()
        return self.tips + motions[..., :3], turns @ self.rotations

    def motion_matrices(self) -> np.ndarray:
        """Return V: change of the leg lengths per virtual displacement of the tool (v. Daake et al., eq. 1–2)."""
        here = self.lengths()
        columns = [(self.lengths(VIRTUAL * axis) - here) / VIRTUAL for axis in np.eye(6)]
        return np.stack(columns, axis=2)

    def follow(self, change: np.ndarray) -> None:
        """Move the tools along tangents so that the leg lengths change by `change`, shape (N, 6), m, to first order."""
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
    """Return the effect of single error number `index` at poses of the platform, by the paper's iteration."""
    count, none = len(positions), np.zeros(len(positions))
    if errors.part[index] == TOOL:
        shifts = rotations @ errors.vector[index] @ geometry.work.rotation
        return TangentialResult(np.hstack([shifts, np.zeros((count, 3))]), none, none, 0, none.astype(int))
    tips = positions + rotations @ geometry.tool.position
    state = _State(geometry.base_joints, geometry.platform_joints, geometry.tool.position, tips, rotations)
    path = _path(geometry, errors, index, state.lengths(), step)
    return _walk(geometry.work.rotation, state, errors.struts[index], path, tolerance)


# Leg lengths to reach, shape (N, 6), base joints and platform joints at one step
Waypoint = tuple[np.ndarray, np.ndarray, np.ndarray]


def _path(
    geometry: HexapodGeometry, errors: SingleErrors, index: int, nominal: np.ndarray, step: float
) -> list[Waypoint]:
    """Return the waypoints at which the error grows from zero to its size in equal steps."""
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
    """Follow a path with the active legs `struts`, correct the passive legs, and return the final displacements."""
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
    turns = attitude_error(state.rotations, start_rotations)
    vectors = np.hstack([(state.tips - start_tips) @ work_rotation, turns @ work_rotation])
    vectors[(np.abs(state.lengths() - path[-1][0]) > tolerance).any(axis=1)] = np.nan
    return TangentialResult(vectors, drift, travel, len(path), corrections)


def _correct(state: _State, target: np.ndarray, tolerance: float) -> np.ndarray:
    """Correct legs with a length error above the tolerance; return the number of corrections at each pose, (N,)."""
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


@dataclass(frozen=True)
class Agreement:
    """Agreement of the linear and the tangential method with the exact one at random poses."""

    effects: int  # number of compared effects
    # Largest difference from the exact displacement, divided by the largest exact displacement of the same error type
    linear: float
    tangential: float
    drift: float  # largest length error of a passive leg divided by the travel of the active leg, for length errors


def compared(
    geometry: HexapodGeometry, errors: SingleErrors, reaches: tuple[Reach, ...], count: int, seed: int
) -> Agreement:
    """Compare the three methods for all errors except the tool's at `count` random poses of the workspace."""
    moved = errors.select(errors.part != TOOL)
    positions, rotations = random_poses(reaches, count, seed)
    exact = effects(geometry, moved, positions, rotations, EXACT)[..., 0]
    linear = effects(geometry, moved, positions, rotations, LINEAR)[..., 0]
    walked, drift = np.empty_like(exact), 0.0
    for e in range(len(moved)):
        result = tangential_effects(geometry, moved, e, positions, rotations)
        walked[:, e] = np.linalg.norm(result.vectors[:, :3], axis=1)
        travelled = result.travel > 0.0
        if moved.part[e] == LENGTH and travelled.any():
            drift = max(drift, float((result.drift[travelled] / result.travel[travelled]).max()))
    largest = np.array([exact[:, moved.kind == kind].max(initial=0.0) for kind in range(len(moved.kinds))])
    scale = np.where(largest > 0.0, largest, np.inf)[moved.kind]
    return Agreement(
        effects=exact.size,
        linear=float((np.abs(linear - exact) / scale).max()),
        tangential=float((np.abs(walked - exact) / scale).max()),
        drift=drift,
    )
