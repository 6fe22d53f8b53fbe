"""Forward kinematics without a guess: every assembly mode of a 6-3 machine, and the pick of the working one.

:mod:`hexapod_comp.machine.elimination` finds where to look, :mod:`hexapod_comp.machine.triangles` closes the
loops from there; this module makes poses of the triangles, continues them to real structures, and picks. The modes
of other machines, of which there may be forty, are sought by Newton from some thousand poses all around.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..core import Status, batch
from ..errors import KinematicsError, OtherAssemblyModeError, SingularError, UnreachableError
from ..pose import Pose, rotation_angle
from .elimination import joint_circles, start_angles
from .geometry import HexapodGeometry
from .kinematics import Structure, jacobian, six_lengths, solve_one, solve_poses
from .triangles import closed_triangles

CLOSURE = 1e-12
"""Largest error of a strut length or of a platform side in a mode, relative to the longest strut."""

DISTINCT = 1e-6
"""Modes whose platform joints all lie closer than this, relative to the longest strut, are one double mode:
rounding moves the two of a pair by about √1e-16 = 1e-8."""

PAIR_GAP = 0.02
"""Largest distance of two platform joints that count as one, relative to the characteristic length; enough
for deviations of 1 mm on a machine with a 300 mm platform."""

EXACT_GAP = 1e-13
"""Pairs closer than this, relative to the characteristic length, coincide to rounding."""

NEARLY_CLOSED = 20.0
"""Modes of the pairs' midpoints that fail to close by up to this many gaps are tried on a real structure."""

MOST_MODES = 16
"""A 6-3 machine has at most sixteen modes unless it can move with all struts locked."""

MOST_GENERAL_MODES = 40
"""A 6-6 machine has at most forty modes (Raghavan 1993) unless it can move with all struts locked."""

ORIENTATIONS = 2000
"""Attitudes from which the modes of a machine that is not 6-3 are sought, two positions each."""

AMBIGUITY = 1.2
"""A cold start is refused when the second-nearest candidate is within this factor of the nearest."""


