"""Recording a machine's topics for replay, without ROS 2's own tools: messages as they travel, into an MCAP file."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_msgs.msg import String

from ..errors import HexapodError, InputFileError
from .base import profile
from .process import QUIET, SPIN_PERIOD, RosSession

# Recorded topics, their types, and whether they are offered reliably
TOPICS = {
    "tool_pose_command": (PoseStamped, True),
    "strut_setpoints": (JointState, True),
    "strut_commands": (JointState, True),
    "strut_corrections": (JointState, True),
    "strut_states": (JointState, False),
    "tool_pose_estimate": (PoseStamped, False),
    "tool_pose_true": (PoseStamped, False),
    "temperatures": (Temperature, False),
    "humidity": (RelativeHumidity, False),
    "gravity": (Vector3Stamped, False),
    "wrench": (WrenchStamped, False),
    "outside": (JointState, False),
    "/diagnostics": (DiagnosticArray, True),
}

JOURNAL = "compensator/journal"
KEPT = (JOURNAL, "compensator/files")  # Topics that late subscribers receive too
DEPTH = 1000  # Messages that may wait while the disk is slow: a second of commands

# With less free space than this on its disk, byte, a recording ends: closing it takes pending chunks of 1 MB,
# an index of 300 bytes for each chunk, and others may write to the disk between two checks
RESERVE = 64_000_000

# The disk, and whether the bag is still at its place, are checked at this period, s, and after this many bytes
LOOK_PERIOD, LOOK_AFTER = 1.0, 16_000_000


class BagWriter:
    """Writes messages into a bag, which is closed while its disk still has room to close it."""

    def __init__(self, folder: str | Path) -> None:
        self.counts: dict[str, int] = {}
        self.problem = ""
        self._folder = Path(folder)
        self._connections: dict[str, Any] = {}
        self._looked, self._since_look = time.monotonic(), 0
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise HexapodError("recording needs rosbags, which is not installed: pip install rosbags") from error
        if self._folder.exists():
            raise InputFileError(self._folder, "", "is there already; a recording makes a folder of its own")
        self._store = get_typestore(Stores.ROS2_JAZZY)
        try:
            self._writer = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except OSError as error:
            raise InputFileError(self._folder, "", f"cannot be made: {error.strerror}") from error
        self._check()
        if self.problem:
            self.close()
            shutil.rmtree(self._folder)
            raise InputFileError(self._folder, "", f"cannot be made: {self.problem.partition(';')[0]}")

    def write(self, topic: str, kind: str, data: bytes) -> None:
        """Write a message that arrived now; nothing once there is a :attr:`problem`."""
        if self.problem:
            return
        try:
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
            self._writer.write(self._connections[topic], time.time_ns(), data)
        except OSError as error:
            self.problem = f"{error.strerror}: what came before may be damaged"
            return
        self.counts[topic] = self.counts.get(topic, 0) + 1
        self._since_look += len(data)
        if self._since_look > LOOK_AFTER:
            self._check()

    def check_disk(self) -> None:
        """Detect, periodically, that the bag was removed or its disk gets full."""
        if not self.problem and time.monotonic() - self._looked >= LOOK_PERIOD:
            self._check()

    def _check(self) -> None:
        self._looked, self._since_look = time.monotonic(), 0
        try:
            free = shutil.disk_usage(self._folder).free
        except OSError:
            self.problem = "was removed or moved while it was written"
            return
        if free < RESERVE:
            full = f"less than {RESERVE // 1_000_000} MB are free on its disk"
            self.problem = f"{full}; what was received until then is whole and can be replayed"

    def close(self) -> None:
        """Close the bag; an error is the :attr:`problem`."""
        try:
            self._writer.close()
        except OSError as error:
            self.problem = (
                self.problem or f"metadata.yaml could not be written ({error.strerror}); was the folder moved?"
            )


class BagRecorder(RosSession):
    """Subscribes to a machine's topics and writes them."""

    def __init__(self, folder: str | Path, namespace: str = "") -> None:
        self._bag = BagWriter(folder)
        self.counts = self._bag.counts  # messages of each topic
        super().__init__("hexapod_comp_recorder", namespace, **QUIET)
        for topic, (kind, reliable) in TOPICS.items():
            self._subscribe(topic, kind, profile(DEPTH, reliable))
        for topic in KEPT:
            self._subscribe(topic, String, profile(DEPTH, latched=True))

    def close(self) -> None:
        super().close()
        self._bag.close()

    def run(self, going_on: Callable[[], bool], progress: Callable[[int], object] = lambda messages: None) -> None:
        """Record while a condition, checked at least every 0.1 s, holds, and while the bag can be written."""
        reported = 0
        while going_on() and not self.problem:
            self.spin_once(SPIN_PERIOD)
            self._bag.check_disk()
            total = sum(self.counts.values())
            progress(total - reported)
            reported = total

    @property
    def problem(self) -> str:
        return self._bag.problem

    @property
    def journal(self) -> int:
        return sum(count for topic, count in self.counts.items() if topic.endswith(JOURNAL))

    def _subscribe(self, topic: str, kind: Any, qos: QoSProfile) -> None:
        name = self.node.resolve_topic_name(topic)
        text = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"

        def keep(data: bytes) -> None:
            self._bag.write(name, text, bytes(data))

        self.node.create_subscription(kind, topic, keep, qos, raw=True)
