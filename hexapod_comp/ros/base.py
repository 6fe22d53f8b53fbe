"""Shared by the package's lifecycle nodes: topics, timers and services under one guard, log, diagnostics.

doc/states.md has every state that compensator and drive report.
"""

from __future__ import annotations

import copy
import functools
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.logging import get_logging_directory
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from ..compensation.guards import EventWindow, OneSender, Sample, StampClock
from ..errors import LONGEST_TEXT, CommandError, HexapodError, printable
from .messages import read_message
from .parameters import Parameter, Parameters
from .rclpy_compat import (
    Alarm,
    PlainLogger,
    Throttle,
    callers,
    described,
    end_lifecycle,
    lifecycle_state,
    possible_only,
    publishers,
    sampled,
)


def profile(depth: int, reliable: bool = True, latched: bool = False) -> QoSProfile:
    """Return the QoS of a topic that keeps its last `depth` messages; latched: also for late subscribers."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


# Commands: each must arrive. A hundred wait while a busy processor pauses for 0.1 s at 1 kHz, or lost ones are
# repeated.
COMMAND_QOS = profile(100)

# Publishers of states: the newest only, to reliable subscribers too, as those with rclpy's defaults are
STATE_QOS = profile(1)

# Subscriptions of states, however published: only the newest counts, an old one need not be repeated
NEWEST_QOS = profile(1, reliable=False)

# Subscriptions of sensors, for any publisher's QoS
SENSOR_QOS = profile(10, reliable=False)

# Rare messages, each of which counts: diagnostics, markers
EVENT_QOS = profile(10)

# A state that late subscribers must receive too
LATCHED_QOS = profile(1, latched=True)

# QoS policies of a topic that a user may override by parameters; subscriptions have no lifespan
OVERRIDES = QoSOverridingOptions(
    (
        QoSPolicyKind.HISTORY,
        QoSPolicyKind.DEPTH,
        QoSPolicyKind.RELIABILITY,
        QoSPolicyKind.DEADLINE,
        QoSPolicyKind.LIFESPAN,
    )
)

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

TRANSITIONS = ("on_configure", "on_activate", "on_deactivate", "on_cleanup", "on_shutdown")

CHECK_PERIOD = 0.05  # Period at which a node evaluates its state, s
STATUS_PERIOD = 1.0  # A status is published at once when level or text change, and after this time, s

# Longest wait for the last message's acknowledgement: DDS may take 3 s, and dead subscribers never send it
ACKNOWLEDGED_WITHIN = Duration(seconds=0.4)


# ---- what a node reports ----

LEAST_ROOM = 65_536  # A file system with less free space, byte, is full: a few hundred lines of log


def status_prefix(namespace: str, node: str) -> str:
    return f"{namespace.strip('/')}/{node}:".lstrip("/")


def status_of(
    name: str, hardware_id: str, level: bytes, text: str, values: Mapping[str, str], longest: int = LONGEST_TEXT
) -> DiagnosticStatus:
    status = DiagnosticStatus(level=level, name=printable(name), hardware_id=printable(hardware_id))
    status.message = printable(text, longest)
    status.values = [KeyValue(key=key, value=printable(value, longest)) for key, value in values.items()]
    return status


def joined(findings: Iterable[tuple[bytes, str]]) -> tuple[bytes, str]:
    """Return level and text of all findings that are not OK, worst first; of the first when all are OK."""
    listed = list(findings)
    bad = [finding for finding in listed if finding[0] != OK] or listed[:1]
    return bad[0][0], "; ".join(text for _, text in bad)


def seconds(value: float) -> str:
    """Return an age as text: ``never`` when it is infinite."""
    return "never" if value == math.inf else f"{value:.3f}"


class Flow:
    """Counts events; returns their rate and the age of the last one."""

    def __init__(self) -> None:
        self.count, self.last = 0, -math.inf
        self._since, self._before, self._rate = time.monotonic(), 0, 0.0

    def tick(self, now: float) -> None:
        self.count += 1
        self.last = now

    def age(self, now: float) -> float:
        return now - self.last

    def rate(self, now: float) -> float:
        if (span := now - self._since) >= 1.0:
            self._rate = (self.count - self._before) / span
            self._since, self._before = now, self.count
        return self._rate


class Refusals:
    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._lately: dict[str, EventWindow] = {}
        self.last_reason = self.last_text = ""

    @property
    def total(self) -> int:
        return sum(self.counts.values())

    def add(self, reason: str, text: str, now: float) -> None:
        self.counts[reason] += 1
        self._lately.setdefault(reason, EventWindow()).note(now)
        self._lately[reason] = self._lately.pop(reason)  # the newest stands last
        self.last_reason, self.last_text = reason, text

    def recent(self, now: float) -> bool:
        """Return whether one is recent enough to be shown as an error."""
        return bool(self.reasons(now))

    def reasons(self, now: float, but: str = "") -> str:
        """Return all reasons `but` one recent enough to be shown, the newest first: none must hide another."""
        recent = [reason for reason, lately in self._lately.items() if lately.holds(now)]
        return ", ".join(reason for reason in reversed(recent) if reason != but)

    def values(self) -> dict[str, str]:
        counts = {f"refused.{reason}": str(count) for reason, count in sorted(self.counts.items())}
        return {"refused": str(self.total), **counts}


def log_problem(folder: str = "") -> str:
    """Return why ROS's log cannot be written, empty if it can: only the nodes can report that nothing is written any
    more. Takes a few microseconds on a local file system."""
    folder = folder or str(get_logging_directory())
    try:
        usage = os.statvfs(folder)
    except FileNotFoundError:
        return ""  # nothing is logged to files
    except OSError as error:
        return f"log folder lost: {error.strerror}"
    return f"log disk full: {folder}" if usage.f_bavail * usage.f_frsize < LEAST_ROOM else ""


# ---- the node ----


class CallbackGuard:
    """The guard around everything that ROS calls in a node: it catches and counts what a callback raises.

    A message, a timer, an event or a request must not end a running machine's node, whoever sent it and whatever the
    error. An exception caught here was not foreseen elsewhere, so it is an error for a second. A service also answers:
    anyone may request a transition that is not allowed now, and rclpy raises then.
    """

    def __init__(self, warn: Callable[[str, str], None], complain: Callable[[str, str], None]) -> None:
        self._warn, self._complain = warn, complain  # log with a cause, for throttling
        self._caught, self._requests = Refusals(), Refusals()
        self.request = ""  # name of the service that is answering; empty between requests

    def caught(self, what: str, error: Exception) -> None:
        """Count and log an exception of a callback."""
        text = printable(f"{what}: {described(error)}", LONGEST_TEXT)
        self._caught.add(what, text, time.monotonic())
        self._complain(what, f"error in a callback, the node goes on: {text}")

    def around(self, what: str, callback: Callable[..., Any], otherwise: Any = None) -> Callable[..., Any]:
        """Return a callback that never raises; it returns `otherwise` instead."""

        @functools.wraps(callback)  # rclpy inspects the number of arguments of callbacks
        def guarded(*arguments: Any, **keywords: Any) -> Any:
            try:
                return callback(*arguments, **keywords)
            except Exception as error:  # of any kind: this is the guard's purpose
                self.caught(what, error)
                return otherwise

        return guarded

    def answering(self, name: str, kind: Any, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service's callback that refuses a request when the given one raises: unset fields of the response
        are false or empty."""

        def answer(request: Any, response: Any) -> Any:
            self.request = name
            try:
                return callback(request, response)
            except Exception as error:  # rclpy's own errors, Python's where it does not check: of many kinds
                text, refusal = printable(str(error), LONGEST_TEXT), kind.Response()
                self._requests.add(name, text, time.monotonic())
                self._warn(name, f"{name} refused: {text}")
                if isinstance(refusal, SetParameters.Response):
                    refusal.results = [SetParametersResult(reason=text) for _ in request.parameters]
                elif hasattr(refusal, "message"):
                    refusal.message = text
                return refusal
            finally:
                self.request = ""

        return answer

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        if reasons := self._caught.reasons(now):
            yield ERROR, f"error in a callback: {reasons}"

    def values(self) -> dict[str, str]:
        return {
            "callback_errors": str(self._caught.total),
            "last_callback_error": self._caught.last_text,
            "refused_requests": str(self._requests.total),
        }


