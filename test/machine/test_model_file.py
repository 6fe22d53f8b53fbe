"""Model files: written models read back, files mean what their keys say, doubtful files are refused."""

from __future__ import annotations

import contextlib
import functools
import operator
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path

import make_example_models as tool
import numpy as np
import pytest
import yaml
from helpers import assert_defaults, assert_equal, beside, places, put
from strategies import UNEVEN_GRID, paper_geometry, random_field, random_model, skewed_geometry, whole_model

from hexapod_comp.calibration.evaluation import evaluate_model
from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.machine.field import CROSS_AXES, GridField
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import Datum, MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import load_model, model_text, parse_model, read_load, save_model, terms_text
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.machine.region import Region
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import LateGrowth
from hexapod_comp.pose import Pose

PAPER, SKEWED = paper_geometry(), skewed_geometry()
DIGEST = "0123456789abcdef" * 4
ORIGIN = ModelOrigin("2026-01-31", (("laser x.csv", DIGEST), ("ballbar.csv", "f" * 64)), 4.2e-6, "Größe: 4 µm")
DATUM, LOAD = Datum((0.1, 0.2, 0.4), (0.3, -0.2, 0.1), 4), (0.01, 0.02, 0.03, 0.1, -9.7, 1.0)
ROOT = Path(__file__).parents[2]

TEXTS = beside(__file__)
BY_HAND = TEXTS["by hand"]


def load(folder, text, geometry=PAPER):
    path = folder / "model.yaml"
    path.write_text(text, encoding="utf-8")
    return load_model(path, geometry)


def there_and_back(model, folder, geometry):
    save_model(model, folder / "there.yaml")
    return load_model(folder / "there.yaml", geometry)


# Written and read back


def test_a_model_comes_back(tmp_path):
    """The truth is the model that was saved, with one rounding per number, 2.2e-16."""
    rng = np.random.default_rng(0)
    box = np.sort(rng.uniform(-1.0, 1.0, (2, 3)), axis=0)
    nodes = np.radians([0.0, 20.0, 90.0]), np.radians([-90.0, 45.0])
    values = rng.uniform(-5e-5, 5e-5, (2, 6, 3))
    model = replace(
        whole_model(rng, "skewed"),
        outside=OutsideTable(("elevation", "rotation"), ("deg", "deg"), nodes, *values, "refuse"),
        region=Region(box, rng.uniform(-0.1, 0.1, 3), *rng.uniform(-1.0, 1.0, (2, 3))),
        origin=replace(ORIGIN, posterior=("there.npz", "a" * 64), datum=DATUM, loads=((5.0, *LOAD), (0.0, *LOAD))),
    )
    once = there_and_back(model, tmp_path, SKEWED)
    assert_equal(once, model, relative=2.3e-16)
    first = (tmp_path / "there.yaml").read_text(encoding="utf-8")
    assert_equal(there_and_back(once, tmp_path, SKEWED), once)  # a second time all numbers are exact
    assert (tmp_path / "there.yaml").read_text(encoding="utf-8") == first
    keys = [line.split(":")[0] for line in first.splitlines() if line[0] not in " -"]
    opening = "format version closed machine name date sources region held_out_residual_um note posterior datum"
    loads = ["measured_loads", "reversal_threshold_um"]
    assert keys == [*opening.split(), *loads, "structure", "struts", "thermal", "field", "load", "outside", "end"]


def test_a_datum_is_stated_in_mm_and_degrees():
    """Without a minus before zeros."""
    datum = Datum.at(Pose.from_angles([0.1, -0.0, 0.4], [-0.0, 0.0, np.pi / 6]), 4)
    assert str(datum) == "fixes 4 of 6 degrees of freedom; platform at 100, 0, 400 mm, 0, 0, 30° in base"


def _families(*powers):
    return tuple(
        np.zeros((2, len(UNEVEN_GRID[a]), len(UNEVEN_GRID[b]), 6, k))
        for (a, b), k in zip(CROSS_AXES, powers, strict=True)
    )


@pytest.mark.parametrize(
    "field",
    [
        pytest.param(GridField(UNEVEN_GRID, _families(0, 0, 0), outside="refuse"), id="a box without lines"),
        pytest.param(GridField(UNEVEN_GRID, _families(0, 2, 0)), id="a family of zeros"),
        pytest.param(random_field(np.random.default_rng(3), powers=9, probe=[0, 0, -0.15]), id="nine powers"),
    ],
)
def test_fields_come_back(tmp_path, field):
    model = MachineModel("paper", field=field, origin=ORIGIN)
    assert_equal(there_and_back(model, tmp_path, PAPER), model, relative=2.3e-16)


