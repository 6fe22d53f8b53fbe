"""The mover and its clients: moves are straight and within the struts' limits, and their results are reported.

The truth is the poses sent to the compensator, differentiated here, closed-form targets, the drive's true tool, and
measure() with the drive's hidden errors. A client in lock-step talks to a stand-in that refuses like the
compensator."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from threading import Thread
from time import sleep
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, Quaternion, Transform, Vector3, Vector3Stamped
from node_helpers import HOME, Bench, Messages, Rig, Voice, closed_form_lengths, geometry_file, model_file, near
from rclpy.parameter import Parameter
from rclpy.time import Time
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from hexapod_comp.cli.app import make_parser
from hexapod_comp.compensation.journal import LARGEST_SOURCE
from hexapod_comp.errors import CommandError, NoAnswerError
from hexapod_comp.formats.adapt_journal import sole_user
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine import trajectory
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.pose import Pose, rotation_angle
from hexapod_comp.ros import client as clients
from hexapod_comp.ros import collector, mover
from hexapod_comp.ros.adapter import AdapterNode
from hexapod_comp.ros.base import ERROR, OK, WARN
from hexapod_comp.ros.client import LoopClient, Machine, MoveError, MoveState, Sent
from hexapod_comp.ros.collector import AdaptedMachine, WatchedMachine
from hexapod_comp.ros.compensator_state import ADVICE, OTHERWISE
from hexapod_comp.ros.instrument import InstrumentNode
from hexapod_comp.ros.messages import message_pose, nanoseconds_of, pose_message
from hexapod_comp.ros.mover import UNDER_WAY, MoverNode
from hexapod_comp.ros.worker import Worker

RATE = 100.0  # tool poses sent and struts read per second: few for short tests, and so that steps limit the speed

TOPICS = {"move_to": PoseStamped, "move_by": PoseStamped, "pivot": PointStamped, "program": MultiDOFJointTrajectory}


class Moved:
    """A simulated machine with a mover, and methods that request moves."""

    def __init__(self, rig: Rig, geometry: str = "paper.yaml", model: str = "ideal", **parameters: object) -> None:
        rig.remove_publisher("tool_pose_command")
        self.rig, self.states, self.sent, self.geometry = rig, Messages(), Messages(), load_geometry(geometry)
        rig.listeners += [("/mover/state", self.states), ("/tool_pose_command", self.sent)]
        self.node: MoverNode = rig.add(MoverNode, True, {"rate": RATE, **parameters})
        rig.drive(geometry_file=geometry, truth_file="random:3", rate=RATE)
        rig.compensator(geometry_file=geometry, model_file=model)
        self.voices = {topic: Voice(rig, topic, kind, "/client") for topic, kind in TOPICS.items()}
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
        """Return the largest speed, acceleration and jerk of nominal struts, over the mover's share of the limits."""
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
    """Return the distance of two poses, m, with 0.1 m for a radian."""
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
    asked = moved.ask("move_to", target)
    assert moved.ended() == "arrived"
    states = [{entry.key: entry.value for entry in message.values} for message in moved.states]
    assert [name for name, _ in groupby(states, itemgetter("state"))] == ["idle", *UNDER_WAY, "arrived"]
    last = {"state": "arrived", "ready": "true", "move": "1", "request": str(asked), "share": "1.0000"}
    none = {"time_left_s": "0.000", "stopped_by": "", "refused_request": "0", "refusal": ""}
    frames = {f"frame.{name}": name for name in (*moved.geometry.work_frames, "tool")}
    assert states[-1] == {**last, **none, **frames, "tool": "tool"}
    assert (moved.states[-1].name, moved.states[-1].level) == ("mover: move", OK)
    told = re.fullmatch(r"arrived: arrived, (\d.\d\d) µm and (\d.\d\d) µrad from the target", moved.states[-1].message)
    newest = [message_pose(message) for message in rig.seen["tool_pose_estimate"][-10:]]
    off = [
        (np.linalg.norm(p.position - target.position), rotation_angle(p.rotation.T @ target.rotation)) for p in newest
    ]
    assert told.groups() in [tuple(f"{1e6 * float(one):.2f}" for one in both) for both in off]
    way = [(float(state["share"]), float(state["time_left_s"])) for state in states if state["state"] == "moving"]
    done, left = np.array(way).T
    np.testing.assert_allclose(done, 1.0 - left / left[0], atol=0.02)  # to a period of 10 ms
    np.testing.assert_allclose(np.diff(left[1:]), -0.1, atol=0.051)  # published every 0.1 s, checked every 0.05 s
    assert rig.values()["refused"] == "0"
    assert max(moved.shares()) <= 1.0 + 1e-3
    assert apart(message_pose(moved.sent[-1]), target) < 1e-12
    assert apart(moved.estimated(), target) < 1e-5, "by the drives' steps, encoders and their lag"
    points = np.array([message_pose(m).position for m in moved.sent])
    line = points[-1] - points[0]
    off = points - points[0] - np.outer((points - points[0]) @ line / (line @ line), line)
    assert np.abs(off).max() < 1e-12
    held = len(moved.sent)
    rig.step(0.1)
    assert len(moved.sent) - held in (9, 10, 11), "it holds the tool there"
    count = len(moved.states)
    rig.step(0.95)
    assert len(moved.states) == count + 1, "one a second"


def test_a_model_too_long_for_the_files_message_is_read_from_its_folder(rig: Rig, tmp_path: Path) -> None:
    """Self-calibration makes models of 500 kB; another file in its place is refused, since its hash differs."""
    path = tmp_path / "long.yaml"
    path.write_text(f"{config_file('paper_machine.yaml', 'model').read_text()}# {LARGEST_SOURCE * 'x'}\n")
    moved = Moved(rig, model=str(path))
    assert moved.go("move_to", near(HOME, (0.01, 0.0, 0.0))) == "arrived"
    path.write_text(f"{path.read_text()}#\n")
    moved.node._worker.close()  # a new worker process reads the file again
    moved.node._worker = Worker()
    assert moved.go("move_to", HOME) == "stopped"
    assert moved.value("stopped_by") == "planning"
    assert "has changed since it was loaded" in moved.states[-1].message


def test_relative_moves_in_the_tools_frame_and_in_a_work_frame(moved: Moved) -> None:
    """The tool moves along its axis, tilted by 10° about x; then it turns by 5° about base z about its tip."""
    assert moved.go("move_to", near(HOME, tilt_deg=10.0)) == "arrived"
    assert moved.go("move_by", Pose([0.0, 0.0, 0.01], np.eye(3)), "tool") == "arrived"
    raised = near(HOME, (0.0, -0.01 * math.sin(math.radians(10.0)), 0.01 * math.cos(math.radians(10.0))), 10.0)
    assert apart(message_pose(moved.sent[-1]), raised) < 1e-12
    turn = Pose.from_angles([0.0, 0.0, 0.0], [0.0, 0.0, math.radians(5.0)])
    assert moved.go("move_by", turn, "base") == "arrived"
    assert apart(message_pose(moved.sent[-1]), Pose(raised.position, turn.rotation @ raised.rotation)) < 1e-12
    assert moved.rig.values()["refused"] == "0"


def test_the_tool_turns_about_the_pivot(moved: Moved) -> None:
    """A point 50 mm below the tip stays at its place while the tool tilts about it."""
    message = PointStamped()
    message.header.frame_id, message.point.z = "tool", -0.05
    moved.go("move_to", HOME)
    began = len(moved.sent)
    message.header.frame_id = "base"
    moved.ask("pivot", message)
    refused = moved.ask("move_to", HOME)
    assert moved.value("refused_request") == str(refused), "the client's move raises the refusal"
    assert "the newest pivot point was refused: must be finite and in tool, not [" in moved.value("refusal")
    message.header.frame_id = "tool"
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


