"""When a fault is visible, to whom, and what that node must then say: one function for each kind of fault.

All of it is read off the record: what was delivered to whom, and when. Nothing here asks the nodes.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from hexapod_comp.ros import compensator, strut_drive

from .record import Happened, Record, Told

LOOKED_AT = 0.1
"""What lasts a moment less than a node's two looks is not visible to it, s: silence that much beyond its limit is."""

REPORT_WITHIN = 0.2
"""A fault is in diagnostics this long after it is visible, s."""

Expected = tuple[str, re.Pattern, float]
"""Node, what it must say, and since when it can know it."""


@dataclass(frozen=True)
class Reported:
    """Whether a fault was visible, after how long it was said, s, and in which words."""

    visible: bool
    delay: float = math.nan
    words: str = ""


def _default(module, name: str, otherwise: float) -> float:
    """Return the default of a node's parameter."""
    return next((float(p.default) for p in module.PARAMETERS if p.name == name), otherwise)


COMMAND_TIMEOUT = _default(compensator, "command_timeout", 0.1)
FEEDBACK_TIMEOUT = _default(compensator, "feedback_timeout", 0.1)
DRIVE_TIMEOUT = _default(strut_drive, "command_timeout", 0.1)
FOLLOWING_LIMIT = _default(compensator, "following_error_limit", 1e-3)

SILENCE = {
    "pose": ("compensator", re.compile("no new command|waiting for the first command"), COMMAND_TIMEOUT),
    "command": ("strut_drive", re.compile("no new command|waiting for the first command"), DRIVE_TIMEOUT),
    "feedback": ("compensator", re.compile("feedback lost|pose estimated from own commands"), FEEDBACK_TIMEOUT),
}
"""Who must say what when a link is silent for longer than a time, s."""

LATCHED = "following_error"
"""What refuses every command until it is released, before anything else about a command is checked."""

REFUSALS = {
    "pose": ("compensator", f"refusing commands: .*({{}}|{LATCHED})|last_refusal=.*{{}}"),
    "command": ("strut_drive", "refusing commands: .*{}|last_refusal=.*{}"),
    "feedback": ("compensator", "bad feedback: .*{}|last_bad_feedback=.*{}|refusing commands: .*{}"),
}
"""Who must say what when a link delivers what cannot be used; the reason goes into the braces."""


def silence(link: str, record: Record, fault: Happened) -> list[Expected]:
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


def refusal(link: str, record: Record, fault: Happened) -> list[Expected]:
    """A link delivers what cannot be used: visible when the first of it is delivered to a running node."""
    node, words = REFUSALS[link]
    reason = fault.detail.rsplit("reason ", 1)[-1]
    return at_mark([(node, words.replace("{}", f"({reason})"))], record, fault)


def either(first: Callable, second: Callable, record: Record, fault: Happened) -> list[Expected]:
    """What makes a fault visible first decides."""
    return first(record, fault) or second(record, fault)


def following_error(record: Record, fault: Happened) -> list[Expected]:
    """Struts are not where they were told: visible in the first reading beyond the compensator's limit."""
    told = Told(record.commands)
    for reading in record.measured:
        if fault.began <= reading.time <= fault.ended + LOOKED_AT and told.off(reading, 0.1) > FOLLOWING_LIMIT:
            return [("compensator", re.compile("following"), reading.time)]
    return []


def at_mark(said_by: Sequence[tuple[str, str]], record: Record, fault: Happened) -> list[Expected]:
    """Visible when it is done, unless the node is dead or killed before it must report."""
    found = []
    for node, words in said_by:
        dead = record.killed[node]
        seen = [m for m in fault.marks if not any(start - REPORT_WITHIN < m < end for start, end in dead)]
        found += [(node, re.compile(words), mark) for mark in seen[:1]]
    return found


def nothing(record: Record, fault: Happened) -> list[Expected]:
    """Harmless, and nothing need be reported."""
    return []


VISIBLE: dict[str, Callable[[Record, Happened], list[Expected]]] = {
    "kill_compensator": partial(silence, "command"),
    "stop_compensator": partial(silence, "command"),
    "kill_drive": partial(silence, "feedback"),
    "stop_drive": partial(silence, "feedback"),
    "kill_mover": partial(silence, "pose"),
    "stop_mover": partial(silence, "pose"),
    **{f"drop_{link}": partial(silence, link) for link in SILENCE},
    **{f"delay_{link}": partial(either, partial(silence, link), partial(refusal, link)) for link in SILENCE},
    **{f"duplicate_{link}": nothing for link in SILENCE},
    **{f"reorder_{link}": partial(refusal, link) for link in SILENCE},
    **{f"corrupt_{link}": partial(refusal, link) for link in SILENCE},
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
"""For each kind, a function of record and fault that returns who must say what since when; see doc/faults.md."""
