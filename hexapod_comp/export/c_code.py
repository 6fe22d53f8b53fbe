"""A machine and its error model as constants in C, beside the core that runs them in a servo thread.

The core, the folder ``hexapod_comp/core``, is the same for all machines and is copied; ``hexapod_model.h`` holds this
machine, ``hexapod_vectors.h`` commands that the Python compensator has answered, which the self-test runs on
the target. Numbers are written with the digits that bring back the very same double.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..compensation.compensator import DEFAULT_RAMP_RATE, Compensator
from ..errors import HexapodError, TooEarlyError
from ..formats.outputs import write_text
from ..kernels.struts import GROWTH, MOST_HARMONICS, WAVES
from ..machine.geometry import HexapodGeometry
from ..machine.late import MOST_TIME_CONSTANTS, PARTS
from ..machine.model import MachineModel, RealMachine
from ..machine.temperatures import Temperatures
from ..machine.trajectory import moves
from ..pose import Pose, rotation_from_angles, stacked
from . import carried
from .carried import refuse_unknown

SOURCES = Path(__file__).parents[1] / "core", Path(__file__).parent / "c"
"""Where the core lies, and what is written around it."""

PERIOD = 0.004
"""Between two commands of the self-test, s."""

MODEL_FILE, VECTORS_FILE = "hexapod_model.h", "hexapod_vectors.h"

STATUS = (
    "ok",
    "stroke_short",
    "stroke_long",
    "base_cone",
    "platform_cone",
    "clearance",
    "condition",
    "assembly",
    "not_finite",
    "correction",
    "step",
    "speed",
    "early",
    "acceleration",
    "not_converged",
    "outside_field",
    "quaternion",
    "singular",
    "unreachable",
    "other_assembly_mode",
    "temperature",
    "humidity",
    "tool_changed",
)
"""Names of hc_status, in its order."""


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
        What the Python compensator said, by its place in :data:`STATUS`.
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
    paths = [path for folder in SOURCES for path in sorted(folder.iterdir()) if path.suffix in (".c", ".h", ".comp")]
    files = {path.name: path.read_text(encoding="utf-8") for path in paths}
    files[MODEL_FILE] = model_header(geometry, model, hashes)
    files[VECTORS_FILE] = vectors_header(self_test(geometry, model))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_text(folder / name, text)
    return [folder / name for name in files]


def model_header(geometry: HexapodGeometry, model: MachineModel, hashes: tuple[str, str]) -> str:
    """Return ``hexapod_model.h``: geometry, limits and model as one constant of type hc_model.

    Raises
    ------
    ModelError
        The model has a term of which the C core knows nothing: struts that swell by humidity.
    """
    refuse_unknown(model, carried.C, "the C core")
    machine = RealMachine(geometry, model)
    _, knots, pieces = machine.strut_arrays
    arrays = {"hexapod_knots": knots, "hexapod_pieces": pieces}
    for axis, nodes, family in zip("xyz", model.field.grid, model.field.lines, strict=True):
        arrays |= {f"hexapod_nodes_{axis}": nodes, f"hexapod_lines_{axis}": family.swapaxes(3, 4)}
    lines = [
        "/* Written by hexapod_comp export --c. Constants of one machine, for hexapod_comp.c; include it once.",
        " * m, rad, 1/K; frames and meanings as in hexapod_comp.h. You may use and ship this file as you like. */",
        "#ifndef HEXAPOD_MODEL_H",
        "#define HEXAPOD_MODEL_H",
        "",
        '#include "hexapod_comp.h"',
        "",
        *(_array(name, values) for name, values in arrays.items()),
        "static const hc_model hexapod_model = {",
        *(f"    .{name} = {value}," for name, value in _members(geometry, model, machine, hashes)),
        "};",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _members(
    geometry: HexapodGeometry, model: MachineModel, machine: RealMachine, hashes: tuple[str, str]
) -> Iterator[tuple[str, str]]:
    """Return the members of hc_model and their initialisers."""
    strings = {"machine": model.machine, "model": model.name, "date": model.origin.date or ""}
    strings |= {"geometry_sha256": hashes[0], "model_sha256": hashes[1]}
    yield from ((name, _text(value)) for name, value in strings.items())
    bodies = zip(("base", "platform"), geometry.kernel_joints, machine.body[2:], strict=True)
    for name, joints, axes in bodies:
        deviation, expansion = getattr(model, f"{name}_deviation"), getattr(model, f"{name}_expansion")
        yield name, _struct({"joints": joints, "deviation": deviation, "axes": axes, "expansion": expansion})
    tool = geometry.tool
    poses = {"home": geometry.home, "work": geometry.work, "tool": tool, "tool_inverse": tool.inverse()}
    for name, pose in poses.items():
        yield name, _struct({"position": pose.position, "rotation": pose.rotation})
    yield "limits", _struct(geometry.limit_numbers._asdict())
    yield "struts", _struts(machine, model)
    yield "map", _struct({"knot_count": len(machine.strut_arrays[1])}, knots="hexapod_knots", pieces="hexapod_pieces")
    field = model.field
    counts = {"node_count": [len(nodes) for nodes in field.grid], "powers": [f.shape[4] for f in field.lines]}
    pointers = {kind: f"{{{', '.join(f'hexapod_{kind}_{axis}' for axis in 'xyz')}}}" for kind in ("nodes", "lines")}
    flags = {"refuse_outside": int(field.outside == "refuse")}
    yield "field", _struct({"probe": field.probe, **counts, **flags}, **pointers)
    late = model.late_growth
    count = len(late.time_constants)
    constants, expansion = np.zeros(MOST_TIME_CONSTANTS), np.zeros((len(PARTS), MOST_TIME_CONSTANTS))
    constants[:count], expansion[:, :count] = late.time_constants, late.expansion
    sensors = [late.sensor_of(part) for part in range(len(PARTS))]
    numbers = {"count": count, "time_constants": constants, "expansion": expansion, "sensors": sensors}
    yield "late", _struct(numbers)
    yield "axis_threshold", _number(machine.thresholds[0])
    yield "strut_threshold", _number(machine.thresholds[1])


def _struts(machine: RealMachine, model: MachineModel) -> str:
    """Return the six struts; the columns of the kernels' table stand in the order of hc_strut."""
    table = machine.strut_arrays[0].copy()
    table[:, GROWTH] = model.struts.expansion  # the core works out the growth from its temperatures
    rows = [f"{{{_row(row[:WAVES])}, 0.0, {_values(row[WAVES:].reshape(MOST_HARMONICS, 2))}}}" for row in table]
    return "{\n        " + ",\n        ".join(rows) + "}"


def _struct(numbers: dict[str, Any], **others: str) -> str:
    """Return an initialiser with a line per member."""
    members = {name: _values(np.asarray(value)) for name, value in numbers.items()} | others
    return "{\n" + "".join(f"        .{name} = {text},\n" for name, text in members.items()) + "    }"


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
    name = {"bad_model": "temperature"}.get(error.reason, error.reason)
    if isinstance(error, TooEarlyError):
        name = "early"
    if name == "stroke":
        name = "stroke_short" if error.value < error.limit else "stroke_long"  # type: ignore[attr-defined]
    return STATUS.index(name)


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
