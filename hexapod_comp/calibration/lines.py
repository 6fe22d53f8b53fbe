"""Scheme ``lines``, Mou & King's: a polynomial along each measured grid line, separate for forward and backward.

A laser's zero relative to the next line's is not known, nor the slope of a straightness beam. So the mean of both
directions of a displacement along a line, and of rotations, is set to zero at home's coordinate along the line; each
direction keeps half of the backlash. From a straightness its least-squares line is subtracted. The position and bending
of the planes through home (1-D data), or the squareness of the axes and the twists of the planes (5-D data) remain in
the machine.

The three families of a field add up, but all cross in the grid's nodes and see the same errors there. So each component
belongs first to one family (a displacement to the lines along it; a rotation to the first of x, y, z that reads it as
pitch or yaw); the others share one polynomial for its residual, averaged over lines that differ only in the first
family's coordinate. On twenty virtual machines the residual was 18.1 µm of 27.9; 18.3 where all readings were added.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date as calendar
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Legendre, Polynomial, legendre

from ..errors import CalibrationError
from ..machine.arrays import rms
from ..machine.field import COMPONENTS, CROSS_AXES, GridField
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.model import MachineModel, ModelOrigin, RealMachine
from ..machine.region import Region
from ..machine.temperatures import REFERENCE_TEMPERATURE
from ..measurements.readings import AXES, CHANNELS, KINDS, LEAST_NOISE, LEAST_TRAVEL, MeasurementSet, refuse_unmoved
from ..pose import Pose
from ..virtual.instruments import station_errors
from .assumptions import ASSUMED
from .datum import HeldDatum, hold

# Commands further off the nominal lengths than this, m, are a compensation's; than that, worth a note
COMPENSATED, FOLLOWED = 10e-6, 0.1e-6
# A line of 17 points gets at most 5 coefficients, one of 9 gets 3: no more than the readings can carry
POINTS_PER_COEFFICIENT = 3
FEWEST_POINTS = 2 * POINTS_PER_COEFFICIENT  # below this not even a straight line is possible
# Repeated readings may scatter by this factor more than stated, and readings may lie this far off their polynomial,
# which leaves out the screws' waves (on the shipped machine 15 times a rotation's noise)
MISFIT, LINES_MISFIT = 10.0, 100.0
DIRECTIONS = (1, -1)  # forward, backward: the order of a field's polynomials


@dataclass(frozen=True)
class LineFit:
    """One polynomial and the quality of its fit."""

    name: str  # of the line, or of the lines that share the polynomial
    axis: int  # along which it runs
    nodes: tuple[tuple[int, int], ...]  # indices across, in the order of CROSS_AXES, of each line that it represents
    component: int  # index into machine.field.COMPONENTS
    direction: int  # 1, -1, or 0 for a line that was read in one direction, or in none, and represents both
    coordinates: np.ndarray  # (n,), along the axis, m in base
    values: np.ndarray  # (n,), mean readings minus the datum and the other families' part, m or rad
    coefficients: np.ndarray  # (order + 1,), powers of u, which runs from -1 to 1 over the box
    r2: float
    adjusted_r2: float
    residual_std: float  # with n - order - 1 degrees of freedom, m or rad
    repeat_std: float  # of one reading about its mean over the repeated ones; NaN where nothing was repeated

    @property
    def order(self) -> int:
        """Order of the polynomial."""
        return len(self.coefficients) - 1


@dataclass(frozen=True)
class LinesFit:
    """Result of scheme ``lines`` for a machine's readings."""

    model: MachineModel  # the field; the rest is nominal, except the base if holding the datum moves it
    lines: tuple[LineFit, ...]
    notes: tuple[str, ...]  # notes on odd, omitted or assumed inputs
    held: HeldDatum
    misfit: str = ""  # why the model is not to be trusted: repeats that scatter, or readings far off their polynomials


