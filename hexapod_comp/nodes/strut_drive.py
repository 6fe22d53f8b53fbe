"""The simulated strut-drive node: strut commands in, encoder readings and the true tool pose out.

It stands for the six drives and the machine on them: :class:`~hexapod_comp.simulation.StrutDrive` with a
hidden truth. Run it with ``ros2 run hexapod_comp strut_drive`` or
``python -m hexapod_comp.nodes.strut_drive``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from sensor_msgs.msg import JointState

from ..conversions import StrutMessage, StrutReader, write_pose
from ..errors import CommandError, HexapodError, KinematicsError
from ..geometry import STRUT_NAMES, HexapodGeometry, load_geometry
from ..imperfections import ImperfectionBounds, draw_model
from ..machine import MachineModel, RealMachine
from ..model_file import load_model
from ..paths import config_file
from ..simulation import DriveParameters, Faults, StrutDrive
from .command_source import CommandSource
from .health import ERROR, OK, WARN, Flow, HealthReport, Refusals, joined, seconds
from .log_space import LogSpace
from .order import InOrder, NoStep
from .runtime import (
    ACKNOWLEDGED_WITHIN,
    EVENT_QOS,
    STATE_QOS,
    MachineNode,
    Parameter,
    checked,
    declare,
    keep_discovery_local,
    run,
)
from .stamps import nanoseconds_of

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start"),
    Parameter("geometry_file", "paper.yaml", "geometry file: a path or the name of a shipped one"),
    Parameter(
        "truth_file",
        "paper_machine.yaml",
        "hidden truth: a model file, ideal for none, or random for one drawn from truth_seed",
    ),
    Parameter("truth_seed", 1, "seed of a random truth", 0, 2**31),
    Parameter("noise_seed", 0, "seed of the noise", 0, 2**31),
    Parameter("base_frame", "base", "frame_id of the true tool pose"),
    Parameter("command_timeout", 0.1, "without a command for this long diagnostics warn, s; 0 = off", 0.0, 3600.0),
    Parameter("allow_several_publishers", False, "obey though several nodes publish strut commands"),
    Parameter("rate", 500.0, "readings published per second, Hz", 1.0, 2000.0),
    Parameter("step", 0.1e-6, "length of one motor step, m; 0 = none", 0.0, 1e-3),
    Parameter("lag", 0.005, "time by which the drives follow a moving command, s", 1e-3, 1.0),
    Parameter("max_speed", 0.0, "largest motor speed, m/s; 0 = the geometry's limit", 0.0, 10.0),
    Parameter("max_acceleration", 10.0, "largest motor acceleration, m/s²", 1e-3, 1e4),
    Parameter("encoder_resolution", 0.1e-6, "length of one encoder count, m; 0 = none", 0.0, 1e-3),
    Parameter("encoder_noise", 0.05e-6, "standard deviation of an encoder reading, m", 0.0, 1e-3),
    Parameter("tracker_noise", 0.0, "standard deviation of the true pose's coordinates, m", 0.0, 1e-3),
)

FAULT_PARAMETERS = (
    Parameter("fault_stuck_strut", 0, "strut 1 to 6 that does not move; 0 = none", 0, 6, read_only=False),
    Parameter("fault_encoder_lost", 0, "strut 1 to 6 whose encoder reads NaN; 0 = none", 0, 6, read_only=False),
    Parameter("fault_feedback_delay", 0.0, "age of readings when they are published, s", 0.0, 10.0, read_only=False),
    Parameter("fault_feedback_drop", 0.0, "share of readings that are never published", 0.0, 1.0, read_only=False),
    Parameter("fault_jump_strut", 1, "strut 1 to 6 that fault_jump knocks away", 1, 6, read_only=False),
    Parameter("fault_jump", 0.0, "distance of a knock, m; each setting knocks once", -0.1, 0.1, read_only=False),
)

LONGEST_PAUSE = 0.25
"""After a longer pause (a stopped process), the machine has moved on by no more than this, s."""

CHECK_PERIOD = 0.05


class StrutDriveNode(MachineNode):
    """Lifecycle node around one :class:`StrutDrive`; arguments are those of ``rclpy`` nodes."""

    def __init__(self, **options: Any) -> None:
        super().__init__("strut_drive", **options)
        self._options = declare(self, PARAMETERS + FAULT_PARAMETERS)
        self.wants_autostart = self._options["autostart"]
        self._refusals, self._commands = Refusals(), Flow()
        self._reader = StrutReader()
        self._states_out, self._true_out = StrutMessage(), PoseStamped()
        self._true_out.header.frame_id = self._options["base_frame"]
        self._drive: StrutDrive | None = None
        self.add_on_set_parameters_callback(self._on_parameters)

    @property
    def drive(self) -> StrutDrive:
        """The simulated machine of a configured node."""
        if self._drive is None:
            raise CommandError("not_configured", "the node is not configured")
        return self._drive

    # ---- lifecycle ----

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build the machine and open topics."""
        options = self._options
        self.get_logger().info("loading; the first start on a machine compiles its kernels, which takes up to a minute")
        try:
            geometry = load_geometry(config_file(options["geometry_file"]))
            machine = RealMachine(geometry, self._truth(geometry))
            self._drive = StrutDrive(machine, self._drive_parameters(), options["noise_seed"])
            self.drive.faults = self._faults(options)
            self.drive.advance(1.0 / options["rate"])
            self._tool_in_base()
        except HexapodError as error:
            self._drive = None
            self.get_logger().error(f"cannot configure: {error}")
            return TransitionCallbackReturn.FAILURE
        self._open_topics()
        self._order, self._no_step, self._log_space = InOrder("strut_commands"), NoStep(geometry), LogSpace()
        self._report = HealthReport(f"{self.get_fully_qualified_name()[1:]}: {geometry.name}", geometry.name)
        self.get_logger().info(f"configured machine {geometry.name!r} with hidden truth {machine.model.name!r}")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to move and to measure."""
        self._last_run = time.monotonic()
        self._active = True
        self.get_logger().info("ready")
        return super().on_activate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close topics and forget the machine."""
        self._active = False
        for timer in self._own_timers:
            self.destroy_timer(timer)
        self.destroy_subscription(self._subscription)
        for publisher in (self._states_pub, self._true_pub, self._diagnostics_pub):
            self.destroy_publisher(publisher)
        self._drive = None
        return super().on_cleanup(state)

    def say_goodbye(self) -> None:
        """Publish a last status and wait until it has arrived."""
        if self._drive is None:
            return
        self._active = False
        self._check_state()
        self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def _truth(self, geometry: HexapodGeometry) -> MachineModel:
        name = self._options["truth_file"]
        if name == "ideal":
            return MachineModel(geometry.name)
        if name == "random":
            return draw_model(geometry, ImperfectionBounds(), self._options["truth_seed"], "random")
        return load_model(config_file(name), geometry)

    def _drive_parameters(self) -> DriveParameters:
        names = ("step", "lag", "max_acceleration", "encoder_resolution", "encoder_noise", "tracker_noise")
        values = {name: self._options[name] for name in names}
        return DriveParameters(max_speed=self._options["max_speed"] or None, **values)

    def _open_topics(self) -> None:
        self._states_pub = self.publish_on(JointState, "strut_states", STATE_QOS)
        self._true_pub = self.publish_on(PoseStamped, "tool_pose_true", STATE_QOS)
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, "/diagnostics", EVENT_QOS)
        self._subscription = self.obey(JointState, "strut_commands", self._on_commands, self._look_at_publishers)
        topic, count = self._subscription.topic_name, self._subscription.get_publisher_count
        self._source = CommandSource(self, topic, count, self._options["allow_several_publishers"])
        self._own_timers = [
            self.every(1.0 / self._options["rate"], self._run),
            self.every(CHECK_PERIOD, self._check_state),
        ]

    # ---- faults ----

    def _on_parameters(self, parameters: list[RosParameter]) -> SetParametersResult:
        wanted = dict(self._options)
        known = {parameter.name: parameter for parameter in FAULT_PARAMETERS}
        try:
            for parameter in parameters:
                if parameter.name in known:
                    wanted[parameter.name] = checked(known[parameter.name], parameter.value)
            faults = self._faults(wanted)
        except HexapodError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if not any(parameter.name == "fault_jump" for parameter in parameters):
            faults = replace(faults, jump=None)
        self._options = wanted
        if self._drive is not None:
            self.drive.faults = faults
        return SetParametersResult(successful=True)

    @staticmethod
    def _faults(options: dict[str, Any]) -> Faults:
        def index(number: int) -> int | None:
            return number - 1 if number else None

        jump = options["fault_jump"]
        return Faults(
            stuck=index(options["fault_stuck_strut"]),
            encoder_lost=index(options["fault_encoder_lost"]),
            feedback_delay=options["fault_feedback_delay"],
            feedback_drop=options["fault_feedback_drop"],
            jump=(options["fault_jump_strut"] - 1, jump) if jump else None,
        )

    # ---- the machine ----

    def _look_at_publishers(self) -> None:
        self._source.look(time.monotonic())

    def _on_commands(self, message: JointState, number: int | None) -> None:
        if not self._active:
            return
        now = time.monotonic()
        self._source.hear(number, now)
        try:
            if self._source.problem:
                raise CommandError(self._source.reason, self._source.problem)
            self._obey_commands(message, now)
        except HexapodError as error:
            self._refusals.add(error.reason, str(error), now)
            self.warn_of(error.reason, f"command refused ({error.reason}): {error}")
            return
        self._commands.tick(now)

    def _obey_commands(self, message: JointState, now: float) -> None:
        """Take commands that are six lengths, in order, and no step from the last ones."""
        stamp, lengths = nanoseconds_of(message.header.stamp), self._reader.lengths
        self._reader.read(message)
        self._order.check(stamp, now)
        self._no_step.check(lengths, now)
        self.drive.set_command(lengths)
        self._order.passed(stamp, now)
        self._no_step.passed(lengths, now)

    def _run(self) -> None:
        if not self._active:
            return
        now = time.monotonic()
        self.drive.advance(min(now - self._last_run, LONGEST_PAUSE))
        self._last_run = now
        stamp = self.get_clock().now().to_msg()
        if self.drive.feedback_arrived:
            out = self._states_out
            out.position[:] = self.drive.encoder_lengths()
            out.velocity[:] = self.drive.encoder_speeds()
            out.message.header.stamp = stamp
            self._states_pub.publish(out.message)
        try:
            self._tool_in_base()
        except KinematicsError as error:
            self.warn_of("true pose", f"the machine cannot stand where its struts are: {error}")
            return
        self._true_out.header.stamp = stamp
        self._true_pub.publish(self._true_out)

    def _tool_in_base(self) -> None:
        """Fill the message of the true tool pose, as the tracker reads it, in ``base``."""
        pose = self.drive.machine.geometry.work @ self.drive.tracker_pose()
        write_pose(self._true_out, pose.position, pose.rotation)

    # ---- state ----

    def _findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        """Yield what there is to say, worst first."""
        stopped = [name for name, at_stop in zip(STRUT_NAMES, self.drive.stopped, strict=True) if at_stop]
        if stopped:
            yield ERROR, f"at the travel stop: {', '.join(stopped)}"
        if self._source.problem:
            yield ERROR, f"refusing commands: {self._source.reason}: {self._source.problem}"
        if reasons := self._refusals.reasons(now, self._source.reason if self._source.problem else ""):
            yield ERROR, f"refusing commands: {reasons}"
        if self._commands.count and 0.0 < self._options["command_timeout"] < self._commands.age(now):
            yield WARN, "no new command"
        elif self._source.sequence.missing(now):
            yield WARN, "running, commands are being missed"
        if self._log_space.problem:
            yield WARN, self._log_space.problem
        yield OK, "running"

    def _check_state(self) -> None:
        self._look_at_publishers()
        self._log_space.look()
        now = time.monotonic()
        level, text = joined(self._findings(now)) if self._active else (WARN, "not active")
        if not self._report.due(level, text, now):
            return
        values = {
            "commanded_by": ", ".join(self._source.names),
            "commands": str(self._commands.count),
            "commands_missed": str(self._source.sequence.missed),
            "command_rate_hz": f"{self._commands.rate(now):.1f}",
            "command_age_s": seconds(self._commands.age(now)),
            "last_refusal": self._refusals.last_text,
            **self._refusals.values(),
        }
        stamp = self.get_clock().now().to_msg()
        self._diagnostics_pub.publish(self._report.message(level, text, values, stamp))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node; the entry of the executable ``strut_drive``."""
    keep_discovery_local()
    return run(StrutDriveNode, argv)


if __name__ == "__main__":
    sys.exit(main())
