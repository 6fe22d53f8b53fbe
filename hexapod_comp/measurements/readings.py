"""Readings of all instruments in one form: channels, single readings, and sets of readings as arrays.

A run: readings with one set-up of the instrument, and so with one unknown zero in each channel; often along a line. A
station: one commanded pose, reached from one direction, in one run, at one state of temperatures, humidity and load.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from ..errors import CalibrationError
from ..machine.arrays import rms
from ..machine.geometry import HexapodGeometry
from ..machine.surroundings import NO_LOAD, Surroundings
from ..machine.temperatures import PARTS, REFERENCE_TEMPERATURE
from ..pose import Pose, attitude_error, nearest_rotation

AXES = ("x", "y", "z")
# Channels: what an instrument reads. ``linear``: displacement along the run's line; ``length``: distance from a centre;
# all others: displacement along or rotation about an axis of the work frame. Position and attitude are absolute; all
# other channels have an unknown zero in each run. Straightness and rotation are read on lines, displacement anywhere.
CHANNELS = (
    "linear",
    *(f"straightness_{a}" for a in AXES),
    *(f"rotation_{a}" for a in AXES),
    *(f"position_{a}" for a in AXES),
    *(f"attitude_{a}" for a in AXES),
    "length",
    *(f"displacement_{a}" for a in AXES),
)

LINE_KINDS = ("linear", "straightness", "rotation")  # kinds of channels that are read on a line
ABSOLUTE_KINDS = ("position", "attitude")  # kinds of channels without an unknown zero
# For each kind of channel: standard deviation of a reading, m or rad, if the file does not state it
DEFAULT_UNCERTAINTY = {
    **dict.fromkeys(LINE_KINDS, 1e-6),
    **dict.fromkeys(ABSOLUTE_KINDS, 10e-6),
    **dict.fromkeys(("length", "displacement"), 1e-6),
}
KINDS = tuple(DEFAULT_UNCERTAINTY)
LENGTH = CHANNELS.index("length")
# Index into KINDS of each channel's kind
KIND_OF = np.array([KINDS.index(channel.partition("_")[0]) for channel in CHANNELS])
ANGULAR_KINDS = ("rotation", "attitude")
# Direction from which a station is reached; FROM_PREVIOUS: from the commanded pose of the reading before
FORWARD, BACKWARD, UNKNOWN, FROM_PREVIOUS = 1, -1, 0, 2
SAME_ATTITUDE = 1e-6  # rad; attitudes with a smaller difference are equal
LEAST_SIDE = 1e-6  # m; points whose bounding box has a shorter side lie in a plane or on a line
# Lower bound of the estimated noise of a reading, m or rad; it limits the weight of readings without noise
LEAST_NOISE = 1e-9
# Standard deviation / median absolute deviation of a normal distribution
MEDIAN_TO_SIGMA = 1.4826
# A stated σ above this multiple of DEFAULT_UNCERTAINTY suggests a wrong unit (except for position and attitude)
COARSEST = 300.0
LARGEST_READING = 1.0  # largest magnitude of a reading, and largest offset of an instrument's zero, m or rad
# Limits of readings by a tracker in its own frame: the tracker's range, m; largest magnitude of a rotation vector, rad
LARGEST_OF_TRACKER = {"position": 100.0, "attitude": np.pi}
PARALLEL = 1.0 - 1e-9  # a line is parallel to an axis if the cosine of the angle between them is above this
LEAST_TRAVEL = 1e-6  # m; a line does not travel along an axis if its component along the axis is shorter


def si_unit(channel: str) -> str:
    """Return the SI unit of the readings of a channel or of a kind of channel."""
    return "rad" if channel.partition("_")[0] in ANGULAR_KINDS else "m"


def of_median(sigma: np.ndarray, count: int) -> np.ndarray:
    """Return the standard deviation of the median of `count` readings, each with the standard deviation `sigma`."""
    return sigma * math.sqrt(math.pi / 2.0) / math.sqrt(count)


class FileLine(NamedTuple):
    file: str  # name of the file or, if there is none, of the campaign or program that made the reading
    line: int  # number of the line; 0 if there is no file

    def __str__(self) -> str:
        return f"{self.file}: line {self.line}" if self.line else self.file


class Reading(NamedTuple):
    run: str  # name of the run; its readings share one unknown zero per channel
    cycle: int  # number of the pass through the run, from 1
    direction: int  # ``FORWARD``, ``BACKWARD``, ``UNKNOWN`` or ``FROM_PREVIOUS``
    pose: Pose  # commanded ``pose_tool_in_work``
    channel: str  # one of :data:`CHANNELS`
    value: float  # measured error, actual minus commanded, m or rad
    uncertainty: float = np.nan  # standard deviation of the value, m or rad; NaN: unknown
    temperatures: tuple[float, ...] = (REFERENCE_TEMPERATURE,) * 8  # temperatures of struts 1–6, base and platform, °C
    # strut lengths that were commanded or read by encoders, m; None: the nominal lengths of the pose were commanded
    commands: tuple[float, ...] | None = None
    source: FileLine = FileLine("", 0)  # file and line, for messages
    time: float = np.nan  # time of the reading, s, on one clock for all readings; NaN: unknown
    # channel ``length``: point from which the distance is read, m in the work frame, known to some millimetres
    centre: tuple[float, ...] | None = None
    known_zero: bool = False  # channel ``length``: whether the zero is known, as with a calibrated ball bar
    humidity: float = np.nan  # relative humidity of the air, a fraction 0…1; NaN: unknown
    load: tuple[float, ...] = NO_LOAD  # payload, kg, its centre in platform, m, gravity in base, m/s²; NaN: unknown
    slope: str = ""  # straightness: name of the optical square from which it is read; its runs share one unknown slope


@dataclass(frozen=True)
class Run:
    """Readings with one set-up of the instrument, and so with one unknown zero per channel."""

    name: str  # name in the file
    # (3,): unit vector of the run's line in ``base``, in the forward direction; zero for a run that is not a line.
    # Forward: the first of the coordinates x, y, z in the work frame that changes along the line increases.
    axis: np.ndarray
    origin: np.ndarray  # (3,): first commanded position of the measured point, m in ``base``
    known_zero: bool = False  # whether the zero of the run's distances is known
    slope: str = ""  # name of an optical square, whose runs share one slope; empty: the run has its own slope

    @property
    def is_line(self) -> bool:
        return bool(self.axis.any())

    @property
    def base_axis(self) -> int | None:
        """Index, 0, 1 or 2, of the axis of ``base`` to which the run's line is parallel; None: oblique or no line."""
        parallel = np.flatnonzero(np.abs(self.axis) > PARALLEL)
        return int(parallel[0]) if len(parallel) else None


