"""How long the nodes take until they are ready.

Usage: python -m benchmarks.start [--starts 5]; exits 1 when the median is above the bar.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from hexapod_comp.loop.processes import NodeProcess, PrivateDomain

BAR = 1.0
"""Longest start allowed, s."""

GIVE_UP = 60.0


def seconds_until_ready(name: str) -> float:
    """Start a node, wait until it says that it is ready, end it; return how long that took, s."""
    began = time.monotonic()
    node = NodeProcess(name, {"model_file": "paper_machine.yaml"} if name == "compensator" else {})
    try:
        while "ready" not in node.output():
            if node.exit_code() is not None or time.monotonic() > began + GIVE_UP:
                raise SystemExit(f"{name} did not become ready:\n{node.output()}")
            time.sleep(0.01)
        return time.monotonic() - began
    finally:
        node.stop()


def main() -> int:
    """Print a line per node."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=5)
    starts = parser.parse_args().starts
    kept = True
    with PrivateDomain():
        for name in ("compensator", "strut_drive"):
            first = seconds_until_ready(name)
            times = [seconds_until_ready(name) for _ in range(starts)]
            kept = kept and float(np.median(times)) <= BAR
            print(f"{name}: first {first:.2f} s, then median {np.median(times):.2f} s, longest {max(times):.2f} s")
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
