"""The verbs for poses and strut lengths: ``show``, ``travel``, ``ik``, ``fk``, ``check`` and ``assess``."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..compensation.checks import CheckResult
from ..compensation.checks import check as check_limits
from ..core import Status
from ..errors import CommandError, KinematicsError, NotConvergedError, NotFiniteError, UnreachableError
from ..formats import texts
from ..formats.csv import Row
from ..machine.assembly import ORIENTATIONS, assembly_modes, mode_objections, working_mode
from ..machine.geometry import STRUT_NAMES, HexapodGeometry, Limits, load_geometry, pose_text
from ..machine.kinematics import Structure, solve_pose, solve_poses
from ..machine.model import DIRECTIONS, FOLLOWED, MachineModel, RealMachine
from ..machine.passes import Passes
from ..machine.pose_files import LENGTH_COLUMNS, PREDICTED_ERRORS, length_values, read_lengths, read_pose_arrays
from ..machine.region import region_json, region_text
from ..pose import Pose, rotation_from_angles, stacked
from . import results
from .results import Result, Table

MOST_NOTES = 10  # Largest number of broken limits that ik and fk print on stderr
MOST_STEPS = 100_000  # Largest number of poses on a line, in each direction
MOST_ROWS = 100  # Largest number of rows of margins that check prints; --out writes all rows
MOST_BREACHES = 20  # Largest number of broken limits that check prints; --json prints all broken limits
MOST_RESULTS = 10_000_000  # Largest number of machines × poses in assess, for which the memory suffices


def show(args: argparse.Namespace) -> Result:
    from ..workspace.overview import as_json, overview, report
    from ..workspace.pictures import overview_figure

    geometry = load_geometry(args.machine)
    with results.stage("reach and largest box"):
        seen = overview(geometry)
    return Result(lambda: report(seen), lambda: as_json(seen), pictures=lambda: {"machine.png": overview_figure(seen)})


def travel(args: argparse.Namespace) -> Result:
    from ..compensation.travel import travel, travel_text

    geometry, model = results.load_machine(args)
    pose = geometry.tool_pose(geometry.home) if args.pose is None else Pose.from_angles(*args.pose)
    ways = travel(RealMachine(geometry, model), pose)
    title = f"{results.machine_title(geometry, model)}: travel of {results.tool_in_frame(geometry)}"
    listed = []
    for way in ways:
        limit, problem = (None, None) if way.error is None else (way.error.reason, str(way.error))
        listed.append({"way": way.way, "unit": way.unit, "travel": way.shown, "limit": limit, "problem": problem})
    return Result(
        lambda: f"{title} from {pose_text(pose)}\n{travel_text(ways)}",
        lambda: {**results.about(geometry, model), "pose": pose, "travel": listed},
    )


# ---- ik ----


@dataclass(frozen=True)
class Targets:
    """Tool poses for which the verb ``ik`` computes strut lengths, with the directions of motion at each pose."""

    rows: list[Row]  # line number and label of each pose
    positions: np.ndarray  # (N, 3): positions of pose_tool_in_work, m
    rotations: np.ndarray  # (N, 3, 3): rotation matrices of pose_tool_in_work
    senses: np.ndarray  # (N, 9): directions of motion of three axes and six struts
    directions: list[str]  # name of the direction of each pose: forward, backward or midway
    along: np.ndarray | None = None  # (N,): distances from the start of a line, m

    @staticmethod
    def given(args: argparse.Namespace) -> Targets:
        if args.poses is not None:
            with results.stage(f"reading {args.poses}"):
                rows, positions, rotations = read_pose_arrays(args.poses)
        else:
            place, angles = args.pose
            rows, positions, rotations = [Row(0, "1")], np.array([place]), rotation_from_angles(np.array([angles]))
        direction = args.direction or "midway"
        senses = np.full((len(rows), FOLLOWED), DIRECTIONS[direction])
        return Targets(rows, positions, rotations, senses, [direction] * len(rows))

    @staticmethod
    def on_line(args: argparse.Namespace, geometry: HexapodGeometry) -> Targets:
        """Return the poses along a straight line of the tool, first for forward, then for backward motion.

        The line gives the directions of motion of axes and struts; an axis or strut at rest has no direction.
        """
        start, end, angles = args.line
        way, step = np.array(end) - np.array(start), args.step_mm * 1e-3
        length = float(np.linalg.norm(way))
        if length > step * MOST_STEPS:
            least = f"at least {length / MOST_STEPS * 1e3:g}, since the line has {length * 1e3:g} mm"
            raise CommandError("usage", f"--step-mm: must be {least}, not {step * 1e3:g}")
        along = np.append(step * np.arange(np.ceil(length / step - 1e-6)), length)
        positions = np.array(start) + along[:, None] * (way / length)
        rotations = np.tile(rotation_from_angles(np.array([angles])), (len(along), 1, 1))
        passes = Passes.of_tool(geometry, positions, rotations, np.tile(way / length, (len(along), 1)))
        rows = [Row(0, str(n + 1)) for n in range(2 * len(along))]
        directions = ["forward"] * len(along) + ["backward"] * len(along)
        both = np.tile(positions, (2, 1)), np.tile(rotations, (2, 1, 1)), passes.both_ways().senses()
        return Targets(rows, *both, directions, np.tile(along, 2))

    def where(self, n: int) -> str:
        if self.along is None:
            return results.where(self.rows[n])
        return f"{texts.number(float(self.along[n]) * 1e3, 3)} mm along the line, {self.directions[n]}"

    def row(self, n: int, lengths: np.ndarray, with_model: bool) -> dict[str, Any]:
        """Return row `n` of the output; `with_model` adds the direction, the nominal lengths and the corrections."""
        nominal, command = lengths
        columns: dict[str, Any] = {"sequence": self.rows[n].label}
        columns |= {"direction": self.directions[n]} if with_model else {}
        if self.along is not None:
            columns["along_mm"] = float(self.along[n]) * 1e3
            columns |= Pose(self.positions[n], self.rotations[n]).as_columns()
        columns |= length_values(command if with_model else nominal)
        if with_model:
            columns |= {f"nominal_{name}": value for name, value in length_values(nominal).items()}
            corrections = zip(LENGTH_COLUMNS, ((command - nominal) * 1e6).tolist(), strict=True)
            columns |= {f"correction_{name}_um": value for name, value in corrections}
        return columns


def ik(args: argparse.Namespace) -> Result:
    """Compute strut lengths for tool poses; the text is CSV, or a table for --pose, or empty if --out is given."""
    geometry, model = results.load_machine(args)
    targets = Targets.given(args) if args.line is None else Targets.on_line(args, geometry)
    poses, count = (targets.positions, targets.rotations), len(targets.rows)
    with results.progress_bar(count, " poses") as bar:
        found = check_limits(geometry, model, poses, "poses", progress=bar.update, senses=targets.senses)
    lengths = found.lengths
    if not np.isfinite(lengths).all():  # a pose has no strut command
        row = int((~np.isfinite(lengths)).any(axis=(1, 2)).argmax())
        for breach in found.breaches:
            if breach.row == row and isinstance(breach.error, NotConvergedError):
                raise NotConvergedError(f"{targets.where(row)}: {breach.error}")
        raise NotFiniteError(f"{targets.where(row)}: strut lengths are not finite")
    predicted = None
    if args.model != "ideal":
        predicted = Predicted(RealMachine(geometry, model), args.model, geometry.platform_poses(*poses), targets.senses)
        if predicted.missing:
            note = "a machine with the model's errors has no pose with the nominal lengths, so no error is predicted"
            results.print_notes([f"{predicted.missing} of {count} poses: {note}"])
        if outside := int(found.outside_box.sum()):
            lie = "the pose lies" if count == 1 else f"{outside} of {count} poses lie"
            note = f"{lie} outside the box in which the model was measured; the error there is an extrapolation"
            results.print_notes([f"{note} ({region_text(model.measured, geometry)})"])
    # if screws turn with the cardan joints, commands differ from the strut lengths even on an ideal machine
    corrected = predicted is not None or bool(geometry.screw_lead.any())
    rows = [targets.row(n, lengths[n], corrected or args.line is not None) for n in range(count)]
    content: dict[str, Any] = results.about(geometry, model)
    if predicted is not None:
        rows = [{**columns, **predicted.columns(n)} for n, columns in enumerate(rows)]
        content |= {"error_frame": geometry.work_name, "error_sd_not_known": predicted.unknown or None}

    def text() -> str:
        if args.out is not None or args.poses is not None or args.line is not None:
            results.print_default_machine(args, geometry)
            return "" if args.out is not None else Table(rows).csv()
        (nominal, command), direction = lengths[0] * 1e3, targets.directions[0]
        columns = {"strut": STRUT_NAMES, "nominal_mm": nominal.tolist()}
        if corrected:
            columns |= {"command_mm": command.tolist(), "correction_um": ((command - nominal) * 1e3).tolist()}
        struts = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        pose = f"a pose of {results.tool_in_frame(geometry)}"
        title = f"{results.machine_title(geometry, model)}: strut lengths for {pose}"
        title += "" if direction == "midway" else f", {_direction_text(direction)}"
        errors = f"\n{predicted.text(direction)}" if predicted is not None else ""
        return f"{title}\n{Table(struts).text()}\n{errors}"

    notes = [f"{targets.where(breach.row)}: {breach.error}" for breach in found.breaches[:MOST_NOTES]]
    if (more := len(found.breaches) - MOST_NOTES) > 0:
        notes.append(f"{more} more limits are broken; `hexapod_comp check` lists all")
    return Result(text, lambda: {**content, "rows": rows}, rows, notes=notes)


def _direction_text(direction: str) -> str:
    return f"all axes and struts moved {direction}"


class Predicted:
    """The predicted tool errors without compensation: absolute, and after best-fit alignment."""

    def __init__(self, machine: RealMachine, file: str, poses: Any, senses: np.ndarray) -> None:
        from ..calibration.posterior import COMPONENTS, ErrorPredictor
        from ..calibration.posterior_file import load_posterior

        fitted, self.unknown = load_posterior(machine.model, machine.geometry, file)
        held = None if fitted is None else fitted.held
        self.unseen = 0 if held is None else held.held  # number of unmeasured coordinates, of 6, of the datum
        parts = ErrorPredictor(machine, fitted).predict(poses, senses)
        self._numbers = [n for p in parts for n in ((None, None) if p is None else (p.values, p.deviations))]
        self._components, self.frame = COMPONENTS, machine.geometry.work_name
        self.missing = int(np.isnan(parts[0].values).any(axis=1).sum())  # number of poses without a prediction

    def columns(self, row: int) -> dict[str, Any]:
        """Return a row's errors and standard deviations by column name."""
        columns: dict[str, Any] = {}
        for name, values in zip(PREDICTED_ERRORS, self._numbers, strict=True):
            for n, component in enumerate(self._components):
                key = f"{name.format(component)}_{'urad' if component[0] == 'r' else 'um'}"
                columns[key] = None if values is None or np.isnan(values[row, n]) else float(values[row, n]) * 1e6
        return columns

    def text(self, direction: str) -> str:
        cells = ["not known" if value is None else texts.number(value, 2) for value in self.columns(0).values()]
        rows = zip(*(cells[start : start + 6] for start in range(0, 24, 6)), strict=True)
        named = zip(self._components, rows, strict=True)
        body = [[name, *row, "µrad" if name[0] == "r" else "µm"] for name, row in named]
        title = "predicted error of the tool without compensation, actual − commanded, along and about the axes of "
        title += self.frame
        unknown = "mean of both directions of motion, because --direction is not given"
        title += f";\n{unknown if direction == 'midway' else _direction_text(direction)}"
        title += f"; ± is one standard deviation{f', not known: {self.unknown}' if self.unknown else ' of the fit'}"
        if self.unseen:
            title += (
                f";\n{self.unseen} of the 6 coordinates of the datum (where the whole machine is) were not measured: "
                "the model assumes no error\nat the datum pose, and ± of absolute errors includes the uncertainty of "
                "this assumption"
            )
        heads = [f"in {self.frame}", "absolute", "±", "after best-fit alignment", "±", ""]
        return f"{title}\n{texts.aligned(heads, body)}\n"


