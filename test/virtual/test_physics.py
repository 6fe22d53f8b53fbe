"""A machine with physics behind its struts.

The truth is closed forms of statics (six forces balance a weight, a spring yields by force over stiffness), forward
kinematics of the resulting lengths, and MuJoCo's steps in time.
"""

from __future__ import annotations

import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from foreign_machines import machine_names, machines
from helpers import assert_equal
from scipy.spatial.transform import Rotation

from hexapod_comp.errors import HexapodError, ModelError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import solve_pose, strut_lengths
from hexapod_comp.machine.load import Load, Payload
from hexapod_comp.machine.model import MachineModel, RealMachine
from hexapod_comp.machine.model_file import load_model
from hexapod_comp.machine.robot_description import foot_frames
from hexapod_comp.machine.temperatures import Temperatures
from hexapod_comp.pose import Pose
from hexapod_comp.virtual.imperfections import ImperfectionBounds, draw_model
from hexapod_comp.virtual.physics import PhysicalMachine, Physics, find_mujoco

SPINDLE = Payload(10.0, (0.02, -0.03, 0.08))
MACHINES = dict.fromkeys([*machine_names(), "unit"])  # "unit" has short struts


@pytest.fixture(autouse=True)
def mujoco() -> ModuleType:
    pytest.importorskip("mujoco", reason="no mujoco-core (make test: from Python 3.11 on)")
    return find_mujoco()


def geometry_of(name: str, folder: Path) -> HexapodGeometry:
    return load_geometry(machines()[name].write(folder / "machine.yaml"))


def poses_about_home(geometry: HexapodGeometry, count: int = 4) -> list[Pose]:
    rng, home = np.random.default_rng(5), geometry.home
    far = 0.2 * np.abs(geometry.limits.stroke - strut_lengths(geometry, home)[:, None]).min()
    turns = Rotation.from_rotvec(rng.uniform(-far, far, (count, 3))).as_matrix()
    return [Pose(home.position + rng.uniform(-far, far, 3), turn @ home.rotation) for turn in turns]


def off(pose: Pose, other: Pose) -> tuple[float, float]:
    """Return distance, m, and angle, rad, of two poses."""
    turn = Rotation.from_matrix(pose.rotation @ other.rotation.T).magnitude()
    return float(np.linalg.norm(pose.position - other.position)), float(turn)


@pytest.mark.parametrize("name", MACHINES)
def test_rigid_struts_leave_the_machine_where_its_kinematics_have_it(name: str, tmp_path: Path):
    """The true model has a field as well; with 1e13 N/m, 400 kg yield less than a nanometre."""
    geometry = geometry_of(name, tmp_path)
    bounds = ImperfectionBounds(1e-4, 1e-4, pitch=5e-5, field_displacement=1e-5, field_rotation=1e-5,
                                field_box=geometry.home.position + np.outer([-0.1, 0.1], np.ones(3)))  # fmt: skip
    real = RealMachine(geometry, draw_model(geometry, bounds, 4))
    machine = PhysicalMachine(real, Physics(1e13, payload=SPINDLE, strut_mass=1.0))
    for pose in poses_about_home(geometry):
        commands = strut_lengths(geometry, pose)
        place, turn = off(machine.pose_for(commands)[0], real.pose_for(commands)[0])
        assert place < 1e-9
        assert turn < 1e-8


