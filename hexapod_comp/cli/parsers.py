"""The parsers of all verbs. This loads nothing heavy: ``--help`` and the shell's completion answer at once.

Three options mean the same wherever they stand. ``--out`` is the file to which a verb writes what it makes,
``--pictures`` is the folder for its pictures, and ``--json`` prints the result as JSON in place of text, with the
units in the keys.
"""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Callable
from itertools import groupby
from typing import Any, NoReturn

from . import arguments
from .verbs import DESCRIPTION, EPILOG, VERBS

PROGRAM = "hexapod_comp"

ALIASES = {"simulate": ("measure",)}
"""Old names of verbs, which still work."""

GONE = {"paper": "is `make papers` in the source tree now (python -m examples.papers)"}
"""Verbs that went, and where to."""

SHAPE = "X,Y,Z[,A,B,C]"

LINE_SHAPE = "X,Y,Z,X,Y,Z[,A,B,C]"

WORDS = "ideal, random or random:SEED"
"""Models that are no files."""


class _Parser(argparse.ArgumentParser):
    """Says which option was meant."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        options = [option for option in self._option_string_actions if option.startswith("--")]
        names = [] if self._subparsers is not None else [one.partition("=")[0] for one in args if one.startswith("--")]
        for name in names:
            if name == "--":
                break
            if not any(option.startswith(name) for option in options):
                near = difflib.get_close_matches(name, options, 1)
                self.error(f"there is no option {name}" + (f"; did you mean {near[0]}?" if near else ""))
        return super().parse_known_args(args, namespace)


def unknown_verb(name: str) -> str | None:
    """Return None for a verb, else which one may have been meant, to follow a complaint."""
    names = [*VERBS, *(alias for aliases in ALIASES.values() for alias in aliases)]
    if name in names:
        return None
    near = difflib.get_close_matches(name, names, 1)
    return f"; did you mean {near[0]}?" if near else ""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; it leaves the verb as ``verb``, and the name under which it was called as ``called``."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(PROGRAM, description=DESCRIPTION, epilog=EPILOG, formatter_class=raw)
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and leave")
    hint = "VERB --help gives its options, units and an example"
    subparsers = parser.add_subparsers(
        title="verbs", description=_listed(), dest="called", metavar="VERB", required=True, help=hint
    )
    for name, (_, summary, text) in VERBS.items():
        verb = subparsers.add_parser(
            name, aliases=ALIASES.get(name, ()), description=summary, epilog=text, formatter_class=raw
        )
        OPTIONS[name](verb)
        verb.set_defaults(verb=name)
    return parser


def _listed() -> str:
    """Return the verbs in their groups, a line each."""
    lines = []
    for group, verbs in groupby(VERBS.items(), lambda item: item[1].group):
        lines += [f"{group}:", *(f"  {name:<9} {verb.summary}" for name, verb in verbs)]
    return "\n".join(lines)


class _Version(argparse.Action):
    """Print the version of the code that runs."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from ..formats.paths import version

        print(f"{PROGRAM} {version()}")
        parser.exit()


class _Renamed(argparse.Action):
    """Refuse an option of an older version, and say what it is called now."""

    def __call__(self, parser: argparse.ArgumentParser, _: object, __: object, option: str | None = None) -> NoReturn:
        parser.error(f"argument {option}: is now {self.const}")


Add = Callable[..., Any]
"""``add_argument`` of a parser."""


class _Given(argparse.Action):
    """Store a machine, and that it was given."""

    def __call__(self, _: object, namespace: argparse.Namespace, value: Any, __: str | None = None) -> None:
        namespace.machine, namespace.machine_given = value, True


def _machine(add: Add, default: str = "paper.yaml") -> None:
    text = f"geometry file, or the name of a shipped one (default {default})"
    add("--machine", metavar="FILE", action=_Given, default=default, help=text)


def _machine_and_model(add: Add) -> None:
    _machine(add)
    text = f"model of the machine's errors: a file, the name of a shipped one, {WORDS} (default ideal)"
    add("--model", metavar="FILE", default="ideal", help=text)


def _machine_model_frames(add: Add) -> None:
    _machine_and_model(add)
    add("--tool", metavar="NAME", help="one of the geometry file's `tools` (default: its `tool`)")
    add("--work", metavar="NAME", help="the poses' frame: one of its `work_frames`, or base (default: its `work`)")


