"""What the compensator says of itself for LinuxCNC's feed hold."""

from __future__ import annotations

import math
import time
from typing import Any

from std_msgs.msg import Bool, UInt64

from ..ros.runtime import EVENT_QOS, MachineNode
from ..ros.vital_signs import LATCHED_QOS


class StopInput:
    """Hears ``compensator/stopped`` and ``compensator/heartbeat``."""

    def __init__(self, node: MachineNode, options: dict[str, Any]) -> None:
        self._stopped, self._beat_at, self._options = True, -math.inf, options
        node.listen_to(Bool, "compensator/stopped", self._on_stopped, LATCHED_QOS)
        node.listen_to(UInt64, "compensator/heartbeat", self._on_beat, EVENT_QOS)

    def stopped(self, now: float) -> bool:
        """Return whether it refuses commands, or is not heard, at the monotonic time `now`, s."""
        return self._stopped or now - self._beat_at > self._options["timeout"]

    def _on_stopped(self, message: Bool) -> None:
        self._stopped = message.data

    def _on_beat(self, _: UInt64) -> None:
        self._beat_at = time.monotonic()
