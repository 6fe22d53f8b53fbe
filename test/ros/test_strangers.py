"""Messages and names from unknown participants must not end a node, forge its log, or fill its memory.

The participants are real ones on DDS, and their messages are real; the nodes' output is read from stderr and
/diagnostics.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from hal_stand_in import StandInHal
from lifecycle_msgs.srv import ChangeState
from node_helpers import HOME, RELIABLE, Bench, Stranger, closed_form_lengths
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from sensor_msgs.msg import JointState, Temperature

from hexapod_comp.errors import LONGEST_TEXT, CommandError, HexapodError, printable, shorten
from hexapod_comp.linuxcnc.bridge import LinuxcncBridgeNode
from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.base import ERROR, CallbackGuard
from hexapod_comp.ros.compensator_state import MachineFiles
from hexapod_comp.ros.messages import pose_message
from hexapod_comp.ros.rclpy_compat import publishers

FORGED = "base\n[INFO] [1.0] [compensator]: all is well\r\x1b[2J\x1b[31m\u202e"
"""A text that begins its own line, clears the terminal, colours it, and reverses the direction of what follows."""

HUGE = FORGED + 200_000 * "x"  # longer messages are refused unparsed: test_wire.py


def bridge(rig: Bench) -> LinuxcncBridgeNode:
    """Add a LinuxCNC bridge on a machine that is on; the witness sends no commands any more."""
    rig.remove_publisher("tool_pose_command")
    rig.remove_publisher("strut_states")
    hal = StandInHal()
    node = rig.add(LinuxcncBridgeNode, True, {"rate": 250.0, "timeout": 1.0}, hal=hal)
    for n, length in enumerate(closed_form_lengths(HOME)):
        hal[f"joint-fb.{n}"] = float(length) * 1e3
    hal["z"] = 400.0
    hal["machine-on"] = hal["enable"] = True
    return node


NODES: dict[str, Callable[[Bench], Any]] = {
    "compensator": lambda rig: rig.compensator(),
    "strut_drive": lambda rig: rig.drive(),
    "linuxcnc_bridge": bridge,
}


# ---- a participant whose name is not UTF-8 ----


def test_a_name_that_rclpy_cannot_return_is_said() -> None:
    """rclpy 7.1 raises an error if a node's name is not UTF-8, or if the graph has another surprise."""

    def fails(_: str) -> None:
        b"mill\xff\x1b[31m".decode()

    assert publishers(SimpleNamespace(get_publishers_info_by_topic=fails), "/commands") == (
        (),
        r"a node's name is not UTF-8: b'mill\xff\x1b[31m'",
    )
    names, said = publishers(SimpleNamespace(get_publishers_info_by_topic=broken), "/commands")
    assert (names, said.startswith("ZeroDivisionError: ")) == ((), True)


@pytest.mark.parametrize(
    ("name", "topic", "said"),
    [
        ("compensator", "strut_commands", "/strut_commands is also published by a node whose name cannot be read"),
        ("strut_drive", "strut_commands", "the publisher of /strut_commands is unknown: a node whose name"),
        ("linuxcnc_bridge", "strut_corrections", "the publisher of /strut_corrections is unknown: a node whose name"),
    ],
)
def test_nobody_obeys_whom_it_cannot_name(rig, monkeypatch, name, topic, said):
    unknown = (), "a node whose name cannot be read"
    monkeypatch.setattr("hexapod_comp.ros.base.publishers", lambda node, asked: unknown if topic in asked else ((), ""))
    NODES[name](rig)
    voice = Stranger(rig, "stranger").create_publisher(JointState, topic)
    rig.step(0.1)
    rig.send(HOME) if name == "compensator" else voice.publish(strange_struts("strut_1"))
    rig.until(lambda: rig.values(name).get("refused.unknown_publisher") == "1", "the refusal")
    assert (rig.status(name).level, "unknown_publisher" in rig.message(name)) == (ERROR, True)
    assert said in rig.values(name)["last_refusal"]
    assert rig.values(name)["callback_errors"] == "0"
    assert name == "strut_drive" or not rig.seen["strut_commands"]


# ---- no callback ends a node ----