def fit_lines(
    measurements: MeasurementSet,
    order: int | None = None,
    date: str = "",
    name: str = "",
    datum: Pose | None = None,
) -> LinesFit:
    """Fit Mou & King's polynomials to a rectangular grid of lines; None: of the orders with the largest adjusted R²."""
    readings, notes = _grid_readings(measurements)
    grid = _grid_of(readings)
    readings = readings._replace(node=_nearest_nodes(readings.point, grid))
    _check_complete(readings, grid)
    zero, remark = _datum_of(measurements, grid)
    notes += remark
    field, fits = _fit_families(readings, GridField(grid, _no_lines(grid), probe=measurements.probe), order, zero)
    notes += _fit_notes(fits, order)
    groups = np.unique(np.stack([measurements.run, measurements.channel]), axis=1, return_inverse=True)[1].ravel()
    means = np.bincount(groups, measurements.value) / np.bincount(groups)
    left = measurements.value - means[groups]
    if np.abs(left).max() <= LEAST_NOISE:  # one kind without noise among others does not harm this scheme
        refuse_unmoved(measurements, left)
    chosen = "of an order chosen by adjusted-r2" if order is None else f"of order {order}"
    note = (
        f"Scheme lines (Mou & King 1998): polynomials {chosen} along grid lines. Datum: displacements and rotations "
        "are zero (mean of both directions) at home's coordinate along each line; straightness without its straight "
        "line."
    )
    model = MachineModel(
        machine=measurements.geometry.name,
        name=name or f"lines, {'5-D' if (readings.component >= 3).any() else '1-D'}",
        field=field,
        region=Region(np.array([[nodes[0] for nodes in grid], [nodes[-1] for nodes in grid]]), measurements.probe),
        origin=ModelOrigin(date or calendar.today().isoformat(), measurements.files, None, note),
    )
    notes = list(dict.fromkeys((*measurements.notes, *notes)))
    model, held = hold(measurements.geometry, model, measurements.geometry.home if datum is None else datum, np.eye(6))
    return LinesFit(model, tuple(fits), tuple(notes), held, _misfit(measurements, fits))


def _misfit(measurements: MeasurementSet, fits: Sequence[LineFit]) -> str:
    """Return :attr:`LinesFit.misfit`."""
    repeated: dict[int, float] = {}
    left: dict[int, float] = {}
    for kind in np.unique(measurements.kind):
        members = [fit for fit in fits if _kind(fit) == KINDS[kind]]
        for spread, values in (
            (repeated, [fit.repeat_std for fit in members if np.isfinite(fit.repeat_std)]),
            (left, [fit.residual_std for fit in members]),
        ):
            if values:
                spread[int(kind)] = rms(values)
    return measurements.misfit(repeated, MISFIT) or measurements.misfit(left, LINES_MISFIT)


def _kind(fit: LineFit) -> str:
    """Return the kind of channel that a polynomial was fitted to."""
    if fit.component >= 3:
        return "rotation"
    return "linear" if fit.component == fit.axis else "straightness"


# Readings on the grid


class Readings(NamedTuple):
    """Readings on grid lines; every array has one entry a reading."""

    axis: np.ndarray  # of the line
    component: np.ndarray
    direction: np.ndarray
    run: np.ndarray
    cycle: np.ndarray
    point: np.ndarray  # (N, 3), commanded place of the measured point in base, m
    node: np.ndarray  # (N, 3), nearest node along each axis; along the line itself without meaning
    value: np.ndarray  # m or rad
    sloping: np.ndarray  # whether the beam's slope is unknown

    def select(self, mask: np.ndarray) -> Readings:
        """Return those in a mask or at indices."""
        return Readings(*(array[mask] for array in self))


def _grid_readings(measurements: MeasurementSet) -> tuple[Readings, list[str]]:
    """Return the readings on lines parallel to an axis, and notes on omitted ones."""
    m = measurements
    axis_of_run = np.array([-1 if run.base_axis is None else run.base_axis for run in m.runs])
    axis = axis_of_run[m.run]
    notes = []
    others = [m.runs[r].name for r in np.unique(m.run[axis < 0])]
    if others:
        what = "not parallel to an axis of base; scheme lines has no use for them"
        notes.append(f"{len(others)} runs are {what} (first: {others[0]})")
    if (axis < 0).all():
        raise CalibrationError("grid lines", "there are none: no run is parallel to an axis of base")
    component = _components(m, axis >= 0)
    along_itself = (component == axis) & (m.channel != CHANNELS.index("linear"))
    if along_itself.any():
        notes.append("straightness along the line itself was left out")
    kept = np.flatnonzero((axis >= 0) & ~along_itself)
    axis, station = axis[kept], m.station[kept]
    rotations = m.stations.rotations[station]
    if np.abs(rotations - rotations[0]).max() > 1e-9:
        raise CalibrationError("grid lines", "must all be read at one attitude of the platform: the field has none")
    low, high = m.stations.temperatures[station].min(), m.stations.temperatures[station].max()
    if max(REFERENCE_TEMPERATURE - low, high - REFERENCE_TEMPERATURE) > ASSUMED.least_warming:
        notes.append(f"read at {low:.1f} to {high:.1f} °C; scheme lines models this growth as an error at 20 °C")
    notes += _command_note(m, np.unique(station))
    direction = m.stations.sense[station, axis].astype(int)
    node = np.zeros((len(kept), 3), dtype=int)
    value = _of_the_model(m)[kept] * np.sign(m.directions()[kept, component[kept]])
    sloping = m.kind[kept] == KINDS.index("straightness")
    point = m.points()[station]
    return Readings(axis, component[kept], direction, m.run[kept], m.cycle[kept], point, node, value, sloping), notes


