"""The lead of the screws, estimated from the readings: the period of the struts' errors.

The residuals of a fit without screw waves are searched for periods: first strut by strut with Fourier transforms over
the commands, then, about the strongest lines, with all other parameters free. A period is reported when the readings
prefer it to every other one by far more than noise would.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core import MOST_HARMONICS
from .assumptions import ASSUMED
from .blocks import WAVES
from .estimator import MEDIAN_TO_SIGMA, Estimation, LinearProblem, Posterior, at_once, solve

LEAST_FREEDOM = 200.0  # fewest readings beyond the parameters that determine a period
MOST_READINGS = 2500  # first range of the search
WAVE_AMPLITUDE = 10e-6  # prior of amplitudes while periods are compared, m: loose
AGREES, CLOSE = 6.0, 5e-3  # a given or a round lead agrees within, σ, and as a share

SHORTEST, LONGEST = 1e-3, 30e-3  # range of the search, m: longer waves are as smooth as a length map

GRID_STEP = SHORTEST / 32.0
"""Of the transforms, m: 0.3 % of a wave of the shortest period is lost."""

ROUND = (0.5e-3, 0.025 * 0.0254)
"""Screws are made with leads that are whole multiples of one of these, m."""


@dataclass(frozen=True)
class ScrewLead:
    """The screws' lead: as given by settings or geometry, and as detected in the readings."""

    given: float | None  # by the settings or the geometry, m
    shown: float | None  # the period that the readings show, m; None: none
    error: float  # its standard error, m
    odds: float  # log odds by which they prefer it to any other period and to none

    @property
    def used(self) -> float | None:
        """The period to be fitted, m: the given one, else the detected one, or the round number near that."""
        if self.given is not None or self.shown is None:
            return self.given
        within = AGREES * self.error
        round_ones = [step * round(self.shown / step) for step in ROUND if within < 0.1 * step]
        near = [lead for lead in round_ones if abs(lead - self.shown) < within]
        return near[0] if near else self.shown

    @property
    def agrees(self) -> bool:
        """Whether the given lead explains the shown one, as one of its harmonics; True if there is nothing to
        compare."""
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
            return f"{shown}, {self.used * 1e3:.6g} mm taken"  # type: ignore[operator]
        return f"{given}, {shown}{'' if self.agrees else ': THEY DISAGREE'}"


def detect_lead(estimation: Estimation, problem: LinearProblem) -> ScrewLead:
    """Return the lead that readings show, with the given one; `problem` is at the nominal machine.

    With many readings a random part is tried first; that is enough to check a given lead.
    """
    space, measurements = estimation.space, estimation.measurements
    given = float(space.periods[0]) if np.isfinite(space.periods).all() else None
    every = estimation, problem
    if len(measurements) > MOST_READINGS:
        some = np.zeros(len(measurements), dtype=bool)
        some[np.random.default_rng(0).choice(len(measurements), MOST_READINGS, replace=False)] = True
        estimation = Estimation(measurements.select(some), space, alone=False)
        problem, _ = estimation.linearise(np.zeros(space.size), np.ones(MOST_READINGS))
    odds, best, posterior = _strongest(estimation, problem)
    if given is None and len(measurements) > MOST_READINGS:
        estimation, problem = every
        if odds < ASSUMED.lead_odds:
            odds, best, posterior = _strongest(estimation, problem)
    if best is None or odds < ASSUMED.lead_odds:
        return ScrewLead(given, None, np.inf, odds)
    # Until here the waves counted as noise, which gave the priors too much weight.
    quiet = solve(space, problem, posterior.tolerances, posterior.noise * best.noise, rounds=0)
    rest = _Rest(estimation, problem, quiet)
    if rest.freedom >= LEAST_FREEDOM:  # a quiet fit of few readings has no information on its noise
        best = rest.line(best.frequency)
    if not np.isfinite(best.error):
        return ScrewLead(given, None, np.inf, odds)
    return ScrewLead(given, float(1.0 / best.frequency), float(best.error / best.frequency**2), odds)


