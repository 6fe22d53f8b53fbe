"""Which few readings check a model best: greedy on how clearly they tell a change from every other one.

All that could be read is laid out once. A channel of a run has an unknown zero, so what a choice of readings tells are
differences along it, whatever they will read; the evidence of each change then follows as for real check readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import CalibrationError
from ..machine.geometry import STRUT_NAMES
from ..measurements.campaign import Campaign, template
from ..measurements.readings import CHANNELS, FORWARD, MeasurementSet
from .changes import STRUT, TEMPERATURE, Change, CheckReadings, Evidence, Hypothesis, possible_changes, widened
from .posterior import FittedParameters

USUAL = 12
"""Check readings that are proposed."""

LEAST, MOST = 6, 60
"""As few tell next to nothing; as many are better laid out as a campaign."""

READ_BY = {"linear": ("linear",), "rotation": ("rotation_x", "rotation_y", "rotation_z")}
"""What each instrument reads: on lines along the axes pitch and yaw, there and on diagonals the displacement."""

CRASH, WARMTH = 20e-6, 12e-6
"""Changes that are to be named: of each strut by itself, m, and growth of all struts, m/m: steel by a kelvin."""


_log_sum = np.logaddexp.reduce
"""Of arrays so small that checks of arguments took scipy's most of the time."""


@dataclass(frozen=True)
class _Choice:
    """Readings chosen so far: places of all that could be read, by the channel and run that share a zero."""

    groups: tuple[tuple[int, ...], ...] = ()

    def contrasts(self, size: int) -> np.ndarray:
        """Return differences of readings that have no zeros in them, shape (n, size), orthonormal."""
        rows = []
        for places in self.groups:
            centred = np.eye(len(places)) - 1.0 / len(places)
            part = np.zeros((len(places) - 1, size))
            part[:, places] = np.linalg.svd(centred)[0].T[:-1]
            rows.append(part)
        return np.concatenate(rows)


def propose_check(
    fitted: FittedParameters, readings: int = USUAL, instruments: Sequence[str] = tuple(READ_BY)
) -> MeasurementSet:
    """Return the check readings to take with a laser: values are not a number.

    A crash of any strut and growth of all are to be told from all else that may have happened.

    Parameters
    ----------
    fitted : FittedParameters
        What the fit knows.
    readings : int
        How many.
    instruments : sequence of str
        What there is to measure with, of :data:`READ_BY`.

    Raises
    ------
    CalibrationError
        A fit without a box, a number of readings that is none, or an unknown instrument.
    """
    for name in instruments:
        if name not in READ_BY:
            raise CalibrationError("instruments", f"must be of {', '.join(READ_BY)}, not {name!r}")
    if not LEAST <= readings <= MOST:
        raise CalibrationError("readings", f"must be {LEAST}…{MOST}, not {readings}")
    wide = widened(fitted)
    laid_out, groups = _laid_out(
        wide, [channel for name in READ_BY if name in instruments for channel in READ_BY[name]]
    )
    weighing = _Weighing(wide, laid_out, possible_changes(wide.space, tuple(b.name for b in fitted.space.blocks)))
    choice, value, left = _Choice(), -np.inf, readings
    while left > 0:
        tries = [(moved, cost) for moved, cost in _moves(choice, groups) if cost <= left]
        values = np.array([weighing.clearness(moved) for moved, _ in tries])
        start = values.min() if value == -np.inf else value
        best = int(((values - start) / [cost for _, cost in tries]).argmax())
        (choice, cost), value = tries[best], float(values[best])
        left -= cost
    chosen = np.sort([place for places in choice.groups for place in places])
    picked = laid_out.select(np.isin(np.arange(len(laid_out)), chosen))
    return picked.with_values(np.full(len(picked), np.nan))


