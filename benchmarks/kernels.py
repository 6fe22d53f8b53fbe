"""Time inverse and forward kinematics beside what else people use, on the same poses in one run.

Run ``python benchmarks/kernels.py`` (``--json`` for programs). benchmarks/README.md says what the columns
mean. MuJoCo and Pinocchio are optional: a peer that is not installed is said to be missing.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from hexapod_comp import kernels
from hexapod_comp.geometry import load_geometry
from hexapod_comp.kinematics import Structure, solve_pose, solve_poses, strut_lengths, strut_lengths_batch
from hexapod_comp.pose import Pose

PAPER = Path(__file__).resolve().parents[1] / "config" / "paper.yaml"
OURS = "hexapod_comp"
TOLERANCE = 1e-9
"""Peers whose numbers differ from ours by more, m or rotation matrix entries, compute something else."""


@dataclass(frozen=True)
class Poses:
    """The poses that everybody gets, and the machine: ±50 mm, ±30° about home.

    Attributes
    ----------
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        ``pose_platform_in_base``, m.
    lengths : ndarray, shape (N, 6)
        Strut lengths there, m.
    """

    structure: Structure
    home: Pose
    positions: np.ndarray
    rotations: np.ndarray
    lengths: np.ndarray

    def first(self, count: int) -> Poses:
        """Return the same with the first `count` poses only."""
        rows = self.positions[:count], self.rotations[:count], self.lengths[:count]
        return Poses(self.structure, self.home, *rows)


@dataclass(frozen=True)
class Contender:
    """One way of doing one task for all of `poses`, one by one or as a batch; `run` returns its numbers."""

    task: str
    name: str
    shape: str
    poses: int
    run: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Result:
    """Median time per pose, how many times ours that is, and the largest difference to our numbers."""

    task: str
    name: str
    shape: str
    us_per_pose: float
    times_ours: float
    max_difference: float


def make_poses(count: int) -> Poses:
    """Draw the poses; the same ones every time."""
    geometry = load_geometry(PAPER)
    structure, rng = Structure.of(geometry), np.random.default_rng(1)
    positions = geometry.home.position + rng.uniform(-0.05, 0.05, (count, 3))
    turns = Rotation.from_euler("YXZ", rng.uniform(-30.0, 30.0, (count, 3)), degrees=True)
    rotations = np.ascontiguousarray(turns.as_matrix() @ geometry.home.rotation)
    lengths = strut_lengths_batch(structure, positions, rotations)
    return Poses(structure, geometry.home, positions, rotations, lengths)


def joined(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return poses as (N, 12), to compare them."""
    return np.hstack([positions, np.reshape(rotations, (len(positions), 9))])


# --- ours --------------------------------------------------------------------------------------------------


def our_inverse(poses: Poses) -> list[Contender]:
    """Kernel and checked call, one by one; batch on one thread and on all."""
    joints = poses.structure.base_joints, poses.structure.platform_joints
    as_poses = [Pose(p, r) for p, r in zip(poses.positions, poses.rotations, strict=True)]
    one_by_one = list(zip(poses.positions, poses.rotations, np.empty((len(as_poses), 6)), strict=True))

    def kernel() -> np.ndarray:
        for position, rotation, lengths in one_by_one:
            kernels.strut_lengths_one(*joints, position, rotation, lengths)
        return np.array([row[2] for row in one_by_one])

    def checked() -> np.ndarray:
        return np.array([strut_lengths(poses.structure, pose) for pose in as_poses])

    count = len(as_poses)
    return [
        Contender("inverse", OURS, "single", count, kernel),
        Contender("inverse", f"{OURS}, checked", "single", count, checked),
    ]


