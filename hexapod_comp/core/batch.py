"""The core on arrays: named functions, and the one place where shape, type and layout of an array are checked.

Inputs and outputs are arrays that the caller owns, C-contiguous, float64 unless stated otherwise; a function writes its
last arguments. Rows may be slices, so that threads share a batch: the core releases the GIL.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from . import Struct, ffi, lib

QUANTITIES = np.dtype(
    [
        ("lengths", float, 6),
        ("cosines", float, (2, 6)),
        ("distances", float, 6),
        ("nearest", float, 6),
        ("condition", float),
        ("sign", float),
    ]
)
"""``hc_quantities``: the limited quantities of a pose, in one stage."""

TYPES = {np.dtype(float): "double[]", np.dtype(np.intc): "int[]", np.dtype(np.int8): "signed char[]"}


def given(name: str, array: np.ndarray, *shape: int, kind: Any = float) -> Any:
    """Return what the core reads of an array.

    Raises
    ------
    ValueError
        It has another shape, type or layout.
    """
    _check(name, array, shape, kind)
    return ffi.from_buffer(TYPES[array.dtype], array)


def written(name: str, array: np.ndarray, *shape: int, kind: Any = float) -> Any:
    """Return what the core writes into an array; raises as :func:`given`, and for one that is read-only."""
    _check(name, array, shape, kind)
    if not array.flags.writeable:
        raise ValueError(f"{name}: is read-only")
    return ffi.from_buffer(TYPES[array.dtype], array)


def _check(name: str, array: np.ndarray, shape: tuple[int, ...], kind: Any) -> None:
    if array.dtype != kind or array.shape != shape or not array.flags.c_contiguous:
        layout = "C-contiguous" if array.flags.c_contiguous else "not C-contiguous"
        wanted = f"C-contiguous {np.dtype(kind)} of shape {shape}"
        raise ValueError(f"{name}: must be {wanted}, not {layout} {array.dtype} of shape {array.shape}")


def _poses(positions: np.ndarray, rotations: np.ndarray) -> tuple[int, Any, Any]:
    count = len(positions)
    return count, given("positions", positions, count, 3), given("rotations", rotations, count, 3, 3)


def _joints(base: np.ndarray, platform: np.ndarray) -> tuple[Any, Any]:
    return given("base", base, 6, 3), given("platform", platform, 6, 3)


# --- kinematics ----------------------------------------------------------------------------------------------


def strut_lengths(
    base: np.ndarray, platform: np.ndarray, positions: np.ndarray, rotations: np.ndarray, lengths: np.ndarray
) -> None:
    """Write |P + R·t_i − b_i|, m, shape (N, 6), of joints (6, 3) at poses (N, 3), (N, 3, 3)."""
    poses = _poses(positions, rotations)
    lib.hc_strut_lengths_many(*_joints(base, platform), *poses, written("lengths", lengths, poses[0], 6))


def solve_poses(
    base: np.ndarray,
    platform: np.ndarray,
    lengths: np.ndarray,
    positions: np.ndarray,
    rotations: np.ndarray,
    characteristic_length: float,
    home_sign: float,
    max_condition: float,
    outcomes: np.ndarray,
    iterations: np.ndarray,
    conditions: np.ndarray,
) -> None:
    """Solve the loop closures |P + R·t_i − b_i| = L_i of N sets of lengths by Newton from guesses.

    Parameters
    ----------
    base, platform : ndarray, shape (6, 3)
        Joints, m.
    lengths : ndarray, shape (N, 6)
        m.
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        Guesses; overwritten where the outcome is HC_OK.
    characteristic_length, home_sign, max_condition : float
        What a solution is judged by; a sign of 0 accepts either assembly.
    outcomes, iterations : ndarray of intc, shape (N,)
        ``hc_status``; Newton steps.
    conditions : ndarray, shape (N,)
        Condition numbers, NaN where there is no solution.
    """
    count = len(lengths)
    lib.hc_solve_pose_many(
        *_joints(base, platform),
        count,
        given("lengths", lengths, count, 6),
        written("positions", positions, count, 3),
        written("rotations", rotations, count, 3, 3),
        characteristic_length,
        home_sign,
        max_condition,
        written("outcomes", outcomes, count, kind=np.intc),
        written("iterations", iterations, count, kind=np.intc),
        written("conditions", conditions, count),
    )


def jacobians(
    base: np.ndarray, platform: np.ndarray, positions: np.ndarray, rotations: np.ndarray, matrices: np.ndarray
) -> None:
    """Write ∂L/∂(v, ω), shape (N, 6, 6), twist in ``base``: row i is (u_i, R·t_i × u_i)."""
    poses = _poses(positions, rotations)
    lib.hc_jacobian_many(*_joints(base, platform), *poses, written("matrices", matrices, poses[0], 6, 6))


def conditions(
    base: np.ndarray,
    platform: np.ndarray,
    positions: np.ndarray,
    rotations: np.ndarray,
    characteristic_length: float,
    numbers: np.ndarray,
    signs: np.ndarray,
) -> None:
    """Write condition numbers ‖J‖·‖J⁻¹‖/6 in Frobenius norms, and signs of det J, shape (N,) each.

    Rotation columns are divided by the characteristic length: 1 for an isotropic machine, ∞ at a singular pose, within
    [κ₂/6, κ₂] of the spectral condition number and an order cheaper.
    """
    poses = _poses(positions, rotations)
    out = written("numbers", numbers, poses[0]), written("signs", signs, poses[0])
    lib.hc_condition_many(*_joints(base, platform), *poses, characteristic_length, *out)


def motions(
    positions: np.ndarray,
    rotations: np.ndarray,
    to_positions: np.ndarray,
    to_rotations: np.ndarray,
    point: np.ndarray,
    axes: np.ndarray,
    moved: np.ndarray,
) -> None:
    """Write the motion from each pose to another, shape (6, N): displacement of a point, m, and rotation vector, rad.

    Parameters
    ----------
    positions, rotations, to_positions, to_rotations : ndarray, shape (N, 3), (N, 3, 3) each
        Poses and where they go, in ``base``, m.
    point : ndarray, shape (3,)
        In ``platform``, m.
    axes : ndarray, shape (3, 3)
        Its columns are the axes, in ``base``, along which the motions are written.
    moved : ndarray, shape (6, N)
        NaN after exactly half a turn, whose axis could point either way.
    """
    poses, count = _poses(positions, rotations), len(positions)
    lib.hc_motions_many(
        *poses,
        given("to_positions", to_positions, count, 3),
        given("to_rotations", to_rotations, count, 3, 3),
        given("point", point, 3),
        given("axes", axes, 3, 3),
        written("moved", moved, 6, count),
    )


def screw_twists(
    body: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], positions: np.ndarray, rotations: np.ndarray
) -> np.ndarray:
    """Return the angles about the struts from the base's cardan axes to the platform's, shape (N, 6), rad.

    `body`: joints of base and platform, then their cardan axes, (6, 3) each. Both axes are seen along the strut. Where
    the angle stays within ±90°, its sine is the one in LinuxCNC's genhexkins.
    """
    poses = _poses(positions, rotations)
    twists = np.empty((poses[0], 6))
    names = ("base", "platform", "base_axes", "platform_axes")
    parts = [given(name, part, 6, 3) for name, part in zip(names, body, strict=True)]
    lib.hc_screw_twists(*parts, *poses, written("twists", twists, poses[0], 6))
    return twists


# --- the model -----------------------------------------------------------------------------------------------


def strut_errors(state: Any, strut: int, commands: np.ndarray, sense: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of a strut at commands, m, without backlash and growth, and their slopes; shape (N,) each."""
    count = len(commands)
    errors, slopes = np.empty(count), np.empty(count)
    out = written("errors", errors, count), written("slopes", slopes, count)
    lib.hc_strut_errors(state, _strut(strut), sense, count, given("commands", commands, count), *out)
    return errors, slopes


