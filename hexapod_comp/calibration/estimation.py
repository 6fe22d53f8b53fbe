"""Scheme ``joint``: structure, struts and field from all readings at once.

Gauss–Newton on the exact machine. Each linear problem is Bayesian: every block of parameters has a prior
whose size is estimated from the data (MacKay's fixed point), as is the noise of every kind of channel. What
an instrument does not know (each run's zero, the slope of its beam, where a length starts from) is projected out
beforehand, so it costs no parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from ..errors import CalibrationError, KinematicsError, ModelError
from ..measurements.readings import KINDS, LEAST_NOISE, MeasurementSet
from .cells import Cells
from .parameters import ParameterSpace
from .sensitivity import derivatives, predict
from .unknowns import Unknown, of_zero

STEPS = 20
"""Most Gauss–Newton steps; a handful is enough for deviations of a tenth of a millimetre."""

SLOW, LEAST_SHARE = 0.7, 0.3
"""A step whose change is not below so much of the last one's is shortened by half, to this share at least:
tolerances and parameters that wait for each other could otherwise swing for ever."""

SETTLED = 1e-2
"""The fit stops when no parameter moves by more than this share of its standard deviation."""

SCALE_ROUNDS = 12
"""Rounds of estimating tolerances and noise for one linearisation."""

HYPER = 0.1
"""How many parameters the first guess of a tolerance is worth."""

LARGEST_TOLERANCE = {"structure": 5e-3}
"""No machine is built worse than this, m; a misfit that grows the tolerance further has another cause."""

LEAST_FREEDOM = 10.0
"""Noise is estimated from at least so many readings beyond those that the parameters use up."""

HUBER = 2.5
"""Residuals beyond so many standard deviations lose weight in proportion."""

MEDIAN_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""

OUTLIER = 5.0
"""Residuals beyond so many standard deviations are listed."""


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
    """

    used: np.ndarray
    y: np.ndarray
    covariance: np.ndarray
    tolerances: np.ndarray
    noise: np.ndarray
    determined: np.ndarray


