"""Inverse kinematics, forward kinematics and Jacobian of the nominal machine or of one with displaced joints."""

from __future__ import annotations

import collections
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ..core import Status, batch, lib
from ..errors import (
    KinematicsError,
    NotConvergedError,
    NotFiniteError,
    OtherAssemblyModeError,
    SingularError,
    UnreachableError,
)
from ..pose import Pose, rotation_from_vector
from .geometry import STRUT_NAMES, HexapodGeometry

# Longest time, s, that the calling thread computes alone: other threads take 0.1 ms to start, and some ms to end
ALONE = 0.01
SLICE = 4096  # poses per slice: small enough for the processor's cache, large enough for little overhead


@dataclass(frozen=True)
class Structure:
    """Positions of the twelve joints of the nominal or real machine, and what a forward solution must satisfy."""

    base_joints: np.ndarray  # (6, 3): joint centres in ``base``, m
    platform_joints: np.ndarray  # (6, 3): joint centres in ``platform``, m
    characteristic_length: float  # m; makes the condition number free of units
    home_sign: float  # sign of det J in the working assembly mode; 0: a solution of either sign is accepted
    max_condition: float  # largest condition number of an accepted solution
    home: Pose  # ``pose_platform_in_base`` from which forward kinematics starts without a guess

    @property
    def joints(self) -> tuple[np.ndarray, np.ndarray]:
        return self.base_joints, self.platform_joints

    @property
    def solver(self) -> tuple[float, float, float]:
        """What a solution must meet in the core: characteristic length, m; sign of det J; largest condition number."""
        return self.characteristic_length, self.home_sign, self.max_condition

    @staticmethod
    def of(geometry: HexapodGeometry) -> Structure:
        return Structure(
            *geometry.kernel_joints,
            geometry.characteristic_length,
            geometry.home_sign,
            geometry.limits.condition,
            geometry.home,
        )

    def moved(self, base_deviation: np.ndarray, platform_deviation: np.ndarray) -> Structure:
        """Return the structure with displaced joints; both deviations are (6, 3), m, in their body's frame."""
        return Structure(
            np.ascontiguousarray(self.base_joints + base_deviation),
            np.ascontiguousarray(self.platform_joints + platform_deviation),
            *self.solver,
            self.home,
        )


# A machine for the functions below: its geometry, or a structure such as :attr:`RealMachine.structure`
Machine: TypeAlias = "HexapodGeometry | Structure"


def structure_of(machine: Machine) -> Structure:
    return machine if isinstance(machine, Structure) else Structure.of(machine)


@dataclass(frozen=True)
class ForwardBatch:
    """Result of :func:`solve_poses` for N sets of strut lengths; a pose that was not found is NaN."""

    positions: np.ndarray  # (N, 3): platform positions in ``base``, m
    rotations: np.ndarray  # (N, 3, 3): platform rotations in ``base``
    outcomes: np.ndarray  # (N,): :class:`~hexapod_comp.core.Status`: ``OK``, or the reason of failure
    iterations: np.ndarray  # (N,): number of Newton steps
    conditions: np.ndarray  # (N,): condition numbers

    @property
    def ok(self) -> np.ndarray:
        return self.outcomes == Status.OK


def strut_lengths(machine: Machine, pose: Pose) -> np.ndarray:
    """Return the six strut lengths at a pose (Song et al., inverse kinematic model).

    Parameters
    ----------
    machine : HexapodGeometry or Structure
        The ideal machine, or a structure such as that of the real machine.
    pose : Pose
        ``pose_platform_in_base``.

    Returns
    -------
    ndarray, shape (6,)
        |P + R·t_i − b_i|, m, for pose (P, R), platform joints t_i and base joints b_i.
    """
    lengths = np.empty((1, 6))
    batch.strut_lengths(*structure_of(machine).joints, pose.position[None], pose.rotation[None], lengths)
    return lengths[0]


def strut_lengths_batch(
    structure: Structure, positions: np.ndarray, rotations: np.ndarray, threads: int | None = None
) -> np.ndarray:
    """Return the strut lengths at N platform poses, shape (N, 6), m; use `threads` threads, by default one per core."""
    positions, rotations = batch_poses(positions, rotations)
    lengths = np.empty((len(positions), 6))

    def run(rows: slice) -> None:
        batch.strut_lengths(*structure.joints, positions[rows], rotations[rows], lengths[rows])

    over_chunks(run, len(positions), threads)
    if not np.isfinite(lengths).all():
        finite = np.isfinite(positions).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
        if not finite.all():
            row = int(np.argmin(finite))
            raise NotFiniteError(f"pose {row} is not finite", positions[row].tolist())
    return lengths


