"""The largest box in a reach: against every box of small grids, limits by NumPy, and as campaigns use it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines

from hexapod_comp import cli
from hexapod_comp.errors import GeometryError, InputFileError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.measurements.campaign import load_campaign
from hexapod_comp.pose import Pose
from hexapod_comp.workspace.overview import overview
from hexapod_comp.workspace.reach import FACES, FINDINGS, ROOM, _largest_cells, largest_box, machine_box, reach

ROOT = Path(__file__).resolve().parents[2]


def lengths(geometry: HexapodGeometry, tips: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return strut lengths (N, 6) for tool tips in work, by NumPy alone."""
    work, tool = geometry.work, geometry.tool
    platform = work.rotation @ rotation @ tool.rotation.T
    positions = work.position + tips @ work.rotation.T - platform @ tool.position
    return np.linalg.norm(positions[:, None] + geometry.platform_joints @ platform.T - geometry.base_joints, axis=2)


def test_the_largest_box_of_a_grid_is_found():
    rng = np.random.default_rng(5)
    for shape, density in product([(5, 4, 6), (2, 7, 3), (3, 3, 3)], (0.95, 0.8, 0.5)):
        within = rng.random(shape) < density
        best = 0
        for ends in product(*(combinations(range(n), 2) for n in shape)):
            if within[tuple(slice(a, b + 1) for a, b in ends)].all():
                best = max(best, int(np.prod([b - a for a, b in ends])))
        corners = _largest_cells(within)
        if not best:
            assert corners is None
            continue
        low, high = corners
        assert np.prod(np.subtract(high, low)) == best
        assert within[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))].all()


@pytest.mark.parametrize("name", ["paper", "positioning_unit", "example_6_6"])
def test_all_of_the_box_is_within_the_limits_and_no_face_can_move_out(name: str):
    geometry = load_geometry(name)
    seen = reach(geometry, cells=20)
    box, rotation, causes = largest_box(seen)
    tips = np.random.default_rng(1).uniform(box[0], box[1], (500, 3))
    found = lengths(geometry, tips, rotation)
    assert (found >= geometry.limits.stroke[:, 0]).all()
    assert (found <= geometry.limits.stroke[:, 1]).all()
    for tip, row in zip(tips[:100], found, strict=False):
        pose = geometry.platform_pose(Pose(tip, rotation))
        assert geometry.refusal(pose.position, pose.rotation, row) is None
    assert list(causes) == list(FACES)
    assert all(cause.split(", strut")[0] in FINDINGS for cause in causes.values())
    room = ROOM / (1.0 - 2.0 * ROOM) * np.ptp(box, axis=0) * [[-1.0], [1.0]]
    for axis, side in product(range(3), range(2)):
        moved = box + room  # as it was before it came in; rounding took up to 1 % of the shortest edge beside
        moved[side, axis] += 0.05 * (2 * side - 1) * np.ptp(box, axis=0)[axis]
        grid = np.stack(np.meshgrid(*(np.linspace(*ends, 9) for ends in moved.T), indexing="ij"), -1).reshape(-1, 3)
        stroke = geometry.limits.stroke
        far = lengths(geometry, grid, rotation)
        assert ((far < stroke[:, 0]) | (far > stroke[:, 1])).any(), (axis, side)


def test_the_papers_own_box_fits_into_what_its_machine_reaches():
    """16 × 16 × 8 inches, by Mou & King; the largest box is larger."""
    box = machine_box(load_geometry("paper")).box
    papers = load_campaign("campaign_5d").box
    assert (box[0] <= papers[0]).all()
    assert (box[1] >= papers[1]).all()


def test_a_tool_turned_by_90_degrees_is_measured_as_it_stands_at_home():
    geometry = load_geometry("positioning_unit")
    turned = replace(geometry, tool=Pose.from_angles(geometry.tool.position, [0.0, 0.0, np.pi / 2]))
    largest = machine_box(turned)
    np.testing.assert_allclose(largest.rotation, turned.tool.rotation, atol=1e-15)
    np.testing.assert_allclose(largest.box, machine_box(geometry).box, atol=1e-9)


def test_limits_that_leave_a_needle_are_refused():
    geometry = load_geometry("positioning_unit")
    narrow = replace(geometry.limits, stroke=np.tile([0.18805, 0.18815], (6, 1)))
    with pytest.raises(GeometryError):
        machine_box(replace(geometry, limits=narrow), cells=4)


