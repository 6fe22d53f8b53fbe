"""Tidy CSV files of measurements, one reading a row: the door through which every instrument's data come in."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputFileError, PoseError
from ..formats.csv import Table, csv_text, exact, si_from_text
from ..formats.outputs import write_text
from ..formats.schema import UNITS, file_errors, spellings
from ..machine.arrays import changed_rows
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths
from ..machine.load import EARTH, LARGEST_MASS, check_gravity
from ..machine.pose_files import ANGLE_COLUMNS, POSITION_COLUMNS, poses_of
from ..machine.temperatures import REFERENCE_TEMPERATURE, TEMPERATURE_RANGE, Temperatures
from ..pose import Pose, angles_from_rotation, attitude_error
from .air import AIR_RANGES, LARGEST_INDEX, Air, correct_displacement
from .readings import (
    ANGULAR_KINDS,
    AXES,
    BACKWARD,
    CHANNELS,
    FORWARD,
    FROM_PREVIOUS,
    LEAST_TRAVEL,
    LENGTH,
    LINE_KINDS,
    UNKNOWN,
    FileLine,
    MeasurementSet,
    Reading,
)
from .runs import assemble

# Words of the column ``direction``
DIRECTIONS = {"forward": FORWARD, "backward": BACKWARD, "sequence": FROM_PREVIOUS, "": UNKNOWN}
TURNS = ("roll", "pitch", "yaw")  # rotations named after the line on which they are read
TURN_AXES = ((0, 1, 2), (1, 0, 2), (2, 0, 1))  # axes of roll, pitch and yaw on a line along x, y, z
QUATERNION_CHANNELS = tuple(f"quaternion_{c}" for c in "xyzw")
# What each channel of a file is measured in
DIMENSIONS = {
    **{channel: "angle" if channel.partition("_")[0] in ANGULAR_KINDS else "length" for channel in CHANNELS},
    **dict.fromkeys(TURNS, "angle"),
    **dict.fromkeys(QUATERNION_CHANNELS, ""),
    **dict.fromkeys(STRUT_NAMES, "length"),
}

ALONG_LINES = (*LINE_KINDS, *TURNS)  # channels that light reads along a line, and that the air therefore bends
LATEST = 1e11  # largest time, s: seconds since 1970 of the next three thousand years; nanoseconds are not seconds
# Columns of a reading's load, in the order of Reading.load, and how many digits they move from SI
LOAD_COLUMNS = {"payload_kg": 0, **{f"payload_{a}_mm": 3 for a in AXES}, **{f"gravity_{a}_m_s2": 0 for a in AXES}}
FURTHEST_CENTRE = 100.0  # no instrument stands further away, m


class TidyRow(NamedTuple):
    """A row of a file; value and uncertainty in SI, `text` is the value as it stands there, in `unit`."""

    run: str
    cycle: int
    direction: int
    pose: Pose
    channel: str
    value: float
    text: str
    unit: float
    uncertainty: float
    temperatures: tuple[float, ...]
    air: tuple[float, ...] | None
    centre: tuple[float, ...] | None
    known_zero: bool
    line: int
    time: float
    humidity: float
    load: tuple[float, ...]
    slope: str


def read_rows(table: Table) -> list[TidyRow]:
    """Return the rows of a file, every cell checked by itself."""
    runs, channels, units = table.texts("run"), table.texts("channel"), table.texts("unit")
    directions, cycles, poses = _directions(table), _cycles(table), _poses(table)
    value_column = table.required(("value",), None)[0][0]
    uncertainty_column = table.column("uncertainty", None)
    temperatures, (air, humidity) = _temperatures(table), _air(table)
    centres, known = _centres(table), _known_zeros(table)
    times = _optional(table, "time", "time", lambda v: abs(v) <= LATEST, f"±{LATEST:g} s", blank=True)
    loads = _loads(table)
    slopes = [""] * len(runs) if table.column("slope", None) is None else table.texts("slope")
    table.refuse_unknown()
    sizes: dict[tuple[str, str], float] = {}
    rows = []
    for n, (line, cells) in enumerate(table.rows):
        if not runs[n]:
            raise InputFileError(table.path, f"line {line}, column run", "must be a name")
        key = (channels[n], units[n])
        if key not in sizes:
            sizes[key] = _unit_size(table, line, *key)
        text = cells[value_column]
        number = table.number(line, value_column, text)
        value = (si_from_text(text, number, sizes[key]), text, sizes[key])
        uncertainty = _uncertainty(table, line, cells, uncertainty_column, sizes[key])
        place = (runs[n], cycles[n], directions[n], poses[n], channels[n])
        set_up = air[n], centres[n], known[n]
        rows.append(
            TidyRow(
                *(*place, *value, uncertainty, temperatures[n], *set_up, line, times[n], humidity[n]),
                load=loads[n],
                slope=slopes[n],
            )
        )
    return rows


def _uncertainty(table: Table, line: int, cells: Sequence[str], column: tuple[int, float] | None, unit: float) -> float:
    """Return a standard deviation in SI, NaN where there is none."""
    if column is None or not cells[column[0]].strip():
        return math.nan
    text = cells[column[0]]
    value = si_from_text(text, table.number(line, column[0], text), unit)
    if value <= 0.0:
        raise InputFileError(table.path, f"line {line}, column uncertainty", "must be above zero, or empty", text)
    return value


def _directions(table: Table) -> list[int]:
    """Return the directions as numbers."""
    texts = table.texts("direction")
    for (line, _), text in zip(table.rows, texts, strict=True):
        if text not in DIRECTIONS:
            allowed = "must be forward, backward, sequence or empty"
            raise InputFileError(table.path, f"line {line}, column direction", allowed, text)
    return [DIRECTIONS[text] for text in texts]


def _poses(table: Table) -> list[Pose]:
    """Return the commanded poses; rows with the same one share the object."""
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


def _cycles(table: Table) -> list[int]:
    """Return the numbers of the passes, 1 without a column."""
    if table.column("cycle", None) is None:
        return [1] * len(table.rows)
    texts, numbers = table.texts("cycle"), dict[str, int]()
    for (line, _), text in zip(table.rows, texts, strict=True):
        if text not in numbers:
            if not (text.isascii() and text.isdigit() and int(text[:9]) >= 1 and len(text) < 10):
                raise InputFileError(table.path, f"line {line}, column cycle", "must be a whole number from 1", text)
            numbers[text] = int(text)
    return [numbers[text] for text in texts]


def _optional(
    table: Table, name: str, dimension: str | None, fits: Callable[[float], bool], allowed: str, blank: bool
) -> list[float]:
    """Return a column's numbers in SI; NaN where it is missing, or a cell `blank` where that may be."""
    column = table.column(name, dimension)
    if column is None:
        return [math.nan] * len(table.rows)
    index, unit = column
    numbers = []
    for line, cells in table.rows:
        text = cells[index]
        if blank and not text.strip():
            numbers.append(math.nan)
            continue
        numbers.append(si_from_text(text, table.number(line, index, text), unit))
        if not fits(numbers[-1]):
            where = f"line {line}, column {table.header[index]}"
            raise InputFileError(table.path, where, f"must be within {allowed}", text)
    return numbers


