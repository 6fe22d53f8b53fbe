"""Any bytes as commands, as strut readings and as a machine, for the core under libFuzzer with sanitizers.

``test/core/fuzz.c`` is compiled by clang, once for each entry. Beside what the sanitizers see it asserts that an answer
is finite and within the limits, and that a refusal leaves the state as it was. Each entry runs for ten minutes at low
priority (``--seconds``); what it found lies in out/fuzz-core, and is tried first the next time.

Run ``python -m benchmarks.fuzz_core``, or ``make fuzz-core``. Exits 1 where an input breaks something: it lies there.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path

from hexapod_comp import core
from hexapod_comp.core.build import FLAGS
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

ROOT = Path(__file__).resolve().parents[1]
ENTRIES = ("command", "estimate", "model")
SANITIZERS = ["-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]


def build(entry: str, folder: Path) -> Path:
    """Return the fuzzer of an entry."""
    geometry, sources = load_geometry("paper"), Path(core.__file__).parent
    write_c(folder, geometry, load_model("paper_machine", geometry), ("", ""))
    program = folder / f"fuzz-{entry}"
    words = ["clang", *FLAGS, "-O1", *SANITIZERS, f"-D{entry.upper()}", f"-I{folder}", f"-I{sources}"]
    words += [str(ROOT / "test" / "core" / "fuzz.c"), str(sources / "hexapod_comp.c"), "-lm", "-o", str(program)]
    subprocess.run(words, check=True)
    return program


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz_core", description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=int, default=600, help="for each entry")
    parser.add_argument("--entries", nargs="+", choices=ENTRIES, default=ENTRIES)
    args = parser.parse_args()
    if shutil.which("clang") is None:
        print("benchmarks.fuzz_core: no clang here (Debian: apt install clang)", file=sys.stderr)
        return 2
    broken = []
    for entry in args.entries:
        folder = ROOT / "out" / "fuzz-core" / entry
        folder.mkdir(parents=True, exist_ok=True)
        corpus = folder / "inputs"
        corpus.mkdir(exist_ok=True)
        words = ["nice", "-n", "10", str(build(entry, folder)), str(corpus), f"-max_total_time={args.seconds}"]
        words += ["-max_len=4096", "-print_final_stats=1", f"-artifact_prefix={folder}/"]
        done = subprocess.run(words, capture_output=True, text=True, errors="replace")
        (folder / "log").write_text(done.stderr, encoding="utf-8")
        runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
        covered = re.findall(r"cov: (\d+)", done.stderr)
        said = f"{int(runs[1]):,} inputs, {covered[-1]} branches" if runs and covered else "did not end well"
        print(
            f"{entry:10} {said}: {'nothing broke' if done.returncode == 0 else f'BROKE, see {folder}/log'}", flush=True
        )
        broken += [entry] if done.returncode else []
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
