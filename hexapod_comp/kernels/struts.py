"""Compiled: what a strut makes of its command, and the command that gives it a length."""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .kinematics import strut_vector

OFFSET, PITCH, REFERENCE, WAVENUMBER, HARMONICS, BACKLASH, LEAD, TWIST_HOME, GROWTH, WAVES = range(10)
"""Columns of the table of strut parameters that the kernels read; from the last one on stand cosine and sine amplitude
of each harmonic of the screw wave, of which the first HARMONICS count."""

MOST_HARMONICS = 4

PARAMETERS = WAVES + 2 * MOST_HARMONICS

SMALL_ANGLE = 1.0 / 64.0
"""Up to here, rad, cosine and sine of a sum come from series that are good to 3e-14."""


@compiled
def screw_twist(base, platform, base_axes, platform_axes, position, rotation, i):
    """Return the angle about strut `i` from the base's cardan axis to the platform's, rad.

    Both axes are seen along the strut, i.e. projected perpendicular to it. Where the angle stays within
    ±90°, its sine is the one in LinuxCNC's genhexkins.
    """
    sx, sy, sz = strut_vector(base, platform, position, rotation, i)
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    ux, uy, uz = sx / length, sy / length, sz / length
    bx, by, bz = base_axes[i, 0], base_axes[i, 1], base_axes[i, 2]
    ax, ay, az = platform_axes[i, 0], platform_axes[i, 1], platform_axes[i, 2]
    px = rotation[0, 0] * ax + rotation[0, 1] * ay + rotation[0, 2] * az
    py = rotation[1, 0] * ax + rotation[1, 1] * ay + rotation[1, 2] * az
    pz = rotation[2, 0] * ax + rotation[2, 1] * ay + rotation[2, 2] * az
    sine = bx * (py * uz - pz * uy) + by * (pz * ux - px * uz) + bz * (px * uy - py * ux)
    cosine = bx * px + by * py + bz * pz - (bx * ux + by * uy + bz * uz) * (px * ux + py * uy + pz * uz)
    return math.atan2(sine, cosine)


@compiled
def screw_shift(base, platform, base_axes, platform_axes, position, rotation, table, i):
    """Return −l·θ/2π: how much longer the command of strut `i` must be for its screw's rotation, m.

    A platform that turns by θ about the strut turns the screw in its nut. A right-hand screw then advances
    by l·θ/2π by itself, wherever its nut sits, and the command must be shorter by as much.
    """
    lead = table[i, LEAD]
    if lead == 0.0:
        return 0.0
    twist = screw_twist(base, platform, base_axes, platform_axes, position, rotation, i)
    turns = (twist - table[i, TWIST_HOME]) / (2.0 * math.pi)
    return -lead * (turns - math.floor(turns + 0.5))


@compiled
def screw_turn(command, table, i):
    """Return cosine and sine of the angle that the screw of strut `i` has turned; (1, 0) where it has no wave."""
    if table[i, HARMONICS] == 0.0:
        return 1.0, 0.0
    angle = table[i, WAVENUMBER] * command
    return math.cos(angle), math.sin(angle)


@compiled
def turned_on(cosine, sine, angle):
    """Return cosine and sine of an angle increased by a small one."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0)))
    return cosine * c - sine * s, sine * c + cosine * s


@compiled
def wave_error(cosine, sine, table, i):
    """Return (error, slope) of the screw wave at an angle of the screw; harmonics by the addition theorem."""
    a, b = table[i, WAVES], table[i, WAVES + 1]
    error, slope = a * cosine + b * sine, b * cosine - a * sine
    c, s = cosine, sine
    for n in range(2, int(table[i, HARMONICS]) + 1):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        a, b = table[i, WAVES + 2 * n - 2], table[i, WAVES + 2 * n - 1]
        error += a * c + b * s
        slope += n * (b * c - a * s)
    return error, table[i, WAVENUMBER] * slope


@compiled
def error_at(command, cosine, sine, sense, table, knots, pieces, i):
    """Return (error, slope) as :func:`smooth_error`, for a screw whose angle is known.

    Of `pieces`, the first four columns are the length map's, the others those of the change of the backlash.
    """
    error = table[i, OFFSET] + table[i, PITCH] * (command - table[i, REFERENCE])
    slope = table[i, PITCH]
    if table[i, HARMONICS] != 0.0:
        wave, steep = wave_error(cosine, sine, table, i)
        error += wave
        slope += steep
    last = knots.shape[0] - 1
    if last > 0:
        held = min(knots[last], max(knots[0], command))
        piece = min(np.searchsorted(knots, held, side="right") - 1, last - 1)
        x = held - knots[piece]
        half = -0.5 * sense
        a, b = pieces[i, piece, 0] + half * pieces[i, piece, 4], pieces[i, piece, 1] + half * pieces[i, piece, 5]
        c3, d = pieces[i, piece, 2] + half * pieces[i, piece, 6], pieces[i, piece, 3] + half * pieces[i, piece, 7]
        error += ((a * x + b) * x + c3) * x + d
        if held == command:
            slope += (3.0 * a * x + 2.0 * b) * x + c3
    return error, slope


@compiled
def smooth_error(command, sense, table, knots, pieces, i):
    """Return (error, slope) of what depends on the command: offset, pitch, waves, map, and the backlash's change."""
    cosine, sine = screw_turn(command, table, i)
    return error_at(command, cosine, sine, sense, table, knots, pieces, i)


@compiled
def actual_length(command, sense, shift, table, knots, pieces, i):
    """Return the real length of strut `i` for a command, m; `sense` is its direction of motion, −1…1."""
    error, _ = smooth_error(command, sense, table, knots, pieces, i)
    return (1.0 + table[i, GROWTH]) * (command + error - 0.5 * sense * table[i, BACKLASH] - shift)


@compiled
def command_for_length(length, sense, shift, table, knots, pieces, i):
    """Return the command that gives strut `i` a real length, m: the inverse of :func:`actual_length`.

    Offset and pitch are undone beforehand: what is left for Newton's method are micrometres, by which the screw hardly
    turns, so its angle costs one cosine and sine in all.
    """
    wanted = length / (1.0 + table[i, GROWTH]) + 0.5 * sense * table[i, BACKLASH] + shift
    command = wanted - table[i, OFFSET]
    command -= table[i, PITCH] * (command - table[i, REFERENCE])
    cosine, sine = screw_turn(command, table, i)
    for _ in range(8):
        error, slope = error_at(command, cosine, sine, sense, table, knots, pieces, i)
        step = (wanted - command - error) / (1.0 + slope)
        command += step
        if abs(step) < 1e-9:  # Newton squares it: the rest is below rounding
            break
        angle = table[i, WAVENUMBER] * step
        if abs(angle) < SMALL_ANGLE:
            cosine, sine = turned_on(cosine, sine, angle)
        else:
            cosine, sine = screw_turn(command, table, i)
    return command


@compiled
def write_lengths(lengths, period, fastest, position, velocity):
    """Write six lengths and their speeds in place; these are at most `fastest`: jitter in stamps is no speed."""
    if period > 0.0:
        for i in range(6):
            period = max(period, abs(lengths[i] - position[i]) / fastest)
    for i in range(6):
        velocity[i] = (lengths[i] - position[i]) / period if period > 0.0 else 0.0
        position[i] = lengths[i]


@compiled
def within(values, others, limit):
    """Return whether six values differ from six others by no more than a limit."""
    worst = 0.0
    for i in range(6):
        worst = max(worst, abs(values[i] - others[i]))
    return worst <= limit
