"""Scheme ``lines``, Mou & King's: a polynomial along each measured grid line, forward and backward apart.

Every line of a full rectangular grid gets one polynomial per direction and component, by linear regression
on the mean of its cycles; between the lines :class:`hexapod_comp.machine.field.GridField` weights bilinearly. The
inverse kinematics then makes strut lengths of it, as everywhere.

**What a line does not say.** A laser reads from a zero that nobody knows against the next line's, and a
straightness beam lies off the axis by a slope that nobody knows. So

- displacement along the line and rotations are taken as zero, in the mean of both directions, where the line
  passes home's coordinate along it. Backlash stays in, half to each direction;
- a straightness is taken without its least-squares straight line, common to both directions.

How the planes through home stand and bend (1-D data), or the squareness of the axes, the twists of the
planes and, without a roll channel, the roll (5-D data) so remain in the machine.

Where screws turn with cardan joints, what that does to the readings is known from the geometry and taken off first.

**What several families say about one component.** The three families of a field add up, but the lines along
x, y and z all cross in the grid's nodes and see the same errors there. With 5-D data dx is the linear
displacement on x-lines and a straightness on y- and z-lines. Were all three added as read, a term such as
x·y², which x-lines see as a displacement that differs from line to line and y-lines as a bow that differs
from line to line, would count twice. But the x-lines leave open only what does not depend on x, their zeros:
dx(x, y, z) = X(x; y, z) + f(y, z) with X from the x-lines. So each component belongs first to one family,
read line by line as Mou & King do; the others are asked only for what it leaves over: its prediction is taken off
their readings, and since the rest is the same for all lines that differ only in the first family's
coordinate, these are averaged and share one polynomial. A displacement belongs first to the lines along it
(the only ones without an unknown slope); a rotation to the first of x, y, z that reads it as pitch or yaw.
Mou & King do not say how their 5-D model did this. On twenty virtual machines (±100 µm on joints and struts, screw
waves, backlash) the RMS error in space after alignment of the datum fell from 27.9 µm to 19.0 µm with own
displacements alone, to 18.3 µm with everything added as read, to 18.1 µm so; with strut maps of 5 µm as well
from 29.2 µm to 21.0, 20.6 and 20.1 µm. Adding as read also raised what is left along lines by a tenth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date as calendar
from itertools import product
from typing import Literal

import numpy as np
from numpy.polynomial import Legendre, Polynomial, legendre

from ..errors import CalibrationError
from ..machine.arrays import rms
from ..machine.field import CROSS_AXES, GridField
from ..machine.model import MachineModel, ModelOrigin
from ..measurements.readings import AXES, KINDS, LEAST_NOISE, MeasurementSet, refuse_unmoved
from ..pose import Pose
from .datum import HeldDatum, hold
from .grid_readings import (
    Readings,
    check_complete,
    datum_of,
    distinct,
    grid_of,
    grid_readings,
    line_name,
    nearest_nodes,
    region_of,
)

OrderRule = Literal["adjusted-r2", "aicc"] | int
"""How the order of a polynomial is chosen, or the order itself."""

POINTS_PER_COEFFICIENT = 3
"""A line of 17 points gets at most 5 coefficients, one of 9 gets 3: no more than the readings can carry."""

FEWEST_POINTS = 2 * POINTS_PER_COEFFICIENT
"""Below this not even a straight line is left."""

MISFIT, LINES_MISFIT = 10.0, 100.0
"""Repeated readings may scatter so many times as much as stated, and so far may readings lie off their polynomial,
which leaves out the screws' waves (on the shipped machine 15 times a rotation's noise)."""

DIRECTIONS = (1, -1)
"""Forward, backward: the order of a field's polynomials."""


