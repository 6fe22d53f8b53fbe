"""What to measure: the lines, diagonals and poses of a calibration campaign, and the instruments used on them.

A campaign is a plan: :func:`template` lists its readings as a :class:`MeasurementSet` without values, which
``hexapod_comp plan`` examines and ``hexapod_comp measure`` fills in from the virtual machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import InputFileError
from ..formats.paths import input_file
from ..formats.yaml import Section, read_yaml
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..machine.model_blocks import block_text, written
from ..pose import Pose, rotation_from_angles
from .campaign_runs import CampaignRun, line_readings, read_runs
from .readings import (
    ANGULAR_KINDS,
    AXES,
    DEFAULT_UNCERTAINTY,
    KINDS,
    LARGEST_READING,
    UNKNOWN,
    FileLine,
    MeasurementSet,
    Reading,
)
from .runs import assemble

CAMPAIGN_FORMAT = "hexapod_comp/campaign"
CAMPAIGN_VERSION = 1

INSTRUMENTS = ("1-D", "5-D", "6-D")
"""Lasers on grid lines: linear only; with two straightnesses, pitch and yaw; with roll as well."""

MOST_READINGS = 500_000
"""Larger campaigns are refused: at one reading a second this one takes six days, and a unit may be wrong."""

DIAGONALS = (0, 4, 16)
"""None, the box's four body diagonals, or these and the two diagonals of each of its six faces."""


@dataclass(frozen=True)
class Campaign:
    """A calibration campaign on a box of commanded tool positions.

    Parameters
    ----------
    box : ndarray, shape (2, 3)
        Lowest and highest corner in the work frame, m.
    cell : float
        Distance of the grid's lines, m.
    step : float
        Distance of the readings along a line, m.
    instrument : str or None
        One of :data:`INSTRUMENTS` on every grid line; None for no lines.
    diagonals : int
        One of :data:`DIAGONALS`, read by a 1-D laser.
    cycles : int
        Passes forward and backward over each line.
    poses : int
        Scattered poses in the box, each read by a tracker in position and attitude.
    tilt : float
        Largest tilt about x and y of the scattered poses, rad.
    noise : tuple of float
        Standard deviation of a reading by kind (:data:`KINDS`), m or rad.
    beam_slope : float
        Standard deviation of a straightness beam's unknown slope, rad.
    centre_off : float
        Standard deviation of where the centre of lengths is beside its place in the file, along each axis, m.
    repeatability : float
        Standard deviation of where the machine really stops, along each axis, m.
    level : ndarray, shape (3, 3)
        Attitude of the tool in the work frame on lines; scattered poses tilt from there.
    runs : tuple of CampaignRun
        Runs one by one, in measuring order, after all others.

    Raises
    ------
    InputFileError
        Values that no campaign can have (the path is empty: the caller knows it).
    """

    box: np.ndarray
    cell: float
    step: float
    instrument: str | None = "5-D"
    diagonals: int = 4
    cycles: int = 1
    poses: int = 0
    tilt: float = 0.0
    noise: tuple[float, ...] = tuple(DEFAULT_UNCERTAINTY.values())
    beam_slope: float = 100e-6
    centre_off: float = 0.3e-3
    repeatability: float = 0.0
    level: np.ndarray = field(default_factory=lambda: np.eye(3))
    runs: tuple[CampaignRun, ...] = ()

    def __post_init__(self) -> None:
        box = np.array(self.box, dtype=float)
        object.__setattr__(self, "box", box)
        if box.shape != (2, 3) or not (np.isfinite(box).all() and (box[0] < box[1]).all()):
            raise InputFileError("campaign", "box", "must be its lowest and its highest corner", box.tolist())
        for name in ("cell", "step"):
            if not 0.0 < getattr(self, name) <= np.ptp(box, axis=0).min() + 1e-9:
                problem = "must be above zero and no longer than the box's shortest side, m"
                raise InputFileError("campaign", name, problem, getattr(self, name))
        if self.instrument is not None and self.instrument not in INSTRUMENTS:
            raise InputFileError("campaign", "instrument", f"must be one of {', '.join(INSTRUMENTS)}", self.instrument)
        if self.diagonals not in DIAGONALS:
            raise InputFileError("campaign", "diagonals", f"must be one of {DIAGONALS}", self.diagonals)
        if not (1 <= self.cycles <= MOST_READINGS and 0 <= self.poses <= MOST_READINGS):
            problem = f"must be at least 1 and 0, and at most {MOST_READINGS}"
            raise InputFileError("campaign", "cycles, poses", problem, [self.cycles, self.poses])
        if not (self.instrument or self.diagonals or self.poses or self.runs):
            raise InputFileError("campaign", "instrument", "or diagonals, poses or runs: nothing is measured")
        if not 0.0 <= self.tilt < math.inf:
            raise InputFileError("campaign", "tilt", "must be finite and not negative", self.tilt)
        for name in ("beam_slope", "centre_off", "repeatability"):
            if not 0.0 <= getattr(self, name) <= LARGEST_READING:
                raise InputFileError("campaign", name, f"must be 0…{LARGEST_READING:g} m or rad", getattr(self, name))
        if len(self.noise) != len(KINDS) or not all(0.0 <= sigma <= LARGEST_READING for sigma in self.noise):
            raise InputFileError("campaign", "noise", f"must be 0…{LARGEST_READING:g} m or rad", list(self.noise))
        if not self._roughly() <= MOST_READINGS:
            problem = f"would be some {self._roughly():.3g} readings, at most {MOST_READINGS} are allowed"
            raise InputFileError("campaign", "cell, step, cycles, poses, runs", problem)

    def _roughly(self) -> float:
        """Return about how many readings the campaign takes, without making any."""
        sides = np.ptp(self.box, axis=0)
        cells, passes = sides / self.cell + 1.0, 2.0 * self.cycles * (sides / self.step + 1.0)
        of_lines = cells.prod() * (passes / cells).sum() * len(self.channels(0)) if self.instrument else 0.0
        of_diagonals = 2.0 * self.cycles * self.diagonals * (float(np.linalg.norm(sides)) / self.step + 1.0)
        of_runs = sum(run.count(self.cycles) for run in self.runs)
        return float(of_lines + of_diagonals + 6.0 * self.poses + of_runs)

    @property
    def stops(self) -> float:
        """How far the tool stops beside its usual place, RMS over all three axes, m."""
        return math.sqrt(3.0) * self.repeatability

    def nodes(self, axis: int) -> np.ndarray:
        """Return where the grid's lines stand along an axis, m; the last cell may be narrower."""
        low, high = self.box[:, axis]
        inner = np.arange(low, high - 1e-3 * self.cell, self.cell)
        return np.append(inner, high)

    def channels(self, axis: int) -> tuple[str, ...]:
        """Return what is read on a grid line along an axis."""
        across = [AXES[a] for a in CROSS_AXES[axis]]
        five = ("linear", *(f"straightness_{a}" for a in across), *(f"rotation_{a}" for a in across))
        return {"1-D": five[:1], "5-D": five, "6-D": (*five, f"rotation_{AXES[axis]}")}[self.instrument or "1-D"]


