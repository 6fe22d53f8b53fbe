"""The picture of an observed run: the tool's error without and with compensation, and the predicted interval."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..formats.figures import WITH, WITHOUT, picture_text
from ..machine.arrays import rms
from .report import ErrorRow, PathRecord, PoseRecord, SessionResult, Track
from .story import Calibration

matplotlib.rcParams.update({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})

# The two passes with their colours, red and blue, which all people distinguish, and markers
SIDES = ((0, WITHOUT, "o"), (1, WITH, "D"))

FLOOR = 0.01  # lower end of the error axes, µm: a tenth of the drives' steps
DRAWN_DEVIATION = 0.04  # the path's deviation without compensation is drawn as this share of its width


def session_figure(
    result: SessionResult, rows: Sequence[ErrorRow], title: str, calibration: Calibration | None = None
) -> Figure:
    """Draw an observed run: the path with magnified deviation, errors at rest and along it, and their figures."""
    aligned = result.aligned()
    figure = Figure(figsize=(12, 8.4 if result.path else 5.0), layout="constrained")
    figure.suptitle(picture_text(title))
    shown = result if aligned is None else aligned
    if shown.path is None:
        at_rest, figures = figure.subplots(1, 2)
    else:
        (path, at_rest), (along, figures) = figure.subplots(2, 2)
        datum = "" if aligned is None else ", datum aligned"
        _path(path, shown.path, datum)
        _deviation(along, shown.path, datum, rows)
    _rest(at_rest, result.poses, None if aligned is None else aligned.poses, rows)
    _figures(figures, rows, calibration)
    figure.legend(handles=list(_key(result, rows, aligned is not None)), loc="outside lower center", ncols=6)
    return figure


def _key(result: SessionResult, rows: Sequence[ErrorRow], aligned: bool) -> Iterable[Any]:
    """Yield the legend's entries, for all panels at once."""
    if result.path is not None:
        yield Line2D([], [], color="black", lw=1.0, ls=(0, (5, 4)), label="commanded")
    for (_, colour, marker), label in zip(SIDES, ("without", "with compensation"), strict=True):
        yield Line2D([], [], color=colour, marker=marker, label=label)
    if aligned:
        yield Line2D(
            [], [], color="0.4", marker="o", mfc="none", ls="", label="hollow: as the machine stands, datum not aligned"
        )
    if any(row.promised for row in rows):
        yield Patch(color=WITH, alpha=0.2, label="promised RMS, 95 %")


def _tracks(path: PathRecord) -> list[tuple[Track, str]]:
    """Return the recorded passes, without and with compensation, each with its colour."""
    tracks = (path.without, path.compensated)
    return [(tracks[side], colour) for side, colour, _ in SIDES if tracks[side] is not None]  # type: ignore[misc]


def _path(axes: Axes, record: PathRecord, datum: str) -> None:
    """Draw the path in its plane, and the true tracks with their deviation magnified to be seen."""
    commanded, tracks = record.path.positions * 1e3, _tracks(record)
    extent = np.ptp(record.path.positions, axis=0)
    across, up = sorted(np.argsort(extent)[1:])  # the plane in which it lies, or the one nearest to that
    width = float(extent.max())
    largest = max((rms(track.deviation) for track, _ in tracks), default=0.0)
    magnified = float(f"{DRAWN_DEVIATION * width / max(largest, 1e-9):.0e}")
    for track, colour in tracks:
        drawn = (track.feet + magnified * (track.positions - track.feet)) * 1e3
        axes.plot(drawn[:, across], drawn[:, up], color=colour, lw=2.2)
    axes.plot(commanded[:, across], commanded[:, up], color="black", lw=1.0, ls=(0, (5, 4)))
    names = [f"{'xyz'[axis]} in work, mm" for axis in (across, up)]
    axes.set(title=f"Tool path, deviation × {magnified:g}{datum}", xlabel=names[0], ylabel=names[1], aspect="equal")