def _moves(choice: _Choice, groups: list[tuple[int, ...]]) -> list[tuple[_Choice, int]]:
    """Return what may be read next, with the number of readings: both ends of a line, or one more in between."""
    used = {places[:2]: n for n, places in enumerate(choice.groups)}
    moves = []
    for places in groups:
        n = used.get(places[:2])
        if n is None:
            moves.append((_Choice((*choice.groups, places[:2])), 2))
        elif len(choice.groups[n]) < len(places):
            longer = places[: len(choice.groups[n]) + 1]
            moves.append((_Choice((*choice.groups[:n], longer, *choice.groups[n + 1 :])), 1))
    return moves


def _laid_out(fitted: FittedParameters, channels: Sequence[str]) -> tuple[MeasurementSet, list[tuple[int, ...]]]:
    """Return what could be read in the measured box, and the readings of each zero: both ends, then the middle."""
    space = fitted.space
    box, side = space.work_box, float(np.ptp(space.work_box, axis=0).min())
    if side <= 0.0:
        raise CalibrationError("fit", "has measured no box in which check readings could be laid out")
    level = space.geometry.work.rotation.T @ space.level @ space.geometry.tool.rotation
    grid = template(Campaign(box, side, 0.5 * side, "5-D", 4, level=level), space.geometry)
    read = np.isin(grid.channel, [CHANNELS.index(name) for name in channels]) & (grid.direction == FORWARD)
    along, chosen = grid.along(), []
    for key in np.unique(np.stack([grid.run, grid.channel], axis=1)[read], axis=0):
        members = np.flatnonzero(read & (grid.run == key[0]) & (grid.channel == key[1]))
        members = members[np.argsort(along[members])]
        chosen.append((members[0], members[-1], members[len(members) // 2]))
    every = np.unique(chosen)
    place = {int(n): i for i, n in enumerate(every)}
    kept = grid.select(np.isin(np.arange(len(grid)), every))
    return kept, [tuple(place[int(n)] for n in group) for group in chosen]


class _Weighing:
    """How clearly a choice of readings names the changes that it should, before anything is read."""

    def __init__(self, fitted: FittedParameters, laid_out: MeasurementSet, changes: list[Change]) -> None:
        self._fitted, self._laid_out, self._changes = fitted, laid_out, changes
        self._every = CheckReadings.of(fitted, laid_out)
        sizes = dict.fromkeys(((STRUT, name) for name in STRUT_NAMES), CRASH) | {(TEMPERATURE, "struts"): WARMTH}
        named = [(c, sizes[c.family, c.name]) for c in changes if (c.family, c.name) in sizes]
        self._changes_named = [change for change, _ in named]
        self._named = np.array([size * c.columns[:, 0] for c, size in named if c.columns is not None])

    def clearness(self, choice: _Choice) -> float:
        """Return the log odds of the right kind of change over all others; those that are told worst count most."""
        check = self._every.part(choice.contrasts(len(self._laid_out)))
        evidence = Evidence(check.covariance(self._fitted.covariance), check.effects(self._changes))
        weights = np.array([_log_sum(w, 1) for w in evidence.log_weights(self._named @ check.rows.T)])
        own, other = (
            np.array([of(h, c) for h in evidence.hypotheses for c in self._changes_named]) for of in (_same, _other)
        )
        right, wrong = (_log_sum(np.where(of.reshape(weights.shape), weights, -np.inf), 0) for of in (own, other))
        return -float(_log_sum(wrong - right, 0))


def _same(hypothesis: Hypothesis, change: Change) -> bool:
    """Return whether a hypothesis is a change by name, of a strut, or of its kind."""
    return hypothesis.change.family == change.family and (
        change.family != STRUT or hypothesis.change.name == change.name
    )


def _other(hypothesis: Hypothesis, change: Change) -> bool:
    """Return whether a hypothesis is of another kind, or another strut; several struts at once are neither."""
    return hypothesis.change.family != change.family or (
        hypothesis.change.name in STRUT_NAMES and hypothesis.change.name != change.name
    )
