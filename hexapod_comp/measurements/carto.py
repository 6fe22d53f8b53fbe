"""Files of Renishaw's laser software: dynamic captures (.rtx) and static linear runs (.rtl).

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

No file of the maker's own was at hand. Neither format says where the line lies in the machine, so each file needs
a small YAML file beside it (format ``hexapod_comp/line``)::

    format: hexapod_comp/line
    version: 1
    run: x at y 0, z 450      # files of the same run (the channels of one set-up) share it
    axis: x                   # of the work frame along which the tool was commanded
    across_mm: [0, 450]       # commanded coordinates along the other two, in order
    channel: linear           # as in tidy CSV files; roll, pitch, yaw too
    unit: um                  # of the values: .rtl um, .rtx mm (mrad)
    value_sense: 1            # optional; -1 where the instrument counts against the axis
    temperature_degC: 20      # optional, of the machine
    # .rtl: commanded coordinate = target_sense × target + target_offset; deviations of linear runs turn with it
    target_offset_mm: 0       # optional
    target_sense: 1           # optional; or -1
    # .rtx: one pass at constant commanded speed; what the machine lags behind goes into the run's unknown zero
    start_mm: -200            # commanded coordinate at from
    speed_mm_s: 5             # negative: backward
    from_s: 2                 # part of the capture in which the speed was constant
    to_s: 82
    every_mm: 5               # a reading is the mean over this travel
    cycle: 1                  # optional; which of several passes

An .rtx file with stops, with more than one pass, or with a speed that was not constant cannot be used: nothing in it
says where the machine was commanded to be. A linear capture that does not travel as its line file says is refused.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import InputFileError
from ..formats.yaml import UNITS, Section, read_yaml
from ..machine.field import CROSS_AXES
from ..machine.geometry import HexapodGeometry
from ..machine.model import REFERENCE_TEMPERATURE, TEMPERATURE_RANGE
from ..pose import Pose
from .readings import AXES, BACKWARD, FORWARD, FileLine, MeasurementSet, Reading
from .runs import assemble
from .tidy_csv import DIMENSIONS, LINE_KINDS, TURN_AXES, TURNS

LINE_FORMAT = "hexapod_comp/line"
LINE_VERSION = 1

MAX_BYTES = 1_000_000_000
"""Longer files are refused: forty minutes at 50 kHz."""

MAX_HEADER_BYTES = 65_536
"""A header that does not end in ``Data:`` within this is none; those seen have 500 bytes."""

LARGEST_RATIO = 0.01
"""Largest difference of a capture's travel from the commanded one, relative: no machine is that wrong."""

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


@dataclass(frozen=True)
class Capture:
    """The part of a capture at constant speed: m, m/s, s; `every` is the travel of one reading."""

    start: float
    speed: float
    begin: float
    end: float
    every: float
    cycle: int


@dataclass(frozen=True)
class LineFile:
    """What a file of the laser software does not say; lengths in m, the unit's size in SI.

    Attributes are those of the YAML file in the module's docstring; `capture` holds what .rtx files need.
    """

    run: str
    axis: int
    across: np.ndarray
    channel: str
    unit: float
    value_sense: int
    target_offset: float
    target_sense: int
    temperature: float
    capture: Capture | None

    def pose(self, coordinate: float) -> Pose:
        """Return the commanded pose of the tool at a coordinate along the line, level."""
        position = np.empty(3)
        position[self.axis], position[list(CROSS_AXES[self.axis])] = coordinate, self.across
        return Pose(position.round(12), np.eye(3))


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
    found = DATA_LINE.search(content, 0, MAX_HEADER_BYTES)
    if not found:
        raise InputFileError(path, "", f"has no line Data: within its first {MAX_HEADER_BYTES} bytes")
    header: dict[str, str] = {}
    for line in content[: found.start()].decode("utf-8", "replace").splitlines():
        entry = _entry(line)
        if entry and not TITLE.fullmatch(line.strip()):
            header.setdefault(*entry)
    samples = _samples(path, content, found.end(), _header_number(path, header, "Sample no", whole=True))
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
    try:
        number = float(header[key])
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf or (whole and number != int(number)) or not _plain(header[key]):
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
            targets += [_number(path, number, part) for part in (entry[1] if entry else text).split()]
    first = lines[0][0] if lines else 0
    count = _count(path, first, entries, "Target-count")
    if len(targets) != count:
        raise InputFileError(path, f"section at line {first}", f"Target-count is {count}, but there are", len(targets))
    if len(set(targets)) != count:
        raise InputFileError(path, f"section at line {first}", "each target may be there once", targets)
    return np.array(targets)


