"""Time inverse and forward kinematics beside what else people use, on the same poses in one run.

Run ``python -m benchmarks.kernels``. doc/benchmarks.md says what the columns mean.
MuJoCo, Pinocchio and LinuxCNC are optional: a peer that is not installed is said to be missing. Exits 1 when a bar
is missed, or somebody's numbers differ from ours.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from hexapod_comp.core import batch, lib
from hexapod_comp.machine.kinematics import solve_pose, solve_poses, strut_lengths, strut_lengths_batch
from hexapod_comp.pose import Pose

from . import genhexkins, judged, peers, table
from .poses import NEAR, OURS, WIDE, Contender, Poses, joined, make_poses, near_poses

TOLERANCE = 1e-9  # Peers whose numbers differ from ours by more, m or rotation matrix entries, compute something else

LOOSE_TOLERANCE = 1e-6  # … and those that were told to end early

# How many times faster than genhexkins ours must be, with any of its two criteria
BARS = {
    ("inverse", "batch"): 4.0,
    (WIDE, "batch"): 4.0,
    (NEAR, "batch"): 4.0,
    (WIDE, "single"): 1.3,
    (NEAR, "single"): 1.3,
}


@dataclass(frozen=True)
class Result:
    """Median time per pose, how many times ours that is, and the largest difference to our numbers."""

    task: str
    name: str
    shape: str
    us_per_pose: float
    times_ours: float
    max_difference: float


# --- ours --------------------------------------------------------------------------------------------------


def _rows(shape: str, *arrays: np.ndarray) -> list[list[Any]]:
    """Return what the core takes of each pose alone, or of all at once: their number, and checked places."""
    count = len(arrays[0])
    parts = [slice(n, n + 1) for n in range(count)] if shape == "single" else [slice(count)]
    return [[len(arrays[0][part]), *(_place(array[part]) for array in arrays)] for part in parts]


def _place(array: np.ndarray) -> Any:
    return batch.written("row", array, *array.shape, kind=array.dtype)


def our_inverse(poses: Poses, shape: str) -> list[Contender]:
    """Kernel and checked call, on one thread; on all of them: :mod:`.batches`."""
    structure, count = poses.structure, len(poses.positions)
    joints = [batch.given("joints", part, 6, 3) for part in (structure.base_joints, structure.platform_joints)]
    as_poses = [Pose(p, r) for p, r in zip(poses.positions, poses.rotations, strict=True)]
    lengths = np.empty((count, 6))
    rows = _rows(shape, poses.positions, poses.rotations, lengths)

    def kernel() -> None:
        for row in rows:
            lib.hc_strut_lengths_many(*joints, *row)

    def checked() -> np.ndarray:
        if shape == "single":
            return np.array([strut_lengths(structure, pose) for pose in as_poses])
        return strut_lengths_batch(structure, poses.positions, poses.rotations, threads=1)

    return [
        Contender("inverse", OURS, shape, count, kernel, lambda: lengths),
        Contender("inverse", f"{OURS}, checked", shape, count, checked),
    ]


def our_forward(task: str, poses: Poses, shape: str) -> list[Contender]:
    """Kernel and checked call, on one thread, every pose from home."""
    structure, home, count = poses.structure, poses.home, len(poses.positions)
    joints = [batch.given("joints", part, 6, 3) for part in (structure.base_joints, structure.platform_joints)]
    limits = structure.characteristic_length, structure.home_sign, structure.max_condition
    positions, rotations = np.empty((count, 3)), np.empty((count, 3, 3))
    rows = _rows(shape, poses.lengths, positions, rotations)
    results = _rows(shape, np.empty(count, np.intc), np.empty(count, np.intc), np.empty(count))

    def kernel() -> None:
        positions[:], rotations[:] = home.position, home.rotation
        for row, (_, *result) in zip(rows, results, strict=True):
            lib.hc_solve_pose_many(*joints, *row, *limits, *result)

    def checked() -> np.ndarray:
        if shape == "single":
            found = [solve_pose(structure, lengths, home) for lengths in poses.lengths]
            return joined(np.array([p.position for p in found]), np.array([p.rotation for p in found]))
        many = solve_poses(structure, poses.lengths, home, threads=1)
        return joined(many.positions, many.rotations)

    return [
        Contender(task, OURS, shape, count, kernel, lambda: joined(positions, rotations)),
        Contender(task, f"{OURS}, checked", shape, count, checked),
    ]


# --- the run -----------------------------------------------------------------------------------------------


def contenders(singles: int, batch: int) -> tuple[list[Contender], list[str]]:
    """Return everybody who takes part, and why others do not."""
    wide, near = make_poses(max(singles, batch)), near_poses(max(singles, batch))
    single, near_single, wide, near = wide.first(singles), near.first(singles), wide.first(batch), near.first(batch)
    found = [
        *our_inverse(single, "single"),
        peers.numpy_inverse(single, "single"),
        *our_inverse(wide, "batch"),
        peers.numpy_inverse(wide, "batch"),
        *our_forward(WIDE, single, "single"),
        peers.numpy_forward(single, "single"),
        peers.scipy_forward(single),
        *our_forward(WIDE, wide, "batch"),
        peers.numpy_forward(wide, "batch"),
        *our_forward(NEAR, near_single, "single")[:1],
        *our_forward(NEAR, near, "batch")[:1],
    ]
    missing = []
    for package, make in peers.OPTIONAL.items():
        try:
            found.append(make(single))
        except ImportError:
            missing.append(f"{package} is not installed: pip install {package}")
    try:
        found += genhexkins.contenders(single, wide, near_single, near)
    except genhexkins.NotHere as reason:
        missing.append(str(reason))
    return found, missing


def timed(one: Contender) -> float:
    """Run somebody once; return µs per pose, processor time."""
    start = time.thread_time()
    own = one.run()
    took = own if isinstance(own, float) else time.thread_time() - start
    return took / one.poses * 1e6


def numbers(one: Contender) -> np.ndarray:
    """Run somebody and return what they find."""
    found = one.run()
    return found if one.numbers is None else one.numbers()


def measure(everybody: list[Contender], repeats: int) -> list[Result]:
    """Run everybody in turn, `repeats` times, so that a busy second hits all alike; medians."""
    found = [numbers(one) for one in everybody]  # the first run compiles
    rounds = [[timed(one) for one in everybody] for _ in range(repeats)]
    ours = {(one.task, one.shape): i for i, one in enumerate(everybody) if one.name == OURS}
    results = []
    for i, one in enumerate(everybody):
        reference = ours[one.task, one.shape]
        times = [row[i] for row in rounds]
        ratio = statistics.median(row[i] / row[reference] for row in rounds)
        difference = float(np.abs(found[i] - found[reference]).max())
        results.append(Result(one.task, one.name, one.shape, statistics.median(times), ratio, difference))
    return sorted(results, key=lambda result: (result.task, result.shape, result.times_ours))


def report(results: list[Result]) -> str:
    """Return the table of times."""
    rows = (
        (r.task, r.shape, r.name, f"{r.us_per_pose:.3f}", f"{r.times_ours:.2f}", f"{r.max_difference:.1e}")
        for r in results
    )
    return table(["task", "shape", "who", "µs/pose", "× ours", "max difference"], rows, texts=3)


def problems(results: list[Result]) -> list[str]:
    """Return which bars were missed, and whose numbers differ from ours."""
    found = []
    for r in results:
        loose = r.name == genhexkins.LOOSE
        if not r.max_difference <= (LOOSE_TOLERANCE if loose else TOLERANCE):
            found.append(f"{r.task}, {r.shape}: the numbers of {r.name} differ from ours by {r.max_difference:.1e}")
        bar = BARS.get((r.task, r.shape), 0.0) if loose or r.name == genhexkins.NAME else 0.0
        if r.times_ours < bar:
            found.append(f"{r.task}, {r.shape}: {r.times_ours:.2f} × {r.name}, bar {bar:g} ×")
    return found


def main() -> int:
    """Print the table; exit 1 when a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=20_000, help="poses in a batch (default %(default)s)")
    parser.add_argument("--single", type=int, default=500, help="poses one by one (default %(default)s)")
    parser.add_argument("--repeats", type=int, default=15, help="runs of everybody (default %(default)s)")
    options = parser.parse_args()
    everybody, missing = contenders(options.single, options.batch)
    results = measure(everybody, options.repeats)
    print(report(results), *missing, sep="\n")
    return judged(problems(results))


if __name__ == "__main__":
    sys.exit(main())
