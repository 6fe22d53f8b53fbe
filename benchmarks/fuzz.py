"""Fuzzing at nightly size: the tests of ``test/fuzz/test_fuzz_*.py`` with more cases, others for every seed.

    python -m benchmarks.fuzz [--cases N] [--seed N] [--jobs N] [-k WORD]

``-k any_content`` sends N messages of any bytes to each node, as processes, over DDS. Exit code 1: some case failed;
hypothesis has then shrunk it and printed it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Endings of counts that are not cases: how many were accepted, and what a case of a node consists of
NOT_CASES = (" accepted", " messages")


def main() -> int:
    """Run the tests and print a table of what was run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000, metavar="N", help="about how many (default 100000)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of all that is random (default 0)")
    cores = os.cpu_count() or 1
    parser.add_argument("--jobs", type=int, default=cores, metavar="N", help="processes (default: as many as cores)")
    parser.add_argument("-k", default="", metavar="WORD", help="only tests with this word in their name")
    args = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        files = sorted((ROOT / "test" / "fuzz").glob("test_fuzz_*.py"))
        with ThreadPoolExecutor(max(1, args.jobs)) as pool:
            codes = list(pool.map(lambda file: run(file, args, folder), files))
        counts: Counter[str] = Counter()
        for path in Path(folder).glob("*.json"):
            counts.update(json.loads(path.read_text()))
    print(report(counts, time.monotonic() - began))
    failed = [file.name for file, code in zip(files, codes, strict=True) if code not in (0, 5)]  # 5: -k left none
    print(f"FAILED: {', '.join(failed)}" if failed else "all passed")
    return 1 if failed else 0


def run(file: Path, args: argparse.Namespace, folder: str) -> int:
    """Run one file's tests in a process of its own; print what it says when it is done."""
    environment = {**os.environ, "HEXAPOD_FUZZ_CASES": str(args.cases), "HEXAPOD_FUZZ_COUNTS": folder}
    environment.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: more threads only wait for each other
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-o", "timeout=0"]
    command += [f"--hypothesis-seed={args.seed}", *(["-k", args.k] if args.k else []), str(file)]
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=False, **both)
    said = done.stdout.decode("utf-8", "replace").strip() or "nothing was said"
    print(f"== {file.name}\n{said if done.returncode not in (0, 5) else said.splitlines()[-1]}", flush=True)
    return done.returncode


def report(counts: Counter[str], seconds: float) -> str:
    """Return the table of cases, and of what was accepted of them."""
    cases = {name: count for name, count in counts.items() if not name.endswith(NOT_CASES)}
    lines = [f"{'':22}{'cases':>9}{'accepted':>10}"]
    for name, count in sorted(cases.items()):
        accepted = counts.get(f"{name} accepted")
        lines.append(f"{name:22}{count:9,}{'–' if accepted is None else f'{accepted:,}':>10}")
    messages = sum(count for name, count in counts.items() if name.endswith(" messages"))
    lines.append(f"{'together':22}{sum(cases.values()):9,}  in {seconds:.0f} s")
    lines.append(f"the nodes' cases are sequences: {messages:,} messages, requests and timers")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
