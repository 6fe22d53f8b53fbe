"""Reads and writes tidy CSV files, in which each row is one reading of any instrument."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputFileError, PoseError
from ..formats.csv import Table, csv_text, exact, si_from_text
from ..formats.outputs import write_text
from ..formats.schema import DIMENSIONS, UNITS, decimal_shift, file_errors, spellings
from ..machine.arrays import changed_rows
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths
from ..machine.load import EARTH, LARGEST_MASS, check_gravity
from ..machine.pose_files import ANGLE_COLUMNS, POSITION_COLUMNS, poses_of
from ..machine.temperatures import HUMIDITY_RANGE, REFERENCE_TEMPERATURE, TEMPERATURE, Temperatures
from ..pose import Pose, angles_from_rotation, attitude_error
from .air import AIR_RANGES, LARGEST_INDEX, Air, correct_displacement
from .readings import (
    AXES,
    BACKWARD,
    CHANNELS,
    FORWARD,
    FROM_PREVIOUS,
    LEAST_TRAVEL,
    LENGTH,
    LINE_KINDS,
    PARALLEL,
    UNKNOWN,
    FileLine,
    MeasurementSet,
    Reading,
    si_unit,
)
from .runs import MeasuredFile

# Words of the column ``direction``
DIRECTIONS = {"forward": FORWARD, "backward": BACKWARD, "sequence": FROM_PREVIOUS, "": UNKNOWN}
TURNS = ("roll", "pitch", "yaw")  # channels in files only; their axes of rotation depend on the line's direction
TURN_AXES = ((0, 1, 2), (1, 0, 2), (2, 0, 1))  # axes of roll, pitch and yaw: on a line along x, along y, along z
QUATERNION_CHANNELS = tuple(f"quaternion_{c}" for c in "xyzw")
# SI unit of each channel of a file; "" for a pure number
SI_UNITS = {
    **{channel: si_unit(channel) for channel in CHANNELS},
    **dict.fromkeys(TURNS, "rad"),
    **dict.fromkeys(QUATERNION_CHANNELS, ""),
    **dict.fromkeys(STRUT_NAMES, "m"),
}

CYCLE = re.compile("0*[1-9][0-9]{0,8}")
ALONG_LINES = (*LINE_KINDS, *TURNS)  # kinds that are read on a line by a laser, and so affected by the air
LATEST = 1e11  # s since 1970: about the year 5000; a larger time is probably in nanoseconds
FURTHEST_CENTRE = 100.0  # largest magnitude of a coordinate of a centre, m


class Range(NamedTuple):
    low: float  # smallest number that is allowed in a column, SI; temperatures in °C
    high: float  # largest number
    allowed: str  # the range as text, for messages
    unit: str = ""  # unit in which the column is written; other units can be read; "": a pure number
    blank: bool = True  # whether a cell may be empty

    def of(self, table: Table, index: int, unit: float) -> np.ndarray:
        """Return a column's numbers in SI units, with NaN for an empty cell; refuse a number outside the range."""
        values = table.values(index, unit, self.blank)
        wrong = (values < self.low) | (values > self.high)
        if wrong.any():
            line, cells = table.rows[int(wrong.argmax())]
            where = f"line {line}, column {table.header[index]}"
            raise InputFileError(table.path, where, f"must be within {self.allowed}", cells[index])
        return values

    def read(self, table: Table, name: str) -> np.ndarray:
        """Return the numbers in the column called `name` + unit, in SI units; NaN for each row if it is missing."""
        column = table.column(name, DIMENSIONS.get(self.unit))
        return np.full(len(table.rows), np.nan) if column is None else self.of(table, *column)


