"""Nominal strut lengths as commands: from a controller that plans struts and knows nothing of poses.

Truth: strut lengths of foreign machines by the tests' own kinematics (closed form), and the answers to the tool poses
that these lengths belong to.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from node_helpers import BEST_EFFORT, HOME, Bench, closed_form_lengths, near
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from hexapod_comp.cli import main
from hexapod_comp.compensation.compensator import Compensator, pack_pose
from hexapod_comp.compensation.guards import Sample
from hexapod_comp.errors import CommandError, KinematicsError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.pose import Pose
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.interface import STRUTS, StrutInput
from hexapod_comp.ros.status import ERROR, OK, WARN
from hexapod_comp.virtual.named import find_model

POSES = 400
"""Of each machine."""

SAME = 1e-9
"""What the two ways may differ, m: forward kinematics closes the loops to rounding, some 1e-15 m."""


def setpoints(lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES) -> JointState:
    return JointState(name=list(names), position=[float(length) for length in lengths])


@pytest.mark.parametrize("name", machines())
def test_lengths_and_the_pose_they_belong_to_are_answered_alike(name: str, tmp_path: Path):
    """On straight lines in the box, tilted by up to 3° about each axis, on a machine with random errors."""
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


def test_who_cannot_be_told_is_refused_with_the_reason(paper: Compensator):
    given = StrutInput(paper, STRUT_NAMES, "base")
    at_home = closed_form_lengths(HOME)
    for lengths, names, error, text in (
        (at_home[:5], STRUT_NAMES[:5], CommandError, "strut_6 missing"),
        ([*at_home[:5], math.nan], STRUT_NAMES, CommandError, "finite"),
        ([0.5] * 5 + [2.0], STRUT_NAMES, KinematicsError, "."),
    ):
        with pytest.raises(error, match=text):
            given.read(serialize_message(setpoints(lengths, names)), Sample(0.0))


@pytest.fixture
def paper() -> Compensator:
    geometry = load_geometry(config_file("paper.yaml"))
    return Compensator(geometry, find_model("ideal", geometry))


def ask(rig: Bench, lengths: np.ndarray, **others: float) -> JointState:
    """Send setpoints beside other joints and return the strut commands that answer them."""
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
    rig.until_status(WARN, "no new command")


def told(rig: Bench, measured: np.ndarray) -> np.ndarray:
    """Measure struts and return what a controller of nominal lengths is told of them."""
    seen: list[JointState] = []
    listener = rig.witness.create_subscription(JointState, "nominal_strut_states", seen.append, BEST_EFFORT)
    sent = rig.feed(measured)
    rig.until(lambda: [m for m in seen if m.header.stamp == sent.header.stamp], "nominal lengths of a reading")
    rig.witness.destroy_subscription(listener)
    assert tuple(seen[-1].name) == STRUT_NAMES
    return np.array(seen[-1].position)


def test_a_controller_that_starts_again_moves_no_strut(rig: Bench):
    """It commands what it is told it stands at. Truth: closed-form lengths, and that told again nothing changes."""
    rig.add_publisher("strut_setpoints")
    rig.compensator(command_input=STRUTS, ramp_rate=1.0)
    at_home = closed_form_lengths(HOME)
    standing = told(rig, at_home)  # before any command: less what the model would correct there
    assert np.abs(standing - at_home).max() > 5e-6
    np.testing.assert_allclose(ask(rig, standing).position, at_home, rtol=0, atol=SAME)
    for _ in range(3):
        command = np.array(ask(rig, at_home).position)
    assert np.abs(command - at_home).max() > 5e-6
    for _ in range(3):  # each time that it starts from the readings
        standing = told(rig, command)
        np.testing.assert_allclose(standing, at_home, rtol=0, atol=SAME)
        np.testing.assert_allclose(ask(rig, standing).position, command, rtol=0, atol=SAME)
    np.testing.assert_allclose(told(rig, command + 1e-5), at_home + 1e-5, rtol=0, atol=SAME)  # the struts lag


def test_joints_go_by_the_machine_s_own_names(rig: Bench):
    names = [f"left_leg_{n}" for n in range(1, 7)]
    rig.compensator(joint_names=names, enable_compensation=False, feedback_timeout=60.0)  # on a busy computer too
    rig.feed(closed_form_lengths(HOME))  # under the usual names: nobody's
    rig.until(lambda: rig.logged("left_leg_1 missing"), "a warning")
    answer = rig.ask(HOME)
    assert list(answer.command.name) == names
    rig.feed(closed_form_lengths(HOME)[::-1], tuple(reversed(names)))
    rig.until(lambda: rig.values().get("pose_estimated_from") == "strut_states", "feedback")


def test_joint_states_show_the_machine_where_its_struts_are(rig: Bench):
    """Truth: closed-form lengths, and the pose that they belong to."""
    rig.compensator(model_file="ideal", marker_rate=10.0)
    seen: list[JointState] = []
    rig.witness.create_subscription(JointState, "joint_states", seen.append, 10)
    pose = near(HOME, (0.003, -0.002, 0.01), 1.0)
    rig.feed(closed_form_lengths(pose))
    rig.until(lambda: seen and abs(seen[-1].position[list(seen[-1].name).index("platform_z")] - 0.41) < SAME, "pose")
    joints = dict(zip(seen[-1].name, seen[-1].position, strict=True))
    at = [joints[f"platform_{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(at, pose.position, rtol=0, atol=SAME)
    np.testing.assert_allclose([joints[n] for n in STRUT_NAMES], closed_form_lengths(pose), rtol=0, atol=SAME)


# ---- before ros2_control ----


ASKEW = near(HOME, (0.01, 0.005, 0.0), 1.0)
"""A pose at which all struts differ."""


def test_before_ros2_control_arrays_are_in_joint_order(rig: Bench, tmp_path: Path):
    """By the configuration that the export writes. Truth: closed-form lengths, all different."""
    assert main(["export", "--ros2-control", str(tmp_path)]) == 0
    words = ["--ros-args", "--params-file", str(tmp_path / "config" / "before.yaml")]
    words += ["-r", "strut_commands_array:=forward_command_controller/commands", "-r", "strut_states:=joint_states"]
    rig.add(CompensatorNode, True, {"enable_compensation": False}, cli_args=words)
    told: list[Float64MultiArray] = []
    rig.witness.create_subscription(Float64MultiArray, "forward_command_controller/commands", told.append, 10)
    publisher = rig.witness.create_publisher(JointState, "joint_states", 10)
    # As joint_state_broadcaster publishes them: by name, in its own order, beside other joints.
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
