"""A long run at 1 kHz: is anything lost, does memory grow, how much is it, and what were the longest latencies?

Compensator and simulated drive run as processes of their own, the drive's readings go back to the compensator,
and the tool goes round a circle. Their stderr goes into a pipe that nobody reads, as when a terminal was stopped
with Ctrl-S. Latency is from just before a command is published to its strut commands' arrival here; how long each
process waited for a processor (/proc/PID/task/*/schedstat) tells how much of it is the computer's. Before that each
node's resident memory is measured at rest, and at most while somebody sends it messages of 10 MB by all its topics in
turn. 1 MB is 2²⁰ bytes.

Usage: python -m benchmarks.soak [--minutes 30] [--rate-hz 1000] [--messages 30]
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
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.experimental import EventsExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import UInt64

from benchmarks import judged
from hexapod_comp.loop.processes import PrivateDomain
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import COMMAND_QOS, EVENT_QOS
from hexapod_comp.ros.messages import nanoseconds_of, pose_message
from hexapod_comp.ros.process import SPIN_PERIOD, RosSession

NODES = ("compensator", "strut_drive")

RADIUS, TURN_TIME = 0.012, 4.0  # Circle about home, m, and time of one turn, s: 19 mm/s
RUN_IN = 3.0  # Commands are sent, and not counted, for this long first, s: until DDS has made everybody known
WARM_UP, LEAST_WARM_UP = 0.1, 5.0  # Share of the run after which memory should be flat, and at least, s
# Edges of the latency histogram, s: 0.23 % apart, so that the client's own memory stays flat
BINS = np.geomspace(1e-5, 10.0, 6001)
BAR_GROWTH = 1.0  # MB an hour

BAR_AT_REST, BAR_AT_MOST = 100.0, 200.0  # Resident memory, MB
LENGTH = 10_000_000  # Of a message, byte
SETTLED = 3.0  # What does not change for so long stays, s
HEARD = {
    "compensator": {"tool_pose_command": PoseStamped, "strut_states": JointState, "temperatures": Temperature},
    "strut_drive": {"strut_commands": JointState},
}


@dataclass
class Soak:
    """What a run found."""

    commands: int = 0  # Sent, and never answered
    lost: int = 0
    heartbeats: int = 0  # Of the compensator: heard, and missing between them
    heartbeats_lost: int = 0
    longest: float = 0.0
    # Answers by latency, in :data:`BINS`
    histogram: np.ndarray = field(default_factory=lambda: np.zeros(len(BINS) + 1, dtype=np.int64))
    # Time since the start, s, and resident memory of each node, byte
    memory: list[tuple[float, ...]] = field(default_factory=list)
    # How long the threads of each process, together, waited for a processor during the whole run, s
    waited: dict[str, float] = field(default_factory=dict)
    diagnostics: dict[str, dict[str, str]] = field(default_factory=dict)

    def quantile(self, share: float) -> float:
        """Return the latency, s, below which a share of the answers lies, to the width of a bin."""
        counts = np.cumsum(self.histogram)
        if not counts[-1]:
            return float("nan")
        index = int(np.searchsorted(counts, share * counts[-1]))
        return float(min(BINS[min(index, len(BINS) - 1)], self.longest))

    def growth(self, node: int) -> tuple[float, float]:
        """Return slope and its standard error of a node's resident memory after warming up, MB/h."""
        rows = np.array(self.memory)
        rows = rows[rows[:, 0] > max(LEAST_WARM_UP, WARM_UP * rows[-1, 0])]
        if len(rows) < 4:
            return float("nan"), float("nan")
        hours, megabytes = rows[:, 0] / 3600.0, rows[:, 1 + node] * 1e-6
        (slope, _), covariance = np.polyfit(hours, megabytes, 1, cov="unscaled")
        residual = megabytes - np.polyval(np.polyfit(hours, megabytes, 1), hours)
        return float(slope), float(np.sqrt(covariance[0, 0] * residual.var()))


