"""Reading of files: every reader of the package opens its files here, with a check of the file's type and size.

A FIFO without a writer would block for ever, a device or a growing file has no end, and a parser may need a hundred
times the size of a file in memory. Each limit is above the size of the largest expected file, which is stated beside
the limit.
"""

from __future__ import annotations

import io
import os
import re
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputFileError, printable
from .texts import MICRO_ERRORS

# A function for the argument `opener` of Python's `open`: it takes path and flags and returns a file descriptor
Opener = Callable[[str, int], int]

MEGABYTE = 1_000_000

MAX_FILE_BYTES = 8 * MEGABYTE  # limit for YAML files, HAL files and pages of a journal; a large model has 100 kB
MAX_CSV_BYTES = 500 * MEGABYTE  # limit for CSV files; one hour's path at 500 Hz has about 270 MB
MAX_ARCHIVE_BYTES = 200 * MEGABYTE  # limit for a fit's posterior: the covariance of about 5000 parameters

# Names of streams that the shell has opened for this process (`-`, `<(command)`); only these names may be pipes
OPEN_STREAMS = re.compile(r"/dev/(stdin|fd/\d+)|/proc/(self|\d+)/fd/\d+")

KINDS = {stat.S_IFIFO: "FIFO", stat.S_IFCHR: "device", stat.S_IFBLK: "device", stat.S_IFSOCK: "socket"}


def open_input(path: str | Path, most: int, opener: Opener | None = None) -> io.FileIO:
    """Open for reading a regular file of at most `most` bytes, or a stream that the shell has opened (`-`)."""
    try:
        file = open(path, "rb", buffering=0, opener=opener or _open_at_once)  # noqa: SIM115 - the caller closes it
        try:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                _refuse_unless_opened_already(path, status.st_mode)
                os.set_blocking(file.fileno(), True)
            elif status.st_size > most:
                raise too_large(path, most)
        except BaseException:
            file.close()
            raise
        return file
    except (OSError, ValueError) as error:  # ValueError: the name contains a zero byte
        raise InputFileError(path, "", f"cannot be read: {getattr(error, 'strerror', None) or error}") from error


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY)


def _refuse_unless_opened_already(path: str | Path, mode: int) -> None:
    if not OPEN_STREAMS.fullmatch(os.fspath(path)):
        kind = KINDS.get(stat.S_IFMT(mode), "special file")
        raise InputFileError(path, "", f"is a {kind}, not a regular file; to read from a pipe, give - as file name")


def too_large(path: str | Path, most: int) -> InputFileError:
    return InputFileError(path, "", f"is larger than the allowed {most / MEGABYTE:g} MB")


def read_bytes(path: str | Path, most: int = MAX_FILE_BYTES, opener: Opener | None = None) -> bytes:
    """Return the bytes of a file; raise an InputFileError for a file that is unreadable or larger than `most` bytes."""
    with io.BufferedReader(open_input(path, most, opener)) as file, parsing(path, "cannot be read", OSError):
        content = file.read(most + 1)
    if len(content) > most:
        raise too_large(path, most)
    return content


def read_text(path: str | Path, opener: Opener | None = None, most: int = MAX_FILE_BYTES) -> str:
    """Return the text of a UTF-8 file of at most `most` bytes, with line feeds as line ends."""
    content = read_bytes(path, most, opener)
    try:
        text = content.decode("utf-8-sig", MICRO_ERRORS).replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise InputFileError(path, "", f"is not UTF-8 text (byte {error.start})") from error
    if not text.strip():
        raise InputFileError(path, "", "is empty")
    return text


@contextmanager
def parsing(
    path: str | Path, problem: str, kinds: type[Exception] | tuple[type[Exception], ...] = Exception
) -> Iterator[None]:
    """Convert an exception that a parser raises in this context into an InputFileError that begins with `problem`."""
    # On damaged files libraries raise struct.error, KeyError, AssertionError, zlib.error, RecursionError and others, so
    # the default is every exception. Around code of this package, this context would hide programming errors.
    try:
        yield
    except InputFileError:
        raise
    except kinds as error:
        text = getattr(error, "strerror", None) or " ".join(map(str, error.args)) or type(error).__name__
        raise InputFileError(path, "", f"{problem}: {printable(text)}") from error
