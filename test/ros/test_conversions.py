"""ROS messages to core types and back; rotations against SciPy, which knows nothing of this package."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from strategies import fixed, seeds

from hexapod_comp.core.batch import quaternion_of
from hexapod_comp.errors import CommandError, PoseError
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import StrutBytes, StrutReader, message_pose, pose_message, pose_numbers, strut_order

ROUNDING = 1e-15
"""A few operations on numbers up to 1: some 1e-16 each."""


def quaternion_message(x: float, y: float, z: float, w: float) -> PoseStamped:
    message = PoseStamped()
    q = message.pose.orientation
    q.x, q.y, q.z, q.w = x, y, z, w
    return message


# ---- poses ----


@fixed
@given(seeds, st.floats(-5.0, 5.0), st.floats(0.9995, 1.0005))
def test_reader_agrees_with_scipy(seed, x, norm):
    """Any rotation, any position, a norm that is 1 within the tolerance."""
    turn = Rotation.random(random_state=seed)
    message = quaternion_message(*(norm * turn.as_quat()).tolist())
    message.pose.position.x, message.pose.position.z = x, -x
    pose = message_pose(message)
    np.testing.assert_array_equal(pose.position, [x, 0.0, -x])
    np.testing.assert_allclose(pose.rotation, turn.as_matrix(), rtol=0.0, atol=4 * ROUNDING)


HALF_TURNS = [
    Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis))
    for axis in np.array(
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0], [1.0, 0.0, -1.0], [1.0, 1.0, 1.0]]
    )
]


@pytest.mark.parametrize("turn", [Rotation.identity(), *HALF_TURNS])
def test_quaternion_where_w_vanishes(turn):
    """At half a turn w is zero, and the quaternion must come from another component."""
    found = np.array(quaternion_of(turn.as_matrix()))
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=4 * ROUNDING)
    assert abs(found @ turn.as_quat()) == pytest.approx(1.0, abs=4 * ROUNDING)  # q and −q are one rotation


@fixed
@given(seeds, st.floats(0.0, np.pi))
def test_quaternion_agrees_with_scipy(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    found = np.array(quaternion_of(turn.as_matrix()))
    assert abs(found @ turn.as_quat()) == pytest.approx(1.0, abs=4 * ROUNDING)
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), turn.as_matrix(), rtol=0.0, atol=8 * ROUNDING)


@fixed
@given(seeds)
def test_pose_survives_the_wire(seed):
    pose = Pose(np.random.default_rng(seed).normal(size=3), Rotation.random(random_state=seed).as_matrix())
    wire = deserialize_message(serialize_message(pose_message(pose, "base")), PoseStamped)
    assert wire.header.frame_id == "base"
    assert (wire.header.stamp.sec, wire.header.stamp.nanosec) == (0, 0)
    back = message_pose(wire)
    np.testing.assert_array_equal(back.position, pose.position)
    np.testing.assert_allclose(back.rotation, pose.rotation, rtol=0.0, atol=8 * ROUNDING)


def test_numbers_come_in_the_order_that_they_say():
    message = quaternion_message(4.0, 5.0, 6.0, 7.0)
    message.pose.position.x, message.pose.position.y, message.pose.position.z = 1.0, 2.0, 3.0
    assert pose_numbers(message) == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)


@pytest.mark.parametrize(
    ("quaternion", "text"),
    [
        ((0.0, 0.0, 0.0, 0.0), "norm 1"),
        ((0.0, 0.0, 0.0, 1.0011), "norm 1"),
        ((0.0, 0.0, 0.0, 0.9989), "norm 1"),
        ((1e-200, 0.0, 0.0, 0.0), "norm 1"),
        ((math.nan, 0.0, 0.0, 1.0), "finite"),
        ((0.0, 0.0, -math.inf, 1.0), "finite"),
    ],
)
def test_bad_quaternions_are_refused(quaternion, text):
    with pytest.raises(PoseError, match=text):
        message_pose(quaternion_message(*quaternion))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", "xyz")
def test_positions_that_are_no_numbers_are_refused(axis, value):
    message = quaternion_message(0.0, 0.0, 0.0, 1.0)
    setattr(message.pose.position, axis, value)
    with pytest.raises(PoseError, match="must be finite"):
        message_pose(message)


# ---- struts ----


def strut_message(lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES) -> JointState:
    return JointState(name=list(names), position=[float(value) for value in lengths])


@fixed
@given(st.permutations(range(6)))
def test_struts_are_matched_by_name(order):
    lengths = np.linspace(0.4, 0.9, 6)
    reader = StrutReader()
    reader.read(strut_message(np.zeros(6)))
    reader.read(strut_message(lengths[list(order)], tuple(STRUT_NAMES[i] for i in order)))
    np.testing.assert_array_equal(reader.lengths, lengths)


@pytest.mark.parametrize(
    ("names", "count", "reason"),
    [
        (STRUT_NAMES[:5], 6, "strut_names"),
        ((*STRUT_NAMES, "strut_1"), 7, "strut_names"),
        ((), 6, "strut_names"),
        ((), 0, "strut_names"),
        ((*STRUT_NAMES, "gripper"), 6, "strut_count"),
        (STRUT_NAMES, 5, "strut_count"),
        (STRUT_NAMES, 7, "strut_count"),
        (STRUT_NAMES, 0, "strut_count"),
        (("strut_1", *STRUT_NAMES[:5]), 6, "strut_names"),
        (("Strut_1", *STRUT_NAMES[1:]), 6, "strut_names"),
        (("", *STRUT_NAMES[1:]), 6, "strut_names"),
    ],
)
def test_wrong_names_and_counts_are_refused_every_time(names, count, reason):
    """Also the second time, when the reader already knows the names; what was read before stays."""
    reader = StrutReader()
    reader.read(strut_message(np.arange(1.0, 7.0)))
    for _ in range(2):
        with pytest.raises(CommandError) as caught:
            reader.read(strut_message(np.ones(count), names))
        assert caught.value.reason == reason
    np.testing.assert_array_equal(reader.lengths, np.arange(1.0, 7.0))
    reader.read(strut_message(np.full(6, 0.5)))
    np.testing.assert_array_equal(reader.lengths, 0.5)


@pytest.mark.parametrize("count", [6, 0])
def test_a_message_without_names_is_refused_from_the_first_one_on(count):
    """Which number is which strut's nobody has said, also while no message with names has come yet."""
    reader = StrutReader()
    with pytest.raises(CommandError, match="named once: strut_1 missing, strut_2 missing") as caught:
        reader.read(strut_message(np.full(count, 0.5), ()))
    assert caught.value.reason == "strut_names"
    np.testing.assert_array_equal(reader.lengths, 0.0)


