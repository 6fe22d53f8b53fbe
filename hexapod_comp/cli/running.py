"""The verbs ``run``, ``demo``, ``adapt``, ``move``, ``watch``, ``echo``, ``record`` and ``replay``."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import GeometryError, InputFileError
from ..formats.json import json_text
from ..formats.paths import input_file
from ..formats.texts import number
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from ..machine.pose_files import read_poses
from ..virtual.named import find_model, is_random, is_word, truth_name
from . import results
from .app import INTERRUPTED
from .results import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..ros.echo import EchoedMessage

TRUTH = "truth"  # Value of --model for a model with exactly the errors of the simulated machine
HZ_PERIOD = 1.0  # Time between two lines of echo --hz, s


def run(args: argparse.Namespace) -> Result:
    from ..loop import report, session

    low, high = session.RATES
    if not low <= args.rate_hz <= high:
        raise GeometryError("--rate-hz", f"must lie in {low:g}…{high:g} Hz", args.rate_hz)
    geometry = load_geometry(args.machine)
    truth = _hidden_errors(args, geometry)
    if args.attach:
        model = MachineModel(geometry.name)
    else:
        model = truth if args.model == TRUTH else find_model(args.model, geometry)
    rows, poses = read_poses(args.poses)
    session.refuse_broken_limits(args.poses, geometry, model, rows, poses)
    started = nullcontext(()) if args.attach else session.simulated(args.machine, model, truth)
    compare = not args.attach  # since a real machine must not move without compensation
    with results.exit_on_signals(), started as nodes:
        result = session.run_poses(geometry, nodes, poses, args.rate_hz, compare, args.namespace)
    errors, unanswered = result.errors(), result.lost + result.refused

    def pictures() -> dict[str, Figure]:
        from ..loop.pictures import session_figure

        return {"run.png": session_figure(result, f"{geometry.name}: {args.poses}, model {result.model}")}

    blocks = [report.pose_block(f"pose {row.label}", record) for row, record in zip(rows, result.poses, strict=True)]
    return Result(
        lambda: "\n".join([*blocks, report.summary(result, errors)]),
        lambda: report.as_json(rows, result, errors),
        pictures=pictures,
        code=1 if unanswered else 0,
        notes=filter(None, [result.busy]) if unanswered else (),
    )


def _hidden_errors(args: argparse.Namespace, geometry: HexapodGeometry) -> MachineModel:
    """Return the virtual machine's errors, and store the name of the errors' file in ``args.truth``."""
    args.truth = truth_name(args.truth, geometry)
    return find_model(args.truth, geometry)


def demo(args: argparse.Namespace) -> Result:
    """Run the demonstration on a virtual machine; exit code 1: the demonstration FAILED."""
    from ..loop import story

    geometry = load_geometry(args.machine)
    truth = _hidden_errors(args, geometry)
    with results.stage_line() as say:
        outcome = story.demonstrate(geometry, truth, args.seed, say)
    title = f"{geometry.name}, hidden errors {args.truth}, calibrates itself"

    def pictures() -> dict[str, Figure]:
        from ..loop.pictures import story_figure

        return {"demo.png": story_figure(outcome, title)}

    return Result(
        lambda: "\n".join([f"machine {title}", *journal_lines(outcome.events), "", outcome.text()]),
        lambda: {"machine": geometry.name, "truth": args.truth, **outcome.as_json()},
        pictures=pictures,
        code=1 if outcome.complaints else 0,
    )


def adapt(args: argparse.Namespace) -> Result:
    """Calibrate a running machine, and check or repair its model; exit code 1: no check confirmed a model."""
    from ..formats.adapt_journal import IN_USE, sole_user
    from ..ros import received_signals
    from ..ros.collector import AdaptedMachine
    from ..upkeep.loop import Adaptation, Task, begun_with
    from ..workspace.reach import machine_box
    from .fitting import fit_settings

    geometry, campaign = load_geometry(args.machine), None
    begun = {} if args.anew else begun_with(args.folder)
    if args.verify and not begun:
        raise InputFileError(args.folder, "", "has no journal of a calibration; run adapt without --verify first")
    if args.campaign is not None:
        campaign = results.load_campaign(args, geometry)
        box, level = campaign.box, campaign.level
    else:
        box, level, _ = machine_box(geometry)
        box, level = np.array(begun.get("box_m", box)), np.array(begun.get("level", level))
        if args.box is not None:
            box = np.array(args.box)
    goal = None if args.goal_um is None else args.goal_um * 1e-6
    if goal is None and campaign is None:
        goal = begun.get("goal_m")
    every = Task.every if args.every_min is None else 60.0 * args.every_min
    checks = None if args.checks is None and args.every_min is not None else args.checks or 0
    task = Task(box, level, goal, campaign, fit_settings(args), every)
    signals = received_signals()

    def going_on() -> bool:
        return not signals

    with (
        sole_user(args.folder),
        AdaptedMachine(args.topic, args.namespace, samples=args.samples, going_on=going_on) as machine,
        results.stage_line() as say,
    ):
        machine.refuse_other(geometry.name)
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
        lambda: "\n".join(journal_lines(loop.events)),
        lambda: {
            "machine": geometry.name,
            "state": outcome.state,
            "text": outcome.text,
            "model": outcome.model,
            "promised_m": None if np.isnan(loop.state.promised_in_use) else loop.state.promised_in_use,
            "events": loop.events,
        },
        code=INTERRUPTED if outcome.state == "stopped" else 0 if outcome.good else 1,
    )


def journal_lines(events: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a line of text for each event in the journal of the verb ``adapt``."""
    from ..upkeep.loop import applied_text, moved_text

    def um(value: float | None) -> str:
        return "–" if value is None else f"{number(value * 1e6, 2)} µm"

    adopted = ""
    for e in events:
        match e["event"]:
            case "planned":
                text = "campaign: as given" if e["expected_m"] is None else f"campaign: {e['campaign']}"
                text += "" if e["expected_m"] is None else f", {um(e['expected_m'])} RMS expected"
            case "collected":
                lost = f", no readings at {len(e['missing'])} stops" if e["missing"] else ""
                text = f"{e['count']} readings: {e['readings']}{lost}"
            case "fitted":
                promised = f"{e['model']}, up to {um(e['promised_m'])} RMS (95 %)"
                text = promised if e["enough"] else f"not enough: {e['short']}"
            case "checked":
                found = f"shows {um(e['found_m'])}, {um(e['promised_m'])} promised"
                text = f"{e['readings']} {found}; {'confirmed' if e['good'] else e['text']}"
                text += moved_text(e)
                if e["good"] and e["model"] == adopted:  # a candidate does not run yet, and a change is an own cause
                    text += applied_text(e)
            case "repaired":
                text = f"{e['text']}; {e['model']} updates {e['of']}"
            case "begun" | "reloaded":
                text = e.get("model", "")
            case "adopted":
                text = adopted = e["model"]
            case "ended":
                text = f"{e['state']}: {e['text']}"
            case _:
                text = e.get("reason", "")
        yield f"{e['time']}  {e['event']:<13} {text}".rstrip()


