"""Combines single readings into one :class:`~.readings.MeasurementSet`: recognises lines, merges equal stations."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import InputFileError
from ..formats.paths import config_file
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..machine.passes import APPROACH, Passes, Poses, arrivals
from ..pose import Pose, attitude_error, rotation_from_vector, stacked
from .readings import (
    AXES,
    BACKWARD,
    CHANNELS,
    FORWARD,
    FROM_PREVIOUS,
    KIND_OF,
    KINDS,
    LARGEST_OF_TRACKER,
    LARGEST_READING,
    LEAST_TRAVEL,
    LENGTH,
    LINE_KINDS,
    MeasurementSet,
    Reading,
    Run,
    Stations,
    si_unit,
)

# Shipped geometry files that a message suggests if the chosen machine cannot reach the commanded poses
GEOMETRIES = ("paper.yaml", "example_6_6.yaml", "jugglebot.yaml", "positioning_unit.yaml")
FEWEST_POSES = 10  # for fewer poses a message suggests no mistake, because many mistakes could explain them
OTHER_UNITS = (("inches", 25.4), ("m", 1e3))  # (unit, its size, mm) that a message suggests for coordinates in mm
# Largest difference of a strut command from the nominal strut length, as a fraction of the length
LARGEST_CORRECTION = 0.02


def impossible(geometry: HexapodGeometry, poses: Poses, commands: np.ndarray) -> Iterator[tuple[int, str]]:
    """Yield index and reason for each unreachable pose and each with strut commands far from its strut lengths."""
    lengths = strut_lengths_batch(Structure.of(geometry), *poses)
    for number, (position, rotation, needed, command) in enumerate(zip(*poses, lengths, commands, strict=True)):
        if refusal := geometry.refusal(position, rotation, needed):
            yield number, f"the commanded pose is out of the machine's reach: {refusal}"
            continue
        off = np.abs(command / needed - 1.0)
        if (off > LARGEST_CORRECTION).any():
            n = int(off.argmax())
            both = f"{command[n] * 1e3:.4f} mm was commanded, the pose needs {needed[n] * 1e3:.4f} mm"
            yield number, f"strut_{n + 1}: {both} (they may differ by {LARGEST_CORRECTION * 100.0:g} %)"


def possible_misreadings(geometry: HexapodGeometry, poses: Poses, commands: np.ndarray) -> list[str]:
    """Return other ways to read a file, such as "with x and z exchanged", with which the machine reaches all poses."""
    if len(commands) < FEWEST_POSES:
        return []
    others = _misreadings(geometry, poses)
    return [how for how, machine, other in others if next(impossible(machine, other, commands), None) is None]


def exchanged(geometry: HexapodGeometry, poses: Poses, a: int, b: int) -> Poses:
    """Return the platform's poses after an exchange of the tool's coordinates a and b (0, 1, 2) in work."""
    tips, tools = geometry.tool_poses(*poses)
    tips[:, [a, b]] = tips[:, [b, a]]
    return geometry.platform_poses(tips, tools)


def _misreadings(geometry: HexapodGeometry, poses: Poses) -> Iterator[tuple[str, HexapodGeometry, Poses]]:
    """Yield other ways to read a file's poses: a text for a message, the geometry, and the platform's poses."""
    tips, tools = geometry.tool_poses(*poses)
    for a, b in combinations(range(3), 2):
        yield f"with {AXES[a]} and {AXES[b]} exchanged", geometry, exchanged(geometry, poses, a, b)
    for axis, sign in zip(AXES, 1.0 - 2.0 * np.eye(3), strict=True):
        yield f"with the sign of {axis} reversed", geometry, geometry.platform_poses(sign * tips, tools)
    for unit, factor in OTHER_UNITS:
        yield f"with coordinates in {unit}", geometry, geometry.platform_poses(factor * tips, tools)
    yield "as poses of the platform in base", geometry, (tips, tools)
    frames = [("tool", name) for name in geometry.tools] + [("work", name) for name in geometry.work_frames]
    machines = [(f"with --{kind} {name}", geometry.using(**{kind: name})) for kind, name in frames]
    machines += [(f"with --machine {name.partition('.')[0]}", load_geometry(config_file(name))) for name in GEOMETRIES]
    for how, machine in machines:
        yield how, machine, machine.platform_poses(tips, tools)


SAME = 1e-9  # m; two commands with a smaller difference are one command
SHORTEST_LENGTH = 1e-3  # m; the direction of a shorter distance is unknown, because centres are known to millimetres
NUMBER_OF = {channel: number for number, channel in enumerate(CHANNELS)}
OF_LINES = np.isin(np.array(KINDS)[KIND_OF], LINE_KINDS)
# Channels of straightness along x, y and z of the work frame
STRAIGHTNESS = np.array([NUMBER_OF[f"straightness_{axis}"] for axis in AXES])
OWN_LINE = 0.99  # straightness along an axis is refused on a line whose unit vector has a larger component along it
NO_COMMANDS = (math.nan,) * 6  # strut commands of a reading whose file states none
SMALLEST_UNCERTAINTY = 1e-12  # m or rad; the squared inverse of this is still a finite number


def assemble(
    geometry: HexapodGeometry,
    readings: Sequence[Reading],
    probe: np.ndarray | None = None,
    files: Iterable[tuple[str, str]] = (),
    notes: Iterable[str] = (),
    in_reach: bool = True,
) -> MeasurementSet:
    """Combine readings into one set; if `in_reach` is True, refuse poses that the nominal machine cannot reach."""
    probe = np.array(geometry.tool.position if probe is None else probe, dtype=float)
    if not readings:
        raise InputFileError("measurements", "", "hold no reading")
    cycle, direction = (np.array([getattr(r, name) for r in readings]) for name in ("cycle", "direction"))
    channel = np.array([NUMBER_OF[r.channel] for r in readings])
    value, uncertainty = (np.array([getattr(r, name) for r in readings], float) for name in ("value", "uncertainty"))
    _check_values(readings, channel, value, uncertainty)
    poses, place = _platform_poses(geometry, readings)
    points = (poses[0] + poses[1] @ probe)[place]
    centre = _centres(geometry, readings, points)
    runs, run_of, swapped = _runs(readings, (direction, cycle, channel), points, geometry.work.rotation.T)
    of_readings = zip(readings, place.tolist(), [runs[i] for i in run_of.tolist()], strict=True)
    if in_reach:
        _check_possible(geometry, readings, place, poses)
    stations, station = _collect_stations(geometry, list(of_readings), poses)
    visited = MeasurementSet(
        geometry=geometry,
        probe=probe,
        runs=runs,
        stations=stations,
        station=station,
        run=run_of,
        cycle=cycle,
        direction=direction,
        channel=channel,
        value=value,
        uncertainty=uncertainty,
        centre=centre,
        sources=tuple(r.source for r in readings),
        files=tuple(files),
        notes=(*notes, *swapped, *_out_of_order(readings)),
    )
    missed = np.isnan(value)  # pose visited without a reading: only the direction to the next pose depends on it
    return visited.select(~missed) if missed.any() else visited


def _runs(
    readings: Sequence[Reading], passes: tuple[np.ndarray, ...], points: np.ndarray, along: np.ndarray
) -> tuple[tuple[Run, ...], np.ndarray, list[str]]:
    """Return the runs, the index of each reading's run, and notes on runs whose directions look exchanged.

    `passes` are the direction, cycle and channel of each reading; rows of `along` are the work frame's axes in base.
    """
    members: dict[str, list[int]] = {}
    for index, reading in enumerate(readings):
        members.setdefault(reading.run, []).append(index)
    runs, notes = [], []
    for name, rows in members.items():
        run = _recognise([readings[i] for i in rows], passes[2][rows], points[rows], along)
        runs.append(run)
        if run.is_line and _swapped(points[rows] @ run.axis, *(part[rows] for part in passes)):
            problem = "rows with direction forward travel backward, and vice versa: are the directions exchanged?"
            notes.append(f"{readings[rows[0]].source}: run {name}: {problem}")
    number = {name: index for index, name in enumerate(members)}
    return tuple(runs), np.array([number[r.run] for r in readings]), notes


def _swapped(along: np.ndarray, direction: np.ndarray, cycle: np.ndarray, channel: np.ndarray) -> bool:
    travel = {FORWARD: 0.0, BACKWARD: 0.0}
    for each in travel:
        chosen = np.flatnonzero(direction == each)
        if len(chosen):
            first = (cycle[chosen] == cycle[chosen[0]]) & (channel[chosen] == channel[chosen[0]])
            travel[each] = along[chosen[first][-1]] - along[chosen[0]]
    return bool(travel[FORWARD] < 0.0 < travel[BACKWARD])


def _out_of_order(readings: Sequence[Reading]) -> Iterator[str]:
    """Yield a note on each file with a `sequence` in which times decrease from one stop to the next."""
    steps, earlier = Counter[str](), Counter[str]()
    for before, r in pairwise(readings):
        if r.direction == FROM_PREVIOUS and r.run == before.run and r.pose is not before.pose:
            steps[r.source.file] += 1
            earlier[r.source.file] += r.time < before.time
    for file, count in (+earlier).items():
        problem = f"{count} of {steps[file]} stops of a sequence have an earlier time than the stop in the row before"
        yield f"{file}: {problem}: were the rows sorted? Each pose counts as reached from the pose in the row before"


def _platform_poses(geometry: HexapodGeometry, readings: Sequence[Reading]) -> tuple[Poses, np.ndarray]:
    """Return the distinct commanded ``pose_platform_in_base``, and the index of each reading's pose among them."""
    objects: dict[int, int] = {}
    values: dict[bytes, int] = {}
    poses: list[Pose] = []
    for pose in (reading.pose for reading in readings):
        if id(pose) not in objects:
            key = pose.position.tobytes() + pose.rotation.tobytes()
            objects[id(pose)] = values.setdefault(key, len(poses))
            if objects[id(pose)] == len(poses):
                poses.append(pose)
    return geometry.platform_poses(*stacked(poses)), np.array([objects[id(reading.pose)] for reading in readings])


