"""Figures of calibrations: strut errors, polynomials of scheme lines, residuals, and maps of the tool error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ..core.batch import strut_errors
from ..errors import CalibrationError, ModelError
from ..formats.figures import LEAST_SHOWN, SIX_COLOURS, WITH, WITHOUT, picture_text
from ..machine.field import COMPONENTS, CROSS_AXES
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import MachineModel, RealMachine, commanded_box
from ..machine.passes import Passes, level_attitude
from ..machine.trial import Trial
from ..measurements.readings import AXES, KINDS
from .fit import ModelFit
from .lines import LineFit, LinesFit
from .posterior import COMPONENTS as PREDICTED
from .posterior import ErrorPredictor, FittedParameters

SAMPLES = 161
MAP_NODES = 21  # nodes of a map along x, and along y
ARROWS = {1: "→", -1: "←"}


def strut_length_errors(
    geometry: HexapodGeometry, model: MachineModel, along_x: np.ndarray, y: float, z: float
) -> np.ndarray:
    """Return Mou & King's ΔL = L_actual − L_ideal, m, of a level tool along x in work: (forward and backward, n, 6)."""
    points = np.stack([along_x, np.full_like(along_x, y), np.full_like(along_x, z)], axis=1)
    level = np.tile(level_attitude(geometry), (len(points), 1, 1))
    nominal = Structure.of(geometry)
    errors = []
    for way in ARROWS:
        passes = Passes.of_tool(geometry, points, level, np.tile([float(way), 0.0, 0.0], (len(points), 1)))
        driven = Trial(RealMachine(geometry, model), passes).drive(passes.nominal_commands())
        errors.append(strut_lengths_batch(nominal, *driven.actual) - passes.nominal_commands())
    return np.array(errors)


