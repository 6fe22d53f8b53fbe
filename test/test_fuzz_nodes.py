"""Messages and services of any content, in any order: no node dies, and what it publishes stays within its limits.

The callbacks that rclpy would call are called here in this thread, with everything that the message types can
hold: that makes thousands of cases a second. A smaller number goes over DDS.

Truth: the geometry file's limits; the closed form of the paper machine's strut lengths (node_helpers.py); for
refusals, what ROS and IEEE 754 say of a message: a number that is not finite, a quaternion that is no unit one.
"""

from __future__ import annotations

import importlib
import inspect
import math
import re
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from fuzzing import COUNTS, cases
from geometry_msgs.msg import PoseStamped
from hypothesis import example, given
from hypothesis import strategies as st
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState
from node_helpers import HOME, Bench, closed_form_lengths, model_file
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState, Temperature
from strategies import paper_geometry

from hexapod_comp.geometry import STRUT_NAMES
from hexapod_comp.nodes.compensator import CompensatorNode
from hexapod_comp.nodes.runtime import MachineNode, autostart
from hexapod_comp.nodes.strut_drive import StrutDriveNode
from hexapod_comp.pose import Pose

LIMITS = paper_geometry().limits
HOME_LENGTHS = closed_form_lengths(HOME)
LEGAL = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP, Transition.TRANSITION_ACTIVATE)
LEGAL += (Transition.TRANSITION_DEACTIVATE,)

# Anything that a message can hold.

floats = st.one_of(
    st.floats(),
    st.floats(-1.0, 1.0),
    st.sampled_from((0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-310, 1e155, 0.4, 1.0, -1.0)),
)
texts = st.one_of(
    st.sampled_from(("", "base", "work", "BASE", "base ", "/base", "map", "platform", "strut_1", "strut_7", "a" * 99)),
    st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=8),
)
INTEGER = re.compile(r"(u?)int(\d+)")


def any_value(kind: str) -> st.SearchStrategy[Any]:
    """Return what a field of a ROS type can hold."""
    if kind.startswith("sequence<"):
        return st.lists(any_value(kind[len("sequence<") : -1].partition(",")[0]), max_size=7)
    if kind.endswith("]"):
        inner, _, size = kind[:-1].partition("[")
        return st.lists(any_value(inner), min_size=int(size), max_size=int(size))
    whole = INTEGER.fullmatch(kind)
    if whole:
        bits = int(whole[2])
        return st.integers(0, 2**bits - 1) if whole[1] else st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    simple = {"double": floats, "boolean": st.booleans(), "string": texts, "octet": st.binary(min_size=1, max_size=1)}
    if kind in simple:
        return simple[kind]
    if kind == "float":
        return st.floats(width=32)
    package, _, name = kind.partition("/")
    return any_message(getattr(importlib.import_module(f"{package}.msg"), name))


def any_message(kind: type) -> st.SearchStrategy[Any]:
    """Return messages of a type with any content."""
    fields = kind.get_fields_and_field_types()  # type: ignore[attr-defined]
    return st.builds(kind, **{name: any_value(of) for name, of in fields.items()})


# What mostly is right: a good message with a few things changed.

moves = st.lists(st.floats(-3e-4, 3e-4), min_size=3, max_size=3)
changes = st.one_of(st.just([]), st.just([]), st.lists(st.tuples(st.integers(0, 6), floats), max_size=2))
stamps = st.one_of(
    st.just(0.0), st.just(0.0), st.floats(-0.6, 0.6), st.sampled_from((-1e9, 1e8, 1e-9)), st.tuples(
        st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1)
    )
)  # fmt: skip
frames = st.one_of(st.just("base"), st.just("base"), st.just("work"), texts)
names = st.one_of(
    st.just(list(STRUT_NAMES)), st.just(list(STRUT_NAMES)), st.permutations(STRUT_NAMES), st.lists(texts, max_size=7)
)
lengths = st.one_of(
    st.lists(st.floats(-3e-4, 3e-4), min_size=6, max_size=6).map(lambda moved: (HOME_LENGTHS + moved).tolist()),
    st.lists(st.floats(0.33, 0.88), min_size=6, max_size=6),
    st.lists(floats, max_size=8),
)
pose_action = st.tuples(st.just("pose"), moves, changes, frames, stamps)
states_action = st.tuples(st.just("struts"), names, lengths, st.lists(floats, max_size=7), stamps)
temperature_action = st.tuples(
    st.just("temperature"), st.one_of(st.sampled_from((*STRUT_NAMES, "base", "platform")), texts), floats
)
tick = st.just(("tick",))
transitions = st.sampled_from((*LEGAL, *LEGAL, 0, 10, 99, 255))
transition = st.tuples(st.just("transition"), transitions, st.sampled_from(("", "x")))
anything = st.tuples(st.just("any"), st.integers(0, 1000), st.randoms(use_true_random=False))