def _centres(geometry: HexapodGeometry, readings: Sequence[Reading], points: np.ndarray) -> np.ndarray:
    """Return the points, (N, 3), m in ``base``, from which readings of ``length`` were read; NaN for other channels."""
    centres = np.full((len(readings), 3), np.nan)
    known: dict[str, bool] = {}
    for n, r in enumerate(readings):
        is_length = r.channel == CHANNELS[LENGTH]
        if is_length and r.centre is None:
            raise InputFileError(r.source.file, _line(r), "a reading of a length needs the position of its centre")
        if not is_length and (r.centre is not None or r.known_zero):
            problem = f"only lengths have a centre or a known zero; leave both empty for {r.channel}"
            raise InputFileError(r.source.file, _line(r), problem)
        if known.setdefault(r.run, r.known_zero) != r.known_zero:
            problem = f"run {r.run}: the zero is known in some rows and unknown in others; give them two run names"
            raise InputFileError(r.source.file, _line(r), problem)
        if r.centre is not None:
            centres[n] = geometry.work.position + geometry.work.rotation @ np.array(r.centre)
            distance = float(np.linalg.norm(points[n] - centres[n]))
            if not SHORTEST_LENGTH <= distance < np.inf:
                problem = f"commanded distance from the centre, mm: must be {SHORTEST_LENGTH * 1e3:g} or more"
                raise InputFileError(r.source.file, _line(r), problem, distance * 1e3)
    return centres


