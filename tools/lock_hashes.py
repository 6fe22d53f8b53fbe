"""Write locked/*.txt: every package of constraints.txt with the SHA-256 of each file that make may install of it.

``make constraints`` runs it, with Python 3.11 or newer and uv beside that Python. locked/ros.txt is complete; any other
file holds only the packages that it adds to ros.txt, and pip installs both together.
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
"""The extras of each file, by its name; the package's own requirements are in every file."""

WHEEL = re.compile(
    r"-(?:cp3(?:10|11|12|13|14)-cp3\d+|cp3\d+-abi3|(?:py2\.)?py3\d*(?:\.py2)?-none|cp3\d+-none)-(\S+)\.whl$"
)
"""Wheels for Python 3.10 to 3.14 without free threading, by the end of their names; group 1 is the platform."""

EVERYWHERE = ("platform_machine == 'x86_64'", "platform_python_implementation == 'CPython'", "sys_platform == 'linux'")
"""Conditions that make requires of every machine, and that are therefore omitted from the markers."""


def compiled(extras: list[str]) -> list[dict[str, Any]]:
    """Return the packages that uv resolves for some extras, at the versions of constraints.txt."""
    command = [str(Path(sys.executable).parent / "uv"), "pip", "compile", "setup.py", "--universal", "--quiet"]
    command += ["--python-version", "3.10", "--constraint", "constraints.txt", "--format", "pylock.toml"]
    for extra in extras:
        command += ["--extra", extra]
    text = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return tomllib.loads(text)["packages"]


def hashes(package: dict[str, Any]) -> Iterator[str]:
    """Yield the SHA-256 of each wheel for make's Pythons, or of the source archive if there is no such wheel."""
    fitting = []
    for wheel in package.get("wheels", []):
        match = WHEEL.search(wheel["url"])
        if match and (match[1] == "any" or "manylinux" in match[1]):
            fitting.append(wheel)
    for archive in fitting or [package["sdist"]]:
        yield archive["hashes"]["sha256"]


def entry(package: dict[str, Any]) -> str:
    """Return a package's entry in a requirements file: name, version, marker, hashes."""
    parts = [part for part in package.get("marker", "").split(" and ") if part and part not in EVERYWHERE]
    marker = f" ; {' and '.join(parts)}" if parts else ""
    lines = [f"{package['name']}=={package['version']}{marker}"]
    return " \\\n".join([*lines, *(f"    --hash=sha256:{value}" for value in sorted(set(hashes(package))))])


def main() -> None:
    """Write all files of locked/."""
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
