"""The compensator in the loop of a real controller: LinuxCNC 2.9 with the shipped configuration, without stand-ins.

LinuxCNC plans, runs genhexkins and the safety chain at 1 kHz, and moves simulated drives. A bridge and a compensator
run beside it as processes. The drives move a hidden machine whose joints are wrong by up to ±100 µm. LinuxCNC's sampler
records the drives' lengths in every servo cycle, and RealMachine computes the true tool poses from them afterwards,
independently of the loop.

The compensator's model is not the truth: it is fitted to virtual readings of that machine by ``simulate`` and ``fit``.
"""

from __future__ import annotations

import csv
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from linuxcnc_helpers import OURS, Linuxcnc, Record, why_not
from scipy.ndimage import distance_transform_edt

from hexapod_comp import cli
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin, MotionState, RealMachine
from hexapod_comp.machine.model_file import save_model

pytestmark = [pytest.mark.skipif(bool(why_not()), reason=f"LinuxCNC: {why_not()}"), pytest.mark.timeout(600)]

CONFIG = Path(__file__).resolve().parents[2] / "config"

CAMPAIGN, PROGRAM = str(OURS / "campaign.yaml"), (OURS / "part.ngc").read_text()

RAMP = 1e-3  # mm per servo cycle of 1 ms: the configured ramp of 1 mm/s
DIGITS = 1.1e-6  # mm; difference of two readings of halsampler, which prints six decimals
LATE = 500  # servo cycles of 1 ms for which a process may have to wait on a busy computer
EVERY = 5  # only every fifth cycle of a record is evaluated: neighbours are micrometres apart


