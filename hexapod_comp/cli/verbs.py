"""The verbs: each with its group, a summary, its options, its help, and rules for its options."""

# ruff: noqa: I001 (one name a line would be fifty)
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
    """A verb: a function of this name, of the parsed options, that returns an exit code or a Result."""

    module: str  # in which it is
    group: str  # under which heading it is listed
    summary: str  # one line
    options: tuple[Option, ...]
    text: str  # help below the options
    rules: tuple[Rule, ...] = ()


DESCRIPTION = """Error compensation for hexapod machine tools: tool poses in, compensated strut lengths out.

Lengths are shown in mm, corrections in µm, angles in degrees. A pose is the tool's pose in the work frame:
x, y, z and the angles α, β, γ with R = Ry(β)·Rx(α)·Rz(γ). A machine or model is a file, or the name of a
shipped one (paper, paper_machine, …)."""

EPILOG = """Verbs, options and files complete in the shell: pip install argcomplete, then
eval "$(register-python-argcomplete hexapod_comp)"."""

CORNERS = "X0,Y0,Z0,X1,Y1,Z1"

# Instruments for which plan can propose runs; a test compares them with the planner's own list, which is slow to import
INSTRUMENTS = (
    "linear", "straightness", "rotation", "5-D", "6-D", "tracker", "tracker_6d", "ball_bar", "station", "r_test",
)  # fmt: skip

CAMPAIGN = reads(
    "--campaign",
    "campaign file, or the name of a shipped one (default campaign_5d.yaml for the machine paper, else campaign)",
    kind="campaign",
)
TRACKER = value(
    "--topic",
    None,
    "TOPIC",
    "poses of the tool (PoseStamped), from a tracker or motion capture (default tool_pose_true, the simulated one)",
    default="tool_pose_true",
)

# Bounds of an imagined machine, by the names of ImperfectionBounds; defaults are those of `random`
BOUNDED = (
    ("--joints-um", bound, 1e-6, "joint", "every coordinate of every joint, ± µm (default 50)"),
    ("--struts-um", bound, 1e-6, "strut_offset", "every strut's length, ± µm (default 50)"),
    ("--pitch-ppm", bound, 1e-6, "pitch", "every screw's pitch, ± ppm (default 50)"),
    ("--wave-um", span, 1e-6, "wave", "amplitude of the screws' periodic error, µm (default 1,3)"),
    ("--harmonics-um", span, 1e-6, "harmonics", "the same of those two, three and four times a turn (default 0)"),
    ("--wave-period-mm", above_zero, 1e-3, "wave_period", "its period, mm (default: the geometry's lead, else 10)"),
    ("--map-um", bound, 1e-6, "length_map", "smooth length error of every strut, RMS µm (default 1)"),
    ("--backlash-um", span, 1e-6, "backlash", "backlash of every strut, µm (default 2,4)"),
    ("--wear-um", bound, 1e-6, "wear", "largest additional backlash where a screw is worn, µm (default 0)"),
    ("--strut-expansion-ppm-per-k", span, 1e-6, "strut_expansion", "thermal expansion of the struts (default 0)"),
    ("--body-expansion-ppm-per-k", span, 1e-6, "body_expansion", "the same of base and platform (default 0)"),
    ("--field-um", bound, 1e-6, "field_displacement", "largest displacement by a field in space, µm (default 0)"),
    ("--field-urad", bound, 1e-6, "field_rotation", "its largest rotation, µrad (default 0)"),
    ("--field-reversal-percent", bound, 1e-2, "field_reversal", "share of it that changes with direction (default 10)"),
)
BOUNDS = (
    *(value(name, scaled(read, size), "LOW,HIGH" if read is span else "NUMBER", text, dest=bound)
      for name, read, size, bound, text in BOUNDED),
    value("--box", box, CORNERS, "region of the field: lowest and highest tool position, mm (default: the reach of a "
                                 "level tool about home)"),
    flag("--separate-joints", "struts that share a platform joint get separate ones"),
)  # fmt: skip