class Rig:
    """A node whose callbacks are called here, and what it publishes; it is made anew when it has been shut down."""

    def __init__(self, context: Any, kind: type[MachineNode], **parameters: Any) -> None:
        self.sent: list[tuple[str, Any]] = []
        rig = self

        class Recorded(kind):  # type: ignore[misc, valid-type]
            def create_publisher(self, message_type: type, topic: str, *args: Any, **options: Any) -> Any:
                publisher = super().create_publisher(message_type, topic, *args, **options)
                publish = publisher.publish

                def recorded(message: Any) -> None:
                    rig.record(topic, message_type, message)
                    publish(message)

                publisher.publish = recorded
                return publisher

        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.node = Recorded(context=context, namespace="fuzzed", parameter_overrides=overrides)
        self._numbers: dict[str, int] = {}
        assert autostart(self.node)

    def record(self, topic: str, message_type: type, message: Any) -> None:
        """Keep what is published, as it is now: nodes use their messages again."""
        if isinstance(message, bytes):
            message = rclpy.serialization.deserialize_message(message, message_type)
        kept: Any = message
        if isinstance(message, JointState):
            stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
            kept = (list(message.name), np.array(message.position), np.array(message.velocity), stamp)
        elif isinstance(message, PoseStamped):
            p, q = message.pose.position, message.pose.orientation
            kept = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
        self.sent.append((topic, kept))

    def took(self, topic: str) -> list[Any]:
        """Return what was published on a topic, and forget it."""
        found = [message for name, message in self.sent if name == topic]
        self.sent = [(name, message) for name, message in self.sent if name != topic]
        return found

    @property
    def active(self) -> bool:
        return self.node._state_machine.current_state[0] == State.PRIMARY_STATE_ACTIVE

    def deliver(self, topic: str, message: Any) -> None:
        """Call the callback of a subscription as rclpy would, if there is one."""
        for subscription in self.node.subscriptions:
            if subscription.topic_name.rsplit("/", 1)[-1] != topic:
                continue
            if subscription.raw:
                message = rclpy.serialization.serialize_message(message)
            number = self._numbers[topic] = self._numbers.get(topic, 0) + 1
            if len(inspect.signature(subscription.callback).parameters) == 2:
                subscription.callback(message, {"publication_sequence_number": number})
            else:
                subscription.callback(message)

    def serve(self, name: str, request: Any) -> Any:
        """Call the callback of a service, if there is one, and return its response."""
        for service in self.node.services:
            if service.srv_name.rsplit("/", 1)[-1] == name:
                response = service.callback(request, service.srv_type.Response())
                assert response is None or isinstance(response, service.srv_type.Response)
                return response
        return None

    def serve_any(self, place: int, random: Any) -> None:
        """Call some service with any request at all."""
        services = sorted(self.node.services, key=lambda s: s.srv_name)
        service = services[place % len(services)]
        name = service.srv_name.rsplit("/", 1)[-1]
        rare = name == "reload_model" and random.random() > 0.02  # starts a process
        if name != "change_state" and not rare:  # that has an action of its own: shutting down is for good
            self.serve(name, draw(service.srv_type.Request, random))

    def tick(self) -> None:
        """Call all timers."""
        for timer in list(self.node.timers):
            timer.callback()

    def change(self, number: int, label: str = "") -> bool:
        """Ask for a transition."""
        request = ChangeState.Request()
        request.transition.id, request.transition.label = number, label
        return self.serve("change_state", request).success

    def activate(self) -> None:
        """Bring the node back to active, from wherever it is."""
        state = self.node._state_machine.current_state[0]
        if state == State.PRIMARY_STATE_UNCONFIGURED:
            assert self.change(Transition.TRANSITION_CONFIGURE)
            state = State.PRIMARY_STATE_INACTIVE
        if state == State.PRIMARY_STATE_INACTIVE:
            assert self.change(Transition.TRANSITION_ACTIVATE)
        assert self.active


