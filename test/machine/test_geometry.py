"""Geometry files: the paper's machine, a general machine in inches, named tools and frames; refusals and doubts."""

from __future__ import annotations

import copy
import pickle
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign_machines import machines, with_frames
from helpers import beside, distances
from strategies import PAPER_FILE, paper_geometry, skewed_geometry

from hexapod_comp.errors import FrameError, GeometryError, InputFileError
from hexapod_comp.machine.doubts import doubts, joint_doubts, largest_screw_turn
from hexapod_comp.machine.geometry import (
    MOST_FRAMES,
    HexapodGeometry,
    Limits,
    load_geometry,
    paper_joints,
    parse_geometry,
)
from hexapod_comp.machine.struts import home_twists
from hexapod_comp.pose import Pose

PAPER_TEXT = PAPER_FILE.read_text(encoding="utf-8")

TEXTS = beside(__file__)
GENERAL = TEXTS["general"]


def test_the_papers_joints():
    """The truth is the joints by hand from a = 300, b = 572, d = 243 mm, to 1 µm.

    √3/6 = 0.2886751: X_B1 = 0.2886751·(2·572 + 243) = 400.392, Y_B1 = 121.5; X_B2 = −0.2886751·329 = −94.974, Y_B2 =
    407.5; X_B3 = −0.2886751·1058 = −305.418, Y_B3 = 286; joints 4, 5, 6 mirror 3, 2, 1. The platform's joints have the
    radius 300/√3 = 173.205 at 60°, 180°, −60°.
    """
    geometry = paper_geometry()
    half = np.array([[400.392, 121.5, 0], [-94.974, 407.5, 0], [-305.418, 286, 0]])
    base = [*half, *(half[::-1] * [1, -1, 1])]
    corners = [[86.603, 150, 0], [-173.205, 0, 0], [86.603, -150, 0]]
    np.testing.assert_allclose(geometry.base_joints * 1e3, base, atol=5e-4)
    np.testing.assert_allclose(geometry.platform_joints * 1e3, np.repeat(corners, 2, axis=0), atol=5e-4)


