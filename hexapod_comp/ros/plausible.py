"""Measured struts that no machine can have: too far from where they were a moment ago."""

from __future__ import annotations

import numpy as np

from ..errors import LimitError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry

FASTER = 2.0
"""Struts may have moved so many times faster than they may be commanded: jogged by hand, or pulled back."""


class NoJump:
    """Refuses readings further from the last good ones than the struts can have moved since.

    A strut that has really jumped is believed when so much time has passed that it may have got there.

    Parameters
    ----------
    geometry : HexapodGeometry
        Its limits of step and speed.
    """

    def __init__(self, geometry: HexapodGeometry) -> None:
        self._step, self._speed = geometry.limits.step, FASTER * geometry.limits.speed
        self._last: np.ndarray | None = None
        self._at, self._stamp = 0.0, 0

    def check(self, measured: np.ndarray, stamp: int, now: float) -> None:
        """Check measured struts, shape (6,), m, stamped `stamp`, ns, that came at the monotonic time `now`, s.

        The time since counts by stamp or by arrival, whichever is longer: transports delay.

        Raises
        ------
        LimitError
            ``jump``.
        """
        if self._last is None:
            return
        by_stamp = (stamp - self._stamp) * 1e-9 if stamp and self._stamp else 0.0
        since = max(by_stamp, now - self._at)
        moved, allowed = np.abs(measured - self._last), self._step + self._speed * since
        strut = int(moved.argmax())
        if moved[strut] <= allowed:
            return
        text = f"{STRUT_NAMES[strut]} has jumped by {moved[strut] * 1e3:.3f} mm, in {since:.3f} s it can have moved "
        text += f"{allowed * 1e3:.3f} mm"
        raise LimitError("jump", text, float(moved[strut]), allowed, strut, "measured")

    def passed(self, measured: np.ndarray, stamp: int, now: float) -> None:
        """Take measured struts as the last good ones."""
        self._last, self._at, self._stamp = measured.copy(), now, stamp
