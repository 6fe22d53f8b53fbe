"""Counters of a node, and what it says of itself in diagnostics: a table of findings and one of values.

doc/states.md has every case.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.logging import get_logging_directory

from ..compensation.compensator import Compensator
from ..compensation.guards import Guard, Lately, OneSender, StampClock, StampGate
from ..compensation.thermal import Thermometers
from ..compensation.track import StrutTrack
from ..errors import LONGEST_TEXT, printable
from ..machine.temperatures import HUMIDITY, REFERENCE_HUMIDITY

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

LEAST_ROOM = 65_536  # A file system with less than this, byte, is full: a few hundred lines of log
NEAR_SINGULAR = 0.9  # From this share of the largest allowed condition number on, diagnostics warn


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


def joined(findings: Iterable[tuple[bytes, str]]) -> tuple[bytes, str]:
    """Return level and text of all findings that are not well, worst first; of the first when all are well."""
    listed = list(findings)
    bad = [finding for finding in listed if finding[0] != OK] or listed[:1]
    return bad[0][0], "; ".join(text for _, text in bad)


def seconds(value: float) -> str:
    """Return an age for people: ``never`` when it is infinite."""
    return "never" if value == math.inf else f"{value:.3f}"


class Flow:
    """Counts events and tells their rate and the age of the last one."""

    def __init__(self) -> None:
        self.count, self.last = 0, -math.inf
        self._since, self._before, self._rate = time.monotonic(), 0, 0.0

    def tick(self, now: float) -> None:
        """Count one event."""
        self.count += 1
        self.last = now

    def age(self, now: float) -> float:
        """Return the time since the last event, s; infinite before the first."""
        return now - self.last

    def rate(self, now: float) -> float:
        """Return events per second over the last full second or so."""
        if (span := now - self._since) >= 1.0:
            self._rate = (self.count - self._before) / span
            self._since, self._before = now, self.count
        return self._rate


class Refusals:
    """Refused messages, counted by reason."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._lately: dict[str, Lately] = {}
        self.last_reason = self.last_text = ""

    @property
    def total(self) -> int:
        """All of them."""
        return sum(self.counts.values())

    def add(self, reason: str, text: str, now: float) -> None:
        """Count one."""
        self.counts[reason] += 1
        self._lately.setdefault(reason, Lately()).note(now)
        self._lately[reason] = self._lately.pop(reason)  # the newest stands last
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
        counts = {f"refused.{reason}": str(count) for reason, count in sorted(self.counts.items())}
        return {"refused": str(self.total), **counts}