def test_a_transition_that_raises_is_said(rig, monkeypatch):
    """rclpy swallows the error, and the node stopped answering without a message."""
    rig.compensator(start=False)
    rig.may_catch = True
    monkeypatch.setattr(MachineFiles, "geometry", lambda files: 1 / 0)
    assert not rig.change("configure")
    assert rig.logged("error in a callback, the node keeps running: on_configure: ZeroDivisionError")


@pytest.mark.parametrize("name", NODES)
def test_all_that_ros_calls_goes_through_the_guard(rig, name):
    node = NODES[name](rig)
    callbacks = [entity.callback for kind in (node.subscriptions, node.timers, node.services) for entity in kind]
    assert len(callbacks) > 12
    assert {callback.__code__.co_filename.rpartition("/")[2] for callback in callbacks} == {
        "base.py",
        "rclpy_compat.py",
    }


def test_a_middleware_without_events_of_matching_opens_topics_too(rig):
    def make(**options: object) -> str:
        if options:
            raise UnsupportedEventTypeError
        return "made"

    node = rig.compensator(start=False)
    assert node._when_matched("commands", SubscriptionEventCallbacks, make, broken) == "made"


def broken(*_: object, **__: object) -> None:
    raise ZeroDivisionError("nobody has foreseen this\x1b[2J\n[INFO] [1.0] [compensator]: all is well")


@pytest.mark.parametrize(
    ("what", "owner", "method"),
    [
        ("tool_pose_command", "compensator", "step"),
        ("check_state", "", "acting_guard"),
        ("matching of tool_pose_command", "", "update_publishers"),
    ],
)
def test_a_callback_that_raises_is_counted_and_said_and_the_node_goes_on(rig, monkeypatch, what, owner, method):
    node = rig.compensator()
    rig.may_catch = True
    rig.ask(HOME)
    with monkeypatch.context() as patch:
        patch.setattr(getattr(node, owner) if owner else node, method, broken)
        rig.send(HOME)
        rig.add_publisher("tool_pose_command") if what.startswith("matching") else None
        rig.until(lambda: what in node.guard.values()["last_callback_error"], "the error to be caught")
    values = rig.until_status(ERROR, "error in a callback")
    assert int(values["callback_errors"]) > 0
    assert "ZeroDivisionError: nobody has foreseen this" in values["last_callback_error"]
    assert values["last_callback_error"].isprintable()
    assert rig.logged("error in a callback, the node keeps running: ")
    rig.until(lambda: "callback" not in rig.status().message, "the error to be past")
    rig.ask(HOME)


def test_a_service_that_raises_answers_no(rig, monkeypatch):
    node = rig.compensator()
    monkeypatch.setattr(node.compensator, "reset", broken)
    answer = rig.trigger("reset")
    assert not answer.success
    assert answer.message.startswith("nobody has foreseen this")
    assert answer.message.isprintable()
    assert node.guard.values()["refused_requests"] == "1"
    assert rig.logged("reset refused: ")


def test_the_guard_of_the_spin_loop_holds_whatever_comes():
    said: list[str] = []
    guard = CallbackGuard(lambda *_: None, lambda _, text: said.append(text))
    assert guard.around("spinning", broken, "otherwise")(1, two=2) == "otherwise"
    assert guard.around("spinning", lambda one: one)(1) == 1
    assert len(said) == 1
    assert "test_strangers.py" in said[0]
    with pytest.raises(KeyboardInterrupt):
        guard.around("spinning", lambda: (_ for _ in ()).throw(KeyboardInterrupt()))()


# ---- foreign texts are shown on one line, shortened, and not kept ----


def strange_struts(text: str) -> JointState:
    return JointState(name=[text, *STRUT_NAMES[1:]], position=[0.5] * 6)


def strange_temperature(text: str) -> Temperature:
    message = Temperature(temperature=20.0)
    message.header.frame_id = text
    return message


DOORS = {
    "frame_id": ("compensator", "tool_pose_command", lambda text: pose_message(HOME, text)),
    "measured": ("compensator", "strut_states", strange_struts),
    "sensor": ("compensator", "temperatures", strange_temperature),
    "commanded": ("strut_drive", "strut_commands", strange_struts),
    "correction": ("linuxcnc_bridge", "strut_corrections", strange_struts),
}


