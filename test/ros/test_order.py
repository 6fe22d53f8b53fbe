"""Messages that must not be obeyed although each by itself is good: overtaken ones, and steps that nobody sends."""

from __future__ import annotations

import numpy as np
import pytest
from node_helpers import HOME, Bench, closed_form_lengths, near
from rclpy.duration import Duration
from rclpy.time import Time
from sensor_msgs.msg import JointState

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.status import ERROR, WARN, LogSpace


def strut_message(rig: Bench, lengths: np.ndarray, before: JointState | None = None) -> JointState:
    """Return a message stamped now, or 50 ms before another: however long that took, it has been overtaken."""
    message = JointState(name=list(STRUT_NAMES), position=lengths.tolist(), velocity=[0.0] * 6)
    message.header.stamp = rig.now()
    if before is not None:
        message.header.stamp = (Time.from_msg(before.header.stamp) - Duration(seconds=0.05)).to_msg()
    return message


def test_the_drive_refuses_overtaken_commands_and_steps(rig):
    """Its parameter rate is low, so that nothing else happens; what it obeys last stays in force."""
    rig.drive(rate=50.0)
    good = closed_form_lengths(HOME)
    first = strut_message(rig, good)
    rig.publish("strut_commands", first)  # both wait in the node's queue, so it reads them without a pause
    rig.publish("strut_commands", strut_message(rig, good + 1e-4, first))
    rig.until_status(ERROR, "refusing commands: stamp_order", "strut_drive")
    rig.publish("strut_commands", strut_message(rig, np.where(np.arange(6) == 1, 1e30, good)))
    rig.until_status(ERROR, "refusing commands: step", "strut_drive")
    drive = rig.nodes[0].drive
    np.testing.assert_array_equal(drive.commands, good)


def test_the_compensator_does_not_use_overtaken_readings(rig):
    rig.compensator()
    lengths = closed_form_lengths(HOME)
    first = rig.feed(lengths)
    rig.barrier()
    rig.publish("strut_states", strut_message(rig, closed_form_lengths(near(HOME, (1e-3, 0.0, 0.0))), first))
    rig.until_status(ERROR, "bad feedback: stamp_order")
    assert len(rig.seen["tool_pose_estimate"]) == 1


def test_a_strut_that_is_away_for_one_reading_is_said(rig):
    """One reading 3 mm off among good ones, between two looks of the diagnostics: the limit is 2 mm."""
    rig.compensator()
    answer = rig.ask(HOME)
    for n, off in enumerate((0.0, 3e-3, 0.0)):  # 30 ms apart: a strut may move by 17 mm
        rig.feed(answer.lengths + off * (np.arange(6) == 3), later=0.03 * n)
        rig.barrier()
    rig.until_status(ERROR, "refusing commands: following_error: strut_4")
    assert "bad feedback: following_error" in rig.status().message  # behind it, on a busy computer, what is late
    assert "strut_4" in rig.values()["last_bad_feedback"]


@pytest.mark.parametrize("node", ["compensator", "strut_drive"])
def test_a_full_log_disk_is_said_beside_everything_else(rig, monkeypatch, node):
    monkeypatch.setattr(LogSpace, "check", lambda space: setattr(space, "problem", "log disk full: /var/log"))
    made = rig.compensator() if node == "compensator" else rig.drive()
    rig.until(lambda: rig.status(node), "a status")
    assert rig.status(made.get_name()).message.endswith("log disk full: /var/log")
    assert rig.status(node).level == WARN
