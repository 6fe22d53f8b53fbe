"""The compensator node: tool pose commands in, compensated strut commands and pose estimates out.

It holds no mathematics: it converts, calls :class:`~hexapod_comp.compensation.compensator.Compensator`, publishes, and
reports what it refused. Run it with ``ros2 run hexapod_comp compensator`` or
``python -m hexapod_comp.nodes.compensator``; doc/nodes.md lists topics, services and parameters.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from ..compensation.compensator import Compensator
from ..compensation.journal import Source, load_with_source
from ..compensation.state import pack_pose
from ..compensation.thermal import TemperatureFilter
from ..errors import CommandError, HexapodError, shorten
from ..formats.paths import confined_file, folder_of
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from ..machine.model_file import load_model
from ..pose import Pose
from .command_source import CommandSource, OwnTopic
from .compensator_parameters import PARAMETERS, PROGRAM
from .compensator_status import CompensatorStatus
from .following import StrokeRange
from .health import WARN, seconds
from .journal import JournalTopics
from .markers import machine_markers
from .messages import StrutReader, write_pose
from .model_loading import Loading
from .order import InOrder
from .parameters import ParameterError, declare
from .reloading import ReloadService
from .running import keep_discovery_local, run
from .runtime import ACKNOWLEDGED_WITHIN, COMMAND_QOS, EVENT_QOS, STATE_QOS, MachineNode
from .stamps import StampCheck, nanoseconds_of, period, stamp_of
from .wire import StrutBytes, read_pose_bytes

CHECK_PERIOD = 0.05
"""How often the node looks whether its state has changed, s."""

ESTIMATE_PERIOD = 0.02
"""How often the pose is estimated from the node's own commands while there is no feedback, s."""


