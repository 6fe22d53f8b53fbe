"""Pictures of a replayed run: corrections, commands, following error, tool, refused commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..formats.figures import WITH, WITHOUT, picture_text
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from .replay import BEFORE, DIFFERENT, LOST
from .report import LONGEST_GAP, Report, following_error, tool_positions

EVENT_COLOURS = {
    "temperature": "#8a6d3b", "humidity": "#1f78b4", "model": "#7b3294", "enable": "#2e8b57", "tool": "#b8860b",
    "reset": "#555555", "drift": "#d95f02",
}  # fmt: skip

MOST_LABELS = 12  # Largest number of changes of inputs that are drawn with names


def figures_of(report: Report, geometry: HexapodGeometry | None) -> dict[str, Figure]:
    """Return the figures of a report by file name; the figure of the tool's path requires a geometry."""
    figures = {"corrections": corrections_figure(report), "commands": commands_figure(report)}
    if len(report.recording.topics["strut_states"]):
        figures["following_error"] = following_figure(report)
    if geometry is not None:
        figures["tool"] = tool_figure(report, geometry)
    if report.other is not None or not report.same:
        figures["difference"] = difference_figure(report)
    return {f"{name}.png": figure for name, figure in figures.items()}


def _figure(report: Report, what: str, height: float = 4.5) -> Figure:
    figure = Figure(figsize=(11, height), layout="constrained")
    figure.suptitle(picture_text(f"{what} · {report.recording.node} · {Path(report.recording.path).name}"))
    return figure


def _broken(seconds: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert NaN, drawn as a gap, at each pause of the recording that is longer than LONGEST_GAP."""
    holes = np.flatnonzero(np.diff(seconds) > LONGEST_GAP) + 1
    return np.insert(seconds, holes, np.nan), np.insert(values, holes, np.nan, axis=0)


def _struts(axes: Axes, seconds: np.ndarray, values: np.ndarray) -> None:
    for name, column in zip(STRUT_NAMES, values.T, strict=True):
        axes.plot(*_broken(seconds, column), lw=0.8, label=name)
    axes.set(xlabel="time, s")
    axes.legend(ncols=6, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.12))


def _mark_events(report: Report, axes: Axes) -> None:
    """Draw a vertical line at each change of an input, and shade the periods whose answers were not replayed."""
    replayed = report.replayed
    if replayed is None:
        return
    seconds = report.seconds
    for event in replayed.changes:
        at, entry = seconds[min(event.row, len(seconds) - 1)], event.entry
        axes.axvline(at, color=EVENT_COLOURS.get(entry.what, "black"), lw=0.8, ls="--")
        if len(replayed.changes) <= MOST_LABELS:
            label = f"{entry.what} {picture_text(str(entry.values.get('name', '')), 20)}".rstrip()
            label = label if entry.what != "enable" else "enable" if entry.values["on"] else "disable"
            axes.annotate(
                label, (at, 1.0), (2, -3), xycoords=("data", "axes fraction"), textcoords="offset points",
                rotation=90, va="top", fontsize=6,
            )  # fmt: skip
    lost = np.isin(replayed.outcome, (LOST, BEFORE))
    if lost.any():
        low, high = axes.get_ylim()
        axes.fill_between(seconds, low, high, where=lost.tolist(), color="grey", alpha=0.2, lw=0.0, step="mid")
        axes.set_ylim(low, high)


def corrections_figure(report: Report) -> Figure:
    figure = _figure(report, "Strut corrections: command − nominal")
    axes = figure.subplots()
    _struts(axes, report.seconds, report.strut_corrections * 1e6)
    axes.set(ylabel="µm")
    _mark_events(report, axes)
    return figure


def commands_figure(report: Report) -> Figure:
    figure = _figure(report, "Strut lengths", 6.5)
    panels = figure.subplots(2, 3, sharex=True)
    commands, states = report.strut_commands * 1e3, report.recording.topics["strut_states"]
    for n, axes in enumerate(panels.ravel()):
        if len(states):
            axes.plot(
                *_broken(report.since(states.when), states.values[:, n] * 1e3), color=WITHOUT, lw=1.6, label="measured"
            )
        axes.plot(*_broken(report.seconds, commands[:, n]), color=WITH, lw=0.8, label="command")
        axes.set(title=STRUT_NAMES[n])
    for axes in panels[1]:
        axes.set(xlabel="time, s")
    for axes in panels[:, 0]:
        axes.set(ylabel="mm")
    panels[0, 0].legend(fontsize=7)
    return figure


def following_figure(report: Report) -> Figure:
    figure = _figure(report, "Following error: measured − commanded, including the drives' lag")
    axes = figure.subplots()
    seconds, error = following_error(report)
    _struts(axes, seconds, error * 1e6)
    axes.set(ylabel="µm")
    return figure


def tool_figure(report: Report, geometry: HexapodGeometry) -> Figure:
    """Draw the commanded and the estimated tool positions from above and from the side."""
    figure = _figure(report, "Tool", 5.0)
    positions = tool_positions(report.recording, geometry)
    estimates = report.recording.topics["tool_pose_estimate"]
    panels = figure.subplots(1, 2)
    for axes, (first, second) in zip(panels, ((0, 1), (0, 2)), strict=True):
        if len(estimates):
            points = estimates.values[:, :3] * 1e3
            axes.plot(points[:, first], points[:, second], color=WITHOUT, lw=1.6, label="estimated")
        axes.plot(positions[:, first] * 1e3, positions[:, second] * 1e3, color=WITH, lw=0.8, label="commanded")
        axes.set(xlabel=f"{'xyz'[first]} in base, mm", ylabel=f"{'xyz'[second]} in base, mm")
        axes.axis("equal")
    panels[0].legend(fontsize=7)
    return figure


def difference_figure(report: Report) -> Figure:
    """Draw the corrections of each replay minus the recorded corrections."""
    shown = [(report.other, f"{report.other_name} − recorded")] if report.other is not None else []
    replayed = report.replayed
    if replayed is not None and (replayed.outcome == DIFFERENT).any():
        shown.append((replayed, "replayed − recorded"))
    figure = _figure(report, "Corrections compared", 4.5 * max(1, len(shown)))
    for axes, (run, title) in zip(figure.subplots(max(1, len(shown)), 1, squeeze=False)[:, 0], shown, strict=False):
        _struts(axes, report.seconds, run.difference * 1e6)
        axes.set(title=picture_text(title), ylabel="µm")
    return figure
