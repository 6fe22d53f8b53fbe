"""Python access to the C core: its structs and statuses; :mod:`.batch` has the functions."""

from __future__ import annotations

import enum
import functools
from typing import Any, cast

import numpy as np

try:
    from ._core import ffi, lib
except ImportError as error:
    raise ImportError(
        f"hexapod_comp's core does not load: {error}. Build it: `pip install --editable .` in the source tree, "
        "or `python3 setup.py build_ext --inplace` beside setup.py",
        name="hexapod_comp.core._core",
    ) from error

# Version of the arithmetic (it changes when any bit of a result changes), and SHA-256 of the C sources
VERSION, SOURCES_HASH = ffi.string(lib.hc_version()).decode(), ffi.string(lib.hc_sources()).decode()

_STATUSES = {name[3:]: value for name, value in ffi.typeof("hc_status").relements.items()}
Status = cast("Any", enum.IntEnum)("Status", _STATUSES)  # The values of hc_status by name: OK = 0, …
NUMBERS = {"double": "f8", "int": "i4", "long": "i8"}


@functools.cache
def dtype_of(name: str) -> np.dtype:
    """Return the NumPy type with the memory layout of a struct of the C headers; pointers become integer addresses."""
    return np.dtype(_layout(ffi.typeof(name)))


def _layout(kind: Any) -> Any:
    """Return the argument of ``np.dtype`` that describes the memory layout of a cffi type."""
    if kind.kind == "array":
        return _layout(kind.item), (kind.length,)
    if kind.kind == "pointer":
        return np.uintp
    if kind.kind == "struct":
        names, fields = zip(*kind.fields, strict=True)
        formats, offsets = [_layout(field.type) for field in fields], [field.offset for field in fields]
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": ffi.sizeof(kind)})
    return "i4" if kind.kind == "enum" else NUMBERS[kind.cname]


MOST_HARMONICS = dtype_of("hc_strut")["wave"].shape[0]  # Largest number of harmonics of a screw's periodic error


class Struct:
    """A struct of the C headers, in memory that this object owns.

    `at` is the pointer to pass to C; it is valid while this object exists. `view` gives access to the struct's members,
    for example ``view["last"]["nominal"]``.
    """

    __slots__ = ("_kept", "at", "name", "view")

    def __init__(self, name: str, values: dict[str, Any] | None = None) -> None:
        self.name, self.view = name, np.zeros((), dtype_of(name))
        self.at = ffi.from_buffer(f"{name} *", self.view, True)
        self._kept: list[Any] = []
        _fill(self.view, values or {}, self._kept)

    def __reduce__(self) -> tuple:
        if self._kept:
            raise TypeError(f"{self.name} cannot be pickled: it points to memory of this process")
        return _unpickled, (self.name, self.view.tobytes())

    def keep(self, other: Struct) -> None:
        """Keep `other` in memory, as this struct now has a pointer to it; release what was kept before."""
        self._kept[:] = [other]

    def copy_from(self, other: Struct) -> None:
        """Copy the content of another struct of the same type, and keep alive the memory to which it points."""
        self.view[...] = other.view
        self._kept[:] = other._kept


def _unpickled(name: str, content: bytes) -> Struct:
    struct = Struct(name)
    struct.view[...] = np.frombuffer(content, struct.view.dtype)[0]
    return struct


def _fill(view: np.ndarray, values: dict[str, Any], kept: list[Any]) -> None:
    """Write values into a struct by member name; append to `kept` the memory to which the struct's pointers point."""
    for name, value in values.items():
        kind = view.dtype[name]
        if isinstance(value, dict):
            _fill(view[name], value, kept)
        elif kind.base.names and not isinstance(value, np.ndarray):
            for part, member in zip(view[name], value, strict=True):
                _fill(part, member, kept)
        elif kind.base == np.uintp:
            view[name] = [_address(part, kept) for part in value] if kind.shape else _address(value, kept)
        else:
            view[name] = value


def _address(value: Any, kept: list[Any]) -> int:
    """Copy a text or numbers, append the copy to `kept`, so that it stays in memory, and return its address."""
    held = ffi.new("char[]", value.encode()) if isinstance(value, str) else np.ascontiguousarray(value, dtype=float)
    kept.append(held)
    return int(ffi.cast("uintptr_t", held)) if isinstance(value, str) else held.ctypes.data