WARMTH = Range(*TEMPERATURE.range, TEMPERATURE.allowed, "degC", blank=False)
TIME = Range(-LATEST, LATEST, f"±{LATEST:g} s", "s")
INDEX = Range(1.0, LARGEST_INDEX, f"1…{LARGEST_INDEX:g}")
PRESSURE = Range(*AIR_RANGES["pressure"], "kPa")
HUMIDITY = Range(*HUMIDITY_RANGE, "{:g}…{:g} %".format(*(100.0 * end for end in HUMIDITY_RANGE)), "percent")
AIR_TEMPERATURE = Range(*AIR_RANGES["temperature"], "degC")
PLACE = Range(-FURTHEST_CENTRE, FURTHEST_CENTRE, f"±{FURTHEST_CENTRE:g} m", "mm")
MASS = Range(0.0, LARGEST_MASS, f"0…{LARGEST_MASS:g} kg", "kg")
PULL = Range(-EARTH[1], EARTH[1], f"±{EARTH[1]:g} m/s²", "m_s2")
# Groups of columns: a row must fill all columns of a group, or none
CENTRE = {f"centre_{axis}": PLACE for axis in AXES}
PAYLOAD = {"payload": MASS} | {f"payload_{axis}": PLACE for axis in AXES}
GRAVITY = {f"gravity_{axis}": PULL for axis in AXES}


def _stacked(table: Table, columns: Mapping[str, Range]) -> np.ndarray:
    """Return the numbers of a group of columns, (rows, columns); NaN for empty cells."""
    return np.stack([column.read(table, name) for name, column in columns.items()], axis=1)


def _complete(table: Table, what: str, columns: Mapping[str, Range], values: np.ndarray) -> np.ndarray:
    """Return the `values` of a group of columns; refuse a row that fills only some of the columns."""
    blank = np.isnan(values)
    torn = blank.any(axis=1) & ~blank.all(axis=1)
    if torn.any():
        row = int(torn.argmax())
        missing = list(columns)[int(blank[row].argmax())]
        where, problem = f"line {table.rows[row][0]}", f"fills only some columns of the {what}: {missing} is empty"
        raise InputFileError(table.path, where, problem)
    return values


def _texts(table: Table, name: str, missing: str = "") -> list[str]:
    """Return the cells of an optional column; if the file lacks the column, return `missing` for each row."""
    return [missing] * len(table.rows) if table.column(name, None) is None else table.texts(name)


def _uncertainty(table: Table, line: int, cells: Sequence[str], index: int, unit: float) -> float:
    """Return a row's standard deviation in SI; NaN for an empty cell."""
    text = cells[index]
    if not text.strip():
        return math.nan
    value = si_from_text(text, table.number(line, index, text), unit)
    if value <= 0.0:
        raise InputFileError(table.path, f"line {line}, column uncertainty", "must be above zero, or empty", text)
    return value


def _poses(table: Table) -> list[Pose]:
    """Return the commanded pose of each row; rows with equal poses share one Pose object."""
    positions, rotations = poses_of(table)
    first, number = changed_rows(np.hstack([positions, rotations.reshape(-1, 9)]))
    known: dict[bytes, Pose] = {}
    poses = []
    for position, rotation in zip(positions[first], rotations[first], strict=True):
        key = position.tobytes() + rotation.tobytes()
        if key not in known:
            known[key] = Pose(position, rotation)
        poses.append(known[key])
    return [poses[n] for n in number.tolist()]


def _temperatures(table: Table) -> list[tuple[float, ...]]:
    """Return the temperatures of struts 1–6, base and platform in each row, °C."""
    everywhere = np.nan_to_num(WARMTH.read(table, "temperature"), nan=REFERENCE_TEMPERATURE)
    columns = (WARMTH.read(table, name) for name in Temperatures.NAMES)
    rows = np.stack([np.where(np.isnan(own), everywhere, own) for own in columns], axis=1)
    return list(map(tuple, rows.tolist()))


