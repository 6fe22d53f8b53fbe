"""Benchmarks of accuracy, speed and robustness; run a module with ``python -m benchmarks.NAME``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

CANNOT_RUN = 2  # exit code if a program or library is missing; exit code 1: a target was missed


def cannot_run(reason: str) -> int:
    """Print on stderr why a benchmark cannot run; return the exit code."""
    print(f"cannot run: {reason}", file=sys.stderr)
    return CANNOT_RUN


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], texts: int = 1) -> str:
    """Return a Markdown table with `texts` columns that are aligned to the left; numbers are aligned to the right."""
    marks = ["---"] * texts + ["---:"] * (len(columns) - texts)
    lines = [" | ".join(map(str, row)) for row in (columns, *rows)]
    return "\n".join([f"| {lines[0]} |", f"|{'|'.join(marks)}|", *(f"| {line} |" for line in lines[1:])])


def judged(problems: Sequence[str]) -> int:
    print(*(problems or ["targets kept"]), sep="\n", file=sys.stderr)
    return 1 if problems else 0
