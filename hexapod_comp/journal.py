"""The compensator's journal: what changed its state between two commands, written so that it can be replayed.

A command's answer follows from the commands before it, which a recording holds, and from what happened to the
compensator in between: temperatures, models, switching, starts. A page names those changes in order, and closes
with a snapshot of everything that decides the next answer. So any page is enough to go on from: a lost one costs
no more than what lies before the next, and a recording may begin in the middle of a motion.

A page is JSON: people read it with ``ros2 topic echo``, and its numbers come back as the very same floats, as
Python writes the shortest digits that do. NaN, for which JSON has no word, is null.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .compensation import Compensator
from .errors import HexapodError, InputFileError
from .files import read_text
from .machine import MachineModel

FORMAT = 1
"""Version of pages."""

SNAPSHOT_PERIOD = 1.0
"""Longest time between two pages, s: what a lost message costs a replay."""

REFUSALS_PER_PAGE = 20
"""A page names no more refused commands than this; it counts the others."""

LARGEST_SOURCE = 250_000
"""Longer files are named, not copied, characters: the message is made while commands wait."""

CPU_INFO = Path("/proc/cpuinfo")

Loaded = TypeVar("Loaded")


class JournalError(HexapodError):
    """A page that is none: what is wrong in it."""

    reason = "bad_journal"


@dataclass(frozen=True)
class Source:
    """A file that decides commands: geometry or model.

    Attributes
    ----------
    name : str
        Where it was read from.
    text : str or None
        All of it; None where it was too long to be copied. Empty for the ideal model.
    sha256 : str
        Of the text as UTF-8, hexadecimal.
    """

    name: str
    text: str | None
    sha256: str

    @classmethod
    def of(cls, name: str, text: str) -> Source:
        """Return the source with a text."""
        return cls(name, text, hashlib.sha256(text.encode()).hexdigest())


def load_with_source(path: str | Path, load: Callable[[str | Path], Loaded]) -> tuple[Loaded, Source]:
    """Load a file and return also the text it was loaded from.

    Raises
    ------
    InputFileError
        As `load`; or the file changes while it is read.
    """
    before = read_text(path)
    loaded = load(path)
    if read_text(path) != before:
        raise InputFileError(path, "", "is being written while it is read; try again")
    return loaded, Source.of(str(path), before)


@dataclass(frozen=True)
class Mark:
    """A place between two answered commands.

    Attributes
    ----------
    count : int
        Commands answered before it since the node started.
    stamp : int
        Stamp of the last of them, ns; 0 when there is none.
    """

    count: int
    stamp: int


@dataclass(frozen=True)
class Entry:
    """One change, or one refused command.

    Attributes
    ----------
    mark : Mark
        Where it happened.
    what : str
        ``temperature``, ``model``, ``enable``, ``reset`` or ``refused``.
    values : dict of str to object
        ``name`` and ``value`` (°C) of a temperature; ``name`` and ``sha256`` of a model; ``on``;
        ``measured`` (m, or None) of a reset; ``stamp`` (ns), ``reason`` and ``text`` of a refused command.
    """

    mark: Mark
    what: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Page:
    """One message of the journal.

    Attributes
    ----------
    session : str
        Differs from one configuration of a node to the next.
    number : int
        Of this page in its session, from 1.
    entries : tuple of Entry
        What happened since the page before.
    refused_more : int
        Refused commands that the page does not name.
    mark : Mark
        Where the snapshot was taken.
    snapshot : dict
        As :meth:`Compensator.snapshot`, arrays in place of lists.
    model, geometry : dict of str to str
        ``name`` and ``sha256`` of what was in use.
    frames : dict of str to str
        frame_id of poses in the machine's ``base`` and in its ``work`` frame.
    made_with : dict of str to str
        Versions that the last bit may depend on.
    """

    session: str
    number: int
    entries: tuple[Entry, ...]
    refused_more: int
    mark: Mark
    snapshot: dict[str, Any]
    model: dict[str, str]
    geometry: dict[str, str]
    frames: dict[str, str]
    made_with: dict[str, str]


class Journal:
    """Writes the pages of one compensator, whose ``on_change`` it takes.

    Parameters
    ----------
    compensator : Compensator
        Watched from now on.
    place : callable
        Returns commands answered so far and the stamp of the last, ns.
    sources : mapping of str to Source
        ``geometry`` and ``model`` in use; looked up whenever a page is written.
    frames : dict of str to str
        See :class:`Page`.
    """

    def __init__(
        self,
        compensator: Compensator,
        place: Callable[[], tuple[int, int]],
        sources: Mapping[str, Source],
        frames: dict[str, str],
    ) -> None:
        self._compensator, self._place, self._sources = compensator, place, sources
        self._always = {"frames": frames, "made_with": made_with()}
        self._session, self._number = secrets.token_hex(4), 0
        self._entries: list[dict[str, Any]] = []
        self._refused = 0
        self._last = -math.inf
        compensator.on_change = self.note

    def note(self, what: str, value: Any) -> None:
        """Write down a change that has just been made."""
        entry = {"after": self._place(), "what": what, **_values(what, value, self._sources)}
        if self._entries and what == "reset":
            last = self._entries[-1]
            # Every refused first command resets anew; only the last reset counts, and a page stays short.
            if (last["what"], last["after"]) == (what, entry["after"]):
                self._entries.pop()
        self._entries.append(entry)

    def refused(self, stamp: int, reason: str, text: str) -> None:
        """Write down a refused command with its stamp, ns."""
        self._refused += 1
        if self._refused <= REFUSALS_PER_PAGE:
            place = {"after": self._place(), "what": "refused"}
            self._entries.append({**place, "stamp": stamp, "reason": reason, "text": text})

    def due(self, now: float) -> bool:
        """Return whether a page should be written at the monotonic time `now`, s."""
        return bool(self._entries) or now - self._last >= SNAPSHOT_PERIOD

    def page(self, now: float) -> str:
        """Return the next page and begin a new one."""
        self._number, self._last = self._number + 1, now
        content = {
            "journal": FORMAT,
            "session": self._session,
            "number": self._number,
            "entries": self._entries,
            "refused_more": max(0, self._refused - REFUSALS_PER_PAGE),
            "after": self._place(),
            "snapshot": _nullified(self._compensator.snapshot()),
            "model": _identity(self._compensator.model, self._sources["model"]),
            "geometry": {"name": self._compensator.geometry.name, "sha256": self._sources["geometry"].sha256},
            **self._always,
        }
        self._entries, self._refused = [], 0
        return json.dumps(content, ensure_ascii=False)


def _values(what: str, value: Any, sources: Mapping[str, Source]) -> dict[str, Any]:
    if what == "temperature":
        return {"name": value[0], "value": value[1]}
    if what == "model":
        return _identity(value, sources["model"])
    if what == "enable":
        return {"on": bool(value)}
    if what == "reset":
        return {"measured": None if value is None else value.tolist()}
    raise JournalError(f"the journal knows no change called {what!r}")


def _identity(model: MachineModel, source: Source) -> dict[str, str]:
    return {"name": model.name, "sha256": source.sha256}


def _nullified(snapshot: dict[str, Any]) -> dict[str, Any]:
    """Return a snapshot with null for NaN."""
    return {
        key: [None if v != v else v for v in value] if isinstance(value, list) else value
        for key, value in snapshot.items()
    }


def made_with() -> dict[str, str]:
    """Return the versions and the processor that a result's last bit may depend on."""
    import numba

    from .compiling import cache_folder

    return {
        "kernels": cache_folder(numba.config.CACHE_DIR).name,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "processor": _processor(),
    }