def strut_error_figure(geometry: HexapodGeometry, models: Mapping[str, MachineModel], y: float | None = None) -> Figure:
    """Plot the six struts' length errors along x, forward (a) and backward (b), as Mou & King's Figures 3 and 4."""
    if not models or any(model.measured is None for model in models.values()):
        raise CalibrationError("picture of strut errors", "needs at least one model, each with its measured box")
    box = commanded_box(geometry, next(iter(models.values())))
    line = box.mean(axis=0)[1:]
    line[0] = line[0] if y is None else y
    along = np.linspace(box[0, 0], box[1, 0], SAMPLES)
    figure = Figure(figsize=(11, 3.8 * len(models)), layout="constrained")
    rows = figure.subplots(len(models), 2, squeeze=False, sharex=True, sharey="row")
    for panels, (title, model) in zip(rows, models.items(), strict=True):
        errors = strut_length_errors(geometry, model, along, *line)
        for axes, lengths, letter, way in zip(panels, errors, "ab", ("forward →", "backward ←"), strict=True):
            for name, colour, values in zip(STRUT_NAMES, SIX_COLOURS, lengths.T, strict=True):
                axes.plot(along * 1e3, values * 1e6, color=colour, lw=1.3, label=name)
            text = f"{picture_text(title)}, ({letter}) {way}"
            axes.set(title=text, xlabel="x in work, mm", ylabel="ΔL = actual − ideal, µm")
    figure.legend(*rows[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.suptitle(f"Strut length error along x in work, at y = {line[0] * 1e3:g} mm, z = {line[1] * 1e3:g} mm")
    return figure


def fitted_lines_figure(fit: LinesFit, axis: int = 0, component: int | None = None) -> Figure:
    """Plot the mean readings and the polynomials of one component on all lines along an axis."""
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
    for axes in panels[-1]:
        axes.set_xlabel(f"{AXES[axis]} in work, mm")
    for axes in panels[:, 0]:
        axes.set_ylabel("µm" if component < 3 else "µrad")
    panels[0, 0].legend(fontsize=6)
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


def pictures_of(fit: ModelFit | LinesFit) -> dict[str, Figure]:
    geometry = fit.measurements.geometry
    if isinstance(fit, ModelFit):
        figures, known, title = {"fit.png": fit_figure(fit)}, fit.parameters, "scheme joint"
        if fit.model.region is None:
            return figures
        figures["left.png"] = before_after_figure(fit)
    else:
        first, known, title = fit.lines[0], None, fit.model.name  # not every grid has lines along x
        figures = {"lines.png": fitted_lines_figure(fit, first.axis, first.component)}
    figures["strut_errors.png"] = strut_error_figure(geometry, {title: fit.model})
    figures["predicted_error.png"] = predicted_error_figure(RealMachine(geometry, fit.model), known)
    return figures


def fit_figure(fit: ModelFit) -> Figure:
    """Plot histograms of a joint fit's residuals by kind of channel, and each strut's pitch error and length map."""
    figure, geometry = Figure(figsize=(11, 4.2), layout="constrained"), fit.measurements.geometry
    left, right = figure.subplots(1, 2)
    edges = np.linspace(-5.0, 5.0, 51)
    for channel in fit.channels:
        residuals = fit.solution.residuals[fit.measurements.kind == KINDS.index(channel.kind)] / channel.found
        label = f"{channel.kind}, {channel.readings}"
        left.hist(np.clip(residuals, -5.0, 5.0), edges.tolist(), density=True, histtype="step", label=label)
    left.plot(edges, np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi), "k:", lw=1.0, label="normal")
    left.set(title="residuals", xlabel="residual over the noise found", ylabel="density")
    left.legend(fontsize=7)
    struts, commands = fit.model.struts, fit.measurements.stations.commands
    even = replace(struts, cosine=np.zeros_like(struts.cosine), sine=np.zeros_like(struts.sine))
    machine = RealMachine(geometry, replace(fit.model, struts=even))
    waves = np.hypot(struts.cosine, struts.sine).max(axis=1)
    for strut, name in enumerate(STRUT_NAMES):
        at = np.linspace(commands[:, strut].min(), commands[:, strut].max(), 4 * SAMPLES)
        errors, _ = strut_errors(machine.state, strut, 0.0, at)
        label = f"{name}, wave ±{waves[strut] * 1e6:.1f} µm" if waves.any() else name
        right.plot(at * 1e3, (errors - struts.offset[strut]) * 1e6, lw=1.2, color=SIX_COLOURS[strut], label=label)
    right.set(title="strut errors: pitch and length map", xlabel="command, mm", ylabel="error, µm")
    right.legend(ncols=2, fontsize=7)
    figure.suptitle(f"{picture_text(geometry.name)}: scheme joint, {len(fit.measurements)} readings")
    return figure


def before_after_figure(fit: ModelFit) -> Figure:
    """Map the RMS tool error before compensation, and that expected after it, at three heights of the box.

    The RMS is over both directions of motion along x, for a level tool, after best-fit alignment.
    """
    space, geometry = fit.space, fit.measurements.geometry
    low, high = space.work_box
    x, y = (np.linspace(low[a], high[a], MAP_NODES) for a in range(2))
    heights = np.linspace(low[2], high[2], 3)
    points = np.stack(np.meshgrid(heights, y, x, indexing="ij"), axis=-1)[..., ::-1].reshape(-1, 3)
    level, along_x = np.tile(space.level, (len(points), 1, 1)), np.tile(geometry.work.rotation[:, 0], (len(points), 1))
    passes = Passes(geometry, space.places(points) - space.level @ space.probe, level, along_x).both_ways()
    predictor = ErrorPredictor(RealMachine(geometry, fit.model), fit.parameters)
    aligned = predictor.predict(passes.poses, passes.senses())[1]
    if aligned is None or aligned.covariance is None:
        raise CalibrationError("picture of the error in space", "needs readings that span a box")
    squares = (aligned.values[:, :3] ** 2).sum(axis=1), np.trace(aligned.covariance[:, :3, :3], axis1=1, axis2=2)
    before, after = (1e6 * np.sqrt(part.reshape(2, 3, MAP_NODES, MAP_NODES).mean(axis=0)) for part in squares)
    # It is not known where errors are that no parameter describes: add them everywhere
    unexplained = 0.0 if fit.level is None else (fit.level.after * 1e6) ** 2 - np.nanmean(after**2)
    maps = before, np.sqrt(after**2 + max(unexplained, 0.0))
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    rows = figure.subplots(2, 3, sharex=True, sharey=True)
    sizes = np.maximum(np.array(maps), LEAST_SHOWN)
    scale = LogNorm(float(np.nanmin(sizes)), float(np.nanmax(sizes)))
    for panels, name, values in zip(rows, ("before", "after"), sizes, strict=True):
        for axes, height, layer in zip(panels, heights, values, strict=True):
            drawn = axes.pcolormesh(x * 1e3, y * 1e3, np.ma.masked_invalid(layer), norm=scale, cmap="viridis")
            span = f"{np.nanmin(layer):.3g}…{np.nanmax(layer):.3g} µm" if np.isfinite(layer).any() else "out of reach"
            axes.set(title=f"{name}, z in work = {height * 1e3:.0f} mm: {span}", aspect="equal")
            axes.title.set_fontsize(9)
    for axes in rows[1]:
        axes.set_xlabel("x in work, mm")
    for axes in rows[:, 0]:
        axes.set_ylabel("y in work, mm")
    figure.colorbar(drawn, ax=rows, label="error in space, level tool, after best-fit alignment, µm")
    return figure


def residuals_by_run_figure(fit: ModelFit) -> Figure:
    """Plot residual / stated σ of each reading against its run, in one panel for each kind of channel."""
    m = fit.measurements
    sigmas = fit.solution.residuals / m.stated
    figure = Figure(figsize=(11, 0.6 + 1.7 * len(fit.channels)), layout="constrained")
    panels = figure.subplots(len(fit.channels), 1, squeeze=False, sharex=True)[:, 0]
    for axes, channel in zip(panels, fit.channels, strict=True):
        members = m.kind == KINDS.index(channel.kind)
        runs = np.unique(m.run[members])
        sizes = [np.sqrt((sigmas[members & (m.run == run)] ** 2).mean()) for run in runs]
        axes.plot(m.run[members] + 1, sigmas[members], ".", color="#9a9a9a", ms=2)
        axes.plot(runs + 1, sizes, "_", color=WITHOUT, ms=8, mew=2, label="RMS of the run")
        axes.axhspan(-2.0, 2.0, color=WITH, alpha=0.12, lw=0.0)
        axes.set(ylabel=f"{channel.kind}, σ")
    panels[0].legend(fontsize=7, loc="upper right")
    panels[-1].set_xlabel("run, in the order of the files")
    return figure


def predicted_error_figure(machine: RealMachine, fitted: FittedParameters | None) -> Figure:
    """Map the predicted error of a level tool and its σ, after best-fit alignment, at mid-height of the box."""
    box = commanded_box(machine.geometry, machine.model)
    x, y = (np.linspace(box[0, axis], box[1, axis], MAP_NODES) for axis in range(2))
    height = float(box[:, 2].mean())
    points = np.stack([*np.meshgrid(x, y), np.full((MAP_NODES, MAP_NODES), height)], axis=-1).reshape(-1, 3)
    level = np.tile(level_attitude(machine.geometry), (len(points), 1, 1))
    poses = machine.geometry.platform_poses(points, level)
    aligned = ErrorPredictor(machine, fitted).predict(poses)[1]
    if aligned is None:
        raise ModelError("region", "contains fewer than three poses that the machine reaches")
    figure = Figure(figsize=(11, 7), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    for n, axes in enumerate(panels.ravel()):
        component = PREDICTED[n]
        turn, values = component[0] == "r", np.ma.masked_invalid(aligned.values[:, n].reshape(MAP_NODES, -1) * 1e6)
        most = max(float(np.abs(values).max()), 1e-6)
        drawn = axes.contourf(x * 1e3, y * 1e3, values, np.linspace(-most, most, 21), cmap="PuOr")
        figure.colorbar(drawn, ax=axes, label="µrad" if turn else "µm", shrink=0.65)
        if aligned.deviations is not None:
            sigma = aligned.deviations[:, n].reshape(MAP_NODES, -1) * 1e6
            axes.clabel(axes.contour(x * 1e3, y * 1e3, sigma, 4, colors="black", linewidths=0.6), fontsize=6)
        title = f"rotation about {component[1]}" if turn else f"displacement along {component}"
        axes.set(title=title, aspect="equal")
        if n >= 3:
            axes.set_xlabel("x in work, mm")
        if n % 3 == 0:
            axes.set_ylabel("y in work, mm")
    known = "black lines: one standard deviation" if fitted is not None else "standard deviation not known"
    title = f"{machine.geometry.name}, {machine.model.name}: predicted error of the tool without compensation"
    where = f"z = {height * 1e3:.0f} mm in work, level tool, after best-fit alignment; {known}"
    figure.suptitle(f"{picture_text(title)}\n{where}", fontsize=10)
    return figure
