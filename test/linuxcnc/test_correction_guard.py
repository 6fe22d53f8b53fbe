"""What stands between a compensator and a machine: no step, no excess, no NaN, whatever comes in and whenever.

The bounds are the contract's own (limit, ramp, timeout), checked from outside on what comes out; paths are worked
out by hand. ``SLACK`` is a few roundings of numbers below a millimetre: 1e-18 m each.
"""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hexapod_comp.errors import CommandError
from hexapod_comp.linuxcnc.bridge import LONGEST_STEP, CorrectionGuard, GuardStatus

LIMIT, RAMP, TIMEOUT = 500e-6, 1e-3, 0.1
SLACK = 1e-15
TICK = 1e-3
TARGET = [100e-6, -50e-6, 0.0, 25e-6, -100e-6, 75e-6]


def guard(on_loss: str = "zero", limit: float = LIMIT, ramp_rate: float = RAMP) -> CorrectionGuard:
    return CorrectionGuard(limit, ramp_rate, TIMEOUT, on_loss)


class Loop:
    """A guard in a loop of 1 kHz whose compensator answers every cycle while it is alive."""

    def __init__(self, on_loss: str = "zero") -> None:
        self.guard, self.now = guard(on_loss), 100.0
        self.alive, self.enabled, self.target = True, True, TARGET

    def run(self, cycles: int) -> list[list[float]]:
        """Return the outputs of some cycles."""
        outputs = []
        for _ in range(cycles):
            self.now += TICK
            if self.alive:
                self.guard.offer(self.target, self.now)
            outputs.append(list(self.guard.update(self.now, self.enabled)))
        return outputs


def largest_step(outputs: list[list[float]]) -> float:
    return max(abs(b - a) for one, other in pairwise(outputs) for a, b in zip(one, other, strict=True))


# ---- whatever comes in ----

ANY_NUMBER = st.floats(width=64, allow_nan=True, allow_infinity=True)
USUAL = st.floats(-1.2 * LIMIT, 1.2 * LIMIT)
PAUSE = st.floats(0.0, 0.5) | st.sampled_from([0.0, TICK, TIMEOUT, 1e9, -0.01, math.inf, math.nan])
EVENT = st.tuples(
    PAUSE,
    st.none() | st.lists(ANY_NUMBER | USUAL, min_size=6, max_size=6) | st.lists(USUAL, min_size=6, max_size=6),
    st.booleans(),
)


@settings(deadline=None)
@given(st.lists(EVENT, max_size=60), st.sampled_from(["zero", "hold"]), st.floats(1e-6, 1.0))
def test_never_too_fast_too_far_or_not_a_number(events, on_loss, ramp_rate):
    """Any corrections at any times, with the clock standing, jumping, going back, or not being one."""
    subject, now = guard(on_loss, ramp_rate=ramp_rate), 100.0
    before, updated_at = list(subject.output), -math.inf
    for pause, correction, enabled in events:
        now = now + pause if math.isfinite(now + pause) else pause
        if correction is not None:
            acceptable = all(abs(value) <= LIMIT for value in correction)
            if acceptable:
                subject.offer(correction, now)
            else:
                with pytest.raises(CommandError):
                    subject.offer(correction, now)
        output = list(subject.update(now, enabled))
        assert all(math.isfinite(value) and abs(value) <= LIMIT + SLACK for value in output)
        passed = now - updated_at
        allowed = ramp_rate * min(passed, LONGEST_STEP) if 0.0 < passed < math.inf else 0.0
        assert max(abs(b - a) for a, b in zip(before, output, strict=True)) <= allowed + SLACK
        assert subject.status in GuardStatus
        before, updated_at = output, now
        now = now if math.isfinite(now) else 100.0


@settings(deadline=None)
@given(st.lists(st.floats(-LIMIT, LIMIT), min_size=6, max_size=6))
def test_reaches_every_allowed_correction_exactly_and_in_proportion(correction):
    """On the way all six are the same share of their targets, the largest at the ramp's speed."""
    loop = Loop()
    loop.target = correction
    for cycle, output in enumerate(loop.run(5), start=1):
        largest = max(map(abs, correction))
        share = 1.0 if largest <= (cycle - 1) * RAMP * TICK else (cycle - 1) * RAMP * TICK / largest
        assert output == pytest.approx([share * value for value in correction], rel=1e-9, abs=SLACK)
    assert loop.run(500)[-1] == correction
    assert loop.guard.status is GuardStatus.COMPENSATING


