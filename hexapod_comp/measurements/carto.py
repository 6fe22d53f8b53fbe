"""Files of Renishaw's laser software: dynamic captures (.rtx) and static linear runs (.rtl).

Neither format (:mod:`.carto_files`) says where the line lies in the machine, so each file needs a small YAML file
beside it (format ``hexapod_comp/line``)::

    format: hexapod_comp/line
    version: 1
    run: x at y 0, z 450      # files of the same run (the channels of one set-up) share it
    axis: x                   # of the work frame along which the tool was commanded
    across_mm: [0, 450]       # commanded coordinates along the other two, in order
    channel: linear           # as in tidy CSV files; roll, pitch, yaw too
    unit: um                  # of the values: .rtl um, .rtx mm (mrad)
    value_sense: 1            # optional; -1 where the instrument counts against the axis
    temperature_degC: 20      # optional, of the machine
    # .rtl: commanded coordinate = target_sense × target + target_offset; deviations of linear runs turn with it
    target_offset_mm: 0       # optional
    target_sense: 1           # optional; or -1
    # .rtx: one pass at constant commanded speed; what the machine lags behind goes into the run's unknown zero
    start_mm: -200            # commanded coordinate at from
    speed_mm_s: 5             # negative: backward
    from_s: 2                 # part of the capture in which the speed was constant
    to_s: 82
    every_mm: 5               # a reading is the mean over this travel
    cycle: 1                  # optional; which of several passes

An .rtx file with stops, with more than one pass, or with a speed that was not constant cannot be used: nothing in it
says where the machine was commanded to be. A linear capture that does not travel as its line file says is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputFileError
from ..formats.yaml import UNITS, Section, read_yaml
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..machine.temperatures import REFERENCE_TEMPERATURE, TEMPERATURE_RANGE
from ..pose import Pose
from .carto_files import Dynamic, Static, is_capture, read_rtl, read_rtx
from .readings import AXES, BACKWARD, FORWARD, FileLine, MeasurementSet, Reading
from .runs import assemble
from .tidy_rows import ALONG_LINES, DIMENSIONS, TURN_AXES, TURNS

LINE_FORMAT = "hexapod_comp/line"
LINE_VERSION = 1

LARGEST_RATIO = 0.01
"""Largest difference of a capture's travel from the commanded one, relative: no machine is that wrong."""


@dataclass(frozen=True)
class Capture:
    """The part of a capture at constant speed: m, m/s, s; `every` is the travel of one reading."""

    start: float
    speed: float
    begin: float
    end: float
    every: float
    cycle: int


@dataclass(frozen=True)
class LineFile:
    """What a file of the laser software does not say; lengths in m, the unit's size in SI.

    Attributes are those of the YAML file in the module's docstring; `capture` holds what .rtx files need.
    """

    run: str
    axis: int
    across: np.ndarray
    channel: str
    unit: float
    value_sense: int
    target_offset: float
    target_sense: int
    temperature: float
    capture: Capture | None

    def pose(self, coordinate: float) -> Pose:
        """Return the commanded pose of the tool at a coordinate along the line, level."""
        position = np.empty(3)
        position[self.axis], position[list(CROSS_AXES[self.axis])] = coordinate, self.across
        return Pose(position.round(12), np.eye(3))


def load_line(path: str | Path) -> LineFile:
    """Read the YAML file beside a file of the laser software.

    Raises
    ------
    InputFileError
        With file, key and value.
    """
    top = read_yaml(path, LINE_FORMAT, LINE_VERSION)
    axis = AXES.index(top.choice("axis", AXES))
    channel = top.choice("channel", tuple(c for c in DIMENSIONS if c.partition("_")[0] in ALONG_LINES))
    line = LineFile(
        run=top.text("run"),
        axis=axis,
        across=top.quantity("across", "length", (2,)),
        channel=f"rotation_{AXES[TURN_AXES[axis][TURNS.index(channel)]]}" if channel in TURNS else channel,
        unit=top.unit("unit", DIMENSIONS[channel]),
        value_sense=_sense(top, "value_sense"),
        target_offset=float(top.quantity("target_offset", "length", default=0.0)),
        target_sense=_sense(top, "target_sense"),
        temperature=float(top.quantity("temperature", "temperature", default=REFERENCE_TEMPERATURE)),
        capture=_capture(top) if top.quantity_key("speed", "speed") else None,
    )
    if not TEMPERATURE_RANGE[0] <= line.temperature <= TEMPERATURE_RANGE[1]:
        raise top.error("temperature_degC", "must lie within {:g}…{:g} °C".format(*TEMPERATURE_RANGE), line.temperature)
    top.finish()
    return line


