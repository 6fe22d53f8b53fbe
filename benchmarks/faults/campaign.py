"""Draws the episodes, runs them, and gathers what the judge says."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from .fault import Fault
from .judge import MOVER_RECOVERS_WITHIN, RECOVER_WITHIN, Limits, Verdict, judge
from .kinds import KINDS, kinds_of
from .record import Happened
from .rig import Rig

BEFORE, AFTER = 0.4, 0.5
"""How long the machine is watched before the first fault, and after the last has ended and recovery is over, s."""

SECOND_WITHIN = 0.5
"""A second fault begins at most this long after the first, s."""

WARM_UP = 2.0
"""The machine moves for so long before the first episode, s."""

RUNS_AGAIN_WITHIN = 5.0
"""A machine that does not run this long after an episode, s, is replaced."""

STARVED = 0.1
"""A process that waits for a processor for more than this share of the time is starved."""

GIVE_UP = 30.0
"""A fault that is not over by then never will be, s."""


@dataclass
class Episode:
    """What is to happen.

    Attributes
    ----------
    number : int
        Its number; with the campaign's seed it decides everything that is drawn.
    faults : list of (float, Fault)
        One or two, and when each begins, s.
    """

    number: int
    faults: list[tuple[float, Fault]]

    @property
    def kinds(self) -> list[str]:
        """Names of its faults."""
        return [fault.kind for _, fault in self.faults]


@dataclass
class Outcome:
    """What has happened, and what the judge says.

    Attributes
    ----------
    starved : float
        Share of the episode for which one of the processes was ready to run and got no processor: above
        :data:`STARVED` its times say as much about the computer as about the nodes.
    """

    episode: Episode
    verdict: Verdict
    happened: list[Happened]
    starved: float = 0.0

    def line(self, seed: int) -> str:
        """Return what was missed, and how to run it alone."""
        what = "; ".join(self.verdict.misses())
        drawn = ", ".join(f"{h.kind} ({h.detail})" if h.detail else h.kind for h in self.happened)
        busy = f" [no processor for {self.starved:.0%} of the time]" if self.starved > STARVED else ""
        return f"episode {self.episode.number}: {drawn}: {what}{busy}   (--seed {seed} --only {self.episode.number})"


def draw(seed: int, number: int, kinds: Sequence[str] = kinds_of(mover=False)) -> Episode:
    """Draw one episode: its kinds come in shuffled rounds, so that all come equally often; half have a second.

    Parameters
    ----------
    seed : int
        Of the campaign.
    number : int
        Of the episode, from 0.
    kinds : sequence of str
        To draw from.
    """
    rounds, place = divmod(number, len(kinds))
    order = np.random.default_rng([seed, rounds, 0]).permutation(len(kinds))
    rng, of_first, of_second = (np.random.default_rng([seed, number, part]) for part in (1, 2, 3))
    first = KINDS[kinds[order[place]]]
    faults = [(0.0, first(of_first))]
    fitting = [KINDS[name] for name in kinds if not KINDS[name].touches & first.touches]
    if fitting and rng.uniform() < 0.5:
        second = fitting[int(rng.integers(len(fitting)))]
        faults.append((float(rng.uniform(0.0, SECOND_WITHIN)), second(of_second)))
    return Episode(number, faults)


def run_episode(rig: Rig, episode: Episode) -> Outcome:
    """Run one episode and judge it."""
    record = rig.new_record()
    waited, first = rig.waited(), time.monotonic()
    rig.spin(BEFORE)
    began = time.monotonic()
    waiting = [(began + at, fault) for at, fault in episode.faults]
    under_way: list[tuple[Fault, Happened]] = []
    ending: list[tuple[Fault, Happened]] = []
    while (waiting or under_way or ending) and time.monotonic() < began + GIVE_UP:
        now = time.monotonic()
        for at, fault in [entry for entry in waiting if entry[0] <= now]:
            waiting.remove((at, fault))
            happened = Happened(fault.kind, now)
            record.faults.append(happened)
            fault.begin(rig, happened)
            under_way.append((fault, happened))
        for entry in [entry for entry in under_way if now >= entry[1].began + entry[0].duration]:
            under_way.remove(entry)
            entry[0].end(rig, entry[1])
            ending.append(entry)
        for entry in [entry for entry in ending if entry[0].over(rig)]:
            ending.remove(entry)
            entry[1].ended = time.monotonic()
        rig.spin(0.005)
    for _, happened in ending:
        happened.ended = math.inf
    recovery = MOVER_RECOVERS_WITHIN if rig.has_mover else RECOVER_WITHIN
    rig.spin(recovery + AFTER)
    record.ended = time.monotonic()
    longest = max(time_now - waited.get(pid, 0.0) for pid, time_now in rig.waited().items())
    starved = longest / (record.ended - first)
    return Outcome(episode, judge(record, Limits.of(rig.geometry), recovery), record.faults, starved)


def campaign(episodes: Iterable[Episode], seed: int, mover: bool) -> Iterator[Outcome]:
    """Run episodes one after the other on one machine; a machine that does not recover is replaced by a new one."""
    remaining = iter(episodes)
    episode = next(remaining, None)
    while episode is not None:
        with Rig(seed, mover=mover) as rig:
            rig.spin(WARM_UP)
            while episode is not None:
                outcome = run_episode(rig, episode)
                yield outcome
                episode = next(remaining, None)
                rig.spin(RUNS_AGAIN_WITHIN, rig.running)
                if not rig.running():
                    break


@dataclass
class Row:
    """One kind of fault over a campaign: worst figures and counts."""

    kind: str
    episodes: int = 0
    visible: int = 0
    reports: list[float] = field(default_factory=list)
    recoveries: list[float] = field(default_factory=list)
    lost: int = 0
    breaches: int = 0


def rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Gather outcomes by kind; recovery, losses and breaches of an episode count for each of its faults."""
    table = {kind: Row(kind) for kind in KINDS}
    for outcome in outcomes:
        for kind, report in outcome.verdict.reports:
            row = table[kind]
            row.episodes += 1
            row.recoveries.append(outcome.verdict.recovery)
            row.lost += outcome.verdict.lost
            row.breaches += len(outcome.verdict.breaches)
            if report.visible:
                row.visible += 1
                row.reports.append(report.delay)
    return [row for row in table.values() if row.episodes]