def _check_values(readings: Sequence[Reading], channel: np.ndarray, value: np.ndarray, uncertainty: np.ndarray) -> None:
    possible = (uncertainty >= SMALLEST_UNCERTAINTY) & (uncertainty <= LARGEST_READING)
    largest = np.array([LARGEST_OF_TRACKER.get(kind, LARGEST_READING) for kind in KINDS])[KIND_OF[channel]]
    wrong = np.flatnonzero(~(((np.abs(value) <= largest) | np.isnan(value)) & (np.isnan(uncertainty) | possible)))
    if not len(wrong):
        return
    r, allowed = readings[wrong[0]], largest[wrong[0]]
    unit = si_unit(r.channel)
    if abs(r.value) > allowed:
        problem = f"value must be within ±{allowed:g} {unit}: it is the error, actual minus commanded"
        raise InputFileError(r.source.file, _line(r), f"{problem}; is the unit right?", r.value)
    problem = f"uncertainty must be {SMALLEST_UNCERTAINTY:g}…{LARGEST_READING:g} {unit}"
    raise InputFileError(r.source.file, _line(r), problem, r.uncertainty)


def _line(reading: Reading) -> str:
    return f"line {reading.source.line}" if reading.source.line else f"run {reading.run}"


def _recognise(readings: list[Reading], channel: np.ndarray, points: np.ndarray, work_axes: np.ndarray) -> Run:
    """Return the run of `readings`; if they are on a line, fit this line to the commanded points, (n, 3), m in base."""
    first, name = readings[0], readings[0].run
    of_line = OF_LINES[channel]
    if of_line.any() and not of_line.all():
        problem = "mixes channels of a line (linear, straightness, rotation) with other channels"
        raise InputFileError(first.source.file, f"run {name}", problem)
    if first.slope and not np.isin(channel, STRAIGHTNESS).any():
        raise InputFileError(first.source.file, f"run {name}", "has a slope, but no straightness reading", first.slope)
    if not of_line.any():
        return Run(name, np.zeros(3), points[0], first.known_zero)
    spread = points - points[0]
    far = spread[np.linalg.norm(spread, axis=1).argmax()]
    if np.linalg.norm(far) < LEAST_TRAVEL:
        raise InputFileError(first.source.file, f"run {name}", "has one commanded point only; a line needs two")
    axis = far / np.linalg.norm(far)
    off = np.linalg.norm(spread - np.outer(spread @ axis, axis), axis=1)
    if off.max() > LEAST_TRAVEL:
        where = readings[int(off.argmax())]
        problem = f"run {name}: the commanded point is {off.max() * 1e3:.4f} mm off the run's line"
        raise InputFileError(where.source.file, _line(where), problem)
    in_work = work_axes @ far
    wrong = np.flatnonzero(np.isin(channel, STRAIGHTNESS[np.abs(in_work) > OWN_LINE * np.linalg.norm(far)]))
    if len(wrong):
        r = readings[wrong[0]]
        problem = f"run {name}: {r.channel} is along the line itself; straightness is perpendicular to the line"
        raise InputFileError(r.source.file, _line(r), problem)
    if len({r.slope for r in readings}) > 1:
        raise InputFileError(first.source.file, f"run {name}", "mixes optical squares (slope); give each its own run")
    leading = in_work[np.abs(in_work) > LEAST_TRAVEL][0]
    return Run(name, axis * np.sign(leading), points[0], slope=first.slope)


