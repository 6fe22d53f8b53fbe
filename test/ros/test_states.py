"""What compensator and drive do in every case: one test per row of doc/states.md, which names it.

Cases that another file tests are named there with that file. Levels and texts are those of the table.
"""

from __future__ import annotations

import os
import pickle
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from lifecycle_msgs.srv import ChangeState
from node_helpers import CONFIG, HOME, RELIABLE, Bench, closed_form_lengths, geometry_file, model_file, near
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from hexapod_comp.compensation import guards
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.compensator import CHECK_PERIOD, CompensatorNode
from hexapod_comp.ros.messages import period, pose_message
from hexapod_comp.ros.parameters import ParameterError
from hexapod_comp.ros.status import ERROR, OK, WARN
from hexapod_comp.ros.strut_drive import StrutDriveNode

DRIVE = "strut_drive"
STATES = Path(__file__).resolve().parents[2] / "doc" / "states.md"
MOVED = near(HOME, (0.0002, 0.0001, -0.0003))
ROUNDING = 1e-12


@pytest.fixture(autouse=True)
def short_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """What colours a status for one or two seconds does so for 0.3 s."""
    monkeypatch.setattr(guards, "SHOWN_FOR", 0.3)
    monkeypatch.setattr(guards, "SPEAKERS_HELD", 0.3)


@pytest.fixture
def over_dds(bench: Bench) -> Iterator[Callable[[str], Node]]:
    """Give what makes a real node of a name."""
    nodes: list[Node] = []

    def make(name: str) -> Node:
        nodes.append(rclpy.create_node(name, context=bench.context))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def loop(rig: Bench, **compensator: object) -> tuple[StrutDriveNode, CompensatorNode]:
    """Start both nodes, the drive with the shipped machine's backlash and without noise, and let them meet."""
    drive = rig.drive(step=0.0, encoder_resolution=0.0, encoder_noise=0.0)
    node = rig.compensator(**compensator)
    met(rig, drive, node)
    return drive, node


def met(rig: Bench, drive: LifecycleNode, compensator: LifecycleNode) -> None:
    """Wait until both nodes hear each other, and readings have come."""
    ends = {end.topic_name: end for end in (*compensator.publishers, *compensator.subscriptions)}
    (heard,) = [end for end in drive.subscriptions if end.topic_name == "/strut_commands"]
    rig.until(lambda: heard.get_publisher_count() == 1, "the drive to hear the compensator")
    rig.until(lambda: ends["/strut_states"].get_publisher_count() == 1, "the compensator to hear the drive")
    rig.seen["strut_states"].clear()
    rig.until(lambda: rig.values().get("pose_estimated_from") == "strut_states", "feedback")


def end(rig: Bench, node: LifecycleNode) -> None:
    """End a node; nothing of it is left: its publishers live on until the executor has let go of their events."""
    count = rig.witness.count_publishers
    before = {publisher.topic_name: count(publisher.topic_name) for publisher in node.publishers}
    node.trigger_deactivate()
    rig.executor.remove_node(node)
    rig.nodes.remove(node)
    node.destroy_node()
    rig.until(lambda: all(count(topic) < number for topic, number in before.items()), "its publishers to be gone")


def command(rig: Bench, lengths: np.ndarray) -> None:
    rig.publish("strut_commands", JointState(name=list(STRUT_NAMES), position=[float(v) for v in lengths]))


def measured(rig: Bench) -> np.ndarray:
    return np.array(rig.seen["strut_states"][-1].position)


# ---- the table itself ----


def test_every_row_names_a_test_that_is_there():
    """The last column: a test of this file, or file::test."""
    rows = [line for line in STATES.read_text(encoding="utf-8").splitlines() if line.startswith("| ")][1:]
    rows = [row for row in rows if not re.match(r"\| (Case|Phase|[A-Z_]+) \|", row)]
    assert len(rows) >= 30
    for row in rows:
        names = re.findall(r"`(?:(test_\w+\.py)::)?(test_\w+)`", row.rsplit("|", 2)[1])
        assert names, row
        for file, name in names:
            (path,) = Path(__file__).parents[1].rglob(file or "test_states.py")
            source = path.read_text(encoding="utf-8")
            assert f"def {name}(" in source, f"{file}::{name}"


def test_a_state_is_looked_at_often_enough():
    """Within 200 ms, of which the timeouts take 100, one period of looking 50; the rest is a busy machine's."""
    assert CHECK_PERIOD == 0.05