def test_a_general_machine_in_inches():
    """An inch is 25.4 mm; axes become unit vectors; one cone angle counts for all joints; 12 m/min are 0.2 m/s."""
    geometry = parse_geometry(GENERAL)
    np.testing.assert_allclose(geometry.base_joints[1], np.array([-8, 18, 0.5]) * 0.0254, rtol=1e-15)
    np.testing.assert_allclose(geometry.platform_joints[4], np.array([4, -9, 1]) * 0.0254, rtol=1e-15)
    np.testing.assert_allclose(geometry.base_axes[0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(geometry.base_axes[1], np.array([3, 1, 0]) / np.sqrt(10), rtol=1e-15)
    np.testing.assert_allclose(geometry.platform_cone_axes, np.tile([0, 0, 1], (6, 1)), atol=1e-15)
    np.testing.assert_allclose(geometry.screw_lead, np.array([1, 1, 1, 1, 1, -1]) * 5.08e-3, rtol=1e-15)
    np.testing.assert_allclose(geometry.home.position, [0, 0, 0.508], rtol=1e-15)
    np.testing.assert_allclose(geometry.tool.position, [0, 0, -0.1016], rtol=1e-15)
    np.testing.assert_allclose(geometry.tool.rotation @ [0, 0, 1], [1, 0, 0], atol=1e-15)  # β = 90° about y
    np.testing.assert_allclose(geometry.work.position, np.array([1, 2, 3]) * 0.0254, rtol=1e-15)
    limits = geometry.limits
    low, high = np.array([10, 10, 10, 10, 11, 12]), np.array([40, 40, 40, 40, 41, 42])
    np.testing.assert_allclose(limits.stroke, np.stack([low, high], axis=1) * 0.0254, rtol=1e-15)
    np.testing.assert_allclose(np.rad2deg(limits.base_cone), [60, 60, 60, 60, 60, 50], rtol=1e-15)
    np.testing.assert_allclose(np.rad2deg(limits.platform_cone), 80, rtol=1e-15)
    assert (limits.condition, limits.correction, limits.step) == (20.0, 2e-3, 2e-3)
    assert limits.speed == pytest.approx(0.2, rel=1e-15)


# Refusals, which name file, key and value


@pytest.mark.parametrize(
    ("old", "new", "said"),
    TEXTS["refused"],
)
def test_refused(old, new, said):
    text = GENERAL if old in GENERAL and "lead" not in new else PAPER_TEXT
    assert old in text
    with pytest.raises(InputFileError) as caught:
        parse_geometry(text.replace(old, new, 1))
    assert all(part in str(caught.value) for part in said)


def test_struts_at_home_are_the_cones_axes_where_the_file_gives_none():
    """A home turned by degrees breaks no cone of 0.0001° about the struts at home."""
    skewed, narrow = skewed_geometry(), np.full(6, 2e-6)
    limits = replace(skewed.limits, base_cone=narrow, platform_cone=narrow)
    replace(skewed, limits=limits, base_cone_axes=None, platform_cone_axes=None)


def test_clearance():
    """Clearance is optional, not negative, and not above that at home: 243 mm between base joints 2 and 3."""
    assert parse_geometry(PAPER_TEXT).limits.clearance == 0.0
    text = PAPER_TEXT.replace("  step_mm: 2", "  clearance_mm: {}\n  step_mm: 2")
    assert parse_geometry(text.format(60)).limits.clearance == 0.06
    parse_geometry(text.format(242.9))
    for wrong, said in (
        (-1, "limits.clearance_mm: must be finite and not negative"),
        (243.1, "home: breaks a limit: "),
    ):
        with pytest.raises(InputFileError, match=said):
            parse_geometry(text.format(wrong))


@pytest.mark.parametrize(("a", "b", "d"), [(0.0, 0.5, 0.2), (0.3, -0.5, 0.2), (0.3, 0.5, np.nan)])
def test_dimensions_of_no_machine(a, b, d):
    with pytest.raises(GeometryError, match="finite and positive"):
        paper_joints(a, b, d)
    paper = paper_geometry()
    with pytest.raises(GeometryError, match=r"platform\.joints.*coincide"):
        replace(paper, platform_joints=np.zeros((6, 3)))


# ---- from text, path and shipped name ----


@pytest.mark.parametrize("name", ["paper", "paper.yaml"])
def test_a_shipped_machine_goes_by_its_name(name, tmp_path, monkeypatch):
    """The name finds the shipped machine from any folder, even if a folder there has the same name."""
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_geometry(name).name == "paper"


EXAMPLE = Path(__file__).resolve().parents[2] / "config" / "example_6_6.yaml"
ROUNDING = 1e-14  # m; a few products of numbers below one


@pytest.mark.parametrize("name", ["framed", "hanging", "inches", "mirror"])
def test_poses_are_those_of_the_tool_and_frame_in_use(name: str, tmp_path: Path) -> None:
    """The truth is the zoo's own frames, multiplied there."""
    machine = with_frames(name)
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    assert list(geometry.tools) == ["tool", "probe", "stub"]
    assert list(geometry.work_frames) == ["base", "work", "fixture"]
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


def test_a_geometry_with_tools_can_be_copied_replaced_and_sent_elsewhere() -> None:
    shipped = load_geometry(EXAMPLE)
    geometry = shipped.using("probe", "fixture")
    for name in (
        "base_cone_axes",
        "platform_cone_axes",
        "base_axes",
        "platform_axes",
        "kernel_joints",
        "limit_numbers",
    ):
        assert getattr(geometry, name) is getattr(shipped, name)  # axes normalised twice may differ in a bit
    for other in (pickle.loads(pickle.dumps(geometry)), copy.deepcopy(geometry), replace(geometry)):
        assert (other.tool_name, other.work_name) == ("probe", "fixture")
        assert list(other.tools) == list(geometry.tools)
    moved = replace(geometry, tool=Pose(np.ones(3), np.eye(3)))
    assert moved.using("tool").using("probe").tool is moved.tool  # a name given to the used tool returns this tool
    with pytest.raises(FrameError, match=r"machine example_6_6 has no tool 'prob'; it has tool, probe$"):
        geometry.using(tool="prob")
    with pytest.raises(FrameError, match=r"no work frame ''; it has base, work, fixture$"):
        geometry.using(work="")


@pytest.mark.parametrize(
    ("key", "named", "complaint"),
    [
        *TEXTS["frames"],
        (
            "work_frames",
            {f"f{n}": {"position_mm": [0, 0, n]} for n in range(MOST_FRAMES + 1)},
            "work_frames: must have at most 100 entries",
        ),
    ],
)
def test_frames_that_cannot_be_are_refused(key: str, named: object, complaint: str) -> None:
    content = yaml.safe_load(EXAMPLE.read_text(encoding="utf-8"))
    with pytest.raises(InputFileError, match=complaint):
        parse_geometry(yaml.safe_dump({**content, key: named}))


def test_a_machine_may_have_as_many_frames_as_the_limit_says() -> None:
    content = yaml.safe_load(EXAMPLE.read_text(encoding="utf-8"))
    named = {f"f{n}": {"position_mm": [0, 0, n]} for n in range(MOST_FRAMES)}
    assert named.keys() <= parse_geometry(yaml.safe_dump({**content, "work_frames": named})).work_frames.keys()


CONFIG = Path(__file__).resolve().parents[2] / "config"
WIDE = Limits(np.tile([0.01, 3.0], (6, 1)), np.full(6, np.pi), np.full(6, np.pi), 1e9, 1.0, 1.0, 1.0)


def example(**changes: object) -> HexapodGeometry:
    """Return the 6-6 example with limits so wide that no mistake breaks them."""
    return replace(load_geometry("example_6_6"), limits=WIDE, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["paper", "positioning_unit", "jugglebot", "example_6_6"])
def test_shipped_machines_are_right(name: str):
    assert doubts(load_geometry(name)) == ()


@pytest.mark.parametrize(
    "wrong", ["base.joints and platform.joints", "platform.joints", "home.position", "limits.stroke"]
)
@pytest.mark.parametrize(
    ("factor", "unit"),
    [(25.4, "in inches"), (1.0 / 25.4, "in mm, not inches"), (10.0, "in cm"), (1e3, "in m"), (1e-3, "in mm, not m")],
)
def test_lengths_in_a_wrong_unit_are_named(factor: float, unit: str, wrong: str):
    """With strokes of ±1 % about home the right unit of the wrong lengths fits."""
    right = load_geometry("example_6_6")
    base, platform, home, stroke = (
        given / (factor if key in wrong else 1.0)
        for key, given in {
            "base.joints": right.base_joints,
            "platform.joints": right.platform_joints,
            "home.position": right.home.position,
            "limits.stroke": distances(right, right.home)[:, None] * [0.99, 1.01],
        }.items()
    )
    changes = {"base_joints": base, "platform_joints": platform, "home": Pose(home, right.home.rotation)}
    limits = replace(right.limits, stroke=stroke)
    with pytest.raises(GeometryError, match=f"unit wrong. With (.*or )?{wrong} {unit}.*, home would keep the limits"):
        replace(right, limits=limits, base_cone_axes=None, platform_cone_axes=None, **changes)


@pytest.mark.parametrize("name", machines())
def test_foreign_machines_are_right(name: str, tmp_path: Path):
    """Correct machines (6-6 uneven, hanging, with turned frames, in inches) raise no doubt."""
    assert doubts(load_geometry(machines()[name].write(tmp_path / "machine.yaml"))) == ()


@pytest.mark.parametrize("pair", [*pairwise(range(6)), (0, 5), (1, 4), (0, 3)])
@pytest.mark.parametrize("body", ["base_joints", "platform_joints"])
def test_swapped_joints_are_named(pair: tuple[int, int], body: str):
    order = np.arange(6)
    order[list(pair)] = order[list(pair)][::-1]
    (doubt,) = doubts(example(**{body: getattr(example(), body)[order]}))
    assert doubt.startswith(f"joints {pair[0] + 1}, {pair[1] + 1} of the platform, or of the base, look swapped")


def test_a_turned_or_mirrored_home_and_a_wrong_unit_are_noticed():
    home, base = example().home, example().base_joints
    for turn in (-100.0, 60.0, 175.0):
        (doubt,) = doubts(example(home=Pose.from_angles(home.position, np.radians([0.0, 0.0, turn]))))
        found = float(doubt.partition("turned by ")[2].partition("°")[0])
        assert found == pytest.approx(turn, abs=10.0)  # the 6-6's platform is not an exact copy of its base
    (doubt,) = doubts(example(home=Pose(home.position * [1.0, 1.0, -1.0], home.rotation)))
    assert "the wrong sign" in doubt
    assert doubts(example(screw_lead=np.zeros(6))) == (
        "without screw.lead, joint_axes affect only the bearing friction of a model (friction_N_m)",
    )
    up, turned = np.array([0.0, 0.0, 1.0]), base[[1, 2, 0, 3, 4, 5]]
    for bodies, doubt in (
        ((25.4 * base, base + 9.0 * up), "base.joints lie within 10530.7 mm of their centre: is their unit right?"),
        ((base, 0.015 * base + up), "platform.joints lie within 6.21889 mm of their centre: is their unit right?"),
        ((base, turned + up), "joints 1, 2, 3 of the platform, or of the base, look swapped: the struts cross"),
    ):
        assert [*joint_doubts(*bodies)] == [doubt]


def test_a_home_that_breaks_a_limit_says_what_may_be_wrong(tmp_path: Path):
    """With the wrong sign of the platform's y the paper's machine is nearly singular at home; the message says so."""
    text = (CONFIG / "example_6_6.yaml").read_text(encoding="utf-8")
    before, after = text.split("platform:", 1)
    joints = load_geometry("example_6_6").platform_joints * [1.0, -1.0, 1.0] * 1e3
    start, end = after.index("joints_mm:"), after.index("  # Direction of the cardan axis")
    wrong = f"{before}platform:{after[:start]}joints_mm: {joints.tolist()}\n{after[end:]}"
    with pytest.raises(InputFileError, match=r"home: breaks a limit: .*; platform joints 1…6 go round in the opposite"):
        parse_geometry(wrong)


@pytest.mark.parametrize(
    ("field", "key", "shape"),
    [
        ("base_joints", "base.joints", (6, 3)),
        ("platform_joints", "platform.joints", (6, 3)),
        ("screw_lead", "screw.lead", (6,)),
        ("base_axes", "base.joint_axes", (6, 3)),
        ("platform_cone_axes", "platform.cone_axes", (6, 3)),
    ],
)
def test_arrays_of_a_geometry_have_their_shape_and_are_finite_and_read_only(field: str, key: str, shape: tuple):
    geometry = example()
    with pytest.raises(GeometryError, match=re.escape(f"{key}: must have shape {shape}, not {(*shape[:-1], 2)}")):
        replace(geometry, **{field: np.ones((*shape[:-1], 2))})
    with pytest.raises(GeometryError, match=re.escape(f"{key}: must be finite")):
        replace(geometry, **{field: np.full(shape, np.nan)})
    assert not getattr(geometry, field).flags.writeable


def test_twist_is_that_of_a_machine_that_says_its_axes():
    """Machines whose file has no axes get the same twist as those with axes across the struts at home."""
    bare = replace(load_geometry("paper"), limits=WIDE)
    neutral = np.asarray(bare.base_cone_axes)
    across = np.cross(neutral, np.eye(3)[np.abs(neutral).argmin(axis=1)])
    turned = Pose.from_angles(bare.home.position, np.radians([2.0, -3.0, 6.0]))
    told = replace(bare, base_axes=across, platform_axes=across, screw_lead=np.full(6, 0.01), home=turned)
    share = largest_screw_turn(bare, turned.position[None], turned.rotation[None])
    assert share == pytest.approx(np.abs(home_twists(told)).max() / (2.0 * np.pi), rel=1e-12)
