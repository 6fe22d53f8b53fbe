"""The load block: struts that give under weight, on machines that stand, hang, count in inches, and need pivoting.

The truth is a closed form where the machine is symmetric, and elsewhere the minimum of the energy of six springs and a
weight, which SciPy finds without knowing of forces.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foreign_machines import machine_names, machines
from helpers import three_two_one_machine
from hypothesis import given
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from strategies import fixed, paper_geometry, random_model, random_pose, seeds, skewed_geometry

from hexapod_comp.compensation.compensator import Compensator
from hexapod_comp.errors import InputFileError, ModelError
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.load import STANDARD_GRAVITY, Load, Loading, Payload
from hexapod_comp.machine.model import MachineModel, ModelOrigin, MotionState, RealMachine
from hexapod_comp.machine.model_file import model_text, parse_model
from hexapod_comp.pose import Pose

SOFT = np.full(6, 20e6)  # N/m
G = STANDARD_GRAVITY


def loaded(geometry: HexapodGeometry, loading: Loading | None = None, **load: object) -> RealMachine:
    block = Load(**{"stiffness": SOFT, "mass": 30.0, **load})  # type: ignore[arg-type]
    return RealMachine(geometry, MachineModel(geometry.name, load=block), loading=loading or Loading())


def nominal(geometry: HexapodGeometry, pose: Pose) -> np.ndarray:
    return np.linalg.norm(pose.position + geometry.platform_joints @ pose.rotation.T - geometry.base_joints, axis=1)


def lowest_energy(
    geometry: HexapodGeometry, lengths: np.ndarray, stiffness: np.ndarray, mass: float, centre: np.ndarray,
    gravity: np.ndarray, start: Pose,
) -> Pose:  # fmt: skip
    """Return where a platform on six springs comes to rest: its energy's gradient, by central differences, is zero."""

    def pose(x: np.ndarray) -> Pose:
        return Pose(start.position + x[:3], Rotation.from_rotvec(x[3:]).as_matrix() @ start.rotation)

    def energy(x: np.ndarray) -> float:
        at, home = pose(x), start.position + start.rotation @ centre
        springs = 0.5 * (stiffness * (nominal(geometry, at) - lengths) ** 2).sum()
        return float(springs - mass * gravity @ (at.position + at.rotation @ centre - home))

    def gradient(x: np.ndarray) -> np.ndarray:
        return np.array([(energy(x + 1e-6 * e) - energy(x - 1e-6 * e)) / 2e-6 for e in np.eye(6)])

    return pose(least_squares(gradient, np.zeros(6), x_scale=1e-5, xtol=1e-15, ftol=None, gtol=None).x)


def test_a_symmetric_machine_sinks_by_its_weight_over_its_stiffness() -> None:
    """Closed form: mg/Σ k sin². Six equal struts at one angle share the weight; the sink's square is below 1e-10 m."""
    geometry = paper_geometry()
    machine, home = loaded(geometry), geometry.home
    sine = home.position[2] / nominal(geometry, home)
    sink = 30.0 * G / (SOFT * sine**2).sum()
    commands, _, _ = machine.commands_for(home)
    np.testing.assert_allclose(commands - nominal(geometry, home), sink * sine, rtol=1e-12)
    actual, _ = machine.pose_for(nominal(geometry, home))
    np.testing.assert_allclose(actual.position - home.position, [0.0, 0.0, -sink], atol=1e-10)
    np.testing.assert_allclose(actual.rotation, home.rotation, atol=1e-10)


@pytest.mark.parametrize("name", [*machine_names(), "pivoting"])
def test_it_rests_where_the_energy_is_least(name: str, tmp_path: Path) -> None:
    """Uneven struts, a mass off the middle, gravity from aside. The differences' rounding is worth 1 nm and 10 nrad."""
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
    assert_at(actual, Pose(geometry.home.position, turned), 1e-13, 1e-12)
    rest = lowest_energy(geometry, commands, stiffness, 30.0, centre, gravity, geometry.home)
    assert_at(actual, rest, 1e-9, 1e-8)
    assert np.abs(commands - nominal(geometry, actual)).max() > 1e-6, "and it bends by more than a µm"


def assert_at(found: Pose, truth: Pose, position: float, angle: float) -> None:
    assert np.abs(found.position - truth.position).max() <= position
    assert Rotation.from_matrix(found.rotation @ truth.rotation.T).magnitude() <= angle


def test_a_hanging_machine_is_commanded_shorter() -> None:
    """The paper's machine turned upside down: every strut pulls, by the same forces."""
    standing = paper_geometry()
    over = np.diag([1.0, -1.0, -1.0])
    hanging = replace(
        standing, base_joints=standing.base_joints @ over, platform_joints=standing.platform_joints @ over,
        home=Pose(over @ standing.home.position, np.eye(3)), base_cone_axes=None, platform_cone_axes=None,
    )  # fmt: skip
    pushed, pulled = (loaded(g).commands_for(g.home)[0] - nominal(g, g.home) for g in (standing, hanging))
    assert (pushed > 1e-6).all()
    np.testing.assert_allclose(pulled, -pushed, rtol=1e-9)
    # Lost motion: a strut that pushes is shorter by half of it, so it is told to be longer, and the other way round.
    for geometry, sign in ((standing, 1.0), (hanging, -1.0)):
        with_play = loaded(geometry, lost_motion=4e-6 * np.arange(1.0, 7.0)).commands_for(geometry.home)[0]
        added = with_play - loaded(geometry).commands_for(geometry.home)[0]
        np.testing.assert_allclose(added, sign * 2e-6 * np.arange(1.0, 7.0), rtol=1e-9)


