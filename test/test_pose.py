"""Poses: the paper's angles, quaternions, composition, and refused values."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import moved
from hypothesis import given
from scipy.spatial.transform import Rotation
from strategies import fixed, seeds

from hexapod_comp.errors import PoseError
from hexapod_comp.pose import (
    Pose,
    angles_from_rotation,
    best_motion,
    nearest_rotation,
    roll_pitch_yaw,
    rotation_angle,
    rotation_from_angles,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_vector,
)

EXACT = 4e-16  # elements of a rotation matrix are sums of two products of numbers up to 1


def printed_matrix(alpha, beta, gamma):
    """Return the rotation part of T_BASE^TOP as Song et al. print it."""
    ca, sa = np.cos(alpha), np.sin(alpha)
    cb, sb = np.cos(beta), np.sin(beta)
    cg, sg = np.cos(gamma), np.sin(gamma)
    return np.array(
        [
            [cb * cg + sa * sb * sg, -cb * sg + sa * sb * cg, ca * sb],
            [ca * sg, ca * cg, -sa],
            [-sb * cg + sa * cb * sg, sb * sg + sa * cb * cg, ca * cb],
        ]
    )


def as_matrix(pose):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.position
    return matrix


@fixed
@given(seeds)
def test_angles_give_the_papers_matrix_and_come_back(seed):
    """The truth is T_BASE^TOP as printed by Song et al., and its inverse, unique for |α| < 90°; one pose and a batch.

    Near ±86° a rounding of 1e-16 grows by 1/cos α = 14.
    """
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-1.5, -np.pi, -np.pi], [1.5, np.pi, np.pi], (2, 3, 3))
    rotations = rotation_from_angles(angles)
    assert rotations.shape == (2, 3, 3, 3)
    np.testing.assert_allclose(rotations[1, 2], printed_matrix(*angles[1, 2]), atol=2 * EXACT)
    np.testing.assert_allclose(angles_from_rotation(rotations), angles, atol=2e-14)
    np.testing.assert_allclose(Pose.from_angles(np.zeros(3), angles[1, 2]).angles(), angles[1, 2], atol=2e-14)


@pytest.mark.parametrize("short_of", [0.0, 1e-15, 1e-9])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_angles_at_gimbal_lock_give_the_same_rotation(sign, short_of):
    """At α = ±90° only β ∓ γ is determined, but the returned angles must give the same matrix.

    (γ from the second row alone, whose elements vanish there, gave rotations wrong by 0.1.)
    """
    alpha = sign * (np.pi / 2 - short_of)
    pose = Pose.from_angles(np.zeros(3), np.array([alpha, 0.3, 0.2]))
    np.testing.assert_allclose(rotation_from_angles(pose.angles()), pose.rotation, atol=1e-15)


@pytest.mark.parametrize("pitch", [0.3, -1.2, 0.5 * np.pi, -0.5 * np.pi])
def test_roll_pitch_yaw_give_the_rotation_back(pitch: float) -> None:
    """The truth is SciPy's rotation from angles about fixed axes, also at a pitch of 90°, where they are not unique."""
    for roll, yaw in ((0.0, 0.0), (0.4, -2.5), (-3.0, 1.1)):
        rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
        again = Rotation.from_euler("xyz", roll_pitch_yaw(rotation)).as_matrix()
        np.testing.assert_allclose(again, rotation, atol=1e-15)


@fixed
@given(seeds)
def test_quaternion_is_half_the_angle_about_the_axis(seed):
    """The truth is (n·sin φ/2, cos φ/2) with φ in [0, π], so that w ≥ 0; and its inverse."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angle = rng.uniform(0.0, 3.1)
    pose = Pose(np.zeros(3), Rotation.from_rotvec(angle * axis).as_matrix())
    truth = np.append(axis * np.sin(angle / 2), np.cos(angle / 2))
    np.testing.assert_allclose(pose.quaternion(), truth, atol=2e-15)
    np.testing.assert_allclose(Pose.from_quaternion(np.zeros(3), -truth).rotation, pose.rotation, atol=2e-15)
    assert rotation_angle(pose.rotation) == pytest.approx(angle, abs=4e-15)


@fixed
@given(seeds)
def test_composition_and_inverse_are_those_of_matrices(seed):
    """The truth is NumPy's products and inverses of 4 × 4 matrices; lengths of 10 m are rounded a few times."""
    rng = np.random.default_rng(seed)
    one, two = (Pose.from_angles(rng.uniform(-10.0, 10.0, 3), rng.uniform(-np.pi, np.pi, 3)) for _ in range(2))
    np.testing.assert_allclose(as_matrix(one @ two), as_matrix(one) @ as_matrix(two), atol=1e-14)
    np.testing.assert_allclose(as_matrix(one.inverse()), np.linalg.inv(as_matrix(one)), atol=1e-13)
    np.testing.assert_allclose(as_matrix(one @ Pose.identity()), as_matrix(one), atol=0)
    points = np.hstack([np.vstack([two.position, -3.0 * one.position]), np.ones((2, 1))])
    np.testing.assert_allclose(one.transform(points[:, :3]), (points @ as_matrix(one).T)[:, :3], atol=1e-13)


