"""Strict YAML with units in key names; schemas, whose fields are a file's keys; results as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest
from helpers import beside

from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.formats.json import json_text
from hexapod_comp.formats.schema import (
    PER_STRUT,
    UNITS,
    Choice,
    Integer,
    Names,
    Numbers,
    Section,
    Text,
    Unit,
    read,
    read_whole,
)
from hexapod_comp.formats.yaml import read_yaml


@dataclass(frozen=True)
class Wave:
    """A section of the test's file."""

    period: Annotated[float, Numbers("mm")]
    cosine: Annotated[np.ndarray, Numbers("um", PER_STRUT)] = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True)
class Machine:
    """The schema of the test's file."""

    name: Annotated[str, Text()]
    stroke: Annotated[np.ndarray, Numbers("mm", (2,))]
    ratio: Annotated[float, Numbers("")] = 1.0
    points: Annotated[int, Integer(2, 9)] = 2
    outside: Annotated[str, Choice("hold", "refuse")] = "hold"
    columns: Annotated[tuple[str, ...], Names(3)] = ()
    unit: Annotated[float, Unit("angle")] = 1.0
    wave: Wave | None = None
    inside: str = "no key"

    def __post_init__(self) -> None:
        if self.stroke[1] <= self.stroke[0]:
            raise ModelError("stroke", "must rise", self.stroke.tolist())


GIVEN = {"name": "x", "stroke_mm": [330, 880.1]}


def machine(**content):
    return read_whole(Machine, Section("some.yaml", "", {**GIVEN, **content}))


def test_units_shapes_and_defaults():
    """880.1 mm is read as exactly 0.8801, an inch as 25.4 mm, and one number stands for all six struts."""
    read_in = machine(wave={"period_in": 0.2, "cosine_µm": 1.1}, columns=["a", "b", "c"])
    assert read_in.stroke.tolist() == [0.33, 0.8801]
    assert read_in.wave.period == pytest.approx(5.08e-3, rel=1e-15)
    assert read_in.wave.cosine.tolist() == [1.1e-6] * 6
    assert (read_in.ratio, read_in.points, read_in.outside, read_in.columns) == (1.0, 2, "hold", ("a", "b", "c"))


@pytest.mark.parametrize(("content", "said"), beside(__file__)["refused"])
def test_what_is_refused(content, said):
    with pytest.raises(InputFileError, match=rf"^some\.yaml: {said}"):
        machine(**content)


@pytest.mark.parametrize(("numbers", "size"), [(Numbers("um", PER_STRUT), 1e-5), (Numbers("mm", (6,)), 0.3)])
def test_written_numbers_read_back_to_the_same_values(numbers: Numbers, size: float):
    """Written numbers read back to one rounding; numbers that were read, with any digits, read back to the last bit."""

    def read_back(values: np.ndarray) -> np.ndarray:
        key, written = numbers.write("cosine", values)
        return numbers.read(Section("some.yaml", "", {key: written}), "cosine", None)

    for values in np.random.default_rng(4).normal(0.0, size, (50, 6)):
        back = read_back(values)
        np.testing.assert_allclose(back, values, rtol=3e-16)
        assert read_back(back).tobytes() == back.tobytes()
    for given in np.random.default_rng(5).normal(0.0, 10.0, (50, 6)).tolist():
        back = numbers.read(Section("some.yaml", "", {f"cosine_{numbers.unit}": given}), "cosine", None)
        assert read_back(back).tobytes() == back.tobytes()
        short = np.round(given, 2).tolist()
        back = numbers.read(Section("some.yaml", "", {f"cosine_{numbers.unit}": short}), "cosine", None)
        assert numbers.write("cosine", back)[1] == short, "as written"
    one = numbers.write("a", np.full(6, 1e-6))
    assert one == {"um": ("a_um", 1.0), "mm": ("a_mm", [1e-3] * 6)}[numbers.unit]


def test_what_is_given_is_not_looked_for():
    section = Section("some.yaml", "", {"name": "x", "outside": "refuse"})
    assert read(Machine, section, stroke=np.array([0.1, 0.2]), inside="y").inside == "y"


HEAD = "format: test\nversion: 1\n"


def load(folder, text):
    path = folder / "some.yaml"
    path.write_text(text, encoding="utf-8")
    return read_yaml(path, "test", 1)


def section(**content):
    return Section("some.yaml", "", content)


# Whole files


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
        ("a:\n " + "- " * 100_000 + "1", "nested deeper than the allowed 32 levels"),
        # The parser builds its tree by recursion in C: four million brackets overflowed its stack (SIGSEGV)
        ("a: " + "[" * 4_000_000, "nested deeper than the allowed 32 levels"),
        ('"a\\n\\e[2J": 1', r"a\\n\\x1b\[2J: is not a known key here \(found 1\)$"),
    ],
)
def test_yaml_that_is_refused(tmp_path, text, said):
    """Long texts; test/cli/messages.txt has short ones, and surprises of YAML 1.1 (0400 is 256)."""
    with pytest.raises(InputFileError, match=said):
        load(tmp_path, HEAD + text).finish()


def test_a_missing_key_among_very_many(tmp_path):
    """Only the first names are searched for a similar one: a search through half a million took 17 s."""
    others = "".join(f"n{number}: 1\n" for number in range(1000))
    with pytest.raises(InputFileError, match=r"format: is missing; is 'formt' a misspelling of it\?$"):
        load(tmp_path, "formt: test\n" + others)
    with pytest.raises(InputFileError, match=r"format: is missing$"):
        load(tmp_path, others + "formt: test\n")


