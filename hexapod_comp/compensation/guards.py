"""Checks of every message before it moves a strut: of its sender, of its stamp, and of the struts' speed.

This module does not use ROS: node, drive and LinuxCNC bridge share these guards, and tests call them with their own
clock. Arguments named `now` are monotonic times in s; stamps are integers in ns.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from operator import sub
from typing import NamedTuple

from ..errors import CommandError, LimitError
from ..machine.limits import STRUT_NAMES

SHOWN_FOR = 1.0  # Time for which a node's status shows an event, s

# After a pause of this length, s, a stamp earlier than the last one is accepted, because the sender may have restarted
FORGET_ORDER_AFTER = 0.5

# A change of the offset between system clock and monotonic clock by more than this, ns, is a step of the system clock
STEP_TOLERANCE = 2_000_000
SLEW = 1e-3  # Largest rate at which a clock is slewed, not stepped; NTP slews a clock at half of this rate at most

# If more than this time, ns, passes between the readings of two clocks, both clocks are read again
READ_WITHIN = 200_000

IN_FLIGHT = 0.5  # Time after a step of the clock for which messages stamped before the step may still arrive, s

# Largest time by which a stamp may be ahead of the node's clock, ns; the stored lead of the sender's clock is added
EARLY = 2_000_000

# Rate at which the stored lead of a sender's clock decreases, ns/s: ten times the rate at which clocks drift apart
LEAD_SHRINKS = 1e6

# A sender's clock has been set back if RUN messages with stamps earlier than the last accepted stamp arrive in order,
# over a time of at least RUN_LASTS, s. (Delayed messages would arrive all at once.)
RUN, RUN_LASTS = 3, 0.02

BUNCHED_WITHIN = 0.1  # Longest delay after which delayed commands may arrive all at once, s

# Two publishers send in turn if the first publisher sends again within this time, s, after the second publisher's first
# message; a stopped publisher would not send again
IN_TURN_WITHIN = 1.0

IN_TURN_HELD = 2.0  # Time, s, for which commands are refused after two publishers last sent in turn

# Name that rmw gives to a publisher whose node is unknown, because it was just discovered or is no ROS node
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"


class Sample:
    """The data of one message that the guards use: values, stamp, frame, and time of receipt."""

    __slots__ = ("age", "frame_id", "now", "stamp", "values")

    def __init__(self, now: float, stamp: int = 0, values: tuple[float, ...] | None = None, frame_id: str = "") -> None:
        self.now, self.stamp, self.values, self.frame_id = now, stamp, values, frame_id
        self.age = 0.0  # age of the message by its stamp, s; StampGate.check sets it


class Guard:
    """A check of one property of each sample. While the text `problem` is not empty, the guard refuses every sample."""

    reason = ""  # name under which refusals are counted
    problem = ""

    def check(self, sample: Sample) -> None:
        if self.problem:
            raise CommandError(self.reason, self.problem)

    def accept(self, sample: Sample) -> None:
        """Store a sample that has passed all guards."""

    def reset(self) -> None:
        """Forget all samples; a latched problem stays."""


class EventWindow:
    """An event that stays recent for :data:`SHOWN_FOR` s, or longer if needed until a query has seen it."""

    def __init__(self) -> None:
        self._at = self._asked = self._before = -math.inf

    def note(self, now: float) -> None:
        self._at = now

    def holds(self, now: float) -> bool:
        """Return whether the event is recent; repeated queries at the same time give the same answer."""
        if now > self._asked:
            self._before, self._asked = self._asked, now
        return now - self._at < SHOWN_FOR or self._at > self._before


# ---- speed ----


class Excess(NamedTuple):
    which: int  # index of the value
    moved: float  # change of the value; if `in_sequence`, the distance by which it is ahead of a motion at the rate
    allowed: float  # largest allowed `moved`
    elapsed: float  # time since the last accepted values, s
    in_sequence: bool  # True: the last step is allowed, but the sequence of steps is too fast (leaky bucket)


class RateLimit:
    """A limit for changes: a value may differ from its last accepted value by `at_once` + `rate` · (time since then).

    A sequence of values may be ahead of a motion at the constant speed `rate` by at most `at_once` + `rate` · `bunched`
    (leaky bucket); `bunched` is the longest delay, s, after which delayed values may arrive all at once.
    """

    def __init__(self, at_once: float, rate: float, bunched: float = math.inf) -> None:
        self.at_once, self.rate, self.bunched = at_once, rate, bunched
        self.reset()

    def reset(self, standing: Sequence[float] | None = None) -> None:
        """Let the next values differ from `standing` by at most `at_once`; if `standing` is None, accept any values."""
        self.last, self.at = standing, math.inf
        self._ahead: Sequence[float] = () if standing is None else (0.0,) * len(standing)

    def excess(self, values: Sequence[float], now: float, elapsed: float = -math.inf) -> Excess | None:
        """Return the value furthest beyond the limit, or None; the last values are at least `elapsed`, s, old."""
        if self.last is None:
            return None
        elapsed = max(elapsed, now - self.at, 0.0)
        moved, allowed = list(map(abs, map(sub, values, self.last))), self.at_once + self.rate * elapsed
        if max(moved) > allowed or sum(moved) != sum(
            moved
        ):  # max may overlook a NaN; a sum with NaN is unequal to itself
            worst = max(range(len(moved)), key=lambda n: math.inf if math.isnan(moved[n]) else moved[n])
            return Excess(worst, moved[worst], allowed, elapsed, False)
        if self.bunched < math.inf:
            ahead, allowed = self._ahead_of(moved, elapsed), self.at_once + self.rate * self.bunched
            if max(ahead) > allowed:
                worst = ahead.index(max(ahead))
                return Excess(worst, ahead[worst], allowed, elapsed, True)
        return None

    def accept(self, values: Sequence[float], now: float) -> None:
        if self.bunched < math.inf:
            last = values if self.last is None else self.last
            self._ahead = self._ahead or (0.0,) * len(values)
            self._ahead = self._ahead_of(list(map(abs, map(sub, values, last))), max(0.0, now - self.at))
        self.last, self.at = values, now

    def _ahead_of(self, moved: list[float], elapsed: float) -> list[float]:
        drained = self.rate * elapsed
        return [max(ahead + step - drained, 0.0) for ahead, step in zip(self._ahead, moved, strict=True)]


class StrutSteps(Guard):
    """Refuses a command that moves a strut by more than `step` (m) + `speed` (m/s) · (time since the last command)."""

    def __init__(self, step: float, speed: float) -> None:
        self._limit = RateLimit(step, speed, BUNCHED_WITHIN)

    def check(self, sample: Sample) -> None:
        """Raise a LimitError if a strut would step too far (``step``), or if the commands come too fast (``speed``)."""
        excess = self._limit.excess(sample.values or (), sample.now)
        if excess is None:
            return
        which, moved, allowed = STRUT_NAMES[excess.which], f"{excess.moved * 1e3:.4g} mm", excess.allowed
        text = f"{which} would step by {moved}, allowed {allowed * 1e3:.4g} mm"
        if excess.in_sequence:
            motion = f"a motion at {self._limit.rate * 1e3:g} mm/s"
            text = f"{which} would be {moved} ahead of {motion}, allowed {allowed * 1e3:.4g} mm"
        reason = "speed" if excess.in_sequence else "step"
        raise LimitError(reason, text, excess.moved, allowed, excess.which, "commanded")

    def accept(self, sample: Sample) -> None:
        self._limit.accept(tuple(sample.values or ()), sample.now)

    def reset(self, standing: Sequence[float] | None = None) -> None:
        """Compare the next command with the struts' present lengths `standing`, m; None: accept any next command."""
        self._limit.reset(standing)


