"""Which measured runs a standard judges, and each standard's figures under its own name.

Lines along an axis of the work frame: ISO 230-2. Lines across the axes, as body and face diagonals: ISO 230-6. Lengths
from the middle of a circle, as of a ball bar: ISO 230-4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from ..formats.texts import aligned, number
from .iso230 import PositioningTest, evaluate, report
from .iso230_circles import CircularTest, evaluate_circle
from .readings import BACKWARD, CHANNELS, FORWARD, LEAST_TRAVEL, LENGTH, MeasurementSet

AXES_STANDARD, DIAGONALS_STANDARD, CIRCLES_STANDARD = "ISO 230-2:2014", "ISO 230-6:2002", "ISO 230-4:2005"

ALONG = 1e-6
"""A line whose direction has a component below this does not travel along that axis."""

OFF_THE_MIDDLE = 0.01
"""A length's centre further than this, m, from a circle's is no ball bar's: it is known to some millimetres."""

BODY, FACE = "body", "face"

LINEAR = CHANNELS.index("linear")

COLUMNS = {"A": "A", "E": "E", "R": "R", "M": "M", "B": "B", "B_mean": "B̄"}
"""Figures of both directions together, and how they are printed."""

CIRCLE_COLUMNS = {
    "G_ccw": "G ↺",
    "G_cw": "G ↻",
    "G_b": "G(b)",
    "F_max_ccw": "Fmax ↺",
    "F_min_ccw": "Fmin ↺",
    "F_max_cw": "Fmax ↻",
    "F_min_cw": "Fmin ↻",
    "D": "D",
}
"""Figures of a circle, and how they are printed."""


@dataclass(frozen=True)
class LinearRun:
    """A linear run as ISO 230-2 and 230-6 want it."""

    name: str  # of the run
    axes: tuple[int, ...]  # along which axes of the work frame it travels: one, or more for a diagonal
    targets: np.ndarray  # (m,): commanded coordinates along the line, rising, m
    deviations: np.ndarray  # (2, cycles, m): readings, forward and backward, m


@dataclass(frozen=True)
class Judged:
    """Figures of all runs that a standard judges, by the runs' names."""

    axes: dict[str, PositioningTest]  # lines along an axis: ISO 230-2
    diagonals: dict[str, dict[str, PositioningTest]]  # ``body`` and ``face`` diagonals: ISO 230-6
    circles: dict[str, CircularTest]  # ISO 230-4

    def __bool__(self) -> bool:
        return bool(self.axes or self.diagonals or self.circles)


def judge(measurements: MeasurementSet) -> Judged:
    """Return the figures of the runs that a standard can judge: the others are left out."""
    axes: dict[str, PositioningTest] = {}
    diagonals: dict[str, dict[str, PositioningTest]] = {}
    for run in linear_runs(measurements):
        kind = None if len(run.axes) == 1 else BODY if len(run.axes) == 3 else FACE
        group = axes if kind is None else diagonals.setdefault(kind, {})
        group[run.name] = evaluate(run.targets, run.deviations)
    return Judged(axes, diagonals, circular_tests(measurements))


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


def circular_tests(measurements: MeasurementSet) -> dict[str, CircularTest]:
    """Return the figures of the runs of lengths whose points lie on a circle about their centre, by name.

    Others are left out, as are runs with too few readings. Senses are those of the rows' order, seen against that axis
    of the work frame which stands most upright on the circle.
    """
    points = measurements.points()[measurements.station]
    tests = {}
    for index, run in enumerate(measurements.runs):
        chosen = np.flatnonzero((measurements.run == index) & (measurements.channel == LENGTH))
        centres = measurements.centre[chosen]
        if len(chosen) < 3 or np.ptp(centres, axis=0).max() > LEAST_TRAVEL:
            continue
        circle = _circle(points[chosen], measurements.geometry.work.rotation)
        if circle is None or np.linalg.norm(circle.middle - centres[0]) > OFF_THE_MIDDLE:
            continue
        lengths = measurements.value[chosen] + np.linalg.norm(points[chosen] - centres, axis=1)
        height = float(circle.axis @ (centres[0] - circle.middle))
        given = lengths - np.hypot(circle.radius, height), _senses(circle.angles, measurements.cycle[chosen])
        try:
            tests[run.name] = evaluate_circle(circle.radius, circle.angles, *given, length_known=run.known_zero)
        except ModelError:  # too few readings of one sense
            continue
    return tests


