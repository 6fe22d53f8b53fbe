"""How far struts yield under load, beyond the stated values: compliance, lost motion by force, friction of their
bearings."""

from __future__ import annotations

from abc import abstractmethod
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ...core import SLIDING
from ...errors import CalibrationError
from ...machine.arrays import rms
from ...machine.geometry import STRUT_NAMES, HexapodGeometry
from ...machine.load import MOST_LOADS, Load
from ...measurements.readings import MeasurementSet, Stations
from ..assumptions import ASSUMED
from .block import Block, Columns, Draft, Facts, Linkage, Prediction

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


def bearing_forces(linkage: Linkage) -> np.ndarray:
    """Return the force of each strut's bearings on the platform when they resist with 1 N m, (M, 6, 3), N."""
    u, motion, axes = linkage.directions, linkage.stations.sense[:, None, :3], linkage.geometry.base_axes
    slow = SLIDING * np.maximum(np.linalg.norm(motion, axis=2), 1.0)
    if axes is not None:  # two bearings of a cardan joint turn
        yoke = np.cross(axes, u)
        share = np.linalg.norm(yoke, axis=2, keepdims=True)
        first = yoke / np.maximum(share, SLIDING)
        sides = (first, first / np.maximum(share, SLIDING)), (np.cross(first, u),) * 2
        force = sum(np.clip((motion * n).sum(axis=2) / slow, -1.0, 1.0)[..., None] * along for n, along in sides)
    else:
        across = motion - (motion * u).sum(axis=2, keepdims=True) * u
        force = across / np.maximum(np.linalg.norm(across, axis=2), slow)[..., None]
    return -force / linkage.lengths[..., None]


@lru_cache(maxsize=1)  # three blocks ask for the same linkage's
def by_friction(linkage: Linkage) -> np.ndarray:
    """Return the struts' tensions by 1 N m in the bearings of each strut, (M, 6, 6), N."""
    forces = bearing_forces(linkage)
    wrenches = np.concatenate([forces, np.cross(linkage.arms, forces)], axis=2)
    return np.stack([linkage.tensions(wrenches[:, n]) for n in range(6)], axis=2)


@lru_cache(maxsize=1)
def tensions(linkage: Linkage) -> np.ndarray:
    """Return the struts' tensions under weight and friction at a linkage's stations, (M, 6), N."""
    load = linkage.load
    mass, moment, gravity = weights(load, linkage.geometry, linkage.stations)
    torque = np.cross(np.einsum("mij,mj->mi", linkage.rotations, moment), gravity)
    pulled = linkage.tensions(np.concatenate([mass[:, None] * gravity, torque], axis=1))
    return pulled + by_friction(linkage) @ load.friction if load.friction.any() else pulled


def taken_up(linkage: Linkage) -> np.ndarray:
    """Return the share of half its lost motion by which each strut is longer at a linkage's stations, (M, 6), −1…1."""
    return np.clip(tensions(linkage) / linkage.load.take_up, -1.0, 1.0)


def unsettled_lengths(linkage: Linkage) -> np.ndarray:
    """Return the standard deviation of the struts' lengths where the take-up exceeds their tension, (M, 6), m.

    A clearance rests at one of its ends. Which one depends on a force that is not known better than the take-up, so the
    model lengthens the strut by the mean of both, weighted by their probabilities. A strut whose own clearance hardly
    shows has the usual one of the six.
    """
    usual = np.maximum(linkage.load.lost_motion, rms(linkage.load.lost_motion))
    deviation: np.ndarray = 0.5 * usual * np.sqrt(1.0 - taken_up(linkage) ** 2)
    return deviation


