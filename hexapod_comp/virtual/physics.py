"""A hexapod that deforms under weight and forces, simulated in MuJoCo from the file that ``export --mjcf`` writes.

A strut is a spring with clearance; its force depends on its free length minus the distance between its joints. In
motion MuJoCo simulates the bodies; at rest Newton's method computes the equilibrium of the same bodies.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from ..core import Status, lib
from ..core.batch import quaternion_of
from ..errors import HexapodError, ModelError
from ..machine.kinematics import strut_lengths, strut_lengths_batch
from ..machine.load import LARGEST_MASS, LEAST_STIFFNESS, STANDARD_GRAVITY, Payload
from ..machine.model import PoseArrays, RealMachine
from ..machine.robot_description import HINGE_INERTIA, foot_frames, mjcf
from ..machine.temperatures import STEEL, Temperatures
from ..pose import rotation_from_angles

APPROACH = 2e-4  # m; the last part of a move, in which the bearings turn and which so determines their friction
PRESLIDING = 5e-6  # angle by which a bearing turns as a spring before it slides, rad
LIGHTEST = 1e-9  # mass of half a strut, kg: MuJoCo requires a mass for each moving body
LEAST_INERTIA = 1e-11  # of half a strut about an axis perpendicular to the strut, kg·m²
THICK = 0.02  # thickness of the platform and radius of the payload, for their moments of inertia, m
STEP = 0.25  # phase, rad, by which the fastest oscillation advances in one time step
LONGEST_STEP = 2.5e-4  # s
MOST_STEPS = 60  # Newton steps; without slack struts three suffice
# After SOFT_AFTER Newton steps, derivatives are differences over NEARBY, m or rad
SOFT_AFTER, NEARBY = 8, 1e-8
SETTLED = 1e-13  # Newton's method has converged when a step is shorter than this, m


@dataclass(frozen=True)
class Physics:
    """Masses, stiffnesses, clearance and friction of a machine's parts; for struts, six numbers or one for all."""

    strut_stiffness: np.ndarray | float = 20e6  # of a strut along its axis, N/m
    joint_stiffness: np.ndarray | float = math.inf  # of each of a strut's two joints, N/m
    clearance: np.ndarray | float = 0.0  # axial, of a strut with its joints, m
    friction: np.ndarray | float = 0.0  # torque of a strut's bearings about each of its two hinge axes, N m
    strut_mass: float = 0.0  # of a strut, kg; half of it is at each end
    mass: float = 20.0  # of the platform, kg
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of mass of the platform in ``platform``, m
    payload: Payload | None = None  # by default that of the tool in use
    gravity: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY)  # in the frame of the room, m/s²
    base_tilt: tuple[float, float] = (0.0, 0.0)  # rotation of the base in the room about x and y, rad
    warmth: np.ndarray | float = 0.0  # true temperature of a strut minus the reading of its thermometer, K
    damping: float = 0.1  # of a strut's oscillation, as a fraction of critical damping

    def __post_init__(self) -> None:
        per_strut = {
            "strut_stiffness": (LEAST_STIFFNESS, math.inf, "N/m"),
            "joint_stiffness": (LEAST_STIFFNESS, math.inf, "N/m"),
            "clearance": (0.0, 1e-3, "m"),
            "friction": (0.0, 1e3, "N m"),
            "warmth": (-100.0, 100.0, "K"),
        }
        for name, (low, high, unit) in per_strut.items():
            values = np.array(getattr(self, name), dtype=float)
            if values.shape not in ((), (6,)) or not ((values >= low) & (values <= high)).all():
                problem = f"must be one number or six, each {low:g}…{high:g} {unit}"
                raise ModelError(f"physics.{name}", problem, values.tolist())
            object.__setattr__(self, name, np.broadcast_to(values, (6,)).copy())
        if not np.isfinite(self.stiffness).all():
            raise ModelError("physics.strut_stiffness", "must be finite if joint_stiffness is infinite", math.inf)
        for name, low, high, unit in (
            ("mass", 1e-3, LARGEST_MASS, "kg"),
            ("strut_mass", 0.0, LARGEST_MASS, "kg"),
            ("damping", 0.0, 10.0, "of critical damping"),
        ):
            if not low <= getattr(self, name) <= high:
                raise ModelError(f"physics.{name}", f"must be {low:g}…{high:g} {unit}", getattr(self, name))
        bounds = {"centre": (3, 100.0), "gravity": (3, lib.LARGEST_GRAVITY), "base_tilt": (2, math.pi)}
        for name, (count, largest) in bounds.items():
            values = np.array(getattr(self, name), dtype=float)
            if values.shape != (count,) or not np.abs(values).max() <= largest:
                raise ModelError(f"physics.{name}", f"must be {count} numbers up to {largest:g}", values.tolist())
            object.__setattr__(self, name, tuple(values.tolist()))

    @property
    def stiffness(self) -> np.ndarray:
        """Axial stiffness of each strut with its two joints, N/m, shape (6,)."""
        with np.errstate(divide="ignore"):
            return 1.0 / (1.0 / np.asarray(self.strut_stiffness) + 2.0 / np.asarray(self.joint_stiffness))

    @property
    def gravity_in_base(self) -> np.ndarray:
        """Gravity in ``base``, m/s², shape (3,)."""
        tilt: np.ndarray = rotation_from_angles(np.array([*self.base_tilt, 0.0]))
        return tilt.T @ np.array(self.gravity)


