"""From readings to a model on machines that are not the paper's: boxes and figures in the right frame.

Machines, readings and judgement come from :mod:`foreign_machines`, whose kinematics are not the package's. The
package is used as its users do, from file to file.
"""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from foreign_machines import UM, Errors, Machine, aligned_rms, machines, tool_errors

from hexapod_comp import cli
from hexapod_comp.calibration.posterior import load_posterior
from hexapod_comp.calibration.prediction import ErrorPredictor
from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.pose import Pose

NOISE = 0.5 * UM
STEP = 0.02
ACROSS = ((1, 2), (2, 0), (0, 1))


def laser_file(machine: Machine, truth: Errors, path: Path) -> Path:
    """Write what a linear laser reads on 27 lines along the axes of work and four body diagonals, both ways."""
    rng, rows = np.random.default_rng(5), ["run,direction,x_mm,y_mm,z_mm,channel,value,unit"]
    for number, (start, stop) in enumerate(lines(machine.box)):
        count = round(np.linalg.norm(stop - start) / STEP) + 1
        tips = np.linspace(start, stop, count)
        along = (stop - start) / np.linalg.norm(stop - start)
        errors = tool_errors(machine, truth, Errors.none(), tips) @ along
        for way, order in (("forward", slice(None)), ("backward", slice(None, None, -1))):
            read = errors - errors[0] + NOISE * rng.standard_normal(count)
            for tip, value in zip(tips[order], read[order], strict=True):
                place = ",".join(f"{v * 1e3:.9f}" for v in tip)
                rows.append(f"line {number},{way},{place},linear,{value * 1e6:.4f},um")
    path.write_text("\n".join(rows) + "\n")
    return path


