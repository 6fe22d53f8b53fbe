"""Recordings and their replay without ROS: what is replayed, what is lost, and which bags are refused.

A compensator that keeps its journal like the node makes the recordings; the truth is the numbers that it computed. The
tests damage messages, or bytes of the bag.
"""

from __future__ import annotations

import base64
import contextlib
import csv
import json
import shutil
import sqlite3
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rosbags")

import lz4.frame
from helpers import beside, quick_pictures
from replay_helpers import (
    BEGAN,
    CONFIG,
    MILLISECOND,
    STORE,
    TYPES,
    Messages,
    RecordedMachine,
    serialized,
    wave_pose,
    write_bag,
)
from rosbags.rosbag2 import CompressionMode

from hexapod_comp.cli import main, running
from hexapod_comp.cli.app import make_parser
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.journal import (
    COMMAND,
    FORMAT,
    JournalError,
    Source,
    read_page,
    read_sources,
    sources_text,
)
from hexapod_comp.errors import HexapodError, InputFileError, ModelError
from hexapod_comp.formats.files import MEGABYTE
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.pose import Pose
from hexapod_comp.replay import storage
from hexapod_comp.replay.bag import Recording, Series, read_recording
from hexapod_comp.replay.replay import BEFORE, DIFFERENT, IDENTICAL, LOST, Replay, replay_recording
from hexapod_comp.replay.report import Report, following_error

PERIOD = 4 * MILLISECOND  # between two commands of the run
FAR = Pose([0.2, 0.0, 0.4], np.eye(3))  # refused: struts would change by 90 mm in one command

JOINT_STATE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"


def warm_model(folder: Path) -> Path:
    """Write the shipped machine's model with growth, so that temperatures and humidity have an effect."""
    model = load_model(CONFIG / "paper_machine.yaml", load_geometry(CONFIG / "paper.yaml"))
    struts = replace(model.struts, expansion=np.full(6, 11e-6), moisture=np.full(6, 2e-4))
    save_model(replace(model, struts=struts, base_expansion=12e-6), folder / "warm.yaml")
    return folder / "warm.yaml"


def full_run(folder: Path) -> RecordedMachine:
    """Return a run of 300 commands at 250 Hz with all kinds of events; every 5 a page, every 25 with a snapshot."""
    machine = RecordedMachine("", warm_model(folder))
    machine.period = PERIOD
    core = machine.compensator
    happenings: dict[int, Callable[[], object]] = {
        37: lambda: core.set_temperature("strut_1", 23.4),
        38: lambda: core.set_temperature("base", 21.1),
        39: lambda: core.set_humidity(0.63),
        87: lambda: core.enable(False),
        162: lambda: core.enable(True),
        225: lambda: core.reset(core.command + 1e-6),
        237: lambda: core.set_model(machine.load(CONFIG / "paper_machine.yaml")),
        250: lambda: machine.send(FAR),
        251: lambda: core.reset(),
    }
    for n in range(300):
        happenings.get(n, lambda: None)()
        assert machine.send(wave_pose(4 * n))
        if n % 5 == 4:
            machine.page(snapshot=n % 25 == 24)
    return machine


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedMachine:
    return full_run(tmp_path_factory.mktemp("model"))


def opened(bag: Path, namespace: str | None = None) -> tuple[Recording, Replay]:
    """Read a bag and replay it, with progress per message and per command."""
    read, replayed = list[int](), list[int]()
    recording = read_recording(bag, namespace, read.append)
    result = replay_recording(recording, None, replayed.append)
    assert {*read, *replayed} == {1}
    assert len(replayed) == len(recording.commands)
    return recording, result


def counted(result: Replay) -> dict[int, int]:
    """Return the number of commands of each outcome."""
    values, counts = np.unique(result.outcome, return_counts=True)
    return dict(zip(values.tolist(), counts.tolist(), strict=True))


def of_topic(messages: Messages, ending: str) -> list[int]:
    """Return the numbers of a topic's messages."""
    return [n for n, message in enumerate(messages) if message[1].endswith(ending)]


def without(messages: Messages, *numbers: int) -> Messages:
    """Return messages without some of them."""
    return [message for n, message in enumerate(messages) if n not in numbers]


def call(*arguments: object) -> int:
    """Call the verb like the command line, except that errors are raised."""
    args = make_parser().parse_args(["replay", *map(str, arguments)])
    return running.replay(args).finish(args)


