"""The compensator's interface: its parameters, the files they name, its inputs and what it publishes.

Only the answers to commands are published by the loop itself, in :mod:`.compensator`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, PoseStamped
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState, TimeReference
from std_msgs.msg import Bool, ColorRGBA, String, UInt64
from visualization_msgs.msg import Marker, MarkerArray

from ..compensation.compensator import DEFAULT_RAMP_RATE, Compensator
from ..compensation.fusion import FusionRules
from ..compensation.guards import Sample
from ..compensation.journal import IDEAL_SOURCE, Journal, Source, sources_text
from ..compensation.thermal import DEFAULT_TIME_CONSTANT, HUMIDITY_RATE, Plausibility
from ..core import ffi
from ..core.batch import quaternion_of
from ..errors import HexapodError
from ..formats.paths import confined_file, confined_opener, folder_of
from ..machine.geometry import BASE, TOOL, WORK, HexapodGeometry
from ..machine.kinematics import Structure, forward_error, solve_poses, strut_lengths
from ..machine.model import MachineModel
from ..machine.model_file import IDEAL
from ..machine.robot_description import joint_positions, urdf
from ..pose import Pose
from .base import ACKNOWLEDGED_WITHIN, EVENT_QOS, LATCHED_QOS, STATE_QOS, MachineNode, profile
from .messages import PoseBytes, StrutBytes, StrutReader, command_stamp, period, read_message, read_pose, stamp_of
from .parameters import ParameterError, Program, read_table

POSES, STRUTS = "poses", "struts"  # Values of the parameter ``command_input``

# Whether the node stops the machine is published again after this time, s: late subscribers receive what is latched,
# but on a busy computer the middleware loses that now and then
REPEATED_AFTER = 1.0

# Largest time of a message, ns: later validities are limited to it
LAST_STAMP = 2**31 * 10**9 - 1

# Pages: each counts, and late subscribers need the last snapshot; a recorder's own queue is no longer than this
JOURNAL_QOS = profile(10, latched=True)

RULES = FusionRules()

PARAMETERS = read_table(f"""
autostart | true |  | start | configure and activate at the start
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
model_file | ideal |  | reload | model file: a path or the name of a shipped one; `ideal` corrects nothing, and the
    log says so
model_folder | '' |  | start | folder from which geometry and model may be read, with all below it, beside the shipped
    ones; empty: each file's own folder at the start. What leads out by `..` or a link is refused, as is what is no
    regular file or larger than 8 MB
base_frame | base |  | configure | frame_id of poses in the machine base
work_frame | work | not base_frame | configure | frame_id of poses in the geometry file's work frame
frame_prefix | '' |  | configure | in front of the names of its other work frames
tool | {TOOL} |  | always | the tool in use, by its name in the geometry file; while the machine stands
command_input | poses | poses, struts | configure | what commands: `poses` on `tool_pose_command`, or `struts`
    (nominal lengths) on `strut_setpoints`; the other topic is ignored
joint_names | [strut_1, strut_2, strut_3, strut_4, strut_5, strut_6] |  | configure | the struts' names in JointState
    messages, in strut order
command_timeout | 0.1 | 0 to 3600 s | always | a command is valid for this long; without another one the state is then
    stale; 0 = off. The deadline that the publishers offer is the one at configure
max_command_age | 0.5 | 0 to 3600 s | always | older, or newer, stamps are refused; 0 = off; a zero stamp means now
feedback_timeout | 0.1 | 0.001 to 3600 s | always | without measured struts for this long there is no feedback
max_reading_age | 0.5 | 0 to 3600 s | always | measured struts stamped older, or newer, are refused; 0 = off; a zero
    stamp means now
require_feedback | false |  | always | refuse commands while there is no feedback
start_without_feedback_after | 0.0 | 0 to 3600 s | configure | for a machine without feedback: when no struts have
    been measured for this long after the start, the first command may be anywhere within the limits; 0 = never, a
    start waits for `strut_states`
following_error_limit | 0.002 | 0 to 1 m | configure | measured struts further than this from all that was commanded
    in the last 0.1 s stop the machine until `~/reset`; 0 = off
catch_up_within | 0.1 | 0 to 3600 s | always | commands that arrive sooner than the struts may move wait at most this
    long, in their order; 0 = only the newest waits
