"""The box that a machine reaches: judged by the tests' own strut lengths, and by being nearly as large as can be."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import Errors, commands, machines

from hexapod_comp.errors import GeometryError
from hexapod_comp.machine.box import PROPORTIONS, SHARE, box_of_platforms, level_box
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.pose import Pose, rotation_from_angles


@pytest.fixture(params=list(machines()))
def machine(request: pytest.FixtureRequest, tmp_path: Path) -> tuple:
    known = machines()[request.param]
    return known, load_geometry(known.write(tmp_path / "machine.yaml"))


def tips(box: np.ndarray, steps: int = 4) -> np.ndarray:
    """Return a grid of places of a box, its corners among them, (n, 3)."""
    return np.array(list(product(*(np.linspace(low, high, steps) for low, high in box.T))))


def angles_to_home(known, places: np.ndarray) -> np.ndarray:
    """Return the angle of each strut to where it points at home, in base, degrees (n, 6)."""
    at_home = np.array(known.home) + known.platform - known.base
    there = known.platforms(places)[:, None] + known.platform @ known.level().T - known.base
    cosines = (there * at_home).sum(axis=2) / np.linalg.norm(there, axis=2) / np.linalg.norm(at_home, axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))


def test_a_level_tool_gets_everywhere(machine) -> None:
    known, geometry = machine
    box = level_box(geometry)
    places = tips(box)
    turned = np.tile(known.level(), (len(places), 1, 1))
    lengths = commands(known, Errors.none(), known.platforms(places), turned)
    assert ((lengths > known.stroke[0]) & (lengths < known.stroke[1])).all()
    assert (angles_to_home(known, places) < 70.0).all()
    home_tip = known.tips(np.array([known.home]), np.eye(3)[None])[0]
    np.testing.assert_allclose(box.mean(axis=0), home_tip, atol=1e-9)
    sides = np.ptp(box, axis=0)
    np.testing.assert_allclose(sides / sides[0], PROPORTIONS, atol=2e-3)


def test_no_much_larger_one_does(machine) -> None:
    """A box that is 1/0.8 as large, and 1 % more, has a corner or a place that the machine must not take."""
    _, geometry = machine
    box = level_box(geometry)
    centre = box.mean(axis=0)
    larger = centre + (box - centre) * 1.01 / SHARE

    def taken(place: np.ndarray) -> bool:
        pose = geometry.platform_pose(Pose(place, np.eye(3)))
        lengths = np.linalg.norm(
            pose.position + geometry.platform_joints @ pose.rotation.T - geometry.base_joints, axis=1
        )
        return geometry.refusal(pose.position, pose.rotation, lengths) is None

    assert not all(taken(place) for place in tips(larger, 5))


def test_platform_box(machine) -> None:
    known, geometry = machine
    box = level_box(geometry)
    platforms = known.platforms(tips(box, 2))
    np.testing.assert_allclose(
        box_of_platforms(geometry, box), [platforms.min(axis=0), platforms.max(axis=0)], atol=1e-12
    )


def test_frames_that_let_no_level_tool_be_at_home_are_named(tmp_path: Path) -> None:
    geometry: HexapodGeometry = load_geometry("paper")
    upside_down = replace(geometry, tool=Pose(np.zeros(3), rotation_from_angles(np.radians([180.0, 0.0, 0.0]))))
    with pytest.raises(GeometryError, match="work, tool: are turned so that a tool parallel to the work frame cannot"):
        level_box(upside_down)
