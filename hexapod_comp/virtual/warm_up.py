"""A virtual machine that warms up, or whose air turns damp, while it is measured repeatedly.

One power warms all parts, each through a first-order lag of its own, with sensors that are read once a second and
filtered as the compensator does it. A campaign is measured before the power is on; then an x, a y and a z line in the
middle of its box, over and over.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..compensation.thermal import TemperatureFilter
from ..errors import InputFileError, ModelError
from ..formats.paths import input_file
from ..formats.schema import Section
from ..formats.yaml import read_yaml
from ..machine.model import MachineModel, RealMachine
from ..machine.temperatures import HUMIDITY, HUMIDITY_RANGE, PARTS, REFERENCE_TEMPERATURE, TEMPERATURE_RANGE
from ..measurements.campaign import Campaign, CampaignRun
from ..measurements.readings import AXES, MeasurementSet, Stations
from .instruments import compensated, measure

WARM_UP_FORMAT, WARM_UP_VERSION = "hexapod_comp/warm_up", 1
SENSED = (*PARTS, HUMIDITY)  # Quantities with a course, in the order of every array of nine
POINTS = 9  # points of each line that is measured again
# Largest spread of the struts of one machine (standard deviation): beyond, one of them may run backwards in time
MOST_APART = 0.2
LONGEST = 1_000_000  # A warm-up of more seconds is a season
APART, NOISE = 20, 17  # Streams of random numbers: how struts differ, and what the sensors add


@dataclass(frozen=True)
class WarmUp:
    """How a machine warms up, and how it is measured meanwhile."""

    rise: np.ndarray  # (9,): final rise of each part, K, and the humidity, a fraction
    time_constants: np.ndarray  # (9,): s
    humidity: float = math.nan  # at the beginning, a fraction; NaN: not known
    # parts that have a thermometer, and ``humidity`` for a hygrometer. Others are read as at 20 °C, or not at all.
    sensors: tuple[str, ...] = PARTS
    noise: tuple[float, float] = (0.05, 0.01)  # standard deviation of a reading once a second, K, and of the humidity
    # rounds of the three lines before the power is on: without them, errors of a model on these lines count as growth
    cold_rounds: int = 1
    # rounds of the three lines; time from one to the next, s, and of one reading, s. A round begins at half of its time
    rounds: int = 18
    every: int = 600
    pace: int = 4

    def __post_init__(self) -> None:
        ends = self.start + self.rise
        ranges = [TEMPERATURE_RANGE] * len(PARTS) + [HUMIDITY_RANGE]
        damp = np.isfinite(self.humidity)
        for name, end, (low, high) in zip(SENSED, ends, ranges, strict=True):
            if (damp or name != HUMIDITY) and not low <= end <= high:
                raise ModelError(f"warm-up of {name}", f"must end within {low:g}…{high:g}", float(end))
        if not (np.isfinite(self.time_constants).all() and (self.time_constants > 0.0).all()):
            raise ModelError(
                "warm-up, time constants", "must be finite and above zero, s", self.time_constants.tolist()
            )
        unknown = [name for name in self.sensors if name not in SENSED] + [HUMIDITY] * (
            HUMIDITY in self.sensors and not damp
        )
        if unknown or len(set(self.sensors)) != len(self.sensors):
            allowed = f"must be of {', '.join(SENSED)}, each once, and of the humidity only where it is given"
            raise ModelError("warm-up, sensors", allowed, list(self.sensors))
        if not all(0.0 <= sigma < math.inf for sigma in self.noise):
            raise ModelError("warm-up, noise", "must be finite and not negative", list(self.noise))
        if not 0 <= self.cold_rounds <= self.rounds:
            raise ModelError("warm-up, cold_rounds", "must not be negative, nor more than rounds", self.cold_rounds)
        if min(self.rounds, self.every, self.pace) < 1 or self.rounds * self.every > LONGEST:
            problem = f"rounds, seconds between them and of a reading must be above zero, {LONGEST} s in all at most"
            raise ModelError("warm-up", problem, [self.rounds, self.every, self.pace])

    @property
    def start(self) -> np.ndarray:
        """Temperatures, °C, and humidity before the power is on, shape (9,)."""
        return np.append(np.full(len(PARTS), REFERENCE_TEMPERATURE), self.humidity)

    def apart(self, share: float, seed: int) -> WarmUp:
        """Return the same with each strut's rise and time constant changed by a random share (standard deviation)."""
        off = 1.0 + share * np.random.default_rng([seed, APART]).standard_normal((6, 2))
        rise, time_constants = self.rise.copy(), self.time_constants.copy()
        rise[:6] *= off[:, 0]
        time_constants[:6] *= off[:, 1]
        return replace(self, rise=rise, time_constants=time_constants)

    def course(self, seconds: int, off: tuple[int, int] = (0, 0)) -> np.ndarray:
        """Return temperatures, °C, and humidity at each second from switching on, shape (seconds + 1, 9).

        From the one to the other second of `off` the power is off.
        """
        now, result = np.zeros(len(SENSED)), np.empty((seconds + 1, len(SENSED)))
        gone = -np.expm1(-1.0 / self.time_constants)
        for second in range(seconds + 1):
            result[second] = now
            now = now + ((not off[0] <= second < off[1]) * self.rise - now) * gone
        return self.start + result

    def sensed(self, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the filtered sensors at each second, shape (seconds, 9)."""
        result, low_pass = np.empty(true.shape), TemperatureFilter()
        result[:, :-1], result[:, -1] = REFERENCE_TEMPERATURE, np.nan
        for name in self.sensors:
            column, sigma = SENSED.index(name), self.noise[name == HUMIDITY]
            readings = true[:, column] + sigma * rng.standard_normal(len(true))
            result[:, column] = [low_pass.update(name, value, float(n)) for n, value in enumerate(readings)]
        return result

    def campaign(self, cold: Campaign) -> Campaign:
        """Return a campaign with the lines that are measured again after it."""
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
        """Return the true stations of this campaign, and those by the sensors."""
        first = len(planned.runs) - len(AXES) * self.rounds
        of_station = np.full(len(planned.stations), -1)
        of_station[planned.station] = np.maximum((planned.run - first) // len(AXES), -1)
        seconds = np.arange(len(of_station)) - (of_station < 0).sum()  # one a second, the cold ones before that
        for number in range(self.rounds):
            members = np.flatnonzero(of_station == number)
            if len(members) * self.pace > self.every - self.every // 2:
                problem = f"of {len(members)} readings take longer than half of {self.every} s"
                raise ModelError("warm-up, rounds", problem, self.pace)
            seconds[members] = number * self.every + self.every // 2 + self.pace * np.arange(len(members))
        true = self.course(self.rounds * self.every)
        sensed, warm = self.sensed(true, np.random.default_rng([seed, NOISE])), np.maximum(seconds, 0)
        before = self.start
        before[-1] = self.humidity if HUMIDITY in self.sensors else np.nan
        seen = np.where((seconds < 0)[:, None], before, sensed[warm])
        times = seconds.astype(float)
        is_so, is_read = (
            replace(planned.stations, temperatures=now[:, :-1], humidity=now[:, -1], times=times)
            for now in (true[warm], seen)
        )
        return is_so, is_read

    def measured(
        self,
        planned: MeasurementSet,
        campaign: Campaign,
        truth: RealMachine,
        seed: int,
        model: MachineModel | None = None,
        advance: Callable[[int], object] = lambda stations: None,
    ) -> MeasurementSet:
        """Return the readings of this campaign (:func:`.instruments.measure`), with those of the sensors.

        With a `model` the machine's commands are those of its compensation by these sensors.
        """
        is_so, is_read = self.stations(planned, seed)
        planned = replace(planned, stations=is_read)
        if model is not None:
            planned = compensated(planned, model)
        commands = planned.stations.commands
        read = measure(replace(planned, stations=replace(is_so, commands=commands)), campaign, truth, seed, advance)
        return replace(read, stations=planned.stations)


def load_warm_up(path: str | Path, seed: int = 0) -> tuple[WarmUp, np.ndarray]:
    """Read a warm-up file (YAML, see config/warm_up.yaml), or a shipped one by its name."""
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
    if not 0.0 <= share <= MOST_APART:
        raise top.error("strut_spread", f"must be 0…{100.0 * MOST_APART:g} %", 100.0 * share)
    counts = [top.integer(name, getattr(WarmUp, name)) for name in ("cold_rounds", "rounds", "every", "pace")]
    expansion = top.quantity("expansion", "expansion", (3,), np.zeros(3))
    top.finish()
    try:
        if not isinstance(sensors, list):
            raise ModelError("warm-up, sensors", "must be a list", sensors)
        warm = WarmUp(
            np.append(rise, np.diff(humidity)), np.array(constants), float(humidity[0]), tuple(sensors),
            (float(noise[0]), float(noise[1])), *counts,
        )  # fmt: skip
        return warm.apart(share, seed), expansion
    except ModelError as error:
        raise InputFileError(path, error.key, error.problem, error.value) from error


def _of_bodies(top: Section, name: str, dimension: str, default: float | None) -> list[float]:
    return [float(top.quantity(f"{body}_{name}", dimension, (), default)) for body in PARTS[6:]]


def growing(model: MachineModel, expansion: np.ndarray) -> MachineModel:
    """Return a machine that grows by heat: by expansions of struts, base and platform, 1/K, where it has none."""
    if model.struts.expansion.any() or model.base_expansion or model.platform_expansion:
        return model
    struts = replace(model.struts, expansion=np.full(6, expansion[0]))
    return replace(model, struts=struts, base_expansion=float(expansion[1]), platform_expansion=float(expansion[2]))
