"""Shells: meshes of the workspace's boundary at one tool orientation (Daake et al., Figure 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core import Status
from ..machine.geometry import HexapodGeometry
from .reach import Reach, bisected, first_limits, poses_at


@dataclass(frozen=True)
class Layer:
    """A mesh with a value for each point, which determines the point's colour."""

    points: np.ndarray  # (H, A, 3): m in the work frame
    values: np.ndarray  # (H, A): m or rad


@dataclass(frozen=True)
class Quantity:
    name: str  # such as "translation of the tool"
    unit: str  # in pictures
    factor: float  # from SI to `unit`

    @property
    def label(self) -> str:
        return f"{self.name}, {self.unit}"


TRANSLATION = Quantity("translation of the tool", "µm", 1e6)
ROTATION = Quantity("rotation of the tool, largest of three", "m°", 1e3 * 180.0 / np.pi)
SAMPLES = 96  # points per ray in the search for the boundary; a gap narrower than 1 % of the reach may be missed


@dataclass(frozen=True)
class Shell:
    """The boundary of a reach as a mesh of H rings, from bottom to top, with A points each."""

    geometry: HexapodGeometry
    rotation: np.ndarray  # (3, 3): of the tool in the work frame
    centre: np.ndarray  # (3,): start of the rays to the boundary, m in the work frame
    points: np.ndarray  # (H, A, 3): the tool's tip on the boundary, m in the work frame
    findings: np.ndarray  # (H, A): limit at each point, index into :data:`~hexapod_comp.workspace.reach.FINDINGS`

    def scaled(self, fraction: float) -> np.ndarray:
        """Return the points with their distances from the centre multiplied by `fraction`, m in the work frame."""
        return self.centre + fraction * (self.points - self.centre)

    def platform_poses(self, fraction: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return ``pose_platform_in_base`` at the n points of :meth:`scaled`: positions, m, and rotations (n, 3, 3)."""
        return poses_at(self.geometry, self.scaled(fraction).reshape(-1, 3), self.rotation)


def shell(reach: Reach, rings: int, sectors: int) -> Shell:
    """Find the boundary of a reach along rays from its centre, as a mesh of rings and sectors.

    The rays go to equal steps of elevation and azimuth on a spheroid with the reach's ratio of height to width.
    """
    geometry, origin, size = reach.geometry, reach.centre, np.ptp(reach.box, axis=0)
    elevation = np.linspace(-0.5 * np.pi, 0.5 * np.pi, rings)[:, None]
    azimuth = np.linspace(0.0, 2.0 * np.pi, sectors + 1)
    across, up = size[:2].mean() * np.cos(elevation), size[2] * np.sin(elevation) + 0.0 * azimuth
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=-1).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    corners = np.array([[axis[0], axis[-1]] for axis in reach.axes])
    farthest = np.linalg.norm(np.abs(corners - origin[:, None]).max(axis=1))  # to the grid's corners
    samples = origin + np.linspace(0.0, farthest, SAMPLES)[:, None] * directions[:, None]
    at_samples, _ = first_limits(geometry, samples.reshape(-1, 3), reach.rotation[None])
    within = (at_samples == Status.OK).reshape(len(directions), SAMPLES)
    within[:, 0] = True
    exits, ray = within.argmin(axis=1), np.arange(len(directions))
    ends, findings = bisected(geometry, samples[ray, exits - 1], samples[ray, exits], reach.rotation)
    points = ends.reshape(rings, -1, 3)
    # At the poles, and at the seam of 0° and 360°, points must be equal bit by bit
    points[:, -1] = points[:, 0]
    points[0], points[-1] = points[0, 0], points[-1, 0]
    return Shell(geometry, reach.rotation, origin, points, findings.reshape(rings, -1))
