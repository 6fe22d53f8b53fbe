"""A record of commanded and measured strut lengths, from which start lengths, motion and following errors are found."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from operator import sub

import numpy as np

from ..errors import CommandError, LimitError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from .guards import Guard, RateLimit, Sample

KEPT = 512  # Number of stored commands, and of stored readings: half a second at 1 kHz

# Longest delay, s, from a command to the reading of the commanded length, as drives lag and readings are delayed. A
# measured strut may be at any length that was commanded within this time before the measurement.
FOLLOWED_WITHIN = 0.1

# Largest motion of a strut at rest within FOLLOWED_WITHIN, m, since encoders are noisy and servos hunt
REST_WITHIN = 50e-6

# Time over which the readings of a machine at rest are averaged, s: ten readings of a slow drive, at 20 Hz
AVERAGED_OVER = 0.5

# Largest difference between readings of a strut at rest, m: encoders read to 0.1 µm, servos hold to 1 µm
NOISE = 2e-6

FASTER = 2.0  # Largest believed speed of a measured strut, in multiples of the speed limit, which jogging may exceed

Struts = Sequence[float]


class StrutTrack(Guard):
    """The last :data:`KEPT` commanded and the last :data:`KEPT` measured strut lengths, m.

    `limit` (m) is the largest allowed following error; 0 switches the check off. The first command must wait until the
    struts were read. If no reading arrives within `anywhere_after` s of the activation, any first command is allowed
    (0: never).
    """

    reason = "following_error"

    def __init__(
        self, geometry: HexapodGeometry | None = None, limit: float = 0.0, anywhere_after: float = 0.0
    ) -> None:
        self.limit, self.anywhere_after, self._began = limit, anywhere_after, math.inf
        self._commands: deque[tuple[float, Struts]] = deque(maxlen=KEPT)
        self._readings: deque[tuple[float, Struts]] = deque(maxlen=KEPT)
        self._read_made, self._read_stamp = -math.inf, 0
        self._before_reset: tuple[float, Struts] = (-math.inf, ())  # the last command before the last reset
        self.watch(geometry)

    def watch(self, geometry: HexapodGeometry | None) -> None:
        """Set limits for readings from the geometry's limits: stroke ± largest correction, step and speed."""
        self._low, self._high = (-math.inf,) * 6, (math.inf,) * 6
        self._jumps = RateLimit(math.inf, 0.0)
        if geometry is not None:
            limits = geometry.limits
            self._low = tuple((limits.stroke[:, 0] - limits.correction).tolist())
            self._high = tuple((limits.stroke[:, 1] + limits.correction).tolist())
            self._jumps = RateLimit(limits.step, FASTER * limits.speed)

    def add_command(self, command: Struts, now: float) -> None:
        self._commands.append((now, command))

    def check_jump(self, sample: Sample) -> None:
        """Raise a LimitError (``jump``) if a strut's reading has changed by more than the strut can have moved.

        The allowed difference grows with the time since the last accepted reading, so the readings of a strut that has
        really jumped are accepted later. The time between two readings is the difference of their stamps or of their
        times of arrival, whichever is larger.
        """
        both = sample.stamp and self._read_stamp
        by_stamp = (sample.stamp - self._read_stamp) * 1e-9 if both else -math.inf
        excess = self._jumps.excess(sample.values or (), sample.now, by_stamp)
        if excess is not None:
            moved, allowed = f"{excess.moved * 1e3:.3f} mm", f"{excess.allowed * 1e3:.3f} mm"
            text = f"{STRUT_NAMES[excess.which]} has jumped by {moved}, allowed {allowed} in {excess.elapsed:.3f} s"
            raise LimitError("jump", text, excess.moved, excess.allowed, excess.which, "measured")

    def check_stroke(self, struts: Struts) -> None:
        """Raise a LimitError (``stroke``) if a length, m, is outside the stroke by more than the largest correction."""
        short, long = list(map(sub, self._low, struts)), list(map(sub, struts, self._high))
        if max(short) <= 0.0 and max(long) <= 0.0:
            return
        beyond = list(map(max, short, long))
        strut = beyond.index(max(beyond))
        length, low, high = struts[strut], self._low[strut], self._high[strut]
        text = f"{STRUT_NAMES[strut]} cannot be {length * 1e3:.3f} mm long, only {low * 1e3:g}…{high * 1e3:g} mm"
        raise LimitError("stroke", text, length, low if length < low else high, strut, "measured")

    def add_reading(self, sample: Sample) -> None:
        """Store a reading, which was made ``sample.age`` seconds before its receipt at ``sample.now``."""
        struts = sample.values or ()
        self._jumps.accept(struts, sample.now)
        self._readings.append((sample.now, struts))
        self._read_made, self._read_stamp = sample.now - sample.age, sample.stamp

    def follow(self, measured: Struts, made: float) -> bool:
        """Latch a problem, and return True, if the struts did not follow their commands at the time `made`, s."""
        if self.problem or not (self._commands and self.limit):
            return False
        if max(map(abs, map(sub, measured, self._commands[-1][1]))) <= self.limit:  # a fast test for the usual case
            return False
        low, high = _range(self._commands, made - FOLLOWED_WITHIN)
        off = np.maximum(low - measured, measured - high)
        strut = int(off.argmax())
        if off[strut] <= self.limit:
            return False
        # Latched, as on servo drives: a strut that returns to its command has been at a length that was not commanded
        self.problem = (
            f"{STRUT_NAMES[strut]} is at {measured[strut] * 1e3:.3f} mm, {off[strut] * 1e3:.3f} mm from its "
            f"command, allowed {self.limit * 1e3:g} mm; commands are refused until ~/reset"
        )
        return True

    def release(self) -> None:
        self.problem = ""

    def reset(self) -> None:
        """Forget all commands except the last, which :meth:`start` may return."""
        if self._commands:
            self._before_reset = self._commands[-1]
        self._commands.clear()

    def begin(self, now: float) -> None:
        self._began = now

    def moving(self, now: float) -> str:
        """Return, as text, which strut moves or was commanded to move; empty if all struts are at rest."""
        for recent, how in ((self._commands, "was commanded to move by"), (self._readings, "moved by")):
            if recent:
                low, high = _range(recent, now - FOLLOWED_WITHIN)
                strut = int((high - low).argmax())
                if (moved := float(high[strut] - low[strut])) > REST_WITHIN:
                    return f"{STRUT_NAMES[strut]} {how} {moved * 1e3:.3f} mm in the last {FOLLOWED_WITHIN:g} s"
        return ""

    def mean(self) -> np.ndarray:
        """Return the mean lengths, m, of the last :data:`AVERAGED_OVER` s; the newest reading if the struts moved."""
        since = self._readings[-1][0] - AVERAGED_OVER
        rows = np.array([struts for at, struts in self._readings if at >= since])
        return rows.mean(axis=0) if (np.ptp(rows, axis=0) <= NOISE).all() else rows[-1]

    def waits(self, now: float) -> bool:
        """Return whether the first command must wait, because the struts' lengths are unknown."""
        # A controller goes on sending while a compensator restarts, and DDS may discover it before the drive
        unknown = not self._readings and not self._before_reset[1]
        return unknown and not 0.0 < self.anywhere_after <= now - self._began

    def start(self, now: float, fresh: bool) -> np.ndarray | None:
        """Return the strut lengths, m, from which the first command must start; None: it may start anywhere.

        The first command starts from the measured lengths if the last reading was made at least
        :data:`FOLLOWED_WITHIN` after the last command or, if `fresh` is True, at most :data:`FOLLOWED_WITHIN` before
        the last command. Otherwise it starts from the last commanded lengths.
        """
        if self.waits(now):
            problem = "no strut_states yet: the struts' lengths are unknown"
            if self.anywhere_after:
                problem += f"; {self.anywhere_after:g} s after the activation the first command may be at any lengths"
            raise CommandError("no_feedback", problem)
        commanded_at, commanded = self._before_reset
        if self._readings and self._read_made >= commanded_at + (-FOLLOWED_WITHIN if fresh else FOLLOWED_WITHIN):
            return self.mean()
        return np.array(commanded) if commanded else None


def _range(recent: deque[tuple[float, Struts]], since: float) -> tuple[np.ndarray, np.ndarray]:
    """Return each strut's smallest and largest length, m, from the last entry before the time `since`, s, until now."""
    rows = []
    for at, struts in reversed(recent):
        rows.append(struts)
        if at < since:
            break
    return np.min(rows, axis=0), np.max(rows, axis=0)
