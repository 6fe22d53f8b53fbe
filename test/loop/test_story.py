"""The demonstration: a machine calibrates itself, and what it says of warmth and of a knock is what was done to it.

The machines come from :mod:`foreign_machines`; what a model leaves is judged at points that nothing was fitted to.
"""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import long_test

from hexapod_comp import cli
from hexapod_comp.compensation.checks import check
from hexapod_comp.loop import story
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.pose import Pose, rotation_from_angles
from hexapod_comp.workspace.reach import machine_box


def test_the_box_is_about_this_machines_home(tmp_path: Path) -> None:
    """Or as near to it as the ends of the machine's own largest box allow."""
    for machine in machines().values():
        geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
        box = story.demo_place(geometry).box
        home = machine.tips(np.array([machine.home]), np.eye(3)[None])[0]
        largest, middle = machine_box(geometry).box, box.mean(axis=0)
        low, high = np.abs(box - largest) < 1e-6  # where the boxes end together
        assert (np.isclose(middle, home, atol=1e-9) | (low & (middle > home)) | (high & (middle < home))).all()
        assert ((home >= box[0]) & (home <= box[1])).all()


def test_a_tool_that_cannot_be_level_stays_as_at_home() -> None:
    """A spindle whose frame looks down, in a work frame that looks up: the box's corners are within the limits."""
    paper = load_geometry("paper")
    geometry = replace(paper, tool=Pose([0.0, 0.0, 0.1], rotation_from_angles(np.radians([180.0, 0.0, 0.0]))))
    place = story.demo_place(geometry)
    np.testing.assert_allclose(place.attitude, geometry.tool.rotation, atol=1e-12)
    assert check(geometry, MachineModel("paper"), [Pose(corner, place.attitude) for corner in place.box]).ok


def test_a_warm_machine_has_struts_longer_by_steels_growth() -> None:
    geometry = load_geometry("paper")
    warm = story.warmed(geometry, MachineModel("paper"), 5.0).struts
    home = np.linalg.norm(
        geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T - geometry.base_joints, axis=1
    )
    np.testing.assert_allclose(warm.offset, 57.5e-6 * home, rtol=1e-12)
    np.testing.assert_allclose(warm.pitch, 57.5e-6)


@long_test
@pytest.mark.timeout(300)
def test_the_whole_story_on_a_foreign_machine(tmp_path: Path) -> None:
    """Turned tool and work frames, every kind of error that ``random`` has."""
    file = machines()["framed"].write(tmp_path / "machine.yaml")
    words = ["--machine", file, "--truth", "random:5", "--seed", 2, "--pictures", tmp_path / "out"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = cli.main(["demo", "--json", *map(str, words)])
    told = json.loads(out.getvalue())
    assert (code, told["complaints"]) == (0, []), told["chapters"]
    left = {chapter["title"]: chapter["box_rms_m"] for chapter in told["chapters"]}
    titles = ["as built", "calibrated", "warmer by 5 K", "renewed", "strut_6 knocked", "repaired"]
    assert list(left) == titles
    assert max(left[title] for title in titles[1::2]) <= told["promised_m"] <= story.GOAL
    assert left["calibrated"] < 0.1 * left["as built"]
    assert min(left[title] for title in titles[2::2]) > 2.0 * left["calibrated"]
    for chapter in told["chapters"][1::2]:  # sixteen stops scatter by a tenth, and the drives' steps are 0.1 µm
        assert chapter["rms_m"] == pytest.approx(left[chapter["title"]], rel=0.4, abs=0.1e-6)
    assert (tmp_path / "out" / "demo.png").stat().st_size > 20_000
