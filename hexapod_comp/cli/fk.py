"""``hexapod_comp fk``: tool poses from strut lengths."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ..formats import texts
from . import common

if TYPE_CHECKING:
    import numpy as np

    from ..formats.csv import Row
    from ..machine.geometry import HexapodGeometry
    from ..machine.model import MachineModel
    from ..pose import Pose

MODE_COLUMNS = ("mode", "x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg", "")


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import CommandError

    if (args.lengths_file is None) == (args.lengths is None):
        raise CommandError("usage", "give either a CSV file of lengths or --lengths")
    if args.all_modes and (args.lengths is None or args.model != "ideal"):
        raise CommandError("usage", "--all-modes goes with --lengths and the nominal machine only")
    with common.stage(f"reading {args.lengths_file}"):
        rows, lengths = _read(args)
    geometry, model = common.load_machine(args)
    _mention_search(args, geometry, len(rows))
    if args.all_modes:
        _all_modes(args, geometry, lengths[0])
    else:
        _poses(args, geometry, model, rows, lengths)
    return 0


def _mention_search(args: argparse.Namespace, geometry: HexapodGeometry, rows: int) -> None:
    """Say on stderr what a start without a guess is worth where no theory counts the poses."""
    from ..machine.assembly import ORIENTATIONS, is_six_three
    from ..machine.kinematics import Structure

    if not (args.cold or args.all_modes) or is_six_three(Structure.of(geometry)):
        return
    sets = "these lengths" if rows == 1 else "each row's lengths"
    common.say_notes(
        [
            f"machine {geometry.name} is no 6-3 machine: Newton sought the poses of {sets} from home and "
            f"{2 * ORIENTATIONS} starts all around; each closes the loops, but nothing proves that there are no others"
        ]
    )


def _read(args: argparse.Namespace) -> tuple[list[Row], np.ndarray]:
    import numpy as np

    from ..formats.csv import Row, read_lengths

    if args.lengths is None:
        return read_lengths(args.lengths_file)
    return [Row(0, "1")], np.array([args.lengths])


def _poses(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    model: MachineModel,
    rows: list[Row],
    lengths: np.ndarray,
) -> None:
    """Solve all rows; write the CSV file, print JSON or, where no file was written, CSV or a table of one pose."""
    from ..formats.csv import pose_values

    poses = _solve(args, geometry, model, rows, lengths)
    table: list[dict[str, Any]] = [
        {"sequence": row.label, **pose_values(geometry.tool_pose(pose))} for row, pose in zip(rows, poses, strict=True)
    ]
    common.write_table(args, table)
    direction = args.direction or "midway"
    if args.json:
        content: dict[str, Any] = {"machine": geometry.name, "model": model.name, **common.frames(geometry)}
        content |= {"direction": direction} if args.model != "ideal" else {}
        common.show({**content, "rows": table})
        return
    if args.lengths is None:
        common.mention_default(args, geometry)
    if args.out is None and args.lengths is None:
        common.show(common.csv_text(table))
    elif args.out is None:
        header = list(table[0])[1:]
        title = f"{common.machine_title(geometry, model)}: pose of {common.whose(geometry)}"
        title += f", all axes and struts moved {direction}" if args.direction else ""
        common.show(f"{title}\n{texts.aligned(header, [[texts.number(table[0][name], 6) for name in header]])}")


def _solve(
    args: argparse.Namespace,
    geometry: HexapodGeometry,
    model: MachineModel,
    rows: list[Row],
    lengths: np.ndarray,
) -> list[Pose]:
    """Return the platform pose of every row; the first row without one is named."""
    import numpy as np

    from ..errors import KinematicsError
    from ..machine.assembly import working_mode
    from ..machine.kinematics import Structure, solve_pose, solve_poses
    from ..machine.model import DIRECTIONS, FOLLOWED, RealMachine
    from ..pose import Pose

    machine = RealMachine(geometry, model)
    commands = args.model != "ideal" or bool(geometry.screw_lead.any())  # rather than lengths
    structure = machine.structure if commands else Structure.of(geometry)
    guess, senses = _guess(args, geometry), np.full(FOLLOWED, DIRECTIONS[args.direction or "midway"])
    batch = None if args.cold else solve_poses(structure, lengths, guess)
    poses = []
    bar = common.progress_bar(len(rows), " rows")
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
    bar.close()
    return poses


def _guess(args: argparse.Namespace, geometry: HexapodGeometry) -> Pose:
    from ..pose import Pose

    if args.guess is None:
        return geometry.home
    return geometry.platform_pose(Pose.from_angles(*args.guess))


def _all_modes(args: argparse.Namespace, geometry: HexapodGeometry, lengths: np.ndarray) -> None:
    """Show every assembly mode, and say for each why it is, or is not, the working one."""
    from ..errors import KinematicsError, UnreachableError
    from ..formats.csv import pose_values
    from ..machine.assembly import assembly_modes, mode_objections, working_mode
    from ..machine.kinematics import Structure

    structure = Structure.of(geometry)
    modes = assembly_modes(structure, lengths)
    if not modes:
        raise UnreachableError("no pose of the machine has these strut lengths", 0)
    try:
        working, reason = working_mode(geometry, structure, lengths), ""
    except KinematicsError as error:
        working, reason = None, str(error)
    listed: list[dict[str, Any]] = []
    for index, mode in enumerate(modes, start=1):
        objections = mode_objections(geometry, structure, mode)
        is_working = working is not None and _same(mode, working)
        values = pose_values(geometry.tool_pose(mode))
        listed.append({"mode": index, **values, "working": is_working, "objections": objections})
    joined = [{**m, "working": int(m["working"]), "objections": "; ".join(m["objections"])} for m in listed]
    common.write_table(args, joined)
    if args.json:
        common.show({"machine": geometry.name, **common.frames(geometry), "modes": listed, "no_working_mode": reason})
    elif args.out is None:
        numbers = MODE_COLUMNS[1:7]
        body = [[str(m["mode"]), *(texts.number(m[name], 6) for name in numbers), _verdict(m)] for m in listed]
        lines = [
            f"machine {geometry.name}: {len(modes)} assembly modes, tool in work",
            texts.aligned(MODE_COLUMNS, body),
        ]
        common.show("\n".join(lines + [f"no working mode: {reason}"] * bool(reason)))


def _same(one: Pose, other: Pose) -> bool:
    import numpy as np

    return np.array_equal(one.position, other.position) and np.array_equal(one.rotation, other.rotation)


def _verdict(mode: dict[str, Any]) -> str:
    if mode["working"]:
        return "working mode"
    return "; ".join(mode["objections"]) or "possible, further from home"
