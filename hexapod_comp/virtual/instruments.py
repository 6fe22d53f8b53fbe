"""Virtual instruments: the readings of lasers and trackers on a machine with known errors.

The inverse of calibration: a campaign's template is filled in from the truth, so that everything from measuring to
compensating can be tried, and judged, without a laser.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..errors import CommandError
from ..machine.arrays import different_rows
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.trial import drive, model_commands
from ..measurements.campaign import INSTRUMENTS, Campaign, line_channels, line_readings
from ..measurements.readings import (
    ABSOLUTE_KINDS,
    ANGULAR_KINDS,
    AXES,
    CHANNELS,
    KINDS,
    LEAST_NOISE,
    LENGTH,
    MeasurementSet,
)
from ..measurements.runs import assemble
from ..pose import Pose, attitude_error, rotation_from_vector

# Streams of random numbers, one per cause: changing one leaves the others' draws alone
VISITS, SLOPES, NOISE, CENTRES = range(4)


def measure(
    template: MeasurementSet,
    campaign: Campaign,
    truth: RealMachine,
    seed: int,
    advance: Callable[[int], object] = lambda stations: None,
) -> MeasurementSet:
    """Return the readings of a template that instruments would give on the real machine.

    value = w · (e + where the machine happened to stop) − the same at the run's first reading of that channel + slope
    of the straightness beam × way along the line + noise of the instrument. Positions and attitudes are absolute:
    nothing is subtracted; nor from lengths whose zero is known. Lengths are distances from centres whose body is
    displaced from its place in the file. Each reading states its instrument's noise as its uncertainty, at least
    :data:`~hexapod_comp.measurements.readings.LEAST_NOISE`; an instrument without noise states nothing.
    """
    errors = station_errors(template, truth, advance)[template.station]
    _, visit = different_rows(np.stack([template.station, template.cycle], axis=1))
    stops = np.random.default_rng([seed, VISITS]).standard_normal((visit.max() + 1, 3))  # beside the usual place
    errors[:, :3] += campaign.repeatability * stops[visit]
    value = (template.directions() * errors).sum(axis=1)
    lengths = np.flatnonzero(template.channel == LENGTH)
    centres = _centres(template, lengths, campaign.centre_off, np.random.default_rng([seed, CENTRES]))
    points = template.points()[template.station[lengths]]
    commanded = np.linalg.norm(points - template.centre[lengths], axis=1)
    value[lengths] = np.linalg.norm(points + errors[lengths, :3] - centres, axis=1) - commanded
    value -= _zeros(template, value)
    value += campaign.beam_slope * _beams(template, np.random.default_rng([seed, SLOPES]))
    sigma = np.array(campaign.noise)[template.kind]
    value += sigma * np.random.default_rng([seed, NOISE]).standard_normal(len(value))
    return replace(template, value=value, uncertainty=np.where(sigma > 0.0, np.maximum(sigma, LEAST_NOISE), np.nan))


def station_errors(
    measurements: MeasurementSet, truth: RealMachine, advance: Callable[[int], object] = lambda stations: None
) -> np.ndarray:
    """Return the real error of the measured point at each station, shape (M, 6), m and rad along ``base``.

    Displacement of the point and rotation of the platform, actual minus commanded, under the stations'
    commands, directions of motion, temperatures and humidity.
    """
    stations, name_of = measurements.stations, partial(_station_name, measurements)
    machines = stations.machines(truth)
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, stations.sense, stations.commands, name_of, advance)
    return driven.errors(commanded, measurements.probe).as_array()


def compensated(template: MeasurementSet, model: MachineModel) -> MeasurementSet:
    """Return a template with the commands of a model's compensation."""
    stations = template.stations
    machines = stations.machines(RealMachine(template.geometry, model))
    targets, name_of = (stations.positions, stations.rotations), partial(_station_name, template)
    commands, _ = model_commands(machines, targets, stations.sense, name_of)
    return replace(template, stations=replace(stations, commands=commands))


