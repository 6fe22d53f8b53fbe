"""What a machine's own safety watches: a heartbeat, how long a command holds, and whether commands are refused."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Bool, UInt64

from .runtime import ACKNOWLEDGED_WITHIN, EVENT_QOS, MachineNode
from .stamps import stamp_of

LATCHED_QOS = QoSProfile(
    depth=1,
    history=HistoryPolicy.KEEP_LAST,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""A state that who comes late must know too."""

REPEATED_AFTER = 1.0
"""Whether the node stops the machine is said again after this long, s: who comes late is given what is latched, but on
a busy computer the middleware loses that now and then."""

LAST_STAMP = 2**31 * 10**9 - 1
"""The largest time that a message can hold, ns: what is valid until later is valid until then."""


class VitalSigns:
    """Publishes ``~/heartbeat``, ``~/validity`` and ``~/stopped`` of a configured node.

    Parameters
    ----------
    node : MachineNode
        Publishes.
    options : dict
        Its parameters ``heartbeat_rate``, Hz, and ``command_timeout``, s.
    topic : str
        Of the commands.
    newest : callable
        Returns the newest command's stamp, ns; 0: there is none.
    """

    def __init__(self, node: MachineNode, options: dict[str, Any], topic: str, newest: Callable[[], int]) -> None:
        self._node, self._options, self._newest = node, options, newest
        self._heartbeats = node.create_publisher(UInt64, "~/heartbeat", EVENT_QOS)
        self._validities = node.create_publisher(TimeReference, "~/validity", EVENT_QOS)
        self._stops = node.create_publisher(Bool, "~/stopped", LATCHED_QOS)
        self._beat, self._validity = UInt64(), TimeReference(source=topic)
        self._stopped: bool | None = None
        self._published_at = 0.0
        self.stop(True)
        self._ticker = node.at_rate("heartbeat_rate", self._beats)

    def stop(self, stopped: bool) -> None:
        """Say whether the node stops the machine, where that has changed or has not been said for a while."""
        now = time.monotonic()
        if stopped != self._stopped or now - self._published_at > REPEATED_AFTER:
            self._stopped, self._published_at = stopped, now
            self._stops.publish(Bool(data=stopped))

    def wait(self) -> None:
        """Wait until it has arrived that the node stops the machine."""
        self._stops.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def close(self) -> None:
        """Stop beating."""
        self._ticker.close()
        for publisher in (self._heartbeats, self._validities, self._stops):
            self._node.destroy_publisher(publisher)

    def _beats(self) -> None:
        self._beat.data = (self._beat.data + 1) % 2**64
        self._heartbeats.publish(self._beat)
        stamp, lasting = self._newest(), round(self._options["command_timeout"] * 1e9)
        if stamp and lasting:
            self._validity.header.stamp = stamp_of(stamp)
            self._validity.time_ref = stamp_of(min(stamp + lasting, LAST_STAMP))
            self._validities.publish(self._validity)
