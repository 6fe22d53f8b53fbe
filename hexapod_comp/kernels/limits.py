"""Compiled: what keeps a machine from standing in a pose, or from going there in one step.

There are two ways to ask. :func:`examine` measures every limited quantity of a pose: for checks before a move and
for cold starts, which name all that is wrong. :func:`check_stage` measures the same and stops at the first limit
that is broken: for the compensator, whose commands must not wait, and for millions of poses. A test holds the two
together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .compiling import compiled
from .kinematics import condition_one, strut_lengths_one, strut_vector

(
    WITHIN,
    STROKE_SHORT,
    STROKE_LONG,
    BASE_CONE,
    PLATFORM_CONE,
    CLEARANCE,
    CONDITION,
    ASSEMBLY,
    NOT_FINITE,
    CORRECTION,
    STEP,
    SPEED,
    EARLY,
    ACCELERATION,
) = range(14)
"""What a check found."""


class LimitNumbers(NamedTuple):
    """Every limit of a machine, and what its quantities are measured against; SI units.

    Attributes
    ----------
    stroke : ndarray, shape (6, 2)
        Shortest and longest strut length, m.
    cone_axes : ndarray, shape (2, 6, 3)
        Neutral directions of the joints, at the base and at the platform, each in its body's frame.
    cone_cosines : ndarray, shape (2, 6)
        Cosines of the largest angles to them.
    apart : ndarray, shape (6, 6)
        1 for pairs of struts whose distance counts, 0 for those that share a joint.
    condition, correction, step, clearance : float
        Largest condition number; largest correction and change of length, m; smallest distance of two struts, m,
        0 when it is not limited.
    characteristic_length : float
        See :func:`~hexapod_comp.kernels.kinematics.condition_one`, m.
    home_sign : float
        Sign of det J in the working assembly mode.
    speed, acceleration : float
        Largest speed and acceleration of a strut, m/s, m/s²; the acceleration 0 when it is not limited.
    """

    stroke: np.ndarray
    cone_axes: np.ndarray
    cone_cosines: np.ndarray
    apart: np.ndarray
    condition: float
    correction: float
    step: float
    clearance: float
    characteristic_length: float
    home_sign: float
    speed: float
    acceleration: float


@compiled
def limits_of(numbers):
    """Return the limits that stand one after the other in a vector, (104,); its parts, not copies."""
    return LimitNumbers(
        stroke=numbers[:12].reshape((6, 2)),
        cone_axes=numbers[12:48].reshape((2, 6, 3)),
        cone_cosines=numbers[48:60].reshape((2, 6)),
        apart=numbers[60:96].reshape((6, 6)),
        condition=numbers[96],
        correction=numbers[97],
        step=numbers[98],
        clearance=numbers[99],
        characteristic_length=numbers[100],
        home_sign=numbers[101],
        speed=numbers[102],
        acceleration=numbers[103],
    )


class Quantities(NamedTuple):
    """The limited quantities of N poses in S stages.

    Attributes
    ----------
    lengths : ndarray, shape (N, S, 6)
        Of the struts, m.
    cosines : ndarray, shape (N, S, 2, 6)
        Of the struts' angles to the neutral directions of their joints, at the base and at the platform.
    distances, nearest : ndarray, shape (N, S, 6)
        From each strut to the nearest other one that counts, m, and its index; ∞ and −1 where there is none, or
        the machine does not limit the distance.
    condition, sign : ndarray, shape (N, S)
        Condition number, and sign of det J.
    """

    lengths: np.ndarray
    cosines: np.ndarray
    distances: np.ndarray
    nearest: np.ndarray
    condition: np.ndarray
    sign: np.ndarray

    @staticmethod
    def empty(poses: int, stages: int = 1) -> Quantities:
        """Return quantities that nothing has been written to."""
        shape = poses, stages
        sixes = np.empty((*shape, 6)), np.empty((*shape, 2, 6)), np.empty((*shape, 6)), np.empty((*shape, 6))
        return Quantities(*sixes, np.empty(shape), np.empty(shape))


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
def nearest_strut(base, ends, apart, i):
    """Return distance, m, and index of the strut before strut `i` that is nearest to it; ∞ and −1 for none.

    Only struts that are `apart` from it count.
    """
    least, nearest = math.inf, -1
    for j in range(i):
        if apart[i, j] > 0.0:
            distance = segment_distance(base[i], ends[i], base[j], ends[j])
            if distance < least or distance != distance:
                least, nearest = distance, j
    return least, nearest


@compiled
def nearest_struts(base, ends, apart, distances, nearest):
    """Write for each strut what :func:`nearest_strut` returns, of all struts; `distances` begin at ∞."""
    for i in range(6):
        for j in range(i):
            if apart[i, j] > 0.0:
                distance = segment_distance(base[i], ends[i], base[j], ends[j])
                for one, other in ((i, j), (j, i)):
                    if distance < distances[one] or distance != distance:
                        distances[one], nearest[one] = distance, other


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
def examine(base, platform, position, rotation, limits, quantities, n, stage):
    """Write all quantities of one pose into `quantities` at `n` and `stage`, beside its lengths, which are there."""
    for i in range(6):
        at_base, at_platform = joint_cosines(base, platform, position, rotation, limits.cone_axes, i)
        quantities.cosines[n, stage, 0, i], quantities.cosines[n, stage, 1, i] = at_base, at_platform
        quantities.distances[n, stage, i], quantities.nearest[n, stage, i] = math.inf, -1.0
    if limits.clearance > 0.0:
        ends = strut_ends(base, platform, position, rotation)
        nearest_struts(base, ends, limits.apart, quantities.distances[n, stage], quantities.nearest[n, stage])
    condition, sign = condition_one(base, platform, position, rotation, limits.characteristic_length)
    quantities.condition[n, stage], quantities.sign[n, stage] = condition, sign


@compiled
def check_joints(base, platform, position, rotation, limits):
    """Check joint cones and strut clearance; return (finding, strut, value, second strut or −1)."""
    for i in range(6):
        at_base, at_platform = joint_cosines(base, platform, position, rotation, limits.cone_axes, i)
        if not at_base >= limits.cone_cosines[0, i]:
            return BASE_CONE, i, math.acos(max(-1.0, min(1.0, at_base))), -1
        if not at_platform >= limits.cone_cosines[1, i]:
            return PLATFORM_CONE, i, math.acos(max(-1.0, min(1.0, at_platform))), -1
    if limits.clearance > 0.0:
        ends = strut_ends(base, platform, position, rotation)
        for i in range(6):
            distance, other = nearest_strut(base, ends, limits.apart, i)
            if not distance >= limits.clearance:
                return CLEARANCE, other, distance, i
    return WITHIN, -1, 0.0, -1


@compiled
def check_stage(base, platform, position, rotation, lengths, limits):
    """Check lengths and pose of one stage; return (finding, strut, value, second strut or −1, condition number)."""
    for i in range(6):
        if not math.isfinite(lengths[i]):
            return NOT_FINITE, i, lengths[i], -1, math.nan
        if lengths[i] < limits.stroke[i, 0]:
            return STROKE_SHORT, i, lengths[i], -1, math.nan
        if lengths[i] > limits.stroke[i, 1]:
            return STROKE_LONG, i, lengths[i], -1, math.nan
    finding, strut, value, other = check_joints(base, platform, position, rotation, limits)
    if finding != WITHIN:
        return finding, strut, value, other, math.nan
    condition, sign = condition_one(base, platform, position, rotation, limits.characteristic_length)
    if not condition <= limits.condition:
        return CONDITION, -1, condition, -1, condition
    if sign != limits.home_sign:
        return ASSEMBLY, -1, sign, -1, condition
    return WITHIN, -1, 0.0, -1, condition


@compiled
def check_poses(base, platform, positions, rotations, limits, findings, struts):
    """Write what limits each of N platform poses, and which struts; one rotation may serve all poses.

    Parameters
    ----------
    base, platform : ndarray, shape (6, 3)
        Joints, m.
    positions, rotations : ndarray, shape (N, 3), (N or 1, 3, 3)
        ``pose_platform_in_base``, m.
    limits : LimitNumbers
    findings : ndarray of int8, shape (N,)
    struts : ndarray of int8, shape (N, 2)
    """
    lengths = np.empty(6)
    for n in range(len(positions)):
        rotation = rotations[min(n, len(rotations) - 1)]
        strut_lengths_one(base, platform, positions[n], rotation, lengths)
        finding, one, _, other, _ = check_stage(base, platform, positions[n], rotation, lengths, limits)
        findings[n], struts[n, 0], struts[n, 1] = finding, one, other


@compiled
def check_change(lengths, previous, largest, finding):
    """Check six values against the previous six; return (finding or WITHIN, strut, change)."""
    for i in range(6):
        change = lengths[i] - previous[i]
        if abs(change) > largest:  # a NaN in `previous` means that there is none
            return finding, i, change
    return WITHIN, -1, 0.0
