"""Messages, pins and services with any content, in any order: nodes keep running and keep their limits.

The nodes are called on the rig's clock, thousands of cases per second; test_fuzz_wire.py sends bytes between processes.
The truth is the geometry file's limits, the closed form of the paper machine's strut lengths, SciPy's rotations, and
LinuxCNC's definition of axes and tool length (doc/linuxcnc.md)."""

from __future__ import annotations

import importlib
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzing import COUNTS, cases
from geometry_msgs.msg import PoseStamped
from hal_stand_in import StandInHal
from hypothesis import example, given
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from node_helpers import AT_ONCE, HOME, Rig, Stranger, closed_form_lengths, model_file
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState, Temperature
from strategies import paper_geometry

from hexapod_comp.core import lib
from hexapod_comp.linuxcnc.bridge import (
    AXES,
    CORRECTIONS,
    FEEDBACK,
    SWITCHES,
    GuardStatus,
    LinuxcncBridgeNode,
)
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.ros.strut_drive import StrutDriveNode

LIMITS = paper_geometry().limits
HOME_LENGTHS = closed_form_lengths(HOME)
WAITS = 0.01  # s; longest wait of a command that is too early for the struts

# Mostly valid messages with a few changes

floats = st.one_of(
    st.floats(),
    st.floats(-1.0, 1.0),
    st.sampled_from((0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-310, 1e155, 0.4, 1.0, -1.0)),
)
texts = st.one_of(
    st.sampled_from(("", "base", "work", "BASE", "base ", "/base", "map", "platform", "strut_1", "strut_7", "a" * 99)),
    st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=8),
)
stamps = st.one_of(
    st.just(0.0), st.just(0.0), st.floats(-0.6, 0.6), st.sampled_from((-1e9, 1e8, 1e-9)), st.tuples(
        st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1)
    )
)  # fmt: skip
names = st.one_of(
    st.just(list(STRUT_NAMES)), st.just(list(STRUT_NAMES)), st.permutations(STRUT_NAMES), st.lists(texts, max_size=7)
)
lengths = st.one_of(
    st.lists(st.floats(-3e-4, 3e-4), min_size=6, max_size=6).map(lambda moved: (HOME_LENGTHS + moved).tolist()),
    st.lists(st.floats(0.33, 0.88), min_size=6, max_size=6),
    st.lists(floats, max_size=8),
)
transitions = st.sampled_from((*(1, 2, 3, 4) * 2, 0, 10, 99, 255))  # valid: configure, cleanup, activate, deactivate
chance = st.tuples(st.integers(0, 1000), st.randoms(use_true_random=False))
WHATEVER = (
    st.tuples(st.just("wait")),
    st.tuples(st.just("wait")),
    st.tuples(st.just("transition"), transitions, st.sampled_from(("", "x"))),
    chance.map(lambda drawn: ("service", *drawn)),
    chance.map(lambda drawn: ("message", *drawn)),
)


def struts_action(topic: str, numbers: st.SearchStrategy[list[float]]) -> st.SearchStrategy[tuple]:
    """Return a strategy for messages of struts on a topic, mostly with valid names."""
    return st.tuples(st.just("struts"), st.just(topic), names, numbers, st.lists(floats, max_size=7), stamps)


WORDS = ("fault_stuck_strut", "fault_encoder_lost", "fault_feedback_delay", "fault_feedback_drop", "fault_jump", "rate")
WORDS += ("fault_jump_strut", "model_file", "ramp_rate", "use_sim_time", "base", *STRUT_NAMES, "", "é", "a" * 3000)
NUMBERS = (0.0, 1.5, -1.0, math.nan, math.inf, 1e308, 3.0, 0.5)


