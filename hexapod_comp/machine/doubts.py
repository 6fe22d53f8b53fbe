"""Suspicious entries in a geometry file that are not forbidden: mirrored, turned, swapped, in a wrong unit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..core.batch import screw_twists

if TYPE_CHECKING:
    from .geometry import HexapodGeometry

COINCIDENT = 1e-6  # Bodies whose centres are nearer than this, m, have no definite direction to each other
# Share of the struts' squared lengths, seen along the machine's axis, that another order of joints must save
LEAST_GAIN = 0.01
MOST_TURN = np.radians(45.0)  # Turn of the platform against the base at home beyond which a question is printed, rad
USUAL_RADII = (0.01, 5.0)  # Of base and platform, m: outside, a unit may be wrong


def doubts(geometry: HexapodGeometry) -> tuple[str, ...]:
    """Return suspicious entries, a sentence each, in the terms of geometry files."""
    platform = geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T
    remarks = [*joint_doubts(geometry.base_joints, platform)]
    axis = platform.mean(axis=0) - geometry.base_joints.mean(axis=0)
    tool = geometry.home.rotation @ geometry.tool.position
    if tool @ axis < -0.5 * np.linalg.norm(tool) * np.linalg.norm(axis):
        remarks.append(
            "at home the tool points from the platform to the base: is home mirrored (the sign of its z), or the tool? "
            "Both homes have the same strut lengths where base and platform are flat"
        )
    given = geometry.base_axes is not None or geometry.platform_axes is not None
    if given and not geometry.screw_lead.any():
        remarks.append("joint_axes have no effect without screw.lead")
    return tuple(remarks)


def joint_doubts(base: np.ndarray, platform: np.ndarray) -> Iterator[str]:
    """Yield warnings about joint coordinates that look wrong: unusual radius (a wrong unit?) or order of the joints.

    `base` and `platform` are the joints in ``base`` with the platform at home, shape (6, 3), m.
    """
    for name, joints in (("base", base), ("platform", platform)):
        radius = float(np.linalg.norm(joints - joints.mean(axis=0), axis=1).max())
        if not USUAL_RADII[0] <= radius <= USUAL_RADII[1]:
            yield f"{name}.joints lie within {radius * 1e3:g} mm of their middle: is their unit right?"
    axis = platform.mean(axis=0) - base.mean(axis=0)
    far = float(np.linalg.norm(axis))
    if far > COINCIDENT:
        yield from _order(_seen_along(axis / far, base), _seen_along(axis / far, platform))


def _seen_along(axis: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return joints about their middle as complex numbers in a plane across an axis, shape (6,), m."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    around = joints - joints.mean(axis=0)
    return np.asarray(around @ first + 1j * (around @ np.cross(axis, first)))


def _order(base: np.ndarray, platform: np.ndarray) -> Iterator[str]:
    """Compare the order of the joints of both bodies; complex numbers, m."""
    cost = np.abs(base[:, None] - platform) ** 2
    rows, order = linear_sum_assignment(cost)
    now = float(np.trace(cost))
    gains = now - cost[rows, order].sum() > LEAST_GAIN * now
    moved = [i + 1 for i in range(6) if cost[i, order[i]] != cost[i, i]]
    turn, mirrored = np.vdot(base, platform), base @ platform  # fits of a turn, and of a turn and a reflection
    if gains and len(moved) == 2:
        yield "joints {}, {} of the platform, or of the base, look swapped: the struts cross".format(*moved)
    elif abs(mirrored) > abs(turn):
        yield (
            "platform joints 1…6 run the other way round than base joints 1…6: is home mirrored (turned over, by 180° "
            "about x or y), or one body's y reversed?"
        )
    elif abs(np.angle(turn)) > MOST_TURN:
        yield (
            f"at home the platform is turned by {np.degrees(np.angle(turn)):.0f}° against the base, about the axis "
            "from base to platform: is home's gamma right, does strut 1 begin at the right joint?"
        )
    elif gains:
        yield f"joints {', '.join(map(str, moved))} of the platform, or of the base, look swapped: the struts cross"


def twist_per_lead(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> float:
    """Return the largest relative deviation from the lead of the screws that turn with cardan joints."""
    neutral = np.asarray(geometry.base_cone_axes)
    across = np.cross(neutral, np.eye(3)[np.abs(neutral).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1)[:, None]
    machine = (*geometry.kernel_joints, across, across @ geometry.home.rotation)
    twists = screw_twists(*machine, np.ascontiguousarray(positions), np.ascontiguousarray(rotations))
    return float(np.abs(twists).max() / (2.0 * np.pi))
