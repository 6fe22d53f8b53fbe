"""Compliance: the stretch of a strut with its joints under its force, beyond the stated one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...errors import CalibrationError
from ...machine.geometry import HexapodGeometry
from ...machine.load import MOST_LOADS, Load
from ...measurements.readings import MeasurementSet, Stations
from ..assumptions import ASSUMED
from .block import Draft, Facts, Linkage, Prediction, StrutBlock

if TYPE_CHECKING:
    from ..parameters import FitSettings


def stated_load(settings: FitSettings) -> Load:
    """Return the load block of the settings; a rigid one if they state none."""
    return Load.from_numbers(settings.load) if settings.load else Load()


def refuse_half_stated(measurements: MeasurementSet) -> None:
    """Raise CalibrationError where some readings state a payload, and that of the others is unknown."""
    blank, tool = np.isnan(measurements.stations.loads[:, 0]), measurements.geometry.payload
    if blank.any() and not blank.all() and not tool.mass:
        where = measurements.sources[int(blank[measurements.station].argmax())]
        name = measurements.geometry.tool_name
        problem = f"has no payload_kg where others do, and the geometry file gives {name} no mass; write 0 for none"
        raise CalibrationError(str(where), problem)


def payloads(geometry: HexapodGeometry, stations: Stations) -> np.ndarray:
    """Return mass, kg, and its centre in platform, m, carried at stations, (M, 4): as stated, else the tool's."""
    tool = geometry.payload
    return np.where(np.isnan(stations.loads[:, :1]), [tool.mass, *tool.centre], stations.loads[:, :4])


def directions_of_gravity(load: Load, stations: Stations) -> np.ndarray:
    """Return gravity in base at stations, m/s², (M, 3): as stated, else the load block's."""
    return np.where(np.isnan(stations.loads[:, 4:5]), load.gravity, stations.loads[:, 4:])


def weights(load: Load, geometry: HexapodGeometry, stations: Stations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass, kg, (M,), mass times its centre in platform, kg m, (M, 3), and gravity, m/s², (M, 3)."""
    payload, gravity = payloads(geometry, stations), directions_of_gravity(load, stations)
    moment = load.mass * load.centre + payload[:, :1] * payload[:, 1:]
    return load.mass + payload[:, 0], moment, gravity


def measured_loads(load: Load, geometry: HexapodGeometry, stations: Stations) -> tuple[tuple[float, ...], ...]:
    """Return the different loads of stations, for :attr:`.ModelOrigin.loads`; none if no load is stated."""
    if np.isnan(stations.loads).all() and not geometry.payload.mass and not load.bends:
        return ()
    rows = np.hstack([payloads(geometry, stations), directions_of_gravity(load, stations)]).round(3)
    different = np.unique(rows, axis=0) + 0.0
    kept = np.unique(np.linspace(0, len(different) - 1, MOST_LOADS).round().astype(int))
    return tuple(map(tuple, different[kept].tolist()))


def tensions(load: Load, geometry: HexapodGeometry, linkage: Linkage) -> np.ndarray:
    """Return what the struts pull with under the weight at a linkage's stations, (M, 6), N."""
    mass, moment, gravity = weights(load, geometry, linkage.stations)
    torque = np.cross(np.einsum("mij,mj->mi", linkage.rotations, moment), gravity)
    return linkage.tensions(np.concatenate([mass[:, None] * gravity, torque], axis=1))


def as_loaded(settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> set[str]:
    """Return the blocks of load that stations cannot show: at one load, or with forces of one sign, struts look longer.

    Forces are those of the nominal machine.
    """
    load, hidden = stated_load(settings), {"compliance", "lost motion"}
    if not settings.load or not len(stations):
        return hidden
    mass, _, gravity = weights(load, geometry, stations)
    forces = mass[:, None] * gravity
    if load.stiffness.all() and np.linalg.norm(np.ptp(forces, axis=0)) >= ASSUMED.least_load:
        hidden.remove("compliance")
    joints = (np.tile(each, (len(stations), 1, 1)) for each in (geometry.base_joints, geometry.platform_joints))
    nominal = Prediction(np.zeros((len(stations), 6)), stations.positions, stations.rotations, *joints)
    pulled = tensions(load, geometry, Linkage(nominal, np.zeros(3), stations))
    if ((pulled.min(axis=0) < -load.take_up) & (pulled.max(axis=0) > load.take_up)).any():
        hidden.remove("lost motion")
    return hidden


class Compliance(StrutBlock):
    """c of each strut, m/N, beyond the stated: δl = c · its tension under weight."""

    name, unit, tolerance = "compliance", "m/N", 15e-9

    def __init__(self, load: Load, geometry: HexapodGeometry) -> None:
        super().__init__()
        self._load, self._geometry = load, geometry

    @classmethod
    def of(cls, facts: Facts) -> Compliance | None:
        """If a stiffness is stated; the settings' blocks report whether there were several loads."""
        load = stated_load(facts.settings)
        return cls(load, facts.geometry) if load.stiffness.all() else None

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """The struts' tensions."""
        return tensions(self._load, self._geometry, linkage)[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """It adds to what is stated."""
        draft.compliance = draft.compliance + x
