"""Scheme ``joint``: structure, struts and field from all readings at once.

Gauss–Newton on the exact machine. Each linear problem is Bayesian: every block of parameters has a prior
whose size is estimated from the data (MacKay's fixed point), as is the noise of every kind of channel. What
an instrument does not know (each run's zero, the slope of its beam, where a length starts from) is projected out
beforehand, so it costs no parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..errors import CalibrationError, KinematicsError, ModelError
from ..measurements.readings import KINDS, LEAST_NOISE, MeasurementSet, refuse_absurd
from .cell_rows import Alike, CellRows, at_once
from .cells import Cells
from .linear_problem import Condensed, LinearProblem, Posterior, condense, held_out, physical_covariance, solve
from .parameters import ParameterSpace
from .sensitivity import Prediction, Slopes, predict
from .unknowns import Unknown, of_zero

STEPS = 20
"""Most Gauss–Newton steps; a handful is enough for deviations of a tenth of a millimetre."""

SLOW, LEAST_SHARE = 0.7, 0.3
"""A step whose change is not below so much of the last one's is shortened by half, to this share at least:
tolerances and parameters that wait for each other could otherwise swing for ever."""

SETTLED = 1e-2
"""The fit stops when no parameter moves by more than this share of its standard deviation."""

HUBER = 2.5
"""Residuals beyond so many standard deviations lose weight in proportion."""

MEDIAN_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""

CHUNK = 512
"""Cells whose derivatives are worked out together: a processor's cache holds them."""

ROUNDING = 1e-12
"""A direction whose component is below this does not have it: frames turned by right angles are right to rounding."""

OUTLIER = 5.0
"""Residuals beyond so many standard deviations are listed."""