def _station_name(measurements: MeasurementSet, station: int) -> str:
    """Return a station's name for messages: the run, the number of its first reading, and its place."""
    reading = int((measurements.station == station).argmax())
    position = (measurements.stations.positions[station] * 1e3).round(3).tolist()
    run = measurements.runs[measurements.run[reading]].name
    return f"run {run}, reading {reading + 1}, platform at {position} mm in base"


def _centres(template: MeasurementSet, lengths: np.ndarray, off: float, rng: np.random.Generator) -> np.ndarray:
    """Return the true places of the centres of some readings, shape (n, 3), m in ``base``: one draw per run.

    A body of several centres is shifted, and turned about their mean so that the furthest moves as far.
    """
    centres = template.centre[lengths].copy()
    drawn = off * rng.standard_normal((len(template.runs), 2, 3))
    for run in np.unique(template.run[lengths]):
        members = template.run[lengths] == run
        mean = centres[members].mean(axis=0)
        arms = centres[members] - mean
        shift, turn = drawn[run]
        size = np.linalg.norm(arms, axis=1).max()
        turned = arms @ rotation_from_vector(turn / size).T if size > off else arms
        centres[members] = mean + shift + turned
    return centres


def _zeros(template: MeasurementSet, value: np.ndarray) -> np.ndarray:
    """Return each reading's zero, the value of its instrument's first reading, shape (N,)."""
    groups = template.run * len(CHANNELS) + template.channel
    _, first, group = np.unique(groups, return_index=True, return_inverse=True)
    absolute = np.isin(np.array(KINDS)[template.kind], ABSOLUTE_KINDS)
    absolute |= np.array([run.known_zero for run in template.runs])[template.run]
    return np.where(absolute, 0.0, value[first][group.ravel()])


def _beams(template: MeasurementSet, rng: np.random.Generator) -> np.ndarray:
    """Return what beams that are misaligned by a random slope add to straightness, per rad, shape (N,), m.

    A square is turned by one draw about each axis of the work frame, for all runs that share its slope.
    """
    drawn = rng.standard_normal((len(template.runs), len(AXES)))
    straightness = np.flatnonzero(template.kind == KINDS.index("straightness"))
    run, axis = template.run[straightness], template.channel[straightness] - CHANNELS.index("straightness_x")
    slopes, names = drawn[run, axis], np.array([r.slope for r in template.runs])
    levers, about = template.square_levers()
    shared = np.flatnonzero(names[run] != "")
    first = np.array([int((names == name).argmax()) for name in names])
    result = np.zeros(len(template))
    result[straightness] = slopes * template.along()[straightness]
    chosen = straightness[shared]
    result[chosen] = drawn[first[run[shared]], about[chosen]] * levers[chosen]
    return result


TRACKER, LASER, BALL_BAR = LIVE = ("tracker", "laser", "ball_bar")
PARALLEL = 1.0 - 1e-9  # cosine from which a line is parallel to an axis of the work frame


@dataclass(frozen=True)
class LiveFlaws:
    """Errors of a live instrument."""

    length_noise: float = 1e-6  # standard deviation of a length, m
    angle_noise: float = 1e-6  # standard deviation of an angle, rad
    beam_slope: float = Campaign.beam_slope  # 1 σ of a straightness beam's unknown slope, rad
    centre_off: float = Campaign.centre_off  # 1 σ of the offset of a centre of lengths along each axis, m
    wild_share: float = 0.0  # share of readings that are outliers
    wild_size: float = 1e-3  # size of an outlier, m or rad
    scale: float = 1.0  # factor of every reading: −1 reverses its sign, 1000 gives mm in place of m
    exchanged: bool = False  # whether its first two channels are exchanged


