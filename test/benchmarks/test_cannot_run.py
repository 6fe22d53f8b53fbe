"""A benchmark without what it measures with says so and fails: exit 0 is for bars that were kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import convergence, jugglebot, network
from benchmarks.genhexkins import NotHere


def test_without_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "grid180.csv").write_text("")
    assert jugglebot.main(["--data", str(tmp_path)]) == 2
    said = capsys.readouterr()
    missing = "108_calibration_poses.csv, grid180_ff_correction.csv"
    assert said.err == f"cannot run: {tmp_path} has no {missing}; name the folder of the data by --data\n"
    assert said.out == ""


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
