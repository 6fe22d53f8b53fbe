"""Every command in README.md and doc/ exists, and sessions print what their page shows.

Each line of a shell block is checked by its program: our verbs by the parser, ROS's tools by the tables of parameters,
topics and services, ``make`` and benchmarks by their files. :data:`OTHERS` are other people's programs. Sessions are
blocks with ``$`` and output. With ``LONG_TESTS=1`` (``make test-docs``) they run in their page's order; each line shown
must be printed, with numbers within two of their last digit or 2 %.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml
from launch_stand_in import LaunchFile

from hexapod_comp.cli.app import make_parser
from hexapod_comp.formats.paths import config_file
from hexapod_comp.linuxcnc import bridge as linuxcnc_bridge
from hexapod_comp.ros import adapter, compensator_state, instrument, mover, strut_drive
from hexapod_comp.ros.parameters import Taken

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "doc").glob("*.md"))]

BLOCK = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)

NODES = {
    part.PROGRAM.name: part for part in (compensator_state, strut_drive, mover, instrument, adapter, linuxcnc_bridge)
}

# Other programs and the shell's own words, which are not checked
OTHERS = {
    ".", "./selftest", "apt-get", "cat", "cc", "cd", "colcon", "cp", "eval", "export", "git", "linuxcnc", "ls", "mkdir",
    "pip", "pixi", "python3", "rm", "rosdep", "source", "sudo", "touch", "venv/bin/pip", "venv/bin/python",
}  # fmt: skip

# Topics on the pages that our nodes do not have, and their owners
OURS_ELSEWHERE = {"/compensation/status": "the controller of export --ros2-control"}


class Command(NamedTuple):
    """A command line of a block as words, and its place."""

    place: str
    words: list[str]


def blocks(page: Path) -> Iterator[tuple[int, str]]:
    """Yield the shell blocks of a page, commands and sessions, each with its first line's number."""
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        if block[2] in ("", "sh"):
            line = text.count("\n", 0, block.start()) + 2
            yield line, re.sub(rf"^{block[1]}", "", block[3], flags=re.MULTILINE)


def commands() -> Iterator[Command]:
    """Yield the commands of blocks that begin with a known program, of sessions the lines after ``$``."""
    for page in PAGES:
        for line, text in blocks(page):
            joined = re.sub(r"\\\n *", " ", text)  # continued lines count as one
            session = joined.startswith("$ ")
            first = joined.removeprefix("$ ").lstrip("#").split()
            if not session and not (first and first[0] in CHECKS.keys() | OTHERS) and "\nros2 " not in joined:
                continue
            for number, row in enumerate(joined.splitlines()):
                if (session and not row.startswith("$ ")) or not row.strip() or row.startswith("#"):
                    continue
                plain = re.sub(r" +#.*", "", row.removeprefix("$ "))
                for part in re.split(r" && | &(?= |$)", plain):
                    words = shlex.split(part)
                    while words and "=" in words[0]:
                        words = words[1:]
                    if words:
                        yield Command(f"{page.relative_to(ROOT)}:{line + number}", words)


def check_verb(words: list[str]) -> None:
    """Check a verb and its options by the parser."""
    if words[1:] != ["--version"]:  # which exits
        make_parser().parse_args(words[1:])


def check_benchmark(words: list[str]) -> None:
    """Check that the module of ``python -m MODULE`` exists, and that its files contain each option."""
    module, *options = words[2:]
    source = importlib.util.find_spec(module)
    assert source is not None
    assert source.origin is not None
    files = Path(source.origin).parent.glob("*.py") if source.submodule_search_locations else [Path(source.origin)]
    text = "".join(file.read_text(encoding="utf-8") for file in files)
    assert all(f'"{word}"' in text for word in options if word.startswith("--")), options


