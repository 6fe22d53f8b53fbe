"""Rows of tidy CSV files (:mod:`.tidy_csv`), every cell checked by itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..errors import InputFileError
from ..formats.csv import Table, si_from_text
from ..formats.schema import UNITS, spellings
from ..machine.arrays import changed_rows
from ..machine.geometry import STRUT_NAMES
from ..machine.temperatures import REFERENCE_TEMPERATURE, TEMPERATURE_RANGE, Temperatures
from ..pose import Pose
from .air import AIR_RANGES, LARGEST_INDEX
from .readings import ANGULAR_KINDS, AXES, BACKWARD, CHANNELS, FORWARD, FROM_PREVIOUS, LINE_KINDS, UNKNOWN

DIRECTIONS = {"forward": FORWARD, "backward": BACKWARD, "sequence": FROM_PREVIOUS, "": UNKNOWN}
"""Words of the column ``direction``."""

TURNS = ("roll", "pitch", "yaw")
"""Rotations named after the line on which they are read."""

TURN_AXES = ((0, 1, 2), (1, 0, 2), (2, 0, 1))
"""Axes of roll, pitch and yaw on a line along x, y, z."""

QUATERNION_CHANNELS = tuple(f"quaternion_{c}" for c in "xyzw")

DIMENSIONS = {
    **{channel: "angle" if channel.partition("_")[0] in ANGULAR_KINDS else "length" for channel in CHANNELS},
    **dict.fromkeys(TURNS, "angle"),
    **dict.fromkeys(QUATERNION_CHANNELS, ""),
    **dict.fromkeys(STRUT_NAMES, "length"),
}
"""What each channel of a file is measured in."""

ALONG_LINES = (*LINE_KINDS, *TURNS)
"""Channels that light reads along a line, and that the air therefore bends."""

LATEST = 1e11
"""Largest time, s: seconds since 1970 of the next three thousand years; nanoseconds are not seconds."""

FURTHEST_CENTRE = 100.0
"""No instrument stands further away, m."""


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


def read_rows(table: Table) -> list[TidyRow]:
    """Return the rows of a file, every cell checked by itself."""
    runs, channels, units = table.texts("run"), table.texts("channel"), table.texts("unit")
    directions, cycles, poses = _directions(table), _cycles(table), _poses(table)
    value_column = table.required(("value",), None)[0][0]
    uncertainty_column = table.column("uncertainty", None)
    temperatures, (air, humidity) = _temperatures(table), _air(table)
    centres, known = _centres(table), _known_zeros(table)
    times = _optional(table, "time", "time", lambda v: abs(v) <= LATEST, f"±{LATEST:g} s", blank=True)
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
        rows.append(TidyRow(*place, *value, uncertainty, temperatures[n], *set_up, line, times[n], humidity[n]))
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
    positions, rotations = table.poses()
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
