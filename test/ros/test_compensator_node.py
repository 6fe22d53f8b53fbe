"""The compensator node: every promise of its documentation, as seen by other nodes; with DDS only where needed.

Lengths are compared with a closed form of the paper's machine or with the paper's tables, not with the package's
results, except where the node must send exactly the core's result. test_states.py covers every state of the node.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import table_lengths, table_poses
from node_helpers import AT_ONCE, CONFIG, HOME, Bench, Rig, closed_form_lengths, equal, geometry_file, model_file, near
from node_stories import NEVER, ask, change, place, play, refuses, reset, send, warm
from rclpy.time import Time
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.guards import Guard
from hexapod_comp.compensation.journal import read_page
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.pose import Pose
from hexapod_comp.ros import base, keep_discovery_local, rclpy_compat
from hexapod_comp.ros.base import ERROR, OK, WARN, Flow
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.messages import message_pose, pose_message
from hexapod_comp.ros.outputs import JOURNAL_QOS
from hexapod_comp.ros.rclpy_compat import Throttle

ROUNDING = 1e-12  # m; a dozen operations on lengths below a metre round by a few 1e-16, and messages are exact
CLOSED = 1e-11  # m; Newton ends below 1e-13 m of strut length, and the inverse Jacobian of this machine is below 3


def same_pose(message: object, pose: Pose) -> None:
    equal(message_pose(message).position, pose.position, CLOSED)
    equal(message_pose(message).rotation, pose.rotation, CLOSED)


def values_of(rig: Bench, key: str, value: str) -> dict[str, str]:
    """Wait until the diagnostics have a value; return all values."""
    rig.until(lambda: rig.values().get(key) == value, f"{key} = {value}, not {rig.values().get(key)}")
    return rig.values()


# ---- commands and answers ----


def test_commands_are_the_papers_table_2(rig, tmp_path):
    """Without a model the paper's Table 1 gives its Table 2 to the printed digits (0.001 mm)."""
    wide = geometry_file(tmp_path, {"step_mm": 500.0, "speed_mm_s": 1e6})
    rig.compensator(geometry_file=wide, model_file="ideal")
    sent = np.array([rig.ask(pose).lengths for pose in table_poses()])
    np.testing.assert_allclose(sent, table_lengths(), rtol=0.0, atol=0.5001e-6)


def test_an_answer_is_named_stamped_and_exactly_what_the_core_computes(rig):
    """The correction is the command minus the closed form's nominal length, to rounding."""
    rig.compensator()
    geometry = load_geometry(CONFIG / "paper.yaml")
    core = Compensator(geometry, load_model(CONFIG / "paper_machine.yaml", geometry))
    for step in range(5):
        pose = near(HOME, (2e-4 * step, -1e-4 * step, 1e-4 * step), 0.03 * step)
        message = pose_message(pose, "base")
        message.header.stamp = rig.now()
        answer, record = rig.ask(message), core.correct(pose)
        for sent, wanted in ((answer.command, record.command), (answer.correction, record.correction)):
            assert (list(sent.name), sent.header.stamp) == (list(STRUT_NAMES), message.header.stamp)
            equal(sent.position, wanted)
            assert len(sent.velocity) == 6, "an empty velocity makes bags that some readers refuse"
            assert np.isfinite(sent.velocity).all()
        equal(answer.corrections, answer.lengths - closed_form_lengths(pose))
        assert np.abs(answer.corrections).max() > 20e-6, "the shipped machine is wrong by some 100 µm"


def test_zero_stamp_means_now(rig):
    rig.compensator()
    before = rig.now()
    rig.send(pose_message(HOME, "base"))
    rig.until(lambda: rig.seen["strut_commands"], "an answer")
    stamp, after = rig.seen["strut_commands"][0].header.stamp, rig.now()
    assert (before.sec, before.nanosec) <= (stamp.sec, stamp.nanosec) <= (after.sec, after.nanosec)


# ---- refusals ----

UPSIDE_DOWN = {"base_cone_deg": 180.0, "platform_cone_deg": 180.0}
SHORT = {"stroke_mm": [330.0, 509.99]}

