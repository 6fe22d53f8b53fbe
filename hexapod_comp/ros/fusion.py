"""The pose instrument of a compensator: parses and validates ``tool_pose_measured``, and feeds the drift to the
compensation.

:mod:`hexapod_comp.compensation.fusion` processes the readings; doc/nodes.md has topic and parameters.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped

from ..compensation.compensator import Compensator
from ..compensation.fusion import Fusion, FusionRules, PoseReading, checked_covariance
from ..compensation.guards import Sample
from ..errors import HexapodError
from ..pose import Pose
from .base import MachineNode
from .messages import check_frame, command_stamp, message_pose
from .sensors import SensorTopic
from .status import CompensatorStatus

TOPIC = "tool_pose_measured"
MESSAGES = {"pose_with_covariance": PoseWithCovarianceStamped, "pose": PoseStamped}
FEED_PERIOD = 1.0  # Period at which the drift is passed to the compensation, s: it is slow, and each time makes a model


def fusion_rules(options: dict[str, Any]) -> FusionRules:
    return FusionRules(**{one.name: options[f"fusion.{one.name}"] for one in fields(FusionRules)})


class PoseInstrument:
    """Receives the instrument's readings in a configured node; made only with ``fusion.enabled``."""

    def __init__(
        self, node: MachineNode, compensator: Compensator, status: CompensatorStatus, frames: dict[str, Pose]
    ) -> None:
        self._node, self._status, self._options, self._frames = node, status, status.options, frames
        self._kind = MESSAGES[self._options["fusion.message"]]
        SensorTopic(node, status, TOPIC, self._kind, self._on_reading, self._reject)
        self.fusion, self._fed = Fusion(compensator, fusion_rules(self._options)), -math.inf
        status.fusion = self.fusion

    def follow(self) -> None:
        """Apply the present parameters, from the next reading on."""
        self.fusion.rules = self.fusion.filter.rules = fusion_rules(self._options)

    def reset(self) -> None:
        """Forget the drift; its correction ramps out."""
        self.fusion.reset()
        self._status.pose_stamps.reset()
        self._fed = -math.inf
        self.update(time.monotonic())

    def update(self, now: float) -> None:
        if now - self._fed < FEED_PERIOD:
            return
        self._fed, self._status.drift_problem = now, ""
        try:
            self.fusion.feed(bool(self._options["fusion.compensate"]))
        except HexapodError as error:
            self._status.drift_problem = f"drift not compensated: {error.reason}: {error}"
            self._node.log_warning("drift", self._status.drift_problem)

    def add_struts(self, struts: Sequence[float], made: float) -> None:
        """Store struts, m, of a monotonic time, s, for the readings about them."""
        for error in self.fusion.add_struts(struts, made):
            self._reject(error)

    def weighed(self, pose: np.ndarray) -> np.ndarray:
        """Return the compensator's estimate, weighed with the readings."""
        return self.fusion.weighed(pose)

    def _on_reading(self, message: Any, now: float) -> None:
        sample, gate = Sample(now, command_stamp(message.header.stamp)), self._status.pose_stamps
        check_frame(frame_id := message.header.frame_id, self._frames)
        gate.check(sample)
        stated = [0.0] * 36
        if self._kind is PoseWithCovarianceStamped:
            stated, message = message.pose.covariance, message.pose
        pose, frame = message_pose(message), self._frames[frame_id]
        turn = np.kron(np.eye(2), frame.rotation)
        covariance = turn @ checked_covariance(stated, self.fusion.rules) @ turn.T
        gate.accept(sample)
        if self._node.active:
            for error in self.fusion.add(PoseReading(frame @ pose, now - sample.age, covariance)):
                self._reject(error)

    def _reject(self, error: HexapodError) -> None:
        self._node.ignore(TOPIC, error, self._status.bad_poses)
