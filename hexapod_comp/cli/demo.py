"""``hexapod_comp demo``: the whole loop on the paper's machine, with a verdict in the exit code."""

from __future__ import annotations

import argparse

from . import common
from .run import draw, show


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..formats.csv import read_poses
    from ..loop import run as loop
    from ..machine.geometry import load_geometry

    rate = loop.checked_rate(args.rate_hz)
    geometry = load_geometry(args.machine)
    rows, poses = read_poses("table1.csv")
    path = loop.demo_path(geometry, rate)
    with loop.simulated(geometry, args.machine, args.model, args.truth) as nodes:
        result = loop.witnessed(geometry, nodes, poses, path, rate, compare=True)
    if not args.json:
        show(rows, result, "Table 1, pose")
    draw(args, result, f"{geometry.name}: Table 1 and a milled pocket")
    complaints = loop.complaints(result, loop.Bars() if args.model == args.truth else None)
    if args.json:
        common.show({**loop.as_json(rows, result), "complaints": complaints})
    else:
        print("\n".join(f"NOT AS IT SHOULD BE: {complaint}" for complaint in complaints) or "all as it should be")
    return 1 if complaints else 0
