"""The poses that everybody gets in :mod:`benchmarks.kernels`, and what taking part means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import Structure, strut_lengths_batch
from hexapod_comp.pose import Pose

PAPER = Path(__file__).resolve().parents[1] / "config" / "paper.yaml"
OURS = "hexapod_comp"

WIDE, NEAR = "forward", "forward, near"
"""Forward tasks: every pose from home, and poses within 1 mm and 1° of home from there, as in a controller's cycle."""


@dataclass(frozen=True)
class Poses:
    """The poses that everybody gets, and the machine."""

    structure: Structure
    home: Pose
    positions: np.ndarray  # ``pose_platform_in_base``, m, shape (N, 3), (N, 3, 3)
    rotations: np.ndarray
    lengths: np.ndarray  # Strut lengths there, m, shape (N, 6)

    def first(self, count: int) -> Poses:
        """Return the same with the first `count` poses only."""
        rows = self.positions[:count], self.rotations[:count], self.lengths[:count]
        return Poses(self.structure, self.home, *rows)


@dataclass(frozen=True)
class Contender:
    """Somebody who does a task: one run over `poses` poses."""

    task: str
    name: str
    shape: str
    poses: int
    # Does it, and returns what it has found, (N, 6) lengths in m or (N, 12) poses as of :func:`joined`. With
    # `numbers` it returns nothing or, when it knows better than its caller, the time it took, s
    run: Callable[[], Any]
    numbers: Callable[[], np.ndarray] | None = None  # Returns what the last run has found


def make_poses(count: int, shift: float = 0.05, turn: float = 30.0) -> Poses:
    """Draw poses within ±`shift` m and ±`turn` degrees of α, β, γ about home; the same ones every time."""
    geometry = load_geometry(PAPER)
    structure, rng = Structure.of(geometry), np.random.default_rng(1)
    positions = geometry.home.position + rng.uniform(-shift, shift, (count, 3))
    turns = Rotation.from_euler("YXZ", rng.uniform(-turn, turn, (count, 3)), degrees=True)
    rotations = np.ascontiguousarray(turns.as_matrix() @ geometry.home.rotation)
    lengths = strut_lengths_batch(structure, positions, rotations)
    return Poses(structure, geometry.home, positions, rotations, lengths)


def near_poses(count: int) -> Poses:
    """Draw poses within ±1 mm and ±1° of home."""
    return make_poses(count, 1e-3, 1.0)


def joined(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return poses as (N, 12), to compare them."""
    return np.hstack([positions, np.reshape(rotations, (len(positions), 9))])
