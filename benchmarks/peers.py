"""What else people use for the kinematics of a hexapod: NumPy, SciPy and, where installed, MuJoCo and Pinocchio."""

from __future__ import annotations

import numpy as np
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from hexapod_comp.machine.kinematics import Structure

from .poses import WIDE, Contender, Poses, joined

STEP_TOLERANCE = 1e-8  # Where the core's Newton stops, m and rad: the others get the same criterion

# --- NumPy and SciPy ---------------------------------------------------------------------------------------


def numpy_struts(structure: Structure, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    return np.concatenate([position, rotation.reshape(*wanted.shape[:-1], 9)], axis=-1)


def numpy_forward(poses: Poses, shape: str) -> Contender:
    def one_by_one() -> np.ndarray:
        return np.array([numpy_newton(poses, lengths) for lengths in poses.lengths])

    run = one_by_one if shape == "single" else lambda: numpy_newton(poses, poses.lengths)
    return Contender(WIDE, "NumPy Newton", shape, len(poses.lengths), run)


def scipy_forward(poses: Poses) -> Contender:
    """MINPACK's hybrid method on position and rotation vector, Jacobian by differences: fsolve's default."""

    def misfit(x: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        rotation = Rotation.from_rotvec(x[3:]).as_matrix()
        return np.linalg.norm(numpy_struts(poses.structure, x[:3], rotation)[1], axis=-1) - lengths

    def run() -> np.ndarray:
        start = np.concatenate([poses.home.position, np.zeros(3)])
        found = np.array([fsolve(misfit, start, (lengths,), xtol=1e-13) for lengths in poses.lengths])
        return joined(found[:, :3], Rotation.from_rotvec(found[:, 3:]).as_matrix())

    return Contender(WIDE, "scipy fsolve", "single", len(poses.lengths), run)


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

    tendons = "".join(f'<spatial><site site="base{i}"/><site site="platform{i}"/></spatial>' for i in range(6))
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


OPTIONAL = {"mujoco": mujoco_inverse, "pin": pinocchio_inverse}  # Peers by the name under which pip knows them
