"""The error field of Mou & King, a table of errors over external quantities, and the measured box of a model.

The truth is Mou & King's formula, SciPy's interpolation, frames by hand, and machines of the zoo.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import calibration_helpers as small
import numpy as np
import pytest
from foreign_machines import machine_names, machines
from helpers import beside, distances
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation
from strategies import UNEVEN_GRID, fixed, paper_geometry, random_field, seeds

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import InputFileError, LimitError, ModelError, OutsideTableError
from hexapod_comp.machine.field import CROSS_AXES, GridField, no_field
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.outside import NO_TABLE, OutsideTable, load_outside
from hexapod_comp.machine.region import Region, region_json, region_text
from hexapod_comp.pose import Pose

FORWARD = np.ones(3)


def empty_lines(grid):
    """Return three families of lines without polynomials."""
    return [np.zeros((2, len(grid[a]), len(grid[b]), 6, 0)) for a, b in CROSS_AXES]


def inside(rng):
    """Return a random point of the uneven grid's box."""
    return np.array([rng.uniform(nodes[0], nodes[-1]) for nodes in UNEVEN_GRID])


def paper_weights(p, q, corners):
    """Return Mou & King's W_1 … W_4 for the point (p, q); the corner opposite to i is k = Mod(i + 2).

    Their denominators |P_1 − P_4| and |P_1 − P_2| define the numbering: 1 → 2 along the second axis, 1 → 4 along the
    first.
    """
    area = abs(corners[1][0] - corners[4][0]) * abs(corners[1][1] - corners[2][1])
    opposite = {1: 3, 2: 4, 3: 1, 4: 2}
    return {i: abs(p - corners[k][0]) * abs(q - corners[k][1]) / area for i, k in opposite.items()}


@fixed
@given(seeds, st.booleans())
def test_equals_the_papers_formula(seed, on_a_line):
    """The truth is Mou & King's W_xi, W_yi, W_zi and Δx, Δy, Δz, written here over the four corners, and np.polyval.

    Their lines carry one component each, here they carry six; the three families add up; an unknown direction has the
    mean of both. On a grid line only this line has a weight, in either cell. Tolerance: 1e-14 of 1e-4.
    """
    rng = np.random.default_rng(seed)
    field = random_field(rng)
    point, sense = inside(rng), rng.choice([-1.0, 0.0, 1.0], 3)
    if on_a_line:
        for axis in CROSS_AXES[rng.integers(3)]:
            point[axis] = rng.choice(UNEVEN_GRID[axis])
    truth = np.zeros(6)
    for axis, (a, b) in enumerate(CROSS_AXES):
        i = max(int(np.searchsorted(UNEVEN_GRID[a], point[a])) - 1, 0)
        j = max(int(np.searchsorted(UNEVEN_GRID[b], point[b])) - 1, 0)
        at = {1: (i, j), 2: (i, j + 1), 3: (i + 1, j + 1), 4: (i + 1, j)}
        corners = {n: (UNEVEN_GRID[a][m], UNEVEN_GRID[b][k]) for n, (m, k) in at.items()}
        middle = (UNEVEN_GRID[axis][0] + UNEVEN_GRID[axis][-1]) / 2
        u = (point[axis] - middle) / (UNEVEN_GRID[axis][-1] - middle)
        weights = paper_weights(point[a], point[b], corners)
        for n, (m, k) in at.items():
            forward, backward = (np.polyval(line[m, k, :, ::-1].T, u) for line in field.lines[axis])
            truth += weights[n] * {1.0: forward, -1.0: backward, 0.0: (forward + backward) / 2.0}[sense[axis]]
    error, outside = field.evaluate(point, sense)
    np.testing.assert_allclose(error, truth, atol=1e-18)
    assert not outside


@fixed
@given(seeds)
def test_outside_holds_the_boundary_value_and_says_so(seed):
    """The truth is the value at the nearest point of the box, bit for bit."""
    rng = np.random.default_rng(seed)
    field = random_field(rng)
    low, high = field.box
    beyond = inside(rng)
    axis, upwards = rng.integers(3), rng.integers(2)
    beyond[axis] = (low, high)[upwards][axis] + (2 * upwards - 1) * rng.uniform(1e-9, 10.0)
    assert np.isnan(field.evaluate([0.0, np.nan, 0.4], FORWARD)[0]).all()
    held, outside = field.evaluate(beyond, FORWARD)
    on_boundary, still_inside = field.evaluate(np.clip(beyond, low, high), FORWARD)
    assert outside is True
    assert still_inside is False
    np.testing.assert_array_equal(held, on_boundary)


