"""The tool errors of a machine with the parameters x at given stations, and the derivatives of these errors by x."""

from __future__ import annotations

import numpy as np

from ..machine.model import RealMachine
from ..machine.trial import drive
from ..measurements.readings import Stations
from .blocks.backlash import without_negative
from .blocks.block import Linkage, Prediction
from .parameters import ParameterSpace

JOINTS = ("base_joints", "platform_joints")


def predict(space: ParameterSpace, x: np.ndarray, stations: Stations) -> Prediction:
    """Return the tool error and the actual pose, at each station, of a machine with the parameters `x` (size,)."""
    positive, sense = without_negative(space.blocks, x, stations.sense)
    model = space.model(positive, with_field=False)
    machines = stations.machines(RealMachine(space.geometry, model))
    commanded = stations.positions, stations.rotations
    driven = drive(machines, commanded, sense, stations.commands)
    errors = driven.errors(commanded, space.probe).as_array()
    errors += space.field_errors(x, driven.actual[0] + driven.actual[1] @ space.probe, stations.sense[:, :3])
    number: dict[RealMachine, int] = {}
    which = np.array([number.setdefault(machine, len(number)) for machine in machines])
    base, platform = (np.array([getattr(m.structure, name) for m in number])[which] for name in JOINTS)
    return Prediction(errors, *driven.actual, base, platform, model.load, space.geometry)


class Slopes:
    """Computes rows of the design matrix: derivatives by x or, if `whitened`, by y (x = root·y)."""

    def __init__(
        self, space: ParameterSpace, prediction: Prediction, stations: Stations, whitened: bool = False
    ) -> None:
        self._blocks, self._linkage = space.blocks, Linkage(prediction, space.probe, stations)
        self._designs = [block.design(self._linkage, whitened) for block in space.blocks]

    def columns(self, components: np.ndarray) -> np.ndarray:
        """Return the indices of the parameters that change at least one of the `components` (0…5) of the tool error."""
        return np.concatenate([block.part.start + block.moving(components) for block in self._blocks])

    def write(self, rows: np.ndarray, at: np.ndarray, directions: np.ndarray, components: np.ndarray) -> None:
        """Write to `rows` the derivatives of the tool errors along `directions` (n, 6) at the stations `at` (n,)."""
        errors, stop = self._linkage.errors(at, directions, components), 0
        for design in self._designs:
            values = design(errors)
            start, stop = stop, stop + values.shape[1]
            rows[:, start:stop] = values


def derivatives(space: ParameterSpace, prediction: Prediction, stations: Stations) -> np.ndarray:
    """Return the derivatives of the tool error e by the parameters x at each station: ∂e/∂x, (M, 6, size)."""
    count = len(stations)
    at, directions = np.repeat(np.arange(count), 6), np.tile(np.eye(6), (count, 1))
    rows = np.empty((6 * count, space.size))
    Slopes(space, prediction, stations).write(rows, at, directions, np.arange(6))
    return rows.reshape(count, 6, space.size)


def carried(motions: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Convert K small rigid motions of the points P, `motions` (N or 1, 6, K), to those of P + `arms` (N, 3), m."""
    displacements = motions[:, :3] + np.cross(motions[:, 3:], arms[:, :, None], axis=1)
    return np.concatenate([displacements, np.broadcast_to(motions[:, 3:], displacements.shape)], axis=1)
