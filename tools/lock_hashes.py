"""Write locked/*.txt: every package of constraints.txt with the SHA-256 of each file that make may install of it.

Run by ``make constraints``, with Python 3.11 or newer and uv beside it. A file of ``ros`` comes first, and the
others hold what they add to it, so that pip takes them together.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tomllib

ROOT = Path(__file__).resolve().parents[1]

FILES = {
    "ros": ["ros"],
    "test": ["ros", "test"],
    "docs": ["ros", "docs"],
    "compiler": ["ros", "compiler"],
    "wheel": ["ros", "wheel"],
}
"""What each file holds: the package's own requirements, and these extras."""

WHEEL = re.compile(
    r"-(?:cp3(?:10|11|12|13|14)-cp3\d+|cp3\d+-abi3|(?:py2\.)?py3\d*(?:\.py2)?-none|cp3\d+-none)-(\S+)\.whl$"
)
"""Interpreters of make's environments, without the free-threaded ones; the rest of a name says the platform."""

EVERYWHERE = ("platform_machine == 'x86_64'", "platform_python_implementation == 'CPython'", "sys_platform == 'linux'")
"""What make asks of a machine anyway, and markers need not say."""


def compiled(extras: list[str]) -> list[dict[str, Any]]:
    """Return the packages that uv picks for extras, at the versions of constraints.txt."""
    command = [str(Path(sys.executable).parent / "uv"), "pip", "compile", "setup.py", "--universal", "--quiet"]
    command += ["--python-version", "3.10", "--constraint", "constraints.txt", "--format", "pylock.toml"]
    for extra in extras:
        command += ["--extra", extra]
    text = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return tomllib.loads(text)["packages"]


def hashes(package: dict[str, Any]) -> Iterator[str]:
    """Yield the hashes of the wheels that fit, of the source archive where none does."""
    fitting = []
    for wheel in package.get("wheels", []):
        match = WHEEL.search(wheel["url"])
        if match and (match[1] == "any" or "manylinux" in match[1]):
            fitting.append(wheel)
    for archive in fitting or [package["sdist"]]:
        yield archive["hashes"]["sha256"]


def entry(package: dict[str, Any]) -> str:
    """Return a package as pip reads it: version, marker, hashes."""
    parts = [part for part in package.get("marker", "").split(" and ") if part and part not in EVERYWHERE]
    marker = f" ; {' and '.join(parts)}" if parts else ""
    lines = [f"{package['name']}=={package['version']}{marker}"]
    return " \\\n".join([*lines, *(f"    --hash=sha256:{value}" for value in sorted(set(hashes(package))))])


def main() -> None:
    """Write all files."""
    before: set[str] = set()
    folder = ROOT / "locked"
    folder.mkdir(exist_ok=True)
    for name, extras in FILES.items():
        entries = [entry(package) for package in compiled(extras)]
        if name == "ros":
            before = set(entries)
        else:
            entries = [text for text in entries if text not in before]
        (folder / f"{name}.txt").write_text("\n".join(["# Written by: make constraints", *entries]) + "\n")


if __name__ == "__main__":
    main()
