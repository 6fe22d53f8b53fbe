"""Tools, work frames and travel at the node. Truth: the zoo's own frames; ``travel`` for what is published of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from foreign_machines import Machine, with_frames
from node_helpers import RELIABLE, Bench
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hexapod_comp.compensation.travel import travel
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.ros.status import ERROR, WARN

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CLOSE = 1e-11
"""m; quaternions have sixteen digits."""


@pytest.fixture
def machine() -> Machine:
    return with_frames("framed")


@pytest.fixture
def file(machine: Machine, tmp_path: Path) -> str:
    return str(machine.write(tmp_path / "machine.yaml"))


def at_home(machine: Machine, tool: str | None = None, work: str | None = None, shift: float = 0.0) -> Pose:
    """Return the tool's pose in a frame (None: the usual ones) with the platform level and a shift above home."""
    used = machine.using(tool, work)
    x, y, z = machine.home
    tip = used.tips(np.array([[x, y, z + shift]]), np.eye(3)[None])[0]
    return Pose(tip, used.work.matrix.T @ used.tool.matrix)


def started(rig: Bench, file: str, **parameters: object) -> None:
    rig.compensator(geometry_file=file, model_file="ideal", **parameters)


def heard(rig: Bench, kind: type, topic: str, qos: QoSProfile = RELIABLE) -> list:
    """Return a list of what is published from now on."""
    messages: list = []
    rig.witness.create_subscription(kind, topic, messages.append, qos)
    return messages


# ---- frames ----


def test_the_frame_id_picks_the_work_frame(rig: Bench, machine: Machine, file: str) -> None:
    """The same place in three frames gives the same struts: those of the zoo's own kinematics."""
    started(rig, file)
    truth = machine.lengths(np.array([machine.home]), np.eye(3)[None])[0]
    for frame in ("work", "fixture"):
        answer = rig.ask(at_home(machine, None, frame), frame)
        np.testing.assert_allclose(answer.lengths, truth, rtol=0.0, atol=CLOSE)
    tip = np.array(machine.home) + np.array(machine.tool.position)
    answer = rig.ask(Pose(tip, machine.tool.matrix), "base")
    np.testing.assert_allclose(answer.lengths, truth, rtol=0.0, atol=CLOSE)
    rig.send(at_home(machine), "fixtures")
    values = rig.until_status(ERROR, "refusing commands: frame_id")
    assert values["last_refusal"] == "frame_id must be one of base, work, fixture, not 'fixtures'"
    rig.send(at_home(machine), "")
    rig.until(lambda: rig.values().get("refused.frame_id") == "2")
    rig.until(lambda: rig.values()["frame_id"] == "base")


def test_frames_of_two_machines_have_prefixes(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file, base_frame="left_base", work_frame="left_work", frame_prefix="left_")
    rig.ask(at_home(machine, None, "fixture"), "left_fixture")
    rig.send(at_home(machine, None, "fixture"), "fixture")
    values = rig.until_status(ERROR, "refusing commands: frame_id")
    assert "left_base, left_work, left_fixture" in values["last_refusal"]


def test_two_frames_of_one_name_are_refused(rig: Bench, file: str) -> None:
    rig.compensator(start=False, geometry_file=file, model_file="ideal", work_frame="fixture")
    assert not rig.change("configure")
    assert rig.logged("parameter frame_prefix: with it work frame 'fixture' has the frame_id of another")


# ---- tools ----


