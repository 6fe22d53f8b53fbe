"""Where the shipped configuration files are, in a source tree as in an installation."""

from __future__ import annotations

import difflib
import os
import re
import stat
from collections.abc import Callable
from functools import cache
from pathlib import Path

from ..errors import InputFileError

PACKAGE = "hexapod_comp"


def config_file(name: str | os.PathLike[str]) -> Path:
    """Find a configuration file: the user's own where `name` is a path to one, else a shipped one.

    Parameters
    ----------
    name : str or path
        Path of a file (``~`` is understood), or the name of a shipped file relative to its folder,
        with or without ``.yaml``: ``paper``, ``paper.yaml``.

    Returns
    -------
    Path
        An existing file.

    Raises
    ------
    InputFileError
        There is no such file; the message lists the shipped names.
    """
    own = os.path.expanduser(name)
    if os.path.isfile(own):
        return Path(own)
    shipped = shipped_names()
    for candidate in (os.fspath(name), f"{os.fspath(name)}.yaml"):
        if candidate in shipped:
            return config_folder() / candidate
    raise InputFileError(os.fspath(name) or "''", "", _no_such_file(os.fspath(name), shipped))


def input_file(name: str | os.PathLike[str]) -> Path:
    """Find what is to be read: anything but a folder at a path, pipes too; else a shipped file.

    Parameters
    ----------
    name : str or path
        As for :func:`config_file`, or ``-`` for standard input.

    Raises
    ------
    InputFileError
        As :func:`config_file`.
    """
    own = os.path.expanduser(name)
    if own == "-":
        return Path("/dev/stdin")
    return Path(own) if os.path.exists(own) and not os.path.isdir(own) else config_file(name)


def confined_file(name: str | os.PathLike[str], folder: Path | None) -> Path:
    """Find a configuration file as :func:`config_file` does, but only in one folder or among the shipped ones.

    Parameters
    ----------
    name : str or path
        Path of a file, also relative to `folder`, or the name of a shipped one.
    folder : Path or None
        Folder, with all below it, from which files may be read; None: only shipped ones.

    Returns
    -------
    Path
        An existing regular file, without links: what is replaced later cannot lead elsewhere.

    Raises
    ------
    InputFileError
        There is no such file, it is not a regular one, or it lies elsewhere, be it by ``..`` or a link.
    """
    own = os.path.expanduser(os.fspath(name))
    if own and folder is not None and os.path.exists(folder / own):
        own = os.path.join(folder, own)
    if os.path.exists(own) and not os.path.isfile(own):
        raise InputFileError(own, "", "is not a regular file")
    path = config_file(own).resolve()
    _refuse_elsewhere(name, path, folder)
    return path


def confined_opener(folder: Path | None) -> Callable[[str, int], int]:
    """Return what opens a file for Python's ``open`` only where :func:`confined_file` finds it.

    Between the look at a name and its opening the file may be replaced, by a pipe or by a link that leads elsewhere. So
    nothing is waited for, and what counts is the open file.

    Parameters
    ----------
    folder : Path or None
        As for :func:`confined_file`.

    Returns
    -------
    callable
        Takes path and flags, returns the descriptor; raises InputFileError.
    """

    def opened(path: str, flags: int) -> int:
        descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_NOCTTY)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise InputFileError(path, "", "is not a regular file")
            _refuse_elsewhere(path, Path(os.readlink(f"/proc/self/fd/{descriptor}")), folder)
        except BaseException:
            os.close(descriptor)
            raise
        return descriptor

    return opened


def _refuse_elsewhere(name: str | os.PathLike[str], path: Path, folder: Path | None) -> None:
    """Raise when a file, by its path without links, is neither in a folder nor shipped."""
    folders = [place.resolve() for place in (folder, config_folder()) if place is not None]
    if not any(path.is_relative_to(place) for place in folders):
        places = " and ".join(str(place) for place in folders)
        problem = f"leads to {path}, but files are only read from {places}; see model_folder"
        raise InputFileError(os.fspath(name), "", problem)


def folder_of(name: str | os.PathLike[str]) -> Path | None:
    """Return the folder of a file given by its path, without links; None for the name of a shipped one."""
    own = os.path.expanduser(name)
    if os.path.dirname(own) or os.path.isfile(own):
        return Path(os.path.dirname(own) or ".").resolve()
    return None


def shipped_names() -> list[str]:
    """Return the names of all shipped configuration files, relative to their folder, sorted."""
    folder = config_folder()
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return sorted(path.as_posix() for path in files if not path.name.startswith("."))


@cache
def config_folder() -> Path:
    """Return the folder of the shipped configuration files.

    It is sought from this file upwards, so it always belongs to the code that runs: ``config`` beside
    the package in a source tree (also with an editable or symlinked installation), else
    ``share/hexapod_comp/config`` in the prefix into which pip or colcon installed both.

    Raises
    ------
    InputFileError
        The installation has lost its files.
    """
    package = Path(__file__).resolve().parents[1]
    if (package.parent / "package.xml").is_file():
        return package.parent / "config"
    for prefix in package.parents:
        folder = prefix / "share" / PACKAGE / "config"
        if folder.is_dir():
            return folder
    raise InputFileError(package, "", f"no share/{PACKAGE}/config in any folder above it; install it anew")


def version() -> str:
    """Return the version of the code that runs: package.xml is installed beside the configuration."""
    path = config_folder().parent / "package.xml"
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputFileError(path, "", f"cannot be read: {error.strerror}; install it anew") from error
    match = re.search(r"<version>\s*(.*?)\s*</version>", text)
    return match.group(1) if match else "unknown"


def _no_such_file(name: str, shipped: list[str]) -> str:
    """Say that `name` is neither a file nor shipped, and what is."""
    near = difflib.get_close_matches(name, shipped, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    what = "is a folder" if os.path.isdir(os.path.expanduser(name)) else "there is no such file"
    return f"{what}, and the shipped ones are {', '.join(shipped)}{hint}"
