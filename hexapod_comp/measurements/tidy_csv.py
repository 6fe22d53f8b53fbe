"""Tidy CSV files of measurements, one reading a row: the door through which every instrument's data come in.

Columns
-------
``run``
    Name. Readings of one run share the instrument's set-up: one unknown zero per channel. The same name in
    two files means two runs; they are then called ``name [file]``.
``direction``
    ``forward``: travelling along the first of x, y, z of the work frame that moves; ``backward``; ``sequence``:
    from the row before to this one (rows in the order of measuring); empty: not known.
``x_mm``, ``y_mm``, ``z_mm``; ``alpha_deg``, ``beta_deg``, ``gamma_deg`` or ``qx``, ``qy``, ``qz``, ``qw``
    Commanded pose of the tool in the work frame, as in every pose file (:func:`hexapod_comp.formats.csv.read_poses`).
``channel``, ``value``, ``unit``
    What was read (below), how much, and in what: m, mm, um, in; rad, mrad, urad, deg, arcsec; empty for quaternions.
``cycle`` (optional)
    Which of several passes, from 1. The same reading twice in a pass is refused.
``uncertainty`` (optional)
    Standard deviation, in the value's unit; may be empty.
``temperature_degC`` (optional)
    Of the air, and of the whole machine unless ``strut_1_degC`` … ``strut_6_degC``, ``base_degC``,
    ``platform_degC`` say otherwise. Without any, 20 °C. Where one part alone has a column, its sensor stands for all.
``time_s`` (optional)
    When the row was read, on one clock for all files: what shows how late parts follow their sensors.
``centre_x_mm``, ``centre_y_mm``, ``centre_z_mm`` (for lengths)
    From where the length is read, in the work frame, known to some millimetres: the fixed ball of a ball bar, the
    station, the sphere. Centres of one run belong to one body, such as a ball plate: only as a whole it may stand
    elsewhere.
``zero`` (optional)
    ``known`` where lengths are known as a whole, with a calibrated bar or sphere; else their run has an unknown zero.
``instrument_index``, ``pressure_kPa``, ``humidity_percent`` (optional)
    The refractive index with which the instrument turned its counts into lengths; 1 when it counts vacuum
    wavelengths. A row that has one is corrected to the air of that row (Ciddor), which needs its temperature,
    pressure and relative humidity. Empty: the instrument has corrected itself, nothing is done. The humidity also acts
    on struts that swell, with or without an index.

Channels
--------
``linear``
    Displacement read minus commanded displacement, along the line, positive as ``forward``.
``straightness_x`` … ``_z``, ``rotation_x`` … ``_z``
    Displacement along, rotation about an axis of the work frame (right-hand), minus that commanded.
``roll``, ``pitch``, ``yaw``
    Of lines parallel to an axis of the work frame. Roll is about the line. On x lines pitch is about y, yaw about
    z; on y lines about x and z; on z lines about x and y. All are positive as a right hand turns about the
    positive axis: an instrument that counts otherwise needs its sign changed first.
``position_x`` … ``_z``
    Measured coordinates of the point in the work frame, not their errors: what a tracker reads.
``quaternion_x`` … ``_w``
    Measured orientation of the tool in the work frame, four rows for one pose.
``attitude_x`` … ``_z``
    Or its error: the rotation vector from the commanded to the measured orientation, along the work frame's axes.
``length``
    Distance read from the centre to the measured point, from any zero: a ball bar's change of length, an
    interferometer's count, or always the same (0, say) at the poses at which a probe touches a sphere.
``displacement_x`` … ``_z``
    Displacement along an axis of the work frame minus that commanded, from any zero: an R-test at the tool's ball.
``strut_1`` … ``strut_6``
    Strut lengths that the machine was told, or that its encoders show, six rows for one pose: they then hold for
    all readings of that run, cycle, direction and pose. Without them the machine was told nominal lengths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputFileError, PoseError
from ..formats.csv import Table, exact
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..pose import Pose
from .air import Air, correct_displacement
from .readings import (
    AXES,
    CHANNELS,
    FROM_PREVIOUS,
    LEAST_TRAVEL,
    LENGTH,
    FileLine,
    MeasurementSet,
    Reading,
    attitude_error,
)
from .runs import assemble
from .tidy_rows import ALONG_LINES, QUATERNION_CHANNELS, TURN_AXES, TURNS, TidyRow, read_rows

PARALLEL = 1e-9
"""Largest cross component of a unit vector that still is parallel to an axis."""


def read_tidy(
    paths: str | Path | Sequence[str | Path],
    geometry: HexapodGeometry,
    probe: np.ndarray | None = None,
    in_reach: bool = True,
) -> MeasurementSet:
    """Read tidy CSV files (described above) as one set."""
    paths = [paths] if isinstance(paths, str | Path) else list(paths)
    readings: list[Reading] = []
    files: list[tuple[str, str]] = []
    notes: list[str] = []
    tables = [Table(path) for path in paths]
    _refuse_twice(tables)
    of_files = [read_rows(table) for table in tables]
    for table, rows, names in zip(tables, of_files, _run_names(tables, of_files), strict=True):
        own, corrected = _file_readings(table, rows, names, geometry, probe)
        readings += own
        files.append((Path(table.path).name, table.sha256))
        if corrected:
            notes.append(f"{table.path}: {corrected} readings corrected to the air of their rows (Ciddor)")
    return assemble(geometry, readings, probe, files, notes, in_reach)


def _refuse_twice(tables: Sequence[Table]) -> None:
    """Raise on a file given twice: its readings would count twice."""
    seen: dict[str, Table] = {}
    for table in tables:
        if table.sha256 in seen:
            raise InputFileError(table.path, "", f"is the same file as {seen[table.sha256].path}")
        seen[table.sha256] = table


def _run_names(tables: Sequence[Table], of_files: Sequence[Sequence[TidyRow]]) -> list[dict[str, str]]:
    """Return the names that the runs of each file get: their own where no other file has the same."""
    names = [{row.run for row in rows} for rows in of_files]
    short = [Path(table.path).name for table in tables]
    label = short if len(set(short)) == len(short) else [str(table.path) for table in tables]
    return [
        {name: f"{name} [{label[n]}]" if sum(name in other for other in names) > 1 else name for name in own}
        for n, own in enumerate(names)
    ]


def _file_readings(
    table: Table, rows: Sequence[TidyRow], names: dict[str, str], geometry: HexapodGeometry, probe: np.ndarray | None
) -> tuple[list[Reading], int]:
    """Return a file's readings, and how many of them were corrected for the air."""
    file = str(table.path)
    visits = _visits(rows)
    _refuse_duplicates(file, rows, visits)
    points = _points(rows, geometry, probe)
    lines = _lines(rows, points)
    commands = _commands(file, rows, visits)
    attitudes = _attitudes(file, rows, visits)
    corrected = _corrected(file, rows, lines, points)
    readings = []
    for n, row in enumerate(rows):
        if row.channel in STRUT_NAMES:
            continue
        if row.channel in QUATERNION_CHANNELS:
            pairs = attitudes.pop(visits[n], [])
        elif row.channel.startswith("position_"):
            pairs = [(row.channel, _minus(row, float(points[n, AXES.index(row.channel[-1])])))]
        elif row.channel == CHANNELS[LENGTH] and row.centre is not None:
            pairs = [(row.channel, _minus(row, math.dist(points[n], row.centre)))]
        else:
            pairs = [(_channel(file, row, lines), corrected.get(n, row.value))]
        for channel, value in pairs:
            reading = (names[row.run], row.cycle, row.direction, row.pose, channel, value, row.uncertainty)
            source = FileLine(file, row.line)
            state = row.temperatures, commands.get(visits[n]) if commands else None, source, row.time
            readings.append(Reading(*reading, *state, row.centre, row.known_zero, row.humidity))
    if not readings:
        raise InputFileError(file, "", "holds strut readings only: nothing that was measured")
    return readings, len(corrected)


