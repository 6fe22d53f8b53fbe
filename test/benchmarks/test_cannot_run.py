"""A benchmark without what it measures with says so and fails: exit 0 is for bars that were kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import convergence, jugglebot, network, rubin
from benchmarks.genhexkins import NotHere


def test_without_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "grid180.csv").write_text("")
    assert jugglebot.main(["--data", str(tmp_path)]) == 2
    said = capsys.readouterr()
    missing = "108_calibration_poses.csv, grid180_ff_correction.csv"
    assert said.err == f"cannot run: {tmp_path} has no {missing}; name the folder of the data by --data\n"
    assert said.out == ""


def test_rubins_tables_are_fetched_by_who_runs_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Without them exit 2; with files of their form, here a cosine in five rows, the nodes are judged."""
    assert rubin.main([str(tmp_path)]) == 2
    assert f"cannot run: there is no {tmp_path}/fitter/zd_m2.txt" in capsys.readouterr().err
    angles = np.arange(90.0, -1.0, -22.5)
    rows = np.outer(np.cos(np.radians(angles)), [1.0, 400.0, -300.0, 0.01, 1e-6, 1e-5])
    (tmp_path / "fitter").mkdir()
    for file in rubin.TABLES.values():
        np.savetxt(tmp_path / file, np.column_stack([angles, rows]), header="Camera")
    assert rubin.main([str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("PASSED") == 2


def test_the_data_are_in_the_repository():
    assert all((jugglebot.DATA / name).is_file() for name in (*jugglebot.FILES, "LICENSE.MIT"))


def test_without_linuxcnc(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def honesty() -> None:
        raise NotHere("genhexkins: no /usr/lib/linuxcnc")

    monkeypatch.setattr(convergence, "honesty", honesty)
    monkeypatch.setattr(convergence, "convergence", lambda yaws: [])
    assert convergence.main() == 2
    assert capsys.readouterr().err == "cannot run: genhexkins: no /usr/lib/linuxcnc\n"


def test_without_network_namespaces(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr("sys.argv", ["network"])
    monkeypatch.delenv(network.INSIDE, raising=False)
    monkeypatch.setattr(network, "refusal", lambda: "Operation not permitted")
    assert network.main() == 2
    assert "no network namespaces here: Operation not permitted" in capsys.readouterr().err
