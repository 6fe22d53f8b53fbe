"""Scheme ``lines`` of Mou & King (1998): a polynomial along each measured grid line for each direction of motion.

Lines along x, y and z cross in the grid's nodes, where all three contain the same errors; :func:`_fit_families` fits
these errors only once. The scheme does not correct errors that displace, bend or twist the coordinate planes through
home, or that change the angles between these planes.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from ..measurements.stations import station_errors
from ..pose import Pose
from .assumptions import ASSUMED
from .datum import HeldDatum, hold

# |strut command − nominal length|, m: above the first, readings are refused; above the second, a note reports it
COMPENSATED, FOLLOWED = 10e-6, 0.1e-6
POINTS_PER_COEFFICIENT = 3  # fewest points for each coefficient of a polynomial: 17 points allow 5 coefficients
FEWEST_POINTS = 2 * POINTS_PER_COEFFICIENT  # fewest points of a line: a straight line has two coefficients
MISFIT = 10.0  # the model is refused if repeated readings scatter by more than this many times the stated noise
LINES_MISFIT = 100.0  # the same for residuals; screw waves, which this scheme does not fit, can reach 15
DIRECTIONS = (1, -1)  # order of a field's polynomials: forward, backward


@dataclass(frozen=True)
class LineFit:
    """One polynomial, and how well it fits."""

    name: str  # of the line, or of all lines that share this polynomial
    axis: int  # index of the axis along which the line runs
    nodes: tuple[tuple[int, int], ...]  # for each of these lines: indices of its nodes on the two CROSS_AXES
    component: int  # of the error: index into machine.field.COMPONENTS
    direction: int  # 1 forward, -1 backward; 0: used for both directions, but read in one only
    coordinates: np.ndarray  # (n,), of the points along the axis, m in base
    values: np.ndarray  # (n,), m or rad: mean readings minus the zero and the polynomials that were fitted before
    coefficients: np.ndarray  # (order + 1,), of powers of u, which is -1…1 over the box
    r2: float
    adjusted_r2: float
    residual_std: float  # m or rad
    repeat_std: float  # standard deviation of repeated readings at one place, m or rad; NaN without repeats

    @property
    def order(self) -> int:
        return len(self.coefficients) - 1


@dataclass(frozen=True)
class LinesFit:
    model: MachineModel  # nominal machine with the field; its base is moved so that the tool has no error at the datum
    measurements: MeasurementSet
    lines: tuple[LineFit, ...]
    notes: tuple[str, ...]  # on omitted readings, and on assumptions
    held: HeldDatum
    misfit: str = ""  # reason to refuse the model, by MISFIT or LINES_MISFIT; empty: none


def fit_lines(measurements: MeasurementSet, date: str = "", name: str = "", datum: Pose | None = None) -> LinesFit:
    """Fit Mou & King's polynomials, with the degrees of largest adjusted R², to a rectangular grid of lines."""
    readings, notes = _grid_readings(measurements)
    grid = _grid_of(readings)
    nearest = [np.abs(readings.point[:, axis, None] - nodes).argmin(axis=1) for axis, nodes in enumerate(grid)]
    readings = readings._replace(node=np.stack(nearest, axis=1))
    _check_complete(readings, grid)
    home = measurements.geometry.home
    point = home.position + home.rotation @ measurements.probe
    zero = np.array([min(max(p, nodes[0]), nodes[-1]) for p, nodes in zip(point, grid, strict=True)])
    if beyond := [AXES[a] for a in range(3) if abs(point[a] - zero[a]) > LEAST_TRAVEL]:
        where = f"home lies outside the box along {', '.join(beyond)}"
        notes.append(f"{where}: the polynomials are zero at the end of the box nearest to home")
    field, fits = _fit_families(readings, grid, measurements.probe, zero)
    if one_way := list(dict.fromkeys(fit.name for fit in fits if fit.direction == 0)):
        what = "lines were not read in both directions; their polynomials are used for both directions"
        notes.append(f"{len(one_way)} {what} (first: {one_way[0]})")
    groups = np.unique(np.stack([measurements.run, measurements.channel]), axis=1, return_inverse=True)[1].ravel()
    means = np.bincount(groups, measurements.value) / np.bincount(groups)
    residuals = measurements.value - means[groups]
    if np.abs(residuals).max() <= LEAST_NOISE:  # no channel of a run changes
        refuse_unmoved(measurements, residuals)
    note = (
        "Scheme lines (Mou & King 1998): polynomials along grid lines, their order chosen by adjusted R². Datum: at "
        "home's coordinate along each line, displacements and rotations have the mean zero over both directions; from "
        "straightness, its least-squares line is subtracted."
    )
    model = MachineModel(
        machine=measurements.geometry.name,
        name=name or f"lines, {'5-D' if (readings.component >= 3).any() else '1-D'}",
        field=field,
        region=Region(np.array([[nodes[0] for nodes in grid], [nodes[-1] for nodes in grid]]), measurements.probe),
        origin=ModelOrigin(date or calendar.today().isoformat(), measurements.files, None, note),
    )
    notes = list(dict.fromkeys((*measurements.notes, *notes)))
    model, held = hold(measurements.geometry, model, home if datum is None else datum, np.eye(6))

    def spread(name: str) -> dict[int, float]:
        """Return for each kind of channel the RMS, over its polynomials, of their attribute `name`."""
        values: dict[int, list[float]] = {}
        for fit in fits:
            kind = "rotation" if fit.component >= 3 else "linear" if fit.component == fit.axis else "straightness"
            values.setdefault(KINDS.index(kind), []).append(getattr(fit, name))
        finite = {kind: [v for v in of_kind if np.isfinite(v)] for kind, of_kind in sorted(values.items())}
        return {kind: rms(of_kind) for kind, of_kind in finite.items() if of_kind}

    misfit = measurements.misfit(spread("repeat_std"), MISFIT)
    misfit = misfit or measurements.misfit(spread("residual_std"), LINES_MISFIT)
    return LinesFit(model, measurements, tuple(fits), tuple(notes), held, misfit)


