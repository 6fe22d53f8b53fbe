"""Poses that a machine passes through, each with a direction of travel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import HexapodError
from ..pose import Pose, rotation_from_angles
from .geometry import HexapodGeometry, pose_text
from .kinematics import Structure, strut_lengths_batch

LEAST_SPEED = 1e-9  # An axis or strut slower than this share of the tool's speed counts as at rest
BOTH_WAYS = (1.0, -1.0)  # Forward, backward
# Length, m, of the straight approach to a pose from which the struts' directions are computed. A strut that reverses
# just before the pose keeps its direction, as its nut has not crossed the backlash yet
APPROACH = 2e-3

# Positions, shape (N, 3), m, and rotations, shape (N, 3, 3), of ``pose_platform_in_base``
Poses = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Passes:
    """N commanded platform poses of a machine, each with a direction of travel."""

    geometry: HexapodGeometry  # the nominal machine
    positions: np.ndarray  # (N, 3): positions of ``pose_platform_in_base``, m
    rotations: np.ndarray  # (N, 3, 3): rotations of ``pose_platform_in_base``
    directions: np.ndarray  # (N, 3): directions of travel in ``base``; their lengths do not matter

    def __len__(self) -> int:
        return len(self.positions)

    @staticmethod
    def of_tool(
        geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, directions: np.ndarray
    ) -> Passes:
        """Make the passes from N tool poses and N directions of travel, (N, 3), all in ``work``."""
        platform = geometry.platform_poses(positions, rotations)
        return Passes(geometry, *platform, directions @ geometry.work.rotation.T)

    @property
    def poses(self) -> Poses:
        return self.positions, self.rotations

    def of_the_tool(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the tool's positions, m, rotations and directions of travel, all in ``work``."""
        tool = self.geometry.tool_poses(self.positions, self.rotations)
        return *tool, self.directions @ self.geometry.work.rotation

    def both_ways(self) -> Passes:
        """Return these passes, followed by the same poses passed in the opposite direction."""
        directions = np.concatenate([way * self.directions for way in BOTH_WAYS])
        twice = np.tile(self.positions, (2, 1)), np.tile(self.rotations, (2, 1, 1))
        return Passes(self.geometry, *twice, directions)

    def points(self, point: np.ndarray) -> np.ndarray:
        """Return the commanded positions in ``base``, (N, 3), m, of a point given in ``platform``, m."""
        return self.positions + self.rotations @ point

    def senses(self) -> np.ndarray:
        """Return the directions of motion, −1, 0 or 1, of x, y, z and six struts on arrival at the poses, (N, 9)."""
        lengths = np.linalg.norm(self.directions, axis=1, keepdims=True)
        ways = APPROACH * self.directions / np.where(lengths > 0.0, lengths, 1.0)
        return arrivals(self.geometry, self.poses, (self.positions - ways, self.rotations))

    def select(self, mask: np.ndarray) -> Passes:
        return Passes(self.geometry, self.positions[mask], self.rotations[mask], self.directions[mask])

    def nominal_commands(self) -> np.ndarray:
        """Return the nominal strut lengths, shape (N, 6), m: the commands without compensation."""
        return strut_lengths_batch(Structure.of(self.geometry), *self.poses)

    def refusals(self) -> list[HexapodError | None]:
        """Return for each pose the error of the first limit that the pose breaks, or None if it breaks none."""
        lengths = self.nominal_commands()
        return [self.geometry.refusal(*pose) for pose in zip(self.positions, self.rotations, lengths, strict=True)]

    def reachable(self) -> np.ndarray:
        return np.array([refusal is None for refusal in self.refusals()])

    def refuse_unreachable(self, names: Sequence[str] = ()) -> None:
        """Raise the error of the first pose that breaks a limit; `names` are the poses' names in the message."""
        for n, refusal in enumerate(self.refusals()):
            if refusal is not None:
                where = names[n] if names else at(self.geometry, self.positions[n], self.rotations[n])
                refusal.args = (f"{where}: {refusal}",)
                raise refusal


def level_attitude(geometry: HexapodGeometry) -> np.ndarray:
    """Return the rotation matrix in ``work`` of the tool without tilt, which reports call level.

    A level tool's axes are parallel to those of ``work``. If the machine cannot hold the tool parallel to ``work`` at
    the tool's home position, the tool's attitude at home counts as level.
    """
    home, parallel = geometry.tool_pose(geometry.home), np.eye(3)
    there = Passes.of_tool(geometry, home.position[None], parallel[None], np.zeros((1, 3)))
    return parallel if there.reachable()[0] else home.rotation


def arrivals(geometry: HexapodGeometry, poses: Poses, before: Poses) -> np.ndarray:
    """Return the directions of motion, (N, 9), −1, 0 or 1, of x, y, z and six struts, from `before` to `poses`."""
    structure = Structure.of(geometry)
    changes = strut_lengths_batch(structure, *poses) - strut_lengths_batch(structure, *before)
    moving = np.concatenate([poses[0] - before[0], changes], axis=1) / APPROACH
    return np.sign(moving) * (np.abs(moving) > LEAST_SPEED)


def at(geometry: HexapodGeometry, position: np.ndarray, rotation: np.ndarray) -> str:
    """Return as text the tool's pose in the work frame when the platform is at this pose in ``base``."""
    pose = geometry.tool_pose(Pose(position, rotation))
    return f"the {geometry.tool_name} in {geometry.work_name} at {pose_text(pose)}"


def random_directions(rng: np.random.Generator, count: int) -> np.ndarray:
    directions = rng.standard_normal((count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def random_passes(
    geometry: HexapodGeometry,
    box: np.ndarray,
    points: int,
    tilt: float,
    rng: np.random.Generator,
    level: np.ndarray | None = None,
) -> Passes:
    """Return random passes of the tool in both directions: positions in a box in ``work``, tilts up to `tilt`, rad."""
    positions = rng.uniform(box[0], box[1], (points, 3))
    directions = random_directions(rng, points)
    tilts = np.append(rng.uniform(-tilt, tilt, (points, 2)), np.zeros((points, 1)), axis=1)
    rotations = rotation_from_angles(tilts) @ (np.eye(3) if level is None else level)
    return Passes.of_tool(geometry, positions, rotations, directions).both_ways()