# ---- fk ----


def fk(args: argparse.Namespace) -> Result:
    """Compute tool poses for strut lengths; the text is CSV, or a table for --lengths, or empty if --out is given."""
    if args.lengths is None:
        with results.stage(f"reading {args.lengths_file}"):
            rows, lengths = read_lengths(args.lengths_file)
    else:
        rows, lengths = [Row(0, "1")], np.array([args.lengths])
    geometry, model = results.load_machine(args)
    notes = []
    if args.cold or args.all_modes:
        sets = "these lengths" if len(rows) == 1 else "each row's lengths"
        how = f"Newton's method searched for poses with {sets} from home and from {2 * ORIENTATIONS} other starts"
        notes = [f"{how}; there may be poses that this search did not find"]
    if args.all_modes:
        return replace(_all_modes(args, geometry, lengths[0]), notes=notes)
    poses = zip(rows, _solved(args, geometry, model, rows, lengths), strict=True)
    notes += [f"{results.where(rows[n])}: {text}" for n, text in _beyond_stroke(geometry, lengths, MOST_NOTES)]
    table = [{"sequence": row.label, **geometry.tool_pose(pose).as_columns()} for row, pose in poses]
    content = results.about(geometry, model)
    content |= {"direction": args.direction or "midway"} if args.model != "ideal" else {}

    def text() -> str:
        if args.lengths is None:
            results.print_default_machine(args, geometry)
            return "" if args.out is not None else Table(table).csv()
        title = f"{results.machine_title(geometry, model)}: pose of {results.tool_in_frame(geometry)}"
        title += f", {_direction_text(args.direction)}" if args.direction else ""
        return "" if args.out is not None else f"{title}\n{Table(table).text(list(table[0])[1:])}"

    return Result(text, lambda: {**content, "rows": table}, table, notes=notes)


