"""All speed benchmarks in one run: kinematics, batches, convergence, model blocks, and the compensator with a relay.

``python -m benchmarks.speed`` measures (ten minutes) and prints the tables; ``--doc`` also renews those of
doc/speed.md, for which LinuxCNC's kinematics must be installed. Exit code 1: a target is missed.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from hexapod_comp.formats.outputs import write_text

from . import c_core, cannot_run, genhexkins, judged, kinematics, loop

DOC = Path(__file__).resolve().parents[1] / "doc"
PACKAGES = ("numpy", "scipy", "mujoco", "mujoco-core", "pin", "ros-jazzy-rclpy")


def surroundings() -> str:
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
    found = [f"processor {os.cpu_count()} × {model}", f"Python {platform.python_version()}"]
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return f"Measured on: {', '.join(found)}, load before the run {os.getloadavg()[0]:.1f}."


def renewed(page: str, where: str, report: str, problems: list[str]) -> str:
    """Return the text of doc/speed.md, whose tables are in the report's order, with new tables, machine and verdict."""
    tables = iter(re.findall(r"(?:^\|.*\n)+", report + "\n", re.MULTILINE))
    page = re.sub(r"(?:^\|.*\n)+", lambda _: next(tables), page, flags=re.MULTILINE)
    verdict = "\n".join(["Targets missed in this run:", "", *(f"- {text}" for text in problems)])
    page = re.sub(r"^Measured on: .*$", where, page, flags=re.MULTILINE)
    return re.sub(
        r"^(Targets missed.*?|All targets.*?)\n\n(?=## )",
        f"{verdict if problems else 'All targets are kept.'}\n\n",
        page,
        flags=re.MULTILINE | re.DOTALL,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--doc", action="store_true", help="renew the tables of doc/speed.md")
    parser.add_argument("--quick", action="store_true", help="run in a tenth of the time, for a trial")
    options = parser.parse_args()
    where, rounds, bouts = surroundings(), *((3, 1) if options.quick else (25, 10))
    parts = [kinematics.times(500, 20_000, rounds)]
    parts.append(kinematics.batches(*((1_000_000, 0.4) if options.quick else ())))
    try:
        parts.append(kinematics.convergences())
    except genhexkins.NotHere as reason:
        if options.doc:
            return cannot_run(str(reason))
    parts.append(c_core.times(rounds))
    beside, floor = (loop.measure(max(1, n), 6, 0.4, floor) for n, floor in ((bouts, False), (bouts // 3, True)))
    parts += [(loop.report(beside), loop.problems(beside)), (loop.report(floor), [])]
    report, problems = "\n\n".join(text for text, _ in parts), [one for _, missed in parts for one in missed]
    print(where, report, sep="\n\n")
    if options.doc:
        page = DOC / "speed.md"
        write_text(page, renewed(page.read_text(encoding="utf-8"), where, report, problems))
    return judged(problems)


if __name__ == "__main__":
    sys.exit(main())
