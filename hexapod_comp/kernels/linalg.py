"""Compiled linear algebra for the kernels: 3-vectors as tuples, 6×6 systems of strut rows.

Two solvers, because no single one is both fast and safe. Elimination by 3×3 blocks (:func:`eliminate`,
:func:`substitute`) has no branch and no memory traffic, so the compiler keeps it in vector registers; it
needs struts 1, 3, 5 not to be coplanar directions. Elimination with pivoting (:func:`solve_six`,
:func:`frobenius_condition`) needs nothing, and takes over where the first one is not to be trusted.
"""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled, numba

internal = numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Decorator of what only kernels call: it is cached within them, and has no entry from Python."""

inlined = numba.njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True)
"""… and of small parts that must become part of their caller, or its loop cannot become SIMD."""

SMALLEST_PIVOT = 1e-14
"""A pivot not above this, in a matrix of unit vectors and moments, is rounding: the matrix is singular."""


@inlined
def dot(a, b):
    """Return a·b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def norm(a):
    """Return |a|."""
    return math.sqrt(dot(a, a))


@inlined
def cross(a, b):
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def add(a, b):
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def subtract(a, b):
    """Return a − b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def scale(factor, a):
    """Return factor·a."""
    return factor * a[0], factor * a[1], factor * a[2]


@inlined
def combine(k, a, b, c):
    """Return k₀·a + k₁·b + k₂·c: the row k times the matrix whose rows are a, b, c."""
    return (
        k[0] * a[0] + k[1] * b[0] + k[2] * c[0],
        k[0] * a[1] + k[1] * b[1] + k[2] * c[1],
        k[0] * a[2] + k[1] * b[2] + k[2] * c[2],
    )


@inlined
def inverse_columns(a, b, c):
    """Return the columns of the inverse of the matrix with rows a, b, c, and its determinant."""
    first = cross(b, c)
    determinant = dot(a, first)
    factor = 1.0 / determinant
    return scale(factor, first), scale(factor, cross(c, a)), scale(factor, cross(a, b)), determinant


@inlined
def eliminate(s, m):
    """Factorise the 6×6 matrix with rows (s_i, m_i) by 3×3 blocks.

    Rows 0, 2, 4 give v = A⁻¹·(f_a − M_a·ω); what is left of rows 1, 3, 5 is a 3×3 system in ω.

    Parameters
    ----------
    s, m : tuple of six 3-tuples
        Translation and rotation part of each row.

    Returns
    -------
    upper : tuple of three 3-tuples
        Columns of A⁻¹.
    ratios : tuple of three 3-tuples
        Rows 1, 3, 5 of S·A⁻¹.
    lower : tuple of three 3-tuples
        Columns of the inverse of the reduced 3×3 matrix.
    determinant_a, determinant_w : float
        Of the two blocks; their product's sign is det's, reversed (the row order 0 2 4 1 3 5 is odd).
    """
    x, y, z, determinant_a = inverse_columns(s[0], s[2], s[4])
    k1 = (dot(s[1], x), dot(s[1], y), dot(s[1], z))
    k3 = (dot(s[3], x), dot(s[3], y), dot(s[3], z))
    k5 = (dot(s[5], x), dot(s[5], y), dot(s[5], z))
    u, v, w, determinant_w = inverse_columns(
        subtract(m[1], combine(k1, m[0], m[2], m[4])),
        subtract(m[3], combine(k3, m[0], m[2], m[4])),
        subtract(m[5], combine(k5, m[0], m[2], m[4])),
    )
    return (x, y, z), (k1, k3, k5), (u, v, w), determinant_a, determinant_w


@inlined
def substitute(m, upper, ratios, lower, f):
    """Solve with the factors of :func:`eliminate`: return (v, ω) with s_i·v + m_i·ω = f_i."""
    even = (f[0], f[2], f[4])
    reduced = subtract((f[1], f[3], f[5]), (dot(ratios[0], even), dot(ratios[1], even), dot(ratios[2], even)))
    omega = combine(reduced, lower[0], lower[1], lower[2])
    rest = subtract(even, (dot(m[0], omega), dot(m[2], omega), dot(m[4], omega)))
    return combine(rest, upper[0], upper[1], upper[2]), omega


@compiled
def solve_six(matrix, right):
    """Solve a 6×6 system in place by elimination with partial pivoting.

    Returns
    -------
    float
        Sign of the determinant, 0.0 when a pivot vanishes or is not finite; `right` then holds no solution.
    """
    sign = 1.0
    for k in range(6):
        pivot = k
        for i in range(k + 1, 6):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        value = matrix[pivot, k]
        if not abs(value) > SMALLEST_PIVOT:
            return 0.0
        if pivot != k:
            sign = -sign
            for j in range(k, 6):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            right[k], right[pivot] = right[pivot], right[k]
        if value < 0.0:
            sign = -sign
        inverse = 1.0 / value
        for i in range(k + 1, 6):
            factor = matrix[i, k] * inverse
            for j in range(k + 1, 6):
                matrix[i, j] -= factor * matrix[k, j]
            right[i] -= factor * right[k]
    for k in range(5, -1, -1):
        total = right[k]
        for j in range(k + 1, 6):
            total -= matrix[k, j] * right[j]
        right[k] = total / matrix[k, k]
    return sign


@compiled
def frobenius_condition(matrix):
    """Return (‖A‖·‖A⁻¹‖/6, sign of det A) of a 6×6 matrix; (∞, 0.0) when it is singular or not finite."""
    factors, column = np.empty((6, 6)), np.empty(6)
    square, inverse_square, sign = 0.0, 0.0, 0.0
    for k in range(6):
        for i in range(6):
            column[i] = 1.0 if i == k else 0.0
            square += matrix[i, k] * matrix[i, k]
            for j in range(6):
                factors[i, j] = matrix[i, j]
        sign = solve_six(factors, column)
        for i in range(6):
            inverse_square += column[i] * column[i]
    if sign == 0.0 or not square * inverse_square < math.inf:
        return math.inf, 0.0
    return math.sqrt(square * inverse_square) / 6.0, sign
