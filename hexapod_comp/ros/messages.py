"""ROS messages to numbers and back.

rclpy makes a Python object for every part of a received message, and checks every element of a sent one; that takes
longer than a compensation. So commands, struts and pose estimates are read and written as the bytes on the wire: CDR
(OMG DDS-RTPS 9.4.2, 10.2), four bytes for the encoding, then the fields in order, each at a multiple of its size,
counted from behind those four. rclpy reads messages with another layout.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from ..compensation.guards import Sample
from ..core import ffi, lib
from ..core.batch import quaternion_of
from ..errors import CommandError, shorten
from ..machine.geometry import STRUT_NAMES
from ..pose import Pose

# Longer messages are refused without parsing, byte: a thousand times ours. Parsed, they would fill many times their
# size.
LARGEST_MESSAGE = 1 << 18

# The squares of larger numbers, m, overflow; limits check whether a strut can be so long
LARGEST_LENGTH = 1e150

# Smallest difference of two stamps from which a speed is computed, s; for a difference above the other there is
# no speed between them
SHORTEST_PERIOD, LONGEST_PERIOD = 1e-4, 1.0

LITTLE_ENDIAN = b"\x00\x01"  # First bytes of plain CDR, little endian

_ENCODING = LITTLE_ENDIAN + b"\0\0"
_START, _STAMP, _COUNT = struct.Struct("<iII"), struct.Struct("<iI"), struct.Struct("<I")
_SIX, _SEVEN = struct.Struct("<6d"), struct.Struct("<7d")
_START_AT, _FRAME_AT = 4, 16
_SECOND = 1_000_000_000
_HEAD = _ENCODING + bytes(_STAMP.size)
_NONE, _SIX_ALIGNED = _COUNT.pack(0), _COUNT.pack(6) + bytes(4)


def _aligned(data: bytes, size: int) -> bytes:
    return data + bytes((_START_AT - len(data)) % size)


def _with_count(data: bytes, count: int) -> bytes:
    return _aligned(data, 4) + _COUNT.pack(count)


def _with_text(data: bytes, text: str) -> bytes:
    encoded = text.encode() + b"\0"
    return _with_count(data, len(encoded)) + encoded


def nanoseconds_of(stamp: Time) -> int:
    return stamp.sec * _SECOND + stamp.nanosec


def stamp_of(nanoseconds: int) -> Time:
    sec, nanosec = divmod(nanoseconds, _SECOND)
    return Time(sec=sec, nanosec=nanosec)


def period(since: int, until: int) -> float:
    """Return the time between two stamps, ns, by which a strut's speed is computed, s; 0 if there is none.

    It depends on the stamps alone, so that a recorded run answers the same when it is replayed.
    """
    seconds = (until - since) * 1e-9
    return max(seconds, SHORTEST_PERIOD) if 0.0 < seconds <= LONGEST_PERIOD else 0.0


def read_message(data: bytes, kind: type) -> Any:
    """Return the message of a subscription's bytes; a CommandError, ``message``, if it is too long or of another
    type."""
    if len(data) > LARGEST_MESSAGE:
        raise CommandError("message", f"a message must not have more than {LARGEST_MESSAGE} bytes, not {len(data)}")
    try:
        return deserialize_message(data, kind)
    except (RuntimeError, ValueError) as error:  # the middleware's, or a text that is not UTF-8
        raise CommandError("message", f"the message cannot be read: {error}") from error


def check_frame(frame_id: str, frames: Iterable[str]) -> None:
    """Raise a CommandError, ``frame_id``, if a message's frame is not among those allowed."""
    if frame_id not in (allowed := tuple(frames)):
        raise CommandError("frame_id", f"frame_id must be one of {', '.join(allowed)}, not {shorten(frame_id)}")


# ---- poses ----


def pose_numbers(message: PoseStamped) -> tuple[float, float, float, float, float, float, float]:
    p, q = message.pose.position, message.pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def write_pose(message: PoseStamped, position: np.ndarray, rotation: np.ndarray) -> None:
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = position.tolist()
    q.x, q.y, q.z, q.w = quaternion_of(rotation)