# Readings on the grid


class Readings(NamedTuple):
    """N readings on grid lines, as arrays."""

    axis: np.ndarray  # index of the axis along which the line runs
    component: np.ndarray  # index into machine.field.COMPONENTS
    direction: np.ndarray  # 1 forward, -1 backward, 0 not known
    run: np.ndarray
    point: np.ndarray  # (N, 3), commanded position of the measured point in base, m
    node: np.ndarray  # (N, 3), index of the nearest node on each axis; the line's own axis is not used
    value: np.ndarray  # m or rad
    sloping: np.ndarray  # whether the slope of the beam is unknown (straightness)

    def select(self, mask: np.ndarray) -> Readings:
        return Readings(*(array[mask] for array in self))


def _grid_readings(measurements: MeasurementSet) -> tuple[Readings, list[str]]:
    """Return the readings on lines parallel to an axis of base, and notes on the others."""
    m, geometry, notes = measurements, measurements.geometry, list[str]()
    axis = np.array([-1 if run.base_axis is None else run.base_axis for run in m.runs])[m.run]
    others = [m.runs[r].name for r in np.unique(m.run[axis < 0])]
    if others:
        what = "runs are not parallel to an axis of base; scheme lines does not use them"
        notes.append(f"{len(others)} {what} (first: {others[0]})")
    if (axis < 0).all():
        raise CalibrationError("grid lines", "there are none: no run is parallel to an axis of base")
    weights = np.abs(m.directions())
    turned = (axis >= 0) & (weights.max(axis=1) < 1.0 - 1e-9)
    if turned.any():
        first = int(turned.argmax())
        turned_by = np.degrees(np.arccos(weights[first].max()))
        problem = f"is read along axes that are turned against the axes of base by {turned_by:.3g}°"
        hint = "scheme lines needs a work frame parallel to base, scheme joint does not"
        raise CalibrationError(f"run {m.runs[m.run[first]].name}", f"{problem}; {hint}")
    component = weights.argmax(axis=1)
    along_itself = (axis >= 0) & (component == axis) & (m.channel != CHANNELS.index("linear"))
    if along_itself.any():
        notes.append("readings of straightness in the direction of their own line are not used")
    kept = np.flatnonzero((axis >= 0) & ~along_itself)
    axis, component, station = axis[kept], component[kept], m.station[kept]
    rotations = m.stations.rotations[station]
    if np.abs(rotations - rotations[0]).max() > 1e-9:
        problem = "must all be read at one attitude of the platform: the field does not depend on the attitude"
        raise CalibrationError("grid lines", problem)
    low, high = m.stations.temperatures[station].min(), m.stations.temperatures[station].max()
    if max(REFERENCE_TEMPERATURE - low, high - REFERENCE_TEMPERATURE) > ASSUMED.least_warming:
        notes.append(f"read at {low:.1f} to {high:.1f} °C; scheme lines takes thermal growth for an error at 20 °C")
    there = m.stations.select(np.unique(station))
    nominal = strut_lengths_batch(Structure.of(geometry), there.positions, there.rotations)
    most = float(np.abs(there.commands - nominal).max())
    if most > COMPENSATED:
        problem = f"were read at strut commands that differ by up to {most * 1e6:.1f} µm from the nominal lengths"
        hint = "scheme lines needs readings of the uncompensated machine"
        raise CalibrationError("grid lines", f"{problem}; {hint}")
    if most > FOLLOWED:
        notes.append(
            f"strut commands differ by up to {most * 1e6:.2f} µm from the nominal lengths; the fit neglects this"
        )
    value = m.value
    if geometry.screw_lead.any():  # every model of this geometry corrects the rotation of the screws
        turning = station_errors(m, RealMachine(geometry, MachineModel(geometry.name)))
        value = value - (m.directions() * turning[m.station]).sum(axis=1)
    return Readings(
        axis=axis,
        component=component,
        direction=m.stations.sense[station, axis].astype(int),
        run=m.run[kept],
        point=m.points()[station],
        node=np.zeros((len(kept), 3), dtype=int),
        value=value[kept] * np.sign(m.directions()[kept, component]),
        sloping=m.kind[kept] == KINDS.index("straightness"),
    ), notes


