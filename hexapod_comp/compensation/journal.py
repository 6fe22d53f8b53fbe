"""The compensator's journal: all inputs and all strut commands in their order, from which a run can be replayed.

Pages are numbered, so that a lost page is detected. Every :data:`SNAPSHOT_PERIOD` s a page ends with a snapshot of the
compensator's state, from which a replay can begin. A page is JSON text, which ``ros2 topic echo`` can show.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import math
import platform
import secrets
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import core
from ..errors import HexapodError, InputFileError, shorten
from ..formats.files import Opener, read_text
from ..formats.json import json_content
from ..machine.geometry import BASE, STRUT_NAMES, WORK, HexapodGeometry, parse_geometry
from ..machine.load import Loading
from ..machine.model import MachineModel
from ..machine.model_file import IDEAL, parse_model
from ..machine.outside import read_numbers
from .compensator import BESIDE, Compensator

FORMAT = 5  # Version of the journal's pages; it changes when a member of ``hc_last`` gets a new name or meaning

# Longest time between two snapshots, s: after a lost page a replay continues at the next snapshot. A late subscriber
# receives the ten newest pages; with one page every 50 ms, a snapshot is among them.
SNAPSHOT_PERIOD = 0.4

# Frames of commanded poses that every machine has; an answer stores the index of its frame in the snapshots' frames
ROLES = (BASE, WORK)

_TIMES = [("stamp", "<i8"), ("stamped", "u1"), ("received", "<f8"), ("published", "<f8")]
# One answered command; a page has an array of them in base64. `stamp`: the answer's stamp, ns; `stamped`: 1 if the
# command had the same stamp, 0 if it had none; `received`, `published`: times of receipt and publication, s; `frame`:
# index of the command's frame; `pose`: position, m, and quaternion x, y, z, w; `lengths`: strut commands and
# corrections of the answer, m.
COMMAND = np.dtype([*_TIMES, ("frame", "u1"), ("pose", "<f8", 7), ("lengths", "<f8", (2, 6))])

_HEAD = struct.Struct("<qBddB7d")  # The first six fields of a COMMAND; packing them in one call is five times faster


def time_of(stamp: int, stamped: bool) -> float:
    """Return a command's stamp in seconds, as the compensator expects it; NaN if the command had no stamp."""
    return stamp * 1e-9 if stamped else math.nan


REFUSALS_PER_PAGE = 20  # Largest number of refused commands that a page lists; it counts all refused commands
# A file with more characters is named but not copied into the journal, because commands wait while it is copied
LARGEST_SOURCE = 250_000

# Longest message that is read, characters; a page (50 ms at 1 kHz) has about 10 kB, geometry and model at most 1.5 MB
MOST_CHARACTERS = 8_000_000

CPU_INFO = Path("/proc/cpuinfo")


class JournalError(HexapodError):
    """A page of the journal, or the message with the geometry and model files, cannot be read."""

    reason = "bad_journal"


@dataclass(frozen=True)
class Source:
    """A file on which the strut commands depend: the geometry file or the model file."""

    name: str  # path of the file
    text: str | None  # None if it was too long to be copied
    sha256: str  # hash of the text as UTF-8, hexadecimal

    @classmethod
    def of(cls, name: str, text: str) -> Source:
        return cls(name, text, hashlib.sha256(text.encode()).hexdigest())

    @classmethod
    def read(cls, path: str | Path, opener: Opener | None = None) -> Source:
        """Return a file's present content; machine and model come from it even if the file changes later."""
        return cls.of(str(path), read_text(path, opener))

    def geometry(self) -> HexapodGeometry:
        return parse_geometry(self._whole(), self.name)

    def model(self, machine: str) -> MachineModel:
        if self.sha256 == IDEAL_SOURCE.sha256:
            return MachineModel(machine)
        return parse_model(self._whole(), machine, self.name)

    def _whole(self) -> str:
        if self.text is None:
            problem = f"is not in the recording, since it has more than {LARGEST_SOURCE} characters"
            raise InputFileError(self.name, "", problem)
        return self.text


IDEAL_SOURCE = Source.of(IDEAL, "")  # The ideal model has no file


@dataclass(frozen=True)
class Entry:
    """One change of an input, or one refused command."""

    after: int  # number of commands that were answered in this session before the change
    what: str  # kind of change: a key of ENTRIES
    # New values, with the keys of ENTRIES[what]. Temperature: °C, time in s (NaN: unknown); humidity: a fraction;
    # drift: twelve numbers, m; load: a Loading; outside: all external quantities by name; ramp rate: m/s; reset:
    # measured lengths, m, or None; refused command: stamp in ns, reason and text.
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Snapshot:
    """The state of a compensator that determines its next strut commands, with names and hashes of the files in use."""

    state: dict[str, Any]  # as :meth:`Compensator.snapshot`, with arrays in place of lists
    model: dict[str, str]  # ``name`` and ``sha256``
    geometry: dict[str, str]  # ``name`` and ``sha256``
    frames: dict[str, str]  # frame_id of ``base``, of ``work`` and of each further work frame, by the frame's name
    made_with: dict[str, str]
    joints: tuple[str, ...]  # names of the struts in messages, in strut order


