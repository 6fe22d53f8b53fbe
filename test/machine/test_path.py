"""Straight motions of least time, moves and milling: closed forms, limits by finite differences, geometry of paths."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import ALL_TESTS, long_test, table_poses
from scipy.spatial.transform import Rotation, Slerp
from strategies import paper_geometry, random_pose

from hexapod_comp.errors import GeometryError, PoseError
from hexapod_comp.machine import trajectory
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.path import Motion, StrutRates, plan_motion, plan_program
from hexapod_comp.machine.trajectory import TRACK_WINDOW, feet_on, motion_onto, move, moves
from hexapod_comp.pose import Pose

LONG = [pytest.param(name, marks=long_test) for name in ("example_6_6", "hanging")]
RATES = StrutRates(0.2, 2.0, 40.0)


def machine_of(name: str, folder: Path) -> HexapodGeometry:
    return load_geometry("example_6_6" if name == "example_6_6" else machines()[name].write(folder / "machine.yaml"))


def lengths(geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return strut lengths of tool poses in work by vectors alone, (N, 6)."""
    turned = geometry.work.rotation @ rotations @ geometry.tool.rotation.T
    tips = geometry.work.position + positions @ geometry.work.rotation.T
    joints = tips[:, None] + np.einsum("nij,kj->nki", turned, geometry.platform_joints - geometry.tool.position)
    return np.linalg.norm(joints - geometry.base_joints, axis=2)


def random_targets(geometry: HexapodGeometry, count: int, seed: int) -> list[Pose]:
    """Return poses 0.1 mm to 50 mm and up to 9° from home."""
    rng, home = np.random.default_rng(seed), geometry.tool_pose(geometry.home)
    result = []
    for size in 10.0 ** rng.uniform(-3.0, 0.0, count):
        turn = Rotation.from_rotvec(size * rng.uniform(-0.1, 0.1, 3)).as_matrix()
        result.append(Pose(home.position + size * rng.uniform(-0.05, 0.05, 3), home.rotation @ turn))
    return result


def shares(
    geometry: HexapodGeometry, path: tuple[np.ndarray, np.ndarray], rate: float, rates: StrutRates
) -> list[float]:
    """Return the largest speed, acceleration and jerk of a motion from rest to rest, over the allowed ones."""
    sent = lengths(geometry, *path)
    sent = np.concatenate([np.repeat(sent[:1], 3, axis=0), sent, np.repeat(sent[-1:], 3, axis=0)])
    allowed = rates.speed, rates.acceleration, rates.jerk
    return [
        float(np.abs(np.diff(sent, n + 1, axis=0)).max() * rate ** (n + 1) / most) for n, most in enumerate(allowed)
    ]


def seven_phases(way: float, rates: StrutRates) -> float:
    """Return the least time of one axis from rest to rest: ramps of jerk and acceleration, and a coast."""
    v, a, j = rates.speed, rates.acceleration, rates.jerk
    if math.isinf(j):
        return way / v + v / a if way >= v * v / a else 2.0 * math.sqrt(way / a)
    a = min(a, math.sqrt(v * j))
    if way >= v * (v / a + a / j):
        return way / v + v / a + a / j
    if way >= 2.0 * a**3 / j**2:
        return a / j + math.sqrt((a / j) ** 2 + 4.0 * way / a)
    return 4.0 * (way / (2.0 * j)) ** (1.0 / 3.0)


