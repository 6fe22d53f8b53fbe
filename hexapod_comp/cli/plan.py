"""``hexapod_comp plan``: what a campaign will determine, before anyone measures."""

from __future__ import annotations

import argparse

from . import common
from .fit import add_fit_options, fit_settings

SUMMARY = "what a measuring campaign will determine, and what it will not"

TEXT = """Takes a campaign file and says without a single reading which parameters the campaign would determine, which
it leaves open, and what tool error a joint fit may be expected to leave on a machine within the tolerances.

example:
  $ hexapod_comp plan campaign_1d --lead-mm 10 --blocks pitch,wave,backlash"""


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "plan", run, SUMMARY, TEXT)
    parser.add_argument("campaign", metavar="CAMPAIGN", help="campaign file, or the name of a shipped one")
    common.add_machine_options(parser, with_model=False)
    add_fit_options(parser)
    parser.add_argument("--seed", type=common.seed, default=0, metavar="N", help="of scattered poses (default 0)")
    parser.add_argument("--json", action="store_true", help="JSON, for programs; SI")


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..calibration.plan import plan
    from ..calibration.report import plan_json, plan_report
    from ..machine.geometry import load_geometry
    from ..measurements.campaign import load_campaign, template

    geometry = load_geometry(args.machine)
    campaign = load_campaign(args.campaign)
    common.mention_compiling("model.actual_pose_one")
    result = plan(template(campaign, geometry, args.seed, args.campaign), campaign, fit_settings(args))
    common.emit(common.json_text(plan_json(result)) if args.json else plan_report(result), None)
    return 0