def draw(kind: type, random: Any) -> Any:
    """Return a message of a type from a source of chance: cheaper than drawing every field of every service."""
    values = {}
    for name, of in kind.get_fields_and_field_types().items():  # type: ignore[attr-defined]
        values[name] = draw_value(of, random)
    return kind(**values)


def draw_value(kind: str, random: Any) -> Any:
    """Return a value of a ROS type."""
    if kind.startswith("sequence<"):
        inner = kind[len("sequence<") : -1].partition(",")[0]
        return [draw_value(inner, random) for _ in range(random.choice((0, 0, 1, 2, 5)))]
    whole = INTEGER.fullmatch(kind)
    if whole:
        top = 2 ** int(whole[2]) - 1
        number = random.choice((0, 1, 2, 3, 5, 9, top, random.randint(0, top)))
        return number if whole[1] else min(number, top // 2)
    simple = {
        "double": (0.0, 1.5, -1.0, math.nan, math.inf, 1e308, 3.0),
        "boolean": (True, False),
        "string": (*PARAMETER_NAMES, "", "nobody", "é", "a" * 3000),
        "octet": (b"\0", b"\xff"),
    }
    if kind in simple:
        return random.choice(simple[kind])
    package, _, name = kind.partition("/")
    return draw(getattr(importlib.import_module(f"{package}.msg"), name), random)


PARAMETER_NAMES = ("fault_stuck_strut", "fault_encoder_lost", "fault_feedback_delay", "fault_feedback_drop")
PARAMETER_NAMES += ("fault_jump", "fault_jump_strut", "rate", "model_file", "ramp_rate", "use_sim_time")


@pytest.fixture(scope="module")
def context(isolated_ros: int) -> Iterator[Any]:
    made = rclpy.Context()
    rclpy.init(args=[], context=made, domain_id=isolated_ros)
    yield made
    rclpy.try_shutdown(context=made)


def stamp_into(message: Any, stamp: Any) -> None:
    """Write a stamp: 0 none, a time from now in s, or any two integers."""
    if isinstance(stamp, tuple):
        message.header.stamp.sec, message.header.stamp.nanosec = stamp
    elif stamp:
        nanoseconds = max(0, time.time_ns() + round(stamp * 1e9))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)


def struts(action: tuple) -> JointState:
    """Return the message of a struts action."""
    _, who, position, velocity, stamp = action
    message = JointState(name=who, position=position, velocity=velocity)
    stamp_into(message, stamp)
    return message


# The compensator.


class CompensatorRig(Rig):
    """A compensator, and what is known of it from outside: the last command."""

    def __init__(self, context: Any, model: str) -> None:
        # Struts that are not where they were told stop the machine (tested elsewhere): here they may be anywhere.
        options = {"following_error_limit": 0.0, "marker_rate": 0.0, "publish_array": True, "model_file": model}
        super().__init__(context, CompensatorNode, **options)
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
        COUNTS[f"compensator {kind} messages"] += 1
        if kind == "pose":
            self.pose(action)
        elif kind == "struts":
            self.deliver("strut_states", struts(action))
        elif kind == "temperature":
            message = Temperature(temperature=action[2])
            message.header.frame_id = action[1]
            self.deliver("temperatures", message)
        elif kind == "tick":
            self.tick()
        elif kind == "transition":
            self.change(*action[1:])
            self.last = None
        elif kind == "any":
            self.serve_any(*action[1:])
            self.last = None  # it may have been a reset: the struts are then where they are measured
        else:
            topic, message = action[1:]
            self.deliver(topic, message)
        for estimate in self.took("tool_pose_estimate"):
            assert np.isfinite(estimate).all()
        for topic in ("strut_commands", "strut_corrections", "strut_commands_array"):
            assert kind not in ("struts", "temperature", "tick", "transition") or not self.took(topic)
        for report in self.took("/diagnostics"):
            said = [text for status in report.status for entry in status.values for text in (entry.key, entry.value)]
            assert sum(map(len, said)) < 20_000

    def answers_the_next_good_command(self) -> None:
        """Check that the node still lives: reset, with struts at home, it answers home, and 0.1 mm beside it."""
        self.activate()
        assert self.serve("reset", draw_reset()).success
        self.last = None
        self.deliver("strut_states", struts(("struts", list(STRUT_NAMES), HOME_LENGTHS.tolist(), [0.0] * 6, 0.0)))
        for move in ([0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]):
            self.pose(("pose", move, [], "base", 0.0))
            assert self.last is not None, self.node._status.refusals.last_text
            self.deliver("strut_states", struts(("struts", list(STRUT_NAMES), self.last.tolist(), [0.0] * 6, 0.0)))
        self.tick()
        self.sent.clear()


