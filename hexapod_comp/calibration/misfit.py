"""What readings show that no parameter describes, and by how much it widens what a fit promises.

A covariance of parameters is right if the model is. Three things are looked for that break it. Whole lines and whole
families of lines are left out: the tool error that this makes, beside the one that the covariance expects, says how far
what is left differs from line to line rather than from reading to reading. What is left beyond the instruments' noise
is taken for an error of the machine that no parameter describes. And a scale that drifts while the readings are taken
is fitted to what is left. The scale of an instrument, which no reading shows, is stated.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtrtrs

from ..measurements.readings import ANGULAR_KINDS, AXES, BACKWARD, FORWARD, KINDS, MeasurementSet
from .estimator import DesignMatrix, at_once, whitened_precision
from .mixups import FAMILIES, family_of_run
from .parameters import FitSettings
from .promise import Unexplained
from .residuals import Residuals
from .scatter import scatter

CHANCE = 2.88
"""Standard deviations of a normal distribution beyond which two of a thousand lie: so rarely readings that the model
describes look misfitted by chance, in each way of leaving some out."""

CLEAR_DRIFT = 3.0
"""A drift of the scale is one from so many standard deviations on."""

PLACE = 1e-3
"""Lines whose middles are closer, m, lie in one plane across an axis."""

QUARTERS = 4
"""Parts, in the order of the readings, that are left out in turn."""

SCALES = {"linear": 0.5e-6, "length": 0.5e-6, "position": 10e-6}
"""Standard deviation of the scale of an instrument of each class, m/m: an interferometer whose air is compensated;
a ball bar or a station that is calibrated as well; a tracker or cameras."""

ALIGNMENT = 0.5e-3
"""Standard deviation of the angle between a laser's beam and its line, rad: a beam set up over half a metre."""

HELD = 0.5
"""A promise of which more than this share comes from the priors is none."""

LINE = "line"
ALL = (
    LINE,
    "family of lines",
    *(f"plane across {axis}" for axis in AXES),
    "direction",
    "quarter of the time",
    "channel",
)
"""What is left out in turn."""

GENERAL, FINE_TERMS = ("map", "backlash map", "field displacement", "field rotation", "field reversal"), 0.3
"""Blocks of coarse and fine terms; and how well the size of the fine ones is known by that of the coarse, as the
standard deviation of its logarithm."""

CUT = 4.0
"""Residuals count for no more standard deviations than that: a gross error is a single reading's."""

LEAST_FREE = 3.0
"""A χ² is given for more degrees of freedom only."""

LEAST_RUNS = 6
"""A drift is looked for in so many runs of a linear laser, or more."""

NEGLIGIBLE = 1e-4
"""Effects on the tool that together are below this share of its squared error cannot matter, whatever is left out."""


def unexplained(
    residuals: Residuals, scale: float, everything: Callable[[], tuple[Residuals, np.ndarray]]
) -> Unexplained:
    """Return what a settled fit leaves unexplained.

    Parameters
    ----------
    residuals : Residuals
        Of the fit.
    scale : float
        Stated standard deviation of the scale of all readings, m/m.
    everything : callable
        Returns the residuals with all blocks in, and by how much the parameters y in use differ from the fit's.
    """
    factor, without, allowed = _left_out(residuals, everything)
    prior, prior_of_rotation = (_of_priors(residuals, m) for m in (residuals.metric, residuals.metric_of_rotation))
    displacement, rotation = scatter(residuals)
    return Unexplained(
        factor=factor,
        without=without,
        allowed=allowed,
        prior=prior,
        prior_rotation=prior_of_rotation,
        displacement=displacement,
        rotation=rotation,
        drift=_drift(residuals),
        scale=scale,
    )


def _of_priors(r: Residuals, metric: np.ndarray) -> float:
    """Return how well the logarithm of a tool error to expect is known, as the sizes of priors are estimates.

    A size that n parameters determine is known to 1/√(2n) of itself, and moves the squared error by its prior's share
    of it: with C = (N + T⁻²)⁻¹, tr(M·C·T⁻²·C)/tr(M·C). Of a length map or a field, coarse terms determine the size and
    fine ones are taken to be in proportion.
    """
    posterior = r.solution.posterior
    expected = float(np.vdot(metric, posterior.covariance))
    if not expected > 0.0:
        return 0.0
    held = np.einsum("ij,ji->i", posterior.covariance @ metric, posterior.covariance) / posterior.spread**2
    variance = 0.0
    for block in r.estimation.space.blocks:
        members = (posterior.used >= block.part.start) & (posterior.used < block.part.stop)
        share = held[members].sum() / expected
        variance += 0.5 * share**2 / max(posterior.determined[members].sum(), 1.0)
        variance += (share * FINE_TERMS) ** 2 if block.name in GENERAL else 0.0
    return float(np.sqrt(variance))


