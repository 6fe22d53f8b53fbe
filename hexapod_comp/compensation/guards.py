"""Checks of every message before it moves a strut: one sender, a valid stamp, no faster than the struts can move.

No ROS here: node, drive and LinuxCNC bridge use the same guards, and tests drive them with their own clock. Times
named `now` are monotonic, s; stamps are integers, ns.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from operator import sub
from typing import NamedTuple

from ..errors import CommandError, LimitError
from ..machine.limits import STRUT_NAMES

SHOWN_FOR = 1.0  # An event is shown in a node's status for this long, s

# After a pause this long, s, stamps may start again earlier: the sender or its clock was restarted
FORGET_ORDER_AFTER = 0.5

STEP_TOLERANCE = 2_000_000  # A difference between system and monotonic clock up to this, ns, is no step
SLEW = 1e-3  # A clock may be corrected at this rate without being set (NTP's own limit is half of it)

# Two clocks read further apart than this, ns, are read again: the process was interrupted between
READ_WITHIN = 200_000

IN_FLIGHT = 0.5  # For this long after a step of the clock, s, messages stamped before it may still arrive

# No message may be from the future by more than this, ns, plus its sender's lead
EARLY = 2_000_000

# Rate at which a sender's lead is forgotten, ns/s: clocks drift apart by a tenth of that
LEAD_SHRINKS = 1e6

# This many messages that are in order among themselves and arrive over this time, s, were not overtaken: their
# sender's clock was set back. Delayed messages arrive all at once.
RUN, RUN_LASTS = 3, 0.02

BUNCHED_WITHIN = 0.1  # Commands delayed by up to this time, s, may arrive all at once

# A sender that returns this long after another has taken over is not a predecessor that was stopped, s
SPEAKERS_WITHIN = 1.0

SPEAKERS_HELD = 2.0  # Two senders in turn count as two for this long after the last turn, s

# What rmw calls a publisher whose node is not known yet: found a moment ago, or not a ROS node
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"


class Sample:
    """One message with the values that the guards need."""

    __slots__ = ("age", "frame_id", "now", "stamp", "values")

    def __init__(self, now: float, stamp: int = 0, values: tuple[float, ...] | None = None, frame_id: str = "") -> None:
        self.now, self.stamp, self.values, self.frame_id = now, stamp, values, frame_id
        self.age = 0.0  # age, s, by its stamp, computed by its StampGate


class Guard:
    """Checks one property of each sample: `check` raises, `accept` stores one that has passed all guards, `reset`
    forgets. While there is a `problem` every sample is refused; a latched one stays until it is released."""

    reason = ""  # under which refusals are counted
    problem = ""

    def check(self, sample: Sample) -> None:
        if self.problem:
            raise CommandError(self.reason, self.problem)

    def accept(self, sample: Sample) -> None:
        """Store a sample that all guards have passed."""

    def reset(self) -> None:
        """Forget all samples; a latched problem stays."""


class EventWindow:
    """Whether an event is recent: within :data:`SHOWN_FOR`, or since the last query.

    So a node that queries periodically shows every event at least once, even after a long pause.
    """

    def __init__(self) -> None:
        self._at = self._asked = self._before = -math.inf

    def note(self, now: float) -> None:
        self._at = now

    def holds(self, now: float) -> bool:
        """Return whether it is recent; repeated queries at the same time give the same answer."""
        if now > self._asked:
            self._before, self._asked = self._asked, now
        return now - self._at < SHOWN_FOR or self._at > self._before


# ---- speed ----


class Excess(NamedTuple):
    which: int  # of the values
    moved: float
    allowed: float
    elapsed: float  # s
    in_turn: bool  # a sequence is too fast, though no single step is


class RateLimit:
    """Limits how fast values move away from the last accepted ones; a step `at_once` is allowed in addition.

    With `bunched`, s, a whole sequence is limited too (a leaky bucket): it may be ahead by `at_once` and by the motion
    of that time, since delayed messages arrive together. Before the first values all pass.
    """

    def __init__(self, at_once: float, rate: float, bunched: float = math.inf) -> None:
        self.at_once, self.rate, self.bunched = at_once, rate, bunched
        self.reset()

    def reset(self, standing: Sequence[float] | None = None) -> None:
        """Forget the last values, or start from the present ones: elapsed time before counts for nothing."""
        self.last, self.at = standing, math.inf
        self._ahead: Sequence[float] = () if standing is None else (0.0,) * len(standing)

    def excess(self, values: Sequence[float], now: float, elapsed: float = -math.inf) -> Excess | None:
        """Return the value that moves too far, if any; `elapsed` is used if it is longer than the time since the
        last."""
        if self.last is None:
            return None
        elapsed = max(elapsed, now - self.at, 0.0)
        moved, allowed = list(map(abs, map(sub, values, self.last))), self.at_once + self.rate * elapsed
        if max(moved) > allowed or sum(moved) != sum(moved):  # the sum alone detects NaN
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
        way = self.rate * elapsed
        return [max(ahead + step - way, 0.0) for ahead, step in zip(self._ahead, moved, strict=True)]


class StrutSteps(Guard):
    """Refuses strut commands further from the last ones than a machine's `step` (m) and `speed` (m/s) allow.

    `reset` gives the struts' present lengths: the first command must be within a step of them.
    """

    def __init__(self, step: float, speed: float) -> None:
        self._limit = RateLimit(step, speed, BUNCHED_WITHIN)

    def check(self, sample: Sample) -> None:
        """Raise a LimitError, ``step`` or ``speed``."""
        excess = self._limit.excess(sample.values or (), sample.now)
        if excess is None:
            return
        which, moved, allowed = STRUT_NAMES[excess.which], f"{excess.moved * 1e3:.4g} mm", excess.allowed
        text = f"{which} would step by {moved}, allowed {allowed * 1e3:.4g} mm"
        if excess.in_turn:
            text = f"{which} would be {moved} ahead of {self._limit.rate * 1e3:g} mm/s, allowed {allowed * 1e3:.4g} mm"
        reason = "speed" if excess.in_turn else "step"
        raise LimitError(reason, text, excess.moved, allowed, excess.which, "commanded")

    def accept(self, sample: Sample) -> None:
        """Remember a command that the struts now follow."""
        self._limit.accept(tuple(sample.values or ()), sample.now)

    def reset(self, standing: Sequence[float] | None = None) -> None:
        """Start from the struts' present lengths, six, m; None: not known, any first command passes."""
        self._limit.reset(standing)


