"""The machine model forwards and backwards: temperatures, late parts, directions of motion, load.

The truth is closures, closed forms, SciPy's integration of the lag, and the minimum of the energy of six springs and a
weight, which SciPy finds without forces.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_helpers import paper
from foreign_machines import machine_names, machines
from helpers import distances, nominal_error, three_two_one_machine
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from strategies import (
    UNEVEN_GRID,
    fixed,
    paper_geometry,
    random_field,
    random_model,
    random_pose,
    seeds,
    skewed_geometry,
)

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.core.batch import follow_nine
from hexapod_comp.errors import FrameError, HexapodError, InputFileError, KinematicsError, ModelError, NotConvergedError
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure, solve_poses, strut_lengths_batch
from hexapod_comp.machine.load import STANDARD_GRAVITY, Load, Loading, Payload, beyond_loads, wrench_on_platform
from hexapod_comp.machine.model import Datum, MachineModel, ModelOrigin, MotionState, RealMachine
from hexapod_comp.machine.outside import OutsideTable
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.surroundings import NO_LOAD, Surroundings
from hexapod_comp.machine.temperatures import PARTS, Lag, LateGrowth, Temperatures, thermal_lags
from hexapod_comp.machine.trial import ToolErrors, drive, model_commands
from hexapod_comp.pose import Pose

WARM = {"strut_1": 24.0, "strut_4": 18.5, "base": 21.0, "platform": 27.0}
GEOMETRIES = {"paper": paper_geometry(), "skewed": skewed_geometry()}


def assert_same_pose(found, truth, position=1e-13, angle=1e-12):
    """Compare two poses within 1e-13 m and 1e-12 rad."""
    assert np.abs(found.position - truth.position).max() <= position
    turn = Rotation.from_matrix(found.rotation @ truth.rotation.T)
    assert turn.magnitude() <= angle


def shifted(pose, *by):
    return Pose(pose.position + np.array(by), pose.rotation)


def moving(machine, pose):
    """Return a motion state in which all nine values have a direction, some forward and some backward."""
    motion = MotionState()
    machine.commands_for(shifted(pose, 1e-3, -1e-3, 1e-3), motion)
    return motion


# Forwards and backwards


@fixed
@given(seeds)
def test_model_pose_times_its_error_is_the_target(seed):
    """The truth is q ∘ E(q) = p, composed here from the field's value with SciPy's rotations.

    E moves the measured point by d and turns the platform by exp(ω) about it. Tolerance: a few roundings.
    """
    rng = np.random.default_rng(seed)
    geometry = GEOMETRIES["skewed"]
    field = random_field(rng, size=1e-4, probe=rng.uniform(-0.1, 0.1, 3))
    machine = RealMachine(geometry, MachineModel("skewed", field=field))
    target = random_pose(rng, geometry.home)
    motion = moving(machine, target)
    _, q, outside = machine.commands_for(target, motion)
    point = q.position + q.rotation @ field.probe
    error, outside_too = field.evaluate(point, motion.sense[:3])
    rotation = Rotation.from_rotvec(error[3:]).as_matrix() @ q.rotation
    position = point + error[:3] - rotation @ field.probe
    np.testing.assert_allclose(position, target.position, atol=2e-15)
    np.testing.assert_allclose(rotation, target.rotation, atol=2e-15)
    assert outside == outside_too


@pytest.mark.parametrize("body", ["base", "platform"])
def test_a_deviation_is_a_moved_joint(body):
    """The strut's length is the distance to the joint's real place; the other five struts do not change."""
    geometry = GEOMETRIES["skewed"]
    deviation = np.zeros((6, 3))
    deviation[2] = [120e-6, -80e-6, 50e-6]
    machine = RealMachine(geometry, MachineModel("skewed", **{f"{body}_deviation": deviation}))
    real = replace(geometry, **{f"{body}_joints": getattr(geometry, f"{body}_joints") + deviation})
    for seed in range(10):
        pose = random_pose(np.random.default_rng(seed), geometry.home)
        commands, _, _ = machine.commands_for(pose, MotionState())
        nominal = distances(geometry, pose)
        np.testing.assert_allclose(commands, distances(real, pose), atol=2e-16)
        np.testing.assert_array_equal(np.abs(commands - nominal) > 1e-9, np.arange(6) == 2)


def test_a_field_too_steep_to_undo_is_refused():
    """A field of slope 2.5 is refused: the fixed-point iteration jumps between the sides of the box for ever."""
    lines = [np.zeros((2, 4 if a == 0 else 3, 3, 6, 2)) for a in (1, 0, 0)]
    lines[0][:, :, :, 0, 1] = 0.5
    model = MachineModel("paper", field=GridField(UNEVEN_GRID, tuple(lines)))
    with pytest.raises(NotConvergedError, match="inverts the error field does not converge"):
        RealMachine(GEOMETRIES["paper"], model).commands_for(Pose([0.01, 0.0, 0.4], np.eye(3)), MotionState())
    poses = np.tile([0.01, 0.0, 0.4], (2, 1)), np.tile(np.eye(3), (2, 1, 1))
    machines = [RealMachine(GEOMETRIES["paper"], one) for one in (MachineModel("paper"), model)]
    with pytest.raises(NotConvergedError, match=r"second: the iteration that inverts the error field does not conv"):
        model_commands(machines, poses, np.zeros((2, 9)), ["first", "second"].__getitem__)


# Temperatures


@fixed
@given(seeds, st.floats(-20.0, 60.0))
def test_uniform_growth_scales_the_machine(seed, temperature):
    """By similar triangles, growth of base, platform and struts by 1 + g scales the platform's position by 1 + g,
    without a rotation. Offsets and deviations belong to the parts and grow with them.
    """
    rng = np.random.default_rng(seed)
    geometry = GEOMETRIES["skewed"]
    expansion = 12e-6
    model = MachineModel(
        "skewed",
        base_deviation=rng.uniform(-1e-4, 1e-4, (6, 3)),
        platform_deviation=rng.uniform(-1e-4, 1e-4, (6, 3)),
        struts=StrutErrors(offset=rng.uniform(-1e-3, 1e-3, 6), expansion=np.full(6, expansion)),
        base_expansion=expansion,
        platform_expansion=expansion,
    )
    everywhere = Temperatures(dict.fromkeys(Temperatures.NAMES, temperature))
    cold, hot = RealMachine(geometry, model), RealMachine(geometry, model, everywhere)
    pose = random_pose(rng, geometry.home)
    commands, _, _ = cold.commands_for(pose, MotionState())
    found, _ = hot.pose_for(commands, np.zeros(9), pose)
    growth = expansion * (temperature - 20.0)
    assert_same_pose(found, Pose(pose.position * (1.0 + growth), pose.rotation))


def test_bad_temperatures_are_refused():
    temperatures = Temperatures()
    for name, value, message in (
        ("strut_7", 20.0, "strut_1.*platform.*strut_7"),
        ("base", math.nan, "base.*-40…120.*nan"),
        ("base", -40.1, "temperature of base: must lie within -40…120 °C"),
        ("base", 120.1, "temperature of base: must lie within -40…120 °C"),
        ("humidity", 0.0099, "humidity: must lie within 0.01…1, as a fraction"),
        ("humidity", 1.01, "humidity: must lie within 0.01…1, as a fraction"),
    ):
        with pytest.raises(ModelError, match=message):
            temperatures.set(name, value)
        assert not temperatures.values
    for name, value in (("base", -40.0), ("base", 120.0), ("humidity", 0.01), ("humidity", 1.0)):
        temperatures.set(name, value)
        assert temperatures.at(name) == value


# Impossible models


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"base_deviation": np.zeros((5, 3))}, r"structure.base_deviation.*\(6, 3\)"),
        ({"platform_deviation": np.full((6, 3), np.nan)}, "structure.platform_deviation.*nan"),
        ({"base_deviation": np.full((6, 3), 0.2)}, "structure.base_deviation.*±50 mm.*0.2"),
        ({"reversal_threshold": -1e-6}, "reversal_threshold.*-1e-06"),
        ({"reversal_threshold": math.nan}, "reversal_threshold.*nan"),
        ({"base_expansion": math.inf}, "thermal.base_expansion.*inf"),
        ({"machine": "the other one"}, r"machine: .*'the other one'.*'paper'"),
    ],
)
def test_bad_models_are_refused(bad, message):
    with pytest.raises(ModelError, match=message):
        RealMachine(GEOMETRIES["paper"], MachineModel(**{"machine": "paper"} | bad))


THRESHOLD = 2e-6


def follow(value, threshold, low, sense, index):
    """Follow one of the nine values without the others; return its direction."""
    values = np.full(9, np.nan)
    values[index] = value
    follow_nine(values, threshold, threshold, low, sense)
    return sense[index]


FAR = 0.5 + 1e-3


@pytest.mark.parametrize(
    ("threshold", "values", "senses"),
    [
        # 1.9 µm back from the furthest point is noise, 2.1 µm is a reversal, and likewise for the next reversal
        pytest.param(THRESHOLD, [0.5, FAR, FAR - 1.9e-6, FAR - 2.1e-6, FAR - 0.3e-6, FAR], [0, 1, 1, -1, -1, 1]),
        # Steps far below the threshold add up: after more than half of it the direction is known
        pytest.param(THRESHOLD, [0.5 + 0.3e-6 * step for step in range(6)], [0, 0, 0, 0, 1, 1], id="creeping"),
        pytest.param(0.0, [0.5, 0.6, 0.6, 0.59, 0.59, 0.7], [0, 1, 1, -1, -1, 1], id="no threshold"),
        pytest.param(THRESHOLD, [math.nan, 0.5, 0.6, math.nan, 0.6 - 1e-6, 0.6 - 3e-6], [0, 0, 1, 1, 1, -1], id="NaN"),
    ],
)
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_direction_turns_at_the_threshold(threshold, values, senses, way):
    """The truth is the definition of the reversal threshold."""
    state = MotionState()
    found = [follow(way * value, threshold, state.low, state.sense, 4) for value in values]
    assert found == [way * sense for sense in senses]


def test_the_nine_values_are_apart_and_a_copy_is_one():
    one, other = MotionState(), MotionState()
    for index in range(9):
        follow(0.5, THRESHOLD, one.low, one.sense, index)
    follow(0.6, THRESHOLD, one.low, one.sense, 2)
    follow(0.4, THRESHOLD, one.low, one.sense, 7)
    np.testing.assert_array_equal(one.sense, [0, 0, 1, 0, 0, 0, 0, -1, 0])
    other.copy_from(one)
    follow(0.5, THRESHOLD, one.low, one.sense, 2)
    assert other.sense[2] == 1.0
    assert one.sense[2] == -1.0


TIMES = np.array([5.0, 65.0, 66.0, 200.0, 900.0, 1000.0])
VALUES = np.array([20.0, 20.4, 20.4, 21.5, 23.0, 22.1])


def integrated(constant: float) -> np.ndarray:
    """Return the lag's output minus its input at TIMES by integrating τ F' = s − F, with s linear between readings."""
    flow = solve_ivp(
        lambda t, f: (np.interp(t, TIMES, VALUES) - f) / constant,
        (TIMES[0], TIMES[-1]), [VALUES[0]], t_eval=TIMES, rtol=1e-10, atol=1e-12, max_step=0.5,
    )  # fmt: skip
    return flow.y[0] - VALUES


@pytest.mark.parametrize("constant", [10.0, 300.0, 1e5])
def test_a_lag_is_the_solution_of_its_equation(constant: float):
    """The integration has 1e-9 K of error."""
    found = thermal_lags(TIMES, VALUES[:, None], [constant])[:, 0, 0]
    np.testing.assert_allclose(found, integrated(constant), atol=1e-7)


def test_readings_one_by_one_and_all_at_once_in_any_order():
    """The core's update reading by reading equals a fit's evaluation of all readings, to rounding."""
    constants = (100.0, 1000.0)
    compensator = Compensator(paper(), warming_model(time_constants=constants))
    behind = []
    for time, value in zip(TIMES, VALUES, strict=True):
        compensator.set_temperature("base", value, time)
        behind.append(compensator.temperatures.lags["base"].behind)
    shuffled = np.array([3, 0, 5, 1, 4, 2])
    found = thermal_lags(TIMES[shuffled], VALUES[shuffled, None], constants)[:, 0]
    np.testing.assert_allclose(found, np.array(behind)[shuffled], atol=1e-12)


def test_a_snapshot_with_other_lags_is_refused():
    """Two time constants need four numbers of a sensor with a reading: begin, newest, two lags."""
    for values, numbers in (({"base": 21.0}, [0.0, 9.0, 0.5]), ({}, [0.0, 9.0, 0.5, 0.1])):
        with pytest.raises(ModelError, match=r"snapshot.lags.base: must be 4 numbers"):
            Temperatures.restored(values, {"base": numbers}, 2)
    restored = Temperatures.restored({"base": 21.0}, {"base": [0.0, 9.0, 0.5, 0.1]}, 2)
    assert restored.snapshot() == {"temperatures": {"base": 21.0}, "lags": {"base": [0.0, 9.0, 0.5, 0.1]}}


def warming_model(**changes) -> MachineModel:
    """Return a model with two time constants whose parts all follow the base's thermometer."""
    expansion = 1e-6 * np.arange(16.0).reshape(8, 2)
    values = {"time_constants": (600.0, 7200.0), "expansion": expansion, "thermometer": "base"} | changes
    struts = StrutErrors(expansion=np.full(6, 11e-6))
    model = MachineModel("paper", "warm", struts=struts, base_expansion=10e-6, platform_expansion=23e-6)
    return replace(model, late_growth=LateGrowth(**values), origin=ModelOrigin("2026-01-31"))


