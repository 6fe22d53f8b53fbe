"""Design of measurements: predict what readings would determine, and choose the best ones before anyone measures.

A campaign is designed for the smallest mean square tool error (:class:`RemainingError`, an I-optimal design), a check
for the largest log odds that it names the right change of the machine (:class:`Detectability`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from ..errors import CalibrationError
from ..formats.texts import aligned, number, relative_change
from ..machine.geometry import STRUT_NAMES
from ..machine.kinematics import Structure, strut_lengths_batch
from ..measurements.campaign import Campaign, CampaignRun, template
from ..measurements.readings import ABSOLUTE_KINDS, BACKWARD, CHANNELS, DEFAULT_UNCERTAINTY, KINDS, MeasurementSet
from .blocks import WAVES
from .blocks.load import stated_load
from .candidates import TILTS, MeasuringBox, box_template, candidates, places
from .changes import (
    HEAVIER,
    PAYLOAD,
    ROUNDING,
    STRUT,
    TEMPERATURE,
    CheckReadings,
    Evidence,
    Explanation,
    possible_changes,
    reading_noise,
    widened,
    wrong_readings,
)
from .estimator import Estimation, physical_covariance, solve
from .fit import unseen_errors
from .lead import LEAST_FREEDOM
from .observations import MeanReadings
from .parameters import Extent, FitSettings, ParameterSpace
from .posterior import (
    POINTS,
    FittedParameters,
    Observability,
    ToolError,
    UnseenError,
    about_other_loads,
    box_errors,
    expected_error,
    observe,
)
from .promise import Scatter, Unexplained
from .report import expected_json, expected_text, observability_text
from .trust import TILT

FAINT = 0.05  # σ; combinations of parameters that change the readings by less (root sum of squares) are omitted
LEAST_REACHED = 0.3  # smallest share of the box in which the machine must be able to tilt the tool by the goal's tilt


def information(space: ParameterSpace, readings: MeasurementSet, x: np.ndarray) -> tuple[np.ndarray, MeanReadings]:
    """Return ∂(mean readings / σ)/∂y, (C, size), without the instruments' unknowns, and as second the mean readings."""
    estimation = Estimation(readings, space, check_count=False)
    problem, _ = estimation.linearise(x, np.ones(len(readings)))
    return problem.rows.dense(), estimation.means


def information_of_fit(fitted: FittedParameters, readings: MeasurementSet) -> tuple[np.ndarray, MeanReadings]:
    """Return :func:`information` at the parameters x of a fit, but ∂/∂x in place of ∂/∂y."""
    rows, means = information(fitted.space, readings, fitted.x)
    return fitted.space.unwhitened(rows), means


# The planner


class Criterion(Protocol):
    """A criterion for the choice among candidates; it remembers which candidates have been chosen so far."""

    def gains(self, allowed: np.ndarray) -> np.ndarray:
        """Return by how much each allowed candidate would improve the criterion."""

    def add(self, n: int) -> None:
        """Add candidate `n` to the chosen candidates."""


C = TypeVar("C", bound=Criterion)


class Greedy(Generic[C]):
    """A greedy planner: within a budget it repeatedly chooses the candidate with the largest gain per cost."""

    def __init__(
        self,
        criterion: C,
        costs: np.ndarray,
        needs: Sequence[str] = (),  # name of the set-up that each candidate needs; by default none
        set_up_costs: Mapping[str, float] | None = None,  # cost of each set-up, which is paid once
        # Index of the candidate that must be chosen before each candidate; -1: none. If given, none is chosen twice
        after: np.ndarray | None = None,
    ) -> None:
        self.criterion, self.costs, self.set_up_costs = criterion, costs, set_up_costs or {}
        self.needs = list(needs) or [""] * len(costs)
        self.after = after
        self.picks: list[int] = []
        self.spent = 0.0

    def totals(self) -> np.ndarray:
        """Return, for each candidate, the cost of the plan if this candidate, and its set-up, is added."""
        done = {self.needs[n] for n in self.picks}
        set_ups = [0.0 if name in done else self.set_up_costs.get(name, 0.0) for name in self.needs]
        return self.spent + self.costs + set_ups

    def extend(self, budget: float, enough: Callable[[], bool] = lambda: False, most: int = 400) -> None:
        """Add up to `most` candidates; end if `enough()`, or if none within the budget improves the criterion."""
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


