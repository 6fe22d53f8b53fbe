"""Reloading a model must neither hang the node, nor move the machine to where it may not be.

A file on a dead mount is imitated by a loading process that never ends; what the node itself may touch, by watching its
calls. Limits are those of the shipped geometry: ±2 mm of correction.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from node_helpers import CONFIG, HOME, model_file, near

from hexapod_comp.compensation.journal import LARGEST_SOURCE, Source
from hexapod_comp.errors import InputFileError
from hexapod_comp.formats.files import read_text
from hexapod_comp.formats.paths import confined_opener
from hexapod_comp.ros.status import WARN
from hexapod_comp.ros.worker import Job, Worker

ROUNDING = 1e-12


def field(displacement_um: float, outside: str = "hold") -> dict[str, object]:
    """Return a field of one constant along z over the whole working volume."""
    lines = [
        {"axis": "z", "at": [i, j], "direction": "both", "dz_um": [displacement_um]} for i in (0, 1) for j in (0, 1)
    ]
    grid = {"grid_x_mm": [-200, 200], "grid_y_mm": [-200, 200], "grid_z_mm": [350, 550]}
    return {**grid, "outside": outside, "lines": lines}


# ---- nothing that breaks a limit ----


def test_a_model_that_breaks_a_limit_at_the_last_command_moves_nothing(rig, tmp_path):
    """5 mm of field need more than the 2 mm of correction allowed: said by the service, at once and in words."""
    path = model_file(tmp_path, struts={"offset_um": 100.0})
    node = rig.compensator(model_file=path, ramp_rate=1.0, command_timeout=0.0)
    rig.ask(HOME)
    before = dict(node._files.sources)
    model_file(tmp_path, field=field(5000.0))
    response = rig.trigger("reload_model")
    assert not response.success
    assert "the old model stays: strut_" in response.message
    assert "is larger than ±2000 µm" in response.message
    assert node._files.sources == before, "the journal must not name a model that is not in use"
    rig.until_status(WARN, "the old model stays")
    for _ in range(3):
        np.testing.assert_allclose(rig.ask(HOME).corrections, -100e-6, rtol=0.0, atol=ROUNDING)
    model_file(tmp_path, field=field(1000.0))
    assert rig.trigger("reload_model").success


@pytest.mark.parametrize(
    ("steps", "shape", "said"),
    [(0, field(5000.0), "is larger than ±2000 µm"), (54, field(10.0, "refuse"), "is outside the field's box")],
    ids=["at home before the first command", "below the box, which begins 50 mm under home"],
)
def test_a_model_is_judged_where_the_machine_stands(rig, tmp_path, steps, shape, said):
    rig.compensator(model_file=model_file(tmp_path), command_timeout=0.0)
    for step in range(1, steps + 1):
        rig.ask(near(HOME, (0.0, 0.0, -1e-3 * step)))
    model_file(tmp_path, field=shape)
    response = rig.trigger("reload_model")
    assert not response.success
    assert said in response.message


def test_compensation_is_not_switched_on_where_it_breaks_a_limit(rig, tmp_path):
    """Fine at home, not further up, where it went while compensation was off: the ramp would drag the struts there."""
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


# ---- nothing that is waited for without end ----


def test_the_node_itself_does_not_touch_the_file(bench, tmp_path, monkeypatch):
    """A look at a file on a dead mount never returns: only another process may take it."""
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
    """Have a worker do a job, and return its result or its error."""
    beside, found = Worker(), []
    late = f"could not be read in {within:g} s"
    beside.ask(Job(name, arguments, found.append, found.append, within=within, late=late))
    end = time.monotonic() + 60.0
    while not found and time.monotonic() < end:
        beside.poll(time.monotonic())
        time.sleep(0.01)
    beside.close()
    return found


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
    """A pipe, which nobody writes into: to open it would take until somebody does. A link that leads out."""
    (tmp_path / "mine").mkdir()
    outside, pipe, link = tmp_path / "outside.yaml", tmp_path / "pipe", tmp_path / "mine" / "model.yaml"
    outside.write_text("a: 1")
    os.mkfifo(pipe)
    link.symlink_to(outside)
    with pytest.raises(InputFileError, match="is not a regular file"):
        read_text(pipe, confined_opener(tmp_path))
    with pytest.raises(InputFileError, match=f"leads to {outside}, but files are only read from"):
        read_text(link, confined_opener(tmp_path / "mine"))
    assert read_text(link, confined_opener(tmp_path)) == "a: 1"


@pytest.mark.parametrize("padding", [0, LARGEST_SOURCE])
def test_the_loading_process_hands_back_what_it_has_read(tmp_path, padding):
    """The text that the journal keeps, and the model made of it; of a long file its hash alone."""
    text = (CONFIG / "paper_machine.yaml").read_text(encoding="utf-8") + f"# {'é' * padding}\n"
    path = tmp_path / "model.yaml"
    path.write_text(text, encoding="utf-8")
    ((model, source),) = outcome("load_model", wanted(tmp_path, Path()))
    assert model.name == "virtual machine"
    whole = Source.of(str(path), text)
    assert (source.name, source.sha256) == (whole.name, whole.sha256)
    assert source.text == (None if padding else text)
