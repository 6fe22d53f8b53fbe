"""Effect of every single error at every pose on the tool (paper 004), exact or to first order.

The effect of an error is where the tool of the machine with that one error stands, told the nominal strut
lengths of a pose, beside where it should stand: Euclidean distance, and the largest of the three components of
the rotation vector about the axes of the work frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import KinematicsError
from ..kernels.effects import effect_vectors_many, extremes_many, sizes_many
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, over_chunks, strut_lengths
from .sources import SingleErrors

EXACT, LINEAR = "exact", "linear"
METHODS = (EXACT, LINEAR)

COLUMNS = ("translation max", "translation min", "rotation max", "rotation min")
"""Columns of :class:`Extremes`."""


@dataclass(frozen=True)
class Extremes:
    """Largest and smallest effect of each error type, and where they happen; columns as in :data:`COLUMNS`.

    Attributes
    ----------
    errors : SingleErrors
        The E errors of K types.
    values : ndarray, shape (K, 4)
        m, m, rad, rad; NaN for a type without any effect to be had.
    at_pose : ndarray of int, shape (K, 4)
        Number of the pose; −1 for none.
    at_error : ndarray of int, shape (K, 4)
        Which single error.
    positions, rotations : ndarray, shape (K, 4, 3), (K, 4, 3, 3)
        That pose, ``pose_platform_in_base``, m.
    failed : ndarray of int, shape (K,)
        Effects without a certified solution: they are left out and counted.
    poses : int
        How many poses were looked at.
    """

    errors: SingleErrors
    values: np.ndarray
    at_pose: np.ndarray
    at_error: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    failed: np.ndarray
    poses: int


def effect_vectors(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    threads: int | None = None,
) -> np.ndarray:
    """Return what every error does to the tool at every pose, with its direction.

    Parameters
    ----------
    geometry : HexapodGeometry
        The nominal machine, with its tool and work frames.
    errors : SingleErrors
        E errors, each acting alone.
    positions, rotations : array_like, shape (N, 3), (N, 3, 3)
        Nominal ``pose_platform_in_base``, m.
    method : str
        ``exact``: forward kinematics of the machine with the error, loops closed to rounding. ``linear``: by the
        nominal machine's Jacobian.
    threads : int, optional
        Threads to use; all cores by default.

    Returns
    -------
    ndarray, shape (N, E, 6)
        Displacement of the tool tip, m, and rotation vector, rad, actual minus nominal, along the axes of the
        work frame. NaN where the pose is not finite, singular, above the limit of the condition number or in
        another assembly mode, and where the machine with the error cannot close its loops.

    Raises
    ------
    KinematicsError
        Shapes do not fit, or the method is unknown.
    """
    positions, rotations = _poses(positions, rotations)
    machine, parts, exact = _arguments(geometry, errors, method)
    vectors = np.empty((len(positions), len(errors), 6))

    def run(rows: slice) -> None:
        effect_vectors_many(machine, positions[rows], rotations[rows], parts, exact, vectors[rows])

    over_chunks(run, len(positions), threads)
    return vectors


def effects(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    threads: int | None = None,
) -> np.ndarray:
    """Return the size of every error's effect at every pose, shape (N, E, 2): m and rad (004, Results).

    Arguments and errors as for :func:`effect_vectors`.
    """
    positions, rotations = _poses(positions, rotations)
    machine, parts, exact = _arguments(geometry, errors, method)
    sizes = np.empty((len(positions), len(errors), 2))

    def run(rows: slice) -> None:
        vectors = np.empty((rows.stop - rows.start, len(errors), 6))
        effect_vectors_many(machine, positions[rows], rotations[rows], parts, exact, vectors)
        sizes_many(vectors, sizes[rows])

    over_chunks(run, len(positions), threads)
    return sizes


def extremes(
    geometry: HexapodGeometry,
    errors: SingleErrors,
    positions: np.ndarray,
    rotations: np.ndarray,
    method: str = EXACT,
    first: int = 0,
    threads: int | None = None,
) -> Extremes:
    """Return the largest and smallest effects of each error type over some poses (004, Table 1).

    Of more poses than memory takes, hand over one part after the other and join the results with :func:`merged`:
    they are the same to the last bit however the poses are parted.

    Parameters
    ----------
    first : int
        Number of the first of these poses. The other arguments are those of :func:`effect_vectors`.
    """
    positions, rotations = _poses(positions, rotations)
    machine, parts, exact = _arguments(geometry, errors, method)
    kinds, types = np.array(errors.kind, dtype=np.int64), len(errors.kinds)
    of_slice: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def run(rows: slice) -> None:
        values = np.tile([-np.inf, np.inf, -np.inf, np.inf], (types, 1))
        at, failed = np.full((types, 4, 2), -1), np.zeros(types, np.int64)
        extremes_many(machine, positions[rows], rotations[rows], parts, exact, kinds, values, at, failed)
        at[..., 0] += np.where(at[..., 0] < 0, 0, rows.start)
        of_slice[rows.start] = values, at, failed

    over_chunks(run, len(positions), threads)
    slices = [of_slice[start] for start in sorted(of_slice)]
    failed = np.array([part[2] for part in slices], np.int64).reshape(-1, types)
    values, at = _first_best(
        np.array([part[0] for part in slices]).reshape(-1, types, 4),
        np.array([part[1] for part in slices], int).reshape(-1, types, 4, 2),
    )
    found = at[..., 0] >= 0
    return Extremes(
        errors=errors,
        values=np.where(found, values, np.nan),
        at_pose=np.where(found, at[..., 0] + first, -1),
        at_error=at[..., 1],
        positions=_picked(positions, at[..., 0], found),
        rotations=_picked(rotations, at[..., 0], found),
        failed=failed.sum(axis=0),
        poses=len(positions),
    )


def merged(parts: Iterable[Extremes]) -> Extremes:
    """Return the extremes over several parts of a set of poses, given in the order of their poses.

    Raises
    ------
    KinematicsError
        There are no parts.
    """
    result: Extremes | None = None
    for part in parts:
        result = part if result is None else _merged_pair(result, part)
    if result is None:
        raise KinematicsError("no poses to look at: the workspace is empty", 0)
    return result


def _merged_pair(a: Extremes, b: Extremes) -> Extremes:
    """Return the extremes over two parts; equal ones are a's."""
    higher = b.values * _SIGNS > a.values * _SIGNS
    take_b = higher | (np.isnan(a.values) & ~np.isnan(b.values))
    return replace(
        a,
        values=np.where(take_b, b.values, a.values),
        at_pose=np.where(take_b, b.at_pose, a.at_pose),
        at_error=np.where(take_b, b.at_error, a.at_error),
        positions=np.where(take_b[..., None], b.positions, a.positions),
        rotations=np.where(take_b[..., None, None], b.rotations, a.rotations),
        failed=a.failed + b.failed,
        poses=a.poses + b.poses,
    )