# fmt: off
VERBS = {
    "show": Verb(
        "poses", "kinematics",
        "a machine at a glance: frames, joints, reach, largest box",
        (
            reads("machine", "geometry file, or the name of a shipped one", "MACHINE", "geometry"),
            pictures("out"),
            JSON,
        ),
        """Lengths in mm, angles in degrees: places of joints and frames, the reach and the limits that end it, the
largest box in it, which campaigns without a box use. Suspicious entries of the file come last. More:
doc/own_machine.md.

example:
  $ hexapod_comp show mine.yaml""",
    ),
    "ik": Verb(
        "poses", "kinematics",
        "strut lengths (mm) for a tool pose (mm, degrees) or a CSV file",
        (
            reads("poses", "CSV file of poses; - for standard input", "POSES.csv", "poses", nargs="?"),
            value("--pose", pose, SHAPE, POSE_HELP),
            value("--line", line, LINE_SHAPE, f"both ways along a straight line of the tool, {LINE_HELP}"),
            value("--step-mm", above_zero, "MM", "distance of the poses on that line (default 5)", default=5.0),
            DIRECTION,
            *FRAMES,
            table_out("the lengths"),
            JSON,
        ),
        """Columns of the file: x_mm, y_mm, z_mm, optionally alpha_deg, beta_deg, gamma_deg (or qx, qy, qz, qw) and
sequence or name; other units by their suffix (_m, _um, _in, _rad). CSV in gives CSV out, L1_mm … L6_mm, which fk
reads. With --model these are the lengths to command; nominal_L1_mm … and correction_L1_um … (command − nominal)
follow. Without a direction commands are the mean of both; along a line each strut moves as the line requires. Lengths
are computed for any pose; broken limits are reported on stderr (see check). More: doc/command_line.md.

example:
  $ hexapod_comp ik --pose 0,0,400,5,0,0
  $ hexapod_comp ik config/table1.csv --model paper_machine --out lengths.csv
  $ hexapod_comp ik --line=-200,0,450,200,0,450 --step-mm 5 --model paper_machine --out line.csv""",
        (
            exactly_one("poses", "--pose", "--line"),
            excluded_by("--line", "--direction"),
        ),
    ),
    "fk": Verb(
        "poses", "kinematics",
        "tool pose (mm, degrees) for six strut lengths (mm) or a CSV file",
        (
            reads("lengths_file", "CSV file; - for standard input", "LENGTHS.csv", "lengths", nargs="?"),
            value("--lengths", lengths, "L1,…,L6", "six lengths, mm"),
            value("--guess", pose, SHAPE, f"{POSE_HELP}; default home"),
            flag("--cold", "no guess: pick the working assembly mode"),
            flag("--all-modes", "list every assembly mode of the nominal machine"),
            DIRECTION,
            *FRAMES,
            table_out("the poses"),
            JSON,
        ),
        """Columns of the file: L1_mm … L6_mm (or _m, _um, _in), optionally sequence or name; CSV in gives CSV out,
which ik and check read. With --model the lengths are commands, and the pose is that of the real machine. Newton starts
at home, or at --guess; --cold takes the poses with these lengths that Newton finds from 4000 starts all around, and
selects the one in which the machine can work.

example:
  $ hexapod_comp fk --lengths 519.494,519.808,509.192,509.192,499.282,498.955
  $ hexapod_comp ik config/table1.csv | hexapod_comp fk -""",
        (
            exactly_one("lengths_file", "--lengths"),
            needed_by("--lengths", "--all-modes"),
            excluded_by("--model", "--all-modes"),
            excluded_by("--all-modes", "--cold", "--guess"),
            excluded_by("--cold", "--guess"),
        ),
    ),
    "check": Verb(
        "poses", "kinematics",
        "which pose of a CSV file breaks which limit, with all margins",
        (
            reads("poses", "CSV file of poses (mm, degrees); - for standard input", "POSES.csv", "poses"),
            flag("--stream", "rows are consecutive commands"),
            value("--rate-hz", finite, "HZ", "commands per second (default 250)", default=250.0),
            *FRAMES,
            table_out("all margins"),
            JSON,
        ),
        """By default the rows are targets: the tool moves from one to the next with a rest at each, as in `run`, and
the whole path is checked. With --stream the rows are consecutive commands at --rate-hz, and the steps and strut speeds
between them are checked. Limits hold for nominal and for compensated values (--model). Margins: stroke in mm to the
nearer end, joint cones in degrees, distance of the struts' axes in mm if the machine limits it; condition number,
correction (µm), step (mm) and speed (mm/s) are shown as values. Exit code 1: a limit is broken.

example:
  $ hexapod_comp check config/table1.csv""",
    ),
    "travel": Verb(
        "poses", "kinematics",
        "how far the tool may move each way, and which limit ends it",
        (
            value("--pose", pose, SHAPE, f"pose of the tool, {POSE_HELP} (default: home)"),
            *FRAMES,
            JSON,
        ),
        """Moves from the pose along x, y and z of the work frame, mm, and by each of its angles, degrees, with the
others fixed, forward and backward, up to a limit: stroke, joint cones, clearance of the struts, condition number,
correction, the field's box. Limits hold for nominal and for compensated values (--model); turns end at 180°. A
forbidden region narrower than a five-hundredth of the longest strut, or half a degree, may be missed.

example:
  $ hexapod_comp travel --pose 0,0,400,0,0,5 --model paper_machine.yaml""",
    ),
    "run": Verb(
        "running", "loop",
        "send poses through the loop: two simulated nodes, or your own",
        (
            reads("poses", "CSV file of poses (mm, degrees)", "POSES.csv", "poses"),
            MACHINE,
            TRUTH,
            value("--rate-hz", float, "HZ", "commands per second (default 250)", default=250.0),
            JSON,
            reads("--model", f"model that the compensator runs: file, shipped name, {WORDS}, or truth, the machine's "
                  "own errors "
                  "(default)", kind="model", default="truth"),
            pictures(),
            flag("--attach", "use nodes that already run; one pass, without changing them"),
            value("--namespace", None, "NAME", "namespace of those nodes", default=""),
        ),
        """The tool moves from pose to pose within the machine's limits and rests at each; its error (µm, µrad) is read
from tool_pose_true, from six poses on also with the datum aligned. Poses are the tool's in the work frame; columns as
of ik. The simulated machine has the errors of --truth; by default the compensator knows them. Exit code 1: commands
were lost or refused.

example:
  $ hexapod_comp run config/table1.csv --pictures out
  $ hexapod_comp run poses.csv --machine mine.yaml --truth random:7 --model model.yaml
  $ hexapod_comp run poses.csv --attach --rate-hz 100     (nodes already running in this ROS domain)""",
    ),
    "move": Verb(
        "running", "loop",
        "move a running machine's tool to a pose and wait for it",
        (
            value("--pose", pose, SHAPE, f"where to, {POSE_HELP}"),
            value("--frame", None, "NAME", "frame of the pose: work (default), base or a named one; with --relative "
                  "also tool", default="work"),
            flag("--relative", "move relative to the tool's present pose, along and about the frame's axes"),
            flag("--stop", "brake the present move, within the struts' limits"),
            NAMESPACE,
            JSON,
        ),
        """Sends the target to the node mover, which moves straight, with the shortest turn, in the least time that the
struts allow, and checks every limit first. Ctrl-C brakes. Exit code 2: refused, or stopped on the way, with the
reason. More: doc/ros.md.

example:
  $ ros2 run hexapod_comp mover     (beside the compensator)
  $ hexapod_comp move --pose 0,0,410,0,0,5
  $ hexapod_comp move --pose 0,0,2 --relative --frame tool""",
        (exactly_one("--pose", "--stop"),),
    ),
    "adapt": Verb(
        "running", "loop",
        "a machine calibrates itself, checks its model and repairs it",
        (
            MACHINE,
            folder("--folder", "folder of the journal, readings and models; what it has begun goes on", required=True),
            value("--goal-um", above_zero, "UM", "RMS tool error that may be left, with 95 %%, the datum aligned: "
                  "campaigns are planned for it (default: the folder's)"),
            reads("--campaign", "campaign file to measure instead; its box is checked", kind="campaign"),
            flag("--reload", "have the compensator run each model that its checks bear out; else models are proposed"),
            flag("--verify", "check the model of the folder once, now; calibrate nothing"),
            flag("--anew", "calibrate, whatever the folder has"),
            value("--checks", whole(0), "N", "then check the model N times (default 0; with --every-min until Ctrl-C)"),
            value("--every-min", bound, "MIN", "time from one check to the next (default 10)"),
            value("--box", box, CORNERS, "lowest and highest tool position that counts, mm (default: the "
                  "folder's, the campaign's, else the largest that the machine reaches)"),
            TRACKER,
            value("--samples", whole(3, 10_000), "N", "poses of which the median is taken, three times at each stop "
                  "(default 25)", default=25),
            NAMESPACE,
            JSON,
            *ESTIMATION,
        ),
        """Plans a campaign for the goal, has the mover visit it, fits a model, and takes check readings elsewhere.
Only a model that they bear out becomes FOLDER/model.yaml; with --reload the compensator then runs it. With --checks or
--every-min the model is then checked at that interval; what has changed is named, and repaired or proposed. Ctrl-C
brakes and ends; the same command goes on from FOLDER/journal.jsonl, also after a kill. Exit code 1: a model was
refused, or the machine has changed; 130: stopped. More: doc/staying_true.md.

example:
  $ ros2 launch hexapod_comp machine.launch.py mover:=true model_folder:=$PWD     (and a simulated machine)
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
        "a machine calibrates itself, warms up, is knocked and repaired: its error over time",
        (
            MACHINE,
            TRUTH,
            JSON,
            seed_of("noise, and of the strut that is knocked"),
            pictures("out"),
        ),
        """A virtual machine calibrates itself as adapt does; then its struts become warmer by 5 K, which no
thermometer reads, and one is knocked by 20 µm. Checks have to name each and repair the model. Errors in µm, the datum
aligned; no ROS runs. Exit code 1: warmth or knock was not named and repaired, or a model leaves more than promised (95
%). More: doc/demo.md.

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
            value("--host", None, "ADDRESS", "address to serve on (default 127.0.0.1: this computer alone; 0.0.0.0: "
                                             "all that can reach it)", default="127.0.0.1"),
            value("--port", whole(1, 65535), "N", "port to serve on (default 8080)", default=8080),
        ),
        """Serves a page to this computer alone, unless --host gives another address, until Ctrl-C. It only subscribes:
nothing on it moves or changes anything. It needs viser: pip install viser. More: doc/ros.md.

example:
  $ hexapod_comp watch --machine mine.yaml""",
    ),
    "echo": Verb(
        "running", "loop",
        "print a topic of a running machine with units, rate and age",
        (
            value("topic", None, "TOPIC", "name of a topic (default: list those that are published)", nargs="?"),
            NAMESPACE,
            value("--count", count, "N", "end after N messages"),
            value("--seconds", above_zero, "S", "end after S seconds (default: at Ctrl-C)"),
            flag("--hz", "print the rate once a second instead of the messages"),
            JSON,
        ),
        """Struts in mm, corrections in µm, poses in mm and degrees, predicted errors in µm and µrad with their
standard deviations; above each message its rate over the last 2 s and its age, from its stamp to its receipt. With
--json each message is one line. Exit code 1: no message arrived.

example:
  $ hexapod_comp echo strut_corrections --count 1
  $ hexapod_comp echo strut_commands --hz --seconds 10""",
    ),
    "record": Verb(
        "running", "loop",
        "record a running machine's topics, for replay",
        (
            folder("--out", "folder for the bag (MCAP); must not exist", dest="folder", required=True),
            NAMESPACE,
            value("--seconds", above_zero, "S", "end after this time (default: at Ctrl-C)"),
            JSON,
        ),
        """Writes commands, readings, estimates, diagnostics and the compensator's journal as ros2 bag does, into a
folder with an MCAP file; it may begin during a motion. Exit code 1: no compensator published, so that nothing can be
replayed.

example:
  $ hexapod_comp record --out run
  $ hexapod_comp replay run""",
    ),
    "replay": Verb(
        "running", "loop",
        "run a recorded bag through the compensator again: the same bits?",
        (
            reads("bag", "folder of a bag, .mcap or .db3 file", "BAG"),
            value("--namespace", None, "NAME", "namespace of the machine, when the bag holds several"),
            reads("--machine", "geometry file, or the name of a shipped one (default: the recording's)",
                  kind="geometry"),
            reads("--model", f"model file, the name of a shipped one, {WORDS} (default: the recording's)",
                  kind="model"),
            value("--tolerance-um", bound, "UM", "accept differences up to this, µm (default 0: the same bits)",
                  default=0.0),
            pictures(),
            table_out("all corrections"),
            JSON,
        ),
        """BAG must hold compensator/journal; with compensator/files it contains the geometry and the model in use. The
tool's distance from its path is given in µm: as the machine stands, and with the datum aligned. With another --model
(or --machine) the report also shows the corrections that it would have made. Exit code 1: not the same bits, or not
within --tolerance-um. More: doc/replay.md.

example:
  $ ros2 bag record --storage mcap --output run --all
  $ hexapod_comp replay run --pictures out/replay""",
    ),
    "plan": Verb(
        "fitting", "calibration",
        "what a campaign will determine; or which one a goal needs",
        (
            reads("campaign", "campaign file, or the name of a shipped one; with --goal-um optional: only its box and "
                              "noise are used", "CAMPAIGN", "campaign", nargs="?"),
            MACHINE,
            value("--repeatability-um", bound, "UM", "standard deviation of the machine's stops, along each axis "
                                                     "(default: the campaign's)"),
            *under(
                "proposing a campaign",
                value("--goal-um", above_zero, "UM", "allowed RMS tool error, the datum aligned: propose a campaign "
                                                     "that reaches it"),
                value("--tilt-deg", bound, "DEG", "tilt of the tool at which the goal must also hold (default 0)"),
                value("--tools-kg", numbers, "KG,…", "masses of other tools that the model will be told, for which the "
                                                    "goal must also hold, and with which readings may be taken (with "
                                                    "--load)"),
                value("--gravity", vector, "X,Y,Z", "the same for another direction of gravity in base, m/s²; may be "
                                                     "repeated", action="append"),
                value("--instruments", None, "A,B,…", f"available instruments: {', '.join(INSTRUMENTS)} (default "
                                                      "linear)"),
                value("--hours", above_zero, "H", "time available for measuring (default 4)"),
                value("--time", times, "NAME=MIN,MIN,S", "times of an instrument: minutes to set up, minutes a run, "
                                                         "seconds a stop; may be repeated", action="append"),
                writes("--out", "write the proposed campaign to a file (YAML)", "CAMPAIGN"),
            ),
            *ESTIMATION,
            seed_of("scattered poses"),
            JSON,
        ),
        """Predicts, without readings, which parameters a campaign would determine, which it would not, and which tool
error (µm) a fit will leave on a machine within the tolerances. With --goal-um it proposes a campaign: lines and poses
in measuring order, within the limits, that reduce the tool error (µm, RMS, the datum aligned) to the goal in the
available time. Exit code 1: the goal is not met. More: doc/measuring.md.

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
        "draw a virtual machine with hidden errors, for any geometry",
        (
            MACHINE,
            *under("how imperfect it may be", *BOUNDS),
            seed_of("the machine", 1),
            value("--name", None, "TEXT", "name of the model (default virtual-SEED)"),
            writes("--out", "write the errors to a model file (YAML)", "MODEL", required=True),
            JSON,
        ),
        """Draws the errors uniformly within the bounds; a bound of 0 leaves that error out. The same seed gives the
same machine; changing one bound does not change the other errors. Wherever an option accepts a truth or a model,
`random` is the machine that this verb draws without any option, and `random:7` the one of --seed 7.

example:
  $ hexapod_comp imagine --machine mine.yaml --joints-um 100 --backlash-um 3,5 --seed 3 --out truth.yaml
  $ hexapod_comp simulate --machine mine.yaml --truth truth.yaml --campaign mine_5d.yaml --out measured.csv""",
    ),
    "outside": Verb(
        "measuring", "calibration",
        "put a table of errors over elevation, say, into a model",
        (
            reads("table", "CSV file: one or two outside numbers, x, y, z, rx, ry, rz", "TABLE.csv"),
            Option("--holds", "what it holds: where the tool goes beyond its command, or what is added to commands",
                   {"choices": ("errors", "corrections"), "required": True}),
            choice("--beyond", ("hold", "refuse"), "outside the table: its edge's value holds, or commands are "
                   "refused (default hold)", "hold"),
            value("--calibrated-at", outside_numbers, "NAME_UNIT=NUMBER,…", "where the model was calibrated: the table "
                  "is made zero there"),
            MACHINE,
            MODEL,
            writes("--out", "write the model to a YAML file", "MODEL", required=True),
            JSON,
        ),
        """Columns: one or two outside numbers (elevation_deg, rotation_deg; oil_degC), and x_um, y_um, z_um of the
field's measured point in base, rx_urad, ry_urad, rz_urad about it, in any unit; a row a node of their grid. Between
nodes the table is bilinear. Frame and sign: doc/model_file.md.

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
            reads("--warm-up", "file that describes a warm-up during the measurement, warm_up for the shipped one: "
                               "then x, y and z lines are repeated", kind="warm_up"),
            seed_of("all random draws"),
            writes("--out", "write the readings to a CSV file", type=csv_file, required=True),
            JSON,
        ),
        """Writes the readings of the instruments of a campaign, with noise and unknown zeros, for fit: one reading a
row, measured minus commanded, in um and urad. --model measures the machine with that model's compensation. --warm-up
warm_up warms it after the campaign, and reads three lines again every ten minutes. The same seed gives the same file.
More: doc/measuring.md.

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
            value("--readings", None, "TOPIC", "single readings (JointState: names are channels) of a laser or ball "
                  "bar; lines, lengths and displacements are then read from it", default=""),
            choice("--tracker-frame", ("free", "known"), "known: poses are measured in base (default); free: in an "
                   "unknown frame", "known"),
            flag("--confirm", "wait for Enter before each run that --readings reads, while the instrument is set up"),
            value("--samples", whole(3, 10_000), "N", "readings at each stop, whose median is used (default 25)",
                  default=25),
            seed_of("the scattered poses"),
            writes("--out", "write the readings to a CSV file; an incomplete one of this campaign is "
                            "completed", type=csv_file,
                   required=True),
            NAMESPACE,
            JSON,
        ),
        """Has the mover visit a campaign's stations and reads the instruments there when the tool has settled. The
