"""Export to C: the core (the files of ``hexapod_comp/core``), and one machine with its error model as constants.

``hexapod_vectors.h`` has commands and the Python compensator's answers, for the self-test on the target. Numbers have
enough digits to restore the same double.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..compensation.compensator import DEFAULT_RAMP_RATE, Compensator
from ..core import Status, dtype_of, ffi, lib
from ..errors import HexapodError, TooEarlyError
from ..formats.outputs import make_folder, write_text
from ..machine.geometry import HexapodGeometry
from ..machine.load import Loading
from ..machine.model import MachineModel, members
from ..machine.temperatures import Temperatures
from ..machine.trajectory import moves
from ..pose import Pose, rotation_from_angles, stacked
from .terms import refuse_unknown

CORE = Path(__file__).parents[1] / "core"  # Folder of the core's files
USERS = Path(__file__).parent / "c"  # Folder of C files that call the core: self-test, library, LinuxCNC component
PERIOD = 0.004  # Time between two commands of the self-test, s
MODEL_FILE, VECTORS_FILE = "hexapod_model.h", "hexapod_vectors.h"


def write_c(folder: str | Path, geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str]) -> list[Path]:
    """Write core, constants and self-test into a folder; `hashes` are SHA-256 of geometry file and model file."""
    files = {path.name: path.read_text(encoding="utf-8") for path in sources()}
    files[MODEL_FILE] = model_header(geometry, model, hashes)
    files[VECTORS_FILE] = vectors_header(self_test(geometry, model))
    folder = Path(folder)
    make_folder(folder)
    for name, text in files.items():
        write_text(folder / name, text)
    return [folder / name for name in files]


def sources() -> list[Path]:
    """Return the files to copy: ``hexapod_comp.c``, the files that it includes, and the files of the folder ``c``."""
    unit = (CORE / "hexapod_comp.c").read_text(encoding="utf-8")
    names = ["hexapod_comp.h", "hexapod_comp.c", *re.findall(r'#include "(.+)"', unit)]
    return [*(CORE / name for name in names), *(path for path in sorted(USERS.iterdir()) if path.is_file())]


def model_header(geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str]) -> str:
    """Return the text of ``hexapod_model.h``; raise ModelError if the C core does not have a term of the model."""
    refuse_unknown(model, "the C core")
    arrays: list[str] = []
    text = _initialiser(members(geometry, model, hashes), dtype_of("hc_model"), "hexapod", arrays)
    return f"""\
/* Written by hexapod_comp export --c. Constants of one machine, for hexapod_comp.c; include it once.
 * Units: m, rad, 1/K. hexapod_comp.h describes members and frames. You may use and ship this file as you like. */
#ifndef HEXAPOD_MODEL_H
#define HEXAPOD_MODEL_H

#include "hexapod_comp.h"

{"".join(arrays)}
static const hc_model hexapod_model = {text};

