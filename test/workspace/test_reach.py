"""The reach of a machine, its shells and boxes, against closed forms, plain NumPy, small grids and random points."""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machines
from helpers import hexapod, quick_pictures
from strategies import paper_geometry

from hexapod_comp.cli import results
from hexapod_comp.core import Status
from hexapod_comp.errors import GeometryError, HexapodError
from hexapod_comp.machine import kinematics
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.limits import REASONS
from hexapod_comp.measurements.campaign import load_campaign
from hexapod_comp.pose import Pose
from hexapod_comp.workspace.overview import _tilt_text, overview, report
from hexapod_comp.workspace.reach import (
    FACES,
    FINDINGS,
    ROOM,
    Boundary,
    Reach,
    _largest_cells,
    first_limits,
    largest_box,
    machine_box,
    orientations,
    possible_box,
    reach,
)
from hexapod_comp.workspace.shells import shell

LEVEL = np.eye(3)


def unit() -> HexapodGeometry:
    return load_geometry("positioning_unit")


def limited(geometry: HexapodGeometry, **limits: object) -> HexapodGeometry:
    return replace(geometry, limits=replace(geometry.limits, **limits))


def tilted(geometry: HexapodGeometry, alpha: float = 0.0, beta: float = 0.0, gamma: float = 0.0) -> np.ndarray:
    return orientations(geometry, np.deg2rad([[alpha], [beta], [gamma]]))[0]


