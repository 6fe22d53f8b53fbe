"""README and doc/: each link leads to a file and a heading, and the code that theory.md names exists."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import fields
from pathlib import Path

import pytest
from helpers import quick_pictures

from hexapod_comp.calibration.design import TIMES, Times
from hexapod_comp.cli import main
from hexapod_comp.cli.verbs import VERBS
from hexapod_comp.measurements import wide_csv
from hexapod_comp.measurements.readings import DEFAULT_UNCERTAINTY, si_unit

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("doc/**/*.md")])
FENCED = re.compile(r"^( *)```.*?^\1```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!\w+:)([^)\s#]*)(?:#([^)\s]+))?\)")


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as hosting sites and MyST make them."""
    slugs: Counter[str] = Counter()
    for heading in re.findall(r"^#{1,6} +(.+)$", FENCED.sub("", page.read_text(encoding="utf-8")), re.MULTILINE):
        shown = re.sub(r"[`*$]|\]\([^)]*\)", "", heading).strip().lower()
        slugs[re.sub(r"[^\w\- ]", "", shown).replace(" ", "-")] += 1
    return {f"{slug}-{n}" if n else slug for slug, count in slugs.items() for n in range(count)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_each_link_leads_to_a_file_and_a_heading(page: Path):
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    assert "```" not in text  # a block that is not closed swallows the text after it
    for name, anchor in LINK.findall(text):
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), name
        assert not anchor or anchor in anchors(target), f"{name}#{anchor}"


def test_each_key_of_a_campaigns_noise_is_documented_with_its_default():
    text = (ROOT / "doc" / "measuring.md").read_text(encoding="utf-8")
    for kind, sigma in DEFAULT_UNCERTAINTY.items():
        unit = si_unit(kind)
        assert re.search(rf"^\| `{kind}_u{unit}` \|.+\| {sigma * 1e6:g} µ{unit} \|$", text, re.MULTILINE), kind


def test_the_times_of_each_instrument_are_documented():
    text = (ROOT / "doc" / "measuring.md").read_text(encoding="utf-8")
    text = text.partition("| instrument | set-up, min |")[2].partition("\n\n")[0]
    stated = {}
    for names, set_up, run, stops in re.findall(r"^\| (`.+`) \| (.+) \| (.+) \| (.+) \|$", text, re.MULTILINE):
        instruments, seconds = re.findall(r"`(.+?)`", names), [float(stop) for stop in stops.split(", ")]
        for name, stop in zip(instruments, seconds * (len(instruments) // len(seconds)), strict=True):
            stated[name] = Times(60.0 * float(set_up), 60.0 * float(run), stop)
    assert stated == TIMES


def test_subpackages_are_listed_in_the_order_that_the_linter_checks():
    page = (ROOT / "doc" / "architecture.md").read_text(encoding="utf-8")
    listed = re.findall(r"^  (\w+)(?:/|\.py) ", page, re.MULTILINE)
    layers = re.search(r"^layers = \[(.+?)^\]", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M | re.S)
    assert layers
    lowest_first = [re.findall(r"\w+", layer) for layer in re.findall(r'"(.+?)"', layers[1])][::-1]
    rank = {name: number for number, names in enumerate(lowest_first) for name in names}
    listed.remove("__init__")
    assert [rank[name] for name in listed] == sorted(rank[name] for name in listed)
    assert set(rank) - set(listed) == {"nodes", "__main__"}


def test_each_key_of_a_columns_file_is_documented():
    text = (ROOT / "doc" / "measuring.md").read_text(encoding="utf-8").partition("### Wide CSV")[2]
    names = "Columns", "Layout", "MeasuredPoses", "PoseFile", "UncertaintyColumns", "Humidity", "Times", "StrutColumns"
    keys = [one.name for name in names for one in fields(getattr(wide_csv, name))]
    assert {key for key in keys if not re.search(rf"^{key}:|`{key}(_\w+)?(: \w+)?`", text, re.MULTILINE)} == set()


def test_the_code_that_the_theory_names_is_there():
    """Each ``package.module.name`` in theory.md, also methods and private functions, is defined in that file."""
    text = (ROOT / "doc" / "theory.md").read_text(encoding="utf-8")
    rooms = "|".join(path.name for path in (ROOT / "hexapod_comp").iterdir() if (path / "__init__.py").is_file())
    named = re.findall(rf"`((?:(?:{rooms})\.[a-z]|pose\.)[\w.]*)`", text)
    assert len(named) >= 100
    for dotted in named:
        parts = dotted.split(".")
        stems = [(ROOT / "hexapod_comp").joinpath(*parts[:n]) for n in range(1, len(parts) + 1)]
        found = [path for stem in stems for end in (".c", ".py") if (path := stem.with_suffix(end)).is_file()]
        defined = re.compile(rf"^ *(?:[\w*]+ )*\*?{parts[-1]} *[(:=]", re.MULTILINE)
        assert any(parts[-1] == path.stem or defined.search(path.read_text("utf-8")) for path in found), dotted


def test_what_make_names_as_the_next_commands_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    """The last lines that ``make demo`` prints are commands that run, except the shell's own first line."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8").partition("define NEXT\n")[2].partition("\nendef")[0]
    commands = re.findall(r"^  hexapod_comp (.*?) +#", text, re.MULTILINE)
    assert len(commands) == 2
    monkeypatch.chdir(tmp_path)
    for command in commands:
        with quick_pictures():
            assert main(command.split()) == 0, capsys.readouterr().err


def test_the_page_of_the_command_line_has_every_verb_in_its_group():
    text = (ROOT / "doc" / "command_line.md").read_text(encoding="utf-8").partition("\n## ")[0]
    listed, group = {}, ""
    for bold, verb in re.findall(r"^\| (?:\*\*(\w+)\*\*|`(\w+)`) \|", text, re.MULTILINE):
        group = bold or group
        listed |= {verb: group} if verb else {}
    assert listed == {name: verb.group for name, verb in VERBS.items()}


@pytest.mark.parametrize("page", sorted(ROOT.glob("doc/notebooks/*.md")), ids=lambda page: page.name)
def test_notebooks_import_what_is_there(page: Path):
    for line in re.findall(r"^from (?:hexapod_comp|examples)\S* import .+$", page.read_text("utf-8"), re.M):
        exec(line, {})