def test_the_papers_field_is_sparse_and_equal_directions_are_said_once():
    """A 1-D laser's lines carry one component each; if forward equals backward, one line has both."""
    lines = _families(3, 0, 0)
    lines[0][:, :, :, 0] = np.random.default_rng(1).normal(size=lines[0][:, :, :, 0].shape) * 1e-5
    lines[0][1, 0, 0] = lines[0][0, 0, 0]
    text = model_text(MachineModel("paper", field=GridField(UNEVEN_GRID, lines), origin=ORIGIN))
    written = yaml.safe_load(text)["field"]["lines"]
    assert all(set(line) == {"axis", "at", "direction", "dx_um"} for line in written)
    assert [line["direction"] for line in written] == ["both"] + ["forward", "backward"] * 8


def test_round_numbers_stay_round_and_nothing_is_written_of_an_ideal_block():
    """The truth is the text that a person would write: 0.35 m is 350 mm, not 349.99999999999994."""
    struts = StrutErrors(offset=np.full(6, 12.3e-6), pitch=np.arange(6) / 1e6, sine=np.full(6, 1e-7))
    grid = (np.array([-0.2, 0.1]), np.array([-0.15, 0.3]), np.array([0.35, 0.55]))
    lines = tuple(np.zeros((2, 2, 2, 6, 0)) for _ in range(3))
    text = model_text(MachineModel("paper", struts=struts, field=GridField(grid, lines), origin=ORIGIN))
    for line in (
        "  offset_um: 12.3\n",
        "  pitch_ppm: [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]\n",
        "    sine_um: 0.1\n",
        "    period_mm: 10.0\n",
        "  grid_z_mm: [350.0, 550.0]\n",
        "held_out_residual_um: 4.2\n",
        "Größe: 4 µm",
    ):
        assert line in text
    assert not {"structure", "thermal", "load", "outside", "region"} & set(yaml.safe_load(text))
    assert "field" not in yaml.safe_load(model_text(MachineModel("paper", origin=ORIGIN)))


# Reading


def test_a_file_written_by_hand(tmp_path):
    """The truth is the numbers in BY_HAND times their units; missing or short lists are filled with zeros."""
    model = load(tmp_path, BY_HAND)
    date = "2026-01-31T12:30:00+01:00"
    assert_equal(model.origin, ModelOrigin(date, (("laser.csv", DIGEST),), 4.2e-6), relative=3e-16)
    assert (model.machine, model.name, model.reversal_threshold) == ("paper", "by hand", 3e-6)
    assert_equal(model.region, Region(np.array([[-0.2, -0.2, 0.35], [0.2, 0.2, 0.55]])))
    np.testing.assert_array_equal(model.base_deviation[[0, 5]], [[1e-6, 2e-6, 3e-6], [-4e-6, 5.5e-6, 0]])
    assert not model.platform_deviation.any()
    zero, six = np.zeros(6), np.arange(1.0, 7.0)
    wanted = StrutErrors(
        offset=1e-5 * six,
        pitch=np.full(6, 12e-6),
        reference_length=np.full(6, 0.508),
        backlash=np.full(6, 1e-5),
        expansion=np.full(6, 11.7e-6),
        cosine=1e-6 * np.array([zero, six, zero, zero + 1.0]).T,
        sine=1e-6 * np.array([zero + 2.0, zero + 0.5, zero, zero]).T,
        period=np.array([0.005] * 5 + [0.004]),
        map_knots=np.array([0.33, 0.88]),
        map_values=1e-6 * np.outer(six, [0.0, 1.0]),
        map_backlash=np.outer([3e-6, 0, 0, 0, 0, 0], [0.0, 1.0]),
    )
    assert_equal(model.struts, wanted, relative=1e-15)
    assert (model.base_expansion, model.platform_expansion) == (0.0, 23.1e-6)
    late = np.where(np.arange(8)[:, None] == 6, [12e-6, 13e-6], 0.0)
    assert_equal(model.late_growth, LateGrowth((600.0, 7200.0), late, "base"), relative=1e-15)
    assert_equal(model.load, Load(np.full(6, 20e6), mass=12.5, centre=np.array([0.001, 0.002, 0.03])), relative=1e-15)
    table = OutsideTable(
        ("elevation",), ("deg",), (np.array([0.0, np.pi / 2]),), 1e-6 * np.outer([10.0, 40.0], [0.0, 0.0, -1.0]),
        np.outer([0.0, 5e-6], [1.0, 0.0, 0.0]), "refuse",
    )  # fmt: skip
    assert_equal(model.outside, table, relative=1e-15, absolute=1e-30)
    field = model.field
    np.testing.assert_allclose(field.grid[1], [-0.2032, 0.2032], rtol=1e-15)
    np.testing.assert_array_equal(field.grid[2], [0.35, 0.4, 0.55])
    np.testing.assert_array_equal(field.probe, [0, 0, -0.1])
    assert field.outside == "hold"
    assert [family.shape for family in field.lines] == [(2, 2, 3, 6, 0), (2, 2, 3, 6, 0), (2, 2, 2, 6, 3)]
    truth = np.zeros((2, 2, 2, 6, 3))
    truth[:, 0, 0, 2] = [1e-6, 2e-6, 3e-6]
    truth[:, 0, 0, 3, 0] = 7e-6
    truth[1, 0, 1, 2, 0] = 1e-6
    np.testing.assert_array_equal(field.lines[2], truth)