def _air(table: Table) -> np.ndarray:
    """Return (rows, 4): the refractive index that the instrument assumed (NaN: no correction), and the temperature, °C,
    pressure, Pa, and humidity of the air.
    """
    index, pressure = INDEX.read(table, "instrument_index"), PRESSURE.read(table, "pressure")
    wanted = np.isfinite(index)
    if not wanted.any():
        return np.full((len(index), 4), np.nan)
    air = [index, AIR_TEMPERATURE.read(table, "temperature"), pressure, HUMIDITY.read(table, "humidity")]
    lacking = wanted & np.isnan(air).any(axis=0)
    if lacking.any():
        problem = "has an instrument_index, so it needs temperature_degC, pressure_kPa and humidity_percent too"
        raise InputFileError(table.path, f"line {table.rows[int(lacking.argmax())][0]}", problem)
    return np.column_stack(air)


def _loads(table: Table) -> list[tuple[float, ...]]:
    """Return each row's payload, kg, its centre in platform, m, and gravity in base, m/s²; NaN for empty cells."""
    payload = _stacked(table, PAYLOAD)
    payload[payload[:, 0] == 0.0, 1:] = 0.0  # without mass the centre of mass has no meaning, and may be empty
    payload = _complete(table, "load", PAYLOAD, payload)
    gravity = _complete(table, "load", GRAVITY, _stacked(table, GRAVITY))
    for n in changed_rows(np.nan_to_num(gravity))[0]:
        if np.isfinite(gravity[n, 0]):
            with file_errors(table.path):
                check_gravity(f"line {table.rows[n][0]}: gravity", gravity[n])
    return list(map(tuple, np.hstack([payload, gravity]).tolist()))


def _unit_size(table: Table, line: int, channel: str, unit: str) -> float:
    """Return the factor from `unit` to SI; refuse an unknown channel, and a unit that the channel cannot have."""
    if channel not in SI_UNITS:
        allowed = f"must be one of {', '.join(SI_UNITS)}"
        raise InputFileError(table.path, f"line {line}, column channel", allowed, channel)
    dimension = DIMENSIONS.get(SI_UNITS[channel])
    units = spellings(dimension) if dimension else {"": 1.0}
    if unit not in units:
        allowed = f"must be {' or '.join(UNITS[dimension])}" if dimension else "must be empty"
        raise InputFileError(table.path, f"line {line}, column unit", f"{allowed} for {channel}", unit)
    return units[unit]


