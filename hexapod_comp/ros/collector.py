"""A running machine that :func:`~hexapod_comp.measurements.collect.collect` measures: moved by the mover, watched on a
topic of poses."""

from __future__ import annotations

import math
import time

import numpy as np
from geometry_msgs.msg import PoseStamped
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState, Temperature

from ..errors import CommandError, HexapodError, NoAnswerError, shorten
from ..machine.geometry import STRUT_NAMES
from ..machine.temperatures import TEMPERATURE_RANGE, Temperatures
from ..measurements.collect import Observation
from ..measurements.readings import LEAST_NOISE
from ..pose import Pose
from .base import NEWEST_QOS, SENSOR_QOS
from .client import Machine
from .messages import message_pose, nanoseconds_of

MEDIAN_TO_SIGMA = 1.4826  # Standard deviation of a normal distribution over the median of its absolute values
OF_A_MEDIAN = math.sqrt(math.pi / 2.0)  # Its standard deviation, times √n, over that of a reading


class WatchedMachine(Machine):
    """A machine with a mover, and an instrument that publishes poses of its tool in ``base``.

    At each stop the median of `samples` poses that came after the tool had settled is taken, so that single wild ones
    count for nothing; fewer than half within `patience`, s, count as a broken beam.
    """

    def __init__(
        self, topic: str, namespace: str = "", mover: str = "mover", samples: int = 25, patience: float = 2.0
    ) -> None:
        self._samples, self._patience, self._problem = samples, patience, ""
        self._poses, self._struts = list[tuple[Pose, float]](), list[np.ndarray]()
        self._warmth: dict[str, float] = {}
        super().__init__(namespace, mover)
        node = self._session.node
        node.create_subscription(PoseStamped, topic, self._on_pose, SENSOR_QOS)
        node.create_subscription(JointState, "strut_states", self._on_struts, NEWEST_QOS)
        node.create_subscription(Temperature, "temperatures", self._on_temperature, SENSOR_QOS)
        self._topic = node.resolve_topic_name(topic)

    def _on_pose(self, message: PoseStamped) -> None:
        if message.header.frame_id != "base":
            self._problem = f"frame_id must be base, not {shorten(message.header.frame_id)}"
            return
        try:
            self._poses.append((message_pose(message), nanoseconds_of(message.header.stamp) * 1e-9))
        except HexapodError as error:
            self._problem = str(error)

    def _on_struts(self, message: JointState) -> None:
        lengths = dict(zip(message.name, message.position, strict=False))
        if all(math.isfinite(lengths.get(name, math.nan)) for name in STRUT_NAMES):
            self._struts.append(np.array([lengths[name] for name in STRUT_NAMES]))

    def _on_temperature(self, message: Temperature) -> None:
        low, high = TEMPERATURE_RANGE
        if message.header.frame_id in Temperatures.NAMES and low <= message.temperature <= high:
            self._warmth[message.header.frame_id] = message.temperature

    def observe(self) -> Observation | None:
        """Return the median of the next poses; None where too few come."""
        self._poses.clear()
        self._struts.clear()
        self._problem = ""
        end = time.monotonic() + self._patience
        while len(self._poses) < self._samples and time.monotonic() < end:
            self._session.spin_once(0.02)
        if self._problem:
            raise CommandError("instrument", f"{self._topic}: {self._problem}")
        if len(self._poses) < max(3, self._samples // 2):
            if self._session.node.count_publishers(self._topic) == 0:
                raise NoAnswerError(f"nobody publishes {self._topic}")
            return None
        first = self._poses[0][0]
        numbers = np.array(
            [
                np.concatenate([p.position, Rotation.from_matrix(p.rotation @ first.rotation.T).as_rotvec()])
                for p, _ in self._poses
            ]
        )
        middle = np.median(numbers, axis=0)
        spread = MEDIAN_TO_SIGMA * np.median(np.abs(numbers - middle), axis=0)
        return Observation(
            Pose(middle[:3], Rotation.from_rotvec(middle[3:]).as_matrix() @ first.rotation),
            np.maximum(spread * OF_A_MEDIAN / math.sqrt(len(numbers)), LEAST_NOISE),
            tuple(np.mean(self._struts, axis=0).tolist()) if self._struts else None,
            tuple(self._warmth[name] for name in Temperatures.NAMES) if len(self._warmth) == 8 else None,
            self._poses[-1][1],
        )
