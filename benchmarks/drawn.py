"""Shared code of benchmarks on many machines: foreign machines, options, parallel processes, tables."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from numpy.polynomial import polynomial
from tqdm import tqdm

from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.virtual.imperfections import seeded
from hexapod_comp.workspace.study import process_pool

from . import table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))
from calibration_helpers import joined as joined
from foreign_machines import Machine, machines

BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])  # measured box of the paper's machine, m
Case = TypeVar("Case")
Result = TypeVar("Result")


def of_zoo(name: str) -> tuple[HexapodGeometry, Machine]:
    """Return a machine of test/foreign_machines.py and the geometry that is read from its file."""
    machine = machines()[name]
    with TemporaryDirectory() as folder:
        return load_geometry(machine.write(Path(folder) / "geometry.yaml")), machine


# A test of the calibration needs errors that do not consist of the calibration's own terms: sine waves in space
FIELD_WAVES = 6  # waves in each component of a wavy field
FIELD_NODES, FIELD_POWERS = 17, 12  # lines of a wavy field along y and z; coefficients along x


def with_wavy_field(
    model: MachineModel,
    box: np.ndarray,
    seed: int,
    displacement: float = 5e-6,
    rotation: float = 30e-6,
    waves: tuple[float, float] = (0.4, 0.8),
) -> MachineModel:
    """Add a smooth pose error that is a sum of sine waves in space, equal in both directions of motion."""
    rng = seeded(seed, "field")
    vectors = rng.standard_normal((6, FIELD_WAVES, 3))
    vectors *= 2.0 * np.pi / (np.linalg.norm(vectors, axis=2) * rng.uniform(*waves, (6, FIELD_WAVES)))[..., None]
    phases = rng.uniform(0.0, 2.0 * np.pi, (6, FIELD_WAVES))

    def waves_at(points: np.ndarray) -> np.ndarray:
        return np.sin(np.einsum("...i,cwi->...cw", points, vectors) + phases).sum(axis=-1)

    x, y, z = (np.linspace(box[0, a], box[1, a], FIELD_NODES) for a in range(3))
    u = np.polynomial.chebyshev.chebpts2(4 * FIELD_POWERS)
    along = x[0] + 0.5 * (u + 1.0) * (x[-1] - x[0])
    points = np.stack(np.meshgrid(y, z, along, indexing="ij"), axis=-1)[..., [2, 0, 1]]
    values = waves_at(points)
    centres = (0.5 * (nodes[1:] + nodes[:-1]) for nodes in (x, y, z))
    even = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1)
    size = np.sqrt((waves_at(even) ** 2).mean(axis=(0, 1, 2)))
    values *= np.repeat([displacement, rotation], 3) / size
    flat = np.moveaxis(values, 2, 0).reshape(len(u), -1)
    fitted = polynomial.polyfit(u, flat, FIELD_POWERS - 1)
    lines = np.moveaxis(fitted.reshape(FIELD_POWERS, *values.shape[:2], 6), 0, -1)
    empty = np.zeros((2, 2, FIELD_NODES, 6, 0))
    return replace(model, field=GridField((x[[0, -1]], y, z), (np.stack([lines, lines]), empty, empty)))


def options(doc: str | None, machines: int, first: int = 1, of: str = "case") -> argparse.ArgumentParser:
    """Return a parser for the number of machines, the seed of the first machine and the number of processes."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--machines", type=int, default=machines, help=f"machines of each {of} (default {machines})")
    parser.add_argument("--first", type=int, default=first, help=f"seed of the first machine (default {first})")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: all cores)")
    return parser


def each(run: Callable[..., Result], tasks: Sequence[tuple], workers: int) -> Iterator[Result]:
    """Yield the results of the tasks in order, from `workers` processes, with a progress bar."""
    # One thread per process: the threads of a library would compete for the same cores
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    with process_pool(workers) as pool, tqdm(total=len(tasks), disable=None) as bar:
        for result in pool.map(run, *zip(*tasks, strict=True)) if tasks else ():
            yield result
            bar.update()


def results(
    of_machine: Callable[[Case, int], Result], cases: Sequence[Case], args: argparse.Namespace
) -> Iterator[tuple[Case, list[Result]]]:
    """Yield each case with its machines' results as soon as all of them are done."""
    seeds = range(args.first, args.first + args.machines)
    found = each(of_machine, [(case, seed) for case in cases for seed in seeds], args.workers)
    for case in cases:
        yield case, [next(found) for _ in seeds]


class Table:
    """A Markdown table, printed row by row above the progress bar; `met` is False after a missed target."""

    def __init__(self, columns: Sequence[str], texts: int = 1) -> None:
        self.met = True
        show(table(columns, [], texts))

    def row(self, *cells: object, met: bool = True) -> None:
        self.met &= met
        show(f"| {' | '.join(map(str, cells))} |")


def show(text: str) -> None:
    tqdm.write(text)
    sys.stdout.flush()


def verdict(target: float, met: bool) -> str:
    return f"{target:.0%} {'met' if met else 'MISSED'}"
