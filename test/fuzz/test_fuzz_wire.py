"""Bytes of any content over DDS, to a compensator in a process: it lives, in bounded memory, and goes on afterwards.

What the middleware itself refuses never comes to a callback; so here nothing is called by the test. Truth: a process
that lives, its memory as Linux tells it, and a good message that is answered.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from fuzzing import COUNTS, NIGHTLY
from node_helpers import HOME, RELIABLE, SENT, closed_form_lengths
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from hexapod_comp.loop.processes import NodeProcess
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.messages import pose_message

MESSAGES = max(600, NIGHTLY)  # In each of two floods

HUGE = 10_000_000  # Byte; one message in a hundred

# Allowed growth during the second flood, MB: middleware keeps one longest message (10 MB) or two more or fewer,
# and log and diagnostics have their share. Some six of them arrive: a node that kept them would grow by 60 MB.
GROWTH = 35

# No node may ever have more than this, MB, or than it began with and six copies of the longest message: the
# middleware's, rclpy's, the one that is looked at, and others that wait; 55 is the most in 200,000 messages. A
# node begins with some 80.
PEAK, COPIES = 200, 60

TOPICS = ("tool_pose_command", "strut_states", "temperatures", "humidity")
AT_HOME = closed_form_lengths(HOME)
HALVES = (0.0, -0.0, 0.5, 1.0, 1e308, 5e-324, math.nan, -math.inf)


def memory(node: NodeProcess) -> tuple[int, int]:
    """Return what a process has in memory, and the most that it had since its peak was last cleared, MB."""
    lines = Path(f"/proc/{node.pid}/status").read_text(encoding="ascii").splitlines()
    found = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
    return int(found["VmRSS"]) // 1000, int(found["VmHWM"]) // 1000


def message(topic: str, random: np.random.Generator) -> Any:
    """Return a message that is good but for some of its content."""
    made = SENT[topic]()
    made.header.stamp.sec = int(random.choice([0, int(time.time()), -(2**31), 2**31 - 1]))
    made.header.stamp.nanosec = int(random.choice([0, 999_999_999, 2**32 - 1]))
    made.header.frame_id = str(random.choice(["base", "work", "strut_1", "", "é\n\x1b[2J", "x" * 3000]))
    if topic == "tool_pose_command":
        p, q = made.pose.position, made.pose.orientation
        p.x, p.y, p.z, q.x, q.y, q.z, q.w = random.choice([*HALVES, 0.0, 0.0, 0.4], 7).tolist()
    elif topic == "temperatures":
        made.temperature = float(random.choice([*HALVES, 21.0, 119.0]))
    elif topic == "humidity":
        made.relative_humidity = float(random.choice([*HALVES, 0.45, 45.0]))
    else:
        made.name = list(random.permutation([*STRUT_NAMES, "x"])[: random.integers(8)])
        made.position = random.choice([*HALVES, *AT_HOME], random.integers(8)).tolist()
    return made


def garbled(topic: str, random: np.random.Generator) -> bytes:
    """Return a message's bytes: whole, cut off, with others in them, made up, with absurd lengths, or huge."""
    good = message(topic, random)
    way = random.integers(100)
    if way == 0:
        good.header.frame_id = "x" * HUGE
    elif way == 1 and isinstance(good, JointState):
        good.name = ["a"] * (HUGE // 8)
    data = bytearray(serialize_message(good))
    if way < 40:
        return bytes(data)
    if way < 60:
        return bytes(data[: random.integers(len(data))])
    if way < 75:
        return random.bytes(random.integers(400))
    if way < 85:
        place = 4 * random.integers(1, len(data) // 4)
        data[place : place + 4] = random.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\1"])
        return bytes(data)
    for _ in range(random.integers(1, 6)):
        data[random.integers(len(data))] = random.integers(256)
    return bytes(data)


@pytest.fixture
def stranger(ros_context: Any) -> Iterator[Node]:
    node = rclpy.create_node("stranger", context=ros_context, namespace="hostile")
    yield node
    node.destroy_node()


def spin(node: Node, until: Callable[[], object], what: str) -> None:
    """Let a node hear until something has happened."""
    executor, end = rclpy.executors.SingleThreadedExecutor(context=node.context), time.monotonic() + 60.0
    executor.add_node(node)
    try:
        while not until():
            assert time.monotonic() < end, what
            executor.spin_once(timeout_sec=0.02)
    finally:
        executor.shutdown()


def flood(node: NodeProcess, stranger: Node, publishers: dict[str, Any], count: int) -> None:
    """Send garbled messages, waiting for their arrival now and then; stop when the process has died of one."""
    random = np.random.default_rng(count)
    for number in range(count):
        topic = str(random.choice(list(publishers)))
        publishers[topic].publish(garbled(topic, random))
        COUNTS["wire messages"] += 1
        if number % 50 == 0:
            publishers[topic].wait_for_all_acked(Duration(seconds=5.0))
            assert node.exit_code() is None, f"died within 50 messages before the {number}th: {node.output()[-500:]}"
    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=5.0))


@pytest.mark.timeout(60 + MESSAGES)
def test_bytes_of_any_content(stranger: Node) -> None:
    node = NodeProcess("compensator", {"following_error_limit": 0.0}, {"__ns": "/hostile"})
    try:
        publishers = {topic: stranger.create_publisher(SENT[topic], topic, RELIABLE) for topic in TOPICS}
        seen: list[JointState] = []
        stranger.create_subscription(JointState, "strut_commands", seen.append, 10)
        spin(stranger, lambda: all(p.get_subscription_count() for p in publishers.values()), "the node is not there")
        # The first flood fills what middleware and allocator keep for good: what a second one like it adds is a leak.
        flood(node, stranger, publishers, MESSAGES)
        Path(f"/proc/{node.pid}/clear_refs").write_text("5")  # the peak is that of the messages, not of the start
        before, _ = memory(node)
        flood(node, stranger, publishers, MESSAGES)
        seen.clear()
        answers(stranger, publishers, seen)
        after, peak = memory(node)
        assert after <= before + GROWTH
        assert peak <= max(PEAK, before + COPIES)
        COUNTS["wire"] += 1
    finally:
        code, said = node.stop()
    assert code == 0
    assert all(line.isprintable() for line in said.splitlines())


def answers(stranger: Node, publishers: dict[str, Any], seen: list[JointState]) -> None:
    """Reset, readings at home, then a command there, which is answered: also when the struts had been elsewhere."""
    client = stranger.create_client(Trigger, "compensator/reset")
    spin(stranger, client.service_is_ready, "no reset")

    def asked() -> bool:
        struts, pose = JointState(name=list(STRUT_NAMES), position=AT_HOME.tolist()), pose_message(HOME, "base")
        struts.header.stamp = pose.header.stamp = stranger.get_clock().now().to_msg()
        publishers["strut_states"].publish(struts)
        if not seen:
            client.call_async(Trigger.Request())
        publishers["tool_pose_command"].publish(pose)
        return any(np.abs(np.array(message.position) - AT_HOME).max() < 1e-9 for message in seen)

    spin(stranger, asked, "no good command is answered any more")
