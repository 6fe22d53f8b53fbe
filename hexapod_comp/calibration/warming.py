"""Growth seen while a machine warms: time constants sought from the readings, and what the readings tell of heat.

For given time constants the growth is linear in what is fitted. So each constant of a logarithmic grid, and each pair,
is tried on what a fit without late parts leaves: its gain is by how much it raises the logarithm of the readings'
probability, all other parameters and the late parts' prior integrated out. A parabola through the best three refines
it, and says how well it is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..formats.texts import number
from ..machine.temperatures import (
    MOST_TIME_CONSTANTS,
    PARTS,
    REFERENCE_HUMIDITY,
    REFERENCE_TEMPERATURE,
    TIME_CONSTANT_RANGE,
    LateGrowth,
)
from ..measurements.readings import KINDS, MeasurementSet
from .assumptions import ASSUMED
from .blocks.block import Linkage
from .blocks.growth import growth_causes, growth_columns, growth_root
from .estimator import Estimation, Posterior, Solution, physical_covariance, solve
from .parameters import TOLERANCES, ParameterSpace
from .sensitivity import predict

GRID = 40
"""Time constants tried, from :data:`SHORTEST` to :data:`LONGEST` times what the readings span: a sixth apart."""

SHORTEST, LONGEST = 1.0 / 200.0, 2.0

CLEAR_GAIN = 10.0
"""A time constant must make the readings e¹⁰ times as probable."""

SEEN_SHARE = 0.5
"""A parameter is determined when more than this share of it comes from the readings."""


LEAST_KNOWN = {"expansion": 20e-6, "late": 60e-6, "moisture": 5e-4}
"""Growth that surprises in no material: by heat, 1/K; what of it comes late, which is several times that of a part much
faster than its thermometer; and by humidity, m/m."""

UNSEEN = (0.1, 0.5)
"""Time constants that nothing has shown may be such shares of what the readings span."""

STEP = 0.02
"""Of a time constant's logarithm, for derivatives."""


@dataclass(frozen=True)
class TimeConstants:
    """Time constants, and how well they are known.

    Attributes
    ----------
    values : tuple of float
        s.
    deviations : tuple of float
        Standard deviation of the logarithm of each.
    """

    values: tuple[float, ...] = ()
    deviations: tuple[float, ...] = ()


def seek_time_constants(
    measurements: MeasurementSet, space: ParameterSpace, progress: Callable[[str], object]
) -> TimeConstants:
    """Return the time constants that the readings show; none where there are none, or nothing tells.

    Parameters
    ----------
    measurements : MeasurementSet
        The readings.
    space : ParameterSpace
        Of a fit without late parts.
    progress : callable
        Told what goes on.
    """
    settings, times = space.settings, measurements.stations.times
    if "late" not in settings.blocks or settings.time_constants is not None or not np.ptp(times) > 0.0:
        return TimeConstants()
    progress("seeking time constants")
    grid = np.ptp(times) * np.geomspace(SHORTEST, LONGEST, GRID)
    grid = grid[(grid >= TIME_CONSTANT_RANGE[0]) & (grid <= TIME_CONSTANT_RANGE[1])]
    if len(grid) < 3:
        return TimeConstants()
    estimation = Estimation(measurements, space)
    scan = _Scan.of(estimation, grid, _tried(estimation))
    best, gain = scan.best(1)
    if gain < CLEAR_GAIN:
        return TimeConstants()
    # A constant that is left out raises the noise, which hides a second one: once more with the noise that it leaves.
    with_best = ParameterSpace(measurements, replace(settings, time_constants=tuple(grid[list(best)].tolist())))
    tried = _tried(Estimation(measurements, with_best))
    scan = _Scan.of(estimation, grid, replace(tried, tolerances=tried.tolerances[:-1]))
    (best, gain), (pair, gain_of_pair) = scan.best(1), scan.best(MOST_TIME_CONSTANTS)
    return scan.refined(pair if gain_of_pair > gain + CLEAR_GAIN else best)