@pytest.mark.parametrize(
    ("rise", "jerk"),
    [(0.0001, math.inf), (-0.06, math.inf), (0.0001, 40.0), (0.025, 40.0), (-0.06, 40.0), (0.01, 4.0)],
)
def test_straight_up_all_struts_are_one_axis(rise: float, jerk: float) -> None:
    """Above the middle of the paper's machine all struts move alike: the optimum is the textbook's for one axis."""
    geometry, rates = paper_geometry(), replace(RATES, jerk=jerk)
    home = Pose(np.array([0.0, 0.0, geometry.home.position[2]]), geometry.home.rotation)
    start = geometry.tool_pose(home)
    end = geometry.tool_pose(Pose(home.position + np.array([0.0, 0.0, rise]), home.rotation))
    (motion,) = plan_motion(geometry, [start, end], rates)
    both = lengths(geometry, *(np.array([getattr(p, name) for p in (start, end)]) for name in ("position", "rotation")))
    assert np.ptp(both, axis=1).max() < 1e-9
    optimum = seven_phases(abs(both[1, 0] - both[0, 0]), rates)
    assert len(motion.sample(40.0 / motion.duration)) == 41, "40 periods, rounded either way"
    assert optimum * (1.0 - 1e-6) <= motion.duration <= optimum * (1.0003 if math.isinf(jerk) else 1.01)


@pytest.mark.parametrize("name", ["paper", "inches", *LONG])
def test_random_motions_keep_every_limit_and_go_straight(name: str, tmp_path: Path) -> None:
    geometry, rate = machine_of(name, tmp_path), 1000.0
    rng, targets = np.random.default_rng(5), random_targets(geometry, 51 if ALL_TESTS else 5, 4)
    for start, end in pairwise(targets):
        pivot = rng.uniform(-0.1, 0.1, 3)
        (motion,) = plan_motion(geometry, [start, end], RATES, pivot)
        path = motion.sample(rate)
        assert max(shares(geometry, (path.positions, path.rotations), rate, RATES)) <= 1.0 + 1e-6
        assert np.array_equal(path.positions[[0, -1]], [start.position, end.position])
        assert np.array_equal(path.rotations[[0, -1]], [start.rotation, end.rotation])
        assert 0.0 <= (len(path) - 1) / rate - motion.duration < 1.0 / rate
        points = path.positions + path.rotations @ pivot
        way = points[-1] - points[0]
        share = (points - points[0]) @ way / (way @ way)
        assert (np.diff(share) > -1e-9).all()
        assert np.allclose(points, points[0] + share[:, None] * way, atol=1e-12)
        turns = Rotation.from_matrix(path.rotations @ start.rotation.T).as_rotvec()
        assert np.allclose(turns, share[:, None] * turns[-1], atol=1e-9)


@pytest.mark.parametrize("name", ["paper", *LONG])
def test_a_stop_keeps_every_limit_stays_on_the_way_and_is_never_later_than_the_end(name: str, tmp_path: Path) -> None:
    geometry, rate = machine_of(name, tmp_path), 500.0
    rng, targets = np.random.default_rng(6), random_targets(geometry, 13 if ALL_TESTS else 4, 7)
    for start, end in pairwise(targets):
        (motion,) = plan_motion(geometry, [start, end], RATES)
        sent = motion.sample(rate)
        for tick in rng.integers(0, len(sent), 3):
            stop = motion.stop(min(tick / rate, motion.duration), rate)
            assert len(stop) <= len(sent) - tick + 1
            both = (
                np.concatenate([sent.positions[:tick], stop.positions]),
                np.concatenate([sent.rotations[:tick], stop.rotations]),
            )
            assert max(shares(geometry, both, rate, RATES)) <= 1.0 + 1e-3
            way = end.position - start.position
            share = (stop.positions - start.position) @ way / (way @ way)
            assert (np.diff(share) > -1e-9).all()
            assert np.allclose(stop.positions, start.position + share[:, None] * way, atol=1e-12)