class LiveInstrument:
    """An instrument that reads the pose of a moving tool, with the signs and zeros of :func:`measure`.

    A laser and a ball bar are set up for each run and read relative to that place; a tracker stays at its place.
    """

    def __init__(
        self,
        geometry: HexapodGeometry,
        kind: str,
        components: str = "5-D",
        flaws: LiveFlaws = LiveFlaws(),
        stands: Pose | None = None,
        seed: int = 0,
    ) -> None:
        if kind not in LIVE or components not in INSTRUMENTS:
            raise CommandError("instrument", f"must be one of {', '.join(LIVE)}, of {', '.join(INSTRUMENTS)}")
        self._geometry, self.kind, self._components, self.flaws = geometry, kind, components, flaws
        self._to_own = (stands or Pose.identity()).inverse()
        self._rng = np.random.default_rng(seed)
        self._place: Pose | None = None
        self.channels: tuple[str, ...] = ()

    def set_up(self, place: Pose) -> None:
        """Set up for a run: a line that begins at a place in ``base`` and goes along its x, or a centre there."""
        self._place = place
        self._centre = place.position + self.flaws.centre_off * self._rng.standard_normal(3)
        self.channels, axis = ("length",), self._geometry.work.rotation.T @ place.rotation[:, 0]
        if self.kind == LASER:
            along = int(np.abs(axis).argmax())
            self.channels = line_channels(self._components, along if abs(axis[along]) > PARALLEL else None)
            ends = [self._geometry.work.inverse() @ Pose(place.position + way * place.rotation[:, 0], place.rotation)
                    for way in (0.0, 1.0)]  # fmt: skip
            line = assemble(self._geometry, list(line_readings("line", ends, self.channels, 1)), in_reach=False)
            self._directions = line.directions()[: len(self.channels)]
            straight = np.array([channel.startswith("straightness") for channel in self.channels])
            slopes = np.where(straight, self.flaws.beam_slope * self._rng.standard_normal(len(straight)), 0.0)
            self._directions[:, :3] += slopes[:, None] * place.rotation[:, 0]
        self.zero()

    def zero(self) -> None:
        """Set the zero to the next pose that is read."""
        self._start: Pose | None = None

    def read(self, tool: Pose) -> dict[str, float]:
        """Return the channels of a laser or ball bar at a tool pose in ``base``; none before it is set up."""
        if self._place is None or self.kind == TRACKER:
            return {}
        self._start = start = self._start or tool
        if self.kind == LASER:
            turned = attitude_error(tool.rotation, start.rotation)
            values = self._directions @ np.concatenate([tool.position - start.position, turned])
        else:
            ends = np.array([tool.position, start.position]) - self._centre
            values = -np.diff(np.linalg.norm(ends, axis=1))
        noise = [self._noise(channel) for channel in self.channels]
        values = self.flaws.scale * (values + noise)
        if self.flaws.exchanged and len(values) > 1:
            values[[0, 1]] = values[[1, 0]]
        return dict(zip(self.channels, values.tolist(), strict=True))

    def pose(self, tool: Pose) -> Pose:
        """Return the tool pose that a tracker reads, in the tracker's frame."""
        own = self._to_own @ tool
        away = np.array([self._noise("position") for _ in AXES])
        turn = np.array([self._noise("attitude") for _ in AXES])
        position = self.flaws.scale * (own.position + away)
        if self.flaws.exchanged:
            position[[0, 1]] = position[[1, 0]]
        return Pose(position, rotation_from_vector(turn) @ own.rotation)

    def _noise(self, channel: str) -> float:
        """Return the error of one reading: noise and, at times, an outlier."""
        angular = channel.partition("_")[0] in ANGULAR_KINDS
        noise = (self.flaws.angle_noise if angular else self.flaws.length_noise) * self._rng.standard_normal()
        wild = self._rng.random() < self.flaws.wild_share
        return float(noise + wild * self.flaws.wild_size * self._rng.choice([-1.0, 1.0]))
