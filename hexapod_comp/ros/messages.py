"""ROS messages to core types and back; the only module beside ``nodes`` that knows ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from ..core.batch import quaternion_of, write_lengths
from ..errors import CommandError
from ..machine.geometry import STRUT_NAMES
from ..pose import Pose

LARGEST_MESSAGE = 1 << 18
"""Longer messages are refused unread, byte: a thousand times ours. Read, they would fill many times their size."""


def read_message(data: bytes, kind: type) -> Any:
    """Return the message of a type that a subscription got as bytes.

    Raises
    ------
    CommandError
        ``message``: it is too long, or none of this type.
    """
    if len(data) > LARGEST_MESSAGE:
        raise CommandError("message", f"a message must not have more than {LARGEST_MESSAGE} bytes, not {len(data)}")
    try:
        return deserialize_message(data, kind)
    except (RuntimeError, ValueError) as error:  # the middleware's, or a text that is not UTF-8
        raise CommandError("message", f"the message cannot be read: {error}") from error


def pose_numbers(message: PoseStamped) -> tuple[float, float, float, float, float, float, float]:
    """Return x, y, z (m) and the quaternion x, y, z, w of a message."""
    p, q = message.pose.position, message.pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def write_pose(message: PoseStamped, position: np.ndarray, rotation: np.ndarray) -> None:
    """Fill a message's pose from position (m) and rotation matrix."""
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
    """Return a message's pose.

    Raises
    ------
    PoseError
        Not finite, or the quaternion's norm is not 1.
    """
    numbers = pose_numbers(message)
    return Pose.from_quaternion(np.array(numbers[:3]), np.array(numbers[3:]))


class StrutMessage:
    """A JointState of the six struts whose numbers are written in place, to be published again and again.

    The velocity field is filled too: an empty one makes bags that some readers refuse.

    Parameters
    ----------
    frame_id : str, optional
        Of the header.
    names : sequence of str, optional
        The struts' joint names.

    Attributes
    ----------
    message : JointState
        The message.
    position, velocity : ndarray, shape (6,)
        Views of the message's numbers, m and m/s.
    """

    def __init__(self, frame_id: str = "", names: Sequence[str] = STRUT_NAMES) -> None:
        self.message = JointState(name=list(names), position=[0.0] * 6, velocity=[0.0] * 6)
        self.message.header.frame_id = frame_id
        self.position = np.frombuffer(self.message.position, dtype=float)
        self.velocity = np.frombuffer(self.message.velocity, dtype=float)

    def write(self, lengths: np.ndarray, period: float = 0.0) -> None:
        """Write lengths, m, and as velocities their change since the last ones over `period` s; 0: at rest."""
        write_lengths(lengths, period, np.inf, self.position, self.velocity)


LARGEST_LENGTH = 1e150
"""The squares of larger numbers, m, overflow; whether a strut can be so long is a question for limits."""


class StrutReader:
    """Picks the six struts out of JointState messages by name; other joints beside them do not matter.

    Parameters
    ----------
    names : sequence of str, optional
        The struts' joint names, in strut order.

    Attributes
    ----------
    lengths : ndarray, shape (6,)
        Lengths last read, in strut order, m.
    """

    def __init__(self, names: Sequence[str] = STRUT_NAMES) -> None:
        self.lengths = np.zeros(6)
        self._struts, self._names = names, list[str]()
        self._order = np.arange(6)

    def take(self, data: bytes) -> JointState:
        """Read a message that came as bytes, and return it; errors as :func:`read_message` and :meth:`read`."""
        message: JointState = read_message(data, JointState)
        self.read(message)
        return message

    def read(self, message: JointState) -> None:
        """Read a message.

        Raises
        ------
        CommandError
            ``strut_names``, ``strut_count`` or ``not_finite``; the lengths last read stay.
        """
        self.keep(self.pick(message))

    def keep(self, lengths: np.ndarray) -> None:
        """Take lengths as those last read.

        Raises
        ------
        CommandError
            ``not_finite``; the lengths last read stay.
        """
        if not all(abs(length) < LARGEST_LENGTH for length in lengths.tolist()):
            allowed = f"finite and below {LARGEST_LENGTH:g} m"
            raise CommandError("not_finite", f"strut lengths must be {allowed}, not {lengths.tolist()}")
        self.lengths[:] = lengths

    def pick(self, message: JointState) -> np.ndarray:
        """Return a message's six lengths in strut order, whatever their values.

        Raises
        ------
        CommandError
            ``strut_names`` or ``strut_count``.
        """
        if not self._names or message.name != self._names:
            self._order = strut_order(message.name, self._struts)
            self._names = list(message.name)
        joints, positions = len(message.name), len(message.position)
        if joints != positions:
            raise CommandError("strut_count", f"each of {joints} names needs a position, there are {positions}")
        return np.frombuffer(message.position, dtype=float)[self._order]


def strut_order(names: Sequence[str], struts: Sequence[str] = STRUT_NAMES) -> np.ndarray:
    """Return where each of the six struts stands in a list of names.

    Raises
    ------
    CommandError
        ``strut_names``: one is missing, or there twice.
    """
    places_of: dict[str, list[int]] = {name: [] for name in struts}
    for place, name in enumerate(names):
        if name in places_of:
            places_of[name].append(place)
    wrong = [f"{name} {'twice' if places else 'missing'}" for name, places in places_of.items() if len(places) != 1]
    if wrong:
        raise CommandError("strut_names", f"each strut must be named once: {', '.join(wrong)}")
    return np.array([places[0] for places in places_of.values()])