def test_durations_are_as_recorded() -> None:
    """Recorded in place of a truth: nobody knows the least time. Other tests show that every limit is kept.

    By hand: at a feed of 0.03 m/s a move of d takes 1.875·d/0.03 s, and in the middle of a path of 0.15 m a stop takes
    at most three times as long as with the largest acceleration alone, 0.3 s.
    """
    geometry, poses = paper_geometry(), table_poses()
    arrays = np.array([pose.position for pose in poses[:5]]), np.array([pose.rotation for pose in poses[:5]])
    quick = replace(geometry, limits=replace(geometry.limits, acceleration=1.0))
    found = [moves(*of, 250.0, feed)[1].tolist() for of, feed in (((geometry, *arrays), math.inf),
             ((quick, *arrays), math.inf), ((geometry, *arrays), 0.03))]  # fmt: skip
    assert found == [[26, 55, 59, 64], [72, 105, 111, 117], [26, 111, 175, 79]]
    jerky, smooth = (plan_motion(geometry, poses[:4], rates) for rates in (StrutRates(0.2, 2.0), RATES))
    assert [motion.duration for motion in jerky] == pytest.approx([0.145782, 0.215504, 0.222181], rel=1e-4)
    assert [motion.duration for motion in smooth] == pytest.approx([0.210022, 0.272515, 0.278499], rel=1e-4)
    program = plan_program(geometry, poses[:5], [0.0, 0.1, 0.2, 0.3, 0.4], RATES)
    assert program.duration == pytest.approx(1.105986, rel=1e-4)
    home = geometry.tool_pose(geometry.home)
    (up,) = plan_motion(geometry, [home, Pose(home.position + np.array([0.0, 0.0, 0.15]), home.rotation)], RATES)
    assert [len(up.stop(up.duration / 2.0, 1000.0)), len(up.stop(up.duration / 4.0, 250.0))] == [175, 45]


def test_a_program_rests_at_each_way_point_and_skips_equal_ones() -> None:
    geometry = paper_geometry()
    a, b, c = random_targets(geometry, 3, 2)
    motions = plan_motion(geometry, [a, b, b, c], RATES)
    assert [(m.leg.start, m.leg.end) for m in motions] == [(a, b), (b, c)]
    assert plan_motion(geometry, [a, a], RATES) == []


def test_rates_are_a_share_of_the_machines_limits() -> None:
    """The step of 2 mm limits the speed below 125 Hz; acceleration and jerk that the file lacks follow from times."""
    geometry = paper_geometry()
    assert StrutRates.of(geometry, 50.0, 1.0).speed == pytest.approx(0.1)
    rates = StrutRates.of(geometry, 250.0, 0.8)
    assert (rates.speed, rates.acceleration, rates.jerk) == pytest.approx((0.2, 2.0, 100.0))
    given = replace(geometry, limits=replace(geometry.limits, acceleration=1.0, jerk=10.0))
    rates = StrutRates.of(given, 250.0, 0.5)
    assert (rates.speed, rates.acceleration, rates.jerk) == pytest.approx((0.125, 0.5, 5.0))
    assert load_geometry("example_6_6").limits.jerk == pytest.approx(100.0)


def test_what_makes_no_motion_is_refused() -> None:
    geometry = paper_geometry()
    home = geometry.tool_pose(geometry.home)
    (motion,) = plan_motion(geometry, [home, Pose(home.position + np.array([0.0, 0.0, 0.01]), home.rotation)], RATES)
    assert isinstance(motion, Motion)
    turned = Pose(home.position, home.rotation @ np.diag([-1.0, -1.0, 1.0]))
    with pytest.raises(PoseError, match="180° has two shortest ways"):
        plan_motion(geometry, [home, turned], RATES)
    with pytest.raises(PoseError, match="180° has two shortest ways"):
        plan_program(geometry, [home, turned], [0.0, 1.0], RATES)
    for refused, words in (
        (lambda: plan_motion(geometry, [home, home], RATES, [0.0, math.nan, 0.0]), "pivot: must be three finite"),
        (lambda: StrutRates(0.2, math.inf), "acceleration: must be positive and finite"),
        (lambda: plan_program(geometry, [home], [0.0], RATES), "times: must be two or more increasing"),
        (lambda: plan_program(geometry, [home, home], [1.0, 0.5], RATES), "times: must be two or more increasing"),
        (lambda: plan_program(geometry, [home, home], [0.0, 0.0], RATES), "times: must be two or more increasing"),
        (lambda: plan_program(geometry, [home, home], [0.0, 1.0, 2.0], RATES), "times: must be two or more increasing"),
        (lambda: plan_program(geometry, [home, home], [0.0, math.nan], RATES), "times: must be two or more increasing"),
        (lambda: StrutRates(0.2, 1.0, 0.0), "jerk: must be positive"),
        (lambda: StrutRates.of(geometry, 250.0, 1.1), "share: must lie in"),
        (lambda: StrutRates.of(geometry, 250.0, 0.0), "share: must lie in"),
        (lambda: StrutRates.of(geometry, math.nan), "rate: must be finite and positive"),
        (lambda: move(geometry, home, home, math.inf), "rate: must be finite and positive, Hz"),
        (lambda: move(geometry, home, home, 250.0, 0.0), "feed: must be positive, m/s"),
        (lambda: motion.sample(0.0), "rate: must be finite and positive"),
        (lambda: motion.stop(0.1, -250.0), "rate: must be finite and positive"),
        (lambda: motion.stop(-0.1, 250.0), "now: must lie in the motion's"),
        (lambda: replace(geometry.limits, jerk=-1.0), "limits.jerk: must be finite and not negative"),
    ):
        with pytest.raises(GeometryError, match=words):
            refused()


