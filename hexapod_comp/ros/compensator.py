"""The compensator node: receives tool pose commands, publishes compensated strut commands and pose estimates.

Run the node with ``ros2 run hexapod_comp compensator`` or ``python -m hexapod_comp.ros.compensator``.
"""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from contextlib import suppress
from functools import partial
from typing import Any

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_msgs.msg import Float64MultiArray

from ..compensation.compensator import Compensator, pack_pose
from ..compensation.guards import Sample
from ..errors import CommandError, HexapodError, LimitError, TooEarlyError
from ..machine.temperatures import HUMIDITY, check_part
from .base import ACKNOWLEDGED_WITHIN, COMMAND_QOS, NEWEST_QOS, seconds
from .compensator_state import ADVICE, OTHERWISE, PROGRAM, CompensatorState, temperature_rules
from .inputs import Loads, PoseInstrument, SensorTopic, command_input
from .messages import StrutBytes, StrutReader, check_frame, period
from .outputs import JournalTopics, Outputs
from .process import run
from .rclpy_compat import Alarm
from .requests import Requests

ESTIMATE_PERIOD = 0.02  # Period, s, at which poses are estimated from the node's own commands, without feedback
JITTER = 0.02  # Delay, s, up to which a waiting command or an alarm does not count as late


class CompensatorNode(CompensatorState):
    """Lifecycle node around one :class:`Compensator`; `options` are those of rclpy's nodes."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._logged_problem = ""
        self._unestimated = 0  # Stamp, ns, of a command whose pose has not been estimated yet; 0: none

    # ---- lifecycle ----

    def configure(self) -> None:
        began, options, files = time.perf_counter(), self.options, self.files
        geometry = files.geometry()
        compensator = Compensator(geometry, files.model(geometry), options["ramp_rate"])
        compensator.check()
        compensator.enable(options["enable_compensation"])
        compensator.set_tool(options["tool"])
        self.use_machine(compensator)
        self._frames = {self.frame_ids[name]: pack_pose(pose) for name, pose in geometry.work_frames.items()}
        self._open_topics()
        what = f"model {compensator.model.name!r}"
        what = "the ideal model, which corrects nothing (parameter model_file)" if files.ideal else what
        took = time.perf_counter() - began
        self.get_logger().info(f"configured machine {geometry.name!r} with {what} in {took:.2f} s")

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to answer commands; commands that waited since before the activation are dropped."""
        self._forget_commands()
        self.track.begin(time.monotonic())
        return super().on_activate(state)

    def unconfigure(self) -> None:
        self._journal.finish(time.monotonic())
        self._forget_commands()
        self._requests.close()
        self._pacing.close()
        self.instrument = None

    def check_parameters(self, values: dict[str, Any]) -> None:
        if self.configured and "tool" in values:
            self._requests.tools.check(values["tool"])

    def on_parameters(self, names: set[str]) -> None:
        """Apply the parameters that are not read each time they are used."""
        self.apply_parameters()
        if self.configured:
            self.thermometers.follow(*temperature_rules(self.options))
            self.compensator.set_ramp_rate(self.options["ramp_rate"])
            self.loads.apply()
            self._requests.tools.apply()
            if self.instrument is not None:
                self.instrument.apply_parameters()

    def publish_last_status(self) -> None:
        super().publish_last_status()
        if self.configured:
            self._journal.finish(time.monotonic())
            self._commands.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
            self._outputs.wait()

    def _open_topics(self) -> None:
        options, names = self.options, self.options["joint_names"]
        deadline, several = options["command_timeout"], options["allow_several_publishers"]
        self._commands = self.publish_on(JointState, "strut_commands", COMMAND_QOS, deadline)
        self._corrections = self.publish_on(JointState, "strut_corrections", COMMAND_QOS, deadline)
        self._command_out, self._correction_out = StrutBytes(names=names), StrutBytes(names=names)
        self._fastest = self.compensator.geometry.limits.speed
        self._array, self._array_out = None, Float64MultiArray()
        if options["publish_array"]:
            self._array = self.publish_on(Float64MultiArray, "strut_commands_array", COMMAND_QOS, deadline)
        self._outputs, self._reader, self._input = Outputs(self), StrutReader(names), command_input(self)
        self.command_sender = self.subscribe_exclusive(self._input.kind, self._input.topic, self._on_command, several)
        self.own_sender = self.sole_publisher(self._commands, several)
        self.strut_sender = self.subscribe_exclusive(JointState, "strut_states", self._on_states, several, NEWEST_QOS)
        any_thermometer = "allow_several_thermometers"
        SensorTopic(self, "temperatures", Temperature, self._on_temperature, several=any_thermometer)
        SensorTopic(self, HUMIDITY, RelativeHumidity, self._on_humidity, several=any_thermometer)
        self._pacing = Pacing(self)
        self._requests = Requests(self, self._forget_commands)
        self._journal = JournalTopics(self)
        self.loads = Loads(self)
        senders = self.command_sender, self.own_sender, self.strut_sender
        self.command_guards = *senders, self.track, self.loads.guard, self.command_stamps
        if options["fusion.enabled"]:
            self.instrument = PoseInstrument(self)
        self.every(ESTIMATE_PERIOD, self._estimate_from_commands)

    # ---- a command ----

    def _on_command(self, data: bytes, sample: Sample) -> None:
        if self._active:
            self._pacing.receive(data, sample)

    def _process_command(self, data: bytes, sample: Sample) -> float:
        """Answer or refuse a command and return 0; or return how long, s, the speed limit makes the command wait."""
        now, compensator = sample.now, self.compensator
        try:
            self._input.read(data, sample)
            if sample.values is None:
                return 0.0
            check_frame(sample.frame_id, self._frames)
            for guard in self.command_guards:
                guard.check(sample)
            if self.fresh_start or self.options["require_feedback"]:
                self._begin_at_struts(now)
            stamp = sample.stamp
            made = stamp * 1e-9 if stamp else math.nan
            compensator.step(sample.values, made, self._frames[sample.frame_id], now)
        except TooEarlyError as error:
            return error.wait
        except HexapodError as error:
            self._refuse(sample.stamp, error, now)
            return 0.0
        when, outputs = stamp or self.get_clock().now().nanoseconds, self._outputs  # a zero stamp means now
        speed_over, outputs.answered = period(outputs.answered, when), when
        self._commands.publish(self._command_out.encoded(compensator.command_at, when, speed_over, self._fastest))
        if self._corrections.get_subscription_count():  # publishing takes longer than the computation
            self._corrections.publish(self._correction_out.encoded(compensator.correction_at, when))
        if self._array is not None:
            self._array_out.data = compensator.command.tolist()
            self._array.publish(self._array_out)
        compensator.published(out := time.monotonic())
        self._journal.answered(when, sample.frame_id, sample.values, (now, out), bool(stamp))
        for guard in self.command_guards:
            guard.accept(sample)
        self.track.add_command(compensator.command.tolist(), now)
        self.commands.tick(now)
        self.fresh_start, self.last_answered, self.frame_id = False, when, sample.frame_id
        self._unestimated = when
        return 0.0

    def _begin_at_struts(self, now: float) -> None:
        """Let the first command start at the struts' known positions; refuse any command without required readings."""
        has_feedback = self.has_feedback(now)
        if self.options["require_feedback"] and not has_feedback:
            since = f"for {seconds(self.feedback.age(now))} s" if self.feedback.count else "yet"
            raise CommandError("no_feedback", f"no strut_states {since}")
        if self.fresh_start:
            self.compensator.reset(self.track.start(now, has_feedback))

    def _refuse(self, stamp: int, error: HexapodError, now: float) -> None:
        self._journal.refused(stamp, error.reason, str(error))
        self.refusals.add(error.reason, str(error), now)
        self._outputs.stop(True)
        self.log_warning(
            error.reason, f"command refused ({error.reason}): {error}; {ADVICE.get(error.reason, OTHERWISE)}"
        )

    # ---- a reading ----

    def _on_states(self, data: bytes, sample: Sample) -> None:
        """Check and store measured struts, also before the activation; while active, publish pose estimates."""
        now, track, instrument = sample.now, self.track, self.instrument
        try:
            self.strut_sender.check(sample)
            self._reader.sample(data, sample)
            self.reading_stamps.check(sample)
            struts = sample.values or ()
            track.check_stroke(struts)
            # before check_jump: a single reading far from the commands must stop the machine, whether a strut or an
            # encoder fails
            if self._active and track.follow(struts, now - sample.age):
                self.bad_feedback.add(track.reason, track.problem, now)
            track.check_jump(sample)
            pose = self.compensator.estimate(struts)
            track.add_reading(sample)
            self.reading_stamps.accept(sample)
            self.feedback.tick(now)
            if self._active:
                self._outputs.estimate(pose, sample.stamp)
                self._outputs.nominal(sample.stamp, track.mean)
                if instrument is not None:  # must be last, since add_struts may overwrite `pose`
                    instrument.add_struts(struts, now - sample.age)
        except HexapodError as error:
            self.ignore("strut_states", error, self.bad_feedback)

    def _on_temperature(self, message: Temperature, now: float) -> None:
        check_part(name := message.header.frame_id)
        self.compensator.set_temperature(name, self.thermometers.update(name, message.temperature, now), now)

    def _on_humidity(self, message: RelativeHumidity, now: float) -> None:
        self.compensator.set_humidity(self.thermometers.update(HUMIDITY, message.relative_humidity, now), now)

    def _estimate_from_commands(self) -> None:
        """While no measured struts arrive, publish a pose estimate from the newest command."""
        stamp, self._unestimated, now = self._unestimated, 0, time.monotonic()
        instrument = self.instrument if self.commands.count else None
        if not (stamp or instrument) or not self._active or self.has_feedback(now):
            return
        try:
            if stamp:
                self._outputs.estimate(self.compensator.estimate(self.compensator.command), stamp)
            if instrument is not None:
                instrument.add_struts(self.compensator.command.tolist(), now)
        except HexapodError as error:
            self.ignore("estimate from commands", error, self.bad_feedback)

    # ---- state ----

    def _forget_commands(self) -> None:
        """Forget the last command and waiting commands; `track` keeps the struts' last known positions."""
        self.compensator.reset()
        if self.instrument is not None:
            self.instrument.reset()
        for guard in self.command_guards:
            guard.reset()
        self._pacing.reset()
        self._unestimated = 0
        self._outputs.answered = 0  # so that the next strut command has zero velocities
        self.fresh_start = True

    def update(self, now: float) -> None:
        super().update(now)
        if self._active:
            self.loads.update(now)
        guard = self.acting_guard()
        problem = guard.problem if guard is not None and self._active else ""
        if problem and problem != self._logged_problem:
            self.get_logger().error(f"refusing commands: {problem}")
        self._logged_problem = problem
        self._requests.update(now)
        if self.instrument is not None:
            self.instrument.update(now)
        self._journal.tick(now)
        self._outputs.stop(not self._active or self.refuses_commands(now))