def stated_scale(measurements: MeasurementSet, settings: FitSettings) -> float:
    """Return the standard deviation of the scale of all readings, m/m, as stated or as their instruments' class has it.

    The best instrument for lengths counts. A beam that is off its line by an angle θ reads θ²/2 too little.
    """
    kinds = {KINDS[k] for k in np.unique(measurements.kind)}
    known = [value for kind, value in SCALES.items() if kind in kinds]
    scale = settings.scale if settings.scale is not None else min(known, default=0.0)
    angle = settings.alignment if settings.alignment is not None else ALIGNMENT
    return float(np.hypot(scale, 0.5 * angle**2 if "linear" in kinds else 0.0))


def held_by_priors(residuals: Residuals) -> bool:
    """Return whether what a fit expects of the tool comes from the priors rather than from the readings."""
    r, metric = residuals, residuals.metric
    if not metric.any():
        return False
    posterior = r.solution.posterior
    spread = r.estimation.space.spread(posterior.tolerances)[posterior.used]
    prior, left = (np.sqrt(np.trace(metric @ part)) for part in (np.diag(spread**2), posterior.covariance))
    noise = r.estimation.uncertainty * posterior.noise[r.estimation.measurements.kind]
    lengths = ~np.isin(r.estimation.measurements.kind, [KINDS.index(kind) for kind in ANGULAR_KINDS])
    return bool(left > HELD * prior and (not lengths.any() or left > np.median(noise[lengths])))


def _left_out(r: Residuals, everything: Callable[[], tuple[Residuals, np.ndarray]]) -> tuple[float, str, float]:
    """Return the largest factor on standard deviations that leaving something out shows, what that was, and `allowed`.

    Without one line the others still stand about it. Without a family, a plane or a channel the model is left to
    itself, and with fewer blocks than the machine has it is too sure: then no more is unexplained than all blocks
    together leave possible.
    """
    factors = _factors(r, ALL)
    allowed, far = factors.get(LINE, 1.0), factors.keys() - {LINE}
    if far:
        wide, shift = everything()
        beyond = _factors(wide, far)
        possible = np.sqrt((wide.expected + shift @ wide.metric @ shift) / r.expected)
        for what in far:
            factors[what] = min(factors[what], float(possible) * beyond.get(what, 1.0))
        allowed = max(allowed, *beyond.values(), 1.0)
    without = max(factors, key=lambda what: factors[what], default="")
    return (factors[without], without, allowed) if factors.get(without, 0.0) > 1.0 else (1.0, "", allowed)


def _factors(r: Residuals, wanted: Container[str]) -> dict[str, float]:
    """Return what changes the tool too much when it is left out, with the factor on standard deviations."""
    leaving = _Leaving(r)
    factors = {}
    for what, groups in _groupings(r).items():
        if what in wanted and len(np.unique(groups)) > 1:  # not everything at once
            ratio, limit = _excess(*np.transpose(leaving.changes(groups)))
            if ratio > max(limit, 1.0):
                factors[what] = float(np.sqrt(ratio))
    return factors


class _Leaving:
    """What the tool's error becomes where some cells are left out of a fit.

    With group g left out the parameters change by δ, whose covariance is C₋g − C if the model is right. M turns both
    into the tool's mean squared error in the measured box; M = F·Fᵀ, F without what no prior lets happen.
    """

    def __init__(self, residuals: Residuals) -> None:
        self._residuals, self._posterior = residuals, residuals.solution.posterior
        problem, self._spread = residuals.solution.problem, self._posterior.spread
        self._precision = whitened_precision(problem, self._posterior)
        values, vectors = np.linalg.eigh(self._spread[:, None] * residuals.metric * self._spread)
        unheeded = NEGLIGIBLE * residuals.expected
        kept = np.cumsum(values) > unheeded  # ascending
        self._effects = vectors[:, kept] * np.sqrt(np.maximum(values[kept], 0.0))
        self._reached = self._posterior.covariance @ (self._effects / self._spread[:, None])  # C·F
        self._expected = (self._effects / self._spread[:, None]).T @ self._reached
        few = self._few = residuals.solution.condensed
        scale = 1.0 / self._posterior.noise[problem.kind[few.cell]]
        self._rows = few.rows.using(self._posterior.used, scale)
        self._left = scale * few.target - self._rows.times(self._posterior.y)

    def changes(self, groups: np.ndarray) -> list[tuple[float, float, float]]:
        """Return what leaving out each group of cells does; by condensed rows, unless folds are divided."""
        rows, left = self._rows, self._left
        if (groups == groups[self._few.first]).all():
            groups = groups[self._few.cell]
        else:
            rows, left = self._residuals.rows, self._residuals.residual
        members = (np.flatnonzero(groups == group) for group in np.unique(groups))
        return at_once(lambda chosen: self._change(rows.select(chosen), left[chosen]), members)

    def _change(self, rows: DesignMatrix, left: np.ndarray) -> tuple[float, float, float]:
        """Return the squared change that leaving rows out makes, what it should be, and its degrees of freedom.

        With R and r the rows and their residuals, C₋g = (P − Rᵀ·R)⁻¹ = C + C·Rᵀ·(1 − R·C·Rᵀ)⁻¹·R·C: a matrix of the
        parameters' size, or of the rows', where they are few. Half of either side is enough.
        """
        if 2 * len(left) < len(self._spread):
            matrix = np.eye(len(left)) - rows.times(rows.times(self._posterior.covariance).T)
            sides, before = (rows.times(self._reached), left), 0.0
        else:
            matrix = self._precision - self._spread[:, None] * rows.normal() * self._spread
            sides, before = (self._effects, self._spread * rows.transposed_times(left)), self._expected
        factor = np.linalg.cholesky(matrix)
        half, moment = (dtrtrs(factor, side, lower=1)[0] for side in sides)
        spread, moved = half.T @ half - before, half.T @ moment
        expected = float(np.trace(spread))
        return float(moved @ moved), expected, expected**2 / float(np.vdot(spread, spread))


