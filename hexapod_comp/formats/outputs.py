"""Writing of files: a file is written completely or not at all; an output never replaces an input of its command."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from ..errors import InputFileError

# Files that the running command reads: device and inode → name; empty if no command runs
_protected: dict[tuple[int, int], str] = {}


@contextmanager
def protected(read: Mapping[str, Any], written: Mapping[str, Any], folders: Mapping[str, Any]) -> Iterator[None]:
    """Check all outputs, then run the block; until its end, refuse to replace an input file of the running command.

    `read` maps each option to the name of an input file, or to a list of such names; `written` maps options to output
    files, and `folders` to output folders. Options without text (None) are ignored.
    """
    # An output that is an input, that two options name, or that cannot be written is refused before the calculation,
    # which may take hours
    try:
        for given in read.values():
            for value in given if isinstance(given, list) else [given]:
                if isinstance(value, str):
                    _protected.update((identity, value) for identity in _identities(value))
        for value in (*written.values(), *folders.values()):
            if isinstance(value, str):
                refuse_replacing_input(value)
        _refuse_unwritable({name: path for name, path in written.items() if isinstance(path, str)})
        for path in folders.values():
            while path and not os.path.exists(path):
                path = os.path.dirname(path)
            if path and not os.path.isdir(path):
                raise InputFileError(path, "", "cannot be created as a folder: it is a file")
        yield
    finally:
        _protected.clear()


def _refuse_unwritable(files: Mapping[str, str]) -> None:
    """Raise an InputFileError if a file cannot be written, or if two options name the same regular file."""
    option_of: dict[str, str] = {}
    for name, path in files.items():
        if os.path.isdir(path):
            raise InputFileError(path, "", "cannot be written: it is a folder, not a file")
        if not os.path.isdir(os.path.dirname(path) or "."):
            raise InputFileError(path, "", "cannot be written: its folder does not exist")
        if os.path.exists(path) and not os.path.isfile(path):
            continue
        other = option_of.setdefault(os.path.realpath(path), name)
        if other != name:
            raise InputFileError(path, "", f"is given for both {other} and {name}; give two files")


def refuse_replacing_input(path: str | Path) -> None:
    """Raise an InputFileError if the file `path` is an input of the running command."""
    identity = _identity(path)
    if identity is not None and identity in _protected:
        problem = f"is an input of this command ({_protected[identity]}) and would be replaced; write to another file"
        raise InputFileError(path, "", problem)


@contextmanager
def new_file(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a stream that writes a file completely or not at all, even if the process crashes; text is UTF-8.

    An existing file is replaced; the new file gets the old file's permissions and, if the user may change it, the old
    file's owner. A pipe or a device is written directly.
    """
    refuse_replacing_input(path)
    encoding = None if "b" in mode else "utf-8"
    try:
        if os.path.exists(path) and not os.path.isfile(path):
            with open(path, mode, encoding=encoding) as stream:
                yield stream
        else:
            with _replacement(os.path.realpath(path), mode, encoding) as stream:
                yield stream
    except BrokenPipeError:  # the reader has closed the pipe; this error has its own exit code
        raise
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error


@contextmanager
def _replacement(target: str, mode: str, encoding: str | None) -> Iterator[IO[Any]]:
    """Open a stream to a temporary file; replace `target` when the temporary file is completely on the disk."""
    before = os.stat(target) if os.path.exists(target) else None
    if before is not None and not os.access(target, os.W_OK):  # os.replace ignores the write protection of a file
        raise PermissionError(errno.EACCES, "it is write-protected")
    folder, name = os.path.split(target)
    temporary = os.path.join(folder, f".{name[:50]}.{secrets.token_hex(6)}")
    try:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        with open(handle, mode, encoding=encoding) as stream:
            yield stream
            stream.flush()
            if before is not None:
                with suppress(PermissionError):
                    os.fchown(handle, before.st_uid, before.st_gid)
                os.fchmod(handle, stat.S_IMODE(before.st_mode))
            os.fsync(handle)
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)
        raise


def write_text(path: str | Path, text: str) -> None:
    with new_file(path) as stream:
        stream.write(text)


def make_folder(path: str | Path) -> None:
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputFileError(path, "", f"cannot be created as a folder: {error.strerror}") from error


def _identities(name: str) -> list[tuple[int, int]]:
    """Return device and inode of the file `name`, or of each file in the folder `name`."""
    from .paths import config_file

    try:
        path = Path("/dev/stdin") if name == "-" else Path(name) if os.path.isdir(name) else config_file(name)
    except InputFileError:  # a word such as ideal or random, or a missing file; the verb reports a missing file
        return []
    files = path.iterdir() if path.is_dir() else [path]
    return [identity for file in files if (identity := _identity(file)) is not None]


def _identity(path: str | Path) -> tuple[int, int] | None:
    """Return device and inode of a regular file, also through links; None if `path` leads to no regular file."""
    try:
        status = os.stat(os.path.expanduser(path))
    except (OSError, ValueError):
        return None
    return (status.st_dev, status.st_ino) if stat.S_ISREG(status.st_mode) else None
