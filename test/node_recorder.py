"""A recorder of a machine's topics.

It takes messages as they travel, as ``ros2 bag record`` does, with that program's quality of service: reliable where
the publisher is, kept for late subscribers where the publisher does so.
"""

from __future__ import annotations

import time

from geometry_msgs.msg import PoseStamped
from node_helpers import Bench
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from replay_helpers import KINDS, Messages
from sensor_msgs.msg import JointState
from std_msgs.msg import String

TYPES = {"PoseStamped": PoseStamped, "JointState": JointState, "String": String}

BEST_EFFORT = ("tool_pose_estimate", "strut_states", "tool_pose_true")  # Topics that are offered so

OF_THE_DRIVE = ("strut_states", "tool_pose_true")  # Topics that a compensator alone does not have

# The least that ``ros2 bag record`` has ever given a topic; newer ones keep all where the depth is not known
RECORDER_DEPTH = 10


class Recorder:
    """Hears a machine's topics from now on, as serialized messages."""

    def __init__(self, bench: Bench) -> None:
        self.messages, self._bench = Messages(), bench
        node = bench.witness
        self._subscriptions = []
        for topic, kind in KINDS.items():
            kept = topic.startswith("compensator/")
            qos = QoSProfile(
                depth=RECORDER_DEPTH,
                reliability=ReliabilityPolicy.BEST_EFFORT if topic in BEST_EFFORT else ReliabilityPolicy.RELIABLE,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
            )
            name = node.resolve_topic_name(topic)
            message_type = TYPES[kind.rpartition("/")[2]]
            self._subscriptions.append(
                node.create_subscription(message_type, topic, self._keeper(name, kind), qos, raw=True)
            )
        wanted = [s for s in self._subscriptions if not s.topic_name.endswith(OF_THE_DRIVE)]
        bench.until(lambda: all(s.get_publisher_count() for s in wanted), "the recorder's discovery")
        bench.until(lambda: self.heard("/compensator/journal"), "a page of the journal")

    def _keeper(self, topic: str, kind: str):
        return lambda raw: self.messages.append((time.time_ns(), topic, kind, bytes(raw)))

    def heard(self, ending: str) -> int:
        """Return how many messages of a topic have come."""
        return sum(topic.endswith(ending) for _, topic, _, _ in self.messages)

    def stop(self) -> None:
        """Wait until the journal confirms all answers, and hear no more."""
        pages = self.heard("/compensator/journal")
        self._bench.until(lambda: self.heard("/compensator/journal") > pages + 1, "two more pages of the journal")
        for subscription in self._subscriptions:
            self._bench.witness.destroy_subscription(subscription)