def _visits(rows: Sequence[TidyRow]) -> list[tuple]:
    """Return for each row what readings taken together share; a sequence may come back to a place."""
    visits: list[tuple] = []
    count, before = 0, None
    for row in rows:
        place = (row.run, row.cycle, row.direction, id(row.pose))
        if row.direction == FROM_PREVIOUS and place != before:
            count += 1
        before = place
        visits.append((*place, count if row.direction == FROM_PREVIOUS else 0))
    return visits


def _refuse_duplicates(file: str, rows: Sequence[TidyRow], visits: Sequence[tuple]) -> None:
    """Raise on a channel read twice in one pass at one place."""
    seen: dict[tuple, int] = {}
    for row, visit in zip(rows, visits, strict=True):
        first = seen.setdefault((visit, row.channel, row.centre), row.line)
        if first != row.line:
            problem = f"reads {row.channel} again at the place of line {first}; number repeated passes in column cycle"
            raise InputFileError(file, f"line {row.line}", problem)


def _points(rows: Sequence[TidyRow], geometry: HexapodGeometry, probe: np.ndarray | None) -> np.ndarray:
    """Return the commanded place of the measured point in the work frame, shape (N, 3), m."""
    offset = np.zeros(3)
    if probe is not None:
        offset = geometry.tool.rotation.T @ (np.asarray(probe, dtype=float) - geometry.tool.position)
    if not offset.any():
        return np.array([row.pose.position for row in rows])
    return np.array([row.pose.position + row.pose.rotation @ offset for row in rows])


class _Line(NamedTuple):
    """A run's first point and its direction forward, in the work frame; no direction when it does not travel."""

    origin: np.ndarray
    axis: np.ndarray