class RemainingError:
    """Criterion of an I-optimal design: the expected mean square tool error tr(M·C) after the measurements.

    z is the vector of parameters over their prior σ, and C its covariance. Readings with A = ∂(readings / σ)/∂z change
    C to C − CAᵀ(I + ACAᵀ)⁻¹AC, whatever their values. `seen` has the A of each candidate; `square` is M: a machine with
    the parameters z has the mean square tool error zᵀ·M·z.
    """

    def __init__(self, seen: Sequence[np.ndarray], square: np.ndarray) -> None:
        sizes = np.array([len(rows) for rows in seen])
        self.parts = [slice(*pair) for pair in pairwise(np.cumsum([0, *sizes]))]
        # Candidates of equally many rows are tried together: indices of candidates, (g,), and of their rows, (g, k)
        starts, self.alike = np.cumsum(sizes) - sizes, list[tuple[np.ndarray, np.ndarray]]()
        for size in np.unique(sizes[sizes > 0]):
            of = np.flatnonzero(sizes == size)
            self.alike.append((of, starts[of, None] + np.arange(size)))
        rows = np.concatenate(seen)
        values, vectors = np.linalg.eigh(rows.T @ rows)
        self.basis = vectors[:, values > FAINT**2]
        self.rows, self.inner = rows @ self.basis, np.eye(self.basis.shape[1])
        values, vectors = np.linalg.eigh(square)
        kept = values > 1e-9 * values[-1]  # the others contribute nothing to the tool error
        root = self.basis.T @ (vectors[:, kept] * np.sqrt(values[kept]))
        self.known, self.shown = self.rows.copy(), self.rows @ root  # A·C and A·C·√M

    @property
    def covariance(self) -> np.ndarray:
        return self._whole(self.inner)

    def _whole(self, inner: np.ndarray) -> np.ndarray:
        """Return the covariance C: `inner` in the range of `basis`, the prior's I in directions orthogonal to it."""
        return np.asarray(np.eye(len(self.basis)) + self.basis @ (inner - np.eye(len(inner))) @ self.basis.T)

    def gains(self, allowed: np.ndarray | None = None) -> np.ndarray:
        gains = np.zeros(len(self.parts))
        for of, rows in self.alike:
            chosen = slice(None) if allowed is None else allowed[of]
            rows, shown = rows[chosen], self.shown[rows[chosen]]
            gains[of[chosen]] = (shown * np.linalg.solve(self._variance(rows), shown)).sum(axis=(1, 2))
        return gains

    def add(self, n: int) -> None:
        """Add candidate `n`; a candidate may be added several times."""
        part = self.parts[n]
        known, shown = self.known[part].copy(), self.shown[part].copy()
        solved = np.linalg.solve(self._variance(part), known)
        gain = self.rows @ solved.T
        self.inner -= known.T @ solved
        self.known -= gain @ known
        self.shown -= gain @ shown

    def _variance(self, rows: slice | np.ndarray) -> np.ndarray:  # I + ACAᵀ
        reached = self.known[rows] @ np.swapaxes(self.rows[rows], -2, -1)
        return np.eye(reached.shape[-1]) + reached

    def after_all(self, times: float = 1.0) -> np.ndarray:
        """Return C, the covariance of z, if every candidate is measured `times` times."""
        return self._whole(np.linalg.inv(np.eye(self.basis.shape[1]) + times * self.rows.T @ self.rows))


# Prediction for a given campaign


@dataclass(frozen=True)
class Plan:
    measurements: MeasurementSet  # the planned readings, with the value zero
    space: ParameterSpace
    observability: Observability
    unseen_errors: tuple[UnseenError, ...]  # machine errors that the readings will not show
    level: ToolError | None  # expected error, level tool, with repeatability; machine drawn from the priors
    tilted: ToolError | None  # as `level`, for a tool tilted by :data:`~.trust.TILT`
    stops: float  # stated repeatability of the machine, RMS over all three axes, m; 0 if not stated
    notes: tuple[str, ...]  # on the tool error under loads that no reading has, and on an unknown screw lead


def plan(measurements: MeasurementSet, campaign: Campaign, settings: FitSettings) -> Plan:
    """Predict the result of a fit to the readings listed in `measurements`, of a machine drawn from the priors."""
    space = ParameterSpace(measurements, settings)
    estimation = Estimation(measurements, space)
    x, tolerances = np.zeros(space.size), space.start_tolerances()
    problem, _ = estimation.linearise(x, np.ones(len(measurements)))
    posterior = solve(space, problem, tolerances, noise_factors(campaign), rounds=0)
    covariance, prior = physical_covariance(space, posterior), space.prior_covariance(tolerances)
    beyond = Unexplained(displacement=Scatter(stops=campaign.stops, most_stops=campaign.stops))
    boxes = (box_errors(space, x, tilt) for tilt in (0.0, TILT))
    level, tilted = (expected_error(errors, covariance, prior, beyond) for errors in boxes)
    sight = observe(space, problem, posterior, measurements.tilt())
    unseen = unseen_errors(estimation, problem)
    elsewhere = about_other_loads(space, x, covariance, beyond)
    loads = f"the expected error is valid for the loads of the readings; {elsewhere}" if elsewhere else ""
    lead = about_unknown_lead(space, settings, lambda: float(problem.freedom.sum() - posterior.determined.sum()))
    return Plan(measurements, space, sight, unseen, level, tilted, campaign.stops, tuple(filter(None, (loads, lead))))


