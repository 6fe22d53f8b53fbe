"""How long a fit of scheme joint takes: the shipped 5-D campaign on the paper's machine, read more and more finely.

The campaign's lines with readings so many times as dense: 10,230 and 105,006. First the fit alone, then the
whole command ``fit``, from the start of Python to the files that it writes. The processors' time is that of all
threads, and a busy computer changes it little; the clock's is less where two threads work at once. Answers can be kept
and compared with those of another version: the largest difference of a parameter, in its standard error.

Usage: python -m benchmarks.calibration_speed [--dense 1.3 14] [--save FILE] [--against FILE] [--json]
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is loaded, as by the command line

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.campaign import load_campaign, template
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.measurements.tidy import write_measurements
from hexapod_comp.virtual.instruments import measure
from hexapod_comp.virtual.named import find_model

CONFIG = Path(__file__).resolve().parents[1] / "config"


def timed(dense: float) -> tuple[dict[str, float], np.ndarray]:
    """Return readings, seconds and what is promised of a fit with readings so many times as dense; and its answer.

    The answer: parameters and their standard errors, shape (2, size).
    """
    geometry = load_geometry(CONFIG / "paper.yaml")
    campaign = load_campaign(CONFIG / "campaign_5d.yaml")
    campaign = replace(campaign, step=campaign.step / dense)
    truth = RealMachine(geometry, find_model("paper_machine", geometry))
    readings = measure(template(campaign, geometry), campaign, truth, 1)
    processor, clock = time.process_time(), time.perf_counter()
    fit = fit_model(readings, FitSettings(lead=0.01))
    processor, clock = time.process_time() - processor, time.perf_counter() - clock
    expected = fit.level.after * 1e6 if fit.level is not None else float("nan")
    row = {
        "readings": len(readings),
        "parameters": fit.space.size,
        "steps": fit.solution.steps,
        "processor_s": processor,
        "clock_s": clock,
        "expected_um": expected,
        **command(readings),
    }
    return row, np.array([fit.solution.x, fit.standard_errors])


def command(readings: MeasurementSet) -> dict[str, float]:
    """Return what the command ``fit`` takes of processors and by the clock, s."""
    with TemporaryDirectory() as folder:
        write_measurements(readings, f"{folder}/readings.csv")
        words = ["fit", f"{folder}/readings.csv", "--lead-mm", "10", "--out", f"{folder}/model.yaml"]
        before, clock = os.times(), time.perf_counter()
        program = [sys.executable, "-m", "hexapod_comp", *words]
        subprocess.run(program, cwd=CONFIG.parent, check=True, stdout=subprocess.DEVNULL)
        after, clock = os.times(), time.perf_counter() - clock
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return {"command_processor_s": used, "command_clock_s": clock}


def main() -> None:
    """Print a line for each density."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    text = "times as many readings (default 1.3 14)"
    parser.add_argument("--dense", type=float, nargs="+", default=[1.3, 14], help=text)
    parser.add_argument("--json", action="store_true", help="JSON instead of a table")
    parser.add_argument("--save", type=Path, metavar="FILE", help="keep the answers (.npz)")
    parser.add_argument("--against", type=Path, metavar="FILE", help="compare the answers with kept ones")
    args = parser.parse_args()
    timed(1)  # compiled and loaded
    rows, answers = zip(*map(timed, args.dense), strict=True)
    if args.save is not None:
        np.savez(args.save, **{f"dense_{dense:g}": answer for dense, answer in zip(args.dense, answers, strict=True)})
    if args.against is not None:
        kept = np.load(args.against)
        for dense, row, (x, error) in zip(args.dense, rows, answers, strict=True):
            row["difference"] = float((np.abs(x - kept[f"dense_{dense:g}"][0]) / error).max())
    if args.json:
        print(json.dumps(rows, indent=1))
        return
    print("readings  parameters  steps  processor s  clock s  expected µm  command: processor s  clock s")
    for row in rows:
        print(
            f"{row['readings']:8.0f}  {row['parameters']:10.0f}  {row['steps']:5.0f}  {row['processor_s']:11.1f}"
            f"  {row['clock_s']:7.1f}  {row['expected_um']:11.3f}  {row['command_processor_s']:20.1f}"
            f"  {row['command_clock_s']:7.1f}"
            + (f"  differs by {row['difference']:.1g} standard errors" if "difference" in row else "")
        )


if __name__ == "__main__":
    main()