def _processor() -> str:
    """Return what Linux calls the processor, else its family."""
    try:
        text = CPU_INFO.read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    names = [line.partition(":")[2].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.machine()


def sources_text(sources: Mapping[str, Source]) -> str:
    """Return the message that carries the files in use."""
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
    """Read what :func:`sources_text` has written.

    Raises
    ------
    JournalError
        It is something else, or a text does not have its hash.
    """
    sources = {}
    try:
        for key, entry in _content(text)["files"].items():
            text_or_none = None if entry["text"] is None else str(entry["text"])
            sources[key] = Source(str(entry["name"]), text_or_none, str(entry["sha256"]))
    except (KeyError, TypeError, AttributeError) as error:
        raise JournalError(f"not a message with files: {error!r}") from error
    for key, source in sources.items():
        if source.text is not None and Source.of("", source.text).sha256 != source.sha256:
            raise JournalError(f"the {key}'s text does not have the hash that stands beside it")
    return sources


def read_page(text: str) -> Page:
    """Read what :meth:`Journal.page` has written.

    Raises
    ------
    JournalError
        It is something else, or of another version.
    """
    content = _content(text)
    try:
        return Page(
            session=str(content["session"]),
            number=int(content["number"]),
            entries=tuple(_read_entry(entry) for entry in content["entries"]),
            refused_more=int(content["refused_more"]),
            mark=_read_mark(content["after"]),
            snapshot=_read_snapshot(content["snapshot"]),
            model=_words(content["model"], "name", "sha256"),
            geometry=_words(content["geometry"], "name", "sha256"),
            frames=_words(content["frames"], "base", "work"),
            made_with=_words(content["made_with"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise JournalError(f"not a page of the journal: {error!r}") from error


def _content(text: str) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise JournalError(f"not JSON: {error}") from error
    if not isinstance(content, dict) or content.get("journal") != FORMAT:
        found = content.get("journal") if isinstance(content, dict) else content
        raise JournalError(f"must be of version {FORMAT}, not {str(found)[:40]}")
    return content


def _read_mark(content: Any) -> Mark:
    count, stamp = content
    return Mark(int(count), int(stamp))


def _measured(content: Any) -> list[float] | None:
    return None if content is None else [float(value) for value in content]


ENTRIES: dict[str, dict[str, Callable[[Any], Any]]] = {
    "temperature": {"name": str, "value": float},
    "model": {"name": str, "sha256": str},
    "enable": {"on": bool},
    "reset": {"measured": _measured},
    "refused": {"stamp": int, "reason": str, "text": str},
}
"""What each kind of entry says, and how it is read."""

SNAPSHOT_ARRAYS = ("state", "poses", "switches")
"""Lists of numbers in a snapshot, see :meth:`Compensator.snapshot`."""


def _read_entry(content: Any) -> Entry:
    what = content["what"]
    return Entry(_read_mark(content["after"]), what, {key: read(content[key]) for key, read in ENTRIES[what].items()})


def _read_snapshot(content: Any) -> dict[str, Any]:
    arrays = {key: np.array([math.nan if v is None else float(v) for v in content[key]]) for key in SNAPSHOT_ARRAYS}
    return {**arrays, "temperatures": {str(key): float(value) for key, value in content["temperatures"].items()}}


def _words(content: Any, *required: str) -> dict[str, str]:
    words = {str(key): str(value) for key, value in content.items()}
    missing = [key for key in required if key not in words]
    if missing:
        raise KeyError(missing[0])
    return words
