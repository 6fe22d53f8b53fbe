"""Where a machine can go: against Pythagoras, plain NumPy with every limit on its own, and random points."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers import segment_distance
from strategies import PAPER_FILE, paper_geometry

from hexapod_comp.core import Status
from hexapod_comp.core.batch import segment_distance as closest
from hexapod_comp.errors import GeometryError
from hexapod_comp.machine import kinematics
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.pose import Pose
from hexapod_comp.workspace.reach import (
    FINDINGS,
    Boundary,
    Examiner,
    Reach,
    _crossings,
    _grid,
    home_orientation,
    orientations,
    possible_box,
    reach,
    reaches,
)

UNIT_FILE = PAPER_FILE.with_name("positioning_unit.yaml")
LEVEL = np.eye(3)


def unit() -> HexapodGeometry:
    return load_geometry(UNIT_FILE)


def limited(geometry: HexapodGeometry, **limits: object) -> HexapodGeometry:
    """Return a machine with other limits and its other parts as they are."""
    return rebuilt(geometry, limits=replace(geometry.limits, **limits))


def rebuilt(geometry: HexapodGeometry, **parts: object) -> HexapodGeometry:
    kept = ("name", "base_joints", "platform_joints", "home", "limits", "tool", "work")
    return HexapodGeometry(**{**{name: getattr(geometry, name) for name in kept}, **parts})


def tilted(geometry: HexapodGeometry, alpha: float = 0.0, beta: float = 0.0, gamma: float = 0.0) -> np.ndarray:
    return turned_by(geometry, [alpha], [beta], [gamma])[0]


def turned_by(geometry: HexapodGeometry, *degrees: list[float]) -> np.ndarray:
    """Return all combinations of angles about x, y and z."""
    return orientations(geometry, [np.deg2rad(angles) for angles in degrees])


def ends(geometry: HexapodGeometry, tips: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the platform joints in base, (N, 6, 3), by the definitions of tool and work frame."""
    work, tool = geometry.work, geometry.tool
    turned = work.rotation @ rotation @ tool.rotation.T
    origin = work.position + tips @ work.rotation.T - turned @ tool.position
    return origin[:, None] + geometry.platform_joints @ turned.T


def quantities(geometry: HexapodGeometry, tip: np.ndarray, rotation: np.ndarray) -> dict[int, np.ndarray]:
    """Return margin of every limit at one pose, in plain NumPy, by finding; negative beyond it."""
    limits = geometry.limits
    end = ends(geometry, tip[None], rotation)[0]
    struts = end - geometry.base_joints
    lengths = np.linalg.norm(struts, axis=1)
    along = struts / lengths[:, None]
    turned = geometry.work.rotation @ rotation @ geometry.tool.rotation.T
    at_base = np.arccos(np.clip((along * geometry.base_cone_axes).sum(axis=1), -1, 1))
    at_platform = np.arccos(np.clip((along @ turned * geometry.platform_cone_axes).sum(axis=1), -1, 1))
    centre = end - geometry.platform_joints @ turned.T
    jacobian = np.hstack([along, np.cross(end - centre, along) / geometry.characteristic_length])
    condition = np.linalg.norm(jacobian) * np.linalg.norm(np.linalg.inv(jacobian)) / 6.0
    apart = [
        segment_distance(geometry.base_joints[i], end[i], geometry.base_joints[j], end[j])
        for i, j in combinations(range(6), 2)
        if np.linalg.norm(geometry.platform_joints[i] - geometry.platform_joints[j]) > 1e-6
    ]
    return {
        Status.STROKE_SHORT: lengths - limits.stroke[:, 0],
        Status.STROKE_LONG: limits.stroke[:, 1] - lengths,
        Status.BASE_CONE: limits.base_cone - at_base,
        Status.PLATFORM_CONE: limits.platform_cone - at_platform,
        Status.CLEARANCE: np.array(apart) - limits.clearance,
        Status.CONDITION: np.array([limits.condition - condition]),
    }


# Single poses.


