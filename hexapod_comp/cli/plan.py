"""``hexapod_comp plan``: what a campaign will determine, or which one a goal needs, before anyone measures."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from . import common
from .fit import fit_settings

if TYPE_CHECKING:
    from ..calibration.design import Goal
    from ..machine.geometry import HexapodGeometry
    from ..measurements.campaign import Campaign

OF_A_GOAL = ("tilt_deg", "instruments", "hours", "time", "out")
"""Options that mean nothing without ``--goal-um``."""


def run(args: argparse.Namespace) -> int:
    """Run the verb; 1 when a goal cannot be met."""
    from ..errors import CalibrationError
    from ..machine.geometry import load_geometry

    geometry = load_geometry(args.machine)
    if args.goal_um is not None:
        return _propose(args, geometry)
    for name in OF_A_GOAL:
        if getattr(args, name) is not None:
            raise CalibrationError(f"--{name.replace('_', '-')}", "needs a goal: --goal-um")
    if args.campaign is None:
        raise CalibrationError("plan", "needs a campaign to be judged, or --goal-um to propose one")
    return _judge(args, geometry)


def _judge(args: argparse.Namespace, geometry: HexapodGeometry) -> int:
    """Say what a campaign determines."""
    from ..calibration.design import plan
    from ..calibration.report import plan_json, plan_report
    from ..measurements.campaign import template

    campaign = _campaign(args, geometry)
    with common.stage_line() as say:
        say("laying out the readings")
        measured = template(campaign, geometry, args.seed, args.campaign)
        say(f"what {len(measured)} readings determine")
        result = plan(measured, campaign, fit_settings(args))
    common.show(plan_json(result) if args.json else plan_report(result))
    return 0


def _propose(args: argparse.Namespace, geometry: HexapodGeometry) -> int:
    """Propose a campaign for a goal; 1 when it is not met."""
    from ..calibration.candidates import MeasuringBox
    from ..calibration.design import propose
    from ..calibration.design_report import proposal_json, proposal_report, remarks
    from ..formats.outputs import write_text
    from ..measurements.campaign import campaign_text

    goal = _goal(args)
    base = _campaign(args, geometry)
    place = MeasuringBox(geometry, base.box, base.level, goal.tilt)
    with common.stage_line() as say:
        result = propose(place, goal, fit_settings(args), base, say)
    common.say_notes(_detours(geometry, result.campaign))
    if args.out is not None:
        write_text(args.out, campaign_text(result.campaign, remarks(result)))
    if args.json:
        common.show({**proposal_json(result), "written": args.out})
    else:
        common.show(proposal_report(result) + (f"\ncampaign: {args.out}\n" if args.out else ""))
    return 0 if result.met else 1


def _campaign(args: argparse.Namespace, geometry: HexapodGeometry) -> Campaign:
    """Return the campaign that the options name, with the repeatability that they state."""
    from dataclasses import replace

    campaign = common.load_campaign(args, geometry)
    if args.repeatability_um is None:
        return campaign
    return replace(campaign, repeatability=args.repeatability_um * 1e-6)


def _goal(args: argparse.Namespace) -> Goal:
    """Return the goal that the options name."""
    import numpy as np

    from ..calibration.design import TIMES, Goal, Times
    from ..errors import CalibrationError

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
    import numpy as np

    from ..compensation.checks import check
    from ..machine.model import MachineModel

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
