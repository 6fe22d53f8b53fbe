"""The certificate of a small fit: its figures equal the report's, it quotes any text, its hashes match the files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from calibration_helpers import FEW, assert_recorded, campaign, described, measured, virtual_machine

from hexapod_comp.calibration import certificate
from hexapod_comp.calibration.certificate import Details, _result, _tests, certificate_text, left_out, load_details
from hexapod_comp.calibration.fit import ModelFit, Outlier, fit_model
from hexapod_comp.calibration.lead import ScrewLead
from hexapod_comp.calibration.pictures import pictures_of, residuals_by_run_figure
from hexapod_comp.calibration.posterior import Observability, UnseenError
from hexapod_comp.calibration.report import as_json, fit_report
from hexapod_comp.calibration.sensitivity import predict
from hexapod_comp.calibration.trust import ChiSquare
from hexapod_comp.errors import InputFileError
from hexapod_comp.measurements.iso230 import CircularTest, Judged, notes_of
from hexapod_comp.measurements.readings import FileLine

# Text that a user might give as a run's name, and that HTML or a template must not interpret
HOSTILE = "</td><script>alert(1)</script><img src=https://example.org/x onerror=y>\u202e\n"


@pytest.fixture(scope="module")
def fit() -> ModelFit:
    plan = campaign("1-D", cycles=2, repeatability=0.5e-6)
    return fit_model(measured(virtual_machine(1), plan, 1), FEW)


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(certificate, "_figures", lambda fit: [])  # the pictures take most of the time
    (tmp_path / "model.yaml").write_text("the model")
    return tmp_path / "model.yaml"


def cells(text: str) -> list[list[str]]:
    """Return the texts of the cells of each table row."""
    rows = re.findall(r"<tr>(.*?)</tr>", text, re.DOTALL)
    return [[re.sub("<.*?>", "", cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL)] for row in rows]


def test_it_promises_what_the_report_promises(fit: ModelFit, model: Path) -> None:
    """The tool error is that of the recorded report of this fit; U is twice the upper end of the interval."""
    read = replace(fit, measurements=replace(fit.measurements, files=(("laser.csv", "ab" * 32),)))
    report = fit_report(fit)
    table = cells(certificate_text(read, "a model", [model], report))
    assert_recorded("certificate", "".join(f"{row}\n" for row in table if row[0] != "evaluated with"))
    doubtful = certificate_text(fit, "a model", [model], f"IN DOUBT: off by <10 times\n\n{report}")
    tables = [chunk for chunk in doubtful.split("<table") if "Largest: " in chunk]
    assert len(tables) == 2  # lines along the axes, body diagonals
    for text in tables:
        errors = re.findall(r'data-label="E">([\d.]+) → ([\d.]+)<', text)
        before, after = (max(column, key=float) for column in zip(*errors, strict=True))
        assert f"Largest: E {before} → {after} µm, B " in text
    assert "</h1><p class=warning><b>Warning.</b> IN DOUBT: off by &lt;10 times</p>" in doubtful


def test_circles_of_a_ball_bar_are_listed_before_and_after() -> None:
    figures = {"G_ccw": 4e-6, "G_cw": 3e-6, "G_b": 6.006e-6}
    before = Judged({}, {}, {"c": CircularTest(0.05, {"ccw": 8}, figures, ("a note",))})
    after = Judged({}, {}, {"c": CircularTest(0.05, {"ccw": 8}, {name: 0.5 * v for name, v in figures.items()}, ())})
    (table,) = _tests(before, after)
    shown = "G ↺", "G ↻", "G(b)", "Fmax ↺", "Fmin ↺", "Fmax ↻", "Fmin ↻", "D"
    values = "4.00 → 2.00", "3.00 → 1.50", "6.01 → 3.00"
    assert (table["title"], table["header"]) == ("ISO 230-4:2005, circles", ("run", "radius mm", *shown))
    assert table["rows"] == [("c", "50.0", *values, *["–"] * 5)]
    assert (table["largest"], table["notes"]) == ("", notes_of(before.circles))
    assert _result(SimpleNamespace(level=None)) == []


def test_a_fits_report_has_all_that_was_found(fit: ModelFit) -> None:
    """Outliers of eleven runs, four of them gross, a lead, more χ² and warnings are added to a real fit."""
    runs = ["a"] * 4 + list("bcdefghijk")
    outliers = [Outlier(f"m.csv: line {n}", run, "linear", -9e-6, -59.0 + 3.0 * n, "m") for n, run in enumerate(runs)]
    kinds = Observability(fit.observability.blocks, 30, 33, 40, 57, 1234.5, {"O1": 0.123456}, ("base 1 y",), 0.1)
    chi_squares = (ChiSquare("linear", "x lines", 9, 1.23456),)
    told = replace(
        fit, outliers=tuple(outliers), refusals=("off by far",), doubts=("not converged",), notes=("a note",),
        lead=ScrewLead(9e-3, 10.0002e-3, 2e-7, 50.0), observability=kinds, decisions=fit.decisions[:2],
        unseen_errors=(UnseenError("roll of x", 0.0),), chi_squares=chi_squares, chi_squares_of_runs=chi_squares * 6,
    )  # fmt: skip
    assert_recorded("fit", fit_report(told))
    assert_recorded("fit", as_json(told))


def test_pictures_of_a_fit(fit: ModelFit) -> None:
    figures = {**pictures_of(fit), "residuals.png": residuals_by_run_figure(fit)}
    for name in ("fit", "left", "strut_errors", "predicted_error", "residuals"):
        assert_recorded(f"picture_{name}", described(figures[f"{name}.png"]))


def test_strangers_names_are_text(fit: ModelFit, model: Path) -> None:
    """Markup in names of runs, files and models, in notes, outliers and details appears as text and loads nothing."""
    m = fit.measurements
    runs = tuple(replace(run, name=HOSTILE + run.name) for run in m.runs)
    sources = tuple(FileLine(HOSTILE, 1) for _ in m.sources)
    hostile = replace(m, runs=runs, sources=sources, files=((HOSTILE, HOSTILE),))
    stranger = replace(fit, measurements=hostile, notes=(HOSTILE,), unseen_errors=(UnseenError(HOSTILE, 0.0),))
    details = Details(customer=HOSTILE, instruments=(HOSTILE,), remarks=(HOSTILE,))
    text = certificate_text(stranger, HOSTILE, [model], HOSTILE, details)
    assert "<script" not in text
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r"<[^>]* src=\"?([^\s\">]*)", text))
    assert text.count("&lt;script&gt;alert(1)&lt;/script&gt;") > len(runs)
    assert "\u202e" not in text


def test_figures_after_come_from_a_fit_without_the_line(fit: ModelFit) -> None:
    """The truth is a fit repeated without the first line, and its prediction for that line.

    That fit's own noise and tolerances differ, by a fifth of the residual of 1.1 µm (1 µm of laser noise, 0.5 µm of
    scatter of the stops). The line's error is 10 µm."""
    m = fit.measurements
    own = np.flatnonzero(m.run == 0)
    others = fit_model(m.select(m.run != 0), replace(FEW, blocks=tuple(b.name for b in fit.space.blocks[1:])))
    errors = predict(others.space, others.solution.x, m.stations).errors[m.station[own]]
    left = m.value[own] - np.einsum("ni,ni->n", m.directions()[own], errors)
    left -= left.mean()
    given = left_out(fit)[own]
    given = given - given.mean()
    assert np.sqrt(((given - left) ** 2).mean()) < 0.2 * left.std()
    assert left.std() < 1.5e-6 < 0.2 * m.value[own].std(), "the line is predicted at all"


DETAILS = "format: hexapod_comp/certificate\nversion: 1\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (DETAILS + "number: 14\n", r"number: must be text \(found 14\)"),
        (DETAILS + "remarks: [1]\n", "remarks: must be a list of texts"),
        (DETAILS + "custmer: x\n", "custmer"),
    ],
)
def test_wrong_details_are_refused(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "d.yaml").write_text(text)
    with pytest.raises(InputFileError, match=complaint):
        load_details(tmp_path / "d.yaml")