BENT: dict[str, dict[str, Any]] = {
    "soft joints": {"joint_stiffness": 60e6},
    "clearance": {"clearance": [0.0, 2e-6, 4e-6, 6e-6, 8e-6, 1e-5]},
    "tilted": {"base_tilt": (0.5, -0.3), "clearance": 5e-6},
    "sideways": {"gravity": (3.0, 9.3, 1.0), "clearance": 5e-6, "centre": (0.01, 0.02, 0.03)},
    "six stiffnesses": {"strut_stiffness": [2e7, 3e7, 4e7, 5e7, 6e7, 7e7]},
    "a warm strut": {"warmth": [0.0, 0.0, 3.0, 0.0, 0.0, 0.0]},
}


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("given", BENT.values(), ids=BENT)
def test_it_rests_where_forces_balance(name: str, given: dict[str, Any], tmp_path: Path):
    """f = J⁻ᵀ·(weight) at the pose found. Each strut is longer by f/k, by half its clearance with the sign of f, and by
    11.5 ppm/K; from these lengths the package's forward kinematics must find the same pose."""
    geometry = geometry_of(name, tmp_path)
    real = RealMachine(geometry, draw_model(geometry, ImperfectionBounds(1e-4, 1e-4), 4))
    physics = Physics(**given, payload=SPINDLE)
    machine = PhysicalMachine(real, physics)
    about_x, about_y = given.get("base_tilt", (0.0, 0.0))
    gravity = Rotation.from_euler("YX", [about_y, about_x]).inv().apply(given.get("gravity", (0.0, 0.0, -9.80665)))
    stiffness = 1.0 / (
        1.0 / np.broadcast_to(given.get("strut_stiffness", 20e6), 6) + 2.0 / given.get("joint_stiffness", np.inf)
    )
    for pose in poses_about_home(geometry):
        commands = strut_lengths(geometry, pose)
        settled, free = machine.pose_for(commands)[0], strut_lengths(real.structure, real.pose_for(commands)[0])
        ends = real.structure.platform_joints @ settled.rotation.T
        along = settled.position + ends - real.structure.base_joints
        along /= np.linalg.norm(along, axis=1)[:, None]
        arms = [settled.rotation @ given.get("centre", (0.0, 0.0, 0.0)), settled.rotation @ SPINDLE.centre]
        weight = np.concatenate([30.0 * gravity, np.cross(arms[0], 20.0 * gravity) + np.cross(arms[1], 10.0 * gravity)])
        forces = np.linalg.solve(np.hstack([along, np.cross(ends, along)]).T, -weight)  # pull up
        pulled = -forces
        lengths = free * (1.0 + 11.5e-6 * np.array(given.get("warmth", 0.0))) + pulled / stiffness
        lengths += 0.5 * np.array(given.get("clearance", 0.0)) * np.sign(pulled)
        place, turn = off(solve_pose(real.structure, lengths, settled), settled)
        assert place < 1e-11
        assert turn < 1e-11


@pytest.mark.parametrize("name", MACHINES)
def test_it_rests_where_one_strut_has_no_force(name: str, tmp_path: Path):
    """A payload far out leaves strut 1 without force, in the middle of its clearance.

    Only the change of the other forces by the motion, 10⁵ times weaker than a spring, holds it there or topples it to
    an end. At rest the springs, with their clearances, balance the weight."""
    geometry = geometry_of(name, tmp_path)
    commands, pose, clearance = strut_lengths(geometry, geometry.home), geometry.home, 40e-6
    up, outward = np.array([0.0, 0.0, 9.80665]), np.array([1.0, 0.0, 0.0])

    def statics(pose: Pose, x: float) -> tuple[np.ndarray, np.ndarray]:
        ends = geometry.platform_joints @ pose.rotation.T
        along = pose.position + ends - geometry.base_joints
        along /= np.linalg.norm(along, axis=1)[:, None]
        weight = np.concatenate([30.0 * up, np.cross(pose.rotation @ (x * outward), 10.0 * up)])
        return np.hstack([along, np.cross(ends, along)]).T, weight

    for _ in range(5):
        middle, out = (np.linalg.solve(*statics(pose, x)) for x in (0.0, 1.0))
        x = middle[0] / (middle[0] - out[0])
        forces = middle + x * (out - middle)
        pose = solve_pose(geometry, commands - 0.5 * clearance * np.sign(forces.round(6)) - forces / 20e6, pose)
    physics = Physics(clearance=clearance, payload=Payload(10.0, x * outward))
    settled, _ = PhysicalMachine(RealMachine(geometry, MachineModel(geometry.name)), physics).pose_for(commands)
    slack = commands - strut_lengths(geometry, settled)
    arms, weight = statics(settled, x)
    carried = arms @ (20e6 * (slack - np.clip(slack, -0.5 * clearance, 0.5 * clearance)))
    assert carried == pytest.approx(weight, abs=1e-5)  # N; 1e-13 m of six springs


MOVED: dict[str, tuple[dict[str, Any], float]] = {
    "weight": ({}, 2e-8),
    "heavy struts, tilted": ({"strut_mass": 4.0, "base_tilt": (0.5, 0.2)}, 2e-9),
    "clearance": ({"clearance": 6e-6, "gravity": (0.0, 9.8, -1.0), "strut_mass": 1.0}, 2e-8),
    "friction": ({"friction": 3.0, "strut_mass": 1.0}, 6e-8),
}


