"""Thermal growth and swelling: smoothed sensor readings, time constants of delayed growth, growth found by a fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..formats.texts import number
from ..machine.temperatures import (
    HUMIDITY,
    MOST_TIME_CONSTANTS,
    PARTS,
    REFERENCE_HUMIDITY,
    TIME_CONSTANT_RANGE,
)
from ..measurements.readings import KINDS, MeasurementSet
from .assumptions import ASSUMED
from .blocks.block import Linkage
from .blocks.growth import growth_causes, growth_root, per_growth
from .estimator import (
    Estimation,
    Further,
    LinearProblem,
    Posterior,
    Solution,
    leave_out,
    physical_covariance,
    solve,
)
from .parameters import TOLERANCES, ParameterSpace
from .sensitivity import predict

BIN = 60.0  # shortest time over which a sensor's readings are averaged, s: twice the default filter's time constant

SEEN_SHARE = 0.5
"""Growth counts as determined if the readings lower its prior variance by more than this share."""

MEMBERS = {"struts": slice(0, 6), "base": slice(6, 7), "platform": slice(7, 8)}
"""Indices into :data:`~hexapod_comp.machine.temperatures.PARTS` of each kind of part."""

# Two lags whose combination imitates most delays: time constants as shares of the duration of the measurement
LAGS = np.array([0.1, 0.5])

ROBUST_STEPS = 3
"""Number of steps of the fit that rejects outliers before the search for time constants."""

NO_WEIGHT = 1e-6
"""Weight of a rejected reading; with a weight of 0 the mean of rejected readings alone would be 0/0."""

SPANS = 12
"""The jackknife over time divides the readings by time into this number of parts, and leaves out one at a time."""

# Smallest prior σ, SI, with which the reported ± of growth is computed: wide enough for any material
LEAST_KNOWN = {
    "expansion": ASSUMED.known_expansion,
    "late": 3.0 * ASSUMED.known_expansion,
    "moisture": ASSUMED.known_moisture,
}

# Smoothing of sensor readings

PACE, APART = 4.0, 128.0
"""If readings have no times: assumed time from one station to the next, and pause between runs, s."""

MOST_BINS = 400
"""Largest number of bins over which a sensor's readings are averaged: limits the size of dense matrices."""

RATIOS = np.geomspace(1e-4, 1e10, 43)
"""Tried ratios: variance of (rate of change · rate_persistence) / noise variance of a bin. At the smallest the smoothed
course is constant, at the largest it is the bins' means."""


def with_courses(measurements: MeasurementSet) -> MeasurementSet:
    """Return the measurement set with each sensor's readings smoothed over time, so that they are free of noise.

    A fit to noisy temperatures would underestimate growth (attenuation); the remedy is regression calibration (Carroll
    et al. 2006, *Measurement Error in Nonlinear Models*). If readings have no times, each run is smoothed by itself.
    """
    stations = measurements.stations
    read = np.column_stack([stations.temperatures, stations.humidity])
    live = np.flatnonzero(np.isfinite(read).all(axis=0) & (np.ptp(read, axis=0) > 0.0))
    if not len(live):
        return measurements
    times, run_of = stations.times, np.zeros(len(stations), dtype=int)
    if not np.isfinite(times).all():
        run_of[measurements.station] = measurements.run
        times = PACE * np.arange(len(stations)) + APART * run_of
    order = np.argsort(times, kind="stable")
    members = [order[run_of[order] == run] for run in np.unique(run_of)]
    stairs = [_stairs(times[order], read[order, sensor]) for sensor in live]
    for width in {width for width, _ in stairs}:
        sensors = [n for n, stair in enumerate(stairs) if stair[0] == width]
        rows = live[sensors]
        courses = [_Course(times[part], read[part][:, rows], width) for part in members]
        ratios = _ratios(courses, np.array([stairs[n][1] for n in sensors]))
        for part, course in zip(members, courses, strict=True):
            read[np.ix_(part, rows)] = course.at(times[part], ratios)
    return replace(measurements, stations=replace(stations, temperatures=read[:, :-1], humidity=read[:, -1]))


