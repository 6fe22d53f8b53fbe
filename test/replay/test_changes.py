"""Each change that a journal may hold, tools and frames included: its entry, its snapshot, and the bits of a replay.

The truth is the compensator that was recorded; other tests cover its arithmetic."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_machines import Errors, with_frames
from replay_helpers import CONFIG, RecordedMachine, wave_pose, write_bag

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.journal import ENTRIES, SETTERS, read_page
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load, Loading
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.pose import Pose
from hexapod_comp.replay.bag import Recording, read_recording
from hexapod_comp.replay.replay import replay_recording, what_if
from hexapod_comp.replay.report import Report, tool_positions

LOADING = Loading.of([1.0, 0.0, -9.7], [5.0] * 6)
DRIFT = (1e-6 * np.arange(12.0)).tolist()

CHANGES: dict[str, list[tuple[tuple[Any, ...], dict[str, Any]]]] = {
    "temperature": [
        (("base", 23.5, 5.0), {"name": "base", "value": 23.5, "time": 5.0}),
        (("strut_2", 19.0, np.nan), {"name": "strut_2", "value": 19.0, "time": np.nan}),
    ],
    "humidity": [((0.61, 12.5), {"value": 0.61, "time": 12.5})],
    "drift": [((DRIFT,), {"value": DRIFT}), (([0.0] * 12,), {"value": [0.0] * 12})],
    "load": [((LOADING,), {"value": LOADING}), ((Loading(),), {"value": Loading()})],
    "outside": [
        (({"elevation": 0.4},), {"value": {"elevation": 0.4}}),
        (({"elevation": 0.8},), {"value": {"elevation": 0.8}}),
    ],
    "enable": [((False,), {"on": False}), ((True,), {"on": True})],
    "ramp_rate": [((5e-4,), {"value": 5e-4})],
    "tool": [(("tool",), {"name": "tool"})],
    "reset": [((None,), {"measured": None}), (([0.5] * 6,), {"measured": [0.5] * 6})],
}
"""By name of the change: the setter's arguments, and the journal's entry."""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a model that every change of :data:`CHANGES` affects."""
    known = load_model(CONFIG / "paper_machine.yaml", load_geometry("paper"))
    sag = np.outer([10e-6, 40e-6], [0.1, 0.0, -1.0])
    table = OutsideTable(("elevation",), ("rad",), (np.array([0.0, 1.5]),), sag, 0.2 * sag)
    struts = replace(known.struts, expansion=np.full(6, 11e-6), moisture=np.full(6, 2e-4))
    load = Load(stiffness=np.full(6, 20e6), mass=30.0)
    file = tmp_path_factory.mktemp("changes") / "model.yaml"
    save_model(replace(known, struts=struts, base_expansion=11e-6, load=load, outside=table), file)
    return file


@pytest.mark.parametrize("what", CHANGES)
def test_a_change_is_written_restored_and_replayed(what: str, model: Path, tmp_path: Path) -> None:
    assert CHANGES.keys() == SETTERS.keys() == ENTRIES.keys() - {"model", "refused"}
    machine = RecordedMachine(model=model)
    machine.wave(10)
    machine.page(snapshot=False)
    count = 10
    for arguments, entry in CHANGES[what]:
        getattr(machine.compensator, SETTERS[what])(*arguments)
        machine.elapsed += 1.0
        page = read_page(machine.journal.page(machine.elapsed))
        assert [(one.what, str(one.values)) for one in page.entries] == [(what, str(entry))]
        assert page.snapshot is not None
        other = Compensator(machine.geometry, machine.compensator.model)
        other.restore(page.snapshot.state)
        assert str(other.snapshot()) == str(machine.compensator.snapshot())
    machine = RecordedMachine(model=model)
    machine.wave(10)
    for n, (arguments, _) in enumerate(CHANGES[what]):
        getattr(machine.compensator, SETTERS[what])(*arguments)
        machine.wave(1, count - 1)  # the first command with another tool must be where the struts are
        if what == "reset":
            machine.compensator.reset()
        machine.wave(20, count)
        count += 20
        machine.page(snapshot=n == 0)
    result = replay_recording(read_recording(write_bag(tmp_path / "bag", machine.messages)))
    assert (result.identical, result.states_differ, result.compared) == (True, [], len(machine.answers))
    assert len({answer.tobytes() for answer in machine.answers}) > 20


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[RecordedMachine, Recording, Path]:
    """Return 240 commands in all frames with three tools in turn, a refused tool and a refused command; the model."""
    machine, folder = with_frames("framed"), tmp_path_factory.mktemp("recorded")
    model = Errors.drawn(machine, 5).write(folder / "model.yaml", machine)
    run = RecordedMachine("", model, machine.write(folder / "machine.yaml"))
    core, frames = run.compensator, ("base", "work", "fixture")
    tools = {0: "probe", 60: "stub", 120: "tool", 180: "probe"}
    for n in range(240):
        if n in tools:
            core.set_tool(tools[n])
            assert n == 0 or not run.send(Pose(core.platform.position, core.platform.rotation))  # refused: elsewhere
            place(run, n - 1 if n else 0, frames[n % 3])  # where the struts are
        place(run, n, frames[n % 3])
        if n % 20 == 19:
            run.page(snapshot=n % 40 == 39)
    return run, read_recording(write_bag(folder / "bag", run.messages)), model


