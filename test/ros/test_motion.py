"""The struts' speed limits and the nodes' clocks; the outputs that a drive, a PLC or a HAL may watch.

The rig's machine moves its struts at up to 250 mm/s, and by up to 2 mm per command. At home a strut lengthens by less
than the tool rises; closed-form lengths give the amount.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from node_helpers import HOME, Bench, closed_form_lengths, near
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import JointState, TimeReference
from std_msgs.msg import Bool, UInt64
from std_srvs.srv import SetBool, Trigger

from hexapod_comp.ros import base
from hexapod_comp.ros.base import ERROR, LATCHED_QOS, WARN
from hexapod_comp.ros.messages import pose_message
from hexapod_comp.ros.rclpy_compat import Alarm

SPEED = 0.25  # largest strut speed of the rig's machine, m/s


def risen(rig: Bench, millimetres: float, seconds: float | None = None):
    """Return the command of a tool raised from home, stamped some seconds from now or without a stamp."""
    message = pose_message(near(HOME, (0.0, 0.0, millimetres * 1e-3)), "base")
    if seconds is not None:
        message.header.stamp = rig.stamp(seconds)
    return message


def way(low: float, high: float) -> float:
    """Return how far the struts move between two heights of the tool above home, mm, in m."""
    ends = (closed_form_lengths(near(HOME, (0.0, 0.0, rise * 1e-3))) for rise in (low, high))
    return float(np.abs(next(ends) - next(ends)).max())


def lengths(rig: Bench) -> np.ndarray:
    """Return all strut commands so far, m."""
    return np.array([message.position for message in rig.seen["strut_commands"]])


# ---- speed ----


def test_commands_that_are_too_fast_by_their_stamps_are_refused(rig):
    """Commands of 1.5 mm with one stamp: 5 ms at 250 mm/s are allowed for jitter, so one such step passes."""
    rig.compensator()
    first = risen(rig, 0.0, 0.0)
    rig.ask(first)
    for n in range(1, 4):
        message = risen(rig, 1.5 * n)
        message.header.stamp.sec = first.header.stamp.sec
        message.header.stamp.nanosec = first.header.stamp.nanosec
        rig.send(message)
    rig.until(lambda: rig.values().get("refused") == "2", "two refusals")
    values = rig.values()
    assert values["refused.speed"] == "1", "the second; the third is a step further still"
    assert values["refused.step"] == "1"
    assert len(lengths(rig)) == 2
    rig.ask(risen(rig, 1.6, 0.02))


def test_the_velocity_of_a_command_is_none_above_the_limit(rig):
    """1 mm within 1 µs, allowed as jitter, must not give a velocity of 1 km/s."""
    rig.compensator()
    stamp = rig.ask(risen(rig, 0.0, 0.0)).command.header.stamp
    message = risen(rig, 1.0, 0.0)
    message.header.stamp.sec, message.header.stamp.nanosec = stamp.sec, stamp.nanosec + 1000
    velocity = np.array(rig.ask(message).command.velocity)
    assert 0.99 * SPEED < np.abs(velocity).max() <= SPEED * (1.0 + 1e-9)


def burst(rig: Bench, count: int, stamped: bool = True, stride: float = 0.5) -> float:
    """Send commands `stride` mm apart at once, stamped 4 ms apart; return the struts' motion, m."""
    rig.ask(risen(rig, 0.0, -0.4))
    for n in range(1, count + 1):
        rig.send(risen(rig, stride * n, -0.4 + 4e-3 * n if stamped else None))
    return way(0.0, stride * count)


@pytest.mark.parametrize("stamped", [True, False])
def test_a_burst_is_followed_in_order_no_faster_than_the_struts_may_move(rig, stamped):
    """Twenty commands that were delayed by 80 ms, or have no stamps, arrive at once: all are sent, in order."""
    rig.compensator(catch_up_within=5.0, max_command_age=0.0)
    began = time.monotonic()
    told = burst(rig, 20, stamped)
    rig.until(lambda: len(lengths(rig)) == 21, "all of them")
    took = time.monotonic() - began
    assert told > 7.5e-3, "thirty milliseconds and more"
    assert took > told / SPEED - 1e-3, f"{told * 1e3:.2f} mm in {took * 1e3:.1f} ms"
    heights = lengths(rig).mean(axis=1)
    assert (np.diff(heights) > 0.0).all(), "in their order"
    rig.until(lambda: int(rig.values().get("commands_waited", 0)) > 10, "that it is counted")
    assert rig.values()["refused"] == "0"


