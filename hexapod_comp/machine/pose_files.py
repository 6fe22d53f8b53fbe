"""CSV files of poses and of strut lengths that ``ik`` and ``fk`` read and write; column names end in their units."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core import lib
from ..errors import InputFileError, PoseError
from ..formats.csv import Row, Table
from ..formats.paths import input_file
from ..pose import Pose, rotation_from_angles, rotation_from_quaternion

POSITION_COLUMNS = ("x", "y", "z")
ANGLE_COLUMNS = ("alpha", "beta", "gamma")
QUATERNION_COLUMNS = ("qx", "qy", "qz", "qw")
LENGTH_COLUMNS = tuple(f"L{i}" for i in range(1, 7))
# Columns of the tool's predicted errors and their standard deviations, from `ik --model`; {} is x, y, z, rx, ry or rz
PREDICTED_ERRORS = tuple(f"{error}_{{}}{known}" for error in ("error", "error_aligned") for known in ("", "_sd"))
# Columns that `ik --model` and `ik --line` write beside the lengths and `read_lengths` ignores, and their dimension
BESIDE_LENGTHS = {
    tuple(f"nominal_{name}" for name in LENGTH_COLUMNS): "length",
    tuple(f"correction_{name}" for name in LENGTH_COLUMNS): "length",
    tuple(name.format(axis) for name in PREDICTED_ERRORS for axis in "xyz"): "length",
    tuple(name.format(axis) for name in PREDICTED_ERRORS for axis in ("rx", "ry", "rz")): "angle",
    ("along", *POSITION_COLUMNS): "length",
    ANGLE_COLUMNS: "angle",
    ("direction",): None,
}


def read_poses(path: str | Path) -> tuple[list[Row], list[Pose]]:
    """Read poses from a CSV file, a shipped file such as ``table1.csv``, or ``-`` for standard input.

    The columns ``x_mm``, ``y_mm``, ``z_mm`` are required. Optional are the angles ``alpha_deg``, ``beta_deg``,
    ``gamma_deg`` or the quaternion ``qx``, ``qy``, ``qz``, ``qw``, and a label ``sequence`` or ``name``. Columns may
    have other units, such as ``x_um`` or ``alpha_rad``. Lines that start with ``#`` are skipped.

    Returns
    -------
    rows : list of Row
        Line number and label of each pose.
    poses : list of Pose
        Poses in the frame that the file uses.

    Raises
    ------
    InputFileError
        The file cannot be used; the message names file, line and column.
    """
    rows, positions, rotations = read_pose_arrays(path)
    return rows, [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]


def read_pose_arrays(path: str | Path) -> tuple[list[Row], np.ndarray, np.ndarray]:
    """Read poses as :func:`read_poses` does, but as arrays, which is faster for many thousand rows."""
    table = Table(input_file(path, "poses"))
    positions, rotations = poses_of(table)
    table.refuse_unknown()
    return table.labels(), positions, rotations


def poses_of(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return positions, (N, 3), m, and rotations, (N, 3, 3), from the columns that :func:`read_poses` lists."""
    columns = table.required(POSITION_COLUMNS, "length")
    angle_columns = table.columns(ANGLE_COLUMNS, "angle")
    quaternion_columns = table.columns(QUATERNION_COLUMNS, None)
    if angle_columns and quaternion_columns:
        raise InputFileError(table.path, "header", "give either angles or a quaternion, not both")
    positions = table.numbers(columns)
    if quaternion_columns:
        return positions, rotations_of(table, table.numbers(quaternion_columns), "qx…qw")
    angles = table.numbers(angle_columns) if angle_columns else np.zeros((len(table.rows), 3))
    return positions, rotations_of(table, angles, "alpha…gamma")


def rotations_of(table: Table, turns: np.ndarray, columns: str) -> np.ndarray:
    """Check a table's angles (N, 3), rad, or quaternions (N, 4), and return them as rotation matrices (N, 3, 3)."""
    row = int(np.abs(turns).max(axis=1).argmax())
    try:
        if turns.shape[1] == 3:
            return rotation_from_angles(turns)
        wrong = np.abs(np.linalg.norm(turns, axis=1) - 1.0) > lib.QUATERNION_TOLERANCE
        if wrong.any():
            row = int(wrong.argmax())
            Pose.from_quaternion(np.zeros(3), turns[row])
        return rotation_from_quaternion(turns)
    except PoseError as error:
        raise InputFileError(table.path, f"line {table.rows[row][0]}, columns {columns}", str(error)) from error


def read_lengths(path: str | Path) -> tuple[list[Row], np.ndarray]:
    """Read strut lengths, (N, 6), m, from the columns ``L1_mm`` … ``L6_mm`` of a CSV file or standard input (``-``)."""
    table = Table(input_file(path, "lengths"))
    lengths = table.numbers(table.required(LENGTH_COLUMNS, "length"))
    for names, dimension in BESIDE_LENGTHS.items():
        table.columns(names, dimension)
    table.refuse_unknown()
    return table.labels(), lengths


def length_values(lengths: np.ndarray) -> dict[str, float]:
    """Convert six strut lengths from m to mm; return them by the column names ``L1_mm`` … ``L6_mm``."""
    return {f"{name}_mm": float(value) * 1e3 for name, value in zip(LENGTH_COLUMNS, lengths, strict=True)}
