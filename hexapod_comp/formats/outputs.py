"""What a command writes never replaces what it reads: neither by name, nor by a link, nor under another name."""

from __future__ import annotations

import argparse
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputFileError

READ = ("bag", "budget", "campaign", "columns", "files", "lengths_file", "machine", "model", "poses", "truth")
"""Arguments of all verbs that name what is read: files, shipped files, or a bag's folder."""

WRITTEN = ("covariance", "out", "report", "table")
"""Arguments that name files to write."""

FOLDERS = ("linuxcnc", "pictures")
"""Arguments that name folders to write into; they are made."""

_protected: dict[tuple[int, int], str] = {}
"""What this command reads, by device and inode, and as what it was named; empty outside of a command."""


@contextmanager
def inputs_protected(args: argparse.Namespace) -> Iterator[None]:
    """Refuse, as long as this context is open, to write what the arguments read; what they name is tried at once.

    Raises
    ------
    InputFileError
        An output is one of the inputs, or its place cannot take it: better now than after a long calculation.
    """
    try:
        for name in READ:
            given = getattr(args, name, None)
            for value in given if isinstance(given, list) else [given]:
                if isinstance(value, str):
                    _protected.update((identity, value) for identity in _identities(value))
        for name in (*WRITTEN, *FOLDERS):
            value = getattr(args, name, None)
            if isinstance(value, str):
                refuse_replacing_input(value)
                (_refuse_no_folder if name in FOLDERS else _refuse_no_file)(value)
        yield
    finally:
        _protected.clear()


def refuse_replacing_input(path: str | Path) -> None:
    """Raise InputFileError when a file that is about to be written is one that this command reads."""
    identity = _identity(path)
    if identity is not None and identity in _protected:
        problem = f"is read by this command, as {_protected[identity]}, and would be replaced; write to another file"
        raise InputFileError(path, "", problem)


def _refuse_no_file(path: str) -> None:
    """Raise where no file of this name can be."""
    if os.path.isdir(path):
        raise InputFileError(path, "", "cannot be written: it is a folder, and a file is wanted")
    if not os.path.isdir(os.path.dirname(path) or "."):
        raise InputFileError(path, "", "cannot be written: its folder does not exist")


def _refuse_no_folder(path: str) -> None:
    """Raise where a file is in the way of a folder, here or above."""
    while path and not os.path.exists(path):
        path = os.path.dirname(path)
    if path and not os.path.isdir(path):
        raise InputFileError(path, "", "cannot be made a folder: it is a file")


def _identities(name: str) -> list[tuple[int, int]]:
    """Return what device and inode an argument stands for, those of all files for a folder."""
    from .paths import config_file

    try:
        path = Path("/dev/stdin") if name == "-" else Path(name) if os.path.isdir(name) else config_file(name)
    except InputFileError:  # not a file's name, as ideal and random, or a missing one: the verb's own affair
        return []
    files = path.iterdir() if path.is_dir() else [path]
    return [identity for file in files if (identity := _identity(file)) is not None]


def _identity(path: str | Path) -> tuple[int, int] | None:
    """Return device and inode of a regular file, links followed; None for anything else."""
    try:
        found = os.stat(os.path.expanduser(path))
    except (OSError, ValueError):
        return None
    return (found.st_dev, found.st_ino) if stat.S_ISREG(found.st_mode) else None
