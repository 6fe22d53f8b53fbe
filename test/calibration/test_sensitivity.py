"""Parameters, blocks and predictions, against NumPy's polynomials, the priors' formulas, and finite differences."""

import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields, replace

import calibration_helpers as small
import numpy as np
import pytest
from helpers import central_difference, general_machine, poses_about
from numpy.polynomial import legendre
from scipy.spatial.distance import cdist

from hexapod_comp.calibration.assumptions import ASSUMED
from hexapod_comp.calibration.blocks.field import GRID_TOLERANCE, SmoothField
from hexapod_comp.calibration.parameters import BLOCKS, Extent, FitSettings, ParameterSpace
from hexapod_comp.calibration.sensitivity import derivatives, predict
from hexapod_comp.cli.app import main
from hexapod_comp.errors import CalibrationError, ModelError
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.model import RealMachine
from hexapod_comp.measurements.readings import MeasurementSet, Stations
from hexapod_comp.pose import Pose, attitude_error

BOX = np.array([[-0.2, -0.1, 0.3], [0.2, 0.3, 0.5]])


@pytest.fixture(scope="module")
def readings() -> MeasurementSet:
    return small.blank(small.campaign())


@pytest.fixture(scope="module")
def space(readings: MeasurementSet) -> ParameterSpace:
    return ParameterSpace(readings, small.SETTINGS)


def unit_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return coordinates that run from −1 to 1 over a box."""
    return np.stack([np.interp(points[:, a], box[:, a], (-1.0, 1.0)) for a in range(3)])


def series(powers: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return coefficients in the form of NumPy's three-dimensional Legendre series, shape (5, 5, 5)."""
    result = np.zeros((5, 5, 5))
    result[tuple(powers.T)] = values
    return result


