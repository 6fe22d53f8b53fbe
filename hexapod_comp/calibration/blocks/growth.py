"""Growth of struts, base and platform with temperature, at once or with a delay ("late"), and with the air's humidity.

A part grows in proportion to its thermometer's temperature above 20 °C; :mod:`hexapod_comp.machine.temperatures`
describes the delay as a first-order lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...machine.temperatures import PARTS, REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE, LateGrowth, thermal_lags
from ...measurements.readings import Stations
from ..assumptions import ASSUMED
from .block import Block, Columns, Draft, Errors, Facts, Linkage, StrutBlock

if TYPE_CHECKING:
    from ..parameters import FitSettings


def per_growth(linkage: Linkage) -> np.ndarray:
    """Return the derivative of strut lengths by the relative growth of struts 1-6, base, platform, (M, 6, 8), m."""
    along = [np.einsum("mik,mik->mi", linkage.directions, joints) for joints in (linkage.base_joints, -linkage.arms)]
    struts = np.eye(6) * linkage.lengths[:, None]
    return np.concatenate([struts, np.stack(along, axis=2)], axis=2)


def growth_causes(settings: FitSettings, stations: Stations, constants: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return each part's temperature above 20 °C, then its lag for each time constant, in kelvins; (M, 8, 1 + lags)."""
    sensors = LateGrowth(thermometer=settings.thermometer)
    read = stations.temperatures[:, [sensors.sensor_of(part) for part in range(len(PARTS))]]
    above = (read - REFERENCE_TEMPERATURE)[..., None]
    if not len(constants) or not np.isfinite(stations.times).all():
        return np.concatenate([above, np.zeros((*read.shape, len(constants)))], axis=2)
    return np.concatenate([above, thermal_lags(stations.times, read, constants)], axis=2)


def growth_root(terms: int, struts: float = ASSUMED.struts_warmed_alike) -> np.ndarray:
    """Return the root of the prior correlation of growths, (8·terms, 8·terms); `struts`: correlation of two struts."""
    alike = np.eye(len(PARTS))
    alike[:6, :6] += struts * (1.0 - np.eye(6))
    return np.kron(np.linalg.cholesky(alike), np.eye(terms))


def undetermined_growth(settings: FitSettings, stations: Stations) -> tuple[str, set[str]]:
    """Return the part with the only thermometer ('' if there are several), and the blocks that cannot be determined."""
    temperatures = stations.temperatures
    seen = np.flatnonzero((temperatures != REFERENCE_TEMPERATURE).any(axis=0))
    thermometer = settings.thermometer or (PARTS[seen[0]] if len(seen) == 1 else "")
    seen = np.array([PARTS.index(thermometer)]) if thermometer else np.arange(len(PARTS))
    warmed = bool(np.ptp(temperatures[:, seen], axis=0).max() >= ASSUMED.least_warming)
    damped = bool(np.ptp(np.nan_to_num(stations.humidity, nan=REFERENCE_HUMIDITY)) >= ASSUMED.least_damping)
    shown = {"expansion": warmed, "moisture": damped, "late": warmed and bool(np.isfinite(stations.times).all())}
    return thermometer, {name for name, fits in shown.items() if not fits}


class Expansion(Block):
    """Thermal expansion of struts 1-6, base and platform minus their stated expansion, 1/K."""

    name, unit, tolerance = "expansion", "1/K", 10e-6

    def __init__(self, settings: FitSettings) -> None:
        self._settings = settings
        self.labels = tuple(f"{part} expansion beyond the stated" for part in PARTS)
        self.root = growth_root(1, ASSUMED.struts_warmed_alike if settings.thermometer else ASSUMED.struts_alike)

    @classmethod
    def of(cls, facts: Facts) -> Expansion | None:
        """Return the block for any machine; the settings omit it if the temperatures hardly change."""
        return cls(facts.settings)

    def causes(self, stations: Stations) -> np.ndarray:
        """Return the temperature differences that multiply the parts' expansions, (M, 8, terms), K."""
        return growth_causes(self._settings, stations, ())

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return the columns: derivative of the error by a part's growth, times the temperature differences."""
        grown, causes = per_growth(linkage), self.causes(linkage.stations)

        def columns(errors: Errors) -> np.ndarray:
            each = np.einsum("ns,nsp->np", errors.gains, grown[errors.at])
            moved = (each[..., None] * causes[errors.at]).reshape(len(errors.at), -1)
            return moved @ self.root if whitened else moved

        return columns

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.growth = draft.growth + x


class Late(Expansion):
    """Expansion of each part in proportion to its lag behind the thermometer, 1/K, for each time constant."""

    name, unit, tolerance = "late", "1/K", 10e-6
    extends = Expansion.name  # a lag ends: without expansion, no part would grow in the end

    def __init__(self, settings: FitSettings) -> None:
        self._settings, self._constants = settings, settings.time_constants or ()
        self.labels = tuple(f"{part} late by {constant:.0f} s" for part in PARTS for constant in self._constants)
        self.root = growth_root(len(self._constants))

    @classmethod
    def of(cls, facts: Facts) -> Late | None:
        return cls(facts.settings) if facts.settings.time_constants else None

    def causes(self, stations: Stations) -> np.ndarray:
        """Return the lag of each part behind its thermometer for each time constant, (M, 8, time constants), K."""
        return growth_causes(self._settings, stations, self._constants)[..., 1:]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the late expansions into a model, one column for each time constant."""
        draft.late = x.reshape(len(PARTS), len(self._constants))


class Moisture(StrutBlock):
    """Swelling of all struts, m/m from relative humidity 0 to 1, minus the stated swelling; one parameter."""

    name, unit, tolerance = "moisture", "1", 1e-4

    def __init__(self) -> None:
        super().__init__(("moisture of the struts beyond the stated",), np.eye(1))
        self.root = np.eye(1)

    @classmethod
    def of(cls, facts: Facts) -> Moisture | None:
        return cls() if facts.settings.strut_moisture is not None else None

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return strut length · (humidity − reference humidity), (M, 6, 1), m; 0 if the humidity is unknown."""
        damp = np.nan_to_num(linkage.stations.humidity - REFERENCE_HUMIDITY)
        return (linkage.lengths * damp[:, None])[..., None]

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Return one column, the sum of the six struts' columns, since all struts share the parameter."""
        each = super().design(linkage, whitened)
        return lambda errors: each(errors).sum(axis=1, keepdims=True)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.struts["moisture"] = draft.struts["moisture"] + x
