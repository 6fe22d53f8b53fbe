"""Compliance: what a strut with its joints gives under its force, beyond what is stated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...machine.geometry import HexapodGeometry
from ...machine.load import MOST_LOADS, Load
from ...measurements.readings import Stations
from ..assumptions import ASSUMED
from .block import Draft, Facts, Linkage, StrutBlock

if TYPE_CHECKING:
    from ..parameters import FitSettings


def stated_load(settings: FitSettings) -> Load:
    """Return the load block that a fit is told; one that is rigid where it is told of none."""
    return Load.from_numbers(settings.load) if settings.load else Load()


def weights(load: Load, geometry: HexapodGeometry, stations: Stations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mass, kg, (M,), mass times its centre in platform, kg m, (M, 3), and gravity, m/s², (M, 3)."""
    tool, told = geometry.payload, stations.loads
    payload = np.where(np.isnan(told[:, :1]), [tool.mass, *tool.centre], told[:, :4])
    gravity = np.where(np.isnan(told[:, 4:5]), load.gravity, told[:, 4:])
    moment = load.mass * load.centre + payload[:, :1] * payload[:, 1:]
    return load.mass + payload[:, 0], moment, gravity


def measured_loads(load: Load, geometry: HexapodGeometry, stations: Stations) -> tuple[tuple[float, ...], ...]:
    """Return the different loads of stations, as :attr:`.ModelOrigin.loads` has them; none where nobody states any."""
    told = stations.loads
    if np.isnan(told).all() and not geometry.payload.mass and not load.bends:
        return ()
    tool = geometry.payload
    payload = np.where(np.isnan(told[:, :1]), [tool.mass, *tool.centre], told[:, :4])
    gravity = np.where(np.isnan(told[:, 4:5]), load.gravity, told[:, 4:])
    rows = np.hstack([payload.round(3), gravity.round(3)])
    different = np.unique(rows, axis=0) + 0.0
    kept = np.unique(np.linspace(0, len(different) - 1, MOST_LOADS).round().astype(int))
    return tuple(map(tuple, different[kept].tolist()))


def as_loaded(settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> set[str]:
    """Return the blocks of load that stations cannot show: one load is a change of the struts' lengths."""
    load = stated_load(settings)
    mass, _, gravity = weights(load, geometry, stations)
    forces = mass[:, None] * gravity
    several = bool(np.linalg.norm(np.ptp(forces, axis=0)) >= ASSUMED.least_load) if len(forces) else False
    return set() if several and load.stiffness.all() else {"compliance"}


class Compliance(StrutBlock):
    """c of each strut, m/N, beyond the stated: δl = c · its tension under weight."""

    name, unit, tolerance = "compliance", "m/N", 15e-9

    def __init__(self, load: Load, geometry: HexapodGeometry) -> None:
        super().__init__()
        self._load, self._geometry = load, geometry

    @classmethod
    def of(cls, facts: Facts) -> Compliance | None:
        """Where a stiffness is stated; whether there were several loads, the settings' blocks report."""
        load = stated_load(facts.settings)
        return cls(load, facts.geometry) if load.stiffness.all() else None

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """The struts' tensions."""
        mass, moment, gravity = weights(self._load, self._geometry, linkage.stations)
        torque = np.cross(np.einsum("mij,mj->mi", linkage.rotations, moment), gravity)
        return linkage.tensions(np.concatenate([mass[:, None] * gravity, torque], axis=1))[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """It adds to what is stated."""
        draft.compliance = draft.compliance + x
