"""Verbs of running machines, with stand-ins for the machine: what they ask of it, print and return."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import hexapod

from hexapod_comp.calibration import design
from hexapod_comp.cli import measuring
from hexapod_comp.cli.running import journal_lines
from hexapod_comp.errors import CommandError, HexapodError
from hexapod_comp.loop.report import PoseRecord, SessionResult
from hexapod_comp.measurements.collect import RunSetUp
from hexapod_comp.pose import Pose
from hexapod_comp.upkeep.loop import Outcome

OWN = ((-0.3, -0.3, 0.2), (0.3, 0.3, 0.5))  # the largest that the machine reaches
BOX = ((-0.1, -0.2, 0.3), (0.1, 0.2, 0.4))


class StandIn:
    """A context manager that records how it was made, and has the attributes that it is given."""

    def __init__(self, calls: list[Any], **attributes: Any) -> None:
        self.calls = calls
        self.__dict__ |= attributes

    def __call__(self, *given: Any, **options: Any) -> StandIn:
        self.calls.append((*given, {name: value for name, value in options.items() if not callable(value)}))
        return self

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None:
        self.calls.append("closed")


@pytest.fixture
def signals(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the list of received signals; real signals keep their usual effect."""
    received: list[int] = []
    monkeypatch.setattr("hexapod_comp.ros.received_signals", lambda: received)
    return received


