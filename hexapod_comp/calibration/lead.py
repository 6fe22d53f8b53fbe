"""Estimate the lead of the screws from the readings: the period of the struts' errors over strut length.

The search uses the residuals of a fit without screw waves. A Fourier transform over each strut's commanded lengths
gives the strongest frequencies. Each of these frequencies is refined by Newton steps with all other parameters free. A
period is reported if its log odds against every other period, and against no period, are at least `lead_odds`
(assumptions.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core import MOST_HARMONICS
from .assumptions import ASSUMED
from .blocks import WAVES
from .estimator import Estimation, LinearProblem, Posterior, huber_limit, in_parallel, solve
from .observations import without_nuisance

LEAST_FREEDOM = 200.0  # smallest number of degrees of freedom with which a period is searched for
MOST_STEPS = 8  # largest number of Newton steps to a frequency; the clipping of outliers converges only linearly
MOST_READINGS = 2500  # with more readings than this, a random sample of this size is searched first
WAVE_AMPLITUDE = 10e-6  # standard deviation of the prior of the waves' amplitudes, m
AGREES = 6.0  # a given or round lead agrees with the detected lead if the two differ by fewer standard errors than this
CLOSE = 5e-3  # a given lead also agrees if it differs from the detected lead by less than this share

SHORTEST, LONGEST = 1e-3, 30e-3  # range of the periods searched, m; a length map describes waves of longer periods

GRID_STEP = SHORTEST / 32.0
"""Step of strut length in the Fourier transforms, m; rounding to it costs 0.3 % of a wave of the shortest period."""

ROUND = (0.5e-3, 0.025 * 0.0254)
"""Steps of round leads, m: a round lead is a whole multiple of 0.5 mm or of 0.025 inch."""


@dataclass(frozen=True)
class ScrewLead:
    """The screws' lead: as given by settings or geometry, and as detected in the readings."""

    given: float | None  # lead from the settings or the geometry, m; None: not given
    shown: float | None  # period detected in the readings, m; None: no period was detected
    error: float  # standard error of the detected period, m
    odds: float  # log odds of the detected period against every other period and against no period

    @property
    def used(self) -> float | None:
        """The period to be fitted, m: the given lead or the detected period, rounded if a round lead agrees with it."""
        if self.given is not None or self.shown is None:
            return self.given
        within = AGREES * self.error
        round_leads = [step * round(self.shown / step) for step in ROUND if within < 0.1 * step]
        near = [lead for lead in round_leads if abs(lead - self.shown) < within]
        return near[0] if near else self.shown

    @property
    def agrees(self) -> bool:
        """Whether the detected period is the given lead or a harmonic of it; True if one of them is unknown."""
        if self.given is None or self.shown is None:
            return True
        misses = [abs(self.given / n - self.shown) for n in range(1, MOST_HARMONICS + 1)]
        return min(misses) < max(AGREES * self.error, CLOSE * self.shown)

    def __str__(self) -> str:
        given = "" if self.given is None else f"{self.given * 1e3:.6g} mm given"
        if self.shown is None:
            return f"{given or 'not known'}; the readings do not show it"
        shown = f"{self.shown * 1e3:.4f} ± {self.error * 1e3:.4f} mm shown by the readings"
        if self.given is None:
            return f"{shown}, {self.used * 1e3:.6g} mm used in the fit"  # type: ignore[operator]
        return f"{given}, {shown}{'' if self.agrees else ': THEY DISAGREE'}"


