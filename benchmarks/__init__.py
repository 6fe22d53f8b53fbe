"""What the package is compared with, and what it costs: one module for each, run by ``python -m benchmarks.NAME``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

CANNOT_RUN = 2  # exit code of a benchmark that lacks what it measures with; 1 says that a bar was missed


def cannot_run(reason: str) -> int:
    """Say on stderr what a benchmark lacks; return its exit code."""
    print(f"cannot run: {reason}", file=sys.stderr)
    return CANNOT_RUN


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], texts: int = 1) -> str:
    """Return a table in Markdown; its first columns are texts, all others numbers."""
    marks = ["---"] * texts + ["---:"] * (len(columns) - texts)
    lines = [" | ".join(map(str, row)) for row in (columns, *rows)]
    return "\n".join([f"| {lines[0]} |", f"|{'|'.join(marks)}|", *(f"| {line} |" for line in lines[1:])])


def judged(problems: Sequence[str]) -> int:
    """Print which bars were missed on stderr; return the exit code."""
    print(*(problems or ["bars kept"]), sep="\n", file=sys.stderr)
    return 1 if problems else 0
