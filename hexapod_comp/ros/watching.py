"""Watching a machine: hears what its nodes publish, publishes nothing itself, and says what is known at present."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from ..errors import HexapodError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import solve_pose
from ..pose import Pose, rotation_angle
from .health import status_prefix
from .messages import StrutReader, message_pose, read_message
from .ros_session import QUIET, RosSession
from .running import SPIN_PERIOD, keep_discovery_local
from .runtime import EVENT_QOS, NEWEST_QOS
from .stamps import nanoseconds_of

STREAM_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort, so that nobody waits for a slow witness; deep enough that the latencies are those of all commands."""

SILENT_AFTER = 2.0
"""What nobody has said for this long is not known any more, s: diagnostics come once a second."""

WINDOW = 5.0
"""Latencies are those of the last so many seconds."""

UPDATE_PERIOD = 0.1
"""How often what is seen is shown anew, s."""

NODES = ("compensator", "strut_drive")


@dataclass(frozen=True)
class WatchedError:
    """An error of the tool along and about the axes of ``work``, actual − commanded.

    Attributes
    ----------
    displacement : ndarray, shape (3,)
        In m.
    turn : float
        Angle, rad.
    deviation : float
        Standard deviation of the displacement, m, all axes together; NaN where not known.
    """

    displacement: np.ndarray
    turn: float
    deviation: float = float("nan")


@dataclass(frozen=True)
class Latency:
    """How long commands took from their stamp to the struts' command as heard here, s; `count` of them."""

    median: float
    largest: float
    count: int


@dataclass(frozen=True)
class View:
    """What is known of a machine at one moment; None and empty where nothing was heard of late.

    Attributes
    ----------
    platform : Pose
        ``pose_platform_in_base`` by ``tool_pose_estimate``.
    commanded : Pose
        The same by ``strut_commands`` less ``strut_corrections``: where a machine without errors would be.
    corrections, measured : ndarray, shape (6,)
        Strut corrections and measured struts, m.
    predicted, left, seen : WatchedError
        Without compensation, at the last command; by the estimate; by ``tool_pose_true``.
    latency : Latency
        Of the last seconds' commands.
    states : dict of str to DiagnosticStatus
        What each node says of itself.
    """

    platform: Pose | None = None
    commanded: Pose | None = None
    corrections: np.ndarray | None = None
    measured: np.ndarray | None = None
    predicted: WatchedError | None = None
    left: WatchedError | None = None
    seen: WatchedError | None = None
    latency: Latency | None = None
    states: dict[str, DiagnosticStatus] = field(default_factory=dict)


T = TypeVar("T")


