"""``hexapod_comp ik``: strut lengths for tool poses."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..formats import texts
from . import arguments, common

if TYPE_CHECKING:
    import numpy as np

    from ..calibration.posterior import PredictedError
    from ..compensation.checks import CheckResult
    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel, RealMachine
    from ..machine.passes import Poses


MOST_NOTES = 10
"""Broken limits named on stderr."""

MOST_STEPS = 100_000
"""Poses on a line, each way."""


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..compensation.checks import check
    from ..machine.model import RealMachine

    _refuse_several(args)
    geometry, model = common.load_machine(args)
    targets = _targets(args, geometry)
    with common.progress_bar(len(targets.rows), " poses") as bar:
        given = targets.positions, targets.rotations
        result = check(geometry, model, given, "poses", progress=bar.update, senses=targets.senses)
    _refuse_lengthless(result, targets)
    predicted = None
    if args.model != "ideal":
        platforms = geometry.platform_poses(*given)
        predicted = _Predicted.of(RealMachine(geometry, model), args.model, platforms, targets.senses)
        _mention_outside(geometry, model, int(result.outside_box.sum()), len(targets.rows))
    _show(args, geometry, model, targets, result, predicted)
    common.say_notes(f"{targets.where(breach.row)}: {breach.error}" for breach in result.breaches[:MOST_NOTES])
    if len(result.breaches) > MOST_NOTES:
        common.say_notes([f"{len(result.breaches) - MOST_NOTES} more limits are broken; see check"])
    return 0


@dataclass(frozen=True)
class _Targets:
    """Tool poses, each with its directions of motion."""

    rows: list[Row]  # where each comes from
    positions: np.ndarray  # (N, 3), (N, 3, 3): ``pose_tool_in_work``, m
    rotations: np.ndarray  # (N, 3), (N, 3, 3)
    senses: np.ndarray  # (N, 9): of axes and struts
    directions: list[str]  # what they are called
    along: np.ndarray | None = None  # (N,), or None: way from the start of a line, m

    def where(self, n: int) -> str:
        """Say which pose one is, for messages."""
        if self.along is None:
            return common.where(self.rows[n])
        return f"{texts.number(float(self.along[n]) * 1e3, 3)} mm along the line, {self.directions[n]}"

    def columns(self, n: int) -> dict[str, Any]:
        """Return what a row of the output says of where a pose of a line is."""
        from ..formats.csv import pose_values
        from ..pose import Pose

        if self.along is None:
            return {}
        pose = Pose(self.positions[n], self.rotations[n])
        return {"along_mm": float(self.along[n]) * 1e3, **pose_values(pose)}


def _refuse_several(args: argparse.Namespace) -> None:
    """Raise unless poses are given in exactly one way."""
    from ..errors import CommandError

    by_number = any(getattr(args, name) is not None for name in arguments.POSE_OPTIONS)
    if (args.poses is not None) + (args.pose is not None) + (args.line is not None) + by_number != 1:
        problem = "give a CSV file of poses, or --pose, or --x-mm --y-mm --z-mm, or --line; exactly one of the four"
        raise CommandError("usage", problem)
    if args.line is not None and args.direction is not None:
        raise CommandError("usage", "--line gives both directions; --direction goes with poses")


def _targets(args: argparse.Namespace, geometry: HexapodGeometry) -> _Targets:
    """Return the poses that the options give or name, each with its direction."""
    import numpy as np

    from ..formats.csv import read_pose_arrays
    from ..machine.model import DIRECTIONS, FOLLOWED

    if args.line is not None:
        start, end, angles = args.line
        return _line(geometry, start, end, angles, args.step_mm * 1e-3)
    with common.stage(f"reading {args.poses}"):
        rows, positions, rotations = _given_pose(args) if args.poses is None else read_pose_arrays(args.poses)
    direction = args.direction or "midway"
    senses = np.full((len(rows), FOLLOWED), DIRECTIONS[direction])
    return _Targets(rows, positions, rotations, senses, [direction] * len(rows))


def _line(
    geometry: HexapodGeometry,
    start: tuple[float, ...],
    end: tuple[float, ...],
    angles: tuple[float, ...],
    step: float,
) -> _Targets:
    """Return the poses along a straight line of the tool, forward and then, in the same order, backward.

    Each axis and each strut has the direction of its own motion; one that stands still has none.
    """
    import numpy as np

    from ..errors import CommandError
    from ..formats.csv import Row
    from ..machine.passes import Passes
    from ..pose import rotation_from_angles

    way = np.array(end) - np.array(start)
    length = float(np.linalg.norm(way))
    if length > step * MOST_STEPS:
        least = f"{length / MOST_STEPS * 1e3:g} or more on a line of {length * 1e3:g} mm"
        problem = f"--step-mm: must be {least}, not {step * 1e3:g}"
        raise CommandError("usage", problem)
    whole = int(length / step * (1.0 + 1e-9))
    along = step * np.arange(whole + 1)
    along = np.append(along, length) if length - along[-1] > 1e-6 * step else np.append(along[:-1], length)
    positions = np.array(start) + along[:, None] * (way / length)
    rotations = np.tile(rotation_from_angles(np.array([angles])), (len(along), 1, 1))
    senses = Passes.of_tool(geometry, positions, rotations, np.tile(way / length, (len(along), 1))).both_ways().senses()
    return _Targets(
        [Row(0, str(n + 1)) for n in range(2 * len(along))],
        np.tile(positions, (2, 1)),
        np.tile(rotations, (2, 1, 1)),
        senses,
        ["forward"] * len(along) + ["backward"] * len(along),
        np.tile(along, 2),
    )


def _given_pose(args: argparse.Namespace) -> tuple[list[Row], np.ndarray, np.ndarray]:
    """Return the pose given by options."""
    from ..errors import CommandError

    if args.pose is not None:
        return common.one_row(args.pose)
    single = [getattr(args, name) for name in arguments.POSE_OPTIONS]
    missing = [name for name, value in zip(arguments.POSE_OPTIONS[:3], single, strict=False) if value is None]
    if missing:
        raise CommandError("usage", f"--{missing[0].replace('_', '-')} is missing")
    return common.one_row(arguments.pose(",".join(repr(value or 0.0) for value in single)))


def _refuse_lengthless(result: CheckResult, targets: _Targets) -> None:
    """Raise where there are no commands to give: the model cannot be undone at a pose."""
    import numpy as np

    from ..errors import NotConvergedError, NotFiniteError

    if np.isfinite(result.lengths).all():
        return
    row = int((~np.isfinite(result.lengths)).any(axis=(1, 2)).argmax())
    for breach in result.breaches:
        if breach.row == row and isinstance(breach.error, NotConvergedError):
            raise NotConvergedError(f"{targets.where(row)}: {breach.error}")
    raise NotFiniteError(f"{targets.where(row)}: strut lengths are not finite")


@dataclass(frozen=True)
class _Predicted:
    """What the tool would do without compensation: as the machine stands, and with the datum aligned."""

    standing: PredictedError
    aligned: PredictedError | None
    unknown: str
    unseen: int  # ways of the whole machine to shift and turn that readings did not show

    @staticmethod
    def of(machine: RealMachine, model_file: str, poses: Poses, senses: np.ndarray) -> _Predicted:
        """Predict for platform poses; what the model file says of its fit is read."""
        from ..calibration.posterior import ErrorPredictor
        from ..calibration.posterior_file import load_posterior

        fitted, unknown = load_posterior(machine.model, machine.geometry, model_file)
        standing, aligned = ErrorPredictor(machine, fitted).predict(poses, senses)
        held = None if fitted is None else fitted.held
        return _Predicted(standing, aligned, unknown, 0 if held is None else held.held)

    def columns(self, row: int) -> dict[str, Any]:
        """Return one row's errors and their standard deviations, units in the names."""
        from ..calibration.posterior import COMPONENTS
        from ..formats.csv import PREDICTED_ERRORS

        numbers = [part for predicted in (self.standing, self.aligned) for part in _parts(predicted)]
        columns: dict[str, Any] = {}
        for name, values in zip(PREDICTED_ERRORS, numbers, strict=True):
            for n, component in enumerate(COMPONENTS):
                key = f"{name.format(component)}_{'urad' if component[0] == 'r' else 'um'}"
                columns[key] = None if values is None else float(values[row, n]) * 1e6
        return columns

    def text(self, direction: str) -> str:
        """Return the first pose's errors as a table for people."""
        from ..calibration.posterior import COMPONENTS

        cells = ["not known" if value is None else texts.number(value, 2) for value in self.columns(0).values()]
        rows = zip(*(cells[start : start + 6] for start in range(0, 24, 6)), strict=True)
        body = [[c, *row, "µrad" if c[0] == "r" else "µm"] for c, row in zip(COMPONENTS, rows, strict=True)]
        header = ["in work", "as it stands", "±", "datum aligned", "±", ""]
        title = (
            "predicted error of the tool without compensation, actual − commanded, along and about the axes of work;\n"
        )
        title += "direction of motion not known: midway" if direction == "midway" else _moved(direction)
        title += "; ± is one standard deviation"
        title += f", not known: {self.unknown}" if self.unknown else " of the fit"
        if self.unseen:
            title += (
                f";\nin {self.unseen} of 6 ways the readings did not show where the machine stands as a whole: there "
            )
            title += "the error as it stands is zero at the\nheld datum, and ± has the tolerance of the structure"
        return f"{title}\n{texts.aligned(header, body)}\n"