# ---- stamps ----


class StampClock:
    """The clock for stamps, and its steps, detected by comparison with the monotonic clock.

    `simulated` reads simulated time, ns, whose steps are only detected when it falls; None: the system's clock. (ROS
    reads the system's too, but takes ten times as long.)
    """

    def __init__(
        self,
        simulated: Callable[[], int] | None = None,
        system: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._simulated, self.system, self.steady = simulated, system, steady
        self._at, self._offset, self._last, self.shift = steady(), 0, 0, 0
        self.set_back = self.set_forward = self.last_step = 0  # number of steps, and the newest step, ns
        self.steps: list[tuple[int, int]] = []  # monotonic time, ns, of the newest, and the shift in force until then
        self.read()
        self.shift = self.set_back = self.set_forward = 0  # the shift is the sum of all steps, ns
        self.steps.clear()

    def read(self) -> int:
        """Return the time, ns, and detect steps of the clock."""
        steady = self.steady
        if self._simulated is not None:
            now, clock = steady(), self._simulated()
            if clock < self._last:
                self._was_set(clock - self._last, now)
            self._last = clock
            return clock
        for _ in range(3):
            now, clock = steady(), self.system()
            if (apart := steady() - now) <= READ_WITHIN:
                break
        step = clock - now - self._offset
        if abs(step) > STEP_TOLERANCE + apart + SLEW * (now - self._at):
            self._was_set(step, now)
            self._offset, self._at = clock - now, now
        elif apart <= READ_WITHIN:
            self._offset, self._at = clock - now, now
        return clock

    def before(self) -> list[int]:
        """Return the clock's shifts before its recent steps: messages stamped before a step may still arrive."""
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
    """Checks one sender's stamps: none too old or from the future, none overtaken.

    Sender and node may share a clock that is set, back or forward, while messages are in transit. Then a stamp may be
    one of the old setting or of the new one, unless that would put the message into the future by more than its
    sender's lead: messages arrive late, but never before they were sent. The setting whose stamp follows most closely
    on the last message's is used. So a step of the clock locks no sender out, and lets no overtaken message pass. A
    sender whose clock is set while the node's is not is detected by a run of messages in order.

    `max_age`, s, is the allowed difference to the clock, 0: any; with `future` stamps from the future are refused as
    old ones are; `capped`: a stamp from the future counts as now in the order of stamps, so that it does not shut out
    those that follow. A zero stamp passes: its message is not dated.
    """

    def __init__(
        self, what: str, clock: StampClock, max_age: float = 0.0, future: bool = True, capped: bool = False
    ) -> None:
        self._what, self._clock, self.max_age = what, clock, max_age
        self._future, self._capped = future, capped
        self.sender_set_back = 0  # number of steps back of the sender's clock alone
        self._now = self._age = self._made = 0
        self._shift = self._checked_shift = clock.shift
        self._run, self._run_since, self._run_made = 0, 0.0, 0
        self._then = -math.inf
        self._lead = 0  # the sender's lead, ns

    def check(self, sample: Sample) -> None:
        """Raise a CommandError, ``stamp_past``, ``stamp_future`` or ``stamp_order``; write the sample's age, s."""
        stamp, now, clock = sample.stamp, sample.now, self._clock
        if not stamp:
            return
        self._now = clock.read()
        ordered = now - self._then < FORGET_ORDER_AFTER
        # A sender that has not followed a step has its own clock: its order continues by that.
        self._age, self._checked_shift = self._now - stamp, self._shift if ordered else clock.shift
        if clock.steps:
            self._find_setting(stamp, clock.before())
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
            raise CommandError("stamp_order", f"{self._what} is stamped {late:.1f} ms earlier than the one before")

    def accept(self, sample: Sample) -> None:
        """Remember the stamp that was just checked as that of the last message accepted."""
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

    def _find_setting(self, stamp: int, before: list[int]) -> None:
        """Determine by which setting of a recently set clock a stamp was made, and its age then, ns."""
        if not before:
            return
        age, shift = self._age, self._clock.shift
        ages = {age - shift + one: one for one in {shift, self._checked_shift, *before}}
        possible = {age: one for age, one in ages.items() if age >= -self._lead - EARLY}
        self._age = min(possible, default=max(ages))
        # The stamp that follows most closely on the last one: messages queued during a pause of the node arrive in
        # order.
        made = sorted((stamp - one, one) for one in possible.values() or ages.values())
        self._checked_shift = next((one for when, one in made if when >= self._made), made[-1][1])

    def _is_run(self, made: int, now: float) -> bool:
        """Return whether messages with earlier stamps arrive in a pattern that shows that their sender's clock was set
        back."""
        if not self._run or made < self._run_made:
            self._run, self._run_since = 0, now
        self._run, self._run_made = self._run + 1, made
        run = self._run >= RUN and now - self._run_since >= RUN_LASTS - 1e-6
        self.sender_set_back += run
        return run


# ---- senders ----


class OneSender(Guard):
    """Only one node may publish on a topic of commands or of readings; missing messages are detected.

    The graph gives the publishers' names, but keeps a killed node until its lease ends (20 s by default). Sequence
    numbers distinguish such ghosts: every publisher counts its messages from 1, and only living ones send. A second
    node of this node's `own` name on a topic that it publishes is not detected here: it may be this one's killed
    predecessor; a subscriber detects it.

    `count` returns how many publishers there are, cheap; `names` their full names, each once, and why they cannot be
    told, empty where they can: without knowing its sender no command may be accepted. Several `allowed` publishers are
    still named.
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
        self.names: tuple[str, ...] = ()  # of the others, where one is its own
        self._unknown = ""
        self.missed = 0  # number of messages sent and never handled: dropped from a queue, or lost by the network
        self._counted = True  # whether the middleware counts messages at all
        self._turned_at = self._changed_at = -math.inf
        self._last = self._other = 0
        self._misses = EventWindow()

    @property
    def reason(self) -> str:  # type: ignore[override]
        return "unknown_publisher" if self._unknown else "several_publishers"

    def update(self, now: float) -> None:
        """Check the publishers: their names only when they may have changed, or when they matter."""
        count = self._count_now()
        if count != self._count or count > 1 or self._unknown or UNKNOWN_NAME in self.names:
            self._count = count
            names, self._unknown = self._look_up() if count else ((), "")
            self.names = tuple(name for name in names if name != self._own)
        if count > 1 or self.problem or self._unknown or (self._own and self.names):
            self._judge(now)

    def receive(self, number: int | None, now: float) -> bool:
        """Record a message's sequence number, None if there are none; return whether it showed a second sender."""
        last, self._last = self._last, number or 0
        if number is not None and number == last + 1:
            return False
        counted, self._counted = self._counted, number is not None
        returned = False
        if number is not None and last:  # it does not follow the last one: two senders in turn, or missing messages
            back = number <= last
            returned = now - self._changed_at < SPEAKERS_WITHIN and (back or last < self._other < number)
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
            self.problem = f"who publishes {self.topic} cannot be told: {self._unknown}"
        elif len(self.names) > 1:
            self.problem = f"several publishers of {self.topic}: {names}"
        elif self._count > 1 and now - self._turned_at < SPEAKERS_HELD:
            self.problem = f"two publishers of {self.topic} speak in turn, both called {both}"
        elif self._count > 1 and not self._counted:
            told = "whether both speak cannot be told, as this middleware (RMW) does not count messages"
            self.problem = f"two publishers of {self.topic} are called {both}; {told}"
