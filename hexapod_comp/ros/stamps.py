"""Stamps of commands and readings: neither too old nor from the future, never out of order, and clocks may be set."""

from __future__ import annotations

import time
from collections.abc import Callable

from builtin_interfaces.msg import Time

from ..errors import CommandError

FORGET_ORDER_AFTER = 0.5
"""After a pause this long, s, stamps may start again earlier: the sender or its clock was restarted."""

STEP_TOLERANCE = 2_000_000
"""A change between system and monotonic clock up to this, ns, is no step."""

SLEW = 1e-3
"""A clock may be corrected at this rate without being set (NTP's own limit is half of it)."""

READ_WITHIN = 200_000
"""Two clocks read further apart than this, ns, are read again: the processor was elsewhere in between."""

IN_FLIGHT = 0.5
"""For this long after a step of the clock, s, messages that were stamped before it may still arrive."""

EARLY = 2_000_000
"""No message is from the future by more than this, ns, or than its sender's messages are, where it stamps ahead."""

LEAD_SHRINKS = 1e6
"""How fast it is forgotten how far a sender stamps ahead, ns/s: clocks drift apart by a tenth of that."""

RUN, RUN_LASTS = 3, 0.02
"""This many messages that are in order among themselves and arrive over this time, s, were not overtaken: their
sender's clock was set back. What was held up on its way arrives at once."""

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