def _family(values, axis):
    """Return three families of which only one, the given one, is not zero."""
    return [values if a == axis else lines for a, lines in enumerate(empty_lines(UNEVEN_GRID))]


@pytest.mark.parametrize(
    ("axis", "nodes", "lines", "key"),
    [
        (0, UNEVEN_GRID[0], _family(np.full((2, 4, 3, 6, 1), np.nan), 1), "field.lines_y"),
        (0, UNEVEN_GRID[0], _family(np.zeros((2, len(UNEVEN_GRID[1]) + 1, 3, 6, 1)), 0), "field.lines_x"),
        (0, UNEVEN_GRID[0][:1], empty_lines(UNEVEN_GRID), "field.grid_x"),
        (2, UNEVEN_GRID[2][::-1], empty_lines(UNEVEN_GRID), "field.grid_z"),
        (1, UNEVEN_GRID[1][[0, 1, 1]], empty_lines(UNEVEN_GRID), "field.grid_y"),
        (0, np.array([-np.inf, 0.0, 0.1, 0.2]), empty_lines(UNEVEN_GRID), "field.grid_x"),
    ],
)
def test_refuses_what_is_no_field(axis, nodes, lines, key):
    grid = [nodes if a == axis else given for a, given in enumerate(UNEVEN_GRID)]
    with pytest.raises(ModelError, match=key):
        GridField(tuple(grid), tuple(lines))
    for change in ({"probe": [0, 0]}, {"probe": [0, np.nan, 0]}, {"outside": "guess"}):
        with pytest.raises(ModelError, match=f"field.{next(iter(change))}"):
            GridField(UNEVEN_GRID, tuple(empty_lines(UNEVEN_GRID)), **change)


ELEVATION, ROTATION = np.radians([0.0, 20.0, 60.0, 90.0]), np.radians([-90.0, 0.0, 45.0])
HERE = {"elevation": 0.7, "rotation": -0.3}


def random_table(seed: int = 1, size: float = 50e-6, beyond: str = "hold") -> OutsideTable:
    rng = np.random.default_rng(seed)
    values = rng.uniform(-size, size, (2, len(ELEVATION) * len(ROTATION), 3))
    return OutsideTable(("elevation", "rotation"), ("deg", "deg"), (ELEVATION, ROTATION), *values, beyond=beyond)


def flexure(beyond: str = "hold") -> OutsideTable:
    """Return a table of a sag of 10 µm at an elevation of 0° and 40 µm at 90°."""
    sag = np.outer([10e-6, 40e-6], [0.0, 0.0, -1.0])
    return OutsideTable(("elevation",), ("deg",), (np.array([0.0, np.pi / 2]),), sag, np.zeros_like(sag), beyond=beyond)


# ---- the table ----


def test_between_nodes_it_is_bilinear_and_beyond_them_held() -> None:
    """The truth is SciPy's grid interpolation at the clipped place; at the nodes the values are exact."""
    table, rng = random_table(), np.random.default_rng(2)
    values = np.hstack([table.displacement, table.rotation]).reshape(len(ELEVATION), len(ROTATION), 6)
    reference = RegularGridInterpolator(table.nodes, values)
    for place in rng.uniform([-0.3, -2.0], [1.9, 1.2], (200, 2)):
        inside = np.clip(place, [ELEVATION[0], ROTATION[0]], [ELEVATION[-1], ROTATION[-1]])
        found = table.evaluate(dict(zip(table.names, place.tolist(), strict=True)))
        np.testing.assert_allclose(found, reference(inside)[0], atol=1e-19)
    for index in np.ndindex(values.shape[:2]):
        at = {"elevation": float(ELEVATION[index[0]]), "rotation": float(ROTATION[index[1]])}
        np.testing.assert_array_equal(table.evaluate(at), values[index])