def test_a_burst_that_would_be_followed_too_late_ends(rig):
    """Ninety commands need 0.29 s at the largest speed, and 0.02 s are allowed: the others are refused, and the struts
    stop.

    A busy computer may take 0.25 s to receive the ninety, so fewer may be refused.
    """
    rig.compensator(catch_up_within=0.02, max_command_age=0.0)
    way_told = burst(rig, 90, stride=1.0)
    assert way_told / SPEED > 0.28
    rig.until(lambda: "refused.speed" in rig.values(), "a refusal")
    assert "commands arrive faster than the struts may move" in rig.values()["last_refusal"]
    rig.until(lambda: int(rig.values()["commands"]) + int(rig.values()["refused"]) == 91, "an end")
    answered = len(lengths(rig))
    assert 0 < answered < 80
    last = 1.0 * (answered - 1)
    rig.send(risen(rig, 95.0, 0.0))
    rig.until(lambda: "refused.step" in rig.values(), "that it is far away")
    rig.ask(risen(rig, last + 0.5, 0.0))


def test_a_node_that_stood_still_blames_no_commands(rig):
    """Twenty commands need 32 ms and may wait for 1 s, but nothing runs in the node for 1.5 s, as on a busy computer:
    they are late, but not too fast, so none is refused.
    """
    node = rig.compensator(catch_up_within=1.0, max_command_age=0.0)
    burst(rig, 20)
    rig.until(lambda: node.waited, "that one waits")
    time.sleep(1.5)
    rig.until(lambda: rig.values().get("commands") == "21", "all of them")
    assert rig.values()["refused"] == "0"


def test_where_a_parameter_says_so_only_the_newest_of_a_burst_waits(rig):
    """The first command is sent; the newest, 10 mm away, is refused as a step; the others are dropped."""
    rig.compensator(catch_up_within=0.0, command_timeout=0.0, max_command_age=0.0)
    burst(rig, 20)
    rig.until_status(ERROR, "refusing commands: step")
    counters = ("commands_dropped", "commands", "refused")
    rig.until(lambda: sum(int(rig.values()[name]) for name in counters) == 21, "all of them in a status")
    assert int(rig.values()["commands_dropped"]) >= 10
    late = "catching up with commands that came late"
    rig.until(lambda: any(late in status.message for status in rig.statuses()), "that it is said")


# ---- callers of services ----


def test_who_asked_is_logged(bench):
    """rclpy does not report the caller, so the log names all nodes with a client of the service."""
    bench.compensator()
    other = rclpy.create_node("operator", context=bench.context)
    client = other.create_client(SetBool, "compensator/enable_compensation")
    bench.until(client.service_is_ready, "the other's client")
    bench.enable(True)
    bench.until(lambda: bench.logged("asked for by /operator or /witness"), "the log")
    other.destroy_node()


def test_each_of_two_services_called_within_a_second_is_logged(rig):
    rig.compensator()
    rig.call(Trigger, "compensator/reset")
    rig.call(SetBool, "compensator/enable_compensation", SetBool.Request(data=True))
    assert rig.logged("reset: asked for by ")
    assert rig.logged("enable_compensation: asked for by ")


# ---- clocks ----


def test_a_change_ramps_out_without_stamps_while_simulated_time_stands(rig):
    rig.compensator(use_sim_time=True, command_timeout=0.0, ramp_rate=5e-3)
    seen = rig.seen["strut_corrections"]
    rig.send(risen(rig, 0.0))
    rig.until(lambda: seen, "an answer")
    assert np.abs(seen[0].position).max() > 1e-4
    assert rig.enable(False).success
    began = time.monotonic()
    while np.abs(seen[-1].position).max() > 0.0:
        count = len(seen)
        rig.send(risen(rig, 0.0))
        rig.until(lambda count=count: len(seen) > count, "an answer")
        assert time.monotonic() < began + 10.0
    assert len(seen) > 2, "it has ramped"


# ---- heartbeat, validity, stop output and deadlines, for a drive, a PLC or a HAL ----


def test_the_heartbeat_counts_every_beat_as_long_as_the_node_is_configured(rig):
    rig.compensator(heartbeat_rate=200.0)
    beats = rig.listen(UInt64, "compensator/heartbeat")
    rig.until(lambda: len(beats) > 20, "heartbeats")
    before = len(beats)
    rig.step(1.0)
    assert len(beats) - before == pytest.approx(200, abs=2), "in step, though each waits for the clock's next 2 ms"
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


