"""Common parts of the fuzz tests: numbers of cases, unusual values, mutations of files, and a second reader of YAML.

A bounded number of cases, always the same ones, runs with the other tests. ``python -m benchmarks.fuzz`` sets
``HEXAPOD_FUZZ_CASES``, which is divided among the tests, with new cases for every ``--hypothesis-seed``.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from hexapod_comp.errors import HexapodError

# number of cases of a nightly run, for all tests together; 0 for the bounded run
NIGHTLY = int(os.environ.get("HEXAPOD_FUZZ_CASES", "0"))

COUNTS: Counter[str] = Counter()  # by test: cases run, and cases accepted (``… accepted``)

if "HEXAPOD_FUZZ_COUNTS" in os.environ:
    KEPT = Path(os.environ["HEXAPOD_FUZZ_COUNTS"], f"{os.getpid()}.json")
    atexit.register(lambda: KEPT.write_text(json.dumps(COUNTS)))

# Longest readable message, characters
LONGEST_MESSAGE = 2500


def cases(bounded: int, share: float) -> settings:
    """Return hypothesis settings: `bounded` cases, or a share (0…1) of the nightly run's cases."""
    return settings(
        max_examples=max(bounded, round(NIGHTLY * share)),
        derandomize=not NIGHTLY,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        print_blob=True,
    )


# Numbers, and texts that some program takes for a number
NASTY_NUMBERS = (
    *("0", "-0", "1", "-1", "7", "400", "1e308", "-1e308", "1e-308", "5e-324", "1e400", "-1e400", "1e-400", "1.0e+308"),
    *("nan", ".nan", "inf", "-inf", ".inf", "-.INF", "1e3", "1.0e+3", "1.5E-3", ".5", "5.", "+3", "--3", "1-", "1e"),
    *("0400", "0x10", "0o17", "0b11", "1:30", "1:30.5", "1_000", "1,5", "1 5", "1'000", "1.2.3", "½", "１２", "٣"),
    *("400mm", "'400'", '"400"', "true", "no", "~", "null", "", "[1]", "{a: 1}", "!!float 5", "2026-01-31"),
    *("9" * 20, "1" * 400, "0." + "3" * 60, "179769313486231580793e289", "4.35", "1.0000000000000002", "0.1"),
)

# Texts with a special meaning for some reader
NASTY_TEXTS = (
    *("\0", "\ufeff", "\r", "\r\n", "\n", "\t", " ", "\x85", "\u2028", "\x1b[2J", "é", "\u202e", "\ud800", "\x7f"),
    *(",", ";", '"', "'", '"\n"', ":", ": ", "#", " # ", "-", "- ", "---\n", "...\n", "?", "? ", "|", ">", "%", "@"),
    *("[", "]", "{", "}", "[[", "]]", "[" * 50, "{a: " * 50, "&a ", "*a", "<<: ", "!!", "!!bool x", "!!float ''"),
    *("%YAML 1.2\n---\n", "%TAG ! tag:x,2000:\n---\n", "!!binary =", "!!timestamp 0", "!!set {a}", "!!omap [a: 1]"),
    *("EOF::", "Data:\r\n", "HEADER::\n", "RUNS::\n", "Targets :", "Sample no: ", "[JOINT_0]\n", "setp ", "# set "),
    *("_mm", "_um", "_in", "_deg", "forward", "backward", "linear", "roll", "mm", "um", "rad", "x", "both", "home"),
)

UNIT_NAMES = ("_m", "_mm", "_um", "_in", "_rad", "_mrad", "_urad", "_deg", "_arcsec", "_ppm", "_percent", "_s", "")

numbers = st.one_of(
    st.sampled_from(NASTY_NUMBERS),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.floats(-1000.0, 1000.0).map(lambda v: f"{v:.6f}"),
    st.integers(-5, 1000).map(str),
)
tokens = st.one_of(st.sampled_from(NASTY_TEXTS), numbers, st.text(max_size=4))

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")
UNIT = re.compile(r"_(?:mm_s|mm|um|m|in|deg|rad|urad|mrad|arcsec|ppm_per_K|ppm|percent|ms|s|degC)\b(?=\s*[:,\r\n])")


# Edits of a part of a file; edits of numbers are the most frequent
EDITS = ("number", "number", "number", "unit", "overwrite", "overwrite", "byte", "cut", "copy")
EDITS += ("drop line", "repeat line", "swap lines")


