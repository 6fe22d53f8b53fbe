"""How many files and calls of Python one pose, and one reading, pass in a node: what a newcomer has to read.

Counted by the interpreter's own profile, in a running node, without DDS: its callbacks are called with bytes.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from node_helpers import HOME, closed_form_lengths
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

import hexapod_comp
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.messages import pose_message, stamp_of
from hexapod_comp.ros.process import autostart

PACKAGE = str(Path(hexapod_comp.__file__).parent)


def way(call: Callable[[], object]) -> tuple[Counter[str], set[str]]:
    """Return the package's functions that a call passes, and their files."""
    calls: Counter[str] = Counter()
    files: set[str] = set()

    def note(frame, event, argument):
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            calls[frame.f_code.co_qualname if hasattr(frame.f_code, "co_qualname") else frame.f_code.co_name] += 1
            files.add(frame.f_code.co_filename.removeprefix(PACKAGE))

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return calls, files


def test_a_pose_and_a_reading_pass_few_files_and_calls(ros_context):
    node = CompensatorNode(context=ros_context)
    assert autostart(node)
    ends = {end.topic_name: end for end in node.subscriptions}
    number = 0

    def deliver(topic: str, message: object) -> Callable[[], object]:
        nonlocal number
        number += 1
        message.header.stamp = stamp_of(node.get_clock().now().nanoseconds)
        arguments = bytes(serialize_message(message)), {"publication_sequence_number": number}
        return lambda: ends[topic].callback(*arguments)

    struts = JointState(name=list(STRUT_NAMES), position=closed_form_lengths(HOME).tolist(), velocity=[0.0] * 6)
    try:
        for topic, message, most_calls, most_files in (
            ("/strut_states", struts, 25, 7),
            ("/tool_pose_command", pose_message(HOME, "base"), 20, 7),
        ):
            number = 0
            for _ in range(3):
                deliver(topic, message)()
            calls, files = way(deliver(topic, message))
            print(topic, sum(calls.values()), len(files), calls, files)
            assert sum(calls.values()) <= most_calls, calls
            assert len(files) <= most_files, files
        assert node._status.commands.count == 4
        assert node._status.feedback.count == 4
    finally:
        node.destroy_node()
