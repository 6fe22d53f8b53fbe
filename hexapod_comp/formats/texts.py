"""Numbers and tables as text, for reports, and streams that take any text."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Iterable, Sequence


def number(value: float, digits: int) -> str:
    """Return a number with so many digits after its point, never −0."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def plain_number(text: str) -> float:
    """Return the finite number that a text is to everybody, else NaN: Python also reads 1_0 and １０ as ten."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and text.isascii() and "_" not in text else math.nan


def aligned(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with its columns aligned to the right, a last one without header to the left."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    if not header[-1]:
        widths[-1] = 0
    shown = [[cell.rjust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join("  ".join(cells).rstrip() for cells in shown)


def accept_any_terminal() -> None:
    """Write what a terminal's encoding does not have as an escape: no reason to end with a traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
