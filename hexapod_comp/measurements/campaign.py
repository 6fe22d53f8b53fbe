"""Campaigns: the lines, diagonals and poses that are measured for a calibration, and the instruments for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ..errors import ModelError
from ..formats.paths import input_file
from ..formats.schema import Choice, Integer, Numbers, Section, Text, file_errors, in_unit, keys_of, read_whole
from ..formats.yaml import block_text, read_yaml
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..pose import Pose, angles_from_rotation, rotation_from_angles
from .readings import (
    AXES,
    BACKWARD,
    DEFAULT_UNCERTAINTY,
    FORWARD,
    FROM_PREVIOUS,
    KINDS,
    LARGEST_READING,
    LEAST_TRAVEL,
    FileLine,
    MeasurementSet,
    Reading,
    si_unit,
)
from .runs import assemble

CAMPAIGN_FORMAT = "hexapod_comp/campaign"
CAMPAIGN_VERSION = 1
# Lasers for grid lines. 1-D reads displacement, 5-D also two straightnesses, pitch and yaw, 6-D also roll.
INSTRUMENTS = ("1-D", "5-D", "6-D")
# Instruments for a line: a linear laser, straightness optics, optics for pitch and yaw, a 5-D laser and a 6-D laser.
# Along a line that is not parallel to an axis of the work frame, the 5-D and the 6-D laser read displacement only.
LINE_INSTRUMENTS = ("linear", "straightness", "rotation", "5-D", "6-D")
# Instruments for scattered poses: a tracker that reads position only, and a tracker that also reads attitude
POSE_INSTRUMENTS = ("tracker", "tracker_6d")
# Instruments that read a distance from a centre: a telescoping ball bar (on circles in both senses), a tracking
# interferometer (here called station), and a probe that touches spheres
LENGTH_INSTRUMENTS = ("ball_bar", "station", "probe")
# R-test: three sensors read the displacement of a ball at the tool's tip while the tool tilts about the ball's centre
BALL_INSTRUMENTS = ("r_test",)
LISTED_INSTRUMENTS = (*LINE_INSTRUMENTS, *POSE_INSTRUMENTS, *LENGTH_INSTRUMENTS, *BALL_INSTRUMENTS)
# Planes of circles, as axes of the work frame: a counter-clockwise circle turns from the first axis to the second axis
PLANES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}
MOST_POINTS = 10_000  # largest number of points of one run
MOST_READINGS = 500_000  # largest number of readings of a campaign: six days at one reading a second
DIAGONALS = (0, 4, 16)  # allowed numbers of diagonals: none; the box's 4 body diagonals; also 12 diagonals of its faces
# Default grid: number of grid cells along the longest edge of the machine's largest box; number of steps per cell
CELLS_OF_A_BOX, STEPS_OF_A_CELL = 4, 4
# Keys beside ``noise``: further standard deviations with which a virtual machine is measured
SIZES = ("beam_slope", "centre_off", "repeatability")
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # successive points turned by this angle, rad, are spread evenly

# Function that returns the machine's largest reachable box, (2, 3), m in work
OwnBox = Callable[[], np.ndarray]


@dataclass(frozen=True)
class CampaignRun:
    """The instrument and poses of one run; raises ModelError if the instrument cannot measure at the poses."""

    name: str
    instrument: str  # one of LISTED_INSTRUMENTS
    # ``pose_tool_in_work``: (n, 3), m, and (n, 3, 3). A line has one attitude; its poses are listed from end to end.
    # The machine visits the poses of a line and of a ball bar's circle in this order and in the reverse order.
    positions: np.ndarray
    rotations: np.ndarray
    centres: np.ndarray | None = None  # (n, 3): point from which the distance at each pose is read, m in work
    known_zero: bool = False  # whether the zero of the distances is known
    alternate: bool = False  # whether a line's points 1, 3, … are read only forward, and points 2, 4, … only backward
    slope: str = ""  # straightness: name of the optical square; its runs share one unknown slope

    def __post_init__(self) -> None:
        where = f"run {self.name}"
        if not 1 <= len(self.positions) <= MOST_POINTS:
            raise ModelError(where, f"must have 1 to {MOST_POINTS} points", len(self.positions))
        if (self.instrument in LENGTH_INSTRUMENTS) != (self.centres is not None):
            problem = "reads lengths, so it needs a centre" if self.centres is None else "must not have a centre"
            raise ModelError(where, f"the instrument {self.instrument} {problem}")
        if self.is_line and np.linalg.norm(self.travel) < LEAST_TRAVEL:
            raise ModelError(where, "starts and ends at the same place")
        if self.axis is None and self.instrument in ("straightness", "rotation"):
            problem = "is not parallel to an axis of the work frame: only a linear laser can measure along it"
            raise ModelError(where, problem, self.instrument)

    @property
    def is_line(self) -> bool:
        return self.instrument in LINE_INSTRUMENTS

    @property
    def travel(self) -> np.ndarray:
        """Vector from the run's first to its last position, in the work frame, shape (3,), m."""
        return np.asarray(self.positions[-1] - self.positions[0])

    @property
    def axis(self) -> int | None:
        """Index of the work axis to which the line is parallel, 0, 1 or 2; None if the line is oblique."""
        moving = np.flatnonzero(np.abs(self.travel) > LEAST_TRAVEL)
        return int(moving[0]) if len(moving) == 1 else None

    @property
    def channels(self) -> tuple[str, ...]:
        if self.instrument in LENGTH_INSTRUMENTS:
            return ("length",)
        if self.instrument in BALL_INSTRUMENTS:
            return tuple(f"displacement_{a}" for a in AXES)
        positions = tuple(f"position_{a}" for a in AXES)
        if not self.is_line:
            return positions if self.instrument == "tracker" else (*positions, *(f"attitude_{a}" for a in AXES))
        return line_channels(self.instrument, self.axis)

    def count(self, cycles: int) -> int:
        return len(self.positions) * len(self.channels) * self._passes(cycles) // (1 + self.alternate)

    def _passes(self, cycles: int) -> int:
        """Return how often each pose is visited: 1 (tracker), 2 × `cycles` (line, circle) or `cycles` (others)."""
        if self.instrument in POSE_INSTRUMENTS:
            return 1
        return (2 if self.is_line or self.instrument == "ball_bar" else 1) * cycles

    def readings(self, cycles: int) -> Iterator[Reading]:
        """Yield the run's future readings in measuring order; every value is zero."""
        poses = [Pose(*pose) for pose in zip(self.positions, self.rotations, strict=True)]
        if self.is_line:
            for reading in line_readings(self.name, poses, self.channels, cycles, self.alternate):
                yield reading._replace(slope=self.slope)
            return
        centres = [None] * len(poses) if self.centres is None else [tuple(c) for c in self.centres.tolist()]
        for number in range(self._passes(cycles)):
            order = -1 if self.instrument == "ball_bar" and number % 2 else 1
            for pose, centre in list(zip(poses, centres, strict=True))[::order]:
                for channel in self.channels:
                    reading = Reading(self.name, number + 1, FROM_PREVIOUS, pose, channel, 0.0)
                    yield reading._replace(centre=centre, known_zero=self.known_zero)

    def content(self) -> dict[str, Any]:
        """Return the run's entry in a campaign file, in mm and degrees."""
        head: dict[str, Any] = {"name": self.name, "instrument": self.instrument}
        angles = (np.degrees(angles_from_rotation(self.rotations)).round(9) + 0.0).tolist()
        positions = in_unit(self.positions + 0.0, "mm")
        if self.centres is not None:
            centres = in_unit(self.centres + 0.0, "mm")
            head |= {"centres_mm": centres} if np.ptp(self.centres, axis=0).any() else {"centre_mm": centres[0]}
        if self.known_zero:
            head["zero"] = "known"
        if not self.is_line:
            return {**head, "poses_mm": positions, "angles_deg": angles}
        head |= {"line_mm": [positions[0], positions[-1]], "points": len(positions), "angles_deg": angles[0]}
        head |= {"slope": self.slope} if self.slope else {}
        return head | ({"stops": "alternate"} if self.alternate else {})


