"""The compensation in LinuxCNC's own servo thread: hexapod_rt, compiled from an export, in the shipped configuration.

As in test_linuxcnc.py, a hidden machine behind the drives is evaluated from records of every servo cycle.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from linuxcnc_helpers import OURS, Linuxcnc, why_not
from test_linuxcnc import CONFIG, DIGITS, RAMP, Calibrated, calibrated, compared

from hexapod_comp import cli
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import solve_pose
from hexapod_comp.machine.model_file import load_model

MODULES = Path("/usr/lib/linuxcnc/modules")
MISSING = why_not() or ("" if shutil.which("halcompile") else "no halcompile: apt-get install linuxcnc-uspace-dev")
NEEDS_ROOT = "" if MISSING or os.access(MODULES, os.W_OK) else f"{MODULES} is not ours to write to"

pytestmark = [
    pytest.mark.skipif(bool(MISSING or NEEDS_ROOT), reason=f"LinuxCNC: {MISSING or NEEDS_ROOT}"),
    pytest.mark.timeout(600),
]

__all__ = ["calibrated"]  # the fixture


@pytest.fixture(scope="module")
def controller(calibrated: Calibrated, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Linuxcnc]:
    """Provide a LinuxCNC that is on and homed, with the fitted model in its servo thread and compensation off."""
    folder = tmp_path_factory.mktemp("rt")
    assert cli.main(["export", "--model", calibrated.model_file, "--c", str(folder)]) == 0
    words = ["halcompile", "--install", "hexapod_rt.comp"]
    environment = {**os.environ, "EXTRA_CFLAGS": f"-I{folder}"}
    made = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    try:
        with Linuxcnc({"ENABLE = 1": "ENABLE = 0", "HALFILE = bridge.hal": "HALFILE = rt.hal"}) as linuxcnc:
            linuxcnc.ask("on")
            linuxcnc.ask("home")
            yield linuxcnc
    finally:
        (MODULES / "hexapod_rt.so").unlink(missing_ok=True)


@pytest.mark.parametrize("program", ["part.ngc", "fast.ngc"])
def test_the_error_goes_away_at_every_feed(controller: Linuxcnc, calibrated: Calibrated, program: str) -> None:
    """The error is at most the bridge's, 0.92 µm, on the circle and the tilted moves, and no larger at 6 m/min."""
    before, after = compared(controller, calibrated.truth, (OURS / program).read_text())
    assert after <= 0.02 * before


def test_jogging_tool_change_abort_and_emergency_stop(controller: Linuxcnc, calibrated: Calibrated) -> None:
    """After each, the corrections are those of the present pose; none steps, and there is no following error."""
    controller.enable(True)
    steps = {
        "jog": lambda: controller.ask("jog", 0, 20.0, 2.0),
        "tool change": lambda: controller.ask("mdi", "T2 M6 G43"),
        "abort": lambda: (controller.ask("start", "G1 X-60 F3000"), time.sleep(0.5), controller.ask("abort")),
        "off and on": lambda: (controller.ask("off"), controller.until_pin("comp-status", 5), controller.ask("on")),
    }
    for name, step in steps.items():
        with controller.recording() as record:
            step()
            controller.until_pin("comp-status", 2)
            time.sleep(0.3)
        assert record.largest_step <= RAMP + DIGITS, name
        assert record.following_error < controller.get("joint.0.f-error-lim"), name
        assert_where_it_stands(controller, calibrated, name)
    controller.ask("mdi", "G49")
    assert controller.ask("errors") == []


def assert_where_it_stands(controller: Linuxcnc, calibrated: Calibrated, name: str) -> None:
    """Check that corrections at rest equal Python's for the pose of the nominal lengths, to halcmd's digits."""
    geometry = load_geometry(CONFIG / "paper.yaml")
    corrections = np.array(controller.get(*(f"comp-correction-{n}" for n in range(6))))
    pose = solve_pose(geometry, (controller.struts() - corrections) * 1e-3, geometry.home)
    model = load_model(calibrated.model_file, geometry)
    expected = Compensator(geometry, model).correct(geometry.tool_pose(pose)).correction * 1e3
    np.testing.assert_allclose(corrections, expected, rtol=0.0, atol=2e-6, err_msg=name)