def test_move_sends_the_target_and_brakes_on_a_signal(signals: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def move(pose: Pose, frame: str, relative: bool, progress: Any) -> None:
        calls.append((pose.position.tolist(), frame, relative))
        for received in ([], [2]):
            signals.extend(received)
            progress(SimpleNamespace(state="moving", share=0.5, time_left=1.0))

    last = SimpleNamespace(state="arrived", text="after 2.00 s", stopped_by="")
    machine = StandIn(calls, last=last, move=move, stop=lambda: calls.append("stop"))
    monkeypatch.setattr("hexapod_comp.ros.client.Machine", machine)
    words = ("move", "--pose", "1,2,3", "--relative", "--frame", "tool", "--namespace", "a")
    assert hexapod(*words) == (0, "arrived: after 2.00 s\n", "")
    assert calls == [("a", {}), ([0.001, 0.002, 0.003], "tool", True), "stop", "closed"]
    calls.clear()
    assert json.loads(hexapod("move", "--stop", "--json")[1]) == vars(last)
    assert calls == [("", {}), "stop", "closed"]


@pytest.mark.parametrize(("missing", "code"), [([], 0), (["x line, stop 3"], 1)])
def test_collect(missing: list[str], code: int, signals: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def collect(*given: Any, progress: Any, going_on: Any, tracker_frame: str) -> Any:
        calls.append((given[1].name, given[3:], tracker_frame))
        progress(0, 12, "x line")
        assert going_on()
        signals.append(2)
        assert not going_on()
        return SimpleNamespace(measurements=range(12 - len(missing)), missing=missing, resumed=4)

    monkeypatch.setattr("hexapod_comp.ros.collector.WatchedMachine", StandIn(calls, refuse_other=calls.append))
    monkeypatch.setattr("hexapod_comp.measurements.collect.collect", collect)
    monkeypatch.setattr(measuring, "template", lambda *_: range(12))
    typed = "collect --campaign campaign_1d --out m.csv --topic t --readings r --samples 7"
    note = "hexapod_comp: note: no readings at x line, stop 3; run the same command again to complete the file\n"
    found = hexapod(*typed.split(), "--tracker-frame", "free", "--seed", 5, "--namespace", "a")
    assert found == (code, f"{12 - len(missing)} of 12 readings: m.csv\n", note * code)
    told = {"readings": "r", "tracker_frame": "free", "samples": 7}
    assert calls == [("t", "a", told), "paper", ("paper", ("m.csv", 5), "free"), "closed"]
    signals.clear()
    content = {"machine": "paper", "readings": 12 - len(missing), "planned": 12, "missing": missing, "written": "m.csv"}
    assert json.loads(hexapod(*typed.split(), "--json")[1]) == content | {"resumed_stops": 4}


def test_a_set_up_is_confirmed_by_enter(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for channels, where in (
        (("linear", "straightness"), "from ({}) mm in base along (1.000, 0.000, 0.000)"),
        (("length",), "at ({}) mm in base"),
    ):
        monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
        run = RunSetUp("x line", channels, Pose(np.array([0.1, -0.2, 0.3]), np.eye(3)))
        measuring._confirmed(run)
        asked = f"\nset up {', '.join(channels)} for x line, {where.format('100.0, -200.0, 300.0')}, then press Enter "
        assert capsys.readouterr() == ("", asked)
    with pytest.raises(CommandError, match="the set-up for x line was not confirmed"):
        measuring._confirmed(run)


WIDE = "--box=-200,-300,200,200,300,600"
BEGUN = {"goal_m": 2e-6, "box_m": BOX, "level": np.eye(3).tolist()}


@pytest.mark.parametrize(
    ("words", "begun", "goal", "every", "calls", "state", "code"),
    [
        ("--goal-um 3", {}, 3e-6, 600.0, [("calibrate", False)], "in use", 0),
        ("--checks 0", BEGUN, 2e-6, 600.0, [("calibrate", False)], "in use", 0),
        ("--every-min 5 --reload", BEGUN, 2e-6, 300.0, [("calibrate", False), ("guard", None)], "in use", 0),
        ("--checks 3 --every-min 1", {}, None, 60.0, [("calibrate", False), ("guard", 3)], "in use", 0),
        (f"--checks 2 --anew {WIDE}", BEGUN, None, 600.0, [("calibrate", True), ("guard", 2)], "in use", 0),
        ("--checks 2", BEGUN, 2e-6, 600.0, [("calibrate", False)], "refused", 1),
        ("--verify", BEGUN, 2e-6, 600.0, [("guard", 1)], "stopped", 130),
        ("--campaign campaign_1d", BEGUN, None, 600.0, [("calibrate", False)], "in use", 0),
    ],
)
def test_adapt(
    words: str, begun: dict, goal: float | None, every: float, calls: list, state: str, code: int,
    signals: list[int], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Options and the folder's journal give the task and the calls of the loop; its outcome gives the exit code."""
    made: list[Any] = []
    asked: list[Any] = []
    outcome = Outcome(state, "a text", None)

    def call(name: str) -> Any:
        return lambda value: asked.append((name, value)) or outcome

    machine = StandIn(asked, reload="reload", runs="runs", refuse_unreadable=lambda path: made.append(str(path)))
    machine.refuse_other = asked.append  # type: ignore[attr-defined]
    monkeypatch.setattr("hexapod_comp.ros.collector.AdaptedMachine", machine)
    loop = SimpleNamespace(events=[], state=SimpleNamespace(promised_in_use=np.nan), calibrate=call("calibrate"))
    loop.guard = call("guard")
    monkeypatch.setattr("hexapod_comp.upkeep.loop.Adaptation", lambda *given, runs: made.append(given) or loop)
    monkeypatch.setattr("hexapod_comp.formats.adapt_journal.sole_user", lambda folder: contextlib.nullcontext())
    monkeypatch.setattr("hexapod_comp.upkeep.loop.begun_with", lambda folder: begun)
    monkeypatch.setattr("hexapod_comp.workspace.reach.machine_box", lambda geometry: (np.array(OWN), np.eye(3), None))
    found = hexapod("adapt", "--folder", "f", "--topic", "t", "--samples", 9, "--json", *words.split())
    assert found[0] == code
    assert json.loads(found[1]) == {
        "machine": "paper", "state": state, "text": "a text", "model": None, "promised_m": None, "events": []
    }  # fmt: skip
    *checked, (geometry, _, task, folder, reload, *_) = made
    assert (checked, reload) == ((["f/model.yaml"], "reload") if "--reload" in words else ([], None))
    assert (geometry.name, folder, task.goal, task.every) == ("paper", "f", goal, every)
    assert (task.campaign is not None) == ("--campaign" in words)
    if task.campaign is None:
        wide = ((-0.2, -0.3, 0.2), (0.2, 0.3, 0.6))
        np.testing.assert_allclose(task.box, wide if WIDE in words else OWN if begun == {} else BOX)
    assert asked == [("t", "", {"samples": 9}), "paper", *calls, "closed"]


@pytest.mark.parametrize(
    ("journal", "problem", "code", "text", "err"),
    [
        (2, "", 0, "written: b", ""),
        (0, "", 1, "written: b", "note: no compensator published, so this recording cannot be replayed"),
        (2, "the disk is full", 2, "recording ended early", "error: b: the disk is full"),
        (0, "the disk is full", 2, "recording ended early", "error: b: the disk is full"),
    ],
)
def test_record(
    journal: int, problem: str, code: int, text: str, err: str, signals: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(going_on: Any, progress: Any) -> None:
        assert going_on()
        progress(3)
        signals.append(15)
        assert not going_on()

    recorder = StandIn([], counts={"b": 13, "a": 2}, problem=problem, journal=journal, run=run)
    monkeypatch.setattr("hexapod_comp.ros.recorder.BagRecorder", recorder)
    begun = "hexapod_comp: recording to b until Ctrl-C\n"
    after = f"hexapod_comp: {err}\n" if err else ""
    assert hexapod("record", "--out", "b") == (code, f"       2  a\n      13  b\n{text}\n", begun + after)
    assert recorder.calls == [("b", "", {}), "closed"]


def test_watch_serves_until_a_signal(signals: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    page = StandIn(calls, address="http://x", show="show", close=lambda: calls.append("page closed"))
    monkeypatch.setattr("hexapod_comp.viewer.page.WatchPage", page)
    monkeypatch.setattr(
        "hexapod_comp.viewer.page.watch", lambda _, *given: calls.append((given[0], given[1](), given[2]))
    )
    shown = "hexapod_comp: paper is shown on http://x until Ctrl-C\n"
    assert hexapod("watch", "--host", "h", "--port", 81, "--namespace", "a") == (0, "", shown)
    assert calls[0][1:] == ("h", 81, {})
    assert calls[1:] == [("show", True, "a"), "page closed"]


def test_echo(signals: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Two messages arrive every 0.3 s by the stand-in's clock; the rate is printed once a second."""
    clock = [100.0]
    intervals = SimpleNamespace(count=0)
    intervals.text = lambda: f"{intervals.count} messages"
    intervals.record = lambda: {"count": intervals.count}
    shown: list[Any] = []

    def spin_once(period: float) -> None:
        clock[0] += 0.3
        for shown_to in shown * 2:
            intervals.count += 1
            text = f"m{intervals.count}"
            shown_to(SimpleNamespace(text=lambda text=text: text, record=lambda text=text: {"n": text}))

    def watch(node: object, spin: object, topic: str, print_message: Any) -> Any:
        intervals.count, shown[:] = 0, [print_message]
        return SimpleNamespace(topic=f"/{topic}", intervals=intervals)

    topics = {"/a": "Pose", "/b": "String"}
    monkeypatch.setattr("hexapod_comp.cli.running.time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr("hexapod_comp.ros.process.RosSession", StandIn([], node=None, spin_once=spin_once))
    monkeypatch.setattr("hexapod_comp.ros.echo.Echo", watch)
    monkeypatch.setattr("hexapod_comp.ros.echo.published_topics", lambda node: topics)
    assert hexapod("echo") == (0, "/a  Pose\n/b  String\n", "")
    assert hexapod("echo", "t", "--count", 3) == (0, "m1\n\nm2\n\nm3\n\n", "/t: 4 messages\n")
    assert hexapod("echo", "t", "--count", 4)[1:] == ("m1\n\nm2\n\nm3\n\nm4\n\n", "/t: 4 messages\n")
    assert hexapod("echo", "t", "--count", 1, "--json") == (0, '{"n": "m1"}\n', "")
    rates = "/t: 8 messages\n/t: 14 messages\n"
    assert hexapod("echo", "t", "--hz", "--seconds", 2.5) == (0, rates, "/t: 18 messages\n")
    assert json.loads(hexapod("echo", "t", "--hz", "--json", "--seconds", 1)[1]) == {"topic": "/t", "count": 8}
    signals.append(2)
    assert hexapod("echo", "t") == (1, "", "/t: 0 messages\n")
    topics.clear()
    assert hexapod("echo")[0] == 1


def test_the_journal_as_text() -> None:
    """Lengths are in µm; – stands for a value that is not known."""
    check = {"event": "checked", "model": "n.yaml", "readings": "c.csv", "found_m": 1.234e-6, "promised_m": 3e-6}
    check |= {"ran_m": 9e-6, "applied": False}
    events = [
        {"event": "begun"},
        {"event": "planned", "expected_m": None},
        {"event": "planned", "expected_m": 2.5e-6, "campaign": "p.yaml"},
        {"event": "collected", "count": 9, "readings": "r.csv", "missing": []},
        {"event": "collected", "count": 7, "readings": "r.csv", "missing": ["a", "b"]},
        {"event": "fitted", "enough": True, "model": "m.yaml", "promised_m": 3e-6},
        {"event": "fitted", "enough": False, "model": None, "promised_m": None, "short": "too few readings"},
        check | {"good": True, "moved_m": 5e-6},
        check | {"good": False, "promised_m": None, "text": "strut_1"},
        {"event": "repaired", "text": "strut_1", "model": "n.yaml", "of": "m.yaml"},
        {"event": "adopted", "model": "n.yaml"},
        check | {"good": True, "moved_m": None},
        check | {"good": False, "text": "strut_1"},
        {"event": "ended", "state": "in use", "text": "done"},
        {"event": "skipped", "reason": "busy"},
    ]
    assert [line.removeprefix("T  ") for line in journal_lines([{"time": "T", **event} for event in events])] == [
        "begun",
        "planned       campaign: as given",
        "planned       campaign: p.yaml, 2.50 µm RMS expected",
        "collected     9 readings: r.csv",
        "collected     7 readings: r.csv, no readings at 2 stops",
        "fitted        m.yaml, up to 3.00 µm RMS (95 %)",
        "fitted        not enough: too few readings",
        "checked       c.csv shows 1.23 µm, 3.00 µm promised; confirmed; all positions have shifted together, by 5.0 "
        "µm: base, workpiece or instrument has moved",
        "checked       c.csv shows 1.23 µm, – promised; strut_1",
        "repaired      strut_1; n.yaml updates m.yaml",
        "adopted       n.yaml",
        "checked       c.csv shows 1.23 µm, 3.00 µm promised; confirmed; the running machine's tool error was 9.00 µm "
        "RMS: the compensator did not run this model, or struts did not reach their commands",
        "checked       c.csv shows 1.23 µm, 3.00 µm promised; strut_1",
        "ended         in use: done",
        "skipped       busy",
    ]


def test_a_plan_has_the_goal_of_its_options(monkeypatch: pytest.MonkeyPatch) -> None:
    """Masses other than the payload's have its centre of mass; a gravity of another attitude has the payload's mass."""
    given: list[Any] = []

    def propose(place: Any, goal: Any, settings: Any, base: Any, progress: Any) -> Any:
        given.append((place, goal, base))
        raise HexapodError("enough")

    monkeypatch.setattr(design, "propose", propose)
    options = "--tilt-deg 10 --instruments linear,tracker --hours 3 --time linear=5,2,1 --repeatability-um 2"
    loads = ("--tools-kg", "0,1,2", "--gravity", "0,9.81,0", "--gravity", "9.81,0,0")
    for words in ((*options.split(), *loads), ()):
        assert hexapod("plan", "campaign_1d", "--goal-um", 2, *words)[::2] == (2, "hexapod_comp: error: enough\n")
    assert hexapod("plan", "--goal-um", 2)[2] == "hexapod_comp: error: enough\n"  # campaign_5d, which gives a box
    (place, goal, base), (_, plain, _), _ = given
    assert (base.repeatability, place.tilt) == (2e-6, pytest.approx(np.radians(10.0)))
    times = {**design.TIMES, "linear": design.Times(300.0, 120.0, 1.0)}
    wanted = design.Goal(2e-6, float(np.radians(10.0)), ("linear", "tracker"), 10800.0, times, goal.loads)
    assert goal == wanted
    assert plain == design.Goal(2e-6, 0.0, times=dict(design.TIMES))
    of_mass, of_attitude = (
        [[m, 0, 0, 0, *[np.nan] * 3] for m in (1, 2)],
        [[0] * 4 + g for g in ([0, 9.81, 0], [9.81, 0, 0])],
    )
    np.testing.assert_array_equal(goal.loads, of_mass + of_attitude)
    monkeypatch.setattr(design, "propose", lambda *_: SimpleNamespace(met=False, campaign=base))
    monkeypatch.setattr(design, "proposal_report", lambda _: "the goal is not met\n")
    monkeypatch.setattr("hexapod_comp.cli.fitting._detours", lambda *_: ["via home"])
    assert hexapod("plan", "campaign_1d", "--goal-um", 2) == (
        1,
        "the goal is not met\n",
        "hexapod_comp: note: via home\n",
    )


@pytest.mark.parametrize(("lost", "refused", "code"), [(0, 0, 0), (1, 0, 1), (0, 1, 1)])
def test_a_run_fails_if_a_command_stays_unanswered(
    monkeypatch: pytest.MonkeyPatch, lost: int, refused: int, code: int
) -> None:
    """Only then a busy computer is worth a note. An attached machine is never moved without compensation."""
    given: list[tuple[Any, ...]] = []

    def run_poses(*arguments: Any) -> SessionResult:
        given.append(arguments)
        return SessionResult(
            [PoseRecord(pose) for pose in arguments[2]], lost=lost, refused=refused, busy="it was busy"
        )

    monkeypatch.setattr("hexapod_comp.loop.session.run_poses", run_poses)
    note = "hexapod_comp: note: it was busy\n" * code
    assert hexapod("run", "table1.csv", "--attach", "--rate-hz", 100)[::2] == (code, note)
    ((_, nodes, poses, *options),) = given
    assert (nodes, len(poses), options) == ((), 10, [100.0, False, ""])
