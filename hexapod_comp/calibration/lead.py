"""Estimate the lead of the screws: the strut length after which the errors of all struts repeat.

Fourier transforms of the residuals of a fit without screw waves give the strongest frequencies, 1/m. Newton steps
refine these frequencies; each step fits waves and all other parameters together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core import MOST_HARMONICS
from ..measurements.readings import KINDS
from .assumptions import ASSUMED
from .blocks import WAVES
from .estimator import Estimation, LinearProblem, Posterior, huber_limit, in_parallel, solve
from .observations import without_nuisance

LEAST_FREEDOM = 200.0  # degrees of freedom needed to search for a period
MOST_STEPS = 8  # Newton steps to a frequency, at most; not fewer, as the clipping of outliers converges only linearly
MOST_READINGS = 2500  # if there are more readings, a random sample of this number is searched first
WAVE_AMPLITUDE = 10e-6  # prior σ of a wave's amplitude, m
AGREES = 6.0  # standard errors by which a given or round lead may differ from the detected lead
CLOSE = 5e-3  # a given lead agrees if it differs by less than this fraction, whatever the standard error

SHORTEST, LONGEST = 1e-3, 30e-3  # range of the searched periods, m; a length map describes longer waves

GRID_STEP = SHORTEST / 32.0
"""For Fourier transforms, strut lengths are rounded to multiples of this, m: the shortest wave loses 0.3 % of power."""

ROUND = (0.5e-3, 0.025 * 0.0254)
"""A round lead is a multiple of 0.5 mm or of 0.025 inch; both in m."""


@dataclass(frozen=True)
class ScrewLead:
    given: float | None  # in the settings or the geometry, m
    shown: float | None  # period detected in the readings, m
    error: float  # standard error of `shown`, m
    odds: float  # smallest log odds of `shown`: against no waves, and against each other period

    @property
    def used(self) -> float | None:
        """The lead used in the fit, m: the given one, or the detected one, rounded if its standard error allows."""
        if self.given is not None or self.shown is None:
            return self.given
        within = AGREES * self.error
        round_leads = [step * round(self.shown / step) for step in ROUND if within < 0.1 * step]
        near = [lead for lead in round_leads if abs(lead - self.shown) < within]
        return near[0] if near else self.shown

    @property
    def agrees(self) -> bool:
        """False if the detected period is neither the given lead nor 1/2, 1/3 or 1/4 of it."""
        if self.given is None or self.shown is None:
            return True
        misses = [abs(self.given / n - self.shown) for n in range(1, MOST_HARMONICS + 1)]
        return min(misses) < max(AGREES * self.error, CLOSE * self.shown)

    def __str__(self) -> str:
        given = "" if self.given is None else f"{self.given * 1e3:.6g} mm given"
        if self.shown is None and given:  # fewer readings show waves of a given lead, so the fit may keep them
            return f"{given}, not shown by the readings"
        if self.shown is None:
            return "not known; the readings show no periodic error of the screws"
        shown = f"{self.shown * 1e3:.4f} ± {self.error * 1e3:.4f} mm shown by the readings"
        if self.given is None:
            return f"{shown}, {self.used * 1e3:.6g} mm used in the fit"  # type: ignore[operator]
        return f"{given}, {shown}{'' if self.agrees else ': THEY DISAGREE'}"


def detect_lead(estimation: Estimation, problem: LinearProblem) -> ScrewLead:
    """Detect the screws' lead in the readings; `problem` is the fit linearised at the nominal machine.

    Of more than MOST_READINGS readings a random sample is searched; if it shows no lead, and none is given, all are.
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
    # The noise was estimated from residuals that contain the waves: solve again with a smaller noise
    quieter = solve(space, problem, posterior.tolerances, posterior.noise * best.noise, rounds=0)
    residuals = _Residuals(estimation, problem, quieter)
    if residuals.freedom >= LEAST_FREEDOM:  # else the noise cannot be estimated
        best = residuals.line(best.frequency)
    if not np.isfinite(best.error):
        return ScrewLead(given, None, np.inf, odds)
    return ScrewLead(given, float(1.0 / best.frequency), float(best.error / best.frequency**2), odds)


def _strongest(estimation: Estimation, problem: LinearProblem) -> tuple[float, Line | None, Posterior]:
    """Return log odds and :class:`Line` of the most probable period, and the posterior of a fit without waves."""
    space = estimation.space
    tolerances = np.where([b.name in WAVES for b in space.blocks], 0.0, space.start_tolerances())
    posterior = solve(space, problem, tolerances, np.ones(len(KINDS)), 5)
    residuals = _Residuals(estimation, problem, posterior)
    if residuals.freedom < LEAST_FREEDOM:
        return 0.0, None, posterior
    spectrum = residuals.spectrum()
    best = _fundamental(residuals, spectrum)
    rivals = _rivals(residuals.frequencies, spectrum, best.frequency, residuals.span)
    lines = in_parallel(lambda f: residuals.line(f, 1), rivals, len(problem.target))
    return min([best.odds, *(best.odds - rival.odds for rival in lines)]), best, posterior


class Line(NamedTuple):
    """A spectral line: waves of the struts' length errors at one frequency along the screws, 1/m, and its harmonics."""

    frequency: float  # of the first harmonic: 1 / period, 1/m
    error: float  # standard error of `frequency`, 1/m
    odds: float  # log odds against a fit without waves
    noise: float  # standard deviation of the residuals with waves, in units of the noise estimated without waves


