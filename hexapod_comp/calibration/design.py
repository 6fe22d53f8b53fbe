"""What to measure: candidates, the information of each, and the best of them by a criterion.

In parameters z of unit prior variance, readings A of unit noise, free of nuisances, turn their covariance C into C −
CAᵀ(I + ACAᵀ)⁻¹AC, independent of the values read. So :class:`Greedy` chooses in advance the candidate with the largest
gain per cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from ..core import Status
from ..errors import CalibrationError, GeometryError, InputFileError
from ..formats.texts import aligned, number
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths_batch
from ..measurements.campaign import (
    LINE_INSTRUMENTS,
    PLANES,
    POSE_INSTRUMENTS,
    Campaign,
    CampaignRun,
    circle_run,
    line_run,
    template,
    tilts,
)
from ..measurements.readings import AXES, DEFAULT_UNCERTAINTY, KINDS, MeasurementSet
from ..pose import rotation_from_angles
from ..workspace.reach import Examiner
from .estimator import Estimation, physical_covariance, solve
from .fit import unseen_errors
from .observations import Cells
from .parameters import Extent, FitSettings, ParameterSpace
from .posterior import POINTS, Observability, ToolError, UnseenError, box_errors, expected_error, observe
from .promise import Scatter, Unexplained
from .trust import TILT

FAINT = 0.05  # directions with a smaller effect on readings are omitted, σ
LEAST_REACHED = 0.3  # share of the box in which the tool must reach the wanted tilt


def information(space: ParameterSpace, readings: MeasurementSet, x: np.ndarray) -> tuple[np.ndarray, Cells]:
    """Return the derivatives of readings by the parameters y, (cells, size), over their stated noise and free of
    nuisances."""
    estimation = Estimation(readings, space, alone=False)
    problem, _ = estimation.linearise(x, np.ones(len(readings)))
    return problem.rows.dense(), estimation.cells


TILTS = (10.0, 5.0, 2.0)  # of scattered poses, °: the first within reach

# The planner


class Criterion(Protocol):
    """A criterion for choosing candidates; it stores those already chosen."""

    def gains(self, allowed: np.ndarray) -> np.ndarray:
        """Return the improvement by each allowed candidate."""

    def add(self, n: int) -> None:
        """Take a candidate."""


C = TypeVar("C", bound=Criterion)


class Greedy(Generic[C]):
    """Candidates chosen one by one, each time the one with the largest gain per cost, within a budget."""

    def __init__(
        self,
        criterion: C,
        costs: np.ndarray,  # of each candidate
        needs: Sequence[str] = (),  # instrument to set up for it; none by default
        putting_up: Mapping[str, float] | None = None,  # cost of that set-up
        # index of the candidate that must be chosen before it, or -1: then each is chosen once
        after: np.ndarray | None = None,
    ) -> None:
        self.criterion, self.costs, self.putting_up = criterion, costs, putting_up or {}
        self.needs = list(needs) or [""] * len(costs)
        self.after = after
        self.picks: list[int] = []
        self.spent = 0.0

    def totals(self) -> np.ndarray:
        """Return the total cost after each candidate."""
        up = {self.needs[n] for n in self.picks}
        return self.spent + self.costs + [0.0 if name in up else self.putting_up.get(name, 0.0) for name in self.needs]

    def extend(self, budget: float, enough: Callable[[], bool] = lambda: False, most: int = 400) -> None:
        """Choose candidates until the goal is met, none gains or is affordable, or `most` have been chosen."""
        most += len(self.picks)
        while len(self.picks) < most and not enough():
            totals = self.totals()
            possible = totals <= budget
            if self.after is not None:
                possible &= np.isin(self.after, [-1, *self.picks])
                possible[self.picks] = False
            gains = np.where(possible, self.criterion.gains(possible) / self.costs, -np.inf)
            best = int(gains.argmax())
            if not possible.any() or gains[best] == 0.0:
                return
            self.criterion.add(best)
            self.picks.append(best)
            self.spent = float(totals[best])


class ErrorLeft:
    """Criterion: the mean square tr(M·C) of the tool's error, in parameters z of unit variance before."""

    def __init__(self, seen: Sequence[np.ndarray], square: np.ndarray) -> None:
        values, vectors = np.linalg.eigh(square)
        kept = values > 1e-9 * values[-1]  # the others contribute almost nothing to the tool's error
        root = vectors[:, kept] * np.sqrt(values[kept])
        self.parts = [slice(*pair) for pair in pairwise(np.cumsum([0, *(len(rows) for rows in seen)]))]
        rows = np.concatenate(seen)
        values, vectors = np.linalg.eigh(rows.T @ rows)
        self.basis = vectors[:, values > FAINT**2]
        self.root = self.basis.T @ root
        self.rows = rows @ self.basis
        self.inner = np.eye(self.basis.shape[1])
        self.known = self.rows.copy()  # A·C
        self.shown = self.rows @ self.root  # A·C·√M
        self.grams = [self.rows[part] @ self.rows[part].T for part in self.parts]  # A·C·Aᵀ

    @property
    def covariance(self) -> np.ndarray:
        """C, shape (size, size)."""
        return self._whole(self.inner)

    def _whole(self, inner: np.ndarray) -> np.ndarray:
        return np.asarray(np.eye(len(self.basis)) + self.basis @ (inner - np.eye(len(inner))) @ self.basis.T)

    def gains(self, allowed: np.ndarray | None = None) -> np.ndarray:
        """Return by how much each candidate lowers the mean square error, m²."""
        gains = np.zeros(len(self.parts))
        for n, (part, gram) in enumerate(zip(self.parts, self.grams, strict=True)):
            if len(gram) and (allowed is None or allowed[n]):
                shown = self.shown[part]
                gains[n] = np.vdot(shown, np.linalg.solve(np.eye(len(gram)) + gram, shown))
        return gains

    def add(self, n: int) -> None:
        """Add a candidate's readings, also once more."""
        root = cholesky(np.eye(len(self.grams[n])) + self.grams[n], lower=True)
        step = solve_triangular(root, self.known[self.parts[n]], lower=True)
        self.inner -= step.T @ step
        along = self.rows @ step.T
        self.known -= along @ step
        self.shown -= along @ (step @ self.root)
        for gram, part in zip(self.grams, self.parts, strict=True):
            gram -= along[part] @ along[part].T

    def after_all(self, times: float = 1.0) -> np.ndarray:
        """Return C after all candidates, each repeated."""
        size = np.eye(self.basis.shape[1])
        return self._whole(cho_solve(cho_factor(size + times * self.rows.T @ self.rows), size))


