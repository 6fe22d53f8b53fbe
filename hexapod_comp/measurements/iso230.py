"""Figures of ISO 230-2:2014 for positioning along one line: targets approached again and again, from both sides.

Up (↑) is the approach in the positive direction. A deviation is the position reached minus the target. The
symbols of the standard stand beside each figure; the formulas are those of its clause 3. ISO 230-6:2002 judges
diagonals by the same formulas.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import ModelError

DIRECTIONS = ("up", "down")
"""Approach in the positive direction, and in the negative."""

ARROWS = {"up": "↑", "down": "↓"}

STANDARD_CYCLES = 5
"""How often the standard has each target approached from each side."""

TARGETS_PER_METRE = 5
"""Fewest targets per metre, and fewest at all, that the standard asks for."""

LONGEST_TRAVEL = 2.0
"""Longest travel, m, for which the standard prescribes this test."""

EVEN_SPACING = 1e-6
"""Targets whose spacings differ by less than this, m, count as evenly spaced."""

SURE_REVERSAL = 3.0
"""A mean reversal above so many of its standard errors is no chance."""


@dataclass(frozen=True, eq=False)
class OneDirection:
    """Figures of the approach from one side; m targets."""

    mean: np.ndarray  # (m,): mean unidirectional deviation x̄ᵢ, m
    standard_deviation: np.ndarray  # (m,): estimator sᵢ of the repeatability, with n − 1, m

    @property
    def repeatability_at_targets(self) -> np.ndarray:
        """Rᵢ = 4·sᵢ, shape (m,), m."""
        return 4.0 * self.standard_deviation

    @property
    def repeatability(self) -> float:
        """R↑ or R↓: the largest Rᵢ, m."""
        return float(self.repeatability_at_targets.max())

    @property
    def systematic_deviation(self) -> float:
        """E↑ or E↓: from the lowest to the highest mean, m."""
        return float(np.ptp(self.mean))

    @property
    def interval(self) -> tuple[np.ndarray, np.ndarray]:
        """x̄ᵢ − 2·sᵢ and x̄ᵢ + 2·sᵢ, shape (m,) each, m."""
        return self.mean - 2.0 * self.standard_deviation, self.mean + 2.0 * self.standard_deviation

    @property
    def accuracy(self) -> float:
        """A↑ or A↓: from the lowest x̄ᵢ − 2·sᵢ to the highest x̄ᵢ + 2·sᵢ, m."""
        low, high = self.interval
        return float(high.max() - low.min())


@dataclass(frozen=True, eq=False)
class BothDirections:
    """Figures that take the approaches from both sides together; m targets."""

    up: OneDirection  # what they are made of
    down: OneDirection

    @property
    def mean(self) -> np.ndarray:
        """Mean bidirectional deviation x̄ᵢ = (x̄ᵢ↑ + x̄ᵢ↓)/2, shape (m,), m."""
        return 0.5 * (self.up.mean + self.down.mean)

    @property
    def reversal_at_targets(self) -> np.ndarray:
        """Bᵢ = x̄ᵢ↑ − x̄ᵢ↓, shape (m,), m; negative where the motion lags, as with play."""
        return self.up.mean - self.down.mean

    @property
    def reversal(self) -> float:
        """B: the largest magnitude of Bᵢ, m."""
        return float(np.abs(self.reversal_at_targets).max())

    @property
    def mean_reversal(self) -> float:
        """B̄: the mean of Bᵢ with their signs, m."""
        return float(self.reversal_at_targets.mean())

    @property
    def repeatability_at_targets(self) -> np.ndarray:
        """Rᵢ = max(2·sᵢ↑ + 2·sᵢ↓ + abs(Bᵢ), Rᵢ↑, Rᵢ↓), shape (m,), m."""
        up, down = self.up, self.down
        across = 2.0 * up.standard_deviation + 2.0 * down.standard_deviation + np.abs(self.reversal_at_targets)
        return np.max([across, up.repeatability_at_targets, down.repeatability_at_targets], axis=0)

    @property
    def repeatability(self) -> float:
        """R: the largest Rᵢ, m."""
        return float(self.repeatability_at_targets.max())

    @property
    def systematic_deviation(self) -> float:
        """E: from the lowest to the highest of all x̄ᵢ↑ and x̄ᵢ↓, m."""
        return float(np.ptp([self.up.mean, self.down.mean]))

    @property
    def mean_deviation(self) -> float:
        """M: from the lowest to the highest x̄ᵢ, m."""
        return float(np.ptp(self.mean))

    @property
    def accuracy(self) -> float:
        """A: from the lowest x̄ᵢ − 2·sᵢ to the highest x̄ᵢ + 2·sᵢ of either direction, m."""
        low, high = np.stack([self.up.interval, self.down.interval], axis=1)
        return float(high.max() - low.min())


@dataclass(frozen=True, eq=False)
class PositioningTest:
    """A positioning test with its figures, as :func:`evaluate` returns it."""

    targets: np.ndarray  # (m,): commanded positions along the line, m
    cycles: int  # n, approaches of each target from each side
    up: OneDirection | None  # figures by direction; None for the one that was not run
    down: OneDirection | None
    notes: tuple[str, ...]  # where the test departs from the standard's, and what looks wrong: one sentence each

    @property
    def both(self) -> BothDirections | None:
        """Figures of both directions together, None after a unidirectional test."""
        return None if self.up is None or self.down is None else BothDirections(self.up, self.down)

    @property
    def directions(self) -> dict[str, OneDirection]:
        """The directions that were run, by name."""
        pairs = zip(DIRECTIONS, (self.up, self.down), strict=True)
        return {name: one for name, one in pairs if one is not None}

    def figures(self) -> dict[str, float]:
        """Return the axis' figures, m, by the standard's symbols: ``A``, ``A_up``, …, ``B_mean``, ``M``.

        What the test cannot tell is left out.
        """
        values: dict[str, float] = {}
        parts = {"": self.both, **{f"_{name}": one for name, one in self.directions.items()}}
        for suffix, part in parts.items():
            if part is not None:
                values[f"A{suffix}"] = part.accuracy
                values[f"E{suffix}"] = part.systematic_deviation
                values[f"R{suffix}"] = part.repeatability
        if self.both is not None:
            values |= {"M": self.both.mean_deviation, "B": self.both.reversal, "B_mean": self.both.mean_reversal}
        return values


def evaluate(targets: np.ndarray, deviations: np.ndarray, directions: Sequence[str] = DIRECTIONS) -> PositioningTest:
    """Return the figures of ISO 230-2:2014 for one axis, or one line."""
    names = _checked_directions(directions)
    positions = _checked_targets(targets)
    readings = _checked_deviations(deviations, names, len(positions))
    of_direction = {name: _one_direction(readings[k]) for k, name in enumerate(names)}
    up, down = of_direction.get("up"), of_direction.get("down")
    cycles = readings.shape[1]
    notes = _design_notes(positions, cycles)
    if up is not None and down is not None:
        notes += _swap_notes(BothDirections(up, down), cycles)
    return PositioningTest(positions, cycles, up, down, tuple(notes))


def _checked_directions(directions: Sequence[str]) -> tuple[str, ...]:
    names = tuple(directions)
    if not names or len(set(names)) < len(names) or not set(names) <= set(DIRECTIONS):
        raise ModelError("directions", "must be (up, down), or one of them", list(names))
    return names


def _checked_targets(targets: np.ndarray) -> np.ndarray:
    """Return a private read-only copy of targets that are finite and distinct."""
    positions = np.array(targets, dtype=float)
    if positions.ndim != 1 or not len(positions) or not np.isfinite(positions).all():
        raise ModelError("targets", "must be a list of finite positions, m", positions.tolist())
    values, counts = np.unique(positions, return_counts=True)
    if (counts > 1).any():
        raise ModelError("targets", "each target may be there once", float(values[counts.argmax()]))
    positions.flags.writeable = False
    return positions


def _checked_deviations(deviations: np.ndarray, names: tuple[str, ...], count: int) -> np.ndarray:
    """Return the deviations as an array (directions, cycles, targets) in which every reading is there."""
    try:
        readings = np.asarray(deviations, dtype=float)
    except ValueError as error:  # ragged lists
        problem = "every target needs the same number of readings from each direction"
        raise ModelError("deviations", problem) from error
    if readings.ndim != 3 or readings.shape[0] != len(names) or readings.shape[2] != count:
        problem = f"must have the shape ({len(names)} directions, cycles, {count} targets)"
        raise ModelError("deviations", problem, readings.shape)
    if readings.shape[1] < 2:
        problem = "a standard deviation needs at least two cycles"
        raise ModelError("deviations", problem, readings.shape[1])
    wrong = np.argwhere(~np.isfinite(readings))
    if len(wrong):
        direction, cycle, target = wrong[0]
        where = f"deviations, {names[direction]}, cycle {cycle + 1}, target {target + 1}"
        raise ModelError(where, "must be a finite number, m", float(readings[direction, cycle, target]))
    return readings


def _one_direction(readings: np.ndarray) -> OneDirection:
    """Return mean and estimator of each target from readings (cycles, targets)."""
    mean, standard_deviation = readings.mean(axis=0), readings.std(axis=0, ddof=1)
    mean.flags.writeable = standard_deviation.flags.writeable = False
    return OneDirection(mean, standard_deviation)


def _design_notes(targets: np.ndarray, cycles: int) -> list[str]:
    """Return where the test's plan departs from the standard's."""
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
            f"targets every {spacings[0] * 1e3:g} mm: an error of that period, or of a whole fraction of it, does"
            " not show; the standard shifts each target by a random share of the expected period"
        )
    return notes


def _swap_notes(both: BothDirections, cycles: int) -> list[str]:
    """Return a note when the motion leads instead of lagging, at every target and beyond chance."""
    variance = both.up.standard_deviation**2 + both.down.standard_deviation**2
    standard_error = math.sqrt(float(variance.sum()) / cycles) / len(variance)
    if both.reversal_at_targets.min() <= 0.0 or both.mean_reversal <= SURE_REVERSAL * standard_error:
        return []
    return [
        f"the reversal is positive at every target (mean {both.mean_reversal * 1e6:.3f} µm), where play makes it"
        " negative: directions or sign swapped, or backlash compensated too much?"
    ]


def report(test: PositioningTest, standard: str = "ISO 230-2:2014") -> str:
    """Return a test as text, under the name of its standard: targets in mm, everything else in µm, notes below."""
    arrows = "".join(ARROWS[name] for name in test.directions)
    travel = float(np.ptp(test.targets)) * 1e3
    title = f"{standard}: {len(test.targets)} targets over {travel:g} mm, {test.cycles} cycles {arrows}; µm"
    lines = [title, "", *_target_lines(test), "", *_figure_lines(test)]
    if test.notes:
        lines += ["", *(f"note: {note}" for note in test.notes)]
    return "\n".join(lines)


def _target_lines(test: PositioningTest) -> list[str]:
    """Return the table of the targets, in ascending order."""
    columns = {f"mean {ARROWS[name]}": one.mean for name, one in test.directions.items()}
    columns |= {f"s {ARROWS[name]}": one.standard_deviation for name, one in test.directions.items()}
    columns |= {f"R {ARROWS[name]}": one.repeatability_at_targets for name, one in test.directions.items()}
    if test.both is not None:
        columns |= {"B": test.both.reversal_at_targets, "R": test.both.repeatability_at_targets}
    lines = ["target mm".rjust(12) + "".join(name.rjust(10) for name in columns)]
    for i in np.argsort(test.targets):
        lines.append(f"{test.targets[i] * 1e3:12.4f}" + "".join(_micrometres(v[i]) for v in columns.values()))
    return lines


def _figure_lines(test: PositioningTest) -> list[str]:
    """Return the table of the axis' figures; a dash where the test cannot tell, a blank where there is none."""
    figures = test.figures()
    rows = {
        "accuracy A": ("A", "A_up", "A_down"),
        "systematic deviation E": ("E", "E_up", "E_down"),
        "repeatability R": ("R", "R_up", "R_down"),
        "mean bidirectional deviation M": ("M",),
        "reversal B": ("B",),
        "mean reversal B̄": ("B_mean",),
    }
    lines = [" " * 30 + "both".rjust(10) + "↑".rjust(10) + "↓".rjust(10)]
    for name, keys in rows.items():
        cells = [_micrometres(figures[key]) if key in figures else "–".rjust(10) for key in keys]
        lines.append(name + " " * (30 - len(name.replace("\u0304", ""))) + "".join(cells))
    return lines


def _micrometres(value: float) -> str:
    """Return a length in µm, ten characters wide, never −0."""
    return f"{round(value * 1e6, 3) + 0.0:10.3f}"
