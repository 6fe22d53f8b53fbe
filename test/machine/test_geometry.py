"""Geometry files: the paper's machine, a general one in inches, and everything that must be refused."""

from __future__ import annotations

import numpy as np
import pytest
from strategies import PAPER_FILE, paper_geometry

from hexapod_comp.errors import GeometryError, InputFileError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry, paper_joints

PAPER_TEXT = PAPER_FILE.read_text(encoding="utf-8")

# A 6-6 machine in inches: no two joints in one place, two of them off their plane, everything optional given.
GENERAL = """
format: hexapod_comp/geometry
version: 1
machine: general
base:
  joints_in: [[20, 2, 0], [-8, 18, 0.5], [-12, 16, 0], [-12, -16, 0], [-8, -18, -0.5], [20, -2, 0]]
  joint_axes: [[0, 2, 0], [3, 1, 0], [1, 1, 0], [1, -1, 0], [3, -1, 0], [0, -2, 0]]
platform:
  joints_in: [[5, 8, 0], [4, 9, 1], [-10, 1, 0], [-10, -1, 0], [4, -9, 1], [5, -8, 0]]
  joint_axes: [[0, 1, 0], [3, 1, 0], [1, 1, 0], [1, -1, 0], [3, -1, 0], [0, -1, 0]]
  cone_axes: [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 2], [0, 0, 1], [0, 0, 1]]
screw:
  lead_in: [0.2, 0.2, 0.2, 0.2, 0.2, -0.2]
home:
  position_in: [0, 0, 20]
tool:
  position_in: [0, 0, -4]
  rotation_deg: [0, 90, 0]
work:
  position_in: [1, 2, 3]
limits:
  stroke_in: [[10, 40], [10, 40], [10, 40], [10, 40], [11, 41], [12, 42]]
  base_cone_deg: [60, 60, 60, 60, 60, 50]
  platform_cone_deg: 80
  condition_number: 20
  correction_um: 2000
  step_mm: 2
  speed_m_min: 12
"""