def _lines(rows: Sequence[TidyRow], points: np.ndarray) -> dict[str, _Line]:
    """Return the lines of the runs that have channels of lines."""
    members: dict[str, list[int]] = {}
    for n, row in enumerate(rows):
        if row.channel.partition("_")[0] in ALONG_LINES:
            members.setdefault(row.run, []).append(n)
    lines = {}
    for run, indices in members.items():
        spread = points[indices] - points[indices[0]]
        far = spread[np.linalg.norm(spread, axis=1).argmax()]
        moving = np.flatnonzero(np.abs(far) > LEAST_TRAVEL)
        axis = far / np.linalg.norm(far) * np.sign(far[moving[0]]) if len(moving) else np.zeros(3)
        lines[run] = _Line(points[indices[0]], axis)
    return lines


def _commands(file: str, rows: Sequence[TidyRow], visits: Sequence[tuple]) -> dict[tuple, tuple[float, ...]]:
    """Return the strut commands of the visits that have them, m."""
    by_visit: dict[tuple, dict[str, TidyRow]] = {}
    for row, visit in zip(rows, visits, strict=True):
        if row.channel in STRUT_NAMES:
            if not math.isnan(row.uncertainty):
                raise InputFileError(file, f"line {row.line}, column uncertainty", "must be empty for a strut")
            by_visit.setdefault(visit, {})[row.channel] = row
    return {visit: _whole(file, group, STRUT_NAMES) for visit, group in by_visit.items()}


def _whole(file: str, group: dict[str, TidyRow], channels: Sequence[str]) -> tuple[float, ...]:
    """Return the values of channels that only make sense together."""
    for channel in channels:
        if channel not in group:
            line = next(iter(group.values())).line
            together = f"{channels[0]} … {channels[-1]} belong together"
            raise InputFileError(file, f"line {line}", f"{together}; {channel} is missing at this pose")
    return tuple(group[channel].value for channel in channels)


def _attitudes(file: str, rows: Sequence[TidyRow], visits: Sequence[tuple]) -> dict[tuple, list[tuple[str, float]]]:
    """Return attitude errors from measured quaternions, rad along the work frame's axes."""
    by_visit: dict[tuple, dict[str, TidyRow]] = {}
    for row, visit in zip(rows, visits, strict=True):
        if row.channel in QUATERNION_CHANNELS:
            if not math.isnan(row.uncertainty):
                wrong = "must be empty for a quaternion; give attitude_x, attitude_y, attitude_z instead"
                raise InputFileError(file, f"line {row.line}, column uncertainty", wrong)
            by_visit.setdefault(visit, {})[row.channel] = row
    errors = {}
    for visit, group in by_visit.items():
        first = next(iter(group.values()))
        try:
            measured = Pose.from_quaternion(np.zeros(3), np.array(_whole(file, group, QUATERNION_CHANNELS)))
        except PoseError as problem:
            where = f"line {first.line}, channels {QUATERNION_CHANNELS[0]} …"
            raise InputFileError(file, where, str(problem)) from problem
        error = attitude_error(measured.rotation, first.pose.rotation)
        errors[visit] = [(f"attitude_{axis}", float(value)) for axis, value in zip(AXES, error, strict=True)]
    return errors


def _channel(file: str, row: TidyRow, lines: dict[str, _Line]) -> str:
    """Return the channel of a set for a channel of a file."""
    if row.channel not in TURNS:
        return row.channel
    along = np.flatnonzero(np.abs(lines[row.run].axis) > 1.0 - PARALLEL)
    if not len(along):
        problem = f"{row.channel} is for lines parallel to an axis of the work frame; use rotation_x, _y or _z"
        raise InputFileError(file, f"line {row.line}, column channel", problem)
    return f"rotation_{AXES[TURN_AXES[along[0]][TURNS.index(row.channel)]]}"


def _corrected(file: str, rows: Sequence[TidyRow], lines: dict[str, _Line], points: np.ndarray) -> dict[int, float]:
    """Return the values of the rows that are to be corrected for the air, by the rows' number."""
    chosen = [n for n, row in enumerate(rows) if row.air is not None]
    if not chosen:
        return {}
    commanded = np.zeros(len(chosen))
    for k, n in enumerate(chosen):
        row = rows[n]
        if row.channel.partition("_")[0] not in ALONG_LINES:
            problem = f"is for what a laser reads along a line; a {row.channel} must come corrected"
            raise InputFileError(file, f"line {row.line}, column instrument_index", problem)
        if row.channel == "linear":
            commanded[k] = lines[row.run].axis @ (points[n] - lines[row.run].origin)
    index, *air = np.array([rows[n].air for n in chosen]).T
    shown = np.array([rows[n].value for n in chosen]) + commanded
    true = correct_displacement(shown, Air(*air), index) - commanded
    return dict(zip(chosen, true.tolist(), strict=True))


def _minus(row: TidyRow, commanded: float) -> float:
    """Return a coordinate minus the commanded one, without losing the digits that both share."""
    power = round(math.log10(row.unit))
    if 10.0**power != row.unit:
        return row.value - commanded
    return float(exact(row.text, float(row.text)).scaleb(power) - Decimal(repr(commanded)))
