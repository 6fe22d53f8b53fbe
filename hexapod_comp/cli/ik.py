"""``hexapod_comp ik``: strut lengths for tool poses."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compensation.checks import CheckResult, check
from ..errors import CommandError, NotConvergedError, NotFiniteError
from ..formats import texts
from ..formats.csv import LENGTH_COLUMNS, PREDICTED_ERRORS, Row, length_values, pose_values, read_pose_arrays
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.model import DIRECTIONS, FOLLOWED, MachineModel, RealMachine
from ..machine.passes import Passes
from ..machine.region import region_text
from ..pose import Pose, rotation_from_angles
from . import common
from .table import Table
from .verbs import POSE_OPTIONS

MOST_NOTES = 10  # broken limits named on stderr
MOST_STEPS = 100_000  # poses on a line, each way


@dataclass(frozen=True)
class Targets:
    """Tool poses, each with its directions of motion."""

    rows: list[Row]  # where each comes from
    positions: np.ndarray  # (N, 3) and (N, 3, 3): pose_tool_in_work, m
    rotations: np.ndarray
    senses: np.ndarray  # (N, 9), of axes and struts
    directions: list[str]  # what they are called
    along: np.ndarray | None = None  # way from the start of a line, (N,), m

    def where(self, n: int) -> str:
        """Say which pose one is, for messages."""
        if self.along is None:
            return common.where(self.rows[n])
        return f"{texts.number(float(self.along[n]) * 1e3, 3)} mm along the line, {self.directions[n]}"


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    geometry, model = common.load_machine(args)
    targets = _line(args, geometry) if args.line is not None else _poses(args)
    with common.progress_bar(len(targets.rows), " poses") as bar:
        poses = targets.positions, targets.rotations
        result = check(geometry, model, poses, "poses", progress=bar.update, senses=targets.senses)
    _refuse_lengthless(result, targets)
    predicted = None
    if args.model != "ideal":
        predicted = Predicted(RealMachine(geometry, model), args.model, geometry.platform_poses(*poses), targets.senses)
        if outside := int(result.outside_box.sum()):
            lie = "the pose lies" if len(targets.rows) == 1 else f"{outside} of {len(targets.rows)} poses lie"
            text = f"{lie} outside the box in which the model was measured; the predicted error there is extrapolated"
            common.say_notes([f"{text} ({region_text(model.measured, geometry)})"])
    shown = _result(args, geometry, model, targets, result.lengths, predicted)
    code = shown.finish(args)
    common.say_notes(f"{targets.where(breach.row)}: {breach.error}" for breach in result.breaches[:MOST_NOTES])
    if len(result.breaches) > MOST_NOTES:
        common.say_notes([f"{len(result.breaches) - MOST_NOTES} more limits are broken; see check"])
    return code


def _poses(args: argparse.Namespace) -> Targets:
    """Return the poses of the file, or the one that the options give, in one direction."""
    if args.poses is not None:
        with common.stage(f"reading {args.poses}"):
            rows, positions, rotations = read_pose_arrays(args.poses)
    elif args.pose is not None:
        rows, positions, rotations = common.one_row(args.pose)
    else:
        numbers = [getattr(args, name[2:].replace("-", "_")) or 0.0 for name in POSE_OPTIONS]
        place, angles = tuple(1e-3 * v for v in numbers[:3]), tuple(np.radians(numbers[3:]))
        rows, positions, rotations = common.one_row((place, angles))
    direction = args.direction or "midway"
    senses = np.full((len(rows), FOLLOWED), DIRECTIONS[direction])
    return Targets(rows, positions, rotations, senses, [direction] * len(rows))


def _line(args: argparse.Namespace, geometry: HexapodGeometry) -> Targets:
    """Return the poses along a straight line of the tool, forward and then, in the same order, backward."""
    # Each axis and each strut has the direction of its own motion; one that stands still has none.
    start, end, angles = args.line
    way, step = np.array(end) - np.array(start), args.step_mm * 1e-3
    length = float(np.linalg.norm(way))
    if length > step * MOST_STEPS:
        least = f"{length / MOST_STEPS * 1e3:g} or more on a line of {length * 1e3:g} mm"
        raise CommandError("usage", f"--step-mm: must be {least}, not {step * 1e3:g}")
    along = step * np.arange(int(length / step * (1.0 + 1e-9)) + 1)
    along = np.append(along, length) if length - along[-1] > 1e-6 * step else np.append(along[:-1], length)
    positions = np.array(start) + along[:, None] * (way / length)
    rotations = np.tile(rotation_from_angles(np.array([angles])), (len(along), 1, 1))
    passes = Passes.of_tool(geometry, positions, rotations, np.tile(way / length, (len(along), 1)))
    rows = [Row(0, str(n + 1)) for n in range(2 * len(along))]
    directions = ["forward"] * len(along) + ["backward"] * len(along)
    both = np.tile(positions, (2, 1)), np.tile(rotations, (2, 1, 1)), passes.both_ways().senses()
    return Targets(rows, *both, directions, np.tile(along, 2))


def _refuse_lengthless(result: CheckResult, targets: Targets) -> None:
    """Raise where there are no commands to give: the model cannot be undone at a pose."""
    if np.isfinite(result.lengths).all():
        return
    row = int((~np.isfinite(result.lengths)).any(axis=(1, 2)).argmax())
    for breach in result.breaches:
        if breach.row == row and isinstance(breach.error, NotConvergedError):
            raise NotConvergedError(f"{targets.where(row)}: {breach.error}")
    raise NotFiniteError(f"{targets.where(row)}: strut lengths are not finite")


class Predicted:
    """What the tool would do without compensation: as the machine stands, and with the datum aligned."""

    def __init__(self, machine: RealMachine, file: str, poses: Any, senses: np.ndarray) -> None:
        from ..calibration.posterior import COMPONENTS, ErrorPredictor
        from ..calibration.posterior_file import load_posterior  # slow to import, and needed with a model only

        fitted, self.unknown = load_posterior(machine.model, machine.geometry, file)
        held = None if fitted is None else fitted.held
        self.unseen = 0 if held is None else held.held  # of 6 ways in which readings did not show where it stands
        parts = ErrorPredictor(machine, fitted).predict(poses, senses)
        self._numbers = [
            n for part in parts for n in ((None, None) if part is None else (part.values, part.deviations))
        ]
        self._components = COMPONENTS

    def columns(self, row: int) -> dict[str, Any]:
        """Return one row's errors and their standard deviations, units in the names."""
        columns: dict[str, Any] = {}
        for name, values in zip(PREDICTED_ERRORS, self._numbers, strict=True):
            for n, component in enumerate(self._components):
                key = f"{name.format(component)}_{'urad' if component[0] == 'r' else 'um'}"
                columns[key] = None if values is None else float(values[row, n]) * 1e6
        return columns

    def text(self, direction: str) -> str:
        """Return the first pose's errors as a table for people."""
        cells = ["not known" if value is None else texts.number(value, 2) for value in self.columns(0).values()]
        rows = zip(*(cells[start : start + 6] for start in range(0, 24, 6)), strict=True)
        named = zip(self._components, rows, strict=True)
        body = [[name, *row, "µrad" if name[0] == "r" else "µm"] for name, row in named]
        title = "predicted error of the tool without compensation, actual − commanded, along and about the axes of work"
        title += ";\ndirection of motion not known: midway" if direction == "midway" else f";\n{_moved(direction)}"
        title += f"; ± is one standard deviation{f', not known: {self.unknown}' if self.unknown else ' of the fit'}"
        if self.unseen:
            title += (
                f";\nin {self.unseen} of 6 ways the readings did not show where the machine stands as a whole: there "
                "the error as it stands is zero at the\nheld datum, and ± has the tolerance of the structure"
            )
        return f"{title}\n{texts.aligned(['in work', 'as it stands', '±', 'datum aligned', '±', ''], body)}\n"


