"""Measured data of a machine, whatever instrument they come from, in one form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from ..errors import CalibrationError
from ..machine.arrays import rms
from ..machine.geometry import HexapodGeometry
from ..machine.surroundings import NO_LOAD, Surroundings
from ..machine.temperatures import REFERENCE_TEMPERATURE, Temperatures
from ..pose import Pose, attitude_error, nearest_rotation

AXES = ("x", "y", "z")
# What a reading is of. ``linear`` is along the run's line, ``length`` from a centre; the others are along or about an
# axis of the work frame. Straightness and rotation belong to lines and have unknown zeros, displacement has one
# wherever the poses are; position and attitude are absolute.
CHANNELS = (
    "linear",
    *(f"straightness_{a}" for a in AXES),
    *(f"rotation_{a}" for a in AXES),
    *(f"position_{a}" for a in AXES),
    *(f"attitude_{a}" for a in AXES),
    "length",
    *(f"displacement_{a}" for a in AXES),
)

LINE_KINDS = ("linear", "straightness", "rotation")  # kinds of channel that are read along a line
ABSOLUTE_KINDS = ("position", "attitude")  # kinds of channel without an unknown zero
# Kinds of channel: those of one kind share an instrument and its noise
KINDS = (*LINE_KINDS, *ABSOLUTE_KINDS, "length", "displacement")
LENGTH = CHANNELS.index("length")  # the channel of distances from a centre
# Kind of each channel, as an index
KIND_OF = np.array([KINDS.index(channel.partition("_")[0]) for channel in CHANNELS])
# Standard deviation of a reading where neither the file nor repeated readings tell, m or rad
DEFAULT_UNCERTAINTY = dict(zip(KINDS, (1e-6, 1e-6, 1e-6, 10e-6, 10e-6, 1e-6, 1e-6), strict=True))
ANGULAR_KINDS = ("rotation", "attitude")
# How a station was approached; FROM_PREVIOUS: from the command in the row before
FORWARD, BACKWARD, UNKNOWN, FROM_PREVIOUS = 1, -1, 0, 2
SAME_ATTITUDE = 1e-6  # attitudes that differ by less, rad, are one
LEAST_SIDE = 1e-6  # A box of which a side is shorter, m, is a line or a plane
# No instrument reads better, m or rad; also keeps readings without noise from having infinite weight
LEAST_NOISE = 1e-9
# Factor on the assumed noise of an instrument (trackers and cameras apart) above which a unit must be wrong
COARSEST = 300.0
LARGEST_READING = 1.0  # no machine errs by more, and no instrument's zero lies further off, m or rad
LEAST_TRAVEL = 1e-6  # components of a line shorter than this, m, are no travel along that axis


class FileLine(NamedTuple):
    """Where a reading stands."""

    file: str  # name of the file, or of what made the reading
    line: int  # line in it; 0 when it has none

    def __str__(self) -> str:
        return f"{self.file}: line {self.line}" if self.line else self.file


class Reading(NamedTuple):
    """One reading as an instrument or a file gives it, in SI; the unit in which files become sets."""

    run: str  # readings of one run share the unknown zeros
    cycle: int  # which of several passes of the run, from 1
    direction: int  # ``FORWARD``, ``BACKWARD``, ``UNKNOWN`` or ``FROM_PREVIOUS``
    pose: Pose  # commanded ``pose_tool_in_work``
    channel: str  # one of :data:`CHANNELS`
    value: float  # error read, actual minus commanded, m or rad
    uncertainty: float = np.nan  # its standard deviation; NaN when not known
    temperatures: tuple[float, ...] = (REFERENCE_TEMPERATURE,) * 8  # struts 1–6, base, platform, °C
    # strut readings, m, when the file has them; otherwise the machine was told nominal lengths
    commands: tuple[float, ...] | None = None
    source: FileLine = FileLine("", 0)  # for messages
    time: float = np.nan  # when it was taken, s, on a clock that all readings share; NaN when not known
    # from where a length is read: a place in the work frame, m, known to some millimetres; None for others
    centre: tuple[float, ...] | None = None
    known_zero: bool = False  # a length that is known as a whole, as with a calibrated bar
    humidity: float = np.nan  # relative humidity of the air, a fraction; NaN when not known
    load: tuple[float, ...] = NO_LOAD  # mass, kg, its centre in platform, m, and gravity in base, m/s²; NaN: as usual
    slope: str = ""  # runs of this name read their straightness from one square, whose faces' slope they share


@dataclass(frozen=True)
class Run:
    """What the readings of one run share."""

    name: str  # as in the file
    # (3,): unit vector of the run's line in ``base``, zero for scattered poses. It points along the first of x, y, z
    # along which the line travels: that is forward.
    axis: np.ndarray
    origin: np.ndarray  # (3,): first commanded point of the line, m in ``base``
    known_zero: bool = False  # its lengths are known as a whole
    slope: str = ""  # the square or straightedge whose slope it shares with other runs; empty: one of its own

    @property
    def is_line(self) -> bool:
        """Whether its points lie on a line."""
        return bool(self.axis.any())

    @property
    def base_axis(self) -> int | None:
        """0, 1 or 2 for a line parallel to x, y or z of ``base``, None for any other."""
        parallel = np.flatnonzero(np.abs(self.axis) > 1.0 - 1e-9)
        return int(parallel[0]) if len(parallel) else None


@dataclass(frozen=True)
class Stations(Surroundings):
    """Where the machine stood, M times: commands, and what acted on it."""

    positions: np.ndarray  # (M, 3): commanded ``pose_platform_in_base``, m
    rotations: np.ndarray  # (M, 3, 3)
    commands: np.ndarray  # (M, 6): strut commands, or encoder readings, m
    sense: np.ndarray  # (M, 9): directions of motion as in :class:`hexapod_comp.machine.model.MotionState`

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, chosen: np.ndarray | slice) -> Stations:
        """Return those in a mask, at indices or of a slice."""
        return Stations(**{entry.name: getattr(self, entry.name)[chosen] for entry in fields(self)})

    def pose(self, index: int) -> Pose:
        """Return a commanded ``pose_platform_in_base``."""
        return Pose(self.positions[index], self.rotations[index])

    def temperature(self, index: int) -> Temperatures:
        """Return the temperatures of a station."""
        return Temperatures(dict(zip(Temperatures.NAMES, self.temperatures[index].tolist(), strict=True)))


@dataclass(frozen=True)
class MeasurementSet:
    """Readings of one machine; arrays have one entry a reading.

    Attributes
    ----------
    geometry : HexapodGeometry
        The machine as designed.
    probe : ndarray, shape (3,)
        The measured point (reflector, target) in ``platform``, m.
    runs : tuple of Run
        Runs in order of appearance.
    stations : Stations
        Distinct places.
    station, run, cycle, direction, channel : ndarray of int, shape (N,)
        Indices of station, run and channel; number of the pass; direction.
    value, uncertainty : ndarray, shape (N,)
        m or rad; NaN where the uncertainty is not known.
    centre : ndarray, shape (N, 3)
        Approximate point from which a length is read (ball bar, tracker), m in ``base``; NaN for other readings. The
        centres of one run belong to one body, whose place and attitude are unknown.
    sources : tuple of FileLine
        Where each reading stands.
    files : tuple of (str, str)
        Name and SHA-256 of each file read.
    notes : tuple of str
        What the reader found odd, for the report.
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
        """Index into :data:`KINDS` of each reading."""
        return KIND_OF[self.channel]

    @property
    def stated(self) -> np.ndarray:
        """Standard deviation of each reading, shape (N,), m or rad: its file's, else :data:`DEFAULT_UNCERTAINTY`."""
        defaults = np.array([DEFAULT_UNCERTAINTY[kind] for kind in KINDS])[self.kind]
        return np.where(np.isfinite(self.uncertainty), self.uncertainty, defaults)

    def stated_of(self, kind: int) -> float:
        """Return the root mean square of :attr:`stated` over a kind's readings, m or rad; 1 where there are none."""
        members = self.stated[self.kind == kind]
        return rms(members) if len(members) else 1.0

    def misfit(self, noise: Mapping[int, float], times: float) -> str:
        """Return the kinds of reading whose residuals or stated σ exceed `times` their noise, with the factor."""
        far, coarse = [], []
        for kind, value in noise.items():
            stated, unit = self.stated_of(kind), "µrad" if KINDS[kind] in ANGULAR_KINDS else "µm"
            usual = DEFAULT_UNCERTAINTY[KINDS[kind]]
            if stated > COARSEST * usual and KINDS[kind] not in ("position", "attitude"):
                coarse.append(f"{KINDS[kind]} by {stated * 1e6:.3g} {unit}, where {usual * 1e6:.3g} {unit} are usual")
            if value > times * stated:
                given = np.isfinite(self.uncertainty[self.kind == kind]).any()
                source = "stated" if given else "assumed, since the file states none"
                ratio = f"{value / stated:.3g} times the {stated * 1e6:.3g} {unit} {source}"
                far.append(f"{KINDS[kind]} by {value * 1e6:.3g} {unit}, {ratio}")
        problems = {
            f"readings are off by more than {times:g} times their noise": far,
            "readings are stated to be uncertain as no such instrument is, do units fit": coarse,
        }
        return "; ".join(f"{problem}: {'; '.join(kinds)}" for problem, kinds in problems.items() if kinds)

    def directions(self) -> np.ndarray:
        """Return w of each reading, shape (N, 6): value = w · (dx, dy, dz, rx, ry, rz) in ``base``."""
        axes = self.geometry.work.rotation.T  # row a: the work frame's axis a, in base
        fixed = np.zeros((len(CHANNELS), 6))
        for index, channel in enumerate(CHANNELS):
            kind, _, axis = channel.partition("_")
            if not axis:
                continue
            part = slice(3, 6) if kind in ANGULAR_KINDS else slice(0, 3)
            fixed[index, part] = axes[AXES.index(axis)]
        weights = fixed[self.channel]
        linear = self.channel == 0
        weights[linear, :3] = np.array([run.axis for run in self.runs]).reshape(-1, 3)[self.run[linear]]
        length = self.channel == LENGTH
        away = self.points()[self.station[length]] - self.centre[length]
        weights[length, :3] = away / np.linalg.norm(away, axis=1, keepdims=True)
        return weights

    def points(self) -> np.ndarray:
        """Return the commanded place of the measured point at each station, shape (M, 3), m in ``base``."""
        return self.stations.positions + self.stations.rotations @ self.probe

    def level(self) -> np.ndarray:
        """Return the platform's attitude that reports call level, shape (3, 3), in ``base``.

        The tool parallel to the work frame, where the stations surround such an attitude or have it. Otherwise
        the machine was measured turned, and the station nearest to the mean of all attitudes stands for them.
        """
        rotations = self.stations.rotations
        parallel = self.geometry.work.rotation @ self.geometry.tool.rotation.T
        mean = nearest_rotation(rotations.sum(axis=0))
        away = np.linalg.norm(attitude_error(rotations, mean), axis=1)
        if np.linalg.norm(attitude_error(parallel, mean)) <= away.max() + SAME_ATTITUDE:
            return parallel
        return rotations[away.argmin()]

    def tilt(self) -> float:
        """Return how far the tool was tilted or turned at most, from :meth:`level`, rad."""
        return float(np.linalg.norm(attitude_error(self.stations.rotations, self.level()), axis=1).max())

    def tool_box(self) -> np.ndarray:
        """Return the lowest and highest commanded tool position, shape (2, 3), m in ``work``."""
        positions, _ = self.geometry.tool_poses(self.stations.positions, self.stations.rotations)
        return np.array([positions.min(axis=0), positions.max(axis=0)])

    def along(self) -> np.ndarray:
        """Return each reading's commanded coordinate along its line, from the run's first point, m, (N,)."""
        origins = np.array([run.origin for run in self.runs]).reshape(-1, 3)
        axes = np.array([run.axis for run in self.runs]).reshape(-1, 3)
        return ((self.points()[self.station] - origins[self.run]) * axes[self.run]).sum(axis=1)

    def square_levers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of each straightness reading per angle by which its square turns, m/rad, and the axis, 0…2.

        Shape (N,) each. A face along a turns about ω to ω × a: seen along s, the third of these axes, by ω × a · s. Of
        a line that is not parallel to an axis the lever is shorter; other readings have none.
        """
        in_work = np.array([run.axis for run in self.runs]).reshape(-1, 3) @ self.geometry.work.rotation
        ways, seen = in_work[self.run], self.channel - CHANNELS.index("straightness_x")
        seen = np.where(self.kind == KINDS.index("straightness"), seen, 0)
        about = 3 - seen - np.where(np.abs(ways).argmax(axis=1) == seen, (seen + 1) % 3, np.abs(ways).argmax(axis=1))
        turned = np.cross(np.eye(3)[about], ways)
        levers = np.take_along_axis(turned, seen[:, None], axis=1)[:, 0] * self.along()
        return np.where(self.kind == KINDS.index("straightness"), levers, 0.0), about

    def select(self, mask: np.ndarray) -> MeasurementSet:
        """Return the set of the readings in a boolean mask (N,); runs and stations keep their numbers."""
        arrays = ("station", "run", "cycle", "direction", "channel", "value", "uncertainty", "centre")
        chosen = {name: getattr(self, name)[mask] for name in arrays}
        return replace(self, sources=tuple(s for s, m in zip(self.sources, mask, strict=True) if m), **chosen)

    def with_values(self, value: np.ndarray) -> MeasurementSet:
        """Return the same stations with other readings, shape (N,), m or rad."""
        return replace(self, value=value)


def refuse_impossible(measurements: MeasurementSet) -> None:
    """Refuse values that no reading has, as :func:`.runs.assemble` does: sets may have been changed since."""
    impossible = np.flatnonzero(~(np.abs(measurements.value) <= LARGEST_READING))
    if len(impossible):
        first = impossible[0]
        where = f"{measurements.sources[first]}, {CHANNELS[measurements.channel[first]]}"
        value = measurements.value[first]
        problem = f"the value is {value:g} m or rad, allowed ±{LARGEST_READING:g}; does the unit fit?"
        raise CalibrationError(where, problem)


def refuse_unmoved(measurements: MeasurementSet, left: np.ndarray) -> None:
    """Refuse a kind of reading that shows nothing: an instrument without any noise would have infinite weight."""
    for k in np.unique(measurements.kind):
        members = measurements.kind == k
        if np.abs(left[members]).max() <= LEAST_NOISE:
            zero = not measurements.value[members].any()
            problem = "are all zero" if zero else "never change within a run, or are just what the machine was told"
            hint = "was the instrument connected? Such readings tell nothing; leave them out"
            raise CalibrationError(f"{KINDS[k]}", f"the {members.sum()} readings {problem}: {hint}")


def spans(points: np.ndarray) -> bool:
    """Return whether points (n, 3), m, span a box."""
    return bool((np.ptp(points, axis=0) >= LEAST_SIDE).all())
