"""``hexapod_comp plan``: what a campaign will determine, before anyone measures."""

from __future__ import annotations

import argparse

from . import common
from .fit import fit_settings


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..calibration.plan import plan
    from ..calibration.report import plan_json, plan_report
    from ..machine.geometry import load_geometry
    from ..measurements.campaign import template

    geometry = load_geometry(args.machine)
    campaign = common.load_campaign(args, geometry)
    common.mention_compiling("model.actual_pose_one")
    with common.stage_line() as say:
        say("laying out the readings")
        measured = template(campaign, geometry, args.seed, args.campaign)
        say(f"what {len(measured)} readings determine")
        result = plan(measured, campaign, fit_settings(args))
    common.show(plan_json(result) if args.json else plan_report(result))
    return 0
