"""The verb ``echo``: the messages of a topic with units, rate and age, without the command ``ros2``."""

from __future__ import annotations

import importlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature, TimeReference
from std_msgs.msg import Float64MultiArray

from ..errors import CommandError, HexapodError, printable
from ..machine.geometry import STRUT_NAMES
from ..pose import Pose
from .base import profile
from .messages import nanoseconds_of, read_message

DISCOVERY_TIME = 3.0  # Longest wait for the discovery of a topic, s; Fast DDS needs 0.1 to 1 s
RATE_WINDOW = 2.0  # Time over which the rate is averaged, s
QUEUE = 1000  # Length of the queue: one second of commands at 1 kHz, for a slow terminal

ANGLES = ("alpha", "beta", "gamma")
LEVELS = {b"\x00": "OK", b"\x01": "WARN", b"\x02": "ERROR", b"\x03": "STALE"}


class MessageField(NamedTuple):
    """A number or text of a message with its unit in ASCII: mm, um, deg, urad, mm_s, degC, percent, s, or empty."""

    name: str
    value: Any
    unit: str = ""

    @property
    def key(self) -> str:
        """The field's name followed by its unit, such as ``x_mm``."""
        return f"{self.name}_{self.unit}" if self.unit else self.name


# Displayed unit by the unit in a key such as ``x_um``, where the two differ
UNITS = {"um": "µm", "urad": "µrad", "deg": "°", "mm_s": "mm/s", "degC": "°C", "percent": "%"}

# Digits after the decimal point, by unit; nine for numbers with another unit or none
DIGITS = {"mm": 6, "um": 3, "deg": 6, "urad": 3, "mm_s": 3, "degC": 2, "percent": 1, "s": 6}


def message_fields(topic: str, message: Any) -> list[MessageField]:
    """Return a message's numbers in displayed units; messages of unknown types stay in SI."""
    if isinstance(message, PoseStamped):
        p, q = message.pose.position, message.pose.orientation
        quaternion, rows = (q.x, q.y, q.z, q.w), [MessageField("frame", message.header.frame_id)]
        rows += [MessageField(axis, value * 1e3, "mm") for axis, value in zip("xyz", (p.x, p.y, p.z), strict=True)]
        try:
            degrees = np.degrees(Pose.from_quaternion((0.0, 0.0, 0.0), quaternion).angles()).tolist()
        except HexapodError:  # the quaternion's norm is not 1: show it as received
            return rows + [MessageField(f"q{axis}", value) for axis, value in zip("xyzw", quaternion, strict=True)]
        return rows + [MessageField(name, angle, "deg") for name, angle in zip(ANGLES, degrees, strict=True)]
    if isinstance(message, PoseWithCovarianceStamped):  # a tool error, with a small rotation
        p, q = message.pose.pose.position, message.pose.pose.orientation
        deviations = np.sqrt(np.diag(np.reshape(message.pose.covariance, (6, 6)))).tolist()
        twice = 2.0 * math.copysign(1.0, q.w)  # sin(ω/2) = ω/2 to 1e-13 at 100 µrad
        values = p.x, p.y, p.z, twice * q.x, twice * q.y, twice * q.z
        rows = [MessageField("frame", message.header.frame_id)]
        for name, value, sigma in zip(("x", "y", "z", "rx", "ry", "rz"), values, deviations, strict=True):
            unit = "urad" if name.startswith("r") else "um"
            rows += [MessageField(name, value * 1e6, unit), MessageField(f"{name}_sigma", sigma * 1e6, unit)]
        return rows
    if isinstance(message, JointState) and set(message.name) == set(STRUT_NAMES) and not message.effort:
        return _strut_rows(message.name, message.position, message.velocity, topic.endswith("strut_corrections"))
    if isinstance(message, Float64MultiArray) and topic.endswith("strut_commands_array"):
        return _strut_rows(STRUT_NAMES, message.data, (), False)
    if isinstance(message, DiagnosticArray | DiagnosticStatus):
        rows = []
        for status in message.status if isinstance(message, DiagnosticArray) else [message]:
            level = LEVELS.get(status.level, repr(status.level))
            rows.append(MessageField(status.name, f"{level}: {status.message}"))
            rows += [MessageField(f"  {entry.key}", entry.value) for entry in status.values]
        return rows
    if isinstance(message, Temperature):
        return [MessageField(message.header.frame_id or "temperature", message.temperature, "degC")]
    if isinstance(message, RelativeHumidity):
        return [MessageField("humidity", message.relative_humidity * 100.0, "percent")]
    if isinstance(message, TimeReference):
        valid = (nanoseconds_of(message.time_ref) - nanoseconds_of(message.header.stamp)) * 1e-9
        return [MessageField("valid_for", valid, "s"), MessageField("source", message.source)]
    return list(_plain_rows("", message))


