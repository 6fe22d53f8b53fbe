"""``hexapod_comp ik``: strut lengths for tool poses."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from ..formats import texts
from . import arguments, common

if TYPE_CHECKING:
    import numpy as np

    from ..compensation.checks import CheckResult
    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..compensation.checks import check
    from ..formats.csv import read_pose_arrays

    rows, positions, rotations = _given_pose(args) or read_pose_arrays(args.poses)
    geometry, model = common.load_machine(args)
    common.mention_compiling("checks.examine_many")
    result = check(geometry, model, (positions, rotations), "poses")
    _refuse_lengthless(result, rows)
    _show(args, geometry, model, rows, result)
    for breach in result.breaches:
        print(f"hexapod_comp: note: {common.where(rows[breach.row])}: {breach.error}", file=sys.stderr)
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


def _show(
    args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], result: CheckResult
) -> None:
    """Write the CSV file; print JSON or, where no file was written, CSV or a table of one pose."""
    with_model = args.model != "ideal"
    table = [_columns(row, lengths, with_model) for row, lengths in zip(rows, result.lengths, strict=True)]
    common.write_table(args, table)
    if args.json:
        common.show({"machine": geometry.name, "model": model.name, "rows": table})
    elif args.out is None:
        one = args.poses is None
        common.show(_one_pose(geometry, model, result.lengths[0], with_model) if one else common.csv_text(table))


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


def _one_pose(geometry: HexapodGeometry, model: MachineModel, lengths: np.ndarray, with_model: bool) -> str:
    """Return one pose's lengths as a table for people."""
    from ..machine.geometry import STRUT_NAMES

    nominal, command = lengths
    header, columns = ["strut", "nominal_mm"], [nominal * 1e3]
    if with_model:
        header += ["command_mm", "correction_um"]
        columns += [command * 1e3, (command - nominal) * 1e6]
    digits = [6, 6, 3]
    body = [
        [name, *(texts.number(float(c[i]), d) for c, d in zip(columns, digits, strict=False))]
        for i, name in enumerate(STRUT_NAMES)
    ]
    title = f"machine {geometry.name}" + (f", model {model.name}" if with_model else "")
    return f"{title}\n{texts.aligned(header, body)}\n"
