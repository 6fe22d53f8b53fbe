"""A machine that calibrates itself, over DDS: what a direct call of the loop does not show (test/upkeep).

Truth: the compensator's own parameter, and the corrections that it publishes; the mover's state.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from node_helpers import HOME, Bench, model_file, near
from std_srvs.srv import Trigger

from hexapod_comp.errors import CommandError
from hexapod_comp.ros.adapter import AdapterNode
from hexapod_comp.ros.adapting import AdaptedMachine
from hexapod_comp.ros.client import MoveError
from hexapod_comp.ros.mover import MoverNode


def asked(bench: Bench, what: Callable[[AdaptedMachine], object], going_on: Callable[[], bool] = lambda: True) -> Any:
    """Return what a client makes of the machine, or the error that it ended with."""
    ended: list[Any] = []

    def client() -> None:
        with AdaptedMachine("tool_pose_true", going_on=going_on) as machine:
            try:
                ended.append(what(machine))
            except Exception as error:  # it is the thread's result
                ended.append(error)

    thread = Thread(target=client)
    thread.start()
    bench.until(lambda: not thread.is_alive(), "the client", timeout=60.0)
    return ended[0]


def test_a_model_is_named_to_the_compensator_and_runs_by_its_ramp_or_the_old_one_stays(
    bench: Bench, tmp_path: Path
) -> None:
    bench.machine(truth="ideal", model=model_file(tmp_path, "old.yaml", struts={"offset_um": 10.0}))
    bench.add(MoverNode, True, {})
    for name, offset in (("new.yaml", 50.0), ("far.yaml", 5000.0)):
        model_file(tmp_path, name, struts={"offset_um": offset})
    assert asked(bench, lambda machine: machine.reload(tmp_path / "new.yaml")) is None

    def named() -> str:
        node = next(node for node in bench.nodes if node.get_name() == "compensator")
        return str(node.get_parameter("model_file").value)

    assert named() == str(tmp_path / "new.yaml")
    asked(bench, lambda machine: machine.move(near(HOME, (0.0, 0.0, 0.001)), "base"))
    bench.until(lambda: abs(bench.seen["strut_corrections"][-1].position[0] + 50e-6) < 1e-9, "the ramp's end")
    error = asked(bench, lambda machine: machine.reload(tmp_path / "far.yaml"))
    assert isinstance(error, CommandError)
    assert "did not take" in str(error)
    assert "the old model stays" in str(error)
    assert named() == str(tmp_path / "new.yaml"), "a restart would else begin with what was refused"
    assert np.allclose(bench.seen["strut_corrections"][-1].position, -50e-6, rtol=0.0, atol=1e-9)
    below, elsewhere = tmp_path / "adapted" / "model.yaml", tmp_path.parent / "model.yaml"
    assert asked(bench, lambda machine: machine.refuse_unreadable(below)) is None
    error = asked(bench, lambda machine: machine.refuse_unreadable(elsewhere))
    assert f"compensator reads models in {tmp_path} alone: start it with -p model_folder:=FOLDER" in str(error)


def test_a_loop_that_shall_not_go_on_brakes_the_move(bench: Bench) -> None:
    bench.machine(truth="ideal")
    bench.add(MoverNode, True, {"limit_share": 0.05})
    error = asked(bench, lambda machine: machine.move(near(HOME, (0.0, 0.0, 0.02)), "base"), lambda: False)
    assert isinstance(error, MoveError)
    assert error.reason == "person"


def test_the_node_starts_reports_and_stops_a_calibration(bench: Bench, tmp_path: Path) -> None:
    """No machine is there: the process waits for one. The journal is the test's."""
    node = bench.add(AdapterNode, True, {"folder": str(tmp_path)})
    assert bench.call(Trigger, "adapter/stop").message == "nothing was running"
    (tmp_path / "journal.jsonl").write_text('{"event": "stopped"}\n', encoding="utf-8")
    assert bench.call(Trigger, "adapter/calibrate").success
    refused = bench.call(Trigger, "adapter/verify")
    assert (refused.success, refused.message) == (False, "calibrating already: ~/stop ends it")
    bench.until(lambda: node._check_state() is None, "a look at the journal")
    assert (node._step, node._text) == ("", "starting"), "the step of the run before is none of this one"
    journal = '{"event": "begun", "machine": "paper", "goal_m": 3e-06}\n{"event": "pla'
    (tmp_path / "journal.jsonl").write_text(journal, encoding="utf-8")
    bench.until(lambda: node._step == "begun", "the step")
    assert bench.call(Trigger, "adapter/stop").message == "the machine brakes"
    bench.until(lambda: node._state == "stopped", "its end", timeout=60.0)
    assert bench.call(Trigger, "adapter/stop").message == "nothing was running"


def test_a_process_that_ends_without_a_result_is_reported(bench: Bench, tmp_path: Path) -> None:
    node = bench.add(AdapterNode, True, {"folder": str(tmp_path), "geometry_file": "not_there.yaml"})
    assert bench.call(Trigger, "adapter/verify").success
    bench.until(lambda: node._state == "failed", "its end", timeout=60.0)
    assert node._text.startswith("the process ended with 2")
