"""Compiled: what keeps a machine from standing in a pose, for many poses."""

from __future__ import annotations

import math

import numpy as np

from ..compiling import compiled
from ..kernels import condition_one, strut_vector
from ..limits import joint_cosines

NOBODY = np.int64(-1)
"""No strut is concerned, or no second one."""

(WITHIN, STROKE_SHORT, STROKE_LONG, BASE_CONE, PLATFORM_CONE, CLEARANCE, CONDITION, ASSEMBLY) = range(8)
"""What limits a pose; the order is the order of the checks."""


@compiled
def examine_poses(base, platform, positions, rotations, arrays, apart, findings, struts):
    """Write what limits each of N platform poses, and which struts; one rotation may serve all poses.

    Parameters
    ----------
    base, platform : ndarray, shape (6, 3)
        Joints, m.
    positions, rotations : ndarray, shape (N, 3), (N or 1, 3, 3)
        ``pose_platform_in_base``, m.
    arrays : tuple of ndarray
        Stroke (6, 2), cone axes (2, 6, 3), cone cosines (2, 6), scalars: the largest condition number, the
        characteristic length, the sign of det J at home, the smallest strut–strut distance.
    apart : ndarray of bool, shape (6, 6)
        Pairs of struts whose distance counts.
    findings : ndarray of int8, shape (N,)
    struts : ndarray of int8, shape (N, 2)
    """
    for n in range(len(positions)):
        rotation = rotations[min(n, len(rotations) - 1)]
        finding, one, other = _examine_pose(base, platform, positions[n], rotation, arrays, apart)
        findings[n], struts[n, 0], struts[n, 1] = finding, one, other


@compiled
def _examine_pose(base, platform, position, rotation, arrays, apart):
    """Return (finding, strut, second strut) of one pose."""
    stroke, cone_axes, cosines, scalars = arrays
    for i in range(6):
        sx, sy, sz = strut_vector(base, platform, position, rotation, i)
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        if not length >= stroke[i, 0]:
            return STROKE_SHORT, i, NOBODY
        if not length <= stroke[i, 1]:
            return STROKE_LONG, i, NOBODY
    for i in range(6):
        at_base, at_platform = joint_cosines(base, platform, position, rotation, cone_axes, i)
        if not at_base >= cosines[0, i]:
            return BASE_CONE, i, NOBODY
        if not at_platform >= cosines[1, i]:
            return PLATFORM_CONE, i, NOBODY
    if scalars[3] > 0.0:
        one, other = _too_close(base, platform, position, rotation, scalars[3], apart)
        if one >= 0:
            return CLEARANCE, one, other
    condition, sign = condition_one(base, platform, position, rotation, scalars[1])
    if not condition <= scalars[0]:
        return CONDITION, NOBODY, NOBODY
    if sign != scalars[2]:
        return ASSEMBLY, NOBODY, NOBODY
    return WITHIN, NOBODY, NOBODY


@compiled
def _too_close(base, platform, position, rotation, clearance, apart):
    """Return the first pair of struts that are closer than allowed, (−1, −1) when none is."""
    ends = np.empty((6, 3))
    for i in range(6):
        sx, sy, sz = strut_vector(base, platform, position, rotation, i)
        ends[i, 0], ends[i, 1], ends[i, 2] = base[i, 0] + sx, base[i, 1] + sy, base[i, 2] + sz
    for i in range(6):
        for j in range(i):
            if apart[i, j] and segment_distance(base[i], ends[i], base[j], ends[j]) < clearance:
                return np.int64(j), np.int64(i)
    return NOBODY, NOBODY


@compiled
def segment_distance(a, b, c, d):
    """Return the smallest distance, m, between the segments from `a` to `b` and from `c` to `d`, each (3,).

    Where the lines come closest inside both segments it is the lines' distance; otherwise an end of one
    segment is one of the two closest points.
    """
    least = min(
        min(_point_distance(a, c, d), _point_distance(b, c, d)),
        min(_point_distance(c, a, b), _point_distance(d, a, b)),
    )
    uu, uv, vv, uw, vw = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        u, v, w = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        uu, uv, vv, uw, vw = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w
    determinant = uu * vv - uv * uv
    if determinant <= 0.0:  # parallel: an end is always among the closest
        return least
    s, t = (uv * vw - vv * uw) / determinant, (uu * vw - uv * uw) / determinant
    if not (0.0 < s < 1.0 and 0.0 < t < 1.0):
        return least
    square = 0.0
    for k in range(3):
        square += (a[k] + s * (b[k] - a[k]) - c[k] - t * (d[k] - c[k])) ** 2
    return min(least, math.sqrt(square))


@compiled
def _point_distance(point, start, end):
    """Return the distance from a point to a segment, m."""
    along, square = 0.0, 0.0
    for k in range(3):
        u = end[k] - start[k]
        along += (point[k] - start[k]) * u
        square += u * u
    share = 0.0 if square == 0.0 else max(0.0, min(1.0, along / square))
    total = 0.0
    for k in range(3):
        total += (point[k] - start[k] - share * (end[k] - start[k])) ** 2
    return math.sqrt(total)
