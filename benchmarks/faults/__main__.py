"""The fault campaign: a moving machine, one or two faults per episode, and a judge.

Usage: python -m benchmarks.faults [--mover] [--episodes 300] [--seed 0] [--only 17,kill_drive] [--definitions]

Every miss is printed with what runs it alone. Exits with 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
import time

from tqdm import tqdm

from hexapod_comp.formats.texts import aligned

from .campaign import STARVED, Episode, Outcome, campaign, draw, rows
from .judge import REPORT_WITHIN
from .kinds import KINDS, kinds_of
from .logdisk import refusal_to_mount


def chosen(only: str, episodes: int, seed: int, kinds: tuple[str, ...]) -> list[Episode]:
    """Return the episodes to run: all, those of the numbers given, or those with the kinds given."""
    drawn = [draw(seed, number, kinds) for number in range(episodes)]
    if not only:
        return drawn
    names = only.split(",")
    numbers = {int(name) for name in names if name.isdigit()}
    unknown = [name for name in names if not name.isdigit() and name not in KINDS]
    if unknown:
        raise SystemExit(f"--only: there is no kind {', '.join(unknown)}; there are {', '.join(KINDS)}")
    picked = [draw(seed, number, kinds) for number in sorted(numbers)]
    return picked + [e for e in drawn if e.number not in numbers and set(e.kinds) & set(names)]


def definitions() -> str:
    """Return the table of what each fault is, when it is visible, and who must say what."""
    lines = [["fault", "what", "visible from the moment at which", "who must say what"]]
    lines += [[name, (k.__doc__ or "").split("\n")[0], k.meaning.visible, k.meaning.said] for name, k in KINDS.items()]
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], ["---"] * 4, *lines[1:]])


def table(outcomes: list[Outcome]) -> str:
    """Return the table of results."""
    header, lines = ["fault", "episodes", "visible", "worst report, ms", "worst recovery, s", "lost", "breaches"], []
    for row in rows(outcomes):
        report = f"{max(row.reports) * 1e3:.0f}" if row.reports else "–"
        counts = str(row.episodes), str(row.visible)
        lines.append([row.kind, *counts, report, f"{max(row.recoveries):.2f}", str(row.lost), str(row.breaches)])
    return aligned(header, lines)


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="numbers of episodes, or kinds of faults, with commas between")
    parser.add_argument("--mover", action="store_true", help="the poses come from the mover node")
    parser.add_argument("--definitions", action="store_true", help="print when each fault is visible, and to whom")
    args = parser.parse_args()
    if args.definitions:
        print(definitions())
        return 0
    kinds, why_not = kinds_of(args.mover), refusal_to_mount()
    if why_not:
        kinds = tuple(kind for kind in kinds if kind != "log_disk_full")
        print(f"log_disk_full is left out: no file system can be mounted here ({why_not})", file=sys.stderr)
    episodes = chosen(args.only, args.episodes, args.seed, kinds)
    began, outcomes, total = time.monotonic(), [], len(episodes)
    try:
        for outcome in tqdm(campaign(episodes, args.seed, args.mover), total=total, unit="episode", disable=None):
            outcomes.append(outcome)
            if outcome.verdict.misses():
                tqdm.write(outcome.line(args.seed))
                sys.stdout.flush()
    except KeyboardInterrupt:
        print(f"interrupted after {len(outcomes)} of {len(episodes)} episodes", file=sys.stderr)
    print(table(outcomes))
    print(summary(outcomes, time.monotonic() - began))
    return int(any(outcome.verdict.misses() for outcome in outcomes))


def summary(outcomes: list[Outcome], seconds: float) -> str:
    """Return what the campaign comes down to."""
    missed = [outcome for outcome in outcomes if outcome.verdict.misses()]
    busy = sum(outcome.starved > STARVED for outcome in missed)
    starved = sum(outcome.starved > STARVED for outcome in outcomes)
    good, lost = (sum(getattr(o.verdict, name) for o in outcomes) for name in ("sent", "lost"))
    within = max((o.verdict.within for o in outcomes), default=0.0)
    return (
        f"{len(outcomes)} episodes in {seconds / 60.0:.1f} min; {good} good commands outside the faults, {lost} lost.\n"
        f"Bars (report ≤ {REPORT_WITHIN * 1e3:.0f} ms, recovery ≤ {within:g} s, nothing lost, no breach): "
        f"{f'MISSED in {len(missed)} episodes, {busy} of them on a busy computer' if missed else 'kept'}.\n"
        f"In {starved} of the {len(outcomes)} episodes a process was ready to run and got no processor for more than "
        f"{STARVED:.0%} of the time."
    )


if __name__ == "__main__":
    sys.exit(main())