class Commander:
    """Sends a circle at a fixed rate and keeps account of the answers."""

    def __init__(self, rate: float, pids: dict[str, int]) -> None:
        self.found, self._rate, self._pids = Soak(), rate, pids
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("soak", context=self.context)
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._publisher = self.node.create_publisher(PoseStamped, "tool_pose_command", COMMAND_QOS)
        self.node.create_subscription(JointState, "strut_commands", self._on_answer, QoSProfile(depth=1000))
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        self.node.create_subscription(UInt64, "compensator/heartbeat", self._on_heartbeat, QoSProfile(depth=1000))
        self._beat: int | None = None
        self._message = pose_message(Pose(np.array([0.0, 0.0, 0.4]), np.eye(3)), "base")
        self._sent: dict[int, float] = {}
        self._turned = 0.0
        self.begin()

    def begin(self) -> None:
        """Forget what was counted up to now."""
        self.found = Soak(diagnostics=self.found.diagnostics)
        self._sent.clear()
        self._waited = self._run_queue()

    def close(self) -> None:
        """Leave ROS."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def wait_until_ready(self, timeout: float = 180.0) -> None:
        """Return when both nodes are connected."""
        end = time.monotonic() + timeout
        while not (self._publisher.get_subscription_count() and set(NODES) <= set(self.found.diagnostics)):
            self.executor.spin_once(timeout_sec=SPIN_PERIOD)
            if time.monotonic() > end:
                raise SystemExit(f"the nodes did not come up within {timeout:g} s")

    def run(self, seconds: float) -> Soak:
        """Send for some seconds, wait for the last answers, and return the account."""
        self.begin()
        start = due = time.monotonic()
        next_look = start
        while (now := time.monotonic()) < start + seconds:
            self._send()
            if now >= next_look:
                self._look(now - start)
                next_look = now + 1.0
            due = max(due + 1.0 / self._rate, now)
            while (left := due - time.monotonic()) > 0.0:
                self.executor.spin_once(timeout_sec=left)
        end = time.monotonic() + 2.0
        while self._sent and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=SPIN_PERIOD)
        self._look(time.monotonic() - start)
        self.found.lost = len(self._sent)
        self.found.waited = {k: v - self._waited[k] for k, v in self._run_queue().items()}
        return self.found

    def _send(self) -> None:
        self._turned += 1.0 / (self._rate * TURN_TIME)
        angle = 2.0 * np.pi * self._turned
        position = self._message.pose.position
        position.x, position.y = RADIUS * float(np.cos(angle)) - RADIUS, RADIUS * float(np.sin(angle))
        stamp = self.node.get_clock().now()
        self._message.header.stamp = stamp.to_msg()
        self._sent[stamp.nanoseconds] = time.monotonic()
        self.found.commands += 1
        self._publisher.publish(self._message)

    def _on_answer(self, message: JointState) -> None:
        now = time.monotonic()
        sent = self._sent.pop(nanoseconds_of(message.header.stamp), None)
        if sent is None:
            return
        latency, found = now - sent, self.found
        found.histogram[np.searchsorted(BINS, latency)] += 1
        found.longest = max(found.longest, latency)

    def _on_heartbeat(self, message: UInt64) -> None:
        self.found.heartbeats += 1
        self.found.heartbeats_lost += 0 if self._beat is None else message.data - self._beat - 1
        self._beat = message.data

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.found.diagnostics[status.name.partition(":")[0]] = {v.key: v.value for v in status.values}

    def _look(self, elapsed: float) -> None:
        self.found.memory.append((elapsed, *(_resident(self._pids[name]) for name in NODES)))

    def _run_queue(self) -> dict[str, float]:
        """Return how long the threads of each process have waited for a processor up to now, s."""
        waited = dict.fromkeys((*self._pids, "client"), 0.0)
        for name, pid in {**self._pids, "client": os.getpid()}.items():
            for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                with suppress(OSError, IndexError):  # a thread that has just ended
                    waited[name] += int(path.read_text(encoding="ascii").split()[1]) * 1e-9
        return waited


def _resident(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def memory(messages: int) -> bool:
    """Print the nodes' memory at rest, and at most while long messages come; return whether they keep the bars."""
    kept = True
    with nodes() as pids, RosSession("stranger") as session:
        for name, topics in HEARD.items():
            pid, kinds, before = pids[name], list(topics.values()), math.inf
            make = session.node.create_publisher
            publishers = [make(kind, topic, QoSProfile(depth=1)) for topic, kind in topics.items()]
            while not all(publisher.get_subscription_count() for publisher in publishers):
                session.spin_once(SPIN_PERIOD)
            while abs((rest := _resident(pid) / 2**20) - before) >= 1.0:
                before = rest
                time.sleep(SETTLED)
            Path(f"/proc/{pid}/clear_refs").write_text("5", encoding="ascii")  # forget the largest so far
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
            kept &= rest <= BAR_AT_REST and most <= BAR_AT_MOST
    return kept


