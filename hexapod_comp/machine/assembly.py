"""Forward kinematics without a guess: every assembly mode of a 6-3 machine, and the selection of the working one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..core import Status, batch
from ..core.batch import settle
from ..errors import KinematicsError, OtherAssemblyModeError, SingularError, UnreachableError
from ..pose import Pose, rotation_angle
from .geometry import HexapodGeometry
from .kinematics import Structure, jacobian, six_lengths, solve_one, solve_poses

SAMPLES = 32
HALF_DEGREE = 8
# Cyclic successors of each joint: sides[i] lies between i and SECOND[i], sides[THIRD[i]] between THIRD[i] and i
SECOND, THIRD = np.array([1, 2, 0]), np.array([2, 0, 1])


def joint_circles(base_joints: np.ndarray, lengths: np.ndarray, allowed: float) -> np.ndarray | None:
    """Return the circles on which pairs of struts hold their platform joints; None when two cannot meet."""
    one, other = lengths[0::2], lengths[1::2]
    between = base_joints[1::2] - base_joints[0::2]
    apart = np.linalg.norm(between, axis=1)
    e = between / apart[:, None]
    spare = np.array([one + other - apart, apart + one - other, apart - one + other])
    if spare.min() < -allowed:
        return None
    # Heron's formula keeps its accuracy for flat triangles, where L² − s² would not.
    radius = np.sqrt(np.maximum(spare.prod(axis=0), 0.0) * (one + other + apart)) / (2.0 * apart)
    along = 0.5 * (apart + (one - other) * (one + other) / apart)
    thin = np.abs(e).argmin(axis=1)
    u = np.eye(3)[thin] - e[np.arange(3), thin][:, None] * e
    u /= np.linalg.norm(u, axis=1)[:, None]
    scaled = radius[:, None]
    return np.stack([base_joints[0::2] + along[:, None] * e, scaled * u, scaled * np.cross(e, u)], axis=1)


def start_angles(circles: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return angles (φ1, φ2, φ3) near which the platform may close, shape (K, 3), rad."""
    roots = [_roots(*about_one) for about_one in zip(*_samples(circles, sides), strict=True)]
    angles, row = np.concatenate(roots), np.arange(sum(map(len, roots)))
    first = np.repeat(np.arange(3), [len(of_one) for of_one in roots])
    second, third = SECOND[first], THIRD[first]
    points = _points(circles[first], angles)
    starts = np.empty((len(row), 2, 2, 3))
    starts[row, :, :, first] = angles[:, None, None]
    starts[row, :, :, second] = _branches(points, circles[second], sides[first])[:, :, None]
    starts[row, :, :, third] = _branches(points, circles[third], sides[third])[:, None, :]
    return starts.reshape(-1, 3)


