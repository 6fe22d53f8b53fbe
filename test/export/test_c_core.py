"""The C core beside the Python compensator: the same numbers, the same refusals, and nothing read or written outside.

The truth is the Python compensator, whose own tests hold it to the papers and to closed forms. Two units in the last
place of a length are allowed, since compilers and mathematical libraries differ by as much; here they differ by none.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from ctypes import Structure, byref, c_char_p, c_double, c_int
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from replay_helpers import CONFIG, RecordedMachine, write_bag
from strategies import fixed, paper_geometry, random_model, random_pose, seeds, skewed_geometry

from hexapod_comp.cli import main
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.state import BESIDE_NUMBERS
from hexapod_comp.errors import HexapodError
from hexapod_comp.export.c_code import SOURCES, STATUS, write_c
from hexapod_comp.export.c_library import CCompensator, CPose
from hexapod_comp.kernels.struts import GROWTH, PARAMETERS
from hexapod_comp.machine.field import no_field
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.late import LateGrowth
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import Temperatures

COMPILER = shutil.which("gcc")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O1"]
PLACES = [f"{what}_{part}" for what in ("platform", "model") for part in ("position", "rotation")]
"""Parts of the state that mean nothing before the first command."""

MATHEMATICS = ["exp", "expm1", "sqrt", "sin", "cos", "sincos", "acos", "atan2", "floor", "fmin", "fmax"]

ALLOWED = 2.0 * np.finfo(float).eps
"""Of a length below 1 m: two units in the last place of numbers in [0.5, 1)."""

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no gcc here")

MACHINES = [("paper", "paper_machine"), ("paper", "paper_lines_model"), ("positioning_unit", "ideal")]


def compiled(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(COMPILER), *STRICT, *arguments, "-lm"], cwd=folder, capture_output=True, text=True)


def library(folder: Path) -> Path:
    """Return an export compiled as a shared library."""
    made = compiled(folder, "-fPIC", "-shared", "hexapod_comp.c", "hexapod_library.c", "-o", "libhexapod.so")
    assert made.returncode == 0, made.stderr
    return folder / "libhexapod.so"


@pytest.fixture(scope="module")
def core(tmp_path_factory) -> CCompensator:
    """The core of the paper's machine, as a library; tests put other machines in its place."""
    folder = tmp_path_factory.mktemp("core")
    geometry = paper_geometry()
    write_c(folder, geometry, MachineModel(geometry.name), ("", ""))
    return CCompensator(library(folder), geometry, MachineModel(geometry.name))


@pytest.mark.parametrize(("machine", "model"), MACHINES)
def test_self_test_agrees_to_the_last_digit_and_stays_inside(tmp_path, capsys, machine, model):
    """As a user makes it; gcc's address and undefined-behaviour sanitizers end the program at the first fault."""
    assert main(["export", "--machine", machine, "--model", model, "--c", str(tmp_path)]) == 0
    sanitizers = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    made = compiled(tmp_path, *sanitizers, "hexapod_comp.c", "hexapod_selftest.c", "-o", "selftest")
    assert made.returncode == 0, made.stderr
    ran = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "as they should be" in ran.stdout


def test_self_test_notices_three_units_in_the_last_place(tmp_path):
    geometry = paper_geometry()
    write_c(tmp_path, geometry, MachineModel(geometry.name), ("", ""))
    vectors = tmp_path / "hexapod_vectors.h"
    text = vectors.read_text()
    first = re.search(r"\{'c', 0, .*?, \{.*?\}, \{(0\.\d+)", text)
    assert first is not None
    changed = float(first[1])
    for _ in range(3):
        changed = float(np.nextafter(changed, 1.0))
    vectors.write_text(text[: first.start(1)] + repr(changed) + text[first.end(1) :])
    made = compiled(tmp_path, "hexapod_comp.c", "hexapod_selftest.c", "-o", "selftest")
    assert made.returncode == 0, made.stderr
    ran = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True)
    assert ran.returncode == 1
    assert "WRONG" in ran.stdout


def test_the_loop_of_the_page_compiles_and_answers(tmp_path):
    """doc/c_core.md, as it stands there; at home an ideal machine is told its nominal lengths."""
    geometry = paper_geometry()
    write_c(tmp_path, geometry, MachineModel(geometry.name), ("", ""))
    page = (CONFIG.parent / "doc" / "c_core.md").read_text(encoding="utf-8")
    (tmp_path / "loop.c").write_text(page.split("```c\n")[1].split("```")[0])
    made = compiled(tmp_path, "-fPIC", "-shared", "hexapod_comp.c", "loop.c", "-o", "loop.so")
    assert made.returncode == 0, made.stderr
    loop, struts, pose = ctypes.CDLL(str(tmp_path / "loop.so")), (c_double * 6)(), geometry.tool_pose(geometry.home)
    loop.start()
    assert loop.cycle((c_double * 7)(*pose.position, *pose.quaternion()), c_double(0.0), struts) == 0
    expected = np.linalg.norm(geometry.home.position + geometry.platform_joints - geometry.base_joints, axis=1)
    np.testing.assert_allclose(list(struts), expected, rtol=0.0, atol=1e-15)


