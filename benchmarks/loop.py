"""The compensator against a do-nothing relay: rate and latency, side by side in one run.

Both run as processes of their own at the same time, in one ROS domain and two namespaces; short rounds
alternate between them, so that whatever else the machine does hits both alike. A ratio is the median over
the rounds of the compensator's figure divided by the relay's of the same round.

Usage: python -m benchmarks.loop [--rounds 15] [--seconds 1.0] [--json]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.experimental import EventsExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState

from hexapod_comp.conversions import pose_message
from hexapod_comp.nodes.processes import PrivateDomain
from hexapod_comp.nodes.runtime import COMMAND_QOS
from hexapod_comp.pose import Pose

RATES = (250.0, 500.0, 1000.0, 0.0)
"""Commands per second; 0 is flat out: the next one leaves when the last was answered."""

BAR_RATE, BAR_LATENCY = 0.9, 1.15


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
        sent = self.sent.pop(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec, None)
        if sent is not None:
            self.latencies.append(now - sent)


@contextmanager
def process(module: str, namespace: str, *parameters: str):
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


def one_round(executor: EventsExecutor, line: Line, rate: float, seconds: float) -> tuple[float, float, float]:
    """Return (answers per second, median latency µs, 99th percentile µs) of one round."""
    line.sent.clear()
    line.latencies.clear()
    start = due = time.perf_counter()
    while (now := time.perf_counter()) < start + seconds:
        if rate == 0.0:
            answered = len(line.latencies)
            line.send()
            give_up = now + 0.05
            while len(line.latencies) == answered and time.perf_counter() < give_up:
                executor.spin_once(timeout_sec=0.01)
            continue
        line.send()
        due += 1.0 / rate
        while (left := due - time.perf_counter()) > 0.0:
            executor.spin_once(timeout_sec=left)
    end = time.perf_counter() + 0.05
    while line.sent and time.perf_counter() < end:
        executor.spin_once(timeout_sec=0.01)
    latencies = np.array(line.latencies or [np.nan]) * 1e-3
    return len(line.latencies) / seconds, float(np.median(latencies)), float(np.percentile(latencies, 99))


def measure(rounds: int, seconds: float) -> list[dict[str, float]]:
    """Run everything and return one row per rate."""
    with ExitStack() as stack:
        stack.enter_context(PrivateDomain())
        stack.enter_context(process("hexapod_comp.nodes.compensator", "ours", "marker_rate:=0.0"))
        stack.enter_context(process("benchmarks.relay", "relay"))
        context = rclpy.Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("bench", context=context)
        executor = EventsExecutor(context=context)
        executor.add_node(node)
        lines = {name: Line(node, name) for name in ("ours", "relay")}
        give_up = time.monotonic() + 120.0
        while not all(line.connected for line in lines.values()):
            executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > give_up:
                raise SystemExit("the nodes did not come up within 120 s")
        for line in lines.values():
            one_round(executor, line, 250.0, 1.0)
        rows = [compare(executor, lines, rate, rounds, seconds) for rate in RATES]
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    return rows


def compare(
    executor: EventsExecutor, lines: dict[str, Line], rate: float, rounds: int, seconds: float
) -> dict[str, float]:
    """Return one rate's row: medians over the rounds, and medians of the rounds' ratios."""
    results: dict[str, list[tuple[float, float, float]]] = {name: [] for name in lines}
    for number in range(rounds):
        for name in sorted(lines, reverse=bool(number % 2)):
            results[name].append(one_round(executor, lines[name], rate, seconds))
    ours, relay = np.array(results["ours"]), np.array(results["relay"])
    ratio = np.median(ours / relay, axis=0)
    return {
        "rate_hz": rate,
        "relay_rate": float(np.median(relay[:, 0])),
        "our_rate": float(np.median(ours[:, 0])),
        "rate_ratio": float(ratio[0]),
        "relay_median_us": float(np.median(relay[:, 1])),
        "our_median_us": float(np.median(ours[:, 1])),
        "median_ratio": float(ratio[1]),
        "p99_ratio": float(ratio[2]),
    }


def main() -> int:
    """Print the table; exit 1 when a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = measure(args.rounds, args.seconds)
    if args.json:
        json.dump(rows, sys.stdout, indent=1)
        print()
    else:
        print("rate, Hz   answers/s relay    ours   ratio   median latency, µs relay    ours   ratio   99 % ratio")
        for row in rows:
            rate = f"{row['rate_hz']:8.0f}" if row["rate_hz"] else "flat out"
            print(
                f"{rate}   {row['relay_rate']:15.0f} {row['our_rate']:7.0f} {row['rate_ratio']:7.3f}"
                f"   {row['relay_median_us']:24.1f} {row['our_median_us']:7.1f} {row['median_ratio']:7.3f}"
                f"   {row['p99_ratio']:10.3f}"
            )
    kept = all(row["rate_ratio"] >= BAR_RATE and row["median_ratio"] <= BAR_LATENCY for row in rows)
    verdict = "kept" if kept else "MISSED"
    print(f"bars (rate ≥ {BAR_RATE} ×, median latency ≤ {BAR_LATENCY} ×): {verdict}", file=sys.stderr)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
