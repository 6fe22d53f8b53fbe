"""Temperature readings of a machine's parts, thermal growth with a delay, and the humidity that makes struts swell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ..core import dtype_of, lib
from ..errors import ModelError
from .limits import STRUT_NAMES
from .terms import term

PARTS = (*STRUT_NAMES, "base", "platform")  # Parts that have a temperature; arrays of eight values have this order
# Readings of a warming machine distinguish at most a fast and a slow time constant
MOST_TIME_CONSTANTS = dtype_of("hc_late")["time_constants"].shape[0]
# Smallest and largest time constant, s: shorter constants fit sensor noise, longer constants the seasons
TIME_CONSTANT_RANGE = (10.0, 1e6)
REST = 3.0  # Number of time constants after which an unknown lag at the start has decayed to 5 %
STEEL = 11.5e-6  # Thermal expansion of steel, 1/K
EXPANSION = 1e-3  # Largest thermal expansion of a machine's part, 1/K: five times that of soft plastics


@dataclass(frozen=True)
class LateGrowth:
    """How the thermal growth of a machine's parts lags behind the readings of their thermometers."""

    time_constants: tuple[float, ...] = term("thermal", "s", "time constants of delayed growth: at most two", (None,))
    expansion: np.ndarray = term(  # (8, time constants): a row for each of struts 1–6, base, platform
        "thermal",
        "ppm_per_K",
        "delayed expansion of each strut (a row each), of base and platform, for each time constant",
        "6 × n, n, n",
        np.zeros((len(PARTS), 0)),
        "late_struts, late_base, late_platform",
        largest=EXPANSION,
    )
    thermometer: str = ""  # the part whose sensor represents all parts; empty: each part has its own sensor

    def __post_init__(self) -> None:
        constants = tuple(float(value) for value in self.time_constants)
        low, high = TIME_CONSTANT_RANGE
        increasing = all(a < b for a, b in pairwise(constants))
        if len(constants) > MOST_TIME_CONSTANTS or not increasing or not all(low <= c <= high for c in constants):
            allowed = f"must be at most {MOST_TIME_CONSTANTS} increasing numbers, each {low:g}…{high:g} s"
            raise ModelError("thermal.time_constants", allowed, list(constants))
        expansion = np.array(self.expansion, dtype=float)
        if expansion.shape != (len(PARTS), len(constants)) or not np.isfinite(expansion).all():
            allowed = f"must give each part one finite value, 1/K, for each of {len(constants)} time constants"
            raise ModelError("thermal.late", allowed, expansion.tolist())
        if self.thermometer not in ("", *PARTS):
            raise ModelError("thermal.thermometer", f"must be one of {', '.join(PARTS)}", self.thermometer)
        object.__setattr__(self, "time_constants", constants)
        object.__setattr__(self, "expansion", expansion)

    def sensor_of(self, part: int) -> int:
        """Return the index in `PARTS` of the part whose sensor gives the temperature of the part with index `part`."""
        return PARTS.index(self.thermometer) if self.thermometer else part


AT_ONCE = LateGrowth()  # Every part has a sensor of its own, and grows without delay


@dataclass
class Lag:
    """A part's delayed temperature minus the reading of the part's sensor, for each time constant."""

    began: float  # time of the first reading, s
    newest: float  # time of the newest reading, s
    behind: list[float]  # delayed temperature − reading for each time constant, K


def thermal_lags(times: np.ndarray, values: np.ndarray, time_constants: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return delayed temperature − reading, K, at the times, s, of N readings; shape (N, parts, time constants)."""
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


REFERENCE_TEMPERATURE = lib.REFERENCE_TEMPERATURE  # °C, at which the lengths in geometry and model are true (ISO 1)
# Readings outside this range, °C, are refused: no machine shop has them
TEMPERATURE_RANGE = lib.LOWEST_TEMPERATURE, lib.HIGHEST_TEMPERATURE
HUMIDITY = "humidity"  # Name of the air's relative humidity among a machine's readings
REFERENCE_HUMIDITY = lib.REFERENCE_HUMIDITY  # Fraction, at which the lengths in geometry and model are true
# Readings of relative humidity outside this range are refused: they are probably percent, or the 0 of a broken sensor
HUMIDITY_RANGE = lib.LOWEST_HUMIDITY, 1.0


@dataclass(frozen=True)
class Sensed:
    """A quantity that a sensor reads: temperature or relative humidity."""

    title: str  # name for messages; ``{}`` is replaced by the sensor's name
    reference: float  # value used before the first reading
    range: tuple[float, float]  # smallest and largest accepted reading
    allowed: str  # `range` as text
    unit: str = ""  # unit of a reading, as text with a space before it
    difference: str = ""  # unit of the difference between two readings, as text with a space before it


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
    return RELATIVE_HUMIDITY if name == HUMIDITY else TEMPERATURE


def check_part(name: str) -> None:
    if name not in PARTS:
        raise ModelError("temperature", f"the measured part must be one of {', '.join(PARTS)}", name)


def valid_reading(name: str, value: float) -> float:
    """Return a sensor's reading, °C or a fraction (humidity), as float; raise ModelError if it is out of range."""
    if name != HUMIDITY:
        check_part(name)
    quantity = quantity_of(name)
    low, high = quantity.range
    if not low <= value <= high:
        raise ModelError(quantity.title.format(name), f"must lie within {quantity.allowed}", value)
    return float(value)


class Temperatures:
    """Newest readings of temperatures, °C, and of the air's humidity; before the first reading, 20 °C and 50 %.

    Attributes
    ----------
    values : dict of str to float
        Readings by the names ``strut_1`` … ``strut_6``, ``base``, ``platform``, °C, and ``humidity``, a fraction.
    lags : dict of str to Lag
        By sensor, the lag of the delayed growth behind the reading; a sensor without an entry has no lag.
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
        """Rebuild the temperatures from a :meth:`snapshot`, for a model with this number of time constants."""
        for name, numbers in lags.items():
            if name not in values or len(numbers) != 2 + time_constants:
                raise ModelError(f"snapshot.lags.{name}", f"must be {2 + time_constants} numbers", list(numbers))
        return cls(values, {name: Lag(began, newest, behind) for name, (began, newest, *behind) in lags.items()})

    def snapshot(self) -> dict[str, dict[str, Any]]:
        """Return ``temperatures``, °C, and ``lags`` by sensor; a lag is a list: `began`, `newest`, all of `behind`."""
        lags = {name: [lag.began, lag.newest, *lag.behind] for name, lag in self.lags.items()}
        return {"temperatures": dict(self.values), "lags": lags}

    def unknown_for(self, late_growth: LateGrowth, time: float) -> float:
        """Return for how many seconds after `time` the delayed growth stays uncertain.

        The temperatures before the first reading are not known, so the lag is assumed to be zero at the first reading.
        The error of the assumed lag of zero decays within three times the longest time constant.
        """
        begun = [lag.began for name, lag in self.lags.items() if late_growth.thermometer in ("", name)]
        if not begun or not late_growth.time_constants:
            return 0.0
        return max(0.0, max(begun) + REST * late_growth.time_constants[-1] - time)

    def set(self, name: str, value: float) -> None:
        """Store a sensor's reading that has no time stamp; the sensor's lag stays unchanged."""
        self.values[name] = valid_reading(name, value)

    def at(self, name: str) -> float:
        """Return the newest reading of a temperature, °C, or of the humidity; before any reading, 20 °C or 0.5."""
        return self.values.get(name, quantity_of(name).reference)