def _direction(add: Add) -> None:
    text = "the direction in which every axis and every strut last moved (default: not known, midway between both)"
    add("--direction", choices=arguments.DIRECTIONS, help=text)


def _json(add: Add) -> None:
    add("--json", action="store_true", help="print JSON, for programs, in place of text; units are in the keys")


def _table_out(add: Add, what: str) -> None:
    add("--out", type=arguments.csv_file, metavar="FILE", help=f"write {what} to a CSV file")


def _pictures(add: Add, default: str | None = None) -> None:
    text = "folder for pictures; made if it is missing" + (f" (default {default})" if default else "")
    add("--pictures", metavar="FOLDER", default=default, help=text)


def _seed(add: Add, what: str, default: int = 0) -> None:
    add("--seed", type=arguments.seed, default=default, metavar="N", help=f"of {what} (default {default})")


def _show(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("machine", metavar="MACHINE", help="geometry file, or the name of a shipped one")
    _pictures(add, "out")
    _json(add)


def _ik(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("poses", nargs="?", metavar="POSES.csv", help="CSV file of poses; - for standard input")
    add("--pose", type=arguments.pose, metavar=SHAPE, help=arguments.POSE_HELP)
    for name in arguments.POSE_OPTIONS:
        unit = "mm" if name.endswith("mm") else "degrees"
        text = f"the pose number by number, {unit}"
        add(f"--{name.replace('_', '-')}", type=arguments.finite, metavar="NUMBER", help=text)
    text = f"both ways along a straight line of the tool, {arguments.LINE_HELP}"
    add("--line", type=arguments.line, metavar=LINE_SHAPE, help=text)
    text = "distance of the poses on that line (default 5)"
    add("--step-mm", type=arguments.above_zero, default=5.0, metavar="MM", help=text)
    _direction(add)
    _machine_model_frames(add)
    _table_out(add, "the lengths")
    _json(add)


def _fk(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("lengths_file", nargs="?", metavar="LENGTHS.csv", help="CSV file; - for standard input")
    add("--lengths", type=arguments.lengths, metavar="L1,…,L6", help="six lengths, mm")
    start = parser.add_mutually_exclusive_group().add_argument
    start("--guess", type=arguments.pose, metavar=SHAPE, help=f"{arguments.POSE_HELP}; default home")
    start("--cold", action="store_true", help="no guess: pick the working assembly mode")
    start("--all-modes", action="store_true", help="list every assembly mode of the nominal machine")
    _direction(add)
    _machine_model_frames(add)
    _table_out(add, "the poses")
    _json(add)


def _check(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("poses", metavar="POSES.csv", help="CSV file of poses (mm, degrees); - for standard input")
    add("--stream", action="store_true", help="rows are consecutive commands")
    add("--rate-hz", type=arguments.finite, default=250.0, metavar="HZ", help="commands per second (default 250)")
    _machine_model_frames(add)
    _table_out(add, "all margins")
    _json(add)


def _travel(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--pose", type=arguments.pose, metavar=SHAPE, help=f"where the tool is, {arguments.POSE_HELP} (default: home)")
    _machine_model_frames(add)
    _json(add)


def _loop(add: Add) -> None:
    """Add what ``run`` and ``demo`` share."""
    _machine(add)
    _truth(add)
    add("--rate-hz", type=float, default=250.0, metavar="HZ", help="commands per second (default 250)")
    add("--plot", action=_Renamed, const="--pictures FOLDER", metavar="PNG", help=argparse.SUPPRESS)
    _json(add)


def _run(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("poses", metavar="POSES.csv", help="CSV file of poses (mm, degrees)")
    _loop(add)
    text = f"model that the compensator runs: file, shipped name, {WORDS}, or truth, the machine's own errors (default)"
    add("--model", metavar="FILE", default="truth", help=text)
    _pictures(add)
    add("--attach", action="store_true", help="use nodes that already run; one pass, as they are")
    add("--namespace", default="", metavar="NAME", help="namespace of those nodes")
    add("--no-compare", action="store_true", help="leave out the simulated pass without compensation")


def _demo(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _loop(add)
    text = f"model that the compensator runs: fit, made of laser readings (default); truth; file, shipped name, {WORDS}"
    add("--model", metavar="FILE", default="fit", help=text)
    _seed(add, "noise and poses")
    _pictures(add, "out")


def _watch(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _machine(add)
    add("--namespace", default="", metavar="NAME", help="where the machine's nodes are (default: none)")
    text = "address to serve on (default 127.0.0.1: this computer alone; 0.0.0.0: all that reach it)"
    add("--host", default="127.0.0.1", metavar="ADDRESS", help=text)
    add("--port", type=arguments.port, default=8080, metavar="N", help="port to serve on (default 8080)")


def _echo(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("topic", nargs="?", metavar="TOPIC", help="name of a topic (default: list those that are published)")
    add("--namespace", default="", metavar="NAME", help="where the machine's nodes are (default: none)")
    add("--count", type=arguments.count, metavar="N", help="end after N messages")
    add("--seconds", type=arguments.above_zero, metavar="S", help="end after S seconds (default: at Ctrl-C)")
    add("--hz", action="store_true", help="print the rate once a second in place of the messages")
    _json(add)


def _record(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "folder for the bag (MCAP); must not be there yet"
    add("--out", dest="folder", required=True, metavar="FOLDER", help=text)
    add("--namespace", default="", metavar="NAME", help="where the machine's nodes are (default: none)")
    add("--seconds", type=arguments.above_zero, metavar="S", help="end after so long (default: at Ctrl-C)")
    _json(add)


def _replay(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("bag", metavar="BAG", help="folder of a bag, .mcap or .db3 file")
    add("--namespace", metavar="NAME", help="the machine meant, when the bag holds several")
    own = "(default: what the recording carries)"
    add("--machine", metavar="FILE", help=f"geometry file, or the name of a shipped one {own}")
    add("--model", metavar="FILE", help=f"model file, the name of a shipped one, {WORDS} {own}")
    text = "accept differences up to this, µm (default 0: the same bits)"
    add("--tolerance-um", type=arguments.bound, default=0.0, metavar="UM", help=text)
    _pictures(add)
    _table_out(add, "all corrections")
    _json(add)


def _plan(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "campaign file, or the name of a shipped one; with --goal-um optional: whose box and noise count"
    add("campaign", nargs="?", metavar="CAMPAIGN", help=text)
    _machine(add)
    text = "standard deviation of where the machine stops, along each axis (default: the campaign's)"
    add("--repeatability-um", type=arguments.bound, metavar="UM", help=text)
    goal = parser.add_argument_group("proposing a campaign").add_argument
    text = "RMS tool error that may be left, the datum aligned: propose a campaign for it"
    goal("--goal-um", type=arguments.above_zero, metavar="UM", help=text)
    text = "tilt of the tool at which it must hold too (default 0)"
    goal("--tilt-deg", type=arguments.bound, metavar="DEG", help=text)
    text = f"what there is to measure with: {', '.join(arguments.INSTRUMENTS)} (default linear)"
    goal("--instruments", metavar="A,B,…", help=text)
    goal("--hours", type=arguments.above_zero, metavar="H", help="how long measuring may take (default 4)")
    text = "how long an instrument takes: minutes to put it up, minutes a run, seconds a stop; may be repeated"
    goal("--time", type=arguments.times, action="append", metavar="NAME=MIN,MIN,S", help=text)
    goal("--out", metavar="CAMPAIGN", help="write the proposed campaign to a file (YAML)")
    _estimation(parser)
    _seed(add, "scattered poses")
    _json(add)


def _truth(add: Add) -> None:
    """Add the hidden errors of a virtual machine."""
    default = "(default: paper_machine for the paper's machine, random for others)"
    add("--truth", metavar="FILE", help=f"errors of the virtual machine: file, shipped name, {WORDS} {default}")


def _imagine(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _machine(add)
    _bounds(parser)
    _seed(add, "the machine", 1)
    add("--name", metavar="TEXT", help="name of the model (default virtual-SEED)")
    add("--out", metavar="MODEL", required=True, help="write the errors to a model file (YAML)")
    _json(add)


def _bounds(parser: argparse.ArgumentParser) -> None:
    """Add how imperfect an imagined machine may be; defaults are those of ``random``."""
    add = parser.add_argument_group("how imperfect it may be").add_argument
    one, spans = "NUMBER", "LOW,HIGH"
    for name, kind, metavar, text in (
        ("joints-um", arguments.bound, one, "every coordinate of every joint, ± µm (default 50)"),
        ("struts-um", arguments.bound, one, "every strut's length, ± µm (default 50)"),
        ("pitch-ppm", arguments.bound, one, "every screw's pitch, ± ppm (default 50)"),
        ("wave-um", arguments.span, spans, "amplitude of the screws' periodic error, µm (default 1,3)"),
        ("harmonics-um", arguments.span, spans, "the same of those two, three and four times a turn (default 0)"),
        ("wave-period-mm", arguments.above_zero, one, "its period, mm (default: the geometry's lead, else 10)"),
        ("map-um", arguments.bound, one, "smooth length error of every strut, RMS µm (default 1)"),
        ("backlash-um", arguments.span, spans, "backlash of every strut, µm (default 2,4)"),
        ("wear-um", arguments.bound, one, "how much more of it a screw has where it is worn most, µm (default 0)"),
        ("strut-expansion-ppm-per-k", arguments.span, spans, "thermal expansion of the struts (default 0)"),
        ("body-expansion-ppm-per-k", arguments.span, spans, "the same of base and platform (default 0)"),
        ("field-um", arguments.bound, one, "largest displacement by a field in space, µm (default 0)"),
        ("field-urad", arguments.bound, one, "its largest rotation, µrad (default 0)"),
        ("field-reversal-percent", arguments.bound, one, "share of it that changes with direction (default 10)"),
    ):
        add(f"--{name}", type=kind, metavar=metavar, help=text)
    text = "where the field is: lowest and highest tool position, mm (default: what a level tool reaches about home)"
    add("--box", type=arguments.box, metavar="X0,Y0,Z0,X1,Y1,Z1", help=text)
    add("--separate-joints", action="store_true", help="struts that share a platform joint each get one of their own")


def _simulate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _machine_and_model(add)
    _truth(add)
    text = "campaign file, or the name of a shipped one (default campaign_5d.yaml for the machine paper, else campaign)"
    add("--campaign", metavar="FILE", help=text)
    text = "file of how the machine warms meanwhile, warm_up for the shipped one: then x, y and z lines again and again"
    add("--warm-up", metavar="FILE", help=text)
    _seed(add, "all that is random")
    add("--out", type=arguments.csv_file, metavar="FILE", required=True, help="write the readings to a CSV file")
    _json(add)


def _fit(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _readings(add)
    add("--scheme", choices=("joint", "lines"), default="joint", help="how to fit (default joint)")
    add("--out", metavar="MODEL", required=True, help="write the model to a YAML file")
    add("--name", metavar="TEXT", help="name of the model")
    text = f"tool pose in work that stays where it is, {arguments.POSE_HELP} (default: home)"
    add("--datum", type=arguments.pose, metavar="POSE", help=text)
    add("--report", metavar="FILE", help="write the report to a file too")
    text = "write a calibration certificate, a page to be filed or printed (scheme joint)"
    add("--certificate", type=arguments.html_file, metavar="FILE.html", help=text)
    add("--details", metavar="FILE", help="what the certificate says of instruments, place and people (YAML)")
    now = "always written, beside the model, as MODEL.posterior.npz"
    add("--covariance", action=_Renamed, const=now, metavar="FILE.npz", help=argparse.SUPPRESS)
    _pictures(add)
    _json(add)
    add("--truth", metavar="FILE", help=f"errors of the virtual machine that was measured: file, shipped name, {WORDS}")
    add("--force", action="store_true", help="write a model that the readings do not bear out")
    add("--update", metavar="MODEL", help="renew this model from few readings, what its fit knows as the prior")
    _compensated(add)
    _estimation(parser)
    text = "scale error of the instrument, 1 σ, ppm (scheme joint; default by its class: laser 0.5, tracker 10)"
    add("--scale-ppm", type=arguments.bound, metavar="PPM", help=text)
    text = "angle between a laser's beam and its line, 1 σ, mrad (scheme joint; default 0.5)"
    add("--alignment-mrad", type=arguments.bound, metavar="MRAD", help=text)
    add("--not-robust", action="store_true", help="trust readings that disagree with the rest (scheme joint)")
    text = "what picks the polynomials' order (scheme lines; default adjusted-r2)"
    add("--order", choices=("adjusted-r2", "aicc"), help=text)
    add("--every-line", action="store_true", help="report order, R² and residual of each line (scheme lines)")


def _verify(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("model", metavar="MODEL", help="model file that fit has written, MODEL.posterior.npz beside it")
    _readings(add, required=False)
    _compensated(add)
    add("--propose", metavar="FILE", help="instead: write which readings to take, a tidy CSV file without values")
    add("--readings", type=int, metavar="N", help="how many of them (default 12)")
    text = "what takes them: linear, straightness, rotation, tracker, tracker_6d (default linear,rotation)"
    add("--instruments", metavar="A,B", help=text)
    _json(add)


def _compensated(add: Add) -> None:
    text = "check readings: taken with the compensation running, by the model that is checked"
    add("--compensated", action="store_true", help=text)


def _readings(add: Add, required: bool = True) -> None:
    """Add the measured files, the machine, and how the files are read."""
    files = add("files", nargs="+", metavar="FILE", help="measured files")
    files.required = required  # nargs="*" would take none where an option stands before them
    _machine(add)
    add("--columns", metavar="FILE", help="columns file that explains wide CSV files")
    text = "measured point in platform (default: the tool's tip)"
    add("--probe-mm", type=arguments.point, metavar="X,Y,Z", help=text)


def _separate_joints(add: Add) -> None:
    add("--separate-joints", action="store_true", help="platform joints at the same place are two joints, not one")


def _estimation(parser: argparse.ArgumentParser) -> None:
    """Add what a fit of scheme joint, or a plan for one, can be given."""
    add = parser.add_argument_group("scheme joint").add_argument
    text = "period of the screws' errors (default: the geometry's; else what the readings show)"
    add("--lead-mm", type=arguments.bound, metavar="MM", help=text)
    text = "what may be fitted: pitch, wave, harmonics, backlash, map, field, expansion, moisture, late (default all)"
    add("--blocks", metavar="A,B,…", help=text)
    _separate_joints(add)
    text = "how well joints are built, to start from, µm (default 100)"
    add("--tolerance-um", type=arguments.bound, metavar="UM", help=text)
    add("--field-degree", type=arguments.count, metavar="N", help="degree of the field (default 6)")
    text = "thermal expansion of struts, or of struts, base and platform, ppm/K; a warm-up starts there (default 0)"
    add("--expansion-ppm", type=arguments.expansions, metavar="S[,B,P]", help=text)
    add("--moisture-ppm", type=arguments.bound, metavar="PPM", help="growth of struts by humidity, ppm per %% (1 to 5)")
    add("--thermometer", metavar="PART", help="part whose sensor stands for all (default: the one that alone was read)")
    text = "how late parts follow their sensors (default: sought from the readings)"
    add("--time-constants-s", type=arguments.time_constants, metavar="S[,S]", help=text)


def _iso230(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _readings(add)
    add("--targets", action="store_true", help="each run target by target, with notes")
    _json(add)


def _export(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _machine_and_model(add)
    add("--linuxcnc", metavar="FOLDER", help="folder for LinuxCNC's files; made if it is missing")
    add("--table", type=arguments.csv_file, metavar="FILE.csv", help="CSV file for the trilinear table")
    add("--c", dest="c_folder", metavar="FOLDER", help="folder for the compensator in C with this machine's constants")
    text = "folder for a ROS 2 package: this machine's compensation as a controller of ros2_control, and configurations"
    add("--ros2-control", metavar="FOLDER", help=text)
    add("--rate", type=arguments.rate, default=250, metavar="HZ", help="of ros2_control's loop (default 250)")
    text = "the struts' joints in URDF, MJCF and ros2_control (default strut_1,…,strut_6)"
    add("--joint-names", type=arguments.joint_names, metavar="A,B,C,D,E,F", help=text)
    text = "file for the machine as URDF: robot_state_publisher, RViz, ros2_control; needs no model"
    add("--urdf", metavar="FILE.urdf", help=text)
    add("--mjcf", metavar="FILE.xml", help="file for the machine as MuJoCo's MJCF, loops closed; needs no model")
    text = "LinuxCNC's machine unit, [TRAJ]LINEAR_UNITS (default mm)"
    add("--units", choices=("mm", "inch"), default="mm", help=text)
    text = "lowest and highest tool position, mm (default: the model's valid box, else its field's)"
    add("--box", type=arguments.box, metavar="X0,Y0,Z0,X1,Y1,Z1", help=text)
    text = "largest step of the table (default 25.4)"
    add("--step-mm", type=arguments.above_zero, default=25.4, metavar="MM", help=text)
    text = "random poses to check (default 1000, the least)"
    add("--poses", type=arguments.trials, default=1000, metavar="N", help=text)
    add("--tilt-deg", type=arguments.bound, default=5.0, metavar="DEG", help="tilt to check (default 5)")
    _seed(add, "the random poses")
    _json(add)


def _assess(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    text = "CSV file of poses (mm, degrees; default: Table 1 of Song, Mou & King); - for standard input"
    add("poses", nargs="?", default="table1.csv", metavar="POSES.csv", help=text)
    for name, default, what in (
        ("joint-um", 10.0, "every coordinate of every joint, µm"),
        ("strut-um", 10.0, "every strut's length offset, µm"),
        ("pitch-ppm", 0.0, "every screw's pitch error, ppm"),
        ("wave-um", 0.0, "every screw's periodic error (its amplitude, drawn from 0 up), µm"),
    ):
        text = f"bound of {what} (default {default:g})"
        add(f"--{name}", type=arguments.bound, default=default, metavar="BOUND", help=text)
    add("--wave-period-mm", type=arguments.bound, default=10.0, metavar="MM", help="period of that error (default 10)")
    text = "struts that share a platform joint nominally each get one of their own"
    add("--separate-platform-joints", action="store_true", help=text)
    add("--machines", type=arguments.count, default=1, metavar="N", help="how many to draw (default 1)")
    _seed(add, "the first machine")
    _machine(add)
    _table_out(add, "every machine and pose")
    _json(add)


def _classify(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _machine(add, "positioning_unit.yaml")
    text = "error budget, or the name of a shipped one (default error_budget.yaml)"
    add("--budget", metavar="FILE", default="error_budget.yaml", help=text)
    text = "in place of a budget: what the fit of this model leaves, and which measurement would remove most of it"
    add("--model", metavar="FILE", help=text)
    _table_out(add, "the ranking")
    _pictures(add)
    _json(add)
    _separate_joints(add)
    text = "cells along the grid's longest edge (default 30)"
    add("--cells", type=arguments.count, default=30, metavar="N", help=text)
    text = "smallest distance between the axes of two struts, mm; 0: not limited (default: the geometry's)"
    add("--clearance-mm", type=arguments.bound, metavar="MM", help=text)
    text = "tilts about the tool's x and y, from its attitude at home (default -4,0,4)"
    add("--tilt-deg", type=arguments.tilts, default=arguments.tilts("-4,0,4"), metavar="A,B,…", help=text)
    text = "of the ranking: exact (default), linear, or iteration, which is v. Daake et al.'s own"
    add("--method", choices=("exact", "linear", "iteration"), default="exact", help=text)
    text = "compare exact, linear and the iteration of v. Daake et al. at N poses"
    add("--compare", type=arguments.count, metavar="N", help=text)
    text = "allowed error of the tool: says what the errors may be"
    add("--allow-um", type=arguments.above_zero, metavar="UM", help=text)
    add("--workers", type=arguments.workers, default=1, metavar="N", help="processes (default 1, with all threads)")
    add("--scheduler", metavar="tcp://…", help="Dask scheduler that does the work instead")
    _seed(add, "random poses and draws")
    add("--no-page", action="store_true", help="leave the interactive page out of --pictures")
    add("--publish", action="store_true", help="then keep the worst type's shells on workspace/shells until Ctrl-C")


OPTIONS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    "show": _show,
    "ik": _ik,
    "fk": _fk,
    "check": _check,
    "travel": _travel,
    "run": _run,
    "demo": _demo,
    "watch": _watch,
    "echo": _echo,
    "record": _record,
    "replay": _replay,
    "plan": _plan,
    "imagine": _imagine,
    "simulate": _simulate,
    "fit": _fit,
    "verify": _verify,
    "iso230": _iso230,
    "export": _export,
    "assess": _assess,
    "classify": _classify,
}
"""What adds each verb's options."""
