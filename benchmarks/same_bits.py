"""The core's numbers under every compiler and instruction set that is here: the same bits.

``test/core/driver.c`` goes through all that the core does, on a shipped machine, and prints each number in full. It is
compiled by gcc, clang and zig, for each width of vectors, for 32-bit x86 and for ARM under QEMU (Debian packages:
clang, gcc-i686-linux-gnu, gcc-arm-linux-gnueabihf, qemu-user; PyPI: ziglang), and with sanitizers. What a build prints
is compared with gcc's: no C library's sine or exponential is in it.

Run ``python -m benchmarks.same_bits``. Exits 1 when a bit differs, or a sanitizer complains.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from hexapod_comp import core
from hexapod_comp.core.build import FLAGS
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

DRIVER = Path(__file__).resolve().parents[1] / "test" / "core" / "driver.c"
SOURCES = Path(core.__file__).parent

STRICT = ["-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]
SANITIZED = ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
ARM = ["arm-linux-gnueabihf-gcc", "-O2", "-static"], ["qemu-arm"]


@dataclass(frozen=True)
class Build:
    """A way to compile the driver: compiler and words, what runs it, the processor it needs."""

    name: str
    words: list[str]
    runs: tuple[str, ...] = ()
    needs: str = ""


def builds() -> list[Build]:
    """Return the ways; the first one is what the others are compared with."""
    zig = [sys.executable, "-m", "ziglang", "cc"] if importlib.util.find_spec("ziglang") else ["zig", "cc"]
    return [
        Build("gcc -O3", ["gcc", "-O3"]),
        Build("gcc -O0", ["gcc", "-O0"]),
        Build("gcc, SSE2", ["gcc", "-O3", "-DWIDE="]),
        Build("gcc, AVX2 with FMA", ["gcc", "-O3", "-DWIDE=", "-mavx2", "-mfma"], needs="avx2"),
        Build("gcc, AVX-512", ["gcc", "-O3", "-DWIDE=", "-mavx512f"], needs="avx512f"),
        Build("gcc, sanitizers", ["gcc", *SANITIZED]),
        Build("clang -O3", ["clang", "-O3"]),
        Build("clang, sanitizers", ["clang", *SANITIZED]),
        Build("zig -O3", [*zig, "-O3"]),
        Build("32-bit x86", ["i686-linux-gnu-gcc", "-O2", "-msse2", "-mfpmath=sse", "-static"]),
        Build("ARM, 32 bits", ARM[0], tuple(ARM[1])),
    ]


def compiled(build: Build, folder: Path) -> subprocess.CompletedProcess[str]:
    """Return what compiling the driver said; it is then ``driver`` in the folder."""
    flags = [*(flag for flag in FLAGS if flag != "-O3"), *STRICT, f"-I{folder}", f"-I{SOURCES}"]
    words = [*build.words, *flags, str(DRIVER)]  # which includes the core
    return subprocess.run([*words, "-lm", "-o", str(folder / "driver")], capture_output=True, text=True)


def printed(build: Build, folder: Path, commands: int) -> str:
    """Return what the driver prints."""
    made = compiled(build, folder)
    if made.returncode or made.stderr:
        raise RuntimeError(made.stderr.strip())
    ran = subprocess.run([*build.runs, str(folder / "driver"), str(commands)], capture_output=True, text=True)
    if ran.returncode or ran.stderr:
        raise RuntimeError(f"ended with {ran.returncode}: {ran.stderr.strip()}")
    return ran.stdout


def missing(build: Build) -> str:
    """Return what is not here that a build needs, or nothing."""
    for word in (build.words[0], *build.runs):
        if shutil.which(word) is None:
            return word
    flags = Path("/proc/cpuinfo")
    if build.needs and not (flags.exists() and f" {build.needs} " in flags.read_text()):
        return build.needs
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.same_bits", description=__doc__.split("\n")[0])
    parser.add_argument("--machine", default="paper")
    parser.add_argument("--model", default="paper_machine")
    parser.add_argument("--commands", type=int, default=20_000)
    args = parser.parse_args()
    geometry = load_geometry(args.machine)
    expected, failed = "", []
    for build in builds():
        if missing(build):
            print(f"{build.name:22} not tried: no {missing(build)} here")
            if not expected:
                return 2
            continue
        with tempfile.TemporaryDirectory() as name:
            write_c(Path(name), geometry, load_model(args.model, geometry), ("", ""))
            try:
                text = printed(build, Path(name), args.commands)
            except RuntimeError as error:
                print(f"{build.name:22} FAILED: {error}")
                failed.append(build.name)
                continue
        expected = expected or text
        apart = sum(line != other for line, other in zip_longest(text.splitlines(), expected.splitlines()))
        numbers = sum(len(line.split()) - 1 for line in text.splitlines())
        said = f"{apart:,} lines differ" if apart else "the same bits"
        print(f"{build.name:22} {numbers:,} numbers: {said}", flush=True)
        if apart:
            failed.append(build.name)
    print(f"FAILED: {', '.join(failed)}" if failed else "PASSED")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
