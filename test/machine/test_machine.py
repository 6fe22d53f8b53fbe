"""The machine model run both ways, its temperatures, and the directions of motion that it follows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import nominal_error
from hypothesis import given
from hypothesis import strategies as st
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

from hexapod_comp.core.batch import follow_nine
from hexapod_comp.errors import ModelError, NotConvergedError, NotFiniteError, UnreachableError
from hexapod_comp.machine.field import GridField
from hexapod_comp.machine.kinematics import Structure, solve_pose
from hexapod_comp.machine.model import MachineModel, MotionState, RealMachine
from hexapod_comp.machine.struts import StrutErrors
from hexapod_comp.machine.temperatures import Temperatures
from hexapod_comp.pose import Pose

WARM = {"strut_1": 24.0, "strut_4": 18.5, "base": 21.0, "platform": 27.0}
GEOMETRIES = {"paper": paper_geometry(), "skewed": skewed_geometry(), "with lead": skewed_geometry(lead=0.01)}


def assert_same_pose(found, truth, position=1e-13, angle=1e-12):
    """Compare within the issue's bar: 1e-13 m and 1e-12 rad."""
    assert np.abs(found.position - truth.position).max() <= position
    turn = Rotation.from_matrix(found.rotation @ truth.rotation.T)
    assert turn.magnitude() <= angle


def distances(base, platform, pose):
    """Return the six distances between joints, by NumPy alone."""
    return np.linalg.norm(pose.position + platform @ pose.rotation.T - base, axis=1)


def shifted(pose, *by):
    return Pose(pose.position + np.array(by), pose.rotation)


def moving(machine, pose):
    """Return a motion state in which all nine values have a direction, some forward and some backward."""
    motion = MotionState()
    machine.commands_for(shifted(pose, 1e-3, -1e-3, 1e-3), motion)
    return motion


# Forwards and backwards.


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("temperatures", [{}, WARM], ids=["20 °C", "warm"])
def test_forwards_undoes_backwards(name, temperatures):
    """Truth: closure, over 20 random models with every block on and tilted poses within ±50 mm and 15°."""
    geometry = GEOMETRIES[name]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        model = random_model(rng, geometry.name)
        machine = RealMachine(geometry, model, Temperatures(temperatures))
        target = random_pose(rng, geometry.home)
        motion = moving(machine, target)
        commands, model_pose, _ = machine.commands_for(target, motion)
        assert motion.sense.all()
        actual, again = machine.pose_for(commands, motion.sense, geometry.home)
        assert_same_pose(actual, target)
        assert_same_pose(again, model_pose)
        # The model is no small matter: uncompensated, the same pose is missed by 10 µm at the least.
        missed = nominal_error(machine, target, motion.sense)
        assert np.linalg.norm(missed.position - target.position) > 1e-5


@fixed
@given(seeds)
def test_model_pose_times_its_error_is_the_target(seed):
    """Truth: q ∘ E(q) = p (DESIGN), put together here from the field's value with SciPy's rotations.

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
    """Truth: the distance to the joint where it really is; the other five struts stay as they were."""
    geometry = GEOMETRIES["skewed"]
    deviation = np.zeros((6, 3))
    deviation[2] = [120e-6, -80e-6, 50e-6]
    machine = RealMachine(geometry, MachineModel("skewed", **{f"{body}_deviation": deviation}))
    joints = {"base": geometry.base_joints, "platform": geometry.platform_joints}
    joints[body] = joints[body] + deviation
    for seed in range(10):
        pose = random_pose(np.random.default_rng(seed), geometry.home)
        commands, _, _ = machine.commands_for(pose, MotionState())
        nominal = distances(geometry.base_joints, geometry.platform_joints, pose)
        np.testing.assert_allclose(commands, distances(joints["base"], joints["platform"], pose), atol=2e-16)
        np.testing.assert_array_equal(np.abs(commands - nominal) > 1e-9, np.arange(6) == 2)


def test_backlash_follows_each_struts_own_direction():
    """Truth: half the play is added going out and taken off coming back; none before anything has moved."""
    geometry, play = GEOMETRIES["paper"], 40e-6
    machine = RealMachine(geometry, MachineModel("paper", struts=StrutErrors(backlash=np.full(6, play))))
    motion = MotionState()
    home = geometry.home
    nominal = distances(geometry.base_joints, geometry.platform_joints, home)
    np.testing.assert_allclose(machine.commands_for(home, motion)[0], nominal, atol=2e-16)
    up = shifted(home, 0.0, 0.0, 1e-3)
    lengths_up = distances(geometry.base_joints, geometry.platform_joints, up)
    np.testing.assert_allclose(machine.commands_for(up, motion)[0], lengths_up + play / 2, atol=2e-16)
    np.testing.assert_allclose(machine.commands_for(home, motion)[0], nominal - play / 2, atol=2e-16)


def test_a_field_too_steep_to_undo_is_refused():
    """Truth: a field of slope 2.5 sends the fixed point from one side of the box to the other for ever."""
    lines = [np.zeros((2, 4 if a == 0 else 3, 3, 6, 2)) for a in (1, 0, 0)]
    lines[0][:, :, :, 0, 1] = 0.5
    model = MachineModel("paper", field=GridField(UNEVEN_GRID, tuple(lines)))
    with pytest.raises(NotConvergedError, match="steep"):
        RealMachine(GEOMETRIES["paper"], model).commands_for(Pose([0.01, 0.0, 0.4], np.eye(3)), MotionState())


@pytest.mark.parametrize(
    ("commands", "error"),
    [
        ([0.5, 0.5, 0.5, 0.5, 0.5, math.nan], NotFiniteError),
        ([0.5, 0.5, 0.5, 0.5, 0.5, -0.5], NotFiniteError),
        ([0.5, 0.5, 0.5, 0.5, 0.5, 5.0], UnreachableError),
    ],
)
def test_bad_strut_readings_are_refused(commands, error):
    machine = RealMachine(GEOMETRIES["with lead"], MachineModel("skewed"))
    with pytest.raises(error):
        machine.pose_for(commands, np.zeros(9), GEOMETRIES["with lead"].home)


# Temperatures.


@fixed
@given(seeds, st.floats(-20.0, 60.0))
def test_uniform_growth_scales_the_machine(seed, temperature):
    """Truth: similar triangles. When base, platform and struts all grow by 1 + g, so does the position of
    the platform, and it turns by nothing. Offsets and deviations belong to the parts and grow with them.
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


