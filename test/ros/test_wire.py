"""Messages as bytes: the truth is the middleware's own serialiser, which another code base wrote."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from strategies import fixed

from hexapod_comp.compensation.guards import Sample
from hexapod_comp.core import ffi
from hexapod_comp.errors import CommandError
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros import messages
from hexapod_comp.ros.messages import (
    LARGEST_MESSAGE,
    StrutBytes,
    StrutReader,
    read_message,
    read_pose,
)


def read_pose_bytes(data: bytes) -> tuple:
    """Return stamp, frame and numbers of a pose's bytes."""
    sample = Sample(0.0)
    read_pose(data, sample)
    return sample.stamp, sample.frame_id, sample.values


def made(out: StrutBytes, lengths, stamp: int = 0, period: float = 0.0):
    """Return struts as they are published."""
    return out.made(ffi.from_buffer("double[6]", np.array(lengths, dtype=float)), stamp, period)


NUMBERS = st.lists(st.floats(), min_size=7, max_size=7)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)


def pose(sec: int, nanosec: int, frame_id: str, numbers: list[float]) -> PoseStamped:
    message = PoseStamped()
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = sec, nanosec, frame_id
    for part, names in ((message.pose.position, "xyz"), (message.pose.orientation, "xyzw")):
        for name in names:
            setattr(part, name, numbers.pop(0))
    return message


def same(a: float, b: float) -> bool:
    return a == b or (math.isnan(a) and math.isnan(b))


def reason_of(data: bytes) -> str:
    """Return why bytes are refused, "" when they are read."""
    try:
        _, _, numbers = read_pose_bytes(data)
    except CommandError as error:
        return error.reason
    return "" if len(numbers) == 7 else "numbers are missing"


@fixed
@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1), NAMES, NUMBERS)
def test_every_pose_is_read_as_it_was_sent(sec, nanosec, frame_id, numbers):
    data = serialize_message(pose(sec, nanosec, frame_id, list(numbers)))
    stamp, frame, found = read_pose_bytes(data)
    assert stamp == sec * 10**9 + nanosec
    assert frame == frame_id
    assert all(map(same, found, numbers))


@pytest.mark.parametrize("nanosec", [10**9, 2**32 - 1])
def test_a_stamp_that_is_no_time_is_refused(nanosec):
    assert reason_of(serialize_message(pose(2**31 - 1, nanosec, "base", [0.5] * 7))) == "message"


def test_usual_bytes_are_read_without_a_message(monkeypatch):
    monkeypatch.setattr(messages, "read_message", None)
    for name in ("", "b", "base", "a_frame_id_of_19_xx"):
        assert read_pose_bytes(serialize_message(pose(1, 2, name, [0.5] * 7)))[1:] == (name, (0.5,) * 7)


def test_a_message_that_is_too_long_is_refused_unread(monkeypatch):
    """A quarter of a MB is allowed, a thousand times ours; read, a text of 10 MB would be there several times."""
    monkeypatch.setattr(messages, "deserialize_message", None)
    with pytest.raises(CommandError, match=r"must not have more than 262144 bytes, not 262145") as caught:
        read_message(bytes(LARGEST_MESSAGE + 1), JointState)
    assert caught.value.reason == "message"
    assert reason_of(serialize_message(pose(1, 2, "x" * LARGEST_MESSAGE, [0.5] * 7))) == "message"


