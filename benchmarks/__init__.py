"""What the package is compared with, and what it costs: one module for each, run by ``python -m benchmarks.NAME``."""

from __future__ import annotations

import sys

CANNOT_RUN = 2  # Exit code of a benchmark that lacks what it measures with; 1 says that a bar was missed


def cannot_run(reason: str) -> int:
    """Say on stderr what a benchmark lacks; return its exit code."""
    print(f"cannot run: {reason}", file=sys.stderr)
    return CANNOT_RUN