class MachineNode(LifecycleNode):
    """A lifecycle node with a table of parameters. ROS calls everything here through a :class:`CallbackGuard`.

    A node overrides `configure`, which opens its topics, timers and services: all that was opened since then is closed
    with its configuration. `findings` and `values` are its state.

    A user may override the QoS of topics by parameters. rclpy writes the overrides into the given profile, so every
    topic gets its own copy. A ParameterError reports a parameter's invalid value.
    """

    def __init__(self, name: str, table: Sequence[Parameter] = (), **options: Any) -> None:
        self._active = self.configured = False
        self._throttle = Throttle()
        self.guard = CallbackGuard(self.log_warning, self.log_error)
        for change in TRANSITIONS:  # rclpy would swallow their exceptions silently
            setattr(self, change, self.guard.around(change, getattr(self, change), TransitionCallbackReturn.ERROR))
        super().__init__(name, **options)
        self._logger = PlainLogger(self.get_logger().name, lambda: bool(self.guard.request))
        for service in self.services:  # create_service does not make the lifecycle's services
            callback = service.callback
            callback = possible_only(self, callback) if service.srv_type is ChangeState else callback
            service.callback = self.guard.answering(service.srv_name, service.srv_type, callback)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        diagnostics = functools.partial(self.create_publisher, DiagnosticArray, "/diagnostics", EVENT_QOS)
        self._diagnostics_pub: Publisher = self._when_matched(
            "/diagnostics", PublisherEventCallbacks, diagnostics, self._renew_status
        )
        self._status_shown: tuple[bytes, str] | None = None
        self.set_hardware_id("")
        self._tickers: dict[str, Alarm] = {}
        self._options = Parameters(self, table, self.check_parameters, self._on_parameters)
        self.clock = StampClock(self.simulated_time())
        self._steps_logged = 0
        self.wants_autostart = bool(self._options.get("autostart", True))

    # ---- the lifecycle ----

    @property
    def unconfigured(self) -> bool:
        """Whether the node may be configured."""
        return lifecycle_state(self)[0] == State.PRIMARY_STATE_UNCONFIGURED

    @property
    def active(self) -> bool:
        return self._active

    def configure(self) -> None:
        """Make what the node needs, and open its topics; a HexapodError leaves it unconfigured."""

    def unconfigure(self) -> None:
        """End what `configure` has made beside topics, timers and services."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; after an error the node is as before."""
        self._permanent = self._open_ends()
        try:
            with self.rolled_back_on_error():
                self.configure()
                self.every(CHECK_PERIOD, self._check_state)
        except HexapodError as error:
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self.configured = True
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        if not self._active:
            self._active = True
            self.get_logger().info("ready")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close what was opened since `configure`."""
        self._active = self.configured = False
        self.unconfigure()
        self._close_since(self._permanent)
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop permanently: publish the last status, then close everything, so that nothing more is published."""
        self.publish_last_status()
        if state.state_id != State.PRIMARY_STATE_UNCONFIGURED:
            self.on_cleanup(state)
        return super().on_shutdown(state)

    def publish_last_status(self) -> None:
        """Publish the last status of a configured node, and wait until it has arrived."""
        if self.configured:
            self._active = False
            self._check_state()
            self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def destroy_node(self) -> None:
        """Leave ROS at once, with the lifecycle services."""
        for ticker in self._tickers.values():
            ticker.close()
        super().destroy_node()
        end_lifecycle(self)

    def _open_ends(self) -> list[Any]:
        return [*self.timers, *self.subscriptions, *self.services, *self.clients, *self.publishers]

    @contextmanager
    def rolled_back_on_error(self) -> Iterator[None]:
        """Close everything opened in this block if it raises, so that the node is as before."""
        before = self._open_ends()
        try:
            yield
        except BaseException:
            self._close_since(before)
            raise

    def _close_since(self, before: Sequence[Any]) -> None:
        for ticker in self._tickers.values():
            ticker.close()
        self._tickers.clear()
        self.close_ends(*(end for end in self._open_ends() if end not in before))

    def close_ends(self, *ends: Publisher | Subscription | Service | Timer | Client | None) -> None:
        kinds: tuple[tuple[type, Callable[[Any], Any]], ...] = (
            (Publisher, self.destroy_publisher),
            (Subscription, self.destroy_subscription),
            (Service, self.destroy_service),
            (Timer, self.destroy_timer),
            (Client, self.destroy_client),
        )
        for end in ends:
            for kind, destroy in kinds:
                if isinstance(end, kind):
                    destroy(end)

    # ---- parameters and time ----

    def _on_parameters(self, names: set[str]) -> None:
        for name in names & self._tickers.keys():
            self._tickers[name].set_rate(self._options[name])
        self.on_parameters(names)

    def check_parameters(self, values: dict[str, Any]) -> None:
        """Refuse, by a ParameterError, values that are allowed, but not now."""

    def on_parameters(self, names: set[str]) -> None:
        """Apply parameters that have been set while the node runs; called at other times too, with no names."""

    def simulated_time(self) -> Callable[[], int] | None:
        """Return a function that reads the simulated time, ns; None if the time is the system's."""
        simulated = bool(self.get_parameter("use_sim_time").value)
        return (lambda: int(self.get_clock().now().nanoseconds)) if simulated else None

    def every(self, period: float, callback: Callable[[], None]) -> Timer:
        """Return a timer on a clock that cannot be set: the node's own would stop while it is set back.

        Its period stays, and it is never reset: see :class:`~.rclpy_compat.Alarm`.
        """
        return self.create_timer(period, callback, clock=self._steady)

    def at_rate(self, name: str, callback: Callable[[], None]) -> Alarm:
        """Return a timer whose rate is a parameter, which may change at any time; 0: never."""
        self._tickers[name] = ticker = Alarm(self, self.guard.around(name, callback), self._options[name])
        return ticker

    # ---- topics and services ----

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Subscription:
        guarded = self.guard.around(topic, callback)
        return super().create_subscription(msg_type, topic, guarded, *arguments, **options)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Timer:
        guarded = self.guard.around(getattr(callback, "__name__", "timer").strip("_"), callback)
        return super().create_timer(timer_period_sec, guarded, *arguments, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Service:
        """Return a service that refuses a request where its callback raises."""
        guarded = self.guard.answering(srv_name, srv_type, callback)
        return super().create_service(srv_type, srv_name, guarded, *arguments, **options)

    def create_logged_service(self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any]) -> Service:
        """Return a service that logs which nodes may have called: after an accident the first question is who."""

        def logged(request: Any, response: Any) -> Any:
            name = srv_name.removeprefix("~/")
            self.note(name, f"{name}: asked for by {callers(self, service)}")
            return callback(request, response)

        service = self.create_service(srv_type, srv_name, logged)
        return service

    def publish_on(self, message_type: type, topic: str, qos: QoSProfile, deadline: float = 0.0) -> Publisher:
        """Return a publisher; it offers `deadline`, s, between messages, 0: none."""
        qos = copy.copy(qos)
        qos.deadline = Duration(seconds=deadline)
        return self.create_publisher(message_type, topic, qos, qos_overriding_options=OVERRIDES)

    def subscribe(
        self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> Subscription:
        """Return a subscription of what any node may publish; what cannot be read, or is too long, is ignored."""

        def receive(data: bytes) -> None:
            try:
                message = read_message(data, message_type)
            except CommandError:
                return
            callback(message)

        qos = copy.copy(qos)
        return self.create_subscription(message_type, topic, receive, qos, qos_overriding_options=OVERRIDES, raw=True)

    def subscribe_exclusive(
        self,
        message_type: type,
        topic: str,
        callback: Callable[[bytes, Sample], None],
        several: bool,
        qos: QoSProfile = COMMAND_QOS,
    ) -> OneSender:
        """Subscribe to what only one node may publish, unless `several` may; return the guard of its sender.

        The callback gets the message's bytes, so that it need not read what is too long. Where the middleware tells
        that a publisher comes or goes, or a message shows a second one, :meth:`update_publishers` is called at once.
        """

        full = self.resolve_topic_name(topic)
        names = functools.partial(publishers, self, full)
        sender = OneSender(full, lambda: int(subscription.get_publisher_count()), names, several)

        def on_matched() -> None:
            if subscription in self.subscriptions:  # the event of one that has been closed meanwhile
                self.update_publishers()

        caught = functools.partial(self.guard.caught, topic)
        make = functools.partial(
            super().create_subscription,
            message_type,
            topic,
            sampled(callback, sender, self.update_publishers, caught),
            copy.copy(qos),
            qos_overriding_options=OVERRIDES,
            raw=True,
        )
        subscription = self._when_matched(topic, SubscriptionEventCallbacks, make, on_matched)
        return sender

    def _when_matched(self, topic: str, events: type, make: Callable[..., Any], callback: Callable[[], None]) -> Any:
        """Make an end of a topic that calls back, where the middleware can tell, when one at the other end comes or
        goes."""
        try:
            guarded = self.guard.around(f"matching of {topic}", lambda _: callback())
            return make(event_callbacks=events(matched=guarded))
        except UnsupportedEventTypeError:
            return make()

    def update_publishers(self) -> None:
        """Update who publishes what only one node may; called when a publisher comes or goes, and periodically."""

    def sole_publisher(self, own: Publisher, several: bool) -> OneSender:
        """Return the guard of a topic that only this node may publish, unless `several` may."""
        count = functools.partial(self.count_publishers, own.topic_name)
        names = functools.partial(publishers, self, own.topic_name)
        return OneSender(own.topic_name, count, names, several, self.get_fully_qualified_name())

    # ---- log and diagnostics ----

    def log_warning(self, cause: str, text: str) -> None:
        """Log a warning, once per cause and second."""
        if (line := self._throttle.allow(cause, text)) is not None:
            self.get_logger().warning(line, throttled=True)

    def log_error(self, cause: str, text: str) -> None:
        """Log an error, once per cause and second."""
        if (line := self._throttle.allow(cause, text)) is not None:
            self.get_logger().error(line, throttled=True)

    def ignore(self, what: str, error: HexapodError, counts: Refusals, reason: str = "") -> None:
        """Count and log a message that an active node rejects, by the error's reason unless another is given."""
        if self._active:
            counts.add(reason := reason or error.reason, str(error), time.monotonic())
            self.log_warning(f"{what} {reason}", f"{what} ignored: {error}")

    def note(self, cause: str, text: str) -> None:
        """Log an action, once per cause and second."""
        if (line := self._throttle.allow(f"note {cause}", text)) is not None:
            self.get_logger().info(line)

    def report(
        self, what: str, level: bytes, text: str, values: Mapping[str, str], longest: int = LONGEST_TEXT
    ) -> DiagnosticStatus:
        """Return a status of this node: its state, or of something that it does."""
        name = f"{self.get_fully_qualified_name()[1:]}: {what}"
        return status_of(name, self.hardware_id, level, text, values, longest)

    def set_hardware_id(self, what: str) -> None:
        """Set the hardware_id of this node's status to the machine or component it serves, with the namespace, so that
        two of a kind are distinguished. The status's name stays: an aggregator would otherwise wait for the old one for
        ever."""
        self.hardware_id = f"{self.get_namespace()}/{what}".strip("/")
        self._status_due = 0.0

    def update(self, now: float) -> None:
        """Do what is due every :data:`CHECK_PERIOD` of a configured node, before its state is judged."""
        self.update_publishers()

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield level and text of an active node's findings, worst first."""
        yield OK, "running"

    def values(self, now: float) -> dict[str, str]:
        """Return all else of the node's state as key and value."""
        return {}

    def _renew_status(self) -> None:
        """Let a new subscriber get the status with the next check: what was published before its discovery is lost to
        it."""
        self._status_due = 0.0

    def _check_state(self) -> None:
        """Publish the state when it is due, with the guard's findings; log steps of the clock."""
        now = time.monotonic()
        self.update(now)
        findings = self.findings(now) if self._active else [(WARN, "not active")]
        log = log_problem()
        level, text = joined([*self.guard.findings(now), joined(findings), (WARN if log else OK, log)])
        self.clock.read()
        if (steps := self.clock.set_back + self.clock.set_forward) != self._steps_logged:
            self._steps_logged = steps
            step = self.clock.last_step * 1e-9
            self.log_warning("clock", f"the clock was set {'back' if step < 0 else 'forward'} by {abs(step):.3f} s")
        if (level, text) != self._status_shown or now >= self._status_due:
            self._status_shown, self._status_due = (level, text), now + STATUS_PERIOD
            values = {**self.values(now), **self.guard.values()}
            array = DiagnosticArray(status=[self.report("state", level, text, values)])
            array.header.stamp = self.get_clock().now().to_msg()
            self._diagnostics_pub.publish(array)
