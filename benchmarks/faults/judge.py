"""The judge: from what was seen to what was missed. It knows nothing of the nodes but their limits and timeouts.

A fault is visible by the record alone: what was delivered to whom, and when. VISIBLE has a function for each kind.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from hexapod_comp.machine.limits import Limits
from hexapod_comp.ros import interface, strut_drive

from .record import LINKS, Happened, Record, Sent, Status, Struts, Told

REPORT_WITHIN = 0.2  # A fault is in diagnostics this long after it is visible, s,
RECOVER_WITHIN = 1.0  # and all is well again this long after the last fault has ended, s;
MOVER_RECOVERS_WITHIN = 5.0  # with a mover, which starts a process and plans before it sends anything again
ANSWER_WITHIN = 0.2  # A command without an answer for this long is lost, s
FOLLOWS_WITHIN = 1e-3  # A machine that follows has its measured struts this near to their commands, m,
LATELY = 0.05  # of the last so many seconds: drives lag, and readings are on their way
RECENT = 0.1  # How old the measured struts may be from which a compensator starts afresh, s
HEARD = 0.05  # Where nothing has been measured for so long, s, it may start from its last command as well
SPEED_OVER = 0.02  # Over so long or longer, s, between two commands as they were sent, no strut is faster than
SPEED_SHARE = 1.05  # so much of the geometry's largest speed
CLOCK_ROUNDING = 1e-6  # Times of this century in seconds are doubles to 0.24 µs
NOTICED_WITHIN = 0.05  # What a node must not do from a moment on, it may still do for this long, s
ROUNDING = 1e-9  # Allowed beyond a limit, m: the limits are decimal fractions
LOOKED_AT = 0.1  # Silence must last so much longer than its limit, s: less may lie between two checks of a node


@dataclass
class Verdict:
    """What the judge found in one episode."""

    breaches: list[str] = field(default_factory=list)  # what was published and must not be
    # Of each fault, by kind, how long it took until it was reported, s; NaN where it was not visible
    reports: list[tuple[str, float]] = field(default_factory=list)
    recovery: float = 0.0  # from the end of the last fault until all was well, s; infinite if never
    sent: int = 0  # good commands outside the faults,
    lost: int = 0  # and those of them without an answer
    within: float = RECOVER_WITHIN  # longest recovery allowed, s

    def misses(self) -> list[str]:
        """Return which bars were missed, in words."""
        found = list(self.breaches)
        for kind, delay in self.reports:
            if delay > REPORT_WITHIN:
                when = "never" if math.isinf(delay) else f"after {delay * 1e3:.0f} ms"
                found.append(f"{kind}: reported {when}")
        if not self.recovery <= self.within:
            found.append(f"recovery took {self.recovery:.2f} s")
        if self.lost:
            found.append(f"{self.lost} of {self.sent} good commands lost")
        return found


def judge(record: Record, limits: Limits, within: float = RECOVER_WITHIN) -> Verdict:
    """Return the verdict over one episode; `within`: longest recovery allowed, s."""
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
    return [entry for entry in record.sent.values() if entry.sent_at < record.ended - ANSWER_WITHIN]


def _answered(entry: Sent) -> bool:
    return bool(entry.answered_at - entry.sent_at <= ANSWER_WITHIN)


# ---- what must never be published ----


def breaches(record: Record, limits: Limits) -> list[str]:
    """Return what was published that must not be: not finite, outside the stroke, too far, too fast, too corrected."""
    found = [text for fault in record.faults for text in fault.breaches]
    low, high = limits.stroke[:, 0] - ROUNDING, limits.stroke[:, 1] + ROUNDING
    for previous, struts in zip([None, *record.commands], record.commands, strict=False):
        if not np.isfinite(struts.lengths).all():
            found.append("strut_commands not finite, or not six")
        elif ((struts.lengths < low) | (struts.lengths > high)).any():
            found.append("strut_commands outside the stroke")
        if previous is not None and (step := _step(record, previous, struts)) > limits.step + ROUNDING:
            found.append(f"strut_commands step of {step * 1e3:.3f} mm at {struts.time - record.commands[0].time:.3f} s")
    for struts in record.corrections:
        if not np.isfinite(struts.lengths).all():
            found.append("strut_corrections not finite")
        elif (largest := np.abs(struts.lengths).max()) > limits.correction + ROUNDING:
            found.append(f"strut_corrections of {largest * 1e3:.3f} mm")
    times = np.array([struts.time for struts in record.commands])
    for fault in record.faults:
        for since, until in fault.standing:
            if count := int(((times > since + NOTICED_WITHIN) & (times < until)).sum()):
                found.append(f"{fault.kind}: {count} strut_commands though the machine must stand")
    if (speed := _largest_speed(record)) > SPEED_SHARE * limits.speed:
        found.append(f"strut_commands at {speed * 1e3:.0f} mm/s over {SPEED_OVER * 1e3:g} ms")
    return found


def _step(record: Record, previous: Struts, struts: Struts) -> float:
    """Return the step of a command, m: from the one before, or at a fresh start from the struts measured last."""
    steps = []
    if _fresh(record, previous, struts):
        recent = [m for m in record.measured if 0 <= struts.time - m.time < RECENT]
        steps = [_distance(struts.lengths, measured.lengths) for measured in recent]
        if recent and recent[-1].time >= struts.time - HEARD:
            return min(steps)
    return min([*steps, _distance(struts.lengths, previous.lengths)])


def _fresh(record: Record, previous: Struts, struts: Struts) -> bool:
    """Return whether a compensator was started or reset between two commands."""
    return any(previous.time < start <= struts.time for start in record.fresh_starts)


def _largest_speed(record: Record) -> float:
    """Return the largest speed of a strut, m/s; a fresh start begins anew."""
    begin, worst = 0, 0.0
    for n, struts in enumerate(record.commands):
        if n and _fresh(record, record.commands[n - 1], struts):
            begin = n
        while begin + 1 < n and record.commands[begin + 1].time <= struts.time - SPEED_OVER:
            begin += 1
        since = struts.time - record.commands[begin].time
        if since >= SPEED_OVER - CLOCK_ROUNDING:
            worst = max(worst, _distance(struts.lengths, record.commands[begin].lengths) / since)
    return worst


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    distance = float(np.abs(a - b).max())
    return distance if math.isfinite(distance) else math.inf


# ---- when a fault is visible, to which node, and what that must report ----


def default_of(node, name: str) -> float:
    return next(float(p.default) for p in node.PARAMETERS if p.name == name)


FOLLOWING_LIMIT = default_of(interface, "following_error_limit")

SILENCE = {  # which node must report what when a link is silent for longer than a time, s
    "pose": ("compensator", "no new command|waiting for the first command", default_of(interface, "command_timeout")),
    "command": (
        "strut_drive",
        "no new command|waiting for the first command",
        default_of(strut_drive, "command_timeout"),
    ),
    "feedback": (
        "compensator",
        "feedback lost|pose estimated from own commands",
        default_of(interface, "feedback_timeout"),
    ),
}
# … when a link delivers what must be refused, for the reason in the braces. A latched following error refuses every
# command before anything else about it is checked.
REFUSALS = {
    "pose": ("compensator", "refusing commands: .*({}|following_error)|last_refusal=.*{}"),
    "command": ("strut_drive", "refusing commands: .*{}|last_refusal=.*{}"),
    "feedback": ("compensator", "bad feedback: .*{}|last_bad_feedback=.*{}|refusing commands: .*{}"),
}

Expected = list[tuple[str, str, float]]
"""Nodes, the pattern that each must report, and since when it can know it."""


def silence(link: str, record: Record, fault: Happened) -> Expected:
    """A link is silent: visible when nothing has come for the timeout of a node that is alive."""
    node, pattern, timeout = SILENCE[link]
    times, killed = [*record.delivered[link], math.inf], sorted(record.killed[node])
    for last, following in itertools.pairwise(times):
        since = last + timeout
        for start, end in killed:
            if start < since + LOOKED_AT:
                since = max(since, end)
        if following > fault.began and last < fault.ended and following > since + LOOKED_AT:
            return [(node, pattern, last + timeout)]
    return []


def refusal(link: str, record: Record, fault: Happened) -> Expected:
    """A link delivers what must be refused: visible when the first of it is delivered to a running node."""
    node, words = REFUSALS[link]
    return at_mark([(node, words.replace("{}", f"({fault.detail.rsplit('reason ', 1)[-1]})"))], record, fault)


def late(link: str, record: Record, fault: Happened) -> Expected:
    """Messages come late: visible as silence, or as what must be refused."""
    return silence(link, record, fault) or refusal(link, record, fault)


def following_error(record: Record, fault: Happened) -> Expected:
    """Struts are not where they were told: visible in the first reading beyond the compensator's limit."""
    told = Told(record.commands)
    for reading in record.measured:
        if fault.began <= reading.time <= fault.ended + LOOKED_AT and told.off(reading, 0.1) > FOLLOWING_LIMIT:
            return [("compensator", "following", reading.time)]
    return []


