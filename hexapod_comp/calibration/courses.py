"""The courses of temperatures and humidity behind what sensors read, whose noise would pass for growth.

Each run has a zero of its own, so a warm-up shows in how lines change from round to round. Noise of the sensors differs
from reading to reading, and within a run all channels together show that the tool did not move with it: growth seems
smaller than it is. Fitted to sensors as they read, 10.9 ppm/K came out as 8.0 ± 0.3. (Carroll et al. 2006, *Measurement
Error in Nonlinear Models*, chapters 3 and 4: attenuation, and regression calibration, which is what is done here.)

A course is an integrated Wiener process, read with noise. How far it bends in proportion to that noise is estimated
for each sensor by restricted maximum likelihood. The most probable course is a natural cubic spline.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from ..measurements.readings import MeasurementSet

BIN = 60.0
"""Readings within about so long, s, count as one: the compensator's filter of 30 s makes their noise alike."""

GAP = 120.0
"""After a longer pause, s, a course begins anew: who switches something on does it between readings."""

MOST_BINS = 400
"""Longer courses are cut."""

PACE = 4.0
"""How long a reading takes, s, where nobody wrote down the times."""

BENDS = np.geomspace(1e-11, 1e4, 31)
"""Variances of how far a course bends off in one bin, over that of a bin's noise: from a straight line to what the
sensor reads."""


def with_courses(measurements: MeasurementSet) -> MeasurementSet:
    """Return readings whose stations have the courses of temperatures and humidity, instead of what sensors read.

    Parameters
    ----------
    measurements : MeasurementSet
        The readings. Where they have no times, each run is a course, at an even pace.
    """
    stations = measurements.stations
    read = np.column_stack([stations.temperatures, stations.humidity])
    live = np.flatnonzero(np.isfinite(read).all(axis=0) & (np.ptp(read, axis=0) > 0.0))
    if not len(live):
        return measurements
    if np.isfinite(stations.times).all():
        times = stations.times
    else:
        run_of = np.zeros(len(stations), dtype=int)
        run_of[measurements.station] = measurements.run
        times = PACE * np.arange(len(stations)) + (GAP + 2.0 * PACE) * run_of
    read[:, live] = _courses(times, read[:, live])
    return replace(measurements, stations=replace(stations, temperatures=read[:, :-1], humidity=read[:, -1]))


def _courses(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the courses behind values (N, sensors) that were read at times (N,), s."""
    order = np.argsort(times, kind="stable")
    times, result = times[order], np.empty_like(values)
    parts = [_Part.of(times[part], values[order[part]]) for part in _unbroken(times)]
    bend = _bends(parts)
    for members, part in zip(_unbroken(times), parts, strict=True):
        result[order[members]] = part.course(bend, times[members])
    return result


def _unbroken(times: np.ndarray) -> Iterator[slice]:
    """Yield where sorted times have no long pause."""
    first = 0
    for end in [*(np.flatnonzero(np.diff(times) > GAP) + 1), len(times)]:
        pieces = int(np.ceil((times[end - 1] - times[first]) / (MOST_BINS * BIN))) or 1
        cuts = np.linspace(times[first], times[end - 1], pieces + 1)[1:-1]
        ends = [first, *(first + np.searchsorted(times[first:end], cuts)), end]
        yield from (slice(a, b) for a, b in pairwise(ends) if b > a)
        first = end


class _Part:
    """An unbroken course: means of bins, and in the directions of `bent` what is no straight line, with its variances.

    Variances are those of the course, for a bend of 1, over the noise's.
    """

    def __init__(self, at: np.ndarray, means: np.ndarray, bent: np.ndarray, variances: np.ndarray) -> None:
        self._at, self._means, self._bent, self.variances = at, means, bent, variances
        self.bends = bent.T @ means

    @staticmethod
    def of(times: np.ndarray, values: np.ndarray) -> _Part:
        """Return the part that was read at times (n,) as values (n, sensors)."""
        bins = max(1, round(float(times[-1] - times[0]) / BIN))
        edges = np.linspace(times[0], times[-1], bins + 1)[:-1]
        starts = np.unique(np.searchsorted(times, edges))
        count = np.diff(np.append(starts, len(times)))
        at, means = np.add.reduceat(times, starts) / count, np.add.reduceat(values, starts) / count[:, None]
        t = (at - at[0]) / BIN
        first, last = np.minimum.outer(t, t), np.maximum.outer(t, t)
        straight = np.column_stack([np.ones(len(t)), t])
        away = np.linalg.qr(straight, mode="complete")[0][:, 2:]
        # Covariance of an integrated Wiener process: ∫(s − u)(t − u) du from 0 to the earlier one.
        variances, turned = np.linalg.eigh(away.T @ (first**2 * (3.0 * last - first) / 6.0) @ away)
        return _Part(at, means, away @ turned, np.maximum(variances, 0.0))

    def course(self, bend: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the course at times, shape (n, sensors), for bends (sensors,)."""
        noise = self._bent @ (self.bends / (1.0 + bend * self.variances[:, None]))
        knots = self._means - noise
        if len(knots) == 1:
            return np.repeat(knots, len(times), axis=0)
        curve = CubicSpline(self._at, knots, bc_type="natural")
        inside = np.clip(times, self._at[0], self._at[-1])
        return np.asarray(curve(inside) + curve(inside, 1) * (times - inside)[:, None])


def _bends(parts: list[_Part]) -> np.ndarray:
    """Return the most probable of :data:`BENDS` for each sensor, the noise being what it leaves, shape (sensors,)."""
    variances, bends = np.concatenate([p.variances for p in parts]), np.concatenate([p.bends for p in parts])
    if not len(variances):
        return np.full(bends.shape[1], BENDS[0])
    spread = 1.0 + np.outer(BENDS, variances)
    noise = np.maximum((bends**2).T @ (1.0 / spread).T, np.finfo(float).tiny)  # sensors, bends; times freedom
    return BENDS[np.argmin(len(variances) * np.log(noise) + np.log(spread).sum(axis=1), axis=1)]
