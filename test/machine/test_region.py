"""The box in which a model was measured: of one point of the platform, in a frame of its own.

Truth: frames by hand, and that more readings cannot show less.
"""

from __future__ import annotations

from dataclasses import replace

import calibration_helpers as small
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation
from strategies import fixed, seeds

from hexapod_comp.calibration.parameters import FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import box_stations
from hexapod_comp.errors import ModelError
from hexapod_comp.machine.region import Region
from hexapod_comp.pose import Pose

SIDES = np.array([[-0.1, -0.05, 0.3], [0.1, 0.05, 0.5]])


def space_of(poses: list[Pose]) -> ParameterSpace:
    return ParameterSpace(small.scattered(small.paper(), poses), FitSettings(blocks=()))


def drawn(rng: np.random.Generator, count: int, half: float, tilt_deg: float) -> list[Pose]:
    middle = np.array([0.0, 0.0, 0.45])
    turns = Rotation.from_rotvec(np.radians(tilt_deg) * rng.uniform(-1.0, 1.0, (count, 3))).as_matrix()
    return [Pose(middle + rng.uniform(-half, half, 3), turn) for turn in turns]


@fixed
@given(seeds)
def test_readings_that_are_added_never_make_it_smaller(seed: int) -> None:
    """Some poses tilted, some level, some all tilted one way: in any order."""
    rng = np.random.default_rng(seed)
    poses = drawn(rng, 4, 0.1, 8.0) + drawn(rng, 4, 0.03, 0.0) + drawn(rng, 3, 0.1, 0.0)
    poses = [poses[n] for n in rng.permutation(len(poses))]
    few, more = (space_of(part).measured for part in (poses[: rng.integers(3, 11)], poses))
    assert few is not None
    assert more is not None
    assert (more.box[0] <= few.box[0]).all()
    assert (more.box[1] >= few.box[1]).all()
    np.testing.assert_array_equal(more.point, few.point)


def test_the_promise_is_made_where_the_model_says_that_it_was_measured() -> None:
    """Poses of the promise, level and tilted, are all inside, and reach within a twentieth of each face."""
    rng = np.random.default_rng(2)
    poses = drawn(rng, 30, 0.05, 5.0)
    geometry = replace(small.paper(), tool=Pose([0.01, 0.0, 0.08], np.eye(3)))
    space = ParameterSpace(small.scattered(geometry, poses), FitSettings(blocks=()))
    region = space.measured
    assert region is not None
    for tilt in (0.0, 0.1):
        stations = box_stations(space, tilt)
        assert stations is not None
        assert region.contains(stations.positions, stations.rotations).all()
    places, _ = geometry.tool_poses(stations.positions, stations.rotations)
    box = region.commanded(geometry)
    assert (np.abs(places.min(axis=0) - box[0]) < 0.05 * np.ptp(box, axis=0)).all()
    assert (np.abs(places.max(axis=0) - box[1]) < 0.05 * np.ptp(box, axis=0)).all()


def test_a_tilted_tool_is_inside_where_its_point_is() -> None:
    """The point is 0.2 m above the platform: tilted by 0.3 rad about x it goes 0.2·sin 0.3 along −y, at the edge."""
    region = Region(SIDES, np.array([0.0, 0.0, 0.2]))
    tilted = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    edge = np.array([0.0, 0.05 + 0.2 * np.sin(0.3), 0.4 - 0.2 * np.cos(0.3)])
    assert region.contains(edge - [0.0, 1e-6, 0.0], tilted)
    assert not region.contains(edge + np.array([0.0, 1e-6, 0.0]), tilted)
    assert not region.contains(edge, np.eye(3))
    many = region.contains(np.array([edge, edge]) - [0.0, 1e-6, 0.0], np.array([tilted, np.eye(3)]))
    np.testing.assert_array_equal(many, [True, False])


def test_the_tools_box_follows_tool_and_work_frame() -> None:
    """Measured 0.1 m below a tip, in base: the tip's box is higher by that. In a frame turned by 90° x and y change."""
    base = Region(SIDES, np.array([0.0, 0.0, 0.05]))
    turned = Pose.from_angles([0.2, 0.0, 0.1], np.radians([0.0, 0.0, 90.0]))
    geometry = replace(small.paper(), tool=Pose([0.0, 0.0, 0.15], np.eye(3)), work=turned)
    low, high = SIDES + np.array([0.0, 0.0, 0.1])
    wanted = np.array([[low[1], 0.2 - high[0], low[2] - 0.1], [high[1], 0.2 - low[0], high[2] - 0.1]])
    np.testing.assert_allclose(base.commanded(geometry), wanted, atol=1e-12)
    of_work = Region.of(SIDES, np.array([0.0, 0.0, 0.15]), turned)
    np.testing.assert_allclose(of_work.commanded(geometry), SIDES, atol=1e-12)
    corners = of_work.poses(SIDES, np.eye(3))
    assert of_work.contains(*corners).all()
    tip = turned.position + turned.rotation @ SIDES[0]
    np.testing.assert_allclose(corners[0][0] + np.array([0.0, 0.0, 0.15]), tip, atol=1e-12)


def test_in_a_frame_turned_askew_all_of_the_tools_box_was_measured() -> None:
    turned = Pose.from_angles([0.0, 0.0, 0.0], np.radians([10.0, -5.0, 30.0]))
    geometry, region = replace(small.paper(), work=turned), Region(SIDES)
    box = region.commanded(geometry)
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
    level = np.tile(np.eye(3), (8, 1, 1))
    assert region.contains(*geometry.platform_poses(corners, level)).all()
    larger = box.mean(axis=0) + 1.01 * (corners - box.mean(axis=0))
    assert not region.contains(*geometry.platform_poses(larger, level)).all()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"box": np.zeros((2, 2))}, "region.box.*lowest.*highest"),
        ({"box": [[0, 0, 1], [1, 1, 0]]}, r"region.box.*\[1.0, 1.0, 0.0\]"),
        ({"box": [[0, 0, 0], [1, 1, np.nan]]}, "region.box.*nan"),
        ({"box": SIDES, "point": [0.0, np.inf, 0.0]}, "region.point.*inf"),
    ],
)
def test_what_is_no_box_is_refused(bad: dict, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Region(**bad)
