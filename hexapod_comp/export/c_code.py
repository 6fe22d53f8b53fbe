"""A machine and its error model as constants in C, beside the core that runs them in a servo thread.

The core, the folder ``hexapod_comp/core``, is the same for all machines and is copied; ``hexapod_model.h`` holds this
machine, ``hexapod_vectors.h`` commands that the Python compensator has answered, which the self-test runs on
the target. Numbers are written with the digits that bring back the very same double.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..compensation.compensator import DEFAULT_RAMP_RATE, Compensator
from ..core import Status, dtype_of
from ..errors import HexapodError, TooEarlyError
from ..formats.outputs import write_text
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, members
from ..machine.temperatures import Temperatures
from ..machine.trajectory import moves
from ..pose import Pose, rotation_from_angles, stacked
from . import carried
from .carried import refuse_unknown

CORE, AROUND = Path(__file__).parents[1] / "core", Path(__file__).parent / "c"
"""Where the core lies, and what is written around it."""

PERIOD = 0.004
"""Between two commands of the self-test, s."""

MODEL_FILE, VECTORS_FILE = "hexapod_model.h", "hexapod_vectors.h"


@dataclass(frozen=True)
class Vector:
    """One line of the self-test.

    Attributes
    ----------
    kind : str
        ``c`` command, ``p`` estimate of the pose, ``t`` temperature, ``e`` enable, ``f`` forget, ``r`` reset to
        measured struts.
    values : tuple of float
        Its numbers, as the core's function takes them.
    time : float
        Of a command, s.
    status : int
        What the Python compensator said, a :class:`~hexapod_comp.core.Status`.
    expected : tuple of six float
        Strut commands, m; of an estimate, position, m, and last row of the rotation matrix.
    """

    kind: str
    values: tuple[float, ...]
    time: float
    status: int
    expected: tuple[float, ...]


def write_c(folder: str | Path, geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str]) -> list[Path]:
    """Write the core, this machine's constants and its self-test into a folder, which is made if it is missing.

    Parameters
    ----------
    folder : str or Path
        Files of these names in it are replaced.
    geometry, model : HexapodGeometry, MachineModel
        The machine and what it does differently.
    hashes : tuple of two str
        SHA-256 of the geometry file and of the model file; a replay looks whether they are those of a recording.

    Returns
    -------
    list of Path
        The files.
    """
    files = {path.name: path.read_text(encoding="utf-8") for path in sources()}
    files[MODEL_FILE] = model_header(geometry, model, hashes)
    files[VECTORS_FILE] = vectors_header(self_test(geometry, model))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_text(folder / name, text)
    return [folder / name for name in files]


def sources() -> list[Path]:
    """Return the files that are copied: of the core, what a controller needs, and what is written around it."""
    unit = (CORE / "hexapod_comp.c").read_text(encoding="utf-8")
    names = ["hexapod_comp.h", "hexapod_comp.c", *re.findall(r'#include "(.+)"', unit)]
    return [*(CORE / name for name in names), *(path for path in sorted(AROUND.iterdir()) if path.is_file())]


def model_header(geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str]) -> str:
    """Return ``hexapod_model.h``: geometry, limits and model as one constant of type hc_model.

    Raises
    ------
    ModelError
        The model has a term of which the core knows nothing.
    """
    refuse_unknown(model, carried.C, "the C core")
    arrays: dict[str, np.ndarray] = {}
    text = _struct(members(geometry, model, hashes), dtype_of("hc_model"), "hexapod", arrays, 1)
    lines = [
        "/* Written by hexapod_comp export --c. Constants of one machine, for hexapod_comp.c; include it once.",
        " * m, rad, 1/K; frames and meanings as in hexapod_comp.h. You may use and ship this file as you like. */",
        "#ifndef HEXAPOD_MODEL_H",
        "#define HEXAPOD_MODEL_H",
        "",
        '#include "hexapod_comp.h"',
        "",
        *(_array(name, values) for name, values in arrays.items()),
        f"static const hc_model hexapod_model = {text};",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _struct(values: dict[str, Any], layout: np.dtype, path: str, arrays: dict[str, np.ndarray], depth: int) -> str:
    """Return the initialiser of a struct; what it points to is put into `arrays` by name."""
    inner = "    " * depth
    lines = []
    for name, value in values.items():
        text = _initialiser(value, layout[name], f"{path}_{name}", arrays, depth)
        lines.append(f"{inner}.{name} = {text},\n")
    return "{\n" + "".join(lines) + "    " * (depth - 1) + "}"


def _initialiser(value: Any, kind: np.dtype, path: str, arrays: dict[str, np.ndarray], depth: int) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, dict):
        return _struct(value, kind, path, arrays, depth + 1)
    if kind.base == np.uintp:
        if not kind.shape:
            arrays[path] = value
            return path
        return (
            "{" + ", ".join(_initialiser(v, kind.base, f"{path}_{n}", arrays, depth) for n, v in enumerate(value)) + "}"
        )
    if kind.base.names and not isinstance(value, np.ndarray):
        return "{" + ", ".join(_struct(v, kind.base, path, arrays, depth + 1) for v in value) + "}"
    if kind.base.names:
        return _struct({name: value[name] for name in kind.names or ()}, kind, path, arrays, depth + 1)
    while kind.subdtype:
        kind = kind.base
    return _values(np.asarray(value).astype(kind))


def _array(name: str, values: np.ndarray) -> str:
    """Return the definition of a flat array; C has none without elements, so an empty one gets a zero."""
    flat = np.ravel(values) if values.size else np.zeros(1)
    rows = [", ".join(_number(v) for v in flat[k : k + 6]) for k in range(0, len(flat), 6)]
    return f"static const double {name}[{len(flat)}] = {{\n    " + ",\n    ".join(rows) + "};\n"


def _values(values: np.ndarray) -> str:
    if values.ndim == 0:
        return _number(values[()])
    return "{" + ", ".join(_values(np.asarray(part)) for part in values) + "}"


def _number(value: Any) -> str:
    """Return a number as C: whole ones of integer type stay so, others come back as the same double."""
    return str(int(value)) if isinstance(value, (int, np.integer)) else repr(float(value)).replace("inf", "HUGE_VAL")


def _text(value: str) -> str:
    """Return a string literal; whatever is not plain ASCII is written in octal, byte by byte."""
    plain = "".join(chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in value.encode())
    return f'"{plain}"'


def self_test(geometry: HexapodGeometry, model: MachineModel, seed: int = 1) -> list[Vector]:
    """Return commands, refusals and estimates, answered by the Python compensator.

    A stream of small moves around home, there and back; on the way temperatures change, compensation is switched,
    a command is too far, one is not finite, one has no unit quaternion, and it starts again from measured struts.
    """
    recorder = Recorder(geometry, model)
    random = np.random.default_rng(seed)
    stream = _stream(geometry, [_near_home(geometry, random) for _ in range(4)])
    quarter = max(1, len(stream) // 4)
    recorder.commands(stream[:quarter])
    recorder.take("t", (2.0, 24.5))
    recorder.take("t", (6.0, 21.25))
    recorder.take("t", (7.0, 1e3))
    recorder.take("t", (6.0, 22.25))
    recorder.commands(stream[quarter : 2 * quarter])
    recorder.take("e", (0.0,))
    recorder.commands(stream[2 * quarter : 3 * quarter])
    recorder.take("e", (1.0,))
    for strange in ((np.nan, 0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0, 2), (9.9, 0, 0, 0, 0, 0, 1)):
        recorder.take("c", strange)
    recorder.commands(stream[3 * quarter :])
    struts = tuple(recorder.compensator.command.tolist())
    recorder.take("p", struts)
    recorder.take("p", (*struts[:5], struts[5] * 3.0))
    recorder.take("r", struts)
    recorder.commands(stream[::-1][: quarter + 1])
    recorder.take("f", ())
    recorder.commands(stream[:3])
    return recorder.vectors


def _near_home(geometry: HexapodGeometry, random: np.random.Generator) -> Pose:
    """Return a tool pose in ``work`` around home: the largest step of twenty that keeps the nominal limits."""
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


def _stream(geometry: HexapodGeometry, poses: Sequence[Pose]) -> list[Pose]:
    """Return the stream that joins tool poses, in steps that the machine's limits allow."""
    path, _ = moves(geometry, *stacked(poses), 1.0 / PERIOD)
    return [path.pose(k) for k in range(len(path))]


