"""Error budgets: what a file may say, and which single errors come of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from strategies import PAPER_FILE

from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure, solve_pose, strut_lengths
from hexapod_comp.pose import Pose
from hexapod_comp.workspace.budget import (
    BASE_JOINT,
    LENGTH,
    PLATFORM_JOINT,
    SOURCE_TYPES,
    TOOL,
    Budget,
    SingleErrors,
    load_budget,
)
from hexapod_comp.workspace.effects import effects

HEAD = "format: hexapod_comp/error_budget\nversion: 1\nmachine: positioning_unit\n"


def unit() -> HexapodGeometry:
    return load_geometry(PAPER_FILE.with_name("positioning_unit.yaml"))


def made(**sizes: float) -> SingleErrors:
    return Budget("positioning_unit", sizes).single_errors(unit())


def read(folder: Path, text: str) -> Budget:
    path = folder / "budget.yaml"
    path.write_text(text, encoding="utf-8")
    return load_budget(path)


# What a budget makes.


def test_the_shipped_budget_has_the_papers_sizes() -> None:
    """004, chapter 3: pitch ±20 µm, joints ±10 µm, quantisation ±7 µm; six struts, 36 coordinates, six struts."""
    budget = load_budget(config_file("error_budget"))
    errors = budget.single_errors(unit())
    assert len(errors) == 48
    assert len(set(zip(errors.kind, errors.labels, strict=True))) == 48  # type and label name one error
    counts = dict(zip(errors.kinds, np.bincount(errors.kind), strict=True))
    assert counts == {
        "screw pitch": 6,
        "quantisation": 6,
        "base joint x/y": 12,
        "base joint z": 6,
        "platform joint x/y": 12,
        "platform joint z": 6,
    }
    sizes = {title: np.linalg.norm(errors.vector[errors.kind == k], axis=1) for k, title in enumerate(errors.kinds)}
    np.testing.assert_allclose(sizes.pop("screw pitch"), 20e-6, rtol=1e-12)
    np.testing.assert_allclose(sizes.pop("quantisation"), 7e-6, rtol=1e-12)
    for size in sizes.values():
        np.testing.assert_allclose(size, 10e-6, rtol=1e-12)


def test_every_type_names_what_it_moves() -> None:
    """Lengths by strut, joints by strut and axis, the tool by axis; a coordinate's error is along its own axis."""
    errors = made(**{source.name: 1e-5 for source in SOURCE_TYPES})
    assert len(errors) == 6 * 6 + 12 + 6 + 12 + 6 + 3
    for part, struts, vector, label in zip(errors.part, errors.struts, errors.vector, errors.labels, strict=True):
        strut = int(struts.argmax())
        assert struts.sum() == (part != TOOL)
        if part == LENGTH:
            assert label == f"strut_{strut + 1}"
            continue
        axis = "xyz"[int(np.flatnonzero(vector)[0])]
        np.testing.assert_allclose(np.sort(vector), [0.0, 0.0, 1e-5], rtol=1e-12)
        body = {BASE_JOINT: f"base joint {strut + 1}", PLATFORM_JOINT: f"platform joint {strut + 1}", TOOL: "tool"}
        assert label == f"{body[part]} {axis}"


def test_a_ball_joint_that_two_struts_share_is_one_joint() -> None:
    """As in ``assess`` and ``fit``: three platform joints of the papers' machine, unless they are asked for apart."""
    paper, sizes = load_geometry(PAPER_FILE), {"platform_joint_xy": 1e-5, "base_joint_z": 1e-5}
    shared = Budget("paper", sizes).single_errors(paper)
    platform = shared.part == PLATFORM_JOINT
    along_x = [label for label in shared.labels if label.endswith("x")]
    assert along_x == [f"platform joint {pair} x" for pair in ("1/2", "3/4", "5/6")]
    assert (shared.struts[platform].sum(axis=1) == 2).all()
    assert (shared.struts.sum(axis=1)[~platform] == 1).all()
    assert len(shared) == 3 * 2 + 6
    apart = Budget("paper", sizes).single_errors(paper, shared_platform_joints=False)
    assert len(apart) == 6 * 2 + 6
    assert (apart.struts.sum(axis=1) == 1).all()


