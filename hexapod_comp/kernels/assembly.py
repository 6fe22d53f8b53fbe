"""The polish of assembly modes, compiled: from start angles to the distinct triangles that close.

Circles and sides as in :mod:`hexapod_comp.machine.elimination`. A start is three angles on three circles;
a minimiser of the three side errors runs from it, and what counts as a mode is decided by closure alone.
"""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .linalg import combine, dot, internal, inverse_columns

NEAR = 0.01
"""Triangles closer than this, relative to the sum of the sides, may be copies of one multiple root."""

MOST_STEPS = 60
"""Steps of the minimiser; more than a few are needed only at multiple roots, where it converges linearly."""


def closed_triangles(
    circles: np.ndarray, sides: np.ndarray, starts: np.ndarray, allowed: float, distinct: float
) -> np.ndarray:
    """Return the distinct closed triangles that the minimiser reaches.

    At a root of multiplicity m rounding spreads the solutions over ε^{1/m}, 1e-4 for m = 4, so distance
    alone does not tell copies from neighbours.

    Parameters
    ----------
    circles : ndarray, shape (3, 3, 3)
        Rows (centre, p, q) of each, m, in ``base``.
    sides : ndarray, shape (3,)
        |T1 − T2|, |T2 − T3|, |T3 − T1|, m.
    starts : ndarray, shape (K, 3)
        φ1, φ2, φ3, rad.
    allowed : float
        Largest error of a side, m.
    distinct : float
        Triangles whose corners all lie closer than this, m, are one.

    Returns
    -------
    ndarray, shape (M, 3, 3)
        T1..T3 as rows, in ``base``, m; of copies the one that closes best.
    """
    angles, points, errors = _settled(circles, sides, starts)
    left = errors.argsort()
    left = left[: int((errors <= allowed).sum())]
    corners = []
    while len(left):
        best, left = left[0], left[1:]
        corners.append(points[best])
        apart = np.abs(points[left] - points[best]).max(axis=(1, 2))
        new = apart >= distinct
        near = new & (apart < NEAR * sides.sum())
        if near.any():
            new[near] = ~_closed_between(circles, sides, angles[left[near]], angles[best], allowed)
        left = left[new]
    return np.array(corners).reshape(-1, 3, 3)


def _closed_between(
    circles: np.ndarray, sides: np.ndarray, angles: np.ndarray, other: np.ndarray, allowed: float
) -> np.ndarray:
    """Return for each of (N, 3) solutions whether the loops also close between it and the other, (3,).

    Then the two are one multiple root. A start between two modes either stays open or runs to one of them;
    between two copies it closes on the spot. It is not taken halfway, where symmetry likes to put a third.
    """
    turn = other - angles
    turn -= 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
    starts = angles + 0.38 * turn
    ends, _, errors = _settled(circles, sides, starts)
    moved = np.abs(ends - starts).max(axis=1)
    return (errors <= allowed) & (moved < 0.1 * np.abs(turn).max(axis=1))


def _settled(circles: np.ndarray, sides: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angles (N, 3), corners (N, 3, 3), m, and largest side errors (N,), m, that starts lead to."""
    angles, points, errors = starts.copy(), np.empty((len(starts), 3, 3)), np.empty(len(starts))
    settle_many(circles, sides, angles, points, errors)
    return angles, points, errors


@compiled
def settle_many(circles, sides, angles, points, errors):
    """Minimise the side errors from N starts; `angles` in place, `points` and `errors` overwritten."""
    for n in range(len(angles)):
        errors[n] = _settle(circles, sides, angles[n], points[n])


@internal
def _settle(circles, sides, angles, points):
    """Minimise the side errors over the angles, in place (Levenberg-Marquardt); return the largest, m.

    A minimiser rather than Newton: at a double root the Jacobian is singular, where Newton would be thrown
    out of reach by rounding.
    """
    jacobian, tangents, errors, trial = np.zeros((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    cost = _side_errors(circles, sides, angles, points, tangents, errors, jacobian)
    rounding = (2e-16 * (sides[0] + sides[1] + sides[2])) ** 2
    damping = 1e-6
    for _ in range(MOST_STEPS):
        if cost <= rounding or damping > 1e6:
            break
        step = _damped_step(jacobian, errors, damping)
        for i in range(3):
            trial[i] = angles[i] - step[i]
        next_cost = _side_errors(circles, sides, trial, points, tangents, errors, jacobian)
        if next_cost < cost:
            for i in range(3):
                angles[i] = trial[i]
            cost, damping = next_cost, 0.1 * damping
        else:
            damping = 10.0 * max(damping, 1e-12)
            _side_errors(circles, sides, angles, points, tangents, errors, jacobian)
    return max(abs(errors[0]), abs(errors[1]), abs(errors[2]))


@internal
def _side_errors(circles, sides, angles, points, tangents, errors, jacobian):
    """Write points, tangents, errors (|T_i − T_j|² − a²)/(2a), m, and ∂errors/∂φ; return Σ errors²."""
    for i in range(3):
        c, s = math.cos(angles[i]), math.sin(angles[i])
        for k in range(3):
            points[i, k] = circles[i, 0, k] + c * circles[i, 1, k] + s * circles[i, 2, k]
            tangents[i, k] = c * circles[i, 2, k] - s * circles[i, 1, k]
    cost = 0.0
    for i in range(3):
        j = (i + 1) % 3
        apart = (points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2])
        errors[i] = (dot(apart, apart) - sides[i] * sides[i]) / (2.0 * sides[i])
        jacobian[i, i] = dot(apart, tangents[i]) / sides[i]
        jacobian[i, j] = -dot(apart, tangents[j]) / sides[i]
        cost += errors[i] * errors[i]
    return cost


@internal
def _damped_step(jacobian, errors, damping):
    """Return (JᵀJ + damping·tr(JᵀJ)·1)⁻¹·Jᵀ·errors, rad; zero where that has no inverse."""
    x, y, z = jacobian[:, 0], jacobian[:, 1], jacobian[:, 2]
    xx, yy, zz, xy, xz, yz = dot(x, x), dot(y, y), dot(z, z), dot(x, y), dot(x, z), dot(y, z)
    added = damping * (xx + yy + zz)
    a, b, c, determinant = inverse_columns((xx + added, xy, xz), (xy, yy + added, yz), (xz, yz, zz + added))
    if not abs(determinant) > 0.0:
        return 0.0, 0.0, 0.0
    return combine((dot(x, errors), dot(y, errors), dot(z, errors)), a, b, c)
