"""One linear problem of a fit: the most probable parameters, their priors' sizes, the noise, and what is left out.

All that a solution needs are sums of products of the derivatives, kind by kind: readings are looked at once, however
often tolerances and noise are estimated anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from ..errors import CalibrationError
from .cell_rows import CellRows
from .parameters import ParameterSpace
from .unknowns import Unknown

SCALE_ROUNDS = 12
"""Rounds of estimating tolerances and noise for one linearisation."""

SCALE_SETTLED = 1e-6
"""The rounds stop when no tolerance and no noise changes by more than this share."""

LONGEST_STRIDE = 16.0
"""An extrapolation goes no further than so many rounds squared would."""

LEAP = np.log(10.0)
"""It changes no tolerance and no noise by more than this logarithm: rounds that still gain speed lead nowhere."""

HYPER = 0.1
"""How many parameters the first guess of a tolerance is worth."""

LARGEST_TOLERANCE = {"structure": 5e-3}
"""No machine is built worse than this, m; a misfit that grows the tolerance further has another cause."""

LEAST_FREEDOM = 10.0
"""Noise is estimated from at least so many readings beyond those that the parameters use up."""

TOGETHER = 1000
"""Cells of small folds that are looked at together."""

LARGE_FOLD, SMALL = 300, -1
"""Cells from which a fold is left out by its sums, not cell by cell; and the mark of all smaller folds together."""


class FoldSum(NamedTuple):
    """Sum of products of the derivatives of one fold's cells that the same parameters move.

    Attributes
    ----------
    fold : int
        As in :class:`Cells`; :data:`SMALL` for all small folds together.
    part : int
        Which part of the rows.
    where : slice
        Where they stand in it.
    normal : ndarray, shape (m, m)
        rowsᵀ·rows.
    """

    fold: int
    part: int
    where: slice
    normal: np.ndarray


@dataclass(frozen=True)
class LinearProblem:
    """The fit linearised at one parameter vector x = root·y, free of what instruments do not know.

    Attributes
    ----------
    target : ndarray, shape (C,)
        Cells' values that the parameters explain, over their standard deviation at unit noise factors.
    rows : CellRows, shape (C, size)
        Their derivatives by y, alike.
    kind, fold : ndarray of int, shape (C,)
        As in :class:`Cells`.
    normal : ndarray, shape (kinds, size, size)
        rowsᵀ·rows of each kind.
    moment : ndarray, shape (kinds, size)
        rowsᵀ·target of each kind.
    square : ndarray, shape (kinds,)
        Sum of squared targets, the scatter of readings about their cell's mean included.
    freedom : ndarray, shape (kinds,)
        Readings minus unknowns projected out.
    least_noise : ndarray, shape (kinds,)
        Smallest noise factors that an instrument can have.
    per_length : ndarray, shape (C, 6)
        Derivatives by the struts' lengths, scaled as the rows, with what instruments do not know still in them.
    unknowns : tuple of Unknown
        What that is.
    sums : tuple of FoldSum
        The parts of `normal` that large folds make up.
    """

    target: np.ndarray
    rows: CellRows
    kind: np.ndarray
    fold: np.ndarray
    normal: np.ndarray
    moment: np.ndarray
    square: np.ndarray
    freedom: np.ndarray
    least_noise: np.ndarray
    per_length: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    unknowns: tuple[Unknown, ...] = ()
    sums: tuple[FoldSum, ...] = ()


@dataclass(frozen=True)
class Posterior:
    """What a linear problem says about the parameters y that it uses.

    Attributes
    ----------
    used : ndarray of int, shape (n,)
        Which parameters; the others' blocks are out.
    y : ndarray, shape (n,)
        The most probable ones.
    covariance : ndarray, shape (n, n)
        Theirs.
    tolerances : ndarray, shape (blocks,)
        Size of each block's prior; zero: the block is out.
    noise : ndarray, shape (kinds,)
        Factor on the standard deviation of each kind's readings.
    determined : ndarray, shape (n,)
        Share of each parameter that comes from the data; the rest comes from the prior.
    spread : ndarray, shape (n,)
        The prior's standard deviation of each y.
    """

    used: np.ndarray
    y: np.ndarray
    covariance: np.ndarray
    tolerances: np.ndarray
    noise: np.ndarray
    determined: np.ndarray
    spread: np.ndarray


def solve(
    space: ParameterSpace,
    problem: LinearProblem,
    tolerances: np.ndarray,
    noise: np.ndarray,
    rounds: int = SCALE_ROUNDS,
) -> Posterior:
    """Return the posterior of a linear problem; tolerances and noise factors are estimated with it.

    Parameters
    ----------
    space : ParameterSpace
        Blocks and their priors' shapes.
    problem : LinearProblem
        The data.
    tolerances : ndarray, shape (blocks,)
        To start from; a block with zero is left out.
    noise : ndarray, shape (kinds,)
        To start from.
    rounds : int
        Fixed-point rounds; 0 takes tolerances and noise as they are.
    """
    used = np.flatnonzero(space.spread(tolerances))
    kinds = np.unique(problem.kind)
    normal, moment = problem.normal[np.ix_(kinds, used, used)], problem.moment[np.ix_(kinds, used)]
    scales = [np.concatenate([tolerances, noise])]
    for turn in range(rounds + 1):
        tolerances, noise = scales[-1][: len(tolerances)], scales[-1][len(tolerances) :]
        spread = space.spread(tolerances)[used]
        whitened = np.tensordot(noise[kinds] ** -2, normal, 1)
        whitened *= spread[:, None] * spread
        whitened[np.diag_indices_from(whitened)] += 1.0
        inverse = _inverse(whitened)
        z = inverse @ (spread * (noise[kinds] ** -2 @ moment))
        determined = 1.0 - np.diag(inverse)
        inverse *= spread[:, None] * spread
        posterior = Posterior(used, spread * z, inverse, tolerances, noise, determined, spread)
        if turn < rounds:
            noise, tolerances = _noise(problem, kinds, normal, moment, posterior), _tolerances(space, posterior, z)
            scales.append(np.concatenate([tolerances, noise]))
            ratio = scales[-1][scales[-1] > 0.0] / scales[-2][scales[-1] > 0.0]
            if np.abs(np.log(ratio)).max() < SCALE_SETTLED:
                break
            if len(scales) == 3:
                scales = [_extrapolated(*scales)]
    return posterior


def _extrapolated(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Return where three rounds of a fixed point that converge slowly lead, in logarithms (SQUAREM).

    Varadhan, Roland (2008), Scandinavian Journal of Statistics 35, 335: first − 2·a·r + a²·v, with r and v first and
    second differences and a = −|r|/|v|, no shorter than a round and at most :data:`LONGEST_STRIDE` of them.
    """
    live = third > 0.0
    logs = np.log(np.stack([first[live], second[live], third[live]]))
    step, bend = logs[1] - logs[0], logs[2] - 2.0 * logs[1] + logs[0]
    stride = float(np.clip(np.linalg.norm(step) / max(float(np.linalg.norm(bend)), 1e-12), 1.0, LONGEST_STRIDE))
    result = third.copy()
    led = logs[0] + 2.0 * stride * step + stride**2 * bend
    result[live] = np.exp(np.clip(led, logs[2] - LEAP, logs[2] + LEAP))
    return result


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite matrix, which is overwritten.

    Raises
    ------
    CalibrationError
        It is not, to rounding: readings outweigh the priors more than 1e16 times.
    """
    factor, failed = dpotrf(matrix.T, lower=1, overwrite_a=1)
    if failed:
        problem = "are too few to tell noise from the machine's errors, or their uncertainty is below any instrument's"
        raise CalibrationError("measurements", problem)
    lower, _ = dpotri(factor, lower=1, overwrite_c=1)
    inverse = lower.T + lower  # dpotrf has left zeros above
    inverse[np.diag_indices_from(inverse)] *= 0.5
    return inverse


def _noise(
    problem: LinearProblem, kinds: np.ndarray, normal: np.ndarray, moment: np.ndarray, posterior: Posterior
) -> np.ndarray:
    """Return new noise factors: squared residuals over what freedom the parameters leave; sums of some kinds."""
    result, y = posterior.noise.copy(), posterior.y
    for k, information, sums in zip(kinds, normal, moment, strict=True):
        rest = problem.square[k] - 2.0 * y @ sums + y @ information @ y
        freedom = problem.freedom[k] - np.vdot(posterior.covariance, information) / result[k] ** 2
        if freedom > LEAST_FREEDOM and rest > 0.0:
            result[k] = np.sqrt(rest / freedom)
    return np.maximum(result, problem.least_noise)


def _tolerances(space: ParameterSpace, posterior: Posterior, z: np.ndarray) -> np.ndarray:
    """Return new tolerances: MacKay's fixed point, squared parameters over how many are determined.

    The first guess counts as a tenth of a parameter, which keeps an empty block from collapsing.
    """
    result, start = posterior.tolerances.copy(), space.start_tolerances()
    for n, block in enumerate(space.blocks):
        members = (posterior.used >= block.part.start) & (posterior.used < block.part.stop)
        if members.any():
            first = HYPER * (start[n] / result[n]) ** 2
            factor = np.sqrt((z[members] @ z[members] + first) / (posterior.determined[members].sum() + HYPER))
            result[n] = min(result[n] * np.clip(factor, 0.1, 10.0), LARGEST_TOLERANCE.get(block.name, np.inf))
    return result


def log_evidence(problem: LinearProblem, posterior: Posterior) -> float:
    """Return the logarithm of the readings' probability under a posterior's tolerances and noise, but for a constant.

    MacKay (1992), Neural Computation 4, 415: how well the readings are met, less what it takes to single the parameters
    out of their priors.
    """
    kinds = np.unique(problem.kind)
    weights, moment = posterior.noise[kinds] ** -2, problem.moment[np.ix_(kinds, posterior.used)]
    _, determinant = np.linalg.slogdet(whitened_precision(problem, posterior))
    unmet = weights @ (problem.square[kinds] - moment @ posterior.y)
    return float(-0.5 * (unmet + determinant - problem.freedom[kinds] @ np.log(weights)))


def held_out(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the errors, in standard deviations, at cells whose fold the fit did not see, shape (C,).

    Leaving fold g out of a linear least-squares fit changes its residuals r to (I − H_gg)⁻¹·r, with H the
    hat matrix: exact, and no fit is repeated. In a fold of many cells the same is r + R_g·(P − R_gᵀ·R_g)⁻¹·R_gᵀ·r, with
    R_g its rows and P the precision of all: a matrix of the parameters' size.
    """
    full = np.zeros(problem.rows.shape[1])
    full[posterior.used] = posterior.y
    residual = (problem.target - problem.rows.times(full)) / posterior.noise[problem.kind]
    sums: dict[int, list[FoldSum]] = {}
    for one in problem.sums:
        sums.setdefault(one.fold, []).append(one)
    precision = whitened_precision(problem, posterior) if sums else np.zeros((0, 0))
    folds = _Folds(problem, posterior, residual, precision)
    result = residual.copy()
    for cells, change in map(folds.large, sums.values()):
        result[cells] += change
    for cells, change in map(folds.small, _small_folds(problem.fold, [*sums])):
        result[cells] += change
    return result


