"""Forward kinematics of a few poses at once: Newton without a branch, compiled to SIMD instructions.

Every quantity of a pose is a scalar or a tuple that the compiler keeps in registers; the loops over lanes at
the end are what it vectorises. The arithmetic is IEEE either way, so that a pose alone in the first lane gets
the same bits as one among others. A lane that fails any test is only marked: :mod:`hexapod_comp.kernels.kinematics`
then solves it with pivoting and finds the reason.

Rotations `r` are passed as three tuples, the rows of R; joints, strut vectors and moments as six.
"""

from __future__ import annotations

import math

from .linalg import add, combine, cross, dot, eliminate, inlined, internal, norm, scale, substitute, subtract

STEP_TOLERANCE = 1e-8
"""Newton stops after a step shorter than this (m, rad): quadratic convergence leaves its square, 1e-16."""

MAX_ITERATIONS = 30
MAX_ROTATION_STEP = 0.6
"""Longest rotation taken in one Newton step, rad: a linearisation means nothing beyond."""

CLOSURE = 1e-13
"""Largest root sum of squares, m, that rounding may leave in the six loop closures …"""

CLOSURE_RELATIVE = 1e-14
"""… and its part relative to the lengths, which counts on machines of several metres."""

ROTATION_ROUNDING = 1e-13
"""Largest deviation from a rotation matrix that passes as rounding."""

COPLANAR = 1e-3
"""Below this volume of three unit strut vectors elimination by blocks loses digits, and pivoting decides."""

LANES = 8
"""Poses solved at once: two AVX2 registers, or one of AVX-512."""

POSITION, ROTATION, LENGTHS, STEP, COUNT, CONDITION, PASSED, ROWS = 0, 3, 12, 18, 19, 20, 21, 22
"""Where each quantity begins in the lanes array; entry (row, lane) stands at row·LANES + lane. The array is
flat so that the compiler knows every distance and needs no overlap checks."""


@inlined
def row_of(rows, i):
    """Return row `i` of an (N, 3) array as a tuple, which the compiler keeps out of memory."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@inlined
def three_rows(rows):
    """Return the first three rows of an (N, 3) array as tuples."""
    return row_of(rows, 0), row_of(rows, 1), row_of(rows, 2)


@inlined
def six_rows(rows):
    """Return the rows of a (6, 3) array as tuples."""
    a, b, c = three_rows(rows)
    return a, b, c, row_of(rows, 3), row_of(rows, 4), row_of(rows, 5)


@inlined
def strut_between(b, t, p, r):
    """Return P + R·t − b: the vector from a base joint to a platform joint in ``base``, m."""
    return (
        p[0] + r[0][0] * t[0] + r[0][1] * t[1] + r[0][2] * t[2] - b[0],
        p[1] + r[1][0] * t[0] + r[1][1] * t[1] + r[1][2] * t[2] - b[1],
        p[2] + r[2][0] * t[0] + r[2][1] * t[1] + r[2][2] * t[2] - b[2],
    )


@inlined
def _strut(b, t, p, r):
    """Return a strut vector s and its moment R·t × s about the platform's origin, both in ``base``."""
    s = strut_between(b, t, p, r)
    return s, cross((dot(r[0], t), dot(r[1], t), dot(r[2], t)), s)


@inlined
def struts(base, platform, p, r):
    """Return six strut vectors, six moments and six lengths."""
    s0, m0 = _strut(base[0], platform[0], p, r)
    s1, m1 = _strut(base[1], platform[1], p, r)
    s2, m2 = _strut(base[2], platform[2], p, r)
    s3, m3 = _strut(base[3], platform[3], p, r)
    s4, m4 = _strut(base[4], platform[4], p, r)
    s5, m5 = _strut(base[5], platform[5], p, r)
    lengths = norm(s0), norm(s1), norm(s2), norm(s3), norm(s4), norm(s5)
    return (s0, s1, s2, s3, s4, s5), (m0, m1, m2, m3, m4, m5), lengths


@inlined
def block_condition(s, m, lengths, characteristic_length):
    """Return (condition number, sign of det J) of the Jacobian; sign 0.0 where pivoting is needed.

    The rows here are L_i times the Jacobian's, so the inverse's columns are its columns divided by L_i.
    """
    square = characteristic_length * characteristic_length
    upper, ratios, lower, determinant_a, determinant_w = eliminate(s, m)
    (x, y, z), (a, b, c) = upper, ratios
    zero = (0.0, 0.0, 0.0)
    l0, l1, l2, l3, l4, l5 = lengths
    inverse = (
        l0 * l0 * _column_square(m, upper, x, combine((a[0], b[0], c[0]), *lower), square)
        + l1 * l1 * _column_square(m, upper, zero, lower[0], square)
        + l2 * l2 * _column_square(m, upper, y, combine((a[1], b[1], c[1]), *lower), square)
        + l3 * l3 * _column_square(m, upper, zero, lower[1], square)
        + l4 * l4 * _column_square(m, upper, z, combine((a[2], b[2], c[2]), *lower), square)
        + l5 * l5 * _column_square(m, upper, zero, lower[2], square)
    )
    moments = (
        dot(m[0], m[0]) / (l0 * l0)
        + dot(m[1], m[1]) / (l1 * l1)
        + dot(m[2], m[2]) / (l2 * l2)
        + dot(m[3], m[3]) / (l3 * l3)
        + dot(m[4], m[4]) / (l4 * l4)
        + dot(m[5], m[5]) / (l5 * l5)
    )
    condition = math.sqrt((6.0 + moments / square) * inverse) / 6.0
    trusted = (abs(determinant_a) >= COPLANAR * l0 * l2 * l4) & (condition < math.inf)
    sign = -1.0 if determinant_a * determinant_w > 0.0 else 1.0
    return condition, sign if trusted else 0.0


