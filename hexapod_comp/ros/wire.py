"""Commands and struts as the bytes that go over the wire, without message objects in between.

rclpy builds a Python object for every part of a message that comes, and looks at every element of one that goes;
that takes longer than a compensation. A subscription with ``raw=True`` gives the bytes instead, and a publisher
takes bytes. They are CDR (OMG DDS-RTPS 9.4.2, 10.2): four bytes that tell the encoding, then the fields in order,
each at a multiple of its size. Where the layout is not the usual one, rclpy's own conversion is used.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from ..core.batch import write_lengths
from ..errors import CommandError
from ..machine.geometry import STRUT_NAMES
from .messages import LARGEST_MESSAGE, StrutMessage, pose_numbers, read_message
from .stamps import nanoseconds_of, stamp_of

LITTLE_ENDIAN = b"\x00\x01"
"""How plain CDR with the lowest byte first begins."""

_START, _STAMP, _NUMBERS = struct.Struct("<iII"), struct.Struct("<iI"), struct.Struct("<7d")
_START_AT, _FRAME_AT = 4, 16
_SECOND = 1_000_000_000


def read_pose_bytes(data: bytes) -> tuple[int, str, tuple[float, ...]]:
    """Read a serialised PoseStamped.

    Parameters
    ----------
    data : bytes
        What a raw subscription gives.

    Returns
    -------
    stamp : int
        ns.
    frame_id : str
        Frame of the pose.
    numbers : tuple of seven float
        x, y, z (m) and the quaternion x, y, z, w, as :func:`~hexapod_comp.ros.messages.pose_numbers` gives them.

    Raises
    ------
    CommandError
        ``message``: the bytes are no PoseStamped, or its stamp no time.
    """
    if data[:2] == LITTLE_ENDIAN and _FRAME_AT + _NUMBERS.size <= len(data) <= LARGEST_MESSAGE:
        seconds, nanoseconds, length = _START.unpack_from(data, _START_AT)
        end = _FRAME_AT + length
        numbers_at = end + (_START_AT - end) % 8  # alignment counts from behind the four bytes
        fits = numbers_at + _NUMBERS.size == len(data) and nanoseconds < _SECOND
        if fits and (not length or data[end - 1] == 0):
            frame_id = data[_FRAME_AT : end - 1].decode(errors="replace")
            return seconds * _SECOND + nanoseconds, frame_id, _NUMBERS.unpack_from(data, numbers_at)
    return _read_unusual(data)


def _read_unusual(data: bytes) -> tuple[int, str, tuple[float, ...]]:
    """Read a PoseStamped of another encoding as rclpy does."""
    message = read_message(data, PoseStamped)
    return command_stamp(message.header.stamp), message.header.frame_id, pose_numbers(message)


def command_stamp(stamp: Time) -> int:
    """Return a command's stamp, ns.

    Raises
    ------
    CommandError
        ``message``: it is no time; with the largest seconds it would not fit into an answer's stamp.
    """
    if stamp.nanosec >= _SECOND:
        raise CommandError("message", f"nanosec of the stamp must be below {_SECOND}, not {stamp.nanosec}")
    return nanoseconds_of(stamp)


class StrutBytes:
    """A JointState of the six struts as bytes, written in place, to be published again and again.

    Where each number stands is learnt from a message that the middleware's own serialiser has written.

    Parameters
    ----------
    frame_id : str, optional
        Of the header.
    names : sequence of str, optional
        The struts' joint names.

    Attributes
    ----------
    position, velocity : ndarray, shape (6,)
        Views of the message's numbers, m and m/s.
    stamp : int
        Of the message last made, ns; 0 before.
    """

    def __init__(self, frame_id: str = "", names: Sequence[str] = STRUT_NAMES) -> None:
        self.stamp = 0
        self._message: StrutMessage | None = None
        marks = np.arange(1.0, 13.0)
        sample = JointState(name=list(names), position=marks[:6].tolist(), velocity=marks[6:].tolist())
        sample.header.frame_id = frame_id
        sample.header.stamp.sec, sample.header.stamp.nanosec = 0x01020304, 0x05060708
        data = serialize_message(sample)
        wanted = (_STAMP.pack(0x01020304, 0x05060708), marks[:6].tobytes(), marks[6:].tobytes())
        if data[:2] != LITTLE_ENDIAN or any(data.count(part) != 1 for part in wanted):
            self._message = StrutMessage(frame_id, names)
            self.position, self.velocity = self._message.position, self._message.velocity
            return
        stamp, position, velocity = (data.index(part) for part in wanted)
        data = data[: velocity + 48 + 4]  # behind the efforts, none, the serialiser leaves bytes that mean nothing
        spare = -position % 8  # in front, so that numpy finds the numbers at multiples of eight
        whole = np.empty(spare + len(data), np.uint8)
        self._bytes, self._stamp_at = whole[spare:], stamp
        self._bytes[:] = np.frombuffer(data, np.uint8)
        self.position = self._bytes[position : position + 48].view(float)
        self.velocity = self._bytes[velocity : velocity + 48].view(float)
        self.position[:], self.velocity[:] = 0.0, 0.0

    def write(self, lengths: np.ndarray, period: float = 0.0, fastest: float = np.inf) -> None:
        """Write lengths, m, and as velocities their change since the last ones over `period` s; 0: at rest.

        Stamps jitter, and velocities that are larger than `fastest`, m/s, are none: then all are smaller in proportion.
        """
        write_lengths(lengths, period, fastest, self.position, self.velocity)

    def stamped(self, stamp: int) -> bytes | JointState:
        """Return what to publish, with a stamp in ns: bytes, or a message where the layout is not known."""
        self.stamp = stamp
        if self._message is not None:
            self._message.message.header.stamp = stamp_of(stamp)
            return self._message.message
        seconds, nanoseconds = divmod(stamp, _SECOND)
        _STAMP.pack_into(self._bytes.data, self._stamp_at, seconds, nanoseconds)
        return self._bytes.tobytes()
