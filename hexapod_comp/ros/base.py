"""Base class of the package's lifecycle nodes: topics, timers and services whose callbacks cannot end the node, a log
with limited rate, and diagnostics. doc/states.md lists every state that compensator and drive report."""

from __future__ import annotations

import copy
import functools
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

from ..compensation.guards import EventWindow, Guard, OneSender, Sample, StampClock
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
    """Return the QoS of a topic with a queue of `depth` messages; if `latched`, new subscribers get the queue."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


# QoS of commands: reliable, since each command must arrive. The queue holds 0.1 s of commands at 1 kHz, while the
# processor is busy or DDS sends lost messages again.
COMMAND_QOS = profile(100)

# QoS of published states: only the newest is kept; reliable, since rclpy's default QoS of subscribers requires it
STATE_QOS = profile(1)

# QoS of subscribed states: only the newest is kept; best effort, which matches reliable and best-effort publishers
NEWEST_QOS = profile(1, reliable=False)

# QoS of subscribed sensors: best effort, which matches reliable and best-effort publishers
SENSOR_QOS = profile(10, reliable=False)

# QoS of rare messages that must not be lost: diagnostics, markers, requests for moves
EVENT_QOS = profile(10)

# QoS of states that late subscribers must receive too
LATCHED_QOS = profile(1, latched=True)

# QoS policies that a user may override for each topic by parameters; rclpy has no lifespan of subscriptions
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
STATUS_PERIOD = 1.0  # Longest time between two published statuses, s; a changed level or text is published at once

# Longest wait until a node's last message is acknowledged: DDS may take 3 s, and a killed subscriber never replies
ACKNOWLEDGED_WITHIN = Duration(seconds=0.4)


# ---- what a node reports ----

LEAST_ROOM = 65_536  # Free space, byte, for a few hundred log lines; a disk with less is reported as full


def status_prefix(namespace: str, node: str) -> str:
    return f"{namespace.strip('/')}/{node}:".lstrip("/")


def hardware_id(namespace: str, machine: str) -> str:
    return printable(f"{namespace}/{machine}".strip("/"))


def joined(findings: Iterable[tuple[bytes, str]]) -> tuple[bytes, str]:
    """Return the first level that is not OK, and the texts of all findings not OK; if all are OK, the first finding."""
    listed = list(findings)
    bad = [finding for finding in listed if finding[0] != OK] or listed[:1]
    return bad[0][0], "; ".join(text for _, text in bad)


def seconds(value: float) -> str:
    """Return an age in s as text; ``never`` for infinity, the age of an event that has not occurred."""
    return "never" if value == math.inf else f"{value:.3f}"


class Flow:
    """Counter of events: their number, their rate over about one second (Hz), and the age of the last event (s)."""

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
    """Counts refused messages for each reason, and keeps the reasons of recent refusals for the node's status."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._windows: dict[str, EventWindow] = {}
        self.last_reason = self.last_text = ""

    @property
    def total(self) -> int:
        return sum(self.counts.values())

    def add(self, reason: str, text: str, now: float) -> None:
        self.counts[reason] += 1
        window = self._windows.pop(reason, EventWindow())
        window.note(now)
        self._windows[reason] = window  # moves the reason to the end: reasons are in the order of their newest refusal
        self.last_reason, self.last_text = reason, text

    def recent(self, now: float) -> bool:
        """Return whether a message was refused in the last second, or since the previous query."""
        return bool(self.reasons(now))

    def reasons(self, now: float, but: str = "") -> str:
        """Return the reasons of recent refusals as text, newest first, except the reason `but`."""
        recent = [reason for reason, window in self._windows.items() if window.holds(now)]
        return ", ".join(reason for reason in reversed(recent) if reason != but)

    def values(self) -> dict[str, str]:
        counts = {f"refused.{reason}": str(count) for reason, count in sorted(self.counts.items())}
        return {"refused": str(self.total), **counts}