def line_channels(instrument: str, axis: int | None) -> tuple[str, ...]:
    """Return the channels that an instrument reads on a line parallel to work axis 0, 1 or 2 (None: oblique line)."""
    if axis is None or instrument in ("1-D", "linear"):
        return ("linear",)
    straight, turning = (tuple(f"{kind}_{AXES[a]}" for a in CROSS_AXES[axis]) for kind in ("straightness", "rotation"))
    five = ("linear", *straight, *turning)
    six = (*five, f"rotation_{AXES[axis]}")
    return {"straightness": straight, "rotation": turning, "5-D": five, "6-D": six}[instrument]


def line_run(name: str, instrument: str, ends: np.ndarray, points: int, rotation: np.ndarray) -> CampaignRun:
    """Return a run at evenly spaced points on the line between two points `ends`, m in work, at one tool attitude."""
    positions = np.linspace(ends[0], ends[1], points).round(12)
    return CampaignRun(name, instrument, positions, np.tile(rotation, (points, 1, 1)))


def circle_run(
    name: str,
    centre: np.ndarray,
    radius: float,
    points: int,
    axes: np.ndarray,
    rotation: np.ndarray,
    known_zero: bool = False,
) -> CampaignRun:
    """Return a ball bar's circle about `centre`, m in work: it starts at `axes[0]` and turns towards `axes[1]`."""
    angles = np.linspace(0.0, 2.0 * np.pi, points)
    places = centre + radius * (np.cos(angles)[:, None] * axes[0] + np.sin(angles)[:, None] * axes[1])
    centres = np.tile(np.asarray(centre, dtype=float), (points, 1))
    return CampaignRun(name, "ball_bar", places.round(12), np.tile(rotation, (points, 1, 1)), centres, known_zero)


