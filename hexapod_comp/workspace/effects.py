"""Effects of single errors on the tool at many poses (Daake et al.), exact or to first order; extreme effects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..core import batch
from ..errors import KinematicsError
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
from .budget import BASE_JOINT, LENGTH, TOOL, SingleErrors

EXACT, LINEAR = METHODS = ("exact", "linear")


@dataclass(frozen=True)
class Extremes:
    """Extreme displacements and rotations of the tool by each of K error types, and the poses at which they occur."""

    errors: SingleErrors  # all single errors of the K types
    values: np.ndarray  # (K, 4): largest and smallest displacement, m, and rotation, rad; NaN: no solution at any pose
    at_error: np.ndarray  # (K, 4): single error with this effect; −1: no solution at any pose
    positions: np.ndarray  # (K, 4, 3): ``pose_platform_in_base`` with this effect, m
    rotations: np.ndarray  # (K, 4, 3, 3)
    failed: np.ndarray  # (K,): number of effects left out, as forward kinematics found no certified solution
    poses: int


_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])  # with these signs the largest number in each column is the extreme


def effect_vectors(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    threads: int | None = None,
) -> np.ndarray:
    """Return how E errors move the tool at N poses, (N, E, 6) in ``work``: displacement, m; rotation vector, rad."""
    positions, rotations = batch_poses(positions, rotations)
    result = np.empty((len(positions), len(errors), 6))

    def run(rows: slice) -> None:
        for e, vectors in enumerate(_vectors(geometry, errors, positions[rows], rotations[rows], method)):
            result[rows, e] = vectors.T

    over_chunks(run, len(positions), threads)
    return result


def effects(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray, method: str = EXACT
) -> np.ndarray:
    """Return E errors' effects at N poses, (N, E, 2): |displacement|, m; largest |rotation| about x, y or z, rad."""
    return np.moveaxis(_sizes(np.moveaxis(effect_vectors(geometry, errors, positions, rotations, method), 2, 0)), 0, 2)


def extremes(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    threads: int | None = None,
) -> Extremes:
    """Return the extreme effects of each error type over N poses (Daake et al., Table 1)."""
    positions, rotations = batch_poses(positions, rotations)
    parts = {}

    def run(rows: slice) -> None:
        poses = positions[rows], rotations[rows]
        vectors = _vectors(geometry, errors, *poses, method)
        parts[rows.start] = _extremes(errors, vectors, *poses)

    over_chunks(run, len(positions), threads)
    if not parts:
        nowhere = np.full((1, 3), np.nan), np.full((1, 3, 3), np.nan)
        return replace(_extremes(errors, (), *nowhere), poses=0)
    return merged(parts[start] for start in sorted(parts))


def _extremes(
    errors: SingleErrors, vectors: Iterable[np.ndarray], positions: np.ndarray, rotations: np.ndarray
) -> Extremes:
    """Return the extremes over some poses; of equal effects, take that at the first pose, then of the first error."""
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
        at_error=error,
        positions=np.where(found[..., None], positions[pose], nan),
        rotations=np.where(found[..., None, None], rotations[pose], nan),
        failed=failed,
        poses=len(positions),
    )


def merged(parts: Iterable[Extremes]) -> Extremes:
    """Return the extremes over the poses of all parts; of equal effects, take that of the earlier part."""
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
            at_error=np.where(take_b, b.at_error, a.at_error),
            positions=np.where(take_b[..., None], b.positions, a.positions),
            rotations=np.where(take_b[..., None, None], b.rotations, a.rotations),
            failed=a.failed + b.failed,
            poses=a.poses + b.poses,
        )
    if result is None:
        raise KinematicsError("no poses: the workspace is empty", 0)
    return result


def _vectors(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray, method: str
) -> Iterator[np.ndarray]:
    """Yield each error's effect vectors (6, N), from forward kinematics (exact) or the inverse Jacobian (linear)."""
    structure, axes = Structure.of(geometry), np.array(geometry.work.rotation)
    home, lengths = strut_lengths(structure, geometry.home), np.empty((len(positions), 6))
    batch.strut_lengths(*structure.joints, positions, rotations, lengths)
    start = solve_poses(structure, lengths, (positions, rotations), threads=1)  # NaN for refused poses
    before = start.positions, start.rotations
    if method == LINEAR:
        rows = jacobian_batch(structure, *before)
        in_platform = np.einsum("nij,nki->nkj", start.rotations, rows[..., :3])
        per_length = _per_length(geometry, rows, start)
    for part, struts, vector in zip(errors.part, errors.struts, errors.vector, strict=True):
        if part == LENGTH:
            a, b, c = vector
            stretch = a + b * (lengths[:, struts] - home[struts]) + c * lengths[:, struts]
        if part == TOOL:
            vectors = np.zeros((6, len(rotations)))
            vectors[:3] = np.einsum("ik,ni->kn", axes, np.einsum("nij,j->ni", rotations, vector))
            vectors[:, ~start.ok] = np.nan
            yield vectors
        elif method == LINEAR:
            if part != LENGTH:
                stretch = rows[:, struts, :3] @ vector if part == BASE_JOINT else -in_platform[:, struts] @ vector
            yield np.einsum("skn,ns->kn", per_length[struts], stretch)
        else:
            commanded, base, platform = lengths.copy(), np.zeros((6, 3)), np.zeros((6, 3))
            if part == LENGTH:
                commanded[:, struts] += stretch
            else:
                (base if part == BASE_JOINT else platform)[struts] = vector
            after = solve_poses(structure.moved(base, platform), commanded, before, threads=1)
            motions = np.empty((6, len(lengths)))
            batch.motions(*before, after.positions, after.rotations, geometry.tool.position, axes, motions)
            yield motions


def _per_length(geometry: HexapodGeometry, rows: np.ndarray, start: ForwardBatch) -> np.ndarray:
    """Return the tool's motion in ``work`` per metre by which one strut alone grows, shape (6 struts, 6, N)."""
    inverse = np.full((len(rows), 6, 6), np.nan)
    inverse[start.ok] = np.linalg.inv(rows[start.ok])
    columns = inverse.transpose(0, 2, 1)
    lever = np.einsum("nij,j->ni", start.rotations, geometry.tool.position)
    shift, turn = columns[..., :3] + np.cross(columns[..., 3:], lever[:, None]), columns[..., 3:]
    return np.concatenate([np.einsum("ik,nsi->skn", geometry.work.rotation, part) for part in (shift, turn)], axis=1)


def _sizes(vectors: np.ndarray) -> np.ndarray:
    """Return sizes, (2, N), of effect vectors (6, N): |displacement|, largest |rotation| about x, y or z."""
    x, y, z = vectors[:3]
    a, b, c = np.abs(vectors[3:])
    return np.stack([np.sqrt(x * x + y * y + z * z), np.maximum(np.maximum(a, b), c)])
