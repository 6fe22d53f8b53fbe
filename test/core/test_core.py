"""The core returns a correct answer or an error for any input, and compiles without a warning.

NumPy's linear algebra on the joints checks every answer. ``benchmarks.c_core`` covers more compilers, instruction sets
and processors.
"""

from __future__ import annotations

import contextlib
import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import ALL_TESTS, general_machine, three_two_one_machine
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import fixed, often, paper_geometry

from benchmarks.c_core import STRICT, Build, builds, missing
from hexapod_comp import core
from hexapod_comp.core import Status, batch
from hexapod_comp.core.build import FLAGS
from hexapod_comp.errors import KinematicsError
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.kinematics import (
    Structure,
    solve_one,
    solve_pose,
    strut_lengths,
)
from hexapod_comp.machine.model import MachineModel, RealMachine, core_model
from hexapod_comp.pose import Pose

MACHINES = [paper_geometry(), general_machine(), three_two_one_machine()]
fewer = settings(fixed, max_examples=40)  # for tests whose cases mostly end in the slow search for the closest pose

machines = st.sampled_from(MACHINES)
any_float = st.floats(allow_nan=True, allow_infinity=True)
far = st.floats(-2.0, 2.0) | st.floats(-1e6, 1e6)  # coordinates of poses, m

quaternions = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: math.hypot(*q) > 1e-3)


@st.composite
def any_poses(draw) -> Pose:
    """Draw poses within 1000 km, with any rotation."""
    quaternion = np.array(draw(quaternions))
    return Pose.from_quaternion(draw(st.tuples(far, far, far)), quaternion / np.linalg.norm(quaternion))


def judge(machine: HexapodGeometry, structure: Structure, lengths: np.ndarray, pose: Pose) -> None:
    """Fail unless a pose closes the loops, is regular and belongs to the working assembly mode.

    Loops: the solver promises 1e-13 m on such machines, and the sum here rounds once more. Condition and sign: NumPy's
    inverse and determinant of (u_i, R·t_i × u_i), compared with home's sign.
    """
    matrix, found = jacobian_by_numpy(structure, pose)
    np.testing.assert_allclose(found, lengths, rtol=1e-15, atol=3e-13)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(pose.rotation) > 0.0
    condition = np.linalg.norm(matrix) * np.linalg.norm(np.linalg.inv(matrix)) / 6.0
    assert condition <= machine.limits.condition * (1.0 + 1e-9)
    at_home, _ = jacobian_by_numpy(structure, machine.home)
    assert np.linalg.det(matrix) * np.linalg.det(at_home) > 0.0