allow_several_publishers | false |  | configure | accept commands although several nodes publish commands or
    `strut_states`, or others `strut_commands`
allow_several_thermometers | false |  | configure | accept temperatures and humidity from several publishers, one for
    each part for instance
enable_compensation | true |  | configure | compensate from the start; `~/enable_compensation` switches
ramp_rate | {DEFAULT_RAMP_RATE} | 1e-06 to 1 m/s | always | largest speed at which a change of model or switch, or the
    difference between the measured struts and the first command, moves a strut
temperature_time_constant_s | {DEFAULT_TIME_CONSTANT} | 0 to 3600 s | always | low pass of each part's temperatures, and
    of humidity; 0 = off
temperature_rate_limit | 0.2 | 0 to 1000 K/s | always | a part's temperature that jumps by more than 1 K and this rate
    is refused; 0 = off
temperature_spread_limit | 40.0 | 0 to 1000 K | always | a temperature further than this from the median of the other
    parts' is refused, from 20 °C while no other is known; 0 = off
temperature_timeout | 60.0 | 0 to 86400 s | always | a part without a temperature for this long is stale: diagnostics
    report it, and the last value stays; the same for humidity; 0 = off
humidity_rate_limit | {HUMIDITY_RATE} | 0 to 1 1/s | always | a humidity that jumps by more than 0.05 and this rate is
    refused; 0 = off
gravity | [0.0, 0.0, 0.0] | -10.6 to 10.6 m/s² | always | gravity in `base_frame` while nobody publishes `gravity`;
    zeros: the model's
gravity_dead_band | 0.0 | 0 to 1 m/s² | always | ignore a published gravity that differs by less from the one in use
outside_dead_band | 0.0 | 0 to 0.01 m | always | ignore published outside numbers at which the model's table differs by
    less from the one in use: its displacement, and its rotation times the machine's characteristic length
outside_hold | false |  | always | hold the correction for gravity, wrench and outside numbers as it is, while an
    exposure or a cut lasts
outside_timeout | 60.0 | 0 to 86400 s | always | gravity, wrench, or outside numbers, not published for this long after
    the last message are stale: diagnostics report it, and the last value stays; 0 = off
heartbeat_rate | 50.0 | 0 to 1000 Hz | always | heartbeats per second; 0 = none
marker_rate | 10.0 | 0 to 10 Hz | always | markers and joint states per second; 0 = none
fusion.enabled | false |  | configure | weigh the tool's pose that an instrument measures, `tool_pose_measured`, with
    that of the struts, and follow the machine's slow drift
fusion.compensate | false |  | always | also correct that drift, with a ramp as for a change of model; false ramps it
    out
fusion.message | pose_with_covariance | pose_with_covariance, pose | configure | the instrument's message:
    PoseWithCovarianceStamped, or PoseStamped
fusion.position_deviation | {RULES.position_deviation:.1e} | 1e-09 to 0.01 m | always | standard deviation of the
    instrument's positions where its message states none
fusion.rotation_deviation | {RULES.rotation_deviation:.1e} | 1e-09 to 0.1 rad | always | the same of its rotations
fusion.strut_deviation | {RULES.strut_deviation:.1e} | 0 to 0.001 m | always | standard deviation of a strut: its
    encoder, and the model's residual error
fusion.time_deviation | {RULES.time_deviation:.1e} | 0 to 0.1 s | always | standard deviation between the clocks of
    instrument and struts: reduces the weight of readings made in motion
fusion.drift_rate | {RULES.drift_rate:.1e} | 0 to 0.001 m | always | by how much each of the base's displacements and
    the struts may drift in a second (standard deviation; it grows with the root of time)
fusion.initial_deviation | {RULES.initial_deviation:.1e} | 1e-09 to 0.001 m | always | standard deviation of both at the
    start, and after `~/reset`
fusion.limit | {RULES.limit:.1e} | 1e-06 to 0.005 m | always | largest drift: a reading that would exceed it is
    rejected, and the drift stays
fusion.gate_probability | {RULES.gate_probability} | 0.5 to 0.999999 | always | a reading outside the region that holds
    this share of correct readings is rejected as wild (chi-square with six degrees of freedom)
fusion.timeout | 10.0 | 0 to 86400 s | always | without an accepted reading for this long, diagnostics warn; the last
    drift stays; 0 = off
