"""Each change that a journal may hold: what its entry says, what a snapshot brings back, and the bits of a replay.

The truth is the compensator that was recorded; its arithmetic is other tests'.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from replay_helpers import CONFIG, RecordedMachine, write_bag

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.compensation.journal import ENTRIES, SETTERS, read_page
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.load import Load, Loading
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.replay.bag import read_recording
from hexapod_comp.replay.replay import replay_recording

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
"""By their names: the setter's arguments, and what the entry says."""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a model that every one of them moves."""
    known = load_model(CONFIG / "paper_machine.yaml", load_geometry("paper"))
    sag = np.outer([10e-6, 40e-6], [0.1, 0.0, -1.0])
    table = OutsideTable(("elevation",), ("rad",), (np.array([0.0, 1.5]),), sag, 0.2 * sag)
    struts = replace(known.struts, expansion=np.full(6, 11e-6), moisture=np.full(6, 2e-4))
    load = Load(stiffness=np.full(6, 20e6), mass=30.0)
    file = tmp_path_factory.mktemp("changes") / "model.yaml"
    save_model(replace(known, struts=struts, base_expansion=11e-6, load=load, outside=table), file)
    return file


def test_every_change_is_here() -> None:
    assert CHANGES.keys() == SETTERS.keys() == ENTRIES.keys() - {"model", "refused"}


@pytest.mark.parametrize("what", CHANGES)
def test_a_change_is_written_restored_and_replayed(what: str, model: Path, tmp_path: Path) -> None:
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
        machine.wave(1, count - 1)  # where it is: there the first command with another tool must be
        if what == "reset":
            machine.compensator.reset()
        machine.wave(20, count)
        count += 20
        machine.page(snapshot=n == 0)
    result = replay_recording(read_recording(write_bag(tmp_path / "bag", machine.messages)))
    assert (result.identical, result.states_differ, result.compared) == (True, [], len(machine.answers))
    assert len({answer.tobytes() for answer in machine.answers}) > 20
