"""The verbs ``imagine`` (makes a virtual machine), ``outside`` (adds a table to a model), ``simulate`` (measures a
virtual machine), ``collect`` (measures a running machine) and ``iso230`` (evaluates readings)."""

from __future__ import annotations

import argparse
import sys
from dataclasses import fields, replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CalibrationError, CommandError, GeometryError
from ..formats.paths import input_file
from ..formats.schema import in_unit
from ..formats.texts import number
from ..machine.arrays import rms
from ..machine.geometry import load_geometry
from ..machine.model import RealMachine
from ..machine.model_file import save_model
from ..machine.outside import load_outside
from ..machine.temperatures import PARTS
from ..measurements.campaign import template
from ..measurements.collect import RunSetUp
from ..measurements.readings import KINDS, si_unit
from ..virtual import named
from ..virtual.imperfections import ImperfectionBounds
from . import results
from .results import Result, Table

RESOLUTION = 10  # Number of decimals of simulated readings in m (0.1 nm) and rad


def imagine(args: argparse.Namespace) -> Result:
    """Draw random errors for a virtual machine, and write a model file."""
    from ..calibration.evaluation import held_out
    from ..workspace.reach import machine_box

    geometry = load_geometry(args.machine)
    bounds: dict[str, Any] = {"shared_platform_joints": not args.separate_joints}
    known = {one.name for one in fields(ImperfectionBounds)} & vars(args).keys()
    bounds |= {name: value for name in known if (value := getattr(args, name)) is not None}
    if args.field_displacement or args.field_rotation:
        box, attitude, _ = machine_box(geometry)
        box = box if args.box is None else np.array(args.box)
        corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)  # tool positions in work
        positions, _ = geometry.platform_poses(corners, np.tile(attitude, (len(corners), 1, 1)))
        bounds["field_box"] = np.array([positions.min(axis=0), positions.max(axis=0)])
    model = named.imagine(geometry, args.seed, named.usual_bounds(geometry, **bounds), args.name or "")
    save_model(model, args.out)
    lines = [f"machine {model.machine}, seed {args.seed}: model {model.name}"]
    tool: dict[str, Any] | None = None
    try:
        box, attitude, _ = machine_box(geometry)
        error = held_out(RealMachine(geometry, model), None, box, level=attitude)
        low, high = (", ".join(number(v * 1e3, 1) for v in corner) for corner in box)
        lines.append(
            f"tool error in the box ({low})…({high}) mm in work: {error.raw.rms * 1e6:.2f} µm RMS absolute, "
            f"{error.aligned.rms * 1e6:.2f} µm after best-fit alignment"
        )
        tool = {"frame": "work", "box_m": box, "rms_m": error.raw.rms, "aligned_rms_m": error.aligned.rms}
    except GeometryError as problem:
        results.print_notes([f"the tool error is not known: {problem}"])
    about = {"machine": model.machine, "name": model.name, "seed": args.seed}
    content = {**about, "tool_error": tool, "written": args.out}
    return Result(lambda: "\n".join([*lines, f"truth: {args.out}"]), lambda: content)


def outside(args: argparse.Namespace) -> Result:
    table = load_outside(input_file(args.table, "readings"))
    table = replace(table.negated() if args.holds == "corrections" else table, beyond=args.beyond)
    if args.calibrated_at is not None:
        table = table.without(table.numbers_of(args.calibrated_at))
    _, model = results.load_machine(args)
    notes = []
    if model.outside.names:
        notes.append(f"the new table replaces the table over {' and '.join(model.outside.names)} in {args.model}")
    if model.origin.posterior is not None and Path(args.out).parent != Path(args.model).parent:
        notes.append(
            f"copy {model.origin.posterior[0]}, the covariance of the model's parameters, to the folder of {args.out}"
        )
    origin = replace(model.origin, date=model.origin.date or date.today().isoformat())
    model = replace(model, outside=table, origin=origin)
    save_model(model, args.out)
    given = zip(table.names, table.units, table.nodes, strict=True)
    axes = [(name, unit, in_unit(nodes, unit)) for name, unit, nodes in given]
    largest = [float(np.linalg.norm(values, axis=1).max()) for values in (table.displacement, table.rotation)]
    lines = [f"machine {model.machine}, model {model.name}: a table over {' and '.join(table.names)}"]
    lines += [f"{name} {nodes[0]:g} … {nodes[-1]:g} {unit}, {len(nodes)} nodes" for name, unit, nodes in axes]
    lines.append(
        f"largest error {largest[0] * 1e6:.2f} µm and {largest[1] * 1e6:.2f} µrad; outside the table: {table.beyond}"
    )
    content = {
        "machine": model.machine,
        "name": model.name,
        "axes": [{"name": name, "unit": unit, "nodes": nodes} for name, unit, nodes in axes],
        "largest_m": largest[0],
        "largest_rad": largest[1],
        "written": args.out,
    }
    return Result(lambda: "\n".join([*lines, f"written: {args.out}"]), lambda: content, notes=notes)