def assembly_modes(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return every real pose of a machine that has these strut lengths; no guess is needed."""
    lengths = six_lengths(lengths)
    if not is_six_three(structure):
        return sorted(_sought_poses(structure, lengths), key=lambda pose: -pose.position[2])
    _refuse_degenerate(structure)
    if platform_pair_gap(structure) <= EXACT_GAP * structure.characteristic_length:
        poses = _exact_poses(structure, lengths)
    else:
        poses = _continued_poses(structure, lengths)
    return sorted(poses, key=lambda pose: -pose.position[2])


def working_mode(geometry: HexapodGeometry, structure: Structure, lengths: np.ndarray) -> Pose:
    """Return the pose in which the machine must be standing, for cold starts: no guess but its home.

    Of the modes to which :func:`mode_objections` has none the nearest to home is taken, by |Δposition| +
    characteristic length · angle, unless the next is nearly as near.
    A machine that stands outside its own limits, which lengths alone cannot show, is refused or, where another
    mode keeps the limits, taken to be in that one.
    """
    modes = assembly_modes(structure, lengths)
    if not modes:
        raise UnreachableError("no pose of the machine has these strut lengths", 0)
    objections = [mode_objections(geometry, structure, mode) for mode in modes]
    fit = [mode for mode, reasons in zip(modes, objections, strict=True) if not reasons]
    if not fit:
        listed = "; ".join(f"mode {i}: {', '.join(reasons)}" for i, reasons in enumerate(objections, start=1))
        problem = f"none of the {len(modes)} poses with these strut lengths can be the working one: {listed}"
        raise OtherAssemblyModeError(problem, len(modes))
    return _nearest_to_home(geometry, structure, fit)


def mode_objections(geometry: HexapodGeometry, structure: Structure, pose: Pose) -> list[str]:
    """Return what keeps a pose from being the working mode; empty when nothing does.

    The machine can work only with det J of home's sign, the platform on home's side, and its limits kept.
    """
    limits = geometry.limits
    measured = batch.examine(*structure.joints, geometry.limit_numbers.at, pose.position, pose.rotation)
    broken = {
        name: (int(margin.argmin()), value.ravel()[margin.argmin()])
        for name, (margin, value) in limits.margins(measured).items()
        if not (margin >= 0.0).all()
    }
    objections = ["det J of the other sign"] if measured["sign"][0, 0] != structure.home_sign else []
    if "condition" in broken:
        objections.append(f"condition number {broken['condition'][1]:.4g} above {limits.condition:.4g}")
    centre, homewards = _home_side(geometry, structure)
    if homewards @ (pose.position + pose.rotation @ structure.platform_joints.mean(axis=0) - centre) < 0.0:
        objections.append("platform on the other side of the base")
    for body, allowed in (("base", limits.base_cone), ("platform", limits.platform_cone)):
        if f"{body}_cone" in broken:
            joint, angle = broken[f"{body}_cone"]
            degrees = f"{np.rad2deg(angle):.1f}°, allowed {np.rad2deg(allowed[joint]):.1f}°"
            objections.append(f"{body} joint {joint + 1} at {degrees}")
    if "clearance" in broken:
        strut, distance = broken["clearance"]
        one, other = sorted((strut + 1, int(measured["nearest"][0, 0, strut]) + 1))
        millimetres = f"{distance * 1e3:.1f} mm apart, allowed {limits.clearance * 1e3:.1f} mm"
        objections.append(f"struts {one} and {other} {millimetres}")
    return objections


def platform_pair_gap(structure: Structure) -> float:
    """Return the largest distance within the platform joint pairs (1, 2), (3, 4), (5, 6), m; 0 on a 6-3."""
    joints = structure.platform_joints
    return float(np.linalg.norm(joints[0::2] - joints[1::2], axis=1).max())


def is_six_three(structure: Structure) -> bool:
    """Return whether a machine's platform joints coincide in pairs, to within :data:`PAIR_GAP`."""
    return platform_pair_gap(structure) <= PAIR_GAP * structure.characteristic_length


def _nearest_to_home(geometry: HexapodGeometry, structure: Structure, modes: list[Pose]) -> Pose:
    """Return the mode nearest to home; refuse where the next is nearly as near."""

    def distance(pose: Pose) -> float:
        turn = rotation_angle(geometry.home.rotation.T @ pose.rotation)
        shift = float(np.linalg.norm(pose.position - geometry.home.position))
        return shift + structure.characteristic_length * turn

    nearest, *others = sorted(modes, key=distance)
    least = distance(nearest)
    if others and distance(others[0]) <= AMBIGUITY * least:
        next_least = distance(others[0])
        problem = (
            f"{len(modes)} poses with these strut lengths could be the working one and two are about as near "
            f"to home ({least * 1e3:.4g} and {next_least * 1e3:.4g} mm): give a guess"
        )
        raise OtherAssemblyModeError(problem, next_least, AMBIGUITY * least)
    return nearest


def _home_side(geometry: HexapodGeometry, structure: Structure) -> tuple[np.ndarray, np.ndarray]:
    """Return the base joints' centroid, m, and their mean plane's normal towards home; each (3,), ``base``.

    The normal is zero where home lies in that plane: then there is no side to be on.
    """
    centre = structure.base_joints.mean(axis=0)
    normal = np.linalg.svd(structure.base_joints - centre)[2][2]
    home = geometry.home.position + geometry.home.rotation @ structure.platform_joints.mean(axis=0)
    height = float(normal @ (home - centre))
    if abs(height) < 1e-6 * structure.characteristic_length:
        return centre, np.zeros(3)
    return centre, math.copysign(1.0, height) * normal


def _refuse_degenerate(structure: Structure) -> None:
    """Refuse joints of a 6-3 machine that define no circles or no triangle."""
    tiny = 1e-6 * structure.characteristic_length
    for i in (0, 2, 4):
        apart = float(np.linalg.norm(structure.base_joints[i] - structure.base_joints[i + 1]))
        if apart < tiny:
            raise KinematicsError(f"base joints {i + 1} and {i + 2} coincide", apart, tiny)
    corners = _corners(structure)
    area = float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))
    if area < tiny * structure.characteristic_length:
        raise KinematicsError("platform joints lie on one line: the platform can turn about it", area)


def _corners(structure: Structure) -> np.ndarray:
    """Return the midpoints of the platform joint pairs, shape (3, 3), m, in ``platform``."""
    return 0.5 * (structure.platform_joints[0::2] + structure.platform_joints[1::2])


def _closed_triangles(structure: Structure, lengths: np.ndarray, allowed: float, distinct: float) -> np.ndarray:
    """Return the platform corners T1..T3, (M, 3, 3), m, of all modes of the machine with its pairs' midpoints.

    A platform side may be wrong by `allowed`, m: more than rounding keeps modes that only just fail to close.
    Triangles whose corners all lie closer than `distinct`, m, are one.
    """
    circles = joint_circles(structure.base_joints, lengths, allowed)
    if circles is None:
        return np.empty((0, 3, 3))
    corners = _corners(structure)
    sides = np.linalg.norm(corners - corners[[1, 2, 0]], axis=1)
    return closed_triangles(circles, sides, start_angles(circles, sides), allowed, distinct)


