"""The compensator in the loop of a real controller: LinuxCNC 2.9 with the shipped configuration, no mock.

LinuxCNC plans, runs genhexkins and the safety chain at 1 kHz, and moves simulated drives; a bridge and a compensator
run beside it as processes of their own. Behind the drives stands a hidden machine whose joints are off by up to
±100 µm. What it does with the drives' lengths, recorded in every servo cycle by LinuxCNC's own sampler, is worked out
afterwards with RealMachine: the truth is known, and nothing of the loop takes part in judging it.

The compensator's model is not the truth: it is fitted to virtual readings of that machine by measure and fit.
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
from linuxcnc_helpers import Linuxcnc, Record, why_not
from scipy.ndimage import distance_transform_edt

from hexapod_comp import cli
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin, MotionState, RealMachine
from hexapod_comp.machine.model_file import save_model

pytestmark = [pytest.mark.skipif(bool(why_not()), reason=f"LinuxCNC: {why_not()}"), pytest.mark.timeout(600)]

CONFIG = Path(__file__).resolve().parents[2] / "config"

# Lasers see everything but where the machine stands as a whole; the tracker's poses see that
CAMPAIGN = """format: hexapod_comp/campaign
version: 1
box_mm: [[-203.2, -203.2, 350], [203.2, 203.2, 553.2]]
cell_in: 8
step_in: 2
instrument: 5-D
diagonals: 4
poses: 240
tilt_deg: 10
noise: {linear_um: 1, straightness_um: 1, rotation_urad: 1, position_um: 10, attitude_urad: 10}
beam_slope_urad: 100
"""

# A circle of 120 mm diameter at 25 mm/s, then two moves with a tilting tool
PROGRAM = """G21 G90 G94
G1 X60 Y0 Z400 A0 B0 C0 F1500
G3 X60 Y0 I-60 J0
G1 X20 Y-30 Z420 A6 B-5 C4
G1 X-20 Y20 Z390 A-5 B6 C-3
M2
"""

RAMP = 1e-3  # configured ramp of the corrections, mm per servo cycle of 1 ms: 1 mm/s
DIGITS = 1.1e-6  # two readings of halsampler, mm: it prints six digits behind the point
LATE = 500  # servo cycles, ms, that a process may be kept waiting by a machine that does much else
EVERY = 5  # every so many cycles of a record are judged: neighbours are micrometres apart


def uniform(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return deviations of up to ±100 µm, m."""
    return rng.uniform(-100e-6, 100e-6, shape)


@dataclass(frozen=True)
class Calibrated:
    """A hidden machine and a model fitted to readings of it."""

    truth: RealMachine
    model_text: str
    model_file: str


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """Measure a machine that is off by ±100 µm in every joint coordinate, and fit a model to the readings."""
    folder = tmp_path_factory.mktemp("calibrated")
    files = {n: str(folder / n) for n in ("truth.yaml", "campaign.yaml", "measured.csv", "model.yaml")}
    rng = np.random.default_rng(5)
    platform = np.repeat(uniform(rng, 3, 3), 2, axis=0)  # struts meet in pairs
    origin = ModelOrigin("2026-01-31", note="hidden truth of a test")
    model = MachineModel(
        "paper", "truth", base_deviation=uniform(rng, 6, 3), platform_deviation=platform, origin=origin
    )
    save_model(model, files["truth.yaml"])
    Path(files["campaign.yaml"]).write_text(CAMPAIGN)
    options = ["--truth", files["truth.yaml"], "--campaign", files["campaign.yaml"], "--seed", "5"]
    assert cli.main(["simulate", *options, "--out", files["measured.csv"]]) == 0
    fitted = ["--blocks", "structure", "--tracker-frame", "known"]  # the virtual tracker stands in the work frame
    assert cli.main(["fit", files["measured.csv"], *fitted, "--out", files["model.yaml"]]) == 0
    truth = RealMachine(load_geometry(CONFIG / "paper.yaml"), model)
    return Calibrated(truth, Path(files["model.yaml"]).read_text(), files["model.yaml"])


@pytest.fixture(scope="module")
def controller(calibrated: Calibrated) -> Iterator[Linuxcnc]:
    """Give a LinuxCNC that is on and homed, with a compensator; compensation is off."""
    with Linuxcnc({"ENABLE = 1": "ENABLE = 0"}) as linuxcnc:
        linuxcnc.compensator(linuxcnc.give_file("model.yaml", calibrated.model_text))
        linuxcnc.ask("on")
        linuxcnc.ask("home")
        yield linuxcnc


