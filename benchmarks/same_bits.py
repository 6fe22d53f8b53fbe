"""The core's numbers under every compiler and instruction set that is here: the same bits.

``test/core/driver.c`` goes through all that the core does, on a shipped machine, and prints each number in full. It is
compiled by gcc, clang and zig, for each width of vectors, for 32-bit x86 and for ARM under QEMU (Debian packages:
clang, gcc-i686-linux-gnu, gcc-arm-linux-gnueabihf, qemu-user; PyPI: ziglang), and with sanitizers. What a build prints
is compared with gcc's. zig links a sine, a cosine and an exponential of its own, which differ in the last place.

Run ``python -m benchmarks.same_bits``. Exits 1 when a number differs by more than its build may, or a sanitizer
complains.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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

OWN_MATHEMATICS = 1e-6
"""Where sine and cosine differ in the last place, a minimiser at a double root ends elsewhere by about its root."""


@dataclass(frozen=True)
class Build:
    """A way to compile the driver: compiler and words, what runs it, the processor it needs, what may differ."""

    name: str
    words: list[str]
    runs: tuple[str, ...] = ()
    needs: str = ""
    allowed: float = 0.0


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
        Build("zig -O3", [*zig, "-O3"], allowed=OWN_MATHEMATICS),
        Build("32-bit x86", ["i686-linux-gnu-gcc", "-O2", "-msse2", "-mfpmath=sse", "-static"]),
        Build("ARM, 32 bits", ARM[0], tuple(ARM[1])),
    ]


def compiled(build: Build, folder: Path) -> subprocess.CompletedProcess[str]:
    """Return what compiling the driver said; it is then ``driver`` in the folder."""
    sources = [str(DRIVER), str(SOURCES / "hexapod_batch.c")]
    words = [*build.words, *(flag for flag in FLAGS if flag != "-O3"), *STRICT, f"-I{folder}", f"-I{SOURCES}", *sources]
    return subprocess.run([*words, "-lm", "-o", str(folder / "driver")], capture_output=True, text=True)


def printed(build: Build, folder: Path, commands: int) -> str:
    """Return what the driver prints.

    Raises
    ------
    RuntimeError
        It was not compiled without a word, or did not run to its end: what was said.
    """
    made = compiled(build, folder)
    if made.returncode or made.stderr:
        raise RuntimeError(made.stderr.strip())
    ran = subprocess.run([*build.runs, str(folder / "driver"), str(commands)], capture_output=True, text=True)
    if ran.returncode or ran.stderr:
        raise RuntimeError(f"ended with {ran.returncode}: {ran.stderr.strip()}")
    return ran.stdout


def largest_difference(text: str, other: str) -> float:
    """Return the largest difference of two printouts' numbers; infinite where their words or NaN differ."""
    lines, others = text.splitlines(), other.splitlines()
    if len(lines) != len(others):
        return np.inf
    largest = 0.0
    for line, as_well in zip(lines, others, strict=True):
        if line != as_well:
            (name, *numbers), (same, *beside) = line.split(), as_well.split()
            if name != same or len(numbers) != len(beside):
                return np.inf
            a, b = np.array(numbers, float), np.array(beside, float)
            apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
            largest = max(largest, float(np.nan_to_num(apart, nan=np.inf).max()))
    return largest


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
        apart = largest_difference(text, expected)
        numbers = sum(len(line.split()) - 1 for line in text.splitlines())
        said = "the same bits" if text == expected else f"differ by up to {apart:.1g}, allowed {build.allowed:g}"
        print(f"{build.name:22} {numbers:,} numbers: {said}", flush=True)
        if text != expected and not apart <= build.allowed:
            failed.append(build.name)
    print(f"FAILED: {', '.join(failed)}" if failed else "PASSED")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