def about_unknown_lead(space: ParameterSpace, settings: FitSettings, freedom: Callable[[], float]) -> str:
    """Return a note on whether a fit would search for the screws' lead; "" if it is stated or waves are forbidden.

    `freedom` returns the degrees of freedom: readings minus all unknowns that they determine.
    """
    if np.isfinite(space.periods).all() or not set(settings.blocks) & set(WAVES):
        return ""
    missing = "no lead of the screws is stated (--lead-mm): the expected error contains no waves of the screws"
    left = freedom()
    if left >= LEAST_FREEDOM:
        return f"{missing}; a fit searches the readings for the lead"
    few = f"the readings leave {left:.0f} degrees of freedom, and the search for the lead needs {LEAST_FREEDOM:g}"
    return f"{missing}, and a fit does not search for the lead, because {few}"


def noise_factors(campaign: Campaign) -> np.ndarray:
    """Return √(noise² + repeatability²) / DEFAULT_UNCERTAINTY for each kind of channel (kinds,)."""
    default = np.array([DEFAULT_UNCERTAINTY[kind] for kind in KINDS])
    stops = np.where(np.isin(KINDS, ("rotation", "attitude")), 0.0, campaign.repeatability)
    return np.maximum(np.hypot(campaign.noise, stops), 1e-3 * default) / default


# Campaigns proposed for a goal


@dataclass(frozen=True)
class Times:
    first: float  # to install the instrument, s
    run: float  # to set the instrument up for a run, s
    stop: float  # to move to a stop and to read there, s

    def of(self, run: CampaignRun, cycles: int) -> float:
        """Return the duration of a run, s, without the time to install the instrument."""
        return self.run + self.stop * run.count(cycles) / len(run.channels)


# Instruments that can be planned, with the times of an experienced machinist
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
    """A goal of a calibration, and the instruments and time for it; an impossible value raises CalibrationError."""

    error: float  # largest RMS tool error after best-fit alignment, m
    tilt: float = 0.0  # largest tilt of the tool at which the goal must be met, rad
    instruments: tuple[str, ...] = ("linear",)  # of TIMES
    seconds: float = 4.0 * 3600.0  # available time
    times: Mapping[str, Times] = field(default_factory=lambda: TIMES)
    # Loads (rows as in Surroundings.loads) besides the machine file's, under which the goal must also be met
    loads: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        largest = 60.0  # degrees: no hexapod tilts further
        if not 0.0 < self.error < np.inf:
            raise CalibrationError("goal", f"must be finite and above zero, not {self.error * 1e6:g} µm")
        if not 0.0 <= self.tilt <= np.radians(largest):
            raise CalibrationError("tilt", f"must be 0…{largest:g}°, not {np.degrees(self.tilt):g}°")
        if not 0.0 < self.seconds < np.inf:
            raise CalibrationError("hours", f"must be finite and above zero, not {self.seconds / 3600.0:g} h")
        unknown, untimed = set(self.instruments) - set(TIMES), [n for n in self.instruments if n not in self.times]
        if unknown or not self.instruments or len(set(self.instruments)) < len(self.instruments):
            problem = f"must be one or more of {', '.join(TIMES)}, each at most once"
            raise CalibrationError("instruments", f"{problem}, not {', '.join(self.instruments) or 'none'}")
        if untimed:
            raise CalibrationError("times", f"must be given for every instrument, but {', '.join(untimed)} has none")
        for name, times in self.times.items():
            numbers = (times.first, times.run, times.stop)
            if not (all(0.0 <= value < np.inf for value in numbers) and times.stop > 0.0):
                problem = f"must be finite numbers with first ≥ 0 s, run ≥ 0 s and stop > 0 s, not {numbers}"
                raise CalibrationError(f"times of {name}", problem)


@dataclass(frozen=True)
class Proposal:
    """A campaign proposed for a goal. Errors are RMS errors of the tool, m, and include the machine's repeatability."""

    goal: Goal
    campaign: Campaign  # its runs are in measuring order
    space: ParameterSpace
    before: dict[str, float]  # error without a model, by tilt and load: "level" or "tilted", + `load_text`
    expected: dict[str, float]  # expected error with the model, by the same names
    seconds: float  # duration of the campaign, s
    with_all: float  # largest expected error if every candidate run is measured once
    unseen: float  # largest expected error if every candidate run is measured without noise
    shares: dict[str, float]  # share of each block, and of the repeatability, in the expected mean square error
    needed: float | None  # duration in which the goal would be met, s; None: not with these candidates
    loads: tuple[str, ...]  # `load_text` of each run's load
    lead: str  # note if the screws' lead is not stated; else empty

    @property
    def worst(self) -> float:
        return max(self.expected.values())

    @property
    def met(self) -> bool:
        return self.worst <= self.goal.error

    @property
    def readings(self) -> int:
        return sum(run.count(self.campaign.cycles) for run in self.campaign.runs)

    @property
    def durations(self) -> list[float]:
        """Duration of each run, s; it includes installing the instrument after a change of instrument or load."""
        runs = self.campaign.runs
        set_up = [(run.instrument, load) for run, load in zip(runs, self.loads, strict=True)]
        first = [n == 0 or one != set_up[n - 1] for n, one in enumerate(set_up)]
        times = [self.goal.times[run.instrument] for run in runs]
        return [t.of(run, self.campaign.cycles) + t.first * new for t, run, new in zip(times, runs, first, strict=True)]


