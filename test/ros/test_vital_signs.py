"""What a drive, a PLC or a HAL may watch: heartbeat, validity, stop output, deadlines."""

from __future__ import annotations

import time
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from node_helpers import HOME, RELIABLE, Bench, closed_form_lengths, near
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import JointState, TimeReference
from std_msgs.msg import Bool, UInt64

from hexapod_comp.compensation import guards
from hexapod_comp.ros import base
from hexapod_comp.ros.base import LATCHED_QOS
from hexapod_comp.ros.status import ERROR, OK, WARN


@pytest.fixture(autouse=True)
def short_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A refusal colours the status for 0.3 s."""
    monkeypatch.setattr(guards, "SHOWN_FOR", 0.3)


def hear(rig: Bench, kind: type, topic: str, qos: QoSProfile = RELIABLE, **options: Any) -> list[Any]:
    """Return the list to which a topic's messages are appended from now on."""
    heard: list[Any] = []
    rig.witness.create_subscription(kind, topic, heard.append, qos, **options)
    return heard


def test_the_heartbeat_counts_every_beat_as_long_as_the_node_is_configured(rig):
    rig.compensator(heartbeat_rate=200.0)
    beats = hear(rig, UInt64, "compensator/heartbeat")
    rig.until(lambda: len(beats) > 20, "heartbeats")
    assert rig.change("deactivate")
    inactive = len(beats)
    rig.until(lambda: len(beats) > inactive + 20, "heartbeats of an inactive node")
    assert rig.change("cleanup")
    rig.barrier()
    numbers = [beat.data for beat in beats]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    end, ended = time.monotonic() + 0.1, len(beats)
    rig.until(lambda: time.monotonic() > end, "twenty beats' time")
    assert len(beats) == ended


@pytest.mark.parametrize("timeout", [0.1, 2.5])
def test_a_command_is_valid_until_its_stamp_and_the_command_timeout(rig, timeout):
    rig.compensator(command_timeout=timeout)
    validities = hear(rig, TimeReference, "compensator/validity")
    for pose in (HOME, near(HOME, (0.0, 0.0, 0.001))):
        answer = rig.ask(pose)
        stamp = answer.command.header.stamp
        rig.until(lambda stamp=stamp: validities and validities[-1].header.stamp == stamp, "the command's validity")
        lasting = Time.from_msg(validities[-1].time_ref) - Time.from_msg(stamp)
        assert lasting.nanoseconds == timeout * 1e9
        assert validities[-1].source == "/strut_commands"
    stamp = rig.send(near(HOME, (0.0, 0.0, 0.12))).header.stamp
    rig.until_status(ERROR, "refusing commands: step")
    assert validities[-1].header.stamp != stamp  # what is refused prolongs nothing


def test_the_stop_output_is_repeated_for_who_has_missed_what_is_latched(rig):
    rig.compensator()
    stops = hear(rig, Bool, "compensator/stopped", LATCHED_QOS)
    rig.until(lambda: len(stops) >= 3, "the same once more, and again")
    assert {stop.data for stop in stops[1:]} == {stops[-1].data}


def test_the_stop_output_says_when_commands_are_refused(rig):
    node = rig.compensator(start_without_feedback_after=0.0)
    stops = hear(rig, Bool, "compensator/stopped", LATCHED_QOS)

    def until(stopped: bool, why: str) -> None:
        rig.until(lambda: stops and stops[-1].data is stopped, why)

    until(True, "waiting for struts")
    rig.feed(closed_form_lengths(HOME))
    until(False, "the struts are known")
    rig.ask(HOME)
    rig.send(near(HOME, (0.0, 0.0, 0.12)))
    until(True, "a step is refused")
    until(False, "nothing has been refused for a while")
    rig.feed(closed_form_lengths(near(HOME, (0.0, 0.0, 0.01))))
    until(True, "a following error")
    rig.until(lambda: rig.trigger("reset").success, "the machine to stand and the reset")
    until(False, "reset")
    assert rig.change("deactivate")
    until(True, "inactive")
    assert rig.change("activate")
    until(False, "active again")
    node.publish_last_status()
    until(True, "the end")
    assert [stop.data for stop in stops] == [True, False] * (len(stops) // 2) + [True] * (len(stops) % 2)


def deadline(node: Any, topic: str) -> int:
    """Return what a node's publisher offers, ns; 0: nothing."""
    (publisher,) = (p for p in node.publishers if p.topic_name == topic)
    return publisher.qos_profile.deadline.nanoseconds


def test_who_asks_for_the_deadline_is_told_that_commands_end(bench):
    """And the witness, which asks for none, hears them as well."""
    bench.compensator(command_timeout=0.2)
    missed: list[Any] = []
    wants = QoSProfile(depth=10, deadline=Duration(seconds=0.2))
    events = SubscriptionEventCallbacks(deadline=missed.append)
    heard = {
        topic: hear(bench, JointState, topic, wants, event_callbacks=events)
        for topic in ("strut_commands", "strut_corrections")
    }
    bench.until(lambda: all(bench.witness.count_subscribers(topic) == 2 for topic in heard), "discovery")
    bench.ask(HOME)
    bench.until(lambda: all(heard.values()), "commands")
    bench.until(lambda: missed, "a missed deadline")
    bench.until_status(WARN, "no new command")


def test_a_deadline_is_asked_for_where_a_parameter_says_so(bench):
    """Then a controller that offers none is not heard at all; one that does is."""
    name = "qos_overrides./tool_pose_command.subscription.deadline"
    bench.compensator(start=False, **{name: 100_000_000})
    assert bench.change("configure")
    assert bench.change("activate")
    bench.until_status(OK, "waiting for the first command")
    offers = QoSProfile(depth=10, deadline=Duration(seconds=0.1))
    publisher = bench.witness.create_publisher(PoseStamped, "tool_pose_command", offers)
    bench.until(publisher.get_subscription_count, "the one that offers it to match")
    assert bench._publishers["tool_pose_command"].get_subscription_count() == 0
    bench._publishers["tool_pose_command"] = publisher
    bench.ask(HOME)


def test_a_late_subscriber_gets_the_status_of_every_node_when_it_is_discovered(bench, monkeypatch):
    monkeypatch.setattr(base, "STATUS_PERIOD", 1e9)  # nothing is published again only because time passes
    bench.machine()
    arrays = hear(bench, DiagnosticArray, "/diagnostics")
    bench.until(lambda: len({array.status[0].name for array in arrays}) == 2, "the status of drive and compensator")
