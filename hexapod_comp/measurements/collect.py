"""Collecting a campaign's readings on a running machine, from station to station, into a file that is always complete.

The machine is whatever can be sent to a pose and watched there by an instrument: one that reads poses of the tool, a
tracker or motion capture, or one that reads single channels, a laser on a line or a ball bar. What they read is written
as the campaign's channels, so that ``fit`` takes the file. An interrupted run continues after the stations that its
file has, or begins anew if the interruption has lost its unknown zero. First readings are compared with the commands:
:mod:`.set_up` reports a mistake then, not when everything has been measured.
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
from ..errors import HexapodError, InputFileError
from ..machine.geometry import HexapodGeometry
from ..machine.passes import APPROACH
from ..pose import Pose, attitude_error
from .campaign import Campaign, campaign_readings
from .readings import (
    ANGULAR_KINDS,
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
)
from .runs import assemble
from .set_up import (
    FREE,
    KNOWN,
    LARGEST_ERROR,
    PoseCheck,
    SetUpError,
    WayCheck,
    check_nudges,
    dimension,
    nudge,
    nudge_tolerance,
)
from .tidy import read_tidy, write_measurements

__all__ = ["Collected", "InstrumentMachine", "MeasuredMachine", "Observation", "RunSetUp", "SetUpError", "collect"]

SAVE_EVERY = 5.0  # Period at which the file is rewritten, s, also at the end of each run
PASSES = (FORWARD, BACKWARD)  # Directions of a pass over a line
MOVED = 2.0 * LARGEST_ERROR  # Frames from two sets of stations differ by less, m, if the tracker stood
BROKEN = "a broken beam"
FRAME_REMARK = "tracker frame in base, mm and quaternion: "  # of a file whose poses came from a tracker anywhere
OPEN = "open"  # in place of the frame while too little was measured to know it


class Observation(NamedTuple):
    """A reading of a machine at rest."""

    pose: Pose | None  # ``pose_tool_in_base``, or in the tracker's frame, averaged; None: no instrument of poses
    uncertainty: np.ndarray  # (6,) its standard deviation along and about the axes of ``base``, m and rad; NaN: unknown
    struts: tuple[float, ...] | None = None  # measured lengths, m
    temperatures: tuple[float, ...] | None = None  # struts 1–6, base, platform, °C
    time: float = math.nan  # s
    channels: Mapping[str, tuple[float, float]] = {}  # what is read itself, from any zero, and its deviation, m or rad
    zero_lost: bool = False  # the zeros of these are others than at the observation before: a beam was broken
    gravity: tuple[float, ...] | None = None  # in ``base``, m/s²


class RunSetUp(NamedTuple):
    """What an instrument is set up for: one run of a campaign."""

    name: str
    channels: tuple[str, ...]
    # In base: of a line its first point, and x along it, forward; of lengths the first centre; else the first pose
    place: Pose


class MeasuredMachine(Protocol):
    """A machine that moves to poses, with an instrument that measures its tool."""

    def move(self, pose: Pose) -> object:
        """Move the tool to ``pose_tool_in_work`` and return when it has settled; a HexapodError where it cannot."""

    def observe(self) -> Observation | None:
        """Return the instrument's reading; None if it reads nothing, as with a broken beam."""


@runtime_checkable
class InstrumentMachine(MeasuredMachine, Protocol):
    """A machine whose instrument is set up for each run."""

    def set_up(self, run: RunSetUp) -> Collection[str]:
        """Return, when it is set up, which of the run's channels it reads itself; the others come from poses."""


class Visit(NamedTuple):
    """One stop: all channels read at a station in one pass of a run."""

    run: str
    cycle: int
    direction: int
    pose: Pose  # ``pose_tool_in_work``
    readings: tuple[int, ...]  # indices among the campaign's
    first_of_pass: bool
    approach: Pose | None  # from where it is reached in the direction of its pass

    @property
    def where(self) -> str:
        """Where it is, for people."""
        return f"{self.run}, cycle {self.cycle}, at {(self.pose.position * 1e3).round(3).tolist()} mm"


