"""The mover: straight, within the struts' limits, and honest about how a move ended.

Truth: what the compensator is sent, differentiated here; targets by closed form; the drive's true tool.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, Quaternion, Transform, Vector3
from node_helpers import HOME, Bench, Rig, Voice, closed_form_lengths, near
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.pose import Pose
from hexapod_comp.ros.client import Machine, MoveError
from hexapod_comp.ros.messages import message_pose, nanoseconds_of, pose_message
from hexapod_comp.ros.mover import MoverNode

RATE = 250.0
"""Tool poses sent per second, the mover's default."""

KINDS = {"move_to": PoseStamped, "move_by": PoseStamped, "pivot": PointStamped, "program": MultiDOFJointTrajectory}


class Moved:
    """A simulated machine with a mover, and who asks it for moves."""

    def __init__(self, rig: Rig, geometry: str = "paper.yaml", **parameters: object) -> None:
        rig.remove_publisher("tool_pose_command")
        self.rig, self.states, self.sent, self.geometry = rig, list[Any](), list[Any](), load_geometry(geometry)
        rig.listeners += [("/mover/state", self.states.append), ("/tool_pose_command", self.sent.append)]
        self.node: MoverNode = rig.add(MoverNode, True, dict(parameters))
        rig.drive(geometry_file=geometry, truth_file="random:3")
        rig.compensator(geometry_file=geometry, model_file="ideal")
        self.voices = {topic: Voice(rig, topic, kind, "/client") for topic, kind in KINDS.items()}
        rig.step(0.2)

    def ask(self, topic: str, message: Any, frame_id: str = "base") -> int:
        if isinstance(message, Pose):
            message = pose_message(message, frame_id)
        message.header.stamp = self.rig.now()
        self.voices[topic].publish(message)
        return nanoseconds_of(message.header.stamp)

    def value(self, key: str) -> str:
        return {entry.key: entry.value for entry in self.states[-1].values}[key]

    def ended(self, timeout: float = 30.0) -> str:
        self.rig.until(lambda: self.value("state") in ("arrived", "stopped"), "the end of the move", timeout)
        return self.value("state")

    def go(self, topic: str, message: Any, frame_id: str = "base") -> str:
        self.ask(topic, message, frame_id)
        return self.ended()

    def shares(self) -> list[float]:
        """Return the largest speed, acceleration and jerk of nominal struts, over what the limits leave the mover."""
        to_platform = self.geometry.tool.inverse()
        struts = np.array([strut_lengths(self.geometry, message_pose(m) @ to_platform) for m in self.sent])
        stamps = np.array([nanoseconds_of(m.header.stamp) for m in self.sent])
        assert np.ptp(np.diff(stamps)) == 0, "stamped with the times for which they were computed"
        limits, share = self.geometry.limits, 0.9
        speed = min(limits.speed, limits.step * RATE)
        acceleration = limits.acceleration or limits.speed / 0.1
        jerk = limits.jerk or acceleration / 0.02
        found = [np.abs(np.diff(struts, n, axis=0)).max() * RATE**n for n in (1, 2, 3)]
        return [f / (share * most) for f, most in zip(found, (speed, acceleration, jerk), strict=True)]

    def estimated(self) -> Pose:
        return message_pose(self.rig.seen["tool_pose_estimate"][-1])


def apart(one: Pose, other: Pose) -> float:
    """Return how far two poses are apart, m, with 0.1 m for a radian."""
    turn = np.linalg.norm(one.rotation - other.rotation) / math.sqrt(2.0)
    return float(np.linalg.norm(one.position - other.position) + 0.1 * turn)


@pytest.fixture
def moved(rig: Rig) -> Moved:
    return Moved(rig)


@pytest.mark.parametrize("geometry", ["paper.yaml", "example_6_6.yaml"])
def test_a_move_goes_straight_within_the_limits_and_arrives(rig: Rig, geometry: str) -> None:
    moved = Moved(rig, geometry)
    start = moved.geometry.work @ moved.geometry.tool_pose(moved.geometry.home)
    target = near(start, (0.02, -0.01, 0.015), 3.0)
    assert moved.go("move_to", target) == "arrived"
    assert moved.value("share") == "1.0000"
    assert rig.values()["refused"] == "0"
    assert max(moved.shares()) <= 1.0 + 1e-3
    assert apart(message_pose(moved.sent[-1]), target) < 1e-12
    assert apart(moved.estimated(), target) < 1e-5, "by the drives' steps, encoders and their lag"
    points = np.array([message_pose(m).position for m in moved.sent])
    way = points[-1] - points[0]
    off = points - points[0] - np.outer((points - points[0]) @ way / (way @ way), way)
    assert np.abs(off).max() < 1e-12
    held = len(moved.sent)
    rig.step(0.1)
    assert len(moved.sent) - held in (24, 25, 26), "it holds the tool there"


