"""Rubin Observatory's correction tables of its hexapods (M2 and camera), applied by this package's compensator.

Usage: python -m benchmarks.rubin FOLDER [--config FOLDER]; see doc/benchmarks.md. At each node of a table, the nominal
pose of the commanded strut lengths must differ from the wanted pose by the table's offset. Exit code 1: the difference
at a node exceeds the target; 2: the data are missing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from numpy.polynomial.polynomial import polyval2d
from scipy.spatial.transform import Rotation

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.formats.csv import csv_text
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.kinematics import Structure, solve_pose
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.outside import OutsideTable, load_outside

from . import cannot_run
from .drawn import of_zoo

TABLES = {"M2": "fitter/zd_m2.txt", "camera": "fitter/zd_camera.txt"}
POLYNOMIALS = "MTHexapod/v7/laser_rotation_elevation_v23.yaml"
COMPONENTS = ("x_um", "y_um", "z_um", "rx_deg", "ry_deg", "rz_deg")
NODE_TARGET = np.repeat([5e-13, np.radians(5e-13)], 3)  # target: half a unit of the source's last digit, m and rad
STEPS = ((5.0, 10.0), (2.5, 5.0), (1.0, 2.0))  # steps in elevation and rotation, degrees
PLACES = 2000  # random places between the nodes


def table_of(folder: Path, names: Sequence[str], places: np.ndarray, offsets: np.ndarray) -> OutsideTable:
    """Write offsets to a file of corrections and read it with the package; return the table of errors."""
    header = [*(f"{name}_deg" for name in names), *COMPONENTS]
    rows = np.hstack([places, offsets]).tolist()
    (folder / "table.csv").write_text(csv_text([header, *rows]), encoding="utf-8")
    return load_outside(folder / "table.csv").negated()


def commanded_offset(compensator: Compensator, place: np.ndarray) -> np.ndarray:
    """Return the commanded minus the wanted pose, after the ramp: displacement, m, and rotation vector, rad."""
    geometry = compensator.geometry
    compensator.set_outside(dict(zip(compensator.model.outside.names, np.radians(place).tolist(), strict=True)))
    tool = geometry.tool_pose(geometry.home)
    command = compensator.correct(tool).command
    for n in range(200):
        if not compensator.ramping:
            break
        command = compensator.correct(tool, 0.02 * n).command
    pose = solve_pose(Structure.of(geometry), command, geometry.home)
    turn = Rotation.from_matrix(pose.rotation @ geometry.home.rotation.T).as_rotvec()
    return np.concatenate([pose.position - geometry.home.position, turn])


def si(offsets: np.ndarray) -> np.ndarray:
    return np.hstack([offsets[..., :3] * 1e-6, np.radians(offsets[..., 3:])])


def at_nodes(geometry: HexapodGeometry, table: OutsideTable, places: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the largest difference of each component between commanded and tabulated offsets at the nodes."""
    compensator = Compensator(geometry, MachineModel(geometry.name, outside=table), ramp_rate=1.0)
    found = np.array([commanded_offset(compensator, place) for place in places])
    return np.abs(found - si(offsets)).max(axis=0)


def between(table: OutsideTable, places: np.ndarray, offsets: np.ndarray) -> tuple[float, float, float]:
    """Return a table's error between its nodes: RMS and largest displacement, m, largest rotation, rad."""
    numbers = [dict(zip(table.names, np.radians(place).tolist(), strict=True)) for place in places]
    rest = np.array([-table.evaluate(one) for one in numbers]) - si(offsets)
    lengths, angles = (np.linalg.norm(part, axis=1) for part in (rest[:, :3], rest[:, 3:]))
    return float(np.sqrt(np.mean(lengths**2))), float(lengths.max()), float(angles.max())


def report(name: str, missed: np.ndarray, rests: Sequence[tuple[str, tuple[float, float, float]]]) -> bool:
    """Print the figures of a table; return whether the errors at its nodes are within the target."""
    met = bool((missed <= NODE_TARGET).all())
    nodes = f"{missed[:3].max() * 1e6:.1e} µm and {missed[3:].max() * 1e6:.1e} µrad"
    print(f"{name}: nodes reproduced to {nodes}: {'PASSED' if met else 'FAILED'}")
    for what, (rms, largest, angle) in rests:
        print(f"  {what}: {rms * 1e6:.3g} µm RMS, {largest * 1e6:.3g} µm and {angle * 1e6:.3g} µrad at most")
    return met


