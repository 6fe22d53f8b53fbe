"""Records a machine's topics for replay into an MCAP file; the command ``ros2`` need not be installed."""

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

# Recorded topics with their types, and whether to subscribe reliably
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
LATCHED = (JOURNAL, "compensator/files")  # latched topics
DEPTH = 1000  # Length of each topic's queue: one second of commands at 1 kHz, for a slow disk

# Free disk space, byte, at which a recording ends: for the pending chunks of 1 MB, for an index of 300 bytes for each
# chunk, and for what other programs write to the disk between two checks
RESERVE = 64_000_000

# Time, s, and recorded bytes from one check of the free disk space and of the bag's folder to the next
CHECK_PERIOD, CHECK_AFTER = 1.0, 16_000_000


class BagWriter:
    """A bag to which messages are written until the free space of its disk is below RESERVE."""

    def __init__(self, folder: str | Path) -> None:
        self.counts: dict[str, int] = {}
        self.problem = ""
        self._folder = Path(folder)
        self._connections: dict[str, Any] = {}
        self._checked, self._bytes_since_check = time.monotonic(), 0
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise HexapodError("recording needs rosbags, which is not installed: pip install rosbags") from error
        if self._folder.exists():
            raise InputFileError(self._folder, "", "exists already; a recording creates a new folder")
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
        """Write the bytes of a message with the present time; after a :attr:`problem` do nothing."""
        if self.problem:
            return
        try:
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
            self._writer.write(self._connections[topic], time.time_ns(), data)
        except OSError as error:
            self.problem = f"{error.strerror}: the messages that were already written may be damaged"
            return
        self.counts[topic] = self.counts.get(topic, 0) + 1
        self._bytes_since_check += len(data)
        if self._bytes_since_check > CHECK_AFTER:
            self._check()

    def check_disk(self) -> None:
        if not self.problem and time.monotonic() - self._checked >= CHECK_PERIOD:
            self._check()

    def _check(self) -> None:
        self._checked, self._bytes_since_check = time.monotonic(), 0
        try:
            free = shutil.disk_usage(self._folder).free
        except OSError:
            self.problem = "was removed or moved while it was written"
            return
        if free < RESERVE:
            full = f"less than {RESERVE // 1_000_000} MB are free on its disk"
            self.problem = f"{full}; all messages received until then are recorded and can be replayed"

    def close(self) -> None:
        try:
            self._writer.close()
        except OSError as error:
            self.problem = (
                self.problem or f"metadata.yaml could not be written ({error.strerror}); was the folder moved?"
            )


class BagRecorder(RosSession):
    """A node that subscribes to a machine's topics and writes their messages into a bag."""

    def __init__(self, folder: str | Path, namespace: str = "") -> None:
        self._bag = BagWriter(folder)
        self.counts = self._bag.counts  # number of messages of each topic
        super().__init__("hexapod_comp_recorder", namespace, **QUIET)
        for topic, (kind, reliable) in TOPICS.items():
            self._subscribe(topic, kind, profile(DEPTH, reliable))
        for topic in LATCHED:
            self._subscribe(topic, String, profile(DEPTH, latched=True))

    def close(self) -> None:
        super().close()
        self._bag.close()

    def run(self, going_on: Callable[[], bool], progress: Callable[[int], object] = lambda messages: None) -> None:
        """Record until there is a :attr:`problem` or `going_on()`, called at least every 0.1 s, is false."""
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