def _beyond_stroke(geometry: HexapodGeometry, lengths: np.ndarray, most: int) -> list[tuple[int, str]]:
    """Return row number and message for the first `most` of the `lengths`, (N, 6), m, that are outside the stroke."""
    low, high = geometry.limits.stroke.T
    beyond = np.argwhere((lengths < low) | (lengths > high))[:most].tolist()
    return [(n, str(geometry.limits.error(Status.STROKE_SHORT, k, 0, lengths[n, k]))) for n, k in beyond]


def _solved(
    args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], lengths: np.ndarray
) -> list[Pose]:
    """Return every row's platform pose; raise a KinematicsError that names the first row without a pose."""
    machine = RealMachine(geometry, model)
    # True: `lengths` are commands to the drives; False: distances between joints
    commands = args.model != "ideal" or bool(geometry.screw_lead.any())
    structure = machine.structure if commands else Structure.of(geometry)
    guess = geometry.home if args.guess is None else geometry.platform_pose(Pose.from_angles(*args.guess))
    senses = np.full(FOLLOWED, DIRECTIONS[args.direction or "midway"])
    batch = None if args.cold else solve_poses(structure, lengths, guess)
    poses = []
    with results.progress_bar(len(rows), " rows") as bar:
        for n, row in enumerate(rows):
            bar.update()
            try:
                if batch is None:
                    pose = working_mode(geometry, structure, lengths[n])
                elif batch.ok[n]:
                    pose = Pose(batch.positions[n], batch.rotations[n])
                else:
                    pose = solve_pose(structure, lengths[n], guess)
                if commands:
                    pose = machine.pose_for(lengths[n], senses, pose)[0]
            except KinematicsError as error:
                problems = [text for _, text in _beyond_stroke(geometry, lengths[[n]], 1)]
                problem = "; ".join([str(error), *problems])
                problem = f"{results.where(row)}: {problem}" if row.line else problem
                raise KinematicsError(problem, error.value, error.limit) from error
            poses.append(pose)
    return poses


