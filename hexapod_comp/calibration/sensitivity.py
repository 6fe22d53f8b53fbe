"""What a parametrised machine does at measured stations, and how every parameter moves it.

The error of the measured point is e = (dx, dy, dz, rx, ry, rz), actual minus commanded, along and about the
axes of ``base``. Values come from the model that the compensator runs; derivatives from the loop closures,
differentiated by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..machine.late import PARTS, LateGrowth, late
from ..machine.model import MachinesByTemperature
from ..machine.temperatures import REFERENCE_TEMPERATURE
from ..measurements.readings import Stations
from ..virtual.trial import drive
from .parameters import WAVES, ParameterSpace


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
    machines = MachinesByTemperature(space.geometry, model).at_each(stations.temperatures, stations.times)
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, sense, stations.commands)
    errors = driven.errors(commanded, space.probe).as_array()
    errors += space.field_errors(x, driven.actual[0] + driven.actual[1] @ space.probe, stations.sense[:, :3])
    base = np.array([machine.structure.base_joints for machine in machines])
    platform = np.array([machine.structure.platform_joints for machine in machines])
    return Prediction(errors, *driven.actual, base, platform)


def _without_negative_backlash(
    space: ParameterSpace, x: np.ndarray, sense: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and directions that mean the same machine without negative backlash.

    A nut cannot lead its screw, but an estimate can say so: by noise, or for swapped directions. Backlash −b
    in one direction is b in the other; cutting it off here would make the fit add it again in every step.
    """
    block = space.block("backlash")
    if block is None:
        return x, sense
    x, sense = x.copy(), sense.copy()
    sense[:, 3:] *= np.where(x[block.part] < 0.0, -1.0, 1.0)
    x[block.part] = np.abs(x[block.part])
    return x, sense


def derivatives(space: ParameterSpace, prediction: Prediction, stations: Stations) -> np.ndarray:
    """Return ∂e/∂x at each station, shape (M, 6, size).

    From u_i·(δP + δω × R·t_i + R·δt_i − δb_i) = δl_i: the platform's twist is X·(δl + u·δb − u·R·δt) with
    X the inverse of the Jacobian's rows (u_i, R·t_i × u_i).
    """
    links = _Links.of(prediction, space.probe)
    per_length, u, rotations = links.per_length, links.directions, prediction.rotations
    result = np.zeros((len(stations), 6, space.size))
    for block in space.blocks:
        result[:, :, block.part] = _block(space, block.name, per_length, u, rotations, stations)
    _add_field(space, prediction.positions + links.lever, stations.sense[:, :3], result)
    _add_growth(space, links.per_growth(), stations, result)
    return result


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
        return _Links(arms, prediction.base_joints, lengths, u, lever, per_length)

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


def _add_growth(space: ParameterSpace, per_growth: np.ndarray, stations: Stations, result: np.ndarray) -> None:
    """Write the derivatives by expansions, and by those that come late."""
    blocks = space.block("expansion"), space.block("late")
    if not any(blocks):
        return
    constants = (space.settings.time_constants or ()) if blocks[1] else ()
    columns = per_growth[..., None] * growth_causes(space, stations, constants)[:, None]
    for block, part in zip(blocks, (columns[..., :1], columns[..., 1:]), strict=True):
        if block is not None:
            result[:, :, block.part] = part.reshape(*result.shape[:2], -1)


def _block(
    space: ParameterSpace,
    name: str,
    per_length: np.ndarray,
    u: np.ndarray,
    rotations: np.ndarray,
    stations: Stations,
) -> np.ndarray:
    """Return ∂e/∂x of one block; zeros for what is written later: the field, and growth."""
    commands = stations.commands
    if name == "structure":
        base = (per_length[:, :, :, None] * u[:, None]).reshape(len(commands), 6, 18)
        in_platform = np.einsum("nij,nki->nkj", rotations, u)
        platform = -per_length[:, :, :, None] * in_platform[:, None]
        joined = np.zeros((len(commands), 6, space.platform_groups.max() + 1, 3))
        for strut, group in enumerate(space.platform_groups):
            joined[:, :, group] += platform[:, :, strut]
        return np.concatenate([base, joined.reshape(len(commands), 6, -1), per_length], axis=2)
    if name in WAVES:
        phase = 2.0 * np.pi * WAVES[name] * commands / space.periods
        parts = np.stack([np.cos(phase), np.sin(phase)], axis=-1)
        return (per_length[..., None] * parts[:, None]).reshape(len(commands), 6, 12)
    if name == "map":
        weights = space.spline_weights(commands)
        return (per_length[..., None] * weights[:, None]).reshape(len(commands), 6, -1)
    factors = {
        "pitch": commands - space.home_lengths,
        "backlash": -0.5 * stations.sense[:, 3:],
    }
    if name in factors:
        return per_length * factors[name][:, None]
    block = space.block(name)
    return np.zeros((len(commands), 6, block.part.stop - block.part.start if block else 0))


def _add_field(space: ParameterSpace, points: np.ndarray, sense: np.ndarray, result: np.ndarray) -> None:
    """Write the field blocks' derivatives: each component has the basis to itself."""
    basis, turning = space.field.basis(points), space.field.reversal_basis(points)
    for name, first in (("field displacement", 0), ("field rotation", 3)):
        block = space.block(name)
        for c in range(3 if block else 0):
            start = block.part.start + c * basis.shape[1]  # type: ignore[union-attr]
            result[:, first + c, start : start + basis.shape[1]] = basis
    block = space.block("field reversal")
    if block is not None:
        count = turning.shape[1]
        for n in range(18):
            axis, c = divmod(n, 6)
            start = block.part.start + n * count
            result[:, c, start : start + count] = 0.5 * sense[:, axis, None] * turning


def carried(motions: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return small motions (N or 1, 6, K) of a body, known at one point, at points that are arms (N, 3) away."""
    displacements = motions[:, :3] + np.cross(motions[:, 3:], arms[:, :, None], axis=1)
    return np.concatenate([displacements, np.broadcast_to(motions[:, 3:], displacements.shape)], axis=1)