CELLS_OF_A_BOX, STEPS_OF_A_CELL = 4, 4
"""How many cells the longest edge of a machine's own box has, and how many steps a cell, where a file does not say."""

OwnBox = Callable[[], tuple[np.ndarray, np.ndarray]]
"""Gives a machine's own box, (2, 3), m in the work frame, and the tool's attitude there, (3, 3)."""


def load_campaign(path: str | Path, own_box: OwnBox | None = None) -> Campaign:
    """Read a campaign file (YAML, see config/campaign_5d.yaml), or a shipped one by its name.

    Parameters
    ----------
    path : str or Path
        File, or the name of a shipped one.
    own_box : callable, optional
        Asked where the file gives no box: see :func:`hexapod_comp.workspace.box.machine_box`.

    Raises
    ------
    InputFileError
        With file, key and value.
    """
    path = input_file(path, "campaign")
    top = read_yaml(path, CAMPAIGN_FORMAT, CAMPAIGN_VERSION)
    instrument = top.choice("instrument", (*INSTRUMENTS, "none"), "none")
    diagonals = top.integer("diagonals", 0)
    box, level, cell, step = _read_grid(top, own_box, instrument != "none" or diagonals != 0)
    try:
        campaign = Campaign(
            box=box,
            cell=cell,
            step=step,
            level=level,
            instrument=None if instrument == "none" else instrument,
            diagonals=diagonals,
            cycles=top.integer("cycles", 1),
            poses=top.integer("poses", 0),
            tilt=float(top.quantity("tilt", "angle", default=0.0)),
            noise=_read_noise(top.section("noise")) if "noise" in top else Campaign.noise,
            beam_slope=float(top.quantity("beam_slope", "angle", default=Campaign.beam_slope)),
            centre_off=float(top.quantity("centre_off", "length", default=Campaign.centre_off)),
            repeatability=float(top.quantity("repeatability", "length", default=0.0)),
            runs=read_runs(top) if "runs" in top else (),
        )
    except InputFileError as error:
        if error.path != "campaign":
            raise
        raise InputFileError(path, error.key, error.problem, error.value) from error
    top.finish()
    return campaign