def test_a_machine_grows_by_one_thermometer_and_what_is_behind_it():
    """Strut 3 grows by 11 ppm/K of 2 K, less 4 and 5 ppm/K of 1 and 1.5 K: 10.5 ppm; the base by 20 − 12 − 19.5 ppm."""
    read = dict(zip(PARTS, [99.0] * 6 + [22.0, 50.0], strict=True))
    behind = {part: Lag(np.nan, np.nan, [-1.0, -1.5] if part == "base" else [0.0, 0.0]) for part in PARTS}
    warm = RealMachine(paper(), warming_model(), Temperatures(read, behind))
    assert warm.growth[2] == pytest.approx(10.5e-6)
    nominal = paper().kernel_joints[0]
    np.testing.assert_allclose(warm.structure.base_joints - nominal, -11.5e-6 * nominal, atol=1e-15)
    own = RealMachine(paper(), warming_model(thermometer=""), Temperatures({"strut_3": 24.0, "base": 22.0}))
    assert own.growth[2] == pytest.approx(44e-6)  # from its own thermometer, at rest


def test_stations_driven_together_go_where_each_goes_alone():
    """Four stations driven together, two of them equal, give each station's own result bit for bit.

    A third station whose length no pose has is named in the error."""
    temperatures, humidity = np.full((4, 8), 20.0), np.full(4, np.nan)
    temperatures[1:3, 6], temperatures[3, 2] = 23.0, 25.0
    around = Surroundings(temperatures, np.full(4, np.nan), humidity, np.tile(NO_LOAD, (4, 1)))
    machines = around.machines(RealMachine(paper(), warming_model()))
    assert machines[1] is machines[2]
    assert len(set(machines)) == 3
    home = paper().home
    positions = home.position + 1e-3 * np.arange(12.0).reshape(4, 3)
    rotations, senses = np.tile(home.rotation, (4, 1, 1)), np.tile([1.0, -1.0, 1.0], (4, 3))
    commands = strut_lengths_batch(Structure.of(paper()), positions, rotations)
    driven = drive(machines, (positions, rotations), senses, commands).actual
    for n, machine in enumerate(machines):
        alone, _ = machine.pose_for(commands[n], senses[n], Pose(positions[n], rotations[n]))
        assert (driven[0][n] == alone.position).all()
        assert (driven[1][n] == alone.rotation).all()
    commands[2, 0] = 100.0
    with pytest.raises(KinematicsError, match="row 2"):
        drive(machines, (positions, rotations), senses, commands, lambda n: f"row {n}")