def _strut_rows(
    names: Sequence[str], lengths: Sequence[float], speeds: Sequence[float], micro: bool
) -> list[MessageField]:
    scale, unit = (1e6, "um") if micro else (1e3, "mm")
    rows = [MessageField(name, length * scale, unit) for name, length in zip(names, lengths, strict=False)]
    if any(speeds):
        rows += [MessageField(f"{name}_speed", speed * 1e3, "mm_s") for name, speed in zip(names, speeds, strict=False)]
    return rows


def _plain_rows(prefix: str, value: Any) -> Iterator[MessageField]:
    """Yield the fields of any message, in SI, with dotted names; a sequence yields its first twelve items."""
    if isinstance(value, Time | Duration):
        yield MessageField(prefix, value.sec + value.nanosec * 1e-9, "s")
    elif hasattr(value, "get_fields_and_field_types"):
        for name in value.get_fields_and_field_types():
            yield from _plain_rows(f"{prefix}.{name}" if prefix else name, getattr(value, name))
    elif isinstance(value, str | bytes | bool | int | float):
        yield MessageField(prefix, value if not isinstance(value, bytes) else value.hex())
    else:
        items = list(value)
        for n, item in enumerate(items[:12]):
            yield from _plain_rows(f"{prefix}[{n}]", item)
        if len(items) > 12:
            yield MessageField(prefix, f"… {len(items)} items")


class EchoedMessage(NamedTuple):
    """A received message, ready for display."""

    topic: str  # full name
    rows: list[MessageField]
    stamp: float  # stamp of the header, s since 1970; NaN if there is none
    age: float  # time of receipt minus stamp, s; NaN without a stamp
    rate: float  # rate over the last RATE_WINDOW, Hz; NaN for the first message

    def text(self) -> str:
        parts = [self.topic]
        parts += [f"{self.rate:.1f} Hz"] if math.isfinite(self.rate) else []
        parts += [f"{self.age * 1e3:.1f} ms old"] if math.isfinite(self.age) else ["no stamp"]
        lines, width = [", ".join(parts)], max((len(row.name) for row in self.rows), default=0)
        for row in self.rows:
            shown, digits = printable(str(row.value), 1000), DIGITS.get(row.unit, 9)
            if isinstance(row.value, float):
                shown = f"{row.value + 0.0:{digits + 6}.{digits}f} {UNITS.get(row.unit, row.unit)}"
            lines.append(f"  {row.name:<{width}}  {shown}".rstrip())
        return "\n".join(lines)

    def record(self) -> dict[str, Any]:
        """Return the message as a flat JSON object with units in the keys."""
        head = {"topic": self.topic, "stamp_s": self.stamp, "age_ms": self.age * 1e3, "rate_hz": self.rate}
        return {**head, **{row.key.strip(): row.value for row in self.rows}}


