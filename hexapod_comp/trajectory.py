"""Streams of poses for a machine: smooth moves between poses that keep its limits, and milling paths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from .geometry import HexapodGeometry
from .kinematics import Structure, strut_lengths_batch
from .pose import Pose

SHARE_OF_LIMIT = 0.8
"""Moves use this much of the allowed strut speed and step, leaving room for the corrections."""

PEAK_OF_QUINTIC = 1.875
"""Largest slope of the quintic 10t³ − 15t⁴ + 6t⁵."""


@dataclass(frozen=True)
class Path:
    """Poses to be sent one after the other at a constant rate.

    Attributes
    ----------
    positions : ndarray, shape (N, 3)
        m, in the commanded frame.
    rotations : ndarray, shape (N, 3, 3)
        Rotation matrices.
    rate : float
        Poses per second, Hz.
    """

    positions: np.ndarray
    rotations: np.ndarray
    rate: float

    def __len__(self) -> int:
        return len(self.positions)

    def pose(self, index: int) -> Pose:
        """Return one pose."""
        return Pose(self.positions[index], self.rotations[index])


def move(geometry: HexapodGeometry, start: Pose, end: Pose, rate: float, feed: float | None = None) -> Path:
    """Return a smooth straight move between two tool poses that keeps strut speeds and steps.

    Position runs straight, rotation along the shortest arc, both with the quintic 10t³ − 15t⁴ + 6t⁵, which
    starts and ends at rest.

    Parameters
    ----------
    geometry : HexapodGeometry
        Its limits of step and speed set the duration.
    start, end : Pose
        ``pose_tool_in_work``; the start is not part of the path, the end is.
    rate : float
        Poses per second, Hz.
    feed : float, optional
        Largest tool speed, m/s.
    """
    coarse = _interpolate(start, end, np.linspace(0.0, 1.0, 21))
    lengths = _strut_lengths(geometry, *coarse)
    steepest = float(np.abs(np.diff(lengths, axis=0)).max() * 20)
    allowed = SHARE_OF_LIMIT * min(geometry.limits.speed, geometry.limits.step * rate)
    duration = PEAK_OF_QUINTIC * steepest / allowed
    if feed is not None:
        duration = max(duration, PEAK_OF_QUINTIC * float(np.linalg.norm(end.position - start.position)) / feed)
    count = max(1, int(np.ceil(duration * rate)))
    t = np.arange(1, count + 1) / count
    return Path(*_interpolate(start, end, t**3 * (10.0 - 15.0 * t + 6.0 * t * t)), rate)


def circle(centre: Pose, radius: float, feed: float, rate: float) -> Path:
    """Return one full circle in the centre pose's xy plane, starting at its +x side, at constant feed.

    Parameters
    ----------
    centre : Pose
        Centre and orientation of the tool.
    radius : float
        m.
    feed : float
        Tool speed, m/s.
    rate : float
        Poses per second, Hz.
    """
    count = max(8, int(np.ceil(2.0 * np.pi * radius / feed * rate)))
    angle = 2.0 * np.pi * np.arange(count + 1) / count
    offsets = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    positions = centre.position + offsets @ centre.rotation.T
    return Path(positions, np.tile(centre.rotation, (count + 1, 1, 1)), rate)


def pocket(
    geometry: HexapodGeometry, corner: Pose, size: tuple[float, float], pitch: float, feed: float, rate: float
) -> Path:
    """Return a rectangular pocket milled in a zigzag: every row reverses x, so that backlash shows.

    Parameters
    ----------
    geometry : HexapodGeometry
        Its limits bound the speed of each stroke.
    corner : Pose
        Pose at the pocket's lowest x and y.
    size : tuple of float
        Length along x and y, m.
    pitch : float
        Distance of the rows, m.
    feed : float
        Largest tool speed, m/s.
    rate : float
        Poses per second, Hz.
    """
    rows = int(round(size[1] / pitch)) + 1
    corners = []
    for row in range(rows):
        ends = (0.0, size[0]) if row % 2 == 0 else (size[0], 0.0)
        corners += [corner @ Pose(np.array([x, row * pitch, 0.0]), np.eye(3)) for x in ends]
    return join([move(geometry, a, b, rate, feed) for a, b in zip(corners, corners[1:], strict=False)])


def join(paths: list[Path]) -> Path:
    """Return several paths of one rate as one."""
    return Path(
        np.concatenate([path.positions for path in paths]),
        np.concatenate([path.rotations for path in paths]),
        paths[0].rate,
    )


def _interpolate(start: Pose, end: Pose, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    positions = start.position + share[:, None] * (end.position - start.position)
    arc = Slerp([0.0, 1.0], Rotation.from_matrix(np.array([start.rotation, end.rotation])))
    return positions, arc(np.clip(share, 0.0, 1.0)).as_matrix()


def _strut_lengths(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return nominal strut lengths of tool poses in the work frame, shape (N, 6), m."""
    poses = [geometry.work @ Pose(p, r) @ geometry.tool.inverse() for p, r in zip(positions, rotations, strict=True)]
    stacked = np.array([pose.position for pose in poses]), np.array([pose.rotation for pose in poses])
    return strut_lengths_batch(Structure.of(geometry), *stacked, threads=1)
