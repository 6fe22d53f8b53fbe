"""Reads wide CSV files: each row is a measured pose, in columns that a YAML file (the columns file) describes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ..errors import InputFileError, ModelError
from ..formats.csv import DEFAULT_LAYOUT, Layout, Table
from ..formats.schema import (
    MOST_NEIGHBOURS,
    PER_STRUT,
    Choice,
    KeyType,
    Names,
    Numbers,
    Section,
    Text,
    Unit,
    read_whole,
)
from ..formats.texts import did_you_mean
from ..formats.yaml import read_yaml
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import Structure, solve_poses, strut_lengths_batch
from ..machine.passes import Poses
from ..machine.pose_files import read_pose_arrays, rotations_of
from ..machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from ..pose import Pose, attitude_error
from .readings import AXES, FROM_PREVIOUS, UNKNOWN, FileLine, Reading
from .runs import MeasuredFile
from .tidy import HUMIDITY, TIME, WARMTH, Range

COLUMNS_FORMAT = "hexapod_comp/columns"
COLUMNS_VERSION = 1
ORDERS = {"sequence": FROM_PREVIOUS, "unknown": UNKNOWN}
EVERYWHERE = "everywhere"
# Allowed coverage factors; a 99.99 % interval of the normal distribution has the factor 3.9
COVERAGE_FACTORS = (0.5, 10.0)
WITH_DATE = re.compile("%[djcxsDF]")  # directives of ``strptime`` that contain the day
ZEROS = ("home", "given", "measured")  # where the strut lengths at encoder reading zero come from


@dataclass(frozen=True)
class UncertaintyColumns:
    columns: tuple[str, ...]  # one column for all axes, or one for each of three axes
    unit: float  # factor from a number in the file to σ in SI: unit of the number / coverage factor


class Deviation(KeyType):
    """Key of a columns file for standard deviations: one number for all rows, or columns with numbers for each row."""

    def __init__(self, dimension: str) -> None:
        self.dimension = dimension

    def read(self, section: Section, name: str, default: Any) -> float | UncertaintyColumns:
        if name not in section:
            return float(section.quantity(name, self.dimension, default=default))
        part, (low, high) = section.section(name), COVERAGE_FACTORS
        columns, unit = Names(1, 3).read_value(part, "columns"), part.unit("unit", self.dimension)
        factor = float(part.array("coverage_factor"))
        if not low <= factor <= high:
            raise part.error("coverage_factor", f"must be {low:g}…{high:g} (1 for standard deviations)", factor)
        part.finish()
        return UncertaintyColumns(columns, unit / factor)


@dataclass(frozen=True)
class PoseColumns:
    position: Annotated[tuple[str, ...], Names(3)]
    unit: Annotated[float, Unit("length")]
    # vector added to the positions in the file, m
    offset: Annotated[np.ndarray, Numbers("mm", (3,))] = field(default_factory=lambda: np.zeros(3))
    quaternion: Annotated[tuple[str, ...], Names(4)] = ()
    angles: Annotated[tuple[str, ...], Names(3)] = ()  # α, β, γ, in place of a quaternion
    angle_unit: Annotated[float | None, Unit("angle")] = None

    def __post_init__(self) -> None:
        if bool(self.angles) != (self.angle_unit is not None):
            raise ModelError("angle_unit", "belongs to the key angles: give both keys or neither")
        if self.angles and self.quaternion:
            raise ModelError("angles", "give either angles or a quaternion, not both", list(self.angles))

    @property
    def turn(self) -> tuple[str, ...]:
        return self.quaternion or self.angles


@dataclass(frozen=True)
class MeasuredPoses(PoseColumns):
    position_uncertainty: Annotated[float | UncertaintyColumns, Deviation("length")] = math.nan
    attitude_uncertainty: Annotated[float | UncertaintyColumns, Deviation("angle")] = math.nan


@dataclass(frozen=True)
class PoseFile:
    """File with the commanded poses of a wide file's rows."""

    file: Annotated[str, Text()]  # name of the file, in the folder of the columns file
    name: Annotated[str, Text()] = ""  # column of the wide file with the name of each row's pose; empty: row n, pose n

    def __post_init__(self) -> None:
        if Path(self.file).name != self.file:
            raise ModelError(
                "commanded.file", "must be a name without a folder: a file beside the columns file", self.file
            )


