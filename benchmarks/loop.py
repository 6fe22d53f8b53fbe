"""Rate and latency of the compensator compared with a relay node that computes nothing, in one run.

Usage: python -m benchmarks.loop [--bouts 8] [--rounds 6] [--seconds 0.4] [--floor]

In each bout the rounds of both nodes alternate. The ratio of the compensator's figure to the relay's is computed for
each bout; its median and quartiles over the bouts are printed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from hexapod_comp.loop.processes import PrivateDomain
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import COMMAND_QOS
from hexapod_comp.ros.messages import nanoseconds_of, pose_message
from hexapod_comp.ros.process import RosSession

from . import judged, table

# Commands per second; 0: each command is sent as soon as the one before is answered
RATES = (250.0, 500.0, 1000.0, 0.0)
TARGET_RATE, TARGET_MEDIAN, TARGET_P99 = 0.95, 1.10, 1.25  # of the compensator's figures / the relay's
GIVE_UP = 0.05  # longest wait for an answer, s
START_WITHIN = 180.0  # longest wait for the nodes, s
OURS, RELAY = "ours", "relay"
QUIET = "--log-level warn -r __ns:=/"
ALONE = "-p marker_rate:=0.0 -p start_without_feedback_after:=0.1 -p model_file:=paper_machine.yaml"  # without struts


class Line:
    """A client of one node: it commands poses on a circle through home and records the answers' latencies, ns."""

    def __init__(self, node: rclpy.node.Node, namespace: str, radius: float = 1e-3, per_turn: float = 628.0) -> None:
        self.sent: dict[int, int] = {}
        self.latencies: list[int] = []
        self._publisher = node.create_publisher(PoseStamped, f"{namespace}/tool_pose_command", COMMAND_QOS)
        node.create_subscription(JointState, f"{namespace}/strut_commands", self._answer, QoSProfile(depth=1000))
        self._clock, self._radius, self._angle = node.get_clock(), radius, 2.0 * np.pi / per_turn
        self._message = pose_message(Pose(np.array([0.0, 0.0, 0.4]), np.eye(3)), "base")
        self._count = 0

    @property
    def connected(self) -> bool:
        return self._publisher.get_subscription_count() > 0

    def send(self) -> None:
        self._count += 1
        angle, position = self._angle * self._count, self._message.pose.position
        position.x, position.y = self._radius * (float(np.cos(angle)) - 1.0), self._radius * float(np.sin(angle))
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
class Row:
    """Results at one rate: answers per second, median and 99th percentile of the latency, µs."""

    rate_hz: float
    ours: np.ndarray  # (3,): of the compensator, medians over the bouts
    relay: np.ndarray  # (3,): of the relay, medians over the bouts
    ratios: np.ndarray  # (3, 3): ours over relay, quartiles (25, 50, 75 %) over the bouts

    @property
    def name(self) -> str:
        return f"{self.rate_hz:.0f}" if self.rate_hz else "flat out"


@contextmanager
def process(module: str, arguments: str, **options: Any) -> Iterator[subprocess.Popen]:
    """Run a node as a process, with ROS arguments, until the block ends."""
    child = subprocess.Popen([sys.executable, "-m", module, "--ros-args", *arguments.split()], **options)
    try:
        yield child
    finally:
        child.terminate()
        child.wait(20)


def one_round(
    session: RosSession,
    line: Line,
    rate: float,
    seconds: float,
    patience: float = GIVE_UP,
    each_second: Callable[[float], object] = lambda elapsed: None,
) -> list[int]:
    """Send commands to a node for some seconds; return the latencies of the answers, ns."""
    line.sent.clear()
    line.latencies = []
    start = due = time.perf_counter()
    looked = start
    while (now := time.perf_counter()) < start + seconds:
        if now >= looked:
            each_second(now - start)
            looked = now + 1.0
        answered = len(line.latencies)
        line.send()
        if rate == 0.0:  # flat out
            give_up = time.perf_counter() + GIVE_UP
            while len(line.latencies) == answered and time.perf_counter() < give_up:
                session.spin_once(0.01)
            continue
        due = max(due + 1.0 / rate, now)
        while (left := due - time.perf_counter()) > 0.0:
            session.spin_once(left)
    end = time.perf_counter() + patience
    while line.sent and time.perf_counter() < end:
        session.spin_once(0.01)
    return line.latencies