def tilts(points: int, largest: float) -> np.ndarray:
    """Return attitudes, (points, 3, 3), that are tilted by 0 to `largest` rad in evenly spread directions."""
    share = np.sqrt(np.arange(points) / max(points - 1, 1))
    turns = np.arange(points) * GOLDEN_ANGLE
    angles = np.stack([share * np.cos(turns), share * np.sin(turns), np.zeros(points)], axis=1)
    return rotation_from_angles((largest * angles).round(9))


def line_readings(
    name: str, poses: Sequence[Pose], channels: Iterable[str], cycles: int, alternate: bool = False
) -> Iterator[Reading]:
    """Yield the future readings of `cycles` passes over a line in each direction; every value is zero."""
    travel = poses[-1].position - poses[0].position
    if travel[np.flatnonzero(np.abs(travel) > LEAST_TRAVEL)[0]] < 0.0:
        poses = poses[::-1]
    channels, stops = tuple(channels), (poses[::2], poses[1::2]) if alternate else (poses, poses)
    for cycle in range(1, cycles + 1):
        for direction, there in zip((FORWARD, BACKWARD), stops, strict=True):
            for pose in there[::direction]:
                for channel in channels:
                    yield Reading(name, cycle, direction, pose, channel, 0.0)


# Entries under ``runs`` of a campaign file, each for one run; their ``angles`` are α, β, γ of the tool in work

Angles = Annotated[np.ndarray | None, Numbers("deg", (3,))]
Radius = Annotated[float, Numbers("mm", positive=True)]
Zero = Annotated[str, Choice("known", "unknown")]


def _attitude(angles: np.ndarray | None, level: np.ndarray) -> np.ndarray:
    return level if angles is None else rotation_from_angles(angles)


