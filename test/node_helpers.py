"""What the tests of the nodes share: a bench with nodes under test, one executor, and a witness of all topics."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.nodes.compensator import CompensatorNode
from hexapod_comp.nodes.messages import pose_message
from hexapod_comp.nodes.running import autostart
from hexapod_comp.nodes.strut_drive import StrutDriveNode
from hexapod_comp.pose import Pose

CONFIG = Path(__file__).resolve().parents[1] / "config"

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)

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
}

TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
}

LOG_LINE = re.compile(r"\[\w+\] \[[\d.]+\] \[[\w.]+\]: (.*)")
"""How ROS logs: [WARN] [time] [node]: text."""

AT_ONCE = 1e-6
"""A wait that is over, s."""

HOME = Pose([0.0, 0.0, 0.4], np.eye(3))
"""Home of the paper's machine."""


@dataclass
class Answer:
    """What came back for one command.

    Attributes
    ----------
    command, correction : JointState
        The two messages with the command's stamp.
    sent_at, answered_at : float
        Monotonic times just before sending and just after both had come, s: the node handled it between.
    """

    command: JointState
    correction: JointState
    sent_at: float
    answered_at: float

    @property
    def lengths(self) -> np.ndarray:
        """Strut commands, m, shape (6,)."""
        return np.array(self.command.position)

    @property
    def corrections(self) -> np.ndarray:
        """Strut corrections, m, shape (6,)."""
        return np.array(self.correction.position)


