"""The compensator's parameters, its geometry and model files, and its state with counters and diagnostics."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..compensation.compensator import DEFAULT_RAMP_RATE, Compensator
from ..compensation.fusion import FusionRules
from ..compensation.guards import EventWindow, OneSender, StampGate
from ..compensation.journal import IDEAL_SOURCE, Source
from ..compensation.thermal import DEFAULT_TIME_CONSTANT, HUMIDITY_RATE, Plausibility, Thermometers
from ..compensation.track import StrutTrack
from ..formats.paths import confined_file, confined_opener, folder_of
from ..machine.geometry import BASE, TOOL, WORK, HexapodGeometry
from ..machine.model import MachineModel
from ..machine.model_file import IDEAL
from ..machine.temperatures import HUMIDITY, REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE
from .base import ERROR, OK, WARN, CommandedNode, Flow, Refusals, seconds
from .parameters import ParameterError, Program, read_table

if TYPE_CHECKING:
    from .inputs import Loads, PoseInstrument

POSES, STRUTS = "poses", "struts"  # Values of the parameter ``command_input``
NEAR_SINGULAR = 0.9  # Diagnostics warn if the condition number is above this share of its limit
RULES = FusionRules()

PARAMETERS = read_table(f"""
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
model_file | ideal |  | reload | model file: a path or the name of a shipped one; `ideal` corrects nothing, and the log
    states this
model_folder | '' |  | start | geometry and model files must be in this folder or its subfolders, except shipped files;
    empty: the folder of each file at the start. A path that leaves the folder by `..` or a link, and a file that is
    larger than 8 MB or not regular, are refused
base_frame | base |  | configure | frame_id of poses in the machine base
work_frame | work | not base_frame | configure | frame_id of poses in the geometry file's work frame
frame_prefix | '' |  | configure | prefix of the frame_ids of the geometry file's named work frames
tool | {TOOL} |  | always | name of the tool in use, from the geometry file; may be changed while the machine stands
command_input | poses | poses, struts | configure | form of the commands: `poses` on `tool_pose_command`, or `struts`
    (nominal lengths) on `strut_setpoints`; the other topic is ignored
joint_names | [strut_1, strut_2, strut_3, strut_4, strut_5, strut_6] |  | configure | the struts' names in JointState
    messages, in strut order
command_timeout | 0.1 | 0 to 3600 s | always | time for which a command is valid; diagnostics warn if no new command
    arrives in this time; 0 = off. The publishers offer the value that is set at `configure` as their DDS deadline
max_command_age | 0.5 | 0 to 3600 s | always | commands whose stamps differ from the clock by more than this are
    refused; 0 = off; a zero stamp means now
feedback_timeout | 0.1 | 0.001 to 3600 s | always | time without measured struts after which feedback counts as missing
max_reading_age | 0.5 | 0 to 3600 s | always | measured struts whose stamps differ from the clock by more than this are
    refused; 0 = off; a zero stamp means now
require_feedback | false |  | always | refuse commands while feedback is missing
start_without_feedback_after | 0.0 | 0 to 3600 s | configure | for a machine without feedback: if no measured struts
    have arrived within this time after activation, the first command may be anywhere within the limits; 0 = wait for
    `strut_states`
following_error_limit | 0.002 | 0 to 1 m | configure | a measured strut further than this from all its commands of the
    last 0.1 s stops the machine until `~/reset`; 0 = off
catch_up_within | 0.1 | 0 to 3600 s | always | longest wait of commands that arrive faster than the struts may move
    and are answered in their order; 0 = only the newest command waits
allow_several_publishers | false |  | configure | accept commands although several nodes publish commands or
    `strut_states`, or other nodes publish `strut_commands`
allow_several_thermometers | false |  | configure | accept temperatures and humidity from several publishers, for
    example one for each part
enable_compensation | true |  | configure | compensation is on after configure; `~/enable_compensation` switches it
ramp_rate | {DEFAULT_RAMP_RATE} | 1e-06 to 1 m/s | always | largest strut speed that a ramp adds: after a change of
    model, temperature or on/off state, or if the first command differs from the measured struts
temperature_time_constant_s | {DEFAULT_TIME_CONSTANT} | 0 to 3600 s | always | time constant of the low-pass filter of
    each temperature and of humidity; 0 = off
temperature_rate_limit | 0.2 | 0 to 1000 K/s | always | a temperature that differs from the part's last temperature
    by more than 1 K plus this rate times the time since then is refused; 0 = off
