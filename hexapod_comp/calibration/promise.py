"""The predicted interval of a fit's tool error, by its covariance, widened by unexplained errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from ..machine.arrays import rms
from .assumptions import ASSUMED

TWICE = 2.0
"""The ends of an interval, in standard deviations."""

STEEL = 11.5e-6
"""Expansion of steel, 1/K."""


class Scatter(NamedTuple):
    """Tool error that no parameter describes, RMS over all three axes: displacement, m, or rotation, rad."""

    lack: float = 0.0  # of an error that no parameter describes: the discrepancy
    stops: float = 0.0  # of the stops from visit to visit, by repeats, if the instruments scatter as stated
    most_stops: float = 0.0  # its upper bound

    def beside(self, other: float) -> Scatter:
        """Return the same with another scatter from visit to visit, of a known standard deviation."""
        stops, most = (float(np.hypot(*pair)) for pair in ((self.stops, other), (self.most_stops, TWICE * other)))
        return self._replace(stops=stops, most_stops=most)


NO_SCATTER = Scatter()


class Promise(NamedTuple):
    """Expected RMS error of the tool, and its interval of 95 %: m, or rad."""

    after: float
    low: float
    high: float


@dataclass(frozen=True)
class Unexplained:
    """Contributions that widen an interval."""

    factor: float = 1.0  # factor on the standard deviations of all parameters, shown by leaving out runs in turn
    believed: float = np.inf  # degrees of freedom of the covariance's scale
    prior: float = 0.0  # standard deviation of the logarithm of the expected tool error: priors' sizes are estimates
    prior_rotation: float = 0.0  # the same of the tool's rotation
    displacement: Scatter = NO_SCATTER  # tool error that no parameter describes
    rotation: Scatter = NO_SCATTER
    drift: float = 0.0  # change of the scale from the first to the last reading, m/m; 0 where none is in the fit
    drift_error: float = 0.0  # its standard deviation
    scale: float = 0.0  # stated standard deviation of the scale of all readings, m/m
    ratio: float = 1.0  # ratio of the tool's squared changes to the expected ones, as runs are left out in turn
    freedom: float = 0.0  # degrees of freedom of that
    averaged: float = 1.0  # factor on the tool's error, by averaging over the presence of blocks

    def beside(self, displacement: float, rotation: float) -> Unexplained:
        """Return the same with a scatter from visit to visit of the tool, RMS, m and rad."""
        parts = self.displacement.beside(displacement), self.rotation.beside(rotation)
        return replace(self, displacement=parts[0], rotation=parts[1])

    def promised(self, left: np.ndarray, points: np.ndarray) -> Promise:
        """Return the predicted interval of the tool's displacement; unexplained errors raise the upper end.

        `left`, (D,), are RMS errors of draws by the fit's covariance, m; a scale acts on distances of `points` (n, 3).
        """
        after, low, high = self._interval(left, self.prior, self.displacement)
        radius = rms(np.linalg.norm(points - points.mean(axis=0), axis=1))
        off = radius**2 * (self.scale**2 + 0.25 * (self.drift**2 + self.drift_error**2))
        return Promise(float(np.sqrt(after**2 + off)), low, float(np.sqrt(high**2 + TWICE**2 * off)))

    def promised_rotation(self, left: np.ndarray) -> Promise:
        """Return the predicted interval of the tool's rotation, from draws as for :meth:`promised`, rad."""
        return self._interval(left, self.prior_rotation, self.rotation)

    def _interval(self, left: np.ndarray, prior: float, scatter: Scatter) -> Promise:
        """Return the predicted interval without any error of scale.

        Draws are multivariate t's: the variance's scale has an inverse χ² prior about 1 with `believed` degrees of
        freedom, which the runs' own degrees of freedom can outweigh. A ratio below 1 does not reduce it: crossing lines
        predict a line better than the space between lines. Whether the machine or its instrument scatters more than
        stated is unknown: the lower end omits the scatter.
        """
        size, (low, high) = rms(left), np.percentile(left, [2.5, 97.5])
        scaled = left
        if np.isfinite(self.believed):
            places = np.random.default_rng(3).permutation(len(left)) + 0.5  # one draw from each of as many equal shares
            sums = self.believed + self.freedom * max(1.0, self.ratio)
            of_draws = gammaincinv(0.5 * (self.believed + self.freedom), places / len(left))
            scaled = left * np.sqrt(sums / (2.0 * of_draws))
        high = max(self.averaged * high, float(np.percentile(scaled, 97.5)))
        if low > 0.0:
            down, up = (np.exp(np.hypot(np.log(end / size), TWICE * prior)) for end in (low, high))
            low, high = size / down, size * up
        after = np.linalg.norm([self.factor * size, scatter.lack, scatter.stops])
        high = np.linalg.norm([high, ASSUMED.lack_margin * scatter.lack, scatter.most_stops])
        return Promise(float(after), float(low), float(high))

    def findings(self) -> tuple[list[str], list[str]]:
        """Return the causes of doubt about a fit, and notes on how the interval was computed."""
        doubts, notes = [], []
        if self.factor > 1.0:
            found = "left out in turn, each run changes the tool more than noise explains"
            found += f": standard errors are {self.factor:.1f} times as large"
            if self.factor > ASSUMED.misfit[1]:
                doubts.append(f"{found}: lines, or what they were read with, disagree with each other")
            else:
                notes.append(f"{found}; the expected tool error allows for it")
        if self.drift > ASSUMED.clear * self.drift_error:
            size = f"{self.drift * 1e6:.2g} ppm, as steel's does in {self.drift / STEEL:.2g} K"
            problem = f"the scale of the linear readings changes by {size}, from the first to the last"
            doubts.append(f"{problem}: the model is that of the middle of the campaign")
        if lack := self._sizes("lack"):
            notes.append(f"{lack} is in no parameter (discrepancy); the expected tool error allows for it")
        if stops := self._sizes("stops"):
            problem = "repeated readings scatter more than stated: taken for the machine's own repeatability"
            notes.append(f"{problem}, {stops}; the expected tool error has it, the lower end has not")
        return doubts, notes

    def _sizes(self, name: str) -> str:
        """Return a part of displacement and rotation as text; empty if both are zero."""
        parts = (self.displacement, "µm RMS of the tool's displacement"), (self.rotation, "µrad RMS of its rotation")
        return " and ".join(f"{1e6 * getattr(part, name):.2f} {unit}" for part, unit in parts if getattr(part, name))
