"""The verb ``classify``, called in this process: what it prints, writes and refuses."""

from __future__ import annotations

import csv
import importlib.util
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from calibration_helpers import fitted_model
from helpers import hexapod, quick_pictures
from matplotlib.figure import Figure

from hexapod_comp.calibration import remaining
from hexapod_comp.cli import classify as verb
from hexapod_comp.workspace import study

TYPES = ("screw_pitch", "quantisation", "base_joint_xy", "base_joint_z", "platform_joint_xy", "platform_joint_z")
PICTURES = {"ranking.png", "causes.png", *(f"shells_{name}.png" for name in TYPES)}
TABLE = {"ranking.csv"}
PAGE = {"page.html"} if importlib.util.find_spec("plotly") else set()

QUICK = ("--cells", "4", "--tilt-deg", "0", "--no-page")


classify = partial(hexapod, "classify")


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_everything_is_written_printed_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shipped machine and budget, in four tilted orientations: report, table, pictures, page and JSON agree."""
    options = ("--cells", "5", "--tilt-deg", "-4,4", "--allow-um", "50")
    studies: list[study.Study] = []
    real = study.classify
    monkeypatch.setattr(study, "classify", lambda *a, **o: studies.append(real(*a, **o)) or studies[-1])
    monkeypatch.setattr("hexapod_comp.workspace.pictures.shells_figure", lambda *given: Figure())
    with quick_pictures():
        code, report, err = classify("--out", tmp_path / "ranking.csv", "--pictures", tmp_path, *options)
    assert (code, err) == (0, "")
    assert {path.name for path in tmp_path.iterdir()} == TABLE | PICTURES | PAGE
    assert all(name in report for name in PICTURES | PAGE)
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for name in PICTURES)
    assert "48 single errors of 6 types" in report  # test/workspace/study.txt has the words of such a report
    assert report.count("α -4°, β -4°") == report.count("α 4°, β -4°") == 1
    monkeypatch.setattr(study, "classify", lambda *a, **o: studies[0])
    content = json.loads(classify("--json", *options)[1])
    published: list[tuple] = []
    monkeypatch.setattr("hexapod_comp.viewer.shells.show_shells", lambda *given: published.append(given))
    assert classify("--publish", *options)[::2] == (0, "publishing on workspace/shells, frame work, until Ctrl-C\n")
    ((layers, quantity, title),) = published
    worst = content["ranking"][0]["translation_max_error"]
    assert (len(layers), quantity.unit, title) == (3, "µm", f"screw pitch, {worst}, α 4°, β -4°")
    rows = table(tmp_path / "ranking.csv")
    assert (content["machine"], len(content["reach"])) == ("positioning_unit", 4)
    largest = np.array([float(row["translation_max_um"]) for row in rows])
    assert rows[0]["error_type"] == "screw pitch"
    # v. Daake et al., Table 1: from 34.4 to 13.68 µm; the pitch's size is 2 to 2.86 times the other sizes
    assert largest[0] >= 2.0 * largest[1]
    assert (np.diff(largest) < 0.0).all()
    assert [record["error_type"] for record in content["ranking"]] == [row["error_type"] for row in rows]
    assert [record["translation_max_um"] for record in content["ranking"]] == pytest.approx(largest, abs=1e-6)
    for found in content["reach"]:
        assert 1e-4 < found["volume_m3"] < 1e-3
        assert sum(found["limits"].values()) == pytest.approx(1.0)
    combined, (allocated,) = content["combined_m_rad"], content["allocations_m"]
    assert allocated["scale"] == pytest.approx(50e-6 / combined["worst_case"][0])
    drawn = [combined["percentiles"][p][0] for p in ("50.0", "95.0", "99.0")]
    assert drawn == sorted(drawn)
    assert drawn[2] < combined["worst_case"][0]


def test_without_plotly_the_rest_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hexapod_comp.cli.classify._figures", lambda *arguments: {})
    for name in ("plotly", "plotly.offline"):
        monkeypatch.setitem(sys.modules, name, None)
    out = ("--out", tmp_path / "ranking.csv", "--pictures", tmp_path)
    code, out, _ = classify(*out, "--cells", 4, "--tilt-deg", 0)
    assert code == 0
    assert "no page: the interactive page needs plotly: pip install plotly" in out
    assert {path.name for path in tmp_path.iterdir()} == TABLE


def test_options_reach_the_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options arrive in the survey; coinciding platform joints of the paper's machine give 9 errors, or 18."""
    given: list[tuple[object, ...]] = []
    original = study.survey

    def spy(reaches: object, errors: object, *options: object) -> object:
        given.append((len(errors), *options[:3]))
        return original(reaches, errors, progress=options[3])

    monkeypatch.setattr(study, "survey", spy)
    budget = tmp_path / "budget.yaml"
    head = "format: hexapod_comp/error_budget\nversion: 1\nmachine: paper\n"
    budget.write_text(f"{head}errors: {{platform_joint_xy_um: 10, platform_joint_z_um: 10}}\n")
    options = ("--workers", 3, "--scheduler", "tcp://127.0.0.1:8786", "--method", "linear")
    machine = ("--machine", "paper", "--budget", budget)
    for more in ((), ("--separate-joints",)):
        assert classify(*QUICK, *options, *machine, *more)[0] == 0
    assert given == [(size, "linear", 3, "tcp://127.0.0.1:8786") for size in (9, 18)]


def test_a_model_in_place_of_a_budget_says_what_is_left_and_what_to_measure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model with six strut offsets known to 2 µm leaves an error of that size; frame and units are named."""
    found: list[object] = []  # text, JSON, table and picture show one calculation
    real = remaining.remaining
    monkeypatch.setattr(remaining, "remaining", lambda *a: (found or (found.append(real(*a)) or found))[0])
    monkeypatch.setattr(verb, "COMBINED_POSES", 60)
    machine = ("--machine", "paper", "--model", fitted_model(tmp_path), "--cells", 4, "--tilt-deg", 0)
    code, out, err = classify(*machine)
    assert (code, err) == (0, "")
    parts = ("model 'fitted'", "measured box, level tool", "workspace, α and β of 0°", "tool in work, x, y, z mm")
    parts += ("if these parameters were known exactly", "linear laser, body diagonals", "roll, lines along z")
    for part in parts:
        assert part in out, part
    written = ("--out", tmp_path / "r.csv", "--pictures", tmp_path / "p")
    with quick_pictures():
        content = json.loads(classify(*machine, "--json", *written)[1])
    assert content["frame"] == "work"
    assert [part["where"] for part in content["left"]] == ["measured box, level tool", "workspace, α and β of 0°"]
    assert 0.2e-6 < content["left"][0]["rms_m"] < 4e-6
    assert content["left"][0]["rms_m"] < content["left"][1]["rms_m"] < content["left"][1]["machines_95_m"]
    rows = table(tmp_path / "r.csv")
    measured = content["if_measured"]
    assert [row["measurement"] for row in rows] == [entry["name"] for entry in measured]
    left = [entry["left_workspace_m"] for entry in measured]
    assert left == sorted(left)
    assert max(left) <= content["left"][1]["rms_m"] * (1 + 1e-9)
    assert float(rows[0]["left_workspace_um"]) == pytest.approx(left[0] * 1e6, abs=1e-5)
    assert (tmp_path / "p" / "predicted_error.png").read_bytes().startswith(b"\x89PNG")