@dataclass(frozen=True)
class Humidity:
    column: Annotated[str, Text()]
    unit: Annotated[float, Unit("ratio")]


@dataclass(frozen=True)
class Times:
    columns: Annotated[tuple[str, ...], Names()]  # the texts of several columns are joined by spaces
    format: Annotated[str, Text()] = ""  # format for Python's ``strptime``; empty: a column of numbers
    unit: Annotated[float | None, Unit("time")] = None

    def __post_init__(self) -> None:
        if bool(self.format) == (self.unit is not None):
            raise ModelError("time", "needs one of the keys format and unit, not both")
        if self.unit is not None and len(self.columns) != 1:
            raise ModelError("time.columns", "must name exactly one column if unit is given", self.columns)


@dataclass(frozen=True)
class StrutColumns:
    readings: Annotated[tuple[str, ...], Names(6)]
    length_per_unit: Annotated[np.ndarray, Numbers("mm", PER_STRUT)]  # change of length per unit of the reading, m
    zero: Annotated[str, Choice(*ZEROS)] = "home"
    zero_length: Annotated[np.ndarray | None, Numbers("mm", PER_STRUT)] = (
        None  # strut lengths at encoder reading zero, m
    )

    def __post_init__(self) -> None:
        if (self.zero == "given") != (self.zero_length is not None):
            raise ModelError("struts.zero_length", "belongs to zero: given", self.zero)


def _commanded(section: Section, name: str) -> PoseColumns | PoseFile:
    part = section.section(name)
    return read_whole(PoseFile, part) if "file" in part else read_whole(PoseColumns, part)


def _temperature_columns(section: Section, name: str) -> dict[str, str]:
    """Return the temperature column of each part; parts without their own column have that of ``everywhere``."""
    part = section.section(name)
    part.unit("unit", "temperature")
    columns = {key: part.text(key) for key in (EVERYWHERE, *Temperatures.NAMES) if key in part}
    part.finish()
    if not columns:
        raise part.error(EVERYWHERE, "is missing: give this key, or keys of one or more parts")
    return columns


@dataclass(frozen=True)
class Columns:
    """Content of a columns file; None for a section that the file lacks."""

    measured: MeasuredPoses
    table: Layout = DEFAULT_LAYOUT
    commanded: Annotated[PoseColumns | PoseFile | None, KeyType(_commanded)] = None
    temperature: Annotated[dict[str, str], KeyType(_temperature_columns)] = field(default_factory=dict)
    run: Annotated[str, Text()] = ""
    order: Annotated[str, Choice(*ORDERS)] = "unknown"
    humidity: Humidity | None = None
    time: Times | None = None
    struts: StrutColumns | None = None

    def __post_init__(self) -> None:
        if self.commanded is None and self.struts is None:
            raise ModelError("commanded", "is missing: give this key, or struts, from which poses can be computed")
        if self.struts is not None and self.struts.zero == "measured" and not self.measured.turn:
            raise ModelError("struts.zero", "cannot be computed from measured poses without orientations", "measured")


def load_columns(path: str | Path) -> Columns:
    return read_whole(Columns, read_yaml(path, COLUMNS_FORMAT, COLUMNS_VERSION))


def read_wide(path: str | Path, columns_path: str | Path, geometry: HexapodGeometry) -> MeasuredFile:
    """Read a wide CSV file as one run: position readings and, if the file has orientations, attitude readings."""
    columns = load_columns(columns_path)
    table, notes = Table(path, columns.table), list[str]()
    measured = _read_poses(table, columns.measured)
    commands = None if columns.struts is None else _lengths(table, columns.struts, measured, geometry, notes)
    if isinstance(columns.commanded, PoseFile):
        commanded = _poses_of_file(table, columns.commanded, Path(columns_path))
    elif columns.commanded is not None:
        commanded = _read_poses(table, columns.commanded)
    else:
        commanded = _nominal_poses(table, geometry, np.asarray(commands))
    readings = list(_readings(table, columns, commanded, measured, commands))
    notes += table.notes
    notes += [f"{path}: columns not used: {', '.join(table.unknown)}"] if table.unknown else []
    return MeasuredFile(path, table.sha256, readings, notes)


