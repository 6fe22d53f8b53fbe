"""Readings in whatever order they come, assembled into one :class:`~.readings.MeasurementSet`.

Runs are recognised as lines, equal commands become one station, poses out of reach are refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields

import numpy as np

from ..errors import InputFileError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths
from ..machine.passes import Passes
from ..pose import Pose
from .readings import (
    ANGULAR_KINDS,
    BACKWARD,
    CHANNELS,
    FORWARD,
    FROM_PREVIOUS,
    KIND_OF,
    KINDS,
    LEAST_TRAVEL,
    LENGTH,
    LINE_KINDS,
    MeasurementSet,
    Reading,
    Run,
    Stations,
)

SAME = 1e-9
"""Commands nearer to each other than this, m, are the same command."""

SHORTEST_LENGTH = 1e-3
"""A length shorter than this, m, has no direction: its centre is known to some millimetres only."""

LARGEST_READING = 10.0
"""No machine errs by more, and no instrument's zero lies further off, m or rad."""

SMALLEST_UNCERTAINTY = 1e-12
"""No instrument reads better, m or rad; and the square of its inverse is still a number."""


def assemble(
    geometry: HexapodGeometry,
    readings: Sequence[Reading],
    probe: np.ndarray | None = None,
    files: Iterable[tuple[str, str]] = (),
    notes: Iterable[str] = (),
    in_reach: bool = True,
) -> MeasurementSet:
    """Return the set of some readings: runs recognised as lines, stations made unique, reach checked.

    Parameters
    ----------
    geometry, readings : HexapodGeometry, sequence of Reading
        The machine as designed; readings in the order in which they were taken, as far as ``FROM_PREVIOUS`` needs it.
    probe : array_like, shape (3,), optional
        Measured point in ``platform``, m; the tool's tip by default.
    files, notes : iterable of (str, str), iterable of str
        Name and SHA-256 of each file, and remarks so far.
    in_reach : bool
        Refuse commands that the nominal machine cannot take; the figures of a standard do not need that.

    Raises
    ------
    InputFileError
        No readings, an unknown channel, values not finite, poses out of reach, line channels without a line.
    """
    probe = np.array(geometry.tool.position if probe is None else probe, dtype=float)
    _check_readings(readings)
    poses = _platform_poses(geometry, readings)
    points = np.array([pose.position + pose.rotation @ probe for pose in poses])
    centre = _centres(geometry, readings, points)
    runs, run_of, swapped = _runs(readings, points, geometry.work.rotation.T)
    stations, station = _collect_stations(geometry, readings, poses, [runs[i] for i in run_of], in_reach)
    return MeasurementSet(
        geometry=geometry,
        probe=probe,
        runs=runs,
        stations=stations,
        station=station,
        run=run_of,
        cycle=np.array([r.cycle for r in readings]),
        direction=np.array([r.direction for r in readings]),
        channel=np.array([CHANNELS.index(r.channel) for r in readings]),
        value=np.array([r.value for r in readings], dtype=float),
        uncertainty=np.array([r.uncertainty for r in readings], dtype=float),
        centre=centre,
        sources=tuple(r.source for r in readings),
        files=tuple(files),
        notes=(*notes, *swapped),
    )


def _runs(
    readings: Sequence[Reading], points: np.ndarray, along: np.ndarray
) -> tuple[tuple[Run, ...], np.ndarray, list[str]]:
    """Return the runs, each reading's run, and remarks on runs whose directions look swapped."""
    members: dict[str, list[int]] = {}
    for index, reading in enumerate(readings):
        members.setdefault(reading.run, []).append(index)
    parts = [([readings[i] for i in rows], points[rows]) for rows in members.values()]
    runs = tuple(_recognise(*part, along) for part in parts)
    number = {name: index for index, name in enumerate(members)}
    notes = [_swapped_note(run, *part) for run, part in zip(runs, parts, strict=True)]
    return runs, np.array([number[r.run] for r in readings]), [note for note in notes if note]


def _platform_poses(geometry: HexapodGeometry, readings: Sequence[Reading]) -> list[Pose]:
    """Return the commanded ``pose_platform_in_base`` of each reading; equal poses are one object."""
    known: dict[bytes, Pose] = {}
    poses = []
    for reading in readings:
        key = reading.pose.position.tobytes() + reading.pose.rotation.tobytes()
        if key not in known:
            known[key] = geometry.platform_pose(reading.pose)
        poses.append(known[key])
    return poses


