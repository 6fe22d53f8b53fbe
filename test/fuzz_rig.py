"""What the fuzz tests of the nodes share: messages of any content, and a node whose callbacks are called by the test.

Calling here what rclpy would call, in this thread, makes thousands of cases a second. What passes between real
processes is tested elsewhere, and in test_fuzz_compensator.py at the end.
"""

from __future__ import annotations

import importlib
import inspect
import math
import re
import time
from typing import Any

import numpy as np
import pytest
import rclpy
from fuzzing import COUNTS
from geometry_msgs.msg import PoseStamped
from hypothesis import strategies as st
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState
from node_helpers import HOME, closed_form_lengths, model_file
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.base import MachineNode
from hexapod_comp.ros.process import autostart

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


def struts_action(numbers: st.SearchStrategy[list[float]]) -> st.SearchStrategy[tuple]:
    """Return messages of struts with such numbers, mostly well named."""
    return st.tuples(st.just("struts"), names, numbers, st.lists(floats, max_size=7), stamps)


transitions = st.sampled_from((*LEGAL, *LEGAL, 0, 10, 99, 255))
tick = st.just(("tick",))
transition = st.tuples(st.just("transition"), transitions, st.sampled_from(("", "x")))
anything = st.tuples(st.just("any"), st.integers(0, 1000), st.randoms(use_true_random=False))


class Rig:
    """A node whose callbacks are called here, and what it publishes; it is made anew when it has been shut down."""

    def __init__(self, context: Any, kind: type[MachineNode], parameters: dict[str, Any], **options: Any) -> None:
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
                publisher.get_subscription_count = lambda: 1  # what nobody listens to is not published
                return publisher

        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.node = Recorded(context=context, namespace="fuzzed", parameter_overrides=overrides, **options)
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

    def play(self, action: tuple) -> None:
        """Do what can be done to any node: ``tick``, ``transition``, ``any`` service, ``message`` to a topic."""
        kind = action[0]
        COUNTS[f"{self.node.get_name()} {kind} messages"] += 1
        if kind == "tick":
            self.tick()
        elif kind == "transition":
            self.change(*action[1:])
        elif kind == "any":
            self.serve_any(*action[1:])
        elif kind == "message":
            self.deliver(*action[1:])

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


def stamp_into(message: Any, stamp: Any) -> None:
    """Write a stamp: 0 none, a time from now in s, or any two integers."""
    if isinstance(stamp, tuple):
        message.header.stamp.sec, message.header.stamp.nanosec = stamp
    elif stamp:
        nanoseconds = max(0, time.time_ns() + round(stamp * 1e9))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)


def struts(action: tuple) -> JointState:
    """Return the message of a :func:`struts_action`."""
    _, who, position, velocity, stamp = action
    message = JointState(name=who, position=position, velocity=velocity)
    stamp_into(message, stamp)
    return message


def small_model(factory: pytest.TempPathFactory) -> str:
    """Write a small model file, since nodes read it again whenever they are configured; return its path."""
    imperfections = {"offset_um": [40, -30, 20, 10, -50, 5], "backlash_um": 8, "expansion_ppm_per_K": 11.7}
    return model_file(factory.mktemp("model"), struts=imperfections)
