"""Machines of the zoo through every verb and the node pair, with files as a user has them; all with ALL_TESTS=1.

The kinematics of :mod:`foreign_machines`, which are not the package's, check simulate, fit, check, ik, fk, export, run,
replay and classify. There is one campaign and one fit per machine; if tests run in several processes, conftest keeps
those of a machine in one.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from foreign_machines import (
    MM,
    UM,
    Errors,
    Frame,
    Machine,
    aligned_rms,
    commands,
    goes_to,
    machine_names,
    machines,
    rotation,
    tool_errors,
)
from helpers import hexapod
from scipy.spatial.transform import Rotation

from hexapod_comp import cli
from hexapod_comp.calibration.parameters import ParameterSpace
from hexapod_comp.calibration.posterior import ErrorPredictor
from hexapod_comp.calibration.posterior_file import load_posterior
from hexapod_comp.export.linuxcnc import read_genhexkins
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model

NOISE = 0.5 * UM  # standard deviation of the laser's noise

STEP = 0.1 * UM  # the drive's default motor step

WRITTEN = 1e-11  # m; the last digit of CSV files is a picometre, and a few roundings add up


@dataclass(frozen=True)
class Animal:
    """A machine, its true errors, and the folder with its files; `fit` is the JSON output of fit."""

    machine: Machine
    truth: Errors
    folder: Path
    fit: dict[str, Any]

    def file(self, name: str) -> str:
        return str(self.folder / name)

    def says(self, *words: object, code: int = 0) -> str:
        return said(*words, "--machine", self.file("machine.yaml"), code=code)

    def tells(self, *words: object, code: int = 0) -> dict[str, Any]:
        return json.loads(self.says(*words, "--json", code=code))

    @property
    def model(self) -> str:
        return self.file("model.yaml")

    @property
    def believed(self) -> Errors:
        return Errors.read(self.folder / "model.yaml")

    def parameters(self, space: ParameterSpace) -> np.ndarray:
        """Return the true errors as a fit's parameters, with platform joints at one place counted once."""
        first = np.unique(space.platform_groups, return_index=True)[1]
        parts = self.truth.base.ravel(), self.truth.platform[first].ravel(), self.truth.offset, self.truth.pitch
        return np.concatenate(parts[: 3 + len(space.blocks[1:])])


def said(*words: object, code: int = 0) -> str:
    """Run the command in this process; return its stdout. stderr is not captured, since ROS's log needs a real one."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        found = cli.main([str(word) for word in words])
    assert found == code, f"{words}: {found}\n{out.getvalue()}"
    return out.getvalue()


@pytest.fixture(scope="module", params=machine_names())
def animal(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Animal:
    """Give a machine errors of 50 µm on joints and struts and 50 ppm on screws; measure it, and fit these errors."""
    machine = machines()[request.param]
    folder = tmp_path_factory.mktemp("zoo")
    truth = Errors.drawn(machine, 7)
    machine.write(folder / "machine.yaml")
    truth.write(folder / "truth.yaml", machine)
    shortest = 2.0 * min(machine.half)
    # A linear laser on a coarse grid of the machine's box and on its diagonals, twice in both directions
    campaign = {
        "format": "hexapod_comp/campaign",
        "version": 1,
        "box_m": machine.box.tolist(),
        "cell_m": shortest,
        "step_m": shortest / 5.0,
        "instrument": "1-D",
        "diagonals": 16,
        "cycles": 2,
        "noise": {"linear_m": NOISE},
    }
    (folder / "campaign.yaml").write_text(yaml.safe_dump(campaign))
    tips, angles, _ = tool_poses(machine)
    rows = [",".join(f"{v:.12f}" for v in row) for row in np.hstack([tips / MM, angles])]
    (folder / "poses.csv").write_text("\n".join(["x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg", *rows]) + "\n")
    files = ["--machine", folder / "machine.yaml", "--truth", folder / "truth.yaml"]
    said("simulate", "--campaign", folder / "campaign.yaml", "--out", folder / "readings.csv", *files)
    printed = said(
        "fit", folder / "readings.csv", "--blocks", "pitch", "--out", folder / "model.yaml", "--json", *files
    )
    return Animal(machine, truth, folder, json.loads(printed))


def tool_poses(machine: Machine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return four tool poses in work near the middle, tilted by up to 2°: tips, angles (degrees), rotations."""
    rng = np.random.default_rng(3)
    tips = machine.middle + rng.uniform(-0.1, 0.1, (4, 3)) * np.array(machine.half)
    angles = rng.uniform(-2.0, 2.0, (4, 3))
    return tips, angles, np.array([rotation(*row) for row in angles])


