"""The judge: evaluates the record of an episode. It knows only the limits and timeouts of the nodes.

VISIBLE computes from the delivered messages when a fault of each kind becomes visible to a node.
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
from hexapod_comp.ros import compensator_state, strut_drive

from .record import LINKS, CommandHistory, Happened, Record, Sent, Status, Struts

REPORT_WITHIN = 0.2  # target: s from a fault being visible to its report in diagnostics
RECOVER_WITHIN = 1.0  # target: s from the end of the last fault to normal operation
MOVER_RECOVERS_WITHIN = 5.0  # the same target with a mover, which starts a process and plans before it sends commands
ANSWER_WITHIN = 0.2  # s; a command without an answer in this time is lost
FOLLOWS_WITHIN = 1e-3  # largest difference, m, of a measured strut from its recent commands in normal operation
FOLLOWS_WINDOW = 0.05  # s before a reading in which a command is recent: drives lag, readings take time
RECENT = 0.1  # age of the measured struts from which a compensator may start afresh, s
NOT_MEASURED_FOR = 0.05  # time without measured struts, s, after which it may also start from its last command
SPEED_OVER = 0.02  # shortest time between two commands from which a strut's speed is computed, s
SPEED_SHARE = 1.05  # largest speed of a strut, as a share of the geometry's limit
CLOCK_ROUNDING = 1e-6  # s: doubles round today's times to 0.24 µs
NOTICED_WITHIN = 0.05  # s in which a node may still publish after the moment from which it must not
ROUNDING = 1e-9  # allowed excess over a limit, m: the limits are decimal fractions
CHECK_PERIOD = 0.1  # silence becomes visible this long after its timeout, s: a node checks periodically


@dataclass
class Verdict:
    breaches: list[str] = field(default_factory=list)  # published messages that are forbidden
    # Kind of each fault, and time to its report, s; NaN: it was not visible
    reports: list[tuple[str, float]] = field(default_factory=list)
    recovery: float = 0.0  # s from the end of the last fault to normal operation; infinite: never
    sent: int = 0  # valid commands outside the faults
    lost: int = 0  # those without an answer
    within: float = RECOVER_WITHIN  # target of the recovery, s

    def misses(self) -> list[str]:
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
    """Return the verdict on an episode, whose recovery may take `within`, s."""
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


# ---- messages that must never be published ----


def breaches(record: Record, limits: Limits) -> list[str]:
    """Describe each message that breaks a limit: not finite, or beyond stroke, step, speed or correction."""
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
        for since, until in fault.halts:
            if count := int(((times > since + NOTICED_WITHIN) & (times < until)).sum()):
                found.append(f"{fault.kind}: {count} strut_commands though the machine must stand")
    if (speed := _largest_speed(record)) > SPEED_SHARE * limits.speed:
        found.append(f"strut_commands at {speed * 1e3:.0f} mm/s over {SPEED_OVER * 1e3:g} ms")
    return found


def _step(record: Record, previous: Struts, struts: Struts) -> float:
    """Return the step of a command, m: from the command before, or after a fresh start from the measured struts."""
    steps = []
    if _fresh(record, previous, struts):
        recent = [m for m in record.measured if 0 <= struts.time - m.time < RECENT]
        steps = [_distance(struts.lengths, measured.lengths) for measured in recent]
        if recent and recent[-1].time >= struts.time - NOT_MEASURED_FOR:
            return min(steps)
    return min([*steps, _distance(struts.lengths, previous.lengths)])


def _fresh(record: Record, previous: Struts, struts: Struts) -> bool:
    return any(previous.time < start <= struts.time for start in record.fresh_starts)


def _largest_speed(record: Record) -> float:
    """Return a strut's largest speed, m/s, between commands without a fresh start in between."""
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


# ---- when a fault is visible, to which node, and the text that the node must report ----


def default_of(node, name: str) -> float:
    return next(float(p.default) for p in node.PARAMETERS if p.name == name)


FOLLOWING_LIMIT = default_of(compensator_state, "following_error_limit")