def random_field(field: SmoothField, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients of a field of 5 µm and 20 µrad, drawn from its prior; its reversal has 1 µm and 1 µrad."""
    size = np.repeat([5e-6, 20e-6], 3)[:, None] * field.prior
    reversal = 1e-6 * field.reversal_prior * rng.standard_normal((3, 6, len(field.reversal_powers)))
    return size * rng.standard_normal((6, len(field.powers))), reversal


def test_smooth_field_is_the_legendre_series():
    """NumPy's legval3d gives the same sum; both round about fifty products of values below 1e-5."""
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
    """A cube has all terms up to the total degree, C(n + 3, 3); a side of half the length costs √2 per degree."""
    cube = SmoothField(np.array([[0.0, 0.0, 0.0], [0.3, 0.3, 0.3]]), 5)
    assert len(cube.powers) == 56
    assert cube.powers.sum(axis=1).max() == 5
    slab = SmoothField(np.array([[0.0, 0.0, 0.0], [0.4, 0.4, 0.2]]), 4)
    assert slab.powers.max(axis=0).tolist() == [4, 4, 2]
    totals = slab.powers @ [1.0, 1.0, np.sqrt(2.0)]
    assert totals.max() <= 4.0
    np.testing.assert_allclose(slab.prior, ASSUMED.field_decay**totals, rtol=1e-14)
    assert len({tuple(p) for p in slab.powers}) == len(slab.powers) == len(set(slab.terms))


@pytest.mark.parametrize(
    ("degree", "flat", "allowed"),
    [(3, [], GRID_TOLERANCE), (6, [], 100e-9), (3, [2], GRID_TOLERANCE), (3, [0, 1, 2], GRID_TOLERANCE)],
)
def test_grid_field_is_the_same_field(degree: int, flat: list[int], allowed: float):
    """The grid is exact to 30 nm and 30 nrad at its own check points, twice elsewhere; a field of degree 6, limited
    by the number of lines in a model file, to a tenth of a laser's resolution. A flat box has no terms across it."""
    box = BOX.copy()
    box[1, flat] = box[0, flat]
    field = SmoothField(box, degree)
    assert not field.powers[:, flat].any()
    coefficients, rng = random_field(field, np.random.default_rng(4)), np.random.default_rng(3)
    # Some points are outside the box, where both hold the value at the boundary.
    points = box.mean(axis=0) + 1.1 * (rng.uniform(*box, (400, 3)) - box.mean(axis=0))
    sense = rng.choice([-1.0, 0.0, 1.0], (400, 3))
    grid = field.as_grid(*coefficients)
    found = np.array([grid.evaluate(p, s)[0] for p, s in zip(points, sense, strict=True)])
    off = np.abs(found - field.evaluate(*coefficients, points, sense)).max(axis=0)
    assert (off <= np.repeat([allowed, 2.0 * allowed], 3)).all()


def test_vector_names_and_sizes(space: ParameterSpace, readings: MeasurementSet):
    """Of platform joints that coincide in pairs 33 parameters, of separate ones 42; knots cover all commands."""
    geometry = general_machine()
    poses = [Pose(p, r) for p, r in zip(*poses_about(geometry.home, 3, seed=1), strict=True)]
    assert len(ParameterSpace(small.scattered(geometry, poses), FitSettings(lead=0.01)).blocks[0].labels) == 42
    commands, at = readings.stations.commands, space.block("map").knots
    assert at[0] <= commands.min() < commands.max() <= at[-1]
    assert np.diff(at).max() <= ASSUMED.knot_distance * (1.0 + 1e-12)
    assert set(space.block("backlash map").knots) <= set(at)
    assert [len(block.labels) for block in space.blocks[:7]] == [33, 6, 12, 12, 12, 12, 6]
    assert not {block.name for block in space.blocks} & {"expansion", "moisture", "late", "compliance"}, "nothing grew"
    assert len(set(space.labels)) == space.size == sum(len(block.labels) for block in space.blocks)


def test_strut_readings_beyond_the_stroke_are_refused(readings: MeasurementSet):
    stroke, refused = (
        readings.geometry.limits.stroke,
        pytest.raises(CalibrationError, match=r"^strut readings: are .* m; "),
    )
    for end, sign in ((stroke.min(), -1.0), (stroke.max(), 1.0)):
        for beyond, result in ((0.0499, nullcontext()), (0.0501, refused)):
            commands = readings.stations.commands.copy()
            commands[3, 2] = end + sign * beyond
            with result:
                Extent.of(replace(readings, stations=replace(readings.stations, commands=commands)))


def test_without_a_lead_there_are_no_waves(readings: MeasurementSet):
    geometry = replace(readings.geometry, screw_lead=np.zeros(6))
    assert ParameterSpace(replace(readings, geometry=geometry), FitSettings()).block("wave") is None
    across = np.tile([1.0, 0.0, 0.0], (6, 1))
    led = replace(geometry, screw_lead=np.full(6, -0.005), base_axes=across, platform_axes=across)
    np.testing.assert_array_equal(ParameterSpace(replace(readings, geometry=led), FitSettings()).periods, 0.005)


def test_prior_of_the_map_is_matern(space: ParameterSpace):
    """The prior is Matérn 5/2 (Rasmussen and Williams, eq. 4.17), with 1e-9 of independent variance for regularity."""
    root, knots = space.block("map").root, space.block("map").knots
    distance = np.sqrt(5.0) * cdist(knots[:, None], knots[:, None]) / ASSUMED.map_correlation
    wanted = (1.0 + distance + distance**2 / 3.0) * np.exp(-distance)
    n = len(knots)
    np.testing.assert_allclose((root @ root.T)[:n, :n], wanted, atol=2e-9)
    assert not (root @ root.T)[:n, n:].any()


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"blocks": ("pitch", "wobble")}, "blocks: must be of structure, .* (found ['wobble'])"),
        ({"lead": 1.25}, "lead: must be 0.1 mm to 1000 mm (found 1250.0)"),
        ({"lead": np.nan}, "lead"),
        ({"field_degree": 9}, "field_degree: must be 1…8 (found 9)"),
        ({"field_degree": 0}, "field_degree: must be 1…8 (found 0)"),
        ({"tolerances": (("wave", 0.0),)}, "tolerance of wave: must be finite and above zero (found 0.0)"),
        ({"tolerances": (("wave", np.inf),)}, "tolerance of wave: must be finite and above zero (found inf)"),
        ({"base_expansion": 101e-6}, "base expansion: must be within ±100 ppm/K (found 101.0)"),
        ({"strut_moisture": 0.02}, "strut moisture: must be within ±100 ppm per % of relative humidity (found 200.0)"),
        ({"scale": 0.011}, "scale: must be 0…0.01 m/m (found 0.011)"),
        ({"alignment": 0.11}, "alignment: must be 0…0.1 rad (found 0.11)"),
        ({"tracker_frame": "near"}, "tracker_frame: must be free or known (found 'near')"),
        ({"time_constants": (90.0, 30.0)}, "thermal"),
        ({"thermometer": "spindle"}, "thermal"),
    ],
)
def test_settings_that_cannot_be(options: dict, what: str):
    with pytest.raises(ModelError, match=re.escape(what).replace(r"\.\*", ".*")):
        FitSettings(**options)
    FitSettings(lead=1.0, field_degree=1, strut_expansion=100e-6, strut_moisture=0.01, scale=0.01, alignment=0.1)
    FitSettings(lead=1e-4, field_degree=8, scale=0.0, alignment=0.0, tracker_frame="known")