@pytest.mark.parametrize("body", ["base", "platform"])
def test_growth_of_one_body_moves_its_joints_about_its_origin(body):
    """Truth: forward kinematics of a structure whose joints are moved by hand: 20 K · 12 ppm/K = 2.4e-4."""
    geometry = GEOMETRIES["skewed"]
    model = MachineModel("skewed", **{f"{body}_expansion": 12e-6})
    machine = RealMachine(geometry, model, Temperatures({body: 40.0}))
    lengths = distances(geometry.base_joints, geometry.platform_joints, geometry.home)
    found, _ = machine.pose_for(lengths, np.zeros(9), geometry.home)
    grown = {"base": geometry.base_joints, "platform": geometry.platform_joints}
    moved = {name: 2.4e-4 * joints if name == body else 0.0 * joints for name, joints in grown.items()}
    structure = Structure.of(geometry).moved(moved["base"], moved["platform"])
    assert_same_pose(found, solve_pose(structure, lengths, geometry.home))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("strut_7", 20.0, "strut_1.*platform.*strut_7"),
        ("base", math.nan, "base.*-40…120.*nan"),
        ("strut_2", math.inf, "strut_2.*inf"),
        ("platform", 293.15, "platform.*120.*293.15"),  # somebody sends kelvin
    ],
)
def test_bad_temperatures_are_refused(name, value, message):
    temperatures = Temperatures()
    with pytest.raises(ModelError, match=message):
        temperatures.set(name, value)
    assert not temperatures.values


# What no model can be.


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
    """Take one of the nine values, and none of the others; return its direction."""
    values = np.full(9, np.nan)
    values[index] = value
    follow_nine(values, threshold, threshold, low, sense)
    return sense[index]


FAR = 0.5 + 1e-3


@pytest.mark.parametrize(
    ("threshold", "values", "senses"),
    [
        # From the farthest point 1.9 µm back is noise, 2.1 µm back a reversal; the way back again counts as far
        pytest.param(THRESHOLD, [0.5, FAR, FAR - 1.9e-6, FAR - 2.1e-6, FAR - 0.3e-6, FAR], [0, 1, 1, -1, -1, 1]),
        # Steps far below the threshold add up; after more than half of it the direction is known
        pytest.param(THRESHOLD, [0.5 + 0.3e-6 * step for step in range(6)], [0, 0, 0, 0, 1, 1], id="creeping"),
        pytest.param(0.0, [0.5, 0.6, 0.6, 0.59, 0.59, 0.7], [0, 1, 1, -1, -1, 1], id="no threshold"),
        pytest.param(THRESHOLD, [math.nan, 0.5, 0.6, math.nan, 0.6 - 1e-6, 0.6 - 3e-6], [0, 0, 1, 1, 1, -1], id="NaN"),
    ],
)
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_direction_turns_at_the_threshold(threshold, values, senses, way):
    """Truth: the definition."""
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
