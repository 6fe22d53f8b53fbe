"""The simulated strut-drive node: receives strut commands, publishes encoder readings and the true tool pose.

Run the node with ``ros2 run hexapod_comp strut_drive`` or ``python -m hexapod_comp.ros.strut_drive``.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState

from ..compensation.guards import Sample, StampGate, StrutSteps
from ..errors import HexapodError, KinematicsError
from ..formats.paths import config_file
from ..machine.geometry import STRUT_NAMES, load_geometry
from ..machine.load import Payload
from ..machine.model import RealMachine
from ..virtual.machine import DriveParameters, Faults, StrutDrive
from ..virtual.named import RANDOM, find_model, is_word
from .base import ERROR, OK, STATE_QOS, WARN, CommandedNode
from .messages import StrutBytes, StrutReader, stamp_of, write_pose
from .parameters import Program, read_table
from .process import run

LONGEST_PAUSE = 0.25  # Longest time by which the simulation advances after a pause of the process, s

PARAMETERS = read_table("""
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
truth_file | paper_machine.yaml |  | configure | true errors of the simulated machine: a model file, `ideal` for no
    errors, `random` for errors drawn with truth_seed, or `random:SEED`
plant | rigid | rigid, mujoco | configure | simulation of the machine on the struts: rigid, with the errors of
    truth_file, or elastic by MuJoCo with `physics.*` (pip install mujoco-core)
physics.strut_stiffness | 2.0e+7 | 1e5 to 1e12 N/m | configure | stiffness of a strut along its axis
physics.joint_stiffness | 0.0 | 0 to 1e12 N/m | configure | stiffness of each of a strut's two joints, along the strut;
    0 = rigid
physics.clearance | 0.0 | 0 to 0.001 m | configure | difference of a strut's length between pull and push
physics.friction | 0.0 | 0 to 1000 N·m | configure | friction torque of a strut's bearings about each of two hinge axes;
    sum of both ends
physics.strut_mass | 0.0 | 0 to 1e5 kg | configure | mass of a strut
physics.mass | 20.0 | 0.001 to 1e5 kg | configure | mass of the platform
physics.centre | [0.0, 0.0, 0.0] | -100 to 100 m | configure | platform's centre of mass in its own frame
physics.payload_mass | 0.0 | 0 to 1e5 kg | configure | mass of tool and payload; 0 = tool's mass in the geometry file
physics.payload_centre | [0.0, 0.0, 0.0] | -100 to 100 m | configure | payload's centre of mass in the platform's frame
physics.gravity | [0.0, 0.0, -9.80665] | -100 to 100 m/s² | configure | gravity in the room
physics.base_tilt | [0.0, 0.0] | -3.2 to 3.2 rad | configure | rotation of the base in the room, about its x and y axis
physics.warmth | [0.0, 0.0, 0.0, 0.0, 0.0, 0.0] | -100 to 100 K | configure | temperature of each steel strut minus the
    reading of its thermometer
physics.damping | 0.1 | 0 to 10 | configure | damping of the struts' oscillation, as a share of the critical damping
truth_seed | 1 | 0 to 2147483647 | configure | seed of the errors drawn for `random`
noise_seed | 0 | 0 to 2147483647 | configure | seed of the measurement noise
base_frame | base |  | configure | frame_id of the true tool pose
joint_names | [strut_1, strut_2, strut_3, strut_4, strut_5, strut_6] |  | configure | the struts' names in JointState
    messages, in strut order
