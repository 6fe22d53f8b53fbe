"""Mutated files: each is read as what stands in it, or refused in words for people; never anything else.

Truth: for YAML, the tree of nodes with every leaf's text, read by Decimal and the units' definitions (fuzzing.py);
for CSV and the laser's text, splitting by hand; for strut lengths, the closed form of the paper's machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from fuzzing import Refused, cases, document, edits, finite, mutated, number_of, numbers_of, quantity, reader_of, same
from hypothesis import example, given
from scipy.spatial.transform import Rotation
from strategies import paper_geometry, random_model, skewed_geometry

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import HexapodError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.machine.region import Region
from hexapod_comp.measurements.campaign import load_campaign
from hexapod_comp.workspace.budget import load_budget

CONFIG = Path(__file__).resolve().parents[2] / "config"
PAPER = paper_geometry()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def put(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


# Geometry.


def general_geometry() -> bytes:
    """Return the file of a machine with everything that a geometry file may hold."""
    machine = skewed_geometry(0.01)

    def rows(values: np.ndarray | None, scale: float = 1.0) -> list:
        assert values is not None
        return (values * scale).round(6).tolist()

    tree = {
        "format": "hexapod_comp/geometry",
        "version": 1,
        "machine": "general",
        "base": {"joints_mm": rows(machine.base_joints, 1e3), "joint_axes": rows(machine.base_axes)},
        "platform": {"joints_in": rows(machine.platform_joints, 1 / 0.0254), "joint_axes": rows(machine.platform_axes)},
        "home": {"position_m": [0.01, -0.02, 0.42], "rotation_deg": [2, -3, 4]},
        "tool": {"position_mm": [1, 2, 30], "rotation_mrad": [10, 0, -20]},
        "work": {"position_mm": [0, 5, -40], "rotation_deg": [0, 0, 90]},
        "screw": {"lead_mm": [10, 10, 10, 5, 5, 0]},
        "limits": {
            "stroke_mm": [[200, 900 + i] for i in range(6)],
            "base_cone_deg": [80, 81, 82, 83, 84, 85],
            "platform_cone_rad": 1.5,
            "condition_number": 20,
            "correction_um": 2000,
            "step_mm": 2,
            "speed_m_min": 15,
        },
    }
    tree["base"]["cone_axes"] = [[0, 0, 2 + i] for i in range(6)]  # type: ignore[index]
    return yaml.safe_dump(tree, default_flow_style=None, sort_keys=False).encode()


GEOMETRIES = ((CONFIG / "paper.yaml").read_bytes(), (CONFIG / "positioning_unit.yaml").read_bytes(), general_geometry())


def same_pose(pose: Any, tree: dict[str, Any] | None) -> None:
    """Check a pose against its section: R = Ry(β)·Rx(α)·Rz(γ), from SciPy's intrinsic Euler angles."""
    if tree is None:
        tree = {"position_m": ["0"] * 3}
    same(pose.position, quantity(tree, "position", "length"))
    alpha, beta, gamma = quantity(tree, "rotation", "angle", np.zeros(3))
    turn = Rotation.from_euler("YXZ", [beta, alpha, gamma]).as_matrix()
    # Angles of many turns: SciPy and NumPy reduce them alike to within rounding of the angle itself.
    np.testing.assert_allclose(pose.rotation, turn, atol=1e-12 + 4e-16 * max(abs(alpha), abs(beta), abs(gamma)))


def same_geometry(found: HexapodGeometry, tree: dict[str, Any]) -> None:
    """Check a geometry against its file."""
    assert found.name == tree["machine"]
    if "paper_dimensions" in tree and "base" not in tree:
        a, b, d = (quantity(tree["paper_dimensions"], key, "length") for key in "abd")
        corners = np.linalg.norm(np.diff(found.base_joints[[5, 0, 1, 2]], axis=0), axis=1)
        np.testing.assert_allclose(corners, [d, b, d], rtol=1e-12, atol=1e-15)
        side = np.linalg.norm(found.platform_joints[0] - found.platform_joints[2])
        np.testing.assert_allclose(side, a, rtol=1e-12, atol=1e-15)
    for body, joints, axes, cones in (
        ("base", found.base_joints, found.base_axes, found.base_cone_axes),
        ("platform", found.platform_joints, found.platform_axes, found.platform_cone_axes),
    ):
        section = tree.get(body, {})
        if "paper_dimensions" not in tree:
            same(joints, quantity(section, "joints", "length"))
        for key, vectors in (("joint_axes", axes), ("cone_axes", cones)):
            if key in section:
                given = numbers_of(section[key])
                np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-12)
                sizes = np.linalg.norm(given, axis=1)[:, None]
                np.testing.assert_allclose(vectors * sizes, given, rtol=1e-9, atol=1e-12)
    for name in ("home", "tool", "work"):
        same_pose(getattr(found, name), tree.get(name))
    limits = tree["limits"]
    same(found.limits.stroke, quantity(limits, "stroke", "length"))
    same(found.limits.base_cone, quantity(limits, "base_cone", "angle"))
    same(found.limits.platform_cone, quantity(limits, "platform_cone", "angle"))
    same(found.limits.condition, numbers_of(limits["condition_number"]))
    for name, kind in (("correction", "length"), ("step", "length"), ("speed", "speed")):
        same(getattr(found.limits, name), quantity(limits, name, kind))
    same(found.limits.clearance, quantity(limits, "clearance", "length", 0.0))
    same(found.screw_lead, quantity(tree["screw"], "lead", "length") if "screw" in tree else 0.0)