def test_struts_are_taken_from_bytes_that_are_theirs():
    reader, numbers = StrutReader(), [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    message = JointState(name=list(STRUT_NAMES), position=numbers)
    message.header.stamp.sec = 7
    assert reader.parse(serialize_message(message)).header.stamp.sec == 7
    assert reader.lengths.tolist() == numbers
    for data in (b"", serialize_message(message)[:40], b"\xff" * 80):
        with pytest.raises(CommandError, match="cannot be read") as caught:
            reader.parse(data)
        assert caught.value.reason == "message"
    assert reader.lengths.tolist() == numbers


def test_bytes_of_the_other_endianness_are_read():
    data = b"\x00\x00\x00\x00" + struct.pack(">iII5s7x7d", 3, 4, 5, b"base\0", *range(7))
    assert read_pose_bytes(data) == (3 * 10**9 + 4, "base", tuple(float(i) for i in range(7)))


@fixed
@given(st.binary(max_size=200))
def test_noise_is_refused_or_read_but_raises_nothing_else(data):
    assert reason_of(data) in ("", "message")


@fixed
@given(st.integers(0, 83), st.integers(0, 255))
def test_a_changed_byte_does_no_harm(at, value):
    data = bytearray(serialize_message(pose(1, 2, "base", [0.5] * 7)))
    data[at] = value
    assert reason_of(bytes(data)) in ("", "message")


@pytest.mark.parametrize("cut", [1, 8, 56, 60, 80])
def test_a_message_cut_short_is_refused(cut):
    data = serialize_message(pose(1, 2, "base", [0.5] * 7))
    with pytest.raises(CommandError):
        read_pose_bytes(data[:-cut])


@fixed
@given(st.lists(st.floats(-10, 10), min_size=6, max_size=6), st.integers(0, 2**31 * 10**9 - 1), NAMES)
def test_struts_are_what_a_message_would_be(lengths, stamp, frame_id):
    out, message = StrutBytes(frame_id), JointState(name=list(STRUT_NAMES))
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    before = [0.0] * 6
    for period in (0.0, 1e-3):
        data = made(out, lengths, stamp, period)
        message.position = lengths
        message.velocity = [(n - o) / period if period else 0.0 for n, o in zip(lengths, before, strict=True)]
        before, lengths = lengths, [2.0 * length for length in lengths]
    assert isinstance(data, bytes)
    assert deserialize_message(data, JointState) == message
    assert out.stamp == stamp


def test_struts_are_as_long_as_their_fields():
    """Counted by CDR's rules, without the bytes that the serialiser leaves behind: readers of bags refuse those."""
    stamp_and_frame, names, numbers = 8 + 4 + 1 + 3, 4 + 6 * (4 + len("strut_1") + 1), (4 + 48) + (4 + 4 + 48)
    assert len(made(StrutBytes(), np.zeros(6))) == 4 + stamp_and_frame + names + numbers + 4


# ---- struts that come again and again ----


def struts(numbers, sec: int = 1, names=STRUT_NAMES, velocity=(), effort=(), frame_id: str = "") -> bytes:
    message = JointState(name=list(names), position=list(numbers), velocity=list(velocity), effort=list(effort))
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = sec, 5, frame_id
    return bytes(serialize_message(message))


def read_struts(reader: StrutReader, data: bytes) -> tuple:
    sample = Sample(0.0)
    reader.sample(data, sample)
    return sample.stamp, sample.values


def outcome(reader: StrutReader, data: bytes) -> object:
    try:
        return repr(read_struts(reader, data))
    except CommandError as error:
        return error.reason


@fixed
@given(
    st.lists(st.lists(st.floats(-10, 10), min_size=6, max_size=6), min_size=2, max_size=5),
    st.permutations(list(STRUT_NAMES)),
    st.booleans(),
    NAMES,
)
def test_struts_of_a_known_layout_are_those_that_rclpy_reads(rows, names, fast, frame_id):
    reader = StrutReader()
    for n, row in enumerate(rows):
        data = struts(row, n + 1, names, [0.25] * 6 if fast else (), frame_id=frame_id)
        message = deserialize_message(data, JointState)
        wanted = tuple(dict(zip(message.name, message.position, strict=True))[name] for name in STRUT_NAMES)
        assert read_struts(reader, data) == ((n + 1) * 10**9 + 5, wanted)


def test_a_known_layout_is_read_without_a_message(monkeypatch):
    reader = StrutReader()
    read_struts(reader, struts([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], velocity=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    monkeypatch.setattr(messages, "read_message", None)
    numbers = [0.6, 0.5, 0.4, 0.3, 0.2, 0.1]
    assert read_struts(reader, struts(numbers, 9, velocity=[0.0] * 6)) == (9 * 10**9 + 5, tuple(numbers))


@fixed
@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_whatever_byte_is_changed_a_reader_that_knows_the_layout_says_what_a_new_one_says(at, value, cut):
    usual = struts([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], velocity=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    knows = StrutReader()
    read_struts(knows, usual)
    data = bytearray(usual)
    data[at % len(data)] = value
    changed = bytes(data) if cut > 60 else bytes(data[: len(data) - cut])
    assert outcome(knows, changed) == outcome(StrutReader(), changed)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e151])
def test_a_known_layout_does_not_let_numbers_pass_that_are_none(value):
    reader = StrutReader()
    for numbers, wanted in (([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], None), ([0.1, 0.2, value, 0.4, 0.5, 0.6], "not_finite")):
        found = outcome(reader, struts(numbers))
        assert found == wanted or wanted is None


@fixed
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3), st.floats(-3, 3), st.integers(0, 2**31 * 10**9 - 1))
def test_a_pose_is_published_as_a_message_would_be(position, turn, stamp):
    out, message = messages.PoseBytes("base"), PoseStamped()
    rotation = np.array(
        [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    messages.write_pose(message, np.array(position), rotation)
    message.header.stamp, message.header.frame_id = messages.stamp_of(stamp), "base"
    data = out.made(np.concatenate([position, rotation.ravel()]), stamp)
    assert isinstance(data, bytes)
    assert deserialize_message(data, PoseStamped) == message
