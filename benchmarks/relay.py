"""A node that does nothing: the same topics and message types as the compensator, and no thought in between.

It shows what DDS and rclpy cost by themselves; :mod:`benchmarks.loop` holds the compensator against it.
"""

from __future__ import annotations

import sys

from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState

from hexapod_comp.conversions import StrutMessage
from hexapod_comp.nodes.runtime import COMMAND_QOS, MachineNode, run


class RelayNode(MachineNode):
    """Answers every pose command with two strut messages, constant but for the stamp."""

    def __init__(self) -> None:
        super().__init__("relay")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open topics."""
        self._command_pub = self.publish_on(JointState, "strut_commands", COMMAND_QOS)
        self._correction_pub = self.publish_on(JointState, "strut_corrections", COMMAND_QOS)
        self._command, self._correction = StrutMessage().message, StrutMessage().message
        self.listen_to(PoseStamped, "tool_pose_command", self._on_command, COMMAND_QOS)
        return super().on_configure(state)

    def _on_command(self, message: PoseStamped) -> None:
        stamp = message.header.stamp
        self._command.header.stamp = stamp
        self._command_pub.publish(self._command)
        self._correction.header.stamp = stamp
        self._correction_pub.publish(self._correction)


if __name__ == "__main__":
    sys.exit(run(RelayNode))