def laid_out(
    space: ParameterSpace,
    lines: int = 0,
    readings: int = 2,
    poses: int = 0,
    tilts: Sequence[float] = (0.0,),
    instrument: str = "6-D",
) -> tuple[MeasurementSet, float]:
    """Return possible readings in a fit's box: `lines` across each direction with diagonals, and scattered poses."""
    box, side, geometry = space.work_box, float(np.ptp(space.work_box, axis=0).min()), space.geometry
    if side <= 0.0:
        raise CalibrationError("fit", "has measured no box in which readings could be laid out")
    level = geometry.work.rotation.T @ space.level @ geometry.tool.rotation
    grid = Campaign(box, side / max(lines - 1, 1), side / (readings - 1), instrument, 4, poses=poses, level=level)
    if not lines:
        grid = replace(grid, instrument=None, diagonals=0)
    for tilt in tilts:
        try:
            return template(replace(grid, tilt=float(np.radians(tilt))), geometry), tilt
        except InputFileError:  # out of reach
            if tilt == tilts[-1]:
                raise
    raise ValueError("no tilts")


# A campaign that is given


@dataclass(frozen=True)
class Plan:
    """Prediction for a campaign."""

    measurements: MeasurementSet  # its readings, without values
    space: ParameterSpace
    observability: Observability
    unseen_errors: tuple[UnseenError, ...]  # machine errors that the readings will not show
    level: ToolError | None  # after a fit, repeatability included; `before`: machines within the tolerances
    tilted: ToolError | None
    stops: float  # the machine's repeatability as stated, RMS over all three axes, m; 0 where none is


def plan(measurements: MeasurementSet, campaign: Campaign, settings: FitSettings) -> Plan:
    """Return what the readings of a campaign's template would determine on a machine within the tolerances."""
    space = ParameterSpace(measurements, settings)
    estimation = Estimation(measurements, space)
    x, tolerances = np.zeros(space.size), space.start_tolerances()
    problem, _ = estimation.linearise(x, np.ones(len(measurements)))
    posterior = solve(space, problem, tolerances, noise_factors(campaign), rounds=0)
    covariance, prior = physical_covariance(space, posterior), space.prior_covariance(tolerances)
    beyond = Unexplained(displacement=Scatter(stops=campaign.stops, most_stops=campaign.stops))
    level, tilted = (expected_error(space, x, covariance, tilt, prior, beyond) for tilt in (0.0, TILT))
    sight = observe(space, problem, posterior, measurements.tilt())
    unseen = unseen_errors(measurements, settings)
    return Plan(measurements, space, sight, unseen, level, tilted, campaign.stops)


