"""Poses (a position and a validated rotation), and conversions from and to angles, quaternions and rotation vectors.

A pose is a position of shape (3,) in metres and a rotation matrix of shape (3, 3) whose columns are the axes of the
moving frame. Only this module converts between rotation matrices, quaternions and the angles α, β, γ of Song et al.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .core import lib
from .core.batch import quaternion_of, read_pose, rotation_flaw
from .errors import PoseError

# Largest accepted angle, rad (159 turns): no tool turns further, and the sine of a huge angle rounds badly
LARGEST_ANGLE = 1000.0
ROTATION_TOLERANCE = 1e-9  # largest deviation of RᵀR from the identity matrix that is accepted as rounding
IN_A_LINE = 1e-6  # points are regarded as collinear if the ratio of their set's width to its length is below this


@dataclass(frozen=True)
class Pose:
    """The pose of a moving frame in a reference frame, such as ``pose_platform_in_base``.

    Parameters
    ----------
    position : array_like, shape (3,)
        Origin of the moving frame, m.
    rotation : array_like, shape (3, 3)
        Rotation matrix; its columns are the moving frame's axes.

    Raises
    ------
    PoseError
        A shape is wrong, a number is not finite, or the matrix is not a rotation.
    """

    position: np.ndarray
    rotation: np.ndarray

    def __post_init__(self) -> None:
        position = _finite(self.position, (3,), "position")
        rotation = _finite(self.rotation, (3, 3), "rotation matrix")
        if not rotation_flaw(rotation) <= ROTATION_TOLERANCE:
            raise PoseError("rotation matrix must be orthonormal and right-handed", rotation.tolist())
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", rotation)

    @staticmethod
    def identity() -> Pose:
        """Return the pose with position 0 and no rotation."""
        return Pose(np.zeros(3), np.eye(3))

    @staticmethod
    def from_angles(position: ArrayLike, angles: ArrayLike) -> Pose:
        """Make a pose from a position and the angles of Song et al.

        Parameters
        ----------
        position : array_like, shape (3,)
            Origin of the moving frame, m.
        angles : array_like, shape (3,)
            α, β, γ in radians, with the rotation matrix R = Ry(β)·Rx(α)·Rz(γ) (T_BASE^TOP of Song et al.).
        """
        return Pose(_finite(position, (3,), "position"), rotation_from_angles(_finite(angles, (3,), "angles")))

    @staticmethod
    def from_quaternion(position: ArrayLike, quaternion: ArrayLike) -> Pose:
        """Make a pose from a position and a unit quaternion (x, y, z, w).

        Raises
        ------
        PoseError
            A number is not finite, or the quaternion's norm differs from 1 by more than 1e-3.
        """
        quaternion = _finite(quaternion, (4,), "quaternion")
        norm = float(np.linalg.norm(quaternion))
        if abs(norm - 1.0) > lib.QUATERNION_TOLERANCE:
            raise PoseError(f"quaternion must have norm 1, not {norm:.6g}", quaternion.tolist())
        rotation = np.empty((3, 3))
        read_pose((0.0, 0.0, 0.0, *quaternion.tolist()), np.empty(3), rotation)
        return Pose(_finite(position, (3,), "position"), rotation)

    def angles(self) -> np.ndarray:
        """Return the angles α, β, γ of Song et al., radians, shape (3,)."""
        return angles_from_rotation(self.rotation)

    def quaternion(self) -> np.ndarray:
        """Return the unit quaternion (x, y, z, w) with w ≥ 0, shape (4,)."""
        quaternion = np.array(quaternion_of(self.rotation))
        return quaternion if quaternion[3] >= 0.0 else -quaternion

    def as_columns(self) -> dict[str, float]:
        """Return position, mm, and angles, degrees, by the column names of files: ``x_mm``, …, ``alpha_deg``, …."""
        names = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
        values = [*(self.position * 1e3).tolist(), *np.degrees(self.angles()).tolist()]
        return dict(zip(names, values, strict=True))

    def inverse(self) -> Pose:
        """Return the inverse: the pose of the reference frame relative to the moving frame."""
        return Pose(-self.rotation.T @ self.position, self.rotation.T)

    def transform(self, points: np.ndarray) -> np.ndarray:
        """Convert points (N, 3), m, from coordinates in the moving frame to coordinates in the reference frame."""
        moved: np.ndarray = self.position + points @ self.rotation.T
        return moved

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.position + self.rotation @ other.position, self.rotation @ other.rotation)


def stacked(poses: Sequence[Pose] | tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3), m, and rotations (N, 3, 3) of `poses`: a sequence of Pose or a pair of such arrays."""
    listed = [pose for pose in poses if isinstance(pose, Pose)]
    if len(listed) == len(poses):
        positions, rotations = [pose.position for pose in listed], [pose.rotation for pose in listed]
        return np.reshape(positions, (-1, 3)), np.reshape(rotations, (-1, 3, 3))
    if len(poses) != 2:
        problem = "poses must be a sequence of Pose, or a pair of arrays: positions and rotations"
        raise PoseError(problem, type(poses[0]).__name__)
    count = len(poses[0])  # type: ignore[arg-type]
    return _finite(poses[0], (count, 3), "positions"), _finite(poses[1], (count, 3, 3), "rotations")