def test_a_limit_is_found_before_anything_moves(moved: Moved) -> None:
    """A target in mm has strut lengths of 400 m; between two equal poses a spline is higher than both."""
    moved.go("move_to", HOME)
    began = len(moved.sent)
    assert moved.go("move_to", near(HOME, (0.0, 0.0, 399.6))) == "stopped"
    assert (moved.value("stopped_by"), moved.states[-1].level) == ("limit", ERROR)
    lengths = closed_form_lengths(near(HOME, (0.0, 0.0, 399.6)))
    told = f": strut_1: nominal length {1e3 * lengths[0]:.4f} mm is outside the stroke"
    assert told in moved.states[-1].message, "the first of six"
    assert moved.states[-1].message.endswith("target 1 of 1, at x, y, z 0.000, 0.000, 400000.000 mm in base")
    longest = moved.geometry.limits.stroke[:, 1].max()
    across = (closed_form_lengths(HOME) ** 2 - HOME.position[2] ** 2).max()
    highest = near(HOME, (0.0, 0.0, math.sqrt(longest**2 - across) - HOME.position[2] - 1e-3))
    assert moved.go("program", program((HOME, 0.0), (highest, 20.0), (highest, 40.0))) == "stopped"
    assert "s after the start of a move with limit_share 0.9, at x, y, z" in moved.states[-1].message
    assert {message_pose(m).position[2] for m in moved.sent[began:]} == {0.4}
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
    ("program", program((HOME, 0.0), (UP, 1.0), joints=2), "must have one joint"),
    ("program", program((HOME, 1.0), (UP, 1.0)), "must be above 1 s, the time of points[0], not 1 s"),
    ("program", program((HOME, 0.0), (UP, 1.0)), "points[1] must have 1 transform, not 2"),
]
BAD_REQUESTS[2][1].pose.position.x = math.nan
BAD_REQUESTS[-1][1].points[1].transforms *= 2


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
    assert moved.node._worker._idle_after == 600.0, "the next move need not wait for a new process"
    moved.node.trigger_deactivate()
    moved.ask("move_to", HOME)
    assert "the mover is not active" in moved.value("refusal")


def test_a_program_slows_down_where_a_strut_would_be_too_fast_and_is_never_ahead(moved: Moved) -> None:
    """The program moves slowly up, then 40 mm sideways within 30 ms, too fast for the struts, then slowly again."""
    moved.go("move_to", HOME)
    began = len(moved.sent)
    side = near(HOME, (0.04, 0.0, 0.01))
    rows = [(HOME, 0.0), (UP, 1.0), (side, 1.03), (near(HOME, (0.04, 0.0, 0.0)), 2.0)]
    assert moved.go("program", program(*rows)) == "arrived"
    assert moved.rig.values()["refused"] == "0"
    assert max(moved.shares()) <= 1.0 + 1e-3
    points = np.array([message_pose(m).position for m in moved.sent[began:]])
    steps = np.diff(points, axis=0)
    for pose, earliest in rows:
        shares = ((pose.position - points[:-1]) * steps).sum(axis=1) / np.maximum((steps**2).sum(axis=1), 1e-30)
        shares = shares.clip(0.0, 1.0)
        away = np.linalg.norm(points[:-1] + shares[:, None] * steps - pose.position, axis=1)
        nearest = int(away.argmin())
        assert away[nearest] < 1e-4, "between two poses the path bends by a·t²/8, 30 µm at 2.5 m/s²"
        assert (nearest + shares[nearest]) / RATE >= earliest - 1e-9


def test_delays_of_its_process_change_no_stamp_and_end_no_program(rig: Rig) -> None:
    """A machine with a limit of acceleration would refuse poses whose stamps skip the time that the process lost."""
    moved = Moved(rig, "example_6_6.yaml")
    start = moved.geometry.work @ moved.geometry.tool_pose(moved.geometry.home)
    far = near(start, (0.06, 0.03, 0.0))
    moved.ask("program", program((start, 0.0), (far, 0.1), (start, 0.2)))
    for delay in (0.006, 0.01, 0.03, 0.006, 0.02):
        rig.step(0.08)
        rig.clock.passed += round(delay * 1e9)
    assert moved.ended() == "arrived"
    assert max(moved.shares()) <= 1.0 + 1e-3
    assert rig.values()["refused"] == "0"


ENDS = [
    ("planning", "stop", "person", "stopped before the tool moved"),
    ("settling", "stop", "person", "stopped while the tool was settling"),
    ("settling", "tool", "refusal", "the tool was changed to 'probe' during the move"),
    ("moving", "deactivate", "deactivated", "the node was deactivated during the move"),
    ("moving", "end", "shut down", "the node ended during the move"),
    ("moving", "jump", "following error", ""),
]


@pytest.mark.parametrize(("state", "end", "by", "text"), ENDS)
def test_the_state_names_what_has_ended_a_move(
    rig: Rig, tmp_path: Path, state: str, end: str, by: str, text: str
) -> None:
    geometry = geometry_file(tmp_path, tools={"probe": {"position_mm": [0.0, 0.0, 50.0]}})
    moved = Moved(rig, geometry, settling_time=60.0, settling_timeout=3600.0)
    assert rig.call(Trigger, "mover/stop").message == "the tool was not moving"
    asked = moved.ask("move_to", near(HOME, (0.0, 0.0, 0.005)))
    rig.until(lambda: moved.value("state") == state, state)
    rig.step(0.3 if state == "settling" else 0.0)
    if end == "stop":
        assert rig.call(Trigger, "mover/stop").message == "the tool was not moving"
    elif end == "tool":
        assert rig.set_parameter("compensator", "tool", "probe").successful
        rig.step(0.1)
    elif end == "jump":
        rig.fault("jump", 0.01)
        moved.ended()
    else:
        moved.node.trigger_deactivate() if end == "deactivate" else moved.node.publish_last_status()
    assert [moved.value(key) for key in ("state", "stopped_by", "request")] == ["stopped", by, str(asked)]
    assert moved.states[-1].message == f"stopped: {text}" or not text
    sent = len(moved.sent)
    rig.step(0.1)
    assert (rig.message("mover") == "not active") is (end in ("deactivate", "end"))
    assert (len(moved.sent) > sent) is (state == "settling"), "it holds the tool there"


def test_another_tool_is_held_where_the_struts_are_and_its_weight_ramps_in(rig: Rig, tmp_path: Path) -> None:
    """A tool of 100 kg on struts of 1 N/µm, in the closed form of a symmetric machine; then another move."""
    tool = {
        "position_mm": [10.0, 0.0, 50.0],
        "rotation_deg": [10.0, 0.0, 30.0],
        "mass_kg": 100.0,
        "centre_mm": [0, 0, 0],
    }
    model = model_file(tmp_path, load={"stiffness_N_per_um": 1.0, "mass_kg": 0.0})
    moved = Moved(rig, geometry_file(tmp_path, tools={"probe": tool}), model, position_tolerance=1e-3)
    assert moved.go("move_to", HOME) == "arrived"
    assert rig.set_parameter("compensator", "tool", "probe").successful
    stretch = 100.0 * 9.80665 / 6.0 * closed_form_lengths(HOME) / HOME.position[2] / 1e6  # m, of struts that push
    rig.until(lambda: bool(np.allclose(rig.seen["strut_corrections"][-1].position, stretch, atol=1e-12)), "the weight")
    tip = Pose.from_angles([0.01, 0.0, 0.05], np.radians([10.0, 0.0, 30.0]))
    assert apart(message_pose(moved.sent[-1]), HOME @ tip) < 1e-12
    assert moved.go("move_to", HOME @ tip @ Pose([0.0, 0.0, 1e-3], np.eye(3))) == "arrived"


