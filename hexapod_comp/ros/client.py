"""A client of the two nodes: sends poses, keeps what comes back. Used by ``run``, ``demo`` and benchmarks."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from ..errors import NoAnswerError
from ..machine.trajectory import Path
from ..pose import Pose
from .base import COMMAND_QOS, EVENT_QOS, NEWEST_QOS
from .messages import StrutReader, message_pose, nanoseconds_of, pose_message
from .process import RosSession
from .status import status_prefix

# Answers are all kept until they are read: a witness must not lose any
LISTENER_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)

TRACK_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)

# A command without an answer after this long is lost, s: a busy computer may hold it up for seconds
ANSWER_TIMEOUT = 5.0


@dataclass
class Sent:
    """One command on its way."""

    sent_at: float  # monotonic times, s; NaN while unanswered
    refused: int  # commands refused before, and those of them for their age
    too_old: int
    message: PoseStamped
    answered_at: float = float("nan")  # monotonic times, s; NaN while unanswered
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # shape (6,): The answer, m
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # shape (6,): The answer, m


class LoopClient:
    """Commands the compensator and listens to everything around it."""

    def __init__(self, frame_id: str = "base", namespace: str = "") -> None:
        self._session = RosSession("hexapod_comp_client", namespace)
        self.node, self._spin_once, self.close = self._session.node, self._session.spin_once, self._session.close
        self._frame_id, self._reader = frame_id, StrutReader()
        self.sent: dict[int, Sent] = {}  # by their stamps, ns
        self.track: list[tuple[np.ndarray, int]] = []  # where the tool went, m, and how many commands were sent by then
        self.diagnostics: dict[str, str] = {}  # values of the compensator's newest status
        self.true_count = 0  # true poses that came
        self._streamed: int | None = None
        self._status_name = status_prefix(self.node.get_namespace(), "compensator")
        self._counted_before: tuple[int, int] | None = None
        self._newest: dict[str, PoseStamped] = {}
        node = self.node
        self._publisher = node.create_publisher(PoseStamped, "tool_pose_command", COMMAND_QOS)
        for topic in ("strut_commands", "strut_corrections"):
            node.create_subscription(JointState, topic, partial(self._on_answer, topic), LISTENER_QOS)
        for topic, qos in (("tool_pose_true", TRACK_QOS), ("tool_pose_estimate", NEWEST_QOS)):
            node.create_subscription(PoseStamped, topic, partial(self._on_pose, topic), qos)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        self._enable = node.create_client(SetBool, "compensator/enable_compensation")

    def _on_answer(self, topic: str, message: JointState) -> None:
        if (entry := self.sent.get(nanoseconds_of(message.header.stamp))) is not None:
            self._reader.read(message)
            if topic == "strut_commands":
                entry.answered_at, entry.command = time.monotonic(), self._reader.lengths.copy()
            else:
                entry.correction = self._reader.lengths.copy()

    def _on_pose(self, topic: str, message: PoseStamped) -> None:
        self._newest[topic] = message
        if topic == "tool_pose_true":
            self.true_count += 1
            if self._streamed is not None:
                p = message.pose.position
                self.track.append((np.array([p.x, p.y, p.z]), self._streamed))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self._status_name):
                self.diagnostics = {entry.key: entry.value for entry in status.values}
                if "commands" in self.diagnostics:  # a node that is not configured yet has none
                    self._counted_before = self._counted_before or self._counts()

    @property
    def has_true_pose(self) -> bool:
        """Whether somebody tells where the tool really is."""
        return "tool_pose_true" in self._newest

    @property
    def true_pose(self) -> Pose:
        """The newest true tool pose in ``base``."""
        return self._pose("tool_pose_true")

    @property
    def estimate(self) -> Pose:
        """The newest estimated tool pose in ``base``."""
        return self._pose("tool_pose_estimate")

    def _pose(self, topic: str) -> Pose:
        if topic not in self._newest:
            raise NoAnswerError(f"no {topic} has been received")
        return message_pose(self._newest[topic])

    def spin_until(self, condition: Callable[[], bool], timeout: float, what: str) -> None:
        """Handle messages until a condition holds."""
        end = time.monotonic() + timeout
        while not condition():
            left = end - time.monotonic()
            if left <= 0.0:
                raise NoAnswerError(f"waited {timeout:g} s in vain for {what}")
            self._spin_once(min(left, 0.02))

    def connected(self) -> bool:
        """Return whether commands reach a compensator and its answers and pose estimates come back."""
        return (
            self._publisher.get_subscription_count() > 0
            and self.node.count_publishers("strut_commands") > 0
            and "tool_pose_estimate" in self._newest
            and self._enable.service_is_ready()
            and "commands" in self.diagnostics  # a node that is not configured yet has none
        )

    def _counts(self) -> tuple[int, int]:
        return int(self.diagnostics["commands"]), int(self.diagnostics["refused"])

    def counted(self) -> tuple[int, int]:
        """Return how many of this client's commands the compensator has accepted and refused.

        Commands that it does not count within two diagnostics periods are lost. Other clients' commands
        count as ours: nobody else should be sending any.
        """
        accepted_before, refused_before = self._counted_before or (0, 0)
        end = time.monotonic() + 2.5
        while True:
            accepted, refused = self._counts()
            accepted, refused = accepted - accepted_before, refused - refused_before
            if accepted + refused >= len(self.sent) or time.monotonic() > end:
                return accepted, refused
            self._spin_once(0.05)

    def enable(self, enabled: bool) -> None:
        """Switch compensation on or off."""
        future = self._enable.call_async(SetBool.Request(data=enabled))
        self.spin_until(future.done, 5.0, "the service enable_compensation")

    def send(self, pose: Pose) -> Sent:
        """Send one command and return its record, which the answer will fill."""
        return self._send(pose_message(pose, self._frame_id))

    def _send(self, message: PoseStamped) -> Sent:
        stamp = self.node.get_clock().now()
        message.header.stamp = stamp.to_msg()
        entry = self.sent[stamp.nanoseconds] = Sent(time.monotonic(), *self._refused(), message)
        self._publisher.publish(message)
        return entry

    def _refused(self) -> tuple[int, int]:
        """Return how many commands were refused so far, and how many of them for their age."""
        return int(self.diagnostics.get("refused", "0")), int(self.diagnostics.get("refused.stamp_past", "0"))

    def wait_for_answer(self, entry: Sent, timeout: float = ANSWER_TIMEOUT) -> Sent:
        """Wait until command and correction have come back; return the record that was answered.

        A pose that a busy computer handed over too late is sent again, with a new stamp: the machine waits where it is,
        and the next pose on a path would be too far from there.
        """
        end = entry.sent_at + timeout
        while not (np.isfinite(entry.command[0]) and np.isfinite(entry.correction[0])):
            refused, too_old = self._refused()
            if refused != entry.refused:
                if time.monotonic() < end and refused - entry.refused == too_old - entry.too_old:
                    entry = self._send(entry.message)
                    continue
                why, advice = self.diagnostics["last_refusal"], self.diagnostics.get("what_to_do", "")
                raise NoAnswerError(f"a command was refused: {why}" + (f"; {advice}" if advice else ""))
            if time.monotonic() > end:
                raise NoAnswerError(f"no answer to a command within {timeout:g} s")
            self._spin_once(0.01)
        return entry

    def stream(self, path: Path, each: Callable[[int], None] | None = None) -> list[Sent]:
        """Send a path at its rate and return the records; :attr:`track` then holds where the tool went.

        A command waits for the answer to the one before, so that a stall of any process delays the path
        instead of making it jump.
        """
        entries: list[Sent] = []
        self.track = []
        messages = [pose_message(path.pose(n), self._frame_id) for n in range(len(path))]
        due = time.monotonic()
        for index, message in enumerate(messages):
            while (left := due - time.monotonic()) > 0.0:
                self._spin_once(left)
            if entries:
                entries[-1] = self.wait_for_answer(entries[-1])
            entries.append(self._send(message))
            self._streamed = len(entries)
            if each is not None:
                each(index)
            due = max(due + 1.0 / path.rate, time.monotonic() - 1.0 / path.rate)
        entries[-1] = self.wait_for_answer(entries[-1])
        self._streamed = None
        return entries

    def hold(self, pose: Pose, rate: float, until: Callable[[], bool], timeout: float, what: str) -> Sent:
        """Send one pose again and again, as a controller at standstill does, until a condition holds."""
        end = time.monotonic() + timeout
        while True:
            entry = self.wait_for_answer(self.send(pose))
            next_due = entry.sent_at + 1.0 / rate
            while (left := next_due - time.monotonic()) > 0.0:
                self._spin_once(left)
            if until():
                return entry
            if time.monotonic() > end:
                raise NoAnswerError(f"waited {timeout:g} s in vain for {what}")

    def settled(self) -> Callable[[], bool]:
        """Return a condition: the true tool has not moved by more than 20 nm over the last 25 readings."""
        history: deque[np.ndarray] = deque(maxlen=25)
        seen = self.true_count

        def quiet() -> bool:
            nonlocal seen
            if self.true_count == seen:
                return False
            seen = self.true_count
            history.append(self.true_pose.position)
            return len(history) == 25 and float(np.ptp(np.array(history), axis=0).max()) < 20e-9

        return quiet