def _points(circles: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return T(φ), (..., 3), m; circles (..., 3, 3) and angles (...) row by row."""
    c, s = np.cos(angles)[..., None], np.sin(angles)[..., None]
    return circles[..., 0, :] + c * circles[..., 1, :] + s * circles[..., 2, :]


def _branches(points: np.ndarray, circles: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return the two angles at which a circle is `side` from its point, or nearest to being; (N, 2), rad."""
    a, b = _quadratic(points, circles, sides)
    size = 2.0 * np.abs(a)
    cosines = np.divide(-b, size, out=np.zeros(len(b)), where=size > 0.0)  # on the axis any angle satisfies it
    opening = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.stack([opening, -opening], axis=1) - np.angle(a)[:, None]


def _quadratic(points: np.ndarray, circles: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a and b of |point − T(φ)|² − side² = a·t + b + ā/t with t = e^{iφ}, row by row; m²."""
    p, q = circles[..., 1, :], circles[..., 2, :]
    w = points - circles[..., 0, :]
    return -(w * (p - 1j * q)).sum(axis=-1), (w * w).sum(axis=-1) + (p * p).sum(axis=-1) - sides * sides


def _coupling(circles2: np.ndarray, circles3: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Fourier coefficients over φ2, index k + 1 for k = −1, 0, 1, of quadratics in φ3."""
    centres2 = circles2[:, 0]
    m2 = circles2[:, 1] - 1j * circles2[:, 2]
    m3 = circles3[:, 1] - 1j * circles3[:, 2]
    alpha, beta = _quadratic(centres2, circles3, sides)
    outer = ((centres2 - circles3[:, 0]) * m2).sum(axis=1)
    inner = beta + (circles2[:, 1] ** 2).sum(axis=1)
    below, above = -0.5 * (m2.conj() * m3).sum(axis=1), -0.5 * (m2 * m3).sum(axis=1)
    return np.stack([below, alpha, above], axis=1), np.stack([outer.conj(), inner, outer], axis=1)


def _samples(circles: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return N(φ) about each joint at equal steps of φ, (3, SAMPLES), m¹⁶, and bounds of its terms, (3,)."""
    alpha, beta = _coupling(circles[SECOND], circles[THIRD], sides[SECOND])
    alpha, beta = alpha[:, None], beta[:, None]
    points = _points(circles[:, None], 2.0 * np.pi / SAMPLES * np.arange(SAMPLES))
    a2, b2 = _quadratic(points, circles[SECOND][:, None], sides[:, None])
    a3, b3 = _quadratic(points, circles[THIRD][:, None], sides[THIRD][:, None])
    values = _eliminate_second(a2, b2, _eliminate_third(a3[..., None], b3[..., None], alpha, beta))
    size2 = 2.0 * np.abs(a2) + np.abs(b2)
    size3 = np.abs(a3) * np.abs(beta).sum(axis=-1) + np.abs(b3) * np.abs(alpha).sum(axis=-1)
    return values, (size2 * size3).max(axis=1) ** 4


def _eliminate_third(a: np.ndarray, b: np.ndarray, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return R(φ2) = |a·β − b·α|² − 4·Im(a·ᾱ)², the resultant over t3, as coefficients k = −2..2, (..., 5)."""
    g = a * beta - b * alpha
    h = (a * alpha[..., ::-1].conj() - a.conj() * alpha) / 2j
    return _product(g, g[..., ::-1].conj()) - 4.0 * _product(h, h)


def _product(f: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the coefficients (..., 5) of the products of polynomials with coefficients (..., 3)."""
    product = np.zeros((*f.shape[:-1], 5), complex)
    for k in range(3):
        product[..., k : k + 3] += f[..., k : k + 1] * g
    return product


def _eliminate_second(a: np.ndarray, b: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return |a|⁴·R(t₊)·R(t₋) over the two roots of a·t² + b·t + ā, without dividing by a; like a, (...)."""
    powers = a[..., None] ** np.arange(5)
    left, right = r * powers.conj(), r * powers[..., ::-1]
    square = (a * a.conj()).real
    total = (left * right).sum(axis=-1).real
    before, sums = np.full(b.shape, 2.0), -b
    for apart in range(1, 5):
        total += sums * (left[..., :-apart] * right[..., apart:]).sum(axis=-1).real
        before, sums = sums, -b * sums - square * before
    return total


def _roots(values: np.ndarray, bound: float) -> np.ndarray:
    """Return the angles at which a degree-8 trigonometric polynomial may vanish, rad."""
    half = np.fft.rfft(values)[: HALF_DEGREE + 1]
    largest = np.abs(half).max()
    if not largest > 1e-12 * SAMPLES * bound:
        return 2.0 * np.pi / SAMPLES * np.arange(SAMPLES)
    # A tiny leading coefficient belongs to roots near 0 and ∞, far from any real angle; its reciprocal
    # would dominate the others by rounding.
    degree = int(np.flatnonzero(np.abs(half) > 1e-9 * largest)[-1])
    roots = np.roots(np.concatenate([half[degree:0:-1], half[:1].real, half[1 : degree + 1].conj()]))
    return np.angle(roots[np.abs(roots) > 0.9])


NEAR = 0.01  # Triangles closer than this, relative to the sum of the sides, may be copies of one multiple root


def closed_triangles(
    circles: np.ndarray, sides: np.ndarray, starts: np.ndarray, allowed: float, distinct: float
) -> np.ndarray:
    """Return the distinct closed triangles that the minimiser reaches."""
    angles, points, errors = _settled(circles, sides, starts)
    left = errors.argsort()
    left = left[: int((errors <= allowed).sum())]
    corners = []
    while len(left):
        best, left = left[0], left[1:]
        corners.append(points[best])
        apart = np.abs(points[left] - points[best]).max(axis=(1, 2))
        new = apart >= distinct
        near = new & (apart < NEAR * sides.sum())
        if near.any():
            new[near] = ~_closed_between(circles, sides, angles[left[near]], angles[best], allowed)
        left = left[new]
    return np.array(corners).reshape(-1, 3, 3)


def _closed_between(
    circles: np.ndarray, sides: np.ndarray, angles: np.ndarray, other: np.ndarray, allowed: float
) -> np.ndarray:
    """Return for each of (N, 3) solutions whether the loops also close between it and the other, (3,)."""
    turn = other - angles
    turn -= 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
    starts = angles + 0.38 * turn
    ends, _, errors = _settled(circles, sides, starts)
    moved = np.abs(ends - starts).max(axis=1)
    return (errors <= allowed) & (moved < 0.1 * np.abs(turn).max(axis=1))


def _settled(circles: np.ndarray, sides: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angles (N, 3), corners (N, 3, 3), m, and largest side errors (N,), m, that starts lead to."""
    angles, points, errors = starts.copy(), np.empty((len(starts), 3, 3)), np.empty(len(starts))
    settle(circles, sides, angles, points, errors)
    return angles, points, errors


CLOSURE = 1e-12  # Largest error of a strut length or of a platform side in a mode, relative to the longest strut
# Modes whose platform joints all lie closer than this, relative to the longest strut, are one double mode: rounding
# moves the two of a pair by about √1e-16 = 1e-8
DISTINCT = 1e-6
# Largest distance of two platform joints that count as one, relative to the characteristic length; enough for
# deviations of 1 mm on a machine with a 300 mm platform
PAIR_GAP = 0.02
EXACT_GAP = 1e-13  # Pairs closer than this, relative to the characteristic length, coincide to rounding
# Modes of the pairs' midpoints that fail to close by up to this many gaps are tried on a real structure
NEARLY_CLOSED = 20.0
MOST_MODES = 16  # A 6-3 machine has at most sixteen modes unless it can move with all struts locked
# A 6-6 machine has at most forty modes (Raghavan 1993) unless it can move with all struts locked
MOST_GENERAL_MODES = 40
ORIENTATIONS = 2000  # Attitudes from which the modes of a machine that is not 6-3 are sought, two positions each
AMBIGUITY = 1.2  # A cold start is refused when the second-nearest candidate is within this factor of the nearest


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
    """Return the pose in which the machine must be, for cold starts: without a guess other than its home."""
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
    """Return why a pose is not the working mode; empty if it is."""
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
    """Return the mode nearest to home; refuse if the next is almost as near."""

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
    """Return the base joints' centroid, m, and their mean plane's normal towards home; each (3,), ``base``."""
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
    """Return the platform corners T1..T3, (M, 3, 3), m, of all modes of the machine with its pairs' midpoints."""
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
    # Near a singular pose Newton may converge to another mode: then the triangle is used as it is.
    return [
        fine if fine is not None and _same(structure, fine, pose, lengths) else pose
        for pose, fine in zip(poses, polished, strict=True)
    ]


def _continued_poses(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the real structure's modes near those of the machine with its pairs' midpoints."""
    gap = platform_pair_gap(structure)
    # The wide tolerance includes pairs of modes that the deviations have separated or merged.
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
    """Return positions (N, 3), m, and rotations (N, 3, 3) with approximately the struts' lengths."""
    from scipy.spatial.transform import Rotation  # half of the time in which ik starts, and it needs none

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
    """Return guesses at a pose and, where it is nearly singular, to both sides along the weakest motion."""
    size = structure.characteristic_length
    from scipy.spatial.transform import Rotation  # as in _starts_around

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
