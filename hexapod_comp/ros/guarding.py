"""The one guard around everything that ROS calls in a node: no callback may end a running machine's node."""

from __future__ import annotations

import functools
import inspect
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.impl import rcutils_logger

from ..errors import LONGEST_TEXT, printable
from .health import ERROR, Refusals


class CallbackGuard:
    """Catches what a callback raises, counts it, and lets it be said.

    A message, a timer, an event or a request must not end a node, whoever sent it and whatever is wrong with it or
    with us. What is caught here was foreseen nowhere else, so it is an error for :data:`~.health.SHOWN_FOR`.
    A service also answers: anybody may ask for a transition that is not allowed now, and rclpy raises then.

    Parameters
    ----------
    warn, complain : callable
        Log a warning and an error: take its cause, for throttling, and the text.

    Attributes
    ----------
    request : str
        Name of the service that answers at this moment; empty between requests.
    """

    def __init__(self, warn: Callable[[str, str], None], complain: Callable[[str, str], None]) -> None:
        self._warn, self._complain = warn, complain
        self._caught, self._requests = Refusals(), Refusals()
        self.request = ""

    def around(self, what: str, callback: Callable[..., Any], otherwise: Any = None) -> Callable[..., Any]:
        """Return a callback that never raises; it returns `otherwise` instead.

        Parameters
        ----------
        what : str
            Whose callback: a topic, a timer's function.
        callback : callable
            What ROS would call.
        otherwise : object
            What is returned in place of a result.
        """

        @functools.wraps(callback)  # rclpy asks callbacks how many arguments they take
        def guarded(*arguments: Any, **keywords: Any) -> Any:
            try:
                return callback(*arguments, **keywords)
            except Exception as error:  # of any kind: that is what the guard is for
                text = printable(f"{what}: {described(error)}", LONGEST_TEXT)
                self._caught.add(what, text, time.monotonic())
                self._complain(what, f"error in a callback, the node goes on: {text}")
                return otherwise

        return guarded

    def answering(self, name: str, kind: Any, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return a service's callback that refuses a request where the one it has would raise."""

        def answer(request: Any, response: Any) -> Any:
            self.request = name
            try:
                return callback(request, response)
            except Exception as error:  # rclpy's own errors, Python's where it does not check: of many kinds
                text = printable(str(error), LONGEST_TEXT)
                self._requests.add(name, text, time.monotonic())
                self._warn(name, f"{name} refused: {text}")
                return refusal(kind, request, text)
            finally:
                self.request = ""

        return answer

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield what diagnostics have to say at the monotonic time `now`, s."""
        if reasons := self._caught.reasons(now):
            yield ERROR, f"error in a callback: {reasons}"

    def values(self) -> dict[str, str]:
        """Return the counters as key and value."""
        return {
            "callback_errors": str(sum(self._caught.counts.values())),
            "last_callback_error": self._caught.last_text,
            "refused_requests": str(sum(self._requests.counts.values())),
        }


def described(error: BaseException) -> str:
    """Return an error with its kind and the line that raised it."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = f" ({os.path.basename(trace.tb_frame.f_code.co_filename)}:{trace.tb_lineno})" if trace else ""
    return f"{type(error).__name__}: {error}{where}"


def refusal(kind: Any, request: Any, reason: str) -> Any:
    """Return the response of a service type that says no: what is not filled in is false or empty."""
    response = kind.Response()
    if isinstance(response, SetParameters.Response):
        response.results = [SetParametersResult(reason=reason) for _ in request.parameters]
    elif hasattr(response, "message"):
        response.message = reason
    return response


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

    def allow(self, cause: str, text: str) -> str | None:
        """Return the text to be logged, which says what was held back, or None to hold this one back."""
        held = self.passes(cause)
        return None if held is None else text + (f" ({held} more like it)" if held else "")


class PlainLogger(rcutils_logger.RcutilsLogger):
    """A node's logger that writes one printable line for each message, whatever has been quoted in it.

    Anybody may send requests, as fast as he likes. So what is logged while one is answered, by us or by rclpy, is
    throttled: one line a second from each line of source.

    Parameters
    ----------
    name : str
        As of rclpy's logger.
    guard : CallbackGuard
        Knows when a request is answered.
    """

    def __init__(self, name: str, guard: CallbackGuard) -> None:
        super().__init__(name)
        self._guard, self._throttle = guard, Throttle()

    def log(self, message: str, severity: Any, throttled: bool = False, **keywords: Any) -> bool:
        """Log a message, which the caller may have throttled; other arguments are those of rclpy's logger."""
        text: str | None = printable(str(message), LONGEST_TEXT)
        if self._guard.request and not throttled:
            caller = rcutils_logger._find_caller(inspect.currentframe())
            text = self._throttle.allow(f"{caller.f_code.co_filename}:{caller.f_lineno}", str(text))
        return text is not None and bool(super().log(text, severity, **keywords))


# rclpy keeps one severity for each line of source that logs; those above call for others.
rcutils_logger._internal_callers.append(os.path.realpath(__file__))
