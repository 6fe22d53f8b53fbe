"""Assembly modes: all poses without a guess, and the pick of the working one.

Truth comes from the pose that made the lengths, from distances computed here, from symmetry, from poses
whose multiplicity is known, and from a multi-start of Newton on the loop closures, which shares neither
unknowns nor elimination with the code under test. Samples are small; benchmarks/assembly.py runs large ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hexapod_comp.core import Status, batch
from hexapod_comp.errors import KinematicsError, NotFiniteError, OtherAssemblyModeError, SingularError
from hexapod_comp.machine.assembly import (
    assembly_modes,
    joint_circles,
    mode_objections,
    platform_pair_gap,
    start_angles,
    working_mode,
)
from hexapod_comp.machine.geometry import HexapodGeometry, load_geometry
from hexapod_comp.machine.kinematics import Structure
from hexapod_comp.pose import Pose

CLOSED = 2e-15  # m; the loops close to a few roundings of a 1 m strut

# m and rad; a pose of condition number up to 1e4 comes back to 1e4 roundings of the lengths, with margin
REGULAR = 1e-10


@pytest.fixture(scope="module")
def geometry() -> HexapodGeometry:
    return load_geometry(Path(__file__).parents[2] / "config" / "paper.yaml")


@pytest.fixture(scope="module")
def structure(geometry) -> Structure:
    return Structure.of(geometry)


def distances(structure: Structure, pose: Pose) -> np.ndarray:
    """Strut lengths from scratch: where the joints are, and how far apart."""
    joints = np.array([pose.position + pose.rotation @ joint for joint in structure.platform_joints])
    return np.linalg.norm(joints - structure.base_joints, axis=1)


def numbers(pose: Pose) -> np.ndarray:
    return np.concatenate([pose.position, pose.rotation.ravel()])


def miss(pose: Pose, modes: list[Pose]) -> float:
    """Distance of the nearest mode, largest of its differences in m and in rotation matrix elements."""
    return min((float(np.abs(numbers(pose) - numbers(mode)).max()) for mode in modes), default=np.inf)


def pose_mm_deg(position_mm, angles_deg) -> Pose:
    return Pose.from_angles(1e-3 * np.array(position_mm, float), np.deg2rad(angles_deg))


def workspace_poses(geometry: HexapodGeometry, count: int, seed: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [
        Pose.from_angles(geometry.home.position + rng.uniform(-0.05, 0.05, 3), np.deg2rad(rng.uniform(-30.0, 30.0, 3)))
        for _ in range(count)
    ]


def test_each_of_the_three_eliminations_finds_the_pose(geometry, structure):
    """Each eliminates two of the joints' angles. Where one loses a root to rounding the others have it, so that a
    fault in one would not be seen in the modes."""
    for pose in workspace_poses(geometry, 10, seed=8):
        joints = pose.position + structure.platform_joints[::2] @ pose.rotation.T
        sides = np.linalg.norm(joints - joints[[1, 2, 0]], axis=1)
        circles = joint_circles(structure.base_joints, distances(structure, pose), 1e-9)
        angles = start_angles(circles, sides)[..., None]
        points = circles[:, 0] + np.cos(angles) * circles[:, 1] + np.sin(angles) * circles[:, 2]
        assert (np.abs(points - joints).max(axis=(1, 2)) < 1e-6).sum() >= 3


def random_machine(seed: int, planar: bool, deviation: float) -> tuple[Structure, np.ndarray]:
    """A 6-3 machine with joints anywhere, and lengths that it can have."""
    rng = np.random.default_rng(seed)
    base = rng.normal(0.0, 0.3, (6, 3)) * [1.0, 1.0, 0.0 if planar else 1.0]
    platform = np.repeat(rng.normal(0.0, 0.2, (3, 3)), 2, axis=0)
    structure = Structure(base, platform, 0.2, 1.0, 1e9, Pose.identity())
    structure = structure.moved(*rng.uniform(-deviation, deviation, (2, 6, 3)))
    pose = Pose(rng.normal(0.0, 0.4, 3), Rotation.from_rotvec(rng.normal(0.0, 1.0, 3)).as_matrix())
    return structure, distances(structure, pose)


def multi_start(structure: Structure, lengths: np.ndarray, seed: int, count: int = 4000) -> list[Pose]:
    """All poses that Newton reaches from thousands of random ones."""
    positions = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)) * lengths.max()
    rotations = Rotation.random(count, random_state=seed).as_matrix()
    outcomes, iterations = np.empty(count, np.intc), np.empty(count, np.intc)
    joints = structure.base_joints, structure.platform_joints
    state = (np.tile(lengths, (count, 1)), positions, rotations, 0.2, 0.0, np.inf)
    batch.solve_poses(*joints, *state, outcomes, iterations, np.empty(count))
    found: list[Pose] = []
    rows = np.hstack([positions, rotations.reshape(-1, 9)])[outcomes == Status.OK]
    while len(rows):
        found.append(Pose(rows[0, :3], rows[0, 3:].reshape(3, 3)))
        rows = rows[np.abs(rows - rows[0]).max(axis=1) > 1e-6]
    return found


@pytest.mark.parametrize(("planar", "deviation"), [(True, 0.0), (False, 0.0), (False, 1e-4)])
@pytest.mark.parametrize("seed", range(5))
def test_modes_are_those_a_multi_start_finds(seed, planar, deviation):
    """Of joints in pairs by elimination, of joints that are a tenth of a millimetre apart by continuation."""
    structure, lengths = random_machine(seed, planar, deviation)
    modes, truth = assembly_modes(structure, lengths), multi_start(structure, lengths, seed)
    assert len(modes) == len(truth)
    assert max(miss(pose, modes) for pose in truth) < 1e-8
    for mode in modes:
        np.testing.assert_allclose(distances(structure, mode), lengths, rtol=0, atol=5e-13 if deviation else CLOSED)


@pytest.mark.parametrize("deviation", [0.0, 1e-5, 5e-4])
def test_every_workspace_pose_is_found_and_picked(geometry, structure, deviation):
    rng = np.random.default_rng(3)
    for pose in workspace_poses(geometry, 20, seed=4):
        real = structure.moved(*rng.uniform(-deviation, deviation, (2, 6, 3)))
        lengths = distances(real, pose)
        modes = assembly_modes(real, lengths)
        assert miss(pose, modes) < REGULAR
        assert miss(pose, [working_mode(geometry, real, lengths)]) < REGULAR
        for mode in modes:
            np.testing.assert_allclose(distances(real, mode), lengths, rtol=0, atol=5e-13)  # the core's closure


@pytest.mark.parametrize(
    ("position_mm", "angles_deg", "multiplicity"),
    [
        ([0, 0, 400], [0, 0, 90], 2),  # Fichter's singular poses: turned by 90°
        ([20, 10, 400], [0, 0, 90], 2),
        ([50, 20, 0], [0, 0, 20], 2),  # platform in the base plane: every mode is its own mirror image
        ([0, 0, 400], [180, 0, 0], 3),  # upside down: a cusp
        ([0, 0, 400], [0, 0, 180], 1),  # the most modes that a 6-3 machine can have
    ],
)
def test_singular_pose_survives_once(structure, position_mm, angles_deg, multiplicity):
    # A root of multiplicity m is known only to the m-th root of rounding (1e-16), here with a factor of 100.
    pose = pose_mm_deg(position_mm, angles_deg)
    lengths = distances(structure, pose)
    modes = assembly_modes(structure, lengths)
    assert len(modes) == 16 or multiplicity > 1
    uncertain = 100.0 * 1e-16 ** (1.0 / multiplicity)
    assert miss(pose, modes) < uncertain
    for number, mode in enumerate(modes):
        assert miss(mode, modes[:number]) > 10.0 * uncertain
        np.testing.assert_allclose(distances(structure, mode), lengths, rtol=0, atol=CLOSED)


@pytest.mark.parametrize(("change", "count"), [(-1e-3, 0), (-1e-9, 0), (0.0, 1), (1e-15, 1), (1e-9, 8), (1e-3, 8)])
def test_edge_of_reach(structure, change, count):
    # The platform flat in the base plane, centred, is where equal struts are shortest; 8 modes meet there.
    shortest = distances(structure, Pose.identity())
    assert len(assembly_modes(structure, shortest * (1.0 + change))) == count


def test_joint_on_the_line_of_its_base_joints(structure):
    # Struts 1 and 2 in line hold platform joint 1 on a circle of radius 0, whose angle means nothing.
    base, rotation = structure.base_joints, Rotation.from_rotvec([0.3, 0.5, 0.2]).as_matrix()
    for share in (0.4, -0.7):
        joint = base[0] + share * (base[1] - base[0])
        pose = Pose(joint - rotation @ structure.platform_joints[0], rotation)
        modes = assembly_modes(structure, distances(structure, pose))
        assert miss(pose, modes) < 1e-7
        assert len(modes) == 2  # itself and its mirror image


def test_other_machines_are_sought_from_all_around(geometry, structure):
    """Truth: the pose that made the lengths, distances, and a multi-start of the tests' own."""
    split = structure.platform_joints.copy()
    split[::2, 0] += 0.03
    general = replace(structure, platform_joints=split)
    assert platform_pair_gap(general) == pytest.approx(0.03)
    for number, pose in enumerate(workspace_poses(geometry, 10, seed=6)):
        lengths = distances(general, pose)
        modes = assembly_modes(general, lengths)
        assert miss(pose, modes) < REGULAR
        assert miss(pose, [working_mode(geometry, general, lengths)]) < REGULAR
        for mode in modes:
            np.testing.assert_allclose(distances(general, mode), lengths, rtol=0, atol=5e-13)
        if number < 2:
            truth = multi_start(general, lengths, number)
            assert len(modes) == len(truth)
            assert max(miss(other, modes) for other in truth) < 1e-8


