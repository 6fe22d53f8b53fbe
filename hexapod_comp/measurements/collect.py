"""Collecting a campaign's readings on a running machine, from station to station, into a file that is always whole.

The machine is whatever can be sent to a pose and watched there by an instrument that reads poses of the tool, a tracker
or motion capture. What it reads is written as the campaign's own channels, so that ``fit`` takes the file. A run that
was interrupted goes on after the stations that its file has. While the first poses come in they are held against the
commanded ones: a mistake in sign, unit or set-up is reported then, not when everything has been measured.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import HexapodError, InputFileError
from ..machine.geometry import HexapodGeometry
from ..pose import Pose
from .campaign import Campaign, campaign_readings
from .readings import LINE_KINDS, FileLine, MeasurementSet, Reading
from .runs import assemble
from .tidy import tidy_readings, write_measurements

SAVE_EVERY = 5.0  # The file is written anew after this long, s, and at the end of each run: no more is lost than that
OVERRUN = 2e-3  # A pass over a line begins this far before it, m, so that every strut arrives in the pass's direction

# Where no machine is: how far the measured ways may differ from the commanded ones before a mistake is reported
LEAST_WAY = 0.02  # Root of the summed squared ways from which they are compared, m
LARGEST_SCALE_ERROR = 0.01  # Ways longer or shorter by this share: another unit
LARGEST_TURN = math.radians(2.0)  # Ways turned by this: another frame
LARGEST_OFFSET = 0.01  # Poses beside the commanded ones by this, m: another origin or target

UNITS = {1e3: "mm read as m", 1e-3: "m read as mm", 25.4: "inches read as mm", 1.0 / 25.4: "mm read as inches"}


class SetUpError(HexapodError):
    """The first readings show a mistake in sign, unit, frame or target."""

    reason = "set_up"


class Observation(NamedTuple):
    """What was seen of a machine at rest."""

    pose: Pose  # ``pose_tool_in_base``, averaged
    uncertainty: np.ndarray  # (6,) its standard deviation along and about the axes of ``base``, m and rad; NaN: unknown
    struts: tuple[float, ...] | None = None  # measured lengths, m
    temperatures: tuple[float, ...] | None = None  # struts 1–6, base, platform, °C
    time: float = math.nan  # s


class MeasuredMachine(Protocol):
    """A machine that goes to poses, with an instrument that watches its tool."""

    def move(self, pose: Pose) -> object:
        """Move the tool to ``pose_tool_in_work`` and return when it has settled; a HexapodError where it cannot."""

    def observe(self) -> Observation | None:
        """Return what the instrument reads; None while it reads nothing, as with a broken beam."""


class Visit(NamedTuple):
    """One stop: all channels that are read at a station in one pass of a run."""

    run: str
    cycle: int
    direction: int
    pose: Pose  # ``pose_tool_in_work``
    readings: tuple[int, ...]  # indices among the campaign's
    first_of_pass: bool
    approach: Pose | None  # from where it is reached in the direction of its pass


@dataclass(frozen=True)
class Collected:
    """What :func:`collect` leaves."""

    measurements: MeasurementSet
    resumed: int  # stops that the file had already
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
) -> Collected:
    """Visit a campaign's stations in its order and write what is read there as tidy CSV.

    Parameters
    ----------
    campaign : Campaign
        What is read where; ``seed`` draws its scattered poses.
    geometry : HexapodGeometry
        The machine, with the tool that carries the target.
    machine : MeasuredMachine
        Moves and watches.
    path : path
        The file; where it is there already it must hold readings of this campaign, and is completed.
    attempts : int, optional
        How often an instrument that reads nothing is asked at a station before the station is left out.
    progress : callable, optional
        Called at each stop with the number of those done, of all, and where it is.
    going_on : callable, optional
        Asked before each stop; false ends the run, with what was collected in the file.

    Raises
    ------
    SetUpError
        A mistake in sign, unit, frame or target; what was read is in the file.
    InputFileError
        A file of another campaign.
    HexapodError
        As ``machine.move`` raises it; what was read is in the file.
    """
    listed = list(campaign_readings(campaign, seed))
    plan = assemble(geometry, [reading._replace(source=FileLine("campaign", 0)) for reading in listed])
    weights, visits = plan.directions(), list(_visits(listed))
    found: dict[int, Reading] = _resumed(path, geometry, listed) if Path(path).exists() else {}
    resumed = sum(all(n in found for n in visit.readings) for visit in visits)
    watch, missing, saved = _SetUp(geometry), list[str](), time.monotonic()
    here = -1  # the stop at which the machine stands
    try:
        for done, visit in enumerate(visits):
            if all(n in found for n in visit.readings):
                continue
            if not going_on():
                break
            where = f"{visit.run}, cycle {visit.cycle}, at {(visit.pose.position * 1e3).round(3).tolist()} mm"
            progress(done, len(visits), where)
            if visit.approach is not None and (visit.first_of_pass or here != done - 1):
                _approach(machine, visit.approach)
            machine.move(visit.pose)
            here = done
            seen = next((o for o in (machine.observe() for _ in range(attempts)) if o is not None), None)
            if seen is None:
                missing.append(where)
                continue
            if not watch.plausible(visit.pose, seen.pose):
                continue  # of no use, and the next stops tell why
            for n in visit.readings:
                found[n] = _read(listed[n], seen, geometry, weights[n])
            if time.monotonic() - saved > SAVE_EVERY or done + 1 == len(visits) or visits[done + 1].run != visit.run:
                if whole := _in_order(geometry, found):
                    write_measurements(whole, path)
                saved = time.monotonic()
        watch.end()
    finally:
        if whole := _in_order(geometry, found):
            write_measurements(whole, path)
    if whole is None:
        read = "one point of a line only, which is too little for a file" if found else "nothing, so there is no file"
        raise InputFileError(path, "", f"the instrument read {read}")
    return Collected(whole, resumed, tuple(missing))


def _in_order(geometry: HexapodGeometry, found: dict[int, Reading]) -> MeasurementSet | None:
    """Return what was found as a set, without lines of which only one point was; None where nothing is left."""
    places: dict[str, set[bytes]] = {}
    for reading in found.values():
        places.setdefault(reading.run, set()).add(reading.pose.position.tobytes())
    kept = [
        found[n]
        for n in sorted(found)
        if len(places[found[n].run]) > 1 or found[n].channel.partition("_")[0] not in (*LINE_KINDS, "rotation")
    ]
    return assemble(geometry, kept) if kept else None


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
        for other, sign in ((k + 1, -1.0), (k - 1, 1.0)):  # the way from here to the next stop, or from the last one
            there = listed[stops[other][0]] if 0 <= other < len(stops) else None
            if approach is None and r.direction and there and (there.run, there.cycle, there.direction) == this:
                way = sign * (there.pose.position - r.pose.position)
                if (length := float(np.linalg.norm(way))) > 0.0:
                    approach = Pose(r.pose.position + way * (OVERRUN / length), r.pose.rotation)
        yield Visit(*this, r.pose, members, this != before, approach)
        before = this


def _approach(machine: MeasuredMachine, pose: Pose) -> None:
    """Begin a pass, or what is left of it, before its first point; where a limit forbids it, at the point itself."""
    try:
        machine.move(pose)
    except HexapodError as error:
        if error.reason != "limit":
            raise


def _read(reading: Reading, seen: Observation, geometry: HexapodGeometry, w: np.ndarray) -> Reading:
    """Return a campaign's reading with what was seen: `w` as :meth:`MeasurementSet.directions` has it."""
    commanded = geometry.work @ reading.pose
    turned = Rotation.from_matrix(seen.pose.rotation @ commanded.rotation.T).as_rotvec()
    if reading.channel == "length" and reading.centre is not None:
        centre = geometry.work.position + geometry.work.rotation @ np.array(reading.centre)
        value = float(np.linalg.norm(seen.pose.position - centre) - np.linalg.norm(commanded.position - centre))
    else:
        value = float(w @ np.concatenate([seen.pose.position - commanded.position, turned]))
    sigma = float(np.sqrt(w**2 @ seen.uncertainty**2))
    return reading._replace(
        value=value,
        uncertainty=sigma if sigma > 0.0 else math.nan,
        commands=seen.struts,
        temperatures=seen.temperatures or reading.temperatures,
        time=seen.time,
    )