class Watcher:
    """Hears a machine's topics.

    Parameters
    ----------
    geometry : HexapodGeometry
        The machine that is watched.
    node : Node
        That listens, in the namespace where the machine's nodes are; made with the options :data:`.ros_session.QUIET`.
    """

    def __init__(self, geometry: HexapodGeometry, node: Node) -> None:
        self._geometry, self._reader = geometry, StrutReader()
        self._guess = geometry.home
        self._newest: dict[str, tuple[bytes, float]] = {}
        self._states: dict[str, tuple[DiagnosticStatus, float]] = {}
        self._delays: deque[tuple[float, float]] = deque()
        self.node = node
        self._prefixes = {name: status_prefix(node.get_namespace(), name) for name in NODES}
        node.create_subscription(JointState, "strut_commands", self._on_command, STREAM_QOS, raw=True)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        for topic, kind in (
            ("strut_corrections", JointState),
            ("strut_states", JointState),
            ("tool_pose_estimate", PoseStamped),
            ("tool_pose_true", PoseStamped),
            ("compensator/predicted_error", PoseWithCovarianceStamped),
        ):
            node.create_subscription(kind, topic, self._keeper(topic), NEWEST_QOS, raw=True)

    def view(self) -> View:
        """Return what is known now."""
        now = time.monotonic()
        corrections = self._read("strut_corrections", self._lengths, now)
        commands = self._read("strut_commands", self._lengths, now)
        commanded = None if commands is None or corrections is None else self._pose_of(commands - corrections)
        tool, true = (self._read(topic, _tool, now) for topic in ("tool_pose_estimate", "tool_pose_true"))
        in_use = self._tool_in_use()
        return View(
            platform=None if tool is None else tool @ in_use.inverse(),
            commanded=commanded,
            corrections=corrections,
            measured=self._read("strut_states", self._lengths, now),
            predicted=self._read("compensator/predicted_error", _predicted, now),
            left=self._error(tool, commanded, in_use),
            seen=self._error(true, commanded, self._geometry.tool),
            latency=self._latency(now),
            states={name: status for name, (status, at) in self._states.items() if now - at < SILENT_AFTER},
        )

    def _keeper(self, topic: str) -> Callable[[bytes], None]:
        """Return what keeps a topic's newest message; it is read when it is wanted, ten times a second."""

        def keep(data: bytes) -> None:
            self._newest[topic] = (data, time.monotonic())

        return keep

    def _on_command(self, data: bytes) -> None:
        now = time.monotonic()
        self._newest["strut_commands"] = (data, now)
        try:
            stamp = nanoseconds_of(read_message(data, JointState).header.stamp)
        except HexapodError:
            return
        self._delays.append((now, (self.node.get_clock().now().nanoseconds - stamp) * 1e-9))
        self._forget(now)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for name, prefix in self._prefixes.items():
                if status.name.startswith(prefix):
                    self._states[name] = (status, time.monotonic())

    def _forget(self, now: float) -> None:
        while self._delays and now - self._delays[0][0] > WINDOW:
            self._delays.popleft()

    def _latency(self, now: float) -> Latency | None:
        self._forget(now)
        delays = [delay for _, delay in self._delays]
        return Latency(float(np.median(delays)), max(delays), len(delays)) if delays else None

    def _read(self, topic: str, read: Callable[[bytes], T], now: float) -> T | None:
        """Return what a topic's newest message holds, None where it is old or cannot be used."""
        data, at = self._newest.get(topic, (b"", -np.inf))
        if now - at > SILENT_AFTER:
            return None
        try:
            return read(data)
        except HexapodError:
            return None

    def _lengths(self, data: bytes) -> np.ndarray:
        self._reader.take(data)
        return self._reader.lengths.copy()

    def _pose_of(self, lengths: np.ndarray) -> Pose | None:
        """Return the platform's pose in ``base`` with nominal lengths, if there is one."""
        try:
            self._guess = solve_pose(self._geometry, lengths, self._guess)
        except HexapodError:
            self._guess = self._geometry.home
            return None
        return self._guess

    def _tool_in_use(self) -> Pose:
        """Return ``pose_tool_in_platform`` of the tool that the compensator names; of the geometry's before it does."""
        status, _ = self._states.get("compensator", (DiagnosticStatus(), 0.0))
        names = [entry.value for entry in status.values if entry.key == "tool"]
        return self._geometry.tools.get(names[0], self._geometry.tool) if names else self._geometry.tool

    def _error(self, tool: Pose | None, commanded: Pose | None, in_platform: Pose) -> WatchedError | None:
        """Return how far a tool, in ``base``, is from where a platform pose would have it."""
        if tool is None or commanded is None:
            return None
        target = commanded @ in_platform
        displacement = self._geometry.work.rotation.T @ (tool.position - target.position)
        return WatchedError(displacement, rotation_angle(tool.rotation @ target.rotation.T))


def watch(
    geometry: HexapodGeometry, show: Callable[[View], object], going_on: Callable[[], bool], namespace: str = ""
) -> None:
    """Show a machine's present state ten times a second while something holds.

    Parameters
    ----------
    geometry, namespace
        As for :class:`Watcher`.
    show : callable
        Is given each view.
    going_on : callable
        Looked at every 0.1 s at least.
    """
    keep_discovery_local()
    with RosSession("hexapod_comp_watch", namespace, **QUIET) as session:
        watcher, due = Watcher(geometry, session.node), time.monotonic()
        while going_on():
            session.spin_once(min(SPIN_PERIOD, max(0.0, due - time.monotonic())))
            if time.monotonic() >= due:
                show(watcher.view())
                due = time.monotonic() + UPDATE_PERIOD


def _tool(data: bytes) -> Pose:
    return message_pose(read_message(data, PoseStamped))


def _predicted(data: bytes) -> WatchedError:
    message: Any = read_message(data, PoseWithCovarianceStamped)
    error = message_pose(message.pose)
    variance = sum(message.pose.covariance[index] for index in (0, 7, 14))
    deviation = float(np.sqrt(variance)) if variance >= 0.0 else float("nan")
    return WatchedError(error.position, rotation_angle(error.rotation), deviation)
