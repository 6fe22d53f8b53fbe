"""What the benchmarks share that judge many drawn machines: the zoo, options, one process a core, results by case."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from tqdm import tqdm

from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry

from . import table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))
from foreign_machines import Machine, machines

BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])  # that the paper's machine is measured in, m
Case = TypeVar("Case")
Result = TypeVar("Result")


def of_zoo(name: str) -> tuple[HexapodGeometry, Machine]:
    """Return a machine of test/foreign_machines.py, its geometry read from a file as users have it."""
    machine = machines()[name]
    with TemporaryDirectory() as folder:
        return load_geometry(machine.write(Path(folder) / "geometry.yaml")), machine


def options(doc: str | None, machines: int, first: int = 1, of: str = "case") -> argparse.ArgumentParser:
    """Return the parser of a benchmark: how many machines, the seed of the first, and how many processes."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--machines", type=int, default=machines, help=f"machines of each {of} (default {machines})")
    parser.add_argument("--first", type=int, default=first, help=f"seed of the first machine (default {first})")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    return parser


def each(run: Callable[..., Result], tasks: Sequence[tuple], workers: int) -> Iterator[Result]:
    """Yield what comes of each task in its order, one process a core, with the progress."""
    # A library's own threads would only be in each other's way.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    with pool, tqdm(total=len(tasks), disable=None) as bar:
        for result in pool.map(run, *zip(*tasks, strict=True)) if tasks else ():
            yield result
            bar.update()


def results(
    of_machine: Callable[[Case, int], Result], cases: Sequence[Case], args: argparse.Namespace
) -> Iterator[tuple[Case, list[Result]]]:
    """Yield each case with what came of its machines, as soon as all of them are done."""
    seeds = range(args.first, args.first + args.machines)
    found = each(of_machine, [(case, seed) for case in cases for seed in seeds], args.workers)
    for case in cases:
        yield case, [next(found) for _ in seeds]


class Table:
    """A table in Markdown that is printed row by row, above the progress; `met`: whether all bars are."""

    def __init__(self, columns: Sequence[str], texts: int = 1) -> None:
        self.met = True
        show(table(columns, [], texts))

    def row(self, *cells: object, met: bool = True) -> None:
        """Print a row."""
        self.met &= met
        show(f"| {' | '.join(map(str, cells))} |")


def show(text: str) -> None:
    """Print above the progress."""
    tqdm.write(text)
    sys.stdout.flush()


def verdict(bar: float, met: bool) -> str:
    """Return a bar, a share, and whether it is met."""
    return f"{bar:.0%} {'met' if met else 'MISSED'}"