def simulate(args: argparse.Namespace) -> Result:
    from ..measurements.stations import compensated
    from ..measurements.tidy import write_measurements
    from ..virtual.instruments import measure
    from ..virtual.warm_up import growing, load_warm_up

    geometry, model = results.load_machine(args)
    args.truth = named.truth_name(args.truth, geometry)
    truth = named.find_model(args.truth, geometry)
    campaign = results.load_campaign(args, geometry)
    warm_up = None
    if args.warm_up is not None:
        warm_up, expansion = load_warm_up(args.warm_up, args.seed)
        campaign, truth = warm_up.campaign(campaign), growing(truth, expansion)
    plan = template(campaign, geometry, args.seed, args.campaign)
    running, machine = None if args.model == "ideal" else model, RealMachine(geometry, truth)
    with results.progress_bar(len(plan.stations), " stations") as bar:
        if warm_up is not None:
            read = warm_up.measured(plan, campaign, machine, args.seed, running, bar.update)
        else:
            plan = plan if running is None else compensated(plan, running)
            read = measure(plan, campaign, machine, args.seed, bar.update)
    measured = read.with_values(read.value.round(RESOLUTION))
    write_measurements(measured, args.out)

    lengths = "nominal strut lengths" if running is None else f"the strut lengths of {args.model}"
    lines = [f"machine {geometry.name} with the errors of {args.truth}, commanded with {lengths}; seed {args.seed}"]
    content = {"machine": geometry.name, "truth": args.truth, "model": args.model, "seed": args.seed}
    stations = measured.stations
    if args.warm_up is not None:
        went = (stations.temperatures.max(axis=0) - stations.temperatures.min(axis=0)).tolist()
        rises = dict(zip(PARTS, went, strict=True))
        damp = stations.humidity.max() - stations.humidity.min()  # NaN without measured humidity
        listed = ", ".join(f"{name} {number(rise, 2)} K" for name, rise in rises.items() if rise)
        air = f", humidity {number(100.0 * damp, 1)} %" if damp > 0.0 else ""
        lines.append(f"warm-up {args.warm_up}, increase during the measurement: {listed}{air}")
        content |= {"warm_up": args.warm_up, "warmed_K": rises}
    counts = {"readings": len(measured), "runs": len(measured.runs), "stations": len(stations)}
    channels = []
    for n, kind in enumerate(KINDS):
        if len(values := measured.value[measured.kind == n] * 1e6):
            unit, largest = f"u{si_unit(kind)}", float(abs(values).max())
            channels.append({"channel": kind, "readings": len(values), "rms": rms(values), "max": largest, "": unit})
    lines.append(Table(channels).text())
    lines.append(f"{len(measured)} readings of {counts['runs']} runs at {counts['stations']} stations: {args.out}")
    in_json = [{f"{key}_{c['']}" if key in ("rms", "max") else key: c[key] for key in c if key} for c in channels]
    content |= {**counts, "channels": in_json, "written": args.out}
    return Result(lambda: "\n".join(lines), lambda: content)


def collect(args: argparse.Namespace) -> Result:
    """Measure a running machine: the mover moves to the campaign's poses, and readings come from topics."""
    from ..measurements.collect import collect as collect_readings
    from ..ros import received_signals
    from ..ros.collector import WatchedMachine

    geometry = load_geometry(args.machine)
    campaign = results.load_campaign(args, geometry)
    signals = received_signals()
    instruments = {"readings": args.readings, "tracker_frame": args.tracker_frame, "samples": args.samples}
    confirm = _confirmed if args.confirm else lambda run: None
    with (
        WatchedMachine(args.topic, args.namespace, **instruments, confirm=confirm) as machine,
        results.stage_line() as say,
    ):
        machine.refuse_other(geometry.name)
        done = collect_readings(
            campaign,
            geometry,
            machine,
            args.out,
            args.seed,
            progress=lambda done, of, where: say(f"stop {done + 1} of {of}: {where}"),
            going_on=lambda: not signals,
            tracker_frame=args.tracker_frame,
        )
    planned = len(template(campaign, geometry, args.seed, args.campaign))
    count, missing = len(done.measurements), list(done.missing)
    content = {"machine": geometry.name, "readings": count, "planned": planned, "missing": missing, "written": args.out}
    return Result(
        lambda: f"{count} of {planned} readings: {args.out}",
        lambda: {**content, "resumed_stops": done.resumed},
        code=0 if count == planned else 1,
        notes=[f"no readings at {where}; run the same command again to complete the file" for where in missing],
    )


def _confirmed(run: RunSetUp) -> None:
    place = ", ".join(number(value * 1e3, 1) for value in run.place.position)
    axis = ", ".join(number(value, 3) for value in run.place.rotation[:, 0])
    at = f"at ({place}) mm in base" if run.channels == ("length",) else f"from ({place}) mm in base along ({axis})"
    print(
        f"\nset up {', '.join(run.channels)} for {run.name}, {at}, then press Enter ",
        end="",
        file=sys.stderr,
        flush=True,
    )
    if not sys.stdin.readline():
        raise CommandError("instrument", f"the set-up for {run.name} was not confirmed: standard input has ended")


def iso230(args: argparse.Namespace) -> Result:
    from ..measurements.files import read_measurements
    from ..measurements.iso230 import every_target, judge, standards_json, standards_text

    geometry = load_geometry(args.machine)
    with results.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, args.probe_mm, in_reach=False)
    results.print_notes(measured.notes)
    judged = judge(measured)
    if not judged:
        text = "there is no circle, and no linear run with two or more cycles that read every target from both sides"
        raise CalibrationError("measurements", text)
    shown = every_target if args.targets else standards_text
    return Result(lambda: shown(judged), lambda: standards_json(judged))