def move(args: argparse.Namespace) -> Result:
    """Have the mover move or stop the tool; exit code 0: the tool has arrived, or is at rest."""
    from ..pose import Pose
    from ..ros import received_signals
    from ..ros.client import Machine, MoveState

    signals = received_signals()
    with Machine(args.namespace) as machine, results.stage_line() as say:
        if args.stop:
            machine.stop()
        else:

            def shown(state: MoveState) -> None:
                say(f"{state.state} {100.0 * state.share:3.0f} %, {state.time_left:.1f} s left")
                if signals:
                    machine.stop()

            machine.move(Pose.from_angles(*args.pose), args.frame, args.relative, progress=shown)
        state = machine.last
    content = {"state": state.state, "text": state.text, "stopped_by": state.stopped_by}
    return Result(lambda: f"{state.state}: {state.text}", lambda: content)


def watch(args: argparse.Namespace) -> int:
    from ..ros import received_signals
    from ..viewer.page import WatchPage, watch

    geometry = load_geometry(args.machine)
    page = WatchPage(geometry, args.host, args.port)
    signals = received_signals()
    print(f"hexapod_comp: {geometry.name} is shown on {page.address} until Ctrl-C", file=sys.stderr)
    try:
        watch(geometry, page.show, lambda: not signals, args.namespace)
    finally:
        page.close()
    return 0


