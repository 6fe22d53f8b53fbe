"""Compiled: every limited quantity of poses, nominal and compensated."""

from __future__ import annotations

import numpy as np

from .compiling import compiled
from .kinematics import strut_lengths_one
from .limits import examine
from .model import command_one

NOTHING, UNSOLVED, OUTSIDE = range(3)
"""What became of a pose: nothing special, no command was found, its measured point is outside the field's box."""


@compiled
def examine_many(
    positions, rotations, independent, nominal, limits, thresholds, low, sense, body, struts, field, quantities, flags
):
    """Write the limited quantities of N platform poses in both stages, and a flag each.

    `nominal` are the joints of base and platform. Where the flag is UNSOLVED, the compensated stage is not written.

    `low` and `sense` (9,) are the motion state, carried from pose to pose unless they are `independent`.
    """
    q_position, q_rotation, commands = np.empty(3), np.empty((3, 3)), np.empty(6)
    for n in range(len(positions)):
        if independent:
            low[:] = np.nan
            sense[:] = 0.0
        position, rotation = positions[n], rotations[n]
        strut_lengths_one(nominal[0], nominal[1], position, rotation, quantities.lengths[n, 0])
        examine(nominal[0], nominal[1], position, rotation, limits, quantities, n, 0)
        solved, outside = command_one(
            position, rotation, thresholds, low, sense, body, struts, field, q_position, q_rotation, commands
        )
        flags[n] = OUTSIDE if outside else NOTHING
        if not solved:
            flags[n] = UNSOLVED
            continue
        quantities.lengths[n, 1] = commands
        examine(body[0], body[1], q_position, q_rotation, limits, quantities, n, 1)