def test_a_move_that_replaces_another_is_refused_if_the_tools_pose_is_lost_during_planning(moved: Moved) -> None:
    """Before the first command the start is the estimate; without the refusal the node would plan without end."""
    worker = moved.node._worker
    poll, worker.poll = worker.poll, lambda now: None
    moved.ask("move_to", near(HOME, (0.01, 0.0, 0.0)))
    second = moved.ask("move_to", near(HOME, (0.02, 0.0, 0.0)))
    assert moved.rig.change("deactivate")
    moved.rig.step(1.2)
    worker.poll = poll
    assert moved.ended() == "stopped"
    assert moved.value("stopped_by") == "planning"
    assert moved.value("refused_request") == str(second)
    assert "the tool's pose is not known" in moved.value("refusal")
    assert moved.rig.values("mover")["callback_errors"] == "0"
    assert moved.rig.change("activate")
    moved.rig.step(0.1)
    assert moved.go("move_to", near(HOME, (0.01, 0.0, 0.0))) == "arrived"


def test_a_mover_that_does_not_know_its_machine_or_its_tools_pose_refuses_requests(rig: Rig) -> None:
    """Without readings and commands a compensator publishes no estimate; an estimate is used for 1 s."""
    rig.remove_publisher("tool_pose_command")
    states = list[Any]()
    rig.listeners.append(("/mover/state", states.append))
    node = rig.add(MoverNode, True, {})
    move_to, pivot = (Voice(rig, topic, TOPICS[topic], "/client") for topic in ("move_to", "pivot"))

    def refusal() -> str:
        move_to.publish(pose_message(HOME, "base"))
        return {entry.key: entry.value for entry in states[-1].values}["refusal"]

    assert refusal() == "the compensator has not yet published its machine on ~/files"
    rig.until(lambda: rig.message("mover") == "waiting for compensator/files", "the status")
    rig.compensator()
    rig.step(0.1)
    late = "the tool's pose is not known: no tool_pose_estimate for 1 s"
    assert refusal() == late
    for seconds, ready in ((0.95, True), (0.1, False)):
        if ready:
            rig.feed(closed_form_lengths(HOME))
        rig.step(seconds)
        assert node._ready() is ready
    assert refusal() == late
    message = PointStamped()
    message.header.frame_id = "base"
    pivot.publish(message)
    assert rig.logged("pivot refused, and with it all moves: must be finite and in tool, not [0. 0. 0.] in 'base'")


@pytest.mark.parametrize("stall", [0.3, 0.45, 0.55, 1.0])
def test_a_move_goes_on_when_a_busy_computer_has_held_it_up(moved: Moved, stall: float, monkeypatch) -> None:
    """The compensator gets no command for a while and then all at once; commands that are too old are refused."""
    moved.go("move_to", HOME)
    asked = moved.ask("move_to", near(HOME, (0.0, 0.0, 0.05)))
    moved.rig.step(0.1)
    sent = len(moved.sent)
    with monkeypatch.context() as behind:
        behind.setattr(moved.node, "_is_behind", lambda: True)
        moved.rig.step(0.05)
    moved.rig.step(0.02)
    assert 1 <= len(moved.sent) - sent <= 4, "the poses of 0.05 s are not sent at once"
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
    assert len(late) <= 18 * math.ceil(stall / 0.6), "the path waited"
    assert apart(message_pose(moved.sent[-1]), near(HOME, (0.0, 0.0, 0.05))) < 1e-12
    told = np.array([message.position for message in moved.rig.seen["strut_commands"]])
    assert np.abs(np.diff(told, axis=0)).max() < 2e-3, "nothing steps"


@pytest.mark.parametrize(
    ("case", "text", "plans"),
    [
        ("moving", "no answer for 0.6 s; compensator: no new command", 6),
        ("standing", "at standstill: no answer for 0.6 s; compensator: no new command", 0),
        ("gone", "at standstill: no node", 0),
    ],
)
def test_commands_that_stay_unanswered_end_the_move_after_five_attempts(
    moved: Moved, monkeypatch: pytest.MonkeyPatch, case: str, text: str, plans: int
) -> None:
    """Each command is given 0.6 s; a compensator that is gone is not waited for. An old refusal is not the reason."""
    (compensator,) = [node for node in moved.rig.nodes if node.get_name() == "compensator"]
    moved.go("move_to", HOME)
    for oldest, seconds in ((1e-6, 0.1), (0.5, 1.5)):
        compensator.set_parameters([Parameter("max_command_age", value=oldest)])
        moved.rig.step(seconds)
    assert "is stamped" in moved.rig.values()["last_refusal"]
    before, began = int(moved.value("move")), moved.rig.clock.monotonic()
    if case == "moving":
        moved.ask("move_to", near(HOME, (0.0, 0.0, 0.05)))
        moved.rig.step(0.1)
    for name in ("strut_drive", "compensator")[: 1 + (case == "gone")]:
        (node,) = [node for node in moved.rig.nodes if node.get_name() == name]
        moved.rig.nodes.remove(node)
        node.destroy_node()
    deliver = moved.rig.route
    monkeypatch.setattr(moved.rig, "route", lambda topic, *rest: "command" in topic or deliver(topic, *rest))
    moved.rig.until(lambda: moved.value("state") == "stopped", "the end")
    took = moved.rig.clock.monotonic() - began
    assert took == pytest.approx(0.65 if case == "gone" else 3.9, abs=0.1 if case == "gone" else 0.4)
    assert (moved.value("stopped_by"), int(moved.value("move")) - before) == ("refusal", plans)
    assert moved.states[-1].message.startswith(f"stopped: {text}")
    sent = len(moved.sent)
    moved.rig.step(0.5)
    assert len(moved.sent) == sent


def test_the_path_waits_for_a_tool_that_is_behind_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 18 mm/s with drives of 20 mm/s that stop for 0.2 s, the tool is 3.6 mm behind; 1.8 mm are the usual 0.1 s."""
    node, now = object.__new__(MoverNode), [100.0]
    monkeypatch.setattr(mover.time, "monotonic", lambda: now[0])
    node._path, node._near_at = object(), now[0]  # type: ignore[assignment]
    node._sent = deque([np.zeros(3), np.array([1.8e-3, 0.0, 0.0])])
    node._held = Pose(node._sent[-1], np.eye(3))

    def behind(distance: float, age: float = 0.0) -> bool:
        node._estimate = Pose([1.8e-3 - distance, 0.0, 0.0], np.eye(3)), now[0] - age
        return node._is_behind()

    assert [behind(1.8e-3), behind(2.7e-3), behind(2.9e-3), behind(3.6e-3)] == [False, False, True, True]
    assert not behind(3.6e-3, age=1.5), "a stale estimate is none"
    now[0] += 1.9
    assert behind(3.6e-3)
    now[0] += 0.2
    assert not behind(3.6e-3), "a strut that is stuck: the compensator reports it"


def test_a_tool_without_an_estimate_after_its_move_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last estimate is older than the end of the path, so it does not confirm the arrival."""
    node, stopped = object.__new__(MoverNode), list[tuple[str, str]]()
    monkeypatch.setattr(MoverNode, "_stopped", lambda _, by, text: stopped.append((by, text)))
    node.options = {"settling_timeout": 5.0, "position_tolerance": 5e-6, "rotation_tolerance": 2e-5}
    node._compensator_status = {"compensation": "off"}
    node._held, node._estimate, node._ended = HOME, (HOME, 99.0), 100.0
    for now in (101.0, 106.0):
        node._settle(now)
    node._estimate = near(HOME, (0.0, 0.0, 2e-5)), 105.9
    node._settle(106.0)
    far = "20.00 µm, 0.00 µrad from the target after 5 s, allowed 5 µm, 20 µrad; the compensation is off"
    assert stopped == [("settling", "no estimate for 5 s"), ("settling", far)]


