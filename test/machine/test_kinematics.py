"""Kinematics against the paper's tables, closed forms, finite differences, SciPy and closure; assembly modes.

The truth for modes is the pose from which the lengths were computed.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers import (
    central_difference,
    distances,
    general_machine,
    moved,
    poses_about,
    table_lengths,
    table_poses,
    three_two_one_machine,
)
from scipy.spatial.transform import Rotation
from strategies import paper_geometry

from hexapod_comp.core import Status, batch
from hexapod_comp.errors import (
    KinematicsError,
    NotFiniteError,
    OtherAssemblyModeError,
    SingularError,
    UnreachableError,
)
from hexapod_comp.machine import assembly, kinematics
from hexapod_comp.machine.assembly import assembly_modes, mode_objections, working_mode
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
# ±10 µm on every coordinate of every joint, Song et al.'s tolerance
DEVIATION = np.random.default_rng(10).uniform(-10e-6, 10e-6, (2, 6, 3))

REAL = IDEAL.moved(*DEVIATION)

machines = pytest.mark.parametrize("machine", MACHINES.values(), ids=MACHINES.keys())


# --- the paper's tables ------------------------------------------------------------------------------------


def test_table_1_gives_table_2_to_the_last_printed_digit() -> None:
    """Song et al., Tables 1 and 2: 60 lengths, printed to 0.001 mm without trailing zeros."""
    ours = [[f"{length * 1e3:.3f}" for length in strut_lengths(IDEAL, pose)] for pose in table_poses()]
    printed = [[f"{length * 1e3:.3f}" for length in row] for row in table_lengths()]
    assert ours == printed


# --- round trips -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("structure", "home", "count", "reach", "tilt_deg"),
    [
        pytest.param(IDEAL, HOME, 100_000, 0.05, 30.0, id="ideal"),
        pytest.param(REAL, HOME, 100_000, 0.05, 30.0, id="10um"),
        *(pytest.param(Structure.of(m), m.home, 2000, 0.03, 15.0, id=name) for name, m in MACHINES.items()),
    ],
)
def test_round_trip_from_home(structure: Structure, home: Pose, count: int, reach: float, tilt_deg: float) -> None:
    """Every pose is found from home, to 1e-13 m even with lengths of 1.5 m and condition numbers of 20."""
    positions, rotations = poses_about(home, count, seed=1, reach=reach, tilt_deg=tilt_deg)
    found = solve_poses(structure, strut_lengths_batch(structure, positions, rotations), home)
    turns = found.rotations @ rotations.transpose(0, 2, 1)
    assert found.ok.all()
    assert np.abs(found.positions - positions).max() <= 1e-13
    assert np.abs(turns - np.eye(3)).max() <= 1e-12
    assert found.conditions.max() <= structure.max_condition
    if count == 100_000:
        assert found.iterations.mean() <= 5.5


# --- Jacobian ----------------------------------------------------------------------------------------------


@machines
def test_jacobian_against_central_differences(machine: HexapodGeometry) -> None:
    """1e-9 is twenty times the error of :func:`helpers.central_difference`, which describes the step."""
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
        (3.0, 1e-14),  # divided by the sine of the angle, 0.14
    ],
)
def test_motions_between_poses_against_rotations_by_their_vectors(angle: float, tolerance: float) -> None:
    """The motion's rotation turns the first pose to the second, and moves a point with it, along turned axes."""
    rng = np.random.default_rng(21)
    (positions, rotations), point = poses_about(HOME, 40, seed=22), np.array([0.03, -0.02, 0.08])
    axes = Rotation.from_rotvec([0.4, -0.2, 0.7])
    vectors = rng.normal(size=(40, 3))
    vectors *= angle / np.linalg.norm(vectors, axis=1)[:, None]
    shifts = angle * rng.normal(size=(40, 3))
    arms, motions = rotations @ point, np.empty((6, 40))
    # exp(ω)·a − a = sin θ·(k × a) + (1 − cos θ)·k × (k × a) has no difference of nearly equal numbers
    swing, axis = np.cross(vectors, arms) / angle, vectors / angle
    carried = shifts + np.sin(angle) * swing + 2.0 * np.sin(0.5 * angle) ** 2 * np.cross(axis, swing)
    turned = Rotation.from_rotvec(vectors).as_matrix() @ rotations
    batch.motions(positions, rotations, positions + shifts, turned, point, axes.as_matrix(), motions)
    np.testing.assert_allclose(motions[:3].T, axes.inv().apply(carried), rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(motions[3:].T, axes.inv().apply(vectors), rtol=0.0, atol=tolerance)


@machines
def test_condition_number_and_sign_against_linear_algebra(machine: HexapodGeometry) -> None:
    """The truth is NumPy's inverse and determinant of the Jacobian, which has its own test; 1e-11 covers κ²·1e-16."""
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
@pytest.mark.parametrize("count", [0, 1, 8, 203])
def test_batch_equals_single_bit_for_bit(machine: HexapodGeometry, count: int) -> None:
    """Batch and single calls agree in every lane and branch; some rows fail on purpose."""
    structure = Structure.of(machine)
    positions, rotations = poses_about(machine.home, count, seed=6, tilt_deg=50.0)
    lengths = strut_lengths_batch(structure, positions, rotations)
    for n in range(count):
        assert (strut_lengths(structure, Pose(positions[n], rotations[n])) == lengths[n]).all()
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


@pytest.mark.parametrize("alone", [-1.0, np.inf])
@pytest.mark.parametrize("threads", [None, 3])
@pytest.mark.parametrize("count", [0, 4097, 20_000])
def test_every_row_is_in_one_slice(
    monkeypatch: pytest.MonkeyPatch, count: int, threads: int | None, alone: float
) -> None:
    monkeypatch.setattr(kinematics, "ALONE", alone)
    slices: list[slice] = []
    kinematics.over_chunks(slices.append, count, threads)
    assert sorted(n for rows in slices for n in range(rows.start, rows.stop)) == list(range(count))
    assert all(rows.stop > rows.start for rows in slices)


@pytest.mark.parametrize("fails", ["caller", "helper"])
def test_the_first_error_ends_a_shared_batch(monkeypatch: pytest.MonkeyPatch, fails: str) -> None:
    """The first error of any thread ends a batch, and no thread begins another slice."""
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
        time.sleep(0.01)  # the other thread is about to end

    with pytest.raises(ZeroDivisionError):
        kinematics.over_chunks(run, kinematics.SLICE * 200, threads=2)
    assert len(begun) < 100


# --- errors ------------------------------------------------------------------------------------------------


def test_refused_by_name() -> None:
    lengths = strut_lengths(IDEAL, HOME)
    with pytest.raises(NotFiniteError, match="strut_4"):
        solve_pose(IDEAL, [*lengths[:3], -0.5, *lengths[4:]], HOME)
    for shape in ((5,), (7,), (6, 1), ()):
        with pytest.raises(KinematicsError, match="six"):
            solve_pose(IDEAL, np.full(shape, 0.5), HOME)
    positions, rotations = poses_about(HOME, 5, seed=13)
    positions[3, 1] = np.inf
    with pytest.raises(NotFiniteError, match="pose 3"):
        strut_lengths_batch(IDEAL, positions, rotations)


FAR_TURNED = Pose.from_angles(HOME.position, np.deg2rad([0.0, 0.0, 88.0]))


def near_a_singular_pose(lengths: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> None:
    lengths[:], rotation[:] = strut_lengths(IDEAL, FAR_TURNED), FAR_TURNED.rotation


UNTOUCHED = {
    "singular": (Status.SINGULAR, near_a_singular_pose),
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
    """The C function keeps every bit of position and rotation unless its outcome is OK."""
    lengths = strut_lengths(IDEAL, HOME)
    position, rotation = HOME.position.copy(), HOME.rotation.copy()
    spoil(lengths, position, rotation)
    before = position.copy(), rotation.copy()
    found, _ = solve_one(IDEAL, lengths, position, rotation)
    assert found == outcome
    np.testing.assert_array_equal(position, before[0])
    np.testing.assert_array_equal(rotation, before[1])


# --- assembly modes ----------------------------------------------------------------------------------------

# m and rad; at a condition number of 1e4 a pose has 1e4 roundings of the lengths, with a margin
REGULAR = 1e-10


def miss(pose: Pose, modes: list[Pose]) -> float:
    """Return the distance of the nearest mode: its largest difference in m or in elements of the rotation."""
    apart = [
        max(np.abs(pose.position - mode.position).max(), np.abs(pose.rotation - mode.rotation).max()) for mode in modes
    ]
    return float(min(apart, default=np.inf))


def high(tilt_deg: list[float]) -> Pose:
    """Return the pose 400 mm above the middle of the base, with the paper's angles in degrees."""
    return Pose.from_angles([0.0, 0.0, 0.4], np.deg2rad(tilt_deg))


@pytest.mark.parametrize(("split", "deviation"), [(0.0, 0.0), (0.0, 5e-4), (0.03, 5e-4)], ids=["6-3", "near", "6-6"])
def test_every_workspace_pose_is_found_and_picked(split: float, deviation: float) -> None:
    """The truth is the pose from which the lengths were computed."""
    rng, platform = np.random.default_rng(3), IDEAL.platform_joints.copy()
    platform[::2, 0] += split
    real = replace(IDEAL, platform_joints=platform).moved(*rng.uniform(-deviation, deviation, (2, 6, 3)))
    for pose in map(Pose, *poses_about(HOME, 6, seed=4)):
        lengths = distances(real, pose)
        assert miss(pose, assembly_modes(real, lengths)) < REGULAR
        assert miss(pose, [working_mode(PAPER, real, lengths)]) < REGULAR


def test_the_search_for_modes_starts_at_level_poses_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the attitude of a level pose the struts' spheres meet in its position, and in one below the base."""
    pose = high([0, 0, 20])
    monkeypatch.setattr(assembly, "nearest_rotation", lambda _: pose.rotation[None])
    positions, rotations = assembly._starts_around(IDEAL, distances(IDEAL, pose))
    upper_first = positions[1:][np.argsort(-positions[1:, 2])]
    np.testing.assert_allclose(upper_first, pose.position * [[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]], atol=1e-9)
    np.testing.assert_array_equal(rotations, [HOME.rotation, pose.rotation, pose.rotation])
    np.testing.assert_array_equal(positions[0], HOME.position)


@pytest.mark.parametrize("strut", range(6))
@pytest.mark.parametrize("length", [3.0, 1e-3])
def test_one_strut_of_an_impossible_length_is_unreachable(strut: int, length: float) -> None:
    """Joints that share a base joint are at most the platform's size apart, so 1 mm does not go with 0.5 m either."""
    lengths = distances(IDEAL, HOME)
    lengths[strut] = length
    outcome, _ = solve_one(IDEAL, lengths, HOME.position.copy(), HOME.rotation.copy())
    assert outcome == Status.UNREACHABLE


def test_what_has_no_mode() -> None:
    """Refused are lengths out of reach, lengths that are no numbers, and a machine that can turn with locked struts."""
    short = distances(IDEAL, Pose.identity()) * (1.0 - 1e-3)
    assert assembly_modes(IDEAL, short) == []
    with pytest.raises(UnreachableError, match="no pose of the machine has these strut lengths") as caught:
        working_mode(PAPER, IDEAL, short)
    assert caught.value.value == 0, "poses"
    rod = np.zeros((6, 3))
    rod[:, 0] = [-0.5, -0.3, -0.1, 0.1, 0.3, 0.5]  # all joints are on one line, about which the platform can turn
    swinging = replace(IDEAL, base_joints=rod)
    for machine, lengths, error, words in (
        (IDEAL, [0.45] * 3 + [np.nan] + [0.45] * 2, NotFiniteError, "strut_4"),
        (IDEAL, [0.45] * 3 + [-0.4] + [0.45] * 2, NotFiniteError, "strut_4"),
        (swinging, distances(swinging, high([5, 10, 15])), SingularError, "struts locked"),
    ):
        with pytest.raises(error, match=words):
            assembly_modes(machine, np.array(lengths))


def test_no_mode_within_the_limits() -> None:
    """Two degrees from Fichter's singular pose the condition number is 17, above the machine's limit of 10."""
    lengths = distances(IDEAL, high([0, 0, 88]))
    count = len(assembly_modes(IDEAL, lengths))
    expected = f"{count} poses have these strut lengths, but the machine can reach none.*condition number 16.7"
    with pytest.raises(OtherAssemblyModeError, match=expected) as caught:
        working_mode(PAPER, IDEAL, lengths)
    assert caught.value.value == count
    assert mode_objections(PAPER, IDEAL, HOME) == []
    sunk = replace(PAPER, base_joints=PAPER.base_joints - [0, 0, 1], home=Pose(HOME.position - [0, 0, 1], np.eye(3)))
    assert mode_objections(sunk, Structure.of(sunk), sunk.home) == []
    below = Pose(HOME.position * [1, 1, -1], np.eye(3))
    assert mode_objections(PAPER, IDEAL, below) == [
        "det J has the other sign than at home",
        "platform on the other side of the base than at home",
        "base joint 1 at 103.5° from its neutral direction, allowed 50.0°",
        "platform joint 1 at 103.5° from its neutral direction, allowed 75.0°",
    ]
    close = replace(PAPER, limits=replace(PAPER.limits, clearance=0.24, condition=1.2))
    crossed = ["condition number 1.575, allowed 1.2", "struts 4 and 5 are 201.7 mm apart, must be at least 240.0 mm"]
    assert mode_objections(close, IDEAL, high([3, -2, 60])) == crossed


def test_two_candidates_as_near_are_refused() -> None:
    """At a tilt of 80° about its axis of symmetry the paper's machine has two more modes, mirror images at the same
    distance from home, which nothing distinguishes with open cones."""
    limits = replace(PAPER.limits, base_cone=np.full(6, np.pi), platform_cone=np.full(6, np.pi))
    with pytest.raises(
        OtherAssemblyModeError, match=r"at similar distances from home \(692\.4 and 692\.4 mm\): give a"
    ):
        working_mode(replace(PAPER, limits=limits), IDEAL, distances(IDEAL, high([0, 80, 0])))
