"""How much a bag may unpack to: told before the memory is spent, whatever the file promises.

Ninety kilobytes can unpack to gigabytes. While :func:`bounded` is open, what ``rosbags`` unpacks passes through here:
chunks and messages block by block, files on their way to the disk, and SQLite's tables only as they stand in the file;
and YAML, also inside of it, is read by this package's own bounded loader.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from types import SimpleNamespace
from typing import Any

from ..errors import HexapodError
from ..formats.files import MEGABYTE
from ..formats.yaml import yaml_content

MOST_METADATA, MOST_NODES = 4 * MEGABYTE, 100_000
"""Bytes and YAML nodes of a bag's metadata: a topic has some fifty nodes, and so have ten of the files that a long
recording is split into."""

AT_ONCE = 128 * MEGABYTE
"""Most bytes of one message, of one chunk, or of all chunks of one time; recorders make chunks of one to four MB."""

FREE, RATIO = 256 * MEGABYTE, 100
"""A bag may unpack to so many bytes, and to so many more for each of its own. A machine that stands still, the
same lengths a thousand times a second, unpacks to thirty times the bag."""

BLOCK = MEGABYTE
"""Bytes unpacked between two looks at the bounds."""

EXPANDING = """SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'create virtual%'
UNION SELECT m.name FROM sqlite_master m, pragma_table_xinfo(m.name) x WHERE m.type = 'table' AND x.hidden > 1"""
"""Views, virtual tables and computed columns: they give rows that no file holds; no recorder writes any."""


class UnpackingError(HexapodError):
    """A bag that unpacks to more than its size makes believable."""

    reason = "too_large"


class Allowance:
    """What a bag of a given size may still unpack to."""

    def __init__(self, size: int) -> None:
        self._size, self._taken = size, 0

    def take(self, count: int) -> None:
        """Count bytes; raise UnpackingError when they are too many."""
        self._taken += count
        most = FREE + RATIO * self._size
        if self._taken > most:
            raise UnpackingError(
                f"unpacks to more than {most / MEGABYTE:.0f} MB, which is more than a recording of {self._size} bytes "
                f"can hold (allowed are {FREE // MEGABYTE} MB and {RATIO} times its size)"
            )


@contextmanager
def bounded(allowance: Allowance) -> Iterator[None]:
    """Bound what ``rosbags`` unpacks as long as this context is open."""
    apsw, reader, metadata, storage_mcap, zstd_file, lz4_file = _library()

    class Yaml(reader.YAML):  # type: ignore[name-defined, misc]
        def load(self, text: str) -> Any:
            return yaml_content(text, "metadata", MOST_NODES)

    class Counted:
        def read(self, size: int | None = -1) -> bytes:
            block = super().read(size)  # type: ignore[misc]
            allowance.take(len(block))
            return block

    class Zstd(Counted, zstd_file):  # type: ignore[valid-type, misc]
        pass

    class Lz4(Counted, lz4_file):  # type: ignore[valid-type, misc]
        pass

    bounded_zstd = SimpleNamespace(open=Zstd, decompress=lambda data: _unpacked(Zstd(BytesIO(data))))
    bounded_chunks = {
        "": lambda data, size: data,
        "zstd": lambda data, size: bounded_zstd.decompress(data),
        "lz4": lambda data, size: _unpacked(Lz4(BytesIO(data))),
    }
    own = reader.zstd, storage_mcap.DECOMPRESSORS, reader.YAML
    reader.zstd, storage_mcap.DECOMPRESSORS = bounded_zstd, bounded_chunks
    reader.YAML = metadata.YAML = Yaml
    apsw.connection_hooks.append(_refuse_expanding_tables)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(_refuse_expanding_tables)
        reader.zstd, storage_mcap.DECOMPRESSORS, reader.YAML = own
        metadata.YAML = reader.YAML


def _library() -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return the parts of ``rosbags`` that unpack, and what they use; refuse a version that has others."""
    try:
        import apsw
        from lz4.frame import LZ4FrameFile
        from rosbags.rosbag2 import metadata, reader, storage_mcap

        _ = storage_mcap.DECOMPRESSORS, metadata.YAML, reader.YAML
        return apsw, reader, metadata, storage_mcap, reader.zstd.ZstdFile, LZ4FrameFile
    except (ImportError, AttributeError) as error:
        problem = f"this version of rosbags unpacks bags in a way that cannot be bounded ({error})"
        raise HexapodError(f"{problem}; install rosbags 0.11") from error


def _unpacked(stream: Any) -> bytes:
    """Return all that a packed chunk or message holds."""
    blocks, size = [], 0
    while block := stream.read(BLOCK):
        blocks.append(block)
        size += len(block)
        refuse_too_much_at_once(size, "a message or chunk")
    return b"".join(blocks)


def refuse_too_much_at_once(size: int, what: str) -> None:
    """Raise UnpackingError for what cannot be held in memory at one time."""
    if size > AT_ONCE:
        raise UnpackingError(f"{what} unpacks to more than the allowed {AT_ONCE // MEGABYTE} MB")


def refuse_overlapping_chunks(reader: Any) -> None:
    """Raise UnpackingError where chunks of one time, which are merged, promise too much together."""
    for storage in getattr(reader.storage, "storages", [reader.storage]):
        steps = []
        for chunk in getattr(storage, "chunks", ()):
            steps += [(chunk.message_start_time, 0, chunk.uncompressed_size)]
            steps += [(chunk.message_end_time, 1, -chunk.uncompressed_size)]
        size = 0
        for _, _, change in sorted(steps):
            size += change
            refuse_too_much_at_once(size, "what it holds at one time")


def _refuse_expanding_tables(connection: Any) -> None:
    """Bound an SQLite file to what it holds."""
    import apsw

    connection.limit(apsw.SQLITE_LIMIT_LENGTH, AT_ONCE)
    for (name,) in connection.execute(EXPANDING):
        raise UnpackingError(f"table {name!r} computes what it seems to hold; a recording's tables do not")
