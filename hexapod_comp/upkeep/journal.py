"""What was done, a line of JSON each: the memory of a loop that may be killed at any time."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ..errors import InputFileError
from ..formats.json import json_content, json_text

JOURNAL = "journal.jsonl"  # its name in the loop's folder
IN_USE = "model.yaml"  # beside it: the adopted model, always under this name, with its posterior
ENDED = "ended"  # the event with which a run of the loop ends, unless it is killed
LEFT_WITHIN = 10.0  # A process that was told to end brakes the machine and leaves the folder within this time, s

Event = dict[str, Any]


class Journal:
    """A file of events; each is on the disk before the next step begins.

    A last line that a killed process left unfinished is dropped: its step is done again.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.events: list[Event] = []
        if not self.path.exists():
            return
        try:
            text = self.path.read_bytes().decode("utf-8", errors="replace")
        except OSError as error:
            raise InputFileError(path, "", f"cannot be read: {error.strerror}") from error
        whole, _, rest = text.rpartition("\n")
        self.events = list(_parsed(self.path, whole))
        if rest:
            with self.path.open("r+b") as file:
                file.truncate(len((whole + "\n").encode()) if whole else 0)

    @staticmethod
    def read(path: Path, start: int = 0) -> list[Event]:
        """Return the events of a journal that somebody else writes, from a byte on, without a line that is being
        written; none where there is no journal."""
        if not path.exists():
            return []
        with path.open("rb") as file:
            file.seek(start)
            text = file.read().decode("utf-8", errors="replace")
        return list(_parsed(path, text.rpartition("\n")[0]))

    def add(self, event: str, **content: Any) -> Event:
        """Write an event, with the time."""
        entry = {"time": datetime.now(timezone.utc).isoformat(timespec="seconds"), "event": event, **content}
        line = json_text(entry, indent=None)
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputFileError(self.path, "", f"cannot be written: {error.strerror}") from error
        self.events.append(json_content(line))
        return self.events[-1]


@contextmanager
def sole_user(folder: str | Path) -> Iterator[None]:
    """Keep other processes from working in a loop's folder; an InputFileError where one does, and does not end."""
    path, end = Path(folder) / JOURNAL, time.monotonic() + LEFT_WITHIN
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error
    with file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system releases it however the process ends
                break
            except BlockingIOError:
                if time.monotonic() > end:
                    raise InputFileError(folder, "", "another adapt works in this folder: stop it first") from None
                time.sleep(0.1)
        yield


def _parsed(path: Path, text: str) -> Iterator[Event]:
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            event = json_content(line)
        except ValueError as error:
            raise InputFileError(path, f"line {number}", f"is no event: {error}") from error
        if not isinstance(event, dict) or not isinstance(event.get("event"), str):
            raise InputFileError(path, f"line {number}", "must be an object with an event")
        yield event