def _centres(geometry: HexapodGeometry, readings: Sequence[Reading], points: np.ndarray) -> np.ndarray:
    """Return from where lengths are read, (N, 3), m in ``base``, NaN for others; `points` are the measured ones.

    Raises
    ------
    InputFileError
        A length without a centre, or at it; a centre of something else; a run whose zero is known and unknown.
    """
    centres = np.full((len(readings), 3), np.nan)
    known: dict[str, bool] = {}
    for n, r in enumerate(readings):
        is_length = r.channel == CHANNELS[LENGTH]
        if is_length and r.centre is None:
            raise InputFileError(r.source.file, _line(r), "a length needs the place of its centre")
        if not is_length and (r.centre is not None or r.known_zero):
            problem = f"only lengths have a centre or a known zero; leave them empty for {r.channel}"
            raise InputFileError(r.source.file, _line(r), problem)
        if known.setdefault(r.run, r.known_zero) != r.known_zero:
            problem = f"run {r.run}: one zero cannot be known and unknown; call them two runs"
            raise InputFileError(r.source.file, _line(r), problem)
        if r.centre is not None:
            centres[n] = geometry.work.position + geometry.work.rotation @ np.array(r.centre)
            distance = float(np.linalg.norm(points[n] - centres[n]))
            if not SHORTEST_LENGTH <= distance < np.inf:
                problem = f"the commanded point must be {SHORTEST_LENGTH * 1e3:g} mm or more from the centre, mm"
                raise InputFileError(r.source.file, _line(r), problem, distance * 1e3)
    return centres


def _check_readings(readings: Sequence[Reading]) -> None:
    """Refuse what no instrument reads."""
    if not readings:
        raise InputFileError("measurements", "", "hold no reading")
    for r in readings:
        if r.channel not in CHANNELS:
            raise InputFileError(r.source.file, _line(r), f"channel must be one of {', '.join(CHANNELS)}", r.channel)
        unit = "rad" if KINDS[KIND_OF[CHANNELS.index(r.channel)]] in ANGULAR_KINDS else "m"
        if not np.isfinite(r.value):
            raise InputFileError(r.source.file, _line(r), "value must be finite", r.value)
        if abs(r.value) > LARGEST_READING:
            problem = f"value must be within ±{LARGEST_READING:g} {unit}: it is the error, actual minus commanded"
            raise InputFileError(r.source.file, _line(r), problem, r.value)
        if r.uncertainty <= 0.0 or np.isinf(r.uncertainty):
            raise InputFileError(r.source.file, _line(r), "uncertainty must be finite and above zero", r.uncertainty)
        if not (np.isnan(r.uncertainty) or SMALLEST_UNCERTAINTY <= r.uncertainty <= LARGEST_READING):
            problem = f"uncertainty must be {SMALLEST_UNCERTAINTY:g}…{LARGEST_READING:g} {unit}"
            raise InputFileError(r.source.file, _line(r), problem, r.uncertainty)


def _line(reading: Reading) -> str:
    return f"line {reading.source.line}" if reading.source.line else f"run {reading.run}"


def _recognise(readings: list[Reading], points: np.ndarray, work_axes: np.ndarray) -> Run:
    """Return a run from its readings and their commanded points (n, 3), with its line if it has line channels.

    Which way along the line is forward is a matter of the work frame, whose axes are the rows of `work_axes`.

    Raises
    ------
    InputFileError
        Line channels whose commanded points do not lie on a line, or at one place only; channels of lines and others
        mixed.
    """
    first, name = readings[0], readings[0].run
    of_lines = {KINDS[KIND_OF[CHANNELS.index(r.channel)]] in LINE_KINDS for r in readings}
    if len(of_lines) == 2:
        raise InputFileError(first.source.file, f"run {name}", "mixes channels of a line with others")
    if of_lines == {False}:
        return Run(name, np.zeros(3), points[0], first.known_zero)
    spread = points - points[0]
    far = spread[np.linalg.norm(spread, axis=1).argmax()]
    if np.linalg.norm(far) < LEAST_TRAVEL:
        raise InputFileError(first.source.file, f"run {name}", "has one commanded point only; a line needs two")
    axis = far / np.linalg.norm(far)
    off = np.linalg.norm(spread - np.outer(spread @ axis, axis), axis=1)
    if off.max() > LEAST_TRAVEL:
        where = readings[int(off.argmax())]
        problem = f"run {name}: the commanded point is {off.max() * 1e3:.4f} mm off the run's line"
        raise InputFileError(where.source.file, _line(where), problem)
    in_work = work_axes @ far
    leading = in_work[np.abs(in_work) > LEAST_TRAVEL][0]
    return Run(name, axis * np.sign(leading), points[0])


