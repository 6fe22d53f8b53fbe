"""Figures of ISO 230-4:2005 for a circle run in both senses: how round the path is, how large, and how the two differ.

A radial deviation is the radius reached minus the nominal one, positive outwards. What stands off the middle of an
instrument is no error of the machine: each figure has its own centre, which is the standard's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from ..errors import ModelError
from .readings import BACKWARD, FORWARD

SENSES = {"ccw": FORWARD, "cw": BACKWARD}
"""Counter-clockwise and clockwise, seen against the circle's axis."""

FEWEST = 5
"""Readings of one sense below which a circle of its own and a deviation from it cannot be told apart: it has three
unknowns."""

FULL = np.radians(45.0)
"""A circle without a larger gap between its readings is a full one."""

SHORTEST = np.radians(90.0)
"""A shorter arc tells no centre."""

ROUNDS, SETTLED = 5, 1e-9
"""Most times that a centre is moved, radii taken as linear in its shift; a shorter shift, m, ends it."""


@dataclass(frozen=True, eq=False)
class CircularTest:
    """A circular test with its figures, as :func:`evaluate_circle` returns it."""

    radius: float  # of the nominal path, m
    readings: dict[str, int]  # how many in each sense that was run, by :data:`SENSES`
    # by the standard's symbols, m: ``G_ccw`` and ``G_cw``, circular deviations; ``G_b``, the bidirectional one;
    # ``F_max_ccw``, ``F_min_ccw`` and so on, radial deviations; ``D``, the mean bidirectional radial deviation. What
    # the test cannot tell is left out.
    figures: dict[str, float]
    notes: tuple[str, ...]  # where the test departs from the standard's: one sentence each


def evaluate_circle(
    radius: float, angles: np.ndarray, deviations: np.ndarray, senses: np.ndarray, length_known: bool = True
) -> CircularTest:
    """Return the figures of ISO 230-4:2005 for one circle.

    G is the least distance of two concentric circles with the whole path between them; for G(b) with both paths. F is
    taken about the centre of the least-squares circle of its own path, D is by how much the radius of the
    least-squares circle of both paths together exceeds the nominal one.
    """
    path = _checked(radius, angles, deviations, senses)
    parts = {name: [column[path[2] == sense] for column in path[:2]] for name, sense in SENSES.items()}
    parts = {name: part for name, part in parts.items() if len(part[0])}
    figures = {f"G_{name}": _separation(radius, *part) for name, part in parts.items()}
    if len(parts) == 2:
        figures["G_b"] = _separation(radius, *path[:2])
    full = all(_largest_gap(part[0]) <= FULL for part in parts.values())
    if full and length_known:
        for name, part in parts.items():
            radial = _from_least_squares_centre(radius, *part)
            figures |= {f"F_max_{name}": float(radial.max()), f"F_min_{name}": float(radial.min())}
        if len(parts) == 2:
            figures["D"] = float(_from_least_squares_centre(radius, *path[:2]).mean())
    return CircularTest(radius, {n: len(p[0]) for n, p in parts.items()}, figures, _notes(parts, full, length_known))


def _checked(
    radius: float, angles: np.ndarray, deviations: np.ndarray, senses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angles, deviations and senses as arrays that can be judged."""
    columns = [np.asarray(values, dtype=float) for values in (angles, deviations, senses)]
    if columns[0].ndim != 1 or any(column.shape != columns[0].shape for column in columns):
        problem = "angles, deviations and senses must be lists of one length"
        raise ModelError("circle", problem, [column.shape for column in columns])
    if not (np.isfinite(radius) and radius > 0.0):
        raise ModelError("radius", "must be finite and above zero, m", radius)
    for name, column in zip(("angles", "deviations"), columns, strict=False):
        if not np.isfinite(column).all():
            raise ModelError(name, "must be finite", float(column[~np.isfinite(column)][0]))
    wrong = ~np.isin(columns[2], list(SENSES.values()))
    if wrong.any():
        raise ModelError("senses", f"must be {FORWARD} or {BACKWARD}", float(columns[2][wrong][0]))
    for name, sense in SENSES.items():
        members = columns[0][columns[2] == sense]
        if 0 < len(members) < FEWEST or not len(columns[0]):
            raise ModelError(f"circle, {name}", f"needs at least {FEWEST} readings", len(members))
        if len(members) and 2.0 * np.pi - _largest_gap(members) < SHORTEST:
            raise ModelError(f"circle, {name}", f"readings must span at least {np.degrees(SHORTEST):g}°")
    return columns[0], columns[1], columns[2]


def _largest_gap(angles: np.ndarray) -> float:
    """Return the largest angle without a reading, rad."""
    turned = np.sort(np.mod(angles, 2.0 * np.pi))
    return float(np.diff(turned, append=turned[0] + 2.0 * np.pi).max())


def _seen_from(
    centre: np.ndarray, radius: float, angles: np.ndarray, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return radial deviations if the instrument stood at a centre, (n,), m, and unit vectors from there, (n, 2)."""
    arms = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) - centre
    distances = np.linalg.norm(arms, axis=1)
    return radius + deviations - distances, arms / distances[:, None]


def _separation(radius: float, angles: np.ndarray, deviations: np.ndarray) -> float:
    """Return the least radial distance of two concentric circles with all readings between them, m."""
    centre = np.zeros(2)
    for _ in range(ROUNDS):
        radial, away = _seen_from(centre, radius, angles, deviations)
        # Of inner and outer deviation and the centre's shift: the distance of the first two, all readings between.
        scale = max(float(np.ptp(radial)), np.finfo(float).tiny)
        ones, zeros = np.ones((len(radial), 1)), np.zeros((len(radial), 1))
        bounds = np.vstack([np.hstack([ones, zeros, -away]), np.hstack([zeros, -ones, away])])
        offset = (radial - radial.mean()) / scale
        answer = linprog([-1.0, 1.0, 0.0, 0.0], bounds, np.concatenate([offset, -offset]), bounds=(None, None))
        shift = scale * answer.x[2:]
        centre = centre + shift
        if np.linalg.norm(shift) < SETTLED:
            break
    return float(np.ptp(_seen_from(centre, radius, angles, deviations)[0]))


def _from_least_squares_centre(radius: float, angles: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return radial deviations seen from the centre of the least-squares circle, shape (n,), m."""
    centre = np.zeros(2)
    for _ in range(ROUNDS):
        radial, away = _seen_from(centre, radius, angles, deviations)
        columns = np.hstack([np.ones((len(radial), 1)), -away])
        centre = centre + np.linalg.lstsq(columns, radial, rcond=None)[0][1:]
    return _seen_from(centre, radius, angles, deviations)[0]


def _notes(parts: dict[str, list[np.ndarray]], full: bool, length_known: bool) -> tuple[str, ...]:
    """Return where a test departs from the standard's."""
    notes = []
    if len(parts) < 2:
        notes.append(f"run {next(iter(parts))} only: no G(b), no D; the standard's test runs both senses")
    if not full:
        notes.append("no full circle: F and D need one, and G of an arc is smaller")
    if full and not length_known:
        notes.append("the instrument's length is not calibrated: no F, no D")
    return tuple(notes)
