"""A long run at 1 kHz: lost commands, growth and size of memory, and longest latencies.

Usage: python -m benchmarks.soak [--minutes 30] [--rate-hz 1000] [--messages 30]

A latency lasts from the publication of a command to the arrival of its strut commands here. The part of it for which a
process waited for a processor (/proc/PID/task/*/schedstat) is due to the computer. 1 MB is 2²⁰ bytes.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import UInt64

from benchmarks import judged
from benchmarks.loop import Line, one_round, process
from hexapod_comp.loop.processes import PrivateDomain
from hexapod_comp.ros.base import EVENT_QOS
from hexapod_comp.ros.process import SPIN_PERIOD, RosSession

NODES = ("compensator", "strut_drive")
RADIUS, TURN_TIME = 0.012, 4.0  # circle about home, m, and time of a turn, s: 19 mm/s
RUN_IN = 3.0  # commands at the start that do not count, s: DDS discovers the participants
WARM_UP, LEAST_WARM_UP = 0.1, 5.0  # at the start, memory may grow: for this share of the run, and at least this time, s
# Targets: growth of memory, MB/h, and besides one of the arenas in which Python allocates memory, MB
TARGET_GROWTH, ARENA = 1.0, 1.0
TARGET_AT_REST, TARGET_AT_MOST = 100.0, 200.0  # targets: resident memory at rest, and with long messages, MB
LENGTH = 10_000_000  # of a long message, bytes
SETTLED = 3.0  # memory that changes by less than 1 MB in this time, s, is at rest
HEARD = {
    "compensator": {"tool_pose_command": PoseStamped, "strut_states": JointState, "temperatures": Temperature},
    "strut_drive": {"strut_commands": JointState},
}


@dataclass
class Soak:
    latencies: list[int]  # of the answers, ns
    lost: int  # commands without an answer
    beats: list[int]  # received heartbeats of the compensator, by number
    memory: list[tuple[float, ...]]  # time since the start, s, and each node's resident memory, bytes
    # Time for which each process' threads waited for a processor in the run, summed, s
    waited: dict[str, float] = field(default_factory=dict)
    diagnostics: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def heartbeats_lost(self) -> int:
        """Heartbeats that are missing between the first and the last received one."""
        return self.beats[-1] - self.beats[0] + 1 - len(self.beats) if self.beats else 0

    def growth(self, node: int) -> tuple[float, float]:
        """Return the growth of a node's memory after the warm-up, MB, and the hours between.

        It is the difference between the medians of the last and the first tenth of the readings.
        """
        rows = np.array(self.memory)
        rows = rows[rows[:, 0] > max(LEAST_WARM_UP, WARM_UP * rows[-1, 0])]
        tenth = max(len(rows) // 10, 1)
        first, last = (np.median(part, axis=0) for part in (rows[:tenth], rows[-tenth:]))
        return float(last[1 + node] - first[1 + node]) / 2**20, float(last[0] - first[0]) / 3600.0


def run_queue(pids: dict[str, int]) -> dict[str, float]:
    """Return the time for which each process' threads have waited for a processor so far, s."""
    waited = dict.fromkeys(pids, 0.0)
    for name, pid in pids.items():
        for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            with suppress(OSError, IndexError):  # the thread has just ended
                waited[name] += int(path.read_text(encoding="ascii").split()[1]) * 1e-9
    return waited