def test_a_number_that_cannot_be_is_refused() -> None:
    """45 is refused as degrees. Beyond 90° a value is held up to a quarter of the table's range: 1.9 rad, not 2 rad."""
    compensator = Compensator(paper_geometry(), MachineModel("paper", outside=random_table()))
    compensator.set_outside({"elevation": 1.9, "rotation": 0.0, "azimuth": 1e9})
    assert compensator.model.outside.held(compensator.outside).startswith("elevation 108.862 deg")
    for numbers, problem in (
        ({"elevation": 2.0}, r"outside.elevation: the table covers elevation 0 to 90 deg; is the unit right\?"),
        ({"rotation": -2.2}, "outside.rotation: the table covers rotation -90 to 45 deg; is the unit right"),
        ({"elevation": np.nan}, "outside.elevation: must be finite"),
    ):
        with pytest.raises(ModelError, match=problem):
            compensator.set_outside(numbers)
        assert compensator.outside == {"elevation": 1.9, "rotation": 0.0, "azimuth": 1e9}


def test_a_table_that_refuses_and_a_correction_above_its_limit_keep_the_last_numbers() -> None:
    compensator = Compensator(paper_geometry(), MachineModel("paper", outside=random_table(beyond="refuse")))
    compensator.set_outside(HERE)
    with pytest.raises(
        OutsideTableError, match=r"elevation 91\.6732 deg: the table covers elevation 0 to 90 deg"
    ) as caught:
        compensator.set_outside({"elevation": 1.6})
    assert (caught.value.value, *caught.value.limit) == (1.6, 0.0, np.pi / 2)
    with pytest.raises(OutsideTableError, match="elevation 90"):
        compensator.set_outside({"elevation": 1.570799})  # 2.7 µrad too much
    assert compensator.outside == HERE
    compensator.set_outside({"elevation": 1.570797})  # 90° as a sender may round it: 0.7 µrad too much
    assert not compensator.model.outside.held(compensator.outside)
    tight = replace(paper_geometry(), limits=replace(paper_geometry().limits, correction=20e-6))
    compensator = Compensator(tight, MachineModel("paper", outside=flexure()))
    compensator.set_outside({"elevation": 0.1})
    with pytest.raises(LimitError, match="correction"):
        compensator.set_outside({"elevation": 1.5})
    assert compensator.outside == {"elevation": 0.1}


# ---- the machine ----


def goes(model: MachineModel, geometry: HexapodGeometry, numbers: dict[str, float], struts: np.ndarray) -> Pose:
    return RealMachine(geometry, model.at(numbers)).pose_for(struts)[0]


@pytest.mark.parametrize("name", machine_names())
def test_it_moves_the_measured_point_as_it_says(name: str, tmp_path: Path) -> None:
    """actual = commanded ∘ error: with nominal struts the measured point has the table's displacement and rotation.

    It holds at any pose, to rounding of the forward kinematics.
    """
    geometry, point = load_geometry(machines()[name].write(tmp_path / "machine.yaml")), np.array([0.01, -0.02, 0.05])
    model = MachineModel(geometry.name, field=replace(no_field(), probe=point), outside=random_table())
    error = model.outside.evaluate(HERE)
    for shift, turn in (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((1e-3, -2e-3, 1e-3), (0.02, -0.01, 0.03))):
        rotation = geometry.home.rotation @ Rotation.from_rotvec(turn).as_matrix()
        pose = Pose(geometry.home.position + np.array(shift), rotation)
        struts = distances(geometry, pose)
        if geometry.screw_lead.any():  # turning screws have another test
            struts = RealMachine(geometry, MachineModel(geometry.name)).commands_for(pose)[0]
        actual = goes(model, geometry, HERE, struts)
        moved = actual.position + actual.rotation @ point - pose.position - pose.rotation @ point
        np.testing.assert_allclose(moved, error[:3], atol=1e-13)
        turned = Rotation.from_matrix(actual.rotation @ pose.rotation.T).as_rotvec()
        np.testing.assert_allclose(turned, error[3:], atol=1e-12)


def test_a_field_and_the_table_add_up() -> None:
    """The table adds the same error everywhere in the field's box, whichever families of lines the field has."""
    rng, table = np.random.default_rng(5), random_table()
    error = table.evaluate(HERE)
    whole = random_field(rng)
    for field in (whole, replace(whole, lines=(whole.lines[0][..., :0], *whole.lines[1:])), no_field()):
        with_table = MachineModel("paper", field=field, outside=table).at(HERE)
        assert with_table.outside is NO_TABLE
        for _ in range(20):
            position = rng.uniform(field.box[0], field.box[1]) if field is not no_field() else rng.normal(size=3)
            sense = rng.uniform(-1.0, 1.0, 3)
            added = with_table.field.evaluate(position, sense)[0] - field.evaluate(position, sense)[0]
            np.testing.assert_allclose(added, error, atol=1e-19)