temperature_spread_limit | 40.0 | 0 to 1000 K | always | a part's temperature that differs by more than this from the
    median of the other parts (from 20 °C if no other part is known) is refused; 0 = off
temperature_timeout | 60.0 | 0 to 86400 s | always | time after which a part's last temperature, or the last humidity,
    is stale: diagnostics warn, and the stale value stays in use; 0 = off
humidity_rate_limit | {HUMIDITY_RATE} | 0 to 1 1/s | always | refuse a humidity (0 to 1) that differs from the
    last one by more than 0.05 + this rate × the time since the last one; 0 = off
gravity | [0.0, 0.0, 0.0] | -10.6 to 10.6 m/s² | always | gravity in `base_frame` if no node publishes `gravity`;
    zeros: the gravity of the model file
gravity_dead_band | 0.0 | 0 to 1 m/s² | always | ignore a published gravity that differs by less than this from the
    gravity in use
outside_dead_band | 0.0 | 0 to 0.01 m | always | ignore published external quantities (topic `outside`) that change
    the error of the model's table by less than this; a rotation counts as rotation × characteristic length
outside_hold | false |  | always | keep the present correction for gravity, wrench and external quantities, for
    example during an exposure or a cut
outside_timeout | 60.0 | 0 to 86400 s | always | time after which the last gravity, wrench or external quantities
    are stale: diagnostics warn, and the stale values stay in use; 0 = off
heartbeat_rate | 50.0 | 0 to 1000 Hz | always | heartbeats per second; 0 = none
marker_rate | 10.0 | 0 to 10 Hz | always | markers and joint states per second; 0 = none
fusion.enabled | false |  | configure | combine the tool's pose that an instrument measures, on `tool_pose_measured`,
    with the pose from the struts, and estimate the machine's slow drift
fusion.compensate | false |  | always | also correct the estimated drift, with a ramp; false: the correction ramps out
fusion.message | pose_with_covariance | pose_with_covariance, pose | configure | type of the instrument's messages:
    PoseWithCovarianceStamped or PoseStamped
fusion.position_deviation | {RULES.position_deviation:.1e} | 1e-09 to 0.01 m | always | standard deviation of the
    instrument's positions if its message states none
fusion.rotation_deviation | {RULES.rotation_deviation:.1e} | 1e-09 to 0.1 rad | always | standard deviation of the
    instrument's rotations if its message states none
fusion.strut_deviation | {RULES.strut_deviation:.1e} | 0 to 0.001 m | always | standard deviation of a strut's length:
    encoder and residual error of the model
fusion.time_deviation | {RULES.time_deviation:.1e} | 0 to 0.1 s | always | standard deviation of the time difference
    between the stamps of instrument and struts; it reduces the weight of readings made in motion
fusion.drift_rate | {RULES.drift_rate:.1e} | 0 to 0.001 m | always | standard deviation of the drift of each base
    displacement and strut in one second; it grows with the square root of time
fusion.initial_deviation | {RULES.initial_deviation:.1e} | 1e-09 to 0.001 m | always | standard deviation of the drift
    of base and struts at the start and after `~/reset`
fusion.limit | {RULES.limit:.1e} | 1e-06 to 0.005 m | always | largest estimated drift; a reading that
    would make the drift larger is rejected
fusion.gate_probability | {RULES.gate_probability} | 0.5 to 0.999999 | always | a reading outside the region that holds
    this share of correct readings is rejected as an outlier (chi-square with six degrees of freedom)
fusion.timeout | 10.0 | 0 to 86400 s | always | time without an accepted reading after which diagnostics warn; the last
    drift stays in use; 0 = off
publish_array | false |  | configure | also publish `strut_commands_array` for ros2_controllers, in the order of
    joint_names
publish_description | true |  | configure | publish the machine's URDF on `robot_description` (latched) and all its
    joints on `joint_states`, for robot_state_publisher and RViz; false if another node publishes these topics