def test_a_restart_does_not_know_what_was_before_and_says_for_how_long():
    """The lags are uncertain for 7200 s, three slowest time constants, after the thermometer's first reading."""
    compensator = Compensator(paper(), warming_model())

    def unknown_for(time: float) -> float:
        return compensator.temperatures.unknown_for(compensator.model.late_growth, time)

    assert unknown_for(1000.0) == 0.0
    compensator.set_temperature("strut_1", 25.0, 900.0)
    assert unknown_for(1000.0) == 0.0
    compensator.set_temperature("base", 25.0, 1000.0)
    assert unknown_for(2000.0) == 3 * 7200.0 - 1000.0
    assert unknown_for(50_000.0) == 0.0


def test_whatever_acts_on_the_machine_tells_places_apart():
    """Stations that differ in any influence on the machine are kept apart; only others may be merged."""
    swelling = StrutErrors(expansion=np.full(6, 11e-6), moisture=np.full(6, 1e-4))
    load = Load(stiffness=np.full(6, 2e7), mass=20.0)
    bending = RealMachine(paper(), replace(warming_model(), struts=swelling, load=load))
    rigid, growing = (
        RealMachine(paper(), MachineModel("paper", name, base_expansion=expansion))
        for name, expansion in (("rigid", 0.0), ("growing", 11e-6))
    )
    usual = [20.0] * 8 + [0.5] + [3.0, 0.0, 0.0, 0.1] + [0.0, 0.0, -9.81]
    rows = np.tile(usual, (1 + len(usual), 1))
    rows[1 + np.arange(len(usual)), np.arange(len(usual))] += 0.25
    around = Surroundings(rows[:, :8], np.full(len(rows), np.nan), rows[:, 8], rows[:, 9:])
    assert len(set(around.machines(bending))) == len(rows)
    assert len(set(around.machines(growing))) == 9  # without compliance and swelling only temperatures matter
    assert len(set(around.machines(rigid))) == 1
    again = Surroundings(*(np.concatenate([part, part]) for part in vars(around).values()))
    machines = again.machines(bending)
    assert all(a is b for a, b in zip(machines, machines[len(rows) :], strict=False))


