"""Parameters of the compensator node, and its help."""

from __future__ import annotations

from ..compensation.compensator import DEFAULT_RAMP_RATE
from ..compensation.thermal import DEFAULT_TIME_CONSTANT, HUMIDITY_RATE
from ..machine.geometry import TOOL
from .arguments import Program
from .parameters import read_table

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
    (nominal lengths) on `strut_setpoints`; the other topic is not heard
joint_names | [strut_1, strut_2, strut_3, strut_4, strut_5, strut_6] |  | configure | the struts' names in JointState
    messages, in strut order
command_timeout | 0.1 | 0 to 3600 s | always | a command is valid for this long, without another one the state is
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
catch_up_within | 0.1 | 0 to 3600 s | always | commands that come sooner than the struts may move wait for so long, in
    their order; 0 = only the newest waits
allow_several_publishers | false |  | configure | obey though several nodes publish commands or `strut_states`, or
    others `strut_commands`
allow_several_thermometers | false |  | configure | take temperatures, and humidity, though several nodes publish them,
    one for each part for instance
enable_compensation | true |  | configure | compensate from the start; `~/enable_compensation` switches
ramp_rate | {DEFAULT_RAMP_RATE} | 1e-06 to 1 m/s | always | how fast a change of model or switch, or the way from the
    measured struts to the first command, moves a strut
temperature_time_constant_s | {DEFAULT_TIME_CONSTANT} | 0 to 3600 s | always | low pass of each part's temperatures, and
    of humidity; 0 = off
temperature_rate_limit | 0.2 | 0 to 1000 K/s | always | a part's temperature that jumps by more than 1 K and this rate
    is refused; 0 = off
temperature_spread_limit | 40.0 | 0 to 1000 K | always | a temperature further than this from the median of the other
    parts' is refused, from 20 °C while no other is known; 0 = off
temperature_timeout | 60.0 | 0 to 86400 s | always | a part without a temperature for this long is stale: said, and
    its last one stays; the same of humidity; 0 = off
humidity_rate_limit | {HUMIDITY_RATE} | 0 to 1 1/s | always | a humidity that jumps by more than 0.05 and this rate is
    refused; 0 = off
heartbeat_rate | 50.0 | 0 to 1000 Hz | always | heartbeats per second; 0 = none
marker_rate | 10.0 | 0 to 10 Hz | always | markers and joint states per second; 0 = none
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
