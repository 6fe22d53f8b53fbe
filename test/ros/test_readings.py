"""Whose readings count, and which: struts, temperatures and humidity have one owner, and must be such as can be.

Truth: the shipped geometry's limits (2 mm a command, 250 mm/s, twice that for what is measured), and the arithmetic of
temperatures beside each test.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from node_helpers import HOME, RELIABLE, Rig, Stranger, closed_form_lengths, model_file, near
from sensor_msgs.msg import JointState, Temperature

from hexapod_comp.compensation import guards
from hexapod_comp.compensation.guards import Sample, StampClock, StampGate
from hexapod_comp.errors import CommandError
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.status import ERROR, OK, WARN

AT_HOME = closed_form_lengths(HOME)
SECOND = 1_000_000_000
EXPANDING = {"expansion_ppm_per_K": 12.0}


def heard(rig: Rig, topic: str, count: int) -> None:
    (end,) = [end for end in rig.nodes[0].subscriptions if end.topic_name == topic]
    rig.until(lambda: end.get_publisher_count() == count, "the publishers to be found")


@pytest.fixture(params=["stranger", "witness"])
def other(request: pytest.FixtureRequest, rig: Rig) -> Stranger:
    """Another node: of a name of its own, or of the one that is there already."""
    return Stranger(rig, request.param)


# ---- who measures ----


def test_a_second_publisher_of_measured_struts_stops_the_machine(rig, stranger):
    """Where it stands is in dispute: both are named, nothing of either is used, until one is left."""
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0)
    rig.feed(AT_HOME)
    rig.ask(HOME)
    publisher = stranger.create_publisher(JointState, "/strut_states", RELIABLE)
    values = rig.until_status(ERROR, "refusing commands: several_publishers: several publishers of /strut_states")
    assert rig.status().message.endswith("/strut_states: /stranger, /witness")
    assert values["measured_by"] == "/stranger, /witness"
    rig.send(HOME)
    rig.feed(AT_HOME)
    rig.barrier()
    assert len(rig.seen["strut_commands"]) == len(rig.seen["tool_pose_estimate"]) == 1
    rig.until(lambda: rig.values()["bad_feedback"] == "1", "the count")
    stranger.destroy_publisher(publisher)
    rig.until_status(OK, "running")
    assert rig.values()["measured_by"] == "/witness"
    rig.ask(HOME)


def test_twins_that_both_measure_are_told_apart_by_their_sequence(rig, other, monkeypatch):
    """Of one name, as a killed drive and its successor are: only when both speak does neither count."""
    monkeypatch.setattr(guards, "SPEAKERS_HELD", 0.5)
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0)
    rig.ask(HOME)
    publisher = other.create_publisher(JointState, "/strut_states", RELIABLE)
    heard(rig, "/strut_states", 2)
    same = other.get_name() == "witness"
    struts = JointState(name=list(STRUT_NAMES), position=AT_HOME.tolist())
    for _ in range(3):
        rig.feed(AT_HOME)
        rig.barrier()
        publisher.publish(struts)
        rig.barrier()
    what = "two publishers of /strut_states speak in turn" if same else "several publishers of /strut_states"
    rig.until_status(ERROR, f"refusing commands: several_publishers: {what}")
    if same:
        rig.until_status(OK, "running")


def test_several_may_measure_where_that_is_allowed(rig, stranger):
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0, allow_several_publishers=True)
    publisher = stranger.create_publisher(JointState, "/strut_states", RELIABLE)
    rig.until(lambda: rig.values().get("measured_by") == "/stranger, /witness", "both names")
    heard(rig, "/strut_states", 2)
    rig.until(lambda: publisher.get_subscription_count() >= 1, "the match")
    rig.feed(AT_HOME)
    rig.ask(HOME)
    publisher.publish(JointState(name=list(STRUT_NAMES), position=AT_HOME.tolist()))
    rig.until(lambda: len(rig.seen["tool_pose_estimate"]) == 2, "the stranger's reading")


def test_temperatures_have_an_owner_too_and_a_second_one_does_not_stop_the_machine(rig, stranger, tmp_path):
    """A drift of minutes is no reason to stop a cut: what is known stays in use, and it is said while it lasts."""
    rig.compensator(model_file=model_file(tmp_path, struts=EXPANDING), command_timeout=0.0, ramp_rate=1.0)
    rig.ask(HOME)
    rig.warm("strut_3", 25.0)
    publisher = stranger.create_publisher(Temperature, "/temperatures", RELIABLE)
    wanted = "temperatures ignored: several_publishers: several publishers of /temperatures: /stranger, /witness"
    values = rig.until_status(ERROR, wanted)
    assert values["temperatures_by"] == "/stranger, /witness"
    rig.warm("strut_3", 25.5)
    rig.ask(HOME)
    stranger.destroy_publisher(publisher)
    rig.until_status(OK, "running")
    assert rig.values()["temperature.strut_3_degC"] == "25.00"


def test_several_thermometers_where_that_is_allowed(rig, stranger):
    rig.compensator(command_timeout=0.0, allow_several_thermometers=True)
    publisher = stranger.create_publisher(Temperature, "/temperatures", RELIABLE)
    heard(rig, "/temperatures", 2)
    rig.warm("strut_3", 25.0)
    message = Temperature(temperature=24.0)
    message.header.frame_id = "base"
    rig.until(lambda: publisher.get_subscription_count() == 1, "the match")
    publisher.publish(message)
    rig.until(lambda: rig.values().get("temperature.base_degC") == "24.00", "the stranger's part")
    assert rig.values()["temperature.strut_3_degC"] == "25.00"


# ---- when it was measured ----


def test_a_reading_from_the_future_or_the_past_is_refused_and_shuts_nothing_out(rig):
    """By 0.6 s, with 0.5 s allowed; one that is 0.4 s ahead is taken, and so is the next one that is not."""
    rig.compensator(feedback_timeout=60.0)
    for later, reason in ((0.6, "stamp_future"), (-0.6, "stamp_past")):
        rig.feed(AT_HOME, later=later)
        rig.until_status(ERROR, f"bad feedback: {reason}")
        assert not rig.seen["tool_pose_estimate"]
    for later in (0.4, 0.0):
        rig.estimate(rig.feed(AT_HOME, later=later))
    rig.feed(AT_HOME, later=-0.2)
    rig.until_status(ERROR, "bad feedback: stamp_order")


def test_the_age_of_readings_need_not_matter(rig):
    """A controller whose clock nobody has set."""
    rig.compensator(feedback_timeout=60.0, max_reading_age=0.0)
    rig.estimate(rig.feed(AT_HOME, later=-3e8))


@pytest.mark.parametrize("capped", [True, False])
def test_a_stamp_ahead_counts_as_now_where_it_must_not_shut_out(capped):
    """Of readings, not of commands: there the order matters more."""
    gate = StampGate("reading", StampClock(lambda: 100 * SECOND), 0.5, capped=capped)
    ahead = Sample(1.0, 100 * SECOND + 400_000_000)
    gate.check(ahead)
    gate.accept(ahead)
    if capped:
        gate.check(Sample(1.0, 100 * SECOND))
        with pytest.raises(CommandError, match="ms earlier than the one before"):
            gate.check(Sample(1.0, 100 * SECOND - 1))
    else:
        with pytest.raises(CommandError, match="ms earlier than the one before"):
            gate.check(Sample(1.0, 100 * SECOND))


# ---- what was measured ----


def test_a_reading_that_cannot_be_is_neither_used_nor_a_start(rig):
    """300 mm away within a moment: the next start goes on from where the struts stand."""
    rig.compensator(feedback_timeout=60.0)
    rig.estimate(rig.feed(AT_HOME))
    rig.feed(closed_form_lengths(near(HOME, (0.0, 0.0, 0.2))))
    assert "has jumped by" in rig.until_status(ERROR, "bad feedback: jump")["last_bad_feedback"]
    assert len(rig.seen["tool_pose_estimate"]) == 1
    np.testing.assert_array_equal(rig.ask(HOME).lengths, AT_HOME)


def test_a_reading_that_cannot_be_stops_the_machine_all_the_same(rig):
    """Either the strut is broken or its encoder."""
    rig.compensator(feedback_timeout=60.0, command_timeout=0.0)
    rig.estimate(rig.feed(AT_HOME))
    rig.ask(HOME)
    rig.feed(AT_HOME + 0.2 * (np.arange(6) == 2))
    rig.until_status(ERROR, "refusing commands: following_error: strut_3")
    assert "jump" in rig.status().message


# ---- temperatures ----


def refused(rig: Rig, part: str, temperature: float, text: str) -> None:
    rig.warm(part, temperature)
    values = rig.until_status(ERROR, "bad feedback: temperature")
    assert text in values["last_bad_feedback"]


def test_one_wild_temperature_moves_nothing(rig, tmp_path):
    """119 °C among readings of 21 °C: steel of 0.5 m would move by 0.58 mm, at once with this ramp."""
    rig.compensator(
        model_file=model_file(tmp_path, struts=EXPANDING),
        command_timeout=0.0,
        ramp_rate=1.0,
        temperature_time_constant_s=0.0,
    )
    for part in STRUT_NAMES:
        rig.warm(part, 21.0)
    before = rig.settle(HOME)
    refused(rig, "strut_2", 119.0, "temperature of strut_2: has jumped from 21.00 to 119.00 °C in")
    np.testing.assert_array_equal(rig.ask(HOME).lengths, before.lengths)
    rig.warm("strut_2", 21.5)
    assert rig.ask(HOME).lengths[1] < before.lengths[1], "it was not shut out"


def test_the_first_temperature_of_all_must_be_one_of_a_shop(rig):
    rig.compensator(command_timeout=0.0)
    refused(rig, "strut_2", 119.0, "99.0 K from 20 °C, and no other part is known; allowed 40 K")


@pytest.mark.parametrize("settings", [{"temperature_rate_limit": 0.0}, {"temperature_spread_limit": 0.0}])
def test_each_rule_may_be_switched_off(rig, settings):
    rig.compensator(command_timeout=0.0, **settings)
    for part in STRUT_NAMES:
        rig.warm(part, 21.0)
    text = "the other parts' 21.00 °C" if "temperature_rate_limit" in settings else "has jumped"
    refused(rig, "strut_2", 119.0, text)


def test_a_thermometer_that_falls_silent_is_said_and_its_last_word_stays(rig):
    rig.compensator(command_timeout=0.0, temperature_timeout=0.3)
    rig.ask(HOME)
    for part in ("strut_3", "base"):
        rig.warm(part, 24.0)
    values: dict[str, Any] = rig.until_status(WARN, "temperatures stale: strut_3, base")
    assert values["stale_temperatures"] == "strut_3, base"
    assert values["temperature.base_degC"] == "24.00"


# ---- humidity ----


def test_struts_that_swell_follow_the_humidity(rig, tmp_path):
    """From 50 to 60 % a strut of 2 ppm per % grows by 20 ppm: its command is L/(1 + 20e-6). Rounding: 1e-15 m."""
    rig.compensator(
        model_file=model_file(tmp_path, struts={"moisture_ppm_per_percent": 2.0}), command_timeout=0.0, ramp_rate=1.0
    )
    dry = rig.ask(HOME)
    assert not dry.corrections.any()
    unknown = "not known, taken as 50"
    rig.until(lambda: rig.values().get("humidity_percent") == unknown, "that nobody tells the humidity")
    rig.publish_humidity(0.6)
    rig.settle(HOME)
    np.testing.assert_allclose(rig.ask(HOME).lengths, dry.lengths / (1.0 + 20e-6), rtol=0.0, atol=1e-15)
    rig.until(lambda: rig.values().get("humidity_percent") == "60.0", "the humidity")
    assert rig.values()["humidity_by"] == "/witness"


@pytest.mark.parametrize("wrong", [45.0, 0.0045, math.nan], ids=["percent", "twice a fraction", "NaN"])
def test_a_humidity_that_cannot_be_is_refused(rig, wrong):
    rig.compensator(command_timeout=0.0)
    rig.publish_humidity(wrong)
    values = rig.until_status(ERROR, "bad feedback: humidity")
    assert "humidity: must lie within 0.01…1, as a fraction" in values["last_bad_feedback"]
    assert "humidity_percent" not in values


def test_a_temperature_called_humidity_is_refused(rig):
    rig.compensator(command_timeout=0.0)
    rig.warm("humidity", 0.5)
    values = rig.until_status(ERROR, "bad feedback: temperature")
    assert "must be of one of strut_1" in values["last_bad_feedback"]


def test_a_hygrometer_that_jumps_is_refused_and_one_that_falls_silent_is_said(rig):
    rig.compensator(command_timeout=0.0, temperature_timeout=0.3)
    rig.ask(HOME)
    rig.publish_humidity(0.4)
    rig.publish_humidity(0.9)
    assert (
        "humidity: has jumped from 0.40 to 0.90"
        in rig.until_status(ERROR, "bad feedback: humidity")["last_bad_feedback"]
    )
    assert rig.until_status(WARN, "humidity stale")["humidity_percent"] == "40.0"