class _TidyFile:
    """Rows of a tidy file as readings, with the machine's stop at which each was read, and the lines of the runs."""

    def __init__(self, table: Table, geometry: HexapodGeometry, probe: np.ndarray | None) -> None:
        self._table, self._file = table, str(table.path)
        # For each row: the reading; the text of its value, with the factor from the value's unit to SI
        self._rows, self._exact = list[Reading](), list[tuple[str, float]]()
        self._air = _air(table)
        self._read_rows()
        self._visits = list(self._numbered_visits())
        self._refuse_duplicates()
        # Commanded position of the measured point in the work frame, (rows, 3), m
        self._points = np.array([r.pose.position for r in self._rows])
        if probe is not None:
            offset = geometry.tool.rotation.T @ (np.asarray(probe, dtype=float) - geometry.tool.position)
            self._points += np.array([r.pose.rotation @ offset for r in self._rows])
        self._axes = dict(self._lines())

    def _read_rows(self) -> None:
        table = self._table
        runs, channels, units, cycles = *map(table.texts, ("run", "channel", "unit")), _texts(table, "cycle", "1")
        directions = table.texts("direction")
        directions = table.meanings("direction", directions, DIRECTIONS, "forward, backward, sequence or empty")
        numbers = {text: int(text) for text in set(cycles) if CYCLE.fullmatch(text)}
        cycles = table.meanings("cycle", cycles, numbers, "a whole number from 1")
        poses, temperatures = _poses(table), _temperatures(table)
        rows = _complete(table, "centre", CENTRE, _stacked(table, CENTRE)).tolist()
        centres = [None if math.isnan(row[0]) else tuple(row) for row in rows]
        known = table.meanings("zero", _texts(table, "zero"), {"known": True, "": False}, "known or empty")
        times, humidities = TIME.read(table, "time").tolist(), HUMIDITY.read(table, "humidity").tolist()
        loads, slopes = _loads(table), _texts(table, "slope")
        (value_column, _), uncertain = table.required(("value",), None)[0], table.column("uncertainty", None)
        table.refuse_unknown()
        sizes: dict[tuple[str, str], float] = {}
        for n, (line, cells) in enumerate(table.rows):
            if not runs[n]:
                raise InputFileError(table.path, f"line {line}, column run", "must be a name")
            unit, text = sizes.get((channels[n], units[n])), cells[value_column]
            if unit is None:
                unit = sizes[channels[n], units[n]] = _unit_size(table, line, channels[n], units[n])
            value = si_from_text(text, table.number(line, value_column, text), unit) if text.strip() else math.nan
            uncertainty = math.nan if uncertain is None else _uncertainty(table, line, cells, uncertain[0], unit)
            place = runs[n], cycles[n], directions[n], poses[n], channels[n]
            state = value, uncertainty, temperatures[n], None, FileLine(self._file, line)
            details = times[n], centres[n], known[n], humidities[n], loads[n], slopes[n]
            self._rows.append(Reading._make((*place, *state, *details)))
            self._exact.append((text, unit))
        self.missed = sum(math.isnan(r.value) for r in self._rows)
        if self.missed == len(self._rows):
            raise InputFileError(self._file, "column value", "is empty in every row")

    def _numbered_visits(self) -> Iterator[tuple]:
        """Yield a key for each row; rows that were read at the same stop of the machine have equal keys.

        With the direction ``sequence`` a run can visit a pose twice, so keys of such rows contain the stop's number.
        """
        count, before = 0, None
        for r in self._rows:
            place = (r.run, r.cycle, r.direction, id(r.pose))
            count += r.direction == FROM_PREVIOUS and place != before
            before = place
            yield (*place, count if r.direction == FROM_PREVIOUS else 0)

    def _refuse_duplicates(self) -> None:
        """Raise an InputFileError if a channel is read twice at one stop of the machine."""
        seen: dict[tuple, int] = {}
        for r, visit in zip(self._rows, self._visits, strict=True):
            first = seen.setdefault((visit, r.channel, r.centre), r.source.line)
            if first != r.source.line:
                problem = f"reads {r.channel} again at the pose of line {first}; number repeated passes in column cycle"
                raise self._error(r, problem)

    def _error(self, reading: Reading, problem: str, column: str = "") -> InputFileError:
        return InputFileError(self._file, f"line {reading.source.line}{column}", problem)

    def _lines(self) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray]]]:
        """Yield each run on a line: its name, and its first point (m) and forward direction (0: no travel) in work."""
        members: dict[str, list[int]] = {}
        for n, r in enumerate(self._rows):
            if r.channel.partition("_")[0] in ALONG_LINES:
                members.setdefault(r.run, []).append(n)
        for run, indices in members.items():
            origin = self._points[indices[0]]
            spread = self._points[indices] - origin
            far = spread[np.linalg.norm(spread, axis=1).argmax()]
            moving = np.flatnonzero(np.abs(far) > LEAST_TRAVEL)
            forward = far / np.linalg.norm(far) * np.sign(far[moving[0]]) if len(moving) else np.zeros(3)
            yield run, (origin, forward)

    def readings(self) -> tuple[list[Reading], int]:
        """Return the readings, with actual − commanded as values, and how many of them were corrected for the air."""
        commands = {visit: values for visit, _, values in self._whole(STRUT_NAMES, "must be empty for a strut")}
        attitudes, corrected = self._attitudes(), self._corrected()
        readings: list[Reading] = []
        for n, r in enumerate(self._rows):
            channel, value = r.channel, corrected.get(n, r.value)
            if channel in STRUT_NAMES:
                continue
            if commands:
                r = r._replace(commands=commands.get(self._visits[n]))
            if channel in QUATERNION_CHANNELS:  # a stop's first quaternion row becomes its three attitude readings
                errors = zip(AXES, attitudes.pop(self._visits[n], ()), strict=False)
                readings += [r._replace(channel=f"attitude_{axis}", value=error) for axis, error in errors]
                continue
            if channel.startswith("position_"):
                value = self._minus(n, float(self._points[n, AXES.index(channel[-1])]))
            elif channel == CHANNELS[LENGTH] and r.centre is not None:
                value = self._minus(n, math.dist(self._points[n], r.centre))
            elif channel in TURNS:
                channel = self._rotation(r)
            readings.append(r._replace(channel=channel, value=value))
        if not readings:
            raise InputFileError(self._file, "", "contains only readings of struts; a reading of the tool is needed")
        return readings, len(corrected)

    def _whole(self, channels: Sequence[str], wrong: str) -> Iterator[tuple[tuple, Reading, tuple[float, ...]]]:
        """Yield, for each stop at which `channels` were read: its key, its first reading, the values of all `channels`.

        Refuse a stop at which only some of them were read. Refuse a stated standard deviation with the message `wrong`.
        """
        by_visit: dict[tuple, dict[str, Reading]] = {}
        for r, visit in zip(self._rows, self._visits, strict=True):
            if r.channel in channels and not math.isnan(r.value):
                if not math.isnan(r.uncertainty):
                    raise self._error(r, wrong, ", column uncertainty")
                by_visit.setdefault(visit, {})[r.channel] = r
        for visit, group in by_visit.items():
            first = next(iter(group.values()))
            for channel in channels:
                if channel not in group:
                    problem = f"{channels[0]} … {channels[-1]} belong together; {channel} is missing at this pose"
                    if first.direction == FROM_PREVIOUS:
                        problem += "; in a sequence the rows of one stop must follow each other"
                    raise self._error(first, problem)
            yield visit, first, tuple(group[channel].value for channel in channels)

    def _attitudes(self) -> dict[tuple, tuple[float, ...]]:
        """Return the attitude error of each stop with a measured quaternion, rad about the axes of the work frame."""
        errors = {}
        wrong = "must be empty for a quaternion; give attitude_x, attitude_y, attitude_z instead"
        for visit, first, values in self._whole(QUATERNION_CHANNELS, wrong):
            try:
                measured = Pose.from_quaternion(np.zeros(3), np.array(values))
            except PoseError as problem:
                raise self._error(first, str(problem), f", channels {QUATERNION_CHANNELS[0]} …") from problem
            errors[visit] = tuple(attitude_error(measured.rotation, first.pose.rotation).tolist())
        return errors

    def _rotation(self, reading: Reading) -> str:
        """Return the channel ``rotation_…`` of a reading of roll, pitch or yaw."""
        along = np.flatnonzero(np.abs(self._axes[reading.run][1]) > PARALLEL)
        if not len(along):
            problem = f"{reading.channel} needs a line parallel to a work axis; use rotation_x, _y or _z"
            raise self._error(reading, problem, ", column channel")
        return f"rotation_{AXES[TURN_AXES[along[0]][TURNS.index(reading.channel)]]}"

    def _corrected(self) -> dict[int, float]:
        """Return the values after the correction for the air, m or rad, by the index of the row."""
        chosen = np.flatnonzero(np.isfinite(self._air[:, 0]))
        commanded = np.zeros(len(chosen))
        for k, n in enumerate(chosen):
            r = self._rows[n]
            if r.channel.partition("_")[0] not in ALONG_LINES:
                problem = "is only for readings of a laser along a line; leave it empty"
                problem += f", and give values of {r.channel} that are corrected for the air"
                raise self._error(r, problem, ", column instrument_index")
            if r.channel == "linear":
                origin, forward = self._axes[r.run]
                commanded[k] = forward @ (self._points[n] - origin)
        index, *air = self._air[chosen].T
        shown = np.array([self._rows[n].value for n in chosen]) + commanded
        true = correct_displacement(shown, Air(*air), index) - commanded
        return dict(zip(chosen.tolist(), true.tolist(), strict=True))

    def _minus(self, n: int, commanded: float) -> float:
        """Return the measured coordinate of row `n` minus `commanded`, m; without rounding if read in m, mm or µm."""
        text, unit = self._exact[n]
        power = round(math.log10(unit))
        if 10.0**power != unit or math.isnan(self._rows[n].value):
            return self._rows[n].value - commanded
        return float(exact(text, float(text)).scaleb(power) - Decimal(repr(commanded)))


