"""What both nodes share: parameters, the spin loop, signals, log throttling."""

from __future__ import annotations

import copy
import difflib
import functools
import gc
import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from ..errors import HexapodError
from .log_relay import LogRelay
from .middleware import avoid_shared_memory
from .refusing import unfailing

SPIN_PERIOD = 0.1
"""Longest wait of one spin, s: how soon a signal is noticed (EventsExecutor.spin itself never returns)."""

COMMAND_QOS = QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
"""Commands: each must arrive. A hundred wait while a busy processor pauses for 0.1 s at 1 kHz, or a cable repeats."""

STATE_QOS = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Measured states: only the newest counts, and an old one is not worth repeating."""

EVENT_QOS = QoSProfile(depth=10, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.RELIABLE)
"""Rare messages, each of which counts: temperatures, diagnostics, markers."""

ACKNOWLEDGED_WITHIN = Duration(seconds=0.4)
"""How long the last message waits to be acknowledged: that may take DDS 3 s, and the dead never do it."""


class ParameterError(HexapodError):
    """A parameter's value is not allowed."""

    reason = "bad_parameter"


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node.

    Parameters
    ----------
    name : str
        Its name.
    default : bool, int, float or str
        Default, which also fixes the type; an int is accepted for a float.
    description : str
        What it means, with its unit.
    low, high : float, optional
        Allowed range of a number.
    read_only : bool
        Fixed at start; the others may be set while the node runs.
    """

    name: str
    default: bool | int | float | str
    description: str
    low: float | None = None
    high: float | None = None
    read_only: bool = True


def declare(node: LifecycleNode, parameters: Sequence[Parameter]) -> dict[str, Any]:
    """Declare parameters and return their checked values.

    Raises
    ------
    ParameterError
        Wrong type or out of range; names parameter, value and what is allowed.
    """
    values = {}
    for parameter in parameters:
        descriptor = ParameterDescriptor(
            description=_described(parameter), read_only=parameter.read_only, dynamic_typing=True
        )
        if isinstance(parameter.default, float) and parameter.low is not None:
            bounds = FloatingPointRange(from_value=float(parameter.low), to_value=float(parameter.high or 1e9))
            descriptor.floating_point_range = [bounds]
        try:
            found = node.declare_parameter(parameter.name, parameter.default, descriptor).value
        except rclpy.exceptions.InvalidParameterValueException as error:
            raise ParameterError(f"parameter {parameter.name}: {error}") from error
        values[parameter.name] = checked(parameter, found)
    _warn_of_strangers(node)
    return values


def _described(parameter: Parameter) -> str:
    if parameter.low is None:
        return parameter.description
    upper = "" if parameter.high is None else f" to {parameter.high:g}"
    return f"{parameter.description} (from {parameter.low:g}{upper})"


def checked(parameter: Parameter, value: Any) -> Any:
    """Return `value` as the parameter's type, or refuse it.

    Raises
    ------
    ParameterError
        Wrong type or out of range; an int is taken for a float.
    """
    wanted = type(parameter.default)
    if wanted is float and type(value) is int:
        value = float(value)
    if type(value) is not wanted:
        raise ParameterError(f"parameter {parameter.name}: must be {wanted.__name__}, not {value!r}")
    if isinstance(value, int | float) and wanted is not bool:
        low = -float("inf") if parameter.low is None else parameter.low
        high = float("inf") if parameter.high is None else parameter.high
        if not low <= value <= high:
            raise ParameterError(f"parameter {parameter.name}: must lie in {low:g}…{high:g}, not {value!r}")
    return value


def _warn_of_strangers(node: LifecycleNode) -> None:
    """Warn of overrides that no declared parameter takes: most likely misspelt."""
    declared = set(node.get_parameters_by_prefix(""))
    for name in getattr(node, "_parameter_overrides", {}):
        if name not in declared and not name.startswith("qos_overrides."):
            near = difflib.get_close_matches(name, declared, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            node.get_logger().warning(f"there is no parameter {name}, it is ignored{hint}")


class MachineNode(LifecycleNode):
    """What the package's lifecycle nodes have in common: when they act, throttled warnings, topics.

    Topics have a QoS that a user may override by parameters. rclpy writes the overrides into the profile
    that it is given, so every topic gets a copy of its own.
    """

    wants_autostart = True

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._active = False
        self._throttle = Throttle()
        for service in self.services:  # those that rclpy has made
            service.callback = unfailing(service, self.get_logger().warning)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting; the struts keep their last command."""
        self._active = False
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting for good."""
        self._active = False
        return super().on_shutdown(state)

    def warn_of(self, cause: str, text: str) -> None:
        """Log a warning, once per cause and second."""
        held = self._throttle.passes(cause)
        if held is not None:
            self.get_logger().warning(text + (f" ({held} more like it)" if held else ""))

    def publish_on(self, message_type: type, topic: str, qos: QoSProfile) -> Publisher:
        """Return a publisher."""
        options = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(message_type, topic, copy.copy(qos), qos_overriding_options=options)

    def every(self, period: float, callback: Callable[[], None]) -> Timer:
        """Return a timer on a clock that nobody can set: the node's own stops for as long as it is set back."""
        return self.create_timer(period, callback, clock=self._steady)

    def listen_to(
        self, message_type: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile
    ) -> Subscription:
        """Return a subscription."""
        options = QoSOverridingOptions.with_default_policies()
        return self.create_subscription(message_type, topic, callback, copy.copy(qos), qos_overriding_options=options)

    def obey(
        self,
        message_type: type,
        topic: str,
        callback: Callable[[Any, int | None], None],
        matched: Callable[[], None],
        raw: bool = False,
    ) -> Subscription:
        """Return a subscription of commands.

        Its callback gets the message, or with `raw` its bytes, and the message's sequence number; `matched` is called
        when a publisher comes or goes, where the middleware tells (who wants to be sure also looks now and then).
        """
        make = functools.partial(
            self.create_subscription,
            message_type,
            topic,
            numbered(callback),
            copy.copy(COMMAND_QOS),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            raw=raw,
        )

        def on_matched(_: Any) -> None:
            if subscription in self.subscriptions:  # told of a subscription that has been closed meanwhile
                matched()

        try:
            subscription = make(event_callbacks=SubscriptionEventCallbacks(matched=on_matched))
        except UnsupportedEventTypeError:
            subscription = make()
        return subscription

    def say_goodbye(self) -> None:
        """Publish what must still be said before the node ends."""

    def destroy_node(self) -> None:
        """Leave ROS at once, lifecycle services included.

        rclpy leaves those to the garbage collector: a node that somebody still refers to would go on to offer
        services that nobody answers.
        """
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()


