"""Temperatures of a machine's parts, what follows them late, and the humidity by which struts swell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ..errors import ModelError
from .limits import STRUT_NAMES
from .terms import term

PARTS = (*STRUT_NAMES, "base", "platform")  # What has a temperature, in the order of every array of eight
MOST_TIME_CONSTANTS = 2  # A machine that warms shows a fast and a slow one; more cannot be distinguished
TIME_CONSTANT_RANGE = (10.0, 1e6)  # Time constants outside this, s, are a sensor's noise, or a building's seasons
REST = 3.0  # time constants after which a twentieth of an unknown initial state is left
EXPANSION = 1e-3  # Largest expansion that a machine's part may have, 1/K: five times that of soft plastics


@dataclass(frozen=True)
class LateGrowth:
    """How the parts of a machine follow their thermometers."""

    # τ_k, a tuple; late growth has b_k of struts 1–6, base and platform as rows (8, time constants)
    time_constants: tuple[float, ...] = term("thermal", "s", "how late parts follow: none, one or two", (None,))
    expansion: np.ndarray = term(
        "thermal", "ppm_per_K", "what of a part's growth comes so late", (8, None), key="late", largest=EXPANSION
    )
    thermometer: str = ""  # The part whose sensor represents all parts; empty: each part has its own

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


AT_ONCE = LateGrowth()  # Every part has a thermometer of its own and follows it at once


@dataclass
class Lag:
    """By how much the parts that follow a thermometer late lag behind it."""

    began: float  # Time of the first reading and of the newest one, s
    newest: float  # Time of the first reading and of the newest one, s
    behind: list[float]  # d_k, K

    def add(self, change: float, time: float, time_constants: Sequence[float]) -> None:
        """Add a reading that differs from the last one by a `change`, K, at a time, s."""
        elapsed = max(0.0, time - self.newest)
        self.newest = max(self.newest, time)
        for k, constant in enumerate(time_constants):
            self.behind[k] = followed(self.behind[k], change, elapsed / constant)


def followed(behind: float, change: float, ages: float) -> float:
    """Return by how much a first-order lag trails an input that has ramped by `change` within `ages` time constants."""
    gone = -math.expm1(-ages)
    kept = gone / ages if ages > 0.0 else 1.0
    return behind * (1.0 - gone) - change * kept


def late(times: np.ndarray, values: np.ndarray, time_constants: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return by how much first-order lags trail some thermometers at each of their readings, K."""
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


REFERENCE_TEMPERATURE = 20.0  # Temperature at which geometry and model hold, °C (ISO 1)
TEMPERATURE_RANGE = (-40.0, 120.0)  # Sensor readings outside this, °C, are not a machine shop's
HUMIDITY = "humidity"  # Name of the air's relative humidity among a machine's readings
REFERENCE_HUMIDITY = 0.5  # Relative humidity at which geometry and model hold, a fraction
# Relative humidity outside this is not a machine shop's: percent for a fraction, a fraction for percent, or a broken
# sensor's zero
HUMIDITY_RANGE = (0.01, 1.0)


@dataclass(frozen=True)
class Sensed:
    """What a sensor reads."""

    title: str  # For messages; ``{}`` stands for the sensor's name
    reference: float  # value before the first reading
    range: tuple[float, float]  # Readings outside are refused
    allowed: str  # The same for people
    unit: str = ""  # Unit of a reading, and of a difference of two, after a space
    difference: str = ""  # Unit of a reading, and of a difference of two, after a space


TEMPERATURE = Sensed(
    "temperature of {}",
    REFERENCE_TEMPERATURE,
    TEMPERATURE_RANGE,
    "{:g}…{:g} °C".format(*TEMPERATURE_RANGE),
    " °C",
    " K",
)
RELATIVE_HUMIDITY = Sensed(
    HUMIDITY, REFERENCE_HUMIDITY, HUMIDITY_RANGE, "{:g}…{:g}, as a fraction".format(*HUMIDITY_RANGE)
)


def quantity_of(name: str) -> Sensed:
    """Return what the sensor of a name reads."""
    return RELATIVE_HUMIDITY if name == HUMIDITY else TEMPERATURE


def check_part(name: str) -> None:
    """Raise ModelError on what is no name of a part that has a temperature."""
    if name not in PARTS:
        raise ModelError("temperature", f"must be of one of {', '.join(PARTS)}", name)


class Temperatures:
    """Temperatures of struts, base and platform, °C, and the air's humidity; without a reading 20 °C, 50 %.

    Attributes
    ----------
    values : dict of str to float
        Readings by ``strut_1`` … ``strut_6``, ``base``, ``platform``, °C; ``humidity``, a fraction.
    lags : dict of str to Lag
        How far what follows each of them is behind; whatever is not here is at rest.
    """

    NAMES = PARTS

    def __init__(self, readings: Mapping[str, float] | None = None, lags: Mapping[str, Lag] | None = None) -> None:
        self.values: dict[str, float] = {}
        for name, value in (readings or {}).items():
            self.set(name, value)
        self.lags: dict[str, Lag] = dict(lags or {})

    @classmethod
    def restored(
        cls, values: Mapping[str, float], lags: Mapping[str, Sequence[float]], time_constants: int
    ) -> Temperatures:
        """Return the layout of a :meth:`snapshot` for a model with that number of time constants."""
        for name, numbers in lags.items():
            if name not in values or len(numbers) != 2 + time_constants:
                raise ModelError(f"snapshot.lags.{name}", f"must be {2 + time_constants} numbers", list(numbers))
        return cls(values, {name: Lag(began, newest, behind) for name, (began, newest, *behind) in lags.items()})

    def snapshot(self) -> dict[str, dict[str, Any]]:
        """Return ``temperatures``, °C, and ``lags``: began and newest, s, and how far behind, K; each by name."""
        lags = {name: [lag.began, lag.newest, *lag.behind] for name, lag in self.lags.items()}
        return {"temperatures": dict(self.values), "lags": lags}

    def follow(self, name: str, value: float, time: float, time_constants: tuple[float, ...]) -> None:
        """Set a reading made at a time, s, on a monotonic clock; late parts follow.

        At the first reading late parts are assumed at rest.
        """
        before = self.at(name)
        late_parts = bool(time_constants) and name != HUMIDITY
        if late_parts and not math.isfinite(time):
            raise ModelError(f"time of the temperature of {name}", "must be finite, s: the model has time constants")
        self.set(name, value)
        if name in self.lags:
            self.lags[name].add(self.values[name] - before, time, time_constants)
        elif late_parts:
            self.lags[name] = Lag(time, time, [0.0] * len(time_constants))

    def unknown_for(self, late_growth: LateGrowth, time: float) -> float:
        """Return for how long, s, late parts are still not known at a `time`, s, because readings began too recently.

        At the first reading they are assumed at rest; the error of this assumption has decayed after three time
        constants.
        """
        begun = [lag.began for name, lag in self.lags.items() if late_growth.thermometer in ("", name)]
        if not begun or not late_growth.time_constants:
            return 0.0
        return max(0.0, max(begun) + REST * late_growth.time_constants[-1] - time)

    def set(self, name: str, value: float) -> None:
        """Set a reading without a time: late parts keep their lag."""
        if name != HUMIDITY:
            check_part(name)
        quantity = quantity_of(name)
        low, high = quantity.range
        if not low <= value <= high:
            raise ModelError(quantity.title.format(name), f"must lie within {quantity.allowed}", value)
        self.values[name] = float(value)

    def at(self, name: str) -> float:
        """Return a temperature, °C, or the humidity."""
        return self.values.get(name, quantity_of(name).reference)