def test_names_of_refusals_are_the_header_s_in_its_order():
    """The enumeration is counted by hand on both sides."""
    header = (SOURCES[0] / "hexapod_comp.h").read_text().partition("} hc_status;")[0]
    names = re.findall(r"^    HC_(\w+)", header, re.MULTILINE)
    assert [name.lower() for name in names] == [
        {"other_assembly_mode": "other_assembly"}.get(name, name) for name in STATUS
    ]


def test_core_has_no_globals_and_needs_nothing_but_mathematics(tmp_path):
    """nm: no data of its own (no D, B, C symbols), and what is undefined is from the mathematical library."""
    shutil.copytree(SOURCES[0], tmp_path, dirs_exist_ok=True)
    assert compiled(tmp_path, "-c", "hexapod_comp.c", "-o", "core.o").returncode == 0
    lines = subprocess.run(["nm", "core.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-2:] for line in lines.splitlines()]
    assert not [name for kind, name in symbols if kind in "DdBbC"]
    needed = {name for kind, name in symbols if kind == "U"}
    assert needed <= {*MATHEMATICS, *["memcpy", "memset", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"]}


class CBody(Structure):
    _fields_ = (
        ("joints", c_double * 18),
        ("deviation", c_double * 18),
        ("axes", c_double * 18),
        ("expansion", c_double),
    )


class CLimits(Structure):
    _fields_ = (("numbers", c_double * 104),)


class CMap(Structure):
    _fields_ = (("count", c_int), ("knots", ctypes.c_void_p), ("pieces", ctypes.c_void_p))


class CField(Structure):
    _fields_ = (
        ("probe", c_double * 3),
        ("node_count", c_int * 3),
        ("nodes", ctypes.c_void_p * 3),
        ("powers", c_int * 3),
        ("lines", ctypes.c_void_p * 3),
        ("refuse_outside", c_int),
    )


class CLate(Structure):
    """hc_late"""

    _fields_ = (
        ("count", c_int),
        ("time_constants", c_double * 2),
        ("expansion", (c_double * 2) * 8),
        ("sensors", c_int * 8),
    )


class CModel(Structure):
    """hc_model, so that thousands of machines can be tried without a compiler."""

    _fields_ = (
        *((name, c_char_p) for name in ("machine", "model", "date", "geometry_sha256", "model_sha256")),
        ("base", CBody),
        ("platform", CBody),
        *((name, CPose) for name in ("home", "work", "tool", "tool_inverse")),
        ("limits", CLimits),
        ("struts", c_double * (6 * (PARAMETERS + 1))),
        ("map", CMap),
        ("field", CField),
        ("late", CLate),
        ("axis_threshold", c_double),
        ("strut_threshold", c_double),
    )


def in_c(geometry: HexapodGeometry, model: MachineModel) -> tuple[CModel, list[np.ndarray]]:
    """Return a machine as the core takes it, and the arrays that it points to."""
    real = RealMachine(geometry, model)
    table, knots, pieces = real.strut_arrays
    table[:, GROWTH] = model.struts.expansion
    lines = [family.swapaxes(3, 4) for family in model.field.lines]
    made, kept = CModel(), [np.ascontiguousarray(a) for a in (knots, pieces, *model.field.grid, *lines)]
    for name, joints, axes in zip(("base", "platform"), geometry.kernel_joints, geometry.kernel_axes, strict=True):
        deviation, expansion = getattr(model, f"{name}_deviation"), getattr(model, f"{name}_expansion")
        setattr(made, name, CBody(*(tuple(np.ravel(a)) for a in (joints, deviation, axes)), expansion))
    tool = geometry.tool
    for name, pose in {
        "home": geometry.home,
        "work": geometry.work,
        "tool": tool,
        "tool_inverse": tool.inverse(),
    }.items():
        setattr(made, name, CPose(tuple(pose.position), tuple(pose.rotation.ravel())))
    made.limits.numbers[:] = np.concatenate([np.ravel(part) for part in geometry.limit_numbers])
    made.struts[:] = np.insert(table, GROWTH + 1, 0.0, axis=1).ravel()
    at = [array.ctypes.data for array in kept]
    made.map = CMap(len(knots), *at[:2])
    made.field = CField(
        tuple(model.field.probe),
        tuple(len(nodes) for nodes in model.field.grid),
        tuple(at[2:5]),
        tuple(family.shape[4] for family in model.field.lines),
        tuple(at[5:]),
        model.field.outside == "refuse",
    )
    late = model.late_growth
    made.late.count = len(late.time_constants)
    made.late.time_constants[: made.late.count] = late.time_constants
    for part in range(8):
        made.late.expansion[part][: made.late.count] = late.expansion[part].tolist()
        made.late.sensors[part] = late.sensor_of(part)
    made.axis_threshold, made.strut_threshold = real.thresholds
    return made, kept


def drawn_machine(rng: np.random.Generator) -> tuple[HexapodGeometry, MachineModel]:
    """Draw a machine with frames, leads and limits, and a model with some of the blocks."""
    geometry = skewed_geometry(rng.choice([0.0, 0.005, -0.01])) if rng.random() < 0.7 else paper_geometry()
    frames = {name: random_pose(rng, random_pose(rng, geometry.home), 0.1, 60.0) for name in ("tool", "work")}
    geometry = replace(geometry, **frames) if rng.random() < 0.5 else geometry
    geometry = replace(geometry, limits=replace(geometry.limits, clearance=float(rng.choice([0.0, 0.005, 0.012]))))
    model = random_model(rng, geometry.name)
    if rng.random() < 0.3:
        model = replace(model, struts=StrutErrors())
    if rng.random() < 0.3:
        model = replace(model, field=no_field())
    if rng.random() < 0.2:
        model = replace(model, field=replace(model.field, outside="refuse"))
    if rng.random() < 0.5:
        constants = ((0.05,), (0.02, 0.5))[rng.integers(2)]  # of some ten commands
        expansion = 1e-5 * rng.standard_normal((8, len(constants)))
        late = LateGrowth(tuple(1e3 * c for c in constants), expansion, ("", "base", "strut_2")[rng.integers(3)])
        model = replace(model, late_growth=late)
    return geometry, model


def drawn_event(rng: np.random.Generator, geometry: HexapodGeometry, last: np.ndarray, at: Any) -> tuple[str, Any]:
    """Draw what happens next: most of the time a command near the last one."""
    kind = rng.choice(
        ["step", "estimate", "temperature", "enable", "reset", "odd"], p=[0.75, 0.1, 0.05, 0.04, 0.03, 0.03]
    )
    if kind == "step":
        pose = random_pose(rng, at, *rng.choice([(2e-4, 0.02), (2e-3, 0.2), (0.1, 20.0)], p=[0.8, 0.15, 0.05]))
        return "step", pose
    if kind == "odd":
        numbers = [*rng.uniform(-0.1, 0.1, 3), 0.0, 0.0, 0.0, 1.0]
        numbers[rng.integers(7)] = rng.choice([np.nan, np.inf, -np.inf, 1e308, 3.0, 0.0])
        return "odd", tuple(map(float, numbers))
    if kind == "temperature":
        return kind, (Temperatures.NAMES[rng.integers(8)], float(rng.uniform(-60.0, 140.0)))
    if kind == "enable":
        return kind, bool(rng.integers(2))
    lengths = np.where(np.isfinite(last), last, 0.5) + rng.choice([0.0, 1e-5, 1e-3, 0.3]) * rng.uniform(-1.0, 1.0, 6)
    if kind == "reset" and rng.random() < 0.3:
        return kind, None
    return kind, lengths


def outcome_of(compensator: Any, kind: str, value: Any, made: float, received: float) -> tuple[str, np.ndarray]:
    """Do one thing; return the refusal, and the numbers that came of it."""
    numbers = np.zeros(0)
    try:
        if kind in ("step", "odd"):
            pose = value if kind == "odd" else (*value.position, *value.quaternion())
            compensator.step(tuple(map(float, pose)), made, None, received)
            compensator.published(received + 2e-4)
        elif kind == "estimate":
            numbers = compensator.estimate(value).copy()
        elif kind == "temperature":
            compensator.set_temperature(*value, 1e3 * made)  # as seldom as in a shop
        else:
            getattr(compensator, kind)(value)
    except HexapodError as error:
        return error.reason, np.zeros(0)
    return "", np.concatenate([numbers, compensator.command, compensator.correction])


@fixed
@given(seeds)
def test_drawn_machines_models_and_events_give_the_same_numbers_and_refusals(core, seed):
    """Every block, reversals, ramps, temperatures, restarts, refusals, odd numbers; state for state at the end."""
    rng = np.random.default_rng(seed)
    geometry, model = drawn_machine(rng)
    machine, kept = in_c(geometry, model)
    python = Compensator(geometry, model)
    core._library.hc_init(byref(core.state), ctypes.addressof(machine), c_double(1e-3))
    at = geometry.tool_pose(geometry.home)
    for n in range(80):
        kind, value = drawn_event(rng, geometry, python.command, at)
        received = 0.004 * n + rng.uniform(0.0, 0.004)
        times = (np.nan if rng.random() < 0.1 else 0.004 * n, np.nan if rng.random() < 0.1 else received)
        expected, got = (outcome_of(c, kind, value, *times) for c in (python, core))
        assert got[0] == expected[0], (n, kind, value)
        np.testing.assert_allclose(got[1], expected[1], rtol=0.0, atol=ALLOWED, equal_nan=True)
        if kind == "step" and not expected[0]:
            at = value
    assert kept  # the core points into them
    ours, theirs = python.snapshot(), core.snapshot()
    for name in set(ours) - {*BESIDE_NUMBERS, *PLACES}:
        np.testing.assert_allclose(theirs[name], ours[name], rtol=0.0, atol=ALLOWED, equal_nan=True, err_msg=name)


def test_nominal_lengths_give_what_their_pose_gives(core):
    """For controllers that plan struts. 1e-12 m: what Newton leaves, times the condition."""
    rng = np.random.default_rng(7)
    geometry = skewed_geometry(0.005)
    machine, kept = in_c(geometry, random_model(rng, geometry.name))
    by_pose, by_lengths = Compensator(geometry, random_model(np.random.default_rng(7), geometry.name)), core
    core._library.hc_init(byref(core.state), ctypes.addressof(machine), c_double(1e-3))
    pose = geometry.tool_pose(geometry.home)
    for n in range(300):
        pose = random_pose(rng, pose, 2e-4, 0.02)
        by_pose.step((*pose.position, *pose.quaternion()), 0.001 * n)
        got = by_lengths.step_lengths(by_pose.nominal, 0.001 * n)
        np.testing.assert_allclose(got, by_pose.command, rtol=0.0, atol=1e-12)
    with pytest.raises(HexapodError, match="unreachable"):
        by_lengths.step_lengths(by_pose.nominal * [1, 1, 1, 1, 1, 3], 1.0)
    assert kept


def test_inch_machine_with_a_hostile_name(tmp_path):
    """Names go into string literals: quotes, backslashes, trigraphs and letters beyond ASCII stay what they are."""
    name = 'mill "7" \\n ??/ Größe'
    geometry = replace(paper_geometry(), name=name)
    model = MachineModel(name, "ideal")
    write_c(tmp_path, geometry, model, ("", ""))
    assert CCompensator(library(tmp_path), geometry, model).geometry.name == name


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A bag with temperatures, switching and a start from measured struts."""
    machine = RecordedMachine()
    machine.wave(200)
    machine.compensator.set_temperature("strut_3", 23.5)
    machine.wave(100, 200)
    machine.compensator.enable(False)
    machine.wave(100, 300)
    machine.page()
    machine.compensator.enable(True)
    machine.compensator.reset(machine.compensator.command.copy())
    machine.wave(100, 400)
    machine.page()
    return write_bag(tmp_path_factory.mktemp("bags") / "run", machine.messages)


def test_recording_replays_through_the_core(recording, tmp_path, capsys):
    """The same bits as the node's."""
    main(["export", "--model", "paper_machine", "--c", str(tmp_path)])
    assert main(["replay", str(recording), "--c", str(library(tmp_path))]) == 0
    assert "500 of 500" in capsys.readouterr().out


def test_recording_refuses_the_core_of_another_model(recording, tmp_path, capsys):
    text = (CONFIG / "paper_machine.yaml").read_text().replace(": ", ":  ", 1)
    (tmp_path / "same_but_one_blank.yaml").write_text(text)
    main(["export", "--model", str(tmp_path / "same_but_one_blank.yaml"), "--c", str(tmp_path / "c")])
    assert main(["replay", str(recording), "--c", str(library(tmp_path / "c"))]) == 2
    assert "is made of another model file than the recording's" in capsys.readouterr().err


@pytest.mark.parametrize(("content", "said"), [(None, "is no library"), (b"no library", "is no library")])
def test_what_is_no_library_is_named(recording, tmp_path, capsys, content, said):
    path = tmp_path / "lib.so"
    if content is not None:
        path.write_bytes(content)
    assert main(["replay", str(recording), "--c", str(path)]) == 2
    assert said in capsys.readouterr().err
