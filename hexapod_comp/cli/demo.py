"""``hexapod_comp demo``: the whole loop on the paper's machine, with a verdict in the exit code."""

from __future__ import annotations

import argparse

HELP = "show the loop: Table 1 of the paper and a milling path through two real nodes"

EXAMPLE = """example:
  hexapod_comp demo
  hexapod_comp demo --model paper_lines_model.yaml     (the paper's own 1-D scheme: exits 1, doc/demo.md says why)

Exits 0 only when no command was lost or refused, both nodes ended well, and compensation reduced the error;
with the simulated machine's true model to at most 1 µm at rest and 0.5 µm RMS (10 µm in passing) on the path."""


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Add the verb."""
    from .run import add_loop_options

    parser = subparsers.add_parser(
        "demo", help=HELP, description=HELP, epilog=EXAMPLE, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_loop_options(parser)
    parser.add_argument("--plot", metavar="PNG", default="out/demo.png", help="picture (default out/demo.png)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..formats.csv import read_poses
    from ..formats.figures import save
    from ..loop import run as loop
    from ..loop.pictures import session_figure
    from ..loop.report import pose_block, summary
    from ..machine.geometry import load_geometry

    rate = loop.checked_rate(args.rate_hz)
    geometry = load_geometry(args.machine)
    rows, poses = read_poses("table1.csv")
    path = loop.demo_path(geometry, rate)
    with loop.simulated(geometry, args.machine, args.model, args.truth) as nodes:
        result = loop.witnessed(geometry, nodes, poses, path, rate, compare=True)
    for row, record in zip(rows, result.poses, strict=True):
        print(pose_block(f"Table 1, pose {row.label}", record))
    print(summary(result))
    save(session_figure(result, f"{geometry.name}: Table 1 and a milled pocket, model {result.model}"), args.plot)
    print(f"picture: {args.plot}")
    complaints = loop.complaints(result, loop.Bars() if args.model == args.truth else None)
    for complaint in complaints:
        print(f"NOT AS IT SHOULD BE: {complaint}")
    if not complaints:
        print("all as it should be")
    return 1 if complaints else 0
