"""``hexapod_comp run``: send the poses of a file through the running loop and say what came of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING

from ..formats.csv import read_poses
from ..loop import report, session
from ..loop.report import ErrorRow, SessionResult, busy_text, error_rows, pose_block, summary
from ..loop.story import Calibration
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from ..virtual.named import find_model, truth_name
from . import common

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRUE = "truth"  # the model that is no file: the machine's own errors


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb; 0 when every command was answered."""
    rate = session.checked_rate(args.rate_hz)
    geometry = load_geometry(args.machine)
    truth = hidden_errors(args, geometry)
    model = MachineModel(geometry.name) if args.attach else chosen_model(args, geometry, truth)
    rows, poses = read_poses(args.poses)
    session.refuse_broken_limits(args.poses, geometry, model, rows, poses)
    started = nullcontext(()) if args.attach else session.simulated(args.machine, model, truth)
    compare = not (args.attach or args.no_compare)  # nobody switches a real machine's compensation off in passing
    with common.ended_in_order(), started as nodes:
        result = session.witnessed(geometry, nodes, poses, None, rate, compare, args.namespace)
    errors, unanswered = error_rows(result), result.lost + result.refused
    blocks = [pose_block(f"pose {row.label}", record) for row, record in zip(rows, result.poses, strict=True)]
    if unanswered and result.answering.busy:
        common.say_notes([busy_text(result.answering)])
    return common.Result(
        lambda: "\n".join([*blocks, summary(result, errors)]),
        lambda: report.as_json(rows, result, errors),
        pictures=lambda: drawn(args, result, errors, f"{geometry.name}: {args.poses}"),
        code=1 if unanswered else 0,
    )


def hidden_errors(args: argparse.Namespace, geometry: HexapodGeometry) -> MachineModel:
    """Return the machine's hidden errors, and leave the name that they go by in the options."""
    args.truth = truth_name(args.truth, geometry)
    return find_model(args.truth, geometry)


def chosen_model(args: argparse.Namespace, geometry: HexapodGeometry, truth: MachineModel) -> MachineModel:
    """Return the model that the compensator runs."""
    return truth if args.model == TRUE else find_model(args.model, geometry)


def drawn(
    args: argparse.Namespace,
    result: SessionResult,
    rows: Sequence[ErrorRow],
    title: str,
    calibration: Calibration | None = None,
) -> dict[str, Figure]:
    """Return the picture of the session, under the verb's name."""
    from ..loop.pictures import session_figure

    return {f"{args.verb}.png": session_figure(result, rows, f"{title}, model {result.model}", calibration)}
