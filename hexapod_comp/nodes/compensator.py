"""The compensator node: tool pose commands in, compensated strut commands and pose estimates out.

It holds no mathematics: it converts, calls :class:`~hexapod_comp.compensation.Compensator`, publishes, and
reports what it refused. Run it with ``ros2 run hexapod_comp compensator`` or
``python -m hexapod_comp.nodes.compensator``; the README lists topics, services and parameters.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from ..compensation import Compensator
from ..compensation_kernels import pack_pose
from ..conversions import StrutMessage, StrutReader, pose_numbers, write_pose
from ..errors import CommandError, HexapodError
from ..geometry import HexapodGeometry, load_geometry
from ..machine import MachineModel
from ..model_file import load_model
from ..paths import config_file
from ..pose import Pose
from ..thermal import DEFAULT_TIME_CONSTANT, TemperatureFilter
from .health import ERROR, OK, WARN, Flow, HealthReport, Refusals, seconds
from .markers import machine_markers
from .runtime import (
    ACKNOWLEDGED_WITHIN,
    COMMAND_QOS,
    EVENT_QOS,
    STATE_QOS,
    MachineNode,
    Parameter,
    declare,
    keep_discovery_local,
    run,
)

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start"),
    Parameter("geometry_file", "paper.yaml", "geometry file: a path or the name of a shipped one"),
    Parameter("model_file", "paper_machine.yaml", "model file: a path or the name of a shipped one; ideal = none"),
    Parameter("base_frame", "base", "frame_id of poses in the machine base"),
    Parameter("work_frame", "work", "frame_id of poses in the geometry file's work frame"),
    Parameter("command_timeout", 0.1, "without a command for this long the state is stale, s; 0 = off", 0.0, 3600.0),
    Parameter("max_command_age", 0.5, "older (or newer) stamps are refused, s; 0 = off", 0.0, 3600.0),
    Parameter("feedback_timeout", 0.1, "without measured struts for this long there is no feedback, s", 1e-3, 3600.0),
    Parameter("require_feedback", False, "refuse commands while there is no feedback"),
    Parameter("ramp_rate", 1e-3, "strut speed at which a change of model or enabling is taken up, m/s", 1e-6, 1.0),
    Parameter("enable_compensation", True, "compensate from the start"),
    Parameter(
        "temperature_time_constant_s", DEFAULT_TIME_CONSTANT, "low pass of temperatures, s; 0 = off", 0.0, 3600.0
    ),
    Parameter("marker_rate", 10.0, "markers per second, Hz; 0 = none", 0.0, 10.0),
    Parameter("publish_array", False, "also publish strut_commands_array for ros2_controllers"),
)

CHECK_PERIOD = 0.05
"""How often the node looks whether its state has changed, s."""

ESTIMATE_PERIOD = 0.02
"""How often the pose is estimated from the node's own commands while there is no feedback, s."""

FORGET_ORDER_AFTER = 1.0
"""After a pause this long, s, stamps may start again earlier: the sender or its clock was restarted."""


