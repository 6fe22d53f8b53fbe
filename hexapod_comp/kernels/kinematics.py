"""Compiled kinematics: strut lengths, Jacobian, forward kinematics; single pose and batch.

These functions trust their arguments (C-contiguous float64, right shapes); :mod:`hexapod_comp.machine.kinematics`
checks them. Rotations are matrices; the twist (v, ω) is expressed in ``base``, so that a small rotation ω
updates multiplicatively, R ← exp(ω)·R.

Forward kinematics goes through :mod:`hexapod_comp.kernels.lanes` first. Whatever does not come out of it
converged, closed, well conditioned and in the working assembly mode is solved again with pivoting, which is
safe wherever the Jacobian is regular, and finds the reason of a failure.
"""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .lanes import (
    CONDITION,
    COUNT,
    LANES,
    MAX_ITERATIONS,
    MAX_ROTATION_STEP,
    PASSED,
    ROTATION_ROUNDING,
    ROWS,
    STEP_TOLERANCE,
    block_condition,
    closure_error,
    fill_lane,
    fill_poses,
    measure_lanes,
    rotation_error,
    row_of,
    six_rows,
    solve_lanes,
    straightened,
    strut_between,
    struts,
    take_lane,
    take_lengths,
    three_rows,
)
from .linalg import add, dot, frobenius_condition, inlined, internal, norm, scale, solve_six, subtract

OK, NOT_FINITE, NOT_CONVERGED, SINGULAR, UNREACHABLE, OTHER_ASSEMBLY = range(6)
"""Outcome of a forward solution; everything but OK leaves the caller's pose untouched."""

ONE = np.int64(1)
"""A literal 1 would be compiled as a case of its own."""


@compiled
def strut_lengths_one(base, platform, position, rotation, lengths):
    """Write |P + R·t_i − b_i| into `lengths`, shape (6,), m (Song et al., inverse kinematics)."""
    _write_lengths(six_rows(base), six_rows(platform), position, rotation, lengths)


@inlined
def _write_lengths(base, platform, position, rotation, lengths):
    """Write six strut lengths; joints come as tuples, so that a batch loads them once."""
    p, r = (position[0], position[1], position[2]), three_rows(rotation)
    lengths[0] = norm(strut_between(base[0], platform[0], p, r))
    lengths[1] = norm(strut_between(base[1], platform[1], p, r))
    lengths[2] = norm(strut_between(base[2], platform[2], p, r))
    lengths[3] = norm(strut_between(base[3], platform[3], p, r))
    lengths[4] = norm(strut_between(base[4], platform[4], p, r))
    lengths[5] = norm(strut_between(base[5], platform[5], p, r))


@compiled
def strut_vector(base, platform, position, rotation, i):
    """Return the vector from base joint to platform joint of strut `i` in ``base``, m."""
    p, r = (position[0], position[1], position[2]), three_rows(rotation)
    return strut_between(row_of(base, i), row_of(platform, i), p, r)


@compiled
def jacobian_one(base, platform, position, rotation, jacobian):
    """Write ∂L/∂(v, ω), shape (6, 6), twist in ``base``: row i is (u_i, R·t_i × u_i)."""
    for i in range(6):
        sx, sy, sz = strut_vector(base, platform, position, rotation, i)
        _jacobian_row(base, position, i, sx, sy, sz, jacobian)


@compiled
def jacobian_many(base, platform, positions, rotations, jacobians):
    """Batch of :func:`jacobian_one`: (N, 3), (N, 3, 3) → (N, 6, 6)."""
    for n in range(positions.shape[0]):
        jacobian_one(base, platform, positions[n], rotations[n], jacobians[n])


@internal
def _jacobian_row(base, position, i, sx, sy, sz, jacobian):
    """Write one row of the Jacobian and return the strut's length."""
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    ux, uy, uz = sx / length, sy / length, sz / length
    rx = sx + base[i, 0] - position[0]
    ry = sy + base[i, 1] - position[1]
    rz = sz + base[i, 2] - position[2]
    jacobian[i, 0], jacobian[i, 1], jacobian[i, 2] = ux, uy, uz
    jacobian[i, 3] = ry * uz - rz * uy
    jacobian[i, 4] = rz * ux - rx * uz
    jacobian[i, 5] = rx * uy - ry * ux
    return length


