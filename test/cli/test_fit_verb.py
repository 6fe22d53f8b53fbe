"""The verbs ``simulate``, ``fit``, ``plan``, ``iso230`` and ``verify``, called in this process with files.

One campaign of a 1-D laser is measured and fitted once for the whole module; tests of options that change only the
output use this fit. ``verify`` checks a model whose parameters are known to 2 µm.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from calibration_helpers import fitted_model, paper, scattered
from helpers import assert_equal, hexapod, quick_pictures
from matplotlib.figure import Figure

from hexapod_comp.calibration.blocks import ERRORS, GROUPS
from hexapod_comp.calibration.fit import ModelFit
from hexapod_comp.calibration.parameters import BLOCKS, FitSettings
from hexapod_comp.calibration.posterior_file import load_posterior
from hexapod_comp.calibration.report import SHOWN_UNITS
from hexapod_comp.cli import fitting as fit_module
from hexapod_comp.cli.fitting import beyond_limits
from hexapod_comp.cli.verbs import VERBS
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.measurements.stations import compensated
from hexapod_comp.measurements.tidy import write_measurements
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.instruments import measure

# Six readings on the shortest line, the minimum of scheme lines; two cycles, the minimum of ISO 230-2
CAMPAIGN = """format: hexapod_comp/campaign
version: 1
box_mm: [[-203.2, -203.2, 350], [203.2, 203.2, 553.2]]
cell_in: 8
step_in: 1.6
instrument: 1-D
diagonals: 4
cycles: 2
"""

BOX = np.array([[-0.2032, -0.2032, 0.35], [0.2032, 0.2032, 0.5532]])  # the campaign's box, m

JOINT = ("--lead-mm", "10", "--blocks", "pitch,wave,backlash")


class Calibration(NamedTuple):
    folder: Path
    campaign: Path
    measured: Path
    fit: ModelFit
    said: str
    content: dict  # of --json


def fit_once(patch: pytest.MonkeyPatch) -> list[ModelFit]:
    """Return a list for the result of the next fit, which is the result of all further fits, too."""
    fits: list[ModelFit] = []
    real = fit_module.fit_model
    patch.setattr(fit_module, "fit_model", lambda *given: (fits or (fits.append(real(*given)) or fits))[0])  # type: ignore[func-returns-value]
    return fits


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """Measure and fit the shipped machine with all output files of ``fit``."""
    folder = tmp_path_factory.mktemp("calibration")
    campaign, measured, details = folder / "campaign.yaml", folder / "measured.csv", folder / "details.yaml"
    campaign.write_text(CAMPAIGN)
    details.write_text("format: hexapod_comp/certificate\nversion: 1\noperator: <Jo>\n")
    files = {"--out": "model.yaml", "--report": "report.txt", "--certificate": "out.html", "--pictures": "pictures"}
    written = [word for option, name in files.items() for word in (option, folder / name)]
    with pytest.MonkeyPatch.context() as patch, quick_pictures():
        patch.setattr("hexapod_comp.calibration.certificate._figures", lambda fit: [])  # they are those of --pictures
        fits = fit_once(patch)
        said_by("simulate", "--campaign", campaign, "--seed", 1, "--out", measured)
        judged = ("fit", measured, *JOINT, "--truth", "paper_machine", "--name", "Tuesday's")
        said = said_by(*judged, *written, "--details", details)
        again = said_by(*judged, "--out", folder / "model.yaml", "--json")
    return Calibration(folder, campaign, measured, fits[0], said, json.loads(again))


def said_by(*words: object) -> str:
    code, out, err = hexapod(*words)
    assert code == 0, err
    return out


def test_fit_reports_all_its_sections_and_what_was_fitted(done: Calibration) -> None:
    for part in (
        "machine paper: 1000 readings of 25 runs at 500 stations",
        "tilted 10°: ",
        "Do not trust this model with a tilted tool",
        "observability indices: O1 ",
        "structure parameters that are mostly unobservable (kept near nominal): base 1",
        "ISO 230-6:2002, body diagonals, both directions",
        "On the virtual machine, without → with the model",
        "metric of Mou & King, mean |displacement error|",
    ):
        assert part in done.said, part
    report = (done.folder / "report.txt").read_text()
    assert done.said.startswith(report)
    assert done.said.removeprefix(report).strip().splitlines()[0] == f"model: {done.folder / 'model.yaml'}"
    pictures = sorted((done.folder / "pictures").iterdir())
    assert [path.name for path in pictures] == ["fit.png", "left.png", "predicted_error.png", "strut_errors.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for path in pictures)
    level = done.fit.level
    assert level is not None
    found = re.search(r"level tool: +([\d.]+) → ([\d.]+) µm RMS \(([\d.]+)…([\d.]+) with 95 %\)", done.said)
    assert found
    wanted = [1e6 * value for value in (level.before, level.after, level.low, level.high)]
    np.testing.assert_allclose([float(v) for v in found.groups()], wanted, atol=0.006)
    removed = re.search(r"error vector in space, RMS, after best-fit alignment: .*\(([\d.]+) % less\)", done.said)
    assert removed
    assert float(removed.group(1)) > 90.0  # the shipped machine has a field of 3 µm, and the fit has no field


def test_model_file_holds_the_fit_and_where_it_comes_from(done: Calibration) -> None:
    """The model file holds the fitted numbers to the last digit, its sources and date."""
    geometry = load_geometry("paper")
    model = load_model((done.folder / "model.yaml"), geometry)
    stored, _ = load_posterior(model, geometry, (done.folder / "model.yaml"))
    assert stored is not None
    content, parameters = done.content, done.content["parameters"]
    assert [entry["name"] for entry in parameters] == list(stored.space.labels)
    errors = [entry["standard_error"] for entry in parameters]
    np.testing.assert_allclose(np.sqrt(np.diag(stored.covariance)), errors, rtol=1e-9)
    assert {entry["unit"] for entry in parameters} <= {"m", "m/m", "rad"}
    assert {entry["block"] for entry in content["blocks"]} == {"pitch", "wave", "backlash"}
    assert content["worth"]["error_with"]["aligned_rms_m"] < 0.1 * content["worth"]["error_without"]["aligned_rms_m"]
    assert content["standards"]["iso230_2"]["x line at y 0.0, z 350.0"]["A_m"] > 0.0
    assert (content["scheme"], content["written"]) == ("joint", str(done.folder / "model.yaml"))
    assert content["observability"]["structure_size"] == 33
    assert model.name == "Tuesday's"
    assert model.origin.sources == (("measured.csv", hashlib.sha256(done.measured.read_bytes()).hexdigest()),)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", model.origin.date)
    assert model.region is not None
    np.testing.assert_allclose(model.region.box, BOX, atol=1e-12)
    residual = model.origin.held_out_residual
    assert residual is not None
    assert 0.5e-6 < residual < 5e-6  # two readings of 1 µm per cell, and the machine's field of 3 µm
    np.testing.assert_allclose(model.base_deviation, done.fit.model.base_deviation, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(model.struts.backlash, done.fit.model.struts.backlash, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(model.struts.period, 0.01, rtol=1e-12)


def test_options_reach_the_fit(done: Calibration, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Every option arrives in the settings, in SI units; `field` and `harmonics` each stand for three blocks."""
    given: list[FitSettings] = []
    monkeypatch.setattr(fit_module, "fit_model", lambda _, settings, *__: given.append(settings) or done.fit)
    load = Load(stiffness=np.full(6, 2e7), mass=30.0)
    monkeypatch.setattr(fit_module, "read_load", lambda _: load)
    fit = ("fit", done.measured, "--out", tmp_path / "m.yaml")
    options = (
        "--lead-mm 5 --blocks map,field,harmonics --separate-joints --tolerance-um 20 --field-degree 3 --not-robust"
    )
    options += " --expansion-ppm 11.7,11,23 --moisture-ppm 2 --tracker-frame known --thermometer base --load l.yaml"
    options += " --time-constants-s 900,60 --scale-ppm 0.7 --alignment-mrad 2"
    for words in (options.split(), ("--expansion-ppm", 5), ()):
        assert hexapod(*fit, *words)[::2] == (0, "")
    blocks = ("map", "field displacement", "field rotation", "field reversal", "wave 2", "wave 3", "wave 4")
    every = FitSettings(
        lead=5e-3, blocks=blocks, shared_platform_joints=False, robust=False, field_degree=3,
        tolerances=(("structure", 20e-6),), strut_expansion=11.7e-6, base_expansion=11e-6, platform_expansion=23e-6,
        strut_moisture=2e-4, tracker_frame="known", thermometer="base", load=load.numbers(), scale=0.7e-6,
        time_constants=(60.0, 900.0), alignment=2e-3,
    )  # fmt: skip
    for found, wanted in zip(given, (every, FitSettings(strut_expansion=5e-6), FitSettings()), strict=True):
        assert_equal(found, wanted, relative=1e-12)


