"""Long fuzzing: the tests of ``test/fuzz`` with more cases, different for every seed; or the C core.

    python -m benchmarks.fuzz [--cases N] [--seed N] [--jobs N] [-k WORD]
    python -m benchmarks.fuzz --core [--seconds 600]

Hypothesis shrinks and prints a failing case. ``-k any_content`` sends N messages of random bytes over DDS to each node.
``--core`` fuzzes ``test/core/fuzz.c`` with libFuzzer and sanitizers; inputs that reach new branches are kept in
out/fuzz-core and tried first in the next run. Exit code 1: a test or an entry failed; 2: clang is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks import cannot_run, table
from hexapod_comp import core
from hexapod_comp.core.build import FLAGS
from hexapod_comp.export.c_code import write_c
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model

ROOT = Path(__file__).resolve().parents[1]
NOT_CASES = (" accepted", " messages")  # ends of the names of counts that are not cases
ENTRIES = ("command", "estimate", "model")
SANITIZERS = ["-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]


def tests(args: argparse.Namespace) -> list[str]:
    """Run the tests, print the numbers of cases, and return the test files that failed."""
    began, counts, failed = time.monotonic(), Counter[str](), []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "HEXAPOD_FUZZ_CASES": str(args.cases), "HEXAPOD_FUZZ_COUNTS": folder}
        environment.setdefault("OPENBLAS_NUM_THREADS", "1")  # fastest for small matrices
        command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-o", "timeout=0"]
        command += [f"--hypothesis-seed={args.seed}", *(["-k", args.k] if args.k else [])]

        def run(file: Path) -> None:
            """Run the tests of a file; print its last line, or all its output if it failed."""
            done = subprocess.run([*command, str(file)], cwd=ROOT, env=environment, capture_output=True, check=False)
            passed = done.returncode in (0, 5)  # 5: -k selected no test
            said = (done.stdout + done.stderr).decode("utf-8", "replace").strip()
            print(f"== {file.name}\n{said.splitlines()[-1] if passed else said}", flush=True)
            if not passed:
                failed.append(file.name)

        with ThreadPoolExecutor(max(1, args.jobs)) as pool:
            list(pool.map(run, sorted((ROOT / "test" / "fuzz").glob("test_fuzz_*.py"))))
        for path in Path(folder).glob("*.json"):
            counts.update(json.loads(path.read_text()))
    cases = {name: count for name, count in sorted(counts.items()) if not name.endswith(NOT_CASES)}
    rows = [[name, f"{count:,}", counts.get(f"{name} accepted", "–")] for name, count in cases.items()]
    print(table(["", "cases", "accepted"], [*rows, ["together", f"{sum(cases.values()):,}", ""]]))
    messages = sum(count for name, count in counts.items() if name.endswith(" messages"))
    print(f"in {time.monotonic() - began:.0f} s; the nodes' cases contain {messages:,} messages, requests and timers")
    return failed


def core_entries(seconds: int) -> list[str]:
    """Fuzz each entry of the core at low priority; return the entries that failed."""
    geometry, sources, broken = load_geometry("paper"), Path(core.__file__).parent, []
    for entry in ENTRIES:
        folder = ROOT / "out" / "fuzz-core" / entry
        (folder / "inputs").mkdir(parents=True, exist_ok=True)
        write_c(folder, geometry, load_model("paper_machine", geometry), ("", ""))
        program = str(folder / f"fuzz-{entry}")
        words = ["clang", *FLAGS, "-O1", *SANITIZERS, f"-D{entry.upper()}", f"-I{folder}", f"-I{sources}"]
        words += [str(ROOT / "test" / "core" / "fuzz.c"), str(sources / "hexapod_comp.c"), "-lm", "-o", program]
        subprocess.run(words, check=True)
        words = ["nice", "-n", "10", program, str(folder / "inputs"), f"-max_total_time={seconds}"]
        words += ["-max_len=4096", "-print_final_stats=1", f"-artifact_prefix={folder}/"]
        done = subprocess.run(words, capture_output=True, text=True, errors="replace")
        (folder / "log").write_text(done.stderr, encoding="utf-8")
        runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
        covered = re.findall(r"cov: (\d+)", done.stderr)
        said = f"{int(runs[1]):,} inputs, {covered[-1]} branches" if runs and covered else "no summary was printed"
        print(f"{entry:10} {said}: {f'FAILED, see {folder}/log' if done.returncode else 'no failure'}", flush=True)
        broken += [entry] if done.returncode else []
    return broken


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000, metavar="N", help="about 100000 cases by default")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all random numbers (default 0)")
    cores = os.cpu_count() or 1
    parser.add_argument("--jobs", type=int, default=cores, metavar="N", help="processes (default: one per core)")
    parser.add_argument("-k", default="", metavar="WORD", help="run only tests with this word in their name")
    parser.add_argument("--core", action="store_true", help="fuzz the core with libFuzzer instead of the tests")
    parser.add_argument("--seconds", type=int, default=600, help="time for each entry of the core, s (default 600)")
    args = parser.parse_args()
    if args.core and shutil.which("clang") is None:
        return cannot_run("clang is missing (Debian: apt install clang)")
    failed = core_entries(args.seconds) if args.core else tests(args)
    print(f"FAILED: {', '.join(failed)}" if failed else "all passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
