"""Pictures of a session (tool error without and with compensation) and of the demonstration (tool error over time)."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..formats.figures import WITH, WITHOUT, picture_text
from ..machine.arrays import rms
from .report import ALIGNED, DEFINITIONS, SessionResult
from .story import Demonstration

matplotlib.rcParams.update({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})

FLOOR = 0.01  # Smaller errors are drawn at this value, µm, a tenth of the drives' resolution


def session_figure(result: SessionResult, title: str) -> Figure:
    """Draw the tool error at each pose: absolute (hollow markers) and after best-fit alignment (filled markers)."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    axes, number = figure.subplots(), np.arange(1, len(result.poses) + 1)
    figure.suptitle(picture_text(title))
    for datum, errors in result.errors().items():
        sides = zip(("without", "with compensation"), (WITHOUT, WITH), ("o", "D"), errors, strict=True)
        for name, colour, marker, distances in sides:
            face, label = colour if datum == ALIGNED else "none", f"{name}, {DEFINITIONS[datum]}"
            axes.plot(number, np.maximum(distances * 1e6, FLOOR), marker, color=colour, mfc=face, label=label)
    axes.set(title="Tool error at rest", xlabel="pose", ylabel="µm", yscale="log")
    if axes.lines:
        axes.legend()
    return figure


def story_figure(outcome: Demonstration, title: str) -> Figure:
    """Draw the tool error at each stop over time, its RMS between changes of machine or model, and the promised RMS."""
    figure = Figure(figsize=(11, 5), layout="constrained")
    axes = figure.subplots()
    figure.suptitle(picture_text(title))
    compensated = ("calibrated", "renewed", "repaired")
    for label, colour in (("without a model of the present machine", WITHOUT), ("with this model", WITH)):
        axes.plot([], [], ".-", color=colour, label=f"{label}: error at a stop (point), RMS (line)")
    for chapter in outcome.chapters:
        minutes, errors = np.array(chapter.times) / 60.0, np.maximum(chapter.errors() * 1e6, FLOOR)
        colour, whole = WITH if chapter.title in compensated else WITHOUT, rms(errors)
        axes.plot(minutes, errors, ".", color=colour)
        axes.hlines(whole, minutes[0], minutes[-1], color=colour, lw=2.0)
        axes.axvline(minutes[0], color="0.6", lw=0.8)
        axes.annotate(
            f"{chapter.title}: {whole:.3g} µm", (minutes[0], 1.0), (3, -4), xycoords=("data", "axes fraction"),
            textcoords="offset points", rotation=90, va="top",
        )  # fmt: skip
    axes.axhline(outcome.promised * 1e6, color="black", ls="--", lw=1.0, label="promised RMS in the whole box (95 %)")
    axes.set(xlabel="time of the machine, min", ylabel="tool error after best-fit alignment, µm", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(top=100.0 * axes.get_ylim()[1])  # leave space for the titles of the chapters
    axes.legend(loc="lower left")
    return figure
