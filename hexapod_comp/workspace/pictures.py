"""Pictures of the workspace study: shells coloured by effect or limit, the ranking as bars, a machine's overview."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

from ..errors import GeometryError
from ..formats.figures import picture_text
from ..machine.geometry import HexapodGeometry
from ..machine.pictures import draw_flat, draw_in_space
from .overview import Overview
from .reach import FINDINGS
from .shells import ROTATION, TRANSLATION, Layer, Quantity, shell
from .study import RINGS, SECTORS

COLOURS = "viridis"  # perceptually uniform, also in grey and for colour-blind readers
# in the order of FINDINGS
CAUSE_COLOURS = ("#ffffff", "#20639b", "#c1432e", "#e3a72f", "#3c8d5a", "#7b4ea3", "#444444", "#d77fb3", "#000000")
VIEW_AZIMUTH, VIEW_ELEVATION = -60.0, 20.0  # degrees
BOX = "#d77f00"  # largest box
SHADOW = "#dbe4ee"  # reach behind the machine
WEDGE = 130.0  # degrees; this wedge is cut out of the outermost shell, smaller wedges out of inner shells


def shades(shares: np.ndarray) -> np.ndarray:
    """Return the colours of values from 0 to 1, (N,), as red, green, blue and opacity, (N, 4)."""
    return colormaps[COLOURS](shares)


def outline(geometry: HexapodGeometry) -> list[np.ndarray]:
    """Return the machine at home as polylines, each (points, 3), m in work: base, platform, six struts, tool."""
    home, to_work = geometry.home, geometry.work.inverse()
    platform = home.transform(geometry.platform_joints)
    base, tip = geometry.base_joints, (home @ geometry.tool).position
    lines = [np.vstack([base, base[:1]]), np.vstack([platform, platform[:1]])]
    lines += [np.stack([start, end]) for start, end in zip(base, platform, strict=True)]
    lines.append(np.stack([home.position, tip]))
    return [to_work.transform(line) for line in lines]


def shells_figure(geometry: HexapodGeometry, layers: Sequence[Layer], quantity: Quantity, title: str) -> Figure:
    """Draw shells coloured by an effect, with the machine at home (Daake et al., Figure 2)."""
    values = np.concatenate([layer.values.ravel() for layer in layers]) * quantity.factor
    if not np.isfinite(values).all():
        raise GeometryError("values", "of a mesh must be finite", int((~np.isfinite(values)).sum()))
    norm = Normalize(values.min(), values.max())
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    figure.suptitle(picture_text(title))
    faces, colours = [], []
    for number, layer in enumerate(layers):
        kept, corners = _faces(layer.points, WEDGE * number / max(1, len(layers) - 1))
        faces.append(kept)
        colours.append(shades(norm(_of_faces(layer.values, corners) * quantity.factor)))
    places = figure.add_gridspec(1, 2, width_ratios=[2, 3])
    _draw(_space(figure, places[0], "the machine at home"), geometry, faces[-1], colours[-1], machine=True)
    axes = _space(figure, places[1], "shells cut open; black line: platform at home" if len(layers) > 1 else "")
    _draw(axes, geometry, np.concatenate(faces), np.concatenate(colours))
    bar = figure.colorbar(ScalarMappable(norm, COLOURS), ax=axes, shrink=0.75, pad=0.12)
    bar.set_label(quantity.label)
    bar.ax.set_title(f"{norm.vmax:.4g}", fontsize=8)
    bar.ax.set_xlabel(f"{norm.vmin:.4g}", fontsize=8)
    return figure


def causes_figure(geometry: HexapodGeometry, points: np.ndarray, findings: np.ndarray, title: str) -> Figure:
    """Draw the workspace's boundary coloured by its limits, from above and from below."""
    faces, corners = _faces(points, 0.0)
    of_face = findings[corners]
    diagonals = np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    area = 0.5 * np.linalg.norm(diagonals, axis=1)
    colours = np.array(CAUSE_COLOURS)[of_face]
    figure = Figure(figsize=(13.0, 5.2), layout=ConstrainedLayoutEngine(rect=(0.0, 0.08, 1.0, 0.92)))
    figure.suptitle(picture_text(title))
    places = figure.add_gridspec(1, 3, width_ratios=[2, 3, 3])
    _draw(_space(figure, places[0], "the machine at home"), geometry, faces, colours, machine=True)
    for place, elevation, name in ((places[1], 30.0, "from above"), (places[2], -30.0, "from below")):
        _draw(_space(figure, place, name, elevation), geometry, faces, colours)
    present = [code for code in range(len(FINDINGS)) if (of_face == code).any()]
    shares = [area[of_face == code].sum() / area.sum() for code in present]
    handles = [
        Patch(color=CAUSE_COLOURS[code], label=f"{FINDINGS[code]}: {share:.1%} of the area")
        for code, share in zip(present, shares, strict=True)
    ]
    figure.legend(handles=handles, loc="lower center", ncols=min(4, len(handles)))
    return figure