# ---- the same bits ----


COMPRESSED = [
    ("mcap", CompressionMode.STORAGE),
    ("mcap", CompressionMode.MESSAGE),
    ("mcap", CompressionMode.FILE),
    ("sqlite3", CompressionMode.MESSAGE),
    ("sqlite3", CompressionMode.FILE),
]
PLAIN = [("mcap", CompressionMode.NONE), ("sqlite3", CompressionMode.NONE)]


@pytest.mark.parametrize(("storage", "mode"), PLAIN + COMPRESSED)
def test_everything_comes_back_bit_for_bit(run, tmp_path, storage, mode):
    """The truth is the compensator's answers during the recording, not the answers in the bag."""
    recording, result = opened(write_bag(tmp_path / "run", run.messages, storage, mode))
    assert counted(result) == {IDENTICAL: 300}
    assert result.lengths.tobytes() == np.array(run.answers).tobytes()
    assert not result.states_differ
    assert not result.lost
    whats = ["temperature", "temperature", "humidity", "enable", "enable", "reset", "model", "reset"]
    assert [event.entry.what for event in result.changes] == whats
    assert [event.row for event in result.changes] == [37, 38, 39, 87, 162, 225, 237, 251]
    assert [(event.row, event.entry.values["reason"]) for event in result.refused] == [(250, "step")]
    assert (recording.recorded, recording.notes) == (301, [])


def altered(messages: Messages, number: int, change: Callable[[dict], None]) -> Messages:
    """Return messages with changed content of one page of the journal."""
    messages, place = list(messages), of_topic(messages, "journal")[number]
    time, topic, kind, raw = messages[place]
    page = json.loads(STORE.deserialize_cdr(raw, kind).data)
    change(page)
    messages[place] = time, topic, kind, serialized(kind, TYPES[TEXT](json.dumps(page)))
    return messages


@pytest.mark.parametrize(("kind", "name"), [(0, "command"), (1, "correction")])
def test_replay_sees_a_difference_of_one_bit(run, tmp_path, capsys, kind, name):
    """One number is changed to its neighbouring float; no other number may be reported as different."""

    def move(page: dict) -> None:
        answers = np.frombuffer(base64.b64decode(page["answers"]), COMMAND).copy()
        value = answers["lengths"][2, kind, 3]
        answers["lengths"][2, kind, 3] = np.nextafter(value, 1.0)
        page["answers"] = base64.b64encode(answers.tobytes()).decode()

    bag = write_bag(tmp_path / "run", altered(run.messages, 36, move))  # page 0 is empty, others have 5 answers
    recording, result = opened(bag)
    assert counted(result) == {IDENTICAL: 299, DIFFERENT: 1}
    assert result.outcome[177] == DIFFERENT

    def made(page: dict) -> None:
        page["snapshot"]["made_with"]["numpy"] = "0.1"

    bag = write_bag(tmp_path / "old", altered(altered(run.messages, 36, move), 0, made))
    assert call(bag) == 1
    said = capsys.readouterr().out
    assert f"\nthe difference may be rounding; recorded with numpy 0.1, here {np.__version__}\n" in said
    stamp = int(recording.commands["stamp"][177])
    assert f"stamp {stamp // 10**9}.{stamp % 10**9:09d}" in said
    assert f"strut_4, {name} recorded" in said
    assert call(bag, "--tolerance-um", "1e-6") == 0


def test_a_change_that_the_journal_hides_is_found(run, tmp_path):
    """A temperature in the journal is changed by 1 K: all answers until the next snapshot differ."""

    def warm(page: dict) -> None:
        (entry,) = [entry for entry in page["entries"] if entry.get("name") == "strut_1"]
        entry["value"] += 1.0

    _, result = opened(write_bag(tmp_path / "run", altered(run.messages, 8, warm)))
    different = np.flatnonzero(result.outcome == DIFFERENT)
    assert 37 <= different[0] < 39
    assert different[-1] < 50
    assert result.states_differ == [50]


def test_stamps_need_not_tell_commands_apart(tmp_path):
    """Commands without stamps, with equal stamps, equal commands, refused ones: their order identifies them."""
    machine = RecordedMachine()
    for n in range(60):
        machine.send(wave_pose(n), stamped=n % 2 == 0)
        if n % 3 == 1:
            machine.now -= MILLISECOND
            machine.send(FAR if n % 2 else wave_pose(n))
            machine.now -= MILLISECOND
            machine.send(wave_pose(n + 1), frame="work" if n % 4 else "base")
    machine.page()
    _, result = opened(write_bag(tmp_path / "run", machine.messages))
    assert counted(result) == {IDENTICAL: len(machine.answers)}
    assert [event.entry.values["reason"] for event in result.refused] == ["step"] * 10