SOFT = np.full(6, 20e6)  # N/m
G = STANDARD_GRAVITY


def loaded(geometry: HexapodGeometry, loading: Loading | None = None, **load: object) -> RealMachine:
    block = Load(**{"stiffness": SOFT, "mass": 30.0, **load})  # type: ignore[arg-type]
    return RealMachine(geometry, MachineModel(geometry.name, load=block), loading=loading or Loading())


def lowest_energy(
    geometry: HexapodGeometry, lengths: np.ndarray, stiffness: np.ndarray, mass: float, centre: np.ndarray,
    gravity: np.ndarray, start: Pose,
) -> Pose:  # fmt: skip
    """Return the pose of a platform on six springs at which the energy's gradient, by central differences, is zero."""

    def pose(x: np.ndarray) -> Pose:
        return Pose(start.position + x[:3], Rotation.from_rotvec(x[3:]).as_matrix() @ start.rotation)

    def energy(x: np.ndarray) -> float:
        at, home = pose(x), start.position + start.rotation @ centre
        springs = 0.5 * (stiffness * (distances(geometry, at) - lengths) ** 2).sum()
        return float(springs - mass * gravity @ (at.position + at.rotation @ centre - home))

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.array([(energy(x + 1e-6 * e) - energy(x - 1e-6 * e)) / 2e-6 for e in np.eye(6)])

    return pose(least_squares(gradient, np.zeros(6), x_scale=1e-5, xtol=1e-15, ftol=None, gtol=None).x)


