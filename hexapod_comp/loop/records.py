"""Records of a witnessed run, and the errors they show, as they are and with the datum aligned; no ROS in here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..machine.trajectory import Path, feet_on
from ..pose import Pose, best_motion, rotation_angle

FEWEST_ALIGNED = 6
"""A datum takes six numbers away, two poses' worth: from fewer poses hardly anything would be left."""

LATE_SHARE, WAITED_SHARE = 0.02, 0.2
"""A computer is called busy when more of its answers are late, or when its processes wait for more of the time."""


@dataclass
class PoseRecord:
    """What happened at one commanded pose; m, rotation matrices; all poses in one frame, ``base`` at first."""

    target: Pose  # commanded pose of the tool
    # (6,): compensated strut commands and their correction, m
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    # (6,): compensated strut commands and their correction, m
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))
    estimate: Pose | None = None  # estimated pose of the tool with compensation
    true_without: Pose | None = None  # where the tool really was, when anybody can tell
    true_with: Pose | None = None  # where the tool really was, when anybody can tell

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
    """Where the tool really went along a path."""

    positions: np.ndarray  # (n, 3): true tool positions on the way, m
    sent: np.ndarray  # (n,) int: how many poses of the path had been sent when each was seen
    feet: np.ndarray  # (n, 3): the nearest point of the commanded path to each, m: a late tool is no contour error

    @staticmethod
    def along(path: Path, positions: np.ndarray, sent: np.ndarray) -> Track | None:
        """Return the track of true positions, shape (n, 3), m, along a path; None when there are none."""
        return Track(positions, sent, feet_on(path.positions, positions, sent)) if len(positions) else None

    @property
    def deviation(self) -> np.ndarray:
        """Distances to the path, shape (n,), m."""
        return np.linalg.norm(self.positions - self.feet, axis=1)


@dataclass
class PathRecord:
    """What happened along a path."""

    path: Path  # commanded poses, in ``base`` at first
    without: Track | None  # the two passes; None where there was none, or nobody to tell where the tool was
    compensated: Track | None  # the two passes; None where there was none, or nobody to tell where the tool was
    corrections: np.ndarray  # (N, 6): corrections sent, m

    def seen_from(self, frame: Pose) -> PathRecord:
        """Return the same in another frame, whose own pose is given in the present one."""
        inverse = frame.inverse()
        path = Path(_moved(inverse, self.path.positions), inverse.rotation @ self.path.rotations, self.path.rate)
        return self._with(path, (inverse, inverse))

    def aligned(self, datums: tuple[Pose | None, Pose | None]) -> PathRecord:
        """Return the same with each pass's true positions moved by its datum; a pass without a datum is left out."""
        return self._with(self.path, datums)

    def _with(self, path: Path, motions: tuple[Pose | None, Pose | None]) -> PathRecord:
        without, compensated = (
            None if track is None or motion is None else Track.along(path, _moved(motion, track.positions), track.sent)
            for track, motion in zip((self.without, self.compensated), motions, strict=True)
        )
        return replace(self, path=path, without=without, compensated=compensated)


@dataclass
class Answering:
    """How fast the loop answered, and what kept it waiting."""

    latencies: np.ndarray = field(default_factory=lambda: np.zeros(0))  # command to answer of the compensated pass, s
    # commands of the whole session that were answered, and those of which the answer came after the next was due
    answered: int = 0
    # commands of the whole session that were answered, and those of which the answer came after the next was due
    late: int = 0
    longest: float = 0.0  # longest time to an answer in the whole session, s
    elapsed: float = 0.0  # length of the session, s
    waited: float = 0.0  # how long its processes waited for a processor, added up, s

    @property
    def busy(self) -> bool:
        """Whether something else kept the processors: a share of the answers was late, or the processes waited long."""
        return self.late > LATE_SHARE * self.answered or self.waited > WAITED_SHARE * self.elapsed


@dataclass
class SessionResult:
    """Everything that a session has seen."""

    poses: list[PoseRecord] = field(default_factory=list)  # the single poses
    path: PathRecord | None = None  # the path
    answering: Answering = field(default_factory=Answering)  # how fast the loop answered
    sent: int = 0  # commands of the whole session
    lost: int = 0  # commands of the whole session
    refused: int = 0  # commands of the whole session
    refusals: dict[str, int] = field(default_factory=dict)  # refused commands by reason
    model: str = ""  # model that the compensator ran

    def seen_from(self, frame: Pose) -> SessionResult:
        """Return the same in another frame, whose own pose is given in the present one."""
        path = None if self.path is None else self.path.seen_from(frame)
        return replace(self, poses=[record.seen_from(frame) for record in self.poses], path=path)

    def aligned(self) -> SessionResult | None:
        """Return the same once the datum is aligned: each pass by the rigid motion that fits its poses best.

        A path is moved by its pass's poses, as a workpiece whose zero was set by them. None with fewer than
        :data:`FEWEST_ALIGNED` poses, with poses in a line, or when nobody told where the tool was.
        """
        before = _datum(self.poses, [record.true_without for record in self.poses])
        after = _datum(self.poses, [record.true_with for record in self.poses])
        if after is None:
            return None
        poses = []
        for record in self.poses:
            moved = _after(before, record.true_without), _after(after, record.true_with)
            poses.append(replace(record, true_without=moved[0], true_with=moved[1]))
        path = None if self.path is None else self.path.aligned((before, after))
        return replace(self, poses=poses, path=path)


def _datum(records: Sequence[PoseRecord], actual: Sequence[Pose | None]) -> Pose | None:
    """Return the rigid motion that brings true tool positions onto commanded ones; None where there is no telling."""
    seen = [pose.position for pose in actual if pose is not None]
    if len(seen) < len(records) or len(seen) < FEWEST_ALIGNED:
        return None
    return best_motion(np.array(seen), np.array([record.target.position for record in records]))


def _after(motion: Pose | None, pose: Pose | None) -> Pose | None:
    return None if motion is None or pose is None else motion @ pose


def _moved(motion: Pose, points: np.ndarray) -> np.ndarray:
    return motion.position + points @ motion.rotation.T


def pose_error(target: Pose, actual: Pose | None) -> tuple[float, float] | None:
    """Return distance (m) and angle (rad) between two poses, None when one is unknown."""
    if actual is None:
        return None
    distance = float(np.linalg.norm(actual.position - target.position))
    return distance, rotation_angle(target.rotation.T @ actual.rotation)
