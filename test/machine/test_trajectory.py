"""Moves and milling paths: limits kept by finite differences, rest at both ends, shapes as drawn."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers import table_poses
from scipy.spatial.transform import Rotation, Slerp
from strategies import paper_geometry, random_pose

from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.trajectory import TRACK_WINDOW, Path, circle, feet_on, motion_onto, move, pocket
from hexapod_comp.pose import Pose

PAPER = paper_geometry()
OFFSET = replace(
    PAPER,
    tool=Pose.from_angles([0.01, -0.02, -0.12], np.deg2rad([5.0, -8.0, 30.0])),
    work=Pose.from_angles([0.05, 0.03, 0.2], np.deg2rad([0.0, 3.0, 45.0])),
)
MACHINES = pytest.mark.parametrize("geometry", [PAPER, OFFSET], ids=["plain", "tool and work offset"])


def matrices(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return homogeneous matrices, shape (N, 4, 4)."""
    result = np.tile(np.eye(4), (len(positions), 1, 1))
    result[:, :3, 3], result[:, :3, :3] = positions, rotations
    return result


def lengths_by_numpy(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return strut lengths of tool poses in the work frame by 4×4 matrices, shape (N, 6)."""
    work = matrices(geometry.work.position[None], geometry.work.rotation[None])[0]
    tool = matrices(geometry.tool.position[None], geometry.tool.rotation[None])[0]
    platform = work @ matrices(positions, rotations) @ np.linalg.inv(tool)
    joints = platform[:, None, :3, :3] @ geometry.platform_joints[:, :, None]
    return np.linalg.norm(joints[..., 0] + platform[:, None, :3, 3] - geometry.base_joints, axis=2)


def with_start(start: Pose, path: Path) -> tuple[np.ndarray, np.ndarray]:
    return np.vstack([start.position, path.positions]), np.concatenate([start.rotation[None], path.rotations])


def tool_targets(geometry: HexapodGeometry) -> list[Pose]:
    """Return Table 1 of 000 as tool poses."""
    return [geometry.work.inverse() @ pose @ geometry.tool for pose in table_poses()]


@MACHINES
@pytest.mark.parametrize("rate", [20.0, 250.0, 1000.0])
def test_moves_keep_steps_and_strut_speeds(geometry: HexapodGeometry, rate: float) -> None:
    """Steps and speeds by finite differences; at 20 Hz the step of 2 mm limits, above 125 Hz the speed."""
    limits = geometry.limits
    targets = tool_targets(geometry)
    for start, end in pairwise(targets):
        path = move(geometry, start, end, rate)
        steps = np.abs(np.diff(lengths_by_numpy(geometry, *with_start(start, path)), axis=0)).max()
        allowed = min(limits.step, limits.speed / rate)
        assert steps <= 0.8 * allowed * (1.0 + 1e-3)
        assert steps >= 0.5 * allowed  # and it does not crawl: 0.8 less the coarse count of poses


@MACHINES
@pytest.mark.parametrize("rate", [250.0, 1000.0])
def test_moves_keep_the_acceleration_where_it_is_limited(geometry: HexapodGeometry, rate: float) -> None:
    """Of the struts, by second differences; 0.8 of it are meant to be used, and a third is where moves are short."""
    limited = replace(geometry, limits=replace(geometry.limits, acceleration=1.0))
    for start, end in pairwise(tool_targets(geometry)):
        path = move(limited, start, end, rate)
        lengths = lengths_by_numpy(geometry, *with_start(start, path))
        acceleration = np.abs(np.diff(lengths, 2, axis=0)).max() * rate**2
        assert 0.25 < acceleration <= 0.8 * (1.0 + 1e-3)


def test_moves_start_and_end_at_rest() -> None:
    """The quintic's ends: velocity and acceleration zero, so the first step is 10·t³ of the way."""
    start, end = table_poses()[0], table_poses()[4]
    path = move(PAPER, start, end, 1000.0)
    positions = with_start(start, path)[0]
    share = (positions - start.position) @ (end.position - start.position)
    share /= np.linalg.norm(end.position - start.position) ** 2
    n = len(path)
    assert share[1] == pytest.approx(10.0 / n**3, rel=20.0 / n)
    assert 1.0 - share[-2] == pytest.approx(10.0 / n**3, rel=20.0 / n)
    assert (np.diff(share) > 0.0).all()


@MACHINES
def test_a_move_is_straight_and_turns_along_the_shortest_arc(geometry: HexapodGeometry) -> None:
    """Against scipy's Slerp at the share of the straight line; ends exactly at the end."""
    rng = np.random.default_rng(5)
    start, end = (random_pose(rng, tool_targets(geometry)[0], tilt=25.0) for _ in range(2))
    path = move(geometry, start, end, 250.0)
    travel = end.position - start.position
    share = (path.positions - start.position) @ travel / (travel @ travel)
    np.testing.assert_allclose(path.positions, start.position + share[:, None] * travel, atol=1e-15)
    arc = Slerp([0, 1], Rotation.from_matrix([start.rotation, end.rotation]))(np.clip(share, 0, 1))
    np.testing.assert_allclose(path.rotations, arc.as_matrix(), atol=1e-13)
    np.testing.assert_allclose(path.positions[-1], end.position, atol=1e-16)
    np.testing.assert_allclose(path.rotations[-1], end.rotation, atol=1e-15)
    assert path.pose(len(path) - 1).position == pytest.approx(end.position)


def test_feed_bounds_the_tool_speed() -> None:
    start = PAPER.home
    end = Pose(start.position + np.array([0.03, 0.0, 0.0]), start.rotation)
    positions = with_start(start, move(PAPER, start, end, 500.0, feed=0.02))[0]
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) * 500.0
    assert speeds.max() <= 0.02 * (1.0 + 1e-9)
    assert speeds.max() >= 0.99 * 0.02


