"""What the compensator counts, and what it says of itself in diagnostics; doc/states.md has the whole table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from ..compensation.compensator import Compensator
from ..compensation.thermal import Thermometers
from ..machine.temperatures import HUMIDITY, REFERENCE_HUMIDITY
from .command_source import CommandSource, OwnTopic
from .following import Following, LastKnown, Standing
from .health import ERROR, OK, WARN, Flow, Refusals, joined, seconds
from .log_space import LogSpace
from .pacing import Pacing
from .stamps import StampClock, StampGate

NEAR_SINGULAR = 0.9
"""From this share of the largest allowed condition number on, diagnostics warn."""


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
"""What the sender of a refused command is to do, by reason."""

OTHERWISE = "mend what the refusal names, and go on from the last answered command (last_answered)"
"""The same for all other reasons: a limit, a frame, a message that cannot be read."""


class Guard(Protocol):
    """Something that stops the machine while it has a problem."""

    @property
    def reason(self) -> str:
        """Name under which refusals are counted."""

    @property
    def problem(self) -> str:
        """What is wrong, empty while all is well."""


class CompensatorStatus:
    """Counters of a compensator node, its guards, and the status made of them.

    Parameters
    ----------
    options : dict
        The node's parameters.
    clock : StampClock
        The node's.

    Attributes
    ----------
    commands, feedback : Flow
        Accepted commands and usable measured struts.
    refusals, bad_feedback, failed_reloads, refused_resets, refused_tools : Refusals
        What was refused.
    frame_id : str
        Of the last command; empty before the first.
    last_answered : int
        Stamp of the last answered command, ns; 0 before the first.
    prediction_problem : str
        Why no error is predicted though somebody listens; empty while all is well.
    source : CommandSource
        Who commands.
    own_topic : OwnTopic
        Who else publishes strut commands.
    measuring : CommandSource
        Who publishes measured struts.
    sensing : dict of str to CommandSource
        Who publishes temperatures, humidity and the choice of tool, by topic: a second one is not obeyed, and stops
        nothing.
    thermometers : Thermometers
        Which of them no longer tell.
    command_stamps, reading_stamps : StampGate
        Of the commands, and of the measured struts.
    following : Following
        Whether the struts go where they are told.
    standing : Standing
        Whether they stand.
    pacing : Pacing
        Commands that wait.
    last_known : LastKnown
        Where a start begins.
    log_space : LogSpace
        Whether the log can be written.
    """

    def __init__(self, options: dict[str, Any], clock: StampClock) -> None:
        self._options, self._clock = options, clock
        self.command_stamps, self.reading_stamps = StampGate("command", clock), StampGate("reading", clock, capped=True)
        self.commands, self.feedback = Flow(), Flow()
        self.refusals, self.bad_feedback = Refusals(), Refusals()
        self.failed_reloads, self.refused_resets, self.refused_tools = Refusals(), Refusals(), Refusals()
        self.frame_id = self.prediction_problem = ""
        self.last_answered = 0
        self.following = Following()
        self.standing = Standing(self.following.commands)
        self.last_known = LastKnown(average=self.standing.mean)
        self.log_space = LogSpace()
        self.take_parameters()

    def take_parameters(self) -> None:
        """Take the parameters as they are now; others are looked up where they are needed."""
        options = self._options
        self.command_stamps.max_age = options["max_command_age"]
        self.reading_stamps.max_age = options["max_reading_age"]
        self.following.limit = options["following_error_limit"]
        self.last_known.anywhere_after = options["start_without_feedback_after"]

    def answered(self, command: np.ndarray, frame_id: str, stamp: int, now: float) -> None:
        """Take notice of a strut command, m, stamped in ns, that answered a pose in a frame at a monotonic time, s."""
        self.last_answered = stamp
        self.following.note(command, now)
        self.commands.tick(now)
        self.frame_id = frame_id

    def advice(self) -> str:
        """Return what the sender of commands is to do: about what stops the machine, or else about the last refusal."""
        guard = self.problem()
        reason = guard.reason if guard is not None else self.refusals.last_reason
        return ADVICE.get(reason, OTHERWISE) if reason else ""

    def watch(self, source: CommandSource, own_topic: OwnTopic, pacing: Pacing) -> None:
        """Take the guards of the topics of a configured node, and what lets its commands wait."""
        self.source, self.own_topic, self.pacing = source, own_topic, pacing

    def watch_readings(
        self, measuring: CommandSource, sensing: dict[str, CommandSource], thermometers: Thermometers
    ) -> None:
        """Take the guards of the readings of a configured node."""
        self.measuring, self.sensing, self.thermometers = measuring, sensing, thermometers

    def look(self, now: float) -> None:
        """Look who publishes, at the monotonic time `now`, s."""
        topics: list[CommandSource | OwnTopic] = [self.source, self.own_topic, self.measuring, *self.sensing.values()]
        for topic in topics:
            topic.look(now)

    def problem(self) -> Guard | None:
        """Return the guard that stops the machine at present, if any."""
        guards: tuple[Guard, ...] = (self.source, self.own_topic, self.measuring, self.following)
        return next((guard for guard in guards if guard.problem), None)

    def stops(self, now: float) -> bool:
        """Return whether an active node refuses commands: by a guard, for want of readings, or as of late."""
        return self.problem() is not None or self.refusals.recent(now) or self.last_known.waits(now)

    def fed(self, now: float) -> bool:
        """Return whether measured struts are fresh."""
        return self.feedback.age(now) <= self._options["feedback_timeout"]

    def judged(self, compensator: Compensator, now: float) -> tuple[bytes, str]:
        """Return level and message of an active node."""
        return joined(self._findings(compensator, now))

    def _findings(self, compensator: Compensator, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield what there is to say, worst first."""
        guard = self.problem()
        if guard is not None:
            yield ERROR, f"refusing commands: {guard.reason}: {guard.problem}"
        if reasons := self.refusals.reasons(now, guard.reason if guard is not None else ""):
            yield ERROR, f"refusing commands: {reasons}"
        disputed = next((owner.reason for owner in (self.measuring, *self.sensing.values()) if owner.problem), "")
        if reasons := self.bad_feedback.reasons(now, disputed):
            yield ERROR, f"bad feedback: {reasons}"
        for topic, owner in self.sensing.items():
            if owner.problem:
                yield ERROR, f"{topic} ignored: {owner.reason}: {owner.problem}"
        if self.failed_reloads.recent(now):
            yield WARN, "the old model stays"
        if self.refused_resets.recent(now):
            yield WARN, "reset refused while the machine moves"
        if self.refused_tools.recent(now):
            yield WARN, f"tool refused: {self.refused_tools.last_text}"
        yield from self._lost(now)
        if self.prediction_problem:
            yield WARN, self.prediction_problem
        if self.log_space.problem:
            yield WARN, self.log_space.problem
        if self.last_known.waits(now):
            yield WARN, "waiting for strut_states: where the struts stand is not known"
        if not self.commands.count:
            yield OK, "waiting for the first command"
        if compensator.condition > NEAR_SINGULAR * compensator.geometry.limits.condition:
            yield WARN, "running, near a singularity"
        if compensator.outside_box:
            yield WARN, "running, outside the box in which the model was measured"
        if compensator.ramping:
            yield OK, "running, a change is ramping in"
        yield OK, "running" if self.fed(now) else "running, pose estimated from own commands"

    def _lost(self, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield what no longer comes."""
        silent = self.commands.count and 0.0 < self._options["command_timeout"] < self.commands.age(now)
        if silent:
            yield WARN, "no new command"
        if self.feedback.count and not self.fed(now):
            yield WARN, "feedback lost, pose estimated from own commands"
        if stale := ", ".join(self._stale_parts(now)):
            yield WARN, f"temperatures stale: {stale}"
        if HUMIDITY in self.thermometers.stale(now):
            yield WARN, "humidity stale"
        if self.source.sequence.missing(now) and not silent:
            yield WARN, "running, commands are being missed"
        if self.pacing.behind(now):
            yield WARN, "running, catching up with commands that came late"

    def _stale_parts(self, now: float) -> list[str]:
        return [name for name in self.thermometers.stale(now) if name != HUMIDITY]

    def values(self, compensator: Compensator, fresh_start: bool, now: float) -> dict[str, str]:
        """Return everything else as key and value; before the first command nothing is corrected."""
        correction = 0.0 if fresh_start else float(np.abs(compensator.correction).max())
        region = compensator.model.measured
        values = {
            "model": compensator.model.name,
            "tool": compensator.geometry.tool_name,
            "frame_id": self.frame_id,
            "datum": str(compensator.model.origin.datum or "not known"),
            "compensation": "on" if compensator.enabled else "off",
            "ramping": str(compensator.ramping).lower(),
            "pose_estimated_from": "strut_states" if self.fed(now) else "own commands",
            "commanded_by": ", ".join(self.source.names),
            "measured_by": ", ".join(self.measuring.names),
            **{f"{topic}_by": ", ".join(owner.names) for topic, owner in self.sensing.items()},
            "stale_temperatures": ", ".join(self._stale_parts(now)),
            **self._flows(now),
            "largest_correction_m": f"{correction:.9f}",
            "condition_number": f"{compensator.condition:.3f}",
            "outside_field": str(compensator.outside_field).lower(),
            "outside_box": str(compensator.outside_box).lower(),
            "measured_box": "not known" if region is None else region.text(compensator.geometry),
            "last_refusal": self.refusals.last_text,
            "what_to_do": self.advice(),
            "last_answered": f"{self.last_answered // 10**9}.{self.last_answered % 10**9:09d}",
            "last_bad_feedback": self.bad_feedback.last_text,
            "bad_feedback": str(sum(self.bad_feedback.counts.values())),
            "failed_reloads": str(sum(self.failed_reloads.counts.values())),
            "last_failed_reload": self.failed_reloads.last_text,
            "refused_resets": str(sum(self.refused_resets.counts.values())),
            "refused_tools": str(sum(self.refused_tools.counts.values())),
        }
        heard = dict(compensator.temperatures.values)
        if (humidity := heard.pop(HUMIDITY, None)) is not None:
            values["humidity_percent"] = f"{100.0 * humidity:.1f}"
        elif compensator.model.struts.moisture.any():
            values["humidity_percent"] = f"not known, taken as {100.0 * REFERENCE_HUMIDITY:g}"
        values.update({f"temperature.{k}_degC": f"{v:.2f}" for k, v in heard.items()})
        if (unknown := compensator.temperatures.unknown_for(compensator.model.late_growth, now)) > 0.0:
            values["late_parts"] = f"not known for another {unknown:.0f} s: the readings began too short ago"
        values.update(self.refusals.values())
        return values

    def _flows(self, now: float) -> dict[str, str]:
        return {
            "commands": str(self.commands.count),
            "commands_missed": str(self.source.sequence.missed),
            "commands_waited": str(self.pacing.waited),
            "commands_dropped": str(self.pacing.dropped),
            "command_rate_hz": f"{self.commands.rate(now):.1f}",
            "command_age_s": seconds(self.commands.age(now)),
            "feedback_rate_hz": f"{self.feedback.rate(now):.1f}",
            "feedback_age_s": seconds(self.feedback.age(now)),
            "clock_set_back": str(self._clock.set_back),
            "clock_set_forward": str(self._clock.set_forward),
            "senders_clock_set_back": str(self.command_stamps.sender_set_back + self.reading_stamps.sender_set_back),
        }