def _read_numbers(table: Table, names: tuple[str, ...], unit: float) -> np.ndarray:
    """Return the numbers of the columns `names` in SI units, shape (rows, columns)."""
    return table.numbers([(index, unit) for index, _ in table.required(names, None)])


def _read_poses(table: Table, columns: PoseColumns) -> Poses:
    """Return each row's pose in the file's frame, with identity rotations if the file has no orientations."""
    positions = _read_numbers(table, columns.position, columns.unit) + columns.offset
    if not columns.turn:
        return positions, np.tile(np.eye(3), (len(positions), 1, 1))
    turns = _read_numbers(table, columns.turn, columns.angle_unit or 1.0)
    return positions, rotations_of(table, turns, ", ".join(columns.turn))


def _poses_of_file(table: Table, file: PoseFile, columns_path: Path) -> Poses:
    path = columns_path.with_name(file.file)
    labels, positions, rotations = read_pose_arrays(path)
    if not file.name:
        if len(labels) != len(table.rows):
            problem = f"has {len(table.rows)} rows, but {path.name} has {len(labels)} poses; give commanded.name"
            raise InputFileError(table.path, "", f"{problem}, or one pose for each row")
        return positions, rotations
    rows = {one.label: n for n, one in enumerate(labels)}
    if len(rows) != len(labels):
        raise InputFileError(path, "", "has two poses with the same name; with commanded.name all names must differ")
    numbers = []
    for (line, _), name in zip(table.rows, table.texts(file.name), strict=True):
        if name not in rows:
            problem = f"has no pose in {path.name}{did_you_mean(name, list(rows)[:MOST_NEIGHBOURS])}"
            raise InputFileError(table.path, f"line {line}, column {file.name}", problem, name)
        numbers.append(rows[name])
    return positions[numbers], rotations[numbers]


def _deviations(table: Table, given: float | UncertaintyColumns) -> np.ndarray:
    if not isinstance(given, UncertaintyColumns):
        return np.full((len(table.rows), 3), given)
    values = _read_numbers(table, given.columns, given.unit)
    if not (values > 0.0).all():
        row, column = np.argwhere(values <= 0.0)[0]
        where = f"line {table.rows[row][0]}, column {given.columns[column]}"
        raise InputFileError(table.path, where, "an uncertainty must be above zero", float(values[row, column]))
    return np.broadcast_to(values, (len(values), 3))


def _conditions(table: Table, columns: Columns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each row's part temperatures, (rows, 8), °C, its time, s, and relative humidity (both NaN if unknown)."""
    unknown, named, damp, time = np.full(len(table.rows), np.nan), columns.temperature, columns.humidity, columns.time

    def read(name: str | None, unit: float, within: Range, otherwise: np.ndarray) -> np.ndarray:
        if name is None:
            return otherwise
        return within._replace(blank=False).of(table, table.required((name,), None)[0][0], unit)

    everywhere = read(named.get(EVERYWHERE), 1.0, WARMTH, np.full_like(unknown, REFERENCE_TEMPERATURE))
    parts = [read(named.get(part), 1.0, WARMTH, everywhere) for part in Temperatures.NAMES]
    humidities = unknown if damp is None else read(damp.column, damp.unit, HUMIDITY, unknown)
    if time is not None and time.format:
        times = _clock_times(table, time)
    else:
        times = unknown if time is None else read(time.columns[0], time.unit or 1.0, TIME, unknown)
    return np.stack(parts, axis=1), times, humidities


def _clock_times(table: Table, time: Times) -> np.ndarray:
    """Return times, s since 1970, from columns with date and time of day; without a time zone they are UTC."""
    texts = [" ".join(parts) for parts in zip(*(table.texts(name) for name in time.columns), strict=True)]
    names, times = ", ".join(time.columns), np.empty(len(texts))
    for n, ((line, _), text) in enumerate(zip(table.rows, texts, strict=True)):
        try:
            moment = datetime.strptime(text, time.format)
        except (ValueError, re.error) as error:
            problem = f"does not match time.format, {time.format!r}"
            raise InputFileError(table.path, f"line {line}, column {names}", problem, text) from error
        times[n] = (moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)).timestamp()
        if n and times[n] < times[n - 1] and not WITH_DATE.search(time.format):
            problem = "is earlier than the row before; times past midnight need a date, too: columns: [date, time]"
            raise InputFileError(table.path, f"line {line}, column {names}", problem, text)
    return times