# As campaigns use it.


def test_a_campaign_without_a_box_needs_a_machine(tmp_path: Path):
    with pytest.raises(InputFileError, match="box: is missing"):
        load_campaign("campaign")
    box = np.array([[-0.1, -0.2, 0.3], [0.1, 0.2, 0.4]])
    campaign = load_campaign("campaign", lambda: (box, np.eye(3)))
    np.testing.assert_array_equal(campaign.box, box)
    assert (campaign.cell, campaign.step) == pytest.approx((0.1, 0.025))  # a quarter of 0.4 m, a quarter of that
    own = tmp_path / "own.yaml"
    own.write_text((ROOT / "config" / "campaign_1d.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    with_box = load_campaign(own, lambda: pytest.fail("a file's own box is taken"))
    np.testing.assert_allclose(with_box.box[0], [-0.2032, -0.2032, 0.35])


@pytest.mark.parametrize("name", ["hanging", "framed", "inches"])
def test_simulate_measures_any_machine_in_its_own_box(name: str, tmp_path: Path, capsys):
    machine = machines()[name]
    geometry = machine.write(tmp_path / "machine.yaml")
    out = tmp_path / "measured.csv"
    campaign = tmp_path / "coarse.yaml"
    campaign.write_text("format: hexapod_comp/campaign\nversion: 1\ninstrument: 1-D\ncell_mm: 300\nstep_mm: 150\n")
    asked = ["simulate", "--machine", str(geometry), "--truth", "ideal", "--campaign", str(campaign), "--out", str(out)]
    assert cli.main(asked) == 0
    assert "gives no box: the largest that" in capsys.readouterr().err
    box = machine_box(load_geometry(geometry)).box
    with out.open(newline="", encoding="utf-8") as file:
        tips = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in csv.DictReader(file)]) * 1e-3
    np.testing.assert_allclose([tips.min(axis=0), tips.max(axis=0)], box, atol=1e-9)


# As `show` shows it.


def test_show_draws_and_says_in_which_frame(tmp_path: Path, capsys):
    assert cli.main(["show", "example_6_6", "--pictures", str(tmp_path / "new")]) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "new" / "machine.png").stat().st_size > 50_000
    assert printed.count("work frame x ") == 3  # reach, largest box, box for campaigns
    assert "look again" not in printed
    assert cli.main(["show", "paper", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["largest_box"]["frame"] == shown["campaign_box"]["frame"] == "work"
    assert any("joint_axes are missing" in text for text in shown["look_again"])
    np.testing.assert_allclose(shown["home_lengths_m"], 0.509192, atol=5e-7)  # Table 2 of Song et al., pose 1


def test_tilts_stop_where_a_limit_does():
    """One step of a quarter of a degree further, a strut or a joint is beyond its limit."""
    geometry = load_geometry("example_6_6")
    tilts = overview(geometry, cells=8).tilts
    home = geometry.tool_pose(geometry.home)
    for axis, (backward, forward) in enumerate(tilts):
        assert backward < 0.0 < forward
        for angle, within in ((forward, True), (forward + np.radians(0.26), False), (backward, True)):
            turned = Pose.from_angles(np.zeros(3), angle * np.eye(3)[axis])
            pose = geometry.platform_pose(Pose(home.position, home.rotation @ turned.rotation))
            found = lengths(geometry, home.position[None], home.rotation @ turned.rotation)[0]
            assert (geometry.refusal(pose.position, pose.rotation, found) is None) == within


def test_the_example_explains_every_key():
    """All that parse_geometry takes, but the dimensions of the paper's machine."""
    text = (ROOT / "config" / "example_6_6.yaml").read_text(encoding="utf-8")
    keys = "base platform joints joint_axes cone_axes home position rotation limits stroke base_cone platform_cone "
    keys += (
        "condition_number correction step speed acceleration jerk clearance tool work screw lead machine format version"
    )
    assert [key for key in keys.split() if f"{key}:" not in text and f"{key}_" not in text] == []
    geometry = load_geometry("example_6_6")
    assert geometry.screw_lead.min() < 0.0 < geometry.screw_lead.max()
    assert np.unique(geometry.platform_joints, axis=0).shape == (6, 3)
