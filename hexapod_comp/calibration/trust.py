"""How far a converged fit may be trusted: errors that the parameters' covariance does not contain, and χ².

Errors beyond the covariance are estimated by a jackknife over runs, and from the discrepancy between model and readings
(Kennedy & O'Hagan 2001), a drift in time, and the instruments' scale errors.
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
"""The jackknife omits directions in parameter space that have, in sum, at most this share of the mean square error."""

DRIFT_RUNS, DRIFT_TERMS = 6, 2
"""Fewest runs with readings of displacement or distance from which a drift is estimated; its degree in time."""

LEAST_PAIRS = 30  # smallest number of pairs, or repeats, from which a variance is estimated (standard error 26 %)
LEAST_LEFT = 0.25  # lower bound of the share of a discrepancy's variance that is left in the residuals of a fit
LEAST_FREE = 3.0  # the report omits a χ² with at most this many degrees of freedom

HELD = 0.5
"""A posterior RMS tool error above this fraction of the prior RMS tool error counts as determined by the priors."""

FIELDS = ("field displacement", "field rotation")


class ChiSquare(NamedTuple):
    kind: str  # one of KINDS
    part: str  # name of a family of lines, a direction of motion, or a run
    readings: int
    value: float  # Σ residual² / (stated variance · degrees of freedom)


class Residuals:
    """Residuals of a converged fit, (mean reading − fit) / estimated σ, and the tool error that they suggest."""

    def __init__(
        self,
        estimation: Estimation,
        solution: Solution,
        # (C, terms): change of each mean reading, in σ, by one prior standard deviation of each term of a drift
        drifting: np.ndarray | None = None,
        # Relative change of scale from the first to the last reading, and its standard error, m/m; zeros: no drift
        drift: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.estimation, self.solution, self.drift = estimation, solution, drift
        self.drifting = np.zeros((len(estimation.means.kind), 0)) if drifting is None else drifting
        self.rows, self.residual = whitened_residuals(solution.problem, solution.posterior)
        means, m = estimation.means, estimation.measurements
        self.run, self.direction = m.run[means.first], m.direction[means.first]

    @cached_property
    def absorbed(self) -> np.ndarray:
        """Leverage (C,) of each mean reading, 0…1: its residual has the variance (1 − leverage)·σ²."""
        every = np.arange(len(self.residual))
        return self.leverage(every, every)

    @cached_property
    def level(self) -> FirstOrder | None:
        return box_errors(self.estimation.space, self.solution.x)

    @cached_property
    def metrics(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrices M for displacement and rotation: δy causes the mean square tool error δyᵀ·M·δy; 0 without a box."""
        space, used = self.estimation.space, self.solution.posterior.used
        if self.level is None:
            return np.zeros((len(used),) * 2), np.zeros((len(used),) * 2)
        displacement, rotation = (space.whitened(space.whitened(m).T) for m in self.level.mean_squares)
        return displacement[np.ix_(used, used)], rotation[np.ix_(used, used)]

    @property
    def expected(self) -> float:
        """Expected mean squared displacement error of the tool, m², from the covariance of the parameters."""
        return float(np.vdot(self.metrics[0], self.solution.posterior.covariance))

    @cached_property
    def omitted(self) -> list[Omitted]:
        """The jackknife, without one line, circle or pose at a time; |moved|²: mean square displacement of the tool."""
        spread, terms = self.solution.posterior.spread, self.drifting.shape[1]
        values, vectors = np.linalg.eigh(spread[:, None] * self.metrics[0] * spread)
        # Eigenvalues ascend: omit the first directions, which together contribute less than WITHOUT_EFFECT
        kept = np.cumsum(values) > WITHOUT_EFFECT * self.expected
        kept[-1] = True
        functions = np.pad(vectors[:, kept] * np.sqrt(np.maximum(values[kept], 0.0)), ((0, terms), (0, 0)))
        precision = whitened_precision(self.solution.problem, self.solution.posterior)
        cross, own = self.rows.transposed_times(self.drifting), np.eye(terms)
        precision = np.block([[precision, cross], [cross.T, own + self.drifting.T @ self.drifting]])
        rows = self.rows.beside(self.drifting)
        return jackknife(rows, self.residual, precision, self.estimation.means.fold, functions)

    @cached_property
    def held_out(self) -> np.ndarray:
        """(Mean reading − its prediction by a fit without its line, circle or pose) / stated σ, for C mean readings."""
        problem, posterior = self.solution.problem, self.solution.posterior
        errors = np.empty(len(self.residual))
        for group in self.omitted:
            errors[group.means] = group.errors
        return errors * posterior.noise[problem.kind]

    def leverage(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return by how much fitting lowers the covariance of two residuals / σ, for each pair (`first`, `second`)."""
        p = self.solution.posterior
        by_parameters = self.rows.between(p.covariance / np.outer(p.spread, p.spread), first, second)
        return by_parameters + (self._unknowns[first] * self._unknowns[second]).sum(axis=1)

    @cached_property
    def _unknowns(self) -> csr_array:  # (C, unknowns): basis · √share; products of two rows are parts of the leverage
        count, entries = 0, [(np.zeros(0), (np.zeros(0, dtype=int),) * 2)]
        for part in self.solution.problem.unknowns:
            members, places = np.broadcast_arrays(part.members[:, None], count + np.arange(len(part.share)))
            entries.append(((part.basis * np.sqrt(part.share)).ravel(), (members.ravel(), places.ravel())))
            count += len(part.share)
        values, places = (np.concatenate(part, axis=-1) for part in zip(*entries, strict=True))
        return csr_array((values, tuple(places)), shape=(len(self.residual), max(count, 1)))


def unexplained(r: Residuals, settings: FitSettings, averaged: float) -> Unexplained:
    """Return errors that the parameters' covariance omits; `averaged` is the factor of model averaging on the error."""
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
    """Return the standard deviation of the readings' scale error, m/m: stated, or usual for the kind of instrument.

    With several instruments, it is the smallest of their usual scale errors. A laser beam at an angle θ to the line
    of motion measures only 1 − θ²/2 of a displacement.
    """
    kinds = {KINDS[k] for k in np.unique(measurements.kind)}
    known = [value for kind, value in ASSUMED.scales if kind in kinds]
    scale = settings.scale if settings.scale is not None else min(known, default=0.0)
    angle = settings.alignment if settings.alignment is not None else ASSUMED.alignment
    return float(np.hypot(scale, 0.5 * angle**2 if "linear" in kinds else 0.0))


# The jackknife, and drift


def variance_ratio(r: Residuals) -> tuple[float, float]:
    """Return observed / expected Σ (change of the tool error by leaving out one line, circle or pose)².

    Also return the degrees of freedom of this ratio, which is nearly distributed like χ² (Satterthwaite).
    """
    if not r.expected > 0.0 or len(r.omitted) < 2:
        return 1.0, 0.0
    sums = [(o.moved @ o.moved, np.trace(o.covariance), np.vdot(o.covariance, o.covariance)) for o in r.omitted]
    observed, expected, squares = np.transpose(sums).sum(axis=1)
    return float(observed / expected), float(min(expected**2 / squares, len(r.omitted) - 1))


def with_drift(estimation: Estimation, solution: Solution) -> Residuals:
    """Return a fit's residuals, with a scale that drifts as a polynomial of time, if the drift raises the evidence.

    A warming machine, or air that changes along a laser beam, multiplies all distances from the mean of the measured
    points by one factor. The result is exact if the fit is linear; tolerances and noise stay those of `solution`.
    """
    m, means = estimation.measurements, estimation.means
    posterior, problem = solution.posterior, solution.problem
    r = Residuals(estimation, solution)
    lengths = ~np.isin(means.kind, [KINDS.index(kind) for kind in (*ANGULAR_KINDS, "straightness")])
    if len(np.unique(r.run[lengths])) < DRIFT_RUNS:
        return r
    count = np.bincount(means.of_reading)
    place = np.bincount(means.of_reading, np.arange(len(m))) / count
    time = 2.0 * place / max(len(m) - 1, 1) - 1.0
    points = m.points()[means.station]
    growth = np.where(lengths, np.einsum("ci,ci->c", means.directions[:, :3], points - points.mean(axis=0)), 0.0)
    legendre = np.polynomial.legendre.legvander(time, DRIFT_TERMS)[:, 1:]
    columns = problem.free_of_nuisance(ASSUMED.drift * growth[:, None] * legendre)
    drift = Further.of(problem, posterior, columns)
    if drift.gain < 0.0:
        return r
    values, moved = drift.mean, drift.moved @ drift.mean
    columns /= posterior.noise[means.kind][:, None]
    change = r.rows.times(moved / posterior.spread) + columns @ values
    covariance = posterior.covariance + drift.moved @ drift.covariance @ drift.moved.T
    known = replace(posterior, y=posterior.y + moved, covariance=covariance)
    of_means = posterior.noise[problem.kind]
    target = problem.target - of_means * (columns @ values)
    residuals = solution.residuals - (of_means * change / problem.scale)[means.of_reading]
    without_drift = problem.with_target(target, problem.square)
    # The jackknife over time (thermal.py) takes growth from readings with their drift, which growth may have caused
    vars(without_drift)["moment"] = problem.moment
    settled = replace(
        solution,
        problem=without_drift,
        posterior=known,
        x=estimation.space.physical(known.every(estimation.space.size)),
        residuals=residuals,
    )
    size, error = 2.0 * ASSUMED.drift * np.array([abs(values[0]), drift.covariance[0, 0] ** 0.5])
    return Residuals(estimation, settled, columns, (float(size), float(error)))


# The discrepancy


class LackOfFit(NamedTuple):
    """Variances of one kind of channel beyond its stated noise, m² or rad²; 0 if not significant."""

    common: float = 0.0  # of the machine's errors that are equal forward and backward, also of the part that was fitted
    most_common: float = 0.0  # upper bound of `common`
    other: float = 0.0  # of the machine's errors that differ between forward and backward but not between repeats
    stops: float = 0.0  # of repeated readings at one place (pure error)
    most_stops: float = 0.0  # upper bound of `stops`


def discrepancy(r: Residuals) -> tuple[Scatter, Scatter]:
    """Estimate from residuals the tool's displacement error, m, and rotation error, rad, that no parameter describes.

    The scatter of repeated readings at one place is pure error. Variance beyond pure error and stated noise is lack of
    fit (Draper & Smith 1998): an error of the machine that no block describes, such as lost motion by friction.
    """
    kinds = np.unique(r.estimation.means.kind)
    found = []
    for angular in (False, True):
        some = [k for k in kinds if (KINDS[k] in ANGULAR_KINDS) == angular]
        counts = [int((r.estimation.means.kind == k).sum()) for k in some]
        mean = np.average([lack_of_fit(r, k) for k in some], 0, counts) if some else np.zeros(len(LackOfFit._fields))
        found.append(LackOfFit(*np.sqrt(3.0 * mean).tolist()))  # RMS over all three axes from the variance of one axis
    displacement, rotation = found
    space, sizes = r.estimation.space, r.solution.posterior.tolerances
    fields = {b.name: size for b, size in zip(space.blocks, sizes, strict=True) if b.name in FIELDS and size > 0.0}
    shifted, turned = displacement.common, rotation.common
    if len(fields) == len(FIELDS):
        # Errors of shorter wavelength than the fitted polynomials may exceed the noise of rotations only, or of
        # displacements only: infer one lack of fit from the other, up to the upper bound by its own readings
        ratio = float(fields[FIELDS[0]] / fields[FIELDS[1]])
        shifted = max(shifted, min(rotation.common * ratio, displacement.most_common))
        turned = max(turned, min(displacement.common / ratio, rotation.most_common))
    lacks = np.hypot(shifted, displacement.other), np.hypot(turned, rotation.other)
    return tuple(  # type: ignore[return-value]
        Scatter(float(lack), part.stops, part.most_stops) for lack, part in zip(lacks, found, strict=True)
    )


def lack_of_fit(r: Residuals, kind: int) -> LackOfFit:
    """Return the lack of fit of a kind of channel; the computation divides variances by the stated noise variance."""
    m, estimated = r.estimation.measurements, float(r.solution.posterior.noise[kind] ** 2)
    readings, means = int((m.kind == kind).sum()), int((r.estimation.means.kind == kind).sum())
    # Pure error: variance of repeated readings about their mean, divided by the stated variance
    members, of_reading = np.flatnonzero(m.kind == kind), r.estimation.means.of_reading
    own, weights = of_reading[members], r.solution.weights[members]
    values = r.solution.residuals[members] / r.solution.problem.uncertainty[members]
    mean = np.bincount(own, weights * values)[own] / np.bincount(own, weights)[own]
    freedom = float(readings - means)
    repeated = float(((weights * (values - mean)) ** 2).sum()) / max(freedom, 1.0)
    pure, error = (repeated, repeated * np.sqrt(2.0 / freedom)) if freedom >= LEAST_PAIRS else (1.0, 0.0)
    stops = _significant(pure - 1.0, error)
    # Pairs of mean readings of one run and channel, read forward and backward at the same pose
    stations, every = m.stations, r.estimation.means
    poses = np.hstack([stations.positions, stations.rotations.reshape(-1, 9)]).round(9)
    pose = different_rows(poses)[1][every.station]
    key = different_rows(np.stack([r.run, every.channel, pose], axis=1))[1]
    ways = [np.flatnonzero((every.kind == kind) & (r.direction == way)) for way in (FORWARD, BACKWARD)]
    _, first, second = np.intersect1d(key[ways[0]], key[ways[1]], return_indices=True)
    forward, backward = ways[0][first], ways[1][second]
    other, of_readings = estimated - 1.0 - stops, estimated * np.sqrt(2.0 / readings)
    if len(forward) >= LEAST_PAIRS:
        # A residual is divided by the σ of a mean reading, which is smaller than the σ of a single reading
        covariance, kept = _common_variance(r, forward, backward)
        share, of_pairs = means / readings, estimated / np.sqrt(len(forward))
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
    """Return `variance` if it exceeds ASSUMED.clear times its standard `error`; otherwise 0."""
    return variance if variance > ASSUMED.clear * error else 0.0


def _common_variance(r: Residuals, forward: np.ndarray, backward: np.ndarray) -> tuple[float, float]:
    """Return covariance(forward errors, backward errors) / noise variance, and its share that residuals contain.

    Fitting lowers the covariance of a pair's residuals by :meth:`Residuals.leverage`, so this is added. To limit
    outliers, residuals are clipped at 2 σ, which multiplies the covariance of normal residuals by P(|x| < 2)² = 0.911.
    """
    # σ is at least the residuals' own standard deviation, because each place may have its own error
    limit = 2.0 * max(1.0, MEDIAN_TO_SIGMA * float(np.median(np.abs(r.residual[forward]))))
    clipped = np.clip(r.residual, -limit, limit)
    absorbed = r.leverage(forward, backward)
    common = (clipped[forward] * clipped[backward] / 0.911 + absorbed).mean()
    return float(common), float(max(1.0 - (r.absorbed[forward] + absorbed).mean(), LEAST_LEFT))


def _unread_backlash(r: Residuals) -> float:
    """Return the tool's RMS displacement by half an assumed backlash, m; 0 if any reading states its direction."""
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
    """Return the standard deviation of log(expected tool error) that errors of the blocks' prior σ, T, cause.

    A T estimated from n parameters has the relative error 1/√(2n); a relative error ε of T changes that log by
    ε·tr(M·C·T⁻²·C)/tr(M·C), with M the `metric` and C the posterior covariance. For blocks of smooth functions (MAPS)
    ASSUMED.fine_terms² is added to ε², because the prior of their high terms is extrapolated from low terms.
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
    return f"{problem}: the expected tool error omits scatter of the machine's stops below this uncertainty"


def chi_squares(r: Residuals) -> tuple[tuple[ChiSquare, ...], tuple[ChiSquare, ...]]:
    """Return two lists of χ² per degree of freedom: by family of lines and by direction; by run, largest first."""
    m, solution, of_reading = r.estimation.measurements, r.solution, r.estimation.means.of_reading
    freedom = 1.0 - (r.absorbed / np.bincount(of_reading))[of_reading]
    squares = (solution.weights * solution.residuals / solution.problem.uncertainty) ** 2
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
