"""Schemas: a dataclass whose fields are the keys of a file, read with their units, and numbers written back."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import pytest

from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.formats.schema import (
    PER_STRUT,
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


@dataclass(frozen=True)
class Wave:
    """A section."""

    period: Annotated[float, Numbers("mm")]
    cosine: Annotated[np.ndarray, Numbers("um", PER_STRUT)] = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True)
class Machine:
    """A file."""

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
    """Truth: 880.1 mm is the very 0.8801 of source code, an inch 25.4 mm, one number stands for six struts."""
    read_in = machine(wave={"period_in": 0.2, "cosine_µm": 1.1}, columns=["a", "b", "c"])
    assert read_in.stroke.tolist() == [0.33, 0.8801]
    assert read_in.wave.period == pytest.approx(5.08e-3, rel=1e-15)
    assert read_in.wave.cosine.tolist() == [1.1e-6] * 6
    assert (read_in.ratio, read_in.points, read_in.outside, read_in.columns) == (1.0, 2, "hold", ("a", "b", "c"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"stroke_mm": [1, 2, 3]}, r"stroke_mm: must be numbers of shape 2, not 3"),
        ({"stroke_mm": [880, 330]}, r"stroke: must rise \(found \[0\.88, 0\.33\]\)"),
        ({"points": 10}, r"points: must be 2 to 9 \(found 10\)"),
        ({"points": 2.0}, "points: must be a whole number"),
        ({"outside": "held"}, r"outside: must be one of hold, refuse \(found 'held'\)"),
        ({"columns": ["a"]}, "columns: must be a list of 3 column names"),
        ({"unit": "mm"}, "unit: must be one of rad, mrad"),
        ({"wave": {"perod_mm": 5}}, r"wave\.period: is missing; write one of .*; did you mean it by 'perod_mm'"),
        ({"wave": 5}, "wave: must be a mapping"),
        ({"wave": {"period_mm": 5, "sine": 1}}, r"wave\.sine: is not a known key here"),
        ({"inside": "x"}, "inside: is not a known key here"),
        ({"raito": 2}, r"raito: is not a known key here; did you mean 'ratio'\?"),
    ],
)
def test_what_is_refused(content, said):
    with pytest.raises(InputFileError, match=rf"^some\.yaml: {said}"):
        machine(**content)


@pytest.mark.parametrize(("numbers", "size"), [(Numbers("um", PER_STRUT), 1e-5), (Numbers("mm", (6,)), 0.3)])
def test_written_numbers_read_back_to_the_same_values(numbers: Numbers, size: float):
    """Property; to one rounding, and what has been read is written back unchanged."""
    values = np.random.default_rng(4).normal(0.0, size, 6)
    key, written = numbers.write("cosine", values)
    back = numbers.read(Section("some.yaml", "", {key: written}), "cosine", None)
    np.testing.assert_allclose(back, values, rtol=3e-16)
    assert numbers.write("cosine", back) == (key, written)


def test_what_is_given_is_not_looked_for():
    section = Section("some.yaml", "", {"name": "x", "outside": "refuse"})
    assert read(Machine, section, stroke=np.array([0.1, 0.2]), inside="y").inside == "y"