def edited(text: str, edit: str, place: int, span: int, token: str) -> str:
    """Return a text after one of :data:`EDITS`."""
    if edit in ("number", "unit"):
        found = list((NUMBER if edit == "number" else UNIT).finditer(text))
        if not found:
            return text
        start, end = found[place % len(found)].span()
        return text[:start] + (token if edit == "number" else UNIT_NAMES[span % len(UNIT_NAMES)]) + text[end:]
    if edit.endswith(("line", "lines")):
        lines = text.splitlines(keepends=True) or [""]
        one, other = place % len(lines), span % len(lines)
        if edit == "drop line":
            del lines[one]
        elif edit == "repeat line":
            lines.insert(other, lines[one])
        else:
            lines[one], lines[other] = lines[other], lines[one]
        return "".join(lines)
    start, to = place % (len(text) + 1), span % (len(text) + 1)
    if edit == "cut":
        return text[:start]
    if edit == "copy":
        return text[:to] + text[start : start + 60] + text[to:]
    if edit == "byte":
        return text[:start] + chr(span % 256) + text[start + 1 :]
    return text[:start] + token + text[start + span % 9 :]


# Changes of a whole file by encodings, line ends and spreadsheets
WHOLE: tuple[Callable[[bytes], bytes], ...] = (
    lambda data: b"\xef\xbb\xbf" + data,
    lambda data: data.decode("latin-1").encode("utf-16"),
    lambda data: data.decode("latin-1").encode("utf-32"),
    lambda data: data.replace(b"\n", b"\r\n"),
    lambda data: data.replace(b"\n", b"\r"),
    lambda data: data + b"\0",
    lambda data: data + data,
    lambda data: data[::-1],
    lambda data: data.rstrip(),
    lambda data: b"",
    lambda data: data.replace(b".", b","),
    lambda data: data.replace(b" ", b"\xc2\xa0"),
    lambda data: data.replace(b",", b";"),
    lambda data: data.upper(),
)

places = st.integers(0, 1 << 14)
# Edits of a file, each as (edit, place, span, token); see :func:`mutated`
edits = st.lists(st.tuples(st.integers(0, len(EDITS)), places, places, tokens), min_size=1, max_size=3)


def mutated(data: bytes, changes: list[tuple[int, int, int, str]]) -> bytes:
    """Return a file after some edits of its bytes, which latin-1 maps to characters one by one."""
    for kind, place, span, token in changes:
        if kind == len(EDITS):
            data = WHOLE[place % len(WHOLE)](data)
        else:
            raw = token.encode("utf-8", "surrogatepass").decode("latin-1")
            data = edited(data.decode("latin-1"), EDITS[kind], place, span, raw).encode("latin-1")
    return data


class Refused(Exception):
    """The refusal of a file by its reader."""


@contextlib.contextmanager
def reader_of(test: str, *files: Path) -> Iterator[None]:
    """Count a case of a test; check the message of a HexapodError and raise :class:`Refused`."""
    COUNTS[test] += 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # overflow warnings on numbers that are then refused
        try:
            yield
        except HexapodError as error:
            check_message(str(error))
            raise Refused from error
    COUNTS[f"{test} accepted"] += 1


def check_message(text: str) -> None:
    """Check that a message is one printable line of at most 2,500 characters."""
    assert text
    assert len(text) <= LONGEST_MESSAGE, text[:300]
    assert text.isprintable(), text


def finite(*arrays: Any) -> None:
    """Check that all numbers are finite."""
    for array in arrays:
        assert np.isfinite(np.asarray(array, dtype=float)).all(), array


# A second reading of files: numbers by Decimal, units by their definitions

# Factor to SI and SI unit of each unit; units whose factor is no short decimal stay as they are
UNITS = {
    **{unit: (factor, "m") for unit, factor in (("m", "1"), ("mm", "0.001"), ("um", "0.000001"), ("in", "0.0254"))},
    **{unit: (factor, "rad") for unit, factor in (("rad", "1"), ("mrad", "0.001"), ("urad", "0.000001"))},
    **{unit: (factor, "s") for unit, factor in (("s", "1"), ("ms", "0.001"))},
    **{unit: (factor, "m_s") for unit, factor in (("m_s", "1"), ("mm_s", "0.001"))},
    **{unit: ("1", unit) for unit in ("deg", "arcsec", "ppm", "percent", "ppm_per_K", "degC", "m_min")},
}

# Numbers that every reader understands in the same way
PLAIN = re.compile(r"[-+]?(?:(?:0|[1-9]\d*)(?:\.\d*)?|\.\d+|0+\.\d*)(?:[eE][-+]?\d+)?", re.ASCII)

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def check_document(data: bytes) -> yaml.Node:
    """Return a YAML file's tree of nodes; check that it contains no alias and no tag."""
    text = data.decode("utf-8-sig")
    for event in yaml.parse(text, Loader=LOADER):
        assert not isinstance(event, yaml.AliasEvent)
        assert getattr(event, "tag", None) is None
    return yaml.compose(text, Loader=LOADER)