def _collect_stations(
    geometry: HexapodGeometry, readings: Sequence[tuple[Reading, int, Run]], poses: Poses
) -> tuple[Stations, np.ndarray]:
    """Return the distinct stations and each reading's station index; `readings`: (reading, index of its pose, run)."""
    known: dict[tuple, int] = {}
    rows: list[tuple] = []
    previous: list[int | None] = []  # station from which the machine came; None: unknown
    travels: list[np.ndarray] = []  # (3,): direction of a pass over a line, else zero
    index: list[int] = []
    lengths = strut_lengths_batch(Structure.of(geometry), *poses)
    # Times distinguish stations only if a temperature changes; otherwise all cycles share their stations.
    warming = len({r.temperatures for r, _, _ in readings}) > 1
    here: tuple | None = None
    before: int | None = None
    for r, pose, run in readings:
        place = (r.run, pose, r.commands)
        if here is not None and place != here:
            before = index[-1] if here[0] == r.run else None
        here = place
        # A station belongs to one run, because two lines that cross at a point pass it in different directions.
        came_from = before if r.direction == FROM_PREVIOUS else None
        time = r.time if warming else math.nan
        around = r.temperatures, time, r.humidity, r.load  # order of Surroundings' fields
        key = (place, r.direction, came_from, struct.pack("17d", *r.temperatures, time, r.humidity, *r.load))
        if key not in known:
            own = poses[0][pose], poses[1][pose], lengths[pose]
            commands = own[2] if r.commands is None else np.array(r.commands, dtype=float)
            known[key] = len(rows)
            previous.append(came_from)
            rows.append((*own[:2], commands, np.zeros(9), *around))
            travels.append(r.direction * run.axis if r.direction in (FORWARD, BACKWARD) else np.zeros(3))
        index.append(known[key])
    columns = [np.array(column, dtype=float) for column in zip(*rows, strict=True)]
    along = np.array(travels).any(axis=1)
    columns[3][along] = Passes(geometry, *(part[along] for part in (*columns[:2], np.array(travels)))).senses()
    if len(there := np.array([n for n, start in enumerate(previous) if start is not None], dtype=int)):
        start = np.array([n for n in previous if n is not None])
        columns[3][there] = _arrival(geometry, *([part[n] for part in columns[:3]] for n in (there, start)))
    return Stations(*columns[4:], *columns[:4]), np.array(index)