@dataclass(frozen=True)
class LineFit:
    """One polynomial and how well it fits.

    Attributes
    ----------
    name : str
        Of the line, or of the lines that share the polynomial.
    axis : int
        Along which it runs.
    nodes : tuple of (int, int)
        Node indices across, in the order of :data:`hexapod_comp.machine.field.CROSS_AXES`, of every line that it
        stands for.
    component : int
        Index into :data:`hexapod_comp.machine.field.COMPONENTS`.
    direction : int
        1, −1, or 0 for a line that was read in one direction, or in none, and stands for both.
    coordinates, values : ndarray, shape (n,)
        Along the axis, m in ``base``, and the mean readings after the datum and what other families say have
        been taken off, m or rad.
    coefficients : ndarray, shape (order + 1,)
        Powers of u, which runs from −1 to 1 over the box.
    r2, adjusted_r2 : float
        Coefficient of determination, and adjusted for the coefficients spent.
    residual_std : float
        Standard deviation of the residuals with n − order − 1 degrees of freedom, m or rad.
    repeat_std : float
        Standard deviation of one reading about its mean over the repeated ones, pooled over the line; NaN
        where nothing was repeated.
    """

    name: str
    axis: int
    nodes: tuple[tuple[int, int], ...]
    component: int
    direction: int
    coordinates: np.ndarray
    values: np.ndarray
    coefficients: np.ndarray
    r2: float
    adjusted_r2: float
    residual_std: float
    repeat_std: float

    @property
    def order(self) -> int:
        """Order of the polynomial."""
        return len(self.coefficients) - 1


@dataclass(frozen=True)
class LinesFit:
    """What scheme ``lines`` makes of a machine's readings.

    Attributes
    ----------
    model : MachineModel
        The field; struts are nominal, and so is the structure, but for the whole base where holding the datum moves it.
    lines : tuple of LineFit
        Every polynomial.
    notes : tuple of str
        What was odd, left out or assumed.
    held : HeldDatum
        Where the tool is held.
    misfit : str
        Why the model is not to be trusted: readings that scatter more than :data:`MISFIT` allows when repeated, or
        lie further off their polynomials than :data:`LINES_MISFIT`; empty if none does.
    """

    model: MachineModel
    lines: tuple[LineFit, ...]
    notes: tuple[str, ...]
    held: HeldDatum
    misfit: str = ""


def fit_lines(
    measurements: MeasurementSet,
    order: OrderRule = "adjusted-r2",
    date: str = "",
    name: str = "",
    datum: Pose | None = None,
) -> LinesFit:
    """Fit Mou & King's polynomials to the readings on a rectangular grid of lines.

    Parameters
    ----------
    measurements : MeasurementSet
        Lines parallel to the axes of ``base``, all of each measured family; everything else is left out and
        noted. Runs along one line are merged, each after its own zero.
    order : {'adjusted-r2', 'aicc'} or int
        How the order of each line's polynomial is chosen: by the highest adjusted R² or the lowest corrected
        Akaike criterion, with at most a third of the line's points as coefficients. Or the order itself; lines
        whose points do not carry it get the highest that they do, and are noted.
    date, name : str, optional
        ISO 8601 date and name of the model; today, and the scheme's, by default.
    datum : Pose, optional
        ``pose_platform_in_base`` at which the model moves the tool by nothing; home by default. Lines do not show where
        the machine stands as a whole.

    Raises
    ------
    CalibrationError
        No grid lines, a line or channel missing, readings that do not reach the grid's edge, fewer points
        than a straight line needs, lines at different attitudes, a work frame turned against ``base``.
    """
    _check_order(order)
    readings, notes = grid_readings(measurements)
    grid = grid_of(readings)
    readings = readings._replace(node=nearest_nodes(readings.point, grid))
    check_complete(readings, grid)
    zero, remark = datum_of(measurements, grid)
    notes += remark
    field, fits = _fit_families(readings, GridField(grid, _no_lines(grid), probe=measurements.probe), order, zero)
    notes += _fit_notes(fits, order)
    left = _without_means(measurements)
    if np.abs(left).max() <= LEAST_NOISE:  # one silent kind among others does this scheme no harm
        refuse_unmoved(measurements, left)
    model = MachineModel(
        machine=measurements.geometry.name,
        name=name or f"lines, {'5-D' if (readings.component >= 3).any() else '1-D'}",
        field=field,
        region=region_of(measurements, grid),
        origin=ModelOrigin(date or calendar.today().isoformat(), measurements.files, None, _origin_note(order)),
    )
    notes = list(dict.fromkeys((*measurements.notes, *notes)))
    model, held = hold(measurements.geometry, model, measurements.geometry.home if datum is None else datum, np.eye(6))
    return LinesFit(model, tuple(fits), tuple(notes), held, _misfit(measurements, fits))


