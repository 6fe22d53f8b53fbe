"""Two controllers: one streams poses, with a feed hold that a fault may disable; one requests moves of the mover."""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Transform, Vector3
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.trajectory import Path, commanded_in_base, join, move, quintic
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import EVENT_QOS, LATCHED_QOS
from hexapod_comp.ros.messages import nanoseconds_of, pose_message

RATE = 250.0  # commands per second
FEED = 0.08  # largest tool speed, m/s
REPEAT_AFTER = 0.1  # a command that has not been answered for this time, s, is sent again
STUCK_AFTER = 0.25  # if no command has been answered for this time, s, the controller resets the compensator
REPEAT_MOVE_AFTER = 0.5  # if the mover has published no state for this time, s, the move is requested again


class Mode(Enum):
    MILL = "follow the path"
    ASK = "wait until the compensator has been reset"
    RETURN = "move from the measured pose to the point at which the path was left"


class Controller:
    """A controller that sends the poses of a path, each after the last one's answer; it repeats unanswered poses.

    A `heedless` controller has no feed hold: it sends every `stride`-th pose without waiting for answers. After the
    drive was restarted, or if commands are refused because the machine is not at its commanded position, it resets the
    compensator, if it `may_reset`, and moves from the measured pose back to its path.
    """

    def __init__(
        self,
        geometry: HexapodGeometry,
        send: Callable[[Pose], int],
        reset: Callable[[Callable[[Pose | None], None]], None],
    ) -> None:
        self._geometry, self._send, self._reset = commanded_in_base(geometry), send, reset
        self._path = endless_path(geometry)
        self._index = 0
        self._way: Path | None = None
        self._way_index = 0
        self.mode, self.heedless, self.may_reset = Mode.MILL, False, True
        self.stride = 1
        self._awaited = self._sent_at = self._answered_at = 0.0
        self._must_return = False

    @property
    def target(self) -> Pose:
        return self._path.pose(self._index % len(self._path))

    def answered(self, stamp: int, now: float) -> None:
        if stamp == self._awaited:
            self._awaited, self._answered_at = 0, now
            self._advance()

    def start_over(self) -> None:
        """The drive was restarted: as soon as possible, reset and return to the path from the measured pose."""
        self._must_return = True

    def tick(self, now: float, stuck: bool) -> None:
        """Send what is due at the monotonic time `now`, s; `stuck`: the machine is not at its commanded position."""
        if self.mode is Mode.ASK:
            return
        if self.heedless:
            self._go_on(now)
        elif self.may_reset and (self._must_return or (stuck and now - self._answered_at > STUCK_AFTER)):
            self._ask()
        elif now >= self.due():
            self._awaited, self._sent_at = self._send(self._next_pose()), now

    def due(self) -> float:
        if self.mode is Mode.ASK:
            return float("inf")
        return self._sent_at + (REPEAT_AFTER if self._awaited else 1.0 / RATE)

    def _go_on(self, now: float) -> None:
        if now >= self.due():
            self.mode, self._way, self._index = Mode.MILL, None, self._index + self.stride
            self._awaited, self._sent_at = 0, now
            self._send(self.target)

    def _next_pose(self) -> Pose:
        return self.target if self._way is None else self._way.pose(self._way_index)

    def _advance(self) -> None:
        if self._way is None:
            self._index += 1
            return
        self._way_index += 1
        if self._way_index == len(self._way):
            self._way, self.mode = None, Mode.MILL

    def _ask(self) -> None:
        self.mode, self._must_return, self._awaited = Mode.ASK, False, 0
        self._reset(self._return_from)

    def _return_from(self, pose: Pose | None) -> None:
        self._answered_at, self._sent_at = time.monotonic(), 0.0
        if pose is None:
            self.mode, self._must_return = Mode.MILL, True
            return
        self.mode, self._way_index = Mode.RETURN, 0
        self._way = join([Path(pose.position[None], pose.rotation[None], RATE), self._way_back(pose)])

    def _way_back(self, pose: Pose) -> Path:
        return move(self._geometry, pose, self.target, RATE, FEED)


