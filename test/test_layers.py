"""The house: which room may import which. The picture is in doc/architecture.md."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "hexapod_comp"
ROOMS = (
    "errors", "kernels", "pose", "formats", "machine", "compensation", "measurements", "virtual", "workspace",
    "calibration", "export", "replay", "nodes", "linuxcnc", "loop", "cli", "__main__",
)  # fmt: skip
"""From the ground up: a room imports from itself and from those before it."""

MODULES = sorted(PACKAGE.rglob("*.py"))


def imported(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield line and dotted name, as a list, of all that a module imports, inside functions too."""
    here = path.relative_to(PACKAGE.parent).with_suffix("").parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name.split(".")) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = list(here[: len(here) - node.level]) if node.level else []
            start += node.module.split(".") if node.module else []
            yield from ((node.lineno, [*start, alias.name]) for alias in node.names)


def room(parts: list[str]) -> str:
    """Return the room of a dotted name of this package."""
    return parts[1]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    here = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if here == "__init__":
        return
    for line, name in imported(path):
        if name[0] == PACKAGE.name:
            assert ROOMS.index(room(name)) <= ROOMS.index(here), f"line {line}: {here} imports {'.'.join(name)}"