""")

TOPICS = """
in   tool_pose_command       PoseStamped: commanded tool pose, in base or a work frame (command_input: poses)
     strut_setpoints         JointState: nominal strut lengths, m (command_input: struts); NaN is ignored
     strut_states            JointState: measured strut lengths, m
     select_tool             String: name of the tool to use, for controllers; sets the parameter tool
     temperatures            Temperature: °C; frame_id names strut_1 to strut_6, base or platform
     humidity                RelativeHumidity: 0 to 1; for a model of struts that swell
     gravity                 Vector3Stamped: in base, m/s²; for a model with a load block
     wrench                  WrenchStamped: forces on the platform besides weight; frame_id: platform or the tool
     outside                 JointState: external quantities by name, rad, m or °C; for a model with an outside table
     tool_pose_measured      PoseWithCovarianceStamped: tool pose of an instrument, with fusion.enabled
out  strut_commands          JointState: compensated strut lengths, m
     strut_commands_array    Float64MultiArray: the commands in joint order, with publish_array
     strut_corrections       JointState: command − nominal, m
     nominal_strut_states    JointState: with strut_setpoints: measured struts minus the corrections, m
     tool_pose_estimate      PoseStamped: from measured struts, in base
     ~/predicted_error       PoseWithCovarianceStamped: the tool's error without compensation, in work;
     ~/predicted_error_aligned  the same error after best-fit alignment
     ~/tool                  String, latched: name of the tool in use
     ~/travel                DiagnosticStatus: the tool's travel from the present pose in each axis, 1 Hz
     ~/stopped               Bool, latched: true while commands are refused
     ~/heartbeat, ~/validity UInt64, TimeReference: counter; time until which the newest command is valid
     joint_states            JointState: all joints of the machine's URDF
     robot_description       String, latched: URDF of the geometry in use
     /diagnostics, ~/markers, ~/journal, ~/files
ask  ~/enable_compensation   SetBool
     ~/reload_model, ~/reset Trigger
     ~/get_travel            Trigger: the tool's travel from the present pose, as a table
"""

PROGRAM = Program(
    "compensator",
    "Compensates a hexapod's errors: receives tool poses, publishes strut commands.",
    PARAMETERS,
    TOPICS,
    "-p geometry_file:=mine.yaml -p model_file:=model.yaml",
)


def temperature_rules(options: dict[str, Any]) -> tuple[Plausibility, float]:
    """Return the limits of plausible temperatures and humidity, and their low-pass filter's time constant, s."""
    rules = Plausibility(
        rate=options["temperature_rate_limit"],
        spread=options["temperature_spread_limit"],
        timeout=options["temperature_timeout"],
        humidity_rate=options["humidity_rate_limit"],
    )
    return rules, options["temperature_time_constant_s"]


def frame_ids(geometry: HexapodGeometry, options: dict[str, Any]) -> dict[str, str]:
    """Return the ``frame_id`` of each frame by the frame's name; raise a ParameterError if two would be equal."""
    ids = {BASE: options["base_frame"], WORK: options["work_frame"]}
    for name in geometry.work_frames:
        frame_id = ids.setdefault(name, f"{options['frame_prefix']}{name}")
        if name not in (BASE, WORK) and frame_id in (ids[BASE], ids[WORK]):
            problem = f"work frame {name!r} would have the frame_id {frame_id!r} of another frame"
            raise ParameterError(f"parameter frame_prefix: {problem}")
    return ids


class MachineFiles:
    """The geometry and model file that the parameters name, read only from the folders that ``model_folder`` allows."""

    def __init__(self, options: dict[str, Any]) -> None:
        self._options, configured = options, options["model_folder"]
        folder = Path(configured).expanduser() if configured else None
        if folder is not None and not folder.is_dir():
            raise ParameterError(f"parameter model_folder: {configured!r} is not a folder")
        self._folders = {kind: folder or folder_of(options[f"{kind}_file"]) for kind in ("geometry", "model")}
        self.sources: dict[str, Source] = {}  # texts of the files read last, under "geometry" and "model"

    @property
    def ideal(self) -> bool:
        return bool(self._options["model_file"] == IDEAL)

    def worker_machine(self) -> dict[str, Any]:
        """Return what the worker process needs to make this machine: texts of geometry and model, and model folder."""
        folder = self._folders["model"]
        return {**self.sources, "folder": None if folder is None else str(folder)}

    def model_place(self) -> tuple[str, str, str | None]:
        """Return the model file's name, the directory to which a relative name refers, and the folder for models."""
        try:
            place = os.getcwd()
        except FileNotFoundError:  # the working directory was deleted
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


# ---- state ----