def test_a_node_that_is_restarted_begins_anew(tmp_path):
    """A bag may hold two lives of a node: counts and state begin again with the second."""
    first, second = RecordedMachine(), RecordedMachine()
    first.wave(120)
    first.page()
    second.messages.clear()
    second.now = first.now + 700 * MILLISECOND
    second.page()
    second.wave(80, 40)
    second.page()
    _, result = opened(write_bag(tmp_path / "run", first.messages + second.messages))
    assert counted(result) == {IDENTICAL: 200}


def test_a_snapshot_that_is_not_whole_is_refused_and_changes_nothing():
    one = RecordedMachine()
    other = Compensator(one.geometry, one.compensator.model)
    before, whole = repr(other.snapshot()), one.compensator.snapshot()
    for change, complaint in (
        ({"nominal": [1.0]}, r"snapshot\.nominal: must be 6 numbers"),
        ({"speed": [1.0]}, r"snapshot\.speed: is unknown to this release"),
        ({"enabled": [np.nan]}, r"snapshot\.enabled: must be a whole number, 0…1 \(found nan\)"),
        ({"resumes": [3.0]}, r"snapshot\.resumes: must be a whole number, 0…2 \(found 3"),
        ({"temperatures": {"strut_7": 20.0}}, "temperature: the measured part must be one of"),
    ):
        with pytest.raises(ModelError, match=complaint):
            other.restore(whole | change)
    for name in whole:
        with pytest.raises(ModelError, match=rf"snapshot\.{name}: is missing"):
            other.restore({key: value for key, value in whole.items() if key != name})
    assert repr(other.snapshot()) == before
    page = json.loads(one.journal.page(1e9))
    page["snapshot"]["state"]["lags"] = {"platform": None}
    with pytest.raises(JournalError, match="not a page of the journal: 'NoneType' object is not iterable"):
        read_page(json.dumps(page))


def test_a_snapshot_has_the_keys_of_its_version() -> None:
    """If this fails, older recordings cannot be read: raise FORMAT, and list the keys of the new version."""
    keys = """ahead_by_receipt ahead_by_stamp changed command correction drift enabled lags loading model_position
        model_rotation motion_low motion_sense nominal outside platform_position platform_rotation published ramp
        ramp_rate received resumes smooth_speed temperatures time tool"""
    assert (FORMAT, sorted(RecordedMachine().compensator.snapshot())) == (5, keys.split())


def test_journal_stays_short_when_something_goes_wrong_very_often():
    """Refused first commands reset each time, and commands may be refused at 1 kHz; the journal must stay short."""
    machine = RecordedMachine()
    for _ in range(300):
        machine.compensator.reset(np.full(6, 0.5))
    for n in range(300):
        machine.journal.refused(n, "step", "too far")
    page = read_page(machine.journal.page(0.0))
    assert [entry.what for entry in page.entries] == ["reset"] + ["refused"] * 20
    assert page.refused_more == 280
    journal, due = machine.journal, []
    for now in (10.0, 10.39, 10.4):  # a snapshot is due every 0.4 s
        due.append((journal.due(now), read_page(journal.page(now)).snapshot is not None))
    assert due == [(True, True), (False, False), (True, True)]


# ---- losses of a recorder ----


def test_recording_that_begins_in_motion_is_replayed_from_its_first_snapshot(run, tmp_path, capsys):
    """A late recorder gets earlier pages and, after a while, the next snapshot; of a machine at rest it needs none."""
    first = of_topic(run.messages, "journal")[22]
    kept = run.messages[of_topic(run.messages, "files")[4]]
    bag = write_bag(tmp_path / "run", [kept, *run.messages[first:]])
    recording, result = opened(bag)
    assert call(bag) == 0
    assert "\nnot compared: 20 answers before the journal's first snapshot\n" in capsys.readouterr().out
    assert counted(result) == {BEFORE: 20, IDENTICAL: 175}
    assert (result.outcome[:20] == BEFORE).all()
    assert not result.lost
    assert recording.recorded == 301 - 110
    last = of_topic(run.messages, "journal")[20]
    kept_too = [kept, run.messages[last]]
    assert counted(opened(write_bag(tmp_path / "rest", kept_too + run.messages[last + 1 :]))[1]) == {
        BEFORE: 5,
        IDENTICAL: 200,
    }


