"""Words that a user reads: papers go by their authors, and names in the code are the field's."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hexapod_comp"
MODULES = sorted(PACKAGE.rglob("*.py"))
SHIPPED = sorted(path for folder in ("config", "launch") for path in (ROOT / folder).rglob("*") if path.is_file())

PAPER_NUMBER = re.compile(r"(?<![\d.,])00[014](?![\d.])")
"""000, 001 and 004 were file names of the papers; numbers as 0.001 and 1,000 are none of them."""

NO_NAMES = {"told", "untold", "said", "mine", "bump", "lockstep", "gathering", "gathered", "answers", "found"}
"""Verbs and pronouns, where the field has a word: commanded, predicted, members, ramp, batch, assembled."""


def names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield every name that a module gives or uses, and its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute):
            yield node.lineno, node.attr
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_strings_and_names_are_for_people(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    strings = [n for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    assert [(n.lineno, n.value) for n in strings if PAPER_NUMBER.search(n.value)] == []
    assert [(line, name) for line, name in names(tree) if set(name.lower().split("_")) & NO_NAMES] == []


def test_shipped_files_name_authors():
    texts = {path.name: path.read_text(encoding="utf-8") for path in SHIPPED}
    assert {name: found for name, text in texts.items() if (found := PAPER_NUMBER.findall(text))} == {}