@pytest.mark.parametrize("door", DOORS)
def test_text_in_a_message_neither_forges_a_line_nor_fills_anything(rig, door):
    name, topic, message = DOORS[door]
    NODES[name](rig)
    publisher = rig._publishers.get(topic) or rig.witness.create_publisher(JointState, topic, RELIABLE)
    counter = "bad_feedback" if topic in ("strut_states", "temperatures") else "refused"
    stranger = message(HUGE)
    for count in range(1, 4):
        if isinstance(stranger, JointState):
            stranger.header.stamp = rig.now()
        publisher.publish(stranger)
        rig.until(lambda count=count: int(rig.values(name).get(counter, "0")) >= count, "a refusal")
    assert_harmless(rig)
    if name == "compensator":
        assert len(rig.nodes[0]._journal._journal.page(0.0)) < 20_000


def assert_harmless(rig: Bench) -> None:
    """Check that every line in the log and in the diagnostics is ours, short and printable."""
    rig.barrier()
    rig.logged("")
    lines = rig._log.splitlines()
    assert lines
    assert not [line for line in lines if line.startswith("[INFO] [1.0]") or not line.isprintable()]
    assert max(map(len, lines)) < LONGEST_TEXT + 200
    for name in NODES:
        for status in rig.statuses(name):
            texts = [status.message, *(entry.value for entry in status.values)]
            assert all(text.isprintable() and len(text) <= LONGEST_TEXT for text in texts)


def test_text_in_a_request_neither_forges_a_line_nor_is_shown_whole(rig):
    """rclpy and rcl quote a transition's label, a parameter's name and its value when they refuse them."""
    rig.compensator()
    rig.drive()
    request = ChangeState.Request()
    request.transition.label = FORGED
    assert not rig.call(ChangeState, "compensator/change_state", request).success
    for name, text in ((FORGED, "x"), ("fault_jump", FORGED), ("fault_jump", HUGE)):
        parameter = ParameterMessage(name=name)
        parameter.value.type, parameter.value.string_value = 4, text
        answer = rig.call(SetParameters, "strut_drive/set_parameters", SetParameters.Request(parameters=[parameter]))
        assert not answer.results[0].successful
    assert_harmless(rig)


def test_a_flood_of_refused_requests_gives_a_line_a_second(rig):
    """This holds for our lines and rclpy's: an impossible or unknown transition, a parameter of a wrong type."""
    node = rig.compensator()
    wrong, untyped = ParameterMessage(name="use_sim_time"), ParameterMessage(name="use_sim_time")
    wrong.value.type, wrong.value.string_value = 4, "yes"
    untyped.value.type = 255
    possible, unknown = ChangeState.Request(), ChangeState.Request()
    possible.transition.id, unknown.transition.label = 1, "fly"  # configure: the node is active
    rig.logged("")
    before = len(rig._log.splitlines())
    for _ in range(100):
        for request in (possible, unknown):
            assert not rig.call(ChangeState, "compensator/change_state", request).success
        for parameter in (wrong, untyped):
            request = SetParameters.Request(parameters=[parameter])
            assert not rig.call(SetParameters, "compensator/set_parameters", request).results[0].successful
    assert rig.logged("there is no transition")
    said = rig._log.splitlines()[before:]
    assert len(said) <= 8, "at most two from each, all within the same second"
    assert int(node.guard.values()["refused_requests"]) >= 300


def test_names_of_files_and_parameters_do_not_forge_a_line(rig, tmp_path):
    rig.compensator(start=False, **{"model_file": str(tmp_path / f"{FORGED}.yaml"), f"modell_file{FORGED}": "x"})
    assert not rig.change("configure")
    assert rig.logged("there is no parameter modell_file")
    assert rig.logged("cannot configure: ")
    assert_harmless(rig)


@pytest.mark.parametrize("text", [FORGED, 3000 * "\x1b", 5000 * "x", "\ud800", "", "ordinary, 4 µm ± 1 °"])
def test_every_error_of_ours_is_one_short_printable_line(text):
    """The truth for printable text is Python's repr; a printable and short text stays unchanged."""
    for error in (HexapodError(text), CommandError("frame_id", text)):
        said = str(error)
        assert said.isprintable()
        assert len(said) <= LONGEST_TEXT
        assert said == text or not text.isprintable() or len(text) > LONGEST_TEXT
        assert printable(said, LONGEST_TEXT) == said
    assert len(shorten(text)) <= 80
    assert shorten(text) == repr(text) or len(repr(text)) > 80