# ---- commands ----


def test_no_command_yet(rig):
    rig.compensator()
    rig.until_status(OK, "waiting for the first command")
    assert not rig.seen["strut_commands"]


def test_no_command_yet_drive(rig):
    rig.drive()
    rig.until_status(OK, "waiting for the first command", DRIVE)
    rig.until(lambda: len(rig.seen["strut_states"]) > 20, "readings")
    readings = np.array([message.position for message in rig.seen["strut_states"]])
    assert np.ptp(readings, axis=0).max() < 1e-6, "noise"


def test_first_command_has_no_direction_of_motion(rig, tmp_path):
    """Between the two sides of a backlash of 10 µm: half of it either way is corrected once a strut moves.

    The first command, its way unknown, is in the middle: no correction.
    """
    rig.compensator(model_file=model_file(tmp_path, struts={"backlash_um": 10.0}), ramp_rate=1.0)
    assert not rig.ask(HOME).corrections.any()
    up = rig.ask(near(HOME, (0.0, 0.0, 1e-4)))
    np.testing.assert_allclose(up.corrections, 5e-6, rtol=0.0, atol=ROUNDING)
    rig.until(lambda: rig.trigger("reset").success, "the machine to stand")
    rig.ask(near(HOME, (0.0, 0.0, 1e-4)))
    again = rig.ask(near(HOME, (0.0, 0.0, 1e-4)))
    assert not again.corrections.any(), "forgotten with the reset"


def test_commands_end(rig):
    """Nothing is sent any more, the drives hold; the next command goes on where the last one was."""
    _, _ = loop(rig)
    last = rig.settle(HOME)
    rig.until_status(WARN, "no new command")
    assert float(rig.until_status(WARN, "no new command", DRIVE)["command_age_s"]) >= 0.1  # said in ms
    assert rig.seen["strut_commands"][-1].header.stamp == last.command.header.stamp
    np.testing.assert_allclose(measured(rig), last.lengths, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(rig.ask(HOME).lengths, last.lengths, rtol=0.0, atol=ROUNDING)
    rig.until(lambda: rig.ask(HOME) and rig.message() == rig.message(DRIVE) == "running", "both to run again")


def test_singular_pose_near(bench, tmp_path):
    """A limit just above home's condition number of the struts: at home a warning, tilted a refusal."""
    bench.compensator(command_timeout=0.0)
    bench.ask(HOME)
    bench.seen["/diagnostics"].clear()
    bench.until(bench.status, "a status")
    home = float(bench.values()["condition_number"])
    end(bench, bench.nodes[0])
    limited = geometry_file(tmp_path, {"condition_number": 1.05 * home})
    bench.compensator(geometry_file=limited, command_timeout=0.0)
    bench.ask(HOME)
    bench.until_status(WARN, "running, near a singularity")
    bench.send(near(HOME, tilt_deg=40.0))
    bench.until_status(ERROR, "refusing commands")


def test_outside_the_measured_box(rig, tmp_path):
    """Measured 5 mm around home: 6 mm beside it the node goes on, and says where it was measured."""
    x, y, z = (1e3 * HOME.position).tolist()
    box = [[x - 5.0, y - 5.0, z - 5.0], [x + 5.0, y + 5.0, z + 5.0]]
    rig.compensator(model_file=model_file(tmp_path, region={"box_mm": box}), command_timeout=0.0)
    rig.ask(HOME)
    assert rig.until_status(OK, "running")["outside_box"] == "false"
    assert rig.ask(near(HOME, (0.001, 0.0, 0.0)))
    for step in range(2, 7):
        rig.ask(near(HOME, (0.001 * step, 0.0, 0.0)))
    values = rig.until_status(WARN, "running, outside the box in which the model was measured")
    assert values["outside_box"] == "true"
    assert "sides 10 × 10 × 10 mm" in values["measured_box"]
    for step in range(5, -1, -1):
        rig.ask(near(HOME, (0.001 * step, 0.0, 0.0)))
    rig.until_status(OK, "running")


def test_overload_keeps_the_newest_and_counts_the_others(bench):
    """105 commands before the node gets to work, and a queue of a hundred: five are counted, none comes late."""
    bench.compensator(command_timeout=0.0)
    bench.ask(HOME)
    sent = [bench.send(near(HOME, (0.0, 0.0, 1e-6 * n))) for n in range(1, 106)]
    bench.until(lambda: bench.seen["strut_commands"][-1].header.stamp == sent[-1].header.stamp, "the last answer")
    values = bench.until_status(WARN, "running, commands are being missed")
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in bench.seen["strut_commands"]]
    assert int(values["commands_missed"]) == 106 - len(stamps) == 5
    assert stamps == sorted(stamps)
    bench.ask(HOME)
    bench.until_status(OK, "running")


