"""Readings in one form: lines recognised, directions of motion, and w against poses really displaced."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from strategies import paper_geometry

from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.measurements.readings import AXES, BACKWARD, CHANNELS, FORWARD, UNKNOWN, FileLine, Reading
from hexapod_comp.measurements.runs import assemble
from hexapod_comp.pose import Pose, attitude_error


def geometry_with(work: Pose | None = None, tool: Pose | None = None) -> HexapodGeometry:
    """Return the paper's machine with a work frame and a tool."""
    paper = paper_geometry()
    frames = {"work": work or Pose.identity(), "tool": tool or Pose.identity()}
    return HexapodGeometry("paper", paper.base_joints, paper.platform_joints, paper.home, paper.limits, **frames)


def line(start: list[float], stop: list[float], count: int = 5, direction: int = FORWARD) -> list[Reading]:
    """Return linear readings on a line, m."""
    points = np.linspace(start, stop, count).round(9)
    return [
        Reading("line", 1, direction, Pose(p, np.eye(3)), "linear", 0.0, source=FileLine("f", n + 2))
        for n, p in enumerate(points)
    ]


@pytest.mark.parametrize(
    ("start", "stop", "axis", "base_axis"),
    [
        ([-0.1, 0.0, 0.4], [0.1, 0.0, 0.4], [1, 0, 0], 0),
        ([0.1, 0.0, 0.4], [-0.1, 0.0, 0.4], [1, 0, 0], 0),  # measured from the far end first
        ([0.0, 0.0, 0.5], [0.0, 0.0, 0.4], [0, 0, 1], 2),
        ([0.1, 0.0, 0.5], [-0.1, 0.1, 0.4], [2 / 3**0.5 / 2**0.5, -1 / 6**0.5, 1 / 6**0.5], None),
        ([0.0, 0.1, 0.5], [0.0, -0.1, 0.4], [0, 2 / 5**0.5, 1 / 5**0.5], None),
    ],
)
def test_forward_is_along_the_first_axis_that_moves(start, stop, axis, base_axis) -> None:
    run = assemble(paper_geometry(), line(start, stop)).runs[0]
    np.testing.assert_allclose(run.axis, axis, atol=1e-12)
    assert run.base_axis == base_axis
    assert run.is_line


def test_along_counts_from_the_first_point() -> None:
    found = assemble(paper_geometry(), line([0.1, 0.0, 0.4], [-0.1, 0.0, 0.4], 3, BACKWARD))
    np.testing.assert_allclose(found.along(), [0.0, -0.1, -0.2], atol=1e-15)


def test_w_is_what_a_displaced_pose_shows() -> None:
    """Truth: the probe's place and the tool's attitude before and after a small displacement, in the work frame.

    Rotations compose to first order only, so 1e-6 rad leave up to 1e-12; measured 2e-13.
    """
    work = Pose.from_angles([0.02, -0.01, 0.03], np.deg2rad([5.0, -8.0, 30.0]))
    tool = Pose.from_angles([0.01, 0.02, -0.05], np.deg2rad([4.0, 3.0, -20.0]))
    geometry = geometry_with(work, tool)
    pose = work.inverse() @ Pose([0.01, -0.02, 0.42], np.eye(3)) @ tool
    channels = [c for c in CHANNELS if c.startswith(("position", "attitude"))]
    found = assemble(geometry, [Reading("p", 1, UNKNOWN, pose, c, 0.0) for c in channels])
    e = 1e-6 * np.array([3.0, -2.0, 1.0, 0.4, -0.7, 0.5])
    platform = found.stations.pose(0)
    rotation = Rotation.from_rotvec(e[3:]).as_matrix() @ platform.rotation
    point = platform.position + platform.rotation @ found.probe + e[:3]  # e displaces the measured point
    moved = work.inverse() @ Pose(point - rotation @ found.probe, rotation) @ tool
    expected = [*(moved.position - pose.position), *attitude_error(moved.rotation, pose.rotation)]
    np.testing.assert_allclose(found.directions() @ e, expected, rtol=0.0, atol=2e-12)


def test_swapped_directions_are_flagged() -> None:
    there = line([-0.1, 0.0, 0.4], [0.1, 0.0, 0.4], 3, BACKWARD)
    back = line([0.1, 0.0, 0.4], [-0.1, 0.0, 0.4], 3, FORWARD)
    assert "swapped?" in assemble(paper_geometry(), there + back).notes[0]
    right = [r._replace(direction=-r.direction) for r in there + back]
    assert assemble(paper_geometry(), right).notes == ()


def test_select_keeps_what_belongs_together() -> None:
    found = assemble(paper_geometry(), line([-0.1, 0.0, 0.4], [0.1, 0.0, 0.4]))
    some = found.select(np.array([False, True, False, True, False]))
    assert [s.line for s in some.sources] == [3, 5]
    np.testing.assert_array_equal(some.points()[some.station][:, 0], [-0.05, 0.05])
    assert AXES == ("x", "y", "z")