command_timeout | 0.1 | 0 to 3600 s | always | time without a command after which diagnostics warn; 0 = off
command_validity | 0.0 | 0 to 3600 s | always | commands whose stamps are older than this are refused; 0 = off
allow_several_publishers | false |  | configure | accept strut commands from several publishers
rate | 500.0 | 1 to 2000 Hz | configure | readings published per second
step | 1.0e-7 | 0 to 0.001 m | configure | length of one motor step; 0 = none
lag | 0.005 | 0.001 to 1 s | configure | time by which the drives lag behind a moving command
max_speed | 0.0 | 0 to 10 m/s | configure | largest motor speed; 0 = the geometry's limit
max_acceleration | 10.0 | 0.001 to 1e4 m/s² | configure | largest motor acceleration
encoder_resolution | 1.0e-7 | 0 to 0.001 m | configure | length of one encoder count; 0 = none
encoder_noise | 5.0e-8 | 0 to 0.001 m | configure | standard deviation of an encoder reading
tracker_noise | 0.0 | 0 to 0.001 m | configure | standard deviation of the true pose's coordinates
fault_stuck_strut | 0 | 0 to 6 | always | number of the strut that does not move; 0 = none
fault_encoder_lost | 0 | 0 to 6 | always | number of the strut whose encoder reads NaN; 0 = none
fault_feedback_delay | 0.0 | 0 to 10 s | always | delay after which readings are published
fault_feedback_drop | 0.0 | 0 to 1 | always | share of readings that are never published
fault_jump_strut | 1 | 1 to 6 | always | number of the strut that fault_jump displaces
fault_jump | 0.0 | -0.1 to 0.1 m | always | sudden displacement of a strut; each setting displaces it once
fault_longer | [0.0, 0.0, 0.0, 0.0, 0.0, 0.0] | -0.01 to 0.01 m | always | true length of each strut minus its encoder's
    reading, as after a crash; 0 = no difference
""")

TOPICS = """
in   strut_commands   JointState: strut lengths, m
out  strut_states     JointState: encoder readings, m
     tool_pose_true   PoseStamped: true pose of the tool, in base
     /diagnostics