def _resident(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def memory(messages: int) -> bool:
    """Print each node's memory at rest and its largest memory with long messages; return whether targets are met."""
    kept = True
    with nodes() as pids, RosSession("stranger") as session:
        for name, topics in HEARD.items():
            pid, kinds, before = pids[name], list(topics.values()), math.inf
            make = session.node.create_publisher
            publishers = [make(kind, topic, QoSProfile(depth=1)) for topic, kind in topics.items()]
            session.wait(lambda some=publishers: all(p.get_subscription_count() for p in some), 180.0, f"the {name}")
            while abs((rest := _resident(pid) / 2**20) - before) >= 1.0:
                before = rest
                time.sleep(SETTLED)
            Path(f"/proc/{pid}/clear_refs").write_text("5", encoding="ascii")  # reset the largest memory
            for number in range(messages):
                message = kinds[number % len(kinds)]()
                message.header.frame_id = "x" * LENGTH
                publishers[number % len(kinds)].publish(message)
                end = time.monotonic() + 0.2
                while time.monotonic() < end:
                    session.spin_once(SPIN_PERIOD)
            status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
            most = int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 1024.0
            print(f"{name}: {rest:.0f} MB at rest, with messages of 10 MB {most:.0f} MB at most", flush=True)
            kept &= rest <= TARGET_AT_REST and most <= TARGET_AT_MOST
    return kept


@contextmanager
def nodes() -> Iterator[dict[str, int]]:
    """Run both nodes in a private domain, with a log pipe that nobody reads; yield their process ids."""
    unread, sink = os.pipe()
    with PrivateDomain(), ExitStack() as stack:
        stack.callback(os.close, unread)
        stack.callback(os.close, sink)
        arguments, options = (
            "-p compensator:model_file:=paper_machine.yaml",
            {"stderr": sink, "stdin": subprocess.DEVNULL},
        )
        children = [process(f"hexapod_comp.ros.{name}", arguments, **options) for name in NODES]
        yield {name: stack.enter_context(child).pid for name, child in zip(NODES, children, strict=True)}


def soak(seconds: float, rate: float) -> Soak:
    with nodes() as pids, RosSession("soak") as session:
        found, line = Soak([], 0, [], []), Line(session.node, "", RADIUS, rate * TURN_TIME)

        def on_diagnostics(message: DiagnosticArray) -> None:
            for status in message.status:
                found.diagnostics[status.name.partition(":")[0]] = {v.key: v.value for v in status.values}

        depth = QoSProfile(depth=1000)
        session.node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, EVENT_QOS)
        beat = lambda message: found.beats.append(message.data)  # type: ignore[attr-defined]  # noqa: E731
        session.node.create_subscription(UInt64, "compensator/heartbeat", beat, depth)
        session.wait(lambda: line.connected and set(NODES) <= set(found.diagnostics), 180.0, "the nodes")
        one_round(session, line, rate, RUN_IN)
        found.beats.clear()
        before = run_queue(pids)
        found.latencies = one_round(
            session,
            line,
            rate,
            seconds,
            patience=2.0,
            each_second=lambda elapsed: found.memory.append((elapsed, *(_resident(pids[name]) for name in NODES))),
        )
        found.lost = len(line.sent)
        found.waited = {name: waited - before[name] for name, waited in run_queue(pids).items()}
    return found


def report(found: Soak) -> list[str]:
    shares = (50.0, 90.0, 99.0, 99.9, 99.99)
    sizes = np.percentile(found.latencies or [np.nan], shares) * 1e-3
    quantiles = "  ".join(f"{share:g} % {size:.0f}" for share, size in zip(shares, sizes, strict=True))
    lines = [
        f"{len(found.latencies) + found.lost} commands, {found.lost} without an answer; "
        f"{len(found.beats)} heartbeats, {found.heartbeats_lost} lost",
        f"latency, µs: {quantiles}  largest {max(found.latencies, default=0) * 1e-3:.0f}",
    ]
    for index, node in enumerate(NODES):
        growth, hours = found.growth(index)
        lines.append(
            f"{node}: {found.memory[-1][1 + index] / 2**20:.1f} MB, "
            f"{growth:+.2f} MB in the {60.0 * hours:.0f} min after the warm-up; "
            f"waited {found.waited[node]:.2f} s for a processor"
        )
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="duration of the run; 0: memory test only")
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--messages", type=int, default=30, help="number of 10 MB messages to each node; 0: run only")
    args = parser.parse_args()
    problems = []
    if args.messages and not memory(args.messages):
        problems.append(f"a node has more than {TARGET_AT_REST:g} MB at rest or {TARGET_AT_MOST:g} MB at most")
    if args.minutes:
        found = soak(args.minutes * 60.0, args.rate_hz)
        print("\n".join(report(found)))
        problems += ["a command or a heartbeat was lost"] if found.lost or found.heartbeats_lost else []
        if any(growth > TARGET_GROWTH * hours + ARENA for growth, hours in map(found.growth, (0, 1))):
            problems.append(f"memory grows by more than {ARENA:g} MB and {TARGET_GROWTH:g} MB/h")
    return judged(problems)


if __name__ == "__main__":
    sys.exit(main())
