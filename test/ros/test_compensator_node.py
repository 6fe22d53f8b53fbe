"""The compensator node: every sentence of its contract, seen from outside, without DDS but where that is the matter.

Lengths are compared with a closed form of the paper's machine or with the paper's tables, never with what
the package computes, except where a test says that the node must send exactly what the core computes.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import PoseStamped
from helpers import table_lengths, table_poses
from lifecycle_msgs.srv import GetState
from node_helpers import (
    AT_ONCE,
    CONFIG,
    HOME,
    SENT,
    Answer,
    Bench,
    closed_form_lengths,
    geometry_file,
    model_file,
    near,
)
from rcl_interfaces.srv import DescribeParameters
from rclpy.qos import HistoryPolicy, ReliabilityPolicy

from hexapod_comp.compensation import guards
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.pose import Pose
from hexapod_comp.ros import compensator as compensator_module
from hexapod_comp.ros import keep_discovery_local, rclpy_compat
from hexapod_comp.ros import status as status_module
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.messages import message_pose, pose_message
from hexapod_comp.ros.parameters import ParameterError
from hexapod_comp.ros.rclpy_compat import Throttle
from hexapod_comp.ros.status import ERROR, OK, WARN, Flow, HealthReport, Refusals
from hexapod_comp.ros.strut_drive import StrutDriveNode

STEP_BACK = (0.0002, 0.0001, -0.0003)
"""A small move, m, that no limit forbids."""

TILTED = near(HOME, tilt_deg=20.0)

CROSSED = Pose.from_angles([0.01, -0.02, 0.42], np.deg2rad([3.0, -2.0, 60.0]))
"""Turned about z, where the struts come nearer to each other than at home."""

ROUNDING = 1e-12
"""Lengths below a metre, a dozen operations: a few 1e-16 m; the wire is exact. Everything real is 1e-9 m."""


@pytest.fixture
def short_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a refusal colour the status for 0.2 s instead of 1 s, so that tests of the recovery are short."""
    monkeypatch.setattr(guards, "SHOWN_FOR", 0.2)


def values_of(rig: Bench, key: str, value: str) -> dict[str, str]:
    """Wait until a diagnostics value is there and return all."""
    rig.until(lambda: rig.values().get(key) == value, f"{key} = {value}, not {rig.values().get(key)}")
    return rig.values()


# ---- commands in, struts out ----


def test_commands_are_the_papers_table_2(rig, tmp_path):
    """Table 1 in, Table 2 out at its printed digits (0.001 mm), with no model; the truth is the paper's."""
    wide = geometry_file(tmp_path, {"step_mm": 500.0, "speed_mm_s": 1e6})
    rig.compensator(geometry_file=wide, model_file="ideal")
    sent = np.array([rig.ask(pose).lengths for pose in table_poses()])
    np.testing.assert_allclose(sent, table_lengths(), rtol=0.0, atol=0.5001e-6)


def test_answer_is_named_stamped_and_in_metres(rig):
    rig.compensator()
    command = rig.send(HOME)
    rig.until(lambda: rig.seen["strut_commands"] and rig.seen["strut_corrections"], "an answer")
    for topic in ("strut_commands", "strut_corrections"):
        (message,) = rig.seen[topic]
        assert message.name == [f"strut_{i}" for i in range(1, 7)]
        assert message.header.stamp == command.header.stamp
        assert len(message.position) == 6
        assert len(message.velocity) == 6, "an empty velocity makes bags that some readers refuse"
        assert np.isfinite(message.velocity).all()
    lengths = np.array(rig.seen["strut_commands"][0].position)
    np.testing.assert_allclose(lengths, 0.509192, rtol=0.0, atol=2e-4)  # Table 2, row 1, ± the correction


def test_correction_is_command_minus_nominal(rig):
    """Nominal lengths by the closed form; the difference of two lengths is exact to rounding."""
    rig.compensator()
    for pose in (HOME, near(HOME, STEP_BACK, 0.05)):
        answer = rig.ask(pose)
        nominal = closed_form_lengths(pose)
        np.testing.assert_allclose(answer.corrections, answer.lengths - nominal, rtol=0.0, atol=ROUNDING)
        assert np.abs(answer.corrections).max() > 20e-6, "the shipped machine is wrong by some 100 µm"


def test_node_sends_exactly_what_the_core_computes(rig):
    rig.compensator()
    geometry = load_geometry(CONFIG / "paper.yaml")
    core = Compensator(geometry, load_model(CONFIG / "paper_machine.yaml", geometry))
    for step in range(5):
        pose = near(HOME, (2e-4 * step, -1e-4 * step, 1e-4 * step), 0.03 * step)
        answer, record = rig.ask(pose), core.correct(pose)
        np.testing.assert_allclose(answer.lengths, record.command, rtol=0.0, atol=ROUNDING)
        np.testing.assert_allclose(answer.corrections, record.correction, rtol=0.0, atol=ROUNDING)


def test_zero_stamp_means_now(rig):
    rig.compensator()
    before = rig.now()
    rig.send(pose_message(HOME, "base"))
    rig.until(lambda: rig.seen["strut_commands"], "an answer")
    stamp, after = rig.seen["strut_commands"][0].header.stamp, rig.now()
    assert (before.sec, before.nanosec) <= (stamp.sec, stamp.nanosec) <= (after.sec, after.nanosec)


def test_command_velocity_is_the_change_per_time(rig):
    """v = Δ/t with one t for all struts, which lies between what the witness measured around it."""
    rig.compensator()
    first, second = rig.ask(HOME), rig.ask(near(HOME, (0.0, 0.0, 1e-3)))
    assert list(first.command.velocity) == [0.0] * 6
    change, speed = second.lengths - first.lengths, np.array(second.command.velocity)
    np.testing.assert_allclose(change / speed, change[0] / speed[0], rtol=1e-9)
    assert second.sent_at - first.answered_at <= change[0] / speed[0] <= second.answered_at - first.sent_at


def test_unnormalised_within_tolerance_is_the_rotation_it_means(rig):
    """A float32 sender's quaternion has a norm of 1 ± 1e-7: the rotation is the same, only scaled."""
    rig.compensator(model_file="ideal")
    message = pose_message(near(HOME, tilt_deg=0.1), "base")
    for axis in "xyzw":
        setattr(message.pose.orientation, axis, getattr(message.pose.orientation, axis) * 1.0005)
    message.header.stamp = rig.now()
    expected = closed_form_lengths(near(HOME, tilt_deg=0.1))
    np.testing.assert_allclose(rig.ask(message).lengths, expected, rtol=0.0, atol=ROUNDING)


def test_minus_q_is_the_same_rotation(rig):
    rig.compensator(model_file="ideal")
    message = pose_message(near(HOME, tilt_deg=0.1), "base")
    for axis in "xyzw":
        setattr(message.pose.orientation, axis, -getattr(message.pose.orientation, axis))
    message.header.stamp = rig.now()
    expected = closed_form_lengths(near(HOME, tilt_deg=0.1))
    np.testing.assert_allclose(rig.ask(message).lengths, expected, rtol=0.0, atol=ROUNDING)


# ---- frames ----