def _strongest(estimation: Estimation, problem: LinearProblem) -> tuple[float, Line | None, Posterior]:
    """Return the odds of the most probable period, that period, and the fit without waves."""
    space = estimation.space
    tolerances = np.where([b.name in WAVES for b in space.blocks], 0.0, space.start_tolerances())
    posterior = solve(space, problem, tolerances, np.ones(problem.normal.shape[0]), 5)
    rest = _Rest(estimation, problem, posterior)
    if rest.freedom < LEAST_FREEDOM:
        return 0.0, None, posterior
    spectrum = rest.spectrum()
    best = _fundamental(rest, spectrum)
    rivals = _rivals(rest.frequencies, spectrum, best.frequency, rest.span)
    others = at_once(lambda f: rest.line(f, 1), rivals, len(problem.target))
    return min([best.odds, *(best.odds - other.odds for other in others)]), best, posterior


class Line(NamedTuple):
    """A frequency of the errors and its harmonics."""

    frequency: float  # 1/m
    error: float  # its standard error
    odds: float  # log odds against no such errors
    noise: float  # its residual, over the residual without it


class _Rest:
    """The residuals of a fit without screw waves, and their derivatives by the six lengths, over the noise."""

    def __init__(self, estimation: Estimation, problem: LinearProblem, posterior: Posterior) -> None:
        over_noise = 1.0 / posterior.noise[problem.kind]
        self._problem, self._posterior, self._over_noise = problem, posterior, over_noise
        left = over_noise * (problem.target - problem.rows.times(posterior.every(problem.rows.shape[1])))
        cut = ASSUMED.huber * MEDIAN_TO_SIGMA * np.median(np.abs(left))
        self.left = np.clip(left, -cut, cut)
        self.gains = over_noise[:, None] * problem.per_length
        self.commands = estimation.measurements.stations.commands[estimation.cells.station]
        self.span = float(np.ptp(self.commands, axis=0).max())
        self.square = float(self.left @ self.left)
        self.freedom = float(problem.freedom.sum() - posterior.determined.sum())
        self._size = 2 ** int(np.ceil(np.log2(4.0 * self.span / GRID_STEP + 1.0)))
        every = np.arange(self._size // 2 + 1) / (self._size * GRID_STEP)
        self._searched = (every >= 1.0 / LONGEST) & (every <= 1.0 / SHORTEST)
        self.frequencies = every[self._searched]

    def spectrum(self) -> np.ndarray:
        """Return the reduction of the sum of squares by a wave of each frequency, as if struts and readings were
        independent."""
        power = np.zeros(len(self.frequencies))
        for gain, commands in zip(self.gains.T, self.commands.T, strict=True):
            bins = ((commands - commands.min()) / GRID_STEP).round().astype(int)
            line = np.fft.rfft(np.bincount(bins, gain * self.left, self._size), self._size)[self._searched]
            power += np.abs(line) ** 2 / max(0.5 * gain @ gain, np.finfo(float).tiny)
        return power

    def line(self, frequency: float, harmonics: int = MOST_HARMONICS) -> Line:
        """Return the best frequency near one, with at most this number of harmonics, all other parameters free."""
        harmonics = int(np.clip(1.0 / (SHORTEST * frequency), 1, harmonics))
        parameters = 12 * harmonics + 1
        half_width, start = 0.5 / self.span, frequency
        for _ in range(4):
            less, step, deviation = self._step_to(frequency, harmonics)
            noise = np.sqrt(max(self.square - less, 1e-6 * self.square) / (self.freedom - parameters))
            error = noise * deviation
            step = float(np.clip(step, -half_width, half_width))
            if abs(frequency + step - start) > half_width:
                break
            frequency += step
            if abs(step) < 0.1 * error:  # a Newton step squares the error
                break
        return Line(frequency, error, self._odds(less, parameters), noise)

    def _odds(self, less: float, parameters: int) -> float:
        """Return the log odds of an explanation that lowers the sum of squares, at the noise of its residuals."""
        left = max(self.square - less, 1e-6 * self.square)
        return 0.5 * self.freedom * float(np.log(self.square / left)) - parameters

    def _step_to(self, frequency: float, harmonics: int) -> tuple[float, float, float]:
        """Return the reduction of the sum of squares by waves of a frequency, the step to a better one, its error at
        noise 1.

        If readings cannot distinguish a frequency from all others, to rounding, the step is zero, with an infinite
        error.
        """
        orders = np.arange(1, harmonics + 1)
        first = np.exp(2.0j * np.pi * frequency * self.commands)[:, None]
        turns = np.cumprod(np.repeat(first, harmonics, axis=1), axis=1)
        c, s = self.gains[:, None] * turns.real, self.gains[:, None] * turns.imag
        waves = self._free(np.concatenate([c, s], axis=1).reshape(len(c), -1))
        shared = self._shared(waves)
        amplitudes, less, covariance = self._solved(waves, shared)
        noise = max(self.square - less, 1e-6 * self.square) / (self.freedom - amplitudes.size)
        a, b = _shrunk(amplitudes.reshape(2, -1, 6), noise * covariance)
        turning = 2.0 * np.pi * self.commands[:, None] * orders[:, None]
        slope = self._free(((b * c - a * s) * turning).sum(axis=(1, 2))[:, None])
        every = np.hstack([waves, slope]), np.hstack([shared, self._shared(slope)])
        together, _, covariance = self._solved(*every, loose=1)
        if not covariance[-1, -1] > 0.0:
            return less, 0.0, np.inf
        return less, float(together[-1]), float(np.sqrt(covariance[-1, -1]))

    def _free(self, columns: np.ndarray) -> np.ndarray:
        """Return columns free of the instruments' unknowns."""
        for part in self._problem.unknowns:
            part.project_out(columns)
        return columns

    def _shared(self, columns: np.ndarray) -> np.ndarray:
        """Return the products of columns with the derivatives by all other parameters."""
        return self._problem.rows.transposed_times(self._over_noise[:, None] * columns)[self._posterior.used]

    def _solved(self, columns: np.ndarray, shared: np.ndarray, loose: int = 0) -> tuple[np.ndarray, float, np.ndarray]:
        """Return factors of columns (C, n), their reduction of the sum of squares, and their covariance.

        `shared` are theirs of :meth:`_shared`; the other parameters are free within their priors, and the last `loose`
        columns have none.
        """
        precision = columns.T @ columns - shared.T @ self._posterior.covariance @ shared
        tight = len(precision) - loose
        precision[np.diag_indices(tight)] += WAVE_AMPLITUDE**-2
        covariance = np.linalg.pinv(precision, hermitian=True)
        moment = columns.T @ self.left
        factors = covariance @ moment
        return factors, float(moment @ factors), covariance


def _shrunk(amplitudes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return amplitudes (2, harmonics, 6) shrunk by the share of noise, harmonic by harmonic (James & Stein).

    The noise of an absent harmonic would count as information about the frequency, most of all that of the highest.
    """
    result, numbers = amplitudes.copy(), np.arange(amplitudes.size).reshape(amplitudes.shape)
    for n in range(amplitudes.shape[1]):
        own = numbers[:, n].ravel()
        values = amplitudes[:, n].ravel()
        size = float(values @ np.linalg.solve(covariance[np.ix_(own, own)], values))
        result[:, n] *= max(0.0, 1.0 - len(own) / size) if size > 0.0 else 0.0
    return result


def _fundamental(rest: _Rest, spectrum: np.ndarray) -> Line:
    """Return the frequency of which the strongest line is a harmonic: the highest that explains as much as any.

    Parts of it are tried only where one of their other harmonics stands out of the spectrum.
    """
    strongest = rest.frequencies[spectrum.argmax()]
    lines = [rest.line(strongest)]
    for n in range(2, MOST_HARMONICS + 1):
        others = np.array([m * strongest / n for m in range(1, MOST_HARMONICS + 1) if m % n])
        at = np.searchsorted(rest.frequencies, others[others <= rest.frequencies[-1]])
        stands_out = spectrum[np.minimum(at, len(spectrum) - 1)].max() > 3.0 * np.median(spectrum)
        if strongest / n >= 1.0 / LONGEST and stands_out:
            lines.append(rest.line(strongest / n))
    return next(line for line in lines if line.odds > max(other.odds for other in lines) - ASSUMED.lead_odds)


def _rivals(frequencies: np.ndarray, spectrum: np.ndarray, best: float, span: float) -> np.ndarray:
    """Return the frequencies of the strongest lines that are no harmonics of the best one."""
    peaks = np.flatnonzero((spectrum[1:-1] >= spectrum[:-2]) & (spectrum[1:-1] >= spectrum[2:])) + 1
    turns = frequencies[peaks] / best
    apart = np.abs(turns - np.maximum(np.round(turns), 1.0)) * best * span > 1.5
    others = peaks[apart]
    return frequencies[others[np.argsort(-spectrum[others])][:4]]