def test_circle_has_its_radius_plane_and_feed() -> None:
    """In the tilted centre's own frame: distance 25 mm, z zero, closed, from rest to rest at the feed at most."""
    centre = Pose.from_angles([0.01, 0.02, 0.4], np.deg2rad([8.0, -6.0, 20.0]))
    path = circle(centre, 0.025, feed=0.05, rate=250.0)
    local = (path.positions - centre.position) @ centre.rotation
    np.testing.assert_allclose(np.hypot(local[:, 0], local[:, 1]), 0.025, atol=1e-16)
    np.testing.assert_allclose(local[:, 2], 0.0, atol=1e-16)
    np.testing.assert_allclose(local[0], [0.025, 0.0, 0.0], atol=1e-16)
    np.testing.assert_allclose(local[-1], local[0], atol=1e-16)
    steps = np.linalg.norm(np.diff(local, axis=0), axis=1)
    assert 0.99 * 0.05 / 250.0 <= steps.max() <= 0.05 / 250.0 * (1.0 + 1e-9)
    assert max(steps[0], steps[-1]) < 1e-4 * steps.max()
    quarter = local[len(local) // 4]
    assert np.cross(local[0], quarter)[2] > 0.0  # counter-clockwise seen from +z
    assert (path.rotations == centre.rotation).all()


def test_pocket_mills_every_row_and_keeps_the_limits() -> None:
    corner = Pose([-0.02, -0.01, 0.4], np.eye(3))
    path = pocket(PAPER, corner, (0.04, 0.02), pitch=0.005, feed=0.05, rate=250.0)
    local = path.positions - corner.position
    assert local[:, 0].min() >= -1e-15
    assert local[:, 0].max() <= 0.04 + 1e-15
    rows = np.unique(np.round(local[(local[:, 0] > 0.01) & (local[:, 0] < 0.03), 1], 9))
    np.testing.assert_allclose(rows, [0.0, 0.005, 0.01, 0.015, 0.02], atol=1e-9)
    speeds = np.linalg.norm(np.diff(path.positions, axis=0), axis=1) * 250.0
    assert speeds.max() <= 0.05 * (1.0 + 1e-9)
    steps = np.abs(np.diff(lengths_by_numpy(PAPER, path.positions, path.rotations), axis=0)).max()
    assert steps <= PAPER.limits.speed / 250.0
    directions = np.sign(np.diff(local[:, 0]))[np.abs(np.diff(local[:, 0])) > 1e-9]
    assert (np.diff(directions) != 0.0).sum() == 4  # five rows, four reversals


def figure_of_eight(count: int = 400) -> np.ndarray:
    """Return a path that crosses itself and leaves its plane, (count, 3), m."""
    t = np.linspace(0.0, 2.0 * np.pi, count)
    return np.stack([0.02 * np.sin(t), 0.01 * np.sin(2.0 * t), 0.4 + 0.003 * np.cos(t)], axis=1)


def test_the_foot_of_a_point_is_the_nearest_place_of_what_was_just_commanded() -> None:
    """Beside a dense sampling of the last legs; where the path crosses itself the other branch does not count."""
    corners, rng = figure_of_eight(), np.random.default_rng(4)
    sent = rng.integers(0, len(corners) + 3, 200)
    newest = np.clip(sent, 1, len(corners) - 1)
    behind = np.maximum(newest - rng.integers(0, TRACK_WINDOW - 5, 200), 0)
    points = corners[behind] + rng.uniform(-1e-4, 1e-4, (200, 3))
    feet = feet_on(corners, points, sent)
    for point, last, foot in zip(points, newest, feet, strict=True):
        near = corners[max(0, last - TRACK_WINDOW) : last + 1]
        legs = [near[i] + np.linspace(0.0, 1.0, 2001)[:, None] * (near[i + 1] - near[i]) for i in range(len(near) - 1)]
        nearest = np.linalg.norm(np.concatenate(legs) - point, axis=1).min()
        assert np.linalg.norm(foot - point) == pytest.approx(nearest, rel=1e-4, abs=1e-9)


def test_a_track_is_moved_back_onto_its_path() -> None:
    """A tool that runs late on a path which stands 150 µm and 0.3 mrad off: the path's own motion takes it back."""
    corners = figure_of_eight()
    sent = np.arange(10, len(corners))
    turn, shift = Rotation.from_rotvec([1e-4, -2e-4, 2e-4]), np.array([1e-4, -1e-4, 5e-5])
    late = corners[sent - 4]
    motion = motion_onto(corners, turn.apply(late) + shift, sent)
    assert motion is not None
    back = motion.position + (turn.apply(late) + shift) @ motion.rotation.T
    assert np.linalg.norm(back - feet_on(corners, back, sent), axis=1).max() < 1e-7
    assert motion_onto(corners[:, [0, 0, 0]], late[:, [0, 0, 0]], sent) is None
