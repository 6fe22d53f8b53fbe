"""Test bench: compensator, strut drive and the tester's nodes on one executor, without launch, processes or sleeps."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Vector3Stamped, WrenchStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from ..formats.paths import config_file
from ..machine.geometry import STRUT_NAMES, load_geometry
from ..machine.model_file import save_model
from ..pose import Pose
from ..ros.base import profile, status_prefix
from ..ros.compensator import CompensatorNode
from ..ros.messages import message_pose, pose_message
from ..ros.process import autostart
from ..ros.strut_drive import StrutDriveNode
from ..virtual.named import find_model, is_random

if TYPE_CHECKING:
    import pytest

RELIABLE = profile(100)
BEST_EFFORT = profile(100, reliable=False)

WATCHED = {
    "strut_commands": (JointState, RELIABLE),
    "strut_corrections": (JointState, RELIABLE),
    "strut_commands_array": (Float64MultiArray, RELIABLE),
    "strut_states": (JointState, BEST_EFFORT),
    "tool_pose_estimate": (PoseStamped, BEST_EFFORT),
    "tool_pose_true": (PoseStamped, BEST_EFFORT),
    "compensator/markers": (MarkerArray, RELIABLE),
    "/diagnostics": (DiagnosticArray, RELIABLE),
}

SENT = {
    "tool_pose_command": PoseStamped,
    "strut_setpoints": JointState,
    "strut_states": JointState,
    "strut_commands": JointState,
    "temperatures": Temperature,
    "humidity": RelativeHumidity,
    "gravity": Vector3Stamped,
    "wrench": WrenchStamped,
    "outside": JointState,
}

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}

LOG_LINE = re.compile(r"\[\w+\] \[[\d.]+\] \[[\w.]+\]: (.*)")  # ROS's format of a log line: [WARN] [time] [node]: text


@dataclass
class Answer:
    """The two messages, with the command's stamp, by which a compensator answers a command."""

    command: JointState
    correction: JointState
    sent_at: float  # monotonic time just before the command was sent, s
    answered_at: float  # monotonic time just after both messages had arrived, s

    @property
    def lengths(self) -> np.ndarray:
        return np.array(self.command.position)

    @property
    def corrections(self) -> np.ndarray:
        return np.array(self.correction.position)