NO_COMMAND = "no new command|waiting for the first command"
SILENCE = {  # by silent link: node, text that it must report, and timeout, s
    "pose": ("compensator", NO_COMMAND, default_of(compensator_state, "command_timeout")),
    "command": ("strut_drive", NO_COMMAND, default_of(strut_drive, "command_timeout")),
    "feedback": (
        "compensator",
        "feedback lost|pose estimated from own commands|waiting for strut_states",
        default_of(compensator_state, "feedback_timeout"),
    ),
}
# Node and its text, with the reason in braces, by link with a message that must be refused. A latched following error
# is reported in place of the reason.
REFUSALS = {
    "pose": ("compensator", "refusing commands: .*({}|following_error)|last_refusal=.*{}"),
    "command": ("strut_drive", "refusing commands: .*{}|last_refusal=.*{}"),
    "feedback": ("compensator", "bad feedback: .*{}|last_bad_feedback=.*{}|refusing commands: .*{}"),
}

Expected = list[tuple[str, str, float]]
"""Each node that must report the fault, its text as a pattern, and the time from which the fault is visible to it."""


def silence(link: str, record: Record, fault: Happened) -> Expected:
    """Expect a report of a silent link from the node that receives it, after the node's timeout."""
    node, pattern, timeout = SILENCE[link]
    times, killed = [*record.delivered[link], math.inf], sorted(record.killed[node])
    for last, following in itertools.pairwise(times):
        since = last + timeout
        for start, end in killed:
            if start < since + CHECK_PERIOD:
                since = max(since, end)
        if following > fault.began and last < fault.ended and following > since + CHECK_PERIOD:
            return [(node, pattern, last + timeout)]
    return []


def refusal(link: str, record: Record, fault: Happened) -> Expected:
    """Expect a report of refused messages, from the first one that a running node receives."""
    node, words = REFUSALS[link]
    return at_mark([(node, words.replace("{}", f"({fault.detail.rsplit('reason ', 1)[-1]})"))], record, fault)


def late(link: str, record: Record, fault: Happened) -> Expected:
    """Expect late messages to be reported as silence, or refused."""
    return silence(link, record, fault) or refusal(link, record, fault)


def following_error(record: Record, fault: Happened) -> Expected:
    """Expect a report of a following error, from the first reading beyond the compensator's limit."""
    history = CommandHistory(record.commands)
    for reading in record.measured:
        during = fault.began <= reading.time <= fault.ended + CHECK_PERIOD
        if during and history.deviation(reading, 0.1) > FOLLOWING_LIMIT:
            return [("compensator", "following", reading.time)]
    return []


def at_mark(said_by: Sequence[tuple[str, str]], record: Record, fault: Happened) -> Expected:
    """Expect each node to report the first mark (delivery of a wrong message) after which it runs long enough."""
    found = []
    for node, words in said_by:
        dead = record.killed[node]
        seen = [m for m in fault.marks if not any(start - REPORT_WITHIN < m < end for start, end in dead)]
        found += [(node, words, mark) for mark in seen[:1]]
    return found


def nothing(record: Record, fault: Happened) -> Expected:
    """Expect no report: the fault is harmless."""
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
    """Return the longest time, s, from a fault becoming visible to a node until its report; NaN if it was invisible."""
    found = [_reported_by(record, fault, *expected) for expected in VISIBLE[fault.kind](record, fault)]
    return max((delay for delay in found if not math.isnan(delay)), default=math.nan)


def _reported_by(record: Record, fault: Happened, node: str, pattern: str, since: float) -> float:
    """Return for how long, s, a node ran since `since` until it reported a pattern; 0 if it had reported it before."""
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
    """Whether a pattern is in a status' message, or in a value that has changed since the fault began."""
    if re.search(pattern, status.message):
        return True
    old = [s for s in said if s.time < began]
    text_before = old[-1].text() if old else ""
    return any(re.search(pattern, line) and line not in text_before for line in status.text().split("\n")[1:])


def recovery(record: Record, ended: float) -> float:
    """Return the time from the end of the faults until commands are answered and the struts follow, s."""
    after, history = [entry for entry in _due(record) if entry.sent_at >= ended], CommandHistory(record.commands)
    bad = [entry.sent_at for entry in after if not _answered(entry)]
    readings = [m for m in record.measured if m.time >= ended]
    bad += [m.time for m in readings if not history.deviation(m, FOLLOWS_WINDOW) <= FOLLOWS_WITHIN]
    last_bad = max(bad, default=ended)
    good = [entry.answered_at for entry in after if entry.sent_at >= last_bad and _answered(entry)]
    return min(good) - ended if good else math.inf
