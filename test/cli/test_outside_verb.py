"""``outside``, and --outside of the verbs that take a model. Truth: a table of a sag, by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hexapod_comp.cli import main
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model

Printed = pytest.CaptureFixture[str]

CSV = """elevation_deg,x_um,y_um,z_um,rx_urad,ry_urad,rz_urad
0,0,0,-10,0,0,0
90,0,0,-40,0,0,0
"""


@pytest.fixture
def bent(tmp_path: Path) -> Path:
    (tmp_path / "sag.csv").write_text(CSV)
    assert main(["outside", str(tmp_path / "sag.csv"), "--holds", "errors", "--out", str(tmp_path / "bent.yaml")]) == 0
    return tmp_path / "bent.yaml"


def raised_um(model: Path, capsys: Printed, *options: str) -> float:
    """Return by how much the tool is commanded higher at home."""
    geometry = load_geometry("paper")
    x, y, z = geometry.tool_pose(geometry.home).position * 1e3
    pose = ["--pose", f"{x!r},{y!r},{z!r}".replace("np.float64(", "").replace(")", "")]
    capsys.readouterr()
    assert main(["ik", *pose, "--model", str(model), "--json", *options]) == 0
    row = json.loads(capsys.readouterr().out)["rows"][0]
    lengths = np.array([row[f"L{n}_mm"] for n in range(1, 7)]) * 1e-3
    nominal = RealMachine(geometry, MachineModel("paper")).pose_for(lengths)[0]
    return float(nominal.position[2] - geometry.home.position[2]) * 1e6


def test_a_table_moves_the_tool_where_it_is_looked_up(bent: Path, capsys: Printed) -> None:
    assert raised_um(bent, capsys, "--outside", "elevation_deg=30") == pytest.approx(20.0, abs=1e-6)
    assert raised_um(bent, capsys) == pytest.approx(0.0, abs=1e-6)
    main(["ik", "--pose", "0,0,400", "--model", str(bent)])
    assert "table over elevation does not count: --outside says where" in capsys.readouterr().err


def test_corrections_have_the_other_sign_and_a_calibration_has_seen_some(bent: Path, capsys: Printed) -> None:
    table = ["outside", str(bent.parent / "sag.csv"), "--out", str(bent)]
    capsys.readouterr()
    assert main([*table, "--holds", "corrections", "--beyond", "refuse"]) == 0
    assert "error of up to 40.00 µm and 0.00 µrad; beyond the table: refuse" in capsys.readouterr().out
    assert raised_um(bent, capsys, "--outside", "elevation_deg=90") == pytest.approx(-40.0, abs=1e-6)
    assert main(["ik", "--pose", "0,0,400", "--model", str(bent), "--outside", "elevation_deg=91"]) == 2
    assert "elevation 91 deg: the table holds elevation 0 to 90 deg" in capsys.readouterr().err
    assert main([*table, "--holds", "errors", "--calibrated-at", "elevation_deg=60"]) == 0
    assert raised_um(bent, capsys, "--outside", "elevation_deg=60") == pytest.approx(0.0, abs=1e-6)
    assert raised_um(bent, capsys, "--outside", "elevation_deg=0") == pytest.approx(-20.0, abs=1e-6)


def test_a_table_leaves_what_a_fit_knows_of_a_model(bent: Path) -> None:
    """The hash that the posterior's file names is that of the model with a table and without."""
    geometry, out = load_geometry("paper"), bent.parent / "both.yaml"
    main(["outside", str(bent.parent / "sag.csv"), "--holds", "errors", "--model", "paper_machine", "--out", str(out)])
    text = out.read_text()
    (bent.parent / "plain.yaml").write_text(text[: text.index("\noutside:\n") + 1] + "end: true\n")
    plain, both = (load_model(bent.parent / name, geometry) for name in ("plain.yaml", "both.yaml"))
    assert both.outside.names == ("elevation",)
    assert not plain.outside.names
    assert both.origin.text_sha256 == plain.origin.text_sha256 != ""


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ("elevation_deg=90000", "the table holds elevation 0 to 90 deg; is the unit right?"),
        ("elevation_mm=3", "outside.elevation_mm: the model's table is over elevation_deg"),
        ("azimuth_deg=3", "outside.azimuth_deg: the model's table is over elevation_deg"),
    ],
)
def test_numbers_that_the_table_has_not_are_refused(bent: Path, given: str, problem: str, capsys: Printed) -> None:
    assert main(["ik", "--pose", "0,0,400", "--model", str(bent), "--outside", given]) == 2
    assert problem in capsys.readouterr().err
    assert main(["ik", "--pose", "0,0,400", "--outside", given]) == 2
    assert "the model has no table" in capsys.readouterr().err


def test_an_export_needs_to_know_where(bent: Path, capsys: Printed) -> None:
    folder = str(bent.parent / "c")
    assert main(["export", "--c", folder, "--model", str(bent)]) == 2
    assert "outside.names: cannot be exported: the C core does not know it" in capsys.readouterr().err
    assert main(["export", "--c", folder, "--model", str(bent), "--outside", "elevation_deg=45"]) == 0
    assert ".powers = {1, 0, 0}" in (bent.parent / "c" / "hexapod_model.h").read_text()
