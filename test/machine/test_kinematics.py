"""Kinematics against the paper's tables, closed forms, finite differences, scipy and closure."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from helpers import (
    central_difference,
    general_machine,
    moved,
    poses_about,
    table_lengths,
    table_poses,
    three_two_one_machine,
    twist_between,
)
from scipy.spatial.transform import Rotation
from strategies import paper_geometry

from hexapod_comp.core import Status, batch
from hexapod_comp.errors import KinematicsError, NotFiniteError, OtherAssemblyModeError, SingularError, UnreachableError
from hexapod_comp.machine import kinematics
from hexapod_comp.machine.geometry import HexapodGeometry
from hexapod_comp.machine.kinematics import (
    Structure,
    condition_number,
    jacobian,
    solve_one,
    solve_pose,
    solve_poses,
    strut_lengths,
    strut_lengths_batch,
)
from hexapod_comp.pose import Pose

PAPER = paper_geometry()
IDEAL = Structure.of(PAPER)
HOME = PAPER.home
MACHINES = {"paper": PAPER, "general": general_machine(), "3-2-1": three_two_one_machine()}
# ±10 µm on every coordinate of every joint, the tolerance that 000 works with
DEVIATION = np.random.default_rng(10).uniform(-10e-6, 10e-6, (2, 6, 3))

REAL = IDEAL.moved(*DEVIATION)
POSES = 100_000

machines = pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES.keys())


# --- the paper's tables ------------------------------------------------------------------------------------


def test_table_1_gives_table_2_to_the_last_printed_digit() -> None:
    """000, Tables 1 and 2: 60 lengths, printed to 0.001 mm with trailing zeros dropped."""
    ours = [[f"{length * 1e3:.3f}" for length in strut_lengths(IDEAL, pose)] for pose in table_poses()]
    printed = [[f"{length * 1e3:.3f}" for length in row] for row in table_lengths()]
    assert ours == printed


@pytest.mark.parametrize("row", range(10))
def test_table_2_gives_table_1_within_its_rounding(row: int) -> None:
    """A length is rounded by at most 0.5 µm: component k of the pose moves by at most Σ_j |J⁻¹|_kj · 0.5 µm.

    The Jacobian is the finite-difference one. Second order: 6 µrad at a radius of 0.2 m change a length by
    less than (6e-6)² · 0.2 m, which |J⁻¹| ≈ 10 rad/m turns into 1e-10; the slack of 1e-9 holds it ten times.
    """
    target, lengths = table_poses()[row], table_lengths()[row]
    matrix = central_difference(lambda twist: strut_lengths(IDEAL, moved(target, twist)), np.zeros(6))
    allowed = np.abs(np.linalg.inv(matrix)).sum(axis=1) * 0.5e-6 + 1e-9
    assert (np.abs(twist_between(target, solve_pose(IDEAL, lengths, HOME))) <= allowed).all()
    assert (allowed < [*[1.5e-6] * 3, *[7e-6] * 3]).all()  # so that the bound above is worth something


# --- round trips -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("structure", [IDEAL, REAL], ids=["ideal", "10um"])
def test_round_trip_of_100000_poses_from_home(structure: Structure) -> None:
    """Closure over ±50 mm and ±30°, every pose from the same guess; issue 2's bars."""
    positions, rotations = poses_about(HOME, POSES, seed=1)
    found = solve_poses(structure, strut_lengths_batch(structure, positions, rotations), HOME)
    turns = found.rotations @ rotations.transpose(0, 2, 1)
    assert found.ok.all()
    assert np.abs(found.positions - positions).max() <= 1e-13
    assert np.abs(turns - np.eye(3)).max() <= 1e-12
    assert found.iterations.mean() <= 5.5
    assert found.conditions.max() <= structure.max_condition


