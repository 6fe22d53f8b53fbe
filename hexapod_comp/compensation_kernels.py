"""Compiled steps of the compensator's loop.

Handing an array to a compiled function costs more than most of what is computed with it, so everything
that stays the same between two commands travels in two vectors, and everything that changes in a third.
Each vector is packed and taken apart by two functions that stand side by side here.
"""

from __future__ import annotations

import math

import numpy as np

from . import kernels
from .compiling import compiled
from .geometry import HexapodGeometry
from .limit_kernels import CORRECTION as CORRECTION_FOUND
from .limit_kernels import STEP, WITHIN, check_change, check_stage, limits_of
from .machine import RealMachine
from .machine_kernels import actual_pose_one, command_one
from .pose import POSE_OK, Pose, read_pose
from .struts import PARAMETERS

SOLVED, UNSOLVED, OUTSIDE, NO_POSE = range(4)
"""How it went: solved, field not undone, solved with the field held at its boundary, input is no pose."""

LOW, SENSE, NOMINAL, CORRECTION, COMMAND, BUMP, TIME, STATE_SIZE = 0, 9, 18, 24, 30, 36, 42, 43
"""Where the parts of a state begin: motion windows and directions (9 each), six struts each, time of the command."""

ENABLED, CHANGED, RAMP_RATE = range(3)
"""What the compensator is told from outside: share of the correction, whether anything changed, m/s."""

LONGEST_RAMP_STEP = 0.02
"""A pause between commands counts as no more than this in a ramp, s: a late command must not step."""

TABLE_END = 72 + 6 * PARAMETERS


def pack_machine(machine: RealMachine) -> np.ndarray:
    """Return what :func:`machine_views` takes apart."""
    parts = (*machine.body, machine.strut_arrays[0], machine.field_arrays[0], machine.thresholds, machine.solver)
    return np.concatenate([np.ravel(part) for part in parts])


@compiled
def machine_views(numbers):
    """Return the body (four arrays), strut table, probe, thresholds, solver's scalars."""
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


def pack_nominal(geometry: HexapodGeometry) -> np.ndarray:
    """Return what :func:`nominal_views` takes apart."""
    tool_inverse = geometry.tool.inverse()
    parts = (*geometry.kernel_joints, tool_inverse.position, tool_inverse.rotation, *geometry.limit_numbers)
    return np.concatenate([np.ravel(part) for part in parts])


@compiled
def nominal_views(numbers):
    """Return base, platform, tool inverse (position over rotation) and the limits."""
    return (
        numbers[:18].reshape((6, 3)),
        numbers[18:36].reshape((6, 3)),
        numbers[36:48].reshape((4, 3)),
        limits_of(numbers[48:]),
    )


def pack_pose(pose: Pose) -> np.ndarray:
    """Return position, then rotation matrix by rows, shape (12,)."""
    return np.concatenate([pose.position, pose.rotation.ravel()])


@compiled
def pose_views(poses):
    """Return positions and rotations of the two poses, (24,), that a command leaves behind."""
    return poses[:3], poses[3:12].reshape((3, 3)), poses[12:15], poses[15:].reshape((3, 3))


@compiled
def compose(p1, r1, p2, r2, position, rotation):
    """Write the pose product (p1, r1) ∘ (p2, r2)."""
    for i in range(3):
        position[i] = p1[i] + r1[i, 0] * p2[0] + r1[i, 1] * p2[1] + r1[i, 2] * p2[2]
        for j in range(3):
            rotation[i, j] = r1[i, 0] * r2[0, j] + r1[i, 1] * r2[1, j] + r1[i, 2] * r2[2, j]