class CompensatorNode(MachineNode):
    """Lifecycle node around one :class:`Compensator`; arguments are those of ``rclpy`` nodes."""

    def __init__(self, **options: Any) -> None:
        super().__init__("compensator", **options)
        self._options = declare(self, PARAMETERS)
        self.wants_autostart = self._options["autostart"]
        self._folders = {name: self._folder(name) for name in ("geometry_file", "model_file")}
        if self._options["base_frame"] == self._options["work_frame"]:
            raise ParameterError(f"parameter work_frame: must differ from base_frame, {self._options['base_frame']!r}")
        simulated = bool(self.get_parameter("use_sim_time").value)
        clock = (lambda: self.get_clock().now().nanoseconds) if simulated else None
        self._stamps = StampCheck(self._options["max_command_age"], clock)
        self._status = status = CompensatorStatus(self._options, self._stamps)
        self._commands, self._feedback, self._following = status.commands, status.feedback, status.following
        self._last_known, self._struts = status.last_known, StrutReader()
        self._order = InOrder("strut_states")
        self._answered = 0
        self._fresh_start = self._looks_closer = True
        self._told = ""
        self._unestimated: int | None = None
        self._compensator: Compensator | None = None
        self._sources: dict[str, Source] = {}

    @property
    def compensator(self) -> Compensator:
        """The compensator of a configured node."""
        if self._compensator is None:
            raise CommandError("not_configured", "the node is not configured")
        return self._compensator

    def _folder(self, parameter: str) -> Path | None:
        """Return the folder from which a file may be read."""
        configured = self._options["model_folder"]
        if not configured:
            return folder_of(self._options[parameter])
        folder = Path(configured).expanduser()
        if not folder.is_dir():
            raise ParameterError(f"parameter model_folder: {configured!r} is not a folder")
        return folder

    # ---- lifecycle ----

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load geometry and model, compile, open topics."""
        began = time.perf_counter()
        self.get_logger().info("loading; the first start on a machine compiles its kernels, which takes up to a minute")
        try:
            path = confined_file(self._options["geometry_file"], self._folders["geometry_file"])
            geometry, self._sources["geometry"] = load_with_source(path, load_geometry)
            self._compensator = Compensator(geometry, self._load_model(geometry), self._options["ramp_rate"])
            self._warm_up()
        except HexapodError as error:
            self._compensator = None
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._temperatures = TemperatureFilter(self._options["temperature_time_constant_s"])
        self._frames = {
            self._options["base_frame"]: pack_pose(Pose.identity()),
            self._options["work_frame"]: pack_pose(geometry.work),
        }
        self._reach = StrokeRange(geometry)
        self._open_topics()
        frames = {name: self._options[f"{name}_frame"] for name in ("base", "work")}
        self._journal = JournalTopics(self, self.compensator, self._sources, frames)
        model = f"model {self.compensator.model.name!r}"
        if self._options["model_file"] == "ideal":
            model = "the ideal model, which corrects nothing (parameter model_file)"
        took = time.perf_counter() - began
        self.get_logger().info(f"configured machine {geometry.name!r} with {model} in {took:.2f} s")
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
        self._reload.close()
        self._journal.close(time.monotonic())
        self._forget()
        self._close_topics()
        self._compensator = None
        return super().on_cleanup(state)

    def say_goodbye(self) -> None:
        """Publish a last status and wait until it has arrived."""
        if self._compensator is None:
            return
        self._active = False
        self._check_state()
        self._journal.close(time.monotonic())
        self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
        self._command_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def _load_model(self, geometry: HexapodGeometry) -> MachineModel:
        name = self._options["model_file"]
        if name == "ideal":
            self._sources["model"] = Source.of(name, "")
            return MachineModel(geometry.name)
        path = confined_file(name, self._folders["model_file"])
        model, self._sources["model"] = load_with_source(path, lambda file: load_model(file, geometry))
        return model

    def _warm_up(self) -> None:
        """Run every kernel of the loop once, so that none compiles while the machine moves."""
        trial = Compensator(self.compensator.geometry, self.compensator.model)
        home = trial.geometry.tool_pose(trial.geometry.home)
        message = PoseStamped()
        write_pose(message, home.position, home.rotation)
        _, _, numbers = read_pose_bytes(serialize_message(message))
        trial.step(numbers, 0.0)
        trial.estimate(trial.command)
        StrutBytes().write(trial.command)
        self.compensator.enable(self._options["enable_compensation"])

    def _open_topics(self) -> None:
        self._command_pub = self.publish_on(JointState, "strut_commands", COMMAND_QOS)
        self._correction_pub = self.publish_on(JointState, "strut_corrections", COMMAND_QOS)
        self._estimate_pub = self.publish_on(PoseStamped, "tool_pose_estimate", STATE_QOS)
        self.open_diagnostics(self.compensator.geometry.name)
        self._marker_pub = self.create_publisher(MarkerArray, "~/markers", EVENT_QOS)
        self._array_pub = None
        if self._options["publish_array"]:
            self._array_pub = self.publish_on(Float64MultiArray, "strut_commands_array", COMMAND_QOS)
            self._array_out = Float64MultiArray(data=[0.0] * 6)
            self._array_view = np.frombuffer(self._array_out.data, dtype=float)
        self._command_out, self._correction_out = StrutBytes(), StrutBytes()
        self._estimate_out = PoseStamped()
        self._estimate_out.header.frame_id = self._options["base_frame"]
        commands = self.obey(PoseStamped, "tool_pose_command", self._on_command, self._look_at_publishers, raw=True)
        self._entities = [
            commands,
            self.listen_to(JointState, "strut_states", self._on_states, STATE_QOS),
            self.listen_to(Temperature, "temperatures", self._on_temperature, EVENT_QOS),
        ]
        allowed = self._options["allow_several_publishers"]
        self._status.watch_topics(
            CommandSource(self, commands.topic_name, commands.get_publisher_count, allowed),
            OwnTopic(self, self._command_pub.topic_name, allowed),
        )
        self._hear = self._status.source.hear
        self._reload = ReloadService(self, self._begin_reload, self._take_model, self._status.failed_reloads)
        self._own_services = [
            self.create_service(SetBool, "~/enable_compensation", self._on_enable),
            self._reload.service,
            self.create_service(Trigger, "~/reset", self._on_reset),
        ]
        self._timers_open = [
            self.every(CHECK_PERIOD, self._check_state),
            self.every(ESTIMATE_PERIOD, self._estimate_from_commands),
        ]
        if self._options["marker_rate"] > 0.0:
            self._timers_open.append(self.every(1.0 / self._options["marker_rate"], self._publish_markers))

    def _close_topics(self) -> None:
        for timer in self._timers_open:
            self.destroy_timer(timer)
        for service in self._own_services:
            self.destroy_service(service)
        for subscription in self._entities:
            self.destroy_subscription(subscription)
        for publisher in (
            self._command_pub,
            self._correction_pub,
            self._estimate_pub,
            self._diagnostics_pub,
            self._marker_pub,
            self._array_pub,
            *self._journal.publishers,
        ):
            if publisher is not None:
                self.destroy_publisher(publisher)

    # ---- messages in ----

    def _on_command(self, data: bytes, number: int | None) -> None:
        if not self._active:
            return
        now = time.monotonic()
        if self._hear(number, now):
            self._look_closer()
        stamp = 0
        try:
            stamp, frame_id, numbers = read_pose_bytes(data)
            frame = self._frames.get(frame_id)
            if frame is None or self._looks_closer:
                self._examine(frame_id, now)
            if stamp:
                self._stamps.check(stamp, now)
            when = stamp or self.get_clock().now().nanoseconds  # zero means now
            self.compensator.step(numbers, when * 1e-9, frame)
        except HexapodError as error:
            self._journal.refused(stamp, error.reason, str(error))
            self._refuse(error, now)
            return
        self._publish_command(when)
        self._journal.answered(when, frame_id, numbers)
        if self._fresh_start:
            self._fresh_start = False
            self._look_closer()
        if stamp:
            self._stamps.accept(stamp, now)
        self._following.note(self.compensator.command, now)
        self._commands.tick(now)
        self._unestimated = when

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
            since = f"for {seconds(self._feedback.age(now))} s" if self._feedback.count else "yet"
            raise CommandError("no_feedback", f"no strut_states {since}")
        if self._fresh_start:
            self.compensator.reset(self._last_known.struts(now, fed))

    def _look_closer(self) -> None:
        """Find out whether the next commands must be examined."""
        required = self._fresh_start or self._options["require_feedback"]
        self._looks_closer = required or self._status.problem() is not None

    def _look_at_publishers(self) -> None:
        """Look who publishes what only one may: now and then, and when somebody comes or goes."""
        now = time.monotonic()
        self._status.source.look(now)
        self._status.own_topic.look(now)
        self._look_closer()

    def _on_states(self, message: JointState) -> None:
        # Also while inactive: the first command after activation must start from where the struts are.
        now = time.monotonic()
        struts = self._struts.lengths
        stamp = nanoseconds_of(message.header.stamp)
        try:
            self._order.check(stamp, now)
            self._struts.read(message)
            self._reach.check(struts)
            pose = self.compensator.estimate(struts)
        except HexapodError as error:
            if self._active:
                self._status.bad_feedback.add(error.reason, str(error), now)
                self.warn_of("feedback " + error.reason, f"strut_states ignored: {error}")
            return
        self._last_known.measure(struts, now)
        self._order.passed(stamp, now)
        self._feedback.tick(now)
        if self._active:
            self._watch_following(struts, now)
            self._publish_estimate(pose, message.header.stamp)

    def _watch_following(self, measured: np.ndarray, now: float) -> None:
        """Hold the measured struts against their commands; even one reading that is off is said."""
        known = self._following.problem
        self._following.check(measured, now)
        if self._following.problem and not known:
            self._looks_closer = True
            self._status.bad_feedback.add(self._following.reason, self._following.problem, now)

    def _on_temperature(self, message: Temperature) -> None:
        # Also while inactive: the first command after activation must know how warm the machine is. Dated by
        # arrival: sensors need not stamp, clocks may be set, and what a transport delays a drift does not notice.
        name, now = message.header.frame_id, time.monotonic()
        try:
            self.compensator.set_temperature(name, self._temperatures.take(name, message.temperature, now))
        except HexapodError as error:
            if not self._active:
                return
            self._status.bad_feedback.add("temperature", str(error), now)
            self.warn_of("temperature", f"temperature ignored: {error}")

    # ---- services ----

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.compensator.enable(request.data)
        response.success = True
        response.message = f"compensation ramps {'in' if request.data else 'out'}"
        return response

    def _begin_reload(self) -> Loading:
        """Begin to load the model, as at the start, elsewhere."""
        name, machine = self._options["model_file"], self.compensator.geometry.name
        return Loading(None if name == "ideal" else confined_file(name, self._folders["model_file"]), machine)

    def _take_model(self, model: MachineModel, source: Source) -> None:
        self._sources["model"] = source
        self.compensator.set_model(model)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._forget()
        response.success = True
        response.message = "the next command may be one allowed step from where the struts were known to be last"
        return response

    # ---- messages out ----

    def _publish_command(self, when: int) -> None:
        out, correction, compensator = self._command_out, self._correction_out, self.compensator
        out.write(compensator.command, period(self._answered, when))
        self._answered = when
        self._command_pub.publish(out.stamped(when))
        correction.write(compensator.correction)
        self._correction_pub.publish(correction.stamped(when))
        if self._array_pub is not None:
            self._array_view[:] = compensator.command
            self._array_pub.publish(self._array_out)

    def _publish_estimate(self, pose: np.ndarray, stamp: Time) -> None:
        write_pose(self._estimate_out, pose[:3], pose[3:].reshape((3, 3)))
        self._estimate_out.header.stamp = stamp
        self._estimate_pub.publish(self._estimate_out)

    def _estimate_from_commands(self) -> None:
        """Without feedback, estimate the pose from the newest command, at a rate that leaves the loop alone."""
        stamp, self._unestimated = self._unestimated, None
        if stamp is None or not self._active or self._status.fed(time.monotonic()):
            return
        try:
            pose = self.compensator.estimate(self.compensator.command)
            self._publish_estimate(pose, stamp_of(stamp))
        except HexapodError as error:
            self._status.bad_feedback.add(error.reason, str(error), time.monotonic())
            self.warn_of("estimate " + error.reason, f"no pose estimate: {error}")

    def _publish_markers(self) -> None:
        if not self._active or not self._marker_pub.get_subscription_count():
            return
        now = self.get_clock().now().to_msg()
        correction = np.zeros(6) if self._fresh_start else self.compensator.correction
        frame, pose = self._options["base_frame"], self.compensator.platform_estimate
        markers = machine_markers(self.compensator.geometry, *pose, correction, frame, now)
        self._marker_pub.publish(markers)

    # ---- state ----

    def _forget(self) -> None:
        """Forget the last command, but not where it has sent the struts."""
        if not self._fresh_start:
            self._last_known.tell(self.compensator.command, self._commands.last)
        self.compensator.reset()
        self._unestimated = None
        self._fresh_start = self._looks_closer = True
        self._answered = 0
        self._stamps.forget()
        self._following.forget()

    def _refuse(self, error: HexapodError, now: float) -> None:
        self._status.refusals.add(error.reason, str(error), now)
        self.warn_of(error.reason, f"command refused ({error.reason}): {error}")

    def _check_state(self) -> None:
        self._look_at_publishers()
        now = time.monotonic()
        self._status.log_space.look()
        self._look_closer()
        self._tell_problem()
        self._reload.look()
        self._journal.tick(now)
        level, text = self._status.judged(self.compensator, now) if self._active else (WARN, "not active")
        self.tell(level, text, lambda: self._status.values(self.compensator, self._fresh_start, now))

    def _tell_problem(self) -> None:
        """Log what stops the machine, once."""
        guard = self._status.problem()
        problem = guard.problem if guard is not None and self._active else ""
        if problem and problem != self._told:
            self.get_logger().error(f"refusing commands: {problem}")
        self._told = problem


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node; the entry of the executable ``compensator``."""
    keep_discovery_local()
    return run(CompensatorNode, PROGRAM, argv)


if __name__ == "__main__":
    sys.exit(main())
