"""Numbers and tables as text, for reports, and streams that accept any text."""

from __future__ import annotations

import codecs
import io
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, TextIO

from ..errors import InputFileError

# Characters that a terminal executes instead of showing: all control characters but tab and line break, changes of
# direction
CODES = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")

# Exit codes when output cannot be written, and when its reader has closed it: 128 + signal, as in shells
UNWRITABLE, BROKEN_PIPE = 2, 141


def number(value: float, digits: int) -> str:
    """Return a number with these digits after its point, never −0."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def plain_number(text: str) -> float:
    """Return the finite number of a text in plain notation, else NaN: Python also reads 1_0 and １０ as ten."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and text.isascii() and "_" not in text else math.nan


DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")  # a number in the notation of many countries


# A number whose comma may be a decimal one, or a thousands separator
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")


def number_hint(text: str) -> str:
    """Return why a text is not a number, to append to a message, where that is obvious."""
    text = text.strip()
    if THOUSANDS.fullmatch(text):
        meant = f"{text.replace(',', '.')} or {text.replace(',', '')}"
        return f"; its comma may be a decimal one or stand between thousands: write {meant}"
    if DECIMAL_COMMA.fullmatch(text):
        return f", with a decimal point: {text.replace(',', '.')}"
    return ", without semicolons" if ";" in text else ""


def _micro(error: UnicodeError) -> tuple[str, int]:
    """Read the byte B5, which is not valid UTF-8 alone, as µ, as spreadsheets under Windows write it."""
    if isinstance(error, UnicodeDecodeError) and error.object[error.start] == 0xB5:
        return "µ", error.start + 1
    raise error


# Handler of decoding errors: UTF-8 in which a micro sign may be that of Windows-1252
MICRO_ERRORS = "hexapod_comp_micro"

codecs.register_error(MICRO_ERRORS, _micro)


def aligned(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with its columns aligned to the right, a last one without header to the left."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    if not header[-1]:
        widths[-1] = 0
    shown = [[cell.rjust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join("  ".join(cells).rstrip() for cells in shown)


class PlainStream:
    """A text stream that shows codes for the terminal instead of executing them, in any encoding."""

    # Printed text may quote files and arguments: names of machines, of runs, labels. When it cannot be written, it
    # is discarded from then on, so that no further error appears at the program's end.

    def __init__(self, stream: TextIO | None, needed: bool) -> None:
        self.terminal = stream or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - as long as the process
        self._needed = needed
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.terminal, name)

    def write(self, text: str) -> int:
        try:
            return self.terminal.write(CODES.sub(lambda code: repr(code[0])[1:-1], text))
        except OSError as error:
            return self._fail(error)

    def flush(self) -> None:
        """Write what is still to be written; errors are those of :meth:`write`."""
        try:
            self.terminal.flush()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> int:
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.terminal.fileno())
        if not self._needed:
            return 0
        if isinstance(error, BrokenPipeError):
            raise error
        raise InputFileError("standard output", "", f"cannot be written: {error.strerror}") from error


def own_terminal() -> TextIO:
    """Return stderr for our own codes, as those of a progress bar."""
    return getattr(sys.stderr, "terminal", sys.stderr)


def run_with_plain_streams(run: Callable[[], int | None]) -> int | None:
    """Run a program that prints to a :class:`PlainStream`; return its exit code, or the code of failed output."""
    with redirect_stdout(PlainStream(sys.stdout, True)), redirect_stderr(PlainStream(sys.stderr, False)):  # type: ignore[type-var]
        try:
            code = run()
            sys.stdout.flush()
        except BrokenPipeError:
            return BROKEN_PIPE
        except InputFileError as error:
            print(f"error: {error}", file=sys.stderr)
            return UNWRITABLE
        return code
