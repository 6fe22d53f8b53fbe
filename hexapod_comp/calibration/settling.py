"""Which further readings would tell two explanations of the same check readings apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputFileError
from ..measurements.campaign import Campaign, template
from ..measurements.readings import BACKWARD, CHANNELS, KINDS, MeasurementSet
from .changes import Explanation
from .estimator import Estimation
from .posterior import FittedParameters

ABSOLUTE = (KINDS.index("position"), KINDS.index("attitude"))
"""Kinds that are read at scattered poses; the others are read along lines."""

SCATTERED, TILTS = 8, (10.0, 5.0, 0.0)
"""Poses that are tried, and their largest tilts, degrees: the first that is within reach."""

MOST = 3
"""So many are proposed."""


@dataclass(frozen=True)
class Settling:
    """Readings that would settle it.

    Attributes
    ----------
    name : str
        A line with its ends, or a pose.
    channels : tuple of str
        What to read there.
    readings : int
        How many.
    odds : float
        Logarithm of the odds to expect for the right explanation over the wrong one, whichever is right.
    """

    name: str
    channels: tuple[str, ...]
    readings: int
    odds: float


def settle(
    fitted: FittedParameters, measured: MeasurementSet, explanations: tuple[Explanation, Explanation]
) -> list[Settling]:
    """Return the readings that would tell two explanations apart best, the best first.

    Parameters
    ----------
    fitted : FittedParameters
        Tells the parameters, the box and the noise.
    measured : MeasurementSet
        The readings so far: what was read shows which instruments there are.
    explanations : tuple of Explanation
        The two, in the parameters of `fitted`.
    """
    proposals = []
    for readings in filter(len, _candidates(fitted, np.unique(measured.kind))):
        estimation = Estimation(readings, fitted.space, alone=False)
        problem, _ = estimation.linearise(fitted.x, np.ones(len(readings)))
        rows, cells = fitted.space.unwhitened(problem.rows.dense()), estimation.cells
        first = np.unique(cells.of_reading, return_index=True)[1]
        by_pose = np.isin(cells.kind, ABSOLUTE)
        groups = np.where(by_pose, cells.station, -1 - readings.run[first])
        for group in np.unique(groups):
            chosen = np.flatnonzero(groups == group)
            odds = _separation(rows[chosen], fitted.noise[cells.kind[chosen]], explanations)
            proposals.append(Settling(*described(readings, first[chosen]), len(chosen), odds))
    return sorted(proposals, key=lambda p: -p.odds)[:MOST]


def _separation(rows: np.ndarray, noise: np.ndarray, explanations: tuple[Explanation, Explanation]) -> float:
    """Return the smaller of the two divergences between what explanations expect of readings, nats."""
    difference = rows @ (explanations[0].mean - explanations[1].mean)
    first, second = (np.diag(noise**2) + rows @ e.covariance @ rows.T for e in explanations)
    return min(_divergence(difference, first, second), _divergence(difference, second, first))


def _divergence(difference: np.ndarray, right: np.ndarray, wrong: np.ndarray) -> float:
    """Return the Kullback–Leibler divergence of two normal distributions."""
    solved = np.linalg.solve(wrong, np.column_stack([right, difference]))
    logs = np.linalg.slogdet(wrong)[1] - np.linalg.slogdet(right)[1]
    return 0.5 * float(np.trace(solved[:, :-1]) - len(right) + difference @ solved[:, -1] + logs)


def _candidates(fitted: FittedParameters, kinds: np.ndarray) -> list[MeasurementSet]:
    """Return readings that could be taken in the measured box with instruments of these kinds."""
    space = fitted.space
    box, side = space.work_box, float(np.ptp(space.work_box, axis=0).min())
    if side <= 0.0:
        return []
    geometry, result = space.geometry, []
    level = geometry.work.rotation.T @ space.level @ geometry.tool.rotation
    grid = Campaign(box, side, side, "6-D", 4, level=level)
    if not np.isin(kinds, ABSOLUTE).all():
        lines = _of_kinds(template(grid, geometry), kinds)
        result.append(lines.select(lines.direction != BACKWARD))
    if np.isin(kinds, ABSOLUTE).any():
        for tilt in TILTS:
            poses = Campaign(box, side, side, None, 0, poses=SCATTERED, tilt=float(np.radians(tilt)), level=level)
            try:
                result.append(_of_kinds(template(poses, geometry), kinds))
                break
            except InputFileError:  # out of reach
                continue
    return result


def _of_kinds(readings: MeasurementSet, kinds: np.ndarray) -> MeasurementSet:
    return readings.select(np.isin(readings.kind, kinds))


def described(readings: MeasurementSet, members: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """Return where some readings of one run or one pose are taken, and what is read."""
    run = readings.runs[readings.run[members[0]]]
    channels = tuple(dict.fromkeys(CHANNELS[c] for c in readings.channel[members]))
    stations = readings.stations
    tips, _ = readings.geometry.tool_poses(stations.positions, stations.rotations)
    places = [", ".join(f"{1e3 * v:.1f}" for v in tips[s] + 0.0) for s in dict.fromkeys(readings.station[members])]
    return (
        f"{run.name}: {' – '.join((places[0], places[-1]))} mm" if run.is_line else f"pose {places[0]} mm"
    ), channels
