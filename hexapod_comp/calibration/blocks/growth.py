"""Growth of struts, base and platform with the temperature above 20 °C, at once or delayed ("late"), and with humidity.

The delay is a first-order lag behind the thermometer: :mod:`hexapod_comp.machine.temperatures`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...machine.geometry import HexapodGeometry
from ...machine.temperatures import PARTS, REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE, LateGrowth, thermal_lags
from ...measurements.readings import Stations
from ..assumptions import ASSUMED
from .block import Draft, Facts, LengthBlock, Linkage

if TYPE_CHECKING:
    from ..parameters import FitSettings


def per_growth(linkage: Linkage) -> np.ndarray:
    """Return derivatives (stations, 6, 8) of lengths, m, by the relative growth of struts 1-6, base and platform."""
    along = [np.einsum("mik,mik->mi", linkage.directions, joints) for joints in (linkage.base_joints, -linkage.arms)]
    struts = np.eye(6) * linkage.lengths[:, None]
    return np.concatenate([struts, np.stack(along, axis=2)], axis=2)


def growth_causes(settings: FitSettings, stations: Stations, constants: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return each part's temperature above 20 °C, then its lag for n time constants, K: (stations, 8, 1 + n)."""
    sensors = LateGrowth(thermometer=settings.thermometer)
    read = stations.temperatures[:, [sensors.sensor_of(part) for part in range(len(PARTS))]]
    above = (read - REFERENCE_TEMPERATURE)[..., None]
    if not len(constants) or not np.isfinite(stations.times).all():
        return np.concatenate([above, np.zeros((*read.shape, len(constants)))], axis=2)
    return np.concatenate([above, thermal_lags(stations.times, read, constants)], axis=2)


def growth_root(terms: int, struts: float = ASSUMED.struts_warmed_alike) -> np.ndarray:
    """Return a root of the prior correlation of growth parameters; any two struts have the correlation `struts`."""
    alike = np.eye(len(PARTS))
    alike[:6, :6] += struts * (1.0 - np.eye(6))
    return np.kron(np.linalg.cholesky(alike), np.eye(terms))


def used_thermometer(settings: FitSettings, stations: Stations) -> str:
    """Return the part whose thermometer is used for all parts; empty if each part's own is used."""
    read = stations.thermometers
    return settings.thermometer or (read[0] if len(read) == 1 else "")


class Expansion(LengthBlock):
    """Thermal expansion minus stated thermal expansion of struts 1-6, base and platform, 1/K."""

    name, unit, tolerance = "expansion", "1/K", 10e-6

    def __init__(self, settings: FitSettings) -> None:
        self._settings = settings
        self.labels = tuple(f"{part} expansion minus the stated" for part in PARTS)
        self.root = growth_root(1, ASSUMED.struts_warmed_alike if settings.thermometer else ASSUMED.struts_alike)

    @classmethod
    def of(cls, facts: Facts) -> Expansion | None:
        return cls(facts.settings)

    @classmethod
    def shown(cls, settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> bool:
        thermometer = used_thermometer(settings, stations)
        read = stations.temperatures[:, PARTS.index(thermometer)] if thermometer else stations.temperatures
        return bool(np.ptp(read, axis=0).max() >= ASSUMED.least_warming)

    def causes(self, stations: Stations) -> np.ndarray:
        """Return factors (stations, 8, terms), K: times the parameters they give the relative growth of each part."""
        return growth_causes(self._settings, stations, ())

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        grown, causes = per_growth(linkage), self.causes(linkage.stations)
        return (grown[..., None] * causes[:, None]).reshape(*grown.shape[:2], -1)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.growth = draft.growth + x


class Late(Expansion):
    """Delayed growth of each part per kelvin of its lag behind the thermometer, 1/K, for each time constant."""

    name, unit, tolerance = "late", "1/K", 10e-6
    extends = Expansion.name  # at a constant temperature lags vanish, and only the expansion remains

    def __init__(self, settings: FitSettings) -> None:
        self._settings, self._constants = settings, settings.time_constants or ()
        self.labels = tuple(f"{part} late by {constant:.0f} s" for part in PARTS for constant in self._constants)
        self.root = growth_root(len(self._constants))

    @classmethod
    def of(cls, facts: Facts) -> Late | None:
        return cls(facts.settings) if facts.settings.time_constants else None

    @classmethod
    def shown(cls, settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> bool:
        return super().shown(settings, geometry, stations) and bool(np.isfinite(stations.times).all())

    def causes(self, stations: Stations) -> np.ndarray:
        return growth_causes(self._settings, stations, self._constants)[..., 1:]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.late = x.reshape(len(PARTS), len(self._constants))


class Moisture(LengthBlock):
    """One parameter: swelling of all struts from 0 to 100 % relative humidity, minus the stated swelling, m/m."""

    name, unit, tolerance = "moisture", "1", 1e-4
    labels, root = ("moisture of the struts minus the stated",), np.eye(1)

    @classmethod
    def of(cls, facts: Facts) -> Moisture | None:
        return cls() if facts.settings.strut_moisture is not None else None

    @classmethod
    def shown(cls, settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> bool:
        humidity = np.nan_to_num(stations.humidity, nan=REFERENCE_HUMIDITY)
        return bool(np.ptp(humidity) >= ASSUMED.least_damping)

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return strut length · (humidity − reference humidity), m: (stations, 6, 1); 0 if the humidity is unknown."""
        damp = np.nan_to_num(linkage.stations.humidity - REFERENCE_HUMIDITY)
        return (linkage.lengths * damp[:, None])[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.struts["moisture"] = draft.struts["moisture"] + x