def check_make(words: list[str]) -> None:
    """Check that the Makefile has the target and the variables."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(rf"^{re.escape(words[1])}:", text, re.MULTILINE)
    assert all(re.search(rf"\b{word.partition('=')[0]}\b", text) for word in words[2:])


def check_node(words: list[str]) -> None:
    """Check that a node has these parameters with these values, and the renamed topics."""
    node = NODES[words[0]]
    table = {parameter.name: parameter for parameter in node.PARAMETERS}
    for option, word in pairwise(words):
        if option == "-p":
            name, _, value = word.partition(":=")
            table[name].checked(yaml.safe_load(value))
        elif option == "-r":
            assert f"/{word.partition(':=')[0]}" in topics_of(words[0]), word


def topics_of(name: str) -> set[str]:
    """Return the topics and services of a node, from its help."""
    lines = re.findall(r"^(?:in |out|ask|   )  ([~\w/]+(?:, [~\w/]+)*)", NODES[name].TOPICS, re.MULTILINE)
    return {absolute(topic, name) for line in lines for topic in line.split(", ")}


def absolute(topic: str, node: str) -> str:
    return "/" + topic.replace("~", node).lstrip("/")


def test_the_page_of_the_nodes_has_the_topics_of_their_help():
    """The bridge has its own page; /diagnostics, which every node has, is in the table only where its row says more."""
    table = (ROOT / "doc" / "nodes.md").read_text(encoding="utf-8").partition("|---|")[2].partition("\n\n")[0]
    found, node = {name: {"/diagnostics"} for name in NODES}, ""
    for row in table.splitlines()[1:]:
        _, first, topics, *_ = row.split("|")
        node = first.split()[0] if first.strip() else node
        found[node] |= {absolute(topic, node) for topic in re.findall(r"`(.+?)`", topics)}
    for name in NODES.keys() - {"linuxcnc_bridge"}:
        assert found[name] == topics_of(name), name


def check_ros(words: list[str]) -> None:
    """Check topics, services, parameters and launch arguments of ROS's tools; other tools have only a node's name."""
    kind, verb, *rest = words[1:]
    if kind == "launch":
        with pytest.MonkeyPatch.context() as patch:
            known = set(LaunchFile(patch).defaults)
        assert verb == "hexapod_comp"
        assert rest.pop(0) == "machine.launch.py"
        assert {word.partition(":=")[0] for word in rest} <= known
    elif kind == "run" and verb == "hexapod_comp":
        check_node(rest)
    elif kind == "topic":
        topic = next(word for word in rest if word.startswith("/"))
        assert verb in ("echo", "hz", "delay", "pub")
        assert topic in set(OURS_ELSEWHERE).union(*map(topics_of, NODES))
    elif kind == "service":
        node, service = rest[0].strip("/").split("/")
        assert verb == "call"
        assert re.search(rf"~/{service}\b", NODES[node].TOPICS), rest[0]
        assert rest[1].rpartition("/")[2] in NODES[node].TOPICS
    elif kind == "param":
        table = {parameter.name: parameter for parameter in NODES[rest[0].strip("/")].PARAMETERS}
        if verb == "set":
            table[rest[1]].checked(yaml.safe_load(rest[2]))
            assert table[rest[1]].taken in (Taken.ALWAYS, Taken.RELOAD)
        elif verb == "describe":
            assert rest[1] in table
    else:
        assert kind in ("lifecycle", "security", "pkg", "run")


CHECKS: dict[str, Callable[[list[str]], None]] = {
    "hexapod_comp": check_verb,
    "python": check_benchmark,
    "make": check_make,
    "ros2": check_ros,
    **dict.fromkeys(NODES, check_node),
}
COMMANDS = list(commands())


def test_all_programs_are_known() -> None:
    unused = {"instrument", "adapter", "mover", "linuxcnc_bridge"}  # no page starts them by this name alone
    assert {c.words[0] for c in COMMANDS} - OTHERS == CHECKS.keys() - unused


@pytest.mark.parametrize(
    "command", [c for c in COMMANDS if c.words[0] in CHECKS], ids=lambda c: f"{c.place} {' '.join(c.words)[:60]}"
)
def test_what_a_command_names_is_there(command: Command) -> None:
    CHECKS[command.words[0]](command.words)


LONG = pytest.mark.skipif(not os.environ.get("LONG_TESTS"), reason="minutes: make test-docs runs it (LONG_TESTS=1)")

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?")


def sessions(page: Path) -> list[tuple[str, list[str], list[str]]]:
    """Return a page's sessions, each as the command's place, its words, and the lines shown of its output."""
    found: list[tuple[str, list[str], list[str]]] = []
    for line, text in blocks(page):
        if not text.startswith("$ hexapod_comp"):
            continue
        for number, row in enumerate(text.splitlines()):
            if row.startswith("$ "):
                words = shlex.split(re.sub(r"\s+#.*", "", row.removeprefix("$ ")))
                found.append((f"{page.relative_to(ROOT)}:{line + number}", words, []))
            elif row.strip() not in ("", "…"):
                found[-1][2].append(row)
    return found


def same(shown: str, printed: str) -> bool:
    """Return whether a shown line equals a printed line up to the last digits of numbers; ``…`` matches anything."""
    begins, *rest = shown.split("…")
    texts = [" ".join(NUMBER.sub("0", line).split()) for line in (begins, printed)]
    numbers = [NUMBER.findall(line) for line in (begins, printed)]
    alike = texts[1].startswith(texts[0]) if rest else texts[0] == texts[1]
    return alike and all(close(a, b) for a, b in zip(*numbers, strict=not rest))


def close(shown: str, printed: str) -> bool:
    digits = len(shown.partition(".")[2]) if "e" not in shown else 0
    a, b = float(shown), float(printed)
    return abs(a - b) <= max(2.0 * 10.0**-digits, 0.02 * abs(a)) if digits else abs(a - b) <= max(1.0, 0.02 * abs(a))


def prepare(page: Path, folder: Path) -> None:
    """Write the files that a page assumes: the reader's machine, and campaigns that the page prints."""
    machine = config_file("example_6_6.yaml").read_text(encoding="utf-8")
    (folder / "mine.yaml").write_text(machine.replace("machine: example_6_6", "machine: mine"), encoding="utf-8")
    for block in BLOCK.finditer(page.read_text(encoding="utf-8")):
        if name := re.search(r"^format: hexapod_comp/campaign +# (\w+\.yaml)$", block[3], re.MULTILINE):
            (folder / name[1]).write_text(block[3], encoding="utf-8")


