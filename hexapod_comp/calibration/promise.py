"""What a fit promises of the tool's error: an interval by its covariance, widened by what is unexplained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..machine.size import rms

TWICE, LACK_MARGIN = 2.0, 1.5
"""An end of an interval stands so far out: in standard deviations, and in sizes of a lack."""

DOUBTFUL_FACTOR = 3.0
"""Parts of the readings that differ so many times as much as their noise explains put the whole fit in doubt."""

STEEL = 11.5e-6
"""Expansion of steel, 1/K."""


@dataclass(frozen=True)
class Unexplained:
    """What widens a promise.

    Attributes
    ----------
    factor : float
        On the standard deviations of all parameters, from 1: what leaving out `without` shows.
    without : str
        What was left out in turn where that showed most; empty where the factor is 1.
    allowed : float
        The same on what the readings allow with all blocks in, of which the fit has chosen some.
    prior : float
        Standard deviation of the logarithm of the tool error to expect: the sizes of the priors are estimated from the
        same readings.
    lack : float
        RMS displacement of the tool that readings show and no parameter describes, m.
    drift : float
        Change of the scale from the first to the last reading, m/m; 0 where there is none.
    scale : float
        Stated standard deviation of the scale of all readings, m/m.
    """

    factor: float = 1.0
    without: str = ""
    allowed: float = 1.0
    prior: float = 0.0
    lack: float = 0.0
    drift: float = 0.0
    scale: float = 0.0

    def promised(self, left: np.ndarray, possible: np.ndarray, points: np.ndarray) -> tuple[float, float, float]:
        """Return the error to expect, and between what it lies with 95 %, m; what is unexplained raises the upper end.

        Parameters
        ----------
        left, possible : ndarray, shape (D,)
            RMS errors of draws by the fit's covariance, and with all that the readings allow, m.
        points : ndarray, shape (n, 3)
            The places, m: a scale that is off acts on their distances.
        """
        size, (low, high) = rms(left), np.percentile(left, [2.5, 97.5])
        if low > 0.0:
            down, up = (np.exp(np.hypot(np.log(end / size), TWICE * self.prior)) for end in (low, high))
            low, high = size / down, size * up
        high = max(self.factor * high, self.allowed * float(np.percentile(possible, 97.5)))
        radius = rms(np.linalg.norm(points - points.mean(axis=0), axis=1))
        stretch = radius * np.array([self.scale, 0.5 * self.drift])
        after = np.sqrt((self.factor * size) ** 2 + self.lack**2 + stretch @ stretch)
        high = np.sqrt(high**2 + (LACK_MARGIN * self.lack) ** 2 + TWICE**2 * stretch @ stretch)
        return float(after), float(low), float(high)

    def doubts(self) -> list[str]:
        """Return what puts a fit in doubt."""
        listed = []
        if self.factor > DOUBTFUL_FACTOR:
            listed.append(f"{self._outcome()}: lines, or what they were read with, disagree with each other")
        if self.drift:
            size = f"{self.drift * 1e6:.2g} ppm, as steel's does in {self.drift / STEEL:.2g} K"
            listed.append(f"the scale of the linear readings changes by {size}, from the first to the last")
        return listed

    def remarks(self) -> list[str]:
        """Return what a reader must know of how the promise came about."""
        listed = []
        if 1.0 < self.factor <= DOUBTFUL_FACTOR:
            listed.append(f"{self._outcome()}; the expected tool error allows for it")
        if self.lack:
            problem = f"{self.lack * 1e6:.2f} µm RMS of the tool's error, there and back alike, are in no parameter"
            listed.append(f"{problem}; the expected tool error allows for them")
        return listed

    def as_json(self) -> dict[str, float | str]:
        """Return this as plain numbers; units are in the keys."""
        return {
            "factor": self.factor,
            "without": self.without,
            "factor_allowed": self.allowed,
            "prior_log_deviation": self.prior,
            "lack_m": self.lack,
            "drift_m_per_m": self.drift,
            "scale_m_per_m": self.scale,
        }

    def _outcome(self) -> str:
        problem = f"left out in turn, each {self.without} changes the tool more than noise explains"
        return f"{problem}: standard errors are {self.factor:.1f} times as large"
