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
from .limits import ACCELERATION, CORRECTION, EARLY, SPEED, STEP, WITHIN, check_change, check_stage, limits_of
from .model import actual_pose_one, command_one
from .pose import POSE_OK, read_pose
from .struts import PARAMETERS

SOLVED, UNSOLVED, OUTSIDE, NO_POSE = range(4)
"""How it went: solved, field not undone, solved with the field held at its boundary, input is no pose."""

LONGEST_RAMP_STEP = 0.02
"""A pause between commands counts as no more than this in a ramp, s: a late command must not step."""

AHEAD_BY_STAMP = 5e-3
"""By its stamp a command may be so much motion at the largest speed ahead, s: a controller whose loop was late by a
period catches it up at once, and periods of 4 ms are usual."""

AHEAD_BY_RECEIPT = 8e-4
"""By its receipt it may be only so much ahead, s, and waits otherwise: over 20 ms no strut is then sent faster than at
1.04 times the limit."""

SHORTEST_PERIOD = 1e-4
"""Two commands count as no closer than this when an acceleration is made of them, s."""

SMOOTHED_OVER = 0.02
"""Time constant over which a speed is smoothed before its change counts as an acceleration, s: stamps jitter."""

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
        command starts from measured struts, or with 2 must be where the struts are, as the tool has changed.
    ramp_rate : 1 number
        Largest speed of the ramp, m/s.
    received, published : 1 number each
        When the command was taken, and when what was answered had gone out, s on a clock that nobody sets; a reset does
        not forget them.
    ahead_by_stamp, ahead_by_receipt : 6 numbers each
        How far each strut is ahead of what the speed limit allows by the one clock and by the other, m.
    smooth_speed : 6 numbers
        Of the struts, m/s, where the acceleration is limited.
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
    received: Any
    published: Any
    ahead_by_stamp: Any
    ahead_by_receipt: Any
    smooth_speed: Any


