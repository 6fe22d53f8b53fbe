"""Compensator and drive in every case of doc/states.md, most of them as stories of a node.

Stories run in one process on the test's own clock; cases that need DDS follow them. Levels and texts are those of the
page. Lengths come from the closed form of the paper's machine, numbers in texts from its limits.
"""

from __future__ import annotations

import ast
import inspect
import os
import re
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from lifecycle_msgs.srv import ChangeState
from node_helpers import CONFIG, HOME, RELIABLE, Bench, Rig, closed_form_lengths, geometry_file, model_file, near
from node_stories import (
    ERROR,
    FED,
    NEVER,
    OK,
    WARN,
    Step,
    ask,
    change,
    feed,
    holds,
    joins,
    leaves,
    moisten,
    other,
    passes,
    play,
    poses,
    refuses,
    reset,
    says,
    seen,
    send,
    shows,
    struts,
    tell,
    warm,
)
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from hexapod_comp.compensation import guards
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.journal import LARGEST_SOURCE, Source
from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.files import read_text
from hexapod_comp.formats.paths import confined_opener
from hexapod_comp.machine.geometry import STRUT_NAMES, load_geometry
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.ros import base
from hexapod_comp.ros.base import CommandedNode
from hexapod_comp.ros.compensator import CompensatorNode
from hexapod_comp.ros.compensator_state import CompensatorState
from hexapod_comp.ros.messages import pose_message
from hexapod_comp.ros.strut_drive import StrutDriveNode
from hexapod_comp.ros.worker import Worker

DRIVE = "strut_drive"
STATES = Path(__file__).resolve().parents[2] / "doc" / "states.md"
MOVED = near(HOME, (0.0002, 0.0001, -0.0003))
ROUNDING = 1e-12
QUIET = {"command_timeout": 0.0}
TWO = "several_publishers: several publishers of "


