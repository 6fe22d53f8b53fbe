"""Compilation of the core: the choice of the C compiler, and the build requirements if there is none.

setup.py takes its build command from this module. pip and other frontends call its PEP 517 hooks (pyproject.toml names
the file): setuptools' own, which also require PyPI's package ``ziglang`` on a machine without a C compiler.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from setuptools import Extension, build_meta
from setuptools.build_meta import *  # noqa: F403 (all other hooks, unchanged)
from setuptools.command.build_ext import build_ext

PROBE = "#include <math.h>\n#include <stdint.h>\ndouble probe(double x) { return sin(x) + (double)INT64_MAX; }\n"

ZIG = [sys.executable, "-m", "ziglang", "cc", "-target", f"{platform.machine()}-linux-gnu.2.17"]
"""Target: any processor of this architecture, glibc 2.17 (2012). Without a target zig compiles for this processor."""

NO_COMPILER = """no C compiler here can compile and link a shared library, and hexapod_comp builds its core with one.
  Debian, Ubuntu: apt-get install gcc libc6-dev; Fedora: dnf install gcc; without root: pip install ziglang.
  CC=... names another compiler."""

NO_CFFI = f"""cffi is missing in {sys.executable}, and hexapod_comp builds its core with it.
  Debian, Ubuntu: apt-get install python3-cffi; Fedora: dnf install python3-cffi; any: pip install cffi."""


def core_module() -> dict[str, Any]:
    """Return the arguments of setup() for the core; without cffi, an extension whose build fails with the reason."""
    if importlib.util.find_spec("cffi"):
        return {"cffi_modules": ["hexapod_comp/core/build.py:ffi"]}
    return {"ext_modules": [Extension("hexapod_comp.core._core", sources=[])]}


def works(command: list[str]) -> bool:
    """Return whether a command can compile C that uses the standard library, and link it as a shared library."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "probe.c")
        source.write_text(PROBE, encoding="ascii")
        made = [*command, "-shared", "-fPIC", str(source), "-lm", "-o", str(Path(folder, "probe.so"))]
        try:
            return subprocess.run(made, capture_output=True, timeout=300, check=False).returncode == 0
        except OSError:
            return False


def installed_compiler() -> list[str] | None:
    """Return the C compiler: $CC, else the first of Python's own, cc, gcc and clang that works; None if none works."""
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])  # untested: the user chose it, and its own messages state what is wrong
    candidates = [shlex.split(sysconfig.get_config_var("CC") or "cc"), ["cc"], ["gcc"], ["clang"]]
    return next((command for command in candidates if works(command)), None)


class BuildCore(build_ext):
    """Build command that compiles the core with the available compiler, without Python's headers (core/stable_abi)."""

    def run(self) -> None:
        """Fail if cffi is missing; setuptools would omit the core without a message."""
        if importlib.util.find_spec("cffi") is None:
            sys.exit(f"setup.py: {NO_CFFI}")
        super().run()

    def build_extensions(self) -> None:
        """Compile and link without the flags of the running Python, whose own compiler may be a different one."""
        compiler = installed_compiler()
        if compiler is None and importlib.util.find_spec("ziglang"):
            compiler = ZIG
        if compiler is None:
            sys.exit(f"setup.py: {NO_COMPILER}")
        self.announce(f"compiling the core with {shlex.join(compiler)}", level=2)
        self.compiler.set_executables(
            compiler=compiler, compiler_so=[*compiler, "-fPIC", "-DNDEBUG"], linker_so=[*compiler, "-shared"]
        )
        for extension in self.extensions:
            extension.include_dirs.insert(0, str(Path("hexapod_comp", "core", "stable_abi")))
            extension.define_macros.append(("Py_LIMITED_API", "0x030a0000"))
            extension.extra_compile_args.append("-Werror=implicit-function-declaration")
        with tempfile.TemporaryDirectory() as folder:
            for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"):  # otherwise zig leaves 100 MB in ~/.cache
                os.environ.setdefault(name, folder)
            super().build_extensions()


def compiler_from_pypi() -> list[str]:
    """Return the additional build requirement of a machine without a C compiler: ``ziglang``."""
    return [] if installed_compiler() else ["ziglang"]


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return setuptools' requirements for a wheel and, if there is no C compiler, ``ziglang``."""
    return [*build_meta.get_requires_for_build_wheel(config_settings), *compiler_from_pypi()]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    """Return setuptools' requirements for an editable installation and, if there is no C compiler, ``ziglang``."""
    return [*build_meta.get_requires_for_build_editable(config_settings), *compiler_from_pypi()]


if __name__ == "__main__":  # called by the Makefile: exit code 0 if a compiler works; --zig prints zig's command
    if "--zig" in sys.argv:
        print(shlex.join(ZIG))
        sys.exit()
    sys.exit(0 if installed_compiler() else f"make: {NO_COMPILER}")
