"""What a compensator publishes: strut commands and corrections, pose estimates, predicted errors, markers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from visualization_msgs.msg import MarkerArray

from ..compensation.compensator import Compensator
from ..export.robot_description import joint_positions, urdf
from ..pose import Pose
from .command_inputs import STRUTS, nominal_lengths
from .machine_files import MachineFiles
from .markers import machine_markers
from .messages import write_pose
from .predicted_error import PredictedErrorTopics
from .runtime import ACKNOWLEDGED_WITHIN, COMMAND_QOS, EVENT_QOS, STATE_QOS, MachineNode
from .stamps import nanoseconds_of, period
from .vital_signs import LATCHED_QOS, VitalSigns
from .wire import StrutBytes


class CompensatorOutputs:
    """Publishers of a configured compensator.

    Parameters
    ----------
    node : MachineNode
        Publishes.
    compensator : Compensator
        What is published.
    options : dict
        The node's parameters.
    files : MachineFiles
        What the compensator's model was made of.
    """

    def __init__(
        self, node: MachineNode, compensator: Compensator, options: dict[str, Any], files: MachineFiles
    ) -> None:
        self._node, self._compensator, self._frame = node, compensator, options["base_frame"]
        deadline = options["command_timeout"]
        self._commands = node.publish_on(JointState, "strut_commands", COMMAND_QOS, deadline)
        self._corrections = node.publish_on(JointState, "strut_corrections", COMMAND_QOS, deadline)
        self._estimates = node.publish_on(PoseStamped, "tool_pose_estimate", STATE_QOS)
        self._markers = node.create_publisher(MarkerArray, "~/markers", EVENT_QOS)
        self._names = options["joint_names"]
        self._joints: Publisher | None = None
        self._description: Publisher | None = None
        if options["publish_description"]:
            self._joints = node.create_publisher(JointState, "joint_states", EVENT_QOS)
            self._description = node.create_publisher(String, "robot_description", LATCHED_QOS)
            below = options["command_input"] == STRUTS
            self._description.publish(String(data=urdf(compensator.geometry, self._names, ros2_control=below)))
        self._array: Publisher | None = None
        self._nominal: Publisher | None = None
        if options["command_input"] == STRUTS:
            self._nominal = node.publish_on(JointState, "nominal_strut_states", STATE_QOS)
        if options["publish_array"]:
            self._array = node.publish_on(Float64MultiArray, "strut_commands_array", COMMAND_QOS, deadline)
        self._array_out = Float64MultiArray(data=[0.0] * 6)
        self._array_view = np.frombuffer(self._array_out.data, dtype=float)
        self._command_out, self._correction_out = (StrutBytes(names=options["joint_names"]) for _ in range(2))
        self._nominal_out = StrutBytes(names=options["joint_names"])
        self._estimate_out = PoseStamped()
        self._estimate_out.header.frame_id = self._frame
        self._answered, self._fastest = 0, compensator.geometry.limits.speed
        self.signs = VitalSigns(node, options, self.command_topic, lambda: self._answered)
        self._predicted = PredictedErrorTopics(node, compensator, files, options["work_frame"], lambda: self._answered)

    @property
    def command_topic(self) -> str:
        """Full name of the topic of strut commands."""
        return self._commands.topic_name

    @property
    def prediction_problem(self) -> str:
        """Why no error is predicted though somebody listens; empty while all is well."""
        return self._predicted.problem

    def command(self, when: int) -> None:
        """Publish the compensator's command and correction, stamped `when`, ns."""
        self._command_out.write(self._compensator.command, period(self._answered, when), self._fastest)
        self._answered = when
        self._commands.publish(self._command_out.stamped(when))
        self._correction_out.write(self._compensator.correction)
        self._corrections.publish(self._correction_out.stamped(when))
        if self._array is not None:
            self._array_view[:] = self._compensator.command
            self._array.publish(self._array_out)

    def forget(self) -> None:
        """Take the next command as the first: its velocity is zero."""
        self._answered = 0

    def measured(
        self, struts: np.ndarray, pose: np.ndarray, stamp: Time, average: Callable[[np.ndarray], np.ndarray]
    ) -> None:
        """Publish what follows from a reading of the struts, shape (6,), m, and the tool pose estimated from it.

        Controllers start from the nominal lengths, and hold them: those of struts at rest are of their average.
        """
        self.estimate(pose, stamp)
        if self._nominal is not None:
            out, when = self._nominal_out, nanoseconds_of(stamp)
            out.write(nominal_lengths(self._compensator, average(struts)), period(out.stamp, when), self._fastest)
            self._nominal.publish(out.stamped(when))

    def estimate(self, pose: np.ndarray, stamp: Time) -> None:
        """Publish a pose, shape (12,): position, m, and rotation matrix, row by row."""
        write_pose(self._estimate_out, pose[:3], pose[3:].reshape((3, 3)))
        self._estimate_out.header.stamp = stamp
        self._estimates.publish(self._estimate_out)

    def show(self, corrects: bool) -> None:
        """Publish the machine as it stands to who looks: as markers, before the first command without corrections, and
        as the joints of its URDF."""
        now, pose = self._node.get_clock().now().to_msg(), self._compensator.platform_estimate
        geometry = self._compensator.geometry
        if self._markers.get_subscription_count():
            correction = self._compensator.correction if corrects else np.zeros(6)
            self._markers.publish(machine_markers(geometry, *pose, correction, self._frame, now))
        if self._joints is not None and self._joints.get_subscription_count():
            positions = joint_positions(geometry, Pose(*pose), self._names)
            message = JointState(name=list(positions), position=list(positions.values()))
            message.header.stamp = now
            self._joints.publish(message)

    def wait(self) -> None:
        """Wait until the last command has arrived."""
        self._commands.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
        self.signs.wait()

    def close(self) -> None:
        """Destroy the publishers."""
        self._predicted.close()
        self.signs.close()
        always = self._commands, self._corrections, self._estimates, self._markers
        for publisher in (*always, self._joints, self._description, self._array, self._nominal):
            if publisher is not None:
                self._node.destroy_publisher(publisher)