class Bench:
    """Nodes under test on one executor in a private context, and a witness that sees and sends everything.

    Parameters
    ----------
    context : Context
        Private context.
    spin : callable
        The fixture ``spin_until``.
    capture : CaptureFixture
        The fixture ``capfd``: what is logged is read where it is written, on stderr. (Fast DDS sometimes
        delivers only the first message of /rosout to a reader in the same process.)
    namespace : str
        Of the witness and of the nodes.
    """

    def __init__(
        self,
        context: Context,
        spin: Callable[..., None],
        capture: pytest.CaptureFixture[str],
        namespace: str = "",
    ) -> None:
        self.context, self._spin, self.namespace = context, spin, namespace
        self._capture, self._log = capture, ""
        self.executor = EventsExecutor(context=context)
        self.nodes: list[LifecycleNode] = []
        self.seen: dict[str, list[Any]] = defaultdict(list)
        self.witness = rclpy.create_node("witness", context=context, namespace=namespace)
        self.executor.add_node(self.witness)
        for topic, (kind, qos) in WATCHED.items():
            self.witness.create_subscription(kind, topic, self.seen[topic].append, qos)
        self._publishers: dict[str, Any] = {}
        for topic in SENT.keys() - {"strut_commands", "strut_setpoints"}:  # a test asks for these
            self.speak(topic)
        self._clients: dict[str, Any] = {}

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.executor.shutdown()
        for node in (*self.nodes, self.witness):
            node.destroy_node()

    # ---- nodes ----

    def compensator(self, start: bool = True, **parameters: object) -> CompensatorNode:
        """Add a compensator, with the virtual machine's model unless another is given.

        `start` configures and activates it and waits until it is connected. Its machine has no feedback unless a test
        gives some, and need not wait for it unless a test says so.
        """
        self.hush("strut_commands")
        defaults = {"model_file": "paper_machine.yaml", "start_without_feedback_after": AT_ONCE}
        return self.add(CompensatorNode, start, {**defaults, **parameters})

    def drive(self, start: bool = True, **parameters: object) -> StrutDriveNode:
        """Add a strut drive, which the witness commands unless there is a compensator to do it; it alone measures."""
        self.hush("strut_states")
        if not self.nodes:
            self.speak("strut_commands")
        return self.add(StrutDriveNode, start, parameters)

    def add(self, kind: type, start: bool, parameters: dict[str, object], **options: Any) -> Any:
        """Add a node of a kind with parameter overrides; options are those of rclpy nodes."""
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        node = kind(context=self.context, namespace=self.namespace, parameter_overrides=overrides, **options)
        self.nodes.append(node)
        self.executor.add_node(node)
        if start:
            assert autostart(node), self.logged("")
            self.until(self.matched, "both directions of discovery")
        return node

    def matched(self) -> bool:
        """Return whether what nodes and witness send each other has met, in both directions."""
        heard = [s.topic_name for node in self.nodes for s in node.subscriptions]
        ours = [s.topic_name for s in self.witness.subscriptions]
        theirs = [p for node in self.nodes for p in node.publishers if p.topic_name in ours]
        return (
            all(p.get_subscription_count() for p in self._publishers.values() if p.topic_name in heard)
            and all(p.get_subscription_count() for p in theirs)
            and all(
                s.get_publisher_count() >= sum(p.topic_name == s.topic_name for p in theirs)
                for s in self.witness.subscriptions
            )
        )

    # ---- time ----

    def until(self, condition: Callable[[], object], what: str = "", timeout: float = 10.0) -> None:
        """Handle messages until a condition holds; the timeout is for a machine under load."""
        self._spin(self.executor, condition, timeout=timeout, what=what)

    def barrier(self) -> None:
        """Return when every node has handled what was sent to it before.

        All events of a process pass one queue, so the answer to a question comes after them.
        """
        for node in self.nodes:
            self.call(GetState, f"{node.get_name()}/get_state")

    # ---- services ----

    def call(self, kind: type, name: str, request: Any = None) -> Any:
        """Call a service and return its response."""
        client = self._client(kind, name)
        future = client.call_async(kind.Request() if request is None else request)
        self.until(future.done, f"answer of {name}", timeout=30.0)  # one starts a process, and others may be busy
        return future.result()

    def _client(self, kind: type, name: str) -> Any:
        """Return a client whose service is there."""
        if name not in self._clients:
            self._clients[name] = self.witness.create_client(kind, name)
        self.until(self._clients[name].service_is_ready, f"service {name}")
        return self._clients[name]

    def change(self, transition: str, node: str = "compensator") -> bool:
        """Ask a node for a lifecycle transition; return whether it went well."""
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return self.call(ChangeState, f"{node}/change_state", request).success

    def state(self, node: str = "compensator") -> str:
        """Return the lifecycle state of a node."""
        return self.call(GetState, f"{node}/get_state").current_state.label

    def enable(self, enabled: bool) -> SetBool.Response:
        """Switch compensation."""
        return self.call(SetBool, "compensator/enable_compensation", SetBool.Request(data=enabled))

    def trigger(self, name: str) -> Trigger.Response:
        """Call ``reload_model`` or ``reset``."""
        return self.call(Trigger, f"compensator/{name}")

    def begin(self, name: str) -> Any:
        """Call ``reload_model`` or ``reset`` and return the future of its response."""
        return self._client(Trigger, f"compensator/{name}").call_async(Trigger.Request())

    def call_parameter(self, node: str, name: str, value: float) -> bool:
        """Set a float parameter of a node; return whether it took it."""
        parameter = ParameterMessage(name=name)
        parameter.value.type, parameter.value.double_value = ParameterType.PARAMETER_DOUBLE, value
        request = SetParameters.Request(parameters=[parameter])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0].successful

    def set_bool(self, node: str, name: str, value: bool) -> Any:
        """Set a parameter of a node; return the result."""
        parameter = ParameterMessage(name=name)
        parameter.value.type, parameter.value.bool_value = ParameterType.PARAMETER_BOOL, value
        request = SetParameters.Request(parameters=[parameter])
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    # ---- messages ----

    def speak(self, topic: str) -> None:
        """Let the witness publish on a topic."""
        self._publishers[topic] = self.witness.create_publisher(SENT[topic], topic, RELIABLE)

    def hush(self, topic: str) -> None:
        """Let the witness publish on a topic no longer."""
        if topic in self._publishers:
            self.witness.destroy_publisher(self._publishers.pop(topic))

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message to the nodes under test."""
        self._publishers[topic].publish(message)

    def send(self, pose: Pose | PoseStamped, frame_id: str = "base") -> PoseStamped:
        """Send one command, stamped now, and return it; a message is sent as it is."""
        message = pose
        if isinstance(pose, Pose):
            message = pose_message(pose, frame_id)
            message.header.stamp = self.now()
        self.publish("tool_pose_command", message)
        return message

    def ask(self, pose: Pose | PoseStamped, frame_id: str = "base") -> Answer:
        """Send one command and wait for its answer."""
        began = time.monotonic()
        stamp = self.send(pose, frame_id).header.stamp

        def find(topic: str) -> list[JointState]:
            return [m for m in self.seen[topic][-5:] if m.header.stamp == stamp]

        self.until(
            lambda: find("strut_commands") and find("strut_corrections"),
            f"answer to a command; {self.status() and self.status().message}",
        )
        return Answer(find("strut_commands")[0], find("strut_corrections")[0], began, time.monotonic())

    def settle(self, pose: Pose) -> Answer:
        """Hold a pose until the corrections have ramped in: until two answers in turn are alike."""
        last, answer = self.ask(pose), self.ask(pose)
        while not (answer.corrections == last.corrections).all():
            last, answer = answer, self.ask(pose)
        return answer

    def estimate(self, of: JointState) -> PoseStamped:
        """Wait for the pose estimate made from a message of commanded or measured struts."""

        def find() -> list[PoseStamped]:
            return [m for m in self.seen["tool_pose_estimate"][-5:] if m.header.stamp == of.header.stamp]

        self.until(find, "a pose estimate")
        return find()[0]

    def feed(self, lengths: np.ndarray, names: tuple[str, ...] = STRUT_NAMES, later: float = 0.0) -> JointState:
        """Publish measured struts, stamped now, or so many seconds from now, and return the message.

        By a later stamp struts may have moved further since the last reading.
        """
        message = JointState(name=list(names), position=[float(v) for v in lengths], velocity=[0.0] * 6)
        message.header.stamp = self.stamp(later)
        self.publish("strut_states", message)
        return message

    def warm(self, part: str, temperature: float) -> None:
        """Publish a temperature, °C, and wait until it has been handled."""
        message = Temperature(temperature=temperature)
        message.header.frame_id = part
        self.publish("temperatures", message)
        self.barrier()

    def now(self) -> Any:
        """Return the ROS time as a stamp."""
        return self.witness.get_clock().now().to_msg()

    def stamp(self, seconds_from_now: float) -> Any:
        """Return a stamp some seconds from now."""
        return Time(nanoseconds=self.witness.get_clock().now().nanoseconds + round(seconds_from_now * 1e9)).to_msg()

    # ---- what they say ----

    def statuses(self, node: str = "compensator") -> list[DiagnosticStatus]:
        """Return all statuses of a node, oldest first."""
        prefix = f"{self.namespace.strip('/')}/{node}:".lstrip("/")
        return [s for array in self.seen["/diagnostics"] for s in array.status if s.name.startswith(prefix)]

    def status(self, node: str = "compensator") -> DiagnosticStatus | None:
        """Return the newest status of a node."""
        found = self.statuses(node)
        return found[-1] if found else None

    def values(self, node: str = "compensator") -> dict[str, str]:
        """Return the values of the newest status of a node."""
        status = self.status(node)
        return {} if status is None else {entry.key: entry.value for entry in status.values}

    def until_status(self, level: bytes, message: str, node: str = "compensator") -> dict[str, str]:
        """Wait until a node's newest status has a level and its message starts so; return the values."""

        def there() -> bool:
            status = self.status(node)
            return status is not None and status.level == level and status.message.startswith(message)

        self.until(there, f"status {message!r}")
        return self.values(node)

    def logged(self, part: str) -> list[str]:
        """Return what nodes have logged up to now and contains a part, oldest first, without time and name."""
        self._log += self._capture.readouterr().err
        texts = [match[1] for line in self._log.splitlines() if (match := LOG_LINE.fullmatch(line))]
        return [text for text in texts if part in text]