def test_the_parameter_changes_the_tool_and_nothing_moves(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    tools = heard(rig, String, "compensator/tool", LATCHED)
    before = rig.ask(at_home(machine), "work")
    assert rig.set_parameter("compensator", "tool", "probe").successful
    rig.send(at_home(machine), "work")
    values = rig.until_status(ERROR, "refusing commands: tool_changed")
    assert "since the change to tool 'probe' no command was where the struts are" in values["last_refusal"]
    after = rig.ask(at_home(machine, "probe", "fixture"), "fixture")
    np.testing.assert_allclose(after.lengths, before.lengths, rtol=0.0, atol=CLOSE)
    estimate = message_pose(rig.estimate(after.command))
    tip = np.array(machine.home) + np.array(machine.tools["probe"].position)
    np.testing.assert_allclose(estimate.position, tip, rtol=0.0, atol=1e-10)
    rig.until(lambda: [rig.values().get(key) for key in ("tool", "frame_id")] == ["probe", "fixture"])
    rig.until(lambda: [message.data for message in tools][-1:] == ["probe"])


def test_a_controller_selects_a_tool_by_a_topic(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    select = rig.witness.create_publisher(String, "select_tool", RELIABLE)
    rig.until(select.get_subscription_count)
    rig.ask(at_home(machine), "work")
    select.publish(String(data="stub"))
    rig.until(lambda: rig.nodes[0].get_parameter("tool").value == "stub", "the tool")
    rig.ask(at_home(machine, "stub"), "work")
    select.publish(String(data="drill"))
    values = rig.until_status(WARN, "tool refused: parameter tool: machine framed has no tool 'drill'")
    assert (values["tool"], values["refused_tools"]) == ("stub", "1")
    # Commands for the tool that it did not get are refused, however near.
    rig.send(at_home(machine, "stub", shift=1e-4), "work")
    rig.until_status(ERROR, "refusing commands: tool_changed")
    rig.ask(at_home(machine, "stub"), "work")


def test_of_two_who_select_tools_none_is_obeyed(rig: Bench, machine: Machine, file: str, stranger) -> None:
    started(rig, file)
    select = rig.witness.create_publisher(String, "select_tool", RELIABLE)
    other = stranger.create_publisher(String, "select_tool", RELIABLE)
    rig.until(lambda: select.get_subscription_count() and other.get_subscription_count())
    rig.ask(at_home(machine), "work")
    values = rig.until_status(ERROR, "select_tool ignored: several_publishers: several publishers of /select_tool")
    assert values["select_tool_by"] == "/stranger, /witness"
    for publisher in (select, other):
        publisher.publish(String(data="stub"))
    rig.until(lambda: rig.values().get("refused_tools") == "2")
    assert rig.values()["tool"] == "tool"
    rig.ask(at_home(machine, shift=1e-4), "work")


def test_the_tool_stays_while_the_machine_moves(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    rig.ask(at_home(machine), "work")
    rig.ask(at_home(machine, shift=2e-4), "work")
    answer = rig.set_parameter("compensator", "tool", "probe")
    assert not answer.successful
    assert answer.reason.startswith("parameter tool: stays 'tool' while the machine moves: strut_")
    assert rig.set_parameter("compensator", "tool", "tool").successful
    rig.ask(at_home(machine, shift=3e-4), "work")


def test_a_start_takes_the_tool_that_was_set(rig: Bench, machine: Machine, file: str) -> None:
    rig.compensator(start=False, geometry_file=file, model_file="ideal", tool="probe")
    assert rig.set_parameter("compensator", "tool", "drill").successful  # nobody knows the machine yet
    assert not rig.change("configure")
    assert rig.logged("cannot configure: machine framed has no tool 'drill'; it has tool, probe, stub")
    assert "parameter tool: " in rig.set_parameter("compensator", "tool", 3).reason
    rig.set_parameter("compensator", "tool", "stub")
    assert rig.change("configure")
    assert rig.change("activate")
    rig.until(rig.matched)
    truth = machine.lengths(np.array([machine.home]), np.eye(3)[None])[0]
    answer = rig.ask(at_home(machine, "stub"), "work")
    np.testing.assert_allclose(answer.lengths, truth, rtol=0.0, atol=CLOSE)


# ---- travel ----


def test_travel_is_answered_and_published_with_names_and_units(rig: Bench, machine: Machine, file: str) -> None:
    started(rig, file)
    early = rig.call(Trigger, "compensator/get_travel")
    assert not early.success
    assert "where the machine is is not known" in early.message
    rig.ask(at_home(machine), "work")
    rig.set_parameter("compensator", "tool", "probe")
    rig.ask(at_home(machine, "probe", "fixture"), "fixture")
    answer = rig.call(Trigger, "compensator/get_travel")
    assert answer.success
    assert answer.message.startswith("tool probe in fixture at x, y, z ")
    geometry = load_geometry(file).using("probe", "fixture")
    ways = travel(RealMachine(geometry, MachineModel("framed")), at_home(machine, "probe", "fixture"))
    reports = heard(rig, DiagnosticStatus, "compensator/travel")
    rig.until(lambda: reports, "a report")
    values = {entry.key: entry.value for entry in reports[0].values}
    for way in ways:
        assert float(values[way.key]) == pytest.approx(way.shown, abs=2e-6)
        assert values[f"{way.way} stops at"].partition(":")[0] == str(way.error).partition(":")[0]
        assert [way.way, f"{way.shown:.3f}", way.unit] in [line.split()[:3] for line in answer.message.splitlines()]
    assert reports[0].message == answer.message.partition("\n")[0]
    assert (reports[0].hardware_id, reports[0].name) == ("framed", "compensator: travel")
