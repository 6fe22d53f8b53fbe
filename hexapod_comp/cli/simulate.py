"""``hexapod_comp simulate``: a calibration campaign on the virtual machine."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from ..formats import texts
from ..machine.arrays import rms
from ..machine.model import RealMachine
from ..machine.temperatures import PARTS
from ..measurements.campaign import template
from ..measurements.readings import ANGULAR_KINDS, KINDS, MeasurementSet
from ..measurements.tidy import write_measurements
from ..virtual.instruments import compensated, measure
from ..virtual.named import find_model, truth_name
from ..virtual.warm_up import growing, load_warm_up
from . import common
from .table import Table

RESOLUTION = 10  # digits after the point of the instruments, m and rad: a tenth of a nanometre


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    geometry, model = common.load_machine(args)
    args.truth = truth_name(args.truth, geometry)
    truth = find_model(args.truth, geometry)
    campaign = common.load_campaign(args, geometry)
    warm_up = None
    if args.warm_up is not None:
        warm_up, expansion = load_warm_up(args.warm_up, args.seed)
        campaign, truth = warm_up.campaign(campaign), growing(truth, expansion)
    plan = template(campaign, geometry, args.seed, args.campaign)
    running, machine = None if args.model == "ideal" else model, RealMachine(geometry, truth)
    with common.progress_bar(len(plan.stations), " stations") as bar:
        if warm_up is not None:
            read = warm_up.measured(plan, campaign, machine, args.seed, running, bar.update)
        else:
            plan = plan if running is None else compensated(plan, running)
            read = measure(plan, campaign, machine, args.seed, bar.update)
    measured = read.with_values(read.value.round(RESOLUTION))
    write_measurements(measured, args.out)
    return common.Result(lambda: _report(measured, args), lambda: _as_json(measured, args))


def _report(measured: MeasurementSet, args: argparse.Namespace) -> str:
    """Say what was measured, how much of each kind, and where it went."""
    lengths = "nominal strut lengths" if args.model == "ideal" else f"the strut lengths of {args.model}"
    errors = f"machine {measured.geometry.name} with the errors of {args.truth}"
    lines = [f"{errors}, moved by {lengths}; seed {args.seed}"]
    if args.warm_up is not None:
        lines.append(f"{_warmth(measured)}, as {args.warm_up} has it")
    names = ("channel", "readings", "rms", "max", "")
    rows = [dict(zip(names, row, strict=True)) for row in _channels(measured)]
    lines.append(Table(rows).text())
    count = f"{len(measured)} readings of {len(measured.runs)} runs at {len(measured.stations)} stations"
    return "\n".join([*lines, f"{count}: {args.out}"])


def _warmth(measured: MeasurementSet) -> str:
    """Say how far the sensors went."""
    listed = ", ".join(f"{name} {texts.number(rise, 2)} K" for name, rise in _rises(measured).items() if rise)
    humidity = measured.stations.humidity
    damp = humidity.max() - humidity.min()  # NaN where nobody tells
    air = f", humidity {texts.number(100.0 * damp, 1)} %" if damp > 0.0 else ""
    return f"warms while it is measured: {listed}{air}"


def _rises(measured: MeasurementSet) -> dict[str, float]:
    """Return how far each part's sensor went, K."""
    values = measured.stations.temperatures
    return dict(zip(PARTS, (values.max(axis=0) - values.min(axis=0)).tolist(), strict=True))


def _as_json(measured: MeasurementSet, args: argparse.Namespace) -> dict[str, Any]:
    """Return the same for programs."""
    warm = {"warm_up": args.warm_up, "warmed_K": _rises(measured)} if args.warm_up else {}
    head = {"machine": measured.geometry.name, "truth": args.truth, "model": args.model, "seed": args.seed}
    channels = [
        {"channel": kind, "readings": count, f"rms_{unit}": rms, f"max_{unit}": largest}
        for kind, count, rms, largest, unit in _channels(measured)
    ]
    counts = {"readings": len(measured), "runs": len(measured.runs), "stations": len(measured.stations)}
    return {**head, **warm, **counts, "channels": channels, "written": args.out}


def _channels(measured: MeasurementSet) -> Iterator[tuple[str, int, float, float, str]]:
    """Yield each kind of channel that was read, how often, its RMS and largest reading, and their unit."""
    for number, kind in enumerate(KINDS):
        values = measured.value[measured.kind == number] * 1e6
        if len(values):
            unit = "urad" if kind in ANGULAR_KINDS else "um"
            yield kind, len(values), rms(values), float(abs(values).max()), unit