@machines
def test_round_trip_on_any_machine(machine: HexapodGeometry) -> None:
    """The same closure on a general 6-6 machine and where only pivoting works; ±30 mm, ±15° stay regular.

    1e-13 m there too, though the lengths reach 1.5 m and the condition number 20.
    """
    structure = Structure.of(machine)
    positions, rotations = poses_about(machine.home, 2000, seed=2, reach=0.03, tilt_deg=15.0)
    found = solve_poses(structure, strut_lengths_batch(structure, positions, rotations), machine.home)
    assert found.ok.all()
    assert np.abs(found.positions - positions).max() <= 1e-13
    assert np.abs(found.rotations - rotations).max() <= 1e-12


# --- Jacobian ----------------------------------------------------------------------------------------------


@machines
def test_jacobian_against_central_differences(machine: HexapodGeometry) -> None:
    """See :func:`helpers.central_difference` for the step; 1e-9 is twenty times its error."""
    structure = Structure.of(machine)
    for position, rotation in zip(*poses_about(machine.home, 20, seed=4, tilt_deg=15.0), strict=True):
        pose = Pose(position, rotation)

        def lengths(twist: np.ndarray, pose: Pose = pose) -> np.ndarray:
            return strut_lengths(structure, moved(pose, twist))

        expected = central_difference(lengths, np.zeros(6))
        np.testing.assert_allclose(jacobian(structure, pose), expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("angle", "tolerance"),
    [
        (1e-9, 4e-16),  # rounding of the two rotations alone
        (1e-4, 4e-16),
        (0.3, 1e-15),
        (3.0, 1e-14),  # … over the sine of the angle, 0.14
    ],
)
def test_motions_between_poses_against_rotations_by_their_vectors(angle: float, tolerance: float) -> None:
    """The turn comes back that made the second pose, and a point goes where it carries it, along turned axes."""
    rng = np.random.default_rng(21)
    (positions, rotations), point = poses_about(HOME, 40, seed=22), np.array([0.03, -0.02, 0.08])
    axes = Rotation.from_rotvec([0.4, -0.2, 0.7])
    vectors = rng.normal(size=(40, 3))
    vectors *= angle / np.linalg.norm(vectors, axis=1)[:, None]
    shifts = angle * rng.normal(size=(40, 3))
    arms, motions = rotations @ point, np.empty((6, 40))
    # exp(ω)·a − a = sin θ·(k × a) + (1 − cos θ)·k × (k × a), without a difference of nearly equal numbers
    swing, axis = np.cross(vectors, arms) / angle, vectors / angle
    carried = shifts + np.sin(angle) * swing + 2.0 * np.sin(0.5 * angle) ** 2 * np.cross(axis, swing)
    turned = Rotation.from_rotvec(vectors).as_matrix() @ rotations
    batch.motions(positions, rotations, positions + shifts, turned, point, axes.as_matrix(), motions)
    np.testing.assert_allclose(motions[:3].T, axes.inv().apply(carried), rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(motions[3:].T, axes.inv().apply(vectors), rtol=0.0, atol=tolerance)


@machines
def test_condition_number_and_sign_against_linear_algebra(machine: HexapodGeometry) -> None:
    """NumPy's inverse and determinant of the Jacobian, whose own test is above; 1e-11 covers κ²·1e-16."""
    structure = Structure.of(machine)
    unit = np.array([1.0, 1.0, 1.0, *[1.0 / structure.characteristic_length] * 3])
    for position, rotation in zip(*poses_about(machine.home, 50, seed=5, tilt_deg=15.0), strict=True):
        pose = Pose(position, rotation)
        matrix = jacobian(structure, pose) * unit
        expected = np.linalg.norm(matrix) * np.linalg.norm(np.linalg.inv(matrix)) / 6.0
        condition, sign = condition_number(structure, pose)
        assert condition == pytest.approx(expected, rel=1e-11)
        assert sign == np.sign(np.linalg.det(matrix))
        assert 1.0 <= condition <= np.linalg.cond(matrix) * (1 + 1e-12) <= 6.0 * condition * (1 + 1e-11)


# --- batches -----------------------------------------------------------------------------------------------


@machines
@pytest.mark.parametrize("count", [1, 7, 8, 9, 203])
def test_batch_equals_single_bit_for_bit(machine: HexapodGeometry, count: int) -> None:
    """Whatever lane a pose falls into, and on whatever branch; some rows fail on purpose."""
    structure = Structure.of(machine)
    positions, rotations = poses_about(machine.home, count, seed=6, tilt_deg=50.0)
    lengths = strut_lengths_batch(structure, positions, rotations)
    lengths[3::11] *= 1.7
    lengths[5::13, 2] = np.nan
    batch = solve_poses(structure, lengths, machine.home)
    for n in range(count):
        position, rotation = machine.home.position.copy(), machine.home.rotation.copy()
        outcome, condition = solve_one(structure, lengths[n], position, rotation)
        assert outcome == batch.outcomes[n]
        assert condition == batch.conditions[n] or (np.isnan(condition) and np.isnan(batch.conditions[n]))
        if outcome == Status.OK:
            assert (position == batch.positions[n]).all()
            assert (rotation == batch.rotations[n]).all()
        else:
            assert np.isnan(batch.positions[n]).all()
            assert np.isnan(batch.rotations[n]).all()


@machines
def test_batch_of_lengths_equals_single_bit_for_bit(machine: HexapodGeometry) -> None:
    structure = Structure.of(machine)
    positions, rotations = poses_about(machine.home, 50, seed=7)
    lengths = strut_lengths_batch(structure, positions, rotations)
    for n in range(50):
        assert (strut_lengths(structure, Pose(positions[n], rotations[n])) == lengths[n]).all()


@machines
def test_a_start_may_be_a_rounded_rotation(machine: HexapodGeometry) -> None:
    """Ten digits pass as a pose; a start at the answer, off by 5e-11, once left a closure that was refused."""
    structure = Structure.of(machine)
    positions, rotations = poses_about(machine.home, 20, seed=9, tilt_deg=15.0)
    lengths = strut_lengths_batch(structure, positions, rotations)
    assert solve_poses(structure, lengths, (positions, np.round(rotations, 9))).ok.all()
    for n in range(20):
        found = solve_pose(structure, lengths[n], Pose(positions[n], np.round(rotations[n], 10)))
        np.testing.assert_allclose(found.position, positions[n], rtol=0.0, atol=1e-14)


def test_number_of_threads_does_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kinematics, "ALONE", -1.0)  # others help from the second slice on
    positions, rotations = poses_about(HOME, 5000, seed=8)
    lengths = strut_lengths_batch(IDEAL, positions, rotations, threads=1)
    assert (lengths == strut_lengths_batch(IDEAL, positions, rotations, threads=3)).all()
    one, three = (solve_poses(IDEAL, lengths, HOME, threads=n) for n in (1, 3))
    assert (one.positions == three.positions).all()
    assert (one.rotations == three.rotations).all()


