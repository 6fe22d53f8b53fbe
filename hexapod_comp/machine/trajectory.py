"""Straight moves from rest to rest, as tool poses to send at a constant rate; and distances of points from a path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import GeometryError
from ..pose import Pose, attitude_error, best_motion, rotation_angle, rotation_from_vector
from .geometry import HexapodGeometry
from .kinematics import Structure, strut_lengths_batch

SHARE_OF_LIMIT = 0.8  # Share of the limits of strut speed and step that moves use; corrections need the other 0.2
PEAK_OF_QUINTIC = 1.875  # Largest slope of the quintic 10t³ − 15t⁴ + 6t⁵
BEND_OF_QUINTIC = 10.0 / 3.0**0.5  # Largest second derivative of the quintic 10t³ − 15t⁴ + 6t⁵
TRACK_WINDOW = 25  # Number of commands by which the tool may lag behind the newest command; 0.1 s at 250 Hz
# `motion_onto`: largest number of points; largest number of iterations; step, m and rad, below which iterations end
MOST_ALIGNED, ALIGNING_STEPS, SETTLED = 5000, 200, 1e-9
COARSE = 20  # Number of sections of a move on which the change of each strut's length is computed


@dataclass(frozen=True)
class Path:
    """A sequence of poses to be sent at a constant rate."""

    positions: np.ndarray  # (N, 3): m, in the commanded frame
    rotations: np.ndarray  # (N, 3, 3): rotation matrices
    rate: float  # Poses per second, Hz

    def __len__(self) -> int:
        return len(self.positions)

    def pose(self, index: int) -> Pose:
        return Pose(self.positions[index], self.rotations[index])


def check_rate(rate: float) -> None:
    if not (np.isfinite(rate) and rate > 0.0):
        raise GeometryError("rate", "must be finite and positive, Hz", rate)


def move(geometry: HexapodGeometry, start: Pose, end: Pose, rate: float, feed: float = np.inf) -> Path:
    """Return a straight move from rest to rest at a rate, Hz, as fast as `feed`, m/s, and the struts' limits allow."""
    positions = np.array([start.position, end.position])
    return moves(geometry, positions, np.array([start.rotation, end.rotation]), rate, feed)[0]


def moves(
    geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, rate: float, feed: float = np.inf
) -> tuple[Path, np.ndarray]:
    """Return moves (see :func:`move`) through N tool poses, with a stop at each, and each move's number of poses."""
    check_rate(rate)
    if not feed > 0.0:
        raise GeometryError("feed", "must be positive, m/s", feed)
    legs = np.arange(len(positions) - 1)
    share = np.tile(np.linspace(0.0, 1.0, COARSE + 1), len(legs))
    coarse = _interpolate(positions, rotations, np.repeat(legs, COARSE + 1), share)
    lengths = strut_lengths_batch(Structure.of(geometry), *geometry.platform_poses(*coarse), threads=1)
    changes = np.abs(np.diff(lengths.reshape(len(legs), COARSE + 1, 6), axis=1))
    allowed = SHARE_OF_LIMIT * min(geometry.limits.speed, geometry.limits.step * rate)
    duration = PEAK_OF_QUINTIC * COARSE * changes.max(axis=(1, 2)) / allowed
    if geometry.limits.acceleration:
        # Bound of l'' = l_s s'' + l_ss s'² for strut length l at share s of the way, from each factor's largest value
        bends = np.abs(np.diff(lengths.reshape(len(legs), COARSE + 1, 6), 2, axis=1)).max(axis=(1, 2), initial=0.0)
        worst = BEND_OF_QUINTIC * COARSE * changes.max(axis=(1, 2)) + (PEAK_OF_QUINTIC * COARSE) ** 2 * bends
        duration = np.maximum(duration, np.sqrt(worst / (SHARE_OF_LIMIT * geometry.limits.acceleration)))
    travel = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    duration = np.maximum(duration, PEAK_OF_QUINTIC * travel / feed)
    counts = np.maximum(1, np.ceil(duration * rate).astype(int))
    leg = np.repeat(legs, counts)
    t = (np.arange(len(leg)) - (np.cumsum(counts) - counts)[leg] + 1) / counts[leg]
    return Path(*_interpolate(positions, rotations, leg, quintic(t)), rate), counts


def quintic(t: np.ndarray) -> np.ndarray:
    """Return 10t³ − 15t⁴ + 6t⁵, which rises from 0 to 1 with zero slope and zero second derivative at both ends."""
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def commanded_in_base(geometry: HexapodGeometry) -> HexapodGeometry:
    """Return the machine with its work frame at ``base``, so that tool poses are in ``base``."""
    return replace(geometry, work=Pose.identity())


def feet_on(corners: np.ndarray, points: np.ndarray, sent: np.ndarray) -> np.ndarray:
    """Return for each of n points the nearest point, (n, 3), m, of a polyline of commanded corners. `sent` is for each
    point the index of the last corner that had been commanded when the machine was at the point.
    """
    start, along = corners[:-1], np.diff(corners, axis=0)
    square = np.maximum((along**2).sum(axis=1), 1e-30)
    newest = np.clip(sent, 1, len(start))
    feet, nearest = np.array(points), np.full(len(points), np.inf)
    for back in range(TRACK_WINDOW):
        leg = np.maximum(newest - 1 - back, 0)
        share = np.clip(((points - start[leg]) * along[leg]).sum(axis=1) / square[leg], 0.0, 1.0)
        candidates = start[leg] + share[:, None] * along[leg]
        distance = np.linalg.norm(points - candidates, axis=1)
        closer = distance < nearest
        feet[closer], nearest[closer] = candidates[closer], distance[closer]
    return feet


def motion_onto(corners: np.ndarray, points: np.ndarray, sent: np.ndarray) -> Pose | None:
    """Return the rigid motion that brings points closest to a commanded polyline; None if the points are collinear."""
    every = max(1, len(points) // MOST_ALIGNED)
    points, sent, motion = points[::every], sent[::every], Pose.identity()
    for _ in range(ALIGNING_STEPS):
        moved = motion.transform(points)
        step = best_motion(moved, feet_on(corners, moved, sent))
        if step is None:
            return None
        motion = step @ motion
        if np.linalg.norm(step.position) < SETTLED and rotation_angle(step.rotation) < SETTLED:
            break
    return motion


def join(paths: list[Path]) -> Path:
    return Path(
        np.concatenate([path.positions for path in paths]),
        np.concatenate([path.rotations for path in paths]),
        paths[0].rate,
    )


def _interpolate(
    positions: np.ndarray, rotations: np.ndarray, leg: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return K poses: pose k is at the fraction `share[k]` of leg `leg[k]`, a straight line with the shortest turn."""
    travel = np.diff(positions, axis=0)
    turn = attitude_error(rotations[1:], rotations[:-1])
    turned = rotation_from_vector(share[:, None] * turn[leg]) @ rotations[leg]
    return positions[leg] + share[:, None] * travel[leg], turned
