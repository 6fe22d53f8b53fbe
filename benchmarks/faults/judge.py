"""The judge: from what was seen to what was missed. It knows nothing of the nodes but their limits."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import numpy as np

from hexapod_comp.machine.geometry import HexapodGeometry

from .record import Happened, Record, Sent, Status, Struts, Told
from .visible import REPORT_WITHIN, VISIBLE, Reported

RECOVER_WITHIN = 1.0
"""All is well again this long after the last fault has ended, s."""

MOVER_RECOVERS_WITHIN = 3.0
"""With a mover, which starts a process and plans before it sends anything again, s."""

ANSWER_WITHIN = 0.2
"""A command without an answer for this long is lost, s."""

FOLLOWS_WITHIN = 1e-3
"""A machine that follows has its measured struts this near to what they were told lately, m."""

LATELY = 0.05
"""Drives lag, and readings are on their way for a while, s."""

RECENT = 0.1
"""How old the measured struts may be from which a compensator starts afresh, s."""

HEARD = 0.05
"""Where nothing has been measured for so long, s, it may start from what it told last as well."""

SPEED_OVER = 0.02
"""Over so long or longer, s, between two commands as they were sent, no strut goes faster than allowed."""

CLOCK_ROUNDING = 1e-6
"""Times of this century in seconds are doubles to 0.24 µs."""

SPEED_SHARE = 1.05
"""So much of the geometry's largest speed is allowed there."""

NOTICED_WITHIN = 0.05
"""What a node must not do from a moment on, it may still do for this long, s: it has to hear of it."""

ROUNDING = 1e-9
"""Allowed beyond a limit, m: the limits are decimal fractions."""


@dataclass(frozen=True)
class Limits:
    """What may be published: stroke (6, 2), largest step and largest correction, m, largest speed, m/s."""

    stroke: np.ndarray
    step: float
    correction: float
    speed: float

    @staticmethod
    def of(geometry: HexapodGeometry) -> Limits:
        """Return a machine's."""
        limits = geometry.limits
        return Limits(limits.stroke, limits.step, limits.correction, limits.speed)


@dataclass
class Verdict:
    """What the judge found in one episode.

    Attributes
    ----------
    breaches : list of str
        What was published and must not be.
    reports : list of (str, Reported)
        For each fault its kind and how long it took until it was said.
    recovery : float
        From the end of the last fault until all was well, s; infinite if never.
    sent, lost : int
        Good commands outside the faults, and how many of these got no answer.
    within : float
        Longest recovery allowed, s.
    """

    breaches: list[str] = field(default_factory=list)
    reports: list[tuple[str, Reported]] = field(default_factory=list)
    recovery: float = 0.0
    sent: int = 0
    lost: int = 0
    within: float = RECOVER_WITHIN

    def misses(self) -> list[str]:
        """Return which bars were missed, in words."""
        found = list(self.breaches)
        for kind, report in self.reports:
            if report.visible and not report.delay <= REPORT_WITHIN:
                when = "never" if math.isinf(report.delay) else f"after {report.delay * 1e3:.0f} ms"
                found.append(f"{kind}: reported {when}")
        if not self.recovery <= self.within:
            found.append(f"recovery took {self.recovery:.2f} s")
        if self.lost:
            found.append(f"{self.lost} of {self.sent} good commands lost")
        return found


def judge(record: Record, limits: Limits, within: float = RECOVER_WITHIN) -> Verdict:
    """Return the verdict over one episode; within: longest recovery allowed, s."""
    began = min((fault.began for fault in record.faults), default=math.inf)
    ended = max((fault.ended for fault in record.faults), default=-math.inf)
    outside = [s for s in _due(record) if not began - ANSWER_WITHIN < s.sent_at < ended + within]
    return Verdict(
        breaches=breaches(record, limits),
        reports=[(fault.kind, reported(record, fault)) for fault in record.faults],
        recovery=recovery(record, ended) if record.faults else 0.0,
        sent=len(outside),
        lost=sum(not _answered(entry) for entry in outside),
        within=within,
    )


def _due(record: Record) -> list[Sent]:
    """Return the commands that had time to be answered."""
    return [entry for entry in record.sent.values() if entry.sent_at < record.ended - ANSWER_WITHIN]


def _answered(entry: Sent) -> bool:
    return bool(entry.answered_at - entry.sent_at <= ANSWER_WITHIN)


# ---- what must never be published ----


def breaches(record: Record, limits: Limits) -> list[str]:
    """Return what was published that must not be: not finite, outside the stroke, too far, too fast, too corrected."""
    found = [text for fault in record.faults for text in fault.breaches]
    for previous, struts in zip([None, *record.commands], record.commands, strict=False):
        found += [f"strut_commands {problem}" for problem in _outside(struts.lengths, limits)]
        if previous is not None and (step := _step(record, previous, struts)) > limits.step + ROUNDING:
            found.append(f"strut_commands step of {step * 1e3:.3f} mm at {struts.time - record.commands[0].time:.3f} s")
    for struts in record.corrections:
        if not np.isfinite(struts.lengths).all():
            found.append("strut_corrections not finite")
        elif (largest := np.abs(struts.lengths).max()) > limits.correction + ROUNDING:
            found.append(f"strut_corrections of {largest * 1e3:.3f} mm")
    return [*found, *_too_fast(record, limits), *_not_standing(record)]


