"""Memory of a node's process that goes back to the system."""

from __future__ import annotations

import contextlib
import ctypes
import re
from pathlib import Path

M_MMAP_THRESHOLD, LARGEST_KEPT = -3, 1 << 20
"""Parameter of glibc's ``mallopt``; blocks from this size on, byte, go back to the system when they are freed. Left
alone, the threshold grows with the largest block that was ever freed, and long messages leave holes in the heap."""

MADV_DONTNEED = 4

MAPS = Path("/proc/self/smaps")

HEAD = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \S+ +(/\S.*)$", re.MULTILINE)

COMPILING = ("llvmlite", "scipy")
"""Words in the names of libraries that only compiling needs: LLVM, and what Numba loads of linear algebra beside it."""


def give_blocks_back() -> None:
    """Let large blocks go back to the system at once, where the C library is glibc."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)


def give_code_back() -> None:
    """Take the code of what only compiling needs out of this process's memory, where the system is Linux.

    Kernels that are loaded run without it. Its pages are those of a file and have never been written to; the system
    maps them again where somebody needs them after all.
    """
    with contextlib.suppress(OSError, AttributeError):
        advise = ctypes.CDLL(None).madvise
        advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
        for start, end in _unwritten(MAPS.read_text()):
            advise(start, end - start, MADV_DONTNEED)


def _unwritten(maps: str) -> list[tuple[int, int]]:
    """Return where the libraries of :data:`COMPILING` are mapped and no page is this process's own."""
    areas = []
    _, *parts = HEAD.split(maps)
    for start, end, access, name, rest in zip(*(parts[n::5] for n in range(5)), strict=True):
        own = re.search(r"^Anonymous: +(\d+) kB$", rest, re.MULTILINE)
        if any(word in name for word in COMPILING) and "w" not in access and own is not None and own[1] == "0":
            areas.append((int(start, 16), int(end, 16)))
    return areas