publish_array | false |  | configure | also publish `strut_commands_array` for ros2_controllers, in the order of
    joint_names
publish_description | true |  | configure | publish the machine for robot_state_publisher and RViz: its URDF on
    `robot_description`, latched, and all its joints on `joint_states`; false where another node publishes these topics
""")

TOPICS = """
in   tool_pose_command       PoseStamped: commanded tool pose, frame_id a work frame; or, by command_input,
     strut_setpoints         JointState: nominal strut lengths, m; NaN while the controller is not active
     strut_states            JointState: measured strut lengths, m
     select_tool             String: tool by its name, for controllers; as parameter tool
     temperatures            Temperature: °C; frame_id names strut_1 to strut_6, base or platform
     humidity                RelativeHumidity: 0 to 1; for struts that swell
     gravity                 Vector3Stamped: in base, m/s²; for a model with a load block
     wrench                  WrenchStamped: on the platform beside weight; frame_id platform, or the tool in use
     outside                 JointState: outside numbers by name, rad, m or °C; for a model with a table of them
     tool_pose_measured      PoseWithCovarianceStamped: an instrument's, with fusion.enabled
out  strut_commands          JointState: compensated strut lengths, m
     strut_commands_array    Float64MultiArray: the commands in joint order, with publish_array
     strut_corrections       JointState: command − nominal, m
     nominal_strut_states    JointState: with strut_setpoints, measured struts less the corrections, m
     tool_pose_estimate      PoseStamped: from measured struts, in base
     ~/predicted_error       PoseWithCovarianceStamped: the tool's error without compensation, in work;
     ~/predicted_error_aligned  the same with the datum aligned
     ~/tool                  String, latched: the tool in use
     ~/travel                DiagnosticStatus: how far the tool may go from here, 1 Hz
     ~/stopped               Bool, latched: commands are refused
     ~/heartbeat, ~/validity UInt64, TimeReference: until when the newest command is valid
     joint_states            JointState: all joints of the machine's URDF
     robot_description       String, latched: that URDF, of the geometry in use
     /diagnostics, ~/markers, ~/journal, ~/files
ask  ~/enable_compensation   SetBool
     ~/reload_model, ~/reset Trigger
     ~/get_travel            Trigger: how far the tool may go from here
"""

PROGRAM = Program(
    "compensator",
    "Compensates a hexapod's errors: tool poses in, strut commands out.",
    PARAMETERS,
    TOPICS,
    "-p geometry_file:=mine.yaml -p model_file:=model.yaml",
)


def temperature_rules(options: dict[str, Any]) -> tuple[Plausibility, float]:
    """Return the limits for temperatures, and the time constant of their filter, s, from the parameters."""
    rules = Plausibility(
        rate=options["temperature_rate_limit"],
        spread=options["temperature_spread_limit"],
        timeout=options["temperature_timeout"],
        humidity_rate=options["humidity_rate_limit"],
    )
    return rules, options["temperature_time_constant_s"]


def frame_ids(geometry: HexapodGeometry, options: dict[str, Any]) -> dict[str, str]:
    """Return the ``frame_id`` of poses in each frame of a machine, by the machine's names; a ParameterError if another
    work frame's is that of the base or the usual work frame."""
    ids = {BASE: options["base_frame"], WORK: options["work_frame"]}
    for name in geometry.work_frames:
        frame_id = ids.setdefault(name, f"{options['frame_prefix']}{name}")
        if name not in (BASE, WORK) and frame_id in (ids[BASE], ids[WORK]):
            raise ParameterError(f"parameter frame_prefix: with it work frame {name!r} has the frame_id of another")
    return ids