def draw(kind: str, random: Any) -> Any:
    """Return a random value for a field of a message's type, which may be a message itself."""
    if kind.startswith("sequence<"):
        return [draw(kind[len("sequence<") : -1].partition(",")[0], random) for _ in range(random.choice((0, 0, 1, 6)))]
    if kind.endswith("]"):
        inner, _, size = kind[:-1].partition("[")
        return [draw(inner, random) for _ in range(int(size))]
    if whole := re.fullmatch(r"(u?)int(\d+)", kind):
        top = 2 ** int(whole[2]) - 1
        number = random.choice((0, 1, 2, 3, 5, 9, top, random.randint(0, top)))
        return number if whole[1] else min(number, top // 2)
    simple = {
        "double": NUMBERS,
        "float": NUMBERS[:3],
        "boolean": (True, False),
        "string": WORDS,
        "octet": (b"\0", b"\xff"),
    }
    if kind in simple:
        return random.choice(simple[kind])
    package, _, name = kind.partition("/")
    return made(getattr(importlib.import_module(f"{package}.msg"), name), random)


def made(kind: Any, random: Any) -> Any:
    return kind(**{name: draw(of, random) for name, of in kind.get_fields_and_field_types().items()})


class Fuzzed:
    """A node on the rig, one other node that publishes all its topics, and actions that suit any node."""

    def __init__(self, rig: Rig, kind: type, parameters: dict[str, Any], **options: Any) -> None:
        for topic in list(rig._publishers):
            rig.remove_publisher(topic)
        self.rig, self.node = rig, rig.add(kind, True, parameters, **options)
        self.name, witness = self.node.get_name(), Stranger(rig, "witness")
        ends = {end.topic_name.lstrip("/"): end.msg_type for end in self.node.subscriptions}
        self.voices = {topic: witness.create_publisher(kind, topic) for topic, kind in ends.items()}
        witness.create_subscription(PoseStamped, "tool_pose_command", rig.seen["tool_pose_command"].append)

    def took(self, topic: str) -> list[Any]:
        """Return the messages published on a topic since the last call."""
        found = list(self.rig.seen[topic])
        self.rig.seen[topic].clear()
        return found

    def stamp(self, message: Any, stamp: Any) -> None:
        """Write a stamp into a message: 0 for none, a number of seconds from now, or two integers."""
        if isinstance(stamp, tuple):
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        elif stamp:
            nanoseconds = max(0, self.rig.clock.time_ns() + round(stamp * 1e9))
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)

    def play(self, actions: list[tuple]) -> None:
        """Do each action and check the node after it; at the end check that the node still works."""
        COUNTS[self.name] += 1
        for kind, *rest in actions:
            COUNTS[f"{self.name} {kind} messages"] += 1
            getattr(self, kind)(*rest)
            self.check(kind)
        self.rig.clock.sleep(2.0)  # so that struts that have been anywhere may be at home and at rest
        for transition in ("configure", "activate"):
            self.rig.change(transition, self.name)
        self.goes_on()
        assert self.node.guard.values()["callback_errors"] == "0", self.node.guard.values()
        for messages in self.rig.seen.values():
            messages.clear()

    def wait(self) -> None:
        self.rig.step(0.05)

    def transition(self, number: int, label: str) -> None:
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        self.rig.call(ChangeState, f"{self.name}/change_state", request)

    def service(self, place: int, random: Any) -> None:
        """Call any service with any request, except transitions, since shutting down is permanent."""
        services = sorted((s for s in self.node.services if "change_state" not in s.srv_name), key=lambda s: s.srv_name)
        service = services[place % len(services)]
        response = service.callback(made(service.srv_type.Request, random), service.srv_type.Response())
        assert response is None or isinstance(response, service.srv_type.Response)

    def message(self, place: int, random: Any) -> None:
        voice = self.voices[sorted(self.voices)[place % len(self.voices)]]
        voice.publish(made(voice.kind, random))
        self.rig.step(2 * WAITS)

    def struts(
        self, topic: str, who: list[str], position: list[float], velocity: list[float], stamp: Any
    ) -> JointState:
        message = JointState(name=who, position=position, velocity=velocity)
        self.stamp(message, stamp)
        self.voices[topic].publish(message)
        return message


# ---- the compensator ----