@settings(deadline=None)
@given(st.lists(ANY_NUMBER, min_size=6, max_size=6).filter(lambda c: not all(abs(v) <= LIMIT for v in c)))
def test_a_rejected_correction_changes_nothing(correction):
    """Neither the output nor its target nor the age: a compensator that talks nonsense is as good as dead."""
    loop = Loop()
    loop.run(200)
    loop.alive = False
    for _ in range(150):
        with pytest.raises(CommandError):
            loop.guard.offer(correction, loop.now)
        loop.run(1)
    assert loop.guard.age(loop.now) == pytest.approx(0.15)
    assert (loop.guard.accepted, loop.guard.rejected) == (200, 150)
    assert loop.guard.status is GuardStatus.RETURNING


# ---- enabling, disabling, loss ----


def test_enabling_and_disabling_ramp():
    """100 µm at 1 µm per cycle: 100 cycles there and 100 back; the guard's first cycle has no time behind it."""
    loop = Loop()
    rising = loop.run(101)
    assert largest_step(rising) == pytest.approx(1e-6)
    assert (rising[99] == TARGET, rising[100] == TARGET) == (False, True)
    assert loop.guard.status is GuardStatus.COMPENSATING
    loop.enabled = False
    falling = loop.run(99)
    assert largest_step([TARGET, *falling]) == pytest.approx(1e-6)
    assert loop.guard.status is GuardStatus.RETURNING
    assert loop.run(2)[-1] == [0.0] * 6
    assert loop.guard.status is GuardStatus.OFF


def test_a_lost_compensator_lets_it_return_to_zero():
    """It stays for the timeout (100 cycles), then ramps out in 100 more."""
    loop = Loop("zero")
    loop.run(200)
    loop.alive = False
    assert loop.run(99)[-1] == TARGET
    assert loop.guard.status is GuardStatus.COMPENSATING
    falling = loop.run(103)
    assert largest_step([TARGET, *falling]) == pytest.approx(1e-6)
    assert falling[-1] == [0.0] * 6
    assert loop.guard.status is GuardStatus.WAITING


def test_a_lost_compensator_lets_it_hold():
    """It stays where it is, also half way, and still returns to zero when disabled."""
    loop = Loop("hold")
    loop.run(51)
    loop.target = loop.guard.output
    loop.run(1)
    half = list(loop.guard.output)
    assert max(map(abs, half)) == pytest.approx(50e-6)
    loop.alive = False
    assert loop.run(1000)[-1] == half
    assert loop.guard.status is GuardStatus.HOLDING
    loop.enabled = False
    assert loop.run(60)[-1] == [0.0] * 6
    assert loop.guard.status is GuardStatus.OFF


@pytest.mark.parametrize("on_loss", ["zero", "hold"])
def test_a_compensator_that_comes_back_ramps_in(on_loss):
    """With another opinion: from wherever the output is, no faster than ever."""
    loop = Loop(on_loss)
    loop.run(200)
    loop.alive = False
    left = loop.run(160)[-1]
    loop.alive, loop.target = True, [-value for value in TARGET]
    back = loop.run(210)
    assert largest_step([left, *back]) == pytest.approx(1e-6)
    assert back[-1] == loop.target
    assert loop.guard.status is GuardStatus.COMPENSATING


def test_a_moving_correction_is_followed_without_flicker():
    """Slower than the ramp it is met exactly; a jump that 20 ms take up is not called ramping, a larger one is."""
    loop = Loop()
    loop.run(200)
    for _ in range(50):
        loop.target = [value + 0.5e-6 for value in loop.target]
        assert loop.run(1)[0] == loop.target
    loop.target = [value + 15e-6 for value in loop.target]
    loop.run(1)
    assert loop.guard.status is GuardStatus.COMPENSATING
    loop.target = [value + 50e-6 for value in loop.target]
    loop.run(1)
    assert loop.guard.status is GuardStatus.RAMPING


def test_a_refusal_says_why():
    with pytest.raises(CommandError, match=r"strut 6: correction 501\.000 µm is larger than ±500 µm") as caught:
        guard().offer([0.0] * 5 + [501e-6], 0.0)
    assert caught.value.reason == "correction"
