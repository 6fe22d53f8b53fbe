"""README and doc/ as a reader finds them: each link leads somewhere, and the code that theory.md names is there."""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import re
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

from hexapod_comp.cli import main
from hexapod_comp.measurements.readings import ANGULAR_KINDS, DEFAULT_UNCERTAINTY

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


def test_each_key_of_a_campaigns_noise_is_documented_with_its_default():
    text = (ROOT / "doc" / "measuring.md").read_text(encoding="utf-8")
    for kind, sigma in DEFAULT_UNCERTAINTY.items():
        unit = "rad" if kind in ANGULAR_KINDS else "m"
        assert re.search(rf"^\| `{kind}_u{unit}` \|.+\| {sigma * 1e6:g} µ{unit} \|$", text, re.MULTILINE), kind


def test_the_code_that_the_theory_names_is_there():
    """``room.module.name`` in theory.md, down to methods and private functions, is defined in that module or C file."""
    text = (ROOT / "doc" / "theory.md").read_text(encoding="utf-8")
    rooms = "|".join(path.name for path in (ROOT / "hexapod_comp").iterdir() if (path / "__init__.py").is_file())
    named = re.findall(rf"`((?:(?:{rooms})\.[a-z]|pose\.)[\w.]*)`", text)
    assert len(named) >= 100
    for dotted in named:
        parts = dotted.split(".")
        stems = [(ROOT / "hexapod_comp").joinpath(*parts[:n]) for n in range(1, len(parts) + 1)]
        found = [path for stem in stems for end in (".c", ".py") if (path := stem.with_suffix(end)).is_file()]
        assert any(parts[-1] in {path.stem, *names_in(path)} for path in found), dotted


@functools.cache
def names_in(path: Path) -> set[str]:
    """Return the names that a Python or C file defines."""
    text = path.read_text(encoding="utf-8")
    return (
        defined(ast.parse(text))
        if path.suffix == ".py"
        else set(re.findall(r"^(?:\w+ )+\*?(\w+)\(", text, re.MULTILINE))
    )


def defined(tree: ast.AST) -> set[str]:
    """Return the names of functions, classes and constants in a module."""
    nodes = list(ast.walk(tree))
    targets = [node.targets[0] for node in nodes if isinstance(node, ast.Assign)]
    targets += [node.target for node in nodes if isinstance(node, ast.AnnAssign)]
    names = {target.id for target in targets if isinstance(target, ast.Name)}
    return names | {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}


def test_nobody_is_told_to_install_a_name_that_no_index_has():
    """The package is on no index: ``pip install hexapod_comp[…]`` would fail, or fetch a stranger's package."""
    files = [*PAGES, *(ROOT / "hexapod_comp").rglob("*.py"), ROOT / "CHANGELOG.rst"]
    told = re.compile(r"pip3? install (?:-\S+ )*['\"]?hexapod[_-]comp\b")
    assert [str(path) for path in files if told.search(path.read_text(encoding="utf-8"))] == []


def test_what_make_names_as_the_next_commands_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    """The last lines of ``make demo``, each as it is typed but the shell's own first one."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8").partition("define NEXT\n")[2].partition("\nendef")[0]
    commands = re.findall(r"^  hexapod_comp (.*?) +#", text, re.MULTILINE)
    assert len(commands) == 2
    monkeypatch.chdir(tmp_path)
    for command in commands:
        assert main(command.split()) == 0, capsys.readouterr().err


def test_the_configuration_of_the_pages_needs_nothing_but_sphinx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As rosdoc2 runs it: from a copy, perhaps before it has set ``release``, without notebooks, MathML and NumPy."""
    stand_in = SimpleNamespace(option_spec={})
    names = {"docutils": "nodes", "sphinx.application": "Sphinx", "sphinx.writers.html5": "HTML5Translator"}
    for module, name in names.items():
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(**{name: stand_in}))
    code_block = SimpleNamespace(CodeBlock=type("CodeBlock", (), {"option_spec": {}}))
    monkeypatch.setitem(sys.modules, "sphinx", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "sphinx.directives", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "sphinx.directives.code", code_block)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "latex2mathml.converter", None)
    settings = {"__file__": str(tmp_path / "conf.py"), "__name__": "conf"}
    exec((ROOT / "doc" / "conf.py").read_text(encoding="utf-8"), settings)
    assert settings["html_title"] == "hexapod_comp"
    assert "myst_parser" in settings["extensions"]
    assert "**/api.md" in settings["exclude_patterns"]


@pytest.mark.parametrize("page", sorted(ROOT.glob("doc/notebooks/*.md")), ids=lambda page: page.name)
def test_notebooks_import_what_is_there(page: Path):
    for line in re.findall(r"^from (?:hexapod_comp|examples)\S* import .+$", page.read_text("utf-8"), re.M):
        exec(line, {})
