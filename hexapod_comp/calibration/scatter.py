"""What residuals show of the machine that no parameter describes: what is alike there and back, and what never repeats.

The first is an error that stays where it is. The second is how far the machine stops from where it stopped before, its
repeatability (ISO 230-2), as far as the readings scatter more than their instrument does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..machine.arrays import different_rows
from ..measurements.readings import ANGULAR_KINDS, BACKWARD, FORWARD, KINDS
from .estimator import MEDIAN_TO_SIGMA
from .promise import Scatter
from .residuals import Residuals

CLEAR = 3.0
"""What residuals show is no chance from so many standard deviations on."""

CUT, LEFT_BY_CUT = 2.0, 0.911
"""Residuals of pairs count for no more standard deviations than that, for an instrument that slips puts many readings
off; and what is left by that of the covariance of normal ones that are nearly independent, (P(|x| < 2))²."""

LEAST_LEFT = 0.25
"""No more than the rest is taken for swallowed by the parameters."""

FIELDS = ("field displacement", "field rotation")
"""Blocks of terms that are equally smooth."""

LEAST_PAIRS = 30
"""Pairs of readings there and back from which on their likeness tells the machine's errors from noise."""

LEAST_REPEATED = 30.0
"""Readings beyond the first of their cell from which on they tell what does not repeat."""

MOST = 2.0
"""A variance is at most so many standard deviations larger than it was estimated."""


class _OfKind(NamedTuple):
    """Variances that one kind of readings shows beyond its stated noise, m² or rad²; 0 where it may be chance.

    Attributes
    ----------
    alike, most_alike : float
        Shared by readings there and back, with the part that the parameters have swallowed; and what would have shown.
    stops, most_stops : float
        Of what never repeats, and what it is at most.
    cells : int
        How many cells tell so.
    """

    alike: float
    most_alike: float
    stops: float
    most_stops: float
    cells: int


def scatter(r: Residuals) -> tuple[Scatter, Scatter]:
    """Return what residuals show of the tool's displacement, and of its rotation, that no parameter describes.

    A field that is not as smooth as its terms shows that first where it is large beside the readings' noise, in its
    rotations as a rule; in displacements there is as much, in proportion to the sizes that were fitted, unless so much
    would have shown there as well.
    """
    kinds = np.unique(r.estimation.cells.kind)
    parts = [_of_kind(r, k) for k in kinds]
    angular = np.array([KINDS[k] in ANGULAR_KINDS for k in kinds])
    (displacement, hidden), (rotation, hidden_rotation) = (
        _together([parts[n] for n in np.flatnonzero(which)]) for which in (~angular, angular)
    )
    space, sizes = r.estimation.space, r.solution.posterior.tolerances
    fields = {b.name: size for b, size in zip(space.blocks, sizes, strict=True) if b.name in FIELDS and size > 0.0}
    if len(fields) == len(FIELDS):
        ratio = float(fields[FIELDS[0]] / fields[FIELDS[1]])
        shifted = max(displacement.lack, min(rotation.lack * ratio, hidden))
        turned = max(rotation.lack, min(displacement.lack / ratio, hidden_rotation))
        displacement, rotation = displacement._replace(lack=shifted), rotation._replace(lack=turned)
    return displacement, rotation


def _together(parts: list[_OfKind]) -> tuple[Scatter, float]:
    """Return what kinds of readings show together, the mean variance of an axis, three times; and the most alike."""
    if not parts:
        return Scatter(), 0.0
    mean = np.average([part[:-1] for part in parts], 0, [part.cells for part in parts])
    alike, most_alike, stops, most_stops = np.sqrt(3.0 * mean).tolist()
    return Scatter(alike, stops, most_stops), most_alike


