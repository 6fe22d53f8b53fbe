"""Collects a campaign's readings on a running machine, stop by stop, into a tidy CSV file.

``fit`` can read the file at any time; after an interruption :func:`collect` continues at the first missing stop.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from ..core.batch import quaternion_of
from ..errors import HexapodError, InputFileError, PoseError
from ..machine.geometry import HexapodGeometry
from ..machine.passes import APPROACH
from ..pose import Pose, attitude_error
from .campaign import Campaign, campaign_readings
from .readings import (
    BACKWARD,
    FORWARD,
    FROM_PREVIOUS,
    LINE_KINDS,
    NO_LOAD,
    UNKNOWN,
    FileLine,
    MeasurementSet,
    Reading,
    Run,
    si_unit,
)
from .runs import MeasuredFile, assemble
from .set_up import (
    FREE,
    KNOWN,
    LARGEST_ERROR,
    PoseCheck,
    SetUpError,
    TravelCheck,
    check_nudges,
    nudge,
    nudge_tolerance,
)
from .tidy import read_tidy, write_measurements

__all__ = ["Collected", "InstrumentMachine", "MeasuredMachine", "Observation", "RunSetUp", "SetUpError", "collect"]

SAVE_EVERY = 5.0  # time between two writes of the file, s; it is also written before an instrument is set up
PASSES = (FORWARD, BACKWARD)
# Two estimates of the tracker's frame may place the tool this far apart, m; a larger distance means a moved tracker
LARGEST_FRAME_SHIFT = 2.0 * LARGEST_ERROR
BROKEN_BEAM = "a broken beam"
FRAME_REMARK = "tracker frame in base, mm and quaternion: "  # first line of a file in a free tracker frame
OPEN = "open"  # text in the file in place of the tracker's frame, until the frame is estimated


class Observation(NamedTuple):
    """All readings at one stop of the machine."""

    pose: Pose | None  # averaged pose of the tool in ``base`` or in the tracker's frame; None: poses are not measured
    # (6,): σ of the position along, and of the attitude about, the axes of the same frame, m and rad; NaN: unknown
    uncertainty: np.ndarray
    struts: tuple[float, ...] | None = None  # measured strut lengths, m
    temperatures: tuple[float, ...] | None = None  # of struts 1–6, base and platform, °C; 20 °C without a thermometer
    time: float = math.nan  # time of the readings, s
    # By channel: the reading, with an arbitrary zero, and its standard deviation, m or rad
    channels: Mapping[str, tuple[float, float]] = {}
    zero_lost: bool = False  # whether the beam was broken since the last observation, so that zeros are lost
    gravity: tuple[float, ...] | None = None  # gravity in ``base``, m/s²
    humidity: float = math.nan  # relative humidity of the air, a fraction; NaN: not published


class RunSetUp(NamedTuple):
    """Describes a run of a campaign for which the instrument must be set up."""

    name: str
    channels: tuple[str, ...]
    # Pose in ``base`` at which the instrument is set up: on a line its first point, with x in the forward direction;
    # for distances their first centre; in any other run the first commanded pose of the tool
    place: Pose


class MeasuredMachine(Protocol):
    """A machine that moves to poses, with an instrument that measures its tool."""

    def move(self, pose: Pose) -> object:
        """Move the tool to ``pose_tool_in_work``, wait until it has settled; raise HexapodError if this fails."""

    def observe(self) -> Observation | None:
        """Return the readings at this stop; None if the instrument reads nothing, for example with a broken beam."""


@runtime_checkable
class InstrumentMachine(MeasuredMachine, Protocol):
    """A machine whose instrument must be set up anew for each run."""

    def set_up(self, run: RunSetUp) -> Collection[str]:
        """Set up the instrument; return the run's channels that it reads. Measured poses give the other channels."""


class Visit(NamedTuple):
    """One stop of the machine at a pose, in one pass of a run, with all readings that are taken there."""

    run: str
    cycle: int
    direction: int
    pose: Pose  # ``pose_tool_in_work``
    readings: tuple[int, ...]  # indices into the campaign's readings
    first_of_pass: bool
    approach: Pose | None  # pose from which all struts move to `pose` in the direction of the pass; None: from any pose

    @property
    def where(self) -> str:
        return f"{self.run}, cycle {self.cycle}, at {(self.pose.position * 1e3).round(3).tolist()} mm"


@dataclass(frozen=True)
class Collected:
    """Result of :func:`collect`."""

    measurements: MeasurementSet
    resumed: int  # number of stops whose readings were in the file before the call
    missing: tuple[str, ...]  # texts: stops at which the instrument read nothing, and runs whose zero was lost


