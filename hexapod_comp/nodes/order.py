"""Messages that must not be obeyed although each by itself is good: overtaken ones, and steps that nobody sends."""

from __future__ import annotations

import math
import time

import numpy as np

from ..errors import CommandError, LimitError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from .stamps import FORGET_ORDER_AFTER

OVERTAKEN_BY = 1_000_000_000
"""No message is overtaken by more than this, ns: an earlier stamp means that the sender's clock was set back."""


class InOrder:
    """Refuses a message with an earlier stamp than the last good one's; equal ones, and zero, may pass.

    Parameters
    ----------
    what : str
        Of what, for the text.
    valid_for : float
        Refused as well is what is older than this by this computer's clock, s; 0: nothing.

    Attributes
    ----------
    valid_for : float
        As given; may be set.
    """

    def __init__(self, what: str, valid_for: float = 0.0) -> None:
        self._what, self.valid_for = what, valid_for
        self._last, self._at = 0, -float("inf")

    def check(self, stamp: int, now: float) -> None:
        """Check a stamp, ns, at the monotonic time `now`, s.

        Raises
        ------
        CommandError
            ``stamp_order``, ``stamp_past``.
        """
        if stamp and 0.0 < self.valid_for < (age := (time.time_ns() - stamp) * 1e-9):
            raise CommandError("stamp_past", f"{self._what} is {age:.3f} s old, valid for {self.valid_for:g} s")
        late = self._last - stamp
        if stamp and 0 < late < OVERTAKEN_BY and now - self._at < FORGET_ORDER_AFTER:
            raise CommandError("stamp_order", f"{self._what} is {late * 1e-6:.1f} ms older than the one before")

    def passed(self, stamp: int, now: float) -> None:
        """Take a stamp, ns, as the last good one's."""
        self._last, self._at = stamp or self._last, now


BUNCHED_WITHIN = 0.1
"""Commands that were held up on their way for up to this time, s, may come all at once."""


class NoStep:
    """Refuses strut commands further from the last ones than the machine's step and speed allow.

    Each may be one step, and as far as the struts may go in the time since the last one, away from it; after a pause
    they may have gone on meanwhile. Many in turn may be no faster than the struts, but for a bunch that was held up on
    its way. Before the first one the struts stand, and time gives no right to any way.

    Parameters
    ----------
    geometry : HexapodGeometry
        Its limits.
    """

    def __init__(self, geometry: HexapodGeometry) -> None:
        self._step, self._speed = geometry.limits.step, geometry.limits.speed
        self._last, self._ahead = np.empty(6), np.zeros(6)
        self._at = -math.inf

    def start(self, standing: np.ndarray) -> None:
        """Begin where the struts stand, shape (6,), m."""
        self._last[:], self._ahead[:], self._at = standing, 0.0, math.inf

    def check(self, lengths: np.ndarray, now: float) -> None:
        """Check six commands, m, at the monotonic time `now`, s.

        Raises
        ------
        LimitError
            ``step`` or ``speed``.
        """
        steps, way = np.abs(lengths - self._last), self._speed * max(0.0, now - self._at)
        allowed = self._step + way
        if not (steps <= allowed).all():
            strut = int(np.argmax(np.where(np.isfinite(steps), steps, np.inf)))
            text = f"{STRUT_NAMES[strut]} would step by {steps[strut] * 1e3:.4g} mm, allowed {allowed * 1e3:.4g} mm"
            raise LimitError("step", text, float(steps[strut]), allowed, strut, "commanded")
        ahead, allowed = self._ahead_of(steps, way), self._step + self._speed * BUNCHED_WITHIN
        strut = int(ahead.argmax())
        if ahead[strut] > allowed:
            text = (
                f"{STRUT_NAMES[strut]} would be {ahead[strut] * 1e3:.4g} mm ahead of {self._speed * 1e3:g} mm/s, "
                f"allowed {allowed * 1e3:.4g} mm"
            )
            raise LimitError("speed", text, float(ahead[strut]), allowed, strut, "commanded")

    def _ahead_of(self, steps: np.ndarray, way: float) -> np.ndarray:
        """Return how far the struts would be ahead of their largest speed, m."""
        return np.maximum(self._ahead + steps - way, 0.0)

    def passed(self, lengths: np.ndarray, now: float) -> None:
        """Take six commands, m, as obeyed."""
        way = self._speed * max(0.0, now - self._at)
        self._ahead[:] = self._ahead_of(np.abs(lengths - self._last), way)
        self._last[:], self._at = lengths, now
