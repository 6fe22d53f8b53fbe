"""Topics of readings that a compensator uses beside its struts: temperatures, loads, measured poses.

Each is handled in the same way: one publisher, a minimum period, a valid message; then its handler, which raises an
error about the content. A rejected reading, or a second publisher, is counted and reported, and stops nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ..compensation.guards import Sample
from ..errors import CommandError, HexapodError
from .base import SENSOR_QOS, MachineNode
from .messages import read_message
from .status import CompensatorStatus


class SensorTopic:
    """The subscription of one topic of readings.

    `handle` is called with each message and its time of arrival, monotonic, s; it raises a HexapodError to reject it.
    `reject` is called with that error; None: it is bad feedback. Messages within `period`, s, of the last good one are
    ignored.
    """

    def __init__(
        self,
        node: MachineNode,
        status: CompensatorStatus,
        topic: str,
        kind: type,
        handle: Callable[[Any, float], None],
        reject: Callable[[HexapodError], None] | None = None,
        period: float = 0.0,
        several: str = "allow_several_publishers",  # name of the parameter that allows a second publisher
    ) -> None:
        self._node, self._status, self._topic, self._kind, self._period = node, status, topic, kind, period
        self._handle, self._reject = handle, reject or self._bad_feedback
        self.last = math.nan  # time of the last good message, s; NaN before the first
        allowed = bool(status.options["allow_several_publishers"] or status.options[several])
        self._sender = status.sensing[topic] = node.subscribe_exclusive(kind, topic, self._receive, allowed, SENSOR_QOS)

    def stale(self, now: float, timeout: float) -> bool:
        """Return whether it was published before, but not for longer than a timeout, s (0: off)."""
        return 0.0 < timeout < now - self.last

    def _receive(self, data: bytes, sample: Sample) -> None:
        # Dated by arrival: sensors need no stamp, clocks may be set, and a drift is slow compared with transport
        # delays.
        try:
            self._sender.check(sample)
            if sample.now - self.last < self._period:
                return
            self._handle(read_message(data, self._kind), sample.now)
            self.last = sample.now
        except HexapodError as error:
            self._reject(error)

    def _bad_feedback(self, error: HexapodError) -> None:
        what = self._topic.removesuffix("s")
        self._node.ignore(what, error, self._status.bad_feedback, "" if isinstance(error, CommandError) else what)
