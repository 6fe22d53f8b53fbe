"""Compiled: what keeps a machine from standing in a pose, for many poses."""

from __future__ import annotations

import math

import numpy as np

from ..compiling import compiled
from ..kernels import condition_one, strut_vector
from ..limit_kernels import joint_cosines, nearest_strut, strut_ends

NOBODY = np.int64(-1)
"""No strut is concerned, or no second one."""

(WITHIN, STROKE_SHORT, STROKE_LONG, BASE_CONE, PLATFORM_CONE, CLEARANCE, CONDITION, ASSEMBLY) = range(8)
"""What limits a pose; the order is the order of the checks."""


@compiled
def examine_poses(base, platform, positions, rotations, arrays, findings, struts):
    """Write what limits each of N platform poses, and which struts; one rotation may serve all poses.

    Parameters
    ----------
    base, platform : ndarray, shape (6, 3)
        Joints, m.
    positions, rotations : ndarray, shape (N, 3), (N or 1, 3, 3)
        ``pose_platform_in_base``, m.
    arrays : tuple of ndarray
        :attr:`~hexapod_comp.limits.LimitTable.arrays`.
    findings : ndarray of int8, shape (N,)
    struts : ndarray of int8, shape (N, 2)
    """
    for n in range(len(positions)):
        rotation = rotations[min(n, len(rotations) - 1)]
        finding, one, other = _examine_pose(base, platform, positions[n], rotation, arrays)
        findings[n], struts[n, 0], struts[n, 1] = finding, one, other


@compiled
def _examine_pose(base, platform, position, rotation, arrays):
    """Return (finding, strut, second strut) of one pose."""
    stroke, cone_axes, cosines, apart, scalars = arrays
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
    if scalars[5] > 0.0:
        ends = strut_ends(base, platform, position, rotation)
        for i in range(6):
            distance, other = nearest_strut(base, ends, apart, i, i)
            if not distance >= scalars[5]:
                return CLEARANCE, other, i
    condition, sign = condition_one(base, platform, position, rotation, scalars[3])
    if not condition <= scalars[0]:
        return CONDITION, NOBODY, NOBODY
    if sign != scalars[4]:
        return ASSEMBLY, NOBODY, NOBODY
    return WITHIN, NOBODY, NOBODY
