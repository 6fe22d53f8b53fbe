"""The wires of the harness: what a link may do to the messages on it."""

from __future__ import annotations

import copy
import heapq
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

NOTHING, SPOILT, LATE = range(3)
"""What is wrong with a message that is delivered; a late one only if another has overtaken it."""

Deliveries = list[tuple[float, Any, int]]
"""When, which message, and what is wrong with it."""

REORDERED_BY = 0.15
"""A message held back so long, s, is overtaken: the controller repeats after 0.1 s, the others speak every few ms."""

NANOSECONDS = 1_000_000_000


class Wire:
    """One link: passes messages on at once, or as its rule says.

    Parameters
    ----------
    deliver : callable
        Takes message and time.
    """

    def __init__(self, deliver: Callable[[Any, float], None]) -> None:
        self._deliver = deliver
        self._waiting: list[tuple[float, int, Any, int]] = []
        self._count = itertools.count()
        self._newest = -1
        self.rule: Rule | None = None
        self.marks: list[float] = []

    def put(self, message: Any, now: float) -> None:
        """Take a message at the monotonic time `now`, s."""
        if self.rule is None:
            self._deliver(message, now)
            return
        for due, out, wrong in self.rule(message, now):
            heapq.heappush(self._waiting, (due, next(self._count), out, wrong))
        self.release(now)

    def release(self, now: float) -> None:
        """Deliver what is due."""
        while self._waiting and self._waiting[0][0] <= now:
            self._hand_over(heapq.heappop(self._waiting), now)

    def _hand_over(self, entry: tuple[float, int, Any, int], now: float) -> None:
        """Deliver one message, and note it if something is wrong with it."""
        _, number, message, wrong = entry
        self._deliver(message, now)
        if wrong == SPOILT or (wrong == LATE and number < self._newest):
            self.marks.append(now)
        self._newest = max(self._newest, number)

    def due(self) -> float:
        """Return when the next delivery is due, monotonic, s; infinite for none."""
        return self._waiting[0][0] if self._waiting else float("inf")

    def mend(self, now: float) -> None:
        """Work well again; what is still on its way arrives now, in its order."""
        self.rule = None
        waiting, self._waiting = sorted(self._waiting), []
        for entry in waiting:
            self._hand_over(entry, now)


class Rule:
    """What a link does to a message; random, but the same for the same seed.

    Parameters
    ----------
    rng : Generator
        Of the episode.
    share : float
        Of the messages that it happens to, 0…1.
    """

    def __init__(self, rng: np.random.Generator, share: float) -> None:
        self._rng, self._share = rng, share

    def __call__(self, message: Any, now: float) -> Deliveries:
        """Return what becomes of a message."""
        if self._rng.uniform() >= self._share:
            return [(now, message, NOTHING)]
        return self.happen(message, now)

    def happen(self, message: Any, now: float) -> Deliveries:
        """Do it to one message."""
        raise NotImplementedError


class Drop(Rule):
    """The message is lost."""

    def happen(self, message: Any, now: float) -> Deliveries:
        """Deliver nothing."""
        return []


class Duplicate(Rule):
    """The message comes twice."""

    def happen(self, message: Any, now: float) -> Deliveries:
        """Deliver it now, and once more 1 ms later."""
        return [(now, message, NOTHING), (now + 1e-3, copy.deepcopy(message), NOTHING)]


class Reorder(Rule):
    """The message is overtaken by later ones."""

    def happen(self, message: Any, now: float) -> Deliveries:
        """Deliver it late."""
        return [(now + REORDERED_BY, copy.deepcopy(message), LATE)]


class Delay(Rule):
    """All messages come later, in their order.

    Parameters
    ----------
    time : float
        s.
    too_old : bool
        Whether that makes them useless to who gets them.
    """

    def __init__(self, rng: np.random.Generator, time: float, too_old: bool) -> None:
        super().__init__(rng, 1.0)
        self._time, self._too_old = time, too_old

    def happen(self, message: Any, now: float) -> Deliveries:
        """Deliver it later."""
        return [(now + self._time, copy.deepcopy(message), SPOILT if self._too_old else NOTHING)]


class Bunch(Rule):
    """The message is held up until the link is mended; then all come at once."""

    def happen(self, message: Any, now: float) -> Deliveries:
        """Hold it up."""
        return [(float("inf"), copy.deepcopy(message), NOTHING)]


