"""The journal of the loop: one line of JSON for each finished step, so that a killed process can continue."""

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

JOURNAL = "journal.jsonl"  # name of the journal in the loop's folder
IN_USE = "model.yaml"  # name of the adopted model in the same folder; its posterior file is beside it
ENDED = "ended"  # event with which a run of the loop ends, unless the process is killed
LEFT_WITHIN = 10.0  # wait this long for another process that is ending, s: it brakes the machine first

Event = dict[str, Any]


class Journal:
    """A file of events; each event is on the disk before the next step begins.

    An unfinished last line, left by a killed process, is removed, and its step is repeated.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.events: list[Event] = []
        if not self.path.exists():
            return
        try:
            content = self.path.read_bytes()
        except OSError as error:
            raise InputFileError(path, "", f"cannot be read: {error.strerror}") from error
        complete = content[: content.rfind(b"\n") + 1]
        self.events = list(_parsed(self.path, complete.decode("utf-8", errors="replace")))
        if len(complete) < len(content):
            os.truncate(self.path, len(complete))

    @staticmethod
    def read(path: Path, start: int = 0) -> list[Event]:
        """Return the complete events, from byte `start` on, of a journal that another process writes; empty if none."""
        if not path.exists():
            return []
        with path.open("rb") as file:
            file.seek(start)
            text = file.read().decode("utf-8", errors="replace")
        return list(_parsed(path, text.rpartition("\n")[0]))

    def add(self, event: str, **content: Any) -> Event:
        """Append an event with the current time to the file, and return it."""
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
    """Lock a loop's folder against other processes; raise InputFileError if one still has it after LEFT_WITHIN."""
    path, end = Path(folder) / JOURNAL, time.monotonic() + LEFT_WITHIN
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error
    with file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # released by the system when the process ends
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
            raise InputFileError(path, f"line {number}", f"is not JSON: {error}") from error
        if not isinstance(event, dict) or not isinstance(event.get("event"), str):
            raise InputFileError(path, f"line {number}", 'must be a JSON object with the key "event"')
        yield event
