"""The estimator: a whitened, chunked, robust Gauss–Newton with evidence for the parameters given the readings.

Each linear problem is Bayesian: every block of parameters has a prior whose size (a hyperparameter) is estimated from
the readings, as is the noise of every kind of channel: empirical Bayes, by MacKay's fixed point. Nuisance parameters of
the instruments are projected out of the design matrix beforehand, so they add no unknowns.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs

from ..errors import CalibrationError, KinematicsError, ModelError
from ..measurements.readings import KINDS, LEAST_NOISE, MeasurementSet, refuse_impossible
from .assumptions import ASSUMED
from .blocks.block import Linkage
from .blocks.load import unsettled_lengths
from .observations import Cells, Nuisance, of_square
from .parameters import Components, ParameterSpace
from .sensitivity import Prediction, Slopes, predict

Given = TypeVar("Given")
Result = TypeVar("Result")

STEPS, SETTLED = 20, 1e-2  # most Gauss-Newton steps; largest change of a parameter in the last one, σ
ROUNDS, FEW_ROUNDS = 12, 2  # rounds of hyperparameters at one step, and at the start from an answer
ROUNDS_SETTLED = 1e-3  # relative change after which rounds stop: hyperparameters are known to 1/√(2n)
LONGEST_STRIDE, LEAP = 16.0, np.log(10.0)  # longest extrapolation, in rounds, and largest change by it, logarithm
LEAST_FREEDOM = 10.0  # fewest readings beyond the parameters for a noise: its own error is then 22 %
CHUNK, THREADED = 512, 500  # cells of a processor's cache; rows from which on threads share the work


def at_once(work: Callable[[Given], Result], items: Iterable[Given], rows: int) -> list[Result]:
    """Return the results of independent work with matrices of this number of rows, done in parallel if these are many.

    NumPy uses as many threads as there are processors; work on few rows ends before a thread would have started.
    """
    if rows < THREADED:
        return list(map(work, items))
    return list(_workers(os.getpid()).map(work, items))


@cache
def _workers(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process; one that was forked has its own."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(process)))


class Alike(NamedTuple):
    """Cells whose readings depend on the same parameters."""

    cells: np.ndarray  # (n,): Which
    columns: np.ndarray  # (m,): These parameters, ascending
    values: np.ndarray  # (n, m): Derivatives


class DesignMatrix:
    """A matrix of a row for each cell and a column for each parameter."""

    def __init__(self, shape: tuple[int, int], parts: Sequence[Alike]) -> None:
        self.shape, self.parts = shape, tuple(parts)
        self._part, self._place = np.zeros(shape[0], dtype=int), np.zeros(shape[0], dtype=int)
        for n, part in enumerate(self.parts):
            self._part[part.cells], self._place[part.cells] = n, np.arange(len(part.cells))

    @staticmethod
    def of(matrix: np.ndarray) -> DesignMatrix:
        """Return a dense matrix in this form."""
        return DesignMatrix(matrix.shape, [Alike(np.arange(len(matrix)), np.arange(matrix.shape[1]), matrix)])

    def dense(self) -> np.ndarray:
        """Return the whole matrix."""
        result = np.zeros(self.shape)
        for part in self.parts:
            result[np.ix_(part.cells, part.columns)] = part.values
        return result

    def times(self, y: np.ndarray) -> np.ndarray:
        """Return the product with y, (size,) or (size, k)."""
        result = np.zeros((self.shape[0], *y.shape[1:]))
        for part in self.parts:
            result[part.cells] = part.values @ y[part.columns]
        return result

    def transposed_times(self, v: np.ndarray) -> np.ndarray:
        """Return the transposed matrix's product with v, (C,) or (C, k)."""
        result = np.zeros((self.shape[1], *v.shape[1:]))
        for part in self.parts:
            result[part.columns] += part.values.T @ v[part.cells]
        return result

    def between(self, matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return aᵀ·M·b for the rows a and b of pairs of cells, shape (pairs,)."""
        result = np.empty(len(first))
        for (p, q), pairs in _alike(self._part[first], self._part[second]):
            a, b = self.parts[p], self.parts[q]
            reached = a.values[self._place[first[pairs]]] @ matrix[np.ix_(a.columns, b.columns)]
            result[pairs] = np.einsum("ci,ci->c", reached, b.values[self._place[second[pairs]]])
        return result

    def select(self, cells: np.ndarray) -> DesignMatrix:
        """Return the rows of some cells, in their order; without copying if they are consecutive."""
        owner, parts = self._part[cells], []
        for n in np.unique(owner):
            at = np.flatnonzero(owner == n)
            part = self.parts[n]
            parts.append(Alike(at, part.columns, part.values[as_slice(self._place[cells[at]])]))
        return DesignMatrix((len(cells), self.shape[1]), parts)

    def using(self, used: np.ndarray, factors: np.ndarray, spread: np.ndarray | None = None) -> DesignMatrix:
        """Return the rows times a factor each, (C,), with some parameters' columns only, times their spread."""
        place = np.full(self.shape[1], -1)
        place[used] = np.arange(len(used))
        parts = []
        for part in self.parts:
            kept = np.flatnonzero(place[part.columns] >= 0)
            columns = place[part.columns[kept]]
            values = factors[part.cells, None] * part.values[:, as_slice(kept)]
            if spread is not None:
                values *= spread[columns]
            parts.append(Alike(part.cells, columns, values))
        return DesignMatrix((self.shape[0], len(used)), parts)

    def beside(self, columns: np.ndarray) -> DesignMatrix:
        """Return the matrix with further columns (C, k)."""
        size, further = self.shape[1], np.arange(columns.shape[1])
        parts = [
            Alike(p.cells, np.append(p.columns, size + further), np.hstack([p.values, columns[p.cells]]))
            for p in self.parts
        ]
        return DesignMatrix((self.shape[0], size + len(further)), parts)

    def project_out(self, unknowns: Sequence[Nuisance]) -> None:
        """Project out, in place, the components that unknowns of instruments may explain.

        The cells of each are in one part, or in parts of the same parameters, as a tracker's positions and attitudes.
        """
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

        at_once(clear, range(len(self.parts)), self.shape[0])


def as_slice(indices: np.ndarray) -> np.ndarray | slice:
    """Return indices as a slice where they follow each other: then indexing copies nothing."""
    if len(indices) and indices[-1] - indices[0] == len(indices) - 1 and (np.diff(indices) == 1).all():
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices


def _alike(first: np.ndarray, second: np.ndarray) -> Iterator[tuple[tuple[int, int], np.ndarray]]:
    """Yield each pair of numbers that occurs, and where."""
    many = int(second.max(initial=0)) + 1
    pairs, group = np.unique(first * many + second, return_inverse=True)
    for n, pair in enumerate(pairs.tolist()):
        yield divmod(pair, many), np.flatnonzero(group == n)


@dataclass(frozen=True)
class LinearProblem:
    """The fit linearised at one parameter vector x = root·y, free of the instruments' unknowns."""

    # (C,): Cells' values that the parameters explain, over their standard deviation at unit noise factors
    target: np.ndarray
    rows: DesignMatrix  # (C, size): Their derivatives by y, alike
    kind: np.ndarray  # (C,): As in :class:`Cells`
    fold: np.ndarray  # (C,): As in :class:`Cells`
    normal: np.ndarray  # (kinds, size, size): rowsᵀ·rows of each kind
    moment: np.ndarray  # (kinds, size): rowsᵀ·target of each kind
    square: np.ndarray  # (kinds,): Sum of squared targets, the scatter of readings about their cell's mean included
    freedom: np.ndarray  # (kinds,): Readings minus unknowns projected out
    least_noise: np.ndarray  # (kinds,): Smallest noise factors that an instrument can have
    # (C, 6): Derivatives by the struts' lengths, scaled as the rows, with the instruments' unknowns still in them
    per_length: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    unknowns: tuple[Nuisance, ...] = ()  # What that is
    # (C,): One over the standard deviation of the cells' values at unit noise factors
    scale: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Posterior:
    """The posterior of a linear problem for the parameters y in use."""

    used: np.ndarray  # (n,): Which parameters; the others' blocks are out
    y: np.ndarray  # (n,): The most probable ones
    covariance: np.ndarray  # (n, n): Theirs
    tolerances: np.ndarray  # (blocks,): Size of each block's prior; zero: the block is out
    noise: np.ndarray  # (kinds,): Factor on the standard deviation of each kind's readings
    determined: np.ndarray  # (n,): Share of each parameter that comes from the data; the rest comes from the prior
    spread: np.ndarray  # (n,): The prior's standard deviation of each y
    log_determinant: float  # Logarithm of the determinant of the precision of y over that

    def every(self, size: int) -> np.ndarray:
        """Return all parameters y, (size,): zero for those not in use."""
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
    """Return the posterior of a linear problem; tolerances and noise factors are estimated with it."""
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
    """Return the extrapolation of three rounds of a fixed point that converges slowly, in logarithms (SQUAREM).

    Varadhan, Roland (2008), Scandinavian Journal of Statistics 35, 335: first − 2·a·r + a²·v, with r and v first and
    second differences and a = −|r|/|v|, no shorter than a round and at most ``longest_stride`` of them.
    """
    live = third > 0.0
    logs = np.log(np.stack([first[live], second[live], third[live]]))
    step, bend = logs[1] - logs[0], logs[2] - 2.0 * logs[1] + logs[0]
    stride = float(np.clip(np.linalg.norm(step) / max(float(np.linalg.norm(bend)), 1e-12), 1.0, LONGEST_STRIDE))
    result = third.copy()
    led = logs[0] + 2.0 * stride * step + stride**2 * bend
    result[live] = np.exp(np.clip(led, logs[2] - LEAP, logs[2] + LEAP))
    return result


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the inverse of a positive definite matrix, which is overwritten, and the logarithm of its determinant."""
    factor, failed = dpotrf(matrix.T, lower=1, overwrite_a=1)
    if failed:
        problem = "are too few to tell noise from the machine's errors, or their uncertainty is below any instrument's"
        raise CalibrationError("measurements", problem)
    log_determinant = 2.0 * float(np.log(np.diag(factor)).sum())
    lower, _ = dpotri(factor, lower=1, overwrite_c=1)
    inverse = lower.T + lower  # dpotrf has left zeros above
    inverse[np.diag_indices_from(inverse)] *= 0.5
    return inverse, log_determinant


def _noise(
    problem: LinearProblem, kinds: np.ndarray, normal: np.ndarray, moment: np.ndarray, posterior: Posterior
) -> np.ndarray:
    """Return new noise factors: squared residuals over the remaining degrees of freedom; sums of some kinds."""
    result = posterior.noise.copy()
    for k, information, rest in zip(kinds, normal, _unmet(problem, kinds, normal, moment, posterior.y), strict=True):
        freedom = problem.freedom[k] - np.vdot(posterior.covariance, information) / result[k] ** 2
        if freedom > LEAST_FREEDOM and rest > 0.0:
            result[k] = np.sqrt(rest / freedom)
    return np.maximum(result, problem.least_noise)


def _tolerances(space: ParameterSpace | Components, posterior: Posterior, z: np.ndarray) -> np.ndarray:
    """Return new tolerances: MacKay's fixed point, squared parameters over how many are determined.

    The first guess counts as a tenth of a parameter, which keeps an empty block from collapsing; a stated tolerance is
    not estimated.
    """
    result, start = posterior.tolerances.copy(), space.start_tolerances()
    for n, part in enumerate(space.parts):
        members = (posterior.used >= part.start) & (posterior.used < part.stop)
        if members.any() and not space.stated[n]:
            first = ASSUMED.hyperprior * (start[n] / result[n]) ** 2
            factor = np.sqrt(
                (z[members] @ z[members] + first) / (posterior.determined[members].sum() + ASSUMED.hyperprior)
            )
            result[n] *= np.clip(factor, 0.1, 10.0)
    return result


def log_evidence(problem: LinearProblem, posterior: Posterior) -> float:
    """Return the logarithm of the readings' probability under a posterior's tolerances and noise, up to a constant.

    MacKay (1992), Neural Computation 4, 415: the likelihood of the best parameters, times the Occam factor of their
    priors.
    """
    kinds, used, y = np.unique(problem.kind), posterior.used, posterior.y
    normal, moment = problem.normal[np.ix_(kinds, used, used)], problem.moment[np.ix_(kinds, used)]
    weights = posterior.noise[kinds] ** -2
    # A sum of squares: where the equations are ill-conditioned, y is not their solution, and makes it larger
    unmet = weights @ _unmet(problem, kinds, normal, moment, y) + ((y / posterior.spread) ** 2).sum()
    return float(-0.5 * (unmet + posterior.log_determinant - problem.freedom[kinds] @ np.log(weights)))


def _unmet(
    problem: LinearProblem, kinds: np.ndarray, normal: np.ndarray, moment: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Return the squared residuals of each kind for parameters y, (kinds,), over the stated noise."""
    return np.maximum(problem.square[kinds] - 2.0 * moment @ y + normal @ y @ y, 0.0)


def whitened_precision(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the precision of y over the prior's spread, shape (n, n)."""
    kinds = np.unique(problem.kind)
    information = problem.normal[np.ix_(kinds, posterior.used, posterior.used)]
    return _whitened(posterior.noise[kinds], information, posterior.spread)


def _whitened(noise: np.ndarray, information: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return :func:`whitened_precision` of the noise (kinds,) and the information (kinds, n, n) of each kind, and the
    spread (n,)."""
    precision = np.tensordot(noise**-2, information, 1)
    precision *= spread[:, None] * spread
    precision[np.diag_indices_from(precision)] += 1.0
    return precision


def physical_covariance(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the covariance of the parameters x, shape (size, size), SI; all blocks must be in use."""
    return space.physical(space.physical(posterior.covariance).T)


MEDIAN_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""

ROUNDING = 1e-12
"""A smaller component of a direction counts as zero: frames turned by right angles are exact to rounding."""


class _Group(NamedTuple):
    """Cells of one kind whose errors have the same components; those of a run, and of an unknown, are consecutive."""

    kind: int
    components: np.ndarray
    cells: np.ndarray


class Estimation:
    """Readings against parameters."""

    def __init__(self, measurements: MeasurementSet, space: ParameterSpace, alone: bool = True) -> None:
        refuse_impossible(measurements)
        self.measurements, self.space = measurements, space
        self.cells = Cells.of(measurements)
        self.uncertainty = measurements.stated
        self._zeros, self._lengths = self.cells.groups(measurements)
        self._squares = self.cells.squares()
        self._frames = [] if space.settings.tracker_frame == "known" else self.cells.frames(measurements)
        self._components = np.abs(self.cells.directions) > ROUNDING
        for frame in self._frames:  # turning the frame turns them
            self._components[frame.members] = np.repeat(
                [self._components[frame.members, k : k + 3].any() for k in (0, 3)], 3
            )
        for lengths in self._lengths:
            self._components[lengths.members, :3] = True  # their directions change with the answer
        self._groups = self._group_alike()
        needed = len(space.blocks[0].labels)
        free = len(self.cells.station) - len(self._zeros.groups) - int(self._zeros.sloping.sum())
        free -= len(self._squares) + sum(lengths.count for lengths in self._lengths) + 6 * len(self._frames)
        if alone and free < needed:
            problem = f"{len(measurements)} readings at {len(self.cells.station)} distinct places leave {free} "
            raise CalibrationError("measurements", problem + f"numbers for the structure's {needed} parameters")

    def linearise(
        self, x: np.ndarray, reading_weights: np.ndarray, unsettled: bool = True
    ) -> tuple[LinearProblem, np.ndarray]:
        """Return the linear problem at a parameter vector, and each reading's residual there, m or rad.

        The cells' variance includes that of `unsettled` lost motions.
        """
        c, m = self.cells, self.measurements
        weights = reading_weights / self.uncertainty**2
        total = np.bincount(c.of_reading, weights)
        values = np.bincount(c.of_reading, weights * m.value) / total
        prediction, directions = self._predicted(x), c.directions.copy()
        variances = self._variances_of_unsettled(prediction) * unsettled
        allowed, shown = 1.0 + total * variances
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
        # Huber's proposal 2: noise is estimated from clipped residuals, weight² · residual², since outliers would
        # enlarge it.
        clipped = weights * (1.0 - reading_weights) / allowed[c.of_reading]
        beyond = np.bincount(m.kind, clipped * residuals**2, len(KINDS))
        problem = self._problem(target + moved, rows, scatter - beyond, unknowns)
        freedom = problem.freedom - np.bincount(c.kind, 1.0 - shown / allowed, len(KINDS))
        problem = replace(problem, freedom=freedom, per_length=per_length, unknowns=tuple(unknowns), scale=scale)
        return problem, residuals

    def _rows(self, x: np.ndarray, prediction: Prediction, directions: np.ndarray) -> tuple[DesignMatrix, np.ndarray]:
        """Return each cell's derivatives by y, and the effect of all parameters together, (C,).

        Along directions (C, 6), over the standard deviations of the cells' values.
        """
        c, space, moved = self.cells, self.space, np.empty(len(self.cells.station))
        slopes, y = Slopes(space, prediction, self.measurements.stations, whitened=True), space.whitened_parameters(x)

        def rows_of(group: _Group) -> Alike:
            columns = slopes.columns(group.components)
            rows = np.empty((len(group.cells), len(columns)))
            for first in range(0, len(rows), CHUNK):
                part, cells = rows[first : first + CHUNK], group.cells[first : first + CHUNK]
                slopes.write(part, c.station[cells], directions[cells], group.components)
                moved[cells] = part @ y[columns]
            return Alike(group.cells, columns, rows)

        return DesignMatrix((len(moved), space.size), at_once(rows_of, self._groups, len(moved))), moved

    @property
    def fixed_unknowns(self) -> bool:
        """Whether the instruments' unknowns move the same cells whatever was read: no lengths, no tracker's frame."""
        return not self._lengths and not self._frames

    def free_of_nuisance(self, rows: np.ndarray) -> np.ndarray:
        """Return cells' derivatives (C, K) free of the instruments' unknowns, over their noise.

        The noise is the stated one.
        """
        scale, unknowns = self._stated_unknowns()
        rows = scale[:, None] * rows
        for part in unknowns:
            part.project_out(rows)
        return rows

    def shares_of_nuisance(self) -> np.ndarray:
        """Return the share of each cell's value that the instruments' unknowns explain, shape (C,), 0…1."""
        shares = np.zeros(len(self.cells.station))
        for part in self._stated_unknowns()[1]:
            shares[part.members] += part.basis**2 @ part.share
        return shares

    def _stated_unknowns(self) -> tuple[np.ndarray, list[Nuisance]]:
        """Return 1/σ of each cell by its stated noise, (C,), and the instruments' unknowns, for the nominal machine."""
        scale = np.sqrt(np.bincount(self.cells.of_reading, self.uncertainty**-2))
        values = np.zeros(len(scale))
        return scale, self.unknowns(self.cells.directions.copy(), np.zeros((len(scale), 6)), values, scale)[1]

    def _predicted(self, x: np.ndarray) -> Prediction:
        """Return the machine of a parameter vector at the stations."""
        try:
            return predict(self.space, x, self.measurements.stations)
        except (ModelError, KinematicsError) as error:
            hint = "do units, directions and commanded poses fit, and are all blocks allowed?"
            problem = f"left the machines that can be ({error}); {hint}"
            raise CalibrationError("fit", problem) from error

    def unknowns(
        self, directions: np.ndarray, errors: np.ndarray, values: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, list[Nuisance]]:
        """Return the predicted values of cells with errors (C, 6), and the unknowns; updates `directions` that depend
        on them."""
        expected = np.einsum("ci,ci->c", directions, errors)
        unknowns = self._zeros.unknowns(scale)
        unknowns += [of_square(n, scale[n], self.cells.lever[n], self.cells.group[n]) for n in self._squares]
        for lengths in self._lengths:
            n = lengths.members
            expected[n], directions[n, :3], parts = lengths.linearise(errors[n, :3], values[n], scale[n])
            unknowns += parts
        for frame in self._frames:
            n = frame.members
            expected[n], directions[n], part = frame.linearise(directions[n], errors[n], values[n], scale[n])
            unknowns.append(part)
        return expected, unknowns

    def _variances_of_unsettled(self, prediction: Prediction) -> np.ndarray:
        """Return variances of cells' values by lost motions that may be at either end, (2, C): allowed, and expected.

        An error of the forces is common to all n cells of a strut's unsettled stations: each is allowed n times its
        own variance, so that together they count as one.
        """
        c = self.cells
        if not prediction.load.lost_motion.any():
            return np.zeros((2, len(c.station)))
        gains, deviations = self.of_unsettled(prediction)
        squares = (gains * deviations) ** 2
        return np.stack([squares @ np.count_nonzero(deviations, axis=0), squares.sum(axis=1)])

    def of_unsettled(self, prediction: Prediction) -> tuple[np.ndarray, np.ndarray]:
        """Return cells' derivatives by the struts' lengths, and these lengths' deviations by unsettled lost motions, m,
        both (C, 6)."""
        c, linkage = self.cells, Linkage(prediction, self.space.probe, self.measurements.stations)
        return linkage.errors(c.station, c.directions, np.arange(6)).gains, unsettled_lengths(linkage)[c.station]

    def _problem(
        self, target: np.ndarray, rows: DesignMatrix, scatter: np.ndarray, unknowns: list[Nuisance]
    ) -> LinearProblem:
        """Compute the sums that later steps need."""
        kind, size, kinds = self.cells.kind, self.space.size, len(KINDS)
        normal, moment, square = np.zeros((kinds, size, size)), np.zeros((kinds, size)), scatter.copy()
        freedom = np.bincount(self.measurements.kind, minlength=kinds).astype(float)
        for part in unknowns:
            freedom -= np.bincount(kind[part.members], part.basis**2 @ part.share, kinds)
        products = at_once(lambda part: part.values.T @ part.values, rows.parts, len(target))
        for group, (_, columns, values), product in zip(self._groups, rows.parts, products, strict=True):
            normal[group.kind][np.ix_(columns, columns)] += product
            moment[group.kind][columns] += target[group.cells] @ values
            square[group.kind] += target[group.cells] @ target[group.cells]
        least_noise = LEAST_NOISE / np.array([self.measurements.stated_of(k) for k in range(kinds)])
        return LinearProblem(target, rows, kind, self.cells.fold, normal, moment, square, freedom, least_noise)

    def _group_alike(self) -> list[_Group]:
        """Return the cells in groups of one kind whose errors have the same components."""
        c = self.cells
        for members in (*self._zeros.groups, *self._squares, *(lengths.members for lengths in self._lengths)):
            self._components[members] |= self._components[members].any(axis=0)
        key = c.kind * 64 + self._components @ (1 << np.arange(6))
        order = np.lexsort((c.group, self.measurements.run[c.first], key))
        return [
            _Group(int(c.kind[cells[0]]), np.flatnonzero(self._components[cells[0]]), cells)
            for cells in np.split(order, np.flatnonzero(np.diff(key[order])) + 1)
        ]

    def robust_weights(self, residuals: np.ndarray) -> np.ndarray:
        """Return Huber's weights of residuals (N,), 1 for all below the threshold.

        The threshold is in units of the median of each kind's residuals, which gross errors do not move.
        """
        size = np.abs(residuals) / self.uncertainty
        weights = np.ones(len(size))
        for k in np.unique(self.measurements.kind):
            members = self.measurements.kind == k
            cut = ASSUMED.huber * MEDIAN_TO_SIGMA * np.median(size[members])
            if cut > 0.0:
                weights[members] = np.minimum(1.0, cut / np.maximum(size[members], cut))
        return weights


class NotSettled(CalibrationError):
    """A fit whose parameters still change after the last step, with its state then."""

    def __init__(self, problem: str, solution: Solution) -> None:
        super().__init__("fit", problem)
        self.solution = solution


@dataclass(frozen=True)
class Solution:
    """A settled fit."""

    problem: LinearProblem  # Linearised at the answer
    posterior: Posterior  # The answer
    x: np.ndarray  # (size,): Its parameters, SI
    residuals: np.ndarray  # (N,): Of each reading, m or rad
    weights: np.ndarray  # (N,): Robust weight of each reading, 0…1
    steps: int  # Gauss–Newton steps
    change: float  # Largest change of a parameter in the last one, in its standard deviation


def iterate(
    estimation: Estimation,
    x: np.ndarray,
    tolerances: np.ndarray,
    noise: np.ndarray,
    progress: Callable[[str], object],
) -> Solution:
    """Run Gauss–Newton steps until the parameters converge, from the nominal machine or from an answer."""
    space, weights = estimation.space, np.ones(len(estimation.measurements))
    robust = space.settings.robust
    share, before = 1.0, np.inf  # of a step that is made: less where steps grow, as where a force changes its sign
    all_alike = 0 if x.any() else 1  # steps whose residuals are the machine's errors: no reading is downweighted
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
        if (change < SETTLED and (step > all_alike + 1 or not robust)) or step == STEPS:
            break
        if robust and step > all_alike:
            weights = estimation.robust_weights(residuals)
    solution = Solution(problem, posterior, x, residuals, weights, step, change)
    if change > 1.0:
        block = max(space.blocks, key=lambda block: sizes[block.part].max())
        moving = f"did not settle within {STEPS} steps: {block.name} still changes by {change:.2g} standard deviations"
        raise NotSettled(f"{moving}; are all blocks allowed, and is it measured in enough places?", solution)
    return solution


class Omitted(NamedTuple):
    """Effect of leaving one group of cells out of a fit."""

    cells: np.ndarray  # (n,): the group
    errors: np.ndarray  # (n,): leave-one-out residuals, in standard deviations
    moved: np.ndarray  # (k,): change of the effects of the parameters
    covariance: np.ndarray  # (k, k): covariance of that change, if the model is right


def jackknife(
    rows: DesignMatrix, residual: np.ndarray, precision: np.ndarray, groups: np.ndarray, effects: np.ndarray
) -> list[Omitted]:
    """Return the effect of leaving out each group of cells, in the linear problem: exact, and no fit is repeated.

    Without a group's rows R and residuals r, parameters z whose precision is P = C⁻¹ change by
    (P − Rᵀ·R)⁻¹·Rᵀ·r = C·Rᵀ·(1 − R·C·Rᵀ)⁻¹·r, a matrix of the parameters' size or of the group's; the covariance of
    that is (P − Rᵀ·R)⁻¹ − C if the model is right. `effects`, (n, k), are the functions of the parameters whose change
    is computed.
    """
    covariance = np.linalg.inv(precision)
    reached = covariance @ effects
    before = effects.T @ reached

    def without(cells: np.ndarray) -> Omitted:
        own, left = rows.select(cells).dense(), residual[cells]
        few = 2 * len(left) < len(precision)
        matrix = np.eye(len(left)) - own @ covariance @ own.T if few else precision - own.T @ own
        factor = np.linalg.cholesky(matrix)
        half, moment = (
            dtrtrs(factor, side, lower=1)[0] for side in ((own @ reached, left) if few else (effects, own.T @ left))
        )
        solved = dtrtrs(factor, moment, lower=1, trans=1)[0]
        errors, grown = (solved, half.T @ half) if few else (left + own @ solved, half.T @ half - before)
        return Omitted(cells, errors, half.T @ moment, grown)

    order = np.argsort(groups, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    return at_once(without, members, len(groups))


def influence(run: np.ndarray, solution: Solution) -> np.ndarray:
    """Return the change of the parameters without each run, in their standard deviations: Cook's distance, (runs,).

    `run` (C,) is that of each cell.
    """
    problem, p = solution.problem, solution.posterior
    scale = 1.0 / p.noise[problem.kind]
    rows = problem.rows.using(p.used, scale, p.spread)
    precision = whitened_precision(problem, p)
    left = scale * problem.target - rows.times(p.y / p.spread)
    omitted = jackknife(rows, left, precision, run, np.linalg.cholesky(precision))
    return np.array([np.linalg.norm(one.moved) for one in omitted])
