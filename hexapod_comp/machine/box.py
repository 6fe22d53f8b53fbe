"""The box of tool positions about home that a machine reaches: where the demonstration measures, fields are drawn."""

from __future__ import annotations

import numpy as np

from ..errors import GeometryError
from .geometry import HexapodGeometry
from .passes import Passes

PROPORTIONS = np.array([1.0, 1.0, 0.5])
"""Sides of the box to each other, along x, y and z of the work frame."""

SAMPLES = 5
"""Places along each side at which reach is tried."""

SHARE = 0.8
"""The box is this share of the largest one: room for tilts, corrections and the way there."""

STEPS = 20
"""Halvings in search of the largest box: a millionth of the stroke."""


def level_box(geometry: HexapodGeometry) -> np.ndarray:
    """Return a box of tool positions about home that a tool parallel to the work frame reaches, shape (2, 3), m.

    The box lies in the work frame, its middle is the tool's place at home, and its sides are as
    :data:`PROPORTIONS`. It is :data:`SHARE` of the largest such box of which the nominal machine reaches every
    corner, and every place of a grid, within all limits; rounded to tenths of a millimetre.

    Raises
    ------
    GeometryError
        A level tool cannot be at home: work or tool frame is turned too far.
    """
    centre = geometry.tool_pose(geometry.home).position
    unit = np.linspace(-1.0, 1.0, SAMPLES)
    grid = np.stack(np.meshgrid(unit, unit, unit), axis=-1).reshape(-1, 3) * PROPORTIONS
    level = np.tile(np.eye(3), (len(grid), 1, 1))

    def passes(half: float) -> Passes:
        return Passes.of_tool(geometry, centre + half * grid, level, np.zeros_like(grid))

    refusal = passes(0.0).refusals()[0]
    if refusal is not None:
        problem = f"are turned so that a tool parallel to the work frame cannot be at home: {refusal}"
        raise GeometryError("work, tool", problem)
    low, high = 0.0, float(np.ptp(geometry.limits.stroke, axis=1).max())
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(middle).reachable().all() else (low, middle)
    half = np.floor(SHARE * low * PROPORTIONS * 1e4) * 1e-4
    if not half.all():
        raise GeometryError("limits", "leave a level tool no room at home, m", (low * PROPORTIONS).tolist())
    return np.array([centre - half, centre + half]).round(9)


def box_of_platforms(geometry: HexapodGeometry, box: np.ndarray) -> np.ndarray:
    """Return the lowest and highest platform position in ``base`` of a level tool in a box of ``work``, (2, 3), m."""
    corners = np.stack(np.meshgrid(*np.transpose(box)), axis=-1).reshape(-1, 3)
    positions, _ = geometry.platform_poses(corners, np.tile(np.eye(3), (len(corners), 1, 1)))
    return np.array([positions.min(axis=0), positions.max(axis=0)])