def _temperatures(table: Table) -> list[tuple[float, ...]]:
    """Return the temperatures of struts, base and platform of each row, °C."""
    low, high = TEMPERATURE_RANGE

    def read(name: str) -> np.ndarray:
        return np.array(
            _optional(table, name, "temperature", lambda v: low <= v <= high, f"{low:g}…{high:g} °C", blank=False)
        )

    everywhere = np.nan_to_num(read("temperature"), nan=REFERENCE_TEMPERATURE)
    columns = [np.where(np.isnan(own := read(name)), everywhere, own) for name in Temperatures.NAMES]
    rows = np.stack(columns, axis=1)
    if (rows == rows[0]).all():
        return [tuple(rows[0].tolist())] * len(rows)
    return list(map(tuple, rows.tolist()))


def _air(table: Table) -> tuple[list[tuple[float, ...] | None], list[float]]:
    """Return instrument index, temperature, pressure and humidity of rows that have the first; and all humidities."""
    up_to = LARGEST_INDEX
    index = _optional(table, "instrument_index", None, lambda v: 1.0 <= v <= up_to, f"1…{up_to:g}", blank=True)
    wanted = {"humidity"} if np.isnan(index).all() else {*AIR_RANGES}
    columns = [index]
    for name, dimension in (("temperature", "temperature"), ("pressure", "pressure"), ("humidity", "ratio")):
        low, high, allowed = AIR_RANGES[name]
        columns.append(
            _optional(
                table,
                name,
                dimension,
                lambda v, name=name, low=low, high=high: name not in wanted or low <= v <= high,  # type: ignore[misc]
                allowed,
                blank=True,
            )
        )
    air: list[tuple[float, ...] | None] = []
    if np.isnan(index).all():
        return [None] * len(index), columns[-1]
    for (line, _), *row in zip(table.rows, *columns, strict=True):
        if math.isnan(row[0]):
            air.append(None)
            continue
        if any(map(math.isnan, row)):
            problem = "has an instrument_index, so it needs temperature_degC, pressure_kPa and humidity_percent too"
            raise InputFileError(table.path, f"line {line}", problem)
        air.append(tuple(row))
    return air, columns[-1]