@dataclass(frozen=True)
class Collected:
    """Result of :func:`collect`."""

    measurements: MeasurementSet
    resumed: int  # number of stops that the file had already
    missing: tuple[str, ...]  # stops at which the instrument read nothing


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
    """Visit a campaign's stations in its order and write what is read there as tidy CSV; `seed` draws scattered poses.

    A file that is there already must hold readings of this campaign, and is completed. An instrument that reads nothing
    is asked `attempts` times, and a run whose zero is lost on the way is begun as often. `progress` is told, at each
    stop, the number of those done, of all, and where it is; `going_on` ends the run before a stop. With
    `tracker_frame` ``free`` poses are measured in a frame that is estimated from the first stations. A SetUpError is a
    mistake in sign, unit, channel, frame or target, an InputFileError a file of another campaign; what was read is in
    the file.
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
        read = (
            "one point of a line only, which is too little for a file" if work.found else "nothing, so there is no file"
        )
        raise InputFileError(path, "", f"the instrument read {read}")
    return Collected(whole, work.resumed, tuple(work.missing))


class _Collecting:
    """A campaign in progress: the readings taken so far, and the poses of the instruments as far as they are known."""

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
        self._ways = np.where(
            np.isnan(away), self._plan.along(), away
        )  # along a line, or the distance from a length's centre
        self.visits, self.missing, self.resumed = list(_visits(listed)), list[str](), 0
        angular = any(reading.channel.partition("_")[0] in ANGULAR_KINDS for reading in listed)
        self.poses = PoseCheck(geometry.characteristic_length, tracker_frame, angular)
        self._frame: Pose | None = Pose.identity() if tracker_frame == KNOWN else None
        self.found: dict[int, Reading] = {}
        if Path(path).exists():
            self.found = _resumed(path, geometry, listed)
            self._frame = _stated_frame(path, tracker_frame)
        self._unplaced: list[tuple[int, Observation, Pose]] = []  # in a frame that does not show yet
        self._nudged: set[tuple[str, ...]] = set()  # channels that were checked
        self._saved, self._here = time.monotonic(), -1  # when, and the stop at which the machine stands
        self.progress: Callable[[int, int, str], object]
        self.going_on: Callable[[], bool]

    # ---- runs and stops ----

    def run(self, stops: Sequence[int]) -> None:
        """Visit the stops of a run that have no reading yet; begin anew where the zero of its readings is lost."""
        if self._all_found(stops):
            self.resumed += len(stops)
            return
        readings = [n for k in stops for n in self.visits[k].readings]
        channels = tuple(dict.fromkeys(self._listed[n].channel for n in readings))
        run = self._plan.runs[self._plan.run[readings[0]]]
        own: Collection[str] = ()
        if isinstance(self._machine, InstrumentMachine):
            place = self._place(run, self.visits[stops[0]])
            own = [c for c in channels if c in self._machine.set_up(RunSetUp(run.name, channels, place))]
        counting = bool(own) and not run.known_zero
        missing, causes = list(self.missing), list[str]()
        for _ in range(self._attempts if counting else 1):
            self.missing = list(missing)
            if counting:  # whoever was away does not know whether the zero is still the same
                for n in readings:
                    self.found.pop(n, None)
            cause = self._pass_over(stops, own, counting)
            if not cause:
                break
            causes.append(cause)
        else:
            if BROKEN not in causes:
                question = "is the centre or the target elsewhere, or is something in the beam"
                raise SetUpError(f"{causes[-1]}, each of {self._attempts} times: {question}?")
            self.missing.append(f"{run.name}, whose zero was lost {self._attempts} times")
        self.save()

    def _all_found(self, stops: Sequence[int]) -> bool:
        return all(n in self.found for k in stops for n in self.visits[k].readings)

    def _place(self, run: Run, first: Visit) -> Pose:
        """Return where an instrument stands: see :class:`RunSetUp`."""
        n = first.readings[0]
        if run.is_line:
            across = np.linalg.svd(run.axis[None])[2][1]
            return Pose(run.origin, np.column_stack([run.axis, across, np.cross(run.axis, across)]))
        pose = self._geometry.work @ first.pose
        return pose if self._listed[n].centre is None else Pose(self._plan.centre[n], np.eye(3))

    def _pass_over(self, stops: Sequence[int], own: Collection[str], counting: bool) -> str:
        """Visit a run's stops that are not found yet; return the reason if the zero was lost, else an empty text."""
        zeros: dict[str, float] = {}
        checked = not own or tuple(own) in self._nudged
        ways = {channel: WayCheck(channel, checked) for channel in own}
        for k in stops:
            visit = self.visits[k]
            if self._all_found([k]):
                self.resumed += 1
                continue
            if not self.going_on():
                return ""
            self.progress(k, len(self.visits), visit.where)
            self._go(k)
            if not checked:
                if not self._check_channels(visit, own):
                    return BROKEN
                checked = True
                self._go(k)
            seen = self._observe()
            if seen is None:
                self.missing.append(visit.where)
                continue
            if seen.zero_lost and counting and zeros:
                return BROKEN
            if jumped := self._take_channels(visit, seen, ways, zeros):
                if counting:
                    return jumped
                self.missing.append(visit.where)
                continue
            self._take_pose(visit, seen, own)
            if time.monotonic() - self._saved > SAVE_EVERY:
                self.save()
        return ""

    def _go(self, k: int) -> None:
        """Move to a stop, in the direction of its pass."""
        visit = self.visits[k]
        if visit.approach is not None and (visit.first_of_pass or self._here != k - 1):
            self._move(visit.approach)
        self._machine.move(visit.pose)
        self._here = k

    def _move(self, pose: Pose) -> bool:
        """Move somewhere that need not be reached; return False where a limit forbids it."""
        try:
            self._machine.move(pose)
        except HexapodError as error:
            if error.reason != "limit":
                raise
            return False
        return True

    def _observe(self) -> Observation | None:
        """Return the instrument's reading; ask again where it reads nothing."""
        return next((o for o in (self._machine.observe() for _ in range(self._attempts)) if o is not None), None)

    def _check_channels(self, visit: Visit, own: Collection[str]) -> bool:
        """Move the tool a little along each channel's direction and hold what they read against it; False: their zero
        was lost meanwhile."""
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
                raise SetUpError(f"the limits leave no room to move along {name} at {visit.where}")
        tolerances = [nudge_tolerance(self._listed[n].channel, float(self._ways[n])) for n in chosen]
        check_nudges(names, directions, seen, tolerances)
        self._nudged.add(tuple(own))
        return True

    # ---- readings ----

    def _take_channels(
        self, visit: Visit, seen: Observation, ways: Mapping[str, WayCheck], zeros: dict[str, float]
    ) -> str:
        """Add what an instrument read itself; return the jump that no machine makes, as text, empty if there is
        none."""
        added, jumped = {}, ""
        for n in visit.readings:
            reading = self._listed[n]
            if reading.channel in ways:
                (read, deviation), way = seen.channels[reading.channel], float(self._ways[n])
                follows = reading.channel in ("linear", "length")
                if jump := ways[reading.channel].jump(way, read):
                    unit = "mrad" if dimension(reading.channel) == "angle" else "mm"
                    jumped = f"{reading.channel} jumps by {jump * 1e3:.3g} {unit} on the way to {visit.where}"
                value = read - (way if follows else 0.0)
                if not reading.known_zero:
                    value -= zeros.setdefault(reading.channel, value)
                added[n] = self._reading(reading, value, deviation, seen)
        if not jumped:
            self.found |= added
        return jumped

    def _take_pose(self, visit: Visit, seen: Observation, own: Collection[str]) -> None:
        """Add what a measured pose shows of the channels that no instrument read itself."""
        wanted = [n for n in visit.readings if self._listed[n].channel not in own]
        if not wanted:
            return
        if seen.pose is None:
            self.missing.append(visit.where)
            return
        if not self.poses.plausible(self._geometry.work @ visit.pose, seen.pose):
            return  # not usable, and the next stops give the reason
        self._unplaced += [(n, seen, seen.pose) for n in wanted]
        shown = self.poses.frame()
        if self._frame is None:
            self._frame = shown
        if self._frame is None:
            return
        apart = (
            0.0 if shown is None else np.linalg.norm((shown @ seen.pose).position - (self._frame @ seen.pose).position)
        )
        if apart > MOVED:
            text = f"the tracker stands {apart * 1e3:.1f} mm from where it stood when the file was begun"
            raise SetUpError(f"{text}: give another file")
        self.found |= {n: self._of_pose(n, then, self._frame, pose) for n, then, pose in self._unplaced}
        self._unplaced.clear()

    def _of_pose(self, n: int, seen: Observation, frame: Pose, pose: Pose) -> Reading:
        """Return a reading from a measured pose in an instrument's frame."""
        reading, w = self._listed[n], self._directions[n]
        commanded, measured = self._geometry.work @ reading.pose, frame @ pose
        off = measured.position - commanded.position
        if reading.channel == "length":
            centre = self._plan.centre[n]
            value = float(np.linalg.norm(measured.position - centre) - np.linalg.norm(commanded.position - centre))
        else:
            value = float(w @ np.concatenate([off, attitude_error(measured.rotation, commanded.rotation)]))
        along = np.concatenate([w[:3] @ frame.rotation, w[3:] @ frame.rotation])  # as the instrument's axes see it
        return self._reading(reading, value, float(np.sqrt(along**2 @ seen.uncertainty**2)), seen)

    def _reading(self, reading: Reading, value: float, deviation: float, seen: Observation) -> Reading:
        """Return a campaign's reading with its value, and the temperatures and load at that time."""
        payload = self._geometry.payload
        load = (payload.mass, *payload.centre) if payload.mass else NO_LOAD[:4]
        return reading._replace(
            value=value,
            uncertainty=deviation if deviation > 0.0 else math.nan,
            commands=seen.struts,
            temperatures=seen.temperatures or reading.temperatures,
            time=seen.time,
            load=(*load, *(seen.gravity or NO_LOAD[4:])),
        )

    def save(self) -> MeasurementSet | None:
        """Write the readings, without lines of one point; return them, None where there are none."""
        places: dict[str, set[bytes]] = {}
        for reading in self.found.values():
            places.setdefault(reading.run, set()).add(reading.pose.position.tobytes())
        self._tell_directions()
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

    def _tell_directions(self) -> None:
        """Set the direction of poses outside of passes: reached from the pose before, or unknown after a gap."""
        for before, visit in zip([None, *self.visits], self.visits, strict=False):
            if visit.direction not in PASSES:
                read = before is not None and before.run == visit.run and before.readings[0] in self.found
                for n in filter(self.found.__contains__, visit.readings):
                    self.found[n] = self.found[n]._replace(direction=FROM_PREVIOUS if read else UNKNOWN)

    def _frame_remark(self) -> str:
        """Return the note for the file about a tracker whose frame is unknown."""
        if not self.poses.free:
            return ""
        if self._frame is None:
            return FRAME_REMARK + OPEN
        numbers = *(self._frame.position * 1e3).tolist(), *quaternion_of(self._frame.rotation)
        return FRAME_REMARK + ", ".join(map(repr, numbers))


