"""Time batches of kinematics as users call them beside one thread: the clock's time and the processor's.

Run ``python -m benchmarks.batches``. Both get the same poses in turn, so that a busy second
hits both alike. Exits 1 when the default is slower than one thread.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hexapod_comp.machine.kinematics import solve_poses, strut_lengths_batch

from . import judged, table
from .poses import WIDE, Poses, make_poses

SIZES = (1_000, 10_000, 20_000, 100_000, 1_000_000, 10_000_000)
DISTINCT = 20_000  # Different poses; larger batches repeat them

SECONDS = {"inverse": 5e-8, WIDE: 5e-7}  # A pose's time, roughly, from which the number of rounds follows

FEWEST, MOST = 7, 201  # Rounds of a size. An odd number has a median that was measured.

BAR = 1.05  # The default's median must not be above one thread's by more: that is how well equal runs repeat


@dataclass(frozen=True)
class Row:
    """Times per pose, ns: one thread, then the default; medians, the ratio that of the rounds' ratios."""

    task: str
    poses: int
    rounds: int
    best: tuple[float, float]
    median: tuple[float, float]
    processor: tuple[float, float]
    ratio: float


def timed(call: Callable[[int | None], object], threads: int | None) -> tuple[float, float]:
    """Return the clock's time and the processor time of all threads of one call, s."""
    clock, processor = time.perf_counter(), time.process_time()
    call(threads)
    return time.perf_counter() - clock, time.process_time() - processor


def repeated(poses: Poses, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `count` positions, rotations and lengths."""
    which = np.arange(count) % len(poses.positions)
    return poses.positions[which], poses.rotations[which], poses.lengths[which]


def measure_size(poses: Poses, task: str, count: int, seconds: float) -> Row:
    """Time one task on batches of one size, for about so many seconds."""
    positions, rotations, lengths = repeated(poses, count)

    def call(threads: int | None) -> object:
        if task == "inverse":
            return strut_lengths_batch(poses.structure, positions, rotations, threads)
        return solve_poses(poses.structure, lengths, poses.home, threads)

    call(1)  # compiles
    rounds = int(np.clip(seconds / (2.0 * count * SECONDS[task]), FEWEST, MOST)) // 2 * 2 + 1
    taken = np.empty((rounds, 2, 2))
    for n in range(rounds):
        for which in (0, 1) if n % 2 else (1, 0):
            taken[n, which] = timed(call, (1, None)[which])
    clock, processor = np.moveaxis(taken, 2, 0) / count * 1e9
    return Row(
        task,
        count,
        rounds,
        (float(clock[:, 0].min()), float(clock[:, 1].min())),
        (statistics.median(clock[:, 0]), statistics.median(clock[:, 1])),
        (statistics.median(processor[:, 0]), statistics.median(processor[:, 1])),
        statistics.median(clock[:, 1] / clock[:, 0]),
    )


def measure(most: int = SIZES[-1], seconds: float = 4.0) -> list[Row]:
    """Time both tasks on all sizes up to `most`."""
    poses = make_poses(DISTINCT)
    return [measure_size(poses, task, n, seconds) for task in SECONDS for n in SIZES if n <= most]


def report(rows: list[Row]) -> str:
    """Return the table of times; ns per pose."""
    columns = ["task", "poses", "best: one", "default", "median: one", "default", "processor: one", "default", "ratio"]
    pairs = ([f"{ns:.1f}" for pair in (r.best, r.median, r.processor) for ns in pair] for r in rows)
    return table(
        columns, ([r.task, f"{r.poses:,}", *six, f"{r.ratio:.2f}"] for r, six in zip(rows, pairs, strict=True))
    )


def problems(rows: list[Row]) -> list[str]:
    """Return where the default is slower than one thread."""
    slow = (r for r in rows if r.ratio > BAR)
    return [f"{r.task}, {r.poses:,} poses: the default takes {r.ratio:.2f} × one thread's time" for r in slow]


def main() -> int:
    """Print the table; exit 1 when the default is slower."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most", type=int, default=SIZES[-1], help="largest batch, 3 GB (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=4.0, help="for each size, about (default %(default)s)")
    options = parser.parse_args()
    rows = measure(options.most, options.seconds)
    print(report(rows))
    return judged(problems(rows))


if __name__ == "__main__":
    sys.exit(main())