def test_relative_moves_in_the_tools_frame_and_in_a_work_frame(moved: Moved) -> None:
    """Up along a tool that is tilted by 10° about x; then turned by 5° about the base's z, the tip where it is."""
    assert moved.go("move_to", near(HOME, tilt_deg=10.0)) == "arrived"
    assert moved.go("move_by", Pose([0.0, 0.0, 0.01], np.eye(3)), "tool") == "arrived"
    raised = near(HOME, (0.0, -0.01 * math.sin(math.radians(10.0)), 0.01 * math.cos(math.radians(10.0))), 10.0)
    assert apart(message_pose(moved.sent[-1]), raised) < 1e-12
    turn = Pose.from_angles([0.0, 0.0, 0.0], [0.0, 0.0, math.radians(5.0)])
    assert moved.go("move_by", turn, "base") == "arrived"
    assert apart(message_pose(moved.sent[-1]), Pose(raised.position, turn.rotation @ raised.rotation)) < 1e-12
    assert moved.rig.values()["refused"] == "0"


def test_the_tool_turns_about_the_pivot(moved: Moved) -> None:
    """A point 50 mm below the tip stays where it is while the tool tilts about it."""
    message = PointStamped()
    message.header.frame_id, message.point.z = "tool", -0.05
    moved.go("move_to", HOME)
    began = len(moved.sent)
    moved.ask("pivot", message)
    turn = near(HOME, tilt_deg=6.0).rotation
    pivot = HOME.position - np.array([0.0, 0.0, 0.05])
    moved.go("move_to", Pose(pivot + turn @ [0.0, 0.0, 0.05], turn))
    points = np.array([(message_pose(m) @ Pose([0.0, 0.0, -0.05], np.eye(3))).position for m in moved.sent[began:]])
    assert np.abs(points - pivot).max() < 1e-12


def test_a_stop_brakes_on_the_way_and_a_new_target_replaces_the_present_one(moved: Moved) -> None:
    moved.go("move_to", HOME)
    first = moved.ask("move_to", near(HOME, (0.0, 0.0, 0.05)))
    moved.rig.step(0.1)
    assert moved.rig.call(Trigger, "mover/stop").message == "braking"
    assert moved.ended() == "stopped"
    assert (moved.value("stopped_by"), moved.value("request")) == ("person", str(first))
    assert moved.states[-1].level == DiagnosticStatus.OK, "who asked for it need not be warned"
    height = message_pose(moved.sent[-1]).position[2]
    assert 0.402 < height < 0.445, "on the way"
    moved.ask("move_to", near(HOME, (0.03, 0.0, 0.0)))
    moved.rig.step(0.2)
    assert moved.go("move_to", near(HOME, (0.0, 0.02, 0.0))) == "arrived"
    assert apart(message_pose(moved.sent[-1]), near(HOME, (0.0, 0.02, 0.0))) < 1e-12
    assert max(moved.shares()) <= 1.0 + 1e-3, "braking included"
    assert moved.rig.values()["refused"] == "0"


def test_a_limit_on_the_way_is_found_before_anything_moves(moved: Moved) -> None:
    moved.go("move_to", HOME)
    assert moved.go("move_to", near(HOME, (0.0, 0.0, 0.6))) == "stopped"
    assert moved.value("stopped_by") == "limit"
    assert "strut" in moved.states[-1].message
    assert "s after the start, at x, y, z" in moved.states[-1].message
    assert {message_pose(m).position[2] for m in moved.sent[-20:]} == {0.4}
    assert moved.rig.values()["refused"] == "0"


def bad_quaternion() -> PoseStamped:
    message = pose_message(HOME, "base")
    message.pose.orientation = Quaternion(w=0.5)
    return message


def program(*rows: tuple[Pose, float], joints: int = 1) -> MultiDOFJointTrajectory:
    """Return a program of poses and times, s."""
    message = MultiDOFJointTrajectory(joint_names=["tool"] * joints)
    message.header.frame_id = "base"
    for pose, seconds in rows:
        point = MultiDOFJointTrajectoryPoint()
        (x, y, z), q = pose.position.tolist(), pose.quaternion().tolist()
        turned = Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
        point.transforms = [Transform(translation=Vector3(x=x, y=y, z=z), rotation=turned)]
        whole = math.floor(seconds)
        point.time_from_start = Duration(sec=whole, nanosec=round((seconds - whole) * 1e9))
        message.points.append(point)
    return message


UP = near(HOME, (0.0, 0.0, 0.01))


BAD_REQUESTS = [
    ("move_to", pose_message(HOME, "elsewhere"), "frame_id must be one of base, work, not 'elsewhere'"),
    ("move_by", pose_message(HOME, ""), "frame_id must be one of base, work, tool, not ''"),
    ("move_to", pose_message(HOME, "base"), "finite"),
    ("move_to", bad_quaternion(), "quaternion"),
    ("program", program((HOME, 0.0)), "at least 2 points, not 1 and 1"),
    ("program", program((HOME, 0.0), (UP, 1.0), joints=2), "names one joint"),
    ("program", program((HOME, 1.0), (UP, 1.0)), "must be later than 1 s, that of the point before, not 1 s"),
]
BAD_REQUESTS[2][1].pose.position.x = math.nan


