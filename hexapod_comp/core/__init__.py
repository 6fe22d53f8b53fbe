"""The arithmetic, in C99, and its face in Python."""

from __future__ import annotations

try:
    from ._core import ffi, lib
except ImportError as error:
    raise ImportError(
        f"hexapod_comp's core does not load: {error}. Build it: `pip install --editable .` in the source tree, "
        "or `python3 setup.py build_ext --inplace` beside setup.py",
        name="hexapod_comp.core._core",
    ) from error

__all__ = ["ffi", "lib"]