def test_overload_of_the_drive_is_counted(bench):
    bench.drive(command_timeout=0.0)
    bench.until(lambda: bench.seen["strut_states"], "readings")
    command(bench, closed_form_lengths(HOME))
    bench.barrier()
    for _ in range(102):
        command(bench, closed_form_lengths(MOVED))
    assert bench.until_status(WARN, "running, commands are being missed", DRIVE)["commands_missed"] == "2"
    bench.until_status(OK, "running", DRIVE)


# ---- clocks ----


@pytest.mark.parametrize("hours", [-1.0, 1.0])
def test_clock_is_set(rig, hours):
    """Sender and node share the clock: commands go on at once, and a ramp under way does not step."""
    node = rig.compensator(command_timeout=0.0, ramp_rate=1e-4)
    before = rig.ask(HOME)
    rig.enable(False)
    reading = node.clock.system
    node.clock.system = lambda: reading() + round(hours * 3600e9)
    message = pose_message(HOME, "base")
    message.header.stamp = rig.stamp(hours * 3600.0)
    step = np.abs(rig.ask(message).lengths - before.lengths).max()
    assert step <= 1e-4 * 0.02 + ROUNDING
    rig.seen["/diagnostics"].clear()
    way = "back" if hours < 0.0 else "forward"
    rig.until(lambda: rig.values().get(f"clock_set_{way}") == "1", "the count")
    assert rig.logged(f"the clock was set {way} by 3600.")


def test_clock_of_the_sender_is_set(rig):
    """0.3 s back: out of order until three in order have come over 20 ms, or half a second has passed."""
    rig.compensator(command_timeout=0.0, max_command_age=0.0)
    late = pose_message(HOME, "base")
    late.header.stamp = rig.stamp(-0.3)
    rig.ask(HOME)
    rig.send(late)
    rig.until_status(ERROR, "refusing commands: stamp_order")

    def accepted() -> bool:
        late.header.stamp = rig.stamp(-0.3)
        rig.send(late)
        rig.barrier()
        return len(rig.seen["strut_commands"]) == 2

    rig.until(accepted, "the order to begin anew")


def test_simulated_time_starts_again(bench):
    """A simulation was reset: its clock falls from 100 s to 1 s."""
    bench.compensator(use_sim_time=True, command_timeout=0.0)
    clock = bench.witness.create_publisher(Clock, "/clock", RELIABLE)
    bench.until(lambda: clock.get_subscription_count() > 0, "the node to hear the clock")
    for second in (100, 101, 1, 2):
        now = Clock()
        now.clock.sec = second
        clock.publish(now)
        bench.until(lambda s=second: bench.nodes[0].get_clock().now().nanoseconds == s * 10**9, "the clock to be read")
        message = pose_message(HOME, "base")
        message.header.stamp.sec = second
        assert bench.ask(message).command.header.stamp.sec == second
    bench.seen["/diagnostics"].clear()
    bench.until(lambda: bench.values().get("clock_set_back") == "1", "the count")


def test_speeds_depend_on_stamps_alone():
    """Closed form: differences in s; none over more than a second or backwards; no shorter than 0.1 ms."""
    second = 10**9
    assert period(5 * second, 5 * second + 2_000_000) == pytest.approx(2e-3)
    assert period(5 * second, 5 * second) == period(5 * second, 4 * second) == period(0, 5 * second) == 0.0
    assert period(5 * second, 5 * second + 1) == 1e-4


# ---- who commands ----


def test_two_nodes_command(bench, over_dds):
    """Both are named, also while neither sends, and none is obeyed until one is left."""
    other = over_dds("stranger")
    bench.compensator(command_timeout=0.0)
    bench.ask(HOME)
    publisher = other.create_publisher(type(pose_message(HOME, "")), "/tool_pose_command", 1)
    values = bench.until_status(ERROR, "refusing commands: several_publishers: several publishers of")
    assert bench.status().message.endswith("/tool_pose_command: /stranger, /witness")
    assert values["commanded_by"] == "/stranger, /witness"
    for sender in (bench.send, lambda pose: publisher.publish(pose_message(pose, "base"))):
        sender(MOVED)
        bench.barrier()
    assert len(bench.seen["strut_commands"]) == 1
    other.destroy_publisher(publisher)
    bench.until_status(OK, "running")
    assert bench.values()["refused.several_publishers"] in {"1", "2"}
    bench.ask(MOVED)


