"""Compiled steps of the compensator's loop.

Handing an array to a compiled function costs more than most of what is computed with it, and a named tuple more
still. So everything that stays the same between two commands travels in two vectors, and everything that changes in
a third; here they are taken apart, and their parts get names. Of the state, which has many parts, the kernel asks for
places by name: views of all of them would make a command slower by a tenth.
"""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from . import kinematics as kernels
from .compiling import compiled
from .limits import CORRECTION, STEP, WITHIN, check_change, check_stage, limits_of
from .model import actual_pose_one, command_one
from .pose import POSE_OK, read_pose
from .struts import PARAMETERS

SOLVED, UNSOLVED, OUTSIDE, NO_POSE = range(4)
"""How it went: solved, field not undone, solved with the field held at its boundary, input is no pose."""

LONGEST_RAMP_STEP = 0.02
"""A pause between commands counts as no more than this in a ramp, s: a late command must not step."""

TABLE_END = 72 + 6 * PARAMETERS


class State(NamedTuple):
    """What one command leaves behind, and all that decides the next answer beside geometry, model and temperatures.

    Its parts stand one after the other in a vector. A recording holds them under these names, so a new meaning needs
    a new name.

    Attributes
    ----------
    motion_low, motion_sense : 9 numbers each
        Windows and directions of motion, see :class:`~hexapod_comp.machine.motion.MotionState`.
    nominal, correction, command : 6 numbers each
        Of the struts, m; after a reset to measured struts, the command is where they stand.
    ramp : 6 numbers
        The part of the correction that a change has still to take away, m.
    time : 1 number
        Of the command, s.
    platform_position, platform_rotation, model_position, model_rotation : 3 and 9 numbers
        ``pose_platform_in_base`` commanded, m, and the model pose q with q ∘ E(q) = that pose; matrices by rows.
    enabled, changed, resumes : 1 number each
        1 or 0: corrections are on; model, temperatures or enabling have changed since the last command; the next
        command starts from measured struts.
    ramp_rate : 1 number
        Largest speed of the ramp, m/s.
    """

    motion_low: Any
    motion_sense: Any
    nominal: Any
    correction: Any
    command: Any
    ramp: Any
    time: Any
    platform_position: Any
    platform_rotation: Any
    model_position: Any
    model_rotation: Any
    enabled: Any
    changed: Any
    resumes: Any
    ramp_rate: Any


SIZES = State(9, 9, 6, 6, 6, 6, 1, 3, 9, 3, 9, 1, 1, 1, 1)
"""How many numbers each part is."""

AT = State(*accumulate(SIZES[:-1], initial=0))
"""Where in the vector each part begins."""

STATE_SIZE = sum(SIZES)


def state_of(numbers: np.ndarray) -> State:
    """Return the state that a vector, (STATE_SIZE,), holds: its parts, not copies."""
    return State(*(numbers[begin : begin + size] for begin, size in zip(AT, SIZES, strict=True)))


@compiled
def machine_views(numbers):
    """Return what :func:`hexapod_comp.compensation.state.pack_machine` packs.

    The body (four arrays), strut table, probe, thresholds, and what a solution is judged by.
    """
    end = TABLE_END
    body = (
        numbers[:18].reshape((6, 3)),
        numbers[18:36].reshape((6, 3)),
        numbers[36:54].reshape((6, 3)),
        numbers[54:72].reshape((6, 3)),
    )
    return (
        body,
        numbers[72:end].reshape((6, PARAMETERS)),
        numbers[end : end + 3],
        numbers[end + 3 : end + 5],
        (numbers[end + 5], numbers[end + 6], numbers[end + 7]),
    )


@compiled
def nominal_views(numbers):
    """Return what :func:`hexapod_comp.compensation.state.pack_nominal` packs.

    Base, platform, tool inverse (position over rotation) and the limits.
    """
    return (
        numbers[:18].reshape((6, 3)),
        numbers[18:36].reshape((6, 3)),
        numbers[36:48].reshape((4, 3)),
        limits_of(numbers[48:]),
    )


@compiled
def compose(p1, r1, p2, r2, position, rotation):
    """Write the pose product (p1, r1) ∘ (p2, r2)."""
    for i in range(3):
        position[i] = p1[i] + r1[i, 0] * p2[0] + r1[i, 1] * p2[1] + r1[i, 2] * p2[2]
        for j in range(3):
            rotation[i, j] = r1[i, 0] * r2[0, j] + r1[i, 1] * r2[1, j] + r1[i, 2] * r2[2, j]


