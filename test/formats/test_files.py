"""Strict YAML: units in key names, and files that no sane reader should take."""

from __future__ import annotations

import numpy as np
import pytest

from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.schema import MOST_NEIGHBOURS, UNITS, Section
from hexapod_comp.formats.yaml import read_yaml

HEAD = "format: test\nversion: 1\n"


def load(folder, text):
    path = folder / "some.yaml"
    path.write_text(text, encoding="utf-8")
    return read_yaml(path, "test", 1)


def section(**content):
    return Section("some.yaml", "", content)


# Whole files.


def test_byte_order_mark_and_windows_line_ends(tmp_path):
    path = tmp_path / "windows.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + (HEAD + "name: x\n").replace("\n", "\r\n").encode())
    assert read_yaml(path, "test", 1).text("name") == "x"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: 2026-13-45", "line 3: is not valid YAML: '2026-13-45' is no date"),
        ("a: " + "1" * 5000, r"line 3: is not valid YAML: '1+… is too long for a number"),
        ("[" * 5000, "is not valid YAML"),
        ("a:\n " + "- " * 100_000 + "1", "nested more than 32 deep"),
    ],
)
def test_yaml_that_is_refused(tmp_path, text, said):
    """What is shorter stands in test/cli/messages.txt, as what YAML 1.1 reads otherwise than people do: 0400 is 256."""
    with pytest.raises(InputFileError, match=said):
        load(tmp_path, HEAD + text)


@pytest.mark.parametrize(
    ("number", "value"),
    [("0", 0), ("-0.5", -0.5), ("+400", 400), ("400.", 400), (".5", 0.5), ("1.5e-3", 0.0015), ("0.05", 0.05)],
)
def test_numbers_that_mean_what_they_say(tmp_path, number, value):
    assert load(tmp_path, HEAD + f"a_m: {number}").quantity("a", "length") == value


def test_deep_nesting_does_not_end_the_process(tmp_path):
    """The parser builds its tree by recursion in C: four million brackets overflowed its stack (SIGSEGV)."""
    with pytest.raises(InputFileError, match="nested more than 32 deep"):
        load(tmp_path, HEAD + "a: " + "[" * 4_000_000)


def test_a_missing_key_among_very_many(tmp_path):
    """Looking for the nearest of half a million names took 17 s: only the first of them are looked through."""
    others = "".join(f"n{number}: 1\n" for number in range(MOST_NEIGHBOURS))
    with pytest.raises(InputFileError, match=r"format: is missing; did you mean it by 'formt'\?$"):
        load(tmp_path, "formt: test\n" + others)
    with pytest.raises(InputFileError, match=r"format: is missing$"):
        load(tmp_path, others + "formt: test\n")


def test_messages_are_one_line_without_control_codes(tmp_path):
    with pytest.raises(InputFileError) as caught:
        load(tmp_path, HEAD + '"a\\n\\e[2J": 1').finish()
    assert str(caught.value).endswith(r"a\n\x1b[2J: is not a known key here (found 1)")


# Values.


@pytest.mark.parametrize(
    ("dimension", "unit", "number", "si"),
    [
        ("length", "mm", 350, 0.35),
        ("length", "um", 12.3, 12.3e-6),
        ("length", "in", 8, 0.2032),
        ("length", "m", 1.5, 1.5),
        ("angle", "deg", 180, np.pi),
        ("angle", "urad", 5, 5e-6),
        ("angle", "mrad", 5, 5e-3),
        ("ratio", "ppm", 7, 7e-6),
        ("ratio", "percent", 2, 0.02),
        ("expansion", "ppm_per_K", 11.7, 11.7e-6),
        ("speed", "m_min", 15, 0.25),
        ("time", "ms", 20, 0.02),
    ],
)
def test_units(dimension, unit, number, si):
    """Truth: the definitions of the units; exact, since 350 mm in a file must be the 0.35 of source code."""
    assert section(**{f"a_{unit}": number}).quantity("a", dimension) == si


@pytest.mark.parametrize("micro", ["\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"])
def test_both_micro_signs_are_the_u_of_um(tmp_path, micro):
    taken = load(tmp_path, HEAD + f"a_{micro}m: 12.3\nb_{micro}rad: [1, 2]\nunit: {micro}m\n")
    assert taken.quantity("a", "length") == 12.3e-6
    np.testing.assert_array_equal(taken.quantity("b", "angle", (2,)), [1e-6, 2e-6])
    assert taken.unit("unit", "length") == 1e-6
    taken.finish()
    with pytest.raises(InputFileError, match="a_um: is given twice, also as a_"):
        section(**{"a_um": 1, f"a_{micro}m": 2}).quantity("a", "length")
    with pytest.raises(InputFileError, match=r"unit: must be one of m, mm, um, in \(found"):
        section(unit=f"{micro}rad").unit("unit", "length")
    with pytest.raises(InputFileError, match=r"must be one of m, mm, um, in \(found \['um'\]\)"):
        section(unit=["um"]).unit("unit", "length")


def test_a_micro_sign_of_windows(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_bytes((HEAD + "a_µm: 3").encode("cp1252"))
    assert read_yaml(path, "test", 1).quantity("a", "length") == 3e-6


def test_every_unit_ends_its_key_in_one_way():
    """A key must not fit two units of one kind: a_m_min is not the length a_m in min."""
    for units in UNITS.values():
        assert all(not one.endswith(f"_{other}") for one in units for other in units)


def test_default_is_si_and_only_for_a_missing_key():
    assert section().quantity("a", "length", (), 0.5) == 0.5
    with pytest.raises(InputFileError, match="a_mm: must be a number"):
        section(a_mm=None).quantity("a", "length", (), 0.5)


def test_key_paths_of_nested_lists():
    first, second = section(lines=[{"at": 1}, {}]).sections("lines")
    assert first.require("at") == 1
    with pytest.raises(InputFileError, match=r"some\.yaml: lines\[1\]\.at: is missing"):
        second.require("at")
