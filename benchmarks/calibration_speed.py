"""Time of a fit of scheme joint: the shipped 5-D campaign on the paper's machine, with more and more readings.

Usage: python -m benchmarks.calibration_speed [--dense 1.3 14]
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as the command line does

import argparse
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import table
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


def timed(dense: float) -> list[str]:
    """Return the table's row for a fit with `dense` times as many readings per length of line."""
    geometry = load_geometry(CONFIG / "paper.yaml")
    campaign = load_campaign(CONFIG / "campaign_5d.yaml")
    campaign = replace(campaign, step=campaign.step / dense)
    truth = RealMachine(geometry, find_model("paper_machine", geometry))
    readings = measure(template(campaign, geometry), campaign, truth, 1)
    processor, clock = time.process_time(), time.perf_counter()
    fit = fit_model(readings, FitSettings(lead=0.01))
    processor, clock = time.process_time() - processor, time.perf_counter() - clock
    expected = fit.level.after * 1e6 if fit.level is not None else float("nan")
    sizes = [f"{len(readings):,}", str(fit.space.size), str(fit.solution.steps)]
    times = [f"{seconds:.1f}" for seconds in (processor, clock, *command(readings))]
    return [*sizes, *times[:2], f"{expected:.3f}", *times[2:]]


def command(readings: MeasurementSet) -> tuple[float, float]:
    """Return the processor time and the wall clock time of the command ``fit``, s."""
    with TemporaryDirectory() as folder:
        write_measurements(readings, f"{folder}/readings.csv")
        words = ["fit", f"{folder}/readings.csv", "--lead-mm", "10", "--out", f"{folder}/model.yaml"]
        before, clock = os.times(), time.perf_counter()
        program = [sys.executable, "-m", "hexapod_comp", *words]
        subprocess.run(program, cwd=CONFIG.parent, check=True, stdout=subprocess.DEVNULL)
        after, clock = os.times(), time.perf_counter() - clock
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return used, clock


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--dense", type=float, nargs="+", default=[1.3, 14], help="factors on the readings per length")
    args = parser.parse_args()
    timed(1)  # not timed: imports and caches
    columns = ["readings", "parameters", "steps", "fit: processors, s", "clock, s", "expected, µm"]
    print(table([*columns, "command: processors, s", "clock, s"], map(timed, args.dense), texts=0))


if __name__ == "__main__":
    main()
