"""Pictures of calibrations: what a model says of the struts, and how polynomials lie among their readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .calibration.evaluation import Passes, run
from .calibration.lines import LineFit, LinesFit
from .errors import CalibrationError
from .field import COMPONENTS, CROSS_AXES
from .geometry import STRUT_NAMES, HexapodGeometry
from .kinematics import Structure, strut_lengths_batch
from .machine import MachineModel, RealMachine
from .measurement import AXES
from .plotting import WITH, WITHOUT

SAMPLES = 161
"""Points of a curve."""

ARROWS = {1: "→", -1: "←"}


def strut_length_errors(
    geometry: HexapodGeometry, model: MachineModel, along_x: np.ndarray, y: float, z: float
) -> np.ndarray:
    """Return ΔL = L_actual − L_ideal (001) along a line in x, forward and backward, shape (2, n, 6), m.

    L_ideal are the nominal lengths of the commanded pose; L_actual those of the pose to which the machine,
    told L_ideal, really goes as the model has it. To first order the strut correction is −ΔL.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine as designed.
    model : MachineModel
        What is believed of its errors.
    along_x : ndarray, shape (n,)
        Places of the tool in the work frame, m.
    y, z : float
        Where the line stands, m.
    """
    points = np.stack([along_x, np.full_like(along_x, y), np.full_like(along_x, z)], axis=1)
    level = np.tile(np.eye(3), (len(points), 1, 1))
    nominal = Structure.of(geometry)
    errors = []
    for way in ARROWS:
        passes = Passes.of_tool(geometry, points, level, np.tile([float(way), 0.0, 0.0], (len(points), 1)))
        actual = run(RealMachine(geometry, model), passes, None)
        errors.append(
            strut_lengths_batch(nominal, *actual)
            - strut_lengths_batch(nominal, passes.positions, passes.rotations)
        )
    return np.array(errors)


def strut_error_figure(
    geometry: HexapodGeometry,
    models: Mapping[str, MachineModel],
    y: float | None = None,
    z: float | None = None,
) -> Figure:
    """Show 001's Figures 3 and 4: the six struts' length errors along x, forward (a) and backward (b).

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine as designed.
    models : mapping of str to MachineModel
        One row of two panels each, under its title; 001 has a row from 1-D and one from 5-D data.
    y, z : float, optional
        Where the line stands in the work frame, m; the middle of the first model's box by default.

    Raises
    ------
    CalibrationError
        No model, or one without a box: nobody knows how far the line goes.
    """
    boxes = [model.valid_box for model in models.values() if model.valid_box is not None]
    if not models or len(boxes) < len(models):
        raise CalibrationError("picture of strut errors", "needs models, each with the box in which it holds")
    lever = geometry.tool.position
    corners = (boxes[0] @ geometry.work.rotation) + lever - geometry.work.position @ geometry.work.rotation
    box = np.array([corners.min(axis=0), corners.max(axis=0)])
    middle = box.mean(axis=0)
    along = np.linspace(box[0, 0], box[1, 0], SAMPLES)
    line = (middle[1] if y is None else y, middle[2] if z is None else z)
    figure = Figure(figsize=(11, 3.8 * len(models)), layout="constrained")
    rows = figure.subplots(len(models), 2, squeeze=False, sharex=True, sharey="row")
    for panels, (title, model) in zip(rows, models.items(), strict=True):
        errors = strut_length_errors(geometry, model, along, *line)
        for axes, lengths, letter, way in zip(panels, errors, "ab", ("forward →", "backward ←"), strict=True):
            _strut_curves(axes, along, lengths)
            axes.set(title=f"{title}, ({letter}) {way}", xlabel="x, mm", ylabel="ΔL = actual − ideal, µm")
    rows[0, 0].legend(ncols=2, fontsize=7)
    figure.suptitle(f"Strut length error along x at y = {line[0] * 1e3:g} mm, z = {line[1] * 1e3:g} mm")
    return figure


def _strut_curves(axes: Axes, along: np.ndarray, lengths: np.ndarray) -> None:
    for name, values in zip(STRUT_NAMES, lengths.T, strict=True):
        axes.plot(along * 1e3, values * 1e6, lw=1.0, label=name)


def fitted_lines_figure(fit: LinesFit, axis: int = 0, component: int | None = None) -> Figure:
    """Show the polynomials of one family and component among the readings that they were fitted to.

    Parameters
    ----------
    fit : LinesFit
        Result of scheme ``lines``.
    axis : int
        Along which the lines run.
    component : int, optional
        Index into :data:`hexapod_comp.field.COMPONENTS`; the displacement along the lines by default.

    Raises
    ------
    CalibrationError
        The component was not measured on these lines.
    """
    component = axis if component is None else component
    lines = [line for line in fit.lines if (line.axis, line.component) == (axis, component)]
    if not lines:
        raise CalibrationError(f"{COMPONENTS[component]} on {AXES[axis]} lines", "was not fitted")
    rows, columns = (sorted({line.nodes[0][k] for line in lines}) for k in (0, 1))
    figure = Figure(figsize=(2.6 * len(columns) + 1.0, 1.7 * len(rows) + 1.0), layout="constrained")
    panels = figure.subplots(len(rows), len(columns), squeeze=False, sharex=True, sharey=True)
    for line in lines:
        i, j = line.nodes[0]
        _line_panel(panels[rows.index(i), columns.index(j)], line, fit.model.field.grid)
    _label_edges(panels, axis, component)
    figure.suptitle(f"{COMPONENTS[component]} on lines along {AXES[axis]}: mean readings and polynomials")
    return figure


def _line_panel(axes: Axes, line: LineFit, grid: Sequence[np.ndarray]) -> None:
    nodes = grid[line.axis]
    colour, way = (WITH, "forward") if line.direction >= 0 else (WITHOUT, "backward")
    u = np.linspace(-1.0, 1.0, SAMPLES)
    along = 0.5 * (nodes[0] + nodes[-1] + u * (nodes[-1] - nodes[0]))
    axes.plot(line.coordinates * 1e3, line.values * 1e6, ".", color=colour, ms=4)
    curve = np.polynomial.polynomial.polyval(u, line.coefficients)
    axes.plot(along * 1e3, curve * 1e6, color=colour, lw=1.0, label=way)
    places = zip(CROSS_AXES[line.axis], line.nodes[0], strict=True)
    same = {a for k, a in enumerate(CROSS_AXES[line.axis]) if len({node[k] for node in line.nodes}) > 1}
    where = [f"{AXES[a]} {'all' if a in same else f'{grid[a][n] * 1e3:.0f}'}" for a, n in places]
    axes.set_title(", ".join(where), fontsize=7)


def _label_edges(panels: np.ndarray, axis: int, component: int) -> None:
    for axes in panels[-1]:
        axes.set_xlabel(f"{AXES[axis]}, mm")
    for axes in panels[:, 0]:
        axes.set_ylabel("µm" if component < 3 else "µrad")
    panels[0, 0].legend(fontsize=6)
