"""Common parts of the node tests: the package's bench with this project's usual machine, poses and files."""

from __future__ import annotations

import math
import pickle
import sys
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from concurrent.futures import Future
from functools import cached_property, lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from lifecycle_msgs.srv import GetState
from rclpy.clock import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger

from hexapod_comp.cli.jobs import Jobs
from hexapod_comp.compensation.guards import StampClock
from hexapod_comp.compensation.journal import Source
from hexapod_comp.pose import Pose
from hexapod_comp.ros import rclpy_compat, worker
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.testing.bench import BEST_EFFORT, RELIABLE, SENT, TRANSITIONS, WATCHED, Answer
from hexapod_comp.testing.bench import Bench as BareBench

__all__ = ["BEST_EFFORT", "RELIABLE", "SENT", "TRANSITIONS", "Answer"]

CONFIG = Path(__file__).resolve().parents[1] / "config"

AT_ONCE = 1e-6  # a waiting time that has passed at once, s

READ_MODEL, READ_GEOMETRY = lru_cache(8)(Source.model), lru_cache(8)(Source.geometry)
"""Loaders that read each shipped model and machine once for all tests, instead of once per node."""

NO_EVENTS = {"use_default_callbacks": False}

HOME = Pose([0.0, 0.0, 0.4], np.eye(3))  # of the paper's machine


class Bench(BareBench):
    """A bench whose compensators have the virtual machine's model by default.

    They start without feedback unless a test gives feedback or requires it. At the end no node may have caught an
    exception in a callback, unless the test has set `may_catch`.
    """

    may_catch = False

    def __exit__(self, *pending: object) -> None:
        caught = [node.guard.values()["last_callback_error"] for node in self.nodes if hasattr(node, "guard")]
        self.close(*pending)
        assert self.may_catch or not any(caught), caught

    def close(self, *pending: object) -> None:
        super().__exit__(*pending)

    def compensator(self, start: bool = True, **parameters: object) -> CompensatorNode:
        defaults = {"model_file": "paper_machine.yaml", "start_without_feedback_after": AT_ONCE}
        return super().compensator(start, **{**defaults, **parameters})

    def listen(self, kind: type, topic: str, qos: Any = RELIABLE, **options: Any) -> list[Any]:
        """Return the list to which a topic's messages are appended from now on."""
        received: list[Any] = []
        self.witness.create_subscription(kind, topic, received.append, qos, **options)
        return received


class FakeTime:
    """A stand-in for the module ``time``, with a clock of the test's own."""

    def __init__(self) -> None:
        self.passed, self.set_by = 0, 0  # ns; `set_by`: by how much the system clock was set
        self._began, self._steady = time.time_ns(), time.monotonic_ns()
        self.perf_counter = self.monotonic

    def monotonic_ns(self) -> int:
        return self._steady + self.passed

    def time_ns(self) -> int:
        return self._began + self.passed + self.set_by

    def monotonic(self) -> float:
        return self.monotonic_ns() * 1e-9

    def time(self) -> float:
        return self.time_ns() * 1e-9

    def sleep(self, seconds: float) -> None:
        self.passed += round(seconds * 1e9)


class End:
    """A stand-in for the DDS end of a publisher, subscription or service, which takes milliseconds to make."""

    def __init__(self, node: Any, kind: Any, name: str, qos: object = None) -> None:
        self.qos = {"depth": 10}  # of a lifecycle's services
        self.name = _rclpy.rclpy_resolve_name(node, name, False, hasattr(kind, "Request"))
        self.get_topic_name = self.get_logger_name = lambda: self.name

    def __enter__(self) -> End:
        return self

    def __exit__(self, *_: object) -> None: ...

    def destroy_when_not_in_use(self) -> None: ...


class Lifecycle:
    """A lifecycle's state machine whose services have no DDS ends."""

    def __init__(self, node: Any, _: bool) -> None:
        self._machine = _rclpy.LifecycleStateMachine(node, False)
        for name in ("change_state", "get_state", "get_available_states", "get_available_transitions"):
            setattr(self, f"service_{name}", End(node, GetState, f"~/{name}"))
        self.service_get_transition_graph = End(node, GetState, "~/get_transition_graph")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._machine, name)