# Advice for the sender of a refused command, by the refusal's reason
ADVICE = {
    "stamp_past": "send the pose again with a new stamp; never skip one that was not answered",
    "stamp_future": "set the clocks, or send a zero stamp, which means now",
    "stamp_order": "stamp commands in the order in which they are sent",
    "step": "continue from the last answered command (its stamp: last_answered), in steps within the limit step_mm",
    "speed": "plan a slower motion, and stamp each pose with the time for which it was computed, not of sending",
    "acceleration": "plan less acceleration, and stamp each pose with the time for which it was computed",
    "tool_changed": "send the pose of the tool in use at the struts' present position; last_refusal states this pose",
    "no_feedback": "wait for strut_states; a machine without feedback needs start_without_feedback_after",
    "following_error": "find out why the struts do not follow, then call ~/reset while the machine stands",
    "several_publishers": "leave one publisher on the topic",
    "unknown_publisher": "leave one publisher on the topic; its node must have a readable name",
}

# Advice for all other reasons: a limit, a frame, an invalid message
OTHERWISE = "correct the refused command, and continue from the last answered command (last_answered)"


class CompensatorState(CommandedNode):
    """State and diagnostics of the compensator node; a cleanup keeps counters, stamps and the struts' last lengths."""

    own_sender: OneSender  # guard against another publisher of strut commands
    strut_sender: OneSender  # guard against a second publisher of measured struts
    loads: Loads

    def __init__(self, **options: Any) -> None:
        super().__init__("compensator", PARAMETERS, **options)
        self.files = MachineFiles(self.options)
        self.command_stamps = StampGate("command", self.clock)
        self.reading_stamps = StampGate("reading", self.clock, capped=True)
        self.pose_stamps = StampGate("measured pose", self.clock, capped=True)
        self.track = StrutTrack()
        # Guards of sensor topics and of select_tool; such a topic with two publishers is ignored, and stops no command
        self.sensor_senders: dict[str, OneSender] = {}
        self.feedback = Flow()  # accepted strut readings
        self.bad_feedback, self.bad_poses = Refusals(), Refusals()
        self.failed_reloads, self.refused_resets, self.refused_tools = Refusals(), Refusals(), Refusals()
        self.waited = 0  # number of commands that waited for the struts' speed limit
        self.dropped = 0  # number of waiting commands that a newer command replaced
        self.late_commands = EventWindow()  # a command was handled later than JITTER after its arrival
        self.frame_id = ""  # frame_id of the last answered command
        self.last_answered = 0  # stamp of the last answered command, ns; 0: none
        self.fresh_start = True  # no command was answered since activation or reset
        self.apply_parameters()

    def use_machine(self, compensator: Compensator) -> None:
        self.compensator, self.frame_ids = compensator, frame_ids(compensator.geometry, self.options)
        self.thermometers = Thermometers(*temperature_rules(self.options))
        self.sensor_senders.clear()
        self.instrument: PoseInstrument | None = None  # present with ``fusion.enabled``
        self.prediction_problem = self.drift_problem = ""  # why no error is predicted; why no drift is compensated
        self.track.watch(compensator.geometry)
        self.set_hardware_id(compensator.geometry.name)

    def apply_parameters(self) -> None:
        self.command_stamps.max_age = self.options["max_command_age"]
        self.reading_stamps.max_age = self.pose_stamps.max_age = self.options["max_reading_age"]
        self.track.limit = self.options["following_error_limit"]
        self.track.anywhere_after = self.options["start_without_feedback_after"]

    def update_publishers(self) -> None:
        now = time.monotonic()
        for sender in (self.command_sender, self.own_sender, self.strut_sender, *self.sensor_senders.values()):
            sender.update(now)

    def refuses_commands(self, now: float) -> bool:
        """Return whether a guard or missing strut readings refuse commands, or a command was refused recently."""
        return self.acting_guard() is not None or self.refusals.recent(now) or self.track.waits(now)

    def has_feedback(self, now: float) -> bool:
        return self.feedback.age(now) <= float(self.options["feedback_timeout"])

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        compensator, has_feedback, silent = self.compensator, self.has_feedback(now), self.silent(now)
        yield from self.refusing(now)
        disputed = [(topic, sender) for topic, sender in self.sensor_senders.items() if sender.problem]
        senders = (self.strut_sender, *(sender for _, sender in disputed))
        reported = next((sender.reason for sender in senders if sender.problem), "")
        if reasons := self.bad_feedback.reasons(now, reported):
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
        if silent:
            yield WARN, "no new command"
        if self.feedback.count and not has_feedback:
            yield WARN, "feedback lost, pose estimated from own commands"
        unread = compensator.unread
        if parts := ", ".join(name for name in unread if name != HUMIDITY):
            yield WARN, f"temperatures not received: {parts}; taken as {REFERENCE_TEMPERATURE:g} °C"
        if HUMIDITY in unread:
            yield WARN, f"humidity not received; taken as {100.0 * REFERENCE_HUMIDITY:g} %"
        if stale := self.stale(now):
            yield WARN, f"temperatures stale: {stale}"
        if HUMIDITY in self.thermometers.stale(now):
            yield WARN, "humidity stale"
        if stale := self.loads.stale(now):
            yield WARN, f"{stale} stale"
        if self.command_sender.missing(now) and not silent:
            yield WARN, "running, commands are being missed"
        if self.late_commands.holds(now):
            yield WARN, "running, catching up with commands that came late"
        fusion = self.instrument.fusion if self.instrument is not None else None
        held = fusion.held if fusion is not None else ""
        for problem in filter(None, (self.prediction_problem, self.drift_problem, held)):
            yield WARN, problem
        if fusion is not None and 0.0 < self.options["fusion.timeout"] < now - fusion.last:
            yield WARN, "no measured pose accepted" if fusion.count else "waiting for the first measured pose"
        if self.track.waits(now):
            yield WARN, "waiting for strut_states: the struts' positions are not known"
        if not self.commands.count:
            yield OK, "waiting for the first command"
        if compensator.condition > NEAR_SINGULAR * compensator.geometry.limits.condition:
            yield WARN, "running, near a singularity"
        if compensator.outside_box:
            yield WARN, "running, outside the box in which the model was measured"
        yield from ((WARN, text) for text in self.loads.findings())
        if beyond := compensator.outside_load:
            yield WARN, f"running, under another load than the model was measured with: {beyond}"
        if compensator.ramping:
            yield OK, "running, the corrections are ramping"
        yield OK, "running" if has_feedback else "running, pose estimated from own commands"

    def values(self, now: float) -> dict[str, str]:
        compensator, guard, has_feedback = self.compensator, self.acting_guard(), self.has_feedback(now)
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
            "pose_estimated_from": "strut_states" if has_feedback else "own commands",
            "commands_waited": str(self.waited),
            "commands_dropped": str(self.dropped),
            "measured_by": ", ".join(self.strut_sender.names),
            "stale_temperatures": self.stale(now),
            "feedback_rate_hz": f"{self.feedback.rate(now):.1f}",
            "feedback_age_s": seconds(self.feedback.age(now)),
            "senders_clock_set_back": str(set_back),
            "largest_correction_m": f"{largest:.9f}",
            "condition_number": f"{compensator.condition:.3f}",
            "outside_field": str(compensator.outside_field).lower(),
            "outside_box": str(compensator.outside_box).lower(),
            "measured_box": "not known" if region is None else region.text(compensator.geometry),
            "what_to_do": ADVICE.get(reason, OTHERWISE) if reason else "",
            "last_answered": f"{self.last_answered // 10**9}.{self.last_answered % 10**9:09d}",
            "last_bad_feedback": self.bad_feedback.last_text,
            "bad_feedback": str(self.bad_feedback.total),
            "failed_reloads": str(self.failed_reloads.total),
            "last_failed_reload": self.failed_reloads.last_text,
            "refused_resets": str(self.refused_resets.total),
            "refused_tools": str(self.refused_tools.total),
        }
        values |= {f"{topic}_by": ", ".join(sender.names) for topic, sender in self.sensor_senders.items()}
        known = dict(temperatures.values)
        if (humidity := known.pop(HUMIDITY, None)) is not None:
            values["humidity_percent"] = f"{100.0 * humidity:.1f}"
        values |= {f"temperature.{name}_degC": f"{value:.2f}" for name, value in known.items()}
        values |= self.loads.values()
        if self.instrument is not None:
            values |= self.instrument.values(now)
        if (unknown := temperatures.unknown_for(model.late_growth, now)) > 0.0:
            values["late_parts"] = f"thermal growth uncertain for another {unknown:.0f} s: past temperatures not known"
        return values | self.command_values(now)

    def stale(self, now: float) -> str:
        return ", ".join(name for name in self.thermometers.stale(now) if name != HUMIDITY)