def pose_message(pose: Pose, frame_id: str) -> PoseStamped:
    """Return a new message with a zero stamp."""
    message = PoseStamped()
    message.header.frame_id = frame_id
    write_pose(message, pose.position, pose.rotation)
    return message


def message_pose(message: PoseStamped) -> Pose:
    """Return a message's pose; a PoseError where it is not finite, or the quaternion's norm is not 1."""
    numbers = pose_numbers(message)
    return Pose.from_quaternion(np.array(numbers[:3]), np.array(numbers[3:]))


def command_stamp(stamp: Time) -> int:
    """Return a command's stamp, ns; a CommandError, ``message``, if it is not a valid time: with the largest seconds it
    would not fit into an answer's stamp."""
    if stamp.nanosec >= _SECOND:
        raise CommandError("message", f"nanosec of the stamp must be below {_SECOND}, not {stamp.nanosec}")
    return nanoseconds_of(stamp)


def read_pose(data: bytes, sample: Sample) -> None:
    """Read a serialised PoseStamped into a sample: stamp, frame, x, y, z (m) and the quaternion x, y, z, w; a
    CommandError, ``message``, if it is invalid."""
    if data[:2] == LITTLE_ENDIAN and _FRAME_AT + _SEVEN.size <= len(data) <= LARGEST_MESSAGE:
        seconds, nanoseconds, length = _START.unpack_from(data, _START_AT)
        end = _FRAME_AT + length
        numbers_at = end + (_START_AT - end) % 8
        fits = numbers_at + _SEVEN.size == len(data) and nanoseconds < _SECOND
        if fits and (not length or data[end - 1] == 0):
            sample.frame_id = data[_FRAME_AT : end - 1].decode(errors="replace")
            sample.stamp, sample.values = seconds * _SECOND + nanoseconds, _SEVEN.unpack_from(data, numbers_at)
            return
    message = read_message(data, PoseStamped)
    sample.stamp, sample.frame_id = command_stamp(message.header.stamp), message.header.frame_id
    sample.values = pose_numbers(message)


class PoseBytes:
    def __init__(self, frame_id: str) -> None:
        self._bytes = bytearray(_aligned(_with_text(_HEAD, frame_id), 8) + bytes(_SEVEN.size))
        self._quaternion = ffi.new("double[4]")

    def made(self, pose: np.ndarray, stamp: int) -> bytes:
        """Return the bytes to publish: position, m, and rotation matrix by rows, shape (12,), with a stamp in ns."""
        lib.hc_quaternion(ffi.from_buffer("double[9]", pose[3:]), self._quaternion)
        _STAMP.pack_into(self._bytes, _START_AT, *divmod(stamp, _SECOND))
        _SEVEN.pack_into(self._bytes, len(self._bytes) - _SEVEN.size, *pose[:3].tolist(), *self._quaternion)
        return bytes(self._bytes)


# ---- struts ----


def _before_positions(frame_id: str, names: Sequence[str]) -> bytes:
    """Return a JointState of six positions as bytes, up to these, with a stamp of zero."""
    data = _with_count(_with_text(_HEAD, frame_id), len(names))
    for name in names:
        data = _with_text(data, name)
    return _aligned(_with_count(data, 6), 8)


class StrutBytes:
    """A JointState of the six struts as bytes, to be published repeatedly.

    The velocity field is filled too: with an empty one some readers refuse bags.
    """

    def __init__(self, frame_id: str = "", names: Sequence[str] = STRUT_NAMES) -> None:
        self.stamp = 0  # of the previous message, ns; 0 before
        self.position, self.velocity = np.zeros(6), np.zeros(6)  # m and m/s
        self._names = _before_positions(frame_id, names)[_START_AT + _STAMP.size :]
        self._at = ffi.from_buffer("double[6]", self.position), ffi.from_buffer("double[6]", self.velocity)

    def made(self, lengths: Any, stamp: int, period: float = 0.0, fastest: float = np.inf) -> bytes:
        """Return the bytes to publish, with a stamp in ns.

        `lengths`: six, m, a tuple, a list or the core's ``double[6]``; None: position and velocity unchanged.
        Velocities are their change since the last ones over `period` s; 0: at rest. Stamps jitter, and no strut is
        faster than `fastest`, m/s: where one would be, all velocities are smaller in proportion.
        """
        if lengths is not None:
            lib.hc_write_lengths(lengths, period, fastest, *self._at)
        self.stamp, when = stamp, _STAMP.pack(*divmod(stamp, _SECOND))
        numbers = self.position.tobytes(), _SIX_ALIGNED, self.velocity.tobytes()
        return b"".join((_ENCODING, when, self._names, *numbers, _NONE))