def noise_factors(campaign: Campaign) -> np.ndarray:
    """Return the noise of each kind of channel over the default, (kinds,), the machine's repeatability included."""
    default = np.array([DEFAULT_UNCERTAINTY[kind] for kind in KINDS])
    stops = np.where(np.isin(KINDS, ("rotation", "attitude")), 0.0, campaign.repeatability)
    return np.maximum(np.hypot(campaign.noise, stops), 1e-3 * default) / default


# Possible measurements in a box: lines along and across it, circles, poses; level and tilted

FEW_POINTS, USUAL_POINTS = (5, 13), (13,)
# Points of a line, by instrument: few at little cost, or enough to resolve the screws' waves
LINE_POINTS = {"linear": (8, 21), "5-D": FEW_POINTS, "6-D": FEW_POINTS}
# The same with each point read once, in alternating directions: more places for as many readings
ALTERNATE_POINTS = {"linear": (4, 6, 10), "5-D": (4, 8), "6-D": (4, 8)}


@dataclass(frozen=True)
class MeasuringBox:
    """The box and the attitudes of a measurement."""

    geometry: HexapodGeometry  # the machine as designed
    box: np.ndarray  # (2, 3): lowest and highest corner of the tool's positions, m in the work frame
    level: np.ndarray  # (3, 3): attitude of the level tool in the work frame
    tilt: float  # largest tilt of the tool from there, rad

    def attitudes(self) -> list[tuple[str, np.ndarray]]:
        """Return the level attitude and, where the tool tilts, four tilted ones, with their names."""
        names = {"level": (0.0, 0.0)}
        if self.tilt > 0.0:
            shown = f"{np.degrees(self.tilt):g}°"
            names |= {f"+{shown} about x": (1.0, 0.0), f"−{shown} about x": (-1.0, 0.0)}
            names |= {f"+{shown} about y": (0.0, 1.0), f"−{shown} about y": (0.0, -1.0)}
        return [(name, self.turned(self.tilt * np.array(about))) for name, about in names.items()]

    def turned(self, about: np.ndarray) -> np.ndarray:
        """Return the tool's attitude(s) after small tilts about x and y of the work frame, shape (..., 2), rad."""
        return np.asarray(rotation_from_angles(np.concatenate([about, 0.0 * about[..., :1]], axis=-1)) @ self.level)

    def reaches(self, positions: np.ndarray, rotations: np.ndarray, threads: int | None = 1) -> np.ndarray:
        """Return which poses of the tool the nominal machine's limits allow, shape (n,)."""
        return Examiner(self.geometry).findings(positions, rotations, threads=threads)[0] == Status.OK


def candidates(place: MeasuringBox, instruments: Sequence[str]) -> list[CampaignRun]:
    """Return the candidate runs, all within the limits of the nominal machine; a GeometryError if there are none."""
    runs: list[CampaignRun] = []
    lines = list(_lines(place)) if any(name in LINE_INSTRUMENTS for name in instruments) else []
    for instrument in instruments:
        if instrument in POSE_INSTRUMENTS:
            runs += [CampaignRun(f"{instrument}, poses", instrument, *poses) for poses in _sets_of_poses(place)]
        elif instrument not in LINE_INSTRUMENTS:
            runs += {"ball_bar": _circles, "r_test": _tilted_at, "station": _lengths}[instrument](place)
        else:
            for name, ends, rotation in lines:
                if instrument in ("straightness", "rotation") and name.startswith("diagonal"):
                    continue
                title = f"{instrument}, {name}"
                for points in LINE_POINTS.get(instrument, USUAL_POINTS):
                    runs.append(line_run(title, instrument, ends, points, rotation))
                for points in ALTERNATE_POINTS.get(instrument, ()):
                    runs.append(replace(line_run(title, instrument, ends, points, rotation), alternate=True))
    if not runs:
        raise GeometryError("limits", "leave nothing to be measured in the box", place.box.tolist())
    return runs


