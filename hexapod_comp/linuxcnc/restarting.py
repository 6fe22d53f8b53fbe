"""Asking a compensator that refuses every command to start anew, as one does when the machine moved on unheard."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.task import Future
from std_srvs.srv import Trigger

from ..ros.health import ERROR, status_prefix
from ..ros.runtime import EVENT_QOS, MachineNode
from .bridge_status import BridgeStatus

RESET_AFTER = 0.15
"""A compensator that has been lost for so long is asked to start anew, s: it has forgotten its feedback by then."""

RESET_PERIOD = 0.5
"""The compensator is asked to start anew no more often than this, s."""

COMPLAINT_COUNTS_FOR = 1.2
"""The compensator's last diagnostics tell how it is for so long, s: it sends some every second."""


class CompensatorReset:
    """Calls ``compensator/reset`` when it helps.

    Only a compensator that complains is asked: requests to one that is stopped get lost, and DDS then keeps back those
    that follow for seconds.
    """

    def __init__(self, node: MachineNode, status: BridgeStatus, options: dict[str, Any]) -> None:
        self._node, self._status, self._options = node, status, options
        self._name = status_prefix(node.get_namespace(), "compensator")
        self._asked_at = self._complained_at = -math.inf
        self._in_vain = 0
        self._question: Future | None = None
        self._complaints = node.listen_to(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        self._client = node.create_client(Trigger, "compensator/reset")

    @property
    def in_vain(self) -> bool:
        """Whether it has been asked again, and still nothing was heard."""
        return self._in_vain > 1

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_client(self._client)
        self._node.destroy_subscription(self._complaints)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == ERROR and status.name.startswith(self._name):
                self._complained_at = time.monotonic()

    def ask(self, streaming_since: float, heard_at: float, now: float) -> None:
        """Ask if nothing was heard for too long, though commands have been sent since a while; monotonic times, s."""
        if heard_at > self._asked_at:
            self._in_vain = 0
        waited = now - max(streaming_since, heard_at)
        if waited < self._options["timeout"] + RESET_AFTER or now - self._asked_at < RESET_PERIOD:
            return
        if self._complained_at < heard_at or now - self._complained_at > COMPLAINT_COUNTS_FOR:
            return
        self._asked_at = now
        if not self._client.service_is_ready():
            return
        if self._question is not None:
            self._client.remove_pending_request(self._question)
        self._question = self._client.call_async(Trigger.Request())
        self._status.resets += 1
        self._in_vain += 1
        self._node.warn_of("reset", "the compensator refuses every command; asked it to start anew")