def works_or_refuses(geometry: HexapodGeometry, model: MachineModel) -> None:
    """Check that a machine that was accepted gives commands within its limits, or refuses: home and beside it."""
    try:
        compensator = Compensator(geometry, model)
    except HexapodError:
        return
    home = geometry.tool_pose(geometry.home)
    for time in range(2):
        try:
            found = compensator.correct(home, 0.1 * time)
        except HexapodError:
            continue
        stroke = geometry.limits.stroke
        finite(found.command, found.nominal, found.correction)
        assert (found.command >= stroke[:, 0]).all()
        assert (found.command <= stroke[:, 1]).all()
        assert np.abs(found.correction).max() <= geometry.limits.correction
        home_lengths = np.linalg.norm(
            geometry.home.position + geometry.platform_joints @ geometry.home.rotation.T - geometry.base_joints, axis=1
        )
        # Through work and tool and back: their size is what rounds.
        size = max(1.0, np.abs(geometry.work.position).max(), np.abs(geometry.tool.position).max())
        np.testing.assert_allclose(found.command - found.correction, home_lengths, atol=1e-14 * size + 1e-12)


@pytest.mark.parametrize("seed", range(len(GEOMETRIES)))
@given(changes=edits)
@example(changes=[])
@cases(60, 0.07)
def test_geometry(folder: Path, seed: int, changes: list) -> None:
    data = mutated(GEOMETRIES[seed], changes)
    path = put(folder, "geometry.yaml", data)
    try:
        with reader_of("geometry", path):
            found = load_geometry(path)
    except Refused:
        assert changes
        return
    same_geometry(found, document(data))
    works_or_refuses(found, MachineModel(found.name))


# Models.


def models(folder: Path) -> list[bytes]:
    """Return the file of a model with everything, and one as people write it."""
    rng = np.random.default_rng(6)
    full = random_model(rng, "paper")
    origin = ModelOrigin("2026-01-31", (("laser.csv", "0" * 64),), 4.2e-6, "a note")
    grid = np.array([-0.2, 0.2])
    lines = tuple(rng.uniform(-2e-5, 2e-5, (2, 2, 2, 6, 2)).round(9) for _ in range(3))
    small = type(full.field)((grid, grid, grid + 0.5), lines, [0.01, 0.0, -0.1])  # type: ignore[arg-type]
    box = np.array([[-0.2, -0.2, 0.3], [0.2, 0.2, 0.6]])
    values = {name: getattr(full, name) for name in ("base_deviation", "platform_deviation", "struts")}
    model = MachineModel(
        "paper",
        "full",
        origin=origin,
        field=small,
        region=Region(box, np.array([0.01, 0.0, -0.1]), np.array([0.1, 0.0, 0.2]), np.array([0.1, -0.2, 0.3])),
        base_expansion=11e-6,
        **values,
    )
    save_model(model, folder / "full.yaml")
    by_hand = """format: hexapod_comp/model
version: 1
machine: paper
name: by hand
date: 2026-01-31
sources: []
struts:
  offset_um: [1, -2, 3, 4, 5, 6]
  pitch_ppm: 20
  reference_length_in: 20
  backlash_um: 4
  expansion_ppm_per_K: 11.7
  wave:
    cosine_um: 3
    period_mm: 5
  map:
    knots_mm: [330, 600, 880]
    values_um: [[0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2]]
    backlash_um: [[0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2]]
thermal:
  platform_expansion_ppm_per_K: 23
"""
    return [(folder / "full.yaml").read_bytes(), by_hand.encode()]


@pytest.fixture(scope="module")
def model_seeds(folder: Path) -> list[bytes]:
    return models(folder)