@pytest.mark.parametrize(
    ("make", "position", "rotation", "message"),
    [
        (Pose, [0, 0], np.eye(3), r"position must have shape \(3,\), not \(2,\)"),
        (Pose, [0, np.nan, 0], np.eye(3), "position must be finite.*nan"),
        (Pose, ["0", "0", "top"], np.eye(3), r"position must be numbers of shape \(3,\).*top"),
        (Pose, [0, 0, 0], [[1, 0], [0]], r"rotation matrix must be numbers of shape \(3, 3\)"),
        (Pose, [0, 0, 0], np.full((3, 3), np.nan), "rotation matrix must be finite"),
        (Pose, [0, 0, 0], np.diag([1.0, 1.0, -1.0]), "orthonormal and right-handed"),
        (Pose, [0, 0, 0], np.diag([1.0, 1.0, 1.0 + 1e-8]), "orthonormal and right-handed"),
        (Pose.from_quaternion, [0, 0, 0], [0, 0, 0, 1.002], "norm 1, not 1.002"),
        (Pose.from_quaternion, [0, 0, 0], [0, 0, np.nan, 1], "quaternion must be finite"),
    ],
)
def test_what_is_no_pose(make, position, rotation, message):
    with pytest.raises(PoseError, match=message):
        make(position, rotation)


def test_what_is_just_a_pose() -> None:
    """Just within the tolerances of rotations, 1e-9 of RᵀR, and quaternions, 1e-3; angles reach ±1000 rad."""
    pose = Pose.from_quaternion([0.1, -0.2, 0.3], [0, 0, 0, 1.0009])
    assert Pose(pose.position, np.diag([1.0, 1.0, 1.0 + 4e-10])).rotation[2, 2] > 1.0
    names = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
    turned = Pose.from_angles(pose.position, np.radians([10.0, 20.0, -30.0]))
    assert turned.as_columns() == pytest.approx(dict(zip(names, (100, -200, 300, 10, 20, -30), strict=True)))
    assert np.isfinite(rotation_from_angles(np.full(3, -1000.0))).all()
    with pytest.raises(PoseError, match=r"angles must lie within ±1000 rad .*1000\.1"):
        rotation_from_angles(np.array([0.0, -1000.1, 0.0]))


def test_the_best_motion_takes_points_back_to_where_they_came_from():
    """The motion of points that were turned and shifted is found; with errors no small motion improves it.

    Two points, or points on a line, about which they may turn, give none."""
    rng = np.random.default_rng(1)
    points, turn = rng.uniform(-0.2, 0.2, (9, 3)), Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3)).as_matrix()
    shift = rng.uniform(-0.5, 0.5, 3)
    motion = best_motion((points - shift) @ turn, points)  # undoes turn @ p + shift
    np.testing.assert_allclose(motion.rotation, turn, atol=1e-12)
    np.testing.assert_allclose(motion.position, shift, atol=1e-12)
    seen = points + rng.uniform(-1e-3, 1e-3, points.shape)
    motion = best_motion(seen, points)
    left = np.linalg.norm(motion.position + seen @ motion.rotation.T - points)
    for twist in 1e-5 * np.vstack([np.eye(6), -np.eye(6)]):
        other = moved(motion, twist)
        assert np.linalg.norm(other.position + seen @ other.rotation.T - points) > left
    for count in (2, 7):
        line = np.linspace(0.0, 1.0, count)[:, None] * [0.1, 0.2, -0.3] + [1.0, 2.0, 3.0]
        assert best_motion(line + 1e-4, line) is None


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 0.5, 2.0, np.pi - 1e-9, np.pi])
def test_rotation_vectors_are_those_of_scipy(angle: float) -> None:
    """The truth is SciPy's Rotation in both directions; at π the sign of a vector is free, but not its rotation."""
    axes = np.vstack([np.random.default_rng(4).normal(size=(50, 3)), np.eye(3), -np.eye(3)])
    vectors = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    truth = Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(rotation_from_vector(vectors), truth.as_matrix(), atol=2e-15)
    np.testing.assert_allclose(rotation_from_quaternion(3.0 * truth.as_quat()), truth.as_matrix(), atol=2e-15)
    found = rotation_vector(truth.as_matrix())
    np.testing.assert_allclose(Rotation.from_rotvec(found).as_matrix(), truth.as_matrix(), atol=4e-15)
    if angle < 3.1:
        np.testing.assert_allclose(found, vectors, rtol=1e-14, atol=angle * 1e-15)
    np.testing.assert_allclose(rotation_vector(truth.as_matrix()[0]), found[0], rtol=1e-15)


def test_the_nearest_rotation_to_a_sum_is_the_mean() -> None:
    """The truth is SciPy's mean; also a matrix with a negative determinant gives a rotation."""
    some = Rotation.from_rotvec(0.4 * np.random.default_rng(5).normal(size=(9, 3)))
    np.testing.assert_allclose(nearest_rotation(some.as_matrix().sum(axis=0)), some.mean().as_matrix(), atol=1e-14)
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -0.5]))) == pytest.approx(1.0)