def _lengths(
    table: Table, struts: StrutColumns, measured: Poses, geometry: HexapodGeometry, notes: list[str]
) -> np.ndarray:
    """Return strut lengths, (rows, 6), m, from encoder readings; add a note if the encoders' zeros are estimated."""
    travel = _read_numbers(table, struts.readings, 1.0) * struts.length_per_unit
    structure = Structure.of(geometry)
    home = strut_lengths_batch(structure, geometry.home.position[None], geometry.home.rotation[None])[0]
    zero = {"home": home, "given": struts.zero_length}.get(struts.zero)
    if zero is None:
        platform = geometry.platform_poses(measured[0], measured[1])
        zero = (strut_lengths_batch(structure, *platform) - travel).mean(axis=0)
        shift = ", ".join(f"{name} {value * 1e3:+.3f}" for name, value in zip(STRUT_NAMES, zero - home, strict=True))
        text = "strut lengths at encoder reading zero were computed from the measured poses; their differences from"
        notes.append(f"{table.path}: {text} the lengths at home, mm: {shift}")
    return zero + travel


def _nominal_poses(table: Table, geometry: HexapodGeometry, lengths: np.ndarray) -> Poses:
    """Return the tool poses of the nominal machine with the strut `lengths`, (rows, 6), m."""
    usable = (lengths > 0.0).all(axis=1)
    if not usable.all():
        row = int(usable.argmin())
        problem = "the length of every strut must be above zero, m"
        raise InputFileError(table.path, f"line {table.rows[row][0]}", problem, lengths[row].tolist())
    solved = solve_poses(Structure.of(geometry), lengths, geometry.home)
    if not solved.ok.all():
        row = int(solved.ok.argmin())
        problem = "no pose of the nominal machine has these strut lengths, mm"
        raise InputFileError(table.path, f"line {table.rows[row][0]}", problem, (lengths[row] * 1e3).round(3).tolist())
    return geometry.tool_poses(solved.positions, solved.rotations)


def _readings(
    table: Table, columns: Columns, commanded: Poses, measured: Poses, commands: np.ndarray | None
) -> Iterator[Reading]:
    temperatures, times, humidities = _conditions(table, columns)
    found = columns.measured
    errors = [("position", measured[0] - commanded[0], _deviations(table, found.position_uncertainty))]
    if found.turn:
        turned = attitude_error(measured[1], commanded[1])
        errors.append(("attitude", turned, _deviations(table, found.attitude_uncertainty)))
    run = columns.run or Path(table.path).stem
    for n, (line, _) in enumerate(table.rows):
        pose = Pose(commanded[0][n], commanded[1][n])
        lengths = None if commands is None else tuple(commands[n].tolist())
        state = tuple(temperatures[n].tolist()), lengths, FileLine(str(table.path), line), float(times[n])
        for kind, values, spreads in errors:
            for axis, value, spread in zip(AXES, values[n].tolist(), spreads[n].tolist(), strict=True):
                place = (run, 1, ORDERS[columns.order], pose, f"{kind}_{axis}")
                yield Reading(*place, value, spread, *state, humidity=float(humidities[n]))
