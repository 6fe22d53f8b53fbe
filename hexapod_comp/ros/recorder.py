"""Recording a machine's topics for replay, without ROS 2's own tools: messages as they travel, into an MCAP file."""

from __future__ import annotations

import contextlib
import os
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
from .process import QUIET, SPIN_PERIOD, RosSession

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

RESERVE, RESERVE_PER_GB = 4_000_000, 1_000_000
"""Bytes kept free for closing the bag on a disk that got full: two chunks of 1 MB on their way, and the index, which
has some 300 bytes for each chunk."""

LOOK_PERIOD = 1.0
"""Time between two looks whether the bag is still where it was made, s."""


class BagWriter:
    """Writes messages into a bag, which is whole at its end also where the disk gets full."""

    def __init__(self, folder: str | Path) -> None:
        self.counts: dict[str, int] = {}
        self.problem = ""
        self._folder = Path(folder)
        self._connections: dict[str, Any] = {}
        self._looked = time.monotonic()
        self._writer, self._store = _open(self._folder)
        try:
            self._file = _File(self._writer.storage.bio, self._folder / ".reserve")
        except OSError as error:
            raise InputFileError(self._folder, "", f"cannot be made: {error.strerror}") from error
        self._writer.storage.bio = self._file

    def write(self, topic: str, kind: str, data: bytes) -> None:
        """Write a message that came now; nothing once there is a :attr:`problem`."""
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
        if self._file.full:
            self.problem = f"{self._file.full}; what was heard until then is whole and can be replayed"

    def look(self) -> None:
        """Notice, once in a while, that the bag was removed."""
        if self.problem or time.monotonic() - self._looked < LOOK_PERIOD:
            return
        self._looked = time.monotonic()
        if self._file.removed():
            self.problem = "was removed while it was written; nothing is left of it"

    def close(self) -> None:
        """Close the bag; what goes wrong is the :attr:`problem`."""
        self._file.give_back()
        if not self.problem and self._file.removed():
            self.problem = "was removed while it was written; nothing is left of it"
        try:
            self._writer.close()
        except OSError as error:
            self._file.close()
            self.problem = (
                self.problem or f"metadata.yaml could not be written ({error.strerror}); was the folder moved?"
            )


class _File:
    """The bag's file: where the disk is full, what was kept free is given back, and writing goes on to close it."""

    def __init__(self, file: Any, reserve: Path) -> None:
        file.flush()
        self.full = ""
        self._file, self._reserve = file, reserve
        self._kept, self._left = RESERVE, 1_000_000_000
        self._descriptor: int | None = os.open(reserve, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        try:
            os.posix_fallocate(self._descriptor, 0, self._kept)
        except BaseException:
            self.give_back()
            raise

    def write(self, data: Any) -> int:
        """Write all of some bytes."""
        view = memoryview(data)
        while len(view):
            try:
                view = view[os.write(self._file.fileno(), view) :]
                continue
            except OSError as error:
                if self._descriptor is None:
                    raise
                self.full = str(error.strerror)
            self.give_back()
        self._left -= len(data)
        if self._left < 0 and self._descriptor is not None:
            self._left += 1_000_000_000
            try:
                os.posix_fallocate(self._descriptor, self._kept, RESERVE_PER_GB)
                self._kept += RESERVE_PER_GB
            except OSError as error:
                self.full = str(error.strerror)
                self.give_back()
        return len(data)

    def tell(self) -> int:
        """Return how much was written, bytes."""
        return os.lseek(self._file.fileno(), 0, os.SEEK_CUR)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def removed(self) -> bool:
        """Return whether nobody can find the file any more."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def give_back(self) -> None:
        """Give the reserve back."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
            with contextlib.suppress(OSError):  # the folder may be gone
                self._reserve.unlink()


class BagRecorder:
    """Hears a machine's topics and writes them."""

    def __init__(self, folder: str | Path, namespace: str = "") -> None:
        self._bag = BagWriter(folder)
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
        self._bag.close()

    def run(self, going_on: Callable[[], bool], progress: Callable[[int], object] = lambda messages: None) -> None:
        """Record while something holds, at least looked at every 0.1 s, and while the bag can be written."""
        reported = 0
        while going_on() and not self.problem:
            self._session.spin_once(SPIN_PERIOD)
            self._bag.look()
            total = sum(self.counts.values())
            progress(total - reported)
            reported = total

    @property
    def counts(self) -> dict[str, int]:
        """Messages of each topic."""
        return self._bag.counts

    @property
    def problem(self) -> str:
        """Why nothing more is written; empty while all is well."""
        return self._bag.problem

    @property
    def journal(self) -> int:
        """Messages of the compensator's journal: without one nothing can be replayed."""
        return sum(count for topic, count in self.counts.items() if topic.endswith(KEPT[0]))

    def _hear(self, topic: str, kind: Any, qos: QoSProfile) -> None:
        name = self._session.node.resolve_topic_name(topic)
        text = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"

        def keep(data: bytes) -> None:
            self._bag.write(name, text, bytes(data))

        self._session.node.create_subscription(kind, topic, keep, qos, raw=True)


def _reliability(reliable: bool) -> ReliabilityPolicy:
    return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT


def _open(folder: Path) -> tuple[Any, Any]:
    """Return an open bag, and its types."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise HexapodError("recording needs rosbags, which is not installed: pip install rosbags") from error
    if folder.exists():
        raise InputFileError(folder, "", "is there already; a recording makes a folder of its own")
    try:
        writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.open()
    except OSError as error:
        raise InputFileError(folder, "", f"cannot be made: {error.strerror}") from error
    return writer, get_typestore(Stores.ROS2_JAZZY)
