"""``hexapod_comp travel``: how far the tool may go from a pose."""

from __future__ import annotations

import argparse
from typing import Any

from ..compensation.travel import Travel, travel, travel_text
from ..machine.geometry import pose_text
from ..machine.model import RealMachine
from ..pose import Pose
from . import common


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    geometry, model = common.load_machine(args)
    if args.pose is None:
        pose = geometry.tool_pose(geometry.home)
    else:
        _, positions, rotations = common.one_row(args.pose)
        pose = Pose(positions[0], rotations[0])
    ways = travel(RealMachine(geometry, model), pose)
    title = f"{common.machine_title(geometry, model)}: how far {common.whose(geometry)} may go"
    machine = {"machine": geometry.name, "model": model.name, **common.frames(geometry)}
    return common.Result(
        lambda: f"{title} from {pose_text(pose)}\n{travel_text(ways)}",
        lambda: {**machine, "pose": pose, "travel": [_as_json(way) for way in ways]},
    )


def _as_json(way: Travel) -> dict[str, Any]:
    limit, problem = (None, None) if way.error is None else (way.error.reason, str(way.error))
    return {"way": way.way, "unit": way.unit, "travel": way.shown, "limit": limit, "problem": problem}
