"""The core under the compilers that are here: no warnings, no complaint of a sanitizer, the same bits.

``benchmarks.same_bits`` does it for more compilers, instruction sets and processors.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from benchmarks.same_bits import SANITIZED, STRICT, Build, builds, missing, printed
from hexapod_comp import core
from hexapod_comp.core.build import FLAGS
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

SOURCE = Path(core.__file__).parent / "hexapod_batch.c"
BUILDS = {build.name: build for build in builds()}
QUICK = Build("sanitizers", ["gcc", *SANITIZED, "-O0", "-g0", "-DWIDE="])


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns(compiler, tmp_path):
    if missing(Build(compiler, [compiler])):
        pytest.skip(f"no {compiler} here")
    words = [compiler, *FLAGS, "-O1", *STRICT, "-c", str(SOURCE), "-o", str(tmp_path / "core.o")]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.stderr == ""


def test_sanitizers_have_nothing_to_say_and_the_numbers_are_the_same(tmp_path):
    """Commands, estimates, temperatures, batches, checks, travel, assembly modes and drives; undefined is an error."""
    if missing(BUILDS["gcc -O0"]):
        pytest.skip("no gcc here")
    geometry = load_geometry("paper")
    write_c(tmp_path, geometry, load_model("paper_machine", geometry), ("", ""))
    plain, sanitized = (printed(build, tmp_path, 500) for build in (BUILDS["gcc -O0"], QUICK))
    assert plain == sanitized
    assert plain.count("\ntool ") > 500  # most of the commands and estimates were answered