@compiled
def rotate(rotation, wx, wy, wz):
    """Replace R by exp(ω)·R in place (Rodrigues), ω in the outer frame, rad."""
    square = wx * wx + wy * wy + wz * wz
    if square < 1e-12:  # the series' next terms are below 1e-25
        sine, versine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        half = math.sin(0.5 * angle)
        sine, versine = math.sin(angle) / angle, 2.0 * half * half / square
    for j in range(3):
        x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
        cx, cy, cz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
        rotation[0, j] = x + sine * cx + versine * (wy * cz - wz * cy)
        rotation[1, j] = y + sine * cy + versine * (wz * cx - wx * cz)
        rotation[2, j] = z + sine * cz + versine * (wx * cy - wy * cx)


@compiled
def orthonormalise(rotation):
    """Remove the rounding that products leave in a rotation: one Newton step to the nearest one."""
    r = straightened(three_rows(rotation))
    for i in range(3):
        for j in range(3):
            rotation[i, j] = r[i][j]


@compiled
def motions_many(positions, rotations, to_positions, to_rotations, point, axes, motions):
    """Write the motion from each pose to another: displacement of a point of the platform, and rotation vector.

    Rotations are subtracted before they are multiplied: the smallest motion is off by no more than the poses are.

    Parameters
    ----------
    positions, rotations, to_positions, to_rotations : ndarray, shape (N, 3), (N, 3, 3) each
        Poses and where they go, in ``base``, m.
    point : ndarray, shape (3,)
        In ``platform``, m.
    axes : ndarray, shape (3, 3)
        Its columns are the axes, in ``base``, along which the motions are written.
    motions : ndarray, shape (6, N)
        m and rad. NaN after exactly half a turn, whose axis could point either way.
    """
    t, along = (point[0], point[1], point[2]), three_rows(axes.T)
    for n in range(positions.shape[0]):
        r, s = three_rows(rotations[n]), three_rows(to_rotations[n])
        x, y, z = subtract(s[0], r[0]), subtract(s[1], r[1]), subtract(s[2], r[2])
        shift = add(subtract(row_of(to_positions, n), row_of(positions, n)), (dot(x, t), dot(y, t), dot(z, t)))
        twice = (dot(z, r[1]) - dot(y, r[2]), dot(x, r[2]) - dot(z, r[0]), dot(y, r[0]) - dot(x, r[1]))
        sine, versine = 0.5 * norm(twice), 0.25 * (dot(x, x) + dot(y, y) + dot(z, z))
        if sine > 1e-4 or versine > 1.0:
            turn = scale(0.5 * math.atan2(sine, 1.0 - versine) / sine, twice)
        else:  # the series' next term is below 1e-17
            turn = scale(0.5 + sine * sine / 12.0, twice)
        for k in range(3):
            motions[k, n], motions[3 + k, n] = dot(along[k], shift), dot(along[k], turn)


@compiled
def condition_one(base, platform, position, rotation, characteristic_length):
    """Return (condition number, sign of det J) at a pose.

    The condition number is ‖J‖·‖J⁻¹‖/6 in Frobenius norms, with the rotation columns divided by the
    characteristic length: 1 for an isotropic machine, ∞ at a singular pose, within [κ₂/6, κ₂] of the
    spectral one and an order cheaper.
    """
    p = (position[0], position[1], position[2])
    s, m, lengths = struts(six_rows(base), six_rows(platform), p, three_rows(rotation))
    condition, sign = block_condition(s, m, lengths, characteristic_length)
    if sign != 0.0:
        return condition, sign
    jacobian = np.empty((6, 6))
    jacobian_one(base, platform, position, rotation, jacobian)
    for i in range(6):
        for j in range(3, 6):
            jacobian[i, j] /= characteristic_length
    return frobenius_condition(jacobian)