def jacobian_by_numpy(structure: Structure, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian, with rotations times the characteristic length, and the lengths."""
    arms = structure.platform_joints @ pose.rotation.T
    struts = pose.position + arms - structure.base_joints
    lengths = np.linalg.norm(struts, axis=1)
    units = struts / lengths[:, None]
    return np.hstack([units, np.cross(arms, units) / structure.characteristic_length]), lengths


@often
@given(machines, st.lists(any_float, min_size=18, max_size=18))
def test_anything_at_all_in_the_core(machine: HexapodGeometry, numbers: list[float]) -> None:
    """Any 18 floats as lengths, position and rotation, given to the C core directly, without Python's checks."""
    structure = Structure.of(machine)
    lengths, position, rotation = np.split(np.array(numbers), [6, 9])
    rotation = rotation.reshape(3, 3)
    before = position.copy(), rotation.copy()
    outcome, _ = solve_one(structure, lengths, position, rotation)
    if outcome == Status.OK:
        judge(machine, structure, lengths, Pose(position, rotation))
    else:
        np.testing.assert_array_equal(position, before[0])
        np.testing.assert_array_equal(rotation, before[1])


def test_a_sheared_matrix_that_closes_the_loops_is_no_answer() -> None:
    """The third row of the guess is the cross product of two unit rows that are not perpendicular."""
    machine, structure = MACHINES[1], Structure.of(MACHINES[1])
    position, rotation = machine.home.position.copy(), np.array([[1.0, 0, 0], [0.02, 0.02, 0], [0, 0, 0.02]])
    rotation[1:, 1:] = np.sqrt(1.0 - 0.02**2) * np.eye(2)
    lengths = np.linalg.norm(position + structure.platform_joints @ rotation.T - structure.base_joints, axis=1)
    if solve_one(structure, lengths, position, rotation)[0] == Status.OK:
        judge(machine, structure, lengths, Pose(position, rotation))


@fewer
@given(machines, any_poses(), st.sampled_from(["home", "target", "guess"]))
def test_any_target_and_any_guess(machine: HexapodGeometry, pose: Pose, start: str) -> None:
    """The lengths are those of any pose, also a singular one; the guess is home, the pose, or any other."""
    target, guess = {"home": (pose, machine.home), "target": (pose, pose), "guess": (machine.home, pose)}[start]
    structure = Structure.of(machine)
    lengths = strut_lengths(structure, target)
    if np.isfinite(lengths).all():
        with contextlib.suppress(KinematicsError):
            judge(machine, structure, lengths, solve_pose(structure, lengths, guess))


def leaves(view: np.ndarray) -> list[bytes]:
    """Return the bytes of all numbers of a struct, without the padding between them."""
    if view.dtype.names is None:
        return [view.tobytes()]
    return [part for name in view.dtype.names for part in leaves(view[name])]


def test_a_new_state_does_not_depend_on_what_its_memory_held() -> None:
    """A controller in C takes the memory of a state from its stack; the truth is a state in memory of zeros."""
    constants, states = core_model(paper_geometry(), MachineModel("paper")), [core.Struct("hc_state") for _ in "ab"]
    states[1].view[...] = np.frombuffer(b"\xa5" * states[1].view.nbytes, states[1].view.dtype)[0]
    for state in states:
        core.lib.hc_init(state.at, constants.at, 1e-3)
    assert leaves(states[0].view) == leaves(states[1].view)


def test_a_window_follows_with_play():
    """A window of width 2 is pushed up to 5, and reports the way back after 2, as a nut with backlash."""
    low, sense = batch.follow(2.0, np.array([0.0, 5.0, 3.5, 3.0, 2.5, 5.5]))
    assert low.tolist() == [-1.0, 3.0, 3.0, 3.0, 2.5, 3.5]
    assert sense.tolist() == [0.0, 1.0, 1.0, 1.0, -1.0, 1.0]


def drives(**members: object) -> core.Struct:
    """Return six drives at rest at 0.5 m, with stops at 0.3 and 0.7 m and ticks of 1 ms."""
    at_rest = {"position": np.full(6, 0.5), "motor": np.full(6, 0.5), "stops": np.tile([0.3, 0.7], (6, 1))}
    limits = {"tick": 1e-3, "max_speed": 0.2, "max_acceleration": 4.0}
    return core.Struct("hc_drives", at_rest | limits | members)


def test_motors_move_in_steps_and_the_nut_follows_with_backlash():
    """By hand: steps of 0.1 mm, half a backlash of 0, 20 or 250 µm, a command beyond the stop, and a stuck drive."""
    half = 1e-6 * np.array([0.0, 20.0, 250.0, 20.0, 20.0, 20.0])
    state, sense = drives(step=1e-4, half_play=half, stuck=[0, 0, 0, 0, 0, 1]), np.zeros(9)
    batch.run_drives(state, np.array([0.50006, 0.50006, 0.49986, 0.8, 0.7, 0.6]), 1, sense)
    np.testing.assert_allclose(state.view["motor"], [0.5001, 0.5001, 0.4999, 0.7, 0.7, 0.5], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(state.view["play"], 1e-6 * np.array([0, 20, -100, 20, 20, 0]), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(sense, [0.0, 0.0, 0.0, 0.0, 1.0, -0.4, 1.0, 1.0, 0.0], rtol=0.0, atol=1e-9)
    assert state.view["stopped"].tolist() == [0, 0, 0, 1, 0, 0]


@pytest.mark.parametrize(("way", "stop"), [(1.0, 0.7), (-1.0, 0.3)])
def test_a_drive_is_stopped_at_contact_or_when_it_runs_into_its_stop(way: float, stop: float):
    """A motor 0.5 µm from its stop is in contact, 2 µm are not; a drive at 0.2 m/s, 0.1 mm before it, runs into it."""
    for gap, contact in ((5e-7, 1), (2e-6, 0)):
        state = drives(step=stop - way * gap)
        batch.run_drives(state, np.full(6, stop + way), 1, np.zeros(9))
        assert state.view["stopped"].tolist() == [contact] * 6
    state = drives(lag=0.02, position=np.full(6, stop - way * 1e-4), speed=np.full(6, 0.2 * way))
    batch.run_drives(state, np.full(6, stop), 1, np.zeros(9))
    for name, value in (("motor", stop), ("speed", 0.0), ("stopped", 1)):
        assert (state.view[name] == value).all()


def test_a_drive_speeds_up_and_brakes_within_its_limits():
    """Over 100 mm: 4 m/s², then 0.2 m/s, then half of 4 m/s², without overshoot. Over 10 µm: critically damped, by the
    closed form (1 + 2t/lag)·exp(−2t/lag) of the distance that is left."""
    state, places = drives(lag=5e-3, tick=1e-4), [0.5]
    for _ in range(800):
        batch.run_drives(state, np.full(6, 0.6), 10, np.zeros(9))
        places.append(float(state.view["position"][0]))
    left, speed = 0.6 - np.array(places), 1e3 * np.diff(places)
    acceleration = 1e3 * np.diff(speed)
    np.testing.assert_allclose(acceleration[:30], 4.0, rtol=1e-6)
    assert speed.max() == pytest.approx(0.2, rel=1e-6)
    braking = (speed[1:] < 0.16) & (speed[1:] > 0.08) & (left[2:] < 0.05)
    np.testing.assert_allclose(acceleration[braking], -2.0, rtol=0.04)
    assert (left >= 0.0).all()
    assert (places[-1], state.view["speed"][0]) == (0.6, 0.0)
    state = drives(lag=5e-3, tick=1e-5)
    batch.run_drives(state, np.full(6, 0.50001), 500, np.zeros(9))
    assert 0.50001 - state.view["position"][0] == pytest.approx(3e-5 * np.exp(-2.0), rel=0.01)


@pytest.mark.parametrize(
    ("period", "fastest", "velocities"), [(0.01, 1.0, (0.1, -0.2)), (0.01, 0.1, (0.05, -0.1)), (0.0, 1.0, (0.0, 0.0))]
)
def test_lengths_are_written_with_velocities_up_to_the_fastest(period, fastest, velocities):
    position, velocity = core.ffi.new("double[6]", [0.5] * 6), core.ffi.new("double[6]")
    lengths = [0.501, 0.498, *[0.5] * 4]
    core.lib.hc_write_lengths(lengths, period, fastest, position, velocity)
    assert list(position) == lengths
    assert list(velocity) == pytest.approx([*velocities, 0.0, 0.0, 0.0, 0.0])


WRONG = {"shape": lambda a: a[:-1], "type": lambda a: a.astype(np.float32), "layout": lambda a: np.asfortranarray(a)}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("place", range(5))
def test_what_does_not_fit_is_refused_where_it_crosses(place, wrong):
    """Shape, type and layout of each array are checked, so that the C code stays within it."""
    names = "base", "platform", "positions", "rotations", "lengths"
    arrays = [np.zeros((6, 3)), np.ones((6, 3)), np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 6))]
    arrays[place] = WRONG[wrong](arrays[place])
    # A batch of another length is valid by itself; the next array then does not match it.
    blamed = "rotations" if (names[place], wrong) == ("positions", "shape") else names[place]
    with pytest.raises(ValueError, match=f"^{blamed}: must be"):
        batch.strut_lengths(*arrays)


def test_indices_counts_and_arrays_to_write_are_checked_too() -> None:
    machine = RealMachine(MACHINES[1], MachineModel(MACHINES[1].name))
    for strut in (-1, 6):
        with pytest.raises(ValueError, match=f"^strut: must be 0…5, not {strut}$"):
            batch.strut_errors(machine.state, strut, 0.0, np.zeros(1))
    with pytest.raises(TypeError, match=r"takes 4 arguments, not 1"):
        batch.strut_errors(machine.state)
    with pytest.raises(TypeError, match="cannot be pickled: it points to memory of this process"):
        pickle.dumps(machine.state)
    fixed_sense = np.zeros(9)
    fixed_sense.flags.writeable = False
    with pytest.raises(ValueError, match=r"^sense: is read-only"):
        batch.run_drives(drives(), np.full(6, 0.5), 1, fixed_sense)


SOURCE = Path(core.__file__).parent / "hexapod_batch.c"
BUILDS = {build.name: build for build in builds()}
ULPS = Path(__file__).parent / "ulps.c"


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns(compiler, tmp_path):
    if missing(Build(compiler, [compiler])):
        pytest.skip(f"no {compiler} here")
    words = [compiler, *FLAGS, "-O1", *STRICT, "-c", str(SOURCE), "-o", str(tmp_path / "core.o")]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.stderr == ""


def test_elementary_functions_are_right_to_one_unit_in_the_last_place(tmp_path):
    """For a million arguments (all tests: five million) the truth is the C library in long double."""
    if missing(BUILDS["gcc -O3"]) or np.finfo(np.longdouble).nmant < 63:
        pytest.skip("no gcc, or no long double here")
    words = ["gcc", *FLAGS, *STRICT, f"-I{SOURCE.parent}", str(ULPS), "-o", str(tmp_path / "ulps"), "-lm"]
    made = subprocess.run(words, capture_output=True, text=True)
    assert made.stderr == ""
    ran = subprocess.run(
        [str(tmp_path / "ulps"), "500000" if ALL_TESTS else "100000"], capture_output=True, text=True, check=True
    )
    assert max(map(float, ran.stdout.split())) < 1.0


ROOT = Path(__file__).resolve().parents[2]


WITHOUT_CFFI = (
    "import runpy, sys; sys.modules['cffi'] = None; sys.argv = ['setup.py', *sys.argv[1:]]; runpy.run_path('setup.py')"
)


def test_a_build_without_cffi_fails_and_says_what_is_missing(tmp_path):
    """``setup.py build``, as colcon runs it, fails without cffi; setuptools alone would build no core and succeed."""
    copied = ("setup.py", "package.xml", "README.md", "LICENSE", "tools", "hexapod_comp")
    for name in copied:
        (tmp_path / name).symlink_to(ROOT / name)
    words = [sys.executable, "-c", WITHOUT_CFFI, "build"]
    made = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode != 0
    assert "setup.py: cffi is missing" in made.stderr
    assert "python3-cffi" in made.stderr
