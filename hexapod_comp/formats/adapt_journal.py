"""The journal of ``adapt``: one line of JSON for each finished step, from which a restarted ``adapt`` continues."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from inspect import formatannotation
from pathlib import Path
from typing import IO, Any

from ..errors import InputFileError
from .json import has_type, json_content, json_text

JOURNAL = "journal.jsonl"  # file in the folder of ``adapt``
IN_USE = "model.yaml"  # file of the adopted model, with its posterior file beside it
ENDED = "ended"  # last event of each run of ``adapt``, unless the process is killed
LEFT_WITHIN = 10.0  # longest wait until another process, which first brakes the machine, has left the folder, s

Event = dict[str, Any]

_Size: Any = float | None
_Row: Any = tuple[float, float, float]
# Keys of each event that ``adapt`` or its reports read, with the types of their values; other keys are allowed
KEYS: dict[str, dict[str, Any]] = {
    "begun": {"machine": str, "goal_m": _Size, "box_m": tuple[_Row, _Row], "level": tuple[_Row, _Row, _Row]},
    "planned": {"number": int, "campaign": str, "expected_m": _Size},
    "collected": {"number": int, "readings": str, "count": int, "missing": tuple[str, ...]},
    "fitted": {"number": int, "model": str, "promised_m": _Size, "enough": bool, "short": str},
    "checked": {
        "number": int, "readings": str, "model": str, "good": bool, "spoilt": bool, "verdict": str, "text": str,
        "found_m": _Size, "promised_m": _Size, "moved_m": float, "stands_error_m": float,
        "stands_m": tuple[float, float, float, float, float, float], "ran_m": float, "applied": bool | None,
    },
    "adopted": {"model": str},
    "reloaded": {"model": str},
    "restarted": {"reason": str},
    "repaired": {"number": int, "model": str, "of": str, "text": str},
    "beyond repair": {"number": int, "text": str, "reason": str},
    "refused": {"reason": str},
    ENDED: {"state": str, "text": str, "model": str | None, "applied": bool | None},
}  # fmt: skip
LARGEST, MOST_LISTED = 1e6, 100_000  # limits: |number| in the journal, SI; number of entries in a list


class Journal:
    """The events of ``adapt``, one a line in the file `path`; an event is on the disk before the next step begins.

    An unfinished last line, which a killed process has left, is removed, so that ``adapt`` repeats the line's step.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.events: list[Event] = []
        if not self.path.exists():
            return
        content = _bytes(self.path)
        complete = content[: content.rfind(b"\n") + 1]
        self.events = list(_parsed(self.path, complete.decode("utf-8", errors="replace")))
        if len(complete) < len(content):
            os.truncate(self.path, len(complete))

    @staticmethod
    def read(path: Path, start: int = 0) -> list[Event]:
        """Return the events in the file's complete lines from byte `start` on; another process may be adding lines."""
        if not path.exists():
            return []
        text = _bytes(path, start).decode("utf-8", errors="replace")
        return list(_parsed(path, text.rpartition("\n")[0]))

    def add(self, event: str, **content: Any) -> Event:
        """Append an event with the present time, and return it."""
        entry = {"time": datetime.now(timezone.utc).isoformat(timespec="seconds"), "event": event, **content}
        line = json_text(entry, indent=None)
        size = self.path.stat().st_size if self.path.exists() else 0
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            with suppress(OSError):  # the next event must not follow half a line, after the disk has been full
                os.truncate(self.path, size)
            raise InputFileError(self.path, "", f"cannot be written: {error.strerror}") from error
        self.events.append(json_content(line))
        return self.events[-1]


@contextmanager
def sole_user(folder: str | Path) -> Iterator[None]:
    """Lock the folder of ``adapt``; raise InputFileError if another process still has the lock after LEFT_WITHIN, s."""
    path, end = Path(folder) / JOURNAL, time.monotonic() + LEFT_WITHIN
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a", encoding="utf-8")
    except OSError as error:
        raise InputFileError(path, "", f"cannot be written: {error.strerror}") from error
    with file:
        while not _locks(file):  # the lock is held until the process ends
            if time.monotonic() > end:
                raise InputFileError(folder, "", "another adapt works in this folder: stop it first")
            time.sleep(0.1)
        yield


def has_user(journal: Path) -> bool:
    """Return whether an ``adapt`` works in the folder of a journal."""
    if not journal.exists():
        return False
    with journal.open("rb") as file:
        return not _locks(file)


def _locks(file: IO[Any]) -> bool:
    """Lock an open file; return False if another process holds the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _bytes(path: Path, start: int = 0) -> bytes:
    try:
        with path.open("rb") as file:
            file.seek(start)
            return file.read()
    except OSError as error:
        raise InputFileError(path, "", f"cannot be read: {error.strerror}") from error


def _parsed(path: Path, text: str) -> Iterator[Event]:
    """Yield the events in a text; refuse a line that is not JSON, lacks a key or has a value of a wrong type."""
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            event = json_content(line)
        except ValueError as error:
            raise InputFileError(path, f"line {number}", f"is not JSON: {error}") from error
        name = event.get("event") if isinstance(event, dict) else None
        if name not in list(KEYS):
            problem = f'must be a JSON object whose "event" is one of {", ".join(KEYS)}'
            raise InputFileError(path, f"line {number}", problem)
        common = {"time": str, "number": int} if "number" in event else {"time": str}
        for key, hint in {**common, **KEYS[name]}.items():
            where = f"line {number}, {name}.{key}"
            if key not in event:
                raise InputFileError(path, where, "is missing")
            if not has_type(event[key], hint, LARGEST, MOST_LISTED):
                raise InputFileError(path, where, f"must be of the type {formatannotation(hint)}", event[key])
        yield event