class Circle(NamedTuple):
    """A circle in ``base``: middle and axis, shape (3,), radius, m, and where its points are, (N,), rad."""

    middle: np.ndarray
    axis: np.ndarray
    radius: float
    angles: np.ndarray


def _circle(points: np.ndarray, work_axes: np.ndarray) -> Circle | None:
    """Return the circle on which points (N, 3) lie; its axis points along an axis of the work frame, columns (3, 3)."""
    arms = points - points.mean(axis=0)
    _, sizes, ways = np.linalg.svd(arms, full_matrices=False)
    if sizes[1] < LEAST_TRAVEL:
        return None  # a line
    axis = ways[2] * np.sign(_longest(work_axes.T @ ways[2]))
    first = work_axes[:, int(np.abs(work_axes.T @ axis).argmax()) - 2]  # x of a circle about z, and so on
    first = first - axis * (axis @ first)
    first /= np.linalg.norm(first)
    flat = arms @ np.stack([first, np.cross(axis, first)], axis=1)
    # |p − m|² = r² is linear in the middle m and in r² − |m|².
    middle = np.linalg.lstsq(np.column_stack([2.0 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None)[0]
    around = flat - middle[:2]
    distances = np.linalg.norm(around, axis=1)
    if max(np.ptp(distances), np.abs(arms @ axis).max()) > LEAST_TRAVEL:
        return None
    place = points.mean(axis=0) + middle[0] * first + middle[1] * np.cross(axis, first)
    return Circle(place, axis, float(distances.mean()), np.arctan2(around[:, 1], around[:, 0]))


def _longest(vector: np.ndarray) -> float:
    """Return the component that is largest in magnitude."""
    return float(vector[np.abs(vector).argmax()])


def _senses(angles: np.ndarray, cycles: np.ndarray) -> np.ndarray:
    """Return in which sense each of some angles in a row was come to, (N,); a cycle's first, a pause: as the next."""
    steps = np.angle(np.exp(1j * np.diff(angles, prepend=angles[0])))
    steps[np.diff(cycles, prepend=cycles[0]) != 0] = 0.0
    senses = np.where(np.abs(steps) < ALONG, 0, np.sign(steps)).astype(int)
    for n in range(len(senses) - 2, -1, -1):
        senses[n] = senses[n] or senses[n + 1]
    return np.where(senses == 0, FORWARD, senses)


def standards_text(judged: Judged) -> str:
    """Return the figures of all runs, a table for each standard, µm."""
    parts = []
    if judged.axes:
        parts.append(f"{AXES_STANDARD}, lines along the axes, both directions\n{table(judged.axes)}")
    for kind, tests in judged.diagonals.items():
        worst = ", ".join(f"{name} {number(value * 1e6, 3)} µm" for name, value in largest(tests).items())
        title = f"{DIAGONALS_STANDARD}, {kind} diagonals, both directions"
        parts.append(f"{title}\n{table(tests)}\nlargest of the {len(tests)}: {worst}")
    if judged.circles:
        parts.append(f"{CIRCLES_STANDARD}, circles\n{circle_table(judged.circles)}")
        parts[-1] += "".join(f"\nnote: {note}" for note in notes_of(judged.circles))
    return "\n\n".join(parts)


def notes_of(tests: Mapping[str, PositioningTest] | Mapping[str, CircularTest]) -> list[str]:
    """Return the notes of several tests, each once."""
    return list(dict.fromkeys(note for test in tests.values() for note in test.notes))


def circle_table(tests: Mapping[str, CircularTest]) -> str:
    """Return the figures of several circles, one row each, µm; a dash where a test cannot tell."""
    rows = []
    for name, test in tests.items():
        cells = [number(test.figures[key] * 1e6, 3) if key in test.figures else "–" for key in CIRCLE_COLUMNS]
        rows.append((name, number(test.radius * 1e3, 1), str(sum(test.readings.values())), *cells, "um"))
    return aligned(("run", "radius mm", "readings", *CIRCLE_COLUMNS.values(), ""), rows)


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
    if judged.circles:
        parts.append(standards_text(Judged({}, {}, judged.circles)))
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
    if judged.circles:
        result["iso230_4"] = {name: with_units(test.figures) for name, test in judged.circles.items()}
    return result


def with_units(figures: Mapping[str, float]) -> dict[str, float]:
    """Return lengths with their unit in the keys."""
    return {f"{name}_m": value for name, value in figures.items()}