def test_a_tool_arrives_when_it_stays_within_the_tolerances(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tolerance of 5 µm and 20 µrad for 0.1 s: a place 6 µm away or 30 µrad turned in between does not count."""
    node, changes = object.__new__(MoverNode), list[tuple[str, ...]]()
    monkeypatch.setattr(MoverNode, "_change", lambda _, *change: changes.append(change))
    node.options = {"settling_timeout": 5.0, "settling_time": 0.1}
    node.options |= {"position_tolerance": 5e-6, "rotation_tolerance": 2e-5}
    node._held, node._ended, node._near_since = HOME, 100.0, math.inf
    for now, off, turned in ((101.0, 4, 10), (101.05, 6, 10), (101.1, 4, 10), (101.15, 4, 30), (101.2, 4, 10)):
        node._estimate = near(HOME, (0.0, 0.0, off * 1e-6), math.degrees(turned * 1e-6)), now
        for later in (0.0, 0.049):
            node._settle(now + later)
    assert changes == []
    node._settle(101.301)
    assert changes == [("arrived", "arrived, 4.00 µm and 10.00 µrad from the target")]


@pytest.mark.parametrize(
    ("states", "ends"),
    [
        ([None] * 100 + [{"state": "planning", "request": 7}, None, {"state": "arrived", "request": 7}], ""),
        ([{"state": "moving"}] * 20 + [{"state": "planning", "request": 7}, {"state": "arrived", "request": 7}], ""),
        ([{}] * 5, "the mover is at standstill and has not received the request"),
        ([{"state": "moving", "request": 7}, {"moves": 0}], "restarted: the mover was restarted"),
        ([{"state": "moving", "request": 7}, {"request": 8}], "replaced: another move was requested"),
        ([{"state": "stopped", "stopped_by": "limit", "text": "too long", "request": 7}], "limit: too long"),
        ([{"refused_request": 7, "refusal": "not active"}], "refused: not active"),
        ([None, "ended"], "the mover has ended"),
        ([{"state": "moving", "request": 7}, None], "the tool had not arrived after 0 s, and was stopped"),
    ],
)
def test_the_movers_own_states_tell_what_has_become_of_a_request(states: list[Any], ends: str) -> None:
    """A list has the state of each spin (None: none); on a busy computer an answer may take a hundred spins."""
    machine, left = object.__new__(Machine), iter(states)
    machine.state = MoveState("idle", "", 1.0, 0.0, "", 0, 0, "", moves=3)
    publishers = [1]

    def spin(_: float) -> None:
        change = next(left)
        if change == "ended":
            publishers[0] = 0
        elif change is not None:
            machine.state = replace(machine.last, **{"state": "arrived", "request": 6, **change})

    clock = SimpleNamespace(now=lambda: Time(nanoseconds=7))
    machine.node = SimpleNamespace(get_clock=lambda: clock, count_publishers=lambda _: publishers[0])  # type: ignore
    machine._to, machine._states = SimpleNamespace(publish=lambda _: None), "/mover/state"  # type: ignore
    machine.catch_up, machine.spin_once, machine.stop = lambda: None, spin, lambda: None  # type: ignore[method-assign]
    if not ends:
        told = list[MoveState]()
        assert machine.move(HOME, progress=told.append).state == "arrived"
        assert [state.state for state in told] == ["planning", "arrived"]
        return
    with pytest.raises((MoveError, NoAnswerError)) as caught:
        machine.move(HOME, timeout=0.0 if "0 s" in ends else 60.0)
    assert str(caught.value) == ends


# ---- a client in lock-step ----


class StandIn(LoopClient):
    """A client whose poses are answered or refused for a reason, as a list determines."""

    def __init__(self, outcomes: list[str]) -> None:
        self._outcomes, self.sent, self.diagnostics = list(outcomes), {}, {"refused": "0", "last_refusal": ""}
        self.poses: list[float] = []

    def _send(self, message) -> Sent:
        self.poses.append(message.pose.position.z)
        self._entry = Sent(0.0, *self._refused(), message)
        self._entry.sent_at = 1e12  # never overdue
        return self._entry

    def spin_once(self, timeout: float) -> None:
        outcome = self._outcomes.pop(0)
        if outcome == "answered":
            self._entry.command[:] = self._entry.correction[:] = 0.0
            return
        count, key = int(self.diagnostics["refused"]) + 1, f"refused.{outcome}"
        self.diagnostics |= {"refused": str(count), key: str(int(self.diagnostics.get(key, "0")) + 1)}
        self.diagnostics |= {"last_refusal": f"it is {outcome}", "what_to_do": ADVICE.get(outcome, OTHERWISE)}


def at(height: float):
    message = pose_message(HOME, "base")
    message.pose.position.z = height
    return message


def test_a_pose_that_came_too_late_is_sent_again_and_another_refusal_ends_it():
    client = StandIn(["answered", "stamp_past", "stamp_past", "answered", "stamp_past", "step"])
    client._newest = {"tool_pose_estimate": pose_message(HOME, "base")}
    path = trajectory.Path(np.outer([0.400, 0.401], [0.0, 0.0, 1.0]), np.tile(np.eye(3), (2, 1, 1)), 1e9)
    counted = list[int]()
    assert [entry.command.tolist() for entry in client.stream(path, counted.append)] == [[0.0] * 6] * 2
    assert counted == [1, 1]
    with pytest.raises(
        NoAnswerError, match=r"a command was refused: it is step; continue from the last answered command"
    ):
        client.wait_for_answer(client._send(at(0.402)))
    assert client.poses == [0.400, 0.401, 0.401, 0.401, 0.402, 0.402]


def test_a_client_raises_a_services_refusal_and_commands_in_the_estimates_frame() -> None:
    client, answer = object.__new__(LoopClient), SimpleNamespace(success=False, message="the stroke of strut 1")
    done = SimpleNamespace(done=lambda: True, result=lambda: answer)
    client._enable = SimpleNamespace(call_async=lambda _: done, srv_name="/left/compensator/enable_compensation")
    with pytest.raises(CommandError, match="/left/compensator/enable_compensation: the stroke of strut 1"):
        client.enable(True)
    client._newest = {"tool_pose_estimate": pose_message(HOME, "left/base")}
    assert client._command(HOME).header.frame_id == "left/base"
    client.node, client._status_name = SimpleNamespace(get_namespace=lambda: "/left"), "left/compensator:"
    status = DiagnosticStatus(name="left/compensator: state", hardware_id="left/paper")
    client._on_diagnostics(DiagnosticArray(status=[status]))
    client.refuse_other("paper")
    with pytest.raises(CommandError, match="run the machine 'left/paper', not 'mine'"):
        client.refuse_other("mine")


CONNECTED = {"commands": 1, "answers": 1, "enable": True, "estimate": ["tool_pose_estimate"], "counts": ["commands"]}


@pytest.mark.parametrize("late", ["", *CONNECTED])
def test_a_client_is_connected_when_the_last_of_its_parts_is(late: str) -> None:
    client, has = object.__new__(LoopClient), CONNECTED | ({late: type(CONNECTED[late])()} if late else {})
    client._publisher = SimpleNamespace(get_subscription_count=lambda: has["commands"])
    client.node = SimpleNamespace(count_publishers=lambda topic: has["answers"] * (topic == "strut_commands"))
    client._enable = SimpleNamespace(service_is_ready=lambda: has["enable"])
    client._newest, client.diagnostics = has["estimate"], has["counts"]
    assert client.connected() == (not late)


# ---- instruments and collect ----


EXACT = {"length_noise": 0.0, "angle_noise": 0.0, "beam_slope": 0.0, "centre_off": 0.0}


class Seen:
    """A rig with an instrument, and the true tool pose that it observes."""

    def __init__(self, rig: Rig, kind: str, **parameters: object) -> None:
        rig.add(InstrumentNode, True, {"kind": kind, **EXACT, **parameters})
        self.rig, self.heard = rig, list[Any]()
        topic = "/instrument/pose" if kind == "tracker" else "/instrument/readings"
        rig.listeners.append((topic, self.heard.append))
        self.tool = Voice(rig, "tool_pose_true", PoseStamped, "/strut_drive")
        self.line = Voice(rig, "instrument_set_up", PoseStamped, "/collect")

    def read(self, *offset: float) -> Any:
        """Return the newest message of the instrument with the tool beside home, m."""
        self.heard.clear()
        for _ in range(5):
            self.tool.publish(pose_message(near(HOME, offset or (0.0, 0.0, 0.0)), "base"))
            self.rig.step(0.02)
        return self.heard[-1]

    def channels(self, *offset: float) -> dict[str, float]:
        message: JointState = self.read(*offset)
        return dict(zip(message.name, message.position, strict=True))


def test_a_laser_counts_from_where_it_was_set_up_and_anew_after_a_broken_beam(rig: Rig) -> None:
    seen = Seen(rig, "laser")

    def says(text: str) -> None:
        def told() -> bool:
            seen.tool.publish(pose_message(near(HOME, (1e-3, 2e-4, 0.0)), "base"))
            return rig.message("instrument") == text

        rig.until(told, text, 5.0)

    says("waiting for instrument_set_up")
    seen.line.publish(pose_message(HOME, "elsewhere"))
    rig.until(lambda: "instrument_set_up ignored: frame_id must be base, not 'elsewhere'" in rig.message("instrument"))
    seen.line.publish(pose_message(HOME, "base"))
    says("reading")
    channels = rig.values("instrument")["channels"]
    assert channels == "linear, straightness_y, straightness_z, rotation_y, rotation_z"
    assert rig.logged(f"set up for {channels}")
    assert rig.logged("instrument_set_up ignored: frame_id must be base")
    seen.line.publish(pose_message(HOME, "base"))
    assert set(seen.channels().values()) == {0.0}
    moved = seen.channels(1e-3, 2e-4, 0.0)
    assert moved["linear"] == pytest.approx(1e-3, abs=1e-12)
    assert moved["straightness_y"] == pytest.approx(2e-4, abs=1e-12)
    assert set(moved) == {"linear", "straightness_y", "straightness_z", "rotation_y", "rotation_z"}
    assert rig.set_parameter("instrument", "fault_break", 3600.0).successful
    assert np.isnan(list(seen.channels(1e-3, 2e-4, 0.0).values())).all()
    says("the beam is broken")
    assert rig.set_parameter("instrument", "fault_break", 0.0).successful
    assert set(seen.channels(1e-3, 2e-4, 0.0).values()) == {0.0}
    assert rig.set_parameter("instrument", "fault_silent", True).successful
    seen.heard.clear()
    rig.step(0.2)
    assert seen.heard == []
    rig.until(lambda: "no tool_pose_true is received" in rig.message("instrument"), "diagnostics", 5.0)


def test_a_ball_bar_has_wild_readings_and_a_tracker_reads_in_its_own_frame(rig: Rig) -> None:
    """In a 3-4-5 triangle a tool 4 mm beside a centre 3 mm away reads 2 mm more. The tracker is 1 m along x of the
    base, turned by 90° about z (the paper's γ): its x is the base's y."""
    seen = Seen(rig, "ball_bar", wild_size=0.5)
    seen.line.publish(pose_message(near(HOME, (0.0, 0.0, -0.003)), "base"))
    assert seen.channels() == {"length": 0.0}
    assert seen.channels(0.004, 0.0, 0.0)["length"] == pytest.approx(0.002, abs=1e-12)
    assert rig.set_parameter("instrument", "wild_share", 1.0).successful
    assert abs(seen.channels(0.004, 0.0, 0.0)["length"]) > 0.49
    seen = Seen(rig, "tracker", stands_at=[1.0, 0.0, 0.0], stands_turned=[0.0, 0.0, np.pi / 2.0], frame_id="tracker")
    message, (x, y, z) = seen.read(0.0, 0.002, 0.0), HOME.position
    assert message.header.frame_id == "tracker"
    assert message_pose(message).position == pytest.approx([y + 0.002, 1.0 - x, z], abs=1e-12)


@pytest.mark.parametrize(
    ("reasons", "ends"), [(["refusal", "restarted"], ""), (["refusal"] * 3, "refusal"), (["limit"], "limit")]
)
def test_a_move_that_a_busy_computer_had_refused_is_asked_for_again(
    reasons: list[str], ends: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, left, waits = object.__new__(WatchedMachine), list(reasons), list[object]()
    machine.state = MoveState("idle", "", 1.0, 0.0, "", 0, 0, "")

    def move(*_: object) -> str:
        if left:
            raise MoveError(left.pop(), "command is stamped 0.501 s old")
        return "arrived"

    monkeypatch.setattr(Machine, "move", move)
    monkeypatch.setattr(WatchedMachine, "_spin", lambda *_: None)
    monkeypatch.setattr(WatchedMachine, "wait", lambda *arguments: waits.append(arguments[-1]))
    if not ends:
        assert (machine.move(HOME), waits) == ("arrived", ["the mover"] * 2)
        return
    with pytest.raises(MoveError) as caught:
        machine.move(HOME)
    assert (caught.value.reason, left) == (ends, [])


class Watched(WatchedMachine):
    """A watched machine without nodes: each spin delivers the next message of a list."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, frames: Any = None, **options: Any) -> None:
        monkeypatch.setattr(Machine, "__init__", lambda *_: None)
        self.state = MoveState("idle", "", 1.0, 0.0, "", 0, 0, "", frames=frames or {})
        monkeypatch.setattr(collector, "PATIENCE", 0.2)
        self.node, self.publishers = MagicMock(), 1
        self.node.resolve_topic_name.side_effect = "/{}".format
        self.node.count_publishers.side_effect = lambda topic: self.publishers
        self.node.get_clock.return_value.now.return_value.nanoseconds = 1
        super().__init__("pose", samples=9, **options)

    def look(self, *messages: Any) -> Any:
        """Return the observation made while these messages arrive."""
        coming = iter(messages)

        def spin(_: float) -> None:
            for message in islice(coming, 1):
                kinds = {
                    PoseStamped: self._on_pose,
                    Temperature: self._on_temperature,
                    RelativeHumidity: self._on_humidity,
                    Vector3Stamped: self._on_gravity,
                }
                strutted = "strut_1" in getattr(message, "name", ())
                kinds.get(type(message), self._on_struts if strutted else self._on_readings)(message)

        self.spin_once = spin  # type: ignore[method-assign]
        return self.observe()


def poses_at(*heights: float, frame: str = "base") -> list[PoseStamped]:
    messages = [pose_message(HOME, frame) for _ in heights]
    for message, height in zip(messages, heights, strict=True):
        message.pose.position.z += height
    return messages


def test_of_a_tracker_the_median_counts_and_half_of_the_poses_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of nine poses 1 µm apart one is wrong by 1 m; a pose that is not finite counts as a broken beam."""
    machine = Watched(monkeypatch)
    seen = machine.look(*poses_at(*(1e-6 * n for n in range(8)), 1.0))
    assert seen.pose.position[2] == pytest.approx(HOME.position[2] + 4e-6, abs=1e-12)
    assert (seen.uncertainty > 0.0).all()
    assert machine.look(*poses_at(0.0, 0.0, 0.0, math.nan, 0.0)).pose is not None
    assert machine.look(*poses_at(0.0, 0.0, 0.0, math.nan)) is None
    machine._samples = 3
    assert [machine.look(*poses_at(*[0.0] * n)) is None for n in (2, 3)] == [True, False], "three at least"
    machine.publishers = 0
    with pytest.raises(NoAnswerError, match="no node publishes /pose"):
        machine.look()
    with pytest.raises(CommandError, match="/pose: frame_id must be base, not 'tracker'; `collect --tracker"):
        machine.look(*poses_at(0.0, frame="tracker"))
    free = Watched(monkeypatch, tracker_frame="free")
    assert free.look(*poses_at(*[0.0] * 9, frame="tracker")).pose is not None, "the first frame is the tracker's"
    with pytest.raises(CommandError, match="frame_id must be tracker, not 'base'"):
        free.look(*poses_at(0.0))


def stamped(messages: list[Any], start: float) -> list[Any]:
    """Give messages 0.1 s apart their stamps, s, and return them."""
    for n, message in enumerate(messages):
        message.header.stamp.sec, tenths = divmod(round(10.0 * start) + n, 10)
        message.header.stamp.nanosec = tenths * 100_000_000
    return messages


def test_a_late_reading_of_the_motion_before_the_stop_is_not_of_the_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stop begins at 10 s, and the tracker is 0.5 s late: its first five poses, 1 m beside, are of the motion."""
    machine, laser = Watched(monkeypatch), Watched(monkeypatch, readings="laser")
    laser._own, laser._wants_pose = ("linear",), False
    late = [*poses_at(*[1.0] * 5), *poses_at(*[0.0] * 9)]
    lengths = [JointState(name=["linear"], position=[float(n < 5)]) for n in range(14)]
    for one, messages in ((machine, late), (laser, lengths)):
        one._on_estimate(stamped(poses_at(0.0), 10.0)[0])
        seen = one.look(*stamped(messages, 9.5))
        assert seen.time == pytest.approx(10.8)
        read = seen.channels["linear"][0] if one is laser else seen.pose.position[2] - HOME.position[2]
        assert read == pytest.approx(0.0, abs=1e-12)
        assert one.look(*stamped(messages[:5], 9.5)) is None, "then the beam broke"
        with pytest.raises(CommandError, match=r"is stamped 2\.1 s late: does the instrument repeat an old"):
            one.look(*stamped(messages[-1:], 7.9))
    seen = machine.look(*poses_at(*[0.0] * 9))
    assert seen.time == 10.0, "a zero stamp means now"


def test_readings_of_two_instruments_are_not_mixed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed driver stays in the graph for up to 20 s."""
    machine = Watched(monkeypatch)
    left = iter([2, 2, 1])
    machine.node.count_publishers.side_effect = lambda topic: next(left, 1)
    assert machine.look(*poses_at(*[0.0] * 12)).pose is not None
    monkeypatch.setattr(clients, "ALONE_WITHIN", 0.0)
    machine.node.count_publishers.side_effect = lambda topic: 2
    nodes = [SimpleNamespace(node_name=name, node_namespace="/") for name in ("one", "other")]
    machine.node.get_publishers_info_by_topic.side_effect = lambda topic: nodes
    with pytest.raises(NoAnswerError, match=r"a single publisher of /pose \(publishers now: /one, /other\)"):
        machine.look(*poses_at(*[0.0] * 9))
    machine._states, machine._to = "mover/state", MagicMock()
    with pytest.raises(NoAnswerError, match=r"for a single publisher of mover/state \(publishers now: /one, /other\)"):
        machine.move(HOME)
    machine._to.publish.assert_not_called()


def beside(kind: type, frame: str, value: float) -> Any:
    """Return a temperature, or gravity along z."""
    message = kind(temperature=value) if kind is Temperature else kind(vector=Vector3(z=value))
    message.header.frame_id = frame
    return message


def test_an_observation_holds_all_that_was_published_beside_the_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of nine heights 1 µm apart the median is known to 1.4826 · 2 µm · √(π/2)/3, the other coordinates to 1 nm. Struts
    are averaged. A part without a thermometer has 20 °C; what is in another frame or unit, or lost, does not count.
    Two temperatures or humidities within a moment count equally in the filter's mean over 30 s."""
    machine = Watched(monkeypatch)
    poses = poses_at(*(1e-6 * n for n in range(9)))
    poses[-1].header.stamp.sec = 7
    struts = [JointState(name=STRUT_NAMES, position=[n, *[0.5] * 5]) for n in (0.4, 0.6, math.nan)]
    names = (*STRUT_NAMES, "base", "platform")
    warm = [beside(Temperature, name, 20.0 + n) for n, name in enumerate(names)]
    bad = [beside(Temperature, "base", 293.0), beside(Temperature, "spindle", 25.0)]
    down = [beside(Vector3Stamped, *one) for one in (("base", -9.81), ("work", -9.8), ("base", -1.0))]
    assert machine.look(*bad, *poses)[2:] == (None, None, 7.0, {}, False, None, pytest.approx(math.nan, nan_ok=True))
    assert machine.look(warm[-1], *poses).temperatures == (20.0,) * 7 + (27.0,), "one thermometer, on the platform"
    air = [RelativeHumidity(relative_humidity=h) for h in (0.4, 45.0, 0.5)]
    seen = machine.look(*struts, *warm, *bad, *down, *air, beside(Temperature, "base", 28.0), *poses)
    assert seen.pose.position == pytest.approx(near(HOME, (0.0, 0.0, 4e-6)).position, abs=1e-12)
    assert seen.uncertainty == pytest.approx([1e-9, 1e-9, 1.4826 * 2e-6 * math.sqrt(math.pi / 2.0) / 3.0, *[1e-9] * 3])
    assert seen.struts == pytest.approx((0.5,) * 6)
    mean = pytest.approx((*(20.0 + n for n in range(6)), 27.0, 27.0), abs=0.01)
    assert seen[3:] == (mean, 7.0, {}, False, (0.0, 0.0, -9.81), pytest.approx(0.45, abs=1e-3))


def test_a_broken_beam_loses_the_zero_of_single_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a broken beam the earlier readings of the laser's two channels do not count any more."""
    confirmed: list[Any] = []
    machine = Watched(monkeypatch, readings="laser", confirm=confirmed.append)
    spun: list[float] = []
    machine.spin_once = lambda seconds: spun.append(seconds) or sleep(seconds)  # type: ignore[method-assign]
    run = SimpleNamespace(channels=("linear", "rotation_y", "position_x"), place=HOME)
    assert machine.set_up(run) == ("linear", "rotation_y")
    assert (confirmed, set(spun)) == ([run], {0.02})
    (place,) = machine._set_up.publish.call_args.args
    assert (place.header.frame_id, place.header.stamp.nanosec, place.pose.position.z) == ("base", 1, HOME.position[2])

    def read(*lengths: float) -> list[JointState]:
        return [JointState(name=["rotation_y", "linear"], position=[1e-3, length]) for length in lengths]

    poses = poses_at(*[0.0] * 9)
    seen = machine.look(*poses, *read(*(1e-6 * n for n in range(8)), 0.5))
    assert (seen.channels["linear"][0], seen.channels["rotation_y"][0]) == pytest.approx((4e-6, 1e-3), abs=1e-15)
    assert not seen.zero_lost
    broken = machine.look(*poses, *read(7.0, 7.0, math.nan, *[0.0] * 9))
    assert (broken.channels["linear"][0], broken.zero_lost) == (0.0, True)
    assert not machine.look(*poses, *read(*[0.0] * 9)).zero_lost, "told once"
    machine._on_readings(*read(math.nan))
    assert machine.set_up(SimpleNamespace(channels=("linear",), place=HOME)) == ("linear",)
    seen = machine.look(*read(*[0.0] * 9))
    assert (seen.pose, seen.zero_lost) == (None, False), "a beam may break before the set-up, and nobody needs poses"
    with pytest.raises(CommandError, match="/laser: channel linear is not in 'rotation_y'"):
        machine.look(JointState(name=["rotation_y"], position=[0.0]))


# ---- a machine that calibrates itself (its loop: test/upkeep) ----


def test_a_client_moves_a_machine_with_a_prefix_and_names_models_to_it(bench: Bench, tmp_path: Path) -> None:
    """A named model runs by its ramp; if the compensator refuses it, the old one stays."""
    frames = {"base_frame": "left/base", "work_frame": "left/work", "frame_prefix": "left/"}
    bench.remove_publisher("tool_pose_command")
    bench.drive(truth_file="ideal", base_frame="left/base", rate=100.0)
    bench.compensator(model_file=model_file(tmp_path, "old.yaml"), **frames)
    bench.add(MoverNode, True, {**frames, "tool_frame": "left/tool", "rate": 50.0})
    for name, offset in (("new.yaml", 50.0), ("far.yaml", 5000.0)):
        model_file(tmp_path, name, struts={"offset_um": offset})

    def named() -> str:
        node = next(node for node in bench.nodes if node.get_name() == "compensator")
        return str(node.get_parameter("model_file").value)

    def used(machine: AdaptedMachine) -> Any:
        machine.refuse_other("paper")
        with pytest.raises(CommandError, match="run the machine 'paper', not 'mine': name the running machine's"):
            machine.refuse_other("mine")
        machine.move(HOME, "base")
        machine.move(near(HOME, (0.0, 0.0, 0.001)))
        machine.move(Pose([0.0, 0.0, 0.001], np.eye(3)), "tool", relative=True)
        seen = machine.observe()
        machine.reload(tmp_path / "new.yaml")
        assert named() == str(tmp_path / "new.yaml")
        machine.move(HOME)
        while abs(bench.seen["strut_corrections"][-1].position[0] + 50e-6) > 1e-9:
            machine.spin_once(0.02)
        with pytest.raises(CommandError, match=r"did not load.*the old model stays"):
            machine.reload(tmp_path / "far.yaml")
        machine.refuse_unreadable(tmp_path / "adapted" / "model.yaml")
        with pytest.raises(CommandError) as error:
            machine.refuse_unreadable(tmp_path.parent / "model.yaml")
        assert f"reads only models in {tmp_path}: give it -p model_folder:=FOLDER" in str(error.value)
        return seen

    ended: list[Any] = []

    def client() -> None:
        with AdaptedMachine("tool_pose_true") as machine:
            try:
                ended.append(used(machine))
            except BaseException as error:  # the result of the thread
                ended.append(error)

    thread = Thread(target=client)
    thread.start()
    bench.until(lambda: not thread.is_alive(), "the client", timeout=60.0)
    if isinstance(ended[0], BaseException):
        raise ended[0]
    assert ended[0].pose.position == pytest.approx(near(HOME, (0.0, 0.0, 0.002)).position, abs=1e-6)
    assert named() == str(tmp_path / "new.yaml"), "a restart would else begin with what was refused"
    assert np.allclose(bench.seen["strut_corrections"][-1].position, -50e-6, rtol=0.0, atol=1e-9)


def test_what_is_read_beside_a_machine_with_a_prefix_is_in_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Watched(monkeypatch, {"base": "left/base"}, readings="laser")
    machine.spin_once = sleep  # type: ignore[method-assign]
    machine.set_up(SimpleNamespace(channels=("linear",), place=HOME))
    assert machine._set_up.publish.call_args.args[0].header.frame_id == "left/base"
    machine._own, machine._wants_pose = (), True
    seen = machine.look(beside(Vector3Stamped, "left/base", -9.81), *poses_at(*[0.0] * 9, frame="left/base"))
    assert seen.gravity == (0.0, 0.0, -9.81)


@pytest.mark.parametrize("stopped", [False, True])
def test_another_clients_move_is_reported_and_waited_for(stopped: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another client's move replaces ours twice: during our move, and while the tool is observed; a person may stop the
    wait.

    Then the tool first returns to the stop before: from elsewhere its struts would arrive in other directions.
    """
    machine, before = object.__new__(AdaptedMachine), near(HOME, (0.0, 0.0, 0.01))
    machine._targets = [(before, (), {})]
    own, other = (MoveState("arrived", "", 1.0, 0.0, "", request, 0, "") for request in (1, 2))
    underway = iter([replace(other, state="moving", share=0.5)] * 4 + [other] * 4)
    asked, warned, outcomes = list[Pose](), list[str](), ["replaced", ""]

    def move(machine: AdaptedMachine, pose: Pose, *_: Any, **__: Any) -> MoveState:
        asked.append(pose)
        if outcomes and (reason := outcomes.pop(0)):
            raise MoveError(reason, "another move was requested")
        machine.state = own
        return own

    def spin(_: float) -> None:
        machine.state = next(underway)
        if stopped and machine.state.state == "moving":
            machine._going_on = lambda: False

    monkeypatch.setattr(Machine, "move", move)
    log = SimpleNamespace(warning=warned.append)
    machine.node, machine.spin_once = SimpleNamespace(get_logger=lambda: log), spin  # type: ignore[method-assign]
    machine._going_on, machine._arrived, machine.state = lambda: True, None, replace(other, state="planning")
    if stopped:
        with pytest.raises(MoveError, match="person: stopped while another client moved the tool"):
            machine.move(HOME)
        assert machine._targets == [(before, (), {})], "the target was not reached"
        return
    assert machine.move(HOME) is own
    assert (asked, warned) == (
        [HOME, before, HOME],
        ["another client moves the tool: waiting until the tool is at rest"],
    )
    seen = iter([other, own])

    def observe(machine: AdaptedMachine) -> str:
        machine.state = next(seen)
        return f"of request {machine.state.request}"

    monkeypatch.setattr(WatchedMachine, "observe", observe)
    assert machine.observe() == "of request 1", "what was read of another client's move counts for nothing"
    assert (asked[3:], len(warned)) == ([before, HOME], 2)


def test_a_stop_brakes_a_move_that_was_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first move ends before its stop, since its commands are refused; the second move is stopped, too."""
    machine, requests, stops = object.__new__(AdaptedMachine), iter([1, 2]), list[object]()
    machine.state = MoveState("idle", "", 1.0, 0.0, "", 0, 0, "")

    def move(machine: AdaptedMachine, pose: Pose, *_: Any, progress: Callable[[MoveState], object]) -> MoveState:
        request = next(requests)
        for state in ("planning", "moving"):
            progress(MoveState(state, "", 0.0, 1.0, "", request, 0, ""))
        raise MoveError("refusal" if request == 1 else "person", "stopped")

    monkeypatch.setattr(Machine, "move", move)
    monkeypatch.setattr(WatchedMachine, "_spin", lambda *_: None)
    monkeypatch.setattr(WatchedMachine, "wait", lambda *_: None)
    machine._going_on, machine._stop, machine._targets = lambda: False, SimpleNamespace(call_async=stops.append), []
    with pytest.raises(MoveError, match="person"):
        machine.move(HOME)
    assert len(stops) == 2


@pytest.fixture
def adapter(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], AdapterNode]]:
    """Provide a node whose process is a shell script, since Python's imports at low priority would take long.

    SIGINT is ignored here, as in the background jobs of a script; the node's process must not inherit this.
    """

    def make(script: str, **parameters: object) -> AdapterNode:
        program = tmp_path / "python"
        program.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))
        states = list[tuple[Any, ...]]()

        def keep(message: DiagnosticStatus) -> None:
            values = {entry.key: entry.value for entry in message.values}
            state = message.message.partition(": ")[0]
            assert (message.name, message.hardware_id.removeprefix("left/")) == ("adapter: adapt", "paper")
            assert values.pop("state") == state
            states.append((message.level, message.message, *values.values()))

        rig.listeners.append(("/adapter/state", keep))
        node = rig.add(AdapterNode, True, {"folder": str(tmp_path), **parameters})
        node.published = states  # level, text, step, model, running
        return node

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield make
    signal.signal(signal.SIGINT, before)


