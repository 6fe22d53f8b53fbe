"""Parameter space and smooth field: polynomials as NumPy has them, priors as their formulas say, models as meant."""

from dataclasses import fields, replace

import calibration_helpers as small
import numpy as np
import pytest
from helpers import general_machine, poses_about
from numpy.polynomial import legendre
from scipy.interpolate import CubicSpline
from scipy.spatial.distance import cdist

from hexapod_comp.calibration.assumptions import ASSUMED
from hexapod_comp.calibration.blocks.field import GRID_TOLERANCE, SmoothField
from hexapod_comp.calibration.parameters import BLOCKS, FitSettings, ParameterSpace
from hexapod_comp.cli.app import main
from hexapod_comp.errors import ModelError
from hexapod_comp.measurements.campaign import template
from hexapod_comp.measurements.readings import MeasurementSet
from hexapod_comp.pose import Pose

BOX = np.array([[-0.2, -0.1, 0.3], [0.2, 0.3, 0.5]])


@pytest.fixture(scope="module")
def readings() -> MeasurementSet:
    return template(small.campaign(), small.paper())


@pytest.fixture(scope="module")
def space(readings: MeasurementSet) -> ParameterSpace:
    return ParameterSpace(readings, small.SETTINGS)


def unit_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return coordinates that run from −1 to 1 over a box."""
    return np.stack([np.interp(points[:, a], box[:, a], (-1.0, 1.0)) for a in range(3)])


def series(powers: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return coefficients as NumPy's three-dimensional Legendre series takes them, shape (5, 5, 5)."""
    result = np.zeros((5, 5, 5))
    result[tuple(powers.T)] = values
    return result


