"""Compiled: what keeps a machine from standing in a pose, for many poses."""

from __future__ import annotations

import math

import numpy as np

from ..compiling import compiled
from ..kernels import condition_one, strut_vector
from ..limit_kernels import ASSEMBLY, CONDITION, WITHIN, check_joints

NOBODY = np.int64(-1)
"""No strut is concerned, or no second one."""

STROKE_SHORT, STROKE_LONG = 1, 2
"""Instead of :data:`~hexapod_comp.limit_kernels.STROKE`; the other findings are those of that module."""


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
    stroke, scalars = arrays[0], arrays[4]
    for i in range(6):
        sx, sy, sz = strut_vector(base, platform, position, rotation, i)
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        if not length >= stroke[i, 0]:
            return STROKE_SHORT, i, NOBODY
        if not length <= stroke[i, 1]:
            return STROKE_LONG, i, NOBODY
    finding, strut, _, other = check_joints(base, platform, position, rotation, arrays)
    if finding != WITHIN:
        return finding, strut, other
    condition, sign = condition_one(base, platform, position, rotation, scalars[3])
    if not condition <= scalars[0]:
        return CONDITION, NOBODY, NOBODY
    if sign != scalars[4]:
        return ASSEMBLY, NOBODY, NOBODY
    return WITHIN, NOBODY, NOBODY
