"""A machine that calibrates itself: ``adapt``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputFileError
from ..formats.texts import number
from ..machine.geometry import load_geometry
from . import results
from .app import INTERRUPTED
from .fitting import fit_settings
from .results import Result


def adapt(args: argparse.Namespace) -> Result:
    """Calibrate a running machine, or check the model that came of it; 0 when a model is borne out by its checks."""
    from ..ros import keep_discovery_local, received_signals
    from ..ros.adapting import AdaptedMachine
    from ..upkeep.loop import IN_USE, Adaptation, Task, begun_with
    from ..workspace.reach import machine_box

    geometry, campaign = load_geometry(args.machine), None
    begun = {} if args.anew else begun_with(args.folder)
    if args.verify and not begun:
        raise InputFileError(args.folder, "", "has no journal of a calibration: calibrate first")
    if args.campaign is not None:
        campaign = results.load_campaign(args, geometry)
        box, level = campaign.box, campaign.level
    else:
        box, level, _ = machine_box(geometry)
        box, level = np.array(begun.get("box_m", box)), np.array(begun.get("level", level))
        if args.box is not None:
            box = np.array(args.box)
    instruments = ("6-D",) if args.instruments is None else tuple(args.instruments.split(","))
    goal = None if args.goal_um is None else args.goal_um * 1e-6
    if goal is None and campaign is None:
        goal = begun.get("goal_m")
    hours = 4.0 if args.hours is None else args.hours
    every = 600.0 if args.every_min is None else 60.0 * args.every_min
    checks = None if args.checks is None and args.every_min is not None else args.checks or 0
    task = Task(box, level, goal, campaign, instruments, 3600.0 * hours, fit_settings(args), every)
    keep_discovery_local()
    signals = received_signals()

    def going_on() -> bool:
        return not signals

    with (
        AdaptedMachine(args.topic, args.namespace, samples=args.samples, going_on=going_on) as machine,
        results.stage_line() as say,
    ):
        if args.reload:
            machine.refuse_unreadable(Path(args.folder, IN_USE))
        reload = machine.reload if args.reload else None
        loop = Adaptation(geometry, machine, task, args.folder, reload, going_on, say, runs=machine.runs)
        if args.verify:
            outcome = loop.guard(1)
        else:
            outcome = loop.calibrate(args.anew)
            if outcome.good and checks != 0:
                outcome = loop.guard(checks)
    return Result(
        lambda: "\n".join([*told(loop.events), f"{outcome.state}: {outcome.text}"]),
        lambda: {
            "machine": geometry.name,
            "state": outcome.state,
            "text": outcome.text,
            "model": outcome.model,
            "promised_m": None if np.isnan(loop.state.kept) else loop.state.kept,
            "events": loop.events,
        },
        code=INTERRUPTED if outcome.state == "stopped" else 0 if outcome.good else 1,
    )


def told(events: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a line for each event of a journal."""

    from ..upkeep.loop import moved_text

    def um(value: float | None) -> str:
        return "–" if value is None else f"{number(value * 1e6, 2)} µm"

    for e in events:
        match e["event"]:
            case "planned":
                text = "campaign: as given" if e["expected_m"] is None else f"campaign: {e['campaign']}"
                text += "" if e["expected_m"] is None else f", {um(e['expected_m'])} RMS to expect"
            case "collected":
                lost = f", nothing read at {len(e['missing'])} stops" if e["missing"] else ""
                text = f"{e['count']} readings: {e['readings']}{lost}"
            case "fitted":
                promised = f"{e['model']}, up to {um(e['promised_m'])} RMS (95 %)"
                text = promised if e["enough"] else f"not enough: {e['short']}"
            case "checked":
                found = f"shows {um(e['found_m'])}, {um(e['promised_m'])} promised"
                text = f"{e['readings']} {found}; {'borne out' if e['good'] else e['text']}{moved_text(e)}"
            case "repaired":
                text = f"{e['text']}; {e['model']} renews {e['of']}"
            case "begun" | "adopted" | "reloaded":
                text = e.get("model", "")
            case _:
                text = e.get("reason") or e.get("at") or ""
        yield f"{e['time']}  {e['event']:<13} {text}".rstrip()