def _visits(listed: Sequence[Reading]) -> Iterator[Visit]:
    """Yield the stops of a campaign's readings, in their order."""

    def stop(n: int) -> tuple[str, int, int, bytes]:
        r = listed[n]
        return r.run, r.cycle, r.direction, r.pose.position.tobytes() + r.pose.rotation.tobytes()

    stops = [tuple(members) for _, members in groupby(range(len(listed)), stop)]
    before: tuple[str, int, int] | None = None
    for k, members in enumerate(stops):
        r = listed[members[0]]
        this = r.run, r.cycle, r.direction
        approach = None
        if r.direction not in PASSES:  # poses one after the other, each reached from the one before
            approach = last.pose if k and (last := listed[stops[k - 1][0]]).run == r.run else None
            yield Visit(*this, r.pose, members, False, approach)
            continue
        for other, sign in ((k + 1, -1.0), (k - 1, 1.0)):  # the way from here to the next stop, or from the last one
            there = listed[stops[other][0]] if 0 <= other < len(stops) else None
            if approach is None and there and (there.run, there.cycle, there.direction) == this:
                way = sign * (there.pose.position - r.pose.position)
                if (length := float(np.linalg.norm(way))) > 0.0:
                    approach = Pose(r.pose.position + way * (APPROACH / length), r.pose.rotation)
        yield Visit(*this, r.pose, members, this != before, approach)
        before = this


