"""What setup.py builds of the C core: the extension module ``_core``, by cffi in API mode.

cffi reads the declarations out of the headers, and of the batch functions out of their definitions, so nothing is
declared twice. The module uses Python's stable ABI: one build serves all versions of Python.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from cffi import FFI

FOLDER = Path("hexapod_comp", "core")  # setup.py runs in the root of the sources
# What Python calls; the first is the public one, which ``export --c`` copies
HEADERS = ("hexapod_comp.h", "hexapod_batch.h")
UNIT = "hexapod_batch.c"  # Compiled as one unit; it contains ``hexapod_comp.c``
CONSTANTS = "static const double QUATERNION_TOLERANCE, LONGEST_RAMP_STEP, SLIDING; const char *hc_sources(void);"
FLAGS = ["-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
"""The same bits on every machine: products and sums are not contracted, and nothing is reordered. Nobody asks for errno
or for floating-point exceptions; without them loops become vector code."""


def declarations() -> str:
    """Return what cffi is to declare: the headers without preprocessor's lines, and the batch functions' heads."""
    headers = "".join((FOLDER / name).read_text(encoding="utf-8") for name in HEADERS)
    plain = re.sub(r"^#ifdef __cplusplus.*?^#endif", "", headers, flags=re.MULTILINE | re.DOTALL)
    parts = re.findall(r'^#include "(\w+\.c)"', (FOLDER / UNIT).read_text(encoding="utf-8"), re.MULTILINE)
    code = "".join((FOLDER / name).read_text(encoding="utf-8") for name in parts)
    heads = re.findall(r"^((?:void|int|double|hc_status) hc_\w+\([^{;]*\))\n{", code, re.MULTILINE)
    return re.sub(r"^#.*$", "", plain, flags=re.MULTILINE) + CONSTANTS + "".join(f"{head};\n" for head in heads)


def sources_hash(folder: Path) -> str:
    """Return the SHA-256 of the core's files, by name."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.[ch]")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def extension() -> FFI:
    """Return the module that setup.py builds."""
    made = FFI()
    made.cdef(declarations())
    code = f'#include "{UNIT}"\n'
    code += f'static const char *hc_sources(void) {{ return "{sources_hash(FOLDER)}"; }}\n'
    made.set_source(
        "hexapod_comp.core._core",
        code,
        include_dirs=[str(FOLDER)],
        depends=[str(path) for path in sorted(FOLDER.glob("*.[ch]"))],
        extra_compile_args=FLAGS,
        libraries=["m"],
    )
    return made


if __name__ == "__cffi__":  # as setup.py's cffi_modules runs this file
    ffi = extension()