# ---- stamps ----


class StampClock:
    """The clock for stamps: the system clock, or a function `simulated` that returns the simulated time, ns.

    A step of the system clock is detected by comparison with the monotonic clock; a step of a simulated clock is
    detected only if it goes back. Reading the system clock here takes a tenth of the time that rclpy needs.
    """

    def __init__(
        self,
        simulated: Callable[[], int] | None = None,
        system: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._simulated, self.system, self.steady = simulated, system, steady
        self.shift = self.last_step = 0  # sum of all steps of the clock, and the newest step, ns
        self.set_back = self.set_forward = 0  # numbers of steps back and forward
        self.steps: list[tuple[int, int]] = []  # monotonic time of each recent step, and `shift` before this step, ns
        self._last = simulated() if simulated is not None else 0
        self._at, clock, _ = self._read_both()
        self._offset = clock - self._at

    def read(self) -> int:
        """Return the time, ns, by the simulated clock or the system clock, and detect steps of this clock."""
        if self._simulated is not None:
            clock = self._simulated()
            if clock < self._last:
                self._was_set(clock - self._last, self.steady())
            self._last = clock
            return clock
        now, clock, apart = self._read_both()
        step = clock - now - self._offset
        if abs(step) > STEP_TOLERANCE + apart + SLEW * (now - self._at):
            self._was_set(step, now)
            self._offset, self._at = clock - now, now
        elif apart <= READ_WITHIN:
            self._offset, self._at = clock - now, now
        return clock

    def _read_both(self) -> tuple[int, int, int]:
        """Return monotonic clock, system clock, and the time between the readings of both clocks, ns."""
        for _ in range(3):
            now, clock = self.steady(), self.system()
            if (apart := self.steady() - now) <= READ_WITHIN:
                break
        return now, clock, apart

    def before(self) -> list[int]:
        """For each step of the clock in the last :data:`IN_FLIGHT` seconds, return the sum of all earlier steps, ns."""
        since = self.steady() - round(IN_FLIGHT * 1e9)
        self.steps = [entry for entry in self.steps if entry[0] >= since]
        return [shift for _, shift in self.steps]

    def _was_set(self, step: int, now: int) -> None:
        self.steps.append((now, self.shift))
        self.shift += step
        self.last_step = step
        self.set_back += step < 0
        self.set_forward += step > 0


class StampGate(Guard):
    """A guard of one sender's stamps: it refuses stale messages, messages from the future, and overtaken messages.

    `max_age` (s) is the largest allowed age of a message; 0 allows any age. If `future` is True, a stamp may be in the
    future by at most `max_age`. If `capped` is True, a stamp from the future is stored as the present time, so that
    later messages with correct stamps are not refused. A message with a zero stamp passes.
    """

    def __init__(
        self, what: str, clock: StampClock, max_age: float = 0.0, future: bool = True, capped: bool = False
    ) -> None:
        self._what, self._clock, self.max_age = what, clock, max_age
        self._future, self._capped = future, capped
        self.sender_set_back = 0  # number of times that only the sender's clock was set back
        self._now = self._age = self._made = 0
        self._shift = self._checked_shift = clock.shift
        self._run, self._run_since, self._run_made = 0, 0.0, 0
        self._then = -math.inf
        self._lead = 0  # time by which the sender's clock is ahead of the node's clock, ns

    def check(self, sample: Sample) -> None:
        """Set the sample's age, s; raise a CommandError (``stamp_past``, ``stamp_future`` or ``stamp_order``)."""
        stamp, now, clock = sample.stamp, sample.now, self._clock
        if not stamp:
            return
        self._now = clock.read()
        ordered = now - self._then < FORGET_ORDER_AFTER
        # A sender whose stamps did not follow a step of the node's clock has its own clock and keeps its shift
        self._age, self._checked_shift = self._now - stamp, self._shift if ordered else clock.shift
        if clock.steps:
            self._find_shift(stamp, clock.before())
        age = self._age * 1e-9
        if self.max_age:
            if age > self.max_age or (self._future and -age > self.max_age):
                reason, word = ("stamp_past", "old") if age > 0.0 else ("stamp_future", "in the future")
                text = f"{self._what} is stamped {abs(age):.3f} s {word}, allowed {self.max_age:g} s"
                raise CommandError(reason, text)
            sample.age = max(age, 0.0)
        made = stamp - self._checked_shift
        if ordered and made < self._made and not self._is_run(made, now):
            late = (self._made - made) * 1e-6
            raise CommandError("stamp_order", f"{self._what} is stamped {late:.1f} ms before the previous {self._what}")

    def accept(self, sample: Sample) -> None:
        self._run = 0
        if not sample.stamp:
            return
        elapsed = min(max(0.0, sample.now - self._then), FORGET_ORDER_AFTER)
        self._lead = max(-self._age, self._lead - round(LEAD_SHRINKS * elapsed), 0)
        self._shift, self._then = self._checked_shift, sample.now
        self._made = sample.stamp - self._shift
        if self._capped:
            self._made = min(self._made, self._now - self._clock.shift)

    def reset(self) -> None:
        self._then, self._lead, self._run = -math.inf, 0, 0

    def _find_shift(self, stamp: int, before: list[int]) -> None:
        """Find out whether a message was stamped before or after a recent step of the clock; store its age, ns."""
        if not before:
            return
        age, present = self._age, self._clock.shift
        ages = {age - present + shift: shift for shift in {present, self._checked_shift, *before}}
        # If a clock that sender and node share was set while the message was in transit, one of `ages` is right. An age
        # below −(lead of the sender's clock + EARLY) is impossible, as no message arrives before it was sent.
        possible = {age: shift for age, shift in ages.items() if age >= -self._lead - EARLY}
        self._age = min(possible, default=max(ages))
        # Messages arrive in order, even those that were queued during a pause of the node. So the stamp's time is the
        # first possible time that is not before the last accepted stamp.
        made = sorted((stamp - shift, shift) for shift in possible.values() or ages.values())
        self._checked_shift = next((shift for when, shift in made if when >= self._made), made[-1][1])

    def _is_run(self, made: int, now: float) -> bool:
        """Return whether the last :data:`RUN` messages, stamped in order, show that the sender's clock was set back."""
        if not self._run or made < self._run_made:
            self._run, self._run_since = 0, now
        self._run, self._run_made = self._run + 1, made
        run = self._run >= RUN and now - self._run_since >= RUN_LASTS
        self.sender_set_back += run
        return run


# ---- senders ----


class OneSender(Guard):
    """A guard that allows only one publisher on a topic of commands or readings, and detects missing messages.

    The function `count` returns the number of publishers quickly. The function `names` returns the publishers' names
    without repetitions, and a text why names are unknown ("" if all are known). If `allowed` is True, messages from
    several publishers pass. `own` is the name of this node if it publishes the topic itself.
    """

    def __init__(
        self,
        topic: str,
        count: Callable[[], int],
        names: Callable[[], tuple[tuple[str, ...], str]],
        allowed: bool,
        own: str = "",
    ) -> None:
        self.topic, self._count_now, self._look_up, self._allowed, self._own = topic, count, names, allowed, own
        self._count = -1
        self.names: tuple[str, ...] = ()  # names of the publishers other than `own`
        self._unknown = ""
        self.missed = 0  # number of messages that were sent but never handled: lost from a queue or by the network
        self._counted = True  # whether the middleware gives sequence numbers
        self._turned_at = self._changed_at = -math.inf
        self._last = self._other = 0
        self._misses = EventWindow()

    @property
    def reason(self) -> str:  # type: ignore[override]
        return "unknown_publisher" if self._unknown else "several_publishers"

    def update(self, now: float) -> None:
        """Check the topic's publishers; look up names (slow) only if they may have changed or if there are several."""
        count = self._count_now()
        if count != self._count or count > 1 or self._unknown or UNKNOWN_NAME in self.names:
            self._count = count
            names, self._unknown = self._look_up() if count else ((), "")
            # Another publisher called `own` may be this node's killed predecessor, which the ROS graph contains until
            # its lease ends (20 s by default); if it is alive, the subscribers' guards report it
            self.names = tuple(name for name in names if name != self._own)
        if count > 1 or self.problem or self._unknown or (self._own and self.names):
            self._judge(now)

    def receive(self, number: int | None, now: float) -> bool:
        """Store a message's sequence number (None: unknown); return whether it reveals a second publisher."""
        last, self._last = self._last, number or 0
        if number is not None and number == last + 1:
            return False
        counted, self._counted = self._counted, number is not None
        returned = False
        # A gap or a step back: messages are missing, or two publishers send in turn, each with its own count from 1
        if number is not None and last:
            back = number <= last
            returned = now - self._changed_at < IN_TURN_WITHIN and (back or last < self._other < number)
            lost = number - 1 - (self._other if returned else last)
            if lost > 0 and (returned or not back):
                self.missed += lost
                self._misses.note(now)
            if returned:
                self._turned_at = now
            if back or returned:
                self._other, self._changed_at = last, now
        if returned or (counted and not self._counted):
            self._judge(now)
            return bool(self.problem)
        return False

    def missing(self, now: float) -> bool:
        return self._misses.holds(now)

    def _judge(self, now: float) -> None:
        names, both = ", ".join(self.names), ", ".join(self.names) or UNKNOWN_NAME
        self.problem = ""
        if self._allowed:
            return
        if self._own:
            if others := names or self._unknown:
                self.problem = f"{self.topic} is also published by {others}"
        elif self._unknown:
            self.problem = f"the publisher of {self.topic} is unknown: {self._unknown}"
        elif len(self.names) > 1:
            self.problem = f"several publishers of {self.topic}: {names}"
        elif self._count > 1 and now - self._turned_at < IN_TURN_HELD:
            self.problem = f"two publishers of {self.topic} send in turn, both called {both}"
        elif self._count > 1 and not self._counted:
            unclear = "this middleware (RMW) does not count messages, so it is unknown whether both publishers send"
            self.problem = f"two publishers of {self.topic} are called {both}; {unclear}"