def draw_reset() -> Any:
    return importlib.import_module("std_srvs.srv").Trigger.Request()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Give a small model file: nodes read it again whenever they are configured."""
    struts = {"offset_um": [40, -30, 20, 10, -50, 5], "backlash_um": 8, "expansion_ppm_per_K": 11.7}
    return model_file(tmp_path_factory.mktemp("model"), struts=struts)


@pytest.fixture(scope="module")
def compensator(context: Any, model: str) -> CompensatorRig:
    return CompensatorRig(context, model)


compensator_actions = st.one_of(
    pose_action,
    pose_action,
    pose_action,
    states_action,
    temperature_action,
    tick,
    transition,
    anything,
    st.tuples(st.just("message"), st.just("tool_pose_command"), any_message(PoseStamped)),
    st.tuples(st.just("message"), st.just("strut_states"), any_message(JointState)),
    st.tuples(st.just("message"), st.just("temperatures"), any_message(Temperature)),
)


@given(actions=st.lists(compensator_actions, min_size=1, max_size=12))
@example(actions=[("transition", number, "") for number in (3, 2, 1, 1, 4, 2, 0, 99, 3)])
@cases(60, 0.1)
def test_compensator(compensator: CompensatorRig, actions: list) -> None:
    COUNTS["compensator"] += 1
    for action in actions:
        compensator.play(action)
    compensator.answers_the_next_good_command()


# The drive.


class DriveRig(Rig):
    """A strut drive."""

    def __init__(self, context: Any, truth: str) -> None:
        super().__init__(context, StrutDriveNode, rate=1000.0, truth_file=truth)

    def play(self, action: tuple) -> None:
        """Do one thing to the node, and check its readings."""
        kind = action[0]
        COUNTS[f"drive {kind} messages"] += 1
        if kind == "struts":
            self.deliver("strut_commands", struts(action))
        elif kind == "tick":
            self.tick()
        elif kind == "transition":
            self.change(*action[1:])
        elif kind == "any":
            self.serve_any(*action[1:])
        else:
            self.deliver("strut_commands", action[1])
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
        """Check that the node still lives: it takes a command to home, and without faults tells where it is."""
        self.activate()
        self.serve("set_parameters", no_faults())
        before = self.node._commands.count
        self.deliver("strut_commands", struts(("struts", list(STRUT_NAMES), HOME_LENGTHS.tolist(), [], 0.0)))
        assert self.node._commands.count == before + 1, self.node._refusals.last_text
        self.tick()
        time.sleep(2e-3)
        self.tick()
        assert self.took("strut_states")
        self.sent.clear()


def no_faults() -> Any:
    """Return the request that takes all faults back."""
    request = importlib.import_module("rcl_interfaces.srv").SetParameters.Request()
    values = {"fault_stuck_strut": 0, "fault_encoder_lost": 0, "fault_feedback_delay": 0.0, "fault_feedback_drop": 0.0}
    request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return request


@pytest.fixture(scope="module")
def drive(context: Any, model: str) -> DriveRig:
    return DriveRig(context, model)


drive_actions = st.one_of(
    states_action, states_action, tick, transition, anything, st.tuples(st.just("message"), any_message(JointState))
)


@given(actions=st.lists(drive_actions, min_size=1, max_size=12))
@cases(60, 0.05)
def test_drive(drive: DriveRig, actions: list) -> None:
    COUNTS["drive"] += 1
    for action in actions:
        drive.play(action)
    drive.follows_the_next_good_command()


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


def test_over_dds(ros_context: Any, spin_until: Any, capfd: Any) -> None:
    """The same through the middleware: any messages at all, then a good command is answered."""
    random = np.random.default_rng(11)
    with Bench(ros_context, spin_until, capfd) as bench:
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