@pytest.mark.parametrize("name", [*machine_names(), "pivoting"])
def test_it_rests_where_the_energy_is_least(name: str, tmp_path: Path) -> None:
    """For uneven struts, a mass off the middle and tilted gravity both agree to 1 nm and 10 nrad, the rounding."""
    if name == "pivoting":
        geometry = three_two_one_machine()
    else:
        geometry = load_geometry(machines()[name].write(tmp_path / "machine.yaml"))
    geometry = replace(geometry, screw_lead=np.zeros(6))  # turning screws are another block
    stiffness = 1e6 * np.array([15.0, 18.0, 20.0, 25.0, 30.0, 60.0])
    size = geometry.characteristic_length
    centre, gravity = size * np.array([0.1, -0.2, 0.3]), np.array([2.0, -1.0, -9.0])
    machine = loaded(geometry, Loading.of(gravity), stiffness=stiffness, centre=centre)
    turned = Rotation.from_rotvec([0.02, 0.03, -0.04]).as_matrix() @ geometry.home.rotation
    commands, _, _ = machine.commands_for(Pose(geometry.home.position, turned))
    actual, _ = machine.pose_for(commands)
    assert_same_pose(actual, Pose(geometry.home.position, turned))
    rest = lowest_energy(geometry, commands, stiffness, 30.0, centre, gravity, geometry.home)
    assert_same_pose(actual, rest, 1e-9, 1e-8)
    assert np.abs(commands - distances(geometry, actual)).max() > 1e-6, "and it bends by more than a µm"


