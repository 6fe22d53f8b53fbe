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
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs

from ..errors import CalibrationError
from .cell_rows import CellRows, at_once
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

DRAWS, SEED = 160, 5
"""Draws of the parameters that show what they do along a line."""

TOGETHER = 1000
"""Rows of small folds that are looked at together."""


class Condensed(NamedTuple):
    """The cells of a linear problem, each fold's and kind's in as few rows as its parameters can be told by.

    Attributes
    ----------
    target : ndarray, shape (K,)
        In place of the cells' targets.
    rows : CellRows, shape (K, size)
        In place of theirs.
    cell, first : ndarray of int, shape (K,) and (C,)
        The first cell of the fold and kind that a row, or a cell, belongs to.
    rest : ndarray, shape (folds, kinds)
        Squares of what of the cells' targets no parameter moves.
    """

    target: np.ndarray
    rows: CellRows
    cell: np.ndarray
    first: np.ndarray
    rest: np.ndarray


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
    log_determinant : float
        Logarithm of the determinant of the precision of y over that.
    """

    used: np.ndarray
    y: np.ndarray
    covariance: np.ndarray
    tolerances: np.ndarray
    noise: np.ndarray
    determined: np.ndarray
    spread: np.ndarray
    log_determinant: float


def solve(
    space: ParameterSpace,
    problem: LinearProblem,
    tolerances: np.ndarray,
    noise: np.ndarray,
    rounds: int = SCALE_ROUNDS,
    silent: np.ndarray | None = None,
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
    silent : ndarray of int, optional
        Parameters of which the readings say nothing: they are left out.
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


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the inverse of a positive definite matrix, which is overwritten, and the logarithm of its determinant.

    Raises
    ------
    CalibrationError
        It is not, to rounding: readings outweigh the priors more than 1e16 times.
    """
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
    unmet = weights @ (problem.square[kinds] - moment @ posterior.y)
    return float(-0.5 * (unmet + posterior.log_determinant - problem.freedom[kinds] @ np.log(weights)))


def condense(problem: LinearProblem, posterior: Posterior) -> Condensed:
    """Return what leaving out folds looks at, for fits with the parameters of a posterior, or some of them."""
    group = problem.fold * len(problem.freedom) + problem.kind
    _, cells, member = np.unique(group, return_index=True, return_inverse=True)
    first = cells[member.ravel()]
    draws = np.zeros((problem.rows.shape[1], DRAWS))
    z = np.random.default_rng(SEED).standard_normal((len(posterior.used), DRAWS)) / np.sqrt(DRAWS)
    root = np.linalg.cholesky(whitened_precision(problem, posterior))
    draws[posterior.used] = posterior.spread[:, None] * dtrtrs(root, z, lower=1, trans=1)[0]
    rows, target, cell = problem.rows.condensed(problem.target, first, draws / posterior.noise[problem.kind].min())
    shape = int(problem.fold.max()) + 1, len(problem.freedom)
    rest = np.bincount(group, problem.target**2, shape[0] * shape[1])
    rest -= np.bincount(group[cell], target**2, len(rest))
    return Condensed(target, rows, cell, first, np.maximum(rest, 0.0).reshape(shape))


def held_out(problem: LinearProblem, condensed: Condensed, posterior: Posterior) -> np.ndarray:
    """Return the errors, in standard deviations, at cells whose fold the fit did not see, shape (C,)."""
    solved = _solved_without(problem, condensed, posterior)
    return _errors(problem.rows, problem.target, problem.fold, solved) / posterior.noise[problem.kind]


def held_out_squares(problem: LinearProblem, condensed: Condensed, posterior: Posterior) -> np.ndarray:
    """Return the sums of squares of :func:`held_out` by fold and kind, over the stated noise, shape (folds, kinds)."""
    squares, (fold, kind) = condensed.rest.copy(), (each[condensed.cell] for each in (problem.fold, problem.kind))
    errors = _errors(condensed.rows, condensed.target, fold, _solved_without(problem, condensed, posterior))
    np.add.at(squares, (fold, kind), errors**2)
    return squares