@pytest.mark.parametrize("name", ["paper", "inches", *LONG])
def test_a_program_keeps_every_limit_passes_its_poses_and_is_never_ahead(name: str, tmp_path: Path) -> None:
    """The program is a random walk with some times too short for the struts; the truth is differentiation here."""
    geometry, rate = machine_of(name, tmp_path), 1000.0
    poses = random_targets(geometry, 23, 6)
    times = np.cumsum([0.0, *np.random.default_rng(24).uniform(0.02, 2.0, len(poses) - 1)])
    motion = plan_program(geometry, poses, times.tolist(), RATES)
    assert motion.duration >= times[-1]
    path = motion.sample(rate)
    assert max(shares(geometry, (path.positions, path.rotations), rate, RATES)) <= 1.0 + 1e-3
    assert np.array_equal(path.positions[[0, -1]], [poses[0].position, poses[-1].position])
    step = np.linalg.norm(np.diff(path.positions, axis=0), axis=1).max()
    for pose, earliest in zip(poses, times, strict=True):
        after = path.positions[max(0, int(earliest * rate) - 1) :]
        assert np.linalg.norm(after - pose.position, axis=1).min() <= step
    stop = motion.stop(motion.duration / 2.0, rate)
    assert len(stop) <= len(path) / 2 + 1


def test_a_slow_program_keeps_its_own_time() -> None:
    """A sine of 0.1 mm over 2 s takes only longer by its acceleration at the start and its braking at the end."""
    geometry, (home, *_) = paper_geometry(), random_targets(paper_geometry(), 1, 2)
    times = np.linspace(0.0, 2.0, 41)
    poses = [
        Pose(home.position + 1e-4 * math.sin(math.pi * t) * np.array([0.0, 0.0, 1.0]), home.rotation) for t in times
    ]
    assert 2.0 <= plan_program(geometry, poses, times.tolist(), RATES).duration < 2.2


PAPER = paper_geometry()
OFFSET = replace(
    PAPER,
    tool=Pose.from_angles([0.01, -0.02, -0.12], np.deg2rad([5.0, -8.0, 30.0])),
    work=Pose.from_angles([0.05, 0.03, 0.2], np.deg2rad([0.0, 3.0, 45.0])),
)
MACHINES = pytest.mark.parametrize("geometry", [PAPER, OFFSET], ids=["plain", "tool and work offset"])


def with_start(start: Pose, path: trajectory.Path) -> tuple[np.ndarray, np.ndarray]:
    return np.vstack([start.position, path.positions]), np.concatenate([start.rotation[None], path.rotations])


def tool_targets(geometry: HexapodGeometry) -> list[Pose]:
    """Return Table 1 of Song et al. as tool poses."""
    return [geometry.work.inverse() @ pose @ geometry.tool for pose in table_poses()]