def detect_lead(estimation: Estimation, problem: LinearProblem) -> ScrewLead:
    """Return the given and the detected lead of the screws; `problem` is linearised at the nominal machine.

    If there are more than MOST_READINGS readings, a random sample is searched first. If the sample shows no lead, and
    no lead is given, all readings are searched.
    """
    space, measurements = estimation.space, estimation.measurements
    given = float(space.periods[0]) if np.isfinite(space.periods).all() else None
    whole = estimation, problem
    if len(measurements) > MOST_READINGS:
        sampled = np.zeros(len(measurements), dtype=bool)
        sampled[np.random.default_rng(0).choice(len(measurements), MOST_READINGS, replace=False)] = True
        estimation = Estimation(measurements.select(sampled), space, check_count=False)
        problem, _ = estimation.linearise(np.zeros(space.size), np.ones(MOST_READINGS))
    odds, best, posterior = _strongest(estimation, problem)
    if given is None and len(measurements) > MOST_READINGS:
        estimation, problem = whole
        if odds < ASSUMED.lead_odds:
            odds, best, posterior = _strongest(estimation, problem)
    if best is None or odds < ASSUMED.lead_odds:
        return ScrewLead(given, None, np.inf, odds)
    # The residuals contained the waves, so the estimated noise is too large: solve again with a smaller noise
    quieter = solve(space, problem, posterior.tolerances, posterior.noise * best.noise, rounds=0)
    residuals = _Residuals(estimation, problem, quieter)
    if residuals.freedom >= LEAST_FREEDOM:  # with fewer degrees of freedom the noise cannot be estimated
        best = residuals.line(best.frequency)
    if not np.isfinite(best.error):
        return ScrewLead(given, None, np.inf, odds)
    return ScrewLead(given, float(1.0 / best.frequency), float(best.error / best.frequency**2), odds)


def _strongest(estimation: Estimation, problem: LinearProblem) -> tuple[float, Line | None, Posterior]:
    """Return the log odds of the most probable period, its waves, and the posterior of the fit without waves."""
    space = estimation.space
    tolerances = np.where([b.name in WAVES for b in space.blocks], 0.0, space.start_tolerances())
    posterior = solve(space, problem, tolerances, np.ones(problem.normal.shape[0]), 5)
    residuals = _Residuals(estimation, problem, posterior)
    if residuals.freedom < LEAST_FREEDOM:
        return 0.0, None, posterior
    spectrum = residuals.spectrum()
    best = _fundamental(residuals, spectrum)
    rivals = _rivals(residuals.frequencies, spectrum, best.frequency, residuals.span)
    lines = in_parallel(lambda f: residuals.line(f, 1), rivals, len(problem.target))
    return min([best.odds, *(best.odds - rival.odds for rival in lines)]), best, posterior


class Line(NamedTuple):
    """A spatial frequency of the struts' errors, fitted together with its harmonics."""

    frequency: float  # of the fundamental, 1/m
    error: float  # standard error of the frequency, 1/m
    odds: float  # log odds of waves with this frequency against no waves
    noise: float  # standard deviation of the residuals of a fit with waves, divided by that of a fit without waves