@fixed
@given(seeds)
def test_forwards_undoes_backwards_under_any_load(seed: int) -> None:
    """Closure within 1e-13 m and 1e-12 rad, with all other blocks and terms of load, any gravity and a wrench."""
    rng = np.random.default_rng(seed)
    geometry = skewed_geometry(lead=0.01 * float(rng.integers(2)))
    geometry = replace(geometry, payloads={"tool": Payload(rng.uniform(0.0, 20.0), tuple(rng.uniform(-0.1, 0.1, 3)))})
    load = Load(
        stiffness=rng.uniform(5e6, 100e6, 6), lost_motion=rng.uniform(0.0, 10e-6, 6), mass=rng.uniform(0.0, 50.0),
        centre=rng.uniform(-0.1, 0.1, 3), friction=rng.uniform(0.0, 2.0, 6),
    )  # fmt: skip
    down = rng.normal(size=3)
    loading = Loading.of(G * down / np.linalg.norm(down), rng.uniform(-100.0, 100.0, 6))
    machine = RealMachine(geometry, replace(random_model(rng, "skewed"), load=load), loading=loading)
    target, motion = random_pose(rng, geometry.home), MotionState()
    machine.commands_for(Pose(target.position + 1e-3, target.rotation), motion)
    commands, model_pose, _ = machine.commands_for(target, motion)
    actual, again = machine.pose_for(commands, motion.sense, geometry.home)
    assert_at(actual, target, 1e-13, 1e-12)
    assert_at(again, model_pose, 1e-13, 1e-12)


def test_a_tool_weighs_like_a_wrench_in_its_centre() -> None:
    """8 kg at a place of a platform that is level are a force and a torque about its origin."""
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
    """Command home until nothing ramps any more; return the commands, none of which may step by more than the ramp."""
    home, last = compensator.geometry.tool_pose(compensator.geometry.home), compensator.command.copy()
    for n in range(1, 400):
        compensator.correct(home, start + 0.02 * n)
        if np.isfinite(last).all():
            assert np.abs(compensator.command - last).max() <= 20e-6 * (1.0 + 1e-9)
        last = compensator.command.copy()
    assert not compensator.ramping
    return last


def test_what_acts_ramps_in_and_no_direction_turns() -> None:
    """A change of gravity, force or tool is taken up by 1 mm/s, and ends at what a machine so loaded needs."""
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
    compensator.set_load(tilted)  # the same again is no change
    assert seen == [("load", tilted.numbers()), ("tool", "heavy")]
    with pytest.raises(ModelError, match=r"gravity: must be three numbers, 9…10.6 m/s² in all"):
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


def test_the_model_file_has_the_block() -> None:
    """Written and read again it is the same; engineers write N/µm, µm, kg and mm."""
    load = Load(
        SOFT, np.full(6, 3e-6), 5.0, 12.5, np.array([0.01, 0.0, 0.02]), np.array([0.0, G, 0.0]), np.arange(1.0, 7.0)
    )
    text = model_text(MachineModel("paper", load=load, origin=ModelOrigin("2026-11-24")))
    assert "stiffness_N_per_um: 20.0\n" in text
    assert "mass_kg: 12.5\n" in text
    assert "friction_N_m: [1.0, 2.0, " in text
    assert "gravity_m_s2: [" in text
    again = parse_model(text, "paper").load
    for name in ("stiffness", "lost_motion", "take_up", "mass", "centre", "gravity", "friction"):
        np.testing.assert_array_equal(getattr(again, name), getattr(load, name))
    assert "load" not in model_text(MachineModel("paper", origin=ModelOrigin("2026-11-24")))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"stiffness": np.full(6, 20.0)}, r"load.stiffness: must be 0, which means rigid, or at least 0.1 N/µm"),
        ({"stiffness": -SOFT}, "load.stiffness: must not be negative"),
        ({"mass": np.nan}, "load.mass: must be finite"),
        ({"take_up": 0.0}, "load.take_up: must be above zero"),
    ],
)
def test_a_load_that_no_machine_has_is_refused(change: dict, problem: str) -> None:
    with pytest.raises(ModelError, match=problem):
        Load(**change)


def test_tools_have_mass_and_centre(tmp_path: Path) -> None:
    """The geometry file states them with units, in platform; a mass without its centre is refused."""
    text = (
        machines()["paper"].write(tmp_path / "machine.yaml").read_text()
        + "tools:\n  heavy: {position_mm: [0, 0, 50], mass_kg: 12, centre_mm: [1, 2, 30]}\n"
        + "  light: {position_mm: [0, 0, 9]}\n"
    )
    (tmp_path / "tools.yaml").write_text(text)
    geometry = load_geometry(tmp_path / "tools.yaml")
    assert geometry.using("heavy").payload == Payload(12.0, (0.001, 0.002, 0.03))
    assert geometry.using("light").payload == geometry.payload == Payload()
    (tmp_path / "wrong.yaml").write_text(text.replace(", centre_mm: [1, 2, 30]", ""))
    with pytest.raises(InputFileError, match=r"tools.heavy.centre: is missing"):
        load_geometry(tmp_path / "wrong.yaml")
    (tmp_path / "wrong.yaml").write_text(text.replace("mass_kg: 12", "mass_kg: -12"))
    with pytest.raises(InputFileError, match=r"tools.heavy.mass: must be 0…100000 kg"):
        load_geometry(tmp_path / "wrong.yaml")