@MACHINES
@pytest.mark.parametrize(("rate", "acceleration"), [(20.0, 0.0), (250.0, 0.0), (1000.0, 0.0), (250.0, 1.0), (1e3, 1.0)])
def test_moves_keep_steps_speeds_and_accelerations(geometry: HexapodGeometry, rate: float, acceleration: float) -> None:
    """By finite differences: at 20 Hz the step of 2 mm limits, above 125 Hz the speed, or the acceleration if limited.

    Moves use 0.8 of a limit, less the rounding of the number of poses, and a third of the acceleration in short
    moves."""
    limits = replace(geometry.limits, acceleration=acceleration)
    for start, end in pairwise(tool_targets(geometry)):
        path = move(replace(geometry, limits=limits), start, end, rate)
        sent = lengths(geometry, *with_start(start, path))
        share = np.abs(np.diff(sent, axis=0)).max() / min(limits.step, limits.speed / rate)
        assert share <= 0.8 * (1.0 + 1e-3)
        if acceleration:
            assert 0.25 < np.abs(np.diff(sent, 2, axis=0)).max() * rate**2 / acceleration <= 0.8 * (1.0 + 1e-3)
        else:
            assert share >= 0.5


@MACHINES
def test_a_move_is_straight_and_turns_along_the_shortest_arc(geometry: HexapodGeometry) -> None:
    """The truth is scipy's Slerp at the share of the straight line; the end pose is exact."""
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
    slow = with_start(start, move(geometry, start, end, 250.0, feed=0.02))[0]
    fastest = 250.0 * np.linalg.norm(np.diff(slow, axis=0), axis=1).max()
    assert 0.99 * 0.02 <= fastest <= 0.02 * (1.0 + 1e-9)


def figure_of_eight(count: int = 400) -> np.ndarray:
    """Return a path that crosses itself and leaves its plane, (count, 3), m."""
    t = np.linspace(0.0, 2.0 * np.pi, count)
    return np.stack([0.02 * np.sin(t), 0.01 * np.sin(2.0 * t), 0.4 + 0.003 * np.cos(t)], axis=1)


def test_the_foot_of_a_point_is_the_nearest_place_of_what_was_just_commanded() -> None:
    """The truth is a dense sampling of the last legs; where the path crosses itself only this branch counts."""
    corners, rng = figure_of_eight(), np.random.default_rng(4)
    sent = rng.integers(0, len(corners) + 3, 50)
    newest = np.clip(sent, 1, len(corners) - 1)
    behind = np.maximum(newest - rng.integers(0, TRACK_WINDOW - 5, 50), 0)
    points = corners[behind] + rng.uniform(-1e-4, 1e-4, (50, 3))
    feet = feet_on(corners, points, sent)
    for point, last, foot in zip(points, newest, feet, strict=True):
        near = corners[max(0, last - TRACK_WINDOW) : last + 1]
        legs = [near[i] + np.linspace(0.0, 1.0, 2001)[:, None] * (near[i + 1] - near[i]) for i in range(len(near) - 1)]
        nearest = np.linalg.norm(np.concatenate(legs) - point, axis=1).min()
        assert np.linalg.norm(foot - point) == pytest.approx(nearest, rel=1e-4, abs=1e-9)


def test_a_track_is_moved_back_onto_its_path() -> None:
    """A tool that is late on a path displaced by 150 µm and 0.3 mrad: the known motion maps the track onto the path."""
    corners = figure_of_eight()
    sent = np.arange(10, len(corners))
    turn, shift = Rotation.from_rotvec([1e-4, -2e-4, 2e-4]), np.array([1e-4, -1e-4, 5e-5])
    late = corners[sent - 4]
    motion = motion_onto(corners, turn.apply(late) + shift, sent)
    assert motion is not None
    back = motion.position + (turn.apply(late) + shift) @ motion.rotation.T
    assert np.linalg.norm(back - feet_on(corners, back, sent), axis=1).max() < 1e-7
    assert motion_onto(corners[:, [0, 0, 0]], late[:, [0, 0, 0]], sent) is None
