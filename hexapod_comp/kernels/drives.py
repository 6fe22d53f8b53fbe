"""Compiled: the six strut drives, tick by tick."""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .model import lever
from .motion import follow

SETTLED = 1e-12
"""A reference closer to its command than this, m, is put onto it: an exponential never arrives."""


CONTACT = 1e-6
"""A motor that is asked to go beyond its travel counts as stopped within this distance of the stop, m."""


@compiled
def wanted_speed(distance, lag, max_speed, max_acceleration):
    """Return the speed at which to approach a command, m/s.

    distance/lag near it; further off the curve along which half the acceleration brakes the drive, which
    meets the straight part with the same slope. The other half is for the speed loop's own lag.
    """
    braking = 0.5 * max_acceleration
    size = abs(distance)
    speed = size / lag
    if size > braking * lag * lag:
        speed = math.sqrt(2.0 * braking * size - (braking * lag) ** 2)
    return math.copysign(min(speed, max_speed), distance)


@compiled
def move_reference(target, tick, lag, max_speed, max_acceleration, position, speed, i):
    """Move reference `i` for one tick towards its target."""
    if lag == 0.0:
        position[i] = target
        return
    distance = target - position[i]
    if abs(distance) < SETTLED and abs(speed[i]) * lag < SETTLED:
        position[i], speed[i] = target, 0.0
        return
    change = (wanted_speed(distance, lag, max_speed, max_acceleration) - speed[i]) * (4.0 * tick / lag)
    most = max_acceleration * tick
    speed[i] += min(most, max(-most, change))
    position[i] += tick * speed[i]


@compiled
def place_motor(step, low, high, half_play, position, motor, play, i):
    """Put motor `i` onto the step nearest to its reference, and let the nut follow with play."""
    before = motor[i]
    stepped = np.rint(position[i] / step) * step if step > 0.0 else position[i]
    motor[i] = min(high, max(low, stepped))
    play[i] = min(half_play[i], max(-half_play[i], play[i] + motor[i] - before))


@compiled
def run_struts(
    ticks,
    tick,
    lag,
    max_speed,
    max_acceleration,
    step,
    commands,
    stops,
    stuck,
    half_play,
    position,
    speed,
    motor,
    play,
    stopped,
    sense,
):
    """Run the six drives for some ticks; position, speed, motor, play, stopped and sense are updated.

    What `stopped` already says stays. A drive brakes for its stops as for any command; what still runs
    into one (a jump, a command turned round too late) is stopped there dead.
    """
    for i in range(6):
        low, high = stops[i, 0], stops[i, 1]
        target = min(high, max(low, commands[i]))
        hit = False
        for _ in range(ticks):
            if not stuck[i]:
                move_reference(target, tick, lag, max_speed, max_acceleration, position, speed, i)
            if position[i] < low or position[i] > high:
                hit = True
                position[i], speed[i] = min(high, max(low, position[i])), 0.0
            place_motor(step, low, high, half_play, position, motor, play, i)
        sense[3 + i] = play[i] / half_play[i] if half_play[i] > 0.0 else 0.0
        stopped[i] = stopped[i] or hit or (commands[i] != target and abs(motor[i] - target) <= CONTACT)


@compiled
def follow_point(position, rotation, probe, threshold, low, sense):
    """Follow the measured point of a platform pose along the three axes, see :mod:`hexapod_comp.machine.motion`."""
    arm = lever(rotation, probe)
    for axis in range(3):
        follow(position[axis] + arm[axis], threshold, low, sense, axis)