def _errors(rows: CellRows, target: np.ndarray, fold: np.ndarray, solved: np.ndarray) -> np.ndarray:
    """Return what is left of targets at each fold's own answer (folds, size)."""
    result = target.copy()
    for part in rows.parts:
        for first in range(0, len(part.cells), TOGETHER):
            cells, values = part.cells[first : first + TOGETHER], part.values[first : first + TOGETHER]
            result[cells] -= np.einsum("ci,ci->c", values, solved[np.ix_(fold[cells], part.columns)])
    return result


def _solved_without(problem: LinearProblem, condensed: Condensed, posterior: Posterior) -> np.ndarray:
    """Return the most probable y of fits that did not see one fold, shape (folds, size): exact, and no fit is repeated.

    Without a fold with rows R and residuals r, y changes by −C·Rᵀ·(1 − R·C·Rᵀ)⁻¹·r, with C the parameters' covariance,
    or by −(C⁻¹ − Rᵀ·R)⁻¹·Rᵀ·r: a matrix of the rows' size, where they are few, or of the parameters'.
    """
    used, spread, fold = posterior.used, posterior.spread, problem.fold[condensed.cell]
    solved, small = np.zeros((len(condensed.rest), problem.rows.shape[1])), len(used) // 2
    # It is not needed where no fold is large.
    precision = whitened_precision(problem, posterior) if np.bincount(fold).max() > small else np.zeros((0, 0))

    def solve_without(some: tuple[np.ndarray, list[int]]) -> None:
        chosen, ends = some
        scale = 1.0 / posterior.noise[problem.kind[condensed.cell[chosen]]]
        rows = condensed.rows.select(chosen).using(used, scale)
        left = scale * condensed.target[chosen] - rows.times(posterior.y)
        if ends[1] > small:
            seen = rows.normal()
            seen *= spread[:, None]
            seen *= spread
            factor = np.linalg.cholesky(np.subtract(precision, seen, out=seen))
            changes = spread * dpotrs(factor, spread * rows.transposed_times(left), lower=1)[0]
        else:
            shared, whole = rows.times(posterior.covariance), rows.dense()
            changes = np.empty((len(ends) - 1, len(used)))
            for n, (a, b) in enumerate(pairwise(ends)):
                changes[n] = np.linalg.solve(np.eye(b - a) - shared[a:b] @ whole[a:b].T, left[a:b]) @ shared[a:b]
        solved[np.ix_(fold[chosen[ends[:-1]]], used)] = posterior.y - changes

    at_once(solve_without, _whole_folds(fold, small))
    return solved


def _whole_folds(fold: np.ndarray, small: int) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Yield rows in the order of their folds, and where each ends: some thousand of small folds, or a large one."""
    order = np.argsort(fold, kind="stable")
    ends = [0, *(np.flatnonzero(np.diff(fold[order])) + 1).tolist(), len(order)]
    first = 0
    for n, (start, end) in enumerate(pairwise(ends), 1):
        last = n == len(ends) - 1
        if last or end - ends[first] >= TOGETHER or max(end - start, ends[n + 1] - end) > small:
            yield order[ends[first] : end], [e - ends[first] for e in ends[first : n + 1]]
            first = n


def whitened_precision(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the precision of y over the prior's spread, shape (n, n)."""
    kinds = np.unique(problem.kind)
    information = problem.normal[np.ix_(kinds, posterior.used, posterior.used)]
    return _whitened(posterior.noise[kinds], information, posterior.spread)


def _whitened(noise: np.ndarray, information: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the same from the noise (kinds,) and the information (kinds, n, n) of each kind, and the spread (n,)."""
    precision = np.tensordot(noise**-2, information, 1)
    precision *= spread[:, None] * spread
    precision[np.diag_indices_from(precision)] += 1.0
    return precision


def physical_covariance(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the covariance of the parameters x, shape (size, size), SI; all blocks must be in use."""
    return space.physical(space.physical(posterior.covariance).T)
