"""No verb overwrites its input: every option that names a file is declared as read or written, and never both."""

from __future__ import annotations

import os
import shutil
from argparse import SUPPRESS
from pathlib import Path

import pytest

from hexapod_comp import cli
from hexapod_comp.cli.options import csv_file, html_file
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
