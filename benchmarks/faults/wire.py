"""Wires of the harness, faults of a link, and ways to corrupt a message."""

from __future__ import annotations

import copy
import heapq
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

NOTHING, SPOILT, LATE = range(3)  # defect of a message; only a message that a later one has overtaken is LATE
REORDERED_BY = 0.15  # delay of an overtaken message, s: the controller repeats after 0.1 s, nodes publish every few ms
NANOSECONDS = 1_000_000_000
Rule = Callable[[Any, float], list[tuple[float, Any, int]]]
"""From a message and the time, s: times of delivery, s, delivered messages, and their defects."""


class Wire:
    """Delivers messages at once, or by its `rule`."""

    def __init__(self, deliver: Callable[[Any, float], None]) -> None:
        self._deliver = deliver
        self._waiting: list[tuple[float, int, Any, int]] = []
        self._count = itertools.count()
        self._newest = -1
        self.rule: Rule | None = None
        self.marks: list[float] = []  # times at which defective messages were delivered

    def put(self, message: Any, now: float) -> None:
        if self.rule is None:
            self._deliver(message, now)
            return
        for due, out, wrong in self.rule(message, now):
            heapq.heappush(self._waiting, (due, next(self._count), out, wrong))
        self.release(now)

    def release(self, now: float, everything: bool = False) -> None:
        """Deliver the messages that are due, or all messages, in the order of their times."""
        while self._waiting and (everything or self._waiting[0][0] <= now):
            _, number, message, wrong = heapq.heappop(self._waiting)
            self._deliver(message, now)
            if wrong == SPOILT or (wrong == LATE and number < self._newest):
                self.marks.append(now)
            self._newest = max(self._newest, number)

    def due(self) -> float:
        """Return the monotonic time of the next delivery, s; infinite if no message waits."""
        return self._waiting[0][0] if self._waiting else float("inf")

    def mend(self, now: float) -> None:
        """Remove the rule and deliver all waiting messages."""
        self.rule = None
        self.release(now, everything=True)


# ---- rules ----


def _to_some(rng: np.random.Generator, share: float, happen: Rule) -> Rule:
    """Apply `happen` to a random share of the messages."""

    def rule(message: Any, now: float) -> list[tuple[float, Any, int]]:
        return [(now, message, NOTHING)] if rng.uniform() >= share else happen(copy.deepcopy(message), now)

    return rule


def drop(rng: np.random.Generator, share: float) -> Rule:
    return _to_some(rng, share, lambda message, now: [])


def duplicate(rng: np.random.Generator, share: float) -> Rule:
    """Deliver a share of the messages twice, the second time 1 ms later."""
    return _to_some(
        rng, share, lambda message, now: [(now, message, NOTHING), (now + 1e-3, copy.deepcopy(message), NOTHING)]
    )


def reorder(rng: np.random.Generator, share: float) -> Rule:
    """Delay a share of the messages, so that later messages overtake them."""
    return _to_some(rng, share, lambda message, now: [(now + REORDERED_BY, message, LATE)])


def delay(seconds: float, too_old: bool = False) -> Rule:
    """Delay all messages; if `too_old`, they are marked as messages that the receiver must refuse."""
    return lambda message, now: [(now + seconds, copy.deepcopy(message), SPOILT if too_old else NOTHING)]


def corrupt(rng: np.random.Generator, share: float, spoil: Callable[[Any], object]) -> Rule:
    def happen(message: Any, now: float) -> list[tuple[float, Any, int]]:
        spoil(message)
        return [(now, message, SPOILT)]

    return _to_some(rng, share, happen)


def restamp(apart: int, lengths: Callable[[Any], np.ndarray], allowed: Callable[[float], float]) -> Rule:
    """Give the messages stamps that are `apart` ns from each other, beginning with the first message's own stamp.

    A message is defective if its strut `lengths` differ from the first message's by more than `allowed` for the time
    between their stamps."""
    first: list[tuple[int, np.ndarray]] = []
    count = itertools.count(1)

    def rule(message: Any, now: float) -> list[tuple[float, Any, int]]:
        out, wanted = copy.deepcopy(message), lengths(message)
        stamp = out.header.stamp
        first or first.append((stamp.sec * NANOSECONDS + stamp.nanosec, wanted))
        later = next(count) * apart
        stamp.sec, stamp.nanosec = divmod(first[0][0] + later, NANOSECONDS)
        too_fast = float(np.abs(wanted - first[0][1]).max()) > allowed(later * 1e-9)
        return [(now, out, SPOILT if too_fast else NOTHING)]

    return rule


# ---- ways to corrupt a message, and the reason with which a node must refuse it ----


def _five_struts(message: Any) -> None:
    message.name, message.position, message.velocity = message.name[:5], message.position[:5], message.velocity[:5]


STRUT_SPOILS: dict[str, tuple[Callable[[Any], object], str]] = {
    "NaN": (lambda m: m.position.__setitem__(2, float("nan")), "not_finite"),
    "a name": (lambda m: setattr(m, "name", [*m.name[:5], "strut_9"]), "strut_names"),
    "five struts": (_five_struts, "strut_names"),
}
STAMPS: dict[str, tuple[Callable[[Any], object], str]] = {
    "5 s old": (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec - 5), "stamp_past"),
    "5 s ahead": (lambda m: setattr(m.header.stamp, "sec", m.header.stamp.sec + 5), "stamp_future"),
}


def _huge_strut(message: Any) -> None:
    message.position[4] = 1e30


def _far_strut(message: Any) -> None:
    message.position[1] += 0.03


SPOILS: dict[str, dict[str, tuple[Callable[[Any], object], str]]] = {
    "pose": {
        "NaN": (lambda m: setattr(m.pose.position, "z", float("nan")), "not_finite"),
        "quaternion": (lambda m: setattr(m.pose.orientation, "w", 1.1 * m.pose.orientation.w), "quaternion"),
        "frame": (lambda m: setattr(m.header, "frame_id", "bose"), "frame_id"),
        "30 mm away": (lambda m: setattr(m.pose.position, "x", m.pose.position.x + 0.03), "step"),
        **STAMPS,
    },
    "command": {**STRUT_SPOILS, "1e30 m": (_huge_strut, "step"), "30 mm away": (_far_strut, "step")},
    "feedback": {
        **STRUT_SPOILS,
        "1e30 m": (_huge_strut, "stroke"),
        "30 mm away": (_far_strut, "following|stroke|jump"),
        **STAMPS,
    },
}
