"""Scheme `lines`: polynomials are recovered, unknown zeros and slopes removed, families of lines not added twice."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_helpers import BOUNDS, BOX, INCH, assert_recorded, described, paper
from foreign_machines import machines
from scipy.stats import linregress

from hexapod_comp.calibration.lines import LinesFit, fit_lines
from hexapod_comp.calibration.pictures import (
    fitted_lines_figure,
    pictures_of,
    strut_error_figure,
    strut_length_errors,
)
from hexapod_comp.calibration.report import lines_json, lines_report
from hexapod_comp.errors import CalibrationError
from hexapod_comp.machine.field import CROSS_AXES, GridField
from hexapod_comp.machine.geometry import STRUT_NAMES, HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure, jacobian
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.region import Region
from hexapod_comp.measurements.campaign import Campaign, template
from hexapod_comp.measurements.readings import FORWARD, KINDS, MeasurementSet
from hexapod_comp.measurements.stations import compensated
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import draw_model
from hexapod_comp.virtual.instruments import measure

GRID = tuple(np.round(np.linspace(low, high, n), 9) for low, high, n in zip(*BOX, (5, 5, 3), strict=True))
POWERS = (5, 5, 3)  # orders by the rule: a third of 17, 17 and 9 points

QUIET = Campaign(BOX, 4 * INCH, INCH, instrument="1-D", diagonals=0, noise=(0.0,) * 7, beam_slope=1e-3)
COARSE = replace(QUIET, cell=8 * INCH, step=1.6 * INCH)  # six points on the shortest lines, the fewest for a field


@pytest.fixture(scope="module")
def geometry() -> HexapodGeometry:
    return paper()


def machine_of(geometry: HexapodGeometry, lines) -> RealMachine:
    return RealMachine(geometry, MachineModel(geometry.name, field=GridField(GRID, lines)))


def parameter(axis: int, coordinate):
    """Return u of a coordinate by its definition: −1 at the first node, 1 at the last."""
    low, high = BOX[:, axis]
    return 2.0 * (coordinate - low) / (high - low) - 1.0


def random_family(rng: np.random.Generator, axis: int, components, datum: float) -> np.ndarray:
    """Return a family of lines, ±10 µm or µrad; the mean of both directions of each line is zero at a coordinate."""
    first, second = CROSS_AXES[axis]
    family = np.zeros((2, len(GRID[first]), len(GRID[second]), 6, POWERS[axis]))
    family[:, :, :, components] = rng.uniform(-1e-5, 1e-5, (*family.shape[:3], len(components), POWERS[axis]))
    powers = parameter(axis, datum) ** np.arange(POWERS[axis])
    family[..., 0] -= (family @ powers).mean(axis=0)
    return family


@pytest.fixture(scope="module")
def linear_truth(geometry) -> RealMachine:
    """Return a machine whose only error is Mou & King's 1-D field."""
    rng = np.random.default_rng(1)
    home = geometry.home.position
    return machine_of(geometry, tuple(random_family(rng, axis, [axis], home[axis]) for axis in range(3)))


@pytest.fixture(scope="module")
def quiet(geometry, linear_truth) -> MeasurementSet:
    return measure(template(QUIET, geometry), QUIET, linear_truth, 0)


@pytest.fixture(scope="module")
def five(geometry) -> MeasurementSet:
    """Return the rows of a 5-D campaign without values."""
    return template(replace(QUIET, instrument="5-D"), geometry)


@pytest.fixture(scope="module")
def real(geometry) -> RealMachine:
    return RealMachine(geometry, draw_model(geometry, BOUNDS, 3))


@pytest.fixture(scope="module")
def real_fit(geometry, real) -> LinesFit:
    campaign = replace(COARSE, instrument="5-D", cycles=2, noise=(1e-6,) * 7)
    return fit_lines(measure(template(campaign, geometry), campaign, real, 3), date="2025-01-01")


def test_a_machine_of_the_papers_form_is_found_again(quiet, linear_truth):
    """Coefficients are exact to 1e-12 m of rounding. Without noise adjusted R² must choose the full order."""
    fit = fit_lines(quiet)
    for found, true in zip(fit.model.field.lines, linear_truth.model.field.lines, strict=True):
        assert found == pytest.approx(true, abs=1e-12)
    assert all(nodes == pytest.approx(true) for nodes, true in zip(fit.model.field.grid, GRID, strict=True))
    assert fit.model.region.box == pytest.approx(BOX)