@dataclass(frozen=True)
class LineEntry:
    line: Annotated[np.ndarray, Numbers("mm", (2, 3))]
    points: Annotated[int, Integer(2, MOST_POINTS)] = 2
    angles: Angles = None
    stops: Annotated[str, Choice("all", "alternate")] = "all"
    slope: Annotated[str, Text()] = ""

    def run(self, name: str, instrument: str, level: np.ndarray) -> CampaignRun:
        run = line_run(name, instrument, self.line, self.points, _attitude(self.angles, level))
        return replace(run, alternate=self.stops == "alternate", slope=self.slope)


@dataclass(frozen=True)
class CircleEntry:
    plane: Annotated[str, Choice(*PLANES)]
    centre: Annotated[np.ndarray, Numbers("mm", (3,))]
    radius: Radius
    points: Annotated[int, Integer(5, MOST_POINTS)]
    angles: Angles = None
    zero: Zero = "unknown"

    def run(self, name: str, instrument: str, level: np.ndarray) -> CampaignRun:
        axes, rotation = np.eye(3)[list(PLANES[self.plane])], _attitude(self.angles, level)
        return circle_run(name, self.centre, self.radius, self.points, axes, rotation, self.zero == "known")


@dataclass(frozen=True)
class SphereEntry:
    """A probe touches one or more spheres at points that are evenly spread over their upper halves."""

    centres: Annotated[np.ndarray, Numbers("mm", (None, 3))]
    radius: Radius
    points: Annotated[int, Integer(4, MOST_POINTS)]
    angles: Angles = None
    zero: Zero = "unknown"

    def run(self, name: str, instrument: str, level: np.ndarray) -> CampaignRun:
        up, turns = (np.arange(self.points) + 0.5) / self.points, np.arange(self.points) * GOLDEN_ANGLE
        aside = np.sqrt(1.0 - up**2)
        outwards = np.stack([aside * np.cos(turns), aside * np.sin(turns), up], axis=1)
        places = (self.centres[:, None] + self.radius * outwards).reshape(-1, 3).round(12)
        rotations = np.tile(_attitude(self.angles, level), (len(places), 1, 1))
        centres = np.repeat(self.centres, self.points, axis=0)
        return CampaignRun(name, instrument, places, rotations, centres, self.zero == "known")


@dataclass(frozen=True)
class TiltsEntry:
    """R-test: the tool tilts by up to `tilt` about a ball that rests at `position`."""

    position: Annotated[np.ndarray, Numbers("mm", (3,))]
    points: Annotated[int, Integer(4, MOST_POINTS)]
    tilt: Annotated[float, Numbers("deg")]

    def run(self, name: str, instrument: str, level: np.ndarray) -> CampaignRun:
        rotations = tilts(self.points, self.tilt) @ level
        return CampaignRun(name, instrument, np.tile(self.position, (self.points, 1)), rotations)


@dataclass(frozen=True)
class PosesEntry:
    """A list of poses. Distances are read from one `centre`, or at each pose from its own point in `centres`."""

    poses: Annotated[np.ndarray, Numbers("mm", (None, 3))]
    angles: Annotated[np.ndarray | None, Numbers("deg", (None, 3))] = None
    centre: Annotated[np.ndarray | None, Numbers("mm", (3,))] = None
    centres: Annotated[np.ndarray | None, Numbers("mm", (None, 3))] = None
    zero: Zero = "unknown"

    def run(self, name: str, instrument: str, level: np.ndarray) -> CampaignRun:
        count = len(self.poses)
        for key, given in (("angles_deg", self.angles), ("centres_mm", self.centres)):
            if given is not None and len(given) != count:
                raise ModelError(f"run {name}: {key}", f"must have one row for each of the {count} poses", len(given))
        centres = self.centres if self.centre is None else np.tile(self.centre, (count, 1))
        rotations = np.broadcast_to(_attitude(self.angles, level), (count, 3, 3))
        return CampaignRun(name, instrument, self.poses, rotations, centres, self.zero == "known")


# Entry of each instrument whose poses have a short form; with the key ``poses_mm`` it is a PosesEntry instead
SHORT_FORMS: dict[str, Any] = {"ball_bar": CircleEntry, "probe": SphereEntry, "r_test": TiltsEntry}


