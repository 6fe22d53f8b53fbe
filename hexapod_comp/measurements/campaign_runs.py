"""Runs that a campaign lists one by one, in measuring order: lines, circles and poses, each under one instrument."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputFileError
from ..formats.yaml import Section
from ..machine.field import CROSS_AXES
from ..machine.model_blocks import written
from ..pose import Pose, angles_from_rotation, rotation_from_angles
from .readings import AXES, BACKWARD, FORWARD, FROM_PREVIOUS, LEAST_TRAVEL, UNKNOWN, Reading

LINE_INSTRUMENTS = ("linear", "straightness", "rotation", "5-D", "6-D")
"""What reads a line: a linear laser; straightness, or pitch and yaw, with their optics; all of these; and roll. Along a
line that is not parallel to an axis of the work frame the last two read its length alone."""

POSE_INSTRUMENTS = ("tracker", "tracker_6d")
"""What reads scattered poses: a tracker's position alone, and with the attitude."""

LENGTH_INSTRUMENTS = ("ball_bar", "station", "probe")
"""What reads a length from a centre: a telescoping ball bar, there and back; a tracking interferometer; a probe that
touches spheres."""

BALL_INSTRUMENTS = ("r_test",)
"""What reads where the tool's ball is beside three sensors, while the tool tilts about it."""

LISTED_INSTRUMENTS = (*LINE_INSTRUMENTS, *POSE_INSTRUMENTS, *LENGTH_INSTRUMENTS, *BALL_INSTRUMENTS)

PLANES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}
"""Planes of circles, in the work frame: a circle goes from the first axis to the second."""

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
        passed there and back, and so are those of a ball bar.
    centres : ndarray, shape (n, 3), optional
        From where lengths are read, in the work frame, m.
    known_zero : bool
        The lengths are known as a whole.
    alternate : bool
        A line's places are read once: every second one on the way there, the others on the way back.

    Raises
    ------
    InputFileError
        An instrument that cannot read such a run (the path is empty: the caller knows it).
    """

    name: str
    instrument: str
    positions: np.ndarray
    rotations: np.ndarray
    centres: np.ndarray | None = None
    known_zero: bool = False
    alternate: bool = False

    def __post_init__(self) -> None:
        if self.instrument not in LISTED_INSTRUMENTS:
            allowed = ", ".join(LISTED_INSTRUMENTS)
            raise InputFileError(
                "campaign", f"run {self.name}", f"instrument must be one of {allowed}", self.instrument
            )
        if not 1 <= len(self.positions) <= MOST_POINTS:
            problem = f"must have 1 to {MOST_POINTS} points"
            raise InputFileError("campaign", f"run {self.name}", problem, len(self.positions))
        if (self.instrument in LENGTH_INSTRUMENTS) != (self.centres is not None):
            problem = "a length needs its centre, and nothing else has one"
            raise InputFileError("campaign", f"run {self.name}", problem, self.instrument)
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
        if self.instrument in LENGTH_INSTRUMENTS:
            return ("length",)
        if self.instrument in BALL_INSTRUMENTS:
            return tuple(f"displacement_{a}" for a in AXES)
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
        return len(self.positions) * len(self.channels) * self._passes(cycles) // (1 + self.alternate)

    def _passes(self, cycles: int) -> int:
        """Return how often the poses are passed: a tracker's once, a line and a circle there and back."""
        if self.instrument in POSE_INSTRUMENTS:
            return 1
        return (2 if self.is_line or self.instrument == "ball_bar" else 1) * cycles

    def readings(self, cycles: int) -> Iterator[Reading]:
        """Yield the readings, values of zero; a line's in so many passes forward and backward, each pose's once."""
        poses = [Pose(*pose) for pose in zip(self.positions, self.rotations, strict=True)]
        if self.is_line:
            yield from line_readings(self.name, poses, self.channels, cycles, self.alternate)
            return
        if self.instrument in POSE_INSTRUMENTS:
            for pose in poses:
                for channel in self.channels:
                    yield Reading(self.name, 1, UNKNOWN, pose, channel, 0.0)
            return
        of_file = [None] * len(poses) if self.centres is None else [tuple(c) for c in self.centres.tolist()]
        for number in range(self._passes(cycles)):
            way = -1 if self.instrument == "ball_bar" and number % 2 else 1
            for pose, centre in list(zip(poses, of_file, strict=True))[::way]:
                for channel in self.channels:
                    reading = Reading(self.name, number + 1, FROM_PREVIOUS, pose, channel, 0.0)
                    yield reading._replace(centre=centre, known_zero=self.known_zero)

    def content(self) -> dict[str, Any]:
        """Return the entry of a campaign file."""
        head: dict[str, Any] = {"name": self.name, "instrument": self.instrument}
        angles = (np.degrees(angles_from_rotation(self.rotations)).round(9) + 0.0).tolist()
        positions = written(self.positions + 0.0, "length", "mm")
        if self.centres is not None:
            centres = written(self.centres + 0.0, "length", "mm")
            head |= {"centre_mm": centres[0]} if (self.centres == self.centres[0]).all() else {"centres_mm": centres}
        if self.known_zero:
            head["zero"] = "known"
        if not self.is_line:
            return {**head, "poses_mm": positions, "angles_deg": angles}
        return {
            **head,
            "line_mm": [positions[0], positions[-1]],
            "points": len(positions),
            "angles_deg": angles[0],
            **({"stops": "alternate"} if self.alternate else {}),
        }