class _Residuals:
    """Residuals of a fit without screw waves, and their derivatives by the six strut lengths, divided by the noise."""

    def __init__(self, estimation: Estimation, problem: LinearProblem, posterior: Posterior) -> None:
        over_noise = 1.0 / posterior.noise[problem.kind]
        self._unknowns, self._covariance, self._spread = problem.unknowns, posterior.covariance, posterior.spread
        self._rows, self._target = problem.rows.using(posterior.used, over_noise), over_noise * problem.target
        unclipped, _ = self._unfitted(self._target)
        self.residuals, self._fit = _clipped(unclipped), self._target - unclipped  # without waves
        self.gains = over_noise[:, None] * problem.per_length
        self.commands = estimation.measurements.stations.commands[estimation.cells.station]
        self.span = float(np.ptp(self.commands, axis=0).max())
        _, self.square = self._unfitted(self._fit + self.residuals)
        self.freedom = float(problem.freedom.sum() - posterior.determined.sum())
        self._size = 2 ** int(np.ceil(np.log2(4.0 * self.span / GRID_STEP + 1.0)))
        frequencies = np.arange(self._size // 2 + 1) / (self._size * GRID_STEP)
        self._searched = (frequencies >= 1.0 / LONGEST) & (frequencies <= 1.0 / SHORTEST)
        self.frequencies = frequencies[self._searched]

    def spectrum(self) -> np.ndarray:
        """Return the decrease of the sum of squares by a wave of each frequency, as if the struts were independent."""
        power = np.zeros(len(self.frequencies))
        for gain, commands in zip(self.gains.T, self.commands.T, strict=True):
            bins = ((commands - commands.min()) / GRID_STEP).round().astype(int)
            line = np.fft.rfft(np.bincount(bins, gain * self.residuals, self._size), self._size)[self._searched]
            power += np.abs(line) ** 2 / max(0.5 * gain @ gain, np.finfo(float).tiny)
        return power

    def _unfitted(self, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the residuals of values (C,) after a fit by all parameters except waves, and the sum of squares.

        The sum contains the squares of the residuals, and of the parameters divided by their priors' deviations.
        """
        y = self._covariance @ self._rows.transposed_times(values)
        residual = values - self._rows.times(y)
        # In exact arithmetic the sum is `values @ residual`, which rounding spoils if values are far above the noise.
        return residual, float(residual @ residual + np.square(y / self._spread).sum())

    def line(self, frequency: float, harmonics: int = MOST_HARMONICS) -> Line:
        """Return the best line near `frequency`, with at most `harmonics` harmonics and all other parameters free.

        Each step clips the residuals of the previous step's fit, which contains the waves (Huber's modified residuals).
        Residuals of a fit without waves contain the waves: clipping would cut off the peaks and bias the frequency.
        """
        harmonics = int(np.clip(1.0 / (SHORTEST * frequency), 1, harmonics))
        parameters = 12 * harmonics + 1
        half_width, start, fit = 0.5 / self.span, frequency, self._fit
        for _ in range(MOST_STEPS):
            values = fit + _clipped(self._target - fit)
            fit, square, step, deviation = self._step_to(frequency, harmonics, values)
            noise = np.sqrt(np.square(values - fit).sum() / (self.freedom - parameters))
            error = noise * deviation
            step = float(np.clip(step, -half_width, half_width))
            if abs(frequency + step - start) > half_width:
                break
            frequency += step
            if abs(step) < 0.1 * error:  # the next Newton step would be far smaller than this step
                break
        # Each additional parameter lowers the log odds by 1 (Akaike).
        odds = 0.5 * self.freedom * float(np.log(self.square / square)) - parameters
        return Line(frequency, error, odds, noise)

    def _step_to(self, frequency: float, harmonics: int, values: np.ndarray) -> tuple[np.ndarray, float, float, float]:
        """Fit waves of a frequency and all other parameters to values (C,).

        Return the fit (C,), the sum of squares of residuals and priors, the Newton step of the frequency, 1/m, and the
        step's standard error for a noise of 1, 1/m. If the readings cannot distinguish this frequency from other
        frequencies, the step is zero and its standard error is infinite.
        """
        orders = np.arange(1, harmonics + 1)
        first = np.exp(2.0j * np.pi * frequency * self.commands)[:, None]
        turns = np.cumprod(np.repeat(first, harmonics, axis=1), axis=1)
        c, s = self.gains[:, None] * turns.real, self.gains[:, None] * turns.imag
        waves = without_nuisance(np.concatenate([c, s], axis=1).reshape(len(c), -1), self._unknowns)
        shared = self._rows.transposed_times(waves)
        unfitted, _ = self._unfitted(values)
        amplitudes, covariance = self._solved(waves, shared, unfitted)
        residual, square = self._unfitted(values - waves @ amplitudes)
        square += float(np.square(amplitudes / WAVE_AMPLITUDE).sum())
        variance = float(residual @ residual) / (self.freedom - amplitudes.size)
        a, b = _shrunk(amplitudes.reshape(2, -1, 6), variance * covariance)
        turning = 2.0 * np.pi * self.commands[:, None] * orders[:, None]
        slope = without_nuisance(((b * c - a * s) * turning).sum(axis=(1, 2))[:, None], self._unknowns)
        every = np.hstack([waves, slope]), np.hstack([shared, self._rows.transposed_times(slope)])
        together, covariance = self._solved(*every, unfitted, loose=1)
        if not covariance[-1, -1] > 0.0:
            return values - residual, square, 0.0, np.inf
        return values - residual, square, float(together[-1]), float(np.sqrt(covariance[-1, -1]))

    def _solved(
        self, columns: np.ndarray, shared: np.ndarray, unfitted: np.ndarray, loose: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of columns (C, n) fitted to the residuals `unfitted`, (C,), and their covariance.

        `unfitted` is a result of :meth:`_unfitted`. The fit's other parameters are free within their priors; `shared`
        is the product of the derivatives by these parameters and the columns. The last `loose` factors have no prior.
        """
        precision = columns.T @ columns - shared.T @ self._covariance @ shared
        tight = len(precision) - loose
        precision[np.diag_indices(tight)] += WAVE_AMPLITUDE**-2
        covariance = np.linalg.pinv(precision, hermitian=True)
        return covariance @ (columns.T @ unfitted), covariance


def _clipped(residuals: np.ndarray) -> np.ndarray:
    """Return residuals clipped at the size above which Huber's weights are below 1."""
    limit = huber_limit(np.abs(residuals))
    return np.clip(residuals, -limit, limit)


def _shrunk(amplitudes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return amplitudes (2, harmonics, 6), each harmonic shrunk by the share of noise in it (James & Stein 1961).

    Without shrinking, noise of a harmonic that the screw does not have would count as information on the frequency.
    """
    result, numbers = amplitudes.copy(), np.arange(amplitudes.size).reshape(amplitudes.shape)
    for n in range(amplitudes.shape[1]):
        own = numbers[:, n].ravel()
        values = amplitudes[:, n].ravel()
        size = float(values @ np.linalg.solve(covariance[np.ix_(own, own)], values))
        result[:, n] *= max(0.0, 1.0 - len(own) / size) if size > 0.0 else 0.0
    return result


def _fundamental(residuals: _Residuals, spectrum: np.ndarray) -> Line:
    """Return the line of the fundamental: f, f/2, f/3 or a further fraction of the spectrum's strongest frequency f.

    The fundamental is the highest of these frequencies whose log odds are at most `lead_odds` below the largest. f/n is
    tried only if the spectrum exceeds three times its median at a harmonic of f/n that is not a harmonic of f.
    """
    strongest = residuals.frequencies[spectrum.argmax()]
    lines = [residuals.line(strongest)]
    for n in range(2, MOST_HARMONICS + 1):
        harmonics = np.array([m * strongest / n for m in range(1, MOST_HARMONICS + 1) if m % n])
        at = np.searchsorted(residuals.frequencies, harmonics[harmonics <= residuals.frequencies[-1]])
        peak = spectrum[np.minimum(at, len(spectrum) - 1)].max() > 3.0 * np.median(spectrum)
        if strongest / n >= 1.0 / LONGEST and peak:
            lines.append(residuals.line(strongest / n))
    return next(line for line in lines if line.odds > max(other.odds for other in lines) - ASSUMED.lead_odds)


def _rivals(frequencies: np.ndarray, spectrum: np.ndarray, best: float, span: float) -> np.ndarray:
    """Return the frequencies of the spectrum's four highest peaks that are not harmonics of the best frequency."""
    peaks = np.flatnonzero((spectrum[1:-1] >= spectrum[:-2]) & (spectrum[1:-1] >= spectrum[2:])) + 1
    order = frequencies[peaks] / best
    rivals = peaks[np.abs(order - np.maximum(np.round(order), 1.0)) * best * span > 1.5]
    return frequencies[rivals[np.argsort(-spectrum[rivals])][:4]]