def test_two_nodes_may_command_where_that_is_allowed(rig, stranger):
    rig.compensator(command_timeout=0.0, allow_several_publishers=True)
    rig.ask(HOME)
    publisher = stranger.create_publisher(type(pose_message(HOME, "")), "/tool_pose_command", 1)
    rig.until(lambda: rig.values().get("commanded_by") == "/stranger, /witness", "both names")
    rig.until(lambda: publisher.get_subscription_count() == 1, "the match")
    publisher.publish(pose_message(MOVED, "base"))
    rig.until(lambda: len(rig.seen["strut_commands"]) == 2, "the stranger's answer")


def heard_from(rig: Bench, node: LifecycleNode, topic: str, count: int) -> None:
    """Wait until a node's subscription has so many publishers."""
    (end,) = [end for end in node.subscriptions if end.topic_name == topic]
    rig.until(lambda: end.get_publisher_count() == count, "the publishers to be found")


def test_ghost_of_a_killed_controller_does_not_stop_its_successor(bench, over_dds):
    """DDS keeps the dead for up to 20 s: two of one name, of which one is silent."""
    other = over_dds("witness")
    node = bench.compensator(command_timeout=0.0)
    bench.ask(HOME)
    publisher = other.create_publisher(type(pose_message(HOME, "")), "/tool_pose_command", 1)
    heard_from(bench, node, "/tool_pose_command", 2)
    for n in range(5):  # the successor counts from 1 again
        publisher.publish(pose_message(near(HOME, (0.0, 0.0, 1e-5 * n)), "base"))
        bench.until(lambda n=n: len(bench.seen["strut_commands"]) == 2 + n, "the successor's answers")
    assert bench.until_status(OK, "running")["commanded_by"] == "/witness"


def test_twins_that_both_command_are_refused(rig, twin):
    node = rig.compensator(command_timeout=0.0)
    publisher = twin.create_publisher(type(pose_message(HOME, "")), "/tool_pose_command", 1)
    heard_from(rig, node, "/tool_pose_command", 2)
    rig.ask(HOME)
    rig.ask(HOME)
    publisher.publish(pose_message(MOVED, "base"))
    rig.until(lambda: len(rig.seen["strut_commands"]) == 3, "one that may be a successor's first")
    rig.send(HOME)
    values = rig.until_status(ERROR, "refusing commands: several_publishers")
    assert values["last_refusal"].startswith("two publishers of /tool_pose_command speak in turn")
    assert len(rig.seen["strut_commands"]) == 3
    twin.destroy_publisher(publisher)
    heard_from(rig, node, "/tool_pose_command", 1)
    rig.until_status(OK, "running")
    rig.ask(HOME)


def test_somebody_else_sends_strut_commands(rig, stranger):
    """The compensator stops and names them, and the drive does not obey either."""
    drive, _ = loop(rig, command_timeout=0.0)
    rig.settle(HOME)
    publisher = stranger.create_publisher(JointState, "/strut_commands", 1)
    heard_from(rig, drive, "/strut_commands", 2)
    text = "refusing commands: several_publishers: "
    rig.until_status(ERROR, text + "/strut_commands is also published by /stranger")
    rig.until_status(ERROR, text + "several publishers of /strut_commands: /compensator, /stranger", DRIVE)
    before = measured(rig)
    publisher.publish(JointState(name=list(STRUT_NAMES), position=closed_form_lengths(MOVED).tolist()))
    rig.until(lambda: rig.values(DRIVE)["refused"] != "0", "the refusal")
    np.testing.assert_allclose(measured(rig), before, rtol=0.0, atol=1e-9)
    stranger.destroy_publisher(publisher)
    rig.until_status(OK, "running")
    rig.ask(MOVED)
    rig.until(lambda: rig.status(DRIVE).level != ERROR, "the drive to recover")
    assert rig.values(DRIVE)["commanded_by"] == "/compensator"


