"""All workarounds for rclpy, and uses of its private parts, each with the version and the reason.

rclpy 7.1 is that of Jazzy. When a later version is better, code here can be removed without other changes.
"""

from __future__ import annotations

import inspect
import os
import time
from collections.abc import Callable, Iterable
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
    """Return a callback for rclpy that never raises, and passes on a message with its sample; `second` is called when
    the message's sequence number shows a second sender.

    rclpy inspects a callback's signature for the message info, and then calls it with two arguments; the EventsExecutor
    of rclpy 7.1 calls it with a tuple of the two instead.
    """

    def called(*arguments: Any) -> None:
        try:
            message, info = arguments[0] if len(arguments) == 1 else arguments
            sample = Sample(time.monotonic())
            if sender.receive(info["publication_sequence_number"], sample.now):
                second()
            callback(message, sample)
        except Exception as error:  # of any kind: see CallbackGuard
            failed(error)

    called.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return called


class Alarm:
    """Calls back in the node's executor: once, a while after it was `set`, or at a `rate`; both may change at any time.

    A timer may not be reset while a node runs: at each reset the EventsExecutor of rclpy 7.1 calls every due timer once
    more, and postpones its next call by a period: a check every 50 ms did not run for seconds. A rate that changes
    neither shifts a due tick nor makes it tick more often than the fastest.
    """

    def __init__(self, node: Node, callback: Callable[[], None], rate: float = 0.0) -> None:
        self._node, self._callback = node, callback
        self._change, self._open, self._due = Condition(), True, float("inf")
        self._rate, self._last = 0.0, time.monotonic()
        self._thread = Thread(target=self._wait, name="alarm", daemon=True)
        self._thread.start()
        self.set_rate(rate)

    def set(self, seconds: float) -> None:
        """Call back after this time, s, instead of the previous one; never, if infinite."""
        with self._change:
            self._due = time.monotonic() + seconds
            self._change.notify()

    def set_rate(self, rate: float) -> None:
        """Tick on at another rate, Hz, counted from the last tick; 0: rest."""
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
            return  # it was closed or stopped while this tick was pending
        now, period = time.monotonic(), 1.0 / self._rate
        due = self._last + period
        self._last = due if now - due < period else now  # in step; missed ticks are not repeated
        self._set_next(now)
        self._callback()

    def _wait(self) -> None:
        with self._change:
            while self._open:
                left = self._due - time.monotonic()
                if left > 0.0:
                    self._change.wait(None if left == float("inf") else left)
                    continue
                executor = self._node.executor  # that of Jazzy knows no guard conditions
                if executor is None or self._node not in executor.get_nodes():
                    self._due = time.monotonic() + 0.1
                else:
                    self._due = float("inf")
                    executor.create_task(self._tick if self._rate else self._callback)


class LateAnswer:
    """Lets a service's callback return None: its answer then follows later, and the node continues in between. rclpy
    7.1 lacks this: executors send what the callback returns. Only one request at a time may be pending."""

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
    """Return the callback of ``change_state`` for possible transitions alone: of others rcl 9.2 logs each request."""

    def checked(request: Any, response: Any) -> Any:
        wanted, machine = request.transition, node._state_machine
        possible = {t[1] if wanted.label else t[0] for t in machine.available_transitions}
        if (wanted.label or wanted.id) not in possible:
            name, state = shorten(wanted.label) if wanted.label else wanted.id, machine.current_state[1]
            raise CommandError("transition", f"there is no transition {name} from state {state}")
        return change(request, response)

    return checked


def lifecycle_state(node: LifecycleNode) -> tuple[int, str]:
    """Return id and name of a node's state; a node of rclpy 7.1 offers it by a service, but not to itself."""
    number, name = node._state_machine.current_state
    return int(number), str(name)


def end_lifecycle(node: LifecycleNode) -> None:
    """Destroy the lifecycle's services with the node: rclpy 7.1 leaves them to the garbage collector, and a node that
    is still referenced would continue to offer services that are never answered."""
    node._state_machine.destroy_when_not_in_use()


def overrides(node: Node) -> Iterable[str]:
    """Return the names of all parameters that a user has set, whether declared or not: rclpy 7.1 keeps them."""
    return getattr(node, "_parameter_overrides", {})


# ---- the graph ----


def full_name(info: Any) -> str:
    name = info.node_name
    return name if name == UNKNOWN_NAME else f"{info.node_namespace.rstrip('/')}/{name}"


def publishers(node: Node, topic: str) -> tuple[tuple[str, ...], str]:
    """Return the nodes that publish a topic, each once, and why they cannot be named: a node's name may be any bytes,
    which rclpy 7.1 cannot return."""
    try:
        return tuple(sorted({full_name(info) for info in node.get_publishers_info_by_topic(topic)})), ""
    except UnicodeDecodeError as error:
        return (), f"a node's name is not UTF-8: {shorten(error.object)}"
    except Exception as error:  # of many kinds: others control the content of the graph
        return (), described(error)


def callers(node: Node, service: Service) -> str:
    """Return the nodes that have a client of a service, for the log: one of them has called.

    rclpy 7.1 gives a callback only the number of the request, not its caller; requests are a topic of DDS, and the
    graph lists its publishers. After an accident the first question is who has reset the machine; only the log can
    answer it.
    """
    try:
        infos = node.get_publishers_info_by_topic(f"rq{service.service_name}Request", no_mangle=True)
        names = sorted({full_name(info) for info in infos})
    except Exception as error:  # of many kinds, as above
        return f"somebody unknown ({described(error)})"
    return " or ".join(names) or "a node that has left"


def described(error: BaseException) -> str:
    """Return an error with its kind and the line that raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = f" ({os.path.basename(trace.tb_frame.f_code.co_filename)}:{trace.tb_lineno})" if trace else ""
    return f"{type(error).__name__}: {error}{where}"


# ---- the log ----


class Throttle:
    """Lets one message per cause and second through, and counts what it held back."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def allow(self, cause: str, text: str) -> str | None:
        """Return the text to be logged, with the number of suppressed ones, or None to suppress this one."""
        now = time.monotonic()
        if now - self._last.get(cause, -1e9) < 1.0:
            self._held[cause] = self._held.get(cause, 0) + 1
            return None
        self._last[cause] = now
        held = self._held.pop(cause, 0)
        return text + (f" ({held} more like it)" if held else "")


class PlainLogger(rcutils_logger.RcutilsLogger):
    """A node's logger that writes one printable line for each message, whatever text it quotes.

    Anyone may send requests at any rate. So log messages during a request, ours or rclpy's, are throttled: one line a
    second from each line of source.
    """

    def __init__(self, name: str, answering: Callable[[], bool]) -> None:
        super().__init__(name)
        self._answering, self._throttle = answering, Throttle()

    def log(self, message: str, severity: Any, throttled: bool = False, **keywords: Any) -> bool:
        """Log a message, which the caller may have throttled; other arguments are those of rclpy's logger."""
        text: str | None = printable(str(message), LONGEST_TEXT)
        if self._answering() and not throttled:
            caller = rcutils_logger._find_caller(inspect.currentframe())
            text = self._throttle.allow(f"{caller.f_code.co_filename}:{caller.f_lineno}", str(text))
        return text is not None and bool(super().log(text, severity, **keywords))


# rclpy 7.1 keeps one severity for each line of source that logs; those above call for others.
rcutils_logger._internal_callers.append(os.path.realpath(__file__))