def at_mark(said_by: Sequence[tuple[str, str]], record: Record, fault: Happened) -> Expected:
    """Visible when it is done, unless the node is dead or killed before it must report."""
    found = []
    for node, words in said_by:
        dead = record.killed[node]
        seen = [m for m in fault.marks if not any(start - REPORT_WITHIN < m < end for start, end in dead)]
        found += [(node, words, mark) for mark in seen[:1]]
    return found


def nothing(record: Record, fault: Happened) -> Expected:
    """Harmless, and nothing need be reported."""
    return []


VISIBLE: dict[str, Callable[[Record, Happened], Expected]] = {
    "kill_compensator": partial(silence, "command"),
    "stop_compensator": partial(silence, "command"),
    "kill_drive": partial(silence, "feedback"),
    "stop_drive": partial(silence, "feedback"),
    "kill_mover": partial(silence, "pose"),
    "stop_mover": partial(silence, "pose"),
    **{f"drop_{link}": partial(silence, link) for link in LINKS},
    **{f"delay_{link}": partial(late, link) for link in LINKS},
    **{f"duplicate_{link}": nothing for link in LINKS},
    **{f"reorder_{link}": partial(refusal, link) for link in LINKS},
    **{f"corrupt_{link}": partial(refusal, link) for link in LINKS},
    "restart_under_stream": partial(silence, "command"),
    "reset_under_stream": partial(silence, "feedback"),
    "reload_under_stream": nothing,
    "stop_under_stream": partial(silence, "command"),
    "bunched_pose": partial(silence, "pose"),
    "stamps_stand": partial(refusal, "pose"),
    "too_fast": nothing,
    "reset_in_motion": partial(at_mark, [("compensator", "reset refused|refused_resets=[1-9]")]),
    "use_sim_time_set": nothing,
    "latched_following_error": following_error,
    "stuck_strut": following_error,
    "jumping_strut": following_error,
    "encoder_nan": partial(at_mark, [("compensator", "bad feedback: not_finite")]),
    "log_disk_full": partial(at_mark, [("compensator", "log"), ("strut_drive", "log")]),
    "half_written_model": partial(at_mark, [("compensator", "the old model stays|last_failed_reload=.+")]),
}


