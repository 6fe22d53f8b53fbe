"""Pictures that belong to the papers: the machine with its dimensions, and what random errors do to strut lengths."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from hexapod_comp.formats.figures import WITH, WITHOUT
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.pictures import machine_figure

BINS = np.arange(-40.5, 41.0, 1.0)  # Edges of a histogram of changes of length, µm


def configuration_figure(geometry: HexapodGeometry) -> Figure:
    """Show the paper's machine with its three dimensions (Song et al., Figures 1 and 3)."""
    figure = machine_figure(geometry)
    base, platform = geometry.base_joints * 1e3, geometry.platform_joints * 1e3
    above = figure.axes[1]
    sides = ("b", base[2], base[3], 0.3), ("d", base[1], base[2], 0.5), ("a", platform[0], platform[4], 0.5)
    for name, first, second, share in sides:  # of the way; the middle of b is where platform joint 3 has its name
        x, y = (first + share * (second - first))[:2]
        side = np.linalg.norm(first - second)
        box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
        above.text(x, y, f"{name} = {side:g} mm", ha="center", va="center", bbox=box)
    return figure


def changes_figure(drawn: np.ndarray, printed: np.ndarray) -> Figure:
    """Show how strut lengths of machines drawn within ±10 µm differ from the ideal ones, and the printed ones do."""
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
