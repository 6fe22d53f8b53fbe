"""The table of verbs: group, summary, options, help, and the rules for combinations of options."""

# ruff: noqa: I001 (with one name per line, the import would have fifty lines)
from __future__ import annotations

from typing import NamedTuple

from .options import (
    COMPENSATED, DIRECTION, ESTIMATION, FRAMES, JSON, LINE_HELP, LINE_SHAPE, MACHINE, MODEL, NAMESPACE, OUTSIDE,
    POSE_HELP, SEPARATE, SHAPE, TRUTH, WORDS, Assumptions, Option, Rule,
    above_zero, bound, box, choice, count, csv_file, excluded_by,
    exactly_one, finite, flag, folder, html_file, joint_names, lengths, line, machine, needed_by, numbers,
    outside_numbers, pictures, pose, readings, reads, scaled, seed_of, some_of, span, table_out, tilts, times, under,
    value, vector, whole, writes,
)  # fmt: skip


class Verb(NamedTuple):
    """A verb, whose function takes the options and returns an exit code or a Result."""

    module: str  # module with the function, which has the verb's name
    group: str  # heading under which the verb is listed
    summary: str  # one line
    options: tuple[Option, ...]
    text: str  # help text below the options
    rules: tuple[Rule, ...] = ()


DESCRIPTION = """Error compensation for hexapod machine tools: tool poses in, compensated strut lengths out.

Lengths are shown in mm, corrections in µm, angles in degrees. A pose is the tool's pose in the work frame:
x, y, z and the angles α, β, γ with R = Ry(β)·Rx(α)·Rz(γ). A machine or a model is the name of your file or of a
shipped file (paper, paper_machine, …)."""

EPILOG = """To complete verbs, options and file names with the Tab key: pip install argcomplete;
eval "$(register-python-argcomplete hexapod_comp)"."""

CORNERS = "X0,Y0,Z0,X1,Y1,Z1"

# Instruments for which plan can propose runs: a copy, which a test checks, of the planner's list, whose import is slow
INSTRUMENTS = (
    "linear", "straightness", "rotation", "5-D", "6-D", "tracker", "tracker_6d", "ball_bar", "station", "r_test",
)  # fmt: skip

CAMPAIGN = reads(
    "--campaign",
    "campaign file, or the name of a shipped file (default campaign.yaml; for the machine `paper` campaign_5d.yaml)",
    kind="campaign",
)
TRACKER = value(
    "--topic",
    None,
    "TOPIC",
    "topic of the tool's poses (PoseStamped) from a tracker or motion capture (default tool_pose_true, which the "
    "simulated machine publishes)",
    default="tool_pose_true",
)

# All options of `fit --scheme joint`; a plan has only those in ESTIMATION
FIT_ONLY = (
    *ESTIMATION,
    *under(
        "scheme joint",
        value("--scale-ppm", scaled(bound, 1e-6), "PPM", "scale error of the instrument, 1 σ, ppm (default: 0.5 for a "
              "laser, 10 for a tracker)", dest="scale"),
        value("--alignment-mrad", scaled(bound, 1e-3), "MRAD", "angle between a laser's beam and its line, 1 σ, mrad "
              "(default 0.5)", dest="alignment"),
        flag("--not-robust", "give outliers the same weight as other readings"),
    ),
)  # fmt: skip

# Bounds of a virtual machine's errors: option, reader, unit in SI, field of ImperfectionBounds, help with the default,
# which is the bound of the model `random`
BOUNDED = (
    ("--joints-um", bound, 1e-6, "joint", "every coordinate of every joint, ± µm (default 50)"),
    ("--struts-um", bound, 1e-6, "strut_offset", "every strut's length, ± µm (default 50)"),
    ("--pitch-ppm", bound, 1e-6, "pitch", "every screw's pitch, ± ppm (default 50)"),
    ("--wave-um", span, 1e-6, "wave", "amplitude of the screws' periodic error, µm (default 1,3)"),
    ("--harmonics-um", span, 1e-6, "harmonics", "amplitude of errors with 2, 3 and 4 periods per turn, µm (default 0)"),
    ("--wave-period-mm", above_zero, 1e-3, "wave_period", "period of --wave-um (default: the geometry's lead, or 10)"),
    ("--map-um", bound, 1e-6, "length_map", "smooth length error of every strut, RMS µm (default 1)"),
    ("--backlash-um", span, 1e-6, "backlash", "backlash of every strut, µm (default 2,4)"),
    ("--wear-um", bound, 1e-6, "wear", "largest additional backlash at the most worn place of a screw, µm (default 0)"),
    ("--strut-expansion-ppm-per-k", span, 1e-6, "strut_expansion", "expansion of the struts, ppm/K (default 0)"),
    ("--body-expansion-ppm-per-k", span, 1e-6, "body_expansion", "expansion of base and platform, ppm/K (default 0)"),
    ("--field-um", bound, 1e-6, "field_displacement", "largest displacement of the error field, µm (default 0)"),
    ("--field-urad", bound, 1e-6, "field_rotation", "largest rotation of the error field, µrad (default 0)"),
    ("--field-reversal-percent", bound, 1e-2, "field_reversal",
     "share of the error field, %%, that depends on the direction of motion (default 10)"),
)  # fmt: skip
BOUNDS = (
    *(value(name, scaled(read, size), "LOW,HIGH" if read is span else "NUMBER", text, dest=bound)
      for name, read, size, bound, text in BOUNDED),
    value("--box", box, CORNERS, "box of the field: lowest and highest tool position, mm (default: the largest "
                                 "box that the machine reaches)"),
    flag("--separate-joints", "give each strut's platform joint an error of its own, even where two joints coincide"),
)  # fmt: skip

