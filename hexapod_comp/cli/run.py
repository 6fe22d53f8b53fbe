"""``hexapod_comp run``: send the poses of a file through the running loop and say what came of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from . import common

if TYPE_CHECKING:
    from ..formats.csv import Row
    from ..loop.records import SessionResult


def run(args: argparse.Namespace) -> int:
    """Run the verb; 0 when every command was answered."""
    from contextlib import nullcontext

    from ..formats.csv import read_poses
    from ..loop import run as loop
    from ..machine.geometry import load_geometry

    rate = loop.checked_rate(args.rate_hz)
    geometry = load_geometry(args.machine)
    rows, poses = read_poses(args.poses)
    loop.refuse_broken_limits(args.poses, geometry, "ideal" if args.attach else args.model, rows, poses)
    started = nullcontext(()) if args.attach else loop.simulated(geometry, args.machine, args.model, args.truth)
    compare = not (args.attach or args.no_compare)  # nobody switches a real machine's compensation off in passing
    with started as nodes:
        result = loop.witnessed(geometry, nodes, poses, None, rate, compare, args.namespace)
    if not args.json:
        show(rows, result, "pose")
    draw(args, result, f"{geometry.name}: {args.poses}")
    if args.json:
        common.show(loop.as_json(rows, result))
    return 0 if result.lost == 0 and result.refused == 0 else 1


def show(rows: Sequence[Row], result: SessionResult, name: str) -> None:
    """Print every pose, under a name and its label, and the summary."""
    from ..loop.report import pose_block, summary

    for row, record in zip(rows, result.poses, strict=True):
        print(pose_block(f"{name} {row.label}", record))
    print(summary(result))


def draw(args: argparse.Namespace, result: SessionResult, title: str) -> None:
    """Draw the session into the folder of ``--pictures``, under the verb's name."""
    from ..loop.pictures import session_figure

    common.save_pictures(args, lambda: {f"{args.verb}.png": session_figure(result, f"{title}, model {result.model}")})