def _all_modes(args: argparse.Namespace, geometry: HexapodGeometry, lengths: np.ndarray) -> Result:
    """List the assembly modes: mark the working mode, and state why other modes are not possible."""
    structure = Structure.of(geometry)
    modes = assembly_modes(structure, lengths)
    if not modes:
        problems = [text for _, text in _beyond_stroke(geometry, lengths[None], 1)]
        raise UnreachableError("; ".join(["no pose of the machine has these strut lengths", *problems]), 0)
    working, reason = None, ""
    try:
        working = working_mode(geometry, structure, lengths)
    except KinematicsError as error:
        reason = str(error)
    listed: list[dict[str, Any]] = []
    for index, mode in enumerate(modes, start=1):
        same = working is not None and all(map(np.array_equal, stacked([mode]), stacked([working])))
        objections = mode_objections(geometry, structure, mode)
        values = geometry.tool_pose(mode).as_columns()
        listed.append({"mode": index, **values, "working": same, "objections": objections})

    def text() -> str:
        if args.out is not None:
            return ""
        further = "possible, but farther from home than the working mode"
        verdicts = ["working mode" if m["working"] else "; ".join(m["objections"]) or further for m in listed]
        shown = [{**m, "": verdict} for m, verdict in zip(listed, verdicts, strict=True)]
        table = Table(shown).text(["mode", *(n for n in shown[0] if n.endswith(("_mm", "_deg"))), ""])
        title = f"machine {geometry.name}: {len(modes)} assembly modes, {geometry.tool_name} in {geometry.work_name}"
        return "\n".join([title, table, *([f"no working mode: {reason}"] if reason else [])])

    return Result(
        text,
        lambda: {**results.about(geometry), "modes": listed, "no_working_mode": reason},
        [{**m, "working": int(m["working"]), "objections": "; ".join(m["objections"])} for m in listed],
    )