def test_a_hanging_machine_is_commanded_shorter() -> None:
    """Turned upside down, the paper's machine has struts that pull, with the same forces."""
    standing = paper_geometry()
    over = np.diag([1.0, -1.0, -1.0])
    hanging = replace(
        standing, base_joints=standing.base_joints @ over, platform_joints=standing.platform_joints @ over,
        home=Pose(over @ standing.home.position, np.eye(3)), base_cone_axes=None, platform_cone_axes=None,
    )  # fmt: skip
    pushed, pulled = (loaded(g).commands_for(g.home)[0] - distances(g, g.home) for g in (standing, hanging))
    assert (pushed > 1e-6).all()
    np.testing.assert_allclose(pulled, -pushed, rtol=1e-9)
    # Lost motion: a pushing strut is shorter by half of it, so its command is longer, and conversely.
    for geometry, sign in ((standing, 1.0), (hanging, -1.0)):
        with_play = loaded(geometry, lost_motion=4e-6 * np.arange(1.0, 7.0)).commands_for(geometry.home)[0]
        added = with_play - loaded(geometry).commands_for(geometry.home)[0]
        np.testing.assert_allclose(added, sign * 2e-6 * np.arange(1.0, 7.0), rtol=1e-9)


@fixed
@given(seeds)
def test_forwards_undoes_backwards(seed: int) -> None:
    """With all terms, uneven temperatures, any gravity and a wrench, forwards undoes backwards to 1e-13 m and 1e-12
    rad.

    Without compensation the pose would be missed by at least 10 µm.
    """
    rng = np.random.default_rng(seed)
    geometry = skewed_geometry(lead=0.01 * float(rng.integers(2)))
    geometry = replace(geometry, payloads={"tool": Payload(rng.uniform(0.0, 20.0), tuple(rng.uniform(-0.1, 0.1, 3)))})
    load = Load(
        stiffness=rng.uniform(5e6, 100e6, 6), lost_motion=rng.uniform(0.0, 10e-6, 6), mass=rng.uniform(0.0, 50.0),
        centre=rng.uniform(-0.1, 0.1, 3), friction=rng.uniform(0.0, 2.0, 6),
    )  # fmt: skip
    down = rng.normal(size=3)
    loading = Loading.of(G * down / np.linalg.norm(down), rng.uniform(-100.0, 100.0, 6))
    machine = RealMachine(geometry, replace(random_model(rng, "skewed"), load=load), Temperatures(WARM), loading)
    target = random_pose(rng, geometry.home)
    motion = moving(machine, target)
    commands, model_pose, _ = machine.commands_for(target, motion)
    assert motion.sense.all()
    actual, again = machine.pose_for(commands, motion.sense, geometry.home)
    assert_same_pose(actual, target)
    assert_same_pose(again, model_pose)
    missed = nominal_error(machine, target, motion.sense)
    assert np.linalg.norm(missed.position - target.position) > 1e-5


def test_a_tool_weighs_like_a_wrench_in_its_centre() -> None:
    """8 kg at a point of a level platform act as a force and a torque about its origin."""
    geometry, centre = skewed_geometry(), np.array([0.03, -0.02, 0.12])
    weight = np.array([0.0, 0.0, -8.0 * G])
    level = Pose(geometry.home.position, np.eye(3))
    wrench = [*weight, *np.cross(centre, weight)]
    by_wrench = loaded(geometry, Loading.of(None, wrench)).commands_for(level)[0]
    with_tool = replace(geometry, payloads={"tool": Payload(8.0, tuple(centre))})
    np.testing.assert_allclose(loaded(with_tool).commands_for(level)[0], by_wrench, rtol=0.0, atol=1e-15)
    heavier = loaded(geometry, mass=38.0, centre=8.0 * centre / 38.0).commands_for(level)[0]
    np.testing.assert_allclose(heavier, by_wrench, rtol=0.0, atol=1e-15)


# ---- the compensator ----


def settled(compensator: Compensator, start: float = 0.0) -> np.ndarray:
    """Command home until the ramp has ended; check that no command steps by more than the ramp; return the commands."""
    home, last = compensator.geometry.tool_pose(compensator.geometry.home), compensator.command.copy()
    for n in range(1, 400):
        compensator.correct(home, start + 0.02 * n)
        if np.isfinite(last).all():
            assert np.abs(compensator.command - last).max() <= 20e-6 * (1.0 + 1e-9)
        last = compensator.command.copy()
    assert not compensator.ramping
    return last