def test_bad_requests_are_refused_and_the_present_move_goes_on(moved: Moved) -> None:
    moved.go("move_to", HOME)
    good = moved.ask("move_to", near(HOME, (0.0, 0.0, 0.03)))
    for topic, message, text in BAD_REQUESTS:
        moved.rig.step(0.02)
        bad = moved.ask(topic, message)
        assert text in moved.value("refusal")
        assert moved.value("refused_request") == str(bad)
    assert moved.ended() == "arrived"
    assert moved.value("request") == str(good)
    assert apart(message_pose(moved.sent[-1]), near(HOME, (0.0, 0.0, 0.03))) < 1e-12


def test_a_program_slows_down_where_a_strut_would_be_too_fast_and_is_never_ahead(moved: Moved) -> None:
    """Up slowly, then 40 mm sideways within 30 ms, which no strut can; then slowly again."""
    moved.go("move_to", HOME)
    began = len(moved.sent)
    side = near(HOME, (0.04, 0.0, 0.01))
    rows = [(HOME, 0.0), (UP, 1.0), (side, 1.03), (near(HOME, (0.04, 0.0, 0.0)), 2.0)]
    assert moved.go("program", program(*rows)) == "arrived"
    assert moved.rig.values()["refused"] == "0"
    assert max(moved.shares()) <= 1.0 + 1e-3
    points = np.array([message_pose(m).position for m in moved.sent[began:]])
    for pose, earliest in rows:
        nearest = int(np.linalg.norm(points - pose.position, axis=1).argmin())
        assert np.linalg.norm(points[nearest] - pose.position) < 1e-3, "within what it goes in a period"
        assert nearest / RATE >= earliest - 1e-9


@pytest.mark.parametrize("stall", [0.3, 1.0])
def test_a_move_goes_on_when_a_busy_computer_has_held_it_up(moved: Moved, stall: float, monkeypatch) -> None:
    """The compensator gets nothing for a while, then all at once; what had grown too old by then is refused."""
    moved.go("move_to", HOME)
    asked = moved.ask("move_to", near(HOME, (0.0, 0.0, 0.05)))
    moved.rig.step(0.1)
    deliver, late = moved.rig.route, list[Any]()

    def hold_up(topic: str, data: bytes, number: int | None) -> None:
        if topic == "/tool_pose_command":
            late.append((topic, data, number))
        else:
            deliver(topic, data, number)

    monkeypatch.setattr(moved.rig, "route", hold_up)
    moved.rig.step(stall)
    monkeypatch.setattr(moved.rig, "route", deliver)
    for held_up in late:
        deliver(*held_up)
    assert moved.ended() == "arrived"
    assert moved.value("request") == str(asked)
    assert len(late) <= 45 * math.ceil(stall / 0.4), "the path waited"
    assert apart(message_pose(moved.sent[-1]), near(HOME, (0.0, 0.0, 0.05))) < 1e-12
    told = np.array([message.position for message in moved.rig.seen["strut_commands"]])
    assert np.abs(np.diff(told, axis=0)).max() < 2e-3, "nothing steps"


def test_a_machine_that_does_not_follow_ends_the_move(moved: Moved) -> None:
    moved.go("move_to", HOME)
    moved.ask("move_to", near(HOME, (0.0, 0.0, 0.05)))
    moved.rig.step(0.1)
    moved.rig.fault("jump", 0.01)
    assert moved.ended() == "stopped"
    assert moved.value("stopped_by") == "following error"
    sent = len(moved.sent)
    moved.rig.step(0.5)
    assert len(moved.sent) == sent, "nothing more is sent"


def test_a_tool_that_does_not_settle_is_reported(rig: Rig) -> None:
    moved = Moved(rig, position_tolerance=1e-9, settling_timeout=0.5)
    assert moved.go("move_to", near(HOME, (0.0, 0.0, 0.005))) == "stopped"
    assert moved.value("stopped_by") == "settling"
    assert "from the target after 0.5 s, allowed 0.001 µm" in moved.states[-1].message


def test_a_client_moves_a_machine_and_learns_how_it_ended(bench: Bench) -> None:
    """Over DDS: what is latched reaches who comes late; a move that cannot be is an error with a reason."""
    from threading import Thread  # the bench's nodes run while the client waits

    bench.machine()
    bench.add(MoverNode, True, {})
    ended: list[Any] = []

    def client() -> None:
        with Machine() as machine:
            ended.append(machine.move(near(HOME, (0.0, 0.0, 0.01)), "base"))
            try:
                machine.move(near(HOME, (0.0, 0.0, 0.6)), "base")
            except MoveError as error:
                ended.append(error)

    thread = Thread(target=client)
    thread.start()
    bench.until(lambda: not thread.is_alive(), "two moves", timeout=60.0)
    assert ended[0].state == "arrived"
    assert ended[1].reason == "limit"
    told = np.array(bench.seen["strut_commands"][-1].position)
    assert np.abs(told - closed_form_lengths(near(HOME, (0.0, 0.0, 0.01)))).max() < 1e-9, "the model is ideal"
