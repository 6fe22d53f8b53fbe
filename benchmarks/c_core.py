"""The core in C: whether all compilers and instruction sets give the same bits, and the time of a command.

The output of ``test/core/driver.c`` with other compilers (Debian packages: clang, gcc-i686-linux-gnu,
gcc-arm-linux-gnueabihf, qemu-user; PyPI: ziglang) and with sanitizers is compared with gcc's. Then commands, estimates
and LinuxCNC's genhexkins are timed in turn on one thread.

Run ``python -m benchmarks.c_core [--only bits|times]``. Exit code 1: a bit differs, a sanitizer reports an error or a
target is missed; 2: gcc is missing.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hexapod_comp import core
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.core.build import FLAGS
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure
from hexapod_comp.machine.load import Load
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import Temperatures

from . import cannot_run, judged, table
from .genhexkins import Genhexkins, NotHere, emc_poses

DRIVER = Path(__file__).resolve().parents[1] / "test" / "core" / "driver.c"
SOURCES = Path(core.__file__).parent
STRICT = ["-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]
SANITIZED = ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
# Targets: time of a command with all blocks, µs, and / time of genhexkins' inverse; time of a warm estimate, µs
LARGEST_US, LARGEST_RATIO, LARGEST_ESTIMATE_US = 1.5, 8.0, 1.5
POSES = 500
INNER = 20  # passes over the poses between two readings of the clock


# ---- the same bits ----


@dataclass(frozen=True)
class Build:
    """How the driver is compiled and run."""

    name: str
    words: list[str]  # compiler and its options
    runs: tuple[str, ...] = ()  # emulator
    needs: str = ""  # flag of the processor in /proc/cpuinfo


def builds() -> list[Build]:
    """Return all builds; the output of the first is the reference."""
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
        Build("ARM, 32 bits", ["arm-linux-gnueabihf-gcc", "-O2", "-static"], ("qemu-arm",)),
    ]


def printed(build: Build, folder: Path, commands: int) -> str:
    """Compile and run the driver in a folder that holds an exported core; return the output."""
    flags = [*(flag for flag in FLAGS if flag != "-O3"), *STRICT, f"-I{folder}", f"-I{SOURCES}"]
    words = [*build.words, *flags, str(DRIVER)]  # the driver includes the core
    made = subprocess.run([*words, "-lm", "-o", str(folder / "driver")], capture_output=True, text=True)
    if made.returncode or made.stderr:
        raise RuntimeError(made.stderr.strip())
    ran = subprocess.run([*build.runs, str(folder / "driver"), str(commands)], capture_output=True, text=True)
    if ran.returncode or ran.stderr:
        raise RuntimeError(f"ended with {ran.returncode}: {ran.stderr.strip()}")
    return ran.stdout


def missing(build: Build) -> str:
    """Return the missing program or processor flag that a build needs, or ""."""
    for word in (build.words[0], *build.runs):
        if shutil.which(word) is None:
            return word
    flags = Path("/proc/cpuinfo")
    if build.needs and not (flags.exists() and f" {build.needs} " in flags.read_text()):
        return build.needs
    return ""


def bits(commands: int) -> list[str]:
    """Print a line for each build; return descriptions of the builds whose output differs from the first build's."""
    geometry = load_geometry("paper")
    expected, failed = "", []
    for build in builds():
        if lacks := missing(build):
            print(f"{build.name:22} not tried: {lacks} is missing")
            continue
        with tempfile.TemporaryDirectory() as name:
            write_c(Path(name), geometry, load_model("paper_machine", geometry), ("", ""))
            try:
                text = printed(build, Path(name), commands)
            except RuntimeError as error:
                failed.append(f"{build.name}: {error}")
                continue
        expected = expected or text
        apart = sum(line != other for line, other in zip_longest(text.splitlines(), expected.splitlines()))
        numbers = sum(len(line.split()) - 1 for line in text.splitlines())
        said = f"{apart:,} lines differ" if apart else "the same bits"
        print(f"{build.name:22} {numbers:,} numbers: {said}", flush=True)
        failed += [f"{build.name}: {said}"] if apart else []
    return failed


# ---- times ----


