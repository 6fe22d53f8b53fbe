"""Sets of measurements as tidy CSV files, to the last bit of every value."""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import numpy as np

from ..formats.csv import ANGLE_COLUMNS, POSITION_COLUMNS, csv_text
from ..formats.outputs import write_text
from ..machine.geometry import STRUT_NAMES
from ..machine.kinematics import Structure, strut_lengths
from ..machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from ..pose import angles_from_rotation
from .readings import ANGULAR_KINDS, AXES, CHANNELS, FROM_PREVIOUS, LENGTH, MeasurementSet
from .tidy_rows import DIRECTIONS


def write_measurements(measurements: MeasurementSet, path: str | Path) -> None:
    """Write a set as the file that :func:`~.tidy_csv.read_tidy` reads back, to the last bit.

    Commanded poses are written to 10⁻¹³ m and 10⁻¹² degrees; values that are not a number are left empty, to be filled
    in. The measured point is not a column: where it is not the tool's tip, a comment in the file says where it is, and
    it has to be given again for reading.
    """
    comment = ""
    if not np.array_equal(measurements.probe, measurements.geometry.tool.position):
        point = ", ".join(_scaled(float(value), 3) for value in measurements.probe)
        comment = f"# measured point in the platform frame, mm: {point}\n"
    write_text(path, comment + csv_text(_csv_rows(measurements)))


def _csv_rows(measurements: MeasurementSet) -> Iterator[list[str]]:
    """Yield the header and the rows of a set."""
    words = {number: word for word, number in DIRECTIONS.items()}
    stations, (positions, rotations) = measurements.stations, _tool_poses(measurements)
    offset = measurements.geometry.tool.rotation.T @ (measurements.probe - measurements.geometry.tool.position)
    commanded = positions + rotations @ offset if offset.any() else positions
    pose_names, poses = _pose_cells(positions, rotations)
    temperature_names, temperatures = _temperature_cells(measurements)
    for name, values, digits in (("humidity_percent", stations.humidity, 2), ("time_s", stations.times, 0)):
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
    if not (measurements.channel == LENGTH).any():
        return [], centres, [[] for _ in measurements.station]
    known = [measurements.runs[run].known_zero for run in measurements.run]
    names = [f"centre_{axis}_mm" for axis in AXES] + ["zero"] * any(known)
    texts = [["", "", ""] if np.isnan(c[0]) else [_scaled(float(v), 3) for v in c + 0.0] for c in centres]
    zeros = [["known" if of else ""] if any(known) else [] for of in known]
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