def test_the_node_starts_reports_and_stops_a_calibration(
    rig: Rig, adapter: Callable[[str], AdapterNode], tmp_path: Path
) -> None:
    """The test writes the journal; the step of the run before is none of this one."""
    node = adapter("exec sleep 100", goal=2.5e-6, samples=9, reload=True)
    assert rig.call(Trigger, "adapter/stop").message == "no calibration or check was running"
    journal, before = tmp_path / "journal.jsonl", '{"event": "ended", "state": "stopped"}\n'
    journal.write_text(before + '{"event": "chec', encoding="utf-8")
    answer = rig.call(Trigger, "adapter/calibrate")
    assert (answer.success, answer.message) == (True, "calibrating; ~/state reports progress and result")
    process = node._process
    wanted = f"adapt --machine paper.yaml --folder {tmp_path} --goal-um 2.5 --topic tool_pose_true --samples 9 --reload"
    assert process.args[1:] == ["-m", "hexapod_comp", *wanted.split()]
    assert make_parser().parse_args(process.args[3:]).verb == "adapt"
    assert (os.getsid(process.pid), os.getpriority(os.PRIO_PROCESS, process.pid)) == (process.pid, 10)
    refused = rig.call(Trigger, "adapter/verify")
    assert (refused.success, refused.message) == (False, "already calibrating: call ~/stop to end it")
    rig.step(0.2)
    journal.write_text(before + '{"time": "", "event": "reloaded", "model": ""}\n{"event": "pla', encoding="utf-8")
    rig.until(lambda: node._step == "reloaded", "the step")
    rig.step(0.2)
    answer = rig.call(Trigger, "adapter/stop")
    assert (answer.success, answer.message) == (True, "the machine brakes")
    refused = rig.call(Trigger, "adapter/calibrate")
    stopping = "calibrating is being stopped: call again when ~/state reports its end"
    assert (refused.success, refused.message) == (False, stopping)
    process.wait(50.0)  # its sleep would take 100 s
    rig.until(lambda: node._state == "stopped", "its end")
    assert rig.call(Trigger, "adapter/stop").message == "no calibration or check was running"
    assert node.published == [
        (OK, "idle: no calibration or check was requested yet", "", "", "false"),
        (OK, "calibrating: starting", "", "", "true"),
        (OK, "calibrating: reloaded", "reloaded", "", "true"),
        (OK, "stopped: before the first step was completed", "reloaded", "", "false"),
    ]


