"""``verify`` and ``fit --update`` from file to file: exit codes, what is printed, what is never replaced.

A model whose parameters are known to 2 µm is checked on machines that are it, or that have one strut changed since.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_helpers import fitted_model, paper

from hexapod_comp import cli
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import KINDS
from hexapod_comp.measurements.tidy import write_measurements
from hexapod_comp.virtual.instruments import compensated, measure

MICRON = (1e-6,) * len(KINDS)
STRUT = 1  # which strut is moved, by 50 µm


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a model, and checks of the machine as it is, with a strut moved, and compensated."""
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
    """Return the model file."""
    return next(folder.glob("*.yaml"))


def run(*arguments: object) -> int:
    """Run the command line."""
    return cli.main([str(argument) for argument in arguments])


def test_a_valid_model_exits_0(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("verify", model_in(folder), folder / "same.csv") == 0
    assert "\nVALID: " in capsys.readouterr().out


def test_proposed_readings_are_written_to_be_filled_in(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They are of the model that is named; what is measured has its own files; and one of both is needed."""
    proposed = folder / "check.csv"
    assert run("verify", model_in(folder), "--propose", proposed, "--readings", "8") == 0
    rows = proposed.read_text().splitlines()[1:]
    assert len(rows) == 8
    assert all(row.split(",")[-2] == "" for row in rows), "no values yet"
    assert f"fill in the values: {proposed}" in capsys.readouterr().out
    for wrong, problem in (
        ((), "at least one of FILE, --propose is needed"),
        ((folder / "same.csv", "--propose", proposed), "FILE cannot be combined with --propose"),
        (("--propose", proposed, "--readings", "2"), "must be 6…60, not 2"),
        ((proposed,), "value"),
    ):
        assert run("verify", model_in(folder), *wrong) == 2
        assert problem in capsys.readouterr().err


def test_readings_under_compensation_need_its_option(folder: Path) -> None:
    """All struts are 30 µm too long: taken for readings without compensation, those of a compensated one differ."""
    assert run("verify", model_in(folder), folder / "running.csv", "--compensated") == 0
    assert run("verify", model_in(folder), folder / "running.csv") == 1


def test_a_moved_strut_exits_1_and_is_in_the_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("verify", model_in(folder), folder / "moved.csv", "--json") == 1
    result = json.loads(capsys.readouterr().out)
    best = result["candidates"][0]
    assert (result["verdict"], best["kind"], best["name"]) == ("named", "strut", f"strut_{STRUT + 1}")
    size = best["sizes"][0]
    assert abs(size["value"] - 50.0) < 4.0 * size["standard_error"] < 20.0


def test_update_writes_another_model_and_counts_readings_once(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = model_in(folder), tmp_path / "new.yaml"
    before = old.read_bytes()
    assert run("fit", folder / "moved.csv", "--update", old, "--out", new) == 0
    assert "renewed" in capsys.readouterr().out
    assert old.read_bytes() == before
    change = load_model(new, paper()).struts.offset - load_model(old, paper()).struts.offset
    assert abs(change[STRUT] - 50e-6) < 12e-6
    assert run("verify", new, folder / "moved.csv") == 0
    assert run("fit", folder / "moved.csv", "--update", new, "--out", tmp_path / "twice.yaml") == 2
    assert "count twice" in capsys.readouterr().err


def test_update_never_replaces_what_it_reads(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = model_in(folder)
    assert run("fit", folder / "moved.csv", "--update", old, "--out", old) == 2
    assert "would be replaced" in capsys.readouterr().err
    assert run("fit", folder / "moved.csv", "--update", old, "--out", old.with_suffix(".yml")) == 2
    assert "would replace the fit's result" in capsys.readouterr().err


def test_a_model_without_its_posterior_cannot_be_checked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("verify", "paper_machine", folder / "same.csv") == 2
    assert "cannot be checked" in capsys.readouterr().err
    assert run("fit", folder / "same.csv", "--out", folder / "no.yaml", "--compensated") == 2
