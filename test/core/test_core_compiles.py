"""The core under the compilers that are here: no warnings, no complaint of a sanitizer, the same bits.

``benchmarks.c_core`` does it for more compilers, instruction sets and processors.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import long_test

from benchmarks.c_core import SANITIZED, STRICT, Build, builds, missing, printed
from hexapod_comp import core
from hexapod_comp.core.build import FLAGS, sources_hash
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

SOURCE = Path(core.__file__).parent / "hexapod_batch.c"
BUILDS = {build.name: build for build in builds()}
ULPS = Path(__file__).parent / "ulps.c"
QUICK = Build("sanitizers", ["gcc", *SANITIZED, "-O0", "-g0", "-DWIDE="])


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns(compiler, tmp_path):
    if missing(Build(compiler, [compiler])):
        pytest.skip(f"no {compiler} here")
    words = [compiler, *FLAGS, "-O1", *STRICT, "-c", str(SOURCE), "-o", str(tmp_path / "core.o")]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.stderr == ""


@long_test
def test_sanitizers_have_nothing_to_say_and_the_numbers_are_the_same(tmp_path):
    """Commands, estimates, temperatures, batches, checks, travel, assembly modes and drives; undefined is an error."""
    if missing(BUILDS["gcc -O0"]):
        pytest.skip("no gcc here")
    geometry = load_geometry("paper")
    write_c(tmp_path, geometry, load_model("paper_machine", geometry), ("", ""))
    plain, sanitized = (printed(build, tmp_path, 500) for build in (BUILDS["gcc -O0"], QUICK))
    assert plain == sanitized
    assert plain.count("\ntool ") > 500  # most of the commands and estimates were answered


def test_elementary_functions_are_right_to_one_unit_in_the_last_place(tmp_path):
    """Of five million arguments, beside the C library in long double."""
    if missing(BUILDS["gcc -O3"]) or np.finfo(np.longdouble).nmant < 63:
        pytest.skip("no gcc, or no long double here")
    words = ["gcc", *FLAGS, *STRICT, f"-I{SOURCE.parent}", str(ULPS), "-o", str(tmp_path / "ulps"), "-lm"]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.stderr == ""
    ran = subprocess.run([str(tmp_path / "ulps"), "500000"], capture_output=True, text=True, check=True)
    assert max(map(float, ran.stdout.split())) < 1.0


ROOT = Path(__file__).resolve().parents[2]


def test_the_core_was_built_of_these_very_sources():
    """Where it fails: python setup.py build_ext --inplace."""
    assert core.ffi.string(core.lib.hc_sources()).decode() == sources_hash(Path(core.__file__).parent)


WITHOUT_CFFI = (
    "import runpy, sys; sys.modules['cffi'] = None; sys.argv = ['setup.py', *sys.argv[1:]]; runpy.run_path('setup.py')"
)


def test_a_build_without_cffi_fails_and_says_what_is_missing(tmp_path):
    """As colcon and setup.py run it; pip brings cffi. setuptools alone would end well, with no core."""
    copied = ("setup.py", "package.xml", "README.md", "LICENSE", "tools", "hexapod_comp")
    for name in copied:
        (tmp_path / name).symlink_to(ROOT / name)
    words = [sys.executable, "-c", WITHOUT_CFFI, "build"]
    made = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode != 0
    assert "setup.py: cffi is missing" in made.stderr
    assert "python3-cffi" in made.stderr
