"""The mover node: receives target poses and programs, and sends a stream of tool poses to the compensator.

At standstill the node repeats the last pose, so that the struts follow the machine's temperatures. Run the node with
``ros2 run hexapod_comp mover`` or ``python -m hexapod_comp.ros.mover``.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from ..compensation.journal import Source, read_sources
from ..errors import CommandError, HexapodError, shorten
from ..machine.geometry import BASE, TOOL, HexapodGeometry
from ..machine.path import Motion
from ..machine.trajectory import Path
from ..pose import Pose, rotation_angle
from .base import (
    ACKNOWLEDGED_WITHIN,
    COMMAND_QOS,
    ERROR,
    EVENT_QOS,
    LATCHED_QOS,
    NEWEST_QOS,
    OK,
    WARN,
    MachineNode,
    status_prefix,
)
from .compensator_state import frame_ids
from .messages import check_frame, message_pose, nanoseconds_of, pose_message, stamp_of
from .parameters import Program, read_table
from .process import run
from .worker import Worker

# A command that the compensator has not answered within this time, s, counts as refused. The time exceeds the default
# max_command_age: a younger command may still be accepted, and then the machine leaves the last answered pose.
ANSWERED_WITHIN = 0.6
IN_FLIGHT = 0.15  # The node sends no further pose while a command has waited longer than this, s, for its answer
# The node also waits while the tool lags: while its distance from the command exceeds the way of the commands in the
# last LAG seconds by more than BEHIND, m (half of following_error_limit). A drive may be too slow to catch up, so the
# node waits at most CAUGHT_UP_WITHIN seconds.
LAG, BEHIND, CAUGHT_UP_WITHIN = 0.1, 1e-3, 2.0
MADE_UP = 0.08  # Longest delay, s, after which all due poses are sent; catch_up_within lets commands wait for 0.1 s
RESUMED = 5  # Largest number of new plans for a delayed move, each from the last answered pose
# Reasons of refusals that last until a person acts
LASTING = ("following_error", "several_publishers", "unknown_publisher", "no_feedback", "tool_changed")
PLANNER_KEPT = 600.0  # Time for which an idle worker process is kept, s; a start takes 1 s, or 30 s on a busy computer
ESTIMATE_WITHIN = 1.0  # Largest age of an estimate that is used as the machine's pose, s
STATE_PERIOD, STANDING_PERIOD = 0.1, 1.0  # Periods of ~/state, s: while the machine moves, and at standstill

IDLE, PLANNING, MOVING, SETTLING, ARRIVED, STOPPED = "idle", "planning", "moving", "settling", "arrived", "stopped"
UNDER_WAY = (PLANNING, MOVING, SETTLING)

PARAMETERS = read_table(f"""
compensator | compensator |  | configure | name of the compensator's node, in this node's namespace
base_frame | base |  | configure | frame_id of poses in the machine base
work_frame | work | not base_frame | configure | frame_id of poses in the geometry file's work frame
frame_prefix | '' |  | configure | prefix of the frame_ids of the geometry file's named work frames
tool_frame | {TOOL} |  | configure | frame_id of relative moves in the tool's own frame
rate | 250.0 | 10 to 1000 Hz | configure | tool poses sent per second
limit_share | 0.9 | 0.01 to 1 | always | share of the struts' speed, acceleration and jerk limits that a move may use;
    the remainder is for the corrections
position_tolerance | 5.0e-6 | 1e-9 to 0.01 m | always | largest distance from the estimated tool to the target at
    arrival
rotation_tolerance | 2.0e-5 | 1e-9 to 0.1 rad | always | largest rotation between the estimated tool and the target at
    arrival
settling_time | 0.1 | 0 to 60 s | always | the tool has arrived when it stays within both tolerances for this time
settling_timeout | 5.0 | 0.1 to 3600 s | always | report the move as stopped if the tool has not arrived this long after
    the last pose was sent
""")

TOPICS = """
in   move_to                 PoseStamped: target of the tool, in `base` or a work frame; a new target replaces it
     move_by                 PoseStamped: relative move; frame_id `tool`: in the tool's frame; a work frame: along and
                             about its axes
     pivot                   PointStamped: point of the tool, in its frame, that moves in a straight line; first the tip
     program                 MultiDOFJointTrajectory: tool poses, each with the earliest time at which it is reached
     tool_pose_estimate      PoseStamped: from the compensator, as are its ~/files, ~/tool and strut_commands