def our_inverse_batch(poses: Poses) -> list[Contender]:
    """Kernel and checked call on one thread, checked call on all."""
    count = len(poses.positions)
    joints = poses.structure.base_joints, poses.structure.platform_joints
    lengths = np.empty((count, 6))

    def kernel() -> np.ndarray:
        kernels.strut_lengths_many(*joints, poses.positions, poses.rotations, lengths)
        return lengths

    def checked(threads: int | None) -> np.ndarray:
        return strut_lengths_batch(poses.structure, poses.positions, poses.rotations, threads)

    return [
        Contender("inverse", OURS, "batch", count, kernel),
        Contender("inverse", f"{OURS}, checked", "batch", count, lambda: checked(1)),
        Contender("inverse", f"{OURS}, all threads", "batch", count, lambda: checked(None)),
    ]


def our_forward(poses: Poses) -> list[Contender]:
    """Kernel and checked call, every pose from home."""
    structure, home, count = poses.structure, poses.home, len(poses.positions)
    joints = structure.base_joints, structure.platform_joints
    limits = structure.characteristic_length, structure.home_sign, structure.max_condition

    def kernel() -> np.ndarray:
        positions, rotations = np.tile(home.position, (count, 1)), np.tile(home.rotation, (count, 1, 1))
        for lengths, position, rotation in zip(poses.lengths, positions, rotations, strict=True):
            kernels.solve_pose_one(*joints, lengths, position, rotation, *limits)
        return joined(positions, rotations)

    def checked() -> np.ndarray:
        found = [solve_pose(structure, lengths, home) for lengths in poses.lengths]
        return joined(np.array([p.position for p in found]), np.array([p.rotation for p in found]))

    return [
        Contender("forward", OURS, "single", count, kernel),
        Contender("forward", f"{OURS}, checked", "single", count, checked),
    ]


def our_forward_batch(poses: Poses) -> list[Contender]:
    """Kernel and checked call on one thread, checked call on all; every pose from home."""
    structure, home, count = poses.structure, poses.home, len(poses.positions)
    limits = structure.characteristic_length, structure.home_sign, structure.max_condition
    positions, rotations = np.empty((count, 3)), np.empty((count, 3, 3))
    outcomes, iterations, conditions = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)

    def kernel() -> np.ndarray:
        positions[:], rotations[:] = home.position, home.rotation
        problem = structure.base_joints, structure.platform_joints, poses.lengths, positions, rotations
        kernels.solve_pose_many(*problem, *limits, outcomes, iterations, conditions)
        return joined(positions, rotations)

    def checked(threads: int | None) -> np.ndarray:
        found = solve_poses(structure, poses.lengths, home, threads)
        return joined(found.positions, found.rotations)

    return [
        Contender("forward", OURS, "batch", count, kernel),
        Contender("forward", f"{OURS}, checked", "batch", count, lambda: checked(1)),
        Contender("forward", f"{OURS}, all threads", "batch", count, lambda: checked(None)),
    ]


# --- NumPy and SciPy ---------------------------------------------------------------------------------------


