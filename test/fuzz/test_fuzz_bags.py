"""Mutated recordings through ``replay``: a verdict, or exit code 2 and words for people.

Truth: what is not touched replays to the same bits.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzzing import COUNTS, cases, edits, mutated
from hypothesis import example, given
from hypothesis import strategies as st

pytest.importorskip("rosbags")

from replay_helpers import RecordedMachine, write_bag
from test_fuzz_commands import command

# Bits that are turned: (place, bit)
flips = st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 7)), min_size=1, max_size=3)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    machine = RecordedMachine()
    machine.wave(30)
    machine.page()
    folder = write_bag(tmp_path_factory.mktemp("bags") / "run", machine.messages)
    return next(folder.glob("*.mcap"))


@given(changes=edits)
@example(changes=[])
@cases(15, 0.005)
def test_mutated_bags(bag: Path, changes: list) -> None:
    path = bag.with_name("mutated.mcap")
    path.write_bytes(mutated(bag.read_bytes(), changes))
    COUNTS["bags"] += 1
    code, _, said = command("replay", str(path))
    assert changes or code == 0, said


@given(places=flips)
@cases(15, 0.005)
def test_flipped_bits(bag: Path, places: list) -> None:
    data = bytearray(bag.read_bytes())
    for place, bit in places:
        data[place % len(data)] ^= 1 << bit
    path = bag.with_name("flipped.mcap")
    path.write_bytes(data)
    COUNTS["bags"] += 1
    command("replay", str(path))