class Estimation:
    """Readings against parameters.

    Parameters
    ----------
    measurements : MeasurementSet
        The readings.
    space : ParameterSpace
        The parameters.
    alone : bool
        Nothing else is known of the machine: the readings must be enough.

    Raises
    ------
    CalibrationError
        Fewer readings than unknowns: nothing would be determined.
    """

    def __init__(self, measurements: MeasurementSet, space: ParameterSpace, alone: bool = True) -> None:
        self.measurements, self.space = measurements, space
        self.cells = Cells.of(measurements)
        self.uncertainty = measurements.stated
        self._zeros, self._lengths = self.cells.groups(measurements)
        needed = len(space.blocks[0].labels)
        free = len(self.cells.station) - len(self._zeros) - sum(along is not None for _, along in self._zeros)
        free -= sum(lengths.count for lengths in self._lengths)
        if alone and free < needed:
            problem = f"{len(measurements)} readings at {len(self.cells.station)} distinct places leave {free} "
            raise CalibrationError("measurements", problem + f"numbers for the structure's {needed} parameters")

    def linearise(self, x: np.ndarray, reading_weights: np.ndarray) -> tuple[LinearProblem, np.ndarray]:
        """Return the linear problem at a parameter vector, and each reading's residual there, m or rad.

        Parameters
        ----------
        x : ndarray, shape (size,)
            Parameters, SI.
        reading_weights : ndarray, shape (N,)
            Trust in each reading, 0…1.

        Raises
        ------
        CalibrationError
            No machine is like that, or it cannot take one of the poses.
        """
        c, m = self.cells, self.measurements
        weights = reading_weights / self.uncertainty**2
        total = np.bincount(c.of_reading, weights)
        scale = np.sqrt(total)
        expected, rows, unknowns = self._expected(x, np.bincount(c.of_reading, weights * m.value) / total, scale)
        misfit = m.value - expected[c.of_reading]
        mean = np.bincount(c.of_reading, weights * misfit) / total
        target, rows = scale * mean, scale[:, None] * rows
        per_length = rows[:, self.space.offsets].copy()
        unknown = np.zeros(len(mean))
        for part in unknowns:
            unknown[part.members] += part.explained(target) / scale[part.members]
            part.project_out(target)
            part.project_out(rows)
        residuals = misfit - unknown[c.of_reading]
        scatter = np.bincount(m.kind, weights * (misfit - mean[c.of_reading]) ** 2, len(KINDS))
        # Huber's proposal 2: noise comes from the residuals cut off, weight² · residual², or outliers blow it up.
        beyond = np.bincount(m.kind, weights * (1.0 - reading_weights) * residuals**2, len(KINDS))
        problem = self._problem(target + rows @ x, self.space.whitened(rows), scatter - beyond, unknowns)
        return replace(problem, per_length=per_length, unknowns=tuple(unknowns)), residuals

    def free_of_unknowns(self, rows: np.ndarray) -> np.ndarray:
        """Return what is left of cells' derivatives (C, K) beside all that instruments do not know, over their noise.

        The noise is the stated one.
        """
        scale, unknowns = self._stated_unknowns()
        rows = scale[:, None] * rows
        for part in unknowns:
            part.project_out(rows)
        return rows

    def shares_of_unknowns(self) -> np.ndarray:
        """Return how much of each cell's value what instruments do not know takes up, shape (C,), 0…1."""
        shares = np.zeros(len(self.cells.station))
        for part in self._stated_unknowns()[1]:
            shares[part.members] += part.basis**2 @ part.share
        return shares

    def _stated_unknowns(self) -> tuple[np.ndarray, list[Unknown]]:
        """Return one over the cells' stated noise, (C,), and what instruments do not know, at the nominal machine."""
        scale = np.sqrt(np.bincount(self.cells.of_reading, self.uncertainty**-2))
        values = np.zeros(len(scale))
        return scale, self._unknowns(self.cells.directions.copy(), np.zeros((len(scale), 6)), values, scale)[1]

    def _expected(
        self, x: np.ndarray, values: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, list[Unknown]]:
        """Return what each cell should read, shape (C,), its derivatives, (C, size), m and rad, and what is unknown.

        Lengths start from where their `values` and `scale`, one over their standard deviations, (C,) each, put it.

        Raises
        ------
        CalibrationError
            No machine is like that, or it cannot take one of the poses; a length's centre is far from its place.
        """
        c, stations = self.cells, self.measurements.stations
        try:
            prediction = predict(self.space, x, stations)
        except (ModelError, KinematicsError) as error:
            hint = "do units, directions and commanded poses fit, and are all blocks allowed?"
            problem = f"left the machines that can be ({error}); {hint}"
            raise CalibrationError("fit", problem) from error
        directions = c.directions.copy()
        expected, unknowns = self._unknowns(directions, prediction.errors[c.station], values, scale)
        slopes = derivatives(self.space, prediction, stations)[c.station]
        return expected, np.einsum("ci,cip->cp", directions, slopes), unknowns

    def _unknowns(
        self, directions: np.ndarray, errors: np.ndarray, values: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, list[Unknown]]:
        """Return what cells with errors (C, 6) should read, and what is unknown; renews `directions` of lengths."""
        expected = np.einsum("ci,ci->c", directions, errors)
        unknowns = [of_zero(members, scale[members], along) for members, along in self._zeros]
        for lengths in self._lengths:
            n = lengths.members
            expected[n], directions[n, :3], parts = lengths.seen(errors[n, :3], values[n], scale[n])
            unknowns += parts
        return expected, unknowns

    def _problem(
        self, target: np.ndarray, rows: np.ndarray, scatter: np.ndarray, unknowns: list[Unknown]
    ) -> LinearProblem:
        """Gather the sums that everything later needs."""
        kind, size, kinds = self.cells.kind, self.space.size, len(KINDS)
        normal, moment, square = np.zeros((kinds, size, size)), np.zeros((kinds, size)), scatter.copy()
        freedom = np.bincount(self.measurements.kind, minlength=kinds).astype(float)
        for part in unknowns:
            freedom[kind[part.members[0]]] -= part.share.sum()
        for k in np.unique(kind):
            part = rows[kind == k]
            normal[k] = part.T @ part
            moment[k] = part.T @ target[kind == k]
            square[k] += target[kind == k] @ target[kind == k]
        least_noise = LEAST_NOISE / np.array([self.measurements.stated_of(k) for k in range(kinds)])
        return LinearProblem(target, rows, kind, self.cells.fold, normal, moment, square, freedom, least_noise)

    def robust_weights(self, residuals: np.ndarray) -> np.ndarray:
        """Return Huber's weights of residuals (N,), 1 for all that are no surprise.

        What is a surprise is measured by the median of each kind's residuals, which gross errors do not move.
        """
        size = np.abs(residuals) / self.uncertainty
        weights = np.ones(len(size))
        for k in np.unique(self.measurements.kind):
            members = self.measurements.kind == k
            cut = HUBER * MEDIAN_TO_SIGMA * np.median(size[members])
            if cut > 0.0:
                weights[members] = np.minimum(1.0, cut / np.maximum(size[members], cut))
        return weights


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
    normal = problem.normal[:, used[:, None], used]
    moment = problem.moment[:, used]
    for turn in range(rounds + 1):
        spread = space.spread(tolerances)[used]
        precision = np.tensordot(noise**-2, normal, 1)
        whitened = spread[:, None] * precision * spread
        whitened[np.diag_indices_from(whitened)] += 1.0
        inverse = _inverse(whitened)
        z = inverse @ (spread * (noise**-2 @ moment))
        posterior = Posterior(
            used, spread * z, spread[:, None] * inverse * spread, tolerances, noise, 1.0 - np.diag(inverse)
        )
        if turn < rounds:
            noise = _noise(problem, normal, moment, posterior)
            tolerances = _tolerances(space, posterior, z)
    return posterior


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite matrix.

    Raises
    ------
    CalibrationError
        It is not, to rounding: readings outweigh the priors more than 1e16 times.
    """
    try:
        return cho_solve(cho_factor(matrix, lower=True), np.eye(len(matrix)))
    except LinAlgError as error:
        problem = "are too few to tell noise from the machine's errors, or their uncertainty is below any instrument's"
        raise CalibrationError("measurements", problem) from error


def _noise(problem: LinearProblem, normal: np.ndarray, moment: np.ndarray, posterior: Posterior) -> np.ndarray:
    """Return new noise factors: squared residuals over what freedom the parameters leave."""
    result, y = posterior.noise.copy(), posterior.y
    for k in np.flatnonzero(problem.freedom > 0.0):
        rest = problem.square[k] - 2.0 * y @ moment[k] + y @ normal[k] @ y
        freedom = problem.freedom[k] - (posterior.covariance * normal[k]).sum() / result[k] ** 2
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
    hat matrix: exact, and no fit is repeated.
    """
    scale = 1.0 / posterior.noise[problem.kind]
    rows = scale[:, None] * problem.rows[:, posterior.used]
    residual = scale * problem.target - rows @ posterior.y
    half = rows @ np.linalg.cholesky(posterior.covariance)
    order = np.argsort(problem.fold, kind="stable")
    result = np.empty(len(residual))
    for members in np.split(order, np.flatnonzero(np.diff(problem.fold[order])) + 1):
        left_out = np.eye(len(members)) - half[members] @ half[members].T
        result[members] = np.linalg.solve(left_out, residual[members])
    return result


