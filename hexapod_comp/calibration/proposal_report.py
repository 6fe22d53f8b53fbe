"""What a proposed plan says: the goal, what may be expected, what limits it, and the runs in measuring order."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from .proposal import Proposal
from .report import stops_text

MAIN = 0.1
"""Blocks that make up less than this share of what is left are not named."""


def proposal_report(plan: Proposal) -> str:
    """Return the report of a proposed plan."""
    tables = [_expected(plan), verdict(plan), _runs(plan)]
    return "\n\n".join([f"machine {plan.space.geometry.name}: {_goal(plan)}", *tables]) + "\n"


def proposal_json(plan: Proposal) -> dict[str, Any]:
    """Return a proposed plan as plain numbers; units are in the keys."""
    goal = plan.goal
    return {
        "machine": plan.space.geometry.name,
        "goal_m": goal.error,
        "tilt_rad": goal.tilt,
        "instruments": goal.instruments,
        "allowed_s": goal.seconds,
        "met": plan.met,
        "verdict": verdict(plan),
        "before_m": plan.before,
        "expected_m": plan.expected,
        "takes_s": plan.seconds,
        "needed_s": plan.needed,
        "all_candidates_m": plan.all_of_them,
        "unseen_m": plan.unseen,
        "repeatability_m": plan.campaign.stops,
        "shares": plan.shares,
        "readings": plan.readings,
        "runs": [
            {**run.content(), "takes_s": seconds} for run, seconds in zip(plan.campaign.runs, plan.each, strict=True)
        ],
    }


def remarks(plan: Proposal) -> list[str]:
    """Return what stands on top of the campaign's file."""
    return [
        f"Proposed for machine {plan.space.geometry.name}: {_goal(plan)}.",
        f"Expected: {', '.join(f'{name} {um(value)}' for name, value in plan.expected.items())} RMS, datum aligned.",
        f"{plan.readings} readings in {plan.seconds / 3600.0:.1f} h, in this order.",
    ]


def verdict(plan: Proposal) -> str:
    """Say whether the goal is met and, where it is not, what limits it."""
    if plan.met:
        return f"the goal is met: {um(plan.worst)} in {plan.seconds / 3600.0:.1f} h"
    goal, named = um(plan.goal.error), ", ".join(plan.goal.instruments)
    lines = [f"the goal is NOT met: {um(plan.worst)} can be had in {plan.goal.seconds / 3600.0:g} h, not {goal}"]
    stops = plan.campaign.stops
    if stops > plan.goal.error:
        what = f"its stops alone are {um(stops)} off, {um(stops - plan.goal.error)} more than the goal"
        lines.append(f"  what limits it is the machine's repeatability: {what}, and no model takes that away")
    elif plan.needed is not None:
        lines.append(f"  what limits it is time: {plan.needed / 3600.0:.1f} h would do")
    elif plan.unseen > plan.goal.error:
        what = f"{um(plan.unseen)} would be left by any number of readings of {named} in this box"
        lines.append(f"  what limits it is what these instruments do not see: {what}")
    elif plan.all_of_them > plan.goal.error:
        what = f"all runs considered, once each, leave {um(plan.all_of_them)}"
        lines.append(f"  what limits it is the instruments' noise: {what}")
    else:
        lines.append(f"  what limits it is time: many more runs would do; all considered leave {um(plan.all_of_them)}")
    blocks = [f"{name} {100.0 * share:.0f} %" for name, share in plan.shares.items() if share >= MAIN]
    lines.append(f"  of what is left: {', '.join(blocks)}")
    return "\n".join(lines)


def um(value: float) -> str:
    """Return a length in µm, three digits."""
    return f"{value * 1e6:#.3g} µm"


def _goal(plan: Proposal) -> str:
    goal = plan.goal
    tilt = f" with the tool level and tilted by {np.degrees(goal.tilt):g}°" if goal.tilt else ""
    return f"goal {um(goal.error)} RMS{tilt}, with {', '.join(goal.instruments)} in {goal.seconds / 3600.0:g} h"


def _expected(plan: Proposal) -> str:
    lines = ["expected tool error at random points of the box, both directions, the datum aligned:"]
    for name, after in plan.expected.items():
        shown = "level tool: " if name == "level" else f"tilted {np.degrees(plan.goal.tilt):g}°:"
        before = plan.before[name]
        lines.append(f"  {shown}  {um(before)} → {um(after)} RMS, {100.0 * (1.0 - after / before):.1f} % less")
    lines.append(f"  {stops_text(plan.campaign.stops)}")
    return "\n".join(lines)


def _runs(plan: Proposal) -> str:
    rows = [
        [run.name, str(len(run.positions)), str(run.count(plan.campaign.cycles)), number(seconds / 60.0, 0), "min"]
        for run, seconds in zip(plan.campaign.runs, plan.each, strict=True)
    ]
    times = {run.instrument: plan.goal.times[run.instrument] for run in plan.campaign.runs}
    assumed = [
        f"  {name}: {t.first / 60.0:g} min to put it up, {t.run / 60.0:g} min a run, {t.stop:g} s a stop"
        for name, t in times.items()
    ]
    head = f"{plan.readings} readings in {plan.seconds / 3600.0:.2f} h, in measuring order, if"
    return "\n".join([head, *assumed, aligned(("run", "places", "readings", "takes", ""), rows)])