# fmt: off
VERBS = {
    "show": Verb(
        "poses", "kinematics",
        "show a machine's frames, joints, reach and largest box",
        (
            reads("machine", "geometry file, or the name of a shipped file", "MACHINE", "geometry"),
            pictures("out"),
            JSON,
        ),
        """Shows the positions of joints and frames, the reach, the limits at the boundary of the reach, and the largest
box within the reach, in mm and degrees. A campaign whose file gives no box uses this box. Warnings about suspicious
entries of the geometry file come last. More: doc/own_machine.md.

example:
  $ hexapod_comp show mine.yaml""",
    ),
    "ik": Verb(
        "poses", "kinematics",
        "compute strut lengths (mm) for a tool pose (mm, degrees) or a CSV file",
        (
            reads("poses", "CSV file of poses; - for standard input", "POSES.csv", "poses", nargs="?"),
            value("--pose", pose, SHAPE, POSE_HELP),
            value("--line", line, LINE_SHAPE, f"straight line of the tool, from start to end and back, {LINE_HELP}"),
            value("--step-mm", above_zero, "MM", "distance between poses on the line, mm (default 5)", default=5.0),
            DIRECTION,
            *FRAMES,
            table_out("the lengths"),
            JSON,
        ),
        """Columns of the input: x_mm, y_mm, z_mm, optionally alpha_deg, beta_deg, gamma_deg (or qx, qy, qz, qw), and
optionally sequence or name. A suffix states another unit (_m, _um, _in, _rad). If the input is a CSV file, the output
is CSV with the columns L1_mm … L6_mm, which fk reads. With --model these columns are the lengths to command; the
columns nominal_L1_mm … and correction_L1_um … (command − nominal) follow. Without --direction a command is the mean of
both directions; on a line each strut has the direction of its own motion. Lengths are computed even if a pose breaks a
limit; stderr reports broken limits (see check). More: doc/command_line.md.

example:
  $ hexapod_comp ik --pose 0,0,400,5,0,0
  $ hexapod_comp ik config/table1.csv --model paper_machine --out lengths.csv
  $ hexapod_comp ik --line=-200,0,450,200,0,450 --step-mm 5 --model paper_machine --out line.csv""",
        (
            exactly_one("poses", "--pose", "--line"),
            needed_by("--line", "--step-mm"), excluded_by("--line", "--direction"),
        ),
    ),
    "fk": Verb(
        "poses", "kinematics",
        "compute the tool pose (mm, degrees) for six strut lengths (mm) or a CSV file",
        (
            reads("lengths_file", "CSV file; - for standard input", "LENGTHS.csv", "lengths", nargs="?"),
            value("--lengths", lengths, "L1,…,L6", "six lengths, mm"),
            value("--guess", pose, SHAPE, f"pose near the solution, {POSE_HELP} (default: home)"),
            flag("--cold", "find the pose of the working assembly mode without a guess"),
            flag("--all-modes", "list every assembly mode of the nominal machine"),
            DIRECTION,
            *FRAMES,
            table_out("the poses"),
            JSON,
        ),
        """Columns of the input: L1_mm … L6_mm (or _m, _um, _in), and optionally sequence or name. If the input is a CSV
file, the output is CSV, which ik and check read. With --model the lengths are commands, and the result is the pose of
the real machine. Newton's method starts at home, or at --guess. With --cold, Newton's method starts at 4000 poses; of
all poses that it finds, the result is the pose in which the machine can work.

example:
  $ hexapod_comp fk --lengths 519.494,519.808,509.192,509.192,499.282,498.955
  $ hexapod_comp ik config/table1.csv | hexapod_comp fk -""",
        (
            exactly_one("lengths_file", "--lengths"),
            needed_by("--lengths", "--all-modes"), excluded_by("--model", "--all-modes"),
            excluded_by("--all-modes", "--cold", "--guess"), excluded_by("--cold", "--guess"),
        ),
    ),
    "check": Verb(
        "poses", "kinematics",
        "check the poses of a CSV file against every limit, with all margins",
        (
            reads("poses", "CSV file of poses (mm, degrees); - for standard input", "POSES.csv", "poses"),
            flag("--stream", "rows are consecutive commands"),
            value("--rate-hz", finite, "HZ", "commands per second (default 250)", default=250.0),
            *FRAMES,
            table_out("all margins"),
            JSON,
        ),
        """By default the rows are targets: the tool moves from target to target and rests at each target, as in `run`,
and the whole path is checked. With --stream the rows are consecutive commands at --rate-hz, and the steps and strut
speeds between commands are checked. Limits apply to nominal and to compensated values (--model). The report shows
margins of stroke (mm to the nearer end), of joint cones (degrees) and, if the machine limits it, of the distance
between struts' axes (mm). It shows values of condition number, correction (µm), step (mm) and speed (mm/s). Exit code
1: a limit is broken.

example:
  $ hexapod_comp check config/table1.csv""",
    ),
    "travel": Verb(
        "poses", "kinematics",
        "show how far the tool can move in each direction, and which limit ends the travel",
        (
            value("--pose", pose, SHAPE, f"pose of the tool, {POSE_HELP} (default: home)"),
            *FRAMES,
            JSON,
        ),
        """Computes how far the tool can move from the pose along x, y and z of the work frame (mm) and in each angle
(degrees), forward and backward. Only one coordinate changes, until a limit is reached: stroke, joint cones, clearance
of the struts, condition number, correction, or the field's box. Limits apply to nominal and to compensated values
(--model). Angles end at 180°. The search may miss a forbidden region that is narrower than 1/500 of the longest strut,
or narrower than half a degree.

example:
  $ hexapod_comp travel --pose 0,0,400,0,0,5 --model paper_machine.yaml""",
    ),
    "run": Verb(
        "running", "loop",
        "move through poses with simulated nodes, or with your own nodes",
        (
            reads("poses", "CSV file of poses (mm, degrees)", "POSES.csv", "poses"),
            MACHINE,
            TRUTH,
            value("--rate-hz", finite, "HZ", "commands per second (default 250)", default=250.0),
            JSON,
            reads("--model", f"model of the compensator: a file, the name of a shipped file, {WORDS}, or truth (the "
                  "errors of --truth; default)", kind="model", default="truth"),
            pictures(),
            flag("--attach", "use nodes that already run; move through the poses once; compensation stays as it is"),
            value("--namespace", None, "NAME", "namespace of the nodes for --attach", default=""),
        ),
        """The tool moves from pose to pose within the machine's limits and rests at each pose. The tool error (µm,
µrad) is computed from the topic tool_pose_true; six or more poses also give the error after best-fit alignment. Poses
are tool poses in the work frame; the file has the same columns as for ik. The simulated machine has the errors of
--truth; by default the compensator's model has the same errors. Exit code 1: commands were lost or refused.

example:
  $ hexapod_comp run config/table1.csv --pictures out
  $ hexapod_comp run poses.csv --machine mine.yaml --truth random:7 --model model.yaml
  $ hexapod_comp run poses.csv --attach --rate-hz 100     (nodes already running in this ROS domain)""",
        (needed_by("--attach", "--namespace"), excluded_by("--attach", "--truth", "--model")),
    ),
    "move": Verb(
        "running", "loop",
        "move a running machine's tool to a pose and wait for it",
        (
            value("--pose", pose, SHAPE, f"target, {POSE_HELP}"),
            value("--frame", None, "NAME", "frame of the pose: work (default), base or the name of a work frame; with "
                  "--relative also tool", default="work"),
            flag("--relative", "move relative to the tool's present pose, along and about the axes of --frame"),
            flag("--stop", "stop the present move as fast as the struts' limits allow"),
            NAMESPACE,
            JSON,
        ),
        """Sends the target to the node mover. The mover checks every limit, then moves the tool along a straight line,
with the shortest rotation, in the least time that the struts allow. Ctrl-C stops the move. Exit code 2: the mover
refused the move or stopped it before the target; the reason is printed. More: doc/ros.md.

example:
  $ ros2 run hexapod_comp mover     (while the compensator runs)
  $ hexapod_comp move --pose 0,0,410,0,0,5
  $ hexapod_comp move --pose 0,0,2 --relative --frame tool""",
        (exactly_one("--pose", "--stop"), excluded_by("--stop", "--frame", "--relative")),
    ),
    "adapt": Verb(
        "running", "loop",
        "calibrate a running machine, check its model at intervals, repair the model",
        (
            MACHINE,
            folder("--folder", "folder of journal, readings and models; an unfinished calibration in it is continued",
                   required=True),
            value("--goal-um", above_zero, "UM", "goal of planned campaigns: with 95 %% probability the RMS tool error "
                  "after best-fit alignment is at most this large (default: the goal in the folder's journal)"),
            reads("--campaign", "campaign file that replaces the planned campaigns; checks use the box of the file",
                  kind="campaign"),
            flag("--reload", "load each model that is confirmed by check readings into the compensator (default: only "
                 "propose the model)"),
            flag("--verify", "check the model in the folder once, without a calibration"),
            flag("--anew", "calibrate even if the folder has a model"),
            value("--checks", whole(0), "N", "number of checks after the calibration (default 0; with --every-min: "
                  "checks until Ctrl-C)"),
            value("--every-min", bound, "MIN", "time from one check to the next (default 10)"),
            value("--box", box, CORNERS, "box to calibrate: lowest and highest tool position, mm (default: the box in "
                  "the folder's journal or of the campaign, or else the largest box that the machine reaches)"),
            TRACKER,
            value("--samples", whole(3, 10_000), "N", "number of tracker poses for one median, 3 to 10000; each stop "
                  "gives three medians (default 25)", default=25),
            NAMESPACE,
            JSON,
            *ESTIMATION,
        ),
        """Plans a campaign for the goal, makes the mover move to the poses of the campaign, fits a model, and takes
check readings at other poses. A model that the check readings confirm becomes FOLDER/model.yaml; with --reload the
compensator then loads this model. With --checks or --every-min the model is checked at the interval --every-min. A
check that contradicts the model names the changed error; then the model is repaired, or a repair is proposed. Ctrl-C
stops the machine and ends the program. The same command continues from FOLDER/journal.jsonl, also after the process was
killed. Exit code 1: a model was refused, or the machine has changed; 130: stopped. More: doc/staying_true.md.

example:
  $ ros2 launch hexapod_comp machine.launch.py mover:=true model_folder:=$PWD     (with a simulated machine)
  $ hexapod_comp adapt --goal-um 3 --folder adapted --reload
  $ hexapod_comp adapt --goal-um 3 --folder adapted --reload --every-min 30
  $ hexapod_comp adapt --folder adapted --reload --verify""",
        (
            excluded_by("--campaign", "--goal-um", "--box"),
            excluded_by("--verify", "--anew", "--checks", "--every-min"),
        ),
    ),
    "demo": Verb(
        "running", "loop",
        "calibrate, warm, knock and repair a virtual machine, and show its error over time",
        (
            MACHINE,
            TRUTH,
            JSON,
            seed_of("the noise and of the choice of the knocked strut"),
            pictures("out"),
        ),
        """A virtual machine calibrates itself as with adapt. Then its struts become warmer by 5 K, which no thermometer
shows, and one strut is knocked and becomes 20 µm longer. The checks must name both changes, and the model must be
repaired. Errors are in µm after best-fit alignment; ROS is not used. Exit code 1: a change was not named or not
repaired, or the tool error with a model exceeds the error that the calibration promised (95 %). More: doc/demo.md.

example:
  $ hexapod_comp demo
  $ hexapod_comp demo --machine mine.yaml --truth random:7""",
    ),
    "watch": Verb(
        "running", "loop",
        "show a running machine in the browser: 3-D, errors, refusals",
        (
            MACHINE,
            NAMESPACE,
            value("--host", None, "ADDRESS", "address of the page (default 127.0.0.1: only for this computer; 0.0.0.0: "
                                             "for every computer in the network)", default="127.0.0.1"),
            value("--port", whole(1, 65535), "N", "port of the page (default 8080)", default=8080),
        ),
        """Serves a page until Ctrl-C, by default only to this computer. The page only subscribes to topics: it cannot
move or change the machine. This verb needs viser: pip install viser. More: doc/ros.md.

example:
  $ hexapod_comp watch --machine mine.yaml""",
    ),
    "echo": Verb(
        "running", "loop",
        "print the messages of a topic, with units, rate and age",
        (
            value("topic", None, "TOPIC", "name of a topic (default: list the published topics)", nargs="?"),
            NAMESPACE,
            value("--count", count, "N", "end after N messages"),
            value("--seconds", above_zero, "S", "end after S seconds (default: at Ctrl-C)"),
            flag("--hz", "print only the rate of the messages, once a second"),
            JSON,
        ),
        """Prints struts in mm, corrections in µm, poses in mm and degrees, and predicted errors in µm and µrad with
their standard deviations. The line above a message gives the topic's rate over the last 2 s, and the time from the
message's stamp to its receipt. With --json each message is one line. Exit code 1: no message arrived.

example:
  $ hexapod_comp echo strut_corrections --count 1
  $ hexapod_comp echo strut_commands --hz --seconds 10""",
        (needed_by("topic", "--count", "--seconds", "--hz"),),
    ),
    "record": Verb(
        "running", "loop",
        "record a running machine's topics, for replay",
        (
            folder("--out", "new folder for the bag (MCAP)", dest="folder", required=True),
            NAMESPACE,
            value("--seconds", above_zero, "S", "end after S seconds (default: at Ctrl-C)"),
            JSON,
        ),
        """Writes commands, readings, estimates, diagnostics and the compensator's journal into a folder with an MCAP
file, as ros2 bag does. A recording may begin during a motion. Exit code 1: no compensator published its journal, so the
recording cannot be replayed.

example:
  $ hexapod_comp record --out run
  $ hexapod_comp replay run""",
    ),
    "replay": Verb(
        "running", "loop",
        "compute the commands of a recording again, and compare them bit for bit",
        (
            reads("bag", "folder of a bag, .mcap or .db3 file", "BAG"),
            value("--namespace", None, "NAME", "namespace of the machine, if the bag contains several machines"),
            reads("--machine", "geometry file, or the name of a shipped file (default: the geometry in the recording)",
                  kind="geometry"),
            reads("--model", f"model file, the name of a shipped file, {WORDS} (default: the model in the recording)",
                  kind="model"),
            value("--tolerance-um", bound, "UM", "largest accepted difference, µm (default 0: the same bits)",
                  default=0.0),
            pictures(),
            table_out("all corrections"),
            JSON,
        ),
        """BAG must contain the topic compensator/journal. The topic compensator/files contains the geometry and the
model in use; if BAG does not contain this topic, give --machine and --model. The report gives the tool's distance from
its path in µm: absolute, and after best-fit alignment. With another --model or --machine the report also shows the
corrections that this model would have made. Exit code 1: a computed command differs from the recorded command by more
than --tolerance-um. More: doc/replay.md.

example:
  $ ros2 bag record --storage mcap --output run --all
  $ hexapod_comp replay run --pictures out/replay""",
    ),
    "plan": Verb(
        "fitting", "calibration",
        "predict which parameters a campaign determines, or propose a campaign for a goal",
        (
            reads("campaign", "campaign file, or the name of a shipped file; with --goal-um it is optional, and only "
                              "its box and noise are used", "CAMPAIGN", "campaign", nargs="?"),
            MACHINE,
            value("--repeatability-um", bound, "UM", "standard deviation of the stopped machine's position along each "
                                                     "axis (default: the value in the campaign)"),
            *under(
                "proposing a campaign",
                value("--goal-um", above_zero, "UM", "propose a campaign that reaches this RMS tool error after "
                                                     "best-fit alignment"),
                value("--tilt-deg", bound, "DEG", "tilt of the tool up to which the goal must be reached (default 0)"),
                value("--tools-kg", numbers, "KG,…", "masses of other tools (with --load): the goal must be reached "
                                                    "with each of these tools, and runs may use them"),
                value("--gravity", vector, "X,Y,Z", "gravity in base, m/s², for another attitude of the machine, in "
                                                     "which the goal must also be reached; may be repeated",
                      action="append"),
                value("--instruments", None, "A,B,…", f"available instruments: {', '.join(INSTRUMENTS)} (default "
                                                      "linear)"),
                value("--hours", above_zero, "H", "time available for measuring (default 4)"),
                value("--time", times, "NAME=SETUP,RUN,STOP",
                      "times of an instrument: minutes to set up, minutes per run, "
                      "seconds per stop; may be repeated", action="append"),
                writes("--out", "write the proposed campaign to a file (YAML)", "CAMPAIGN"),
            ),
            *ESTIMATION,
            seed_of("scattered poses"),
            JSON,
        ),
        """Predicts, without readings, which parameters a campaign would determine, which parameters it would not
determine, and the tool error (µm) that would remain after a fit on a machine within the tolerances. With --goal-um it
proposes a campaign: lines and poses in measuring order and within the limits. With the readings of this campaign a fit
reaches the goal (RMS tool error after best-fit alignment, µm) in the available time. Exit code 1: the goal is not
reached. More: doc/measuring.md.

example:
  $ hexapod_comp plan campaign_1d --lead-mm 10 --blocks pitch,wave,backlash
  $ hexapod_comp plan --goal-um 3 --tilt-deg 10 --instruments linear,tracker_6d --hours 4 --out mine.yaml""",
        (
            some_of("campaign", "--goal-um"),
            needed_by("--goal-um", "--tilt-deg", "--tools-kg", "--gravity", "--instruments", "--hours", "--time",
                      "--out"),
        ),
    ),
    "imagine": Verb(
        "measuring", "calibration",
        "make a virtual machine with random errors, for any geometry",
        (
            MACHINE,
            *under("bounds of the errors", *BOUNDS),
            seed_of("the machine", 1),
            value("--name", None, "TEXT", "name of the model (default virtual-SEED)"),
            writes("--out", "write the errors to a model file (YAML)", "MODEL", required=True),
            JSON,
        ),
        """Draws the errors uniformly within the bounds; a bound of 0 switches an error off. The same seed gives the
same machine, and a change of one bound does not change the other errors. As the value of --truth or --model, `random`
means the machine that this verb draws without options, and `random:7` the machine that it draws with --seed 7.

example:
  $ hexapod_comp imagine --machine mine.yaml --joints-um 100 --backlash-um 3,5 --seed 3 --out truth.yaml
  $ hexapod_comp simulate --machine mine.yaml --truth truth.yaml --campaign mine_5d.yaml --out measured.csv""",
        (needed_by("--field-um or --field-urad", "--field-reversal-percent", "--box"),),
    ),
    "outside": Verb(
        "measuring", "calibration",
        "add a table of errors over external quantities (elevation) to a model",
        (
            reads("table", "CSV file of errors over one or two external quantities", "TABLE.csv", "readings"),
            Option("--holds", "content of the table: errors (actual − commanded), or corrections (added to commands)",
                   {"choices": ("errors", "corrections"), "required": True}),
            choice("--beyond", ("hold", "refuse"), "outside the table: hold uses the value at the table's edge "
                   "(default), refuse rejects commands", "hold"),
            value("--calibrated-at", outside_numbers, "NAME_UNIT=NUMBER,…", "values of the external quantities during "
                  "the calibration: the table's error at these values is subtracted from the whole table"),
            MACHINE,
            MODEL,
            writes("--out", "write the model to a YAML file", "MODEL", required=True),
            JSON,
        ),
        """Columns: one or two external quantities (such as elevation_deg, rotation_deg, oil_degC), the displacement
x_um, y_um, z_um of the field's measured point, and the rotation rx_urad, ry_urad, rz_urad about this point, in base. A
suffix states another unit. Each row is a node of a grid; errors between nodes are interpolated bilinearly. Frame and
sign: doc/model_file.md.

example:
  $ hexapod_comp outside flexure.csv --holds corrections --model model.yaml --out bent.yaml""",
    ),
    "simulate": Verb(
        "measuring", "calibration",
        "measure the virtual machine: a campaign's readings as a CSV file",
        (
            MACHINE,
            MODEL,
            TRUTH,
            CAMPAIGN,
            reads("--warm-up", "file that describes a warm-up of the machine, during which x, y and z lines are "
                               "measured again; warm_up: the shipped file", kind="warm_up"),
            seed_of("all random draws"),
            writes("--out", "write the readings to a CSV file", type=csv_file, required=True),
            JSON,
        ),
        """Writes the readings of a campaign's instruments for the verb fit: one reading per row, measured minus
commanded, in um and urad, with noise and unknown zeros. With --model the machine is compensated by this model. With
--warm-up warm_up the machine warms up after the campaign, and three lines are measured again every ten minutes. The
same seed gives the same file. More: doc/measuring.md.

example:
  $ hexapod_comp simulate --campaign campaign_1d --seed 1 --out measured.csv""",
    ),
    "collect": Verb(
        "measuring", "calibration",
        "measure a running machine: a campaign's readings as a CSV file",
        (
            MACHINE,
            CAMPAIGN,
            TRACKER,
            value("--readings", None, "TOPIC", "topic of a laser's or ball bar's readings (JointState: names are "
                  "channels), used for lines, lengths and displacements", default=""),
            choice("--tracker-frame", ("free", "known"), "known: the topic's poses are in base (default); free: the "
                   "topic's poses are in an unknown frame", "known"),
            flag("--confirm", "with --readings: before each run, wait until you press Enter"),
            value("--samples", whole(3, 10_000), "N", "number of messages per stop, 3 to 10000; the reading is their "
                  "median (default 25)", default=25),
            seed_of("the scattered poses"),
            writes("--out", "write the readings to a CSV file; an incomplete file of this campaign is completed",
                   type=csv_file, required=True),
            NAMESPACE,
            JSON,
        ),
        """Makes the mover move to a campaign's poses, and reads the instruments at each pose after the tool has
settled. Ctrl-C or a stop of the mover ends the measurement; the file has all readings so far, and the same command
continues the measurement. If the first line has readings larger than the errors of any machine (wrong unit, sign,
channel, frame or target), the measurement ends after this line. Exit code 1: some readings are missing. More:
doc/measuring.md.

example:
  $ ros2 launch hexapod_comp machine.launch.py mover:=true     (compensator, mover and a simulated machine)
  $ hexapod_comp collect --campaign campaign_1d --out measured.csv
  $ ros2 launch hexapod_comp machine.launch.py mover:=true instrument:=laser     (in place of the first)
  $ hexapod_comp collect --campaign campaign_1d --readings instrument/readings --out laser.csv""",
        (needed_by("--readings", "--confirm"),),
    ),
    "fit": Verb(
        "fitting", "calibration",
        "fit a model of the machine's errors to measurements",
        (
            *readings(),
            choice("--scheme", ("joint", "lines"), "method of the fit (default joint)", "joint"),
            writes("--out", "write the model to a YAML file", "MODEL", required=True),
            value("--name", None, "TEXT", "name of the model"),
            value("--datum", pose, "POSE", f"tool pose in work at which the model makes no correction, {POSE_HELP} "
                                           "(default: home)"),
            writes("--report", "also write the report to a file"),
            writes("--certificate", "write a calibration certificate as an HTML page (scheme joint)", "FILE.html",
                   type=html_file),
            reads("--details", "YAML file with details for the certificate: instruments, place and people"),
            pictures(),
            JSON,
            reads("--truth", f"errors of the virtual machine that was measured: a file, the name of a shipped file, "
                  f"{WORDS}", kind="model"),
            flag("--force", "write the model even if the readings contradict it"),
            Option("--assumptions", "print what all fits assume, with units and sources, and exit",
                   {"action": Assumptions, "nargs": 0}),
            reads("--update", "update this model from few readings; the result of its fit is the prior", "MODEL"),
            COMPENSATED,
            *FIT_ONLY,
        ),
        """Reads tidy CSV (one reading per row, as simulate writes it), or with --columns the wide CSV files of other
laboratories. --scheme joint fits structure, struts and field to all readings at once, and keeps only blocks that
improve the prediction of readings left out of the fit. --scheme lines is the scheme of Mou & King 1998: a polynomial
for each grid line, direction and channel. If you give --truth the same errors as simulate, the report shows the tool
error that remains with the model (µm, µrad). Exit code 1: the readings contradict the model; without --force the model
is not written. More: doc/fitting.md.

example:
  $ hexapod_comp simulate --campaign campaign_5d --seed 1 --out measured.csv
  $ hexapod_comp fit measured.csv --out model.yaml --pictures out
  $ hexapod_comp run poses.csv --model model.yaml""",
        (
            needed_by("--certificate", "--details"),
            needed_by("--update", "--compensated"),
            excluded_by("--scheme lines", *(o.name for o in FIT_ONLY), "--certificate"),
            excluded_by("--update", "--scheme", *(o.name for o in FIT_ONLY), "--pictures", "--truth", "--datum",
                        "--certificate", "--details"),
        ),
    ),
    "verify": Verb(
        "fitting", "calibration",
        "check with few readings whether a model is still valid, and name the machine's change",
        (
            reads("model", "model file written by fit; MODEL.posterior.npz must be in the same folder", "MODEL"),
            *readings(required=False),
            COMPENSATED,
            writes("--propose", "do not check; write a tidy CSV file that lists readings to take, with empty values"),
            value("--readings", whole(6, 60), "N", "number of readings, 6 to 60 (default 12)"),
            value("--instruments", None, "A,B", "instruments: linear, straightness, rotation, tracker, tracker_6d "
                                                "(default linear,rotation)"),
            JSON,
        ),
        """Compares 12 to 24 check readings, spread over the box, with the model and the uncertainty of its parameters,
and names the most probable kind of change, such as a strut's offset, a temperature or a single wrong reading. Take the
readings as for fit: with compensation off, or with the strut commands in the file. If the compensator uses this model
during the readings, give --compensated. fit --update updates the model from the readings. Errors are in µm. Exit code
1: the machine has changed. More: doc/staying_true.md.

example:
  $ hexapod_comp verify model.yaml check.csv
  $ hexapod_comp fit check.csv --update model.yaml --out renewed.yaml""",
        (
            some_of("files", "--propose"),
            excluded_by("--propose", "files", "--columns", "--probe-mm", "--compensated"),
            needed_by("--propose", "--readings", "--instruments"),
        ),
    ),
    "iso230": Verb(
        "measuring", "calibration",
        "compute the parameters of ISO 230-2, 230-4 and 230-6 from readings",
        (
            *readings(),
            flag("--targets", "show each run target by target, with notes"),
            JSON,
        ),
        """Evaluates every linear run with two or more cycles that read each target from both sides: runs along an axis
of the work frame by ISO 230-2:2014, all other runs by ISO 230-6:2002 (A, E, R, M, B). Lengths on a circle are evaluated
by ISO 230-4:2005 (G, G(b), F, D). Results are in µm. More: doc/iso230.md.

example:
  $ hexapod_comp iso230 measured.csv""",
    ),
    "export": Verb(
        "export", "calibration",
        "write a model for other controllers, and compute the tool error that remains",
        (
            MACHINE,
            MODEL,
            OUTSIDE,
            folder("--linuxcnc", "folder for LinuxCNC's files; created if missing"),
            writes("--table", "CSV file for the trilinear table", "FILE.csv", type=csv_file),
            folder("--c", "folder to write the compensator in C into, with the machine's constants", dest="c_folder"),
            folder("--ros2-control", "folder for a ROS 2 package: the machine's compensation as a controller of "
                   "ros2_control, and the controller's configuration"),
            value("--rate", whole(1, 10_000), "HZ", "rate of ros2_control's loop, Hz (default 250)", default=250),
            value("--joint-names", joint_names, "A,B,C,D,E,F", "names of the struts' joints in URDF, MJCF and "
                  "ros2_control (default strut_1,…,strut_6)"),
            writes("--urdf", "file for the nominal machine as URDF, for robot_state_publisher, RViz and ros2_control",
                   "FILE.urdf"),
            writes("--mjcf", "file for the nominal machine as MuJoCo's MJCF, with closed loops", "FILE.xml"),
            choice("--units", ("mm", "inch"), "LinuxCNC's machine unit, [TRAJ]LINEAR_UNITS (default mm)", "mm"),
            value("--box", box, CORNERS, "lowest and highest tool position, mm (default: the box in which the model "
                  "was measured, or else the box of its field)"),
            value("--step-mm", above_zero, "MM", "largest distance between the table's nodes, mm (default 25.4)",
                  default=25.4),
            value("--poses", whole(1000), "N", "number of random poses in the check, at least 1000 (default 1000)",
                  default=1000),
            value("--tilt-deg", bound, "DEG", "tilt of the tool in the check with a tilted tool, degrees (default 5)",
                  default=5.0),
            seed_of("the random poses"),
            JSON,
        ),
        """--linuxcnc writes genhexkins.hal, strut_1.comp … strut_6.comp and comp.ini; --table writes corrections of
struts and poses on a grid. The files of these two options are checked: they are read back, and a simulated machine with
the model's errors moves to random poses. The report gives the tool's 3-D error without and with the corrections, and
the errors that the export does not correct. Existing files are replaced. Exit code 1: the export would increase the
error. More: doc/exporting.md, doc/linuxcnc.md, doc/c_core.md, doc/ros.md.

example:
  $ hexapod_comp export --machine paper.yaml --model paper_machine.yaml --linuxcnc linuxcnc --table table.csv""",
        (
            some_of("--linuxcnc", "--table", "--c", "--ros2-control", "--urdf", "--mjcf"),
            needed_by("--linuxcnc or --table or --c or --ros2-control", "--model", "--outside"),
            needed_by("--linuxcnc", "--units"), needed_by("--table", "--step-mm"),
            needed_by("--ros2-control", "--rate"),
            needed_by("--linuxcnc or --table", "--box", "--poses", "--tilt-deg", "--seed"),
            needed_by("--ros2-control or --urdf or --mjcf", "--joint-names"),
        ),
    ),
    "assess": Verb(
        "poses", "analysis",
        "compute how random imperfections within bounds change strut lengths and tool poses",
        (
            reads("poses", "CSV file of poses (mm, degrees; default: Table 1 of Song, Mou & King); - for standard "
                  "input", "POSES.csv", "poses", nargs="?", default="table1.csv"),
            value("--joint-um", bound, "UM", "bound of each coordinate of each joint, ± µm (default 10)", default=10.0),
            value("--strut-um", bound, "UM", "bound of each strut's length, ± µm (default 10)", default=10.0),
            value("--machines", count, "N", "number of random machines (default 1)", default=1),
            seed_of("the first machine"),
            MACHINE,
            table_out("every machine and pose"),
            JSON,
        ),
        """Draws machines with uniform random errors within ± the bounds. For the first machine it prints the tables of
Song, Mou & King: the ideal strut lengths (mm), the lengths that the real machine needs for the same poses, the
difference of the two (µm), and the pose (mm, degrees) of the real machine with ideal lengths. With --machines N it also
prints percentiles over N machines with consecutive seeds.

example:
  $ hexapod_comp assess config/table1.csv --joint-um 10 --strut-um 10 --machines 200 --seed 1""",
    ),
    "classify": Verb(
        "classify", "analysis",
        "rank a machine's errors by their effect on the tool",
        (
            machine("positioning_unit.yaml"),
            reads("--budget", "error budget, or the name of a shipped file (default error_budget.yaml)",
                  kind="error_budget", default="error_budget.yaml"),
            reads("--model", "rank the errors that remain after the fit of this model (not those of a budget), and the "
                             "measurements that would reduce them", kind="model"),
            table_out("the ranking"),
            pictures(),
            JSON,
            SEPARATE,
            value("--cells", whole(4, 200), "N", "cells along the grid's longest edge, 4 to 200 (default 30)",
                  default=30),
            value("--clearance-mm", bound, "MM", "smallest allowed distance between the axes of two struts, mm; 0: no "
                  "limit (default: the limit in the geometry file)"),
            value("--tilt-deg", tilts, "A,B,…", "tilts about the tool's x and y, degrees, relative to its attitude at "
                  "home (default -4,0,4)", default=tilts("-4,0,4")),
            choice("--method", ("exact", "linear"), "method of the ranking: exact (default), or linear (first order)",
                   "exact"),
            value("--allow-um", above_zero, "UM", "allowed tool error; the report adds the allowed size of each error"),
            value("--workers", whole(1, 256), "N", "number of processes (default 1, which uses all cores)", default=1),
            value("--scheduler", None, "tcp://…", "Dask scheduler that runs the work in place of local processes"),
            seed_of("random poses and random machines"),
            flag("--no-page", "omit the interactive page from --pictures"),
            flag("--publish", "publish the workspace, coloured by the worst error, on workspace/shells until Ctrl-C"),
        ),
        """Computes the reach of the machine. At every grid point in the reach it computes the effect (µm, mdeg) of each
single error of the budget, by forward kinematics of the machine with this error. The result is the ranked table of v.
Daake et al.; --allow-um adds the allowed size of each error. --pictures also writes page.html if plotly is installed.
With --model the covariance of a fit takes the place of the budget: the result is the tool error that remains with the
model, the causes of this error, and the measurement that would reduce it most. More: doc/classification.md.

example:
  $ hexapod_comp classify --pictures out
  $ hexapod_comp classify --machine mine.yaml --model model.yaml --tilt-deg 0,5
  $ hexapod_comp classify --tilt-deg 0 --allow-um 50 --out ranking.csv""",
        (
            excluded_by("--model", "--budget", "--method", "--separate-joints", "--allow-um", "--workers",
                        "--scheduler", "--no-page", "--publish"),
        ),
    ),
}