@pytest.mark.parametrize(("given", "allowed"), MOVED.values(), ids=MOVED)
def test_mujoco_s_steps_end_where_the_forces_balance(given: dict[str, Any], allowed: float):
    """The truth is MuJoCo's motion in time. Its constraints yield by some nm, most with struts without mass; of a
    friction that moves the tool by 2 µm a fiftieth springs back when a strut stops."""
    geometry = load_geometry("paper")
    real = RealMachine(geometry, draw_model(geometry, ImperfectionBounds(1e-4, 1e-4), 3))
    machine = PhysicalMachine(real, Physics(**given, payload=SPINDLE, damping=0.5))
    for goal in poses_about_home(geometry, 1):
        way, sense = np.array([1.0, -1.0, 1.0]), np.zeros(9)
        sense[:3] = way
        rows = goal.position.copy(), goal.rotation.copy(), goal.position.copy(), goal.rotation.copy()
        for short, seconds in ((2e-4, 0.1), (2e-5, 0.1), (0.0, 0.4), (0.0, 0.1)):
            commands = strut_lengths(geometry, Pose(goal.position - short * way, goal.rotation))
            machine.advance(seconds, commands, sense, rows[:2], rows[2:])
        at_rest, _ = machine.pose_for(commands, sense, goal)
        place, turn = off(Pose(rows[2], rows[3]), at_rest)
        assert place < allowed
        assert turn < 5.0 * allowed


@pytest.mark.parametrize("name", MACHINES)
def test_the_model_s_friction_is_that_of_cardan_joints(name: str, tmp_path: Path):
    """MuJoCo's bearings about the axes in the geometry, against the core; both with clearance and weight.

    Tolerance: 2 % of 2 µm, since bearings that turn by less than 5 µrad on the last 0.2 mm resist in part. Without axes
    a joint counts as a ball joint, which resists along the motion: a third may differ.
    """
    plain = replace(geometry_of(name, tmp_path), screw_lead=np.zeros(6), base_axes=None, platform_axes=None)
    axes = foot_frames(plain) @ np.array([0.2, 1.0, 0.3])  # neither across the strut nor MuJoCo's own choice
    cardan = replace(plain, base_axes=axes / np.linalg.norm(axes, axis=1)[:, None])
    bending = {"mass": 30.0, "lost_motion": np.full(6, 4e-6), "stiffness": np.full(6, 2e7), "take_up": 1e-3}
    physics = Physics(2e7, clearance=4e-6, friction=1.0, mass=30.0, payload=Payload())
    truth = PhysicalMachine(RealMachine(cardan, MachineModel(plain.name)), physics)
    differences = []
    for geometry, friction in ((cardan, 1.0), (plain, 1.27), (plain, 0.0)):
        model = MachineModel(plain.name, load=Load(**bending, friction=np.full(6, friction)))
        machine, left = RealMachine(geometry, model), []
        for pose, way in zip(
            poses_about_home(plain), np.sign(np.random.default_rng(2).normal(size=(4, 3))), strict=True
        ):
            commands, sense = strut_lengths(plain, pose), np.array([*way, *np.zeros(6)])
            left.append(off(truth.pose_for(commands, sense, pose)[0], machine.pose_for(commands, sense, pose)[0])[0])
        differences.append(max(left))
    exact, ball, none = differences
    assert exact < 4e-8
    assert exact < ball < 0.5 * none


