"""The compensator against a do-nothing relay: rate and latency, side by side in one run.

Both run as processes of their own at the same time, in one ROS domain and two namespaces; short rounds
alternate between them, so that whatever else the machine does hits both alike, and a rate's rounds come in several
bouts spread over the run. Latencies of a bout are put together. A ratio is the compensator's figure divided by
the relay's of the same bout, and of those the median is told, with the quartiles.

Usage: python -m benchmarks.loop [--bouts 8] [--rounds 6] [--seconds 0.4] [--floor]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.experimental import EventsExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from hexapod_comp.loop.processes import PrivateDomain
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import COMMAND_QOS
from hexapod_comp.ros.messages import nanoseconds_of, pose_message

from . import judged, table

# Commands per second; 0 is flat out: the next one leaves when the last was answered
RATES = (250.0, 500.0, 1000.0, 0.0)

BAR_RATE, BAR_MEDIAN, BAR_P99 = 0.95, 1.10, 1.25

GIVE_UP = 0.05  # An answer that takes longer, s, is not waited for

START_WITHIN = 180.0  # The nodes may have to compile first, s

BLIND = "start_without_feedback_after:=0.1"  # There are no struts here

OURS, RELAY = "ours", "relay"

MODEL = "model_file:=paper_machine.yaml"


class Line:
    """Commands to one of the two nodes and its answers."""

    def __init__(self, node: rclpy.node.Node, namespace: str) -> None:
        self.sent: dict[int, int] = {}
        self.latencies: list[int] = []
        self._publisher = node.create_publisher(PoseStamped, f"/{namespace}/tool_pose_command", COMMAND_QOS)
        node.create_subscription(JointState, f"/{namespace}/strut_commands", self._answer, QoSProfile(depth=100))
        self._clock = node.get_clock()
        self._message = pose_message(Pose(np.array([0.0, 0.0, 0.4]), np.eye(3)), "base")
        self._count = 0

    @property
    def connected(self) -> bool:
        """Whether the node listens."""
        return self._publisher.get_subscription_count() > 0

    def send(self) -> None:
        """Send the next command of a small circle."""
        self._count += 1
        self._message.pose.position.x = 1e-3 * float(np.sin(0.01 * self._count))
        self._message.pose.position.y = 1e-3 * float(np.cos(0.01 * self._count))
        stamp = self._clock.now()
        self._message.header.stamp = stamp.to_msg()
        self.sent[stamp.nanoseconds] = time.perf_counter_ns()
        self._publisher.publish(self._message)

    def _answer(self, message: JointState) -> None:
        now = time.perf_counter_ns()
        sent = self.sent.pop(nanoseconds_of(message.header.stamp), None)
        if sent is not None:
            self.latencies.append(now - sent)


@dataclass(frozen=True)
class Figures:
    """One node's answers in one bout."""

    rate: float  # Answers per second
    median: float  # Latency's median and 99th percentile, µs
    p99: float

    @staticmethod
    def of(latencies: list[int], seconds: float) -> Figures:
        """Return the figures of latencies, ns."""
        if not latencies:
            return Figures(0.0, float("nan"), float("nan"))
        median, p99 = np.percentile(np.array(latencies) * 1e-3, [50.0, 99.0])
        return Figures(len(latencies) / seconds, float(median), float(p99))


@dataclass(frozen=True)
class Row:
    """What is told of one rate: medians over the bouts, and quartiles (25, 50, 75 %) of the bouts' ratios."""

    rate_hz: float
    ours: Figures
    relay: Figures
    rate_ratio: tuple[float, float, float]
    median_ratio: tuple[float, float, float]
    p99_ratio: tuple[float, float, float]

    @property
    def name(self) -> str:
        """The rate, for a table."""
        return f"{self.rate_hz:.0f}" if self.rate_hz else "flat out"


@contextmanager
def process(module: str, namespace: str, *parameters: str) -> Iterator[subprocess.Popen]:
    """Run a node in a namespace until the block ends."""
    arguments = ["--ros-args", "-r", f"__ns:=/{namespace}", "--log-level", "warn"]
    for parameter in parameters:
        arguments += ["-p", parameter]
    child = subprocess.Popen([sys.executable, "-m", module, *arguments])
    try:
        yield child
    finally:
        child.terminate()
        child.wait(10)


def one_round(executor: EventsExecutor, line: Line, rate: float, seconds: float) -> list[int]:
    """Send commands for some seconds; return the latencies of the answers, ns."""
    line.sent.clear()
    line.latencies = []
    start = due = time.perf_counter()
    while time.perf_counter() < start + seconds:
        if rate == 0.0:
            _ask(executor, line)
            continue
        line.send()
        due += 1.0 / rate
        while (left := due - time.perf_counter()) > 0.0:
            executor.spin_once(timeout_sec=left)
    end = time.perf_counter() + GIVE_UP
    while line.sent and time.perf_counter() < end:
        executor.spin_once(timeout_sec=0.01)
    return line.latencies


