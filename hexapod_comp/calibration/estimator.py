"""The estimator: robust Gauss–Newton steps, each a linear Bayesian problem; instruments' unknowns are projected out.

MacKay's fixed point of the evidence estimates the standard deviation of each block's prior (its tolerance) and the
noise of each kind of channel from the readings (empirical Bayes). N readings, C mean readings, `size` parameters.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs

from ..errors import CalibrationError, KinematicsError, ModelError, TooFewReadingsError
from ..measurements.readings import KINDS, LEAST_NOISE, MEDIAN_TO_SIGMA, MeasurementSet, refuse_impossible
from .assumptions import ASSUMED
from .blocks.block import Linkage
from .blocks.load import unsettled_lengths
from .observations import MeanReadings, Nuisance, of_square, without_nuisance
from .parameters import Components, ParameterSpace
from .sensitivity import Prediction, Slopes, predict

Given = TypeVar("Given")
Result = TypeVar("Result")

STEPS, SETTLED = 20, 1e-2  # largest number of Gauss–Newton steps; change of each parameter, σ, below which they end
ROUNDS, FEW_ROUNDS = 12, 2  # most updates of tolerances and noise in a step: usual number, number after a good guess
ROUNDS_SETTLED = 1e-3  # relative change of every tolerance and noise below which the updates end
LONGEST_STRIDE, LEAP = 16.0, np.log(10.0)  # limits of |a| and of a change of a logarithm in :func:`_extrapolated`
LEAST_FREEDOM = 10.0  # degrees of freedom needed to estimate a noise; its relative error is then 22 %
CHUNK, THREADED = 512, 500  # rows that fit into the processor's cache; rows from which threads share the work


def in_parallel(work: Callable[[Given], Result], items: Iterable[Given], rows: int) -> list[Result]:
    if rows < THREADED:
        return list(map(work, items))
    return list(_workers(os.getpid()).map(work, items))


@cache
def _workers(process: int) -> ThreadPoolExecutor:  # a forked process gets its own
    return ThreadPoolExecutor(len(os.sched_getaffinity(process)))


def huber_limit(magnitudes: np.ndarray) -> float:
    """Return the |residual| above which Huber's weight is below 1: 2.5 σ, with σ from the median of |residuals|."""
    return float(ASSUMED.huber * MEDIAN_TO_SIGMA * np.median(magnitudes))


class SparsePart(NamedTuple):
    """Rows of a design matrix whose nonzero values lie in the same columns."""

    rows: np.ndarray  # (n,): indices of the rows
    columns: np.ndarray  # (m,): ascending indices of the columns
    values: np.ndarray  # (n, m)


