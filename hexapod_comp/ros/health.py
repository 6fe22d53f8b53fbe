"""Counters, rates and ages of a node, and the diagnostics message made of them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from ..errors import LONGEST_TEXT, printable

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

SHOWN_FOR = 1.0
"""What has happened colours the status for this long, s."""


def status_prefix(namespace: str, node: str) -> str:
    """Return what the names of all statuses begin with that a node of a namespace publishes."""
    return f"{namespace.strip('/')}/{node}:".lstrip("/")


def status_of(
    name: str, hardware_id: str, level: bytes, text: str, values: Mapping[str, str], longest: int = LONGEST_TEXT
) -> DiagnosticStatus:
    """Return a status; of text and values no more is shown than `longest` characters each."""
    status = DiagnosticStatus(level=level, name=printable(name), hardware_id=printable(hardware_id))
    status.message = printable(text, longest)
    status.values = [KeyValue(key=key, value=printable(value, longest)) for key, value in values.items()]
    return status


class Flow:
    """Counts events and tells their rate and the age of the last one."""

    def __init__(self) -> None:
        self.count = 0
        self.last = -float("inf")
        self._window_start = time.monotonic()
        self._window_count = 0
        self._rate = 0.0

    def tick(self, now: float) -> None:
        """Count one event at the monotonic time `now`, s."""
        self.count += 1
        self.last = now

    def age(self, now: float) -> float:
        """Return the time since the last event, s; infinite before the first."""
        return now - self.last

    def rate(self, now: float) -> float:
        """Return events per second over the last full second or so."""
        span = now - self._window_start
        if span >= 1.0:
            self._rate = (self.count - self._window_count) / span
            self._window_start, self._window_count = now, self.count
        return self._rate


class Lately:
    """Whether something has happened of late: within :data:`SHOWN_FOR`, or since this was asked before.

    So a node that is asked now and then says everything at least once, however long it stood still in between.
    """

    def __init__(self) -> None:
        self._at = self._asked = self._before = -float("inf")

    def note(self, now: float) -> None:
        """Take it that it happens at the monotonic time `now`, s."""
        self._at = now

    def holds(self, now: float) -> bool:
        """Return whether it has happened of late; the same as often as one asks at the same time."""
        if now > self._asked:
            self._before, self._asked = self._asked, now
        return now - self._at < SHOWN_FOR or self._at > self._before


class Refusals:
    """Refused messages, counted by reason."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._lately: dict[str, Lately] = {}
        self.last_reason = ""
        self.last_text = ""

    def add(self, reason: str, text: str, now: float) -> None:
        """Count one refusal."""
        self.counts[reason] += 1
        self._lately[reason] = self._lately.pop(reason, Lately())  # the newest comes last
        self._lately[reason].note(now)
        self.last_reason, self.last_text = reason, text

    def recent(self, now: float) -> bool:
        """Return whether one is recent enough to be shown as an error."""
        return bool(self.reasons(now))

    def reasons(self, now: float, but: str = "") -> str:
        """Return all reasons `but` one recent enough to be shown, the newest first: none must hide another."""
        recent = [reason for reason, lately in self._lately.items() if lately.holds(now)]
        return ", ".join(reason for reason in reversed(recent) if reason != but)

    def values(self) -> dict[str, str]:
        """Return the counters as key and value."""
        values = {"refused": str(sum(self.counts.values()))}
        values.update({f"refused.{reason}": str(count) for reason, count in sorted(self.counts.items())})
        return values


class HealthReport:
    """Publishes a status once a second, and at once when level or message change.

    Parameters
    ----------
    name : str
        Status name, ``node: state``.
    hardware_id : str
        The machine's name, behind its namespace.
    period : float
        Longest time between two messages, s.
    """

    def __init__(self, name: str, hardware_id: str, period: float = 1.0) -> None:
        self._name, self._hardware_id, self._period = name, hardware_id, period
        self._shown: tuple[bytes, str] | None = None
        self._last = -float("inf")

    def due(self, level: bytes, message: str, now: float) -> bool:
        """Return whether a message must go out, and take it as sent."""
        if (level, message) == self._shown and now - self._last < self._period:
            return False
        self._shown, self._last = (level, message), now
        return True

    def message(self, level: bytes, text: str, values: dict[str, str], stamp: Time) -> DiagnosticArray:
        """Return the diagnostics message."""
        array = DiagnosticArray(status=[status_of(self._name, self._hardware_id, level, text, values)])
        array.header.stamp = stamp
        return array


def joined(findings: Iterable[tuple[bytes, str]]) -> tuple[bytes, str]:
    """Return level and text of all findings that are not well, worst first; of the first when all are well."""
    listed = list(findings)
    bad = [finding for finding in listed if finding[0] != OK] or listed[:1]
    return bad[0][0], "; ".join(text for _, text in bad)


def seconds(value: float) -> str:
    """Return an age for people: ``never`` when it is infinite."""
    return "never" if value == float("inf") else f"{value:.3f}"
