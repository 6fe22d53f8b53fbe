"""The wording of messages and reports.

messages.txt holds commands, or files' texts, each followed by its expected message. reports.txt holds commands, each
followed by everything that it prints; numbers may differ by two units of the last digit. In both files a line
``file NAME "its text"`` sets the content of file NAME for all commands.

``RENEW_REPORTS=1 pytest test/cli/test_messages.py`` rewrites both files; ``git diff`` then shows every new word.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from pathlib import Path

import pytest
from helpers import assert_same_text, hexapod

from hexapod_comp import cli
from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.paths import config_folder
from hexapod_comp.formats.yaml import parse_yaml

GOLDEN = Path(__file__).with_name("messages.txt")
ASKED = ("$ ", "yaml ")
LINES = GOLDEN.read_text(encoding="utf-8").splitlines()
CASES = [(n, line) for n, line in enumerate(LINES) if line.startswith(ASKED)]
REPORTS = Path(__file__).with_name("reports.txt")
REPORT = re.compile(r"^\$ (.*)\n((?:(?:  .*)?\n)*)", re.MULTILINE)  # a command, and lines of its output
LISTED = REPORT.findall(REPORTS.read_text(encoding="utf-8"))
FILES = dict(
    line.split(" ", 2)[1:]
    for line in [*LINES, *REPORTS.read_text(encoding="utf-8").splitlines()]
    if line.startswith("file ")
)

BUDGET = "format: hexapod_comp/error_budget\nversion: 1\nmachine: positioning_unit\nerrors: "
YAML = "format: test\nversion: 1\n"


def read_length(text: str) -> None:
    section = parse_yaml(text, "some.yaml", "test", 1)
    section.quantity("a", "length")
    section.finish()


def answer(asked: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the message of a command (in braces: the errors of its b.yaml), or of a YAML file with a length ``a``."""
    if asked.startswith("yaml "):
        with pytest.raises(InputFileError) as caught:
            read_length(YAML + json.loads(asked.removeprefix("yaml ")))
        return str(caught.value)
    typed, brace, errors = asked.removeprefix("$ ").partition("{")
    if brace:
        Path("b.yaml").write_text(f"{BUDGET}{brace}{errors}\n", encoding="utf-8")
    for name in FILES.keys() & set(shlex.split(typed)):
        Path(name).write_bytes(json.loads(FILES[name]).encode("latin-1"))
    before = sorted(Path().rglob("*"))
    assert cli.main(shlex.split(typed)) == 2, "refused by exit code 2"
    out, err = capsys.readouterr()
    assert out == "", "nothing is printed"
    assert sorted(Path().rglob("*")) == before, "nothing is written"
    *usage, last = err.splitlines()
    assert usage[0].startswith("usage: hexapod_comp") if usage else last.startswith("hexapod_comp: error: "), err
    return last.replace(f"{config_folder()}", "config").partition(" (choose from")[0]  # varies with Python


@pytest.mark.parametrize(("line", "asked"), CASES, ids=[asked for _, asked in CASES])
def test_message(
    line: int, asked: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    said = answer(asked, capsys)
    if "RENEW_REPORTS" in os.environ:
        LINES[line + 1 : line + 2] = [f"  {said}"]
        GOLDEN.write_text("\n".join(LINES) + "\n", encoding="utf-8")
    assert LINES[line + 1] == f"  {said}"


@pytest.mark.parametrize(("typed", "wanted"), LISTED, ids=[typed for typed, _ in LISTED])
def test_report(typed: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in FILES.keys() & set(shlex.split(typed)):
        Path(name).write_bytes(json.loads(FILES[name]).encode("latin-1"))
    code, out, err = hexapod(*shlex.split(typed))
    printed = "".join(f"  {line}".rstrip() + "\n" for line in [*(out + err).splitlines(), f"exit code {code}"]) + "\n"
    if "RENEW_REPORTS" in os.environ:
        text = REPORTS.read_text(encoding="utf-8")
        REPORTS.write_text(text.replace(f"$ {typed}\n{wanted}", f"$ {typed}\n{printed}"), encoding="utf-8")
        return
    assert_same_text(printed, wanted, small=1e-12)