moves = st.lists(st.floats(-3e-4, 3e-4), min_size=3, max_size=3)
changes = st.one_of(st.just([]), st.just([]), st.lists(st.tuples(st.integers(0, 6), floats), max_size=2))
frames = st.one_of(st.just("base"), st.just("base"), st.just("work"), texts)
parts = st.one_of(st.sampled_from((*STRUT_NAMES, "base", "platform")), texts)
pose_action = st.tuples(st.just("pose"), moves, changes, frames, stamps)
temperature_action = st.tuples(st.just("temperature"), parts, floats)
actions_on_compensator = st.one_of(
    *(pose_action,) * 3, struts_action("strut_states", lengths), temperature_action, *WHATEVER
)


class FuzzedCompensator(Fuzzed):
    """A compensator without the check of following errors, so that struts may be anywhere."""

    def __init__(self, rig: Rig, model: str) -> None:
        options = {"following_error_limit": 0.0, "marker_rate": 0.0, "publish_array": True, "model_file": model}
        options |= {"start_without_feedback_after": AT_ONCE, "catch_up_within": WAITS}
        super().__init__(rig, CompensatorNode, options)
        self.last: np.ndarray | None = None  # last command, m

    def pose(self, move: list[float], edits: list, frame: str, stamp: Any) -> None:
        """Send a command, and check its answer against the limits and the closed form."""
        numbers = np.array([*(HOME.position + move), 0.0, 0.0, 0.0, 1.0])
        for index, value in edits:
            numbers[index] = value
        message = PoseStamped()
        message.header.frame_id = frame
        self.stamp(message, stamp)
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z, q.x, q.y, q.z, q.w = numbers.tolist()
        was_active = self.node.active
        self.voices["tool_pose_command"].publish(message)
        self.rig.step(2 * WAITS)
        answers, corrections = self.took("strut_commands"), self.took("strut_corrections")
        arrays = self.took("strut_commands_array")
        assert len(answers) == len(corrections) == len(arrays) <= 1
        if not answers:
            return
        with np.errstate(over="ignore"):
            sane = np.isfinite(numbers).all() and abs(np.linalg.norm(numbers[3:]) - 1.0) < 2e-3
        assert was_active
        assert sane
        assert frame in ("base", "work")
        answer, correction, sent = answers[0], np.array(corrections[0].position), message.header.stamp
        assert (sent.sec, sent.nanosec) == (0, 0) or answer.header.stamp == sent
        command = np.array(answer.position)
        assert (list(answer.name), list(arrays[0].data)) == (list(STRUT_NAMES), command.tolist())
        assert np.isfinite([command, answer.velocity, correction]).all()
        assert ((command >= LIMITS.stroke[:, 0]) & (command <= LIMITS.stroke[:, 1])).all()
        assert np.abs(correction).max() <= LIMITS.correction
        pose = Pose.from_quaternion(numbers[:3], numbers[3:])
        np.testing.assert_allclose(command - correction, closed_form_lengths(pose), atol=1e-12)
        if self.last is not None:
            assert np.abs(command - self.last).max() <= LIMITS.step * (1.0 + 1e-12)
        self.last = command

    def temperature(self, part: str, value: float) -> None:
        message = Temperature(temperature=value)
        message.header.frame_id = part
        self.voices["temperatures"].publish(message)

    def check(self, kind: str) -> None:
        by_chance = kind in ("transition", "service", "message")  # these may reset the node or contain a valid command
        self.last = None if by_chance else self.last
        for estimate in self.took("tool_pose_estimate"):
            assert np.isfinite(message_pose(estimate).position).all()
        for topic in ("strut_commands", "strut_corrections", "strut_commands_array"):
            assert not self.took(topic) or by_chance
        for report in self.took("/diagnostics"):
            said = [text for status in report.status for entry in status.values for text in (entry.key, entry.value)]
            assert sum(map(len, said)) < 20_000

    def goes_on(self) -> None:
        """Check that after a reset, with struts at home, the node answers at home and 0.1 mm beside it."""
        assert self.rig.trigger("reset").success
        self.last = HOME_LENGTHS
        for move in ([0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]):
            self.struts("strut_states", list(STRUT_NAMES), self.last.tolist(), [0.0] * 6, 0.0)
            before = self.last
            self.pose(move, [], "base", 0.0)
            assert self.last is not before, self.node.refusals.last_text


