"""Readings of temperature and humidity judged and made smooth: a machine warms over minutes, a sensor jitters.

Unfiltered, a sensor that reads ±0.05 K moves a steel strut of 0.5 m by ±0.3 µm at every reading; one that reads 119 °C
once moves it by 0.6 mm.
"""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

from ..errors import ModelError
from ..machine.temperatures import HUMIDITY, REFERENCE_TEMPERATURE, Temperatures, quantity_of

DEFAULT_TIME_CONSTANT = 30.0
"""Time constant of the filter, s: of a reading a second an eighth of the noise is left, and the drift is
followed 30 s late, by 1/60 K when it is 1 K in half an hour."""


@dataclass
class _Mean:
    """Weighted mean of a sensor's readings, the sum of their weights, and the time of the newest, s."""

    value: float
    weight: float
    newest: float


class TemperatureFilter:
    """Mean of each sensor's readings, every reading weighted by exp(−age / time constant).

    On regular readings that is a first-order low pass. Being a mean, it needs no initial value and no special
    cases: the first readings count alike, until the time constant has passed; after a gap of several time constants
    what was before counts for nothing, and it starts anew; a reading that comes late, or out of order, counts
    for as much as it would have by now.

    Parameters
    ----------
    time_constant : float
        s; 0 lets every reading through as it is.

    Raises
    ------
    ModelError
        The time constant is negative or not finite.
    """

    def __init__(self, time_constant: float = DEFAULT_TIME_CONSTANT) -> None:
        if not 0.0 <= time_constant < math.inf:
            raise ModelError("temperature_time_constant", "must be finite and not negative, s", time_constant)
        self.time_constant = float(time_constant)
        self._means: dict[str, _Mean] = {}

    def take(self, name: str, value: float, time: float) -> float:
        """Take a reading and return the mean.

        Parameters
        ----------
        name : str
            ``strut_1`` … ``strut_6``, ``base``, ``platform`` or ``humidity``.
        value : float
            Reading, °C; of humidity a fraction.
        time : float
            When it was taken, s, on a clock that is never set: a clock put back makes all that follows late.

        Raises
        ------
        ModelError
            As :meth:`.Temperatures.set`, or a time that is not finite; nothing was taken.
        """
        reading = Temperatures({name: value}).values[name]
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


JITTER, HUMIDITY_JITTER = 1.0, 0.05
"""Two readings of a sensor may differ by this at once, K or a fraction: noise, and the last digit of a coarse one."""

HUMIDITY_RATE = 0.02
"""Fastest change of a shop's humidity, 1/s: a gate that opens."""


@dataclass(frozen=True)
class Plausibility:
    """What counts as a machine's temperature; 0 switches a rule off.

    Parameters
    ----------
    rate : float
        Fastest change of one part, K/s, beyond :data:`JITTER`. What is further from the part's last good reading is
        refused until so much time has passed that the part may have got there.
    spread : float
        Largest difference, K, to the median of all other parts' readings; to 20 °C where none is known: that is
        where parts that nobody has measured count as being.
    timeout : float
        A part without a good reading for longer, s, is stale: its last one stays in use, but is no neighbour's measure.
        The same of humidity.
    humidity_rate : float
        As `rate`, of the relative humidity, 1/s, beyond :data:`HUMIDITY_JITTER`.
    """

    rate: float
    spread: float
    timeout: float
    humidity_rate: float = HUMIDITY_RATE


class Thermometers:
    """The temperatures of a machine's parts, and the air's humidity: readings that are plausible, smoothed.

    Parameters
    ----------
    rules : Plausibility
        What is taken.
    time_constant : float
        Of the :class:`TemperatureFilter`, s.
    """

    def __init__(self, rules: Plausibility, time_constant: float = DEFAULT_TIME_CONSTANT) -> None:
        self._rules, self._filter = rules, TemperatureFilter(time_constant)
        self._last: dict[str, tuple[float, float]] = {}

    def follow(self, rules: Plausibility, time_constant: float) -> None:
        """Take other rules and another time constant, s, from the next reading on."""
        self._rules, self._filter.time_constant = rules, time_constant

    def take(self, name: str, value: float, time: float) -> float:
        """Take a reading and return what counts from now on; arguments and errors as those of the filter.

        Raises
        ------
        ModelError
            Also where it has jumped, or does not fit the other parts; nothing was taken.
        """
        reading = Temperatures({name: value}).values[name]
        self._check_rate(name, reading, time)
        self._check_spread(name, reading, time)
        mean = self._filter.take(name, reading, time)
        self._last[name] = reading, time
        return mean

    def stale(self, time: float) -> tuple[str, ...]:
        """Return the parts, and ``humidity``, that no longer tell, at a time, s."""
        return tuple(
            name for name in (*Temperatures.NAMES, HUMIDITY) if name in self._last and self._is_stale(name, time)
        )

    def _is_stale(self, name: str, time: float) -> bool:
        return 0.0 < self._rules.timeout < time - self._last[name][1]

    def _check_rate(self, name: str, reading: float, time: float) -> None:
        of_air = name == HUMIDITY
        rate, jitter = (self._rules.humidity_rate, HUMIDITY_JITTER) if of_air else (self._rules.rate, JITTER)
        if name not in self._last or not rate:
            return
        last, then = self._last[name]
        allowed = jitter + rate * max(0.0, time - then)
        if abs(reading - last) > allowed:
            quantity = quantity_of(name)
            way = f"from {last:.2f} to {reading:.2f}{quantity.unit} in {time - then:.1f} s"
            problem = f"has jumped {way}, allowed {allowed:.3g}{quantity.difference}"
            raise ModelError(quantity.title.format(name), problem)

    def _check_spread(self, name: str, reading: float, time: float) -> None:
        if name == HUMIDITY:
            return
        parts = ((other, last) for other, (last, _) in self._last.items() if other not in (name, HUMIDITY))
        others = [last for other, last in parts if not self._is_stale(other, time)]
        middle = statistics.median(others or [REFERENCE_TEMPERATURE])
        if 0.0 < self._rules.spread < abs(reading - middle):
            whose = f"the other parts' {middle:.2f} °C" if others else f"{middle:g} °C, and no other part is known"
            problem = (
                f"reads {reading:.2f} °C, {abs(reading - middle):.1f} K from {whose}; allowed {self._rules.spread:g} K"
            )
            raise ModelError(f"temperature of {name}", problem)
