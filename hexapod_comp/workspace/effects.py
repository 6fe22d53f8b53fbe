"""Effect of every single error at every pose on the tool (v. Daake et al.), exact or to first order."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..core import batch
from ..errors import KinematicsError, SingularError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import (
    ForwardBatch,
    Structure,
    batch_poses,
    jacobian_batch,
    over_chunks,
    solve_poses,
    strut_lengths,
)
from .budget import BASE_JOINT, LENGTH, PLATFORM_JOINT, TOOL, SingleErrors

EXACT, LINEAR, ITERATION = "exact", "linear", "iteration"
METHODS = (EXACT, LINEAR, ITERATION)
# Poses handled together: many compared with the fixed cost of an error, few enough for a processor's cache
BLOCK = 4096


@dataclass(frozen=True)
class Extremes:
    """Largest and smallest effect of each error type, and where they happen."""

    errors: SingleErrors  # The E errors of K types
    values: np.ndarray  # (K, 4): m, m, rad, rad; NaN for a type without any certified effect
    at_pose: np.ndarray  # (K, 4): number of the pose; −1 for none
    at_error: np.ndarray  # (K, 4): which single error
    positions: np.ndarray  # (K, 4, 3): that pose, ``pose_platform_in_base``, m
    rotations: np.ndarray  # (K, 4, 3, 3): that pose, ``pose_platform_in_base``, m
    failed: np.ndarray  # (K,): number of effects without a certified solution, which are left out
    poses: int  # Number of poses


_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])  # signs of the columns of Extremes: which extreme is a maximum


def effect_vectors(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    threads: int | None = None,
) -> np.ndarray:
    """Return displacement of the tool, m, and rotation vector, rad, by every error at every pose, shape (N, E, 6)."""
    return _of_each(geometry, errors, positions, rotations, method, threads, 6, lambda vectors: vectors)


def effects(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    threads: int | None = None,
) -> np.ndarray:
    """Return the size of every error's effect at every pose, shape (N, E, 2): m and rad (v. Daake et al., Results)."""
    return _of_each(geometry, errors, positions, rotations, method, threads, 2, _sizes)