def echo(args: argparse.Namespace) -> int | Result:
    from ..ros import received_signals
    from ..ros.echo import DISCOVERY_TIME, Echo, published_topics
    from ..ros.process import QUIET, SPIN_PERIOD, RosSession

    signals = received_signals()
    began = time.monotonic()

    def going_on(until: float) -> bool:
        return not signals and time.monotonic() < until

    with RosSession("hexapod_comp_echo", args.namespace, **QUIET) as session:
        if args.topic is None:
            while going_on(began + DISCOVERY_TIME):
                session.spin_once(SPIN_PERIOD)
            topics = published_topics(session.node)
            lines = (f"{name}  {kind}" for name, kind in topics.items())
            return Result(lambda: "\n".join(lines), lambda: topics, code=0 if topics else 1)

        def print_message(received: EchoedMessage) -> None:
            if not args.hz and (args.count is None or watched.intervals.count <= args.count):
                print(json_text(received.record(), indent=None) if args.json else f"{received.text()}\n\n", end="")

        watched = Echo(session.node, session.spin_once, args.topic, print_message)
        end, next_line = began + (args.seconds or math.inf), began + HZ_PERIOD
        while going_on(end) and (args.count is None or watched.intervals.count < args.count):
            session.spin_once(SPIN_PERIOD)
            sys.stdout.flush()
            if args.hz and not args.json and time.monotonic() > next_line:
                next_line += HZ_PERIOD
                print(f"{watched.topic}: {watched.intervals.text()}")
    intervals = watched.intervals
    if args.hz and args.json:
        print(json_text({"topic": watched.topic, **intervals.record()}), end="")
    elif not args.json:
        print(f"{watched.topic}: {intervals.text()}", file=sys.stderr)
    return 0 if intervals.count else 1


def record(args: argparse.Namespace) -> int:
    """Record the topics of a machine in a bag; exit code 0: the bag can be replayed."""
    from ..ros import received_signals
    from ..ros.recorder import BagRecorder

    signals, end = received_signals(), time.monotonic() + (args.seconds or math.inf)
    with BagRecorder(args.folder, args.namespace) as recorder, results.progress_bar(0, " messages") as bar:
        print(f"hexapod_comp: recording to {args.folder} until Ctrl-C", file=sys.stderr)
        recorder.run(lambda: not signals and time.monotonic() < end, bar.update)
    lines = [f"{count:8d}  {topic}" for topic, count in sorted(recorder.counts.items())]
    lines.append("recording ended early" if recorder.problem else f"written: {args.folder}")
    nothing = not (recorder.problem or recorder.journal)
    shown = Result(
        lambda: "\n".join(lines),
        lambda: {"bag": args.folder, "messages": recorder.counts},
        code=0 if recorder.journal else 1,
        notes=["no compensator published, so this recording cannot be replayed"] if nothing else (),
    )
    code = shown.finish(args)
    if recorder.problem:
        raise InputFileError(args.folder, "", recorder.problem)
    return code


def replay(args: argparse.Namespace) -> Result:
    from ..compensation.journal import Source
    from ..replay.bag import Files, read_recording
    from ..replay.replay import replay_recording, what_if
    from ..replay.report import Report, rows_of

    with results.progress_bar(0, " messages") as bar:
        recording = read_recording(args.bag, args.namespace, bar.update)
    model_name, first = args.model or "", recording.first
    named = {"geometry": args.machine, "model": None if is_word(model_name) else args.model}
    given = [Source.read(input_file(name, kind)) for kind, name in named.items() if name is not None]
    files = Files(recording, {source.sha256: source for source in given})
    other = None
    if (
        {source.sha256 for source in given} - files.used
        or is_random(model_name)
        or (model_name == "ideal" and not files.used_ideal)
    ):
        machine = load_geometry(args.machine) if args.machine else files.geometry(first.geometry)
        other = machine, find_model(args.model, machine) if args.model else files.model(first.model, machine)
    with_own_files = other is None or files.missing() is None
    report = Report(recording, None, tolerance=args.tolerance_um * 1e-6)
    with results.progress_bar(len(recording.commands) * (with_own_files + bool(other)), " answers") as bar:
        if with_own_files:
            report.replayed = replay_recording(recording, files, bar.update)
            if other is None and not report.replayed.compared:
                needed = "a comparison needs a snapshot in the journal, and all pages that follow this snapshot"
                problem = f"contains no answer that can be compared: {needed}; record for longer than 1 s"
                raise InputFileError(args.bag, "", problem)
        if other is not None:
            report.other = what_if(recording, *other, bar.update)
            report.other_name = f"machine {other[0].name}, model {other[1].name}"
    geometry = files.geometry(first.geometry) if with_own_files or other is None else other[0]
    report.geometry = geometry
    text, content = report.shown()

    def pictures() -> dict[str, Figure]:
        from ..replay.pictures import figures_of

        return figures_of(report, geometry)

    return Result(lambda: text, lambda: content, rows_of(report), pictures, 0 if report.same else 1)