def test_what_acts_ramps_in_and_no_direction_turns() -> None:
    """A change of gravity, force or tool ramps in at 1 mm/s, and ends at the commands of a machine with this load."""
    geometry = replace(skewed_geometry(), tools={"heavy": Pose.identity()}, payloads={"heavy": Payload(20.0)})
    model = MachineModel("skewed", load=Load(stiffness=np.full(6, 1e6), mass=30.0), reversal_threshold=1e-7)
    compensator = Compensator(geometry, model)
    settled(compensator)
    sense, seen = compensator.motion.sense.copy(), []
    compensator.on_change = lambda what, value: seen.append((what, value))
    tilted = Loading.of([0.0, G * 0.8, -G * 0.6], [50.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    compensator.set_load(tilted)
    assert compensator.ramping
    np.testing.assert_array_equal(settled(compensator, 10.0), loaded_commands(geometry, model, tilted))
    compensator.set_tool("heavy")
    np.testing.assert_array_equal(settled(compensator, 20.0), loaded_commands(geometry.using("heavy"), model, tilted))
    np.testing.assert_array_equal(compensator.motion.sense, sense)
    compensator.set_load(tilted)  # the same load is no change
    assert seen == [("load", tilted.numbers()), ("tool", "heavy")]
    with pytest.raises(ModelError, match=r"gravity: must be three numbers of magnitude 9…10.6 m/s²"):
        compensator.set_load(Loading((0.0, 0.0, 1e3)))
    assert compensator.loading == tilted
    other = Compensator(geometry, model)
    other.restore(compensator.snapshot())
    assert str(other.snapshot()) == str(compensator.snapshot())
    assert other.loading == tilted
    compensator.set_load(Loading())
    np.testing.assert_array_equal(
        settled(compensator, 30.0), loaded_commands(geometry.using("heavy"), model, Loading())
    )


def loaded_commands(geometry: HexapodGeometry, model: MachineModel, loading: Loading) -> np.ndarray:
    return RealMachine(geometry, model, loading=loading).commands_for(geometry.home)[0]


# ---- files ----


def test_a_load_that_no_machine_has_is_refused() -> None:
    for change, problem in (
        ({"stiffness": np.full(6, 20.0)}, r"load.stiffness: must be 0, which means rigid, or at least 0.1 N/µm"),
        ({"stiffness": -SOFT}, "load.stiffness: must not be negative"),
        ({"mass": np.nan}, "load.mass: must be finite"),
        ({"take_up": 0.0}, "load.take_up: must be ≥ 0.001 N"),
    ):
        with pytest.raises(ModelError, match=problem):
            Load(**change)
    with pytest.raises(ModelError, match="load: must be 26 numbers"):
        Load.from_numbers([0.0] * 25)


def test_a_load_beyond_the_measured_ones_is_named() -> None:
    """Measured: 2 and 10 kg, gravity down and 20° from it. Allowed: 0.5 kg (5 % of 10 kg), 5° and half of 20°."""
    angles = np.radians([[0.0], [20.0]])
    down = G * np.hstack([np.sin(angles), 0.0 * angles, -np.cos(angles)])
    loads = [(mass, 0.0, 0.0, 0.0, *direction) for mass, direction in zip((2.0, 10.0), down.tolist(), strict=True)]
    for mass, tilt, problem in (
        (1.51, -14.9, ""),
        (10.49, 34.9, ""),
        (1.49, 0.0, "the tool weighs 1.49 kg, but the model was measured with tools of 2…10 kg"),
        (10.51, 0.0, "the tool weighs 10.51 kg, but the model was measured with tools of 2…10 kg"),
        (2.0, 36.0, "gravity is 16° from the nearest measured direction, allowed at most 15°"),
    ):
        gravity = G * np.array([np.sin(np.radians(tilt)), 0.0, -np.cos(np.radians(tilt))])
        assert beyond_loads(loads, Payload(mass), gravity) == problem
    upside_down = "gravity is 180° from the nearest measured direction, allowed at most 5°"
    heavy = "the tool weighs 21.5 kg, but the model was measured with tools of 20 kg"
    assert beyond_loads([(20.0, 0, 0, 0, 0, 0, -G)], Payload(21.5), [0.0, 0.0, G]) == f"{heavy}; {upside_down}"
    assert beyond_loads([(20.0, 0, 0, 0, 0, 0, -G)], Payload(20.9), [0.0, 0.0, -G]) == ""
    assert beyond_loads([], Payload(99.0), [0.0, 0.0, G]) == ""


def test_tools_have_mass_and_centre(tmp_path: Path) -> None:
    """The geometry file has masses and centres of tools with units; a mass without its centre is refused."""
    text = (
        machines()["paper"].write(tmp_path / "machine.yaml").read_text()
        + "tools:\n  heavy: {position_mm: [0, 0, 50], mass_kg: 12, centre_mm: [1, 2, 30]}\n"
        + "  light: {position_mm: [0, 0, 9]}\n"
    )
    (tmp_path / "tools.yaml").write_text(text)
    geometry = load_geometry(tmp_path / "tools.yaml")
    assert geometry.using("heavy").payload == Payload(12.0, (0.001, 0.002, 0.03))
    assert geometry.using("light").payload == geometry.payload == Payload(0.0, (0.0, 0.0, 0.0))
    (tmp_path / "wrong.yaml").write_text(text.replace(", centre_mm: [1, 2, 30]", ""))
    with pytest.raises(InputFileError, match=r"tools.heavy.centre: is missing"):
        load_geometry(tmp_path / "wrong.yaml")
    (tmp_path / "wrong.yaml").write_text(text.replace("mass_kg: 12", "mass_kg: -12"))
    with pytest.raises(InputFileError, match=r"tools.heavy.mass_kg: must be 0…100000 kg \(found -12\)"):
        load_geometry(tmp_path / "wrong.yaml")


SIX = np.tile([0.0, 0.0, 0.4], (2, 1))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Payload(1.0, (0.0, 0.0)), "centre: must be three finite numbers, m"),
        (lambda: Payload(1.0, (0.0, math.nan, 0.0)), "centre: must be three finite numbers, m"),
        (lambda: Loading.from_numbers([0.0] * 8), "loading: must be nine numbers: gravity, force and torque"),
        (lambda: Datum((0.0, math.inf, 0.0), (0.0,) * 3, 6), "datum.position: must be three finite numbers, m or rad"),
        (lambda: Datum((0.0,) * 3, (0.0,) * 2, 6), "datum.angles: must be three finite numbers, m or rad"),
        (lambda: Datum((0.0,) * 3, (0.0,) * 3, 7), "datum.held: must be a whole number, 0…6 (found 7)"),
        (lambda: Datum((0.0,) * 3, (0.0,) * 3, -1), "datum.held: must be a whole number, 0…6"),
        (lambda: LateGrowth((60.0,), np.zeros((8, 2))), "thermal.late: must give each part one finite value, 1/K, for"),
        (lambda: OutsideTable(("a", "a"), ("deg", "deg"), ([0, 1],) * 2), "outside.axes: must be one or two, each"),
        (lambda: OutsideTable(("a",), ("furlong",), ([0, 1],)), "outside.a: must be in one of"),
        (lambda: OutsideTable(beyond="guess"), "outside.beyond: must be one of hold, refuse"),
        (lambda: solve_poses(Structure.of(paper()), np.ones((2, 5)), paper().home), "have shape (N, 6), not (2, 5)"),
        (lambda: solve_poses(Structure.of(paper()), np.ones((2, 6)), (SIX, np.eye(3))), "guesses must have shapes (2,"),
        (lambda: strut_lengths_batch(Structure.of(paper()), SIX[:, :2], np.eye(3)), "must have shapes (N, 3)"),
        (
            lambda: ToolErrors(SIX, SIX, SIX, SIX[:, 0]).aligned(),
            "points: must be three or more, not in a line, for a best-fit",
        ),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], said: str) -> None:
    with pytest.raises(HexapodError, match=re.escape(said)):
        make()


