"""``hexapod_comp ik``: strut lengths for tool poses."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from ..formats import texts
from . import common

if TYPE_CHECKING:
    import numpy as np

    from ..compensation.checks import CheckResult
    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel

SUMMARY = "strut lengths (mm) for a tool pose or a CSV file of poses (mm, degrees)"

TEXT = """A file's columns are x_mm, y_mm, z_mm, optionally alpha_deg, beta_deg, gamma_deg (or qx, qy, qz, qw)
and sequence or name; other units by their suffix (_m, _um, _in, _rad). CSV in gives CSV out, L1_mm … L6_mm,
which fk reads. With --model, L1_mm … L6_mm are the lengths to command, nominal_L1_mm … and
correction_L1_um … (command − nominal) follow. Directions of motion are not known here: a backlash counts
half either way. Lengths are given for any pose; limits that it breaks are named on stderr (see check).

example:
  $ hexapod_comp ik --pose 0,0,400,5,0,0
  machine paper
    strut  nominal_mm
  strut_1  519.493721
  strut_2  519.807869
  strut_3  509.191843
  strut_4  509.191843
  strut_5  499.282327
  strut_6  498.955256
  $ hexapod_comp ik config/table1.csv --model paper_machine --out lengths.csv"""

POSE_OPTIONS = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "ik", run, SUMMARY, TEXT)
    parser.add_argument("poses", nargs="?", metavar="POSES.csv", help="CSV file of poses; - for standard input")
    parser.add_argument("--pose", type=common.pose_argument, metavar="X,Y,Z[,A,B,C]", help=common.POSE_HELP)
    for name in POSE_OPTIONS:
        unit = "mm" if name.endswith("mm") else "degrees"
        text = f"the pose number by number, {unit}"
        parser.add_argument(f"--{name.replace('_', '-')}", type=common.finite, metavar="NUMBER", help=text)
    common.add_machine_options(parser)
    common.add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..compensation.checks import check
    from ..formats.csv import read_pose_arrays

    rows, positions, rotations = _given_pose(args) or read_pose_arrays(args.poses)
    geometry, model = common.load_machine(args)
    common.mention_compiling("checks.examine_many")
    result = check(geometry, model, (positions, rotations), "poses")
    _refuse_lengthless(result, rows)
    with_model = args.model != "ideal"
    common.emit(_text(args, geometry, model, rows, result, with_model), args.out)
    for breach in result.breaches:
        print(f"hexapod_comp: note: {common.where(rows[breach.row])}: {breach.error}", file=sys.stderr)
    return 0


def _given_pose(args: argparse.Namespace) -> tuple[list[Row], np.ndarray, np.ndarray] | None:
    """Return the pose given by options, None when a file is; refuse both and neither."""
    from ..errors import CommandError

    single = [getattr(args, name) for name in POSE_OPTIONS]
    ways = [args.poses is not None, args.pose is not None, any(value is not None for value in single)]
    if sum(ways) != 1:
        problem = "give a CSV file of poses, or --pose, or --x-mm --y-mm --z-mm; exactly one of the three"
        raise CommandError("usage", problem)
    if args.poses is not None:
        return None
    if args.pose is not None:
        return common.one_row(args.pose)
    missing = [name for name, value in zip(POSE_OPTIONS[:3], single, strict=False) if value is None]
    if missing:
        raise CommandError("usage", f"--{missing[0].replace('_', '-')} is missing")
    return common.one_row(common.pose_argument(",".join(repr(value or 0.0) for value in single)))


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


def _text(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    model: MachineModel,
    rows: list[Row],
    result: CheckResult,
    with_model: bool,
) -> str:
    """Return the result as JSON, CSV or, for one pose, as a table."""
    table = [_columns(row, lengths, with_model) for row, lengths in zip(rows, result.lengths, strict=True)]
    if args.json:
        head = {"machine": geometry.name, "model": model.name}
        return common.json_text({**head, "rows": table})
    if args.poses is not None or args.out:
        return common.csv_text(table)
    return _one_pose(geometry, model, result.lengths[0], with_model)


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
