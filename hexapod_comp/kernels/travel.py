"""Compiled: how far a tool may go from where it is."""

from __future__ import annotations

import math

import numpy as np

from .compensation import OUTSIDE, SOLVED, compensate_one
from .compiling import compiled
from .kinematics import rotate
from .limits import WITHIN

HALVINGS = 32
"""Of a step."""


@compiled
def travel_one(position, rotation, shift, turn, step, longest, frame, fixed, refuses_outside, last, new):
    """Go from a tool pose in `frame` along a unit vector `shift`, or about one, `turn`, until a command is refused.

    The other vector is zero. `fixed`, `last` and `new` are those of compensate_one; `last` is a state before the first
    command, so that single poses are judged. Returns two ways next to each other, the last that is allowed and the
    first that is not, infinite where `longest` is allowed, zero where the pose itself is not; and what came of that.
    """
    at, turned = np.empty(3), np.empty((3, 3))
    inside, outside, halvings = -step, math.inf, 0
    refused = SOLVED, WITHIN, -1, 0, math.nan, math.nan
    while halvings < HALVINGS and inside < longest and outside > 0.0:
        if math.isinf(outside):
            way = min(inside + step, longest)
        else:
            way = 0.5 * (inside + outside)
            halvings += 1
        at[:], turned[:] = position, rotation
        for i in range(3):
            at[i] += way * shift[i]
        rotate(turned, way * turn[0], way * turn[1], way * turn[2])
        outcome = compensate_one(at, turned, math.nan, math.nan, frame, fixed, last, new)
        solved = outcome[0] == SOLVED or (outcome[0] == OUTSIDE and not refuses_outside)
        if solved and outcome[1] == WITHIN:
            inside = way
        else:
            outside, refused = way, outcome
    return inside, outside, refused