class Aim:
    """The mean square tool error tr(M·C) for each tilt and load of a goal; C as in :class:`RemainingError`."""

    def __init__(self, space: ParameterSpace, goal: Goal, stops: float = 0.0) -> None:
        self.stops = stops  # repeatability, RMS over three axes, m: no model reduces it
        tilts = {"level": 0.0} | ({"tilted": goal.tilt} if goal.tilt > 0.0 else {})
        self.parts = {
            name + load_text(load): self._square(space, angle, load)
            for load in (None, *goal.loads)
            for name, angle in tilts.items()
        }
        self.square = np.mean(list(self.parts.values()), axis=0)

    @staticmethod
    def _square(space: ParameterSpace, tilt: float, load: tuple[float, ...] | None) -> np.ndarray:
        """Return the matrix M, m²: zᵀ·M·z is the mean square displacement of the tool after best-fit alignment."""
        errors = box_errors(space, np.zeros(space.size), tilt, load)
        reached = 0.0 if errors is None else len(errors.places) / (2.0 * POINTS)
        if errors is None or reached < LEAST_REACHED:
            problem = f"a tool tilted by {np.degrees(tilt):g}° can reach only {100.0 * reached:.0f} % of the box"
            raise CalibrationError("tilt", f"{problem}; at least {100.0 * LEAST_REACHED:g} % are needed")
        spread = space.spread(space.start_tolerances())
        return np.asarray(spread[:, None] * space.whitened(space.whitened(errors.mean_squares[0]).T) * spread)

    def errors(self, covariance: np.ndarray) -> dict[str, float]:
        """Return the RMS tool error, m, for each tilt and load; `covariance` is that of z (:class:`RemainingError`)."""
        squares = {name: (square * covariance).sum() + self.stops**2 for name, square in self.parts.items()}
        return {name: float(np.sqrt(square)) for name, square in squares.items()}


def seen_by(space: ParameterSpace, campaign: Campaign, measured: MeasurementSet) -> list[np.ndarray]:
    """Return for each run the derivatives (k, size), by y / prior σ, of k independent combinations of readings / σ."""
    rows, means = information(space, measured, np.zeros(space.size))
    rows *= space.spread(space.start_tolerances()) / noise_factors(campaign)[means.kind][:, None]
    run_of_station = np.empty(len(measured.stations), dtype=int)
    run_of_station[measured.station] = measured.run
    run, result = run_of_station[means.station], []
    for n in range(len(measured.runs)):
        values, vectors = np.linalg.eigh(rows[run == n] @ rows[run == n].T)
        result.append(np.asarray(vectors[:, values > FAINT**2].T @ rows[run == n]))
    return result