def lines(box: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ends of 3 × 3 lines along each axis of a box and of its body diagonals, forward first."""
    grid, found = np.array([box[0], box.mean(axis=0), box[1]]), []
    for axis in range(3):
        for i in range(3):
            for j in range(3):
                ends = box.copy()
                ends[:, ACROSS[axis][0]], ends[:, ACROSS[axis][1]] = grid[i, ACROSS[axis][0]], grid[j, ACROSS[axis][1]]
                found.append((ends[0], ends[1]))
    for signs in ((0, 0), (0, 1), (1, 0), (1, 1)):
        start = np.array([box[0, 0], *box[list(signs), [1, 2]]])
        found.append((start, box.sum(axis=0) - start))
    return found


@dataclass(frozen=True)
class Fitted:
    """A machine, its truth, and what ``fit`` made of its readings."""

    machine: Machine
    truth: Errors
    folder: Path
    said: str

    @property
    def geometry(self) -> Path:
        return self.folder / "machine.yaml"

    @property
    def model(self) -> Path:
        return self.folder / "model.yaml"


@pytest.fixture(scope="module", params=list(machines()))
def fitted(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Fitted:
    """Measure a machine with 50 µm on joints and struts and 50 ppm on screws, and fit what it has."""
    machine = machines()[request.param]
    folder = tmp_path_factory.mktemp("foreign")
    truth = Errors.drawn(machine, 7)
    machine.write(folder / "machine.yaml")
    truth.write(folder / "truth.yaml", machine)
    measured = laser_file(machine, truth, folder / "measured.csv")
    words = ["fit", measured, "--machine", folder / "machine.yaml", "--blocks", "pitch", "--out", folder / "model.yaml"]
    words += ["--truth", folder / "truth.yaml", "--pictures", folder / "pictures"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert cli.main([str(word) for word in words]) == 0
    return Fitted(machine, truth, folder, out.getvalue())


def figures(said: str, line: str) -> list[float]:
    """Return the numbers before and after the arrow of a line of the report."""
    found = re.search(re.escape(line) + r":? +([\d.]+) → ([\d.]+)", said)
    assert found, said
    return [float(v) for v in found.groups()]


def somewhere(machine: Machine, count: int) -> np.ndarray:
    """Return random places of the measured box, in work."""
    return np.random.default_rng(11).uniform(*machine.box, (count, 3))


def test_the_model_is_good(fitted: Fitted) -> None:
    """By kinematics that are not ours: less than a twentieth of the error is left, the datum aligned."""
    tips = somewhere(fitted.machine, 1000)
    before = aligned_rms(tips, tool_errors(fitted.machine, fitted.truth, Errors.none(), tips))
    after = aligned_rms(tips, tool_errors(fitted.machine, fitted.truth, Errors.read(fitted.model), tips))
    assert after < 0.05 * before


def test_the_predicted_error_is_as_well_known_as_it_says(fitted: Fitted) -> None:
    """The truth's error by kinematics that are not ours, at 200 places, the datum aligned over them in both.

    Places of one machine are not independent: the RMS may be two and a half times what is said, and ten times less.
    """
    geometry = load_geometry(fitted.geometry)
    model = load_model(fitted.model, geometry)
    parameters, why = load_posterior(model, geometry, fitted.model)
    assert why == ""
    tips = somewhere(fitted.machine, 200)
    poses = fitted.machine.platforms(tips), np.tile(fitted.machine.level(), (200, 1, 1))
    aligned = ErrorPredictor(RealMachine(geometry, model), parameters).predict(poses)[1]
    assert aligned is not None
    assert aligned.deviations is not None
    truth = tool_errors(fitted.machine, fitted.truth, Errors.none(), tips)
    sigma = np.sqrt((aligned.deviations[:, :3] ** 2).sum(axis=1).mean())
    assert sigma < 0.05 * aligned_rms(tips, truth)
    assert 0.1 * sigma < aligned_rms(tips, truth - aligned.values[:, :3]) < 2.5 * sigma


def test_the_valid_box_is_of_platform_positions_in_base(fitted: Fitted) -> None:
    """The file's own words. Eight corners of the measured box say how far the platform went; home is in."""
    corners = np.array(np.meshgrid(*fitted.machine.box.T)).reshape(3, 8).T
    platforms = fitted.machine.platforms(corners)
    box = np.array(yaml.safe_load(fitted.model.read_text())["valid_box_mm"]) * 1e-3
    np.testing.assert_allclose(box, [platforms.min(axis=0), platforms.max(axis=0)], atol=1e-9)
    assert ((box[0] < fitted.machine.home) & (fitted.machine.home < box[1])).all()


def test_the_compensator_knows_inside_from_outside(fitted: Fitted) -> None:
    """At home with a level tool it is inside, and out as soon as the platform leaves what was measured."""
    geometry = load_geometry(fitted.geometry)
    model = load_model(fitted.model, geometry)

    def outside(tip: np.ndarray) -> bool:
        return Compensator(geometry, model).correct(Pose(tip, np.eye(3))).outside_box

    up, middle = fitted.machine.work.matrix.T[:, 2], fitted.machine.middle
    assert not outside(middle)
    corners = np.array(np.meshgrid(*fitted.machine.box.T)).reshape(3, 8).T
    half = 0.5 * np.ptp(fitted.machine.platforms(corners)[:, 2])
    assert not outside(middle + (half - 1e-6) * up)
    assert outside(middle + (half + 1e-6) * up)


def test_check_finds_home_inside(fitted: Fitted, capsys: pytest.CaptureFixture[str]) -> None:
    poses = fitted.folder / "poses.csv"
    poses.write_text("x_mm,y_mm,z_mm\n" + ",".join(f"{v * 1e3:.9f}" for v in fitted.machine.middle) + "\n")
    words = ["check", str(poses), "--machine", str(fitted.geometry), "--model", str(fitted.model)]
    assert cli.main(words) == 0
    assert "outside the box" not in capsys.readouterr().out


def test_export_keeps_to_poses_that_were_measured(fitted: Fitted, capsys: pytest.CaptureFixture[str]) -> None:
    """LinuxCNC's files are written for a box of tool positions inside the measured one, and they help there."""
    words = ["export", "--machine", fitted.geometry, "--model", fitted.model, "--linuxcnc", fitted.folder / "cnc"]
    assert cli.main([str(word) for word in (*words, "--poses", 1000)]) == 0
    said = capsys.readouterr().out
    before, after = figures(said, "LinuxCNC, level tool")
    assert after < 0.5 * before
    found = re.search(r"box of tool positions \((.*?)\)…\((.*?)\) mm", said)
    assert found
    box = np.array([[float(v) for v in corner.split(",")] for corner in found.groups()]) * 1e-3
    corners = fitted.machine.platforms(np.array(np.meshgrid(*box.T)).reshape(3, 8).T)
    valid = np.array(yaml.safe_load(fitted.model.read_text())["valid_box_mm"]) * 1e-3
    assert (corners > valid[0] - 1e-6).all()
    assert (corners < valid[1] + 1e-6).all()
    assert (np.ptp(box, axis=0) > 0.5 * np.array(fitted.machine.half)).all(), "a box that is of use"


def test_what_it_is_worth_is_judged_where_the_machine_was_measured(fitted: Fitted) -> None:
    """Against this file's own evaluation at other random places of the measured box. The mean square of 1,000 places
    whose squares scatter by their own size is good to 3/√1000 = 10 %, its root to 5 %; both draws together 7 %."""
    tips = somewhere(fitted.machine, 1000)
    wild = tool_errors(fitted.machine, fitted.truth, Errors.none(), tips)
    tame = tool_errors(fitted.machine, fitted.truth, Errors.read(fitted.model), tips)
    aligned = [aligned_rms(tips, errors) / UM for errors in (wild, tame)]
    raw = [np.sqrt((errors**2).sum(axis=1).mean()) / UM for errors in (wild, tame)]
    np.testing.assert_allclose(figures(fitted.said, "space, RMS, datum aligned"), aligned, rtol=0.07, atol=0.006)
    np.testing.assert_allclose(figures(fitted.said, "space, RMS, as it is"), raw, rtol=0.07)


def test_the_papers_metric_is_taken_along_the_work_frame(fitted: Fitted) -> None:
    """Mean |error| along lines of this file's own, read against their start; both means are of 60 and 600 lines whose
    figures scatter by about their size: 3/√60 = 40 %."""
    rng, box, machine = np.random.default_rng(12), fitted.machine.box, fitted.machine
    own = {}
    for name, believed in (("before", Errors.none()), ("after", Errors.read(fitted.model))):
        read = []
        for axis in range(3):
            for _ in range(200):
                tips = np.tile(rng.uniform(*box), (9, 1))
                tips[:, axis] = np.linspace(box[0, axis], box[1, axis], 9)
                errors = tool_errors(machine, fitted.truth, believed, tips)[:, axis]
                read += [abs(errors[1:] - errors[0]).mean()] * round(np.ptp(box[:, axis]) / 0.0254)
        own[name] = np.mean(read) / UM
    np.testing.assert_allclose(figures(fitted.said, "lines"), [own["before"], own["after"]], rtol=0.4, atol=0.02)


def test_what_is_expected_is_expected_of_a_level_tool_in_the_measured_box(fitted: Fitted) -> None:
    """What the report says of the machine before is the fitted machine's own error; it differs from the truth's by
    what the fit leaves, a twentieth at most, and by the draw, 5 % each."""
    tips = somewhere(fitted.machine, 1000)
    wild = aligned_rms(tips, tool_errors(fitted.machine, fitted.truth, Errors.none(), tips)) / UM
    assert figures(fitted.said, "level tool")[0] == pytest.approx(wild, rel=0.1)


def test_pictures_are_drawn(fitted: Fitted) -> None:
    names = {path.name for path in (fitted.folder / "pictures").iterdir()}
    assert names == {"fit.png", "left.png", "strut_errors.png"}