def _rest(
    axes: Axes, raw: Sequence[PoseRecord], aligned: Sequence[PoseRecord] | None, rows: Sequence[ErrorRow]
) -> None:
    """Draw the error at each pose; filled with the datum aligned, hollow as the machine stands."""
    number = np.arange(1, len(raw) + 1)
    for records, face in ((raw, "none"), (aligned or raw, None)):
        for side, colour, marker in SIDES:
            errors = [record.errors()[side] for record in records]
            values = [np.nan if error is None else max(error[0] * 1e6, FLOOR) for error in errors]
            axes.plot(number, values, marker, color=colour, mfc=face or colour, ms=6)
    _band(axes, rows, "at rest")
    axes.set(title="Tool error at rest", xlabel="pose", ylabel="µm", yscale="log")
    if len(raw) <= 20:
        axes.set_xticks(number)


def _band(axes: Axes, rows: Sequence[ErrorRow], what: str) -> None:
    """Shade the predicted interval."""
    promised = next((row.promised for row in rows if row.what == what and row.promised), None)
    if promised is not None:
        axes.axhspan(max(promised[0] * 1e6, FLOOR), promised[1] * 1e6, color=WITH, alpha=0.2, lw=0.0)


def _deviation(axes: Axes, record: PathRecord, datum: str, rows: Sequence[ErrorRow]) -> None:
    for track, colour in _tracks(record):
        share = np.linspace(0.0, 100.0, len(track.positions))
        axes.plot(share, np.maximum(track.deviation * 1e6, FLOOR), color=colour, lw=0.8)
    _band(axes, rows, "path")
    title = f"Distance of the tool to the path{datum}"
    axes.set(title=title, xlabel="share of the path, %", ylabel="µm", yscale="log")


def _figures(axes: Axes, rows: Sequence[ErrorRow], calibration: Calibration | None) -> None:
    """Draw every figure as a line from without to with, labelled with the removed share."""
    if not rows:
        axes.set_axis_off()
        return
    entries: list[tuple[str, float | None, float, tuple[float, float] | None]] = []
    for row in rows:
        before = None if row.without is None else rms(row.without)
        entries.append((f"{row.what},\n{row.datum}", before, rms(row.compensated), row.promised))
    if calibration is not None:
        lines, joint = calibration.lines, calibration.joint
        entries += [
            ("along lines*,\nthis fit", joint.before, joint.after, None),
            ("along lines*,\n1-D scheme*", lines.before, lines.after, None),
        ]
    axes.set_xlabel("µm, RMS" + (";  * Mou & King (1998), mean |error|" if calibration else ""))
    for height, (_, before, after, promised) in enumerate(entries):
        if promised is not None:
            low, high = (max(v * 1e6, FLOOR) for v in promised)
            axes.fill_betweenx([height - 0.25, height + 0.25], low, high, color=WITH, alpha=0.2, lw=0.0)
        if before is not None:
            axes.plot([before * 1e6, after * 1e6], [height, height], color="0.6", lw=1.5, zorder=1)
            axes.plot(before * 1e6, height, SIDES[0][2], color=WITHOUT)
        axes.plot(after * 1e6, height, SIDES[1][2], color=WITH)
    axes.set(
        title="Tool error, without → with compensation",
        xscale="log",
        yticks=range(len(entries)),
        yticklabels=[e[0] for e in entries],
    )
    axes.set_ylim(len(entries) - 0.5, -0.5)
    low, high = axes.get_xlim()
    axes.set_xlim(low, high * (high / low) ** 0.25)  # room for the shares
    for height, (_, before, after, _) in enumerate(entries):
        if before is not None:
            text = f"{100.0 * (1.0 - after / before):.1f} % less" if after <= before else "more"
            axes.annotate(text, (before * 1e6, height), (8, 0), textcoords="offset points", va="center")