@compiled
def lengths_possible(base, platform, lengths):
    """Return whether every pair of struts can close its triangle, a necessary condition.

    For struts i, j the joints' distance on each body is fixed, so |L_i − L_j| ≤ |b_ij| + |t_ij| and
    L_i + L_j ≥ ||b_ij| − |t_ij||.
    """
    for i in range(6):
        for j in range(i):
            on_base, on_platform = 0.0, 0.0
            for k in range(3):
                on_base += (base[i, k] - base[j, k]) ** 2
                on_platform += (platform[i, k] - platform[j, k]) ** 2
            on_base, on_platform = math.sqrt(on_base), math.sqrt(on_platform)
            slack = 1e-12 * (on_base + on_platform)
            if abs(lengths[i] - lengths[j]) > on_base + on_platform + slack:
                return False
            if lengths[i] + lengths[j] < abs(on_base - on_platform) - slack:
                return False
    return True


@compiled
def solve_pose_one(base, platform, lengths, position, rotation, characteristic_length, home_sign, max_condition):
    """Solve the six loop closures |P + R·t_i − b_i| = L_i by Newton from a guess.

    Parameters
    ----------
    base, platform : ndarray, shape (6, 3)
        Joints, m.
    lengths : ndarray, shape (6,)
        Strut lengths, m.
    position, rotation : ndarray, shape (3,), (3, 3)
        Guess; overwritten by the solution only when the outcome is OK.
    characteristic_length : float
        See :func:`condition_one`, m.
    home_sign : float
        Sign of det J in the working assembly mode, 0.0 to accept any.
    max_condition : float
        Solutions with a larger condition number are refused as singular.

    Returns
    -------
    outcome : int
        One of the constants above.
    iterations : int
        Newton steps taken.
    condition : float
        Condition number at the solution, NaN when there is none.
    """
    lanes = np.empty(ROWS * LANES)
    fill_lane(lanes, 0, lengths, position, rotation)
    solve_lanes(base, platform, lanes, ONE, characteristic_length, home_sign, max_condition)
    if lanes[PASSED * LANES] == 1.0:
        take_lane(lanes, 0, position, rotation)
        return OK, int(lanes[COUNT * LANES]), lanes[CONDITION * LANES]
    return _solve_carefully(
        base, platform, lengths, position, rotation, characteristic_length, home_sign, max_condition
    )


@internal
def _solve_carefully(base, platform, lengths, position, rotation, characteristic_length, home_sign, max_condition):
    """Solve as :func:`solve_pose_one` does, with pivoting, and name the reason of a failure."""
    if not _usable(lengths, position, rotation):
        return NOT_FINITE, 0, math.nan
    if not lengths_possible(base, platform, lengths):
        return UNREACHABLE, 0, math.nan
    p, r = np.empty(3), np.empty((3, 3))
    _copy_pose(position, rotation, p, r)
    orthonormalise(r)  # or what a rounded guess is off stays in a step too small to be followed by another
    outcome, iterations = _newton(base, platform, lengths, p, r)
    if outcome != OK:
        return outcome, iterations, math.nan
    condition, sign = condition_one(base, platform, p, r, characteristic_length)
    if not condition <= max_condition:
        return SINGULAR, iterations, condition
    if home_sign != 0.0 and sign != home_sign:
        return OTHER_ASSEMBLY, iterations, condition
    _copy_pose(p, r, position, rotation)
    return OK, iterations, condition


@internal
def _usable(lengths, position, rotation):
    """Return whether lengths and guess are finite and the lengths positive."""
    for i in range(6):
        if not 0.0 < lengths[i] < math.inf:
            return False
    for i in range(3):
        if not math.isfinite(position[i]):
            return False
        for j in range(3):
            if not math.isfinite(rotation[i, j]):
                return False
    return True


