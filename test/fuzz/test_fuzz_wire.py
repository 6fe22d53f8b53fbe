"""Arbitrary bytes over DDS to a compensator in a process: it keeps running, with bounded memory, and answers
afterwards.

The middleware itself refuses some of these bytes, so they must come over DDS. Checked are the process, its memory as
Linux reports it, and the answer to a valid message.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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

MESSAGES = max(400, NIGHTLY)
HUGE = 10_000_000  # bytes; one message in a hundred has this size

# Allowed growth of the memory, MB: five copies of the longest message, kept by the allocator (50 MB), plus a margin.
# About ten such messages arrive: a node that kept them would grow by 100 MB.
GROWTH = 75
# Allowed growth at the peak: on a busy computer some ten copies wait in the middleware (98 MB measured), plus a margin
PEAK = 200

TOPICS = ("tool_pose_command", "strut_states", "temperatures", "humidity")
AT_HOME = closed_form_lengths(HOME)
HALVES = (0.0, -0.0, 0.5, 1.0, 1e308, 5e-324, math.nan, -math.inf)


def memory(node: NodeProcess, what: str) -> float:
    """Return the memory of a process, MB: the present (VmRSS) or the peak (VmHWM)."""
    status = Path(f"/proc/{node.pid}/status").read_text(encoding="ascii")
    return int(re.findall(rf"{what}:\s+(\d+) kB", status)[0]) / 1000


def message(topic: str, random: np.random.Generator) -> Any:
    """Return a message in which some values are unusual or invalid."""
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
    """Return a message's bytes: complete, huge, cut off, random, with absurd lengths, or with changed bytes."""
    good, way = message(topic, random), random.integers(100)
    if way == 0:
        good.header.frame_id = "x" * HUGE
    data = bytearray(serialize_message(good))
    if 40 <= way < 60:
        data = data[: random.integers(len(data))]
    elif 60 <= way < 75:
        data = bytearray(random.bytes(random.integers(400)))
    elif 75 <= way < 85:
        place = 4 * random.integers(1, len(data) // 4)
        data[place : place + 4] = random.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\1"])
    elif way >= 85:
        for _ in range(random.integers(1, 6)):
            data[random.integers(len(data))] = random.integers(256)
    return bytes(data)


@pytest.fixture
def stranger(hexapod_context: Any) -> Iterator[Node]:
    node = rclpy.create_node("stranger", context=hexapod_context, namespace="hostile")
    yield node
    node.destroy_node()


def spin(node: Node, until: Callable[[], object], what: str) -> None:
    """Spin a node until a condition holds."""
    executor, end = rclpy.executors.SingleThreadedExecutor(context=node.context), time.monotonic() + 60.0
    executor.add_node(node)
    try:
        while not until():
            assert time.monotonic() < end, what
            executor.spin_once(timeout_sec=0.02)
    finally:
        executor.shutdown()


@pytest.mark.timeout(60 + MESSAGES)
def test_bytes_of_any_content(stranger: Node) -> None:
    node = NodeProcess("compensator", {"following_error_limit": 0.0}, {"__ns": "/hostile"})
    random = np.random.default_rng(1)
    try:
        publishers = {topic: stranger.create_publisher(SENT[topic], topic, RELIABLE) for topic in TOPICS}
        seen: list[JointState] = []
        stranger.create_subscription(JointState, "strut_commands", seen.append, 10)
        spin(stranger, lambda: all(p.get_subscription_count() for p in publishers.values()), "the node is not there")
        Path(f"/proc/{node.pid}/clear_refs").write_text("5")  # the peak must be of the messages, not of the start
        before = memory(node, "VmRSS")
        for number in range(MESSAGES):
            topic = str(random.choice(TOPICS))
            publishers[topic].publish(garbled(topic, random))
            COUNTS["wire messages"] += 1
            if number % 50 == 0:  # otherwise the publisher's queue would drop messages
                publishers[topic].wait_for_all_acked(Duration(seconds=5.0))
                assert node.exit_code() is None, (
                    f"died within 50 messages before the {number}th: {node.output()[-500:]}"
                )
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=5.0))
        seen.clear()
        answers(stranger, publishers, seen)
        assert memory(node, "VmRSS") < before + GROWTH
        assert memory(node, "VmHWM") < before + PEAK
        COUNTS["wire"] += 1
    finally:
        code, said = node.stop()
    assert code == 0
    assert all(line.isprintable() for line in said.splitlines())


def answers(stranger: Node, publishers: dict[str, Any], seen: list[JointState]) -> None:
    """Check that after a reset, with readings at home, the node answers a command at home."""
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