file is complete at any time: Ctrl-C, or a mover that was stopped, ends the run, and the same command resumes it.
Readings beyond any machine's errors (another unit, sign, channel, frame or target) end the run after the first line.
Exit code 1: some readings are missing. More: doc/measuring.md.

example:
  $ ros2 launch hexapod_comp machine.launch.py mover:=true     (compensator, mover and a simulated machine)
  $ hexapod_comp collect --campaign campaign_1d --out measured.csv
  $ ros2 launch hexapod_comp machine.launch.py mover:=true instrument:=laser     (in place of the first)
  $ hexapod_comp collect --campaign campaign_1d --readings instrument/readings --out laser.csv""",
    ),
    "fit": Verb(
        "fitting", "calibration",
        "fit a model of the machine's errors to measurements",
        (
            *readings(),
            choice("--scheme", ("joint", "lines"), "how to fit (default joint)", "joint"),
            writes("--out", "write the model to a YAML file", "MODEL", required=True),
            value("--name", None, "TEXT", "name of the model"),
            value("--datum", pose, "POSE", f"tool pose in work that the model does not move, {POSE_HELP} (default: "
                                           "home)"),
            writes("--report", "write the report to a file too"),
            writes("--certificate", "write a calibration certificate, an HTML page to file or print (scheme joint)",
                   "FILE.html", type=html_file),
            reads("--details", "the certificate's information on instruments, place and people (YAML)"),
            pictures(),
            JSON,
            reads("--truth", f"errors of the virtual machine that was measured: file, shipped name, {WORDS}",
                  kind="model"),
            flag("--force", "write a model that the readings contradict"),
            Option("--assumptions", "print the assumptions of all fits, with units and sources",
                   {"action": Assumptions, "nargs": 0}),
            reads("--update", "renew this model from few readings, with its fit's result as the prior", "MODEL"),
            COMPENSATED,
            *ESTIMATION,
            *under(
                "scheme joint",
                value("--scale-ppm", scaled(bound, 1e-6), "PPM", "scale error of the instrument, 1 σ, ppm (scheme "
                      "joint; default by its class: laser 0.5, tracker 10)", dest="scale"),
                value("--alignment-mrad", scaled(bound, 1e-3), "MRAD", "angle between a laser's beam and its line, "
                      "1 σ, mrad (scheme joint; default 0.5)", dest="alignment"),
                flag("--not-robust", "give full weight to readings that disagree with the rest (scheme joint)"),
            ),
        ),
        """Reads tidy CSV (one reading a row, as simulate writes it), or with --columns the wide CSV files of other