class LogSpace:
    """Whether there is room for ROS's log: nobody but the nodes can tell that nothing is written any more."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = Path(get_logging_directory()) if folder is None else folder
        self.problem = ""

    def look(self) -> None:
        """Look again; takes a few microseconds on a local file system."""
        self.problem = ""
        try:
            usage = os.statvfs(self._folder)
        except FileNotFoundError:
            return  # nothing is logged to files
        except OSError as error:
            self.problem = f"log folder lost: {error.strerror}"
            return
        full = usage.f_bavail * usage.f_frsize < LEAST_ROOM
        self.problem = f"log disk full: {self._folder}" if full else ""


class HealthReport:
    """Publishes a status once a `period`, s, and at once when level or message change."""

    def __init__(self, name: str, hardware_id: str, period: float = 1.0) -> None:
        self._name, self._hardware_id, self._period = name, hardware_id, period
        self._shown: tuple[bytes, str] | None = None
        self._last = -math.inf

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


# ---- the compensator's ----


# What the sender of a refused command is to do, by reason
ADVICE = {
    "stamp_past": "send the pose again with a new stamp; never skip one that was not answered",
    "stamp_future": "set the clocks, or send a zero stamp, which means now",
    "stamp_order": "stamp commands in the order in which they are sent",
    "step": "go on from the last answered command (last_answered), in steps that the limit allows",
    "speed": "plan slower, and stamp each pose with the time for which it was computed, not that of sending",
    "acceleration": "plan more gently, and stamp each pose with the time for which it was computed",
    "tool_changed": "send where the struts are with the tool in use; the refusal says where that is",
    "no_feedback": "wait for strut_states; a machine without feedback needs start_without_feedback_after",
    "following_error": "find out why the struts do not follow, then call ~/reset while the machine stands",
    "several_publishers": "leave one publisher on the topic",
    "unknown_publisher": "leave one publisher on the topic, whose node's name can be read",
}

# The same for all other reasons: a limit, a frame, a message that cannot be read
OTHERWISE = "mend what the refusal names, and go on from the last answered command (last_answered)"


class CompensatorStatus:
    """Counters and guards of a compensator node, which outlive its configurations, and the status made of them."""

    def __init__(self, options: dict[str, Any], clock: StampClock) -> None:
        self.options, self.clock = options, clock
        self.command_stamps, self.reading_stamps = StampGate("command", clock), StampGate("reading", clock, capped=True)
        self.track, self.log_space = StrutTrack(), LogSpace()
        self.commands, self.feedback = Flow(), Flow()  # accepted commands, usable measured struts
        self.refusals, self.bad_feedback = Refusals(), Refusals()
        self.failed_reloads, self.refused_resets, self.refused_tools = Refusals(), Refusals(), Refusals()
        self.waited = self.dropped = 0  # commands that have waited, and that a newer one has replaced
        self.behind = Lately()  # commands were taken late: jitter is nothing to speak of
        self.frame_id = self.prediction_problem = ""  # of the last command; why no error is predicted
        self.last_answered = 0  # stamp, ns; 0 before the first
        self.fresh_start = True  # no command is in force
        self.take_parameters()

    def configure(
        self,
        compensator: Compensator,
        thermometers: Thermometers,
        frame_ids: dict[str, str],
        source: OneSender,
        own_topic: OneSender,
        measuring: OneSender,
        sensing: dict[str, OneSender],
    ) -> None:
        """Take what a configuration has made: who commands, who else publishes strut commands, who measures; who
        publishes temperatures, humidity, the choice of tool, of whom a second one is not obeyed and stops nothing."""
        self.compensator, self.thermometers = compensator, thermometers
        self.frame_ids = frame_ids  # by the machine's names of its frames
        self.source, self.own_topic, self.measuring, self.sensing = source, own_topic, measuring, sensing
        self.standing: tuple[Guard, ...] = (source, own_topic, measuring, self.track)
        self.track.watch(compensator.geometry)

    def take_parameters(self) -> None:
        """Take the parameters as they are now; others are looked up where they are needed."""
        self.command_stamps.max_age = self.options["max_command_age"]
        self.reading_stamps.max_age = self.options["max_reading_age"]
        self.track.limit = self.options["following_error_limit"]
        self.track.anywhere_after = self.options["start_without_feedback_after"]

    def look(self, now: float) -> None:
        """Look who publishes."""
        for sender in (self.source, self.own_topic, self.measuring, *self.sensing.values()):
            sender.look(now)

    def problem(self) -> Guard | None:
        """Return the guard that stops the machine at present, if any."""
        for guard in self.standing:
            if guard.problem:
                return guard
        return None

    def stops(self, now: float) -> bool:
        """Return whether an active node refuses commands: by a guard, for want of readings, or as of late."""
        return self.problem() is not None or self.refusals.recent(now) or self.track.waits(now)

    def fed(self, now: float) -> bool:
        """Return whether measured struts are fresh."""
        return self.feedback.age(now) <= float(self.options["feedback_timeout"])

    def advice(self) -> str:
        """Return what the sender of commands is to do: about what stops the machine, or else about the last refusal."""
        guard = self.problem()
        reason = guard.reason if guard is not None else self.refusals.last_reason
        return ADVICE.get(reason, OTHERWISE) if reason else ""

    def judged(self, now: float) -> tuple[bytes, str]:
        """Return level and message of an active node."""
        return joined((level, text) for level, shown in FINDINGS if (text := shown(self, now)))

    def values(self, now: float) -> dict[str, str]:
        """Return everything else as key and value."""
        values = {key: value(self, now) for key, value in VALUES.items()}
        values |= {f"{topic}_by": ", ".join(sender.names) for topic, sender in self.sensing.items()}
        temperatures, model = self.compensator.temperatures, self.compensator.model
        heard = dict(temperatures.values)
        if (humidity := heard.pop(HUMIDITY, None)) is not None:
            values["humidity_percent"] = f"{100.0 * humidity:.1f}"
        elif model.struts.moisture.any():
            values["humidity_percent"] = f"not known, taken as {100.0 * REFERENCE_HUMIDITY:g}"
        values.update({f"temperature.{name}_degC": f"{value:.2f}" for name, value in heard.items()})
        if (unknown := temperatures.unknown_for(model.late_growth, now)) > 0.0:
            values["late_parts"] = f"not known for another {unknown:.0f} s: the readings began too short ago"
        return {**values, **self.refusals.values()}

    # ---- what the tables below ask ----

    def refusing(self, now: float) -> str:
        """Return what stops the machine."""
        guard = self.problem()
        return f"refusing commands: {guard.reason}: {guard.problem}" if guard is not None else ""

    def refused(self, now: float) -> str:
        """Return why commands were refused of late, beside what stops the machine."""
        guard = self.problem()
        reasons = self.refusals.reasons(now, guard.reason if guard is not None else "")
        return f"refusing commands: {reasons}" if reasons else ""

    def disturbed(self, now: float) -> str:
        """Return why readings were not used of late."""
        senders = (self.measuring, *self.sensing.values())
        reasons = self.bad_feedback.reasons(now, next((sender.reason for sender in senders if sender.problem), ""))
        return f"bad feedback: {reasons}" if reasons else ""

    def disputed(self, now: float) -> str:
        """Return whose readings are not used because several send them."""
        several = ((topic, sender) for topic, sender in self.sensing.items() if sender.problem)
        return "; ".join(f"{topic} ignored: {sender.reason}: {sender.problem}" for topic, sender in several)

    def silent(self, now: float) -> bool:
        """Return whether commands have ended."""
        return bool(self.commands.count and 0.0 < self.options["command_timeout"] < self.commands.age(now))

    def stale(self, now: float) -> str:
        """Return the parts whose last temperature is too old."""
        return ", ".join(name for name in self.thermometers.stale(now) if name != HUMIDITY)

    def near_singular(self, now: float) -> bool:
        """Return whether the last pose was."""
        return bool(self.compensator.condition > NEAR_SINGULAR * self.compensator.geometry.limits.condition)

    def largest_correction(self) -> float:
        """Return it in m; before the first command nothing is corrected."""
        return 0.0 if self.fresh_start else float(np.abs(self.compensator.correction).max())

    def measured_box(self) -> str:
        """Return the region in which the model was measured."""
        region = self.compensator.model.measured
        return "not known" if region is None else region.text(self.compensator.geometry)


def _if(holds: Any, text: str) -> str:
    return text if holds else ""


# What there is to say of an active compensator, worst first: level, and the text, empty where there is nothing
FINDINGS: tuple[tuple[bytes, Callable[[CompensatorStatus, float], str]], ...] = (
    (ERROR, CompensatorStatus.refusing),
    (ERROR, CompensatorStatus.refused),
    (ERROR, CompensatorStatus.disturbed),
    (ERROR, CompensatorStatus.disputed),
    (WARN, lambda s, now: _if(s.failed_reloads.recent(now), "the old model stays")),
    (WARN, lambda s, now: _if(s.refused_resets.recent(now), "reset refused while the machine moves")),
    (WARN, lambda s, now: _if(s.refused_tools.recent(now), f"tool refused: {s.refused_tools.last_text}")),
    (WARN, lambda s, now: _if(s.silent(now), "no new command")),
    (
        WARN,
        lambda s, now: _if(s.feedback.count and not s.fed(now), "feedback lost, pose estimated from own commands"),
    ),
    (WARN, lambda s, now: _if(stale := s.stale(now), f"temperatures stale: {stale}")),
    (WARN, lambda s, now: _if(HUMIDITY in s.thermometers.stale(now), "humidity stale")),
    (WARN, lambda s, now: _if(s.source.missing(now) and not s.silent(now), "running, commands are being missed")),
    (WARN, lambda s, now: _if(s.behind.holds(now), "running, catching up with commands that came late")),
    (WARN, lambda s, now: s.prediction_problem),
    (WARN, lambda s, now: s.log_space.problem),
    (WARN, lambda s, now: _if(s.track.waits(now), "waiting for strut_states: where the struts stand is not known")),
    (OK, lambda s, now: _if(not s.commands.count, "waiting for the first command")),
    (WARN, lambda s, now: _if(s.near_singular(now), "running, near a singularity")),
    (
        WARN,
        lambda s, now: _if(s.compensator.outside_box, "running, outside the box in which the model was measured"),
    ),
    (OK, lambda s, now: _if(s.compensator.ramping, "running, a change is ramping in")),
    (OK, lambda s, now: "running" if s.fed(now) else "running, pose estimated from own commands"),
)

# What else it says: key and value
VALUES: dict[str, Callable[[CompensatorStatus, float], str]] = {
    "model": lambda s, now: s.compensator.model.name,
    "tool": lambda s, now: s.compensator.geometry.tool_name,
    "frame_id": lambda s, now: s.frame_id,
    "datum": lambda s, now: str(s.compensator.model.origin.datum or "not known"),
    "compensation": lambda s, now: "on" if s.compensator.enabled else "off",
    "ramping": lambda s, now: str(s.compensator.ramping).lower(),
    "pose_estimated_from": lambda s, now: "strut_states" if s.fed(now) else "own commands",
    "commanded_by": lambda s, now: ", ".join(s.source.names),
    "measured_by": lambda s, now: ", ".join(s.measuring.names),
    "stale_temperatures": lambda s, now: s.stale(now),
    "commands": lambda s, now: str(s.commands.count),
    "commands_missed": lambda s, now: str(s.source.missed),
    "commands_waited": lambda s, now: str(s.waited),
    "commands_dropped": lambda s, now: str(s.dropped),
    "command_rate_hz": lambda s, now: f"{s.commands.rate(now):.1f}",
    "command_age_s": lambda s, now: seconds(s.commands.age(now)),
    "feedback_rate_hz": lambda s, now: f"{s.feedback.rate(now):.1f}",
    "feedback_age_s": lambda s, now: seconds(s.feedback.age(now)),
    "clock_set_back": lambda s, now: str(s.clock.set_back),
    "clock_set_forward": lambda s, now: str(s.clock.set_forward),
    "senders_clock_set_back": lambda s, now: str(s.command_stamps.sender_set_back + s.reading_stamps.sender_set_back),
    "largest_correction_m": lambda s, now: f"{s.largest_correction():.9f}",
    "condition_number": lambda s, now: f"{s.compensator.condition:.3f}",
    "outside_field": lambda s, now: str(s.compensator.outside_field).lower(),
    "outside_box": lambda s, now: str(s.compensator.outside_box).lower(),
    "measured_box": lambda s, now: s.measured_box(),
    "last_refusal": lambda s, now: s.refusals.last_text,
    "what_to_do": lambda s, now: s.advice(),
    "last_answered": lambda s, now: f"{s.last_answered // 10**9}.{s.last_answered % 10**9:09d}",
    "last_bad_feedback": lambda s, now: s.bad_feedback.last_text,
    "bad_feedback": lambda s, now: str(s.bad_feedback.total),
    "failed_reloads": lambda s, now: str(s.failed_reloads.total),
    "last_failed_reload": lambda s, now: s.failed_reloads.last_text,
    "refused_resets": lambda s, now: str(s.refused_resets.total),
    "refused_tools": lambda s, now: str(s.refused_tools.total),
}
