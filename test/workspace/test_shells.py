"""Shells of the workspace: on the boundary, closed, and honest about what rays from one point do not see."""

from __future__ import annotations

import numpy as np
import pytest
from test_reach import LEVEL, UNIT_FILE, tilted, unit

from hexapod_comp.core import Status
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.workspace.reach import Examiner, Reach, reach
from hexapod_comp.workspace.shells import Shell, shell


def unit_reach() -> Reach:
    return reach(unit(), cells=24)


def small_shell() -> Shell:
    return shell(unit_reach(), 19, 36)


def within(found: Shell, points: np.ndarray) -> np.ndarray:
    return Examiner(found.geometry).findings(points.reshape(-1, 3), found.rotation[None])[0] == Status.OK


def test_a_shell_is_the_boundary():
    """Truth: the limits themselves, a micrometre before the shell and a micrometre beyond it."""
    for rotation in (LEVEL, tilted(unit(), 6.0, -3.0, 5.0)):
        found = shell(reach(unit(), rotation, 24), 19, 36)
        away = found.points - found.centre
        step = 1e-6 * away / np.linalg.norm(away, axis=-1, keepdims=True)
        assert within(found, found.points - step).all()
        assert not within(found, found.points + step).any()
        beyond, _ = Examiner(unit()).findings((found.points + step).reshape(-1, 3), rotation[None])
        assert (beyond == found.findings.ravel()).mean() > 0.99  # at an edge of two limits either may come first


def test_inner_shells_are_within():
    """Truth: the limits; a share of the way from the centre is that share of the way."""
    found = small_shell()
    for fraction in (0.05, 0.4, 0.7, 0.999):
        points = found.scaled(fraction)
        assert within(found, points).all()
        ratio = np.linalg.norm(points - found.centre, axis=-1) / np.linalg.norm(found.points - found.centre, axis=-1)
        np.testing.assert_allclose(ratio, fraction, rtol=1e-9)


def test_the_mesh_is_closed():
    """Truth: a surface without a hole: poles are points, the last azimuth is the first."""
    points = small_shell().points
    assert np.array_equal(points[:, 0], points[:, -1])
    for pole in (points[0], points[-1]):
        assert (pole == pole[0]).all()
    assert points[0, 0, 2] < points[:, :, 2].mean() < points[-1, 0, 2]


def test_poses_of_a_shell_put_the_tool_there():
    """Truth: the tool is 25 mm above the platform, along the platform's z axis (the file)."""
    rotation = tilted(unit(), 6.0)
    found = shell(reach(unit(), rotation, 16), 7, 12)
    positions, rotations = found.platform_poses(0.7)
    assert rotations.shape == (7 * 13, 3, 3)
    np.testing.assert_allclose(positions + 0.025 * rotations[:, :, 2], found.scaled(0.7).reshape(-1, 3), atol=1e-15)
    np.testing.assert_allclose(rotations, np.broadcast_to(rotation, rotations.shape), atol=1e-15)


def test_the_units_shell_holds_its_reach():
    """Truth: the volume by grid columns, which assumes nothing about the shape. The mesh's faces cut off what
    bulges beyond them, less the finer it is."""
    found = unit_reach()
    coarse, fine = shell(found, 19, 36), shell(found, 61, 120)
    assert not fine.folded.any()
    assert 0.97 < coarse.coverage < fine.coverage
    assert fine.coverage == pytest.approx(1.0, abs=0.01)


def test_what_rays_do_not_see_is_said():
    """Truth: Jugglebot without joint cones reaches around its struts; between the shell and a later point on the
    same ray that is within reach lies a point that is not, by the limits themselves."""
    geometry = load_geometry(UNIT_FILE.with_name("jugglebot.yaml"))
    found = shell(reach(geometry, cells=24), 19, 36)
    assert 0 < found.folded.sum() < found.folded.size
    assert found.coverage < 0.99
    rays = found.points - found.centre
    beyond = found.centre + np.linspace(1.001, 4.0, 400)[:, None, None, None] * rays
    again = within(found, beyond).reshape(400, *found.folded.shape).any(axis=0)
    assert again[found.folded].all()


# Refused.
