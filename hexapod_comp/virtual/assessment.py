"""The performance assessment of Song et al.: the effect of random imperfections on strut lengths and poses.

The paper's computation of a real machine's pose from the ideal strut lengths has errors of up to 5 µm (Table 5); this
module solves the loop closures exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine
from ..machine.passes import Passes
from ..machine.trial import drive, model_commands
from ..pose import Pose, attitude_error
from .imperfections import ImperfectionBounds, draw_model


@dataclass(frozen=True)
class Assessment:
    """Strut lengths and poses of an ideal machine and of M drawn machines at P commanded poses, in SI units."""

    seeds: tuple[int, ...]
    # (P, 6): strut commands of the nominal machine; its strut lengths (Table 2) if no joint turns a screw
    ideal_lengths: np.ndarray
    # (M, P, 6): strut commands that bring each real machine exactly to the poses (Table 4)
    real_lengths: np.ndarray
    # (M, P, 3), m, and (M, P, 3, 3): ``pose_tool_in_work`` of each real machine with the ideal lengths
    taken_positions: np.ndarray
    taken_rotations: np.ndarray
    # (M, P, 6): displacement, m, and rotation vector, rad, from the commanded to the taken pose, along work axes
    pose_errors: np.ndarray
    # (M, P, 2): distance, m, and angle, rad, from each pose to the forward kinematics of `real_lengths`: a check
    round_trip: np.ndarray

    @property
    def strut_changes(self) -> np.ndarray:
        """Real minus ideal lengths (machines, poses, 6), m: the corrections that an exact model would compute."""
        return self.real_lengths - self.ideal_lengths

    def statistics(self, percentiles: Sequence[float]) -> dict[str, np.ndarray]:
        """Return, by the name of an error, its percentiles over the machines at each of P poses, (P, percentiles).

        The errors are ``strut_change``, m (the largest of the six struts), ``displacement``, m, and ``rotation``, rad.
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
    """Draw and assess `machines` machines, with the seeds `seed`, `seed` + 1, …; refuse poses that break a limit."""
    names = names or [f"pose {n + 1}" for n in range(len(poses))]
    tool = np.array([pose.position for pose in poses]), np.array([pose.rotation for pose in poses])
    passes = Passes.of_tool(geometry, *tool, np.zeros_like(tool[0]))
    passes.refuse_unreachable(names)
    ideal, unknown = passes.nominal_commands(), passes.senses()
    if geometry.screw_lead.any():
        turning = [RealMachine(geometry, MachineModel(geometry.name))] * len(passes)
        ideal, _ = model_commands(turning, passes.poses, unknown, names.__getitem__)
    seeds, runs = tuple(range(seed, seed + machines)), []
    for one in seeds:
        model = draw_model(geometry, bounds, one)
        alike, named = [RealMachine(geometry, model)] * len(passes), [f"{name}, {model.name}" for name in names]
        real, modelled = model_commands(alike, passes.poses, unknown, named.__getitem__)
        taken = geometry.tool_poses(*drive(alike, passes.poses, unknown, ideal, named.__getitem__).actual)
        # Forward kinematics starts 1 mm from the solution; started at the solution it would test nothing.
        back = drive(alike, (modelled[0] + 1e-3, modelled[1]), unknown, real, named.__getitem__)
        trip = back.errors(passes.poses, np.zeros(3)).as_array().reshape(-1, 2, 3)
        errors = np.hstack([taken[0] - tool[0], attitude_error(taken[1], tool[1])])
        runs.append((real, *taken, errors, np.linalg.norm(trip, axis=2)))
        progress(1)
    return Assessment(seeds, ideal, *map(np.array, zip(*runs, strict=True)))