"""

PROGRAM = Program(
    "strut_drive",
    "Simulates six strut drives and a machine with errors that the compensator does not know.",
    PARAMETERS,
    TOPICS,
    "-p truth_file:=random -p truth_seed:=3",
)


class StrutDriveNode(CommandedNode):
    def __init__(self, **options: Any) -> None:
        super().__init__("strut_drive", PARAMETERS, **options)

    # ---- lifecycle ----

    def configure(self) -> None:
        options, names = self.options, self.options["joint_names"]
        self._reader, self._states_out, self._true_out = StrutReader(names), StrutBytes(names=names), PoseStamped()
        self._true_out.header.frame_id = options["base_frame"]
        geometry = load_geometry(config_file(options["geometry_file"], "geometry"))
        name = options["truth_file"]
        if name == RANDOM:
            name = f"{RANDOM}:{options['truth_seed']}"
        machine = RealMachine(geometry, find_model(name if is_word(name) else config_file(name, "model"), geometry))
        values = {one.name: options[one.name] for one in fields(DriveParameters) if one.name in options}
        parameters = DriveParameters(**values | {"max_speed": options["max_speed"] or None})
        if options["plant"] == "mujoco":
            machine = bending(machine, options)
        self.drive = StrutDrive(machine, parameters, options["noise_seed"])
        self.drive.faults = self._faults()
        self._tool_in_base()
        self._states_pub = self.publish_on(JointState, "strut_states", STATE_QOS)
        self._true_pub = self.publish_on(PoseStamped, "tool_pose_true", STATE_QOS)
        several = options["allow_several_publishers"]
        self.command_sender = self.subscribe_exclusive(JointState, "strut_commands", self._on_commands, several)
        self._stamps = StampGate("command", self.clock, options["command_validity"], future=False)
        self._steps = StrutSteps(geometry.limits.step, geometry.limits.speed)
        self.command_guards = self.command_sender, self._stamps, self._steps
        self.set_hardware_id(geometry.name)
        self.every(1.0 / options["rate"], self._run)
        what = f"machine {geometry.name!r}, whose true errors are the model {machine.model.name!r}"
        self.get_logger().info(f"configured {what}")

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._steps.reset(self.drive.motor_lengths().tolist())
        self._last_run = time.monotonic()
        return super().on_activate(state)

    # ---- faults ----

    def on_parameters(self, names: set[str]) -> None:
        """Apply parameters that were set while the node runs; only a setting of ``fault_jump`` displaces a strut."""
        if self.configured:
            self._stamps.max_age = self.options["command_validity"]
            faults = self._faults()
            self.drive.faults = faults if "fault_jump" in names else replace(faults, jump=None)

    def _faults(self) -> Faults:
        options, jump = self.options, self.options["fault_jump"]
        struts = options["fault_stuck_strut"], options["fault_encoder_lost"]
        stuck, lost = (number - 1 if number else None for number in struts)
        return Faults(
            stuck=stuck,
            encoder_lost=lost,
            feedback_delay=options["fault_feedback_delay"],
            feedback_drop=options["fault_feedback_drop"],
            jump=(options["fault_jump_strut"] - 1, jump) if jump else None,
            longer=tuple(options["fault_longer"]),
        )

    # ---- the machine ----

    def update_publishers(self) -> None:
        self.command_sender.update(time.monotonic())

    def _on_commands(self, data: bytes, sample: Sample) -> None:
        if not self._active:
            return
        try:
            self._reader.sample(data, sample)
            for guard in self.command_guards:
                guard.check(sample)
        except HexapodError as error:
            self.refusals.add(error.reason, str(error), sample.now)
            self.log_warning(error.reason, f"command refused ({error.reason}): {error}")
            return
        self.drive.set_command(np.array(sample.values))
        for guard in self.command_guards:
            guard.accept(sample)
        self.commands.tick(sample.now)

    def _run(self) -> None:
        if not self._active:
            return
        now = time.monotonic()
        self.drive.advance(min(now - self._last_run, LONGEST_PAUSE))
        self._last_run = now
        stamp = self.get_clock().now().nanoseconds
        if self.drive.feedback_arrived:
            out = self._states_out
            out.position[:] = self.drive.encoder_lengths()
            out.velocity[:] = self.drive.encoder_speeds()
            self._states_pub.publish(out.encoded(None, stamp))
        try:
            self._tool_in_base()
        except KinematicsError as error:
            self.log_warning(
                "true pose", f"no true pose: the platform cannot be assembled at these strut lengths: {error}"
            )
            return
        self._true_out.header.stamp = stamp_of(stamp)
        self._true_pub.publish(self._true_out)

    def _tool_in_base(self) -> None:
        """Write the tracker's reading of the true tool pose, in ``base``, into the message for ``tool_pose_true``."""
        pose = self.drive.machine.geometry.work @ self.drive.tracker_pose()
        write_pose(self._true_out, pose.position, pose.rotation)

    # ---- state ----

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        if self.drive.stopped.any():
            yield ERROR, f"at the travel stop: {', '.join(np.array(STRUT_NAMES)[self.drive.stopped])}"
        yield from self.refusing(now)
        missing = self.command_sender.missing(now)
        if self.silent(now):
            yield WARN, "no new command"
        elif missing:
            yield WARN, "running, commands are being missed"
        yield OK, "running" if self.commands.count else "waiting for the first command"

    def values(self, now: float) -> dict[str, str]:
        return {"senders_clock_set_back": str(self._stamps.sender_set_back), **self.command_values(now)}


def bending(machine: RealMachine, options: Mapping[str, Any]) -> RealMachine:
    """Return the machine as MuJoCo simulates it: elastic, with the values of the parameters ``physics.*``."""
    from ..virtual.physics import PhysicalMachine, Physics  # MuJoCo is an extra, imported only when it is used

    values = {name.removeprefix("physics."): value for name, value in options.items() if name.startswith("physics.")}
    payload = Payload(values.pop("payload_mass"), tuple(values.pop("payload_centre")))
    values["joint_stiffness"] = values["joint_stiffness"] or math.inf
    return PhysicalMachine(machine, Physics(payload=payload if payload.mass else None, **values))


main = partial(run, StrutDriveNode, PROGRAM)

if __name__ == "__main__":
    sys.exit(main())