def test_twins_that_both_send_strut_commands_are_refused(rig, twin):
    """Two compensators of one name cannot tell each other from a ghost; the drive, which listens, can."""
    drive = rig.drive(command_timeout=0.0)
    publisher = twin.create_publisher(JointState, "/strut_commands", 1)
    heard_from(rig, drive, "/strut_commands", 2)
    home = JointState(name=list(STRUT_NAMES), position=closed_form_lengths(HOME).tolist())
    for _ in range(3):
        for speak in (publisher.publish, lambda message: rig.publish("strut_commands", message)):
            speak(home)
            rig.barrier()
    values = rig.until_status(ERROR, "refusing commands: several_publishers", DRIVE)
    assert values["last_refusal"].startswith("two publishers of /strut_commands speak in turn")


# ---- feedback ----


def test_no_feedback(rig):
    rig.compensator(command_timeout=0.0)
    rig.ask(HOME)
    assert rig.until_status(OK, "running, pose estimated from own commands")["feedback_age_s"] == "never"


def test_feedback_lost(rig):
    """Compensation goes on; the estimate comes from the commands; with the readings it recovers."""
    drive, _ = loop(rig, command_timeout=0.0)
    rig.settle(HOME)
    rig.until_status(OK, "running")
    assert rig.set_parameter(DRIVE, "fault_feedback_drop", 1.0).successful
    rig.until_status(WARN, "feedback lost, pose estimated from own commands")
    rig.ask(MOVED)
    assert rig.set_parameter(DRIVE, "fault_feedback_drop", 0.0).successful
    rig.until_status(OK, "running")
    assert drive.drive.faults.feedback_drop == 0.0


def test_following_error(rig):
    """Strut 3 stands 3 mm from its command, 2 mm are allowed: refused until a reset, also when it is back."""
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0)
    last = rig.ask(HOME)
    rig.feed(last.lengths)
    rig.ask(HOME)
    away = last.lengths + np.array([0.0, 0.0, 3e-3, 0.0, 0.0, 0.0])
    rig.feed(away)
    rig.until_status(ERROR, "refusing commands: following_error: strut_3 is at 512.")
    assert " mm from its command, allowed 2 mm" in rig.status().message
    rig.send(HOME)
    rig.until(lambda: rig.values()["refused"] == "1", "the refusal")
    assert len(rig.seen["strut_commands"]) == 2
    for _ in range(2):
        rig.feed(last.lengths)
    rig.barrier()
    rig.send(HOME)
    rig.until(lambda: rig.values()["refused"] == "2", "the refusal of a second command")
    assert rig.status().message.endswith("until ~/reset")
    rig.until(lambda: rig.trigger("reset").success, "the machine to stand")
    rig.ask(HOME)
    rig.until_status(OK, "running")


def test_following_error_ends_with_a_reset(rig):
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0)
    rig.ask(HOME)
    elsewhere = near(HOME, (0.0, 0.0, 0.05))
    rig.feed(closed_form_lengths(elsewhere))
    rig.until_status(ERROR, "refusing commands: following_error: strut_")
    assert rig.trigger("reset").success
    rig.ask(elsewhere)
    rig.until_status(OK, "running")


def test_a_reading_is_held_against_the_commands_of_its_own_time(rig):
    """It comes half a second late, as when a busy computer or network holds it up: then it is old, and not wrong."""
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0, max_reading_age=10.0, max_command_age=0.0)
    rig.ask(HOME)
    began = time.monotonic()
    for n in range(1, 21):
        rig.ask(near(HOME, (0.0, 0.0, 5e-4 * n)))
    half_way = closed_form_lengths(near(HOME, (0.0, 0.0, 5e-3)))
    rig.until(lambda: time.monotonic() > began + 0.5, "half a second to pass")
    rig.estimate(rig.feed(half_way, later=began - time.monotonic()))
    rig.ask(near(HOME, (0.0, 0.0, 1e-2)))
    rig.feed(half_way)
    rig.until_status(ERROR, "refusing commands: following_error: strut_")


def test_following_error_may_be_switched_off(rig):
    rig.compensator(command_timeout=0.0, feedback_timeout=60.0, following_error_limit=0.0)
    rig.ask(HOME)
    rig.estimate(rig.feed(closed_form_lengths(near(HOME, (0.0, 0.0, 0.05)))))
    rig.ask(HOME)
    rig.until_status(OK, "running")


# ---- restarts ----