def bout(session: RosSession, lines: dict[str, Line], rate: float, rounds: int, seconds: float) -> list[list[float]]:
    """Run rounds of both nodes in turn; return the figures of the compensator, then those of the relay."""
    latencies: dict[str, list[int]] = {name: [] for name in lines}
    for number in range(rounds):
        for name in sorted(lines, reverse=bool(number % 2)):
            latencies[name] += one_round(session, lines[name], rate, seconds)
    return [
        [len(found) / (rounds * seconds), *(np.percentile(found or [np.nan], [50.0, 99.0]) * 1e-3)]
        for found in (latencies[OURS], latencies[RELAY])
    ]


def measure(bouts: int, rounds: int, seconds: float, floor: bool = False) -> list[Row]:
    """Run all bouts; return a row for each rate. With `floor` the relay does not deserialise messages."""
    with ExitStack() as stack:
        stack.enter_context(PrivateDomain())
        stack.enter_context(process("hexapod_comp.ros.compensator", f"{QUIET}{OURS} {ALONE}"))
        stack.enter_context(process("benchmarks.relay", f"{QUIET}{RELAY} -p serialized:={str(floor).lower()}"))
        session = stack.enter_context(RosSession("bench"))
        lines = {name: Line(session.node, f"/{name}") for name in (OURS, RELAY)}
        session.wait(lambda: all(line.connected for line in lines.values()), START_WITHIN, "both nodes")
        give_up = time.monotonic() + START_WITHIN
        for name, line in lines.items():
            while not one_round(session, line, 250.0, 1.0):
                if time.monotonic() > give_up:
                    raise SystemExit(f"{name} did not answer within {START_WITHIN:g} s")
        found: dict[float, list[list[list[float]]]] = {rate: [] for rate in RATES}
        for _ in range(bouts):
            for rate in RATES:
                found[rate].append(bout(session, lines, rate, rounds, seconds))
    rows = []
    for rate, figures in found.items():
        ours, relay = np.moveaxis(figures, 1, 0)
        ratios = np.nanpercentile(ours / relay, [25.0, 50.0, 75.0], axis=0)
        rows.append(Row(rate, np.nanmedian(ours, axis=0), np.nanmedian(relay, axis=0), ratios))
    return rows


def report(rows: list[Row]) -> str:
    columns = ["rate, Hz"]
    for figure in ("answers/s", "median, µs", "99 %, µs"):
        columns += [f"{figure}: relay", "ours", "ratio"]
    lines = []
    for r in rows:
        low, middle, high = r.ratios
        cells = [f"{middle[0]:.3f}", *(f"{middle[n]:.3f} ({low[n]:.2f}–{high[n]:.2f})" for n in (1, 2))]
        three = zip(r.relay, r.ours, cells, strict=True)
        lines.append([r.name, *(cell for x, y, ratio in three for cell in (f"{x:.0f}", f"{y:.0f}", ratio))])
    return table(columns, lines)


def problems(rows: list[Row]) -> list[str]:
    """Describe the rates at which the compensator misses a target."""
    found = []
    for r in rows:
        rate, median, p99 = r.ratios[1]
        if not (rate >= TARGET_RATE and median <= TARGET_MEDIAN and p99 <= TARGET_P99):
            targets = f"targets {TARGET_RATE}, {TARGET_MEDIAN}, {TARGET_P99}"
            ratios = f"rate {rate:.3f}, median {median:.3f}, 99 % {p99:.3f} ({targets})"
            found.append(f"compensator at {r.name}, ratios to the relay: {ratios}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bouts", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=0.4)
    parser.add_argument("--floor", action="store_true", help="compare with the relay that forwards bytes; no targets")
    args = parser.parse_args()
    rows = measure(args.bouts, args.rounds, args.seconds, args.floor)
    print(report(rows))
    return 0 if args.floor else judged(problems(rows))


if __name__ == "__main__":
    sys.exit(main())
