"""The last thing between a compensator and a controller: corrections that never step, whatever comes in.

No ROS and no HAL: numbers and times in, six corrections out. A controller adds the output to what it sends
to its drives; :class:`CorrectionGuard` sees to it that the output is always finite, never larger than a limit,
and never moves faster than a ramp, also when the compensator dies, talks nonsense, or comes back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum

from ..errors import CommandError, HexapodError

LONGEST_STEP = 0.02
"""Time that one update may ramp for, s: a process that was stopped for longer goes on, it does not catch up."""

ON_LOSS = ("zero", "hold")
"""What the output may do when corrections stop coming: ramp to zero, or stay where it is."""

ZERO = (0.0,) * 6


class GuardStatus(IntEnum):
    """What the output is doing."""

    OFF = 0
    """Not enabled, at zero."""
    RAMPING = 1
    """On its way to the newest correction."""
    COMPENSATING = 2
    """At the newest correction."""
    HOLDING = 3
    """Corrections have stopped coming; it stays."""
    RETURNING = 4
    """On its way to zero: corrections have stopped coming, or it is not enabled."""
    WAITING = 5
    """Enabled, at zero: no corrections are coming, yet or any more."""


class CorrectionGuard:
    """Six corrections that follow what a compensator asks for, within a limit and along a ramp."""

    def __init__(self, limit: float, ramp_rate: float, timeout: float, on_loss: str = "zero") -> None:
        self.follow(limit, ramp_rate, timeout, on_loss)
        self.output: list[float] = list(ZERO)  # the six corrections now, m; zero at first
        self.status = GuardStatus.OFF  # what they are doing
        self.accepted = self.rejected = 0  # corrections taken, and those too large or not finite, which were not
        self._newest: list[float] = list(ZERO)
        self._accepted_at = self._updated_at = -math.inf

    def follow(self, limit: float, ramp_rate: float, timeout: float, on_loss: str) -> None:
        """Go by other rules from now on; what has been accepted stays so. Arguments and errors as for the class."""
        for name, value in (("limit", limit), ("ramp_rate", ramp_rate), ("timeout", timeout)):
            if not 0.0 < value < math.inf:
                raise HexapodError(f"{name} must be positive and finite, not {value!r}")
        if on_loss not in ON_LOSS:
            raise HexapodError(f"on_loss must be {' or '.join(ON_LOSS)}, not {on_loss!r}")
        self._limit, self._ramp_rate, self._timeout = limit, ramp_rate, timeout
        self._holds = on_loss == "hold"

    def age(self, now: float) -> float:
        """Return the time since the last accepted correction, s; infinite before the first."""
        return now - self._accepted_at

    def offer(self, correction: Sequence[float], now: float) -> None:
        """Take a correction as what the output shall become."""
        values = [float(value) for value in correction]
        try:
            self._check(values)
        except CommandError:
            self.rejected += 1
            raise
        self._newest, self._accepted_at = values, now
        self.accepted += 1

    def _check(self, values: list[float]) -> None:
        if len(values) != 6:
            raise CommandError("strut_count", f"six corrections are needed, not {len(values)}")
        for number, value in enumerate(values, start=1):
            if not math.isfinite(value):
                raise CommandError("not_finite", f"strut {number}: a correction must be finite, not {value}")
            if abs(value) > self._limit:
                raise CommandError(
                    "correction",
                    f"strut {number}: correction {value * 1e6:.3f} µm is larger than ±{self._limit * 1e6:g} µm",
                )

    def update(self, now: float, enabled: bool) -> list[float]:
        """Move the output on and return it."""
        reach = self._ramp_rate * self._elapsed(now)
        target, arrived = self._aim(now, enabled)
        ways = [there - here for there, here in zip(target, self.output, strict=True)]
        longest = max(abs(way) for way in ways)
        if longest <= reach:
            self.output, self.status = list(target), arrived
            return self.output
        share = reach / longest
        self.output = [here + share * way for here, way in zip(self.output, ways, strict=True)]
        self._name_motion(arrived, longest - reach)
        return self.output

    def _elapsed(self, now: float) -> float:
        """Return the time that this update stands for, s: none for the first or when the clock went back."""
        elapsed, self._updated_at = now - self._updated_at, now
        if not 0.0 < elapsed < math.inf:
            return 0.0
        return min(elapsed, LONGEST_STEP)

    def _aim(self, now: float, enabled: bool) -> tuple[Sequence[float], GuardStatus]:
        """Return where the output shall go, and what it does once it is there."""
        if not enabled:
            return ZERO, GuardStatus.OFF
        if not self.accepted:
            return ZERO, GuardStatus.WAITING
        if self.age(now) <= self._timeout:
            return self._newest, GuardStatus.COMPENSATING
        return (self.output, GuardStatus.HOLDING) if self._holds else (ZERO, GuardStatus.WAITING)

    def _name_motion(self, arrived: GuardStatus, left: float) -> None:
        """Set the status of an output that has not arrived; a target that moves on a little is not left by that."""
        if arrived is not GuardStatus.COMPENSATING:
            self.status = GuardStatus.RETURNING
        elif self.status is not GuardStatus.COMPENSATING or left > self._ramp_rate * LONGEST_STEP:
            self.status = GuardStatus.RAMPING
