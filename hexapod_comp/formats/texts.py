"""Numbers and tables as text for reports, and an output stream that is safe for a terminal."""

from __future__ import annotations

import codecs
import difflib
import io
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, TextIO

from ..errors import InputFileError

# Characters that control a terminal: control characters except tab and line feed, and changes of writing direction
CODES = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")

# Exit codes: output could not be written; the reader has closed the pipe (128 + the number of SIGPIPE, as in shells)
UNWRITABLE, BROKEN_PIPE = 2, 141


def number(value: float, digits: int) -> str:
    """Return a number with `digits` digits after the decimal point; −0 becomes 0."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def significant(value: float, digits: int) -> str:
    """Return a number rounded to `digits` significant digits, without an exponent up to a million: 100, not 1e+02."""
    return f"{float(f'{value:.{digits}g}'):g}"


def with_error(value: float, error: float) -> str:
    """Return a value and its standard error as text; both are rounded to the error's second significant digit."""
    digits = 1 - math.floor(math.log10(error)) if error > 0.0 else 3
    shown, decimals = round(value, digits) + 0.0, max(digits, 0)
    return f"{shown:+.{decimals}f} ± {round(error, digits):.{decimals}f}"


def relative_change(before: float, after: float, digits: int = 1) -> str:
    """Return the change from `before` to `after`, in percent of `before`: "94.9 % less" or "16.4 % more"."""
    more = 100.0 * (after / before - 1.0)
    return f"{abs(more):.{digits}f} % {'more' if more > 0.0 else 'less'}"


def did_you_mean(name: str, known: Iterable[str] | Mapping[str, str]) -> str:
    """Return the end of a message about an unknown name: a question with the most similar known name, or nothing.

    If `known` is a mapping, `name` is compared with its keys, and the question shows the value of the key.
    """
    shown = known if isinstance(known, Mapping) else {one: one for one in known}
    near = difflib.get_close_matches(name, sorted(shown), 1)
    return f"; did you mean {shown[near[0]]}?" if near else ""


def plain_number(text: str) -> float:
    """Return the finite number in a text; NaN for every other text, also for 1_0 and １０, which float() accepts."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and text.isascii() and "_" not in text else math.nan


POWER_OF_TEN = re.compile(r"([-+]?\d+)(\.\d*)?[eE]([-+]?)(\d+)")  # without point or sign YAML 1.1 reads a text
WITH_UNIT = re.compile(r"[-+.,\d]*\d ?[a-zµμ°'\"/%]+\d?", re.IGNORECASE)
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")  # a number with a decimal comma
# A number whose comma may be a decimal comma or a thousands separator
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(,\d{3})+")


def number_hint(text: str) -> str:
    """Return how to write the number that `text` probably means, as the end of a message; or an empty text."""
    text = text.strip()
    if THOUSANDS.fullmatch(text):
        meant = f"{text.replace(',', '.')} or {text.replace(',', '')}"
        return f"; its comma may be a decimal comma or a thousands separator: write {meant}"
    if DECIMAL_COMMA.fullmatch(text):
        return f", with a decimal point: {text.replace(',', '.')}"
    if parts := POWER_OF_TEN.fullmatch(text):
        whole, decimals, sign, exponent = parts.groups()
        return f", in YAML with a point and a signed exponent: {whole}{decimals or '.0'}e{sign or '+'}{exponent}"
    if WITH_UNIT.fullmatch(text):
        return ", without the unit"
    return ", without semicolons" if ";" in text else ""


def _micro(error: UnicodeError) -> tuple[str, int]:
    """Decode a byte B5 that is invalid UTF-8 as µ, because spreadsheets under Windows write this byte for µ."""
    if isinstance(error, UnicodeDecodeError) and error.object[error.start] == 0xB5:
        return "µ", error.start + 1
    raise error


# Name of the error handler that decodes µ from Windows-1252 in a text that is otherwise UTF-8
MICRO_ERRORS = "hexapod_comp_micro"

codecs.register_error(MICRO_ERRORS, _micro)


def aligned(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table as text with columns aligned to the right; a last column without header is aligned to the left."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    if not header[-1]:
        widths[-1] = 0
    shown = [[cell.rjust(width) for cell, width in zip(line, widths, strict=True)] for line in lines]
    return "\n".join("  ".join(cells).rstrip() for cells in shown)


class PlainStream:
    """A text stream that writes control characters as visible escapes, so that a terminal does not execute them."""

    # Printed text may quote files and arguments, for example names of machines and runs. After a failed write the
    # stream discards all further text, so that no second error appears at the end of the program.

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
    """Return stderr without its :class:`PlainStream`, so that a progress bar can write control characters."""
    return getattr(sys.stderr, "terminal", sys.stderr)


def run_with_plain_streams(run: Callable[[], int | None]) -> int | None:
    """Run a program with :class:`PlainStream` for stdout and stderr; return its exit code, also if output fails."""
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
