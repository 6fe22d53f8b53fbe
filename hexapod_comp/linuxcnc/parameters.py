"""Parameters and help of the LinuxCNC bridge, and the pins of its HAL component."""

from __future__ import annotations

from ..ros.arguments import Program
from ..ros.parameters import read_table
from .hal import pins

PARAMETERS = read_table("""
autostart | true |  | start | configure and activate at the start
component | hexapod_comp |  | start | name of the HAL component
units | mm | mm, inch | start | LinuxCNC's length unit
rate | 1000.0 | 10 to 2000 Hz | start | cycles per second
states_rate | 200.0 | 1 to 2000 Hz | always | measured struts published per second at most
frame_id | work |  | configure | frame_id of the commanded poses: the compensator's work_frame or base_frame
allow_several_publishers | false |  | configure | obey though several nodes publish `strut_corrections`
limit | 0.0005 | 1e-09 to 1 m | configure | a correction larger than this is never applied
ramp_rate | 0.001 | 1e-06 to 1 m/s | always | largest speed of a correction (0.001 is 1 µm per ms)
timeout | 0.1 | 0.001 to 3600 s | always | without an accepted correction for this long the compensator is lost
on_loss | zero | zero, hold | configure | then ramp the corrections to `zero`, or `hold` them
""")

AXES = ("x", "y", "z", "a", "b", "c", "tool-offset")
"""Commanded axes, and the tool length that LinuxCNC's kinematics take off them."""

FEEDBACK = tuple(f"joint-fb.{n}" for n in range(6))
SWITCHES = ("machine-on", "enable")
CORRECTIONS = tuple(f"correction.{n}" for n in range(6))
FLAGS = ("compensating", "heartbeat", "stopped")
COUNTERS = ("updates", "rejected", "resets")

PINS = (
    *pins("in", "float", *AXES, *FEEDBACK),
    *pins("in", "bit", *SWITCHES),
    *pins("out", "float", *CORRECTIONS, "age", "largest"),
    *pins("out", "bit", *FLAGS),
    *pins("out", "s32", "status"),
    *pins("out", "u32", *COUNTERS),
)

TOPICS = """
in   strut_corrections   JointState: what the compensator adds to the struts, m
     /diagnostics        DiagnosticArray: what the compensator complains of
     compensator/stopped, compensator/heartbeat
out  tool_pose_command   PoseStamped: LinuxCNC's commanded axes
     strut_states        JointState: LinuxCNC's measured struts, m
     /diagnostics
ask  compensator/reset   Trigger, of the compensator
HAL  hexapod_comp.x … correction.0 … status: doc/linuxcnc.md lists the pins
"""

PROGRAM = Program(
    "linuxcnc_bridge",
    "Connects LinuxCNC with the compensator; load it from a HAL file: loadusr -Wn hexapod_comp linuxcnc_bridge.",
    PARAMETERS,
    TOPICS,
    "-p units:=inch",
)