class _Group(NamedTuple):
    """Cells of one kind whose errors have the same components; those of a run, and of an unknown, stand together."""

    kind: int
    components: np.ndarray
    cells: np.ndarray


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
        Readings that no machine's error can have, or fewer than unknowns: nothing would be determined.
    """

    def __init__(self, measurements: MeasurementSet, space: ParameterSpace, alone: bool = True) -> None:
        refuse_absurd(measurements)
        self.measurements, self.space = measurements, space
        self.cells = Cells.of(measurements)
        self.uncertainty = measurements.stated
        self._zeros, self._lengths = self.cells.groups(measurements)
        self._components = np.abs(self.cells.directions) > ROUNDING
        for lengths in self._lengths:
            self._components[lengths.members, :3] = True  # their directions change with the answer
        self._groups = self._group_alike()
        needed = len(space.blocks[0].labels)
        free = len(self.cells.station) - len(self._zeros) - sum(along is not None for _, along in self._zeros)
        free -= sum(lengths.count for lengths in self._lengths)
        if alone and free < needed:
            problem = f"{len(measurements)} readings at {len(self.cells.station)} distinct places leave {free} "
            raise CalibrationError("measurements", problem + f"numbers for the structure's {needed} parameters")

    def linearise(
        self, x: np.ndarray, reading_weights: np.ndarray, prediction: Prediction | None = None
    ) -> tuple[LinearProblem, np.ndarray]:
        """Return the linear problem at a parameter vector, and each reading's residual there, m or rad.

        Parameters
        ----------
        x : ndarray, shape (size,)
            Parameters, SI.
        reading_weights : ndarray, shape (N,)
            Trust in each reading, 0…1.
        prediction : Prediction, optional
            What the machine of these parameters does, if that is known.

        Raises
        ------
        CalibrationError
            No machine is like that, or it cannot take one of the poses.
        """
        c, m = self.cells, self.measurements
        weights = reading_weights / self.uncertainty**2
        total = np.bincount(c.of_reading, weights)
        scale = np.sqrt(total)
        values = np.bincount(c.of_reading, weights * m.value) / total
        prediction, directions = prediction or self._predicted(x), c.directions.copy()
        expected, unknowns = self._unknowns(directions, prediction.errors[c.station], values, scale)
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
        # Huber's proposal 2: noise comes from the residuals cut off, weight² · residual², or outliers blow it up.
        beyond = np.bincount(m.kind, weights * (1.0 - reading_weights) * residuals**2, len(KINDS))
        problem = self._problem(target + moved, rows, scatter - beyond, unknowns)
        return replace(problem, per_length=per_length, unknowns=tuple(unknowns)), residuals

    def _rows(self, x: np.ndarray, prediction: Prediction, directions: np.ndarray) -> tuple[CellRows, np.ndarray]:
        """Return each cell's derivatives by y, and what all parameters do together, (C,).

        Along directions (C, 6), over the standard deviations of the cells' values.
        """
        c, space, moved = self.cells, self.space, np.empty(len(self.cells.station))
        slopes, y = Slopes(space, prediction, self.measurements.stations, whitened=True), space.whitened_parameters(x)

        def rows_of(group: _Group) -> Alike:
            columns = slopes.columns(group.components)
            rows = np.empty((len(group.cells), len(columns)))
            for first in range(0, len(rows), CHUNK):
                part, cells = rows[first : first + CHUNK], group.cells[first : first + CHUNK]
                slopes.write(part, columns, c.station[cells], directions[cells], group.components)
                moved[cells] = part @ y[columns]
            return Alike(group.cells, columns, rows)

        return CellRows((len(moved), space.size), at_once(rows_of, self._groups)), moved

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

    def _predicted(self, x: np.ndarray) -> Prediction:
        """Return what the machine of a parameter vector does.

        Raises
        ------
        CalibrationError
            No machine is like that, or it cannot take one of the poses.
        """
        try:
            return predict(self.space, x, self.measurements.stations)
        except (ModelError, KinematicsError) as error:
            hint = "do units, directions and commanded poses fit, and are all blocks allowed?"
            problem = f"left the machines that can be ({error}); {hint}"
            raise CalibrationError("fit", problem) from error

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
        self, target: np.ndarray, rows: CellRows, scatter: np.ndarray, unknowns: list[Unknown]
    ) -> LinearProblem:
        """Gather the sums that everything later needs."""
        kind, size, kinds = self.cells.kind, self.space.size, len(KINDS)
        normal, moment, square = np.zeros((kinds, size, size)), np.zeros((kinds, size)), scatter.copy()
        freedom = np.bincount(self.measurements.kind, minlength=kinds).astype(float)
        for part in unknowns:
            freedom[kind[part.members[0]]] -= part.share.sum()
        products = at_once(lambda part: part.values.T @ part.values, rows.parts)
        for group, (_, columns, values), product in zip(self._groups, rows.parts, products, strict=True):
            normal[group.kind][np.ix_(columns, columns)] += product
            moment[group.kind][columns] += target[group.cells] @ values
            square[group.kind] += target[group.cells] @ target[group.cells]
        least_noise = LEAST_NOISE / np.array([self.measurements.stated_of(k) for k in range(kinds)])
        return LinearProblem(target, rows, kind, self.cells.fold, normal, moment, square, freedom, least_noise)

    def _group_alike(self) -> list[_Group]:
        """Return the cells in groups of one kind whose errors have the same components."""
        c = self.cells
        for members in [members for members, _ in self._zeros] + [lengths.members for lengths in self._lengths]:
            self._components[members] |= self._components[members].any(axis=0)
        key = c.kind * 64 + self._components @ (1 << np.arange(6))
        order = np.lexsort((c.group, self.measurements.run[c.first], key))
        return [
            _Group(int(c.kind[cells[0]]), np.flatnonzero(self._components[cells[0]]), cells)
            for cells in np.split(order, np.flatnonzero(np.diff(key[order])) + 1)
        ]

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

    @cached_property
    def condensed(self) -> Condensed:
        """The cells in as few rows as the parameters in use can be told by."""
        return condense(self.problem, self.posterior)

    @cached_property
    def held_out(self) -> np.ndarray:
        """Errors, in standard deviations, at cells whose fold a fit does not see, shape (C,)."""
        return held_out(self.problem, self.condensed, self.posterior)


def iterate(
    estimation: Estimation,
    x: np.ndarray,
    tolerances: np.ndarray,
    noise: np.ndarray,
    progress: Callable[[str], object],
) -> Solution:
    """Run Gauss–Newton steps until the parameters settle, from the nominal machine or from an answer.

    Raises
    ------
    CalibrationError
        They do not.
    """
    weights, robust = np.ones(len(estimation.measurements)), estimation.space.settings.robust
    share, last = 1.0, np.inf
    all_alike = 0 if x.any() else 1  # steps whose residuals are the machine's errors: they weigh no reading
    for step in range(1, STEPS + 1):
        problem, residuals = estimation.linearise(x, weights)
        posterior = solve(estimation.space, problem, tolerances, noise)
        tolerances, noise = posterior.tolerances, posterior.noise
        change, block = _change(estimation.space.physical(posterior.y) - x, estimation.space, posterior)
        progress(f"step {step}: largest change {change:.2g} standard deviations")
        if step > all_alike + (2 if robust else 1) and change > SLOW * last:  # the first with weights may change more
            share = max(LEAST_SHARE, 0.5 * share)
        x, last = x + share * (estimation.space.physical(posterior.y) - x), change
        if (change < SETTLED and (step > all_alike + 1 or not robust)) or step == STEPS:
            break
        if robust and step > all_alike:
            weights = estimation.robust_weights(residuals)
    if change > 1.0:
        moving = f"did not settle within {STEPS} steps: {block} still changes by {change:.2g} standard deviations"
        raise CalibrationError("fit", f"{moving}; are all blocks allowed, and is it measured in enough places?")
    return Solution(problem, posterior, x, residuals, weights, step, change)


def _change(change: np.ndarray, space: ParameterSpace, posterior: Posterior) -> tuple[float, str]:
    """Return the largest change of a parameter x in its standard deviation, and the block that it belongs to."""
    deviations = np.sqrt(np.diag(physical_covariance(space, posterior)))
    sizes = np.abs(change) / deviations
    block = max(space.blocks, key=lambda block: sizes[block.part].max())
    return float(sizes[block.part].max()), block.name