@pytest.fixture
def small_model(tmp_path: Path) -> str:
    """Write a small model file, since nodes read it again whenever they are configured."""
    imperfections = {"offset_um": [40, -30, 20, 10, -50, 5], "backlash_um": 8, "expansion_ppm_per_K": 11.7}
    return model_file(tmp_path, struts=imperfections)


@pytest.fixture
def compensator(rig: Rig, small_model: str) -> FuzzedCompensator:
    return FuzzedCompensator(rig, small_model)


@given(actions=st.lists(actions_on_compensator, min_size=1, max_size=12))
@example(actions=[("transition", number, "") for number in (3, 2, 1, 1, 4, 2, 0, 99, 3)])
@cases(25, 0.1)
def test_compensator(compensator: FuzzedCompensator, actions: list) -> None:
    compensator.play(actions)


# ---- the drive ----


class FuzzedDrive(Fuzzed):
    def __init__(self, rig: Rig, truth: str) -> None:
        super().__init__(rig, StrutDriveNode, {"rate": 100.0, "truth_file": truth})

    def check(self, kind: str) -> None:
        """Check that readings are finite, except of an encoder that is lost, and within the strokes."""
        lost = self.node.options["fault_encoder_lost"]
        there = np.ones(6, dtype=bool)
        there[lost - 1] = not lost
        for message in self.took("strut_states") if kind != "service" else ():  # a service may have changed the fault
            assert list(message.name) == list(STRUT_NAMES)
            position, noise = np.array(message.position)[there], 1e-6  # 20 standard deviations of the encoder
            assert np.isfinite([position, np.array(message.velocity)[there]]).all()
            assert (position >= LIMITS.stroke[there, 0] - noise).all()
            assert (position <= LIMITS.stroke[there, 1] + noise).all()
        for pose in self.took("tool_pose_true"):
            assert np.isfinite(message_pose(pose).position).all()

    def goes_on(self) -> None:
        """Check that without faults a valid command is accepted, and feedback is published."""
        faults = {"stuck_strut": 0, "encoder_lost": 0, "feedback_delay": 0.0, "feedback_drop": 0.0}
        for name, value in faults.items():
            self.rig.fault(name, value)
        self.wait()
        self.took("strut_states")
        self.wait()
        read, before = self.took("strut_states")[-1], self.node.commands.count
        self.struts("strut_commands", list(STRUT_NAMES), list(self.node.drive.commands), [], 0.0)
        assert self.node.commands.count == before + 1, (read, self.node.refusals.last_text)
        self.wait()
        assert self.took("strut_states")


@pytest.fixture
def drive(rig: Rig, small_model: str) -> FuzzedDrive:
    return FuzzedDrive(rig, small_model)


@given(
    actions=st.lists(st.one_of(*(struts_action("strut_commands", lengths),) * 2, *WHATEVER), min_size=1, max_size=12)
)
@cases(25, 0.05)
def test_drive(drive: FuzzedDrive, actions: list) -> None:
    drive.play(actions)


# ---- the LinuxCNC bridge ----


MM = 1e-3
LIMIT, RAMP = 500e-6, 10e-3
ROUNDING = 1e-15

NOW = 1e-9  # s; stamp of a message that answers the newest command (0 would be no stamp)