class StrutReader:
    """Extracts the six struts, by their joint names, from JointState messages; other joints are ignored."""

    def __init__(self, names: Sequence[str] = STRUT_NAMES) -> None:
        self._struts, self._names = names, list[str]()
        self._order: Sequence[int] = range(6)
        # Layout of the last message: size, bytes before the positions except the stamp, offset of the positions, number
        # of velocities after them, and the offset of the efforts, which are empty.
        self._shape: tuple[int, bytes, int, bytes, int] = (0, b"", 0, b"", 0)

    def sample(self, data: bytes, sample: Sample) -> None:
        """Read a message from bytes into a sample: stamp and lengths, a tuple in strut order.

        A message that differs from the last one only in stamp and numbers is read by the same layout. Errors are
        those of :func:`read_message` and :meth:`read`.
        """
        size, head, at, velocities, efforts = self._shape
        known = len(data) == size and data[:4] == head[:4] and data[12:at] == head[4:]
        if known and data[at + 48 : at + 52] == velocities and data[efforts : efforts + 4] == _NONE:
            seconds, nanoseconds = _STAMP.unpack_from(data, _START_AT)
            numbers = _SIX.unpack_from(data, at)
            values = numbers if self._order == range(6) else tuple(numbers[n] for n in self._order)
            self.check(values)
            sample.stamp, sample.values = seconds * _SECOND + nanoseconds, values
            return
        message: JointState = read_message(data, JointState)
        sample.stamp, sample.values = nanoseconds_of(message.header.stamp), tuple(self.read(message).tolist())
        at, fast = len(_before_positions(message.header.frame_id, message.name)), len(message.velocity)
        efforts, self._shape = at + (104 if fast else 52), (0, b"", 0, b"", 0)
        six = len(message.position) == 6 and fast in (0, 6) and not len(message.effort)
        if six and data[:2] == LITTLE_ENDIAN and data[at : at + 48] == message.position.tobytes():
            self._shape = (len(data), data[:4] + data[12:at], at, _COUNT.pack(fast), efforts)

    def read(self, message: JointState) -> np.ndarray:
        """Return a message's lengths in strut order, m; a CommandError: ``strut_names``, ``strut_count``,
        ``not_finite``."""
        lengths = self.pick(message)
        self.check(lengths.tolist())
        return lengths

    def pick(self, message: JointState) -> np.ndarray:
        """Return a message's six lengths in strut order, whatever their values; errors ``strut_names`` and
        ``strut_count``."""
        if not self._names or message.name != self._names:
            order = strut_order(message.name, self._struts).tolist()
            self._order = range(6) if order == [0, 1, 2, 3, 4, 5] else order
            self._names = list(message.name)
        joints, positions = len(message.name), len(message.position)
        if joints != positions:
            raise CommandError("strut_count", f"each of {joints} names needs a position, there are {positions}")
        return np.frombuffer(message.position, dtype=float)[np.asarray(self._order)]

    def check(self, lengths: Sequence[float]) -> None:
        """Refuse invalid lengths, m: ``not_finite``."""
        if not sum(map(abs, lengths)) < LARGEST_LENGTH:
            allowed = f"finite and below {LARGEST_LENGTH:g} m"
            raise CommandError("not_finite", f"strut lengths must be {allowed}, not {list(lengths)}")


def strut_order(names: Sequence[str], struts: Sequence[str] = STRUT_NAMES) -> np.ndarray:
    """Return the index of each of the six struts in a list of names; a CommandError, ``strut_names``, if one is
    missing, or there twice."""
    counts = [(name, list(names).count(name)) for name in struts]
    wrong = [f"{name} {'twice' if count else 'missing'}" for name, count in counts if count != 1]
    if wrong:
        raise CommandError("strut_names", f"each strut must be named once: {', '.join(wrong)}")
    return np.array([list(names).index(name) for name in struts])
