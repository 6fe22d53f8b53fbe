"""The core under each compiler that is here: no warnings, and it needs nothing but the mathematical library."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from hexapod_comp import core
from hexapod_comp.core.build import FLAGS

FOLDER = Path(core.__file__).parent
STRICT = ["-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns(compiler, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} here")
    words = [compiler, *FLAGS, *STRICT, "-c", str(FOLDER / "hexapod_batch.c"), "-o", str(tmp_path / "core.o")]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.stderr == ""