def _moved(direction: str) -> str:
    return f"all axes and struts moved {direction}"


def _parts(predicted: PredictedError | None) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return values and standard deviations, None for what is not known."""
    return (None, None) if predicted is None else (predicted.values, predicted.deviations)


def _mention_outside(geometry: HexapodGeometry, model: MachineModel, outside: int, count: int) -> None:
    """Say on stderr that predictions go beyond what was measured."""
    from ..machine.region import region_text

    if outside:
        poses = "the pose lies" if count == 1 else f"{outside} of {count} poses lie"
        text = f"{poses} outside the box in which the model was measured; the predicted error there is extrapolated"
        print(f"hexapod_comp: note: {text} ({region_text(model.measured, geometry)})", file=sys.stderr)


def _show(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    model: MachineModel,
    targets: _Targets,
    result: CheckResult,
    predicted: _Predicted | None,
) -> None:
    """Write the CSV file; print JSON or, where no file was written, CSV or a table of one pose.

    Also an ideal machine's commands are not its lengths where screws turn with the joints.
    """
    with_model = predicted is not None or targets.along is not None or bool(geometry.screw_lead.any())
    table = [_columns(targets, n, result.lengths[n], with_model) for n in range(len(targets.rows))]
    if predicted is not None:
        table = [{**columns, **predicted.columns(n)} for n, columns in enumerate(table)]
    common.write_table(args, table)
    if args.json:
        content: dict[str, Any] = {"machine": geometry.name, "model": model.name, **common.frames(geometry)}
        if predicted is not None:
            content |= {"error_frame": geometry.work_name, "error_sd_not_known": predicted.unknown or None}
        common.show({**content, "rows": table})
        return
    one = args.poses is None and args.line is None
    if args.out is not None or not one:
        common.mention_default(args, geometry)
    if args.out is None:
        direction = targets.directions[0]
        common.show(
            _one_pose(geometry, model, result.lengths[0], predicted, direction) if one else common.csv_text(table)
        )


def _columns(targets: _Targets, n: int, lengths: np.ndarray, with_model: bool) -> dict[str, Any]:
    """Return one row of the output: label, commands and, with a model, direction, nominal lengths and corrections."""
    from ..formats.csv import LENGTH_COLUMNS, length_values

    nominal, command = lengths
    columns: dict[str, Any] = {"sequence": targets.rows[n].label}
    columns |= {"direction": targets.directions[n]} if with_model else {}
    columns |= {**targets.columns(n), **length_values(command if with_model else nominal)}
    if with_model:
        columns |= {f"nominal_{name}": value for name, value in length_values(nominal).items()}
        corrections = (command - nominal) * 1e6
        columns |= {
            f"correction_{name}_um": float(value) for name, value in zip(LENGTH_COLUMNS, corrections, strict=True)
        }
    return columns


def _one_pose(
    geometry: HexapodGeometry, model: MachineModel, lengths: np.ndarray, predicted: _Predicted | None, direction: str
) -> str:
    """Return one pose's lengths, and with a model the error that they take out, as tables for people."""
    from ..machine.geometry import STRUT_NAMES

    nominal, command = lengths
    header, columns = ["strut", "nominal_mm"], [nominal * 1e3]
    if predicted is not None or geometry.screw_lead.any():
        header += ["command_mm", "correction_um"]
        columns += [command * 1e3, (command - nominal) * 1e6]
    digits = [6, 6, 3]
    body = [
        [name, *(texts.number(float(c[i]), d) for c, d in zip(columns, digits, strict=False))]
        for i, name in enumerate(STRUT_NAMES)
    ]
    title = common.machine_title(geometry, model) + f": strut lengths for a pose of {common.whose(geometry)}"
    title += "" if direction == "midway" else f", {_moved(direction)}"
    errors = f"\n{predicted.text(direction)}" if predicted is not None else ""
    return f"{title}\n{texts.aligned(header, body)}\n{errors}"
