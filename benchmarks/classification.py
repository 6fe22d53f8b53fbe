"""Classification of single errors: every pose of a workspace × every single error, exact, and who else could do it.

The effect of 48 single errors (lengths of six struts, their screws' pitch, 18 coordinates of base joints, 18
of platform joints) at random poses about home, solved by our core, by the iteration of v. Daake et al.
(Python, 0.01 mm a step, as the paper has it) and by a batch Newton in NumPy. The slow ones get a few of the
same poses, and their time counts per effect.

Usage: python -m benchmarks.classification [--poses 100000] [--json]

Exits 1 when a bar is missed: 1,000 × the paper's iteration, 10 × NumPy, at most 1 GB of memory.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.pose import rotation_from_angles
from hexapod_comp.workspace.budget import BASE_JOINT, LENGTH, PLATFORM_JOINT, Budget, SingleErrors
from hexapod_comp.workspace.effects import ITERATION, Extremes, effect_vectors, extremes, merged

CONFIG = Path(__file__).resolve().parents[1] / "config"

SIZES = {
    "strut_length": 7e-6,
    "screw_pitch": 20e-6,
    "base_joint_xy": 10e-6,
    "base_joint_z": 10e-6,
    "platform_joint_xy": 10e-6,
    "platform_joint_z": 10e-6,
}
"""v. Daake et al.'s sizes of their error types: 48 single errors."""

CHUNK = 65_536
"""Poses handed over at once."""

ITERATION_BAR, NUMPY_BAR, MEMORY_BAR = 1000.0, 10.0, 1e9

ITERATION_POSES, NUMPY_POSES = 4, 2000

NEWTON_STEPS, NEWTON_SETTLED = 10, 1e-12

AGREEMENT = 1e-3
"""Largest relative difference to the others, of the largest effect at a pose: the issue's bar for the iteration."""


@dataclass(frozen=True)
class Result:
    """One way of getting the effects; `difference` is the largest one to ours, relative to the pose's largest."""

    name: str
    poses: int
    seconds: float
    us_per_effect: float
    times_ours: float
    difference: float


