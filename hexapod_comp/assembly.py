"""Forward kinematics without a guess: every assembly mode of a 6-3 machine, and the pick of the working one.

On a 6-3 machine struts (1, 2), (3, 4), (5, 6) share a platform joint. Two struts of given length hold their
joint T_i on a circle about the line through their base joints, at an angle φ_i; the platform is a triangle
of given sides. So three angles meet three distances, |T_i − T_j| = a_ij (doc/theory.md, own derivation):

* with t = e^{iφ} each distance condition is a quadratic a·t² + b·t + ā = 0 in either of its two angles;
* eliminating φ3 between |T1 − T3| and |T2 − T3| (resultant of two quadratics) leaves a real trigonometric
  polynomial R(φ2) of degree 2, whose coefficients depend on φ1;
* eliminating φ2 between R and |T1 − T2| leaves a real trigonometric polynomial N(φ1) of degree 8: sixteen
  roots z = e^{iφ1}, those of a machine that can be put together lie on |z| = 1.

N is sampled, not expanded: a Fourier transform gives its coefficients, a companion matrix its roots. Roots
only start the search: from each of them a minimiser of the three distance errors runs on every branch, so a
root that rounding has pushed off the circle (double roots: singular poses) is not lost, and what counts as a
mode is decided by closure alone. The elimination is done about each of the three joints in turn, so that a
root that is badly conditioned in one angle is found through another.
"""

from __future__ import annotations

import math

import numpy as np

from . import kernels
from .compiling import compiled
from .errors import KinematicsError, OtherAssemblyModeError, SingularError, UnreachableError
from .geometry import HexapodGeometry
from .kinematics import Structure, condition_number, six_lengths, solve_pose
from .pose import Pose, rotation_angle

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

AMBIGUITY = 1.2
"""A cold start is refused when the second-nearest candidate is within this factor of the nearest."""

