"""End to end: measure → fit → model file → compensator and strut drive over DDS, judged by the fit's own report.

The machine is B of the calibration bars: ±100 µm on every joint coordinate and strut, 100 ppm pitch, 4 µm of a
10 mm lead, 3–5 µm backlash, no field; drawn from a seed, so its errors are known, and hidden from everything but
the instruments and the drive. What the fit promises is its report's: the RMS tool error left, and the interval
in which it lies with 95 %.
"""

from __future__ import annotations

import contextlib
import io
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_helpers import BOUNDS, BOX, SETTINGS, campaign, measured, paper, virtual_machine
from helpers import central_difference, moved
from node_helpers import HOME, Bench, closed_form_lengths, geometry_file
from scipy.stats import binom

from hexapod_comp import cli
from hexapod_comp.calibration.evaluation import held_out
from hexapod_comp.calibration.fit import fit_model
from hexapod_comp.machine.arrays import Size
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, ModelOrigin, RealMachine
from hexapod_comp.machine.model_file import load_model, save_model
from hexapod_comp.machine.passes import Passes
from hexapod_comp.machine.trajectory import move
from hexapod_comp.machine.trial import ToolErrors, Trial
from hexapod_comp.pose import Pose
from hexapod_comp.ros.messages import message_pose
from hexapod_comp.virtual.imperfections import draw_model

# The box and the lasers of the bars, a quarter of their lines, half their readings, the four body diagonals
CAMPAIGN = """format: hexapod_comp/campaign
version: 1
box_mm: [[-203.2, -203.2, 350], [203.2, 203.2, 553.2]]
cell_in: 8
step_in: 2
instrument: 5-D
diagonals: 4
cycles: 2
"""

# The machine has the first three; a length map it has not, and the fit has to find that out
BLOCKS = ("pitch", "wave", "backlash", "map")

POINTS = 15  # held-out points, each approached from both sides: 30 rests
APPROACH = 2e-3  # way on which a point is approached, m: four hundred times the backlash

# Every strut changes by this share of the approach and more: 100 µm, so that each takes up its backlash
LEAST_SHARE = 0.05

STEP = 0.1e-6  # motor step of the drive, m; the shipped default
REST = 1e-9  # what the motor step does not explain: as in test_loop.py, m

# Commands per second, Hz; largest tool speed on the way and on the approach, m/s
RATE, FEED, APPROACH_FEED = 100.0, 2.0, 0.075


@dataclass(frozen=True)
class Promise:
    """A calibrated machine: the truth, the model file, and what the fit's report says that it is worth."""

    truth_file: str
    model_file: str
    truth: RealMachine
    model: MachineModel
    before: float
    after: float
    low: float
    high: float


