"""Tools, work frames and travel at the node, and nominal strut lengths as its commands.

The truth is the zoo's own frames and kinematics, ``travel`` for its topic, and closed-form lengths.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from foreign_machines import Machine, machines, with_frames
from node_helpers import BEST_EFFORT, HOME, RELIABLE, Bench, closed_form_lengths, near
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from hexapod_comp.cli import main
from hexapod_comp.compensation.compensator import Compensator, pack_pose
from hexapod_comp.compensation.guards import Sample
from hexapod_comp.compensation.travel import travel
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import ERROR, LATCHED_QOS, OK, WARN
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.compensator_state import STRUTS
from hexapod_comp.ros.inputs import StrutInput
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.virtual.named import find_model

CLOSE = 1e-11  # m; quaternions have sixteen digits


@pytest.fixture
def machine() -> Machine:
    return with_frames("framed")


@pytest.fixture
def file(machine: Machine, tmp_path: Path) -> str:
    return str(machine.write(tmp_path / "machine.yaml"))


def at_home(machine: Machine, tool: str | None = None, work: str | None = None, shift: float = 0.0) -> Pose:
    """Return the tool's pose in a frame (None: the usual one) with a level platform raised above home."""
    used = machine.using(tool, work)
    x, y, z = machine.home
    tip = used.tips(np.array([[x, y, z + shift]]), np.eye(3)[None])[0]
    return Pose(tip, used.work.matrix.T @ used.tool.matrix)


def started(rig: Bench, file: str, **parameters: object) -> None:
    rig.compensator(geometry_file=file, model_file="ideal", **parameters)


# ---- frames ----


def test_the_frame_id_picks_the_work_frame(rig: Bench, machine: Machine, file: str) -> None:
    """The same place in three frames gives the struts of the zoo's own kinematics."""
    started(rig, file)
    truth = machine.lengths(np.array([machine.home]), np.eye(3)[None])[0]
    for frame in ("work", "fixture"):
        answer = rig.ask(at_home(machine, None, frame), frame)
        np.testing.assert_allclose(answer.lengths, truth, rtol=0.0, atol=CLOSE)
    tip = np.array(machine.home) + np.array(machine.tool.position)
    answer = rig.ask(Pose(tip, machine.tool.matrix), "base")
    np.testing.assert_allclose(answer.lengths, truth, rtol=0.0, atol=CLOSE)
    rig.send(at_home(machine), "fixtures")
    values = rig.until_status(ERROR, "refusing commands: frame_id")
    assert values["last_refusal"] == "frame_id must be one of base, work, fixture, not 'fixtures'"
    rig.send(at_home(machine), "")
    rig.until(lambda: rig.values().get("refused.frame_id") == "2")
    rig.until(lambda: rig.values()["frame_id"] == "base")


def test_frames_of_two_machines_have_prefixes(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file, base_frame="left_base", work_frame="left_work", frame_prefix="left_")
    rig.ask(at_home(machine, None, "fixture"), "left_fixture")
    rig.send(at_home(machine, None, "fixture"), "fixture")
    values = rig.until_status(ERROR, "refusing commands: frame_id")
    assert "left_base, left_work, left_fixture" in values["last_refusal"]


def test_two_frames_of_one_name_are_refused(rig: Bench, file: str) -> None:
    rig.compensator(start=False, geometry_file=file, model_file="ideal", work_frame="fixture")
    assert not rig.change("configure")
    assert rig.logged("parameter frame_prefix: work frame 'fixture' would have the frame_id")


# ---- tools ----


