"""Stories of a node: its inputs and the expected outputs, step by step, as rows of a table.

A story is a list of steps, each called with the rig. Places are millimetres from the paper machine's home; its struts
may change by 2 mm per command and by 250 mm/s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from node_helpers import HOME, RELIABLE, Rig, Stranger, closed_form_lengths, near
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import ERROR, OK, WARN
from hexapod_comp.ros.messages import pose_message

__all__ = ["ERROR", "OK", "WARN"]

Step = Callable[[Rig], object]

NEVER = {"start_without_feedback_after": 0.0}
"""The node's default, which the rig changes: a start waits for the struts."""

FED = {"command_timeout": 0.0, "feedback_timeout": 60.0}
"""Parameters with which neither commands nor readings become too old."""


def place(x: float = 0.0, y: float = 0.0, z: float = 0.0, tilt: float = 0.0) -> Pose:
    """Return the pose so many mm from home, tilted about x, degrees."""
    return near(HOME, (x * 1e-3, y * 1e-3, z * 1e-3), tilt)


def play(rig: Rig, steps: Iterable[Step]) -> None:
    for step in steps:
        step(rig)


# ---- inputs ----


def ask(x: float = 0.0, y: float = 0.0, z: float = 0.0, tilt: float = 0.0, frame: str = "base") -> Step:
    """Send a command, and wait for its answer."""
    return lambda rig: rig.ask(place(x, y, z, tilt), frame)


def send(
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    tilt: float = 0.0,
    frame: str = "base",
    later: float | None = 0.0,
    **fields: Any,
) -> Step:
    """Send a command stamped `later` s from now (None: without a stamp); `fields`: ``y_m``, m, ``q``."""

    def step(rig: Rig) -> None:
        message = pose_message(place(x, y, z, tilt), frame)
        if later is not None:
            message.header.stamp = rig.stamp(later)
        for name, value in fields.items():
            if name == "q":
                orientation = message.pose.orientation
                orientation.x, orientation.y, orientation.z, orientation.w = value
            else:
                setattr(message.pose.position, name.removesuffix("_m"), value)
        rig.send(message)
        rig.barrier()

    return step


def lengths_at(rig: Rig, z: float | None, off: dict[int, float] | None) -> np.ndarray:
    """Return the strut lengths at a height above home, or the last commands (None); `off`: change of a strut, m."""
    told = rig.seen["strut_commands"][-1].position if z is None else closed_form_lengths(place(z=z))
    lengths = np.array(told)
    for strut, way in (off or {}).items():
        lengths[strut - 1] += way
    return lengths


def feed(
    z: float | None = None,
    off: dict[int, float] | None = None,
    later: float = 0.0,
    names: tuple[str, ...] = STRUT_NAMES,
) -> Step:
    """Publish measured struts; arguments as of :func:`lengths_at`."""

    def step(rig: Rig) -> None:
        rig.feed(lengths_at(rig, z, off), tuple(names), later)
        rig.barrier()

    return step


def tell(z: float | None = 0.0, off: dict[int, float] | None = None, later: float | None = None) -> Step:
    """Send strut commands to a drive, arguments as of :func:`lengths_at`; `later`: stamp from now, s (None: none)."""

    def step(rig: Rig) -> None:
        message = JointState(name=list(STRUT_NAMES), position=lengths_at(rig, z, off).tolist(), velocity=[0.0] * 6)
        if later is not None:
            message.header.stamp = rig.stamp(later)
        rig.publish("strut_commands", message)
        rig.barrier()

    return step


def warm(part: str, temperature: float) -> Step:
    return lambda rig: rig.warm(part, temperature)


def moisten(humidity: float) -> Step:
    return lambda rig: rig.publish_humidity(humidity)


KINDS = {
    "tool_pose_command": type(pose_message(HOME, "")),
    "strut_states": JointState,
    "strut_commands": JointState,
    "temperatures": Temperature,
    "select_tool": String,
}


def joins(topic: str, name: str = "stranger") -> Step:
    """Let a second node, or one with the witness's name, publish on a topic too."""

    def step(rig: Rig) -> None:
        rig.other = Stranger(rig, name).create_publisher(KINDS[topic], topic, RELIABLE)  # type: ignore[attr-defined]

    return step


def other(message: Callable[[Rig], Any]) -> Step:
    """Let the second node publish a message."""
    return lambda rig: rig.other.publish(message(rig))  # type: ignore[attr-defined]


def leaves(rig: Rig) -> None:
    """Destroy the second node."""
    rig.other.close()  # type: ignore[attr-defined]


def poses(z: float = 0.0) -> Callable[[Rig], Any]:
    return lambda rig: pose_message(place(z=z), "base")


def struts(z: float = 0.0) -> Callable[[Rig], Any]:
    return lambda rig: JointState(name=list(STRUT_NAMES), position=closed_form_lengths(place(z=z)).tolist())


# ---- actions ----


def change(*transitions: str, node: str = "compensator") -> Step:
    """Request lifecycle transitions, which must all succeed."""

    def step(rig: Rig) -> None:
        assert all(rig.change(transition, node) for transition in transitions)

    return step


def reset(rig: Rig) -> None:
    """Call ``~/reset`` until it succeeds, that is, until the machine stands."""
    rig.until(lambda: rig.trigger("reset").success, "the machine to stand")


def setting(name: str, value: object, node: str = "compensator") -> Step:
    """Set a parameter, which must succeed."""

    def step(rig: Rig) -> None:
        answer = rig.set_parameter(node, name, value)
        assert answer.successful, answer.reason

    return step


def passes(seconds: float) -> Step:
    return lambda rig: rig.step(seconds)


# ---- outputs ----


def says(level: bytes, text: str, node: str = "compensator", log: str = "", end: str = "", **values: str) -> Step:
    """Wait for a status whose message begins with `text` and whose values equal (texts: contain) the given ones."""

    def step(rig: Rig) -> None:
        found = rig.until_status(level, text, node)
        for key, value in values.items():
            shown = found[key.replace("__", ".")]
            assert shown == value or (value in shown and not value.isdigit()), f"{key}: {shown!r}, not {value!r}"
        assert rig.message(node).endswith(end)
        assert not log or rig.logged(log)

    return step


def shows(node: str = "compensator", **values: str) -> Step:
    """Wait until the diagnostics have these values."""
    wanted = {key.replace("__", "."): value for key, value in values.items()}
    return lambda rig: rig.until(lambda: wanted.items() <= rig.values(node).items(), f"{wanted}")


def refuses(reason: str, text: str = "", **values: str) -> Step:
    """Wait for the status of a refused command with a reason, whose text contains `text`."""
    return says(ERROR, f"refusing commands: {reason}", last_refusal=text, **values)


def seen(**counts: int) -> Step:
    """Check the number of messages on topics."""

    def step(rig: Rig) -> None:
        assert {topic: len(rig.seen[topic]) for topic in counts} == counts

    return step


def holds(condition: Callable[[Rig], bool], what: str) -> Step:
    """Check a condition."""

    def step(rig: Rig) -> None:
        assert condition(rig), what

    return step