def _number(path: str | Path, line: int, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or not _plain(text):
        raise InputFileError(path, f"line {line}", "must be a finite number", text)
    return number


def _plain(text: str) -> bool:
    """Return whether a number looks like one to everybody: Python also reads 1_0 and １０ as ten."""
    return text.isascii() and "_" not in text


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
        rows.append((run, target, _number(path, number, parts[2]), number))
    if len(rows) != runs * targets:
        problem = f"must have {runs} runs × {targets} targets = {runs * targets} deviations; is the file whole?"
        raise InputFileError(path, f"section at line {title}", problem, len(rows))
    return rows


def _index(path: str | Path, line: int, text: str, top: int) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 8 and 1 <= int(text) <= top):
        raise InputFileError(path, f"line {line}", f"run and target must be whole numbers, here up to {top}", text)
    return int(text)


def load_line(path: str | Path) -> LineFile:
    """Read the YAML file beside a file of the laser software.

    Raises
    ------
    InputFileError
        With file, key and value.
    """
    top = read_yaml(path, LINE_FORMAT, LINE_VERSION)
    axis = AXES.index(top.choice("axis", AXES))
    channel = top.choice("channel", tuple(c for c in DIMENSIONS if c.partition("_")[0] in LINE_KINDS))
    units = UNITS[DIMENSIONS[channel]]
    line = LineFile(
        run=top.text("run"),
        axis=axis,
        across=top.quantity("across", "length", (2,)),
        channel=f"rotation_{AXES[TURN_AXES[axis][TURNS.index(channel)]]}" if channel in TURNS else channel,
        unit=units[top.choice("unit", tuple(units))],
        value_sense=_sense(top, "value_sense"),
        target_offset=float(top.quantity("target_offset", "length", default=0.0)),
        target_sense=_sense(top, "target_sense"),
        temperature=float(top.quantity("temperature", "temperature", default=REFERENCE_TEMPERATURE)),
        capture=_capture(top) if top.quantity_key("speed", "speed") else None,
    )
    if not TEMPERATURE_RANGE[0] <= line.temperature <= TEMPERATURE_RANGE[1]:
        raise top.error("temperature_degC", "must lie within {:g}…{:g} °C".format(*TEMPERATURE_RANGE), line.temperature)
    top.finish()
    return line


def _sense(top: Section, key: str) -> int:
    sense = top.integer(key, 1)
    if sense not in (1, -1):
        raise top.error(key, "must be 1 or -1", sense)
    return sense


def _capture(top: Section) -> Capture:
    """Return what .rtx files need; without a speed there is none of it."""
    capture = Capture(
        start=float(top.quantity("start", "length")),
        speed=float(top.quantity("speed", "speed")),
        begin=float(top.quantity("from", "time")),
        end=float(top.quantity("to", "time")),
        every=float(top.quantity("every", "length")),
        cycle=top.integer("cycle", 1),
    )
    if capture.speed == 0.0:
        raise top.error("speed", "must not be zero", capture.speed)
    if not 0.0 <= capture.begin < capture.end:
        raise top.error("from, to", "must be a span of time within the capture", [capture.begin, capture.end])
    travel = abs(capture.speed) * (capture.end - capture.begin)
    if not (capture.every > 0.0 and 2.0 * capture.every <= travel < 1e4 * capture.every):
        problem = f"must give 2…10000 readings over the travel of {travel * 1e3:g} mm"
        raise top.error("every", problem, capture.every)
    if capture.cycle < 1:
        raise top.error("cycle", "must be at least 1", capture.cycle)
    return capture


def read_carto(
    pairs: Sequence[tuple[str | Path, str | Path]], geometry: HexapodGeometry, probe: np.ndarray | None = None
) -> MeasurementSet:
    """Read files of the laser software, each with its line file, as one set.

    Parameters
    ----------
    pairs : sequence of (path, path)
        An .rtl or .rtx file and the line file beside it.
    geometry : HexapodGeometry
        The machine that was measured.
    probe : array_like, shape (3,), optional
        The measured point in ``platform``, m; the tool's tip by default.

    Raises
    ------
    InputFileError
        Naming file and place.
    """
    readings: list[Reading] = []
    files: list[tuple[str, str]] = []
    notes: list[str] = []
    for path, line_path in pairs:
        found, sha256, said = _file_readings(path, load_line(line_path), line_path)
        readings += found
        notes += said
        files.append((Path(path).name, sha256))
    _refuse_duplicates(readings)
    return assemble(geometry, readings, probe, files, notes)


