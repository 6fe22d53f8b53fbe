"""Compiled effects of single errors: where the tool really is when one number of the machine is off.

The machine is told the lengths of its nominal pose, and one strut's length, joint or the tool is not what it
should be. All errors of a pose share the nominal Jacobian's inverse. An unknown pose is written as its
difference to the nominal one, P + d and C(g)·R with C the Cayley rotation of g, and loop closures as their
difference to the nominal ones, so that nothing cancels: effects of nanometres keep all their digits.
"""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .kinematics import OK, solve_pose_one
from .lanes import CLOSURE, row_of, strut_between, three_rows
from .linalg import add, cross, dot, inlined, internal, norm, scale, solve_six

LENGTH, BASE_JOINT, PLATFORM_JOINT, TOOL = range(4)
"""What a single error moves. Defined here, where compiled code takes them in: see :mod:`.compiling`."""

CONTRACTION = 0.25
"""A step that leaves more than this share of the misfit is no small error's: Newton starts again, with pivoting."""

NOTHING = (0.0, 0.0, 0.0)

WIDTH = 8
"""Struts of a pose stand side by side, two of them idle: whole SIMD registers."""

STRUT, ARM, LENGTH_ROW, OWN, MISFIT, ROWS = 0, 3, 6, 7, 8, 9
"""Where each quantity begins in a pose's flat table; entry (row, strut) stands at row·WIDTH + strut."""

TRANSLATION_MAX, TRANSLATION_MIN, ROTATION_MAX, ROTATION_MIN = range(4)
"""Columns of extremes."""


@inlined
def _swung(g, arm):
    """Return C(g)·arm − arm: how far an arm's end goes when it turns by g."""
    h = scale(0.5, g)
    return scale(2.0 / (1.0 + dot(h, h)), cross(h, add(arm, cross(h, arm))))


@inlined
def _growth(s, length, move):
    """Return |s + move| − |s| with all digits, |s| given."""
    twice = 2.0 * dot(s, move) + dot(move, move)
    return twice / (norm(add(s, move)) + length)


@internal
def _nominal(base, platform, position, rotation, characteristic_length, table, inverse):
    """Write a nominal pose's strut vectors, arms R·t, lengths and ∂(v, ω)/∂L; return (condition, sign of det J).

    The condition number is ∞ where the machine is singular.
    """
    rows, factors, column = np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    p, r = row_of(position.reshape(1, 3), 0), three_rows(rotation)
    for i in range(6):
        s, t = strut_between(row_of(base, i), row_of(platform, i), p, r), row_of(platform, i)
        arm, length = (dot(r[0], t), dot(r[1], t), dot(r[2], t)), norm(s)
        moment = cross(arm, s)
        table[LENGTH_ROW * WIDTH + i] = length
        for k in range(3):
            table[(STRUT + k) * WIDTH + i], table[(ARM + k) * WIDTH + i] = s[k], arm[k]
            rows[i, k], rows[i, 3 + k] = s[k] / length, moment[k] / length
    sign, square, inverse_square = 0.0, 0.0, 0.0
    for i in range(6):
        for k in range(6):
            column[k] = 1.0 if k == i else 0.0
            factors[k] = rows[k]
        sign = solve_six(factors, column)
        if sign == 0.0:
            return math.inf, 0.0
        for k in range(6):
            unit = 1.0 if k < 3 else characteristic_length
            inverse[k, i] = column[k]
            square += (rows[i, k] / unit) ** 2
            inverse_square += (column[k] * unit) ** 2
    return math.sqrt(square * inverse_square) / 6.0, sign


@inlined
def _disturbance(part, vector, r, length, home_length):
    """Return what one error does to its strut: (stretch, shift of its vector, change of its arm), in ``base``."""
    if part == LENGTH:
        return vector[0] + vector[1] * (length - home_length) + vector[2] * length, NOTHING, NOTHING
    v = (vector[0], vector[1], vector[2])
    if part == BASE_JOINT:
        return 0.0, scale(-1.0, v), NOTHING
    turned = (dot(r[0], v), dot(r[1], v), dot(r[2], v))
    return 0.0, turned, turned


@inlined
def _three(table, row, strut):
    """Return three consecutive rows of a strut."""
    at = row * WIDTH + strut
    return table[at], table[at + WIDTH], table[at + 2 * WIDTH]


@inlined
def _times(inverse, first, table):
    """Return three components, from row `first`, of the inverse times the six misfits."""
    x, y, z = 0.0, 0.0, 0.0
    for j in range(6):
        misfit = table[MISFIT * WIDTH + j]
        x += inverse[first, j] * misfit
        y += inverse[first + 1, j] * misfit
        z += inverse[first + 2, j] * misfit
    return x, y, z