def _sense(top: Section, key: str) -> int:
    sense = top.integer(key, 1)
    if sense not in (1, -1):
        raise top.error(key, "must be 1 or -1", sense)
    return sense


def _capture(top: Section) -> Capture:
    """Return what .rtx files need; without a speed there is none of it."""
    capture = Capture(
        start=float(top.quantity("start", "length")),
        speed=float(top.quantity("speed", "speed")),
        begin=float(top.quantity("from", "time")),
        end=float(top.quantity("to", "time")),
        every=float(top.quantity("every", "length")),
        cycle=top.integer("cycle", 1),
    )
    if capture.speed == 0.0:
        raise top.error("speed", "must not be zero", capture.speed)
    if not 0.0 <= capture.begin < capture.end:
        raise top.error("from, to", "must be a span of time within the capture", [capture.begin, capture.end])
    travel = abs(capture.speed) * (capture.end - capture.begin)
    if not (capture.every > 0.0 and 2.0 * capture.every <= travel < 1e4 * capture.every):
        problem = f"must give 2…10000 readings over the travel of {travel * 1e3:g} mm"
        raise top.error("every", problem, capture.every)
    if capture.cycle < 1:
        raise top.error("cycle", "must be at least 1", capture.cycle)
    return capture


def read_carto(
    pairs: Sequence[tuple[str | Path, str | Path]],
    geometry: HexapodGeometry,
    probe: np.ndarray | None = None,
    in_reach: bool = True,
) -> MeasurementSet:
    """Read files of the laser software, each with its line file, as one set.

    Parameters
    ----------
    pairs : sequence of (path, path)
        An .rtl or .rtx file and the line file beside it.
    geometry : HexapodGeometry
        The machine that was measured.
    probe : array_like, shape (3,), optional
        The measured point in ``platform``, m; the tool's tip by default.
    in_reach : bool
        Refuse commands that the nominal machine cannot take; the figures of a standard do not need that.

    Raises
    ------
    InputFileError
        Naming file and place.
    """
    readings: list[Reading] = []
    files: list[tuple[str, str]] = []
    notes: list[str] = []
    for path, line_path in pairs:
        own, sha256, remarks = _file_readings(path, load_line(line_path), line_path)
        readings += own
        notes += remarks
        files.append((Path(path).name, sha256))
    _refuse_duplicates(readings)
    return assemble(geometry, readings, probe, files, notes, in_reach)


def _file_readings(path: str | Path, line: LineFile, line_path: str | Path) -> tuple[list[Reading], str, Sequence[str]]:
    """Return the readings, the SHA-256 and the notes of one file."""
    if not is_capture(path):
        static = read_rtl(path)
        readings, remarks = _static_readings(path, static, line)
        return readings, static.sha256, (*static.notes, *remarks)
    dynamic = read_rtx(path)
    if line.capture is None:
        problem = "is needed for an .rtx file: it does not say where the machine was commanded to be"
        raise InputFileError(line_path, "speed", problem)
    return _dynamic_readings(path, dynamic, line, line.capture), dynamic.sha256, ()


def _refuse_duplicates(readings: Sequence[Reading]) -> None:
    """Raise when two files hold the same pass of the same channel."""
    seen: dict[tuple, Reading] = {}
    for r in readings:
        key = (r.run, r.cycle, r.direction, r.channel, r.pose.position.tobytes())
        if key in seen:
            problem = f"run {r.run}: {r.channel} at the same place and pass stands in {seen[key].source} too"
            raise InputFileError(r.source.file, f"line {r.source.line}" if r.source.line else "", problem)
        seen[key] = r