def test_the_parameter_changes_the_tool_and_nothing_moves(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    tools = rig.listen(String, "compensator/tool", LATCHED_QOS)
    before = rig.ask(at_home(machine), "work")
    assert rig.set_parameter("compensator", "tool", "probe").successful
    rig.send(at_home(machine), "work")
    values = rig.until_status(ERROR, "refusing commands: tool_changed")
    assert "after the change to tool 'probe' the first command must not move the struts" in values["last_refusal"]
    after = rig.ask(at_home(machine, "probe", "fixture"), "fixture")
    np.testing.assert_allclose(after.lengths, before.lengths, rtol=0.0, atol=CLOSE)
    estimate = message_pose(rig.estimate(after.command))
    tip = np.array(machine.home) + np.array(machine.tools["probe"].position)
    np.testing.assert_allclose(estimate.position, tip, rtol=0.0, atol=1e-10)
    rig.until(lambda: [rig.values().get(key) for key in ("tool", "frame_id")] == ["probe", "fixture"])
    rig.until(lambda: [message.data for message in tools][-1:] == ["probe"])


def test_a_controller_selects_a_tool_by_a_topic(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    select = rig.witness.create_publisher(String, "select_tool", RELIABLE)
    rig.until(select.get_subscription_count)
    rig.ask(at_home(machine), "work")
    select.publish(String(data="stub"))
    rig.until(lambda: rig.nodes[0].get_parameter("tool").value == "stub", "the tool")
    rig.ask(at_home(machine, "stub"), "work")
    select.publish(String(data="drill"))
    values = rig.until_status(WARN, "tool refused: parameter tool: machine framed has no tool 'drill'")
    assert (values["tool"], values["refused_tools"]) == ("stub", "1")
    # Commands for a tool that was not selected are refused at any distance.
    rig.send(at_home(machine, "stub", shift=1e-4), "work")
    rig.until_status(ERROR, "refusing commands: tool_changed")
    rig.ask(at_home(machine, "stub"), "work")


def test_a_stranger_who_selects_a_wrong_tool_stops_nothing(rig: Bench, machine: Machine, file: str, stranger) -> None:
    """Its sender does not command: the failed selection is reported, and the controller's next step is accepted."""
    started(rig, file)
    select = stranger.create_publisher(String, "select_tool", RELIABLE)
    rig.until(select.get_subscription_count)
    rig.ask(at_home(machine), "work")
    select.publish(String(data="drill"))
    values = rig.until_status(WARN, "tool refused: parameter tool: machine framed has no tool 'drill'")
    assert values["select_tool_by"] == "/stranger"
    rig.ask(at_home(machine, shift=1e-4), "work")


def test_of_two_who_select_tools_none_is_obeyed(rig: Bench, machine: Machine, file: str, stranger) -> None:
    started(rig, file)
    select = rig.witness.create_publisher(String, "select_tool", RELIABLE)
    other = stranger.create_publisher(String, "select_tool", RELIABLE)
    rig.until(lambda: select.get_subscription_count() and other.get_subscription_count())
    rig.ask(at_home(machine), "work")
    values = rig.until_status(ERROR, "select_tool ignored: several_publishers: several publishers of /select_tool")
    assert values["select_tool_by"] == "/stranger, /witness"
    for publisher in (select, other):
        publisher.publish(String(data="stub"))
    rig.until(lambda: rig.values().get("refused_tools") == "2")
    assert rig.values()["tool"] == "tool"
    rig.ask(at_home(machine, shift=1e-4), "work")


def test_the_tool_stays_while_the_machine_moves(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    rig.ask(at_home(machine), "work")
    rig.ask(at_home(machine, shift=2e-4), "work")
    answer = rig.set_parameter("compensator", "tool", "probe")
    assert not answer.successful
    assert answer.reason.startswith("parameter tool: stays 'tool' while the machine moves: strut_")
    assert rig.set_parameter("compensator", "tool", "tool").successful
    rig.ask(at_home(machine, shift=3e-4), "work")


def test_a_start_takes_the_tool_that_was_set(rig: Bench, machine: Machine, file: str) -> None:
    rig.compensator(start=False, geometry_file=file, model_file="ideal", tool="probe")
    assert rig.set_parameter("compensator", "tool", "drill").successful  # the machine is not known yet
    assert not rig.change("configure")
    assert rig.logged("cannot configure: machine framed has no tool 'drill'; it has tool, probe, stub")
    assert "parameter tool: " in rig.set_parameter("compensator", "tool", 3).reason
    rig.set_parameter("compensator", "tool", "stub")
    assert rig.change("configure")
    assert rig.change("activate")
    rig.until(rig.matched)
    truth = machine.lengths(np.array([machine.home]), np.eye(3)[None])[0]
    answer = rig.ask(at_home(machine, "stub"), "work")
    np.testing.assert_allclose(answer.lengths, truth, rtol=0.0, atol=CLOSE)


# ---- travel ----


def test_travel_is_answered_and_published_with_names_and_units(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    early = rig.call(Trigger, "compensator/get_travel")
    assert not early.success
    assert "the tool's pose is not known" in early.message
    rig.ask(at_home(machine), "work")
    rig.set_parameter("compensator", "tool", "probe")
    rig.ask(at_home(machine, "probe", "fixture"), "fixture")
    answer, busy = (rig._request(Trigger, "compensator/get_travel", Trigger.Request()) for _ in range(2))
    assert (busy.result().success, busy.result().message) == (False, "the travel is already being computed")
    rig.until(answer.done, "the travel")
    answer = answer.result()
    assert answer.success
    assert answer.message.startswith("tool probe in fixture at x, y, z ")
    geometry = load_geometry(file).using("probe", "fixture")
    ways = travel(RealMachine(geometry, MachineModel("framed")), at_home(machine, "probe", "fixture"))
    reports = rig.listen(DiagnosticStatus, "compensator/travel")
    rig.until(lambda: reports, "a report")
    for seconds, count in ((0.9, 1), (0.2, 2)):
        rig.step(seconds)
        assert len(reports) == count, "one a second"
    values = {entry.key: entry.value for entry in reports[0].values}
    for way in ways:
        assert float(values[way.key]) == pytest.approx(way.shown, abs=2e-6)
        assert values[f"{way.way} stops at"].partition(":")[0] == str(way.error).partition(":")[0]
        assert [way.way, f"{way.shown:.3f}", way.unit] in [line.split()[:3] for line in answer.message.splitlines()]
    assert reports[0].message == answer.message.partition("\n")[0]
    assert (reports[0].hardware_id, reports[0].name) == ("framed", "compensator: travel")


# ---- nominal strut lengths as commands, from a controller that knows no poses ----

POSES = 400  # poses on each machine
SAME = 1e-9  # tolerance of both ways, m; forward kinematics closes the loops to 1e-15 m of rounding


def setpoints(lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES) -> JointState:
    return JointState(name=list(names), position=[float(length) for length in lengths])


@pytest.mark.parametrize("name", machines())
def test_lengths_and_the_pose_they_belong_to_are_answered_alike(name: str, tmp_path: Path):
    """Poses on straight lines in the box, tilted by up to 3° about each axis, on a machine with random errors."""
    machine, rng = machines()[name], np.random.default_rng(3)
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    by_pose, by_struts = (Compensator(geometry, find_model("random:3", geometry)) for _ in range(2))
    given = StrutInput(by_struts, list(STRUT_NAMES), "base")
    corners, turns = rng.uniform(*machine.box, (3, 3)), np.radians(rng.uniform(-3.0, 3.0, (3, 3)))
    where = np.linspace(0.0, 2.0, POSES)
    tips, vectors = (np.stack([np.interp(where, range(3), c) for c in a.T], axis=1) for a in (corners, turns))
    tools = Rotation.from_rotvec(vectors)
    for tip, tool, length in zip(
        tips, tools.as_quat(), machine.lengths(*machine.platform_poses(tips, tools.as_matrix())), strict=True
    ):
        given.read(serialize_message(setpoints(length)), sample := Sample(0.0))
        answer = by_struts.step(sample.values, math.nan, pack_pose(Pose.identity()))
        np.testing.assert_allclose(answer, by_pose.step((*tip, *tool), math.nan), rtol=0.0, atol=SAME)
        np.testing.assert_allclose(by_struts.nominal, length, rtol=0.0, atol=SAME)


def ask(rig: Bench, lengths: np.ndarray, **others: float) -> JointState:
    """Send setpoints beside other joints; return the strut commands that answer them."""
    message = setpoints([*others.values(), *lengths], (*others, *STRUT_NAMES))
    message.header.stamp = rig.now()
    rig.publish("strut_setpoints", message)

    def answers() -> list[JointState]:
        return [m for m in rig.seen["strut_commands"][-5:] if m.header.stamp == message.header.stamp]

    rig.until(answers, "an answer to setpoints")
    return answers()[0]


def test_a_controller_of_struts_commands_the_node(rig: Bench):
    rig.add_publisher("strut_setpoints")
    rig.compensator(command_input=STRUTS, enable_compensation=False, max_command_age=60.0)
    at_home = closed_form_lengths(HOME)
    for _ in range(3):  # as ros2_control does until a controller is active
        rig.publish("strut_setpoints", setpoints([math.nan] * 6))
    rig.send(HOME)
    rig.barrier()
    values = rig.until_status(OK, "waiting for the first command")
    assert values["commands"] == "0"
    assert not any(value != "0" for key, value in values.items() if key.startswith("refused"))
    assert not rig.seen["strut_commands"]
    np.testing.assert_allclose(ask(rig, at_home, spindle=12.0).position, at_home, rtol=0, atol=SAME)
    further = closed_form_lengths(near(HOME, (0.0, 0.001, 0.0), 0.1))
    np.testing.assert_allclose(ask(rig, further).position, further, rtol=0, atol=SAME)
    rig.publish("strut_setpoints", setpoints(closed_form_lengths(near(HOME, (0.0, 0.0, 0.05)))))
    rig.until_status(ERROR, "refusing commands: step")
    for message, reason in (
        (setpoints([*at_home[:5], math.nan]), "not_finite"),
        (setpoints([0.5] * 5 + [2.0]), "unreachable"),
        (setpoints(at_home[:5], STRUT_NAMES[:5]), "strut_names"),
    ):
        rig.publish("strut_setpoints", message)
        rig.until_status(ERROR, f"refusing commands: {reason}")
    rig.until_status(WARN, "no new command")


def told(rig: Bench, measured: np.ndarray) -> np.ndarray:
    """Publish measured struts; return the nominal lengths that a controller gets."""
    seen: list[JointState] = []
    listener = rig.witness.create_subscription(JointState, "nominal_strut_states", seen.append, BEST_EFFORT)
    sent = rig.feed(measured)
    rig.until(lambda: [m for m in seen if m.header.stamp == sent.header.stamp], "nominal lengths of a reading")
    rig.witness.destroy_subscription(listener)
    assert tuple(seen[-1].name) == STRUT_NAMES
    return np.array(seen[-1].position)


def test_a_controller_that_starts_again_moves_no_strut(rig: Bench):
    """It commands the lengths that it has got, which are the closed form; repeating this changes nothing."""
    rig.add_publisher("strut_setpoints")
    rig.compensator(command_input=STRUTS, ramp_rate=1.0)
    at_home = closed_form_lengths(HOME)
    standing = told(rig, at_home)  # before any command: without the model's correction there
    assert np.abs(standing - at_home).max() > 5e-6
    np.testing.assert_allclose(ask(rig, standing).position, at_home, rtol=0, atol=SAME)
    for _ in range(3):
        command = np.array(ask(rig, at_home).position)
    assert np.abs(command - at_home).max() > 5e-6
    for _ in range(3):  # at each start from the readings
        standing = told(rig, command)
        np.testing.assert_allclose(standing, at_home, rtol=0, atol=SAME)
        np.testing.assert_allclose(ask(rig, standing).position, command, rtol=0, atol=SAME)
    np.testing.assert_allclose(told(rig, command + 1e-5), at_home + 1e-5, rtol=0, atol=SAME)  # the struts lag


def test_joints_go_by_the_machine_s_own_names(rig: Bench):
    names = [f"left_leg_{n}" for n in range(1, 7)]
    rig.compensator(joint_names=names, enable_compensation=False, feedback_timeout=60.0)
    rig.feed(closed_form_lengths(HOME))  # these names are not the configured ones
    rig.until(lambda: rig.logged("left_leg_1 is missing"), "a warning")
    answer = rig.ask(HOME)
    assert list(answer.command.name) == names
    rig.feed(closed_form_lengths(HOME)[::-1], tuple(reversed(names)))
    rig.until(lambda: rig.values().get("pose_estimated_from") == "strut_states", "feedback")


def test_joint_states_show_the_machine_where_its_struts_are(rig: Bench):
    rig.compensator(model_file="ideal", marker_rate=10.0)
    seen = rig.listen(JointState, "joint_states")
    pose = near(HOME, (0.003, -0.002, 0.01), 1.0)
    rig.feed(closed_form_lengths(pose))
    rig.until(lambda: seen and abs(seen[-1].position[list(seen[-1].name).index("platform_z")] - 0.41) < SAME, "pose")
    joints = dict(zip(seen[-1].name, seen[-1].position, strict=True))
    at = [joints[f"platform_{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(at, pose.position, rtol=0, atol=SAME)
    np.testing.assert_allclose([joints[n] for n in STRUT_NAMES], closed_form_lengths(pose), rtol=0, atol=SAME)


ASKEW = near(HOME, (0.01, 0.005, 0.0), 1.0)  # a pose at which all struts have different lengths


def test_before_ros2_control_arrays_are_in_joint_order(rig: Bench, tmp_path: Path):
    """The configuration is the exported one; the truth is closed-form lengths, all different."""
    assert main(["export", "--ros2-control", str(tmp_path)]) == 0
    words = ["--ros-args", "--params-file", str(tmp_path / "config" / "before.yaml")]
    words += ["-r", "strut_commands_array:=forward_command_controller/commands", "-r", "strut_states:=joint_states"]
    rig.add(CompensatorNode, True, {"enable_compensation": False}, cli_args=words)
    told = rig.listen(Float64MultiArray, "forward_command_controller/commands")
    publisher = rig.witness.create_publisher(JointState, "joint_states", 10)
    # As joint_state_broadcaster publishes them: by name, in its own order, beside other joints
    message = setpoints([12.0, *closed_form_lengths(ASKEW)[::-1]], ("spindle", *STRUT_NAMES[::-1]))

    def tell(key: str, value: str) -> bool:
        message.header.stamp = rig.now()
        publisher.publish(message)
        return value in rig.values().get(key, "")

    rig.until(lambda: tell("pose_estimated_from", "strut_states"), "feedback through joint_states")
    wanted = closed_form_lengths(ASKEW)
    assert len(set(wanted.round(6))) == 6
    rig.until(lambda: tell("pose_estimated_from", "") and (rig.send(ASKEW), told)[1], "an array")
    np.testing.assert_allclose(told[-1].data, wanted, rtol=0, atol=SAME)