def test_nothing_steps_when_a_number_becomes_known() -> None:
    """A new quantity moves no strut faster than the ramp, 1 mm/s over 2 ms; the tool ends higher by the sag."""
    geometry = paper_geometry()
    compensator = Compensator(geometry, MachineModel("paper", outside=flexure()), ramp_rate=1e-3)
    tool = geometry.tool_pose(geometry.home)
    commands = [compensator.correct(tool, 0.0).command.copy()]
    compensator.set_outside({"elevation": np.pi / 2})
    commands += [compensator.correct(tool, 0.002 * n).command.copy() for n in range(1, 100)]
    assert np.abs(np.diff(commands, axis=0)).max() == pytest.approx(2e-6, rel=1e-9)
    assert not compensator.ramping
    raised = Pose(geometry.home.position + np.array([0.0, 0.0, 40e-6]), geometry.home.rotation)
    np.testing.assert_allclose(commands[-1], distances(geometry, raised), atol=1e-14)


def test_another_model_keeps_the_numbers_and_a_drift_stands_beside_them() -> None:
    compensator = Compensator(paper_geometry(), MachineModel("paper"))
    compensator.set_outside({"elevation": np.pi / 2})
    struts = distances(compensator.geometry, compensator.platform)
    height = compensator.estimate(struts)[2]
    compensator.set_model(MachineModel("paper", outside=flexure()))
    compensator.set_drift(np.array([0.0, 0.0, 7e-6, *[0.0] * 9]))
    assert compensator.estimate(struts)[2] - height == pytest.approx(7e-6 - 40e-6, abs=1e-12)
    compensator.set_outside({"elevation": 0.0})
    assert compensator.estimate(struts)[2] - height == pytest.approx(7e-6 - 10e-6, abs=1e-12)
    with pytest.raises(ModelError, match="is the unit right"):  # a model whose table excludes the present value
        compensator.set_model(MachineModel("paper", outside=replace(flexure(), nodes=(np.array([5.0, 6.0]),))))


# ---- files ----


HEADER = "rotation_deg,elevation_deg,x_um,y_um,z_um,rx_urad,ry_arcsec,rz_urad"


def test_a_table_is_read_from_csv(tmp_path: Path) -> None:
    """Rows may have any order; column names give units and order of the axes; there may be one axis or two."""
    file = tmp_path / "table.csv"
    rows = [f"{r},{e},{r + e},{r},{e},1,{e},3" for e in (90, 0, 45) for r in (10, -10)]
    file.write_text("\n".join([HEADER, *rows]))
    table = load_outside(file)
    assert (table.names, table.units) == (("rotation", "elevation"), ("deg", "deg"))
    np.testing.assert_array_equal(table.nodes[1], np.radians([0.0, 45.0, 90.0]))
    # x + y is linear in both quantities, so the table has it everywhere
    error = table.evaluate({"elevation": np.radians(33.0), "rotation": np.radians(7.0)})
    np.testing.assert_allclose(error[:4], [40e-6, 7e-6, 33e-6, 1e-6], rtol=1e-12)
    assert error[4] == pytest.approx(np.radians(33.0 / 3600.0))
    file.write_text("sequence,oil_degC,x_um,y_um,z_mm,rx_µrad,ry_urad,rz_urad\n1,20,0,0,0,0,0,0\n2,30,0,0,0.02,5,0,0\n")
    table = load_outside(file)
    assert (table.names, table.units) == (("oil",), ("degC",))
    np.testing.assert_allclose(table.evaluate({"oil": 24.0}), [0.0, 0.0, 8e-6, 2e-6, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        *beside(__file__)["refused"],
        (
            "\n".join([HEADER, *(f"{n % 2},{n // 2},3,4,5,6,7,8" for n in range(10_002))]),
            "outside.axes: must have at most 10000 nodes together .found 10002",
        ),
    ],
)
def test_a_csv_that_is_no_table_is_refused(text: str, problem: str, tmp_path: Path) -> None:
    file = tmp_path / "table.csv"
    file.write_text(text)
    with pytest.raises(InputFileError, match=problem):
        load_outside(file)


SIDES = np.array([[-0.1, -0.05, 0.3], [0.1, 0.05, 0.5]])


