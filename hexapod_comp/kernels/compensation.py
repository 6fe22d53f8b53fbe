"""Compiled steps of the compensator's loop.

Handing an array to a compiled function costs more than most of what is computed with it, and a named tuple more
still. So everything that stays the same between two commands travels in two vectors, and everything that changes in
a third; here they are taken apart, and their parts get names.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from . import kinematics as kernels
from .compiling import compiled
from .limits import CORRECTION, STEP, WITHIN, check_change, check_stage, limits_of
from .model import actual_pose_one, command_one
from .pose import POSE_OK, read_pose
from .struts import PARAMETERS

SOLVED, UNSOLVED, OUTSIDE, NO_POSE = range(4)
"""How it went: solved, field not undone, solved with the field held at its boundary, input is no pose."""

STATE_SIZE = 71
"""Length of a vector of :class:`State`."""

LONGEST_RAMP_STEP = 0.02
"""A pause between commands counts as no more than this in a ramp, s: a late command must not step."""

TABLE_END = 72 + 6 * PARAMETERS


class State(NamedTuple):
    """What one command leaves behind, and all that decides the next answer beside geometry, model and temperatures.

    Parts of one vector, which single numbers are too: arrays of one. A recording holds them under these names, so a
    new meaning needs a new name.

    Attributes
    ----------
    motion_low, motion_sense : ndarray, shape (9,)
        Windows and directions of motion, see :class:`~hexapod_comp.machine.motion.MotionState`.
    nominal, correction, command : ndarray, shape (6,)
        Of the struts, m; after a reset to measured struts, the command is where they stand.
    ramp : ndarray, shape (6,)
        The part of the correction that a change has still to take away, m.
    time : ndarray, shape (1,)
        Of the command, s.
    platform_position, platform_rotation, model_position, model_rotation : ndarray, shape (3,), (3, 3)
        ``pose_platform_in_base`` commanded, m, and the model pose q with q ∘ E(q) = that pose.
    enabled, changed, resumes : ndarray, shape (1,)
        1 or 0: corrections are on; model, temperatures or enabling have changed since the last command; the next
        command starts from measured struts.
    ramp_rate : ndarray, shape (1,)
        Largest speed of the ramp, m/s.
    """

    motion_low: np.ndarray
    motion_sense: np.ndarray
    nominal: np.ndarray
    correction: np.ndarray
    command: np.ndarray
    ramp: np.ndarray
    time: np.ndarray
    platform_position: np.ndarray
    platform_rotation: np.ndarray
    model_position: np.ndarray
    model_rotation: np.ndarray
    enabled: np.ndarray
    changed: np.ndarray
    resumes: np.ndarray
    ramp_rate: np.ndarray


@compiled
def state_of(numbers):
    """Return the state that a vector, (STATE_SIZE,), holds: its parts, not copies."""
    return State(
        motion_low=numbers[:9],
        motion_sense=numbers[9:18],
        nominal=numbers[18:24],
        correction=numbers[24:30],
        command=numbers[30:36],
        ramp=numbers[36:42],
        time=numbers[42:43],
        platform_position=numbers[43:46],
        platform_rotation=numbers[46:55].reshape((3, 3)),
        model_position=numbers[55:58],
        model_rotation=numbers[58:67].reshape((3, 3)),
        enabled=numbers[67:68],
        changed=numbers[68:69],
        resumes=numbers[69:70],
        ramp_rate=numbers[70:71],
    )


@compiled
def machine_views(numbers):
    """Return what :func:`hexapod_comp.compensation.compensator.pack_machine` packs.

    The body (four arrays), strut table, probe, thresholds, solver's scalars.
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
        numbers[end + 5 : end + 8],
    )


