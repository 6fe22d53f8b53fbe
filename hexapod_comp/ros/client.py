"""Clients of the nodes: :class:`LoopClient` sends tool poses to the compensator, for ``run`` and benchmarks;
:class:`Machine` sends targets to the mover."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from ..errors import CommandError, HexapodError, NoAnswerError
from ..machine.geometry import TOOL
from ..machine.trajectory import Path
from ..pose import Pose
from .base import COMMAND_QOS, EVENT_QOS, LATCHED_QOS, NEWEST_QOS, hardware_id, profile, status_prefix
from .messages import StrutReader, message_pose, nanoseconds_of, pose_message
from .process import RosSession
from .rclpy_compat import publishers

LISTENER_QOS = profile(200)  # QoS of the compensator's answers, none of which may be lost
TRACK_QOS = profile(200, reliable=False)  # QoS of true tool poses, of which `settled` needs many

# A command that is not answered within this time, s, counts as lost; a busy computer may delay an answer by seconds
ANSWER_TIMEOUT = 5.0

FOUND_WITHIN, READY_WITHIN = 10.0, 30.0  # Longest wait, s, until a mover is found, and until it is ready
ALONE_WITHIN = 30.0  # Longest wait, s, until a topic has one publisher; a killed node stays in the graph for 20 s

# A mover at standstill publishes a state each second. If this many states after a request do not mention the request,
# the mover has not received it. States are counted, since a busy computer may deliver a request a minute later.
UNMENTIONED = 5


@dataclass
class Sent:
    """A tool pose command that was sent, and the compensator's answer."""

    sent_at: float  # monotonic time, s
    refused: int  # number of commands refused before this command was sent
    too_old: int  # number of these refused commands that were older than `max_command_age`
    message: PoseStamped
    answered_at: float = float("nan")  # monotonic time, s; NaN while unanswered
    command: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # strut lengths, m; NaN while unanswered
    correction: np.ndarray = field(default_factory=lambda: np.full(6, np.nan))  # corrections, m; NaN while unanswered


class NodeClient(RosSession):
    """A client of the nodes of one machine."""

    machine = ""  # hardware_id in the nodes' newest status: namespace and name of the machine

    def refuse_other(self, name: str) -> None:
        """Raise a CommandError if the running machine is not the machine `name`."""
        if self.machine != hardware_id(self.node.get_namespace(), name):
            problem = f"the nodes run the machine {self.machine!r}, not {name!r}"
            raise CommandError("machine", f"{problem}: name the running machine's geometry file by --machine")

    def wait_until_alone(self, *topics: str) -> None:
        """Wait until no topic has several publishers; after ALONE_WITHIN raise a NoAnswerError that names the nodes."""
        several = [topic for topic in topics if self.node.count_publishers(topic) > 1]
        names = ", ".join(name for topic in several for name in publishers(self.node, topic)[0])
        what = f"a single publisher of {' and of '.join(several)} (publishers now: {names})"
        self.wait(lambda: all(self.node.count_publishers(topic) < 2 for topic in several), ALONE_WITHIN, what)


