"""Validation and low-pass filter of temperature and humidity readings.

A machine warms over minutes, but readings are noisy: without a filter, noise of ±0.05 K moves the command of a steel
strut of 0.5 m by ±0.3 µm at every reading, and a single wrong reading of 119 °C moves it by 0.6 mm.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

from ..errors import ModelError
from ..machine.temperatures import HUMIDITY, REFERENCE_TEMPERATURE, Temperatures, quantity_of, valid_reading
from .guards import RateLimit

# Time constant of the filter, s. With one reading per second, the filtered value has an eighth of the readings' noise.
# It lags by 30 s; while the temperature rises by 1 K in half an hour, the filtered value is 1/60 K too low.
DEFAULT_TIME_CONSTANT = 30.0

# Allowed jump between two readings of a temperature, K, and of humidity, a fraction: noise, and the last digit's step
JITTER, HUMIDITY_JITTER = 1.0, 0.05

HUMIDITY_RATE = 0.02  # Fastest change of a workshop's relative humidity, 1/s (2 % per second, when a gate is opened)


@dataclass
class _Mean:
    value: float
    weight: float  # sum of the weights that the readings have at the time `newest`
    newest: float  # time of the newest reading, s


class TemperatureFilter:
    """A first-order low pass of each sensor: the mean of the readings with the weights exp(−age / time constant).

    No initial value is needed: until one time constant has passed, the readings have nearly equal weights. With a time
    constant of 0 s, the mean is the newest reading.
    """

    def __init__(self, time_constant: float = DEFAULT_TIME_CONSTANT) -> None:
        if not 0.0 <= time_constant < math.inf:
            raise ModelError("temperature_time_constant", "must be finite and not negative, s", time_constant)
        self.time_constant = float(time_constant)
        self._means: dict[str, _Mean] = {}

    def update(self, name: str, value: float, time: float) -> float:
        """Add a reading (°C; humidity: a fraction) and return the weighted mean of all readings.

        `time`, s, is the reading's time on a monotonic clock; on a clock that was set back, readings would seem old and
        get small weights. Raise a ModelError if `time` is not finite or :func:`.valid_reading` rejects the reading; a
        rejected reading changes nothing.
        """
        reading = valid_reading(name, value)
        if not math.isfinite(time):
            raise ModelError(f"time of the {quantity_of(name).title.format(name)}", "must be finite, s", time)
        mean = self._means.get(name)
        if mean is None or self.time_constant == 0.0:
            mean = self._means[name] = _Mean(reading, 1.0, time)
            return mean.value
        later = (time - mean.newest) / self.time_constant
        share = math.exp(min(later, 0.0))
        mean.weight = mean.weight * math.exp(min(-later, 0.0)) + share
        mean.value += (reading - mean.value) * share / mean.weight
        mean.newest = max(mean.newest, time)
        return mean.value


@dataclass(frozen=True)
class Plausibility:
    """Limits of plausible readings; 0 switches a limit off."""

    rate: float  # fastest change of one part's temperature, K/s; the RateLimit also allows a jump by JITTER
    spread: float  # largest difference, K, from the median of the other parts, or from 20 °C if no other part is known
    # Time without an accepted reading after which a sensor is stale, s: its last reading stays in use, but the readings
    # of other parts are not compared with it
    timeout: float
    humidity_rate: float = HUMIDITY_RATE  # fastest change of humidity, 1/s; a jump by HUMIDITY_JITTER is allowed


class Thermometers:
    """Filter of the temperatures of a machine's parts and of the air's humidity that rejects implausible readings."""

    def __init__(self, rules: Plausibility, time_constant: float = DEFAULT_TIME_CONSTANT) -> None:
        self._filter, self._limits = TemperatureFilter(time_constant), dict[str, RateLimit]()
        self.follow(rules, time_constant)

    def follow(self, rules: Plausibility, time_constant: float) -> None:
        """Set the rules of plausibility and the filter's time constant, s."""
        self._rules, self._filter.time_constant = rules, time_constant

    def update(self, name: str, value: float, time: float) -> float:
        """Add a reading (°C; humidity: a fraction) that was made at `time`, s, and return the filtered value.

        Raise a ModelError if the reading is invalid, changes faster than the rules allow, or differs from the other
        parts' median by more than `spread`; the rejected reading changes nothing.
        """
        reading, rules = valid_reading(name, value), self._rules
        limit = self._limits.get(name) or RateLimit(HUMIDITY_JITTER if name == HUMIDITY else JITTER, 0.0)
        limit.rate = rules.humidity_rate if name == HUMIDITY else rules.rate
        excess, quantity = limit.excess((reading,), time) if limit.rate else None, quantity_of(name)
        if excess is not None and limit.last is not None:
            way = f"from {limit.last[0]:.2f} to {reading:.2f}{quantity.unit} in {time - limit.at:.1f} s"
            problem = f"has jumped {way}, allowed {excess.allowed:.3g}{quantity.difference}"
            raise ModelError(quantity.title.format(name), problem)
        left_out = {name, HUMIDITY, *self.stale(time)}
        others = [one.last[0] for part, one in self._limits.items() if part not in left_out and one.last]
        middle = statistics.median(others or [REFERENCE_TEMPERATURE])
        if name != HUMIDITY and 0.0 < rules.spread < (off := abs(reading - middle)):
            whose = f"the other parts' {middle:.2f} °C" if others else f"{middle:g} °C, and no other part is known"
            problem = f"reads {reading:.2f} °C, {off:.1f} K from {whose}; allowed {rules.spread:g} K"
            raise ModelError(f"temperature of {name}", problem)
        mean = self._filter.update(name, reading, time)
        limit.accept((reading,), time)
        self._limits[name] = limit
        return mean

    def stale(self, time: float) -> tuple[str, ...]:
        """Return the parts (and ``humidity``) whose last accepted reading is older than `timeout` at `time`, s."""
        timeout, limits = self._rules.timeout, self._limits
        known = (name for name in (*Temperatures.NAMES, HUMIDITY) if name in limits)
        return tuple(name for name in known if 0.0 < timeout < time - limits[name].at)
