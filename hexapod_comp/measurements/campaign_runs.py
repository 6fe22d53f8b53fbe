"""Runs that a campaign lists one by one, in measuring order: lines and scattered poses, each under one instrument."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputFileError
from ..formats.yaml import Section
from ..machine.field import CROSS_AXES
from ..machine.model_blocks import written
from ..pose import Pose, angles_from_rotation, rotation_from_angles
from .readings import AXES, BACKWARD, FORWARD, LEAST_TRAVEL, UNKNOWN, Reading

LINE_INSTRUMENTS = ("linear", "straightness", "rotation", "5-D", "6-D")
"""What reads a line: a linear laser; straightness, or pitch and yaw, with their optics; all of these; and roll. Along a
line that is not parallel to an axis of the work frame the last two read its length alone."""

POSE_INSTRUMENTS = ("tracker", "tracker_6d")
"""What reads scattered poses: a tracker's position alone, and with the attitude."""

LISTED_INSTRUMENTS = (*LINE_INSTRUMENTS, *POSE_INSTRUMENTS)

MOST_POINTS = 10_000
"""Of one run."""


@dataclass(frozen=True)
class CampaignRun:
    """One run: the poses of the tool, and the instrument that reads them.

    Parameters
    ----------
    name : str
        Of the run.
    instrument : str
        One of :data:`LISTED_INSTRUMENTS`.
    positions, rotations : ndarray, shape (n, 3), (n, 3, 3)
        ``pose_tool_in_work``, m. Those of a line stand on it, equally turned, from its start to its end; they are
        passed there and back.

    Raises
    ------
    InputFileError
        An instrument that cannot read such a run (the path is empty: the caller knows it).
    """

    name: str
    instrument: str
    positions: np.ndarray
    rotations: np.ndarray

    def __post_init__(self) -> None:
        if self.instrument not in LISTED_INSTRUMENTS:
            allowed = ", ".join(LISTED_INSTRUMENTS)
            raise InputFileError(
                "campaign", f"run {self.name}", f"instrument must be one of {allowed}", self.instrument
            )
        if not 1 <= len(self.positions) <= MOST_POINTS:
            problem = f"must have 1 to {MOST_POINTS} points"
            raise InputFileError("campaign", f"run {self.name}", problem, len(self.positions))
        if self.is_line:
            if np.linalg.norm(self.way) < LEAST_TRAVEL:
                raise InputFileError("campaign", f"run {self.name}", "starts and ends at the same place")
            if self.axis is None and self.instrument in ("straightness", "rotation"):
                problem = "is not parallel to an axis of the work frame: only a linear laser reads it"
                raise InputFileError("campaign", f"run {self.name}", problem, self.instrument)

    @property
    def is_line(self) -> bool:
        """Whether it is read along a line."""
        return self.instrument in LINE_INSTRUMENTS

    @property
    def way(self) -> np.ndarray:
        """From the first position to the last, shape (3,), m."""
        return np.asarray(self.positions[-1] - self.positions[0])

    @property
    def axis(self) -> int | None:
        """0, 1 or 2 for a line parallel to x, y or z of the work frame, None for any other."""
        moving = np.flatnonzero(np.abs(self.way) > LEAST_TRAVEL)
        return int(moving[0]) if len(moving) == 1 else None

    @property
    def channels(self) -> tuple[str, ...]:
        """What is read at each point."""
        positions = tuple(f"position_{a}" for a in AXES)
        if not self.is_line:
            return positions if self.instrument == "tracker" else (*positions, *(f"attitude_{a}" for a in AXES))
        if self.axis is None:
            return ("linear",)
        straight, turning = (
            tuple(f"{kind}_{AXES[a]}" for a in CROSS_AXES[self.axis]) for kind in ("straightness", "rotation")
        )
        five = ("linear", *straight, *turning)
        return {
            "linear": five[:1],
            "straightness": straight,
            "rotation": turning,
            "5-D": five,
            "6-D": (*five, f"rotation_{AXES[self.axis]}"),
        }[self.instrument]

    def count(self, cycles: int) -> int:
        """Return how many readings :meth:`readings` yields."""
        return len(self.positions) * len(self.channels) * (2 * cycles if self.is_line else 1)

    def readings(self, cycles: int) -> Iterator[Reading]:
        """Yield the readings, values of zero; a line's in so many passes forward and backward, each pose's once."""
        poses = [Pose(*pose) for pose in zip(self.positions, self.rotations, strict=True)]
        if self.is_line:
            yield from line_readings(self.name, poses, self.channels, cycles)
            return
        for pose in poses:
            for channel in self.channels:
                yield Reading(self.name, 1, UNKNOWN, pose, channel, 0.0)

    def content(self) -> dict[str, Any]:
        """Return the entry of a campaign file."""
        head: dict[str, Any] = {"name": self.name, "instrument": self.instrument}
        angles = (np.degrees(angles_from_rotation(self.rotations)).round(9) + 0.0).tolist()
        positions = written(self.positions + 0.0, "length", "mm")
        if not self.is_line:
            return {**head, "poses_mm": positions, "angles_deg": angles}
        return {
            **head,
            "line_mm": [positions[0], positions[-1]],
            "points": len(positions),
            "angles_deg": angles[0],
        }