@inlined
def _column(inverse, first, strut, misfit):
    """Return three components, from row `first`, of the inverse times the misfit of one strut."""
    return inverse[first, strut] * misfit, inverse[first + 1, strut] * misfit, inverse[first + 2, strut] * misfit


@internal
def _misfits(table, d, g, stretch, shift, arm_change):
    """Write what is missing in each loop closure at the pose (d, g)."""
    h = scale(0.5, g)
    factor = 2.0 / (1.0 + dot(h, h))
    for j in range(WIDTH):
        own = table[OWN * WIDTH + j]
        arm = add(_three(table, ARM, j), scale(own, arm_change))
        swing = scale(factor, cross(h, add(arm, cross(h, arm))))
        move = add(add(d, scale(own, shift)), swing)
        growth = _growth(_three(table, STRUT, j), table[LENGTH_ROW * WIDTH + j], move)
        table[MISFIT * WIDTH + j] = own * stretch - growth


@internal
def _closed(table, inverse, strut, disturbance):
    """Solve the disturbed loop closures with the nominal inverse; return (closed, d, g)."""
    stretch, shift, arm_change = disturbance
    for j in range(WIDTH):
        table[OWN * WIDTH + j] = 1.0 if j == strut else 0.0
    first = stretch - _growth(_three(table, STRUT, strut), table[LENGTH_ROW * WIDTH + strut], shift)
    d, g = _column(inverse, 0, strut, first), _column(inverse, 3, strut, first)
    before = abs(first)
    while True:
        _misfits(table, d, g, stretch, shift, arm_change)
        square = 0.0
        for j in range(6):
            square += table[MISFIT * WIDTH + j] * table[MISFIT * WIDTH + j]
        worst = math.sqrt(square)
        if not (worst <= CLOSURE or worst <= CONTRACTION * before):
            return False, d, g
        d, g = add(d, _times(inverse, 0, table)), add(g, _times(inverse, 3, table))
        if worst <= CLOSURE:  # and the step just taken has made it smaller still
            return True, d, g
        before = worst


@internal
def _closed_carefully(base, platform, position, rotation, table, strut, part, vector, stretch, certificate):
    """Solve the disturbed machine from scratch, certified as every forward solution is; return (closed, d, g)."""
    b, t, told = np.empty((6, 3)), np.empty((6, 3)), np.empty(6)
    p, r = np.empty(3), np.empty((3, 3))
    for i in range(6):
        off = 1.0 if i == strut else 0.0
        told[i] = table[LENGTH_ROW * WIDTH + i] + off * stretch
        for k in range(3):
            b[i, k] = base[i, k] + (off * vector[k] if part == BASE_JOINT else 0.0)
            t[i, k] = platform[i, k] + (off * vector[k] if part == PLATFORM_JOINT else 0.0)
    for k in range(3):
        p[k] = position[k]
        for j in range(3):
            r[k, j] = rotation[k, j]
    outcome, _, _ = solve_pose_one(b, t, told, p, r, certificate[0], certificate[1], certificate[2])
    d = (p[0] - position[0], p[1] - position[1], p[2] - position[2])
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = _turn_between(three_rows(rotation), three_rows(r))
    return outcome == OK, d, scale(2.0 / (1.0 + xx + yy + zz), (zy - yz, xz - zx, yx - xy))


@inlined
def _turn_between(before, after):
    """Return the rows of after·beforeᵀ."""
    x, y, z = after
    a, b, c = before
    return (dot(x, a), dot(x, b), dot(x, c)), (dot(y, a), dot(y, b), dot(y, c)), (dot(z, a), dot(z, b), dot(z, c))


@internal
def _write(work, displacement, g, vector):
    """Write a displacement and the rotation vector of C(g), both in ``base``, along the axes of ``work``."""
    size = norm(g)
    ratio = 2.0 * math.atan(0.5 * size) / size if size > 1e-4 else 1.0 - size * size / 12.0
    for k in range(3):
        vector[k] = work[0, k] * displacement[0] + work[1, k] * displacement[1] + work[2, k] * displacement[2]
        vector[3 + k] = ratio * (work[0, k] * g[0] + work[1, k] * g[1] + work[2, k] * g[2])