class DesignMatrix:
    """A design matrix, stored in parts without zero columns: its rows are mean readings, its columns parameters."""

    def __init__(self, shape: tuple[int, int], parts: Sequence[SparsePart]) -> None:
        self.shape, self.parts = shape, tuple(parts)
        self._part, self._place = np.zeros(shape[0], dtype=int), np.zeros(shape[0], dtype=int)
        for n, part in enumerate(self.parts):
            self._part[part.rows], self._place[part.rows] = n, np.arange(len(part.rows))

    @staticmethod
    def of(matrix: np.ndarray) -> DesignMatrix:
        return DesignMatrix(matrix.shape, [SparsePart(np.arange(len(matrix)), np.arange(matrix.shape[1]), matrix)])

    def dense(self) -> np.ndarray:
        result = np.zeros(self.shape)
        for part in self.parts:
            result[np.ix_(part.rows, part.columns)] = part.values
        return result

    def times(self, y: np.ndarray) -> np.ndarray:
        result = np.zeros((self.shape[0], *y.shape[1:]))
        for part in self.parts:
            result[part.rows] = part.values @ y[part.columns]
        return result

    def transposed_times(self, v: np.ndarray) -> np.ndarray:
        result = np.zeros((self.shape[1], *v.shape[1:]))
        for part in self.parts:
            result[part.columns] += part.values.T @ v[part.rows]
        return result

    def between(self, matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return aᵀ·M·b for each pair of rows a and b; `first` and `second` are their indices, M is `matrix`."""
        result = np.empty(len(first))
        for (p, q), pairs in _equal_pairs(self._part[first], self._part[second]):
            a, b = self.parts[p], self.parts[q]
            reached = a.values[self._place[first[pairs]]] @ matrix[np.ix_(a.columns, b.columns)]
            result[pairs] = np.einsum("ci,ci->c", reached, b.values[self._place[second[pairs]]])
        return result

    def select(self, rows: np.ndarray) -> DesignMatrix:
        """Return the rows with the indices `rows`, in this order; consecutive rows are not copied."""
        owner, parts = self._part[rows], []
        for n in np.unique(owner):
            at = np.flatnonzero(owner == n)
            part = self.parts[n]
            parts.append(SparsePart(at, part.columns, part.values[as_slice(self._place[rows[at]])]))
        return DesignMatrix((len(rows), self.shape[1]), parts)

    def using(self, used: np.ndarray, factors: np.ndarray, spread: np.ndarray | None = None) -> DesignMatrix:
        """Return the columns with the indices `used`; row i is multiplied by `factors`[i], column j by `spread`[j]."""
        place = np.full(self.shape[1], -1)
        place[used] = np.arange(len(used))
        parts = []
        for part in self.parts:
            kept = np.flatnonzero(place[part.columns] >= 0)
            columns = place[part.columns[kept]]
            values = factors[part.rows, None] * part.values[:, as_slice(kept)]
            if spread is not None:
                values *= spread[columns]
            parts.append(SparsePart(part.rows, columns, values))
        return DesignMatrix((self.shape[0], len(used)), parts)

    def beside(self, columns: np.ndarray) -> DesignMatrix:
        size, further = self.shape[1], np.arange(columns.shape[1])
        parts = [
            SparsePart(p.rows, np.append(p.columns, size + further), np.hstack([p.values, columns[p.rows]]))
            for p in self.parts
        ]
        return DesignMatrix((self.shape[0], size + len(further)), parts)

    def project_out(self, unknowns: Sequence[Nuisance]) -> None:
        """Project the instruments' unknowns out, in place; parts with readings of one unknown need the same columns."""
        owner = np.array([self._part[unknown.members[0]] for unknown in unknowns])
        for n, unknown in enumerate(unknowns):
            own = self._part[unknown.members]
            if (own == own[0]).all():
                continue
            owner[n] = -1
            pieces = [(np.flatnonzero(own == p), self.parts[p]) for p in np.unique(own)]
            places = [self._place[unknown.members[at]] for at, _ in pieces]
            values = np.concatenate([part.values[at] for at, (_, part) in zip(places, pieces, strict=True)])
            order = np.concatenate([at for at, _ in pieces])
            unknown._replace(basis=unknown.basis[order]).project_out(values, np.arange(len(values)))
            ends = np.cumsum([len(at) for at in places])[:-1]
            for at, (_, part), cleared in zip(places, pieces, np.split(values, ends), strict=True):
                part.values[at] = cleared

        def clear(part: int) -> None:
            for n in np.flatnonzero(owner == part).tolist():
                unknowns[n].project_out(self.parts[part].values, as_slice(self._place[unknowns[n].members]))

        in_parallel(clear, range(len(self.parts)), self.shape[0])


def as_slice(indices: np.ndarray) -> np.ndarray | slice:
    """Return consecutive indices as a slice, which copies nothing when it indexes; return other indices unchanged."""
    if len(indices) and indices[-1] - indices[0] == len(indices) - 1 and (np.diff(indices) == 1).all():
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices


def _equal_pairs(first: np.ndarray, second: np.ndarray) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """Yield each distinct pair (first[i], second[i]), and the indices i at which it occurs."""
    many = int(second.max(initial=0)) + 1
    pairs, group = np.unique(first * many + second, return_inverse=True)
    for n, pair in enumerate(pairs.tolist()):
        yield divmod(pair, many), np.flatnonzero(group == n)


@dataclass(frozen=True)
class LinearProblem:
    """The linearised fit: target = rows·y + noise, with the parameters x = root·y and without instruments' unknowns.

    `target`, `rows` and `per_length` are divided by σ, each mean reading's stated standard deviation.
    """

    target: np.ndarray  # (C,): (mean readings − prediction at y₀) + rows·y₀, with y₀ the point of linearisation
    rows: DesignMatrix  # (C, size): derivatives of the mean readings by y
    kind: np.ndarray  # (C,): as in :class:`MeanReadings`
    fold: np.ndarray  # (C,): as in :class:`MeanReadings`
    square: np.ndarray  # (kinds,): Σ target² + Σ (deviation of a reading from its mean / σ of a reading)²
    freedom: np.ndarray  # (kinds,): number of readings minus number of instruments' unknowns
    least_noise: np.ndarray  # (kinds,): LEAST_NOISE / stated noise
    # (C, 6): derivatives by the six strut lengths, before the unknowns are projected out
    per_length: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    unknowns: tuple[Nuisance, ...] = ()
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (C,): 1/σ
    # (N,): σ of each reading by stated noise and, if its direction is unknown, half of the fitted backlash
    uncertainty: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def normal(self) -> np.ndarray:
        """rowsᵀ·rows of the mean readings of each kind of channel: (kinds, size, size)."""
        result = np.zeros((len(KINDS), self.rows.shape[1], self.rows.shape[1]))
        products = in_parallel(lambda part: part.values.T @ part.values, [p for _, p in self._parts], len(self.target))
        for (kind, part), product in zip(self._parts, products, strict=True):
            result[kind][np.ix_(part.columns, part.columns)] += product
        return result

    @cached_property
    def moment(self) -> np.ndarray:
        """rowsᵀ·target of the mean readings of each kind of channel: (kinds, size)."""
        result = np.zeros((len(KINDS), self.rows.shape[1]))
        for kind, part in self._parts:
            result[kind][part.columns] += self.target[part.rows] @ part.values
        return result

    @cached_property
    def _parts(self) -> list[tuple[int, SparsePart]]:  # of the rows, each with its kind
        result = list[tuple[int, SparsePart]]()
        for part in self.rows.parts:
            for kind in np.unique(self.kind[part.rows]).tolist():
                own = as_slice(np.flatnonzero(self.kind[part.rows] == kind))
                result.append((kind, SparsePart(part.rows[own], part.columns, part.values[own])))
        return result

    def with_target(self, target: np.ndarray, square: np.ndarray) -> LinearProblem:
        """Return a copy of this problem with another `target` (C,) and the `square` of that target."""
        other = replace(self, target=target, square=square)
        vars(other).update(_parts=self._parts, normal=self.normal)
        return other

    def free_of_nuisance(self, columns: np.ndarray) -> np.ndarray:
        """Divide `columns` (C, K), m or rad, by σ and project the instruments' unknowns out, as was done to `rows`."""
        return without_nuisance(self.scale[:, None] * columns, self.unknowns)


@dataclass(frozen=True)
class Posterior:
    """The posterior of a linear problem; n parameters y are in use, all others are zero."""

    used: np.ndarray  # (n,): indices of the parameters in use
    y: np.ndarray  # (n,): most probable values
    covariance: np.ndarray  # (n, n)
    tolerances: np.ndarray  # (blocks,): prior σ of each block; 0: the block is not in use
    noise: np.ndarray  # (kinds,): noise factor: estimated / stated standard deviation of each kind's readings
    determined: np.ndarray  # (n,): 1 − posterior variance / prior variance: 0: by the prior alone … 1: by the readings
    spread: np.ndarray  # (n,): prior σ of each y
    log_determinant: float  # of the posterior's precision matrix of y / spread

    def within(self, part: slice) -> np.ndarray:
        """Return for each of the n parameters in use whether it belongs to the block with the indices `part`."""
        return (self.used >= part.start) & (self.used < part.stop)

    def every(self, size: int) -> np.ndarray:  # zeros for parameters not in use
        y = np.zeros(size)
        y[self.used] = self.y
        return y


def solve(
    space: ParameterSpace | Components,
    problem: LinearProblem,
    tolerances: np.ndarray,
    noise: np.ndarray,
    rounds: int = ROUNDS,
    silent: np.ndarray | None = None,
) -> Posterior:
    """Return the posterior after up to `rounds` updates of tolerances and noise factors.

    Parameters whose tolerance is 0, and those with the indices `silent`, stay zero.
    """
    used = np.setdiff1d(np.flatnonzero(space.spread(tolerances)), [] if silent is None else silent)
    kinds = np.unique(problem.kind)
    normal, moment = problem.normal[np.ix_(kinds, used, used)], problem.moment[np.ix_(kinds, used)]
    scales = [np.concatenate([tolerances, noise])]
    for turn in range(rounds + 1):
        tolerances, noise = scales[-1][: len(tolerances)], scales[-1][len(tolerances) :]
        spread = space.spread(tolerances)[used]
        inverse, log_determinant = _inverse(_whitened(noise[kinds], normal, spread))
        z = inverse @ (spread * (noise[kinds] ** -2 @ moment))
        determined = 1.0 - np.diag(inverse)
        inverse *= spread[:, None] * spread
        posterior = Posterior(used, spread * z, inverse, tolerances, noise, determined, spread, log_determinant)
        if turn < rounds:
            noise, tolerances = _noise(problem, kinds, normal, moment, posterior), _tolerances(space, posterior, z)
            scales.append(np.concatenate([tolerances, noise]))
            ratio = scales[-1][scales[-1] > 0.0] / scales[-2][scales[-1] > 0.0]
            if np.abs(np.log(ratio)).max() < ROUNDS_SETTLED:
                break
            if len(scales) == 3:
                scales = [_extrapolated(*scales)]
    return posterior


def _extrapolated(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Extrapolate the logarithms of three iterates of a slow fixed-point iteration (SQUAREM; Varadhan & Roland 2008).

    The result is first − 2·a·r + a²·v: r, v are the first, second differences, a = −|r|/|v|, 1 ≤ |a| ≤ LONGEST_STRIDE.
    """
    positive = third > 0.0
    logs = np.log(np.stack([first[positive], second[positive], third[positive]]))
    step, bend = logs[1] - logs[0], logs[2] - 2.0 * logs[1] + logs[0]
    stride = float(np.clip(np.linalg.norm(step) / max(float(np.linalg.norm(bend)), 1e-12), 1.0, LONGEST_STRIDE))
    result = third.copy()
    extrapolated = logs[0] + 2.0 * stride * step + stride**2 * bend
    result[positive] = np.exp(np.clip(extrapolated, logs[2] - LEAP, logs[2] + LEAP))
    return result


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Return inverse and log determinant of a positive definite matrix, whose content is overwritten."""
    factor, failed = dpotrf(matrix.T, lower=1, overwrite_a=1)
    if failed:
        problem = "are too few to distinguish noise from machine errors, or their stated uncertainty is too small"
        raise TooFewReadingsError("measurements", problem)
    log_determinant = 2.0 * float(np.log(np.diag(factor)).sum())
    lower, _ = dpotri(factor, lower=1, overwrite_c=1)
    inverse = lower.T + lower  # dpotrf has written zeros above the diagonal
    inverse[np.diag_indices_from(inverse)] *= 0.5
    return inverse, log_determinant


def _noise(
    problem: LinearProblem, kinds: np.ndarray, normal: np.ndarray, moment: np.ndarray, posterior: Posterior
) -> np.ndarray:
    """Return the new noise factor of each kind of channel: √(Σ (residual / stated σ)² / degrees of freedom)."""
    result = posterior.noise.copy()
    squares = _squared_residuals(problem, kinds, normal, moment, posterior.y)
    for k, information, square in zip(kinds, normal, squares, strict=True):
        freedom = problem.freedom[k] - np.vdot(posterior.covariance, information) / result[k] ** 2
        if freedom > LEAST_FREEDOM and square > 0.0:
            result[k] = np.sqrt(square / freedom)
    return np.maximum(result, problem.least_noise)


def _tolerances(space: ParameterSpace | Components, posterior: Posterior, z: np.ndarray) -> np.ndarray:
    """Return each block's new prior σ (tolerance) by MacKay's fixed point: tolerance² = Σ y² / Σ `determined`.

    The first guess of a tolerance weighs as much as ASSUMED.hyperprior parameters, so that it cannot shrink to zero.
    """
    result, start = posterior.tolerances.copy(), space.start_tolerances()
    for n, part in enumerate(space.parts):
        members = posterior.within(part)
        if members.any() and not space.stated[n]:
            first = ASSUMED.hyperprior * (start[n] / result[n]) ** 2
            factor = np.sqrt(
                (z[members] @ z[members] + first) / (posterior.determined[members].sum() + ASSUMED.hyperprior)
            )
            result[n] *= np.clip(factor, 0.1, 10.0)
    return result


def log_evidence(problem: LinearProblem, posterior: Posterior) -> float:
    """Return log p(readings | tolerances, noise) + constant: likelihood × Occam factor (MacKay 1992)."""
    kinds, used, y = np.unique(problem.kind), posterior.used, posterior.y
    normal, moment = problem.normal[np.ix_(kinds, used, used)], problem.moment[np.ix_(kinds, used)]
    weights = posterior.noise[kinds] ** -2
    # From y, not by the formula for the minimum: right even if y solves ill-conditioned equations inexactly
    squares = weights @ _squared_residuals(problem, kinds, normal, moment, y) + ((y / posterior.spread) ** 2).sum()
    return float(-0.5 * (squares + posterior.log_determinant - problem.freedom[kinds] @ np.log(weights)))


def _squared_residuals(
    problem: LinearProblem, kinds: np.ndarray, normal: np.ndarray, moment: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Return, for each kind of channel, Σ (residual / stated noise)² of the readings at the parameters y."""
    return np.maximum(problem.square[kinds] - 2.0 * moment @ y + normal @ y @ y, 0.0)


def whitened_residuals(problem: LinearProblem, posterior: Posterior) -> tuple[DesignMatrix, np.ndarray]:
    """Return derivatives of C mean readings by n values y / prior σ, and residuals (C,), both / estimated noise."""
    scale = 1.0 / posterior.noise[problem.kind]
    rows = problem.rows.using(posterior.used, scale, posterior.spread)
    return rows, scale * problem.target - rows.times(posterior.y / posterior.spread)


def whitened_precision(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    kinds = np.unique(problem.kind)
    information = problem.normal[np.ix_(kinds, posterior.used, posterior.used)]
    return _whitened(posterior.noise[kinds], information, posterior.spread)


def _whitened(noise: np.ndarray, information: np.ndarray, spread: np.ndarray) -> np.ndarray:
    precision = np.tensordot(noise**-2, information, 1)
    precision *= spread[:, None] * spread
    precision[np.diag_indices_from(precision)] += 1.0
    return precision


@dataclass(frozen=True)
class Further:
    """Quantities for k further parameters θ ~ N(0, 1) of a solved problem: t is its target, D = ∂(mean readings)/∂θ.

    K is the covariance of t due to the parameters' priors and to noise. Tolerances and noise are not estimated again.
    """

    information: np.ndarray  # (k, k): Dᵀ·K⁻¹·D
    moment: np.ndarray  # (k,): Dᵀ·K⁻¹·t
    moved: np.ndarray  # (n, k): change of the most probable y per unit of each θ

    @staticmethod
    def of(problem: LinearProblem, posterior: Posterior, columns: np.ndarray) -> Further:
        """Solve for θ; `columns` (C, k) are ∂(mean readings / σ)/∂θ with the instruments' unknowns projected out."""
        over = 1.0 / posterior.noise[problem.kind]
        rows, columns = problem.rows.using(posterior.used, over), over[:, None] * columns
        shared = rows.transposed_times(columns)
        moved = -posterior.covariance @ shared
        residuals = over * problem.target - rows.times(posterior.y)
        return Further(columns.T @ columns + shared.T @ moved, columns.T @ residuals, moved)

    @cached_property
    def covariance(self) -> np.ndarray:
        return np.asarray(np.linalg.inv(np.eye(len(self.moment)) + self.information))

    @property
    def mean(self) -> np.ndarray:
        return np.asarray(self.covariance @ self.moment)

    @property
    def gain(self) -> float:
        """Log Bayes factor: log evidence with θ minus log evidence without θ."""
        return float(0.5 * (self.moment @ self.mean + np.linalg.slogdet(self.covariance)[1]))


def physical_covariance(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the covariance (size, size) of the parameters x, SI, from a posterior with all blocks in use."""
    return space.physical(space.physical(posterior.covariance).T)


ROUNDING = 1e-12
"""A component of a reading's direction counts as zero up to this magnitude."""


class _Group(NamedTuple):
    """Mean readings of one kind that depend on the same components of the tool error, in the order of runs."""

    components: np.ndarray  # of the tool error: ascending indices, 0…5
    means: np.ndarray  # indices


class Estimation:
    """Fits parameters to readings; `check_count`: refuse fewer independent values than structure parameters."""

    def __init__(self, measurements: MeasurementSet, space: ParameterSpace, check_count: bool = True) -> None:
        self.space, self.means = space, MeanReadings.of(measurements)
        self.frames = [] if space.settings.tracker_frame == "known" else self.means.frames(measurements)
        self.measurements = measurements = self.means.near_work(measurements, self.frames)
        refuse_impossible(measurements)
        self.uncertainty = measurements.stated
        self._zeros, self._distances = self.means.with_zeros(measurements)
        self._squares = self.means.squares()
        self._components = np.abs(self.means.directions) > ROUNDING
        for frame in self.frames:  # the unknown frame turns the directions
            self._components[frame.members] = np.repeat(
                [self._components[frame.members, k : k + 3].any() for k in (0, 3)], 3
            )
        for distances in self._distances:
            self._components[distances.members, :3] = True  # the unknown centre turns the direction
        self._groups = self._grouped()
        needed = len(space.blocks[0].labels)
        free = len(self.means.station) - len(self._zeros.groups) - int(self._zeros.sloping.sum())
        free -= len(self._squares) + sum(distances.count for distances in self._distances) + 6 * len(self.frames)
        if check_count and free < needed:
            places = f"{len(measurements)} readings at {len(self.means.station)} distinct places"
            problem = f"{places} give {max(free, 0)} independent values for the structure's {needed} parameters"
            raise TooFewReadingsError("measurements", problem)

    def linearise(
        self, x: np.ndarray, reading_weights: np.ndarray, unsettled: bool = True
    ) -> tuple[LinearProblem, np.ndarray]:
        """Return the problem linearised at x, and the residuals (N,) of the readings, m or rad.

        With `unsettled`, the noise includes the variance due to struts at an unknown end of their clearance, or on an
        unknown side of their backlash.
        """
        c, m = self.means, self.measurements
        prediction, directions = self._predicted(x), c.directions.copy()
        gains, clearance, lag = self.of_unsettled(x, prediction) * unsettled
        # The upper bound, reached where all struts lengthen in step
        uncertainty = np.hypot(self.uncertainty, np.abs(gains * lag).sum(axis=1)[c.of_reading])
        weights = reading_weights / uncertainty**2
        total = np.bincount(c.of_reading, weights)
        values = np.bincount(c.of_reading, weights * m.value) / total
        # Readings at which a strut's end is unknown share one error of the strut: together they weigh as much as one
        ends, sharing = (gains * clearance) ** 2, np.count_nonzero(clearance, axis=0)
        allowed, shown = 1.0 + total * (ends @ sharing), 1.0 + total * ends.sum(axis=1)
        scale = np.sqrt(total / allowed)
        expected, unknowns = self.unknowns(directions, prediction.errors[c.station], values, scale)
        misfit = m.value - expected[c.of_reading]
        mean = np.bincount(c.of_reading, weights * misfit) / total
        rows, moved = self._rows(x, prediction, scale[:, None] * directions)
        target, unknown = scale * mean, np.zeros(len(mean))
        per_length = rows.using(np.arange(self.space.size)[self.space.offsets], np.ones(len(mean))).dense()
        for part in unknowns:
            unknown[part.members] += part.explained(target) / scale[part.members]
            part.project_out(target)
            part.project_out(moved)
        rows.project_out(unknowns)
        residuals = misfit - unknown[c.of_reading]
        scatter = np.bincount(m.kind, weights * (misfit - mean[c.of_reading]) ** 2, len(KINDS))
        # Huber's proposal 2: the noise comes from weight² · residual², because outliers would enlarge it
        clipped = weights * (1.0 - reading_weights) / allowed[c.of_reading]
        beyond = np.bincount(m.kind, clipped * residuals**2, len(KINDS))
        problem = self._problem(target + moved, rows, scatter - beyond, unknowns)
        freedom = problem.freedom - np.bincount(c.kind, 1.0 - shown / allowed, len(KINDS))
        problem = replace(
            problem,
            freedom=freedom,
            per_length=per_length,
            unknowns=tuple(unknowns),
            scale=scale,
            uncertainty=uncertainty,
        )
        return problem, residuals

    def _rows(self, x: np.ndarray, prediction: Prediction, directions: np.ndarray) -> tuple[DesignMatrix, np.ndarray]:
        """Return the derivatives by y of tool errors along `directions` (C, 6), and these derivatives times y (C,)."""
        c, space, moved = self.means, self.space, np.empty(len(self.means.station))
        slopes, y = Slopes(space, prediction, self.measurements.stations, whitened=True), space.whitened_parameters(x)

        def rows_of(group: _Group) -> SparsePart:
            columns = slopes.columns(group.components)
            rows = np.empty((len(group.means), len(columns)))
            for first in range(0, len(rows), CHUNK):
                part, means = rows[first : first + CHUNK], group.means[first : first + CHUNK]
                slopes.write(part, c.station[means], directions[means], group.components)
                moved[means] = part @ y[columns]
            return SparsePart(group.means, columns, rows)

        return DesignMatrix((len(moved), space.size), in_parallel(rows_of, self._groups, len(moved))), moved

    @property
    def fixed_unknowns(self) -> bool:
        """Whether readings are linear in the instruments' unknowns: no distances, no tracker in an unknown frame."""
        return not self._distances and not self.frames

    def _predicted(self, x: np.ndarray) -> Prediction:
        try:
            return predict(self.space, x, self.measurements.stations)
        except (ModelError, KinematicsError) as error:
            hint = "check units, directions and commanded poses, and allow all blocks"
            raise CalibrationError("fit", f"reached parameters that no machine can have ({error}); {hint}") from error

    def unknowns(
        self, directions: np.ndarray, errors: np.ndarray, values: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, list[Nuisance]]:
        """Return the mean readings that the tool errors `errors` (C, 6) predict, and the instruments' unknowns.

        `directions` (C, 6), ∂reading/∂error, are updated in place for `errors`; `scale` (C,) is 1 / σ of the `values`.
        """
        expected = np.einsum("ci,ci->c", directions, errors)
        unknowns = self._zeros.unknowns(scale)
        unknowns += [of_square(n, scale[n], self.means.lever[n], self.means.group[n]) for n in self._squares]
        for distances in self._distances:
            n = distances.members
            expected[n], directions[n, :3], parts = distances.linearise(errors[n, :3], values[n], scale[n])
            unknowns += parts
        for frame in self.frames:
            n = frame.members
            expected[n], directions[n], part = frame.linearise(directions[n], errors[n], values[n], scale[n])
            unknowns.append(part)
        return expected, unknowns

    def of_unsettled(self, x: np.ndarray, prediction: Prediction) -> np.ndarray:
        """Return (3, C, 6): mean readings' derivatives by strut lengths; two standard deviations of the lengths, m.

        The first deviation is that of :func:`unsettled_lengths`; the second is half of a strut's backlash where its
        direction of motion is unknown. If all deviations are zero, the derivatives are returned as zero.
        """
        c, block, stations = self.means, self.space.block("backlash"), self.measurements.stations
        lag = np.where(stations.sense[:, 3:] == 0.0, 0.5 * np.abs(x[block.part]), 0.0) if block else np.zeros((1, 6))
        if not (lag.any() or prediction.load.lost_motion.any()):
            return np.zeros((3, len(c.station), 6))
        linkage = Linkage(prediction, self.space.probe, stations)
        gains = linkage.errors(c.station, c.directions, np.arange(6)).gains
        lag = np.broadcast_to(lag, linkage.lengths.shape)
        return np.stack([gains, unsettled_lengths(linkage)[c.station], lag[c.station]])

    def _problem(
        self, target: np.ndarray, rows: DesignMatrix, scatter: np.ndarray, unknowns: list[Nuisance]
    ) -> LinearProblem:
        kind, kinds = self.means.kind, len(KINDS)
        freedom = np.bincount(self.measurements.kind, minlength=kinds).astype(float)
        for part in unknowns:
            freedom -= np.bincount(kind[part.members], part.basis**2 @ part.share, kinds)
        square = scatter + np.bincount(kind, target**2, kinds)
        least_noise = LEAST_NOISE / np.array([self.measurements.stated_of(k) for k in range(kinds)])
        return LinearProblem(target, rows, kind, self.means.fold, square, freedom, least_noise)

    def _grouped(self) -> list[_Group]:
        c = self.means
        for members in (*self._zeros.groups, *self._squares, *(distances.members for distances in self._distances)):
            self._components[members] |= self._components[members].any(axis=0)
        key = c.kind * 64 + self._components @ (1 << np.arange(6))
        order = np.lexsort((c.group, self.measurements.run[c.first], key))
        return [
            _Group(np.flatnonzero(self._components[means[0]]), means)
            for means in np.split(order, np.flatnonzero(np.diff(key[order])) + 1)
        ]

    def robust_weights(self, sigmas: np.ndarray) -> np.ndarray:
        """Return Huber's weights (N,): min(1, t / |residual / σ|); t: :func:`huber_limit` of its kind of channel."""
        size = np.abs(sigmas)
        weights = np.ones(len(size))
        for k in np.unique(self.measurements.kind):
            members = self.measurements.kind == k
            cut = huber_limit(size[members])
            if cut > 0.0:
                weights[members] = cut / np.maximum(size[members], cut)
        return weights


class NotSettled(CalibrationError):
    """The fit did not converge: its last step, which led to `solution`, changed a parameter by more than 1 σ."""

    def __init__(self, problem: str, solution: Solution) -> None:
        super().__init__("fit", problem)
        self.solution = solution


@dataclass(frozen=True)
class Solution:
    problem: LinearProblem  # linearised before the last step
    posterior: Posterior
    x: np.ndarray  # (size,), SI
    residuals: np.ndarray  # (N,), m or rad
    weights: np.ndarray  # (N,): Huber's, 0…1
    steps: int
    change: float  # largest change in the last step, in σ of the parameter


def iterate(
    estimation: Estimation,
    x: np.ndarray,
    tolerances: np.ndarray,
    noise: np.ndarray,
    progress: Callable[[str], object],
) -> Solution:
    """Return the fit by Gauss–Newton steps from x (zero: nominal machine); raise NotSettled if it does not converge."""
    space, weights = estimation.space, np.ones(len(estimation.measurements))
    robust = space.settings.robust
    share, before = 1.0, np.inf  # share of the step that is taken; halved if steps grow, since a force changes sign
    unweighted = 0 if x.any() else 1  # no Huber weights from residuals of the nominal machine, which are no noise
    for step in range(1, STEPS + 1):
        problem, residuals = estimation.linearise(x, weights)
        posterior = solve(space, problem, tolerances, noise)
        tolerances, noise = posterior.tolerances, posterior.noise
        moved = space.physical(posterior.y) - x
        sizes = np.abs(moved) / np.sqrt(np.diag(physical_covariance(space, posterior)))
        change = float(sizes.max())
        share *= 0.5 if step > 3 and change > before else 1.0
        x, before = space.physical(posterior.y) - (1.0 - share) * moved, change
        progress(f"step {step}: largest change {change:.2g} standard deviations")
        if (change < SETTLED and (step > unweighted + 1 or not robust)) or step == STEPS:
            break
        if robust and step > unweighted:
            weights = estimation.robust_weights(residuals / problem.uncertainty)
    solution = Solution(problem, posterior, x, residuals, weights, step, change)
    if change > 1.0:
        block = max(space.blocks, key=lambda block: sizes[block.part].max())
        moving = f"did not converge in {STEPS} steps: {block.name} still changes by {change:.2g} standard deviations"
        raise NotSettled(f"{moving}; are all blocks allowed, and are there readings at enough places?", solution)
    return solution


class Omitted(NamedTuple):
    """How a fit changes if one group of mean readings is left out."""

    means: np.ndarray  # (n,): indices of the mean readings left out
    errors: np.ndarray  # (n,): these minus their prediction by the fit without them, in σ
    moved: np.ndarray  # (k,): `functions` of the parameters fitted to all readings, minus those of the fit without them
    covariance: np.ndarray  # (k, k): of `moved`, if the model is right


def jackknife(
    rows: DesignMatrix, residual: np.ndarray, precision: np.ndarray, groups: np.ndarray, functions: np.ndarray
) -> list[Omitted]:
    """Leave out each group of mean readings in turn; this is exact for a linear problem and needs no further fit.

    `groups` (C,) has the group of each mean reading. Each column of `functions` has the coefficients of a linear
    function of the parameters; the change of each function by leaving out a group is returned. If rows R with residuals
    r are left out, parameters with the precision P = C⁻¹ change by −(P − Rᵀ·R)⁻¹·Rᵀ·r = −C·Rᵀ·(1 − R·C·Rᵀ)⁻¹·r; the
    covariance of this change is (P − Rᵀ·R)⁻¹ − C. The code inverts P − Rᵀ·R or 1 − R·C·Rᵀ, whichever matrix is smaller.
    """
    covariance = np.linalg.inv(precision)
    reached = covariance @ functions
    before = functions.T @ reached

    def without(means: np.ndarray) -> Omitted:
        own, left = rows.select(means).dense(), residual[means]
        few = 2 * len(left) < len(precision)
        try:
            factor = np.linalg.cholesky(
                np.eye(len(left)) - own @ covariance @ own.T if few else precision - own.T @ own
            )
        except np.linalg.LinAlgError:  # rounding, since this group alone determines a parameter: add up the other rows
            few, others = False, rows.select(np.setdiff1d(order, means)).dense()
            factor = np.linalg.cholesky(np.eye(len(precision)) + others.T @ others)
        half, moment = (
            dtrtrs(factor, side, lower=1)[0] for side in ((own @ reached, left) if few else (functions, own.T @ left))
        )
        solved = dtrtrs(factor, moment, lower=1, trans=1)[0]
        errors, grown = (solved, half.T @ half) if few else (left + own @ solved, half.T @ half - before)
        return Omitted(means, errors, half.T @ moment, grown)

    order = np.argsort(groups, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    return in_parallel(without, members, len(groups))


def leave_out(
    problem: LinearProblem, posterior: Posterior, groups: np.ndarray, functions: np.ndarray | None = None
) -> list[Omitted]:
    """Return the :func:`jackknife` of a fit, at fixed tolerances and noise, for `functions` of parameters / prior σ.

    Without `functions`, |moved| is the Mahalanobis distance by which all parameters change.
    """
    precision = whitened_precision(problem, posterior)
    functions = np.linalg.cholesky(precision) if functions is None else functions
    return jackknife(*whitened_residuals(problem, posterior), precision, groups, functions)


def influence(run: np.ndarray, solution: Solution) -> np.ndarray:
    """Return how far the parameters move without each run (Mahalanobis distance); `run` (C,) is each mean's run."""
    return np.array([np.linalg.norm(one.moved) for one in leave_out(solution.problem, solution.posterior, run)])
