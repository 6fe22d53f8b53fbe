"""What might be measured in a box within the limits: lines along and across it, level and tilted; scattered poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..core import Status
from ..errors import GeometryError
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..measurements.campaign import (
    LINE_INSTRUMENTS,
    PLANES,
    POSE_INSTRUMENTS,
    CampaignRun,
    circle_run,
    line_run,
    tilts,
)
from ..measurements.readings import AXES
from ..pose import rotation_from_angles
from ..workspace.reach import Examiner

POINTS = {"linear": (8, 21), "5-D": (5, 13), "6-D": (5, 13)}
"""Points of a line, by instrument: few at little cost, or enough to see the screws' waves."""

ALTERNATE_POINTS = {"linear": (4, 6, 10), "5-D": (4, 8), "6-D": (4, 8)}
"""The same where each is read once, on the way there or back: more places for as many readings."""

USUAL_POINTS = (13,)
"""Points of lines of all other instruments, there and back."""

SAMPLES = 41
"""Points of a line that are examined."""

LEAST_SHARE = 0.4
"""Lines of which the limits leave less than this share are left out."""

POSES_A_RUN, POSE_RUNS = 12, 25
"""Scattered poses that are measured in one go, and how many such sets there are to choose from."""

SEED = 11
"""Of the scattered poses."""

BAR, BAR_SHARE, CIRCLE_POINTS = 0.1, 0.45, 17
"""Length of a ball bar, m; it is shorter where it is more than this share of a side of the box; readings each way."""

TILTS = 13
"""Attitudes of an R-test at one place."""

STATION_OFF = 0.3
"""How far outside the box, in shares of its sides, a tracking interferometer stands beside a lower corner."""


@dataclass(frozen=True)
class MeasuringBox:
    """Where a machine is to be measured.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine as designed.
    box : ndarray, shape (2, 3)
        Lowest and highest corner of the tool's way, m in the work frame.
    level : ndarray, shape (3, 3)
        Attitude of the level tool in the work frame.
    tilt : float
        Largest tilt of the tool from there, rad.
    """

    geometry: HexapodGeometry
    box: np.ndarray
    level: np.ndarray
    tilt: float

    def attitudes(self) -> list[tuple[str, np.ndarray]]:
        """Return the level attitude and, where the tool tilts, four tilted ones, with their names."""
        names = {"level": (0.0, 0.0)}
        if self.tilt > 0.0:
            shown = f"{np.degrees(self.tilt):g}°"
            for axis, turn in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
                for sign, way in (("+", 1.0), ("−", -1.0)):
                    names[f"{sign}{shown} about {axis}"] = way * turn[0], way * turn[1]
        return [(name, self.turned(self.tilt * np.array(about))) for name, about in names.items()]

    def turned(self, about: np.ndarray) -> np.ndarray:
        """Return the tool's attitude(s) after small tilts about x and y of the work frame, shape (..., 2), rad."""
        return np.asarray(rotation_from_angles(np.concatenate([about, 0.0 * about[..., :1]], axis=-1)) @ self.level)


def candidates(place: MeasuringBox, instruments: Sequence[str]) -> list[CampaignRun]:
    """Return the runs to choose from, all within the limits of the nominal machine.

    Raises
    ------
    GeometryError
        The limits leave none.
    """
    runs: list[CampaignRun] = []
    lines = list(_lines(place)) if any(name in LINE_INSTRUMENTS for name in instruments) else []
    for instrument in instruments:
        if instrument in LINE_INSTRUMENTS:
            runs += _read_by(instrument, lines)
        elif instrument in POSE_INSTRUMENTS:
            runs += [CampaignRun(f"{instrument}, poses", instrument, *poses) for poses in _sets_of_poses(place)]
        else:
            runs += {"ball_bar": _circles, "r_test": _tilted_at, "station": _lengths}[instrument](place)
    if not runs:
        raise GeometryError("limits", "leave nothing to be measured in the box", place.box.tolist())
    return runs


def _read_by(instrument: str, lines: list[tuple[str, np.ndarray, np.ndarray]]) -> Iterator[CampaignRun]:
    """Yield the lines that an instrument can read, with each number of points."""
    for name, ends, rotation in lines:
        if instrument in ("straightness", "rotation") and name.startswith("diagonal"):
            continue
        for points in POINTS.get(instrument, USUAL_POINTS):
            yield line_run(f"{instrument}, {name}", instrument, ends, points, rotation)
        for points in ALTERNATE_POINTS.get(instrument, ()):
            yield replace(line_run(f"{instrument}, {name}", instrument, ends, points, rotation), alternate=True)


def _lines(place: MeasuringBox) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, ends (2, 3), m, and attitude of each line, as far as the limits let it go."""
    diagonals = list(_diagonals(place.box))
    level = [*_axis_lines(place.box, True), *diagonals]
    tilted = [*_axis_lines(place.box, False), *diagonals[:4]]
    examiner = Examiner(place.geometry)
    share = np.linspace(0.0, 1.0, SAMPLES)
    for attitude, rotation in place.attitudes():
        for name, ends in level if attitude == "level" else tilted:
            points = ends[0] + share[:, None] * (ends[1] - ends[0])
            findings, _ = examiner.findings(points, rotation[None], threads=1)
            first, last = _longest(findings == Status.OK)
            if last - first >= LEAST_SHARE * (SAMPLES - 1):
                yield f"{name}, {attitude}", points[[first, last]].round(6), rotation


def _longest(within: np.ndarray) -> tuple[int, int]:
    """Return first and last index of the longest stretch; one less at an end where a limit cuts it."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], within, [False]]).astype(int)))
    if not len(edges):
        return 0, -1
    starts, stops = edges[::2], edges[1::2] - 1
    first, last = max(zip(starts.tolist(), stops.tolist(), strict=True), key=lambda pair: pair[1] - pair[0])
    return first + (first > 0), last - (last < len(within) - 1)