def _static_readings(path: str | Path, static: Static, line: LineFile) -> tuple[list[Reading], list[str]]:
    """Return the readings of static runs; their directions are those in which the targets follow each other."""
    sense = line.value_sense * (line.target_sense if line.channel == "linear" else 1)
    coordinates = line.target_sense * static.targets * UNITS["length"]["mm"] + line.target_offset
    poses = [line.pose(float(coordinate)) for coordinate in coordinates]
    by_run: dict[int, list[tuple[int, float, int]]] = {}
    for run, target, value, number in static.rows:
        by_run.setdefault(run, []).append((target - 1, value, number))
    passes = {FORWARD: 0, BACKWARD: 0}
    readings = []
    for run, rows in by_run.items():
        steps = np.diff(coordinates[[target for target, _, _ in rows]])
        if not len(steps) or not ((steps > 0.0).all() or (steps < 0.0).all()):
            raise InputFileError(path, f"line {rows[0][2]}", f"the targets of run {run} must follow each other one way")
        direction = FORWARD if steps[0] > 0.0 else BACKWARD
        passes[direction] += 1
        for target, value, number in rows:
            place = (line.run, passes[direction], direction, poses[target], line.channel)
            source = FileLine(str(path), number)
            temperatures = (line.temperature,) * 8
            readings.append(Reading(*place, sense * value * line.unit, temperatures=temperatures, source=source))
    one_way = [f"{path}: all its runs travel one way"] if len(by_run) > 1 and 0 in passes.values() else []
    return readings, one_way


def _dynamic_readings(path: str | Path, dynamic: Dynamic, line: LineFile, capture: Capture) -> list[Reading]:
    """Return the readings of a capture at constant speed: means over equal pieces of the travel."""
    if not capture.end * dynamic.rate <= len(dynamic.samples):
        length = len(dynamic.samples) / dynamic.rate
        raise InputFileError(path, "", f"lasts {length:.3f} s, but its line file goes on to {capture.end:g} s")
    first, last = (round(time * dynamic.rate) for time in (capture.begin, capture.end))
    travel = capture.speed * np.arange(last - first) / dynamic.rate
    values = line.value_sense * line.unit * dynamic.samples[first:last]
    if line.channel == "linear":
        values = values - travel
        _check_travel(path, travel, values)
    piece = (np.abs(travel) / capture.every).astype(int)
    pieces = int(abs(capture.speed) * (capture.end - capture.begin) / capture.every + 1e-6)
    inside = piece < pieces
    count = np.bincount(piece[inside], minlength=pieces)
    if (count < 1).any():
        raise InputFileError(path, "", f"has fewer than one sample per {capture.every * 1e3:g} mm of travel")
    means = np.bincount(piece[inside], values[inside]) / count
    places = capture.start + np.bincount(piece[inside], travel[inside]) / count
    direction = FORWARD if capture.speed > 0.0 else BACKWARD
    source, temperatures = FileLine(str(path), 0), (line.temperature,) * 8
    return [
        Reading(line.run, capture.cycle, direction, line.pose(place), line.channel, value,
                temperatures=temperatures, source=source)
        for place, value in zip(places.tolist(), (means - means[0]).tolist(), strict=True)
    ]  # fmt: skip


def _check_travel(path: str | Path, travel: np.ndarray, errors: np.ndarray) -> None:
    """Refuse a capture whose travel is not the commanded one: wrong speed, sense or unit."""
    with np.errstate(all="ignore"):
        centred = travel - travel.mean()
        ratio = float(centred @ errors / (centred @ centred))
    if not abs(ratio) <= LARGEST_RATIO:
        problem = (
            f"travels {1.0 + ratio:.4g} times as far as its line file commands; are speed, unit and value_sense right?"
        )
        raise InputFileError(path, "", problem)
