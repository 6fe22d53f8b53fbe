"""Batches of the core: against NumPy, SciPy and finite differences, and what is refused where arrays cross."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from strategies import paper_geometry, skewed_geometry

from hexapod_comp.core import batch, ffi


def drawn_poses(geometry, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    positions = geometry.home.position + rng.uniform(-0.05, 0.05, (count, 3))
    turned = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, (count, 3))).as_matrix()
    return positions, np.ascontiguousarray(turned @ geometry.home.rotation)


def joints(geometry) -> tuple[np.ndarray, np.ndarray]:
    return geometry.base_joints.copy(), geometry.platform_joints.copy()


def lengths_at(geometry, positions, rotations) -> np.ndarray:
    lengths = np.empty((len(positions), 6))
    batch.strut_lengths(*joints(geometry), positions, rotations, lengths)
    return lengths


@pytest.mark.parametrize("geometry", [paper_geometry(), skewed_geometry()], ids=["6-3", "6-6"])
@pytest.mark.parametrize("count", [1, 7, 8, 21])
def test_lengths_are_numpy_s_distances(geometry, count):
    """1e-15 m: the roundings of a sum of four products."""
    positions, rotations = drawn_poses(geometry, count, 1)
    base, platform = joints(geometry)
    expected = np.linalg.norm(positions[:, None] + platform @ np.swapaxes(rotations, 1, 2) - base, axis=2)
    np.testing.assert_allclose(lengths_at(geometry, positions, rotations), expected, rtol=0.0, atol=1e-15)


def test_a_window_follows_with_play():
    """As a nut in its thread: 2 wide, pushed up to 5, the way back shows after 2."""
    low, sense = batch.follow(2.0, np.array([0.0, 5.0, 3.5, 3.0, 2.5, 5.5]))
    assert low.tolist() == [-1.0, 3.0, 3.0, 3.0, 2.5, 3.5]
    assert sense.tolist() == [0.0, 1.0, 1.0, 1.0, -1.0, 1.0]


def test_triangles_close_on_their_circles():
    """The corners lie on the circles and their distances are the sides: by NumPy, to rounding."""
    rng = np.random.default_rng(8)
    axes = Rotation.random(3, random_state=8).as_matrix()
    circles = np.ascontiguousarray(
        np.stack([0.3 * rng.normal(size=(3, 3)), 0.4 * axes[:, 0], 0.4 * axes[:, 1]], axis=1)
    )
    true = np.array([0.4, 1.9, -2.0])
    corners = circles[:, 0] + np.cos(true)[:, None] * circles[:, 1] + np.sin(true)[:, None] * circles[:, 2]
    sides = np.linalg.norm(corners - corners[[1, 2, 0]], axis=1)
    angles = true + rng.uniform(-0.05, 0.05, (40, 3))
    points, errors = np.empty((40, 3, 3)), np.empty(40)
    batch.settle(circles, sides, angles, points, errors)
    assert errors.max() < 1e-15
    np.testing.assert_allclose(
        np.linalg.norm(points - points[:, [1, 2, 0]], axis=2), np.tile(sides, (40, 1)), atol=1e-15
    )
    np.testing.assert_allclose(points, np.tile(corners, (40, 1, 1)), atol=1e-13)


WRONG = {"shape": lambda a: a[:-1], "type": lambda a: a.astype(np.float32), "layout": lambda a: np.asfortranarray(a)}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("place", range(5))
def test_what_does_not_fit_is_refused_where_it_crosses(place, wrong):
    """Nothing is read or written beyond an array: each argument's shape, type and layout is checked."""
    names = "base", "platform", "positions", "rotations", "lengths"
    arrays = [np.zeros((6, 3)), np.ones((6, 3)), np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 6))]
    arrays[place] = WRONG[wrong](arrays[place])
    # A batch of another length is one: it is the next array that does not fit.
    blamed = "rotations" if (names[place], wrong) == ("positions", "shape") else names[place]
    with pytest.raises(ValueError, match=f"^{blamed}: must be"):
        batch.strut_lengths(*arrays)


def test_quantities_lie_as_in_the_header():
    assert ffi.sizeof("hc_quantities") == batch.QUANTITIES.itemsize
    for name in batch.QUANTITIES.names:
        assert ffi.offsetof("hc_quantities", name) == batch.QUANTITIES.fields[name][1]
