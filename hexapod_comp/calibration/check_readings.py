"""Check readings beside what a model and its fit expect of them, and what a change would make of them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from ..errors import CalibrationError
from ..measurements.readings import CHANNELS, MeasurementSet
from .changes import OTHER, READING, Change
from .estimator import Estimation
from .evidence import Evidence
from .posterior import FittedParameters

MOST_PLACES = 500
"""More distinct readings are no check but a calibration."""

SAME_POINT = 1e-9
"""Measured points nearer to each other than this, m, are one."""

SAME = 1e-9
"""Directions of readings that are left so small, beside the largest, are rounding."""

WRONG_READINGS = (5.0, 20.0, 100.0, 1000.0)
"""How far off a wrong reading may be, in standard deviations."""

SCATTERS = (2.0, 5.0, 20.0, 100.0)
"""How much more all readings may scatter, each by itself, in standard deviations."""


class CheckReadings:
    """Check readings beside what a model and its fit expect of them.

    Parameters
    ----------
    fitted : FittedParameters
        In a space that has all blocks, see :func:`~.changes.widened`.
    measurements : MeasurementSet
        The readings.
    x : ndarray, shape (size,), optional
        Parameters at which the machine is linearised; `residuals` are from those of `fitted` all the same.

    Attributes
    ----------
    residuals : ndarray, shape (n,)
        What the fit does not expect of the readings, in standard deviations, free of what instruments do not know.
    rows : ndarray, shape (n, size)
        How the parameters move them.
    noise : ndarray, shape (n, n)
        Their covariance where the machine is known.
    single : ndarray, shape (n, places)
        The effect of one reading that is wrong by one of its standard deviations.
    readings : list of int
        The first reading of each place.

    Raises
    ------
    CalibrationError
        Readings of another point than the fit's, such that tell nothing, or so many that they are a calibration.
    """

    def __init__(self, fitted: FittedParameters, measurements: MeasurementSet, x: np.ndarray | None = None) -> None:
        away = float(np.abs(measurements.probe - fitted.space.probe).max())
        if away > SAME_POINT:
            problem = f"are of a point {away * 1e3:.4g} mm from that of the fit; give its place (--probe-mm)"
            raise CalibrationError("measurements", problem)
        estimation = Estimation(measurements, fitted.space, alone=False)
        of_reading, kinds = estimation.cells.of_reading, estimation.cells.kind
        if len(kinds) > MOST_PLACES:
            problem = f"{len(kinds)} readings at distinct places are no check (at most {MOST_PLACES}); fit them"
            raise CalibrationError("measurements", problem)
        linear, _ = estimation.linearise(fitted.x if x is None else x, np.ones(len(measurements)))
        rows, seen = fitted.space.unwhitened(linear.rows.dense()), _seen(estimation)
        if not seen.shape[1]:
            problem = "tell nothing: the unknown zeros of their runs take all of them; read more places of each run"
            raise CalibrationError("measurements", problem)
        sigma = fitted.noise[kinds]
        self._seen = seen
        self.rows = seen.T @ rows
        self.residuals = seen.T @ linear.target - self.rows @ fitted.x
        self.noise = (seen.T * sigma**2) @ seen
        self.single = seen.T * sigma
        self.readings = [int((of_reading == cell).argmax()) for cell in range(len(kinds))]

    def part(self, contrasts: np.ndarray) -> CheckReadings:
        """Return what some differences of the places tell, shape (k, places), orthonormal and free of all zeros."""
        reduced, result = contrasts @ self._seen, copy(self)
        result.rows, result.residuals, result.single = (reduced @ a for a in (self.rows, self.residuals, self.single))
        result.noise = reduced @ self.noise @ reduced.T
        used = np.flatnonzero(contrasts.any(axis=0))
        result.single, result.readings = result.single[:, used], [self.readings[n] for n in used]
        result._seen = reduced
        return result

    def covariance(self, of_parameters: np.ndarray) -> np.ndarray:
        """Return the readings' covariance when the parameters have one, shape (n, n)."""
        return self.noise + self.rows @ of_parameters @ self.rows.T


def weigh(
    check: CheckReadings, fitted: FittedParameters, changes: list[Change], measurements: MeasurementSet
) -> Evidence:
    """Return the evidence of changes, of a single wrong reading, and of readings that scatter more than they did."""
    evidence = Evidence(check.covariance(fitted.covariance))
    for change in changes:
        evidence.add(change.family, change.name, check.rows @ change.columns, change.scales, change.group)
    for column, reading in zip(check.single.T, check.readings, strict=True):
        channel = CHANNELS[measurements.channel[reading]]
        name = f"{measurements.sources[reading]}: {channel} of run {measurements.runs[measurements.run[reading]].name}"
        evidence.add(READING, name, column[:, None], WRONG_READINGS)
    evidence.add(OTHER, "each reading by itself", check.single, SCATTERS, "scatter")
    return evidence


def _seen(estimation: Estimation) -> np.ndarray:
    """Return an orthonormal basis (places, n) of what is left of readings beside all that instruments do not know."""
    free = estimation.free_of_nuisance(np.eye(len(estimation.cells.station)))
    directions, sizes, _ = np.linalg.svd(free)
    return directions[:, sizes > SAME * sizes.max(initial=0.0)]


@dataclass(frozen=True)
class Explanation:
    """How the parameters differ from the fit's if one explanation of the readings is right.

    Attributes
    ----------
    mean : ndarray, shape (size,)
        SI.
    covariance : ndarray, shape (size, size)
        SI.
    """

    mean: np.ndarray
    covariance: np.ndarray


def explained(check: CheckReadings, fitted: FittedParameters, change: Change | None, scale: float) -> Explanation:
    """Return what readings make of the parameters if a change of one scale has happened; None: no change."""
    prior = fitted.covariance
    if change is not None:
        prior = prior + scale**2 * change.columns @ change.columns.T
    reached = check.rows @ prior
    gain = np.linalg.solve(check.covariance(prior), reached).T
    return Explanation(gain @ check.residuals, prior - gain @ reached)
