"""Records of a witnessed run, and the errors they show; no ROS in here."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..machine.trajectory import Path
from ..pose import Pose, rotation_angle

TRACK_WINDOW = 25
"""How many commands the tool may lag behind the newest one; at 250 Hz a tenth of a second."""


@dataclass
class PoseRecord:
    """What happened at one commanded pose; m, rotation matrices; all poses in one frame, ``base`` at first.

    Attributes
    ----------
    target : Pose
        Commanded pose of the tool.
    command, correction : ndarray, shape (6,)
        Compensated strut commands and their correction, m.
    estimate : Pose
        Estimated pose of the tool with compensation.
    true_without, true_with : Pose or None
        Where the tool really was, when anybody can tell.
    """

    target: Pose
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    estimate: Pose | None = None
    true_without: Pose | None = None
    true_with: Pose | None = None

    def seen_from(self, frame: Pose) -> PoseRecord:
        """Return the same with its poses in another frame, whose own pose is given in the present one."""
        inverse = frame.inverse()
        estimate, without, compensated = (
            None if pose is None else inverse @ pose for pose in (self.estimate, self.true_without, self.true_with)
        )
        target = inverse @ self.target
        return replace(self, target=target, estimate=estimate, true_without=without, true_with=compensated)

    def errors(self) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        """Return (position error m, rotation error rad) without and with compensation."""
        return pose_error(self.target, self.true_without), pose_error(self.target, self.true_with)


@dataclass
class Track:
    """Where the tool really went along a path.

    Attributes
    ----------
    positions : ndarray, shape (n, 3)
        True tool positions on the way, m.
    feet : ndarray, shape (n, 3)
        The nearest point of the commanded path to each, m: a late tool is no contour error.
    """

    positions: np.ndarray
    feet: np.ndarray

    @property
    def deviation(self) -> np.ndarray:
        """Distances to the path, shape (n,), m."""
        return np.linalg.norm(self.positions - self.feet, axis=1)


@dataclass
class PathRecord:
    """What happened along a path.

    Attributes
    ----------
    path : Path
        Commanded poses in ``base``.
    without, compensated : Track or None
        The two passes; None where there was none, or nobody to tell where the tool was.
    corrections : ndarray, shape (N, 6)
        Corrections sent, m.
    """

    path: Path
    without: Track | None
    compensated: Track | None
    corrections: np.ndarray


@dataclass
class SessionResult:
    """Everything that a session has seen.

    Attributes
    ----------
    poses : list of PoseRecord
        The single poses.
    path : PathRecord or None
        The path.
    latencies : ndarray
        Command to answer of the compensated pass, s.
    sent, lost, refused : int
        Commands of the whole session.
    refusals : dict of str to int
        Refused commands by reason.
    model : str
        Model that the compensator ran.
    """

    poses: list[PoseRecord] = field(default_factory=list)
    path: PathRecord | None = None
    latencies: np.ndarray = field(default_factory=lambda: np.zeros(0))
    sent: int = 0
    lost: int = 0
    refused: int = 0
    refusals: dict[str, int] = field(default_factory=dict)
    model: str = ""


def pose_error(target: Pose, actual: Pose | None) -> tuple[float, float] | None:
    """Return distance (m) and angle (rad) between two poses, None when one is unknown."""
    if actual is None:
        return None
    distance = float(np.linalg.norm(actual.position - target.position))
    return distance, rotation_angle(target.rotation.T @ actual.rotation)


def track_along(path: Path, positions: np.ndarray, sent: np.ndarray) -> Track | None:
    """Return true positions with their feet on the commanded polyline.

    Parameters
    ----------
    path : Path
        Commanded poses.
    positions : ndarray, shape (n, 3)
        True tool positions, m.
    sent : ndarray of int, shape (n,)
        How many poses of the path had been sent when each was seen. Only what was commanded within the
        last :data:`TRACK_WINDOW` poses counts, so that a path that crosses itself is not mistaken.
    """
    if not len(positions):
        return None
    start, along = path.positions[:-1], np.diff(path.positions, axis=0)
    square = np.maximum((along**2).sum(axis=1), 1e-30)
    feet = np.empty_like(positions)
    for n, (point, count) in enumerate(zip(positions, sent, strict=True)):
        near = slice(max(0, min(count, len(start)) - TRACK_WINDOW), max(1, min(count, len(start))))
        share = np.clip(((point - start[near]) * along[near]).sum(axis=1) / square[near], 0.0, 1.0)
        candidates = start[near] + share[:, None] * along[near]
        feet[n] = candidates[np.linalg.norm(point - candidates, axis=1).argmin()]
    return Track(positions, feet)
