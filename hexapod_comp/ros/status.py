"""Counters of a node, and its diagnostics: a table of findings and one of values.

doc/states.md has every case.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.logging import get_logging_directory

from ..compensation.compensator import Compensator
from ..compensation.fusion import Fusion
from ..compensation.guards import EventWindow, Guard, OneSender, StampClock, StampGate
from ..compensation.thermal import Thermometers
from ..compensation.track import StrutTrack
from ..errors import LONGEST_TEXT, printable
from ..machine.temperatures import HUMIDITY, REFERENCE_HUMIDITY

if TYPE_CHECKING:
    from .sensors import Loads

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

LEAST_ROOM = 65_536  # A file system with less free space, byte, is full: a few hundred lines of log
NEAR_SINGULAR = 0.9  # Share of the largest allowed condition number above which diagnostics warn


def status_prefix(namespace: str, node: str) -> str:
    return f"{namespace.strip('/')}/{node}:".lstrip("/")


def status_of(
    name: str, hardware_id: str, level: bytes, text: str, values: Mapping[str, str], longest: int = LONGEST_TEXT
) -> DiagnosticStatus:
    status = DiagnosticStatus(level=level, name=printable(name), hardware_id=printable(hardware_id))
    status.message = printable(text, longest)
    status.values = [KeyValue(key=key, value=printable(value, longest)) for key, value in values.items()]
    return status


def joined(findings: Iterable[tuple[bytes, str]]) -> tuple[bytes, str]:
    """Return level and text of all findings that are not OK, worst first; of the first when all are OK."""
    listed = list(findings)
    bad = [finding for finding in listed if finding[0] != OK] or listed[:1]
    return bad[0][0], "; ".join(text for _, text in bad)


def seconds(value: float) -> str:
    """Return an age as text: ``never`` when it is infinite."""
    return "never" if value == math.inf else f"{value:.3f}"


class Flow:
    """Counts events; returns their rate and the age of the last one."""

    def __init__(self) -> None:
        self.count, self.last = 0, -math.inf
        self._since, self._before, self._rate = time.monotonic(), 0, 0.0

    def tick(self, now: float) -> None:
        self.count += 1
        self.last = now

    def age(self, now: float) -> float:
        return now - self.last

    def rate(self, now: float) -> float:
        if (span := now - self._since) >= 1.0:
            self._rate = (self.count - self._before) / span
            self._since, self._before = now, self.count
        return self._rate


class Refusals:
    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._lately: dict[str, EventWindow] = {}
        self.last_reason = self.last_text = ""

    @property
    def total(self) -> int:
        return sum(self.counts.values())

    def add(self, reason: str, text: str, now: float) -> None:
        self.counts[reason] += 1
        self._lately.setdefault(reason, EventWindow()).note(now)
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
        counts = {f"refused.{reason}": str(count) for reason, count in sorted(self.counts.items())}
        return {"refused": str(self.total), **counts}


def log_problem(folder: str = "") -> str:
    """Return why ROS's log cannot be written, empty if it can: only the nodes can report that nothing is written any
    more. Takes a few microseconds on a local file system."""
    folder = folder or str(get_logging_directory())
    try:
        usage = os.statvfs(folder)
    except FileNotFoundError:
        return ""  # nothing is logged to files
    except OSError as error:
        return f"log folder lost: {error.strerror}"
    return f"log disk full: {folder}" if usage.f_bavail * usage.f_frsize < LEAST_ROOM else ""


# ---- the compensator's ----


# What the sender of a refused command should do, by reason
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

# The same for all other reasons: a limit, a frame, an invalid message
OTHERWISE = "mend what the refusal names, and go on from the last answered command (last_answered)"


class CompensatorStatus:
    """Counters and guards of a compensator node, which outlive its configurations, and the status made of them."""

    def __init__(self, options: dict[str, Any], clock: StampClock) -> None:
        self.options, self.clock = options, clock
        self.command_stamps, self.reading_stamps = StampGate("command", clock), StampGate("reading", clock, capped=True)
        self.pose_stamps = StampGate("measured pose", clock, capped=True)
        self.track = StrutTrack()
        # Senders of sensor readings and of the tool's choice: a second one is ignored, and stops nothing
        self.sensing: dict[str, OneSender] = {}
        self.commands, self.feedback = Flow(), Flow()  # accepted commands, usable measured struts
        self.refusals, self.bad_feedback, self.bad_poses = Refusals(), Refusals(), Refusals()
        self.failed_reloads, self.refused_resets, self.refused_tools = Refusals(), Refusals(), Refusals()
        self.waited = self.dropped = 0  # number of commands that have waited, and that a newer one has replaced
        self.behind = EventWindow()  # commands were handled late, by more than jitter
        self.frame_id = ""  # of the last command
        self.last_answered = 0  # stamp, ns; 0 before the first
        self.fresh_start = True  # no command is in force
        self.apply_parameters()

    def configure(
        self,
        compensator: Compensator,
        thermometers: Thermometers,
        frame_ids: dict[str, str],
        source: OneSender,
        own_topic: OneSender,
        measuring: OneSender,
    ) -> None:
        """Apply a configuration: the machine, its frames by the machine's names, and the guards of commanders, of other
        publishers of strut commands, and of readings."""
        self.compensator, self.thermometers, self.frame_ids = compensator, thermometers, frame_ids
        self.source, self.own_topic, self.measuring = source, own_topic, measuring
        self.sensing.clear()
        self.loads: Loads | None = None
        self.fusion: Fusion | None = None
        self.prediction_problem = self.drift_problem = ""  # why no error is predicted, and no drift compensated
        self.standing: tuple[Guard, ...] = (source, own_topic, measuring, self.track)
        self.track.watch(compensator.geometry)

    def apply_parameters(self) -> None:
        """Apply the parameters as they are now; others are read where they are used."""
        self.command_stamps.max_age = self.options["max_command_age"]
        self.reading_stamps.max_age = self.pose_stamps.max_age = self.options["max_reading_age"]
        self.track.limit = self.options["following_error_limit"]
        self.track.anywhere_after = self.options["start_without_feedback_after"]

    def update(self, now: float) -> None:
        for sender in (self.source, self.own_topic, self.measuring, *self.sensing.values()):
            sender.update(now)

    def problem(self) -> Guard | None:
        return next((guard for guard in self.standing if guard.problem), None)

    def stops(self, now: float) -> bool:
        """Return whether an active node refuses commands: by a guard, without readings, or recently."""
        return self.problem() is not None or self.refusals.recent(now) or self.track.waits(now)

    def fed(self, now: float) -> bool:
        return self.feedback.age(now) <= float(self.options["feedback_timeout"])

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        compensator, guard, fed = self.compensator, self.problem(), self.fed(now)
        if guard is not None:
            yield ERROR, f"refusing commands: {guard.reason}: {guard.problem}"
        if reasons := self.refusals.reasons(now, guard.reason if guard is not None else ""):
            yield ERROR, f"refusing commands: {reasons}"
        disputed = [(topic, sender) for topic, sender in self.sensing.items() if sender.problem]
        senders = (self.measuring, *(sender for _, sender in disputed))
        said = next((sender.reason for sender in senders if sender.problem), "")
        if reasons := self.bad_feedback.reasons(now, said):
            yield ERROR, f"bad feedback: {reasons}"
        for topic, sender in disputed:
            yield ERROR, f"{topic} ignored: {sender.reason}: {sender.problem}"
        if reasons := self.bad_poses.reasons(now):
            yield WARN, f"measured poses rejected: {reasons}"
        if self.failed_reloads.recent(now):
            yield WARN, "the old model stays"
        if self.refused_resets.recent(now):
            yield WARN, "reset refused while the machine moves"
        if self.refused_tools.recent(now):
            yield WARN, f"tool refused: {self.refused_tools.last_text}"
        silent = bool(self.commands.count) and 0.0 < self.options["command_timeout"] < self.commands.age(now)
        if silent:
            yield WARN, "no new command"
        if self.feedback.count and not fed:
            yield WARN, "feedback lost, pose estimated from own commands"
        if stale := self.stale(now):
            yield WARN, f"temperatures stale: {stale}"
        if HUMIDITY in self.thermometers.stale(now):
            yield WARN, "humidity stale"
        if self.loads is not None and (stale := self.loads.stale(now)):
            yield WARN, f"{stale} stale"
        if self.source.missing(now) and not silent:
            yield WARN, "running, commands are being missed"
        if self.behind.holds(now):
            yield WARN, "running, catching up with commands that came late"
        held = self.fusion.held if self.fusion is not None else ""
        for problem in filter(None, (self.prediction_problem, self.drift_problem, held)):
            yield WARN, problem
        if self.fusion is not None and 0.0 < self.options["fusion.timeout"] < now - self.fusion.last:
            yield WARN, "no measured pose counts" if self.fusion.count else "waiting for the first measured pose"
        if self.track.waits(now):
            yield WARN, "waiting for strut_states: where the struts stand is not known"
        if not self.commands.count:
            yield OK, "waiting for the first command"
        if compensator.condition > NEAR_SINGULAR * compensator.geometry.limits.condition:
            yield WARN, "running, near a singularity"
        if compensator.outside_box:
            yield WARN, "running, outside the box in which the model was measured"
        if self.loads is not None:
            yield from ((WARN, text) for text in self.loads.findings())
        if beyond := compensator.outside_load:
            yield WARN, f"running, under another load than the model was measured with: {beyond}"
        if compensator.ramping:
            yield OK, "running, a change is ramping in"
        yield OK, "running" if fed else "running, pose estimated from own commands"

    def values(self, now: float) -> dict[str, str]:
        compensator, guard, fed = self.compensator, self.problem(), self.fed(now)
        model, temperatures, region = compensator.model, compensator.temperatures, compensator.model.measured
        reason = guard.reason if guard is not None else self.refusals.last_reason
        set_back = self.command_stamps.sender_set_back + self.reading_stamps.sender_set_back
        largest = 0.0 if self.fresh_start else float(np.abs(compensator.correction).max())
        values = {
            "model": model.name,
            "tool": compensator.geometry.tool_name,
            "frame_id": self.frame_id,
            "datum": str(model.origin.datum or "not known"),
            "compensation": "on" if compensator.enabled else "off",
            "ramping": str(compensator.ramping).lower(),
            "pose_estimated_from": "strut_states" if fed else "own commands",
            "commanded_by": ", ".join(self.source.names),
            "measured_by": ", ".join(self.measuring.names),
            "stale_temperatures": self.stale(now),
            "commands": str(self.commands.count),
            "commands_missed": str(self.source.missed),
            "commands_waited": str(self.waited),
            "commands_dropped": str(self.dropped),
            "command_rate_hz": f"{self.commands.rate(now):.1f}",
            "command_age_s": seconds(self.commands.age(now)),
            "feedback_rate_hz": f"{self.feedback.rate(now):.1f}",
            "feedback_age_s": seconds(self.feedback.age(now)),
            "clock_set_back": str(self.clock.set_back),
            "clock_set_forward": str(self.clock.set_forward),
            "senders_clock_set_back": str(set_back),
            "largest_correction_m": f"{largest:.9f}",
            "condition_number": f"{compensator.condition:.3f}",
            "outside_field": str(compensator.outside_field).lower(),
            "outside_box": str(compensator.outside_box).lower(),
            "measured_box": "not known" if region is None else region.text(compensator.geometry),
            "last_refusal": self.refusals.last_text,
            "what_to_do": ADVICE.get(reason, OTHERWISE) if reason else "",
            "last_answered": f"{self.last_answered // 10**9}.{self.last_answered % 10**9:09d}",
            "last_bad_feedback": self.bad_feedback.last_text,
            "bad_feedback": str(self.bad_feedback.total),
            "failed_reloads": str(self.failed_reloads.total),
            "last_failed_reload": self.failed_reloads.last_text,
            "refused_resets": str(self.refused_resets.total),
            "refused_tools": str(self.refused_tools.total),
        }
        values |= {f"{topic}_by": ", ".join(sender.names) for topic, sender in self.sensing.items()}
        known = dict(temperatures.values)
        if (humidity := known.pop(HUMIDITY, None)) is not None:
            values["humidity_percent"] = f"{100.0 * humidity:.1f}"
        elif model.struts.moisture.any():
            values["humidity_percent"] = f"not known, taken as {100.0 * REFERENCE_HUMIDITY:g}"
        values |= {f"temperature.{name}_degC": f"{value:.2f}" for name, value in known.items()}
        if self.loads is not None:
            values |= self.loads.values()
        values |= self._drift(now)
        if (unknown := temperatures.unknown_for(model.late_growth, now)) > 0.0:
            values["late_parts"] = f"not known for another {unknown:.0f} s: the readings began too short ago"
        return {**values, **self.refusals.values()}

    def _drift(self, now: float) -> dict[str, str]:
        if (fusion := self.fusion) is None:
            return {}

        def micro(values: np.ndarray) -> str:
            return ", ".join(f"{1e6 * value:.2f}" for value in values)

        return {
            "fusion": "compensating" if self.options["fusion.compensate"] else "estimating",
            "measured_poses": str(fusion.count),
            "measured_pose_age_s": seconds(now - fusion.last),
            "rejected_poses": str(self.bad_poses.total),
            "last_rejected_pose": self.bad_poses.last_text,
            "innovation_chi_square": f"{fusion.filter.chi_square:.2f}",
            "drift_um": micro(fusion.drift[:3]),
            "drift_turn_urad": micro(fusion.turn),
            "drift_struts_um": micro(fusion.drift[6:]),
            "drift_deviation_um": micro(np.sqrt(np.diagonal(fusion.filter.covariance))),
            "drift_compensated_um": micro(self.compensator.drift),
        }

    def stale(self, now: float) -> str:
        return ", ".join(name for name in self.thermometers.stale(now) if name != HUMIDITY)
