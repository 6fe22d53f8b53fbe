"""The picture of doc/speed.md from what :mod:`benchmarks.speed` has measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hexapod_comp.formats.figures import WITH, WITHOUT

from .loop import BAR_MEDIAN, BAR_P99, Row
from .poses import NEAR, OURS, WIDE

if TYPE_CHECKING:
    from .blocks import Block
    from .convergence import Convergence
    from .kernels import Result

OTHERS = "#8d99a6"


def speed_picture(timed: list[Result], yaws: list[Convergence], costs: list[Block], beside: list[Row]) -> Figure:
    """Show kinematics, convergence, cost of blocks, and latency beside the relay."""
    figure = Figure(figsize=(12, 9.5), layout="constrained")
    left, right = figure.subfigures(1, 2)
    _kernels(left.subplots(1, 1), timed)
    above, middle, below = right.subplots(3, 1)
    _convergence(above, yaws)
    _blocks(middle, costs)
    _latency(below, beside)
    return figure


def _kernels(axes: Axes, results: list[Result]) -> None:
    """Draw time per pose, a group of dots per task and shape: bars would begin nowhere on a logarithmic axis."""
    groups = [("inverse", "batch"), (WIDE, "batch"), (NEAR, "batch"), ("inverse", "single"), (WIDE, "single")]
    groups.append((NEAR, "single"))
    place, places, names = 0.0, [], []
    for task, shape in groups:
        rows = [r for r in results if (r.task, r.shape) == (task, shape)]
        for r in rows:
            colour = WITH if r.name == OURS else WITHOUT if "genhexkins" in r.name else OTHERS
            axes.plot(r.us_per_pose, place, "o", color=colour, markersize=7)
            axes.text(1.25 * r.us_per_pose, place, f"{r.us_per_pose:.3g}", va="center", fontsize=7)
            places.append(place)
            names.append(r.name)
            place += 1.0
        if rows:
            at = place - len(rows) - 0.6
            title = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "bottom", "fontweight": "bold"}
            axes.text(0.99, at, f"{task}, {shape}", **title)
        place += 1.2
    axes.set_yticks(places, names, fontsize=7)
    axes.set(xscale="log", xlabel="processor time, µs a pose", title="Kinematics")
    axes.set_xlim(right=6.0 * axes.get_xlim()[1])
    axes.invert_yaxis()
    axes.grid(axis="x", which="major", alpha=0.4)


def _convergence(axes: Axes, rows: list[Convergence]) -> None:
    axes.set(title="Solved from 1 mm and 1 mrad away", xlabel="yaw, °", ylabel="solved, %")
    yaws = [row.yaw_deg for row in rows]
    axes.plot(yaws, [100.0 * row.ours / row.poses for row in rows], "o-", color=WITH, label="hexapod_comp")
    axes.plot(yaws, [100.0 * row.theirs / row.poses for row in rows], "s-", color=WITHOUT, label="genhexkins")
    axes.legend(loc="center left")


def _blocks(axes: Axes, blocks: list[Block]) -> None:
    """Draw what each block adds."""
    rows = np.arange(len(blocks))
    axes.barh(rows - 0.2, [b.command_us for b in blocks], 0.4, color=WITH, label="command")
    axes.barh(rows + 0.2, [b.estimate_us for b in blocks], 0.4, color=OTHERS, label="estimate")
    names = [b.name if b.name == "ideal" else f"+ {b.name}" for b in blocks]
    axes.set_yticks(rows, names, fontsize=8)
    axes.set(title="A command and an estimate, and what blocks add", xlabel="µs, called from Python")
    axes.invert_yaxis()
    axes.legend(loc="lower right")


def _latency(axes: Axes, rows: list[Row]) -> None:
    """Draw the ratios to the relay with their quartiles and bars."""
    places = np.arange(len(rows))
    medians, tails = [row.median_ratio for row in rows], [row.p99_ratio for row in rows]
    shown = ((-0.15, medians, WITH, "median", BAR_MEDIAN), (0.15, tails, OTHERS, "99th percentile", BAR_P99))
    for shift, ratios, colour, label, bar in shown:
        low, middle, high = np.array(ratios).T
        spread = [middle - low, high - middle]
        axes.errorbar(places + shift, middle, spread, fmt="o", color=colour, label=label, capsize=3)
        axes.axhline(bar, color=colour, linestyle="--", linewidth=1.0)
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_xticks(places, [row.name if row.name == "flat out" else f"{row.name} Hz" for row in rows])
    axes.set(title="Latency: compensator ÷ idle relay (dashed: bar)", ylabel="ratio")
    axes.legend(loc="upper center")