def read_runs(top: Section, level: np.ndarray) -> tuple[CampaignRun, ...]:
    runs: list[CampaignRun] = []
    for entry in top.sections("runs"):
        name = entry.text("name")
        if name in {run.name for run in runs}:
            raise entry.error("name", "is given to two runs: a run's readings share one zero, so rename one run", name)
        instrument = entry.choice("instrument", LISTED_INSTRUMENTS)
        schema = LineEntry if instrument in LINE_INSTRUMENTS else SHORT_FORMS.get(instrument, PosesEntry)
        if instrument not in LINE_INSTRUMENTS and entry.quantity_key("poses", "length") is not None:
            schema = PosesEntry
        given = {}
        if schema is PosesEntry and instrument in LENGTH_INSTRUMENTS and not entry.quantity_key("centres", "length"):
            given["centre"] = entry.quantity("centre", "length", (3,))
        with file_errors(entry):
            runs.append(read_whole(schema, entry, **given).run(name, instrument, level))
    return tuple(runs)


@dataclass(frozen=True)
class Campaign:
    """A calibration campaign in a box of commanded tool positions."""

    box: Annotated[np.ndarray, Numbers("mm", (2, 3))]  # lowest and highest corner in the work frame, m
    cell: Annotated[float, Numbers("mm")]  # distance between neighbouring grid lines, m
    step: Annotated[float, Numbers("mm")]  # distance between neighbouring readings along a line, m
    instrument: str | None = "5-D"  # one of INSTRUMENTS, for all grid lines; None: no grid lines are measured
    diagonals: int = 4  # number of diagonals, one of DIAGONALS, measured with a 1-D laser
    cycles: Annotated[int, Integer(1, MOST_READINGS)] = 1  # number of passes in each direction over each line
    poses: Annotated[int, Integer(0, MOST_READINGS)] = 0  # number of random poses, at which a tracker reads pose errors
    tilt: Annotated[float, Numbers("deg")] = 0.0  # largest tilt about x and about y of the random poses, rad
    noise: tuple[float, ...] = tuple(DEFAULT_UNCERTAINTY.values())  # σ of a reading, for each of KINDS, m or rad
    beam_slope: Annotated[float, Numbers("urad")] = 100e-6  # 1 σ of a straightness beam's angle to its line, rad
    centre_off: Annotated[float, Numbers("mm")] = 0.3e-3  # 1 σ of a stated centre's error along each axis, m
    repeatability: Annotated[float, Numbers("um")] = 0.0  # 1 σ of the machine's stops, per axis, m
    level: np.ndarray = field(default_factory=lambda: np.eye(3))  # attitude of the level tool in the work frame
    runs: tuple[CampaignRun, ...] = ()  # further runs, measured in this order after lines, diagonals and random poses

    def __post_init__(self) -> None:
        box = np.array(self.box, dtype=float)
        object.__setattr__(self, "box", box)
        if box.shape != (2, 3) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
            raise ModelError("box", "must be the box's lowest corner and its highest corner", box.tolist())
        sides = np.ptp(box, axis=0)
        for name, side, longest in (("cell", "longest", sides.max()), ("step", "shortest", sides.min())):
            if not 0.0 < getattr(self, name) <= longest + 1e-9:
                problem = f"must be above zero and at most the length of the box's {side} side, {longest:g} m"
                raise ModelError(name, problem, getattr(self, name))
        if not (self.instrument or self.diagonals or self.poses or self.runs):
            raise ModelError("instrument", "is missing, and so are diagonals, poses and runs: nothing to measure")
        if not 0.0 <= self.tilt < math.inf:
            raise ModelError("tilt", "must be finite and not negative", self.tilt)
        if len(self.noise) != len(KINDS):
            raise ModelError("noise", f"must be one number for each of {', '.join(KINDS)}", list(self.noise))
        sizes = {name: getattr(self, name) for name in SIZES}
        sizes |= {f"noise.{kind}": sigma for kind, sigma in zip(KINDS, self.noise, strict=True)}
        for name, size in sizes.items():
            if not 0.0 <= size <= LARGEST_READING:
                raise ModelError(name, f"must be 0…{LARGEST_READING:g} m or rad", size)
        if not self._approximate_count() <= MOST_READINGS:
            problem = f"result in about {self._approximate_count():.3g} readings; allowed are up to {MOST_READINGS}"
            raise ModelError("cell, step, cycles, poses, runs", problem)

    def _approximate_count(self) -> float:
        sides = np.ptp(self.box, axis=0)
        cells, passes = sides / self.cell + 1.0, 2.0 * self.cycles * (sides / self.step + 1.0)
        of_lines = cells.prod() * (passes / cells).sum() * len(self.channels(0)) if self.instrument else 0.0
        of_diagonals = 2.0 * self.cycles * self.diagonals * (float(np.linalg.norm(sides)) / self.step + 1.0)
        of_runs = sum(run.count(self.cycles) for run in self.runs)
        return float(of_lines + of_diagonals + 6.0 * self.poses + of_runs)

    @property
    def stops(self) -> float:
        """RMS distance, m, of the positions at which the tool stops from their mean, over x, y and z together."""
        return math.sqrt(3.0) * self.repeatability

    def nodes(self, axis: int) -> np.ndarray:
        """Return the grid nodes on axis 0, 1 or 2, m; the last grid cell may be narrower than `cell`."""
        low, high = self.box[:, axis]
        inner = np.arange(low, high - 1e-3 * self.cell, self.cell)
        return np.append(inner, high)

    def channels(self, axis: int) -> tuple[str, ...]:
        return line_channels(self.instrument or "1-D", axis)


