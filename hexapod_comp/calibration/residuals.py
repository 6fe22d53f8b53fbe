"""What is left of the readings at a settled fit, cell by cell, and what it says of the tool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .estimator import DesignMatrix, Estimation, Solution
from .posterior import box_errors


@dataclass(frozen=True)
class Residuals:
    """A settled fit's residuals, cell by cell, in standard deviations at the noise that was estimated.

    Attributes
    ----------
    estimation, solution : Estimation, Solution
        The fit.
    rows : DesignMatrix, shape (C, n)
        Derivatives by the parameters in use.
    residual : ndarray, shape (C,)
        What is left.
    run, direction : ndarray of int, shape (C,)
        Of each cell.
    rank : ndarray, shape (C,)
        Place in the order of the readings, −½…½.
    """

    estimation: Estimation
    solution: Solution
    rows: DesignMatrix
    residual: np.ndarray
    run: np.ndarray
    direction: np.ndarray
    rank: np.ndarray

    @staticmethod
    def of(estimation: Estimation, solution: Solution) -> Residuals:
        """Return those of a fit."""
        problem, posterior, cells = solution.problem, solution.posterior, estimation.cells
        scale = 1.0 / posterior.noise[problem.kind]
        rows = problem.rows.using(posterior.used, scale)
        m = estimation.measurements
        order = np.argsort(np.argsort(cells.first))
        return Residuals(
            estimation=estimation,
            solution=solution,
            rows=rows,
            residual=scale * problem.target - rows.times(posterior.y),
            run=m.run[cells.first],
            direction=m.direction[cells.first],
            rank=order / max(len(order) - 1, 1) - 0.5,
        )

    @cached_property
    def taken(self) -> np.ndarray:
        """Share of each cell that parameters and unknowns of the instruments take up, shape (C,)."""
        every = np.arange(len(self.residual))
        return self.shared(every, every) + self.estimation.shares_of_nuisance()

    @property
    def metric(self) -> np.ndarray:
        """M: yᵀ·M·y is the tool's mean squared error in the box, the datum aligned, of parameters y in use; or zero."""
        return self._metrics[0]

    @property
    def metric_of_rotation(self) -> np.ndarray:
        """The same of the tool's mean squared rotation, the mean one taken out."""
        return self._metrics[1]

    @cached_property
    def _metrics(self) -> tuple[np.ndarray, np.ndarray]:
        space, used = self.estimation.space, self.solution.posterior.used
        errors = box_errors(space, self.solution.x)
        if errors is None:
            return np.zeros((len(used),) * 2), np.zeros((len(used),) * 2)
        displacement, rotation = (space.whitened(space.whitened(m).T) for m in errors.mean_squares())
        return displacement[np.ix_(used, used)], rotation[np.ix_(used, used)]

    @property
    def expected(self) -> float:
        """Mean squared error of the tool to expect by the covariance, m²."""
        return float(np.vdot(self.metric, self.solution.posterior.covariance))

    def shared(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return by how much fitting makes cells unlike each other, pair by pair: what both give to the parameters."""
        return self.rows.between(self.solution.posterior.covariance, first, second)
