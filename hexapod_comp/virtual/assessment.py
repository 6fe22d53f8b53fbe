"""The performance assessment of paper 000: what random imperfections do to strut lengths and to poses.

For machines drawn within bounds: the strut lengths that the ideal and that the real machine need at a pose
(Tables 2 and 4), and the pose that the real machine takes when it is told the ideal lengths. Where the
paper's forward model of the real structure left errors of up to 5 µm (Table 5), the loop closures are solved
here as they are; the round trip says how exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import KinematicsError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths
from ..machine.model import MachineModel, RealMachine
from ..machine.motion import FOLLOWED, MotionState
from ..pose import Pose, rotation_angle
from .imperfections import ImperfectionBounds, draw_model


@dataclass(frozen=True)
class Assessment:
    """Ideal and real machine at P poses, for M machines; SI units.

    Attributes
    ----------
    seeds : tuple of int
        The machines' seeds.
    ideal_lengths : ndarray, shape (P, 6)
        Strut lengths of the nominal machine (000, Table 2).
    real_lengths : ndarray, shape (M, P, 6)
        Strut commands that bring each real machine exactly to the poses (000, Table 4).
    taken_positions, taken_rotations : ndarray, shape (M, P, 3), (M, P, 3, 3)
        ``pose_tool_in_work`` that each real machine takes when told the ideal lengths.
    pose_errors : ndarray, shape (M, P, 6)
        The same as displacement, m, and rotation vector, rad, along the work frame's axes.
    round_trip : ndarray, shape (M, P, 2)
        Distance, m, and angle, rad, between the pose and the one found from `real_lengths`.
    """

    seeds: tuple[int, ...]
    ideal_lengths: np.ndarray
    real_lengths: np.ndarray
    taken_positions: np.ndarray
    taken_rotations: np.ndarray
    pose_errors: np.ndarray
    round_trip: np.ndarray

    @property
    def strut_changes(self) -> np.ndarray:
        """Real minus ideal lengths, shape (M, P, 6), m: the corrections that a perfect model would give."""
        return self.real_lengths - self.ideal_lengths

    def statistics(self, percentiles: Sequence[float] = (50.0, 95.0, 100.0)) -> dict[str, np.ndarray]:
        """Return percentiles over the machines, pose by pose, each of shape (P, len(percentiles)).

        Returns
        -------
        dict
            ``strut_change``: largest magnitude of the six, m; ``displacement``, m, and ``rotation``, rad, of
            the tool under ideal commands.
        """
        quantities = {
            "strut_change": np.abs(self.strut_changes).max(axis=2),
            "displacement": np.linalg.norm(self.pose_errors[..., :3], axis=2),
            "rotation": np.linalg.norm(self.pose_errors[..., 3:], axis=2),
        }
        return {name: np.percentile(values, percentiles, axis=0).T for name, values in quantities.items()}


def assess(
    geometry: HexapodGeometry,
    poses: Sequence[Pose],
    bounds: ImperfectionBounds,
    seed: int = 0,
    machines: int = 1,
    names: Sequence[str] | None = None,
    progress: Callable[[int], object] = lambda machines: None,
) -> Assessment:
    """Draw machines and run each of them both ways at all poses.

    Parameters
    ----------
    geometry : HexapodGeometry
        The nominal machine.
    poses : sequence of Pose
        ``pose_tool_in_work``.
    bounds : ImperfectionBounds
        What is drawn. Directions of motion are taken as unknown: backlash has no effect here.
    seed : int
        Of the first machine; the others follow one by one.
    machines : int
        How many.
    names : sequence of str, optional
        What the poses are called in errors.
    progress : callable, optional
        Called with the number of machines just done.

    Raises
    ------
    KinematicsError
        A pose that a machine cannot take; says which.
    ModelError
        Seed or bounds that are none.
    """
    names = names or [f"pose {n + 1}" for n in range(len(poses))]
    platform = [geometry.platform_pose(pose) for pose in poses]
    ideal = np.array([strut_lengths(Structure.of(geometry), pose) for pose in platform])
    seeds = tuple(range(seed, seed + machines))
    runs = []
    for one in seeds:
        runs.append(_run_machine(geometry, draw_model(geometry, bounds, one), poses, platform, ideal, names))
        progress(1)
    real, positions, rotations, errors, trips = (np.array(part) for part in zip(*runs, strict=True))
    return Assessment(seeds, ideal, real, positions, rotations, errors, trips)


def _run_machine(
    geometry: HexapodGeometry,
    model: MachineModel,
    poses: Sequence[Pose],
    platform: Sequence[Pose],
    ideal: np.ndarray,
    names: Sequence[str],
) -> tuple[np.ndarray, ...]:
    """Return real lengths, taken positions and rotations, pose errors and round trips of one machine."""
    machine = RealMachine(geometry, model)
    rows = []
    for n, pose in enumerate(poses):
        try:
            rows.append(_run_pose(geometry, machine, pose, platform[n], ideal[n]))
        except KinematicsError as error:
            raise KinematicsError(f"{names[n]}, {model.name}: {error}", error.value, error.limit) from error
    real, positions, rotations, errors, trips = (np.array(part) for part in zip(*rows, strict=True))
    return real, positions, rotations, errors, trips


def _run_pose(
    geometry: HexapodGeometry, machine: RealMachine, pose: Pose, platform: Pose, ideal: np.ndarray
) -> tuple[np.ndarray, ...]:
    unknown = np.zeros(FOLLOWED)
    real, model_pose, _ = machine.commands_for(platform, MotionState())
    taken = geometry.tool_pose(machine.pose_for(ideal, unknown, platform)[0])
    turn = Rotation.from_matrix(taken.rotation @ pose.rotation.T).as_rotvec()
    # The start is 1 mm off, so that Newton has something to do.
    start = Pose(model_pose.position + 1e-3, model_pose.rotation)
    back = machine.pose_for(real, unknown, start)[0]
    distance = float(np.linalg.norm(back.position - platform.position))
    trip = np.array([distance, rotation_angle(back.rotation @ platform.rotation.T)])
    return real, taken.position, taken.rotation, np.concatenate([taken.position - pose.position, turn]), trip
