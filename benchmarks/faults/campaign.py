"""Draw the episodes of the fault campaign, run them, and collect verdicts."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from hexapod_comp.formats.texts import aligned

from .judge import MOVER_RECOVERS_WITHIN, RECOVER_WITHIN, REPORT_WITHIN, Verdict, judge
from .kinds import KINDS, Fault, kinds_of
from .record import Happened
from .rig import Rig, refusal_to_mount

BEFORE, AFTER = 0.4, 0.5  # recorded time before the first fault, and after the time allowed for recovery, s
SECOND_WITHIN = 0.5  # from the first to the second fault, s
WARM_UP = 2.0  # motion before the first episode, s
RUNS_AGAIN_WITHIN = 5.0  # the machine is replaced if it does not run again in this time after an episode, s
STARVED = 0.1  # share of the time without a processor; above it, delays are the computer's, not the nodes'
GIVE_UP = 30.0  # duration of a fault, s
OVER = object()


@dataclass
class Episode:
    """One or two faults, each with its start, s."""

    number: int
    faults: list[tuple[float, Fault]]


@dataclass
class Outcome:
    episode: Episode
    verdict: Verdict
    happened: list[Happened]
    starved: float  # largest share of the episode in which a process was ready to run but had no processor

    def line(self, seed: int) -> str:
        """Return the missed targets, with the options that run the episode alone."""
        what = "; ".join(self.verdict.misses())
        drawn = ", ".join(f"{h.kind} ({h.detail})" if h.detail else h.kind for h in self.happened)
        busy = f" [no processor for {self.starved:.0%} of the time]" if self.starved > STARVED else ""
        return f"episode {self.episode.number}: {drawn}: {what}{busy}   (--seed {seed} --only {self.episode.number})"


def draw(seed: int, number: int, kinds: Sequence[str] = kinds_of(mover=False)) -> Episode:
    """Draw an episode from the campaign's seed and its own number.

    First faults are shuffled rounds of all kinds; half of the episodes have a second fault.
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
    record = rig.new_record()
    waited, first = rig.waited(), time.monotonic()
    rig.spin(BEFORE)
    began = time.monotonic()
    waiting = [(began + at, fault) for at, fault in episode.faults]
    under_way: list[tuple[Fault, Happened, Iterator[None]]] = []
    while (waiting or under_way) and time.monotonic() < began + GIVE_UP:
        now = time.monotonic()
        for at, fault in [entry for entry in waiting if entry[0] <= now]:
            waiting.remove((at, fault))
            happened = Happened(fault.kind, now)
            record.faults.append(happened)
            under_way.append((fault, happened, fault.run(fault, rig, happened)))
            next(under_way[-1][2])
        for entry in [entry for entry in under_way if now >= entry[1].began + entry[0].duration]:
            if next(entry[2], OVER) is OVER:
                under_way.remove(entry)
                entry[1].ended = time.monotonic()
        rig.spin(0.005)
    for _, happened, _ in under_way:
        happened.ended = math.inf
    recovery = MOVER_RECOVERS_WITHIN if rig.has_mover else RECOVER_WITHIN
    rig.spin(recovery + AFTER)
    record.ended = time.monotonic()
    longest = max(time_now - waited.get(pid, 0.0) for pid, time_now in rig.waited().items())
    verdict = judge(record, rig.geometry.limits, recovery)
    return Outcome(episode, verdict, record.faults, longest / (record.ended - first))


