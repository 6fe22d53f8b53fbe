"""Files of a wrong kind: every reader refuses them with a message before it reads or expands them.

The only right answer is an InputFileError that begins with the file's name. Sparse files reach bounds of size at once;
the tests lower bounds that would take time.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hexapod_comp.calibration.certificate import load_details
from hexapod_comp.errors import InputFileError
from hexapod_comp.export.table import read_table
from hexapod_comp.formats import csv, files
from hexapod_comp.formats.csv import Layout, Table
from hexapod_comp.formats.json import json_content
from hexapod_comp.formats.yaml import yaml_content
from hexapod_comp.machine.geometry import load_geometry, parse_geometry
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.pose_files import poses_of, read_lengths, read_poses
from hexapod_comp.measurements.campaign import load_campaign
from hexapod_comp.measurements.files import read_measurements
from hexapod_comp.measurements.wide_csv import load_columns
from hexapod_comp.virtual.warm_up import load_warm_up
from hexapod_comp.workspace.budget import load_budget

CONFIG = Path(__file__).resolve().parents[2] / "config"
PAPER = load_geometry("paper")

READERS: dict[str, Callable[[Path], Any]] = {
    "geometry": load_geometry,
    "model": lambda path: load_model(path, PAPER),
    "campaign": load_campaign,
    "budget": load_budget,
    "columns": load_columns,
    "warm-up": load_warm_up,
    "details": load_details,
    "poses": read_poses,
    "lengths": read_lengths,
    "grid table": read_table,
    "tidy": lambda path: read_measurements(path, PAPER),
    "wide": lambda path: read_measurements(path, PAPER, "jugglebot_columns"),
}


def unix_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as endpoint:
        endpoint.bind(os.path.relpath(path))


def huge(path: Path) -> None:
    with open(path, "wb") as stream:
        stream.truncate(1 << 40)  # sparse: a terabyte that occupies nothing


def containing(content: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(content) and None


ALIASES = b"a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + b"".join(
    b"%c: &%c [%s]\n" % (98 + n, 98 + n, b", ".join([b"*%c" % (97 + n)] * 9)) for n in range(12)
)

HOSTILE: dict[str, Callable[[Path], None]] = {
    "FIFO": os.mkfifo,
    "socket": unix_socket,
    "device without an end": lambda path: path.symlink_to("/dev/zero"),
    "empty device": lambda path: path.symlink_to("/dev/null"),
    "huge": huge,
    "folder": os.mkdir,
    "link to itself": lambda path: path.symlink_to(path),
    "empty": containing(b""),
    "zeros": containing(bytes(5000)),
    "picture": containing(b"\x89PNG\r\n\x1a\n" + bytes(range(256))),
    "archive": containing(b"PK\x03\x04\x14\0\x06\0" + bytes(range(255, 0, -1))),
    "references": containing(ALIASES),
    "deep": containing(b"[" * 100_000),
    "list": containing(b"[]\n"),
    "mapping": containing(b"{}\n"),
    "null": containing(b"null\n"),
    "one line": containing(b"x" * (csv.MAX_LINE + 1)),
    "commas": containing(b"," * 100_000),
}


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_such_file_is_refused_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, make in HOSTILE.items():
        path = tmp_path / f"{name}.x"
        make(path)
        with pytest.raises(InputFileError) as caught:
            READERS[reader](path)
        assert str(caught.value).startswith(str(path)), name


# Bounds


def test_yaml_of_many_short_values_is_refused_before_it_is_made(tmp_path: Path) -> None:
    """8 MB of ``[],`` took 1.6 GB and 24 s as Python objects, so the bound counts the parser's events."""
    with pytest.raises(InputFileError, match="line 1: is not valid YAML: contains more than the allowed 1000 values"):
        yaml_content("[" + "[]," * 2000 + "]", "some.yaml", most_nodes=1000)
    assert yaml_content("[" + "[]," * 998 + "]", "some.yaml", most_nodes=1000) == [[]] * 998


