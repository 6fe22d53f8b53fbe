"""The compensation in C: its self-test on other targets, and what a command takes in a servo thread.

The self-test of an export runs on targets whose compiler is here (32-bit x86, ARM under QEMU): the answers of this
machine, to the last digit. Then one thread times commands and estimates, and LinuxCNC's genhexkins beside them, on the
same poses in turn.

Run ``python -m benchmarks.c_core``. Exits 1 when a bar is missed.
"""

from __future__ import annotations

import argparse
import ctypes
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import judged
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.temperatures import Temperatures

from .blocks import commands, compensators
from .genhexkins import Genhexkins, NotHere, emc_poses

FLAGS = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]
# Compilers and emulators that Debian packages: gcc-i686-linux-gnu, gcc-arm-linux-gnueabihf, qemu-user
TARGETS = {
    "32-bit x86": (["i686-linux-gnu-gcc", "-msse2", "-mfpmath=sse", "-static"], []),
    "ARM, 32 bits": (["arm-linux-gnueabihf-gcc", "-static"], ["qemu-arm"]),
}

# Bars: of the whole model's command, beside genhexkins' inverse, of a warm estimate
LARGEST_US, LARGEST_RATIO, LARGEST_ESTIMATE_US = 1.5, 8.0, 1.5

ROUNDS = 15
INNER = 20  # Times that the poses are run through between two looks at the clock


@dataclass(frozen=True)
class Cost:
    """What a command and a warm estimate take, µs: medians of rounds; the command beside genhexkins in its round."""

    block: str
    command_us: float
    estimate_us: float
    ratio: float | None


@dataclass(frozen=True)
class Spread:
    """Single commands of the whole model by the clock on the wall, µs."""

    commands: int
    median_us: float
    tail_us: float
    largest_us: float


def build(geometry: HexapodGeometry, model: MachineModel, folder: Path, *extra: str) -> Path:
    """Return an export as a shared library."""
    write_c(folder, geometry, model, ("", ""))
    name = folder / "libhexapod.so"
    sources = ["hexapod_comp.c", "hexapod_library.c", *extra]
    words = [_compiler(), *FLAGS, f"-I{folder}", "-fPIC", "-shared", *sources, "-lm", "-o", str(name)]
    subprocess.run(words, cwd=folder, check=True)
    return name


def _compiler() -> str:
    found = shutil.which("gcc") or shutil.which("cc")
    if found is None:
        raise SystemExit("benchmarks.c_core: no C compiler here (gcc or cc)")
    return found


def self_tests() -> dict[str, str]:
    """Return what the self-test says on each target."""
    geometry = load_geometry("paper")
    model = load_model("paper_machine", geometry)
    said = {}
    for target, (compiler, emulator) in {"this machine": ([_compiler()], []), **TARGETS}.items():
        missing = [word for word in (compiler[0], *emulator) if shutil.which(word) is None]
        if missing:
            said[target] = f"not tried: no {missing[0]}"
            continue
        with tempfile.TemporaryDirectory() as folder:
            write_c(folder, geometry, model, ("", ""))
            words = [*compiler, *FLAGS, "hexapod_comp.c", "hexapod_selftest.c", "-lm", "-o", "selftest"]
            subprocess.run(words, cwd=folder, check=True)
            done = subprocess.run([*emulator, f"{folder}/selftest"], capture_output=True, text=True, check=False)
        said[target] = done.stdout.strip() or f"ended with {done.returncode}"
    return said


# --- what it takes -------------------------------------------------------------------------------------------


class Timed:
    """A model's core, with the loops around it."""

    def __init__(self, compensator: Compensator) -> None:
        folder = tempfile.TemporaryDirectory()
        source = str(Path(__file__).with_suffix(".c"))
        path = build(compensator.geometry, compensator.model, Path(folder.name), source)
        self.library = ctypes.CDLL(str(path))
        folder.cleanup()
        for name in ("commands_many", "estimates_many", "each_command", "clock_cost"):
            getattr(self.library, name).restype = ctypes.c_double
        self.poses = np.array(commands(compensator.geometry))
        self.warm = np.array([compensator.temperatures.values.get(name, 20.0) for name in Temperatures.NAMES])

    def run(self, function: str, rounds: int, *more: Any) -> float:
        """Return what a function of the library says of so many rounds of the poses."""
        arrays = [array.ctypes.data_as(ctypes.c_void_p) for array in (self.poses, self.warm)]
        call = getattr(self.library, function)
        result = call(ctypes.c_long(len(self.poses)), ctypes.c_long(rounds), *arrays, *more)
        if result < 0.0:
            raise SystemExit("benchmarks.c_core: a command was refused")
        return result