SAMPLES = 32
HALF_DEGREE = 8
PAIRS = ((0, 1), (2, 3), (4, 5))
ORDERS = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def assembly_modes(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return every real pose of a 6-3 machine that has these strut lengths; no guess is needed.

    Parameters
    ----------
    structure : Structure
        Machine whose platform joints coincide in the pairs (1, 2), (3, 4), (5, 6), exactly or, on a real
        structure, within :data:`PAIR_GAP`; base joints anywhere. Its home sign and largest condition number
        are not used: all modes are returned.
    lengths : array_like, shape (6,)
        Strut lengths, m.

    Returns
    -------
    list of Pose
        ``pose_platform_in_base``, highest platform first; empty when no pose has these lengths. A singular
        pose (double root) is listed once.

    Raises
    ------
    NotFiniteError
        A length is NaN, infinite or not positive.
    SingularError
        The machine moves with its struts locked: its poses are not countable.
    KinematicsError
        Not a 6-3 machine; or joints that define no circle or no triangle.

    Notes
    -----
    For pairs that coincide the list is complete. For a real structure the modes of the machine with the
    pairs' midpoints are continued by Newton. With deviations of a few tenths of a per cent of the platform's
    size, modes within a hair of a singular pose (condition numbers above 100) can be missed there.
    """
    lengths = six_lengths(lengths)
    _refuse_degenerate(structure)
    if platform_pair_gap(structure) <= EXACT_GAP * structure.characteristic_length:
        poses = _exact_poses(structure, lengths)
    else:
        poses = _continued_poses(structure, lengths)
    return sorted(poses, key=lambda pose: -pose.position[2])


def working_mode(geometry: HexapodGeometry, structure: Structure, lengths: np.ndarray) -> Pose:
    """Return the pose in which the machine must be standing, for cold starts: no guess but its home.

    Of all modes only those count that the machine can work in: det J of home's sign, platform on home's side
    of the base, condition number and joint cones within their limits. Of several the nearest to home is
    taken, by |Δposition| + characteristic length · angle, unless the next is nearly as near. On a machine
    that is not 6-3 the one candidate is what Newton finds from home.

    The lengths alone cannot show that the machine stands outside its own limits: it is then refused or, where
    another mode keeps the limits, taken to be in that one.

    Parameters
    ----------
    geometry : HexapodGeometry
        Home, joint cones and limits.
    structure : Structure
        Ideal or real joints.
    lengths : array_like, shape (6,)
        Strut lengths, m.

    Returns
    -------
    Pose
        ``pose_platform_in_base``.

    Raises
    ------
    UnreachableError
        No pose has these lengths.
    OtherAssemblyModeError
        No mode can be the working one (says how many there are and what rules each out), or two can.
    NotFiniteError, SingularError, NotConvergedError, KinematicsError
        As :func:`assembly_modes` or, where the machine is not 6-3, as
        :func:`~hexapod_comp.kinematics.solve_pose`.
    """
    if platform_pair_gap(structure) > PAIR_GAP * structure.characteristic_length:
        modes = [solve_pose(structure, lengths, geometry.home)]
    else:
        modes = assembly_modes(structure, lengths)
    if not modes:
        raise UnreachableError("no pose of the machine has these strut lengths", 0)
    side = _home_side(geometry, structure)
    objections = [_objections(geometry, structure, mode, *side) for mode in modes]
    fit = [mode for mode, found in zip(modes, objections, strict=True) if not found]
    if not fit:
        listed = "; ".join(f"mode {i}: {', '.join(found)}" for i, found in enumerate(objections, start=1))
        problem = f"none of the {len(modes)} poses with these strut lengths can be the working one: {listed}"
        raise OtherAssemblyModeError(problem, len(modes))
    return _nearest_to_home(geometry, structure, fit)


def mode_objections(geometry: HexapodGeometry, structure: Structure, pose: Pose) -> list[str]:
    """Return what keeps a pose from being the working mode; empty when nothing does.

    Parameters
    ----------
    geometry : HexapodGeometry
        Home, joint cones and limits.
    structure : Structure
        Ideal or real joints.
    pose : Pose
        ``pose_platform_in_base``.
    """
    return _objections(geometry, structure, pose, *_home_side(geometry, structure))


def _objections(
    geometry: HexapodGeometry, structure: Structure, pose: Pose, centre: np.ndarray, upwards: np.ndarray
) -> list[str]:
    found = []
    condition, sign = condition_number(structure, pose)
    if sign != structure.home_sign:
        found.append("det J of the other sign")
    if not condition <= structure.max_condition:
        found.append(f"condition number {condition:.4g} above {structure.max_condition:.4g}")
    joints = pose.position + structure.platform_joints @ pose.rotation.T
    if upwards @ (joints.mean(axis=0) - centre) < 0.0:
        found.append("platform on the other side of the base")
    struts = joints - structure.base_joints
    directions = struts / np.sqrt((struts * struts).sum(axis=1))[:, None]
    for body, seen, axes, limits in (
        ("base", directions, geometry.base_cone_axes, geometry.limits.base_cone),
        ("platform", directions @ pose.rotation, geometry.platform_cone_axes, geometry.limits.platform_cone),
    ):
        angles = np.arccos(np.clip((seen * axes).sum(axis=1), -1.0, 1.0))  # rounding may leave 1 + 2e-16
        worst = int((angles - limits).argmax())
        if angles[worst] > limits[worst]:
            found.append(
                f"{body} joint {worst + 1} at {np.rad2deg(angles[worst]):.1f}°, "
                f"allowed {np.rad2deg(limits[worst]):.1f}°"
            )
    return found


def platform_pair_gap(structure: Structure) -> float:
    """Return the largest distance within the platform joint pairs (1, 2), (3, 4), (5, 6), m; 0 on a 6-3."""
    joints = structure.platform_joints
    return float(np.linalg.norm(joints[0::2] - joints[1::2], axis=1).max())


def _nearest_to_home(geometry: HexapodGeometry, structure: Structure, modes: list[Pose]) -> Pose:
    """Return the mode nearest to home; refuse where the next is nearly as near."""

    def distance(pose: Pose) -> float:
        turn = rotation_angle(geometry.home.rotation.T @ pose.rotation)
        shift = float(np.linalg.norm(pose.position - geometry.home.position))
        return shift + structure.characteristic_length * turn

    ranked = sorted(((distance(mode), index) for index, mode in enumerate(modes)))
    if len(ranked) > 1 and ranked[1][0] <= AMBIGUITY * ranked[0][0]:
        raise OtherAssemblyModeError(
            f"{len(modes)} poses with these strut lengths could be the working one and two are about as near "
            f"to home ({ranked[0][0] * 1e3:.4g} and {ranked[1][0] * 1e3:.4g} mm): give a guess",
            ranked[1][0],
            AMBIGUITY * ranked[0][0],
        )
    return modes[ranked[0][1]]


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
    """Refuse joints that make no 6-3 machine, or define no circles or no triangle."""
    gap, allowed = platform_pair_gap(structure), PAIR_GAP * structure.characteristic_length
    if gap > allowed:
        raise KinematicsError(
            "platform joints of struts (1, 2), (3, 4), (5, 6) must coincide to find poses without a guess, "
            f"but are up to {gap * 1e3:.4g} mm apart ({allowed * 1e3:.4g} mm allowed): use solve_pose",
            gap,
            allowed,
        )
    tiny = 1e-6 * structure.characteristic_length
    for first, second in PAIRS:
        apart = float(np.linalg.norm(structure.base_joints[first] - structure.base_joints[second]))
        if apart < tiny:
            raise KinematicsError(f"base joints {first + 1} and {second + 1} coincide", apart, tiny)
    corners = _corners(structure)
    area = float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))
    if area < tiny * structure.characteristic_length:
        raise KinematicsError("platform joints lie on one line: the platform can turn about it", area)


def _corners(structure: Structure) -> np.ndarray:
    """Return the midpoints of the platform joint pairs, shape (3, 3), m, in ``platform``."""
    return 0.5 * (structure.platform_joints[0::2] + structure.platform_joints[1::2])


def _closed_triangles(
    structure: Structure, lengths: np.ndarray, allowed: float, distinct: float
) -> np.ndarray:
    """Return the platform corners T1..T3 of every mode of the machine with coinciding pairs.

    Parameters
    ----------
    structure : Structure
        Only the midpoints of its platform pairs are used.
    lengths : ndarray, shape (6,)
        m.
    allowed : float
        Largest error of a platform side, m; more than rounding keeps modes that only just fail to close.
    distinct : float
        Triangles whose corners all lie closer than this, m, are one.

    Returns
    -------
    ndarray, shape (M, 3, 3)
        In ``base``, m; row i of each is T_i.
    """
    circles = np.empty((3, 10))
    if not _circles(structure.base_joints, lengths, allowed, circles):
        return np.empty((0, 3, 3))
    corners = _corners(structure)
    sides = np.linalg.norm(corners - corners[[1, 2, 0]], axis=1)
    values = np.empty((3, SAMPLES))
    starts = []
    for order in ORDERS:
        bound = _sample(circles, sides, *order, values[order[0]])
        starts.append(_start_angles(values[order[0]], bound))
    return _settle_all(circles, sides, *starts, allowed, distinct)


def _start_angles(values: np.ndarray, bound: float) -> np.ndarray:
    """Return the angles at which a degree-8 trigonometric polynomial may vanish, rad.

    Parameters
    ----------
    values : ndarray, shape (SAMPLES,)
        The polynomial at equal steps of the angle from 0.
    bound : float
        Size that its terms had before they cancelled.

    Returns
    -------
    ndarray
        Arguments of all roots z not inside the unit circle: roots come in pairs z, 1/z̄ of one argument.
        Where the polynomial vanishes everywhere, a uniform grid.
    """
    half = np.fft.rfft(values)[: HALF_DEGREE + 1]
    largest = np.abs(half).max()
    if not largest > 1e-12 * SAMPLES * bound:
        return 2.0 * np.pi / SAMPLES * np.arange(SAMPLES)
    # A tiny leading coefficient belongs to roots near 0 and ∞, far from any real angle; its reciprocal
    # would drown the others in rounding.
    degree = int(np.flatnonzero(np.abs(half) > 1e-9 * largest)[-1])
    if degree == 0:
        return np.empty(0)
    coefficients = np.concatenate([half[degree:0:-1], half[:1].real, half[1 : degree + 1].conj()])
    companion = np.eye(2 * degree, k=-1, dtype=complex)
    companion[0] = -coefficients[1:] / coefficients[0]
    roots = np.linalg.eigvals(companion)
    return np.angle(roots[np.abs(roots) > 0.9])


def _exact_poses(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the modes of a machine whose platform joints coincide in pairs."""
    scale = float(lengths.max())
    triangles = _closed_triangles(structure, lengths, CLOSURE * scale, DISTINCT * scale)
    if len(triangles) > MOST_MODES:
        raise SingularError("the machine moves with its struts locked at these lengths: its pose is open")
    positions, rotations = _platforms_at(structure, triangles)
    for position, rotation in zip(positions, rotations, strict=True):
        polished, turned = position.copy(), rotation.copy()
        if not _newton(structure, lengths, polished, turned):
            continue
        turn = np.abs(turned - rotation).max() * structure.characteristic_length
        if max(np.abs(polished - position).max(), turn) < DISTINCT * scale:
            position[:], rotation[:] = polished, turned  # else a singular pose threw Newton elsewhere
    return [Pose(*pose) for pose in zip(positions, rotations, strict=True)]


def _continued_poses(structure: Structure, lengths: np.ndarray) -> list[Pose]:
    """Return the real structure's modes near those of the machine with its pairs' midpoints."""
    gap = platform_pair_gap(structure)
    # The wide tolerance takes in pairs of modes that the deviations have parted or joined.
    triangles = _closed_triangles(structure, lengths, NEARLY_CLOSED * gap, gap)
    found: list[Pose] = []
    for pose_of_pairs in zip(*_platforms_at(structure, triangles), strict=True):
        for position, rotation in _starts_near(structure, pose_of_pairs, gap):
            if not _newton(structure, lengths, position, rotation):
                continue
            pose = Pose(position, rotation)
            if not any(_same(structure, pose, other, lengths) for other in found):
                found.append(pose)
    return found


def _platforms_at(structure: Structure, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (M, 3), m, and rotations (M, 3, 3) of the platforms with these corners."""
    positions, rotations = np.empty((len(triangles), 3)), np.empty((len(triangles), 3, 3))
    _place_platform(_corners(structure), triangles, positions, rotations)
    return positions, rotations


def _starts_near(
    structure: Structure, pose: tuple[np.ndarray, np.ndarray], gap: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return guesses at a pose and, where it is nearly singular, to both sides along the weakest motion.

    Near a singular pose a deviation ε of the joints moves modes by √ε, and parts or joins them in pairs.
    """
    position, rotation = pose
    matrix = np.empty((6, 6))
    kernels.jacobian_one(structure.base_joints, structure.platform_joints, position, rotation, matrix)
    size = structure.characteristic_length
    matrix[:, 3:] /= size
    _, singular_values, directions = np.linalg.svd(matrix)
    starts = [(position.copy(), rotation.copy())]
    reach = math.sqrt(gap * size)
    if singular_values[-1] > 4.0 * reach / size:
        return starts
    for step in (-3.0 * reach, -reach, -0.3 * reach, 0.3 * reach, reach, 3.0 * reach):
        turned = rotation.copy()
        kernels.rotate(turned, *(step / size * directions[-1][3:]))
        starts.append((position + step * directions[-1][:3], turned))
    return starts


def _same(structure: Structure, one: Pose, other: Pose, lengths: np.ndarray) -> bool:
    apart = one.position - other.position + structure.platform_joints @ (one.rotation - other.rotation).T
    return bool(np.abs(apart).max() < DISTINCT * lengths.max())


def _newton(structure: Structure, lengths: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> bool:
    """Polish a pose in place on the six loop closures; any sign, any condition number."""
    outcome, _, _ = kernels.solve_pose_one(
        structure.base_joints,
        structure.platform_joints,
        lengths,
        position,
        rotation,
        structure.characteristic_length,
        0.0,
        math.inf,
    )
    return outcome == kernels.OK


@compiled
def _place_platform(corners, triangles, positions, rotations):
    """Write the platform poses whose corners, (3, 3) in ``platform``, stand at triangles, (M, 3, 3)."""
    own, seen = np.empty((3, 3)), np.empty((3, 3))
    _triad(corners, own)
    for n in range(len(triangles)):
        _triad(triangles[n], seen)
        for i in range(3):
            positions[n, i] = 0.0
            for k in range(3):
                rotations[n, i, k] = seen[0, i] * own[0, k] + seen[1, i] * own[1, k] + seen[2, i] * own[2, k]
        for i in range(3):
            for m in range(3):
                positions[n, i] += triangles[n, m, i] / 3.0
                for k in range(3):
                    positions[n, i] -= rotations[n, i, k] * corners[m, k] / 3.0


@compiled
def _triad(points, axes):
    """Write an orthonormal right-handed frame attached to three points; its rows are x, y, z."""
    for k in range(3):
        axes[0, k] = points[1, k] - points[0, k]
        axes[1, k] = points[2, k] - points[0, k]
    _normalise(axes[0])
    _cross(axes[0], axes[1], axes[2])
    _normalise(axes[2])
    _cross(axes[2], axes[0], axes[1])


@compiled
def _normalise(vector):
    """Make a vector of shape (3,) one of length 1 and return its former length."""
    length = math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    for k in range(3):
        vector[k] /= length
    return length


@compiled
def _cross(a, b, product):
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def _circles(base, lengths, allowed, circles):
    """Write the three circles, rows (centre, u, v, radius); return whether all exist.

    T(φ) = centre + radius·(u·cos φ + v·sin φ), m. A triangle that fails to close by no more than `allowed`
    is taken as stretched flat: at the edge of reach rounding decides its sign.
    """
    e, u, v = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        first, second = lengths[2 * i], lengths[2 * i + 1]
        for k in range(3):
            e[k] = base[2 * i + 1, k] - base[2 * i, k]
        apart = _normalise(e)
        if min(first + second - apart, apart + first - second, apart - first + second) < -allowed:
            return False
        # Heron's formula keeps its accuracy for flat triangles, where L² − s² would not.
        product = (first + second - apart) * (apart + first - second) * (apart - first + second)
        along = 0.5 * (apart + (first - second) * (first + second) / apart)
        circles[i, 9] = math.sqrt(max(product, 0.0) * (first + second + apart)) / (2.0 * apart)
        thin = 0
        for k in range(1, 3):
            thin = k if abs(e[k]) < abs(e[thin]) else thin
        for k in range(3):
            circles[i, k] = base[2 * i, k] + along * e[k]
            u[k] = (1.0 if k == thin else 0.0) - e[thin] * e[k]
        _normalise(u)
        _cross(e, u, v)
        for k in range(3):
            circles[i, 3 + k], circles[i, 6 + k] = u[k], v[k]
    return True


@compiled
def _point(circle, angle, point, tangent):
    """Write T(φ) and dT/dφ."""
    c, s = circle[9] * math.cos(angle), circle[9] * math.sin(angle)
    for k in range(3):
        point[k] = circle[k] + c * circle[3 + k] + s * circle[6 + k]
        tangent[k] = c * circle[6 + k] - s * circle[3 + k]


@compiled
def _quadratic(point, circle, side):
    """Return (a, b) of |point − T(φ)|² − side² = a·t + b + ā/t with t = e^{iφ}; `point` may be complex.

    For a complex point, a point's Fourier coefficient, only a is meant and the centre is not subtracted.
    """
    square, real, imaginary = 0.0, 0.0, 0.0
    for k in range(3):
        w = point[k] - circle[k]
        square += w * w
        real += w * circle[3 + k]
        imaginary += w * circle[6 + k]
    radius = circle[9]
    return complex(-radius * real, radius * imaginary), square + radius * radius - side * side


@compiled
def _coupling(circle2, circle3, side):
    """Return the Fourier coefficients over φ2, index k + 1 for k = −1, 0, 1, of the quadratic in φ3.

    |T2(φ2) − T3(φ3)|² − side² = α(φ2)·t3 + β(φ2) + ᾱ(φ2)/t3.
    """
    alpha, beta = np.zeros(3, np.complex128), np.zeros(3, np.complex128)
    alpha[1], plain = _quadratic(circle2, circle3, side)
    beta[1] = plain + circle2[9] ** 2
    radii = 0.5 * circle2[9] * circle3[9]
    for k in range(3):
        m2, m3 = complex(circle2[3 + k], -circle2[6 + k]), complex(circle3[3 + k], -circle3[6 + k])
        alpha[2] -= radii * m2 * m3
        alpha[0] -= radii * m2.conjugate() * m3
        beta[2] += circle2[9] * (circle2[k] - circle3[k]) * m2
    beta[0] = beta[2].conjugate()
    return alpha, beta


@compiled
def _sample(circles, sides, first, second, third, values):
    """Write N(φ) about joint `first` at equal steps of φ; return a bound of the terms that make it up.

    Parameters
    ----------
    circles : ndarray, shape (3, 10)
        See :func:`_circles`.
    sides : ndarray, shape (3,)
        |T1 − T2|, |T2 − T3|, |T3 − T1|, m.
    first, second, third : int
        Cyclic order of the joints, so that sides[first] lies between first and second, and so on.
    values : ndarray, shape (SAMPLES,)
        Overwritten; m¹⁶.
    """
    alpha, beta = _coupling(circles[second], circles[third], sides[second])
    point, tangent = np.empty(3), np.empty(3)
    r = np.empty(5, np.complex128)
    bound = 0.0
    for n in range(values.shape[0]):
        _point(circles[first], 2.0 * math.pi * n / values.shape[0], point, tangent)
        a2, b2 = _quadratic(point, circles[second], sides[first])
        a3, b3 = _quadratic(point, circles[third], sides[third])
        size = _eliminate_third(a3, b3, alpha, beta, r)
        values[n] = _eliminate_second(a2, b2, r)
        bound = max(bound, (2.0 * abs(a2) + abs(b2)) ** 4 * size * size)
    return bound


@compiled
def _eliminate_third(a, b, alpha, beta, r):
    """Write R(φ2) = |a·β − b·α|² − 4·Im(a·ᾱ)², the resultant over t3, as coefficients k = −2..2.

    It is the resultant of a·t² + b·t + ā and α·t² + β·t + ᾱ with b, β real. Returns a bound of its terms.
    """
    g, h = np.empty(3, np.complex128), np.empty(3, np.complex128)
    for k in range(3):
        g[k] = a * beta[k] - b * alpha[k]
        h[k] = (a * alpha[2 - k].conjugate() - a.conjugate() * alpha[k]) / 2j
    size = 0.0
    for k in range(5):
        r[k] = 0.0
    for i in range(3):
        for j in range(3):
            r[i - j + 2] += g[i] * g[j].conjugate()
            r[i + j] -= 4.0 * h[i] * h[j]
            size += (abs(a) * abs(beta[i]) + abs(b) * abs(alpha[i])) * (
                abs(a) * abs(beta[j]) + abs(b) * abs(alpha[j])
            )
    return size


@compiled
def _eliminate_second(a, b, r):
    """Return |a|⁴·R(t₊)·R(t₋) over the two roots of a·t² + b·t + ā, without dividing by a.

    With S_m = aᵐ·(t₊ᵐ + t₋ᵐ), which obeys S_m = −b·S_{m−1} − |a|²·S_{m−2}, the product is
    Σ_j r_j²·ā^{2+j}·a^{2−j} + Σ_{j<k} r_j·r_k·ā^{2+j}·a^{2−k}·S_{k−j}, j and k from −2 to 2.
    """
    powers, conjugates = np.ones(5, np.complex128), np.ones(5, np.complex128)
    sums = np.empty(5)
    sums[0], sums[1] = 2.0, -b
    square = a.real * a.real + a.imag * a.imag
    for m in range(1, 5):
        powers[m] = powers[m - 1] * a
        conjugates[m] = conjugates[m - 1] * a.conjugate()
        if m > 1:
            sums[m] = -b * sums[m - 1] - square * sums[m - 2]
    total = 0.0
    for j in range(5):
        for k in range(j, 5):
            share = 0.5 * sums[0] if j == k else sums[k - j]
            total += (r[j] * r[k] * conjugates[j] * powers[4 - k]).real * share
    return total


@compiled
def _settle_all(circles, sides, starts0, starts1, starts2, allowed, distinct):
    """Return the distinct closed triangles reached from all start angles on all branches, (M, 3, 3)."""
    most = 4 * (len(starts0) + len(starts1) + len(starts2))
    found, found_angles, errors = np.empty((most, 3, 3)), np.empty((most, 3)), np.empty(most)
    count = 0
    angles, points = np.empty(3), np.empty((3, 3))
    for first in range(3):
        second, third = (first + 1) % 3, (first + 2) % 3
        starts = starts0 if first == 0 else (starts1 if first == 1 else starts2)
        for n in range(4 * len(starts)):
            angles[first] = starts[n // 4]
            _point(circles[first], angles[first], points[0], points[1])
            angles[second] = _branch(points[0], circles[second], sides[first], n % 2)
            angles[third] = _branch(points[0], circles[third], sides[third], n // 2 % 2)
            error = _settle(circles, sides, angles, points)
            if not error <= allowed:
                continue
            copy = _find_copy(circles, sides, angles, points, allowed, found[:count], found_angles, distinct)
            if copy == count or error < errors[copy]:
                _store(found[copy], points, found_angles[copy], angles)
                errors[copy] = error
            count = max(count, copy + 1)
    return found[:count].copy()


@compiled
def _store(to_points, points, to_angles, angles):
    for i in range(3):
        to_angles[i] = angles[i]
        for k in range(3):
            to_points[i, k] = points[i, k]


@compiled
def _branch(point, circle, side, branch):
    """Return one of the two angles at which the circle is `side` from the point, or the nearest to being."""
    a, b = _quadratic(point, circle, side)
    size = 2.0 * abs(a)
    if size == 0.0:
        return math.pi * branch
    opening = math.acos(min(1.0, max(-1.0, -b / size)))
    middle = -math.atan2(a.imag, a.real)
    return middle + opening if branch == 0 else middle - opening


@compiled
def _find_copy(circles, sides, angles, points, allowed, found, found_angles, distinct):
    """Return the index of the triangle that `points` repeats, len(found) if it is new.

    At a root of multiplicity m rounding spreads the solutions over ε^{1/m}, 1e-4 for m = 4, so distance
    alone does not tell copies from neighbours.
    """
    size = sides[0] + sides[1] + sides[2]
    for n in range(len(found)):
        apart = 0.0
        for i in range(3):
            for k in range(3):
                apart = max(apart, abs(points[i, k] - found[n, i, k]))
        if apart < distinct:
            return n
        if apart < 0.01 * size and _closed_between(circles, sides, angles, found_angles[n], allowed):
            return n
    return len(found)


@compiled
def _closed_between(circles, sides, one, other, allowed):
    """Return whether the loops also close between two solutions: then they are one multiple root.

    A start between two modes either stays open or runs to one of them; between two copies it closes on the
    spot. It is not taken halfway, where symmetry likes to put a third mode.
    """
    angles, points, start = np.empty(3), np.empty((3, 3)), np.empty(3)
    apart, moved = 0.0, 0.0
    for i in range(3):
        turn = other[i] - one[i]
        turn -= 2.0 * math.pi * np.rint(turn / (2.0 * math.pi))
        start[i] = one[i] + 0.38 * turn
        angles[i] = start[i]
        apart = max(apart, abs(turn))
    if not _settle(circles, sides, angles, points) <= allowed:
        return False
    for i in range(3):
        moved = max(moved, abs(angles[i] - start[i]))
    return moved < 0.1 * apart


@compiled
def _settle(circles, sides, angles, points):
    """Minimise the three side errors over the three angles (Levenberg-Marquardt); return the largest, m.

    `points` receives T1..T3. A minimiser rather than Newton: at a double root the Jacobian is singular,
    where Newton would be thrown out of reach by rounding.
    """
    jacobian, tangents, errors = np.zeros((3, 3)), np.empty((3, 3)), np.empty(3)
    trial, step = np.empty(3), np.empty(3)
    cost = _side_errors(circles, sides, angles, points, tangents, errors, jacobian)
    rounding = (2e-16 * (sides[0] + sides[1] + sides[2])) ** 2
    damping = 1e-6
    for _ in range(60):
        if cost <= rounding or damping > 1e6:
            break
        _damped_step(jacobian, errors, damping, step)
        for i in range(3):
            trial[i] = angles[i] + step[i]
        next_cost = _side_errors(circles, sides, trial, points, tangents, errors, jacobian)
        if next_cost < cost:
            for i in range(3):
                angles[i] = trial[i]
            cost, damping = next_cost, 0.1 * damping
        else:
            damping = 10.0 * max(damping, 1e-12)
            _side_errors(circles, sides, angles, points, tangents, errors, jacobian)
    _side_errors(circles, sides, angles, points, tangents, errors, jacobian)
    return max(abs(errors[0]), abs(errors[1]), abs(errors[2]))


@compiled
def _side_errors(circles, sides, angles, points, tangents, errors, jacobian):
    """Write points, tangents, errors (|T_i − T_j|² − a²)/(2a), m, and ∂errors/∂φ; return Σ errors²."""
    for i in range(3):
        _point(circles[i], angles[i], points[i], tangents[i])
    cost = 0.0
    for i in range(3):
        j = (i + 1) % 3
        square, by_i, by_j = 0.0, 0.0, 0.0
        for k in range(3):
            apart = points[i, k] - points[j, k]
            square += apart * apart
            by_i += apart * tangents[i, k]
            by_j -= apart * tangents[j, k]
        errors[i] = (square - sides[i] * sides[i]) / (2.0 * sides[i])
        jacobian[i, i], jacobian[i, j] = by_i / sides[i], by_j / sides[i]
        cost += errors[i] * errors[i]
    return cost


@compiled
def _damped_step(jacobian, errors, damping, step):
    """Write −(JᵀJ + damping·tr(JᵀJ)·1)⁻¹·Jᵀ·errors, by Cramer's rule."""
    j = jacobian
    n00 = j[0, 0] ** 2 + j[1, 0] ** 2 + j[2, 0] ** 2
    n11 = j[0, 1] ** 2 + j[1, 1] ** 2 + j[2, 1] ** 2
    n22 = j[0, 2] ** 2 + j[1, 2] ** 2 + j[2, 2] ** 2
    n01 = j[0, 0] * j[0, 1] + j[1, 0] * j[1, 1] + j[2, 0] * j[2, 1]
    n02 = j[0, 0] * j[0, 2] + j[1, 0] * j[1, 2] + j[2, 0] * j[2, 2]
    n12 = j[0, 1] * j[0, 2] + j[1, 1] * j[1, 2] + j[2, 1] * j[2, 2]
    added = damping * (n00 + n11 + n22)
    n00, n11, n22 = n00 + added, n11 + added, n22 + added
    g0 = j[0, 0] * errors[0] + j[1, 0] * errors[1] + j[2, 0] * errors[2]
    g1 = j[0, 1] * errors[0] + j[1, 1] * errors[1] + j[2, 1] * errors[2]
    g2 = j[0, 2] * errors[0] + j[1, 2] * errors[1] + j[2, 2] * errors[2]
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
    determinant = n00 * c00 + n01 * c01 + n02 * c02
    if not abs(determinant) > 0.0:
        step[0], step[1], step[2] = 0.0, 0.0, 0.0
        return
    step[0] = -(c00 * g0 + c01 * g1 + c02 * g2) / determinant
    step[1] = -(c01 * g0 + c11 * g1 + c12 * g2) / determinant
    step[2] = -(c02 * g0 + c12 * g1 + c22 * g2) / determinant