def _of_each(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str,
    threads: int | None,
    width: int,
    wanted: Callable[[np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return the columns of every error's effects, shape (N, E, width)."""
    positions, rotations = batch_poses(positions, rotations)
    each, result = _way(method), np.empty((len(positions), len(errors), width))

    def run(rows: slice) -> None:
        for e, vectors in enumerate(each(geometry, errors, positions[rows], rotations[rows])):
            result[rows, e] = wanted(vectors).T

    over_chunks(run, len(positions), threads, BLOCK)
    return result


def extremes(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    first: int = 0,
    threads: int | None = None,
) -> Extremes:
    """Return the largest and smallest effects of each error type over some poses (v. Daake et al., Table 1)."""
    positions, rotations = batch_poses(positions, rotations)
    each, parts = _way(method), {}

    def run(rows: slice) -> None:
        poses = positions[rows], rotations[rows]
        parts[rows.start] = _extremes(errors, each(geometry, errors, *poses), *poses, first + rows.start)

    over_chunks(run, len(positions), threads, BLOCK)
    if not parts:
        nowhere = np.full((1, 3), np.nan), np.full((1, 3, 3), np.nan)
        return replace(_extremes(errors, (), *nowhere, first), poses=0)
    return merged(parts[start] for start in sorted(parts))


def _extremes(
    errors: SingleErrors, vectors: Iterable[np.ndarray], positions: np.ndarray, rotations: np.ndarray, first: int
) -> Extremes:
    """Return the extremes of a few poses; of equal effects the first pose's first error."""
    best, at = np.full((len(errors), 4), -np.inf), np.zeros((len(errors), 4), int)
    count = len(errors.kinds)
    failed, error = np.zeros(count, int), np.full((count, 4), -1)
    for e, vector in enumerate(vectors):
        signed = _SIGNS[:, None] * _sizes(vector)[[0, 0, 1, 1]]
        missing = np.isnan(signed).any(axis=0)
        signed[:, missing] = -np.inf
        at[e] = signed.argmax(axis=1)
        best[e] = signed[range(4), at[e]]
        failed[errors.kind[e]] += missing.sum()
    for kind, column in np.ndindex(count, 4):
        members = np.flatnonzero((errors.kind == kind) & np.isfinite(best[:, column]))
        if len(members):
            error[kind, column] = members[np.lexsort((at[members, column], -best[members, column]))[0]]
    found, columns = error >= 0, np.arange(4)
    pose, nan = at[error, columns], np.nan
    return Extremes(
        errors=errors,
        values=np.where(found, best[error, columns] * _SIGNS, nan),
        at_pose=np.where(found, pose + first, -1),
        at_error=error,
        positions=np.where(found[..., None], positions[pose], nan),
        rotations=np.where(found[..., None, None], rotations[pose], nan),
        failed=failed,
        poses=len(positions),
    )


def merged(parts: Iterable[Extremes]) -> Extremes:
    """Return the extremes over several parts of a set of poses, given in order; of equal ones the first part's."""
    result: Extremes | None = None
    for b in parts:
        if result is None:
            result = b
            continue
        a = result
        take_b = (b.values * _SIGNS > a.values * _SIGNS) | (np.isnan(a.values) & ~np.isnan(b.values))
        result = replace(
            a,
            values=np.where(take_b, b.values, a.values),
            at_pose=np.where(take_b, b.at_pose, a.at_pose),
            at_error=np.where(take_b, b.at_error, a.at_error),
            positions=np.where(take_b[..., None], b.positions, a.positions),
            rotations=np.where(take_b[..., None, None], b.rotations, a.rotations),
            failed=a.failed + b.failed,
            poses=a.poses + b.poses,
        )
    if result is None:
        raise KinematicsError("no poses to look at: the workspace is empty", 0)
    return result


def _exact(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield the effects of one error after the other by forward kinematics, shape (6, N)."""
    structure = Structure.of(geometry)
    home = strut_lengths(structure, geometry.home)
    lengths, start = _nominal(structure, positions, rotations)
    before, axes = (start.positions, start.rotations), np.array(geometry.work.rotation)
    for part, struts, vector in zip(errors.part, errors.struts, errors.vector, strict=True):
        if part == TOOL:
            yield _tool_shift(geometry, rotations, start.ok, vector)
            continue
        commanded, base, platform = lengths.copy(), np.zeros((6, 3)), np.zeros((6, 3))
        if part == LENGTH:
            commanded[:, struts] += _stretch(vector, lengths[:, struts], home[struts])
        else:
            (base if part == BASE_JOINT else platform)[struts] = vector
        after = solve_poses(structure.moved(base, platform), commanded, before, threads=1)
        motions = np.empty((6, len(lengths)))
        batch.motions(*before, after.positions, after.rotations, geometry.tool.position, axes, motions)
        yield motions


def _linear(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield the effects of one error after the other by the inverse Jacobian, shape (6, N)."""
    structure = Structure.of(geometry)
    home = strut_lengths(structure, geometry.home)
    lengths, start = _nominal(structure, positions, rotations)
    rows = jacobian_batch(structure, start.positions, start.rotations)
    in_platform = np.einsum("nij,nki->nkj", start.rotations, rows[..., :3])
    per_length = _per_length(geometry, rows, start)
    for part, struts, vector in zip(errors.part, errors.struts, errors.vector, strict=True):
        if part == TOOL:
            yield _tool_shift(geometry, rotations, start.ok, vector)
            continue
        if part == LENGTH:
            change = _stretch(vector, lengths[:, struts], home[struts])
        elif part == BASE_JOINT:
            change = rows[:, struts, :3] @ vector
        else:
            change = -in_platform[:, struts] @ vector
        yield np.einsum("skn,ns->kn", per_length[struts], change)


def _iterated(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield the effects of one error after the other by v. Daake et al.'s iteration, shape (6, N)."""
    certified = _nominal(Structure.of(geometry), positions, rotations)[1].ok
    for error in range(len(errors)):
        vectors = np.full((6, len(positions)), np.nan)
        walked = tangential_effects(geometry, errors, error, positions[certified], rotations[certified])
        vectors[:, certified] = walked.vectors.T
        yield vectors


def _way(method: str) -> Callable[..., Iterator[np.ndarray]]:
    """Return the generator of effects of a method."""
    if method not in METHODS:
        raise KinematicsError(f"method must be one of {', '.join(METHODS)}, not {method!r}", method)
    return {EXACT: _exact, LINEAR: _linear, ITERATION: _iterated}[method]


def _nominal(structure: Structure, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, ForwardBatch]:
    """Return the nominal lengths (N, 6), and their certified poses, NaN if there are none."""
    lengths = np.empty((len(positions), 6))
    batch.strut_lengths(*structure.joints, positions, rotations, lengths)
    return lengths, solve_poses(structure, lengths, (positions, rotations), threads=1)


def _stretch(coefficients: np.ndarray, lengths: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Return struts' length errors at their lengths, shape (N, struts), m: a + b·(L − L_home) + c·L."""
    a, b, c = coefficients
    return a + b * (lengths - home) + c * lengths


def _tool_shift(
    geometry: HexapodGeometry, rotations: np.ndarray, certified: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Return the effects of a wrong tool, shape (6, N): its offset along the axes of the work frame."""
    vectors = np.zeros((6, len(rotations)))
    vectors[:3] = np.einsum("ik,ni->kn", geometry.work.rotation, np.einsum("nij,j->ni", rotations, offset))
    vectors[:, ~certified] = np.nan
    return vectors


def _per_length(geometry: HexapodGeometry, rows: np.ndarray, start: ForwardBatch) -> np.ndarray:
    """Return displacement of the tool and turn per length of each strut, shape (6 struts, 6, N), in the work frame."""
    inverse = np.full((len(rows), 6, 6), np.nan)
    inverse[start.ok] = np.linalg.inv(rows[start.ok])
    columns = inverse.transpose(0, 2, 1)
    lever = np.einsum("nij,j->ni", start.rotations, geometry.tool.position)
    shift, turn = columns[..., :3] + np.cross(columns[..., 3:], lever[:, None]), columns[..., 3:]
    return np.concatenate([np.einsum("ik,nsi->skn", geometry.work.rotation, part) for part in (shift, turn)], axis=1)


def _sizes(vectors: np.ndarray) -> np.ndarray:
    """Return displacements and largest rotations about an axis, (6, N) → (2, N)."""
    x, y, z = vectors[:3]
    a, b, c = np.abs(vectors[3:])
    return np.stack([np.sqrt(x * x + y * y + z * z), np.maximum(np.maximum(a, b), c)])


# The iteration of v. Daake et al. (chapter 1), an independent check that shares nothing with the core: tangents to
# the motion that one active leg causes are followed in small steps. Each needs the motion relations of all legs, which
# virtual displacements of the tool give through the inverse kinematics alone.

STEP = 1e-5  # Travel of the active leg per step, m (v. Daake et al.: 0.01 mm)
TOLERANCE = 1e-9  # ε: legs that are off by more, m, are corrected
VIRTUAL = 1e-7  # Virtual displacement, m and rad: small beside any curvature, large beside rounding
MOST_CORRECTIONS = 20  # A step that needs more does not converge


@dataclass(frozen=True)
class TangentialResult:
    """Where the iteration ends at each of N poses."""

    # (N, 6): displacement of the tool and its rotation vector, actual minus nominal, along the axes of the work frame;
    # m, rad. NaN where the legs could not be brought back within the tolerance
    vectors: np.ndarray
    drift: np.ndarray  # (N,): largest length error of a passive leg that any step left before correction, m
    travel: np.ndarray  # (N,): travel of the active legs, m
    steps: int  # How many steps
    corrections: np.ndarray  # (N,): number of corrections


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
        """Move the tools along the tangents on which the legs change by this much, shape (N, 6)."""
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
    """Return the effect of one single error at some poses by the paper's iteration."""
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


# Leg lengths to hold, shape (N, 6), and the base and platform joints
Waypoint = tuple[np.ndarray, np.ndarray, np.ndarray]


def _path(
    geometry: HexapodGeometry, errors: SingleErrors, index: int, nominal: np.ndarray, step: float
) -> list[Waypoint]:
    """Return how the error grows from zero to its size, in equal steps at every pose."""
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
    """Move the active legs along a path step by step; return the tool pose that is reached."""
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
    """Correct the legs that are off by more than ε by the same algorithm; return the number of corrections, shape
    (N,)."""
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
