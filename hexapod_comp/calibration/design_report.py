"""What a proposed campaign, and what a calibration leaves, say: for people, as JSON and as CSV."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from ..machine.region import region_json, region_text
from ..measurements.readings import DEFAULT_UNCERTAINTY
from .design import Proposal
from .follow_up import Remaining, Share
from .report import stops_text


def proposal_report(plan: Proposal) -> str:
    """Return the report of a proposed plan: the goal, what may be expected, what limits it, the runs in their order."""
    expected = ["expected tool error at random points of the box, both directions, the datum aligned:"]
    for name, after in plan.expected.items():
        shown = "level tool: " if name == "level" else f"tilted {np.degrees(plan.goal.tilt):g}°:"
        before = plan.before[name]
        expected.append(f"  {shown}  {um(before)} → {um(after)} RMS, {100.0 * (1.0 - after / before):.1f} % less")
    expected.append(f"  {stops_text(plan.campaign.stops)}")
    rows = [
        [run.name, str(len(run.positions)), str(run.count(plan.campaign.cycles)), number(seconds / 60.0, 0), "min"]
        for run, seconds in zip(plan.campaign.runs, plan.each, strict=True)
    ]
    used = {run.instrument: plan.goal.times[run.instrument] for run in plan.campaign.runs}
    assumed = [
        f"  {name}: {t.first / 60.0:g} min to put it up, {t.run / 60.0:g} min a run, {t.stop:g} s a stop"
        for name, t in used.items()
    ]
    head = f"{plan.readings} readings in {plan.seconds / 3600.0:.2f} h, in measuring order, if"
    runs = "\n".join([head, *assumed, aligned(("run", "places", "readings", "takes", ""), rows)])
    name = f"machine {plan.space.geometry.name}: {_goal(plan)}"
    return "\n\n".join([name, "\n".join(expected), verdict(plan), runs]) + "\n"


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
    goal, named, stops = um(plan.goal.error), ", ".join(plan.goal.instruments), plan.campaign.stops
    if stops > plan.goal.error:
        beyond = f"its stops alone are {um(stops)} off, {um(stops - plan.goal.error)} more than the goal"
        limit = f"the machine's repeatability: {beyond}, and no model takes that away"
    elif plan.needed is not None:
        limit = f"time: {plan.needed / 3600.0:.1f} h would do"
    elif plan.unseen > plan.goal.error:
        left = f"{um(plan.unseen)} would be left by any number of readings of {named} in this box"
        limit = f"what these instruments do not see: {left}"
    elif plan.all_of_them > plan.goal.error:
        limit = f"the instruments' noise: all runs considered, once each, leave {um(plan.all_of_them)}"
    else:
        limit = f"time: many more runs would do; all considered leave {um(plan.all_of_them)}"
    least = 0.1  # blocks that make up less of what is left are not named
    blocks = [f"{name} {100.0 * share:.0f} %" for name, share in plan.shares.items() if share >= least]
    return "\n".join(
        [
            f"the goal is NOT met: {um(plan.worst)} can be had in {plan.goal.seconds / 3600.0:g} h, not {goal}",
            f"  what limits it is {limit}",
            f"  of what is left: {', '.join(blocks)}",
        ]
    )


def um(value: float) -> str:
    """Return a length in µm, three digits."""
    return f"{value * 1e6:#.3g} µm"


def _goal(plan: Proposal) -> str:
    goal = plan.goal
    tilt = f" with the tool level and tilted by {np.degrees(goal.tilt):g}°" if goal.tilt else ""
    return f"goal {um(goal.error)} RMS{tilt}, with {', '.join(goal.instruments)} in {goal.seconds / 3600.0:g} h"


def remaining_text(result: Remaining) -> str:
    """Return what a calibration leaves, for people."""
    geometry, model = result.machine.geometry, result.machine.model
    head = (
        f"machine {geometry.name}, model {model.name!r}: what is left of the tool's error after compensation, by the "
        f"covariance of the fit's {result.parameters} parameters.\n{region_text(model.measured, geometry)}\nThe datum "
        "is aligned over that box. Where nothing was measured, only what the fit's parameters describe counts."
    )
    titles = ["where", "poses", "RMS µm", "worst pose µm", "there, tool in work: x, y, z mm"]
    titles += ["95 % of machines below µm", "rotation µrad", "datum as it stands, RMS µm"]
    rows = []
    for part in result.left:
        sizes = [number(v * 1e6, 2) for v in (part.rms[0], part.worst, part.most, part.rms[1], part.standing)]
        place = ", ".join(number(v * 1e3, 1) for v in part.at)
        rows.append((part.where, str(part.poses), *sizes[:2], place, *sizes[2:]))
    noise = ", ".join(f"{name} {value * 1e6:g}" for name, value in DEFAULT_UNCERTAINTY.items())

    def shares(given: Iterable[Share], counted: str) -> str:
        now, table = np.array([part.rms[0] for part in result.left]), []
        for share in given:
            less = 100.0 * (1.0 - share.left / now)
            pairs = ((number(v * 1e6, 2), f"{r:.0f} % less") for v, r in zip(share.left, less, strict=True))
            table.append((share.name, str(share.count), *(cell for pair in pairs for cell in pair)))
        return aligned(("", counted, *(title for part in result.left for title in (part.where, ""))), table)

    return "\n\n".join(
        (
            head,
            aligned(titles, rows),
            "if these parameters were known exactly, RMS µm\n" + shares(result.blocks, "parameters"),
            f"with one more measurement in the measured box (noise, µm and µrad: {noise}), RMS µm\n"
            + shares(result.measurements, "readings"),
        )
    )


def measurement_rows(result: Remaining) -> list[dict[str, Any]]:
    """Return the measurements for CSV: a record each, µm."""
    return [
        {"rank": rank, "measurement": share.name, "readings": share.count}
        | {f"left_{key}_um": float(value) * 1e6 for key, value in zip(("box", "workspace"), share.left, strict=True)}
        for rank, share in enumerate(result.measurements, start=1)
    ]


def remaining_json(result: Remaining) -> dict[str, Any]:
    """Return what a calibration leaves as plain numbers; units are in the keys."""

    def shares(given: Iterable[Share], counted: str) -> list[dict[str, Any]]:
        return [
            {"name": s.name, counted: s.count, "left_box_m": s.left[0], "left_workspace_m": s.left[1]} for s in given
        ]

    return {
        "machine": result.machine.geometry.name,
        "model": result.machine.model.name,
        "parameters": result.parameters,
        "frame": "work",
        "measured_box": region_json(result.machine.model.measured, result.machine.geometry),
        "left": [
            {
                "where": part.where,
                "poses": part.poses,
                "rms_m": part.rms[0],
                "rms_rotation_rad": part.rms[1],
                "worst_m": part.worst,
                "worst_at_m": part.at,
                "machines_95_m": part.most,
                "rms_datum_as_it_stands_m": part.standing,
            }
            for part in result.left
        ],
        "if_known": shares(result.blocks, "parameters"),
        "if_measured": shares(result.measurements, "readings"),
    }