def _lines(place: MeasuringBox) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, ends (2, 3), m, and attitude of each line, cut at the limits."""
    low, size = place.box[0], np.ptp(place.box, axis=0)
    level, tilted = [], []
    for axis, (a, b) in enumerate(CROSS_AXES):
        for first, second in np.ndindex(3, 3):
            ends = place.box.copy()
            ends[:, [a, b]] = low[[a, b]] + 0.5 * np.array([first, second]) * size[[a, b]]
            where = f"{AXES[a]} {ends[0, a] * 1e3:.0f}, {AXES[b]} {ends[0, b] * 1e3:.0f}"
            level.append((f"{AXES[axis]} at {where}", ends))
            if (first == 1) == (second == 1):  # no middle of a face
                tilted.append(level[-1])
    corners = [(np.array(c), 1 - np.array(c)) for c in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0))]
    for a, b in CROSS_AXES:
        for side, turned in np.ndindex(2, 2):
            start, stop = np.full((2, 3), side)
            start[[a, b]], stop[[a, b]] = (0, turned), (1, 1 - turned)
            corners.append((start, stop))
    diagonals = [(f"diagonal {n}", low + np.array(pair) * size) for n, pair in enumerate(corners, start=1)]
    level += diagonals
    tilted += diagonals[:4]

    share = np.linspace(0.0, 1.0, 41)  # points that are checked
    least = 0.4  # lines of which a smaller share is within the limits are omitted
    for attitude, rotation in place.attitudes():
        for name, ends in level if attitude == "level" else tilted:
            points = ends[0] + share[:, None] * (ends[1] - ends[0])
            first, last = _longest(place.reaches(points, rotation[None]))
            if last - first >= least * (len(share) - 1):
                yield f"{name}, {attitude}", points[[first, last]].round(6), rotation


def _longest(within: np.ndarray) -> tuple[int, int]:
    """Return first and last index of the longest stretch; one less at an end that a limit cuts."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], within, [False]]).astype(int)))
    if not len(edges):
        return 0, -1
    starts, stops = edges[::2], edges[1::2] - 1
    first, last = max(zip(starts.tolist(), stops.tolist(), strict=True), key=lambda pair: pair[1] - pair[0])
    return first + (first > 0), last - (last < len(within) - 1)


def _sets_of_poses(place: MeasuringBox) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield positions and rotations of 25 sets of 12 random poses within the limits."""
    rng, together, sets = np.random.default_rng(11), 12, 25
    count = 4 * together * sets
    positions = rng.uniform(place.box[0], place.box[1], (count, 3)).round(6)
    rotations = place.turned(rng.uniform(-place.tilt, place.tilt, (count, 2)).round(6))
    good = np.flatnonzero(place.reaches(positions, rotations, threads=None))[: together * sets]
    for start in range(0, len(good) - together + 1, together):
        part = good[start : start + together]
        yield positions[part], rotations[part]


def _circles(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield circles of a ball bar in the box: in three planes each, level and tilted; of 100 mm, or what fits."""
    sides = np.ptp(place.box, axis=0)
    for attitude, rotation in place.attitudes():
        for plane, axes in PLANES.items():
            radius = min(0.1, 0.45 * float(sides[list(axes)].min()))
            room = np.where(np.isin(range(3), axes), radius, 0.0)
            for share in _shares(attitude == "level"):
                centre = (place.box[0] + room + share * (sides - 2.0 * room)).round(6)
                name = f"ball_bar, {plane} at {_millimetres(centre)}, {attitude}"
                run = circle_run(name, centre, radius, 17, np.eye(3)[list(axes)], rotation)
                if place.reaches(run.positions, rotation[None]).all():
                    yield run


def _shares(corners: bool) -> Iterator[np.ndarray]:
    """Yield places of a box, in shares of its sides: its middle, the middles of its faces, and its corners."""
    for index in np.ndindex(3, 3, 3):
        off = sum(i != 1 for i in index)
        if off in (0, 1) or (corners and off == 3):
            yield 0.5 * np.array(index)


