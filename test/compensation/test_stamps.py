"""Stamps while clocks are set: new messages pass, overtaken ones are refused, and no stream is blocked for good.

The truth is the time of each message by a clock that nobody sets, which the simulation knows and the gate does not.
"""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from hexapod_comp.compensation.guards import Sample, StampClock, StampGate
from hexapod_comp.errors import CommandError

SECOND, MS = 1_000_000_000, 1_000_000

STEPS = [sign * step for step in (0.01, 0.1, 0.45, 0.6, 2.0) for sign in (-1.0, 1.0)]
"""Steps by which the clock is set, s."""


class TestClock:
    """A system clock that can be set, beside a monotonic clock."""

    __test__ = False

    def __init__(self) -> None:
        self.steady, self.ahead = 1000 * SECOND, 5 * 10**17
        self.watch = StampClock(system=self.system, steady=lambda: self.steady)

    def system(self) -> int:
        return self.steady + self.ahead

    @property
    def now(self) -> float:
        return self.steady * 1e-9


def checked(gate: StampGate, stamp: int, now: float, accept: bool = False) -> float:
    """Return the age of a message, s, by the gate that checks, and perhaps accepts, its stamp."""
    sample = Sample(now, stamp)
    gate.check(sample)
    if accept:
        gate.accept(sample)
    return sample.age


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(
    ("lead", "rate", "shared"), [(0.0, 1000.0, True), (0.05, 1000.0, True), (0.0, 50.0, True), (0.0, 1000.0, False)]
)
def test_a_shared_clock_that_is_set_shuts_nothing_out(step, lead, rate, shared):
    """No message in order is refused during 0.8 s, although the clock is set after 0.2 s, and no late copy is accepted.

    A message takes 0.2 ms plus an exponential jitter of 0.1 ms, so some are stamped before the step and arrive after
    it. With `lead` messages are stamped in advance, as scheduled commands are. Some arrive a second time, 37 ms later.
    A sender with a clock of its own is not affected when ours is set.
    """
    rng, clock, count = np.random.default_rng(1), TestClock(), round(0.8 * rate)
    gate, began, step_at = StampGate("command", clock.watch, 0.5 * shared), clock.steady, 0.25 * count / rate
    arrivals = np.maximum.accumulate(np.arange(count) / rate + 2e-4 + rng.exponential(1e-4, count))
    events = [(at + late, k) for k, at in enumerate(arrivals) for late in ((0.0, 0.037) if k % 50 == 10 else (0.0,))]
    newest, overtaken = -1, 0
    for arrival, k in sorted(events):
        made = k / rate
        stamp = began + round((made + lead + step * (shared and made >= step_at)) * SECOND) + 5 * 10**17
        clock.steady = began + round(arrival * SECOND)
        clock.ahead = 5 * 10**17 + round(step * (arrival >= step_at) * SECOND)
        try:
            checked(gate, stamp, clock.now, accept=True)
        except CommandError:
            assert k <= newest, "refused though none after it had come"
            continue
        overtaken += k < newest
        newest = max(k, newest)
    assert overtaken <= (shared and abs(step) < 0.1), "a step of the size of a copy's delay cannot be told from it"


@pytest.mark.parametrize(("step", "period", "count"), [(-0.9, 3, 7), (-0.3, 25, 2), (-0.05, 3, 7)])
def test_a_sender_whose_clock_alone_is_set_back_is_heard_after_a_run_of_20_ms(step, period, count):
    """A run has at least three messages; the last of them is accepted."""
    clock = TestClock()
    gate = StampGate("command", clock.watch)
    refused = []
    for k in range(400):
        clock.steady += period * MS
        stamp = clock.system() + (round(step * SECOND) if k >= 200 else 0)
        try:
            checked(gate, stamp, clock.now, accept=True)
        except CommandError as error:
            refused.append((k, error.reason))
    assert refused == [(200 + n, "stamp_order") for n in range(count)]
    assert gate.sender_set_back == 1