def somewhere(machine: Machine, count: int = 1000) -> np.ndarray:
    """Return random places of the measured box, in work."""
    return np.random.default_rng(11).uniform(*machine.box, (count, 3))


def corners(box: np.ndarray) -> np.ndarray:
    return np.array(np.meshgrid(*box.T)).reshape(3, 8).T


def table(path: str | Path) -> list[dict[str, str]]:
    """Read a CSV file with comment lines."""
    lines = [line for line in Path(path).read_text().splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def columns(rows: list[dict[str, Any]], *names: str) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows])


def lengths(rows: list[dict[str, Any]], form: str = "L{}_mm") -> np.ndarray:
    """Return the lengths of all rows, (N, 6), m."""
    return columns(rows, *(form.format(i) for i in range(1, 7))) * (MM if form.endswith("mm") else UM)


def leverage(machine: Machine, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the tip's displacement by each strut's length, (N, 3, 6), m per m, by differences."""
    none, poses = Errors.none(), (positions, rotations)
    told, moved = commands(machine, none, *poses), []
    for change in UM * np.eye(6):
        ends = [machine.tips(*goes_to(machine, none, told + way * change, *poses)) for way in (1.0, -1.0)]
        moved.append((ends[0] - ends[1]) / (2.0 * UM))
    return np.stack(moved, axis=2)


def test_simulate_reads_what_the_machine_does(animal: Animal) -> None:
    """Each reading is the tool's error along its line in work, relative to the line's first, plus the laser's noise."""
    rows = table(animal.file("readings.csv"))
    tips, value = columns(rows, "x_mm", "y_mm", "z_mm") * MM, columns(rows, "value")[:, 0] * UM
    assert {row["channel"] for row in rows} == {"linear"}
    assert {row["unit"] for row in rows} == {"um"}
    errors = tool_errors(animal.machine, animal.truth, None, tips)
    expected = np.empty(len(rows))
    for run in {row["run"] for row in rows}:
        members = np.flatnonzero([row["run"] == run for row in rows])
        ways = tips[members] - tips[members[0]]
        along = ways[np.linalg.norm(ways, axis=1).argmax()]
        along *= np.sign(along[np.abs(along) > 1e-9][0]) / np.linalg.norm(along)
        expected[members] = (errors[members] - errors[members[0]]) @ along
    left = value - expected
    assert np.abs(left).max() < 5.0 * NOISE, "5 σ: once in two million readings"
    assert np.std(left) == pytest.approx(NOISE, rel=0.1)


def test_the_figures_of_fit_are_the_machines(animal: Animal) -> None:
    """The truth is evaluated here at other random places of the measured box. The mean square of 1,000 places, whose
    squares scatter by their own size, is good to 3/√1000 = 10 %, its root to 5 %; both draws together to 7 %.

    The paper's measure is the mean |error| along lines relative to their start. Both means are over 60 and 600 lines
    whose values scatter by about their size: 3/√60 = 40 %.
    """
    machine, tips, worth = animal.machine, somewhere(animal.machine), animal.fit["worth"]
    rng, box, aligned = np.random.default_rng(12), animal.machine.box, []
    for name, believed in (("without", None), ("with", animal.believed)):
        errors = tool_errors(machine, animal.truth, believed, tips)
        aligned.append(aligned_rms(tips, errors))
        raw = np.sqrt((errors**2).sum(axis=1).mean())
        assert worth[f"error_{name}"]["aligned_rms_m"] == pytest.approx(aligned[-1], rel=0.07)
        assert worth[f"error_{name}"]["rms_m"] == pytest.approx(raw, rel=0.07)
        read: list[float] = []
        for axis in range(3):
            lines = np.tile(rng.uniform(*box, (200, 1, 3)), (1, 9, 1))
            lines[:, :, axis] = np.linspace(box[0, axis], box[1, axis], 9)
            found = tool_errors(machine, animal.truth, believed, lines.reshape(-1, 3))[:, axis].reshape(200, 9)
            # A long axis has more readings, one per inch
            means = np.abs(found[:, 1:] - found[:, :1]).mean(axis=1).tolist()
            read += means * len(np.arange(0.0127, np.ptp(box[:, axis]), 0.0254))
        along = worth["mean_displacement_error_along_lines"][f"{name}_m"]
        assert along == pytest.approx(np.mean(read), rel=0.4, abs=0.02 * UM)
    assert aligned[1] < 0.05 * aligned[0]
    # The fitted machine's own error differs from the true one by the fit's error, at most a twentieth
    assert animal.fit["expected_tool_error"]["before_m"] == pytest.approx(aligned[0], rel=0.1)


def test_the_truth_lies_within_every_published_deviation(animal: Animal) -> None:
    """Errors of parameters, and of six components at tilted poses, by independent kinematics, over stated deviations.

    One machine's poses share its parameters: with 8 informative ones, |z| < 2 for 75 % of all components, and |z| < 5
    for each with a million to one. The squared Mahalanobis distances of 6 components stay below the 1e-7 quantile of
    χ², 44.
    """
    machine, geometry = animal.machine, load_geometry(animal.file("machine.yaml"))
    model = load_model(animal.model, geometry)
    fitted = load_posterior(model, geometry, animal.model)[0]
    assert fitted is not None
    rng = np.random.default_rng(4)
    tips = np.vstack([machine.middle, somewhere(machine, 39)])
    tools = np.array([rotation(*angles) for angles in [(0.0, 0.0, 0.0), *rng.uniform(-2.0, 2.0, (39, 3))]])
    poses = machine.platform_poses(tips, tools)
    standing, _ = ErrorPredictor(RealMachine(geometry, model), fitted).predict(poses)
    assert standing.deviations is not None
    assert standing.covariance is not None
    positions, rotations = goes_to(machine, animal.truth, machine.lengths(*poses), *poses)
    turns = Rotation.from_matrix(rotations @ np.swapaxes(poses[1], 1, 2)).as_rotvec() @ machine.work.matrix
    off = np.hstack([machine.tips(positions, rotations) - tips, turns]) - standing.values
    z = np.abs(off / standing.deviations)
    assert z.max() < 5.0
    assert (z < 2.0).mean() > 0.75
    assert np.einsum("ni,ni->n", off, np.linalg.solve(standing.covariance, off[:, :, None])[:, :, 0]).max() < 44.0

    z = np.abs((animal.parameters(fitted.space) - fitted.x) / np.sqrt(np.diag(fitted.covariance)))
    assert z.max() < 5.0
    assert (z < 2.0).mean() > 0.75


def test_the_model_holds_in_the_box_that_was_measured(animal: Animal) -> None:
    """The model file's box is in its frame: the laser followed the tool's tip, and home is inside."""
    region = yaml.safe_load(Path(animal.model).read_text())["region"]
    machine, box = animal.machine, np.array(region["box_mm"]) * MM
    np.testing.assert_allclose(box, machine.box, atol=1e-9)
    np.testing.assert_allclose(np.array(region.get("point_mm", [0.0] * 3)) * MM, machine.tool.position, atol=1e-12)
    position, angles = (region.get(key, [0.0] * 3) for key in ("position_mm", "rotation_deg"))
    frame = Frame(tuple(np.array(position) * MM), tuple(angles))
    np.testing.assert_allclose(frame.position, machine.work.position, atol=1e-12)
    np.testing.assert_allclose(frame.matrix, machine.work.matrix, atol=1e-12)
    assert ((box[0] < machine.middle) & (machine.middle < box[1])).all()


def test_plan_expects_of_the_campaign_what_the_fit_achieves(animal: Animal) -> None:
    plan = animal.tells("plan", animal.file("campaign.yaml"), "--blocks", "pitch")
    assert plan["readings"] == len(table(animal.file("readings.csv")))
    assert 0.0 < plan["expected_tool_error"]["after_m"] < 0.05 * plan["expected_tool_error"]["before_m"]


@pytest.mark.parametrize("model", ["fitted", "none"])
def test_ik_and_fk(animal: Animal, model: str) -> None:
    """Nominal lengths are distances; commands are those of the fitted machine, or of turning screws without a model; fk
    inverts them, also from a cold start."""
    machine = animal.machine
    tips, angles, tools = tool_poses(machine)
    poses = machine.platform_poses(tips, tools)
    given, believed = {"fitted": (["--model", animal.model], animal.believed), "none": ([], Errors.none())}[model]
    rows = animal.tells("ik", animal.file("poses.csv"), *given, "--out", animal.file("L.csv"))["rows"]
    wanted = commands(machine, believed, *poses)
    np.testing.assert_allclose(lengths(rows), wanted, atol=WRITTEN)
    np.testing.assert_allclose(lengths(table(animal.file("L.csv"))), wanted, atol=WRITTEN)
    if given:
        np.testing.assert_allclose(lengths(rows, "nominal_L{}_mm"), machine.lengths(*poses), atol=WRITTEN)
        np.testing.assert_allclose(lengths(rows, "correction_L{}_um"), wanted - machine.lengths(*poses), atol=WRITTEN)
    for start in ((), ("--cold",)):
        back = animal.tells("fk", animal.file("L.csv"), *given, *start)
        assert back["frame"] == "work"
        np.testing.assert_allclose(columns(back["rows"], "x_mm", "y_mm", "z_mm") * MM, tips, atol=100 * WRITTEN)
        np.testing.assert_allclose(columns(back["rows"], "alpha_deg", "beta_deg", "gamma_deg"), angles, atol=1e-7)


def test_every_pose_of_all_modes_has_the_lengths(animal: Animal) -> None:
    """One pose is the working one, and a note says that there may be others."""
    machine = animal.machine
    tips, _, tools = tool_poses(machine)
    distances = machine.lengths(*machine.platform_poses(tips[:1], tools[:1]))[0]
    typed = "fk", "--lengths", ",".join(f"{v / MM:.12f}" for v in distances), "--all-modes", "--json"
    _, out, err = hexapod(*typed, "--machine", animal.file("machine.yaml"))
    assert "there may be poses that this search did not find" in err
    modes = json.loads(out)["modes"]
    places = columns(modes, "x_mm", "y_mm", "z_mm") * MM
    np.testing.assert_allclose(places[[mode["working"] for mode in modes]], tips[:1], atol=1e-9)
    turns = np.array([rotation(*row) for row in columns(modes, "alpha_deg", "beta_deg", "gamma_deg")])
    back = machine.lengths(*machine.platform_poses(places, turns))
    np.testing.assert_allclose(back, np.tile(distances, (len(modes), 1)), atol=1e-9)


def test_check(animal: Animal) -> None:
    """Home is inside the measured box of the model; a pose outside is named; stroke margins are recomputed."""
    machine = animal.machine
    home = animal.folder / "home.csv"
    home.write_text("x_mm,y_mm,z_mm\n" + ",".join(f"{v / MM:.9f}" for v in machine.middle) + "\n")
    text = animal.says("check", home, "--model", animal.model)
    assert "tool in work" in text
    assert "outside the box" not in text
    up = machine.work.matrix.T[:, 2]
    half = 0.5 * np.ptp(machine.platforms(corners(machine.box))[:, 2])
    home.write_text("x_mm,y_mm,z_mm\n" + ",".join(f"{v / MM:.9f}" for v in machine.middle + (half + UM) * up) + "\n")
    assert "outside the box" in animal.says("check", home, "--model", animal.model)
    found = animal.tells("check", home, "--model", animal.model)
    assert found["frame"] == "work"
    distances = machine.lengths(*level_poses(machine, machine.middle + half * up[None]))
    margin = np.minimum(distances - machine.stroke[0], machine.stroke[1] - distances).min()
    assert found["rows"][0]["stroke_margin_nominal_mm"] * MM == pytest.approx(margin, abs=2 * UM)


def test_exports_read_back(animal: Animal) -> None:
    """LinuxCNC's files and the table, read as by their users, give the commands of the fitted machine."""
    cnc, path = animal.folder / "cnc", animal.file("table.csv")
    found = animal.tells("export", "--model", animal.model, "--linuxcnc", cnc, "--table", path, "--step-mm", 1000)
    assert found["frame"] == "work"
    box = np.array(found["box_mm"]) * MM
    np.testing.assert_allclose(box, animal.machine.box, atol=1e-9)
    for check in found["checks"]:
        assert check["level"]["after_rms_um"] < 0.5 * check["level"]["before_rms_um"]

    rows = table(path)
    tips = columns(rows, "x_mm", "y_mm", "z_mm") * MM
    poses = level_poses(animal.machine, tips)
    wanted = commands(animal.machine, animal.believed, *poses)
    np.testing.assert_allclose(
        lengths(rows, "correction_L{}_um") + animal.machine.lengths(*poses), wanted, atol=WRITTEN
    )
    tips = np.random.default_rng(8).uniform(*box, (50, 3))
    wanted = commands(animal.machine, animal.believed, *level_poses(animal.machine, tips))
    # The files have six decimals of mm, and trims bend by a few ppm of the screws' rotation
    np.testing.assert_allclose(linuxcnc(cnc, tips), wanted, atol=3e-9)


def level_poses(machine: Machine, tips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return machine.platform_poses(tips, np.tile(np.eye(3), (len(tips), 1, 1)))


def linuxcnc(folder: Path, tips: np.ndarray) -> np.ndarray:
    """Return LinuxCNC's motor commands, (N, 6), m, at places of a level tool, from its files, for growing joints."""
    found = read_genhexkins(folder, "mm")
    joints = found.joints(tips, np.tile(np.eye(3), (len(tips), 1, 1)))
    growing = np.ones(len(tips), dtype=bool)
    return joints + np.stack([t.correction(joints[:, i], growing) for i, t in enumerate(found.tables)], axis=1)


def test_run_and_replay(animal: Animal, bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The node pair runs the fitted model on the true machine; commands and true poses are checked, the replay bit for
    bit.

    Each motor is on a step, so the tool is off by up to half a step of each strut times its leverage.
    """
    pytest.importorskip("rosbags")
    from hexapod_comp.ros.client import LoopClient
    from hexapod_comp.ros.recorder import BagRecorder

    # Nodes and client share one interpreter: on a busy computer an answer may take more than its second.
    monkeypatch.setattr(LoopClient.wait_for_answer, "__defaults__", (20.0,))
    machine = animal.machine
    tips, _, tools = tool_poses(machine)
    poses = machine.platform_poses(tips[:2], tools[:2])
    two = animal.folder / "two.csv"
    two.write_text("".join(Path(animal.file("poses.csv")).read_text().splitlines(keepends=True)[:3]))
    files = {"geometry_file": animal.file("machine.yaml")}
    bench.drive(truth_file=animal.file("truth.yaml"), **files)
    # A drive that waits for the processor must not stop the machine.
    patience = {"max_command_age": 0.0, "following_error_limit": 0.0}
    bench.compensator(model_file=animal.model, ramp_rate=0.01, **patience, **files)
    bench.remove_publisher("tool_pose_command")  # only one publisher may command
    bag, pages = animal.folder / "bag", list[int]()
    with spinning(bench), BagRecorder(bag) as recorder:
        recorder.run(lambda: not recorder.journal)
        listening = threading.Thread(target=recorder.run, args=(lambda: not pages or recorder.journal < pages[0] + 2,))
        listening.start()
        try:
            found = animal.tells("run", two, "--attach")
        finally:
            pages.append(recorder.journal)
            listening.join()

    assert (found["frame"], found["lost"], found["refused"]) == ("work", 0, 0)
    told = lengths([pose["struts"] for pose in found["poses"]])
    np.testing.assert_allclose(told, commands(machine, animal.believed, *poses), atol=WRITTEN)
    true = columns([pose["true"] for pose in found["poses"]], "x_mm", "y_mm", "z_mm") * MM
    expected = machine.tips(*goes_to(machine, animal.truth, told, *poses))
    bound = np.abs(leverage(machine, *poses)).sum(axis=2) * STEP / 2.0 + 1e-9
    assert (np.abs(true - expected) < bound).all()

    found = json.loads(said("replay", bag, "--json"))
    assert found["same"]
    assert found["geometry"]["name"] == machine.name


@contextlib.contextmanager
def spinning(bench: Any) -> Iterator[None]:
    """Handle the bench's messages in another thread."""
    done = threading.Event()

    def spin() -> None:
        while not done.is_set():
            bench.executor.spin_once(timeout_sec=0.02)

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_classify(animal: Animal) -> None:
    """At the pose and with the error that it names, the tool moves as far as it states.

    An effect is that of the structure; the additional rotation of screws is omitted.
    """
    machine = replace(animal.machine, lead=0.0)
    budget = animal.folder / "budget.yaml"
    errors = {"strut_length_um": 10, "base_joint_z_um": 10}
    head = {"format": "hexapod_comp/error_budget", "version": 1, "machine": machine.name, "errors": errors}
    budget.write_text(yaml.safe_dump(head))
    words = ["classify", "--budget", budget, "--cells", 8, "--tilt-deg", 0]
    found = animal.tells(*words)
    box = np.array(found["reach"][0]["box_m"])
    assert (box[0] < machine.middle).all()
    assert (machine.middle < box[1]).all()
    for row in found["ranking"]:
        for name in ("translation_max", "translation_min"):
            strut = int(row[f"{name}_error"].replace("joint ", "joint_").split("_")[1].split()[0]) - 1
            tip = columns([row], *(f"{name}_{axis}_mm" for axis in "xyz")) * MM
            angles = columns([row], *(f"{name}_{angle}_deg" for angle in ("alpha", "beta", "gamma")))[0]
            poses = machine.platform_poses(tip, rotation(*angles)[None])
            truth = Errors.none()
            if "strut" in row[f"{name}_error"]:
                truth.offset[strut] = 10 * UM
            else:
                truth.base[strut, 2] = 10 * UM
            moved = machine.tips(*goes_to(machine, truth, commands(machine, Errors.none(), *poses), *poses)) - tip
            assert row[f"{name}_um"] == pytest.approx(np.linalg.norm(moved) / UM, rel=2e-3)