#endif
"""


def _initialiser(value: Any, kind: np.dtype, path: str, arrays: list[str], margin: str = "\n") -> str:
    """Return the C initialiser of a value; for a pointer, add the C array `path` to `arrays` and return its name."""
    inner = margin + "    "
    if isinstance(value, str):  # bytes other than plain ASCII are written in octal
        text = "".join(chr(b) if 32 <= b < 127 and b not in b'"\\?' else f"\\{b:03o}" for b in value.encode())
        return f'"{text}"'
    if kind.base.names and isinstance(value, np.ndarray):
        value = {name: value[name] for name in kind.base.names}
    if isinstance(value, dict):
        parts = (f".{n} = {_initialiser(v, kind[n], f'{path}_{n}', arrays, inner)}," for n, v in value.items())
        return "{" + "".join(inner + part for part in parts) + margin + "}"
    if kind.base == np.uintp and not kind.shape:
        numbers = np.ravel(value).tolist() or [0.0]  # C does not allow empty arrays
        rows = (", ".join(map(_numbers, numbers[k : k + 6])) for k in range(0, len(numbers), 6))
        arrays.append(f"static const double {path}[{len(numbers)}] = {{\n    " + ",\n    ".join(rows) + "};\n")
        return path
    if kind.base == np.uintp or kind.base.names:
        return f"{{{', '.join(_initialiser(v, kind.base, f'{path}_{n}', arrays, inner) for n, v in enumerate(value))}}}"
    while kind.subdtype:
        kind = kind.base
    return _numbers(np.asarray(value).astype(kind).tolist())


def _numbers(value: Any) -> str:
    """Return numbers as C text: integers, or doubles with enough digits to restore the same bits."""
    if isinstance(value, (list, tuple)):
        return "{" + ", ".join(map(_numbers, value)) + "}"
    return str(value) if isinstance(value, int) else repr(value).replace("inf", "HUGE_VAL").replace("nan", "NAN")


def self_test(geometry: HexapodGeometry, model: MachineModel, seed: int = 1) -> list[str]:
    """Return the steps of the self-test with the Python compensator's answers, as rows of a C array.

    The steps are small moves near home. Between the moves, temperatures and gravity change, compensation is switched
    off and on, commands are refused, and the core is reset twice: to measured strut lengths, and without them.
    """
    recorder = Recorder(geometry, model)
    random = np.random.default_rng(seed)
    path, _ = moves(geometry, *stacked([_near_home(geometry, random) for _ in range(4)]), 1.0 / PERIOD)
    stream = [path.pose(k) for k in range(len(path))]
    quarter = max(1, len(stream) // 4)
    recorder.commands(stream[:quarter])
    for part, temperature in ((2.0, 24.5), (6.0, 21.25), (7.0, 1e3), (6.0, 22.25)):
        recorder.record("t", (part, temperature))
    recorder.record("g", (1.0, -2.0, -9.5))
    recorder.commands(stream[quarter : 2 * quarter])
    recorder.record("e", (0.0,))
    recorder.commands(stream[2 * quarter : 3 * quarter])
    recorder.record("e", (1.0,))
    for invalid in ((np.nan, 0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 2), (9.9, 0, 0, 0, 0, 0, 1)):
        recorder.record("c", invalid)
    recorder.commands(stream[3 * quarter :])
    struts = tuple(recorder.compensator.command.tolist())
    recorder.record("p", struts)
    recorder.record("p", (*struts[:5], struts[5] * 3.0))
    recorder.record("r", struts)
    recorder.commands(stream[::-1][: quarter + 1])
    recorder.record("f", ())
    recorder.commands(stream[:3])
    return recorder.rows


def _near_home(geometry: HexapodGeometry, random: np.random.Generator) -> Pose:
    """Return a random tool pose in ``work`` so near home that the nominal machine is within its limits."""
    home, size = geometry.home, geometry.characteristic_length
    shift, turn = random.uniform(-1.0, 1.0, 3), random.uniform(-1.0, 1.0, 3)
    for share in 0.1 * 0.7 ** np.arange(20):
        pose = Pose(home.position + share * size * shift, rotation_from_angles(share * turn) @ home.rotation)
        try:
            Compensator(geometry, MachineModel(geometry.name)).correct(geometry.tool_pose(pose))
        except HexapodError:
            continue
        return geometry.tool_pose(pose)
    return geometry.tool_pose(home)


class Recorder:
    """A Python compensator that records inputs and answers, as initialisers of the C struct ``hexapod_vector``."""

    def __init__(self, geometry: HexapodGeometry, model: MachineModel) -> None:
        self.compensator = Compensator(geometry, model, DEFAULT_RAMP_RATE)
        self.rows: list[str] = []
        self.time = 100.0

    def commands(self, poses: Iterable[Pose]) -> None:
        """Command tool poses in ``work`` and record the answers."""
        for pose in poses:
            self.record("c", (*pose.position, *pose.quaternion()))

    def record(self, kind: str, values: tuple[float, ...]) -> None:
        """Give one input to the compensator; record the kind of the input, status, time (s), input and answer.

        Kinds: "c" command; "p" struts for a pose estimate (answer: position, m, and last row of the rotation matrix);
        "t" temperature; "g" gravity; "e" enable; "r" reset to measured strut lengths; "f" reset without them.
        """
        compensator, status = self.compensator, 0
        self.time += PERIOD
        expected = np.zeros(6)
        try:
            if kind == "c":
                compensator.step(tuple(map(float, values)), self.time)
            elif kind == "p":
                pose = compensator.estimate(np.array(values))
                expected = np.concatenate([pose[:3], pose[9:]])
            elif kind == "t":
                compensator.set_temperature(Temperatures.NAMES[int(values[0])], values[1], self.time)
            elif kind == "g":
                compensator.set_load(Loading.of(values))
            elif kind == "e":
                compensator.enable(bool(values[0]))
            else:
                compensator.reset(np.array(values) if values else None)
        except HexapodError as error:
            status = status_of(error)
            expected = np.full(6, np.nan) if kind == "p" else expected
        if kind == "c":
            expected = compensator.command
        given = [*map(float, values), *[0.0] * (7 - len(values))]
        numbers = f"{self.time!r}, {_numbers(given)}, {_numbers(expected.tolist())}"
        self.rows.append(f"    {{'{kind}', {status}, {numbers}}},\n")


def status_of(error: HexapodError) -> int:
    if isinstance(error, TooEarlyError):
        return int(Status.EARLY)
    if error.reason == "stroke":
        return int(Status.STROKE_SHORT if error.value < error.limit else Status.STROKE_LONG)  # type: ignore[attr-defined]
    return min(int(status) for status in Status if ffi.string(lib.hc_reason(status)).decode() == error.reason)


def vectors_header(rows: Sequence[str]) -> str:
    return f"""\
/* Written by hexapod_comp export --c: steps and the Python compensator's answers, for hexapod_selftest.c. */
#ifndef HEXAPOD_VECTORS_H
#define HEXAPOD_VECTORS_H

#include <math.h>

typedef struct {{
    char kind;
    int status;
    double time, input[7], expected[6];
}} hexapod_vector;

static const double hexapod_ramp_rate = {DEFAULT_RAMP_RATE!r};

static const hexapod_vector hexapod_vectors[] = {{
{"".join(rows)}}};

#endif
"""
