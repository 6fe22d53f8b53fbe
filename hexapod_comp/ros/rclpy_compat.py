"""All workarounds for rclpy (7.1 in ROS 2 Jazzy) and uses of its private attributes, each with version and reason."""

from __future__ import annotations

import inspect
import os
import time
from collections.abc import Callable, Mapping
from threading import Condition, Thread
from typing import Any, cast

from rclpy.impl import rcutils_logger
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.service import Service

from ..compensation.guards import UNKNOWN_NAME, OneSender, Sample
from ..errors import LONGEST_TEXT, CommandError, printable, shorten

# ---- callbacks ----


def sampled(
    callback: Callable[[bytes, Sample], None],
    sender: OneSender,
    second: Callable[[], None],
    failed: Callable[[Exception], None],
) -> Callable[..., None]:
    """Return a subscription's callback that calls `callback` with the message and a new Sample.

    The returned callback first calls `second` if the message's sequence number shows a second sender, and calls
    `failed` with any exception that `second` or `callback` raises. rclpy passes a message and its info as two
    arguments, but the EventsExecutor of rclpy 7.1 passes both in one tuple.
    """

    def called(*arguments: Any) -> None:
        try:
            message, info = arguments[0] if len(arguments) == 1 else arguments
            sample = Sample(time.monotonic())
            if sender.receive(info["publication_sequence_number"], sample.now):
                second()
            callback(message, sample)
        except Exception as error:
            failed(error)

    called.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return called


class Alarm:
    """A timer that calls back in the node's executor: once after a time given to `set`, or at a rate that may change.

    Frequent resets of an rclpy timer can delay another timer with a period of 50 ms by seconds: at each reset, the
    EventsExecutor of rclpy 7.1 postpones every due timer by one period of that timer.
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        self._node, self._callback = node, callback
        self._change, self._open, self._due = Condition(), True, float("inf")
        self._rate, self._last = 0.0, time.monotonic()
        self._thread = Thread(target=self._wait, name="alarm", daemon=True)
        self._thread.start()

    def set(self, seconds: float) -> None:
        """Call back once, `seconds` from now, in place of an earlier `set`; never if `seconds` is infinite."""
        with self._change:
            self._due = time.monotonic() + seconds
            self._change.notify()

    def set_rate(self, rate: float) -> None:
        """Call back `rate` times a second, beginning one period after the last callback; never if `rate` is 0."""
        if rate != self._rate:
            self._rate = rate
            self._set_next(time.monotonic())

    def close(self) -> None:
        with self._change:
            self._open, self._rate = False, 0.0
            self._change.notify()
        self._thread.join()

    def _set_next(self, now: float) -> None:
        self.set(max(0.0, self._last + 1.0 / self._rate - now) if self._rate else float("inf"))

    def _tick(self) -> None:
        if not self._rate:
            return  # close() or set_rate(0) came before this call
        now, period = time.monotonic(), 1.0 / self._rate
        due = self._last + period
        self._last = due if now - due < period else now  # missed calls are left out
        self._set_next(now)
        self._callback()

    def _wait(self) -> None:
        with self._change:
            while self._open:
                left = self._due - time.monotonic()
                if left > 0.0:
                    self._change.wait(None if left == float("inf") else left)
                    continue
                executor = self._node.executor  # of tasks, since Jazzy's EventsExecutor has no guard conditions
                if executor is None or self._node not in executor.get_nodes():
                    self._due = time.monotonic() + 0.1
                else:
                    self._due = float("inf")
                    executor.create_task(self._tick if self._rate else self._callback)


class LateAnswer:
    """A service whose callback may return None: then :meth:`answer` sends the response later. In rclpy 7.1 a service
    sends the result of its callback at once."""

    def __init__(self, service: Service) -> None:
        self.service, self._send, self._header = service, service.send_response, cast(Any, None)

        def send_or_keep(response: Any, header: Any) -> None:
            if response is None:
                self._header = header
            else:
                self._send(response, header)

        service.send_response = send_or_keep  # type: ignore[method-assign]

    def answer(self, response: Any) -> None:
        header, self._header = self._header, None
        if header is not None:
            self._send(response, header)


# ---- the lifecycle ----


def possible_only(node: LifecycleNode, change: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a callback of ``change_state`` that refuses impossible transitions; rcl 9.2 would log each request."""

    def checked(request: Any, response: Any) -> Any:
        wanted, machine = request.transition, node._state_machine
        possible = {t[1] if wanted.label else t[0] for t in machine.available_transitions}
        if (wanted.label or wanted.id) not in possible:
            name, state = shorten(wanted.label) if wanted.label else wanted.id, machine.current_state[1]
            raise CommandError("transition", f"there is no transition {name} from state {state}")
        return change(request, response)

    return checked