def _resumed(path: str | Path, geometry: HexapodGeometry, listed: Sequence[Reading]) -> dict[int, Reading]:
    """Return the campaign's readings that a file has already, by their number."""

    def key(run: str, cycle: int, direction: int, pose: Pose, channel: str) -> tuple[object, ...]:
        place = np.concatenate([pose.position * 1e6, pose.rotation.ravel() * 1e6]).round().astype(int)
        return run, cycle, direction, tuple(place.tolist()), channel

    number = {key(r.run, r.cycle, r.direction, r.pose, r.channel): n for n, r in enumerate(listed)}
    found: dict[int, Reading] = {}
    for reading in tidy_readings(path, geometry):
        n = number.get(key(reading.run, reading.cycle, reading.direction, reading.pose, reading.channel))
        if n is None:
            problem = f"run {reading.run}, {reading.channel} is no reading of this campaign; give another file"
            raise InputFileError(path, str(reading.source.line), problem)
        found[n] = reading
    return found


class _SetUp:
    """Holds measured ways between stops against the commanded ones."""

    def __init__(self, geometry: HexapodGeometry) -> None:
        self._geometry = geometry
        self._commanded, self._measured = list[np.ndarray](), list[np.ndarray]()

    def plausible(self, commanded: Pose, measured: Pose) -> bool:
        """Take a stop's poses, in the work frame and in the base, and return whether a machine may err so; a SetUpError
        as soon as the ways between the stops tell why it cannot."""
        meant = self._geometry.work @ commanded
        self._commanded.append(meant.position)
        self._measured.append(measured.position)
        turned = Rotation.from_matrix(measured.rotation @ meant.rotation.T).as_rotvec()
        if (angle := float(np.linalg.norm(turned))) > LARGEST_TURN:
            about = ", ".join(f"{value:.1f}" for value in np.degrees(turned))
            text = f"the tool reads turned by {math.degrees(angle):.1f}° ({about}° about x, y, z of the base)"
            raise SetUpError(f"{text}: is the target mounted turned, or are the axes of the instrument's frame others?")
        ways = [np.array(places) - np.mean(places, axis=0) for places in (self._commanded, self._measured)]
        gone, seen = (float(np.sqrt((way**2).sum())) for way in ways)
        if gone > LEAST_WAY:
            scale, cosine = seen / gone, float((ways[0] * ways[1]).sum() / max(gone * seen, 1e-300))
            if abs(scale - 1.0) > LARGEST_SCALE_ERROR:
                near = min(UNITS, key=lambda size: abs(math.log(max(scale, 1e-12) / size)))
                hint = f": {UNITS[near]}?" if abs(scale / near - 1.0) < LARGEST_SCALE_ERROR else ""
                raise SetUpError(f"ways read {scale:.4g} times as long as commanded{hint}")
            if cosine < -math.cos(LARGEST_TURN):
                raise SetUpError(
                    "ways read reversed: the sign of the readings, or of an axis of the instrument's frame"
                )
            if (angle := math.acos(min(cosine, 1.0))) > LARGEST_TURN:
                text = f"ways read turned by about {math.degrees(angle):.1f}° against the commanded ones"
                raise SetUpError(f"{text}: are the axes of the instrument's frame those of the base, none exchanged?")
            self.end()
        return bool(np.linalg.norm(self._offset()) < LARGEST_OFFSET)

    def end(self) -> None:
        """Raise a SetUpError where the tool reads beside where it was sent."""
        offset = self._offset()
        if np.linalg.norm(offset) > LARGEST_OFFSET:
            away = ", ".join(f"{value * 1e3:.1f}" for value in offset)
            text = f"the tool reads {away} mm beside where it was sent"
            raise SetUpError(f"{text}: is the target's place the tool's, and the instrument's origin the base's?")

    def _offset(self) -> np.ndarray:
        if not self._measured:
            return np.zeros(3)
        return np.asarray(np.mean(self._measured, axis=0) - np.mean(self._commanded, axis=0))