BAD = {
    "NaN position": ({}, send(y_m=math.nan), "not_finite", "must be finite"),
    "zero quaternion": ({}, send(q=(0.0,) * 4), "quaternion", "norm 1 within 0.001, not 0"),
    "unknown frame": ({}, send(frame="map"), "frame_id", "one of base, work, not 'map'"),
    "old stamp": ({}, send(later=-2.0), "stamp_past", "2.0"),
    "future stamp": ({}, send(later=5.0), "stamp_future", "in the future, allowed 0.5 s"),
    "earlier than the last": ({}, send(later=-0.2), "stamp_order", "before the previous command"),
    "out of reach": ({}, send(z_m=2.0), "stroke", "outside the stroke 330.000…880.000 mm"),
    # Turned by 60° about z the struts are nearer to each other than at home
    "struts too near": ({"clearance_mm": 220.0}, send(q=(0.0, 0.0, 0.5, 0.75**0.5)), "clearance", "nearest strut"),
    "turned inside out": (UPSIDE_DOWN, send(z=-800), "assembly", "another assembly mode"),
    # The shipped model corrects 164 µm at home and 170 µm at 20° of tilt
    "correction": ({"correction_um": 166.0}, send(tilt=20), "correction", "larger than ±166 µm"),
    # At z = 401 mm the struts are 509.978 mm long, within the stroke only before correction
    "stroke of the compensated struts": (SHORT, send(z=1), "stroke", "compensated length 510."),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_command_is_refused_and_the_last_good_one_stands(rig, tmp_path, case):
    limits, step, reason, text = BAD[case]
    rig.compensator(geometry_file=geometry_file(tmp_path, limits))
    pages, good = rig.listen(String, "compensator/journal", JOURNAL_QOS), rig.ask(HOME)
    step(rig)
    values = rig.until_status(ERROR, f"refusing commands: {reason}")
    assert text in values["last_refusal"]
    entries = [entry.values for page in pages for entry in read_page(page.data).entries if entry.what == "refused"]
    assert [(entry["reason"], entry["text"]) for entry in entries] == [(reason, values["last_refusal"])]
    assert (values["refused"], values[f"refused.{reason}"], values["commands"]) == ("1", "1", "1")
    (line,) = rig.logged("command refused")
    assert line.startswith(f"command refused ({reason}): ")
    assert text in line
    after = rig.ask(place(z=0.01))
    stamps = [message.header.stamp for message in rig.seen["strut_commands"]]
    assert stamps == [good.command.header.stamp, after.command.header.stamp], "nothing in between"
    assert len(rig.seen["strut_corrections"]) == 2
    equal(after.lengths - after.corrections, closed_form_lengths(place(z=0.01)))


def test_a_further_guard_of_commands_is_checked_and_told_what_was_answered_or_forgotten(rig):
    """By the description of Guard; a command that another guard or a limit refuses is checked, but not accepted."""
    calls = []

    class Further(Guard):
        reason = "further"

        def check(self, sample):
            calls.append("check")
            super().check(sample)

        def accept(self, sample):
            calls.append(f"accept {sample.values[2]:g}")

        def reset(self):
            calls.append("reset")

    node, guard = rig.compensator(command_timeout=0.0), Further()
    node.command_guards = (*node.command_guards, guard)
    play(rig, [ask(), send(z=50), refuses("step"), reset])
    assert calls == ["check", "accept 0.4", "check", "reset"]
    guard.problem = "a text"
    play(rig, [send(), refuses("further: a text", refused__further="1")])


def test_a_stale_first_command_is_refused_for_its_stamp_and_resets_nothing(rig):
    """Allowed are 0.5 s. The journal of a start has the reset at the activation, and none for the refused command."""
    pages = rig.listen(String, "compensator/journal", JOURNAL_QOS)
    rig.compensator(**NEVER)
    rig.feed(closed_form_lengths(HOME))
    rig.step(0.1)
    pages.clear()
    play(rig, [send(later=-0.6), refuses("stamp_past")])
    rig.step(0.1)
    entries = [entry.what for page in pages for entry in read_page(page.data).entries]
    assert entries == ["refused"]


# ---- feedback and estimate ----


def test_estimate_from_measured_struts_by_name(rig):
    """Closed-form lengths of a pose, with the names in any order, give the pose with the stamp of the message."""
    rig.compensator(model_file="ideal", feedback_timeout=60.0)
    pose = place(10, -20, 30, 5.0)
    lengths, order = closed_form_lengths(pose), [3, 5, 0, 1, 4, 2]
    same_pose(rig.estimate(rig.feed(lengths[order], tuple(STRUT_NAMES[i] for i in order))), pose)
    values_of(rig, "pose_estimated_from", "strut_states")


def test_without_feedback_commands_give_50_estimates_a_second(rig):
    rig.compensator(model_file="ideal", command_timeout=0.0)
    rig.ask(HOME)
    rig.step(0.1)
    count = len(rig.seen["tool_pose_estimate"])
    for _ in range(100):
        rig.send(HOME)
        rig.step(0.01)
    assert len(rig.seen["tool_pose_estimate"]) - count == pytest.approx(50, abs=1)


def struts(which: int, value: float) -> Callable[[Rig], object]:
    """Publish measured struts at home, with one strut of another length, m."""
    lengths = closed_form_lengths(HOME)
    lengths[which - 1] = value
    return lambda rig: rig.feed(lengths)


def row(count: int, *names: str) -> Callable[[Rig], object]:
    """Publish the lengths of the first struts at home under these names."""
    return lambda rig: rig.feed(closed_form_lengths(HOME)[:count], names)


SIX = STRUT_NAMES
BAD_READINGS = {
    "NaN": (struts(3, math.nan), "not_finite", "must be finite"),
    "other names": (row(6, *"abcdef"), "strut_names", "named once: strut_1 is missing"),
    "five positions": (row(5, *SIX), "strut_count", "need 6 positions, but there are 5"),
    "too short": (struts(5, 0.05), "stroke", "strut_5 cannot be 50.000 mm long"),
    # Struts 1 and 2 share a platform joint; with feet 0.243 m apart, lengths of 0.879 and 0.509 m cannot meet
    "no machine stands so": (struts(1, 0.879), "", "strut_states ignored"),
    "an unknown part": (warm("spindle", 25.0), "temperature", "found 'spindle'"),
    "kelvins": (warm("base", 293.15), "temperature", "must lie within -40…120 °C (found 293.15)"),
}


@pytest.mark.parametrize("case", BAD_READINGS)
def test_a_bad_reading_is_ignored_counted_and_logged(rig, case):
    step, reason, text = BAD_READINGS[case]
    rig.compensator(ramp_rate=1.0)
    step(rig)
    values = rig.until_status(ERROR, f"bad feedback: {reason}")
    assert values["bad_feedback"] == "1"
    assert values["refused"] == "0", "no command has been refused"
    (line,) = rig.logged(text)
    assert values["last_bad_feedback"] in line
    assert not rig.seen["tool_pose_estimate"]
    assert not [key for key in values if key.startswith("temperature.")]


# ---- temperatures ----


def expanding(folder: Path, **parameters: object) -> dict[str, object]:
    """Return the parameters of a compensator whose struts grow by 12 ppm/K, with an immediate ramp."""
    model = model_file(folder, struts={"expansion_ppm_per_K": 12.0})
    loose = {"temperature_rate_limit": 0.0, "temperature_spread_limit": 0.0, "command_timeout": 0.0}
    return {"model_file": model, "ramp_rate": 1.0, **loose, **parameters}


def grown(kelvin: float, strut: int = 3) -> float:
    """Return the change of the command at home, m, of a strut that has warmed by some kelvins: L/(1 + g) − L."""
    nominal = closed_form_lengths(HOME)[strut - 1]
    return float(nominal / (1.0 + 12e-6 * kelvin) - nominal)


@pytest.mark.parametrize(("time_constant", "taken"), [(3600.0, 26.0), (0.0, 27.0)], ids=["filtered", "off"])
def test_readings_are_filtered(rig, tmp_path, time_constant, taken):
    """Two readings within seconds count equally in a mean over an hour; 1 nm corresponds to 0.6 s of difference."""
    rig.compensator(**expanding(tmp_path, temperature_time_constant_s=time_constant))
    play(rig, [warm("strut_3", 25.0), warm("strut_3", 27.0)])
    values_of(rig, "temperature.strut_3_degC", f"{taken:.2f}")
    assert rig.ask(HOME).corrections[2] == pytest.approx(grown(taken - 20.0), rel=0.0, abs=10e-9)


def test_temperatures_of_an_inactive_node_act_on_activation_and_ramp(rig, tmp_path):
    """The first command after activation uses the temperature at once; a node that has moved before ramps to it."""
    settings = {"ramp_rate": 0.005, "max_command_age": 0.0, "temperature_time_constant_s": 0.0}
    rig.compensator(start=False, **expanding(tmp_path, **settings))
    play(rig, [change("configure"), warm("strut_3", 25.0), change("activate")])
    first = rig.ask(HOME)
    assert first.corrections[2] == pytest.approx(grown(5.0), rel=0.0, abs=ROUNDING)
    play(rig, [change("deactivate"), warm("strut_3", 80.0), change("activate")])
    assert abs(rig.ask(HOME).corrections[2] - first.corrections[2]) <= 0.005 * 0.02 + ROUNDING, "20 ms at most"
    assert rig.settle(HOME).corrections[2] == pytest.approx(grown(60.0), rel=0.0, abs=ROUNDING)


def test_struts_that_swell_follow_the_humidity(rig, tmp_path):
    """From 50 to 60 % a strut of 2 ppm per % grows by 20 ppm: its command is L/(1 + 20e-6), to 1e-15 m."""
    swelling = model_file(tmp_path, struts={"moisture_ppm_per_percent": 2.0})
    rig.compensator(model_file=swelling, command_timeout=0.0, ramp_rate=1.0)
    dry = rig.ask(HOME)
    assert not dry.corrections.any()
    rig.until_status(WARN, "humidity not received; taken as 50 %")
    rig.publish_humidity(0.6)
    equal(rig.settle(HOME).lengths, dry.lengths / (1.0 + 20e-6), 1e-15)
    assert values_of(rig, "humidity_percent", "60.0")["humidity_by"] == "/witness"


# ---- lifecycle ----


@pytest.mark.parametrize(
    ("limits", "said"),
    [({"step_mm": -1.0}, "limits.step"), ({"correction_um": 100.0}, "larger than ±100 µm")],
    ids=["a bad file", "home out of limits"],
)
def test_what_cannot_be_configured_says_why_and_may_be_mended(rig, tmp_path, limits, said):
    """The shipped model corrects 164 µm at home: with a limit of 100 µm the machine cannot be at home."""
    path = geometry_file(tmp_path, limits)
    node = rig.compensator(start=False, geometry_file=path)
    assert not rig.change("configure")
    assert rig.state() == "unconfigured"
    (line,) = rig.logged("cannot configure")
    assert said in line
    node.publish_last_status()
    geometry_file(tmp_path)
    play(rig, [change("configure", "activate"), ask()])


# ---- parameters ----


def test_what_is_given_by_other_names_or_types(rig):
    """An integer is accepted for a double, and QoS overrides are accepted; a misspelt name is reported."""
    override = {"qos_overrides./tool_pose_command.subscription.depth": 3}
    rig.compensator(use_sim_time=False, command_timeout=1, ramp_rate=1, marker_rate=5, **override)
    rig.ask(HOME)
    assert rig.logged("ready")
    assert not rig.logged("there is no parameter")
    assert rig.compensator(start=False, comand_timeout=1.0).wants_autostart is True
    (line,) = rig.logged("comand_timeout")
    assert line == "there is no parameter comand_timeout, so its value is ignored; did you mean command_timeout?"


# ---- diagnostics ----


STATUS, DRIVE_STATUS = Path(__file__).with_name("status.txt").read_text(encoding="utf-8").split("\n\n")


def pairs(text: str) -> dict[str, str]:
    return dict(pair.split(": ", 1) for pair in re.split(r"; |\n", text.strip("\n")))


def test_diagnostics_once_a_second_and_complete(rig):
    """The drive publishes 500 readings a second; of two commands 1.5 s apart the second is 1.1 s old."""
    node = rig.compensator(following_error_limit=0.0)
    rig.drive(encoder_noise=0.0)
    rig.step(0.3)
    status = rig.statuses()[0]
    assert (status.name, status.hardware_id) == ("compensator: state", "paper")
    assert (status.level, status.message) == (OK, "waiting for the first command")
    assert rig.values()["command_age_s"] == "never"
    rig.ask(HOME)
    play(rig, [warm("strut_3", 25.0), send(frame="map")])
    rig.publish_humidity(0.6)
    rig.step(1.5)
    stamp = rig.ask(place(z=1)).command.header.stamp
    rig.step(1.2)
    assert rig.values() == pairs(STATUS) | {
        "last_answered": f"{stamp.sec}.{stamp.nanosec:09d}",
        "largest_correction_m": f"{np.abs(node.compensator.correction).max():.9f}",
        "condition_number": f"{node.compensator.condition:.3f}",
    }
    assert rig.values("strut_drive") == pairs(DRIVE_STATUS)
    assert rig.message() == rig.message("strut_drive") == "no new command"
    times = [Time.from_msg(array.header.stamp).nanoseconds for array in rig.seen["/diagnostics"]]
    assert max(np.diff(times)) <= 1.05e9


def test_log_lets_one_line_per_cause_and_second_through(monkeypatch):
    clock = iter([0.0, 0.4, 0.5, 0.9, 1.1, 1.6])
    monkeypatch.setattr(rclpy_compat, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    throttle = Throttle()
    causes = ["nan", "nan", "step", "nan", "nan", "step"]
    said = ["it", None, "it", None, "it (2 more suppressed)", "it"]
    assert [throttle.allow(cause, "it") for cause in causes] == said


def test_rate_and_age_of_a_flow(monkeypatch):
    """250 events in 2 s are 125 a second."""
    monkeypatch.setattr(base, "time", SimpleNamespace(monotonic=lambda: 10.0))
    flow = Flow()
    assert flow.age(11.0) == math.inf
    for n in range(250):
        flow.tick(10.0 + n / 125.0)
    assert flow.rate(12.0) == pytest.approx(125.0)
    assert flow.rate(12.5) == pytest.approx(125.0), "over the last full second"
    assert flow.rate(14.0) == 0.0
    assert flow.age(14.0) == pytest.approx(14.0 - 10.0 - 249 / 125.0)


# ---- markers and mirror ----


GREY, STEEL = (0.5, 0.5, 0.55, 1.0), (0.3, 0.35, 0.45, 0.9)

DRAWN = [
    (Marker.LINE_LIST, 0.02, (0.0, 0.0, 0.0, 1.0), 12),
    (Marker.SPHERE_LIST, 0.035, GREY, 12),
    (Marker.LINE_STRIP, 0.02, STEEL, 7),
    (Marker.LINE_STRIP, 0.02, GREY, 7),
    (Marker.ARROW, 0.02, STEEL, 2),
]
"""Struts, joints, platform, base and tool: kind, diameter, m, colour and number of points."""


def test_markers_show_the_machine_as_it_stands(rig, tmp_path):
    """Drawn lengths are the closed form's; colours are blue from −100 µm of correction down, red from +100 µm up."""
    rig.compensator(model_file=model_file(tmp_path, struts={"offset_um": [100.0, -100.0, -50.0, 0.0, 300.0, 0.0]}))
    pose = near(HOME, (0.01, 0.0, 0.02), 3.0)
    rig.ask(pose)
    drawn = rig.listen(MarkerArray, "compensator/markers")
    rig.until(lambda: drawn, "markers")
    markers = drawn[0].markers
    for number, (marker, (kind, size, colour, count)) in enumerate(zip(markers, DRAWN, strict=True)):
        head, c, turn = marker.header, marker.color, marker.pose.orientation
        assert (marker.ns, marker.id, marker.type, marker.action) == ("hexapod", number, kind, Marker.ADD)
        assert (head.frame_id, head.stamp.sec > 0, marker.lifetime.sec, len(marker.points)) == ("base", True, 1, count)
        assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)
        assert (marker.scale.x, marker.scale.y, marker.scale.z) == (size,) * 3
        assert (c.r, c.g, c.b, c.a) == pytest.approx(colour)
    end, tip = ([p.x, p.y, p.z] for p in markers[4].points)
    equal(end, pose.position)
    equal(tip, pose.position + 0.1 * pose.rotation[:, 2], CLOSED)
    struts = next(marker for marker in markers if marker.type == marker.LINE_LIST)
    points = np.array([[p.x, p.y, p.z] for p in struts.points]).reshape(6, 2, 3)
    lengths = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    np.testing.assert_allclose(lengths, closed_form_lengths(pose), rtol=0.0, atol=1e-11)
    colours = np.array([[c.r, c.g, c.b] for c in struts.colors[::2]])
    expected = [[0, 0, 1], [1, 0, 0], [1, 0.5, 0.5], [1, 1, 1], [0, 0, 1], [1, 1, 1]]
    np.testing.assert_allclose(colours, expected, atol=1e-6)  # messages have float32


@pytest.mark.parametrize("asked", [True, False])
def test_what_is_published_only_where_it_is_asked_for(rig, asked):
    rig.compensator(publish_array=asked, marker_rate=10.0 if asked else 0.0)
    answer, drawn = rig.ask(HOME), rig.listen(MarkerArray, "compensator/markers")
    rig.step(0.3)
    arrays = [list(message.data) for message in rig.seen["strut_commands_array"]]
    assert arrays == [list(answer.command.position)] * asked
    assert rig.witness.count_publishers("strut_commands_array") == asked
    assert bool(drawn) is asked


# ---- topics ----


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


def test_a_bare_start_corrects_nothing_and_says_so(rig):
    """A node started without a model must not move a machine by the errors of another one."""
    rig.remove_publisher("strut_commands")
    rig.add(CompensatorNode, True, {"start_without_feedback_after": AT_ONCE})
    assert rig.logged("with the ideal model, which corrects nothing (parameter model_file)")
    answer = rig.settle(near(HOME, (0.01, 0.02, 0.03), 3.0))
    np.testing.assert_array_equal(answer.corrections, 0.0)
    rig.until_status(OK, "running")
    assert rig.values()["model"] == "ideal"
    assert rig.trigger("reload_model").message == "model 'ideal' ramps in"
    rig.enable(False)
    assert rig.trigger("reload_model").message == "model 'ideal' is loaded; the compensation is off"