def _tried(estimation: Estimation) -> Posterior:
    """Return the fit linearised at the nominal machine."""
    space = estimation.space
    problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(estimation.measurements)))
    return solve(space, problem, space.start_tolerances(), np.ones(len(KINDS)))


def _per_growth(estimation: Estimation, x: np.ndarray) -> np.ndarray:
    """Return what the relative growth of each part moves each cell by, shape (C, 8), m or rad."""
    space, cells = estimation.space, estimation.cells
    stations = estimation.measurements.stations
    columns = growth_columns(Linkage(predict(space, x, stations), space.probe, stations))[cells.station]
    return np.einsum("ci,cip->cp", cells.directions, columns)


def _late_columns(estimation: Estimation, x: np.ndarray, constants: np.ndarray, size: float) -> np.ndarray:
    """Return what late parts of a size, 1/K, move the cells by, (C, K·8), over the stated noise, free of zeros."""
    behind = growth_causes(estimation.space.settings, estimation.measurements.stations, constants)
    behind = behind[estimation.cells.station, :, 1:]
    columns = (_per_growth(estimation, x)[:, :, None] * behind).transpose(0, 2, 1) @ (size * growth_root(1))
    return estimation.free_of_nuisance(columns.reshape(len(columns), -1))


class _Scan:
    """What each time constant of a grid would explain of what a fit without late parts leaves."""

    def __init__(self, grid: np.ndarray, normal: np.ndarray, moment: np.ndarray) -> None:
        self._grid, self._normal, self._moment = grid, normal, moment

    @staticmethod
    def of(estimation: Estimation, grid: np.ndarray, known: Posterior) -> _Scan:
        """Return the scan at the nominal machine with known tolerances and noise."""
        space = estimation.space
        nominal = np.zeros(space.size)
        problem, _ = estimation.linearise(nominal, np.ones(len(estimation.measurements)))
        posterior = solve(space, problem, known.tolerances, known.noise, rounds=0)
        columns = _late_columns(estimation, nominal, grid, TOLERANCES["late"])
        over = 1.0 / posterior.noise[problem.kind]
        rows, columns = problem.rows.using(posterior.used, over), over[:, None] * columns
        left = over * problem.target - rows.times(posterior.y)
        shared = rows.transposed_times(columns)
        return _Scan(grid, columns.T @ columns - shared.T @ posterior.covariance @ shared, columns.T @ left)

    def gain(self, chosen: Sequence[int]) -> float:
        """Return by how much some constants of the grid raise the logarithm of the readings' probability."""
        parts = len(PARTS)
        members = np.concatenate([np.arange(parts * n, parts * (n + 1)) for n in chosen])
        matrix = np.eye(len(members)) + self._normal[np.ix_(members, members)]
        moment = self._moment[members]
        return float(0.5 * moment @ np.linalg.solve(matrix, moment) - 0.5 * np.linalg.slogdet(matrix)[1])

    def best(self, count: int) -> tuple[tuple[int, ...], float]:
        """Return so many constants of the grid that gain most, and what they gain."""
        gains = {chosen: self.gain(chosen) for chosen in combinations(range(len(self._grid)), count)}
        best = max(gains, key=gains.__getitem__)
        return best, gains[best]

    def refined(self, chosen: tuple[int, ...]) -> TimeConstants:
        """Return the summits of parabolas through each constant's gain and its neighbours', the others kept.

        Deviations are by all bends together: two constants that act alike are known the less.
        """
        step = np.log(self._grid[1] / self._grid[0])
        values, deviations = self._grid[list(chosen)], np.full(len(chosen), math.inf)
        inside = [i for i, n in enumerate(chosen) if 0 < n < len(self._grid) - 1 and not {n - 1, n + 1} & {*chosen}]
        here, bends = self.gain(chosen), np.zeros((len(inside), len(inside)))
        for a, i in enumerate(inside):
            before, after = (self._moved(chosen, {i: way}) for way in (-1, 1))
            bends[a, a] = 2.0 * here - before - after
            values[i] *= np.exp(step * 0.5 * (after - before) / bends[a, a])
            for b, j in enumerate(inside[:a]):
                ways = [(u, v, u * v) for u in (-1, 1) for v in (-1, 1)]
                bends[a, b] = bends[b, a] = -0.25 * sum(w * self._moved(chosen, {i: u, j: v}) for u, v, w in ways)
        if (np.linalg.eigvalsh(bends) > 0.0).all():
            deviations[inside] = step * np.sqrt(np.diag(np.linalg.inv(bends)))
        return TimeConstants(tuple(values.tolist()), tuple(deviations.tolist()))

    def _moved(self, chosen: tuple[int, ...], ways: dict[int, int]) -> float:
        """Return the gain of constants some of which are moved on the grid."""
        return self.gain([n + ways.get(i, 0) for i, n in enumerate(chosen)])