@internal
def _effects_of_pose(machine, position, rotation, errors, exact, scratch, vectors):
    """Write the effect (displacement, rotation vector) of each error at one pose, NaN where there is none."""
    base, platform, home_lengths, tool, work, certificate = machine
    part, strut, vector = errors
    table, inverse = scratch
    condition, sign = _nominal(base, platform, position, rotation, certificate[0], table, inverse)
    if not (condition <= certificate[2] and (certificate[1] == 0.0 or sign == certificate[1])):
        vectors[:] = math.nan
        return
    r, t = three_rows(rotation), (tool[0], tool[1], tool[2])
    tool_arm = (dot(r[0], t), dot(r[1], t), dot(r[2], t))
    for e in range(len(part)):
        i = strut[e]
        if part[e] == TOOL:
            v = row_of(vector, e)
            _write(work, (dot(r[0], v), dot(r[1], v), dot(r[2], v)), NOTHING, vectors[e])
            continue
        length = table[LENGTH_ROW * WIDTH + i]
        disturbance = _disturbance(part[e], vector[e], r, length, home_lengths[i])
        if not exact:
            first = disturbance[0] - dot(_three(table, STRUT, i), disturbance[1]) / length
            g = _column(inverse, 3, i, first)
            _write(work, add(_column(inverse, 0, i, first), cross(g, tool_arm)), g, vectors[e])
            continue
        closed, d, g = _closed(table, inverse, i, disturbance)
        if not closed:
            closed, d, g = _closed_carefully(
                base, platform, position, rotation, table, i, part[e], vector[e], disturbance[0], certificate
            )
        _write(work, add(d, _swung(g, tool_arm)), g, vectors[e])
        if not closed:
            vectors[e] = math.nan


@internal
def _scratch():
    """Return room for one pose's table, its idle struts of length 1, and for its inverse."""
    table = np.zeros(ROWS * WIDTH)
    table[LENGTH_ROW * WIDTH : OWN * WIDTH] = 1.0
    return table, np.empty((6, 6))


@compiled
def effect_vectors_many(machine, positions, rotations, errors, exact, vectors):
    """Write the effect of each error at each pose.

    Parameters
    ----------
    machine : tuple
        Joints (6, 3) and (6, 3); home lengths (6,); tool in ``platform`` (3,); rotation of ``work`` in ``base``
        (3, 3); characteristic length, sign of det J, largest condition number (3,).
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        Nominal ``pose_platform_in_base``, m.
    errors : tuple
        Part (E,), strut (E,), vector (E, 3), as in :class:`hexapod_comp.workspace.sources.SingleErrors`.
    exact : bool
        Close the loops to rounding; else to first order.
    vectors : ndarray, shape (N, E, 6)
        Displacement of the tool and its rotation vector, actual minus nominal, along the axes of ``work``; m, rad.
    """
    scratch = _scratch()
    for n in range(len(positions)):
        _effects_of_pose(machine, positions[n], rotations[n], errors, exact, scratch, vectors[n])


@inlined
def _sizes(vector):
    """Return (displacement, largest rotation about an axis) of one effect."""
    turn = max(abs(vector[3]), max(abs(vector[4]), abs(vector[5])))
    return math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]), turn


@compiled
def sizes_many(vectors, sizes):
    """Write Euclidean displacement and largest of three rotations, (N, E, 6) → (N, E, 2); NaN stays NaN."""
    for n in range(vectors.shape[0]):
        for e in range(vectors.shape[1]):
            shift, turn = _sizes(vectors[n, e])
            sizes[n, e, 0], sizes[n, e, 1] = shift, turn if shift >= 0.0 else math.nan


@internal
def _keep(kind, column, value, larger, n, e, values, at):
    """Keep a value if it is the largest, or smallest, so far; the first of equals stays."""
    best = values[kind, column]
    if value > best if larger else value < best:
        values[kind, column] = value
        at[kind, column, 0], at[kind, column, 1] = n, e


@compiled
def extremes_many(machine, positions, rotations, errors, exact, kinds, values, at, failed):
    """Write the largest and smallest effect of each error type over all poses.

    As :func:`effect_vectors_many`, but without holding more than a pose.

    Parameters
    ----------
    kinds : ndarray of int, shape (E,)
        Type of each error.
    values : ndarray, shape (K, 4)
        Columns as the constants above; must come as −∞ (maxima) and ∞ (minima).
    at : ndarray of int, shape (K, 4, 2)
        Pose and error of each; left alone where a type has no effect at all.
    failed : ndarray of int, shape (K,)
        How many of a type's effects could not be had.
    """
    scratch, vectors = _scratch(), np.empty((len(kinds), 6))
    for n in range(len(positions)):
        _effects_of_pose(machine, positions[n], rotations[n], errors, exact, scratch, vectors)
        for e in range(len(kinds)):
            shift, turn = _sizes(vectors[e])
            if not shift < math.inf:
                failed[kinds[e]] += 1
                continue
            _keep(kinds[e], TRANSLATION_MAX, shift, True, n, e, values, at)
            _keep(kinds[e], TRANSLATION_MIN, shift, False, n, e, values, at)
            _keep(kinds[e], ROTATION_MAX, turn, True, n, e, values, at)
            _keep(kinds[e], ROTATION_MIN, turn, False, n, e, values, at)