@pytest.mark.parametrize("instrument", ["1-D", "5-D"])
def test_what_the_screws_turning_does_is_not_counted_twice(tmp_path, instrument):
    """Commanded with nominal lengths the machine errs by micrometres, which the compensator computes from the geometry;
    the field is zero to 1e-12 m and rad of rounding."""
    machine = machines()["unit"]
    geometry = load_geometry(machine.write(tmp_path / "machine.yaml"))
    campaign = Campaign(machine.box, 0.01, 0.002, instrument=instrument, diagonals=0, noise=(0.0,) * 7)
    ideal = RealMachine(geometry, MachineModel(geometry.name))
    measured = measure(template(campaign, geometry), campaign, ideal, 0)
    assert np.abs(measured.value).max() > 1e-6
    for family in fit_lines(measured).model.field.lines:
        assert np.abs(family).max(initial=0.0) < 1e-12


def noisy_lines(geometry: HexapodGeometry, seed: int = 0) -> MeasurementSet:
    """Return 1-D readings of 20 µm·u² with 0.5 µm of noise on every line."""
    rng = np.random.default_rng(seed)
    blank = template(QUIET, geometry)
    axis = np.array([run.base_axis for run in blank.runs])[blank.run]
    points = blank.points()[blank.station]
    u = np.array([parameter(a, point[a]) for a, point in zip(axis, points, strict=True)])
    return blank.with_values(20e-6 * u**2 + 0.5e-6 * rng.standard_normal(len(u)))


def test_adjusted_r2_finds_a_parabola(geometry):
    """No line has an order below 2. A higher term with F > 1 is taken by chance, on fewer than half of the lines."""
    orders = np.array([line.order for line in fit_lines(noisy_lines(geometry)).lines])
    assert orders.min() == 2
    assert np.mean(orders == 2) > 0.5


def test_the_figures_of_a_polynomial_are_those_of_a_regression(geometry):
    """The truth is scipy.stats.linregress on NumPy's polynomial of the same order; adjusted R² from variances."""
    for line in fit_lines(noisy_lines(geometry)).lines[::7]:
        fitted = np.polynomial.Polynomial.fit(line.coordinates, line.values, line.order)(line.coordinates)
        variance = ((line.values - fitted) ** 2).sum() / (len(fitted) - line.order - 1)
        assert line.r2 == pytest.approx(linregress(fitted, line.values).rvalue ** 2, abs=1e-12)
        assert line.residual_std == pytest.approx(np.sqrt(variance), rel=1e-9)
        assert line.adjusted_r2 == pytest.approx(1.0 - variance / line.values.var(ddof=1), abs=1e-12)


def test_families_do_not_count_twice(geometry, five):
    """5-D lines without noise recover the field of a machine of the scheme's own form, except for its unseen terms.

    The truth is the machine's field at random points. Its dx has any polynomials on the x-lines, zero at home, and a
    curve that all y-lines share; dy and dz likewise. The unknown zeros and slopes hide a constant, the two slopes
    across and their product in each displacement; the test projects them out. Families added as they are read would be
    wrong by 10 µm.
    """
    rng = np.random.default_rng(5)
    home = geometry.home.position
    families = [random_family(rng, axis, [axis], home[axis]) for axis in range(3)]
    for axis, component in ((1, 0), (0, 1), (0, 2)):
        rest = random_family(rng, axis, [component], home[axis])
        families[axis] += rest[:, :1, :1]
    truth = machine_of(geometry, tuple(families))
    campaign = replace(QUIET, instrument="5-D")
    found = fit_lines(measure(five, campaign, truth, 0)).model.field
    points = rng.uniform(*BOX, (200, 3))
    senses = rng.choice([-1.0, 1.0], (200, 3))
    both = zip(points, senses, strict=True)
    off = np.array([found.evaluate(p, s)[0] - truth.model.field.evaluate(p, s)[0] for p, s in both])
    for component in range(3):
        s, t = (parameter(a, points[:, a]) for a in CROSS_AXES[component])
        unseen = np.stack([np.ones_like(s), s, t, s * t], axis=1)
        rest = off[:, component] - unseen @ np.linalg.lstsq(unseen, off[:, component], rcond=None)[0]
        assert np.abs(rest).max() < 1e-10


