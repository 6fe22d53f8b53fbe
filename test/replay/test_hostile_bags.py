"""Recordings from strangers: false metadata, special files and false journals are refused with a message, at once.

No recorder writes such files. If a journal is not refused, the test checks only that its replay ends without a
traceback.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import places, put

pytest.importorskip("rosbags")

from replay_helpers import STORE, RecordedMachine, serialized, write_bag

from hexapod_comp.compensation.journal import Source
from hexapod_comp.errors import HexapodError, InputFileError
from hexapod_comp.machine.model import MachineModel
from hexapod_comp.replay.bag import FILES, JOURNAL, Files, _Collected, read_recording
from hexapod_comp.replay.replay import replay_recording, what_if
from hexapod_comp.replay.report import Report, rows_of

VALUES = [[], {}, None, "\x1b[2J", 1e308, {"a": [1.0]}]


@pytest.fixture(scope="module")
def machine() -> RecordedMachine:
    made = RecordedMachine()
    made.wave(5)
    made.page()
    return made


@pytest.fixture
def bag(tmp_path: Path, machine: RecordedMachine) -> Path:
    return write_bag(tmp_path / "run", machine.messages)


def test_any_value_in_any_place_of_the_metadata(bag: Path) -> None:
    file = bag / "metadata.yaml"
    tree = yaml.safe_load(file.read_text())
    for at in places(tree):
        for value in VALUES[::2]:
            file.write_text(yaml.dump(put(tree, at, value), Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper)))
            try:
                read_recording(bag)
            except HexapodError:
                continue
            except Exception as error:
                raise AssertionError((at, value)) from error


ALIASES = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join([f'*{chr(97 + n)}'] * 9)}]\n" for n in range(12)
)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (ALIASES, r"metadata\.yaml: line 2: is not valid YAML: reference \*a"),
        ("[]", "must be a mapping"),
        ("a: !!python/object/apply:os.system ['true']", "tag"),
        (None, "larger than the allowed 4 MB"),
    ],
)
def test_metadata_that_stand_for_more_than_they_say(bag: Path, content: str | None, said: str) -> None:
    """A kilobyte of YAML references was expanded without end, and 200 MB were read, before they were refused."""
    file = bag / "metadata.yaml"
    if content is None:
        os.truncate(file, 1 << 40)  # sparse
    else:
        file.write_text(content)
    with pytest.raises(InputFileError, match=said):
        read_recording(bag)


def test_metadata_that_do_not_fit_the_files(bag: Path) -> None:
    file = bag / "metadata.yaml"
    tree = yaml.safe_load(file.read_text())
    for changes, said in (
        ({"relative_file_paths": ["gone.mcap"]}, "relative_file_paths: there is no file gone.mcap"),
        ({"compression_mode": "FILE", "compression_format": "lz4"}, "compression_format: must be zstd"),
    ):
        file.write_text(
            yaml.safe_dump({"rosbag2_bagfile_information": {**tree["rosbag2_bagfile_information"], **changes}})
        )
        with pytest.raises(InputFileError, match=said):
            read_recording(bag)


@pytest.mark.parametrize("place", ["metadata.yaml", "run.mcap", "alone.mcap"])
def test_nothing_is_waited_for_in_a_fifo(bag: Path, place: str) -> None:
    """A FIFO as metadata, as storage, beside them, or given by itself is refused without waiting."""
    file = bag / place
    file.unlink(missing_ok=True)
    os.mkfifo(file)
    with pytest.raises(InputFileError, match=r"regular file|must be a bag"):
        read_recording(file if place == "alone.mcap" else bag)


def test_any_value_in_any_place_of_the_journal(machine: RecordedMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is read, replayed with its own and another model, and shown; or refused with a message."""
    ends = {JOURNAL: "/journal", FILES: "/files"}
    texts = [
        (name, time, STORE.deserialize_cdr(raw, kind).data)
        for time, topic, kind, raw in machine.messages
        for name, end in ends.items()
        if topic.endswith(end)
    ]

    def replayed(now: list[tuple[str, int, str]]) -> None:
        collected = _Collected("bag", "/compensator")
        for name, time, content in now:
            collected.add_text(name, time, content)
        recording = collected.recording([], 0)
        report = Report(recording, replay_recording(recording, Files(recording, {})), tolerance=1e-6)
        report.shown(), list(rows_of(report))
        what_if(recording, machine.geometry, MachineModel(machine.geometry.name))

    monkeypatch.setattr(Source, "geometry", lambda source: machine.geometry)  # reading both takes most of the time
    monkeypatch.setattr(Source, "model", lambda source, name: machine.compensator.model)
    replayed(texts)
    read = 0
    with np.errstate(over="ignore", invalid="ignore"):
        for n in (0, len(texts) - 1):
            name, time, content = texts[n]
            tree = json.loads(content)
            for at in places(tree):
                for value in VALUES:
                    other = [*texts[:n], (name, time, json.dumps(put(tree, at, value))), *texts[n + 1 :]]
                    try:
                        replayed(other)
                        read += 1
                    except HexapodError:
                        continue
                    except Exception as error:
                        raise AssertionError((at, value)) from error
    assert read > 10, "some places hold words for people"


def test_a_journal_of_short_lists_is_refused_before_it_is_made(bag: Path, machine: RecordedMachine) -> None:
    messages = list(machine.messages)
    time, topic, kind, _ = next(one for one in messages if one[1].endswith("/journal"))
    long = json.dumps({"journal": 5, "x": "[]" * 5_000_000})
    messages.append((time, topic, kind, serialized(kind, STORE.types[kind](long))))
    with pytest.raises(InputFileError, match=r"journal at .*at most 8000000 are allowed"):
        read_recording(write_bag(bag.with_name("long"), messages))
