"""A recorded run with other tools and work frames comes back bit for bit; so does one from before there were any.

The truth is what the compensator answered while it was recorded.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from foreign_machines import Errors, with_frames
from replay_helpers import STORE, TYPES, Messages, RecordedMachine, serialized, wave_pose, write_bag

from hexapod_comp.cli import main
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.pose import Pose
from hexapod_comp.replay.bag import read_recording
from hexapod_comp.replay.replay import Replay, replay_recording, what_if
from hexapod_comp.replay.report import tool_positions

TEXT = "std_msgs/msg/String"


def recorded(folder: Path, name: str = "framed") -> RecordedMachine:
    """Return 600 commands through all frames with three tools, one after the other, and a refused tool and command."""
    machine = with_frames(name)
    model = Errors.drawn(machine, 5).write(folder / "model.yaml", machine)
    run = RecordedMachine("", model, machine.write(folder / "machine.yaml"))
    core, frames = run.compensator, ("base", "work", "fixture")
    tools = {0: "probe", 150: "stub", 300: "tool", 450: "probe"}
    for n in range(600):
        if n in tools:
            core.set_tool(tools[n])
            assert n == 0 or not run.send(Pose(core.platform.position, core.platform.rotation))  # not where the tool is
            place(run, n - 1 if n else 0, frames[n % 3])  # where the struts are
        place(run, n, frames[n % 3])
        if n % 20 == 19:
            run.page(snapshot=n % 100 == 99)
    return run


def place(run: RecordedMachine, n: int, frame: str) -> None:
    """Command pose `n` of a wave about home to the tool in use, in a frame."""
    geometry, wave = run.compensator.geometry, wave_pose(n)
    home = Pose(geometry.home.position + wave.position - wave_pose(0).position, geometry.home.rotation @ wave.rotation)
    assert run.send(geometry.using(work=frame).tool_pose(home), frame)


def replayed(bag: Path) -> Replay:
    return replay_recording(read_recording(bag))


@pytest.mark.parametrize("name", ["framed", "hanging"])
def test_tools_and_frames_come_back_bit_for_bit(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = recorded(tmp_path, name)
    bag = write_bag(tmp_path / "bag", run.messages)
    result = replayed(bag)
    assert result.identical
    assert not result.states_differ
    assert result.compared == len(run.answers) == 604
    assert [event.entry.values["name"] for event in result.changes] == ["probe", "stub", "tool", "probe"]
    assert {event.entry.values["reason"] for event in result.refused} == {"tool_changed"}
    assert main(["replay", str(bag)]) == 0
    out = capsys.readouterr().out
    assert "replayed 604 of 604 answers: identical bit for bit" in out
    assert "changes between commands: 4 × tool" in out


def test_commanded_positions_are_seen_from_the_base(tmp_path: Path) -> None:
    """Truth: the platform's way, which is one smooth wave whatever frame and tool it was commanded in."""
    run = recorded(tmp_path)
    recording = read_recording(write_bag(tmp_path / "bag", run.messages))
    assert set(recording.frames) == {"base", "work", "fixture"}
    positions = tool_positions(recording, run.geometry.work_frames)[:151]
    tool, home = run.geometry.tools["probe"].position, run.geometry.home
    for position, n in zip(positions, (0, *range(150)), strict=True):
        wave = wave_pose(n)
        platform = home.position + wave.position - wave_pose(0).position
        tip = platform + home.rotation @ wave.rotation @ tool
        np.testing.assert_allclose(position, tip, rtol=0.0, atol=1e-12)


def test_another_machine_must_have_the_tools_and_frames(tmp_path: Path) -> None:
    """What cannot be: said of each command, or of the tool at once; never a command in another frame."""
    run = recorded(tmp_path)
    recording = read_recording(write_bag(tmp_path / "bag", run.messages))
    plain = with_frames("framed")
    plain.tools.pop("stub")
    plain.work_frames.clear()
    geometry = load_geometry(plain.write(tmp_path / "plain.yaml"))
    model = load_model(tmp_path / "model.yaml", geometry)
    with pytest.raises(Exception, match="machine framed has no tool 'stub'; it has tool, probe"):
        what_if(recording, geometry, model)
    plain = with_frames("framed")
    plain.work_frames.clear()
    result = what_if(recording, load_geometry(plain.write(tmp_path / "plain.yaml")), model)
    assert "unknown_frame: the machine has no work frame 'fixture'" in result.refused_now.values()
    assert all(recording.frames[row] == "fixture" for row, why in result.refused_now.items() if "unknown_frame" in why)


def older(messages: Messages) -> Messages:
    """Return messages as they were before there were tools: version 4 of the journal, and nothing of them in it."""
    changed = []
    for time, topic, kind, raw in messages:
        if kind == TEXT:
            content = json.loads(STORE.deserialize_cdr(raw, kind).data)
            content["journal"] = 4
            if content.get("snapshot"):
                content["snapshot"]["state"].pop("tool")
            raw = serialized(kind, TYPES[TEXT](json.dumps(content)))
        changed.append((time, topic, kind, raw))
    return changed


def test_recordings_from_before_still_come_back(tmp_path: Path) -> None:
    run = RecordedMachine()
    run.wave(150)
    run.page()
    run.wave(150, 150)
    run.page()
    result = replayed(write_bag(tmp_path / "bag", older(run.messages)))
    assert result.identical
    assert result.compared == 300