def _of_kind(r: Residuals, kind: int) -> _OfKind:
    """Return what one kind of readings shows."""
    m, estimated = r.estimation.measurements, float(r.solution.posterior.noise[kind] ** 2)
    readings, cells = int((m.kind == kind).sum()), int((r.estimation.cells.kind == kind).sum())
    there, back = _pairs(r, kind)
    repeated, freedom = _repeated(r, kind)
    own = error = 0.0
    if len(there) >= LEAST_PAIRS:
        shared, kept = _likeness(r, there, back)
        # Residuals of cells count in their means' noise, which is smaller than a reading's.
        alike, clear = (v * estimated / kept * cells / readings for v in (shared, CLEAR / np.sqrt(len(there))))
        own, error = (1.0 - shared) * estimated - 1.0, estimated * np.sqrt(2.0 / readings + 1.0 / len(there))
    if freedom >= LEAST_REPEATED:
        own, error = repeated - 1.0, repeated * np.sqrt(2.0 / freedom)
    own = own if own > CLEAR * error else 0.0
    if len(there) < LEAST_PAIRS:  # what is beyond noise, and may repeat, is taken for the machine's
        alike, clear = estimated - 1.0 - own, CLEAR * estimated * np.sqrt(2.0 / readings)
    variance = m.stated_of(kind) ** 2
    return _OfKind(
        alike=variance * alike if alike > clear else 0.0,
        most_alike=variance * max(alike, clear),
        stops=variance * own,
        most_stops=variance * (own + MOST * error) if own else 0.0,
        cells=cells,
    )


def _repeated(r: Residuals, kind: int) -> tuple[float, float]:
    """Return the variance of readings about their cell's mean, in the stated noise's, and its degrees of freedom."""
    m, solution, cell = r.estimation.measurements, r.solution, r.estimation.cells.of_reading
    members = np.flatnonzero(m.kind == kind)
    cell, weights = cell[members], solution.weights[members]
    values = solution.residuals[members] / r.estimation.uncertainty[members]
    total = np.bincount(cell, weights)
    mean = np.bincount(cell, weights * values)[cell] / total[cell]
    freedom = float(len(members) - len(np.unique(cell)))
    return float(((weights * (values - mean)) ** 2).sum()) / max(freedom, 1.0), freedom


def _pairs(r: Residuals, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells of a kind that were read forward, and those read backward at the same places."""
    cells, stations = r.estimation.cells, r.estimation.measurements.stations
    poses = np.hstack([stations.positions, stations.rotations.reshape(-1, 9)]).round(9)
    pose = different_rows(poses)[1][cells.station]
    keys = np.stack([r.run, cells.channel, pose], axis=1)
    key = different_rows(keys)[1]
    ways = []
    for direction in (FORWARD, BACKWARD):
        members = np.flatnonzero((cells.kind == kind) & (r.direction == direction))
        ways.append((members, key[members]))
    (there, a), (back, b) = ways
    _, first, second = np.intersect1d(a, b, return_indices=True)
    return there[first], back[second]


def _likeness(r: Residuals, there: np.ndarray, back: np.ndarray) -> tuple[float, float]:
    """Return the variance that pairs of cells share, in their estimated noise's, and what fitting has left of it.

    Fitting makes the noise of a pair unlike each other, by what both give to the parameters and to the run's unknowns;
    and it takes up that part of what they share.
    """
    # Means of repeated readings are off by more than their noise where each has an error of its own.
    size = max(1.0, MEDIAN_TO_SIGMA * float(np.median(np.abs(r.residual[there]))))
    cut = np.clip(r.residual, -CUT * size, CUT * size)
    groups = r.estimation.cells.group
    sizes = np.bincount(groups + 1)[groups[there] + 1]
    unlike = r.shared(there, back) + np.where(groups[there] < 0, 0.0, 1.0 / sizes)
    shared = (cut[there] * cut[back] / LEFT_BY_CUT + unlike).mean()
    return float(shared), float(max(1.0 - (r.taken[there] + unlike).mean(), LEAST_LEFT))