# ---- check ----


class LimitFormat(NamedTuple):
    column: str
    unit: str
    factor: float  # number of displayed units per SI unit
    digits: int  # number of decimals in the text
    margin: bool = False  # True: show the margin; False: show the value
    unsigned: bool = False  # True: show the value without its sign
    stages: tuple[int, ...] = (0, 1)  # 0: show nominal values; 1: show compensated values

    def name(self, stage: int) -> str:
        return "_".join(filter(None, (self.column, STAGES[stage] if len(self.stages) > 1 else "", self.unit)))


STAGES = ("nominal", "compensated")
# Columns of the table of smallest margins
SMALLEST = ("limit", "margin", "value", "allowed", "unit", "strut", "stage", "label", "line", "share_of_move")
LIMITS_SHOWN = {
    "stroke": LimitFormat("stroke_margin", "mm", 1e3, 3, margin=True),
    "base_cone": LimitFormat("base_cone_margin", "deg", 180.0 / math.pi, 3, margin=True),
    "platform_cone": LimitFormat("platform_cone_margin", "deg", 180.0 / math.pi, 3, margin=True),
    "clearance": LimitFormat("clearance_margin", "mm", 1e3, 3, margin=True),
    "condition": LimitFormat("condition", "", 1.0, 3),
    "correction": LimitFormat("correction", "um", 1e6, 2, stages=(1,)),
    "step": LimitFormat("step", "mm", 1e3, 4, unsigned=True),
    "speed": LimitFormat("speed", "mm_s", 1e3, 2, unsigned=True),
}