def read_tidy(path: str | Path, geometry: HexapodGeometry, probe: np.ndarray | None = None) -> MeasuredFile:
    """Read a tidy CSV file; `probe` is the measured point in ``platform``, m, by default the tool's tip."""
    table = Table(path)
    if not {"run", "channel"}.intersection(table.header):
        problem = "has no column run and no column channel: a file with one pose in each row needs --columns (columns)"
        raise InputFileError(path, "header", problem)
    file = _TidyFile(table, geometry, probe)
    readings, corrected = file.readings()
    notes = [f"{path}: {corrected} readings were corrected for the air in their row (Ciddor)"] if corrected else []
    if file.missed:
        notes.append(f"{path}: {file.missed} of {len(table.rows)} rows have no value: nothing was read at these stops")
    return MeasuredFile(path, table.sha256, readings, notes, table.comments)


def write_measurements(measurements: MeasurementSet, path: str | Path, remark: str = "") -> None:
    """Write a tidy CSV file, from which :func:`read_tidy` returns the same numbers exactly, with `remark` as line 1."""
    comment = f"# {remark}\n" if remark else ""
    if not np.array_equal(measurements.probe, measurements.geometry.tool.position):
        point = ", ".join(_cells(measurements.probe, "mm"))
        comment += f"# measured point in the platform frame, mm: {point}\n"
    write_text(path, comment + csv_text(_csv_rows(measurements)))


