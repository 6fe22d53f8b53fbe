"""What campaigns see: the issue's counts, the machine errors no line can show, indices by their definitions."""

from dataclasses import replace
from functools import cache

import calibration_helpers as small
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import gmean

from hexapod_comp.calibration.estimator import DesignMatrix, Estimation, LinearProblem, Posterior, solve
from hexapod_comp.calibration.parameters import TOLERANCES, FitSettings, ParameterSpace
from hexapod_comp.calibration.posterior import (
    MACHINE_ERRORS,
    Observability,
    box_errors,
    box_stations,
    expected_error,
    observe,
    without_trace,
)
from hexapod_comp.calibration.sensitivity import predict
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.measurements.campaign import load_campaign, template
from hexapod_comp.measurements.readings import KINDS, MeasurementSet
from hexapod_comp.pose import Pose

SQUARENESS = ("squareness xy", "squareness xz", "squareness yz")
TWISTS = ("twist dx ~ y z", "twist dy ~ x z", "twist dz ~ x y")
ROLLS = ("roll of x", "roll of y", "roll of z")
ONES = np.ones(len(KINDS))
STRUCTURE = FitSettings(blocks=())
FIELD = FitSettings(blocks=("field displacement", "field rotation"), field_degree=3)


@cache
def linearised(
    instrument: str, diagonals: int, settings: FitSettings, poses: int = 0, tilt: float = 0.0
) -> tuple[ParameterSpace, LinearProblem]:
    """Return space and linear problem of a campaign on the nominal machine: what it sees needs no readings."""
    plan = small.campaign(instrument, diagonals, poses=poses, tilt=tilt)
    return problem_of(template(plan, small.paper()), settings)


def read(instrument: str, diagonals: int, settings: FitSettings) -> Estimation:
    """Return a campaign's readings against parameters."""
    plan = template(small.campaign(instrument, diagonals), small.paper())
    return Estimation(plan, ParameterSpace(plan, settings))


def problem_of(measurements: MeasurementSet, settings: FitSettings) -> tuple[ParameterSpace, LinearProblem]:
    space = ParameterSpace(measurements, settings)
    estimation = Estimation(measurements, space)
    return space, estimation.linearise(np.zeros(space.size), np.ones(len(measurements)))[0]


def sight(space: ParameterSpace, problem: LinearProblem) -> Observability:
    return observe(space, problem, solve(space, problem, space.start_tolerances(), ONES, 0))


def rank(space: ParameterSpace, problem: LinearProblem) -> int:
    """Return how many structure parameters readings of 1 µm tell from ±100 µm, by NumPy's singular values."""
    singular = np.linalg.svd(problem.rows.dense()[:, space.blocks[0].part] * 100e-6, compute_uv=False)
    return int((singular > 1.0).sum())


def test_level_lines_see_14_of_33_structure_parameters():
    """The issue's count, on the shipped campaign without its diagonals: 33 parameters, 14 of them seen."""
    plan = replace(load_campaign(config_file("campaign_5d.yaml")), diagonals=0)
    space, problem = problem_of(template(plan, small.paper()), STRUCTURE)
    seen = sight(space, problem)
    assert (seen.structure_rank, seen.structure_size) == (14, 33)
    assert rank(space, problem) == 14


@pytest.mark.parametrize(
    ("instrument", "diagonals", "unseen"),
    [
        ("5-D", 0, {*SQUARENESS, *TWISTS, *ROLLS}),
        ("5-D", 4, {*ROLLS}),
        ("6-D", 0, {*SQUARENESS, *TWISTS}),
    ],
)
def test_machine_errors_that_leave_no_trace(instrument: str, diagonals: int, unseen: set[str]):
    """By hand: a shear or a bilinear twist is constant along its own line and linear across, which zeros and beam
    slopes swallow; on a body diagonal it is not. Roll needs a roll channel."""
    errors = without_trace(read(instrument, diagonals, FIELD))
    assert {error.name for error in errors} == unseen


def test_what_is_below_the_noise_was_read() -> None:
    """Attitudes at random places, of 1 mrad; a roll of the field's tolerance turns about x by up to that at the faces.

    So all of them together change by tolerance/noise · √(Σu²) standard deviations.
    """
    turns = Rotation.from_rotvec(np.radians(8.0) * np.random.default_rng(4).uniform(-1.0, 1.0, (54, 3))).as_matrix()
    places = np.random.default_rng(3).uniform(*small.BOX, (54, 3))
    readings = small.scattered(small.paper(), [Pose(p, turn) for p, turn in zip(places, turns, strict=True)])
    assert np.degrees(readings.tilt()) == pytest.approx(np.degrees(Rotation.from_matrix(turns).magnitude()).max())
    readings = replace(readings, uncertainty=np.full(len(readings), 1e-3))
    known = replace(FIELD, tracker_frame="known")
    estimation = Estimation(readings, ParameterSpace(readings, known))
    found = {error.name: error for error in without_trace(estimation)}
    field, low, high = estimation.space.field, *estimation.space.box[:, 0]
    u = 2.0 * (places[:, 0] - low) / (high - low) - 1.0
    largest = TOLERANCES["field rotation"] * field.prior[field.terms.index("x1")]
    wanted = largest / 1e-3 * np.sqrt((u**2).sum())
    assert found["roll of x"].trace == pytest.approx(wanted, rel=1e-6)
    assert found["roll of x"].reason.startswith(f"below the noise: it changes all readings together by {wanted:.2g} σ")


