"""``hexapod_comp iso230``: the figures of ISO 230-2 from measured lines."""

from __future__ import annotations

import argparse

from . import common
from .fit import add_reading_options

SUMMARY = "the figures of ISO 230-2:2014 (A, E, R, M, B) of measured lines"

TEXT = """Judges every linear run with two cycles or more, all targets read from both sides in each (the standard asks
for five cycles; a campaign says how many it makes). --targets prints each run target by target.

example:
  $ hexapod_comp iso230 measured.csv"""


def add_parser(subparsers: common.Subparsers) -> None:
    """Add the verb."""
    parser = common.add_verb(subparsers, "iso230", run, SUMMARY, TEXT)
    add_reading_options(parser)
    parser.add_argument("--targets", action="store_true", help="each run target by target, with notes")
    parser.add_argument("--json", action="store_true", help="JSON, for programs; m")


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import CalibrationError
    from ..formats.paths import config_file
    from ..machine.geometry import load_geometry
    from ..measurements.files import read_measurements
    from ..measurements.iso230 import evaluate, iso230_runs, report, table

    geometry = load_geometry(args.machine)
    columns = None if args.columns is None else config_file(args.columns)
    measured = read_measurements(args.files, geometry, columns, args.probe_mm)
    common.say_notes(measured.notes)
    tests = {run.name: evaluate(run.targets, run.deviations) for run in iso230_runs(measured)}
    if not tests:
        problem = "no linear run has two cycles or more with every target read from both sides in each"
        raise CalibrationError("measurements", problem)
    if args.json:
        text = common.json_text({name: test.figures() for name, test in tests.items()})
    elif args.targets:
        text = "\n\n".join(f"{name}\n{report(test)}" for name, test in tests.items())
    else:
        text = table(tests)
    common.emit(text, None)
    return 0