def test_what_was_held_up_and_comes_at_once_is_no_clock_that_was_set():
    """Fifty commands, delayed by 50 ms, arrive in order within a millisecond: all are refused."""
    clock = TestClock()
    gate = StampGate("command", clock.watch)
    checked(gate, clock.system(), clock.now, accept=True)
    start = clock.system() - 50 * MS
    for k in range(50):
        clock.steady += MS // 50
        with pytest.raises(CommandError, match="ms before the previous "):
            checked(gate, start + k * MS, clock.now)


@pytest.mark.parametrize("step", [-2.0, -0.3, 0.3, 2.0])
def test_a_step_while_the_node_stands_still_splits_what_waits_where_it_was_made(step):
    """0.4 s of commands wait while the clock is set in their middle: all are accepted, in order."""
    clock = TestClock()
    gate = StampGate("command", clock.watch, 0.5)
    for _ in range(100):
        clock.steady += MS
        checked(gate, clock.system(), clock.now, accept=True)
    waiting = []
    for k in range(400):
        clock.steady += MS
        clock.ahead += round(step * SECOND) if k == 200 else 0
        waiting.append(clock.system())
    for stamp in waiting:
        checked(gate, stamp, clock.now, accept=True)


@pytest.mark.parametrize("step", [-3600.0, -0.3, 0.3, 3600.0])
def test_a_command_that_is_faster_than_the_only_one_before_is_read_by_the_new_setting(step):
    """The first command took 20 ms on a busy computer, the next 1 ms, and the clock was set between them."""
    clock = TestClock()
    gate = StampGate("command", clock.watch, 0.5)
    for late in (20 * MS, MS):
        stamp = clock.system()
        clock.steady += late
        assert checked(gate, stamp, clock.now, accept=True) == pytest.approx(late * 1e-9)
        clock.ahead += round(step * SECOND)
        clock.steady += 50 * MS


