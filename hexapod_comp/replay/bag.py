"""The reader of a recorded run: it reads one machine's topics from a bag into arrays with ``rosbags``. A bag is a
folder with ``metadata.yaml``, as ``ros2 bag record`` writes it, or a single ``.mcap`` or ``.db3`` file. A replay needs
only the compensator's topics ``journal`` and, for geometry and model, ``files``."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..compensation.journal import IDEAL_SOURCE, ROLES, JournalError, Page, Snapshot, Source, read_page, read_sources
from ..errors import HexapodError, InputFileError, printable
from ..formats.files import MEGABYTE, read_text
from ..formats.schema import Section
from ..formats.yaml import yaml_content
from ..machine.geometry import STRUT_NAMES, HexapodGeometry
from ..machine.model import MachineModel
from .storage import Allowance, Message, UnpackingError, check_size, cut_off, messages, zstd_stream

POSE, STRUTS, TEXT = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState", "std_msgs/msg/String"

# Topics in the machine's namespace that a report shows, and their types
TOPICS = {"strut_states": STRUTS, "tool_pose_estimate": POSE, "tool_pose_true": POSE}

COMMANDS = "tool_pose_command"  # Topic whose messages are only counted, since the journal has the answered commands
JOURNAL, FILES = "/journal", "/files"  # Names of topics after the compensator's full name

METADATA = "metadata.yaml"

STORAGE = (".mcap", ".db3")

# Limits of metadata.yaml: bytes, and YAML nodes, about fifty for a topic and five for a file
MOST_METADATA, MOST_NODES = 4 * MEGABYTE, 100_000

CUT_OFF = (
    "its end is missing, as when the recorder is killed; `mcap recover FILE --output NEW.mcap` makes a complete file"
)

SPARE = 4  # Number of meaningless bytes that rclpy's serialize_message appends to some messages

RECORD = "record at least compensator/journal and compensator/files"

IDEAL = IDEAL_SOURCE.sha256  # Hash of the ideal model, which has no file


@dataclass(frozen=True)
class Series:
    """Messages of one topic, oldest first."""

    stamps: np.ndarray  # (n,) int64: stamps in the messages' headers, ns
    times: np.ndarray  # (n,) int64: times of receipt by the recorder, ns
    values: np.ndarray  # (n, 6): lengths of the six struts, m; or (n, 3): position x, y, z, m

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def when(self) -> np.ndarray:
        """Stamps of all messages, ns; if any message has no stamp, the times of receipt of all messages."""
        return self.stamps if self.stamps.all() else self.times


@dataclass
class Recording:
    """The content of a bag for one machine.

    Attributes
    ----------
    path : str
        The bag.
    node : str
        Full name of the compensator.
    topics : dict of str to Series
        Messages of each topic, by its name in :data:`TOPICS`; empty for a topic that the bag does not have.
    pages : list of (int, Page)
        Each page of the journal with its time of receipt, ns: session by session, in the order of the page numbers.
    commands : ndarray of COMMAND
        Commands of all pages, with their answers, in the order of the pages.
    sources : dict of str to Source
        Texts of the geometry files and model files in the bag, by their hash.
    recorded : int
        Number of recorded messages of :data:`COMMANDS`; the compensator may have received fewer.
    notes : list of str
        Irregularities of the bag, for the report.
    """

    path: str
    node: str
    topics: dict[str, Series]
    pages: list[tuple[int, Page]]
    commands: np.ndarray
    sources: dict[str, Source]
    recorded: int
    notes: list[str]

    @property
    def first(self) -> Snapshot:
        return next(page.snapshot for _, page in self.pages if page.snapshot is not None)

    @cached_property
    def frames(self) -> np.ndarray:
        """Name of the frame of each of the n commands; empty if no snapshot in the journal names the frame."""
        sessions = {page.session: tuple(page.snapshot.frames) for _, page in self.pages if page.snapshot is not None}
        names = [np.zeros(0, dtype=object)]
        for _, page in self.pages:
            known = sessions.get(page.session, ROLES)
            frames = page.commands["frame"].astype(int)
            names.append(np.array([*known, ""], dtype=object)[np.minimum(frames, len(known))])
        return np.concatenate(names)

    @cached_property
    def tools(self) -> np.ndarray:
        """Name of the tool in use at each of the n commands."""
        tool, names = self.first.state["tool"], list[str]()
        for _, page in self.pages:
            for entry in page.steps():
                if entry is None:
                    names.append(tool)
                elif entry.what == "tool":
                    tool = entry.values["name"]
            if page.snapshot is not None:
                tool = page.snapshot.state["tool"]
        return np.array(names, dtype=object)


def read_recording(
    path: str | Path, namespace: str | None = None, progress: Callable[[int], object] = lambda messages: None
) -> Recording:
    """Read the topics of one machine from a bag.

    Parameters
    ----------
    path : str or Path
        Folder, ``.mcap`` or ``.db3``.
    namespace : str, optional
        The machine's namespace, needed if the bag contains several machines; ``/``: the root namespace.
    progress : callable, optional
        Called with the argument 1 after each message.

    Raises
    ------
    HexapodError
        ``rosbags`` is not installed.
    InputFileError
        The path is not a bag; the bag is damaged, was recorded by an unsupported version, or has no journal; no machine
        or several machines are in the namespace; or the bag unpacks to more bytes than its :class:`Allowance`.
    """
    path, store = Path(path), _typestore()
    files, packing, notes = _files(path)
    inside = [one for file in {path, *files} for one in (file.iterdir() if file.is_dir() else [file])]
    for one in inside:
        if one.exists() and not (one.is_file() or one.is_dir()):  # opening a FIFO would wait without end
            raise InputFileError(one, "", "is not a regular file; a bag contains only regular files")
    size = sum(file.stat().st_size for file in inside if file.is_file())
    with TemporaryDirectory(prefix="hexapod_comp_") as folder:
        if packing == "file":
            files = [_unpacked(path, file, Path(folder) / file.stem, Allowance(size)) for file in files]
        counts, texts = Counter[tuple[str, str]](), list[Message]()
        for message in _messages(path, files, packing, size):
            counts[message.topic, message.kind] += 1
            if message.topic.endswith((JOURNAL, FILES)):
                texts.append(message)
        if not counts:
            raise InputFileError(path, "", "is a bag without messages")
        node = _choose(path, counts, namespace)
        wanted = _wanted(path, counts, node)
        collected = _Collected(path, node)
        others = (m for m in _messages(path, files, packing, size) if wanted.get(m.topic) in TOPICS)
        # the journal first, for its joint names
        for part in ((m for m in texts if m.topic in wanted), others):
            for message in part:
                key = f"{message.topic} at {message.time} ns"
                collected.add(wanted[message.topic], message.time, _deserialized(path, key, store, message))
                progress(1)
    return collected.recording(notes, counts[f"{_namespace(node)}/{COMMANDS}", POSE])


def _typestore() -> Any:
    # not from the bag's message definitions, since these messages are the same in all ROS 2 versions
    try:
        from rosbags import typesys
    except ImportError as error:
        raise HexapodError(
            f"reading bags needs rosbags ({error}): pip install rosbags, "
            "or on a ROS machine the rosdep key python3-rosbags-pip"
        ) from error
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)


def _files(path: Path) -> tuple[list[Path], str, list[str]]:
    """Return a bag's files, what is compressed (``file``, ``message``, or empty: nothing), and notes for the report."""
    if path.name == METADATA:
        path = path.parent
    if not path.exists():
        raise InputFileError(path, "", "there is no such file or folder")
    if not path.is_dir():
        if path.suffix not in STORAGE or not path.is_file():
            raise InputFileError(path, "", "must be a bag: a folder with metadata.yaml, a .mcap or a .db3 file")
        return [path], "", []
    file = path / METADATA
    if not file.exists():
        if not (files := sorted(one for one in path.iterdir() if one.suffix in STORAGE)):
            raise InputFileError(path, "", "is not a bag: it has neither metadata.yaml nor a .mcap or .db3 file")
        note = "metadata.yaml is missing, as when the recorder is killed; all files of the folder were read"
        return files, "", [note]
    top = Section(file, "", yaml_content(read_text(file, most=MOST_METADATA), file, MOST_NODES))
    about = top.section("rosbag2_bagfile_information")
    names = about.require("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) and Path(name).name for name in names):
        raise about.error("relative_file_paths", "must be a list of names", names)
    files = [path / Path(name).name for name in names]
    if missing := next((one for one in files if not one.exists()), None):
        raise about.error("relative_file_paths", f"there is no file {missing.name}")
    packing, by = (about.require(key) if key in about else "" for key in ("compression_mode", "compression_format"))
    packing = str(packing or "").lower()
    if packing in ("file", "message") and by != "zstd":
        raise about.error("compression_format", "must be zstd", by)
    return files, packing, []


def _unpacked(path: Path, file: Path, target: Path, allowance: Allowance) -> Path:
    """Unpack a file of a bag into `target` and return `target`."""
    try:
        with zstd_stream(file) as stream, open(target, "wb") as unpacked:
            unpacked.writelines(allowance.blocks(stream))
    except Exception as error:
        raise _unreadable(path, file, error) from error
    return target


def _messages(path: Path, files: list[Path], packing: str, size: int) -> Iterator[Message]:
    """Yield the unpacked messages of all files of a bag."""
    allowance, total = Allowance(size), Allowance(size)
    for file in files:
        try:
            for message in messages(file, allowance):
                check_size(len(message.raw), "a message")
                total.charge(len(message.raw))  # many rows of a malicious database may refer to the same bytes
                if packing == "message":
                    message = message._replace(raw=allowance.unpacked(zstd_stream(message.raw)))
                yield message
            if cut_off(file):
                raise ValueError("its recorder did not close it")
        except Exception as error:
            raise _unreadable(path, file, error) from error


def _unreadable(path: Path, file: Path | None, error: Exception, key: str = "") -> InputFileError:
    """Convert an exception of any type that damaged bytes of a bag have caused into an InputFileError."""
    if isinstance(error, UnpackingError):
        return InputFileError(path, key, str(error))
    text = " ".join(str(part) for part in error.args) or type(error).__name__
    problem = f"cannot be read as a bag: {printable(text)}"
    return InputFileError(path, key, f"{problem}; {CUT_OFF}" if file is not None and cut_off(file) else problem)


def _deserialized(path: Path, key: str, store: Any, message: Message) -> Any:
    """Return a decoded message; if decoding fails, decode it without the last :data:`SPARE` bytes."""
    try:
        try:
            return store.deserialize_cdr(message.raw, message.kind)
        except Exception:
            if len(message.raw) <= SPARE:
                raise
            return store.deserialize_cdr(message.raw[:-SPARE], message.kind)
    except Exception as error:
        raise _unreadable(path, None, error, key) from error


def _choose(path: Path, topics: Collection[tuple[str, str]], namespace: str | None) -> str:
    """Return the full name of the only compensator in `namespace` or, without a namespace, in the whole bag."""
    journals = [(topic, kind) for topic, kind in topics if topic.endswith(JOURNAL)]
    journals = [one for one in journals if one[1] == TEXT] or journals  # without other programs' topics
    nodes = sorted({topic.removesuffix(JOURNAL) for topic, _ in journals})
    if namespace is not None:
        wanted = "/" + namespace.strip("/")
        here = [node for node in nodes if _namespace(node) == wanted.rstrip("/")]
    else:
        here = nodes
    if len(here) == 1:
        return here[0]
    if not nodes:
        listed = ", ".join(sorted({topic for topic, _ in topics}))
        problem = f"contains no journal of a compensator, without which a run cannot be replayed; {RECORD}"
        raise InputFileError(path, "", f"{problem}. Its topics: {printable(listed, 500)}")
    names = ", ".join(_namespace(node) or "/" for node in nodes)
    problem = "contains several machines; choose one with --namespace" if here else f"has no machine in {namespace}"
    raise InputFileError(path, "", f"{problem}: {names}")


def _namespace(node: str) -> str:
    return node.rpartition("/")[0]


def _wanted(path: Path, topics: Collection[tuple[str, str]], node: str) -> dict[str, str]:
    """Map each topic's full name to its name in TOPICS, or to JOURNAL or FILES; refuse a topic of a wrong type."""
    names = {f"{_namespace(node)}/{name}": (name, kind) for name, kind in TOPICS.items()}
    names |= {node + JOURNAL: (JOURNAL, TEXT), node + FILES: (FILES, TEXT)}
    for topic, found in topics:
        kind = names.get(topic, ("", found))[1]
        if found != kind:
            raise InputFileError(path, topic, f"must be of type {kind}", found)
    return {topic: name for topic, (name, _) in names.items()}


class _Collected:
    """The messages read so far; their stamps, times and values are in arrays, with a fifth of the memory of tuples."""

    def __init__(self, path: str | Path, node: str) -> None:
        self._path, self._node = path, node
        # stamps, times and values of each topic, for a Series; the values in one flat array
        self._columns = {name: (array("q"), array("q"), array("d")) for name in TOPICS}
        self._pages: list[tuple[int, Page]] = []
        self._sources: dict[str, Source] = {}
        self._odd = Counter[str]()
        self._joints: tuple[str, ...] = STRUT_NAMES

    def add(self, name: str, time: int, message: Any) -> None:
        if name in (JOURNAL, FILES):
            self.add_text(name, time, message.data)
            return
        place = getattr(message, "pose", None) and message.pose.position
        numbers = (place.x, place.y, place.z) if place else _lengths(message, self._joints)
        if numbers is None:
            self._odd[name] += 1
            return
        stamps, times, values = self._columns[name]
        times.append(time)
        stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        values.extend(numbers)

    def add_text(self, name: str, time: int, text: str) -> None:
        try:
            if name == JOURNAL:
                self._pages.append((time, page := read_page(text)))
                self._joints = page.snapshot.joints if page.snapshot else self._joints
            else:
                self._sources |= {source.sha256: source for source in read_sources(text).values()}
        except JournalError as error:
            raise InputFileError(self._path, f"{self._node}{name} at {time} ns", str(error)) from error

    def recording(self, notes: list[str], recorded: int) -> Recording:
        commands, pages = self._in_order()
        if not any(page.snapshot for _, page in pages):
            problem = "contains no snapshot of the compensator's state: record for longer than half a second"
            raise InputFileError(self._path, self._node + JOURNAL, problem)
        if not len(commands):
            raise InputFileError(self._path, self._node + JOURNAL, "contains no answer of the compensator")
        topics = {}
        for name, (stamps, times, values) in self._columns.items():
            table = np.array(values, dtype=float).reshape((-1, 3 if TOPICS[name] == POSE else 6))
            order = np.argsort(times, kind="stable")
            of_stamps, of_times = (np.array(one, dtype=np.int64)[order] for one in (stamps, times))
            topics[name] = Series(of_stamps, of_times, table[order])
        notes = notes + [
            f"{count} messages of {name} were left out, because each needs one position for {', '.join(self._joints)}"
            for name, count in self._odd.items()
        ]
        recording = Recording(str(self._path), self._node, topics, pages, commands, self._sources, recorded, notes)
        if (recording.frames == "").any():
            problem = "has a command in a frame that is missing in every snapshot of the compensator's state"
            raise InputFileError(self._path, self._node + JOURNAL, problem)
        return recording

    def _in_order(self) -> tuple[np.ndarray, list[tuple[int, Page]]]:
        """Return an array of all commands, and the pages in order, each once, with their commands as views of it."""
        pages = sorted(self._pages, key=lambda entry: entry[0])
        sessions = {session: n for n, session in enumerate(dict.fromkeys(page.session for _, page in pages))}
        once = {(sessions[page.session], page.number): (time, page) for time, page in reversed(pages)}
        pages = [once[key] for key in sorted(once)]
        if not pages:
            return np.zeros(0), []
        commands = np.concatenate([page.commands for _, page in pages])
        views = np.split(commands, np.cumsum([len(page.commands) for _, page in pages])[:-1])
        return commands, [(time, replace(page, commands=view)) for (time, page), view in zip(pages, views, strict=True)]


def _lengths(message: Any, joints: Sequence[str]) -> tuple[float, ...] | None:
    """Return the positions of the six `joints`, m, or None if a joint is missing or repeated in the message."""
    names, positions = list(message.name), message.position.tolist()
    if len(names) != len(positions) or any(names.count(name) != 1 for name in joints):
        return None
    return tuple(positions[names.index(name)] for name in joints)


class Files:
    """Geometries and models, found by their hash in the recording or in files that the user gives."""

    def __init__(self, recording: Recording, given: Mapping[str, Source]) -> None:
        self._path = recording.path
        self._sources = {**recording.sources, **given}
        self._read: dict[tuple[str, str], Any] = {}
        pages = [page for _, page in recording.pages]
        snapshots = [page.snapshot for page in pages if page.snapshot is not None]
        self.used = {one["sha256"] for snapshot in snapshots for one in (snapshot.geometry, snapshot.model)}
        self.used |= {str(entry.values["sha256"]) for page in pages for entry in page.entries if entry.what == "model"}

    @property
    def used_ideal(self) -> bool:
        """Whether the compensator used the ideal model at any time."""
        return IDEAL in self.used

    def missing(self) -> str | None:
        """Return the hash of one missing file that the compensator used; None if no file is missing."""
        absent = (s for s in sorted(self.used) if s != IDEAL and not getattr(self._sources.get(s), "text", None))
        return next(absent, None)

    def geometry(self, identity: Mapping[str, str]) -> HexapodGeometry:
        return self._loaded("machine", identity, "", Source.geometry)

    def model(self, identity: Mapping[str, str], geometry: HexapodGeometry) -> MachineModel:
        return self._loaded("model", identity, geometry.name, lambda source: source.model(geometry.name))

    def _loaded(self, what: str, identity: Mapping[str, str], machine: str, load: Callable[[Source], Any]) -> Any:
        """Return the geometry or the model with the hash ``identity["sha256"]``; parse each file only once."""
        sha256 = identity["sha256"]
        if (sha256, machine) in self._read:
            return self._read[sha256, machine]
        source = IDEAL_SOURCE if what == "model" and sha256 == IDEAL else self._sources.get(sha256)
        if source is None or source.text is None:
            problem = (
                f"does not contain the {what} {identity.get('name', '')!r} that was in use; "
                f"give its file with --{what} (sha256 {sha256})"
            )
            raise InputFileError(self._path, "", problem)
        try:
            return self._read.setdefault((sha256, machine), load(source))
        except InputFileError as error:
            # probably a file of another version of this package
            raise InputFileError(self._path, f"{source.name}: {error.key}", error.problem, error.value) from error