def test_the_simulated_machine_has_the_masses_inertias_and_damping_that_are_stated():
    """By the textbook: a disc of the joints' RMS radius and a sphere of 20 mm, moved to their common centre of mass;
    struts in two halves, as slender rods; damping as a share of 2·√(k·m) of a sixth of the mass on each strut."""
    geometry, disc, ball = load_geometry("paper"), np.array([0.01, 0.0, 0.02]), np.array([0.0, 0.03, 0.1])
    physics = Physics(3e7, strut_mass=3.0, mass=12.0, centre=disc, payload=Payload(8.0, ball), damping=0.2)
    model = PhysicalMachine(RealMachine(geometry, MachineModel("paper")), physics)._mj
    body, middle, radius = model.body("platform"), (12.0 * disc + 8.0 * ball) / 20.0, geometry.characteristic_length
    flat = 12.0 * (radius**2 / 4.0 + 0.02**2 / 12.0)
    wanted = np.diag([flat, flat, 6.0 * radius**2]) + 0.4 * 8.0 * 0.02**2 * np.eye(3)
    for mass, arm in ((12.0, disc - middle), (8.0, ball - middle)):
        wanted += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    turn = Rotation.from_quat(np.roll(body.iquat, -1)).as_matrix()
    np.testing.assert_allclose(turn @ np.diag(body.inertia) @ turn.T, wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose([body.mass[0], *body.ipos], [20.0, *middle], rtol=1e-12, atol=1e-12)
    length = strut_lengths(geometry, geometry.home)[0]
    for name, height in (("strut_1_body", 0.25 * length), ("strut_1_rod", -0.25 * length)):
        half = model.body(name)
        assert (half.mass[0], half.ipos[2]) == pytest.approx((1.5, height))
        assert sorted(half.inertia) == pytest.approx(1.5 * (0.5 * length) ** 2 / 12.0 * np.array([0.01, 1.0, 1.0]))
    assert not np.concatenate([model.actuator_ctrllimited, model.actuator_forcelimited, model.jnt_limited]).any()
    slide = model.joint("strut_1").dofadr[0]
    assert model.dof_damping[slide] == pytest.approx(0.2 * 2.0 * np.sqrt(3e7 * 20.0 / 6.0))
    assert model.opt.timestep == pytest.approx(0.25 / np.sqrt(6.0 * 3e7 / 12.0)), "0.25 rad of the fastest oscillation"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"strut_stiffness": 0.999e5},
            "strut_stiffness: must be one number or six, each 100000…inf N/m (found 99900.0",
        ),
        ({"joint_stiffness": 0.999e5}, "joint_stiffness: must be one number or six, each 100000…inf N/m"),
        ({"clearance": 1.01e-3}, "clearance: must be one number or six, each 0…0.001 m"),
        ({"friction": [0.0] * 5}, "friction: must be one number or six, each 0…1000 N m (found [0"),
        ({"friction": 1001.0}, "friction: must be one number or six"),
        ({"warmth": [0.0] * 5 + [101.0]}, "warmth: must be one number or six, each -100…100 K"),
        ({"strut_stiffness": np.inf}, "strut_stiffness: must be finite if joint_stiffness is infinite"),
        ({"mass": 0.99e-3}, "mass: must be 0.001…100000 kg (found 0.00099)"),
        ({"strut_mass": 1.01e5}, "strut_mass: must be 0…100000 kg"),
        ({"damping": 10.1}, "damping: must be 0…10 of critical damping"),
        ({"gravity": (0.0, 9.8)}, "gravity: must be 3 numbers up to 100"),
        ({"centre": (0.0, -100.1, 0.0)}, "centre: must be 3 numbers up to 100"),
        ({"base_tilt": (0.0, 3.2)}, "base_tilt: must be 2 numbers up to 3.14159"),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, Any], said: str):
    with pytest.raises(ModelError, match=re.escape(f"physics.{said}")):
        Physics(**given)
    Physics(1e5, 1e5, 1e-3, 1e3, 1e5, 1e-3, (100.0, 0, 0), gravity=(0, 0, 100.0), base_tilt=(np.pi, 0), damping=10.0)
    Physics(np.inf, 1e5, warmth=[-100.0, 100.0] * 3, mass=1e5, damping=0.0)


def test_mujoco_s_warnings_are_logged_and_leave_no_file(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
):
    """For a body that is too fast, MuJoCo's own handler would write MUJOCO_LOG.TXT into the current folder."""
    monkeypatch.chdir(tmp_path)
    mujoco = find_mujoco()
    body = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(body)
    data = mujoco.MjData(model)
    data.qvel[:] = 1e30
    mujoco.mj_step(model, data)
    assert "QVEL" in caplog.text
    assert not list(tmp_path.iterdir())


def test_a_machine_with_physics_is_pickled_and_carries_other_payloads():
    """Gravity given in base replaces gravity in the room, so the base is not tilted a second time."""
    geometry = load_geometry("paper")
    machine = PhysicalMachine(RealMachine(geometry, MachineModel("paper")), Physics(base_tilt=(0.3, 0.0)))
    other = machine.at(Temperatures({"base": 25.0}), SPINDLE, [1.0, 2.0, -9.0])
    assert (other.physics.payload, other.mass, other.temperatures.at("base"), other.bends) == (
        SPINDLE,
        30.0,
        25.0,
        True,
    )
    np.testing.assert_allclose(other.physics.gravity_in_base, [1.0, 2.0, -9.0])
    for same in (machine.at(Temperatures()), pickle.loads(pickle.dumps(machine))):
        assert_equal(same.physics, machine.physics)
    soft = MachineModel("paper", load=Load(stiffness=np.full(6, 2e7)))
    with pytest.raises(ModelError, match="load: must not be in the model of a machine that MuJoCo deforms"):
        PhysicalMachine(RealMachine(geometry, soft))


def test_without_mujoco_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(HexapodError, match=r"pip install mujoco-core"):
        PhysicalMachine(RealMachine(load_geometry("paper"), load_model("paper_machine", load_geometry("paper"))))