class LoopClient(NodeClient):
    """A client that sends tool poses to a compensator and records answers, estimates and diagnostics."""

    def __init__(self, namespace: str = "") -> None:
        super().__init__("hexapod_comp_client", namespace)
        self._reader = StrutReader()
        self.sent: dict[int, Sent] = {}  # sent commands by their stamps, ns
        self.diagnostics: dict[str, str] = {}  # values of the compensator's newest status
        self.true_count = 0  # number of true poses received
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
            lengths = self._reader.read(message)
            if topic == "strut_commands":
                entry.answered_at, entry.command = time.monotonic(), lengths
            else:
                entry.correction = lengths

    def _on_pose(self, topic: str, message: PoseStamped) -> None:
        self._newest[topic] = message
        if topic == "tool_pose_true":
            self.true_count += 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self._status_name):
                self.diagnostics = {entry.key: entry.value for entry in status.values}
                self.machine = status.hardware_id
                if "commands" in self.diagnostics:  # the status of an unconfigured node has no counts
                    self._counted_before = self._counted_before or self._counts()

    @property
    def has_true_pose(self) -> bool:
        return "tool_pose_true" in self._newest

    @property
    def true_pose(self) -> Pose:
        return message_pose(self._received("tool_pose_true"))

    @property
    def estimate(self) -> Pose:
        return message_pose(self._received("tool_pose_estimate"))

    def _received(self, topic: str) -> PoseStamped:
        if topic not in self._newest:
            raise NoAnswerError(f"no {topic} has been received")
        return self._newest[topic]

    def connected(self) -> bool:
        """Return whether a configured compensator is found and its pose estimates arrive."""
        return (
            self._publisher.get_subscription_count() > 0
            and self.node.count_publishers("strut_commands") > 0
            and "tool_pose_estimate" in self._newest
            and self._enable.service_is_ready()
            and "commands" in self.diagnostics  # the status of an unconfigured node has no counts
        )

    def _counts(self) -> tuple[int, int]:
        return int(self.diagnostics["commands"]), int(self.diagnostics["refused"])

    def counted(self) -> tuple[int, int]:
        """Return the numbers of accepted and of refused commands since this client's first diagnostics.

        Wait up to 2.5 s until accepted and refused commands are as many as this client has sent; no other client may
        send commands meanwhile.
        """
        accepted_before, refused_before = self._counted_before or (0, 0)
        end = time.monotonic() + 2.5
        while True:
            accepted, refused = self._counts()
            accepted, refused = accepted - accepted_before, refused - refused_before
            if accepted + refused >= len(self.sent) or time.monotonic() > end:
                return accepted, refused
            self.spin_once(0.05)

    def enable(self, enabled: bool) -> None:
        """Switch the compensation on or off; raise a CommandError if the compensator refuses."""
        self.call(self._enable, SetBool.Request(data=enabled), ANSWER_TIMEOUT)

    def send(self, pose: Pose) -> Sent:
        """Send a tool pose in ``base`` as a command; return the command's record, which gets the answer later."""
        return self._send(self._command(pose))

    def _command(self, pose: Pose) -> PoseStamped:
        return pose_message(pose, self._received("tool_pose_estimate").header.frame_id)

    def _send(self, message: PoseStamped) -> Sent:
        stamp = self.node.get_clock().now()
        message.header.stamp = stamp.to_msg()
        entry = self.sent[stamp.nanoseconds] = Sent(time.monotonic(), *self._refused(), message)
        self._publisher.publish(message)
        return entry

    def _refused(self) -> tuple[int, int]:
        """Return the number of refused commands, and how many of these were refused for their age."""
        return int(self.diagnostics.get("refused", "0")), int(self.diagnostics.get("refused.stamp_past", "0"))

    def wait_for_answer(self, entry: Sent, timeout: float = ANSWER_TIMEOUT) -> Sent:
        """Wait until strut command and correction have arrived; return the answered record, or raise a NoAnswerError.

        If the command was refused for its age, send its pose again with a new stamp and return the new record: without
        this pose, a path's next pose would be more than one allowed step away.
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
            self.spin_once(0.01)
        return entry

    def stream(self, path: Path, progress: Callable[[int], object]) -> list[Sent]:
        """Send the poses of a path at its rate and return the commands' records; call `progress(1)` after each command.

        Each command waits for the answer to the previous command, so that a stall delays the path and causes no jump.
        """
        entries: list[Sent] = []
        messages = [self._command(path.pose(n)) for n in range(len(path))]
        due = time.monotonic()
        for message in messages:
            while (left := due - time.monotonic()) > 0.0:
                self.spin_once(left)
            if entries:
                entries[-1] = self.wait_for_answer(entries[-1])
            entries.append(self._send(message))
            progress(1)
            due = max(due + 1.0 / path.rate, time.monotonic() - 1.0 / path.rate)
        entries[-1] = self.wait_for_answer(entries[-1])
        return entries

    def hold(self, pose: Pose, rate: float, until: Callable[[], bool], timeout: float, what: str) -> Sent:
        """Send a pose `rate` times a second until `until()` is true; raise NoAnswerError after `timeout` seconds."""
        end = time.monotonic() + timeout
        while True:
            entry = self.wait_for_answer(self.send(pose))
            next_due = entry.sent_at + 1.0 / rate
            while (left := next_due - time.monotonic()) > 0.0:
                self.spin_once(left)
            if until():
                return entry
            if time.monotonic() > end:
                raise NoAnswerError(f"waited {timeout:g} s in vain for {what}")

    def settled(self) -> Callable[[], bool]:
        """Return a function that is true if the last 25 true tool positions differ by less than 20 nm in each axis."""
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


class MoveError(HexapodError):
    """A move that was refused or stopped; `reason` is ``refused`` or a cause such as ``limit`` or ``person``."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(f"{reason}: {text}")
        self.reason = reason


@dataclass(frozen=True)
class MoveState:
    """A state of the mover, from its topic ``~/state``."""

    state: str  # idle, planning, moving, settling, arrived, stopped
    text: str
    share: float  # completed share of the move's duration, 0 to 1
    time_left: float  # time until the last pose is sent, s
    stopped_by: str  # cause of the stop; empty: the move was not stopped
    request: int  # stamp of the message that requested the move, ns
    refused_request: int  # stamp of the newest refused message, ns
    refusal: str
    ready: bool = True  # the mover knows the machine and the present pose of its tool
    moves: int = 0  # number of moves since the mover was started
    frames: Mapping[str, str] = field(default_factory=dict)  # frame_id of each frame that the mover knows, by its name
    tool: str = TOOL  # name of the tool in use, which a move brings to its target

    @property
    def at_rest(self) -> bool:
        return self.state in ("idle", "arrived", "stopped")


