"""Compliance, lost motion and bearing friction of struts under load; parameters are deviations from stated values."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ...core import lib
from ...errors import CalibrationError
from ...machine.arrays import rms
from ...machine.geometry import STRUT_NAMES, HexapodGeometry
from ...machine.load import MOST_LOADS, Load, reciprocal
from ...measurements.readings import MeasurementSet, Stations
from ..assumptions import ASSUMED
from .block import Draft, Facts, LengthBlock, Linkage, Prediction

if TYPE_CHECKING:
    from ..parameters import FitSettings


def stated_load(settings: FitSettings) -> Load:
    """Return the stated behaviour of the struts under load; without a stated stiffness they are rigid."""
    return Load.from_numbers(settings.load) if settings.load else Load()


def refuse_half_stated(measurements: MeasurementSet) -> None:
    """Refuse readings of which only some state a payload, unless the tool's mass is known."""
    blank, tool = np.isnan(measurements.stations.loads[:, 0]), measurements.geometry.payload
    if blank.any() and not blank.all() and not tool.mass:
        where = measurements.sources[int(blank[measurements.station].argmax())]
        name = measurements.geometry.tool_name
        missing = f"other readings state a payload, and the geometry file gives {name} no mass"
        problem = f"has no payload_kg, but {missing}; write 0 if there is no payload"
        raise CalibrationError(str(where), problem)


def complete_loads(load: Load, geometry: HexapodGeometry, loads: np.ndarray) -> np.ndarray:
    """Return `loads` (stations, 7) with NaN replaced by the tool's mass and centre, and by the gravity of `load`."""
    tool = geometry.payload
    return np.where(np.isnan(loads), [tool.mass, *tool.centre, *load.gravity], loads)