def line_run(name: str, instrument: str, ends: np.ndarray, points: int, rotation: np.ndarray) -> CampaignRun:
    """Return a run between two places of the work frame, shape (2, 3), m, at one attitude of the tool."""
    positions = np.linspace(ends[0], ends[1], points).round(12)
    return CampaignRun(name, instrument, positions, np.tile(rotation, (points, 1, 1)))


def line_readings(name: str, poses: Sequence[Pose], channels: Iterable[str], cycles: int) -> Iterator[Reading]:
    """Yield the readings of passes forward and backward over a line, values of zero.

    Forward is along the first of x, y, z of the work frame that moves, whichever way the poses are listed.
    """
    way = poses[-1].position - poses[0].position
    if way[np.flatnonzero(np.abs(way) > LEAST_TRAVEL)[0]] < 0.0:
        poses = poses[::-1]
    channels = tuple(channels)
    for cycle in range(1, cycles + 1):
        for direction in (FORWARD, BACKWARD):
            for pose in poses[::direction]:
                for channel in channels:
                    yield Reading(name, cycle, direction, pose, channel, 0.0)


def read_runs(top: Section) -> tuple[CampaignRun, ...]:
    """Return the runs that a campaign file lists under ``runs``.

    Raises
    ------
    InputFileError
        With file, key and value.
    """
    runs: list[CampaignRun] = []
    for entry in top.sections("runs"):
        name = entry.text("name")
        if name in {run.name for run in runs}:
            raise entry.error("name", "is given to two runs: readings of one run share their unknown zeros", name)
        instrument = entry.choice("instrument", LISTED_INSTRUMENTS)
        read = _read_line if instrument in LINE_INSTRUMENTS else _read_poses
        runs.append(read(entry, name, instrument))
        entry.finish()
    return tuple(runs)


def _read_line(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return a run along a line."""
    ends = entry.quantity("line", "length", (2, 3))
    angles = entry.quantity("angles", "angle", (3,), default=np.zeros(3))
    points = entry.integer("points", 2)
    if not 2 <= points <= MOST_POINTS:
        raise entry.error("points", f"must be 2 to {MOST_POINTS}", points)
    return line_run(name, instrument, ends, points, rotation_from_angles(angles))


def _read_poses(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return a run of scattered poses."""
    positions = entry.quantity("poses", "length", (None, 3))
    angles = entry.quantity("angles", "angle", (None, 3), default=np.zeros_like(positions))
    if len(angles) != len(positions):
        raise entry.error("angles_deg", f"must be as many as poses: {len(positions)}", len(angles))
    return CampaignRun(name, instrument, positions, rotation_from_angles(angles))
