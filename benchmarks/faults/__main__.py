"""The fault campaign: a moving machine, one or two faults per episode, and a judge.

Usage: python -m benchmarks.faults [--mover] [--episodes 300] [--seed 0] [--only 17,kill_drive]

Every miss is printed with what runs it alone. Exits with 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import sys
import time

from tqdm import tqdm

from .campaign import STARVED, Episode, Outcome, campaign, draw, table
from .judge import REPORT_WITHIN
from .kinds import KINDS, kinds_of
from .rig import refusal_to_mount


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
    return picked + [e for e in drawn if e.number not in numbers and {f.kind for _, f in e.faults} & set(names)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="numbers of episodes, or kinds of faults, with commas between")
    parser.add_argument("--mover", action="store_true", help="the poses come from the mover node")
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
        f"Bars (report ≤ {REPORT_WITHIN * 1e3:.0f} ms, recovery ≤ {within:g} s, nothing lost, no breach): "
        f"{f'MISSED in {len(missed)} episodes, {busy} of them on a busy computer' if missed else 'kept'}.\n"
        f"In {starved} of the {len(outcomes)} episodes a process was ready to run and got no processor for more than "
        f"{STARVED:.0%} of the time."
    )
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