class Recorder:
    """Runs a Python compensator and writes down what it was given and what it said."""

    def __init__(self, geometry: HexapodGeometry, model: MachineModel) -> None:
        self.compensator = Compensator(geometry, model, DEFAULT_RAMP_RATE)
        self.vectors: list[Vector] = []
        self.time = 100.0

    def commands(self, poses: Iterable[Pose]) -> None:
        """Command tool poses in ``work``, one after the other."""
        for pose in poses:
            self.take("c", (*pose.position, *pose.quaternion()))

    def take(self, kind: str, values: tuple[float, ...]) -> None:
        """Do one thing, and write it down."""
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
            elif kind == "e":
                compensator.enable(bool(values[0]))
            else:
                compensator.reset(np.array(values) if values else None)
        except HexapodError as error:
            status = status_of(error)
            expected = np.full(6, np.nan) if kind == "p" else expected
        if kind == "c":
            expected = compensator.command
        self.vectors.append(Vector(kind, tuple(map(float, values)), self.time, status, tuple(expected.tolist())))


def status_of(error: HexapodError) -> int:
    """Return the hc_status of what the Python compensator raises."""
    name = {"bad_model": "temperature", "other_assembly_mode": "other_assembly"}.get(error.reason, error.reason)
    if isinstance(error, TooEarlyError):
        name = "early"
    if name == "stroke":
        name = "stroke_short" if error.value < error.limit else "stroke_long"  # type: ignore[attr-defined]
    return int(Status[name.upper()])


def vectors_header(vectors: Sequence[Vector]) -> str:
    """Return ``hexapod_vectors.h``."""
    rows = []
    for v in vectors:
        values = [*v.values, *[0.0] * (7 - len(v.values))]
        rows.append(f"    {{'{v.kind}', {v.status}, {_c(v.time)}, {{{_row(values)}}}, {{{_row(v.expected)}}}}},")
    return "\n".join(
        [
            "/* Written by hexapod_comp export --c: what the Python compensator answered, for hexapod_selftest.c. */",
            "#ifndef HEXAPOD_VECTORS_H",
            "#define HEXAPOD_VECTORS_H",
            "",
            "#include <math.h>",
            "",
            "typedef struct {",
            "    char kind;",
            "    int status;",
            "    double time, input[7], expected[6];",
            "} hexapod_vector;",
            "",
            f"static const double hexapod_ramp_rate = {_c(DEFAULT_RAMP_RATE)};",
            "",
            "static const hexapod_vector hexapod_vectors[] = {",
            *rows,
            "};",
            "",
            "#endif",
            "",
        ]
    )


def _row(values: Iterable[float]) -> str:
    return ", ".join(_c(v) for v in values)


def _c(value: float) -> str:
    return "NAN" if np.isnan(value) else _number(float(value))