def _ask(executor: EventsExecutor, line: Line) -> None:
    """Send one command and wait for its answer."""
    answered = len(line.latencies)
    line.send()
    give_up = time.perf_counter() + GIVE_UP
    while len(line.latencies) == answered and time.perf_counter() < give_up:
        executor.spin_once(timeout_sec=0.01)


def bout(
    executor: EventsExecutor, lines: dict[str, Line], rate: float, rounds: int, seconds: float
) -> dict[str, Figures]:
    """Return both nodes' figures of some rounds in turn."""
    latencies: dict[str, list[int]] = {name: [] for name in lines}
    for number in range(rounds):
        for name in sorted(lines, reverse=bool(number % 2)):
            latencies[name] += one_round(executor, lines[name], rate, seconds)
    return {name: Figures.of(found, rounds * seconds) for name, found in latencies.items()}


def summary(rate: float, bouts: list[dict[str, Figures]]) -> Row:
    """Return a rate's row."""
    ours, relay = (np.array([[f.rate, f.median, f.p99] for f in (b[who] for b in bouts)]) for who in (OURS, RELAY))
    quartiles = np.nanpercentile(ours / relay, [25.0, 50.0, 75.0], axis=0)
    ratios = [tuple(quartiles[:, i].tolist()) for i in range(3)]
    return Row(rate, Figures(*np.nanmedian(ours, axis=0)), Figures(*np.nanmedian(relay, axis=0)), *ratios)


def measure(bouts: int, rounds: int, seconds: float, floor: bool = False) -> list[Row]:
    """Run everything and return one row per rate; `floor`: against the relay that does not even look at messages."""
    with ExitStack() as stack:
        stack.enter_context(PrivateDomain())
        stack.enter_context(process("hexapod_comp.ros.compensator", OURS, "marker_rate:=0.0", BLIND, MODEL))
        stack.enter_context(process("benchmarks.relay", RELAY, f"serialized:={str(floor).lower()}"))
        context = rclpy.Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("bench", context=context)
        executor = EventsExecutor(context=context)
        executor.add_node(node)
        lines = {name: Line(node, name) for name in (OURS, RELAY)}
        _warm_up(executor, lines)
        found: dict[float, list[dict[str, Figures]]] = {rate: [] for rate in RATES}
        for _ in range(bouts):
            for rate in RATES:
                found[rate].append(bout(executor, lines, rate, rounds, seconds))
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    return [summary(rate, figures) for rate, figures in found.items()]


def _warm_up(executor: EventsExecutor, lines: dict[str, Line]) -> None:
    """Wait until both nodes listen and answer."""
    give_up = time.monotonic() + START_WITHIN
    while not all(line.connected for line in lines.values()):
        executor.spin_once(timeout_sec=0.05)
        if time.monotonic() > give_up:
            raise SystemExit(f"the nodes did not come up within {START_WITHIN:g} s")
    for line in lines.values():
        while not one_round(executor, line, 250.0, 1.0):
            if time.monotonic() > give_up:
                raise SystemExit(f"the nodes did not answer within {START_WITHIN:g} s")


def report(rows: list[Row]) -> str:
    """Return the table of rates and latencies."""
    columns = ["rate, Hz"]
    for figure in ("answers/s", "median, µs", "99 %, µs"):
        columns += [f"{figure}: relay", "ours", "ratio"]
    lines = []
    for r in rows:
        middle, tail = (f"{q[1]:.3f} ({q[0]:.2f}–{q[2]:.2f})" for q in (r.median_ratio, r.p99_ratio))
        pairs = [(r.relay.rate, r.ours.rate), (r.relay.median, r.ours.median), (r.relay.p99, r.ours.p99)]
        both = [[f"{value:.0f}" for value in pair] for pair in pairs]
        lines.append([r.name, *both[0], f"{r.rate_ratio[1]:.3f}", *both[1], middle, *both[2], tail])
    return table(columns, lines)


def problems(rows: list[Row]) -> list[str]:
    """Return the rates at which the compensator misses a bar."""
    found = []
    for r in rows:
        rate, median, p99 = r.rate_ratio[1], r.median_ratio[1], r.p99_ratio[1]
        if not (rate >= BAR_RATE and median <= BAR_MEDIAN and p99 <= BAR_P99):
            bars = f"{BAR_RATE} / {BAR_MEDIAN} / {BAR_P99}"
            ratios = f"{rate:.3f} / {median:.3f} / {p99:.3f}, bars {bars}"
            found.append(f"compensator at {r.name}: rate / median / 99 % of the relay's {ratios}")
    return found


def main() -> int:
    """Print the table; exit 1 when a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bouts", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=0.4)
    parser.add_argument("--floor", action="store_true", help="against the relay that passes bytes; no bars")
    args = parser.parse_args()
    rows = measure(args.bouts, args.rounds, args.seconds, args.floor)
    print(report(rows))
    return 0 if args.floor else judged(problems(rows))


if __name__ == "__main__":
    sys.exit(main())