class _Residuals:
    """Residuals of a fit without screw waves, and derivatives of mean readings by strut lengths, both divided by σ."""

    def __init__(self, estimation: Estimation, problem: LinearProblem, posterior: Posterior) -> None:
        over_noise = 1.0 / posterior.noise[problem.kind]
        self._unknowns, self._covariance, self._spread = problem.unknowns, posterior.covariance, posterior.spread
        self._rows, self._target = problem.rows.using(posterior.used, over_noise), over_noise * problem.target
        unclipped, _ = self._unfitted(self._target)
        self.residuals, self._fit = _clipped(unclipped), self._target - unclipped  # without waves
        self.gains = over_noise[:, None] * problem.per_length
        self.commands = estimation.measurements.stations.commands[estimation.means.station]
        self.span = float(np.ptp(self.commands, axis=0).max())
        _, self.square = self._unfitted(self._fit + self.residuals)
        self.freedom = float(problem.freedom.sum() - posterior.determined.sum())
        self._size = 2 ** int(np.ceil(np.log2(4.0 * self.span / GRID_STEP + 1.0)))
        frequencies = np.arange(self._size // 2 + 1) / (self._size * GRID_STEP)
        self._searched = (frequencies >= 1.0 / LONGEST) & (frequencies <= 1.0 / SHORTEST)
        self.frequencies = frequencies[self._searched]

    def spectrum(self) -> np.ndarray:
        """Return by how much waves of each frequency would lower Σ residuals² if struts' effects were orthogonal."""
        power = np.zeros(len(self.frequencies))
        for gain, commands in zip(self.gains.T, self.commands.T, strict=True):
            bins = ((commands - commands.min()) / GRID_STEP).round().astype(int)
            line = np.fft.rfft(np.bincount(bins, gain * self.residuals, self._size), self._size)[self._searched]
            power += np.abs(line) ** 2 / max(0.5 * gain @ gain, np.finfo(float).tiny)
        return power

    def _unfitted(self, values: np.ndarray) -> tuple[np.ndarray, float]:
        """Fit all parameters except waves to `values` (C,): return residuals, and Σ residuals² + Σ (y / prior σ)²."""
        y = self._covariance @ self._rows.transposed_times(values)
        residual = values - self._rows.times(y)
        # Not the equal `values @ residual`, which rounding spoils if values are far above the noise
        return residual, float(residual @ residual + np.square(y / self._spread).sum())

    def line(self, frequency: float, harmonics: int = MOST_HARMONICS) -> Line:
        """Return the best spectral line near `frequency`, with up to `harmonics` harmonics; refit all other parameters.

        Each step clips outliers (Huber's modified residuals) in the residuals of a fit that contains the waves, because
        clipping the waves themselves would bias the frequency.
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
            if abs(step) < 0.1 * error:  # the next step would be far smaller
                break
        # Akaike: −1 for each parameter of the waves
        odds = 0.5 * self.freedom * float(np.log(self.square / square)) - parameters
        return Line(frequency, error, odds, noise)

    def _step_to(self, frequency: float, harmonics: int, values: np.ndarray) -> tuple[np.ndarray, float, float, float]:
        """Fit waves of a frequency and all other parameters to `values` (C,).

        Return the fitted values (C,); Σ residuals² + Σ (parameter / prior σ)²; the Newton step of the frequency, 1/m;
        the frequency's standard error, 1/m, for noise with σ = 1: infinite if the readings do not determine it.
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
        """Fit a factor of each of `columns` (C, n) and all parameters except waves; return n factors and covariance.

        `unfitted`: residuals of a fit without `columns`; `shared`: rowsᵀ·columns. The last `loose` have no prior.
        """
        precision = columns.T @ columns - shared.T @ self._covariance @ shared
        tight = len(precision) - loose
        precision[np.diag_indices(tight)] += WAVE_AMPLITUDE**-2
        covariance = np.linalg.pinv(precision, hermitian=True)
        return covariance @ (columns.T @ unfitted), covariance


def _clipped(residuals: np.ndarray) -> np.ndarray:
    limit = huber_limit(np.abs(residuals))
    return np.clip(residuals, -limit, limit)


def _shrunk(amplitudes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the cosine and sine `amplitudes` (2, harmonics, 6) times each harmonic's James–Stein factor (1961).

    Without shrinkage, the noise of a harmonic that the screws do not have would be taken for information on the
    frequency.
    """
    result, numbers = amplitudes.copy(), np.arange(amplitudes.size).reshape(amplitudes.shape)
    for n in range(amplitudes.shape[1]):
        own = numbers[:, n].ravel()
        values = amplitudes[:, n].ravel()
        size = float(values @ np.linalg.solve(covariance[np.ix_(own, own)], values))
        result[:, n] *= max(0.0, 1.0 - len(own) / size) if size > 0.0 else 0.0
    return result


def _fundamental(residuals: _Residuals, spectrum: np.ndarray) -> Line:
    """Return the spectral line of the waves' first harmonic: the strongest frequency f, or f/2, f/3 or f/4.

    Of f, f/2, f/3 and f/4 the highest whose log odds are within ASSUMED.lead_odds of the largest is returned. f/n is
    tried only if, at a harmonic of f/n that is no harmonic of f, the spectrum is above three times its median.
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
    """Return the frequencies of the four highest peaks that are not harmonics of `best`."""
    rising = np.diff(spectrum) > 0.0
    peaks = np.flatnonzero(rising[:-1] & ~rising[1:]) + 1
    order = frequencies[peaks] / best
    rivals = peaks[np.abs(order - np.maximum(np.round(order), 1.0)) * best * span > 1.5]
    return frequencies[rivals[np.argsort(-spectrum[rivals])][:4]]