def weights(load: Load, geometry: HexapodGeometry, stations: Stations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mass carried at M stations, kg, mass · centre in platform (M, 3), kg m, and gravity in base, m/s²."""
    payload, gravity = np.split(complete_loads(load, geometry, stations.loads), [4], axis=1)
    moment = load.mass * load.centre + payload[:, :1] * payload[:, 1:]
    return load.mass + payload[:, 0], moment, gravity


def measured_loads(load: Load, geometry: HexapodGeometry, stations: Stations) -> tuple[tuple[float, ...], ...]:
    """Return up to MOST_LOADS distinct loads of the readings, for the model file; () if none is stated."""
    if np.isnan(stations.loads).all() and not geometry.payload.mass and not load.bends:
        return ()
    rows = complete_loads(load, geometry, stations.loads).round(3)
    different = np.unique(rows, axis=0) + 0.0
    kept = np.unique(np.linspace(0, len(different) - 1, MOST_LOADS).round().astype(int))
    return tuple(map(tuple, different[kept].tolist()))


def bearing_forces(linkage: Linkage) -> np.ndarray:
    """Return each strut's force on the platform, N, per N m of friction torque of its bearings: (stations, 6, 3)."""
    u, motion, axes = linkage.directions, linkage.stations.sense[:, None, :3], linkage.geometry.base_axes
    slow = lib.SLIDING * np.maximum(np.linalg.norm(motion, axis=2), 1.0)
    if axes is not None:  # cardan joints, each with two bearings
        yoke = np.cross(axes, u)
        share = np.linalg.norm(yoke, axis=2, keepdims=True)
        first = yoke / np.maximum(share, lib.SLIDING)
        sides = (first, first / np.maximum(share, lib.SLIDING)), (np.cross(first, u),) * 2
        force = sum(np.clip((motion * n).sum(axis=2) / slow, -1.0, 1.0)[..., None] * along for n, along in sides)
    else:  # ball joints
        across = motion - (motion * u).sum(axis=2, keepdims=True) * u
        force = across / np.maximum(np.linalg.norm(across, axis=2), slow)[..., None]
    return -force / linkage.lengths[..., None]


@lru_cache(maxsize=1)  # three blocks need it
def tensions_per_friction(linkage: Linkage) -> np.ndarray:
    """Return the tension, N, of strut i per N m of friction torque in the bearings of strut j: (stations, i, j)."""
    forces = bearing_forces(linkage)
    wrenches = np.concatenate([forces, np.cross(linkage.arms, forces)], axis=2)
    return np.stack([linkage.tensions(wrenches[:, n]) for n in range(6)], axis=2)


@lru_cache(maxsize=1)
def tensions(linkage: Linkage) -> np.ndarray:
    """Return the struts' tensions (stations, 6), N, by weight and friction; positive if the strut is pulled."""
    load = linkage.load
    mass, moment, gravity = weights(load, linkage.geometry, linkage.stations)
    torque = np.cross(np.einsum("mij,mj->mi", linkage.rotations, moment), gravity)
    pulled = linkage.tensions(np.concatenate([mass[:, None] * gravity, torque], axis=1))
    return pulled + tensions_per_friction(linkage) @ load.friction if load.friction.any() else pulled


def taken_up(linkage: Linkage) -> np.ndarray:
    """Return tension / take-up force (stations, 6), clipped at ±1; at +1 a strut is longer by half its lost motion."""
    return np.clip(tensions(linkage) / linkage.load.take_up, -1.0, 1.0)


def unsettled_lengths(linkage: Linkage) -> np.ndarray:
    """Return the standard deviation (stations, 6) of strut lengths, m, due to an unknown end of the clearance.

    If a strut's tension is below the take-up force, the model uses the mean of its lengths at both ends of the
    clearance, weighted by their probabilities. Each clearance is raised to at least the RMS of all six, because
    readings may not determine each.
    """
    usual = np.maximum(linkage.load.lost_motion, rms(linkage.load.lost_motion))
    deviation: np.ndarray = 0.5 * usual * np.sqrt(1.0 - taken_up(linkage) ** 2)
    return deviation


class LoadBlock(LengthBlock):
    """Fitted minus stated value of a property of each strut under load; the prior correlates the six values."""

    term: ClassVar[str]  # name of the property in Load

    def __init__(self, facts: Facts) -> None:
        self.labels = tuple(f"{strut} {self.name}" for strut in STRUT_NAMES)
        self.root = np.linalg.cholesky(ASSUMED.alike + (1.0 - ASSUMED.alike) * np.eye(6))

    @classmethod
    def of(cls, facts: Facts) -> LoadBlock | None:
        return cls(facts) if stated_load(facts.settings).stiffness.all() else None

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Add the fitted deviations to the stated values; noise may make a sum slightly negative."""
        draft.load = replace(draft.load, **{self.term: getattr(draft.load, self.term) + x})


class Compliance(LoadBlock):
    """Compliance c of each strut, m/N: δl = c · tension."""

    name, unit, tolerance, stated = "compliance", "m/N", 15e-9, True

    def __init__(self, facts: Facts) -> None:
        super().__init__(facts)
        compliance = stated_load(facts.settings).compliance
        self.tolerance = ASSUMED.stated_stiffness * compliance.mean()
        self.root = compliance[:, None] / compliance.mean() * self.root

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        return tensions(linkage)[..., None] * np.eye(6)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write stiffnesses of at most ten times the stated ones, because steps of the fit may overshoot."""
        stated = draft.load.compliance
        draft.load = replace(draft.load, stiffness=reciprocal(np.maximum(stated + x, 0.1 * stated)))


class LostMotion(LoadBlock):
    """Lost motion c: δl = +c/2 of a pulled strut, −c/2 of a pushed one, in between proportional to the force."""

    name, unit, tolerance, term = "lost motion", "m", 3e-6, "lost_motion"

    @classmethod
    def of(cls, facts: Facts) -> LoadBlock | None:
        return cls(facts) if facts.settings.load else None

    @classmethod
    def shown(cls, settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> bool:
        """Whether a strut is pulled at one station and pushed at another; if not, lost motion acts like an offset."""
        if not settings.load:
            return False
        load, joints = stated_load(settings), (geometry.base_joints, geometry.platform_joints)
        base, platform = (np.tile(each, (len(stations), 1, 1)) for each in joints)
        errors = np.zeros((len(stations), 6))
        nominal = Prediction(errors, stations.positions, stations.rotations, base, platform, load, geometry)
        pulled = tensions(Linkage(nominal, np.zeros(3), stations))
        return bool(((pulled.min(axis=0) < -load.take_up) & (pulled.max(axis=0) > load.take_up)).any())

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        return 0.5 * taken_up(linkage)[..., None] * np.eye(6)


class Friction(LoadBlock):
    """Friction torque of each strut's bearings, N m; it acts against the motion and changes all six tensions."""

    name, unit, tolerance, term = "friction", "N m", 0.5, "friction"

    @classmethod
    def shown(cls, settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> bool:
        return bool(stations.sense[:, :3].any())

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return the derivatives of strut lengths by friction torques: ∂length/∂tension · ∂tension/∂torque."""
        load = linkage.load
        within_take_up = np.abs(taken_up(linkage)) < 1.0
        per_newton = load.compliance + 0.5 * load.lost_motion / load.take_up * within_take_up
        return per_newton[..., None] * tensions_per_friction(linkage)