@pytest.mark.parametrize("alone", [-1.0, 0.0, np.inf])
@pytest.mark.parametrize("threads", [None, 1, 3])
@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 5000])
def test_every_row_is_in_one_slice(
    monkeypatch: pytest.MonkeyPatch, count: int, threads: int | None, alone: float
) -> None:
    monkeypatch.setattr(kinematics, "ALONE", alone)
    slices: list[slice] = []
    kinematics.over_chunks(slices.append, count, threads)
    assert sorted(n for rows in slices for n in range(rows.start, rows.stop)) == list(range(count))
    assert all(rows.stop > rows.start for rows in slices)


def test_large_batches_are_shared() -> None:
    """A slice that waits for another one to begin ends only if two threads work at once; until then there is one."""
    together, seen = threading.Barrier(2), set()

    def run(rows: slice) -> None:
        start = time.thread_time()
        while time.thread_time() - start < 0.002:
            pass
        if threading.active_count() > before and len(seen) < 2:
            seen.add(threading.get_ident())
            together.wait(60.0)

    before = threading.active_count()
    kinematics.over_chunks(run, 256 * 60, threads=2)
    assert len(seen) == 2


@pytest.mark.parametrize("fails", ["caller", "helper"])
def test_the_first_error_ends_a_shared_batch(monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    """It is raised whoever meets it, and of what is left nobody begins anything: neither has to be waited for."""
    monkeypatch.setattr(kinematics, "ALONE", -1.0)
    caller, begun, failed = threading.get_ident(), [], threading.Event()

    def run(rows: slice) -> None:
        begun.append(rows)
        if rows.start == 0:
            return  # the caller is still alone
        if (threading.get_ident() == caller) == (fails == "caller"):
            failed.set()
            raise ZeroDivisionError
        assert failed.wait(60.0)
        time.sleep(0.01)  # the other one is on its way out

    with pytest.raises(ZeroDivisionError):
        kinematics.over_chunks(run, 256 * 200, threads=2)
    assert len(begun) < 100


def test_empty_batch() -> None:
    assert strut_lengths_batch(IDEAL, np.empty((0, 3)), np.empty((0, 3, 3))).shape == (0, 6)
    assert solve_poses(IDEAL, np.empty((0, 6)), HOME).ok.shape == (0,)


def test_batch_releases_the_gil() -> None:
    """Python code sees a batch half done: the kernel's first row written, its last one not yet.

    A kernel that kept the GIL could only ever be seen before its start or after its end, so this cannot
    pass by luck. It could fail by luck, if the system never gave this thread a turn; hence growing batches.
    """
    assert any(seen_half_done(count) for count in (20_000, 50_000, 100_000, 200_000, 400_000))


def seen_half_done(count: int) -> bool:
    """Solve `count` poses in one kernel call on a thread, and look on from here."""
    lengths = np.tile(strut_lengths(IDEAL, table_poses()[4]), (count, 1))
    positions, rotations = np.tile(HOME.position, (count, 1)), np.tile(HOME.rotation, (count, 1, 1))
    outcomes, iterations = np.full(count, -1, np.intc), np.empty(count, np.intc)
    call = (IDEAL.base_joints, IDEAL.platform_joints, lengths, positions, rotations)
    limits = (IDEAL.characteristic_length, IDEAL.home_sign, IDEAL.max_condition)
    worker = threading.Thread(target=batch.solve_poses, args=(*call, *limits, outcomes, iterations, np.empty(count)))
    worker.start()
    seen = False
    while worker.is_alive() and not seen:
        first_done = outcomes[0] != -1  # before the last one is looked at
        seen = bool(outcomes[-1] == -1 and first_done)
    worker.join()
    return seen


# --- errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [90.0, -90.0])
def test_octahedral_machine_yawed_by_a_quarter_turn_is_singular(yaw: float) -> None:
    """Fichter 1986: a 6-3 machine with both bodies level loses a freedom at γ = ±90°, at any height."""
    singular = Pose.from_angles(HOME.position, np.deg2rad([0.0, 0.0, yaw]))
    with pytest.raises(SingularError) as caught:
        solve_pose(IDEAL, strut_lengths(IDEAL, singular), singular)
    assert caught.value.limit == IDEAL.max_condition
    near = Pose.from_angles(HOME.position, np.deg2rad([0.0, 0.0, yaw * 0.97]))
    with pytest.raises(SingularError) as caught:
        solve_pose(IDEAL, strut_lengths(IDEAL, near), near)
    assert caught.value.value > caught.value.limit


def test_mirrored_machine_is_another_assembly_mode() -> None:
    """Both joint planes being level, reflection in the base plane keeps all lengths and flips det J."""
    pose = table_poses()[4]
    mirror = np.diag([1.0, 1.0, -1.0])
    reflected = Pose(mirror @ pose.position, mirror @ pose.rotation @ mirror)
    lengths = strut_lengths(IDEAL, pose)
    np.testing.assert_allclose(strut_lengths(IDEAL, reflected), lengths, atol=1e-15)
    with pytest.raises(OtherAssemblyModeError):
        solve_pose(IDEAL, lengths, reflected)


@pytest.mark.parametrize(
    "change", [[1.5, 0, 0, 0, 0, 0], [0, 0, 0, -0.45, 0, 0], [0.25, -0.2, 0.25, -0.2, 0.25, -0.2]], ids=str
)
def test_unreachable_lengths(change: list[float]) -> None:
    """A strut 1.5 m too long cannot even meet its neighbour; the others can, but not all at once."""
    lengths = strut_lengths(IDEAL, HOME) + change
    with pytest.raises(UnreachableError):
        solve_pose(IDEAL, lengths, HOME)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -0.5, 0.0, -0.0], ids=str)