def _read_grid(top: Section, own_box: OwnBox | None, with_lines: bool) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return the box, m, the tool's attitude in it, and the distances of lines and of readings, m.

    A campaign without lines of its own, of scattered poses or of runs that it lists, needs no distances.
    """
    if own_box is None or top.quantity_key("box", "length") is not None:
        box, level, cells = top.quantity("box", "length", (2, 3)), np.eye(3), None
        if not with_lines:
            cells = float(np.ptp(box, axis=0).min())
    else:
        box, level = own_box()
        cells = float(np.ptp(box, axis=0).max()) / CELLS_OF_A_BOX
    cell = float(top.quantity("cell", "length", default=cells))
    step = float(top.quantity("step", "length", default=None if cells is None else cell / STEPS_OF_A_CELL))
    return box, level, cell, step


def _read_noise(section: Section) -> tuple[float, ...]:
    noise = tuple(
        float(section.quantity(kind, "angle" if kind in ANGULAR_KINDS else "length", default=default))
        for kind, default in zip(KINDS, Campaign.noise, strict=True)
    )
    section.finish()
    return noise


def campaign_text(campaign: Campaign, remarks: Sequence[str] = ()) -> str:
    """Return the file (YAML) of a campaign that lists its runs, with remarks on top.

    Parameters
    ----------
    campaign : Campaign
        All that it measures are its runs.
    remarks : sequence of str
        Lines of comment.
    """
    noise = {
        f"{kind}_urad" if kind in ANGULAR_KINDS else f"{kind}_um": written(
            sigma, *(("angle", "urad") if kind in ANGULAR_KINDS else ("length", "um"))
        )
        for kind, sigma in zip(KINDS, campaign.noise, strict=True)
    }
    content = {
        "format": CAMPAIGN_FORMAT,
        "version": CAMPAIGN_VERSION,
        "box_mm": written(campaign.box, "length", "mm"),
        "cycles": campaign.cycles,
        "noise": noise,
        "beam_slope_urad": written(campaign.beam_slope, "angle", "urad"),
        "centre_off_mm": written(campaign.centre_off, "length", "mm"),
        "repeatability_um": written(campaign.repeatability, "length", "um"),
        "runs": [run.content() for run in campaign.runs],
    }
    return "".join(f"# {line}\n" for line in remarks) + block_text(content)


def template(campaign: Campaign, geometry: HexapodGeometry, seed: int = 0, name: str = "campaign") -> MeasurementSet:
    """Return the readings of a campaign with values of zero.

    Parameters
    ----------
    campaign : Campaign
        What to measure.
    geometry : HexapodGeometry
        The machine as designed.
    seed : int
        Picks the scattered poses.
    name : str
        Of the campaign's file, for messages.

    Raises
    ------
    InputFileError
        A pose of the campaign is out of the machine's reach.
    """
    listed = (reading for run in campaign.runs for reading in run.readings(campaign.cycles))
    readings = [*_lines(campaign), *_diagonals(campaign), *_scattered(campaign, seed), *listed]
    return assemble(geometry, [reading._replace(source=FileLine(name, 0)) for reading in readings])


def _lines(campaign: Campaign) -> Iterator[Reading]:
    """Yield the readings on the grid's lines."""
    if campaign.instrument is None:
        return
    for axis in range(3):
        first, second = (campaign.nodes(a) for a in CROSS_AXES[axis])
        for a in first:
            for b in second:
                ends = campaign.box.copy()
                ends[:, CROSS_AXES[axis]] = a, b
                name = f"{AXES[axis]} line at {AXES[CROSS_AXES[axis][0]]} {a * 1e3:.1f}, "
                name += f"{AXES[CROSS_AXES[axis][1]]} {b * 1e3:.1f}"
                yield from _line(campaign, name, ends, campaign.channels(axis))


def _diagonals(campaign: Campaign) -> Iterator[Reading]:
    """Yield the readings on body diagonals and face diagonals."""
    low, high = campaign.box
    ends: list[tuple[np.ndarray, np.ndarray]] = []
    if campaign.diagonals:
        for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
            start = np.array([*np.where(corner, high[:2], low[:2]), low[2]])
            ends.append((start, low + high - start))
    if campaign.diagonals == 16:
        for axis in range(3):
            v = CROSS_AXES[axis][1]
            for face in (low, high):
                for turned in (False, True):
                    start, stop = low.copy(), high.copy()
                    start[axis] = stop[axis] = face[axis]
                    if turned:
                        start[v], stop[v] = high[v], low[v]
                    ends.append((start, stop))
    for number, pair in enumerate(ends, start=1):
        yield from _line(campaign, f"diagonal {number}", np.array(pair), ("linear",))


def _line(campaign: Campaign, name: str, ends: np.ndarray, channels: tuple[str, ...]) -> Iterator[Reading]:
    """Yield the readings of all passes over the line between two points, shape (2, 3)."""
    count = max(2, round(float(np.linalg.norm(ends[1] - ends[0])) / campaign.step) + 1)
    poses = [Pose(p, campaign.level) for p in np.linspace(ends[0], ends[1], count).round(12)]
    return line_readings(name, poses, channels, campaign.cycles)


def _scattered(campaign: Campaign, seed: int) -> Iterator[Reading]:
    """Yield the tracker's readings at random poses."""
    rng = np.random.default_rng(seed)
    channels = [f"{kind}_{a}" for kind in ("position", "attitude") for a in AXES]
    for number in range(campaign.poses):
        position = rng.uniform(campaign.box[0], campaign.box[1]).round(6)
        angles = np.append(rng.uniform(-campaign.tilt, campaign.tilt, 2), 0.0).round(6)
        pose = Pose(position, rotation_from_angles(angles) @ campaign.level)
        for channel in channels:
            yield Reading("poses", number + 1, UNKNOWN, pose, channel, 0.0)