def test_every_assumption_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", "--assumptions"]) == 0
    text = capsys.readouterr().out
    names = [f.name for f in fields(ASSUMED)]
    listed = [line.partition(" = ")[0] for line in text.splitlines()]
    assert listed == [*names, *(f"tolerance of {block}" for block in BLOCKS)]
    small.assert_recorded("assumptions", text)


PROBE = np.array([0.02, -0.03, -0.06])
COLD = FitSettings(lead=small.LEAD, field_degree=2)
WARM = replace(COLD, strut_expansion=12e-6, base_expansion=11e-6, platform_expansion=23e-6)
LATE = replace(
    WARM,
    strut_moisture=1e-4,
    time_constants=(500.0, 5000.0),
    blocks=("pitch", "backlash", "expansion", "late", "moisture"),
)
BY_ONE = replace(LATE, thermometer="base")
SPLIT = replace(WARM, shared_platform_joints=False)
STRUTS_ONLY = replace(COLD, blocks=("pitch", "wave", "backlash", "map"))


def led() -> HexapodGeometry:
    """Return the paper's machine with cardan joints and screws of 10 mm lead that turn in their nuts."""
    across = np.tile([1.0, 0.0, 0.0], (6, 1))
    return replace(small.paper(), screw_lead=np.full(6, 0.01), base_axes=across, platform_axes=across)


def case(geometry: HexapodGeometry, settings: FitSettings) -> tuple[ParameterSpace, Stations, np.ndarray]:
    """Return a parameter space, tilted stations with temperatures and humidity, and a machine drawn from the priors."""
    rng = np.random.default_rng(11)
    positions, rotations = poses_about(geometry.home, 12, seed=12, reach=0.04, tilt_deg=8.0)
    poses = [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]
    temperatures = [tuple(20.0 + rng.uniform(-8.0, 8.0, 8)) for _ in poses]
    readings = small.scattered(geometry, poses, temperatures, PROBE)
    times, humidity = np.sort(rng.uniform(0.0, 9e3, len(poses))), rng.uniform(0.2, 0.8, len(poses))
    readings = replace(readings, stations=replace(readings.stations, times=times, humidity=humidity))
    space = ParameterSpace(readings, settings)
    x = space.physical(space.spread(space.start_tolerances()) * rng.standard_normal(space.size))
    backlash = space.block("backlash").part
    x[backlash] = np.abs(x[backlash]) + 1e-6
    return space, readings.stations, x