laboratories. --scheme joint fits structure, struts and field to all readings at once, and keeps only blocks that
improve the prediction of readings left out; --scheme lines is that of Mou & King 1998: a polynomial per grid line,
direction and channel. The report (µm, µrad) compares with the --truth that simulate moved. Exit code 1: the readings
contradict the model; nothing is written without --force. More: doc/fitting.md.

example:
  $ hexapod_comp simulate --campaign campaign_5d --seed 1 --out measured.csv
  $ hexapod_comp fit measured.csv --out model.yaml --pictures out
  $ hexapod_comp run poses.csv --model model.yaml""",
        (
            needed_by("--certificate", "--details"),
            needed_by("--update", "--compensated"),
            excluded_by("--scheme lines", *(o.name for o in ESTIMATION), "--scale-ppm", "--alignment-mrad",
                        "--not-robust", "--certificate"),
            excluded_by("--update", "--scheme", *(o.name for o in ESTIMATION), "--not-robust", "--pictures", "--truth",
                        "--datum", "--certificate", "--details"),
        ),
    ),
    "verify": Verb(
        "fitting", "calibration",
        "check by few readings whether a model holds, and what has changed",
        (
            reads("model", "model file that fit has written, MODEL.posterior.npz beside it", "MODEL"),
            *readings(required=False),
            COMPENSATED,
            writes("--propose", "instead: write which readings to take, a tidy CSV file without values"),
            value("--readings", int, "N", "number of readings (default 12)"),
            value("--instruments", None, "A,B", "instruments: linear, straightness, rotation, tracker, tracker_6d "
                                                "(default linear,rotation)"),
            JSON,
        ),
        """Compares 6 to 20 check readings, spread over the box, with the model and the uncertainty of its parameters,
