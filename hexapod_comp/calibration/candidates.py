"""Candidate runs of a campaign: for each instrument, runs in a box that the nominal machine can reach."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ..core import Status
from ..errors import CalibrationError, GeometryError, InputFileError
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..machine.region import box_text
from ..measurements.campaign import (
    LINE_INSTRUMENTS,
    PLANES,
    POSE_INSTRUMENTS,
    Campaign,
    CampaignRun,
    circle_run,
    diagonals,
    line_run,
    template,
    tilts,
)
from ..measurements.readings import AXES, CHANNELS, MeasurementSet
from ..pose import rotation_from_angles
from ..workspace.reach import first_limits
from .parameters import ParameterSpace

TILTS = (10.0, 5.0, 2.0)  # tilts of scattered poses, °; the first tilt that the machine reaches is used
FEW_POINTS, USUAL_POINTS = (5, 13), (13,)
# Numbers of points on a candidate line: few points cost little time, many points resolve the screws' waves
LINE_POINTS = {"linear": (8, 21), "5-D": FEW_POINTS, "6-D": FEW_POINTS}
# The same for lines with alternating directions, on which each point is read in one direction only
ALTERNATE_POINTS = {"linear": (4, 6, 10), "5-D": (4, 8), "6-D": (4, 8)}


@dataclass(frozen=True)
class MeasuringBox:
    geometry: HexapodGeometry
    box: np.ndarray  # (2, 3): lowest and highest corner of the tool's positions, m in the work frame
    level: np.ndarray  # (3, 3): attitude of the level tool in the work frame
    tilt: float  # largest tilt of the tool from `level`, rad

    def attitudes(self) -> list[tuple[str, np.ndarray]]:
        names = {"level": (0.0, 0.0)}
        if self.tilt > 0.0:
            shown = f"{np.degrees(self.tilt):g}°"
            names |= {f"+{shown} about x": (1.0, 0.0), f"−{shown} about x": (-1.0, 0.0)}
            names |= {f"+{shown} about y": (0.0, 1.0), f"−{shown} about y": (0.0, -1.0)}
        return [(name, self.turned(self.tilt * np.array(about))) for name, about in names.items()]

    def turned(self, about: np.ndarray) -> np.ndarray:
        """Tilt the level tool by small angles (..., 2), rad, about x and y of work; return attitudes (..., 3, 3)."""
        return np.asarray(rotation_from_angles(np.concatenate([about, 0.0 * about[..., :1]], axis=-1)) @ self.level)

    def reaches(self, positions: np.ndarray, rotations: np.ndarray, threads: int | None = 1) -> np.ndarray:
        return first_limits(self.geometry, positions, rotations, threads=threads)[0] == Status.OK


def candidates(place: MeasuringBox, instruments: Sequence[str]) -> list[CampaignRun]:
    runs: list[CampaignRun] = []
    lines = list(_lines(place)) if any(name in LINE_INSTRUMENTS for name in instruments) else []
    for instrument in instruments:
        if instrument in POSE_INSTRUMENTS:
            runs += [CampaignRun(f"{instrument}, poses", instrument, *poses) for poses in _sets_of_poses(place)]
        elif instrument not in LINE_INSTRUMENTS:
            runs += {"ball_bar": _circles, "r_test": _tilted_at, "station": _lengths}[instrument](place)
        else:
            for name, ends, rotation in lines:
                if instrument in ("straightness", "rotation") and name.startswith("diagonal"):
                    continue
                title = f"{instrument}, {name}"
                for points in LINE_POINTS.get(instrument, USUAL_POINTS):
                    runs.append(line_run(title, instrument, ends, points, rotation))
                for points in ALTERNATE_POINTS.get(instrument, ()):
                    runs.append(replace(line_run(title, instrument, ends, points, rotation), alternate=True))
    if not runs:
        where = f"the box {box_text(place.box)}, work frame"
        raise GeometryError("limits", f"let the machine complete none of the candidate runs in {where}")
    return runs


def _lines(place: MeasuringBox) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield lines along axes and diagonals, cut to what the machine reaches: name, ends (2, 3), m in work, attitude."""
    low, size = place.box[0], np.ptp(place.box, axis=0)
    level, tilted = [], []
    for axis, (a, b) in enumerate(CROSS_AXES):
        for first, second in np.ndindex(3, 3):
            ends = place.box.copy()
            ends[:, [a, b]] = low[[a, b]] + 0.5 * np.array([first, second]) * size[[a, b]]
            where = f"{AXES[a]} {ends[0, a] * 1e3:.0f}, {AXES[b]} {ends[0, b] * 1e3:.0f}"
            level.append((f"{AXES[axis]} at {where}", ends))
            if (first == 1) == (second == 1):  # edges and centre line of the box, but not the centre lines of its faces
                tilted.append(level[-1])
    of_box = [(f"diagonal {n}", ends) for n, ends in enumerate(diagonals(place.box), start=1)]
    level += of_box
    tilted += of_box[:4]

    share = np.linspace(0.0, 1.0, 41)  # points tried on a line, as shares of its length
    least = 0.4  # a line is omitted if a smaller share of its length is within the limits
    for attitude, rotation in place.attitudes():
        for name, ends in level if attitude == "level" else tilted:
            points = ends[0] + share[:, None] * (ends[1] - ends[0])
            first, last = _longest(place.reaches(points, rotation[None]))
            if last - first >= least * (len(share) - 1):
                yield f"{name}, {attitude}", points[[first, last]].round(6), rotation