def _loads(table: Table) -> list[tuple[float, ...]]:
    """Return payload, kg, its centre in platform, m, and gravity in base, m/s²; NaN where a row has none."""
    groups = (
        {"payload": ("mass", 0.0, LARGEST_MASS)}
        | {f"payload_{axis}": ("length", -FURTHEST_CENTRE, FURTHEST_CENTRE) for axis in AXES},
        {f"gravity_{axis}": ("acceleration", -EARTH[1], EARTH[1]) for axis in AXES},
    )
    columns: list[list[float]] = []
    for group in groups:
        own = []
        for name, (dimension, low, high) in group.items():
            inside = lambda value, low=low, high=high: low <= value <= high  # noqa: E731
            own.append(_optional(table, name, dimension, inside, f"{low:g}…{high:g}, in SI", blank=True))
        for (line, _), *row in zip(table.rows, *own, strict=True):
            blank = [name for name, value in zip(group, row, strict=True) if math.isnan(value)]
            if blank and len(blank) < len(group):
                raise InputFileError(table.path, f"line {line}", f"has a load without its {blank[0]}")
            if "gravity_x" in group and not blank:
                with file_errors(table.path):
                    check_gravity(f"line {line}: gravity", row)
        columns += own
    return list(zip(*columns, strict=True))


def _centres(table: Table) -> list[tuple[float, ...] | None]:
    """Return from where lengths are read, m in the work frame, None in rows without."""

    def read(axis: str) -> list[float]:
        allowed = f"±{FURTHEST_CENTRE:g} m"
        return _optional(table, f"centre_{axis}", "length", lambda v: abs(v) <= FURTHEST_CENTRE, allowed, blank=True)

    columns = [read(axis) for axis in AXES]
    if np.isnan(columns).all():
        return [None] * len(table.rows)
    centres: list[tuple[float, ...] | None] = []
    for (line, _), *centre in zip(table.rows, *columns, strict=True):
        missing = [axis for axis, value in zip(AXES, centre, strict=True) if math.isnan(value)]
        if len(missing) in (1, 2):
            raise InputFileError(table.path, f"line {line}", f"has a centre without its centre_{missing[0]}")
        centres.append(None if missing else tuple(centre))
    return centres


def _known_zeros(table: Table) -> list[bool]:
    """Return which rows have lengths that are known as a whole."""
    if table.column("zero", None) is None:
        return [False] * len(table.rows)
    texts = table.texts("zero")
    for (line, _), text in zip(table.rows, texts, strict=True):
        if text not in ("known", ""):
            raise InputFileError(table.path, f"line {line}, column zero", "must be known or empty", text)
    return [text == "known" for text in texts]


def _unit_size(table: Table, line: int, channel: str, unit: str) -> float:
    """Return the size of a unit in SI; refuse unknown channels and units that do not fit them."""
    if channel not in DIMENSIONS:
        allowed = f"must be one of {', '.join(DIMENSIONS)}"
        raise InputFileError(table.path, f"line {line}, column channel", allowed, channel)
    dimension = DIMENSIONS[channel]
    units = spellings(dimension) if dimension else {"": 1.0}
    if unit not in units:
        allowed = f"must be {' or '.join(UNITS[dimension])}" if dimension else "must be empty"
        raise InputFileError(table.path, f"line {line}, column unit", f"{allowed} for {channel}", unit)
    return units[unit]


