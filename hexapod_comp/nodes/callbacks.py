"""Callbacks that know a message's sequence number, and services that answer later: rclpy offers neither openly."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, cast

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