def _longest(within: np.ndarray) -> tuple[int, int]:
    """Return the first and last index of the longest stretch of True; drop an end point that is next to a False."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], within, [False]]).astype(int)))
    if not len(edges):
        return 0, -1
    starts, stops = edges[::2], edges[1::2] - 1
    first, last = max(zip(starts.tolist(), stops.tolist(), strict=True), key=lambda pair: pair[1] - pair[0])
    return first + (first > 0), last - (last < len(within) - 1)


def _sets_of_poses(place: MeasuringBox) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    rng, together, sets = np.random.default_rng(11), 12, 25
    count = 4 * together * sets
    positions = rng.uniform(place.box[0], place.box[1], (count, 3)).round(6)
    rotations = place.turned(rng.uniform(-place.tilt, place.tilt, (count, 2)).round(6))
    good = np.flatnonzero(place.reaches(positions, rotations, threads=None))
    for part in good[: min(sets, len(good) // together) * together].reshape(-1, together):
        yield positions[part], rotations[part]


def _circles(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield ball bar circles in each plane of the box, level and tilted; radius 100 mm, or less in a small box."""
    sides = np.ptp(place.box, axis=0)
    for attitude, rotation in place.attitudes():
        for plane, axes in PLANES.items():
            radius = min(0.1, 0.45 * float(sides[list(axes)].min()))
            room = np.where(np.isin(range(3), axes), radius, 0.0)
            for share in _shares(attitude == "level"):
                centre = (place.box[0] + room + share * (sides - 2.0 * room)).round(6)
                name = f"ball_bar, {plane} at {_millimetres(centre)}, {attitude}"
                run = circle_run(name, centre, radius, 17, np.eye(3)[list(axes)], rotation)
                if place.reaches(run.positions, rotation[None]).all():
                    yield run


def _shares(corners: bool) -> Iterator[np.ndarray]:
    """Yield centre, face centres and, with `corners`, corners of a box as fractions, 0, ½ or 1, of its sides."""
    for index in np.ndindex(3, 3, 3):
        off = sum(i != 1 for i in index)
        if off in (0, 1) or (corners and off == 3):
            yield 0.5 * np.array(index)


def _tilted_at(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield R-tests: the tool tilts about a fixed ball in the box; none if the tool must stay level."""
    if place.tilt == 0.0:
        return
    count = 13
    rotations = tilts(count, place.tilt) @ place.level
    for share in _shares(True):
        ball = (place.box[0] + share * np.ptp(place.box, axis=0)).round(6)
        positions = np.tile(ball, (count, 1))
        if place.reaches(positions, rotations).all():
            yield CampaignRun(f"r_test, at {_millimetres(ball)}", "r_test", positions, rotations)


def _lengths(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield runs in which a tracking interferometer beside a lower corner of the box reads distances to the tool."""
    off = 0.3  # distance of the interferometer from the box along each axis, as a share of its side
    for corner in np.ndindex(2, 2):
        share = np.array([*(side + off * (2 * side - 1) for side in corner), -off])
        station = (place.box[0] + share * np.ptp(place.box, axis=0)).round(4)
        for positions, rotations in _sets_of_poses(place):
            centres = np.tile(station, (len(positions), 1))
            yield CampaignRun(f"station at {_millimetres(station)}", "station", positions, rotations, centres)


def _millimetres(place: np.ndarray) -> str:
    return ", ".join(f"{value * 1e3:.0f}" for value in place)


# Templates of readings in the box of a fit


def box_template(
    space: ParameterSpace,
    lines: int = 0,
    readings: int = 2,
    poses: int = 0,
    tilts: Sequence[float] = (0.0,),
    instrument: str = "6-D",
) -> tuple[MeasurementSet, float]:
    """Return a template of readings in the box of a fit, each with the value 0, and the largest tilt of its poses, °.

    A line along the box's shortest side has `readings` points; `lines` such lines lie side by side (0: no lines). The
    tilt is the first of `tilts` with which the machine reaches all poses.
    """
    box, side, geometry = space.work_box, float(np.ptp(space.work_box, axis=0).min()), space.geometry
    if side <= 0.0:
        raise CalibrationError("fit", "was made with readings that span no box; readings can be proposed only in a box")
    level = geometry.work.rotation.T @ space.level @ geometry.tool.rotation
    grid = Campaign(box, side / max(lines - 1, 1), side / (readings - 1), instrument, 4, poses=poses, level=level)
    if not lines:
        grid = replace(grid, instrument=None, diagonals=0)
    *steeper, last = tilts
    for tilt in steeper:
        with suppress(InputFileError):  # some pose is out of reach
            return template(replace(grid, tilt=float(np.radians(tilt))), geometry), tilt
    return template(replace(grid, tilt=float(np.radians(last))), geometry), last


def places(readings: MeasurementSet) -> Iterator[tuple[str, tuple[str, ...], np.ndarray]]:
    """Yield for each line, and for each pose that is on no line: name, channels, and indices of its readings."""
    on_line = np.array([run.is_line for run in readings.runs])[readings.run]
    key = np.where(on_line, -1 - readings.run, readings.station)
    tips, _ = readings.geometry.tool_poses(readings.stations.positions, readings.stations.rotations)
    for group in dict.fromkeys(key.tolist()):
        members = np.flatnonzero(key == group)
        run = readings.runs[readings.run[members[0]]]
        at = [", ".join(f"{1e3 * v:.1f}" for v in tips[s] + 0.0) for s in dict.fromkeys(readings.station[members])]
        where = f"{run.name}: {at[0]} – {at[-1]} mm" if run.is_line else f"pose {at[0]} mm"
        yield where, tuple(dict.fromkeys(CHANNELS[c] for c in readings.channel[members])), members
