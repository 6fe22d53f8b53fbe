"""Which measured runs a standard judges, and each standard's figures under its own name.

Lines along an axis of the work frame: ISO 230-2. Lines across the axes, as body and face diagonals: ISO 230-6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from .iso230 import PositioningTest, evaluate, report
from .readings import BACKWARD, CHANNELS, FORWARD, MeasurementSet

AXES_STANDARD, DIAGONALS_STANDARD = "ISO 230-2:2014", "ISO 230-6:2002"

ALONG = 1e-6
"""A line whose direction has a component below this does not travel along that axis."""

BODY, FACE = "body", "face"

LINEAR = CHANNELS.index("linear")

COLUMNS = {"A": "A", "E": "E", "R": "R", "M": "M", "B": "B", "B_mean": "B̄"}
"""Figures of both directions together, and how they are printed."""


@dataclass(frozen=True)
class LinearRun:
    """A linear run as ISO 230-2 and 230-6 want it.

    Attributes
    ----------
    name : str
        Of the run.
    axes : tuple of int
        Along which axes of the work frame it travels: one, or more for a diagonal.
    targets : ndarray, shape (m,)
        Commanded coordinates along the line, rising, m.
    deviations : ndarray, shape (2, cycles, m)
        Readings, forward and backward, m.
    """

    name: str
    axes: tuple[int, ...]
    targets: np.ndarray
    deviations: np.ndarray


@dataclass(frozen=True)
class Judged:
    """Figures of all runs that a standard judges, by the runs' names.

    Attributes
    ----------
    axes : dict of str to PositioningTest
        Lines along an axis: ISO 230-2.
    diagonals : dict of str to dict of str to PositioningTest
        ``body`` and ``face`` diagonals: ISO 230-6.
    """

    axes: dict[str, PositioningTest]
    diagonals: dict[str, dict[str, PositioningTest]]

    def __bool__(self) -> bool:
        return bool(self.axes or self.diagonals)


def judge(measurements: MeasurementSet) -> Judged:
    """Return the figures of the runs that a standard can judge: the others are left out."""
    axes: dict[str, PositioningTest] = {}
    diagonals: dict[str, dict[str, PositioningTest]] = {}
    for run in linear_runs(measurements):
        kind = None if len(run.axes) == 1 else BODY if len(run.axes) == 3 else FACE
        group = axes if kind is None else diagonals.setdefault(kind, {})
        group[run.name] = evaluate(run.targets, run.deviations)
    return Judged(axes, diagonals)


def linear_runs(measurements: MeasurementSet) -> list[LinearRun]:
    """Return the linear runs that can be judged: two cycles or more, every target from both sides in each.

    Runs with fewer cycles, gaps or without both directions are left out.
    """
    points = measurements.points()[measurements.station]
    runs = []
    for index, run in enumerate(measurements.runs):
        chosen = np.flatnonzero((measurements.run == index) & (measurements.channel == LINEAR))
        table: dict[tuple[int, int], dict[float, float]] = {}
        for n in chosen:
            pass_of = (int(measurements.direction[n]), int(measurements.cycle[n]))
            target = round(float(points[n] @ run.axis), 9) + 0.0
            table.setdefault(pass_of, {})[target] = float(measurements.value[n])
        in_work = measurements.geometry.work.rotation.T @ run.axis
        axes = tuple(np.flatnonzero(np.abs(in_work) > ALONG).tolist())
        complete = _complete_run(run.name, axes, table)
        if complete is not None:
            runs.append(complete)
    return runs


def _complete_run(
    name: str, axes: tuple[int, ...], table: dict[tuple[int, int], dict[float, float]]
) -> LinearRun | None:
    """Return a run from {(direction, cycle): {target: reading}} if nothing is missing in it."""
    cycles = sorted({cycle for _, cycle in table})
    passes = {(direction, cycle) for direction in (FORWARD, BACKWARD) for cycle in cycles}
    if len(cycles) < 2 or set(table) != passes:
        return None
    targets = sorted(table[FORWARD, cycles[0]])
    if any(sorted(readings) != targets for readings in table.values()):
        return None
    deviations = [[[table[d, c][t] for t in targets] for c in cycles] for d in (FORWARD, BACKWARD)]
    return LinearRun(name, axes, np.array(targets), np.array(deviations))


def standards_text(judged: Judged) -> str:
    """Return the figures of all runs, a table for each standard, µm."""
    parts = []
    if judged.axes:
        parts.append(f"{AXES_STANDARD}, lines along the axes, both directions\n{table(judged.axes)}")
    for kind, tests in judged.diagonals.items():
        worst = ", ".join(f"{name} {number(value * 1e6, 3)} µm" for name, value in largest(tests).items())
        title = f"{DIAGONALS_STANDARD}, {kind} diagonals, both directions"
        parts.append(f"{title}\n{table(tests)}\nlargest of the {len(tests)}: {worst}")
    return "\n\n".join(parts)


def largest(tests: Mapping[str, PositioningTest]) -> dict[str, float]:
    """Return ISO 230-6's figures of diagonals of one kind together, m: ``E_d`` and ``B_d``, the largest of them."""
    both = [test.figures() for test in tests.values()]
    return {f"{name}_d": max(figures[name] for figures in both) for name in ("E", "B")}


def table(tests: Mapping[str, PositioningTest]) -> str:
    """Return the figures of several bidirectional tests, one row each, µm."""
    header = ("run", "targets", "cycles", *COLUMNS.values(), "")
    rows = []
    for name, test in tests.items():
        figures = test.figures()
        cells = [number(figures[key] * 1e6, 3) for key in COLUMNS]
        rows.append((name, str(len(test.targets)), str(test.cycles), *cells, "um"))
    return aligned(header, rows)


def every_target(judged: Judged) -> str:
    """Return each run target by target, with notes."""
    parts = [f"{name}\n{report(test, AXES_STANDARD)}" for name, test in judged.axes.items()]
    for tests in judged.diagonals.values():
        parts += [f"{name}\n{report(test, DIAGONALS_STANDARD)}" for name, test in tests.items()]
    return "\n\n".join(parts)


def standards_json(judged: Judged) -> dict[str, Any]:
    """Return the figures as plain numbers by standard and run, with their unit in the keys: ``A_m``, ``E_up_m``, …"""
    result: dict[str, Any] = {}
    if judged.axes:
        result["iso230_2"] = {name: with_units(test.figures()) for name, test in judged.axes.items()}
    if judged.diagonals:
        kinds = judged.diagonals.items()
        figures = {kind: {name: with_units(test.figures()) for name, test in tests.items()} for kind, tests in kinds}
        result["iso230_6"] = {**figures, "largest": {kind: with_units(largest(tests)) for kind, tests in kinds}}
    return result


def with_units(figures: Mapping[str, float]) -> dict[str, float]:
    """Return lengths with their unit in the keys."""
    return {f"{name}_m": value for name, value in figures.items()}