class MachineFiles:
    """Geometry and model, as the parameters name them, each from its folder at the start or from ``model_folder``.

    `sources` holds the texts read last, unchanged: ``geometry`` and ``model``.
    """

    def __init__(self, options: dict[str, Any]) -> None:
        self._options, configured = options, options["model_folder"]
        folder = Path(configured).expanduser() if configured else None
        if folder is not None and not folder.is_dir():
            raise ParameterError(f"parameter model_folder: {configured!r} is not a folder")
        self._folders = {kind: folder or folder_of(options[f"{kind}_file"]) for kind in ("geometry", "model")}
        self.sources: dict[str, Source] = {}

    @property
    def ideal(self) -> bool:
        """Whether the model is the ideal one, which has no file."""
        return bool(self._options["model_file"] == IDEAL)

    def made_of(self) -> dict[str, Any]:
        """Return what the worker's process needs to make geometry and model from the same texts."""
        folder = self._folders["model"]
        return {**self.sources, "folder": None if folder is None else str(folder)}

    def model_place(self) -> tuple[str, str, str | None]:
        """Return name, the folder that relative paths start from (where it was deleted, only absolute ones are found),
        and the folder in which it must be: the file is not opened here."""
        try:
            place = os.getcwd()
        except FileNotFoundError:
            place = os.sep
        folder = self._folders["model"]
        return self._options["model_file"], place, None if folder is None else str(folder)

    def geometry(self) -> HexapodGeometry:
        self.sources["geometry"] = self._read("geometry")
        return self.sources["geometry"].geometry()

    def model(self, geometry: HexapodGeometry) -> MachineModel:
        self.sources["model"] = IDEAL_SOURCE if self.ideal else self._read("model")
        return self.sources["model"].model(geometry.name)

    def _read(self, kind: str) -> Source:
        folder = self._folders[kind]
        return Source.read(confined_file(self._options[f"{kind}_file"], folder, kind), confined_opener(folder))


# ---- what comes in ----


class PoseInput:
    """Tool poses on ``tool_pose_command``."""

    topic, kind = "tool_pose_command", PoseStamped

    read = staticmethod(read_pose)
    """Reads a command into a sample: stamp, frame and the seven numbers of a pose; without values nothing is commanded
    yet."""

    def stamp(self, data: bytes) -> int:
        """Return the stamp of a command, ns; 0 if it has none."""
        sample = Sample(0.0)
        try:
            self.read(data, sample)
        except HexapodError:
            return 0
        return sample.stamp


class StrutInput(PoseInput):
    """Nominal strut lengths on ``strut_setpoints``, m, by name: what a controller that plans struts itself commands a
    machine without errors.

    They become the tool pose of that machine at once: limits, stamps, journal and replay only use poses. The strut
    readings that such a controller receives are nominal too.
    """

    topic, kind = "strut_setpoints", JointState

    def __init__(self, compensator: Compensator, names: list[str], frame_id: str) -> None:
        # the search for the pose starts from its last command
        self._compensator, self._frame_id = compensator, frame_id
        self._structure, self._reader = Structure.of(compensator.geometry), StrutReader(names)

    def read(self, data: bytes, sample: Sample) -> None:  # type: ignore[override]
        """As for poses; no values while all lengths are NaN: ros2_control publishes NaN until one of its controllers is
        active. A KinematicsError: no pose near the last command, nor near home, has these lengths."""
        message = read_message(data, JointState)
        sample.stamp, sample.frame_id = command_stamp(message.header.stamp), self._frame_id
        lengths = self._reader.pick(message)
        if np.isnan(lengths).all():
            return
        self._reader.check(lengths.tolist())
        guesses = [self._compensator.geometry.home]
        if np.isfinite(self._compensator.nominal).all():  # else there was no command yet
            guesses.insert(0, self._compensator.platform)
        for guess in guesses:
            solved = solve_poses(self._structure, lengths[None], guess, threads=1)
            if solved.ok[0]:
                tool = Pose(solved.positions[0], solved.rotations[0]) @ self._compensator.geometry.tool
                sample.values = (*tool.position.tolist(), *quaternion_of(tool.rotation))
                return
        raise forward_error(int(solved.outcomes[0]), float(solved.conditions[0]), self._structure.max_condition)


def command_input(compensator: Compensator, options: dict[str, Any]) -> PoseInput:
    """Return the input selected by a node's parameters."""
    if options["command_input"] == STRUTS:
        return StrutInput(compensator, options["joint_names"], options["base_frame"])
    return PoseInput()


# ---- what goes out ----


def nominal_lengths(compensator: Compensator, measured: np.ndarray) -> np.ndarray:
    """Return measured struts minus the correction, shape (6,), m, for a controller of nominal lengths.

    With the measured ones it would count the corrections as a distance to go, and at each start from the struts'
    positions they would be corrected once more. Before the first command the model's correction is used, where it
    corrects.
    """
    if np.isfinite(compensator.correction).all():
        return measured - compensator.correction
    if not compensator.enabled:
        return measured
    tool = compensator.estimate(measured)
    pose = Pose(tool[:3], tool[3:].reshape((3, 3)))
    return strut_lengths(compensator.geometry, pose @ compensator.geometry.tool.inverse())