@pytest.fixture(autouse=True)
def short_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time for which an event affects a status from one or two seconds to 0.3 s."""
    monkeypatch.setattr(guards, "SHOWN_FOR", 0.3)
    monkeypatch.setattr(guards, "IN_TURN_HELD", 0.3)


def boxed(folder: Path) -> dict[str, object]:
    """Return parameters with a model that was measured within 5 mm of home."""
    x, y, z = (1e3 * HOME.position).tolist()
    box = [[x - 5.0, y - 5.0, z - 5.0], [x + 5.0, y + 5.0, z + 5.0]]
    return {"model_file": model_file(folder, region={"box_mm": box}), **QUIET}


def singular(folder: Path) -> dict[str, object]:
    """Return a machine whose condition number at home is 5 % below the limit; the warning begins at 10 %."""
    geometry = load_geometry("paper")
    core = Compensator(geometry, load_model("paper_machine", geometry))
    core.correct(HOME)
    return {"geometry_file": geometry_file(folder, {"condition_number": 1.05 * core.condition}), **QUIET}


def expanding(folder: Path) -> dict[str, object]:
    """Return parameters with a model whose struts grow by 12 ppm/K and 2 ppm per % of humidity."""
    struts = {"expansion_ppm_per_K": 12.0, "moisture_ppm_per_percent": 2.0}
    return {"model_file": model_file(folder, struts=struts), "ramp_rate": 1.0, **QUIET}


def all_warm(*parts: str) -> list[Step]:
    return [warm(part, 21.0) for part in parts or STRUT_NAMES]


def sensor(part: str, temperature: float) -> Callable[[Rig], Temperature]:
    message = Temperature(temperature=temperature)
    message.header.frame_id = part
    return lambda rig: message


WAITING = "waiting for strut_states: the struts' positions are not known"
UNFED = "no strut_states yet: the struts' lengths are unknown"

STORIES: dict[str, tuple[dict[str, object] | Callable[[Path], dict[str, object]], list[Step]]] = {
    # ---- commands ----
    "no command yet": ({}, [says(OK, "waiting for the first command"), seen(strut_commands=0)]),
    "near a singularity": (
        singular,
        [ask(), says(WARN, "running, near a singularity"), send(tilt=40), refuses("condition")],
    ),
    "outside the measured box": (
        boxed,
        [
            *(ask(), says(OK, "running", outside_box="false"), *(ask(x) for x in range(1, 7))),
            says(
                WARN,
                "running, outside the box in which the model was measured",
                outside_box="true",
                measured_box="sides 10 × 10 × 10 mm",
            ),
            *(*(ask(x) for x in range(5, -1, -1)), says(OK, "running")),
        ],
    ),
    "a field that refuses extrapolation": (
        lambda folder: {"model_file": model_file(folder, field=narrow_field())},
        [ask(), send(1.5), refuses("outside_field", "(1.500, 0.000, 400.000) mm")],
    ),
    "after a reset stamps may start earlier": (
        {"max_command_age": 0.0},
        [ask(), reset, send(later=-0.3), seen(strut_commands=2)],
    ),
    "what is refused does not count as the last command": (
        {},
        [ask(), send(z=50, later=0.4), refuses("step"), ask(z=0.1)],
    ),
    "reasons are counted apart": (
        QUIET,
        [
            ask(),
            *(step for _ in range(3) for step in (send(frame="map"), refuses("frame_id"), send(z=10), refuses("step"))),
            *(shows(refused="6", refused__frame_id="3", refused__step="3"), ask(), says(OK, "running", refused="6")),
            holds(lambda rig: len(rig.logged("command refused (step)")) < 3, "a line per cause and second"),
        ],
    ),
    # ---- who commands, who measures ----
    "several may command where that is allowed": (
        {**QUIET, "allow_several_publishers": True},
        [
            *(ask(), joins("tool_pose_command"), shows(commanded_by="/stranger, /witness")),
            *(other(poses(0.2)), seen(strut_commands=2)),
        ],
    ),
    "twins that both command": (
        QUIET,
        [
            *(joins("tool_pose_command", "witness"), ask(), ask(), other(poses(0.2)), seen(strut_commands=3), send()),
            refuses("several_publishers", "two publishers of /tool_pose_command send in turn"),
            *(seen(strut_commands=3), leaves, says(OK, "running"), ask()),
        ],
    ),
    "a second publisher of measured struts": (
        FED,
        [
            *(feed(0), ask(), joins("strut_states")),
            refuses(TWO + "/strut_states", measured_by="/stranger, /witness", end="/strut_states: /stranger, /witness"),
            *(send(), feed(0), seen(strut_commands=1, tool_pose_estimate=1), shows(bad_feedback="1"), leaves),
            *(says(OK, "running", measured_by="/witness"), ask()),
        ],
    ),
    "several may measure where that is allowed": (
        {**FED, "allow_several_publishers": True},
        [
            *(joins("strut_states"), shows(measured_by="/stranger, /witness"), feed(0), ask()),
            *(other(struts(0)), seen(tool_pose_estimate=2)),
        ],
    ),
    "a second publisher of temperatures": (
        expanding,
        [
            *(ask(), moisten(0.4), warm("strut_3", 25.0), *all_warm(*(set(STRUT_NAMES) - {"strut_3"}))),
            joins("temperatures"),
            says(
                ERROR,
                f"temperatures ignored: {TWO}/temperatures: /stranger, /witness",
                temperatures_by="/stranger, /witness",
            ),
            *(warm("strut_3", 25.5), ask(), leaves, says(OK, "running", temperature__strut_3_degC="25.00")),
        ],
    ),
    "several thermometers where that is allowed": (
        {**QUIET, "allow_several_thermometers": True},
        [
            *(joins("temperatures"), warm("strut_3", 25.0), other(sensor("base", 24.0))),
            shows(temperature__base_degC="24.00", temperature__strut_3_degC="25.00"),
        ],
    ),
    # ---- feedback ----
    "never any feedback": (
        QUIET,
        [ask(), says(OK, "running, pose estimated from own commands", feedback_age_s="never")],
    ),
    "feedback that is lost": (
        {**QUIET, "feedback_timeout": 0.2},
        [
            *(feed(0), ask(), says(WARN, "feedback lost, pose estimated from own commands"), ask(z=0.2), feed()),
            shows(pose_estimated_from="strut_states"),
        ],
    ),
    "feedback is required": (
        {**QUIET, "require_feedback": True, "feedback_timeout": 0.3},
        [
            *(send(), refuses("no_feedback", "no strut_states yet"), feed(0), ask(), says(WARN, "feedback lost")),
            *(send(), refuses("no_feedback", refused__no_feedback="2"), seen(strut_commands=1)),
        ],
    ),
    "own commands are not taken for measured": (
        FED,
        [
            *(feed(0), ask(z=0.2), passes(0.1), seen(tool_pose_estimate=1)),
            says(OK, "running, the corrections are ramping", pose_estimated_from="strut_states"),
        ],
    ),
    "a reading from the future or the past": (
        FED,
        [
            *(feed(0, later=0.6), says(ERROR, "bad feedback: stamp_future"), seen(tool_pose_estimate=0)),
            *(feed(0, later=-0.6), says(ERROR, "bad feedback: stamp_past"), seen(tool_pose_estimate=0)),
            *(feed(0, later=0.4), feed(0), seen(tool_pose_estimate=2)),
            *(feed(0, later=-0.2), says(ERROR, "bad feedback: stamp_order"), seen(tool_pose_estimate=2)),
        ],
    ),
    "a reading that cannot be is no start": (
        FED,
        [
            *(feed(0), feed(200), says(ERROR, "bad feedback: jump", last_bad_feedback="has jumped by")),
            *(seen(tool_pose_estimate=1), ask()),
            lambda rig: np.testing.assert_array_equal(
                rig.seen["strut_commands"][-1].position, closed_form_lengths(HOME)
            ),
        ],
    ),
    "a reading that cannot be stops the machine": (
        FED,
        [
            *(feed(0), ask(), feed(0, {3: 0.2})),
            says(ERROR, "refusing commands: following_error: strut_3", last_bad_feedback="jump"),
        ],
    ),
    "a following error": (
        FED,
        [
            *(ask(), feed(), ask(), feed(off={3: 3e-3})),
            *(refuses("following_error: strut_3 is at 512."), send(), shows(refused="1"), seen(strut_commands=2)),
            *(feed(), feed(), send(), shows(refused="2"), refuses("following_error", end="until ~/reset")),
            *(change("deactivate", "activate"), feed(), refuses("following_error", "mm from its command, allowed 2")),
            *(reset, ask(), says(OK, "running")),
        ],
    ),
    "a strut that is away for one reading": (
        FED,
        [
            *(ask(), feed(), feed(off={4: 3e-3}, later=0.03), feed(later=0.06)),
            says(ERROR, "refusing commands: following_error: strut_4", last_bad_feedback="strut_4"),
            holds(lambda rig: "bad feedback: following_error" in rig.message(), "said beside the problem"),
        ],
    ),
    "a reading is held against the commands of its own time": (
        {**FED, "max_reading_age": 10.0, "max_command_age": 0.0},
        [
            *(ask(), *(ask(z=0.5 * n) for n in range(1, 21)), passes(0.5), feed(5, later=-0.5), ask(z=10)),
            *(shows(bad_feedback="0"), feed(5), refuses("following_error: strut_")),
        ],
    ),
    "following errors may be switched off": (
        {**FED, "following_error_limit": 0.0},
        [ask(), feed(50), ask(), says(OK, "running")],
    ),
    # ---- starts and ends ----
    "a start waits for the struts": (
        {**FED, **NEVER},
        [
            *(says(WARN, WAITING), send(), refuses(f"no_feedback; {WAITING}", UNFED), seen(strut_commands=0)),
            *(feed(0), send(z=5), refuses("step"), ask()),
        ],
    ),
    "a start is at most one step from the measured struts": (
        FED,
        [
            *(feed(50), send(z=55)),
            refuses("step", "allowed 2 mm", what_to_do="continue from the last answered", last_answered="0.000000000"),
            *(ask(z=51), seen(strut_commands=1)),
        ],
    ),
    "struts that were moved while the node was inactive": (
        FED,
        [
            *(feed(0), ask(), change("deactivate"), feed(50, later=0.3), change("activate"), send(), refuses("step")),
            ask(z=50),
        ],
    ),
    "struts that were moved and are stale": (
        {},
        [
            *(ask(), change("deactivate"), passes(0.2), feed(50), change("activate")),
            *(says(WARN, "no new command; feedback lost"), send(), refuses("step"), ask(z=50)),
        ],
    ),
    "a reset starts from the measured struts": (
        FED,
        [ask(), send(z=50), refuses("step"), feed(50), reset, send(), ask(z=50), seen(strut_commands=2)],
    ),
    "a reset while the machine moves": (
        FED,
        [
            *(feed(0), ask(), ask(z=0.2), lambda rig: answered(rig, "refused while the machine moves: strut_", "0.")),
            *(says(WARN, "reset refused while the machine moves", log="asked for by /witness"), reset),
            *(feed(), feed(off=dict.fromkeys(range(1, 7), 1e-3)), feed(off=dict.fromkeys(range(1, 7), 2e-3))),
            lambda rig: answered(rig, "refused while the machine moves: strut_", "moved by 2."),
        ],
    ),
    "an inactive node replays nothing": (
        {"start": False, **FED},
        [
            *(change("configure"), send(z=50), says(WARN, "not active", commands="0"), change("activate")),
            *(says(OK, "waiting for the first command", refused="0"), ask(), seen(strut_commands=1)),
        ],
    ),
    "a deactivated node is silent": (
        {},
        [
            *(ask(), passes(0.1), change("deactivate"), send(), feed(0), warm("nonsense", np.nan)),
            *(seen(strut_commands=1, tool_pose_estimate=1), says(WARN, "not active", bad_feedback="0")),
        ],
    ),
    # ---- temperatures and humidity ----
    "a wild temperature": (
        {**QUIET, "temperature_time_constant_s": 0.0},
        [
            *(*all_warm(), warm("strut_2", 119.0)),
            says(
                *(ERROR, "bad feedback: temperature"),
                last_bad_feedback="temperature of strut_2: has jumped from 21.00 to 119.00 °C in",
            ),
            *(
                shows(temperature__strut_2_degC="21.00"),
                warm("strut_2", 21.5),
                shows(temperature__strut_2_degC="21.50"),
            ),
        ],
    ),
    "a thermometer that the model needs is missing": (
        expanding,
        [
            *(ask(), *all_warm(*STRUT_NAMES[:4]), moisten(0.4)),
            says(WARN, "temperatures not received: strut_5, strut_6; taken as 20 °C"),
            *(*all_warm(*STRUT_NAMES[4:]), says(OK, "running")),
        ],
    ),
    "a thermometer falls silent": (
        {**QUIET, "temperature_timeout": 0.3},
        [
            *(ask(), *all_warm("strut_3", "base")),
            says(
                *(WARN, "temperatures stale: strut_3, base"),
                stale_temperatures="strut_3, base",
                temperature__base_degC="21.00",
            ),
        ],
    ),
    "a hygrometer that jumps and falls silent": (
        {**QUIET, "temperature_timeout": 0.3},
        [
            *(ask(), moisten(0.4), moisten(0.9)),
            says(ERROR, "bad feedback: humidity", last_bad_feedback="humidity: has jumped from 0.40 to 0.90"),
            says(WARN, "humidity stale", humidity_percent="40.0"),
        ],
    ),
}


DRIVES: dict[str, tuple[dict[str, object], list[Step]]] = {
    "a first command further than a step": (
        QUIET,
        [
            *(passes(0.1), tell(0, {1: 2.5e-3}), says(ERROR, "refusing commands: step", DRIVE)),
            *(tell(0, {1: 1.9e-3}), says(OK, "running", DRIVE)),
        ],
    ),
    "commands that are in turn too fast": (
        QUIET,
        [
            *(tell(0, dict.fromkeys(range(1, 7), 1e-3 * n)) for n in range(50)),
            says(ERROR, "refusing commands: ", DRIVE, log="mm ahead of a motion at 250 mm/s, allowed 27 mm"),
            holds(lambda rig: int(rig.values(DRIVE)["commands"]) >= 25, "a bunch of 0.1 s may come at once"),
        ],
    ),
    "overtaken commands": (
        {"rate": 50.0},
        [
            *(tell(0, later=0.0), tell(0, {1: 1e-4}, later=-0.05)),
            says(ERROR, "refusing commands: stamp_order", DRIVE),
            *(tell(0, {2: 1e30}, later=0.0), says(ERROR, "refusing commands: step", DRIVE)),
            lambda rig: np.testing.assert_array_equal(rig.nodes[0].drive.commands, closed_form_lengths(HOME)),
        ],
    ),
    "commands that are no longer valid": (
        {"command_validity": 0.3},
        [
            tell(0, later=-0.5),
            says(ERROR, "refusing commands: stamp_past", DRIVE, last_refusal="s old, allowed 0.3 s"),
            *(tell(0, later=0.0), shows(DRIVE, commands="1")),
        ],
    ),
    "twins that both send strut commands": (
        QUIET,
        [
            joins("strut_commands", "witness"),
            *(step for _ in range(3) for step in (other(struts(0)), tell(0))),
            says(ERROR, "refusing commands: several_publishers", DRIVE, last_refusal="/strut_commands send in turn"),
        ],
    ),
}


def narrow_field() -> dict[str, object]:
    """Return a field of 1 µm within 1 mm of home that refuses commands outside."""
    lines = [{"axis": "x", "at": [i, j], "direction": "both", "dx_um": [1.0]} for i in (0, 1) for j in (0, 1)]
    grid = {"grid_x_mm": [-1.0, 1.0], "grid_y_mm": [-1.0, 1.0], "grid_z_mm": [399.0, 401.0]}
    return {**grid, "outside": "refuse", "lines": lines}


def answered(rig: Rig, begin: str, part: str) -> None:
    response = rig.trigger("reset")
    assert not response.success
    assert response.message.startswith(begin)
    assert part in response.message


@pytest.mark.parametrize("story", STORIES)
def test_story(rig: Rig, tmp_path: Path, story: str) -> None:
    parameters, steps = STORIES[story]
    rig.compensator(**(parameters(tmp_path) if callable(parameters) else parameters))
    play(rig, steps)


@pytest.mark.parametrize("story", DRIVES)
def test_story_of_a_drive(rig: Rig, story: str) -> None:
    parameters, steps = DRIVES[story]
    rig.drive(encoder_noise=0.0, truth_file="ideal", **parameters)
    play(rig, steps)


# ---- the page ----


def test_every_row_names_a_test_that_is_there() -> None:
    """A row's last column names a story in brackets, a test of this file, or file::test; each story has a row."""
    rows = [line for line in STATES.read_text(encoding="utf-8").splitlines() if line.startswith("| ")][1:]
    rows = [row for row in rows if not re.match(r"\| (Case|Phase|[A-Z_]+) \|", row)]
    assert len(rows) >= 30
    told = set()
    for row in rows:
        cell = row.rsplit("|", 2)[1]
        stories = re.findall(r"`\[(.+?)\]`", cell)
        names = re.findall(r"`(?:(test_\w+\.py)::)?(test_\w+)`", cell)
        assert names or stories, row
        assert set(stories) <= STORIES.keys() | DRIVES.keys(), row
        told.update(stories)
        for file, name in names:
            paths = Path(__file__).parents[1].rglob(file or "test_states.py")
            assert any(f"def {name}(" in path.read_text(encoding="utf-8") for path in paths), f"{file}::{name}"
    assert told == STORIES.keys() | DRIVES.keys()