def test_work_frame_and_base_frame(rig, tmp_path):
    """A work frame 50 mm along x, turned by 90° about z: worked out by hand below."""
    work = {"position_mm": [50.0, 0.0, 0.0], "rotation_deg": [0.0, 0.0, 90.0]}
    rig.compensator(geometry_file=geometry_file(tmp_path, work=work), model_file="ideal")
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    # Work's x is base's y: (0.002, 0.05, 0.4) in work is 0.05 − 0.05 along base's x, 0.002 along its y.
    in_work = Pose([0.002, 0.05, 0.4], quarter.T)
    in_base = Pose([0.0, 0.002, 0.4], np.eye(3))
    by_work, by_base = rig.ask(in_work, "work"), rig.ask(in_base, "base")
    np.testing.assert_allclose(by_work.lengths, closed_form_lengths(in_base), rtol=0.0, atol=ROUNDING)
    np.testing.assert_allclose(by_base.lengths, by_work.lengths, rtol=0.0, atol=ROUNDING)
    estimate = rig.estimate(by_base.command)
    assert estimate.header.frame_id == "base"
    np.testing.assert_allclose(message_pose(estimate).position, in_base.position, rtol=0.0, atol=1e-11)


def test_frames_may_have_other_names(rig):
    rig.compensator(base_frame="machine_3/base", work_frame="fixture")
    rig.ask(HOME, "machine_3/base")
    answer = rig.ask(HOME, "fixture")
    assert rig.estimate(answer.command).header.frame_id == "machine_3/base"
    rig.send(HOME, "base")
    rig.until_status(ERROR, "refusing commands: frame_id")
    assert "machine_3/base, fixture" in rig.values()["last_refusal"]


