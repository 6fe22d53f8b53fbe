"""Messages that must not be obeyed although each by itself is good: overtaken ones, and steps that nobody sends."""

from __future__ import annotations

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
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._last, self._at = 0, -float("inf")

    def check(self, stamp: int, now: float) -> None:
        """Check a stamp, ns, at the monotonic time `now`, s.

        Raises
        ------
        CommandError
            ``stamp_order``.
        """
        late = self._last - stamp
        if stamp and 0 < late < OVERTAKEN_BY and now - self._at < FORGET_ORDER_AFTER:
            raise CommandError("stamp_order", f"{self._what} is {late * 1e-6:.1f} ms older than the one before")

    def passed(self, stamp: int, now: float) -> None:
        """Take a stamp, ns, as the last good one's."""
        self._last, self._at = stamp or self._last, now


class NoStep:
    """Refuses strut commands further from the last ones than the machine's step and speed allow.

    Parameters
    ----------
    geometry : HexapodGeometry
        Its limits.
    """

    def __init__(self, geometry: HexapodGeometry) -> None:
        self._step, self._speed = geometry.limits.step, geometry.limits.speed
        self._last: np.ndarray | None = None
        self._at = 0.0

    def check(self, lengths: np.ndarray, now: float) -> None:
        """Check six commands, m, at the monotonic time `now`, s; after a pause they may have gone on meanwhile.

        Raises
        ------
        LimitError
            ``step``.
        """
        if self._last is None:
            return
        steps = np.abs(lengths - self._last)
        allowed = self._step + self._speed * (now - self._at)
        if (steps <= allowed).all():
            return
        strut = int(np.argmax(np.where(np.isfinite(steps), steps, np.inf)))
        text = f"{STRUT_NAMES[strut]} would step by {steps[strut] * 1e3:.4g} mm, allowed {allowed * 1e3:.4g} mm"
        raise LimitError("step", text, float(steps[strut]), allowed, strut, "commanded")

    def passed(self, lengths: np.ndarray, now: float) -> None:
        """Take six commands, m, as obeyed."""
        self._last, self._at = lengths.copy(), now
