"""Which change explains check readings best: Gaussian hypotheses weighed by their marginal likelihood.

Under "nothing has changed" the readings are N(0, S), S = J·Σ·Jᵀ + noise. A hypothesis adds scale²·A·Aᵀ. In
coordinates in which S is the identity each one is a few directions with a gain, so that evidence takes a dot product:
that makes it cheap to draw thousands of sets of readings from a machine that has not changed, and to see how strange
these are.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from .changes import PRIOR

DRAWS, SEED = 4000, 11
"""Machines that have not changed, drawn to see what is usual."""

LEAST_GAIN = 1e-9
"""Directions of an effect that are smaller, beside its largest, are rounding."""


@dataclass(frozen=True)
class Hypothesis:
    """A change as readings see it.

    Attributes
    ----------
    family, name : str
        As of a :class:`~.changes.Change`.
    directions : ndarray, shape (n, k)
        Orthonormal, in coordinates in which readings of an unchanged machine are N(0, 1).
    gains : ndarray, shape (k,)
        How large the effect of a coefficient of one is along them.
    scales : ndarray, shape (m,)
        Standard deviations that a coefficient may have.
    coefficients : int
        How many coefficients the change has; those beyond the directions move no reading.
    group : str
        As of a :class:`~.changes.Change`.
    """

    family: str
    name: str
    directions: np.ndarray
    gains: np.ndarray
    scales: np.ndarray
    coefficients: int
    group: str = ""

    @property
    def least_gain(self) -> float:
        """How much the least visible of its coefficients moves the readings, in standard deviations."""
        return float(self.gains.min(initial=np.inf)) if len(self.gains) == self.coefficients else 0.0

    @staticmethod
    def of(family: str, name: str, effect: np.ndarray, scales: tuple[float, ...], group: str = "") -> Hypothesis:
        """Return a hypothesis from its effect (n, k) on whitened readings."""
        if effect.shape[1] == 1:  # most of them: no need to decompose
            gains = np.linalg.norm(effect, axis=0)
            directions = effect / (gains or 1.0)
        else:
            directions, gains, _ = np.linalg.svd(effect, full_matrices=False)
        felt = gains > LEAST_GAIN * max(gains.max(initial=0.0), 1.0)
        return Hypothesis(family, name, directions[:, felt], gains[felt], np.array(scales), effect.shape[1], group)

    def log_ratios(self, z: np.ndarray) -> np.ndarray:
        """Return log evidence over that of no change for whitened readings (N, n), scale by scale: (N, m)."""
        grown = np.outer(self.scales**2, self.gains**2)
        along = (z @ self.directions) ** 2
        return 0.5 * (along @ (grown / (1.0 + grown)).T - np.log1p(grown).sum(axis=1))


class Evidence:
    """Hypotheses against readings.

    Parameters
    ----------
    covariance : ndarray, shape (n, n)
        Of the readings of a machine that has not changed.

    Attributes
    ----------
    hypotheses : list of Hypothesis
        Added by :meth:`add`.
    """

    def __init__(self, covariance: np.ndarray) -> None:
        self._whitening = solve_triangular(np.linalg.cholesky(covariance), np.eye(len(covariance)), lower=True)
        self.hypotheses: list[Hypothesis] = []

    def whitened(self, effect: np.ndarray) -> np.ndarray:
        """Return readings or effects (n, …) in coordinates in which those of an unchanged machine are N(0, 1)."""
        return np.asarray(self._whitening @ effect)

    def add(self, family: str, name: str, effect: np.ndarray, scales: tuple[float, ...], group: str = "") -> None:
        """Add what has an effect (n, k) on readings, for a coefficient of one."""
        self.hypotheses.append(Hypothesis.of(family, name, self.whitened(effect), scales, group))

    def weights(self, readings: np.ndarray) -> list[np.ndarray]:
        """Return the log weight of each hypothesis at each of its scales, (m,), over that of no change.

        Kinds of change have their :data:`~.changes.PRIOR`; the groups of a kind are equally likely, as are the
        hypotheses of a group, and the scales of each.
        """
        return [logs[0] for logs in self.weights_of_each(readings[None])]

    def weights_of_each(self, readings: np.ndarray) -> list[np.ndarray]:
        """Return the same, (N, m), of N sets of readings, shape (N, n)."""
        return self._logs(self.whitened(readings.T).T)

    def probability_unchanged(self, readings: np.ndarray) -> float:
        """Return in which share of checks a machine that has not changed reads as strangely as this, or more so.

        Strange is what some change explains much better: the evidence of all of them together.
        """
        z = np.random.default_rng(SEED).standard_normal((DRAWS, len(readings)))
        usual, here = self._changed(z), self._changed(self.whitened(readings)[None])[0]
        return float((1 + (usual >= here).sum()) / (DRAWS + 1))

    def _changed(self, z: np.ndarray) -> np.ndarray:
        """Return the log evidence of all changes together over that of none, shape (N,)."""
        return np.logaddexp.reduce(np.concatenate(self._logs(z), axis=1), axis=1)

    def _logs(self, z: np.ndarray) -> list[np.ndarray]:
        groups = [(h.family, h.group) for h in self.hypotheses]
        in_kind = Counter(family for family, _ in set(groups))
        share = {g: PRIOR[g[0]] / (sum(PRIOR.values()) * in_kind[g[0]] * groups.count(g)) for g in set(groups)}
        return [
            h.log_ratios(z) + np.log(share[g] / len(h.scales)) for h, g in zip(self.hypotheses, groups, strict=True)
        ]
