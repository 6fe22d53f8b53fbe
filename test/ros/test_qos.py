"""What the nodes offer and ask for: queues, reliability, and what a user may override.

Truth: the request-and-offer rule of DDS: a reliable subscription is not served by a best-effort publisher. Who
subscribes with rclpy's default settings hears everything that the nodes publish.
"""

from __future__ import annotations

from typing import Any

import pytest
from hal_stand_in import StandInHal
from node_helpers import Rig
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_check_compatible

from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.strut_drive import StrutDriveNode

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = ReliabilityPolicy.RELIABLE

NODES = {
    "compensator": (CompensatorNode, {"command_input": "struts", "publish_array": True}),
    "strut_drive": (StrutDriveNode, {}),
    "linuxcnc_bridge": (LinuxcncBridgeNode, {}),
}
COMMANDS = {"/strut_setpoints", "/strut_commands", "/strut_corrections", "/strut_commands_array"}
LATCHED = {
    "compensator": {
        *(f"/compensator/{name}" for name in ("files", "journal", "stopped", "tool")),
        "/robot_description",
    },
    "strut_drive": set(),
    "linuxcnc_bridge": set(),
}
"""For late subscribers."""
STATES = {"/strut_states", "/tool_pose_estimate", "/nominal_strut_states", "/tool_pose_true"}


def made(rig: Rig, name: str, **overrides: object) -> Any:
    """Return a node whose topics are open."""
    kind, parameters = NODES[name]
    hal = {"hal": StandInHal()} if kind is LinuxcncBridgeNode else {}
    node = rig.add(kind, False, parameters | overrides, **hal)
    node.trigger_configure()
    return node


@pytest.mark.parametrize("name", NODES)
def test_default_subscribers_hear_all_that_is_published(rig: Rig, name: str) -> None:
    """Commands reliable, in a queue of a hundred; of states the newest only."""
    node = made(rig, name)
    for end in node.publishers:
        for wanted in (QoSProfile(depth=10), BEST_EFFORT):
            assert "ERROR" not in str(qos_check_compatible(end.qos_profile, wanted)[0]), end.topic_name
        assert end.qos_profile.reliability == RELIABLE, end.topic_name
    for end in (*node.publishers, *node.subscriptions):
        if end.topic_name in COMMANDS | STATES:
            queue = 100 if end.topic_name in COMMANDS else 1
            assert (end.qos_profile.depth, end.qos_profile.history) == (queue, HistoryPolicy.KEEP_LAST), end.topic_name
            reading = name == "compensator" and end.topic_name == "/strut_states"
            assert end.qos_profile.reliability == (ReliabilityPolicy.BEST_EFFORT if reading else RELIABLE)
    kept = {end.topic_name for end in node.publishers if end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL}
    assert kept == LATCHED[name]


def test_readings_are_heard_from_best_effort_publishers_too(rig: Rig) -> None:
    heard = {end.topic_name: end.qos_profile for end in made(rig, "compensator").subscriptions}
    for topic in ("/strut_states", "/temperatures", "/humidity", "/gravity", "/wrench", "/outside"):
        assert "ERROR" not in str(qos_check_compatible(BEST_EFFORT, heard[topic])[0]), topic


def test_what_is_named_can_be_overridden_and_nothing_else(rig: Rig) -> None:
    overrides = {
        "qos_overrides./strut_states.subscription.reliability": "reliable",
        "qos_overrides./strut_commands.publisher.depth": 7,
    }
    node = made(rig, "compensator", **overrides)
    ends = {end.topic_name: end.qos_profile for end in (*node.publishers, *node.subscriptions)}
    assert ends["/strut_states"].reliability == RELIABLE
    assert ends["/strut_commands"].depth == 7
    assert ends["/strut_corrections"].depth == 100