@pytest.mark.parametrize(
    ("function", "count"), [(CompensatorState.findings, 20), (StrutDriveNode.findings, 5), (CommandedNode.refusing, 2)]
)
def test_the_page_has_every_text_of_the_diagnostics(function: Callable[..., object], count: int) -> None:
    page = re.sub(r"[A-Z]{2,}|…", "", STATES.read_text(encoding="utf-8"))
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    texts = []
    for found in ast.walk(tree):
        if isinstance(found, ast.Yield) and isinstance(found.value, ast.Tuple):
            text = found.value.elts[1]
            for part in (text.body, text.orelse) if isinstance(text, ast.IfExp) else (text,):
                texts.append(part.values[0] if isinstance(part, ast.JoinedStr) else part)
    known = [text.value.rstrip(": ") for text in texts if isinstance(text, ast.Constant)]
    assert len(known) >= count
    assert [text for text in known if text not in page] == []


# ---- cases with numbers ----


@pytest.mark.parametrize("hours", [-1.0, 1.0])
def test_clock_is_set(rig, hours):
    """Sender and node share the clock: commands continue at once, and a ramp in progress does not step."""
    rig.compensator(command_timeout=0.0, ramp_rate=1e-4)
    before = rig.ask(HOME)
    rig.enable(False)
    rig.clock.set_by = round(hours * 3600e9)
    assert np.abs(rig.ask(HOME).lengths - before.lengths).max() <= 1e-4 * 0.02 + ROUNDING
    way = "back" if hours < 0.0 else "forward"
    play(rig, [shows(**{f"clock_set_{way}": "1"})])
    assert rig.logged(f"the clock was set {way} by 3600.")


