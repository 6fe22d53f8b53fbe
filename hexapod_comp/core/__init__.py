"""The arithmetic, in C99, and its face in Python: structs and statuses; :mod:`.batch` has the functions."""

from __future__ import annotations

import enum
import functools
from typing import Any

import numpy as np

try:
    from ._core import ffi, lib
except ImportError as error:
    raise ImportError(
        f"hexapod_comp's core does not load: {error}. Build it: `pip install --editable .` in the source tree, "
        "or `python3 setup.py build_ext --inplace` beside setup.py",
        name="hexapod_comp.core._core",
    ) from error

# Version of the arithmetic, which changes when a bit of an answer does, and SHA-256 of the sources that were built
VERSION, SOURCES_HASH = ffi.string(lib.hc_version()).decode(), ffi.string(lib.hc_sources()).decode()
# A quaternion whose norm is further from 1 than this is refused: it was never a rotation
QUATERNION_NORM_TOLERANCE = lib.QUATERNION_TOLERANCE
# A pause between commands counts as no more than this in a ramp, s: a late command must not step
LONGEST_RAMP_STEP = lib.LONGEST_RAMP_STEP
# A bearing that turns by less than this share of the motion does not resist in full
SLIDING = lib.SLIDING
MOST_ITERATIONS, MOST_HARMONICS = lib.HC_MOST_ITERATIONS, lib.HC_MOST_HARMONICS


def _statuses() -> Any:
    return enum.IntEnum("Status", {name[3:]: value for name, value in ffi.typeof("hc_status").relements.items()})


Status = _statuses()  # hc_status: what became of a command, a check or a solution; ``OK`` is 0

NUMBERS = {"double": "f8", "int": "i4", "long": "i8"}


@functools.cache
def dtype_of(name: str) -> np.dtype:
    """Return the NumPy type that is laid out as a struct of the headers; pointers are addresses."""
    return np.dtype(_layout(ffi.typeof(name)))


def _layout(kind: Any) -> Any:
    if kind.kind == "array":
        return _layout(kind.item), (kind.length,)
    if kind.kind == "pointer":
        return np.uintp
    if kind.kind == "struct":
        names, fields = zip(*kind.fields, strict=True)
        formats, offsets = [_layout(field.type) for field in fields], [field.offset for field in fields]
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": ffi.sizeof(kind)})
    return "i4" if kind.kind == "enum" else NUMBERS[kind.cname]


class Struct:
    """A struct of the headers in memory of its own.

    Attributes
    ----------
    at : cdata
        Pointer to it, for C; valid while the struct is referenced.
    view : ndarray of shape ()
        It by name: ``view["last"]["nominal"]`` is an array in it.
    """

    __slots__ = ("_kept", "at", "name", "view")

    def __init__(self, name: str, values: dict[str, Any] | None = None) -> None:
        self.name, self.view = name, np.zeros((), dtype_of(name))
        self.at = ffi.from_buffer(f"{name} *", self.view, True)
        self._kept: list[Any] = []
        _fill(self.view, values or {}, self._kept)

    def __reduce__(self) -> tuple:
        if self._kept:
            raise TypeError(f"{self.name} points to memory of this process")
        return _rebuilt, (self.name, self.view.tobytes())

    def keep(self, other: Struct) -> None:
        """Keep the memory alive to which C has pointed this struct, in place of the memory kept before."""
        self._kept[:] = [other]

    def copy_from(self, other: Struct) -> None:
        """Copy another one, with what it points to."""
        self.view[...] = other.view
        self._kept[:] = other._kept


def _rebuilt(name: str, content: bytes) -> Struct:
    struct = Struct(name)
    struct.view[...] = np.frombuffer(content, struct.view.dtype)[0]
    return struct


def _fill(view: np.ndarray, values: dict[str, Any], kept: list[Any]) -> None:
    """Write values by name; what a pointer points to is kept."""
    for name, value in values.items():
        kind = view.dtype[name]
        if isinstance(value, dict):
            _fill(view[name], value, kept)
        elif kind.base.names and not isinstance(value, np.ndarray):
            for part, member in zip(view[name], value, strict=True):
                _fill(part, member, kept)
        elif kind.base == np.uintp:
            view[name] = [_kept(part, kept) for part in value] if kind.shape else _kept(value, kept)
        else:
            view[name] = value


def _kept(value: Any, kept: list[Any]) -> int:
    held = ffi.new("char[]", value.encode()) if isinstance(value, str) else np.ascontiguousarray(value, dtype=float)
    kept.append(held)
    return int(ffi.cast("uintptr_t", held)) if isinstance(value, str) else held.ctypes.data