def run_program(linuxcnc: Linuxcnc, text: str = PROGRAM) -> Record:
    """Go to the program's start, run it, and return the record of it."""
    linuxcnc.ask("mdi", "G0 X0 Y0 Z400 A0 B0 C0")
    path = linuxcnc.give_file("part.ngc", text)
    with linuxcnc.recording() as record:
        linuxcnc.ask("program", path)
        linuxcnc.ask("finish")
    return record


def tool_errors(truth: RealMachine, record: Record, tool_length: float = 0.0) -> np.ndarray:
    """Return true minus commanded tool positions along a record, m, shape (N, 3)."""
    # The machine has neither backlash nor field: directions of motion do not matter.
    up = np.array([0.0, 0.0, tool_length])
    guess, sense, errors = truth.geometry.home, MotionState().sense, []
    for axes, struts in zip(record.axes[::EVERY], record.struts[::EVERY], strict=True):
        guess, _ = truth.pose_for(struts * 1e-3, sense, guess)
        tip = guess.position - guess.rotation @ up  # the paper's tool frame is its platform's, base is work
        errors.append(tip - (axes[:3] * 1e-3 - up))
    return np.array(errors)


def in_force(truth: RealMachine, record: Record, tool_length: float = 0.0) -> np.ndarray:
    """Return the tool errors of a record while the corrections were in force, m, shape (N, 3)."""
    # On a machine under load processes stand still for longer than the bridge's timeout now and then; the corrections
    # then ramp out and in again, as they must. That is another test's matter.
    errors = tool_errors(truth, record, tool_length)
    there = settled(record, 2)[::EVERY]
    print(f"\ncorrections in force for {100 * there.mean():.0f} % of the time")
    assert there.mean() > 0.2
    return errors[there]


def settled(record: Record, status: int) -> np.ndarray:
    """Return in which cycles a living bridge has had a status for 0.3 s, and keeps it for 0.3 s, bool, shape (N,)."""
    # The status of a bridge that is dead, or kept waiting, is an old one.
    there = (record.status == status) & record.alive
    return np.ones(len(there), bool) if there.all() else distance_transform_edt(there) > 300.0


def rms(errors: np.ndarray) -> float:
    """Return the root mean square of vectors' lengths."""
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def assert_undisturbed(linuxcnc: Linuxcnc, record: Record) -> None:
    """Nothing stopped, nothing stepped."""
    assert linuxcnc.ask("errors") == []
    assert record.following_error < linuxcnc.get("joint.0.f-error-lim")
    assert (record.side[:, -1] == 1.0).all(), "LinuxCNC was off, or not homed, for a while"
    assert record.largest_step <= RAMP + DIGITS


def table_1() -> list[list[float]]:
    """Return α, β, γ, degrees, x, y, z, mm, of Table 1's rows."""
    with (CONFIG / "table1.csv").open(newline="") as file:
        return [[float(word) for word in row[1:]] for row in list(csv.reader(file))[1:]]


def test_a_fitted_model_takes_the_error_away(controller: Linuxcnc, calibrated: Calibrated) -> None:
    """Bar: at least 95 % of the tool's RMS error over a circle and tilted moves."""
    controller.enable(False)
    without = run_program(controller)
    controller.enable(True)
    compensated = run_program(controller)
    before, after = rms(tool_errors(calibrated.truth, without)), rms(in_force(calibrated.truth, compensated))
    print(f"\ntool error {before * 1e6:.2f} -> {after * 1e6:.2f} µm RMS, {100 * (1 - after / before):.1f} % less")
    assert np.ptp(without.corrections) == 0.0
    assert before > 30e-6
    assert after <= 0.05 * before
    assert_undisturbed(controller, without)
    assert_undisturbed(controller, compensated)