def ends(geometry: HexapodGeometry, tips: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the platform joints in base, (N, 6, 3), by the definitions of tool and work frame."""
    work, tool = geometry.work, geometry.tool
    turned = work.rotation @ rotation @ tool.rotation.T
    origin = work.position + tips @ work.rotation.T - turned @ tool.position
    return origin[:, None] + geometry.platform_joints @ turned.T


def test_poses_of_their_own_orientation(monkeypatch):
    """The truth is the same poses one by one, on one thread and on three with more than one slice."""
    monkeypatch.setattr(kinematics, "ALONE", -1.0)  # other threads help from the second slice on
    geometry, rng = unit(), np.random.default_rng(2)
    angles = np.deg2rad([[-8, 0, 8], [-8, 0, 8], [-10, 0, 10]])
    rotations = orientations(geometry, angles)[rng.integers(0, 27, 5000)]
    tips = rng.uniform([-0.09, -0.09, 0.14], [0.09, 0.09, 0.23], (5000, 3))
    found, struts = first_limits(geometry, tips, rotations, threads=3)
    assert len(np.unique(found)) >= 4
    for n in range(0, 5000, 97):
        alone = first_limits(geometry, tips[n : n + 1], rotations[n : n + 1])
        assert (alone[0][0], *alone[1][0]) == (found[n], *struts[n])
    np.testing.assert_equal(first_limits(geometry, tips, rotations, threads=1), (found, struts))


@pytest.mark.parametrize(
    ("make", "limiting"),
    [
        pytest.param(lambda: (unit(), LEVEL), {1, 2, 3}, id="unit"),
        pytest.param(lambda: (unit(), tilted(unit(), 6, -3, 4)), {1, 2, 3}, id="unit tilted"),
        pytest.param(lambda: (limited(paper_geometry(), clearance=0.2), LEVEL), {Status.CLEARANCE}, id="clearance"),
        pytest.param(lambda: (limited(paper_geometry(), condition=1.6), LEVEL), {Status.CONDITION}, id="condition"),
    ],
)
def test_at_the_boundary_the_named_limit_is_reached_and_no_other_broken(make, limiting):
    """The truth is the nominal machine's limits 1 µm inside and outside along the grid's line; the limits themselves
    have their own test. Where two limits meet, either may come first."""
    geometry, rotation = make()
    edge = reach(geometry, rotation, cells=8).boundary
    assert limiting <= set(edge.findings.tolist())
    named = []
    for tip, finding, axis, way in zip(*vars(edge).values(), strict=True):
        step = 1e-6 * way * np.eye(3)[axis]
        assert refused(geometry, tip - step, rotation) is None
        found = refused(geometry, tip + step, rotation)
        named.append(found.reason == REASONS[finding])
    assert np.mean(named) > 0.97


def refused(geometry: HexapodGeometry, tip: np.ndarray, rotation: np.ndarray) -> HexapodError | None:
    pose = geometry.platform_pose(Pose(tip, rotation))
    return geometry.refusal(pose.position, pose.rotation, lengths(geometry, tip[None], rotation)[0])


def test_volume_of_the_unit():
    """The truth is 100,000 random points checked in plain NumPy by stroke and cones, within four standard errors plus
    the 0.5 % that the grid may be wrong by."""
    geometry = unit()
    found = reach(geometry, cells=32)
    low, high = found.box + np.array([[-1e-3], [1e-3]])
    tips = np.random.default_rng(5).uniform(low, high, (100_000, 3))
    struts = ends(geometry, tips, LEVEL) - geometry.base_joints
    lengths = np.linalg.norm(struts, axis=2)
    cosines = (struts * geometry.base_cone_axes).sum(axis=2) / lengths  # level: the same at both ends
    within = (lengths >= 0.158) & (lengths <= 0.218) & (cosines >= np.cos(np.deg2rad(18.0)))
    share, whole = within.all(axis=1).mean(), np.prod(high - low)
    error = np.sqrt(share * (1.0 - share) / len(tips))
    assert found.volume == pytest.approx(share * whole, abs=(4.0 * error + 0.005 * share) * whole)


def test_shares_pieces_and_centre():
    """The truth is counted by hand; of two separate pieces the deepest point is within reach, the centroid is not."""
    boundary = Boundary(np.zeros((4, 3)), np.array([1, 2, 2, 3]), np.array([2, 2, 2, 0]), np.ones(4))
    apart = np.ones((5, 5, 5), np.int8)
    apart[[0, 4], 2, 2] = Status.OK
    two = Reach(unit(), LEVEL, (np.linspace(-1.0, 1.0, 5),) * 3, apart, boundary)
    assert two.shares() == {FINDINGS[2]: 0.5, FINDINGS[1]: 0.25, FINDINGS[3]: 0.25}
    assert two.parts == 2
    assert two.centre.tolist() == [-1.0, 0.0, 0.0]


def test_an_empty_workspace_says_where_and_why():
    with pytest.raises(GeometryError, match=r"empty at the orientation \(0, 0, 80\)°.*none of .* is within.*stroke"):
        reach(unit(), tilted(unit(), gamma=80.0))
    with pytest.raises(GeometryError, match=r"empty at the orientation \(70, 0, 0\)°"):
        reach(unit(), tilted(unit(), alpha=70.0), cells=8)
    home = unit().tool_pose(unit().home).position
    stroke = lengths(unit(), home[None], LEVEL)[0][:, None] + [-2e-3, 2e-3]
    with pytest.raises(GeometryError, match="cells: must be larger: the workspace contains no point of this grid"):
        reach(limited(unit(), stroke=stroke), LEVEL, cells=5)
    # Turned by 180° about z, each strut's ball is about a point 260 mm from the axis, and 250 mm do not reach across
    short = limited(unit(), stroke=np.tile([0.187, 0.19], (6, 1)))
    with pytest.raises(GeometryError, match="stroke, longest: at every position some strut is too long"):
        possible_box(short, tilted(short, gamma=180.0))


def test_a_shell_is_the_boundary_and_closed():
    """The truth is the limits 1 µm inside the shell and outside it."""
    for rotation in (LEVEL, tilted(unit(), 6.0, -3.0, 5.0)):
        found = shell(reach(unit(), rotation, 24), 19, 36)
        away = found.points - found.centre
        step = 1e-6 * away / np.linalg.norm(away, axis=-1, keepdims=True)
        near, beyond = (
            first_limits(unit(), (found.points + way * step).reshape(-1, 3), rotation[None])[0] for way in (-1.0, 1.0)
        )
        assert (near == Status.OK).all()
        assert (beyond != Status.OK).all()
        assert (beyond == found.findings.ravel()).mean() > 0.99  # where two limits meet, either may come first
        assert np.array_equal(found.points[:, 0], found.points[:, -1])  # the last azimuth is the first
        for pole in (found.points[0], found.points[-1]):
            assert (pole == pole[0]).all()
        assert found.points[0, 0, 2] < found.points[:, :, 2].mean() < found.points[-1, 0, 2]


def lengths(geometry: HexapodGeometry, tips: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    return np.linalg.norm(ends(geometry, tips, rotation) - geometry.base_joints, axis=2)


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


@pytest.mark.parametrize("name", ["positioning_unit", "example_6_6"])
def test_all_of_the_box_is_within_the_limits_and_no_face_can_move_out(name: str):
    geometry = load_geometry(name)
    seen = reach(geometry, cells=20)
    box, rotation, causes = largest_box(seen)
    tips = np.random.default_rng(1).uniform(box[0], box[1], (500, 3))
    found = lengths(geometry, tips, rotation)
    stroke = geometry.limits.stroke
    assert ((found >= stroke[:, 0]) & (found <= stroke[:, 1])).all()
    assert not any(refused(geometry, tip, rotation) for tip in tips[:100])
    assert list(causes) == list(FACES)
    assert all(cause.split(", strut")[0] in FINDINGS for cause in causes.values())
    room = ROOM / (1.0 - 2.0 * ROOM) * np.ptp(box, axis=0) * [[-1.0], [1.0]]
    for axis, side in product(range(3), range(2)):
        moved = box + room  # before the margin; rounding took up to 1 % of the shortest edge
        moved[side, axis] += 0.05 * (2 * side - 1) * np.ptp(box, axis=0)[axis]
        grid = np.stack(np.meshgrid(*(np.linspace(*ends, 9) for ends in moved.T), indexing="ij"), -1).reshape(-1, 3)
        far = lengths(geometry, grid, rotation)
        assert ((far < stroke[:, 0]) | (far > stroke[:, 1])).any(), (axis, side)


def test_the_papers_own_box_fits_into_what_its_machine_reaches():
    """Mou & King's box of 16 × 16 × 8 inches."""
    box, papers = machine_box(load_geometry("paper")).box, load_campaign("campaign_5d").box
    assert (box * [[1.0], [-1.0]] <= papers * [[1.0], [-1.0]]).all()


def test_simulate_measures_any_machine_in_its_own_box(tmp_path: Path):
    geometry, out = machines()["hanging"].write(tmp_path / "machine.yaml"), tmp_path / "measured.csv"
    campaign = tmp_path / "coarse.yaml"
    campaign.write_text("format: hexapod_comp/campaign\nversion: 1\ninstrument: 1-D\ncell_mm: 300\nstep_mm: 150\n")
    told = hexapod("simulate", "--machine", geometry, "--truth", "ideal", "--campaign", campaign, "--out", out)
    assert "gives no box: the largest box that" in told[2]
    box = machine_box(load_geometry(geometry)).box
    with out.open(newline="", encoding="utf-8") as file:
        tips = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in csv.DictReader(file)]) * 1e-3
    np.testing.assert_allclose([tips.min(axis=0), tips.max(axis=0)], box, atol=1e-9)