@pytest.fixture(scope="module")
def promise(tmp_path_factory: pytest.TempPathFactory) -> Promise:
    """Calibrate the machine by the command line, from file to file."""
    folder = tmp_path_factory.mktemp("calibration")
    files = {n: str(folder / n) for n in ("truth.yaml", "campaign.yaml", "measured.csv", "model.yaml")}
    Path(files["campaign.yaml"]).write_text(CAMPAIGN)
    dated = ModelOrigin("2026-01-31", note="hidden truth of a test")
    save_model(replace(draw_model(paper(), BOUNDS, seed=11), origin=dated), files["truth.yaml"])
    options = ["--truth", files["truth.yaml"], "--campaign", files["campaign.yaml"], "--seed", "11"]
    assert cli.main(["simulate", *options, "--out", files["measured.csv"]]) == 0
    options = ["--lead-mm", "10", "--blocks", ",".join(BLOCKS), "--json"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert cli.main(["fit", files["measured.csv"], *options, "--out", files["model.yaml"]]) == 0
    expected = json.loads(out.getvalue())["expected_tool_error"]
    return Promise(
        truth_file=files["truth.yaml"],
        model_file=files["model.yaml"],
        truth=RealMachine(paper(), load_model(files["truth.yaml"], paper())),
        model=load_model(files["model.yaml"], paper()),
        **{name: expected[f"{name}_m"] for name in ("before", "after", "low", "high")},
    )


@pytest.fixture
def bench(ros_context: Any, capfd: pytest.CaptureFixture[str]) -> Iterator[Bench]:
    with Bench(ros_context, capfd) as made:
        yield made


def held_out_points(geometry: HexapodGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) in the box, in an order of short ways, and a direction of approach for each, (n, 3)."""
    rng = np.random.default_rng(2026)
    inside = np.array([[1.0], [-1.0]]) * APPROACH + BOX
    points: list[np.ndarray] = []
    ways: list[np.ndarray] = []
    while len(points) < POINTS:
        point, way = rng.uniform(inside[0], inside[1]), rng.standard_normal(3)
        way /= np.linalg.norm(way)
        legs = point + geometry.platform_joints - geometry.base_joints  # level: along them the struts change
        legs /= np.linalg.norm(legs, axis=1, keepdims=True)
        if np.abs(legs @ way).min() > LEAST_SHARE:
            points.append(point)
            ways.append(way)
    order = [0]
    while len(order) < POINTS:
        left = [n for n in range(POINTS) if n not in order]
        order.append(min(left, key=lambda n: float(np.linalg.norm(points[n] - points[order[-1]]))))
    return np.array(points)[order], np.array(ways)[order]


def start_loop(bench: Bench, folder: Path, promise: Promise) -> HexapodGeometry:
    """Start both nodes on a machine that is as accurate but faster than the paper's: 30 rests take seconds."""
    file = geometry_file(folder, {"speed_mm_s": 5000, "step_mm": 40})
    bench.drive(geometry_file=file, truth_file=promise.truth_file, step=STEP, max_acceleration=200.0)
    # Every command is waited for: one that a busy machine delivers late is late, not lost.
    # Its drives overshoot by some 15 mm.
    settings = {"max_command_age": 0.0, "following_error_limit": 0.0}
    node = bench.compensator(geometry_file=file, model_file=promise.model_file, **settings)
    both: list[Any] = [*node.publishers, *node.subscriptions]
    ends = {end.topic_name: end for end in both}
    bench.until(lambda: ends["/strut_commands"].get_subscription_count() == 2, "the drive to hear the compensator")
    bench.until(lambda: bench.seen["tool_pose_true"] and bench.seen["strut_states"], "readings")
    return load_geometry(file)


def is_past(due: float) -> bool:
    return time.monotonic() >= due


def go(bench: Bench, geometry: HexapodGeometry, start: np.ndarray, end: np.ndarray, feed: float) -> None:
    """Move from point to point, each command after the answer to the one before."""
    path = move(geometry, Pose(start, np.eye(3)), Pose(end, np.eye(3)), RATE, feed)
    due = time.monotonic()
    for index in range(len(path)):
        bench.ask(path.pose(index))
        due += 1.0 / RATE
        bench.until(partial(is_past, due), "the next command to be due")


def rest(bench: Bench) -> Pose:
    """Wait until the true tool stands still, and return where: 30 ms, six of the drives' lags, within 1 nm."""
    bench.seen["tool_pose_true"].clear()

    def quiet() -> bool:
        recent = [message_pose(message).position for message in bench.seen["tool_pose_true"][-15:]]
        return len(recent) == 15 and float(np.ptp(recent, axis=0).max()) < 1e-9

    bench.until(quiet, "the tool to rest")
    return message_pose(bench.seen["tool_pose_true"][-1])


def visit(bench: Bench, geometry: HexapodGeometry, points: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Approach each point along its way and against it; return where the tool stood, (2 n, 3): there, then back."""
    at = HOME.position
    bench.settle(HOME)
    found: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for point, way in zip(points, ways, strict=True):
        for stood, side in zip(found, (1.0, -1.0), strict=True):
            before = point - side * APPROACH * way
            go(bench, geometry, at, before, FEED if side > 0.0 else APPROACH_FEED)
            go(bench, geometry, before, point, APPROACH_FEED)
            stood.append(rest(bench).position)
            at = point
    return np.array(found[0] + found[1])


def aligned_rms(points: np.ndarray, displacement: np.ndarray) -> float:
    rest = np.zeros_like(points)
    return Size.of(ToolErrors(points, displacement, rest, rest).aligned().displacement).rms


def leverage(point: np.ndarray) -> np.ndarray:
    """Return what each strut's length moves the tool by, (3, 6) m per m, from closed-form strut lengths."""
    jacobian = central_difference(lambda twist: closed_form_lengths(moved(Pose(point, np.eye(3)), twist)), np.zeros(6))
    return np.linalg.inv(jacobian)[:3]


def test_the_loop_leaves_what_the_fit_promised(bench: Bench, tmp_path: Path, promise: Promise) -> None:
    """The issue's last sentence: the error at held-out points falls by what the report predicted."""
    # The promise is of the RMS over the whole box. The loop adds two things. Motors stand on steps of 0.1 µm: each
    # strut is off by up to half a step, evenly distributed, standard deviation step/√12, and the tool by that times the
    # struts' leverage, added as squares (some 0.05 µm, next to some 0.2 µm promised). And 30 rests are not the whole
    # box: an RMS of 15 independent error vectors of three components scatters by 1/√(2·45) = 10.5 %, so the interval is
    # widened by twice that. A wrong sign, or one block that is lost between file and machine, would leave microns.
    geometry = start_loop(bench, tmp_path, promise)
    points, ways = held_out_points(geometry)
    actual, wanted = visit(bench, geometry, points, ways), np.tile(points, (2, 1))
    after = aligned_rms(wanted, actual - wanted)

    levers = np.array([leverage(point) for point in points])
    steps = STEP / np.sqrt(12.0) * float(np.sqrt((levers**2).sum(axis=(1, 2)).mean()))
    sampling = 2.0 / np.sqrt(2.0 * 3.0 * POINTS)
    low, high = promise.low * (1.0 - sampling), promise.high * (1.0 + sampling)
    print(f"left {after * 1e6:.3f} µm, promised {promise.after * 1e6:.3f} ({promise.low * 1e6:.3f}…"
          f"{promise.high * 1e6:.3f}) µm, steps {steps * 1e6:.3f} µm")  # fmt: skip
    assert low <= after <= np.hypot(high, steps)

    trial = Trial(promise.truth, Passes(geometry, points, np.tile(np.eye(3), (POINTS, 1, 1)), ways).both_ways())
    before = aligned_rms(wanted, trial.errors(trial.commands(None)).displacement)
    assert before == pytest.approx(promise.before, rel=4.0 * sampling)  # as the machine is: larger, and less even
    assert 1.0 - after / before >= 0.97

    # Nothing else stands between the model file and the tool: struts off by half a step, all the same way at worst.
    expected, _ = trial.drive(trial.commands(promise.model)).actual
    bound = np.tile(np.abs(levers).sum(axis=2) * STEP / 2.0 + REST, (2, 1))
    assert (np.abs(actual - expected) <= bound).all()


MACHINES = 8  # machines whose promises are checked without DDS

# So many of them must lie in their interval: fewer would happen once in a hundred honest studies
LEAST_KEPT = int(binom.ppf(0.01, MACHINES, 0.95))


def test_promises_are_kept_as_often_as_they_say(unsuspected: None) -> None:
    """Eight machines, eight noises: the RMS at 500 held-out points lies in the fit's 95 % interval. 40 others
    kept 39 (5-D) promises; the points' own scatter is 1 %, against an interval of ±40 %."""
    kept, left = [], []
    settings = replace(SETTINGS, blocks=("pitch", "wave", "backlash"))
    for seed in range(21, 21 + MACHINES):
        truth = virtual_machine(seed)
        level = (fit := fit_model(measured(truth, campaign(), seed), settings)).level
        assert level is not None
        before, after = (held_out(truth, model, BOX, 500, seed).aligned.rms for model in (None, fit.model))
        kept.append(level.low <= after <= level.high)
        left.append((before, after))
        assert level.before == pytest.approx(before, rel=0.1)
    assert sum(kept) >= LEAST_KEPT, kept
    before, after = np.sqrt((np.array(left) ** 2).mean(axis=0))
    assert after < 0.03 * before, "machine B's bar for the whole campaign, met by a quarter of it"