def check(args: argparse.Namespace) -> Result:
    """Check every limit along a list of poses; exit code 1: a limit is broken."""
    with results.stage(f"reading {args.poses}"):
        rows, positions, rotations = read_pose_arrays(args.poses)
    geometry, model = results.load_machine(args)
    mode = "stream" if args.stream else "moves"
    with results.progress_bar(len(rows), " poses") as bar:
        result = check_limits(geometry, model, (positions, rotations), mode, args.rate_hz, bar.update)
    if not args.json:
        results.print_default_machine(args, geometry)
    margins = [_margins(row, n, result) for n, row in enumerate(rows)]
    smallest = _smallest(geometry.limits, rows, result)

    def text() -> str:
        counted = f"{len(rows)} pose{'s' * (len(rows) != 1)} of {results.tool_in_frame(geometry)}"
        joined = "as targets with moves between them" if result.mode == "moves" else "as a stream of commands"
        title = f"machine {geometry.name}, model {model.name}: {counted} {joined} at {result.rate:g} Hz"
        lines = [f"{title}; {result.examined} poses examined"]
        if not args.out:
            lines += ["", _margin_table(margins, result, args.model == "ideal")]
        if result.breaches:
            lines += ["", f"broken limits ({len(result.breaches)}):"]
            for breach in result.breaches[:MOST_BREACHES]:
                at = "" if breach.share == 1.0 else f", at {breach.share * 100:.1f} % of the move to this pose"
                lines.append(f"{results.where(rows[breach.row])}{at}: {breach.error}")
            if len(result.breaches) > MOST_BREACHES:
                lines.append(f"… and {len(result.breaches) - MOST_BREACHES} more; --json prints all")
        lines += ["", "smallest margin per limit:", Table(smallest).text(SMALLEST), ""]
        if skipped := int(result.unchecked_moves.sum()):
            first = results.where(rows[int(result.unchecked_moves.argmax())])
            lines.append(f"not checked: {skipped} moves whose start or end breaks a limit, first the move to {first}")
        for outside, problem in (
            (result.outside_box, "outside the box in which the model was measured"),
            (result.outside_field, "outside the error field's box, so the field's value at the boundary is used"),
        ):
            if outside.any():
                first = results.where(rows[int(outside.argmax())])
                lines.append(f"note: {problem}: {int(outside.sum())} of {len(rows)}, first {first}")
        if result.outside_box.any():
            lines.append(f"  {region_text(model.measured, geometry)}")
        broken = len({breach.row for breach in result.breaches})
        bad = f"LIMITS BROKEN: {len(result.breaches)}, on {broken} of {len(rows)} poses"
        return "\n".join([*lines, "all within limits" if result.ok else bad])

    def content() -> dict[str, Any]:
        broken = []
        for breach in result.breaches:
            row, error = rows[breach.row], breach.error
            one = {"row": breach.row + 1, "label": row.label, "line": row.line, "share_of_move": breach.share}
            one |= {"limit": breach.limit, "problem": str(error)}
            if (shown := LIMITS_SHOWN.get(breach.limit)) is not None:
                values = (error.value * shown.factor, error.limit * shown.factor, shown.unit)  # type: ignore[attr-defined]
                strut = None if error.strut is None else error.strut + 1  # type: ignore[attr-defined]
                one |= dict(zip(("value", "allowed", "unit"), values, strict=True))
                one |= {"strut": strut, "stage": error.stage}  # type: ignore[attr-defined]
            broken.append(one)
        return {
            **results.about(geometry, model),
            "mode": result.mode,
            "rate_hz": result.rate,
            "within_limits": result.ok,
            "poses_examined": result.examined,
            "measured_box": region_json(model.measured, geometry),
            "broken": broken,
            "smallest_margins": smallest,
            "rows": margins,
        }

    return Result(text, content, margins, code=0 if result.ok else 1)


def _margins(row: Row, n: int, result: CheckResult) -> dict[str, Any]:
    """Return one row of the output: for each limit, the pose's margin or the limited value, see LIMITS_SHOWN."""
    values: dict[str, Any] = {"sequence": row.label, "line": row.line}
    for name, summary in result.limits.items():
        shown = LIMITS_SHOWN[name]
        for stage in shown.stages:
            value = float((summary.margin if shown.margin else summary.value)[n, stage]) * shown.factor
            values[shown.name(stage)] = abs(value) if shown.unsigned else value
    return values | {"move_checked": int(not result.unchecked_moves[n])}