def test_compensator_restarts_without_a_step(bench):
    """Its first command is what the struts read, then it ramps: 1 mm/s, 20 ms at most; backlash and all."""
    _, node = loop(bench)
    before = bench.settle(MOVED)
    bench.until(lambda: np.abs(measured(bench) - before.lengths).max() < 1e-9, "the struts to be there")
    end(bench, node)
    drive = bench.nodes[0]
    met(bench, drive, bench.compensator())
    bench.seen["strut_commands"].clear()
    first = bench.ask(MOVED)
    np.testing.assert_allclose(first.lengths, measured(bench), rtol=0.0, atol=1e-9)
    bench.settle(MOVED)
    sent = np.array([message.position for message in bench.seen["strut_commands"]])
    assert (np.abs(np.diff(sent, axis=0)) <= 20e-6 + ROUNDING).all()


def test_compensator_restarts_far_from_the_struts(rig):
    """5 mm from the command no correction explains it: the first command may be one step from the struts."""
    rig.compensator(feedback_timeout=60.0)
    rig.feed(closed_form_lengths(HOME))
    rig.barrier()
    rig.send(near(HOME, (0.0, 0.0, 0.005)))
    rig.until_status(ERROR, "refusing commands: step")
    rig.ask(HOME)


def test_drive_restarts(bench):
    """The simulated one stands at home again: more than the limit from the last command, which stops the machine."""
    drive, node = loop(bench, command_timeout=0.0)
    pose = HOME
    for n in range(1, 21):
        pose = near(HOME, (0.0, 0.0, 3e-4 * n))
        bench.ask(pose)
    bench.settle(pose)
    bench.until_status(OK, "running")
    end(bench, drive)
    bench.until_status(WARN, "feedback lost")
    again = bench.drive(step=0.0, encoder_resolution=0.0, encoder_noise=0.0)
    bench.until_status(ERROR, "refusing commands: following_error")
    bench.send(pose)
    bench.until(lambda: bench.values()["refused"] == "1", "the refusal")
    assert bench.trigger("reset").success
    met(bench, again, node)
    bench.ask(HOME)
    bench.until_status(OK, "running")


# ---- files ----


def test_model_is_replaced_while_it_runs(rig, tmp_path):
    """The service answers when the file has been read elsewhere; commands are answered all the while."""
    path = model_file(tmp_path, struts={"offset_um": 100.0})
    rig.compensator(model_file=path, ramp_rate=1.0, command_timeout=0.0)
    rig.ask(HOME)
    model_file(tmp_path, struts={"offset_um": -200.0})
    reply = rig.begin("reload_model")
    answered = 0
    while not reply.done():
        rig.ask(HOME)
        answered += 1
    assert reply.result().success
    assert answered > 10, "a second or so of imports, in another process"
    np.testing.assert_allclose(rig.settle(HOME).corrections, 200e-6, rtol=0.0, atol=ROUNDING)


def test_model_half_written(rig, tmp_path):
    """The old one stays; that is said for a while, counted, and the service says why."""
    path = Path(model_file(tmp_path, struts={"offset_um": 100.0}))
    rig.compensator(model_file=str(path), command_timeout=0.0)
    rig.ask(HOME)
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: len(text) // 2], encoding="utf-8")
    response = rig.trigger("reload_model")
    assert not response.success
    assert str(path) in response.message
    values = rig.until_status(WARN, "the old model stays")
    assert values["failed_reloads"] == "1"
    assert str(path) in values["last_failed_reload"]
    rig.until_status(OK, "running")
    np.testing.assert_allclose(rig.ask(HOME).corrections, -100e-6, rtol=0.0, atol=ROUNDING)


def test_one_reload_at_a_time(rig):
    rig.compensator()
    first = rig.begin("reload_model")
    second = rig.trigger("reload_model")
    assert not second.success
    assert "being loaded already" in second.message
    rig.until(first.done, "the first answer")
    assert first.result().success


def test_model_leads_out_of_its_folder(rig, tmp_path):
    """By a link made while the node runs, and by ``..`` at the start."""
    folder = tmp_path / "models"
    folder.mkdir()
    inside, outside = Path(model_file(folder)), Path(model_file(tmp_path, name="outside.yaml"))
    rig.compensator(model_file=str(inside))
    inside.unlink()
    inside.symlink_to(outside)
    response = rig.trigger("reload_model")
    assert not response.success
    assert f"leads to {outside}, but files are only read from {folder}" in response.message
    sneaky = rig.compensator(start=False, model_folder=str(folder), model_file=f"{folder}/../outside.yaml")
    sneaky.trigger_configure()
    (line,) = rig.logged("cannot configure")
    assert f"leads to {outside}" in line