def written(folder, text):
    path = folder / "machine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(folder, text):
    """Load a geometry text that must be refused and return what the message says, file left out."""
    path = written(folder, text)
    with pytest.raises(InputFileError) as caught:
        load_geometry(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    return message[len(str(path)) :]


def test_the_papers_joints():
    """Truth: the joints worked by hand from a = 300, b = 572, d = 243 mm, to 1 µm.

    √3/6 = 0.2886751: X_B1 = 0.2886751·(2·572 + 243) = 400.392, Y_B1 = 121.5; X_B2 = −0.2886751·329 =
    −94.974, Y_B2 = 407.5; X_B3 = −0.2886751·1058 = −305.418, Y_B3 = 286; 4, 5, 6 mirror 3, 2, 1. Platform
    radius 300/√3 = 173.205 at 60°, 180°, −60°.
    """
    geometry = paper_geometry()
    base = [
        [400.392, 121.5, 0],
        [-94.974, 407.5, 0],
        [-305.418, 286, 0],
        [-305.418, -286, 0],
        [-94.974, -407.5, 0],
        [400.392, -121.5, 0],
    ]
    corners = [[86.603, 150, 0], [-173.205, 0, 0], [86.603, -150, 0]]
    np.testing.assert_allclose(geometry.base_joints * 1e3, base, atol=5e-4)
    np.testing.assert_allclose(geometry.platform_joints * 1e3, np.repeat(corners, 2, axis=0), atol=5e-4)


def test_a_general_machine_in_inches(tmp_path):
    """Truth: 25.4 mm to the inch; axes are made unit vectors."""
    geometry = load_geometry(written(tmp_path, GENERAL))
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


def test_limits_in_their_units(tmp_path):
    """Truth: arithmetic. Six stroke pairs stay six; one cone angle serves all; 12 m/min are 0.2 m/s."""
    limits = load_geometry(written(tmp_path, GENERAL)).limits
    low, high = np.array([10, 10, 10, 10, 11, 12]), np.array([40, 40, 40, 40, 41, 42])
    np.testing.assert_allclose(limits.stroke, np.stack([low, high], axis=1) * 0.0254, rtol=1e-15)
    np.testing.assert_allclose(np.rad2deg(limits.base_cone), [60, 60, 60, 60, 60, 50], rtol=1e-15)
    np.testing.assert_allclose(np.rad2deg(limits.platform_cone), 80, rtol=1e-15)
    assert (limits.condition, limits.correction, limits.step) == (20.0, 2e-3, 2e-3)
    assert limits.speed == pytest.approx(0.2, rel=1e-15)


def test_cone_axes_default_to_the_struts_at_home():
    """Truth: directions between joints at home, where nothing is turned, by NumPy."""
    geometry = paper_geometry()
    along = geometry.home.position + geometry.platform_joints - geometry.base_joints
    along /= np.linalg.norm(along, axis=1)[:, None]
    np.testing.assert_allclose(geometry.base_cone_axes, along, atol=1e-15)
    np.testing.assert_allclose(geometry.platform_cone_axes, along, atol=1e-15)


def test_a_geometry_cannot_be_changed_afterwards():
    with pytest.raises(ValueError, match="read-only"):
        paper_geometry().base_joints[0, 0] = 0.0


# Refused, naming file, key and value.

FIFTH_JOINT = ", [20, -2, 0]]"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        pytest.param(FIFTH_JOINT, "]", ["base.joints_in", "6×3", "5×3"], id="five joints"),
        pytest.param("[5, 8, 0]", "[5, 8, .nan]", ["platform.joints_in[0][2]", "finite", "nan"], id="NaN"),
        pytest.param("[5, 8, 0]", "[5, eight, 0]", ["platform.joints_in[0][1]", "number", "eight"], id="a word"),
        pytest.param(
            "[-8, 18, 0.5]",
            "[20, 2, 0]",
            ["base.joints[1]", "coincides with base joint 1", "0.508"],
            id="coincident base joints",
        ),
        pytest.param("[11, 41]", "[41, 11]", ["limits.stroke[4]", "below the longest", "1.041"], id="stroke reversed"),
        pytest.param("[11, 41]", "[-11, 41]", ["limits.stroke[4]", "positive", "-0.2794"], id="negative length"),
        pytest.param("60, 50]", "60, 0]", ["limits.base_cone[5]", "(0, π]", "0.0"], id="cone of nothing"),
        pytest.param("cone_deg: 80", "cone_deg: 200", ["limits.platform_cone[0]", "(0, π]", "3.49"], id="cone"),
        pytest.param("number: 20", "number: 0.5", ["limits.condition", "above 1", "0.5"], id="condition"),
        pytest.param("correction_um: 2000", "correction_um: 0", ["limits.correction", "above 0"], id="zero limit"),
        pytest.param("step_mm: 2", "step: 2", ["limits.step", "no unit", "step_mm", "2"], id="unit missing"),
        pytest.param("step_mm: 2", "step_kg: 2", ["limits.step", "missing", "step_mm"], id="wrong unit"),
        pytest.param("step_mm: 2", "step_mm: 2\n  step_um: 2000", ["limits.step_", "given twice"], id="two units"),
        pytest.param(
            "speed_m_min: 12", "speed_m_min: 12\n  warp: 9", ["limits.warp", "not a known key", "9"], id="unknown key"
        ),
        pytest.param("screw:", "screws:", ["screws", "not a known key"], id="unknown block"),
        pytest.param("  platform_cone", "  base_cone_deg: 3\n  platform_cone", ["base_cone_deg", "twice"], id="twice"),
        pytest.param("version: 1", "version: 2", ["version", "only version 1", "2"], id="version"),
        pytest.param("hexapod_comp/geometry", "hexapod_comp/model", ["format", "geometry", "model"], id="format"),
        pytest.param("machine: general", "machine: 12", ["machine", "text", "12"], id="name not text"),
        pytest.param("[0, 2, 0]", "[0, 0, 0]", ["base.joint_axes[0]", "zero vector"], id="axis of no direction"),
        pytest.param("position_in: [0, 0, 20]", "position_in: [0, 0, 90]", ["home", "stroke"], id="home too high"),
        pytest.param("home:\n  position_in: [0, 0, 20]", "home:", ["home", "mapping"], id="empty block"),
        pytest.param("[0, 90, 0]", "[0, 90]", ["tool.rotation_deg", "shape 3"], id="two angles"),
    ],
)
def test_refused(tmp_path, old, new, said):
    assert old in GENERAL
    message = refusal(tmp_path, GENERAL.replace(old, new, 1))
    for part in said:
        assert part in message