def test_a_full_log_disk_is_said_beside_everything_else(rig, monkeypatch):
    monkeypatch.setattr(base, "log_problem", lambda: "log disk full: /var/log")
    rig.drive()
    rig.until(lambda: rig.status(DRIVE), "a status")
    assert (rig.status(DRIVE).level, rig.message(DRIVE).endswith("log disk full: /var/log")) == (WARN, True)


# ---- both nodes ----


def loop(rig: Bench, **compensator: object) -> tuple[StrutDriveNode, CompensatorNode]:
    """Start both nodes, the drive with the shipped machine's backlash and without noise; wait until they connect."""
    drive = rig.drive(step=0.0, encoder_resolution=0.0, encoder_noise=0.0)
    node = rig.compensator(**compensator)
    met(rig, drive, node)
    return drive, node


def met(rig: Bench, drive: LifecycleNode, compensator: LifecycleNode) -> None:
    """Wait until both nodes are connected and readings have come."""
    ends = {end.topic_name: end for end in (*compensator.publishers, *compensator.subscriptions)}
    (heard,) = [end for end in drive.subscriptions if end.topic_name == "/strut_commands"]
    rig.until(lambda: heard.get_publisher_count() == 1, "the drive to hear the compensator")
    rig.until(lambda: ends["/strut_states"].get_publisher_count() == 1, "the compensator to hear the drive")
    rig.seen["strut_states"].clear()
    rig.until(lambda: rig.values().get("pose_estimated_from") == "strut_states", "feedback")