@compiled
def compensate_one(
    position,
    rotation,
    time,
    frame,
    fixed,
    switches,
    state,
    next_state,
    poses,
):
    """Run the whole chain for one command; return (status, finding, strut, stage, value, condition number).

    `fixed` holds the machine's numbers, the nominal ones, and the arrays whose size varies. `state` stays as
    it is; `next_state` and `poses` (platform pose, model pose) are written, and count only when nothing was
    found.
    """
    machine_numbers, nominal_numbers, varied = fixed
    body, table, probe, thresholds, _ = machine_views(machine_numbers)
    nominal_base, nominal_platform, tool, limits = nominal_views(nominal_numbers)
    struts, field = (table, *varied[:2]), (probe, *varied[2:])
    platform_position, platform_rotation, model_position, model_rotation = pose_views(poses)
    half_position, half_rotation = np.empty(3), np.empty((3, 3))
    compose(frame[:3], frame[3:].reshape((3, 3)), position, rotation, half_position, half_rotation)
    compose(half_position, half_rotation, tool[0], tool[1:], platform_position, platform_rotation)
    nominal, correction = next_state[NOMINAL:CORRECTION], next_state[CORRECTION:COMMAND]
    command = next_state[COMMAND:BUMP]
    kernels.strut_lengths_one(nominal_base, nominal_platform, platform_position, platform_rotation, nominal)
    finding, strut, value, _, condition = check_stage(
        nominal_base, nominal_platform, platform_position, platform_rotation, nominal, limits
    )
    if finding != WITHIN:
        return SOLVED, finding, strut, 0, value, condition
    next_state[:NOMINAL] = state[:NOMINAL]
    solved, outside = command_one(
        platform_position,
        platform_rotation,
        thresholds,
        next_state[LOW:SENSE],
        next_state[SENSE:NOMINAL],
        body,
        struts,
        field,
        model_position,
        model_rotation,
        command,
    )
    if not solved:
        return UNSOLVED, WITHIN, -1, 1, math.nan, condition
    for i in range(6):
        correction[i] = switches[ENABLED] * (command[i] - nominal[i])
    next_state[TIME] = time
    ramp_bump(correction, state, next_state[BUMP:TIME], switches, time)
    for i in range(6):
        correction[i] += next_state[BUMP + i]
        command[i] = nominal[i] + correction[i]
    finding, strut, value, stage = check_command(nominal, correction, command, state, limits)
    if finding == WITHIN:
        stage = 1
        finding, strut, value, _, _ = check_stage(body[0], body[1], model_position, model_rotation, command, limits)
    return OUTSIDE if outside else SOLVED, finding, strut, stage, value, condition


@compiled
def compensate_quaternion(
    x,
    y,
    z,
    qx,
    qy,
    qz,
    qw,
    time,
    frame,
    fixed,
    switches,
    state,
    next_state,
    poses,
):
    """Run :func:`compensate_one` on a position and a quaternion, as messages carry them.

    When the status is NO_POSE, the finding is the outcome of :func:`hexapod_comp.pose.read_pose`.
    """
    position, rotation = np.empty(3), np.empty((3, 3))
    outcome = read_pose(x, y, z, qx, qy, qz, qw, position, rotation)
    if outcome != POSE_OK:
        return NO_POSE, outcome, -1, 0, math.nan, math.nan
    return compensate_one(
        position,
        rotation,
        time,
        frame,
        fixed,
        switches,
        state,
        next_state,
        poses,
    )


@compiled
def check_command(nominal, correction, command, state, limits):
    """Check correction and steps; return (finding, strut, value, stage)."""
    for i in range(6):
        if not abs(correction[i]) <= limits.correction:
            return CORRECTION_FOUND, i, correction[i], 1
    finding, strut, value = check_change(nominal, state[NOMINAL:CORRECTION], limits.step, STEP)
    if finding != WITHIN:
        return finding, strut, value, 0
    finding, strut, value = check_change(command, state[COMMAND:BUMP], limits.step, STEP)
    return finding, strut, value, 1


@compiled
def ramp_bump(correction, state, next_bump, switches, time):
    """Write the part of the last correction that has not been given up yet.

    When model, temperatures or enabling have changed since the last command, the bump takes up the whole
    difference, so that the command does not move; it then shrinks in proportion, its largest element at no
    more than the ramp rate.
    """
    pause = time - state[TIME]
    ramp = 0.0 if math.isnan(pause) else switches[RAMP_RATE] * min(max(pause, 0.0), LONGEST_RAMP_STEP)
    largest = 0.0
    for i in range(6):
        next_bump[i] = state[BUMP + i]
        if switches[CHANGED] != 0.0 and not math.isnan(state[CORRECTION + i]):
            next_bump[i] = state[CORRECTION + i] - correction[i]
        largest = max(largest, abs(next_bump[i]))
    keep = 0.0 if largest <= ramp else 1.0 - ramp / largest
    for i in range(6):
        next_bump[i] *= keep


@compiled
def estimate_one(
    readings,
    state,
    fixed,
    tool_position,
    tool_rotation,
    model_pose,
    tool_pose,
):
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
        state[SENSE:NOMINAL],
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