def load_campaign(path: str | Path, own_box: OwnBox | None = None, level: np.ndarray | None = None) -> Campaign:
    """Read a campaign file (YAML, see config/campaign_5d.yaml) by its path, or a shipped campaign by its name.

    `level` is the attitude of a level (untilted) tool: its rotation matrix in the work frame, by default the identity.
    The function `own_box` returns the box for a file without a box.
    """
    path = input_file(path, "campaign")
    top = read_yaml(path, CAMPAIGN_FORMAT, CAMPAIGN_VERSION)
    instrument = top.choice("instrument", (*INSTRUMENTS, "none"), "none")
    diagonals = top.choice("diagonals", DIAGONALS, 0)
    given = _grid(top, own_box, instrument != "none" or diagonals != 0)
    given |= {"instrument": None if instrument == "none" else instrument, "diagonals": diagonals}
    given["level"] = np.eye(3) if level is None else level
    if "noise" in top:
        section = top.section("noise")
        noise = zip(KINDS, Campaign.noise, strict=True)
        given["noise"] = tuple(Numbers(f"u{si_unit(kind)}").read(section, kind, usual) for kind, usual in noise)
        section.finish()
    if "runs" in top:
        given["runs"] = read_runs(top, given["level"])
    return read_whole(Campaign, top, **given)


def _grid(top: Section, own_box: OwnBox | None, with_lines: bool) -> dict[str, Any]:
    """Return the box, the grid cell and the step along lines of a campaign file; `own_box()` replaces a missing box."""
    mm, given = Numbers("mm"), dict[str, Any]()
    if own_box is None or top.quantity_key("box", "length") is not None:
        given["box"] = top.quantity("box", "length", (2, 3))
        if with_lines:
            return given
        cell = float(np.ptp(given["box"], axis=0).min())
    else:
        given["box"] = own_box()
        cell = float(np.ptp(given["box"], axis=0).max()) / CELLS_OF_A_BOX
    given["cell"] = mm.read(top, "cell", cell)
    shortest = float(np.ptp(given["box"], axis=0).min())
    given["step"] = mm.read(top, "step", min(given["cell"], shortest) / STEPS_OF_A_CELL)
    return given