class Pacing:
    """Queue of commands that arrive faster than the struts may move, because a network or a pause has bunched them.

    If a command has waited for more than ``catch_up_within`` seconds, all waiting commands are refused; this wait does
    not include time in which the system did not run this process. If ``catch_up_within`` is 0, only the newest command
    waits.
    """

    def __init__(self, node: CompensatorNode) -> None:
        self._node = node
        self.waiting: deque[tuple[float, bytes]] = deque()
        self._due = 0.0  # monotonic time of the next call, s
        self._unscheduled = 0.0  # total time, s, in which this process should have run, but the system did not run it
        self._alarm = Alarm(node, node.guard.around("process_next", self._process_next))

    @property
    def _longest(self) -> float:
        return float(self._node.options["catch_up_within"])

    def receive(self, message: bytes, sample: Sample) -> None:
        """Answer a command or queue it; before queueing, refuse all commands of a full queue, or drop the waiting
        command if ``catch_up_within`` is 0."""
        node, now = self._node, sample.now
        if not self.waiting:
            if (wait := node._process_command(message, sample)) <= 0.0:
                return
            self._wait_for_struts(now, wait)
        elif not self._longest:
            node.dropped += len(self.waiting)
            self.waiting.clear()
            node.late_commands.note(now)
        elif len(self.waiting) == COMMAND_QOS.depth:
            self._refuse_all(now)
        # time of arrival, s, by a clock that stops while the system does not run this process
        self.waiting.append((now - self._unscheduled, message))
        node.waited += 1

    def reset(self) -> None:
        self.waiting.clear()

    def close(self) -> None:
        self.reset()
        self._alarm.close()

    def _wait_for_struts(self, now: float, wait: float) -> None:
        self._due = now + wait
        self._alarm.set(wait)

    def _age(self, came: float, now: float) -> float:
        return now - self._unscheduled - came

    def _process_next(self) -> None:
        """Answer the waiting commands that the struts' speed limit allows by now."""
        if (late := time.monotonic() - self._due) > JITTER:
            self._unscheduled += late
        if not self._node.active:
            self.waiting.clear()
        while self.waiting:
            now = time.monotonic()
            came, message = self.waiting[0]
            if 0.0 < self._longest < self._age(came, now):
                self._refuse_all(now)
                return
            if (wait := self._node._process_command(message, Sample(now))) > 0.0:
                self._wait_for_struts(now, wait)
                return
            if self._age(came, now) > JITTER:
                self._node.late_commands.note(now)
            if self.waiting:  # a reset while the command was processed would have cleared the queue
                self.waiting.popleft()

    def _refuse_all(self, now: float) -> None:
        waited = self._age(self.waiting[0][0], now)
        times = f"the oldest waited {waited:.3f} s, allowed {self._longest:g} s"
        text = f"commands arrive faster than the struts may move: {times}"
        while self.waiting:
            sample = Sample(now)
            with suppress(HexapodError):  # a command that cannot be read may have no stamp
                self._node._input.read(self.waiting.popleft()[1], sample)
            error = LimitError("speed", text, waited, self._longest, None, "compensated")
            self._node._refuse(sample.stamp, error, now)


main = partial(run, CompensatorNode, PROGRAM)

if __name__ == "__main__":
    sys.exit(main())
