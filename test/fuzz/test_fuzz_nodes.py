"""Messages, pins and services of any content, in any order: nodes do not die, and keep their limits.

Truth: the geometry file's limits; the closed form of the paper machine's strut lengths; IEEE 754 and ROS for what is no
number and no rotation; SciPy's rotations and LinuxCNC's meaning of its axes and tool length (doc/linuxcnc.md)."""

from __future__ import annotations

import importlib
import math
import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from fuzz_rig import (
    HOME_LENGTHS,
    Rig,
    any_message,
    anything,
    floats,
    lengths,
    small_model,
    stamp_into,
    stamps,
    struts,
    struts_action,
    texts,
    tick,
    transition,
)
from fuzzing import COUNTS, cases
from geometry_msgs.msg import PoseStamped
from hal_stand_in import StandInHal
from hypothesis import example, given
from hypothesis import strategies as st
from node_helpers import AT_ONCE, HOME, Bench, closed_form_lengths
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_srvs.srv import Trigger
from strategies import paper_geometry

from hexapod_comp.linuxcnc.bridge import (
    AXES,
    CORRECTIONS,
    FEEDBACK,
    LONGEST_STEP,
    SWITCHES,
    GuardStatus,
    LinuxcncBridgeNode,
)
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.strut_drive import StrutDriveNode

LIMITS = paper_geometry().limits

# What mostly is right: a good message with a few things changed.

moves = st.lists(st.floats(-3e-4, 3e-4), min_size=3, max_size=3)
changes = st.one_of(st.just([]), st.just([]), st.lists(st.tuples(st.integers(0, 6), floats), max_size=2))
frames = st.one_of(st.just("base"), st.just("base"), st.just("work"), texts)
parts = st.one_of(st.sampled_from((*STRUT_NAMES, "base", "platform")), texts)
pose_action = st.tuples(st.just("pose"), moves, changes, frames, stamps)
actions_on_compensator = st.one_of(
    pose_action,
    pose_action,
    pose_action,
    struts_action(lengths),
    st.tuples(st.just("temperature"), parts, floats),
    tick,
    transition,
    anything,
    st.tuples(st.just("message"), st.just("tool_pose_command"), any_message(PoseStamped)),
    st.tuples(st.just("message"), st.just("strut_states"), any_message(JointState)),
    st.tuples(st.just("message"), st.just("temperatures"), any_message(Temperature)),
    st.tuples(st.just("message"), st.just("humidity"), any_message(RelativeHumidity)),
)


