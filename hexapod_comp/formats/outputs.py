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

WRITTEN = ("covariance", "json", "linuxcnc", "out", "pictures", "plot", "report", "table")
"""Arguments that name what is written: files, or folders for them. ``json`` is a switch for most verbs."""

_protected: dict[tuple[int, int], str] = {}
"""What this command reads, by device and inode, and as what it was named; empty outside of a command."""


@contextmanager
def inputs_protected(args: argparse.Namespace) -> Iterator[None]:
    """Refuse, as long as this context is open, to write what the arguments read; what they name is tried at once.

    Raises
    ------
    InputFileError
        An output is one of the inputs.
    """
    try:
        for name in READ:
            given = getattr(args, name, None)
            for value in given if isinstance(given, list) else [given]:
                if isinstance(value, str):
                    _protected.update((identity, value) for identity in _identities(value))
        for name in WRITTEN:
            value = getattr(args, name, None)
            if isinstance(value, str):
                refuse_replacing_input(value)
        yield
    finally:
        _protected.clear()


def refuse_replacing_input(path: str | Path) -> None:
    """Raise InputFileError when a file that is about to be written is one that this command reads."""
    identity = _identity(path)
    if identity is not None and identity in _protected:
        problem = f"is read by this command, as {_protected[identity]}, and would be replaced; write to another file"
        raise InputFileError(path, "", problem)


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
