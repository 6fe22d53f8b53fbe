"""Which runs to measure for a wanted tool error: greedy on the error to expect, the most of it gone in each minute."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import CalibrationError
from ..machine.kinematics import Structure, strut_lengths_batch
from ..measurements.campaign import Campaign, CampaignRun, template
from .candidates import MeasuringBox, candidates
from .gains import Aim, Selection, seen_by
from .parameters import Extent, FitSettings, ParameterSpace

RUNS_AT_ONCE = 40
"""Candidates that are laid out together: bounds the memory."""

MOST_RUNS = 400
"""Of one plan."""

BEYOND = 25
"""Runs by which a plan that falls short is continued, to say what the goal would take."""

LARGEST_TILT = np.radians(60.0)
"""No hexapod tilts further."""

REPEATED = 1e4
"""So often measured, all candidates leave what their instruments do not see."""


@dataclass(frozen=True)
class Times:
    """How long an instrument takes.

    Attributes
    ----------
    first, run, stop : float
        To put it up, to set up one run, and each stop of the machine with its readings, s.
    """

    first: float
    run: float
    stop: float

    def of(self, run: CampaignRun, cycles: int) -> float:
        """Return how long a run takes, s."""
        return self.run + self.stop * run.count(cycles) / len(run.channels)


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
"""What a practised machinist needs, by instrument: those for which there are runs to choose from."""


@dataclass(frozen=True)
class Goal:
    """What is wanted.

    Parameters
    ----------
    error : float
        RMS tool error, the datum aligned, that may be left, m.
    tilt : float
        Tilt of the tool up to which it holds, rad.
    instruments : tuple of str
        Which there are, of :data:`TIMES`.
    seconds : float
        How long measuring may take.
    times : mapping of str to Times
        How long each instrument takes.

    Raises
    ------
    CalibrationError
        Values that no goal can have.
    """

    error: float
    tilt: float = 0.0
    instruments: tuple[str, ...] = ("linear",)
    seconds: float = 4.0 * 3600.0
    times: Mapping[str, Times] = field(default_factory=lambda: TIMES)

    def __post_init__(self) -> None:
        if not 0.0 < self.error < np.inf:
            raise CalibrationError("goal", f"must be finite and above zero, not {self.error * 1e6:g} µm")
        if not 0.0 <= self.tilt <= LARGEST_TILT:
            allowed = f"{np.degrees(LARGEST_TILT):g}°"
            raise CalibrationError("tilt", f"must be 0…{allowed}, not {np.degrees(self.tilt):g}°")
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
    """A plan for a goal.

    Attributes
    ----------
    goal : Goal
        What is wanted.
    campaign : Campaign
        The runs in measuring order.
    space : ParameterSpace
        The parameters to be fitted.
    before, expected : dict of str to float
        Tool error before and after, the machine's repeatability included, RMS, m, by tilt: ``level`` and, where the
        goal tilts, ``tilted``.
    seconds : float
        How long measuring takes.
    all_of_them, unseen : float
        The worse of level and tilted after all candidates, and after so many repeats that noise no longer counts, m.
    shares : dict of str to float
        Shares of blocks, and of the repeatability, in the mean square error left.
    needed : float or None
        Seconds in which the goal would be met; None where these candidates do not meet it.
    """

    goal: Goal
    campaign: Campaign
    space: ParameterSpace
    before: dict[str, float]
    expected: dict[str, float]
    seconds: float
    all_of_them: float
    unseen: float
    shares: dict[str, float]
    needed: float | None

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
        up: set[str] = set()
        taken = []
        for run in self.campaign.runs:
            times = self.goal.times[run.instrument]
            taken.append(times.of(run, self.campaign.cycles) + (0.0 if run.instrument in up else times.first))
            up.add(run.instrument)
        return taken


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
    """Return the runs to measure for a goal, in measuring order.

    Parameters
    ----------
    place : MeasuringBox
        The machine, its box, and how far its tool tilts.
    goal : Goal
        What is wanted, with what, and in which time.
    settings : FitSettings
        Blocks and tolerances of the fit.
    base : Campaign, optional
        Tells the instruments' noise, beam slope, repeatability and cycles.
    progress : callable
        Told what goes on.

    Raises
    ------
    CalibrationError, GeometryError
        Nothing can be measured there or in that time, or the tool does not tilt so far.
    """
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
    for start in range(0, len(runs), RUNS_AT_ONCE):
        progress(f"what {len(runs)} runs would show: {start}")
        part = (replace(run, name=f"{n}") for n, run in enumerate(runs[start : start + RUNS_AT_ONCE]))
        batch = replace(base, runs=tuple(part))
        seen += seen_by(space, batch, template(batch, place.geometry))
    return _Greedy(goal, runs, seen, aim, base.cycles).proposal(base, space, progress)


class _Greedy:
    """The choice of runs for a goal among candidates that are seen so and so."""

    def __init__(self, goal: Goal, runs: list[CampaignRun], seen: list[np.ndarray], aim: Aim, cycles: int) -> None:
        self.goal, self.runs, self.seen, self.aim = goal, runs, seen, aim
        self.costs = np.array([goal.times[run.instrument].of(run, cycles) for run in runs])

    def proposal(self, base: Campaign, space: ParameterSpace, progress: Callable[[str], object]) -> Proposal:
        """Return the best plan: that of all instruments, or of one of them alone, which saves putting up the others."""
        names = self.goal.instruments
        saves = len(names) > 1 and any(self.goal.times[name].first for name in names)
        sets = [names, *(((name,) for name in names) if saves else ())]
        tries = []
        for instruments in sets:
            progress(f"choosing runs of {', '.join(instruments)}")
            tries.append(self._chosen(instruments))
        best = min(
            tries, key=lambda t: (t.worst > self.goal.error, t.seconds if t.worst <= self.goal.error else t.worst)
        )
        if not best.picks:
            least = (self.costs + self._putting_up(best)).min() / 3600.0
            raise CalibrationError("hours", f"are too few: the shortest run takes {least:.2g} h")
        expected, seconds, covariance = best.errors, best.seconds, best.selection.covariance
        picks = self._ordered(best.picks)
        progress("what limits it")
        everything = tries[0].selection
        all_of_them, unseen = (max(everything.after_all(times).values()) for times in (1.0, REPEATED))
        needed = seconds if best.worst <= self.goal.error else None
        if needed is None and all_of_them <= self.goal.error:
            needed = self._needed(tries[0])
        named = tuple(replace(self.runs[n], name=f"{k}: {self.runs[n].name}") for k, n in enumerate(picks, start=1))
        return Proposal(
            goal=self.goal,
            campaign=replace(base, runs=named),
            space=space,
            before=self.aim.errors(np.eye(space.size)),
            expected=expected,
            seconds=seconds,
            all_of_them=all_of_them,
            unseen=unseen,
            shares=_shares(space, self.aim.square * covariance, self.aim.stops),
            needed=needed,
        )

    def _chosen(self, instruments: tuple[str, ...]) -> _Try:
        """Return the greedy choice of some instruments' runs, up to the goal or the end of its time."""
        allowed = np.array([run.instrument in instruments for run in self.runs])
        nothing = np.zeros((0, self.seen[0].shape[1]))
        seen = [rows if is_allowed else nothing for rows, is_allowed in zip(self.seen, allowed, strict=True)]
        attempt = _Try(Selection(seen, self.aim))
        while attempt.worst > self.goal.error and len(attempt.picks) < MOST_RUNS:
            totals = attempt.seconds + self.costs + self._putting_up(attempt)
            n = self._next(attempt, allowed & (totals <= self.goal.seconds))
            if n is None:
                break
            attempt.take(n, float(totals[n]))
        return attempt

    def _needed(self, attempt: _Try) -> float | None:
        """Return in which time a choice that fell short would meet the goal, s; None if :data:`BEYOND` runs do not."""
        every = np.ones(len(self.runs), dtype=bool)
        for _ in range(BEYOND):
            n = self._next(attempt, every)
            if n is None:
                return None
            attempt.take(n, attempt.seconds + float(self.costs[n] + self._putting_up(attempt)[n]))
            if attempt.worst <= self.goal.error:
                return attempt.seconds
        return None

    def _next(self, attempt: _Try, allowed: np.ndarray) -> int | None:
        """Return the allowed candidate that takes off most in a second, None when there is none."""
        gains = np.where(allowed, attempt.selection.gains(), 0.0)
        return int((gains / self.costs).argmax()) if gains.any() else None

    def _putting_up(self, attempt: _Try) -> np.ndarray:
        """Return what each candidate takes besides because its instrument is not up yet, s."""
        up = {self.runs[n].instrument for n in attempt.picks}
        return np.array([0.0 if run.instrument in up else self.goal.times[run.instrument].first for run in self.runs])

    def _ordered(self, picks: list[int]) -> list[int]:
        """Return picks in measuring order: instrument by instrument, and within it by attitude and direction."""
        return sorted(picks, key=lambda n: (self.goal.instruments.index(self.runs[n].instrument), n))


class _Try:
    """Runs picked so far, what they take, and what they leave."""

    def __init__(self, selection: Selection) -> None:
        self.selection = selection
        self.picks: list[int] = []
        self.seconds = 0.0
        self.errors = selection.errors()

    @property
    def worst(self) -> float:
        """The larger of the errors left, level and tilted, m."""
        return max(self.errors.values())

    def take(self, n: int, seconds: float) -> None:
        """Take a candidate, after which so much time has gone."""
        self.selection.take(n)
        self.picks.append(n)
        self.seconds, self.errors = seconds, self.selection.errors()


def _shares(space: ParameterSpace, left: np.ndarray, stops: float) -> dict[str, float]:
    """Return shares of a mean square error tr(M·C) + stops², given M·C element by element; the largest first."""
    total = float(left.sum()) + stops**2
    of_parameter = left.sum(axis=1) / total
    shares = {block.name: float(of_parameter[block.part].sum()) for block in space.blocks}
    shares["repeatability"] = stops**2 / total
    return dict(sorted(shares.items(), key=lambda item: -item[1]))