def _margin_table(margins: list[dict[str, Any]], result: CheckResult, ideal: bool) -> str:
    def cell(row: dict[str, Any], shown: LimitFormat) -> str:
        values = [row[shown.name(stage)] for stage in (shown.stages[:1] if ideal else shown.stages)]
        return "/".join(texts.number(v, shown.digits) if math.isfinite(v) else "–" for v in values)

    columns = [LIMITS_SHOWN[name] for name in result.limits]
    header = ["row", "line", *("_".join(filter(None, (c.column.removesuffix("_margin"), c.unit))) for c in columns)]
    body = [[row["sequence"], str(row["line"]), *(cell(row, c) for c in columns)] for row in margins[:MOST_ROWS]]
    kind = "" if ideal else " (nominal/compensated)"
    worst = "; each number is the worst on the move to the pose" if result.mode == "moves" else ""
    more = len(margins) - MOST_ROWS
    note = f"\n… and {more} more rows; --out FILE writes all" if more > 0 else ""
    names = "stroke, cones and clearance" if "clearance" in result.limits else "stroke and cones"
    return f"margins of {names}; values for all other limits{kind}{worst}:\n{texts.aligned(header, body)}{note}"


def _smallest(limits: Limits, rows: list[Row], result: CheckResult) -> list[dict[str, Any]]:
    listed = []
    for name, summary in result.limits.items():
        shown, place = LIMITS_SHOWN[name], summary.smallest()
        if place is None:
            continue
        row, stage = place
        strut, value = int(summary.strut[place]), float(summary.value[place])
        bound = limits.stroke[strut] if name == "stroke" else getattr(limits, name)
        if name == "stroke":  # the nearer end
            bound = bound[0] if value - bound[0] < bound[1] - value else bound[1]
        allowed = float(bound[strut]) if name.endswith("cone") else float(bound)
        listed.append(
            {
                "limit": name,
                "unit": shown.unit,
                "margin": float(summary.margin[place]) * shown.factor,
                "value": (abs(value) if shown.unsigned else value) * shown.factor,
                "allowed": allowed * shown.factor,
                "strut": strut + 1 if strut >= 0 else None,
                "stage": STAGES[stage],
                "row": row + 1,
                "label": rows[row].label,
                "line": rows[row].line,
                "share_of_move": float(summary.share[place]),
            }
        )
    return listed


# ---- assess ----

POSE_COLUMNS = ("alpha_deg", "beta_deg", "gamma_deg", "x_mm", "y_mm", "z_mm")
PERCENTILES = {"median": 50.0, "95 %": 95.0, "max": 100.0}
# Quantities with percentiles over the machines: title, unit, units per SI unit
STATISTICS = {"strut_change": ("|dL|", "um", 1e6), "displacement": ("|dp|", "um", 1e6),
              "rotation": ("angle", "deg", 180.0 / math.pi)}  # fmt: skip
ERRORS = ("x_um", "y_um", "z_um", "rx_urad", "ry_urad", "rz_urad")


