"""Warnings about geometry files: a body that looks mirrored or turned, swapped joints, a length in a wrong unit."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..core import batch

if TYPE_CHECKING:
    from .geometry import HexapodGeometry

COINCIDENT = 1e-6  # Distance of the bodies' centres, m, below which no axis from base to platform is defined
# Joints look swapped if, seen along the axis, another order of joints reduces the sum of squared strut lengths by 1 %
LEAST_GAIN = 0.01
MOST_TURN = np.radians(45.0)  # Rotation of the platform against the base at home above which a warning is printed, rad
# Lengths that may all have been read in a wrong unit
LENGTHS = ("base.joints", "platform.joints", "home.position", "limits.stroke")
SUSPECTS = (LENGTHS[:2], *((key,) for key in LENGTHS))
# The factor from values read in a wrong unit to the correct values, and the correct unit
UNIT_MIXUPS = {25.4: "in inches", 1.0 / 25.4: "in mm, not inches", 10.0: "in cm", 1e3: "in m", 1e-3: "in mm, not m"}
USUAL_RADII = (0.01, 5.0)  # Usual radii of base and platform, m; a radius outside suggests a wrong unit


def doubts(geometry: HexapodGeometry) -> tuple[str, ...]:
    platform = geometry.home.transform(geometry.platform_joints)
    remarks = [*joint_doubts(geometry.base_joints, platform)]
    axis = platform.mean(axis=0) - geometry.base_joints.mean(axis=0)
    tool = geometry.home.rotation @ geometry.tool.position
    if tool @ axis < -0.5 * np.linalg.norm(tool) * np.linalg.norm(axis):
        remarks.append(
            "at home the tool points from the platform to the base: has home's z or the tool's z the wrong sign? With "
            "a flat base and a flat platform, home and its mirror image have the same strut lengths"
        )
    given = geometry.base_axes is not None or geometry.platform_axes is not None
    if given and not geometry.screw_lead.any():
        remarks.append("without screw.lead, joint_axes affect only the bearing friction of a model (friction_N_m)")
    return tuple(remarks)


def joint_doubts(base: np.ndarray, platform: np.ndarray) -> Iterator[str]:
    """Yield warnings about an unusual radius or order of the joints, (6, 3) each, m in ``base`` at home."""
    for name, joints in (("base", base), ("platform", platform)):
        if not _usual(joints):
            yield f"{name}.joints lie within {_radius(joints) * 1e3:g} mm of their centre: is their unit right?"
    axis = platform.mean(axis=0) - base.mean(axis=0)
    far = float(np.linalg.norm(axis))
    if far > COINCIDENT:
        yield from _order(_seen_along(axis / far, base), _seen_along(axis / far, platform))


def _radius(joints: np.ndarray) -> float:
    return float(np.linalg.norm(joints - joints.mean(axis=0), axis=1).max())


def _usual(joints: np.ndarray) -> bool:
    return USUAL_RADII[0] <= _radius(joints) <= USUAL_RADII[1]


def unit_doubts(geometry: HexapodGeometry) -> Iterator[str]:
    """Yield a warning if home would keep the limits of stroke and condition with some lengths in another unit."""
    fitting = []
    for wrong, (factor, unit) in product(SUSPECTS, UNIT_MIXUPS.items()):
        of_base, of_platform, of_home, of_stroke = (factor if key in wrong else 1.0 for key in LENGTHS)
        base, platform = geometry.base_joints * of_base, geometry.platform_joints * of_platform
        rows = geometry.home.position[None] * of_home, geometry.home.rotation[None]
        lengths, conditions = np.empty((1, 6)), (np.empty(1), np.empty(1))
        batch.strut_lengths(base, platform, *rows, lengths)
        batch.conditions(base, platform, *rows, of_platform * geometry.characteristic_length, *conditions)
        low, high = geometry.limits.stroke.T * of_stroke
        kept = (lengths >= low).all() and (lengths <= high).all() and conditions[0][0] <= geometry.limits.condition
        if kept and _usual(base) and _usual(platform):
            fitting.append(f"{' and '.join(wrong)} {unit}")
    if fitting:
        yield f"is a unit wrong? With {', or '.join(fitting)}, home would keep the limits of stroke and condition"


def _seen_along(axis: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return the joints as seen along an axis from their centroid: complex numbers x + iy, (6,), m."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    around = joints - joints.mean(axis=0)
    return np.asarray(around @ first + 1j * (around @ np.cross(axis, first)))


def _order(base: np.ndarray, platform: np.ndarray) -> Iterator[str]:
    """Yield a warning if the joints of base and platform, given as complex numbers, go round in different orders."""
    cost = np.abs(base[:, None] - platform) ** 2
    rows, order = linear_sum_assignment(cost)
    now = float(np.trace(cost))
    gains = now - cost[rows, order].sum() > LEAST_GAIN * now
    moved = [i + 1 for i in range(6) if cost[i, order[i]] != cost[i, i]]
    turn, mirrored = np.vdot(base, platform), base @ platform  # best rotation, and best reflection
    if gains and len(moved) == 2:
        yield "joints {}, {} of the platform, or of the base, look swapped: the struts cross".format(*moved)
    elif abs(mirrored) > abs(turn):
        yield (
            "platform joints 1…6 go round in the opposite sense to base joints 1…6: is home turned over (by 180° "
            "about x or y), or is one body's y axis reversed?"
        )
    elif abs(np.angle(turn)) > MOST_TURN:
        yield (
            f"at home the platform is turned by {np.degrees(np.angle(turn)):.0f}° against the base, about the axis "
            "from base to platform: is home's gamma right, and is joint 1 of both bodies a joint of the same strut?"
        )
    elif gains:
        yield f"joints {', '.join(map(str, moved))} of the platform, or of the base, look swapped: the struts cross"


def largest_screw_turn(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> float:
    """Return the most revolutions by which cardan joints turn a screw between home and any of N platform poses."""
    neutral = np.asarray(geometry.base_cone_axes)
    across = np.cross(neutral, np.eye(3)[np.abs(neutral).argmin(axis=1)])
    machine = (*geometry.kernel_joints, across, across @ geometry.home.rotation)
    twists = batch.screw_twists(*machine, np.ascontiguousarray(positions), np.ascontiguousarray(rotations))
    return float(np.abs(twists).max() / (2.0 * np.pi))
