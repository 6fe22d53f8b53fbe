"""``hexapod_comp measure``: a calibration campaign on the virtual machine."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..formats import texts
from . import common

if TYPE_CHECKING:
    from ..measurements.readings import MeasurementSet

SUMMARY = "measure the virtual machine: a campaign's readings as a CSV file"

TEXT = """Moves the virtual machine through a campaign (lines, diagonals, scattered poses) and writes what its
instruments read, noise and unknown zeros included, as the CSV file that fit reads: one reading a row, errors
as measured minus commanded, in um and urad. --model measures the machine with that model's compensation: then the file
also holds the strut lengths that the machine was told. The same seed gives the same file.

example:
  $ hexapod_comp measure --campaign campaign_1d --seed 1 --out measured.csv
  machine paper with the errors of paper_machine.yaml, told nominal strut lengths; seed 1
  channel  readings     rms      max
   linear      1670  28.603  142.893  um
  1670 readings of 59 runs at 1670 stations: measured.csv"""


RESOLUTION = 10
"""Digits after the point of the instruments, m and rad: a tenth of a nanometre."""


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "measure", run, SUMMARY, TEXT)
    common.add_machine_options(parser)
    parser.add_argument(
        "--truth",
        metavar="FILE",
        default="paper_machine.yaml",
        help="model of the virtual machine's real errors (default paper_machine.yaml)",
    )
    parser.add_argument(
        "--campaign",
        metavar="FILE",
        default="campaign_5d.yaml",
        help="campaign file, or the name of a shipped one (default campaign_5d.yaml)",
    )
    parser.add_argument("--seed", type=common.seed, default=0, metavar="N", help="of all that is random (default 0)")
    parser.add_argument("--out", metavar="FILE", required=True, help="CSV file to write")


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..machine.model import RealMachine
    from ..machine.model_file import load_model
    from ..measurements.campaign import load_campaign, template
    from ..measurements.writing import write_measurements
    from ..virtual.instruments import compensated, measure

    geometry, model = common.load_machine(args)
    truth = load_model(args.truth, geometry)
    campaign = load_campaign(args.campaign)
    common.mention_compiling("model.actual_pose_one")
    plan = template(campaign, geometry, args.seed, args.campaign)
    if args.model != "ideal":
        plan = compensated(plan, model)
    with common.progress_bar(len(plan.stations), " stations") as bar:
        read = measure(plan, campaign, RealMachine(geometry, truth), args.seed, bar.update)
    measured = read.with_values(read.value.round(RESOLUTION))
    write_measurements(measured, args.out)
    print(_report(measured, args))
    return 0


def _report(measured: MeasurementSet, args: argparse.Namespace) -> str:
    """Say what was measured, how much of each kind, and where it went."""
    from ..machine.size import rms
    from ..measurements.readings import ANGULAR_KINDS, KINDS

    told = "nominal strut lengths" if args.model == "ideal" else f"the strut lengths of {args.model}"
    lines = [f"machine {measured.geometry.name} with the errors of {args.truth}, told {told}; seed {args.seed}"]
    rows = []
    for number, kind in enumerate(KINDS):
        values = measured.value[measured.kind == number] * 1e6
        if len(values):
            unit = "urad" if kind in ANGULAR_KINDS else "um"
            rows.append([kind, str(len(values)), _digits(rms(values)), _digits(abs(values).max()), unit])
    lines.append(texts.aligned(["channel", "readings", "rms", "max", ""], rows))
    count = f"{len(measured)} readings of {len(measured.runs)} runs at {len(measured.stations)} stations"
    return "\n".join([*lines, f"{count}: {args.out}"])


def _digits(value: float) -> str:
    return texts.number(float(value), 3)
