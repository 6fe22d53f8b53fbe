"""Recording a machine's topics for replay, without ROS 2's own tools: messages as they travel, into an MCAP file."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_msgs.msg import String

from ..errors import HexapodError, InputFileError
from .ros_session import QUIET, RosSession
from .running import SPIN_PERIOD

COMPENSATOR = "compensator"

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
    "/diagnostics": (DiagnosticArray, True),
}
"""What is recorded, its type, and whether it is offered reliably."""

KEPT = (f"{COMPENSATOR}/journal", f"{COMPENSATOR}/files")
"""Topics that who comes late is given too."""

DEPTH = 1000
"""Messages that may wait while the disk is slow: a second of commands."""


class BagRecorder:
    """Hears a machine's topics and writes them.

    Parameters
    ----------
    folder : str or Path
        For the bag; must not be there yet.
    namespace : str
        Where the machine's nodes are.

    Raises
    ------
    HexapodError
        rosbags is not installed.
    InputFileError
        The folder is there already, or cannot be made.

    Attributes
    ----------
    counts : dict of str to int
        Messages of each topic.
    """

    def __init__(self, folder: str | Path, namespace: str = "") -> None:
        self.counts: dict[str, int] = {}
        self._connections: dict[str, Any] = {}
        self._writer, self._store = _open(Path(folder))
        self._session = RosSession("hexapod_comp_recorder", namespace, **QUIET)
        for topic, (kind, reliable) in TOPICS.items():
            self._hear(topic, kind, QoSProfile(depth=DEPTH, reliability=_reliability(reliable)))
        for topic in KEPT:
            kept = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._hear(topic, String, kept)

    def __enter__(self) -> BagRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._session.close()
        self._writer.close()

    def run(self, going_on: Callable[[], bool], progress: Callable[[int], object] = lambda messages: None) -> None:
        """Record while something holds, at least looked at every 0.1 s."""
        reported = 0
        while going_on():
            self._session.spin_once(SPIN_PERIOD)
            total = sum(self.counts.values())
            progress(total - reported)
            reported = total

    @property
    def journal(self) -> int:
        """Messages of the compensator's journal: without one nothing can be replayed."""
        return sum(count for topic, count in self.counts.items() if topic.endswith(KEPT[0]))

    def _hear(self, topic: str, kind: Any, qos: QoSProfile) -> None:
        name = self._session.node.resolve_topic_name(topic)
        text = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"

        def keep(data: bytes) -> None:
            if name not in self._connections:
                self._connections[name] = self._writer.add_connection(name, text, typestore=self._store)
            self._writer.write(self._connections[name], time.time_ns(), bytes(data))
            self.counts[name] = self.counts.get(name, 0) + 1

        self._session.node.create_subscription(kind, topic, keep, qos, raw=True)


def _reliability(reliable: bool) -> ReliabilityPolicy:
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


def _open(folder: Path) -> tuple[Any, Any]:
    """Return an open bag, and its types."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise HexapodError("recording needs rosbags, which is not installed: pip install hexapod_comp[bags]") from error
    if folder.exists():
        raise InputFileError(folder, "", "is there already; a recording makes a folder of its own")
    try:
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.open()
    except OSError as error:
        raise InputFileError(folder, "", f"cannot be made: {error.strerror}") from error
    return writer, get_typestore(Stores.ROS2_JAZZY)
