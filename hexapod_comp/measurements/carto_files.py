"""The files of Renishaw's laser software as they stand: dynamic captures (.rtx) and static linear runs (.rtl).

The maker documents neither format publicly. What is read here, and nothing else, is known from other people's
programs that read or write such files:

.rtx
    Public converters TanmayPani/rtx2csv (with the header of a capture by CARTO 4.13) and travdt/RTX2CSV-Converter:
    a text header of ``key: value`` lines under titles that end in ``::``, a line ``Data:``, little-endian float64
    samples in mm (or mrad), ``EOF::`` with or without a line end before it. Header keys seen: File Type, Owner,
    Version no, Velocity, Sample rate, Sample no, Trigger point, Trigger interval, Actual sample rate, Flags, Machine,
    Serial No, Date, By, Axis, Location. ``Sample no`` is the number of samples, ``Actual sample rate`` is in 1/s.
.rtl
    several public programs that read it and one that writes it agree on the sections HEADER, TARGET DATA
    (``Target-count``, ``Targets :`` with positions in mm over several lines, up to ``Flags:``), USER-TEXT, RUNS
    (``Run-count``) and DEVIATIONS (``Run Target Data:``, then run, target and deviation in each line; µm on linear
    runs). Sections ENVIRONMENT and EQUIPMENT exist; what is in them has not been read anywhere, so they are listed
    as not understood, and no correction is taken from them.

No file of the maker's own was at hand.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import InputFileError
from ..formats.csv import number_in
from ..formats.texts import plain_number

MAX_BYTES = 1_000_000_000
"""Longer files are refused: forty minutes at 50 kHz."""

MAX_HEADER_BYTES = 65_536
"""A header that does not end in ``Data:`` within this is none; those seen have 500 bytes."""

DATA_LINE = re.compile(rb"^Data:[ \t]*\r?\n", re.MULTILINE)
END_MARK = re.compile(rb"EOF::[ \t\r\n]*\Z")
TITLE = re.compile(r"([A-Z][A-Z0-9 \-]*)::\s*")
UNDERSTOOD = ("HEADER", "TARGET DATA", "USER-TEXT", "RUNS", "DEVIATIONS", "EOF")


@dataclass(frozen=True)
class Dynamic:
    """An .rtx file.

    Attributes
    ----------
    header : dict of str to str
        As it stands there.
    rate : float
        Samples per second.
    samples : ndarray, shape (N,)
        As they stand there; mm or mrad by default.
    sha256 : str
        Of the file.
    """

    header: dict[str, str]
    rate: float
    samples: np.ndarray
    sha256: str


@dataclass(frozen=True)
class Sectioned:
    """A text file in sections; lines keep their numbers.

    Attributes
    ----------
    sections : dict of str to list of (int, str)
        Line number and text of the lines under each title.
    titles : dict of str to int
        Line of each title.
    sha256 : str
        Of the file.
    """

    sections: dict[str, list[tuple[int, str]]]
    titles: dict[str, int]
    sha256: str


@dataclass(frozen=True)
class Static:
    """An .rtl file.

    Attributes
    ----------
    targets : ndarray, shape (m,)
        As they stand there; mm.
    rows : list of (int, int, float, int)
        Run, target (from 1), deviation as it stands there, line.
    entries : dict of str to str
        What HEADER, TARGET DATA, USER-TEXT and RUNS say; kept, not interpreted.
    sha256 : str
        Of the file.
    notes : tuple of str
        What was not understood.
    """

    targets: np.ndarray
    rows: list[tuple[int, int, float, int]]
    entries: dict[str, str]
    sha256: str
    notes: tuple[str, ...] = field(default=())


def _read_bytes(path: str | Path) -> bytes:
    try:
        with open(path, "rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be read: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise InputFileError(path, "", f"larger than the allowed {MAX_BYTES // 1_000_000} MB")
    if not content.strip():
        raise InputFileError(path, "", "is empty")
    return content


def is_capture(path: str | Path) -> bool:
    """Return whether a file is a dynamic capture, whatever its name says."""
    return DATA_LINE.search(_read_bytes(path)[:MAX_HEADER_BYTES]) is not None


def read_rtx(path: str | Path) -> Dynamic:
    """Read a dynamic capture.

    Unknown header lines are kept; the amount of data and the end mark must be right.

    Raises
    ------
    InputFileError
        No header or no ``Data:``, a truncated file (with the byte at which it ends), samples that are not finite.
    """
    content = _read_bytes(path)
    if not content.startswith(b"HEADER::"):
        raise InputFileError(path, "byte 0", "an .rtx file starts with HEADER::", content[:16])
    match = DATA_LINE.search(content, 0, MAX_HEADER_BYTES)
    if not match:
        raise InputFileError(path, "", f"has no line Data: within its first {MAX_HEADER_BYTES} bytes")
    header: dict[str, str] = {}
    for line in content[: match.start()].decode("utf-8", "replace").splitlines():
        entry = _entry(line)
        if entry and not TITLE.fullmatch(line.strip()):
            header.setdefault(*entry)
    samples = _samples(path, content, match.end(), _header_number(path, header, "Sample no", whole=True))
    rate = _header_number(path, header, "Actual sample rate", whole=False)
    return Dynamic(header, rate, samples, hashlib.sha256(content).hexdigest())


def _entry(text: str) -> tuple[str, str] | None:
    """Return key and value of a line ``key : value``."""
    key, colon, value = text.strip().partition(":")
    return (key.strip(), value.strip()) if colon and key[:1].isalpha() else None


def _header_number(path: str | Path, header: dict[str, str], key: str, whole: bool) -> float:
    """Return a number above zero from the header."""
    if key not in header:
        raise InputFileError(path, "header", f"has no line {key!r}")
    number = plain_number(header[key])
    if not number > 0.0 or (whole and number != int(number)):
        kind = "whole number" if whole else "number"
        raise InputFileError(path, f"header, {key}", f"must be a {kind} above zero", header[key])
    return number


def _samples(path: str | Path, content: bytes, start: int, count: float) -> np.ndarray:
    """Return the samples that start at a byte; the header says how many there are."""
    end = start + 8 * int(count)
    if len(content) < end:
        whole = (len(content) - start) // 8
        problem = f"is truncated: it ends after {whole} of {int(count)} samples, which end at byte {end}"
        raise InputFileError(path, f"byte {len(content)}", problem)
    if not END_MARK.fullmatch(content[end:].lstrip(b"\r\n")):
        problem = f"after {int(count)} samples there must be EOF::"
        raise InputFileError(path, f"byte {end}", problem, content[end : end + 16])
    samples = np.frombuffer(content, "<f8", int(count), start).astype(float)
    if not np.isfinite(samples).all():
        first = int(np.argmin(np.isfinite(samples)))
        raise InputFileError(path, f"byte {start + 8 * first}, sample {first + 1}", "must be finite", samples[first])
    return samples


def read_sections(path: str | Path) -> Sectioned:
    """Read a text file whose sections have titles such as ``TARGET DATA::``; lines before the first are refused.

    Text that is not UTF-8 is taken for Windows-1252: machine names and dates may hold anything.
    """
    content = _read_bytes(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", "replace")
    sections: dict[str, list[tuple[int, str]]] = {}
    titles: dict[str, int] = {}
    current: list[tuple[int, str]] | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        title = TITLE.fullmatch(line.strip())
        if title:
            name = title[1].strip()
            if name in sections:
                raise InputFileError(path, f"line {number}", f"section {name}:: is there twice")
            current = sections[name] = []
            titles[name] = number
        elif line.strip():
            if current is None:
                raise InputFileError(path, f"line {number}", "a title such as HEADER:: must come first", line[:40])
            current.append((number, line.strip()))
    return Sectioned(sections, titles, hashlib.sha256(content).hexdigest())


def read_rtl(path: str | Path) -> Static:
    """Read static linear runs.

    Raises
    ------
    InputFileError
        A section or entry that is needed is missing, numbers are none, counts do not fit; names the line.
    """
    file = read_sections(path)
    for name in ("TARGET DATA", "RUNS", "DEVIATIONS"):
        if name not in file.sections:
            raise InputFileError(path, "", f"has no section {name}::")
    entries: dict[str, str] = {}
    for name in ("HEADER", "USER-TEXT", "RUNS"):
        for _, text in file.sections.get(name, []):
            entry = _entry(text)
            if entry:
                entries[entry[0]] = entry[1]
    targets = _targets(path, file.sections["TARGET DATA"], entries)
    rows = _deviations(path, file, len(targets), _count(path, file.titles["RUNS"], entries, "Run-count"))
    notes = [
        f"{path}: section {name}:: (line {file.titles[name]}, {len(lines)} lines) was not understood and is not used"
        for name, lines in file.sections.items()
        if name not in UNDERSTOOD
    ]
    notes += [] if "EOF" in file.sections else [f"{path}: has no EOF:: at its end; is it whole?"]
    if file.sections.get("EOF"):
        line = file.sections["EOF"][0][0]
        raise InputFileError(path, f"line {line}", "nothing may follow EOF::; are these two files?")
    return Static(targets, rows, entries, file.sha256, tuple(notes))


def _count(path: str | Path, line: int, entries: dict[str, str], key: str) -> int:
    text = entries.get(key, "")
    if not (text.isascii() and text.isdigit() and len(text) < 8 and int(text) > 0):
        problem = f"needs {key}: and a whole number above zero"
        raise InputFileError(path, f"section at line {line}", problem, text or None)
    return int(text)


def _targets(path: str | Path, lines: Sequence[tuple[int, str]], entries: dict[str, str]) -> np.ndarray:
    """Return the targets, and put the section's other entries with the rest."""
    targets: list[float] = []
    listing = False
    for number, text in lines:
        entry = _entry(text)
        if entry:
            listing = entry[0] == "Targets"
            entries[entry[0]] = entry[1]
        if listing:
            targets += [number_in(path, f"line {number}", part) for part in (entry[1] if entry else text).split()]
    first = lines[0][0] if lines else 0
    count = _count(path, first, entries, "Target-count")
    if len(targets) != count:
        raise InputFileError(path, f"section at line {first}", f"Target-count is {count}, but there are", len(targets))
    if len(set(targets)) != count:
        raise InputFileError(path, f"section at line {first}", "each target may be there once", targets)
    return np.array(targets)