class Voice:
    """A publisher of the rig with a node's name and its own sequence numbers."""

    def __init__(self, rig: Rig, topic: str, kind: type, name: str) -> None:
        self.rig, self.topic_name, self.kind, self.name, self.number = rig, "/" + topic.lstrip("/"), kind, name, 0
        rig.voices.append(self)
        rig.matched_anew(self.topic_name)

    def publish(self, message: Any) -> None:
        data = message if isinstance(message, bytes) else bytes(serialize_message(message))
        self.rig.step(self.rig.TRANSPORT)
        self.number += 1
        self.rig.route(self.topic_name, data, self.number)

    def close(self) -> None:
        self.rig.voices.remove(self)
        self.rig.matched_anew(self.topic_name)

    def get_subscription_count(self) -> int:
        return self.rig.audience(self.topic_name)


class Stranger:
    """A node with a given name beside those under test, which publishes and subscribes."""

    def __init__(self, rig: Rig, name: str) -> None:
        self._rig, self._name = rig, name
        self.get_clock = lambda: rig.ros_clock

    def get_name(self) -> str:
        return self._name

    def create_publisher(self, kind: type, topic: str, *_: object) -> Voice:
        return Voice(self._rig, topic, kind, f"/{self._name}")

    def destroy_publisher(self, publisher: Voice) -> None:
        publisher.close()

    def create_subscription(self, kind: type, topic: str, callback: Any, *_: object, **__: object) -> tuple[str, Any]:
        subscription = "/" + topic.lstrip("/"), callback
        self._rig.listeners.append(subscription)
        return subscription

    def destroy_subscription(self, subscription: tuple[str, Any]) -> None:
        self._rig.listeners.remove(subscription)

    def count_publishers(self, topic: str) -> int:
        return len(self._rig.speakers("/" + topic.lstrip("/")))

    def count_subscribers(self, topic: str) -> int:
        return self._rig.audience(f"/{topic}", listeners=False)


class Messages(list[Any]):
    """The messages of a topic, oldest first; a message is deserialised when it is read."""

    def add(self, data: bytes, kind: type) -> None:
        self.append((data, kind))

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[n] for n in range(*which.indices(len(self)))]
        found = super().__getitem__(which)
        if isinstance(found, tuple):
            self[which] = found = deserialize_message(*found)
        return found

    def __iter__(self) -> Iterator[Any]:
        return (self[n] for n in range(len(self)))

    def __reversed__(self) -> Iterator[Any]:
        return (self[n] for n in reversed(range(len(self))))