def _tilted_at(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield R-tests in the box, for a tool that tilts: one ball, the tool turning about it."""
    if place.tilt == 0.0:
        return
    count = 13
    rotations = tilts(count, place.tilt) @ place.level
    for share in _shares(True):
        ball = (place.box[0] + share * np.ptp(place.box, axis=0)).round(6)
        positions = np.tile(ball, (count, 1))
        if place.reaches(positions, rotations).all():
            yield CampaignRun(f"r_test, at {_millimetres(ball)}", "r_test", positions, rotations)


def _lengths(place: MeasuringBox) -> Iterator[CampaignRun]:
    """Yield sets of poses read from a tracking interferometer that stands beside a lower corner of the box."""
    off = 0.3  # how far outside the box, in shares of its sides
    for corner in np.ndindex(2, 2):
        share = np.array([*(side + off * (2 * side - 1) for side in corner), -off])
        station = (place.box[0] + share * np.ptp(place.box, axis=0)).round(4)
        for positions, rotations in _sets_of_poses(place):
            centres = np.tile(station, (len(positions), 1))
            yield CampaignRun(f"station at {_millimetres(station)}", "station", positions, rotations, centres)


def _millimetres(place: np.ndarray) -> str:
    return ", ".join(f"{value * 1e3:.0f}" for value in place)


# A campaign for a goal


@dataclass(frozen=True)
class Times:
    """How long an instrument takes, s."""

    first: float  # to put it up
    run: float  # to set up one run
    stop: float  # for each stop of the machine with its readings

    def of(self, run: CampaignRun, cycles: int) -> float:
        """Return how long a run takes, s."""
        return self.run + self.stop * run.count(cycles) / len(run.channels)


# Times of an experienced machinist, by instrument; for these there are candidate runs
TIMES = {
    "linear": Times(1200.0, 480.0, 4.0),
    "straightness": Times(1200.0, 900.0, 4.0),
    "rotation": Times(1200.0, 480.0, 4.0),
    "5-D": Times(1500.0, 600.0, 4.0),
    "6-D": Times(1500.0, 600.0, 4.0),
    "tracker": Times(1800.0, 30.0, 10.0),
    "tracker_6d": Times(1800.0, 30.0, 15.0),
    "ball_bar": Times(900.0, 300.0, 1.0),
    "station": Times(1800.0, 600.0, 5.0),
    "r_test": Times(1200.0, 600.0, 5.0),
}


@dataclass(frozen=True)
class Goal:
    """A goal; a :class:`CalibrationError` reports impossible values."""

    error: float  # allowed RMS tool error, the datum aligned, m
    tilt: float = 0.0  # of the tool, up to which the goal holds, rad
    instruments: tuple[str, ...] = ("linear",)  # available instruments, of TIMES
    seconds: float = 4.0 * 3600.0  # available time
    times: Mapping[str, Times] = field(default_factory=lambda: TIMES)

    def __post_init__(self) -> None:
        largest = 60.0  # degrees: no hexapod tilts further
        if not 0.0 < self.error < np.inf:
            raise CalibrationError("goal", f"must be finite and above zero, not {self.error * 1e6:g} µm")
        if not 0.0 <= self.tilt <= np.radians(largest):
            raise CalibrationError("tilt", f"must be 0…{largest:g}°, not {np.degrees(self.tilt):g}°")
        if not 0.0 < self.seconds < np.inf:
            raise CalibrationError("hours", f"must be finite and above zero, not {self.seconds / 3600.0:g}")
        unknown = set(self.instruments) - set(TIMES)
        if unknown or not self.instruments or len(set(self.instruments)) < len(self.instruments):
            problem = f"must be one or more of {', '.join(TIMES)}, each once"
            raise CalibrationError("instruments", f"{problem}, not {', '.join(self.instruments) or 'none'}")
        for name, times in self.times.items():
            numbers = (times.first, times.run, times.stop)
            if not (all(0.0 <= value < np.inf for value in numbers) and times.stop > 0.0):
                problem = f"must be finite, not negative, a stop above zero, not {numbers} s"
                raise CalibrationError(f"times of {name}", problem)


@dataclass(frozen=True)
class Proposal:
    """A plan for a goal; errors are those of the tool, the machine's repeatability included, RMS, m."""

    goal: Goal
    campaign: Campaign  # the runs in measuring order
    space: ParameterSpace  # the parameters to be fitted
    before: dict[str, float]  # the error before, `level` and, where the goal tilts, `tilted`
    expected: dict[str, float]  # and after
    seconds: float  # duration of the measurement
    all_of_them: float  # the worse error after all candidates,
    unseen: float  # and after enough repeats of them that noise no longer counts
    shares: dict[str, float]  # of blocks, and of the repeatability, in the remaining mean square error
    needed: float | None  # seconds in which the goal would be met; None if these candidates do not meet it

    @property
    def worst(self) -> float:
        """The larger of the expected errors, m."""
        return max(self.expected.values())

    @property
    def met(self) -> bool:
        """Whether the goal is met."""
        return self.worst <= self.goal.error

    @property
    def readings(self) -> int:
        """How many there are."""
        return sum(run.count(self.campaign.cycles) for run in self.campaign.runs)

    @property
    def each(self) -> list[float]:
        """Duration of each run, the instrument's set-up included in its first, s."""
        runs = self.campaign.runs
        first = [n == 0 or run.instrument != runs[n - 1].instrument for n, run in enumerate(runs)]
        times = [self.goal.times[run.instrument] for run in runs]
        return [t.of(run, self.campaign.cycles) + t.first * new for t, run, new in zip(times, runs, first, strict=True)]


class Aim:
    """The tool error of the goal, by parameters z of unit prior."""

    def __init__(self, space: ParameterSpace, tilt: float, stops: float = 0.0) -> None:
        self.stops = stops  # repeatability, RMS over all three axes, m: no model reduces it
        tilts = {"level": 0.0} | ({"tilted": tilt} if tilt > 0.0 else {})
        self.parts = {name: self._square(space, angle) for name, angle in tilts.items()}
        self.square = np.mean(list(self.parts.values()), axis=0)

    @staticmethod
    def _square(space: ParameterSpace, tilt: float) -> np.ndarray:
        """Return M, shape (size, size), m²: the mean square tool error with the datum aligned is tr(M·C)."""
        errors = box_errors(space, np.zeros(space.size), tilt)
        reached = 0.0 if errors is None else len(errors.places) / (2.0 * POINTS)
        if errors is None or reached < LEAST_REACHED:
            problem = f"{np.degrees(tilt):g}° is within the limits at {100.0 * reached:.0f} % of the box only"
            raise CalibrationError("tilt", f"{problem}, {100.0 * LEAST_REACHED:g} % are needed")
        spread = space.spread(space.start_tolerances())
        return np.asarray(spread[:, None] * space.whitened(space.whitened(errors.mean_squares()[0]).T) * spread)

    def errors(self, covariance: np.ndarray) -> dict[str, float]:
        """Return the RMS tool error for a covariance, level and tilted, m."""
        squares = {name: (square * covariance).sum() + self.stops**2 for name, square in self.parts.items()}
        return {name: float(np.sqrt(square)) for name, square in squares.items()}


def seen_by(space: ParameterSpace, campaign: Campaign, measured: MeasurementSet) -> list[np.ndarray]:
    """Return the derivatives of each run of a campaign's template (or part of it) by z, (k, size), over its noise."""
    rows, cells = information(space, measured, np.zeros(space.size))
    rows *= space.spread(space.start_tolerances()) / noise_factors(campaign)[cells.kind][:, None]
    run_of_station = np.empty(len(measured.stations), dtype=int)
    run_of_station[measured.station] = measured.run
    run, result = run_of_station[cells.station], []
    for n in range(len(measured.runs)):
        values, vectors = np.linalg.eigh(rows[run == n] @ rows[run == n].T)
        result.append(np.asarray(vectors[:, values > FAINT**2].T @ rows[run == n]))
    return result


def region(place: MeasuringBox, runs: Sequence[CampaignRun]) -> Extent:
    """Return the region that runs of a box cover, as far as parameters depend on it."""
    geometry = place.geometry
    positions, rotations = (np.concatenate([getattr(run, name) for run in runs]) for name in ("positions", "rotations"))
    lengths = strut_lengths_batch(Structure.of(geometry), *geometry.platform_poses(positions, rotations))
    corners = np.stack(np.meshgrid(*place.box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    platform, level = geometry.platform_poses(corners, place.level[None])
    points = platform + level @ geometry.tool.position
    return Extent(
        commands=np.array([lengths.min(), lengths.max()]),
        box=np.array([points.min(axis=0), points.max(axis=0)]),
        work_box=place.box,
        level=level[0],
        probe=np.asarray(geometry.tool.position),
    )


def propose(
    place: MeasuringBox,
    goal: Goal,
    settings: FitSettings,
    base: Campaign | None = None,
    progress: Callable[[str], object] = lambda text: None,
) -> Proposal:
    """Return the runs to measure for a goal, in measuring order; `base` gives noise, beam slope, stops and cycles."""
    progress("what could be measured")
    runs = candidates(place, goal.instruments)
    space = ParameterSpace((place.geometry, region(place, runs)), settings)
    side = float(np.ptp(place.box, axis=0).min())
    base = base or Campaign(place.box, side, side, runs=tuple(runs[:1]))
    aim = Aim(space, goal.tilt, base.stops)
    base = replace(
        base, instrument=None, diagonals=0, poses=0, box=place.box, cell=side, step=side, runs=tuple(runs[:1])
    )
    seen: list[np.ndarray] = []
    together = 40  # runs laid out at once: bounds the memory
    for start in range(0, len(runs), together):
        progress(f"what {len(runs)} runs would show: {start}")
        part = (replace(run, name=f"{n}") for n, run in enumerate(runs[start : start + together]))
        batch = replace(base, runs=tuple(part))
        seen += seen_by(space, batch, template(batch, place.geometry))

    costs = np.array([goal.times[run.instrument].of(run, base.cycles) for run in runs])
    needs, putting_up = [run.instrument for run in runs], {name: goal.times[name].first for name in goal.instruments}

    def left(choice: Greedy[ErrorLeft]) -> float:
        return max(aim.errors(choice.criterion.covariance).values())

    def chosen(instruments: Sequence[str]) -> Greedy[ErrorLeft]:
        progress(f"choosing runs of {', '.join(instruments)}")
        nothing = np.zeros((0, space.size))
        of_these = [rows if name in instruments else nothing for rows, name in zip(seen, needs, strict=True)]
        choice = Greedy(ErrorLeft(of_these, aim.square), costs, needs, putting_up)
        choice.extend(goal.seconds, lambda: left(choice) <= goal.error)
        return choice

    # All instruments, or one of them alone, which saves setting up the others.
    alone = [(name,) for name in goal.instruments] if len(goal.instruments) > 1 and any(putting_up.values()) else []
    tries = [chosen(names) for names in dict.fromkeys([tuple(goal.instruments), *alone])]
    best = min(tries, key=lambda t: (left(t) > goal.error, t.spent if left(t) <= goal.error else left(t)))
    if not best.picks:
        raise CalibrationError("hours", f"are too few: the shortest run takes {best.totals().min() / 3600.0:.2g} h")
    progress("what limits it")
    covariance, seconds, picks = best.criterion.covariance, best.spent, best.picks
    repeated = 1e4  # repeats after which only errors that the instruments do not see remain
    all_of_them, unseen = (max(aim.errors(tries[0].criterion.after_all(n)).values()) for n in (1.0, repeated))
    needed = seconds if left(best) <= goal.error else None
    expected = aim.errors(covariance)
    if needed is None and all_of_them <= goal.error:  # continued, to report the time that the goal would take
        tries[0].extend(np.inf, lambda: left(tries[0]) <= goal.error, most=25)
        needed = tries[0].spent if left(tries[0]) <= goal.error else None
    picks = sorted(picks, key=lambda n: (goal.instruments.index(needs[n]), n))
    named = tuple(replace(runs[n], name=f"{k}: {runs[n].name}") for k, n in enumerate(picks, start=1))
    of_parameter, total = (aim.square * covariance).sum(axis=1), (aim.square * covariance).sum() + aim.stops**2
    shares = {block.name: float(of_parameter[block.part].sum() / total) for block in space.blocks}
    shares["repeatability"] = aim.stops**2 / total
    return Proposal(
        goal=goal,
        campaign=replace(base, runs=named),
        space=space,
        before=aim.errors(np.eye(space.size)),
        expected=expected,
        seconds=seconds,
        all_of_them=all_of_them,
        unseen=unseen,
        shares=dict(sorted(shares.items(), key=lambda item: -item[1])),
        needed=needed,
    )


# What a proposal prints


def stops_text(stops: float) -> str:
    """Return the part of a planned tool error that is the machine's repeatability: RMS over all three axes, m."""
    if stops:
        return f"counted in: the machine's repeatability, {stops * 1e6:.3g} µm RMS over all three axes"
    return "not counted: the machine's repeatability, for none is stated (--repeatability-um)"


def proposal_report(plan: Proposal) -> str:
    """Return the report of a proposed plan: goal, prediction, limiting factor, runs in their order."""
    expected = ["expected tool error at random points of the box, both directions, the datum aligned:"]
    for name, after in plan.expected.items():
        shown = "level tool: " if name == "level" else f"tilted {np.degrees(plan.goal.tilt):g}°:"
        before = plan.before[name]
        expected.append(f"  {shown}  {um(before)} → {um(after)} RMS, {100.0 * (1.0 - after / before):.1f} % less")
    expected.append(f"  {stops_text(plan.campaign.stops)}")
    rows = [
        [run.name, str(len(run.positions)), str(run.count(plan.campaign.cycles)), number(seconds / 60.0, 0), "min"]
        for run, seconds in zip(plan.campaign.runs, plan.each, strict=True)
    ]
    used = {run.instrument: plan.goal.times[run.instrument] for run in plan.campaign.runs}
    assumed = [
        f"  {name}: {t.first / 60.0:g} min to put it up, {t.run / 60.0:g} min a run, {t.stop:g} s a stop"
        for name, t in used.items()
    ]
    head = f"{plan.readings} readings in {plan.seconds / 3600.0:.2f} h, in measuring order, if"
    runs = "\n".join([head, *assumed, aligned(("run", "places", "readings", "takes", ""), rows)])
    name = f"machine {plan.space.geometry.name}: {_goal(plan)}"
    return "\n\n".join([name, "\n".join(expected), verdict(plan), runs]) + "\n"


def proposal_json(plan: Proposal) -> dict[str, Any]:
    """Return a proposed plan as plain numbers; units are in the keys."""
    goal = plan.goal
    return {
        "machine": plan.space.geometry.name,
        "goal_m": goal.error,
        "tilt_rad": goal.tilt,
        "instruments": goal.instruments,
        "allowed_s": goal.seconds,
        "met": plan.met,
        "verdict": verdict(plan),
        "before_m": plan.before,
        "expected_m": plan.expected,
        "takes_s": plan.seconds,
        "needed_s": plan.needed,
        "all_candidates_m": plan.all_of_them,
        "unseen_m": plan.unseen,
        "repeatability_m": plan.campaign.stops,
        "shares": plan.shares,
        "readings": plan.readings,
        "runs": [
            {**run.content(), "takes_s": seconds} for run, seconds in zip(plan.campaign.runs, plan.each, strict=True)
        ],
    }


def remarks(plan: Proposal) -> list[str]:
    """Return the comment at the top of the campaign's file."""
    return [
        f"Proposed for machine {plan.space.geometry.name}: {_goal(plan)}.",
        f"Expected: {', '.join(f'{name} {um(value)}' for name, value in plan.expected.items())} RMS, datum aligned.",
        f"{plan.readings} readings in {plan.seconds / 3600.0:.1f} h, in this order.",
    ]


def verdict(plan: Proposal) -> str:
    """Report whether the goal is met and, if not, the limiting factor."""
    if plan.met:
        return f"the goal is met: {um(plan.worst)} in {plan.seconds / 3600.0:.1f} h"
    goal, named, stops = um(plan.goal.error), ", ".join(plan.goal.instruments), plan.campaign.stops
    if stops > plan.goal.error:
        beyond = f"its stops alone are {um(stops)} off, {um(stops - plan.goal.error)} more than the goal"
        limit = f"the machine's repeatability: {beyond}, and no model takes that away"
    elif plan.needed is not None:
        limit = f"time: {plan.needed / 3600.0:.1f} h would do"
    elif plan.unseen > plan.goal.error:
        left = f"{um(plan.unseen)} would be left by any number of readings of {named} in this box"
        limit = f"what these instruments do not see: {left}"
    elif plan.all_of_them > plan.goal.error:
        limit = f"the instruments' noise: all runs considered, once each, leave {um(plan.all_of_them)}"
    else:
        limit = f"time: many more runs would do; all considered leave {um(plan.all_of_them)}"
    least = 0.1  # smaller shares of blocks in the remaining error are not listed
    blocks = [f"{name} {100.0 * share:.0f} %" for name, share in plan.shares.items() if share >= least]
    return "\n".join(
        [
            f"the goal is NOT met: {um(plan.worst)} can be had in {plan.goal.seconds / 3600.0:g} h, not {goal}",
            f"  what limits it is {limit}",
            f"  of what is left: {', '.join(blocks)}",
        ]
    )


def um(value: float) -> str:
    """Return a length in µm, three digits."""
    return f"{value * 1e6:#.3g} µm"


def _goal(plan: Proposal) -> str:
    goal = plan.goal
    tilt = f" with the tool level and tilted by {np.degrees(goal.tilt):g}°" if goal.tilt else ""
    return f"goal {um(goal.error)} RMS{tilt}, with {', '.join(goal.instruments)} in {goal.seconds / 3600.0:g} h"