@pytest.mark.parametrize(("lost", "silent"), [([3], 2), ([5], 5), ([24, 51], 1 + 4), ([60], 0)])
def test_what_the_recorder_has_lost_is_never_called_a_difference(run, tmp_path, capsys, lost, silent):
    """Commands between a lost page and the next snapshot are counted but not compared; all others are identical.

    The snapshot after page 24 is of a compensation that ramps out."""
    # Page 0 is empty, each other page holds 5 answers; page 0 and every fifth page end with a snapshot. So after the
    # loss of page 3, pages 4 and 5 are `silent`.
    pages = of_topic(run.messages, "journal")
    messages = without(run.messages, *(pages[n] for n in lost))
    bag = write_bag(tmp_path / "run", messages)
    _, result = opened(bag)
    found = counted(result)
    assert DIFFERENT not in found
    assert not result.states_differ
    assert found.get(LOST, 0) == 5 * silent
    assert found[IDENTICAL] == 300 - 5 * (silent + len(lost))
    assert call(bag) == 0
    said = capsys.readouterr().out
    if lost == [60]:  # as if the node is killed: the commands since its last page are on their topic alone
        assert result.lost == 0
        assert "296 commands handled, 295 answered, 1 refused; 301 recorded" in said
    else:
        assert result.lost == 5 * len(lost)
        assert f"lost: {result.lost} answers in pages of the journal that the recorder did not receive" in said


def test_pages_that_come_twice_or_late_do_no_harm(run, tmp_path):
    """A recorder that joins twice gets old pages again, and two recordings may have been merged."""
    pages = of_topic(run.messages, "journal")
    messages = list(run.messages)
    messages += [(BEGAN + 5_000 * MILLISECOND, *run.messages[n][1:]) for n in pages[-10:]]
    early = run.messages[pages[30]]
    messages[pages[30]] = (early[0] + 300 * MILLISECOND, *early[1:])
    _, result = opened(write_bag(tmp_path / "run", sorted(messages, key=lambda message: message[0])))
    assert counted(result) == {IDENTICAL: 300}


def test_bytes_that_rclpy_appends_are_no_part_of_a_message(run, tmp_path):
    """rclpy's serialize_message appends up to four meaningless bytes."""
    messages = [(*message[:3], message[3] + b"\0\0\0\0") for message in run.messages]
    assert counted(opened(write_bag(tmp_path / "run", messages))[1]) == {IDENTICAL: 300}


def test_the_journal_is_enough_and_other_topics_do_not_disturb(run, tmp_path):
    """The replay works without commands and answers, with struts in another order, and with a topic of unknown type."""
    messages = [message for message in run.messages if "compensator/" in message[1]]
    names = [f"strut_{n}" for n in (6, 5, 4, 3, 2, 1)]
    for n, broken in enumerate((False, True)):
        numbers = np.arange(6.0 - broken)
        message = TYPES[JOINT_STATE](RecordedMachine().header(BEGAN), names, numbers, np.zeros(0), np.zeros(0))
        messages.append((BEGAN + n, "/strut_states", JOINT_STATE, serialized(JOINT_STATE, message)))
    messages.append((BEGAN, "/other/journal", "std_msgs/msg/Header", b"\0\1\0\0"))
    recording, result = opened(write_bag(tmp_path / "run", messages))
    assert counted(result) == {IDENTICAL: 300}
    assert recording.recorded == 0
    assert recording.topics["strut_states"].values.tolist() == [[5.0, 4.0, 3.0, 2.0, 1.0, 0.0]]
    assert "1 messages of strut_states were left out" in recording.notes[0]


def test_folder_of_a_killed_recorder_is_read_without_metadata(run, tmp_path):
    """Only metadata.yaml is missing, and the bag is split into two files."""
    folder = tmp_path / "run"
    folder.mkdir()
    for name, part in (("a", run.messages[:200]), ("b", run.messages[200:])):
        bag = write_bag(tmp_path / name, part)
        shutil.move(bag / f"{name}.mcap", folder)
    recording, result = opened(folder)
    assert counted(result) == {IDENTICAL: 300}
    assert "metadata.yaml is missing" in recording.notes[0]


