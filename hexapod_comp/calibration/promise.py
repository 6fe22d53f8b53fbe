"""The 95 % interval of a fit's tool error, from the covariance of the parameters and from errors beyond it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from ..machine.arrays import rms
from ..machine.temperatures import STEEL
from .assumptions import ASSUMED

TWICE = 2.0
"""Half the width of a 95 % interval, in standard deviations."""


class Scatter(NamedTuple):
    """Tool error that no parameter describes, RMS over all three axes: displacement, m, or rotation, rad."""

    lack: float = 0.0  # discrepancy: the machine's error, a function of the pose, that the model cannot describe
    stops: float = 0.0  # scatter of the machine's stops at one pose: of repeated readings, beyond their stated noise
    most_stops: float = 0.0  # upper end of the 95 % interval of `stops`

    def beside(self, other: float) -> Scatter:
        stops, most = (float(np.hypot(*pair)) for pair in ((self.stops, other), (self.most_stops, TWICE * other)))
        return self._replace(stops=stops, most_stops=most)


NO_SCATTER = Scatter()


class Promise(NamedTuple):
    """Expected RMS error of the tool, and the ends of its 95 % interval: m, or rad."""

    after: float
    low: float
    high: float


@dataclass(frozen=True)
class Unexplained:
    """Errors beyond the covariance of the parameters, which widen the interval of the tool error."""

    factor: float = 1.0  # factor on the parameters' standard deviations, from the jackknife over runs
    believed: float = np.inf  # degrees of freedom of the prior of the factor on the covariance
    prior: float = 0.0  # standard deviation of log(tool error) due to errors of the estimated prior σ
    prior_rotation: float = 0.0  # the same for the tool's rotation
    displacement: Scatter = NO_SCATTER  # displacement of the tool that no parameter describes
    rotation: Scatter = NO_SCATTER  # rotation of the tool that no parameter describes
    assumed_backlash: float = 0.0  # tool displacement by half an assumed backlash, m; 0: readings state directions
    drift: float = 0.0  # relative change of scale from the first to the last reading, m/m; 0: no drift was fitted
    drift_error: float = 0.0  # standard error of the drift, m/m
    scale: float = 0.0  # stated standard deviation of the instruments' scale error, m/m
    ratio: float = 1.0  # observed / expected Σ (change of the tool error by leaving out one run)² (jackknife)
    freedom: float = 0.0  # degrees of freedom of `ratio`
    averaged: float = 1.0  # factor on the tool error, because the machine may have errors of omitted blocks

    @property
    def scatters(self) -> tuple[Scatter, Scatter]:
        """Lack of fit and scatter of stops, of displacement and of rotation: compensation does not reduce them."""
        lack = float(np.hypot(self.displacement.lack, self.assumed_backlash))
        return self.displacement._replace(lack=lack), self.rotation

    def beside(self, displacement: float, rotation: float) -> Unexplained:
        """Return these errors plus a scatter of the tool's stops: RMS displacement, m, and rotation, rad."""
        parts = self.displacement.beside(displacement), self.rotation.beside(rotation)
        return replace(self, displacement=parts[0], rotation=parts[1])

    def promised(self, left: np.ndarray, points: np.ndarray) -> Promise:
        """Return the tool's expected displacement error and its interval, m; `left` (D,) has RMS errors of D machines.

        A scale error moves each of `points` (n, 3), m, in proportion to its distance from their mean.
        """
        after, low, high = self._interval(left, self.prior, self.scatters[0])
        radius = rms(np.linalg.norm(points - points.mean(axis=0), axis=1))
        off = radius**2 * (self.scale**2 + 0.25 * (self.drift**2 + self.drift_error**2))
        return Promise(float(np.sqrt(after**2 + off)), low, float(np.sqrt(high**2 + TWICE**2 * off)))

    def promised_rotation(self, left: np.ndarray) -> Promise:
        return self._interval(left, self.prior_rotation, self.rotation)

    def _interval(self, left: np.ndarray, prior: float, scatter: Scatter) -> Promise:
        """Return an expected RMS error and its interval from the RMS errors `left` of drawn machines.

        The covariance of the draws has an unknown factor, whose scaled inverse χ² prior (scale 1) has `believed`
        degrees of freedom and is updated by `ratio`: so the errors are scaled to a multivariate t distribution. The
        interval's lower end omits the scatter of the machine's stops, because this scatter may be the instrument's.
        """
        size, (low, high) = rms(left), np.percentile(left, [2.5, 97.5])
        scaled = left
        if np.isfinite(self.believed):
            places = np.random.default_rng(3).permutation(len(left)) + 0.5  # stratified: one quantile for each draw
            # A ratio below 1 counts as 1: crossing lines predict a left-out line better than places between lines
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
        """Return doubts about the fit, and notes on what widens its interval."""
        doubts, notes = [], []
        if self.factor > 1.0:
            found = "leaving out single runs changes the predicted tool error more than noise explains"
            found += f": the standard errors of all parameters are multiplied by {self.factor:.1f}"
            if self.factor > ASSUMED.misfit[1]:
                doubts.append(f"{found}: runs, or their instruments, contradict each other")
            else:
                notes.append(f"{found}; the expected tool error allows for it")
        if self.drift > ASSUMED.clear * self.drift_error:
            size = f"{self.drift * 1e6:.2g} ppm (as steel does if warmed by {self.drift / STEEL:.2g} K)"
            problem = f"the scale of the linear readings changes by {size}, from the first to the last reading"
            doubts.append(f"{problem}: the model is valid for the middle of the campaign")
        if lack := self._sizes("lack"):
            notes.append(f"no parameter describes {lack} (discrepancy); the expected tool error allows for it")
        if self.assumed_backlash:
            problem = "no reading states its direction of motion (for rows in measuring order give direction: sequence)"
            size = f"{1e6 * self.assumed_backlash:.2f} µm RMS of the tool's displacement"
            notes.append(f"{problem}: the expected tool error contains half of an assumed backlash, {size}")
        if stops := self._sizes("stops"):
            problem = f"repeated readings scatter by {stops} beyond the stated σ: perhaps the machine's repeatability"
            notes.append(f"{problem}; the expected tool error includes it, the lower end of its interval omits it")
        return doubts, notes

    def _sizes(self, name: str) -> str:
        parts = (self.displacement, "µm RMS of the tool's displacement"), (self.rotation, "µrad RMS of its rotation")
        return " and ".join(f"{1e6 * getattr(part, name):.2f} {unit}" for part, unit in parts if getattr(part, name))