def _of_the_model(measurements: MeasurementSet) -> np.ndarray:
    """Return readings without the effect of the screws' turning, shape (N,), m or rad."""
    m = measurements
    if not m.geometry.screw_lead.any():
        return m.value
    turning = station_errors(m, RealMachine(m.geometry, MachineModel(m.geometry.name)))
    return m.value - (m.directions() * turning[m.station]).sum(axis=1)


def _components(measurements: MeasurementSet, wanted: np.ndarray) -> np.ndarray:
    """Return the index of each reading's component of six, shape (N,), −1 where a mask excludes it."""
    weights = np.abs(measurements.directions())
    turned = wanted & (weights.max(axis=1) < 1.0 - 1e-9)
    if turned.any():
        run = measurements.runs[measurements.run[turned.argmax()]]
        turned_by = np.degrees(np.arccos(np.clip(weights[turned.argmax()].max(), -1.0, 1.0)))
        problem = f"is read across axes that are turned against those of base by {turned_by:.3g}°"
        raise CalibrationError(
            f"run {run.name}", f"{problem}; scheme lines needs a work frame parallel to base, scheme joint does not"
        )
    return np.where(wanted, weights.argmax(axis=1), -1)


def _command_note(measurements: MeasurementSet, stations: np.ndarray) -> list[str]:
    """Return a note on commands that were not quite nominal; refuse a machine that was compensated."""
    there, nominal = measurements.stations, Structure.of(measurements.geometry)
    lengths = strut_lengths_batch(nominal, there.positions[stations], there.rotations[stations])
    most = float(np.abs(there.commands[stations] - lengths).max())
    if most > COMPENSATED:
        problem = f"were read under strut commands up to {most * 1e6:.1f} µm off the nominal lengths: compensated?"
        raise CalibrationError("grid lines", f"{problem} Scheme lines needs the machine as it is")
    if most <= FOLLOWED:
        return []
    return [f"strut commands are up to {most * 1e6:.2f} µm off the nominal lengths, and are taken for nominal"]


def _distinct(values: np.ndarray) -> np.ndarray:
    """Return the sorted values, of those closer than :data:`LEAST_TRAVEL` only the first."""
    ordered = np.unique(values)
    return ordered[np.append(True, np.diff(ordered) > LEAST_TRAVEL)]