def assess(args: argparse.Namespace) -> Result:
    """Draw random machines as Song, Mou & King do; tabulate the first machine, and percentiles over all machines."""
    from ..virtual.assessment import assess
    from ..virtual.imperfections import ImperfectionBounds

    rows, positions, rotations = read_pose_arrays(args.poses)
    poses = [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]
    if args.machines * len(poses) > MOST_RESULTS:
        most = MOST_RESULTS // len(poses)
        raise CommandError("usage", f"--machines: must be at most {most} with {len(poses)} poses, not {args.machines}")
    geometry, _ = results.load_machine(args)
    bounds = ImperfectionBounds(joint=args.joint_um * 1e-6, strut_offset=args.strut_um * 1e-6)
    names = [f"{Path(args.poses).name}, {results.where(row)}" for row in rows]
    with results.progress_bar(args.machines, " machines") as bar:
        result = assess(geometry, poses, bounds, args.seed, args.machines, names, bar.update)
    records = []
    for m, seed in enumerate(result.seeds):
        for n, row in enumerate(rows):
            taken = Pose(result.taken_positions[m, n], result.taken_rotations[m, n])
            errors = zip(ERRORS, result.pose_errors[m, n], strict=True)
            trip = (result.round_trip[m, n] * 1e6).tolist()
            records.append(
                {
                    "seed": seed,
                    "sequence": row.label,
                    **{f"ideal_{k}": v for k, v in length_values(result.ideal_lengths[n]).items()},
                    **{f"real_{k}": v for k, v in length_values(result.real_lengths[m, n]).items()},
                    **{f"change_L{i + 1}_um": float(v) * 1e6 for i, v in enumerate(result.strut_changes[m, n])},
                    **{f"taken_{k}": v for k, v in taken.as_columns().items()},
                    **{f"error_{k}": float(v) * 1e6 for k, v in errors},
                    "round_trip_um": trip[0],
                    "round_trip_urad": trip[1],
                }
            )
    commanded = [{"sequence": row.label, **pose.as_columns()} for row, pose in zip(rows, poses, strict=True)]
    statistics = result.statistics(tuple(PERCENTILES.values()))
    distance, angle = float(result.round_trip[..., 0].max()), float(result.round_trip[..., 1].max())

    def text() -> str:
        drawn = f"joints ±{args.joint_um:g} µm, struts ±{args.strut_um:g} µm"
        last = f"…{result.seeds[-1]}" if len(result.seeds) > 1 else ""
        lines = [f"machine {geometry.name}, {drawn}; seed {result.seeds[0]}{last}"]
        lengths = tuple(f"L{i}_mm" for i in range(1, 7))
        for title, table, prefix, columns, header in (
            ("commanded poses of the tool in work (as in Song et al., Table 1):", commanded, "", POSE_COLUMNS, ""),
            ("strut lengths of the ideal machine (as Table 2):", records, "ideal_", lengths, ""),
            ("strut lengths of the real machine at the same poses (as Table 4):", records, "real_", lengths, ""),
            ("real minus ideal (Table 4 − Table 2):", records, "change_", [f"L{i}_um" for i in range(1, 7)], "d"),
            ("tool pose in work of the real machine at the ideal lengths:", records, "taken_", POSE_COLUMNS, ""),
        ):
            body = [{"sequence": r["sequence"], **{header + c: r[prefix + c] for c in columns}}
                    for r in table[: len(rows)]]  # fmt: skip
            lines += ["", title, Table(body).text()]
        if len(result.seeds) > 1:
            body = [
                {"sequence": row.label}
                | {f"{title} {percentile} {unit}": float(statistics[name][n, k] * factor)
                   for name, (title, unit, factor) in STATISTICS.items() for k, percentile in enumerate(PERCENTILES)}
                for n, row in enumerate(rows)
            ]  # fmt: skip
            digits = {name: 6 for name in body[0] if name.endswith("deg")}
            what = "largest strut change |dL|, and the tool's displacement |dp| and rotation at the ideal lengths:"
            lines += ["", f"over {len(result.seeds)} machines: {what}", Table(body).text(digits=digits)]
        bound = 2.0 * math.sqrt(3.0) * args.joint_um + args.strut_um
        largest = (
            f"largest strut change {abs(result.strut_changes).max() * 1e6:.3f} µm (possible: up to {bound:.3f} µm, "
        )
        largest += "with the largest error in each coordinate of both joints, and the largest strut offset)"
        trip = f"round trip of the real structure, pose → lengths → pose: within {distance:.1e} m and {angle:.1e} rad"
        return "\n".join(
            [
                *lines,
                "",
                largest,
                trip,
                "(only rounding errors; in Table 5 of Song, Mou & King the round trip is off by up to 5 µm)",
            ]
        )

    def content() -> dict[str, Any]:
        return {
            "machine": geometry.name,
            "frame": "work",
            "bounds": {name: getattr(args, name) for name in ("joint_um", "strut_um")},
            "seeds": list(result.seeds),
            "commanded": [{name: pose[name] for name in POSE_COLUMNS} for pose in commanded],
            "percentiles": list(PERCENTILES.values()),
            "statistics": [
                {"sequence": row.label}
                | {f"{name}_{unit}": statistics[name][n] * factor for name, (_, unit, factor) in STATISTICS.items()}
                for n, row in enumerate(rows)
            ],
            "round_trip_m": distance,
            "round_trip_rad": angle,
            "records": records,
        }

    return Result(text, content, records)
