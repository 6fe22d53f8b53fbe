"""Parameters of the compensator node, which are fixed when it starts, and its help."""

from __future__ import annotations

from ..compensation.thermal import DEFAULT_TIME_CONSTANT
from .arguments import Program
from .command_inputs import POSES, STRUTS
from .parameters import JOINT_NAMES, Parameter

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start"),
    Parameter("geometry_file", "paper.yaml", "geometry file: a path or the name of a shipped one"),
    Parameter("model_file", "ideal", "model file: a path or the name of a shipped one; ideal = corrects nothing"),
    Parameter("model_folder", "", "folder from which both files may be read; empty: each one's own at the start"),
    Parameter("base_frame", "base", "frame_id of poses in the machine base"),
    Parameter("work_frame", "work", "frame_id of poses in the geometry file's work frame"),
    Parameter(
        "command_input",
        POSES,
        f"what commands: {POSES} on tool_pose_command, or {STRUTS} (nominal lengths) on strut_setpoints",
        choices=(POSES, STRUTS),
    ),
    JOINT_NAMES,
    Parameter("command_timeout", 0.1, "without a command for this long the state is stale, s; 0 = off", 0.0, 3600.0),
    Parameter("max_command_age", 0.5, "older (or newer) stamps are refused, s; 0 = off", 0.0, 3600.0),
    Parameter("feedback_timeout", 0.1, "without measured struts for this long there is no feedback, s", 1e-3, 3600.0),
    Parameter("max_reading_age", 0.5, "measured struts stamped older (or newer) are refused, s; 0 = off", 0.0, 3600.0),
    Parameter("require_feedback", False, "refuse commands while there is no feedback"),
    Parameter(
        "start_without_feedback_after",
        0.0,
        "without measured struts for this long after the start the first command may be anywhere, s; 0 = never",
        0.0,
        3600.0,
    ),
    Parameter(
        "following_error_limit",
        2e-3,
        "measured struts further than this from their commands stop the machine, m; 0 = off",
        0.0,
        1.0,
    ),
    Parameter(
        "catch_up_within",
        0.1,
        "commands that come sooner than the struts may move wait so long, s, in order; 0 = only the newest waits",
        0.0,
        3600.0,
    ),
    Parameter("allow_several_publishers", False, "obey though several nodes publish commands or readings"),
    Parameter("allow_several_thermometers", False, "take temperatures though several nodes publish them"),
    Parameter("ramp_rate", 1e-3, "strut speed at which a change of model or enabling is taken up, m/s", 1e-6, 1.0),
    Parameter("enable_compensation", True, "compensate from the start"),
    Parameter(
        "temperature_time_constant_s", DEFAULT_TIME_CONSTANT, "low pass of temperatures, s; 0 = off", 0.0, 3600.0
    ),
    Parameter(
        "temperature_rate_limit", 0.2, "a part's temperature that jumps faster is refused, K/s; 0 = off", 0.0, 1000.0
    ),
    Parameter(
        "temperature_spread_limit",
        40.0,
        "a temperature further than this from the other parts' is refused, K; 0 = off",
        0.0,
        1000.0,
    ),
    Parameter(
        "temperature_timeout", 60.0, "without a temperature for this long a part's is stale, s; 0 = off", 0.0, 86400.0
    ),
    Parameter("heartbeat_rate", 50.0, "heartbeats per second, Hz; 0 = none", 0.0, 1000.0),
    Parameter("marker_rate", 10.0, "markers and joint states per second, Hz; 0 = none", 0.0, 10.0),
    Parameter("publish_array", False, "also publish strut_commands_array for ros2_controllers"),
)

TOPICS = """
in   tool_pose_command       PoseStamped: commanded tool pose, frame_id base or work; or, by command_input,
     strut_setpoints         JointState: nominal strut lengths, m; NaN while the controller is not active
     strut_states            JointState: measured strut lengths, m
     temperatures            Temperature: °C; frame_id names strut_1 to strut_6, base or platform
out  strut_commands          JointState: compensated strut lengths, m
     strut_corrections       JointState: command − nominal, m
     tool_pose_estimate      PoseStamped: from measured struts, in base
     ~/predicted_error       PoseWithCovarianceStamped: the tool's error without compensation, in work;
     ~/predicted_error_aligned  the same with the datum aligned
     ~/stopped               Bool, latched: commands are refused
     ~/heartbeat, ~/validity UInt64, TimeReference: until when the newest command is valid
     joint_states            JointState: all joints of the machine's URDF
     /diagnostics, ~/markers, ~/journal, ~/files
ask  ~/enable_compensation   SetBool
     ~/reload_model, ~/reset Trigger
"""

PROGRAM = Program(
    "compensator",
    "Compensates a hexapod's errors: tool poses in, strut commands out.",
    PARAMETERS,
    TOPICS,
    "-p geometry_file:=mine.yaml -p model_file:=model.yaml",
)
