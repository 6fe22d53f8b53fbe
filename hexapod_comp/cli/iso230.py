"""``hexapod_comp iso230``: the figures of ISO 230 from measured lines."""

from __future__ import annotations

import argparse

from ..errors import CalibrationError
from ..machine.geometry import load_geometry
from ..measurements.files import read_measurements
from ..measurements.iso230 import every_target, judge, standards_json, standards_text
from . import common


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb."""
    geometry = load_geometry(args.machine)
    with common.stage("reading measurements"):
        measured = read_measurements(args.files, geometry, args.columns, args.probe_mm, in_reach=False)
    common.say_notes(measured.notes)
    judged = judge(measured)
    if not judged:
        problem = (
            "no linear run has two cycles or more with every target read from both sides in each; no circle either"
        )
        raise CalibrationError("measurements", problem)
    text = every_target if args.targets else standards_text
    return common.Result(lambda: text(judged), lambda: standards_json(judged))
