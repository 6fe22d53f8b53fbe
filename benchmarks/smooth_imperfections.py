"""Imperfections in space that no model has exactly: sums of sine waves of random length, direction and phase.

A calibration is only tried honestly on errors that are not made of its own terms.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.polynomial import polynomial

from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.virtual.imperfections import seeded

FIELD_WAVES = 6  # Waves added up in each component of a field
FIELD_NODES, FIELD_POWERS = 17, 12  # Lines of a wavy field along y and z, and coefficients along x


def with_wavy_field(
    model: MachineModel,
    box: np.ndarray,
    seed: int,
    displacement: float = 5e-6,
    rotation: float = 30e-6,
    waves: tuple[float, float] = (0.4, 0.8),
) -> MachineModel:
    """Return a model with a smooth pose error in space, the same in both directions of motion."""
    rng = seeded(seed, "field")
    vectors = rng.standard_normal((6, FIELD_WAVES, 3))
    vectors *= 2.0 * np.pi / (np.linalg.norm(vectors, axis=2) * rng.uniform(*waves, (6, FIELD_WAVES)))[..., None]
    phases = rng.uniform(0.0, 2.0 * np.pi, (6, FIELD_WAVES))

    def waves_at(points: np.ndarray) -> np.ndarray:
        return np.sin(np.einsum("...i,cwi->...cw", points, vectors) + phases).sum(axis=-1)

    x, y, z = (np.linspace(box[0, a], box[1, a], FIELD_NODES) for a in range(3))
    u = np.polynomial.chebyshev.chebpts2(4 * FIELD_POWERS)
    along = x[0] + 0.5 * (u + 1.0) * (x[-1] - x[0])
    points = np.stack(np.meshgrid(y, z, along, indexing="ij"), axis=-1)[..., [2, 0, 1]]
    values = waves_at(points)
    centres = (0.5 * (nodes[1:] + nodes[:-1]) for nodes in (x, y, z))
    even = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1)
    size = np.sqrt((waves_at(even) ** 2).mean(axis=(0, 1, 2)))
    values *= np.repeat([displacement, rotation], 3) / size
    flat = np.moveaxis(values, 2, 0).reshape(len(u), -1)
    fitted = polynomial.polyfit(u, flat, FIELD_POWERS - 1)
    lines = np.moveaxis(fitted.reshape(FIELD_POWERS, *values.shape[:2], 6), 0, -1)
    empty = np.zeros((2, 2, FIELD_NODES, 6, 0))
    return replace(model, field=GridField((x[[0, -1]], y, z), (np.stack([lines, lines]), empty, empty)))
