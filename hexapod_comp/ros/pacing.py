"""Commands that come sooner than the struts may go there: they wait, in their order, as long as a parameter says."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from ..errors import HexapodError, LimitError
from .callbacks import Alarm
from .health import Lately
from .runtime import COMMAND_QOS, MachineNode

JITTER = 0.02
"""A wait up to this, s, is nothing to speak of, nor is an alarm that rings so late."""


class Pacing:
    """The queue of commands that came too early: bunched on their way, or in a burst after a pause.

    Parameters
    ----------
    node : MachineNode
        In whose executor what waits is taken.
    options : dict
        The node's parameter ``catch_up_within``: how long a command may wait for the struts, s; all that wait are
        refused when one has waited longer. While the node itself stood still, none has waited for the struts. 0: only
        the newest waits, and those that it replaces are dropped.
    take : callable
        Takes a message at a monotonic time, s; returns how long it must wait still, s, 0 when it is settled.
    refuse : callable
        Refuses a message with an error, at a monotonic time, s.

    Attributes
    ----------
    waited, dropped : int
        Commands that have waited, and those that a newer one has replaced.
    """

    def __init__(
        self,
        node: MachineNode,
        options: dict[str, Any],
        take: Callable[[bytes, float], float],
        refuse: Callable[[bytes, HexapodError, float], None],
    ) -> None:
        self._node, self._options, self._take, self._refuse = node, options, take, refuse
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._behind = Lately()
        self._due = self._stood_still = 0.0
        self.waited = self.dropped = 0
        self._alarm = Alarm(node, node.guard.around("go_on", self._go_on))

    @property
    def _longest(self) -> float:
        return float(self._options["catch_up_within"])

    def command(self, message: bytes, now: float) -> None:
        """Take a command that comes at the monotonic time `now`, s, now or in its turn."""
        if not self._waiting:
            if (wait := self._take(message, now)) > 0.0:
                self._wait_in_line(message, now)
                self._wait_for_struts(now, wait)
            return
        if not self._longest:
            self.dropped += len(self._waiting)
            self._waiting.clear()
            self._behind.note(now)
        elif len(self._waiting) == COMMAND_QOS.depth:
            self._refuse_all(now)
        self._wait_in_line(message, now)

    def behind(self, now: float) -> bool:
        """Return whether commands were taken late, or dropped, of late: jitter is nothing to speak of."""
        return self._behind.holds(now)

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()

    def close(self) -> None:
        """Forget what waits, and take nothing any more."""
        self.clear()
        self._alarm.close()

    def _wait_in_line(self, message: bytes, now: float) -> None:
        self._waiting.append((now - self._stood_still, message))
        self.waited += 1

    def _wait_for_struts(self, now: float, wait: float) -> None:
        self._due = now + wait
        self._alarm.set(wait)

    def _age(self, came: float, now: float) -> float:
        """Return how long a command has waited for the struts; `came` counts no time in which the node stood still."""
        return now - self._stood_still - came

    def _go_on(self) -> None:
        """Take what waits, as far as the struts may go by now."""
        if (late := time.monotonic() - self._due) > JITTER:
            self._stood_still += late
        if not self._node.active:
            self._waiting.clear()
        while self._waiting:
            now = time.monotonic()
            came, message = self._waiting[0]
            if 0.0 < self._longest < self._age(came, now):
                self._refuse_all(now)
                return
            if (wait := self._take(message, now)) > 0.0:
                self._wait_for_struts(now, wait)
                return
            if self._age(came, now) > JITTER:
                self._behind.note(now)
            if self._waiting:  # else what was taken has cleared it
                self._waiting.popleft()

    def _refuse_all(self, now: float) -> None:
        waited = self._age(self._waiting[0][0], now)
        text = f"commands come faster than the struts may move: {waited:.3f} s behind, allowed {self._longest:g} s"
        while self._waiting:
            error = LimitError("speed", text, waited, self._longest, None, "compensated")
            self._refuse(self._waiting.popleft()[1], error, now)
