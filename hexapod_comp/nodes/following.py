"""Measured struts: whether a machine can stand so, and whether the struts go where they are told."""

from __future__ import annotations

from collections import deque

import numpy as np

from ..compiling import compiled
from ..errors import LimitError
from ..geometry import STRUT_NAMES, HexapodGeometry

KEPT = 512
"""Commands remembered: half a second at 1 kHz."""

FOLLOWED_WITHIN = 0.1
"""A drive follows and tells within this time, s: a strut is right where any command of that time wants it."""


class Reach:
    """The lengths that struts can have, with the largest correction to spare at either end.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine.
    """

    def __init__(self, geometry: HexapodGeometry) -> None:
        spare = geometry.limits.correction
        self._low, self._high = geometry.limits.stroke[:, 0] - spare, geometry.limits.stroke[:, 1] + spare

    def check(self, measured: np.ndarray) -> None:
        """Check measured struts, shape (6,), m.

        Raises
        ------
        LimitError
            ``stroke``: no strut can be that long or short.
        """
        beyond = np.maximum(self._low - measured, measured - self._high)
        if beyond.max() <= 0.0:
            return
        strut = int(beyond.argmax())
        length, low, high = float(measured[strut]), self._low[strut], self._high[strut]
        text = f"{STRUT_NAMES[strut]} cannot be {length * 1e3:.3f} mm long, only {low * 1e3:g}…{high * 1e3:g} mm"
        raise LimitError("stroke", text, length, float(low if length < low else high), strut, "measured")


class Following:
    """Guards the difference of measured and commanded struts.

    Drives lag, and readings are on their way for a while, so a reading is compared with all that was commanded
    in the last :data:`FOLLOWED_WITHIN`: it must lie between the least and the most of it, or within the limit.

    Parameters
    ----------
    limit : float
        Allowed difference, m; 0 switches the guard off.

    Attributes
    ----------
    problem : str
        Which strut, where, how far off and what is allowed, as it was first found; empty while all is well.
    """

    reason = "following_error"

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._kept: deque[tuple[float, bytes]] = deque(maxlen=KEPT)  # bytes: six times faster than array rows
        self.problem = ""
        within(np.zeros(6), np.frombuffer(bytes(48)), 0.0)  # compiles now, not while the machine moves

    def note(self, command: np.ndarray, now: float) -> None:
        """Remember a command, shape (6,), m, accepted at the monotonic time `now`, s."""
        self._kept.append((now, command.tobytes()))

    def forget(self) -> None:
        """No command is in force any more."""
        self._kept.clear()
        self.problem = ""

    def check(self, measured: np.ndarray, arrived: float) -> None:
        """Compare measured struts, shape (6,), m, that arrived at the monotonic time `arrived`, s."""
        if not (self._kept and self._limit) or self._at_last_command(measured):
            self.problem = ""
            return
        low, high = self._range(arrived - FOLLOWED_WITHIN)
        off = np.maximum(low - measured, measured - high)
        strut = int(off.argmax())
        if off[strut] <= self._limit:
            self.problem = ""
        elif not self.problem:
            self.problem = (
                f"{STRUT_NAMES[strut]} is at {measured[strut] * 1e3:.3f} mm, {off[strut] * 1e3:.3f} mm from its "
                f"command, allowed {self._limit * 1e3:g} mm"
            )

    def _at_last_command(self, measured: np.ndarray) -> bool:
        """Return whether all struts are within the limit of the last command, as they nearly always are."""
        return within(measured, np.frombuffer(self._kept[-1][1]), self._limit)

    def _range(self, since: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the most commanded after a time, and by the command then in force."""
        recent = []
        for accepted, command in reversed(self._kept):
            recent.append(command)
            if accepted < since:
                break
        commands = np.frombuffer(b"".join(recent)).reshape((-1, 6))
        return commands.min(axis=0), commands.max(axis=0)


@compiled
def within(values, others, limit):
    """Return whether six values differ from six others by no more than a limit."""
    worst = 0.0
    for i in range(6):
        worst = max(worst, abs(values[i] - others[i]))
    return worst <= limit