and gives the most probable change: of the datum, a strut's offset, a temperature, the whole, a single reading, or how
they were taken. Take them as for fit: compensation off, or with the struts' commands in the file, or with this model
running and --compensated. fit --update renews the model from them. Errors in µm; exit code 1: changed. More:
doc/fitting.md.

example:
  $ hexapod_comp verify model.yaml check.csv
  $ hexapod_comp fit check.csv --update model.yaml --out renewed.yaml""",
        (
            some_of("files", "--propose"),
            excluded_by("--propose", "files", "--compensated"),
            needed_by("--propose", "--readings", "--instruments"),
        ),
    ),
    "iso230": Verb(
        "measuring", "calibration",
        "the figures of ISO 230-2, 230-4 and 230-6 of readings",
        (
            *readings(),
            flag("--targets", "each run target by target, with notes"),
            JSON,
        ),
        """Evaluates every linear run with two cycles or more and all targets read from both sides in each: along an
axis of the work frame by ISO 230-2:2014, others by ISO 230-6:2002 (A, E, R, M, B); lengths around a circle by ISO
230-4:2005 (G, G(b), F, D). Figures are in µm. More: doc/iso230.md.

example:
  $ hexapod_comp iso230 measured.csv""",
    ),
    "export": Verb(
        "export", "calibration",
        "write a model for LinuxCNC or as a table; check its residual error",
        (
            MACHINE,
            MODEL,
            OUTSIDE,
            folder("--linuxcnc", "folder for LinuxCNC's files; made if it is missing"),
            writes("--table", "CSV file for the trilinear table", "FILE.csv", type=csv_file),
            folder("--c", "folder for the compensator in C with this machine's constants", dest="c_folder"),
            folder("--ros2-control", "folder for a ROS 2 package: this machine's compensation as a controller of "
                   "ros2_control, and configurations"),
            value("--rate", whole(1, 10_000), "HZ", "of ros2_control's loop (default 250)", default=250),
            value("--joint-names", joint_names, "A,B,C,D,E,F", "the struts' joints in URDF, MJCF and ros2_control "
                  "(default strut_1,…,strut_6)"),
            writes("--urdf", "file for the machine as URDF: robot_state_publisher, RViz, ros2_control; needs no "
                   "model", "FILE.urdf"),
            writes("--mjcf", "file for the machine as MuJoCo's MJCF, loops closed; needs no model", "FILE.xml"),
            choice("--units", ("mm", "inch"), "LinuxCNC's machine unit, [TRAJ]LINEAR_UNITS (default mm)", "mm"),
            value("--box", box, CORNERS, "lowest and highest tool position, mm (default: the model's valid box, else "
                  "its field's)"),
            value("--step-mm", above_zero, "MM", "largest step of the table (default 25.4)", default=25.4),
            value("--poses", whole(1000), "N", "random poses to check (default 1000, the least)", default=1000),
            value("--tilt-deg", bound, "DEG", "tilt to check (default 5)", default=5.0),
            seed_of("the random poses"),
            JSON,
        ),
        """--linuxcnc writes genhexkins.hal, strut_1.comp … strut_6.comp and comp.ini; --table corrections of struts