def _csv_rows(m: MeasurementSet) -> Iterator[list[str]]:
    """Yield the header and the rows of a tidy file, without empty columns."""
    words = {number: word for word, number in DIRECTIONS.items()}
    stations, work, tool = m.stations, m.geometry.work, m.geometry.tool
    tips = stations.positions + stations.rotations @ tool.position
    positions = ((tips - work.position) @ work.rotation).round(13)  # m in work
    rotations = work.rotation.T @ stations.rotations @ tool.rotation
    centres = ((m.centre - work.position) @ work.rotation).round(13)
    offset = tool.rotation.T @ (m.probe - tool.position)
    commanded = positions + rotations @ offset if offset.any() else positions
    angles = np.degrees(angles_from_rotation(rotations)).round(12) if (rotations != np.eye(3)).any() else None
    poses = _columns(dict.fromkeys(POSITION_COLUMNS, PLACE), positions)
    if angles is not None:
        poses |= {f"{name}_deg": _cells(turns, "deg") for name, turns in zip(ANGLE_COLUMNS, angles.T, strict=True)}
    one_run = [("known" if run.known_zero else "", run.slope) for run in m.runs]
    zeros, slopes = (list(texts) for texts in zip(*(one_run[n] for n in m.run), strict=True))
    of_readings = {**_columns(CENTRE, centres), "zero": zeros, "slope": slopes}
    others = {"humidity": HUMIDITY, "time": TIME, **PAYLOAD, **GRAVITY}
    values = np.column_stack([stations.humidity, stations.times, stations.loads])
    around = _temperature_columns(stations.temperatures) | _columns(others, values)
    of_readings, around = ({name: c for name, c in cells.items() if any(c)} for cells in (of_readings, around))
    uncertain = ["uncertainty"] * bool(np.isfinite(m.uncertainty).any())
    yield ["run", "direction", "cycle", *poses, "channel", "value", "unit", *uncertain, *of_readings, *around]
    of_reading, blank = _rows(of_readings, len(m)), [""] * (len(uncertain) + len(of_readings))
    pose_of, around_of = (_rows(cells, len(stations)) for cells in (poses, around))
    struts, written, before = _strut_cells(m), set[tuple](), None
    for n, station in enumerate(m.station.tolist()):
        direction, cycle = int(m.direction[n]), int(m.cycle[n])
        head = [m.runs[m.run[n]].name, words[direction], str(cycle), *pose_of[station]]
        visit = (direction, cycle, station)
        if station in struts and (visit not in written or (direction == FROM_PREVIOUS and visit != before)):
            for name, length in zip(STRUT_NAMES, struts[station], strict=True):
                yield [*head, name, length, "mm", *blank, *around_of[station]]
        written.add(visit)
        before = visit
        channel = CHANNELS[m.channel[n]]
        at = _commanded(channel, commanded[station], centres[n])
        cells = _value_cells(channel, float(m.value[n]), float(m.uncertainty[n]), at)
        yield [*head, channel, *cells[: 2 + len(uncertain)], *of_reading[n], *around_of[station]]