def line_run(name: str, instrument: str, ends: np.ndarray, points: int, rotation: np.ndarray) -> CampaignRun:
    """Return a run between two places of the work frame, shape (2, 3), m, at one attitude of the tool."""
    positions = np.linspace(ends[0], ends[1], points).round(12)
    return CampaignRun(name, instrument, positions, np.tile(rotation, (points, 1, 1)))


def circle_run(
    name: str, centre: np.ndarray, radius: float, points: int, axes: np.ndarray, rotation: np.ndarray
) -> CampaignRun:
    """Return a ball bar's run on a full circle, there and back.

    Parameters
    ----------
    name : str
        Of the run.
    centre : ndarray, shape (3,)
        Of the circle and of the bar's fixed ball, m in the work frame.
    radius : float
        m.
    points : int
        Readings each way.
    axes : ndarray, shape (2, 3)
        Unit vectors across each other: the circle starts at the first and goes to the second.
    rotation : ndarray, shape (3, 3)
        Attitude of the tool in the work frame.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, points)
    places = centre + radius * (np.cos(angles)[:, None] * axes[0] + np.sin(angles)[:, None] * axes[1])
    centres = np.tile(np.asarray(centre, dtype=float), (points, 1))
    return CampaignRun(name, "ball_bar", places.round(12), np.tile(rotation, (points, 1, 1)), centres)


def tilts(points: int, largest: float) -> np.ndarray:
    """Return attitudes of a tool that tilts outwards in a spiral up to an angle, rad, level first, (points, 3, 3)."""
    share = np.sqrt(np.arange(points) / max(points - 1, 1))
    turns = np.arange(points) * np.pi * (3.0 - np.sqrt(5.0))  # the golden angle: neighbours are never alike
    angles = np.stack([share * np.cos(turns), share * np.sin(turns), np.zeros(points)], axis=1)
    return rotation_from_angles((largest * angles).round(9))


def line_readings(
    name: str, poses: Sequence[Pose], channels: Iterable[str], cycles: int, alternate: bool = False
) -> Iterator[Reading]:
    """Yield the readings of passes forward and backward over a line, values of zero; all each way, or alternate ones.

    Forward is along the first of x, y, z of the work frame that moves, whichever way the poses are listed.
    """
    way = poses[-1].position - poses[0].position
    if way[np.flatnonzero(np.abs(way) > LEAST_TRAVEL)[0]] < 0.0:
        poses = poses[::-1]
    channels, stops = tuple(channels), (poses, poses)
    if alternate:
        stops = poses[::2], poses[1::2]
    for cycle in range(1, cycles + 1):
        for direction, there in zip((FORWARD, BACKWARD), stops, strict=True):
            for pose in there[::direction]:
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
        runs.append(_reader(entry, instrument)(entry, name, instrument))
        entry.finish()
    return tuple(runs)


def _reader(entry: Section, instrument: str) -> Callable[[Section, str, str], CampaignRun]:
    """Return what reads an entry: a line, a short form of a circle or of tilts, or a list of poses."""
    if instrument in LINE_INSTRUMENTS:
        return _read_line
    listed = entry.quantity_key("poses", "length") is not None
    short = {"ball_bar": _read_circle, "probe": _read_sphere, "r_test": _read_tilts}
    return _read_poses if listed else short.get(instrument, _read_poses)


def _points(entry: Section, fewest: int) -> int:
    points = entry.integer("points", 0)
    if not fewest <= points <= MOST_POINTS:
        raise entry.error("points", f"must be {fewest} to {MOST_POINTS}", points)
    return points


def _read_circle(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return a ball bar's circle."""
    plane = PLANES[entry.choice("plane", tuple(PLANES))]
    centre, radius = entry.quantity("centre", "length", (3,)), float(entry.quantity("radius", "length"))
    rotation = rotation_from_angles(entry.quantity("angles", "angle", (3,), default=np.zeros(3)))
    run = circle_run(name, centre, radius, _points(entry, 5), np.eye(3)[list(plane)], rotation)
    return replace(run, known_zero=_known(entry))