def closed_form_lengths(pose: Pose, a: float = 0.3, b: float = 0.572, d: float = 0.243) -> np.ndarray:
    """Return the paper machine's nominal strut lengths, m, from plane geometry, not from the package.

    The corners of an equiangular hexagon with sides b and d in turn lie on a circle of radius
    √((b² + bd + d²)/3), here with a side d across +x; the platform is an equilateral triangle of side a.
    """
    radius = np.sqrt((b * b + b * d + d * d) / 3.0)
    half = np.arcsin(d / (2.0 * radius))
    thirds = np.deg2rad([0.0, 120.0, 120.0, 240.0, 240.0, 360.0])
    corners = thirds + half * np.array([1, -1, 1, -1, 1, -1])
    tips = np.deg2rad([60.0, 60.0, 180.0, 180.0, 300.0, 300.0])
    base = radius * np.stack([np.cos(corners), np.sin(corners), 0 * corners], axis=1)
    platform = a / np.sqrt(3.0) * np.stack([np.cos(tips), np.sin(tips), 0 * tips], axis=1)
    return np.linalg.norm(pose.position + platform @ pose.rotation.T - base, axis=1)


def near(pose: Pose, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), tilt_deg: float = 0.0) -> Pose:
    """Return a pose shifted by metres along the base axes and tilted about its own x axis."""
    turn = Rotation.from_euler("X", tilt_deg, degrees=True).as_matrix()
    return Pose(pose.position + shift, pose.rotation @ turn)


def geometry_file(folder: Path, limits: dict[str, object] | None = None, **sections: object) -> str:
    """Write the shipped geometry with other limits or sections into a folder and return its path."""
    data = yaml.safe_load((CONFIG / "paper.yaml").read_text(encoding="utf-8"))
    data["limits"].update(limits or {})
    data.update(sections)
    path = folder / "geometry.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)


def model_file(folder: Path, name: str = "model.yaml", **sections: object) -> str:
    """Write a small model of the paper's machine into a folder and return its path."""
    data = {"format": "hexapod_comp/model", "version": 1, "machine": "paper", "name": "written by a test"}
    data.update({"date": "2026-01-31", "sources": []})
    data.update(sections)
    path = folder / name
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return str(path)
