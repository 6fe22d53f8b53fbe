"""Parameters of the strut-drive node, of which the faults may be set while it runs, and its help."""

from __future__ import annotations

from .arguments import Program
from .parameters import read_table

PARAMETERS = read_table("""
autostart | true |  | start | configure and activate at the start
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
truth_file | paper_machine.yaml |  | configure | hidden truth: a model file, `ideal` for none, `random` for one drawn
    from truth_seed, or `random:SEED`
truth_seed | 1 | 0 to 2147483647 | configure | seed of a random truth
noise_seed | 0 | 0 to 2147483647 | configure | seed of the noise
base_frame | base |  | configure | frame_id of the true tool pose
joint_names | [strut_1, strut_2, strut_3, strut_4, strut_5, strut_6] |  | configure | the struts' names in JointState
    messages, in strut order
command_timeout | 0.1 | 0 to 3600 s | always | without a command for this long diagnostics warn; 0 = off
command_validity | 0.0 | 0 to 3600 s | always | commands stamped earlier than this are refused; 0 = off
allow_several_publishers | false |  | configure | obey though several nodes publish strut commands
rate | 500.0 | 1 to 2000 Hz | configure | readings published per second
step | 1.0e-7 | 0 to 0.001 m | configure | length of one motor step; 0 = none
lag | 0.005 | 0.001 to 1 s | configure | time by which the drives follow a moving command
max_speed | 0.0 | 0 to 10 m/s | configure | largest motor speed; 0 = the geometry's limit
max_acceleration | 10.0 | 0.001 to 1e4 m/s² | configure | largest motor acceleration
encoder_resolution | 1.0e-7 | 0 to 0.001 m | configure | length of one encoder count; 0 = none
encoder_noise | 5.0e-8 | 0 to 0.001 m | configure | standard deviation of an encoder reading
tracker_noise | 0.0 | 0 to 0.001 m | configure | standard deviation of the true pose's coordinates
fault_stuck_strut | 0 | 0 to 6 | always | strut 1 to 6 that does not move; 0 = none
fault_encoder_lost | 0 | 0 to 6 | always | strut 1 to 6 whose encoder reads NaN; 0 = none
fault_feedback_delay | 0.0 | 0 to 10 s | always | age of readings when they are published
fault_feedback_drop | 0.0 | 0 to 1 | always | share of readings that are never published
fault_jump_strut | 1 | 1 to 6 | always | strut 1 to 6 that fault_jump knocks away
fault_jump | 0.0 | -0.1 to 0.1 m | always | distance of a knock; each setting knocks once
""")

TOPICS = """
in   strut_commands   JointState: strut lengths, m
out  strut_states     JointState: what the encoders read, m
     tool_pose_true   PoseStamped: where the tool really is, in base
     /diagnostics
"""

PROGRAM = Program(
    "strut_drive",
    "Simulates six strut drives and a machine with hidden errors on them.",
    PARAMETERS,
    TOPICS,
    "-p truth_file:=random -p truth_seed:=3",
)
