"""A node with the compensator's topics, message types, QoS and number of messages, which computes nothing.

:mod:`benchmarks.loop` compares it with the compensator. A ``serialized`` relay neither parses nor builds messages: it
always publishes the same bytes with the command's stamp.
"""

from __future__ import annotations

import sys

from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.base import COMMAND_QOS, STATE_QOS, MachineNode
from hexapod_comp.ros.parameters import Program, read_table
from hexapod_comp.ros.process import run

STAMP = slice(4, 12)  # of a serialised message
ESTIMATE_PERIOD = 0.02  # of the compensator's pose estimates, s
PARAMETERS = read_table("serialized | false | | start | receive and publish bytes")


class RelayNode(MachineNode):
    """Answers each pose command with two strut messages that are constant except for their stamp."""

    def __init__(self) -> None:
        super().__init__("relay", PARAMETERS)
        self._serialized = self.options["serialized"]

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._command_pub = self.publish_on(JointState, "strut_commands", COMMAND_QOS)
        self._correction_pub = self.publish_on(JointState, "strut_corrections", COMMAND_QOS)
        self._estimate_pub = self.publish_on(PoseStamped, "tool_pose_estimate", STATE_QOS)
        zeros = [0.0] * 6
        self._command, self._correction = (
            JointState(name=list(STRUT_NAMES), position=zeros, velocity=zeros) for _ in range(2)
        )
        self._bytes, self._estimate, self._answered = serialize_message(self._command), PoseStamped(), False
        callback = self._on_bytes if self._serialized else self._on_command
        topic = "tool_pose_command"
        self.create_subscription(PoseStamped, topic, callback, COMMAND_QOS, raw=self._serialized)
        self.create_timer(ESTIMATE_PERIOD, self._publish_estimate)
        return super().on_configure(state)

    def _on_command(self, message: PoseStamped) -> None:
        stamp = message.header.stamp
        self._command.header.stamp = stamp
        self._command_pub.publish(self._command)
        self._correction.header.stamp = stamp
        self._correction_pub.publish(self._correction)
        self._answered = True

    def _on_bytes(self, data: bytes) -> None:
        stamped = self._bytes[: STAMP.start] + data[STAMP] + self._bytes[STAMP.stop :]
        self._command_pub.publish(stamped)
        self._correction_pub.publish(stamped)
        self._answered = True

    def _publish_estimate(self) -> None:
        if self._answered:
            self._answered = False
            self._estimate_pub.publish(self._estimate)


if __name__ == "__main__":
    sys.exit(run(RelayNode, Program("relay", "Answers each pose with strut messages that never change.", PARAMETERS)))