@dataclass(frozen=True)
class Page:
    session: str  # identifier of the session, which begins when a node is configured
    number: int  # number of the page in its session, from 1
    begins: int  # number of commands that were answered in this session before this page
    commands: np.ndarray  # of COMMAND
    entries: tuple[Entry, ...]  # changes and refused commands since the previous page
    refused_more: int  # number of refused commands beyond REFUSALS_PER_PAGE
    snapshot: Snapshot | None  # taken after all commands and entries of this page

    def steps(self) -> Iterator[Entry | None]:
        """Yield in order of time the entry of each change, and None for each accepted command."""
        entries = iter(self.entries)
        upcoming = next(entries, None)
        for number in range(len(self.commands) + 1):
            while upcoming is not None and upcoming.after <= self.begins + number:
                yield upcoming
                upcoming = next(entries, None)
            if number < len(self.commands):
                yield None


class Journal:
    """The journal of one compensator, which calls :meth:`note` (as its ``on_change``) after each change of an input."""

    def __init__(
        self,
        compensator: Compensator,
        sources: Mapping[str, Source],
        frames: dict[str, str],
        joints: Sequence[str] = STRUT_NAMES,
    ) -> None:
        self._compensator, self._sources = compensator, sources
        self._always = {"frames": frames, "made_with": made_with(), "joints": list(joints)}
        self._places = {frames[role]: place for place, role in enumerate(frames)}
        self._session, self._number, self._count = secrets.token_hex(4), 0, 0
        self._commands, self._begins = bytearray(), 0
        self._entries: list[dict[str, Any]] = []
        self._refused = 0
        self._last = -math.inf
        compensator.on_change = self.note

    def answered(
        self, stamp: int, frame_id: str, numbers: tuple[float, ...], times: tuple[float, float], stamped: bool = True
    ) -> None:
        """Record an accepted command as a :data:`COMMAND`; `times` are the times, s, when the command was received and
        when the strut commands were published.
        """
        self._commands += _HEAD.pack(stamp, stamped, *times, self._places[frame_id], *numbers)
        self._commands += self._compensator.command.tobytes() + self._compensator.correction.tobytes()
        self._count += 1

    def note(self, what: str, value: Any) -> None:
        entry = {"after": self._count, "what": what}
        if what == "model":
            entry |= {"name": value.name, "sha256": self._sources["model"].sha256}
        elif what in SETTERS:
            values = value if isinstance(value, tuple) else (value,)
            entry |= {key: None if v != v else v for key, v in zip(ENTRIES[what], values, strict=True)}
        else:
            raise JournalError(f"the journal has no entry for a change called {what!r}")
        # Each refused first command resets the compensator again. Only the last reset has an effect and is stored.
        last = self._entries[-1] if self._entries else {}
        if what == "reset" and (last.get("what"), last.get("after")) == (what, self._count):
            self._entries.pop()
        self._entries.append(entry)

    def refused(self, stamp: int, reason: str, text: str) -> None:
        self._refused += 1
        if self._refused <= REFUSALS_PER_PAGE:
            entry = {"after": self._count, "what": "refused", "stamp": stamp, "reason": reason, "text": text}
            self._entries.append(entry)

    def due(self, now: float) -> bool:
        """Return whether a page is due at the monotonic time `now`, s: there are new entries, or a snapshot is due."""
        return bool(self._commands or self._entries) or self._snapshot_due(now)

    def _snapshot_due(self, now: float) -> bool:
        return now - self._last >= SNAPSHOT_PERIOD

    def page(self, now: float) -> str:
        """Return the next page as JSON, and begin a new one; `now` is the monotonic time, s."""
        snapshot = None
        if self._snapshot_due(now):
            self._last, compensator = now, self._compensator
            state = compensator.snapshot()
            for key, value in state.items():  # JSON has no NaN: it becomes null
                state[key] = [None if v != v else v for v in value] if isinstance(value, list) else value
            snapshot = {
                "state": state,
                "model": {"name": compensator.model.name, "sha256": self._sources["model"].sha256},
                "geometry": {"name": compensator.geometry.name, "sha256": self._sources["geometry"].sha256},
                **self._always,
            }
        self._number += 1
        content = {
            "journal": FORMAT,
            "session": self._session,
            "number": self._number,
            "begins": self._begins,
            "entries": self._entries,
            "refused_more": max(0, self._refused - REFUSALS_PER_PAGE),
            "snapshot": snapshot,
        }
        commands = base64.b64encode(self._commands).decode()
        self._commands, self._begins = bytearray(), self._count
        self._entries, self._refused = [], 0
        # The commands are inserted as text, because json.dumps would need most of its time to escape this long string.
        return f'{json.dumps(content, ensure_ascii=False)[:-1]}, "answers": "{commands}"}}'


def made_with() -> dict[str, str]:
    """Return the software's versions and the processor's name: the last bit of a result may depend on them."""
    try:
        lines = CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "core": core.VERSION,
        "core_sources": core.SOURCES_HASH,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "processor": names[0] if names else platform.machine(),
    }


