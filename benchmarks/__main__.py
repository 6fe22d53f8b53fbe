"""Run all benchmarks, one after the other: ``make bench`` or ``python -m benchmarks``."""

import subprocess
import sys

BENCHMARKS = ("speed", "thermal")
"""Those of some minutes; ``benchmarks.calibration`` (an hour) and ``benchmarks.jugglebot`` are run by their names."""

if __name__ == "__main__":
    worst = 0
    for name in BENCHMARKS:
        print(f"== benchmarks.{name}", flush=True)
        worst = max(worst, subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=False).returncode)
    sys.exit(worst)