def test_a_killed_compensator(controller: Linuxcnc, calibrated: Calibrated) -> None:
    """kill -9 in the middle of a circle: the correction ramps out, LinuxCNC goes on; a new one ramps in."""
    controller.enable(True)
    slow = PROGRAM.replace("F1500", "F900").split("G1 X20")[0] + "M2\n"
    controller.ask("mdi", "G0 X60 Y0 Z400 A0 B0 C0")
    with controller.recording() as record:
        controller.ask("program", controller.give_file("slow.ngc", slow))
        time.sleep(3.0)
        controller.newest_compensator.end(signal.SIGKILL)
        controller.until_pin("hexapod_comp.status", 5)
        controller.compensator(str(controller.folder / "model.yaml"))
        controller.until_pin("hexapod_comp.status", 2)
        time.sleep(2.0)
        assert not controller.ask("stat", "inpos")[0], "the circle was too short for this test"
        controller.ask("finish")
    assert_undisturbed(controller, record)
    assert_ramped_out_and_in(record)
    errors = tool_errors(calibrated.truth, record)
    there, gone = (settled(record, status)[::EVERY] for status in (2, 5))
    print(f"\nwith the compensator {rms(errors[there]) * 1e6:.2f} µm RMS, without it {rms(errors[gone]) * 1e6:.2f} µm")
    assert rms(errors[there]) <= 0.05 * rms(errors[gone])


def assert_ramped_out_and_in(record: Record) -> None:
    """Corrections went to zero along the ramp, neither faster nor much slower than configured, and came back."""
    largest = np.abs(record.corrections).max(axis=1)
    zero = np.flatnonzero(largest == 0.0)
    assert len(zero), "the corrections never got to zero"
    height = largest[max(zero[0] - 1000, 0) : zero[0]].max()
    start = np.flatnonzero(largest[: zero[0]] > height - 0.002)[-1]  # a moving tool's correction changes a little
    took, needed = zero[0] - start, (height - 0.002) / RAMP
    print(f"\ncorrections of up to {height * 1e3:.0f} µm went to zero in {took} ms")
    assert needed - 1.0 <= took <= needed + LATE
    assert largest[-1] > 0.5 * height, "the corrections did not come back"


def test_a_killed_bridge(controller: Linuxcnc) -> None:
    """kill -9 of the bridge in the middle of a circle: the realtime chain ramps out; bridge.hal brings it back."""
    controller.enable(True)
    slow = PROGRAM.replace("F1500", "F900").split("G1 X20")[0] + "M2\n"
    controller.ask("mdi", "G0 X60 Y0 Z400 A0 B0 C0")
    with controller.recording() as record:
        controller.ask("program", controller.give_file("slow.ngc", slow))
        time.sleep(2.0)
        os.kill(controller.pid_of("hexapod_comp"), signal.SIGKILL)
        controller.until_pin("comp-alive", False)
        controller.until_pin("comp-missing", True)
        controller.until_pin("ramp.0.out", 0.0)
        controller.halcmd("-i", "headless.ini.expanded", "-f", "bridge.hal")
        controller.until_pin("hexapod_comp.status", 2)
        controller.until_pin("comp-missing", False)
        time.sleep(1.0)
        controller.ask("finish")
    # The new component's status pin is not the old one's: only the first columns are continuous.
    assert_undisturbed(controller, record)
    assert_ramped_out_and_in(record)


def test_tool_length(controller: Linuxcnc, calibrated: Calibrated) -> None:
    """A tool 50 mm longer: the tip, not the geometry file's tool frame, goes where G-code says, tilted too."""
    program = """G21 G90 G94 T2 M6 G43
G1 X0 Y0 Z400 A0 B0 C0 F1500
G1 X20 Y-30 Z370 A6 B-5 C4
G1 X-20 Y20 Z380 A-5 B6 C-3
G1 X0 Y0 Z360 A0 B0 C0
M2
"""
    errors = {}
    try:
        for on in (False, True):
            controller.enable(on)
            judge = in_force if on else tool_errors
            errors[on] = rms(judge(calibrated.truth, run_program(controller, program), 0.050))
    finally:
        controller.ask("mdi", "G49")
    print(f"\ntip of the long tool: {errors[False] * 1e6:.2f} -> {errors[True] * 1e6:.2f} µm RMS")
    assert errors[True] <= 0.05 * errors[False]


def test_the_exported_model_agrees(controller: Linuxcnc, calibrated: Calibrated, tmp_path: Path) -> None:
    """The same model without a bridge: real joints in genhexkins, the rest in .comp files, the same program."""
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
    assert apart < 0.1  # the model is structure only: both are exact, but for LinuxCNC's single-precision tables


def rests(linuxcnc: Linuxcnc) -> np.ndarray:
    """Return the drives' lengths at rest at poses of Table 1, mm, shape (10, 6)."""
    found = []
    for alpha, beta, gamma, x, y, z in table_1():
        linuxcnc.ask("mdi", f"G0 X{x} Y{y} Z{z} A{alpha} B{beta} C{gamma}")
        time.sleep(0.2)  # the loop has answered, the ramp is through
        found.append(linuxcnc.struts())
    return np.array(found)
