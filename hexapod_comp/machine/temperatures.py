"""Temperatures of a machine's parts, what follows them late, and the humidity by which struts swell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import ModelError
from .late import PARTS, REST, Lag, LateGrowth

REFERENCE_TEMPERATURE = 20.0
"""Temperature at which geometry and model hold, °C (ISO 1)."""

TEMPERATURE_RANGE = (-40.0, 120.0)
"""Sensor readings outside this, °C, are not a machine shop's."""

HUMIDITY = "humidity"
"""Name of the air's relative humidity among a machine's readings."""

REFERENCE_HUMIDITY = 0.5
"""Relative humidity at which geometry and model hold, a fraction."""

HUMIDITY_RANGE = (0.01, 1.0)
"""Relative humidity outside this is not a machine shop's: percent for a fraction, a fraction for percent, or a broken
sensor's zero."""


@dataclass(frozen=True)
class Sensed:
    """What a sensor reads."""

    title: str  # For messages; ``{}`` stands for the sensor's name
    reference: float  # What counts while nobody has told
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
    """Temperatures of struts, base and platform, °C, and the air's humidity; of what nobody has told: 20 °C, 50 %.

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
        """Return what a :meth:`snapshot` holds, for a model with so many time constants."""
        for name, numbers in lags.items():
            if name not in values or len(numbers) != 2 + time_constants:
                raise ModelError(f"snapshot.lags.{name}", f"must be {2 + time_constants} numbers", list(numbers))
        return cls(values, {name: Lag(began, newest, behind) for name, (began, newest, *behind) in lags.items()})

    def snapshot(self) -> dict[str, dict[str, Any]]:
        """Return ``temperatures``, °C, and ``lags``: began and newest, s, and how far behind, K; each by name."""
        lags = {name: [lag.began, lag.newest, *lag.behind] for name, lag in self.lags.items()}
        return {"temperatures": dict(self.values), "lags": lags}

    def follow(self, name: str, value: float, time: float, time_constants: tuple[float, ...]) -> None:
        """Take a reading made at a time, s, on a clock that is never set; late parts follow.

        The first reading finds its followers at rest: what was before nobody knows.
        """
        before = self.at(name)
        late_parts = bool(time_constants) and name != HUMIDITY
        if late_parts and not math.isfinite(time):
            raise ModelError(f"time of the temperature of {name}", "must be finite, s: the model has time constants")
        self.set(name, value)
        if name in self.lags:
            self.lags[name].take(self.values[name] - before, time, time_constants)
        elif late_parts:
            self.lags[name] = Lag(time, time, [0.0] * len(time_constants))

    def unknown_for(self, late_growth: LateGrowth, time: float) -> float:
        """Return for how long, s, late parts are still not known at a `time`, s: the readings began too short ago.

        A first reading finds them at rest. What it did not know is forgotten after three time constants.
        """
        begun = [lag.began for name, lag in self.lags.items() if late_growth.thermometer in ("", name)]
        if not begun or not late_growth.time_constants:
            return 0.0
        return max(0.0, max(begun) + REST * late_growth.time_constants[-1] - time)

    def set(self, name: str, value: float) -> None:
        """Take a reading, whenever it was made: late parts stay as far behind as they are."""
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

    def above_reference(self, name: str) -> float:
        """Return the difference to 20 °C, K, or to 50 %."""
        return self.at(name) - quantity_of(name).reference