class Rig(Bench):
    """A bench without DDS, threads and waiting: the rig calls nodes with messages, on its own clock.

    Published messages are kept in ``seen`` and passed to the other nodes. Timers and alarms fire when :meth:`until` or
    :meth:`step` has advanced the clock to their time. Jobs for the process beside a node are done at once.
    """

    TRANSPORT, TICK = 2e-4, 2e-3
    """Travel time of a message and longest step of the clock, s."""

    def __init__(self, context: Any, capture: Any, patch: pytest.MonkeyPatch) -> None:
        self.context, self.namespace, self._capture, self._log = context, "", capture, ""
        self.clock, self.nodes, self.voices, self._alarms = FakeTime(), [], [], []
        self.seen: dict[str, Any] = defaultdict(Messages)
        watched = WATCHED.keys() - {"compensator/markers"}  # which take long to make; a test of them listens to them
        self.listeners: list[tuple[str, Any]] = [("/" + topic.lstrip("/"), self.seen[topic]) for topic in watched]
        self._waiting: deque[tuple[Any, Any]] = deque()
        self._due: dict[Any, float] = {}
        self._handling, self._publishers, self._numbers = False, {}, dict[Any, int]()
        self._matched: dict[Any, Any] = {}
        rig = self

        class Alarm(rclpy_compat.Alarm):
            def __init__(self, *arguments: Any) -> None:
                rig._alarms.append(self)
                super().__init__(*arguments)

        class AtOnce:  # in place of a thread
            def __init__(self, *_: object) -> None:
                self.shutdown = lambda **_: None

            def submit(self, call: Any, *arguments: Any) -> Future[Any]:
                future: Future[Any] = Future()
                try:
                    future.set_result(call(*arguments))
                except worker.WorkerError as error:
                    future.set_exception(error)
                return future

        class Process(worker._Process):  # in place of a process; requests and answers are still pickled
            def exchange(self, request: Any, within: float | None) -> Any:
                self.jobs = getattr(self, "jobs", None) or Jobs()
                return pickle.loads(pickle.dumps(self.jobs.do(*pickle.loads(pickle.dumps(request)))))

        def clocked(simulated: Any = None) -> StampClock:
            return StampClock(simulated, rig.clock.time_ns, rig.clock.monotonic_ns)

        patch.setattr(Source, "model", READ_MODEL)
        patch.setattr(Source, "geometry", READ_GEOMETRY)
        for name, module in list(sys.modules.items()):
            if name.startswith(("hexapod_comp.ros.", "hexapod_comp.linuxcnc.", "hexapod_comp.testing.bench")):
                for what, stand_in in (("time", self.clock), ("Alarm", Alarm), ("StampClock", clocked)):
                    if hasattr(module, what) and name != "hexapod_comp.ros.rclpy_compat":
                        patch.setattr(module, what, stand_in)
        patch.setattr(rclpy_compat, "time", self.clock)
        patch.setattr(rclpy_compat, "Thread", lambda **_: SimpleNamespace(start=lambda: None, join=lambda: None))
        patch.setattr(worker, "_Process", Process)
        patch.setattr(worker, "ThreadPoolExecutor", AtOnce)
        clock = self.clock
        patch.setattr(
            "hexapod_comp.ros.base.publishers", lambda node, topic: (tuple(sorted(set(self.speakers(topic)))), "")
        )
        patch.setattr("hexapod_comp.ros.base.callers", lambda node, service: "/witness")
        without_dds = {"Publisher": End, "Subscription": End, "Service": End, "LifecycleStateMachine": Lifecycle}
        rclpy_without_dds = SimpleNamespace(**{**vars(_rclpy), **without_dds})
        patch.setattr("rclpy.node._rclpy", rclpy_without_dds)
        patch.setattr("rclpy.lifecycle.node._rclpy", rclpy_without_dds)
        make, make_publisher = Node.create_subscription, Node.create_publisher
        self.ros_clock = SimpleNamespace(now=lambda: Time(nanoseconds=clock.time_ns(), clock_type=ClockType.ROS_TIME))
        self.witness = Stranger(self, "witness")

        def create_subscription(
            node: Node, *arguments: Any, event_callbacks: Any = None, **options: Any
        ) -> Subscription:
            made = make(node, *arguments, event_callbacks=SubscriptionEventCallbacks(**NO_EVENTS), **options)
            self._matched[made] = event_callbacks
            return made

        def create_publisher(node: Node, *arguments: Any, event_callbacks: Any = None, **options: Any) -> Publisher:
            return make_publisher(node, *arguments, event_callbacks=PublisherEventCallbacks(**NO_EVENTS), **options)

        patch.setattr(Node, "create_publisher", create_publisher)
        patch.setattr(Publisher, "wait_for_all_acked", lambda *_: True)
        patch.setattr(Node, "create_subscription", create_subscription)
        for end in (Subscription, Publisher):  # rclpy asks C for the name each time
            once = cached_property(end.topic_name.fget)
            once.__set_name__(end, "topic_name")
            patch.setattr(end, "topic_name", once)
        patch.setattr(Node, "get_clock", lambda node: self.ros_clock)
        patch.setattr(Node, "count_publishers", lambda node, topic: len(self.speakers(topic)))
        patch.setattr(Subscription, "get_publisher_count", lambda end: len(self.speakers(end.topic_name)))
        patch.setattr(Publisher, "get_subscription_count", lambda end: self.audience(end.topic_name))
        patch.setattr(Publisher, "publish", lambda end, message: self._published(end, message))
        patch.setattr(Service, "send_response", lambda service, response, header: header.append(response))
        for topic in SENT.keys() - {"strut_commands", "strut_setpoints"}:
            self.add_publisher(topic)

    def close(self, *_: object) -> None:
        for node in self.nodes:
            node.destroy_node()

    # ---- publishers and subscribers ----

    def speakers(self, topic: str) -> list[str]:
        """Return the full name of each publisher's node."""
        ours = [f"/{node.get_name()}" for node in self.nodes for end in node.publishers if end.topic_name == topic]
        return ours + [voice.name for voice in self.voices if voice.topic_name == topic]

    def audience(self, topic: str, listeners: bool = True) -> int:
        """Return the number of subscribers of a topic: nodes and the test's own."""
        nodes = sum(end.topic_name == topic for node in self.nodes for end in node.subscriptions)
        return nodes + listeners * sum(name == topic for name, _ in self.listeners)

    def add_publisher(self, topic: str) -> None:
        self._publishers[topic] = Voice(self, topic, SENT[topic], "/witness")

    def remove_publisher(self, topic: str) -> None:
        if topic in self._publishers:
            self._publishers.pop(topic).close()

    def matched_anew(self, topic: str) -> None:
        """Let the nodes notice that a publisher has come or gone."""
        for node in self.nodes:
            for end in node.subscriptions:
                if end.topic_name == topic and self._matched.get(end) is not None:
                    self._matched[end].matched(None)

    # ---- messages ----

    def _published(self, publisher: Publisher, message: Any) -> None:
        name, self._numbers[publisher] = publisher.topic_name, self._numbers.get(publisher, 0) + 1
        if not self.audience(name):
            return
        data = message if isinstance(message, bytes) else bytes(serialize_message(message))
        for topic, callback in list(self.listeners):
            if topic == name and isinstance(callback, Messages):
                callback.add(data, publisher.msg_type)
            elif topic == name:
                callback(deserialize_message(data, publisher.msg_type))
        self.route(name, data, self._numbers[publisher])

    def route(self, topic: str, data: bytes, number: int | None) -> None:
        """Deliver a message to the subscribed nodes, after earlier messages."""
        for node in self.nodes:
            self._waiting += [(end, (data, number)) for end in node.subscriptions if end.topic_name == topic]
        self._handle()

    def _handle(self) -> None:
        if self._handling:
            return
        self._handling = True
        try:
            while self._waiting:
                end, (data, number) = self._waiting.popleft()
                if end._callback_type.name == "WithMessageInfo":
                    end.callback(data, {"publication_sequence_number": number})
                else:
                    end.callback(data if end.raw else deserialize_message(data, end.msg_type))
        finally:
            self._handling = False

    # ---- time ----

    def step(self, seconds: float) -> None:
        """Advance the clock; call what is due on the way in the order of time."""
        end = self.clock.passed + round(seconds * 1e9)
        while self.clock.passed < end:
            self._advance(end)

    def _advance(self, end: int) -> None:
        """Advance the clock, by a multiple of TICK, to the next time at which something is due."""
        timers, now = [timer for node in self.nodes for timer in node.timers], self.clock.monotonic()
        next_due = min((self._due.get(timer, now) for timer in timers), default=math.inf)
        next_due = min([next_due, *(alarm._due for alarm in self._alarms if alarm._open)])
        ticks = max(1, math.ceil((min(next_due - now, 1e3) / self.TICK) - 1e-6))
        self.clock.passed = min(end, self.clock.passed + ticks * round(self.TICK * 1e9))
        now = self.clock.monotonic()
        for timer in timers:
            period = timer.timer_period_ns * 1e-9
            if self._due.setdefault(timer, now + period) <= now:
                self._due[timer] = max(self._due[timer] + period, now)
                timer.callback()
        for alarm in [alarm for alarm in self._alarms if alarm._open and alarm._due <= now]:
            alarm._due = math.inf
            (alarm._tick if alarm._rate else alarm._callback)()
        self._handle()

    def until(self, condition: Any, what: str = "", timeout: float = 30.0) -> None:
        end = self.clock.passed + round(timeout * 1e9)
        while not condition():
            if self.clock.passed >= end:
                raise TimeoutError(f"waited {timeout} s in vain for: {what}")
            self._advance(end)

    def barrier(self) -> None:
        self._handle()

    def settle(self, pose: Pose) -> Answer:
        """Send a pose every 20 ms until two successive answers have equal corrections."""
        last, answer = self.ask(pose), self.ask(pose)
        while not (answer.corrections == last.corrections).all():
            self.step(0.02)
            last, answer = answer, self.ask(pose)
        return answer

    def matched(self) -> bool:
        return True

    # ---- nodes and services ----

    def host(self, node: Node) -> Node:
        self.nodes.append(node)
        return node

    def begin(self, name: str) -> Any:
        return self._request(Trigger, f"compensator/{name}", Trigger.Request())

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        future = self._request(kind, name, kind.Request() if request is None else request)
        self.until(future.done, f"answer of {name}", timeout=30.0)
        return future.result()

    def _request(self, kind: Any, name: str, request: Any) -> Any:
        answers: list[Any] = []
        (service,) = [one for node in self.nodes for one in node.services if one.service_name == f"/{name}"]
        service.send_response(service.callback(request, kind.Response()), answers)
        return SimpleNamespace(done=lambda: bool(answers), result=lambda: answers[0])