# Refusals, which name file, key and value


def test_an_unknown_key_is_refused_in_every_mapping_of_a_file(tmp_path):
    """A misspelt key must nowhere be ignored; a lost motion below zero is for fits, not for a person's load file."""
    tree = yaml.safe_load(BY_HAND) | {"posterior": {"file": "there.npz", "sha256": DIGEST}}
    tree |= {"datum": {"position_mm": [1, 2, 3], "held": 4}}
    tree |= {"measured_loads": [{"mass_kg": 1, "centre_mm": [1, 2, 3], "gravity_m_s2": [0, 0, -9.8]}]}
    for at in places(tree):
        if isinstance(part := functools.reduce(operator.getitem, at, tree), dict):
            text = yaml.safe_dump(put(tree, at, {**part, "wobble": 1}))
            with pytest.raises(InputFileError, match="wobble: is not a known key here"):
                parse_model(text, "paper")
    path = tmp_path / "load.yaml"
    for line, said in (
        ("lost_motion_um: -1", "lost_motion_um: must not be negative"),
        ("wobble: 1", "not a known"),
    ):
        path.write_text(f"format: hexapod_comp/load\nversion: 1\nstiffness_N_per_um: 20\n{line}\n")
        with pytest.raises(InputFileError, match=said):
            read_load(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    TEXTS["refused"],
)
def test_refused(tmp_path, old, new, said):
    assert old in BY_HAND
    with pytest.raises(InputFileError) as caught:
        load(tmp_path, BY_HAND.replace(old, new, 1))
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "model.yaml"))
    for part in said:
        assert part in message[len(str(tmp_path)) :]


def test_many_nodes_with_few_lines_take_no_memory(tmp_path):
    """2,000 nodes in each direction would need 1 GB of coefficients, but the missing lines are found first."""
    nodes = str(list(range(2000)))
    text = BY_HAND.replace("grid_x_mm: [-200, 200]", f"grid_x_mm: {nodes}").replace("y_in: [-8, 8]", f"y_mm: {nodes}")
    tracemalloc.start()
    try:
        with pytest.raises(InputFileError, match="is missing"):
            load(tmp_path, text)
        assert tracemalloc.get_traced_memory()[1] < 1e8
    finally:
        tracemalloc.stop()


# Writing


