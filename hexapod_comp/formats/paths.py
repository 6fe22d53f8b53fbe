"""Search for configuration files: the user's files, and the shipped files in a source tree or an installation."""

from __future__ import annotations

import itertools
import os
import re
import stat
from collections.abc import Callable
from functools import cache
from pathlib import Path

from ..errors import InputFileError
from .texts import did_you_mean

PACKAGE = "hexapod_comp"

FORMAT = re.compile(r"^format: hexapod_comp/(\w+)", re.MULTILINE)  # the `format` line of a YAML file

# Suffixes of each kind of CSV file; all other kinds of file (geometry, model, …) are YAML files with a `format` line
SUFFIXES = {"poses": (".csv",), "lengths": (".csv",), "readings": (".csv",)}

# For each kind of CSV file: the pattern that its header contains
COLUMNS = {"poses": re.compile(r'(?:^|[",;\t])\s*x_'), "lengths": re.compile(r'(?:^|[",;\t])\s*L1_')}

MOST_LISTED = 12  # largest number of existing files in the message about a missing file
MOST_OPENED = 500  # largest number of files that a search for files of one kind opens in a folder


def config_file(name: str | os.PathLike[str], kind: str = "", beside: bool = False) -> Path:
    """Return the path of a configuration file: `name` if it is the path of a file, else the shipped file `name`.

    If there is no file and no shipped file `name`, raise an InputFileError that lists the shipped files of this `kind`
    and, with `beside`, also the files of this `kind` in the folder of `name`.
    """
    own = os.path.expanduser(name)
    if os.path.isfile(own):
        return Path(own)
    shipped = shipped_names()
    for candidate in (os.fspath(name), f"{os.fspath(name)}.yaml"):
        if candidate in shipped:
            return config_folder() / candidate
    raise InputFileError(os.fspath(name) or "''", "", _no_such_file(os.fspath(name), kind, beside))


def input_file(name: str | os.PathLike[str], kind: str = "") -> Path:
    """Return the path of an input: `name` if it is a file or pipe (- is stdin), else the shipped file `name`."""
    own = os.path.expanduser(name)
    if own == "-":
        return Path("/dev/stdin")
    return Path(own) if os.path.exists(own) and not os.path.isdir(own) else config_file(name, kind, beside=True)


def confined_file(name: str | os.PathLike[str], folder: Path | None, kind: str = "") -> Path:
    """Return the path of a configuration file in `folder` or a subfolder, or of a shipped file; refuse other files."""
    own = os.path.expanduser(os.fspath(name))
    if own and folder is not None and os.path.exists(folder / own):
        own = os.path.join(folder, own)
    if os.path.exists(own) and not os.path.isfile(own):
        raise InputFileError(own, "", "is not a regular file")
    path = config_file(own, kind).resolve()
    _refuse_elsewhere(name, path, folder)
    return path


def confined_opener(folder: Path | None) -> Callable[[str, int], int]:
    """Return an opener for Python's ``open`` that opens only files in `folder` and shipped files."""
    # Another process may replace a file, between the check of its name and its opening, by a pipe or a link to another
    # folder. The file is therefore opened without blocking, and checked when it is open.

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
    """Raise an InputFileError if the resolved `path` is neither in `folder` nor in the folder of shipped files."""
    folders = [place.resolve() for place in (folder, config_folder()) if place is not None]
    if not any(path.is_relative_to(place) for place in folders):
        places = " and ".join(str(place) for place in folders)
        problem = f"names the file {path}, but only files in {places} are read; see the parameter model_folder"
        raise InputFileError(os.fspath(name), "", problem)


def folder_of(name: str | os.PathLike[str]) -> Path | None:
    """Return the resolved folder of the file whose path is `name`; None if `name` is the name of a shipped file."""
    own = os.path.expanduser(name)
    if os.path.dirname(own) or os.path.isfile(own):
        return Path(os.path.dirname(own) or ".").resolve()
    return None


def shipped_names(kind: str = "") -> list[str]:
    """Return the sorted names of the shipped files, either all or those of one `kind`, such as ``geometry``."""
    folder = config_folder()
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
    chosen = [path for path in files if path.parent == folder and _has_kind(path, kind)] if kind else files
    return sorted(path.relative_to(folder).as_posix() for path in chosen)


def _has_kind(path: Path, kind: str) -> bool:
    """Return whether a file is of a `kind`, such as ``geometry``, judged by its suffix and first 4096 characters."""
    if path.suffix.lower() not in SUFFIXES.get(kind, (".yaml", ".yml")):
        return False
    try:
        with open(path, encoding="utf-8-sig", errors="replace") as stream:
            text = stream.read(4096)
    except OSError:
        return False
    if kind in COLUMNS:
        header = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
        return COLUMNS[kind].search(header) is not None
    stated = FORMAT.search(text)
    return kind in SUFFIXES or (stated is not None and stated.group(1) == kind)


@cache
def config_folder() -> Path:
    # The search starts at this source file, so that the folder belongs to the running code. In a source tree (also of
    # an editable or symlinked installation) the folder is `config` beside the package; in other installations, by pip
    # or colcon, the folder is `share/hexapod_comp/config` in the prefix.
    package = Path(__file__).resolve().parents[1]
    if (package.parent / "package.xml").is_file():
        return package.parent / "config"
    for prefix in package.parents:
        folder = prefix / "share" / PACKAGE / "config"
        if folder.is_dir():
            return folder
    problem = f"no folder above the package contains share/{PACKAGE}/config; install the package again"
    raise InputFileError(package, "", problem)


def version() -> str:
    """Return the version of the running code, which package.xml states."""
    path = config_folder().parent / "package.xml"
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputFileError(path, "", f"cannot be read: {error.strerror}; install the package again") from error
    match = re.search(r"<version>\s*(.*?)\s*</version>", text)
    return match.group(1) if match else "unknown"


def _no_such_file(name: str, kind: str, beside: bool) -> str:
    own = os.path.expanduser(name)
    folder = os.path.dirname(own)
    if folder and not os.path.isdir(folder):
        return "there is no such file, and its folder does not exist"
    shipped = shipped_names(kind) if kind != "readings" else []
    present = sorted(path.name for path in _files_in(Path(folder or ".")) if _has_kind(path, kind)) if beside else []
    stems = {Path(one).stem: one for one in shipped + present}
    parts = ["is a folder" if os.path.isdir(own) else "there is no such file"]
    what = ", ".join(SUFFIXES[kind]) if kind in SUFFIXES else kind.replace("_", " ")
    parts += [f"{what} files beside it: {_listed(present)}"] if present else []
    parts += [f"shipped: {_listed(shipped)}"] if shipped else []
    parts += ["or ideal"] if kind == "model" else []
    return "; ".join(parts) + did_you_mean(Path(own).stem, stems)


def _files_in(folder: Path) -> list[Path]:
    """Return at most `MOST_OPENED` files of a folder; no file if the folder cannot be read."""
    try:
        return [path for path in itertools.islice(folder.iterdir(), MOST_OPENED) if path.is_file()]
    except OSError:
        return []


def _listed(names: list[str]) -> str:
    more = len(names) - MOST_LISTED
    return ", ".join(names[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
