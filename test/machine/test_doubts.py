"""What looks wrong in a geometry file: nothing on machines that are right, and each mistake on one that has it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines

from hexapod_comp.errors import InputFileError
from hexapod_comp.machine.doubts import doubts, joint_doubts, twist_per_lead
from hexapod_comp.machine.geometry import HexapodGeometry, Limits, load_geometry, parse_geometry
from hexapod_comp.machine.struts import home_twists
from hexapod_comp.pose import Pose

CONFIG = Path(__file__).resolve().parents[2] / "config"
WIDE = Limits(np.tile([0.01, 3.0], (6, 1)), np.full(6, np.pi), np.full(6, np.pi), 1e9, 1.0, 1.0, 1.0)


def example(**changes: object) -> HexapodGeometry:
    """Return the 6-6 example with limits so wide that mistakes of all kinds come through."""
    return replace(load_geometry("example_6_6"), limits=WIDE, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["paper", "positioning_unit", "jugglebot", "example_6_6"])
def test_shipped_machines_are_right(name: str):
    assert doubts(load_geometry(name)) == ()


@pytest.mark.parametrize("name", machines())
def test_foreign_machines_are_right(name: str, tmp_path: Path):
    """6-6 uneven, hanging, with turned frames, in inches."""
    assert doubts(load_geometry(machines()[name].write(tmp_path / "machine.yaml"))) == ()


@pytest.mark.parametrize("pair", [*pairwise(range(6)), (0, 5), (1, 4), (0, 3)])
@pytest.mark.parametrize("body", ["base_joints", "platform_joints"])
def test_swapped_joints_are_named(pair: tuple[int, int], body: str):
    order = np.arange(6)
    order[list(pair)] = order[list(pair)][::-1]
    (doubt,) = doubts(example(**{body: getattr(example(), body)[order]}))
    assert doubt.startswith(f"joints {pair[0] + 1}, {pair[1] + 1} of the platform, or of the base, look swapped")


@pytest.mark.parametrize("turn", [-100.0, 60.0, 175.0])
def test_a_turned_home_is_noticed(turn: float):
    home = Pose.from_angles(example().home.position, np.radians([0.0, 0.0, turn]))
    (doubt,) = doubts(example(home=home))
    assert "turned by" in doubt
    found = float(doubt.partition("turned by ")[2].partition("°")[0])
    assert found == pytest.approx(turn, abs=10.0)  # the 6-6's platform is no exact copy of its base


def test_a_mirrored_home_is_noticed_by_the_tool():
    home = example().home
    (doubt,) = doubts(example(home=Pose(home.position * [1.0, 1.0, -1.0], home.rotation)))
    assert "mirrored" in doubt


def test_a_wrong_unit_is_noticed():
    base = example().base_joints
    assert [text.split(" ")[0] for text in joint_doubts(base * 25.4, base * 0.5 + [0, 0, 9.0])] == ["base.joints"]


def test_a_home_that_breaks_a_limit_says_what_may_be_wrong(tmp_path: Path):
    """As a user meets it: the platform's y has the wrong sign, and the machine is nearly singular so."""
    text = (CONFIG / "example_6_6.yaml").read_text(encoding="utf-8")
    before, after = text.split("platform:", 1)
    joints = load_geometry("example_6_6").platform_joints * [1.0, -1.0, 1.0] * 1e3
    start, end = after.index("joints_mm:"), after.index("  # Direction of the cardan axis")
    wrong = f"{before}platform:{after[:start]}joints_mm: {joints.tolist()}\n{after[end:]}"
    with pytest.raises(InputFileError, match=r"home: breaks a limit: .*; platform joints 1…6 run the other way round"):
        parse_geometry(wrong)


def test_twist_is_that_of_a_machine_that_says_its_axes():
    """Axes across the struts at home, alike at both ends, given to the geometry itself: its own code's twist."""
    bare = replace(load_geometry("paper"), limits=WIDE)
    neutral = np.asarray(bare.base_cone_axes)
    across = np.cross(neutral, np.eye(3)[np.abs(neutral).argmin(axis=1)])
    turned = Pose.from_angles(bare.home.position, np.radians([2.0, -3.0, 6.0]))
    told = replace(bare, base_axes=across, platform_axes=across, screw_lead=np.full(6, 0.01), home=turned)
    share = twist_per_lead(bare, turned.position[None], turned.rotation[None])
    assert share == pytest.approx(np.abs(home_twists(told)).max() / (2.0 * np.pi), rel=1e-12)