def test_a_command_is_valid_until_its_stamp_and_the_command_timeout(rig):
    rig.compensator(command_timeout=2.5)
    validities = rig.listen(TimeReference, "compensator/validity")
    for pose in (HOME, near(HOME, (0.0, 0.0, 0.001))):
        answer = rig.ask(pose)
        stamp = answer.command.header.stamp
        rig.until(lambda stamp=stamp: validities and validities[-1].header.stamp == stamp, "the command's validity")
        lasting = Time.from_msg(validities[-1].time_ref) - Time.from_msg(stamp)
        assert lasting.nanoseconds == 2.5e9
        assert validities[-1].source == "/strut_commands"
    stamp = rig.send(near(HOME, (0.0, 0.0, 0.12))).header.stamp
    rig.until_status(ERROR, "refusing commands: step")
    assert validities[-1].header.stamp != stamp  # a refused command prolongs nothing


def test_no_validity_is_later_than_the_last_time_that_a_message_can_hold(rig):
    rig.compensator(command_timeout=5.0, max_command_age=0.0)
    validities = rig.listen(TimeReference, "compensator/validity")
    message = pose_message(HOME, "base")
    message.header.stamp.sec = 2**31 - 2
    rig.ask(message)
    rig.until(lambda: validities, "the validity")
    assert Time.from_msg(validities[-1].time_ref).nanoseconds == 2**31 * 10**9 - 1


def test_the_stop_output_is_repeated_for_who_has_missed_what_is_latched(rig):
    rig.compensator()
    stops = rig.listen(Bool, "compensator/stopped", LATCHED_QOS)
    rig.step(0.5)
    count = len(stops)
    rig.step(3.1)
    assert [stop.data for stop in stops[count - 1 :]] == [False] * 4, "once a second"


def test_the_stop_output_says_when_commands_are_refused(rig):
    node = rig.compensator(start_without_feedback_after=0.0)
    stops = rig.listen(Bool, "compensator/stopped", LATCHED_QOS)

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


def test_who_asks_for_the_deadline_is_told_that_commands_end(bench):
    bench.compensator(command_timeout=0.2)
    missed: list[Any] = []
    wants = QoSProfile(depth=10, deadline=Duration(seconds=0.2))
    events = SubscriptionEventCallbacks(deadline=missed.append)
    heard = {
        topic: bench.listen(JointState, topic, wants, event_callbacks=events)
        for topic in ("strut_commands", "strut_corrections")
    }
    bench.until(lambda: all(bench.witness.count_subscribers(topic) == 2 for topic in heard), "discovery")
    bench.ask(HOME)
    bench.until(lambda: all(heard.values()), "commands")
    bench.until(lambda: missed, "a missed deadline")
    bench.until_status(WARN, "no new command")


def test_a_late_subscriber_gets_the_status_of_every_node_when_it_is_discovered(bench, monkeypatch):
    monkeypatch.setattr(base, "STATUS_PERIOD", 1e9)  # nothing is published again because time has passed
    bench.machine()
    arrays = bench.listen(DiagnosticArray, "/diagnostics")
    bench.until(lambda: len({array.status[0].name for array in arrays}) == 2, "the status of drive and compensator")


def test_a_flood_of_rates_moves_neither_ticks_nor_timers(bench):
    """With timers reset at each change, 500 changes a second left 3 heartbeats a second, with gaps of 4 s."""
    node = bench.host(rclpy.create_node("ticking", context=bench.context))
    ticks, checks = [], []
    ticker = Alarm(node, lambda: ticks.append(time.monotonic()))
    ticker.set_rate(100.0)
    node.create_timer(0.05, lambda: checks.append(time.monotonic()))
    began, rates = time.monotonic(), iter(np.random.default_rng(1).uniform(90.0, 110.0, 10_000))
    while time.monotonic() < began + 0.5:
        ticker.set_rate(next(rates))
        bench.executor.spin_once(timeout_sec=0.002)
    ticker.close()
    assert 35 <= len(ticks) <= 58, "90 to 110 Hz for half a second, on a busy computer"
    assert np.diff([began, *ticks, time.monotonic()]).max() < 0.1
    assert len(checks) >= 6
