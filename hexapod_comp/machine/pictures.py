"""Drawings of a machine at home: bodies, struts, joint numbers, frames and cardan axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..formats.figures import WITH, WITHOUT
from ..pose import Pose
from .geometry import HexapodGeometry

AXIS_COLOURS = ("#b22222", "#2e8b57", "#4169e1")  # colours of the axes x, y and z of a frame
CARDAN = "#007f7f"  # colour of the cardan axes that are fixed to base and platform


def draw_in_space(axes: Any, geometry: HexapodGeometry) -> None:
    """Draw a machine at home on 3-D axes, mm in ``base``: bodies, struts, frames, and cardan axes if given."""
    base, platform = _joints(geometry)
    _bodies(axes, base, platform)
    reach = float(np.linalg.norm(base - base.mean(axis=0), axis=1).max())
    for name, pose in _frames(geometry).items():
        _frame(axes, name, pose, 0.17 * reach)
    given = (base, geometry.base_axes, np.eye(3)), (platform, geometry.platform_axes, geometry.home.rotation)
    label: str | None = "cardan axis fixed to the body"
    for joints, directions, turn in given:
        if directions is not None:
            for joint, direction in zip(joints, directions @ turn.T, strict=True):
                ends = joint + 0.1 * reach * np.outer([-1.0, 1.0], direction)
                axes.plot(*ends.T, color=CARDAN, lw=2.5, label=label)
                label = None
    axes.set(xlabel="x in base, mm", ylabel="y in base, mm", zlabel="z in base, mm")
    axes.view_init(elev=22.0, azim=-62.0)


def draw_flat(axes: Any, geometry: HexapodGeometry, plane: tuple[int, int], labels: bool = True) -> None:
    """Draw bodies and struts at home on 2-D axes, mm, projected to two axes of ``base``, such as (0, 2) for x and z."""
    base, platform = _joints(geometry)
    _bodies(axes, base[:, plane], platform[:, plane], labels)
    axes.set(xlabel=f"{'xyz'[plane[0]]} in base, mm", ylabel=f"{'xyz'[plane[1]]} in base, mm", aspect="equal")
    axes.margins(0.12)


def _joints(geometry: HexapodGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions at home of base and platform joints, each (6, 3), mm in ``base``."""
    platform = geometry.home.transform(geometry.platform_joints)
    return geometry.base_joints * 1e3, platform * 1e3


def _bodies(axes: Any, base: np.ndarray, platform: np.ndarray, labels: bool = True) -> None:
    """Draw base, platform and six struts on 2-D or 3-D axes, from the joints' positions, (6, 2) or (6, 3), mm."""
    for joints, colour in ((base, "black"), (platform, WITH)):
        axes.plot(*np.vstack([joints, joints[:1]]).T, color=colour, lw=2.0, marker="o", ms=4)
    for start, end in zip(base, platform, strict=True):
        axes.plot(*np.stack([start, end]).T, color=WITHOUT, lw=1.2)
    if not labels:
        return
    for index, middle in enumerate(0.5 * (base + platform)):
        axes.text(*middle, str(index + 1), color=WITHOUT, weight="bold")
    middle = base.mean(axis=0)
    _labels(axes, base, "b", {"color": "black"}, lambda joint: middle + 1.08 * (joint - middle))
    inside = platform.mean(axis=0)
    _labels(axes, platform, "t", {"color": WITH, "va": "bottom"}, lambda joint: inside + 1.05 * (joint - inside))


def _labels(axes: Any, joints: np.ndarray, letter: str, style: dict[str, str], place: Any) -> None:
    """Write the joints' numbers on the axes; joints at the same place get one text, such as t₁ = t₂."""
    for joint in np.unique(joints.round(6), axis=0):
        here = np.flatnonzero(np.abs(joints - joint).max(axis=1) < 1e-3) + 1
        axes.text(*place(joint), " = ".join(f"${letter}_{i}$" for i in here), ha="center", **style)


def _frames(geometry: HexapodGeometry) -> dict[str, Pose]:
    """Return the poses in ``base`` of the frames to draw, by name; a tool or work frame without offset is left out."""
    frames = {"base": Pose.identity(), "platform": geometry.home}
    offsets = ("tool", geometry.home, geometry.tool), ("work", frames["base"], geometry.work)
    for name, outer, inner in offsets:
        if inner.position.any() or not np.array_equal(inner.rotation, np.eye(3)):
            frames[name] = outer @ inner
    return frames


def _frame(axes: Any, name: str, pose: Pose, length: float) -> None:
    """Draw a frame on 3-D axes: three lines of the given length, mm, and the frame's name."""
    origin = pose.position * 1e3
    for axis, colour, letter in zip(pose.rotation.T, AXIS_COLOURS, "xyz", strict=True):
        tip = origin + length * axis
        axes.plot(*np.stack([origin, tip]).T, color=colour, lw=1.5)
        axes.text(*tip, letter, color=colour, fontsize=7)
    axes.text(*(origin - 0.17 * length), name, style="italic", ha="right", va="top")