def commands(geometry: HexapodGeometry) -> list[tuple[float, ...]]:
    """Return tool poses (x, y, z, quaternion): half a circle of 10 mm about home, tilts of ±3°, there and back."""
    angles = np.linspace(0.0, np.pi, POSES // 2)
    turns = Rotation.from_euler("xyz", np.deg2rad(3.0) * np.column_stack([np.sin(angles), np.cos(angles), angles]))
    circle = np.column_stack([np.sin(angles), np.cos(angles), 0.2 * np.sin(2.0 * angles)])
    tool = geometry.tool_pose(geometry.home)
    rows = np.hstack([tool.position + 0.01 * circle, (turns * Rotation.from_matrix(tool.rotation)).as_quat()])
    return [tuple(row) for row in np.vstack([rows, rows[::-1]]).tolist()]


def cardan(geometry: HexapodGeometry) -> HexapodGeometry:
    """Return the machine with cardan joints that turn the screws."""
    across = np.cross(geometry.platform_joints - geometry.base_joints, [0.0, 0.0, 1.0])
    axes = across / np.linalg.norm(across, axis=1, keepdims=True)
    return replace(geometry, base_axes=axes, platform_axes=axes, screw_lead=np.full(6, 5e-3))


def compensators(geometry: HexapodGeometry) -> dict[str, Compensator]:
    """Return a compensator for each block of the model; the first has no errors, the last all blocks of an export."""
    whole, ideal = load_model("paper_machine", geometry), MachineModel(geometry.name)
    errors, knots = whole.struts, np.linspace(0.42, 0.62, 21)
    waves = replace(StrutErrors(), cosine=errors.cosine, sine=errors.sine, period=errors.period)
    scale = replace(StrutErrors(), offset=errors.offset, pitch=errors.pitch, backlash=errors.backlash)
    values = 5e-6 * np.sin(np.outer(np.arange(1.0, 7.0), 40.0 * knots))
    curved = replace(StrutErrors(), map_knots=knots, map_values=values)
    grown = replace(StrutErrors(), expansion=np.full(6, 11.5e-6))
    joints = {"base_deviation": whole.base_deviation, "platform_deviation": whole.platform_deviation}

    def with_block(**changes: object) -> Compensator:
        return Compensator(geometry, replace(ideal, **changes))

    warm = with_block(struts=grown, base_expansion=11.5e-6, platform_expansion=11.5e-6)
    for name in ("strut_1", "strut_4", "base", "platform"):
        warm.set_temperature(name, 23.0)
    turning, weight = cardan(geometry), Load(stiffness=np.full(6, 20e6), lost_motion=np.full(6, 1e-6), mass=30.0)
    rubbing = replace(weight, friction=np.full(6, 0.5))
    return {
        "ideal": with_block(),
        "structure": with_block(**joints),
        "struts: scale": with_block(struts=scale),
        "struts: waves": with_block(struts=waves),
        "struts: map": with_block(struts=curved),
        "screw rotation": Compensator(turning, ideal),
        "thermal": warm,
        "field": with_block(field=whole.field),
        "load": with_block(load=weight),
        "load, friction": with_block(load=rubbing),
        "all of them": Compensator(geometry, whole),
    }


class Timed:
    """A model's exported core, compiled together with the timing loops of c_core.c."""

    def __init__(self, compensator: Compensator) -> None:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_c(folder, compensator.geometry, compensator.model, ("", ""))
            sources = ["hexapod_comp.c", "hexapod_library.c", str(Path(__file__).with_suffix(".c"))]
            flags = ["-std=c99", "-O2", *STRICT, f"-I{folder}", "-fPIC", "-shared"]
            subprocess.run(["gcc", *flags, *sources, "-lm", "-o", "libhexapod.so"], cwd=folder, check=True)
            self.library = ctypes.CDLL(str(folder / "libhexapod.so"))
        for function in ("commands_many", "estimates_many", "each_command", "clock_cost"):
            getattr(self.library, function).restype = ctypes.c_double
        self.poses = np.array(commands(compensator.geometry))
        self.warm = np.array([compensator.temperatures.values.get(name, 20.0) for name in Temperatures.NAMES])

    def run(self, function: str, rounds: int, *more: Any) -> float:
        """Call a function of c_core.c for a number of rounds over the poses; return its result, a time, s."""
        arrays = [array.ctypes.data_as(ctypes.c_void_p) for array in (self.poses, self.warm)]
        call = getattr(self.library, function)
        result = call(ctypes.c_long(len(self.poses)), ctypes.c_long(rounds), *arrays, *more)
        if result < 0.0:
            raise SystemExit("benchmarks.c_core: a command was refused")
        return result


def genhexkins_inverse(poses: np.ndarray) -> Callable[[], float]:
    """Return a function that measures the time per pose of genhexkins' inverse, s; NaN without genhexkins."""
    geometry = load_geometry("paper")
    try:
        module = Genhexkins(Structure.of(geometry))
    except NotHere as reason:
        print(reason, file=sys.stderr)
        return lambda: np.nan
    rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
    platform = [geometry.platform_poses(p[None], r[None]) for p, r in zip(poses[:, :3], rotations, strict=True)]
    told = emc_poses(*(np.concatenate(part) for part in zip(*platform, strict=True)))
    told = np.ascontiguousarray(np.tile(told, (INNER, 1)))
    lengths, codes = np.empty((len(told), 6)), np.empty(len(told), np.int32)
    return lambda: module.inverse(told, lengths, codes) / len(told)


def times(rounds: int) -> tuple[str, list[str]]:
    """Return a table of the times of a command and of a warm estimate (medians over the rounds), and missed targets."""
    everybody = {name: Timed(one) for name, one in compensators(load_geometry("paper")).items()}
    whole = everybody["all of them"]
    beside, count = genhexkins_inverse(whole.poses), len(whole.poses)
    glance = whole.library.clock_cost(ctypes.c_long(100_000))
    rows = []
    for _ in range(rounds):
        inverse = beside()
        for timed in everybody.values():
            command = timed.run("commands_many", INNER) / (INNER * count)
            estimate = timed.run("estimates_many", 1) / count - glance
            rows.append((command * 1e6, estimate * 1e6, command / inverse))
    medians = np.median(np.reshape(rows, (rounds, len(everybody), 3)), axis=0)
    found = dict(zip(everybody, medians, strict=True))
    cells = ([name, f"{c:.3f}", f"{e:.3f}", f"{r:.2f}"] for name, (c, e, r) in found.items())
    text = table(["block", "command, µs", "warm estimate, µs", "command × genhexkins"], cells)
    command, estimate, ratio = found["all of them"]
    targets = (
        ("command", command, " µs", LARGEST_US),
        ("command", ratio, " × genhexkins", LARGEST_RATIO),  # NaN without LinuxCNC
        ("warm estimate", estimate, " µs", LARGEST_ESTIMATE_US),
    )
    return text, [
        f"whole model, {what}: {figure:.2f}{unit}, target {most:g}"
        for what, figure, unit, most in targets
        if figure > most
    ]


def spread(single: int) -> str:
    """Return the distribution of the times of single commands with all blocks, by wall clock, as text."""
    geometry, bins = load_geometry("paper"), np.zeros(4000, np.int64)  # of 10 ns
    whole = Timed(Compensator(geometry, load_model("paper_machine", geometry)))
    largest = whole.run("each_command", max(1, single // len(whole.poses)), bins.ctypes.data_as(ctypes.c_void_p))
    median, tail = np.searchsorted(np.cumsum(bins) / bins.sum(), (0.5, 0.9999)) * 0.01
    text = f"{bins.sum():,} single commands of the whole model, wall clock: "
    return text + f"median {median:.2f} µs, 99.99 % {tail:.2f} µs, largest {largest * 1e6:.0f} µs"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.c_core", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--only", choices=("bits", "times"), help="run one part only (default: both)")
    parser.add_argument("--commands", type=int, default=20_000, help="commands to compare bitwise (default 20000)")
    parser.add_argument("--single", type=int, default=10_000_000, help="single commands to time (default 10 million)")
    parser.add_argument("--rounds", type=int, default=15, help="number of rounds of the times (default 15)")
    args = parser.parse_args()
    if shutil.which("gcc") is None:
        return cannot_run("no gcc")
    problems = bits(args.commands) if args.only != "times" else []
    if args.only != "bits":
        text, missed = times(args.rounds)
        print(text, spread(args.single), sep="\n\n")
        problems += missed
    return judged(problems)


if __name__ == "__main__":
    sys.exit(main())
