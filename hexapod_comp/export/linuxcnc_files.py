"""LinuxCNC's files for a machine: written, and read back as LinuxCNC reads them.

Facts from LinuxCNC's sources, as in :mod:`hexapod_comp.export.linuxcnc`:

- ``src/emc/kinematics/genhexkins.c``: pins ``genhexkins.base.N.x`` … ``platform.N.z`` (N from 0) in machine
  units, ``base-n`` and ``platform-n`` unit vectors, ``screw-lead``; all of them pins that setp sets.
- ``src/emc/motion/usrmotintf.cc``, usrmotLoadComp: a compensation file is read line by line until one does not
  begin with three numbers, so comments stand at its end. In type 1 the second and third number are the
  trims themselves, for a joint that moves up and for one that moves down.
- ``src/libnml/inifile/inifile.cc`` (2.9): of two ini sections of one name only the first is read.
- ``src/emc/motion/homing.c``: a joint homed to a switch is at HOME_OFFSET *with* the trim there, one homed to an
  index pulse that resets the encoder without it; before its first move a joint has no trim.
"""

from __future__ import annotations

import configparser
import hashlib
import re
from pathlib import Path

import numpy as np

from ..errors import InputFileError
from ..formats.csv import number_in
from ..formats.files import read_text
from ..formats.outputs import write_text
from ..formats.schema import UNITS
from ..machine.geometry import STRUT_NAMES
from .linuxcnc import MOST_POINTS, Genhexkins, ScrewTable

MACHINE_UNITS = {"mm": UNITS["length"]["mm"], "inch": UNITS["length"]["in"]}
"""Values of [TRAJ]LINEAR_UNITS, and their size in m."""

HAL_FILE, INI_FILE = "genhexkins.hal", "comp.ini"
COMP_FILES = tuple(f"{name}.comp" for name in STRUT_NAMES)
COMP_TYPE = 1

PINS = {"base": "base_joints", "platform": "platform_joints", "base-n": "base_axes", "platform-n": "platform_axes"}
SETP = re.compile(r"setp\s+genhexkins\.(\S+)\s+(\S+)\s*")


def write_genhexkins(
    genhexkins: Genhexkins, folder: str | Path, unit: str, titles: list[str], misfit: np.ndarray
) -> list[Path]:
    """Write a HAL file, six compensation files and the ini lines; each file whole or not at all."""
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputFileError(folder, "", f"cannot be made: {error.strerror}") from error
    size = MACHINE_UNITS[unit]
    titles = [" ".join(title.split()) for title in titles]  # a line break would end the comment
    bodies = {HAL_FILE: _hal_lines(genhexkins, size), INI_FILE: _ini_lines()}
    bodies |= {name: _comp_lines(table, size) for name, table in zip(COMP_FILES, genhexkins.tables, strict=True)}
    mark = hashlib.sha256(repr(sorted(bodies.items())).encode()).hexdigest()[:16]
    titles = [f"set {mark}", *titles, f"machine unit: {unit}"]
    for name, body in bodies.items():
        about = {HAL_FILE: HAL_ABOUT, INI_FILE: INI_ABOUT}.get(name) or _comp_about(misfit[COMP_FILES.index(name)])
        comments = [f"# {line}" for line in [*titles, *about]]
        lines = [*body, *comments] if name in COMP_FILES else [*comments, *body]
        write_text(folder / name, "\n".join(lines) + "\n")
    return [folder / name for name in bodies]


HAL_ABOUT = [
    "Real joints of the machine. Source it after genhexkins is loaded, before the machine is switched on.",
    "LinuxCNC's XYZABC is then the geometry file's tool frame in its work frame, with genhexkins.spindle-offset",
    "at its default, 0; tool lengths of the tool table (genhexkins.tool-offset) count from there.",
]

INI_ABOUT = [
    "Copy these lines into the ini file's own [JOINT_N] sections: LinuxCNC 2.9 reads only the first of two sections",
    "of one name. File names are relative to the ini file's folder. BACKLASH of these joints is not used any more.",
    "A joint's correction is zero until it first moves, and ramps in then. HOME_OFFSET stays the length that the",
    "encoder counts at an index pulse that resets it, or where the strut stands (HOME_SEARCH_VEL = 0). At a mere",
    "switch, homing takes the correction there up into the joint's zero: HOME_OFFSET then is the real length, the",
    "joint command that makes up the encoder's length together with its correction.",
]


def _comp_about(misfit: np.ndarray) -> list[str]:
    """Return the comment that follows a table."""
    rms, largest = misfit * 1e6
    return [
        "columns: joint command, correction while it grows, correction while it shrinks (COMP_FILE_TYPE = 1)",
        f"straight lines between the points leave {rms:.3f} um RMS, {largest:.3f} um at most, of the strut's errors",
        "over the lengths that level poses in the box need; outside, points are coarse, and beyond the stroke held",
        "comments stand at the end since LinuxCNC stops reading at the first line that is not three numbers",
    ]