def costs(rounds: int) -> list[Cost]:
    """Return what each block costs; every round times all of them and genhexkins."""
    geometry = load_geometry("paper")
    everybody = {name: Timed(compensator) for (name, _), compensator in compensators(geometry).items()}
    poses = next(iter(everybody.values())).poses
    inverse = _genhexkins(geometry, poses)
    glance = next(iter(everybody.values())).library.clock_cost(ctypes.c_long(100_000))
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in everybody}
    for _ in range(rounds):
        beside = inverse() if inverse else np.nan
        for name, timed in everybody.items():
            command = timed.run("commands_many", INNER) / (INNER * len(poses))
            estimate = timed.run("estimates_many", 1) / len(poses) - glance
            rows[name].append((command * 1e6, estimate * 1e6, command / beside))
    medians = {name: np.median(row, axis=0).tolist() for name, row in rows.items()}
    return [Cost(name, c, e, None if np.isnan(r) else r) for name, (c, e, r) in medians.items()]


def _genhexkins(geometry: HexapodGeometry, poses: np.ndarray) -> Any:
    """Return a function that tells what genhexkins' inverse takes for a pose, s; None where there is none."""
    try:
        module = Genhexkins(Compensator(geometry, MachineModel(geometry.name)).machine.structure)
    except NotHere as reason:
        print(reason, file=sys.stderr)
        return None
    rotations = Rotation.from_quat(poses[:, 3:]).as_matrix()
    platform = [geometry.platform_poses(p[None], r[None]) for p, r in zip(poses[:, :3], rotations, strict=True)]
    told = emc_poses(*(np.concatenate(part) for part in zip(*platform, strict=True)))
    told = np.ascontiguousarray(np.tile(told, (INNER, 1)))
    lengths, codes = np.empty((len(told), 6)), np.empty(len(told), np.int32)
    return lambda: module.inverse(told, lengths, codes) / len(told)


def spread(count: int) -> Spread:
    """Return how single commands of the whole model spread."""
    geometry = load_geometry("paper")
    timed = Timed(Compensator(geometry, load_model("paper_machine", geometry)))
    bins = np.zeros(4000, np.int64)
    rounds = max(1, count // len(timed.poses))
    largest = timed.run("each_command", rounds, bins.ctypes.data_as(ctypes.c_void_p))
    share = np.cumsum(bins) / bins.sum()
    median, tail = (float(np.searchsorted(share, q)) * 0.01 for q in (0.5, 0.9999))
    return Spread(int(bins.sum()), median, tail, largest * 1e6)


def report(said: dict[str, str], cost: list[Cost], single: Spread) -> str:
    """Return everything for a person."""
    lines = ["self-test", *(f"  {target}: {text}" for target, text in said.items())]
    lines += ["", f"{'block':16} {'command, µs':>12} {'× genhexkins':>13} {'warm estimate, µs':>18}"]
    for c in cost:
        ratio = "" if c.ratio is None else f"{c.ratio:.2f}"
        lines.append(f"{c.block:16} {c.command_us:12.3f} {ratio:>13} {c.estimate_us:18.3f}")
    lines += ["", f"{single.commands:,} single commands of the whole model by the clock on the wall:"]
    lines += [f"median {single.median_us:.2f} µs, 99.99 % {single.tail_us:.2f} µs, largest {single.largest_us:.0f} µs"]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.c_core", description=__doc__.split("\n")[0])
    parser.add_argument("--single", type=int, default=10_000_000, help="single commands to time")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    args = parser.parse_args()
    said, cost, single = self_tests(), costs(args.rounds), spread(args.single)
    print(report(said, cost, single))
    whole = cost[-1]
    kept = {
        "self-tests": all("as they should be" in text or "not tried" in text for text in said.values()),
        f"whole model within {LARGEST_US} µs": whole.command_us <= LARGEST_US,
        f"within {LARGEST_RATIO:g} × genhexkins": whole.ratio is None or whole.ratio <= LARGEST_RATIO,
        f"warm estimate within {LARGEST_ESTIMATE_US} µs": whole.estimate_us <= LARGEST_ESTIMATE_US,
    }
    return judged([bar for bar, held in kept.items() if not held])


if __name__ == "__main__":
    sys.exit(main())