def _grid_of(readings: Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nodes along x, y, z, m: the places of the lines, or their ends where none crosses."""
    grid = []
    for axis, name in enumerate(AXES):
        along = readings.point[readings.axis == axis, axis]
        across = readings.point[readings.axis != axis, axis]
        nodes = _distinct(across) if len(across) else np.array([along.min(), along.max()])
        if len(nodes) < 2:
            raise CalibrationError("grid", f"lines stand at one {name} only ({nodes[0] * 1e3:g} mm); two are needed")
        grid.append(nodes)
    return grid[0], grid[1], grid[2]


def _nearest_nodes(points: np.ndarray, grid: Sequence[np.ndarray]) -> np.ndarray:
    """Return the index of the node nearest to each point along each axis, shape (N, 3)."""
    columns = [np.abs(points[:, axis, None] - nodes).argmin(axis=1) for axis, nodes in enumerate(grid)]
    return np.stack(columns, axis=1)


def _line_name(grid: Sequence[np.ndarray], axis: int, node: Sequence[int]) -> str:
    places = zip(CROSS_AXES[axis], node, strict=True)
    return f"{AXES[axis]} line at " + ", ".join(f"{AXES[a]} {grid[a][n] * 1e3:.1f}" for a, n in places) + " mm"


def _check_complete(readings: Readings, grid: Sequence[np.ndarray]) -> None:
    """Refuse a family of which a line, a channel of a line, or a line's end is missing."""
    for axis in np.unique(readings.axis):
        family = readings.select(readings.axis == axis)
        every = set(product(*(range(len(grid[a])) for a in CROSS_AXES[axis])))
        for component in np.unique(family.component):
            rows = family.component == component
            there = {(int(i), int(j)) for i, j in family.node[rows][:, CROSS_AXES[axis]]}
            if every - there:
                first = _line_name(grid, axis, min(every - there))
                what = f"{COMPONENTS[component]} on the {first}"
                missing = f"of {len(every)} lines of the rectangular grid {len(every - there)} were not measured"
                raise CalibrationError(what, f"is missing; {missing}")
        _check_ends(family, int(axis), grid)


def _check_ends(family: Readings, axis: int, grid: Sequence[np.ndarray]) -> None:
    """Refuse a line that ends within the grid: a polynomial is not valid beyond its readings."""
    low, high = grid[axis][0], grid[axis][-1]
    for node in sorted({(int(i), int(j)) for i, j in family.node[:, CROSS_AXES[axis]]}):
        on_line = (family.node[:, CROSS_AXES[axis]] == node).all(axis=1)
        reach = family.point[on_line, axis]
        if reach.min() > low + LEAST_TRAVEL or reach.max() < high - LEAST_TRAVEL:
            problem = f"is read from {reach.min() * 1e3:.1f} to {reach.max() * 1e3:.1f} mm"
            wanted = f"the grid reaches from {low * 1e3:.1f} to {high * 1e3:.1f} mm"
            raise CalibrationError(_line_name(grid, axis, node), f"{problem}, but {wanted}")


def _datum_of(measurements: MeasurementSet, grid: Sequence[np.ndarray]) -> tuple[np.ndarray, list[str]]:
    """Return the point where each line is zero, shape (3,), m in ``base``: home's place of the measured point."""
    home = measurements.geometry.home
    point = home.position + home.rotation @ measurements.probe
    datum = np.array([min(max(p, nodes[0]), nodes[-1]) for p, nodes in zip(point, grid, strict=True)])
    beyond = [name for name, p, d in zip(AXES, point, datum, strict=True) if abs(p - d) > LEAST_TRAVEL]
    if not beyond:
        return datum, []
    return datum, [f"home lies outside the box along {', '.join(beyond)}: lines are zeroed at their end nearest to it"]


# From readings to polynomials


def _priority(component: int, readings: Readings) -> list[int]:
    """Return the families that read a component: first the one that it belongs to."""
    own = component % 3
    measured = [int(axis) for axis in np.unique(readings.axis)]
    # A displacement is best seen along its own axis; a rotation there is roll, and comes last.
    return sorted(measured, key=lambda axis: (axis == own) if component >= 3 else (axis != own))


def _fit_families(
    readings: Readings, empty: GridField, order: int | None, datum: np.ndarray
) -> tuple[GridField, list[LineFit]]:
    """Return the field and its polynomials: component by component, the family that it belongs to first."""
    field, fits = empty, []
    for component in range(6):
        members = readings.select(readings.component == component)
        for axis in _priority(component, members):
            fitted = _fit_family(members, component, axis, field, order, datum)
            field = _with_family(field, axis, fitted)
            fits += fitted
    return field, fits


def _fit_family(
    readings: Readings, component: int, axis: int, field: GridField, order: int | None, datum: np.ndarray
) -> list[LineFit]:
    """Return the polynomials of the lines along an axis for one component; `field` has the families before this one."""
    family = readings.select(readings.axis == axis)
    first = _priority(component, readings)[0]
    # Lines whose differences the first family has predicted share the residual.
    shared = None if axis == first else first
    family = family._replace(value=family.value - _predicted(field, family, component))
    fits = []
    for nodes, group in _groups(family, axis, field.grid, shared):
        name = _line_name(field.grid, axis, nodes[0])
        if len(nodes) > 1:
            name += f" and {len(nodes) - 1} beside it along {AXES[first]}"
        fits += _fit_line(group, name, nodes, field.grid[axis], order, datum[axis])
    return fits


def _fit_notes(fits: Sequence[LineFit], order: int | None) -> list[str]:
    """Return notes on lines that were read in one direction only, or with too few points for the requested order."""
    notes = []
    one_way = list(dict.fromkeys(fit.name for fit in fits if fit.direction == 0))
    if one_way:
        what = "not read in both directions; what was read is used for both"
        notes.append(f"{len(one_way)} lines were {what} (first: {one_way[0]})")
    short = [fit for fit in fits if order is not None and fit.order < order]
    if short:
        what = f"too few points for order {order} and got the highest that they carry"
        notes.append(f"{len(short)} polynomials have {what} (first: {short[0].name}, order {short[0].order})")
    return notes


def _predicted(field: GridField, readings: Readings, component: int) -> np.ndarray:
    """Return the errors that a field predicts for readings, shape (N,); an axis at rest has no direction."""
    predicted = np.zeros(len(readings.value))
    if not any(family[:, :, :, component].any() for family in field.lines):
        return predicted
    for n, (point, axis, direction) in enumerate(zip(readings.point, readings.axis, readings.direction, strict=True)):
        sense = np.zeros(3)
        sense[axis] = direction
        predicted[n] = field.evaluate(point, sense)[0][component]
    return predicted


def _groups(
    family: Readings, axis: int, grid: Sequence[np.ndarray], shared: int | None
) -> Iterator[tuple[tuple[tuple[int, int], ...], Readings]]:
    """Yield the nodes and readings of every line, or of all lines that differ along one axis only."""
    cross = CROSS_AXES[axis]
    every = list(product(*(range(len(grid[a])) for a in cross)))
    together: dict[tuple[int, ...], list[tuple[int, int]]] = {}
    for node in every:
        key = tuple(n for a, n in zip(cross, node, strict=True) if a != shared)
        together.setdefault(key, []).append((node[0], node[1]))
    for key, nodes in together.items():
        kept = [a for a in cross if a != shared]
        yield tuple(nodes), family.select((family.node[:, kept] == key).all(axis=1))


def _fit_line(
    group: Readings, name: str, nodes: tuple[tuple[int, int], ...], along: np.ndarray, order: int | None, datum: float
) -> list[LineFit]:
    """Return the polynomials of a line's directions: two, or one when it was read in one direction only."""
    axis, component = int(group.axis[0]), int(group.component[0])
    ways = sorted(set(group.direction.tolist()) - {0}, reverse=True) or [0]
    group = group.select(np.isin(group.direction, ways))  # readings without direction are not used beside others
    u = _parameter(group.point[:, axis], along)
    values = _without_run_zeros(group, u, ways)
    place, number = _places(group.point[:, axis])
    beside = np.unique(group.node[:, CROSS_AXES[axis]], axis=0, return_inverse=True)[1].ravel()
    means = {}
    for way in ways:
        rows = group.direction == way
        means[way] = (
            _averaged(values[rows], number[rows], len(place)),
            _spread(values[rows], number[rows], beside[rows]),
        )
    if group.sloping.any():
        means = _straightened(means, _parameter(place, along))
    fits = []
    for way, (mean, repeat) in means.items():
        read = np.isfinite(mean)
        line = _regress(_parameter(place[read], along), mean[read], order, name, float(along[-1] - along[0]))
        fits.append(LineFit(name, axis, nodes, component, way, place[read], mean[read], *line, repeat))
    if not group.sloping.any():
        fits = _zeroed(fits, float(_parameter(np.array(datum), along)))
    return fits if len(fits) == 2 else [replace(fits[0], direction=0)]


def _parameter(coordinate: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return u, −1 at the first and 1 at the last node, of coordinates along an axis."""
    return (2.0 * coordinate - along[0] - along[-1]) / (along[-1] - along[0])


def _places(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the _distinct places on a line, and each reading's index among them."""
    places = _distinct(coordinates)
    return places, np.abs(coordinates[:, None] - places).argmin(axis=1)


def _without_run_zeros(group: Readings, u: np.ndarray, ways: Sequence[int]) -> np.ndarray:
    """Return values in which the runs have a common zero (and slope, where a beam's is unknown)."""
    runs, run = np.unique(group.run, return_inverse=True)
    if len(runs) == 1:
        return group.value
    powers = max(1, len(_distinct(u)) // POINTS_PER_COEFFICIENT)
    shape = legendre.legvander(u, powers - 1)
    smooth = np.concatenate([shape * (group.direction == way)[:, None] for way in ways], axis=1)
    unknown = (run[:, None] == np.arange(len(runs))).astype(float)
    if group.sloping.any():
        unknown = np.concatenate([unknown, unknown * u[:, None]], axis=1)
    solution = np.linalg.lstsq(np.concatenate([smooth, unknown], axis=1), group.value, rcond=None)[0]
    return group.value - unknown @ solution[smooth.shape[1] :]


def _averaged(values: np.ndarray, number: np.ndarray, places: int) -> np.ndarray:
    """Return the mean reading at each place, NaN where there is none."""
    count = np.bincount(number, minlength=places)
    total = np.bincount(number, weights=values, minlength=places)
    return np.where(count, total / np.maximum(count, 1), np.nan)


def _spread(values: np.ndarray, number: np.ndarray, line: np.ndarray) -> float:
    """Return the standard deviation of readings about their mean at a place of one line; NaN where none is repeated."""
    repeats = np.unique(np.stack([line, number]), axis=1, return_inverse=True)[1].ravel()
    freedom = len(values) - (int(repeats.max()) + 1)
    left = values - _averaged(values, repeats, int(repeats.max()) + 1)[repeats]
    return float(np.sqrt((left**2).sum() / freedom)) if freedom else float("nan")


def _straightened(means: dict[int, tuple[np.ndarray, float]], u: np.ndarray) -> dict[int, tuple[np.ndarray, float]]:
    """Return mean readings less the straight line through all of them, both directions together."""
    values = np.concatenate([mean for mean, _ in means.values()])
    places = np.tile(u, len(means))
    read = np.isfinite(values)
    line = Polynomial.fit(places[read], values[read], 1, domain=[-1.0, 1.0])
    return {way: (mean - line(u), repeat) for way, (mean, repeat) in means.items()}


def _zeroed(fits: list[LineFit], u: float) -> list[LineFit]:
    """Return a line's polynomials and readings shifted so that the mean of its directions is zero at u."""
    zero = float(np.mean([np.polynomial.polynomial.polyval(u, fit.coefficients) for fit in fits]))
    shifted = []
    for fit in fits:
        coefficients = fit.coefficients.copy()
        coefficients[0] -= zero
        shifted.append(replace(fit, coefficients=coefficients, values=fit.values - zero))
    return shifted


def _regress(
    u: np.ndarray, values: np.ndarray, order: int | None, name: str, reach: float
) -> tuple[np.ndarray, float, float, float]:
    """Return coefficients in powers of u, R², adjusted R² and the standard deviation of the residuals."""
    count = len(u)
    if count < FEWEST_POINTS:
        span = f"{count} points in a direction, over {1e3 * reach:.4g} mm"
        wanted = f"{FEWEST_POINTS} are needed: one every {1e3 * reach / (FEWEST_POINTS - 1):.4g} mm or closer"
        raise CalibrationError(name, f"has {span}; {wanted} (step_mm of a campaign)")
    most = count // POINTS_PER_COEFFICIENT - 1
    orders = range(most + 1) if order is None else [min(order, most)]
    candidates = [_polynomial(u, values, k) for k in orders]
    best = max(candidates, key=lambda fit: fit[2])  # the first of equals: the lowest order
    return legendre.leg2poly(best[0].coef), *best[1:]


def _polynomial(u: np.ndarray, values: np.ndarray, order: int) -> tuple[Legendre, float, float, float]:
    """Return a polynomial of an order with R², adjusted R² and the residuals' standard deviation."""
    fit = Legendre.fit(u, values, order, domain=[-1.0, 1.0])
    rest = float(((values - fit(u)) ** 2).sum())
    total = float(((values - values.mean()) ** 2).sum())
    freedom = len(u) - order - 1
    r2 = 1.0 - rest / total if total > 0.0 else 1.0
    return fit, r2, 1.0 - (1.0 - r2) * (len(u) - 1) / freedom, float(np.sqrt(rest / freedom))


# From polynomials to the field


def _no_lines(grid: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three families that were not measured."""
    first, second, third = (np.zeros((2, len(grid[a]), len(grid[b]), 6, 0)) for a, b in CROSS_AXES)
    return first, second, third


def _with_family(field: GridField, axis: int, fits: Sequence[LineFit]) -> GridField:
    """Return a field to whose family along an axis some polynomials were added."""
    old = field.lines[axis]
    powers = max(old.shape[4], *(len(fit.coefficients) for fit in fits))
    family = np.zeros((*old.shape[:4], powers))
    family[..., : old.shape[4]] = old
    for fit in fits:
        rows = [d for d, way in enumerate(DIRECTIONS) if fit.direction in (way, 0)]
        for (i, j), d in product(fit.nodes, rows):
            family[d, i, j, fit.component, : len(fit.coefficients)] = fit.coefficients
    lines = [family if a == axis else other for a, other in enumerate(field.lines)]
    return replace(field, lines=(lines[0], lines[1], lines[2]))
