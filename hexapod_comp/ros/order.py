"""Strut commands that must not be obeyed although each by itself is good: steps that nobody sends."""

from __future__ import annotations

import math

import numpy as np

from ..errors import LimitError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry

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