def test_how_low_and_how_high_the_unit_goes():
    """Truth: Pythagoras. On the axis each strut spans the same way across, d² = r² + R² − 2rR·cos 25°, so that
    the platform is at √(L² − d²); the tool 25 mm above it. The file gives joints to half a micrometre."""
    across = 0.15**2 + 0.06**2 - 2.0 * 0.15 * 0.06 * np.cos(np.deg2rad(25.0))
    low, high = np.sqrt(0.158**2 - across) + 0.025, np.sqrt(0.218**2 - across) + 0.025
    start = np.array([[0.0, 0.0, 0.185]] * 2)
    end = np.array([[0.0, 0.0, 0.10], [0.0, 0.0, 0.30]])
    points, findings, _ = Examiner(unit()).boundary(start, end, LEVEL)
    np.testing.assert_allclose(points[:, 2], [low, high], atol=1e-6)
    assert findings.tolist() == [Status.STROKE_SHORT, Status.STROKE_LONG]


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [
        pytest.param([[0, 0, 0], [1, 0, 0]], [[0.5, -1, 0.3], [0.5, 1, 0.3]], 0.3, id="crossing"),
        pytest.param([[0, 0, 0], [1, 0, 0]], [[2, -1, 0.3], [2, 1, 0.3]], np.hypot(1, 0.3), id="end to inside"),
        pytest.param([[0, 0, 0], [1, 0, 0]], [[4, 4, 0], [4, 5, 0]], 5.0, id="end to end"),
        pytest.param([[0, 0, 0], [1, 0, 0]], [[0.2, 0.7, 0], [3, 0.7, 0]], 0.7, id="parallel, side by side"),
        pytest.param([[0, 0, 0], [1, 0, 0]], [[3, 0, 0], [2, 0, 0]], 1.0, id="on one line"),
        pytest.param([[0, 0, 0], [1, 1, 1]], [[1, 0, 0], [0, 1, 1]], 0.0, id="through each other"),
    ],
)
def test_distance_of_two_segments(first, second, distance):
    """Truth: read off the coordinates."""
    first, second = np.array(first, dtype=float), np.array(second, dtype=float)
    assert closest(*first, *second) == pytest.approx(distance, abs=1e-15)
    assert closest(*second[::-1], *first) == pytest.approx(distance, abs=1e-15)


def test_poses_of_their_own_orientation(monkeypatch):
    """Truth: the same poses asked one by one; and the same on one thread and on three, more than one slice."""
    monkeypatch.setattr(kinematics, "ALONE", -1.0)  # others help from the second slice on
    geometry, rng = unit(), np.random.default_rng(2)
    rotations = turned_by(geometry, [-8, 0, 8], [-8, 0, 8], [-10, 0, 10])[rng.integers(0, 27, 5000)]
    tips = rng.uniform([-0.09, -0.09, 0.14], [0.09, 0.09, 0.23], (5000, 3))
    examiner = Examiner(geometry)
    found, struts = examiner.findings(tips, rotations, threads=3)
    assert len(np.unique(found)) >= 4
    for n in range(0, 5000, 97):
        alone = examiner.findings(tips[n : n + 1], rotations[n : n + 1])
        assert (alone[0][0], *alone[1][0]) == (found[n], *struts[n])
    again = examiner.findings(tips, rotations, threads=1)
    assert np.array_equal(again[0], found)
    assert np.array_equal(again[1], struts)


def test_work_and_tool_frames_only_rename_poses():
    """Truth: a rigid motion of the frame in which poses are told changes no pose."""
    geometry, rng = unit(), np.random.default_rng(3)
    work = Pose.from_angles([0.1, -0.2, 0.05], [0.3, -0.2, 1.0])
    moved = rebuilt(geometry, work=work)
    tips = rng.uniform([-0.09, -0.09, 0.14], [0.09, 0.09, 0.23], (2000, 3))
    told = (tips - work.position) @ work.rotation
    expected, _ = Examiner(geometry).findings(tips, LEVEL[None])
    found, _ = Examiner(moved).findings(told, work.rotation.T[None])
    assert np.array_equal(found, expected)
    np.testing.assert_allclose(home_orientation(moved), work.rotation.T, atol=1e-15)
    assert reach(moved, cells=24).volume == pytest.approx(reach(geometry, cells=24).volume, rel=0.02)