def waves(places: np.ndarray) -> np.ndarray:
    """Return constant, cosine and sine of zenith distances, degrees: the forms of an elastic structure's sag."""
    angles = np.radians(places[:, 0])
    return np.column_stack([np.ones_like(angles), np.cos(angles), np.sin(angles)])


def finite_elements(name: str, file: Path, geometry: HexapodGeometry, folder: Path) -> bool:
    """Check a table over zenith distance: at its nodes, and at every second row after it was left out."""
    rows = np.loadtxt(file)
    rows = rows[np.argsort(rows[:, 0])]
    places, offsets = rows[:, :1], rows[:, 1:]
    names = ("zenith_distance",)
    missed = at_nodes(geometry, table_of(folder, names, places, offsets), places, offsets)
    coarse = table_of(folder, names, places[::2], offsets[::2])
    fitted, *_ = np.linalg.lstsq(waves(places[::2]), offsets[::2], rcond=None)
    left = np.abs(waves(places[1::2]) @ fitted - offsets[1::2]).max(axis=0)
    print(f"{name}: constant, cosine and sine of every second row miss the others by {left[:3].max():.1e} µm at most")
    fine = np.linspace(places[0], places[-1], PLACES)
    rests = [
        (f"at rows left out, table of {len(places[::2])} rows", between(coarse, places[1::2], offsets[1::2])),
        (f"between {len(places)} rows, compared with these waves", between(
            table_of(folder, names, places, offsets), fine, waves(fine) @ fitted)),
    ]  # fmt: skip
    return report(f"{name}, finite elements by zenith distance", missed, rests)


def laser_and_sky(name: str, coefficients: Sequence[Sequence], geometry: HexapodGeometry, folder: Path) -> bool:
    """Convert polynomials over elevation and rotation to tables of several resolutions, and check each table."""
    powers = [np.array(one, dtype=float) for one in coefficients]

    def offsets(places: np.ndarray) -> np.ndarray:
        return np.column_stack([polyval2d(*places.T, one) for one in powers])

    at_random = np.random.default_rng(1).uniform([20.0, -90.0], [90.0, 90.0], (PLACES, 2))
    missed, rests = np.zeros(6), []
    for step, turn in STEPS:
        axes = np.arange(20.0, 90.1, step), np.arange(-90.0, 90.1, turn)
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        table = table_of(folder, ("elevation", "rotation"), places, offsets(places))
        if not rests:
            missed = at_nodes(geometry, table, places, offsets(places))
        what = f"at {PLACES} random places between nodes each {step:g}° of elevation, {turn:g}° of rotation"
        rests.append((what, between(table, at_random, offsets(at_random))))
    return report(f"{name}, laser tracker and sky by elevation and rotation", missed, rests)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("ts_mthexapod"), help="clone of ts_mthexapod")
    parser.add_argument("--config", type=Path, help="clone of ts_config_mttcs: elevation and rotation (optional)")
    args = parser.parse_args(arguments)
    wanted = [args.folder / name for name in TABLES.values()]
    wanted += [] if args.config is None else [args.config / POLYNOMIALS]
    if missing := [str(path) for path in wanted if not path.is_file()]:
        sources = "github.com/lsst-ts/ts_mthexapod and github.com/lsst-ts/ts_config_mttcs"
        return cannot_run(f"{', '.join(missing)} is missing; clone {sources}, and give their folders")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        geometry, _ = of_zoo("mirror")  # as large as M2's hexapod
        geometry = replace(geometry, limits=replace(geometry.limits, correction=0.02))
        met = [finite_elements(name, args.folder / file, geometry, folder) for name, file in TABLES.items()]
        if args.config is not None:
            content = yaml.safe_load((args.config / POLYNOMIALS).read_text(encoding="utf-8"))
            for name, key in (("M2", "m2_config"), ("camera", "camera_config")):
                met.append(laser_and_sky(name, content[key]["elevation_rotation_coeffs"], geometry, folder))
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
