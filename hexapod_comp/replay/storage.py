"""The reader of a bag's files, MCAP (https://mcap.dev/spec) and SQLite, with a limit on the number of unpacked bytes,
since a malicious file of 90 kB can unpack to gigabytes."""

from __future__ import annotations

import importlib
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

from ..errors import HexapodError
from ..formats.files import MEGABYTE

AT_ONCE = 128 * MEGABYTE  # Largest record, message or chunk, byte; recorders write chunks of one to four MB

# A bag may unpack to FREE bytes plus RATIO times its size; a bag of constant strut lengths unpacks to 30 times its size
FREE, RATIO = 256 * MEGABYTE, 100

MCAP_MAGIC = b"\x89MCAP0\r\n"  # First and last bytes of an MCAP file; the last are missing if the recorder was killed

SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 3, 4, 5, 6, 15  # Kinds of MCAP records that are read

# Header of a record: kind, length. Header of a message: channel, sequence number, times of receipt and of sending
HEAD, MESSAGE_HEAD = struct.Struct("<BQ"), struct.Struct("<HIQQ")

KINDS = range(1, 16)  # Kinds of records that MCAP defines

LATEST = 1 << 63  # Earliest time, ns, that does not fit into a signed 64-bit integer

# Names of views, virtual tables and tables with computed columns, which no recorder writes: a short definition could
# give any number of rows
EXPANDING = """SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'create virtual%'
UNION SELECT m.name FROM sqlite_master m, pragma_table_xinfo(m.name) x WHERE m.type = 'table' AND x.hidden > 1"""


class UnpackingError(HexapodError):
    """A bag unpacks to more bytes than its :class:`Allowance`, or its database computes rows that it does not store."""

    reason = "too_large"


class Message(NamedTuple):
    topic: str
    kind: str
    time: int  # time of receipt by the recorder, ns
    raw: bytes


class Allowance:
    """Counter of unpacked bytes, at most FREE + RATIO · `size` for a bag of `size` bytes."""

    def __init__(self, size: int) -> None:
        self._size, self._taken = size, 0

    def charge(self, count: int) -> None:
        """Count unpacked bytes; raise an UnpackingError above the limit."""
        self._taken += count
        most = FREE + RATIO * self._size
        if self._taken > most:
            raise UnpackingError(
                f"unpacks to more than {most / MEGABYTE:.0f} MB, which is more than a recording of {self._size} bytes "
                f"can contain (allowed are {FREE // MEGABYTE} MB plus {RATIO} times its size)"
            )

    def blocks(self, stream: BinaryIO) -> Iterator[bytes]:
        """Yield the unpacked blocks of a compressed stream; count each block before the next block is unpacked."""
        while block := stream.read(MEGABYTE):
            self.charge(len(block))
            yield block

    def unpacked(self, stream: BinaryIO) -> bytes:
        """Return the whole unpacked content of a compressed stream, at most AT_ONCE bytes."""
        content = bytearray()
        for block in self.blocks(stream):
            content += block
            check_size(len(content), "a message or chunk")
        return bytes(content)


def check_size(size: int, what: str) -> None:
    if size > AT_ONCE:
        raise UnpackingError(f"{what} unpacks to more than the allowed {AT_ONCE // MEGABYTE} MB")


def zstd_stream(packed: bytes | Path) -> BinaryIO:
    """Return a stream of the unpacked content of Zstandard bytes, or of a Zstandard file."""
    zstd = importlib.import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    return zstd.ZstdFile(BytesIO(packed) if isinstance(packed, bytes) else packed)


def messages(file: Path, allowance: Allowance) -> Iterator[Message]:
    """Yield all messages of a file; damaged bytes raise exceptions of any type."""
    if file.suffix == ".db3":
        yield from _sqlite(file)
        return
    with open(file, "rb") as stream:
        if (head := stream.read(len(MCAP_MAGIC))) != MCAP_MAGIC:
            raise ValueError("is no MCAP file" if head else "seems to be empty")
        yield from _in_records(stream, allowance, {}, {})


def _sqlite(file: Path) -> Iterator[Message]:
    database = sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True)
    try:
        for (name,) in database.execute(EXPANDING):
            raise UnpackingError(f"table {name!r} has computed rows or columns; a recording has only stored ones")
        rows = database.execute("SELECT id, name, type FROM topics WHERE serialization_format = 'cdr'")
        topics = {number: (str(name), str(kind)) for number, name, kind in rows}
        for number, time, raw in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp"):
            if number in topics:
                if not (isinstance(time, int) and isinstance(raw, bytes)):
                    raise ValueError("a row of its table of messages has no time or no bytes")
                yield Message(*topics[number], time, raw)
    finally:
        database.close()


def _records(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield the kind (a number that MCAP defines) and the content of each record of an MCAP file or chunk."""
    while head := stream.read(HEAD.size):
        kind, length = HEAD.unpack(head)
        check_size(length, "a record")
        if len(body := stream.read(length)) < length:
            raise ValueError("ends within a record")
        yield kind, body


def _in_records(
    stream: BinaryIO, allowance: Allowance, schemas: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Iterator[Message]:
    """Yield the messages of MCAP records and chunks; add types to `schemas`, and topics with types to `channels`."""
    for kind, body in _records(stream):
        if kind == MESSAGE:
            number, _, time, _ = MESSAGE_HEAD.unpack_from(body)
            if time >= LATEST:
                raise ValueError(f"has a message whose time stamp of {time} ns exceeds 2⁶³ − 1")
            if number in channels:
                yield Message(*channels[number], time, body[MESSAGE_HEAD.size :])
        elif kind == CHUNK:
            *_, size, checksum = struct.unpack_from("<QQQI", body)
            packing, at = _text(body, 28)
            (length,) = struct.unpack_from("<Q", body, at)
            records = body[at + 8 : at + 8 + length]
            if packing:
                records = allowance.unpacked(UNPACK[packing](records))
            if len(records) != size or (checksum and crc32(records) != checksum):
                raise ValueError("contains a damaged chunk")
            yield from _in_records(BytesIO(records), allowance, schemas, channels)
        elif kind == SCHEMA:
            (number,) = struct.unpack_from("<H", body)
            schemas[number] = _text(body, 2)[0]
        elif kind == CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            topic, after = _text(body, 4)
            if _text(body, after)[0] == "cdr":
                channels[number] = topic, schemas[schema]
        elif kind == DATA_END:
            return
        elif kind not in KINDS:
            raise ValueError(f"contains a record of the unknown kind {kind}")


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Return the text whose 4-byte length is at index `at` of a record, and the index of the byte after the text."""
    (length,) = struct.unpack_from("<I", body, at)
    return body[at + 4 : at + 4 + length].decode(), at + 4 + length


def _lz4(packed: bytes) -> Any:
    from lz4.frame import LZ4FrameFile

    return LZ4FrameFile(BytesIO(packed))


UNPACK: dict[str, Callable[[bytes], Any]] = {"zstd": zstd_stream, "lz4": _lz4}


def cut_off(file: Path) -> bool:
    """Return whether a file is an MCAP file that does not end in MCAP_MAGIC, as if its recorder was killed."""
    if file.suffix != ".mcap" or not file.is_file() or not file.stat().st_size:
        return False
    with open(file, "rb") as stream:
        stream.seek(max(0, file.stat().st_size - len(MCAP_MAGIC)))
        return stream.read() != MCAP_MAGIC