def _stairs(times: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the width of a sensor's bins, s, and the variance of a bin's mean that is due to rounded readings.

    Rounded readings form a staircase: a bin is at least as long as the mean time between two steps.
    """
    pauses = np.diff(times)
    shortest = max(BIN, float(pauses.sum()) / MOST_BINS)
    steps = np.diff(np.unique(values))
    step = float(steps.min())
    if np.abs(steps / step - np.round(steps / step)).max() > 1e-3:
        return shortest, 0.0
    read = float(np.minimum(pauses, BIN).sum())
    stair = read / (1.0 + float(np.abs(np.diff(values)).sum()) / step)
    return max(shortest, stair), step**2 / 12.0 * min(1.0, stair / shortest)


class _Course:
    """The values of sensors over time, without noise.

    The rate of change of a value persists for about an hour: the value is an integrated Ornstein–Uhlenbeck process.
    """

    def __init__(self, times: np.ndarray, values: np.ndarray, width: float) -> None:
        bins = max(1, round(float(times[-1] - times[0]) / width))
        edges = np.linspace(times[0], times[-1], bins + 1)[:-1]
        starts = np.unique(np.searchsorted(times, edges))
        count = np.diff(np.append(starts, len(times)))
        self._at = np.add.reduceat(times, starts) / count
        self._means = np.add.reduceat(values, starts) / count[:, None]
        self._covariance = self._process(self._at)
        away = np.linalg.qr(np.ones((len(count), 1)), mode="complete")[0][:, 1:]
        variances, turned = np.linalg.eigh(away.T @ self._covariance @ away)
        self.variances, self._directions = np.maximum(variances, 0.0), away @ turned
        self.parts = self._directions.T @ self._means  # along eigenvectors of the bins' prior covariance

    def _process(self, times: np.ndarray) -> np.ndarray:
        """Return the prior covariance (n, bins) of a sensor's values at `times` with its values in the bins.

        With times in units of rate_persistence, the value's rates of change at u and v have the prior covariance
        e^−|u−v|. The integrals of the rate from the first bin's middle, 0, to s and to t have the covariance
        2·min(s, t) + e^−s + e^−t − 1 − e^−|s−t|. Before the first bin, the value changes at a constant rate.
        """
        t, s = ((part - self._at[0]) / ASSUMED.rate_persistence for part in (times[:, None], self._at))
        t, early = np.maximum(t, 0.0), np.minimum(t, 0.0)
        whole = 2.0 * np.minimum(s, t) + np.exp(-s) + np.exp(-t) - 1.0 - np.exp(-np.abs(s - t))
        return np.asarray(whole + early * -np.expm1(-s))

    def at(self, times: np.ndarray, ratios: np.ndarray) -> np.ndarray:
        """Return the sensors' most probable values (n, sensors) at `times`; `ratios`: one of RATIOS for each."""
        weights = self._directions @ (self.parts / (1.0 / ratios + self.variances[:, None]))
        level = (self._means - self._covariance @ weights).mean(axis=0)
        return np.asarray(level + self._process(times) @ weights)


def _ratios(courses: list[_Course], least: np.ndarray) -> np.ndarray:
    """Return for each sensor the likeliest of RATIOS (restricted likelihood); `least` has the least noise variances."""
    variances = np.concatenate([course.variances for course in courses])
    parts = np.concatenate([course.parts for course in courses])
    if not len(variances):
        return np.full(len(least), RATIOS[0])
    spread = 1.0 + np.outer(RATIOS, variances)
    squares = (parts**2).T @ (1.0 / spread).T  # sensors, ratios
    noise = np.maximum(squares / len(variances), np.maximum(least, np.finfo(float).tiny)[:, None])
    minus_twice_log = len(variances) * np.log(noise) + squares / noise + np.log(spread).sum(axis=1)
    return RATIOS[np.argmin(minus_twice_log, axis=1)]


# Time constants


class TimeConstant(NamedTuple):
    """Time constant of the first-order lag with which growth follows a thermometer."""

    value: float  # s
    deviation: float  # standard deviation of log(value); 0 if the user states the value


def estimate_time_constants(
    measurements: MeasurementSet, space: ParameterSpace, progress: Callable[[str], object]
) -> tuple[TimeConstant, ...]:
    """Return time constants of delayed growth; () if they raise the log evidence by less than ASSUMED.clear_evidence.

    With fixed time constants, growth is linear in the expansions; each constant of a grid, and each pair, is tried.
    """
    settings, times = space.settings, measurements.stations.times
    if "late" not in settings.blocks or settings.time_constants is not None or not np.ptp(times) > 0.0:
        return ()
    progress("searching for time constants of thermal growth")
    grid = np.ptp(times) * np.geomspace(1.0 / 200.0, 2.0, 40)  # time constants, each 17 % larger than the previous one
    grid = grid[(grid >= TIME_CONSTANT_RANGE[0]) & (grid <= TIME_CONSTANT_RANGE[1])]
    if len(grid) < 3:
        return ()
    # With two fixed lags, which together imitate most delays, the first fit does not reject delayed growth as outliers
    lagging = ParameterSpace(measurements, replace(settings, time_constants=tuple(np.ptp(times) * LAGS)))
    first = _first_fit(Estimation(measurements, lagging))
    x, tolerances = space.carried_over(lagging, first.x, first.tolerances)
    scan = _Scan(Estimation(measurements, space), grid, first._replace(x=x, tolerances=tolerances))
    best, gain = scan.best(1)
    if gain < ASSUMED.clear_evidence:
        return ()
    pair, gain_of_pair = scan.best(MOST_TIME_CONSTANTS)
    return scan.refined(pair if gain_of_pair > gain + ASSUMED.clear_evidence else best)


class _FirstFit(NamedTuple):
    x: np.ndarray  # (size,): parameters, SI
    weights: np.ndarray  # (N,): robust weight of each reading, 0…1
    tolerances: np.ndarray  # (blocks,): standard deviation of each block's prior
    noise: np.ndarray  # (kinds,): factor on the stated standard deviation of each kind's readings


def _first_fit(estimation: Estimation) -> _FirstFit:
    """Return a fit that rejects outliers (reweighted least squares; Rousseeuw & Leroy 1987).

    The first step is a least-squares fit linearised at the nominal machine; the next steps use Huber's weights.
    """
    space, weights = estimation.space, np.ones(len(estimation.measurements))
    x, tolerances, noise = np.zeros(space.size), space.start_tolerances(), np.ones(len(KINDS))
    for _ in range(ROBUST_STEPS if space.settings.robust else 1):
        problem, _ = estimation.linearise(x, weights)
        posterior = solve(space, problem, tolerances, noise)
        x, tolerances, noise = space.physical(posterior.every(space.size)), posterior.tolerances, posterior.noise
        if space.settings.robust:
            problem, residuals = estimation.linearise(x, weights)
            weights = estimation.robust_weights(residuals / problem.uncertainty)
    rejected = weights < ASSUMED.huber / ASSUMED.outlier
    return _FirstFit(x, np.where(rejected, NO_WEIGHT, 1.0), tolerances, noise)


def _per_growth(estimation: Estimation, x: np.ndarray) -> np.ndarray:
    """Return the derivatives (C, 8) of C mean readings, m or rad, by the relative growth of each of the 8 parts."""
    space, means, stations = estimation.space, estimation.means, estimation.measurements.stations
    linkage = Linkage(predict(space, x, stations), space.probe, stations)
    columns = linkage.per_length @ per_growth(linkage)
    return np.einsum("ci,cip->cp", means.directions, columns[means.station])


def _late_columns(
    estimation: Estimation, problem: LinearProblem, x: np.ndarray, constants: np.ndarray, size: float
) -> np.ndarray:
    """Return the changes of C mean readings / σ by a late growth `size`, 1/K, of each part with each time constant."""
    lag = growth_causes(estimation.space.settings, estimation.measurements.stations, constants)
    lag = lag[estimation.means.station, :, 1:]
    columns = (_per_growth(estimation, x)[:, :, None] * lag).transpose(0, 2, 1) @ (size * growth_root(1))
    return problem.free_of_nuisance(columns.reshape(len(columns), -1))


class _Scan:
    """Log(p(readings | growth with time constants of `grid`) / p(readings | growth without delay))."""

    def __init__(self, estimation: Estimation, grid: np.ndarray, fit: _FirstFit) -> None:
        problem, _ = estimation.linearise(fit.x, fit.weights)
        posterior = solve(estimation.space, problem, fit.tolerances, fit.noise, rounds=0)
        columns = _late_columns(estimation, problem, fit.x, grid, TOLERANCES["late"])
        self._grid, self._further = grid, Further.of(problem, posterior, columns)

    def gain(self, chosen: Sequence[int]) -> float:
        every, members = self._further, np.add.outer(len(PARTS) * np.array(chosen), np.arange(len(PARTS))).ravel()
        part = every.information[np.ix_(members, members)], every.moment[members], every.moved[:, members]
        return Further(*part).gain

    def best(self, count: int) -> tuple[tuple[int, ...], float]:
        """Return the indices of the `count` time constants that have the largest log Bayes factor, and this factor."""
        gains = {chosen: self.gain(chosen) for chosen in combinations(range(len(self._grid)), count)}
        best = max(gains, key=gains.__getitem__)
        return best, gains[best]

    def refined(self, chosen: tuple[int, ...]) -> tuple[TimeConstant, ...]:
        """Return the time constants at the top of a parabola through the log Bayes factors of neighbouring grid points.

        The parabola's second derivatives give the time constants' standard deviations. A time constant at an end of the
        grid, or beside the grid point of the other time constant, stays there; its standard deviation is infinite.
        """

        def moved(steps: dict[int, int]) -> float:
            return self.gain([n + steps.get(i, 0) for i, n in enumerate(chosen)])

        step = np.log(self._grid[1] / self._grid[0])
        values, deviations = self._grid[list(chosen)], np.full(len(chosen), math.inf)
        inside = [i for i, n in enumerate(chosen) if 0 < n < len(self._grid) - 1 and not {n - 1, n + 1} & {*chosen}]
        here, curvature = self.gain(chosen), np.zeros((len(inside), len(inside)))
        for a, i in enumerate(inside):
            before, after = (moved({i: way}) for way in (-1, 1))
            curvature[a, a] = 2.0 * here - before - after
            values[i] *= np.exp(step * 0.5 * (after - before) / curvature[a, a])
            for b, j in enumerate(inside[:a]):
                corners = [(u, v, u * v) for u in (-1, 1) for v in (-1, 1)]
                curvature[a, b] = curvature[b, a] = -0.25 * sum(w * moved({i: u, j: v}) for u, v, w in corners)
        if (np.linalg.eigvalsh(curvature) > 0.0).all():
            deviations[inside] = step * np.sqrt(np.diag(np.linalg.inv(curvature)))
        return tuple(map(TimeConstant, values.tolist(), deviations.tolist()))


# Growth found by a fit


class SensorRange(NamedTuple):
    sensor: str
    lowest: float
    highest: float
    unit: str  # degC; 1 for relative humidity from 0 to 1


class Growth(NamedTuple):
    """Relative growth of the struts, the base or the platform: per kelvin, or from 0 to 100 % humidity."""

    part: str  # struts (their mean), base or platform
    unit: str  # 1/K by heat, m/m by humidity from 0 to 1
    stated: float
    found: float
    deviation: float  # standard error of `found`; NaN if the growth was not fitted
    determined: float  # 1 − variance / prior variance: 0: by the prior alone … 1: by the readings alone
    late: tuple[float, ...] = ()  # part of `found` that follows with each time constant, 1/K


@dataclass(frozen=True)
class ThermalEvidence:
    ranges: tuple[SensorRange, ...]  # of each thermometer that was read, and of the humidity if struts swell
    thermometer: str  # part whose thermometer is used for all parts; empty: each part has its own
    growths: tuple[Growth, ...]  # by heat if the block `expansion` is fitted, by humidity if struts swell
    time_constants: tuple[TimeConstant, ...]
    timed: bool  # whether the readings have times

    @staticmethod
    def of(
        measurements: MeasurementSet,
        estimation: Estimation,
        solution: Solution,
        constants: tuple[TimeConstant, ...],
        factor: float,
    ) -> ThermalEvidence:
        space, stations, x = estimation.space, measurements.stations, solution.x
        late = space.model(x, with_field=False).late_growth
        if late.time_constants and not constants:  # given
            constants = tuple(TimeConstant(value, 0.0) for value in late.time_constants)
        ends = zip(stations.temperatures.min(axis=0).tolist(), stations.temperatures.max(axis=0).tolist(), strict=True)
        read = stations.thermometers
        ranges = [SensorRange(p, *end, "degC") for p, end in zip(PARTS, ends, strict=True) if p in read]
        covariance, between, prior = _uncertainty(estimation, solution, constants, factor)

        def fitted(part: str, unit: str, stated: float, where: slice, late_parts: tuple[float, ...] = ()) -> Growth:
            within, observed, before = (float(matrix[where, where].mean()) for matrix in (covariance, between, prior))
            variance = max(within, observed)
            known = max(0.0, 1.0 - variance / before)
            return Growth(part, unit, stated, stated + float(x[where].mean()), math.sqrt(variance), known, late_parts)

        growths, heat, damp = list[Growth](), space.block("expansion"), space.block("moisture")
        if heat is not None:
            for part, members in MEMBERS.items():
                where = slice(heat.part.start + members.start, heat.part.start + members.stop)
                late_parts = tuple(late.expansion[members].mean(axis=0).tolist())
                growths.append(fitted(part, "1/K", float(space.stated_expansion[members].mean()), where, late_parts))
        if space.swells:
            humidity, stated = np.nan_to_num(stations.humidity, nan=REFERENCE_HUMIDITY), space.settings.strut_moisture
            ranges.append(SensorRange(HUMIDITY, float(humidity.min()), float(humidity.max()), "1"))
            unknown = Growth("struts", "m/m", stated or 0.0, stated or 0.0, math.nan, 0.0)
            growths.append(unknown if damp is None else fitted("struts", "m/m", stated or 0.0, damp.part))
        return ThermalEvidence(
            ranges=tuple(ranges),
            thermometer=space.settings.thermometer,
            growths=tuple(growths),
            time_constants=constants if late.time_constants else (),
            timed=bool(np.isfinite(stations.times).all()),
        )


def _uncertainty(
    estimation: Estimation, solution: Solution, constants: tuple[TimeConstant, ...], factor: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three covariances of all parameters, SI: of the posterior, by the jackknife over time, and of the priors.

    The posterior's covariance includes errors of the time constants and, with one thermometer for all parts and no time
    constant, delayed growth that the readings do not exclude.
    """
    space, noise, problem = estimation.space, solution.posterior.noise, solution.problem
    # The prior's σ of growth, estimated from three numbers at most, may be far too small
    least = [LEAST_KNOWN.get(block.name, 0.0) for block in space.blocks]
    posterior = solve(space, problem, np.maximum(solution.posterior.tolerances, least), noise, rounds=0)
    covariance = physical_covariance(space, posterior)
    stations, block, step = estimation.measurements.stations, space.block("late"), 0.02
    if block is not None and constants:
        growth = solution.x[block.part].reshape(len(PARTS), len(constants))
        per_part = _per_growth(estimation, solution.x)
        for k, constant in enumerate(constants):
            shorter, longer = (
                growth_causes(space.settings, stations, [constant.value * math.exp(way)])[:, :, 1]
                for way in (-step, step)
            )
            slope = ((longer - shorter) / (2.0 * step))[estimation.means.station]
            effect = problem.free_of_nuisance((per_part * slope) @ growth[:, k : k + 1])
            moved = space.physical(Further.of(problem, posterior, effect).moved)
            covariance += min(constant.deviation, 1.0) ** 2 * moved @ moved.T
    if space.settings.thermometer and block is None and np.ptp(stations.times) > 0.0:
        constants_unseen = np.ptp(stations.times) * LAGS
        columns = _late_columns(estimation, problem, solution.x, constants_unseen, LEAST_KNOWN["late"])
        late = Further.of(problem, posterior, columns)
        covariance += space.physical(space.physical(late.moved @ late.covariance @ late.moved.T).T)
    between = _jackknife_over_time(estimation, problem, posterior)
    return factor**2 * covariance, between, space.prior_covariance(posterior.tolerances)


def _jackknife_over_time(estimation: Estimation, problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the covariance (size, size) of the growth parameters, SI, by a block jackknife over time (Künsch 1989).

    The posterior assumes independent errors, but a thermometer's error lasts for many readings. The jackknife leaves
    out spans of whole runs, because all readings of a run share the instrument's unknowns.
    """
    space, m = estimation.space, estimation.measurements
    growth = space.members(LEAST_KNOWN)
    covariance = np.zeros((space.size, space.size))
    if not growth.any():
        return covariance
    groups, times = m.run[estimation.means.first], m.stations.times[m.station]
    if np.isfinite(times).all():
        middles = np.bincount(m.run, times) / np.maximum(np.bincount(m.run), 1)
        ends = np.quantile(middles[np.unique(groups)], np.linspace(0.0, 1.0, SPANS + 1)[1:-1])
        groups = np.searchsorted(ends, middles)[groups]
    spread = np.eye(space.size)[:, posterior.used] * posterior.spread
    omitted = leave_out(problem, posterior, groups, space.physical(spread)[growth].T)
    moved = np.array([one.moved for one in omitted])
    covariance[np.ix_(growth, growth)] = (1.0 - 1.0 / len(moved)) * moved.T @ moved
    return covariance


def warming_text(warming: ThermalEvidence) -> str:
    """Return the report on growth; empty if neither temperatures nor humidity were read."""
    lines, known = [], {True: "", False: "; not determined by these readings"}
    heat, damp = ([g for g in warming.growths if g.unit == unit] for unit in ("1/K", "m/m"))
    read = [c for c in warming.ranges if c.sensor != HUMIDITY]
    if listed := ", ".join(f"{c.sensor} {c.lowest:.2f}…{c.highest:.2f} °C" for c in read):
        whose = f"; the thermometer of {warming.thermometer} is used for all parts" if warming.thermometer else ""
        lines.append(f"heat; range of each thermometer: {listed}{whose}")
        if not heat:
            least = f"temperatures changed by less than {ASSUMED.least_warming:g} K, or growth explains no residuals"
            lines.append(f"  expansion is not determined: {least}; the stated value is kept")
        for g in heat:
            late = zip(g.late, warming.time_constants, strict=True)
            listed = "".join(f", {1e6 * v:+.1f} of it with a delay of {number(c.value, 0)} s" for v, c in late)
            grows = f"{1e6 * g.found:.2f} ± {1e6 * g.deviation:.2f} ppm/K (stated {1e6 * g.stated:g})"
            lines.append(f"  {g.part}: {grows}{listed}{known[g.determined > SEEN_SHARE]}")
        for value, deviation in warming.time_constants:
            low, high = (number(value * math.exp(2.0 * way * min(deviation, 1.0)), 0) for way in (-1, 1))
            sure = f"{low}…{high} s with 95 %" if deviation < 1.0 else "hardly determined"
            lines.append(f"  time constant {number(value, 0)} s ({sure if deviation else 'given'})")
        if heat and not warming.timed:
            lines.append("  the readings have no times (time_s): delays behind the thermometers are not known")
    for g in damp:
        ends = next(c for c in warming.ranges if c.sensor == HUMIDITY)
        head = f"humidity {100.0 * ends.lowest:.1f}…{100.0 * ends.highest:.1f} %: struts grow by {1e4 * g.found:.2f}"
        stated = f"ppm per % (stated {1e4 * g.stated:g})"
        if math.isnan(g.deviation):
            low = f"humidity changed by less than {100.0 * ASSUMED.least_damping:g} percentage points"
            lines.append(f"{head} {stated}: the stated value, because {low}, or growth explains no residuals")
        else:
            lines.append(f"{head} ± {1e4 * g.deviation:.2f} {stated}{known[g.determined > SEEN_SHARE]}")
    return "\n".join(lines)
