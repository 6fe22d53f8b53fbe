"""Forward kinematics without a guess: how often a pose is lost or wrongly picked, how many modes, how long.

Every machine stands in a known pose; its strut lengths alone are given to ``assembly_modes`` and
``working_mode``. A pose that is not among the modes is lost. Where the pose keeps the machine's own limits,
another pose as the answer is a wrong pick; a refusal is counted beside, for it harms nobody.

Usage: python -m benchmarks.assembly [--count 1000] [--seed 1]

Exits 1 when any pose was lost (but on the row of real structures near a singular pose, where
``assembly_modes`` says that it may) or any pick was wrong.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.errors import OtherAssemblyModeError
from hexapod_comp.machine.assembly import assembly_modes, mode_objections, working_mode
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure, strut_lengths
from hexapod_comp.pose import Pose

from . import table

PAPER = Path(__file__).resolve().parents[1] / "config" / "paper.yaml"

# m and rotation matrix entries; below, a mode is the pose: a pair of modes that are nearer to each other than
# 1e-6 of a strut counts as one, which on the paper's machine is a turn of 3e-6
FOUND = 1e-5

NO_LIMIT = 1e9  # Largest condition number of a machine that has no limits: then nothing is picked either

DESCRIPTION = (__doc__ or "").splitlines()[0]

MAY_LOSE = "paper ±10 µm, off singular"

Case = tuple[Structure, Pose]


@dataclass(frozen=True)
class Result:
    """What became of one kind of pose; times of ``assembly_modes`` in ms."""

    kind: str
    poses: int
    lost: int
    workable: int
    wrong_picks: int
    refused: int
    modes: str
    ms_median: float
    ms_worst: float


def cases(geometry: HexapodGeometry) -> dict[str, Callable[[np.random.Generator], Case]]:
    """Return what draws a machine and the pose in which it stands, per kind."""
    paper = Structure.of(geometry)

    def real(structure: Structure, deviation: float, rng: np.random.Generator) -> Structure:
        return structure.moved(*rng.uniform(-deviation, deviation, (2, 6, 3)))

    def workspace(rng: np.random.Generator) -> Pose:
        position = geometry.home.position + rng.uniform(-0.05, 0.05, 3)
        return Pose.from_angles(position, np.deg2rad(rng.uniform(-30.0, 30.0, 3)))

    def near_singular(rng: np.random.Generator) -> Pose:
        turn = 90.0 + 10.0 ** rng.uniform(-9.0, 0.0)  # Fichter's singular poses are turned by 90° about z
        return Pose.from_angles([*rng.uniform(-0.05, 0.05, 2), 0.4], np.deg2rad([0.0, 0.0, turn]))

    return {
        "paper, ±50 mm, ±30°": lambda rng: (paper, workspace(rng)),
        "paper, joints ±10 µm": lambda rng: (real(paper, 1e-5, rng), workspace(rng)),
        "paper, joints ±0.5 mm": lambda rng: (real(paper, 5e-4, rng), workspace(rng)),
        "paper, 1e-9…1° off singular": lambda rng: (paper, near_singular(rng)),
        MAY_LOSE: lambda rng: (real(paper, 1e-5, rng), near_singular(rng)),
        "random, planar base": lambda rng: (random_structure(rng, 0.0), random_pose(rng)),
        "random, base in space": lambda rng: (random_structure(rng, 1.0), random_pose(rng)),
        "random, joints ±0.1 mm": lambda rng: (real(random_structure(rng, 1.0), 1e-4, rng), random_pose(rng)),
    }


def random_structure(rng: np.random.Generator, height: float) -> Structure:
    """Draw a 6-3 machine with joints anywhere; `height` 0 keeps the base in a plane."""
    base = rng.normal(0.0, 0.3, (6, 3)) * [1.0, 1.0, height]
    return Structure(base, np.repeat(rng.normal(0.0, 0.2, (3, 3)), 2, axis=0), 0.2, 1.0, NO_LIMIT, Pose.identity())


def random_pose(rng: np.random.Generator) -> Pose:
    """Draw a pose, turned by a radian or two."""
    return Pose(rng.normal(0.0, 0.4, 3), Rotation.from_rotvec(rng.normal(0.0, 1.0, 3)).as_matrix())


def same(one: Pose, other: Pose) -> bool:
    """Return whether two poses agree within :data:`FOUND`."""
    shift, turn = np.abs(one.position - other.position).max(), np.abs(one.rotation - other.rotation).max()
    return bool(max(shift, turn) < FOUND)


def measure(
    kind: str, draw: Callable[[np.random.Generator], Case], geometry: HexapodGeometry, count: int, seed: int
) -> Result:
    """Run one kind of pose; the same poses for the same seed."""
    rng = np.random.default_rng(seed)
    lost = workable = wrong = refused = 0
    modes_found, seconds = [], []
    for _ in range(count):
        structure, pose = draw(rng)
        lengths = strut_lengths(structure, pose)
        start = time.perf_counter()
        modes = assembly_modes(structure, lengths)
        seconds.append(time.perf_counter() - start)
        modes_found.append(len(modes))
        lost += not any(same(pose, mode) for mode in modes)
        if structure.max_condition == NO_LIMIT or mode_objections(geometry, structure, pose):
            continue
        workable += 1
        try:
            wrong += not same(pose, working_mode(geometry, structure, lengths))
        except OtherAssemblyModeError:
            refused += 1
    found, ms = np.array(modes_found), 1e3 * np.array(seconds)
    modes = f"{found.min()}/{found.mean():.2f}/{found.max()}"
    return Result(kind, count, lost, workable, wrong, refused, modes, float(np.median(ms)), float(ms.max()))


def report(results: list[Result]) -> str:
    """Return the table of results."""
    columns = ["kind", "poses", "lost", "workable", "wrong", "refused", "modes min/mean/max", "ms median/worst"]
    rows = (
        (r.kind, r.poses, r.lost, r.workable, r.wrong_picks, r.refused, r.modes, f"{r.ms_median:.2f}/{r.ms_worst:.1f}")
        for r in results
    )
    return table(columns, rows)


def main() -> int:
    """Measure every kind and say whether all poses were found."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.assembly", description=DESCRIPTION)
    parser.add_argument("--count", type=int, default=1000, help="poses per kind (default 1000)")
    parser.add_argument("--seed", type=int, default=1, help="of the machines and poses (default 1)")
    args = parser.parse_args()
    if args.count < 1:
        parser.error(f"--count must be at least 1, not {args.count}")
    geometry = load_geometry(PAPER)
    structure = Structure.of(geometry)
    assembly_modes(structure, strut_lengths(structure, geometry.home))  # compiles, which is not measured
    results = [measure(kind, draw, geometry, args.count, args.seed) for kind, draw in cases(geometry).items()]
    print(report(results))
    return int(any(r.wrong_picks or (r.lost and r.kind != MAY_LOSE) for r in results))


if __name__ == "__main__":
    sys.exit(main())
