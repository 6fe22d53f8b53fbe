"""Messages and services of any content, in any order, for the compensator: it does not die, and keeps its limits.

Truth: the geometry file's limits; the closed form of the paper machine's strut lengths (node_helpers.py); for
refusals, what ROS and IEEE 754 say of a message: a number that is not finite, a quaternion that is no unit one.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
import pytest
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
from hypothesis import example, given
from hypothesis import strategies as st
from node_helpers import AT_ONCE, HOME, Bench, closed_form_lengths
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_srvs.srv import Trigger
from strategies import paper_geometry

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.compensator import CompensatorNode

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
