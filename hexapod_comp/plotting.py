"""Every picture: functions that take results and return a matplotlib figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from .errors import InputFileError
from .geometry import STRUT_NAMES, HexapodGeometry
from .motion import follow
from .outputs import refuse_replacing_input
from .pose import Pose
from .session_records import PathRecord, PoseRecord, SessionResult, Track

matplotlib.rcParams.update({"font.size": 9, "axes.grid": True, "grid.alpha": 0.3})

WITHOUT, WITH = "#c1432e", "#20639b"
"""Colours of the machine without and with compensation, the same in every picture."""

NOTHING = 1e-3
"""Lower end of logarithmic error axes, µm: below a nanometre nothing is claimed."""


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, making the folder when it is missing.

    Raises
    ------
    InputFileError
        It cannot be written.
    """
    refuse_replacing_input(path)
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(target, dpi=140)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error


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
    figure.suptitle(title)
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


def machine_figure(geometry: HexapodGeometry) -> Figure:
    """Draw a machine at home: joints, struts and frames in space, joints and struts from above.

    Parameters
    ----------
    geometry : HexapodGeometry
        Its tool and work frames are drawn where they differ from those that carry them.
    """
    figure = Figure(figsize=(12, 6), layout="constrained")
    space = figure.add_subplot(1, 2, 1, projection="3d")
    above = figure.add_subplot(1, 2, 2)
    base = geometry.base_joints * 1e3
    platform = (geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T) * 1e3
    for axes, shown in ((space, 3), (above, 2)):
        _bodies(axes, base[:, :shown], platform[:, :shown])
    for name, pose in _frames(geometry).items():
        _frame(space, name, pose)
    space.set_box_aspect(None, zoom=1.15)  # type: ignore[attr-defined]
    space.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm", aspect="equal")  # type: ignore[call-arg]
    space.view_init(elev=22.0, azim=-62.0)  # type: ignore[attr-defined]
    above.set(xlabel="x, mm", ylabel="y, mm", aspect="equal", title="from above")
    above.margins(0.12)
    return figure


def _bodies(axes: Any, base: np.ndarray, platform: np.ndarray) -> None:
    """Draw both bodies and the six struts on flat or 3-D axes; joints (6, 2) or (6, 3), mm."""
    for joints, colour in ((base, "black"), (platform, WITH)):
        axes.plot(*np.vstack([joints, joints[:1]]).T, color=colour, lw=2.0, marker="o", ms=4)
    for index, (start, end) in enumerate(zip(base, platform, strict=True)):
        axes.plot(*np.stack([start, end]).T, color=WITHOUT, lw=1.2)
        axes.text(*(0.5 * (start + end)), str(index + 1), color=WITHOUT, weight="bold")
        axes.text(*(start * 1.08), f"$b_{index + 1}$", ha="center", va="center")
    for joint in np.unique(platform.round(6), axis=0):
        here = np.flatnonzero(np.abs(platform - joint).max(axis=1) < 1e-3) + 1
        axes.text(*joint, " = ".join(f"$t_{i}$" for i in here), color=WITH, va="bottom")


def _frames(geometry: HexapodGeometry) -> dict[str, Pose]:
    """Return the frames worth drawing, by name, seen from ``base``."""
    frames = {"base": Pose.identity(), "platform": geometry.home}
    offsets = ("tool", geometry.home, geometry.tool), ("work", frames["base"], geometry.work)
    for name, outer, inner in offsets:
        if inner.position.any() or not np.array_equal(inner.rotation, np.eye(3)):
            frames[name] = outer @ inner
    return frames


def _frame(axes: Any, name: str, pose: Pose) -> None:
    """Draw the axes of a frame, 70 mm long, and its name on 3-D axes."""
    origin = pose.position * 1e3
    for axis, colour, letter in zip(pose.rotation.T, ("#b22222", "#2e8b57", "#4169e1"), "xyz", strict=True):
        tip = origin + 70.0 * axis
        axes.plot(*np.stack([origin, tip]).T, color=colour, lw=1.5)
        axes.text(*tip, letter, color=colour, fontsize=7)
    axes.text(*(origin - 12.0), name, style="italic", ha="right", va="top")


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
    low, sense = np.full(1, np.nan), np.zeros(1)
    followed = np.array([(follow(value, threshold, low, sense, 0), low[0]) for value in values])
    figure = Figure(figsize=(7, 4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    number, window = np.arange(len(values)), followed[:, 1]
    upper.fill_between(number, window, window + threshold, color=WITH, alpha=0.25, label="window")
    upper.plot(values, color="black", lw=0.8, label="value, with noise")
    upper.set(ylabel="µm")
    upper.legend()
    lower.step(number, followed[:, 0], where="post", color=WITHOUT)
    lower.set(xlabel="command", ylabel="direction", yticks=[-1, 0, 1])
    return figure
