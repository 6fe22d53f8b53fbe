"""``hexapod_comp run``: send the poses of a file through the running loop and say what came of them."""

from __future__ import annotations

import argparse

from . import common

HELP = "send poses through the loop: two simulated nodes, or your own with --attach"

EXAMPLE = """example:
  hexapod_comp run config/table1.csv --plot out/run.png
  hexapod_comp run poses.csv --attach --rate-hz 100     (nodes already running in this ROS domain)

The tool moves from pose to pose within the machine's limits, rests at each, and its error is taken from
tool_pose_true. Columns of the file: x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg (or qx, qy, qz, qw). The file's
poses and those of the report are the tool's in the work frame."""


def add_parser(subparsers: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "run", help=HELP, description=HELP, epilog=EXAMPLE, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("poses", help="CSV file of poses")
    add_loop_options(parser)
    parser.add_argument("--attach", action="store_true", help="use nodes that already run; one pass, as they are")
    parser.add_argument("--namespace", default="", help="namespace of those nodes")
    parser.add_argument("--no-compare", action="store_true", help="leave out the simulated pass without compensation")
    parser.add_argument("--plot", metavar="PNG", help="write a picture")
    parser.add_argument("--json", action="store_true", help="print results as JSON")
    parser.set_defaults(run=run)


def add_loop_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that ``run`` and ``demo`` share."""
    parser.add_argument("--machine", default="paper.yaml", help="geometry file or shipped name (default paper.yaml)")
    parser.add_argument(
        "--model",
        default="paper_machine.yaml",
        help="model that the compensator runs: file, shipped name or ideal (default paper_machine.yaml)",
    )
    parser.add_argument(
        "--truth",
        default="paper_machine.yaml",
        help="hidden truth of the simulated machine: model file, shipped name, ideal or random",
    )
    parser.add_argument("--rate-hz", type=float, default=250.0, help="commands per second (default 250)")


def run(args: argparse.Namespace) -> int:
    """Run the verb; 0 when every command was answered."""
    from contextlib import nullcontext

    from ..formats.csv import read_poses
    from ..formats.figures import save
    from ..loop import run as loop
    from ..loop.pictures import session_figure
    from ..loop.report import pose_block, summary
    from ..machine.geometry import load_geometry

    rate = loop.checked_rate(args.rate_hz)
    geometry = load_geometry(args.machine)
    rows, poses = read_poses(args.poses)
    loop.refuse_broken_limits(args.poses, geometry, "ideal" if args.attach else args.model, rows, poses)
    started = nullcontext(()) if args.attach else loop.simulated(geometry, args.machine, args.model, args.truth)
    compare = not (args.attach or args.no_compare)  # nobody switches a real machine's compensation off in passing
    with started as nodes:
        result = loop.witnessed(geometry, nodes, poses, None, rate, compare, args.namespace)
    if args.json:
        common.emit(common.json_text(loop.as_json(rows, result)), None)
    else:
        for row, record in zip(rows, result.poses, strict=True):
            print(pose_block(f"pose {row.label}", record))
        print(summary(result))
    if args.plot:
        save(session_figure(result, f"{geometry.name}: {args.poses}, model {result.model}"), args.plot)
    return 0 if result.lost == 0 and result.refused == 0 else 1