def test_a_strut_is_off_by_half_its_backlash() -> None:
    """Play b lets the strut stand b/2 to either side of the middle; what the effect is to that, 004 has no row for."""
    np.testing.assert_allclose(made(backlash=8e-6).vector, made(strut_length=4e-6).vector, rtol=1e-12)


@pytest.mark.parametrize(("name", "relative_to_home"), [("thermal_growth", False), ("screw_pitch_slope", True)])
def test_slopes_act_on_the_strut_and_on_its_way_from_home(name: str, relative_to_home: bool) -> None:
    """Against the certified forward kinematics, told the length that such a strut really has.

    Both solve the loops to about 1e-13 m; the effect is some ten micrometres.
    """
    geometry, size = unit(), 2e-4
    structure = Structure.of(geometry)
    pose = geometry.home @ Pose.from_angles([0.02, -0.015, 0.01], [0.03, -0.02, 0.05])
    nominal, home = strut_lengths(structure, pose), strut_lengths(structure, geometry.home)
    found = effects(geometry, made(**{name: size}), pose.position[None], pose.rotation)[0, :, 0]
    tip = (pose @ geometry.tool).position
    for strut in range(6):
        real = nominal.copy()
        real[strut] += size * (nominal[strut] - (home[strut] if relative_to_home else 0.0))
        actual = (solve_pose(structure, real, pose) @ geometry.tool).position
        assert found[strut] == pytest.approx(np.linalg.norm(actual - tip), abs=1e-11)
    assert found.max() > 1e-6  # not nothing beside nothing


def test_selecting_and_scaling_keep_the_rest() -> None:
    errors = made(screw_pitch=20e-6, tool_offset=5e-6)
    tool = errors.select(errors.part == TOOL)
    assert tool.labels == ("tool x", "tool y", "tool z")
    assert tool.kinds == errors.kinds
    assert len(errors.select(np.zeros(len(errors), dtype=bool))) == 0
    scaled = errors.scaled(np.array([1.0, 3.0]))
    np.testing.assert_array_equal(scaled.vector[:6], errors.vector[:6])
    np.testing.assert_allclose(scaled.vector[6:], 3.0 * errors.vector[6:], rtol=1e-15)


# What a file may say.


def test_units_are_read_from_the_keys(tmp_path: Path) -> None:
    """1 ppm is 1e-6, 0.5 % is 5e-3, 0.0004 in is 10.16 µm: definitions. Types stand in one order, the code's."""
    sizes = "tool_offset_um: 5, thermal_growth_ppm: 120, screw_pitch_slope_percent: 0.5, strut_length_in: 0.0004"
    budget = read(tmp_path, f"{HEAD}errors: {{{sizes}}}\n")
    assert list(budget.sizes) == ["strut_length", "screw_pitch_slope", "thermal_growth", "tool_offset"]
    np.testing.assert_allclose(list(budget.sizes.values()), [10.16e-6, 5e-3, 120e-6, 5e-6], rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "is empty"),
        (HEAD, "errors: is missing"),
        (HEAD.replace("machine: positioning_unit\n", "") + "errors: {screw_pitch_um: 20}", "machine: is missing"),
        (HEAD.replace("error_budget", "geometry") + "errors: {screw_pitch_um: 20}", "format: must be"),
        (HEAD.replace("version: 1", "version: 2") + "errors: {screw_pitch_um: 20}", "version: only version 1"),
        (HEAD + "errors: {screw_pitch_um: 20}\nnote: x\n", "note"),
        (HEAD + "errors: {screw_pitch_um: 20", "is not valid YAML"),
    ],
)
def test_a_file_that_is_no_budget_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(InputFileError, match=rf"budget\.yaml: .*{complaint}"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("sizes", "key"),
    [({}, "errors"), ({"wobble": 1e-6}, "errors.wobble"), ({"backlash": float("nan")}, "errors.backlash")],
)
def test_a_budget_made_in_python_is_checked_too(sizes: dict[str, float], key: str) -> None:
    with pytest.raises(ModelError) as caught:
        Budget("positioning_unit", sizes)
    assert caught.value.key == key