def _resumed(path: str | Path, geometry: HexapodGeometry, listed: Sequence[Reading]) -> dict[int, Reading]:
    """Return the campaign's readings that a file has already, by their number."""

    def key(run: str, cycle: int, direction: int, pose: Pose, channel: str) -> tuple[object, ...]:
        place = np.concatenate([pose.position * 1e6, pose.rotation.ravel() * 1e6]).round().astype(int)
        return run, cycle, direction if direction in PASSES else UNKNOWN, tuple(place.tolist()), channel

    number = {key(r.run, r.cycle, r.direction, r.pose, r.channel): n for n, r in enumerate(listed)}
    found: dict[int, Reading] = {}
    for reading in read_tidy(path, geometry).readings:
        n = number.get(key(reading.run, reading.cycle, reading.direction, reading.pose, reading.channel))
        if n is None:
            problem = f"run {reading.run}, {reading.channel} is no reading of this campaign; give another file"
            raise InputFileError(path, str(reading.source.line), problem)
        found[n] = reading
    return found


def _stated_frame(path: str | Path, tracker_frame: str) -> Pose | None:
    """Return the tracker's frame that a file states, or the base; None where it is yet to be found."""
    with Path(path).open(encoding="utf-8") as file:
        remarks = [line[2:] for line in file if line.startswith(f"# {FRAME_REMARK}")]
    if bool(remarks) != (tracker_frame == FREE):
        other = FREE if remarks else KNOWN
        raise InputFileError(path, "", f"was measured with --tracker-frame {other}: go on so, or give another file")
    if not remarks:
        return Pose.identity()
    text = remarks[0].removeprefix(FRAME_REMARK).strip()
    if text == OPEN:
        return None
    numbers = np.array(text.split(","), dtype=float)
    return Pose.from_quaternion(numbers[:3] * 1e-3, numbers[3:])
