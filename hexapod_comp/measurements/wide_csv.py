"""Wide CSV files of other laboratories: one pose a row, in columns that a small YAML file explains.

A columns file (format ``hexapod_comp/columns``, see config/jugglebot_columns.yaml)::

    format: hexapod_comp/columns
    version: 1
    run: poses                      # optional; the CSV file's name otherwise
    order: sequence                 # rows in the order of measuring: directions follow from it; or unknown (default)
    commanded:                      # pose of the tool in the work frame; without this section it is the nominal
      position: [cx, cy, cz]        # forward kinematics of the strut readings
      unit: mm
      offset_mm: [0, 0, 565]        # optional, added to the position
      quaternion: [qx, qy, qz, qw]  # or angles: [alpha, beta, gamma] with angle_unit; neither: level
    measured:                       # likewise; without quaternion or angles only positions were measured
      position: [mx, my, mz]
      unit: mm
      quaternion: [mqx, mqy, mqz, mqw]
      position_uncertainty_um: 200  # optional standard deviations
      attitude_uncertainty_mrad: 1
    struts:                         # optional: what the machine was told, or its encoders read
      readings: [l1, l2, l3, l4, l5, l6]
      length_per_unit_mm: [75.7, 71.2, 72.3, 70.8, 70.6, 71.3]
      zero: home                    # length at reading zero: home, those of the machine's home pose; given, in
                                    # zero_length_mm; or measured, those that fit the measured poses in the mean

With ``zero: measured`` the six lengths at reading zero come from all rows of the file: data held out of a fit
have had their say in six numbers. A fit finds strut offsets anyway; this only starts it near them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputFileError, PoseError
from ..formats.csv import Table
from ..formats.yaml import Section, read_yaml
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import Structure, solve_poses, strut_lengths_batch
from ..pose import Pose
from .readings import AXES, FROM_PREVIOUS, UNKNOWN, FileLine, MeasurementSet, Reading, attitude_error
from .runs import assemble

COLUMNS_FORMAT = "hexapod_comp/columns"
COLUMNS_VERSION = 1

ORDERS = {"sequence": FROM_PREVIOUS, "unknown": UNKNOWN}

ZEROS = ("home", "given", "measured")
"""Where the lengths at reading zero come from."""


@dataclass(frozen=True)
class PoseColumns:
    """Where a pose stands.

    Attributes
    ----------
    position : tuple of str
        Columns of x, y, z.
    unit : float
        Size of their unit, m.
    offset : ndarray, shape (3,)
        Added to the position, m.
    turn : tuple of str
        Columns of a quaternion (x, y, z, w) or of the paper's three angles; empty when there are none.
    angle_unit : float
        Size of the angles' unit, rad.
    uncertainty : tuple of float
        Standard deviations of position (m) and attitude (rad), NaN when not known.
    """

    position: tuple[str, ...]
    unit: float
    offset: np.ndarray
    turn: tuple[str, ...]
    angle_unit: float
    uncertainty: tuple[float, float]


@dataclass(frozen=True)
class StrutColumns:
    """Where strut readings stand.

    Attributes
    ----------
    readings : tuple of str
        Six columns.
    length_per_unit : ndarray, shape (6,)
        m per unit of the reading.
    zero : str
        One of :data:`ZEROS`.
    zero_length : ndarray, shape (6,)
        Lengths at reading zero, m, when given.
    """

    readings: tuple[str, ...]
    length_per_unit: np.ndarray
    zero: str
    zero_length: np.ndarray


@dataclass(frozen=True)
class Columns:
    """What the columns of a wide file mean; the parts are as in the file, None where left out."""

    run: str
    order: int
    commanded: PoseColumns | None
    measured: PoseColumns
    struts: StrutColumns | None


def load_columns(path: str | Path) -> Columns:
    """Read a columns file.

    Raises
    ------
    InputFileError
        With file, key and value.
    """
    top = read_yaml(path, COLUMNS_FORMAT, COLUMNS_VERSION)
    columns = Columns(
        run=top.text("run") if "run" in top else "",
        order=ORDERS[top.choice("order", tuple(ORDERS), "unknown")],
        commanded=_pose_columns(top.section("commanded")) if "commanded" in top else None,
        measured=_pose_columns(top.section("measured")),
        struts=_strut_columns(top.section("struts")) if "struts" in top else None,
    )
    if columns.commanded is None and columns.struts is None:
        raise top.error("commanded", "is missing, and so are struts, from which it could be computed")
    if columns.struts is not None and columns.struts.zero == "measured" and not columns.measured.turn:
        raise top.error("struts.zero", "measured needs measured orientations", "measured")
    top.finish()
    return columns


def _names(section: Section, key: str, count: int) -> tuple[str, ...]:
    """Take so many column names."""
    names = section.take(key)
    if not isinstance(names, list) or len(names) != count or not all(isinstance(n, str) and n for n in names):
        raise section.error(key, f"must be a list of {count} column names", names)
    return tuple(names)


def _pose_columns(section: Section) -> PoseColumns:
    turn: tuple[str, ...] = ()
    angle_unit = 1.0
    if "quaternion" in section:
        turn = _names(section, "quaternion", 4)
    elif "angles" in section:
        turn = _names(section, "angles", 3)
        angle_unit = section.unit("angle_unit", "angle")
    columns = PoseColumns(
        position=_names(section, "position", 3),
        unit=section.unit("unit", "length"),
        offset=section.quantity("offset", "length", (3,), np.zeros(3)),
        turn=turn,
        angle_unit=angle_unit,
        uncertainty=(
            float(section.quantity("position_uncertainty", "length", default=np.nan)),
            float(section.quantity("attitude_uncertainty", "angle", default=np.nan)),
        ),
    )
    section.finish()
    return columns


def _strut_columns(section: Section) -> StrutColumns:
    zero = section.choice("zero", ZEROS, "home")
    columns = StrutColumns(
        readings=_names(section, "readings", 6),
        length_per_unit=section.per_strut("length_per_unit", "length"),
        zero=zero,
        zero_length=section.per_strut("zero_length", "length") if zero == "given" else np.full(6, np.nan),
    )
    section.finish()
    return columns


@dataclass(frozen=True)
class _Poses:
    """Poses of the tool in the work frame, (N, 3) m and (N, 3, 3)."""

    positions: np.ndarray
    rotations: np.ndarray


def read_wide(
    path: str | Path, columns_path: str | Path, geometry: HexapodGeometry, in_reach: bool = True
) -> MeasurementSet:
    """Read a wide CSV file as one run of absolute positions and, where there are any, attitudes.

    Parameters
    ----------
    path : path
        The CSV file, one pose a row.
    columns_path : path
        The columns file that explains it.
    geometry : HexapodGeometry
        The machine that was measured; the measured point is its tool's tip.
    in_reach : bool
        Refuse commands that the nominal machine cannot take; the figures of a standard do not need that.

    Returns
    -------
    MeasurementSet
        Its notes name the columns that were not used.

    Raises
    ------
    InputFileError
        Naming file, line and column.
    """
    columns, table = load_columns(columns_path), Table(path)
    used: set[str] = set()
    measured = _read_poses(table, columns.measured, used)
    notes: list[str] = []
    commands = None if columns.struts is None else _lengths(table, columns.struts, measured, geometry, used, notes)
    if columns.commanded is not None:
        commanded = _read_poses(table, columns.commanded, used)
    else:
        commanded = _nominal_poses(table, geometry, np.asarray(commands))
    unused = [name for name in table.header if name not in used]
    notes += [f"{path}: columns not used: {', '.join(unused)}"] if unused else []
    readings = _readings(table, columns, commanded, measured, commands)
    return assemble(geometry, readings, None, [(Path(path).name, table.sha256)], notes, in_reach)


def _read_numbers(table: Table, names: tuple[str, ...], unit: float, used: set[str]) -> np.ndarray:
    """Return some columns in SI, shape (rows, columns)."""
    used.update(names)
    return table.numbers([(index, unit) for index, _ in table.required(names, None)])


def _read_poses(table: Table, columns: PoseColumns, used: set[str]) -> _Poses:
    """Return the poses in some columns; level where the file has no orientation."""
    positions = _read_numbers(table, columns.position, columns.unit, used) + columns.offset
    if not columns.turn:
        return _Poses(positions, np.tile(np.eye(3), (len(positions), 1, 1)))
    turns = _read_numbers(table, columns.turn, columns.angle_unit, used)
    if len(columns.turn) == 3:
        return _Poses(positions, table.rotations(turns))
    rotations = np.empty((len(turns), 3, 3))
    for n, ((line, _), quaternion) in enumerate(zip(table.rows, turns, strict=True)):
        try:
            rotations[n] = Pose.from_quaternion(np.zeros(3), quaternion).rotation
        except PoseError as error:
            where = f"line {line}, columns {', '.join(columns.turn)}"
            raise InputFileError(table.path, where, str(error)) from error
    return _Poses(positions, rotations)


def _lengths(
    table: Table,
    struts: StrutColumns,
    measured: _Poses,
    geometry: HexapodGeometry,
    used: set[str],
    notes: list[str],
) -> np.ndarray:
    """Return the strut lengths that the readings say, shape (rows, 6), m."""
    travel = _read_numbers(table, struts.readings, 1.0, used) * struts.length_per_unit
    structure = Structure.of(geometry)
    home = strut_lengths_batch(structure, geometry.home.position[None], geometry.home.rotation[None])[0]
    zero = {"home": home, "given": struts.zero_length}.get(struts.zero)
    if zero is None:
        platform = geometry.platform_poses(measured.positions, measured.rotations)
        zero = (strut_lengths_batch(structure, *platform) - travel).mean(axis=0)
        shift = ", ".join(f"{name} {value * 1e3:+.3f}" for name, value in zip(STRUT_NAMES, zero - home, strict=True))
        notes.append(f"{table.path}: lengths at reading zero from the measured poses, mm from home: {shift}")
    return zero + travel


def _nominal_poses(table: Table, geometry: HexapodGeometry, lengths: np.ndarray) -> _Poses:
    """Return the poses that the machine as designed takes under some strut lengths."""
    usable = (lengths > 0.0).all(axis=1)
    if not usable.all():
        row = int(usable.argmin())
        problem = "a strut would have no length, m"
        raise InputFileError(table.path, f"line {table.rows[row][0]}", problem, lengths[row].tolist())
    solved = solve_poses(Structure.of(geometry), lengths, geometry.home)
    if not solved.ok.all():
        row = int(solved.ok.argmin())
        problem = "no pose of the machine as designed has these strut lengths, mm"
        raise InputFileError(table.path, f"line {table.rows[row][0]}", problem, (lengths[row] * 1e3).round(3).tolist())
    return _Poses(*geometry.tool_poses(solved.positions, solved.rotations))


def _readings(
    table: Table, columns: Columns, commanded: _Poses, measured: _Poses, commands: np.ndarray | None
) -> list[Reading]:
    """Return position and attitude readings of every row."""
    errors = [("position", measured.positions - commanded.positions, columns.measured.uncertainty[0])]
    if columns.measured.turn:
        turned = attitude_error(measured.rotations, commanded.rotations)
        errors.append(("attitude", turned, columns.measured.uncertainty[1]))
    run = columns.run or Path(table.path).stem
    readings = []
    for n, (line, _) in enumerate(table.rows):
        pose = Pose(commanded.positions[n], commanded.rotations[n])
        lengths = None if commands is None else tuple(commands[n].tolist())
        for kind, values, uncertainty in errors:
            for axis, value in zip(AXES, values[n].tolist(), strict=True):
                place = (run, 1, columns.order, pose, f"{kind}_{axis}")
                source = FileLine(str(table.path), line)
                readings.append(Reading(*place, value, uncertainty, commands=lengths, source=source))
    return readings