class CompensatorRig(Rig):
    """A compensator, and what is known of it from outside: the last command."""

    def __init__(self, context: Any, model: str) -> None:
        # Struts that are not where they were told stop the machine (tested elsewhere): here they may be anywhere.
        options = {"following_error_limit": 0.0, "marker_rate": 0.0, "publish_array": True, "model_file": model}
        options["start_without_feedback_after"] = AT_ONCE
        super().__init__(context, CompensatorNode, options)
        self.last: np.ndarray | None = None

    def pose(self, action: tuple) -> None:
        """Send a command, and check what comes of it."""
        _, move, edits, frame, stamp = action
        numbers = np.array([*(HOME.position + move), 0.0, 0.0, 0.0, 1.0])
        for index, value in edits:
            numbers[index] = value
        message = PoseStamped()
        message.header.frame_id = frame
        stamp_into(message, stamp)
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z, q.x, q.y, q.z, q.w = numbers.tolist()
        was_active = self.active
        self.deliver("tool_pose_command", message)
        answers, corrections = self.took("strut_commands"), self.took("strut_corrections")
        arrays = self.took("strut_commands_array")
        assert len(answers) == len(corrections) == len(arrays) <= 1
        with np.errstate(over="ignore"):
            sane = np.isfinite(numbers).all() and abs(np.linalg.norm(numbers[3:]) - 1.0) < 2e-3
        if not answers:
            return
        assert was_active
        assert sane
        assert frame in ("base", "work")
        sent = (message.header.stamp.sec, message.header.stamp.nanosec)
        assert sent == (0, 0) or answers[0][3] == sent
        self.check(answers[0], corrections[0], arrays[0], numbers)

    def check(self, answer: tuple, correction: tuple, array: Any, numbers: np.ndarray) -> None:
        """Check what was published against the limits and the closed form."""
        names, command, velocity, _ = answer
        assert names == list(STRUT_NAMES)
        assert np.isfinite([command, velocity, correction[1]]).all()
        assert list(array.data) == command.tolist()
        assert (command >= LIMITS.stroke[:, 0]).all()
        assert (command <= LIMITS.stroke[:, 1]).all()
        assert np.abs(correction[1]).max() <= LIMITS.correction
        pose = Pose.from_quaternion(numbers[:3], numbers[3:])
        np.testing.assert_allclose(command - correction[1], closed_form_lengths(pose), atol=1e-12)
        if self.last is not None:
            assert np.abs(command - self.last).max() <= LIMITS.step * (1.0 + 1e-12)
        self.last = command

    def play(self, action: tuple) -> None:
        """Do one thing to the node."""
        kind = action[0]
        super().play(action)
        if kind == "pose":
            self.pose(action)
        elif kind == "struts":
            self.deliver("strut_states", struts(action))
        elif kind == "temperature":
            message = Temperature(temperature=action[2])
            message.header.frame_id = action[1]
            self.deliver("temperatures", message)
        elif kind in ("transition", "any", "message"):
            self.last = None  # it may have been a reset, or by chance a good command
        for estimate in self.took("tool_pose_estimate"):
            assert np.isfinite(estimate).all()
        for topic in ("strut_commands", "strut_corrections", "strut_commands_array"):
            assert not self.took(topic) or kind in ("any", "message")
        for report in self.took("/diagnostics"):
            said = [text for status in report.status for entry in status.values for text in (entry.key, entry.value)]
            assert sum(map(len, said)) < 20_000

    def answers_the_next_good_command(self) -> None:
        """Check that the node still lives: reset, with struts at home, it answers home, and 0.1 mm beside it."""
        self.activate()
        status = self.node._status  # as if they had stood for a while: a reset in motion is refused
        status.track._told.clear()
        status.track._read.clear()
        assert self.serve("reset", Trigger.Request()).success
        self.last = None
        status.track._jumps.at -= 10.0  # and struts that were elsewhere had had the time to come back
        self.deliver("strut_states", struts(("struts", list(STRUT_NAMES), HOME_LENGTHS.tolist(), [0.0] * 6, 0.0)))
        for move in ([0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]):
            self.pose(("pose", move, [], "base", 0.0))
            assert self.last is not None, self.node._status.refusals.last_text
            self.deliver("strut_states", struts(("struts", list(STRUT_NAMES), self.last.tolist(), [0.0] * 6, 0.0)))
        self.tick()
        self.sent.clear()


@pytest.fixture(scope="module")
def compensator(module_context: Any, tmp_path_factory: pytest.TempPathFactory) -> CompensatorRig:
    return CompensatorRig(module_context, small_model(tmp_path_factory))


@given(actions=st.lists(actions_on_compensator, min_size=1, max_size=12))
@example(actions=[("transition", number, "") for number in (3, 2, 1, 1, 4, 2, 0, 99, 3)])
@cases(60, 0.1)
def test_compensator(compensator: CompensatorRig, actions: list) -> None:
    COUNTS["compensator"] += 1
    for action in actions:
        compensator.play(action)
    compensator.answers_the_next_good_command()


# Over DDS.


def refused_requests(bench: Bench) -> None:
    """Check that requests at which rclpy's own services raise are answered: each of them ended the node's process."""
    assert not bench.change("configure")  # it is active
    services = importlib.import_module("rcl_interfaces.srv")
    wrong = Parameter("rate", value=1).to_parameter_msg()
    wrong.value.type = 255
    for name in ("SetParameters", "SetParametersAtomically"):
        request = getattr(services, name).Request(parameters=[wrong])
        topic = "set_parameters" + ("_atomically" if name.endswith("ly") else "")
        response = bench.call(getattr(services, name), f"compensator/{topic}", request)
        results = response.results if name == "SetParameters" else [response.result]
        assert [result.successful for result in results] == [False]


