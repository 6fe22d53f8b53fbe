"""Measured struts: whether a machine can stand so, whether they go where they are told, where a start begins."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from ..errors import CommandError, LimitError
from ..kernels.struts import within
from ..machine.geometry import STRUT_NAMES, HexapodGeometry

KEPT = 512
"""Commands remembered: half a second at 1 kHz."""

FOLLOWED_WITHIN = 0.1
"""A drive follows and tells within this time, s: a strut is right where any command of that time wants it."""


class StrokeRange:
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


class LastKnown:
    """Where the struts stand, as far as is known: as measured last, or else as told last. A start goes on from there.

    A controller streams on while a compensator restarts, and DDS may let it be heard before the drive is. So "no
    reading yet" does not mean that the struts may be sent anywhere: a start waits for one.

    Parameters
    ----------
    anywhere_after : float
        For a machine without feedback: when nothing has become known so long after the start, the first command
        may be anywhere, s; 0 = never.
    """

    def __init__(self, anywhere_after: float) -> None:
        self._anywhere_after, self._began = anywhere_after, math.inf
        self._measured, self._commanded = np.empty(6), np.empty(6)
        self._measured_at = self._commanded_at = -math.inf

    def begin(self, now: float) -> None:
        """Start, at the monotonic time `now`, s."""
        self._began = now

    def measure(self, struts: np.ndarray, now: float) -> None:
        """Take a good reading, shape (6,), m, that came at the monotonic time `now`, s."""
        self._measured[:], self._measured_at = struts, now

    def tell(self, command: np.ndarray, at: float) -> None:
        """Take the last command before all of them are forgotten, shape (6,), m, published at a monotonic time, s."""
        self._commanded[:], self._commanded_at = command, at

    def waits(self, now: float) -> bool:
        """Return whether a start must wait until something is known."""
        unknown = self._measured_at == self._commanded_at == -math.inf
        return unknown and not 0.0 < self._anywhere_after <= now - self._began

    def struts(self, now: float, fresh: bool) -> np.ndarray | None:
        """Return where the struts stand, shape (6,), m; None when nobody knows and the start may be anywhere.

        Parameters
        ----------
        now : float
            Monotonic time, s.
        fresh : bool
            Readings are coming: the last one counts, lag and all. Otherwise it counts only when it came so long
            after the last command that the struts had got there.

        Raises
        ------
        CommandError
            ``no_feedback``: nothing is known.
        """
        if self.waits(now):
            raise CommandError("no_feedback", f"no strut_states yet: where the struts stand is not known{self._hint()}")
        after = self._commanded_at + (-FOLLOWED_WITHIN if fresh else FOLLOWED_WITHIN)
        if self._measured_at > -math.inf and self._measured_at >= after:
            return self._measured
        return self._commanded if self._commanded_at > -math.inf else None

    def _hint(self) -> str:
        if self._anywhere_after:
            return f"; from {self._anywhere_after:g} s after the start on the first command may be anywhere"
        return "; a machine without feedback needs start_without_feedback_after"