def test_one_direction_serves_for_both_with_a_note(quiet, linear_truth):
    forward = quiet.select(quiet.direction == FORWARD)
    fit = fit_lines(forward)
    for family, true in zip(fit.model.field.lines, linear_truth.model.field.lines, strict=True):
        assert (family[0] == family[1]).all()
        # The zero is now that of the forward readings alone, so only the shapes are compared.
        assert family[0][..., 1:] == pytest.approx(true[0][..., 1:], abs=1e-12)


def test_all_that_a_reader_must_know_is_a_note(geometry, linear_truth):
    """Lines above home, read forward at 22 to 23 °C with struts 1 µm off, and diagonals: each has its note."""
    campaign = replace(QUIET, box=BOX + np.array([0.0, 0.0, 0.06]), diagonals=2)
    m = measure(template(campaign, geometry), campaign, linear_truth, 0)
    m = m.select(m.direction == FORWARD)
    warm = np.full_like(m.stations.temperatures, 22.0)
    warm[-1] = 23.0
    stations = replace(m.stations, temperatures=warm, commands=m.stations.commands + 1e-6)
    assert fit_lines(replace(m, stations=stations)).notes == (
        "2 runs are not parallel to an axis of base; scheme lines does not use them (first: diagonal 1)",
        "read at 22.0 to 22.0 °C; scheme lines takes thermal growth for an error at 20 °C",
        "strut commands differ by up to 1.00 µm from the nominal lengths; the fit neglects this",
        "home lies outside the box along z: the polynomials are zero at the end of the box nearest to home",
        "55 lines were not read in both directions; their polynomials are used for both directions (first: x line at "
        "y -203.2, z 410.0 mm)",
    )


def test_the_work_frame_may_be_turned_by_right_angles(geometry, linear_truth):
    """The same machine, with its program in a frame turned by 90°, gets the same field in ``base``."""
    turn = Pose.from_angles([0.0, 0.0, 0.0], np.deg2rad([0.0, 0.0, 90.0]))
    turned = replace(geometry, work=turn, tool=turn)  # the tool is turned too, so the platform's poses stay the same
    campaign = replace(COARSE, instrument="5-D")
    fits = []
    for machine in (geometry, turned):
        truth = RealMachine(machine, linear_truth.model)
        fits.append(fit_lines(measure(template(campaign, machine), campaign, truth, 0)).model.field)
    for first, second in zip(fits[0].lines, fits[1].lines, strict=True):
        assert first == pytest.approx(second, abs=1e-11)


def test_the_report_of_lines(real_fit):
    assert_recorded("lines", lines_report(real_fit))
    assert_recorded("lines", lines_json(real_fit))


@pytest.mark.parametrize(("name", "kind", "limit"), [("repeat_std", "linear", 10), ("residual_std", "rotation", 100)])
def test_scatter_and_residuals_have_a_limit(real_fit, name, kind, limit):
    """The model is refused if repeats exceed 10 times, or residuals 100 times, the stated noise; here of x lines."""
    m = real_fit.measurements.select(line_of(real_fit.measurements, "x line"))
    members = m.kind == KINDS.index(kind)
    of_kind = [
        n for n in fit_lines(m).lines if (n.component >= 3) == (kind == "rotation") and n.component in (0, 3, 4, 5)
    ]
    found = np.sqrt(np.mean([getattr(line, name) ** 2 for line in of_kind]))
    for share in (0.999, 1.001):
        stated = np.where(members, share * found / limit, m.uncertainty)
        misfit = fit_lines(replace(m, uncertainty=stated)).misfit
        assert misfit.startswith(
            f"readings scatter by more than {limit} times their noise: {kind}" if share < 1.0 else ""
        )
        assert bool(misfit) == (share < 1.0)


def test_strut_errors_of_a_lifted_machine(geometry):
    """For dz = 10 µm each strut is longer by the z column of its Jacobian, but for ΔL²/2L ≈ 1e-10 m."""
    family = np.zeros((2, 2, 2, 6, 1))
    family[:, :, :, 2] = 10e-6
    empty = np.zeros((2, 2, 2, 6, 0))
    nodes = tuple(BOX[:, axis] for axis in range(3))
    model = MachineModel(geometry.name, field=GridField(nodes, (family, empty, empty)), region=Region(BOX))
    found = strut_length_errors(geometry, model, np.array([-0.1, 0.15]), 0.05, 0.45)
    for n, x in enumerate((-0.1, 0.15)):
        column = jacobian(Structure.of(geometry), Pose([x, 0.05, 0.45], np.eye(3)))[:, 2]
        assert found[:, n] == pytest.approx(np.tile(10e-6 * column, (2, 1)), abs=3e-10)