def test_tool_offset(rig, tmp_path):
    """A tool 80 mm long and 10 mm aside, turned by 90° about x; the platform is where it must be for it."""
    tool = {"position_mm": [0.0, 10.0, 80.0], "rotation_deg": [90.0, 0.0, 0.0]}
    rig.compensator(geometry_file=geometry_file(tmp_path, tool=tool), model_file="ideal")
    turned = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # Rx(90°)
    platform = near(HOME, (0.001, 0.0, 0.0))
    tip = Pose(platform.position + np.array([0.0, 0.01, 0.08]), turned)
    answer = rig.ask(tip)
    np.testing.assert_allclose(answer.lengths, closed_form_lengths(platform), rtol=0.0, atol=ROUNDING)
    estimate = message_pose(rig.estimate(answer.command))
    np.testing.assert_allclose(estimate.position, tip.position, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(estimate.rotation, tip.rotation, rtol=0.0, atol=1e-11)


# ---- refusals ----


def set_position(**values: float) -> Callable[[PoseStamped, Bench], None]:
    return lambda message, _: [setattr(message.pose.position, k, v) for k, v in values.items()] and None


def set_quaternion(x: float, y: float, z: float, w: float) -> Callable[[PoseStamped, Bench], None]:
    def change(message: PoseStamped, _: Bench) -> None:
        q = message.pose.orientation
        q.x, q.y, q.z, q.w = x, y, z, w

    return change


def set_frame(name: str) -> Callable[[PoseStamped, Bench], None]:
    return lambda message, _: setattr(message.header, "frame_id", name)


def set_stamp(seconds_from_now: float) -> Callable[[PoseStamped, Bench], None]:
    return lambda message, rig: setattr(message.header, "stamp", rig.stamp(seconds_from_now))


BAD = {
    "NaN position": (set_position(y=math.nan), "not_finite", "must be finite"),
    "infinite position": (set_position(z=math.inf), "not_finite", "must be finite"),
    "minus infinite position": (set_position(x=-math.inf), "not_finite", "must be finite"),
    "position beyond arithmetic": (set_position(x=1e300), "not_finite", "not finite"),
    "NaN quaternion": (set_quaternion(0.0, math.nan, 0.0, 1.0), "not_finite", "must be finite"),
    "infinite quaternion": (set_quaternion(0.0, 0.0, 0.0, math.inf), "not_finite", "must be finite"),
    "zero quaternion": (set_quaternion(0.0, 0.0, 0.0, 0.0), "quaternion", "norm 1 within 0.001, not 0"),
    "long quaternion": (set_quaternion(0.0, 0.0, 0.0, 1.002), "quaternion", "not 1.002"),
    "short quaternion": (set_quaternion(0.5, 0.5, 0.5, 0.0), "quaternion", "not 0.866"),
    "unknown frame": (set_frame("map"), "frame_id", "one of base, work, not 'map'"),
    "no frame": (set_frame(""), "frame_id", "one of base, work, not ''"),
    "old stamp": (set_stamp(-2.0), "stamp_past", "2.0"),
    "stamp before 1970": (
        lambda message, _: setattr(message.header.stamp, "sec", -5),
        "stamp_past",
        "old, allowed 0.5 s",
    ),
    "future stamp": (set_stamp(5.0), "stamp_future", "in the future, allowed 0.5 s"),
    "earlier than the last": (set_stamp(-0.2), "stamp_order", "earlier than the one before"),
    "out of reach": (set_position(z=2.0), "stroke", "outside the stroke 330.000…880.000 mm"),
    "base joint plane": (set_position(z=0.0), "stroke", "outside the stroke"),
    "too large a step": (set_position(z=0.41), "step", "in one command, allowed 2 mm"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_command_is_refused_and_the_last_good_one_stands(rig, case):
    """Refused, logged once, counted, shown as an error; the next small step from the last good is taken."""
    change, reason, text = BAD[case]
    rig.compensator()
    good = rig.ask(HOME)
    bad = pose_message(HOME, "base")
    bad.header.stamp = rig.now()
    change(bad, rig)
    rig.send(bad)

    values = rig.until_status(ERROR, f"refusing commands: {reason}")
    assert text in values["last_refusal"]
    assert (values["refused"], values[f"refused.{reason}"], values["commands"]) == ("1", "1", "1")
    (line,) = rig.logged("command refused")
    assert line.startswith(f"command refused ({reason}): ")
    assert text in line

    after = rig.ask(near(HOME, STEP_BACK))
    stamps = [message.header.stamp for message in rig.seen["strut_commands"]]
    assert stamps == [good.command.header.stamp, after.command.header.stamp], "nothing in between"
    assert len(rig.seen["strut_corrections"]) == 2
    nominal = closed_form_lengths(near(HOME, STEP_BACK))
    np.testing.assert_allclose(after.lengths - after.corrections, nominal, rtol=0.0, atol=ROUNDING)


LIMITS = {
    "base cone": ({"base_cone_deg": 5.0}, near(HOME, (0.1, 0.0, 0.0)), "base_cone", "allowed 5°"),
    "platform cone": ({"platform_cone_deg": 5.0}, TILTED, "platform_cone", "allowed 5°"),
    "struts too near": ({"clearance_mm": 220.0}, CROSSED, "clearance", "from the nearest other strut"),
    "near a singularity": ({"condition_number": 1.2}, TILTED, "condition", "above 1.2"),
    "the machine turned inside out": (
        {"base_cone_deg": 180.0, "platform_cone_deg": 180.0},
        Pose([0.0, 0.0, -0.4], np.eye(3)),
        "assembly",
        "another assembly mode",
    ),
    # The shipped model corrects 164 µm at home and 170 µm at 20° of tilt.
    "correction": ({"correction_um": 166.0}, TILTED, "correction", "larger than ±166 µm"),
    # At z = 401 mm the struts are 509.978 mm long, within the stroke only until they are corrected.
    "stroke of the compensated struts": (
        {"stroke_mm": [330.0, 509.99]},
        near(HOME, (0.0, 0.0, 0.001)),
        "stroke",
        "compensated length 510.",
    ),
}


@pytest.mark.parametrize("case", LIMITS)
def test_every_limit_refuses(rig, tmp_path, case):
    limits, pose, reason, text = LIMITS[case]
    rig.compensator(geometry_file=geometry_file(tmp_path, limits))
    rig.ask(HOME)
    rig.send(pose)
    values = rig.until_status(ERROR, f"refusing commands: {reason}")
    assert text in values["last_refusal"]
    rig.ask(near(HOME, (0.0, 0.0, 1e-5)))
    assert len(rig.seen["strut_commands"]) == 2


def test_field_that_refuses_extrapolation(rig, tmp_path):
    lines = [{"axis": "x", "at": [i, j], "direction": "both", "dx_um": [1.0]} for i in (0, 1) for j in (0, 1)]
    grid = {"grid_x_mm": [-1.0, 1.0], "grid_y_mm": [-1.0, 1.0], "grid_z_mm": [399.0, 401.0]}
    field = {**grid, "outside": "refuse", "lines": lines}
    rig.compensator(model_file=model_file(tmp_path, field=field))
    rig.ask(HOME)
    rig.send(near(HOME, (0.0015, 0.0, 0.0)))
    assert "(1.500, 0.000, 400.000) mm" in rig.until_status(ERROR, "refusing commands: outside_field")["last_refusal"]


def test_stamps_may_be_off_and_any(rig):
    rig.compensator(max_command_age=0.0)
    message = pose_message(HOME, "base")
    message.header.stamp.sec = 12
    assert rig.ask(message).command.header.stamp.sec == 12


def test_after_a_pause_stamps_may_start_earlier(rig, monkeypatch):
    """The sender or its clock was restarted; the pause is half a second, here 0.1 s."""
    monkeypatch.setattr(guards, "FORGET_ORDER_AFTER", 0.1)
    rig.compensator(max_command_age=0.0, command_timeout=0.15)
    rig.ask(HOME)
    rig.until_status(WARN, "no new command")
    message = pose_message(HOME, "base")
    message.header.stamp.sec = 12
    assert list(rig.ask(message).command.velocity) == [0.0] * 6, "nobody knows how long it took"


def test_same_stamp_again_is_taken(rig):
    """A controller that holds a pose may repeat the very message."""
    rig.compensator()
    message = rig.ask(HOME).command
    again = pose_message(HOME, "base")
    again.header.stamp = message.header.stamp
    rig.send(again)
    rig.until(lambda: len(rig.seen["strut_commands"]) == 2, "the answer to the repeated command")


def test_refused_command_does_not_count_as_the_last_one(rig):
    """Its stamp, a little ahead of time, must not shut out the good ones that follow."""
    rig.compensator()
    rig.ask(HOME)
    bad = pose_message(near(HOME, (0.0, 0.0, 0.05)), "base")
    bad.header.stamp = rig.stamp(0.4)
    rig.send(bad)
    rig.until_status(ERROR, "refusing commands: step")
    rig.ask(near(HOME, STEP_BACK))


def test_several_reasons_are_counted_apart(rig):
    """States change, so each is published at once; the log has one line per cause and second."""
    rig.compensator()
    rig.ask(HOME)
    for _ in range(3):
        for reason, frame, z in (("frame_id", "map", 0.4), ("step", "base", 0.41)):
            rig.send(Pose([0.0, 0.0, z], np.eye(3)), frame)
            values = rig.until_status(ERROR, f"refusing commands: {reason}")
            rig.seen["/diagnostics"].clear()
    assert (values["refused"], values["refused.frame_id"], values["refused.step"]) == ("6", "3", "3")
    assert len(rig.logged("command refused (frame_id)")) == 1
    assert len(rig.logged("command refused (step)")) == 1


def test_status_recovers(rig, short_memory):
    rig.compensator(command_timeout=0.0)
    rig.ask(HOME)
    rig.send(HOME, "map")
    rig.until_status(ERROR, "refusing commands")
    rig.ask(HOME)
    values = rig.until_status(OK, "running")
    assert values["refused"] == "1", "the counter stays"
    assert "not 'map'" in values["last_refusal"]


def test_nothing_out_of_limits_is_ever_published(rig):
    """A rough sender: whatever gets through is finite, in the stroke and within one step of the last."""
    rng = np.random.default_rng(20)
    rig.compensator()
    rig.ask(HOME)
    extremes = [math.nan, math.inf, -1.0, 0.0, 1e9]
    begin = time.monotonic()
    for n in range(60):
        position = HOME.position + rng.normal(0.0, 1e-3, 3)
        message = pose_message(Pose(position, np.eye(3)), "base")
        if rng.uniform() < 0.4:
            setattr(message.pose.position, "xyz"[rng.integers(3)], float(rng.choice(extremes)))
        # 10 ms apart the speed limit lets through what the step limit does, however quick the computer.
        rig.until(lambda due=begin + 0.01 * n: time.monotonic() >= due, "the next command to be due")
        message.header.stamp = rig.now()
        rig.send(message)
        rig.barrier()
    lengths = np.array([message.position for message in rig.seen["strut_commands"]])
    assert 5 < len(lengths) < 61
    assert np.isfinite(lengths).all()
    assert (np.abs(np.diff(lengths, axis=0)) <= 2e-3).all()
    assert ((lengths >= 0.330) & (lengths <= 0.880)).all()


# ---- feedback and estimate ----


def test_estimate_from_measured_struts_by_name(rig):
    """Closed-form lengths of a pose in, the pose out; the names in any order, the stamp copied."""
    rig.compensator(model_file="ideal", feedback_timeout=60.0)
    pose = near(HOME, (0.01, -0.02, 0.03), 5.0)
    lengths, order = closed_form_lengths(pose), [3, 5, 0, 1, 4, 2]
    message = rig.feed(lengths[order], tuple(STRUT_NAMES[i] for i in order))
    estimate = rig.estimate(message)
    # Newton ends below 1e-13 m of strut length; the inverse Jacobian of this machine is below 3.
    np.testing.assert_allclose(message_pose(estimate).position, pose.position, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(message_pose(estimate).rotation, pose.rotation, rtol=0.0, atol=1e-11)
    values_of(rig, "pose_estimated_from", "strut_states")


def test_estimate_runs_through_the_model(rig):
    """Measured struts that stand on their commands: the tool is where it was commanded, not elsewhere."""
    rig.compensator(feedback_timeout=60.0)
    pose = near(HOME, STEP_BACK, 0.1)
    lengths = rig.ask(pose).lengths
    estimate = message_pose(rig.estimate(rig.feed(lengths)))
    np.testing.assert_allclose(estimate.position, pose.position, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(estimate.rotation, pose.rotation, rtol=0.0, atol=1e-11)


def test_without_feedback_the_estimate_comes_from_own_commands(rig):
    rig.compensator(command_timeout=0.0)
    pose = near(HOME, STEP_BACK, 0.1)
    estimate = rig.estimate(rig.ask(pose).command)
    np.testing.assert_allclose(message_pose(estimate).position, pose.position, rtol=0.0, atol=1e-11)
    values = rig.until_status(OK, "running, pose estimated from own commands")
    assert values["pose_estimated_from"] == "own commands"
    assert values["feedback_age_s"] == "never"


def test_with_feedback_own_commands_are_not_taken_for_measured(rig):
    rig.compensator(feedback_timeout=60.0, command_timeout=0.0)
    rig.estimate(rig.feed(closed_form_lengths(HOME)))
    rig.ask(near(HOME, STEP_BACK))
    rig.barrier()
    assert len(rig.seen["tool_pose_estimate"]) == 1
    assert rig.until_status(OK, "running, a change is ramping in")["pose_estimated_from"] == "strut_states"


def test_lost_feedback_is_said_and_compensation_goes_on(rig):
    rig.compensator(feedback_timeout=0.2, command_timeout=0.0)
    rig.feed(closed_form_lengths(HOME))
    rig.ask(HOME)
    rig.until_status(WARN, "feedback lost, pose estimated from own commands")
    rig.ask(near(HOME, STEP_BACK))
    rig.feed(closed_form_lengths(HOME))
    values = values_of(rig, "pose_estimated_from", "strut_states")
    assert float(values["feedback_age_s"]) < 0.2


def lengths_with(index: int, value: float) -> np.ndarray:
    lengths = closed_form_lengths(HOME)
    lengths[index] = value
    return lengths


BAD_FEEDBACK = {
    "NaN": (lengths_with(2, math.nan), STRUT_NAMES, "not_finite", "must be finite"),
    "infinite": (lengths_with(0, math.inf), STRUT_NAMES, "not_finite", "must be finite"),
    "other names": (closed_form_lengths(HOME), tuple("abcdef"), "strut_names", "named once: strut_1 missing"),
    "a name twice": (closed_form_lengths(HOME), ("strut_1", *STRUT_NAMES[:5]), "strut_names", "once: strut_1 twice"),
    "no names": (closed_form_lengths(HOME), (), "strut_names", "strut_1 missing, strut_2 missing"),
    "five names": (closed_form_lengths(HOME), STRUT_NAMES[:5], "strut_names", "named once: strut_6 missing"),
    "a name too many": (closed_form_lengths(HOME), (*STRUT_NAMES, "x"), "strut_count", "each of 7 names"),
    "five positions": (closed_form_lengths(HOME)[:5], STRUT_NAMES, "strut_count", "needs a position, there are 5"),
    "no positions": (np.zeros(0), STRUT_NAMES, "strut_count", "needs a position, there are 0"),
    "too short": (lengths_with(4, 0.05), STRUT_NAMES, "stroke", "strut_5 cannot be 50.000 mm long"),
    "too long": (lengths_with(5, 0.9), STRUT_NAMES, "stroke", "only 328…882 mm"),
    "negative": (lengths_with(4, -0.5), STRUT_NAMES, "stroke", "strut_5 cannot be -500.000 mm long"),
    # Struts 1 and 2 meet at one corner, and their feet are 0.243 m apart: 0.879 and 0.509 m do not meet.
    "no machine stands so": (lengths_with(0, 0.879), STRUT_NAMES, "", "strut_states ignored"),
}


@pytest.mark.parametrize("case", BAD_FEEDBACK)
def test_bad_feedback_is_ignored_counted_and_logged(rig, case):
    lengths, names, reason, text = BAD_FEEDBACK[case]
    rig.compensator()
    rig.feed(lengths, names)
    values = rig.until_status(ERROR, f"bad feedback: {reason}")
    assert values["bad_feedback"] == "1"
    assert values["last_bad_feedback"]
    assert values["refused"] == "0", "no command has been refused"
    (line,) = rig.logged(text)
    assert values["last_bad_feedback"] in line
    assert not rig.seen["tool_pose_estimate"]


@pytest.mark.parametrize("value", [math.nan, 0.05])
def test_first_command_after_bad_feedback(rig, value):
    """Lengths that are no numbers, or that no strut can have, are as none at all."""
    rig.compensator(feedback_timeout=60.0)
    rig.feed(lengths_with(4, value))
    assert rig.until_status(ERROR, "bad feedback")["feedback_age_s"] == "never"
    rig.ask(HOME)


def test_require_feedback(rig, short_memory):
    rig.compensator(require_feedback=True, feedback_timeout=0.3, command_timeout=0.0)
    rig.send(HOME)
    assert "no strut_states yet" in rig.until_status(ERROR, "refusing commands: no_feedback")["last_refusal"]
    rig.feed(closed_form_lengths(HOME))
    rig.ask(HOME)
    rig.until_status(WARN, "feedback lost")
    rig.send(HOME)
    assert rig.until_status(ERROR, "refusing commands: no_feedback")["refused.no_feedback"] == "2"
    assert len(rig.seen["strut_commands"]) == 1


def test_first_command_is_at_most_one_step_from_the_measured_struts(rig):
    """The step allowed is 2 mm; 5 mm along z change every strut by some 4 mm."""
    rig.compensator(feedback_timeout=60.0)
    measured = near(HOME, (0.0, 0.0, 0.05))
    rig.estimate(rig.feed(closed_form_lengths(measured)))
    rig.send(near(measured, (0.0, 0.0, 0.005)))
    values = rig.until_status(ERROR, "refusing commands: step")
    assert "allowed 2 mm" in values["last_refusal"]
    assert values["what_to_do"].startswith("go on from the last answered command")
    assert values["last_answered"] == "0.000000000"
    answer = rig.ask(near(measured, (0.0, 0.0, 0.001)))
    stamp = answer.command.header.stamp
    rig.until(lambda: rig.values()["last_answered"] == f"{stamp.sec}.{stamp.nanosec:09d}", "the stamp")
    assert len(rig.seen["strut_commands"]) == 1


def test_first_command_after_every_activation_starts_from_the_measured_struts(rig):
    """Also when the struts were moved, and measured, while the node was inactive."""
    rig.compensator(feedback_timeout=60.0)
    rig.feed(closed_form_lengths(HOME))
    rig.ask(HOME)
    assert rig.change("deactivate")
    elsewhere = near(HOME, (0.0, 0.0, 0.05))
    rig.feed(closed_form_lengths(elsewhere), later=0.3)  # 45 mm take the struts a while
    rig.barrier()
    assert rig.change("activate")
    rig.send(HOME)
    rig.until_status(ERROR, "refusing commands: step")
    rig.ask(elsewhere)


# ---- changes ramp ----


def stream(rig: Bench, pose: Pose, last: Answer, until: Callable[[Answer], bool]) -> list[Answer]:
    """Send a pose again and again until an answer satisfies a condition; return all from `last` on."""
    answers = [last]
    while not until(answers[-1]):
        answers.append(rig.ask(pose))
        assert len(answers) < 2000, "the ramp does not end"
    return answers


def assert_ramp(answers: list[Answer], rate: float) -> None:
    """No strut steps: at most rate × time between two commands, every strut monotone to its end.

    The node measures its time between handling two commands. That is longer than from the answer of the
    first to the sending of the second, and shorter than from the sending of the first to the answer of the
    second: the latter bounds the step. A pause counts as 20 ms at most.
    """
    corrections = np.array([answer.corrections for answer in answers])
    times = [b.answered_at - a.sent_at for a, b in pairwise(answers)]
    steps = np.diff(corrections, axis=0)
    allowed = rate * np.minimum(times, 0.02)
    assert (np.abs(steps).max(axis=1) <= allowed + ROUNDING).all()
    direction = np.sign(corrections[-1] - corrections[0])
    assert (steps * direction >= -ROUNDING).all(), "a strut went back on its way"


def test_switching_off_and_on_ramps(rig):
    """From the full correction to none and back, at 2 mm/s: 164 µm, at most 40 µm of them after a pause."""
    rate = 0.002
    rig.compensator(ramp_rate=rate, command_timeout=0.0)
    full = rig.ask(HOME)
    assert "ramps out" in rig.enable(False).message
    off = stream(rig, HOME, full, lambda answer: not answer.corrections.any())
    assert_ramp(off, rate)
    np.testing.assert_allclose(off[-1].lengths, closed_form_lengths(HOME), rtol=0.0, atol=ROUNDING)
    assert values_of(rig, "largest_correction_m", "0.000000000")["compensation"] == "off"
    assert "ramps in" in rig.enable(True).message
    back = stream(rig, HOME, off[-1], lambda answer: np.abs(answer.corrections - full.corrections).max() < ROUNDING)
    assert_ramp(back, rate)
    assert len(off) > 3
    assert len(back) > 3
    values_of(rig, "compensation", "on")


def test_a_ramp_is_said(rig):
    rig.compensator(ramp_rate=1e-6, command_timeout=0.0)
    rig.ask(HOME)
    rig.enable(False)
    rig.ask(HOME)
    assert rig.until_status(OK, "running, a change is ramping in")["ramping"] == "true"


def test_a_pause_does_not_become_a_step(rig):
    """After a pause, a strut may go 20 ms × 1 mm/s = 20 µm at once, not the whole 164 µm."""
    rig.compensator(ramp_rate=1e-3, command_timeout=0.05)
    before = rig.ask(HOME)
    rig.enable(False)
    rig.until_status(WARN, "no new command")
    step = np.abs(rig.ask(HOME).corrections - before.corrections).max()
    assert 0.0 < step <= 20e-6 + ROUNDING


def test_switched_off_from_the_start(rig):
    rig.compensator(enable_compensation=False)
    answer = rig.ask(HOME)
    assert not answer.corrections.any()
    np.testing.assert_allclose(answer.lengths, closed_form_lengths(HOME), rtol=0.0, atol=ROUNDING)
    assert rig.enable(True).success
    assert np.abs(rig.ask(HOME).corrections).max() < 20e-6


def test_reload_ramps_to_the_new_model(rig, tmp_path):
    """Two models of strut offsets only: actual = command + offset, so the correction is −offset."""
    rate, path = 0.005, model_file(tmp_path, struts={"offset_um": 100.0})
    rig.compensator(model_file=path, ramp_rate=rate, command_timeout=0.0)
    before = rig.ask(HOME)
    np.testing.assert_allclose(before.corrections, -100e-6, rtol=0.0, atol=ROUNDING)
    offsets = [-50.0, 0.0, 50.0, 100.0, 150.0, 200.0]
    model_file(tmp_path, name="model.yaml", struts={"offset_um": offsets})
    assert rig.trigger("reload_model").success
    wanted = -1e-6 * np.array(offsets)
    answers = stream(rig, HOME, before, lambda answer: np.abs(answer.corrections - wanted).max() < ROUNDING)
    assert_ramp(answers, rate)


BROKEN = {
    "not there": (None, "no such file"),
    "not YAML": ("format: [", "model.yaml"),
    "another machine's": ("machine", "'paper'"),
    "not a number": ("offset_um", "struts.offset_um"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_reload_of_a_broken_file_keeps_the_old_model_and_says_why(rig, tmp_path, case):
    what, text = BROKEN[case]
    path = Path(model_file(tmp_path, struts={"offset_um": 100.0}))
    rig.compensator(model_file=str(path))
    rig.ask(HOME)
    if what is None:
        path.unlink()
    elif what == "machine":
        model_file(tmp_path, machine="somebody else's")
    elif what == "offset_um":
        model_file(tmp_path, struts={"offset_um": "a lot"})
    else:
        path.write_text(what, encoding="utf-8")
    response = rig.trigger("reload_model")
    assert not response.success
    assert response.message.startswith("the old model stays: ")
    assert text in response.message
    assert str(path) in response.message
    np.testing.assert_allclose(rig.ask(HOME).corrections, -100e-6, rtol=0.0, atol=ROUNDING)


def test_reset_starts_from_the_measured_struts(rig):
    rig.compensator(feedback_timeout=60.0)
    rig.ask(HOME)
    elsewhere = near(HOME, (0.0, 0.0, 0.05))
    rig.send(elsewhere)
    rig.until_status(ERROR, "refusing commands: step")
    rig.feed(closed_form_lengths(elsewhere))
    assert rig.trigger("reset").success
    rig.send(HOME)
    rig.barrier()
    rig.ask(elsewhere)
    assert len(rig.seen["strut_commands"]) == 2, "home is not one step away from there"


def test_reset_in_the_middle_of_a_ramp_does_not_step(rig):
    """Changes ramp, they never step: at 1 mm/s and at most 20 ms, a strut may go 20 µm."""
    rig.compensator(ramp_rate=1e-3)
    rig.ask(HOME)
    rig.enable(False)
    before = rig.ask(HOME)
    rig.trigger("reset")
    assert np.abs(rig.ask(HOME).corrections - before.corrections).max() <= 20e-6 + ROUNDING


def test_after_a_reset_stamps_may_start_earlier(rig):
    rig.compensator(max_command_age=0.0)
    earlier = pose_message(HOME, "base")
    earlier.header.stamp = rig.stamp(-0.3)
    rig.ask(HOME)
    rig.trigger("reset")
    rig.ask(earlier)


# ---- temperatures ----


def test_strut_temperature_changes_its_correction(rig, tmp_path):
    """Closed form: a strut that grows by g must be commanded L/(1 + g); only the warm one."""
    path = model_file(tmp_path, struts={"expansion_ppm_per_K": 12.0})
    rig.compensator(model_file=path, ramp_rate=1.0, command_timeout=0.0)
    assert not rig.ask(HOME).corrections.any()
    rig.warm("strut_3", 25.0)
    growth = np.array([0.0, 0.0, 12e-6 * 5.0, 0.0, 0.0, 0.0])
    nominal = closed_form_lengths(HOME)
    expected = nominal / (1.0 + growth) - nominal
    np.testing.assert_allclose(rig.ask(HOME).corrections, expected, rtol=0.0, atol=ROUNDING)
    assert expected[2] == pytest.approx(-30.55e-6, abs=1e-8), "0.509192 m · 12e-6/K · 5 K"
    values_of(rig, "temperature.strut_3_degC", "25.00")


@pytest.mark.parametrize(("part", "sides"), [("base", "bd"), ("platform", "a")])
def test_body_temperature_changes_all_corrections(rig, tmp_path, part, sides):
    """A body that grows about its origin is the paper's machine with larger sides."""
    path = model_file(tmp_path, thermal={f"{part}_expansion_ppm_per_K": 10.0})
    rig.compensator(model_file=path, ramp_rate=1.0)
    rig.ask(HOME)
    rig.warm(part, 30.0)
    grown = {side: {"a": 0.3, "b": 0.572, "d": 0.243}[side] * (1.0 + 100e-6) for side in sides}
    expected = closed_form_lengths(HOME, **grown)
    np.testing.assert_allclose(rig.ask(HOME).lengths, expected, rtol=0.0, atol=ROUNDING)


def test_temperatures_ramp(rig, tmp_path):
    """60 K · 12e-6/K · 0.5 m = 367 µm at 5 mm/s."""
    path = model_file(tmp_path, struts={"expansion_ppm_per_K": 12.0})
    rig.compensator(model_file=path, ramp_rate=0.005, temperature_spread_limit=0.0)
    before = rig.ask(HOME)
    rig.warm("strut_1", 80.0)
    nominal = closed_form_lengths(HOME)[0]
    wanted = nominal / (1.0 + 60.0 * 12e-6) - nominal
    answers = stream(rig, HOME, before, lambda answer: abs(answer.corrections[0] - wanted) < ROUNDING)
    assert_ramp(answers, 0.005)
    assert len(answers) > 3


@pytest.mark.parametrize(("time_constant", "taken"), [(3600.0, 26.0), (0.0, 27.0)], ids=["filtered", "off"])
def test_readings_are_filtered(rig, tmp_path, time_constant, taken):
    """Two readings within a few seconds count alike in an hour's mean; 1 nm is 0.6 s out of that."""
    path = model_file(tmp_path, struts={"expansion_ppm_per_K": 12.0})
    rig.compensator(
        model_file=path, ramp_rate=1.0, temperature_time_constant_s=time_constant, temperature_rate_limit=0.0
    )
    rig.warm("strut_3", 25.0)
    rig.warm("strut_3", 27.0)
    values_of(rig, "temperature.strut_3_degC", f"{taken:.2f}")
    nominal = closed_form_lengths(HOME)[2]
    expected = nominal / (1.0 + 12e-6 * (taken - 20.0)) - nominal
    assert rig.ask(HOME).corrections[2] == pytest.approx(expected, rel=0.0, abs=10e-9)


def test_temperatures_of_an_inactive_node_act_on_activation(rig, tmp_path):
    """The first command after it finds the strut as warm as it is; one that has moved before ramps to it."""
    path = model_file(tmp_path, struts={"expansion_ppm_per_K": 12.0})
    settings = {"ramp_rate": 0.005, "max_command_age": 0.0, "temperature_time_constant_s": 0.0}
    settings |= {"temperature_rate_limit": 0.0, "temperature_spread_limit": 0.0}
    rig.compensator(start=False, model_file=path, **settings)
    assert rig.change("configure")
    rig.until(rig.matched, "discovery")
    rig.warm("strut_3", 25.0)
    assert rig.change("activate")
    nominal = closed_form_lengths(HOME)[2]
    warm, hot = (nominal / (1.0 + 12e-6 * kelvin) - nominal for kelvin in (5.0, 60.0))
    first = rig.ask(HOME)
    assert first.corrections[2] == pytest.approx(warm, rel=0.0, abs=ROUNDING)
    assert rig.change("deactivate")
    rig.warm("strut_3", 80.0)
    assert rig.change("activate")
    answers = stream(rig, HOME, first, lambda answer: abs(answer.corrections[2] - hot) < ROUNDING)
    assert_ramp(answers, 0.005)


@pytest.mark.parametrize(
    ("part", "temperature", "text"),
    [
        ("spindle", 25.0, "found 'spindle'"),
        ("", 25.0, "found ''"),
        ("strut_1", math.nan, "temperature of strut_1: must lie within -40…120 °C (found nan)"),
        ("base", 293.15, "must lie within -40…120 °C (found 293.15)"),
    ],
)
def test_bad_temperature_is_ignored_and_counted(rig, tmp_path, part, temperature, text):
    """An unknown part, no number, and kelvins."""
    path = model_file(tmp_path, struts={"expansion_ppm_per_K": 12.0})
    rig.compensator(model_file=path, ramp_rate=1.0)
    rig.ask(HOME)
    rig.warm(part, temperature)
    values = rig.until_status(ERROR, "bad feedback: temperature")
    assert values["bad_feedback"] == "1"
    assert text in values["last_bad_feedback"]
    assert len(rig.logged("temperature ignored")) == 1
    assert not rig.ask(HOME).corrections.any()


# ---- lifecycle ----


def test_inactive_node_ignores_commands_and_replays_nothing(rig):
    rig.compensator(start=False, feedback_timeout=60.0)
    assert rig.state() == "unconfigured"
    assert rig.change("configure")
    assert rig.state() == "inactive"
    rig.until(rig.matched, "discovery")
    rig.send(near(HOME, (0.0, 0.0, 0.05)))
    rig.barrier()
    assert rig.until_status(WARN, "not active")["commands"] == "0"
    assert rig.change("activate")
    rig.until_status(OK, "waiting for the first command")
    first = rig.ask(HOME)
    assert [m.header.stamp for m in rig.seen["strut_commands"]] == [first.command.header.stamp]
    assert rig.values()["refused"] == "0"


def test_deactivated_node_is_silent(rig):
    rig.compensator()
    rig.ask(HOME)
    assert rig.change("deactivate")
    said = {topic: len(rig.seen[topic]) for topic in ("strut_commands", "tool_pose_estimate")}
    rig.send(HOME)
    rig.feed(closed_form_lengths(HOME))
    rig.warm("nonsense", math.nan)
    assert {topic: len(rig.seen[topic]) for topic in said} == said
    assert rig.until_status(WARN, "not active")["bad_feedback"] == "0"


def test_lifecycle_goes_round(rig):
    """Three rounds by service while measured struts stream in; the topics come and go with it."""
    rig.compensator(start=False)
    for _ in range(3):
        assert rig.change("configure")
        assert rig.change("activate")
        rig.until(rig.matched, "discovery")
        rig.feed(closed_form_lengths(HOME))
        rig.ask(HOME)
        assert rig.change("deactivate")
        rig.feed(closed_form_lengths(HOME))
        assert rig.change("cleanup")
        rig.until(lambda: not rig.witness.count_publishers("strut_corrections"), "the publisher to go")
        assert rig.witness.count_subscribers("tool_pose_command") == 0
    assert rig.state() == "unconfigured"


def test_configure_with_a_bad_file_fails_and_names_file_and_key(rig, tmp_path):
    """The file is mended, and then the node can be configured."""
    path = Path(geometry_file(tmp_path, {"step_mm": -1.0}))
    rig.compensator(start=False, geometry_file=str(path))
    assert not rig.change("configure")
    assert rig.state() == "unconfigured"
    (line,) = rig.logged("cannot configure")
    assert str(path) in line
    assert "limits.step" in line
    assert "-1" in line or "-0.001" in line
    geometry_file(tmp_path)
    assert rig.change("configure")
    assert rig.change("activate")
    rig.until(rig.matched, "discovery")
    rig.ask(HOME)


def test_home_out_of_limits_fails_and_says_why(rig, tmp_path):
    """The shipped model corrects 164 µm at home: with 100 µm allowed, the machine cannot even stand there."""
    node = rig.compensator(start=False, geometry_file=geometry_file(tmp_path, {"correction_um": 100.0}))
    assert not rig.change("configure")
    assert rig.state() == "unconfigured"
    (line,) = rig.logged("cannot configure")
    assert "larger than ±100 µm" in line
    node.publish_last_status()


# ---- parameters ----


def test_parameters_describe_themselves(rig):
    rig.compensator()
    names = [parameter.name for parameter in compensator_module.PARAMETERS]
    request = DescribeParameters.Request(names=names)
    answer = rig.call(DescribeParameters, "compensator/describe_parameters", request)
    described = {descriptor.name: descriptor for descriptor in answer.descriptors}
    assert all(described[name].description for name in names)
    for parameter in compensator_module.PARAMETERS:
        if isinstance(parameter.default, float):
            (bounds,) = described[parameter.name].floating_point_range
            assert bounds.from_value <= parameter.default <= bounds.to_value


def test_int_is_taken_for_a_double(rig):
    rig.compensator(command_timeout=1, ramp_rate=1, marker_rate=5)
    rig.ask(HOME)


def test_misspelt_parameter_is_warned_of(rig):
    rig.compensator(comand_timeout=1.0)
    (line,) = rig.logged("comand_timeout")
    assert line == "there is no parameter comand_timeout, it is ignored; did you mean command_timeout?"


def test_known_parameters_are_not_warned_of(rig):
    override = {"qos_overrides./tool_pose_command.subscription.depth": 3}
    rig.compensator(use_sim_time=False, command_timeout=1.0, **override)
    assert rig.logged("ready")
    assert not rig.logged("there is no parameter")


@pytest.mark.parametrize(
    ("kind", "parameter", "text"),
    [
        (CompensatorNode, {"command_timeout": -0.1}, "command_timeout"),
        (CompensatorNode, {"ramp_rate": 2.0}, "ramp_rate"),
        (CompensatorNode, {"ramp_rate": math.nan}, "ramp_rate"),
        (CompensatorNode, {"ramp_rate": 2}, "ramp_rate: must lie in 1e-06 to 1 m/s, not 2"),
        (CompensatorNode, {"temperature_time_constant_s": -1.0}, "temperature_time_constant_s"),
        (CompensatorNode, {"require_feedback": "yes"}, "require_feedback: must be bool, not 'yes'"),
        (CompensatorNode, {"marker_rate": True}, "marker_rate: must be float, not True"),
        (CompensatorNode, {"model_file": 3}, "model_file: must be str, not 3"),
        (StrutDriveNode, {"rate": 0.0}, "rate"),
        (StrutDriveNode, {"rate": 5000}, "rate: must lie in 1 to 2000 Hz, not 5000"),
        (StrutDriveNode, {"lag": 0.0}, "lag"),
        (StrutDriveNode, {"truth_seed": -1}, "truth_seed"),
        (StrutDriveNode, {"truth_seed": 1.5}, "truth_seed: must be int, not 1.5"),
        (StrutDriveNode, {"fault_stuck_strut": 9}, "fault_stuck_strut"),
    ],
)
def test_parameter_out_of_range_or_of_another_type_is_refused(rig, kind, parameter, text):
    with pytest.raises(ParameterError, match=r"^parameter ") as caught:
        rig.add(kind, False, parameter)
    assert text in str(caught.value)


def test_autostart_is_a_wish_of_the_node(rig):
    assert rig.compensator(start=False).wants_autostart is True


# ---- diagnostics ----


def test_diagnostics_once_a_second_and_complete(rig):
    """With nothing going on: the state at once, then every second (looked at every 50 ms)."""
    rig.compensator()
    rig.until(lambda: len(rig.statuses()) >= 3, "three statuses")
    stamps = [array.header.stamp for array in rig.seen["/diagnostics"][-2:]]
    first, second = (stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps)
    assert 0.95 < second - first < 1.5, "on a machine under load"
    status = rig.status()
    assert (status.name, status.hardware_id) == ("compensator: state", "paper")
    assert (status.level, status.message) == (OK, "waiting for the first command")
    expected = {"model": "virtual machine", "compensation": "on", "ramping": "false", "commands": "0", "refused": "0"}
    assert expected.items() <= rig.values().items()
    for key in ("command_rate_hz", "command_age_s", "feedback_rate_hz", "feedback_age_s", "pose_estimated_from"):
        assert key in rig.values()


def test_stale_commands_are_said(rig):
    rig.compensator(command_timeout=0.1)
    rig.ask(HOME)
    values = rig.until_status(WARN, "no new command")
    assert float(values["command_age_s"]) >= 0.1  # said in milliseconds: more than the timeout may read 0.100

    def running() -> bool:
        rig.ask(HOME)  # again and again: a node that gets no processor for 0.1 s never sees one alone
        return rig.message().startswith("running")

    rig.until(running, "the state to be running")


def test_log_lets_one_line_per_cause_and_second_through(monkeypatch):
    clock = iter([0.0, 0.4, 0.5, 0.9, 1.1, 1.6])
    monkeypatch.setattr(rclpy_compat, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    throttle = Throttle()
    causes = ["nan", "nan", "step", "nan", "nan", "step"]
    said = ["it", None, "it", None, "it (2 more like it)", "it"]
    assert [throttle.allow(cause, "it") for cause in causes] == said


def test_counters_by_reason():
    refusals = Refusals()
    for reason, now in (("step", 1.0), ("stroke", 2.0), ("step", 3.0)):
        refusals.add(reason, f"{reason} at {now}", now)
    assert refusals.values() == {"refused": "3", "refused.step": "2", "refused.stroke": "1"}
    assert (refusals.last_reason, refusals.last_text) == ("step", "step at 3.0")
    assert refusals.recent(3.9)
    assert not refusals.recent(4.1)


def test_what_happened_while_a_node_stood_still_is_said_once():
    """A refusal is shown for 1 s, and the node looks after 5 s: asked twice at that time, it says it, then no more."""
    refusals = Refusals()
    assert not refusals.recent(0.0)
    refusals.add("step", "3 mm", 1.0)
    assert refusals.recent(6.0)
    assert refusals.reasons(6.0) == "step"
    assert not refusals.recent(6.05)


def test_rate_and_age_of_a_flow(monkeypatch):
    """250 events in the 2 s since it was made: 125 a second."""
    monkeypatch.setattr(status_module, "time", SimpleNamespace(monotonic=lambda: 10.0))
    flow = Flow()
    assert flow.age(11.0) == math.inf
    for n in range(250):
        flow.tick(10.0 + n / 125.0)
    assert flow.rate(12.0) == pytest.approx(125.0)
    assert flow.rate(12.5) == pytest.approx(125.0), "over the last full second"
    assert flow.rate(14.0) == 0.0
    assert flow.age(14.0) == pytest.approx(14.0 - 10.0 - 249 / 125.0)


def test_report_is_due_on_change_and_once_a_second():
    report = HealthReport("node: machine", "machine")
    running, refusing = (OK, "running"), (ERROR, "refusing commands: step")
    asked = [(running, 0.0), (running, 0.9), (refusing, 0.95), (refusing, 1.9), (refusing, 2.0)]
    assert [report.due(*state, now) for state, now in asked] == [True, False, True, False, True]


# ---- markers and mirror ----


def test_markers_show_the_machine_as_it_stands(rig):
    """Struts run from base joints to platform joints: their drawn lengths are the closed form's."""
    rig.compensator(model_file="ideal")
    pose = near(HOME, (0.01, 0.0, 0.02), 3.0)
    rig.ask(pose)
    rig.seen["compensator/markers"].clear()
    rig.until(lambda: rig.seen["compensator/markers"], "markers")
    markers = rig.seen["compensator/markers"][0].markers
    assert len({(marker.ns, marker.id) for marker in markers}) == len(markers) == 5
    for marker in markers:
        assert marker.header.frame_id == "base"
        assert marker.header.stamp.sec > 0
        assert marker.points
        assert marker.color.a > 0.0
        assert marker.scale.x > 0.0
    struts = next(marker for marker in markers if marker.type == marker.LINE_LIST)
    points = np.array([[p.x, p.y, p.z] for p in struts.points]).reshape(6, 2, 3)
    lengths = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    np.testing.assert_allclose(lengths, closed_form_lengths(pose), rtol=0.0, atol=1e-11)
    assert len(struts.colors) == 12
    assert all((c.r, c.g, c.b) == (1.0, 1.0, 1.0) for c in struts.colors), "no correction is white"


def test_strut_markers_are_coloured_by_correction(rig, tmp_path):
    """Correction −offset: −100 µm is blue, +100 µm red, +50 µm half way, beyond as at the end."""
    path = model_file(tmp_path, struts={"offset_um": [100.0, -100.0, -50.0, 0.0, 300.0, 0.0]})
    rig.compensator(model_file=path)
    rig.ask(HOME)
    rig.seen["compensator/markers"].clear()
    rig.until(lambda: rig.seen["compensator/markers"], "markers")
    struts = rig.seen["compensator/markers"][0].markers[0]
    colours = np.array([[c.r, c.g, c.b] for c in struts.colors[::2]])
    expected = [[0, 0, 1], [1, 0, 0], [1, 0.5, 0.5], [1, 1, 1], [0, 0, 1], [1, 1, 1]]
    np.testing.assert_allclose(colours, expected, atol=1e-6)  # float32 on the wire


def test_markers_come_at_most_ten_times_a_second(rig):
    """Stamps of the node, not arrival times; a timer that was late may catch up, hence over four periods."""
    rig.compensator()
    rig.until(lambda: len(rig.seen["compensator/markers"]) >= 5, "five markers")
    stamps = [array.markers[0].header.stamp for array in rig.seen["compensator/markers"][:5]]
    times = [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]
    assert times[4] - times[0] > 0.3


def test_no_markers_when_switched_off(rig):
    rig.compensator(marker_rate=0.0, command_timeout=0.1)
    rig.ask(HOME)
    rig.until_status(WARN, "no new command")
    assert not rig.seen["compensator/markers"]


def test_array_mirror(rig):
    rig.compensator(publish_array=True)
    answer = rig.ask(HOME)
    rig.until(lambda: rig.seen["strut_commands_array"], "the mirror")
    assert list(rig.seen["strut_commands_array"][0].data) == list(answer.command.position)


def test_no_array_mirror_unless_asked_for(rig):
    rig.compensator()
    assert rig.witness.count_publishers("strut_commands_array") == 0


# ---- topics ----


def test_quality_of_service(rig):
    """Commands reliable, in a queue of a hundred; states the newest only; estimates for every listener."""
    node = rig.compensator(publish_array=True)
    ends = {end.topic_name: end.qos_profile for end in (*node.publishers, *node.subscriptions)}
    reliable = {"tool_pose_command", "strut_commands", "strut_corrections", "strut_commands_array"}
    for name in reliable | {"strut_states", "tool_pose_estimate"}:
        qos = ends[f"/{name}"]
        assert (qos.depth, qos.history) == (100 if name in reliable else 1, HistoryPolicy.KEEP_LAST), name
    for name in reliable:
        assert ends[f"/{name}"].reliability == ReliabilityPolicy.RELIABLE, name
    for name in ("strut_states", "temperatures", "humidity"):
        assert ends[f"/{name}"].reliability == ReliabilityPolicy.BEST_EFFORT, f"{name}: both kinds of sensor are heard"
    for name in ("tool_pose_estimate", "diagnostics", "compensator/markers"):
        assert ends[f"/{name}"].reliability == ReliabilityPolicy.RELIABLE, name


def test_quality_of_service_can_be_overridden(rig):
    overrides = {
        "qos_overrides./strut_states.subscription.reliability": "reliable",
        "qos_overrides./strut_commands.publisher.depth": 7,
    }
    node = rig.compensator(**overrides)
    ends = {end.topic_name: end.qos_profile for end in (*node.publishers, *node.subscriptions)}
    assert ends["/strut_states"].reliability == ReliabilityPolicy.RELIABLE
    assert ends["/strut_commands"].depth == 7
    assert ends["/strut_corrections"].depth == 100, "only what was named"


def test_two_machines_in_two_namespaces_do_not_mix(ros_context, capfd):
    here = (ros_context, capfd)
    with Bench(*here, "/left") as left, Bench(*here, "/right") as right:
        left.compensator(model_file="ideal")
        right.compensator()
        assert {"/left/strut_commands", "/right/strut_commands"} <= {
            name for name, _ in left.witness.get_topic_names_and_types()
        }
        left.ask(HOME)
        right.ask(near(HOME, STEP_BACK))
        left.ask(HOME)
        assert (len(left.seen["strut_commands"]), len(right.seen["strut_commands"])) == (2, 1)
        assert right.until_status(OK, "running")["model"] == "virtual machine"
        assert left.until_status(OK, "running")["model"] == "ideal"
        status = left.status()
        assert (status.name, status.hardware_id) == ("left/compensator: state", "left/paper")


@pytest.mark.parametrize(
    ("environment", "found"),
    [
        ({}, "LOCALHOST"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "SUBNET"),
        ({"ROS_STATIC_PEERS": "192.0.2.7"}, None),
    ],
)
def test_discovery_stays_on_this_machine_unless_told_otherwise(monkeypatch, environment, found):
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    keep_discovery_local()
    assert os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == found
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)


def test_standard_messages_on_the_topics_of_the_readme(bench):
    bench.add_publisher("strut_setpoints")
    bench.compensator(publish_array=True)
    found = dict(bench.witness.get_topic_names_and_types())
    for topic, kind in SENT.items():
        package = kind.__module__.split(".")[0]
        assert found[f"/{topic}"] == [f"{package}/msg/{kind.__name__}"]
    services = dict(bench.witness.get_service_names_and_types())
    assert services["/compensator/enable_compensation"] == ["std_srvs/srv/SetBool"]
    assert services["/compensator/reload_model"] == services["/compensator/reset"] == ["std_srvs/srv/Trigger"]
    assert bench.call(GetState, "compensator/get_state").current_state.label == "active"


def test_a_bare_start_corrects_nothing_and_says_so(rig):
    """Somebody else's errors must not move a machine whose model was not named."""
    rig.remove_publisher("strut_commands")
    rig.add(CompensatorNode, True, {"start_without_feedback_after": AT_ONCE})
    assert rig.logged("with the ideal model, which corrects nothing (parameter model_file)")
    answer = rig.settle(near(HOME, (0.01, 0.02, 0.03), 3.0))
    np.testing.assert_array_equal(answer.corrections, 0.0)
    rig.until_status(OK, "running")
    assert rig.values()["model"] == "ideal"


def test_a_shipped_model_is_found_by_name(rig):
    rig.compensator(model_file="paper_machine")
    shipped = yaml.safe_load((CONFIG / "paper_machine.yaml").read_text(encoding="utf-8"))
    rig.until(rig.status, "a status")
    assert rig.values()["model"] == shipped["name"]
    assert rig.logged(f"with model {shipped['name']!r}")
