"""Callbacks that know a message's sequence number, alarms, and services that answer later: rclpy lacks them."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable
from threading import Condition, Thread
from typing import Any, cast

from rclpy.node import Node
from rclpy.service import Service


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


class Alarm:
    """Calls back once, in the executor, a while after it was set; it may be set as often as one likes.

    A timer may not be reset while a node runs: at each reset the EventsExecutor of Jazzy (rclpy 7.1) calls every timer
    that is due once more, and puts its next call off by a period: a check every 50 ms rested for seconds.

    Parameters
    ----------
    node : Node
        In whose executor.
    callback : callable
        What is called.
    """

    def __init__(self, node: Node, callback: Callable[[], None]) -> None:
        self._node, self._callback = node, callback
        self._change, self._open, self._due = Condition(), True, float("inf")
        self._thread = Thread(target=self._wait, name="alarm", daemon=True)
        self._thread.start()

    def set(self, seconds: float) -> None:
        """Call back in so many seconds, and not when it was set to before; never, if infinite."""
        with self._change:
            self._due = time.monotonic() + seconds
            self._change.notify()

    def close(self) -> None:
        """Call back no more."""
        with self._change:
            self._open = False
            self._change.notify()
        self._thread.join()

    def _wait(self) -> None:
        with self._change:
            while self._open:
                left = self._due - time.monotonic()
                if left > 0.0:
                    self._change.wait(None if left == float("inf") else left)
                else:
                    executor = self._node.executor  # that of Jazzy knows no guard conditions
                    if executor is not None and self._node not in executor.get_nodes():
                        executor = None
                    self._due = float("inf") if executor is not None else time.monotonic() + 0.1
                    if executor is not None:
                        executor.create_task(self._callback)


class Ticker:
    """Calls back, in the executor, at a rate that may change at any time, which neither moves a tick that is due nor
    touches a timer; a rate that changes a hundred times a second makes it tick no more often than the fastest.

    Parameters
    ----------
    node : Node
        In whose executor.
    callback : callable
        What is called.
    rate : float
        Hz; 0: never.
    """

    def __init__(self, node: Node, callback: Callable[[], None], rate: float) -> None:
        self._callback, self._rate, self._last = callback, 0.0, time.monotonic()
        self._alarm = Alarm(node, self._tick)
        self.set_rate(rate)

    def set_rate(self, rate: float) -> None:
        """Go on at another rate, Hz, counted from the last tick; 0: rest."""
        if rate != self._rate:
            self._rate = rate
            self._wait(time.monotonic())

    def close(self) -> None:
        """Call back no more."""
        self._rate = 0.0
        self._alarm.close()

    def _wait(self, now: float) -> None:
        self._alarm.set(max(0.0, self._last + 1.0 / self._rate - now) if self._rate else float("inf"))

    def _tick(self) -> None:
        if not self._rate:
            return  # it was closed or put to rest while this tick was on its way
        now = time.monotonic()
        due = self._last + 1.0 / self._rate
        self._last = due if now - due < 1.0 / self._rate else now  # in step, but what was missed is not made up for
        self._wait(now)
        self._callback()


class LateAnswer:
    """What lets a service's callback return None: its answer then comes later, and the node goes on in between.

    Parameters
    ----------
    service : Service
        Only one of its requests at a time may be left without an answer.
    """

    def __init__(self, service: Service) -> None:
        self.service = service
        self._send, self._header = service.send_response, cast(Any, None)
        # Executors call it with what the callback returns.
        service.send_response = self._send_or_keep  # type: ignore[method-assign]

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