def measured(rig: Bench) -> np.ndarray:
    return np.array(rig.seen["strut_states"][-1].position)


def test_commands_end(rig):
    loop(rig)
    last = rig.settle(HOME)
    rig.until_status(WARN, "no new command")
    assert float(rig.until_status(WARN, "no new command", DRIVE)["command_age_s"]) >= 0.1
    assert rig.seen["strut_commands"][-1].header.stamp == last.command.header.stamp
    np.testing.assert_allclose(measured(rig), last.lengths, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(rig.ask(HOME).lengths, last.lengths, rtol=0.0, atol=ROUNDING)
    rig.until(lambda: rig.ask(HOME) and rig.message() == rig.message(DRIVE) == "running", "both to run again")


def test_somebody_else_sends_strut_commands(rig):
    """The compensator stops and names the other publishers, and the drive refuses both."""
    loop(rig, command_timeout=0.0)
    rig.settle(HOME)
    joins("strut_commands")(rig)
    text = "refusing commands: several_publishers: "
    rig.until_status(ERROR, text + "/strut_commands is also published by /stranger")
    rig.until_status(ERROR, text + "several publishers of /strut_commands: /compensator, /stranger", DRIVE)
    before = measured(rig)
    other(struts(0.2))(rig)
    rig.until(lambda: rig.values(DRIVE)["refused"] != "0", "the refusal")
    np.testing.assert_allclose(measured(rig), before, rtol=0.0, atol=1e-9)
    leaves(rig)
    rig.until_status(OK, "running")
    rig.ask(MOVED)
    rig.until(lambda: rig.status(DRIVE).level != ERROR, "the drive to recover")
    assert rig.values(DRIVE)["commanded_by"] == "/compensator"


@pytest.mark.parametrize("active", [True, False], ids=["active", "inactive"])
def test_after_a_shutdown_nothing_is_published(rig, active):
    """Heartbeats, journal, diagnostics and readings had continued; without timers nothing is published."""
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
    before = {topic: len(messages) for topic, messages in rig.seen.items()}
    send()(rig)
    assert before == {topic: len(messages) for topic, messages in rig.seen.items()}


def test_compensator_restarts_without_a_step(rig):
    """The first command equals the measured struts; then it ramps at 1 mm/s, 20 ms at most, with backlash."""
    drive, node = loop(rig)
    before = rig.settle(MOVED)
    rig.until(lambda: np.abs(measured(rig) - before.lengths).max() < 1e-9, "the struts to be there")
    node.trigger_deactivate()
    rig.nodes.remove(node)
    node.destroy_node()
    met(rig, drive, rig.compensator())
    rig.seen["strut_commands"].clear()
    first = rig.ask(MOVED)
    np.testing.assert_allclose(first.lengths, before.lengths, rtol=0.0, atol=1e-9)
    rig.settle(MOVED)
    sent = np.array([message.position for message in rig.seen["strut_commands"]])
    assert (np.abs(np.diff(sent, axis=0)) <= 20e-6 + ROUNDING).all()


# ---- cases that need DDS ----


@pytest.fixture
def over_dds(bench: Bench) -> Iterator[Callable[[str], Node]]:
    """Provide a function that makes a real node with a name."""
    nodes: list[Node] = []

    def make(name: str) -> Node:
        nodes.append(rclpy.create_node(name, context=bench.context))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()


def test_overload_keeps_the_newest_and_counts_the_others(bench):
    """With 105 commands waiting and a queue of a hundred, five are counted as missed, and no late one is executed."""
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


def test_simulated_time_starts_again(bench):
    """A simulation is reset: its clock falls from 100 s to 1 s."""
    bench.compensator(use_sim_time=True, command_timeout=0.0)
    bench.until(lambda: "use_sim_time: no time from /clock yet" in bench.message(), "a warning")
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


def test_two_nodes_command(bench, over_dds):
    """Both publishers are named, even while neither sends, and commands are refused until one of them has gone."""
    stranger = over_dds("stranger")
    bench.compensator(command_timeout=0.0)
    bench.ask(HOME)
    publisher = stranger.create_publisher(type(pose_message(HOME, "")), "/tool_pose_command", 1)
    values = bench.until_status(ERROR, f"refusing commands: {TWO}")
    assert bench.status().message.endswith("/tool_pose_command: /stranger, /witness")
    assert values["commanded_by"] == "/stranger, /witness"
    for sender in (bench.send, lambda pose: publisher.publish(pose_message(pose, "base"))):
        sender(MOVED)
        bench.barrier()
    assert len(bench.seen["strut_commands"]) == 1
    stranger.destroy_publisher(publisher)
    bench.until_status(OK, "running")
    assert bench.values()["refused.several_publishers"] in {"1", "2"}
    bench.ask(MOVED)


def test_ghost_of_a_killed_controller_does_not_stop_its_successor(bench, over_dds):
    """DDS keeps a dead node for up to 20 s, so there are two nodes of one name, of which one is silent."""
    successor = over_dds("witness")
    node = bench.compensator(command_timeout=0.0)
    bench.ask(HOME)
    publisher = successor.create_publisher(type(pose_message(HOME, "")), "/tool_pose_command", 1)
    (heard,) = [one for one in node.subscriptions if one.topic_name == "/tool_pose_command"]
    bench.until(lambda: heard.get_publisher_count() == 2, "the publishers to be found")
    for n in range(5):  # the successor counts from 1 again
        publisher.publish(pose_message(near(HOME, (0.0, 0.0, 1e-5 * n)), "base"))
        bench.until(lambda n=n: len(bench.seen["strut_commands"]) == 2 + n, "the successor's answers")
    assert bench.until_status(OK, "running")["commanded_by"] == "/witness"


# ---- files ----


def test_one_reload_at_a_time_and_commands_are_answered_meanwhile(bench, tmp_path):
    """The service answers after another process has read the file, which takes about a second of imports."""
    path = model_file(tmp_path, struts={"offset_um": 100.0})
    bench.compensator(model_file=path, ramp_rate=1.0, command_timeout=0.0)
    bench.ask(HOME)
    model_file(tmp_path, struts={"offset_um": -200.0})
    reply, count = bench.begin("reload_model"), 0
    second = bench.begin("reload_model")
    while not reply.done():
        bench.ask(HOME)
        count += 1
    assert reply.result().success
    assert count > 10
    assert (second.result().success, "already being loaded" in second.result().message) == (False, True)
    np.testing.assert_allclose(bench.settle(HOME).corrections, 200e-6, rtol=0.0, atol=ROUNDING)


def half_written(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: len(text) // 2], encoding="utf-8")


RELOADS: dict[str, tuple[Callable[[Path], object], str]] = {
    "not there": (Path.unlink, "no such file"),
    "half-written": (half_written, "model.yaml"),
    "another machine's": (lambda path: model_file(path.parent, machine="somebody else's"), "'paper'"),
    "too large": (lambda path: os.truncate(path, 9_000_000), "larger than the allowed 8 MB"),
}


@pytest.mark.parametrize("case", RELOADS)
def test_a_model_that_cannot_be_reloaded_leaves_the_old_one(rig, tmp_path, case):
    """The failure is shown for a while and counted, and the service's answer has the reason with the file's name."""
    spoil, text = RELOADS[case]
    (tmp_path / "models").mkdir()
    path = Path(model_file(tmp_path / "models", struts={"offset_um": 100.0}))
    rig.compensator(model_file=str(path), command_timeout=0.0)
    rig.ask(HOME)
    spoil(path)
    response = rig.trigger("reload_model")
    assert not response.success
    assert response.message.startswith("the old model stays: ")
    assert text in response.message
    assert str(path) in response.message
    assert text in rig.until_status(WARN, "the old model stays")["last_failed_reload"]
    assert rig.values()["failed_reloads"] == "1"
    rig.until_status(OK, "running")
    np.testing.assert_allclose(rig.ask(HOME).corrections, -100e-6, rtol=0.0, atol=ROUNDING)


def field(displacement_um: float) -> dict[str, object]:
    """Return a field that is constant along z over the whole workspace."""
    lines = [
        {"axis": "z", "at": [i, j], "direction": "both", "dz_um": [displacement_um]} for i in (0, 1) for j in (0, 1)
    ]
    grid = {"grid_x_mm": [-200, 200], "grid_y_mm": [-200, 200], "grid_z_mm": [350, 550]}
    return {**grid, "lines": lines}


def test_a_model_that_breaks_a_limit_at_the_last_command_moves_nothing(rig, tmp_path):
    """A field of 5 mm needs more than the allowed correction of 2 mm, and the service says so at once. Before the first
    command the machine is assumed to be at home."""
    path = model_file(tmp_path, struts={"offset_um": 100.0})
    node = rig.compensator(model_file=path, ramp_rate=1.0, command_timeout=0.0)
    before = dict(node.files.sources)
    model_file(tmp_path, field=field(5000.0))
    early = rig.trigger("reload_model")
    assert (early.success, "is larger than ±2000 µm" in early.message) == (False, True)
    rig.ask(HOME)
    response = rig.trigger("reload_model")
    assert not response.success
    assert "the old model stays: strut_" in response.message
    assert "is larger than ±2000 µm" in response.message
    assert node.files.sources == before, "the journal must not name a model that is not in use"
    rig.until_status(WARN, "the old model stays")
    for _ in range(3):
        np.testing.assert_allclose(rig.ask(HOME).corrections, -100e-6, rtol=0.0, atol=ROUNDING)
    model_file(tmp_path, field=field(1000.0))
    assert rig.trigger("reload_model").success


def test_compensation_is_not_switched_on_where_it_breaks_a_limit(rig, tmp_path):
    """The model is within the limit at home, but not higher up, where the tool moved without compensation."""
    steep = field(0.0)
    for line in steep["lines"]:
        line["dz_um"] = [2000.0, 4000.0]  # −2 mm at z = 350 mm, 0 at 400 mm, 6 mm at 550 mm
    rig.compensator(model_file=model_file(tmp_path, field=steep), command_timeout=0.0, ramp_rate=1.0)
    rig.ask(HOME)
    assert rig.enable(False).success
    rig.settle(HOME)
    for step in range(1, 71):
        last = rig.ask(near(HOME, (0.0, 0.0, 1e-3 * step)))
    response = rig.enable(True)
    assert not response.success
    assert "is larger than ±2000 µm" in response.message
    assert not rig.ask(near(HOME, (0.0, 0.0, 0.07))).corrections.any()
    assert not last.corrections.any()


# ---- no wait without an end ----


def test_the_node_itself_does_not_touch_the_file(bench, tmp_path, monkeypatch):
    """An access to a file on a dead mount never returns, so only another process may make it."""
    path = model_file(tmp_path)
    bench.compensator(model_file=path)
    for module, name in ((os, "stat"), (os, "lstat"), (os, "open"), (os, "readlink")):
        real = getattr(module, name)

        def watched(place, *arguments, real=real, **options):
            assert str(tmp_path) not in os.fsdecode(place if not isinstance(place, int) else b"")
            return real(place, *arguments, **options)

        monkeypatch.setattr(module, name, watched)
    response = bench.trigger("reload_model")
    assert response.success, response.message


def wanted(place: Path, folder: Path) -> dict:
    return {"name": "model.yaml", "place": str(place), "folder": str(folder), "machine": "paper"}


def outcome(name: str, arguments: dict, within: float = 60.0) -> list:
    """Let a worker do a job; return its result or error."""
    beside, found = Worker(), []
    late = f"could not be read in {within:g} s"
    beside.ask(name, arguments, found.append, found.append, within=within, late=late)
    end = time.monotonic() + 60.0
    while not found and time.monotonic() < end:
        beside.poll(time.monotonic())
        time.sleep(0.01)
    beside.close()
    return found


def test_a_worker_does_one_job_after_the_other_and_ends_its_process_after_ten_seconds(monkeypatch):
    """Two jobs at once would take each other's answers from the process."""
    beside, doing, at_once, done = Worker(), [], [], []

    def do(task, *_):
        doing.append(task)
        at_once.append(len(doing))
        time.sleep(0.01)
        return doing.pop()

    monkeypatch.setattr(beside._process, "do", do)
    for task in "ab":
        beside.ask(task, {}, done.append, done.append)
    assert (beside.busy("b"), beside.busy("c")) == (True, False)
    while len(done) < 2:
        beside.poll(time.monotonic())
    assert (done, at_once, beside.busy("b")) == (["a", "b"], [1, 1], False)
    ended, idle = time.monotonic(), SimpleNamespace(kill=lambda: done.append("killed"), wait=lambda: None)
    beside._process.popen = idle
    beside.poll(ended + 9.9)
    assert beside.process is idle
    beside.poll(ended + 10.1)
    assert (beside.process, done[2:]) == (None, ["killed"])


def test_a_file_that_is_never_read_is_given_up_in_time(tmp_path, monkeypatch):
    never = tmp_path / "never"
    never.write_text("#!/bin/sh\necho $$ > ${0}.pid\nexec sleep 60\n")
    never.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(never))
    began = time.monotonic()
    (error,) = outcome("load_model", wanted(tmp_path, tmp_path), 0.5)
    assert str(error) == "could not be read in 0.5 s"
    assert time.monotonic() - began < 5.0
    process = int((tmp_path / "never.pid").read_text())
    while time.monotonic() - began < 5.0 and Path(f"/proc/{process}").exists():
        time.sleep(0.01)
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_what_takes_the_files_place_after_the_look_at_its_name_is_refused(tmp_path):
    """A pipe that nobody writes would block its reader; a link may lead out of the folder."""
    (tmp_path / "mine").mkdir()
    outside, pipe, link = tmp_path / "outside.yaml", tmp_path / "pipe", tmp_path / "mine" / "model.yaml"
    outside.write_text("a: 1")
    os.mkfifo(pipe)
    link.symlink_to(outside)
    with pytest.raises(InputFileError, match="is not a regular file"):
        read_text(pipe, confined_opener(tmp_path))
    with pytest.raises(InputFileError, match=f"names the file {outside}, but only files in"):
        read_text(link, confined_opener(tmp_path / "mine"))
    assert read_text(link, confined_opener(tmp_path)) == "a: 1"


@pytest.mark.parametrize("padding", [0, LARGEST_SOURCE])
def test_the_loading_process_hands_back_what_it_has_read(tmp_path, padding):
    """It returns the text for the journal and the model; of a long file only the hash."""
    text = (CONFIG / "paper_machine.yaml").read_text(encoding="utf-8") + f"# {'é' * padding}\n"
    path = tmp_path / "model.yaml"
    path.write_text(text, encoding="utf-8")
    ((model, source),) = outcome("load_model", wanted(tmp_path, Path()))
    assert model.name == "virtual machine"
    whole = Source.of(str(path), text)
    assert (source.name, source.sha256) == (whole.name, whole.sha256)
    assert source.text == (None if padding else text)