@contextmanager
def nodes() -> Iterator[dict[str, int]]:
    """Run both nodes in a private domain, their log into a pipe that nobody reads; give their process ids."""
    unread, sink = os.pipe()
    children = {}
    with PrivateDomain():
        try:
            for name in NODES:
                command = [sys.executable, "-m", f"hexapod_comp.ros.{name}", "--ros-args"]
                command += ["-p", "compensator:model_file:=paper_machine.yaml"]
                children[name] = subprocess.Popen(command, stderr=sink, stdin=subprocess.DEVNULL)
            yield {name: child.pid for name, child in children.items()}
        finally:
            for child in children.values():
                child.terminate()
            for child in children.values():
                child.wait(20)
            os.close(unread)
            os.close(sink)


def soak(seconds: float, rate: float) -> Soak:
    """Run everything for some seconds."""
    with nodes() as pids:
        commander = Commander(rate, pids)
        try:
            commander.wait_until_ready()
            commander.run(RUN_IN)
            return commander.run(seconds)
        finally:
            commander.close()


def report(found: Soak) -> list[str]:
    """Return the lines for people."""
    shares = (0.5, 0.9, 0.99, 0.999, 0.9999)
    quantiles = "  ".join(f"{100 * share:g} % {found.quantile(share) * 1e6:.0f}" for share in shares)
    lines = [
        f"{found.commands} commands, {found.lost} without an answer; "
        f"{found.heartbeats} heartbeats, {found.heartbeats_lost} lost",
        f"latency, µs: {quantiles}  largest {found.longest * 1e6:.0f}",
    ]
    for index, node in enumerate(NODES):
        slope, error = found.growth(index)
        lines.append(
            f"{node}: {found.memory[-1][1 + index] * 1e-6:.1f} MB, "
            f"{slope:+.2f} ± {2 * error:.2f} MB/h after warming up; "
            f"waited {found.waited[node]:.2f} s for a processor"
        )
    return lines


def main() -> int:
    """Print the account; exit 1 when something was lost or memory grew or is too large."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="of the run; 0: memory alone")
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--messages", type=int, default=30, help="of 10 MB to each node; 0: the run alone")
    args = parser.parse_args()
    problems = []
    if args.messages and not memory(args.messages):
        problems.append(f"a node has more than {BAR_AT_REST:g} MB at rest or {BAR_AT_MOST:g} MB at most")
    if args.minutes:
        found = soak(args.minutes * 60.0, args.rate_hz)
        print("\n".join(report(found)))
        problems += ["something was lost"] if found.lost or found.heartbeats_lost else []
        if any(found.growth(i)[0] > BAR_GROWTH for i in (0, 1)):
            problems.append(f"memory grows by more than {BAR_GROWTH:g} MB/h")
    return judged(problems)


if __name__ == "__main__":
    sys.exit(main())