def reported(record: Record, fault: Happened) -> float:
    """Return the longest time until a node reported what became visible to it, s; NaN where nothing did."""
    found = [_reported_by(record, fault, *expected) for expected in VISIBLE[fault.kind](record, fault)]
    return max((delay for delay in found if not math.isnan(delay)), default=math.nan)


def _reported_by(record: Record, fault: Happened, node: str, pattern: str, since: float) -> float:
    """Return how long a node, while it ran, took to report a pattern; what it reports already counts as at once."""
    outages = sorted(record.outages[node])
    for start, end in outages:
        if start <= since < end:
            since = end
    if math.isinf(since) or (outages and since > fault.ended):
        return math.nan
    said = record.said(node)
    before = [status for status in said if status.time < since]
    if before and _new(before[-1], said, pattern, fault.began):
        return 0.0
    for status in said:
        if status.time >= since and _new(status, said, pattern, fault.began):
            down = [min(status.time, end) - max(since, start) for start, end in outages]
            return status.time - since - sum(time for time in down if time > 0.0)
    return math.inf


def _new(status: Status, said: list[Status], pattern: str, began: float) -> bool:
    """Return whether a status has a pattern: as its message, or as a value that was another before the fault began."""
    if re.search(pattern, status.message):
        return True
    old = [s for s in said if s.time < began]
    told_before = old[-1].text() if old else ""
    return any(re.search(pattern, line) and line not in told_before for line in status.text().split("\n")[1:])


def recovery(record: Record, ended: float) -> float:
    """Return how long after the end of the faults, s, commands were answered and the struts followed for good."""
    after, told = [entry for entry in _due(record) if entry.sent_at >= ended], Told(record.commands)
    bad = [entry.sent_at for entry in after if not _answered(entry)]
    bad += [m.time for m in record.measured if m.time >= ended and not told.off(m, LATELY) <= FOLLOWS_WITHIN]
    last_bad = max(bad, default=ended)
    good = [entry.answered_at for entry in after if entry.sent_at >= last_bad and _answered(entry)]
    return min(good) - ended if good else math.inf