def place(run: RecordedMachine, n: int, frame: str) -> None:
    """Command pose `n` of a wave near home to the tool in use, in a frame."""
    geometry, wave = run.compensator.geometry, wave_pose(n)
    home = Pose(geometry.home.position + wave.position - wave_pose(0).position, geometry.home.rotation @ wave.rotation)
    assert run.send(geometry.using(work=frame).tool_pose(home), frame)


def test_tools_and_frames_come_back_bit_for_bit(recorded: tuple[RecordedMachine, Recording, Path]) -> None:
    """In base the platform follows one smooth wave, with any frame and tool."""
    run, recording, _ = recorded
    result = replay_recording(recording)
    assert (result.identical, result.states_differ, result.compared) == (True, [], len(run.answers))
    assert [event.entry.values["name"] for event in result.changes] == ["probe", "stub", "tool", "probe"]
    assert {event.entry.values["reason"] for event in result.refused} == {"tool_changed"}
    assert set(recording.frames) == {"base", "work", "fixture"}
    rows, home = (0, *range(60), 59, *range(60, 120), 119, *range(120, 180), 179, *range(180, 240)), run.geometry.home
    for tool, of_tool, count in (("probe", None, 61), ("tool", "tool", 244)):
        tip = run.geometry.tools[tool].position
        for position, n in zip(tool_positions(recording, run.geometry, of_tool)[:count], rows[:count], strict=True):
            wave = wave_pose(n)
            platform = home.position + wave.position - wave_pose(0).position
            np.testing.assert_allclose(position, platform + home.rotation @ wave.rotation @ tip, rtol=0.0, atol=1e-12)


def test_another_machine_must_have_the_tools_and_frames(
    recorded: tuple[RecordedMachine, Recording, Path], tmp_path: Path
) -> None:
    """Unknown frames are reported for each command, an unknown tool at once; no command is taken in another frame."""
    _, recording, model_file = recorded
    plain = with_frames("framed")
    plain.work_frames.clear()
    geometry = load_geometry(plain.write(tmp_path / "plain.yaml"))
    model = load_model(model_file, geometry)
    result = what_if(recording, geometry, model)
    first = "unknown_frame: the machine has no work frame 'fixture'"
    assert first in result.refused_now.values()
    shown = Report(recording, None, result, "plain").shown()[0]
    assert f"  it refuses {len(result.refused_now)} commands, first answer " in shown
    assert shown.partition("it refuses")[2].partition("\n")[0].endswith(first)
    assert all(recording.frames[row] == "fixture" for row, why in result.refused_now.items() if "unknown_frame" in why)
    plain.tools.pop("stub")
    with pytest.raises(Exception, match="machine framed has no tool 'stub'; it has tool, probe"):
        what_if(recording, load_geometry(plain.write(tmp_path / "plain.yaml")), model)