def _axis_lines(box: np.ndarray, faces: bool) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the lines along x, y and z through edges, through the middle and, if wanted, the middles of faces."""
    for axis in range(3):
        for first in (0.0, 0.5, 1.0):
            for second in (0.0, 0.5, 1.0):
                if not faces and (first == 0.5) != (second == 0.5):
                    continue
                ends = box.copy()
                a, b = CROSS_AXES[axis]
                for across, share in ((a, first), (b, second)):
                    ends[:, across] = box[0, across] + share * (box[1, across] - box[0, across])
                where = f"{AXES[a]} {ends[0, a] * 1e3:.0f}, {AXES[b]} {ends[0, b] * 1e3:.0f}"
                yield f"{AXES[axis]} at {where}", ends


def _diagonals(box: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the four body diagonals of a box and the two diagonals of each of its faces."""
    for number, corner in enumerate(((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)), start=1):
        yield f"diagonal {number}", _between(box, corner, tuple(1 - c for c in corner))
    number = 4
    for axis in range(3):
        a, b = CROSS_AXES[axis]
        for side in (0, 1):
            for turned in (0, 1):
                start, stop = [side] * 3, [side] * 3
                start[a], start[b], stop[a], stop[b] = 0, turned, 1, 1 - turned
                number += 1
                yield f"diagonal {number}", _between(box, start, stop)


def _between(box: np.ndarray, start: Sequence[int], stop: Sequence[int]) -> np.ndarray:
    return np.array([[box[c, a] for a, c in enumerate(corner)] for corner in (start, stop)])


def _sets_of_poses(place: MeasuringBox) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield positions and rotations of sets of random poses within the limits."""
    rng = np.random.default_rng(SEED)
    count = 4 * POSES_A_RUN * POSE_RUNS
    positions = rng.uniform(place.box[0], place.box[1], (count, 3)).round(6)
    rotations = place.turned(rng.uniform(-place.tilt, place.tilt, (count, 2)).round(6))
    findings, _ = Examiner(place.geometry).findings(positions, rotations)
    good = np.flatnonzero(findings == Status.OK)[: POSES_A_RUN * POSE_RUNS]
    for start in range(0, len(good) - POSES_A_RUN + 1, POSES_A_RUN):
        part = good[start : start + POSES_A_RUN]
        yield positions[part], rotations[part]


def _circles(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield circles of a ball bar in the box: in three planes each, level and tilted."""
    examiner, sides = Examiner(place.geometry), np.ptp(place.box, axis=0)
    for attitude, rotation in place.attitudes():
        for plane, axes in PLANES.items():
            radius = min(BAR, BAR_SHARE * float(sides[list(axes)].min()))
            room = np.where(np.isin(range(3), axes), radius, 0.0)
            for share in _shares(attitude == "level"):
                centre = (place.box[0] + room + share * (sides - 2.0 * room)).round(6)
                where = ", ".join(f"{value * 1e3:.0f}" for value in centre)
                name = f"ball_bar, {plane} at {where}, {attitude}"
                run = circle_run(name, centre, radius, CIRCLE_POINTS, np.eye(3)[list(axes)], rotation)
                if (examiner.findings(run.positions, rotation[None], threads=1)[0] == Status.OK).all():
                    yield run


def _shares(corners: bool) -> Iterator[np.ndarray]:
    """Yield where in a box, in shares of its sides: its middle, the middles of its faces, and its corners."""
    for index in np.ndindex(3, 3, 3):
        off = sum(i != 1 for i in index)
        if off in (0, 1) or (corners and off == 3):
            yield 0.5 * np.array(index)


def _tilted_at(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield R-tests in the box, for a tool that tilts: one ball, the tool turning about it."""
    if place.tilt == 0.0:
        return
    examiner, rotations = Examiner(place.geometry), tilts(TILTS, place.tilt) @ place.level
    for share in _shares(True):
        ball = (place.box[0] + share * np.ptp(place.box, axis=0)).round(6)
        positions = np.tile(ball, (TILTS, 1))
        if (examiner.findings(positions, rotations, threads=1)[0] == Status.OK).all():
            where = ", ".join(f"{value * 1e3:.0f}" for value in ball)
            yield CampaignRun(f"r_test, at {where}", "r_test", positions, rotations)


def _lengths(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield sets of poses read from a tracking interferometer that stands beside a lower corner of the box."""
    for corner in np.ndindex(2, 2):
        share = np.array([*(side + STATION_OFF * (2 * side - 1) for side in corner), -STATION_OFF])
        station = (place.box[0] + share * np.ptp(place.box, axis=0)).round(4)
        where = ", ".join(f"{value * 1e3:.0f}" for value in station)
        for positions, rotations in _sets_of_poses(place):
            centres = np.tile(station, (len(positions), 1))
            yield CampaignRun(f"station at {where}", "station", positions, rotations, centres)