def chunks(geometry: HexapodGeometry, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Draw poses about home, ±20 mm and ±8°, chunk by chunk: the same ones every time."""
    rng = np.random.default_rng(4)
    for start in range(0, count, CHUNK):
        rows = min(CHUNK, count - start)
        turns = rotation_from_angles(np.deg2rad(rng.uniform(-8.0, 8.0, (rows, 3))))
        yield geometry.home.position + rng.uniform(-0.02, 0.02, (rows, 3)), turns @ geometry.home.rotation


def classify(geometry: HexapodGeometry, errors: SingleErrors, count: int) -> tuple[Extremes, float]:
    """Return the extremes over all poses, and the seconds that they took, drawing the poses left out."""
    seconds, first = 0.0, 0
    parts: Extremes | None = None
    with tqdm(total=count, unit="pose", disable=not sys.stderr.isatty()) as bar:
        for positions, rotations in chunks(geometry, count):
            start = time.perf_counter()
            part = extremes(geometry, errors, positions, rotations, first=first)
            parts = part if parts is None else merged([parts, part])
            seconds += time.perf_counter() - start
            first += len(positions)
            bar.update(len(positions))
    if parts is None:
        raise SystemExit("no poses")
    return parts, seconds


def by_iteration(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray
) -> np.ndarray:
    """Return the effects by the paper's iteration, shape (N, E, 6)."""
    return effect_vectors(geometry, errors, positions, rotations, ITERATION)


def by_numpy(
    geometry: HexapodGeometry, errors: SingleErrors, positions: np.ndarray, rotations: np.ndarray
) -> np.ndarray:
    """Return the effects by Newton on all poses at once in NumPy, error by error, shape (N, E, 6)."""
    arms = np.einsum("nij,kj->nki", rotations, geometry.platform_joints)
    nominal = np.linalg.norm(positions[:, None] + arms - geometry.base_joints, axis=2)
    result = np.empty((len(positions), len(errors), 6))
    for e in range(len(errors)):
        base, platform, lengths = geometry.base_joints.copy(), geometry.platform_joints.copy(), nominal.copy()
        strut, vector = errors.struts[e], errors.vector[e]
        if errors.part[e] == LENGTH:
            lengths[:, strut] += vector[0]
        elif errors.part[e] == BASE_JOINT:
            base[strut] += vector
        elif errors.part[e] == PLATFORM_JOINT:
            platform[strut] += vector
        p, r = _newton(base, platform, lengths, positions, rotations)
        tips = p + r @ geometry.tool.position - positions - rotations @ geometry.tool.position
        result[:, e] = np.hstack([tips, _rotation_vectors(r @ rotations.swapaxes(1, 2))]) @ _in_work(geometry)
    return result


def _newton(
    base: np.ndarray, platform: np.ndarray, lengths: np.ndarray, p: np.ndarray, r: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses (N, 3), (N, 3, 3) of a machine with these lengths (N, 6), from nearby ones."""
    for _ in range(NEWTON_STEPS):
        arms = np.einsum("nij,kj->nki", r, platform)
        struts = p[:, None] + arms - base
        now = np.linalg.norm(struts, axis=2)
        u = struts / now[..., None]
        rows = np.concatenate([u, np.cross(arms, u)], axis=2)
        step = np.linalg.solve(rows, (lengths - now)[..., None])[..., 0]
        p, r = p + step[:, :3], _turns(step[:, 3:]) @ r
        if np.abs(step).max() < NEWTON_SETTLED:
            break
    return p, r


def _turns(w: np.ndarray) -> np.ndarray:
    """Return exp(w) of rotation vectors (N, 3)."""
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    skew = np.zeros((len(w), 3, 3))
    skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = w.T
    skew -= skew.swapaxes(1, 2)
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * skew @ skew


def _rotation_vectors(r: np.ndarray) -> np.ndarray:
    """Return the rotation vectors of small rotations (N, 3, 3)."""
    return 0.5 * np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)


def _in_work(geometry: HexapodGeometry) -> np.ndarray:
    """Return what turns (displacement, rotation vector) rows from ``base`` into the work frame's axes."""
    return np.kron(np.eye(2), geometry.work.rotation)


def beside(
    name: str,
    run: Callable[[HexapodGeometry, SingleErrors, np.ndarray, np.ndarray], np.ndarray],
    geometry: HexapodGeometry,
    errors: SingleErrors,
    count: int,
    ours: float,
) -> Result:
    """Time another way on the first poses and compare its effects with ours; `ours` in µs per effect."""
    positions, rotations = (rows[:count] for rows in next(chunks(geometry, CHUNK)))
    start = time.perf_counter()
    effects = run(geometry, errors, positions, rotations)
    seconds = time.perf_counter() - start
    right = effect_vectors(geometry, errors, positions, rotations)
    parts = [slice(0, 3), slice(3, 6)]
    off = [np.abs(effects - right)[..., p].max() / np.abs(right[..., p]).max() for p in parts]
    us = 1e6 * seconds / (count * len(errors))
    return Result(name, count, seconds, us, us / ours, float(max(off)))


def table(results: list[Result]) -> str:
    """Return the results as text."""
    lines = [f"{'by':24} {'poses':>10} {'s':>9} {'µs/effect':>10} {'× ours':>8} {'difference':>10}"]
    for r in results:
        times = f"{r.seconds:9.2f} {r.us_per_effect:10.3f} {r.times_ours:8.0f}"
        lines.append(f"{r.name:24} {r.poses:10,} {times} {r.difference:10.1e}")
    return "\n".join(lines)


def main() -> int:
    """Measure, print, and say whether all bars were met."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.classification", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--poses", type=int, default=100_000, help="poses (default 100000)")
    parser.add_argument("--json", action="store_true", help="for programs")
    args = parser.parse_args()
    if args.poses < 1:
        parser.error(f"--poses must be at least 1, not {args.poses}")
    geometry = load_geometry(CONFIG / "positioning_unit.yaml")
    errors = Budget(geometry.name, SIZES).single_errors(geometry)
    classify(geometry, errors, 1)  # compiles, which is not measured
    found, seconds = classify(geometry, errors, args.poses)
    memory = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    us = 1e6 * seconds / (args.poses * len(errors))
    results = [
        Result("hexapod_comp", args.poses, seconds, us, 1.0, 0.0),
        beside("iteration of v. Daake et al.", by_iteration, geometry, errors, ITERATION_POSES, us),
        beside("NumPy batch Newton", by_numpy, geometry, errors, NUMPY_POSES, us),
    ]
    failed = int(found.failed.sum())
    if args.json:
        figures = {"errors": len(errors), "failed": failed, "memory_mb": memory / 1e6}
        print(json.dumps({**figures, "results": [asdict(r) for r in results]}, ensure_ascii=False))
    else:
        print(f"{args.poses:,} poses × {len(errors)} single errors, {failed} without a solution")
        print(table(results))
        print(f"largest memory of the process up to there: {memory / 1e6:.0f} MB")
    fast = results[1].times_ours >= ITERATION_BAR and results[2].times_ours >= NUMPY_BAR
    agree = max(r.difference for r in results) <= AGREEMENT
    return int(not (fast and agree and failed == 0 and memory <= MEMORY_BAR))


if __name__ == "__main__":
    sys.exit(main())
