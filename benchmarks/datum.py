"""What switching compensation on does to the tool at the datum.

Machines of every kind in the tests (`test/foreign_machines.py`) with errors of 50 µm are measured by 5-D lines and four
diagonals, which do not show where a machine stands as a whole; the fitted model is written and read back. Then the same
machine is sent home with nominal lengths and with the model's: by how much does the tool move, in place and attitude?
Beside it what it would be, had the fit not held the datum.

Usage: python -m benchmarks.datum [--json]. Exits 1 when a tool moves by more than 0.1 nm or 1 nrad.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is loaded, as by the command line

import argparse
import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.virtual.instruments import measure

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))
from foreign_machines import Errors, Machine, machines

STILL = 1e-10, 1e-9
"""Bars: m and rad. A model file keeps a hundredth of a nanometre."""


@dataclass(frozen=True)
class Moved:
    """How far a tool moves at the datum, m and rad, and would move if it were not held, m."""

    machine: str
    displacement: float
    rotation: float
    not_held: float


def moved(machine: Machine, folder: Path) -> Moved:
    """Fit one machine, and switch compensation on at home."""
    geometry = load_geometry(machine.write(folder / "machine.yaml"))
    truth = RealMachine(geometry, load_model(Errors.drawn(machine, 5).write(folder / "truth.yaml", machine), geometry))
    side = float(np.ptp(machine.box, axis=0).min())
    campaign = Campaign(machine.box, side, side / 3.0, "5-D", 4)
    fit = fit_model(measure(template(campaign, geometry), campaign, truth, 1))
    save_model(fit.model, folder / "model.yaml")
    believed = RealMachine(geometry, load_model(folder / "model.yaml", geometry))
    told = strut_lengths(Structure.of(geometry), geometry.home), believed.commands_for(geometry.home)[0]
    before, after = (truth.pose_for(lengths)[0] for lengths in told)
    place = (after @ geometry.tool).position - (before @ geometry.tool).position
    turn = Rotation.from_matrix(after.rotation @ before.rotation.T).magnitude()
    return Moved(machine.name, float(np.linalg.norm(place)), float(turn), float(np.linalg.norm(fit.held.given_up[:3])))


def main() -> int:
    """Print a line for each machine."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.datum", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", action="store_true", help="JSON instead of a table")
    args = parser.parse_args()
    rows = []
    for machine in machines().values():
        with tempfile.TemporaryDirectory() as folder:
            rows.append(moved(machine, Path(folder)))
        if not args.json:
            r = rows[-1]
            sizes = f"{r.displacement:8.1e} m  {r.rotation:8.1e} rad; not held {r.not_held * 1e6:7.2f} µm"
            print(f"{r.machine:10} {sizes}", flush=True)
    if args.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
    return int(any(r.displacement > STILL[0] or r.rotation > STILL[1] for r in rows))


if __name__ == "__main__":
    sys.exit(main())
