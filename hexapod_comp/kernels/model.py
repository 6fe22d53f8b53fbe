"""Compiled runs of the machine model: backwards (what to command) and forwards (where the tool really goes).

What stays the same between two commands travels in tuples of arrays: the `body` (base joints, platform
joints, cardan axes on the base, on the platform), the `struts` (table, map knots, map pieces) and the
`field` (probe, three grids, three families of lines); see :class:`hexapod_comp.machine.model.RealMachine`.
"""

from __future__ import annotations

import math

import numpy as np

from . import kinematics as kernels
from .compiling import compiled
from .field import field_one
from .motion import follow
from .struts import LEAD, actual_length, command_for_length, screw_shift


@compiled
def undo_field(position, rotation, sense, field, q_position, q_rotation):
    """Solve q ∘ E(q) = target for q; return (solved, outside).

    With f the measured point, E moves it by d(f) and turns the platform by exp(ω(f)), both along the axes
    of ``base``. So q's measured point is a fixed point of f ← f_target − d(f): a contraction whose factor
    is the field's slope, some 1e-4 on a machine tool.
    """
    probe, gx, gy, gz, lx, ly, lz = field
    error = np.empty(6)
    offset = lever(rotation, probe)
    tx, ty, tz = position[0] + offset[0], position[1] + offset[1], position[2] + offset[2]
    point = np.empty(3)
    point[0], point[1], point[2] = tx, ty, tz
    solved, outside = False, False
    for _ in range(50):
        outside = field_one(point, sense, gx, gy, gz, lx, ly, lz, error)
        change = abs(point[0] - (tx - error[0])) + abs(point[1] - (ty - error[1])) + abs(point[2] - (tz - error[2]))
        point[0], point[1], point[2] = tx - error[0], ty - error[1], tz - error[2]
        if change < 1e-15:
            solved = True
            break
    for i in range(3):
        for j in range(3):
            q_rotation[i, j] = rotation[i, j]
    if error[3] != 0.0 or error[4] != 0.0 or error[5] != 0.0:
        kernels.rotate(q_rotation, -error[3], -error[4], -error[5])
    offset = lever(q_rotation, probe)
    for i in range(3):
        q_position[i] = point[i] - offset[i]
    return solved, outside


@compiled
def apply_field(q_position, q_rotation, sense, field, position, rotation):
    """Write q ∘ E(q): the measured point moves by d, the platform turns by exp(ω) about it; return outside."""
    probe, gx, gy, gz, lx, ly, lz = field
    error = np.empty(6)
    point = np.empty(3)
    offset = lever(q_rotation, probe)
    for i in range(3):
        point[i] = q_position[i] + offset[i]
    outside = field_one(point, sense, gx, gy, gz, lx, ly, lz, error)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = q_rotation[i, j]
    if error[3] != 0.0 or error[4] != 0.0 or error[5] != 0.0:
        kernels.rotate(rotation, error[3], error[4], error[5])
    offset = lever(rotation, probe)
    for i in range(3):
        position[i] = point[i] + error[i] - offset[i]
    return outside


@compiled
def lever(rotation, offset):
    """Return R·o as a tuple."""
    return (
        rotation[0, 0] * offset[0] + rotation[0, 1] * offset[1] + rotation[0, 2] * offset[2],
        rotation[1, 0] * offset[0] + rotation[1, 1] * offset[1] + rotation[1, 2] * offset[2],
        rotation[2, 0] * offset[0] + rotation[2, 1] * offset[1] + rotation[2, 2] * offset[2],
    )


@compiled
def command_one(position, rotation, thresholds, low, sense, body, struts, field, q_position, q_rotation, commands):
    """Run the model backwards for one platform pose; return (solved, outside).

    `thresholds` are those of the axes and of the struts, m; `low` and `sense` (9,) are the motion state,
    updated in place; q and `commands` are written.
    """
    base, platform, base_axes, platform_axes = body
    table, knots, pieces = struts
    point = lever(rotation, field[0])
    for axis in range(3):
        follow(position[axis] + point[axis], thresholds[0], low, sense, axis)
    solved, outside = undo_field(position, rotation, sense, field, q_position, q_rotation)
    for i in range(6):
        sx, sy, sz = kernels.strut_vector(base, platform, q_position, q_rotation, i)
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        direction = follow(length, thresholds[1], low, sense, 3 + i)
        shift = screw_shift(base, platform, base_axes, platform_axes, q_position, q_rotation, table, i)
        commands[i] = command_for_length(length, direction, shift, table, knots, pieces, i)
    return solved, outside


@compiled
def actual_pose_one(commands, sense, body, struts, field, solver, q_position, q_rotation, position, rotation):
    """Run the model forwards for six commands; return (outcome, iterations, condition, outside).

    `solver` holds characteristic length, home sign and largest condition number. q (guess in, solution out)
    and the actual pose are written only when the outcome is OK. The screw rotation depends on the pose
    sought, so lengths and pose are settled in turn; that contracts by the lead over the strut length, and
    takes one pass when there is no lead.
    """
    base, platform, base_axes, platform_axes = body
    table, knots, pieces = struts
    lengths = np.empty(6)
    shifts = np.zeros(6)
    p, r = q_position.copy(), q_rotation.copy()
    turning = False
    for i in range(6):
        turning = turning or table[i, LEAD] != 0.0
    outcome, iterations, condition = kernels.NOT_CONVERGED, 0, math.nan
    for _ in range(20):
        change = 0.0
        for i in range(6):
            shift = screw_shift(base, platform, base_axes, platform_axes, p, r, table, i)
            change = max(change, abs(shift - shifts[i]))
            shifts[i] = shift
            lengths[i] = actual_length(commands[i], sense[3 + i], shift, table, knots, pieces, i)
        if turning and outcome == kernels.OK and change < 1e-15:
            break
        outcome, steps, condition = kernels.solve_pose_one(base, platform, lengths, p, r, *solver)
        iterations += steps
        if outcome != kernels.OK:
            return outcome, iterations, condition, False
        if not turning:
            break
    for i in range(3):
        q_position[i] = p[i]
        for j in range(3):
            q_rotation[i, j] = r[i, j]
    outside = apply_field(p, r, sense, field, position, rotation)
    return outcome, iterations, condition, outside


@compiled
def actual_pose_many(
    commands,
    senses,
    body,
    struts,
    field,
    solver,
    q_positions,
    q_rotations,
    positions,
    rotations,
    outcomes,
    conditions,
):
    """Batch of :func:`actual_pose_one`, each row by itself: commands (N, 6), senses (N, 9), guesses in q."""
    for n in range(commands.shape[0]):
        outcomes[n], _, conditions[n], _ = actual_pose_one(
            commands[n],
            senses[n],
            body,
            struts,
            field,
            solver,
            q_positions[n],
            q_rotations[n],
            positions[n],
            rotations[n],
        )