def test_a_tilted_tool_is_inside_where_its_point_is() -> None:
    """The measured point is 0.2 m above the platform: a tilt of 0.3 rad about x moves it by 0.2·sin 0.3 along −y."""
    region = Region(SIDES, np.array([0.0, 0.0, 0.2]))
    tilted = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    edge = np.array([0.0, 0.05 + 0.2 * np.sin(0.3), 0.4 - 0.2 * np.cos(0.3)])
    assert region.contains(edge - [0.0, 1e-6, 0.0], tilted)
    assert not region.contains(edge + np.array([0.0, 1e-6, 0.0]), tilted)
    assert not region.contains(edge, np.eye(3))
    many = region.contains(np.array([edge, edge]) - [0.0, 1e-6, 0.0], np.array([tilted, np.eye(3)]))
    np.testing.assert_array_equal(many, [True, False])


def test_the_box_is_stated_in_text_and_json() -> None:
    """A point 0.9 nm from a face is inside, one 1.1 nm from it is not."""
    region, text = Region(SIDES), "tool positions in work (-100, -50, 300)…(100, 50, 500) mm, sides 200 × 100 × 200 mm"
    assert region_text(region, small.paper()) == f"measured box: {text}"
    assert region_text(None, small.paper()) == "measured box: none"
    assert region_json(None, small.paper()) is None
    found = region_json(region, small.paper())
    np.testing.assert_allclose(found["tool_in_work_m"], SIDES, atol=1e-15)
    assert found["measured_point_in_platform_m"].tolist() == [0.0, 0.0, 0.0]
    for side, way in ((0, -1.0), (1, 1.0)):
        near, far = (SIDES[side] + way * np.array([0.0, 0.0, gap]) for gap in (0.9e-9, 1.1e-9))
        assert region.contains(np.array([near, far]), np.tile(np.eye(3), (2, 1, 1))).tolist() == [True, False]


def test_the_tools_box_follows_tool_and_work_frame() -> None:
    """Measured 0.1 m below the tip, the box is 0.1 m higher for the tip; a frame turned by 90° swaps x and y."""
    base = Region(SIDES, np.array([0.0, 0.0, 0.05]))
    turned = Pose.from_angles([0.2, 0.0, 0.1], np.radians([0.0, 0.0, 90.0]))
    geometry = replace(small.paper(), tool=Pose([0.0, 0.0, 0.15], np.eye(3)), work=turned)
    low, high = SIDES + np.array([0.0, 0.0, 0.1])
    wanted = np.array([[low[1], 0.2 - high[0], low[2] - 0.1], [high[1], 0.2 - low[0], high[2] - 0.1]])
    np.testing.assert_allclose(base.commanded(geometry), wanted, atol=1e-12)
    of_work = Region.of(SIDES + 1e-16, np.array([0.0, 0.0, 0.15]), turned)
    np.testing.assert_allclose(of_work.commanded(geometry), SIDES, atol=1e-12)
    assert of_work.box.tolist() == SIDES.tolist(), "a file has no rounding noise"
    corners = of_work.poses(SIDES, np.eye(3))
    assert of_work.contains(*corners).all()
    tip = turned.position + turned.rotation @ SIDES[0]
    np.testing.assert_allclose(corners[0][0] + np.array([0.0, 0.0, 0.15]), tip, atol=1e-12)


def test_in_a_frame_turned_askew_all_of_the_tools_box_was_measured() -> None:
    turned = Pose.from_angles([0.0, 0.0, 0.0], np.radians([10.0, -5.0, 30.0]))
    geometry, region = replace(small.paper(), work=turned), Region(SIDES)
    box = region.commanded(geometry)
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
    level = np.tile(np.eye(3), (8, 1, 1))
    assert region.contains(*geometry.platform_poses(corners, level)).all()
    larger = box.mean(axis=0) + 1.01 * (corners - box.mean(axis=0))
    assert not region.contains(*geometry.platform_poses(larger, level)).all()


def test_what_is_no_box_is_refused() -> None:
    for box, point, message in (
        (np.zeros((2, 2)), np.zeros(3), "region.box.*lowest.*highest"),
        ([[0, 0, 1], [1, 1, 0]], np.zeros(3), r"region.box.*\[1.0, 1.0, 0.0\]"),
        (SIDES, [0.0, np.inf, 0.0], "region.point.*inf"),
    ):
        with pytest.raises(ModelError, match=message):
            Region(box, point)
