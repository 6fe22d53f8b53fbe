"""``hexapod_comp demo``: hidden errors, a laser campaign, a fit, and what the fit is worth when the machine runs."""

from __future__ import annotations

import argparse
import os

from ..formats.csv import Row
from ..loop import report, session, story
from ..loop.report import error_rows, summary
from ..loop.story import Calibration, Place, calibrate, calibration_text
from ..machine.geometry import HexapodGeometry, load_geometry
from ..machine.model import MachineModel
from . import common
from .run import TRUE, chosen_model, drawn, hidden_errors

FITTED = "fit"  # the model that is yet to be made, of readings


def run(args: argparse.Namespace) -> common.Result:
    """Run the verb; 0 when the loop kept what the fit promised."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as for fit: its matrices are small

    rate = session.checked_rate(args.rate_hz)
    geometry = load_geometry(args.machine)
    truth, calibration = hidden_errors(args, geometry), None
    place = story.demo_place(geometry)
    poses, path = story.demo_poses(place, args.seed), story.demo_path(geometry, place, rate)
    if args.model == FITTED:
        calibration = _calibration(args, geometry, truth, place)
        model = calibration.fit.model
    else:
        model = chosen_model(args, geometry, truth)
    with common.ended_in_order(), session.simulated(args.machine, model, truth) as nodes:
        result = session.witnessed(geometry, nodes, poses, path, rate, compare=True)
    rows = error_rows(result)
    if args.model in (TRUE, FITTED):
        promised = story.EXACT if calibration is None else story.promises(calibration.fit, poses, path)
        rows = story.with_promises(rows, promised, story.left_by_drives(geometry, truth, poses, path))
    complaints = report.complaints(result, rows)
    named = [Row(0, str(n + 1)) for n in range(len(poses))]
    measured = None if calibration is None else story.as_json(calibration)
    known = {"machine": geometry.name, "truth": args.truth, "calibration": measured}
    verdict = "\n".join(f"NOT AS IT SHOULD BE: {complaint}" for complaint in complaints) or "all as it should be"
    title = f"{geometry.name}, hidden errors {args.truth}"
    return common.Result(
        lambda: f"\n{summary(result, rows)}\n{story.REMARK}\n{verdict}",
        lambda: {**known, **report.as_json(named, result, rows), "complaints": complaints},
        pictures=lambda: drawn(args, result, rows, title, calibration),
        code=1 if complaints else 0,
    )


def _calibration(args: argparse.Namespace, geometry: HexapodGeometry, truth: MachineModel, place: Place) -> Calibration:
    """Measure and fit the machine, and say what came of it before the loop starts."""
    with common.stage_line() as say:
        calibration = calibrate(geometry, truth, place, args.seed, say)
    if not args.json:
        print(f"machine {geometry.name}, hidden errors: {args.truth}\n{calibration_text(calibration)}", flush=True)
    return calibration