def campaign(episodes: Iterable[Episode], seed: int, mover: bool) -> Iterator[Outcome]:
    """Run episodes one after the other on one machine; replace the machine if it does not recover."""
    remaining = iter(episodes)
    episode = next(remaining, None)
    while episode is not None:
        with Rig(seed, mover=mover) as rig:
            rig.spin(WARM_UP)
            while episode is not None:
                yield run_episode(rig, episode)
                episode = next(remaining, None)
                rig.spin(RUNS_AGAIN_WITHIN, rig.running)
                if not rig.running():
                    break


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a table by kind of fault; an episode's recovery, losses and breaches count for each of its faults."""
    header = ["fault", "episodes", "visible", "worst report, ms", "worst recovery, s", "good commands", "lost"]
    lines: dict[str, list[str]] = {}
    for kind in dict.fromkeys(kind for outcome in outcomes for kind, _ in outcome.verdict.reports):
        found = [(o.verdict, delay) for o in outcomes for name, delay in o.verdict.reports if name == kind]
        delays = [delay for _, delay in found if not math.isnan(delay)]
        sent, lost, breaches = np.sum([[v.sent, v.lost, len(v.breaches)] for v, _ in found], axis=0)
        worst = f"{max(delays) * 1e3:.0f}" if delays else "–"
        recovery = f"{max(verdict.recovery for verdict, _ in found):.2f}"
        lines[kind] = [kind, *map(str, (len(found), len(delays), worst, recovery, sent, lost, breaches))]
    order = sorted(lines, key=[*KINDS, *lines].index)
    return aligned([*header, "breaches"], [lines[kind] for kind in order])


def chosen(only: str, episodes: int, seed: int, kinds: tuple[str, ...]) -> list[Episode]:
    """Return all episodes, or those whose numbers or kinds of fault `only` lists."""
    drawn = [draw(seed, number, kinds) for number in range(episodes)]
    if not only:
        return drawn
    names = only.split(",")
    numbers = {int(name) for name in names if name.isdigit()}
    unknown = [name for name in names if not name.isdigit() and name not in KINDS]
    if unknown:
        raise SystemExit(f"--only: unknown kind {', '.join(unknown)}; kinds are {', '.join(KINDS)}")
    picked = [draw(seed, number, kinds) for number in sorted(numbers)]
    return picked + [e for e in drawn if e.number not in numbers and {f.kind for _, f in e.faults} & set(names)]


def main(doc: str) -> int:
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="numbers of episodes, or kinds of faults, separated by commas")
    parser.add_argument("--mover", action="store_true", help="the mover node commands the poses")
    args = parser.parse_args()
    kinds, why_not = kinds_of(args.mover), refusal_to_mount()
    if why_not:
        kinds = tuple(kind for kind in kinds if kind != "log_disk_full")
        print(f"log_disk_full is left out: no file system can be mounted here ({why_not})", file=sys.stderr)
    episodes = chosen(args.only, args.episodes, args.seed, kinds)
    began, outcomes = time.monotonic(), list[Outcome]()
    try:
        for outcome in tqdm(
            campaign(episodes, args.seed, args.mover), total=len(episodes), unit="episode", disable=None
        ):
            outcomes.append(outcome)
            if outcome.verdict.misses():
                tqdm.write(outcome.line(args.seed))
                sys.stdout.flush()
    except KeyboardInterrupt:
        print(f"interrupted after {len(outcomes)} of {len(episodes)} episodes", file=sys.stderr)
    print(table(outcomes))
    missed = [outcome for outcome in outcomes if outcome.verdict.misses()]
    busy, starved = (sum(o.starved > STARVED for o in some) for some in (missed, outcomes))
    good, lost = (sum(getattr(o.verdict, name) for o in outcomes) for name in ("sent", "lost"))
    within = max((o.verdict.within for o in outcomes), default=0.0)
    print(
        f"{len(outcomes)} episodes in {(time.monotonic() - began) / 60.0:.1f} min; "
        f"{good} good commands outside the faults, {lost} lost.\n"
        f"Targets (report ≤ {REPORT_WITHIN * 1e3:.0f} ms, recovery ≤ {within:g} s, nothing lost, no breach): "
        f"{f'MISSED in {len(missed)} episodes, {busy} of them on a busy computer' if missed else 'kept'}.\n"
        f"In {starved} of the {len(outcomes)} episodes a process was ready to run and got no processor for more than "
        f"{STARVED:.0%} of the time."
    )
    return int(bool(missed))