@dataclass(frozen=True)
class PartGrowth:
    """How one kind of part grows.

    Attributes
    ----------
    part : str
        ``struts`` (their mean), ``base`` or ``platform``.
    stated, expansion, deviation : float
        Expansion as stated, as fitted, and its standard deviation, 1/K.
    determined : float
        Share of it that comes from the readings.
    late : tuple of float
        What of it comes late, by time constant, 1/K.
    """

    part: str
    stated: float
    expansion: float
    deviation: float
    determined: float
    late: tuple[float, ...]


@dataclass(frozen=True)
class Swelling:
    """What readings tell of the struts' growth by humidity.

    Attributes
    ----------
    change : float
        By how much the relative humidity changed.
    stated, moisture, deviation : float
        Growth as stated, as fitted, and its standard deviation, m/m from 0 to 1; the deviation is NaN where nothing was
        fitted.
    determined : float
        Share of it that comes from the readings.
    """

    change: float
    stated: float
    moisture: float
    deviation: float
    determined: float


@dataclass(frozen=True)
class HeatSeen:
    """What readings tell of heat, and of humidity.

    Attributes
    ----------
    changes : tuple of (str, float)
        By how much each thermometer changed, K; thermometers that nobody read are not here.
    thermometer : str
        The one that stands for all parts; empty: each has its own.
    parts : tuple of PartGrowth
        Empty where no expansion was fitted.
    time_constants : TimeConstants
        None where no part is late.
    timed : bool
        Whether the readings have times.
    swelling : Swelling or None
        What humidity does to the struts; None where they do not swell.
    """

    changes: tuple[tuple[str, float], ...]
    thermometer: str
    parts: tuple[PartGrowth, ...]
    time_constants: TimeConstants
    timed: bool
    swelling: Swelling | None

    @staticmethod
    def of(
        measurements: MeasurementSet,
        estimation: Estimation,
        solution: Solution,
        time_constants: TimeConstants,
        factor: float,
    ) -> HeatSeen:
        """Return what a fit to readings tells; deviations are wider by a `factor` (:class:`~.promise.Unexplained`)."""
        space = estimation.space
        stations, block = measurements.stations, space.block("expansion")
        read = (stations.temperatures != REFERENCE_TEMPERATURE).any(axis=0)
        changes = zip(PARTS, np.ptp(stations.temperatures, axis=0).tolist(), read, strict=True)
        growth = space.model(solution.x, with_field=False).late_growth
        if growth.time_constants and not time_constants.values:  # given
            time_constants = TimeConstants(growth.time_constants, (0.0,) * len(growth.time_constants))
        known = _Known.of(estimation, solution, time_constants, factor)
        return HeatSeen(
            changes=tuple((name, change) for name, change, is_read in changes if is_read),
            thermometer=space.settings.thermometer,
            parts=() if block is None else tuple(_parts(space, solution, known, block.part.start, growth)),
            time_constants=time_constants if growth.time_constants else TimeConstants(),
            timed=bool(np.isfinite(stations.times).all()),
            swelling=_swelling(measurements, space, solution, known) if space.swells else None,
        )