PARALLEL = 1e-9  # largest cross component of a unit vector that still is parallel to an axis


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


def tidy_readings(path: str | Path, geometry: HexapodGeometry) -> list[Reading]:
    """Return the readings of one file as they stand in it."""
    table = Table(path)
    rows = read_rows(table)
    (names,) = _run_names([table], [rows])
    return _file_readings(table, rows, names, geometry, None)[0]


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
            readings.append(Reading(*reading, *state, row.centre, row.known_zero, row.humidity, row.load, row.slope))
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


def write_measurements(measurements: MeasurementSet, path: str | Path, remark: str = "") -> None:
    """Write a set as the file that :func:`~.tidy.read_tidy` reads back, to the last bit, with a remark on top."""
    comment = f"# {remark}\n" if remark else ""
    if not np.array_equal(measurements.probe, measurements.geometry.tool.position):
        point = ", ".join(_scaled(float(value), 3) for value in measurements.probe)
        comment += f"# measured point in the platform frame, mm: {point}\n"
    write_text(path, comment + csv_text(_csv_rows(measurements)))


def _csv_rows(measurements: MeasurementSet) -> Iterator[list[str]]:
    """Yield the header and the rows of a set."""
    words = {number: word for word, number in DIRECTIONS.items()}
    stations, (positions, rotations) = measurements.stations, _tool_poses(measurements)
    offset = measurements.geometry.tool.rotation.T @ (measurements.probe - measurements.geometry.tool.position)
    commanded = positions + rotations @ offset if offset.any() else positions
    pose_names, poses = _pose_cells(positions, rotations)
    temperature_names, temperatures = _temperature_cells(measurements)
    loads = zip(LOAD_COLUMNS.items(), stations.loads.T, strict=True)
    optional = [("humidity_percent", stations.humidity, 2), ("time_s", stations.times, 0)]
    for name, values, digits in (*optional, *((name, values, digits) for (name, digits), values in loads)):
        if np.isfinite(values).any():
            temperature_names = [*temperature_names, name]
            texts = ("" if math.isnan(value) else _scaled(value, digits) for value in values.tolist())
            temperatures = [[*cells, text] for cells, text in zip(temperatures, texts, strict=True)]
    with_uncertainty = bool(np.isfinite(measurements.uncertainty).any())
    centre_names, centres, of_reading = _centre_cells(measurements)
    tail = ["uncertainty"] * with_uncertainty + centre_names + temperature_names
    yield ["run", "direction", "cycle", *pose_names, "channel", "value", "unit", *tail]
    struts = _strut_cells(measurements)
    written: set[tuple] = set()
    before: tuple | None = None
    for n, station in enumerate(measurements.station.tolist()):
        direction, cycle = int(measurements.direction[n]), int(measurements.cycle[n])
        head = [measurements.runs[measurements.run[n]].name, words[direction], str(cycle), *poses[station]]
        visit = (direction, cycle, station)
        if station in struts and (visit not in written or (direction == FROM_PREVIOUS and visit != before)):
            blank = [""] * (with_uncertainty + len(centre_names))
            for name, length in zip(STRUT_NAMES, struts[station], strict=True):
                yield [*head, name, length, "mm", *blank, *temperatures[station]]
        written.add(visit)
        before = visit
        channel, value = CHANNELS[measurements.channel[n]], float(measurements.value[n])
        at = _commanded(channel, commanded[station], centres[n])
        cells = _value_cells(channel, value, float(measurements.uncertainty[n]), at)
        yield [*head, channel, *(cells if with_uncertainty else cells[:2]), *of_reading[n], *temperatures[station]]


def _commanded(channel: str, point: np.ndarray, centre: np.ndarray) -> float:
    """Return what a file's value has on top of the error, m: a coordinate, a distance, or nothing."""
    kind, _, axis = channel.partition("_")
    if kind == "position":
        return float(point[AXES.index(axis)])
    return math.dist(point, centre) if kind == "length" else 0.0