and poses on a grid. Every file is then read back, and drives the machine of the model along random poses: the report
gives the tool's 3-D error before and after, and the errors that the export does not contain. Files of the same names
are replaced. Exit code 1: it would increase the error. More: doc/exporting.md, doc/linuxcnc.md, doc/c_core.md,
doc/ros.md.

example:
  $ hexapod_comp export --machine paper.yaml --model paper_machine.yaml --linuxcnc linuxcnc --table table.csv""",
        (some_of("--linuxcnc", "--table", "--c", "--ros2-control", "--urdf", "--mjcf"),),
    ),
    "assess": Verb(
        "poses", "analysis",
        "effect of random imperfections within bounds on lengths and poses",
        (
            reads("poses", "CSV file of poses (mm, degrees; default: Table 1 of Song, Mou & King); - for standard "
                  "input", "POSES.csv", "poses", nargs="?", default="table1.csv"),
            value("--joint-um", bound, "UM", "bound of each coordinate of each joint, ± µm (default 10)", default=10.0),
            value("--strut-um", bound, "UM", "bound of each strut's length, ± µm (default 10)", default=10.0),
            value("--machines", count, "N", "how many to draw (default 1)", default=1),
            seed_of("the first machine"),
            MACHINE,
            table_out("every machine and pose"),
            JSON,
        ),
        """Draws machines within the bounds (uniform, ±). For the first one it prints the tables of Song, Mou & King:
