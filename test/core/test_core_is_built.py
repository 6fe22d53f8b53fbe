"""The extension module that setup.py builds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hexapod_comp import core
from hexapod_comp.core.build import sources_hash

ROOT = Path(__file__).resolve().parents[2]


def test_the_core_was_built_of_these_very_sources():
    """Where it fails: python setup.py build_ext --inplace."""
    assert core.ffi.string(core.lib.hc_sources()).decode() == sources_hash(Path(core.__file__).parent)


WITHOUT_CFFI = (
    "import runpy, sys; sys.modules['cffi'] = None; sys.argv = ['setup.py', *sys.argv[1:]]; runpy.run_path('setup.py')"
)


@pytest.mark.parametrize("command", [("build",), ("develop", "--no-deps")], ids=lambda c: c[0])
def test_a_build_without_cffi_fails_and_says_what_is_missing(command, tmp_path):
    """As colcon and setup.py run it; pip brings cffi. setuptools alone would end well, with no core."""
    copied = ("setup.py", "package.xml", "README.md", "LICENSE", "tools", "hexapod_comp")
    for name in copied:
        (tmp_path / name).symlink_to(ROOT / name)
    words = [sys.executable, "-c", WITHOUT_CFFI, *command]
    made = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode != 0
    assert "setup.py: cffi is missing" in made.stderr
    assert "python3-cffi" in made.stderr


def test_what_builds_nothing_needs_no_cffi(tmp_path):
    """Tools ask a package for its name before they install what it needs."""
    words = [sys.executable, "-c", WITHOUT_CFFI, "--name"]
    made = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert made.stdout.strip() == "hexapod_comp"
