"""Compiled: what keeps a machine from standing in a pose, or from going there in one step."""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled
from .kernels import condition_one, strut_vector

WITHIN, NOT_FINITE, STROKE, BASE_CONE, PLATFORM_CONE, CLEARANCE, CONDITION, ASSEMBLY, CORRECTION, STEP = range(10)
"""What a check found; the order is the order of the checks."""


@compiled
def joint_cosines(base, platform, position, rotation, cone_axes, i):
    """Return the cosines of strut `i`'s angles to the neutral directions of its base and platform joints."""
    sx, sy, sz = strut_vector(base, platform, position, rotation, i)
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    at_base = (sx * cone_axes[0, i, 0] + sy * cone_axes[0, i, 1] + sz * cone_axes[0, i, 2]) / length
    at_platform = 0.0
    for k in range(3):
        along = rotation[0, k] * sx + rotation[1, k] * sy + rotation[2, k] * sz
        at_platform += along * cone_axes[1, i, k]
    return at_base, at_platform / length


@compiled
def strut_ends(base, platform, position, rotation):
    """Return the platform joints in ``base``, shape (6, 3), m."""
    ends = np.empty((6, 3))
    for i in range(6):
        sx, sy, sz = strut_vector(base, platform, position, rotation, i)
        ends[i, 0], ends[i, 1], ends[i, 2] = base[i, 0] + sx, base[i, 1] + sy, base[i, 2] + sz
    return ends


@compiled
def nearest_strut(base, ends, apart, i, count):
    """Return distance, m, and index of the strut among the first `count` that is nearest to strut `i`.

    Only struts that are `apart` from it count; ∞ and −1 when there is none.
    """
    least, nearest = math.inf, -1
    for j in range(count):
        if j != i and apart[i, j] > 0.0:
            distance = segment_distance(base[i], ends[i], base[j], ends[j])
            if not distance >= least:
                least, nearest = distance, j
    return least, nearest


@compiled
def segment_distance(a, b, c, d):
    """Return the smallest distance, m, between the segments from `a` to `b` and from `c` to `d`, each (3,).

    Of the closest points a + s·u and c + t·v, s is that of the lines, held within its segment, t belongs to it;
    where t leaves its segment, it is held there, and s belongs to it.
    """
    uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        u, v, w = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
    determinant = uu * vv - uv * uv
    s = _share(uv * vw - vv * uw, determinant)  # parallel lines: any s is as good
    t = _share(uv * s + vw, vv)
    s = _share(uv * t - uw, uu)
    square = 0.0
    for k in range(3):
        square += (a[k] + s * (b[k] - a[k]) - c[k] - t * (d[k] - c[k])) ** 2
    return math.sqrt(square)


@compiled
def _share(part, whole):
    """Return the quotient, held within 0…1; 0 where there is nothing to divide by."""
    return max(0.0, min(1.0, part / whole)) if whole > 0.0 else 0.0


@compiled
def check_joints(base, platform, position, rotation, limits):
    """Check joint cones and strut clearance; return (finding, strut, value, second strut or −1)."""
    _, cone_axes, cone_cosines, apart, scalars = limits
    for i in range(6):
        at_base, at_platform = joint_cosines(base, platform, position, rotation, cone_axes, i)
        if not at_base >= cone_cosines[0, i]:
            return BASE_CONE, i, math.acos(max(-1.0, min(1.0, at_base))), -1
        if not at_platform >= cone_cosines[1, i]:
            return PLATFORM_CONE, i, math.acos(max(-1.0, min(1.0, at_platform))), -1
    if scalars[5] > 0.0:
        ends = strut_ends(base, platform, position, rotation)
        for i in range(6):
            distance, other = nearest_strut(base, ends, apart, i, i)
            if not distance >= scalars[5]:
                return CLEARANCE, other, distance, i
    return WITHIN, -1, 0.0, -1


@compiled
def check_stage(base, platform, position, rotation, lengths, limits):
    """Check lengths and pose of one stage; return (finding, strut, value, condition number).

    `limits` is :attr:`~hexapod_comp.limits.LimitTable.arrays`.
    """
    stroke, scalars = limits[0], limits[4]
    for i in range(6):
        if not math.isfinite(lengths[i]):
            return NOT_FINITE, i, lengths[i], math.nan
        if lengths[i] < stroke[i, 0] or lengths[i] > stroke[i, 1]:
            return STROKE, i, lengths[i], math.nan
    finding, strut, value, _ = check_joints(base, platform, position, rotation, limits)
    if finding != WITHIN:
        return finding, strut, value, math.nan
    condition, sign = condition_one(base, platform, position, rotation, scalars[3])
    if not condition <= scalars[0]:
        return CONDITION, -1, condition, condition
    if sign != scalars[4]:
        return ASSEMBLY, -1, sign, condition
    return WITHIN, -1, 0.0, condition


@compiled
def check_change(lengths, previous, largest, finding):
    """Check six values against the previous six; return (finding or WITHIN, strut, change)."""
    for i in range(6):
        change = lengths[i] - previous[i]
        if abs(change) > largest:  # a NaN in `previous` means that there is none
            return finding, i, change
    return WITHIN, -1, 0.0