def region(place: MeasuringBox, runs: Sequence[CampaignRun]) -> Extent:
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
    """Propose runs, in measuring order, that meet a goal or come close; `base` states noise, repeatability, cycles."""
    progress("collecting candidate runs")
    runs = candidates(place, goal.instruments)
    space = ParameterSpace((place.geometry, region(place, runs)), settings)
    side = float(np.ptp(place.box, axis=0).min())
    base = base or Campaign(place.box, side, side, runs=tuple(runs[:1]))
    if goal.loads and not stated_load(settings).stiffness.all():
        raise CalibrationError("loads", "need the stiffness of the struts (--load)")
    aim = Aim(space, goal, base.stops)
    base = replace(
        base, instrument=None, diagonals=0, poses=0, box=place.box, cell=side, step=side, runs=tuple(runs[:1])
    )
    seen, read_under = list[np.ndarray](), list[str]()
    together = 40  # number of runs computed at once: limits the memory
    for load in (None, *goal.loads):
        for start in range(0, len(runs), together):
            progress(f"predicting the readings of {len(runs)} runs{load_text(load)}: {start}")
            part = (replace(run, name=f"{n}") for n, run in enumerate(runs[start : start + together]))
            batch = replace(base, runs=tuple(part))
            laid = template(batch, place.geometry)
            if load is not None:
                loads = np.tile(load, (len(laid.stations), 1))
                laid = replace(laid, stations=replace(laid.stations, loads=loads))
            seen += seen_by(space, batch, laid)
        read_under += [load_text(load)] * len(runs)

    per_load, runs = len(runs), runs * (1 + len(goal.loads))  # the same runs under each load
    costs = np.array([goal.times[run.instrument].of(run, base.cycles) for run in runs])
    # A change of the load requires that the instrument is installed again
    needs = [run.instrument + load for run, load in zip(runs, read_under, strict=True)]
    set_up_costs = {need: goal.times[run.instrument].first for run, need in zip(runs, needs, strict=True)}

    def left(choice: Greedy[RemainingError]) -> float:
        return max(aim.errors(choice.criterion.covariance).values())

    def chosen(set_ups: Sequence[str]) -> Greedy[RemainingError]:
        progress(f"choosing runs of {', '.join(set_ups)}")
        nothing = np.zeros((0, space.size))
        allowed = [rows if need in set_ups else nothing for rows, need in zip(seen, needs, strict=True)]
        choice = Greedy(RemainingError(allowed, aim.square), costs, needs, set_up_costs)
        choice.extend(goal.seconds, lambda: left(choice) <= goal.error)
        return choice

    # Try all instruments and each alone, all loads and fewer loads: fewer installations save time
    first, *others = dict.fromkeys(read_under)
    fewer = [(first, *others), (first,), *((first, other) for other in others)]
    alone = [(name,) for name in goal.instruments] if len(goal.instruments) > 1 and any(set_up_costs.values()) else []
    together_or_alone = (goal.instruments, *alone)
    sets = [[name + load for load in loads for name in names] for loads in fewer for names in together_or_alone]
    tries = [chosen(set_ups) for set_ups in dict.fromkeys(map(tuple, sets))]
    best = min(tries, key=lambda t: (left(t) > goal.error, t.spent if left(t) <= goal.error else left(t)))
    if not best.picks:
        if (before := left(best)) <= goal.error:
            problem = f"is met without a calibration: a tool error of {before * 1e6:.3g} µm is expected"
            raise CalibrationError("goal", problem)
        shortest = f"{best.totals().min() / 3600.0:.2g} h"
        raise CalibrationError("hours", f"are too few: the shortest run takes {shortest} with its set-up")
    progress("finding what limits the accuracy of this campaign")
    covariance, seconds, picks = best.criterion.covariance, best.spent, tuple(best.picks)
    repeated = 1e4  # number of times that each candidate is measured, so that noise no longer contributes
    with_all, unseen = (max(aim.errors(tries[0].criterion.after_all(n)).values()) for n in (1.0, repeated))
    needed = seconds if left(best) <= goal.error else None
    expected = aim.errors(covariance)
    if needed is None and with_all <= goal.error:  # extend the plan until it meets the goal, to find the time
        tries[0].extend(np.inf, lambda: left(tries[0]) <= goal.error, most=25)
        needed = tries[0].spent if left(tries[0]) <= goal.error else None
    order = sorted(picks, key=lambda n: (n // per_load, goal.instruments.index(runs[n].instrument), n))
    named = tuple(replace(runs[n], name=f"{k}: {runs[n].name}{read_under[n]}") for k, n in enumerate(order, start=1))
    of_parameter, total = (aim.square * covariance).sum(axis=1), (aim.square * covariance).sum() + aim.stops**2
    shares = {block.name: float(of_parameter[block.part].sum() / total) for block in space.blocks}
    shares["repeatability"] = aim.stops**2 / total
    campaign = replace(base, runs=named)

    def freedom() -> float:
        readings = template(campaign, place.geometry)
        estimation = Estimation(readings, space, check_count=False)
        problem, _ = estimation.linearise(np.zeros(space.size), np.ones(len(readings)))
        return float(problem.freedom.sum() - space.size + np.trace(covariance))

    return Proposal(
        goal=goal,
        campaign=campaign,
        space=space,
        before=aim.errors(np.eye(space.size)),
        expected=expected,
        seconds=seconds,
        with_all=with_all,
        unseen=unseen,
        shares=dict(sorted(shares.items(), key=lambda item: -item[1])),
        needed=needed,
        loads=tuple(read_under[n] for n in order),
        lead=about_unknown_lead(space, settings, freedom),
    )


# Readings proposed for a check

# Changes that a proposed check must name rightly
CRASH = 20e-6  # of a strut's offset, m: a light collision
WARMTH = 12e-6  # growth of the struts, m/m: steel warmed by 1 K
TOOL_CHANGED = 10.0  # of the tool's mass, kg; only if a load is stated
CHECK_READINGS = 12  # readings of a proposed check: with 12, 95 % of moved struts are named (benchmarks.upkeep)
# Channels that a check reads with each instrument (along diagonals only "linear"; roll is never read)
READ_BY = {
    "linear": ("linear",),
    "straightness": ("straightness_x", "straightness_y", "straightness_z"),
    "rotation": ("rotation_x", "rotation_y", "rotation_z"),
    "tracker": ("position_x", "position_y", "position_z"),
    "tracker_6d": ("position_x", "position_y", "position_z", "attitude_x", "attitude_y", "attitude_z"),
}


class Detectability:
    """Criterion of a check: log odds that it names the true change, be it a moved strut, grown struts or a payload."""

    def __init__(self, fitted: FittedParameters, readings: MeasurementSet, contrasts: Sequence[np.ndarray]) -> None:
        wide = widened(fitted)
        changes = possible_changes(wide.space, [block.name for block in fitted.space.blocks])
        check, every = CheckReadings.of(wide, readings), np.vstack(contrasts)
        numbers = every @ check.seen.T
        self.of_candidate = np.split(np.arange(len(every)), np.cumsum([len(rows) for rows in contrasts])[:-1])
        self.single, self.read = numbers @ check.single, every != 0.0
        self.covariance = numbers @ check.covariance(wide.covariance) @ numbers.T
        # A tracker's unknown frame makes contrasts dependent: rounding leaves eigenvalues below zero
        self.covariance += ROUNDING * np.trace(self.covariance) / len(every) * np.eye(len(every))
        self.effects = [(c, numbers @ (check.rows @ c.columns)) for c in changes]
        sizes = {(STRUT, name): CRASH for name in STRUT_NAMES} | {(TEMPERATURE, "struts"): WARMTH}
        if fitted.space.settings.load:
            sizes[PAYLOAD, HEAVIER] = TOOL_CHANGED
        self.wanted = [(c.family, c.name) for c in changes if (c.family, c.name) in sizes]
        self.moved = [sizes[c.family, c.name] * e[:, 0] for c, e in self.effects if (c.family, c.name) in sizes]
        self.chosen = np.zeros(0, dtype=int)  # indices of contrasts
        self.value = self._log_odds(self.chosen)

    def gains(self, allowed: np.ndarray) -> np.ndarray:
        tries = [
            self._log_odds(np.concatenate([self.chosen, numbers])) if ok else self.value
            for numbers, ok in zip(self.of_candidate, allowed, strict=True)
        ]
        return np.array(tries) - self.value

    def add(self, n: int) -> None:
        self.chosen = np.concatenate([self.chosen, self.of_candidate[n]])
        self.value = self._log_odds(self.chosen)

    def _log_odds(self, chosen: np.ndarray) -> float:
        """Return the log odds that a check with the `chosen` contrasts tells each `wanted` change from all others."""
        single = self.single[chosen][:, self.read[chosen].any(axis=0)]
        effects = [(change, effect[chosen]) for change, effect in self.effects]
        effects += wrong_readings(single, [""] * single.shape[1])
        evidence, log_sum = Evidence(self.covariance[np.ix_(chosen, chosen)], effects), np.logaddexp.reduce
        of_scales = evidence.log_weights(np.array(self.moved)[:, chosen])
        weights = np.array([log_sum(w, axis=1) for w in of_scales])
        seen = [(change.family, change.name) for change, _ in effects]
        # For one moved strut, "several struts" is neither right nor wrong; for warm struts any temperature is right
        right = np.array([[a == b or a[0] == b[0] != STRUT for b in self.wanted] for a in seen])
        wrong = np.array([[a[0] != b[0] or (a != b and a[1] in STRUT_NAMES) for b in self.wanted] for a in seen])
        for_it, against = (log_sum(np.where(of, weights, -np.inf), axis=0) for of in (right, wrong))
        return -float(log_sum(against - for_it))


def propose_check(
    fitted: FittedParameters,
    readings: int = CHECK_READINGS,
    instruments: Sequence[str] = ("linear", "rotation"),
) -> MeasurementSet:
    """Return the readings to take in a check, each with the value NaN; `instruments` are keys of :data:`READ_BY`."""
    for name in instruments:
        if name not in READ_BY:
            raise CalibrationError("instruments", f"must be from {', '.join(READ_BY)}, not {name!r}")
    least, most = 6, 60  # fewer readings determine almost nothing; instead of more readings, measure a campaign
    if not least <= readings <= most:
        raise CalibrationError("readings", f"must be {least}…{most}, not {readings}")
    channels = [CHANNELS.index(name) for instrument in instruments for name in READ_BY[instrument]]
    with_lines, with_poses = (
        any(name.startswith("tracker") == poses for name in instruments) for poses in (False, True)
    )
    tilts = (*TILTS, 0.0) if with_poses else (0.0,)
    every, _ = box_template(fitted.space, 2 * with_lines, 3, 12 * with_poses, tilts, "5-D")
    every = every.select(np.isin(every.channel, channels) & (every.direction != BACKWARD))
    candidates = _contrasts(every)
    every = every.select(np.isin(np.arange(len(every)), np.concatenate([added for _, added, _ in candidates])))
    contrasts, members, after = zip(*_contrasts(every), strict=True)
    costs = np.array([float(len(added)) for added in members])
    choice = Greedy(Detectability(fitted, every, contrasts), costs, after=np.array(after))
    choice.extend(float(readings))
    picked = every.select(np.isin(np.arange(len(every)), np.concatenate([members[n] for n in choice.picks])))
    return picked.with_values(np.full(len(picked), np.nan))


def _contrasts(every: MeasurementSet) -> list[tuple[np.ndarray, np.ndarray, int]]:
    """Return per candidate its contrasts (k, N), the indices of the readings that it adds, and a predecessor's index.

    The predecessor is the candidate that must be chosen earlier; −1: none. A contrast is a linear
    combination of a line's readings that does not depend on the unknown zero and slope of the instrument's beam.
    """
    along, result = every.along(), []

    def row(members: np.ndarray, weights: np.ndarray) -> np.ndarray:
        full = np.zeros((1, len(every)))
        full[0, members] = weights / np.linalg.norm(weights)
        return full

    for where, _, members in places(every):
        if where.startswith("pose "):
            result.append((np.eye(len(every))[members], members, -1))
            continue
        for channel in np.unique(every.channel[members]):
            ordered = members[every.channel[members] == channel]
            ordered = ordered[np.argsort(along[ordered])]
            three = ordered[[0, -1, len(ordered) // 2]]
            if CHANNELS[channel].startswith("straightness"):
                result.append((row(three, np.cross(np.ones(3), along[three])), three, -1))
            else:
                result.append((row(three[:2], np.array([1.0, -1.0])), three[:2], -1))
                result.append((row(three, np.array([1.0, 1.0, -2.0])), three[2:], len(result) - 1))
    return result


@dataclass(frozen=True)
class Settling:
    """Proposed further readings that would distinguish two explanations of a check's readings."""

    name: str  # a line with its ends, or a pose
    channels: tuple[str, ...]
    readings: int
    odds: float  # expected log odds for the true explanation; the smaller one, if either of the two may be true


def distinguishing_readings(
    fitted: FittedParameters, measured: MeasurementSet, explanations: tuple[Explanation, Explanation]
) -> tuple[Settling, ...]:
    """Return the three lines or poses where readings of the measured kinds best distinguish two `explanations`."""
    space, kinds = fitted.space, np.unique(measured.kind)
    by_pose = np.isin(np.array(KINDS)[kinds], ABSOLUTE_KINDS)
    sets = [box_template(space, lines=2)] if not by_pose.all() else []
    sets += [box_template(space, poses=8, tilts=(*TILTS, 0.0))] if by_pose.any() else []
    proposals = []
    for readings, _ in sets:
        readings = readings.select(np.isin(readings.kind, kinds) & (readings.direction != BACKWARD))
        if not len(readings):
            continue
        rows, means = information_of_fit(fitted, readings)
        for where, channels, members in places(readings):
            chosen = np.unique(means.of_reading[members])
            noise, a = np.diag(reading_noise(fitted)[means.kind[chosen]] ** 2), rows[chosen]
            difference = a @ (explanations[0].mean - explanations[1].mean)
            first, second = (noise + a @ e.covariance @ a.T for e in explanations)
            odds = min(_divergence(difference, first, second), _divergence(difference, second, first))
            proposals.append(Settling(where, channels, len(chosen), odds))
    return tuple(sorted(proposals, key=lambda p: -p.odds)[:3])


def _divergence(difference: np.ndarray, right: np.ndarray, wrong: np.ndarray) -> float:
    """Return the Kullback–Leibler divergence of N(0, right) from N(difference, wrong)."""
    solved = np.linalg.solve(wrong, np.column_stack([right, difference]))
    logs = np.linalg.slogdet(wrong)[1] - np.linalg.slogdet(right)[1]
    return 0.5 * float(np.trace(solved[:, :-1]) - len(right) + difference @ solved[:, -1] + logs)


# Reports


def plan_report(plan: Plan) -> str:
    m = plan.measurements
    counts = f"{len(m)} readings of {len(m.runs)} runs at {len(m.stations)} stations"
    head = f"machine {m.geometry.name}: {counts}, {plan.space.size} parameters"
    expected = expected_text(plan.level, plan.tilted, plan.observability)
    counted = [f"{expected}\n  {stops_text(plan.stops)}"] if expected else []
    seen = observability_text(plan.observability, plan.unseen_errors)
    notes = "\n".join(f"note: {note}" for note in plan.notes)
    return "\n\n".join(filter(None, [head, *counted, seen, notes])) + "\n"


def plan_json(plan: Plan) -> dict:
    return {
        "machine": plan.measurements.geometry.name,
        "readings": len(plan.measurements),
        "parameters": plan.space.size,
        "repeatability_m": plan.stops,
        "notes": plan.notes,
        **expected_json(plan.level, plan.tilted, plan.observability, plan.unseen_errors),
    }


def load_text(load: Sequence[float] | None) -> str:
    """Return the end of the names of runs with this `load`, ", tool of … kg"; "" for None: the machine file's load."""
    if load is None:
        return ""
    gravity = "" if np.isnan(load[4]) else f", gravity ({', '.join(f'{g:g}' for g in load[4:])}) m/s²"
    return f", tool of {load[0]:g} kg{gravity}"


def stops_text(stops: float) -> str:
    """State whether an expected error includes the repeatability `stops`, RMS over three axes, m."""
    if stops:
        return f"included: the machine's repeatability, {stops * 1e6:.3g} µm RMS over all three axes"
    return "not included: the machine's repeatability, which is not stated (--repeatability-um)"


def proposal_report(plan: Proposal) -> str:
    expected = ["expected tool error at random points of the box, both directions, after best-fit alignment:"]
    for name, after in plan.expected.items():
        tilt, _, load = name.partition(", ")
        shown = "level tool" if tilt == "level" else f"tilted {np.degrees(plan.goal.tilt):g}°"
        shown = f"{shown}{f' ({load})' if load else ''}:"
        before = plan.before[name]
        expected.append(f"  {shown:12} {um(before)} → {um(after)} RMS, {relative_change(before, after)}")
    expected.append(f"  {stops_text(plan.campaign.stops)}")
    if plan.goal.loads:
        under = ", ".join(load.removeprefix(", ") or "as in the machine file" for load in dict.fromkeys(plan.loads))
        expected.append(f"loads of the readings: {len(set(plan.loads))} of {1 + len(plan.goal.loads)} ({under})")
    rows = [
        [run.name, str(len(run.positions)), str(run.count(plan.campaign.cycles)), number(seconds / 60.0, 0), "min"]
        for run, seconds in zip(plan.campaign.runs, plan.durations, strict=True)
    ]
    used = {run.instrument: plan.goal.times[run.instrument] for run in plan.campaign.runs}
    assumed = [
        f"  {name}: {t.first / 60.0:g} min to install it, {t.run / 60.0:g} min for each run, {t.stop:g} s for each stop"
        for name, t in used.items()
    ]
    head = f"{plan.readings} readings in {plan.seconds / 3600.0:.2f} h, in measuring order, with these times:"
    runs = "\n".join([head, *assumed, aligned(("run", "places", "readings", "takes", ""), rows)])
    name = f"machine {plan.space.geometry.name}: {_goal(plan)}"
    return (
        "\n\n".join(filter(None, [name, "\n".join(expected), verdict(plan), plan.lead and f"note: {plan.lead}", runs]))
        + "\n"
    )


def proposal_json(plan: Proposal) -> dict[str, Any]:
    goal = plan.goal
    return {
        "machine": plan.space.geometry.name,
        "goal_m": goal.error,
        "tilt_rad": goal.tilt,
        "instruments": goal.instruments,
        "allowed_s": goal.seconds,
        "met": plan.met,
        "verdict": verdict(plan),
        "notes": [plan.lead] if plan.lead else [],
        "before_m": plan.before,
        "expected_m": plan.expected,
        "takes_s": plan.seconds,
        "needed_s": plan.needed,
        "all_candidates_m": plan.with_all,
        "unseen_m": plan.unseen,
        "repeatability_m": plan.campaign.stops,
        "shares": plan.shares,
        "loads": len(set(plan.loads)),
        "readings": plan.readings,
        "runs": [
            {**run.content(), "takes_s": seconds}
            for run, seconds in zip(plan.campaign.runs, plan.durations, strict=True)
        ],
    }


def remarks(plan: Proposal) -> list[str]:
    """Return the comment at the top of a proposed campaign's file."""
    return [
        f"Proposed for machine {plan.space.geometry.name}: {_goal(plan)}.",
        f"Expected RMS after best-fit alignment: {', '.join(f'{n} {um(size)}' for n, size in plan.expected.items())}.",
        f"{plan.readings} readings in {plan.seconds / 3600.0:.1f} h, in this order.",
    ]


def verdict(plan: Proposal) -> str:
    if plan.met:
        return f"the goal is met: {um(plan.worst)} in {plan.seconds / 3600.0:.1f} h"
    goal, named, stops = um(plan.goal.error), ", ".join(plan.goal.instruments), plan.campaign.stops
    if stops > plan.goal.error:
        beyond = f"tool error {um(stops)}, {um(stops - plan.goal.error)} above the goal"
        limit = f"the machine's repeatability ({beyond}), which no model reduces"
    elif plan.needed is not None:
        limit = f"time; the goal takes {plan.needed / 3600.0:.1f} h"
    elif plan.unseen > plan.goal.error:
        left = f"after any number of readings of {named} in this box, {um(plan.unseen)} of tool error remain"
        limit = f"machine errors that these instruments do not show; {left}"
    elif plan.with_all > plan.goal.error:
        limit = (
            f"the instruments' noise; if every candidate run is measured once, {um(plan.with_all)} of tool error remain"
        )
    else:
        limit = f"time; many more runs are needed: after all candidate runs, {um(plan.with_all)} of tool error remain"
    least = 0.1  # smallest share that is listed
    blocks = [f"{name} {100.0 * share:.0f} %" for name, share in plan.shares.items() if share >= least]
    reached = f"{um(plan.worst)} is expected after {plan.goal.seconds / 3600.0:g} h, not {goal}"
    left = f"shares of the expected mean square tool error: {', '.join(blocks)}"
    return f"the goal is NOT met: {reached}\n  limited by {limit}\n  {left}"


def um(value: float) -> str:
    return f"{value * 1e6:#.3g} µm"


def _goal(plan: Proposal) -> str:
    goal = plan.goal
    tilt = f" with the tool level and tilted by {np.degrees(goal.tilt):g}°" if goal.tilt else ""
    return f"goal {um(goal.error)} RMS{tilt}, with {', '.join(goal.instruments)} in {goal.seconds / 3600.0:g} h"
