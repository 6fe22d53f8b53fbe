"""Hold the datum: at the datum pose, make a model's correction zero in the directions that the readings do not show.

A laser line reads the same after the whole machine is shifted and turned, because the laser's zero and its beam's
position are unknown. In directions that the readings do not show, a fit follows its priors alone. Therefore the fitted
model is shifted and turned as a whole, until compensation no longer moves the tool in these directions at the datum
pose. A workpiece zero that was set at the datum pose stays valid.
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
from .estimator import Estimation
from .sensitivity import carried


@dataclass(frozen=True)
class HeldDatum:
    """A datum pose, and the directions in which a model has no tool error at this pose."""

    pose: Pose  # pose_platform_in_base
    part: np.ndarray  # (6, 6): projection of displacement, m, and rotation, rad, in base onto the held directions
    error_before: np.ndarray  # (6,): tool error at the datum before the model was shifted and turned, m and rad

    @property
    def held(self) -> int:
        """Number of held directions: the dimension, 0 to 6, of the held shifts and turns of the whole machine."""
        return round(float(np.trace(self.part)))

    @property
    def datum(self) -> Datum:
        """The datum as it is written into a model file."""
        return Datum.at(self.pose, self.held)

    def moved(self, arms: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Return by how much the model was shifted and turned at N points, along the columns of `axes`, (N, 6), m, rad.

        `axes`, (3, 3), is in ``base``. `arms`, (N, 3), m, are the vectors from the tool at the datum to the points.
        """
        there = np.kron(np.eye(2), axes).T @ self.part @ self.error_before
        return carried(np.tile(there[:, None], (len(arms), 1, 1)), arms)[:, :, 0]

    def report(self) -> str:
        """Return text: the datum pose, the number of held directions, and the tool error before the datum was held."""
        lengths = np.linalg.norm(self.error_before[:3]) * 1e6, np.linalg.norm(self.error_before[3:]) * 1e6
        moved = "the tool at the datum by {:.2f} µm and {:.2f} µrad".format(*lengths)
        shown = {0: "all", len(self.part): "none of the"}.get(self.held, f"{len(self.part) - self.held} of the")
        seen = f"The readings show {shown} six ways to shift and turn the whole machine"
        rest = f"; {self.held} are held. Otherwise the model would move" if self.held else ". The model moves"
        return f"datum: {self.datum}\n  {seen}{rest} {moved}."

    def as_json(self) -> dict[str, Any]:
        """Return the datum as plain numbers for JSON; units are in the keys."""
        return {
            "platform_position_m": self.datum.position,
            "platform_angles_rad": self.datum.angles,
            "held": self.held,
            "tool_moved_if_not_held_m": self.error_before[:3],
            "tool_turned_if_not_held_rad": self.error_before[3:],
        }


def refuse_unreachable(geometry: HexapodGeometry, pose: Pose) -> None:
    """Reject a datum, ``pose_platform_in_base``, that a limit of the machine forbids."""
    refusal = geometry.refusal(pose.position, pose.rotation, strut_lengths(Structure.of(geometry), pose))
    if refusal is not None:
        raise CalibrationError("datum", f"is a pose that the machine cannot reach: {refusal}")


def hold(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray
) -> tuple[MachineModel, HeldDatum]:
    """Return the model without the projection `part`, (6, 6), of its tool error at `pose`; and the held datum.

    The deviations of the base are rounded as in a model file. Raise CalibrationError if a limit of the machine forbids
    the pose.
    """
    refuse_unreachable(geometry, pose)
    error_before = tool_move(geometry, model, pose)
    model = with_datum_held(geometry, model, pose, part)
    rounded = {name: getattr(model, name).round(DIGITS) for name in ("base_deviation", "base_axes_turn")}
    held = HeldDatum(pose, part, error_before)
    return replace(model, **rounded, origin=replace(model.origin, datum=held.datum)), held


def unseen_part(
    estimation: Estimation, tolerance: float, noise: np.ndarray, pose: Pose, before: np.ndarray | None = None
) -> np.ndarray:
    """Return the projection, (6, 6), onto the motions of the whole machine that the readings do not show.

    The projection acts on displacement, m, and rotation, rad, of the tool at a pose in ``base``. The readings show a
    motion if a motion of size `tolerance`, m, changes them by more than ASSUMED.seen times their noise. Changes that
    the instruments' unknowns (zeros, beam directions, tracker frames) explain do not count. The size of a rotation is
    the displacement that it causes at the machine's characteristic length. The noise is the stated noise times `noise`,
    (kinds,). `before` is the projection onto the motions that earlier readings did not show.
    """
    measurements, cells = estimation.measurements, estimation.cells
    geometry = measurements.geometry
    arms = measurements.points() - (pose @ geometry.tool).position
    motions = carried(np.tile(np.eye(6), (len(arms), 1, 1)), arms)[cells.station]
    rows = estimation.free_of_nuisance(np.einsum("ci,cip->cp", cells.directions, motions))
    rows /= noise[cells.kind, None]
    size = np.repeat([1.0, 1.0 / geometry.characteristic_length], 3)
    rows *= tolerance * size
    hidden = np.eye(6) if before is None else _range(before / size[:, None] * size)
    strength, directions = np.linalg.eigh(hidden.T @ rows.T @ rows @ hidden)
    unseen = hidden @ directions[:, strength <= ASSUMED.seen**2]
    return size[:, None] * (unseen @ unseen.T) / size


def _range(projection: np.ndarray) -> np.ndarray:
    """Return orthonormal columns that span the range of an orthogonal projection (n, n), shape (n, k)."""
    shares, directions = np.linalg.eigh(0.5 * (projection + projection.T))
    return directions[:, shares > 0.5]
