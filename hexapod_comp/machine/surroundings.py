"""Temperatures, humidity and load at each pose of a measurement, and the real machine under these conditions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .arrays import different_rows
from .load import Payload
from .model import RealMachine
from .temperatures import HUMIDITY, PARTS, REFERENCE_TEMPERATURE, Lag, Temperatures, thermal_lags

NO_LOAD = (math.nan,) * 7  # Row of `loads` if no load was stated: the machine carries its tool in the model's gravity


def load_row(payload: Payload, gravity: Sequence[float] = NO_LOAD[4:]) -> tuple[float, ...]:
    """Return payload and gravity, m/s² in base, as a row of :attr:`Surroundings.loads`; NaN: the model's gravity."""
    return (payload.mass, *payload.centre, *gravity)


@dataclass(frozen=True)
class Surroundings:
    """Temperatures, humidity and load of the machine at each of N poses."""

    temperatures: np.ndarray  # (N, 8): struts 1–6, base, platform, °C
    times: np.ndarray  # (N,): time of the temperature readings at each pose, s; NaN if not known
    humidity: np.ndarray  # (N,): relative humidity of the air, a fraction; NaN if not known
    loads: np.ndarray  # (N, 7): payload mass, kg, its centre in platform, m, gravity in base, m/s²; NaN: NO_LOAD

    @staticmethod
    def usual(count: int) -> Surroundings:
        """Return surroundings at 20 °C for `count` poses; time, humidity and load are unknown."""
        unknown = np.full(count, np.nan)
        warmth = np.full((count, len(PARTS)), REFERENCE_TEMPERATURE)
        return Surroundings(warmth, unknown, unknown, np.tile(NO_LOAD, (count, 1)))

    @staticmethod
    def of(machine: RealMachine, count: int) -> Surroundings:
        """Return a machine's present temperatures, humidity and load, repeated for `count` poses; the times are NaN."""
        now, unknown = machine.temperatures, np.full(count, np.nan)
        warmth = np.tile([now.at(name) for name in PARTS], (count, 1))
        load = load_row(machine.geometry.payload, machine.loading.gravity or NO_LOAD[4:])
        return Surroundings(warmth, unknown, np.full(count, now.at(HUMIDITY)), np.tile(load, (count, 1)))

    def numbers(self) -> np.ndarray:
        """Return a row per pose: all values except `times`, as integers with the same bits, so that NaN equals NaN."""
        rows = np.column_stack([value for name, value in vars(self).items() if name != "times"])
        return np.ascontiguousarray(rows, dtype=float).view(np.int64)

    def machines(self, machine: RealMachine) -> list[RealMachine]:
        """Return for each pose the machine in the pose's surroundings; equal surroundings share one machine."""
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
            lags = thermal_lags(self.times, self.temperatures, constants)
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
