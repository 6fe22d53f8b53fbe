"""How far a converged fit may be trusted: errors that the parameters' covariance does not contain, and χ².

These errors are estimated by a jackknife over runs, from the discrepancy (Kennedy & O'Hagan 2001) and the drift, and
from the instruments' scale.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.special import gammaincinv, ndtr

from ..machine.arrays import different_rows
from ..measurements.readings import (
    ANGULAR_KINDS,
    BACKWARD,
    DEFAULT_UNCERTAINTY,
    FORWARD,
    KINDS,
    MEDIAN_TO_SIGMA,
    UNKNOWN,
    MeasurementSet,
)
from .assumptions import ASSUMED
from .blocks import MAPS
from .estimator import (
    Estimation,
    Further,
    Omitted,
    Solution,
    jackknife,
    whitened_precision,
    whitened_residuals,
)
from .mistakes import RUN_FAMILIES, family_of_run
from .parameters import FitSettings, ParameterSpace
from .posterior import FirstOrder, box_errors
from .promise import Scatter, Unexplained

TILT = np.radians(10.0)
"""Tilt at which the report states the tool error of a tilted tool."""

WITHOUT_EFFECT = 1e-4
"""Share of the tool's mean squared error in directions that the jackknife leaves out, to save time."""

DRIFT_RUNS, DRIFT_TERMS = 6, 2
"""Fewest runs that read lengths, to estimate a drift; degree of the drift's polynomial in time."""

LEAST_PAIRS = 30  # smallest number of pairs, or repeats, from which a variance is estimated (standard error 26 %)
LEAST_LEFT = 0.25  # smallest share of a discrepancy that is assumed to remain in the residuals of a fit
LEAST_FREE = 3.0  # smallest number of degrees of freedom of a χ² in the report

HELD = 0.5
"""If the posterior's RMS tool error exceeds this share of the priors' tool error, it may depend on the priors."""

FIELDS = ("field displacement", "field rotation")


class ChiSquare(NamedTuple):
    kind: str  # one of KINDS
    part: str  # name of a family of lines, a direction of motion, or a run
    readings: int
    value: float  # sum of the squared residuals divided by the stated variance, per degree of freedom