class CompensatorNode(MachineNode):
    """Lifecycle node around one :class:`Compensator`; arguments are those of ``rclpy`` nodes."""

    def __init__(self, **options: Any) -> None:
        super().__init__("compensator", **options)
        self._options = declare(self, PARAMETERS)
        self.wants_autostart = self._options["autostart"]
        self._refusals, self._feedback_refusals = Refusals(), Refusals()
        self._commands, self._feedback = Flow(), Flow()
        self._struts = StrutReader()
        self._last_stamp = 0
        self._fresh_start = self._looks_at_feedback = True
        self._unestimated: Time | None = None
        self._simulated_time = bool(self.get_parameter("use_sim_time").value)
        self._compensator: Compensator | None = None

    @property
    def compensator(self) -> Compensator:
        """The compensator of a configured node."""
        if self._compensator is None:
            raise CommandError("not_configured", "the node is not configured")
        return self._compensator

    # ---- lifecycle ----

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load geometry and model, compile, open topics."""
        began = time.perf_counter()
        self.get_logger().info("loading; the first start on a machine compiles its kernels, which takes up to a minute")
        try:
            geometry = load_geometry(config_file(self._options["geometry_file"]))
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
        self._open_topics()
        name = f"{self.get_fully_qualified_name()[1:]}: {geometry.name}"
        self._report = HealthReport(name, geometry.name)
        self.get_logger().info(
            f"configured machine {geometry.name!r} with model {self.compensator.model.name!r} "
            f"in {time.perf_counter() - began:.2f} s"
        )
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to take commands; of those that came before none is replayed."""
        self._forget()
        self._active = True
        self.get_logger().info("ready")
        return super().on_activate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close topics and forget the machine."""
        self._active = False
        self._close_topics()
        self._compensator = None
        return super().on_cleanup(state)

    def say_goodbye(self) -> None:
        """Publish a last status and wait until it has arrived."""
        if self._compensator is None:
            return
        self._active = False
        self._check_state()
        self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
        self._command_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def _load_model(self, geometry: HexapodGeometry) -> MachineModel:
        name = self._options["model_file"]
        return MachineModel(geometry.name) if name == "ideal" else load_model(config_file(name), geometry)

    def _warm_up(self) -> None:
        """Run every kernel of the loop once, so that none compiles while the machine moves."""
        trial = Compensator(self.compensator.geometry, self.compensator.model)
        home = trial.tool_pose(trial.geometry.home)
        message = PoseStamped()
        write_pose(message, home.position, home.rotation)
        trial.step(pose_numbers(message), 0.0)
        trial.estimate(trial.command)
        StrutMessage().write(trial.command)
        self.compensator.enable(self._options["enable_compensation"])

    def _open_topics(self) -> None:
        self._command_pub = self.publish_on(JointState, "strut_commands", COMMAND_QOS)
        self._correction_pub = self.publish_on(JointState, "strut_corrections", COMMAND_QOS)
        self._estimate_pub = self.publish_on(PoseStamped, "tool_pose_estimate", STATE_QOS)
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, "/diagnostics", EVENT_QOS)
        self._marker_pub = self.create_publisher(MarkerArray, "~/markers", EVENT_QOS)
        self._array_pub = None
        if self._options["publish_array"]:
            self._array_pub = self.publish_on(Float64MultiArray, "strut_commands_array", COMMAND_QOS)
            self._array_out = Float64MultiArray(data=[0.0] * 6)
            self._array_view = np.frombuffer(self._array_out.data, dtype=float)
        self._command_out, self._correction_out = StrutMessage(), StrutMessage()
        self._estimate_out = PoseStamped()
        self._estimate_out.header.frame_id = self._options["base_frame"]
        self._entities = [
            self.listen_to(PoseStamped, "tool_pose_command", self._on_command, COMMAND_QOS),
            self.listen_to(JointState, "strut_states", self._on_states, STATE_QOS),
            self.listen_to(Temperature, "temperatures", self._on_temperature, EVENT_QOS),
        ]
        self._own_services = [
            self.create_service(SetBool, "~/enable_compensation", self._on_enable),
            self.create_service(Trigger, "~/reload_model", self._on_reload),
            self.create_service(Trigger, "~/reset", self._on_reset),
        ]
        self._timers_open = [
            self.create_timer(CHECK_PERIOD, self._check_state),
            self.create_timer(ESTIMATE_PERIOD, self._estimate_from_commands),
        ]
        if self._options["marker_rate"] > 0.0:
            self._timers_open.append(self.create_timer(1.0 / self._options["marker_rate"], self._publish_markers))

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
        ):
            if publisher is not None:
                self.destroy_publisher(publisher)

    # ---- messages in ----

    def _on_command(self, message: PoseStamped) -> None:
        if not self._active:
            return
        now = time.monotonic()
        header = message.header
        try:
            stamp = self._checked_stamp(header.stamp, now)
            frame = self._frames.get(header.frame_id)
            if frame is None or self._looks_at_feedback:
                self._examine(header.frame_id, now)
            self.compensator.step(pose_numbers(message), now, frame)
        except HexapodError as error:
            self._refuse(error, now)
            return
        self._publish_command(stamp, now - self._commands.last)
        self._fresh_start, self._looks_at_feedback = False, self._options["require_feedback"]
        self._last_stamp = _nanoseconds(header.stamp) or self._last_stamp
        self._commands.tick(now)
        self._unestimated = stamp

    def _examine(self, frame_id: str, now: float) -> None:
        """Refuse an unknown frame, or missing feedback; start from the feedback there is."""
        if frame_id not in self._frames:
            raise CommandError("frame_id", f"frame_id must be one of {', '.join(self._frames)}, not {frame_id!r}")
        self._consult_feedback(now)

    def _checked_stamp(self, stamp: Time, now: float) -> Time:
        """Return the stamp to copy, or refuse one too old, too new or out of order; zero means now."""
        nanoseconds = _nanoseconds(stamp)
        if nanoseconds == 0:
            return self.get_clock().now().to_msg()
        # The node's clock is this one, and costs a dozen microseconds more, unless time is simulated.
        clock = self.get_clock().now().nanoseconds if self._simulated_time else time.time_ns()
        age = (clock - nanoseconds) * 1e-9
        allowed = self._options["max_command_age"]
        if 0.0 < allowed < abs(age):
            reason, word = ("stamp_past", "old") if age > 0.0 else ("stamp_future", "in the future")
            raise CommandError(reason, f"stamp is {abs(age):.3f} s {word}, allowed {allowed:g} s")
        if nanoseconds < self._last_stamp and self._commands.age(now) < FORGET_ORDER_AFTER:
            raise CommandError("stamp_order", "stamp is earlier than the last command's")
        return stamp

    def _consult_feedback(self, now: float) -> None:
        """Take the measured struts as the state to start from, or refuse when they are required and absent."""
        fresh = self._feedback.age(now) <= self._options["feedback_timeout"]
        if self._options["require_feedback"] and not fresh:
            raise CommandError("no_feedback", f"no strut_states for {seconds(self._feedback.age(now))} s")
        if self._fresh_start:
            self.compensator.reset(self._struts.lengths if fresh else None)

    def _on_states(self, message: JointState) -> None:
        # Also while inactive: the first command after activation must start from where the struts are.
        now = time.monotonic()
        try:
            self._struts.read(message)
        except CommandError as error:
            if self._active:
                self._feedback_refusals.add(error.reason, str(error), now)
                self.warn_of("feedback " + error.reason, f"strut_states ignored: {error}")
            return
        self._feedback.tick(now)
        if self._active:
            self._publish_estimate(self._struts.lengths, message.header.stamp)

    def _on_temperature(self, message: Temperature) -> None:
        # Also while inactive: the first command after activation must know how warm the machine is. Dated by
        # arrival: sensors need not stamp, clocks may be set, and what a transport delays a drift does not notice.
        name, now = message.header.frame_id, time.monotonic()
        try:
            self.compensator.set_temperature(name, self._temperatures.take(name, message.temperature, now))
        except HexapodError as error:
            if not self._active:
                return
            self._feedback_refusals.add("temperature", str(error), now)
            self.warn_of("temperature", f"temperature ignored: {error}")

    # ---- services ----

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.compensator.enable(request.data)
        response.success = True
        response.message = f"compensation ramps {'in' if request.data else 'out'}"
        return response

    def _on_reload(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            self.compensator.set_model(self._load_model(self.compensator.geometry))
        except HexapodError as error:
            response.success, response.message = False, f"the old model stays: {error}"
            return response
        response.success, response.message = True, f"model {self.compensator.model.name!r} ramps in"
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._forget()
        response.success = True
        response.message = "the next command may be one allowed step from the measured struts"
        return response

    # ---- messages out ----

    def _publish_command(self, stamp: Time, since_last: float) -> None:
        out, correction, compensator = self._command_out, self._correction_out, self.compensator
        out.write(compensator.command, since_last if since_last < FORGET_ORDER_AFTER else 0.0)
        out.message.header.stamp = stamp
        self._command_pub.publish(out.message)
        correction.write(compensator.correction)
        correction.message.header.stamp = stamp
        self._correction_pub.publish(correction.message)
        if self._array_pub is not None:
            self._array_view[:] = compensator.command
            self._array_pub.publish(self._array_out)

    def _publish_estimate(self, struts: np.ndarray, stamp: Time) -> None:
        try:
            pose = self.compensator.estimate(struts)
        except HexapodError as error:
            self._feedback_refusals.add(error.reason, str(error), time.monotonic())
            self.warn_of("estimate " + error.reason, f"no pose estimate: {error}")
            return
        write_pose(self._estimate_out, pose[:3], pose[3:].reshape((3, 3)))
        self._estimate_out.header.stamp = stamp
        self._estimate_pub.publish(self._estimate_out)

    def _estimate_from_commands(self) -> None:
        """Without feedback, estimate the pose from the newest command, at a rate that leaves the loop alone."""
        stamp, self._unestimated = self._unestimated, None
        if stamp is None or not self._active:
            return
        if self._feedback.age(time.monotonic()) > self._options["feedback_timeout"]:
            self._publish_estimate(self.compensator.command, stamp)

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
        self.compensator.reset()
        self._unestimated = None
        self._fresh_start = self._looks_at_feedback = True
        self._last_stamp = 0

    def _refuse(self, error: HexapodError, now: float) -> None:
        self._refusals.add(error.reason, str(error), now)
        self.warn_of(error.reason, f"command refused ({error.reason}): {error}")

    def _state(self, now: float) -> tuple[bytes, str]:
        """Return level and message of the diagnostics."""
        if not self._active:
            return WARN, "not active"
        if self._refusals.recent(now):
            return ERROR, f"refusing commands: {self._refusals.last_reason}"
        if self._feedback_refusals.recent(now):
            return ERROR, f"bad feedback: {self._feedback_refusals.last_reason}"
        timeout = self._options["command_timeout"]
        if not self._commands.count:
            return OK, "waiting for the first command"
        if 0.0 < timeout < self._commands.age(now):
            return WARN, "no new command"
        if self.compensator.ramping:
            return OK, "running, a change is ramping in"
        if self._feedback.age(now) > self._options["feedback_timeout"]:
            return OK, "running, pose estimated from own commands"
        return OK, "running"

    def _check_state(self) -> None:
        now = time.monotonic()
        level, text = self._state(now)
        if not self._report.due(level, text, now):
            return
        stamp = self.get_clock().now().to_msg()
        self._diagnostics_pub.publish(self._report.message(level, text, self._values(now), stamp))

    def _values(self, now: float) -> dict[str, str]:
        compensator = self.compensator
        feedback = self._feedback.age(now) <= self._options["feedback_timeout"]
        correction = 0.0 if self._fresh_start else float(np.abs(compensator.correction).max())
        values = {
            "model": compensator.model.name,
            "compensation": "on" if compensator.enabled else "off",
            "ramping": str(compensator.ramping).lower(),
            "pose_estimated_from": "strut_states" if feedback else "own commands",
            "commands": str(self._commands.count),
            "command_rate_hz": f"{self._commands.rate(now):.1f}",
            "command_age_s": seconds(self._commands.age(now)),
            "feedback_rate_hz": f"{self._feedback.rate(now):.1f}",
            "feedback_age_s": seconds(self._feedback.age(now)),
            "largest_correction_m": f"{correction:.9f}",
            "outside_field": str(compensator.outside_field).lower(),
            "last_refusal": self._refusals.last_text,
            "last_bad_feedback": self._feedback_refusals.last_text,
            "bad_feedback": str(sum(self._feedback_refusals.counts.values())),
        }
        values.update({f"temperature.{k}_degC": f"{v:.2f}" for k, v in compensator.temperatures.values.items()})
        values.update(self._refusals.values())
        return values


def _nanoseconds(stamp: Time) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node; the entry of the executable ``compensator``."""
    keep_discovery_local()
    return run(CompensatorNode, argv)


if __name__ == "__main__":
    sys.exit(main())
