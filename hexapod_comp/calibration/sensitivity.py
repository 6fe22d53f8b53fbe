"""What a parametrised machine does at measured stations, and how every parameter moves it.

The error of the measured point is e = (dx, dy, dz, rx, ry, rz), actual minus commanded, along and about the
axes of ``base``. Values come from the model that the compensator runs; derivatives from the loop closures,
differentiated by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from ..machine.late import PARTS, LateGrowth, late
from ..machine.model import MachinesByTemperature, RealMachine
from ..machine.temperatures import REFERENCE_HUMIDITY, REFERENCE_TEMPERATURE
from ..measurements.readings import Stations
from ..virtual.trial import drive
from .parameters import WAVES, Block, ParameterSpace

JOINTS = ("base_joints", "platform_joints")


@dataclass(frozen=True)
class Prediction:
    """The machine at some stations.

    Attributes
    ----------
    errors : ndarray, shape (M, 6)
        e of each station, m and rad.
    positions, rotations : ndarray, shape (M, 3), (M, 3, 3)
        Actual ``pose_platform_in_base`` without the field, m.
    base_joints, platform_joints : ndarray, shape (M, 6, 3)
        Real joints at each station's temperatures, m.
    """

    errors: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    base_joints: np.ndarray
    platform_joints: np.ndarray

    def select(self, chosen: np.ndarray | slice) -> Prediction:
        """Return the machine at some of the stations."""
        return Prediction(**{name: array[chosen] for name, array in vars(self).items()})


def predict(space: ParameterSpace, x: np.ndarray, stations: Stations) -> Prediction:
    """Return where the machine of a parameter vector goes at each station.

    Raises
    ------
    KinematicsError
        The machine cannot take one of the poses.
    """
    positive, sense = _without_negative_backlash(space, x, stations.sense)
    model = space.model(positive, with_field=False)
    air = stations.temperatures, stations.times, stations.humidity
    machines = MachinesByTemperature(space.geometry, model).at_each(*air)
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, sense, stations.commands)
    errors = driven.errors(commanded, space.probe).as_array()
    errors += space.field_errors(x, driven.actual[0] + driven.actual[1] @ space.probe, stations.sense[:, :3])
    number: dict[RealMachine, int] = {}
    which = np.array([number.setdefault(machine, len(number)) for machine in machines])
    base, platform = (np.array([getattr(m.structure, name) for m in number])[which] for name in JOINTS)
    return Prediction(errors, *driven.actual, base, platform)


def _without_negative_backlash(
    space: ParameterSpace, x: np.ndarray, sense: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and directions that mean the same machine without negative backlash.

    A nut cannot lead its screw, but an estimate can say so: by noise, or for swapped directions. Backlash −b
    in one direction is b in the other; cutting it off here would make the fit add it again in every step.
    """
    block, change = space.block("backlash"), space.block("backlash map")
    if block is None:
        return x, sense
    x, sense = x.copy(), sense.copy()
    turned = np.where(x[block.part] < 0.0, -1.0, 1.0)
    sense[:, 3:] *= turned
    x[block.part] *= turned
    if change is not None:
        x[change.part] *= np.repeat(turned, len(change.labels) // 6)
    return x, sense


def derivatives(space: ParameterSpace, prediction: Prediction, stations: Stations) -> np.ndarray:
    """Return ∂e/∂x at each station, shape (M, 6, size)."""
    count = len(stations)
    at, directions = np.repeat(np.arange(count), 6), np.tile(np.eye(6), (count, 1))
    rows = np.empty((6 * count, space.size))
    Slopes(space, prediction, stations).write(rows, np.arange(space.size), at, directions, np.arange(6))
    return rows.reshape(count, 6, space.size)


class Slopes:
    """How parameters move a machine at some stations: those of the model, x, or `whitened` ones, y of x = root·y.

    From u_i·(δP + δω × R·t_i + R·δt_i − δb_i) = δl_i: the platform's twist is X·(δl + u·δb − u·R·δt) with
    X the inverse of the Jacobian's rows (u_i, R·t_i × u_i).
    """

    def __init__(
        self, space: ParameterSpace, prediction: Prediction, stations: Stations, whitened: bool = False
    ) -> None:
        self._space, self._sense, self._whitened = space, stations.sense[:, :3], whitened
        self._links = links = _Links.of(prediction, space.probe)
        self._causes = _growth_factors(space, stations)
        self._factors: dict[str, np.ndarray] = {}
        for block in space.blocks:
            if block.name not in self._causes and not block.name.startswith("field"):
                factors = _factors(space, block.name, links, stations)
                if whitened and factors.shape[2] > 1:  # each strut's parameters correlate with each other alone
                    factors = factors @ block.root[: factors.shape[2], : factors.shape[2]]
                self._factors[block.name] = factors.reshape(len(factors), -1)
        points, field = prediction.positions + links.lever, space.field
        self._field = {"field": field.basis(points) * (field.prior if whitened else 1.0)}
        if space.block("field reversal"):
            basis = field.reversal_basis(points) * (field.reversal_prior if whitened else 1.0)
            self._field["field reversal"] = basis

    def columns(self, components: np.ndarray) -> np.ndarray:
        """Return which parameters move an error that has some of the six components only."""
        return np.concatenate([self._columns(block, components) for block in self._space.blocks])

    def write(
        self, rows: np.ndarray, columns: np.ndarray, at: np.ndarray, directions: np.ndarray, components: np.ndarray
    ) -> None:
        """Write derivatives of errors at stations `at`, (n,), along directions (n, 6) that have some components only.

        `columns` are those of these components, and the shape of `rows` is (n, columns).
        """
        gains = np.einsum("nc,ncs->ns", directions, self._links.per_length[at])
        ends = np.searchsorted(columns, [*(block.part.start for block in self._space.blocks), self._space.size])
        for block, (start, stop) in zip(self._space.blocks, pairwise(ends), strict=True):
            part = rows[:, start:stop]
            if block.name.startswith("field"):
                self._write_field(block.name, part, at, directions[:, components], components)
            elif block.name in self._causes:
                grown = np.einsum("nc,ncp->np", directions, self._per_growth[at])
                grown = (grown[..., None] * self._causes[block.name][at]).reshape(len(at), -1)
                part[:] = grown @ block.root if self._whitened else grown
            else:
                factors = self._factors[block.name][at]
                each = gains[:, np.repeat(np.arange(6), factors.shape[1] // 6)]
                if block.name == "structure":
                    part[:] = self._joined((each * factors).reshape(len(at), 6, -1))
                elif block.name == "moisture":  # struts of one material swell alike
                    part[:, 0] = np.einsum("ns,ns->n", each, factors)
                else:
                    np.multiply(each, factors, out=part)

    @cached_property
    def _per_growth(self) -> np.ndarray:
        return self._links.per_growth()

    def _columns(self, block: Block, components: np.ndarray) -> np.ndarray:
        """Return which parameters of a block move an error with some components."""
        every = np.arange(block.part.start, block.part.stop)
        if not block.name.startswith("field"):
            return every
        of_component = {"field displacement": [0, 1, 2], "field rotation": [3, 4, 5]}.get(block.name, [*range(6)] * 3)
        return every[np.repeat(np.isin(of_component, components), len(every) // len(of_component))]

    def _write_field(
        self, name: str, part: np.ndarray, at: np.ndarray, directions: np.ndarray, components: np.ndarray
    ) -> None:
        """Write a field block's derivatives: each component has the basis to itself."""
        if name == "field reversal":
            basis, senses = self._field[name][at], 0.5 * self._sense[at].T
            weights = [sense * along for sense in senses for along in directions.T]
        else:
            first = 0 if name == "field displacement" else 3
            basis = self._field["field"][at]
            weights = [along for c, along in zip(components, directions.T, strict=True) if first <= c < first + 3]
        for n, weight in enumerate(weights):
            np.multiply(weight[:, None], basis, out=part[:, n * basis.shape[1] : (n + 1) * basis.shape[1]])

    def _joined(self, moved: np.ndarray) -> np.ndarray:
        """Return derivatives by the structure from those by each strut's base joint, platform joint and offset."""
        groups = self._space.platform_groups
        joined = np.zeros((len(moved), groups.max() + 1, 3))
        for strut, group in enumerate(groups):
            joined[:, group] += moved[:, strut, 3:6]
        parts = moved[:, :, :3], joined, moved[:, :, 6:]
        return np.concatenate([part.reshape(len(moved), -1) for part in parts], axis=1)


def _factors(space: ParameterSpace, name: str, links: _Links, stations: Stations) -> np.ndarray:
    """Return by how much each strut's parameters of a block lengthen it, shape (M, 6, k)."""
    commands = stations.commands
    if name == "structure":
        in_platform = -np.einsum("nij,nki->nkj", links.rotations, links.directions)
        return np.concatenate([links.directions, in_platform, np.ones((*commands.shape, 1))], axis=2)
    if name in WAVES:
        phase = 2.0 * np.pi * WAVES[name] * commands / space.periods
        return np.stack([np.cos(phase), np.sin(phase)], axis=-1)
    if name == "map":
        return space.spline_weights(commands)
    if name == "backlash map":
        return -0.5 * stations.sense[:, 3:, None] * space.spline_weights(commands, name)
    factors = {"pitch": commands - space.home_lengths, "backlash": -0.5 * stations.sense[:, 3:]}
    factors["moisture"] = links.lengths * np.nan_to_num(stations.humidity - REFERENCE_HUMIDITY)[:, None]
    return factors[name][..., None]


@dataclass(frozen=True)
class _Links:
    """The struts at some stations, and what their lengths do to the measured point.

    Attributes
    ----------
    arms : ndarray, shape (M, 6, 3)
        Platform joints from the platform's origin, m in ``base``.
    base_joints : ndarray, shape (M, 6, 3)
        m.
    lengths : ndarray, shape (M, 6)
        m.
    rotations : ndarray, shape (M, 3, 3)
        Of the platform, in ``base``.
    directions : ndarray, shape (M, 6, 3)
        Unit vectors from base to platform.
    lever : ndarray, shape (M, 3)
        The measured point from the platform's origin, m in ``base``.
    per_length : ndarray, shape (M, 6, 6)
        ∂e by the six lengths.
    """

    arms: np.ndarray
    base_joints: np.ndarray
    lengths: np.ndarray
    rotations: np.ndarray
    directions: np.ndarray
    lever: np.ndarray
    per_length: np.ndarray

    @staticmethod
    def of(prediction: Prediction, probe: np.ndarray) -> _Links:
        """Return the struts of predicted stations."""
        rotations = prediction.rotations
        arms = np.einsum("nij,nkj->nki", rotations, prediction.platform_joints)
        struts = prediction.positions[:, None] + arms - prediction.base_joints
        lengths = np.linalg.norm(struts, axis=2)
        u = struts / lengths[..., None]
        inverse = np.linalg.inv(np.concatenate([u, np.cross(arms, u)], axis=2))
        lever = np.einsum("nij,j->ni", rotations, probe)
        per_length = inverse.copy()  # of the measured point, no longer of the platform's origin
        per_length[:, :3] += np.cross(inverse[:, 3:].transpose(0, 2, 1), lever[:, None]).transpose(0, 2, 1)
        return _Links(arms, prediction.base_joints, lengths, rotations, u, lever, per_length)

    def per_growth(self) -> np.ndarray:
        """Return ∂e by the relative growth of struts 1–6, base and platform, shape (M, 6, 8)."""
        bodies = ((1.0, self.base_joints), (-1.0, self.arms))
        along = [sign * np.einsum("mik,mik->mi", self.directions, joints) for sign, joints in bodies]
        grown = [np.einsum("msi,mi->ms", self.per_length, lengths)[..., None] for lengths in along]
        return np.concatenate([self.per_length * self.lengths[:, None], *grown], axis=2)


def growth_columns(space: ParameterSpace, prediction: Prediction) -> np.ndarray:
    """Return ∂e by the relative growth of struts 1–6, base and platform at each station, shape (M, 6, 8), m and rad."""
    return _Links.of(prediction, space.probe).per_growth()


def growth_causes(
    space: ParameterSpace, stations: Stations, time_constants: Sequence[float] | np.ndarray
) -> np.ndarray:
    """Return what parts grow by: their thermometers above 20 °C, and how far each lag is behind these.

    Parameters
    ----------
    space : ParameterSpace
        Says which thermometer stands for which part.
    stations : Stations
        Temperatures and times.
    time_constants : sequence or ndarray of K float
        s.

    Returns
    -------
    ndarray, shape (M, 8, 1 + K)
        K.
    """
    sensors = LateGrowth(thermometer=space.settings.thermometer)
    read = stations.temperatures[:, [sensors.sensor_of(part) for part in range(len(PARTS))]]
    above = (read - REFERENCE_TEMPERATURE)[..., None]
    if not len(time_constants) or not np.isfinite(stations.times).all():
        return np.concatenate([above, np.zeros((*read.shape, len(time_constants)))], axis=2)
    return np.concatenate([above, late(stations.times, read, time_constants)], axis=2)


def _growth_factors(space: ParameterSpace, stations: Stations) -> dict[str, np.ndarray]:
    """Return what parts grow by, (M, 8, 1 or K): for expansions, and for those that come late."""
    late = space.block("late")
    if late is None and space.block("expansion") is None:
        return {}
    constants = (space.settings.time_constants or ()) if late else ()
    causes = growth_causes(space, stations, constants)
    return {"expansion": causes[..., :1], "late": causes[..., 1:]}


def carried(motions: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return small motions (N or 1, 6, K) of a body, known at one point, at points that are arms (N, 3) away."""
    displacements = motions[:, :3] + np.cross(motions[:, 3:], arms[:, :, None], axis=1)
    return np.concatenate([displacements, np.broadcast_to(motions[:, 3:], displacements.shape)], axis=1)
