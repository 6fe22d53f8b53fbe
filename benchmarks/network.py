"""Compensator and drive on two hosts: network namespaces, and a cable that is cut, loses frames or delays them.

The controller stands beside the compensator. The cable is one of ours in user space (benchmarks/faults/cable.py),
since not every kernel has netem. Exits 2, with the reason, where namespaces are not permitted.

Usage: python -m benchmarks.network [--rounds 3] [--seconds 5] [--seed 0] [--only cut,loss,delay,long_cut]
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
from functools import partial

import numpy as np

from hexapod_comp.formats.texts import aligned
from hexapod_comp.ros import avoid_shared_memory

from . import cannot_run
from .faults import visible
from .faults.cable import Cable
from .faults.campaign import RUNS_AGAIN_WITHIN, WARM_UP, Episode, Outcome, run_episode
from .faults.fault import SILENT, Fault, Meaning
from .faults.namespaces import OWN_NETWORK, make_host, refusal
from .faults.record import Happened
from .faults.rig import Rig

# Set where this program runs again, in a namespace of its own: to ``cable``, or to the descriptor for orders
INSIDE = "HEXAPOD_COMP_NETWORK_BENCHMARK"


class OnCable(Fault):
    """Something is wrong with the cable."""

    order: str
    cable: socket.socket
    touches = frozenset()

    def begin(self, rig: Rig, happened: Happened) -> None:
        """Do it."""
        self.cable.sendall(f"{self.order}\n".encode("ascii"))

    def end(self, rig: Rig, happened: Happened) -> None:
        """Mend it."""
        self.cable.sendall(b"mend\n")


class Cut(OnCable):
    """It is cut for a second."""

    kind, order, meaning = "cut", "cut", SILENT["feedback"]
    shortest = longest = 1.0


class LongCut(Cut):
    """It is cut for so long that both sides forget each other."""

    kind = "long_cut"
    shortest = longest = 13.0


class Loss(OnCable):
    """One frame in twenty is lost, either way."""

    kind, order = "loss", "loss 0.05"
    meaning = Meaning("never: a newer message is there before anybody misses one", "nothing need be reported")


class Late(OnCable):
    """All frames take 50 ms, either way."""

    kind, order = "delay", "delay 0.05"
    meaning = Meaning("never: readings come as often as before, only older", "nothing need be reported")


KINDS = {kind.kind: kind for kind in (Cut, Loss, Late, LongCut)}

visible.VISIBLE.update(
    cut=partial(visible.silence, "feedback"),
    long_cut=partial(visible.silence, "feedback"),
    loss=visible.nothing,
    delay=visible.nothing,
)


def harness(args: argparse.Namespace, descriptor: int) -> int:
    """Run the episodes, on the compensator's host; the drive's is entered with the words in the environment."""
    OnCable.shortest = OnCable.longest = args.seconds
    cable = OnCable.cable = socket.socket(fileno=descriptor)
    os.environ.update(ROS_DOMAIN_ID="1", ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
    avoid_shared_memory()
    wanted = [kind for kind in KINDS if kind in args.only.split(",")]
    outcomes: list[Outcome] = []
    with cable, Rig(args.seed, wired=False, domain=False, wrappers={"drive": args.far.split()}) as rig:
        rig.spin(WARM_UP)
        for number in range(args.rounds * len(wanted)):
            fault = KINDS[wanted[number % len(wanted)]](np.random.default_rng([args.seed, number]))
            outcomes.append(run_episode(rig, Episode(number, [(0.0, fault)])))
            for miss in outcomes[-1].verdict.misses():
                busy = f" [no processor for {outcomes[-1].starved:.0%} of the time]"
                print(f"{fault.kind}, round {number // len(wanted)}: {miss}{busy}", flush=True)
            rig.spin(RUNS_AGAIN_WITHIN, rig.running)
            if not rig.running():
                print(f"{fault.kind}: the machine does not run again")
                return 1
    print(table(outcomes))
    return int(any(outcome.verdict.misses() for outcome in outcomes))


def table(outcomes: list[Outcome]) -> str:
    """Return the results by kind."""
    lines = []
    for kind in KINDS:
        verdicts = [o.verdict for o in outcomes if o.episode.kinds == [kind]]
        delays = [report.delay for v in verdicts for _, report in v.reports if report.visible]
        if verdicts:
            counts = np.sum([[v.sent, v.lost, len(v.breaches)] for v in verdicts], axis=0)
            report = f"{max(delays) * 1e3:.0f}" if delays else "–"
            recovery = f"{max(v.recovery for v in verdicts):.2f}"
            lines.append([kind, str(len(verdicts)), report, recovery, *map(str, counts)])
    header = ["cable", "episodes", "worst report, ms", "worst recovery, s", "good commands", "lost", "breaches"]
    return aligned(header, lines)


def cable(args: argparse.Namespace) -> int:
    """Make the two hosts, run the harness on one of them, and carry frames until it ends."""
    near, far = make_host(1), make_host(2)
    ours, theirs = socket.socketpair()
    command = [*near.enter, sys.executable, "-m", "benchmarks.network", *sys.argv[1:], "--far", " ".join(far.enter)]
    environment = {**os.environ, INSIDE: str(theirs.fileno())}
    try:
        child = subprocess.Popen(command, env=environment, pass_fds=[theirs.fileno()])
        theirs.close()
        carrier = Cable((near.wire, far.wire), ours, args.seed)
        carrier.run()
        print(f"{carrier.carried} frames carried, {carrier.lost} lost", file=sys.stderr)
        return child.wait()
    finally:
        near.close()
        far.close()


def main() -> int:
    """Run what this process is there for: it runs three times, outside, at the cable, and on a host."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0, help="of loss and delay")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(KINDS), help="kinds, with commas between")
    parser.add_argument("--far", default="", help=argparse.SUPPRESS)
    args = parser.parse_args()
    role = os.environ.get(INSIDE, "")
    if role == "cable":
        return cable(args)
    if role:
        return harness(args, int(role))
    why_not = refusal()
    if why_not:
        return cannot_run(f"no network namespaces here: {why_not}")
    command = [*OWN_NETWORK, sys.executable, "-m", "benchmarks.network", *sys.argv[1:]]
    return subprocess.run(command, env={**os.environ, INSIDE: "cable"}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