@dataclass(frozen=True)
class _Known:
    """How well growth is known: covariance of all parameters, SI, and what it would be without readings."""

    covariance: np.ndarray
    prior: np.ndarray

    @staticmethod
    def of(estimation: Estimation, solution: Solution, constants: TimeConstants, factor: float) -> _Known:
        """Return the covariance of a fit, whose priors and time constants are themselves no more than estimates.

        The size of a prior is estimated from hardly three numbers, which are themselves drawn to it: how far they may
        be off is worked out with a prior that no material surprises. Time constants that differ by δ, in the logarithm,
        move the readings by h·δ, and with them the parameters by −C·Rᵀ·h·δ. One thermometer for all whose late parts
        nothing has shown may have some all the same, as far as the readings allow.
        """
        space, noise, problem = estimation.space, solution.posterior.noise, solution.problem
        least = [LEAST_KNOWN.get(block.name, 0.0) for block in space.blocks]
        posterior = solve(space, problem, np.maximum(solution.posterior.tolerances, least), noise, rounds=0)
        covariance, over = physical_covariance(space, posterior), 1.0 / noise[problem.kind]
        rows = problem.rows.using(posterior.used, over)
        for deviation, effect in zip(constants.deviations, _effects(estimation, solution.x, constants), strict=False):
            moved = space.physical(posterior.covariance @ rows.transposed_times(over * effect))
            covariance += min(deviation, 1.0) ** 2 * np.outer(moved, moved)
        times = estimation.measurements.stations.times
        if space.settings.thermometer and space.block("late") is None and np.ptp(times) > 0.0:
            columns = _late_columns(estimation, solution.x, np.ptp(times) * np.array(UNSEEN), LEAST_KNOWN["late"])
            columns *= over[:, None]
            shared = rows.transposed_times(columns)
            moved = posterior.covariance @ shared
            left = np.eye(len(shared[0])) + columns.T @ columns - shared.T @ moved
            covariance += space.physical(space.physical(moved @ np.linalg.solve(left, moved.T)).T)
        return _Known(factor**2 * covariance, space.prior_covariance(posterior.tolerances))

    def of_mean(self, members: slice) -> tuple[float, float]:
        """Return the standard deviation of the mean of some parameters, and its share that comes from readings."""
        variance, prior = (float(matrix[members, members].mean()) for matrix in (self.covariance, self.prior))
        return math.sqrt(variance), max(0.0, 1.0 - variance / prior)


def _effects(estimation: Estimation, x: np.ndarray, constants: TimeConstants) -> Iterator[np.ndarray]:
    """Yield how the logarithm of each time constant moves the cells, (C,), over their stated noise, free of zeros."""
    space, stations = estimation.space, estimation.measurements.stations
    block = space.block("late")
    if block is None:
        return
    growth, per_growth = x[block.part].reshape(len(PARTS), -1), _per_growth(estimation, x)
    for k, value in enumerate(constants.values):
        shorter, longer = (
            growth_causes(space.settings, stations, [value * math.exp(way)])[:, :, 1] for way in (-STEP, STEP)
        )
        later = ((longer - shorter) / (2.0 * STEP))[estimation.cells.station]
        yield estimation.free_of_nuisance((per_growth * later) @ growth[:, k : k + 1])[:, 0]


def _swelling(measurements: MeasurementSet, space: ParameterSpace, solution: Solution, known: _Known) -> Swelling:
    humidity = np.nan_to_num(measurements.stations.humidity, nan=REFERENCE_HUMIDITY)
    change, stated, block = float(np.ptp(humidity)), space.settings.strut_moisture or 0.0, space.block("moisture")
    if block is None:
        return Swelling(change, stated, stated, math.nan, 0.0)
    return Swelling(change, stated, stated + float(solution.x[block.part][0]), *known.of_mean(block.part))


MEMBERS = {"struts": slice(0, 6), "base": slice(6, 7), "platform": slice(7, 8)}
"""Which of :data:`~hexapod_comp.machine.temperatures.PARTS` belong to each kind of part."""


