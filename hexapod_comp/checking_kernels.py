"""Compiled: every limited quantity of poses, nominal and compensated."""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .kernels import condition_one, strut_lengths_one
from .limit_kernels import joint_cosines, nearest_strut, strut_ends
from .machine_kernels import command_one

QUANTITIES, CLEARANCE, CONDITION, SIGN = 26, 18, 24, 25
"""Per pose and stage: 6 lengths, 6 cosines at the base joints, 6 at the platform joints, 6 distances to the
nearest strut, condition, sign."""

NOTHING, UNSOLVED, OUTSIDE = range(3)
"""What became of a pose: nothing special, no command was found, its measured point is outside the field's box."""


@compiled
def examine_many(
    positions,
    rotations,
    independent,
    nominal_base,
    nominal_platform,
    limits,
    thresholds,
    low,
    sense,
    body,
    struts,
    field,
    values,
    flags,
):
    """Write the limited quantities, (N, 2, QUANTITIES), of N platform poses, and a flag each.

    `low` and `sense` (9,) are the motion state, carried from pose to pose unless they are `independent`.
    """
    q_position, q_rotation, commands = np.empty(3), np.empty((3, 3)), np.empty(6)
    for n in range(len(positions)):
        if independent:
            low[:] = np.nan
            sense[:] = 0.0
        position, rotation = positions[n], rotations[n]
        row = values[n, 0]
        strut_lengths_one(nominal_base, nominal_platform, position, rotation, row)
        fill(nominal_base, nominal_platform, position, rotation, limits, row)
        solved, outside = command_one(
            position,
            rotation,
            thresholds,
            low,
            sense,
            body,
            struts,
            field,
            q_position,
            q_rotation,
            commands,
        )
        flags[n] = OUTSIDE if outside else NOTHING
        if not solved:
            flags[n] = UNSOLVED
            values[n, 1, :] = np.nan
            continue
        row = values[n, 1]
        row[:6] = commands
        fill(body[0], body[1], q_position, q_rotation, limits, row)


@compiled
def fill(base, platform, position, rotation, limits, values):
    """Write joint cosines, clearances, condition number and sign of det J of one pose beside its lengths."""
    _, cone_axes, _, apart, scalars = limits
    for i in range(6):
        values[6 + i], values[12 + i] = joint_cosines(base, platform, position, rotation, cone_axes, i)
        values[CLEARANCE + i] = math.inf
    if scalars[5] > 0.0:
        ends = strut_ends(base, platform, position, rotation)
        for i in range(6):
            values[CLEARANCE + i] = nearest_strut(base, ends, apart, i, 6)[0]
    values[CONDITION], values[SIGN] = condition_one(base, platform, position, rotation, scalars[3])