class _Folds(NamedTuple):
    """What leaving out folds needs; either way returns cells, and by how much their residuals change without them."""

    problem: LinearProblem
    posterior: Posterior
    residual: np.ndarray
    precision: np.ndarray

    def large(self, sums: list[FoldSum]) -> tuple[np.ndarray, np.ndarray]:
        """Leave out a fold of many cells, given its sums."""
        cells = np.concatenate([self.problem.rows.parts[one.part].cells[one.where] for one in sums])
        posterior, rows = self.posterior, self.problem.rows.select(cells)
        scale, change = 1.0 / posterior.noise[self.problem.kind[cells]], np.zeros(rows.shape[1])
        missing = rows.transposed_times(scale * self.residual[cells])[posterior.used]
        factor = np.linalg.cholesky(_without(self.precision, self.problem, sums, posterior))
        change[posterior.used] = posterior.spread * dpotrs(factor, posterior.spread * missing, lower=1)[0]
        return cells, scale * rows.times(change)

    def small(self, folds: tuple[np.ndarray, list[int]]) -> tuple[np.ndarray, np.ndarray]:
        """Leave out folds of few cells in turn, given all their cells and where each ends."""
        cells, ends = folds
        rows = self.problem.rows.select(cells)
        rows = rows.using(self.posterior.used, 1.0 / self.posterior.noise[self.problem.kind[cells]])
        shared, whole, left = rows.times(self.posterior.covariance), rows.dense(), self.residual[cells]
        result = np.empty(len(cells))
        for a, b in pairwise(ends):
            result[a:b] = np.linalg.solve(np.eye(b - a) - shared[a:b] @ whole[a:b].T, left[a:b])
        return cells, result - left


