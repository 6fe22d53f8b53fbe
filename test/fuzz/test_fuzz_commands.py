"""The command line with mutated files, recordings and arguments: it gives a result, or exit code 2 and a message.

test_fuzz_files.py checks what is read from a file; the tests here check that a verb handles every accepted file.
"""

from __future__ import annotations

import contextlib
import io
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzzing import COUNTS, NASTY_NUMBERS, NASTY_TEXTS, cases, check_message, edits, mutated
from hypothesis import example, given
from hypothesis import strategies as st
from replay_helpers import RecordedMachine, write_bag
from test_fuzz_files import CONFIG, SEEDS

from hexapod_comp import cli


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    made = tmp_path_factory.mktemp("commands")
    for name in ("model.yaml", "poses.csv", "lengths.csv", "tidy.csv", "campaign.yaml"):
        (made / name).write_bytes(SEEDS[name])
    for name in ("paper", "jugglebot_columns", "error_budget", "positioning_unit"):
        shutil.copy(CONFIG / f"{name}.yaml", made)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)  # invalid names may become files in this folder
        yield made


def command(*arguments: str) -> tuple[int, str, str]:
    """Run the command line here; return exit code, stdout and stderr after checking that messages are readable."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(arguments)
    said = err.getvalue()
    assert code in (0, 1, 2), said
    assert "Traceback" not in said
    if code == 2:
        ours = said.partition("hexapod_comp: error: ")[2].removesuffix("\n")
        assert ours or "error: " in said, said  # messages of argparse repeat what was typed
        if ours and not ours.startswith("unrecognized arguments"):
            check_message(ours)
    return code, out.getvalue(), said


# A line has a verb, the file that is mutated, and the other arguments, which name files of the folder
COMMANDS = SEEDS["commands.txt"].decode().splitlines()


@pytest.mark.parametrize("line", COMMANDS)
@given(changes=edits)
@example(changes=[])
@cases(4, 0.002)
def test_mutated_files(folder: Path, line: str, changes: list) -> None:
    verb, name, *rest = line.split()
    original = (folder / name).read_bytes()
    data = mutated(original, changes)
    changed = folder / f"x_{name}"
    changed.write_bytes(data)
    arguments = [str(changed) if word == name else word for word in rest]  # the other files are in this folder
    if name not in rest:
        arguments.insert(0, str(changed))
    COUNTS["commands"] += 1
    code, out, _ = command(verb, *arguments)
    if code != 2:
        COUNTS["commands accepted"] += 1
        assert out.strip()


# Verbs and options that get invalid values; a missing file prevents the slow verbs from starting
OPTIONS = {verb: options for verb, *options in map(str.split, SEEDS["options.txt"].decode().splitlines())}

words = st.one_of(
    st.sampled_from([word for word in (*NASTY_NUMBERS, *NASTY_TEXTS) if "\0" not in word and "\ud800" not in word]),
    st.lists(st.sampled_from(("0", "1", "400", "-5", "nan", "1e308", "", "x")), min_size=1, max_size=7).map(",".join),
    st.floats().map(repr),
    st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=5),
)


@pytest.mark.parametrize("verb", OPTIONS)
@given(place=st.integers(0, 20), value=words, other=st.one_of(st.none(), st.tuples(st.integers(0, 20), words)))
@cases(4, 0.001)
def test_nonsense_options(folder: Path, verb: str, place: int, value: str, other: tuple[int, str] | None) -> None:
    options = OPTIONS[verb]
    arguments = [verb, options[place % len(options)], value]
    if other is not None:
        arguments += [options[other[0] % len(options)], other[1]]
    if verb not in ("ik", "fk", "demo", "imagine"):
        arguments.append("no_such_file.csv")
    if verb in ("imagine", "simulate", "export", "classify", "demo"):
        arguments += ["--machine", "no_such_machine"]
    COUNTS["options"] += 1
    command(*arguments)


# ---- recordings ----

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    machine = RecordedMachine()
    machine.wave(30)
    machine.page()
    folder = write_bag(tmp_path_factory.mktemp("bags") / "run", machine.messages)
    return next(folder.glob("*.mcap"))


@given(changes=edits, flips=st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 7)), max_size=3))
@example(changes=[], flips=[])
@cases(12, 0.01)
def test_mutated_bags(bag: Path, changes: list, flips: list) -> None:
    """The recording is edited or has bits flipped; unchanged it replays to the same bits."""
    data = bytearray(bag.read_bytes() if flips else mutated(bag.read_bytes(), changes))
    for place, bit in flips:
        data[place % len(data)] ^= 1 << bit
    path = bag.with_name("mutated.mcap")
    path.write_bytes(data)
    COUNTS["bags"] += 1
    code, _, said = command("replay", str(path))
    assert changes or flips or code == 0, said