def test_a_run_ends_with_its_node(rig: Rig, adapter: Callable[[str], AdapterNode]) -> None:
    node = adapter("exec sleep 100")
    for end, what in ((node.trigger_deactivate, "calibrate"), (node.publish_last_status, "verify")):
        rig.call(Trigger, f"adapter/{what}")
        process = node._process
        assert ("--verify" in process.args) is (what == "verify")
        end()
        assert process.wait() == -signal.SIGINT
        rig.until(lambda: node._process is None, "its end")
        assert rig.call(Trigger, "adapter/verify").message == "the node is not active"
        node._active = True
    assert (OK, "stopped: the node ended", "", "", "true") in node.published


@pytest.mark.parametrize(
    ("event", "result"),
    [
        ({"event": "adopted", "model": "model_1.yaml"}, "was interrupted"),
        (
            {"event": "ended", "state": "refused", "text": "no reading", "model": None, "applied": None},
            "ended: refused, no reading",
        ),
        ({"event": "adopted"}, "line 1, adopted.model: is missing"),
    ],
)
def test_a_restarted_node_reports_how_the_last_run_ended(
    rig: Rig, adapter: Callable[[str], AdapterNode], tmp_path: Path, event: dict[str, Any], result: str
) -> None:
    journal = tmp_path / "journal.jsonl"
    journal.write_text(json.dumps({"time": "", **event}) + "\n", encoding="utf-8")
    node = adapter("exit 2")
    text = f"before this start of the node, the last run in the folder {result}"
    if "model" not in event:
        text = f"every run will be refused: {journal}: {result}"
    assert node.published == [(OK, f"idle: {text}", "", "", "false")]