class Residuals:
    """Residuals of the cells of a converged fit, divided by the estimated noise, and the expected tool error."""

    def __init__(
        self,
        estimation: Estimation,
        solution: Solution,
        # (C, terms): change of each cell's value / its noise, for a drift of one prior standard deviation
        drifting: np.ndarray | None = None,
        # Change of scale from the first to the last reading, and its standard error, m/m; zeros: no drift
        drift: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.estimation, self.solution, self.drift = estimation, solution, drift
        self.drifting = np.zeros((len(estimation.cells.kind), 0)) if drifting is None else drifting
        self.rows, self.residual = whitened_residuals(solution.problem, solution.posterior)
        cells, m = estimation.cells, estimation.measurements
        self.run, self.direction = m.run[cells.first], m.direction[cells.first]

    @cached_property
    def absorbed(self) -> np.ndarray:
        """Share of each cell's variance that fitted parameters and instruments' unknowns absorb (leverage), (C,)."""
        every = np.arange(len(self.residual))
        return self.leverage(every, every)

    @cached_property
    def level(self) -> FirstOrder | None:
        return box_errors(self.estimation.space, self.solution.x)

    @cached_property
    def metrics(self) -> tuple[np.ndarray, np.ndarray]:
        """M for displacement and for rotation: yᵀ·M·y is the tool's mean squared error in the box; 0 without a box."""
        space, used = self.estimation.space, self.solution.posterior.used
        if self.level is None:
            return np.zeros((len(used),) * 2), np.zeros((len(used),) * 2)
        displacement, rotation = (space.whitened(space.whitened(m).T) for m in self.level.mean_squares)
        return displacement[np.ix_(used, used)], rotation[np.ix_(used, used)]

    @property
    def expected(self) -> float:
        """Expected mean squared displacement error of the tool, from the covariance of the parameters, m²."""
        return float(np.vdot(self.metrics[0], self.solution.posterior.covariance))

    @cached_property
    def omitted(self) -> list[Omitted]:
        """Effect of omitting each fold of cross-validation on the tool's error, by eigenvectors of the metric."""
        spread, terms = self.solution.posterior.spread, self.drifting.shape[1]
        values, vectors = np.linalg.eigh(spread[:, None] * self.metrics[0] * spread)
        # Eigenvalues ascend: omit the first directions, which together contribute less than WITHOUT_EFFECT
        kept = np.cumsum(values) > WITHOUT_EFFECT * self.expected
        kept[-1] = True
        effects = np.pad(vectors[:, kept] * np.sqrt(np.maximum(values[kept], 0.0)), ((0, terms), (0, 0)))
        precision = whitened_precision(self.solution.problem, self.solution.posterior)
        cross, own = self.rows.transposed_times(self.drifting), np.eye(terms)
        precision = np.block([[precision, cross], [cross.T, own + self.drifting.T @ self.drifting]])
        rows = self.rows.beside(self.drifting)
        return jackknife(rows, self.residual, precision, self.estimation.cells.fold, effects)

    @cached_property
    def held_out(self) -> np.ndarray:
        """Error of each cell in a fit without the cell's fold, divided by the stated noise, (C,)."""
        problem, posterior = self.solution.problem, self.solution.posterior
        errors = np.empty(len(self.residual))
        for fold in self.omitted:
            errors[fold.cells] = fold.errors
        return errors * posterior.noise[problem.kind]

    def leverage(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return how much parameters and instruments' unknowns lower the covariance of pairs of residuals."""
        p = self.solution.posterior
        by_parameters = self.rows.between(p.covariance / np.outer(p.spread, p.spread), first, second)
        return by_parameters + (self._unknowns[first] * self._unknowns[second]).sum(axis=1)

    @cached_property
    def _unknowns(self) -> csr_array:
        """Changes of the cells by one σ of each of the instruments' unknowns, times √share, (C, unknowns)."""
        count, entries = 0, [(np.zeros(0), (np.zeros(0, dtype=int),) * 2)]
        for part in self.solution.problem.unknowns:
            members, places = np.broadcast_arrays(part.members[:, None], count + np.arange(len(part.share)))
            entries.append(((part.basis * np.sqrt(part.share)).ravel(), (members.ravel(), places.ravel())))
            count += len(part.share)
        values, places = (np.concatenate(part, axis=-1) for part in zip(*entries, strict=True))
        return csr_array((values, tuple(places)), shape=(len(self.residual), max(count, 1)))


def unexplained(r: Residuals, settings: FitSettings, averaged: float) -> Unexplained:
    """Return the errors that a fit's covariance omits; `averaged`: factor on the tool's error due to omitted blocks."""
    ratio, freedom = variance_ratio(r)
    clear = freedom > 0.0 and ratio > 2.0 * gammaincinv(0.5 * freedom, 1.0 - 2.0 * ndtr(-ASSUMED.clear)) / freedom
    factor = np.sqrt(ratio) if clear else 1.0
    prior, prior_of_rotation = (_of_priors(r, metric) for metric in r.metrics)
    displacement, rotation = discrepancy(r)
    return Unexplained(
        factor=float(factor),
        believed=ASSUMED.jackknife_prior,
        prior=prior,
        prior_rotation=prior_of_rotation,
        displacement=displacement,
        rotation=rotation,
        assumed_backlash=_unread_backlash(r),
        drift=r.drift[0],
        drift_error=r.drift[1],
        scale=stated_scale(r.estimation.measurements, settings),
        ratio=ratio,
        freedom=freedom,
        averaged=averaged,
    )


def stated_scale(measurements: MeasurementSet, settings: FitSettings) -> float:
    """Return the standard deviation of the scale of all readings, m/m: the stated or the instruments' usual value.

    If several instruments read lengths, the smallest of their scale errors is used. A laser beam at an angle θ to the
    line of motion measures only the part 1 − θ²/2 of a length.
    """
    kinds = {KINDS[k] for k in np.unique(measurements.kind)}
    known = [value for kind, value in ASSUMED.scales if kind in kinds]
    scale = settings.scale if settings.scale is not None else min(known, default=0.0)
    angle = settings.alignment if settings.alignment is not None else ASSUMED.alignment
    return float(np.hypot(scale, 0.5 * angle**2 if "linear" in kinds else 0.0))


# The jackknife, and drift


def variance_ratio(r: Residuals) -> tuple[float, float]:
    """Return observed / expected Σ (change of the tool's error without a fold)², and the degrees of freedom of the sum.

    The sum is nearly χ² distributed; its variance gives the degrees of freedom (Satterthwaite), at most folds − 1.
    """
    if not r.expected > 0.0 or len(r.omitted) < 2:
        return 1.0, 0.0
    sums = [(o.moved @ o.moved, np.trace(o.covariance), np.vdot(o.covariance, o.covariance)) for o in r.omitted]
    observed, expected, squares = np.transpose(sums).sum(axis=1)
    return float(observed / expected), float(min(expected**2 / squares, len(r.omitted) - 1))


def with_drift(estimation: Estimation, solution: Solution) -> Residuals:
    """Return the residuals of a fit; a polynomial drift of scale in time is added if it raises the evidence.

    A warming machine, or changing air of a laser, stretches all lengths from the middle of the box. The result is exact
    for a linear problem with the priors' σ and the noise of `solution`.
    """
    m, cells = estimation.measurements, estimation.cells
    posterior, problem = solution.posterior, solution.problem
    r = Residuals(estimation, solution)
    lengths = ~np.isin(cells.kind, [KINDS.index(kind) for kind in (*ANGULAR_KINDS, "straightness")])
    if len(np.unique(r.run[lengths])) < DRIFT_RUNS:
        return r
    count = np.bincount(cells.of_reading)
    place = np.bincount(cells.of_reading, np.arange(len(m))) / count
    time = 2.0 * place / max(len(m) - 1, 1) - 1.0
    points = m.points()[cells.station]
    growth = np.where(lengths, np.einsum("ci,ci->c", cells.directions[:, :3], points - points.mean(axis=0)), 0.0)
    legendre = np.polynomial.legendre.legvander(time, DRIFT_TERMS)[:, 1:]
    columns = problem.free_of_nuisance(ASSUMED.drift * growth[:, None] * legendre)
    drift = Further.of(problem, posterior, columns)
    if drift.gain < 0.0:
        return r
    values, moved = drift.mean, drift.moved @ drift.mean
    columns /= posterior.noise[cells.kind][:, None]
    change = r.rows.times(moved / posterior.spread) + columns @ values
    covariance = posterior.covariance + drift.moved @ drift.covariance @ drift.moved.T
    known = replace(posterior, y=posterior.y + moved, covariance=covariance)
    of_cells = posterior.noise[problem.kind]
    target = problem.target - of_cells * (columns @ values)
    residuals = solution.residuals - (of_cells * change / problem.scale)[cells.of_reading]
    settled = replace(
        solution,
        problem=replace(problem, target=target),
        posterior=known,
        x=estimation.space.physical(known.every(estimation.space.size)),
        residuals=residuals,
    )
    size, error = 2.0 * ASSUMED.drift * np.array([abs(values[0]), drift.covariance[0, 0] ** 0.5])
    return Residuals(estimation, settled, columns, (float(size), float(error)))


# The discrepancy


class LackOfFit(NamedTuple):
    """Variances of one kind of readings beyond its stated noise, m² or rad²; 0 if not significant."""

    common: float = 0.0  # variance of errors equal in both directions; includes the share that parameters absorb
    most_common: float = 0.0  # upper bound of `common`
    other: float = 0.0  # variance of errors that differ between the directions but not between repeats
    stops: float = 0.0  # pure error: variance of readings repeated at one place
    most_stops: float = 0.0


def discrepancy(r: Residuals) -> tuple[Scatter, Scatter]:
    """Return the tool's displacement, m, and rotation, rad, that no parameter describes, from the residuals.

    Readings repeated at one place show the pure error; the remaining variance beyond the stated noise is lack of fit
    (Draper & Smith 1998), an error of the machine such as lost motion by friction.
    """
    kinds = np.unique(r.estimation.cells.kind)
    found = []
    for angular in (False, True):
        some = [k for k in kinds if (KINDS[k] in ANGULAR_KINDS) == angular]
        cells = [int((r.estimation.cells.kind == k).sum()) for k in some]
        mean = np.average([lack_of_fit(r, k) for k in some], 0, cells) if some else np.zeros(len(LackOfFit._fields))
        found.append(LackOfFit(*np.sqrt(3.0 * mean).tolist()))  # RMS over all three axes from the variance of one axis
    displacement, rotation = found
    space, sizes = r.estimation.space, r.solution.posterior.tolerances
    fields = {b.name: size for b, size in zip(space.blocks, sizes, strict=True) if b.name in FIELDS and size > 0.0}
    shifted, turned = displacement.common, rotation.common
    if len(fields) == len(FIELDS):
        # Errors finer than the fitted polynomials show first where they are large compared with the noise, usually in
        # rotations: infer the displacements' lack of fit from the rotations', and vice versa, if readings allow it
        ratio = float(fields[FIELDS[0]] / fields[FIELDS[1]])
        shifted = max(shifted, min(rotation.common * ratio, displacement.most_common))
        turned = max(turned, min(displacement.common / ratio, rotation.most_common))
    lacks = np.hypot(shifted, displacement.other), np.hypot(turned, rotation.other)
    return tuple(  # type: ignore[return-value]
        Scatter(float(lack), part.stops, part.most_stops) for lack, part in zip(lacks, found, strict=True)
    )


def lack_of_fit(r: Residuals, kind: int) -> LackOfFit:
    """Return the lack of fit of one kind of reading; before the last line, variances are in units of the stated one."""
    m, estimated = r.estimation.measurements, float(r.solution.posterior.noise[kind] ** 2)
    readings, cells = int((m.kind == kind).sum()), int((r.estimation.cells.kind == kind).sum())
    # Pure error: variance of the readings about their cell's mean, divided by the stated variance
    members, of_reading = np.flatnonzero(m.kind == kind), r.estimation.cells.of_reading
    cell, weights = of_reading[members], r.solution.weights[members]
    values = r.solution.residuals[members] / r.estimation.uncertainty[members]
    mean = np.bincount(cell, weights * values)[cell] / np.bincount(cell, weights)[cell]
    freedom = float(readings - cells)
    repeated = float(((weights * (values - mean)) ** 2).sum()) / max(freedom, 1.0)
    pure, error = (repeated, repeated * np.sqrt(2.0 / freedom)) if freedom >= LEAST_PAIRS else (1.0, 0.0)
    stops = _significant(pure - 1.0, error)
    # Pairs of cells of one run and channel that were read forward and backward at the same pose
    stations, every = m.stations, r.estimation.cells
    poses = np.hstack([stations.positions, stations.rotations.reshape(-1, 9)]).round(9)
    pose = different_rows(poses)[1][every.station]
    key = different_rows(np.stack([r.run, every.channel, pose], axis=1))[1]
    ways = [np.flatnonzero((every.kind == kind) & (r.direction == way)) for way in (FORWARD, BACKWARD)]
    _, first, second = np.intersect1d(key[ways[0]], key[ways[1]], return_indices=True)
    forward, backward = ways[0][first], ways[1][second]
    other, of_readings = estimated - 1.0 - stops, estimated * np.sqrt(2.0 / readings)
    if len(forward) >= LEAST_PAIRS:
        # A cell's residual is divided by the noise of the cell's mean, which is smaller than one reading's noise.
        covariance, kept = _common_variance(r, forward, backward)
        share, of_pairs = cells / readings, estimated / np.sqrt(len(forward))
        common, of_common = covariance * estimated * share / kept, of_pairs * share / kept
        other -= covariance * estimated * share
        of_readings = np.hypot(of_readings, of_pairs)
    else:  # too few pairs to separate errors common to both directions: count all errors as common
        common, of_common, other = other, of_readings, 0.0
    found = LackOfFit(
        common=_significant(common, of_common),
        most_common=max(common, ASSUMED.clear * of_common),
        other=_significant(other, np.hypot(of_readings, error)),
        stops=stops,
        most_stops=stops + 2.0 * error if stops else 0.0,
    )
    return LackOfFit(*(m.stated_of(kind) ** 2 * np.array(found)).tolist())


def _significant(variance: float, error: float) -> float:
    """Return a variance if it exceeds `ASSUMED.clear` standard errors; otherwise 0."""
    return variance if variance > ASSUMED.clear * error else 0.0


def _common_variance(r: Residuals, forward: np.ndarray, backward: np.ndarray) -> tuple[float, float]:
    """Return (variance of errors common to both directions) / (noise variance), and the share left in the residuals.

    The fit correlates the residuals of a pair of cells negatively; `absorbed` corrects this. Clipping at 2 σ, against
    instruments that slip, reduces the covariance of normal residuals to (P(|x| < 2))² = 0.911.
    """
    # σ is at least the residuals' own σ, because each place may have its own error
    limit = 2.0 * max(1.0, MEDIAN_TO_SIGMA * float(np.median(np.abs(r.residual[forward]))))
    clipped = np.clip(r.residual, -limit, limit)
    absorbed = r.leverage(forward, backward)
    common = (clipped[forward] * clipped[backward] / 0.911 + absorbed).mean()
    return float(common), float(max(1.0 - (r.absorbed[forward] + absorbed).mean(), LEAST_LEFT))


def _unread_backlash(r: Residuals) -> float:
    """Return the tool's RMS displacement, m, by half of the assumed backlash; 0 if readings state their direction."""
    m, space = r.estimation.measurements, r.estimation.space
    if (m.direction != UNKNOWN).any() or space.block("backlash") is not None:
        return 0.0
    alone = ParameterSpace((space.geometry, space.region), replace(space.settings, blocks=("backlash",)))
    errors, block = box_errors(alone, np.zeros(alone.size)), alone.block("backlash")
    if errors is None or block is None:
        return 0.0
    sizes = np.diag(errors.mean_squares[0])[block.part] * block.tolerance**2
    return float(np.sqrt(sizes.sum()))


# Priors, and χ²


def _of_priors(r: Residuals, metric: np.ndarray) -> float:
    """Return the standard deviation of log(expected tool error), because the priors' σ, T, are estimates.

    A T estimated from n parameters has the relative error 1/√(2n); a relative error ε of T changes the log by
    ε·tr(M·C·T⁻²·C)/tr(M·C), with M the `metric` and C = (N + T⁻²)⁻¹ the covariance after readings of information N.
    Fine terms, extrapolated from coarse ones, add `ASSUMED.fine_terms`.
    """
    posterior = r.solution.posterior
    expected = float(np.vdot(metric, posterior.covariance))
    if not expected > 0.0:
        return 0.0
    held = np.einsum("ij,ji->i", posterior.covariance @ metric, posterior.covariance) / posterior.spread**2
    variance = 0.0
    for block in r.estimation.space.blocks:
        members = posterior.within(block.part)
        share = held[members].sum() / expected
        variance += 0.5 * share**2 / max(posterior.determined[members].sum(), 1.0)
        variance += (share * ASSUMED.fine_terms) ** 2 if block.name in MAPS else 0.0
    return float(np.sqrt(variance))


def held_by_priors(r: Residuals) -> bool:
    metric, posterior, m = r.metrics[0], r.solution.posterior, r.estimation.measurements
    prior, left = (np.sqrt(np.trace(metric @ part)) for part in (np.diag(posterior.spread**2), posterior.covariance))
    noise = r.estimation.uncertainty * posterior.noise[m.kind]
    lengths = ~np.isin(m.kind, [KINDS.index(kind) for kind in ANGULAR_KINDS])
    return bool(left > max(HELD * prior, np.median(noise[lengths]) if lengths.any() else 0.0))


def note_on_unstated(m: MeasurementSet) -> str:
    kinds = np.unique(m.kind[~np.isfinite(m.uncertainty)])
    listed = [f"{KINDS[k]} {DEFAULT_UNCERTAINTY[KINDS[k]] * 1e6:g} µm" for k in kinds if KINDS[k] not in ANGULAR_KINDS]
    if not listed:
        return ""
    problem = f"no uncertainty is stated ({', '.join(listed)} assumed)"
    return f"{problem}: the expected tool error omits scatter of the machine's stops below this value"


def chi_squares(r: Residuals) -> tuple[tuple[ChiSquare, ...], tuple[ChiSquare, ...]]:
    """Return χ² per degree of freedom by line family and by direction; and by run, the largest first."""
    m, solution, of_reading = r.estimation.measurements, r.solution, r.estimation.cells.of_reading
    freedom = 1.0 - (r.absorbed / np.bincount(of_reading))[of_reading]
    squares = (solution.weights * solution.residuals / r.estimation.uncertainty) ** 2
    groups = (
        (family_of_run(m)[m.run], dict(enumerate(RUN_FAMILIES))),
        (m.direction, {FORWARD: "forward", BACKWARD: "backward"}),
        (m.run, dict(enumerate(run.name for run in m.runs))),
    )
    parts: list[list[ChiSquare]] = [[], [], []]
    for part, (numbers, names) in zip(parts, groups, strict=True):
        for k in np.unique(m.kind):
            for number, name in names.items():
                members = (m.kind == k) & (numbers == number)
                if freedom[members].sum() > LEAST_FREE:
                    value = float(squares[members].sum() / freedom[members].sum())
                    part.append(ChiSquare(KINDS[k], name, int(members.sum()), value))
    return (*parts[0], *parts[1]), tuple(sorted(parts[2], key=lambda part: -part.value))