def _hal_lines(genhexkins: Genhexkins, size: float) -> list[str]:
    values: list[tuple[str, float]] = [("screw-lead", genhexkins.lead / size)]
    for pin, name in PINS.items():
        if pin.endswith("-n") and genhexkins.lead == 0.0:
            continue
        scale = 1.0 if pin.endswith("-n") else size
        for joint, vector in enumerate(getattr(genhexkins, name)):
            values += [(f"{pin}.{joint}.{axis}", v / scale) for axis, v in zip("xyz", vector, strict=True)]
    return [f"setp genhexkins.{pin} {value + 0.0:.12f}" for pin, value in values]


def _comp_lines(table: ScrewTable, size: float) -> list[str]:
    rows = zip(table.nominal / size, *(table.trims / size), strict=True)
    return [f"{nominal:.9f} {up + 0.0:.12f} {down + 0.0:.12f}" for nominal, up, down in rows]


def _ini_lines() -> list[str]:
    lines = []
    for joint, name in enumerate(COMP_FILES):
        lines += [f"[JOINT_{joint}]", f"COMP_FILE = {name}", f"COMP_FILE_TYPE = {COMP_TYPE}"]
    return lines


# Reading back


def read_genhexkins(folder: str | Path, unit: str) -> Genhexkins:
    """Read a written set as LinuxCNC would."""
    folder, size = Path(folder), MACHINE_UNITS[unit]
    texts = {name: read_text(folder / name) for name in (HAL_FILE, INI_FILE, *COMP_FILES)}
    _refuse_mixed(folder, texts)
    pins = _read_pins(folder / HAL_FILE, texts[HAL_FILE])
    vectors: dict[str, np.ndarray] = {name: np.zeros((6, 3)) for name in PINS.values()}
    for pin, name in PINS.items():
        if not pin.endswith("-n") or pins["screw-lead"] != 0.0:
            vectors[name] = _vectors(folder / HAL_FILE, pins, pin) * (1.0 if pin.endswith("-n") else size)
    names = _comp_names(folder / INI_FILE, texts[INI_FILE])
    tables = tuple(_read_table(folder / name, read_text(folder / name), size) for name in names)
    return Genhexkins(**vectors, lead=pins["screw-lead"] * size, tables=tables)


def _refuse_mixed(folder: Path, texts: dict[str, str]) -> None:
    """Raise when the files do not all carry the same mark."""
    marks = {name: re.findall(r"^# set ([0-9a-f]{16})$", text, re.MULTILINE) for name, text in texts.items()}
    for name, mark in marks.items():
        if not mark or mark != marks[HAL_FILE]:
            raise InputFileError(folder / name, "# set", f"must be that of {HAL_FILE}: files of two exports", mark)


def _read_pins(path: Path, text: str) -> dict[str, float]:
    """Return the pins that a HAL file sets."""
    pins: dict[str, float] = {}
    for number, line in enumerate(text.split("\n"), 1):
        if not line or line.startswith("#"):
            continue
        match = SETP.fullmatch(line)
        if not match:
            raise InputFileError(path, f"line {number}", "is not setp of a genhexkins pin", line)
        if match[1] in pins:
            raise InputFileError(path, f"line {number}", "sets a pin again", line)
        pins[match[1]] = number_in(path, f"line {number}", match[2])
    return {"screw-lead": 0.0} | pins


def _vectors(path: Path, pins: dict[str, float], pin: str) -> np.ndarray:
    names = [[f"{pin}.{joint}.{axis}" for axis in "xyz"] for joint in range(6)]
    missing = next((name for row in names for name in row if name not in pins), None)
    if missing:
        raise InputFileError(path, f"genhexkins.{missing}", "is not set")
    return np.array([[pins[name] for name in row] for row in names])


def _comp_names(path: Path, text: str) -> list[str]:
    """Return the compensation files that the ini lines name, in the order of the joints."""
    parser = configparser.ConfigParser()
    try:
        parser.read_string(text)
        sections = [parser[f"JOINT_{joint}"] for joint in range(6)]
        wrong = next((s for s in sections if s["COMP_FILE_TYPE"] != str(COMP_TYPE)), None)
        names = [section["COMP_FILE"] for section in sections]
    except (configparser.Error, KeyError) as error:
        raise InputFileError(path, "", f"is not the lines that were written: {str(error).splitlines()[0]}") from error
    if wrong is not None:
        raise InputFileError(path, f"[{wrong.name}]COMP_FILE_TYPE", f"must be {COMP_TYPE}", wrong["COMP_FILE_TYPE"])
    for section, name in zip(sections, names, strict=True):
        if name not in COMP_FILES:
            raise InputFileError(path, f"[{section.name}]COMP_FILE", f"must be one of {', '.join(COMP_FILES)}", name)
    return names


def _read_table(path: Path, text: str, size: float) -> ScrewTable:
    """Read a compensation file up to the first line that does not begin with three numbers."""
    rows: list[list[float]] = []
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split()[:3]
        if len(words) < 3 or line.startswith("#"):
            break
        rows.append([number_in(path, f"line {number}", word) for word in words])
        if len(rows) > MOST_POINTS:
            raise InputFileError(path, f"line {number}", f"LinuxCNC takes at most {MOST_POINTS} points")
        if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
            raise InputFileError(path, f"line {number}", "joint commands must increase", rows[-1][0])
    if not rows:
        raise InputFileError(path, "line 1", "has no points: LinuxCNC stops at a line that is not three numbers")
    values = np.array(rows) * size
    return ScrewTable(values[:, 0], values[:, 1:].T)