def lifecycle_state(node: LifecycleNode) -> tuple[int, str]:
    """Return the id and the name of a node's lifecycle state, which rclpy 7.1 gives only by a service."""
    number, name = node._state_machine.current_state
    return int(number), str(name)


def end_lifecycle(node: LifecycleNode) -> None:
    """Destroy a node's lifecycle services, which rclpy 7.1 keeps, without answering calls, until the node is freed."""
    node._state_machine.destroy_when_not_in_use()


def overrides(node: Node) -> Mapping[str, Any]:
    """Return all parameters, by name, that a user has set at the start, including undeclared parameters."""
    return getattr(node, "_parameter_overrides", {})


# ---- the graph ----


def full_name(info: Any) -> str:
    name = info.node_name
    return name if name == UNKNOWN_NAME else f"{info.node_namespace.rstrip('/')}/{name}"


def publishers(node: Node, topic: str) -> tuple[tuple[str, ...], str]:
    """Return the sorted full names of the nodes that publish a topic, and an empty text; or no names, and the text why
    rclpy 7.1 cannot read them, for example a name that is not UTF-8.
    """
    try:
        return tuple(sorted({full_name(info) for info in node.get_publishers_info_by_topic(topic)})), ""
    except UnicodeDecodeError as error:
        return (), f"a node's name is not UTF-8: {shorten(error.object)}"
    except Exception as error:  # any exception: other programs control the content of the graph
        return (), described(error)


def callers(node: Node, service: Service) -> str:
    """Return the names, joined by "or", of the nodes that have a client of a service. rclpy 7.1 does not name a call's
    sender, but the graph lists the publishers of the DDS topic on which the service receives requests."""
    try:
        infos = node.get_publishers_info_by_topic(f"rq{service.service_name}Request", no_mangle=True)
        names = sorted({full_name(info) for info in infos})
    except Exception as error:  # other programs control the content of the graph
        return f"an unknown node ({described(error)})"
    return " or ".join(names) or "a node that has left"


def described(error: BaseException) -> str:
    """Return an exception's type, message, file and line as text."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = f" ({os.path.basename(trace.tb_frame.f_code.co_filename)}:{trace.tb_lineno})" if trace else ""
    return f"{type(error).__name__}: {error}{where}"


# ---- the log ----


class Throttle:
    """Limits a log to one message per second for each cause; a message states how many were suppressed before it."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def allow(self, cause: str, text: str) -> str | None:
        """Return the text to log, with the number of messages suppressed before, or None to suppress this one."""
        now = time.monotonic()
        if now - self._last.get(cause, -1e9) < 1.0:
            self._held[cause] = self._held.get(cause, 0) + 1
            return None
        self._last[cause] = now
        held = self._held.pop(cause, 0)
        return text + (f" ({held} more suppressed)" if held else "")


class PlainLogger(rcutils_logger.RcutilsLogger):
    """A node's logger that writes each message as one printable line, whatever text the message quotes.

    While the node answers a service request, each line of code that logs, also in rclpy, logs at most once per second,
    since other nodes may send requests at any rate.
    """

    def __init__(self, name: str, answering: Callable[[], bool]) -> None:
        super().__init__(name)
        self._answering, self._throttle = answering, Throttle()

    def log(self, message: str, severity: Any, throttled: bool = False, **keywords: Any) -> bool:
        """Log a message as rclpy's logger does; set `throttled` if the caller limits the rate of its messages."""
        text: str | None = printable(str(message), LONGEST_TEXT)
        if self._answering() and not throttled:
            caller = rcutils_logger._find_caller(inspect.currentframe())
            text = self._throttle.allow(f"{caller.f_code.co_filename}:{caller.f_lineno}", str(text))
        return text is not None and bool(super().log(text, severity, **keywords))


# rclpy 7.1 allows one severity for each logging line of code; with this file hidden, rclpy takes the caller's line
rcutils_logger._internal_callers.append(os.path.realpath(__file__))