_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])


def _first_best(values: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the best of several slices, (S, K, 4) → (K, 4); the first of equals."""
    best = np.argmax(values * _SIGNS, axis=0)[None] if len(values) else np.empty((0, *values.shape[1:]), int)
    if not len(best):
        return np.full(values.shape[1:], np.nan), np.full(at.shape[1:], -1)
    return np.take_along_axis(values, best, 0)[0], np.take_along_axis(at, best[..., None], 0)[0]


def _picked(rows: np.ndarray, at: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return the rows at some indices, NaN where nothing was found."""
    picked = np.full((*at.shape, *rows.shape[1:]), np.nan)
    picked[found] = rows[at[found]]
    return picked


def _arguments(geometry: HexapodGeometry, errors: SingleErrors, method: str) -> tuple[tuple, tuple, bool]:
    """Return machine and errors as the kernels take them, and whether to be exact.

    Raises
    ------
    KinematicsError
        The method is unknown.
    """
    if method not in METHODS:
        raise KinematicsError(f"method must be one of {', '.join(METHODS)}, not {method!r}", method)
    structure = Structure.of(geometry)
    certificate = [geometry.characteristic_length, geometry.home_sign, geometry.limits.condition]
    machine = (
        *geometry.kernel_joints,
        strut_lengths(structure, geometry.home),
        np.array(geometry.tool.position),
        np.array(geometry.work.rotation),
        np.array(certificate),
    )
    parts = (
        np.array(errors.part, dtype=np.int64),
        np.array(errors.strut, dtype=np.int64),
        np.array(errors.vector, dtype=float, order="C"),
    )
    return machine, parts, method == EXACT


def _poses(positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return poses as the kernels take them: contiguous, a single rotation (3, 3) for all of them spread.

    Raises
    ------
    KinematicsError
        Their shapes are wrong.
    """
    positions = np.ascontiguousarray(positions, dtype=float)
    rotations = np.asarray(rotations, dtype=float)
    if rotations.shape == (3, 3):
        rotations = np.broadcast_to(rotations, (len(positions), 3, 3))
    if positions.ndim != 2 or positions.shape[1] != 3 or rotations.shape != (len(positions), 3, 3):
        problem = f"poses must have shapes (N, 3) and (N, 3, 3), not {positions.shape} and {rotations.shape}"
        raise KinematicsError(problem, positions.shape)
    return positions, np.array(rotations, order="C")