def collect(
    campaign: Campaign,
    geometry: HexapodGeometry,
    machine: MeasuredMachine,
    path: str | Path,
    seed: int = 0,
    attempts: int = 3,
    progress: Callable[[int, int, str], object] = lambda done, of, text: None,
    going_on: Callable[[], bool] = lambda: True,
    tracker_frame: str = KNOWN,
) -> Collected:
    """Visit a campaign's stops in order and write the readings to `path` as tidy CSV, even if an error ends the visit.

    An existing file must hold readings of this campaign; the missing readings are added. At each stop a reading is
    requested at most `attempts` times; a run whose zero is lost is measured again, at most `attempts` times in all.
    `progress` gets the number of finished stops, the number of all stops and the name of the next stop. The collection
    ends if `going_on` returns False. With the `tracker_frame` ``free``, the first stops determine the tracker's frame.
    A SetUpError reports a mistake in sign, unit, channel, frame or target; an InputFileError, another campaign's file.
    """
    work = _Collecting(geometry, machine, list(campaign_readings(campaign, seed)), path, attempts, tracker_frame)
    work.progress, work.going_on = progress, going_on
    try:
        for _, stops in groupby(range(len(work.visits)), lambda k: work.visits[k].run):
            if not going_on():
                break
            work.run(list(stops))
        work.poses.end()
    finally:
        whole = work.save()
    if whole is None:
        read = "only one point of a line, but a file needs two" if work.found else "nothing, so no file was written"
        when = "" if going_on() else "before the collection was interrupted, "
        raise InputFileError(path, "", f"{when}the instrument read {read}")
    return Collected(whole, work.resumed, tuple(work.missing))