@dataclass(frozen=True)
class Stations(Surroundings):
    """M stations of the machine: commanded poses, strut commands, directions of motion and surroundings."""

    positions: np.ndarray  # (M, 3): of the commanded ``pose_platform_in_base``, m
    rotations: np.ndarray  # (M, 3, 3): of the same poses
    commands: np.ndarray  # (M, 6): commanded strut lengths, or strut lengths read by encoders, m
    sense: np.ndarray  # (M, 9): directions of motion as in :class:`hexapod_comp.machine.model.MotionState`

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def thermometers(self) -> tuple[str, ...]:
        """Parts whose temperature was read; a part with exactly 20 °C at every station is assumed not read."""
        return tuple(PARTS[n] for n in np.flatnonzero((self.temperatures != REFERENCE_TEMPERATURE).any(axis=0)))

    def select(self, chosen: np.ndarray | slice) -> Stations:
        """Return the stations that `chosen` selects: a mask of shape (M,), an array of indices, or a slice."""
        return Stations(**{entry.name: getattr(self, entry.name)[chosen] for entry in fields(self)})

    def pose(self, index: int) -> Pose:
        return Pose(self.positions[index], self.rotations[index])


@dataclass(frozen=True)
class MeasurementSet:
    """N readings of one machine, as arrays with one entry per reading.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine as designed.
    probe : ndarray, shape (3,)
        The measured point (reflector, target) in ``platform``, m.
    runs : tuple of Run
        Runs in order of appearance.
    stations : Stations
        The distinct stations at which the readings were taken.
    station, run, cycle, direction, channel : ndarray of int, shape (N,)
        For each reading: indices of station, run and channel; number of the pass; direction, such as ``FORWARD``.
    value, uncertainty : ndarray, shape (N,)
        Measured error and its standard deviation, m or rad; NaN for an unknown standard deviation.
    centre : ndarray, shape (N, 3)
        Channel ``length``: approximate point from which the distance is read (such as a ball bar's socket), m in
        ``base``; NaN for other channels. All centres of a run are fixed to one rigid body of unknown pose.
    sources : tuple of FileLine
        File and line of each reading.
    files : tuple of (str, str)
        Name and SHA-256 of each file that was read.
    notes : tuple of str
        Remarks for the report.
    """

    geometry: HexapodGeometry
    probe: np.ndarray
    runs: tuple[Run, ...]
    stations: Stations
    station: np.ndarray
    run: np.ndarray
    cycle: np.ndarray
    direction: np.ndarray
    channel: np.ndarray
    value: np.ndarray
    uncertainty: np.ndarray
    centre: np.ndarray
    sources: tuple[FileLine, ...]
    files: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.value)

    @property
    def kind(self) -> np.ndarray:
        """Kind of each reading's channel, as an index into :data:`KINDS`, shape (N,)."""
        return KIND_OF[self.channel]

    @property
    def stated(self) -> np.ndarray:
        """Standard deviation of each reading, (N,), m or rad: the file's, or else that of `DEFAULT_UNCERTAINTY`."""
        defaults = np.array([DEFAULT_UNCERTAINTY[kind] for kind in KINDS])[self.kind]
        return np.where(np.isfinite(self.uncertainty), self.uncertainty, defaults)

    def stated_of(self, kind: int) -> float:
        """Return the RMS standard deviation of the readings of one kind of channel, m or rad; 1 if there are none."""
        members = self.stated[self.kind == kind]
        return rms(members) if len(members) else 1.0

    def misfit(self, noise: Mapping[int, float], times: float) -> str:
        """Describe kinds of channel with an estimated `noise` above `times` · the stated σ, or with too large a σ."""
        large, coarse = [], []
        for kind, value in noise.items():
            stated, unit = self.stated_of(kind), f"µ{si_unit(KINDS[kind])}"
            usual = DEFAULT_UNCERTAINTY[KINDS[kind]]
            if stated > COARSEST * usual and KINDS[kind] not in ("position", "attitude"):
                coarse.append(f"{KINDS[kind]} {stated * 1e6:.3g} {unit}, usual is {usual * 1e6:.3g} {unit}")
            if value > times * stated:
                given = np.isfinite(self.uncertainty[self.kind == kind]).any()
                source = "stated" if given else "assumed, since the file states none"
                ratio = f"{value / stated:.3g} times the {stated * 1e6:.3g} {unit} {source}"
                large.append(f"{KINDS[kind]} by {value * 1e6:.3g} {unit}, {ratio}")
        problems = {
            f"readings scatter by more than {times:g} times their noise": large,
            "stated uncertainties are too large for any such instrument (is the unit right?)": coarse,
        }
        return "; ".join(f"{problem}: {'; '.join(kinds)}" for problem, kinds in problems.items() if kinds)

    def directions(self) -> np.ndarray:
        """Return each reading's direction w in ``base``, (N, 6): value = w · tool error (dx, dy, dz, rx, ry, rz)."""
        axes = self.geometry.work.rotation.T  # row a: the work frame's axis a, in base
        fixed = np.zeros((len(CHANNELS), 6))
        for index, channel in enumerate(CHANNELS):
            kind, _, axis = channel.partition("_")
            if not axis:
                continue
            part = slice(3, 6) if si_unit(kind) == "rad" else slice(0, 3)
            fixed[index, part] = axes[AXES.index(axis)]
        weights = fixed[self.channel]
        linear = self.channel == 0
        weights[linear, :3] = np.array([run.axis for run in self.runs]).reshape(-1, 3)[self.run[linear]]
        length = self.channel == LENGTH
        away = self.points()[self.station[length]] - self.centre[length]
        weights[length, :3] = away / np.linalg.norm(away, axis=1, keepdims=True)
        return weights

    def points(self) -> np.ndarray:
        """Return the commanded position of the measured point at each station, shape (M, 3), m in ``base``."""
        return self.stations.positions + self.stations.rotations @ self.probe

    def level(self) -> np.ndarray:
        """Return the platform attitude in ``base`` that reports call level, as a rotation matrix.

        Usually the tool is parallel to the work frame at this attitude. But if all stations are nearer to their mean
        attitude than the parallel attitude is, the attitude of the station nearest to the mean is called level.
        """
        rotations = self.stations.rotations
        parallel = self.geometry.work.rotation @ self.geometry.tool.rotation.T
        mean = nearest_rotation(rotations.sum(axis=0))
        away = np.linalg.norm(attitude_error(rotations, mean), axis=1)
        if np.linalg.norm(attitude_error(parallel, mean)) <= away.max() + SAME_ATTITUDE:
            return parallel
        return rotations[away.argmin()]

    def tilt(self) -> float:
        """Return the largest angle between the attitude of a station and :meth:`level`, rad."""
        return float(np.linalg.norm(attitude_error(self.stations.rotations, self.level()), axis=1).max())

    def tool_box(self) -> np.ndarray:
        """Return the corners (lowest, highest) of the commanded tool positions, shape (2, 3), m in ``work``."""
        positions, _ = self.geometry.tool_poses(self.stations.positions, self.stations.rotations)
        return np.array([positions.min(axis=0), positions.max(axis=0)])

    def along(self) -> np.ndarray:
        """Return each reading's commanded distance along its line from the run's first point, shape (N,), m."""
        origins = np.array([run.origin for run in self.runs]).reshape(-1, 3)
        axes = np.array([run.axis for run in self.runs]).reshape(-1, 3)
        return ((self.points()[self.station] - origins[self.run]) * axes[self.run]).sum(axis=1)

    def square_levers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how much each straightness reading changes with a rotation of its optical square, (N,), m/rad.

        A rotation ω of the square changes a reading by (ω × a) · s: a is the vector from the run's first point to the
        reading's point, s the direction in which straightness is read. The second array, (N,), has for each reading
        the index of the work axis along which ω points.
        """
        in_work = np.array([run.axis for run in self.runs]).reshape(-1, 3) @ self.geometry.work.rotation
        ways, seen = in_work[self.run], (self.channel - CHANNELS.index("straightness_x")) % 3
        about = 3 - seen - np.where(np.abs(ways).argmax(axis=1) == seen, (seen + 1) % 3, np.abs(ways).argmax(axis=1))
        turned = np.cross(np.eye(3)[about], ways)
        levers = np.take_along_axis(turned, seen[:, None], axis=1)[:, 0] * self.along()
        return np.where(self.kind == KINDS.index("straightness"), levers, 0.0), about

    def select(self, mask: np.ndarray) -> MeasurementSet:
        """Return the readings that `mask`, shape (N,), selects; indices of runs and stations stay valid."""
        arrays = ("station", "run", "cycle", "direction", "channel", "value", "uncertainty", "centre")
        chosen = {name: getattr(self, name)[mask] for name in arrays}
        return replace(self, sources=tuple(s for s, m in zip(self.sources, mask, strict=True) if m), **chosen)

    def with_values(self, value: np.ndarray) -> MeasurementSet:
        return replace(self, value=value)


def refuse_impossible(measurements: MeasurementSet) -> None:
    """Raise a CalibrationError if the magnitude of a reading exceeds `LARGEST_READING`."""
    worst = int(np.abs(measurements.value).argmax())
    if not abs(value := measurements.value[worst]) <= LARGEST_READING:
        where = f"{measurements.sources[worst]}, {CHANNELS[measurements.channel[worst]]}"
        of_tracker = KINDS[measurements.kind[worst]] in ABSOLUTE_KINDS
        question = "are the unit and the tracker's frame right?" if of_tracker else "is the unit right?"
        problem = f"the error, actual minus commanded, is {value:g} m or rad, allowed is ±{LARGEST_READING:g}"
        raise CalibrationError(where, f"{problem}; {question}")


def refuse_unmoved(measurements: MeasurementSet, residuals: np.ndarray) -> None:
    """Raise a CalibrationError if a kind of channel has no noise: all of its residuals are within ±`LEAST_NOISE`."""
    for k in np.unique(measurements.kind):
        members = measurements.kind == k
        if np.abs(residuals[members]).max() <= LEAST_NOISE:
            zero = not measurements.value[members].any()
            problem = "are all zero" if zero else "never change within a run, or are exactly the commanded values"
            hint = "was the instrument connected? Readings without any error contain no information: leave them out"
            raise CalibrationError(f"{KINDS[k]}", f"the {members.sum()} readings {problem}: {hint}")


def spans(points: np.ndarray) -> bool:
    """Return whether `points`, (n, 3), m, span a box: every side of their bounding box is at least `LEAST_SIDE`."""
    return bool((np.ptp(points, axis=0) >= LEAST_SIDE).all())