def test_show_draws_and_its_json_has_the_numbers_of_its_text(tmp_path: Path):
    with quick_pictures():
        shown = json.loads(hexapod("show", "paper", "--pictures", tmp_path / "new", "--json")[1])
    assert (tmp_path / "new" / "machine.png").stat().st_size > 10_000
    assert shown["largest_box"]["frame"] == shown["campaign_box"]["frame"] == "work"
    np.testing.assert_allclose(shown["home_lengths_m"], 0.509192, atol=5e-7)  # Song et al., Table 2, pose 1
    assert shown["home_condition"] == pytest.approx(1.166, abs=5e-4)


def test_the_overview_of_a_machine_without_cardan_axes():
    """The truth is the text of a file, read by a person. A quarter of a degree beyond a tilt, a limit is broken."""
    bare = {"screw_lead": np.zeros(6), "base_axes": None, "platform_axes": None}
    geometry = replace(load_geometry("example_6_6"), **bare)
    found = overview(geometry, cells=8)
    assert report(found) == Path(__file__).with_name("overview.txt").read_text("utf-8").rstrip()
    tilts = np.radians([[-90.0, 89.9], [-1.0, 0.0], [-2.0, 3.0]])
    assert _tilt_text(tilts) == "x -90.0 or more … +89.9°, y -1.0 … +0.0°, z -2.0 … +3.0°"
    home = geometry.tool_pose(geometry.home)
    np.testing.assert_allclose(4.0 * np.degrees(found.tilts), np.rint(4.0 * np.degrees(found.tilts)), atol=1e-9)
    level = overview(unit(), cells=8)
    assert level.campaign is level.box
    for axis, (backward, forward) in enumerate(found.tilts):
        assert backward < 0.0 < forward
        for angle, within in ((forward, True), (forward + np.radians(0.26), False), (backward, True)):
            turned = Pose.from_angles(np.zeros(3), angle * np.eye(3)[axis])
            assert (refused(geometry, home.position, home.rotation @ turned.rotation) is None) == within


def test_a_campaign_yaml_of_ones_own_is_used_with_a_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    text = "box_mm: [[-20, -10, 300], [30, 40, 350]]\ncell_mm: 50\nstep_mm: 10\ninstrument: 1-D\n"
    Path("campaign.yaml").write_text(f"format: hexapod_comp/campaign\nversion: 1\n{text}", encoding="utf-8")
    used = results.load_campaign(argparse.Namespace(campaign=None), load_geometry("example_6_6"))
    assert used.box.tolist() == [[-0.02, -0.01, 0.3], [0.03, 0.04, 0.35]]
    assert "your file campaign.yaml is used, not the shipped one" in capsys.readouterr().err
