"""The C core's functions on NumPy arrays, with checks of each array's shape, type and layout.

The caller allocates the arrays: C-contiguous and, unless stated otherwise, float64. Several threads can work on slices
of the same arrays, as the core releases the GIL. Comments in the C files of this folder describe the functions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from . import Struct, dtype_of, ffi, lib

QUANTITIES = dtype_of("hc_quantities")  # The quantities of a pose that have a limit
KINDS: dict[str | None, np.dtype] = {
    None: np.dtype(float),
    "int": np.dtype(np.intc),
    "byte": np.dtype(np.int8),
    "quantities": QUANTITIES,
}
TYPES = dict(
    zip(KINDS.values(), map(ffi.typeof, ("double[]", "int[]", "signed char[]", "hc_quantities[]")), strict=True)
)
ARGUMENT = re.compile(r"([!>]?)(\w+)(?:\[([\w,]+)\])?(?::(\w+))?$")


def given(name: str, array: np.ndarray, *shape: int, kind: Any = float) -> Any:
    """Return the C pointer to an array that C reads; raise ValueError if its shape, type or layout is wrong."""
    if array.dtype != kind or array.shape != shape or not array.flags.c_contiguous:
        layout = "C-contiguous" if array.flags.c_contiguous else "not C-contiguous"
        wanted = f"C-contiguous {np.dtype(kind)} of shape {shape}"
        raise ValueError(f"{name}: must be {wanted}, not {layout} {array.dtype} of shape {array.shape}")
    return ffi.from_buffer(TYPES[array.dtype], array)


def written(name: str, array: np.ndarray, *shape: int, kind: Any = float) -> Any:
    """Return the C pointer to an array that C writes; raise ValueError as :func:`given`, and for a read-only array."""
    buffer = given(name, array, *shape, kind=kind)
    if not array.flags.writeable:
        raise ValueError(f"{name}: is read-only")
    return buffer


def entry(function: str, arguments: str) -> Callable[..., Any]:
    """Return a Python function that checks its array arguments and calls a function of the core.

    `arguments` lists the C function's arguments. ``name[N,3]`` is an array that C reads, ``!name[N]:int`` an array that
    C writes, and ``>name[N]`` an array that the Python function makes and returns in place of C's result. ``N`` is the
    number of rows of the arrays, ``strut`` an index, 0…5; any other name is a number or a struct.
    """
    call, from_buffer = getattr(lib, function), ffi.from_buffer
    plan, position = [], 0
    counts: dict[str, int] = {}
    for argument in arguments.split():
        role, name, shape, kind = ARGUMENT.match(argument).groups()  # type: ignore[union-attr]
        sizes: list[Any] = [int(size) if size.isdigit() else size for size in shape.split(",")] if shape else []
        asked = role != ">" and not name.isupper()
        if sizes and asked and isinstance(sizes[0], str):
            counts.setdefault(sizes[0], position)
        fixed = tuple(sizes) if all(isinstance(size, int) for size in sizes) else None
        plan.append((name, role, sizes, fixed, KINDS[kind], TYPES[KINDS[kind]], position if asked else -1))
        position += asked

    def run(*values: Any) -> Any:
        if len(values) != position:
            raise TypeError(f"{function}: takes {position} arguments, not {len(values)}")
        rows = {letter: len(values[at]) for letter, at in counts.items()}
        passed, made = [], []
        for name, role, sizes, fixed, kind, pointer, at in plan:
            if sizes:
                shape = tuple([rows.get(size, size) for size in sizes]) if fixed is None else fixed
                if role == ">":
                    made.append(np.empty(shape, kind))
                array = made[-1] if role == ">" else values[at]
                try:
                    if (array.dtype is not kind and array.dtype != kind) or array.shape != shape:
                        raise ValueError(name)
                    passed.append(from_buffer(pointer, array, bool(role)))
                except (ValueError, BufferError):
                    passed.append((written if role else given)(name, array, *shape, kind=kind))  # raises
            elif at < 0:
                passed.append(rows[name])
            elif name == "strut" and not 0 <= values[at] < 6:
                raise ValueError(f"strut: must be 0…5, not {values[at]}")
            else:
                passed.append(getattr(values[at], "at", values[at]))
        result = call(*passed)
        return result if not made else made[0] if len(made) == 1 else tuple(made)

    return run


JOINTS, POSES = "base[6,3] platform[6,3]", "positions[N,3] rotations[N,3,3]"
POSE, MOTION = "position[3] rotation[3,3]", "!low[9] !sense[9]"

# --- kinematics ---

strut_lengths = entry("hc_strut_lengths_many", f"{JOINTS} N {POSES} !lengths[N,6]")
solve_poses = entry(
    "hc_solve_pose_many",
    f"{JOINTS} N lengths[N,6] !positions[N,3] !rotations[N,3,3] characteristic_length home_sign max_condition "
    "!outcomes[N]:int !iterations[N]:int !conditions[N]",
)
jacobians = entry("hc_jacobian_many", f"{JOINTS} N {POSES} !matrices[N,6,6]")
conditions = entry("hc_condition_many", f"{JOINTS} N {POSES} characteristic_length !numbers[N] !signs[N]")
motions = entry("hc_motions_many", f"N {POSES} to_positions[N,3] to_rotations[N,3,3] point[3] axes[3,3] !moved[6,N]")
screw_twists = entry("hc_screw_twists", f"{JOINTS} base_axes[6,3] platform_axes[6,3] N {POSES} >twists[N,6]")
rotate = entry("hc_rotate", "!rotation[3,3] x y z")
rotation_flaw = entry("hc_rotation_flaw", "rotation[3,3]")
solve_linear = entry("hc_solve_linear", "!matrix[6,6] !right[6]")

# --- the model ---

strut_errors = entry("hc_strut_errors", "state strut sense N commands[N] >errors[N] >slopes[N]")
strut_commands = entry("hc_strut_commands", "state strut sense shift N lengths[N] >commands[N]")
field_at = entry("hc_field_at", "field point[3] sense[3] !error[6]")
follow = entry("hc_follow", "threshold N values[N] >low[N] >sense[N]")
follow_nine = entry("hc_follow_nine", f"values[9] axis_threshold strut_threshold {MOTION}")
follow_point = entry("hc_follow_point", f"{POSE} probe[3] threshold {MOTION}")
backwards = entry(
    "hc_backwards_many",
    f"state N {POSES} !low[N,9] !sense[N,9] >model_positions[N,3] >model_rotations[N,3,3] >commands[N,6] "
    ">outcomes[N]:int",
)
forwards = entry(
    "hc_forwards_many",
    "state N commands[N,6] senses[N,9] !model_positions[N,3] !model_rotations[N,3,3] !positions[N,3] "
    "!rotations[N,3,3] !outcomes[N]:int !conditions[N]",
)

# --- limits, drives ---

examine = entry("hc_examine", f"{JOINTS} limits {POSE} >quantities[1,1]:quantities")
examine_poses = entry(
    "hc_examine_many", f"state N {POSES} independent {MOTION} >quantities[N,2]:quantities >flags[N]:int"
)
check_poses = entry(
    "hc_check_poses", f"{JOINTS} limits N positions[N,3] M rotations[M,3,3] !findings[N]:byte !struts[N,2]:byte"
)
run_drives = entry("hc_run_drives", "drives commands[6] ticks !sense[9]")


def go(state: Any, tool: Any, frame: Any, shift: np.ndarray, turn: np.ndarray, step: float, longest: float) -> Any:
    """Return as C struct ``hc_way`` how far a tool can move along `shift`, or turn about `turn`, within the limits."""
    if not (step > 0.0 and math.isfinite(longest)):
        raise ValueError(f"step, longest: must be above 0 and finite, not {step}, {longest}")
    way = ffi.new("hc_way *")
    lib.hc_go(state, tool, frame, given("shift", shift, 3), given("turn", turn, 3), step, longest, way)
    return way


def read_pose(numbers: Sequence[float], position: np.ndarray, rotation: np.ndarray) -> int:
    """Write seven numbers, position and quaternion (x, y, z, w), into position and rotation; return the Status."""
    if len(numbers) != 7:
        raise ValueError(f"numbers: must be seven, position and quaternion, not {len(numbers)}")
    return lib.hc_read_pose(numbers, written("position", position, 3), written("rotation", rotation, 3, 3))


def quaternion_of(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w) of a rotation matrix (3, 3)."""
    quaternion = ffi.new("double[4]")
    lib.hc_quaternion(given("rotation", rotation, 3, 3), quaternion)
    return tuple(quaternion)


def check_stage(*pose: np.ndarray, limits: Struct) -> tuple[int, int, float]:
    """Return status, strut (−1: none) and found value of the first limit that a pose or its strut lengths break."""
    strut, value = ffi.new("int *"), ffi.new("double *")
    shapes = {"base": (6, 3), "platform": (6, 3), "position": (3,), "rotation": (3, 3), "lengths": (6,)}
    arrays = (given(name, part, *shape) for part, (name, shape) in zip(pose, shapes.items(), strict=True))
    status = lib.hc_check_stage(*arrays, limits.at, strut, value)
    return status, strut[0], value[0]