def test_a_model_without_provenance_is_not_written(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text("the old one")
    for origin, said in (
        (ModelOrigin(), "date: must be ISO 8601"),
        (ModelOrigin("2026-01-31", (("x.csv", "abc"),)), r"sources\[0\].sha256.*64.*x.csv.*abc"),
        (ModelOrigin("2026-01-31", (), np.nan), "held_out_residual.*nan"),
    ):
        with pytest.raises(ModelError, match=said):
            save_model(MachineModel("paper", origin=origin), path)
    assert path.read_text() == "the old one"


def test_a_model_that_cannot_be_read_is_not_written(tmp_path):
    """A fit to readings without thermometers on five struts found 1227 ppm/K; nobody could load its file."""
    late = LateGrowth((600.0,), np.full((8, 1), 1.2e-3))
    with pytest.raises(ModelError, match="must stay within ±1000 ppm per K"):
        save_model(MachineModel("paper", late_growth=late, origin=ORIGIN), tmp_path / "model.yaml")
    assert not list(tmp_path.iterdir())


def test_names_of_every_kind_come_back():
    """Names that YAML would read as something else stay text."""
    for word in ("no", "1.5", "null", "2026-01-31", "a: b", "- x", "#1", "0400", "é µ 漢", "'", '"', "!x", "&a", "*b"):
        model = MachineModel("paper", word, origin=ModelOrigin("2026-01-31", ((word, DIGEST),), None, word))
        assert_equal(parse_model(model_text(model), "paper"), model)


def test_a_file_cut_off_anywhere_is_refused():
    """Every block is optional, so a file cut off at fifteen places, some at line ends, might read without an error."""
    text = model_text(replace(random_model(np.random.default_rng(5), "paper"), origin=ORIGIN))
    ends = [number for number, letter in enumerate(text[:-1]) if letter == "\n"]
    places = {*np.linspace(1, len(text) - 2, 9, dtype=int), *np.random.default_rng(6).choice(ends, 6), ends[-1]}
    accepted = []
    for place in sorted(places):
        with contextlib.suppress(InputFileError):
            parse_model(text[:place], "paper")
            accepted.append(text[:place][-20:])
    assert accepted == []


# The documentation


def test_the_documented_table_and_example_are_the_programs():
    """If this fails: put the result of `terms_text` under "All terms". The example has only known keys."""
    page = (ROOT / "doc" / "model_file.md").read_text(encoding="utf-8")
    assert page.endswith("\n\n" + terms_text())
    text = page.split("```yaml\n")[1].split("```")[0]
    text, zeros = text.replace("closed: true", "").replace("end: true", ""), str(np.zeros((6, 3)).tolist())
    text = text.replace("64 lower-case hexadecimal digits", DIGEST)
    for key in ("base_deviation_um:", "platform_deviation_um:", "values_um:", "    backlash_um:"):
        text = re.sub(rf"{key} +#.*", f"{key} {zeros}", text)
    text = re.sub(r"late_struts_ppm_per_K: +#.*", "late_struts_ppm_per_K: " + str(np.zeros((6, 2)).tolist()), text)
    text = text.replace("at: [0, 2]", "at: [0, 0]")
    with pytest.raises(
        InputFileError, match=r"the forward line along x at \[0, 1\] is missing"
    ):  # the example shows one of 18 lines
        parse_model(text, "paper")


# Shipped models


def test_the_ideal_model_has_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ideal").write_text("no model")
    assert_equal(load_model("ideal", SKEWED), MachineModel("skewed"))
    with pytest.raises(InputFileError):  # a path is not taken as a name
        load_model(tmp_path / "ideal", SKEWED)


def test_shipped_files_are_what_the_tool_makes(tmp_path):
    """The last digit may differ by one, as another processor may round the laser lines differently."""
    tool.main(["--out", str(tmp_path)])
    for name in ("paper_machine.yaml", "paper_lines_model.yaml"):
        shipped, fresh = (yaml.safe_load((at / name).read_text("utf-8")) for at in (ROOT / "config", tmp_path))
        for content in (shipped, fresh):
            for key in ("note", "sources", "held_out_residual_um"):  # checked by the next test
                content.pop(key, None)
        assert_equal(fresh, shipped, absolute=1.01e-4)


def test_lines_model_is_worth_what_its_file_says():
    """The figures are those at the same held-out points; in the paper's own measure about 70 % is removed."""
    geometry = load_geometry("paper")
    truth, lines = (load_model(name, geometry) for name in ("paper_machine", "paper_lines_model"))
    found = evaluate_model(RealMachine(geometry, truth), lines, tool.BOX)
    assert lines.origin.held_out_residual == pytest.approx(found.after.raw.rms, abs=2e-9)
    assert found.after.raw.rms < found.before.raw.rms
    assert found.after.aligned.rms < 0.8 * found.before.aligned.rms
    assert found.paper.after < 0.3 * found.paper.before


def test_defaults():
    assert_defaults(__file__)
