"""Hold the datum: at the datum pose the model has no tool error in directions that the readings do not show.

Laser lines, for example, do not show a motion of the whole machine; such motions of the fitted machine come from the
priors alone. So the fitted model is moved as a whole until, at the datum, its error is zero in directions that readings
do not show. A workpiece zero that was set at the datum without compensation is then also valid with compensation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import CalibrationError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, strut_lengths
from ..machine.model import Datum, MachineModel, tool_move, with_datum_held
from ..pose import Pose
from .assumptions import ASSUMED
from .blocks.block import DIGITS
from .estimator import Estimation, LinearProblem
from .sensitivity import carried


@dataclass(frozen=True)
class HeldDatum:
    """A datum pose, and the directions in which the model is moved until it has no tool error at this pose."""

    pose: Pose  # pose_platform_in_base
    part: np.ndarray  # (6, 6): projection onto the held directions of a motion in base, m and rad
    error_before: np.ndarray  # (6,): tool error at the datum before the model was moved, m and rad

    @property
    def held(self) -> int:
        """How many of the six shifts and turns of the whole machine the datum determines, because readings do not."""
        return round(float(np.trace(self.part)))

    @property
    def datum(self) -> Datum:
        return Datum.at(self.pose, self.held)

    def moved(self, arms: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Return by how much, (N, 6), m and rad along and about `axes`, N points moved when the model was moved.

        The columns of `axes` (3, 3) are unit vectors in ``base``. `arms` (N, 3) are the coordinates of the points
        along `axes`, m, relative to the tool at the datum.
        """
        there = np.kron(np.eye(2), axes).T @ self.part @ self.error_before
        return carried(np.tile(there[:, None], (len(arms), 1, 1)), arms)[:, :, 0]

    def report(self) -> str:
        lengths = np.linalg.norm(self.error_before[:3]) * 1e6, np.linalg.norm(self.error_before[3:]) * 1e6
        moved = "the tool at the datum by {:.2f} µm and {:.2f} µrad".format(*lengths)
        shown = {0: "all", len(self.part): "none"}.get(self.held, len(self.part) - self.held)
        seen = f"The readings show {shown} of the six ways to shift and turn the whole machine"
        rest = f"; {self.held} are held. Otherwise the model would move" if self.held else ". The model moves"
        return f"datum: {self.datum}\n  {seen}{rest} {moved}."

    def as_json(self) -> dict[str, Any]:
        return {
            "platform_position_m": self.datum.position,
            "platform_angles_rad": self.datum.angles,
            "held": self.held,
            "tool_moved_if_not_held_m": self.error_before[:3],
            "tool_turned_if_not_held_rad": self.error_before[3:],
        }


def refuse_unreachable(geometry: HexapodGeometry, pose: Pose) -> None:
    refusal = geometry.refusal(pose.position, pose.rotation, strut_lengths(Structure.of(geometry), pose))
    if refusal is not None:
        raise CalibrationError("datum", f"is a pose that the machine cannot reach: {refusal}")


def hold(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray
) -> tuple[MachineModel, HeldDatum]:
    """Move the base of a model: its tool error at `pose` becomes zero in the directions onto which `part` projects.

    Return the model, whose deviations of the base are rounded as in a model file, and the held datum.
    """
    refuse_unreachable(geometry, pose)
    error_before = tool_move(geometry, model, pose)
    model = with_datum_held(geometry, model, pose, part)
    rounded = {name: getattr(model, name).round(DIGITS) for name in ("base_deviation", "base_axes_turn")}
    held = HeldDatum(pose, part, error_before)
    return replace(model, **rounded, origin=replace(model.origin, datum=held.datum)), held


def unseen_part(
    estimation: Estimation,
    problem: LinearProblem,
    tolerance: float,
    noise: np.ndarray,
    pose: Pose,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """Return the projection (6, 6) onto those motions of the whole machine that the readings do not show.

    The readings show a motion of the size `tolerance`, m, if it changes them by more than ASSUMED.seen · noise (root
    sum of squares) after the instruments' unknowns are projected out. The size of a rotation is the displacement that
    it causes at the characteristic length. `noise` (kinds,) is estimated / stated σ of each kind of channel. `before`
    is an earlier result of this function, or None; only motions in the range of that projection are examined.
    """
    measurements, means = estimation.measurements, estimation.means
    geometry = measurements.geometry
    arms = measurements.points() - (pose @ geometry.tool).position
    motions = carried(np.tile(np.eye(6), (len(arms), 1, 1)), arms)[means.station]
    rows = problem.free_of_nuisance(np.einsum("ci,cip->cp", means.directions, motions))
    rows /= noise[means.kind, None]
    size = np.repeat([1.0, 1.0 / geometry.characteristic_length], 3)
    rows *= tolerance * size
    hidden = np.eye(6) if before is None else _range(before / size[:, None] * size)
    strength, directions = np.linalg.eigh(hidden.T @ rows.T @ rows @ hidden)
    unseen = hidden @ directions[:, strength <= ASSUMED.seen**2]
    return size[:, None] * (unseen @ unseen.T) / size


def _range(projection: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (n, k) of the range of an orthogonal projection (n, n)."""
    shares, directions = np.linalg.eigh(0.5 * (projection + projection.T))
    return directions[:, shares > 0.5]