the ideal strut lengths (mm), those that the real machine needs for the same poses, their difference (µm), and the pose
(mm, degrees) of the real machine with ideal lengths; with --machines N also percentiles over N consecutive seeds.

example:
  $ hexapod_comp assess config/table1.csv --joint-um 10 --strut-um 10 --machines 200 --seed 1""",
    ),
    "classify": Verb(
        "classify", "analysis",
        "rank a machine's errors by their effect on the tool",
        (
            machine("positioning_unit.yaml"),
            reads("--budget", "error budget, or the name of a shipped one (default error_budget.yaml)",
                  kind="error_budget", default="error_budget.yaml"),
            reads("--model", "instead of a budget: rank the uncertainties of this model's fit, and the measurements "
                             "that would reduce them most", kind="model"),
            table_out("the ranking"),
            pictures(),
            JSON,
            SEPARATE,
            value("--cells", count, "N", "cells along the grid's longest edge (default 30)", default=30),
            value("--clearance-mm", bound, "MM", "smallest distance between the axes of two struts, mm; 0: not limited "
                  "(default: the geometry's)"),
            value("--tilt-deg", tilts, "A,B,…", "tilts about the tool's x and y, from its attitude at home (default "
                  "-4,0,4)", default=tilts("-4,0,4")),
            choice("--method", ("exact", "linear"), "of the ranking: exact (default), or to first order",
                   "exact"),
            value("--allow-um", above_zero, "UM", "allowed error of the tool: gives the allowed size of each error"),
            value("--workers", whole(1, 256), "N", "processes (default 1, with all threads)", default=1),
            value("--scheduler", None, "tcp://…", "Dask scheduler that runs the work instead"),
            seed_of("random poses and draws"),
            flag("--no-page", "omit the interactive page from --pictures"),
            flag("--publish", "then keep the worst type's shells on workspace/shells until Ctrl-C"),
        ),
        """Computes the reach of the machine and, at every grid point of it, the effect (µm, mdeg) of every single
error of the budget, by forward kinematics of the machine with that error: the ranked table of v. Daake et al., and
with --allow-um the allowed size of each error. --pictures also writes page.html, where plotly is installed. --model
uses the covariance of a fit instead of a budget: the remaining tool error, its causes, and the measurement that would
reduce it most. More: doc/classification.md.

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
