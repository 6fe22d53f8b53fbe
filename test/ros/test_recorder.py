"""Recordings: of the real node, replayed to the same bits; on a disk that gets full, and in a folder that goes.

Truth: what the node has sent; a disk whose room is counted here; what rosbags reads back."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from node_helpers import HOME, Bench, near
from replay_helpers import RecordedMachine

from hexapod_comp.errors import InputFileError
from hexapod_comp.pose import Pose
from hexapod_comp.replay.bag import Recording, read_recording
from hexapod_comp.replay.replay import BEFORE, IDENTICAL, Replay, replay_recording
from hexapod_comp.ros import recorder
from hexapod_comp.ros.recorder import RESERVE, BagRecorder, BagWriter


def replayed(bag: Path, namespace: str | None = None) -> tuple[Recording, Replay]:
    """Read a bag and replay it."""
    recording = read_recording(bag, namespace)
    return recording, replay_recording(recording)


def along(n: int) -> Pose:
    """Return the pose number `n` of a motion that turns struts round, slow enough for a command every millisecond."""
    return near(
        HOME, (6e-4 * np.sin(0.1 * n), 4e-4 * np.sin(0.13 * n), 2e-4 * np.sin(0.07 * n)), 0.06 * np.sin(0.1 * n)
    )


def wait_for_page(rig: Bench) -> None:
    """Wait until a page of the journal has come that was begun from now on; it comes with the diagnostics."""
    pages = len(rig.seen["/diagnostics"])
    rig.until(lambda: len(rig.seen["/diagnostics"]) > pages + 1, "another page of the journal")


def test_what_the_verb_records_is_replayed_and_a_folder_that_is_there_is_left_alone(bench, tmp_path):
    """The recorder runs as a user has it, in a process, beside a compensator that is moving already."""
    bench.compensator()
    answers = [bench.ask(along(n)) for n in range(20)]
    command = [sys.executable, "-m", "hexapod_comp", "record", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    journal = next(p for p in bench.nodes[0].publishers if p.topic_name.endswith("/journal"))
    bench.until(journal.get_subscription_count, "the recorder", timeout=60.0)
    commands = next(p for p in bench.nodes[0].publishers if p.topic_name == "/strut_commands")
    bench.until(lambda: commands.get_subscription_count() > 1, "the recorder of commands")
    wait_for_page(bench)  # what was commanded before the first one that it has cannot be judged
    answers += [bench.ask(along(n)) for n in range(20, 60)]
    wait_for_page(bench)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert "/compensator/journal" in output
    recording, result = replayed(tmp_path / "run")
    judged = result.outcome[result.outcome != BEFORE]
    assert (judged == IDENTICAL).all()
    assert len(judged) >= 40
    assert recording.recorded >= 40
    with pytest.raises(InputFileError, match="is there already"):
        BagRecorder(tmp_path / "run")


# ---- the disk ----


def record(bag: BagWriter, machine: RecordedMachine, times: int) -> None:
    """Write a machine's messages, and as much again of what is only counted."""
    for _, topic, kind, raw in machine.messages:
        bag.write(topic, kind, raw)
    for _ in range(times):
        bag.write("/padding", "std_msgs/msg/String", b"\0\1\0\0" + (100_000).to_bytes(4, "little") + b"x" * 100_000)


@pytest.fixture(scope="module")
def machine() -> RecordedMachine:
    made = RecordedMachine()
    made.wave(20)
    made.page()
    return made


@pytest.mark.parametrize("room", [0.5, 17.0])
def test_a_recording_ends_while_its_disk_has_room_to_close_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, machine: RecordedMachine, room: float
) -> None:
    """Truth: the room above the reserve, MB, counted by what the bag's file has taken; what a replay reads of it."""
    run = tmp_path / "run"

    def usage(folder: Path) -> SimpleNamespace:
        return SimpleNamespace(free=RESERVE + room * 1e6 - sum(path.stat().st_size for path in folder.iterdir()))

    monkeypatch.setattr(recorder.shutil, "disk_usage", usage)
    bag = BagWriter(run)
    record(bag, machine, 600)
    bag.close()
    assert (
        bag.problem == "less than 64 MB are free on its disk; what was received until then is whole and can be replayed"
    )
    assert bag.counts["/padding"] * 0.1 < room + 18.0, "some 16 MB and a chunk after the last look at the latest"
    result = replay_recording(read_recording(run))
    assert result.identical
    assert result.compared == 20


def test_a_disk_without_room_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder.shutil, "disk_usage", lambda _: SimpleNamespace(free=RESERVE - 1))
    with pytest.raises(InputFileError, match="run: cannot be made: less than 64 MB are free on its disk"):
        BagWriter(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_bag_that_was_removed_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = RecordedMachine()
    bag = BagWriter(tmp_path / "run")
    record(bag, machine, 1)
    monkeypatch.setattr(recorder, "LOOK_PERIOD", 0.0)
    bag.check_disk()
    assert not bag.problem
    shutil.rmtree(tmp_path / "run")
    bag.check_disk()
    assert bag.problem == "was removed or moved while it was written"
    bag.close()


def test_a_folder_that_was_moved_keeps_a_whole_file(tmp_path: Path, machine: RecordedMachine) -> None:
    bag = BagWriter(tmp_path / "run")
    record(bag, machine, 1)
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    bag.close()
    assert "metadata.yaml could not be written" in bag.problem
    assert replay_recording(read_recording(tmp_path / "elsewhere")).identical