def _deviations(path: str | Path, file: Sectioned, targets: int, runs: int) -> list[tuple[int, int, float, int]]:
    """Return the rows below ``Run Target Data:``."""
    lines = file.sections["DEVIATIONS"]
    title = file.titles["DEVIATIONS"]
    if not lines or not re.fullmatch(r"Run\s+Target\s+Data\s*:", lines[0][1]):
        raise InputFileError(path, f"line {title}", "DEVIATIONS:: must go on with Run Target Data:")
    rows: list[tuple[int, int, float, int]] = []
    seen = set()
    for number, text in lines[1:]:
        parts = text.split()
        if len(parts) != 3:
            raise InputFileError(path, f"line {number}", "must be run, target and deviation", text[:60])
        run, target = (_index(path, number, part, top) for part, top in zip(parts, (runs, targets), strict=False))
        if (run, target) in seen:
            raise InputFileError(path, f"line {number}", f"run {run} has target {target} twice")
        seen.add((run, target))
        rows.append((run, target, number_in(path, f"line {number}", parts[2]), number))
    if len(rows) != runs * targets:
        problem = f"must have {runs} runs × {targets} targets = {runs * targets} deviations; is the file whole?"
        raise InputFileError(path, f"section at line {title}", problem, len(rows))
    return rows


def _index(path: str | Path, line: int, text: str, top: int) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 8 and 1 <= int(text) <= top):
        raise InputFileError(path, f"line {line}", f"run and target must be whole numbers, here up to {top}", text)
    return int(text)
