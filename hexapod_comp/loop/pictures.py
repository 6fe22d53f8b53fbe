"""Every picture: functions that take results and return a matplotlib figure."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..formats.figures import NOTHING, WITH, WITHOUT, picture_text
from ..machine.geometry import STRUT_NAMES
from .records import PathRecord, PoseRecord, SessionResult, Track

matplotlib.rcParams.update({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})


def session_figure(result: SessionResult, title: str) -> Figure:
    """Show a witnessed run: pose errors, path with magnified deviation, deviation and corrections along it.

    Parameters
    ----------
    result : SessionResult
        With at least one pose.
    title : str
        Machine and model.
    """
    figure = Figure(figsize=(12, 8), layout="constrained")
    figure.suptitle(picture_text(title))
    if result.path is None:
        _pose_errors(figure.subplots(1, 1), result.poses)
        return figure
    axes = figure.subplots(2, 2)
    _path(axes[0, 0], result.path)
    _pose_errors(axes[0, 1], result.poses)
    _deviation(axes[1, 0], result.path)
    _corrections(axes[1, 1], result.path)
    return figure


def _pose_errors(axes: Axes, poses: list[PoseRecord]) -> None:
    number = np.arange(1, len(poses) + 1)
    for shift, side, colour, label in ((-0.2, 0, WITHOUT, "without"), (0.2, 1, WITH, "with compensation")):
        errors = [record.errors()[side] for record in poses]
        values = [np.nan if error is None else error[0] * 1e6 for error in errors]
        if not np.isnan(values).all():
            axes.bar(number + shift, np.maximum(values, NOTHING), 0.4, color=colour, label=label)
    axes.set(title="Position error of the tool at rest", xlabel="pose", ylabel="error, µm", yscale="log")
    axes.set_ylim(top=10.0 * axes.get_ylim()[1])  # room for the legend
    if len(poses) <= 20:
        axes.set_xticks(number)
    axes.legend(loc="upper right", ncols=2)


def _path(axes: Axes, record: PathRecord) -> None:
    """Draw the path in x and y, and the true tracks with their deviation magnified."""
    commanded = record.path.positions
    axes.plot(commanded[:, 0] * 1e3, commanded[:, 1] * 1e3, color="black", lw=0.8, label="commanded")
    magnified = 20.0
    for track, colour, label in _passes(record):
        drawn = (track.feet + magnified * (track.positions - track.feet)) * 1e3
        axes.plot(drawn[:, 0], drawn[:, 1], color=colour, lw=0.8, label=label)
    axes.set(title=f"Tool path in base, deviation × {magnified:g}", xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes.legend(loc="upper right")


def _passes(record: PathRecord) -> list[tuple[Track, str, str]]:
    """Return the passes that were seen, with colour and label."""
    passes = ((record.without, WITHOUT, "without"), (record.compensated, WITH, "with compensation"))
    return [(track, colour, label) for track, colour, label in passes if track is not None]


def _deviation(axes: Axes, record: PathRecord) -> None:
    for track, colour, label in _passes(record):
        share = np.linspace(0.0, 100.0, len(track.positions))
        axes.plot(share, np.maximum(track.deviation * 1e6, NOTHING), color=colour, lw=0.8, label=label)
    axes.set(title="Distance of the tool to the path", xlabel="share of the path, %", ylabel="µm", yscale="log")
    axes.legend()


def _corrections(axes: Axes, record: PathRecord) -> None:
    time = np.arange(len(record.corrections)) / record.path.rate
    for name, values in zip(STRUT_NAMES, record.corrections.T, strict=True):
        axes.plot(time, values * 1e6, lw=0.9, label=name)
    axes.set(title="Strut corrections: command − nominal", xlabel="time, s", ylabel="µm")
    axes.legend(ncols=2, fontsize=7)
