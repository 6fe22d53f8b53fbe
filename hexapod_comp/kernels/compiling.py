"""How kernels are compiled and cached.

Numba renews a cached kernel when the kernel's own file changes, not when a kernel that it calls from
another file does: after an update a machine could run half of the old arithmetic. So the cache lives in a
folder named by a hash of this whole room.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

try:
    import numba
    from numba.core import event
except ImportError as error:
    raise ImportError(
        f"needs Numba, which compiles the kinematics ({error}): apt install python3-numba, or where there is none "
        "(Ubuntu 24.04): pip install numba, in a virtual environment made with --system-site-packages",
        name="numba",
    ) from error

FOLDER_PREFIX = "kernels-"


class NotCompiledError(Exception):
    """A kernel is not in the cache."""


class _Refusal(event.Listener):
    """Hears of kernels that are about to be compiled, in any thread, and stops that."""

    def on_start(self, event: event.Event) -> None:
        raise NotCompiledError(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def from_cache_only() -> Iterator[None]:
    """Raise NotCompiledError, as long as this context is open, where a kernel would have to be compiled."""
    with event.install_listener("numba:compile", _Refusal()):
        yield


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a kernel on first use: cached on disk, releases the GIL, IEEE division."""
    configured = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_folder(configured))
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = configured


@cache
def cache_folder(configured: str = "") -> Path:
    """Return the folder of this version's compiled kernels.

    Parameters
    ----------
    configured : str
        Root that the user has given by ``NUMBA_CACHE_DIR``. Without one the kernels lie beside the
        sources, or, where those are read-only, in the user's cache folder; a machine that offers neither
        compiles anew at every start.
    """
    name = FOLDER_PREFIX + _source_hash()
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    beside = Path(__file__).resolve().parent / "__pycache__"
    roots = [Path(configured)] if configured else [beside, Path(home) / "hexapod_comp"]
    for root in roots:
        folder = root / name
        try:
            _make(folder)
        except OSError:
            continue
        return folder
    folder = Path(tempfile.mkdtemp(prefix="hexapod_comp_")) / name
    folder.mkdir()
    return folder


def _make(folder: Path) -> None:
    """Make a folder that this user can write, and remove those of other versions beside it."""
    if not folder.is_dir():
        folder.mkdir(parents=True)
        for other in folder.parent.glob(FOLDER_PREFIX + "*"):
            if other != folder:
                shutil.rmtree(other, ignore_errors=True)
    with tempfile.TemporaryFile(dir=folder):
        pass


def _source_hash() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
