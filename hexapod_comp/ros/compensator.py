"""The compensator node: tool pose commands in, compensated strut commands and pose estimates out.

It holds no mathematics: it converts, calls :class:`~hexapod_comp.compensation.compensator.Compensator`, publishes, and
reports what it refused. Run it with ``ros2 run hexapod_comp compensator`` or
``python -m hexapod_comp.ros.compensator``; doc/nodes.md lists topics, services and parameters.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from ..compensation.compensator import Compensator
from ..compensation.journal import time_of
from ..compensation.state import pack_pose
from ..errors import CommandError, HexapodError, TooEarlyError, shorten
from .command_inputs import command_input
from .command_source import CommandSource, OwnTopic
from .compensator_outputs import CompensatorOutputs
from .compensator_parameters import PARAMETERS, PROGRAM
from .compensator_status import ADVICE, OTHERWISE, CompensatorStatus
from .feedback import Feedback
from .health import WARN, seconds
from .journal import JournalTopics
from .machine_files import MachineFiles
from .operating import OperatorServices
from .pacing import Pacing
from .reloading import ReloadService
from .running import keep_discovery_local, run
from .runtime import ACKNOWLEDGED_WITHIN, MachineNode
from .stamps import stamp_of
from .tools import ToolChoice, frame_ids
from .travel import TravelReports

CHECK_PERIOD = 0.05
"""How often the node looks whether its state has changed, s."""

ESTIMATE_PERIOD = 0.02
"""How often the pose is estimated from the node's own commands while there is no feedback, s."""