def _groupings(r: Residuals) -> dict[str, np.ndarray]:
    """Return which cells are left out together, by name: a number for each cell."""
    groupings = {LINE: r.run} | {what: groups[r.run] for what, groups in _groupings_of_runs(r).items()}
    groupings["direction"] = r.direction
    groupings["quarter of the time"] = np.floor((r.rank + 0.5) * (QUARTERS - 1e-9))
    return groupings | {"channel": r.estimation.cells.kind}


def _excess(shown: np.ndarray, expected: np.ndarray, freedom: np.ndarray) -> tuple[float, float]:
    """Return how many times as large squared changes are as expected, and how many times they may be by chance.

    By Satterthwaite, the sum is about a χ² of as many degrees of freedom as its variance says, and the cube root of
    that is about normal, by Wilson and Hilferty.
    """
    if not expected.sum() > 0.0:
        return 0.0, np.inf
    all_freedom = expected.sum() ** 2 / (expected**2 / freedom).sum()
    width = 2.0 / (9.0 * all_freedom)
    return float(shown.sum() / expected.sum()), float((1.0 - width + CHANCE * np.sqrt(width)) ** 3)


def _groupings_of_runs(r: Residuals) -> dict[str, np.ndarray]:
    """Return which runs are left out together, by name: a number for each run."""
    m = r.estimation.measurements
    family = family_of_run(m)
    places = m.geometry.tool_poses(m.stations.positions, m.stations.rotations)[0][r.estimation.cells.station]
    count = np.maximum(np.bincount(r.run, minlength=len(m.runs)), 1)
    groups = {"family of lines": family}
    for axis, name in enumerate(AXES):
        middle = np.bincount(r.run, places[:, axis], len(m.runs)) / count
        across = (family < 3) & (family != axis)
        groups[f"plane across {name}"] = np.where(across, np.round(middle / PLACE), np.inf)
    return groups


def _drift(r: Residuals) -> float:
    """Return by how much the scale of the readings changes from the first to the last one, m/m; 0 if it does not."""
    estimation, solution = r.estimation, r.solution
    cells, linear = estimation.cells, estimation.cells.kind == KINDS.index("linear")
    if not linear.any() or len(np.unique(r.run[linear])) < LEAST_RUNS:
        return 0.0
    column = estimation.free_of_nuisance(np.where(linear, cells.along * r.rank, 0.0)[:, None])[:, 0]
    column /= solution.posterior.noise[cells.kind]
    free = column - r.rows.times(solution.posterior.covariance @ r.rows.transposed_times(column))
    information = float(column @ free)
    if information <= 0.0:
        return 0.0
    size = float(free @ np.clip(r.residual, -CUT, CUT)) / information
    return abs(size) if abs(size) * np.sqrt(information) > CLEAR_DRIFT else 0.0


@dataclass(frozen=True)
class ChiSquare:
    """How one part of the readings was met.

    Attributes
    ----------
    kind : str
        Of :data:`~hexapod_comp.measurements.readings.KINDS`.
    part : str
        A family of lines, a direction, or a run's name.
    readings : int
        How many.
    value : float
        Squared residuals over the stated variance, per degree of freedom.
    """

    kind: str
    part: str
    readings: int
    value: float


def chi_squares(r: Residuals) -> tuple[tuple[ChiSquare, ...], tuple[ChiSquare, ...]]:
    """Return χ² by kind of channel for families of lines and for directions, and run by run, the worst first."""
    m, solution, of_reading = r.estimation.measurements, r.solution, r.estimation.cells.of_reading
    freedom = 1.0 - (r.taken / np.bincount(of_reading))[of_reading]
    squares = (solution.weights * solution.residuals / r.estimation.uncertainty) ** 2
    family, runs = family_of_run(m), [run.name for run in m.runs]
    ways = {FORWARD: "forward", BACKWARD: "backward"}
    groups = (
        (family[m.run], dict(enumerate(FAMILIES))),
        (m.direction, ways),
        (m.run, dict(enumerate(runs))),
    )
    parts: list[list[ChiSquare]] = []
    for numbers, names in groups:
        parts.append([])
        for k in np.unique(m.kind):
            for number, name in names.items():
                members = (m.kind == k) & (numbers == number)
                if freedom[members].sum() > LEAST_FREE:
                    value = float(squares[members].sum() / freedom[members].sum())
                    parts[-1].append(ChiSquare(KINDS[k], name, int(members.sum()), value))
    of_runs = sorted(parts[2], key=lambda part: -part.value)
    return (*parts[0], *parts[1]), tuple(of_runs)