def _outside(lengths: np.ndarray, limits: Limits) -> list[str]:
    if not np.isfinite(lengths).all():
        return ["not finite, or not six"]
    low, high = limits.stroke[:, 0] - ROUNDING, limits.stroke[:, 1] + ROUNDING
    return ["outside the stroke"] if ((lengths < low) | (lengths > high)).any() else []


def _step(record: Record, previous: Struts, struts: Struts) -> float:
    """Return the step of a command, m: from the one before, or at a fresh start from the struts measured last."""
    if _fresh(record, previous, struts):
        recent = [m for m in record.measured if 0 <= struts.time - m.time < RECENT]
        steps = [_distance(struts.lengths, measured.lengths) for measured in recent]
        if not recent or recent[-1].time < struts.time - HEARD:
            steps.append(_distance(struts.lengths, previous.lengths))
        return min(steps)
    return _distance(struts.lengths, previous.lengths)


def _fresh(record: Record, previous: Struts, struts: Struts) -> bool:
    """Return whether a compensator was started or reset between two commands."""
    return any(previous.time < start <= struts.time for start in record.fresh_starts)


def _too_fast(record: Record, limits: Limits) -> list[str]:
    """Return the largest speed if it is too large; a fresh start begins anew."""
    begin, worst = 0, 0.0
    for n, struts in enumerate(record.commands):
        if n and _fresh(record, record.commands[n - 1], struts):
            begin = n
        while begin + 1 < n and record.commands[begin + 1].time <= struts.time - SPEED_OVER:
            begin += 1
        since = struts.time - record.commands[begin].time
        if since < SPEED_OVER - CLOCK_ROUNDING:
            continue
        speed = _distance(struts.lengths, record.commands[begin].lengths) / since
        worst = max(worst, speed)
    too_fast = worst > SPEED_SHARE * limits.speed
    return [f"strut_commands at {worst * 1e3:.0f} mm/s over {SPEED_OVER * 1e3:g} ms"] if too_fast else []


def _not_standing(record: Record) -> list[str]:
    """Return how many commands were published while none may be."""
    times = np.array([struts.time for struts in record.commands])
    found = []
    for fault in record.faults:
        for since, until in fault.standing:
            count = int(((times > since + NOTICED_WITHIN) & (times < until)).sum())
            if count:
                found.append(f"{fault.kind}: {count} strut_commands though the machine must stand")
    return found


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    distance = float(np.abs(a - b).max())
    return distance if math.isfinite(distance) else math.inf


# ---- how soon it is said ----


def reported(record: Record, fault: Happened) -> Reported:
    """Return whether a fault became visible to those who must report it, and the longest time until one did."""
    found = [_reported_by(record, fault, *expected) for expected in VISIBLE[fault.kind](record, fault)]
    seen = [report for report in found if report.visible]
    return max(seen, key=lambda report: report.delay, default=Reported(False))


def _reported_by(record: Record, fault: Happened, node: str, pattern: re.Pattern, since: float) -> Reported:
    """Return how long a node, while it ran, took to say a pattern; what it says already counts as at once."""
    since, reachable = _when_running(record, node, since, fault.ended)
    if not reachable:
        return Reported(False)
    said = record.said(node)
    before = [status for status in said if status.time < since]
    if before and _new(before[-1], said, pattern, fault.began):
        return Reported(True, 0.0, before[-1].message)
    for status in said:
        if status.time >= since and _new(status, said, pattern, fault.began):
            return Reported(True, _running_time(record, node, since, status.time), status.message)
    return Reported(True, math.inf)


def _running_time(record: Record, node: str, since: float, until: float) -> float:
    """Return for how long a node ran between two times, s."""
    outages = [min(until, end) - max(since, start) for start, end in record.outages[node]]
    return until - since - sum(outage for outage in outages if outage > 0.0)


def _new(status: Status, said: list[Status], pattern: re.Pattern, began: float) -> bool:
    """Return whether a status says a pattern: as its message, or as a value that was another before the fault began."""
    if pattern.search(status.message):
        return True
    old = [s for s in said if s.time < began]
    told_before = old[-1].text() if old else ""
    return any(pattern.search(line) and line not in told_before for line in status.text().split("\n")[1:])


def _when_running(record: Record, node: str, since: float, until: float) -> tuple[float, bool]:
    """Return when a running node could see something that lasts from `since` to `until`, and whether it could."""
    for start, end in sorted(record.outages[node]):
        if start <= since < end:
            since = end
    return since, math.isfinite(since) and (since <= until or not record.outages[node])


# ---- recovery ----


def recovery(record: Record, ended: float) -> float:
    """Return how long after the end of the faults, s, commands were answered and the struts followed for good."""
    after = [entry for entry in _due(record) if entry.sent_at >= ended]
    bad = [entry.sent_at for entry in after if not _answered(entry)]
    bad += [m.time for m in _astray(record) if m.time >= ended]
    last_bad = max(bad, default=ended)
    good = [entry.answered_at for entry in after if entry.sent_at >= last_bad and _answered(entry)]
    return min(good) - ended if good else math.inf


def _astray(record: Record) -> list[Struts]:
    """Return the readings of struts that are not where they were told to be."""
    told = Told(record.commands)
    return [reading for reading in record.measured if not told.off(reading, LATELY) <= FOLLOWS_WITHIN]