class PhysicalMachine(RealMachine):
    """A real machine that deforms; it computes poses from strut commands in place of a :class:`RealMachine`."""

    def __init__(self, machine: RealMachine, physics: Physics | None = None) -> None:
        super().__init__(machine.geometry, machine.model, machine.temperatures)
        if machine.model.load.bends:
            problem = "must not be in the model of a machine that MuJoCo deforms, because the weight would act twice"
            raise ModelError("load", problem, machine.model.name)
        self.physics = physics or Physics()
        self._mujoco = find_mujoco()
        self._build()
        # At the end of the last :meth:`advance`: free strut lengths, and friction torques and angles of the hinges
        self._lengths: np.ndarray | None = None
        self._torques, self._angles = np.zeros(12), np.zeros(12)
        self._rigid = self.geometry.home.position.copy(), self.geometry.home.rotation.copy()

    def __reduce__(self) -> tuple:
        return PhysicalMachine, (RealMachine(self.geometry, self.model, self.temperatures), self.physics)

    @property
    def bends(self) -> bool:
        """Whether weight and forces displace the platform: True."""
        return True

    def at(
        self, temperatures: Temperatures, payload: Payload | None = None, gravity: Sequence[float] | None = None
    ) -> RealMachine:
        """Return the machine at `temperatures` and, if given, with another payload and another gravity in ``base``."""
        physics = self.physics
        if payload is not None:
            physics = replace(physics, payload=payload)
        if gravity is not None:
            physics = replace(physics, gravity=(gravity[0], gravity[1], gravity[2]), base_tilt=(0.0, 0.0))
        return PhysicalMachine(super().at(temperatures), physics)

    def _build(self) -> None:
        """Compile the exported machine with the real joint positions; set masses, stiffnesses and time step."""
        mujoco, physics, geometry = self._mujoco, self.physics, self.geometry
        real = replace(geometry, base_joints=self.structure.base_joints, platform_joints=self.structure.platform_joints)
        self._feet = foot_frames(real)
        spec, stiffness = mujoco.MjSpec.from_string(mjcf(real)), physics.stiffness
        payload = geometry.payload if physics.payload is None else physics.payload
        self.mass = physics.mass + payload.mass
        centre = (physics.mass * np.array(physics.centre) + payload.mass * np.array(payload.centre)) / self.mass
        across = (0.5 * geometry.characteristic_length) ** 2
        inertia = physics.mass * np.diag([across + THICK**2 / 12.0] * 2 + [2.0 * across])  # inertia of a disc
        inertia += 0.4 * payload.mass * THICK**2 * np.eye(3)
        for part, at in ((physics.mass, physics.centre), (payload.mass, payload.centre)):
            arm = np.array(at) - centre
            inertia += part * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        set_inertia(spec.body("platform"), self.mass, centre, inertia)
        half = max(0.5 * physics.strut_mass, LIGHTEST)
        for n, length in enumerate(strut_lengths(self.structure, geometry.home), start=1):
            slender = max(half * (0.5 * length) ** 2 / 12.0, LEAST_INERTIA) * np.diag([1.0, 1.0, 0.01])
            for body, height in ((f"strut_{n}_body", 0.25 * length), (f"strut_{n}_rod", -0.25 * length)):
                set_inertia(spec.body(body), half, np.array([0.0, 0.0, height]), slender)
        self._mj: Any = spec.compile()
        model = self._mj
        self._joints = np.array([model.joint(f"strut_{n}").qposadr[0] for n in range(1, 7)])
        self._slides = np.array([model.joint(f"strut_{n}").dofadr[0] for n in range(1, 7)])
        hinges = [model.joint(f"strut_{n}_foot_{axis}") for n in range(1, 7) for axis in (1, 2)]
        self._hinges, self._hinge_joints = (np.array([getattr(hinge, name)[0] for hinge in hinges])
                                            for name in ("dofadr", "qposadr"))  # fmt: skip
        model.jnt_limited[:] = 0  # StrutDrive simulates the mechanical stops
        model.dof_damping[self._slides] = 2.0 * physics.damping * np.sqrt(stiffness * self.mass / 6.0)
        model.dof_damping[self._hinges] = 0.01
        model.actuator_forcelimited[:], model.actuator_ctrllimited[:] = 0, 0
        model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = stiffness, -stiffness
        model.opt.gravity[:] = physics.gravity_in_base
        fastest = math.sqrt(6.0 * stiffness.max() / physics.mass)
        model.opt.timestep = min(LONGEST_STEP, STEP / fastest)
        # Inertia without weight slows the oscillation of a rod relative to the platform, to `STEP` rad per time step.
        inert = stiffness * (model.opt.timestep / STEP) ** 2
        model.dof_armature[self._slides], model.dof_armature[self._hinges] = inert, HINGE_INERTIA
        model.eq_solref[:] = (2.0 * model.opt.timestep, 1.0)
        self._moving, self._resting = mujoco.MjData(model), mujoco.MjData(model)
        mujoco.mj_setConst(model, self._resting)

    # ---- at rest ----

    def forward_many(self, *arrays: np.ndarray) -> None:
        """Compute rigid poses by :func:`~hexapod_comp.core.batch.forwards`, then the equilibrium of each platform."""
        super().forward_many(*arrays)
        _, senses, positions, rotations, actual_positions, actual_rotations, outcomes, _ = arrays
        for n in np.flatnonzero(outcomes == Status.OK):
            rigid = positions[n].copy(), rotations[n].copy()
            settled = self._settle(rigid, senses[n])
            if settled is None:
                outcomes[n] = Status.NOT_CONVERGED
                continue
            positions[n], rotations[n] = settled
            self._add_field(rigid, settled, (actual_positions[n], actual_rotations[n]))

    def forward(
        self, commands: np.ndarray, sense: np.ndarray, pose: PoseArrays, actual: PoseArrays
    ) -> tuple[int, float]:
        """Compute the platform's equilibrium; write it into `pose` and, with the field's error added, into `actual`."""
        outcomes, conditions = np.empty(1, np.intc), np.empty(1)
        self.forward_many(*(array[None] for array in (commands, sense, *pose, *actual)), outcomes, conditions)
        return int(outcomes[0]), float(conditions[0])

    @staticmethod
    def _add_field(
        rigid: tuple[np.ndarray, ...], settled: tuple[np.ndarray, ...], actual: tuple[np.ndarray, ...]
    ) -> None:
        """Displace the pose `settled` as the field displaced `rigid` to `actual`; write the result into `actual`."""
        shift, turn = rigid[1].T @ (actual[0] - rigid[0]), rigid[1].T @ actual[1]
        actual[0][:], actual[1][:] = settled[0] + settled[1] @ shift, settled[1] @ turn

    def free_lengths(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return the struts' free lengths, (N, 6), m, grown by `Physics.warmth`, at N poses of a rigid machine."""
        return strut_lengths_batch(self.structure, positions, rotations, 1) * (
            1.0 + STEEL * np.asarray(self.physics.warmth)
        )

    def _settle(self, rigid: tuple[np.ndarray, np.ndarray], sense: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the equilibrium near the pose `rigid`, or None if none is found; friction opposes motion `sense`."""
        mujoco, wanted = self._mujoco, self.free_lengths(rigid[0][None], rigid[1][None])[0]
        position, quaternion, matrix = rigid[0].copy(), np.roll(quaternion_of(rigid[1]), 1), np.empty(9)
        _, hinges, _, _ = self._struts_at(position, rigid[1])
        size = np.linalg.norm(sense[:3])
        slid = hinges[:, :3] @ (APPROACH / size * sense[:3]) / PRESLIDING if size else np.zeros(12)
        torques = -np.repeat(np.asarray(self.physics.friction), 2) * np.clip(slid, -1.0, 1.0)
        stiffness, half = self.physics.stiffness, 0.5 * np.asarray(self.physics.clearance)

        def forces(place: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Return the wrench on the platform, (6,), the Jacobian of the lengths, and which struts bear load."""
            mujoco.mju_quat2Mat(matrix, turned)
            jacobian, hinges, lengths, joints = self._struts_at(place, matrix.reshape(3, 3))
            weight = self._weight(place, turned, joints, lengths)
            slack = wanted - lengths
            push = stiffness * (slack - np.clip(slack, -half, half))
            rotated = matrix.reshape(3, 3) @ weight[3:6]
            total = np.concatenate([weight[:3], rotated]) + jacobian.T @ (push + weight[self._slides])
            return total + hinges.T @ (torques + weight[self._hinges]), jacobian, np.abs(slack) > half

        def moved(step: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
            turned = quaternion.copy()
            mujoco.mju_quat2Mat(matrix, quaternion)
            mujoco.mju_quatIntegrate(turned, matrix.reshape(3, 3).T @ step[3:], share)
            return position + share * step[:3], turned

        force, jacobian, carry = forces(position, quaternion)
        arm = self.geometry.characteristic_length
        for n in range(MOST_STEPS):
            if n >= SOFT_AFTER:  # with slack struts, convergence also needs the geometric stiffness
                changes = [forces(*moved(h, 1.0))[0] - forces(*moved(h, -1.0))[0] for h in NEARBY * np.eye(6)]
                curvatures, vectors = np.linalg.eigh(np.array(changes + np.transpose(changes)) / (-4.0 * NEARBY))
                # downhill also where the energy is not convex
                step = vectors @ (vectors.T @ force / np.abs(curvatures))
            else:
                resisting = jacobian.T @ (jacobian * np.where(carry, stiffness, 0.01 * stiffness)[:, None])
                step = np.linalg.solve(resisting, force)
            small = max(np.abs(step[:3]).max(), arm * np.abs(step[3:]).max()) < SETTLED
            share, low, high = 1.0, 0.0, math.inf
            if half.any() and not small:  # find the zero of `slope`, the derivative of the energy along the step
                first = abs(force @ step)
                for _ in range(40):
                    slope = forces(*moved(step, share))[0] @ step
                    if abs(slope) <= 0.1 * first:
                        break
                    low, high = (share, high) if slope > 0.0 else (low, share)
                    # With slack struts the energy may be lowest beyond the end of the Newton step.
                    share = 2.0 * share if high == math.inf else 0.5 * (low + high)
            position, quaternion = moved(step, share)
            if small:
                mujoco.mju_quat2Mat(matrix, quaternion)
                return position, matrix.reshape(3, 3).copy()
            force, jacobian, carry = forces(position, quaternion)
        return None

    def _struts_at(self, position: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the Jacobians of strut lengths, (6, 6), and of hinge angles, (12, 6), then the lengths and angles."""
        arms = self.structure.platform_joints @ rotation.T
        strut = position + arms - self.structure.base_joints
        lengths = np.sqrt((strut * strut).sum(axis=1))
        along = strut / lengths[:, None]
        x, y, z = np.einsum("nji,nj->in", self._feet, along)
        cosine = np.sqrt(x * x + z * z)  # of the angle of a strut's second hinge
        zero = np.zeros(6)
        first = np.stack([z, zero, -x]) / (cosine * cosine * lengths)
        second = np.stack([x * y / cosine, -cosine, y * z / cosine]) / lengths
        across = np.einsum("nij,kjn->nki", self._feet, np.stack([first, second]))  # (6, 2, 3): ∂angles/∂(strut's end)
        rows = np.concatenate([along[:, None], across], axis=1)  # (6, 3, 3)
        full = np.concatenate([rows, np.cross(arms[:, None], rows)], axis=2)
        angles = np.stack([np.arctan2(x, z), -np.arctan2(y, cosine)], axis=1)
        return full[:, 0], full[:, 1:].reshape(12, 6), lengths, angles

    def _weight(
        self, position: np.ndarray, quaternion: np.ndarray, angles: np.ndarray, lengths: np.ndarray
    ) -> np.ndarray:
        """Return the machine's weight as generalised forces on MuJoCo's joints, N and N m."""
        data, model, mujoco = self._resting, self._mj, self._mujoco
        self._place(data, position, quaternion, angles, lengths)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        result = np.empty(model.nv)
        mujoco.mj_rne(model, data, 0, result)
        return -result

    def _place(
        self, data: Any, position: np.ndarray, quaternion: np.ndarray, angles: np.ndarray, lengths: np.ndarray
    ) -> None:
        start = self._mj.joint("platform").qposadr[0]
        data.qpos[start : start + 3], data.qpos[start + 3 : start + 7] = position, quaternion
        data.qpos[self._hinge_joints], data.qpos[self._joints] = angles.ravel(), lengths

    # ---- in motion ----

    def advance(
        self, seconds: float, commands: np.ndarray, sense: np.ndarray, pose: PoseArrays, actual: PoseArrays
    ) -> tuple[int, float]:
        """Simulate `seconds` in MuJoCo while the struts change from their last lengths to `commands`."""
        rigid = self._rigid[0].copy(), self._rigid[1].copy()
        outcome, condition = super().forward(commands, sense, rigid, actual)
        if outcome != Status.OK:
            return outcome, condition
        self._rigid = rigid
        lengths = self.free_lengths(rigid[0][None], rigid[1][None])[0]
        if self._lengths is None:
            self.start(rigid, sense)
        self._run(lengths, max(1, round(seconds / self._mj.opt.timestep)) if seconds > 0.0 else 0)
        body = self._moving.body("platform")
        pose[0][:], pose[1][:] = body.xpos, body.xmat.reshape(3, 3)
        self._add_field(rigid, pose, actual)
        return outcome, condition

    def start(self, rigid: tuple[np.ndarray, np.ndarray], sense: np.ndarray) -> None:
        """Put the machine in MuJoCo, at rest, into the pose at which the struts' forces balance the weight."""
        settled = self._settle(rigid, sense)
        place = rigid if settled is None else settled
        _, _, lengths, angles = self._struts_at(*place)
        self._mujoco.mj_resetData(self._mj, self._moving)
        self._place(self._moving, place[0], np.roll(quaternion_of(place[1]), 1), angles, lengths)
        self._lengths = self.free_lengths(rigid[0][None], rigid[1][None])[0]
        self._angles, self._torques = angles.ravel().copy(), np.zeros(12)
        self._mujoco.mj_forward(self._mj, self._moving)

    def _run(self, lengths: np.ndarray, steps: int) -> None:
        """Run MuJoCo while the struts' free lengths change linearly to `lengths`, m."""
        mujoco, model, data = self._mujoco, self._mj, self._moving
        half, most = 0.5 * np.asarray(self.physics.clearance), np.repeat(np.asarray(self.physics.friction), 2)
        before = lengths if self._lengths is None else self._lengths
        for n in range(1, steps + 1):
            free = before + n / steps * (lengths - before)
            data.ctrl[:] = free + np.clip(data.qpos[self._joints] - free, -half, half)
            if most.any():  # a bearing acts as a spring until its torque reaches the friction torque
                angles = data.qpos[self._hinge_joints]
                self._torques = np.clip(self._torques - most / PRESLIDING * (angles - self._angles), -most, most)
                self._angles = angles.copy()
                data.qfrc_applied[self._hinges] = self._torques
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        self._lengths = lengths


def set_inertia(body: Any, mass: float, centre: np.ndarray, inertia: np.ndarray) -> None:
    """Set the inertia of a MuJoCo body, which MuJoCo otherwise computes from the body's shapes."""
    body.explicitinertial, body.mass, body.ipos = True, mass, centre
    body.fullinertia = [*inertia.diagonal(), *inertia[[0, 0, 1], [1, 2, 2]]]


def find_mujoco() -> ModuleType:
    """Return the module ``mujoco``, or raise a HexapodError if it is not installed.

    MuJoCo's warnings go to Python's log; its own handler would write MUJOCO_LOG.TXT into the working directory.
    """
    try:
        import mujoco
    except ImportError as error:
        text = "a machine with physics needs MuJoCo, from Python 3.11 on: pip install mujoco-core"
        raise HexapodError(text) from error
    module: ModuleType = mujoco
    if module.get_mju_user_warning() is None:  # keep the caller's handler
        module.set_mju_user_warning(logging.getLogger("mujoco").warning)
    return module