def test_over_dds(ros_context: Any, capfd: Any) -> None:
    """The same through the middleware: any messages at all, then a good command is answered."""
    random = np.random.default_rng(11)
    with Bench(ros_context, capfd) as bench:
        bench.compensator(following_error_limit=0.0)
        for _ in range(200):
            numbers = random.choice([0.0, 1.0, 0.4, math.nan, math.inf, -1e300, 5e-324, 0.1], 7).tolist()
            message = PoseStamped()
            message.header.frame_id = str(random.choice(["base", "", "wörk", "base\n"]))
            p, q = message.pose.position, message.pose.orientation
            p.x, p.y, p.z, q.x, q.y, q.z, q.w = numbers
            bench.publish("tool_pose_command", message)
            size = int(random.integers(0, 9))
            bench.publish("strut_states", JointState(name=["strut_1"] * size, position=[math.nan] * (size // 2)))
            bench.publish("temperatures", Temperature(temperature=numbers[0]))
            COUNTS["dds messages"] += 3
        bench.barrier()
        refused_requests(bench)
        assert bench.trigger("reset").success
        answer = bench.ask(HOME)
        np.testing.assert_allclose(answer.lengths - answer.corrections, HOME_LENGTHS, atol=1e-12)
        for message in bench.seen["strut_commands"]:
            assert np.isfinite(message.position).all()
            assert (np.array(message.position) >= LIMITS.stroke[:, 0]).all()
            assert (np.array(message.position) <= LIMITS.stroke[:, 1]).all()


# ---- the drive ----


class DriveRig(Rig):
    """A strut drive."""

    def __init__(self, context: Any, truth: str) -> None:
        super().__init__(context, StrutDriveNode, {"rate": 1000.0, "truth_file": truth})
        self.obeyed = HOME_LENGTHS

    def deliver(self, topic: str, message: Any) -> None:
        """Deliver a message, and remember commands that were obeyed: the next may be only a step away."""
        before = self.node._commands.count
        super().deliver(topic, message)
        if self.node._commands.count > before:
            told = dict(zip(message.name, message.position, strict=True))
            self.obeyed = np.array([told[name] for name in STRUT_NAMES])

    def play(self, action: tuple) -> None:
        """Do one thing to the node, and check its readings."""
        super().play(action)
        if action[0] == "struts":
            self.deliver("strut_commands", struts(action))
        lost = self.node._options["fault_encoder_lost"]
        for names, position, velocity, _ in self.took("strut_states"):
            assert names == list(STRUT_NAMES)
            there = np.ones(6, dtype=bool)
            there[lost - 1] = not lost
            assert np.isfinite([position[there], velocity[there]]).all()
            noise = 1e-6  # twenty standard deviations of the encoder's
            assert (position[there] >= LIMITS.stroke[there, 0] - noise).all()
            assert (position[there] <= LIMITS.stroke[there, 1] + noise).all()
        for pose in self.took("tool_pose_true"):
            assert np.isfinite(pose).all()
        self.took("/diagnostics")

    def follows_the_next_good_command(self) -> None:
        """Check that the node still lives: the last good command is good again, and without faults it is read."""
        self.activate()
        self.serve("set_parameters", no_faults())
        before = self.node._commands.count
        self.deliver("strut_commands", struts(("struts", list(STRUT_NAMES), self.obeyed.tolist(), [], 0.0)))
        assert self.node._commands.count == before + 1, self.node._refusals.last_text
        self.tick()
        time.sleep(2e-3)
        self.tick()
        assert self.took("strut_states")
        self.sent.clear()


def no_faults() -> Any:
    """Return the request that takes all faults back."""
    request = SetParameters.Request()
    values = {"fault_stuck_strut": 0, "fault_encoder_lost": 0, "fault_feedback_delay": 0.0, "fault_feedback_drop": 0.0}
    request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return request


@pytest.fixture(scope="module")
def drive(module_context: Any, tmp_path_factory: pytest.TempPathFactory) -> DriveRig:
    return DriveRig(module_context, small_model(tmp_path_factory))


actions_on_drive = st.one_of(
    struts_action(lengths),
    struts_action(lengths),
    tick,
    transition,
    anything,
    st.tuples(st.just("message"), st.just("strut_commands"), any_message(JointState)),
)


@given(actions=st.lists(actions_on_drive, min_size=1, max_size=12))
@cases(60, 0.05)
def test_drive(drive: DriveRig, actions: list) -> None:
    COUNTS["drive"] += 1
    for action in actions:
        drive.play(action)
    drive.follows_the_next_good_command()


# ---- the LinuxCNC bridge ----


MM = 1e-3
LIMIT, RAMP = 500e-6, 10e-3
ROUNDING = 1e-15

NOW = 1e-9  # Stamp of a message that answers a command of just now, s from now; 0 would be none

corrections = st.one_of(
    st.lists(st.floats(-1.2 * LIMIT, 1.2 * LIMIT), min_size=6, max_size=6),
    st.lists(st.floats(-LIMIT, LIMIT), min_size=6, max_size=6),
    st.lists(floats, max_size=8),
)
pins = st.one_of(
    st.tuples(st.sampled_from(AXES + FEEDBACK), st.one_of(st.floats(-400.0, 400.0), floats)),
    st.tuples(st.sampled_from(SWITCHES), st.booleans()),
)
good_correction = st.lists(st.floats(-LIMIT, LIMIT), min_size=6, max_size=6).map(
    lambda values: ("struts", list(STRUT_NAMES), values, [], NOW)
)
actions_on_bridge = st.one_of(
    st.tuples(st.just("pins"), st.lists(pins, min_size=1, max_size=4)),
    struts_action(corrections),
    good_correction,
    tick,
    tick,
    tick,
    transition,
    anything,
    st.tuples(st.just("message"), st.just("strut_corrections"), any_message(JointState)),
    st.tuples(st.just("message"), st.just("diagnostics"), any_message(DiagnosticArray)),
)


class BridgeRig(Rig):
    """A bridge, and the pins that LinuxCNC would read and write."""

    def __init__(self, context: Any) -> None:
        self.hal = StandInHal()
        options = {"limit": LIMIT, "ramp_rate": RAMP, "timeout": 1.0}
        super().__init__(context, LinuxcncBridgeNode, options, hal=self.hal)

    def play(self, action: tuple) -> None:
        """Do one thing to pins or node, and check what comes of it."""
        super().play(action)
        if action[0] == "pins":
            for name, value in action[1]:
                self.hal[name] = value
        elif action[0] == "struts":
            self.deliver("strut_corrections", struts(action))
        self.check_pins()
        self.check_topics()

    def check_pins(self) -> None:
        """Check what LinuxCNC has been given since the last time."""
        for name in CORRECTIONS:
            written = [value for _, value in self.hal.pins[name].written]
            assert np.isfinite(written).all()
            assert max(map(abs, written), default=0.0) * MM <= LIMIT + ROUNDING
            assert all(abs(b - a) * MM <= RAMP * LONGEST_STEP + ROUNDING for a, b in pairwise(written))
        assert self.hal["status"] in list(GuardStatus)
        assert math.isfinite(self.hal["age"])
        assert 0.0 <= self.hal["largest"] * MM <= LIMIT + ROUNDING
        for pin in self.hal.pins.values():
            del pin.written[:-1]

    def check_topics(self) -> None:
        """Check commanded poses and measured struts against the pins."""
        axes = np.array([self.hal[name] for name in AXES])
        for pose in self.took("tool_pose_command"):
            assert np.isfinite(pose).all()
            position, rotation = expected_pose(axes)
            np.testing.assert_allclose(pose[:3], position, rtol=0.0, atol=1e-12 * (1.0 + np.abs(axes).max()))
            np.testing.assert_allclose(Rotation.from_quat(pose[3:]).as_matrix(), rotation, atol=1e-12)
        feedback = np.array([self.hal[name] for name in FEEDBACK])
        for who, position, velocity, _ in self.took("strut_states"):
            assert who == list(STRUT_NAMES)
            assert np.isfinite([position, velocity]).all()
            np.testing.assert_allclose(position, feedback * MM, rtol=1e-15)
        self.took("/diagnostics")

    def passes_on_the_next_good_correction(self) -> None:
        """Check that the bridge still lives: with good pins, it commands and passes a correction on."""
        self.activate()
        good = {**dict.fromkeys(AXES, 0.0), **dict.fromkeys(FEEDBACK, 600.0), **dict.fromkeys(SWITCHES, True)}
        self.play(("pins", list(good.items())))
        self.play(("tick",))  # shows what was passed on before
        updates = self.hal["updates"]
        self.deliver("strut_corrections", struts(("struts", list(STRUT_NAMES), [1e-4] * 6, [], NOW)))
        self.tick()
        assert self.hal["updates"] == updates + 1, self.node._refusals.last_text
        assert self.hal["status"] in (GuardStatus.RAMPING, GuardStatus.COMPENSATING)
        assert self.took("tool_pose_command")
        self.check_pins()
        self.sent.clear()


def expected_pose(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position, m, and rotation matrix that LinuxCNC's axes (mm, degrees, tool length) mean."""
    rotation = Rotation.from_euler("xyz", axes[3:6], degrees=True).as_matrix()
    along = np.array([0.0, 0.0, axes[6]])
    return (axes[:3] - along + rotation @ along) * MM, rotation


@pytest.fixture(scope="module")
def bridge(module_context: Any) -> BridgeRig:
    return BridgeRig(module_context)


@given(actions=st.lists(actions_on_bridge, min_size=1, max_size=12))
@example(actions=[("pins", [("machine-on", True), ("tool-offset", 1e308), ("joint-fb.0", 1e308)]), ("tick",)])
@cases(60, 0.05)
def test_bridge(bridge: BridgeRig, actions: list) -> None:
    COUNTS["bridge"] += 1
    for action in actions:
        bridge.play(action)
    bridge.passes_on_the_next_good_correction()
