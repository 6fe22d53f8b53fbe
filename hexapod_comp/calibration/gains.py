"""What each of many runs would take off the tool error to expect.

In parameters z of unit prior, the readings A of a run, whitened, turn the covariance C into C − CAᵀ(I + ACAᵀ)⁻¹AC. The
mean square of the tool's error at some poses is tr(M·C), with M the mean of JᵀJ there, the datum taken out of J. So a
run's gain is tr((I + ACAᵀ)⁻¹ · AC·M·CAᵀ), and only A·C has to be kept up to date.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from ..errors import CalibrationError
from ..measurements.campaign import Campaign
from ..measurements.readings import KINDS, MeasurementSet
from .estimator import Estimation
from .parameters import ParameterSpace
from .plan import noise_factor
from .posterior import POINTS, box_errors

STRENGTH = 0.05
"""Directions that a run's readings see by less than so many standard deviations of their prior are left out of it."""

FAINT = 1e-9
"""Directions that add less than this share of the largest to the tool's mean square error are left out."""

LEAST_REACHED = 0.3
"""Share of the box in which the tool must tilt as far as wanted, for an error there to mean anything."""


class Aim:
    """What the tool error is judged by, in parameters of unit prior.

    Parameters
    ----------
    space : ParameterSpace
        With its box.
    tilt : float
        Largest tilt, rad.
    stops : float
        How far the tool stops beside its usual place, RMS over all three axes, m: no model takes that away.

    Raises
    ------
    CalibrationError
        No pose of the box with that tilt is within the limits.
    """

    def __init__(self, space: ParameterSpace, tilt: float, stops: float = 0.0) -> None:
        self.stops = stops
        self.parts = {"level": _square(space, 0.0)} | ({"tilted": _square(space, tilt)} if tilt > 0.0 else {})
        self.square = np.mean(list(self.parts.values()), axis=0)
        values, vectors = np.linalg.eigh(self.square)
        kept = values > FAINT * values[-1]
        self.root = vectors[:, kept] * np.sqrt(values[kept])

    def errors(self, covariance: np.ndarray) -> dict[str, float]:
        """Return the RMS tool error that a covariance leaves, level and tilted, m."""
        squares = {name: (square * covariance).sum() + self.stops**2 for name, square in self.parts.items()}
        return {name: float(np.sqrt(square)) for name, square in squares.items()}


def _square(space: ParameterSpace, tilt: float) -> np.ndarray:
    """Return M, shape (size, size), m²: the mean square tool error with the datum aligned is tr(M·C)."""
    errors = box_errors(space, np.zeros(space.size), tilt)
    reached = 0.0 if errors is None else len(errors.places) / (2.0 * POINTS)
    if errors is None or reached < LEAST_REACHED:
        problem = f"{np.degrees(tilt):g}° is within the limits at {100.0 * reached:.0f} % of the box only"
        raise CalibrationError("tilt", f"{problem}, {100.0 * LEAST_REACHED:g} % are needed")
    spread = space.spread(space.start_tolerances())
    return spread[:, None] * space.whitened(space.whitened(errors.mean_squares()[0]).T) * spread


def seen_by(space: ParameterSpace, campaign: Campaign, measured: MeasurementSet) -> list[np.ndarray]:
    """Return what each run of a campaign sees: A, shape (k, size), its rows whitened, in parameters of unit prior.

    Parameters
    ----------
    space : ParameterSpace
        The parameters.
    campaign : Campaign
        Tells the instruments' noise.
    measured : MeasurementSet
        Its template, or a part of that.
    """
    estimation = Estimation(measured, space, alone=False)
    problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(measured)))
    noise = np.array([noise_factor(campaign, kind) for kind in KINDS])
    rows = problem.rows.dense() * space.spread(space.start_tolerances()) / noise[problem.kind][:, None]
    run_of_station = np.empty(len(measured.stations), dtype=int)
    run_of_station[measured.station] = measured.run
    run = run_of_station[estimation.cells.station]
    return [_compressed(rows[run == n]) for n in range(len(measured.runs))]


def _compressed(rows: np.ndarray) -> np.ndarray:
    """Return fewer rows that say the same: what is weaker than :data:`STRENGTH` is left out."""
    values, vectors = np.linalg.eigh(rows @ rows.T)
    kept = values > STRENGTH**2
    return np.asarray(vectors[:, kept].T @ rows)


class Selection:
    """Candidates, what of the machine is known so far, and what each would add.

    All is kept in the directions of the parameters that the candidates see at all; the others stay as they are.

    Parameters
    ----------
    seen : list of ndarray, shape (k, size)
        Rows of each candidate.
    aim : Aim
        What counts.
    """

    def __init__(self, seen: list[np.ndarray], aim: Aim) -> None:
        self.aim = aim
        edges = np.cumsum([0, *(len(rows) for rows in seen)])
        self.parts = [slice(*pair) for pair in pairwise(edges)]
        rows = np.concatenate(seen)
        values, vectors = np.linalg.eigh(rows.T @ rows)
        self.basis = vectors[:, values > STRENGTH**2]
        self.root = self.basis.T @ aim.root
        self.rows = rows @ self.basis
        self.inner = np.eye(self.basis.shape[1])
        self.known = self.rows.copy()  # A·C
        self.shown = self.rows @ self.root  # A·C·√M
        self.grams = [self.rows[part] @ self.rows[part].T for part in self.parts]  # A·C·Aᵀ

    @property
    def covariance(self) -> np.ndarray:
        """C, shape (size, size)."""
        return self._whole(self.inner)

    def _whole(self, inner: np.ndarray) -> np.ndarray:
        size = len(inner)
        return np.asarray(np.eye(len(self.basis)) + self.basis @ (inner - np.eye(size)) @ self.basis.T)

    def errors(self) -> dict[str, float]:
        """Return the RMS tool error left, level and tilted, m."""
        return self.aim.errors(self.covariance)

    def gains(self) -> np.ndarray:
        """Return by how much each candidate lowers the mean square error, m²."""
        gains = np.zeros(len(self.parts))
        for n, (part, gram) in enumerate(zip(self.parts, self.grams, strict=True)):
            if len(gram):
                half = solve_triangular(cholesky(np.eye(len(gram)) + gram, lower=True), self.shown[part], lower=True)
                gains[n] = (half * half).sum()
        return gains

    def take(self, n: int) -> None:
        """Take a candidate's readings in."""
        root = cholesky(np.eye(len(self.grams[n])) + self.grams[n], lower=True)
        step = solve_triangular(root, self.known[self.parts[n]], lower=True)
        self.inner -= step.T @ step
        along = self.rows @ step.T
        self.known -= along @ step
        self.shown -= along @ (step @ self.root)
        for gram, part in zip(self.grams, self.parts, strict=True):
            gram -= along[part] @ along[part].T

    def after_all(self, times: float = 1.0) -> dict[str, float]:
        """Return the RMS tool error after all candidates, each so many times, level and tilted, m."""
        size = np.eye(self.basis.shape[1])
        return self.aim.errors(self._whole(cho_solve(cho_factor(size + times * self.rows.T @ self.rows), size)))
