"""Calibration of a real hexapod, checked on poses outside the fit: motion-capture data of the project Jugglebot.

Usage: python -m benchmarks.jugglebot [--data FOLDER] [--workers 2]; see doc/benchmarks.md. The data in
benchmarks/data/jugglebot have the MIT licence. Exit code 1: a target is missed; 2: the data are missing.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.calibration.parameters import FitSettings
from hexapod_comp.calibration.sensitivity import predict
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import Structure, strut_lengths_batch
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.readings import AXES, CHANNELS, KINDS, MeasurementSet

from . import cannot_run
from .drawn import each

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(__file__).parent / "data" / "jugglebot"
FILES = ("108_calibration_poses.csv", "grid180.csv", "grid180_ff_correction.csv")
FOLDS, SPLITS = 6, 5
KNOWN = FitSettings(tracker_frame="known")  # the cameras' frame was aligned with the machine's
POSES_TARGET, GRID_TARGET = 1.08e-3, 0.96  # error of an independent fit of 48 parameters, m; removed share


def read(folder: Path, name: str, columns: str) -> MeasurementSet:
    geometry = load_geometry(ROOT / "config" / "jugglebot.yaml")
    return read_measurements(folder / name, geometry, ROOT / "config" / columns)


def position_squares(measured: MeasurementSet, errors: np.ndarray) -> np.ndarray:
    """Return each station's squared position residual, m², with the predicted errors (M, 6) of all stations."""
    position = measured.kind == KINDS.index("position")
    misfit = measured.value - (measured.directions() * errors[measured.station]).sum(axis=1)
    return np.bincount(measured.station[position], misfit[position] ** 2, len(measured.stations))


def zeroed_without(measured: MeasurementSet, out: np.ndarray) -> MeasurementSet:
    """Return readings whose strut zeros are computed without the stations `out`; the file's zeros use all stations."""
    s = measured.stations
    errors = np.zeros((len(s), 6))
    for kind, first in (("position", 0), ("attitude", 3)):
        for n, axis in enumerate(AXES):
            mine = measured.channel == CHANNELS.index(f"{kind}_{axis}")
            errors[measured.station[mine], first + n] = measured.value[mine]
    rotations = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ s.rotations
    lengths = strut_lengths_batch(Structure.of(measured.geometry), s.positions + errors[:, :3], rotations)
    zero = np.delete(lengths - s.commands, out, axis=0).mean(axis=0)
    return replace(measured, stations=replace(s, commands=s.commands + zero))


def left_out(measured: MeasurementSet, out: np.ndarray, settings: FitSettings) -> np.ndarray:
    """Fit without the stations `out`; return these stations' squared position residuals, m²."""
    is_out = np.isin(measured.station, out)
    fit = fit_model(measured.select(~is_out), settings)
    # only the fitted stations determine the knots and the box of the parameters
    errors = predict(fit.space, fit.solution.x, measured.stations).errors
    return position_squares(measured, errors)[out]


def rms(squares: np.ndarray) -> float:
    return float(np.sqrt(np.mean(squares)))


def poses(folder: Path, workers: int) -> bool:
    """Cross-validate and print the 108 poses; return whether the target is met."""
    measured = read(folder, "108_calibration_poses.csv", "jugglebot_columns.yaml")
    count = len(measured.stations)
    raw = rms(position_squares(measured, np.zeros((count, 6))))
    found = []
    for seed in range(SPLITS):
        fold = np.random.default_rng(seed).permutation(count) % FOLDS
        parts = [np.flatnonzero(fold == k) for k in range(FOLDS)]
        tasks = [(zeroed_without(measured, part), part, KNOWN) for part in parts]
        found.append(rms(np.concatenate([*each(left_out, tasks, workers)])))
        print(f"108 poses, split {seed + 1}: {raw * 1e3:.2f} -> {found[-1] * 1e3:.3f} mm RMS", flush=True)
    print(f"108 poses, mean of {SPLITS} splits: {np.mean(found) * 1e3:.3f} mm RMS (target {POSES_TARGET * 1e3:.2f})")
    return float(np.mean(found)) <= POSES_TARGET


def grid(folder: Path, workers: int) -> bool:
    """Print the leave-one-out test of the level grid; return whether the target is met."""
    measured = read(folder, "grid180.csv", "jugglebot_grid_columns.yaml")
    own = read(folder, "grid180_ff_correction.csv", "jugglebot_grid_columns.yaml")
    count = len(measured.stations)
    raw, corrected = (rms(position_squares(m, np.zeros((len(m.stations), 6)))) for m in (measured, own))
    # Blocks are selected once, with all poses: leaving one out hardly changes the selection.
    whole = fit_model(measured, KNOWN)
    kept = replace(KNOWN, blocks=tuple(block.name for block in whole.space.blocks))
    left = rms(np.concatenate([*each(left_out, [(measured, np.array([n]), kept) for n in range(count)], workers)]))
    print(
        f"grid180, leave-one-out: {raw * 1e3:.2f} -> {left * 1e3:.3f} mm RMS, {100 * (1 - left / raw):.1f} % less "
        f"(target {100 * GRID_TARGET:.0f} %); the owner's own correction: {corrected * 1e3:.2f} mm, "
        f"{100 * (1 - corrected / raw):.1f} % less"
    )
    return left <= (1.0 - GRID_TARGET) * raw


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="folder with the three data files")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    args = parser.parse_args(arguments)
    missing = [name for name in FILES if not (args.data / name).is_file()]
    if missing:
        return cannot_run(f"{args.data} has no {', '.join(missing)}; give the folder of the data with --data")
    met = [poses(args.data, args.workers), grid(args.data, args.workers)]
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