def test_one_rotation_serves_for_all_poses_of_a_batch() -> None:
    of_each = strut_lengths_batch(Structure.of(paper()), SIX, np.tile(np.eye(3), (2, 1, 1)))
    np.testing.assert_array_equal(strut_lengths_batch(Structure.of(paper()), SIX, np.eye(3)), of_each)


def test_a_wrench_in_the_tools_frame_acts_at_the_tools_tip() -> None:
    """10 N at a tip 0.1 m out, 0.2 m up; the tool is turned by 90° about z, so its x is the platform's y."""
    tool = Pose.from_angles([0.1, 0.0, 0.2], [0.0, 0.0, np.pi / 2.0])
    geometry = replace(paper(), tool=tool)
    force, torque = np.array([10.0, 0.0, 0.0]), np.array([0.0, 0.0, 3.0])
    wanted = [0.0, 10.0, 0.0, -2.0, 0.0, 1.0 + 3.0]
    assert wrench_on_platform(geometry, "tool", force, torque) == pytest.approx(wanted, abs=1e-12)
    assert wrench_on_platform(geometry, "platform", force, torque) == (10.0, 0.0, 0.0, 0.0, 0.0, 3.0)
    with pytest.raises(FrameError, match=r"frame_id must be platform or tool, not .base."):
        wrench_on_platform(geometry, "base", force, torque)