def strut_commands(state: Any, strut: int, lengths: np.ndarray, sense: float, shift: float = 0.0) -> np.ndarray:
    """Return the commands that give a strut real lengths, m, shape (N,); `shift`, m, is for its screw's rotation."""
    count = len(lengths)
    commands = np.empty(count)
    out = written("commands", commands, count)
    lib.hc_strut_commands(state, _strut(strut), sense, shift, count, given("lengths", lengths, count), out)
    return commands


def _strut(index: int) -> int:
    if not 0 <= index < 6:
        raise ValueError(f"strut: must be 0…5, not {index}")
    return index


def follow(values: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return window (lower end) and direction of motion after each of N values that follow each other, (N,) each."""
    count = len(values)
    low, sense = np.empty(count), np.empty(count)
    out = written("low", low, count), written("sense", sense, count)
    lib.hc_follow(threshold, count, given("values", values, count), *out)
    return low, sense


def backwards(
    state: Any,
    positions: np.ndarray,
    rotations: np.ndarray,
    senses: np.ndarray,
    model_positions: np.ndarray,
    model_rotations: np.ndarray,
    commands: np.ndarray,
    solved: np.ndarray,
) -> None:
    """Run a model backwards for N platform poses, each by itself, with given directions of motion, shape (N, 9).

    `solved`, of intc, is 0 where the field cannot be undone.
    """
    poses = _poses(positions, rotations)
    count = poses[0]
    lib.hc_backwards_many(
        state,
        *poses,
        given("senses", senses, count, 9),
        written("model_positions", model_positions, count, 3),
        written("model_rotations", model_rotations, count, 3, 3),
        written("commands", commands, count, 6),
        written("solved", solved, count, kind=np.intc),
    )


def forwards(
    state: Any,
    commands: np.ndarray,
    senses: np.ndarray,
    model_positions: np.ndarray,
    model_rotations: np.ndarray,
    positions: np.ndarray,
    rotations: np.ndarray,
    outcomes: np.ndarray,
    conditions: np.ndarray,
) -> None:
    """Run a model forwards for N sets of commands, each by itself.

    Model poses are guesses, and solutions where the outcome, an ``hc_status`` of intc, is HC_OK; only there the poses
    are written.
    """
    count = len(commands)
    lib.hc_forwards_many(
        state,
        count,
        given("commands", commands, count, 6),
        given("senses", senses, count, 9),
        written("model_positions", model_positions, count, 3),
        written("model_rotations", model_rotations, count, 3, 3),
        written("positions", positions, count, 3),
        written("rotations", rotations, count, 3, 3),
        written("outcomes", outcomes, count, kind=np.intc),
        written("conditions", conditions, count),
    )


# --- limits --------------------------------------------------------------------------------------------------


def pose_of(position: np.ndarray, rotation: np.ndarray) -> Any:
    """Return a pose as the core takes it, ``hc_pose *``."""
    pose = ffi.new("hc_pose *")
    ffi.memmove(pose.position, given("position", position, 3), 24)
    ffi.memmove(pose.rotation, given("rotation", rotation, 3, 3), 72)
    return pose


def examine(
    base: np.ndarray, platform: np.ndarray, limits: Any, position: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Return the limited quantities of one pose, shape (1, 1) of :data:`QUANTITIES`; `limits`: ``hc_limits *``."""
    quantities = np.empty((1, 1), QUANTITIES)
    into = ffi.from_buffer("hc_quantities *", quantities)
    lib.hc_examine(*_joints(base, platform), limits, pose_of(position, rotation), into)
    return quantities


def examine_poses(
    state: Any,
    positions: np.ndarray,
    rotations: np.ndarray,
    independent: bool,
    low: np.ndarray,
    sense: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the limited quantities of N platform poses, nominal and compensated, and a flag each.

    Parameters
    ----------
    state : hc_state *
        The machine.
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        ``pose_platform_in_base``, m.
    independent : bool
        Forget the motion before each pose: its directions are the given ones.
    low, sense : ndarray, shape (9,)
        The motion state; updated.

    Returns
    -------
    quantities : ndarray of QUANTITIES, shape (N, 2)
        The second is not written where the flag is HC_NOT_CONVERGED.
    flags : ndarray of intc, shape (N,)
        HC_OK, HC_NOT_CONVERGED: no command was found, HC_OUTSIDE_FIELD: the field's value was held at the boundary.
    """
    poses = _poses(positions, rotations)
    quantities, flags = np.empty((poses[0], 2), QUANTITIES), np.empty(poses[0], np.intc)
    motion = written("low", low, 9), written("sense", sense, 9)
    into = ffi.from_buffer("hc_quantities[]", quantities), written("flags", flags, poses[0], kind=np.intc)
    lib.hc_examine_many(state, *poses, independent, *motion, *into)
    return quantities, flags


def check_poses(
    base: np.ndarray,
    platform: np.ndarray,
    limits: Any,
    positions: np.ndarray,
    rotations: np.ndarray,
    findings: np.ndarray,
    struts: np.ndarray,
) -> None:
    """Write the first limit that each of N poses breaks, an ``hc_status``, and the struts concerned, −1 for none.

    `rotations` are (N, 3, 3), or (1, 3, 3) for all; `findings` (N,) and `struts` (N, 2) are of int8.
    """
    count, turns = len(positions), len(rotations)
    if turns not in (1, count):
        raise ValueError(f"rotations: must be 1 or {count}, not {turns}")
    lib.hc_check_poses(
        *_joints(base, platform),
        limits,
        count,
        given("positions", positions, count, 3),
        turns,
        given("rotations", rotations, turns, 3, 3),
        written("findings", findings, count, kind=np.int8),
        written("struts", struts, count, 2, kind=np.int8),
    )


def go(
    state: Any,
    tool: Any,
    frame: Any,
    shift: np.ndarray,
    turn: np.ndarray,
    step: float,
    longest: float,
) -> Any:
    """Return how far a tool may go from a pose in a frame, both ``hc_pose *``: ``hc_way``, see the header.

    Along the unit vector `shift`, or about `turn`, the other one being 0; `state` had no command yet.
    """
    if not (step > 0.0 and math.isfinite(longest)):
        raise ValueError(f"step, longest: must be above 0 and finite, not {step}, {longest}")
    way = ffi.new("hc_way *")
    lib.hc_go(state, tool, frame, given("shift", shift, 3), given("turn", turn, 3), step, longest, way)
    return way


# --- assembly modes, drives ----------------------------------------------------------------------------------


def settle(circles: np.ndarray, sides: np.ndarray, angles: np.ndarray, points: np.ndarray, errors: np.ndarray) -> None:
    """Minimise the side errors of a triangle over N sets of three angles, in place.

    Circles (3, 3, 3) are rows (centre, p, q), m, sides (3,) those between their joints, m; corners (N, 3, 3) and each
    one's largest side error, m, are written.
    """
    count = len(angles)
    lib.hc_settle_many(
        given("circles", circles, 3, 3, 3),
        given("sides", sides, 3),
        count,
        written("angles", angles, count, 3),
        written("points", points, count, 3, 3),
        written("errors", errors, count),
    )


def run_drives(drives: Struct, commands: np.ndarray, ticks: int, sense: np.ndarray) -> None:
    """Run six drives, ``hc_drives``, for some ticks towards commands, m, (6,); write the struts' part of `sense`, (9,).

    What ``stopped`` already says stays. A drive brakes for its stops as for any command; what still runs into one (a
    jump, a command turned round too late) is stopped there dead.
    """
    lib.hc_run_drives(drives.at, given("commands", commands, 6), ticks, written("sense", sense, 9))


def follow_point(
    position: np.ndarray,
    rotation: np.ndarray,
    probe: np.ndarray,
    threshold: float,
    low: np.ndarray,
    sense: np.ndarray,
) -> None:
    """Follow the measured point of a platform pose along the three axes, see :mod:`hexapod_comp.machine.model`."""
    motion = written("low", low, 9), written("sense", sense, 9)
    lib.hc_follow_point(pose_of(position, rotation), given("probe", probe, 3), threshold, *motion)
