"""LinuxCNC's own compiled kinematics, where they are installed, against ours: two independent truths."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.convergence import convergence, honesty
from benchmarks.genhexkins import Genhexkins, NotHere, emc_poses, si_poses
from benchmarks.poses import make_poses, near_poses


@pytest.fixture
def genhexkins():
    try:
        return Genhexkins(make_poses(1).structure)
    except NotHere as reason:
        pytest.skip(str(reason))


def test_lengths_are_linuxcncs(genhexkins):
    """Both add some ten products of lengths up to 1 m: 1e-15 m each."""
    poses = make_poses(200)
    lengths, codes = np.empty((200, 6)), np.empty(200, np.int32)
    genhexkins.inverse(emc_poses(poses.positions, poses.rotations), lengths, codes)
    assert not codes.any()
    np.testing.assert_allclose(lengths * 1e-3, poses.lengths, rtol=0.0, atol=1e-14)


def test_poses_are_linuxcncs(genhexkins):
    """It ends when the struts are right to 1e-12 m, and leaves about as much."""
    poses = near_poses(200)
    home = emc_poses(poses.home.position[None], poses.home.rotation[None])
    codes, found = genhexkins.solved(poses.lengths, np.repeat(home, 200, axis=0))
    assert not codes.any()
    positions, rotations = si_poses(found)
    np.testing.assert_allclose(positions, poses.positions, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(rotations, poses.rotations, rtol=0.0, atol=1e-10)


def test_ours_converges_at_yaws_where_theirs_cannot(genhexkins):
    """From 60° on the step error of genhexkins is 2·sin(ψ/2) ≥ 1 times the last one."""
    for row in convergence(np.array([0.0, 60.0, 70.0, 80.0]), 50):
        assert row.ours == row.poses
        assert row.theirs == (row.poses if row.yaw_deg == 0.0 else 0)


def test_nothing_that_is_not_so_is_called_solved(genhexkins):
    worth = honesty(2000)
    assert worth.solved[0] > 500
    assert worth.not_finite[0] == worth.open_loops[0] == worth.other_mode[0] == 0