SIZES = State(9, 9, 6, 6, 6, 6, 1, 3, 9, 3, 9, 1, 1, 1, 1, 1, 1, 6, 6, 6)
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
def compensate_one(position, rotation, time, received, frame, fixed, last, new):
    """Run the whole chain for one command; return (status, finding, strut, stage, value, condition number).

    `fixed` holds the machine's numbers, the nominal ones, and the arrays whose size varies. The state in `last`
    stays as it is; the one in `new` is written, and counts only when nothing was found. `time` is the command's stamp
    and `received` when it came, s; either may be NaN: not known.
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
    new[AT.time], new[AT.received], new[AT.published] = time, received, math.nan
    new[AT.changed], new[AT.resumes] = 0.0, 0.0
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
def compensate_quaternion(x, y, z, qx, qy, qz, qw, time, received, frame, fixed, last, new):
    """Run :func:`compensate_one` on a position and a quaternion, as messages carry them.

    When the status is NO_POSE, the finding is the outcome of :func:`hexapod_comp.kernels.kinematics.pose.read_pose`.
    """
    position, rotation = np.empty(3), np.empty((3, 3))
    outcome = read_pose(x, y, z, qx, qy, qz, qw, position, rotation)
    if outcome != POSE_OK:
        return NO_POSE, outcome, -1, 0, math.nan, math.nan
    return compensate_one(position, rotation, time, received, frame, fixed, last, new)


@compiled
def check_command(last, new, limits):
    """Check correction, steps, speed and acceleration; return (finding, strut, value, stage)."""
    for i in range(6):
        if not abs(new[AT.correction + i]) <= limits.correction:
            return CORRECTION, i, new[AT.correction + i], 1
    finding, strut, value = check_change(new[AT.nominal :], last[AT.nominal :], limits.step, STEP)
    if finding != WITHIN:
        return finding, strut, value, 0
    finding, strut, value = check_change(new[AT.command :], last[AT.command :], limits.step, STEP)
    if finding == WITHIN:
        finding, strut, value = check_speed(last, new, limits)
    if finding == WITHIN and limits.acceleration > 0.0:
        finding, strut, value = check_acceleration(last, new, limits)
    return finding, strut, value, 1


@compiled
def elapsed(last, new):
    """Return the time since the last command by the stamps and by the receipt, s; −1: not known.

    A stamp earlier than the last one's comes from a clock that was set back: it tells nothing.
    """
    by_stamp, by_receipt = new[AT.time] - last[AT.time], new[AT.received] - last[AT.received]
    return by_stamp if by_stamp >= 0.0 else -1.0, by_receipt if by_receipt >= 0.0 else -1.0


@compiled
def check_speed(last, new, limits):
    """Check the struts' speed by both clocks, and write how far they are ahead; return (finding, strut, value).

    What the limit would have allowed since the last command, and was not used, is lost: but for the small allowance, a
    pause gives no right to hurry. What counts is when commands go out; this one goes out now at the earliest, and how
    late the last one was is known. The value is a speed, m/s, or for EARLY the time after which the command may come.
    """
    by_stamp, by_receipt = elapsed(last, new)
    held_up = last[AT.published] - last[AT.received]
    if math.isnan(held_up):
        held_up = 0.0
    hurried, early, speed, wait = -1, -1, 0.0, 0.0
    for i in range(6):
        change = abs(new[AT.command + i] - last[AT.command + i])
        if math.isnan(change):  # there is no last command
            change = 0.0
        if by_stamp >= 0.0:
            ahead = max(0.0, last[AT.ahead_by_stamp + i] + change - limits.speed * by_stamp)
            new[AT.ahead_by_stamp + i] = ahead
            if ahead > limits.speed * AHEAD_BY_STAMP and change > speed * by_stamp:
                hurried, speed = i, change / max(by_stamp, 1e-9)
        if by_receipt >= 0.0:
            ahead = max(0.0, last[AT.ahead_by_receipt + i] - limits.speed * held_up)
            ahead = max(0.0, ahead + change - limits.speed * (by_receipt - held_up))
            new[AT.ahead_by_receipt + i] = ahead
            late = ahead / limits.speed - AHEAD_BY_RECEIPT
            if late > wait:
                early, wait = i, late
    if hurried >= 0:
        return SPEED, hurried, speed
    return (EARLY, early, wait) if early >= 0 else (WITHIN, -1, 0.0)


@compiled
def check_acceleration(last, new, limits):
    """Check how fast the struts' smoothed speeds change, and write them; return (finding, strut, m/s²).

    By the stamps, or where there are none by the receipt. Smoothing is u' = u·k + (1 − k)·Δl/Δt with
    k = exp(−Δt/SMOOTHED_OVER): a constant acceleration passes as what it is, a jump Δv as Δv/SMOOTHED_OVER.
    """
    by_stamp, by_receipt = elapsed(last, new)
    period = max(by_stamp if by_stamp >= 0.0 else by_receipt, SHORTEST_PERIOD)
    keep = math.exp(-period / SMOOTHED_OVER)
    finding, strut, worst = WITHIN, -1, limits.acceleration
    for i in range(6):
        before = last[AT.smooth_speed + i]
        speed = (new[AT.command + i] - last[AT.command + i]) / period
        new[AT.smooth_speed + i] = 0.0 if math.isnan(speed) else keep * before + (1.0 - keep) * speed
        acceleration = abs(new[AT.smooth_speed + i] - before) / period
        if acceleration > worst:
            finding, strut, worst = ACCELERATION, i, acceleration
    return finding, strut, worst


@compiled
def shrink_ramp(last, new):
    """Write the part of the last correction that is still to be taken away, beside the new one without it.

    When model, temperatures or enabling have changed since the last command, the ramp takes up the whole
    difference, so that the command does not move; it then shrinks in proportion, its largest element at no
    more than the ramp rate.
    """
    pause = new[AT.time] - last[AT.time]
    if math.isnan(pause):  # one of the two has no stamp
        pause = new[AT.received] - last[AT.received]
    step = last[AT.ramp_rate] * min(max(pause, 0.0), LONGEST_RAMP_STEP)
    if math.isnan(pause) or math.isnan(last[AT.nominal]):  # the first command stands where the struts are
        step = 0.0
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