def _columns(columns: Mapping[str, Range], values: np.ndarray) -> dict[str, list[str]]:
    """Return the columns of `values`, (rows, columns), in SI units, as cells by header; a header ends in the unit."""
    given = zip(columns.items(), values.T, strict=True)
    return {f"{name}_{column.unit}": _cells(numbers, column.unit) for (name, column), numbers in given}


def _rows(columns: Mapping[str, Sequence[str]], count: int) -> list[tuple[str, ...]]:
    return list(zip(*columns.values(), strict=True)) if columns else [()] * count


def _cells(values: np.ndarray, unit: str) -> list[str]:
    """Convert numbers from SI units (angles: degrees) to decimal texts in `unit`, without rounding; "" for NaN."""
    numbers, digits = (values + 0.0).tolist(), _digits(unit)  # no −0
    return ["" if math.isnan(value) else _decimal_text(Decimal(repr(value)), digits) for value in numbers]


@cache
def _digits(unit: str) -> int:
    return -decimal_shift(UNITS[DIMENSIONS[unit]][unit])


def _decimal_text(number: Decimal, digits: int) -> str:
    text = format(number.scaleb(digits), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def _commanded(channel: str, point: np.ndarray, centre: np.ndarray) -> float:
    """Return the commanded coordinate or distance, m, that a file's values include; 0 if they are only errors."""
    kind, _, axis = channel.partition("_")
    if kind == "position":
        return float(point[AXES.index(axis)])
    return math.dist(point, centre) if kind == "length" else 0.0


def _value_cells(channel: str, value: float, uncertainty: float, commanded: float) -> list[str]:
    """Return value, unit and standard deviation of a reading as cells, without rounding."""
    unit = "mm" if channel.partition("_")[0] in ("position", "length") else f"u{si_unit(channel)}"
    shown = "" if math.isnan(value) else _decimal_text(Decimal(repr(value)) + Decimal(repr(commanded)), _digits(unit))
    return [shown, unit, *_cells(np.array([uncertainty]), unit)]


def _temperature_columns(values: np.ndarray) -> dict[str, list[str]]:
    """Return the temperature columns: none if all are 20 °C, one if all parts have equal temperatures, else eight."""
    if (values == REFERENCE_TEMPERATURE).all():
        return {}
    if (values == values[:, :1]).all():
        return _columns({"temperature": WARMTH}, values[:, :1])
    return _columns(dict.fromkeys(Temperatures.NAMES, WARMTH), values)


def _strut_cells(measurements: MeasurementSet) -> dict[int, list[str]]:
    """Return by station the strut commands, as cells in mm, if they differ from the nominal lengths there."""
    nominal, stations = Structure.of(measurements.geometry), measurements.stations
    return {
        n: _cells(commands, "mm")
        for n, commands in enumerate(stations.commands)
        if not np.array_equal(commands, strut_lengths(nominal, stations.pose(n)))
    }
