"""Who subscribes with rclpy's default settings hears everything that the nodes publish.

Truth: the request-and-offer rule of DDS: a reliable subscription is not served by a best-effort publisher.
"""

from __future__ import annotations

import pytest
from hal_stand_in import StandInHal
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_check_compatible

from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.strut_drive import StrutDriveNode

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize(
    ("kind", "options", "states"),
    [
        (CompensatorNode, {"command_input": "struts"}, {"/nominal_strut_states", "/tool_pose_estimate"}),
        (StrutDriveNode, {}, {"/strut_states", "/tool_pose_true"}),
        (LinuxcncBridgeNode, {}, {"/strut_states"}),
    ],
)
def test_default_subscribers_hear_all_that_is_published(kind, options, states, ros_context: Context) -> None:
    hal = {"hal": StandInHal()} if kind is LinuxcncBridgeNode else {}
    overrides = [Parameter(name, value=value) for name, value in options.items()]
    node = kind(context=ros_context, parameter_overrides=overrides, **hal)
    node.trigger_configure()
    offered = {publisher.topic_name: publisher.qos_profile for publisher in node.publishers}
    for topic, profile in offered.items():
        for wanted in (QoSProfile(depth=10), BEST_EFFORT):
            assert "ERROR" not in str(qos_check_compatible(profile, wanted)[0]), topic
    assert {topic for topic, profile in offered.items() if profile.depth == 1 and topic in states} == states
    node.destroy_node()


def test_readings_are_heard_from_best_effort_publishers_too(ros_context: Context) -> None:
    node = CompensatorNode(context=ros_context)
    node.trigger_configure()
    heard = {end.topic_name: end.qos_profile for end in node.subscriptions}
    for topic in ("/strut_states", "/temperatures", "/humidity", "/gravity", "/wrench"):
        assert "ERROR" not in str(qos_check_compatible(BEST_EFFORT, heard[topic])[0]), topic
    node.destroy_node()
