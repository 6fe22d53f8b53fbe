"""Figures of ISO 230-2:2014 (positioning), ISO 230-4:2005 (circles) and ISO 230-6:2002 (diagonals)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..formats.texts import aligned, number
from .readings import BACKWARD, CHANNELS, FORWARD, LEAST_TRAVEL, LENGTH, MeasurementSet

DIRECTIONS = ("up", "down")  # approach in the positive and in the negative direction
STANDARD_CYCLES = 5  # number of cycles that ISO 230-2 requires
TARGETS_PER_METRE = 5  # number of targets that ISO 230-2 requires per metre of travel, and at least
LONGEST_TRAVEL = 2.0  # m; ISO 230-2 prescribes another test for a longer travel
EVEN_SPACING = 1e-6  # m; targets are evenly spaced if their spacings differ by less than this
SURE_REVERSAL = 3.0  # a mean reversal is significant if it exceeds this many of its standard errors


@dataclass(frozen=True, eq=False)
class PositioningTest:
    """Figures of a positioning test. Arrays have two rows: approaches in the positive direction, in the negative."""

    targets: np.ndarray  # (m,): commanded positions along the line, m
    cycles: int  # number of approaches to each target from each side
    mean: np.ndarray  # (2, m): mean unidirectional deviations x̄ᵢ, m
    standard_deviation: np.ndarray  # (2, m): standard deviations sᵢ of the deviations, with denominator n − 1, m
    reversal: np.ndarray  # (m,): reversal Bᵢ = x̄ᵢ↑ − x̄ᵢ↓, m; negative with backlash
    repeatability: np.ndarray  # (3, m): Rᵢ↑, Rᵢ↓ and Rᵢ of both directions, m
    figures: dict[str, float]  # figures of the axis by the standard's symbols, m: ``A``, ``A_up``, …, ``B_mean``, ``M``
    notes: tuple[str, ...]  # on deviations of the test from the standard, and on a suspected mistake


def evaluate(positions: np.ndarray, readings: np.ndarray) -> PositioningTest:
    """Return the figures of ISO 230-2:2014 for a line; `readings`, m, are (up and down, cycles, targets)."""
    mean, s = readings.mean(axis=1), readings.std(axis=1, ddof=1)
    low, high = mean - 2.0 * s, mean + 2.0 * s
    reversal = mean[0] - mean[1]
    repeatability = np.stack([*(4.0 * s), 2.0 * s[0] + 2.0 * s[1] + np.abs(reversal)])
    repeatability[2] = repeatability.max(axis=0)
    figures = {"A": high.max() - low.min(), "E": np.ptp(mean), "R": repeatability[2].max()}
    for d, name in enumerate(DIRECTIONS):
        figures[f"A_{name}"] = high[d].max() - low[d].min()
        figures[f"E_{name}"] = np.ptp(mean[d])
        figures[f"R_{name}"] = repeatability[d].max()
    figures |= {"M": np.ptp(mean.mean(axis=0)), "B": np.abs(reversal).max(), "B_mean": reversal.mean()}
    notes = _positioning_notes(positions, readings.shape[1], reversal, s)
    figures = {name: float(value) for name, value in figures.items()}
    return PositioningTest(positions, readings.shape[1], mean, s, reversal, repeatability, figures, tuple(notes))


def _positioning_notes(targets: np.ndarray, cycles: int, reversal: np.ndarray, deviation: np.ndarray) -> list[str]:
    """Return notes on deviations from the standard, and on a mean reversal value that is significantly positive."""
    notes = []
    travel = float(np.ptp(targets))
    needed = max(TARGETS_PER_METRE, math.ceil(TARGETS_PER_METRE * travel))
    if cycles < STANDARD_CYCLES:
        notes.append(f"{cycles} cycles; the standard asks for {STANDARD_CYCLES}")
    if len(targets) < needed:
        notes.append(f"{len(targets)} targets over {travel * 1e3:g} mm; the standard asks for {needed}")
    if travel > LONGEST_TRAVEL:
        notes.append(f"travel of {travel:g} m; above {LONGEST_TRAVEL:g} m the standard prescribes another test")
    spacings = np.diff(np.sort(targets))
    if len(spacings) > 1 and np.ptp(spacings) < EVEN_SPACING:
        notes.append(
            f"targets every {spacings[0] * 1e3:g} mm do not show errors with a period of {spacings[0] * 1e3:g} mm or "
            "1/2, 1/3, … of it; the standard shifts each target by a random share of the expected period"
        )
    mean, standard_error = float(reversal.mean()), math.sqrt(float((deviation**2).sum()) / cycles) / len(reversal)
    if reversal.min() > 0.0 and mean > SURE_REVERSAL * standard_error:
        notes.append(
            f"the reversal is positive at every target (mean {mean * 1e6:.3f} µm), but backlash makes"
            " it negative: are directions or signs exchanged, or is backlash overcompensated?"
        )
    return notes


ROWS = {
    "accuracy A": ("A", "A_up", "A_down"),
    "systematic deviation E": ("E", "E_up", "E_down"),
    "repeatability R": ("R", "R_up", "R_down"),
    "mean bidirectional deviation M": ("M",),
    "reversal B": ("B",),
    "mean reversal B̄": ("B_mean",),
}


def report(test: PositioningTest, standard: str = "ISO 230-2:2014") -> str:
    """Return a positioning test as text: targets in mm, all figures in µm, and the notes."""

    def cells(values: Iterable[float]) -> str:
        return "".join(f"{round(value * 1e6, 3) + 0.0:10.3f}" for value in values)  # never −0

    travel = float(np.ptp(test.targets)) * 1e3
    lines = [f"{standard}: {len(test.targets)} targets over {travel:g} mm, {test.cycles} cycles ↑↓; µm", ""]
    names = ("mean ↑", "mean ↓", "s ↑", "s ↓", "R ↑", "R ↓", "B", "R")
    lines.append("target mm".rjust(12) + "".join(name.rjust(10) for name in names))
    columns = [*test.mean, *test.standard_deviation, *test.repeatability[:2], test.reversal, test.repeatability[2]]
    lines += [f"{test.targets[i] * 1e3:12.4f}" + cells(v[i] for v in columns) for i in np.argsort(test.targets)]
    lines += ["", " " * 30 + "".join(name.rjust(10) for name in ("both", "↑", "↓"))]
    for name, keys in ROWS.items():
        lines.append(name + " " * (30 - len(name.replace("\u0304", ""))) + cells(test.figures[key] for key in keys))
    if test.notes:
        lines += ["", *(f"note: {note}" for note in test.notes)]
    return "\n".join(lines)


SENSES = {"ccw": FORWARD, "cw": BACKWARD}  # senses of rotation, seen from the tip of the circle's axis
FEWEST_READINGS = 5  # fewest readings in one sense: 3 determine a circle, 2 more check it
LARGEST_GAP = np.radians(45.0)  # rad; a circle with a larger gap between neighbouring readings is an arc
SHORTEST_ARC = np.radians(90.0)  # rad; a shorter arc does not determine a circle's centre
# Largest number of iterations for a circle's centre; length of a step, m, below which they end
ITERATIONS, CONVERGED = 5, 1e-9


@dataclass(frozen=True, eq=False)
class CircularTest:
    radius: float  # radius of the nominal path, m
    readings: dict[str, int]  # number of readings in each measured sense, a key of :data:`SENSES`
    # Figures by the standard's symbols, m: circular deviations ``G_ccw`` and ``G_cw``, bidirectional circular deviation
    # ``G_b``, radial deviations ``F_max_ccw``, ``F_min_ccw``, ``F_max_cw``, ``F_min_cw``, and mean bidirectional radial
    # deviation ``D``. Figures that the test cannot determine are missing.
    figures: dict[str, float]
    notes: tuple[str, ...]  # deviations of the test from the standard: one sentence each


def evaluate_circle(
    radius: float, angles: np.ndarray, deviations: np.ndarray, senses: np.ndarray, length_known: bool = True
) -> CircularTest | None:
    """Return the figures of ISO 230-4:2005 for a nominal circle, from radial `deviations`, m, at `angles`, rad.

    `senses` are the senses of rotation, ±1, in which the deviations were read. Return None if one sense has fewer
    readings than FEWEST_READINGS or an arc shorter than SHORTEST_ARC.
    """
    path = angles, deviations
    parts = {name: [column[senses == sense] for column in path] for name, sense in SENSES.items()}
    parts = {name: part for name, part in parts.items() if len(part[0])}
    arcs = [(len(part[0]), 2.0 * np.pi - _largest_gap(part[0])) for part in parts.values()]
    if any(count < FEWEST_READINGS or arc < SHORTEST_ARC for count, arc in arcs):
        return None
    figures = {f"G_{name}": _separation(radius, *part) for name, part in parts.items()}
    if len(parts) == 2:
        figures["G_b"] = _separation(radius, *path)
    full = all(_largest_gap(part[0]) <= LARGEST_GAP for part in parts.values())
    if full and length_known:
        for name, part in parts.items():
            radial = _from_least_squares_centre(radius, *part)
            figures |= {f"F_max_{name}": float(radial.max()), f"F_min_{name}": float(radial.min())}
        if len(parts) == 2:
            figures["D"] = float(_from_least_squares_centre(radius, *path).mean())
    return CircularTest(radius, {n: len(p[0]) for n, p in parts.items()}, figures, _notes(parts, full, length_known))


def _largest_gap(angles: np.ndarray) -> float:
    """Return the largest angle between neighbouring readings, rad."""
    turned = np.sort(np.mod(angles, 2.0 * np.pi))
    return float(np.diff(turned, append=turned[0] + 2.0 * np.pi).max())


def _seen_from(
    centre: np.ndarray, radius: float, angles: np.ndarray, deviations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the radial deviations about a centre, (n,), m, and the unit vectors from the centre, (n, 2)."""
    arms = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) - centre
    distances = np.linalg.norm(arms, axis=1)
    return radius + deviations - distances, arms / distances[:, None]


