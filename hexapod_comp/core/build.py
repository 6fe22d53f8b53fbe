"""The build of the C core for setup.py: the extension module ``_core``, made by cffi in API mode.

The declarations for cffi come from the headers, from the constants in ``core.h`` and from the definitions of the batch
functions, so that nothing is declared twice. One build serves all versions of Python, by Python's stable ABI.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from cffi import FFI

FOLDER = Path("hexapod_comp", "core")  # setup.py runs in the root of the sources
# Headers of the functions that Python calls; the first header is public, and ``export --c`` copies it
HEADERS = ("hexapod_comp.h", "hexapod_batch.h")
UNIT = "hexapod_batch.c"  # The only file to compile: it includes all others
CONSTANT = re.compile(r"^#define (\w+) \(?(-?[\d.e-]+)", re.MULTILINE)
FLAGS = ["-std=c99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"]
"""Options that give the same bits on every machine: products and sums are not contracted, and nothing is reordered. The
options -fno-math-errno and -fno-trapping-math allow vector code; the core reads neither errno nor exception flags."""


def declarations() -> str:
    """Return the declarations for cffi: constants, headers without preprocessor lines, batch functions' prototypes."""
    constants = CONSTANT.findall((FOLDER / "core.h").read_text(encoding="utf-8"))
    heads = [f"static const {'int' if number.isdigit() else 'double'} {name}" for name, number in constants]
    headers = "".join((FOLDER / name).read_text(encoding="utf-8") for name in HEADERS)
    plain = re.sub(r"^#ifdef __cplusplus.*?^#endif", "", headers, flags=re.MULTILINE | re.DOTALL)
    parts = re.findall(r'^#include "(\w+\.c)"', (FOLDER / UNIT).read_text(encoding="utf-8"), re.MULTILINE)
    code = "".join((FOLDER / name).read_text(encoding="utf-8") for name in parts)
    heads += re.findall(r"^((?:void|int|double|hc_status) hc_\w+\([^{;]*\))\n{", code, re.MULTILINE)
    heads.append("const char *hc_sources(void)")
    return re.sub(r"^#.*$", "", plain, flags=re.MULTILINE) + "".join(f"{head};\n" for head in heads)


def sources_hash(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.[ch]")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def extension() -> FFI:
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


if __name__ == "__cffi__":  # the name under which setup.py's cffi_modules runs this file
    ffi = extension()