# Verbs whose sessions need more than the page's earlier commands
IN_WORDS = {"verify": "of a machine that has changed, which its page describes in words"}


def run_session(page: Path, folder: Path) -> list[str]:
    """Run a page's sessions in order in a folder; return the shown lines that were not printed."""
    prepare(page, folder)
    wrong = []
    for place, words, shown in sessions(page):
        if words[1] in IN_WORDS:
            continue
        program = [sys.executable, "-m", "hexapod_comp", *words[1:]]
        ran = subprocess.run(program, cwd=folder, capture_output=True, text=True, encoding="utf-8")
        printed = (ran.stdout + ran.stderr).splitlines()
        for line in shown:
            if not any(same(line, other) for other in printed):
                wrong.append(f"{place}: {line}")
    return wrong


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Provide a folder with readings and model of doc/calibration.md, with which other pages continue."""
    folder = tmp_path_factory.mktemp("pages")
    page = "doc/calibration.md"
    rows = [c.words for c in COMMANDS if c.place.startswith(page) and c.words[0] == "hexapod_comp"]
    for verb in ("simulate", "fit"):
        words = next(words for words in rows if words[1] == verb)
        subprocess.run([sys.executable, "-m", *words], cwd=folder, capture_output=True, check=True)
    return folder


@LONG
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", [page for page in PAGES if sessions(page)], ids=lambda page: page.name)
def test_sessions_print_what_their_page_shows(page: Path, calibrated: Path, tmp_path: Path) -> None:
    shutil.copytree(calibrated, tmp_path, dirs_exist_ok=True)
    assert not (wrong := run_session(page, tmp_path)), "\n".join(wrong)
