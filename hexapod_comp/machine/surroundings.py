"""Temperatures, humidity and load at each station, and a key by which stations with equal ones are grouped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .arrays import different_rows
from .load import Payload
from .model import RealMachine
from .temperatures import HUMIDITY, PARTS, REFERENCE_TEMPERATURE, Lag, Temperatures, late

# Load that is not known: NaN, the mass and centre of the tool in use, and the model's gravity
NO_LOAD = (math.nan,) * 7


def load_row(payload: Payload, gravity: Sequence[float] = NO_LOAD[4:]) -> tuple[float, ...]:
    """Return a payload under gravity, m/s² in base, by default the model's, as a row of :attr:`Surroundings.loads`."""
    return (payload.mass, *payload.centre, *gravity)


@dataclass(frozen=True)
class Surroundings:
    """What acted on the machine at N places; two places with a difference in any of these fields are two stations."""

    temperatures: np.ndarray  # (N, 8): struts 1–6, base, platform, °C
    times: np.ndarray  # (N,): when these were read, s; NaN where that is not known
    humidity: np.ndarray  # (N,): relative humidity of the air, a fraction; NaN where that is not known
    loads: np.ndarray  # (N, 7): mass, kg, its centre in platform, m, and gravity in base, m/s²; NaN: as usual

    @staticmethod
    def usual(count: int) -> Surroundings:
        """Return 20 °C, and everything else not known, at a number of places."""
        unknown = np.full(count, np.nan)
        warmth = np.full((count, len(PARTS)), REFERENCE_TEMPERATURE)
        return Surroundings(warmth, unknown, unknown, np.tile(NO_LOAD, (count, 1)))

    def numbers(self) -> np.ndarray:
        """Return all fields but the times, one row per place, as bits, by which NaN equals NaN."""
        rows = np.column_stack([value for name, value in vars(self).items() if name != "times"])
        return np.ascontiguousarray(rows, dtype=float).view(np.int64)

    def machines(self, machine: RealMachine) -> list[RealMachine]:
        """Return the machine at each place; places at which the same acts on it share one."""
        model, count = machine.model, len(self.times)
        usual = Surroundings.usual(count)
        around = Surroundings(
            temperatures=self.temperatures if machine.warms else usual.temperatures,
            times=self.times,
            humidity=self.humidity if model.struts.moisture.any() else usual.humidity,
            loads=self.loads if machine.bends else usual.loads,
        )
        constants, lags = model.late_growth.time_constants, np.zeros((count, len(PARTS), 0))
        if constants and np.isfinite(self.times).all():
            lags = late(self.times, self.temperatures, constants)
        bits = np.hstack([around.numbers(), np.ascontiguousarray(lags.reshape(count, -1)).view(np.int64)])
        first, number = different_rows(bits)
        different = []
        for n in first.tolist():
            readings = dict(zip(PARTS, around.temperatures[n].tolist(), strict=True))
            if math.isfinite(around.humidity[n]):
                readings[HUMIDITY] = float(around.humidity[n])
            behind = {name: Lag(math.nan, math.nan, row) for name, row in zip(PARTS, lags[n].tolist(), strict=True)}
            mass, x, y, z, *gravity = around.loads[n].tolist()
            payload = None if math.isnan(mass) else Payload(mass, (x, y, z))
            now = Temperatures(readings, behind if lags.size else {})
            different.append(machine.at(now, payload, None if math.isnan(gravity[0]) else gravity))
        return [different[n] for n in number.tolist()]
