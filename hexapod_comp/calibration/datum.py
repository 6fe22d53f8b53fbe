"""Where a machine stands as a whole: which part of it readings do not show, and the pose at which that part is held.

Shift and turn the whole machine, and a laser line reads the same: its zero, and where its beam lies, are unknown. What
readings do not show, only the priors would decide. So it is held where a shop needs it: at a datum pose the model moves
the tool by nothing, and a workpiece zero set there stays.
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
    """A datum, and which part of the tool's displacement, m, and rotation, rad, in ``base``, is held at zero there."""

    pose: Pose  # pose_platform_in_base
    part: np.ndarray  # (6, 6), a projection
    given_up: np.ndarray  # (6,), by how much the priors alone would move the tool: the held part is not in the model

    @property
    def held(self) -> int:
        """In how many of the six ways to shift and turn the whole machine the tool is held."""
        return round(float(np.trace(self.part)))

    @property
    def datum(self) -> Datum:
        """What a model file says of it."""
        return Datum.at(self.pose, self.held)

    def moved(self, arms: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Return by how much holding moved the machine at places that are arms (N, 3), m, beside the tool there.

        Shape (N, 6), m and rad, along and about the columns of `axes`, (3, 3) in ``base``.
        """
        there = np.kron(np.eye(2), axes).T @ self.part @ self.given_up
        return carried(np.tile(there[:, None], (len(arms), 1, 1)), arms)[:, :, 0]

    def report(self) -> str:
        """Return what is held and why, for people."""
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
    """Return a model that holds a part of the tool's error at a pose, in a model file's digits, and what is held.

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
    """Return which part of the tool's error at a pose is a motion of the whole machine that readings do not show.

    A motion is seen when one of the structure's `tolerance`, m, changes the readings, free of what their instruments do
    not know (zeros, a beam's direction, a tracker's frame), by more than their `noise`, factors on what is stated.
    `before` is the part that earlier readings did not show either. The result, (6, 6), projects displacement, m, and
    rotation, rad, in ``base``; rotations weigh as displacements at the machine's characteristic length.
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
    """Return orthonormal columns that span what an orthogonal projection leaves, shape (n, k)."""
    shares, directions = np.linalg.eigh(0.5 * (projection + projection.T))
    return directions[:, shares > 0.5]