def _moved(direction: str) -> str:
    return f"all axes and struts moved {direction}"


def _result(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    model: MachineModel,
    targets: Targets,
    lengths: np.ndarray,
    predicted: Predicted | None,
) -> common.Result:
    """Return the rows; as text CSV, or a table of one pose, and nothing where a file is written."""
    # Also an ideal machine's commands are not its lengths where screws turn with the joints.
    corrected = predicted is not None or bool(geometry.screw_lead.any())
    rows = [_row(targets, n, lengths[n], corrected or args.line is not None) for n in range(len(targets.rows))]
    if predicted is not None:
        rows = [{**columns, **predicted.columns(n)} for n, columns in enumerate(rows)]
    one = args.poses is None and args.line is None
    content: dict[str, Any] = {"machine": geometry.name, "model": model.name, **common.frames(geometry)}
    if predicted is not None:
        content |= {"error_frame": geometry.work_name, "error_sd_not_known": predicted.unknown or None}

    def text() -> str:
        if args.out is not None or not one:
            common.mention_default(args, geometry)
            return "" if args.out is not None else Table(rows).csv()
        (nominal, command), direction = lengths[0] * 1e3, targets.directions[0]
        columns = {"nominal_mm": nominal}
        columns |= {"command_mm": command, "correction_um": (command - nominal) * 1e3} if corrected else {}
        struts = [{"strut": n, **dict(zip(columns, v, strict=True))}
                  for n, *v in zip(STRUT_NAMES, *(c.tolist() for c in columns.values()), strict=True)]  # fmt: skip
        title = f"{common.machine_title(geometry, model)}: strut lengths for a pose of {common.whose(geometry)}"
        title += "" if direction == "midway" else f", {_moved(direction)}"
        errors = f"\n{predicted.text(direction)}" if predicted is not None else ""
        return f"{title}\n{Table(struts).text()}\n{errors}"

    return common.Result(text, lambda: {**content, "rows": rows}, rows)


def _row(targets: Targets, n: int, lengths: np.ndarray, with_model: bool) -> dict[str, Any]:
    """Return one row of the output: label, commands and, with a model, direction, nominal lengths and corrections."""
    nominal, command = lengths
    columns: dict[str, Any] = {"sequence": targets.rows[n].label}
    columns |= {"direction": targets.directions[n]} if with_model else {}
    if targets.along is not None:
        columns["along_mm"] = float(targets.along[n]) * 1e3
        columns |= pose_values(Pose(targets.positions[n], targets.rotations[n]))
    columns |= length_values(command if with_model else nominal)
    if with_model:
        columns |= {f"nominal_{name}": value for name, value in length_values(nominal).items()}
        corrections = zip(LENGTH_COLUMNS, ((command - nominal) * 1e6).tolist(), strict=True)
        columns |= {f"correction_{name}_um": value for name, value in corrections}
    return columns