def differences(space: ParameterSpace, stations: Stations, x: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return the derivatives of e along some directions (size, n) by central differences, shape (M, 6, n)."""

    def errors(steps: np.ndarray) -> np.ndarray:
        return predict(space, x + ways @ steps, stations).errors.ravel()

    # Steps of 0.5 µm (µm/m, µrad): rounding of 1e-15 m is 2e-9 of a step, and the third derivative is smaller.
    return central_difference(errors, np.zeros(ways.shape[1]), 5e-7).reshape(len(stations), 6, -1)


def some_ways(space: ParameterSpace, part: slice) -> np.ndarray:
    """Return two random directions within a block, shape (size, 2), that contain every parameter."""
    ways = np.zeros((space.size, 2))
    ways[part] = np.random.default_rng(13).choice([-1.0, 1.0], ways[part].shape)
    return ways


def worst(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the largest difference of displacement or rotation, relative to the largest derivative of each."""
    parts = (slice(0, 3), slice(3, 6))
    return max(float(np.abs(found[:, p] - wanted[:, p]).max() / max(np.abs(wanted[:, p]).max(), 1e-9)) for p in parts)


@pytest.mark.parametrize(
    ("make", "settings", "tolerance"),
    [
        # The derivatives omit the growth of the deviations, 2e-4, the slope of the field, 1e-3 at most, and half the
        # rotation error, 1e-3 rad, by which rotation vectors do not add up.
        (small.paper, WARM, 2e-3),
        (small.paper, SPLIT, 2e-3),
        (general_machine, WARM, 2e-3),
        (small.paper, LATE, 2e-3),
        (general_machine, BY_ONE, 2e-3),
        # A screw turned by the platform's rotation: lead/2π times 10 rad per metre of strut
        (led, STRUTS_ONLY, 3e-2),
    ],
    ids=["shared joints", "separate joints", "twelve joints", "late parts", "one thermometer", "turning screws"],
)
def test_every_block_against_finite_differences(
    make: Callable[[], HexapodGeometry], settings: FitSettings, tolerance: float
):
    space, stations, x = case(make(), settings)
    analytic = derivatives(space, predict(space, x, stations), stations)
    for block in space.blocks:
        ways = some_ways(space, block.part)
        assert worst(analytic @ ways, differences(space, stations, x, ways)) < tolerance, block.name


def test_displacements_are_exact_without_heat_and_field():
    """Displacements are exact to 1e-15 m / 5e-7 of rounding. Backlash may be negative, as estimates may be by noise; a
    prediction clipped at zero would make the fit diverge."""
    space, stations, x = case(small.paper(), STRUTS_ONLY)
    x[space.block("backlash").part] = [-2e-6, 1e-6, -1e-6, 3e-6, -3e-6, 2e-6]
    analytic = derivatives(space, predict(space, x, stations), stations)
    for block in space.blocks:
        ways = some_ways(space, block.part)
        numeric = differences(space, stations, x, ways)[:, :3]
        np.testing.assert_allclose((analytic @ ways)[:, :3], numeric, atol=1e-7, err_msg=block.name)


@pytest.mark.parametrize("settings", [WARM, SPLIT, STRUTS_ONLY], ids=["warm", "separate joints", "no field"])
def test_prediction_is_the_machine_that_the_compensator_runs(settings: FitSettings):
    """The grid may differ by its tolerance. Rotations of 1 mrad and 50 µrad do not commute, by half their product."""
    space, stations, x = case(small.paper(), settings)
    model = space.model(x)
    found = predict(space, x, stations).errors
    for n, machine in enumerate(stations.machines(RealMachine(space.geometry, model))):
        commanded = stations.pose(n)
        actual, _ = machine.pose_for(stations.commands[n], stations.sense[n], commanded)
        moved = actual.position + actual.rotation @ PROBE - commanded.position - commanded.rotation @ PROBE
        np.testing.assert_allclose(found[n, :3], moved, atol=2.0 * GRID_TOLERANCE)
        turned = attitude_error(actual.rotation, commanded.rotation)
        np.testing.assert_allclose(found[n, 3:], turned, atol=2.0 * GRID_TOLERANCE + 0.5 * 1e-3 * 50e-6)
