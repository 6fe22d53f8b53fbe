"""``hexapod_comp show``: a machine at a glance, and what looks wrong in its file."""

from __future__ import annotations

import argparse

from ..machine.geometry import load_geometry
from ..workspace.overview import as_json, overview, report
from . import common


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    from ..workspace.pictures import overview_figure

    geometry = load_geometry(args.machine)
    with common.stage_line() as say:
        say("reach and largest box")
        seen = overview(geometry)
    return common.Result(
        lambda: report(seen), lambda: as_json(seen), pictures=lambda: {"machine.png": overview_figure(seen)}
    )
