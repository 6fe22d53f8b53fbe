"""The exported C core with a machine's constants gives the answers that Python computes from the same files."""

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
from helpers import distances
from replay_helpers import CONFIG
from strategies import paper_geometry, random_model, random_pose, skewed_geometry, whole_model

from hexapod_comp.cli import main
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.core import Status, Struct, ffi, lib
from hexapod_comp.export.c_code import self_test, write_c
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.machine.load import Load, Loading
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine, core_model
from hexapod_comp.machine.model_file import save_model

COMPILER = shutil.which("gcc")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
# The correctly rounded functions of C: any other function's bits would depend on the C library
MATHEMATICS = ["sqrt", "floor", "fmin", "fmax", "rint", "fmod", "frexp", "ldexp"]

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no gcc here")


def compiled(folder: Path, *arguments: object) -> None:
    words = [str(COMPILER), *STRICT, *map(str, arguments), "-lm"]
    made = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr


@pytest.fixture(scope="module")
def paper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the export of a shipped machine, with its core compiled: ``core.o``, and ``safe.o`` with the sanitizers.

    The core's files are the same for all machines. The optimiser's passes give some of gcc's warnings.
    """
    folder = tmp_path_factory.mktemp("paper")
    assert main(["export", "--machine", "paper", "--model", "paper_machine", "--c", str(folder)]) == 0
    compiled(folder, "-O1", "-fPIC", "-c", "hexapod_comp.c", "-o", "core.o")
    compiled(folder, *SANITIZERS, "-c", "hexapod_comp.c", "-o", "safe.o")
    return folder


@pytest.mark.parametrize("whole", [False, True], ids=["paper", "with every block"])
def test_self_test_agrees_to_the_last_digit_and_stays_inside(tmp_path: Path, paper: Path, whole: bool) -> None:
    """The self-test passes; gcc's sanitizers end it at the first invalid access."""
    folder = tmp_path if whole else paper
    if whole:
        write_c(tmp_path, skewed_geometry(0.005), whole_model(np.random.default_rng(1), "skewed"), ("", ""))
        assert (tmp_path / "hexapod_comp.c").read_bytes() == (paper / "hexapod_comp.c").read_bytes()
    compiled(folder, *SANITIZERS, paper / "safe.o", "hexapod_selftest.c", "-o", "selftest")
    ran = subprocess.run([folder / "selftest"], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stdout
    assert "PASSED" in ran.stdout


def test_the_self_test_takes_every_way() -> None:
    """Commands to all sides of home in four equal parts; between the parts, the steps that self_test describes."""
    geometry = paper_geometry()
    rows = [re.findall(r"[^\s,{}']+", row) for row in self_test(geometry, MachineModel(geometry.name))]
    kinds, counts = zip(
        *((m[1], len(m[0])) for m in re.finditer(r"(.)\1*", "".join(row[0] for row in rows))), strict=True
    )
    part = counts[0]
    assert "".join(kinds) == "ctgcececprcfc"
    assert counts[1:-6] == (4, 1, part, 1, part, 1), "a whole number of parts, three refused commands and the rest"
    assert (counts[-6] - 3 - part in range(4), counts[-5:]) == (True, (2, 1, part + 1, 1, 3))
    poses = np.array([row[3:9] for row in rows if row[0] == "c" and row[1] == "0"], dtype=float)
    away = poses - [*geometry.tool_pose(geometry.home).position, 0.0, 0.0, 0.0]  # m, and the quaternions' x, y, z
    assert away.min(axis=0).max() < -1e-3 < 1e-3 < away.max(axis=0).min()
    others = [[row[0], Status(int(row[1])).name, *map(float, row[3:5])] for row in rows if row[0] in "tg"]
    assert others == [
        ["t", "OK", 2.0, 24.5],
        ["t", "OK", 6.0, 21.25],
        ["t", "TEMPERATURE", 7.0, 1e3],
        ["t", "OK", 6.0, 22.25],
        ["g", "OK", 1.0, -2.0],
    ]
    refused = [Status(int(row[1])).name for row in rows if row[0] in "cp" and row[1] != "0"]
    assert refused == ["NOT_FINITE", "QUATERNION", "STROKE_LONG", "UNREACHABLE"]
    assert [row[3] for row in rows if row[0] == "e"] == ["0.0", "1.0"]


def test_self_test_notices_three_units_in_the_last_place(tmp_path: Path, paper: Path) -> None:
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
    compiled(tmp_path, paper / "core.o", "hexapod_selftest.c", "-o", "selftest")
    ran = subprocess.run([tmp_path / "selftest"], capture_output=True, text=True)
    assert ran.returncode == 1
    assert "FAILED" in ran.stdout


def test_the_loop_of_the_page_compiles_and_answers(tmp_path: Path, paper: Path) -> None:
    """The example of doc/c_core.md compiles; at home it commands an ideal machine to its nominal lengths.

    The machine's name goes into a string literal: quotes, backslashes, trigraphs and non-ASCII letters.
    """
    geometry = replace(paper_geometry(), name='mill "7" \\n ??/ Größe')
    write_c(tmp_path, geometry, MachineModel(geometry.name), ("", ""))
    page = (CONFIG.parent / "doc" / "c_core.md").read_text(encoding="utf-8")
    asked = "\nconst char *name(void);\nconst char *name(void)\n{\n    return hexapod_model.machine;\n}\n"
    (tmp_path / "loop.c").write_text(page.split("```c\n")[1].split("```")[0] + asked)
    compiled(tmp_path, "-fPIC", "-shared", paper / "core.o", "loop.c", "-o", "loop.so")
    loop, struts, pose = ctypes.CDLL(str(tmp_path / "loop.so")), (c_double * 6)(), geometry.tool_pose(geometry.home)
    loop.start()
    assert loop.cycle((c_double * 7)(*pose.position, *pose.quaternion()), c_double(0.0), struts) == 0
    loop.name.restype = ctypes.c_char_p
    assert loop.name().decode() == geometry.name
    expected = distances(geometry, geometry.home)
    np.testing.assert_allclose(list(struts), expected, rtol=0.0, atol=1e-15)


def test_core_has_no_globals_and_needs_nothing_but_mathematics(paper: Path) -> None:
    """``nm`` lists no data symbols (D, B, C), and undefined symbols only of the mathematical library."""
    lines = subprocess.run(["nm", paper / "core.o"], capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-2:] for line in lines.splitlines()]
    assert not [name for kind, name in symbols if kind in "DdBbC"]
    needed = {name for kind, name in symbols if kind == "U"}
    assert needed <= {*MATHEMATICS, *["memcpy", "memset", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"]}


def test_nominal_lengths_give_what_their_pose_gives():
    """Nominal lengths as input give the commands of their pose, to 1e-12 m: Newton's tolerance times the condition."""
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


TYPES = {"float": "double", "bit": "int", "s32": "int", "u32": "unsigned"}
TILTED, PUSHED = [3.0, 0.0, -9.3], [100.0, -50.0, 20.0, 1.0, 2.0, 3.0]

# Two seconds at 1 kHz each: without inputs; with gravity and wrench; with NaN in both; with zeros
DRIVER = """
#include <stdio.h>
static state one;
static void run(void)
{
    for (int n = 0; n < 2000; n++) {
        correct(&one, 1000000);
    }
    for (int i = 0; i < 6; i++) {
        printf("%.12f ", one.correction_[i]);
    }
    puts(one.ok_ ? "" : "nan");
}
int main(void)
{
    const double lengths[6] = {LENGTHS}, down[3] = {DOWN}, pushing[6] = {PUSHING};
    one.unit_ = 1e-3, one.gravity_step_ = 0.01, one.wrench_step_ = 1.0, one.temperature_step_ = 0.01;
    one.enable_ = one.machine_on_ = 1;
    for (int i = 0; i < 8; i++) {
        one.temperature_[i] = 20.0;
    }
    for (int i = 0; i < 6; i++) {
        one.joint_pos_cmd_[i] = lengths[i];
    }
    run();
    for (int i = 0; i < 6; i++) {
        one.gravity_[i % 3] = down[i % 3], one.wrench_[i] = pushing[i];
    }
    run();
    one.gravity_[1] = one.wrench_[5] = NAN;
    run();
    for (int i = 0; i < 6; i++) {
        one.gravity_[i % 3] = one.wrench_[i] = 0.0;
    }
    run();
    return 0;
}
"""


def as_c(component: str) -> str:
    """Return a component of LinuxCNC as plain C, with its pins, parameters and variables as members of `inst`."""
    head, body = component.split("\n;;\n", 1)
    members, names = [], []
    for kind, name, count in re.findall(r"^(?:pin|param) \w+ (\w+) ([\w-]+?)(?:-#\[(\d+)\])?[ ;]", head, re.MULTILINE):
        own = name.replace("-", "_")
        members.append(f"{TYPES[kind]} {own}_{f'[{count}]' if count else ''};")
        names.append(f"#define {own}{'(i)' if count else ''} inst->{own}_{'[i]' if count else ''}")
    for kind, name, size in re.findall(r"^variable (\w+) (\w+)((?:\[\d+\])?);", head, re.MULTILINE):
        members.append(f"{kind} {name}_{size};")
        names.append(f"#define {name} inst->{name}_")
    function = "#define FUNCTION(name) void name(state *inst, long period)"
    undone = "\n".join(f"#undef {re.split(r'[ (]', name)[1]}" for name in names)
    struct = "typedef struct {\n" + "\n".join(members) + "\n} state;"
    return "\n".join(
        ['#include "hexapod_comp.c"', '#include "hexapod_model.h"', struct, function, *names, body, undone, DRIVER]
    )


def test_gravity_and_wrench_are_pins(tmp_path: Path) -> None:
    """The pins' gravity and wrench give the corrections of the machine under this load; NaN keeps the last load."""
    geometry = load_geometry("paper")
    origin = ModelOrigin("2026-01-31")
    model = MachineModel("paper", name="soft", origin=origin, load=Load(stiffness=np.full(6, 20e6), mass=30.0))
    save_model(model, tmp_path / "soft.yaml")
    assert main(["export", "--model", str(tmp_path / "soft.yaml"), "--c", str(tmp_path / "c")]) == 0
    lengths = strut_lengths(geometry, geometry.home)
    texts = {"LENGTHS": lengths * 1e3, "DOWN": TILTED, "PUSHING": PUSHED}
    source = as_c((tmp_path / "c" / "hexapod_rt.comp").read_text())
    for name, values in texts.items():
        source = source.replace(f"{{{name}}}", "{" + ", ".join(repr(float(value)) for value in values) + "}")
    (tmp_path / "c" / "rt.c").write_text(source)
    subprocess.run([str(COMPILER), "-ffp-contract=off", "rt.c", "-lm", "-o", "rt"], cwd=tmp_path / "c", check=True)
    out = subprocess.run([tmp_path / "c" / "rt"], capture_output=True, text=True, check=True).stdout
    found = np.array([line.split() for line in out.splitlines()], dtype=float)
    alone, loaded = (
        (RealMachine(geometry, model, loading=loading).commands_for(geometry.home)[0] - lengths) * 1e3
        for loading in (Loading(), Loading.of(TILTED, PUSHED))
    )
    assert np.abs(loaded - alone).max() > 1e-3
    np.testing.assert_allclose(found, [alone, loaded, loaded, alone], rtol=0.0, atol=1e-9)
