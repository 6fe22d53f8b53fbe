"""Temperature readings made smooth: a machine warms over minutes, a sensor jitters from one second to the next.

Unfiltered, a sensor that reads ±0.05 K moves a steel strut of 0.5 m by ±0.3 µm at every reading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import ModelError
from ..machine.model import Temperatures

DEFAULT_TIME_CONSTANT = 30.0
"""Time constant of the filter, s: of a reading a second an eighth of the noise is left, and the drift is
followed 30 s late, by 1/60 K when it is 1 K in half an hour."""


@dataclass
class _Mean:
    """Weighted mean of a sensor's readings, °C, the sum of their weights, and the time of the newest, s."""

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
        """Take a reading and return the mean, °C.

        Parameters
        ----------
        name : str
            ``strut_1`` … ``strut_6``, ``base`` or ``platform``.
        value : float
            Reading, °C.
        time : float
            When it was taken, s, on a clock that is never set: a clock put back makes all that follows late.

        Raises
        ------
        ModelError
            As :meth:`~hexapod_comp.machine.model.Temperatures.set`, or a time that is not finite. Nothing was taken.
        """
        reading = Temperatures({name: value}).values[name]
        if not math.isfinite(time):
            raise ModelError(f"time of the temperature of {name}", "must be finite, s", time)
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