# Values


DEFINED = (
    "length m 1 mm 1e-3 um 1e-6 in 0.0254, angle rad 1 mrad 1e-3 urad 1e-6, ratio ppm 1e-6 percent 0.01, "
    "expansion ppm_per_K 1e-6, moisture ppm_per_percent 1e-4, temperature degC 1, difference K 1, "
    "speed m_s 1 mm_s 1e-3 in_s 0.0254, acceleration m_s2 1 mm_s2 1e-3 in_s2 0.0254, "
    "jerk m_s3 1 mm_s3 1e-3 in_s3 0.0254, time s 1 ms 1e-3, "
    "force N 1 kN 1e3 lbf 4.4482216152605, torque N_m 1, mass kg 1 g 1e-3 lb 0.45359237, "
    "stiffness N_per_um 1e6 N_per_mm 1e3, "
    "pressure Pa 1 hPa 100 kPa 1e3"
)


def test_units():
    """The truth is the units' definitions, exactly: 350 mm in a file must equal 0.35 in source code."""
    rows = [row.split() for row in DEFINED.split(", ")]
    sizes = {kind: dict(zip(rest[::2], map(float, rest[1::2]), strict=True)) for kind, *rest in rows}
    sizes["angle"] |= {"deg": np.pi / 180, "arcsec": np.pi / (180 * 3600)}
    sizes["speed"] |= {"m_min": 1 / 60, "in_min": 0.0254 / 60}
    sizes["stiffness"]["lbf_per_in"] = 4.4482216152605 / 0.0254  # NIST Handbook 44: 175.1268 N/m
    assert sizes == UNITS
    given = {"a_mm": (350, "length", 0.35), "a_um": (12.3, "length", 12.3e-6), "a_deg": (180, "angle", np.pi)}
    for key, (number, dimension, si) in given.items():
        assert section(**{key: number}).quantity("a", dimension) == si
    with pytest.raises(InputFileError, match="a: must be a list"):
        list(section(a=1).sections("a"))


@pytest.mark.parametrize("micro", ["\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"])
def test_both_micro_signs_are_the_u_of_um(tmp_path, micro):
    taken = load(tmp_path, HEAD + f"a_{micro}m: 12.3\nb_{micro}rad: [1, 2]\nunit: {micro}m\n")
    assert taken.quantity("a", "length") == 12.3e-6
    np.testing.assert_array_equal(taken.quantity("b", "angle", (2,)), [1e-6, 2e-6])
    assert taken.unit("unit", "length") == 1e-6
    taken.finish()
    with pytest.raises(InputFileError, match="a_um: is given twice, also as a_"):
        section(**{"a_um": 1, f"a_{micro}m": 2}).quantity("a", "length")


def test_every_unit_ends_its_key_in_one_way():
    """No key may fit two units of one kind: a_m_min must not be the length a_m in min."""
    si = {unit for units in UNITS.values() for unit, factor in units.items() if factor == 1.0}
    assert " ".join(sorted(si)) == "K N N_m Pa degC kg m m_s m_s2 m_s3 rad s"
    for units in UNITS.values():
        assert all(not one.endswith(f"_{other}") for one in units for other in units)


class Place(NamedTuple):
    file: str
    line: int


@dataclass(frozen=True)
class Found:
    rms_um: np.ndarray
    place: Place
    best: Found | None = None
    kernel_joints: Any = field(init=False, repr=False, default=len)


def told(value: Any) -> Any:
    """Return a value as a program reads it from JSON; NaN is refused, though Python's reader accepts it."""

    def refuse(word: str) -> None:
        raise AssertionError(word)

    return json.loads(json_text(value), parse_constant=refuse)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.array([[1.5, math.nan], [math.inf, -0.0]]), [[1.5, None], [None, 0.0]]),
        (np.float64("nan"), None),
        (np.bool_(True), True),
        ({"b", "a"}, ["a", "b"]),
        (np.array([1.0, None, "x"], dtype=object), [1.0, None, "x"]),
        ({3: (1, 2.5), "µ": "„Ω“"}, {"3": [1, 2.5], "µ": "„Ω“"}),
        (Path("a") / "b", "a/b"),
        (date(2026, 1, 31), "2026-01-31"),
        (InputFileError("f", "k", "is odd", 3), {"reason": "bad_file", "problem": "f: k: is odd (found 3)"}),
        (
            Found(np.array([1.0, np.nan]), Place("a.csv", 3), Found(np.zeros((2, 0)), Place("b", 0))),
            {
                "rms_um": [1.0, None],
                "place": {"file": "a.csv", "line": 3},
                "best": {"rms_um": [[], []], "place": {"file": "b", "line": 0}, "best": None},
            },
        ),
    ],
)
def test_everything_a_result_is_made_of(value: Any, expected: Any):
    assert told(value) == expected


def test_numbers_come_back_to_the_last_bit():
    numbers = np.random.default_rng(3).standard_normal(1000) * 10.0 ** np.arange(-500, 500, dtype=float).clip(-300, 300)
    assert np.array_equal(told(numbers), numbers)


def test_what_json_has_no_word_for_is_refused():
    for value in (1j, b"bytes", object(), [{"deep": range}]):
        with pytest.raises(TypeError):
            json_text(value)