@inlined
def _column_square(m, upper, v, omega, square):
    """Return |v + A⁻¹·M_a·ω|² + c²·|ω|²: one column of the inverse, squared, its sign left aside."""
    rest = combine((dot(m[0], omega), dot(m[2], omega), dot(m[4], omega)), upper[0], upper[1], upper[2])
    v = add(v, rest)
    return dot(v, v) + square * dot(omega, omega)


@inlined
def _turned(r, w):
    """Return the rows of C·R, C the Cayley rotation of w: exp(w) to second order, exactly orthogonal."""
    x, y, z = 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]
    square = x * x + y * y + z * z
    two = 2.0 / (1.0 + square)
    one = 0.5 * two * (1.0 - square)
    return (
        combine((one + two * x * x, two * (x * y - z), two * (x * z + y)), r[0], r[1], r[2]),
        combine((two * (x * y + z), one + two * y * y, two * (y * z - x)), r[0], r[1], r[2]),
        combine((two * (x * z - y), two * (y * z + x), one + two * z * z), r[0], r[1], r[2]),
    )


@inlined
def straightened(r):
    """Return the rows of the rotation nearest to nearly orthonormal ones: one Newton step."""
    g01, g02, g12 = dot(r[0], r[1]), dot(r[0], r[2]), dot(r[1], r[2])
    return (
        combine((1.5 - 0.5 * dot(r[0], r[0]), -0.5 * g01, -0.5 * g02), r[0], r[1], r[2]),
        combine((-0.5 * g01, 1.5 - 0.5 * dot(r[1], r[1]), -0.5 * g12), r[0], r[1], r[2]),
        combine((-0.5 * g02, -0.5 * g12, 1.5 - 0.5 * dot(r[2], r[2])), r[0], r[1], r[2]),
    )


@inlined
def _newton_step(base, platform, lengths, p, r):
    """Return (p, R) after one Newton step on the loop closures, and the full step's length (m, rad).

    The rows are multiplied by the struts' lengths, which spares a division and does not change the step.
    """
    s, m, now = struts(base, platform, p, r)
    f = (
        now[0] * (lengths[0] - now[0]),
        now[1] * (lengths[1] - now[1]),
        now[2] * (lengths[2] - now[2]),
        now[3] * (lengths[3] - now[3]),
        now[4] * (lengths[4] - now[4]),
        now[5] * (lengths[5] - now[5]),
    )
    upper, ratios, lower, _, _ = eliminate(s, m)
    v, w = substitute(m, upper, ratios, lower, f)
    ratio = MAX_ROTATION_STEP / norm(w)
    shrink = 1.0 if ratio >= 1.0 else ratio
    return add(p, scale(shrink, v)), _turned(r, scale(shrink, w)), math.sqrt(dot(v, v) + dot(w, w))


@inlined
def closure_error(now, wanted):
    """Return the squared misfit of six lengths in units of what rounding may leave; above 1 is too much."""
    first, second = (now[0], now[1], now[2]), (now[3], now[4], now[5])
    a = subtract(first, (wanted[0], wanted[1], wanted[2]))
    b = subtract(second, (wanted[3], wanted[4], wanted[5]))
    allowed = CLOSURE**2 + CLOSURE_RELATIVE**2 * (dot(first, first) + dot(second, second))
    return (dot(a, a) + dot(b, b)) / allowed


@inlined
def _all_positive(a):
    """Return whether six numbers are above zero."""
    return (a[0] > 0.0) & (a[1] > 0.0) & (a[2] > 0.0) & (a[3] > 0.0) & (a[4] > 0.0) & (a[5] > 0.0)


@inlined
def rotation_error(r):
    """Return how far three rows are from those of a right-handed rotation matrix."""
    hand = subtract(cross(r[0], r[1]), r[2])
    first, second, skew = dot(r[0], r[0]) - 1.0, dot(r[1], r[1]) - 1.0, dot(r[0], r[1])
    return math.sqrt(dot(hand, hand) + first * first + second * second + skew * skew)


@inlined
def _read(lanes, row, lane):
    """Return three consecutive rows of a lane."""
    at = row * LANES + lane
    return lanes[at], lanes[at + LANES], lanes[at + 2 * LANES]


@inlined
def _write(lanes, row, lane, values):
    """Write three consecutive rows of a lane."""
    at = row * LANES + lane
    lanes[at], lanes[at + LANES], lanes[at + 2 * LANES] = values


