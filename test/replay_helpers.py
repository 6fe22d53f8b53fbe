"""Common parts of the replay tests: a compensator that keeps its journal like the node, and the writing of bags.

rosbags writes the bags like ``ros2 bag record``: MCAP or sqlite3, with metadata.yaml and message definitions, but
without the offered QoS, which no replay reads and which takes most of the writing. No ROS is needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from hexapod_comp.compensation.compensator import Compensator, pack_pose
from hexapod_comp.compensation.journal import SNAPSHOT_PERIOD, Journal, Source, sources_text, time_of
from hexapod_comp.errors import HexapodError
from hexapod_comp.pose import Pose

CONFIG = Path(__file__).resolve().parents[1] / "config"

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types

KINDS = {
    "tool_pose_command": "geometry_msgs/msg/PoseStamped",
    "tool_pose_estimate": "geometry_msgs/msg/PoseStamped",
    "tool_pose_true": "geometry_msgs/msg/PoseStamped",
    "compensator/journal": "std_msgs/msg/String",
    "compensator/files": "std_msgs/msg/String",
}

BEGAN = 1_795_000_000_994_000_000  # the second command falls into another second
"""Begin of the recordings, ns."""

UP_SINCE = 4321.0987
"""Time since the computer's start at the first command, s."""

MILLISECOND = 1_000_000

Messages = list[tuple[int, str, str, bytes]]
"""Messages as (recorder's time, ns; topic; type; serialised message)."""


def write_bag(
    folder: Path, messages: Messages, storage: str = "mcap", compression: CompressionMode = CompressionMode.NONE
) -> Path:
    """Write a bag into a new folder; return the folder."""
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for time, topic, kind, raw in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time, raw)
    return folder


def serialized(kind: str, message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, kind))


class RecordedMachine:
    """A compensator and its journal, with all messages that a recorder gets and a replay reads or counts."""

    def __init__(
        self,
        namespace: str = "",
        model: str | Path = CONFIG / "paper_machine.yaml",
        geometry: str | Path = CONFIG / "paper.yaml",
    ) -> None:
        self.namespace, self.messages = namespace, Messages()
        geometry_source = Source.read(geometry)
        self.geometry = geometry_source.geometry()
        self.sources = {"geometry": geometry_source}
        self.period = MILLISECOND
        self.now, self.answers = BEGAN, list[np.ndarray]()
        self.compensator = Compensator(self.geometry, self.load(model))
        self.frames = {name: pack_pose(pose) for name, pose in self.geometry.work_frames.items()}
        self.journal = Journal(self.compensator, self.sources, {name: name for name in self.frames})
        self.elapsed = 0.0
        self.page()

    def load(self, path: str | Path) -> Any:
        self.sources["model"] = Source.read(path)
        return self.sources["model"].model(self.geometry.name)

    def keep(self, topic: str, message: Any) -> None:
        """Keep a message as recorded now."""
        kind = KINDS[topic]
        self.messages.append((self.now, f"{self.namespace}/{topic}", kind, serialized(kind, message)))

    def header(self, stamp: int, frame: str = "") -> Any:
        time = TYPES["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return TYPES["std_msgs/msg/Header"](time, frame)

    def keep_pose(self, topic: str, stamp: int, pose: Pose, frame: str = "base") -> tuple[float, ...]:
        """Keep a message of a pose; return its seven numbers."""
        numbers = (*pose.position.tolist(), *Rotation.from_matrix(pose.rotation).as_quat().tolist())
        point = TYPES["geometry_msgs/msg/Point"](*numbers[:3])
        turn = TYPES["geometry_msgs/msg/Quaternion"](*numbers[3:])
        posed = TYPES["geometry_msgs/msg/Pose"](point, turn)
        self.keep(topic, TYPES["geometry_msgs/msg/PoseStamped"](self.header(stamp, frame), posed))
        return numbers

    def keep_text(self, topic: str, text: str) -> None:
        self.keep(topic, TYPES["std_msgs/msg/String"](text))

    def page(self, snapshot: bool = True) -> None:
        self.keep_text("compensator/files", sources_text(self.sources))
        self.elapsed += 2.0 * SNAPSHOT_PERIOD * snapshot
        self.keep_text("compensator/journal", self.journal.page(self.elapsed))

    def send(self, pose: Pose, frame: str = "base", stamped: bool = True) -> bool:
        """Send one command a period after the last; return whether it was answered.

        The answer to a command that is not `stamped` has the time of receipt as its stamp.
        """
        self.now += self.period
        stamp, received = self.now if stamped else 0, UP_SINCE + (self.now - BEGAN) * 1e-9
        numbers = self.keep_pose("tool_pose_command", stamp, pose, frame)
        try:
            self.compensator.step(numbers, time_of(self.now, stamped), self.frames[frame], received)
        except HexapodError as error:
            self.journal.refused(stamp, error.reason, str(error))
            return False
        self.compensator.published(received + 2e-4)
        self.journal.answered(self.now, frame, numbers, (received, received + 2e-4), stamped)
        self.answers.append(np.array([self.compensator.command, self.compensator.correction]))
        return True

    def wave(self, count: int, start: int = 0) -> None:
        """Send a number of commands along a wave that reverses every strut's direction."""
        for n in range(start, start + count):
            self.send(wave_pose(n))


def wave_pose(n: int) -> Pose:
    """Return pose number `n` of a smooth motion of some millimetres and one degree about home."""
    phase = 0.02 * n
    position = np.array([0.004 * np.sin(phase), 0.003 * np.sin(1.3 * phase), 0.4 + 0.002 * np.sin(0.7 * phase)])
    return Pose(position, Rotation.from_euler("XYZ", [0.02 * np.sin(phase), 0.0, 0.01 * np.sin(phase)]).as_matrix())