def uniform(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.uniform(-100e-6, 100e-6, shape)


@dataclass(frozen=True)
class Calibrated:
    """A hidden machine, and the model fitted to readings of it."""

    truth: RealMachine
    model_text: str
    model_file: str


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """Return a machine with ±100 µm on every joint coordinate, measured, and the model fitted to the readings."""
    folder = tmp_path_factory.mktemp("calibrated")
    files = {n: str(folder / n) for n in ("truth.yaml", "measured.csv", "model.yaml")}
    rng = np.random.default_rng(5)
    platform = np.repeat(uniform(rng, 3, 3), 2, axis=0)  # struts meet in pairs
    origin = ModelOrigin("2026-01-31", note="hidden truth of a test")
    model = MachineModel(
        "paper", "truth", base_deviation=uniform(rng, 6, 3), platform_deviation=platform, origin=origin
    )
    save_model(model, files["truth.yaml"])
    options = ["--truth", files["truth.yaml"], "--campaign", CAMPAIGN, "--seed", "5"]
    assert cli.main(["simulate", *options, "--out", files["measured.csv"]]) == 0
    fitted = ["--blocks", "structure", "--tracker-frame", "known"]  # the virtual tracker's frame is the work frame
    assert cli.main(["fit", files["measured.csv"], *fitted, "--out", files["model.yaml"]]) == 0
    truth = RealMachine(load_geometry(CONFIG / "paper.yaml"), model)
    return Calibrated(truth, Path(files["model.yaml"]).read_text(), files["model.yaml"])


@pytest.fixture(scope="module")
def controller(calibrated: Calibrated) -> Iterator[Linuxcnc]:
    """Provide a LinuxCNC that is on and homed, with a compensator whose compensation is off."""
    with Linuxcnc({"ENABLE = 1": "ENABLE = 0"}) as linuxcnc:
        linuxcnc.compensator(linuxcnc.give_file("model.yaml", calibrated.model_text))
        linuxcnc.ask("on")
        linuxcnc.ask("home")
        yield linuxcnc


def run_program(linuxcnc: Linuxcnc, text: str = PROGRAM) -> Record:
    """Move to the program's start, run it, and return its record."""
    linuxcnc.ask("mdi", "G0 X0 Y0 Z400 A0 B0 C0")
    path = linuxcnc.give_file("part.ngc", text)
    with linuxcnc.recording() as record:
        linuxcnc.ask("program", path)
        linuxcnc.ask("finish")
    return record


def tool_errors(truth: RealMachine, record: Record, tool_length: float = 0.0) -> np.ndarray:
    """Return true minus commanded tool positions over a record, m, (N, 3)."""
    # Directions of motion do not matter: the machine has neither backlash nor field.
    up = np.array([0.0, 0.0, tool_length])
    guess, sense, errors = truth.geometry.home, MotionState().sense, []
    for axes, struts in zip(record.axes[::EVERY], record.struts[::EVERY], strict=True):
        guess, _ = truth.pose_for(struts * 1e-3, sense, guess)
        tip = guess.position - guess.rotation @ up  # in the paper's geometry
        errors.append(tip - (axes[:3] * 1e-3 - up))
    return np.array(errors)


def in_force(truth: RealMachine, record: Record, tool_length: float = 0.0) -> np.ndarray:
    """Return the tool errors of those cycles of a record in which the corrections were in force, m, (N, 3)."""
    # On a busy computer a process may wait for longer than the bridge's timeout; the corrections then ramp out and in
    # again, as another test checks.
    errors = tool_errors(truth, record, tool_length)
    there = settled(record, 2)[::EVERY]
    print(f"\ncorrections in force for {100 * there.mean():.0f} % of the time")
    assert there.mean() > 0.2
    return errors[there]


def settled(record: Record, status: int) -> np.ndarray:
    """Return the cycles, bool, (N,), in which a living bridge has had a status for 0.3 s and keeps it for 0.3 s."""
    # A bridge that is dead or waiting for a processor shows an old status.
    there = (record.status == status) & record.alive
    return np.ones(len(there), bool) if there.all() else distance_transform_edt(there) > 300.0


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def assert_undisturbed(linuxcnc: Linuxcnc, record: Record) -> None:
    """Check that LinuxCNC did not stop, and that no correction changed faster than the ramp."""
    assert linuxcnc.ask("errors") == []
    assert record.following_error < linuxcnc.get("joint.0.f-error-lim")
    assert (record.side[:, -1] == 1.0).all(), "LinuxCNC was off, or not homed, for a while"
    assert record.largest_step <= RAMP + DIGITS


def table_1() -> list[list[float]]:
    """Return α, β, γ, degrees, and x, y, z, mm, of Table 1's rows."""
    with (CONFIG / "table1.csv").open(newline="") as file:
        return [[float(word) for word in row[1:]] for row in list(csv.reader(file))[1:]]


def compared(linuxcnc: Linuxcnc, truth: RealMachine, text: str = PROGRAM, tool: float = 0.0) -> tuple[float, float]:
    """Return the tool's RMS errors along a program without and with compensation, m."""
    records = []
    for on in (False, True):
        linuxcnc.enable(on)
        records.append(run_program(linuxcnc, text))
        assert_undisturbed(linuxcnc, records[-1])
    assert np.ptp(records[0].corrections) == 0.0
    before, after = rms(tool_errors(truth, records[0], tool)), rms(in_force(truth, records[1], tool))
    print(f"\ntool error {before * 1e6:.2f} -> {after * 1e6:.2f} µm RMS, {100 * (1 - after / before):.1f} % less")
    return before, after


def test_a_fitted_model_takes_the_error_away(controller: Linuxcnc, calibrated: Calibrated) -> None:
    """A fitted model removes at least 95 % of the tool's RMS error over a circle and tilted moves."""
    before, after = compared(controller, calibrated.truth)
    assert before > 30e-6
    assert after <= 0.05 * before


@pytest.mark.parametrize("killed", ["compensator", "bridge"])
def test_a_killed_process(controller: Linuxcnc, calibrated: Calibrated, killed: str) -> None:
    """After kill -9 in a circle the correction ramps out and LinuxCNC continues; a new process ramps it in.

    Without a bridge the realtime chain ramps out, and bridge.hal starts a new one.
    """
    controller.enable(True)
    slow = PROGRAM.replace("F1500", "F900").split("G1 X20")[0] + "M2\n"
    controller.ask("mdi", "G0 X60 Y0 Z400 A0 B0 C0")
    with controller.recording() as record:
        controller.ask("program", controller.give_file("slow.ngc", slow))
        time.sleep(3.0)
        if killed == "compensator":
            controller.newest_compensator.end(signal.SIGKILL)
            controller.until_pin("hexapod_comp.status", 5)
            controller.compensator(str(controller.folder / "model.yaml"))
        else:
            os.kill(controller.pid_of("hexapod_comp"), signal.SIGKILL)
            controller.until_pin("comp-alive", False)
            controller.until_pin("comp-missing", True)
            controller.until_pin("ramp.0.out", 0.0)
            controller.halcmd("-i", "headless.ini.expanded", "-f", "bridge.hal")
        controller.until_pin("hexapod_comp.status", 2)
        controller.until_pin("comp-missing", False)
        time.sleep(2.0)
        assert not controller.ask("stat", "inpos")[0], "the circle was too short for this test"
        controller.ask("finish")
    assert_undisturbed(controller, record)
    largest = np.abs(record.corrections).max(axis=1)
    zero = np.flatnonzero(largest == 0.0)
    assert len(zero), "the corrections never got to zero"
    height = largest[max(zero[0] - 1000, 0) : zero[0]].max()
    start = np.flatnonzero(largest[: zero[0]] > height - 0.002)[-1]  # a moving tool changes the correction a little
    took, needed = zero[0] - start, (height - 0.002) / RAMP
    print(f"\ncorrections of up to {height * 1e3:.0f} µm went to zero in {took} ms")
    assert needed - 1.0 <= took <= needed + LATE
    assert largest[-1] > 0.5 * height, "the corrections did not come back"
    if killed == "bridge":  # the new component has a status pin of its own, so the record's does not continue
        return
    errors = tool_errors(calibrated.truth, record)
    there, gone = (settled(record, status)[::EVERY] for status in (2, 5))
    print(f"\nwith the compensator {rms(errors[there]) * 1e6:.2f} µm RMS, without it {rms(errors[gone]) * 1e6:.2f} µm")
    assert rms(errors[there]) <= 0.05 * rms(errors[gone])


def test_tool_length(controller: Linuxcnc, calibrated: Calibrated) -> None:
    """With a tool 50 mm longer, its tip (not the geometry file's tool frame) follows G-code, also when tilted."""
    try:
        before, after = compared(controller, calibrated.truth, (OURS / "long_tool.ngc").read_text(), 0.050)
    finally:
        controller.ask("mdi", "G49")
    assert after <= 0.05 * before


def test_the_exported_model_agrees(controller: Linuxcnc, calibrated: Calibrated, tmp_path: Path) -> None:
    """The exported model, without a bridge, gives the same motion: real joints in genhexkins, trims in .comp files."""
    controller.enable(True)
    live, live_rests = run_program(controller), rests(controller)
    controller.close()
    options = ["--model", calibrated.model_file, "--box=-100,-100,350,100,100,450", "--linuxcnc", str(tmp_path)]
    assert cli.main(["export", "--machine", str(CONFIG / "paper.yaml"), *options]) == 0
    files = {path.name: path.read_text() for path in tmp_path.iterdir() if path.suffix in (".hal", ".comp")}
    comp = {f"[JOINT_{i}]\n": f"[JOINT_{i}]\nCOMP_FILE = strut_{i + 1}.comp\nCOMP_FILE_TYPE = 1\n" for i in range(6)}
    with Linuxcnc({"ENABLE = 1": "ENABLE = 0", **comp}, files) as linuxcnc:
        linuxcnc.ask("on")
        linuxcnc.ask("home")
        static, static_rests = run_program(linuxcnc), rests(linuxcnc)
    left = [rms(in_force(calibrated.truth, live)) * 1e6, rms(tool_errors(calibrated.truth, static)) * 1e6]
    apart = np.abs(static_rests - live_rests).max() * 1e3
    print(f"\nlive {left[0]:.2f} µm, static {left[1]:.2f} µm RMS; struts at rest {apart:.3f} µm apart")
    assert np.ptp(static.corrections) == 0.0
    assert abs(left[0] - left[1]) < 0.5
    assert apart < 0.1  # the model has structure only: both are exact up to LinuxCNC's single-precision tables


def rests(linuxcnc: Linuxcnc) -> np.ndarray:
    """Return the drives' lengths at rest at poses of Table 1, mm, (10, 6)."""
    found = []
    for alpha, beta, gamma, x, y, z in table_1():
        linuxcnc.ask("mdi", f"G0 X{x} Y{y} Z{z} A{alpha} B{beta} C{gamma}")
        time.sleep(0.2)  # the loop has answered and the ramp has ended
        found.append(linuxcnc.struts())
    return np.array(found)