@internal
def _copy_pose(position, rotation, to_position, to_rotation):
    """Copy one pose into another."""
    for i in range(3):
        to_position[i] = position[i]
        for j in range(3):
            to_rotation[i, j] = rotation[i, j]


@internal
def _newton(base, platform, lengths, p, r):
    """Iterate (p, r) to closure; return (outcome, iterations)."""
    jacobian = np.empty((6, 6))
    step = np.empty(6)
    for iteration in range(1, MAX_ITERATIONS + 1):
        for i in range(6):
            sx, sy, sz = strut_vector(base, platform, p, r, i)
            step[i] = lengths[i] - _jacobian_row(base, p, i, sx, sy, sz, jacobian)
        if solve_six(jacobian, step) == 0.0:
            return SINGULAR, iteration
        turn = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        if not turn < math.inf:
            return SINGULAR, iteration
        scale = 1.0 if turn <= MAX_ROTATION_STEP else MAX_ROTATION_STEP / turn
        size = turn
        for k in range(3):
            p[k] += scale * step[k]
            size = max(size, abs(step[k]))
        rotate(r, scale * step[3], scale * step[4], scale * step[5])
        if size < STEP_TOLERANCE:
            orthonormalise(r)
            return (OK if _closes(base, platform, lengths, p, r) else NOT_CONVERGED), iteration
    return NOT_CONVERGED, MAX_ITERATIONS


@internal
def _closes(base, platform, lengths, p, r):
    """Return whether the loops close and R is a rotation: a certificate independent of the iteration."""
    rows = three_rows(r)
    _, _, now = struts(six_rows(base), six_rows(platform), (p[0], p[1], p[2]), rows)
    wanted = (lengths[0], lengths[1], lengths[2], lengths[3], lengths[4], lengths[5])
    return closure_error(now, wanted) <= 1.0 and rotation_error(rows) <= ROTATION_ROUNDING


@compiled
def strut_lengths_many(base, platform, positions, rotations, lengths):
    """Batch of :func:`strut_lengths_one`: (N, 3), (N, 3, 3) → (N, 6); eight at once, with the same bits."""
    count = positions.shape[0]
    whole = count - count % LANES
    flat_positions, flat_rotations, flat_lengths = positions.reshape(-1), rotations.reshape(-1), lengths.reshape(-1)
    lanes = np.empty(ROWS * LANES)
    for first in range(0, whole, LANES):
        fill_poses(lanes, first, flat_positions, flat_rotations)
        measure_lanes(base, platform, lanes)
        take_lengths(lanes, first, flat_lengths)
    six_base, six_platform = six_rows(base), six_rows(platform)
    for n in range(whole, count):
        _write_lengths(six_base, six_platform, positions[n], rotations[n], lengths[n])


@compiled
def solve_pose_many(
    base,
    platform,
    lengths,
    positions,
    rotations,
    characteristic_length,
    home_sign,
    max_condition,
    outcomes,
    iterations,
    conditions,
):
    """Batch of :func:`solve_pose_one`; guesses in `positions`, `rotations` are overwritten where it is OK."""
    lanes = np.empty(ROWS * LANES)
    for first in range(0, lengths.shape[0], LANES):
        count = min(LANES, lengths.shape[0] - first)
        for lane in range(count):
            n = first + lane
            fill_lane(lanes, lane, lengths[n], positions[n], rotations[n])
        solve_lanes(base, platform, lanes, count, characteristic_length, home_sign, max_condition)
        for lane in range(count):
            n = first + lane
            if lanes[PASSED * LANES + lane] == 1.0:
                take_lane(lanes, lane, positions[n], rotations[n])
                outcomes[n], iterations[n] = OK, int(lanes[COUNT * LANES + lane])
                conditions[n] = lanes[CONDITION * LANES + lane]
                continue
            outcomes[n], iterations[n], conditions[n] = _solve_carefully(
                base,
                platform,
                lengths[n],
                positions[n],
                rotations[n],
                characteristic_length,
                home_sign,
                max_condition,
            )