def test_files_by_name_in_the_model_folder(rig, tmp_path):
    model_file(tmp_path, name="mine.yaml", struts={"offset_um": 100.0})
    rig.compensator(model_folder=str(tmp_path), model_file="mine.yaml")
    np.testing.assert_allclose(rig.ask(HOME).corrections, -100e-6, rtol=0.0, atol=ROUNDING)


def test_model_folder_must_be_one(rig, tmp_path):
    with pytest.raises(ParameterError, match=r"parameter model_folder: '.*nowhere' is not a folder"):
        rig.compensator(start=False, model_folder=str(tmp_path / "nowhere"))


def test_model_is_no_regular_file(rig, tmp_path):
    """A pipe that nobody writes into would be waited for without end."""
    path = Path(model_file(tmp_path))
    rig.compensator(model_file=str(path))
    path.unlink()
    os.mkfifo(path)
    response = rig.trigger("reload_model")
    assert not response.success
    assert f"{path}: is not a regular file" in response.message


def test_model_too_large(rig, tmp_path):
    path = Path(model_file(tmp_path))
    rig.compensator(model_file=str(path))
    with path.open("ab") as stream:
        stream.truncate(9_000_000)
    response = rig.trigger("reload_model")
    assert not response.success
    assert "larger than the allowed 8 MB" in response.message


# ---- configuration ----


def test_frames_of_one_name_are_refused(rig):
    with pytest.raises(ParameterError, match="work_frame: must differ from base_frame, 'machine'"):
        rig.compensator(start=False, base_frame="machine", work_frame="machine")


def test_shipped_models_survive_the_way_through_the_loading_process():
    """Every number bit for bit, by the saved text of both."""
    from hexapod_comp.formats.json import json_text
    from hexapod_comp.machine.geometry import load_geometry
    from hexapod_comp.machine.model_file import load_model

    geometry = load_geometry(CONFIG / "paper.yaml")
    for name in ("paper_machine.yaml", "paper_lines_model.yaml"):
        model = load_model(CONFIG / name, geometry)
        again = pickle.loads(pickle.dumps(model))
        assert json_text(again) == json_text(model)
        assert {name: type(value) for name, value in vars(again).items()} == {
            name: type(value) for name, value in vars(model).items()
        }
        for one, other in zip(again.field.lines, model.field.lines, strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(again.struts.map_values, model.struts.map_values)
        assert again.origin == model.origin


@pytest.mark.parametrize("active", [True, False], ids=["active", "inactive"])
def test_after_a_shutdown_nothing_is_published(rig, active):
    """Before, heartbeats, journal, diagnostics and readings went on. Without a timer nothing comes by itself."""
    nodes = rig.drive(), rig.compensator()
    rig.ask(HOME)
    for node in nodes:
        name = node.get_name()
        if not active:
            assert rig.change("deactivate", name)
        request = ChangeState.Request()
        request.transition.label = "shutdown"
        assert rig.call(ChangeState, f"{name}/change_state", request).success
        assert rig.state(name) == "finalized"
        assert not list(node.timers)
        rig.until(lambda name=name: rig.message(name).startswith("not active"), "a last status")
        theirs = {p.topic_name for p in node.publishers}
        assert theirs <= {"/rosout", "/parameter_events", "/diagnostics", f"/{name}/transition_event"}
    seen = {topic: len(messages) for topic, messages in rig.seen.items()}
    rig.send(HOME)
    rig.barrier()
    assert seen == {topic: len(messages) for topic, messages in rig.seen.items()}


def test_two_machines_of_a_kind_have_other_hardware_ids(ros_context, capfd):
    """What monitors of a whole plant tell machines apart by."""
    with Bench(ros_context, capfd, "/left") as left, Bench(ros_context, capfd, "/hall/right") as right:
        for rig in (left, right):
            rig.drive()
            rig.compensator()
        for rig, place in ((left, "left"), (right, "hall/right")):
            rig.until(lambda b=rig: b.values("strut_drive") and b.values(), "statuses")
            assert {rig.status(name).hardware_id for name in ("compensator", "strut_drive")} == {f"{place}/paper"}