def _exact_poses(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the modes of a machine whose platform joints coincide in pairs."""
    longest = float(lengths.max())
    triangles = _closed_triangles(structure, lengths, CLOSURE * longest, DISTINCT * longest)
    if len(triangles) > MOST_MODES:
        raise SingularError("the machine moves with its struts locked at these lengths: its pose is open")
    poses = _poses_at(structure, triangles)
    polished = [_newton(structure, lengths, pose) for pose in poses]
    # Near a singular pose Newton may be thrown to another mode: then the triangle stands as it is.
    return [
        fine if fine is not None and _same(structure, fine, pose, lengths) else pose
        for pose, fine in zip(poses, polished, strict=True)
    ]


def _continued_poses(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the real structure's modes near those of the machine with its pairs' midpoints."""
    gap = platform_pair_gap(structure)
    # The wide tolerance takes in pairs of modes that the deviations have parted or joined.
    triangles = _closed_triangles(structure, lengths, NEARLY_CLOSED * gap, gap)
    poses: list[Pose] = []
    for pose_of_pairs in _poses_at(structure, triangles):
        for start in _starts_near(structure, pose_of_pairs, gap):
            pose = _newton(structure, lengths, start)
            if pose is not None and not any(_same(structure, pose, other, lengths) for other in poses):
                poses.append(pose)
    return poses


def _sought_poses(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the poses that Newton finds from all around: random attitudes, and home, each pose once."""
    anything = replace(structure, home_sign=0.0, max_condition=math.inf)
    starts = _starts_around(structure, lengths)
    batch = solve_poses(anything, np.tile(lengths, (len(starts[0]), 1)), starts)
    positions, rotations = batch.positions[batch.ok], batch.rotations[batch.ok]
    joints = positions[:, None] + structure.platform_joints @ np.swapaxes(rotations, 1, 2)
    poses: list[Pose] = []
    left = np.arange(len(positions))
    while len(left):
        first = left[0]
        poses.append(Pose(positions[first], rotations[first]))
        if len(poses) > MOST_GENERAL_MODES:
            raise SingularError("the machine moves with its struts locked at these lengths: its pose is open")
        apart = np.abs(joints[left] - joints[first]).max(axis=(1, 2))
        left = left[apart > DISTINCT * lengths.max()]
    return poses


def _starts_around(structure: Structure, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3), m, and rotations (N, 3, 3) that have the struts' lengths about right; home comes first.

    At a given attitude the platform's origin is as far from b − R·t as strut's lengths say: six spheres. Their
    common chords say where in the plane across which the centres spread least; the mean square of the lengths says
    how far off it, to either side.
    """
    rotations = Rotation.random(ORIENTATIONS, random_state=0).as_matrix()
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


def _poses_at(structure: Structure, triangles: np.ndarray) -> list[Pose]:
    """Return the poses whose platform corners stand at triangles, (M, 3, 3), m; centroid on centroid."""
    corners = _corners(structure)
    rotations = _frames(triangles) @ _frames(corners).T
    positions = triangles.mean(axis=1) - rotations @ corners.mean(axis=0)
    return [Pose(*pose) for pose in zip(positions, rotations, strict=True)]


def _frames(triangles: np.ndarray) -> np.ndarray:
    """Return right-handed orthonormal frames attached to triangles, (..., 3, 3); axes are the columns."""
    x = triangles[..., 1, :] - triangles[..., 0, :]
    z = np.cross(x, triangles[..., 2, :] - triangles[..., 0, :])
    axes = np.stack([x, np.cross(z, x), z], axis=-1)
    return axes / np.linalg.norm(axes, axis=-2, keepdims=True)


def _starts_near(structure: Structure, pose: Pose, gap: float) -> list[Pose]:
    """Return guesses at a pose and, where it is nearly singular, to both sides along the weakest motion.

    Near a singular pose a deviation ε of the joints moves modes by √ε, and parts or joins them in pairs.
    """
    size = structure.characteristic_length
    matrix = jacobian(structure, pose)
    matrix[:, 3:] /= size
    _, singular_values, directions = np.linalg.svd(matrix)
    reach = math.sqrt(gap * size)
    if singular_values[-1] > 4.0 * reach / size:
        return [pose]
    shift, turn = directions[-1][:3], directions[-1][3:] / size
    starts = [pose]
    for step in reach * np.array([-3.0, -1.0, -0.3, 0.3, 1.0, 3.0]):
        turned = Rotation.from_rotvec(step * turn).as_matrix() @ pose.rotation
        starts.append(Pose(pose.position + step * shift, turned))
    return starts


def _same(structure: Structure, one: Pose, other: Pose, lengths: np.ndarray) -> bool:
    """Return whether two poses hold all platform joints at the same places."""
    apart = one.position - other.position + structure.platform_joints @ (one.rotation - other.rotation).T
    return bool(np.abs(apart).max() < DISTINCT * lengths.max())


def _newton(structure: Structure, lengths: np.ndarray, start: Pose) -> Pose | None:
    """Return the pose that Newton on the six loop closures finds, whatever its sign and condition number."""
    position, rotation = start.position.copy(), start.rotation.copy()
    anything = replace(structure, home_sign=0.0, max_condition=math.inf)
    outcome, _ = solve_one(anything, lengths, position, rotation)
    return Pose(position, rotation) if outcome == Status.OK else None
