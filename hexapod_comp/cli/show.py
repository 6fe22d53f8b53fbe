"""``hexapod_comp show``: a machine at a glance, and what looks wrong in its file."""

from __future__ import annotations

import argparse

from ..machine.geometry import load_geometry
from ..workspace.overview import as_json, overview, report
from . import common


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..workspace.pictures import overview_figure

    geometry = load_geometry(args.machine)
    with common.stage_line() as say:
        say("reach and largest box")
        seen = overview(geometry)
    common.show(as_json(seen) if args.json else report(seen))
    common.save_pictures(args, lambda: {"machine.png": overview_figure(seen)})
    return 0