out  tool_pose_command       PoseStamped: to the compensator, in base
     ~/state                 DiagnosticStatus, latched: idle, planning, moving, settling, arrived, stopped
     /diagnostics
ask  ~/stop                  Trigger: brake on the path, within the struts' limits, and stay there
"""

PROGRAM = Program(
    "mover", "Moves a hexapod's tool to target poses, within the struts' limits.", PARAMETERS, TOPICS, "-p rate:=500.0"
)


@dataclass
class Request:
    """A requested move: tool poses in ``base``, for a program with times, or a displacement from the present pose."""

    poses: list[Pose]
    times: list[float] = field(default_factory=list)  # earliest times of a program's poses, s
    relative: Pose | None = None  # displacement and rotation of a relative move, in the frame of `axes`
    axes: np.ndarray | None = None  # shape (3, 3), axes of a relative move in ``base``; None: the tool's own axes
    stamp: int = 0  # stamp of the requesting message, ns

    def from_pose(self, start: Pose) -> list[Pose]:
        """Return the target poses in ``base`` for a move that begins at the tool pose `start`."""
        if self.relative is None:
            return self.poses
        if self.axes is None:
            return [start @ self.relative]
        turn = self.axes @ self.relative.rotation @ self.axes.T
        return [Pose(start.position + self.axes @ self.relative.position, turn @ start.rotation)]


class MoverNode(MachineNode):
    def __init__(self, **options: Any) -> None:
        super().__init__("mover", PARAMETERS, **options)
        self._state, self._text, self._by = IDLE, "no move yet", ""
        self._request = self._refused_request = 0  # stamps of the newest planned and of the newest refused request, ns
        self._refusal, self._ready_shown = "", False
        self._resumed = 0  # number of new plans for the present move after delays
        self._target: Request | None = None  # request of the present move, for a new plan; None for a program
        self._moves = 0  # number of moves whose planning has begun
        self._clear()

    def _clear(self) -> None:
        self._sources: dict[str, Source] = {}
        self._geometry: HexapodGeometry | None = None
        self._frame_ids: dict[str, str] = {}  # frame_id of each frame that a move can be in, by the frame's name
        self._tool = TOOL
        self._pivot: np.ndarray = np.zeros(3)
        self._pivot_refusal = ""
        self._estimate: tuple[Pose, float] | None = None  # estimated tool pose and its monotonic time of receipt, s
        self._compensator_status: dict[str, str] = {}  # values and message of the compensator's newest status
        self._halt()

    def _halt(self) -> None:
        """Stop sending poses, and forget the sent commands."""
        self._held: Pose | None = None  # last commanded tool pose, which is repeated at standstill
        self._queue: deque[Motion] = deque()
        self._motion: Motion | None = None
        self._path_is_motion = False  # True: `_path` follows `_motion`; False: `_path` brakes the tool during `_motion`
        self._path: Path | None = None
        self._index = 0
        self._pending: Request | None = None  # request that is planned as soon as the machine stands
        self._stamp = 0  # stamp of the last command, ns
        self._sent: deque[np.ndarray] = deque()  # tool positions, m, commanded in the last LAG seconds
        self._near_at = 0.0  # monotonic time, s, at which _is_behind() last found the tool close to the command
        self._unanswered: deque[tuple[int, float, Pose]] = deque()  # stamp, ns, monotonic time of sending, s, and pose
        self._answered: Pose | None = None  # pose of the last command that the compensator has answered
        self._ended = self._near_since = 0.0  # monotonic times, s: end of the path; arrival within the tolerances
        self._braking = ""  # cause of braking, for `stopped_by`; empty if a new request is the cause

    # ---- lifecycle ----

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._halt()
        self._commands = self.publish_on(PoseStamped, "tool_pose_command", COMMAND_QOS)
        done = super().on_activate(state)
        self._change(IDLE, "no move yet")
        return done

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop sending poses and close the publisher, so that another node may command."""
        if self._state in UNDER_WAY:
            self._stopped("deactivated", "the node was deactivated during the move")
        self._halt()
        self.close_entities(self._commands)
        return super().on_deactivate(state)

    def unconfigure(self) -> None:
        self._worker.close()
        self._clear()

    def publish_last_status(self) -> None:
        if self._active and self._state in UNDER_WAY:
            self._stopped("shut down", "the node ended during the move")
            self._states.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
        super().publish_last_status()

    def configure(self) -> None:
        name = self.options["compensator"]
        self._worker = Worker(PLANNER_KEPT)
        self._states = self.create_publisher(DiagnosticStatus, "~/state", LATCHED_QOS)
        self._diagnosed = status_prefix(self.get_namespace(), name)
        self.subscribe(PoseStamped, "move_to", partial(self._on_request, self._read_target), EVENT_QOS)
        self.subscribe(PoseStamped, "move_by", partial(self._on_request, self._read_displacement), EVENT_QOS)
        self.subscribe(MultiDOFJointTrajectory, "program", partial(self._on_request, self._read_program), EVENT_QOS)
        self.subscribe(PointStamped, "pivot", self._on_pivot, EVENT_QOS)
        self.subscribe(PoseStamped, "tool_pose_estimate", self._on_estimate, NEWEST_QOS)
        self.subscribe(JointState, "strut_commands", self._on_answer, COMMAND_QOS)
        self.subscribe(String, f"{name}/files", self._on_files, LATCHED_QOS)
        self.subscribe(String, f"{name}/tool", self._on_tool, LATCHED_QOS)
        self.subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        self.create_logged_service(Trigger, "~/stop", self._on_stop)
        self.at_rate("rate", self._tick)
        self._state_due = 0.0
        self._change(IDLE, "no move yet")

    # ---- topics of the compensator ----

    def _on_files(self, message: String) -> None:
        self._sources = read_sources(message.data)
        self._use_machine()

    def _on_tool(self, message: String) -> None:
        self._tool = message.data
        self._use_machine()

    def _use_machine(self) -> None:
        """Use the compensator's geometry and tool; a change of tool stops a move, but moves no strut."""
        if not {"geometry", "model"} <= self._sources.keys():
            return
        geometry = self._sources["geometry"].geometry()
        if self._tool not in geometry.tools:
            return  # a new geometry file with this tool arrives next
        before, self._geometry = self._geometry, geometry.using(tool=self._tool, work=BASE)
        own = frame_ids(geometry, self.options)
        self._frames = {frame_id: geometry.work_frames[name] for name, frame_id in own.items()}
        self._frame_ids = {**own, TOOL: self.options["tool_frame"]}
        self.set_hardware_id(geometry.name)
        if before is not None and self._active and before.tool_name != self._tool:
            answered = self._answered
            if self._state in UNDER_WAY:
                self._stopped("refusal", f"the tool was changed to {self._tool!r} during the move")
            self._halt()
            if answered is not None:  # not the estimate, which has the corrections that have not yet ramped in
                self._held = self._answered = answered @ before.tool.inverse() @ self._geometry.tool
            self._publish_state()  # the tool's name

    def _on_estimate(self, message: PoseStamped) -> None:
        if message.header.frame_id == self.options["base_frame"]:
            self._estimate = message_pose(message), time.monotonic()

    def _on_answer(self, message: JointState) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        while self._unanswered and self._unanswered[0][0] <= stamp:
            self._answered = self._unanswered.popleft()[2]

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self._diagnosed):
                self._compensator_status = {entry.key: entry.value for entry in status.values}
                self._compensator_status["message"] = status.message

    # ---- requests ----

    def _read_target(self, message: PoseStamped) -> Request:
        return Request([self._frame_pose(message.header.frame_id) @ message_pose(message)])

    def _read_displacement(self, message: PoseStamped) -> Request:
        frame_id, pose, tool = message.header.frame_id, message_pose(message), self.options["tool_frame"]
        check_frame(frame_id, [*self._frames, tool])
        return Request([], relative=pose, axes=None if frame_id == tool else self._frames[frame_id].rotation)

    def _read_program(self, message: MultiDOFJointTrajectory) -> Request:
        frame = self._frame_pose(message.header.frame_id)
        if len(message.joint_names) != 1 or len(message.points) < 2:
            found = f"{len(message.joint_names)} and {len(message.points)}"
            raise CommandError("program", f"a program must have one joint name and at least 2 points, not {found}")
        poses, times = [], []
        for n, point in enumerate(message.points):
            if len(point.transforms) != 1:
                raise CommandError("program", f"points[{n}] must have 1 transform, not {len(point.transforms)}")
            t, q = point.transforms[0].translation, point.transforms[0].rotation
            pose = Pose.from_quaternion(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))
            poses.append(frame @ pose)
            times.append(point.time_from_start.sec + point.time_from_start.nanosec * 1e-9)
        for n in range(1, len(times)):
            if not times[n] > times[n - 1]:
                problem = f"must be above {times[n - 1]:.9g} s, the time of points[{n - 1}], not {times[n]:.9g} s"
                raise CommandError("program", f"points[{n}].time_from_start {problem}")
        return Request(poses, times)

    def _on_pivot(self, message: PointStamped) -> None:
        point = np.array([message.point.x, message.point.y, message.point.z])
        self._pivot_refusal = ""
        if message.header.frame_id not in ("", self.options["tool_frame"]) or not np.isfinite(point).all():
            where = f"finite and in {self.options['tool_frame']}"
            self._pivot_refusal = f"must be {where}, not {point} in {shorten(message.header.frame_id)}"
            self.log_warning("pivot", f"pivot refused, and with it all moves: {self._pivot_refusal}")
        else:
            self._pivot = point

    def _frame_pose(self, frame_id: str) -> Pose:
        check_frame(frame_id, self._frames)
        return self._frames[frame_id]

    def _on_request(self, read: Callable[[Any], Request], message: Any) -> None:
        """Plan the requested move, now or after braking the present move; publish why a request is refused."""
        stamp = nanoseconds_of(message.header.stamp)
        try:
            if not self._active:
                raise CommandError("not_active", "the mover is not active: ros2 lifecycle set /mover activate")
            if self._geometry is None:
                raise CommandError("not_ready", "the compensator has not yet published its machine on ~/files")
            if self._pivot_refusal:
                raise CommandError("pivot", f"the newest pivot point was refused: {self._pivot_refusal}; send another")
            self._pending = replace(read(message), stamp=stamp)
        except HexapodError as error:
            self._refuse(stamp, error)
            return
        if self._motion is not None:
            self._brake("")
        elif self._state != PLANNING:
            self._plan()

    def _refuse(self, stamp: int, error: HexapodError) -> None:
        self._refused_request, self._refusal = stamp, str(error)
        self.log_warning("request", f"move refused ({error.reason}): {error}")
        self._publish_state()

    def _ready(self) -> bool:
        """Return whether the node is active and knows the machine and the present pose of its tool."""
        fresh = self._estimate is not None and time.monotonic() - self._estimate[1] <= ESTIMATE_WITHIN
        return self._active and self._geometry is not None and (fresh or self._held is not None)

    def _present_pose(self) -> Pose:
        """Return the last commanded tool pose in ``base``, or before the first command the estimated pose."""
        if self._held is not None:
            return self._held
        if self._estimate is None or time.monotonic() - self._estimate[1] > ESTIMATE_WITHIN:
            problem = f"no tool_pose_estimate for {ESTIMATE_WITHIN:g} s"
            raise CommandError("no_estimate", f"the tool's pose is not known: {problem}")
        return self._estimate[0]

    # ---- planning ----

    def _plan(self, anew: bool = False) -> None:
        """Have the worker plan the pending request from the present pose; `anew`: again, after a delay."""
        request, self._pending = self._pending, None
        if request is None or self._geometry is None:
            return
        try:
            start = self._present_pose()
        except CommandError as error:
            self._refuse(request.stamp, error)
            if self._state in UNDER_WAY:  # planning for an earlier request that this one has replaced
                self._stopped("planning", str(error))
            return
        self._resumed = self._resumed if anew else 0
        self._target = None if request.times else Request(request.from_pose(start), stamp=request.stamp)
        self._request, self._refused_request, self._refusal = request.stamp, 0, ""
        self._moves += 1
        arguments = {
            "poses": [start, *request.from_pose(start)],
            "times": request.times,
            "pivot": self._pivot,
            "tool": self._tool,
            "rate": self.options["rate"],
            "share": self.options["limit_share"],
        }
        number = self._moves
        self._change(PLANNING, "planning")
        self._worker.ask(
            "plan_move",
            arguments,
            lambda motions: self._begin(number, start, motions),
            lambda error: self._planning_failed(number, error),
            # from this folder the worker reads a model that is too long for ~/files, and checks its hash
            {**self._sources, "folder": os.path.dirname(self._sources["model"].name) or None},
        )

    def _planning_failed(self, number: int, error: HexapodError) -> None:
        if number == self._moves and self._state == PLANNING:
            self._stopped("limit" if error.reason == "limit" else "planning", str(error))
            self._plan()  # a newer request, if there is one

    def _begin(self, number: int, start: Pose, motions: list[Motion]) -> None:
        """Begin a planned move, unless the move was stopped or replaced during planning."""
        if number != self._moves or self._state != PLANNING:
            return
        if self._pending is not None:
            self._plan()
            return
        self._held = self._held or start
        self._queue = deque(motions)
        self._whole = sum(motion.duration for motion in motions)
        self._begin_next_motion()
        if self._motion is not None:
            self._change(MOVING, "moving")

    def _begin_next_motion(self) -> None:
        """Begin the next motion of the move; after the last motion plan a newer request, or wait for settling."""
        if self._queue:
            self._motion, self._path_is_motion = self._queue.popleft(), True
            self._start_path(self._motion.sample(self.options["rate"]))
            return
        self._motion = self._path = None
        self._ended = time.monotonic()
        self._near_since = np.inf
        if self._pending is not None:
            self._plan()
        elif self._braking:
            self._stopped(self._braking, "stopped during the move")
        else:
            self._change(SETTLING, "settling")
        self._braking = ""

    def _start_path(self, path: Path) -> None:
        self._path, self._index = path, 1  # index 0 is the present pose, which has been sent

    def _brake(self, why: str) -> None:
        """Brake the present motion within the struts' limits; ~/state names the cause `why`, "" for a new request."""
        self._braking = self._braking or why
        if self._motion is None or self._path is None or not self._path_is_motion:
            return
        rate = self.options["rate"]
        now = min((self._index - 1) / rate, self._motion.duration)
        self._queue.clear()
        self._start_path(self._motion.stop(now, rate))
        self._path_is_motion = False

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._pending = None
        response.success, response.message = True, "the tool was not moving"
        if self._motion is not None:
            self._brake("person")
            response.message = "braking"
        elif self._state in UNDER_WAY:
            text = "stopped before the tool moved" if self._state == PLANNING else "stopped while the tool was settling"
            self._stopped("person", text)
        return response

    # ---- moving ----

    def _tick(self) -> None:
        """Send the poses of the path that are due; at standstill send the last pose again.

        A command's stamp is the time for which its pose was computed: one period after the previous stamp, even if this
        process is late.
        """
        if not self._active:
            return
        period = round(1e9 / self.options["rate"])
        now = int(self.get_clock().now().nanoseconds)
        if abs(now - period - self._stamp) > MADE_UP * 1e9:  # first command, a longer delay, or a step of the clock
            self._stamp = now - period
        while self._held is not None and self._stamp + period <= now + period // 2:
            held_up = self._unanswered and time.monotonic() - self._unanswered[0][1] > IN_FLIGHT
            if held_up or self._is_behind():
                self._stamp = now - period  # the path waits
                return
            if self._path is not None:
                self._held = self._path.pose(min(self._index, len(self._path) - 1))
                self._index += 1
            self._stamp += period
            message = pose_message(self._held, self.options["base_frame"])
            message.header.stamp = stamp_of(self._stamp)
            self._unanswered.append((self._stamp, time.monotonic(), self._held))
            self._sent.append(self._held.position)
            if len(self._sent) > LAG * self.options["rate"]:
                self._sent.popleft()
            self._commands.publish(message)
            if self._path is not None and self._index >= len(self._path):
                self._begin_next_motion()

    def _is_behind(self) -> bool:
        """Return whether the tool lags so far behind the command that no pose is to be sent (see LAG)."""
        now = time.monotonic()
        if self._path is not None and self._held is not None and self._sent and self._estimate is not None:
            pose, came = self._estimate
            behind = np.linalg.norm(self._held.position - pose.position)
            way = np.linalg.norm(self._held.position - self._sent[0])
            if now - came < ESTIMATE_WITHIN and behind > way + BEHIND:
                return now - self._near_at < CAUGHT_UP_WITHIN
        self._near_at = now
        return False

    def _settle(self, now: float) -> None:
        """Report that the tool has arrived, or that ``settling_timeout`` has passed without an arrival."""
        options, where = self.options, ""
        if self._held is not None and self._estimate is not None and self._estimate[1] > self._ended:
            pose = self._estimate[0]
            away = float(np.linalg.norm(pose.position - self._held.position))
            turned = rotation_angle(pose.rotation.T @ self._held.rotation)
            where = f"{away * 1e6:.2f} µm, {turned * 1e6:.2f} µrad"
            if away > options["position_tolerance"] or turned > options["rotation_tolerance"]:
                self._near_since = np.inf
            elif now - (since := min(self._near_since, now)) >= options["settling_time"]:
                self._change(ARRIVED, f"arrived, {away * 1e6:.2f} µm and {turned * 1e6:.2f} µrad from the target")
                return
            else:
                self._near_since = since
        if now - self._ended > options["settling_timeout"]:
            allowed = f"{options['position_tolerance'] * 1e6:g} µm, {options['rotation_tolerance'] * 1e6:g} µrad"
            after = f"{options['settling_timeout']:g} s"
            text = f"{where} from the target after {after}, allowed {allowed}" if where else f"no estimate for {after}"
            off = self._compensator_status.get("compensation") == "off"
            self._stopped("settling", f"{text}; the compensation is off" if off and where else text)

    # ---- state ----

    def _stopped(self, by: str, text: str) -> None:
        self._change(STOPPED, text, by)
        self.get_logger().warning(f"move stopped ({by}): {text}")

    def _change(self, state: str, text: str, by: str = "") -> None:
        self._state, self._text, self._by = state, text, by
        self._publish_state()

    def _publish_state(self) -> None:
        done = left = 0.0
        if self._motion is not None and self._path is not None:
            queued = sum(motion.duration for motion in self._queue)
            left = queued + max(len(self._path) - self._index, 0) / self.options["rate"]
            done = max(0.0, 1.0 - left / self._whole) if self._whole else 1.0
        elif self._state in (SETTLING, ARRIVED):
            done = 1.0
        self._ready_shown = self._ready()
        values = {
            "state": self._state,
            "ready": str(self._ready_shown).lower(),
            "move": str(self._moves),
            "tool": self._tool,
            "request": str(self._request),
            "share": f"{done:.4f}",
            "time_left_s": f"{left:.3f}",
            "stopped_by": self._by,
            "refused_request": str(self._refused_request),
            "refusal": self._refusal,
            **{f"frame.{name}": frame_id for name, frame_id in self._frame_ids.items()},
        }
        level = ERROR if self._state == STOPPED and self._by != "person" else OK
        self._states.publish(self.report("move", level, f"{self._state}: {self._text}", values))
        self._state_due = time.monotonic() + (STATE_PERIOD if self._state == MOVING else STANDING_PERIOD)

    def update(self, now: float) -> None:
        self._worker.poll(now)
        if self._ready() != self._ready_shown or now >= self._state_due:
            self._publish_state()
        if self._active:
            if self._unanswered and now - self._unanswered[0][1] > ANSWERED_WITHIN:
                self._resume_or_stop()
            if self._state == SETTLING:
                self._settle(now)

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        if self._geometry is None:
            yield WARN, f"waiting for {self.options['compensator']}/files"
        elif self._state == STOPPED and self._by != "person":
            yield WARN, f"stopped ({self._by}): {self._text}"
        yield OK, self._state

    def values(self, now: float) -> dict[str, str]:
        return {"state": self._state, "moves": str(self._moves), "tool": self._tool}

    def _resume_or_stop(self) -> None:
        """After an unanswered command, plan the move again from the last answered pose, if possible; otherwise stop."""
        status = self._compensator_status
        message, alive = status.get("message", ""), self.count_publishers(self.resolve_topic_name("strut_commands"))
        under_way, answered, target = self._state in UNDER_WAY, self._answered, self._target
        stands = any(reason in message for reason in LASTING)
        may_resume = alive and answered is not None and not stands and self._resumed < RESUMED
        if may_resume and not under_way:
            self._unanswered.clear()
            self._resumed += 1
            return
        if may_resume and target is not None and not self._braking:
            pending = self._pending or target
            self._halt()
            self._held, self._answered, self._pending = answered, answered, pending
            self._resumed += 1
            self.log_action("resume", "commands were delayed: the move is planned again from the last answered pose")
            self._plan(anew=True)
            return
        reason = "no node publishes strut_commands"
        if alive:  # last_refusal may be an old one, also just after a lasting reason has begun
            said = f"no answer for {ANSWERED_WITHIN:g} s; {self.options['compensator']}: {message or 'no status'}"
            reason = status.get("last_refusal", message) if "refusing" in message and not stands else said
        by = "following error" if "following_error" in message else "refusal"
        self._halt()
        self._stopped(by, reason if under_way else f"at standstill: {reason}")


main = partial(run, MoverNode, PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