class StampClock:
    """The clock by which stamps are judged, and when it was set: found by the monotonic clock, which nobody sets.

    Parameters
    ----------
    simulated : callable or None
        Reads simulated time, ns, which is set only when it falls; None: the system's clock.
    system, steady : callable
        Read the system's and the monotonic clock, ns. (ROS reads the system's too, but takes ten times as long.)

    Attributes
    ----------
    shift : int
        Sum of all steps up to now, ns.
    set_back, set_forward : int
        How often it was set.
    last_step : int
        The newest step, ns.
    """

    def __init__(
        self,
        simulated: Callable[[], int] | None = None,
        system: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._simulated, self.system, self.steady = simulated, system, steady
        self.shift = self.set_back = self.set_forward = self.last_step = 0
        self._ended: list[tuple[int, int]] = []  # monotonic time, ns, and the shift that was in force until then
        self._at = steady()
        self._offset = self._last = 0
        self.read()
        self.shift = self.set_back = self.set_forward = 0
        self._ended.clear()

    def read(self) -> int:
        """Return the time, ns; take notice where it was set since the last time."""
        if self._simulated is not None:
            now, clock = self.steady(), self._simulated()
            if clock < self._last:
                self._was_set(clock - self._last, now)
            self._last = clock
            return clock
        for _ in range(3):
            now, clock = self.steady(), self.system()
            if (apart := self.steady() - now) <= READ_WITHIN:
                break
        step = clock - now - self._offset
        if abs(step) > STEP_TOLERANCE + apart + SLEW * (now - self._at):
            self._was_set(step, now)
            self._offset, self._at = clock - now, now
        elif apart <= READ_WITHIN:
            self._offset, self._at = clock - now, now
        return clock

    def before(self) -> list[int]:
        """Return the shifts that were in force before the newest steps, while messages stamped then may arrive."""
        if self._ended:
            since = self.steady() - round(IN_FLIGHT * 1e9)
            self._ended = [entry for entry in self._ended if entry[0] >= since]
        return [shift for _, shift in self._ended]

    def _was_set(self, step: int, now: int) -> None:
        self._ended.append((now, self.shift))
        self.shift += step
        self.last_step = step
        self.set_back += step < 0
        self.set_forward += step > 0


class StampGate:
    """Lets one sender's messages pass by their stamps: none too old or from the future, none overtaken.

    Sender and node may share a clock that is set, back or forward, while messages are on their way. Then a stamp may
    be one of the old setting or of the new one, unless that would put the message into the future, further than its
    sender stamps ahead: messages come late, but none comes before it was sent. It is the one that follows closest on
    the last message's. So a step of the clock shuts nothing out, and lets no overtaken message pass. A sender whose
    clock is set while the node's is not shows itself by a run of messages in order.

    Parameters
    ----------
    what : str
        What is stamped, for the text.
    clock : StampClock
        The node's.
    max_age : float
        Allowed difference to the clock, s; 0: any.
    future : bool
        Stamps from the future are refused as old ones are; else they may be any.
    capped : bool
        A stamp from the future counts as now in the order of stamps, so that it does not shut out those that follow.

    Attributes
    ----------
    max_age : float
        As given; may be set.
    sender_set_back : int
        How often the sender's clock alone was found set back.
    """

    def __init__(
        self, what: str, clock: StampClock, max_age: float = 0.0, future: bool = True, capped: bool = False
    ) -> None:
        self._what, self._clock, self.max_age = what, clock, max_age
        self._future, self._capped = future, capped
        self.sender_set_back = 0
        self._now = self._age = self._made = 0
        self._shift = self._checked_shift = clock.shift
        self._run, self._run_since, self._run_made = 0, 0.0, 0
        self._then = -float("inf")
        self._lead = 0  # how far the sender stamps ahead, ns

    def check(self, stamp: int, now: float) -> float:
        """Check a stamp, ns, at the monotonic time `now`, s; return how old it is, s, 0 where it may be any age.

        A zero stamp says nothing and passes.

        Raises
        ------
        CommandError
            ``stamp_past``, ``stamp_future`` or ``stamp_order``.
        """
        if not stamp:
            return 0.0
        self._now = self._clock.read()
        self._read_by(stamp, ordered := now - self._then < FORGET_ORDER_AFTER)
        age = self._age * 1e-9
        if self.max_age and (age > self.max_age or (self._future and -age > self.max_age)):
            reason, word = ("stamp_past", "old") if age > 0.0 else ("stamp_future", "in the future")
            raise CommandError(reason, f"{self._what} is stamped {abs(age):.3f} s {word}, allowed {self.max_age:g} s")
        made = stamp - self._checked_shift
        if ordered and made < self._made and not self._is_run(made, now):
            late = (self._made - made) * 1e-6
            raise CommandError("stamp_order", f"{self._what} is stamped {late:.1f} ms earlier than the one before")
        return max(age, 0.0) if self.max_age else 0.0

    def accept(self, stamp: int, now: float) -> None:
        """Remember the stamp that was just checked as that of the last message accepted."""
        self._run = 0
        if not stamp:
            return
        elapsed = min(max(0.0, now - self._then), FORGET_ORDER_AFTER)
        self._lead = max(-self._age, self._lead - round(LEAD_SHRINKS * elapsed), 0)
        self._shift, self._then = self._checked_shift, now
        self._made = stamp - self._shift
        if self._capped:
            self._made = min(self._made, self._now - self._clock.shift)

    def forget(self) -> None:
        """Forget the order: the next stamp may be any."""
        self._then, self._lead, self._run = -float("inf"), 0, 0

    def _read_by(self, stamp: int, ordered: bool) -> None:
        """Find out by which setting of the clock a stamp was made, and how old it is then, ns."""
        clock = self._clock
        age, before = self._now - stamp, clock.before()
        self._age, self._checked_shift = age, clock.shift
        own = self._shift if ordered else clock.shift
        if not before:  # a sender that has not followed a step has a clock of its own: its order goes on by that
            self._checked_shift = own
            return
        ages = {age - clock.shift + shift: shift for shift in {clock.shift, own, *before}}
        possible = {age: shift for age, shift in ages.items() if age >= -self._lead - EARLY}
        self._age = min(possible, default=max(ages))
        # The stamp that follows closest on the last one's: what waited while the node stood still comes in turn.
        made = sorted((stamp - shift, shift) for shift in possible.values() or ages.values())
        self._checked_shift = next((shift for when, shift in made if when >= self._made), made[-1][1])

    def _is_run(self, made: int, now: float) -> bool:
        """Return whether messages with earlier stamps come in such a way that their sender's clock was set back."""
        if not self._run or made < self._run_made:
            self._run, self._run_since = 0, now
        self._run, self._run_made = self._run + 1, made
        if self._run < RUN or now - self._run_since < RUN_LASTS - 1e-6:
            return False
        self.sender_set_back += 1
        return True