class Echo:
    """Subscription to a topic of any type: waits for the first publisher, and uses a QoS that fits all publishers."""

    def __init__(
        self, node: Node, spin_once: Callable[[float], None], topic: str, receive: Callable[[EchoedMessage], None]
    ) -> None:
        self._node, self._receive = node, receive
        try:
            self.topic = node.resolve_topic_name(topic)
        except RuntimeError as error:  # raised by rcl; its text ends with a position in rcl's sources
            raise HexapodError(
                f"{printable(topic)!r} is not a valid topic name: {str(error).partition(', at ')[0]}"
            ) from error
        self.intervals = MessageIntervals()
        end = time.monotonic() + DISCOVERY_TIME
        while not (publishers := node.get_publishers_info_by_topic(self.topic)):
            if time.monotonic() >= end:
                known = published_topics(node)
                close = get_close_matches(self.topic, known, n=3)
                listed = f"published are: {', '.join(known) or 'none'}"
                listed = f"did you mean {' or '.join(close)}?" if close else listed
                problem = f"no node publishes {self.topic} in this ROS domain (waited {DISCOVERY_TIME:g} s)"
                raise HexapodError(f"{problem}; {listed}")
            spin_once(0.05)
        name = str(publishers[0].topic_type)
        package, _, kind = name.partition("/msg/")
        try:
            self._kind: type = getattr(importlib.import_module(f"{package}.msg"), kind)
        except (ImportError, AttributeError) as error:
            text = f"messages of type {name} cannot be read: {package} is not installed here"
            raise HexapodError(text) from error
        # A reliable subscriber receives only from reliable publishers, a latched subscriber only from latched ones.
        offered = [info.qos_profile for info in publishers]
        reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
        latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
        qos = profile(QUEUE, reliable, latched)
        node.create_subscription(self._kind, self.topic, self._on_message, qos, raw=True)

    def _on_message(self, data: bytes) -> None:
        came, now = time.monotonic(), self._node.get_clock().now().nanoseconds
        self.intervals.add(came)
        stamp = 0
        try:
            message = read_message(data, self._kind)
            rows = message_fields(self.topic, message)
            stamp = nanoseconds_of(message.header.stamp) if hasattr(message, "header") else 0
        except CommandError as error:
            rows = [MessageField("problem", str(error))]
        seconds, age = (stamp * 1e-9, (now - stamp) * 1e-9) if stamp else (math.nan, math.nan)
        self._receive(EchoedMessage(self.topic, rows, seconds, age, self.intervals.recent_rate))


class MessageIntervals:
    """Statistics of a topic: number of messages, rates in Hz, shortest and longest time in s between two messages."""

    def __init__(self) -> None:
        self.count = 0
        self.shortest, self.longest = math.inf, 0.0
        self._first = math.nan
        self._recent: deque[float] = deque()

    def add(self, time: float) -> None:
        if self.count:
            apart = time - self._recent[-1]
            self.shortest, self.longest = min(self.shortest, apart), max(self.longest, apart)
        else:
            self._first = time
        self.count += 1
        self._recent.append(time)
        while time - self._recent[0] > RATE_WINDOW:
            self._recent.popleft()

    @property
    def rate(self) -> float:
        """Mean rate of all messages, Hz; NaN for fewer than two messages."""
        return _rate(self.count, self._recent[-1] - self._first) if self.count else math.nan

    @property
    def recent_rate(self) -> float:
        """Mean rate of the messages within the last :data:`RATE_WINDOW`, Hz; NaN for fewer than two messages."""
        return _rate(len(self._recent), self._recent[-1] - self._recent[0]) if self.count else math.nan

    def text(self) -> str:
        """Return the number of messages, their mean rate, and the shortest and longest time between two, as text."""
        if self.count < 2:
            return f"messages: {self.count}"
        between = f"{self.shortest * 1e3:.1f} to {self.longest * 1e3:.1f} ms apart"
        return f"messages: {self.count}, {self.rate:.2f} Hz, {between}"

    def record(self) -> dict[str, Any]:
        apart = {"shortest_ms": self.shortest * 1e3, "longest_ms": self.longest * 1e3}
        return {"messages": self.count, "rate_hz": self.rate, **(apart if self.count > 1 else {})}


def _rate(count: int, span: float) -> float:
    return (count - 1) / span if span > 0.0 else math.nan


def published_topics(node: Node) -> dict[str, str]:
    """Return a dictionary with the name of each published topic and its type, sorted by name."""
    topics = sorted(node.get_topic_names_and_types())
    return {name: kinds[0] for name, kinds in topics if node.count_publishers(name)}
