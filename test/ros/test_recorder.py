"""The recorder's bag on a disk that gets full, and in a folder that goes: what was written is whole.

Truth: a disk of a few megabytes that is counted here, byte by byte; what rosbags reads back.
"""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("rosbags")

from replay_helpers import RecordedMachine

from hexapod_comp.errors import InputFileError
from hexapod_comp.replay.bag import read_recording
from hexapod_comp.replay.replay import replay_recording
from hexapod_comp.ros import recorder
from hexapod_comp.ros.recorder import RESERVE, BagWriter


class Disk:
    """Takes so many bytes, what the reserve holds among them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
        self.left, self._write = size, os.write
        monkeypatch.setattr(recorder.os, "posix_fallocate", self.fallocate)
        monkeypatch.setattr(recorder.os, "write", self.write)
        monkeypatch.setattr(recorder._File, "give_back", self.giving_back(recorder._File.give_back))

    def fallocate(self, descriptor: int, start: int, length: int) -> None:
        if length > self.left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.left -= length

    def write(self, descriptor: int, data: memoryview) -> int:
        if not self.left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = self._write(descriptor, data[: self.left])  # the last bytes in part, as disks do
        self.left -= written
        return written

    def giving_back(self, give_back):
        def and_count(file) -> None:
            self.left += file._kept if file._descriptor is not None else 0
            give_back(file)

        return and_count


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


def test_a_bag_on_a_disk_that_gets_full_can_be_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, machine: RecordedMachine
) -> None:
    """Wherever the last byte falls: in a chunk, in its index."""
    for n, size in enumerate((3_000_000, 3_150_000, 3_151_000, 3_200_001)):
        disk = Disk(monkeypatch, RESERVE + size)
        bag = BagWriter(tmp_path / f"run{n}")
        record(bag, machine, 100)
        bag.close()
        monkeypatch.undo()
        assert bag.problem == "No space left on device; what was heard until then is whole and can be replayed"
        assert disk.left > 0
        assert 20 < bag.counts["/padding"] < 100, "it went on until the disk was full"
        result = replay_recording(read_recording(tmp_path / f"run{n}"))
        assert result.identical
        assert result.compared == 20
        assert [path.name for path in (tmp_path / f"run{n}").iterdir() if path.name.startswith(".")] == []


def test_a_disk_without_room_for_the_reserve_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Disk(monkeypatch, RESERVE - 1)
    with pytest.raises(InputFileError, match="run: cannot be made: No space left on device"):
        BagWriter(tmp_path / "run")


def test_a_bag_that_was_removed_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = RecordedMachine()
    bag = BagWriter(tmp_path / "run")
    record(bag, machine, 1)
    monkeypatch.setattr(recorder, "LOOK_PERIOD", 0.0)
    bag.look()
    assert not bag.problem
    shutil.rmtree(tmp_path / "run")
    bag.look()
    assert bag.problem == "was removed while it was written; nothing is left of it"
    bag.close()


def test_a_folder_that_was_moved_keeps_a_whole_file(tmp_path: Path, machine: RecordedMachine) -> None:
    bag = BagWriter(tmp_path / "run")
    record(bag, machine, 1)
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    bag.close()
    assert "metadata.yaml could not be written" in bag.problem
    assert replay_recording(read_recording(tmp_path / "elsewhere")).identical
