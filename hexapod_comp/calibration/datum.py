"""Where a machine stands as a whole: the part that readings do not show, and the pose at which it is held.

If the whole machine is shifted and turned, a laser line reads the same: its zero and its beam's place are unknown.
Otherwise only the priors would decide the part that readings do not show. So it is held where a workshop needs it: at a
datum pose the model does not move the tool, and a workpiece zero set there stays valid.
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
    """A datum, and the part of the tool's displacement, m, and rotation, rad, in ``base``, that is held at zero
    there."""

    pose: Pose  # pose_platform_in_base
    part: np.ndarray  # (6, 6), a projection
    # (6,), the tool's displacement and rotation by the priors alone: the model does not contain the held part
    given_up: np.ndarray

    @property
    def held(self) -> int:
        """The number of the six ways to shift and turn the whole machine in which the tool is held."""
        return round(float(np.trace(self.part)))

    @property
    def datum(self) -> Datum:
        """Its text in a model file."""
        return Datum.at(self.pose, self.held)

    def moved(self, arms: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Return the machine's motion by holding, at places that are arms (N, 3), m, from the tool at the datum.

        Shape (N, 6), m and rad, along and about the columns of `axes`, (3, 3) in ``base``.
        """
        there = np.kron(np.eye(2), axes).T @ self.part @ self.given_up
        return carried(np.tile(there[:, None], (len(arms), 1, 1)), arms)[:, :, 0]

    def report(self) -> str:
        """Return the number of directions in which the datum is held, and why, as text."""
        lengths = np.linalg.norm(self.given_up[:3]) * 1e6, np.linalg.norm(self.given_up[3:]) * 1e6
        moved = "{:.2f} µm and {:.2f} µrad".format(*lengths)
        of_six = f"Of six ways to shift and turn the whole machine the readings do not show {self.held}; in these the"
        text = {
            0: f"The readings show where the machine stands as a whole; the model moves the tool there by {moved}",
            len(self.part): "The readings do not show where the machine stands as a whole, so it stays where it is: "
            f"there the model moves the tool by nothing. Not held, it would move it by {moved}",
        }.get(self.held, f"{of_six} model moves the tool there by nothing. Not held, it would move it by {moved}")
        return f"datum: {self.datum}\n  {text}."

    def as_json(self) -> dict[str, Any]:
        """Return the same as plain numbers; units are in the keys."""
        return {
            "platform_position_m": self.datum.position,
            "platform_angles_rad": self.datum.angles,
            "held": self.held,
            "tool_moved_if_not_held_m": self.given_up[:3],
            "tool_turned_if_not_held_rad": self.given_up[3:],
        }


def refuse_unreachable(geometry: HexapodGeometry, pose: Pose) -> None:
    """Refuse a datum, ``pose_platform_in_base``, that a limit of the machine forbids."""
    refusal = geometry.refusal(pose.position, pose.rotation, strut_lengths(Structure.of(geometry), pose))
    if refusal is not None:
        raise CalibrationError("datum", f"is a pose that the machine cannot take: {refusal}")


def hold(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray
) -> tuple[MachineModel, HeldDatum]:
    """Return a model in which a part of the tool's error at a pose is zero, rounded as in a model file, and that part.

    A pose that a limit of the machine forbids is refused.
    """
    refuse_unreachable(geometry, pose)
    given_up = tool_move(geometry, model, pose)
    model = with_datum_held(geometry, model, pose, part)
    rounded = {name: getattr(model, name).round(DIGITS) for name in ("base_deviation", "base_axes_turn")}
    held = HeldDatum(pose, part, given_up)
    return replace(model, **rounded, origin=replace(model.origin, datum=held.datum)), held


def unseen_part(
    estimation: Estimation, tolerance: float, noise: np.ndarray, pose: Pose, before: np.ndarray | None = None
) -> np.ndarray:
    """Return the part of the tool's error at a pose that is a motion of the whole machine that readings do not show.

    A motion is seen when one of the structure's `tolerance`, m, changes the readings, free of their instruments'
    unknowns (zeros, a beam's direction, a tracker's frame), by more than their `noise`, factors on the stated. `before`
    is the part that earlier readings did not show either. The result, (6, 6), projects displacement, m, and rotation,
    rad, in ``base``; rotations weigh as displacements at the machine's characteristic length.
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
    """Return orthonormal columns that span the null space of an orthogonal projection, shape (n, k)."""
    shares, directions = np.linalg.eigh(0.5 * (projection + projection.T))
    return directions[:, shares > 0.5]