def numbered(callback: Callable[[Any, int | None], None]) -> Callable[..., None]:
    """Return a callback for rclpy that hands on a message and its publisher's sequence number.

    rclpy asks a callback's signature whether it wants to be told about the message, and then calls it with two
    arguments; the EventsExecutor of Jazzy (rclpy 7.1) calls it with a tuple of the two instead.
    """

    def called(*arguments: Any) -> None:
        message, info = arguments[0] if len(arguments) == 1 else arguments
        callback(message, info["publication_sequence_number"])

    called.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return called


class LateService:
    """A service whose answer may come after its callback has returned: the node goes on in between.

    Parameters
    ----------
    node : LifecycleNode
        Where it is.
    kind : type
        Service type.
    name : str
        Its name.
    callback : callable
        Takes the request; returns the response, or None: then :meth:`answer` gives it later. Only one request
        at a time may be left without an answer.
    """

    def __init__(self, node: LifecycleNode, kind: type, name: str, callback: Callable[[Any], Any]) -> None:
        self.service = node.create_service(kind, name, lambda request, _: callback(request))
        self._send, self._header = self.service.send_response, cast(Any, None)
        # Executors call it with what the callback returns.
        self.service.send_response = self._send_or_keep  # type: ignore[method-assign]

    def _send_or_keep(self, response: Any, header: Any) -> None:
        if response is None:
            self._header = header
        else:
            self._send(response, header)

    def answer(self, response: Any) -> None:
        """Answer the request that waits."""
        header, self._header = self._header, None
        if header is not None:
            self._send(response, header)


class Throttle:
    """Lets one message per cause and second through, and counts what it held back."""

    def __init__(self, period: float = 1.0) -> None:
        self._period = period
        self._last: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def passes(self, cause: str) -> int | None:
        """Return how many of this cause were held back since the last, or None to hold this one back."""
        now = time.monotonic()
        if now - self._last.get(cause, -1e9) < self._period:
            self._held[cause] = self._held.get(cause, 0) + 1
            return None
        self._last[cause] = now
        return self._held.pop(cause, 0)


def autostart(node: LifecycleNode) -> bool:
    """Configure and activate a node; return whether both went well."""
    done = TransitionCallbackReturn.SUCCESS
    return node.trigger_configure() == done and node.trigger_activate() == done


def keep_discovery_local() -> None:
    """Keep discovery to this machine, and out of shared memory, unless the user's environment says otherwise."""
    avoid_shared_memory()
    if "ROS_STATIC_PEERS" not in os.environ:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def run(make_node: Callable[[], MachineNode], argv: Sequence[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM.

    Signals only set a flag, since rclpy's own handling loses the last message and exits non-zero on a
    second Ctrl-C, which ``ros2 launch`` sends.

    Returns
    -------
    int
        0 after a signal, 1 when the node could not start.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with LogRelay():
        return _run_until(stop, make_node, argv)


def _run_until(stop: threading.Event, make_node: Callable[[], MachineNode], argv: Sequence[str] | None) -> int:
    try:
        rclpy.init(args=list(argv) if argv is not None else None, signal_handler_options=SignalHandlerOptions.NO)
    except (rclpy.exceptions.ROSInterruptException, RuntimeError, ValueError) as error:
        print(f"cannot start ROS: {error}", file=sys.stderr)
        return 1
    try:
        node = make_node()
    except HexapodError as error:
        print(f"cannot start: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        if node.wants_autostart and not autostart(node):
            return 1
        # What is loaded by now stays; the collector need not look at it again while the machine moves.
        gc.collect()
        gc.freeze()
        while not stop.is_set() and rclpy.ok():
            executor.spin_once(timeout_sec=SPIN_PERIOD)
        node.say_goodbye()
        return 0
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
        # Python puts its own handlers back while it shuts down; a second Ctrl-C would then end us with -2.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