def _check_order(order: object) -> None:
    """Raise on a rule that is none."""
    if not (order in ("adjusted-r2", "aicc") or (isinstance(order, int) and order >= 1)):
        raise CalibrationError("order", f"must be adjusted-r2, aicc or a whole number from 1, not {order!r}")


def _without_means(measurements: MeasurementSet) -> np.ndarray:
    """Return the readings less the mean of their channel in their run, shape (N,), m or rad."""
    groups = np.unique(np.stack([measurements.run, measurements.channel]), axis=1, return_inverse=True)[1].ravel()
    means = np.bincount(groups, measurements.value) / np.bincount(groups)
    return measurements.value - means[groups]


def _misfit(measurements: MeasurementSet, fits: Sequence[LineFit]) -> str:
    """Return what :attr:`LinesFit.misfit` says."""
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


def _origin_note(order: OrderRule) -> str:
    chosen = f"of order {order}" if isinstance(order, int) else f"of an order chosen by {order}"
    return (
        f"Scheme lines (Mou & King 1998): polynomials {chosen} along grid lines. Datum: displacements and rotations "
        "are zero (mean of both directions) at home's coordinate along each line; straightness without its straight "
        "line."
    )


# From readings to polynomials


def _priority(component: int, readings: Readings) -> list[int]:
    """Return the families that read a component: first the one that it belongs to."""
    own = component % 3
    measured = [int(axis) for axis in np.unique(readings.axis)]
    # A displacement is best seen along its own axis; a rotation there is roll, and comes last.
    return sorted(measured, key=lambda axis: (axis == own) if component >= 3 else (axis != own))


def _fit_families(
    readings: Readings, empty: GridField, order: OrderRule, datum: np.ndarray
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
    readings: Readings, component: int, axis: int, field: GridField, order: OrderRule, datum: np.ndarray
) -> list[LineFit]:
    """Return the polynomials of the lines along an axis for one component.

    Parameters
    ----------
    readings : Readings
        All of the component.
    component, axis : int
        Which.
    field : GridField
        What the families before this one say.
    order : str or int
        As :func:`fit_lines` has it.
    datum : ndarray, shape (3,)
        Where lines are zero, m.
    """
    family = readings.select(readings.axis == axis)
    first = _priority(component, readings)[0]
    # Lines of which the first family has predicted everything that differs between them share what is left.
    shared = None if axis == first else first
    family = family._replace(value=family.value - _predicted(field, family, component))
    fits = []
    for nodes, group in _groups(family, axis, field.grid, shared):
        name = line_name(field.grid, axis, nodes[0])
        if len(nodes) > 1:
            name += f" and {len(nodes) - 1} beside it along {AXES[first]}"
        fits += _fit_line(group, name, nodes, field.grid[axis], order, datum[axis])
    return fits


def _fit_notes(fits: Sequence[LineFit], order: OrderRule) -> list[str]:
    """Return remarks on lines that were read in one direction only, or did not carry the order asked for."""
    notes = []
    one_way = list(dict.fromkeys(fit.name for fit in fits if fit.direction == 0))
    if one_way:
        what = "not read in both directions; what was read is used for both"
        notes.append(f"{len(one_way)} lines were {what} (first: {one_way[0]})")
    short = [fit for fit in fits if isinstance(order, int) and fit.order < order]
    if short:
        what = f"too few points for order {order} and got the highest that they carry"
        notes.append(f"{len(short)} polynomials have {what} (first: {short[0].name}, order {short[0].order})")
    return notes


