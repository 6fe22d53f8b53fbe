"""``imagine``: errors for any geometry, within the bounds asked for, read and judged by the tests' own kinematics."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign_machines import UM, Errors, aligned_rms, machine_names, machines, tool_errors

from hexapod_comp import cli
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

# Leaves what the tests' own reader and kinematics have: structure, offsets and pitch
PLAIN = ("--wave-um", "0", "--map-um", "0", "--backlash-um", "0")


@pytest.mark.parametrize("name", machine_names())
def test_any_machine(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The figures of the report are those of the file, at random places of the box that the report names."""
    # Of 1,000 places each. Aligned errors grow towards the corners, so that squares scatter by one and a half times
    # their size: a mean square good to 4.5/√1000 = 14 %, its root to 7 %, two such 10 %.
    machine = machines()[name]
    geometry, out = machine.write(tmp_path / "machine.yaml"), tmp_path / "truth.yaml"
    bounds = ("--joints-um", "30", "--struts-um", "20", "--pitch-ppm", "100")
    words = ["imagine", "--machine", geometry, *bounds, *PLAIN, "--seed", "3", "--out", out]
    assert cli.main([str(word) for word in words]) == 0
    said = capsys.readouterr().out
    truth = Errors.read(out)
    for values, bound in (
        (truth.base, 30 * UM),
        (truth.platform, 30 * UM),
        (truth.offset, 20 * UM),
        (truth.pitch, 1e-4),
    ):
        assert 0.5 * bound < np.abs(values).max() <= bound
        assert len(np.unique(values)) > 3
    corners, raw, aligned = re.search(r"in \((.*)\) mm of work: ([\d.]+) µm RMS as it is, ([\d.]+) µm", said).groups()
    box = np.array([[float(v) * 1e-3 for v in c.split(",")] for c in corners.split(")…(")])
    tips = np.random.default_rng(8).uniform(box[0], box[1], (1000, 3))
    errors = tool_errors(machine, truth, None, tips)
    assert float(raw) * UM == pytest.approx(np.sqrt((errors**2).sum(axis=1).mean()), rel=0.1)
    assert float(aligned) * UM == pytest.approx(aligned_rms(tips, errors), rel=0.1)


def test_every_bound_ends_where_it_belongs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file's keys carry the units; each value lies within its option's bound, and only then."""
    out = tmp_path / "truth.yaml"
    words = ["--joints-um", "0", "--struts-um", "0", "--pitch-ppm", "0", "--wave-um", "2,3", "--wave-period-mm", "4"]
    words += ["--map-um", "1.5", "--backlash-um", "5,6", "--wear-um", "3", "--strut-expansion-ppm-per-k", "10,11"]
    words += ["--body-expansion-ppm-per-k", "12,13", "--field-um", "7", "--field-urad", "9"]
    words += ["--field-reversal-percent", "20", "--box", "-50,-50,360,50,50,440", "--name", "all of it"]
    assert cli.main(["imagine", *words, "--seed", "2", "--json", "--out", str(out)]) == 0
    told = json.loads(capsys.readouterr().out)
    content = yaml.safe_load(out.read_text())
    assert (content["machine"], content["name"], told["name"], told["seed"]) == ("paper", "all of it", "all of it", 2)
    struts, field = content["struts"], content["field"]
    assert "structure" not in content or not np.any(content["structure"].get("base_deviation_um", 0.0))
    assert not np.any(struts.get("offset_um", 0.0))
    model = load_model(out, load_geometry("paper"))
    amplitude = np.hypot(model.struts.cosine, model.struts.sine) / UM
    assert ((amplitude >= 2.0) & (amplitude <= 3.0)).all()
    assert model.struts.period.tolist() == [0.004] * 6
    assert np.sqrt((model.struts.map_values**2).mean(axis=1)) / UM == pytest.approx([1.5] * 6)
    wear = model.struts.map_backlash.max(axis=1) / UM
    assert ((wear > 1.4) & (wear <= 3.0)).all()  # at least half of it, between knots
    for values, low, high in (
        (struts["backlash_um"], 5.0, 6.0),
        (model.struts.expansion * 1e6, 10.0, 11.0),
        ([model.base_expansion * 1e6, model.platform_expansion * 1e6], 12.0, 13.0),
    ):
        assert ((np.array(values) >= low) & (np.array(values) <= high)).all()
    assert [field["grid_x_mm"][0], field["grid_x_mm"][-1]] == [-50.0, 50.0]
    assert [field["grid_z_mm"][0], field["grid_z_mm"][-1]] == [360.0, 440.0]
    places = np.random.default_rng(1).uniform(model.field.box[0], model.field.box[1], (300, 3))
    seen = np.array([model.field.evaluate(place, np.ones(3))[0] for place in places])
    back = np.array([model.field.evaluate(place, -np.ones(3))[0] for place in places])
    assert 0.2 * 7 * UM < np.abs(seen[:, :3]).max() <= 7.1 * UM  # scaled on a grid of nine places a side
    assert 0.2 * 9e-6 < np.abs(seen[:, 3:]).max() <= 9.1e-6
    assert np.abs(seen - back).max() > 0.1 * UM
    assert told["largest"]["backlash_um"] <= 6.0
    assert told["tool_error"]["frame"] == "work"


CAMPAIGN = """format: hexapod_comp/campaign
version: 1
box_mm: [[-30, -30, 380], [30, 30, 420]]
cell_mm: 40
step_mm: 20
instrument: 1-D
diagonals: 0
"""


@pytest.mark.parametrize(
    "command",
    [
        "ik --pose 10,20,400 --json --model",
        "fk --lengths 519.494,519.808,509.192,509.192,499.282,498.955 --json --model",
        "check table1.csv --json --model",
        "export --box -50,-50,380,50,50,420 --table {}/t.csv --json --model",
        "simulate --campaign {}/campaign.yaml --out {}/m.csv --json --truth",
        "simulate --campaign {}/campaign.yaml --out {}/m.csv --json --model",
    ],
)
def test_random_is_the_same_machine_in_every_verb(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By its name and by the file of ``imagine`` with that seed: the same answers and files, but for the name."""
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    file = tmp_path / "truth.yaml"
    assert cli.main(["imagine", "--seed", "4", "--out", str(file)]) == 0
    capsys.readouterr()
    answers = []
    for name in (str(file), "random:4", "random:5"):
        assert cli.main([*command.replace("{}", str(tmp_path)).split(), name]) == 0
        made = [path.read_text() for path in sorted(tmp_path.glob("*.csv"))]
        answers.append((numbers(capsys.readouterr().out), [numbers(text) for text in made]))
    assert answers[0][0] == pytest.approx(answers[1][0], rel=1e-12, abs=1e-12)
    for one, other in zip(answers[0][1], answers[1][1], strict=True):
        assert one == pytest.approx(other, rel=1e-12, abs=1e-12)
    assert answers[0] != answers[2]


def numbers(text: str) -> list[float]:
    """Return all numbers of a text that have a point."""
    return [float(word) for word in re.findall(r"-?\d+\.\d+(?:e[+-]?\d+)?", text)]
