"""Records of a witnessed run, and the errors they show; no ROS in here."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .pose import Pose, rotation_angle
from .trajectory import Path

TRACK_WINDOW = 40
"""How many commands ahead and behind its last place the tool is looked for on the path."""


@dataclass
class PoseRecord:
    """What happened at one commanded pose; m, rotation matrices.

    Attributes
    ----------
    target : Pose
        Commanded ``pose_tool_in_base``.
    command, correction : ndarray, shape (6,)
        Compensated strut commands and their correction, m.
    estimate : Pose
        Estimated ``pose_tool_in_base`` with compensation.
    true_without, true_with : Pose or None
        Where the tool really was, when anybody can tell.
    """

    target: Pose
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    estimate: Pose | None = None
    true_without: Pose | None = None
    true_with: Pose | None = None

    def errors(self) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        """Return (position error m, rotation error rad) without and with compensation."""
        return pose_error(self.target, self.true_without), pose_error(self.target, self.true_with)


@dataclass
class PathRecord:
    """What happened along a path.

    Attributes
    ----------
    path : Path
        Commanded poses in ``base``.
    track_without, track_with : ndarray, shape (n, 3)
        True tool positions on the way, m.
    deviation_without, deviation_with : ndarray, shape (n,)
        Their distances to the commanded path, m: a late tool is no contour error.
    corrections : ndarray, shape (N, 6)
        Corrections sent, m.
    """

    path: Path
    track_without: np.ndarray
    track_with: np.ndarray
    deviation_without: np.ndarray
    deviation_with: np.ndarray
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


def path_deviation(path: Path, track: np.ndarray) -> np.ndarray:
    """Return the distance of each true position to the commanded polyline, shape (n,), m.

    The track is followed along the path, so that a place where the path crosses itself is not taken for
    the wrong pass.
    """
    start, along = path.positions[:-1], np.diff(path.positions, axis=0)
    square = np.maximum((along**2).sum(axis=1), 1e-30)
    deviation = np.empty(len(track))
    at = 0
    for n, point in enumerate(track):
        near = slice(max(0, at - TRACK_WINDOW), at + TRACK_WINDOW)
        share = np.clip(((point - start[near]) * along[near]).sum(axis=1) / square[near], 0.0, 1.0)
        distance = np.linalg.norm(point - (start[near] + share[:, None] * along[near]), axis=1)
        nearest = int(distance.argmin())
        deviation[n] = distance[nearest]
        at = near.start + nearest
    return deviation