def _value_cells(channel: str, value: float, uncertainty: float, commanded: float) -> list[str]:
    """Return value, unit and uncertainty as text, with every digit."""
    kind = channel.partition("_")[0]
    unit, digits = ("urad", 6) if kind in ANGULAR_KINDS else ("mm", 3) if kind in ("position", "length") else ("um", 6)
    number = Decimal(repr(value)) + Decimal(repr(commanded))
    return [
        "" if math.isnan(value) else _moved(number, digits),
        unit,
        "" if math.isnan(uncertainty) else _scaled(uncertainty, digits),
    ]


def _scaled(value: float, digits: int) -> str:
    """Return a float as decimal text with its point moved: nothing is rounded."""
    return _moved(Decimal(repr(value)), digits)


def _moved(number: Decimal, digits: int) -> str:
    text = format(number.scaleb(digits), "f")
    return text.rstrip("0").rstrip(".") if "." in text else text


def _tool_poses(measurements: MeasurementSet) -> tuple[np.ndarray, np.ndarray]:
    """Return the commanded poses of the tool in the work frame as a file says them, (M, 3) m and (M, 3, 3)."""
    stations, work, tool = measurements.stations, measurements.geometry.work, measurements.geometry.tool
    tips = stations.positions + stations.rotations @ tool.position
    return ((tips - work.position) @ work.rotation).round(13), work.rotation.T @ stations.rotations @ tool.rotation


def _pose_cells(positions: np.ndarray, rotations: np.ndarray) -> tuple[list[str], list[list[str]]]:
    """Return pose columns and their cells per station; angles only where there are any."""
    names = [f"{name}_mm" for name in POSITION_COLUMNS]
    cells = [[_scaled(float(value), 3) for value in position + 0.0] for position in positions]
    if np.array_equal(rotations, np.broadcast_to(np.eye(3), rotations.shape)):
        return names, cells
    angles = np.degrees(angles_from_rotation(rotations)).round(12) + 0.0
    tilted = [[*cell, *(_scaled(float(angle), 0) for angle in row)] for cell, row in zip(cells, angles, strict=True)]
    return names + [f"{name}_deg" for name in ANGLE_COLUMNS], tilted


def _temperature_cells(measurements: MeasurementSet) -> tuple[list[str], list[list[str]]]:
    """Return temperature columns and their cells per station: none, one, or eight."""
    values = measurements.stations.temperatures
    if (values == REFERENCE_TEMPERATURE).all():
        return [], [[] for _ in values]
    if (values == values[:, :1]).all():
        return ["temperature_degC"], [[repr(row[0])] for row in values.tolist()]
    return [f"{name}_degC" for name in Temperatures.NAMES], [list(map(repr, row)) for row in values.tolist()]


def _centre_cells(measurements: MeasurementSet) -> tuple[list[str], np.ndarray, list[list[str]]]:
    """Return columns of centres, the centres in the work frame as the file says them, (N, 3) m, and their cells."""
    work = measurements.geometry.work
    centres = ((measurements.centre - work.position) @ work.rotation).round(13)
    slopes = [measurements.runs[run].slope for run in measurements.run]
    if not (measurements.channel == LENGTH).any():
        sloping = any(slopes)
        return ["slope"] * sloping, centres, [[slope] * sloping for slope in slopes]
    known = [measurements.runs[run].known_zero for run in measurements.run]
    names = [f"centre_{axis}_mm" for axis in AXES] + ["zero"] * any(known) + ["slope"] * any(slopes)
    texts = [["", "", ""] if np.isnan(c[0]) else [_scaled(float(v), 3) for v in c + 0.0] for c in centres]
    zeros = [
        ["known" if of else ""] * any(known) + [slope] * any(slopes) for of, slope in zip(known, slopes, strict=True)
    ]
    return names, centres, [text + zero for text, zero in zip(texts, zeros, strict=True)]


def _strut_cells(measurements: MeasurementSet) -> dict[int, list[str]]:
    """Return the strut commands, mm, of the stations where they are not the nominal lengths."""
    nominal = Structure.of(measurements.geometry)
    stations = measurements.stations
    cells = {}
    for n, commands in enumerate(stations.commands):
        if not np.array_equal(commands, strut_lengths(nominal, stations.pose(n))):
            cells[n] = [_scaled(float(length), 3) for length in commands]
    return cells
