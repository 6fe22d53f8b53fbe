"""The core with a machine's constants, as controllers compile it: the answers that Python gets from the same files."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from ctypes import c_double
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import long_test
from hypothesis import given
from replay_helpers import CONFIG
from strategies import fixed, paper_geometry, random_model, random_pose, seeds, skewed_geometry

from hexapod_comp.cli import main
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.core import Status, Struct, ffi, lib
from hexapod_comp.export.c_code import CORE, model_header, write_c
from hexapod_comp.machine.model import MachineModel, core_model

COMPILER = shutil.which("gcc")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic", "-O1"]
# Exactly rounded, whoever made the C library: with others the answers' bits would depend on it
MATHEMATICS = ["sqrt", "floor", "fmin", "fmax", "rint", "fmod", "frexp", "ldexp"]

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no gcc here")

MACHINES = [
    ("paper", "paper_machine"),
    pytest.param("paper", "paper_lines_model", marks=long_test),
    ("positioning_unit", "ideal"),
]


def compiled(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(COMPILER), *STRICT, *arguments, "-lm"], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize(("machine", "model"), MACHINES)
def test_self_test_agrees_to_the_last_digit_and_stays_inside(tmp_path, capsys, machine, model):
    """As a user makes it; gcc's address and undefined-behaviour sanitizers end the program at the first fault."""
    assert main(["export", "--machine", machine, "--model", model, "--c", str(tmp_path)]) == 0
    sanitizers = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    made = compiled(tmp_path, *sanitizers, "hexapod_comp.c", "hexapod_selftest.c", "-o", "selftest")
    assert made.returncode == 0, made.stderr
    ran = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stdout
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


def test_core_has_no_globals_and_needs_nothing_but_mathematics(tmp_path):
    """nm: no data of its own (no D, B, C symbols), and what is undefined is from the mathematical library."""
    shutil.copytree(CORE, tmp_path, dirs_exist_ok=True)
    assert compiled(tmp_path, "-c", "hexapod_comp.c", "-o", "core.o").returncode == 0
    lines = subprocess.run(["nm", "core.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-2:] for line in lines.splitlines()]
    assert not [name for kind, name in symbols if kind in "DdBbC"]
    needed = {name for kind, name in symbols if kind == "U"}
    assert needed <= {*MATHEMATICS, *["memcpy", "memset", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"]}


def test_nominal_lengths_give_what_their_pose_gives():
    """For controllers that plan struts. 1e-12 m: what Newton leaves, times the condition."""
    rng = np.random.default_rng(7)
    geometry = skewed_geometry(0.005)
    model = random_model(rng, geometry.name)
    by_pose, constants, state = Compensator(geometry, model), core_model(geometry, model), Struct("hc_state")
    answer, now = ffi.new("hc_answer *"), ffi.new("hc_time *")
    lib.hc_init(state.at, constants.at, 1e-3)
    pose = geometry.tool_pose(geometry.home)
    for n in range(300):
        pose = random_pose(rng, pose, 2e-4, 0.02)
        by_pose.step((*pose.position, *pose.quaternion()), 0.001 * n)
        now.made, now.received = 0.001 * n, np.nan
        assert lib.hc_command_lengths(state.at, by_pose.nominal.tolist(), now[0], answer) == Status.OK
        np.testing.assert_allclose(list(answer.command), by_pose.command, rtol=0.0, atol=1e-12)
    far = by_pose.nominal * [1, 1, 1, 1, 1, 3]
    assert lib.hc_command_lengths(state.at, far.tolist(), now[0], answer) == Status.UNREACHABLE


@fixed
@given(seeds)
def test_the_header_is_what_python_fills(seed):
    """Drawn machines and models: compiled constants and those in memory are the same numbers.

    The header's own text is read here, member by member, by a reader that knows nothing of how it is written.
    """
    rng = np.random.default_rng(seed)
    geometry = skewed_geometry(0.005) if rng.random() < 0.5 else paper_geometry()
    model = random_model(rng, geometry.name)
    text = model_header(geometry, model, ("", ""))
    told = {name: numbers_in(text, name) for name in ("base", "platform", "tool_inverse", "limits", "struts", "late")}
    view = core_model(geometry, model).view
    for name, numbers in told.items():
        np.testing.assert_array_equal(numbers, np.array(flat(view[name].tolist())), err_msg=name)
    for name, array in (("map_pieces", model.struts.spline_coefficients()), ("field_lines_1", model.field.lines[1])):
        block = text.partition(f"hexapod_{name}[")[2].partition("};")[0].partition("{")[2]
        assert sorted(numbers_of(block)) == sorted(array.ravel().tolist() or [0.0])


def numbers_of(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])", text)]


def numbers_in(text: str, name: str) -> np.ndarray:
    """Return the numbers of a member of the model, down to the next member's name at its depth."""
    return np.array(numbers_of(re.split(rf"\n    \.{name} = ", text)[1].partition("\n    .")[0]))


def flat(value: object) -> list[float]:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    return [x for part in value for x in flat(part)] if isinstance(value, (list, tuple)) else [float(value)]


def test_a_hostile_name_stays_what_it_is(tmp_path):
    """Names go into string literals: quotes, backslashes, trigraphs and letters beyond ASCII."""
    name = 'mill "7" \\n ??/ Größe'
    geometry = replace(paper_geometry(), name=name)
    write_c(tmp_path, geometry, MachineModel(name, "ideal"), ("", ""))
    (tmp_path / "name.c").write_text(
        '#include <stdio.h>\n#include "hexapod_model.h"\nint main(void) { return puts(hexapod_model.machine) < 0; }\n'
    )
    made = compiled(tmp_path, "name.c", "hexapod_comp.c", "-o", "name")
    assert made.returncode == 0, made.stderr
    assert subprocess.check_output([tmp_path / "name"], text=True).rstrip("\n") == name
