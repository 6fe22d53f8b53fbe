"""Pictures for the papers: the machine with its dimensions, changes of strut lengths by random errors, and weights."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from hexapod_comp.formats.figures import WITH, WITHOUT
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.pictures import draw_flat, draw_in_space

BINS = np.arange(-40.5, 41.0, 1.0)  # Edges of a histogram of changes of length, µm


def configuration_figure(geometry: HexapodGeometry) -> Figure:
    """Draw the paper's machine with its three dimensions (Song et al., Figures 1 and 3)."""
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    space: Any = figure.add_subplot(1, 2, 1, projection="3d")
    above = figure.add_subplot(1, 2, 2, title="from above")
    draw_in_space(space, geometry)
    space.set_box_aspect(None, zoom=1.15)
    space.set(aspect="equal")
    space.locator_params(nbins=4)
    draw_flat(above, geometry, (0, 1))
    base, platform = geometry.base_joints * 1e3, geometry.platform_joints * 1e3
    for name, first, second in (("b", base[2], base[3]), ("d", base[1], base[2]), ("a", platform[0], platform[4])):
        x, y = 0.5 * (first + second)[:2]
        along = np.degrees(np.arctan2(*(first - second)[1::-1]))  # the text is parallel to the side
        where = {"ha": "center", "va": "bottom", "rotation": along, "rotation_mode": "anchor", "size": "small"}
        above.text(x, y, f"{name} = {np.linalg.norm(first - second):g} mm", **where)
    above.margins(0.12)
    return figure


def changes_figure(drawn: np.ndarray, printed: np.ndarray) -> Figure:
    """Draw histograms of real minus ideal strut lengths: of machines with errors up to ±10 µm, and as printed."""
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    for values, colour, name in (
        (drawn, WITHOUT, f"drawn: uniform ±10 µm, {drawn.size} struts"),
        (printed, WITH, f"as printed: {printed.size} struts"),
    ):
        weights = np.full(values.size, 100.0 / values.size)
        axes.hist(values.ravel(), BINS.tolist(), weights=weights, color=colour, alpha=0.6, label=name)
    axes.set(xlabel="real minus ideal strut length, µm", ylabel="share of struts, % per µm")
    axes.legend(loc="upper left", frameon=False)
    return figure


def weights_figure() -> Figure:
    """Draw the weights of the four lines around a tool: each weight is the area of the opposite rectangle."""
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
