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

    from ..calibration.prediction import PredictedError
    from ..compensation.checks import CheckResult
    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel, RealMachine
    from ..machine.passes import Poses


MOST_NOTES = 10
"""Broken limits named on stderr."""


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..compensation.checks import check
    from ..formats.csv import read_pose_arrays
    from ..machine.model import RealMachine

    with common.stage(f"reading {args.poses}"):
        rows, positions, rotations = _given_pose(args) or read_pose_arrays(args.poses)
    geometry, model = common.load_machine(args)
    with common.progress_bar(len(rows), " poses") as bar:
        result = check(geometry, model, (positions, rotations), "poses", progress=bar.update)
    _refuse_lengthless(result, rows)
    predicted = None
    if args.model != "ideal":
        platforms = geometry.platform_poses(positions, rotations)
        predicted = _Predicted.of(RealMachine(geometry, model), args.model, platforms)
        _mention_outside(geometry, model, int(result.outside_box.sum()), len(rows))
    _show(args, geometry, model, rows, result, predicted)
    common.say_notes(f"{common.where(rows[breach.row])}: {breach.error}" for breach in result.breaches[:MOST_NOTES])
    if len(result.breaches) > MOST_NOTES:
        common.say_notes([f"{len(result.breaches) - MOST_NOTES} more limits are broken; see check"])
    return 0


def _given_pose(args: argparse.Namespace) -> tuple[list[Row], np.ndarray, np.ndarray] | None:
    """Return the pose given by options, None when a file is; refuse both and neither."""
    from ..errors import CommandError

    single = [getattr(args, name) for name in arguments.POSE_OPTIONS]
    ways = [args.poses is not None, args.pose is not None, any(value is not None for value in single)]
    if sum(ways) != 1:
        problem = "give a CSV file of poses, or --pose, or --x-mm --y-mm --z-mm; exactly one of the three"
        raise CommandError("usage", problem)
    if args.poses is not None:
        return None
    if args.pose is not None:
        return common.one_row(args.pose)
    missing = [name for name, value in zip(arguments.POSE_OPTIONS[:3], single, strict=False) if value is None]
    if missing:
        raise CommandError("usage", f"--{missing[0].replace('_', '-')} is missing")
    return common.one_row(arguments.pose(",".join(repr(value or 0.0) for value in single)))


def _refuse_lengthless(result: CheckResult, rows: list[Row]) -> None:
    """Raise where there are no commands to give: the model cannot be undone at a pose."""
    import numpy as np

    from ..errors import NotConvergedError, NotFiniteError

    if np.isfinite(result.lengths).all():
        return
    row = int((~np.isfinite(result.lengths)).any(axis=(1, 2)).argmax())
    for breach in result.breaches:
        if breach.row == row and isinstance(breach.error, NotConvergedError):
            raise NotConvergedError(f"{common.where(rows[row])}: {breach.error}")
    raise NotFiniteError(f"{common.where(rows[row])}: strut lengths are not finite")


@dataclass(frozen=True)
class _Predicted:
    """What the tool would do without compensation: as the machine stands, and with the datum aligned."""

    standing: PredictedError
    aligned: PredictedError | None
    unknown: str
    unseen: int  # ways of the whole machine to shift and turn that readings did not show

    @staticmethod
    def of(machine: RealMachine, model_file: str, poses: Poses) -> _Predicted:
        """Predict for platform poses; what the model file says of its fit is read."""
        from ..calibration.posterior import load_posterior
        from ..calibration.prediction import ErrorPredictor

        fitted, unknown = load_posterior(machine.model, machine.geometry, model_file)
        standing, aligned = ErrorPredictor(machine, fitted).predict(poses)
        held = None if fitted is None else fitted.held
        return _Predicted(standing, aligned, unknown, 0 if held is None else held.held)

    def columns(self, row: int) -> dict[str, Any]:
        """Return one row's errors and their standard deviations, units in the names."""
        from ..calibration.prediction import COMPONENTS
        from ..formats.csv import PREDICTED_ERRORS

        numbers = [part for predicted in (self.standing, self.aligned) for part in _parts(predicted)]
        columns: dict[str, Any] = {}
        for name, values in zip(PREDICTED_ERRORS, numbers, strict=True):
            for n, component in enumerate(COMPONENTS):
                key = f"{name.format(component)}_{'urad' if component[0] == 'r' else 'um'}"
                columns[key] = None if values is None else float(values[row, n]) * 1e6
        return columns

    def text(self) -> str:
        """Return the first pose's errors as a table for people."""
        from ..calibration.prediction import COMPONENTS

        cells = ["not known" if value is None else texts.number(value, 2) for value in self.columns(0).values()]
        rows = zip(*(cells[start : start + 6] for start in range(0, 24, 6)), strict=True)
        body = [[c, *row, "µrad" if c[0] == "r" else "µm"] for c, row in zip(COMPONENTS, rows, strict=True)]
        header = ["in work", "as it stands", "±", "datum aligned", "±", ""]
        title = (
            "predicted error of the tool without compensation, actual − commanded, along and about the axes of work;\n"
        )
        title += "direction of motion not known: midway; ± is one standard deviation"
        title += f", not known: {self.unknown}" if self.unknown else " of the fit"
        if self.unseen:
            title += (
                f";\nin {self.unseen} of 6 ways the readings did not show where the machine stands as a whole: there "
            )
            title += "the error as it stands is zero at the\nheld datum, and ± has the tolerance of the structure"
        return f"{title}\n{texts.aligned(header, body)}\n"


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
    rows: list[Row],
    result: CheckResult,
    predicted: _Predicted | None,
) -> None:
    """Write the CSV file; print JSON or, where no file was written, CSV or a table of one pose.

    Also an ideal machine's commands are not its lengths where screws turn with the joints.
    """
    with_model = predicted is not None or bool(geometry.screw_lead.any())
    table = [_columns(row, lengths, with_model) for row, lengths in zip(rows, result.lengths, strict=True)]
    if predicted is not None:
        table = [{**columns, **predicted.columns(n)} for n, columns in enumerate(table)]
    common.write_table(args, table)
    if args.json:
        content: dict[str, Any] = {"machine": geometry.name, "model": model.name, **common.frames(geometry)}
        if predicted is not None:
            content |= {"error_frame": geometry.work_name, "error_sd_not_known": predicted.unknown or None}
        common.show({**content, "rows": table})
    elif args.out is None:
        one = args.poses is None
        common.show(_one_pose(geometry, model, result.lengths[0], predicted) if one else common.csv_text(table))


def _columns(row: Row, lengths: np.ndarray, with_model: bool) -> dict[str, Any]:
    """Return one row of the output: label, commands and, with a model, nominal lengths and corrections."""
    from ..formats.csv import LENGTH_COLUMNS, length_values

    nominal, command = lengths
    columns: dict[str, Any] = {"sequence": row.label, **length_values(command if with_model else nominal)}
    if with_model:
        columns |= {f"nominal_{name}": value for name, value in length_values(nominal).items()}
        corrections = (command - nominal) * 1e6
        columns |= {
            f"correction_{name}_um": float(value) for name, value in zip(LENGTH_COLUMNS, corrections, strict=True)
        }
    return columns


def _one_pose(geometry: HexapodGeometry, model: MachineModel, lengths: np.ndarray, predicted: _Predicted | None) -> str:
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
    return f"{title}\n{texts.aligned(header, body)}\n" + (f"\n{predicted.text()}" if predicted is not None else "")