def _check_possible(geometry: HexapodGeometry, readings: Sequence[Reading], place: np.ndarray, poses: Poses) -> None:
    """Refuse readings with an impossible pose or strut command; `place` has the index of each reading's pose."""
    first: dict[tuple, int] = {}
    for row, r in enumerate(readings):
        first.setdefault((place[row], r.commands), row)
    rows = list(first.values())
    own = poses[0][place[rows]], poses[1][place[rows]]
    commands = np.array([readings[row].commands or NO_COMMANDS for row in rows], dtype=float)
    refused = list(impossible(geometry, own, commands))
    if not refused:
        return
    number, problem = refused[0]
    if changes := possible_misreadings(geometry, own, commands):
        problem += f"; {len(refused)} of {len(rows)} commands are refused; none would be refused "
        problem += ", or ".join(changes)
    where = readings[rows[number]]
    raise InputFileError(where.source.file, _line(where), problem)


def _arrival(geometry: HexapodGeometry, here: Sequence[np.ndarray], there: Sequence[np.ndarray]) -> np.ndarray:
    """Return the directions of motion, (n, 9), of axes and struts after straight travels from `there` to `here`.

    `here` and `there` each have positions, rotations and strut commands. If the poses are equal, struts move as their
    commands change.
    """
    travel, turn = there[0] - here[0], attitude_error(there[1], here[1])
    length = np.linalg.norm(np.concatenate([travel, geometry.characteristic_length * turn], axis=1), axis=1)
    share = np.minimum(1.0, APPROACH / np.maximum(length, SAME))[:, None]
    before = here[0] + share * travel, rotation_from_vector(share * turn) @ here[1]
    change = np.concatenate([np.zeros_like(travel), here[2] - there[2]], axis=1)
    standing = np.sign(change) * (np.abs(change) > SAME)
    return np.where(length[:, None] > SAME, arrivals(geometry, (here[0], here[1]), before), standing)


class MeasuredFile(NamedTuple):
    path: str | Path
    sha256: str
    readings: list[Reading]
    notes: list[str]
    comments: Sequence[str] = ()  # lines above the header


def assembled(
    geometry: HexapodGeometry, files: Sequence[MeasuredFile], probe: np.ndarray | None = None, in_reach: bool = True
) -> MeasurementSet:
    """Return the readings of all files as one set; if two files have a run of the same name, add the files' names."""
    seen: dict[str, MeasuredFile] = {}
    for file in files:
        if (same := seen.setdefault(file.sha256, file)) is not file:
            raise InputFileError(file.path, "", f"is the same file as {same.path}: its readings would count twice")
    short = [Path(file.path).name for file in files]
    labels = short if len(set(short)) == len(short) else [str(file.path) for file in files]
    count = Counter(name for file in files for name in {reading.run for reading in file.readings})
    readings = [
        reading._replace(run=f"{reading.run} [{label}]") if count[reading.run] > 1 else reading
        for file, label in zip(files, labels, strict=True)
        for reading in file.readings
    ]
    read = zip(short, (file.sha256 for file in files), strict=True)
    return assemble(geometry, readings, probe, read, chain(*(file.notes for file in files)), in_reach)