def _predicted(field: GridField, readings: Readings, component: int) -> np.ndarray:
    """Return what a field says of some readings, shape (N,): an axis that stands still has no direction."""
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
    group: Readings, name: str, nodes: tuple[tuple[int, int], ...], along: np.ndarray, order: OrderRule, datum: float
) -> list[LineFit]:
    """Return the polynomials of a line's directions: two, or one when it was read in one direction only."""
    axis, component = int(group.axis[0]), int(group.component[0])
    ways = sorted(set(group.direction.tolist()) - {0}, reverse=True) or [0]
    group = group.select(np.isin(group.direction, ways))  # readings without direction tell nothing beside others
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
        line = _regress(_parameter(place[read], along), mean[read], order, name)
        fits.append(LineFit(name, axis, nodes, component, way, place[read], mean[read], *line, repeat))
    if not group.sloping.any():
        fits = _zeroed(fits, float(_parameter(np.array(datum), along)))
    return fits if len(fits) == 2 else [replace(fits[0], direction=0)]


def _parameter(coordinate: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return u, −1 at the first and 1 at the last node, of coordinates along an axis."""
    return (2.0 * coordinate - along[0] - along[-1]) / (along[-1] - along[0])


def _places(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct places on a line, and each reading's index among them."""
    places = distinct(coordinates)
    return places, np.abs(coordinates[:, None] - places).argmin(axis=1)


def _without_run_zeros(group: Readings, u: np.ndarray, ways: Sequence[int]) -> np.ndarray:
    """Return values in which the runs have a common zero (and slope, where a beam's is unknown).

    The runs' unknowns are found in one regression together with a polynomial per direction, so that runs
    need not cover the same places. What is common to all runs is settled later, by the datum.
    """
    runs, run = np.unique(group.run, return_inverse=True)
    if len(runs) == 1:
        return group.value
    powers = max(1, len(distinct(u)) // POINTS_PER_COEFFICIENT)
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
    """Return the standard deviation of readings about their mean at a place of one line; NaN where none is repeated.

    Lines that share a polynomial differ by what it leaves of the machine: that is no repeatability of anything.
    """
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


def _regress(u: np.ndarray, values: np.ndarray, order: OrderRule, name: str) -> tuple[np.ndarray, float, float, float]:
    """Return coefficients in powers of u, R², adjusted R² and the standard deviation of the residuals.

    Legendre's polynomials keep the regression well conditioned (Mou & King have powers of x: the same functions).
    """
    count = len(u)
    if count < FEWEST_POINTS:
        raise CalibrationError(name, f"has {count} points in a direction; {FEWEST_POINTS} are needed")
    most = count // POINTS_PER_COEFFICIENT - 1
    orders = [min(order, most)] if isinstance(order, int) else range(most + 1)
    candidates = [_polynomial(u, values, k) for k in orders]
    # The first of equals: the lowest order.
    best = max(candidates, key=lambda fit: -_aicc(fit, count) if order == "aicc" else fit[2])
    return legendre.leg2poly(best[0].coef), *best[1:]


def _polynomial(u: np.ndarray, values: np.ndarray, order: int) -> tuple[Legendre, float, float, float]:
    """Return a polynomial of an order with R², adjusted R² and the residuals' standard deviation."""
    fit = Legendre.fit(u, values, order, domain=[-1.0, 1.0])
    rest = float(((values - fit(u)) ** 2).sum())
    total = float(((values - values.mean()) ** 2).sum())
    freedom = len(u) - order - 1
    r2 = 1.0 - rest / total if total > 0.0 else 1.0
    return fit, r2, 1.0 - (1.0 - r2) * (len(u) - 1) / freedom, float(np.sqrt(rest / freedom))


def _aicc(fit: tuple[Legendre, float, float, float], count: int) -> float:
    """Return Akaike's information criterion, corrected for small samples; the variance is a parameter too."""
    parameters = len(fit[0].coef) + 1
    variance = fit[3] ** 2 * (count - len(fit[0].coef)) / count
    # A line without any residual has no logarithm; a femtometre (or femtoradian) is as good as none.
    likelihood = count * np.log(max(variance, 1e-30))
    return float(likelihood + 2 * parameters * (1.0 + (parameters + 1) / (count - parameters - 1)))


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