def same_model(found: MachineModel, tree: dict[str, Any]) -> None:
    """Check a model against its file."""
    assert (found.machine, found.name) == (tree["machine"], tree["name"])
    assert found.origin.date.replace("T", " ")[:10] == tree["date"][:10]
    assert found.origin.sources == tuple((s["file"], s["sha256"]) for s in tree["sources"])
    same(found.reversal_threshold, quantity(tree, "reversal_threshold", "length", 0.2e-6))
    if found.region is not None:
        region = tree["region"]
        for name, value in (("box", found.region.box), ("point", found.region.point)):
            same(value, quantity(region, name, "length", 0.0))
        same(found.region.position, quantity(region, "position", "length", 0.0))
    if found.origin.held_out_residual is not None:
        same(found.origin.held_out_residual, quantity(tree, "held_out_residual", "length"))
    for name in ("base_deviation", "platform_deviation"):
        same(getattr(found, name), quantity(tree.get("structure", {}), name, "length", 0.0))
    for name in ("base_expansion", "platform_expansion"):
        same(getattr(found, name), quantity(tree.get("thermal", {}), name, "expansion", 0.0))
    struts = tree.get("struts", {})
    for name, kind in (("offset", "length"), ("pitch", "ratio"), ("backlash", "length"), ("expansion", "expansion")):
        same(getattr(found.struts, name), quantity(struts, name, kind, 0.0))
    same(found.struts.reference_length, quantity(struts, "reference_length", "length", 0.0))
    wave = struts.get("wave", {"period_m": None})
    for name in ("cosine", "sine"):
        same(getattr(found.struts, name)[:, 0], quantity(wave, name, "length", 0.0))
    if "wave" in struts:
        same(found.struts.period, quantity(wave, "period", "length"))
    if "map" in struts:
        same(found.struts.map_knots, quantity(struts["map"], "knots", "length"))
        same(found.struts.map_values, quantity(struts["map"], "values", "length"))
        same(found.struts.map_backlash, quantity(struts["map"], "backlash", "length", 0.0))
    if "field" in tree:
        same_field(found.field, tree["field"])


def same_field(found: Any, tree: dict[str, Any]) -> None:
    """Check a field against its section: every coefficient of every line, and nothing else."""
    for axis, nodes in zip("xyz", found.grid, strict=True):
        same(nodes, quantity(tree, f"grid_{axis}", "length"))
    same(found.probe, quantity(tree, "probe", "length", np.zeros(3)))
    same(found.reversal_threshold, quantity(tree, "reversal_threshold", "length", 10e-6))
    assert found.outside == tree.get("outside", "hold")
    expected = [np.zeros(family.shape) for family in found.lines]
    for line in tree["lines"]:
        family = expected["xyz".index(line["axis"])]
        ways = {"forward": [0], "backward": [1], "both": [0, 1]}[line["direction"]]
        for component, name in enumerate(("dx", "dy", "dz", "rx", "ry", "rz")):
            row = quantity(line, name, "length" if component < 3 else "angle", ())
            for way in ways:
                family[way, int(line["at"][0]), int(line["at"][1]), component, : len(row)] = row
    for family, read in zip(expected, found.lines, strict=True):
        same(read, family)


@pytest.mark.parametrize("seed", range(2))
@given(changes=edits)
@example(changes=[])
@cases(60, 0.06)
def test_model(folder: Path, model_seeds: list[bytes], seed: int, changes: list) -> None:
    data = mutated(model_seeds[seed], changes)
    path = put(folder, "model.yaml", data)
    try:
        with reader_of("model", path):
            found = load_model(path, PAPER)
    except Refused:
        assert changes
        return
    same_model(found, document(data))
    works_or_refuses(PAPER, found)


# Campaigns and budgets.


@given(changes=edits)
@example(changes=[])
@cases(60, 0.05)
def test_campaign(folder: Path, changes: list) -> None:
    data = mutated((CONFIG / "campaign_full.yaml").read_bytes(), changes)
    path = put(folder, "campaign.yaml", data)
    try:
        with reader_of("campaign", path):
            found = load_campaign(path)
    except Refused:
        assert changes
        return
    tree = document(data)
    same(found.box, quantity(tree, "box", "length"))
    for name, default in (("cell", None), ("step", None), ("repeatability", 0.0)):
        same(getattr(found, name), quantity(tree, name, "length", default))
    for name, default in (("tilt", 0.0), ("beam_slope", 100e-6)):
        same(getattr(found, name), quantity(tree, name, "angle", default))
    for name, default in (("diagonals", "0"), ("cycles", "1"), ("poses", "0")):
        assert getattr(found, name) == number_of(tree.get(name, default))
    assert (found.instrument or "none") == tree.get("instrument", "none")
    noise = tree.get("noise", {"": None})
    kinds = [("linear", 1e-6), ("straightness", 1e-6), ("rotation", 1e-6), ("position", 10e-6), ("attitude", 10e-6)]
    kinds += [("length", 1e-6), ("displacement", 1e-6)]
    for sigma, (name, default) in zip(found.noise, kinds, strict=True):
        same(sigma, quantity(noise, name, "angle" if name in ("rotation", "attitude") else "length", default))


@given(changes=edits)
@example(changes=[])
@cases(60, 0.04)
def test_budget(folder: Path, changes: list) -> None:
    data = mutated((CONFIG / "error_budget.yaml").read_bytes(), changes)
    path = put(folder, "budget.yaml", data)
    try:
        with reader_of("budget", path):
            found = load_budget(path)
    except Refused:
        assert changes
        return
    tree = document(data)
    assert found.machine == tree["machine"]
    assert len(found.sizes) == len(tree["errors"])
    for name, size in found.sizes.items():
        kind = "ratio" if name in ("screw_pitch_slope", "thermal_growth") else "length"
        same(size, quantity(tree["errors"], name, kind))