def _parts(
    space: ParameterSpace, solution: Solution, known: _Known, start: int, growth: LateGrowth
) -> Iterator[PartGrowth]:
    """Yield how each kind of part grows; the expansions stand in the parameters from `start` on."""
    for name, members in MEMBERS.items():
        where = slice(start + members.start, start + members.stop)
        stated = float(space.stated_expansion[members].mean())
        deviation, determined = known.of_mean(where)
        yield PartGrowth(
            part=name,
            stated=stated,
            expansion=stated + float(solution.x[where].mean()),
            deviation=deviation,
            determined=determined,
            late=tuple(growth.expansion[members].mean(axis=0).tolist()),
        )


def warming_text(warming: HeatSeen) -> str:
    """Return what readings tell of heat and humidity, for people; empty where neither was read."""
    parts = [_heat_text(warming)] if warming.changes else []
    return "\n".join([*parts, *([] if warming.swelling is None else [_swelling_text(warming.swelling)])])


def _swelling_text(swelling: Swelling) -> str:
    head = f"humidity; changed by {100.0 * swelling.change:.1f} %: struts grow by {1e4 * swelling.moisture:.2f}"
    stated = f"ppm per % (stated {1e4 * swelling.stated:g})"
    if math.isnan(swelling.deviation):
        least = f"it changed by less than {100.0 * ASSUMED.least_damping:g} %, or growth explains nothing"
        return f"{head} {stated}, as stated: {least}"
    unsure = "" if swelling.determined > SEEN_SHARE else "; these readings do not determine it"
    return f"{head} ± {1e4 * swelling.deviation:.2f} {stated}{unsure}"


def _heat_text(warming: HeatSeen) -> str:
    listed = ", ".join(f"{name} {change:.2f} K" for name, change in warming.changes)
    whose = f"; {warming.thermometer} stands for all parts" if warming.thermometer else ""
    lines = [f"heat; change of each thermometer: {listed}{whose}"]
    if not warming.parts:
        least = f"temperatures changed by less than {ASSUMED.least_warming:g} K, or growth explains nothing"
        lines.append(f"  expansion is not determined: {least}; what was stated stays")
    constants = warming.time_constants
    for p in warming.parts:
        late = zip(p.late, constants.values, strict=True)
        listed = "".join(f", {1e6 * value:+.1f} of it late by {number(constant, 0)} s" for value, constant in late)
        line = (
            f"  {p.part}: {1e6 * p.expansion:.2f} ± {1e6 * p.deviation:.2f} ppm/K (stated {1e6 * p.stated:g}){listed}"
        )
        lines.append(line + ("" if p.determined > SEEN_SHARE else "; these readings do not determine it"))
    for value, deviation in zip(constants.values, constants.deviations, strict=True):
        low, high = (number(value * math.exp(2.0 * way * min(deviation, 1.0)), 0) for way in (-1, 1))
        known = "given" if deviation == 0.0 else f"{low}…{high} s with 95 %" if deviation < 1.0 else "hardly determined"
        lines.append(f"  time constant {number(value, 0)} s ({known})")
    if warming.parts and not warming.timed:
        lines.append("  the readings have no times (time_s): how late parts follow their thermometers is not known")
    return "\n".join(lines)


def warming_json(warming: HeatSeen) -> dict:
    """Return what readings tell of heat as plain numbers; units are in the keys."""
    constants = warming.time_constants
    return {
        "changes_K": dict(warming.changes),
        "thermometer": warming.thermometer or None,
        "parts": [
            {
                "part": p.part,
                "stated_per_K": p.stated,
                "expansion_per_K": p.expansion,
                "standard_error_per_K": p.deviation,
                "determined": p.determined,
                "late_per_K": p.late,
            }
            for p in warming.parts
        ],
        "time_constants_s": constants.values,
        "time_constants_relative_error": constants.deviations,
        "swelling": None
        if warming.swelling is None
        else {
            "humidity_change": warming.swelling.change,
            "stated": warming.swelling.stated,
            "moisture": warming.swelling.moisture,
            "standard_error": None if math.isnan(warming.swelling.deviation) else warming.swelling.deviation,
            "determined": warming.swelling.determined,
        },
    }
