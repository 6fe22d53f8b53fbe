"""Files, tables and terminal output are written completely, and contain nothing that another program would execute."""

from __future__ import annotations

import base64
import csv
import io
import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from hexapod_comp import cli
from hexapod_comp.errors import InputFileError
from hexapod_comp.formats import outputs, paths
from hexapod_comp.formats.csv import Table, csv_text, unmarked
from hexapod_comp.formats.figures import picture_text, save
from hexapod_comp.formats.outputs import new_file, write_text
from hexapod_comp.formats.pages import _environment, png, render
from hexapod_comp.formats.texts import PlainStream

ROOT = Path(__file__).resolve().parents[2]
# Sets a terminal's title, clears it, colours it (one C1 code), reverses the direction of text
SENTINEL = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e"


# Files


def test_modes_and_links_stay_what_the_user_wants(tmp_path):
    """A new file gets its mode from the umask; an overwritten file keeps its mode, and a link stays a link."""
    path, link = tmp_path / "out.yaml", tmp_path / "link.yaml"
    before = os.umask(0o027)
    try:
        write_text(path, "né\n")
    finally:
        os.umask(before)
    assert path.read_bytes() == "né\n".encode()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    link.symlink_to("out.yaml")
    for mode in (0o600, 0o664, 0o755):
        path.chmod(mode)
        write_text(link, f"new {mode}")
        assert link.is_symlink()
        assert path.read_text() == f"new {mode}"
        assert stat.S_IMODE(path.stat().st_mode) == mode
    assert set(os.listdir(tmp_path)) == {"out.yaml", "link.yaml"}


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is protected against root")
def test_a_file_that_is_protected_against_writing_stays(tmp_path):
    path = tmp_path / "out.yaml"
    path.write_text("old")
    path.chmod(0o444)
    with pytest.raises(InputFileError, match="write-protected"):
        write_text(path, "new")
    assert path.read_text() == "old"


def test_a_file_is_on_the_disk_before_it_takes_the_place_of_another(tmp_path, monkeypatch):
    """Otherwise a power cut may leave an empty file under the new name (ext4, XFS)."""
    happened = []
    real = {name: getattr(os, name) for name in ("fsync", "replace")}
    monkeypatch.setattr(outputs.os, "fsync", lambda handle: happened.append(os.fstat(handle).st_size))
    monkeypatch.setattr(outputs.os, "replace", lambda *names: (happened.append("rename"), real["replace"](*names)))
    write_text(tmp_path / "out.yaml", "12345")
    assert happened == [5, "rename"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_whatever_interrupts_writing_leaves_the_old_file_and_no_litter(tmp_path, error):
    path = tmp_path / "out.yaml"
    path.write_text("old")

    def write_half() -> None:
        with new_file(path) as stream:
            stream.write("half of the n")
            raise error

    with pytest.raises((InputFileError, KeyboardInterrupt)):
        write_half()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.yaml"]


def test_write_into_nowhere_over_a_folder_and_by_the_longest_name(tmp_path):
    """The temporary file's name must not be longer than the file's: the limit is 255 bytes."""
    with pytest.raises(InputFileError, match=r"no/out\.yaml: cannot be written: No such file"):
        write_text(tmp_path / "no" / "out.yaml", "x")
    (tmp_path / "out.yaml").mkdir()
    with pytest.raises(InputFileError, match="cannot be written"):
        write_text(tmp_path / "out.yaml", "x")
    assert os.listdir(tmp_path) == ["out.yaml"]
    name = "é" * 125 + ".csv"
    write_text(tmp_path / name, "x")
    assert set(os.listdir(tmp_path)) == {"out.yaml", name}


def test_an_installed_package_finds_its_configuration(tmp_path, monkeypatch):
    """pip and colcon install the configuration into `share` in a folder above the package."""
    config, package = (
        tmp_path / "share" / "hexapod_comp" / "config",
        tmp_path / "lib" / "site-packages" / "hexapod_comp",
    )
    config.mkdir(parents=True)
    monkeypatch.setattr(paths, "__file__", str(package / "formats" / "paths.py"))
    assert paths.config_folder.__wrapped__() == config
    monkeypatch.setattr(paths, "config_folder", lambda: config)
    text = f"{config.parent}/package.xml: cannot be read: No such file or directory; install the package again"
    with pytest.raises(InputFileError, match=f"^{re.escape(text)}$"):
        paths.version()
    for content, version in (("<package/>", "unknown"), ("<a>x</a>\n<version> 1.2\n</version>", "1.2")):
        (config.parent / "package.xml").write_text(content)
        assert paths.version() == version
    monkeypatch.undo()
    assert paths.input_file("-") == Path("/dev/stdin")
    with pytest.raises(InputFileError, match="/dev/null: is not a regular file"):
        paths.confined_file("/dev/null", None)
    monkeypatch.setattr(paths, "__file__", "/nowhere/hexapod_comp/formats/paths.py")
    with pytest.raises(InputFileError, match="contains share/hexapod_comp/config; install the"):
        paths.config_folder.__wrapped__()


# Tables: texts that spreadsheets execute, after OWASP's list

HOSTILE = ["=1+1", "+1+1", "-1+1", "@SUM(A1)", "\tx", "'=1", "''+x", " =1", "-", '=HYPERLINK("http://x","y")']
HARMLESS = ["", "plain", "a=b", "'quoted'", "x-1", "nan", "0", "12.5"]


@pytest.mark.parametrize("text", [*HARMLESS, "-1.5", "+2", "-1e-05", -1.5, 3])
def test_numbers_and_harmless_texts_stay(text):
    assert next(csv.reader(io.StringIO(csv_text([[text, "x"]]))))[0] == str(text)


def test_a_text_that_a_spreadsheet_would_run_is_marked_and_read_back(tmp_path):
    for text in HOSTILE:
        ((cell, _),) = csv.reader(io.StringIO(csv_text([[text, "x"]])))
        assert (cell, unmarked(cell)) == ("'" + text, text)
    assert all(unmarked(text) == text for text in HARMLESS)
    labels = [text for text in HOSTILE if text == text.strip()]
    path = tmp_path / "poses.csv"
    path.write_text(csv_text([["name", "x_mm"], *([label, -1.0] for label in labels)]))
    assert [row.label for row in Table(path).labels()] == labels


# Terminals and pictures


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_codes_are_shown_and_not_obeyed(stream):
    inner = io.StringIO()
    print(f"a\tb {SENTINEL}", file=PlainStream(inner, stream == "stdout"))
    assert inner.getvalue() == "a\tb \\x1b]0;owned\\x07\\x1b[2J\\x9b31m\\u202e\n"


def pixels(picture: bytes) -> tuple[int, int]:
    """Return width and height in the header of a PNG file."""
    return int.from_bytes(picture[16:20], "big"), int.from_bytes(picture[20:24], "big")


@pytest.mark.parametrize("name", ["$x^", "a $x_{$ b", r"\$\frac$", "$1 and $2", "\x1b[2J\n"])
def test_no_name_is_a_formula(name, tmp_path):
    """Matplotlib reads text between two $ as a formula, and raises an error if it is none."""
    figure = Figure(figsize=(2, 1))
    drawn = figure.suptitle(picture_text(name))
    save(figure, tmp_path / "title.png")
    assert pixels((tmp_path / "title.png").read_bytes()) == (280, 140)
    assert pixels(base64.b64decode(png(figure).partition("data:image/png;base64,")[2])) == (220, 110)
    shown, is_formula = drawn._preprocess_math(drawn.get_text())
    assert not is_formula
    assert shown.count("$") == name.count("$")


@pytest.mark.parametrize(("to", "codes"), [("> /dev/full", [2]), ("| true", [0, 141]), (">&-", [0])])
def test_an_output_that_nobody_takes_is_no_traceback(to, codes, tmp_path):
    """A full disk gives exit code 2 and a message; a closed pipe or stdout ends the program without a traceback."""
    (tmp_path / "poses.csv").write_text("sequence,x_mm,y_mm,z_mm\n" + "".join(f"{n},0,0,400\n" for n in range(3000)))
    words = f"{sys.executable} -m hexapod_comp ik poses.csv --machine paper {to}; exit ${{PIPESTATUS[0]}}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-c", words], cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode in codes  # `true` may have read everything before it ended
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert ("standard output: cannot be written: No space left" in done.stderr) == (codes == [2])