class Outputs:
    """What a configured compensator publishes beside its answers: estimates, markers of the machine, its description,
    and what a machine's own safety watches: a heartbeat, how long a command holds, whether commands are refused."""

    def __init__(
        self, node: MachineNode, compensator: Compensator, options: dict[str, Any], command_topic: str
    ) -> None:
        self._node, self._compensator, self._options = node, compensator, options
        self._frame, self._names = options["base_frame"], options["joint_names"]
        self.answered = 0  # stamp of the newest command, ns; 0: there is none
        self._estimates = node.publish_on(PoseStamped, "tool_pose_estimate", STATE_QOS)
        self._markers = node.create_publisher(MarkerArray, "~/markers", EVENT_QOS)
        self._heartbeats = node.create_publisher(UInt64, "~/heartbeat", EVENT_QOS)
        self._validities = node.create_publisher(TimeReference, "~/validity", EVENT_QOS)
        self._stops = node.create_publisher(Bool, "~/stopped", LATCHED_QOS)
        self._joints = self._description = self._nominal = None
        below = options["command_input"] == STRUTS
        if options["publish_description"]:
            self._joints = node.create_publisher(JointState, "joint_states", EVENT_QOS)
            self._description = node.create_publisher(String, "robot_description", LATCHED_QOS)
            self._description.publish(String(data=urdf(compensator.geometry, self._names, ros2_control=below)))
        if below:
            self._nominal = node.publish_on(JointState, "nominal_strut_states", STATE_QOS)
        self._nominal_out, self._estimate_out = StrutBytes(names=self._names), PoseBytes(self._frame)
        self._beat, self._validity = UInt64(), TimeReference(source=command_topic)
        self._stopped: bool | None = None
        self._stop_said = 0.0
        self.stop(True)
        node.at_rate("heartbeat_rate", self._beats)
        node.at_rate("marker_rate", self._show)

    def estimate(self, pose: np.ndarray, stamp: int) -> None:
        """Publish a tool pose, shape (12,), position, m, and rotation matrix by rows, where somebody subscribes."""
        if self._estimates.get_subscription_count():
            self._estimates.publish(self._estimate_out.made(pose, stamp))

    def nominal(self, stamp: int, mean: Callable[[], np.ndarray]) -> None:
        """Publish nominal lengths of the measured struts, from which a controller starts and which it holds: the
        average for struts at rest."""
        if self._nominal is not None:
            out, fastest = self._nominal_out, self._compensator.geometry.limits.speed
            lengths = np.ascontiguousarray(nominal_lengths(self._compensator, mean()))
            at = ffi.from_buffer("double[6]", lengths)
            self._nominal.publish(out.made(at, stamp, period(out.stamp, stamp), fastest))

    def stop(self, stopped: bool) -> None:
        """Publish whether the node stops the machine, when that has changed and every :data:`REPEATED_AFTER`."""
        now = time.monotonic()
        if stopped != self._stopped or now - self._stop_said > REPEATED_AFTER:
            self._stopped, self._stop_said = stopped, now
            self._stops.publish(Bool(data=stopped))

    def wait(self) -> None:
        """Wait until the last ~/stopped has arrived."""
        self._stops.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def _beats(self) -> None:
        self._beat.data = (self._beat.data + 1) % 2**64
        if self._heartbeats.get_subscription_count():
            self._heartbeats.publish(self._beat)
        lasting = round(self._options["command_timeout"] * 1e9)
        if self.answered and lasting and self._validities.get_subscription_count():
            self._validity.header.stamp = stamp_of(self.answered)
            self._validity.time_ref = stamp_of(min(self.answered + lasting, LAST_STAMP))
            self._validities.publish(self._validity)

    def _show(self) -> None:
        """Publish the machine as markers and as the joints of its URDF, where somebody subscribes; before the first
        command its struts have no corrections."""
        if not self._node.active:
            return
        now, pose = self._node.get_clock().now().to_msg(), self._compensator.platform_estimate
        geometry = self._compensator.geometry
        if self._markers.get_subscription_count():
            correction = np.zeros(6) if np.isnan(self._compensator.nominal).any() else self._compensator.correction
            self._markers.publish(machine_markers(geometry, *pose, correction, self._frame, now))
        if self._joints is not None and self._joints.get_subscription_count():
            positions = joint_positions(geometry, Pose(*pose), self._names)
            message = JointState(name=list(positions), position=list(positions.values()))
            message.header.stamp = now
            self._joints.publish(message)


