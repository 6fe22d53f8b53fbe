"""Parameters of the strut-drive node, of which the faults may be set while it runs, and its help."""

from __future__ import annotations

from .arguments import Program
from .parameters import JOINT_NAMES, Parameter

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start"),
    Parameter("geometry_file", "paper.yaml", "geometry file: a path or the name of a shipped one"),
    Parameter(
        "truth_file",
        "paper_machine.yaml",
        "hidden truth: a model file, ideal for none, random for one drawn from truth_seed, or random:SEED",
    ),
    Parameter("truth_seed", 1, "seed of a random truth", 0, 2**31),
    Parameter("noise_seed", 0, "seed of the noise", 0, 2**31),
    Parameter("base_frame", "base", "frame_id of the true tool pose"),
    JOINT_NAMES,
    Parameter("command_timeout", 0.1, "without a command for this long diagnostics warn, s; 0 = off", 0.0, 3600.0),
    Parameter("command_validity", 0.0, "commands stamped earlier than this are refused, s; 0 = off", 0.0, 3600.0),
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

TOPICS = """
in   strut_commands   JointState: strut lengths, m
out  strut_states     JointState: what the encoders read, m
     tool_pose_true   PoseStamped: where the tool really is, in base
     /diagnostics
"""

PROGRAM = Program(
    "strut_drive",
    "Simulates six strut drives and a machine with hidden errors on them.",
    PARAMETERS + FAULT_PARAMETERS,
    TOPICS,
    "-p truth_file:=random -p truth_seed:=3",
)
