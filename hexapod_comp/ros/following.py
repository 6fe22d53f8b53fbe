"""Measured struts: whether a machine can stand so, whether they go where they are told, where a start begins."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from ..errors import CommandError, LimitError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry

KEPT = 512
"""Commands remembered: half a second at 1 kHz."""

FOLLOWED_WITHIN = 0.1
"""A drive follows and tells within this time, s: a strut is right where any command of that time wants it."""

STANDS_WITHIN = 50e-6
"""A strut that moves by no more than this in that time stands, m: encoders and servos are never quite still."""


AVERAGED_OVER = 0.5
"""Readings of a machine at rest are averaged over this time, s: ten at least of a slow drive, at 20 Hz."""

NOISE = 2e-6
"""Readings that differ by no more than this, m, are of one place: encoders read to 0.1 µm, servos hold to 1 µm."""


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


class Recent:
    """The struts of the last half second or so, told or measured."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, bytes]] = deque(maxlen=KEPT)  # bytes: six times faster than array rows

    def __bool__(self) -> bool:
        return bool(self._kept)

    @property
    def last(self) -> np.ndarray:
        """The newest struts, shape (6,), m."""
        return np.frombuffer(self._kept[-1][1])

    @property
    def at(self) -> float:
        """When the newest were noted, by the monotonic clock, s."""
        return self._kept[-1][0]

    def note(self, struts: np.ndarray, now: float) -> None:
        """Remember struts, shape (6,), m, at the monotonic time `now`, s."""
        self._kept.append((now, struts.tobytes()))

    def clear(self) -> None:
        """Forget them all."""
        self._kept.clear()

    def since(self, since: float) -> np.ndarray:
        """Return what came since a monotonic time, s, newest first, shape (n, 6), m."""
        rows = []
        for at, struts in reversed(self._kept):
            if at < since:
                break
            rows.append(struts)
        return np.frombuffer(b"".join(rows)).reshape((-1, 6))

    def range(self, since: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the most since a monotonic time, s, with what was in force then; all of it (6,), m."""
        recent = []
        for at, struts in reversed(self._kept):
            recent.append(struts)
            if at < since:
                break
        rows = np.frombuffer(b"".join(recent)).reshape((-1, 6))
        return rows.min(axis=0), rows.max(axis=0)


class Following:
    """Guards the difference of measured and commanded struts.

    Drives lag, and readings are on their way for a while, so a reading is compared with all that was commanded since
    :data:`FOLLOWED_WITHIN` before it was made: it must lie between the least and the most of it, or within the limit.
    Once it does not, the problem stays until it is released, as on servo drives and in LinuxCNC: a strut that comes
    back by itself has all the same been where nobody told it to be.

    Parameters
    ----------
    limit : float, optional
        Allowed difference, m; 0 switches the guard off.

    Attributes
    ----------
    limit : float
        As given; may be set.
    problem : str
        Which strut, where, how far off and what is allowed, as it was first found; empty while all is well.
    commands : Recent
        What was commanded.
    """

    reason = "following_error"

    def __init__(self, limit: float = 0.0) -> None:
        self.limit = limit
        self.commands = Recent()
        self.problem = ""

    def note(self, command: np.ndarray, now: float) -> None:
        """Remember a command, shape (6,), m, accepted at the monotonic time `now`, s."""
        self.commands.note(command, now)

    def forget(self) -> None:
        """No command is in force any more; what was found stays."""
        self.commands.clear()

    def release(self) -> None:
        """Take what was found as settled."""
        self.problem = ""

    def check(self, measured: np.ndarray, made: float) -> None:
        """Compare measured struts, shape (6,), m; the reading was made at the monotonic time `made`, s."""
        if self.problem or not (self.commands and self.limit):
            return
        if np.abs(measured - self.commands.last).max() <= self.limit:  # as they nearly always are
            return
        low, high = self.commands.range(made - FOLLOWED_WITHIN)
        off = np.maximum(low - measured, measured - high)
        strut = int(off.argmax())
        if off[strut] > self.limit:
            self.problem = (
                f"{STRUT_NAMES[strut]} is at {measured[strut] * 1e3:.3f} mm, {off[strut] * 1e3:.3f} mm from its "
                f"command, allowed {self.limit * 1e3:g} mm; until ~/reset"
            )


class Standing:
    """Whether the machine stands: struts that were neither told nor measured to go anywhere of late.

    Parameters
    ----------
    commands : Recent
        What was commanded.
    """

    def __init__(self, commands: Recent) -> None:
        self._commands, self._readings = commands, Recent()

    def measure(self, struts: np.ndarray, now: float) -> None:
        """Take a good reading, shape (6,), m, that came at the monotonic time `now`, s."""
        self._readings.note(struts, now)

    def mean(self, newest: np.ndarray) -> np.ndarray:
        """Return where struts at rest are: the mean of the readings of the last :data:`AVERAGED_OVER`, shape (6,), m.

        While any of them is further than :data:`NOISE` from another it is the newest reading, as it was given.
        """
        rows = self._readings.since(self._readings.at - AVERAGED_OVER) if self._readings else newest[None]
        return rows.mean(axis=0) if (np.ptp(rows, axis=0) <= NOISE).all() else newest

    def moving(self, now: float) -> str:
        """Return which strut moves and how far in the last :data:`FOLLOWED_WITHIN`; empty when all stand."""
        for recent, how in ((self._commands, "was told to go"), (self._readings, "went")):
            if recent:
                low, high = recent.range(now - FOLLOWED_WITHIN)
                strut = int((high - low).argmax())
                if (way := float(high[strut] - low[strut])) > STANDS_WITHIN:
                    return f"{STRUT_NAMES[strut]} {how} {way * 1e3:.3f} mm in the last {FOLLOWED_WITHIN:g} s"
        return ""


class LastKnown:
    """Where the struts stand, as far as is known: as measured last, or else as told last. A start goes on from there.

    A controller streams on while a compensator restarts, and DDS may let it be heard before the drive is. So "no
    reading yet" does not mean that the struts may be sent anywhere: a start waits for one.

    Parameters
    ----------
    anywhere_after : float, optional
        For a machine without feedback: when nothing has become known so long after the start, the first command
        may be anywhere, s; 0 = never.
    average : callable, optional
        Returns where the struts are when the newest reading is given: the noise of one reading would stay in the place
        of whoever starts from it.

    Attributes
    ----------
    anywhere_after : float
        As given; may be set.
    """

    def __init__(
        self, anywhere_after: float = 0.0, average: Callable[[np.ndarray], np.ndarray] = lambda newest: newest
    ) -> None:
        self.anywhere_after, self._began, self._average = anywhere_after, math.inf, average
        self._measured, self._commanded = np.empty(6), np.empty(6)
        self._measured_at = self._commanded_at = -math.inf

    def begin(self, now: float) -> None:
        """Start, at the monotonic time `now`, s."""
        self._began = now

    def measure(self, struts: np.ndarray, made: float) -> None:
        """Take a good reading, shape (6,), m, that was made at the monotonic time `made`, s."""
        self._measured[:], self._measured_at = struts, made

    def tell(self, command: np.ndarray, at: float) -> None:
        """Take the last command before all of them are forgotten, shape (6,), m, published at a monotonic time, s."""
        self._commanded[:], self._commanded_at = command, at

    def waits(self, now: float) -> bool:
        """Return whether a start must wait until something is known."""
        unknown = self._measured_at == self._commanded_at == -math.inf
        return unknown and not 0.0 < self.anywhere_after <= now - self._began

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
            return self._average(self._measured)
        return self._commanded if self._commanded_at > -math.inf else None

    def _hint(self) -> str:
        if self.anywhere_after:
            return f"; from {self.anywhere_after:g} s after the start on the first command may be anywhere"
        return "; a machine without feedback needs start_without_feedback_after"
