"""Recordings of the real node: what a recorder hears over DDS, written as a bag, gives the same bits again.

The truth is what the node has sent.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from node_helpers import HOME, Bench, model_file, near

from hexapod_comp.errors import InputFileError
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import pose_message
from hexapod_comp.ros.recorder import BagRecorder

pytest.importorskip("rosbags")

from node_recorder import Recorder
from replay_helpers import write_bag

from hexapod_comp.replay.bag import Recording, read_recording
from hexapod_comp.replay.replay import BEFORE, IDENTICAL, Replay, replay_recording


def replayed(bag: Path, namespace: str | None = None) -> tuple[Recording, Replay]:
    """Read a bag and replay it."""
    recording = read_recording(bag, namespace)
    return recording, replay_recording(recording)


def along(n: int) -> Pose:
    """Return the pose number `n` of a motion that turns struts round, slow enough for a command every millisecond."""
    return near(
        HOME, (6e-4 * np.sin(0.1 * n), 4e-4 * np.sin(0.13 * n), 2e-4 * np.sin(0.07 * n)), 0.06 * np.sin(0.1 * n)
    )


def test_a_run_with_everything_is_replayed_bit_for_bit(bench, tmp_path):
    """Ramps in and out and at another rate, a temperature, another model, a reset to measured struts, refusals."""
    model = model_file(tmp_path, struts={"offset_um": 30.0, "backlash_um": 8.0, "expansion_ppm_per_K": 11.0})
    bench.compensator(model_file=model, temperature_time_constant_s=0.0)
    recorder = Recorder(bench)
    answers = [bench.ask(along(n)) for n in range(40)]
    bench.warm("strut_3", 24.7)
    answers += [bench.ask(along(n)) for n in range(40, 60)]
    bench.enable(False)
    answers += [bench.ask(along(n)) for n in range(60, 70)]
    assert bench.set_parameter("compensator", "ramp_rate", 2.5e-3).successful
    answers += [bench.ask(along(n)) for n in range(70, 80)]
    other = model_file(tmp_path, "other.yaml", struts={"offset_um": -20.0, "pitch_ppm": 40.0})
    assert bench.set_parameter("compensator", "model_file", other).successful
    assert bench.trigger("reload_model").success
    bench.enable(True)
    answers += [bench.ask(along(n)) for n in range(80, 120)]
    bench.send(near(HOME, (0.1, 0.0, 0.0)))  # too far in one step
    bench.barrier()
    bench.send(pose_message(HOME, "nowhere"))
    bench.feed(answers[-1].lengths + 5e-6)
    bench.until(lambda: bench.trigger("reset").success, "a machine that stands")
    bench.feed(answers[-1].lengths + 5e-6)
    bench.barrier()
    answers += [bench.ask(along(n)) for n in range(119, 150)]
    recorder.stop()
    recording, result = replayed(write_bag(tmp_path / "run", recorder.messages))
    assert (result.outcome == IDENTICAL).all()
    assert len(result.outcome) == len(answers)
    sent = np.array([answer.lengths for answer in answers])
    assert result.lengths[:, 0].tobytes() == sent.tobytes(), "the truth is what the node sent, not what the bag says"
    assert not result.states_differ
    assert {event.entry.what for event in result.changes} == {"temperature", "enable", "ramp_rate", "model", "reset"}
    assert [event.entry.values["reason"] for event in result.refused] == ["step", "frame_id"]
    assert len(recording.sources) >= 3, "geometry and both models"


def wait_for_page(rig: Bench) -> None:
    """Wait until a page of the journal has come that was begun from now on; it comes with the diagnostics."""
    pages = len(rig.seen["/diagnostics"])
    rig.until(lambda: len(rig.seen["/diagnostics"]) > pages + 1, "another page of the journal")


def test_what_the_verb_records_is_replayed_and_a_folder_that_is_there_is_left_alone(bench, tmp_path):
    """The recorder runs as a user has it, in a process, beside a compensator that is moving already."""
    bench.compensator()
    answers = [bench.ask(along(n)) for n in range(20)]
    command = [sys.executable, "-m", "hexapod_comp", "record", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    journal = next(p for p in bench.nodes[0].publishers if p.topic_name.endswith("/journal"))
    bench.until(journal.get_subscription_count, "the recorder", timeout=60.0)
    commands = next(p for p in bench.nodes[0].publishers if p.topic_name == "/strut_commands")
    bench.until(lambda: commands.get_subscription_count() > 1, "the recorder of commands")
    wait_for_page(bench)  # what was commanded before the first one that it has cannot be judged
    answers += [bench.ask(along(n)) for n in range(20, 60)]
    wait_for_page(bench)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert "/compensator/journal" in output
    recording, result = replayed(tmp_path / "run")
    judged = result.outcome[result.outcome != BEFORE]
    assert (judged == IDENTICAL).all()
    assert len(judged) >= 40
    assert recording.heard >= 40
    with pytest.raises(InputFileError, match="is there already"):
        BagRecorder(tmp_path / "run")
