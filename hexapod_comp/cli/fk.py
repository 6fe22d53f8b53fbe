"""``hexapod_comp fk``: tool poses from strut lengths."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from ..errors import KinematicsError, UnreachableError
from ..formats.csv import Row, pose_values, read_lengths
from ..machine.assembly import ORIENTATIONS, assembly_modes, is_six_three, mode_objections, working_mode
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, solve_pose, solve_poses
from ..machine.model import DIRECTIONS, FOLLOWED, MachineModel, RealMachine
from ..pose import Pose, stacked
from . import common
from .table import Table


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    if args.lengths is None:
        with common.stage(f"reading {args.lengths_file}"):
            rows, lengths = read_lengths(args.lengths_file)
    else:
        rows, lengths = [Row(0, "1")], np.array([args.lengths])
    geometry, model = common.load_machine(args)
    if (args.cold or args.all_modes) and not is_six_three(Structure.of(geometry)):
        sets = "these lengths" if len(rows) == 1 else "each row's lengths"
        how = f"Newton sought the poses of {sets} from home and {2 * ORIENTATIONS} starts all around"
        proof = "each closes the loops, but nothing proves that there are no others"
        common.say_notes([f"machine {geometry.name} is no 6-3 machine: {how}; {proof}"])
    return _all_modes(args, geometry, lengths[0]) if args.all_modes else _poses(args, geometry, model, rows, lengths)


def _poses(
    args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], lengths: np.ndarray
) -> common.Result:
    """Solve all rows; as text CSV, or a table of one pose, and nothing where a file is written."""
    poses = zip(rows, _solve(args, geometry, model, rows, lengths), strict=True)
    table = [{"sequence": row.label, **pose_values(geometry.tool_pose(pose))} for row, pose in poses]
    content: dict[str, Any] = {"machine": geometry.name, "model": model.name, **common.frames(geometry)}
    content |= {"direction": args.direction or "midway"} if args.model != "ideal" else {}

    def text() -> str:
        if args.lengths is None:
            common.mention_default(args, geometry)
            return "" if args.out is not None else Table(table).csv()
        title = f"{common.machine_title(geometry, model)}: pose of {common.whose(geometry)}"
        title += f", all axes and struts moved {args.direction}" if args.direction else ""
        return "" if args.out is not None else f"{title}\n{Table(table).text(list(table[0])[1:])}"

    return common.Result(text, lambda: {**content, "rows": table}, table)


def _solve(
    args: argparse.Namespace, geometry: HexapodGeometry, model: MachineModel, rows: list[Row], lengths: np.ndarray
) -> list[Pose]:
    """Return the platform pose of every row; the first row without one is named."""
    machine = RealMachine(geometry, model)
    commands = args.model != "ideal" or bool(geometry.screw_lead.any())  # rather than lengths
    structure = machine.structure if commands else Structure.of(geometry)
    guess = geometry.home if args.guess is None else geometry.platform_pose(Pose.from_angles(*args.guess))
    senses = np.full(FOLLOWED, DIRECTIONS[args.direction or "midway"])
    batch = None if args.cold else solve_poses(structure, lengths, guess)
    poses = []
    with common.progress_bar(len(rows), " rows") as bar:
        for n, row in enumerate(rows):
            bar.update()
            try:
                if batch is None:
                    pose = working_mode(geometry, structure, lengths[n])
                elif batch.ok[n]:
                    pose = Pose(batch.positions[n], batch.rotations[n])
                else:
                    pose = solve_pose(structure, lengths[n], guess)
                if commands:  # struts and field come on top
                    pose = machine.pose_for(lengths[n], senses, pose)[0]
            except KinematicsError as error:
                problem = f"{common.where(row)}: {error}" if row.line else str(error)
                raise KinematicsError(problem, error.value, error.limit) from error
            poses.append(pose)
    return poses


def _all_modes(args: argparse.Namespace, geometry: HexapodGeometry, lengths: np.ndarray) -> common.Result:
    """Show every assembly mode, and say for each why it is, or is not, the working one."""
    structure = Structure.of(geometry)
    modes = assembly_modes(structure, lengths)
    if not modes:
        raise UnreachableError("no pose of the machine has these strut lengths", 0)
    working, reason = None, ""
    try:
        working = working_mode(geometry, structure, lengths)
    except KinematicsError as error:
        reason = str(error)
    listed: list[dict[str, Any]] = []
    for index, mode in enumerate(modes, start=1):
        same = working is not None and all(map(np.array_equal, stacked([mode]), stacked([working])))
        objections = mode_objections(geometry, structure, mode)
        values = pose_values(geometry.tool_pose(mode))
        listed.append({"mode": index, **values, "working": same, "objections": objections})

    def text() -> str:
        if args.out is not None:
            return ""
        further = "possible, further from home"
        verdicts = ["working mode" if m["working"] else "; ".join(m["objections"]) or further for m in listed]
        shown = [{**m, "": verdict} for m, verdict in zip(listed, verdicts, strict=True)]
        table = Table(shown).text(["mode", *(n for n in shown[0] if n.endswith(("_mm", "_deg"))), ""])
        title = f"machine {geometry.name}: {len(modes)} assembly modes, tool in work"
        return "\n".join([title, table, *([f"no working mode: {reason}"] if reason else [])])

    return common.Result(
        text,
        lambda: {"machine": geometry.name, **common.frames(geometry), "modes": listed, "no_working_mode": reason},
        [{**m, "working": int(m["working"]), "objections": "; ".join(m["objections"])} for m in listed],
    )