@pytest.mark.parametrize(
    "arguments",
    [
        ["ik", "poses.csv"],
        ["ik", "poses.csv", "--json"],
        ["check", "poses.csv", "--machine", "mine.yaml"],
        [SENTINEL],
        ["ik", "--pose", SENTINEL],
    ],
)
def test_codes_in_arguments_and_files_do_not_reach_the_terminal(arguments, tmp_path, monkeypatch, capsys):
    """``ik`` prints labels of a file, and argparse prints unknown arguments: control codes in them are escaped."""
    machine = (ROOT / "config" / "paper.yaml").read_text(encoding="utf-8")
    named = re.sub(r"(?m)^machine: .*$", r'machine: "\\e[2Jmine"', machine)
    (tmp_path / "mine.yaml").write_text(named, encoding="utf-8")
    (tmp_path / "poses.csv").write_text(f"name,x_mm,y_mm,z_mm\n{SENTINEL},0,0,400\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    cli.main(arguments)
    said = "".join(capsys.readouterr())
    assert said.strip()
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", said)


def test_cells_of_a_wide_table_carry_their_columns_names():
    """On narrow screens, which hide the head of a table, the style sheet shows these names in front of the cells."""
    table = _environment().get_template("parts.html").module.table
    text = table(("run", "readings", "RMS <σ>", "largest"), [("x1", 3, 0.5, 1.2)])
    assert '<table class="rows">' in text
    for cell in ('data-label="readings">3<', 'data-label="RMS &lt;σ&gt;">0.5<', 'data-label="largest">1.2<'):
        assert cell in text
    for template, length in (("{{ text }}", 2000), ("{{ text | cell }}", 300)):
        assert _environment().from_string(template).render(text="x" * 3000) == "x" * (length - 1) + "…"
    assert "attr(data-label)" in render("page.html", title="")
    assert "class" not in table(("", "name"), [("a", "b")]).partition("<table")[2].partition(">")[0]
