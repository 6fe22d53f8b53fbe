"""``hexapod_comp iso230``: the figures of ISO 230-2 from measured lines."""

from __future__ import annotations

import argparse

from . import common


def run(args: argparse.Namespace) -> int:
    """Run the verb."""
    from ..errors import CalibrationError
    from ..machine.geometry import load_geometry
    from ..measurements.files import read_measurements
    from ..measurements.iso230 import evaluate, iso230_runs, report, table

    geometry = load_geometry(args.machine)
    with common.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, args.probe_mm)
    common.say_notes(measured.notes)
    tests = {run.name: evaluate(run.targets, run.deviations) for run in iso230_runs(measured)}
    if not tests:
        problem = "no linear run has two cycles or more with every target read from both sides in each"
        raise CalibrationError("measurements", problem)
    if args.json:
        common.show({name: with_units(test.figures()) for name, test in tests.items()})
    elif args.targets:
        common.show("\n\n".join(f"{name}\n{report(test)}" for name, test in tests.items()))
    else:
        common.show(table(tests))
    return 0


def with_units(figures: dict[str, float]) -> dict[str, float]:
    """Return the standard's figures with their unit in the keys: ``A_m``, ``E_up_m``, …"""
    return {f"{name}_m": value for name, value in figures.items()}