@pytest.mark.parametrize(("bound", "said"), [("MAX_ROWS", "5 rows"), ("MAX_CELLS", "5 cells"), ("MAX_CSV_BYTES", "MB")])
def test_tables_are_bounded_while_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str, said: str
) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("x_mm,y_mm,z_mm\n" + "0,0,400\n" * 20)
    monkeypatch.setattr(csv, bound, 5)
    with pytest.raises(InputFileError, match=f"allowed .*{said}"):
        read_poses(path)


@pytest.mark.parametrize(("bound", "refused"), [(174, True), (175, False)])
def test_a_pipe_is_bounded_too(monkeypatch: pytest.MonkeyPatch, bound: int, refused: bool) -> None:
    """The size of a pipe, here 175 bytes, is not known before it is read."""
    monkeypatch.setattr(csv, "MAX_CSV_BYTES", bound)
    for read in (read_poses, lambda path: files.read_bytes(path, bound)):
        reading, writing = os.pipe()
        try:
            os.write(writing, b"x_mm,y_mm,z_mm\n" + b"0,0,400\n" * 20)
            os.close(writing)
            with pytest.raises(InputFileError, match=r"allowed 0\.000174 MB") if refused else nullcontext():
                read(f"/dev/fd/{reading}")
        finally:
            os.close(reading)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "nested too deep"),
        ("[NaN]", "NaN is not valid JSON"),
        ("[-Infinity]", "-Infinity is not valid JSON"),
        ("{", "line 1 column 2"),
        ("1" * 101, "101 characters, at most 100 are allowed"),
        ("1" * 5000, "characters"),
    ],
)
def test_json_that_is_refused(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        json_content(text, 100 if len(text) < 10_000 else 200_000)


# Encodings


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "windows-1252", "latin-1"])
def test_tables_in_any_usual_encoding(tmp_path: Path, encoding: str) -> None:
    """Files in the encodings of editors and spreadsheets are read; UTF-16 without a mark must be named."""
    path = tmp_path / "poses.csv"
    path.write_bytes("name;x_µm;y_mm;z_mm\nMeßpunkt Ö;1,5;2;400\n".encode(encoding))
    named = encoding.removesuffix("-le") if encoding.endswith("-le") else ""
    if named:
        path.write_bytes(b"\xff\xfe" + path.read_bytes())
    table = Table(path, Layout(encoding=named))
    assert table.labels()[0].label == "Meßpunkt Ö"
    assert poses_of(table)[0].tolist() == [[1.5e-6, 0.002, 0.4]]
    assert [note.endswith("read as Windows-1252") for note in table.notes] == [True] * (encoding[0] in "wl")


def test_an_encoding_that_is_named_is_meant(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_bytes("name,x_mm,y_mm,z_mm\nMeßpunkt,1,2,400\n".encode("latin-1"))
    with pytest.raises(InputFileError, match=r"poses\.csv: is not UTF-8 text$"):
        Table(path, Layout(encoding="utf-8"))
    path.write_bytes(b"\xff\xfex\x00\x00\xd8y\x00")  # half of a pair
    with pytest.raises(InputFileError, match=r"is not UTF-16 text; in a spreadsheet choose 'CSV UTF-8' when saving$"):
        Table(path)


# Typing errors


def test_a_geometrys_key_or_number_typed_wrong() -> None:
    text = (CONFIG / "example_6_6.yaml").read_text(encoding="utf-8")
    text = re.sub(r"correction_um: *[\d.]+", "correction_um: 1000", text)
    for before, after, said in (
        (
            "correction_um: 1000",
            "correction_um: 2,000",
            r"its comma may be .* thousands separator: write 2\.000 or 2000",
        ),
        ("correction_um: 1000", "correction_um: 2,5", r"must be a number, with a decimal point: 2\.5"),
        ("step_mm", "stepp_mm", r"step: is missing; write one of step_m, .*; is 'stepp_mm' a misspelling of it\?"),
    ):
        with pytest.raises(InputFileError, match=said):
            parse_geometry(text.replace(before, after))
    tree = yaml.safe_load(text)
    for body in ("base", "platform"):
        tree[body]["joints_mm"] = (np.array(tree[body]["joints_mm"]) / 25.4).round(4).tolist()
    with pytest.raises(InputFileError, match=r"is a unit wrong\? With base.joints and platform.joints in inches"):
        parse_geometry(yaml.safe_dump(tree))
