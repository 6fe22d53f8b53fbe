"""README and doc/ as a reader finds them: each link leads somewhere, and the code that theory.md names is there."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("doc/**/*.md")])
FENCED = re.compile(r"^( *)```.*?^\1```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!\w+:)([^)\s#]*)(?:#([^)\s]+))?\)")


def anchors(page: Path) -> set[str]:
    """Return the targets of a page's headings, as hosting sites and MyST make them."""
    slugs: Counter[str] = Counter()
    for heading in re.findall(r"^#{1,6} +(.+)$", FENCED.sub("", page.read_text(encoding="utf-8")), re.MULTILINE):
        shown = re.sub(r"[`*$]|\]\([^)]*\)", "", heading).strip().lower()
        slugs[re.sub(r"[^\w\- ]", "", shown).replace(" ", "-")] += 1
    return {f"{slug}-{n}" if n else slug for slug, count in slugs.items() for n in range(count)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_each_link_leads_to_a_file_and_a_heading(page: Path):
    for name, anchor in LINK.findall(FENCED.sub("", page.read_text(encoding="utf-8"))):
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), name
        assert not anchor or anchor in anchors(target), f"{name}#{anchor}"


def test_the_site_shows_every_page():
    """A page that no list of contents names can be found by nobody."""
    index = (ROOT / "doc" / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^[\w/]+$", index, re.MULTILINE))
    pages = {str(page.relative_to(ROOT / "doc").with_suffix("")) for page in ROOT.glob("doc/**/*.md")}
    assert listed == pages - {"index"}


def test_the_code_that_the_theory_names_is_there():
    """``room.module.name`` in theory.md, down to methods and private functions, is defined in that module."""
    text = (ROOT / "doc" / "theory.md").read_text(encoding="utf-8")
    rooms = "|".join(path.name for path in (ROOT / "hexapod_comp").iterdir() if (path / "__init__.py").is_file())
    named = re.findall(rf"`((?:{rooms})\.[a-z]\w*|pose)\.((?:\w+\.)?\w+)`", text)
    assert len(named) >= 100
    for module, name in named:
        source = (ROOT / "hexapod_comp" / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
        assert name.rpartition(".")[2] in defined(ast.parse(source)), f"{module}.{name}"


def defined(tree: ast.AST) -> set[str]:
    """Return the names of functions, classes and constants in a module."""
    nodes = list(ast.walk(tree))
    targets = [node.targets[0] for node in nodes if isinstance(node, ast.Assign)]
    targets += [node.target for node in nodes if isinstance(node, ast.AnnAssign)]
    names = {target.id for target in targets if isinstance(target, ast.Name)}
    return names | {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