def test_every_block_has_a_name_in_the_help_and_a_unit_in_the_report() -> None:
    """The structure is in every fit, so the help does not name it."""
    for verb in ("fit", "plan"):
        text = next(option.help for option in VERBS[verb].options if option.name == "--blocks")
        listed = text.partition(": ")[2].partition(" (")[0].split(", ")
        assert {block for name in listed for block in GROUPS.get(name, (name,))} == {*BLOCKS} - {"structure"}
    assert {block.unit for block in ERRORS} <= SHOWN_UNITS.keys()


def test_certificate(done: Calibration) -> None:
    """The certificate has the hash of the written model file, the given details and the whole report."""
    text = (done.folder / "out.html").read_text()
    assert f"\ncertificate: {done.folder / 'out.html'}\n" in done.said
    for name in ("model.yaml", "model.posterior.npz", "measured.csv"):
        assert hashlib.sha256((done.folder / name).read_bytes()).hexdigest() in text, name
    for part in ("Tuesday&#39;s", "&lt;Jo&gt;", "ISO 230-2:2014", "ISO 230-6:2002", "observability indices: O1 "):
        assert part in text, part
    assert "class=warning" not in text


def test_scheme_lines(done: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scheme lines writes a model with a field over the measured box and no posterior; stdout has only JSON."""
    monkeypatch.setattr("hexapod_comp.calibration.pictures.pictures_of", lambda fit: {"lines.png": Figure()})
    written = ("--out", tmp_path / "lines.yaml", "--pictures", tmp_path / "pictures")
    code, out, err = hexapod("fit", done.measured, "--scheme", "lines", "--json", *written)
    assert (code, err) == (0, f"picture: {tmp_path / 'pictures' / 'lines.png'}\n")
    assert {path.name for path in tmp_path.iterdir()} == {"lines.yaml", "pictures"}
    model = load_model(tmp_path / "lines.yaml", load_geometry("paper"))
    np.testing.assert_allclose(model.field.box, BOX, atol=1e-12)
    content = json.loads(out)
    assert (content["machine"], content["scheme"], len(content["lines"])) == ("paper", "lines", 42)
    assert [len(axis) for axis in content["grid_m"]] == [3, 3, 2]
    assert {line["direction"] for line in content["lines"]} == {"forward", "backward"}
    assert all(0.0 < line["residual_std_m"] < 1e-4 for line in content["lines"])


# Readings that contradict the model

ALL = ("--out", "m.yaml", "--report", "r.txt", "--certificate", "c.html", "--pictures", "p")


def test_noise_far_above_the_stated_writes_nothing_unless_it_is_forced(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Noise of 30 times the stated gives exit code 1, the reason first in the report, and no file.

    With --force the report, the model's note and the certificate begin with a warning."""
    monkeypatch.chdir(tmp_path)
    fit_once(monkeypatch)
    Path("campaign.yaml").write_text(CAMPAIGN + "noise: {linear_um: 30}\n")
    said_by("simulate", "--campaign", "campaign.yaml", "--seed", 1, "--out", "readings.csv")
    header, *rows = (line.rsplit(",", 1) for line in Path("readings.csv").read_text().splitlines())
    assert (header[1], {end for _, end in rows}) == ("uncertainty", {"30"})
    Path("readings.csv").write_text("\n".join(start for start, _ in (header, *rows)) + "\n")
    command = ("fit", "readings.csv", "--lead-mm", 10, "--blocks", "pitch")
    before = set(tmp_path.iterdir())
    code, out, err = hexapod(*command, *ALL)
    assert code == 1
    said = r"NOT WRITTEN: .*linear by (\S+) µm, (\S+) times the 1 µm assumed, since the file states none"
    found = re.match(said, out)
    assert found, out
    assert [float(v) for v in found.groups()] == pytest.approx([30.0, 30.0], rel=0.1)
    assert "residuals; held out" in out, "the report says the rest"
    assert err == "hexapod_comp: error: no model was written, see the report; --force writes it\n"
    assert set(tmp_path.iterdir()) == before
    with quick_pictures():
        code, out, err = hexapod(*command, "--force", *ALL[:-2])
    assert (code, err) == (0, "")
    assert out.startswith("WRITTEN BY FORCE: this model is not to be trusted: readings scatter by more than 10 times")
    assert out.startswith(Path("r.txt").read_text())
    model = load_model("m.yaml", load_geometry("paper"))
    assert model.origin.note.startswith("FORCED: readings scatter by more than 10 times their noise: linear by ")
    assert "<p class=warning><b>Warning.</b> WRITTEN BY FORCE: " in Path("c.html").read_text()
    made = {path.name for path in set(tmp_path.iterdir()) - before}
    assert made == {"m.yaml", "m.posterior.npz", "r.txt", "c.html"}


def test_micrometres_called_millimetres_write_nothing(done: Calibration, tmp_path: Path) -> None:
    """Readings in a wrong unit write no model by either scheme, with noise stated in that unit or not stated."""
    # Scheme lines leaves the screws' waves of a few micrometres, here read as millimetres.
    wrong, text = tmp_path / "mm.csv", done.measured.read_text().replace(",um,", ",mm,")
    wrong.write_text("".join(line.rsplit(",", 1)[0] + "\n" for line in text.splitlines()))
    lines = ("fit", wrong, "--scheme", "lines", "--out", tmp_path / "m.yaml")
    code, out, _ = hexapod(*lines)
    assert code == 1
    assert re.match(r"NOT WRITTEN: .*readings scatter by more than 10 times their noise: linear by .* assumed", out)
    wrong.write_text(text)
    code, out, _ = hexapod(*lines)
    assert code == 1
    problem = "stated uncertainties are too large for any such instrument (is the unit right?): linear 1e+03 µm"
    assert out.startswith(f"NOT WRITTEN: this model is not to be trusted: {problem}, usual is 1 µm")
    code, _, err = hexapod("fit", wrong, "--lead-mm", 10, "--blocks", "pitch", "--out", tmp_path / "m.yaml")
    assert code == 1 or "check units" in err
    assert list(tmp_path.iterdir()) == [wrong]


@pytest.mark.parametrize("scheme", ["joint", "lines"])
def test_a_dead_instrument_is_refused(done: Calibration, tmp_path: Path, scheme: str) -> None:
    dead = tmp_path / "dead.csv"
    dead.write_text(re.sub(r",linear,[^,]+,", ",linear,0,", done.measured.read_text()))
    code, out, err = hexapod("fit", dead, "--scheme", scheme, "--out", tmp_path / "m.yaml")
    assert (code, out) == (2, "")
    assert "linear: the 1000 readings are all zero" in err
    assert list(tmp_path.iterdir()) == [dead]


def test_plan_says_what_will_be_determined(done: Calibration) -> None:
    """1-D lines show less than 5-D lines, whose report is in reports.txt: 14 structure parameters, counted by hand."""
    content = json.loads(hexapod("plan", done.campaign, *JOINT, "--json")[1])
    assert (content["readings"], content["parameters"]) == (1000, 57)
    seen = content["observability"]
    assert 0 < seen["structure_rank"] < 14
    assert seen["structure_rank"] < seen["rank"] < seen["size"] == 57
    assert done.content["unseen_errors"] == content["unseen_errors"]
    error = content["expected_tool_error"]
    assert error["low_m"] < error["after_m"] < error["high_m"] < error["before_m"]


def test_plan_proposes_a_campaign(done: Calibration, tmp_path: Path) -> None:
    """``plan`` of the proposed file gives the proposal's expected error, except for random draws."""
    path = tmp_path / "mine.yaml"
    goal = ("--goal-um", "2", "--instruments", "linear", "--hours", "3", "--time", "linear=5,2,1")
    code, out, err = hexapod("plan", done.campaign, *JOINT, *goal, "--out", path, "--json")
    assert (code, err) == (0, "")
    content = json.loads(out)
    assert content["met"]
    assert content["expected_m"]["level"] <= 2e-6
    assert content["takes_s"] <= 3.0 * 3600.0
    assert path.read_text().startswith("# Proposed for machine paper: goal 2.00 µm RMS, with linear in 3 h.\n")
    judged = json.loads(hexapod("plan", path, *JOINT, "--json")[1])
    assert judged["readings"] == content["readings"]
    assert judged["expected_tool_error"]["after_m"] == pytest.approx(content["expected_m"]["level"], rel=0.2)


def test_a_mistyped_coordinate_stands_on_the_first_line(tmp_path: Path, unsuspected: None) -> None:
    """A position of 306 in place of 30.6 is named with its file and line, first in the report."""
    folder, path = Path(__file__).resolve().parents[2] / "examples" / "tracker", tmp_path / "points.csv"
    path.write_bytes(re.sub(rb"(?m)^P07;[-0-9]+,", b"P07;306,", (folder / "points.csv").read_bytes()))
    columns = ("--columns", folder / "columns.yaml", "--blocks", "structure")
    out = hexapod("fit", path, *columns, "--out", tmp_path / "m.yaml")[1]
    assert out.startswith(f"CHECK THIS READING, which looks mistyped: {path}: line 13: position_x is ")


def test_a_model_that_the_compensator_would_refuse_is_named_before_it_is_written() -> None:
    """A model is refused in words if struts are wrong by 1.5 times the correction limit, not at 0.1 times."""
    poses = [Pose(np.array([x, 0.0, 0.42]), np.eye(3)) for x in (-0.1, 0.0, 0.1)]
    measured = scattered(paper(), poses)
    limit = paper().limits.correction
    for offset, said in ((0.1 * limit, False), (1.5 * limit, True)):
        model = MachineModel("paper", struts=StrutErrors(offset=np.full(6, offset)))
        text = beyond_limits(measured, model)
        assert bool(text) == said
    assert text.startswith(
        "with this model the compensator would refuse 3 of the 3 measured poses, first at -100.0, 0.0"
    )
    assert "correction" in text


MICRON = (1e-6,) * len(KINDS)
STRUT = 1  # index of the strut that is moved by 50 µm


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a model and check readings: unchanged, with a moved strut, with compensation running."""
    folder = tmp_path_factory.mktemp("verify")
    model = load_model(fitted_model(folder), paper())
    box = np.array([[-0.1, -0.1, 0.38], [0.1, 0.1, 0.45]])
    plan = Campaign(box, 0.07, 0.07, None, 0, poses=3, noise=MICRON)
    laid_out = template(plan, paper())
    laid_out = replace(laid_out, uncertainty=np.full(len(laid_out), 1e-6))
    struts = model.struts
    moved = replace(model, struts=replace(struts, offset=struts.offset + 50e-6 * (np.arange(6) == STRUT)))
    for name, truth, told in (
        ("same", model, laid_out),
        ("moved", moved, laid_out),
        ("running", model, compensated(laid_out, model)),
    ):
        readings = measure(told, plan, RealMachine(paper(), truth), 3)
        write_measurements(replace(readings, stations=laid_out.stations), folder / f"{name}.csv")
    return folder


def model_in(folder: Path) -> Path:
    return next(folder.glob("*.yaml"))


def test_verdicts_are_exit_codes_and_a_moved_strut_is_named(folder: Path) -> None:
    """VALID gives exit code 0, a moved strut 1. Struts are 30 µm too long: without --compensated, running.csv is
    not valid."""
    model = model_in(folder)
    code, out, _ = hexapod("verify", model, folder / "same.csv")
    assert code == 0
    assert "\nVALID: " in out
    assert hexapod("verify", model, folder / "running.csv", "--compensated")[0] == 0
    code, out, _ = hexapod("verify", model, folder / "moved.csv", "--json")
    assert code == 1
    best = json.loads(out)["candidates"][0]
    assert (json.loads(out)["verdict"], best["kind"], best["name"]) == ("named", "strut", f"strut_{STRUT + 1}")
    size = best["sizes"][0]
    assert abs(size["value"] - 50.0) < 4.0 * size["standard_error"] < 20.0


def test_the_fits_measured_point_counts_unless_another_is_given(folder: Path, tmp_path: Path) -> None:
    """At a point 5 mm off the tip, the rotations of this model change the readings by less than their noise."""
    model = fitted_model(tmp_path, probe=np.array([0.0, 0.0, 5e-3]))
    assert hexapod("verify", model, folder / "same.csv")[0] == 0
    code, _, err = hexapod("verify", model, folder / "same.csv", "--probe-mm", "0,0,0")
    assert code == 2
    assert "the point of the fit's readings" in err
    tracker = Path(__file__).resolve().parents[2] / "examples" / "tracker"
    code, _, err = hexapod("verify", model, tracker / "points.csv", "--columns", tracker / "columns.yaml")
    assert code == 2  # a wide file holds the tip, not the fit's point
    assert "taken at a point of the tool 5 mm from the point of the fit's readings" in err


def test_proposed_readings_are_written_to_be_filled_in(folder: Path) -> None:
    """--propose writes readings without values, which are refused until they are filled in."""
    proposed = folder / "check.csv"
    code, out, _ = hexapod("verify", model_in(folder), "--propose", proposed, "--readings", 6)
    assert code == 0
    assert f"fill in the values: {proposed}" in out
    rows = proposed.read_text().splitlines()[1:]
    assert [row.split(",")[-2] for row in rows] == [""] * 6, "no values yet"
    code, _, err = hexapod("verify", model_in(folder), proposed)
    assert code == 2
    assert "value" in err


def test_update_writes_another_model_and_counts_readings_once(folder: Path, tmp_path: Path) -> None:
    old, new, moved = model_in(folder), tmp_path / "new.yaml", folder / "moved.csv"
    before = old.read_bytes()
    code, out, _ = hexapod("fit", moved, "--update", old, "--out", new)
    assert code == 0
    assert "renewed" in out
    change = load_model(new, paper()).struts.offset - load_model(old, paper()).struts.offset
    assert abs(change[STRUT] - 50e-6) < 12e-6
    assert hexapod("verify", new, moved)[0] == 0
    (tmp_path / "t.csv").write_text("oil_degC,x_um,y_um,z_um,rx_urad,ry_urad,rz_urad\n20,0,0,0,0,0,0\n30,1,0,0,0,0,0\n")
    out = folder.parent / "t.yaml"
    _, _, err = hexapod("outside", tmp_path / "t.csv", "--holds", "errors", "--model", old, "--out", out)
    name = old.with_suffix(".posterior.npz").name
    assert err == f"hexapod_comp: note: copy {name}, the covariance of the model's parameters, to the folder of {out}\n"
    for base, written, problem in (
        (new, tmp_path / "twice.yaml", "count twice"),
        (old, old, "would be replaced"),
        (old, old.with_suffix(".yml"), "would replace the fit's result"),
    ):
        code, _, err = hexapod("fit", moved, "--update", base, "--out", written)
        assert code == 2
        assert problem in err
    assert old.read_bytes() == before