def closed_form_lengths(pose: Pose, a: float = 0.3, b: float = 0.572, d: float = 0.243) -> np.ndarray:
    """Return the paper machine's nominal strut lengths, m, from plane geometry, not from the package.

    The corners of an equiangular hexagon with sides b and d in turn lie on a circle of radius √((b² + bd + d²)/3), here
    with a side d across +x. The platform is an equilateral triangle of side a.
    """
    radius = np.sqrt((b * b + b * d + d * d) / 3.0)
    half = np.arcsin(d / (2.0 * radius))
    thirds = np.deg2rad([0.0, 120.0, 120.0, 240.0, 240.0, 360.0])
    corners = thirds + half * np.array([1, -1, 1, -1, 1, -1])
    tips = np.deg2rad([60.0, 60.0, 180.0, 180.0, 300.0, 300.0])
    base = radius * np.stack([np.cos(corners), np.sin(corners), 0 * corners], axis=1)
    platform = a / np.sqrt(3.0) * np.stack([np.cos(tips), np.sin(tips), 0 * tips], axis=1)
    return np.linalg.norm(pose.position + platform @ pose.rotation.T - base, axis=1)


def equal(one: object, other: object, atol: float = 1e-12) -> None:
    """Check lengths, m, to the rounding of a dozen operations on lengths below a metre; messages are exact."""
    np.testing.assert_allclose(one, other, rtol=0.0, atol=atol)


def near(pose: Pose, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), tilt_deg: float = 0.0) -> Pose:
    """Return a pose shifted along the base axes, m, and tilted about its own x axis."""
    turn = Rotation.from_euler("X", tilt_deg, degrees=True).as_matrix()
    return Pose(pose.position + shift, pose.rotation @ turn)


def geometry_file(folder: Path, limits: dict[str, object] | None = None, **sections: object) -> str:
    """Write the shipped geometry with other limits or sections into a folder; return its path."""
    data = yaml.safe_load((CONFIG / "paper.yaml").read_text(encoding="utf-8"))
    data["limits"].update(limits or {})
    data.update(sections)
    path = folder / "geometry.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


def model_file(folder: Path, name: str = "model.yaml", **sections: object) -> str:
    """Write a small model of the paper's machine into a folder; return its path."""
    data = {"format": "hexapod_comp/model", "version": 1, "machine": "paper", "name": "written by a test"}
    data.update({"date": "2026-01-31", "sources": []})
    data.update(sections)
    path = folder / name
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)