class CompensatorNode(MachineNode):
    """Lifecycle node around one :class:`Compensator`; arguments are those of ``rclpy`` nodes."""

    def __init__(self, **options: Any) -> None:
        super().__init__("compensator", PARAMETERS, **options)
        self._files = MachineFiles(self._options)
        self._status = status = CompensatorStatus(self._options, self.clock)
        self._stamps = status.command_stamps
        self._commands, self._following, self._last_known = status.commands, status.following, status.last_known
        self._fresh_start = self._looks_closer = True
        self._logged_problem = ""
        self._unestimated: int | None = None
        self._compensator: Compensator | None = None

    @property
    def compensator(self) -> Compensator:
        """The compensator of a configured node."""
        if self._compensator is None:
            raise CommandError("not_configured", "the node is not configured")
        return self._compensator

    # ---- lifecycle ----

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load geometry and model, open topics."""
        began = time.perf_counter()
        try:
            geometry = self._files.geometry()
            self._compensator = Compensator(geometry, self._files.model(geometry), self._options["ramp_rate"])
            self._compensator.check()
            self._compensator.enable(self._options["enable_compensation"])
            self._compensator.set_tool(self._options["tool"])
            ids = frame_ids(geometry, self._options)
            self._status.take_parameters()
        except HexapodError as error:
            self._compensator = None
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._frames = {ids[name]: pack_pose(pose) for name, pose in geometry.work_frames.items()}
        try:
            with self.all_or_nothing():
                self._open_topics(ids)
                self._journal = JournalTopics(self, self.compensator, self._files.sources, self._options, ids)
        except Exception:
            self._compensator = None  # else the end would say goodbye on topics that there are not
            raise
        what = f"{geometry.name!r} with {self._files.described(self.compensator.model)}"
        self.get_logger().info(f"configured machine {what} in {time.perf_counter() - began:.2f} s")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to take commands; of those that came before none is replayed."""
        self._forget()
        self._last_known.begin(time.monotonic())
        self._active = True
        self.get_logger().info("ready")
        return super().on_activate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close topics and forget the machine."""
        self._active = False
        self._journal.close(time.monotonic())
        self._forget()
        self._close_topics()
        self._compensator = None
        return super().on_cleanup(state)

    def on_parameters(self, names: set[str]) -> None:
        """Take what has been set while the node runs; the rest is looked up where it is needed."""
        self._status.take_parameters()
        if self._compensator is not None:
            self._feedback.take_parameters()
            self._compensator.set_ramp_rate(self._options["ramp_rate"])
            self._look_closer()

    def say_goodbye(self) -> None:
        """Publish a last status and wait until it has arrived."""
        if self._compensator is None:
            return
        self._active = False
        self._check_state()
        self._journal.close(time.monotonic())
        self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
        self._outputs.wait()

    def _open_topics(self, ids: dict[str, str]) -> None:
        self.speak_for(self.compensator.geometry.name)
        self._outputs = outputs = CompensatorOutputs(self, self.compensator, self._options, self._files)
        inputs = (self.compensator, self._status, self._options)
        self._feedback = Feedback(self, *inputs, outputs.measured, self._look_at_publishers)
        self._input = asked = command_input(self.compensator, self._options)
        self._subscription = commands = self.obey(asked.kind, asked.topic, self._on_command, self._look_at_publishers)
        allowed = self._options["allow_several_publishers"]
        self._pacing = Pacing(self, self._options, self._take, self._refuse_waiting)
        self._status.watch(
            CommandSource(self, commands.topic_name, commands.get_publisher_count, allowed),
            OwnTopic(self, outputs.command_topic, allowed),
            self._pacing,
        )
        self._hear = self._status.source.hear
        self._reload = ReloadService(self, self._files, self.compensator, self._status.failed_reloads)
        self._operator = OperatorServices(self, self.compensator, self._status, self._forget)
        self._tools = ToolChoice(self, self.compensator, self._status)
        self._travel = TravelReports(self, self.compensator, self._status, ids)
        self._timers_open = [
            self.every(CHECK_PERIOD, self._check_state),
            self.every(ESTIMATE_PERIOD, self._estimate_from_commands),
        ]
        self._marking = self.at_rate("marker_rate", self._publish_markers)

    def _close_topics(self) -> None:
        for timer in self._timers_open:
            self.destroy_timer(timer)
        self._marking.close()
        self.destroy_subscription(self._subscription)
        services = self._reload, self._operator, self._tools, self._travel
        for part in (*services, self._pacing, self._feedback, self._outputs):
            part.close()
        for publisher in self._journal.publishers:
            self.destroy_publisher(publisher)

    # ---- messages in ----

    def _on_command(self, data: bytes, number: int | None) -> None:
        if not self._active:
            return
        now = time.monotonic()
        if self._hear(number, now):
            self._look_closer()
        self._pacing.command(data, now)

    def _take(self, data: bytes, now: float) -> float:
        """Answer or refuse a command at the monotonic time `now`, s; return how long it must wait instead, s."""
        stamp = 0
        try:
            stamp, frame_id, numbers = self._input.read(data)
            if numbers is None:
                return 0.0
            frame = self._frames.get(frame_id)
            if frame is None or self._looks_closer:
                self._examine(frame_id, now)
            self._stamps.check(stamp, now)
            when = stamp or self.get_clock().now().nanoseconds  # zero means now
            self.compensator.step(numbers, time_of(stamp, bool(stamp)), frame, now)
        except TooEarlyError as error:
            return error.wait
        except HexapodError as error:
            self._refuse(stamp, error, now)
            return 0.0
        self._outputs.command(when)
        self.compensator.published(out := time.monotonic())
        self._journal.answered(when, frame_id, numbers, (now, out), bool(stamp))
        if self._fresh_start:
            self._fresh_start = False
            self._look_closer()
        self._stamps.accept(stamp, now)
        self._status.answered(self.compensator.command, frame_id, when, now)
        self._unestimated = when
        return 0.0

    def _examine(self, frame_id: str, now: float) -> None:
        """Refuse an unknown frame, while a guard has a problem, or missing feedback; start from what there is."""
        if frame_id not in self._frames:
            allowed = ", ".join(self._frames)
            raise CommandError("frame_id", f"frame_id must be one of {allowed}, not {shorten(frame_id)}")
        guard = self._status.problem()
        if guard is not None:
            raise CommandError(guard.reason, guard.problem)
        fed = self._status.fed(now)
        if self._options["require_feedback"] and not fed:
            feedback = self._status.feedback
            since = f"for {seconds(feedback.age(now))} s" if feedback.count else "yet"
            raise CommandError("no_feedback", f"no strut_states {since}")
        if self._fresh_start:
            self.compensator.reset(self._last_known.struts(now, fed))

    def _look_closer(self) -> None:
        """Find out whether the next commands must be examined."""
        required = self._fresh_start or self._options["require_feedback"]
        self._looks_closer = required or self._status.problem() is not None

    def _look_at_publishers(self) -> None:
        """Look who publishes what only one may: now and then, and when somebody comes or goes."""
        self._status.look(time.monotonic())
        self._look_closer()

    # ---- messages out ----

    def _estimate_from_commands(self) -> None:
        """Without feedback, estimate the pose from the newest command, at a rate that leaves the loop alone."""
        stamp, self._unestimated = self._unestimated, None
        if stamp is None or not self._active or self._status.fed(time.monotonic()):
            return
        try:
            pose = self.compensator.estimate(self.compensator.command)
            self._outputs.estimate(pose, stamp_of(stamp))
        except HexapodError as error:
            self._status.bad_feedback.add(error.reason, str(error), time.monotonic())
            self.warn_of("estimate " + error.reason, f"no pose estimate: {error}")

    def _publish_markers(self) -> None:
        if self._active:
            self._outputs.show(corrects=not self._fresh_start)

    # ---- state ----

    def _forget(self) -> None:
        """Forget the last command, but not where it has sent the struts."""
        if not self._fresh_start:
            self._last_known.tell(self.compensator.command, self._commands.last)
        self.compensator.reset()
        self._pacing.clear()
        self._unestimated = None
        self._fresh_start = self._looks_closer = True
        self._outputs.forget()
        self._stamps.forget()
        self._following.forget()

    def _refuse_waiting(self, data: bytes, error: HexapodError, now: float) -> None:
        self._refuse(self._input.stamp(data), error, now)

    def _refuse(self, stamp: int, error: HexapodError, now: float) -> None:
        self._journal.refused(stamp, error.reason, str(error))
        self._status.refusals.add(error.reason, str(error), now)
        self._outputs.signs.stop(True)
        self.warn_of(error.reason, f"command refused ({error.reason}): {error}; {ADVICE.get(error.reason, OTHERWISE)}")

    def _check_state(self) -> None:
        self._look_at_publishers()
        now = time.monotonic()
        self._status.log_space.look()
        self._look_closer()
        self._tell_problem()
        self._status.prediction_problem = self._outputs.prediction_problem
        self._reload.look()
        self._travel.look(now)
        self._journal.tick(now)
        self._outputs.signs.stop(not self._active or self._status.stops(now))
        level, text = self._status.judged(self.compensator, now) if self._active else (WARN, "not active")
        self.tell(level, text, lambda: self._status.values(self.compensator, self._fresh_start, now))

    def _tell_problem(self) -> None:
        """Log what stops the machine, once."""
        guard = self._status.problem()
        problem = guard.problem if guard is not None and self._active else ""
        if problem and problem != self._logged_problem:
            self.get_logger().error(f"refusing commands: {problem}")
        self._logged_problem = problem


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node; the entry of the executable ``compensator``."""
    keep_discovery_local()
    return run(CompensatorNode, PROGRAM, argv)


if __name__ == "__main__":
    sys.exit(main())