@compiled
def nominal_views(numbers):
    """Return what :func:`hexapod_comp.compensation.compensator.pack_nominal` packs.

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
def compensate_one(position, rotation, time, frame, fixed, numbers, next_numbers):
    """Run the whole chain for one command; return (status, finding, strut, stage, value, condition number).

    `fixed` holds the machine's numbers, the nominal ones, and the arrays whose size varies. The state in `numbers`
    stays as it is; the one in `next_numbers` is written, and counts only when nothing was found.
    """
    machine_numbers, nominal_numbers, varied = fixed
    body, table, probe, thresholds, _ = machine_views(machine_numbers)
    nominal_base, nominal_platform, tool, limits = nominal_views(nominal_numbers)
    struts, field = (table, *varied[:2]), (probe, *varied[2:])
    next_numbers[:] = numbers
    last, new = state_of(numbers), state_of(next_numbers)
    at = np.empty(3), np.empty((3, 3))
    compose(frame[:3], frame[3:].reshape((3, 3)), position, rotation, at[0], at[1])
    compose(at[0], at[1], tool[0], tool[1:], new.platform_position, new.platform_rotation)
    platform, model = (new.platform_position, new.platform_rotation), (new.model_position, new.model_rotation)
    kernels.strut_lengths_one(nominal_base, nominal_platform, *platform, new.nominal)
    finding, strut, value, _, condition = check_stage(nominal_base, nominal_platform, *platform, new.nominal, limits)
    if finding != WITHIN:
        return SOLVED, finding, strut, 0, value, condition
    motion = new.motion_low, new.motion_sense
    solved, outside = command_one(*platform, thresholds, *motion, body, struts, field, *model, new.command)
    if not solved:
        return UNSOLVED, WITHIN, -1, 1, math.nan, condition
    for i in range(6):
        new.correction[i] = last.enabled[0] * (new.command[i] - new.nominal[i])
    new.time[0], new.changed[0], new.resumes[0] = time, 0.0, 0.0
    shrink_ramp(last, new)
    for i in range(6):
        new.correction[i] += new.ramp[i]
        new.command[i] = new.nominal[i] + new.correction[i]
    finding, strut, value, stage = check_command(last, new, limits)
    if finding == WITHIN:
        stage = 1
        finding, strut, value, _, _ = check_stage(body[0], body[1], *model, new.command, limits)
    return OUTSIDE if outside else SOLVED, finding, strut, stage, value, condition


@compiled
def compensate_quaternion(x, y, z, qx, qy, qz, qw, time, frame, fixed, numbers, next_numbers):
    """Run :func:`compensate_one` on a position and a quaternion, as messages carry them.

    When the status is NO_POSE, the finding is the outcome of :func:`hexapod_comp.kernels.kinematics.pose.read_pose`.
    """
    position, rotation = np.empty(3), np.empty((3, 3))
    outcome = read_pose(x, y, z, qx, qy, qz, qw, position, rotation)
    if outcome != POSE_OK:
        return NO_POSE, outcome, -1, 0, math.nan, math.nan
    return compensate_one(position, rotation, time, frame, fixed, numbers, next_numbers)


@compiled
def check_command(last, new, limits):
    """Check correction and steps; return (finding, strut, value, stage)."""
    for i in range(6):
        if not abs(new.correction[i]) <= limits.correction:
            return CORRECTION, i, new.correction[i], 1
    finding, strut, value = check_change(new.nominal, last.nominal, limits.step, STEP)
    if finding != WITHIN:
        return finding, strut, value, 0
    finding, strut, value = check_change(new.command, last.command, limits.step, STEP)
    return finding, strut, value, 1


@compiled
def shrink_ramp(last, new):
    """Write the part of the last correction that is still to be taken away, beside the new one without it.

    When model, temperatures or enabling have changed since the last command, the ramp takes up the whole
    difference, so that the command does not move; it then shrinks in proportion, its largest element at no
    more than the ramp rate.
    """
    pause = new.time[0] - last.time[0]
    step = 0.0 if math.isnan(pause) else last.ramp_rate[0] * min(max(pause, 0.0), LONGEST_RAMP_STEP)
    largest = 0.0
    for i in range(6):
        if last.changed[0] != 0.0 and not math.isnan(last.correction[i]):
            new.ramp[i] = last.correction[i] - new.correction[i]
        largest = max(largest, abs(new.ramp[i]))
    keep = 0.0 if largest <= step else 1.0 - step / largest
    for i in range(6):
        new.ramp[i] *= keep


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
        state_of(numbers).motion_sense,
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