def _distinct(values: np.ndarray) -> np.ndarray:
    """Sort the values; drop each one that exceeds the value before it by LEAST_TRAVEL or less."""
    ordered = np.unique(values)
    return ordered[np.append(True, np.diff(ordered) > LEAST_TRAVEL)]


def _grid_of(readings: Readings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes on each axis, m: coordinates of lines perpendicular to it; without these, ends of lines on it."""
    grid = []
    for axis, name in enumerate(AXES):
        along = readings.point[readings.axis == axis, axis]
        across = readings.point[readings.axis != axis, axis]
        nodes = _distinct(across) if len(across) else np.array([along.min(), along.max()])
        if len(nodes) < 2:
            problem = f"all lines have the same {name} ({nodes[0] * 1e3:g} mm); at least two values are needed"
            raise CalibrationError("grid", problem)
        grid.append(nodes)
    return grid[0], grid[1], grid[2]


def _line_name(grid: Sequence[np.ndarray], axis: int, node: Sequence[int]) -> str:
    places = zip(CROSS_AXES[axis], node, strict=True)
    return f"{AXES[axis]} line at " + ", ".join(f"{AXES[a]} {grid[a][n] * 1e3:.1f}" for a, n in places) + " mm"


def _check_complete(readings: Readings, grid: Sequence[np.ndarray]) -> None:
    """Refuse a grid if a line lacks a channel, or does not reach both ends of the grid."""
    for axis in np.unique(readings.axis).tolist():
        family, cross = readings.select(readings.axis == axis), CROSS_AXES[axis]
        every = set(product(*(range(len(grid[a])) for a in cross)))
        for component in np.unique(family.component):
            missing = every - set(map(tuple, family.node[family.component == component][:, cross].tolist()))
            if missing:
                what = f"{COMPONENTS[component]} on the {_line_name(grid, axis, min(missing))}"
                count = f"{len(missing)} of {len(every)} lines of the rectangular grid were not measured"
                raise CalibrationError(what, f"is missing; {count}")
        low, high = grid[axis][0], grid[axis][-1]
        for node in sorted(every):
            reach = family.point[(family.node[:, cross] == node).all(axis=1), axis]
            if reach.min() > low + LEAST_TRAVEL or reach.max() < high - LEAST_TRAVEL:
                problem = f"is read from {reach.min() * 1e3:.1f} to {reach.max() * 1e3:.1f} mm"
                wanted = f"the grid reaches from {low * 1e3:.1f} to {high * 1e3:.1f} mm"
                raise CalibrationError(_line_name(grid, axis, node), f"{problem}, but {wanted}")


# From readings to polynomials


def _fit_families(
    readings: Readings, grid: tuple[np.ndarray, np.ndarray, np.ndarray], probe: np.ndarray, zero: np.ndarray
) -> tuple[GridField, list[LineFit]]:
    """Return the error field and its polynomials.

    Each error component is fitted to lines along one axis; the lines along the other axes are fitted to the residuals
    of this fit. On twenty virtual machines, fitting residuals in this order reduced the RMS error in space from 27.9 to
    18.1 µm; fitting all lines to the readings themselves reduced it to 18.3 µm.
    """
    first, second, third = (np.zeros((2, len(grid[a]), len(grid[b]), 6, 0)) for a, b in CROSS_AXES)
    field, fits = GridField(grid, (first, second, third), probe=probe), list[LineFit]()
    for component in range(6):
        members, own = readings.select(readings.component == component), component % 3
        # Lines along its own axis come first for a displacement, last for a rotation (roll)
        families = sorted(np.unique(members.axis).tolist(), key=lambda axis: (axis == own) == (component >= 3))
        for axis in families:
            family, cross = members.select(members.axis == axis), CROSS_AXES[axis]
            family = family._replace(value=family.value - _predicted(field, family, component))
            # Lines that differ only in their coordinate along the first family's axis share a polynomial
            apart = [a for a in cross if a != families[0]]
            together: dict[tuple[int, ...], list[tuple[int, int]]] = {}
            for i, j in product(*(range(len(grid[a])) for a in cross)):
                key = tuple(n for a, n in zip(cross, (i, j), strict=True) if a in apart)
                together.setdefault(key, []).append((i, j))
            fitted = list[LineFit]()
            for key, nodes in together.items():
                name = _line_name(grid, axis, nodes[0])
                if len(nodes) > 1:
                    name += f" and {len(nodes) - 1} beside it along {AXES[families[0]]}"
                group = family.select((family.node[:, apart] == key).all(axis=1))
                fitted += _fit_line(group, name, tuple(nodes), grid[axis], zero[axis])
            field = _with_family(field, axis, fitted)
            fits += fitted
    return field, fits


def _predicted(field: GridField, readings: Readings, component: int) -> np.ndarray:
    """Return one component of the error field, m or rad, at each of N readings."""
    predicted = np.zeros(len(readings.value))
    if not any(family[:, :, :, component].any() for family in field.lines):
        return predicted
    for n, (point, axis, direction) in enumerate(zip(readings.point, readings.axis, readings.direction, strict=True)):
        sense = np.zeros(3)
        sense[axis] = direction
        predicted[n] = field.evaluate(point, sense)[0][component]
    return predicted


def _fit_line(
    group: Readings, name: str, nodes: tuple[tuple[int, int], ...], along: np.ndarray, zero: float
) -> list[LineFit]:
    """Return polynomials fitted to the readings of one line: one for each direction in which the line was read.

    Because zeros are unknown, the mean of both directions is set to 0 at the coordinate `zero`, m. Because the slope of
    a straightness beam is unknown, the same straight line is subtracted from the forward and the backward straightness.
    """
    axis, component, sloping = int(group.axis[0]), int(group.component[0]), bool(group.sloping.any())

    def parameter(coordinate: np.ndarray | float) -> np.ndarray:
        return np.asarray((2.0 * coordinate - along[0] - along[-1]) / (along[-1] - along[0]))

    ways = sorted(set(group.direction.tolist()) - {0}, reverse=True) or [0]
    group = group.select(np.isin(group.direction, ways))  # omits readings of unknown direction, if there are others
    values = _without_run_zeros(group, parameter(group.point[:, axis]), ways)
    place = _distinct(group.point[:, axis])
    number = np.abs(group.point[:, axis, None] - place).argmin(axis=1)
    beside = np.unique(group.node[:, CROSS_AXES[axis]], axis=0, return_inverse=True)[1].ravel()
    u = parameter(place)
    means, repeats = [], []
    for way in ways:
        rows = group.direction == way
        means.append(_averaged(values[rows], number[rows], len(place)))
        groups, same = np.unique(np.stack([beside[rows], number[rows]]), axis=1, return_inverse=True)
        same = same.ravel()
        scatter = values[rows] - _averaged(values[rows], same)[same]
        freedom = len(scatter) - groups.shape[1]
        repeats.append(float(np.sqrt((scatter**2).sum() / freedom)) if freedom else float("nan"))
    if sloping:
        every, places = np.concatenate(means), np.tile(u, len(means))
        read = np.isfinite(every)
        line = Polynomial.fit(places[read], every[read], 1, domain=[-1.0, 1.0])
        means = [mean - line(u) for mean in means]
    fits = []
    for way, mean, repeat in zip(ways, means, repeats, strict=True):
        read = np.isfinite(mean)
        figures = _regress(u[read], mean[read], name, float(along[-1] - along[0]))
        fits.append(LineFit(name, axis, nodes, component, way, place[read], mean[read], *figures, repeat))
    if not sloping:
        home = float(parameter(zero))
        shift = float(np.mean([np.polynomial.polynomial.polyval(home, fit.coefficients) for fit in fits]))
        for n, fit in enumerate(fits):
            coefficients = fit.coefficients.copy()
            coefficients[0] -= shift
            fits[n] = replace(fit, coefficients=coefficients, values=fit.values - shift)
    return fits if len(fits) == 2 else [replace(fits[0], direction=0)]


def _without_run_zeros(group: Readings, u: np.ndarray, ways: Sequence[int]) -> np.ndarray:
    """Return the values on a line as if all its runs had one zero and, for straightness, one slope of the beam."""
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


def _averaged(values: np.ndarray, number: np.ndarray, places: int = 0) -> np.ndarray:
    """Return the mean of the values at each place, NaN if a place has none; `number` is the place of each value."""
    count = np.bincount(number, minlength=places)
    total = np.bincount(number, weights=values, minlength=places)
    return np.where(count, total / np.maximum(count, 1), np.nan)


def _regress(u: np.ndarray, values: np.ndarray, name: str, reach: float) -> tuple[np.ndarray, float, float, float]:
    """Fit a polynomial of u = −1…1; return its coefficients, R², adjusted R² and the residuals' standard deviation.

    Of all orders, the polynomial has that with the largest adjusted R². The standard deviation has n − order − 1
    degrees of freedom. `reach` is the length of the line, m.
    """
    count = len(u)
    if count < FEWEST_POINTS:
        span = f"{count} points in one direction, over {1e3 * reach:.4g} mm"
        wanted = f"{FEWEST_POINTS} are needed: one every {1e3 * reach / (FEWEST_POINTS - 1):.4g} mm or closer"
        raise CalibrationError(name, f"has {span}; {wanted} (step_mm of a campaign)")
    total, candidates = float(((values - values.mean()) ** 2).sum()), []
    for order in range(count // POINTS_PER_COEFFICIENT):
        fit = Legendre.fit(u, values, order, domain=[-1.0, 1.0])
        rest, freedom = float(((values - fit(u)) ** 2).sum()), count - order - 1
        r2 = 1.0 - rest / total if total > 0.0 else 1.0
        adjusted = 1.0 - (1.0 - r2) * (count - 1) / freedom
        candidates.append((legendre.leg2poly(fit.coef), r2, adjusted, float(np.sqrt(rest / freedom))))
    return max(candidates, key=lambda one: one[2])


def _with_family(field: GridField, axis: int, fits: Sequence[LineFit]) -> GridField:
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