# The reach as a whole.


@pytest.mark.parametrize(
    ("make", "limiting"),
    [
        pytest.param(lambda: (unit(), LEVEL), {1, 2, 3}, id="unit"),
        pytest.param(lambda: (unit(), tilted(unit(), 6, -3, 4)), {1, 2, 3}, id="unit tilted"),
        pytest.param(lambda: (limited(paper_geometry(), clearance=0.2), LEVEL), {Status.CLEARANCE}, id="clearance"),
        pytest.param(lambda: (limited(paper_geometry(), condition=1.6), LEVEL), {Status.CONDITION}, id="condition"),
    ],
)
def test_at_the_boundary_the_named_limit_is_reached_and_no_other_broken(make, limiting):
    """Truth: every limit computed on its own in plain NumPy. The boundary is bisected to 10⁻⁹ m; cones and
    condition change by less than 100 per metre there. A clearance found by least squares is good to 10⁻⁹ m."""
    geometry, rotation = make()
    found = reach(geometry, rotation, cells=10)
    assert limiting <= set(found.boundary.findings.tolist())
    for tip, finding, struts in zip(
        found.boundary.positions, found.boundary.findings, found.boundary.struts, strict=True
    ):
        margins = quantities(geometry, tip, rotation)
        assert all(margin.min() > -1e-7 for margin in margins.values())
        of = margins[int(finding)]
        at = of[struts[0]] if len(of) == 6 else of.min()
        assert abs(at) < 1e-6


def test_volume_of_the_unit():
    """Truth: 100,000 random points judged in plain NumPy by stroke and cones; four standard errors, and the half
    per cent that the grid may be off."""
    geometry = unit()
    found = reach(geometry, cells=32)
    low, high = found.box + np.array([[-1e-3], [1e-3]])
    tips = np.random.default_rng(5).uniform(low, high, (100_000, 3))
    struts = ends(geometry, tips, LEVEL) - geometry.base_joints
    lengths = np.linalg.norm(struts, axis=2)
    cosines = (struts * geometry.base_cone_axes).sum(axis=2) / lengths  # level: the same at both ends
    within = (lengths >= 0.158) & (lengths <= 0.218) & (cosines >= np.cos(np.deg2rad(18.0)))
    share, whole = within.all(axis=1).mean(), np.prod(high - low)
    error = np.sqrt(share * (1.0 - share) / len(tips))
    assert found.volume == pytest.approx(share * whole, abs=(4.0 * error + 0.005 * share) * whole)
    assert np.ptp(found.volumes) < 0.02 * found.volume


class Ball(Examiner):
    """A machine that reaches a ball of 80 mm about a point, or two such balls."""

    def __init__(self, *centres: tuple[float, float, float]) -> None:
        self.geometry, self.centres = unit(), np.array(centres)

    def findings(self, positions, rotations, threads=None):
        far = np.linalg.norm(positions[:, None] - self.centres, axis=2).min(axis=1) > 0.08
        return np.where(far, Status.STROKE_LONG, 0).astype(np.int8), np.full((len(far), 2), -1, np.int8)


def ball_reach(*centres: tuple[float, float, float]) -> Reach:
    ball = Ball(*centres)
    box = np.array([ball.centres.min(axis=0) - 0.1, ball.centres.max(axis=0) + 0.1])
    axes, findings = _grid(ball, LEVEL, box, 41)
    return Reach(ball.geometry, LEVEL, axes, findings, _crossings(ball, LEVEL, axes, findings))