def log_problem(folder: str = "") -> str:
    """Return why ROS cannot write its log files; empty if ROS can write them."""
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
    """Wrapper that catches, counts and logs every exception of a node's callbacks, so that none ends the node.

    After an exception the node's status shows an error for one second; a service answers with a refusal.
    """

    def __init__(self, log_warning: Callable[[str, str], None], log_error: Callable[[str, str], None]) -> None:
        # The two functions take the cause and the text, and log each cause at most once per second.
        self._log_warning, self._log_error = log_warning, log_error
        self._caught, self._requests = Refusals(), Refusals()
        self.request = ""  # name of the service that is answering; empty between requests

    def caught(self, what: str, error: Exception) -> None:
        text = printable(f"{what}: {described(error)}", LONGEST_TEXT)
        self._caught.add(what, text, time.monotonic())
        self._log_error(what, f"error in a callback, the node keeps running: {text}")

    def around(self, what: str, callback: Callable[..., Any], otherwise: Any = None) -> Callable[..., Any]:
        """Return a function that returns the result of `callback`, or `otherwise` if `callback` raises an exception."""

        @functools.wraps(callback)  # rclpy inspects the number of a callback's arguments
        def guarded(*arguments: Any, **keywords: Any) -> Any:
            try:
                return callback(*arguments, **keywords)
            except Exception as error:
                self.caught(what, error)
                return otherwise

        return guarded

    def answering(self, name: str, kind: Any, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service callback that calls `callback` and, if this raises, answers with the exception's text."""

        def answer(request: Any, response: Any) -> Any:
            self.request = name
            try:
                return callback(request, response)
            except Exception as error:
                text, refusal = printable(str(error), LONGEST_TEXT), kind.Response()
                self._requests.add(name, text, time.monotonic())
                self._log_warning(name, f"{name} refused: {text}")
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
    """Lifecycle node with a table of parameters; a :class:`CallbackGuard` catches the exceptions of its callbacks.

    A subclass opens its topics, timers and services in `configure`; cleanup closes them. `findings` and `values` give
    the node's status in `/diagnostics`. The constructor raises a ParameterError if a parameter's value is invalid.
    """

    def __init__(self, name: str, table: Sequence[Parameter] = (), **options: Any) -> None:
        self._active = self.configured = False
        self._throttle = Throttle()
        self.guard = CallbackGuard(self.log_warning, self.log_error)
        for change in TRANSITIONS:  # rclpy would catch an exception in a transition and log nothing
            setattr(self, change, self.guard.around(change, getattr(self, change), TransitionCallbackReturn.ERROR))
        super().__init__(name, **options)
        self._logger = PlainLogger(self.get_logger().name, lambda: bool(self.guard.request))
        for service in self.services:  # the lifecycle's services: rclpy does not create them by create_service
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
        self.options = Parameters(self, table, self.check_parameters, self._on_parameters)
        simulated = bool(self.get_parameter("use_sim_time").value)
        self.clock = StampClock((lambda: int(self.get_clock().now().nanoseconds)) if simulated else None)
        self._steps_logged = 0
        self.wants_autostart = bool(self.options.get("autostart", True))

    # ---- the lifecycle ----

    @property
    def unconfigured(self) -> bool:
        return lifecycle_state(self)[0] == State.PRIMARY_STATE_UNCONFIGURED

    @property
    def active(self) -> bool:
        return self._active

    def configure(self) -> None:
        """Read the files that the node needs and open its topics; a HexapodError leaves the node unconfigured."""

    def unconfigure(self) -> None:
        """End what `configure` has started besides topics, timers and services, such as processes."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._permanent = self._entities()
        try:
            self.configure()
            self.every(CHECK_PERIOD, self._check_state)
            self.configured = True
        except HexapodError as error:
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        finally:
            if not self.configured:
                self._close_since(self._permanent)
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
        self._active = self.configured = False
        self.unconfigure()
        self._close_since(self._permanent)
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish the last status, then close all topics, so that nothing more is published."""
        self.publish_last_status()
        if state.state_id != State.PRIMARY_STATE_UNCONFIGURED:
            self.on_cleanup(state)
        return super().on_shutdown(state)

    def publish_last_status(self) -> None:
        """If the node is configured, publish the status `not active`; wait up to 0.4 s for its arrival."""
        if self.configured:
            self._active = False
            self._check_state()
            self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def destroy_node(self) -> None:
        for ticker in self._tickers.values():
            ticker.close()
        super().destroy_node()
        end_lifecycle(self)

    def _entities(self) -> list[Any]:
        return [*self.timers, *self.subscriptions, *self.services, *self.clients, *self.publishers]

    def _close_since(self, before: Sequence[Any]) -> None:
        for ticker in self._tickers.values():
            ticker.close()
        self._tickers.clear()
        self.close_entities(*(entity for entity in self._entities() if entity not in before))

    def close_entities(self, *entities: Publisher | Subscription | Service | Timer | Client | None) -> None:
        kinds: tuple[tuple[type, Callable[[Any], Any]], ...] = (
            (Publisher, self.destroy_publisher),
            (Subscription, self.destroy_subscription),
            (Service, self.destroy_service),
            (Timer, self.destroy_timer),
            (Client, self.destroy_client),
        )
        for entity in entities:
            for kind, destroy in kinds:
                if isinstance(entity, kind):
                    destroy(entity)

    # ---- parameters and time ----

    def _on_parameters(self, names: set[str]) -> None:
        for name in names & self._tickers.keys():
            self._tickers[name].set_rate(self.options[name])
        self.on_parameters(names)

    def check_parameters(self, values: dict[str, Any]) -> None:
        """Raise a ParameterError if one of the allowed `values` cannot be set in the node's present state."""

    def on_parameters(self, names: set[str]) -> None:
        """Apply parameters that were set while the node runs."""

    def every(self, period: float, callback: Callable[[], None]) -> Timer:
        """Return a timer that calls back every `period` seconds of the monotonic clock, which is never set back.

        Do not reset this timer or change its period; the docstring of :class:`~.rclpy_compat.Alarm` states why.
        """
        return self.create_timer(period, callback, clock=self._steady)

    def at_rate(self, name: str, callback: Callable[[], None]) -> Alarm:
        """Return a timer that always runs at the rate, Hz, in the node's parameter `name`; the rate 0 stops it."""
        self._tickers[name] = ticker = Alarm(self, self.guard.around(name, callback))
        ticker.set_rate(self.options[name])
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
        guarded = self.guard.answering(srv_name, srv_type, callback)
        return super().create_service(srv_type, srv_name, guarded, *arguments, **options)

    def create_logged_service(self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any]) -> Service:
        """Return a service that logs, at each call, the nodes with a client of the service: one of them has called."""

        def logged(request: Any, response: Any) -> Any:
            name = srv_name.removeprefix("~/")
            self.log_action(name, f"{name}: asked for by {callers(self, service)}")
            return callback(request, response)

        service = self.create_service(srv_type, srv_name, logged)
        return service

    def publish_on(self, message_type: type, topic: str, qos: QoSProfile, deadline: float = 0.0) -> Publisher:
        """Return a publisher whose QoS promises a message at least every `deadline` seconds; 0 promises nothing."""
        qos = copy.copy(qos)  # rclpy writes the user's overrides into the profile
        qos.deadline = Duration(seconds=deadline)
        return self.create_publisher(message_type, topic, qos, qos_overriding_options=OVERRIDES)

    def subscribe(
        self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> Subscription:
        """Subscribe to a topic with any number of publishers; ignore messages that are unreadable or too long."""

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
        """Subscribe to a topic that only one node may publish, unless `several` is true; return the topic's guard.

        `callback` receives the message's bytes, so that it can reject a long message before parsing it.
        :meth:`update_publishers` is called when the number of publishers changes, or a second publisher sends.
        """
        full = self.resolve_topic_name(topic)
        names = functools.partial(publishers, self, full)
        sender = OneSender(full, lambda: int(subscription.get_publisher_count()), names, several)

        def on_matched() -> None:
            if subscription in self.subscriptions:  # events may still arrive after the subscription was closed
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
        """Create a publisher or subscription; `callback` is called when a peer comes or goes, if the rmw reports it."""
        try:
            guarded = self.guard.around(f"matching of {topic}", lambda _: callback())
            return make(event_callbacks=events(matched=guarded))
        except UnsupportedEventTypeError:
            return make()

    def update_publishers(self) -> None:
        """Have every :class:`.OneSender` count publishers: every 50 ms, and when a publisher comes or goes."""

    def sole_publisher(self, own: Publisher, several: bool) -> OneSender:
        """Return a guard that reports other nodes that publish on the topic of `own`, unless `several` is true."""
        count = functools.partial(self.count_publishers, own.topic_name)
        names = functools.partial(publishers, self, own.topic_name)
        return OneSender(own.topic_name, count, names, several, self.get_fully_qualified_name())

    # ---- log, at most once per second for each cause, and diagnostics ----

    def log_warning(self, cause: str, text: str) -> None:
        if (line := self._throttle.allow(cause, text)) is not None:
            self.get_logger().warning(line, throttled=True)

    def log_error(self, cause: str, text: str) -> None:
        if (line := self._throttle.allow(cause, text)) is not None:
            self.get_logger().error(line, throttled=True)

    def ignore(self, what: str, error: HexapodError, counts: Refusals, reason: str = "") -> None:
        """If the node is active, count and log a rejected message; `reason` replaces the error's reason."""
        if self._active:
            counts.add(reason := reason or error.reason, str(error), time.monotonic())
            self.log_warning(f"{what} {reason}", f"{what} ignored: {error}")

    def log_action(self, cause: str, text: str) -> None:
        if (line := self._throttle.allow(f"action {cause}", text)) is not None:
            self.get_logger().info(line, throttled=True)

    def report(
        self, what: str, level: bytes, text: str, values: Mapping[str, str], longest: int = LONGEST_TEXT
    ) -> DiagnosticStatus:
        """Return a DiagnosticStatus with the name ``NODE: WHAT``, and with texts of at most `longest` characters."""
        name = printable(f"{self.get_fully_qualified_name()[1:]}: {what}")
        listed = [KeyValue(key=key, value=printable(value, longest)) for key, value in values.items()]
        return DiagnosticStatus(
            level=level, name=name, hardware_id=self.hardware_id, message=printable(text, longest), values=listed
        )

    def set_hardware_id(self, what: str) -> None:
        """Set the status's hardware_id, for aggregators: the namespace and `what`, a machine's or component's name."""
        self.hardware_id = hardware_id(self.get_namespace(), what)
        self._status_due = 0.0

    def update(self, now: float) -> None:
        """Do the periodic work of a configured node, every :data:`CHECK_PERIOD`, before it evaluates its status."""
        self.update_publishers()

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield level and text of each state that the active node's status reports, the worst state first."""
        yield OK, "running"

    def values(self, now: float) -> dict[str, str]:
        return {}

    def _renew_status(self) -> None:
        """Publish the status at the next check, for a subscriber that has just been discovered."""
        self._status_due = 0.0

    def _check_state(self) -> None:
        """Publish the status if it has changed or a second has passed; log when the clock was set."""
        now = time.monotonic()
        self.update(now)
        findings = self.findings(now) if self._active else [(WARN, "not active")]
        others = [log_problem(), "" if self.clock.read() else "use_sim_time: no time from /clock yet"]
        warnings = ((WARN if problem else OK, problem) for problem in others)
        level, text = joined([*self.guard.findings(now), joined(findings), *warnings])
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


class CommandedNode(MachineNode):
    """Lifecycle node that receives a stream of commands; each of the :attr:`command_guards` checks every command."""

    command_sender: OneSender  # guard against a second publisher of commands
    command_guards: tuple[Guard, ...]  # in the order of their checks; a guard with a problem refuses all commands

    def __init__(self, name: str, table: Sequence[Parameter], **options: Any) -> None:
        super().__init__(name, table, **options)
        self.commands, self.refusals = Flow(), Refusals()  # accepted and refused commands

    def acting_guard(self) -> Guard | None:
        return next((guard for guard in self.command_guards if guard.problem), None)

    def silent(self, now: float) -> bool:
        return bool(self.commands.count) and 0.0 < self.options["command_timeout"] < self.commands.age(now)

    def refusing(self, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield level and text of the reasons for which commands are or were recently refused."""
        guard = self.acting_guard()
        if guard is not None:
            yield ERROR, f"refusing commands: {guard.reason}: {guard.problem}"
        if reasons := self.refusals.reasons(now, guard.reason if guard is not None else ""):
            yield ERROR, f"refusing commands: {reasons}"

    def command_values(self, now: float) -> dict[str, str]:
        return {
            "commanded_by": ", ".join(self.command_sender.names),
            "commands": str(self.commands.count),
            "commands_missed": str(self.command_sender.missed),
            "command_rate_hz": f"{self.commands.rate(now):.1f}",
            "command_age_s": seconds(self.commands.age(now)),
            "clock_set_back": str(self.clock.set_back),
            "clock_set_forward": str(self.clock.set_forward),
            "last_refusal": self.refusals.last_text,
            **self.refusals.values(),
        }