def test_bag_of_an_older_recorder(run, tmp_path):
    """Until ROS 2 Humble sqlite bags had neither message definitions nor tables about themselves."""
    (file,) = write_bag(tmp_path / "run", run.messages, "sqlite3").glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        for table in ("schema", "metadata", "message_definitions"):
            database.execute(f"DROP TABLE {table}")
        database.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
    _, result = opened(file)
    assert counted(result) == {IDENTICAL: 300}


# ---- with another model ----


def offset_model(folder: Path, offset_um: float) -> Path:
    """Write a model whose struts are all too long by an offset."""
    data = {"format": "hexapod_comp/model", "version": 1, "machine": "paper", "name": "all too long"}
    data |= {"date": "2026-01-31", "sources": [], "struts": {"offset_um": offset_um}}
    path = folder / "offset.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def test_another_model_shows_what_it_would_have_corrected(tmp_path, capsys):
    """The recording has no model and corrections of zero; struts too long by 30 µm are commanded 30 µm shorter."""
    # a difference of lengths below a metre is exact to 1e-16 m
    machine = RecordedMachine(model=offset_model(tmp_path, 0.0))
    machine.wave(50)
    machine.page()
    bag = write_bag(tmp_path / "run", machine.messages)
    model = offset_model(tmp_path, 30.0)
    assert call(bag, "--model", model, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["outcomes"]["identical"] == 50
    np.testing.assert_allclose(told["other"]["largest_difference_m"], 30e-6, rtol=0.0, atol=1e-15)
    assert call(bag, "--model", model, "--out", tmp_path / "run.csv") == 0
    with open(tmp_path / "run.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 50
    assert {row["other_L3_um"] for row in rows} == {"-30.000000"}
    assert {row["outcome"] for row in rows} == {"identical"}
    said = capsys.readouterr().out
    assert "model all too long" in said
    rows = [line.split() for line in said.splitlines() if line.startswith("strut_")]
    assert rows == [[f"strut_{n}", "30.000", "30.000"] for n in range(1, 7)], "RMS and largest"


def test_bag_without_files_asks_for_them(tmp_path, capsys):
    """A bag has only the hashes of geometry and model, so the user must give the files."""
    machine = RecordedMachine()
    machine.wave(40)
    machine.page()
    messages = [message for message in machine.messages if not message[1].endswith("files")]
    bag = write_bag(tmp_path / "run", messages)
    with pytest.raises(InputFileError, match=r"does not contain the machine 'paper'.*--machine"):
        call(bag)
    with pytest.raises(InputFileError, match=r"does not contain the model 'virtual machine'.*--model"):
        call(bag, "--machine", "paper")
    assert call(bag, "--machine", "paper", "--model", "paper_machine") == 0
    assert "identical bit for bit" in capsys.readouterr().out
    assert call(bag, "--machine", "paper", "--model", "paper_lines_model") == 0
    assert "corrections differ" in capsys.readouterr().out


# ---- the verb's output ----


def test_verb_writes_report_pictures_and_json(run, tmp_path, capsys):
    bag = write_bag(tmp_path / "run", run.messages)
    assert call(bag) == 0
    assert capsys.readouterr().out == f"{bag}: {beside(__file__)['report']}"
    with quick_pictures():
        assert call(bag, "--model", "ideal", "--pictures", tmp_path / "pictures") == 0
    assert "model ideal" in capsys.readouterr().out
    pictures = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert pictures == {"corrections.png", "commands.png", "tool.png", "difference.png"}
    assert call(bag, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    text = "strut_1: the nominal length would change by -94.8007 mm in one command, allowed 2 mm"
    refusal = {"before_stamp_ns": BEGAN + 252 * PERIOD, "stamp_ns": BEGAN + 251 * PERIOD}
    outcomes = {"identical": 300, "different": 0, "not replayed": 0, "before the journal": 0}
    numbers = {"commands": 301, "commands_recorded": 301, "answers": 300, "answers_lost": 0, "refused": 1}
    expected = {"bag": str(bag), "node": "/compensator", "same": True, "outcomes": outcomes, "first_difference": None,
                "refusals": [{**refusal, "reason": "step", "text": text}], "largest_difference_m": 0.0,
                "states_differ": 0, "distance_to_path": {}, "notes": [], **numbers}  # fmt: skip
    assert {key: told[key] for key in expected} == expected
    assert told.keys() - expected.keys() == {"geometry", "model", "made_with", "changes"}
    first = {"what": "temperature", "name": "strut_1", "value": 23.4, "time": None}
    assert told["changes"][0] == {"before_stamp_ns": BEGAN + 38 * PERIOD, **first}


def test_following_errors_are_measured_minus_commanded_lengths(tmp_path: Path) -> None:
    """Struts n that are n µm too long halfway between two commands; across a pause of 0.5 s no length is commanded."""
    machine = RecordedMachine()
    machine.wave(100)
    machine.now += 500 * MILLISECOND
    machine.wave(100, 100)
    machine.page()
    recording, replayed = opened(write_bag(tmp_path / "run", machine.messages))
    stamps, lengths = recording.commands["stamp"], recording.commands["lengths"][:, 0]
    middle, longer = (stamps[:-1] + stamps[1:]) // 2, 1e-6 * np.arange(1.0, 7.0)
    assert [len(one) for one in following_error(Report(recording, replayed))] == [0, 0], "nothing was measured"
    recording.topics["strut_states"] = Series(middle, middle, 0.5 * (lengths[:-1] + lengths[1:]) + longer)
    report = Report(recording, replayed)
    at, error = following_error(report)
    np.testing.assert_allclose(at, np.delete(middle - stamps[0], 99) * 1e-9, atol=1e-12)
    np.testing.assert_allclose(error, np.tile(longer, (198, 1)), atol=1e-10)
    sizes = " ".join(f"{n}.00/{n}.00" for n in range(1, 7))
    assert f"(measured − commanded, including the drives' lag), RMS/largest µm per strut: {sizes}\n" in (
        report.shown()[0] + "\n"
    )


def retyped(messages: Messages, topic: str) -> Messages:
    """Return the first messages, with another type for one topic."""
    return [
        (time, name, "std_msgs/msg/Header" if name.endswith(topic) else kind, raw)
        for time, name, kind, raw in messages[:10]
    ]


def pages_of(messages: Messages, *numbers: int) -> Messages:
    """Return the files and some pages of the journal alone."""
    pages = of_topic(messages, "journal")
    return [messages[of_topic(messages, "files")[4]], *(messages[pages[n]] for n in numbers)]


UNUSABLE: dict[str, Callable[[Messages], Messages]] = {
    r"contains no journal of a compensator.*Its topics: /compensator/files": lambda m: without(
        m, *of_topic(m, "journal")
    ),
    r"files: must be of type \w+/msg/\w+ .found 'std_msgs/msg/Header'": lambda m: retyped(m, "files"),
    r"journal: must be of type \w+/msg/\w+ .found 'std_msgs/msg/Header'": lambda m: retyped(m, "journal"),
    "contains no answer that can be compared": lambda m: pages_of(m, 20, 22),
    "contains no snapshot": lambda m: pages_of(m, 21, 22, 23, 24),
    "contains no answer": lambda m: pages_of(m, 0),
    "without messages": lambda m: [],
    r"several machines; choose one with --namespace: /, /shop/mill": lambda m: [
        *m[:50],
        *((time, f"/shop/mill{topic}", kind, raw) for time, topic, kind, raw in m[:50]),
    ],
}


@pytest.mark.parametrize("what", UNUSABLE)
def test_bags_that_cannot_be_used(run, tmp_path, what):
    """Nothing can be compared in a recording in motion without a snapshot, or without any page."""
    with pytest.raises(InputFileError, match=what):
        call(write_bag(tmp_path / "run", UNUSABLE[what](run.messages)))


def test_one_of_several_machines_is_chosen(run, tmp_path):
    """Answers of another machine do not count."""
    both = [*run.messages, *((time, f"/shop/mill{topic}", kind, raw) for time, topic, kind, raw in run.messages[:200])]
    bag = write_bag(tmp_path / "both", both)
    recording, result = opened(bag, "/")
    assert (recording.node, counted(result)) == ("/compensator", {IDENTICAL: 300})
    assert opened(bag, "shop/mill")[0].node == "/shop/mill/compensator"


@pytest.mark.parametrize(
    ("name", "message"),
    [("none", "no such file or folder"), ("", "neither metadata.yaml nor"), ("zero.mcap", "seems to be empty$")],
)
def test_paths_that_are_no_bag(tmp_path, name, message):
    (tmp_path / "zero.mcap").touch()
    with pytest.raises(InputFileError, match=message):
        read_recording(tmp_path / name if name else tmp_path.parent)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_damaged_files_end_in_a_clear_error(run, tmp_path, storage):
    """A bag cut off or altered at any place gives an error with the file's name, or what is still readable."""
    bag = write_bag(tmp_path / "run", run.messages[:100], storage)
    (file,) = bag.glob("run.[md][cb]*")
    whole, draw = file.read_bytes(), np.random.default_rng(5)
    if storage == "mcap":
        file.write_bytes(whole[:-8])  # all but the mark at its end
        with pytest.raises(InputFileError, match="cannot be read as a bag: its recorder did not close it; its end is"):
            read_recording(file)
    for case in range(30):
        damaged = bytearray(whole)
        if case % 2:
            del damaged[int(draw.integers(len(whole))) :]
        else:
            for place in draw.integers(len(whole), size=8):
                damaged[place] = draw.integers(256)
        target = tmp_path / f"{case}{file.suffix}"
        target.write_bytes(damaged)
        with contextlib.suppress(HexapodError):  # no other error may be raised
            opened(target)
        if case % 2 and storage == "mcap" and len(damaged):
            with pytest.raises(InputFileError, match="recorder is killed"):
                read_recording(target)


def page_text(**changes: object) -> str:
    """Return the text of an empty page with changes."""
    content = {"journal": FORMAT, "session": "x", "number": 1, "begins": 0, "answers": "", "entries": []}
    return json.dumps({**content, "refused_more": 0, "snapshot": None, **changes})


def test_messages_that_are_damaged_are_named(run, tmp_path):
    """A message is damaged if it is cut off, or if its page is no JSON, has another version, or lacks its numbers."""
    pages = [
        ("{", "not JSON"),
        ('{"journal": 9}', "the journal must have version 5, not 9"),
        ('{"journal": 5}', "not a page of the journal"),
        (page_text(answers="?"), "not a page of the journal"),
        (page_text(entries=[{"after": 3, "what": "enable", "on": True}]), "do not ascend"),
    ]
    for n, (text, message) in enumerate(pages):
        messages = [*run.messages[:10], (BEGAN, "/compensator/journal", TEXT, serialized(TEXT, TYPES[TEXT](text)))]
        with pytest.raises(InputFileError, match=f"/compensator/journal at {BEGAN} ns: .*{message}"):
            read_recording(write_bag(tmp_path / str(n), messages))
    unknown = page_text(answers=base64.b64encode(b"\xff" * COMMAND.itemsize).decode())
    messages = [*run.messages[:10], (BEGAN, "/compensator/journal", TEXT, serialized(TEXT, TYPES[TEXT](unknown)))]
    with pytest.raises(InputFileError, match="/compensator/journal: has a command in a frame that is missing in every"):
        read_recording(write_bag(tmp_path / "frame", messages))
    time, topic, kind, raw = run.messages[of_topic(run.messages, "journal")[1]]
    for late in (0, 1):
        bag = write_bag(tmp_path / f"late{late}", [*run.messages[:20], ((1 << 63) - 1 + late, topic, kind, raw)])
        with pytest.raises(InputFileError, match="exceeds 2⁶³ − 1") if late else contextlib.nullcontext():
            read_recording(bag)
    with pytest.raises(InputFileError, match=f"/compensator/journal at {time} ns: cannot be read"):
        read_recording(write_bag(tmp_path / "cut", [*run.messages[:8], (time, topic, kind, raw[:20])]))


def test_long_files_are_not_copied_into_the_journal():
    for length, copied in ((250_000, True), (250_001, False)):
        source = Source.of("long.yaml", "x" * length)
        (read,) = read_sources(sources_text({"model": source})).values()
        assert read == (source if copied else replace(source, text=None))
    with pytest.raises(
        InputFileError, match=r"^long\.yaml: is not in the recording, since it has more than 250000 char"
    ):
        read.model("paper")


def test_files_of_the_journal_must_have_their_hash():
    text = json.dumps({"journal": FORMAT, "files": {"model": {"name": "m", "sha256": "0" * 64, "text": "x"}}})
    with pytest.raises(JournalError, match="does not have the SHA-256 hash"):
        read_sources(text)


def test_without_rosbags_the_error_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    (tmp_path / "run.mcap").touch()
    with pytest.raises(HexapodError, match=r"pip install rosbags.*python3-rosbags-pip"):
        read_recording(tmp_path / "run.mcap")


@pytest.mark.parametrize(
    ("bound", "message", "kind", "mode"),
    [
        *(("FREE", "more than a recording of", *how) for how in COMPRESSED),
        ("AT_ONCE", "more than the allowed", *COMPRESSED[0]),
    ],
)
def test_bag_that_unpacks_to_too_much_is_refused(run, tmp_path, monkeypatch, kind, mode, bound, message):
    """8 MB of blanks are packed into some hundred bytes; the bounds are lowered for speed."""
    blanks = serialized(TEXT, TYPES[TEXT](" " * 8 * MEGABYTE))
    messages = [*run.messages[:50], (BEGAN, "/compensator/journal", TEXT, blanks)]
    bag = write_bag(tmp_path / "run", messages, kind, mode)
    monkeypatch.setattr(storage, "RATIO", 1)
    monkeypatch.setattr(storage, bound, 2 * MEGABYTE)
    unpacked, charge = [], storage.Allowance.charge
    monkeypatch.setattr(storage.Allowance, "charge", lambda self, n: (unpacked.append(n), charge(self, n)))
    with pytest.raises(InputFileError, match=message):
        read_recording(bag)
    assert sum(unpacked) <= 4 * MEGABYTE or mode == CompressionMode.FILE  # whole files are unpacked to the disk first


def test_chunks_packed_by_lz4_are_bounded_too(monkeypatch):
    monkeypatch.setattr(storage, "AT_ONCE", 2 * MEGABYTE)
    unpacked = lambda packed: storage.Allowance(0).unpacked(storage.UNPACK["lz4"](packed))  # noqa: E731
    with monkeypatch.context() as exactly:
        exactly.setattr(storage, "FREE", 7 * 99)
        assert unpacked(lz4.frame.compress(b"hexapod" * 99)) == b"hexapod" * 99
        with pytest.raises(storage.UnpackingError, match="more than a recording of 0 bytes"):
            unpacked(lz4.frame.compress(b"hexapod" * 99 + b"!"))
    with pytest.raises(storage.UnpackingError, match="allowed 2 MB"):
        unpacked(lz4.frame.compress(bytes(3 * MEGABYTE)))


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("ALTER TABLE messages ADD COLUMN more BLOB AS (zeroblob(900000000))", "has computed rows or columns"),
        ("CREATE VIEW message_definitions_2 AS SELECT 1", "has computed rows or columns"),
        ("UPDATE messages SET timestamp = 'now'", "table of messages has no time or no bytes"),
        ("UPDATE messages SET data = 'text'", "table of messages has no time or no bytes"),
    ],
)
def test_tables_that_no_recorder_writes_are_refused(run, tmp_path, statement, said):
    bag = write_bag(tmp_path / "run", run.messages[:50], "sqlite3")
    (file,) = bag.glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.execute(statement)
        database.commit()
    with pytest.raises(InputFileError, match=said):
        read_recording(bag)


def test_the_distance_to_the_path_is_given_absolute_and_after_best_fit_alignment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The truth is a known motion: a tool 5 ms late on a path displaced by 100 µm and 0.4 mrad."""
    datum = Pose.from_angles([60e-6, -70e-6, 40e-6], np.array([2e-4, -2e-4, 3e-4]))
    machine = RecordedMachine()
    for n in range(400):
        machine.send(wave_pose(n))
        if n >= 5:
            machine.keep_pose("tool_pose_true", machine.now, datum @ wave_pose(n - 5))
        if n % 50 == 49:
            machine.page()
    bag = str(write_bag(tmp_path / "run", machine.messages))
    assert main(["replay", bag, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["distance_to_path"]
    assert list(found) == ["tool_pose_true"]
    raw, aligned = found["tool_pose_true"]["as_it_is"], found["tool_pose_true"]["datum_aligned"]
    assert 20e-6 < raw["rms_m"] < raw["max_m"] < 500e-6  # across the path; 0.4 mrad at 0.4 m add 160 µm
    assert aligned["max_m"] < 1e-7
    assert main(["replay", bag]) == 0
    (said,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("distance of tool_pose_true"))
    assert f"absolute {raw['rms_m'] * 1e6:.2f}/{raw['max_m'] * 1e6:.2f}, after best-fit alignment 0.0" in said