@compiled
def compensate_one(position, rotation, time, frame, fixed, last, new):
    """Run the whole chain for one command; return (status, finding, strut, stage, value, condition number).

    `fixed` holds the machine's numbers, the nominal ones, and the arrays whose size varies. The state in `last`
    stays as it is; the one in `new` is written, and counts only when nothing was found.
    """
    machine_numbers, nominal_numbers, varied = fixed
    body, table, probe, thresholds, _ = machine_views(machine_numbers)
    nominal_base, nominal_platform, tool, limits = nominal_views(nominal_numbers)
    struts, field = (table, *varied[:2]), (probe, *varied[2:])
    new[:] = last
    half = np.empty(3), np.empty((3, 3))
    platform = pose_at(new, AT.platform_position, AT.platform_rotation)
    model = pose_at(new, AT.model_position, AT.model_rotation)
    nominal, command = new[AT.nominal : AT.nominal + 6], new[AT.command : AT.command + 6]
    compose(frame[:3], frame[3:].reshape((3, 3)), position, rotation, half[0], half[1])
    compose(half[0], half[1], tool[0], tool[1:], platform[0], platform[1])
    kernels.strut_lengths_one(nominal_base, nominal_platform, *platform, nominal)
    finding, strut, value, _, condition = check_stage(nominal_base, nominal_platform, *platform, nominal, limits)
    if finding != WITHIN:
        return SOLVED, finding, strut, 0, value, condition
    motion = new[AT.motion_low : AT.motion_low + 9], new[AT.motion_sense : AT.motion_sense + 9]
    solved, outside = command_one(*platform, thresholds, *motion, body, struts, field, *model, command)
    if not solved:
        return UNSOLVED, WITHIN, -1, 1, math.nan, condition
    for i in range(6):
        new[AT.correction + i] = last[AT.enabled] * (command[i] - nominal[i])
    new[AT.time], new[AT.changed], new[AT.resumes] = time, 0.0, 0.0
    shrink_ramp(last, new)
    for i in range(6):
        new[AT.correction + i] += new[AT.ramp + i]
        command[i] = nominal[i] + new[AT.correction + i]
    finding, strut, value, stage = check_command(last, new, limits)
    if finding == WITHIN:
        stage = 1
        finding, strut, value, _, _ = check_stage(body[0], body[1], *model, command, limits)
    return OUTSIDE if outside else SOLVED, finding, strut, stage, value, condition


@compiled
def pose_at(numbers, position, rotation):
    """Return the position and rotation that stand at two places of a vector: its parts, not copies."""
    return numbers[position : position + 3], numbers[rotation : rotation + 9].reshape((3, 3))


@compiled
def compensate_quaternion(x, y, z, qx, qy, qz, qw, time, frame, fixed, last, new):
    """Run :func:`compensate_one` on a position and a quaternion, as messages carry them.

    When the status is NO_POSE, the finding is the outcome of :func:`hexapod_comp.kernels.kinematics.pose.read_pose`.
    """
    position, rotation = np.empty(3), np.empty((3, 3))
    outcome = read_pose(x, y, z, qx, qy, qz, qw, position, rotation)
    if outcome != POSE_OK:
        return NO_POSE, outcome, -1, 0, math.nan, math.nan
    return compensate_one(position, rotation, time, frame, fixed, last, new)


@compiled
def check_command(last, new, limits):
    """Check correction and steps; return (finding, strut, value, stage)."""
    for i in range(6):
        if not abs(new[AT.correction + i]) <= limits.correction:
            return CORRECTION, i, new[AT.correction + i], 1
    finding, strut, value = check_change(new[AT.nominal :], last[AT.nominal :], limits.step, STEP)
    if finding != WITHIN:
        return finding, strut, value, 0
    finding, strut, value = check_change(new[AT.command :], last[AT.command :], limits.step, STEP)
    return finding, strut, value, 1


@compiled
def shrink_ramp(last, new):
    """Write the part of the last correction that is still to be taken away, beside the new one without it.

    When model, temperatures or enabling have changed since the last command, the ramp takes up the whole
    difference, so that the command does not move; it then shrinks in proportion, its largest element at no
    more than the ramp rate.
    """
    pause = new[AT.time] - last[AT.time]
    step = 0.0 if math.isnan(pause) else last[AT.ramp_rate] * min(max(pause, 0.0), LONGEST_RAMP_STEP)
    largest = 0.0
    for i in range(6):
        if last[AT.changed] != 0.0 and not math.isnan(last[AT.correction + i]):
            new[AT.ramp + i] = last[AT.correction + i] - new[AT.correction + i]
        largest = max(largest, abs(new[AT.ramp + i]))
    keep = 0.0 if largest <= step else 1.0 - step / largest
    for i in range(6):
        new[AT.ramp + i] *= keep


@compiled
def estimate_one(readings, numbers, fixed, tool_position, tool_rotation, model_pose, tool_pose):
    """Run the model forwards from six strut readings; return (outcome, condition number).

    `model_pose` (12,) is the guess and, when the outcome is OK, becomes the solution; `tool_pose` (12,) in ``base``
    is then written: position, rotation matrix by rows.
    """
    machine_numbers, _, varied = fixed
    body, table, probe, _, solver = machine_views(machine_numbers)
    struts, field = (table, *varied[:2]), (probe, *varied[2:])
    position, rotation = np.empty(3), np.empty((3, 3))
    outcome, _, condition, _ = actual_pose_one(
        readings,
        numbers[AT.motion_sense : AT.motion_sense + 9],
        body,
        struts,
        field,
        solver,
        model_pose[:3],
        model_pose[3:].reshape((3, 3)),
        position,
        rotation,
    )
    if outcome == kernels.OK:
        compose(position, rotation, tool_position, tool_rotation, tool_pose[:3], tool_pose[3:].reshape((3, 3)))
    return outcome, condition
