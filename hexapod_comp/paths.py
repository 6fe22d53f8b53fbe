"""Where the shipped configuration files are, in a source tree as in an installation."""

from __future__ import annotations

import difflib
import os
from functools import cache
from pathlib import Path

from .errors import InputFileError

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
    raise InputFileError(os.fspath(name) or "''", "", _not_found(os.fspath(name), shipped))


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
    package = Path(__file__).resolve().parent
    if (package.parent / "package.xml").is_file():
        return package.parent / "config"
    for prefix in package.parents:
        folder = prefix / "share" / PACKAGE / "config"
        if folder.is_dir():
            return folder
    raise InputFileError(package, "", f"no share/{PACKAGE}/config in any folder above it; install it anew")


def _not_found(name: str, shipped: list[str]) -> str:
    """Say that `name` is neither a file nor shipped, and what is."""
    near = difflib.get_close_matches(name, shipped, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    return f"there is no such file, and the shipped ones are {', '.join(shipped)}{hint}"