@pytest.mark.parametrize("strut", range(6))
def test_length_that_is_none_is_refused_by_name(value: float, strut: int) -> None:
    lengths = strut_lengths(IDEAL, HOME)
    lengths[strut] = value
    with pytest.raises(NotFiniteError, match=f"strut_{strut + 1}"):
        solve_pose(IDEAL, lengths, HOME)


@pytest.mark.parametrize("shape", [(5,), (7,), (6, 1), ()], ids=str)
def test_other_than_six_lengths_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(KinematicsError, match="six"):
        solve_pose(IDEAL, np.full(shape, 0.5), HOME)


def test_batch_of_poses_names_the_row_that_is_not_finite() -> None:
    positions, rotations = poses_about(HOME, 5, seed=13)
    positions[3, 1] = np.inf
    with pytest.raises(NotFiniteError, match="pose 3"):
        strut_lengths_batch(IDEAL, positions, rotations)


UNTOUCHED = {
    "nan length": (Status.NOT_FINITE, lambda lengths, p, r: lengths.__setitem__(2, np.nan)),
    "infinite length": (Status.NOT_FINITE, lambda lengths, p, r: lengths.__setitem__(0, np.inf)),
    "negative length": (Status.NOT_FINITE, lambda lengths, p, r: lengths.__setitem__(5, -0.5)),
    "zero length": (Status.NOT_FINITE, lambda lengths, p, r: lengths.__setitem__(5, 0.0)),
    "nan guess": (Status.NOT_FINITE, lambda lengths, p, r: p.__setitem__(1, np.nan)),
    "infinite guess": (Status.NOT_FINITE, lambda lengths, p, r: r.__setitem__((2, 2), np.inf)),
    "unreachable": (Status.UNREACHABLE, lambda lengths, p, r: lengths.__setitem__(1, 3.0)),
    "mirrored guess": (Status.OTHER_ASSEMBLY, lambda lengths, p, r: p.__setitem__(2, -0.4)),
    "no rotation": (Status.NOT_CONVERGED, lambda lengths, p, r: r.__imul__(0.9)),
    "left-handed": (Status.NOT_CONVERGED, lambda lengths, p, r: r[:, 2].__imul__(-1.0)),
}


@pytest.mark.parametrize(("outcome", "spoil"), UNTOUCHED.values(), ids=UNTOUCHED.keys())
def test_failure_leaves_the_guess_untouched(outcome: int, spoil) -> None:
    """Kernel level: position and rotation keep every bit unless the outcome is OK."""
    lengths = strut_lengths(IDEAL, HOME)
    position, rotation = HOME.position.copy(), HOME.rotation.copy()
    spoil(lengths, position, rotation)
    before = position.copy(), rotation.copy()
    found, _ = solve_one(IDEAL, lengths, position, rotation)
    assert found == outcome
    np.testing.assert_array_equal(position, before[0])
    np.testing.assert_array_equal(rotation, before[1])


def test_singular_answer_leaves_the_guess_untouched() -> None:
    singular = Pose.from_angles(HOME.position, np.deg2rad([0.0, 0.0, 88.0]))
    position, rotation = singular.position.copy(), singular.rotation.copy()
    outcome, condition = solve_one(IDEAL, strut_lengths(IDEAL, singular), position, rotation)
    assert outcome == Status.SINGULAR
    assert condition > IDEAL.max_condition
    assert (position == singular.position).all()
    assert (rotation == singular.rotation).all()