def test_a_folder_in_which_another_process_works_is_refused(
    rig: Rig, adapter: Callable[[str], AdapterNode], tmp_path: Path
) -> None:
    node = adapter("exit 2", check_every=1.0)
    node._next = "verifying"
    with sole_user(tmp_path):
        answer = rig.call(Trigger, "adapter/calibrate")
        assert (answer.success, answer.message) == (False, f"another adapt works in {tmp_path}: stop it first")
        rig.step(2.0)
        assert [row[1] for row in node.published] == ["idle: no calibration or check was requested yet"]
    rig.until(lambda: node._process is not None, "the check")
    node._process.wait()


def test_a_process_that_ends_without_a_result_is_reported(
    rig: Rig, adapter: Callable[[str], AdapterNode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A check goes on after an interruption, a kill and a restart of the node; an error would only be repeated."""
    node = adapter("exit 2")
    monkeypatch.setattr(node, "get_namespace", lambda: "/left")
    assert rig.call(Trigger, "adapter/verify").success
    assert node._process.args[-3:] == ["--verify", "--namespace", "/left"]
    node._process.wait()
    rig.until(lambda: node._state == "failed", "its end")
    ended, log = "the process `adapt` ended with exit code", "its last messages are in the log"
    assert node.published[-1] == (ERROR, f"failed: {ended} 2; {log}", "", "", "false")
    assert node._next == ""
    for code, state, text, level, model, following in (
        (1, "failed", "refusal: several_publishers: /mover, /other", ERROR, "", "verifying"),
        (-9, "failed", f"{ended} -9; {log}", ERROR, "", "verifying"),
        (0, "changed", "strut 2 by 20 µm", ERROR, "", ""),
        (0, "in use", "confirmed", OK, "model_1.yaml", "verifying"),
    ):
        node._state = "verifying"
        node._finish(code, {"event": "ended", "state": state, "text": text, "model": model} if code >= 0 else {})
        known = str(tmp_path / model) if model else ""
        assert (node.published[-1], node._next) == ((level, f"{state}: {text}", "", known, "false"), following)
    for applied, level in ((None, OK), (True, OK), (False, WARN)):
        node._finish(0, {"event": "ended", "state": "proposed", "text": "", "model": None, "applied": applied})
        assert (node.published[-1][0], next(node.findings(0.0))) == (level, (level, "proposed: "))
    (tmp_path / "model.yaml").touch()
    node.configure()
    assert rig.set_parameter("adapter", "check_every", 1.0).successful
    for seconds, begun in ((0.9, 1), (0.2, 2)):
        rig.step(seconds)
        assert [row[1] for row in node.published].count("verifying: starting") == begun
    while node._process is not None:
        node._process.wait()
        rig.step(0.1)


def test_a_campaign_is_measured_with_its_own_tool_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """A person selects another tool, whose tip would go to the campaign's poses: before a move, and during a move."""
    machine, moves = object.__new__(WatchedMachine), list[Pose]()
    own = MoveState("arrived", "", 1.0, 0.0, "", 1, 0, "")
    machine.state = replace(own, tool="probe")

    def move(machine: WatchedMachine, pose: Pose) -> MoveState:
        moves.append(pose)
        machine.state = replace(own, tool="probe")
        return own

    monkeypatch.setattr(Machine, "move", move)
    for count in (0, 1):
        with pytest.raises(CommandError, match="the tool in use is 'probe', but the readings are of 'tool'"):
            machine.move(HOME)
        assert len(moves) == count
        machine.state = own


def test_struts_and_pose_of_a_stop_are_of_one_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A correction ramps out by 1 mm in the last three of nine readings: pose and struts are those of the six before.

    The mean of the struts would be off by a third of the ramp, 333 µm, and the median of the poses not at all.
    """
    machine = Watched(monkeypatch)
    struts = [
        JointState(name=[f"strut_{n}" for n in range(1, 7)], position=[0.5 + h] * 6) for h in [0.0] * 6 + [1e-3] * 3
    ]
    poses = poses_at(*[0.0] * 6, *[1e-3] * 3)
    seen = machine.look(*(message for pair in zip(struts, poses, strict=True) for message in pair))
    assert seen.struts == (0.5,) * 6
    assert seen.pose.position[2] == HOME.position[2]
