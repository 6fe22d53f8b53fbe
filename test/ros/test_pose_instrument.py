"""A pose instrument on the machine: what it may say, what its readings do, and that nothing steps.

Truth: the tool is measured where this file says, on a machine whose nominal struts come from plane geometry.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from node_helpers import HOME, RELIABLE, Rig, closed_form_lengths, model_file
from std_srvs.srv import Trigger

from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import pose_message
from hexapod_comp.ros.status import OK, WARN

AT_HOME = closed_form_lengths(HOME)
TOPIC = "tool_pose_measured"


def instrument(rig: Rig, kind: type = PoseWithCovarianceStamped) -> SimpleNamespace:
    """Return what measures the tool: ``say`` a shift from home, m, and what else differs."""
    voice = rig.witness.create_publisher(kind, TOPIC, RELIABLE)

    def say(shift: float = 0.0, frame_id: str = "base", late: float = 0.0, **changes: object) -> None:
        now = rig.ros_clock.now().nanoseconds
        pose = pose_message(Pose(HOME.position + np.array([0.0, 0.0, shift]), np.eye(3)), frame_id)
        pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(now - round(late * 1e9), 10**9)
        pose.pose.orientation.w = float(changes.get("w", 1.0))
        pose.pose.position.x += float(changes.get("x", 0.0))
        message = pose
        if kind is PoseWithCovarianceStamped:
            message = PoseWithCovarianceStamped(header=pose.header)
            message.pose.pose = pose.pose
            message.pose.covariance[0] = float(changes.get("variance", 0.0))
        voice.publish(message)

    return SimpleNamespace(say=say, voice=voice)


def started(rig: Rig, tmp_path, **parameters: object) -> None:
    """Start a compensator of an ideal machine that stands at home, measured with each command."""
    defaults = {"fusion.enabled": True, "fusion.initial_deviation": 2e-5, "fusion.timeout": 2.0}
    rig.compensator(
        model_file=model_file(tmp_path), command_timeout=0.0, feedback_timeout=60.0, **{**defaults, **parameters}
    )
    rig.feed(AT_HOME)
    rig.ask(HOME)


def measured(rig: Rig, say, count: int, shift: float = 0.0, **changes: object) -> None:
    """Measure the tool so often, between readings of the struts, while the same command is repeated."""
    for _ in range(count):
        rig.feed(AT_HOME)
        rig.step(0.02)
        say(shift, **changes)
        rig.step(0.02)
        rig.feed(AT_HOME)
        rig.ask(HOME)


def off(rig: Rig) -> float:
    """Return how much higher the newest estimate has the tool than home, m."""
    return rig.seen["tool_pose_estimate"][-1].pose.position.z - HOME.position[2]


@pytest.mark.parametrize("kind", [PoseWithCovarianceStamped, PoseStamped])
def test_the_estimate_weighs_struts_and_instrument(rig, tmp_path, kind):
    message = "pose" if kind is PoseStamped else "pose_with_covariance"
    started(rig, tmp_path, **{"fusion.message": message})
    before = rig.seen["strut_commands"][-1].position
    measured(rig, instrument(rig, kind).say, 40, 1e-5)
    assert off(rig) == pytest.approx(1e-5, abs=1e-6)
    np.testing.assert_allclose(rig.seen["strut_commands"][-1].position, before, atol=1e-12)  # it is only estimated
    rig.step(1.1)
    values = rig.values()
    assert (values["fusion"], values["measured_poses"], values["rejected_poses"]) == ("estimating", "40", "0")


def test_the_compensation_follows_without_a_step_and_a_reset_takes_it_back(rig, tmp_path):
    """A tool that is measured 20 µm too high is lowered; no strut is faster than the ramp, 0.1 mm/s, on its way."""
    started(rig, tmp_path, **{"fusion.compensate": True, "ramp_rate": 1e-4})
    say, height = instrument(rig).say, 2e-5
    rows = []
    for _ in range(60):
        measured(rig, say, 1, height + float(np.mean(rig.seen["strut_corrections"][-1].position)))
        rows.append(rig.seen["strut_corrections"][-1].position.tolist())
    assert max(rows[-1]) < -5e-6
    assert np.abs(np.diff(rows, axis=0)).max() <= 1e-4 * 0.02 + 1e-12
    assert rig.values()["fusion"] == "compensating"
    rig.step(0.3)
    assert rig.call(Trigger, "compensator/reset").success
    for _ in range(60):
        rig.step(0.02)
        rig.ask(HOME)
    np.testing.assert_allclose(rig.seen["strut_corrections"][-1].position, 0.0, atol=1e-12)
    rig.step(1.1)
    assert rig.values()["drift_um"] == "0.00, 0.00, 0.00"


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("frame_id", {"frame_id": "nowhere"}),
        ("stamp_past", {"late": 5.0}),
        ("bad_pose", {"x": math.nan}),
        ("covariance", {"variance": -1.0}),
        ("wild_pose", {"x": 1e-3}),
    ],
)
def test_what_is_no_reading_moves_nothing_and_is_named(rig, tmp_path, reason, changes):
    started(rig, tmp_path, **{"fusion.compensate": True})
    say = instrument(rig).say
    measured(rig, say, 20)
    before, estimate = rig.seen["strut_commands"][-1].position, off(rig)
    measured(rig, say, 1, **changes)
    rig.until_status(WARN, f"measured poses rejected: {reason}")
    assert rig.values()["rejected_poses"] == "1"
    measured(rig, say, 1)
    assert off(rig) == pytest.approx(estimate, abs=1e-7)
    np.testing.assert_allclose(rig.seen["strut_commands"][-1].position, before, atol=1e-7)
    rig.until_status(OK, "running")


def test_a_drift_beyond_the_limit_is_held_and_an_instrument_that_falls_silent_is_said(rig, tmp_path):
    started(rig, tmp_path, **{"fusion.limit": 5e-6})
    say = instrument(rig).say
    measured(rig, say, 30, 3e-5)
    rig.until_status(WARN, "the drift would be")
    assert abs(off(rig)) < 1e-5
    measured(rig, say, 3, off(rig))
    rig.until_status(WARN, "no measured pose counts")


def test_an_overtaken_reading_and_a_second_instrument_stop_nothing(rig, tmp_path, stranger):
    started(rig, tmp_path)
    say = instrument(rig).say
    measured(rig, say, 3)
    say()
    say(late=0.1)
    rig.until_status(WARN, "measured poses rejected: stamp_order")
    stranger.create_publisher(PoseWithCovarianceStamped, TOPIC, RELIABLE)
    rig.until(lambda: "tool_pose_measured ignored: several_publishers" in rig.status().message, "both named")
    rig.ask(HOME)


def test_a_machine_without_feedback_is_measured_beside_its_commands(rig, tmp_path):
    rig.compensator(
        model_file=model_file(tmp_path), command_timeout=0.0,
        **{"fusion.enabled": True, "fusion.initial_deviation": 2e-5},
    )  # fmt: skip
    say = instrument(rig).say
    rig.ask(HOME)
    for _ in range(40):
        rig.step(0.05)
        say(1e-5)
        rig.ask(HOME)
    rig.step(0.1)
    assert off(rig) == pytest.approx(1e-5, abs=1e-6)