def readings_of(instrument: str, diagonals: int, model: MachineModel) -> Estimation:
    """Return what lasers without noise read on a machine, against the nominal one."""
    quiet = small.campaign(instrument, diagonals, noise=(0.0,) * len(KINDS), beam_slope=0.0)
    return Estimation(small.measured(RealMachine(small.paper(), model), quiet, 0), linearised("5-D", 0, FIELD)[0])


@pytest.mark.parametrize("name", [SQUARENESS[0], TWISTS[1], ROLLS[2]])
def test_an_unseen_error_really_changes_no_reading(name: str):
    """10 µm or 10 µrad of it are put on a machine: 5-D lines differ by zeros and slopes, diagonals and roll do not.

    Readings over 1 µm. What is left of the unseen ones: the grid's interpolation of a term linear in each
    coordinate, which is exact, and the cosine of 10 µrad.
    """
    space, _ = linearised("5-D", 0, FIELD)
    labels = [label for block in space.blocks for label in block.labels]
    x = np.zeros(space.size)
    x[[labels.index(f"{component} {term}") for component, term in MACHINE_ERRORS[name]]] = 1e-5
    for instrument, diagonals, is_seen in (("5-D", 0, False), ("6-D" if name in ROLLS else "5-D", 4, True)):
        estimation = readings_of(instrument, diagonals, space.model(x))
        left, _ = estimation.linearise(np.zeros(space.size), np.ones(len(estimation.measurements)))
        assert (np.abs(left.target).max() > 1.0) == is_seen
        assert is_seen or np.abs(left.target).max() < 1e-3


def by_hand(singular: np.ndarray) -> tuple[ParameterSpace, LinearProblem, Posterior]:
    """Return a problem whose whitened structure derivatives have given singular values in random directions."""
    space, rng = linearised("5-D", 0, STRUCTURE)[0], np.random.default_rng(1)
    left = np.linalg.qr(rng.standard_normal((100, space.size)))[0]
    right = np.linalg.qr(rng.standard_normal((space.size, space.size)))[0]
    rows = (left * singular) @ right.T / space.spread(space.start_tolerances())
    target = rng.standard_normal(100)
    normal, moment = np.zeros((len(KINDS), space.size, space.size)), np.zeros((len(KINDS), space.size))
    normal[0], moment[0] = rows.T @ rows, rows.T @ target
    square, freedom = np.array([target @ target, 0, 0, 0, 0]), np.array([100.0, 0, 0, 0, 0])
    kind = np.zeros(100, dtype=int)
    problem = LinearProblem(
        target, DesignMatrix.of(rows), kind, np.arange(100), normal, moment, square, freedom, np.zeros(len(KINDS))
    )
    return space, problem, solve(space, problem, space.start_tolerances(), ONES, 0)


def test_indices_are_the_published_ones():
    """Borm and Menq 1989: (σ₁…σₘ)^(1/m)/√n; Driels and Pathre 1990: σₘ/σ₁; Nahvi et al. 1994: σₘ; Nahvi and
    Hollerbach 1996: σₘ²/σ₁. Over the twenty singular values above 1, of 100 readings."""
    singular = np.concatenate([np.geomspace(400.0, 2.0, 20), np.geomspace(0.5, 1e-3, 13)])
    seen = observe(*by_hand(singular))
    kept = singular[:20]
    assert (seen.rank, seen.size, seen.structure_rank) == (20, 33, 20)
    assert seen.condition == pytest.approx(200.0, rel=1e-6)
    wanted = {"O1": gmean(kept) / 10.0, "O2": 2.0 / 400.0, "O3": 2.0, "O4": 4.0 / 400.0}
    assert seen.indices == pytest.approx(wanted, rel=1e-6)
    assert [strength for strength, _ in seen.weak] == pytest.approx(kept[kept < 5.0][::-1][:5], rel=1e-6)
    # Data give s²/(1 + s²) of each direction; the rest is the prior's
    assert seen.blocks[0].determined == pytest.approx((singular**2 / (1.0 + singular**2)).sum(), rel=1e-9)


def test_expected_error_of_one_known_parameter():
    """One uncertain strut offset: the error is its sensitivity times its standard deviation, the datum aligned.

    Moved by finite difference and aligned by least squares over shift and rotation here. The mean square over 300
    draws of a squared normal number is within 3 · √(2/300) = 25 % of its expectation, its root within 13 %.
    """
    space, _ = linearised("5-D", 4, STRUCTURE)
    offset, sigma = list(space.blocks[0].labels).index("strut_3 offset"), 2e-6
    covariance = np.zeros((space.size, space.size))
    covariance[offset, offset] = sigma**2
    found = expected_error(box_errors(space, np.zeros(space.size)), covariance)
    stations, x = box_stations(space), np.zeros(space.size)
    x[offset] = sigma
    moved = predict(space, x, stations).errors
    points = stations.positions - stations.positions.mean(axis=0)
    datum = np.vstack([np.hstack([np.eye(3), -cross(p)]) for p in points])
    flat = moved[:, :3].ravel()
    left = flat - datum @ np.linalg.lstsq(datum, flat, rcond=None)[0]
    assert found.after == pytest.approx(np.sqrt((left**2).sum() / len(points)), rel=0.13)
    turned = moved[:, 3:] - moved[:, 3:].mean(axis=0)
    assert found.rotation_after == pytest.approx(np.sqrt((turned**2).sum(axis=1).mean()), rel=0.13)
    assert found.before == pytest.approx(0.0, abs=1e-12)
    assert found.low < found.after < found.high


def cross(v: np.ndarray) -> np.ndarray:
    """Return the matrix of v × ."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