def overview_figure(overview: Overview) -> Figure:
    """Draw a machine at home with its frames, its reach coloured by limits, and the largest box."""
    geometry, body = overview.geometry, shell(overview.reach, RINGS, SECTORS)
    faces, corners = _faces(_in_base(geometry, body.points), 0.0)
    box = _in_base(geometry, _box_edges(overview.box.box))
    figure = Figure(figsize=(14.0, 8.0), layout=ConstrainedLayoutEngine(rect=(0.0, 0.08, 1.0, 0.92)))
    sides = " × ".join(f"{edge * 1e3:.0f}" for edge in np.ptp(overview.box.box, axis=0))
    reached = f"reach of the tool's tip {overview.reach.volume * 1e3:.3g} litres, largest box {sides} mm"
    figure.suptitle(f"{picture_text(geometry.name)} at home; {reached}")
    places = figure.add_gridspec(2, 2, width_ratios=[3, 2])
    space: Any = figure.add_subplot(places[:, 0], projection="3d")
    draw_in_space(space, geometry)
    colours = np.array(CAUSE_COLOURS)[body.findings[corners]]
    space.add_collection3d(Poly3DCollection(faces, facecolors=colours, alpha=0.13, lw=0.0))
    for line in box:
        space.plot(*line.T, color=BOX, lw=1.4)
    everything = np.concatenate([*(_in_base(geometry, line) for line in outline(geometry)), faces.reshape(-1, 3)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    space.set_box_aspect(high - low, zoom=1.0)
    for place, plane, title in ((places[0, 1], (0, 1), "from above"), (places[1, 1], (0, 2), "from the side")):
        flat = figure.add_subplot(place)
        flat.add_collection(PolyCollection(list(faces[..., plane]), facecolors=SHADOW, edgecolors=SHADOW))
        for line in box:
            flat.plot(*line[:, plane].T, color=BOX, lw=1.4)
        draw_flat(flat, geometry, plane, labels=plane == (0, 1))
        flat.set_title(f"{title}, base frame")
    handles = [
        Patch(color=CAUSE_COLOURS[FINDINGS.index(name)], label=f"{name}: {share:.0%}")
        for name, share in overview.reach.shares().items()
    ]
    shadow, cardan = Patch(color=SHADOW, label="reach of the tool's tip"), space.get_legend_handles_labels()[0]
    lines = [Line2D([], [], color=BOX, label="largest box"), *cardan, shadow]
    figure.legend(handles=[*lines, *handles], loc="lower center", ncols=4)
    return figure


def _in_base(geometry: HexapodGeometry, points: np.ndarray) -> np.ndarray:
    """Convert points from work, m, to base, mm."""
    return np.asarray(1e3 * geometry.work.transform(points))


def _box_edges(box: np.ndarray) -> np.ndarray:
    """Return the ends of a box's twelve edges, shape (12, 2, 3)."""
    corners = np.array([np.where(pick, box[1], box[0]) for pick in np.ndindex(2, 2, 2)])
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return corners[np.array(pairs)]


def ranking_figure(rows: Sequence[tuple[str, np.ndarray]], title: str) -> Figure:
    """Draw for each row, a title with :meth:`.RankingRow.figures`, a bar from its smallest to its largest effect."""
    figure = Figure(figsize=(10.0, 1.9 + 0.42 * len(rows)), layout="constrained")
    figure.suptitle(picture_text(title))
    left, right = figure.subplots(1, 2, sharey=True)
    figures = np.array([row for _, row in rows])
    _bars(left, figures[:, 1], figures[:, 0], TRANSLATION, "#20639b")
    _bars(right, figures[:, 3], figures[:, 2], ROTATION, "#3c8d5a")
    left.set_yticks(np.arange(len(rows)), [name for name, _ in rows])
    left.set_ylim(len(rows) - 0.4, -0.6)
    return figure


def _bars(axes: Axes, low: np.ndarray, high: np.ndarray, quantity: Quantity, colour: str) -> None:
    """Draw a bar from `low` to `high` for each row, with both numbers beside it."""
    low, high = low * quantity.factor, high * quantity.factor
    number = np.arange(len(low))
    least = 0.004 * high.max()  # makes a bar visible even if `low` equals `high`
    axes.barh(number, np.maximum(high - low, least), left=low, height=0.55, color=colour)
    for row, (start, end) in enumerate(zip(low, high, strict=True)):
        shown = f"{start:.3g}" if start > 1e-3 * high.max() else "≈ 0"
        axes.annotate(f"{shown} – {end:.3g}", (end, row), (4, 0), textcoords="offset points", va="center")
    axes.set_xlim(0.0, 1.28 * high.max())
    axes.set(title=quantity.name, xlabel=f"minimum – maximum over the workspace, {quantity.unit}")
    axes.grid(False, axis="y")


def _space(figure: Figure, place: SubplotSpec, title: str, elevation: float = VIEW_ELEVATION) -> Any:
    """Return 3-D axes that draw objects in the order in which they are added."""
    axes: Any = figure.add_subplot(place, projection="3d", computed_zorder=False)
    axes.view_init(elev=elevation, azim=VIEW_AZIMUTH)
    axes.set(xlabel="x in work, mm", ylabel="y in work, mm", zlabel="z in work, mm", title=title)
    axes.locator_params(nbins=5)
    return axes


def _draw(axes: Any, geometry: HexapodGeometry, faces: np.ndarray, colours: np.ndarray, machine: bool = False) -> None:
    """Draw the machine at home, whole if `machine`, else its platform only; draw `faces`, (F, 4, 3), m, in front."""
    lines = [line * 1e3 for line in outline(geometry)]
    drawn = lines if machine else lines[1:2]
    for line in drawn:
        body = len(line) > 2
        axes.plot(*line.T, color="black" if body else "#777777", lw=1.8 if body else 1.3, zorder=1)
    # Matplotlib sorts faces by distance only within a collection.
    edges: dict[str, Any] = {"edgecolors": colours if machine else (0.0, 0.0, 0.0, 0.12), "lw": 0.3}
    axes.add_collection3d(Poly3DCollection(faces * 1e3, facecolors=colours, zorder=2, **edges))
    everything = np.concatenate([*drawn, faces.reshape(-1, 3) * 1e3])
    low, high = everything.min(axis=0), everything.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=0.88)  # room for the labels


def _faces(points: np.ndarray, wedge: float) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Return the faces of a mesh, (F, 4, 3), and their indices, but no faces in a front wedge of `wedge` degrees."""
    quads = np.stack([points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]], axis=2)
    away = quads.mean(axis=2) - points.reshape(-1, 3).mean(axis=0)
    turn = np.rad2deg(np.arctan2(away[..., 1], away[..., 0])) - VIEW_AZIMUTH
    kept = np.abs((turn + 180.0) % 360.0 - 180.0) >= 0.5 * wedge
    where = np.nonzero(kept)
    return quads[where], (where[0], where[1])


def _of_faces(values: np.ndarray, corners: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the mean of each face's four corner values; `corners` are the indices of each face's first corner."""
    i, j = corners
    return 0.25 * (values[i, j] + values[i, j + 1] + values[i + 1, j + 1] + values[i + 1, j])
