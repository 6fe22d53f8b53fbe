"""Error figures of models, for machines so simple that the figures are known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_helpers import BOUNDS, BOX, assert_recorded, framed, paper, recorded
from scipy.spatial.transform import Rotation

from hexapod_comp.calibration.evaluation import (
    HeldOut,
    ModelEvaluation,
    PaperMetric,
    evaluate_model,
    evaluation_json,
    evaluation_text,
    held_out,
    paper_metric,
)
from hexapod_comp.machine.arrays import Size
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import Temperatures
from hexapod_comp.virtual.imperfections import draw_model


@pytest.fixture
def geometry() -> HexapodGeometry:
    return paper()


def moved(geometry: HexapodGeometry, turn: np.ndarray, shift: np.ndarray) -> RealMachine:
    """Return a machine whose only error is a rigid motion of its base."""
    joints = geometry.base_joints.copy()
    deviation = Rotation.from_rotvec(turn).apply(joints) + shift - joints
    return RealMachine(geometry, MachineModel(geometry.name, base_deviation=deviation))


def field_machine(geometry: HexapodGeometry, forward: list[float], backward: list[float]) -> MachineModel:
    """Return a machine whose only error is dx along x, by the same polynomials of u on every line."""
    nodes = tuple(BOX[:, axis] for axis in range(3))
    family = np.zeros((2, 2, 2, 6, len(forward)))
    family[0, :, :, 0], family[1, :, :, 0] = forward, backward
    empty = np.zeros((2, 2, 2, 6, 0))
    return MachineModel(geometry.name, field=GridField(nodes, (family, empty, empty)))


def test_a_turned_machine_has_no_error_once_aligned(geometry):
    """A shift alone moves every point by the same vector, 50 µm long, with any tool and work frame."""
    turn = np.array([1e-4, -2e-4, 3e-4])
    for machine in (geometry, framed(geometry)):
        shifted = held_out(moved(machine, np.zeros(3), np.array([30e-6, 0.0, -40e-6])), None, BOX * 0.5, 100)
        assert shifted.raw.rms == pytest.approx(50e-6, abs=1e-11)
        assert shifted.aligned.largest < 1e-11
        found = held_out(moved(machine, turn, np.array([1e-4, 0.0, 0.0])), None, BOX * 0.5, 100, tilt=0.1)
        assert found.raw.rms > 5e-5
        assert found.aligned.rms < 1e-11
        assert found.rotation.rms < 1e-9


def test_repeatability_alone(geometry):
    """The error is √3 times the repeatability per axis; 6000 draws scatter by 1/√12000 ≈ 1 %, and 4 % is allowed."""
    perfect = RealMachine(geometry, MachineModel(geometry.name))
    found = held_out(perfect, None, BOX, 1000, repeatability=1e-6)
    assert found.raw.rms == pytest.approx(np.sqrt(3.0) * 1e-6, rel=0.04)
    assert found.rotation.rms < 1e-9


def test_temperatures_seen_and_not_seen(geometry):
    """A machine 1 K warm: its own model leaves nothing with the sensors' readings, and over 4 µm without them."""
    model = MachineModel(geometry.name, struts=StrutErrors(expansion=np.full(6, 11e-6)))
    warm = Temperatures(dict.fromkeys(Temperatures.NAMES, 21.0))
    truth = RealMachine(geometry, model, warm)
    assert held_out(truth, model, BOX, 50, sensed=warm).raw.rms < 1e-12
    assert held_out(truth, model, BOX, 50).raw.rms > 4e-6
    assert paper_metric(truth, model, BOX, lines=2, sensed=warm).after < 1e-12


def test_paper_metric_of_a_scale_error(geometry):
    """dx = a·u grows from 0 to 2a along an x-line, with mean a; of 16 + 16 + 8 readings 16 are on x-lines."""
    truth = RealMachine(geometry, field_machine(geometry, [0.0, 10e-6], [0.0, 10e-6]))
    found = paper_metric(truth, truth.model, BOX)
    assert found.before == pytest.approx(10e-6 * 16 / 40, rel=1e-6)
    assert found.after < 1e-12
    assert (found.lines, found.readings) == (60, 20 * 2 * 40)


def test_paper_metric_of_backlash(geometry):
    """dx is ∓b/2 forward and backward: an interferometer zeroed at the start reads 0 forward and b backward."""
    truth = RealMachine(geometry, field_machine(geometry, [-4e-6], [4e-6]))
    found = paper_metric(truth, MachineModel(geometry.name), BOX)
    assert found.before == pytest.approx(8e-6 / 2 * 16 / 40, rel=1e-6)
    assert found.after == pytest.approx(found.before, rel=1e-9)  # an ideal model changes nothing


def test_an_evaluation_as_text():
    um = 1e-6
    before = HeldOut(1000, Size(145 * um, 0.0), Size(27.46 * um, 91.67 * um), Size(225.3 * um, 0.0))
    after = HeldOut(1000, Size(137 * um, 0.0), Size(0.404 * um, 1.32 * um), Size(81.4 * um, 0.0))
    paper = PaperMetric(19.15 * um, 0.24 * um, 60, 2400)
    known = ModelEvaluation(before, after, paper, (0.31 * um, 0.404 * um))
    assert f"{evaluation_text(known)}\n" == recorded("evaluation")
    assert_recorded("evaluation", evaluation_json(known))
    assert replace(known, promised=(0.404 * um, 0.5 * um)).kept
    missed = replace(known, promised=(0.41 * um, 0.5 * um), before=replace(before, rotation=Size(0.0, 0.0)))
    lines = evaluation_text(missed).splitlines()
    assert lines[3] == "  the interval predicted by the fit, 0.41 to 0.50 µm (95 %), DOES NOT CONTAIN this error"
    assert lines[-1] == "  rotation, RMS, after best-fit alignment: 0.00 → 81.40 µrad"
    assert (replace(known, promised=(0.3 * um, 0.4 * um)).kept, replace(known, promised=None).kept) == (False, None)


def test_an_evaluation_without_and_with_a_model(geometry):
    """It holds what the two functions give for 1000 points; only errors at points include the repeatability."""
    truth = RealMachine(geometry, draw_model(geometry, BOUNDS, 1))
    found = evaluate_model(truth, truth.model, BOX, seed=3, repeatability=1e-6)
    assert found.before == held_out(truth, None, BOX, 1000, 3, 1e-6)
    assert found.after.aligned.rms == pytest.approx(np.sqrt(3.0) * 1e-6, rel=0.04)
    assert found.paper == paper_metric(truth, truth.model, BOX, seed=3)