def test_volume_and_box_of_a_ball():
    """Truth: 4/3·π·r³; the columns' error falls with the 1.5th power of the step: below 0.5 % at r/16."""
    found = ball_reach((0.0, 0.0, 0.3))
    np.testing.assert_allclose(found.volumes, 4.0 / 3.0 * np.pi * 0.08**3, rtol=5e-3)
    np.testing.assert_allclose(found.box, [[-0.08, -0.08, 0.22], [0.08, 0.08, 0.38]], atol=2e-4)
    assert found.parts == 1
    regions = found.regions()
    assert set(regions) == {"top", "bottom", *(f"side {k}…{k + 60}°" for k in range(0, 360, 60))}
    assert all(shares == {FINDINGS[Status.STROKE_LONG]: 1.0} for shares in regions.values())


def test_shares_and_regions():
    """Truth: counted by hand: two faces above, one below, one on the side at 200°."""
    cube = (np.array([-1.0, 1.0]),) * 3
    positions = np.array([[0, 0, 1], [0, 0.1, 1], [0, 0, -1], [np.cos(3.49), np.sin(3.49), 0]])
    boundary = Boundary(positions, np.array([1, 2, 2, 3]), np.full((4, 2), -1), np.array([2, 2, 2, 0]), np.ones(4))

    class Centred(Reach):
        centre = np.zeros(3)

    found = Centred(unit(), LEVEL, cube, np.zeros((2, 2, 2), np.int8), boundary)
    assert found.shares() == {FINDINGS[2]: 0.5, FINDINGS[1]: 0.25, FINDINGS[3]: 0.25}
    assert found.regions() == {
        "top": {FINDINGS[1]: 0.5, FINDINGS[2]: 0.5},
        "bottom": {FINDINGS[2]: 1.0},
        "side 180…240°": {FINDINGS[3]: 1.0},
    }


@pytest.mark.parametrize("name", ["positioning_unit", "paper", "jugglebot"])
def test_the_grid_holds_the_whole_reach(name):
    """Truth: nothing is within reach on the grid's outermost points, nor beyond the box that cannot be left,
    of which a wide grid sees that it loses nothing."""
    geometry = load_geometry(PAPER_FILE.with_name(f"{name}.yaml"))
    found = reach(geometry, cells=20)
    for axis in range(3):
        assert not found.within.take([0, -1], axis).any()
    box = possible_box(geometry, found.rotation)
    assert (box[0] <= found.box[0]).all()
    assert (found.box[1] <= box[1]).all()
    tips = np.random.default_rng(6).uniform(box[0] - 0.05, box[1] + 0.05, (50_000, 3))
    inside = Examiner(geometry).findings(tips, found.rotation[None])[0] == Status.OK
    margin = found.spacing
    assert inside.any()
    assert (tips[inside] > found.box[0] - margin).all()
    assert (tips[inside] < found.box[1] + margin).all()


def test_poses_to_study():
    """Truth: they are within the limits, at the asked orientation, and as many as the grid has within."""
    geometry = unit()
    rotations = turned_by(geometry, [0, 8], [0], [0])
    level, turned = reaches(geometry, rotations, cells=16)
    assert turned.volume < level.volume
    positions, of_platform = turned.platform_poses()
    assert len(positions) == turned.within.sum() == len(turned.points())
    np.testing.assert_allclose(of_platform[0], rotations[1], atol=1e-15)
    np.testing.assert_allclose(positions + of_platform @ [0.0, 0.0, 0.025], turned.points(), atol=1e-15)


# Refused.


def test_an_empty_workspace_says_where_and_why():
    with pytest.raises(GeometryError, match=r"empty at the orientation \(0, 0, 80\)°.*none is within.*stroke"):
        reach(unit(), tilted(unit(), gamma=80.0))
    with pytest.raises(GeometryError, match=r"empty at the orientation \(70, 0, 0\)°"):
        reaches(unit(), turned_by(unit(), [0, 70], [0], [0]), cells=8)


def test_no_point_near_enough_to_all_base_joints():
    """Truth: turned by 180° about z, base joint and platform joint of a strut are on opposite sides: each strut's
    ball is about a point some 260 mm from the axis, and 250 mm do not reach across."""
    geometry = limited(unit(), stroke=np.tile([0.187, 0.19], (6, 1)))
    with pytest.raises(GeometryError, match="no point is near enough"):
        possible_box(geometry, tilted(geometry, gamma=180.0))