def _separation(radius: float, angles: np.ndarray, deviations: np.ndarray) -> float:
    """Return the smallest difference of the radii, m, of two concentric circles between which all readings lie."""
    from scipy.optimize import linprog  # its import takes 0.25 s

    centre = np.zeros(2)
    for _ in range(ITERATIONS):
        radial, away = _seen_from(centre, radius, angles, deviations)
        # A linear program minimises outer − inner radius; unknowns: both radii and the shift of the centre.
        scale = max(float(np.ptp(radial)), np.finfo(float).tiny)
        ones, zeros = np.ones((len(radial), 1)), np.zeros((len(radial), 1))
        bounds = np.vstack([np.hstack([ones, zeros, -away]), np.hstack([zeros, -ones, away])])
        offset = (radial - radial.mean()) / scale
        answer = linprog([-1.0, 1.0, 0.0, 0.0], bounds, np.concatenate([offset, -offset]), bounds=(None, None))
        shift = scale * answer.x[2:]
        centre = centre + shift
        if np.linalg.norm(shift) < CONVERGED:
            break
    return float(np.ptp(_seen_from(centre, radius, angles, deviations)[0]))


def _from_least_squares_centre(radius: float, angles: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Return the radial deviations about the centre of the least-squares circle, (n,), m."""
    centre = np.zeros(2)
    for _ in range(ITERATIONS):
        radial, away = _seen_from(centre, radius, angles, deviations)
        columns = np.hstack([np.ones((len(radial), 1)), -away])
        centre = centre + np.linalg.lstsq(columns, radial, rcond=None)[0][1:]
    return _seen_from(centre, radius, angles, deviations)[0]


def _notes(parts: dict[str, list[np.ndarray]], full: bool, length_known: bool) -> tuple[str, ...]:
    notes = []
    if len(parts) < 2:
        notes.append(f"sense {next(iter(parts))} only: G(b) and D are not computed; the standard asks for both senses")
    if not full:
        notes.append("the readings are on an arc: F and D are not computed, and G is smaller than on the full circle")
    if full and not length_known:
        notes.append("the instrument's length is not calibrated: F and D are not computed")
    return tuple(notes)


AXES_STANDARD, DIAGONALS_STANDARD, CIRCLES_STANDARD = "ISO 230-2:2014", "ISO 230-6:2002", "ISO 230-4:2005"
ALONG = 1e-6  # counts as no motion: a smaller component of a line's unit vector, a smaller step of an angle, rad
# Largest distance, m, from the stated centre of the distances to the centre of the commanded circle
LARGEST_CENTRE_OFFSET = 0.01
BODY, FACE = "body", "face"
LINEAR = CHANNELS.index("linear")
# Bidirectional figures, with the headings of their columns
COLUMNS = {"A": "A", "E": "E", "R": "R", "M": "M", "B": "B", "B_mean": "B̄"}
# Figures of a circle, with the headings of their columns
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


@dataclass(frozen=True)
class Judged:
    """The figures that standards define, for each run to which a standard applies, by the run's name."""

    axes: dict[str, PositioningTest]  # lines along an axis: ISO 230-2
    diagonals: dict[str, dict[str, PositioningTest]]  # ISO 230-6; outer keys ``body`` and ``face``
    circles: dict[str, CircularTest]  # circles of a ball bar: ISO 230-4

    def __bool__(self) -> bool:
        return bool(self.axes or self.diagonals or self.circles)


def judge(measurements: MeasurementSet) -> Judged:
    """Evaluate each run to which a standard applies; a line needs two cycles that read every target from both sides."""
    points = measurements.points()[measurements.station]
    axes: dict[str, PositioningTest] = {}
    diagonals: dict[str, dict[str, PositioningTest]] = {}
    for index, run in enumerate(measurements.runs):
        passes: dict[tuple[int, int], dict[float, float]] = {}  # readings by target, for each (direction, cycle)
        for n in np.flatnonzero((measurements.run == index) & (measurements.channel == LINEAR)):
            target = round(float(points[n] @ run.axis), 9) + 0.0
            pass_of = int(measurements.direction[n]), int(measurements.cycle[n])
            passes.setdefault(pass_of, {})[target] = float(measurements.value[n])
        cycles = sorted({cycle for _, cycle in passes})
        wanted = [(direction, cycle) for direction in (FORWARD, BACKWARD) for cycle in cycles]
        if len(cycles) < 2 or set(passes) != set(wanted):
            continue
        targets = sorted(passes[wanted[0]])
        if any(sorted(readings) != targets for readings in passes.values()):
            continue
        deviations = np.array([[passes[one][target] for target in targets] for one in wanted])
        test = evaluate(np.array(targets), deviations.reshape(2, len(cycles), len(targets)))
        in_work = measurements.geometry.work.rotation.T @ run.axis
        along = np.count_nonzero(np.abs(in_work) > ALONG)  # number of axes along which the line travels
        (axes if along == 1 else diagonals.setdefault(BODY if along == 3 else FACE, {}))[run.name] = test
    return Judged(axes, diagonals, circular_tests(measurements))


def circular_tests(measurements: MeasurementSet) -> dict[str, CircularTest]:
    """Evaluate each run whose distances were read on a circle about their centre; return the tests by run name."""
    points = measurements.points()[measurements.station]
    tests = {}
    for index, run in enumerate(measurements.runs):
        chosen = np.flatnonzero((measurements.run == index) & (measurements.channel == LENGTH))
        centres = measurements.centre[chosen]
        if len(chosen) < FEWEST_READINGS or np.ptp(centres, axis=0).max() > LEAST_TRAVEL:
            continue
        circle = _circle(points[chosen], measurements.geometry.work.rotation)
        if circle is None:
            continue
        middle, axis, radius, angles = circle
        if np.linalg.norm(middle - centres[0]) > LARGEST_CENTRE_OFFSET:
            continue
        lengths = measurements.value[chosen] + np.linalg.norm(points[chosen] - centres, axis=1)
        height = float(axis @ (centres[0] - middle))
        given = lengths - np.hypot(radius, height), _senses(angles, measurements.cycle[chosen])
        test = evaluate_circle(radius, angles, *given, length_known=run.known_zero)
        if test is not None:
            tests[run.name] = test
    return tests


def _circle(points: np.ndarray, work_axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray] | None:
    """Return the circle on which points (N, 3), m, lie: centre, axis, radius, and the points' angles, (N,), rad.

    The circle's axis points in the positive direction of the nearest work axis, a column of `work_axes`. Return None if
    a point is more than LEAST_TRAVEL off the circle.
    """
    arms = points - points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(arms, full_matrices=False)
    if sizes[1] < LEAST_TRAVEL:
        return None  # the points lie on a line
    nearest = int(np.abs(work_axes.T @ directions[2]).argmax())
    axis = directions[2] * np.sign(work_axes[:, nearest] @ directions[2])
    first = work_axes[:, nearest - 2]  # angles about z are measured from x, about x from y, about y from z
    first = first - axis * (axis @ first)
    first /= np.linalg.norm(first)
    flat = arms @ np.stack([first, np.cross(axis, first)], axis=1)
    # |p − m|² = r² is linear in the centre m and in r² − |m|².
    middle = np.linalg.lstsq(np.column_stack([2.0 * flat, np.ones(len(flat))]), (flat**2).sum(axis=1), rcond=None)[0]
    around = flat - middle[:2]
    distances = np.linalg.norm(around, axis=1)
    if max(np.ptp(distances), np.abs(arms @ axis).max()) > LEAST_TRAVEL:
        return None
    place = points.mean(axis=0) + middle[0] * first + middle[1] * np.cross(axis, first)
    return place, axis, float(distances.mean()), np.arctan2(around[:, 1], around[:, 0])


def _senses(angles: np.ndarray, cycles: np.ndarray) -> np.ndarray:
    """Return the sense of rotation, ±1, of the motion to each angle; a cycle's first angle gets that of the second."""
    steps = np.angle(np.exp(1j * np.diff(angles, prepend=angles[0])))
    steps[np.diff(cycles, prepend=cycles[0]) != 0] = 0.0
    senses = np.where(np.abs(steps) < ALONG, 0, np.sign(steps)).astype(int)
    for n in range(len(senses) - 2, -1, -1):
        senses[n] = senses[n] or senses[n + 1]
    return np.where(senses == 0, FORWARD, senses)


def standards_text(judged: Judged) -> str:
    """Return one table for each standard: bidirectional figures, µm."""
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
    """Return the different notes of all tests, each once."""
    return list(dict.fromkeys(note for test in tests.values() for note in test.notes))


def figure_cells(columns: Iterable[str], digits: int, *figures: Mapping[str, float]) -> list[str]:
    """Return a table's cell for each column, µm: a test's figure, or "before → after" of two tests; "–" if missing."""
    return [
        " → ".join(number(part[key] * 1e6, digits) for part in figures) if key in figures[0] else "–" for key in columns
    ]


def circle_table(tests: Mapping[str, CircularTest]) -> str:
    rows = []
    for name, test in tests.items():
        cells = figure_cells(CIRCLE_COLUMNS, 3, test.figures)
        rows.append((name, number(test.radius * 1e3, 1), str(sum(test.readings.values())), *cells, "um"))
    return aligned(("run", "radius mm", "readings", *CIRCLE_COLUMNS.values(), ""), rows)


def largest(tests: Mapping[str, PositioningTest]) -> dict[str, float]:
    """Return ``E_d`` and ``B_d`` of ISO 230-6, m: the largest E and B of the diagonals."""
    return {f"{name}_d": max(test.figures[name] for test in tests.values()) for name in ("E", "B")}


def table(tests: Mapping[str, PositioningTest]) -> str:
    header = ("run", "targets", "cycles", *COLUMNS.values(), "")
    rows = []
    for name, test in tests.items():
        rows.append((name, str(len(test.targets)), str(test.cycles), *figure_cells(COLUMNS, 3, test.figures), "um"))
    return aligned(header, rows)


def every_target(judged: Judged) -> str:
    """Return the figures of all runs at every target as text, with notes."""
    parts = [f"{name}\n{report(test, AXES_STANDARD)}" for name, test in judged.axes.items()]
    for tests in judged.diagonals.values():
        parts += [f"{name}\n{report(test, DIAGONALS_STANDARD)}" for name, test in tests.items()]
    if judged.circles:
        parts.append(standards_text(Judged({}, {}, judged.circles)))
    return "\n\n".join(parts)


def standards_json(judged: Judged) -> dict[str, Any]:
    """Return the figures for JSON, nested by standard, run and symbol with unit, such as ``A_m`` or ``E_up_m``."""
    result: dict[str, Any] = {}
    if judged.axes:
        result["iso230_2"] = {name: with_units(test.figures) for name, test in judged.axes.items()}
    if judged.diagonals:
        kinds = judged.diagonals.items()
        figures = {kind: {name: with_units(test.figures) for name, test in tests.items()} for kind, tests in kinds}
        result["iso230_6"] = {**figures, "largest": {kind: with_units(largest(tests)) for kind, tests in kinds}}
    if judged.circles:
        result["iso230_4"] = {name: with_units(test.figures) for name, test in judged.circles.items()}
    return result


def with_units(figures: Mapping[str, float]) -> dict[str, float]:
    return {f"{name}_m": value for name, value in figures.items()}