def campaign_text(campaign: Campaign, remarks: Sequence[str] = ()) -> str:
    """Return a campaign without grid lines as YAML text, with `remarks` as comments at its top."""
    content = {"format": CAMPAIGN_FORMAT, "version": CAMPAIGN_VERSION, "box_mm": in_unit(campaign.box, "mm")}
    content["cycles"] = campaign.cycles
    noise = zip(KINDS, campaign.noise, strict=True)
    content["noise"] = dict(Numbers(f"u{si_unit(kind)}").write(kind, sigma) for kind, sigma in noise)
    keys = keys_of(Campaign)
    content |= [keys[name][0].write(name, getattr(campaign, name)) for name in SIZES]
    content["runs"] = [run.content() for run in campaign.runs]
    return "".join(f"# {line}\n" for line in remarks) + block_text(content)


def template(campaign: Campaign, geometry: HexapodGeometry, seed: int = 0, name: str = "campaign") -> MeasurementSet:
    """Return the readings that a campaign will take, with zeros as values; `seed` determines the random poses."""
    readings = campaign_readings(campaign, seed)
    return assemble(geometry, [reading._replace(source=FileLine(name, 0)) for reading in readings])


def campaign_readings(campaign: Campaign, seed: int = 0) -> Iterator[Reading]:
    """Yield a campaign's future readings in measuring order, with zeros as values; `seed` gives the random poses."""
    for run in _grid_runs(campaign):
        yield from run.readings(campaign.cycles)
    yield from _scattered(campaign, seed)
    for run in campaign.runs:
        yield from run.readings(campaign.cycles)


def _grid_runs(campaign: Campaign) -> Iterator[CampaignRun]:
    """Yield a run for each grid line, then a run for each diagonal."""

    def run(name: str, instrument: str, ends: np.ndarray) -> CampaignRun:
        points = max(2, round(float(np.linalg.norm(ends[1] - ends[0])) / campaign.step) + 1)
        return line_run(name, instrument, ends, points, campaign.level)

    if campaign.instrument is not None:
        instrument = "linear" if campaign.instrument == "1-D" else campaign.instrument
        for axis, across in enumerate(CROSS_AXES):
            for a, b in product(*(campaign.nodes(other) for other in across)):
                ends = campaign.box.copy()
                ends[:, across] = a, b
                where = ", ".join(f"{AXES[other]} {at * 1e3:.1f}" for other, at in zip(across, (a, b), strict=True))
                yield run(f"{AXES[axis]} line at {where}", instrument, ends)
    for number, ends in enumerate(diagonals(campaign.box)[: campaign.diagonals], start=1):
        yield run(f"diagonal {number}", "linear", ends)


def diagonals(box: np.ndarray) -> list[np.ndarray]:
    """Return the ends, (2, 3), of each of a box's 4 body diagonals, then of the 2 diagonals of each face."""
    corners = [(np.array(c), 1 - np.array(c)) for c in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0))]
    for a, b in CROSS_AXES:
        for side, turned in np.ndindex(2, 2):
            start, stop = np.full((2, 3), side)
            start[[a, b]], stop[[a, b]] = (0, turned), (1, 1 - turned)
            corners.append((start, stop))
    return [np.where(np.array(pair) == 1, box[1], box[0]) for pair in corners]


def _scattered(campaign: Campaign, seed: int) -> Iterator[Reading]:
    """Yield the readings, with the value zero, that a tracker will take at the campaign's random poses."""
    rng = np.random.default_rng(seed)
    channels = [f"{kind}_{a}" for kind in ("position", "attitude") for a in AXES]
    for number in range(campaign.poses):
        position = rng.uniform(campaign.box[0], campaign.box[1]).round(6)
        angles = np.append(rng.uniform(-campaign.tilt, campaign.tilt, 2), 0.0).round(6)
        pose = Pose(position, rotation_from_angles(angles) @ campaign.level)
        for channel in channels:
            yield Reading("poses", number + 1, FROM_PREVIOUS, pose, channel, 0.0)