def _file_readings(path: str | Path, line: LineFile, line_path: str | Path) -> tuple[list[Reading], str, Sequence[str]]:
    """Return the readings, the SHA-256 and the notes of one file."""
    if not DATA_LINE.search(_read_bytes(path)[:MAX_HEADER_BYTES]):
        static = read_rtl(path)
        found, said = _static_readings(path, static, line)
        return found, static.sha256, (*static.notes, *said)
    dynamic = read_rtx(path)
    if line.capture is None:
        problem = "is needed for an .rtx file: it does not say where the machine was commanded to be"
        raise InputFileError(line_path, "speed", problem)
    return _dynamic_readings(path, dynamic, line, line.capture), dynamic.sha256, ()


def _refuse_duplicates(readings: Sequence[Reading]) -> None:
    """Raise when two files hold the same pass of the same channel."""
    seen: dict[tuple, Reading] = {}
    for r in readings:
        key = (r.run, r.cycle, r.direction, r.channel, r.pose.position.tobytes())
        if key in seen:
            problem = f"run {r.run}: {r.channel} at the same place and pass stands in {seen[key].source} too"
            raise InputFileError(r.source.file, f"line {r.source.line}" if r.source.line else "", problem)
        seen[key] = r


def _static_readings(path: str | Path, static: Static, line: LineFile) -> tuple[list[Reading], list[str]]:
    """Return the readings of static runs; their directions are those in which the targets follow each other."""
    sense = line.value_sense * (line.target_sense if line.channel == "linear" else 1)
    coordinates = line.target_sense * static.targets * UNITS["length"]["mm"] + line.target_offset
    poses = [line.pose(float(coordinate)) for coordinate in coordinates]
    by_run: dict[int, list[tuple[int, float, int]]] = {}
    for run, target, value, number in static.rows:
        by_run.setdefault(run, []).append((target - 1, value, number))
    passes = {FORWARD: 0, BACKWARD: 0}
    readings = []
    for run, rows in by_run.items():
        steps = np.diff(coordinates[[target for target, _, _ in rows]])
        if not len(steps) or not ((steps > 0.0).all() or (steps < 0.0).all()):
            raise InputFileError(path, f"line {rows[0][2]}", f"the targets of run {run} must follow each other one way")
        direction = FORWARD if steps[0] > 0.0 else BACKWARD
        passes[direction] += 1
        for target, value, number in rows:
            place = (line.run, passes[direction], direction, poses[target], line.channel)
            source = FileLine(str(path), number)
            temperatures = (line.temperature,) * 8
            readings.append(Reading(*place, sense * value * line.unit, temperatures=temperatures, source=source))
    one_way = [f"{path}: all its runs travel one way"] if len(by_run) > 1 and 0 in passes.values() else []
    return readings, one_way


def _dynamic_readings(path: str | Path, dynamic: Dynamic, line: LineFile, capture: Capture) -> list[Reading]:
    """Return the readings of a capture at constant speed: means over equal pieces of the travel."""
    if not capture.end * dynamic.rate <= len(dynamic.samples):
        length = len(dynamic.samples) / dynamic.rate
        raise InputFileError(path, "", f"lasts {length:.3f} s, but its line file goes on to {capture.end:g} s")
    first, last = (round(time * dynamic.rate) for time in (capture.begin, capture.end))
    travel = capture.speed * np.arange(last - first) / dynamic.rate
    values = line.value_sense * line.unit * dynamic.samples[first:last]
    if line.channel == "linear":
        values = values - travel
        _check_travel(path, travel, values)
    piece = (np.abs(travel) / capture.every).astype(int)
    pieces = int(abs(capture.speed) * (capture.end - capture.begin) / capture.every + 1e-6)
    inside = piece < pieces
    count = np.bincount(piece[inside], minlength=pieces)
    if (count < 1).any():
        raise InputFileError(path, "", f"has fewer than one sample per {capture.every * 1e3:g} mm of travel")
    means = np.bincount(piece[inside], values[inside]) / count
    places = capture.start + np.bincount(piece[inside], travel[inside]) / count
    direction = FORWARD if capture.speed > 0.0 else BACKWARD
    source, temperatures = FileLine(str(path), 0), (line.temperature,) * 8
    return [
        Reading(line.run, capture.cycle, direction, line.pose(place), line.channel, value,
                temperatures=temperatures, source=source)
        for place, value in zip(places.tolist(), (means - means[0]).tolist(), strict=True)
    ]  # fmt: skip


def _check_travel(path: str | Path, travel: np.ndarray, errors: np.ndarray) -> None:
    """Refuse a capture whose travel is not the commanded one: wrong speed, sense or unit."""
    with np.errstate(all="ignore"):
        centred = travel - travel.mean()
        ratio = float(centred @ errors / (centred @ centred))
    if not abs(ratio) <= LARGEST_RATIO:
        problem = (
            f"travels {1.0 + ratio:.4g} times as far as its line file commands; are speed, unit and value_sense right?"
        )
        raise InputFileError(path, "", problem)
