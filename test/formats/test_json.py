"""Results as JSON: what every verb prints for programs."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.json import json_text


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
    """Return what a program reads; a NaN in the text would be no JSON, though Python reads it."""

    def refuse(word: str) -> None:
        raise AssertionError(word)

    return json.loads(json_text(value), parse_constant=refuse)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.array([[1.5, math.nan], [math.inf, -0.0]]), [[1.5, None], [None, 0.0]]),
        (np.float64("nan"), None),
        (np.float32(0.5), 0.5),
        (np.int64(7), 7),
        (np.bool_(True), True),
        (np.array(["a", "b"]), ["a", "b"]),
        (np.array([1.0, None, "x"], dtype=object), [1.0, None, "x"]),
        ({3: (1, 2.5), "µ": "„Ω“"}, {"3": [1, 2.5], "µ": "„Ω“"}),
        ({2, 1}, [1, 2]),
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


@pytest.mark.parametrize("value", [len, 1j, b"bytes", object(), [{"deep": range}]])
def test_what_json_has_no_word_for_is_refused(value: Any):
    with pytest.raises(TypeError):
        json_text(value)