def _collect_stations(
    geometry: HexapodGeometry, readings: Sequence[Reading], poses: list[Pose], runs: list[Run], in_reach: bool
) -> tuple[Stations, np.ndarray]:
    """Return the distinct stations and each reading's index among them; poses and runs per reading."""
    known: dict[tuple, int] = {}
    rows: list[tuple] = []
    ways: list[np.ndarray] = []  # of travel, where a run is a line that is passed forward or backward
    index = np.empty(len(readings), dtype=int)
    nominal = Structure.of(geometry)
    warming = len({r.temperatures for r in readings}) > 1  # else when it was does not matter, and passes are alike
    here: tuple | None = None
    before: int | None = None
    for n, (r, pose, run) in enumerate(zip(readings, poses, runs, strict=True)):
        place = (r.run, id(pose), r.commands)
        if here is not None and place != here:
            before = int(index[n - 1]) if readings[n - 1].run == r.run else None
        here = place
        # A station belongs to a run: lines that cross at a point pass it in different ways.
        came_from = rows[before] if before is not None and r.direction == FROM_PREVIOUS else None
        time = r.time if warming else np.nan
        key = (place, r.direction, None if came_from is None else before, r.temperatures, str(time), str(r.humidity))
        if key not in known:
            lengths = strut_lengths(nominal, pose)
            if in_reach:
                _check_reach(geometry, pose, lengths, r)
            commands = np.array(lengths if r.commands is None else r.commands, dtype=float)
            known[key] = len(rows)
            sense = _sense(pose, commands, came_from)
            rows.append((pose.position, pose.rotation, commands, sense, r.temperatures, time, r.humidity))
            ways.append(r.direction * run.axis if r.direction in (FORWARD, BACKWARD) else np.zeros(3))
        index[n] = known[key]
    columns = [np.array(column, dtype=float) for column in zip(*rows, strict=True)]
    along = np.array(ways).any(axis=1)
    columns[3][along] = Passes(geometry, *(part[along] for part in (*columns[:2], np.array(ways)))).senses()
    return Stations(*columns), index


def _check_reach(geometry: HexapodGeometry, pose: Pose, lengths: np.ndarray, reading: Reading) -> None:
    """Refuse a commanded pose that the machine cannot have taken."""
    refusal = geometry.refusal(pose.position, pose.rotation, lengths)
    if refusal is not None:
        problem = f"the commanded pose is out of the machine's reach: {refusal}"
        raise InputFileError(reading.source.file, _line(reading), problem)


def _sense(pose: Pose, commands: np.ndarray, came_from: tuple | None) -> np.ndarray:
    """Return the directions of motion at a station that is reached from the one before, shape (9,)."""
    if came_from is not None:
        change = np.concatenate([pose.position - came_from[0], commands - came_from[2]])
        return np.sign(change) * (np.abs(change) > SAME)
    return np.zeros(9)


def _swapped_note(run: Run, readings: list[Reading], points: np.ndarray) -> str:
    """Return a remark on a line whose rows run against both their directions, else nothing."""
    if not run.is_line:
        return ""
    along = points @ run.axis
    way = {direction: _way(readings, along, direction) for direction in (FORWARD, BACKWARD)}
    if not way[FORWARD] < 0.0 < way[BACKWARD]:
        return ""
    return f"{readings[0].source}: run {run.name}: rows called forward run backward and vice versa; swapped?"


def _way(readings: list[Reading], along: np.ndarray, direction: int) -> float:
    """Return the way from the first to the last row of the first pass in a direction, m."""
    chosen = [(r.cycle, r.channel, a) for r, a in zip(readings, along, strict=True) if r.direction == direction]
    first_pass = [a for cycle, channel, a in chosen if (cycle, channel) == chosen[0][:2]]
    return float(first_pass[-1] - first_pass[0]) if first_pass else 0.0


def joined(sets: Sequence[MeasurementSet]) -> MeasurementSet:
    """Return several sets of one machine as one; runs of equal names stay apart.

    Raises
    ------
    InputFileError
        Sets of different measured points, or a file twice.
    """
    first = sets[0]
    hashes = [sha for s in sets for _, sha in s.files]
    for s in sets:
        for name, sha in s.files:
            if hashes.count(sha) > 1:
                raise InputFileError(name, "", "is given twice: its readings would count twice")
    if len(sets) == 1:
        return first
    if any(np.abs(other.probe - first.probe).max() > SAME for other in sets[1:]):
        raise InputFileError("measurements", "", "files with different measured points cannot be fitted together")
    stations_before = np.cumsum([0, *(len(s.stations) for s in sets)])[:-1]
    runs_before = np.cumsum([0, *(len(s.runs) for s in sets)])[:-1]

    def together(name: str) -> np.ndarray:
        return np.concatenate([getattr(s, name) for s in sets])

    return MeasurementSet(
        geometry=first.geometry,
        probe=first.probe,
        runs=tuple(run for s in sets for run in s.runs),
        stations=Stations(*(np.concatenate([getattr(s.stations, c.name) for s in sets]) for c in fields(Stations))),
        station=np.concatenate([s.station + n for s, n in zip(sets, stations_before, strict=True)]),
        run=np.concatenate([s.run + n for s, n in zip(sets, runs_before, strict=True)]),
        cycle=together("cycle"),
        direction=together("direction"),
        channel=together("channel"),
        value=together("value"),
        uncertainty=together("uncertainty"),
        centre=together("centre"),
        sources=tuple(source for s in sets for source in s.sources),
        files=tuple(file for s in sets for file in s.files),
        notes=tuple(note for s in sets for note in s.notes),
    )
