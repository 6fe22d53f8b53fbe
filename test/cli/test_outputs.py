"""No verb overwrites its input: every option that names a file is declared as read or written, and never both."""

from __future__ import annotations

import io
import os
import shutil
import sys
from argparse import SUPPRESS, Namespace
from pathlib import Path

import pytest

from hexapod_comp import cli
from hexapod_comp.cli import results
from hexapod_comp.cli.options import csv_file, html_file
from hexapod_comp.cli.results import Result, Table
from hexapod_comp.cli.verbs import VERBS
from hexapod_comp.errors import InputFileError
from hexapod_comp.formats import outputs

ROOT = Path(__file__).resolve().parents[2]
WORDS = {"name", "namespace", "blocks", "instruments", "order", "scheme", "method", "scheduler", "thermometer", "host"}
WORDS |= {"tool", "work", "topic", "frame", "readings"}
"""Options whose text is not a file name."""


def test_every_option_that_names_a_file_is_declared_as_read_or_written():
    """All other options take a number, a word of :data:`WORDS`, or nothing."""
    for name, verb in VERBS.items():
        for option in verb.options:
            text = option.keywords.get("type") in (None, csv_file, html_file) and "choices" not in option.keywords
            nothing = option.keywords.get("action") == "store_true" or option.keywords.get("nargs") == 0
            takes_text = text and option.help != SUPPRESS and not nothing
            assert not takes_text or bool(option.role) != (option.dest in WORDS), (name, option.name)


COMMANDS = [
    ("ik {in}/table1.csv --out {in}/table1.csv", "table1.csv"),
    ("fit {in}/other.csv {in}/m.csv --out {in}/new --report {in}/m.csv", "m.csv"),
    ("replay {in}/bag --out {in}/bag/metadata.yaml", "metadata.yaml"),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("table1.csv", "paper.yaml", "paper_machine.yaml", "campaign_5d.yaml"):
        shutil.copy(ROOT / "config" / name, tmp_path)
    for name in ("m.csv", "other.csv", "c.yaml"):
        (tmp_path / name).write_text("read me\n")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("read me\n")
    return tmp_path


@pytest.mark.parametrize(("command", "name"), COMMANDS)
def test_output_that_is_an_input_is_refused_at_once(command: str, name: str, folder: Path, capsys):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert cli.main([word.replace("{in}", str(folder)) for word in command.split()]) == 2
    told = capsys.readouterr().err
    assert f"{name}: is an input of this command" in told
    assert told.count("\n") == 1
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_other_names_of_an_input_are_refused_too(folder: Path, capsys):
    """The input is recognised through a symbolic link, and as standard input."""
    given, out = folder / "table1.csv", folder / "out.csv"
    out.symlink_to(given)
    assert cli.main(["ik", str(given), "--out", str(out)]) == 2
    assert "is an input of this command" in capsys.readouterr().err
    with open(given, encoding="utf-8") as stream:
        own = os.dup(0)
        os.dup2(stream.fileno(), 0)
        try:
            assert cli.main(["ik", "-", "--out", str(given)]) == 2
        finally:
            os.dup2(own, 0)
            os.close(own)
    assert "is an input of this command (-)" in capsys.readouterr().err
    assert given.read_bytes() == (ROOT / "config" / "table1.csv").read_bytes()


def test_a_file_in_an_output_folder_that_is_read_is_not_replaced(folder: Path):
    """Writers of files in an output folder check each file, since only they know its name."""
    from hexapod_comp.formats.outputs import write_text

    with outputs.protected({"budget": str(folder / "c.yaml")}, {}, {"pictures": str(folder)}):
        with pytest.raises(InputFileError, match="is an input of this command"):
            write_text(folder / "c.yaml", "new")
        write_text(folder / "other.csv", "new")
    write_text(folder / "c.yaml", "new")  # outside of a command a program may overwrite the file
    assert (folder / "c.yaml").read_text() == (folder / "other.csv").read_text() == "new"


def test_two_outputs_in_one_file_are_refused_at_once(folder: Path, capsys):
    """Otherwise one output would replace the other without a message."""
    shutil.copy(ROOT / "config" / "table1.csv", folder / "r.csv")
    (folder / "link.html").symlink_to(folder / "a.html")
    command = f"fit {folder}/r.csv --out {folder}/a.html --certificate {folder}/link.html"
    assert cli.main(command.split()) == 2
    assert "is given for both --out and --certificate" in capsys.readouterr().err
    assert not (folder / "a.html").exists()


def test_tables_as_text_and_as_csv(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    """Decimals follow the unit at the end of a column's name; empty cells or dashes stand for missing values."""
    rows = [{"name": "=a", "x_mm": 1.0, "y_um": -0.0, "share": 2 / 3, "n": 7}]
    rows += [{"name": "b", "x_mm": float("nan"), "y_um": 12.5, "share": None, "n": None}]
    assert Table(rows).csv() == "name,x_mm,y_um,share,n\n'=a,1.000000000,0.000000,0.666667,7\nb,,12.500000,,\n"
    text = "name      x_mm    y_um  share  n\n  =a  1.000000   0.000  0.667  7\n   b         –  12.500      –  –"
    assert Table(rows).text() == text
    assert Table(rows).text(["x_mm", "share"], {"mm": 1, "share": 2}) == "x_mm  share\n 1.0   0.67\n   –      –"
    args = Namespace(json=False, out=str(folder / "o.csv"), pictures=None)
    for text in ("a", "a\n", ""):
        assert Result(lambda text=text: text, dict, rows, code=1, notes=["n"]).finish(args) == 1
        assert capsys.readouterr() == ("a\n" if text else "", "hexapod_comp: note: n\n")
    assert (folder / "o.csv").read_text() == Table(rows).csv()


def test_the_present_step_is_shown_in_one_line_of_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line is cut to the terminal's width minus one, is written over the line before, and is removed at the end."""
    terminal = io.StringIO()
    terminal.isatty, terminal.fileno = lambda: True, lambda: 2  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", terminal)
    times = iter((100.0, 101.0, 112.34, 0.0, 0.0))
    monkeypatch.setattr(results.time, "monotonic", lambda: next(times))
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((20, 24)))
    with results.stage_line() as say:
        say("fit")
        say("a \x1b text that is too long")
    assert terminal.getvalue() == "\r\033[K  1.0 s  fit\r\033[K 12.3 s  a  text th\r\033[K"
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((0, 24)))  # some terminals do not know it
    with results.stage("x" * 100):
        assert terminal.getvalue().endswith("\r\033[K  0.0 s  " + "x" * 70)
