"""The polish of assembly modes: from start angles to the distinct triangles that close.

Circles and sides as in :mod:`hexapod_comp.machine.elimination`. A start is three angles on three circles; a minimiser
of the three side errors, in the core, runs from it, and what counts as a mode is decided by closure alone.
"""

from __future__ import annotations

import numpy as np

from ..core.batch import settle

NEAR = 0.01
"""Triangles closer than this, relative to the sum of the sides, may be copies of one multiple root."""


def closed_triangles(
    circles: np.ndarray, sides: np.ndarray, starts: np.ndarray, allowed: float, distinct: float
) -> np.ndarray:
    """Return the distinct closed triangles that the minimiser reaches.

    At a root of multiplicity m rounding spreads the solutions over ε^{1/m}, 1e-4 for m = 4, so distance
    alone does not tell copies from neighbours.
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
    settle(circles, sides, angles, points, errors)
    return angles, points, errors
