"""The core for one pose, one point or one strut: see ``single.h``. Arrays are checked as in :mod:`.batch`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from . import Struct, ffi, lib
from .batch import given, written


def rotation_flaw(rotation: np.ndarray) -> float:
    """Return the largest element of RᵀR − 1, infinite for a left-handed matrix, NaN for one with NaN in it."""
    return lib.hc_rotation_flaw(given("rotation", rotation, 3, 3))


def read_pose(numbers: Sequence[float], position: np.ndarray, rotation: np.ndarray) -> int:
    """Write the pose that seven numbers are, position and quaternion x, y, z, w; return the status."""
    if len(numbers) != 7:
        raise ValueError(f"numbers: must be seven, position and quaternion, not {len(numbers)}")
    return lib.hc_read_pose(numbers, written("position", position, 3), written("rotation", rotation, 3, 3))


def quaternion_of(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of a rotation matrix, from its largest component."""
    quaternion = ffi.new("double[4]")
    lib.hc_quaternion(given("rotation", rotation, 3, 3), quaternion)
    return tuple(quaternion)


def rotate(rotation: np.ndarray, x: float, y: float, z: float) -> None:
    """Replace R by exp(ω)·R in place (Rodrigues), ω in the outer frame, rad."""
    lib.hc_rotate(written("rotation", rotation, 3, 3), x, y, z)


def orthonormalise(rotation: np.ndarray) -> None:
    """Remove the rounding that products leave in a rotation: one Newton step to the nearest one."""
    lib.hc_orthonormalise(written("rotation", rotation, 3, 3))


def solve_linear(matrix: np.ndarray, right: np.ndarray) -> float:
    """Solve a 6 × 6 system in place with pivoting; return the sign of its determinant, 0 for a singular matrix."""
    return lib.hc_solve_linear(written("matrix", matrix, 6, 6), written("right", right, 6))


def check_stage(
    base: np.ndarray,
    platform: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    lengths: np.ndarray,
    limits: Struct,
) -> tuple[int, int, float, int, float]:
    """Check lengths and pose of one stage; return (status, strut, value, second strut or −1, condition number)."""
    struts, value, condition = ffi.new("int[2]"), ffi.new("double *"), ffi.new("double *")
    joints = given("base", base, 6, 3), given("platform", platform, 6, 3)
    pose = given("position", position, 3), given("rotation", rotation, 3, 3)
    status = lib.hc_check_stage(*joints, *pose, given("lengths", lengths, 6), limits.at, struts, value, condition)
    return status, struts[0], value[0], struts[1], condition[0]


def segment_distance(*ends: np.ndarray) -> float:
    """Return the smallest distance, m, of two segments, whose ends are four points (3,)."""
    if len(ends) != 4:
        raise ValueError(f"ends: must be four points, not {len(ends)}")
    return lib.hc_segment_distance(*(given("end", np.ascontiguousarray(end), 3) for end in ends))


def follow_nine(
    values: np.ndarray, axis_threshold: float, strut_threshold: float, low: np.ndarray, sense: np.ndarray
) -> None:
    """Take values of the measured point's axes and of the struts, (9,), m; update windows and directions of motion."""
    motion = written("low", low, 9), written("sense", sense, 9)
    lib.hc_follow_nine(given("values", values, 9), axis_threshold, strut_threshold, *motion)


def write_lengths(
    lengths: np.ndarray, period: float, fastest: float, position: np.ndarray, velocity: np.ndarray
) -> None:
    """Write six lengths and their speeds in place; these are at most `fastest`: jitter in stamps is no speed."""
    moved = written("position", position, 6), written("velocity", velocity, 6)
    lib.hc_write_lengths(given("lengths", lengths, 6), period, fastest, *moved)


def field_at(field: Struct, point: np.ndarray, sense: np.ndarray, error: np.ndarray) -> bool:
    """Write the six components of a field at a point; return whether that is outside its box."""
    where = given("point", point, 3), given("sense", sense, 3)
    return bool(lib.hc_field_at(field.at, *where, written("error", error, 6)))


def actual_length(state: Struct, strut: int, command: float, sense: float = 0.0, shift: float = 0.0) -> float:
    """Return the real length of a strut for a command, m; `sense` is its direction of motion, −1…1."""
    if not 0 <= strut < 6:
        raise ValueError(f"strut: must be 0…5, not {strut}")
    return lib.hc_actual_length(state.at, strut, command, sense, shift)


def backwards(
    state: Struct,
    position: np.ndarray,
    rotation: np.ndarray,
    low: np.ndarray,
    sense: np.ndarray,
    model_position: np.ndarray,
    model_rotation: np.ndarray,
    commands: np.ndarray,
) -> int:
    """Run the model backwards for one platform pose; the motion, low and sense (9,), goes on.

    Returns OK, NOT_CONVERGED, or OUTSIDE_FIELD where the field is held at the boundary of its box.
    """
    motion = written("low", low, 9), written("sense", sense, 9)
    model = written("model_position", model_position, 3), written("model_rotation", model_rotation, 3, 3)
    pose: tuple[Any, Any] = given("position", position, 3), given("rotation", rotation, 3, 3)
    return lib.hc_backwards(state.at, *pose, *motion, *model, written("commands", commands, 6))