class _Collecting:
    """A collection in progress: the readings taken so far, and the estimate of the tracker's frame."""

    def __init__(
        self,
        geometry: HexapodGeometry,
        machine: MeasuredMachine,
        listed: list[Reading],
        path: str | Path,
        attempts: int,
        tracker_frame: str,
    ) -> None:
        self._geometry, self._machine, self._listed, self._path = geometry, machine, listed, path
        self._attempts = attempts
        self._plan = assemble(geometry, [reading._replace(source=FileLine("campaign", 0)) for reading in listed])
        self._directions, points = self._plan.directions(), self._plan.points()
        away = np.linalg.norm(points[self._plan.station] - self._plan.centre, axis=1)
        # Commanded coordinate along the line or, for channel ``length``, commanded distance from the centre, m
        self._commanded = np.where(np.isnan(away), self._plan.along(), away)
        self.visits, self.missing, self.resumed = list(_visits(listed)), list[str](), 0
        angular = any(si_unit(reading.channel) == "rad" for reading in listed)
        self.poses = PoseCheck(geometry.characteristic_length, tracker_frame, angular)
        self._frame: Pose | None = Pose.identity() if tracker_frame == KNOWN else None
        self.found: dict[int, Reading] = {}
        if Path(path).exists():
            file = read_tidy(path, geometry)
            self.found = _resumed(file, listed)
            self._frame = _stated_frame(file, tracker_frame)
        self._unplaced: list[tuple[int, Observation, Pose]] = []  # readings taken before the frame is estimated
        self._nudged: set[tuple[str, ...]] = set()  # sets of channels that were checked by small moves of the tool
        self._saved, self._present_stop = time.monotonic(), -1  # time of the last save, s; number of the stop
        self.progress: Callable[[int, int, str], object]
        self.going_on: Callable[[], bool]

    # ---- runs and stops ----

    def run(self, stops: Sequence[int]) -> None:
        """Visit the stops of a run that have no reading yet; if the instrument loses its zero, repeat the whole run."""
        if self._all_found(stops):
            self.resumed += len(stops)
            return
        readings = [n for k in stops for n in self.visits[k].readings]
        channels = tuple(dict.fromkeys(self._listed[n].channel for n in readings))
        run = self._plan.runs[self._plan.run[readings[0]]]
        own: Collection[str] = ()
        if isinstance(self._machine, InstrumentMachine):
            self.save()  # a person may take long
            place = self._instrument_pose(run, self.visits[stops[0]])
            read = self._machine.set_up(RunSetUp(run.name, channels, place))
            own = [c for c in channels if c in read]
        counting = bool(own) and not run.known_zero
        missing, causes = list(self.missing), list[str]()
        for _ in range(self._attempts if counting else 1):
            self.missing = list(missing)
            if counting:  # readings that are in the file may have another zero, so measure the whole run again
                for n in readings:
                    self.found.pop(n, None)
            cause = self._pass_over(stops, own, counting)
            if not cause:
                break
            causes.append(cause)
        else:
            if BROKEN_BEAM not in causes:
                question = "is the centre or the target not at its stated place, or is an obstacle in the beam"
                raise SetUpError(f"{causes[-1]}, in each of {self._attempts} attempts: {question}?")
            self.missing.append(f"{run.name}, whose zero was lost {self._attempts} times")

    def _all_found(self, stops: Sequence[int]) -> bool:
        return all(n in self.found for k in stops for n in self.visits[k].readings)

    def _instrument_pose(self, run: Run, first: Visit) -> Pose:
        """Return the pose in ``base`` at which the instrument is set up, see :attr:`RunSetUp.place`."""
        n = first.readings[0]
        if run.is_line:
            across = np.linalg.svd(run.axis[None])[2][1]
            return Pose(run.origin, np.column_stack([run.axis, across, np.cross(run.axis, across)]))
        pose = self._geometry.work @ first.pose
        return pose if self._listed[n].centre is None else Pose(self._plan.centre[n], np.eye(3))

    def _pass_over(self, stops: Sequence[int], own: Collection[str], counting: bool) -> str:
        """Visit the stops that have no reading yet; return why the instrument lost its zero, or "" if it did not."""
        zeros: dict[str, float] = {}
        checked = not own or tuple(own) in self._nudged
        checks = {channel: TravelCheck(channel, checked) for channel in own}
        for k in stops:
            visit = self.visits[k]
            if self._all_found([k]):
                self.resumed += 1
                continue
            if not self.going_on():
                return ""
            self.progress(k, len(self.visits), visit.where)
            self._move_to_stop(k)
            if not checked:
                if not self._check_channels(visit, own):
                    return BROKEN_BEAM
                checked = True
                self._move_to_stop(k)
            seen = self._observe()
            if seen is None:
                self.missing.append(visit.where)
                continue
            if seen.zero_lost and counting and zeros:
                return BROKEN_BEAM
            if jumped := self._add_channels(visit, seen, checks, zeros):
                if counting:
                    return jumped
                self.missing.append(visit.where)
                continue
            self._add_pose(visit, seen, own)
            if time.monotonic() - self._saved > SAVE_EVERY:
                self.save()
        return ""

    def _move_to_stop(self, k: int) -> None:
        """Move to stop `k`, if necessary by way of the pose from which all struts move in the direction of the pass."""
        visit = self.visits[k]
        if visit.approach is not None and (visit.first_of_pass or self._present_stop != k - 1):
            self._move(visit.approach)
        self._machine.move(visit.pose)
        self._present_stop = k

    def _move(self, pose: Pose) -> bool:
        """Move to an auxiliary pose; return False if a limit of the machine forbids the move."""
        try:
            self._machine.move(pose)
        except HexapodError as error:
            if error.reason != "limit":
                raise
            return False
        return True

    def _observe(self) -> Observation | None:
        """Return the readings at the present stop; None if the instrument reads nothing in `attempts` attempts."""
        return next((o for o in (self._machine.observe() for _ in range(self._attempts)) if o is not None), None)

    def _check_channels(self, visit: Visit, own: Collection[str]) -> bool:
        """Raise a SetUpError if a channel does not follow small moves of the tool; return False for a broken beam."""
        chosen = [n for n in visit.readings if self._listed[n].channel in own]
        directions, before = self._directions[chosen], self._observe()
        names = [self._listed[n].channel for n in chosen]
        seen, tool = np.zeros((len(chosen), len(chosen))), self._geometry.work @ visit.pose
        for j, (direction, name) in enumerate(zip(directions, names, strict=True)):
            for sign in (1.0, -1.0):
                if self._move(self._geometry.work.inverse() @ nudge(tool, direction, name, sign)):
                    after = self._observe()
                    self._machine.move(visit.pose)
                    if before is None or after is None or after.zero_lost:
                        return False
                    seen[:, j] = [sign * (after.channels[c][0] - before.channels[c][0]) for c in names]
                    break
            else:
                raise SetUpError(f"a limit of the machine forbids the small move along {name} at {visit.where}")
        tolerances = [nudge_tolerance(self._listed[n].channel, float(self._commanded[n])) for n in chosen]
        check_nudges(names, directions, seen, tolerances)
        self._nudged.add(tuple(own))
        return True

    # ---- readings ----

    def _add_channels(
        self, visit: Visit, seen: Observation, checks: Mapping[str, TravelCheck], zeros: dict[str, float]
    ) -> str:
        """Add the instrument's readings at a stop; if a channel has jumped, add none and return a text on the jump."""
        added, jumped = {}, ""
        for n in visit.readings:
            reading = self._listed[n]
            if reading.channel in checks:
                (read, deviation), commanded = seen.channels[reading.channel], float(self._commanded[n])
                follows = reading.channel in ("linear", "length")
                if jump := checks[reading.channel].jump(commanded, read):
                    unit = si_unit(reading.channel)
                    jumped = f"{reading.channel} jumps by {jump * 1e3:.3g} m{unit} on the way to {visit.where}"
                value = read - (commanded if follows else 0.0)
                if not reading.known_zero:
                    value -= zeros.setdefault(reading.channel, value)
                added[n] = self._reading(reading, value, deviation, seen)
        if not jumped:
            self.found |= added
        return jumped

    def _add_pose(self, visit: Visit, seen: Observation, own: Collection[str]) -> None:
        """Compute readings of the stop's channels that are not in `own` from the measured tool pose, and add them."""
        wanted = [n for n in visit.readings if self._listed[n].channel not in own]
        if not wanted:
            return
        if seen.pose is None:
            self.missing.append(visit.where)
            return
        if not self.poses.plausible(self._geometry.work @ visit.pose, seen.pose):
            return  # the position is wrong; the checks at the next stops will report why
        self._unplaced += [(n, seen, seen.pose) for n in wanted]
        estimated = self.poses.frame()
        if self._frame is None:
            self._frame = estimated
        if self._frame is None:
            return
        shift = 0.0
        if estimated is not None:
            shift = float(np.linalg.norm((estimated @ seen.pose).position - (self._frame @ seen.pose).position))
        if shift > LARGEST_FRAME_SHIFT:
            text = f"the tracker was moved by about {shift * 1e3:.1f} mm since the file was begun"
            raise SetUpError(f"{text}, allowed are {LARGEST_FRAME_SHIFT * 1e3:g} mm: begin a new file")
        self.found |= {n: self._reading_from_pose(n, then, self._frame, pose) for n, then, pose in self._unplaced}
        self._unplaced.clear()

    def _reading_from_pose(self, n: int, seen: Observation, frame: Pose, pose: Pose) -> Reading:
        """Return the campaign's reading with index `n`, computed from a `pose` measured in the tracker's `frame`."""
        reading, w = self._listed[n], self._directions[n]
        commanded, measured = self._geometry.work @ reading.pose, frame @ pose
        off = measured.position - commanded.position
        if reading.channel == "length":
            centre = self._plan.centre[n]
            value = float(np.linalg.norm(measured.position - centre) - np.linalg.norm(commanded.position - centre))
        else:
            value = float(w @ np.concatenate([off, attitude_error(measured.rotation, commanded.rotation)]))
        along = np.concatenate([w[:3] @ frame.rotation, w[3:] @ frame.rotation])  # direction w in the tracker's frame
        return self._reading(reading, value, float(np.sqrt(along**2 @ seen.uncertainty**2)), seen)

    def _reading(self, reading: Reading, value: float, deviation: float, seen: Observation) -> Reading:
        payload = self._geometry.payload
        load = (payload.mass, *payload.centre) if payload.mass else NO_LOAD[:4]
        return reading._replace(
            value=value,
            uncertainty=deviation if deviation > 0.0 else math.nan,
            commands=seen.struts,
            temperatures=seen.temperatures or reading.temperatures,
            time=seen.time,
            humidity=seen.humidity,
            load=(*load, *(seen.gravity or NO_LOAD[4:])),
        )

    def save(self) -> MeasurementSet | None:
        """Write and return the readings (None if there are none); omit lines with one point, as a file needs two."""
        places: dict[str, set[bytes]] = {}
        for reading in self.found.values():
            places.setdefault(reading.run, set()).add(reading.pose.position.tobytes())
        self._set_directions()
        kept = [
            self.found[n]
            for n in sorted(self.found)
            if len(places[self.found[n].run]) > 1 or self.found[n].channel.partition("_")[0] not in LINE_KINDS
        ]
        self._saved = time.monotonic()
        if not kept:
            return None
        whole = assemble(self._geometry, kept)
        write_measurements(whole, self._path, self._frame_remark())
        return whole

    def _set_directions(self) -> None:
        """Set the direction of readings that are not on lines: unknown if the stop before them has no reading."""
        for before, visit in zip([None, *self.visits], self.visits, strict=False):
            if visit.direction not in PASSES:
                read = before is not None and before.run == visit.run and before.readings[0] in self.found
                for n in filter(self.found.__contains__, visit.readings):
                    self.found[n] = self.found[n]._replace(direction=FROM_PREVIOUS if read else UNKNOWN)

    def _frame_remark(self) -> str:
        """Return the file's first line: the tracker's estimated frame, or "" if the tracker measures in ``base``."""
        if not self.poses.free:
            return ""
        if self._frame is None:
            return FRAME_REMARK + OPEN
        numbers = *(self._frame.position * 1e3).tolist(), *quaternion_of(self._frame.rotation)
        return FRAME_REMARK + ", ".join(map(repr, numbers))