class Machine(NodeClient):
    """A client of a running machine's mover: it moves the tool and waits until the tool has arrived.

    `namespace` is the namespace of the machine's nodes, `mover` the mover node's name. A NoAnswerError is raised if no
    mover is found within 10 s, or if the mover is not ready within 30 s.
    """

    def __init__(self, namespace: str = "", mover: str = "mover") -> None:
        super().__init__("hexapod_comp_machine", namespace)
        self.state: MoveState | None = None
        node = self.node
        self._to = node.create_publisher(PoseStamped, "move_to", EVENT_QOS)
        self._by = node.create_publisher(PoseStamped, "move_by", EVENT_QOS)
        self._stop = node.create_client(Trigger, f"{mover}/stop")
        self._states = node.create_subscription(
            DiagnosticStatus, f"{mover}/state", self._on_state, LATCHED_QOS
        ).topic_name
        try:
            self.wait(lambda: self.node.count_publishers(self._states), FOUND_WITHIN, f"the node {mover}")
            what = f"the node {mover} to be ready: it needs an active compensator's files and pose estimate"
            self.wait(self._connected, READY_WITHIN, what)
        except NoAnswerError:
            self.close()
            raise

    def frame_id(self, name: str) -> str:
        """Return the mover's frame_id of the frame `name`, such as ``left/work``; return an unknown name unchanged."""
        return self.last.frames.get(name, name)

    @property
    def last(self) -> MoveState:
        if self.state is None:
            raise NoAnswerError("the mover has not reported a state yet")
        return self.state

    def move(
        self,
        pose: Pose,
        frame_id: str = "work",
        relative: bool = False,
        timeout: float = 3600.0,
        progress: Callable[[MoveState], object] = lambda state: None,
    ) -> MoveState:
        """Move the tool along a straight line, with the shortest rotation; return the mover's state at the arrival.

        The tool has arrived when its estimate, from measured struts, has stayed within the mover's tolerances of the
        target for the settling time. A move in progress is braked first; the call of `move` that began it raises a
        MoveError (``replaced``).

        `pose` is the tool's target in the frame `frame_id`: ``work``, ``base`` or a named work frame, written without
        the prefix that the machine's frame_ids may have. If `relative` is true, `pose` is a displacement from the
        tool's present pose, along and about the frame's axes, and the frame may also be ``tool``. The client
        stops the move after `timeout` seconds.

        Raises a MoveError, whose ``reason`` is the cause, if the move was refused or stopped. Raises a NoAnswerError if
        the mover has ended or not received the request, if the tool has not arrived within `timeout`, or if two movers
        publish ``~/state`` for 30 s.
        """
        self.wait_until_alone(self._states)
        self.catch_up()
        stamp = self.node.get_clock().now()
        message = pose_message(pose, self.frame_id(frame_id))
        message.header.stamp = stamp.to_msg()
        asked, seen = stamp.nanoseconds, self.last
        begun, unmentioned = False, 0
        (self._by if relative else self._to).publish(message)
        end = time.monotonic() + timeout
        while True:
            self.spin_once(0.02)
            state = self.last
            if state is not seen:
                restarted, seen = state.moves < seen.moves, state
                if state.refused_request == asked:
                    raise MoveError("refused", state.refusal)
                if state.request == asked:
                    begun = True
                    progress(state)
                    if state.state == "arrived":
                        return state
                    if state.state == "stopped":
                        raise MoveError(state.stopped_by, state.text)
                elif restarted:
                    raise MoveError("restarted", "the mover was restarted")
                elif begun:
                    raise MoveError("replaced", "another move was requested")
                elif state.at_rest and (unmentioned := unmentioned + 1) >= UNMENTIONED:
                    raise NoAnswerError("the mover is at standstill and has not received the request")
            elif self.node.count_publishers(self._states) == 0:
                raise NoAnswerError("the mover has ended")
            if time.monotonic() > end:
                self.stop()
                raise NoAnswerError(f"the tool had not arrived after {timeout:g} s, and was stopped")

    def stop(self) -> None:
        """Brake within the struts' limits, and return when the mover reports standstill."""
        self.call(self._stop, Trigger.Request(), ANSWER_TIMEOUT)
        self.wait(lambda: self.state is not None and self.state.at_rest, 60.0, "the standstill of the tool")

    def _connected(self) -> bool:
        found = self._to.get_subscription_count() and self._by.get_subscription_count()
        return bool(found) and self.state is not None and self.state.ready and self._stop.service_is_ready()

    def _on_state(self, message: DiagnosticStatus) -> None:
        v, self.machine = {entry.key: entry.value for entry in message.values}, message.hardware_id
        self.state = MoveState(
            v["state"],
            message.message.partition(": ")[2],
            float(v["share"]),
            float(v["time_left_s"]),
            v["stopped_by"],
            int(v["request"]),
            int(v["refused_request"]),
            v["refusal"],
            v["ready"] == "true",
            int(v["move"]),
            {key.removeprefix("frame."): frame_id for key, frame_id in v.items() if key.startswith("frame.")},
            v["tool"],
        )