def _small_folds(fold: np.ndarray, large: list[int]) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Yield the cells of small folds, a thousand or so at a time, in the order of their folds, and where these end."""
    order = np.argsort(fold, kind="stable")
    order = order[~np.isin(fold[order], large)]
    if not len(order):
        return
    ends = [0, *(np.flatnonzero(np.diff(fold[order])) + 1).tolist(), len(order)]
    first = 0
    for n, end in enumerate(ends):
        if end - ends[first] >= TOGETHER or n == len(ends) - 1:
            yield order[ends[first] : end], [e - ends[first] for e in ends[first : n + 1]]
            first = n


def whitened_precision(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the precision of y over the prior's spread, shape (n, n)."""
    kinds = np.unique(problem.kind)
    information = problem.normal[np.ix_(kinds, posterior.used, posterior.used)]
    precision = np.tensordot(posterior.noise[kinds] ** -2, information, 1)
    precision *= posterior.spread[:, None] * posterior.spread
    precision[np.diag_indices_from(precision)] += 1.0
    return precision


def _without(precision: np.ndarray, problem: LinearProblem, parts: list[FoldSum], posterior: Posterior) -> np.ndarray:
    """Return a whitened precision without what the cells of one fold tell."""
    place = np.full(problem.rows.shape[1], -1)
    place[posterior.used] = np.arange(len(posterior.used))
    left = precision.copy()
    for one in parts:
        cells, columns, _ = problem.rows.parts[one.part]
        known = np.flatnonzero(place[columns] >= 0)
        at = place[columns[known]]
        size = posterior.spread[at] / posterior.noise[problem.kind[cells[0]]]
        information = one.normal if len(known) == len(columns) else one.normal[np.ix_(known, known)]
        left[np.ix_(at, at)] -= size[:, None] * information * size
    return left


def physical_covariance(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the covariance of the parameters x, shape (size, size), SI; all blocks must be in use."""
    return space.physical(space.physical(posterior.covariance).T)