@pytest.mark.parametrize(("pause", "lead"), [(0, 50 * MS), (SECOND // 5, 49_800_000), (SECOND * 3 // 5, 49_500_000)])
def test_a_stamp_is_of_the_old_setting_unless_it_were_from_the_future(pause, lead):
    """Allowed are 2 ms and the sender's lead, once 50 ms; the lead shrinks by 1 ms/s, for at most 0.5 s."""
    for beyond in (0, 1):
        clock = TestClock()
        gate = StampGate("command", clock.watch, 0.5)
        for later, ahead in ((0, 50 * MS), (pause, 0))[: 1 + bool(pause)]:
            clock.steady += later
            checked(gate, clock.system() + ahead, clock.now, accept=True)
        clock.ahead += SECOND
        message = Sample(clock.now, clock.system() - SECOND + lead + 2 * MS + beyond)
        with pytest.raises(CommandError, match=r"stamped 0\.94. s old") if beyond else nullcontext():
            gate.check(message)
        assert message.age == 0.0


@pytest.mark.parametrize(
    ("pause", "apart", "allowed", "reads"),
    [
        (0, 0, 2_000_000, 1),
        (SECOND, 0, 3_000_000, 1),  # slewing by 1 ms/s
        (0, 200_000, 2_200_000, 1),  # time between the readings of both clocks
        (0, 200_001, 2_200_401, 3),  # both clocks are read again, and slewing goes on
    ],
)
def test_what_counts_as_a_step(pause, apart, allowed, reads):
    for ahead, step in ((allowed, 0), (allowed + 1, allowed + 1)):
        clock, read = TestClock(), []

        def system(clock=clock, read=read) -> int:
            read.append(clock.system())
            clock.steady += apart
            return read[-1]

        clock.steady, clock.ahead, clock.watch.system = clock.steady + pause, clock.ahead + ahead, system
        clock.watch.read()
        assert (clock.watch.shift, len(read)) == (step, reads)


def test_a_step_in_a_pause_counts_too_and_slewing_and_a_slow_read_do_not():
    clock = TestClock()
    for _ in range(3000):  # one hour at NTP's largest rate, 500 ppm
        clock.steady += int(1.2 * SECOND)
        clock.ahead += int(1.2 * SECOND * 500e-6)
        clock.watch.read()
    assert clock.watch.shift == 0
    plain = clock.watch.system

    def slow() -> int:
        clock.steady += 30 * MS  # a pause between reading the two clocks
        return plain()

    clock.watch.system = slow
    clock.watch.read()
    clock.watch.system = plain
    clock.watch.read()
    assert clock.watch.shift == 0
    clock.steady += 600 * SECOND
    clock.ahead -= 3 * SECOND
    clock.watch.read()
    assert clock.watch.last_step == clock.watch.shift == -3 * SECOND
    assert (clock.watch.set_back, clock.watch.set_forward) == (1, 0)
    clock.steady += SECOND // 2
    assert clock.watch.before() == [0]
    clock.steady += 1
    assert clock.watch.before() == [], "only steps of the last 0.5 s"


def test_simulated_time_is_set_only_when_it_falls():
    times = iter([0, 5 * SECOND, 5 * SECOND, 900 * SECOND, 1 * SECOND])
    clock = StampClock(lambda: next(times))
    for _ in range(4):
        clock.read()
    assert (clock.set_back, clock.set_forward, clock.shift) == (1, 0, -899 * SECOND)


@pytest.mark.parametrize(
    ("later", "pause", "passes"),
    [
        (0, 4, True),  # the same stamp again
        (1, 4, True),
        (-60 * MS, 4, False),
        (-1, 4, False),
        (-1, 499, False),
        (-1, 500, True),  # long enough for a restarted sender
    ],
)
def test_what_is_in_order(later, pause, passes):
    clock = TestClock()
    gate = StampGate("command", clock.watch)
    stamp = clock.system()
    checked(gate, stamp, clock.now, accept=True)
    checked(gate, 0, clock.now, accept=True)  # without a stamp
    clock.steady += pause * MS
    if passes:
        checked(gate, stamp + later, clock.now)
        return
    with pytest.raises(CommandError, match=f"command is stamped {-later / MS:.1f} ms before") as caught:
        checked(gate, stamp + later, clock.now)
    assert caught.value.reason == "stamp_order"
    gate.reset()
    checked(gate, stamp + later, clock.now)


def test_the_drive_refuses_old_commands_only_and_by_the_clock_in_force():
    """With `future=False` stamps ahead pass; setting the clock forward by 2 s makes no command on its way too old."""
    clock = TestClock()
    gate, both = (StampGate("command", clock.watch, 0.1, future=future) for future in (False, True))
    checked(gate, clock.system() + 3600 * SECOND, clock.now)
    for sign, word, reason in ((-1, "old", "stamp_past"), (1, "in the future", "stamp_future")):
        checked(both, clock.system() + sign * 100 * MS, clock.now)
        with pytest.raises(CommandError, match=rf"^command is stamped 0\.101 s {word}, allowed 0\.1 s$") as caught:
            checked(both if sign > 0 else gate, clock.system() + sign * 101 * MS, clock.now)
        assert caught.value.reason == reason
    stamp = clock.system()
    clock.ahead += 2 * SECOND
    clock.steady += MS
    assert checked(gate, stamp, clock.now) == pytest.approx(1e-3)


@pytest.mark.parametrize("capped", [True, False])
def test_a_stamp_ahead_counts_as_now_where_it_must_not_shut_out(capped):
    """A reading stamped ahead counts as stamped now; a command keeps its stamp, since its order matters more."""
    gate = StampGate("reading", StampClock(lambda: 100 * SECOND), 0.5, capped=capped)
    checked(gate, 100 * SECOND + 400 * MS, 1.0, accept=True)
    if capped:
        checked(gate, 100 * SECOND, 1.0)
    with pytest.raises(CommandError, match="ms before the previous "):
        checked(gate, 100 * SECOND - capped, 1.0)
