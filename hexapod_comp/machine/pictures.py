"""Pictures of a machine and of its conventions."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ..core.batch import follow
from ..formats.figures import WITH, WITHOUT
from ..pose import Pose
from .geometry import HexapodGeometry

AXIS_COLOURS = ("#b22222", "#2e8b57", "#4169e1")
"""Of x, y and z; their letters stand beside them."""

CARDAN = "#007f7f"
"""Colour of the cardan axes that are fixed to a body."""


def machine_figure(geometry: HexapodGeometry) -> Figure:
    """Draw a machine at home: joints, struts and frames in space, joints and struts from above."""
    figure = Figure(figsize=(12, 6), layout="constrained")
    space: Any = figure.add_subplot(1, 2, 1, projection="3d")
    above = figure.add_subplot(1, 2, 2)
    draw_in_space(space, geometry)
    space.set_box_aspect(None, zoom=1.15)
    space.set(aspect="equal")
    draw_flat(above, geometry, (0, 1))
    above.set_title("from above")
    return figure


def draw_in_space(axes: Any, geometry: HexapodGeometry) -> None:
    """Draw a machine at home on 3-D axes, seen from ``base``, mm: bodies, struts, frames, and cardan axes if given."""
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
    """Draw bodies and struts at home on flat axes, those two coordinates of ``base``, mm; with numbers or without."""
    base, platform = _joints(geometry)
    _bodies(axes, base[:, plane], platform[:, plane], labels)
    axes.set(xlabel=f"{'xyz'[plane[0]]} in base, mm", ylabel=f"{'xyz'[plane[1]]} in base, mm", aspect="equal")
    axes.margins(0.12)


def _joints(geometry: HexapodGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return base and platform joints at home, seen from ``base``, mm."""
    platform = geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T
    return geometry.base_joints * 1e3, platform * 1e3


def _bodies(axes: Any, base: np.ndarray, platform: np.ndarray, labels: bool = True) -> None:
    """Draw both bodies and the six struts on flat or 3-D axes; joints (6, 2) or (6, 3), mm."""
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
    """Write the numbers of joints, those that lie in one place together."""
    for joint in np.unique(joints.round(6), axis=0):
        here = np.flatnonzero(np.abs(joints - joint).max(axis=1) < 1e-3) + 1
        axes.text(*place(joint), " = ".join(f"${letter}_{i}$" for i in here), ha="center", **style)


def _frames(geometry: HexapodGeometry) -> dict[str, Pose]:
    """Return the frames worth drawing, by name, seen from ``base``."""
    frames = {"base": Pose.identity(), "platform": geometry.home}
    offsets = ("tool", geometry.home, geometry.tool), ("work", frames["base"], geometry.work)
    for name, outer, inner in offsets:
        if inner.position.any() or not np.array_equal(inner.rotation, np.eye(3)):
            frames[name] = outer @ inner
    return frames


def _frame(axes: Any, name: str, pose: Pose, length: float) -> None:
    """Draw the axes of a frame, so many mm long, and its name on 3-D axes."""
    origin = pose.position * 1e3
    for axis, colour, letter in zip(pose.rotation.T, AXIS_COLOURS, "xyz", strict=True):
        tip = origin + length * axis
        axes.plot(*np.stack([origin, tip]).T, color=colour, lw=1.5)
        axes.text(*tip, letter, color=colour, fontsize=7)
    axes.text(*(origin - 0.17 * length), name, style="italic", ha="right", va="top")


def weights_figure() -> Figure:
    """Draw the weights of the four lines around a tool: each the area of the rectangle opposite to it."""
    figure = Figure(figsize=(4.8, 4.2), layout="constrained")
    axes = figure.subplots()
    y, z = 0.3, 0.4
    corners = ((0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0))
    for index, (at_y, at_z) in enumerate(corners):
        far_y, far_z = 1.0 - at_y, 1.0 - at_z
        width, height, colour = abs(far_y - y), abs(far_z - z), f"C{index}"
        corner = min(y, far_y), min(z, far_z)
        axes.add_patch(Rectangle(corner, width, height, color=colour, alpha=0.3, lw=0.0))
        weight = f"$W_{index + 1}$ = {width * height:.2f}"
        axes.text(0.5 * (y + far_y), 0.5 * (z + far_z), weight, ha="center", va="center")
        axes.plot(at_y, at_z, "o", color=colour, ms=9, clip_on=False)
        axes.annotate(f"line {index + 1}", (at_y, at_z), (6, 6), textcoords="offset points", color=colour)
    axes.plot(y, z, "k+", ms=14)
    axes.annotate("tool", (y, z), (6, 4), textcoords="offset points")
    axes.set(xlim=(-0.06, 1.2), ylim=(-0.06, 1.12), aspect="equal")
    axes.set(xlabel="s, across in y", ylabel="t, across in z")
    return figure


def direction_figure() -> Figure:
    """Show the direction of motion that the code gives a noisy axis: there, at rest, and back."""
    threshold = 2.0
    there = np.concatenate([np.linspace(0.0, 12.0, 60), np.full(60, 12.0), np.linspace(12.0, 3.0, 60)])
    values = there + 0.3 * np.random.default_rng(1).standard_normal(len(there))
    low, sense = follow(threshold, values)
    figure = Figure(figsize=(7, 4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    number, window = np.arange(len(values)), low
    upper.fill_between(number, window, window + threshold, color=WITH, alpha=0.25, label="window")
    upper.plot(values, color="black", lw=0.8, label="value, with noise")
    upper.set(ylabel="µm")
    upper.legend()
    lower.step(number, sense, where="post", color=WITHOUT)
    lower.set(xlabel="command", ylabel="direction", yticks=[-1, 0, 1])
    return figure
