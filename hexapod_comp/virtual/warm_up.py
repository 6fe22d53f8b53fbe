"""A virtual machine that is measured repeatedly while it warms up, or while the air becomes humid.

A campaign is measured before the power is on; then lines along x, y and z through the middle of its box are measured
in many rounds. The sensors are read once a second and filtered with the compensator's filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..compensation.thermal import TemperatureFilter
from ..errors import ModelError
from ..formats.paths import input_file
from ..formats.schema import Section, file_errors
from ..formats.yaml import read_yaml
from ..machine.model import MachineModel, RealMachine
from ..machine.temperatures import HUMIDITY, HUMIDITY_RANGE, PARTS, REFERENCE_TEMPERATURE, TEMPERATURE_RANGE
from ..measurements.campaign import Campaign, CampaignRun
from ..measurements.readings import AXES, MeasurementSet, Stations
from ..measurements.stations import compensated
from .instruments import measure

WARM_UP_FORMAT, WARM_UP_VERSION = "hexapod_comp/warm_up", 1
SENSED = (*PARTS, HUMIDITY)  # quantities that change with time, in the order of arrays (9,)
POINTS = 9  # on each of a round's three lines
# Largest relative spread (1 σ) of the struts' rises and time constants; with more a time constant could be < 0
LARGEST_SPREAD = 0.2
LONGEST = 1_000_000  # Longest warm-up, s
SPREAD, NOISE = 20, 17  # random streams of the struts' spread and of the sensors' noise


@dataclass(frozen=True)
class WarmUp:
    """How a machine warms up, and the rounds of lines that are measured meanwhile."""

    rise: np.ndarray  # (9,): final rise of the parts' temperatures, K, and of the humidity, a fraction
    time_constants: np.ndarray  # (9,): of the parts' temperatures and of the humidity, s
    humidity: float = math.nan  # at the beginning, a fraction; NaN: unknown
    # Parts with a thermometer, and ``humidity`` with a hygrometer. A part without a thermometer is read as
    # 20 °C; without a hygrometer the humidity is unknown.
    sensors: tuple[str, ...] = PARTS
    # 1 σ of one unfiltered reading: of a thermometer, K, and of the hygrometer, a fraction
    noise: tuple[float, float] = (0.05, 0.01)
    # Rounds before the power is on; without them the fit would take errors on the lines for growth
    cold_rounds: int = 1
    rounds: int = 18  # rounds after the power is on
    every: int = 600  # period of the rounds, s; each begins in the middle of its period
    pace: int = 4  # time of a reading, s

    def __post_init__(self) -> None:
        ends = self.start + self.rise
        ranges = [TEMPERATURE_RANGE] * len(PARTS) + [HUMIDITY_RANGE]
        damp = np.isfinite(self.humidity)
        for name, end, (low, high) in zip(SENSED, ends, ranges, strict=True):
            if (damp or name != HUMIDITY) and not low <= end <= high:
                unit = "" if name == HUMIDITY else " °C"  # humidity: a fraction
                raise ModelError(f"warm-up of {name}", f"must end within {low:g}…{high:g}{unit}", float(end))
        if not (np.isfinite(self.time_constants).all() and (self.time_constants > 0.0).all()):
            problem = "must be finite and above zero, s"
            raise ModelError("warm-up, time constants", problem, self.time_constants.tolist())
        unknown = [name for name in self.sensors if name not in SENSED]
        unknown += [HUMIDITY] * (HUMIDITY in self.sensors and not damp)
        if unknown or len(set(self.sensors)) != len(self.sensors):
            allowed = f"must be some of {', '.join(SENSED)}, each at most once; humidity needs the file's key humidity"
            raise ModelError("warm-up, sensors", allowed, list(self.sensors))
        if not all(0.0 <= sigma < math.inf for sigma in self.noise):
            raise ModelError("warm-up, noise", "must be finite and not negative", list(self.noise))
        if min(self.rounds, self.every, self.pace) < 1 or self.rounds * self.every > LONGEST:
            problem = f"rounds, every and pace must be above zero, and rounds × every must be at most {LONGEST} s"
            raise ModelError("warm-up", problem, [self.rounds, self.every, self.pace])
        if not 0 <= self.cold_rounds <= self.rounds:
            raise ModelError("warm-up, cold_rounds", f"must be 0…{self.rounds} (rounds)", self.cold_rounds)

    @property
    def start(self) -> np.ndarray:
        """Temperatures of the eight parts, °C, and humidity, a fraction, before the power is on, shape (9,)."""
        return np.append(np.full(len(PARTS), REFERENCE_TEMPERATURE), self.humidity)

    def with_spread(self, share: float, seed: int) -> WarmUp:
        """Return a copy in which each strut's temperature rise and time constant differ at random by `share` (1 σ)."""
        factors = np.random.default_rng([seed, SPREAD]).normal(1.0, share, (6, 2))
        rise, time_constants = self.rise.copy(), self.time_constants.copy()
        rise[:6] *= factors[:, 0]
        time_constants[:6] *= factors[:, 1]
        return replace(self, rise=rise, time_constants=time_constants)

    def over_time(self, seconds: int, off: tuple[int, int] = (0, 0)) -> np.ndarray:
        """Return eight temperatures, °C, and the humidity at each second after the power is on, (seconds + 1, 9).

        The power is off again from second `off[0]` to second `off[1]`.
        """
        now, result = np.zeros(len(SENSED)), np.empty((seconds + 1, len(SENSED)))
        gain = -np.expm1(-1.0 / self.time_constants)  # share of the distance to the final value, in one second
        for second in range(seconds + 1):
            result[second] = now
            now = now + ((not off[0] <= second < off[1]) * self.rise - now) * gain
        return self.start + result

    def sensed(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the sensors' filtered readings, (seconds, 9), of the `true` quantities at each second."""
        result, low_pass = np.empty(true.shape), TemperatureFilter()
        result[:, :-1], result[:, -1] = REFERENCE_TEMPERATURE, np.nan
        for name in self.sensors:
            column, sigma = SENSED.index(name), self.noise[name == HUMIDITY]
            readings = rng.normal(true[:, column], sigma)
            result[:, column] = [low_pass.update(name, value, float(n)) for n, value in enumerate(readings)]
        return result

    def campaign(self, cold: Campaign) -> Campaign:
        """Return the campaign `cold` followed by the rounds of lines: first the cold rounds, then the warm ones."""
        runs = []
        for number in range(-self.cold_rounds, self.rounds):
            when = f"round {number + 1}" if number >= 0 else f"cold {-number}"
            for axis, name in enumerate(AXES):
                positions = np.tile(cold.box.mean(axis=0), (POINTS, 1))
                low, high = cold.box[:, axis]
                positions[:, axis] = np.linspace(low, high, POINTS)
                rotations = np.tile(cold.level, (POINTS, 1, 1))
                runs.append(CampaignRun(f"{name} {when}", "5-D", positions, rotations))
        return replace(cold, runs=(*cold.runs, *runs))

    def stations(self, planned: MeasurementSet, seed: int) -> tuple[Stations, Stations]:
        """Return the stations twice: with the true temperatures and humidity, and with those that the sensors read."""
        first = len(planned.runs) - len(AXES) * self.rounds
        of_station = np.full(len(planned.stations), -1)
        of_station[planned.station] = np.maximum((planned.run - first) // len(AXES), -1)
        # Time of each station after the power is on, s; a station before has a negative time, one per second.
        seconds = np.arange(len(of_station)) - (of_station < 0).sum()
        for number in range(self.rounds):
            members = np.flatnonzero(of_station == number)
            half = self.every - self.every // 2
            if len(members) * self.pace > half:
                problem = f"is too long: a round of {len(members)} stations must take at most {half} s, half of `every`"
                raise ModelError("warm-up, pace", problem, self.pace)
            seconds[members] = number * self.every + self.every // 2 + self.pace * np.arange(len(members))
        true = self.over_time(self.rounds * self.every)
        sensed, warm = self.sensed(true, np.random.default_rng([seed, NOISE])), np.maximum(seconds, 0)
        before = self.start
        before[-1] = self.humidity if HUMIDITY in self.sensors else np.nan
        seen = np.where((seconds < 0)[:, None], before, sensed[warm])
        times = seconds.astype(float)
        true_stations, read_stations = (
            replace(planned.stations, temperatures=now[:, :-1], humidity=now[:, -1], times=times)
            for now in (true[warm], seen)
        )
        return true_stations, read_stations

    def measured(
        self,
        planned: MeasurementSet,
        campaign: Campaign,
        truth: RealMachine,
        seed: int,
        model: MachineModel | None = None,
        advance: Callable[[int], object] = lambda stations: None,
    ) -> MeasurementSet:
        """Return the campaign's readings (:func:`.instruments.measure`) with the temperatures of the sensors.

        With a `model`, the strut commands are compensated by this model at the temperatures that the sensors read.
        """
        true_stations, read_stations = self.stations(planned, seed)
        planned = replace(planned, stations=read_stations)
        if model is not None:
            planned = compensated(planned, model)
        real = replace(planned, stations=replace(true_stations, commands=planned.stations.commands))
        return replace(measure(real, campaign, truth, seed, advance), stations=planned.stations)


def load_warm_up(path: str | Path, seed: int = 0) -> tuple[WarmUp, np.ndarray]:
    """Read a warm-up file (YAML, see config/warm_up.yaml) by its path, or a shipped file by its name.

    Return the warm-up, with struts varied at random by the file's ``strut_spread``, and the expansions of struts,
    base and platform, (3,), 1/K.
    """
    path = input_file(path, "warm_up")
    top = read_yaml(path, WARM_UP_FORMAT, WARM_UP_VERSION)
    damp = top.quantity_key("humidity", "ratio") is not None
    humidity = top.quantity("humidity", "ratio", (2,)) if damp else np.array([math.nan, math.nan])
    rise = [*top.per_strut("struts_rise", "difference", 0.0), *_of_bodies(top, "rise", "difference", 0.0)]
    constants = [*top.per_strut("struts_time_constant", "time"), *_of_bodies(top, "time_constant", "time", None)]
    constants.append(float(top.quantity("humidity_time_constant", "time", default=math.nan if damp else 1.0)))
    noise = top.quantity("noise", "difference", default=0.05), top.quantity("humidity_noise", "ratio", default=0.01)
    default = [*PARTS, *([HUMIDITY] if damp else [])]
    sensors = top.require("sensors") if "sensors" in top else default
    share = float(top.quantity("strut_spread", "ratio", default=0.0))
    if not 0.0 <= share <= LARGEST_SPREAD:
        with file_errors(top):
            raise ModelError("strut_spread", f"must be 0…{100.0 * LARGEST_SPREAD:g} %", share)
    counts = [top.integer(name, getattr(WarmUp, name)) for name in ("cold_rounds", "rounds", "every", "pace")]
    expansion = top.quantity("expansion", "expansion", (3,), np.zeros(3))
    top.finish()
    with file_errors(top):
        if not isinstance(sensors, list):
            raise ModelError("warm-up, sensors", "must be a list", sensors)
        warm = WarmUp(
            np.append(rise, np.diff(humidity)), np.array(constants), float(humidity[0]), tuple(sensors),
            (float(noise[0]), float(noise[1])), *counts,
        )  # fmt: skip
        return warm.with_spread(share, seed), expansion


def _of_bodies(top: Section, name: str, dimension: str, default: float | None) -> list[float]:
    return [float(top.quantity(f"{body}_{name}", dimension, (), default)) for body in PARTS[6:]]


def growing(model: MachineModel, expansion: np.ndarray) -> MachineModel:
    """Return the model; if it has no expansion at all, give it the `expansion` of struts, base and platform, 1/K."""
    if model.struts.expansion.any() or model.base_expansion or model.platform_expansion:
        return model
    struts = replace(model.struts, expansion=np.full(6, expansion[0]))
    return replace(model, struts=struts, base_expansion=float(expansion[1]), platform_expansion=float(expansion[2]))