def test_pictures(geometry, real_fit):
    figure = strut_error_figure(geometry, {"1-D": real_fit.model, "5-D": real_fit.model})
    assert [axes.get_title() for axes in figure.axes[1:3]] == ["1-D, (b) backward ←", "5-D, (a) forward →"]
    along = np.linspace(-0.2032, 0.2032, 161)
    drawn = strut_length_errors(geometry, real_fit.model, along, 0.0, 0.4516)
    for axes, of_way in zip(figure.axes, (*drawn, *drawn), strict=True):
        for line, name, values in zip(axes.lines, STRUT_NAMES, of_way.T, strict=True):
            assert line.get_label() == name
            np.testing.assert_allclose(line.get_xydata(), np.stack([along * 1e3, values * 1e6], axis=1), atol=1e-9)
    assert_recorded("picture_lines", described(fitted_lines_figure(real_fit, 2, 0)))
    with pytest.raises(CalibrationError, match="each with its measured box"):
        strut_error_figure(geometry, {"ideal": MachineModel(geometry.name)})
    with pytest.raises(CalibrationError, match="rx on x lines: was not fitted"):
        fitted_lines_figure(real_fit, 0, 3)


def test_a_grid_without_lines_along_x_has_its_pictures(geometry, linear_truth):
    coarse = measure(template(COARSE, geometry), COARSE, linear_truth, 0)
    pictures = pictures_of(fit_lines(coarse.select(line_of(coarse, "z line"))))
    assert list(pictures) == ["lines.png", "strut_errors.png", "predicted_error.png"]
    assert len(pictures["lines.png"].axes) == 9, "3 × 3 lines along z"


def line_of(measured: MeasurementSet, start: str) -> np.ndarray:
    """Return which readings belong to runs whose names begin with `start`."""
    return np.array([run.name.startswith(start) for run in measured.runs])[measured.run]


def with_a_tilted_line(m: MeasurementSet) -> MeasurementSet:
    """Return readings whose first run has a tilted tool."""
    rotations = m.stations.rotations.copy()
    rotations[m.station[m.run == 0]] = Pose.from_angles(np.zeros(3), [0.01, 0.0, 0.0]).rotation
    return replace(m, stations=replace(m.stations, rotations=rotations))


def skewed(geometry: HexapodGeometry) -> MeasurementSet:
    """Return lines of a work frame turned by 30° about z: only its z-lines are parallel to an axis of base."""
    turn = Pose.from_angles([0.0, 0.0, 0.0], np.deg2rad([0.0, 0.0, 30.0]))
    campaign = replace(QUIET, box=BOX * [0.5, 0.5, 1.0], instrument="5-D")
    return template(campaign, replace(geometry, work=turn, tool=turn))


REFUSED = {
    r"dx on the x line at y 101.6, z 451.6 mm: is missing; 1 of 15 lines": lambda m: m.select(
        ~line_of(m, "x line at y 101.6, z 451.6")
    ),
    r"x line at y 0.0, z 350.0 mm: is read from -203.2 to 177.8 mm": lambda m: m.select(
        ~(line_of(m, "x line at y 0.0, z 350.0") & (m.points()[m.station][:, 0] > 0.19))
    ),
    r"has 5 points in one direction, over 406\.4 mm; 6 are needed: one every 81\.28 mm": lambda m: template(
        replace(QUIET, cell=0.1016, step=0.1016), m.geometry
    ),
    "turned against the axes of base": lambda m: skewed(m.geometry),
    "at one attitude": with_a_tilted_line,
    "uncompensated": lambda m: compensated(m, MachineModel(m.geometry.name, base_deviation=np.full((6, 3), 1e-5))),
}


@pytest.mark.parametrize("what", REFUSED)
def test_lines_that_make_no_field_are_refused(quiet, what):
    with pytest.raises(CalibrationError, match=what):
        fit_lines(REFUSED[what](quiet))