six = st.lists(st.floats(-LIMIT, LIMIT), min_size=6, max_size=6)
corrections = st.one_of(
    st.lists(st.floats(-1.2 * LIMIT, 1.2 * LIMIT), min_size=6, max_size=6), six, st.lists(floats, max_size=8)
)
pins = st.one_of(
    st.tuples(st.sampled_from(AXES + FEEDBACK), st.one_of(st.floats(-400.0, 400.0), floats)),
    st.tuples(st.sampled_from(SWITCHES), st.booleans()),
)
actions_on_bridge = st.one_of(
    st.tuples(st.just("pins"), st.lists(pins, min_size=1, max_size=4)),
    struts_action("strut_corrections", corrections),
    six.map(lambda values: ("struts", "strut_corrections", list(STRUT_NAMES), values, [], NOW)),
    *WHATEVER,
)


class FuzzedBridge(Fuzzed):
    """A bridge, and the pins that LinuxCNC would read and write."""

    def __init__(self, rig: Rig) -> None:
        self.hal = StandInHal()
        super().__init__(
            rig, LinuxcncBridgeNode, {"limit": LIMIT, "ramp_rate": RAMP, "timeout": 1.0, "rate": 100.0}, hal=self.hal
        )

    def pins(self, values: list[tuple[str, Any]]) -> None:
        for name, value in values:
            self.hal[name] = value
        self.took("tool_pose_command"), self.took("strut_states")

    def check(self, kind: str) -> None:
        """Check the pins written since the last check, and published poses and struts against the pins."""
        for name in CORRECTIONS:
            written = [value for _, value in self.hal.pins[name].written]
            assert np.isfinite(written).all()
            assert max(map(abs, written), default=0.0) * MM <= LIMIT + ROUNDING
            assert all(abs(b - a) * MM <= RAMP * lib.LONGEST_RAMP_STEP + ROUNDING for a, b in pairwise(written))
        assert self.hal["status"] in list(GuardStatus)
        assert math.isfinite(self.hal["age"])
        assert 0.0 <= self.hal["largest"] * MM <= LIMIT + ROUNDING
        for pin in self.hal.pins.values():
            del pin.written[:-1]
        axes = np.array([self.hal[name] for name in AXES])
        for message in self.took("tool_pose_command"):
            found, turn = message_pose(message), Rotation.from_euler("xyz", axes[3:6], degrees=True).as_matrix()
            along = np.array([0.0, 0.0, axes[6]])
            position, close = (axes[:3] - along + turn @ along) * MM, 1e-12 * (1.0 + np.abs(axes).max())
            np.testing.assert_allclose(found.position, position, rtol=0.0, atol=close)
            np.testing.assert_allclose(found.rotation, turn, atol=1e-12)
        feedback = np.array([self.hal[name] for name in FEEDBACK])
        for message in self.took("strut_states"):
            assert list(message.name) == list(STRUT_NAMES)
            assert np.isfinite(message.velocity).all()
            np.testing.assert_allclose(message.position, feedback * MM, rtol=1e-15)

    def goes_on(self) -> None:
        """Check that with valid pins the bridge sends commands and passes a correction on."""
        good = {**dict.fromkeys(AXES, 0.0), **dict.fromkeys(FEEDBACK, 600.0), **dict.fromkeys(SWITCHES, True)}
        self.pins(list(good.items()))
        self.wait()  # publishes earlier corrections first
        updates = self.hal["updates"]
        self.struts("strut_corrections", list(STRUT_NAMES), [1e-4] * 6, [], NOW)
        self.wait()
        assert self.hal["updates"] == updates + 1, self.node._refusals.last_text
        assert self.hal["status"] in (GuardStatus.RAMPING, GuardStatus.COMPENSATING)
        assert self.rig.seen["tool_pose_command"]
        self.check("")


@pytest.fixture
def bridge(rig: Rig) -> FuzzedBridge:
    return FuzzedBridge(rig)


@given(actions=st.lists(actions_on_bridge, min_size=1, max_size=12))
@example(actions=[("pins", [("machine-on", True), ("tool-offset", 1e308), ("joint-fb.0", 1e308)]), ("wait",)])
@cases(25, 0.05)
def test_bridge(bridge: FuzzedBridge, actions: list) -> None:
    bridge.play(actions)