class Bench:
    """A test bench: all nodes of a test on one executor, in a private context.

    The bench's node `witness` records the machine's messages in `seen`, and sends the test's messages.
    """

    def __init__(
        self, context: Context, capture: pytest.CaptureFixture[str] | None = None, namespace: str = ""
    ) -> None:
        self.context, self.namespace = context, namespace
        self._capture, self._log = capture, ""
        self._folder = TemporaryDirectory()
        self.executor = EventsExecutor(context=context)
        self.nodes: list[Node] = []
        self.seen: dict[str, list[Any]] = defaultdict(list)
        self.witness = rclpy.create_node("witness", context=context, namespace=namespace)
        self.executor.add_node(self.witness)
        for topic, (kind, qos) in WATCHED.items():
            self.witness.create_subscription(kind, topic, self.seen[topic].append, qos)
        self._publishers: dict[str, Any] = {}
        # drive() adds a publisher of strut_commands; a test adds a publisher of strut_setpoints
        for topic in SENT.keys() - {"strut_commands", "strut_setpoints"}:
            self.add_publisher(topic)
        self._clients: dict[str, Any] = {}

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.executor.shutdown()
        for node in (*self.nodes, self.witness):
            node.destroy_node()
        self._folder.cleanup()

    # ---- nodes ----

    def compensator(self, start: bool = True, **parameters: object) -> CompensatorNode:
        """Add a compensator; with `start`, configure and activate it, and wait until `witness` is connected with it."""
        self.remove_publisher("strut_commands")
        return self.add(CompensatorNode, start, parameters)

    def drive(self, start: bool = True, **parameters: object) -> StrutDriveNode:
        """Add a strut drive, which then publishes strut_states. If the bench has no node yet, the node `witness`
        publishes strut_commands.
        """
        self.remove_publisher("strut_states")
        if not self.nodes:
            self.add_publisher("strut_commands")
        return self.add(StrutDriveNode, start, parameters)

    def machine(self, geometry: str = "paper.yaml", model: str = "ideal", truth: str = "ideal") -> None:
        """Add a drive with the errors `truth` and a compensator with `model`: each a file's name or ``random:SEED``."""
        self.remove_publisher("tool_pose_command")
        self.drive(geometry_file=geometry, truth_file=truth)
        if is_random(model):
            drawn = find_model(model, load_geometry(config_file(geometry, "geometry")))
            model = str(Path(self._folder.name) / "model.yaml")
            save_model(drawn, model)
        self.compensator(geometry_file=geometry, model_file=model)
        self.until(lambda: self.values().get("feedback_age_s", "never") != "never", "the drive's first strut_states")

    def host(self, node: Node) -> Node:
        """Add the tester's own node, made with ``context=bench.context``, to the bench's executor."""
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def add(self, kind: type, start: bool, parameters: dict[str, object], **options: Any) -> Any:
        """Add a node of the class `kind`; with `start`, configure and activate it; pass `options` to the class."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = kind(context=self.context, namespace=self.namespace, parameter_overrides=overrides, **options)
        self.host(node)
        if start:
            if not autostart(node):
                raise RuntimeError(f"{node.get_name()} does not start: {self.logged('')}")
            self.until(self.matched, "both directions of discovery")
        return node

    def matched(self) -> bool:
        """Return whether the node `witness` is connected with the other nodes on all topics, in both directions."""
        read = [s.topic_name for node in self.nodes for s in node.subscriptions]
        ours = [s.topic_name for s in self.witness.subscriptions]
        theirs = [p for node in self.nodes for p in node.publishers if p.topic_name in ours]
        return (
            all(p.get_subscription_count() for p in self._publishers.values() if p.topic_name in read)
            and all(p.get_subscription_count() for p in theirs)
            and all(
                s.get_publisher_count() >= sum(p.topic_name == s.topic_name for p in theirs)
                for s in self.witness.subscriptions
            )
        )

    # ---- time ----

    def until(self, condition: Callable[[], object], what: str = "", timeout: float = 30.0) -> None:
        """Handle messages until the condition holds; after `timeout` seconds raise a TimeoutError that names `what`."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                awaited = what or getattr(condition, "__name__", "condition")
                raise TimeoutError(f"did not happen within {timeout} s: {awaited}")
            self.executor.spin_once(timeout_sec=0.02)

    def barrier(self) -> None:
        """Wait until every lifecycle node has handled all messages sent before this call."""
        # this process has one queue of events, so a node handles earlier messages before a service call
        for node in (node for node in self.nodes if isinstance(node, LifecycleNode)):
            self.call(GetState, f"{node.get_name()}/get_state")

    # ---- services ----

    def call(self, kind: Any, name: str, request: Any = None) -> Any:
        client = self._client(kind, name)
        future = client.call_async(kind.Request() if request is None else request)
        self.until(future.done, f"answer of {name}")  # a service may start a process first
        return future.result()

    def _client(self, kind: type, name: str) -> Any:
        if name not in self._clients:
            self._clients[name] = self.witness.create_client(kind, name)
        self.until(self._clients[name].service_is_ready, f"service {name}")
        return self._clients[name]

    def change(self, transition: str, node: str = "compensator") -> bool:
        """Request a lifecycle transition of a node; return whether it succeeded."""
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return self.call(ChangeState, f"{node}/change_state", request).success

    def state(self, node: str = "compensator") -> str:
        return self.call(GetState, f"{node}/get_state").current_state.label

    def enable(self, enabled: bool) -> SetBool.Response:
        return self.call(SetBool, "compensator/enable_compensation", SetBool.Request(data=enabled))

    def trigger(self, name: str) -> Trigger.Response:
        """Call the compensator's service ``reload_model`` or ``reset`` and return its response."""
        return self.call(Trigger, f"compensator/{name}")

    def begin(self, name: str) -> Any:
        """Call the compensator's service ``reload_model`` or ``reset`` and return the future of its response."""
        return self._client(Trigger, f"compensator/{name}").call_async(Trigger.Request())

    def set_parameter(self, node: str, name: str, value: object) -> SetParametersResult:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    def fault(self, name: str, value: object) -> None:
        """Set the drive's parameter ``fault_NAME``, as in ``fault("stuck_strut", 3)``; raise ValueError if refused."""
        answer = self.set_parameter("strut_drive", f"fault_{name}", value)
        if not answer.successful:
            raise ValueError(answer.reason)

    # ---- messages ----

    def add_publisher(self, topic: str) -> None:
        self._publishers[topic] = self.witness.create_publisher(SENT[topic], topic, RELIABLE)

    def remove_publisher(self, topic: str) -> None:
        if topic in self._publishers:
            self.witness.destroy_publisher(self._publishers.pop(topic))

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message; make a publisher first if the topic has none, or if :meth:`machine` has removed it."""
        if topic not in self._publishers:
            self.add_publisher(topic)
            self.until(self.matched, f"a subscriber of {topic}")
        self._publishers[topic].publish(message)

    def send(self, pose: Pose | PoseStamped, frame_id: str = "base") -> PoseStamped:
        """Send a pose as a command stamped with the present time, or a message unchanged; return the sent message."""
        message = self._stamped(pose, frame_id)
        self.publish("tool_pose_command", message)
        return message

    def _stamped(self, pose: Pose | PoseStamped, frame_id: str) -> PoseStamped:
        """Return a pose as a message stamped with the present time; return a message unchanged."""
        if not isinstance(pose, Pose):
            return pose
        message = pose_message(pose, frame_id)
        message.header.stamp = self.now()
        return message

    def ask(self, pose: Pose | PoseStamped, frame_id: str = "base") -> Answer:
        """Send one command and wait for the answer; send the command again if it was refused for its age."""
        began, too_old = time.monotonic(), self._too_old()
        message = self.send(pose, frame_id)
        self.until(
            lambda: self._replies(message) or (message is not pose and self._too_old() > too_old),
            f"answer to a command; {self.message()}",
        )
        replies = self._replies(message)
        return Answer(*replies, began, time.monotonic()) if replies else self.ask(self._stamped(pose, frame_id))

    def _replies(self, asked: PoseStamped) -> tuple[JointState, JointState] | None:
        """Return the strut command and the correction with the stamp of `asked`, or None if one is missing."""
        command, correction = (
            next((m for m in self.seen[topic][-5:] if m.header.stamp == asked.header.stamp), None)
            for topic in ("strut_commands", "strut_corrections")
        )
        return (command, correction) if command and correction else None

    def _too_old(self) -> int:
        return int(self.values().get("refused.stamp_past", "0"))

    def settle(self, pose: Pose) -> Answer:
        """Send a pose repeatedly until the ramp has ended: two successive answers have equal corrections."""
        last, answer = self.ask(pose), self.ask(pose)
        while not (answer.corrections == last.corrections).all():
            last, answer = answer, self.ask(pose)
        return answer

    def estimate(self, of: JointState) -> PoseStamped:
        """Wait for the pose estimate with the same stamp as the strut message `of`, and return it."""

        def find() -> list[PoseStamped]:
            return [m for m in self.seen["tool_pose_estimate"][-5:] if m.header.stamp == of.header.stamp]

        self.until(find, "a pose estimate")
        return find()[0]

    def tool(self) -> Pose:
        """Return the newest true tool pose in ``base``; wait for the first."""
        self.until(lambda: self.seen["tool_pose_true"], "the drive's true pose")
        return message_pose(self.seen["tool_pose_true"][-1])

    def feed(self, lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES, later: float = 0.0) -> JointState:
        """Publish measured struts, m, with a stamp that is `later` s after the present time, and return the message."""
        # a larger `later` lets the compensator accept a larger change since the last reading
        message = JointState(name=list(names), position=[float(v) for v in lengths], velocity=[0.0] * 6)
        message.header.stamp = self.stamp(later)
        self.publish("strut_states", message)
        return message

    def warm(self, part: str, temperature: float) -> None:
        """Publish a temperature, °C, of a part of the machine, and wait until the nodes have handled it."""
        message = Temperature(temperature=temperature)
        message.header.frame_id = part
        self.publish("temperatures", message)
        self.barrier()

    def publish_humidity(self, humidity: float) -> None:
        """Publish a relative humidity, 0 to 1, and wait until the nodes have handled it."""
        self.publish("humidity", RelativeHumidity(relative_humidity=humidity))
        self.barrier()

    def now(self) -> Any:
        return self.witness.get_clock().now().to_msg()

    def stamp(self, seconds_from_now: float) -> Any:
        return Time(nanoseconds=self.witness.get_clock().now().nanoseconds + round(seconds_from_now * 1e9)).to_msg()

    # ---- status and log ----

    def statuses(self, node: str = "compensator") -> list[DiagnosticStatus]:
        """Return all statuses of a node, oldest first."""
        return list(self._newest_first(node))[::-1]

    def _newest_first(self, node: str) -> Iterator[DiagnosticStatus]:
        prefix = status_prefix(self.namespace, node)
        for array in reversed(self.seen["/diagnostics"]):
            yield from (status for status in reversed(array.status) if status.name.startswith(prefix))

    def status(self, node: str = "compensator") -> DiagnosticStatus | None:
        return next(self._newest_first(node), None)

    def message(self, node: str = "compensator") -> str:
        status = self.status(node)
        return "" if status is None else status.message

    def values(self, node: str = "compensator") -> dict[str, str]:
        status = self.status(node)
        return {} if status is None else {entry.key: entry.value for entry in status.values}

    def until_status(self, level: bytes, message: str, node: str = "compensator") -> dict[str, str]:
        """Wait until a status, the newest or a later one, has `level` and a text that starts with `message`; return its
        values.
        """
        statuses = self.statuses(node)
        looked_at, hits = max(len(statuses) - 1, 0), list[DiagnosticStatus]()

        def there() -> bool:
            nonlocal looked_at
            later = self.statuses(node)[looked_at:]
            looked_at += len(later)
            hits.extend(s for s in later if s.level == level and s.message.startswith(message))
            return bool(hits)

        self.until(there, f"status {message!r}")
        return {entry.key: entry.value for entry in hits[0].values}

    def logged(self, part: str) -> list[str]:
        """Return all log lines that contain `part`, oldest first, without time stamp and node name."""
        self._log += self._capture.readouterr().err if self._capture else ""
        texts = [match[1] for line in self._log.splitlines() if (match := LOG_LINE.fullmatch(line))]
        return [text for text in texts if part in text]