class Restamp(Rule):
    """The stamps of the messages stand, or nearly.

    Parameters
    ----------
    apart : int
        From one message's stamp to the next, ns.
    lengths : callable
        Returns the strut lengths that a message asks for, m.
    allowed : callable
        Returns the way that no strut may go within some seconds, m.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        apart: int,
        lengths: Callable[[Any], np.ndarray],
        allowed: Callable[[float], float],
    ) -> None:
        super().__init__(rng, 1.0)
        self._apart, self._lengths, self._allowed = apart, lengths, allowed
        self._first: tuple[int, np.ndarray] | None = None
        self._count = 0

    def happen(self, message: Any, now: float) -> Deliveries:
        """Deliver it with the first one's stamp, or one little later; it is wrong once the struts are too fast."""
        out = copy.deepcopy(message)
        stamp, lengths = out.header.stamp, self._lengths(message)
        if self._first is None:
            self._first = stamp.sec * NANOSECONDS + stamp.nanosec, lengths
        first, before = self._first
        self._count += 1
        stamp.sec, stamp.nanosec = divmod(first + self._count * self._apart, NANOSECONDS)
        way = float(np.abs(lengths - before).max())
        too_fast = way > self._allowed(self._count * self._apart * 1e-9)
        return [(now, out, SPOILT if too_fast else NOTHING)]


class Corrupt(Rule):
    """The message is spoilt.

    Parameters
    ----------
    spoil : callable
        Changes a message.
    """

    def __init__(self, rng: np.random.Generator, share: float, spoil: Callable[[Any], None]) -> None:
        super().__init__(rng, share)
        self._spoil = spoil

    def happen(self, message: Any, now: float) -> Deliveries:
        """Deliver a spoilt copy."""
        spoilt = copy.deepcopy(message)
        self._spoil(spoilt)
        return [(now, spoilt, SPOILT)]


# ---- ways to spoil a message ----


def shifted_stamp(seconds: float) -> Callable[[Any], None]:
    """Return what shifts a message's stamp by some seconds."""

    def spoil(message: Any) -> None:
        stamp = message.header.stamp
        moved = stamp.sec * NANOSECONDS + stamp.nanosec + round(seconds * NANOSECONDS)
        stamp.sec, stamp.nanosec = divmod(moved, NANOSECONDS)

    return spoil


def _nan_position(message: Any) -> None:
    message.pose.position.z = float("nan")


def _long_quaternion(message: Any) -> None:
    message.pose.orientation.w *= 1.1


def _other_frame(message: Any) -> None:
    message.header.frame_id = "bose"


def _far_pose(message: Any) -> None:
    message.pose.position.x += 0.03


def _nan_strut(message: Any) -> None:
    message.position[2] = float("nan")


def _huge_strut(message: Any) -> None:
    message.position[4] = 1e30


def _other_name(message: Any) -> None:
    message.name = [*message.name[:5], "strut_9"]


def _five_struts(message: Any) -> None:
    message.name, message.position, message.velocity = message.name[:5], message.position[:5], message.velocity[:5]


def _far_strut(message: Any) -> None:
    message.position[1] += 0.03


STRUT_SPOILS: dict[str, tuple[Callable[[Any], None], str]] = {
    "NaN": (_nan_strut, "not_finite"),
    "a name": (_other_name, "strut_names"),
    "five struts": (_five_struts, "strut_names"),
}

SPOILS: dict[str, dict[str, tuple[Callable[[Any], None], str]]] = {
    "pose": {
        "NaN": (_nan_position, "not_finite"),
        "quaternion": (_long_quaternion, "quaternion"),
        "frame": (_other_frame, "frame_id"),
        "30 mm away": (_far_pose, "step"),
        "5 s old": (shifted_stamp(-5.0), "stamp_past"),
        "5 s ahead": (shifted_stamp(5.0), "stamp_future"),
    },
    "command": {**STRUT_SPOILS, "1e30 m": (_huge_strut, "step"), "30 mm away": (_far_strut, "step")},
    "feedback": {
        **STRUT_SPOILS,
        "1e30 m": (_huge_strut, "stroke"),
        "30 mm away": (_far_strut, "following|stroke|jump"),
        "5 s old": (shifted_stamp(-5.0), "stamp_past"),
        "5 s ahead": (shifted_stamp(5.0), "stamp_future"),
    },
}
"""For each link the ways to spoil a message on it, and the reason with which it must be refused."""
