"""Conversion of ROS messages to numbers and back. rclpy takes longer to convert a message than the core to compensate a
pose, so commands, struts and pose estimates are read and written as bytes in CDR (OMG DDS-RTPS 9.4.2, 10.2): four bytes
state the encoding; the fields follow, each aligned to its size, counted from the end of these four bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from ..compensation.guards import Sample
from ..core import ffi, lib
from ..core.batch import quaternion_of
from ..errors import CommandError, FrameError, shorten
from ..machine.geometry import STRUT_NAMES
from ..machine.load import check_gravity
from ..pose import Pose

# Longest accepted message, byte: a thousand times as long as the package's messages; parsing takes far more memory
LARGEST_MESSAGE = 1 << 18

# Largest sum of six strut lengths, m, whose squares do not overflow; the stroke is checked later
LARGEST_LENGTH = 1e150

# Shortest time between two stamps for a speed, s, used in place of a shorter one; above the longest the speed is 0
SHORTEST_PERIOD, LONGEST_PERIOD = 1e-4, 1.0

LITTLE_ENDIAN = b"\x00\x01"  # First bytes of a little-endian message in plain CDR

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
    """Return the time in s by which to divide a strut's change of length between two stamps, to get its speed.

    Return 0, for which the speed is published as 0, if the stamps are more than LONGEST_PERIOD apart or not in order.
    Stamps are used, not the times of receipt, so that a replay gives the recorded speeds.
    """
    seconds = (until - since) * 1e-9
    return max(seconds, SHORTEST_PERIOD) if 0.0 < seconds <= LONGEST_PERIOD else 0.0


def read_message(data: bytes, kind: type) -> Any:
    """Return the message of type `kind`, or raise a CommandError (``message``)."""
    if len(data) > LARGEST_MESSAGE:
        raise CommandError("message", f"a message must not have more than {LARGEST_MESSAGE} bytes, not {len(data)}")
    try:
        return deserialize_message(data, kind)
    except (RuntimeError, ValueError) as error:  # raised by the middleware, or for a text that is not UTF-8
        raise CommandError("message", f"the message cannot be read: {error}") from error


def check_frame(frame_id: str, frames: Collection[str]) -> None:
    if frame_id not in frames:
        which = "" if len(frames) == 1 else "one of "
        raise CommandError("frame_id", f"frame_id must be {which}{', '.join(frames)}, not {shorten(frame_id)}")


def read_gravity(message: Vector3Stamped, base: str) -> tuple[float, float, float]:
    """Return gravity, m/s²; raise a HexapodError if its frame is not `base`, or its magnitude is not that on Earth."""
    if message.header.frame_id != base:
        raise FrameError(f"gravity: frame_id must be {base}, not {shorten(message.header.frame_id)}")
    return check_gravity("gravity", (message.vector.x, message.vector.y, message.vector.z))


# ---- poses ----


def pose_numbers(message: PoseStamped) -> tuple[float, float, float, float, float, float, float]:
    p, q = message.pose.position, message.pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def write_pose(message: PoseStamped, position: np.ndarray, rotation: np.ndarray) -> None:
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = position.tolist()
    q.x, q.y, q.z, q.w = quaternion_of(rotation)


def pose_message(pose: Pose, frame_id: str) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = frame_id
    write_pose(message, pose.position, pose.rotation)
    return message


def message_pose(message: PoseStamped) -> Pose:
    """Return a message's pose; raise a PoseError if a number is not finite or the quaternion's norm is not 1."""
    numbers = pose_numbers(message)
    return Pose.from_quaternion(np.array(numbers[:3]), np.array(numbers[3:]))


def command_stamp(stamp: Time) -> int:
    if stamp.nanosec >= _SECOND:
        raise CommandError("message", f"nanosec of the stamp must be below {_SECOND}, not {stamp.nanosec}")
    return nanoseconds_of(stamp)


def read_pose(data: bytes, sample: Sample) -> None:
    """Read a PoseStamped into a sample: stamp, frame, and the values x, y, z (m) and quaternion x, y, z, w."""
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
    """Writer of PoseStamped messages as bytes."""

    def __init__(self, frame_id: str) -> None:
        self._bytes = bytearray(_aligned(_with_text(_HEAD, frame_id), 8) + bytes(_SEVEN.size))
        self._quaternion = ffi.new("double[4]")

    def encoded(self, pose: np.ndarray, stamp: int) -> bytes:
        """Return the bytes of a message with `stamp`, ns, and `pose`: position, m, then rotation matrix by rows."""
        lib.hc_quaternion(ffi.from_buffer("double[9]", pose[3:]), self._quaternion)
        _STAMP.pack_into(self._bytes, _START_AT, *divmod(stamp, _SECOND))
        _SEVEN.pack_into(self._bytes, len(self._bytes) - _SEVEN.size, *pose[:3].tolist(), *self._quaternion)
        return bytes(self._bytes)


# ---- struts ----


def _before_positions(frame_id: str, names: Sequence[str]) -> bytes:
    """Return the bytes of a JointState message with stamp zero, from its start up to its six positions."""
    data = _with_count(_with_text(_HEAD, frame_id), len(names))
    for name in names:
        data = _with_text(data, name)
    return _aligned(_with_count(data, 6), 8)


class StrutBytes:
    """Writer of JointState messages of six struts as bytes. Every message has velocities, since some readers of
    recordings refuse an empty `velocity`."""

    def __init__(self, frame_id: str = "", names: Sequence[str] = STRUT_NAMES) -> None:
        self.stamp = 0  # stamp of the last message, ns; 0 before the first
        self.position, self.velocity = np.zeros(6), np.zeros(6)  # m and m/s
        self._names = _before_positions(frame_id, names)[_START_AT + _STAMP.size :]
        self._at = ffi.from_buffer("double[6]", self.position), ffi.from_buffer("double[6]", self.velocity)

    def encoded(self, lengths: Any, stamp: int, period: float = 0.0, fastest: float = np.inf) -> bytes:
        """Return a message's bytes with `stamp`, ns, and six `lengths`, m; None: the lengths in :attr:`position`.

        A velocity is the change of a length since the last message divided by `period`, s, or zero if `period` is 0. If
        one velocity exceeds `fastest`, m/s, all six velocities are reduced in proportion.
        """
        if lengths is not None:
            lib.hc_write_lengths(lengths, period, fastest, *self._at)
        self.stamp, when = stamp, _STAMP.pack(*divmod(stamp, _SECOND))
        numbers = self.position.tobytes(), _SIX_ALIGNED, self.velocity.tobytes()
        return b"".join((_ENCODING, when, self._names, *numbers, _NONE))


class StrutReader:
    """Reader of six strut lengths in JointState messages; it finds the struts by name and ignores other joints."""

    def __init__(self, names: Sequence[str] = STRUT_NAMES) -> None:
        self._struts, self._names = names, list[str]()
        self._ordered: Callable[[Sequence[float]], tuple[float, ...]] = tuple  # picks six numbers in strut order
        # Layout of the last message: its size, byte; its bytes before the positions, without the stamp; where the
        # positions begin; the bytes that count its velocities; where the count of its efforts, which must be 0, stands
        self._shape: tuple[int, bytes, int, bytes, int] = (0, b"", 0, b"", 0)

    def sample(self, data: bytes, sample: Sample) -> None:
        """Write a message's stamp (ns) and six lengths (m) into a sample; use rclpy only for a new byte layout."""
        size, head, at, velocities, efforts = self._shape
        known = len(data) == size and data[:4] == head[:4] and data[12:at] == head[4:]
        if known and data[at + 48 : at + 52] == velocities and data[efforts : efforts + 4] == _NONE:
            seconds, nanoseconds = _STAMP.unpack_from(data, _START_AT)
            values = self._ordered(_SIX.unpack_from(data, at))
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
        """Return a message's lengths, m, in strut order."""
        lengths = self.read_unchecked(message)
        self.check(lengths.tolist())
        return lengths

    def read_unchecked(self, message: JointState) -> np.ndarray:
        """Return a message's lengths, m, in strut order; lengths may be NaN."""
        if not self._names or message.name != self._names:
            self._ordered = itemgetter(*strut_order(message.name, self._struts).tolist())
            self._names = list(message.name)
        joints, positions = len(message.name), len(message.position)
        if joints != positions:
            raise CommandError(
                "strut_count", f"{joints} joint names need {joints} positions, but there are {positions}"
            )
        return np.array(self._ordered(message.position))

    def check(self, lengths: Sequence[float]) -> None:
        if not sum(map(abs, lengths)) < LARGEST_LENGTH:
            allowed = f"finite and below {LARGEST_LENGTH:g} m"
            raise CommandError("not_finite", f"strut lengths must be {allowed}, not {list(lengths)}")


def strut_order(names: Sequence[str], struts: Sequence[str] = STRUT_NAMES) -> np.ndarray:
    """Return each strut's index in `names`, or raise a CommandError (``strut_names``)."""
    counts = [(name, list(names).count(name)) for name in struts]
    wrong = [f"{name} is {'repeated' if count else 'missing'}" for name, count in counts if count != 1]
    if wrong:
        raise CommandError("strut_names", f"each strut must be named once: {', '.join(wrong)}")
    return np.array([list(names).index(name) for name in struts])
