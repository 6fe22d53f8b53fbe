"""Where the struts are: one record of commanded and measured lengths, which answers every question about them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from operator import sub

import numpy as np

from ..errors import CommandError, LimitError
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from .guards import Guard, RateLimit, Sample

KEPT = 512  # Commands and readings stored: half a second at 1 kHz

# A drive follows and its reading arrives within this time, s: a strut may be where any command of that time put it
FOLLOWED_WITHIN = 0.1

# A strut that moves by no more than this in that time stands, m: encoders and servos are never quite still
STANDS_WITHIN = 50e-6

# Readings of a machine at rest are averaged over this time, s: ten at least of a slow drive, at 20 Hz
AVERAGED_OVER = 0.5

# Readings that differ by no more than this, m, are of one place: encoders read to 0.1 µm, servos hold to 1 µm
NOISE = 2e-6

FASTER = 2.0  # Factor by which struts may have moved faster than commands allow: jogged by hand, or pulled back

Struts = Sequence[float]


class StrutTrack(Guard):
    """Commanded and measured struts of the last half second, and the last of each, six lengths, m.

    It answers: can a machine have these lengths (`check_stroke`, `check_jump`); do the struts follow (`follow`; a
    problem is latched until `release`, and refuses commands); are they at rest (`moving`); where does a start begin
    (`start`).

    Drives lag, and readings are delayed, so a reading is compared with all commands since :data:`FOLLOWED_WITHIN`
    before it was made: it must lie between their minimum and maximum, or within `limit`, m (0: any). Once it does not,
    the machine is stopped until a person resets it, as on servo drives and in LinuxCNC: a strut that comes back by
    itself has all the same been where it was not commanded to be.

    A controller streams on while a compensator restarts, and DDS may discover it before the drive. So "no reading yet"
    does not mean that the struts may be sent anywhere: a start waits for one, unless nothing has become known for
    `anywhere_after`, s, since the activation (0: for ever), on a machine without feedback.
    """

    reason = "following_error"

    def __init__(
        self, geometry: HexapodGeometry | None = None, limit: float = 0.0, anywhere_after: float = 0.0
    ) -> None:
        self.limit, self.anywhere_after, self._began = limit, anywhere_after, math.inf
        self._told: deque[tuple[float, Struts]] = deque(maxlen=KEPT)
        self._read: deque[tuple[float, Struts]] = deque(maxlen=KEPT)
        self._read_made, self._read_stamp = -math.inf, 0
        self._left: tuple[float, Struts] = (-math.inf, ())  # the last command before all of them were forgotten
        self.watch(geometry)

    def watch(self, geometry: HexapodGeometry | None) -> None:
        """Set a machine's strokes, with the largest correction added at either end, step and speed."""
        self._low, self._high = (-math.inf,) * 6, (math.inf,) * 6
        self._jumps = RateLimit(math.inf, 0.0)
        if geometry is not None:
            limits = geometry.limits
            self._low = tuple((limits.stroke[:, 0] - limits.correction).tolist())
            self._high = tuple((limits.stroke[:, 1] + limits.correction).tolist())
            self._jumps = RateLimit(limits.step, FASTER * limits.speed)

    # ---- what comes ----

    def add_command(self, command: Struts, now: float) -> None:
        self._told.append((now, command))

    def check_jump(self, sample: Sample) -> None:
        """Raise a LimitError, ``jump``, for measured struts further from the last ones than a machine can have moved.

        A strut that has really jumped is accepted once the time since the last sample suffices to move that far: by
        the stamps or by the arrivals, whichever is longer, since transport delays messages.
        """
        both = sample.stamp and self._read_stamp
        by_stamp = (sample.stamp - self._read_stamp) * 1e-9 if both else -math.inf
        excess = self._jumps.excess(sample.values or (), sample.now, by_stamp)
        if excess is not None:
            moved, allowed = f"{excess.moved * 1e3:.3f} mm", f"{excess.allowed * 1e3:.3f} mm"
            text = f"{STRUT_NAMES[excess.which]} has jumped by {moved}, in {excess.elapsed:.3f} s it can have moved "
            raise LimitError("jump", text + allowed, excess.moved, excess.allowed, excess.which, "measured")

    def check_stroke(self, struts: Struts) -> None:
        """Raise a LimitError, ``stroke``, for measured struts, m, that no machine can have."""
        short, long = list(map(sub, self._low, struts)), list(map(sub, struts, self._high))
        if max(short) <= 0.0 and max(long) <= 0.0:
            return
        beyond = list(map(max, short, long))
        strut = beyond.index(max(beyond))
        length, low, high = struts[strut], self._low[strut], self._high[strut]
        text = f"{STRUT_NAMES[strut]} cannot be {length * 1e3:.3f} mm long, only {low * 1e3:g}…{high * 1e3:g} mm"
        raise LimitError("stroke", text, length, low if length < low else high, strut, "measured")

    def accept(self, sample: Sample) -> None:
        """Add a good reading, which was made `age` before it arrived."""
        struts = sample.values or ()
        self._jumps.accept(struts, sample.now)
        self._read.append((sample.now, struts))
        self._read_made, self._read_stamp = sample.now - sample.age, sample.stamp

    def follow(self, measured: Struts, made: float) -> bool:
        """Compare measured struts of a monotonic time, s, with their commands; return whether a following error is
        found for the first time, which is the problem from then on."""
        if self.problem or not (self._told and self.limit):
            return False
        if max(map(abs, map(sub, measured, self._told[-1][1]))) <= self.limit:  # as in nearly all cases
            return False
        low, high = _range(self._told, made - FOLLOWED_WITHIN)
        off = np.maximum(low - measured, measured - high)
        strut = int(off.argmax())
        if off[strut] <= self.limit:
            return False
        self.problem = (
            f"{STRUT_NAMES[strut]} is at {measured[strut] * 1e3:.3f} mm, {off[strut] * 1e3:.3f} mm from its "
            f"command, allowed {self.limit * 1e3:g} mm; until ~/reset"
        )
        return True

    def release(self) -> None:
        self.problem = ""

    def reset(self) -> None:
        """No command is in force any more; the struts' last commanded lengths are kept."""
        if self._told:
            self._left = self._told[-1]
        self._told.clear()

    def begin(self, now: float) -> None:
        self._began = now

    # ---- what is asked ----

    def moving(self, now: float) -> str:
        """Return which strut was commanded, or measured, to move how far in the last :data:`FOLLOWED_WITHIN`, as text;
        empty when all stand."""
        for recent, how in ((self._told, "was told to go"), (self._read, "went")):
            if recent:
                low, high = _range(recent, now - FOLLOWED_WITHIN)
                strut = int((high - low).argmax())
                if (way := float(high[strut] - low[strut])) > STANDS_WITHIN:
                    return f"{STRUT_NAMES[strut]} {how} {way * 1e3:.3f} mm in the last {FOLLOWED_WITHIN:g} s"
        return ""

    def mean(self) -> np.ndarray:
        """Return the position of struts at rest: the mean of the readings of the last :data:`AVERAGED_OVER`, shape
        (6,), m; while any of them is further than :data:`NOISE` from another, the newest."""
        since = self._read[-1][0] - AVERAGED_OVER
        rows = np.array([struts for at, struts in self._read if at >= since])
        return rows.mean(axis=0) if (np.ptp(rows, axis=0) <= NOISE).all() else rows[-1]

    def waits(self, now: float) -> bool:
        """Return whether a start must wait until something is known."""
        unknown = not self._read and not self._left[1]
        return unknown and not 0.0 < self.anywhere_after <= now - self._began

    def start(self, now: float, fresh: bool) -> np.ndarray | None:
        """Return the struts' lengths at the start of a first command: as measured, or else as commanded last.

        With `fresh` readings the last one is used, lag included; otherwise it is used only if it was made long enough
        after the last command that the struts had arrived. None: not known, and the start may be anywhere.

        Raises
        ------
        CommandError
            ``no_feedback``: nothing is known, and the start must wait.
        """
        if self.waits(now):
            hint = "a machine without feedback needs start_without_feedback_after"
            if self.anywhere_after:
                hint = f"from {self.anywhere_after:g} s after the start on the first command may be anywhere"
            raise CommandError("no_feedback", f"no strut_states yet: where the struts stand is not known; {hint}")
        told_at, told = self._left
        if self._read and self._read_made >= told_at + (-FOLLOWED_WITHIN if fresh else FOLLOWED_WITHIN):
            return self.mean()
        return np.array(told) if told else None


def _range(recent: deque[tuple[float, Struts]], since: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the minimum and maximum since a monotonic time, s, including what was in force then; each of shape (6,),
    m."""
    rows = []
    for at, struts in reversed(recent):
        rows.append(struts)
        if at < since:
            break
    return np.min(rows, axis=0), np.max(rows, axis=0)