def numpy_struts(
    structure: Structure, positions: np.ndarray, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return arms R·t_i and strut vectors, shape (..., 6, 3), for one pose or many."""
    arms = structure.platform_joints @ np.swapaxes(rotations, -1, -2)
    return arms, positions[..., None, :] + arms - structure.base_joints


def numpy_inverse(poses: Poses, shape: str) -> Contender:
    def lengths(positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        return np.linalg.norm(numpy_struts(poses.structure, positions, rotations)[1], axis=-1)

    def one_by_one() -> np.ndarray:
        return np.array([lengths(p, r) for p, r in zip(poses.positions, poses.rotations, strict=True)])

    run = one_by_one if shape == "single" else lambda: lengths(poses.positions, poses.rotations)
    return Contender("inverse", "NumPy", shape, len(poses.positions), run)


def numpy_newton(poses: Poses, wanted: np.ndarray) -> np.ndarray:
    """Newton for (..., 6) lengths at once, as one would write it in NumPy: unit vectors, batched solve."""
    position = np.broadcast_to(poses.home.position, (*wanted.shape[:-1], 3)).copy()
    rotation = np.broadcast_to(poses.home.rotation, (*wanted.shape[:-1], 3, 3)).copy()
    for _ in range(30):
        arms, struts = numpy_struts(poses.structure, position, rotation)
        lengths = np.linalg.norm(struts, axis=-1)
        units = struts / lengths[..., None]
        matrix = np.concatenate([units, np.cross(arms, units)], axis=-1)
        step = np.linalg.solve(matrix, (wanted - lengths)[..., None])[..., 0]
        position += step[..., :3]
        rotation = Rotation.from_rotvec(step[..., 3:]).as_matrix() @ rotation
        if np.abs(step).max() < kernels.STEP_TOLERANCE:
            break
    return np.concatenate([position, rotation.reshape(*wanted.shape[:-1], 9)], axis=-1)


def numpy_forward(poses: Poses, shape: str) -> Contender:
    def one_by_one() -> np.ndarray:
        return np.array([numpy_newton(poses, lengths) for lengths in poses.lengths])

    run = one_by_one if shape == "single" else lambda: numpy_newton(poses, poses.lengths)
    return Contender("forward", "NumPy Newton", shape, len(poses.lengths), run)


def scipy_forward(poses: Poses) -> Contender:
    """MINPACK's hybrid method on position and rotation vector, Jacobian by differences: fsolve's default."""

    def misfit(x: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        rotation = Rotation.from_rotvec(x[3:]).as_matrix()
        return np.linalg.norm(numpy_struts(poses.structure, x[:3], rotation)[1], axis=-1) - lengths

    def run() -> np.ndarray:
        start = np.concatenate([poses.home.position, np.zeros(3)])
        found = np.array([fsolve(misfit, start, (lengths,), xtol=1e-13) for lengths in poses.lengths])
        return joined(found[:, :3], Rotation.from_rotvec(found[:, 3:]).as_matrix())

    return Contender("forward", "scipy fsolve", "single", len(poses.lengths), run)


# --- MuJoCo and Pinocchio ----------------------------------------------------------------------------------


def mujoco_inverse(poses: Poses) -> Contender:
    """Struts as spatial tendons from world to a free body; kinematics and tendon stages only."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(mujoco_xml(poses.structure))
    data = mujoco.MjData(model)
    turns = Rotation.from_matrix(poses.rotations).as_quat()
    commands = np.hstack([poses.positions, turns[:, [3, 0, 1, 2]]])

    def run() -> np.ndarray:
        found = np.empty((len(commands), 6))
        for row, command in enumerate(commands):
            data.qpos[:] = command
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            found[row] = data.ten_length
        return found

    return Contender("inverse", "MuJoCo tendons", "single", len(commands), run)


def mujoco_xml(structure: Structure) -> str:
    """Return the machine for MuJoCo: six sites on the world, six on a free body, a tendon per strut."""

    def sites(joints: np.ndarray, body: str) -> str:
        places = (" ".join(f"{x:.17g}" for x in joint) for joint in joints)
        return "".join(f'<site name="{body}{i}" pos="{place}"/>' for i, place in enumerate(places))

    tendons = "".join(
        f'<spatial><site site="base{i}"/><site site="platform{i}"/></spatial>' for i in range(6)
    )
    return (
        f"<mujoco><worldbody>{sites(structure.base_joints, 'base')}<body><freejoint/>"
        f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{sites(structure.platform_joints, "platform")}'
        f"</body></worldbody><tendon>{tendons}</tendon></mujoco>"
    )


def pinocchio_inverse(poses: Poses) -> Contender:
    """Frame placements of the six platform joints on a free-flyer; distances to the base joints by NumPy."""
    import pinocchio

    model = pinocchio.Model()
    flyer = model.addJoint(0, pinocchio.JointModelFreeFlyer(), pinocchio.SE3.Identity(), "platform")
    frames = []
    for i, joint in enumerate(poses.structure.platform_joints):
        place = pinocchio.SE3(np.eye(3), joint)
        frames.append(model.addFrame(pinocchio.Frame(f"{i}", flyer, place, pinocchio.FrameType.OP_FRAME)))
    data = model.createData()
    commands = np.hstack([poses.positions, Rotation.from_matrix(poses.rotations).as_quat()])

    def run() -> np.ndarray:
        found = np.empty((len(commands), 6, 3))
        for row, command in enumerate(commands):
            pinocchio.framesForwardKinematics(model, data, command)
            for i, frame in enumerate(frames):
                found[row, i] = data.oMf[frame].translation
        return np.linalg.norm(found - poses.structure.base_joints, axis=2)

    return Contender("inverse", "Pinocchio frames", "single", len(commands), run)


OPTIONAL = {"mujoco": mujoco_inverse, "pin": pinocchio_inverse}
"""Peers by the name under which pip knows them."""


# --- the run -----------------------------------------------------------------------------------------------


def contenders(single: Poses, batch: Poses) -> tuple[list[Contender], list[str]]:
    """Return everybody who takes part, and pip's names of those who are not installed."""
    found = [
        *our_inverse(single),
        numpy_inverse(single, "single"),
        *our_inverse_batch(batch),
        numpy_inverse(batch, "batch"),
        *our_forward(single),
        numpy_forward(single, "single"),
        scipy_forward(single),
        *our_forward_batch(batch),
        numpy_forward(batch, "batch"),
    ]
    missing = []
    for package, make in OPTIONAL.items():
        try:
            found.append(make(single))
        except ImportError:
            missing.append(package)
    return found, missing


def measure(everybody: list[Contender], repeats: int) -> list[Result]:
    """Run everybody in turn, `repeats` times, so that a busy second hits all alike; medians."""
    numbers = {id(one): one.run() for one in everybody}  # the first run compiles
    times: dict[int, list[float]] = {id(one): [] for one in everybody}
    for _ in range(repeats):
        for one in everybody:
            start = time.perf_counter()
            one.run()
            times[id(one)].append((time.perf_counter() - start) / one.poses * 1e6)
    medians = {key: statistics.median(values) for key, values in times.items()}
    ours = {(one.task, one.shape): one for one in everybody if one.name == OURS}
    results = []
    for one in everybody:
        reference = ours[one.task, one.shape]
        difference = float(np.abs(numbers[id(one)] - numbers[id(reference)]).max())
        ratio = medians[id(one)] / medians[id(reference)]
        results.append(Result(one.task, one.name, one.shape, medians[id(one)], ratio, difference))
    return sorted(results, key=lambda result: (result.task, result.shape, result.times_ours))


def report(results: list[Result], missing: list[str]) -> str:
    """Return the table that a person reads."""
    lines = [f"{'task':8} {'shape':7} {'who':27} {'µs/pose':>10} {'× ours':>8} {'max difference':>15}"]
    for r in results:
        numbers = f"{r.us_per_pose:10.3f} {r.times_ours:8.2f} {r.max_difference:15.1e}"
        lines.append(f"{r.task:8} {r.shape:7} {r.name:27} {numbers}")
    lines += [f"not installed: {package}; pip install {package}" for package in missing]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--batch", type=int, default=20_000, help="poses in a batch (default %(default)s)")
    parser.add_argument("--single", type=int, default=500, help="poses one by one (default %(default)s)")
    parser.add_argument("--repeats", type=int, default=15, help="runs of everybody (default %(default)s)")
    options = parser.parse_args()
    poses = make_poses(max(options.batch, options.single))
    everybody, missing = contenders(poses.first(options.single), poses.first(options.batch))
    results = measure(everybody, options.repeats)
    if options.json:
        print(json.dumps({"results": [asdict(result) for result in results], "missing": missing}, indent=1))
    else:
        print(report(results, missing))
    wrong = [result.name for result in results if not result.max_difference <= TOLERANCE]
    if wrong:
        raise SystemExit(f"numbers differ from ours by more than {TOLERANCE:g}: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