@inlined
def _read_pose(lanes, lane):
    """Return position, rows of the rotation and the six lengths of a lane."""
    rotation = (
        _read(lanes, ROTATION, lane),
        _read(lanes, ROTATION + 3, lane),
        _read(lanes, ROTATION + 6, lane),
    )
    lengths = _read(lanes, LENGTHS, lane) + _read(lanes, LENGTHS + 3, lane)
    return _read(lanes, POSITION, lane), rotation, lengths


@inlined
def _write_pose(lanes, lane, p, r):
    """Write position and rows of the rotation of a lane."""
    _write(lanes, POSITION, lane, p)
    for k in range(3):
        _write(lanes, ROTATION + 3 * k, lane, r[k])


@internal
def fill_lane(lanes, lane, lengths, position, rotation):
    """Put one problem into a lane."""
    for k in range(3):
        lanes[(POSITION + k) * LANES + lane] = position[k]
        for j in range(3):
            lanes[(ROTATION + 3 * k + j) * LANES + lane] = rotation[k, j]
    for k in range(6):
        lanes[(LENGTHS + k) * LANES + lane] = lengths[k]
    lanes[STEP * LANES + lane] = math.inf
    lanes[COUNT * LANES + lane] = 0.0


@internal
def take_lane(lanes, lane, position, rotation):
    """Copy a lane's pose into the caller's arrays."""
    for k in range(3):
        position[k] = lanes[(POSITION + k) * LANES + lane]
        for j in range(3):
            rotation[k, j] = lanes[(ROTATION + 3 * k + j) * LANES + lane]


@internal
def fill_poses(lanes, first, positions, rotations):
    """Put eight poses of a batch into the lanes, from pose `first` of flat positions and rotations on."""
    for lane in range(LANES):
        at = 3 * (first + lane)
        for k in range(3):
            lanes[(POSITION + k) * LANES + lane] = positions[at + k]
        for k in range(9):
            lanes[(ROTATION + k) * LANES + lane] = rotations[3 * at + k]


@internal
def take_lengths(lanes, first, lengths):
    """Copy the lanes' lengths into a batch's flat ones."""
    for lane in range(LANES):
        for k in range(6):
            lengths[6 * (first + lane) + k] = lanes[(LENGTHS + k) * LANES + lane]


@internal
def measure_lanes(base, platform, lanes):
    """Write the strut lengths at the pose in every lane."""
    base, platform = six_rows(base), six_rows(platform)
    for lane in range(LANES):
        p, r, _ = _read_pose(lanes, lane)
        for half in range(2):
            i = 3 * half
            lengths = (
                norm(strut_between(base[i], platform[i], p, r)),
                norm(strut_between(base[i + 1], platform[i + 1], p, r)),
                norm(strut_between(base[i + 2], platform[i + 2], p, r)),
            )
            _write(lanes, LENGTHS + i, lane, lengths)


@internal
def solve_lanes(base, platform, lanes, count, characteristic_length, home_sign, max_condition):
    """Iterate the first `count` lanes until none moves, then mark those whose answer may be taken."""
    live = True
    while live:
        _step_lanes(base, platform, lanes, count)
        live = False
        for lane in range(count):
            moving = lanes[STEP * LANES + lane] >= STEP_TOLERANCE
            live |= moving and lanes[COUNT * LANES + lane] < MAX_ITERATIONS
    _certify_lanes(base, platform, lanes, count, characteristic_length, home_sign, max_condition)


@internal
def _step_lanes(base, platform, lanes, count):
    """Take one Newton step in every lane that has not settled."""
    base, platform = six_rows(base), six_rows(platform)
    for lane in range(count):
        p, r, lengths = _read_pose(lanes, lane)
        p, r, step = _newton_step(base, platform, lengths, p, r)
        if lanes[STEP * LANES + lane] >= STEP_TOLERANCE:
            _write_pose(lanes, lane, p, r)
            lanes[STEP * LANES + lane] = step
            lanes[COUNT * LANES + lane] += 1.0


@internal
def _certify_lanes(base, platform, lanes, count, characteristic_length, home_sign, max_condition):
    """Straighten each lane's rotation and mark the lane if everything that makes an answer right holds."""
    base, platform = six_rows(base), six_rows(platform)
    for lane in range(count):
        p, r, wanted = _read_pose(lanes, lane)
        r = straightened(r)
        s, m, now = struts(base, platform, p, r)
        condition, sign = block_condition(s, m, now, characteristic_length)
        settled = lanes[STEP * LANES + lane] < STEP_TOLERANCE
        closed = (closure_error(now, wanted) <= 1.0) & _all_positive(wanted)
        rigid = rotation_error(r) <= ROTATION_ROUNDING
        working = (sign * home_sign > 0.0) | ((home_sign == 0.0) & (sign != 0.0))
        passed = settled & closed & rigid & working & (condition <= max_condition)
        _write_pose(lanes, lane, p, r)
        lanes[CONDITION * LANES + lane] = condition
        lanes[PASSED * LANES + lane] = 1.0 if passed else 0.0