@dataclass(frozen=True)
class Solution:
    """A settled fit.

    Attributes
    ----------
    problem : LinearProblem
        Linearised at the answer.
    posterior : Posterior
        The answer.
    x : ndarray, shape (size,)
        Its parameters, SI.
    residuals, weights : ndarray, shape (N,)
        Of each reading, m or rad; and the trust it got, 0…1.
    steps : int
        Gauss–Newton steps.
    change : float
        Largest change of a parameter in the last one, in its standard deviation.
    """

    problem: LinearProblem
    posterior: Posterior
    x: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    steps: int
    change: float


def iterate(
    estimation: Estimation,
    x: np.ndarray,
    tolerances: np.ndarray,
    noise: np.ndarray,
    progress: Callable[[str], object],
) -> Solution:
    """Run Gauss–Newton steps until the parameters settle.

    Raises
    ------
    CalibrationError
        They do not.
    """
    weights, robust = np.ones(len(estimation.measurements)), estimation.space.settings.robust
    share, last = 1.0, np.inf
    for step in range(1, STEPS + 1):
        problem, residuals = estimation.linearise(x, weights)
        posterior = solve(estimation.space, problem, tolerances, noise)
        tolerances, noise = posterior.tolerances, posterior.noise
        change = _change(estimation.space.physical(posterior.y) - x, estimation.space, posterior)
        progress(f"step {step}: largest change {change:.2g} standard deviations")
        if step > 2 and change > SLOW * last:
            share = max(LEAST_SHARE, 0.5 * share)
        x, last = x + share * (estimation.space.physical(posterior.y) - x), change
        if (change < SETTLED and (step > 2 or not robust)) or step == STEPS:
            break
        if robust and step > 1:
            weights = estimation.robust_weights(residuals)
    if change > 1.0:
        raise CalibrationError("fit", f"did not settle within {STEPS} steps")
    return Solution(problem, posterior, x, residuals, weights, step, change)


def _change(change: np.ndarray, space: ParameterSpace, posterior: Posterior) -> float:
    """Return the largest change of a parameter x in its standard deviation."""
    deviations = np.sqrt(np.diag(physical_covariance(space, posterior)))
    return float((np.abs(change) / deviations).max())


def physical_covariance(space: ParameterSpace, posterior: Posterior) -> np.ndarray:
    """Return the covariance of the parameters x, shape (size, size), SI; all blocks must be in use."""
    return space.physical(space.physical(posterior.covariance).T)
