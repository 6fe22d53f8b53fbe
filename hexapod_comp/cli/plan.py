"""``hexapod_comp plan``: what a campaign will determine, or which one a goal needs, before anyone measures."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ..calibration.candidates import MeasuringBox
from ..calibration.design import TIMES, Goal, Times, plan, propose
from ..calibration.design_report import proposal_json, proposal_report, remarks
from ..calibration.report import plan_json, plan_report
from ..compensation.checks import check
from ..errors import CalibrationError
from ..formats.outputs import write_text
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from ..measurements.campaign import Campaign, campaign_text, template
from . import common
from .fit import fit_settings


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb; 1 when a goal cannot be met."""
    geometry = load_geometry(args.machine)
    campaign = common.load_campaign(args, geometry)
    if args.repeatability_um is not None:
        campaign = replace(campaign, repeatability=args.repeatability_um * 1e-6)
    return _judge(args, geometry, campaign) if args.goal_um is None else _propose(args, geometry, campaign)


def _judge(args: argparse.Namespace, geometry: HexapodGeometry, campaign: Campaign) -> common.Result:
    """Say what a campaign determines."""
    with common.stage_line() as say:
        say("laying out the readings")
        measured = template(campaign, geometry, args.seed, args.campaign)
        say(f"what {len(measured)} readings determine")
        result = plan(measured, campaign, fit_settings(args))
    return common.Result(lambda: plan_report(result), lambda: plan_json(result))


def _propose(args: argparse.Namespace, geometry: HexapodGeometry, base: Campaign) -> common.Result:
    """Propose a campaign for a goal; 1 when it is not met."""
    goal = _goal(args)
    place = MeasuringBox(geometry, base.box, base.level, goal.tilt)
    with common.stage_line() as say:
        result = propose(place, goal, fit_settings(args), base, say)
    common.say_notes(_detours(geometry, result.campaign))
    if args.out is not None:
        write_text(args.out, campaign_text(result.campaign, remarks(result)))
    return common.Result(
        lambda: proposal_report(result) + (f"\ncampaign: {args.out}\n" if args.out else ""),
        lambda: {**proposal_json(result), "written": args.out},
        code=0 if result.met else 1,
    )


def _goal(args: argparse.Namespace) -> Goal:
    """Return the goal that the options name."""
    times = dict(TIMES)
    for name, numbers in args.time or ():
        if name not in times:
            raise CalibrationError("--time", f"is of one of {', '.join(times)}, not {name}")
        times[name] = Times(*numbers)
    given: dict[str, Any] = {"instruments": tuple(args.instruments.split(","))} if args.instruments is not None else {}
    if args.hours is not None:
        given["seconds"] = args.hours * 3600.0
    return Goal(args.goal_um * 1e-6, float(np.radians(args.tilt_deg or 0.0)), times=times, **given)


def _detours(geometry: HexapodGeometry, campaign: Campaign) -> Iterator[str]:
    """Yield between which runs the machine cannot move straight, as ``check`` sees it."""
    ends = [
        (run, slice(None, None, max(1, len(run.positions) - 1)) if run.is_line else slice(None))
        for run in campaign.runs
    ]
    names = [run.name for run, part in ends for _ in run.positions[part]]
    positions, rotations = (
        np.concatenate([getattr(run, what)[part] for run, part in ends]) for what in ("positions", "rotations")
    )
    result = check(geometry, MachineModel(geometry.name), (positions, rotations))
    for row in sorted({breach.row for breach in result.breaches}):
        error = next(breach.error for breach in result.breaches if breach.row == row)
        yield f"no straight way from {names[max(row - 1, 0)]} to {names[row]}: go by home ({error})"