def _visits(listed: Sequence[Reading]) -> Iterator[Visit]:
    def stop(n: int) -> tuple[str, int, int, bytes]:
        r = listed[n]
        return r.run, r.cycle, r.direction, r.pose.position.tobytes() + r.pose.rotation.tobytes()

    stops = [tuple(members) for _, members in groupby(range(len(listed)), stop)]
    before: tuple[str, int, int] | None = None
    for k, members in enumerate(stops):
        r = listed[members[0]]
        this = r.run, r.cycle, r.direction
        approach = None
        if r.direction not in PASSES:  # in a run that is not a line, each pose is reached from the pose before
            approach = last.pose if k and (last := listed[stops[k - 1][0]]).run == r.run else None
            yield Visit(*this, r.pose, members, False, approach)
            continue
        # Approach a stop from the side opposite to the next stop; the last stop, from the side of the stop before
        for other, sign in ((k + 1, -1.0), (k - 1, 1.0)):
            there = listed[stops[other][0]] if 0 <= other < len(stops) else None
            if approach is None and there and (there.run, there.cycle, there.direction) == this:
                travel = sign * (there.pose.position - r.pose.position)
                if (length := float(np.linalg.norm(travel))) > 0.0:
                    approach = Pose(r.pose.position + travel * (APPROACH / length), r.pose.rotation)
        yield Visit(*this, r.pose, members, this != before, approach)
        before = this


