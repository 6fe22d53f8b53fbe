"""Conversion of ROS messages to numbers and back, as bytes and as objects.

The truth is the middleware's own serialiser, other people's code, and SciPy's rotations.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from strategies import often, seeds

from hexapod_comp.compensation.guards import Sample
from hexapod_comp.core import ffi
from hexapod_comp.errors import CommandError, PoseError
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros import messages
from hexapod_comp.ros.messages import (
    LARGEST_MESSAGE,
    StrutBytes,
    StrutReader,
    message_pose,
    pose_message,
    read_message,
    read_pose,
    strut_order,
)

NUMBERS = st.lists(st.floats(), min_size=7, max_size=7)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
LENGTHS = st.lists(st.floats(-10, 10), min_size=6, max_size=6)
SIX = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]

ROUNDING = 1e-15  # a few operations on numbers up to 1 round by 1e-16 each


def pose(numbers: list[float], frame_id: str = "base", sec: int = 1, nanosec: int = 2) -> PoseStamped:
    """Return a pose message from x, y, z and the quaternion x, y, z, w."""
    message = PoseStamped()
    message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id = sec, nanosec, frame_id
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = numbers
    return message


def read_pose_bytes(data: bytes) -> tuple:
    """Return stamp, frame and numbers of a serialised pose."""
    sample = Sample(0.0)
    read_pose(data, sample)
    return sample.stamp, sample.frame_id, sample.values


def reason_of(data: bytes) -> str:
    """Return the reason why bytes are refused, "" if they are read."""
    try:
        _, _, numbers = read_pose_bytes(data)
    except CommandError as error:
        return error.reason
    return "" if len(numbers) == 7 else "numbers are missing"


@pytest.mark.parametrize(
    ("until", "seconds"), [(4, 0.0), (5, 0.0), (1_005, 1e-4), (200_005, 2e-4), (10**9 + 5, 1.0), (10**9 + 6, 0.0)]
)
def test_speeds_are_of_periods_between_a_tenth_of_a_millisecond_and_a_second(until, seconds):
    assert messages.period(5, until) == pytest.approx(seconds, rel=1e-12)


# ---- poses as messages ----


DIAGONALS = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 0.0, -1.0], [1.0, 1.0, 1.0]]
AXES = st.one_of(st.sampled_from(DIAGONALS), seeds.map(lambda seed: np.random.default_rng(seed).normal(size=3)))


@often
@given(AXES, st.one_of(st.just(np.pi), st.floats(0.0, np.pi)), st.floats(-5.0, 5.0), st.floats(0.9995, 1.0005))
def test_a_pose_is_read_as_scipy_reads_it_and_survives_the_wire(axis, angle, x, norm):
    """Any rotation: at half a turn w is zero, so another component must be used; any norm within the tolerance."""
    turn = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    found = message_pose(pose([x, 0.0, -x, *(norm * turn.as_quat()).tolist()]))
    np.testing.assert_array_equal(found.position, [x, 0.0, -x])
    np.testing.assert_allclose(found.rotation, turn.as_matrix(), rtol=0.0, atol=8 * ROUNDING)
    wire = deserialize_message(serialize_message(pose_message(found, "base")), PoseStamped)
    assert (wire.header.frame_id, wire.header.stamp.sec, wire.header.stamp.nanosec) == ("base", 0, 0)
    np.testing.assert_array_equal(message_pose(wire).position, found.position)
    np.testing.assert_allclose(message_pose(wire).rotation, found.rotation, rtol=0.0, atol=8 * ROUNDING)
    q = wire.pose.orientation
    assert np.linalg.norm([q.x, q.y, q.z, q.w]) == pytest.approx(1.0, abs=4 * ROUNDING)


NO_POSES = [
    *(([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, w], "norm 1") for w in (1e-200, 0.9989, 1.0011)),
    ([0.0, 0.0, 0.0, 0.0, 0.0, -math.inf, 1.0], "finite"),
    ([0.0, math.inf, 0.0, 0.0, 0.0, 0.0, 1.0], "must be finite"),
]


@pytest.mark.parametrize(("numbers", "text"), NO_POSES)
def test_what_is_no_pose_is_refused(numbers, text):
    with pytest.raises(PoseError, match=text):
        message_pose(pose(numbers))


# ---- poses as bytes ----


@often
@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1), NAMES, NUMBERS)
def test_every_pose_is_read_as_it_was_sent(sec, nanosec, frame_id, numbers):
    stamp, frame, found = read_pose_bytes(serialize_message(pose(numbers, frame_id, sec, nanosec)))
    assert (stamp, frame) == (sec * 10**9 + nanosec, frame_id)
    np.testing.assert_array_equal(found, numbers)


def test_usual_bytes_are_read_without_a_message(monkeypatch):
    reader = StrutReader()
    read_struts(reader, strut_bytes(SIX, velocity=SIX))
    monkeypatch.setattr(messages, "read_message", None)
    for name in ("", "b", "base", "a_frame_id_of_19_xx"):
        assert read_pose_bytes(serialize_message(pose([0.5] * 7, name)))[1:] == (name, (0.5,) * 7)
    assert read_struts(reader, strut_bytes(SIX[::-1], velocity=[0.0] * 6, sec=9)) == (9 * 10**9 + 5, tuple(SIX[::-1]))


def test_nanoseconds_beyond_a_second_are_refused():
    """With the largest seconds they would overflow the stamp of an answer."""
    with pytest.raises(CommandError, match="nanosec of the stamp must be below 1000000000, not 1000000000"):
        read_pose_bytes(serialize_message(pose([0.5] * 7, "base", 2**31 - 1, 10**9)))


def test_a_message_that_is_too_long_is_refused_unread(monkeypatch):
    """A quarter of a MB, a thousand times our messages, is allowed; a text of 10 MB would be copied several times."""
    monkeypatch.setattr(messages, "deserialize_message", None)
    with pytest.raises(CommandError, match=r"must not have more than 262144 bytes, not 262145") as caught:
        read_message(bytes(LARGEST_MESSAGE + 1), JointState)
    assert caught.value.reason == "message"
    assert reason_of(serialize_message(pose([0.5] * 7, "x" * LARGEST_MESSAGE))) == "message"


def test_bytes_of_the_other_endianness_are_read():
    data = b"\x00\x00\x00\x00" + struct.pack(">iII5s7x7d", 3, 4, 5, b"base\0", *range(7))
    assert read_pose_bytes(data) == (3 * 10**9 + 4, "base", tuple(float(i) for i in range(7)))


@often
@given(st.binary(max_size=200), st.integers(0, 83), st.integers(0, 255))
def test_noise_and_a_changed_byte_are_refused_or_read_but_raise_nothing_else(noise, at, value):
    data = bytearray(serialize_message(pose([0.5] * 7)))
    data[at] = value
    assert {reason_of(noise), reason_of(bytes(data))} <= {"", "message"}
    assert reason_of(serialize_message(pose([0.5] * 7))[: at - 84]) == "message", "cut short"


@often
@given(st.lists(st.floats(-10, 10), min_size=3, max_size=3), st.floats(-3, 3), st.integers(0, 2**31 * 10**9 - 1))
def test_a_pose_is_published_as_a_message_would_be(position, turn, stamp):
    rotation = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    message = pose_message(Pose(position, rotation), "base")
    message.header.stamp = messages.stamp_of(stamp)
    data = messages.PoseBytes("base").encoded(np.concatenate([position, rotation.ravel()]), stamp)
    assert isinstance(data, bytes)
    assert deserialize_message(data, PoseStamped) == message


# ---- struts ----


def strut_message(lengths, names=STRUT_NAMES, velocity=(), effort=(), frame_id: str = "", sec: int = 1) -> JointState:
    message = JointState(name=list(names), position=[float(length) for length in lengths])
    message.velocity, message.effort, message.header.frame_id = list(velocity), list(effort), frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = sec, 5
    return message


def strut_bytes(*arguments, **options) -> bytes:
    return bytes(serialize_message(strut_message(*arguments, **options)))


def read_struts(reader: StrutReader, data: bytes) -> tuple:
    sample = Sample(0.0)
    reader.sample(data, sample)
    return sample.stamp, sample.values


def outcome(reader: StrutReader, data: bytes) -> object:
    try:
        return repr(read_struts(reader, data))
    except CommandError as error:
        return error.reason


WRONG = [
    (STRUT_NAMES[:5], 6, "strut_names"),
    ((*STRUT_NAMES, "gripper"), 6, "strut_count"),
    (STRUT_NAMES, 5, "strut_count"),
    (STRUT_NAMES, 7, "strut_count"),
    (("strut_1", *STRUT_NAMES[:5]), 6, "strut_names"),
]


@pytest.mark.parametrize(("names", "count", "reason"), WRONG)
@pytest.mark.parametrize("known", [True, False])
def test_wrong_names_and_counts_are_refused_every_time(names, count, reason, known):
    """They are refused from the first message on, and after the reader knows the names."""
    reader = StrutReader()
    if known:
        reader.read(strut_message(np.arange(1.0, 7.0)))
    for _ in range(2):
        with pytest.raises(CommandError) as caught:
            reader.read(strut_message(np.ones(count), names))
        assert caught.value.reason == reason
    np.testing.assert_array_equal(reader.read(strut_message(SIX)), SIX)


def test_other_joints_beside_the_struts_do_not_matter():
    """A controller's JointState holds all its joints in any order; the other joints' values are not checked."""
    names = ("spindle", "strut_6", "strut_5", "strut_4", "table", "strut_3", "strut_2", "strut_1", "spindle")
    reader = StrutReader()
    found = reader.read(strut_message([math.nan, *SIX[:2:-1], 1e300, *SIX[2::-1], -1.0], names))
    np.testing.assert_array_equal(found, SIX)
    np.testing.assert_array_equal(strut_order(["strut_2", "strut_1", *STRUT_NAMES[2:]]), [1, 0, 2, 3, 4, 5])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.1e150])
@pytest.mark.parametrize("index", [0, 2, 5])
def test_lengths_that_are_no_numbers_are_refused(index, value):
    """Also the reader that knows the layout of the bytes refuses them; infinities of both signs do not cancel."""
    reader = StrutReader()
    numbers = list(SIX)
    assert outcome(reader, strut_bytes([*SIX[:5], 0.9e150])) != "not_finite"
    numbers[index] = value
    assert outcome(reader, strut_bytes(numbers)) == "not_finite"
    numbers[1] = -value
    with pytest.raises(CommandError, match="must be finite"):
        reader.read(strut_message(numbers))


@often
@given(st.lists(LENGTHS, min_size=2, max_size=5), st.permutations(list(STRUT_NAMES)), st.booleans(), NAMES)
def test_struts_of_a_known_layout_are_those_that_rclpy_reads(rows, names, fast, frame_id):
    reader = StrutReader()
    for n, row in enumerate(rows):
        data = strut_bytes(row, names, [0.25] * 6 if fast else (), frame_id=frame_id, sec=n + 1)
        message = deserialize_message(data, JointState)
        wanted = tuple(dict(zip(message.name, message.position, strict=True))[name] for name in STRUT_NAMES)
        assert read_struts(reader, data) == ((n + 1) * 10**9 + 5, wanted)


@often
@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_whatever_byte_is_changed_a_reader_that_knows_the_layout_says_what_a_new_one_says(at, value, cut):
    usual = strut_bytes(SIX, velocity=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    knows = StrutReader()
    read_struts(knows, usual)
    data = bytearray(usual)
    data[at % len(data)] = value
    changed = bytes(data) if cut > 60 else bytes(data[: len(data) - cut])
    assert outcome(knows, changed) == outcome(StrutReader(), changed)


@often
@given(LENGTHS, st.integers(0, 2**31 * 10**9 - 1), NAMES)
def test_struts_are_what_a_message_would_be(lengths, stamp, frame_id):
    """Position and velocity have six entries: with an empty velocity some readers refuse the bag."""
    out, message = StrutBytes(frame_id), JointState(name=list(STRUT_NAMES))
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    before = [0.0] * 6
    for period in (0.0, 1e-3):
        data = out.encoded(ffi.from_buffer("double[6]", np.array(lengths)), stamp, period)
        message.position = lengths
        message.velocity = [(n - o) / period if period else 0.0 for n, o in zip(lengths, before, strict=True)]
        before, lengths = lengths, [2.0 * length for length in lengths]
    assert isinstance(data, bytes)
    assert deserialize_message(data, JointState) == message
    assert out.stamp == stamp