def sources_text(sources: Mapping[str, Source]) -> str:
    content = {
        key: {
            "name": source.name,
            "sha256": source.sha256,
            "text": source.text if len(source.text or "") <= LARGEST_SOURCE else None,
        }
        for key, source in sources.items()
    }
    return json.dumps({"journal": FORMAT, "files": content}, ensure_ascii=False)


def read_sources(text: str) -> dict[str, Source]:
    sources = {}
    try:
        for key, entry in _object(_content(text)["files"], "files").items():
            entry = _object(entry, f"files.{key}")
            text_or_none = None if entry["text"] is None else str(entry["text"])
            sources[key] = Source(str(entry["name"]), text_or_none, str(entry["sha256"]))
    except KeyError as error:
        raise JournalError(f"the message with the journal's files lacks the entry {error}") from error
    for key, source in sources.items():
        if source.text is not None and Source.of("", source.text).sha256 != source.sha256:
            raise JournalError(f"the text of the {key} file does not have the SHA-256 hash that is recorded with it")
    return sources


def read_page(text: str) -> Page:
    content = _content(text)
    try:
        page = Page(
            session=str(content["session"]),
            number=int(content["number"]),
            begins=int(content["begins"]),
            commands=np.frombuffer(base64.b64decode(content["answers"], validate=True), COMMAND),
            entries=tuple(_read_entry(entry) for entry in content["entries"]),
            refused_more=int(content["refused_more"]),
            snapshot=None if content["snapshot"] is None else _read_snapshot(content["snapshot"]),
        )
    except KeyError as error:
        raise JournalError(f"not a page of the journal: {error} is missing or unknown") from error
    except (TypeError, ValueError, AttributeError, OverflowError, binascii.Error) as error:
        raise JournalError(f"not a page of the journal: {error}") from error
    places = [page.begins, *(entry.after for entry in page.entries), page.begins + len(page.commands)]
    if places != sorted(places):
        first, last = page.begins, page.begins + len(page.commands)
        raise JournalError(f"the keys `after` of the entries do not ascend from {first} to {last}: {places[1:-1]}")
    return page


def _content(text: str) -> dict[str, Any]:
    try:
        content = json_content(text, MOST_CHARACTERS)
    except ValueError as error:
        raise JournalError(f"not JSON: {error}") from error
    version = content.get("journal") if isinstance(content, dict) else content
    if not isinstance(content, dict) or version != FORMAT:
        found = f"the journal must have version {FORMAT}, not {str(version)[:40]}"
        raise JournalError(f"{found}; replay the recording with the release of this package that made the recording")
    return content


def _object(content: Any, where: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise JournalError(f"{where} must be an object (found {shorten(content)})")
    return content


def _number(found: float | None) -> float:
    return math.nan if found is None else float(found)


def _numbers(found: Sequence[float] | None) -> list[float] | None:
    return None if found is None else [float(value) for value in found]


# The keys of each kind of entry, with the function that reads the key's value from JSON
ENTRIES: dict[str, dict[str, Callable[[Any], Any]]] = {
    "temperature": {"name": str, "value": float, "time": _number},
    "humidity": {"value": float, "time": _number},
    "model": {"name": str, "sha256": str},
    "drift": {"value": _numbers},
    "load": {"value": Loading.from_numbers},
    "outside": {"value": read_numbers},
    "enable": {"on": bool},
    "ramp_rate": {"value": float},
    "tool": {"name": str},
    "reset": {"measured": _numbers},
    "refused": {"stamp": int, "reason": str, "text": str},
}
# Name of the compensator's method that repeats a change, by kind; it takes the entry's values in the order of ENTRIES
SETTERS = {what: f"set_{what}" for what in ("temperature", "humidity", "drift", "load", "outside", "ramp_rate", "tool")}
SETTERS |= {"enable": "enable", "reset": "reset"}


def _read_entry(content: Any) -> Entry:
    what = str(_object(content, "an entry")["what"])
    return Entry(int(content["after"]), what, {key: read(content[key]) for key, read in ENTRIES[what].items()})


def _array(found: Sequence[float | None]) -> np.ndarray:
    return np.array([_number(value) for value in found])


def _read_snapshot(content: Any) -> Snapshot:
    state = _object(_object(content, "snapshot")["state"], "snapshot.state")
    for part in ("temperatures", "lags", "outside"):
        _object(state[part], f"snapshot.state.{part}")

    def words(key: str, *required: str) -> dict[str, str]:
        found = {name: str(value) for name, value in _object(content[key], f"snapshot.{key}").items()}
        if missing := [name for name in required if name not in found]:
            raise KeyError(f"snapshot.{key}.{missing[0]}")
        return found

    return Snapshot(
        state={name: BESIDE.get(name, _array)(state[name]) for name in {**BESIDE, **state}},
        model=words("model", "name", "sha256"),
        geometry=words("geometry", "name", "sha256"),
        frames=words("frames", *ROLES),
        made_with=words("made_with"),
        joints=tuple(str(name) for name in content["joints"]),
    )