class MoverController:
    """A controller that alternately requests of the mover a program along the path and a move to a point of the path.

    If the compensator refuses commands because the machine is not at its commanded position, it is reset first, if it
    `may_reset`. `heedless` has no effect, because the mover handles missing answers.
    """

    def __init__(
        self, geometry: HexapodGeometry, node: Any, reset: Callable[[Callable[[Pose | None], None]], None]
    ) -> None:
        self._node, self._reset, self._path = node, reset, endless_path(geometry)
        self.mode, self.heedless, self.may_reset = Mode.MILL, False, True
        self._publishers = {
            kind: node.create_publisher(kind, topic, EVENT_QOS)
            for kind, topic in ((MultiDOFJointTrajectory, "program"), (PoseStamped, "move_to"))
        }
        self._state: dict[str, str] = {}
        self._asked = self._moves = 0
        self._asked_at = 0.0
        node.create_subscription(DiagnosticStatus, "mover/state", self._on_state, LATCHED_QOS)

    def _on_state(self, message: DiagnosticStatus) -> None:
        self._state = {entry.key: entry.value for entry in message.values}

    def answered(self, stamp: int, now: float) -> None:
        """The mover counts the answers."""

    def start_over(self) -> None:
        """The mover plans from the measured pose."""

    def due(self) -> float:
        return float("inf")

    def tick(self, now: float, stuck: bool) -> None:
        """Request the next move after the last one has ended or was not received."""
        unseen = self._state.get("request") != str(self._asked) and now < self._asked_at + REPEAT_MOVE_AFTER
        if self.mode is Mode.ASK or unseen or self._state.get("state") not in ("idle", "arrived", "stopped"):
            return
        if stuck:
            if self.may_reset:
                self.mode = Mode.ASK
                self._reset(self._has_reset)
        elif self._state["ready"] == "true":
            self._ask(now)

    def _has_reset(self, pose: Pose | None) -> None:
        self.mode = Mode.MILL
        if pose is not None:  # the compensator's status shows the old refusals for up to another second
            self._ask(time.monotonic())

    def _ask(self, now: float) -> None:
        """Request the next move: alternately a move to a point and a program along the path."""
        self._moves += 1
        if self._moves % 2 == 0:
            message = program(self._path, every=5)
        else:
            message = pose_message(self._path.pose(self._moves * len(self._path) * 3 // 10 % len(self._path)), "base")
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._asked, self._asked_at = nanoseconds_of(message.header.stamp), now
        self._publishers[type(message)].publish(message)


def program(path: Path, every: int) -> MultiDOFJointTrajectory:
    """Return a message with every `every`-th pose of a path and its time."""
    message = MultiDOFJointTrajectory(joint_names=["tool"])
    message.header.frame_id = "base"
    for n in range(0, len(path), every):
        pose, seconds = pose_message(path.pose(n), "base").pose, n / path.rate
        at = Vector3(x=pose.position.x, y=pose.position.y, z=pose.position.z)
        point = MultiDOFJointTrajectoryPoint(transforms=[Transform(translation=at, rotation=pose.orientation)])
        point.time_from_start = Duration(sec=int(seconds), nanosec=round(seconds % 1.0 * 1e9))
        message.points.append(point)
    return message


def endless_path(geometry: HexapodGeometry) -> Path:
    """Return a closed path about home, in ``base``: a circle of 16 mm, then straight strokes that reverse."""
    machine = commanded_in_base(geometry)
    home = geometry.home @ geometry.tool
    angle = 2.0 * np.pi * quintic(np.linspace(0.0, 1.0, 297))  # 1.2 s from rest to rest, at most FEED
    offsets = 8e-3 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    ring = Path(home.transform(offsets), np.tile(home.rotation, (len(angle), 1, 1)), RATE)
    ends = [Pose(home.position + 1e-3 * np.array(to), home.rotation) for to in ([-8, 0, 0], [8, 0, 2], [-8, 0, 4])]
    corner = ring.pose(-1)
    legs = [move(machine, a, b, RATE, FEED) for a, b in zip([corner, *ends], [*ends, corner], strict=True)]
    return join([ring, *legs])