def _resumed(file: MeasuredFile, listed: Sequence[Reading]) -> dict[int, Reading]:
    """Return the readings in a file by their index among the campaign's readings."""

    def key(run: str, cycle: int, direction: int, pose: Pose, channel: str) -> tuple[object, ...]:
        place = np.concatenate([pose.position * 1e6, pose.rotation.ravel() * 1e6]).round().astype(int)
        return run, cycle, direction if direction in PASSES else UNKNOWN, tuple(place.tolist()), channel

    numbers = dict[tuple[object, ...], list[int]]()  # in the campaign's order; a run may return to a place
    for n, r in enumerate(listed):
        numbers.setdefault(key(r.run, r.cycle, r.direction, r.pose, r.channel), []).append(n)
    found, newest = dict[int, Reading](), dict[str, int]()  # `newest`: number of a channel's newest reading
    for reading in file.readings:
        place = key(reading.run, reading.cycle, reading.direction, reading.pose, reading.channel)
        left = [n for n in numbers.get(place, ()) if n not in found]
        if not left:
            problem = f"run {reading.run}, {reading.channel} is not a reading of this campaign; begin a new file"
            raise InputFileError(file.path, f"line {reading.source.line}", problem)
        n = next((n for n in left if n > newest.get(reading.channel, -1)), left[0])
        newest[reading.channel] = n
        found[n] = reading
    return found


def _stated_frame(file: MeasuredFile, tracker_frame: str) -> Pose | None:
    """Return the tracker's frame that a file states; ``base`` if it states none; None if it is still OPEN."""
    start = f"# {FRAME_REMARK}"
    remarks = [line.removeprefix(start).strip() for line in file.comments if line.startswith(start)]
    if bool(remarks) != (tracker_frame == FREE):
        other = FREE if remarks else KNOWN
        raise InputFileError(
            file.path, "", f"was begun with --tracker-frame {other}: give this option, or a new file to write to"
        )
    if not remarks:
        return Pose.identity()
    if remarks[0] == OPEN:
        return None
    try:
        numbers = np.array(remarks[0].split(","), dtype=float)
        return Pose.from_quaternion(numbers[:3] * 1e-3, numbers[3:])
    except (PoseError, ValueError) as error:
        problem = "must be a position, mm, and a quaternion: seven numbers"
        raise InputFileError(file.path, "tracker frame", problem, remarks[0]) from error