def test_home_outside_the_stroke_names_the_strut(tmp_path):
    """Truth: Table 2: at 400 mm all six struts are 509.192 mm long."""
    message = refusal(tmp_path, PAPER_TEXT.replace("stroke_mm: [330, 880]", "stroke_mm: [330, 509]"))
    assert "home: breaks a limit: strut_1: nominal length 509.19" in message
    assert "mm is outside the stroke 330.000…509.000 mm" in message


def test_home_at_a_singular_pose(tmp_path):
    """Truth: with the platform in the base's plane all struts lie flat and none can hold it up."""
    text = PAPER_TEXT.replace("[0, 0, 400]", "[0, 0, 0]").replace("[330, 880]", "[100, 880]")
    assert "home: breaks a limit: condition number inf of the nominal pose is above 10" in refusal(tmp_path, text)


def test_home_outside_a_cone_of_its_own_axes(tmp_path):
    """Truth: at a height of 400 mm struts of 509.192 mm lean by arccos(400/509.192) = 38.23°."""
    upright = "[[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]]"
    text = PAPER_TEXT.replace("base_cone_deg: 50", "base_cone_deg: 20")
    assert "paper_dimensions" in text
    text += f"base:\n  cone_axes: {upright}\n"
    assert "home: breaks a limit: strut_1: base joint at 38.2" in refusal(tmp_path, text)


def test_clearance(tmp_path):
    """Optional; never negative; not more than there is at home: 243 mm between base joints 2 and 3."""
    assert load_geometry(written(tmp_path, PAPER_TEXT)).limits.clearance == 0.0
    text = PAPER_TEXT.replace("  step_mm: 2", "  clearance_mm: {}\n  step_mm: 2")
    assert load_geometry(written(tmp_path, text.format(60))).limits.clearance == 0.06
    load_geometry(written(tmp_path, text.format(242.9)))
    assert "limits.clearance: must be finite and not negative" in refusal(tmp_path, text.format(-1))
    assert "home: breaks a limit: strut_" in refusal(tmp_path, text.format(243.1))


def test_a_lead_needs_axes(tmp_path):
    assert "base.joint_axes: are needed" in refusal(tmp_path, PAPER_TEXT + "screw:\n  lead_mm: 5\n")


@pytest.mark.parametrize(("a", "b", "d"), [(0.0, 0.5, 0.2), (0.3, -0.5, 0.2), (0.3, 0.5, np.nan)])
def test_dimensions_of_no_machine(a, b, d):
    with pytest.raises(GeometryError, match="finite and positive"):
        paper_joints(a, b, d)


def test_platform_joints_in_one_point():
    paper = paper_geometry()
    with pytest.raises(GeometryError, match=r"platform\.joints.*coincide"):
        HexapodGeometry("point", paper.base_joints, np.zeros((6, 3)), paper.home, paper.limits)


# ---- text, path, shipped name ----


@pytest.mark.parametrize("name", ["paper", "paper.yaml"])
def test_a_shipped_machine_goes_by_its_name(name, tmp_path, monkeypatch):
    """From any folder, also where an output folder has the name."""
    (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_geometry(name).name == "paper"