def _read_sphere(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return touches spread over the upper half of a sphere, or of each sphere of a plate."""
    centres = entry.quantity("centres", "length", (None, 3))
    radius, points = float(entry.quantity("radius", "length")), _points(entry, 4)
    rotation = rotation_from_angles(entry.quantity("angles", "angle", (3,), default=np.zeros(3)))
    up = (np.arange(points) + 0.5) / points
    turns = np.arange(points) * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - up**2)
    outwards = np.stack([level * np.cos(turns), level * np.sin(turns), up], axis=1)
    places = (centres[:, None] + radius * outwards).reshape(-1, 3).round(12)
    of_each = np.repeat(centres, points, axis=0)
    return CampaignRun(name, instrument, places, np.tile(rotation, (len(places), 1, 1)), of_each, _known(entry))


def _read_tilts(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return an R-test at one place."""
    place, points = entry.quantity("position", "length", (3,)), _points(entry, 4)
    rotations = tilts(points, float(entry.quantity("tilt", "angle")))
    return CampaignRun(name, instrument, np.tile(place, (points, 1)), rotations)


def _known(entry: Section) -> bool:
    return entry.choice("zero", ("known", "unknown"), "unknown") == "known"


def _read_line(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return a run along a line."""
    ends = entry.quantity("line", "length", (2, 3))
    angles = entry.quantity("angles", "angle", (3,), default=np.zeros(3))
    points = entry.integer("points", 2)
    if not 2 <= points <= MOST_POINTS:
        raise entry.error("points", f"must be 2 to {MOST_POINTS}", points)
    run = line_run(name, instrument, ends, points, rotation_from_angles(angles))
    return replace(run, alternate=entry.choice("stops", ("all", "alternate"), "all") == "alternate")


def _read_poses(entry: Section, name: str, instrument: str) -> CampaignRun:
    """Return a run of listed poses."""
    positions = entry.quantity("poses", "length", (None, 3))
    angles = entry.quantity("angles", "angle", (None, 3), default=np.zeros_like(positions))
    if len(angles) != len(positions):
        raise entry.error("angles_deg", f"must be as many as poses: {len(positions)}", len(angles))
    if instrument not in LENGTH_INSTRUMENTS:
        return CampaignRun(name, instrument, positions, rotation_from_angles(angles))
    if entry.quantity_key("centres", "length") is None:
        centres = np.tile(entry.quantity("centre", "length", (3,)), (len(positions), 1))
    else:
        centres = entry.quantity("centres", "length", (None, 3))
    if len(centres) != len(positions):
        raise entry.error("centres_mm", f"must be as many as poses: {len(positions)}", len(centres))
    return CampaignRun(name, instrument, positions, rotation_from_angles(angles), centres, _known(entry))