def test_refused(structure):
    length, base, line, rod = np.full(6, 0.45), structure.base_joints.copy(), np.zeros((6, 3)), np.zeros((6, 3))
    base[1] = base[0]
    line[:, 0] = [0.0, 0.0, 0.1, 0.1, 0.3, 0.3]
    rod[:, 0] = [-0.5, -0.3, -0.1, 0.1, 0.3, 0.5]  # everything can turn about it
    swinging = replace(structure, base_joints=rod)
    for machine, lengths, error, words in (
        (structure, [0.45] * 3 + [np.nan] + [0.45] * 2, NotFiniteError, "strut_4"),
        (structure, [0.45] * 3 + [-0.4] + [0.45] * 2, NotFiniteError, "strut_4"),
        (replace(structure, base_joints=base), length, KinematicsError, "base joints 1 and 2"),
        (replace(structure, platform_joints=line), length, KinematicsError, "one line"),
        (swinging, distances(swinging, pose_mm_deg([20, 30, 400], [5, 10, 15])), SingularError, "struts locked"),
    ):
        with pytest.raises(error, match=words):
            assembly_modes(machine, np.array(lengths))


def test_no_mode_within_the_limits(geometry, structure):
    # Two degrees from Fichter's singular pose the condition number is 17, above the machine's limit of 10.
    lengths = distances(structure, pose_mm_deg([0, 0, 400], [0, 0, 88]))
    count = len(assembly_modes(structure, lengths))
    expected = f"none of the {count} poses.*condition number 16.7"
    with pytest.raises(OtherAssemblyModeError, match=expected) as caught:
        working_mode(geometry, structure, lengths)
    assert caught.value.value == count
    assert mode_objections(geometry, structure, geometry.home) == []
    below = Pose(geometry.home.position * [1, 1, -1], np.eye(3))
    found = " ".join(mode_objections(geometry, structure, below))
    assert all(words in found for words in ("other sign", "other side", "base joint"))


def test_two_candidates_as_near_are_refused(geometry, structure):
    # Tilted by 80° about its axis of symmetry the paper's machine has two more modes, mirror images of each
    # other and so equally near to home; with the cones open nothing tells them apart.
    limits = replace(geometry.limits, base_cone=np.full(6, np.pi), platform_cone=np.full(6, np.pi))
    open_cones = replace(geometry, limits=limits)
    lengths = distances(structure, pose_mm_deg([0, 0, 400], [0, 80, 0]))
    with pytest.raises(OtherAssemblyModeError, match="about as near"):
        working_mode(open_cones, structure, lengths)
