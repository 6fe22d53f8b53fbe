"""Stamps of commands and readings: neither too old nor from the future, never out of order, and clocks may be set."""

from __future__ import annotations

import time
from collections.abc import Callable

from builtin_interfaces.msg import Time

from ..errors import CommandError

FORGET_ORDER_AFTER = 0.5
"""After a pause this long, s, stamps may start again earlier: the sender or its clock was restarted."""

CLOCK_TOLERANCE = 50_000_000
"""This clock may fall back by so much, ns, before it counts as set back: reading two clocks takes a moment."""

SHORTEST_PERIOD = 1e-4
"""Two commands count as no closer than this when a speed is made of them, s."""

LONGEST_PERIOD = 1.0
"""Two commands further apart, s, have no speed between them."""


def nanoseconds_of(stamp: Time) -> int:
    """Return a stamp as nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_of(nanoseconds: int) -> Time:
    """Return nanoseconds as a stamp."""
    sec, nanosec = divmod(nanoseconds, 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def period(since: int, until: int) -> float:
    """Return the time between two stamps, ns, over which a strut's speed is taken, s; 0: it has none.

    It depends on the stamps alone, so that a recorded run answers the same when it is replayed.
    """
    seconds = (until - since) * 1e-9
    if not 0.0 < seconds <= LONGEST_PERIOD:
        return 0.0
    return max(seconds, SHORTEST_PERIOD)


class StampCheck:
    """Checks one stamp after the other.

    Parameters
    ----------
    largest_age : float
        Allowed difference to this node's clock either way, s; 0: any.
    simulated : callable or None
        Reads simulated time, ns; None: the system's clock.
    capped : bool
        A stamp from the future counts as now in the order of stamps, so that it does not shut out those that follow.

    Attributes
    ----------
    clock_set_back : int
        How often this node's clock was found set back.
    """

    def __init__(self, largest_age: float, simulated: Callable[[], int] | None = None, capped: bool = False) -> None:
        # ROS reads the system's clock too, but takes a dozen microseconds longer.
        self._clock = time.time_ns if simulated is None else simulated
        self._simulated, self.largest_age, self._capped = simulated is not None, largest_age, capped
        self._last = self._clock_now = self._clock_then = 0
        self._then = -float("inf")
        self.clock_set_back = 0

    def for_readings(self) -> StampCheck:
        """Return a check of readings' stamps by the same clock."""
        return StampCheck(self.largest_age, self._clock if self._simulated else None, capped=True)

    def check(self, nanoseconds: int, now: float) -> float:
        """Check a stamp at the monotonic time `now`, s; return how old it is, s, or 0 where it may be any age.

        Raises
        ------
        CommandError
            ``stamp_past``, ``stamp_future`` or ``stamp_order``.
        """
        clock = self._clock_now = self._clock()
        age = (clock - nanoseconds) * 1e-9
        if abs(age) > self.largest_age > 0.0:
            reason, word = ("stamp_past", "old") if age > 0.0 else ("stamp_future", "in the future")
            raise CommandError(reason, f"stamp is {abs(age):.3f} s {word}, allowed {self.largest_age:g} s")
        if nanoseconds < self._last and now - self._then < FORGET_ORDER_AFTER and not self._was_set_back(clock, now):
            raise CommandError("stamp_order", "stamp is earlier than the last one's")
        return max(age, 0.0) if self.largest_age else 0.0

    def accept(self, nanoseconds: int, now: float) -> None:
        """Remember the stamp that was just checked as that of the last message accepted."""
        self._last = min(nanoseconds, self._clock_now) if self._capped else nanoseconds
        self._then, self._clock_then = now, self._clock_now

    def forget(self) -> None:
        """Forget the order: the next stamp may be any."""
        self._last = 0

    def _was_set_back(self, clock: int, now: float) -> bool:
        """Return whether this node's clock was set back since the last command: then senders' clocks were too."""
        elapsed = 0.0 if self._simulated else (now - self._then) * 1e9
        set_back = clock - self._clock_then < elapsed - CLOCK_TOLERANCE
        self.clock_set_back += set_back
        return set_back
