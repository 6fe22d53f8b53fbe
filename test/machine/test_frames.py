"""Named tools and work frames of a geometry file: read, used, refused."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign_machines import with_frames

from hexapod_comp.errors import FrameError, InputFileError
from hexapod_comp.machine.geometry import MOST, HexapodGeometry, load_geometry
from hexapod_comp.pose import Pose

EXAMPLE = Path(__file__).resolve().parents[2] / "config" / "example_6_6.yaml"
ROUNDING = 1e-14  # m; a few products of numbers below one


@pytest.mark.parametrize("name", ["framed", "hanging", "inches", "mirror"])
def test_poses_are_those_of_the_tool_and_frame_in_use(name: str, tmp_path: Path) -> None:
    """Truth: the zoo's own frames, multiplied there."""
    machine = with_frames(name)
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    assert (list(geometry.tools), list(geometry.work_frames)) == (
        ["tool", "probe", "stub"],
        ["base", "work", "fixture"],
    )
    rng = np.random.default_rng(4)
    tips = machine.middle + rng.uniform(-0.05, 0.05, (5, 3))
    turns = np.array([Pose.from_angles(np.zeros(3), angles).rotation for angles in rng.uniform(-0.2, 0.2, (5, 3))])
    for tool, work in ((None, None), ("probe", None), (None, "fixture"), ("stub", "fixture"), ("tool", "work")):
        truth, used = machine.using(tool, work), geometry.using(tool, work)
        assert (used.tool_name, used.work_name) == (tool or "tool", work or "work")
        for ours, theirs in zip(used.platform_poses(tips, turns), truth.platform_poses(tips, turns), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=ROUNDING)
    in_base = geometry.using("stub", "base")
    assert np.array_equal(in_base.work.position, np.zeros(3))
    assert in_base.using("tool", "work").tool is geometry.tool


def test_nothing_else_changes_by_a_bit() -> None:
    """Truth: the numbers before. Axes of unit length that were made so again could differ in the last bit."""
    geometry = load_geometry(EXAMPLE)
    other = geometry.using(tool="probe")
    for name in (
        "base_cone_axes",
        "platform_cone_axes",
        "base_axes",
        "platform_axes",
        "kernel_joints",
        "limit_numbers",
    ):
        assert getattr(other, name) is getattr(geometry, name)


def test_a_geometry_with_tools_can_be_copied_replaced_and_sent_elsewhere() -> None:
    geometry = load_geometry(EXAMPLE).using("probe", "fixture")
    for other in (pickle.loads(pickle.dumps(geometry)), copy.deepcopy(geometry), replace(geometry)):
        assert (other.tool_name, other.work_name) == ("probe", "fixture")
        assert list(other.tools) == list(geometry.tools)
    moved = replace(geometry, tool=Pose(np.ones(3), np.eye(3)))
    assert moved.using("tool").using("probe").tool is moved.tool  # the one in use is the one by its name


def test_an_unknown_name_is_refused_with_those_that_there_are() -> None:
    geometry = load_geometry(EXAMPLE)
    with pytest.raises(FrameError, match=r"machine example_6_6 has no tool 'prob'; it has tool, probe$"):
        geometry.using(tool="prob")
    with pytest.raises(FrameError, match=r"no work frame ''; it has base, work, fixture$"):
        geometry.using(work="")


def loaded(content: dict, folder: Path) -> HexapodGeometry:
    (folder / "machine.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return load_geometry(folder / "machine.yaml")


POSE = {"position_mm": [0, 0, 10]}


@pytest.mark.parametrize(
    ("key", "named", "complaint"),
    [
        ("tools", {"tool": POSE}, "tools.tool: is what the machine's own tool frame is called"),
        ("work_frames", {"base": POSE}, "work_frames.base: is what the machine's own base frame"),
        ("tools", {"platform": POSE}, "tools.platform: is what another frame of the machine is called"),
        ("tools", {"strut_1_rod": POSE}, "tools.strut_1_rod: is what another frame"),
        ("tools", {"a probe": POSE}, "tools.a probe: a name must begin with a letter"),
        ("tools", {"ø": POSE}, "a name must begin with a letter"),
        ("tools", {"x" * 65: POSE}, "64 letters, digits and underscores"),
        ("tools", {"fixture": POSE}, "tools.fixture: is a tool and a work frame; their names must differ"),
        ("tools", {"probe": {"position": [0, 0, 1]}}, "tools.probe.position: has no unit"),
        ("tools", {"probe": {"position_mm": [0, 0, float("nan")]}}, r"tools.probe.position_mm\[2\]: must be finite"),
        ("tools", {"probe": {"position_mm": [0, 0, 1], "angle_deg": 1}}, "tools.probe.angle_deg: is not a known key"),
        ("tools", {"probe": [0, 0, 1]}, "tools.probe: must be a mapping"),
        ("tools", [POSE], "tools: must be a mapping"),
        (
            "work_frames",
            {f"f{n}": dict(POSE, position_mm=[0, 0, n]) for n in range(MOST + 1)},
            "work_frames: must be no more than 100",
        ),
    ],
)
def test_what_cannot_be_is_refused(key: str, named: object, complaint: str, tmp_path: Path) -> None:
    content = yaml.safe_load(EXAMPLE.read_text(encoding="utf-8"))
    with pytest.raises(InputFileError, match=complaint):
        loaded({**content, key: named}, tmp_path)