def rotation_from_angles(angles: np.ndarray) -> np.ndarray:
    """Return Ry(β)·Rx(α)·Rz(γ), (..., 3, 3), from angles α, β, γ (..., 3) in rad (Song et al., T_BASE^TOP)."""
    angles = np.asarray(angles, dtype=float)
    if (np.abs(angles) > LARGEST_ANGLE).any():
        raise PoseError(f"angles must lie within ±{LARGEST_ANGLE:g} rad", float(np.abs(angles).max()))
    cosines, sines = np.moveaxis(np.cos(angles), -1, 0), np.moveaxis(np.sin(angles), -1, 0)
    (ca, cb, cg), (sa, sb, sg) = cosines, sines
    rows = [
        [cb * cg + sb * sa * sg, sb * sa * cg - cb * sg, sb * ca],
        [ca * sg, ca * cg, -sa],
        [cb * sa * sg - sb * cg, sb * sg + cb * sa * cg, cb * ca],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles_from_rotation(rotation: np.ndarray) -> np.ndarray:
    """Return α, β, γ of R = Ry(β)·Rx(α)·Rz(γ); radians, shape (..., 3).

    At α = ±90° only the sum or the difference of β and γ is determined; rounding then decides β.
    """
    r = np.asarray(rotation, dtype=float)
    alpha = np.arctan2(-r[..., 1, 2], np.hypot(r[..., 1, 0], r[..., 1, 1]))
    beta = np.arctan2(r[..., 0, 2], r[..., 2, 2])
    # The first row of Ry(−β)·R = Rx(α)·Rz(γ) gives γ, accurately even where cos α vanishes
    cosine, sine = np.cos(beta), np.sin(beta)
    gamma = np.arctan2(sine * r[..., 2, 1] - cosine * r[..., 0, 1], cosine * r[..., 0, 0] - sine * r[..., 2, 0])
    return np.stack([alpha, beta, gamma], axis=-1)


def roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Return URDF's angles roll, pitch, yaw of R = Rz(yaw)·Ry(pitch)·Rx(roll); radians, shape (3,).

    At a pitch of ±90° only the sum or the difference of yaw and roll is determined; rounding then decides yaw.
    """
    r = np.asarray(rotation, dtype=float)
    yaw = math.atan2(r[1, 0], r[0, 0])
    cosine, sine = math.cos(yaw), math.sin(yaw)
    pitch = math.atan2(-r[2, 0], cosine * r[0, 0] + sine * r[1, 0])
    roll = math.atan2(sine * r[0, 2] - cosine * r[1, 2], cosine * r[1, 1] - sine * r[0, 1])
    return np.array([roll, pitch, yaw])


# SciPy's Rotation has the same conversions as the functions below, but takes 27 MB and 0.2 s to load


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues)."""
    vector = np.asarray(vector, dtype=float)
    angle = np.sqrt((vector * vector).sum(axis=-1))[..., None, None]
    size = np.where(angle > 0.0, angle, 1.0)
    sine, cosine = np.sin(angle) / size, 2.0 * (np.sin(0.5 * angle) / size) ** 2  # sin θ / θ and (1 − cos θ) / θ²
    outer = vector[..., :, None] * vector[..., None, :]
    return np.cos(angle) * np.eye(3) + sine * cross_matrix(vector) + cosine * outer


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of quaternions (x, y, z, w), shape (..., 4), of any norm above 0."""
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    across = cross_matrix(quaternion[..., :3])
    return np.eye(3) + 2.0 * (quaternion[..., 3, None, None] * across + across @ across)


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (..., 3), of lengths 0…π rad, of rotation matrices (..., 3, 3)."""
    r = np.asarray(rotation, dtype=float)
    # The matrix 4 q qᵀ of the quaternion q: row i is 4 qᵢ q, and the row of the largest |qᵢ| gives q most accurately
    products = np.empty((*r.shape[:-2], 4, 4))
    symmetric, difference = r + np.swapaxes(r, -1, -2), r - np.swapaxes(r, -1, -2)
    trace = np.trace(r, axis1=-2, axis2=-1)[..., None]
    products[..., :3, :3] = symmetric + (1.0 - trace[..., None]) * np.eye(3)
    sines = np.stack([difference[..., 2, 1], difference[..., 0, 2], difference[..., 1, 0]], axis=-1)
    products[..., :3, 3] = products[..., 3, :3] = sines
    products[..., 3, 3] = 1.0 + trace[..., 0]
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    quaternion = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = np.where(quaternion[..., 3:] < 0.0, -quaternion, quaternion)
    size = np.linalg.norm(quaternion[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(size, quaternion[..., 3:])
    return quaternion[..., :3] * (angle / np.where(size > 0.0, size, 1.0))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to each matrix (..., 3, 3): the mean rotation if a matrix is a sum of rotations."""
    left, _, right = np.linalg.svd(matrix)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    return np.asarray(left @ right)


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the matrices [v]×, (..., 3, 3), of vectors v, (..., 3), with [v]× w = v × w for every vector w."""
    half = np.zeros((*vector.shape, 3))
    half[..., 2, 1], half[..., 0, 2], half[..., 1, 0] = np.moveaxis(vector, -1, 0)
    return half - half.swapaxes(-1, -2)


def turned_by(quaternions: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Rotate one vector, (3,), by each of n unit quaternions (x, y, z, w), (n, 4); return n vectors, (n, 3)."""
    axis, scalar = quaternions[:, :3], quaternions[:, 3:]
    return np.asarray(vector + 2.0 * np.cross(axis, np.cross(axis, vector) + scalar * vector))


def rotation_angle(rotation: np.ndarray) -> float:
    """Return the angle, rad in [0, π], by which a rotation matrix turns."""
    *vector, scalar = quaternion_of(rotation)
    return 2.0 * math.atan2(math.hypot(*vector), abs(scalar))


def attitude_error(actual: np.ndarray, commanded: np.ndarray) -> np.ndarray:
    """Return the rotation vectors, (..., 3), rad in the reference frame, that turn commanded into actual attitudes."""
    return rotation_vector(actual @ np.swapaxes(commanded, -1, -2))


def middle_pose(poses: Sequence[Pose]) -> tuple[Pose, np.ndarray]:
    """Return the median of n similar poses, and each pose's deviation from the median, (n, 6), m and rad."""
    first = poses[0].rotation
    numbers = np.array([[*pose.position, *attitude_error(pose.rotation, first)] for pose in poses])
    middle = np.median(numbers, axis=0)
    return Pose(middle[:3], rotation_from_vector(middle[3:]) @ first), numbers - middle


def best_motion(points: np.ndarray, onto: np.ndarray) -> Pose | None:
    """Return the rigid motion T that minimises the sum of |T·points − onto|² over N pairs of points (Kabsch).

    Return None for fewer than three points and for collinear points, as these do not determine the rotation.
    """
    centre, mean = onto.mean(axis=0), points.mean(axis=0)
    spread = np.linalg.svd(onto - centre, compute_uv=False)
    if len(points) < 3 or spread[1] <= IN_A_LINE * spread[0]:
        return None
    turn = nearest_rotation((onto - centre).T @ (points - mean))
    return Pose(centre - turn @ mean, turn)


def _finite(values: object, shape: tuple[int, ...], name: str) -> np.ndarray:
    try:
        array = np.array(values, dtype=float, order="C")
    except (TypeError, ValueError) as error:  # text, other objects, or rows of different lengths
        raise PoseError(f"{name} must be numbers of shape {shape}", repr(values)) from error
    if array.shape != shape:
        raise PoseError(f"{name} must have shape {shape}, not {array.shape}")
    if not math.isfinite(array.sum()) and not np.isfinite(array).all():
        raise PoseError(f"{name} must be finite", array.tolist())
    return array
