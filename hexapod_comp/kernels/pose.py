"""Compiled: rotations and quaternions."""

from __future__ import annotations

import math

import numpy as np

from .compiling import compiled

QUATERNION_NORM_TOLERANCE = 1e-3
"""A quaternion whose norm is further from 1 than this is refused: it was never a rotation."""


POSE_OK, POSE_NOT_FINITE, POSE_NOT_UNIT = range(3)
"""Outcomes of :func:`read_pose`."""


@compiled
def rotation_flaw(r):
    """Return the largest element of |RᵀR − 1|, infinite for a left-handed matrix, NaN for one with NaN in it."""
    flaw = 0.0
    for i in range(3):
        for j in range(i + 1):
            dot = r[0, i] * r[0, j] + r[1, i] * r[1, j] + r[2, i] * r[2, j]
            part = abs(dot - (1.0 if i == j else 0.0))
            if not part <= flaw:
                flaw = part
    x = r[1, 0] * r[2, 1] - r[2, 0] * r[1, 1]
    y = r[2, 0] * r[0, 1] - r[0, 0] * r[2, 1]
    z = r[0, 0] * r[1, 1] - r[1, 0] * r[0, 1]
    if x * r[0, 2] + y * r[1, 2] + z * r[2, 2] < 0.0:
        return math.inf
    return flaw


@compiled
def read_pose(x, y, z, qx, qy, qz, qw, position, rotation):
    """Write position and rotation matrix of a position and a quaternion; return the outcome."""
    square = qx * qx + qy * qy + qz * qz + qw * qw
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z) and math.isfinite(square)):
        return POSE_NOT_FINITE
    if abs(math.sqrt(square) - 1.0) > QUATERNION_NORM_TOLERANCE:
        return POSE_NOT_UNIT
    s = 2.0 / square
    position[0], position[1], position[2] = x, y, z
    rotation[0, 0] = 1.0 - s * (qy * qy + qz * qz)
    rotation[0, 1] = s * (qx * qy - qz * qw)
    rotation[0, 2] = s * (qx * qz + qy * qw)
    rotation[1, 0] = s * (qx * qy + qz * qw)
    rotation[1, 1] = 1.0 - s * (qx * qx + qz * qz)
    rotation[1, 2] = s * (qy * qz - qx * qw)
    rotation[2, 0] = s * (qx * qz - qy * qw)
    rotation[2, 1] = s * (qy * qz + qx * qw)
    rotation[2, 2] = 1.0 - s * (qx * qx + qy * qy)
    return POSE_OK


@compiled
def quaternion_of(rotation):
    """Return the unit quaternion (x, y, z, w) of a rotation matrix, from its largest component."""
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    best, largest = 3, trace
    for i in range(3):
        if rotation[i, i] > largest:
            best, largest = i, rotation[i, i]
    if best == 3:
        root = 2.0 * math.sqrt(1.0 + trace)
        return (
            (rotation[2, 1] - rotation[1, 2]) / root,
            (rotation[0, 2] - rotation[2, 0]) / root,
            (rotation[1, 0] - rotation[0, 1]) / root,
            0.25 * root,
        )
    i, j, k = best, (best + 1) % 3, (best + 2) % 3
    root = 2.0 * math.sqrt(1.0 + rotation[i, i] - rotation[j, j] - rotation[k, k])
    values = np.empty(3)
    values[i] = 0.25 * root
    values[j] = (rotation[j, i] + rotation[i, j]) / root
    values[k] = (rotation[k, i] + rotation[i, k]) / root
    return values[0], values[1], values[2], (rotation[k, j] - rotation[j, k]) / root
