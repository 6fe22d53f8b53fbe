"""Forward kinematics without a guess: all assembly modes of a machine, and the selection of its working mode."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..core import Status, batch
from ..errors import OtherAssemblyModeError, SingularError, UnreachableError
from ..pose import Pose, nearest_rotation, rotation_angle
from .geometry import HexapodGeometry
from .kinematics import Structure, six_lengths, solve_poses

# Two solutions are one mode if all their platform joints agree within this share of the longest strut's length
DISTINCT = 1e-6
# A machine has at most forty modes (Raghavan 1993) unless it can move with all struts locked
MOST_MODES = 40
MOVES = "the machine can move with its struts locked at these lengths, so the lengths do not determine its pose"
ORIENTATIONS = 2000  # Number of attitudes from which the search starts, with two positions for each
# A cold start is refused if the second-nearest mode is at most 1.2 times as far from home as the nearest mode
AMBIGUITY = 1.2


def assembly_modes(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the platform poses with these strut lengths, highest z first; Newton's method starts from 4000 poses."""
    lengths = six_lengths(lengths)
    anything = replace(structure, home_sign=0.0, max_condition=math.inf)
    starts = _starts_around(structure, lengths)
    found = solve_poses(anything, np.tile(lengths, (len(starts[0]), 1)), starts)
    if not found.ok.any() and (found.outcomes == Status.SINGULAR).any():
        raise SingularError(MOVES)
    positions, rotations = found.positions[found.ok], found.rotations[found.ok]
    joints = positions[:, None] + structure.platform_joints @ np.swapaxes(rotations, 1, 2)
    poses: list[Pose] = []
    left = np.arange(len(positions))
    while len(left):
        first = left[0]
        poses.append(Pose(positions[first], rotations[first]))
        if len(poses) > MOST_MODES:
            raise SingularError(MOVES)
        apart = np.abs(joints[left] - joints[first]).max(axis=(1, 2))
        left = left[apart > DISTINCT * lengths.max()]
    return sorted(poses, key=lambda pose: -pose.position[2])


def _starts_around(structure: Structure, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return N starting poses as positions, (N, 3), m, and rotations, (N, 3, 3): home, and random rotations, each with
    two positions at which the struts roughly have the lengths `lengths`.
    """
    rotations = nearest_rotation(np.random.default_rng(0).standard_normal((ORIENTATIONS, 3, 3)))
    centres = structure.base_joints - structure.platform_joints @ np.swapaxes(rotations, 1, 2)
    middle = centres.mean(axis=1)
    around, squares = centres - middle[:, None], lengths**2
    distances = (around**2).sum(axis=2)
    chords = 0.5 * (distances - distances.mean(axis=1, keepdims=True) - squares + squares.mean())
    left, sizes, axes = np.linalg.svd(around, full_matrices=False)
    along = np.einsum("nik,ni->nk", left, chords)[:, :2] / np.maximum(
        sizes[:, :2], 1e-9 * structure.characteristic_length
    )
    beside = np.einsum("nk,nki->ni", along, axes[:, :2])
    off = squares.mean() - (beside**2).sum(axis=1) - distances.mean(axis=1)
    off = np.sqrt(np.maximum(off, 0.0))[:, None] * axes[:, 2]
    positions = np.concatenate([structure.home.position[None], middle + beside + off, middle + beside - off])
    return positions, np.concatenate([structure.home.rotation[None], rotations, rotations])


def working_mode(geometry: HexapodGeometry, structure: Structure, lengths: np.ndarray) -> Pose:
    """Return the platform pose that has these strut lengths and is in the working assembly mode; no guess is needed."""
    modes = assembly_modes(structure, lengths)
    if not modes:
        raise UnreachableError("no pose of the machine has these strut lengths", 0)
    objections = [mode_objections(geometry, structure, mode) for mode in modes]
    fit = [mode for mode, reasons in zip(modes, objections, strict=True) if not reasons]
    if not fit:
        listed = "; ".join(f"mode {i}: {', '.join(reasons)}" for i, reasons in enumerate(objections, start=1))
        problem = f"{len(modes)} poses have these strut lengths, but the machine can reach none of them: {listed}"
        raise OtherAssemblyModeError(problem, len(modes))
    return _nearest_to_home(geometry, structure, fit)


def mode_objections(geometry: HexapodGeometry, structure: Structure, pose: Pose) -> list[str]:
    """Return why a pose is impossible: a broken limit, or det J's sign or the side of the base is not as at home."""
    limits = geometry.limits
    measured = batch.examine(*structure.joints, geometry.limit_numbers.at, pose.position, pose.rotation)
    broken = {
        name: (int(margin.argmin()), value.ravel()[margin.argmin()])
        for name, (margin, value) in limits.margins(measured).items()
        if not (margin >= 0.0).all()
    }
    objections = ["det J has the other sign than at home"] if measured["sign"][0, 0] != structure.home_sign else []
    if "condition" in broken:
        objections.append(f"condition number {broken['condition'][1]:.4g}, allowed {limits.condition:.4g}")
    centre, homewards = _home_side(geometry, structure)
    if homewards @ (pose.position + pose.rotation @ structure.platform_joints.mean(axis=0) - centre) < 0.0:
        objections.append("platform on the other side of the base than at home")
    for body, allowed in (("base", limits.base_cone), ("platform", limits.platform_cone)):
        if f"{body}_cone" in broken:
            joint, angle = broken[f"{body}_cone"]
            degrees = f"{np.rad2deg(angle):.1f}° from its neutral direction, allowed {np.rad2deg(allowed[joint]):.1f}°"
            objections.append(f"{body} joint {joint + 1} at {degrees}")
    if "clearance" in broken:
        strut, distance = broken["clearance"]
        one, other = sorted((strut + 1, int(measured["nearest"][0, 0, strut]) + 1))
        struts = f"struts {one} and {other} are {distance * 1e3:.1f} mm apart"
        objections.append(f"{struts}, must be at least {limits.clearance * 1e3:.1f} mm")
    return objections


def _nearest_to_home(geometry: HexapodGeometry, structure: Structure, modes: list[Pose]) -> Pose:
    """Return the assembly mode nearest to home; raise if another is at most `AMBIGUITY` times as far from home."""

    def distance(pose: Pose) -> float:
        turn = rotation_angle(geometry.home.rotation.T @ pose.rotation)
        shift = float(np.linalg.norm(pose.position - geometry.home.position))
        return shift + structure.characteristic_length * turn

    nearest, *others = sorted(modes, key=distance)
    least = distance(nearest)
    if others and distance(others[0]) <= AMBIGUITY * least:
        next_least = distance(others[0])
        problem = (
            f"the machine can reach {len(modes)} poses with these strut lengths, and the two nearest to home are at "
            f"similar distances from home ({least * 1e3:.4g} and {next_least * 1e3:.4g} mm): give a guess of its pose"
        )
        raise OtherAssemblyModeError(problem, next_least, AMBIGUITY * least)
    return nearest


def _home_side(geometry: HexapodGeometry, structure: Structure) -> tuple[np.ndarray, np.ndarray]:
    """Return the base joints' centroid, m, and their mean plane's normal towards home; both (3,) in ``base``."""
    centre = structure.base_joints.mean(axis=0)
    normal = np.linalg.svd(structure.base_joints - centre)[2][2]
    home = geometry.home.position + geometry.home.rotation @ structure.platform_joints.mean(axis=0)
    height = float(normal @ (home - centre))
    if abs(height) < 1e-6 * structure.characteristic_length:
        return centre, np.zeros(3)
    return centre, height * normal
