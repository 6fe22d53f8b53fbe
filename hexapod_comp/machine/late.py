"""Parts that follow a thermometer late, or run ahead of it: one sensor for all, or a sensor on a part's skin.

A part grows by a·s + Σ b_k·d_k. Here s is what its thermometer reads above 20 °C; F_k is s through a first-order lag
of time constant τ_k, and d_k = F_k − s says how far it is behind. At rest d_k = 0 and a is the part's expansion. With
b_k = a the part follows with τ_k; with b_k below zero it runs ahead, as struts do of a base that they warm. Whatever
one source warms through first-order lags can be written so: with time constants T of the sensor and τ of the part,
the part's share that comes late is b = a·(1 − T/τ). The growth is linear in a and b_k for given time constants.

A sensor is taken to run in a straight line from one reading to the next; that is exact, causal, and the same for a
fit as for a compensator. Before the first reading nothing is known of it: the part counts as at rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ..errors import ModelError
from .geometry import STRUT_NAMES

PARTS = (*STRUT_NAMES, "base", "platform")
"""What has a temperature, in the order of every array of eight."""

MOST_TIME_CONSTANTS = 2
"""A machine that warms shows a fast and a slow one; more cannot be told apart."""

TIME_CONSTANT_RANGE = (10.0, 1e6)
"""Time constants outside this, s, are a sensor's noise, or a building's seasons."""

REST = 3.0
"""After so many time constants a twentieth is left of what a first reading did not know."""


def _nothing() -> np.ndarray:
    return np.zeros((len(PARTS), 0))


@dataclass(frozen=True)
class LateGrowth:
    """How the parts of a machine follow their thermometers."""

    time_constants: tuple[float, ...] = ()  # τ_k, s, increasing; none, one or two
    # (8, time constants): b_k of struts 1–6, base, platform, 1/K
    expansion: np.ndarray = field(default_factory=_nothing)
    thermometer: str = ""  # The part whose sensor stands for all; empty: each part has its own

    def __post_init__(self) -> None:
        constants = tuple(float(value) for value in self.time_constants)
        low, high = TIME_CONSTANT_RANGE
        increasing = all(a < b for a, b in pairwise(constants))
        if len(constants) > MOST_TIME_CONSTANTS or not increasing or not all(low <= c <= high for c in constants):
            allowed = f"must be at most {MOST_TIME_CONSTANTS}, increasing, each {low:g}…{high:g} s"
            raise ModelError("thermal.time_constants", allowed, list(constants))
        expansion = np.array(self.expansion, dtype=float)
        if expansion.shape != (len(PARTS), len(constants)) or not np.isfinite(expansion).all():
            allowed = f"must be finite, one of each part for each of {len(constants)} time constants, 1/K"
            raise ModelError("thermal.late", allowed, expansion.tolist())
        if self.thermometer not in ("", *PARTS):
            raise ModelError("thermal.thermometer", f"must be one of {', '.join(PARTS)}", self.thermometer)
        expansion.flags.writeable = False
        object.__setattr__(self, "time_constants", constants)
        object.__setattr__(self, "expansion", expansion)

    def sensor_of(self, part: int) -> int:
        """Return the index of the part whose thermometer stands for a part."""
        return PARTS.index(self.thermometer) if self.thermometer else part


AT_ONCE = LateGrowth()
"""Every part has a thermometer of its own and follows it at once."""


@dataclass
class Lag:
    """How far a thermometer's late followers are behind it."""

    began: float  # Time of the first reading and of the newest one, s
    newest: float  # Time of the first reading and of the newest one, s
    behind: list[float]  # d_k, K

    def take(self, change: float, time: float, time_constants: Sequence[float]) -> None:
        """Take a reading that differs from the last one by a `change`, K, at a time, s."""
        elapsed = max(0.0, time - self.newest)
        self.newest = max(self.newest, time)
        for k, constant in enumerate(time_constants):
            self.behind[k] = followed(self.behind[k], change, elapsed / constant)


def followed(behind: float, change: float, ages: float) -> float:
    """Return how far a first-order lag is behind after its input has run by `change` in `ages` time constants."""
    gone = -math.expm1(-ages)
    kept = gone / ages if ages > 0.0 else 1.0
    return behind * (1.0 - gone) - change * kept


def late(times: np.ndarray, values: np.ndarray, time_constants: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return how far lags are behind at each reading of some thermometers, K."""
    constants, order = np.asarray(time_constants, dtype=float), np.argsort(times, kind="stable")
    changes, elapsed = np.diff(values[order], axis=0), np.diff(times[order])
    ages = elapsed[:, None] / constants
    gone = -np.expm1(-ages)
    shares = np.divide(gone, ages, out=np.ones_like(ages), where=ages > 0.0)
    behind = np.zeros((len(times), values.shape[1], len(constants)))
    now = behind[0]
    for n, (change, left, share) in enumerate(zip(changes, 1.0 - gone, shares, strict=True), start=1):
        now = now * left - change[:, None] * share
        behind[n] = now
    result = np.empty_like(behind)
    result[order] = behind
    return result
