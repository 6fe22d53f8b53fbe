"""Virtual instruments: the readings of lasers, trackers and ball bars on a machine with known errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import CommandError
from ..machine.arrays import different_rows
from ..machine.geometry import HexapodGeometry
from ..machine.model import RealMachine
from ..measurements.campaign import INSTRUMENTS, Campaign, line_channels, line_readings
from ..measurements.readings import (
    ABSOLUTE_KINDS,
    AXES,
    CHANNELS,
    KINDS,
    LEAST_NOISE,
    LENGTH,
    PARALLEL,
    MeasurementSet,
    si_unit,
)
from ..measurements.runs import assemble
from ..measurements.stations import station_errors
from ..pose import Pose, attitude_error, rotation_from_vector

# Numbers of independent random streams, one for each cause of error: a draw from one stream changes no other stream.
# No number is 0, because default_rng([seed, 0]) equals default_rng(seed), from which the machine is drawn.
SLOPES, NOISE, CENTRES, VISITS = 1, 2, 3, 6


def measure(
    template: MeasurementSet,
    campaign: Campaign,
    truth: RealMachine,
    seed: int,
    advance: Callable[[int], object] = lambda stations: None,
) -> MeasurementSet:
    """Return the readings of `template` with the values that instruments would read on the real machine, `truth`.

    value = w · (e + s) − zero + b · x + n: w the channel's direction, e the tool error, s the random error of the stop,
    b the slope of a straightness beam, x the coordinate along the line, n the instrument's noise. The zero is the
    channel's first value in the run; a channel whose zero is known reads absolute values. A length is read from its
    true centre, which differs at random from the template's centre by `campaign.centre_off`, m (1 σ per axis).
    """
    errors = station_errors(template, truth, advance)[template.station]
    _, visit = different_rows(np.stack([template.station, template.cycle], axis=1))
    stops = np.random.default_rng([seed, VISITS]).standard_normal((visit.max() + 1, 3))
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
    value = np.random.default_rng([seed, NOISE]).normal(value, sigma)
    return replace(template, value=value, uncertainty=np.where(sigma > 0.0, np.maximum(sigma, LEAST_NOISE), np.nan))


def _centres(template: MeasurementSet, lengths: np.ndarray, off: float, rng: np.random.Generator) -> np.ndarray:
    """Return the true centres from which the readings at indices `lengths` are measured, (n, 3), m in ``base``.

    The centres of a run form a rigid body. The body is shifted at random by `off`, m (1 σ per axis), and turned at
    random about the mean of its centres; the turn moves the outermost centre by `off` (1 σ per axis), too.
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
    """Return the zero of each reading, m or rad, shape (N,); :func:`measure` defines it."""
    groups = template.run * len(CHANNELS) + template.channel
    _, first, group = np.unique(groups, return_index=True, return_inverse=True)
    absolute = np.isin(np.array(KINDS)[template.kind], ABSOLUTE_KINDS)
    absolute |= np.array([run.known_zero for run in template.runs])[template.run]
    return np.where(absolute, 0.0, value[first][group.ravel()])


def _beams(template: MeasurementSet, rng: np.random.Generator) -> np.ndarray:
    """Return the error of each reading, (N,), m, if its straightness beam has a random slope of σ = 1 rad.

    All runs with one optical square read the same random rotation of this square about each axis of ``work``.
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


@dataclass(frozen=True)
class LiveFlaws:
    length_noise: float = 1e-6  # 1 σ of a length, m
    angle_noise: float = 1e-6  # 1 σ of an angle, rad
    beam_slope: float = Campaign.beam_slope  # 1 σ of a straightness beam's slope, rad
    centre_off: float = Campaign.centre_off  # 1 σ of a length's stated centre along each axis, m
    wild_share: float = 0.0  # share of outliers, 0…1
    wild_size: float = 1e-3  # size of an outlier, m or rad
    scale: float = 1.0  # factor on every reading: −1 reverses the sign, 1000 gives mm in place of m
    exchanged: bool = False  # whether the first two channels are exchanged


class LiveInstrument:
    """An instrument that reads a moving tool, with the signs and zeros of :func:`measure`.

    A laser and a ball bar must be set up for each run; a tracker stays at `stands`, a pose in ``base``.
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
            problem = f"must be one of {', '.join(LIVE)}; a laser's components must be one of {', '.join(INSTRUMENTS)}"
            raise CommandError("instrument", problem)
        self._geometry, self.kind, self._components, self.flaws = geometry, kind, components, flaws
        self._to_own = (stands or Pose.identity()).inverse()
        self._rng = np.random.default_rng(seed)
        self._place: Pose | None = None
        self.channels: tuple[str, ...] = ()

    def set_up(self, place: Pose) -> None:
        """Set up a laser at the start of a line, or a ball bar at its centre; the line is the x axis of `place`."""
        self._place = place
        self._centre = place.position + self.flaws.centre_off * self._rng.standard_normal(3)
        self.channels, axis = ("length",), self._geometry.work.rotation.T @ place.rotation[:, 0]
        if self.kind == LASER:
            along = int(np.abs(axis).argmax())
            self.channels = line_channels(self._components, along if abs(axis[along]) > PARALLEL else None)
            ends = [self._geometry.work.inverse() @ Pose(place.position + at * place.rotation[:, 0], place.rotation)
                    for at in (0.0, 1.0)]  # fmt: skip
            line = assemble(self._geometry, list(line_readings("line", ends, self.channels, 1)), in_reach=False)
            self._directions = line.directions()[: len(self.channels)]
            straight = np.array([channel.startswith("straightness") for channel in self.channels])
            slopes = np.where(straight, self.flaws.beam_slope * self._rng.standard_normal(len(straight)), 0.0)
            self._directions[:, :3] += slopes[:, None] * place.rotation[:, 0]
        self.zero()

    def zero(self) -> None:
        """Make the next reading the zero of all channels."""
        self._start: Pose | None = None

    def read(self, tool: Pose) -> dict[str, float]:
        """Return the reading, m or rad, by channel, of a tool pose in ``base``; {} for a tracker or before set-up."""
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
        """Return the pose, in the tracker's frame, that a tracker reads if the true tool pose in ``base`` is `tool`."""
        own = self._to_own @ tool
        away = np.array([self._noise("position") for _ in AXES])
        turn = np.array([self._noise("attitude") for _ in AXES])
        position = self.flaws.scale * (own.position + away)
        if self.flaws.exchanged:
            position[[0, 1]] = position[[1, 0]]
        return Pose(position, rotation_from_vector(turn) @ own.rotation)

    def _noise(self, channel: str) -> float:
        """Return the random error of one reading, m or rad: noise, and with probability `wild_share` an outlier."""
        sigma = self.flaws.angle_noise if si_unit(channel) == "rad" else self.flaws.length_noise
        noise = sigma * self._rng.standard_normal()
        wild = self._rng.random() < self.flaws.wild_share
        return float(noise + wild * self.flaws.wild_size * self._rng.choice([-1.0, 1.0]))
