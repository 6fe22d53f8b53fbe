"""What to measure: candidates, what each would show, and the best of them by a criterion.

In parameters z of unit variance so far, readings A of unit noise, free of nuisances, turn their covariance C into
C − CAᵀ(I + ACAᵀ)⁻¹AC, whatever they will read. So :class:`Greedy` chooses, before anyone measures, the candidate that
gains most for what it costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from ..errors import CalibrationError, InputFileError
from ..machine.kinematics import Structure, strut_lengths_batch
from ..measurements.campaign import Campaign, CampaignRun, template
from ..measurements.readings import DEFAULT_UNCERTAINTY, KINDS, MeasurementSet
from .candidates import MeasuringBox, candidates
from .estimator import Estimation, physical_covariance, solve
from .fit import unseen_errors
from .observations import Cells
from .parameters import Extent, FitSettings, ParameterSpace
from .posterior import POINTS, Observability, ToolError, UnseenError, box_errors, expected_error, observe
from .promise import Scatter, Unexplained
from .trust import TILT

FAINT = 0.05  # directions that readings see by less are left out, σ
LEAST_REACHED = 0.3  # share of the box in which the tool must tilt as wanted


def information(space: ParameterSpace, readings: MeasurementSet, x: np.ndarray) -> tuple[np.ndarray, Cells]:
    """Return how the parameters y move readings, (cells, size), over their stated noise and free of nuisances."""
    estimation = Estimation(readings, space, alone=False)
    problem, _ = estimation.linearise(x, np.ones(len(readings)))
    return problem.rows.dense(), estimation.cells


# The planner


class Criterion(Protocol):
    """What candidates are chosen by; it knows which have been taken."""

    def gains(self, allowed: np.ndarray) -> np.ndarray:
        """Return by how much each allowed candidate would improve it."""

    def take(self, n: int) -> None:
        """Take a candidate."""


C = TypeVar("C", bound=Criterion)


class Greedy(Generic[C]):
    """Candidates taken one by one, each time the one that gains most for its cost, as long as a budget lasts."""

    def __init__(
        self,
        criterion: C,
        costs: np.ndarray,  # of each candidate
        needs: Sequence[str] = (),  # what must be put up for it; nothing by default
        putting_up: Mapping[str, float] | None = None,  # what that costs, once
        after: np.ndarray | None = None,  # the candidate that must be taken before it, or -1: then each is taken once
    ) -> None:
        self.criterion, self.costs, self.putting_up = criterion, costs, putting_up or {}
        self.needs = list(needs) or [""] * len(costs)
        self.after = after
        self.picks: list[int] = []
        self.spent = 0.0

    def totals(self) -> np.ndarray:
        """Return what would have been spent after each candidate."""
        up = {self.needs[n] for n in self.picks}
        return self.spent + self.costs + [0.0 if name in up else self.putting_up.get(name, 0.0) for name in self.needs]

    def extend(self, budget: float, enough: Callable[[], bool] = lambda: False, most: int = 400) -> None:
        """Take candidates until there is enough, none gains or is affordable, or `most` have been taken."""
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
            self.criterion.take(best)
            self.picks.append(best)
            self.spent = float(totals[best])


class ErrorLeft:
    """Criterion: the mean square tr(M·C) of the tool's error, in parameters z of unit variance before."""

    def __init__(self, seen: Sequence[np.ndarray], square: np.ndarray) -> None:
        values, vectors = np.linalg.eigh(square)
        kept = values > 1e-9 * values[-1]  # the others add next to nothing to the tool's error
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

    def take(self, n: int) -> None:
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
        """Return C after all candidates, each so many times."""
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
    """Return what could be read in a fit's box: `lines` across each direction with diagonals, and scattered poses."""
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
    """What may be expected of a campaign."""

    measurements: MeasurementSet  # its readings, without values
    space: ParameterSpace
    observability: Observability
    unseen_errors: tuple[UnseenError, ...]  # machine errors that the readings will not show
    level: ToolError | None  # to expect after a fit, repeatability included; `before`: machines within the tolerances
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


# What a practised machinist needs, by instrument: those for which there are runs to choose from
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
    """What is wanted; a :class:`CalibrationError` names values that no goal can have."""

    error: float  # RMS tool error, the datum aligned, that may be left, m
    tilt: float = 0.0  # of the tool, up to which it holds, rad
    instruments: tuple[str, ...] = ("linear",)  # which there are, of TIMES
    seconds: float = 4.0 * 3600.0  # how long measuring may take
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
    seconds: float  # how long measuring takes
    all_of_them: float  # the worse error after all candidates,
    unseen: float  # and after so many repeats of them that noise no longer counts
    shares: dict[str, float]  # of blocks, and of the repeatability, in the mean square error left
    needed: float | None  # seconds in which the goal would be met; None where these candidates do not meet it

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
        """How long each run takes, the instrument's putting up with its first, s."""
        runs = self.campaign.runs
        first = [n == 0 or run.instrument != runs[n - 1].instrument for n, run in enumerate(runs)]
        times = [self.goal.times[run.instrument] for run in runs]
        return [t.of(run, self.campaign.cycles) + t.first * new for t, run, new in zip(times, runs, first, strict=True)]


class Aim:
    """The tool error that a goal is judged by, of parameters z of unit prior."""

    def __init__(self, space: ParameterSpace, tilt: float, stops: float = 0.0) -> None:
        self.stops = stops  # repeatability, RMS over all three axes, m: no model takes that away
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
        """Return the RMS tool error that a covariance leaves, level and tilted, m."""
        squares = {name: (square * covariance).sum() + self.stops**2 for name, square in self.parts.items()}
        return {name: float(np.sqrt(square)) for name, square in squares.items()}


def seen_by(space: ParameterSpace, campaign: Campaign, measured: MeasurementSet) -> list[np.ndarray]:
    """Return how each run of a campaign's template (or part of it) moves with z, (k, size), over its noise."""
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
    """Return the runs to measure for a goal, in measuring order; `base` tells noise, beam slope, stops and cycles."""
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

    # All instruments, or one of them alone, which saves putting up the others.
    alone = [(name,) for name in goal.instruments] if len(goal.instruments) > 1 and any(putting_up.values()) else []
    tries = [chosen(names) for names in dict.fromkeys([tuple(goal.instruments), *alone])]
    best = min(tries, key=lambda t: (left(t) > goal.error, t.spent if left(t) <= goal.error else left(t)))
    if not best.picks:
        raise CalibrationError("hours", f"are too few: the shortest run takes {best.totals().min() / 3600.0:.2g} h")
    progress("what limits it")
    covariance, seconds, picks = best.criterion.covariance, best.spent, best.picks
    repeated = 1e4  # so often measured, candidates leave only what their instruments do not see
    all_of_them, unseen = (max(aim.errors(tries[0].criterion.after_all(n)).values()) for n in (1.0, repeated))
    needed = seconds if left(best) <= goal.error else None
    expected = aim.errors(covariance)
    if needed is None and all_of_them <= goal.error:  # continued, to say what the goal would take
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