def as_loaded(settings: FitSettings, geometry: HexapodGeometry, stations: Stations) -> set[str]:
    """Return the blocks of load that stations cannot determine: under forces of one sign a strut only looks longer.

    Forces are those of the nominal machine.
    """
    load, hidden = stated_load(settings), {"compliance", "lost motion", "friction"}
    if not settings.load or not len(stations):
        return hidden
    if load.stiffness.all():
        hidden.remove("compliance")
        if stations.sense[:, :3].any():
            hidden.remove("friction")
    base, platform = (np.tile(each, (len(stations), 1, 1)) for each in (geometry.base_joints, geometry.platform_joints))
    errors = np.zeros((len(stations), 6))
    nominal = Prediction(errors, stations.positions, stations.rotations, base, platform, load, geometry)
    pulled = tensions(Linkage(nominal, np.zeros(3), stations))
    if ((pulled.min(axis=0) < -load.take_up) & (pulled.max(axis=0) > load.take_up)).any():
        hidden.remove("lost motion")
    return hidden


class LoadBlock(Block):
    """A term of the load block, one number a strut, beyond what is stated; those of one machine's struts are alike."""

    term: ClassVar[str]  # its name in Draft.load

    def __init__(self, facts: Facts) -> None:
        self.labels = tuple(f"{strut} {self.name}" for strut in STRUT_NAMES)
        self.root = np.linalg.cholesky(ASSUMED.alike + (1.0 - ASSUMED.alike) * np.eye(6))

    @classmethod
    def of(cls, facts: Facts) -> LoadBlock | None:
        """Only if a stiffness is stated; whether readings determine it is decided before, in the settings' blocks."""
        return cls(facts) if stated_load(facts.settings).stiffness.all() else None

    @abstractmethod
    def stretched(self, linkage: Linkage) -> np.ndarray:
        """Return by how much each number lengthens the struts, (M, 6, 6)."""

    def design(self, linkage: Linkage, whitened: bool) -> Columns:
        """Each number lengthens struts, and each strut moves the measured point by its gain per length."""
        factors = self.stretched(linkage) @ (self.root if whitened else np.eye(6))
        return lambda errors: np.einsum("ns,nsp->np", errors.gains, factors[errors.at])

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Added to the stated value; a small negative one is noise, and is kept."""
        draft.load[self.term] = x


class Compliance(LoadBlock):
    """c of each strut, m/N: δl = c · its tension."""

    name, unit, tolerance, term, stated = "compliance", "m/N", 15e-9, "compliance", True

    def __init__(self, facts: Facts) -> None:
        super().__init__(facts)
        compliance = stated_load(facts.settings).compliance
        self.tolerance = ASSUMED.stated_stiffness * compliance.mean()
        self.root = compliance[:, None] / compliance.mean() * self.root

    def stretched(self, linkage: Linkage) -> np.ndarray:
        """The struts' tensions."""
        return tensions(linkage)[..., None] * np.eye(6)


class LostMotion(LoadBlock):
    """By how much a strut is longer when it is pulled than when it is pushed, c: δl = c/2 · the sign of its tension.

    Near zero tension it is in proportion to the tension.
    """

    name, unit, tolerance, term = "lost motion", "m", 3e-6, "lost_motion"

    @classmethod
    def of(cls, facts: Facts) -> LoadBlock | None:
        """For a machine whose load is stated, also with rigid struts."""
        return cls(facts) if facts.settings.load else None

    def stretched(self, linkage: Linkage) -> np.ndarray:
        """Half the sign of the struts' tensions."""
        return 0.5 * taken_up(linkage)[..., None] * np.eye(6)


class Friction(LoadBlock):
    """Torque of each bearing of a strut against its turning, N m: it changes all tensions by the motion's direction."""

    name, unit, tolerance, term = "friction", "N m", 0.5, "friction"

    def stretched(self, linkage: Linkage) -> np.ndarray:
        """Stretch by the struts' tensions, and the reversal of lost motions."""
        load = linkage.load
        turning = np.abs(taken_up(linkage)) < 1.0
        per_newton = load.compliance + 0.5 * load.lost_motion / load.take_up * turning
        return per_newton[..., None] * by_friction(linkage)