def test_other_joints_beside_the_struts_do_not_matter():
    """A controller's JointState holds all its joints, in any order; what the others read is not ours to judge."""
    reader = StrutReader()
    names = ("spindle", "strut_6", "strut_5", "strut_4", "table", "strut_3", "strut_2", "strut_1", "spindle")
    reader.read(strut_message(np.array([math.nan, 0.6, 0.5, 0.4, 1e300, 0.3, 0.2, 0.1, -1.0]), names))
    np.testing.assert_array_equal(reader.lengths, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    reader.read(strut_message(np.array([0.5] * 6)))
    np.testing.assert_array_equal(reader.lengths, 0.5)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("index", [0, 5])
def test_lengths_that_are_no_numbers_are_refused(index, value):
    lengths = np.arange(1.0, 7.0)
    reader = StrutReader()
    reader.read(strut_message(lengths))
    lengths[index] = value
    with pytest.raises(CommandError, match="must be finite") as caught:
        reader.read(strut_message(lengths))
    assert caught.value.reason == "not_finite"
    np.testing.assert_array_equal(reader.lengths, np.arange(1.0, 7.0))


def test_infinities_of_both_signs_do_not_cancel():
    with pytest.raises(CommandError, match="must be finite"):
        StrutReader().read(strut_message(np.array([math.inf, -math.inf, 1.0, 1.0, 1.0, 1.0])))


def test_order_says_where_each_strut_stands():
    names = ["strut_2", "strut_1", "strut_3", "strut_6", "strut_4", "strut_5"]
    np.testing.assert_array_equal(strut_order(names), [1, 0, 2, 4, 5, 3])


def test_strut_message_is_complete():
    """Position and velocity both have six entries: an empty velocity makes bags that some readers refuse."""
    out = StrutBytes("base")
    wire = deserialize_message(out.made([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 0), JointState)
    assert wire.header.frame_id == "base"
    assert wire.name == list(STRUT_NAMES)
    assert list(wire.position) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert list(wire.velocity) == [0.0] * 6
    assert list(wire.effort) == []
    wire = deserialize_message(out.made([1.5, 2.5, 3.5, 4.5, 5.5, 6.5], 0, 0.1), JointState)
    assert list(wire.position) == [1.5, 2.5, 3.5, 4.5, 5.5, 6.5]
    np.testing.assert_allclose(wire.velocity, 5.0, rtol=1e-12)