def random_field(field: SmoothField, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a field of 5 µm and 20 µrad as its prior expects it, forward and backward 1 µm and 1 µrad apart."""
    size = np.repeat([5e-6, 20e-6], 3)[:, None] * field.prior
    reversal = 1e-6 * field.reversal_prior * rng.standard_normal((3, 6, len(field.reversal_powers)))
    return size * rng.standard_normal((6, len(field.powers))), reversal


def test_smooth_field_is_the_legendre_series():
    """NumPy's legval3d sums the same series; both round some fifty products of values below 1e-5."""
    rng = np.random.default_rng(1)
    field = SmoothField(BOX, 4)
    mean, reversal = random_field(field, rng)
    points = rng.uniform(*BOX, (40, 3))
    sense = rng.choice([-1.0, 0.0, 1.0], (40, 3))
    found = field.evaluate(mean, reversal, points, sense)
    for component in range(6):
        wanted = legendre.legval3d(*unit_box(points, BOX), series(field.powers, mean[component]))
        for axis in range(3):
            turning = series(field.reversal_powers, reversal[axis, component])
            wanted += 0.5 * sense[:, axis] * legendre.legval3d(*unit_box(points, BOX), turning)
        np.testing.assert_allclose(found[:, component], wanted, atol=1e-18)


def test_degrees_count_for_more_along_short_sides():
    """A cube takes all terms up to the total degree: C(n + 3, 3). Half a side counts √2 times per degree."""
    cube = SmoothField(np.array([[0.0, 0.0, 0.0], [0.3, 0.3, 0.3]]), 5)
    assert len(cube.powers) == 56
    assert cube.powers.sum(axis=1).max() == 5
    slab = SmoothField(np.array([[0.0, 0.0, 0.0], [0.4, 0.4, 0.2]]), 4)
    assert slab.powers.max(axis=0).tolist() == [4, 4, 2]
    totals = slab.powers @ [1.0, 1.0, np.sqrt(2.0)]
    assert totals.max() <= 4.0
    np.testing.assert_allclose(slab.prior, ASSUMED.field_decay**totals, rtol=1e-14)
    assert len({tuple(p) for p in slab.powers}) == len(slab.powers) == len(set(slab.terms))


def test_outside_its_box_the_field_holds():
    field = SmoothField(BOX, 3)
    coefficients = random_field(field, np.random.default_rng(2))
    beyond = np.array([[0.5, 0.1, 0.4], [0.0, -1.0, 0.9]])
    held = np.clip(beyond, BOX[0], BOX[1])
    assert (field.evaluate(*coefficients, beyond, np.ones((2, 3)))
            == field.evaluate(*coefficients, held, np.ones((2, 3)))).all()  # fmt: skip


def grid_difference(field: SmoothField, coefficients: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the largest difference between a field and its grid at random points and directions, shape (6,)."""
    rng = np.random.default_rng(3)
    points = rng.uniform(*field.box, (400, 3))
    sense = rng.choice([-1.0, 0.0, 1.0], (400, 3))
    grid = field.as_grid(*coefficients)
    found = np.array([grid.evaluate(p, s)[0] for p, s in zip(points, sense, strict=True)])
    return np.abs(found - field.evaluate(*coefficients, points, sense)).max(axis=0)


@pytest.mark.parametrize(("degree", "allowed"), [(1, GRID_TOLERANCE), (3, GRID_TOLERANCE), (6, 100e-9)])
def test_grid_field_is_the_same_field(degree: int, allowed: float):
    """Stated: 30 nm and 30 nrad at points of its own; twice that elsewhere.

    A field of degree 6 would need more lines than a model file should carry. A tenth of what lasers resolve is
    allowed there: 0.1 µm, and twice as many µrad.
    """
    field = SmoothField(BOX, degree)
    coefficients = random_field(field, np.random.default_rng(4))
    assert (grid_difference(field, coefficients) <= np.repeat([allowed, 2.0 * allowed], 3)).all()
    np.testing.assert_allclose(field.as_grid(*coefficients).box, BOX, atol=1e-15)


@pytest.mark.parametrize("flat", [[2], [0, 1], [0, 1, 2]])
def test_flat_boxes_carry_no_power_across(flat: list[int]):
    """A plane, a line and a point: only what varies there can be known, and the grid is still a grid."""
    box = BOX.copy()
    box[1, flat] = box[0, flat]
    field = SmoothField(box, 3)
    assert not field.powers[:, flat].any()
    assert len(field.powers) == {1: 10, 2: 4, 3: 1}[len(flat)]
    coefficients = random_field(field, np.random.default_rng(5))
    points = np.random.default_rng(6).uniform(box[0], box[1], (20, 3))
    grid = field.as_grid(*coefficients)
    found = np.array([grid.evaluate(p, np.ones(3))[0] for p in points])
    wanted = field.evaluate(*coefficients, points, np.ones((20, 3)))
    np.testing.assert_allclose(found, wanted, atol=2.0 * GRID_TOLERANCE)


def test_vector_names_and_sizes(space: ParameterSpace):
    """Twelve joints (three shared ones on the platform) and six offsets are 33; every parameter has a name."""
    sizes = {block.name: len(block.labels) for block in space.blocks}
    knots, worn = (len(space.block(name).knots) for name in ("map", "backlash map"))
    terms, turning = len(space.field.terms), len(space.field.reversal_terms)
    expected = (33, 6, 12, 12, 12, 12, 6, 6 * knots, 6 * worn, 3 * terms, 3 * terms, 18 * turning)
    cold = [
        name
        for name in BLOCKS
        if name not in ("expansion", "moisture", "late", "compliance", "lost motion", "friction")
    ]  # nothing grew
    assert sizes == dict(zip(cold, expected, strict=True))
    labels = [label for block in space.blocks for label in block.labels]
    assert len(set(labels)) == space.size == sum(sizes.values())
    assert [block.part.start for block in space.blocks] == np.cumsum([0, *expected[:-1]]).tolist()


def test_a_machine_without_coinciding_joints_has_42_either_way():
    geometry = general_machine()
    positions, rotations = poses_about(geometry.home, 3, seed=1)
    poses = [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]
    shared = ParameterSpace(small.scattered(geometry, poses), FitSettings(lead=0.01))
    assert len(shared.blocks[0].labels) == 42


def test_without_a_lead_there_are_no_waves(readings: MeasurementSet):
    geometry = replace(readings.geometry, screw_lead=np.zeros(6))
    assert ParameterSpace(replace(readings, geometry=geometry), FitSettings()).block("wave") is None
    across = np.tile([1.0, 0.0, 0.0], (6, 1))
    led = replace(geometry, screw_lead=np.full(6, -0.005), base_axes=across, platform_axes=across)
    np.testing.assert_array_equal(ParameterSpace(replace(readings, geometry=led), FitSettings()).periods, 0.005)


def test_knots_cover_the_commands_close_enough(space: ParameterSpace, readings: MeasurementSet):
    commands = readings.stations.commands
    knots, worn = space.block("map").knots, space.block("backlash map").knots
    assert knots[0] <= commands.min() < commands.max() <= knots[-1]
    assert np.diff(knots).max() <= ASSUMED.knot_distance * (1.0 + 1e-12)
    assert set(worn) <= set(knots)
    assert worn[[0, -1]].tolist() == knots[[0, -1]].tolist()


def test_prior_of_the_map_is_matern(space: ParameterSpace):
    """Matérn 5/2 as in Rasmussen and Williams, eq. 4.17; 1e-9 of independent variance keep it regular."""
    root, knots = space.block("map").root, space.block("map").knots
    distance = np.sqrt(5.0) * cdist(knots[:, None], knots[:, None]) / ASSUMED.map_correlation
    wanted = (1.0 + distance + distance**2 / 3.0) * np.exp(-distance)
    n = len(knots)
    np.testing.assert_allclose((root @ root.T)[:n, :n], wanted, atol=2e-9)
    assert not (root @ root.T)[:n, n:].any()


def test_priors_drawn_have_their_size(space: ParameterSpace):
    """x = root·y with y ~ N(0, tolerance²): 4,000 draws know a standard deviation to 1.1 %; five of that."""
    rng = np.random.default_rng(6)
    spread = space.spread(space.start_tolerances())
    drawn = space.physical(spread[:, None] * rng.standard_normal((space.size, 4000))).std(axis=1)
    for block, tolerance in zip(space.blocks, space.start_tolerances(), strict=True):
        priors = {"field displacement": space.field.prior, "field rotation": space.field.prior,
                  "field reversal": space.field.reversal_prior}  # fmt: skip
        relative = np.resize(priors.get(block.name, [1.0]), len(block.labels))
        np.testing.assert_allclose(drawn[block.part], tolerance * relative, rtol=0.055, atol=0)


def test_spline_weights_are_the_natural_spline(space: ParameterSpace):
    knots = space.block("map").knots
    values = np.random.default_rng(8).standard_normal(len(knots))
    commands = np.linspace(knots[0] - 0.01, knots[-1] + 0.01, 50)
    spline = CubicSpline(knots, values, bc_type="natural")
    held = np.clip(commands, knots[0], knots[-1])
    np.testing.assert_allclose(space.block("map").weights(commands) @ values, spline(held), atol=1e-13)


def test_model_says_what_the_vector_says(readings: MeasurementSet):
    """A drawn machine goes into the vector by its own attributes and comes back."""
    few = ParameterSpace(readings, replace(small.SETTINGS, blocks=("pitch", "wave", "backlash")))
    truth = small.virtual_machine(3).model
    model = few.model(small.true_parameters(few, truth))
    np.testing.assert_array_equal(model.base_deviation, truth.base_deviation)
    np.testing.assert_array_equal(model.platform_deviation, truth.platform_deviation)
    for name in ("offset", "pitch", "reference_length", "cosine", "sine", "period", "backlash"):
        np.testing.assert_allclose(getattr(model.struts, name), getattr(truth.struts, name), atol=1e-15)
    assert model.machine == truth.machine
    assert model.region is not None
    np.testing.assert_allclose(model.region.box, small.BOX, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"blocks": ("pitch", "wobble")}, "wobble"),
        ({"lead": 10.0}, "lead"),
        ({"lead": 0.0}, "lead"),
        ({"lead": np.nan}, "lead"),
        ({"field_degree": 0}, "field_degree"),
        ({"field_degree": 9}, "field_degree"),
    ],
)
def test_settings_that_cannot_be(options: dict, what: str):
    with pytest.raises(ModelError, match=what):
        FitSettings(**options)


def test_every_assumption_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Numbers, lists, and lists of names with their numbers; ``fit --assumptions`` once ended at the last."""
    assert main(["fit", "--assumptions"]) == 0
    printed = capsys.readouterr().out
    assert all(f.name in printed for f in fields(ASSUMED))
    assert "3e-06, 1e-05, 3e-05, 0.0001, 0.0003 m" in printed
    assert "linear 5e-07, length 5e-07, position 1e-05 m/m" in printed
