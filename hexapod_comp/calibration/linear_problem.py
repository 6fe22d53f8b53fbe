"""One linear problem of a fit: the most probable parameters, their priors' sizes, the noise, and what is left out.

All that a solution needs are sums of products of the derivatives, kind by kind: readings are looked at once, however
often tolerances and noise are estimated anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from ..errors import CalibrationError
from .parameters import ParameterSpace
from .unknowns import Unknown

SCALE_ROUNDS = 12
"""Rounds of estimating tolerances and noise for one linearisation."""

SCALE_SETTLED = 1e-9
"""The rounds stop when no tolerance and no noise changes by more than this share."""

LONGEST_STRIDE = 16.0
"""An extrapolation goes no further than so many rounds squared would."""

HYPER = 0.1
"""How many parameters the first guess of a tolerance is worth."""

LARGEST_TOLERANCE = {"structure": 5e-3}
"""No machine is built worse than this, m; a misfit that grows the tolerance further has another cause."""

LEAST_FREEDOM = 10.0
"""Noise is estimated from at least so many readings beyond those that the parameters use up."""

LARGE_FOLD, SMALL = 300, -1
"""Cells from which a fold is left out by its sums, not cell by cell; and the mark of all smaller folds together."""


class FoldSum(NamedTuple):
    """Sum of products of the derivatives of one fold's cells of one kind that the same parameters move.

    Attributes
    ----------
    fold, kind : int
        As in :class:`Cells`; :data:`SMALL` for all small folds together.
    columns : ndarray of int, shape (m,)
        These parameters.
    normal : ndarray, shape (m, m)
        rowsᵀ·rows.
    """

    fold: int
    kind: int
    columns: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class LinearProblem:
    """The fit linearised at one parameter vector x = root·y, free of what instruments do not know.

    Attributes
    ----------
    target : ndarray, shape (C,)
        Cells' values that the parameters explain, over their standard deviation at unit noise factors.
    rows : ndarray, shape (C, size)
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
    rows: np.ndarray
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
    normal = np.ascontiguousarray(problem.normal[:, used[:, None], used])
    moment = problem.moment[:, used]
    scales = [np.concatenate([tolerances, noise])]
    for turn in range(rounds + 1):
        tolerances, noise = scales[-1][: len(tolerances)], scales[-1][len(tolerances) :]
        spread = space.spread(tolerances)[used]
        whitened = np.tensordot(noise**-2, normal, 1)
        whitened *= spread[:, None] * spread
        whitened[np.diag_indices_from(whitened)] += 1.0
        inverse = _inverse(whitened)
        z = inverse @ (spread * (noise**-2 @ moment))
        determined = 1.0 - np.diag(inverse)
        inverse *= spread[:, None] * spread
        posterior = Posterior(used, spread * z, inverse, tolerances, noise, determined, spread)
        if turn < rounds:
            noise, tolerances = _noise(problem, normal, moment, posterior), _tolerances(space, posterior, z)
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
    result[live] = np.exp(logs[0] + 2.0 * stride * step + stride**2 * bend)
    return result


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite matrix.

    Raises
    ------
    CalibrationError
        It is not, to rounding: readings outweigh the priors more than 1e16 times.
    """
    factor, failed = dpotrf(matrix, lower=1)
    if failed:
        problem = "are too few to tell noise from the machine's errors, or their uncertainty is below any instrument's"
        raise CalibrationError("measurements", problem)
    lower, _ = dpotri(factor, lower=1, overwrite_c=1)
    lower = np.tril(lower)
    lower += np.tril(lower, -1).T
    return lower


def _noise(problem: LinearProblem, normal: np.ndarray, moment: np.ndarray, posterior: Posterior) -> np.ndarray:
    """Return new noise factors: squared residuals over what freedom the parameters leave."""
    result, y = posterior.noise.copy(), posterior.y
    for k in np.flatnonzero(problem.freedom > 0.0):
        rest = problem.square[k] - 2.0 * y @ moment[k] + y @ normal[k] @ y
        freedom = problem.freedom[k] - np.vdot(posterior.covariance, normal[k]) / result[k] ** 2
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


def held_out(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the errors, in standard deviations, at cells whose fold the fit did not see, shape (C,).

    Leaving fold g out of a linear least-squares fit changes its residuals r to (I − H_gg)⁻¹·r, with H the
    hat matrix: exact, and no fit is repeated. In a fold of many cells the same is r + R_g·(P − R_gᵀ·R_g)⁻¹·R_gᵀ·r, with
    R_g its rows and P the precision of all: a matrix of the parameters' size.
    """
    scale = 1.0 / posterior.noise[problem.kind]
    full = np.zeros(problem.rows.shape[1])
    full[posterior.used] = posterior.y
    residual = scale * (problem.target - problem.rows @ full)
    sums: dict[int, list[FoldSum]] = {}
    for part in problem.sums:
        sums.setdefault(part.fold, []).append(part)
    order = np.argsort(problem.fold, kind="stable")
    folds = np.split(order, np.flatnonzero(np.diff(problem.fold[order])) + 1)
    precision = whitened_precision(problem, posterior)
    # A root of the covariance, by way of the precision: a block of next to no tolerance leaves the former singular.
    lower = np.linalg.cholesky(precision)
    root = posterior.spread[:, None] * solve_triangular(lower, np.eye(len(lower)), lower=True).T
    result = np.empty(len(residual))
    for members in folds:
        parts = sums.get(int(problem.fold[members[0]]))
        if parts is None:
            half = scale[members, None] * problem.rows[members][:, posterior.used] @ root
            result[members] = np.linalg.solve(np.eye(len(members)) - half @ half.T, residual[members])
            continue
        in_row = members[-1] - members[0] == len(members) - 1  # as a rule: then nothing is copied
        rows = problem.rows[members[0] : members[-1] + 1] if in_row else problem.rows[members]
        missing = posterior.spread * ((scale[members] * residual[members]) @ rows)[posterior.used]
        factor, _ = dpotrf(_without(precision, parts, posterior), lower=1, overwrite_a=1)
        full[posterior.used] = posterior.spread * dpotrs(factor, missing, lower=1)[0]
        result[members] = residual[members] + scale[members] * (rows @ full)
    return result


def whitened_precision(problem: LinearProblem, posterior: Posterior) -> np.ndarray:
    """Return the precision of y over the prior's spread, shape (n, n)."""
    precision = np.tensordot(posterior.noise**-2, problem.normal[:, posterior.used[:, None], posterior.used], 1)
    precision *= posterior.spread[:, None] * posterior.spread
    precision[np.diag_indices_from(precision)] += 1.0
    return precision


def _without(precision: np.ndarray, parts: list[FoldSum], posterior: Posterior) -> np.ndarray:
    """Return a whitened precision, Fortran's order, without what the cells of one fold tell."""
    place = np.full(int(posterior.used.max()) + 1, -1)
    place[posterior.used] = np.arange(len(posterior.used))
    left = np.array(precision, order="F")
    for part in parts:
        known = part.columns <= posterior.used[-1]
        known[known] = place[part.columns[known]] >= 0
        at = place[part.columns[known]]
        size = posterior.spread[at] / posterior.noise[part.kind]
        left[np.ix_(at, at)] -= size[:, None] * part.normal[np.ix_(known, known)] * size
    return left


def physical_covariance(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the covariance of the parameters x, shape (size, size), SI; all blocks must be in use."""
    return space.physical(space.physical(posterior.covariance).T)