class JournalTopics:
    """``~/journal`` and ``~/files``, which make a recording of a run replayable: the pages of
    :mod:`hexapod_comp.compensation.journal`, and geometry and model in use, unchanged.

    Both are reliable and kept for late subscribers, so that a recorder that starts during a motion gets what it needs.
    Nothing is published while a command is handled: events are stored, and published with :meth:`tick`.
    """

    def __init__(
        self, node: MachineNode, compensator: Compensator, sources: dict[str, Source], frame_ids: dict[str, str]
    ) -> None:
        self._sources, self._published = sources, dict[str, Source]()
        self._pages: Publisher = node.create_publisher(String, "~/journal", JOURNAL_QOS)
        self._files: Publisher = node.create_publisher(String, "~/files", JOURNAL_QOS)
        self._journal = Journal(compensator, sources, frame_ids, node.get_parameter("joint_names").value)
        self.answered, self.refused = self._journal.answered, self._journal.refused
        self.tick(time.monotonic())  # so that no command comes before the first page

    def tick(self, now: float) -> None:
        """Publish what is due: new files, then a page."""
        if not self._journal.due(now):
            return
        if self._sources != self._published:
            self._files.publish(String(data=sources_text(self._sources)))
            self._published = dict(self._sources)
        self._pages.publish(String(data=self._journal.page(now)))

    def finish(self, now: float) -> None:
        """Publish a last page, with the answers since the previous one, and wait for its arrival."""
        self._pages.publish(String(data=self._journal.page(now)))
        self._pages.wait_for_all_acked(ACKNOWLEDGED_WITHIN)


# ---- markers ----

STRUT_DIAMETER = 0.02
JOINT_DIAMETER = 0.035
LIFETIME = Duration(sec=1)  # Lifetime of markers: a machine that is not updated disappears instead of seeming alive

GREY = ColorRGBA(r=0.5, g=0.5, b=0.55, a=1.0)
STEEL = ColorRGBA(r=0.3, g=0.35, b=0.45, a=0.9)


def machine_markers(
    geometry: HexapodGeometry,
    position: np.ndarray,
    rotation: np.ndarray,
    correction: np.ndarray,
    frame_id: str,
    stamp: Time,
) -> MarkerArray:
    """Return the machine at a platform pose."""
    base = geometry.base_joints
    platform = position + geometry.platform_joints @ rotation.T
    tip = position + rotation @ geometry.tool.position + 0.1 * rotation[:, 2]
    markers: list[Marker] = []
    for kind, size, colour, points in (
        (Marker.LINE_LIST, STRUT_DIAMETER, None, [end for ends in zip(base, platform, strict=True) for end in ends]),
        (Marker.SPHERE_LIST, JOINT_DIAMETER, GREY, (*base, *platform)),
        (Marker.LINE_STRIP, STRUT_DIAMETER, STEEL, (*platform, platform[0])),
        (Marker.LINE_STRIP, STRUT_DIAMETER, GREY, (*base, base[0])),
        (Marker.ARROW, STRUT_DIAMETER, STEEL, (position, tip)),
    ):
        marker = Marker(ns="hexapod", id=len(markers), type=kind, action=Marker.ADD, lifetime=LIFETIME)
        marker.header.frame_id, marker.header.stamp = frame_id, stamp
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = size
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in np.array(points).tolist()]
        if colour is not None:
            marker.color = colour
        else:  # the struts, each in its own colour
            marker.color.a = 1.0
            marker.colors = [correction_colour(amount) for amount in correction for _ in range(2)]
        markers.append(marker)
    return MarkerArray(markers=markers)


def correction_colour(correction: float) -> ColorRGBA:
    """Return blue for −100 µm, white for 0, red for +100 µm and beyond."""
    share = max(-1.0, min(1.0, correction / 100e-6))
    rest = 1.0 - abs(share)
    return ColorRGBA(r=1.0 if share > 0 else rest, g=rest, b=1.0 if share < 0 else rest, a=1.0)