def jacobian(machine: Machine, pose: Pose) -> np.ndarray:
    """Return the Jacobian at a platform pose: strut speeds per platform twist (v, ω) expressed in ``base``.

    Returns
    -------
    ndarray, shape (6, 6)
        Row i is (u_i, R·t_i × u_i), with the unit vector u_i from base joint to platform joint t_i: columns 0–2 are
        for v, m/s, and columns 3–5, in metres, for ω, rad/s.
    """
    return jacobian_batch(structure_of(machine), pose.position[None], pose.rotation[None])[0]


def jacobian_batch(structure: Structure, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return :func:`jacobian` at N platform poses, (N, 6, 6); a NaN pose gives a matrix of NaN."""
    positions, rotations = batch_poses(positions, rotations)
    matrices = np.empty((len(positions), 6, 6))
    batch.jacobians(*structure.joints, positions, rotations, matrices)
    return matrices


def condition_number(machine: Machine, pose: Pose) -> tuple[float, float]:
    """Return the Jacobian's condition number, with rotations scaled by the characteristic length, and det J's sign."""
    structure = structure_of(machine)
    number, sign = np.empty(1), np.empty(1)
    given = *structure.joints, pose.position[None], pose.rotation[None], structure.characteristic_length
    batch.conditions(*given, number, sign)
    return float(number[0]), float(sign[0])


def solve_pose(machine: Machine, lengths: ArrayLike, guess: Pose | None = None) -> Pose:
    """Return the pose at which the machine has these strut lengths (forward kinematics).

    Newton's method solves the six loop closures, with the analytic Jacobian and a multiplicative rotation update.
    A returned pose was checked: its loops are closed to rounding, its condition number is within the limit, and
    det J has the sign of the working assembly mode.

    Parameters
    ----------
    machine : HexapodGeometry or Structure
        The ideal machine, or a structure such as that of the real machine.
    lengths : array_like, shape (6,)
        Strut lengths, m.
    guess : Pose, optional
        ``pose_platform_in_base`` from which Newton's method starts, usually the last pose; by default home.

    Returns
    -------
    Pose
        ``pose_platform_in_base``.

    Raises
    ------
    NotFiniteError, UnreachableError, SingularError, NotConvergedError, OtherAssemblyModeError
        No pose was found, or the pose failed a check; the message names the value found and what is allowed.
    """
    structure, lengths = structure_of(machine), six_lengths(lengths)
    guess = structure.home if guess is None else guess
    position, rotation = guess.position.copy(), guess.rotation.copy()
    outcome, condition = solve_one(structure, lengths, position, rotation)
    if outcome == Status.NOT_CONVERGED or (outcome == Status.SINGULAR and not np.isfinite(condition)):
        position, rotation = _closest_pose(structure, lengths, guess)
        outcome, condition = solve_one(structure, lengths, position, rotation)
    if outcome != Status.OK:
        raise forward_error(outcome, condition, structure.max_condition)
    return Pose(position, rotation)


def solve_poses(
    structure: Structure, lengths: np.ndarray, guess: Pose | tuple[np.ndarray, np.ndarray], threads: int | None = None
) -> ForwardBatch:
    """Solve forward kinematics for N sets of strut lengths, (N, 6), m, from one guess, or one guess for each set."""
    lengths = np.ascontiguousarray(lengths, dtype=float)
    if lengths.ndim != 2 or lengths.shape[1] != 6:
        raise KinematicsError(f"lengths must have shape (N, 6), not {lengths.shape}", lengths.shape)
    count = len(lengths)
    if isinstance(guess, Pose):
        starts = np.broadcast_to(guess.position, (count, 3)), np.broadcast_to(guess.rotation, (count, 3, 3))
    else:
        starts = np.asarray(guess[0], dtype=float), np.asarray(guess[1], dtype=float)
    shapes = starts[0].shape, starts[1].shape
    if shapes != ((count, 3), (count, 3, 3)):
        problem = f"guesses must have shapes ({count}, 3) and ({count}, 3, 3), as there are {count} sets of lengths"
        raise KinematicsError(f"{problem}; not {shapes[0]} and {shapes[1]}", shapes)
    positions, rotations = np.empty((count, 3)), np.empty((count, 3, 3))
    outcomes, iterations = np.empty(count, np.intc), np.empty(count, np.intc)
    conditions = np.empty(count)

    def run(rows: slice) -> None:
        positions[rows], rotations[rows] = starts[0][rows], starts[1][rows]
        given = lengths[rows], positions[rows], rotations[rows]
        results = outcomes[rows], iterations[rows], conditions[rows]
        batch.solve_poses(*structure.joints, *given, *structure.solver, *results)

    over_chunks(run, count, threads)
    failed = outcomes != Status.OK
    positions[failed] = np.nan
    rotations[failed] = np.nan
    return ForwardBatch(positions, rotations, outcomes, iterations, conditions)


def over_chunks(run: Callable[[slice], None], count: int, threads: int | None = None) -> None:
    """Call `run` on slices that cover ``range(count)``, in threads if that saves time; `run` must release the GIL."""
    if 0 < count <= SLICE:
        run(slice(0, count))
        return
    workers = threads or len(os.sched_getaffinity(0))
    slices = [slice(k, min(k + SLICE, count)) for k in range(0, count, SLICE)]
    began = time.thread_time()
    for done, rows in enumerate(slices):
        if workers > 1 and done and (time.thread_time() - began) * (len(slices) - done) > ALONE * done:
            _run_in_threads(slices[done:], run, workers)
            return
        run(rows)


def _run_in_threads(slices: list[slice], run: Callable[[slice], None], workers: int) -> None:
    """Call `run` on every slice, in this thread and others; after an error in one thread, start no further slice."""
    left = iter(slices)

    def work() -> None:
        try:
            for rows in left:
                run(rows)
        except BaseException:
            collections.deque(left, maxlen=0)  # the remaining slices are not started
            raise

    with ThreadPoolExecutor(workers - 1) as pool:
        helpers = [pool.submit(work) for _ in range(min(workers, len(slices)) - 1)]
        work()
    for helper in helpers:
        helper.result()


def forward_error(outcome: int, condition: float, max_condition: float) -> KinematicsError:
    if outcome == Status.NOT_FINITE:
        return NotFiniteError("strut lengths and guess must be finite, and the lengths above 0")
    if outcome == Status.UNREACHABLE:
        return UnreachableError("no pose has these strut lengths: two struts cannot both reach their platform joints")
    if outcome == Status.SINGULAR:
        problem = f"the machine is near a singularity: condition number {condition:.4g}, allowed {max_condition:.4g}"
        return SingularError(problem, condition, max_condition)
    if outcome == Status.OTHER_ASSEMBLY:
        return OtherAssemblyModeError("the pose found from this guess belongs to another assembly mode than home")
    problem = f"Newton's method did not converge within {lib.MAX_ITERATIONS} steps; give a guess nearer to the pose"
    return NotConvergedError(problem, limit=lib.MAX_ITERATIONS)


def solve_one(
    structure: Structure, lengths: np.ndarray, position: np.ndarray, rotation: np.ndarray
) -> tuple[int, float]:
    """Replace the guess in position and rotation by the solution; return the core's status and the condition number."""
    outcome, steps, condition = np.empty(1, np.intc), np.empty(1, np.intc), np.empty(1)
    given = lengths[None], position[None], rotation[None]
    batch.solve_poses(*structure.joints, *given, *structure.solver, outcome, steps, condition)
    return int(outcome[0]), float(condition[0])


def _closest_pose(structure: Structure, lengths: np.ndarray, guess: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose near `guess` with these strut lengths, by least squares; raise UnreachableError if none exists."""
    from scipy.optimize import least_squares  # takes 39 MB, which a running node does not need

    def pose_at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rotation = rotation_from_vector(x[3:] / structure.characteristic_length) @ guess.rotation
        return guess.position + x[:3], rotation

    def misfit(x: np.ndarray) -> np.ndarray:
        trial = np.empty((1, 6))
        position, rotation = pose_at(x)
        batch.strut_lengths(*structure.joints, position[None], np.ascontiguousarray(rotation)[None], trial)
        return trial[0] - lengths

    first = misfit(np.zeros(6))
    if not np.isfinite(first @ first):
        raise NotConvergedError(f"the guess at {guess.position.tolist()} m gives strut lengths that are not finite")

    fit = least_squares(misfit, np.zeros(6), xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=200)
    rest = float(np.abs(fit.fun).max())
    if rest > 1e-6:
        raise UnreachableError(
            f"no pose near the guess has these strut lengths: at best, one length is {rest * 1e3:.4g} mm off",
            rest,
        )
    return pose_at(fit.x)


def six_lengths(lengths: ArrayLike) -> np.ndarray:
    lengths = np.ascontiguousarray(lengths, dtype=float)
    if lengths.shape != (6,):
        raise KinematicsError(f"six strut lengths are needed, not shape {lengths.shape}", lengths.shape)
    for name, length in zip(STRUT_NAMES, lengths, strict=True):
        if not (np.isfinite(length) and length > 0.0):
            raise NotFiniteError(f"{name}: length must be finite and above 0, not {length} m", float(length))
    return lengths


def batch_poses(positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and rotations as contiguous arrays for the core; one rotation (3, 3) is used for all poses."""
    positions, rotations = np.ascontiguousarray(positions, dtype=float), np.asarray(rotations, dtype=float)
    if rotations.shape == (3, 3):
        rotations = np.broadcast_to(rotations, (len(positions), 3, 3))
    if positions.ndim != 2 or positions.shape[1] != 3 or rotations.shape != (len(positions), 3, 3):
        problem = f"poses must have shapes (N, 3) and (N, 3, 3), not {positions.shape} and {rotations.shape}"
        raise KinematicsError(problem, positions.shape)
    return positions, np.ascontiguousarray(rotations)
