"""Parameters and help of the LinuxCNC bridge, and the pins of its HAL component."""

from __future__ import annotations

from ..nodes.arguments import Program
from ..nodes.parameters import Parameter
from .hal import pins

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start"),
    Parameter("component", "hexapod_comp", "name of the HAL component"),
    Parameter("units", "mm", "LinuxCNC's length unit: mm or inch"),
    Parameter("rate", 1000.0, "cycles per second, Hz", 10.0, 2000.0),
    Parameter("states_rate", 200.0, "measured struts published per second at most, Hz", 1.0, 2000.0),
    Parameter("frame_id", "work", "frame_id of the commanded poses: the compensator's work_frame or base_frame"),
    Parameter("allow_several_publishers", False, "obey though several nodes publish corrections"),
    Parameter("limit", 500e-6, "a correction larger than this is never applied, m", 1e-9, 1.0),
    Parameter("ramp_rate", 1e-3, "largest speed of a correction, m/s", 1e-6, 1.0),
    Parameter("timeout", 0.1, "without a correction for this long the compensator is lost, s", 1e-3, 3600.0),
    Parameter("on_loss", "zero", "what the corrections do when the compensator is lost: zero or hold"),
)

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
