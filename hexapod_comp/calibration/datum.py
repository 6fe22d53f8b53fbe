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
from .estimator import Estimation
from .sensitivity import carried


@dataclass(frozen=True)
class HeldDatum:
    """A datum and what is held there.

    Attributes
    ----------
    pose : Pose
        ``pose_platform_in_base``.
    part : ndarray, shape (6, 6)
        Which part of the tool's displacement, m, and rotation, rad, in ``base``, is held at zero: a projection.
    given_up : ndarray, shape (6,)
        The tool's displacement and rotation there, by which the priors alone would have moved it: the held part of
        it is no longer in the model.
    """

    pose: Pose
    part: np.ndarray
    given_up: np.ndarray

    @property
    def held(self) -> int:
        """In how many of the six ways to shift and turn the whole machine the tool is held."""
        return round(float(np.trace(self.part)))

    @property
    def datum(self) -> Datum:
        """What a model file says of it."""
        return Datum.at(self.pose, self.held)

    def moved(self, arms: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Return by how much holding moved the whole machine, at places beside the datum, shape (N, 6), m and rad.

        Parameters
        ----------
        arms : ndarray, shape (N, 3)
            From the tool at the datum to the places, m.
        axes : ndarray, shape (3, 3)
            In ``base``: all is along and about its columns.
        """
        there = np.kron(np.eye(2), axes).T @ self.part @ self.given_up
        return carried(np.tile(there[:, None], (len(arms), 1, 1)), arms)[:, :, 0]

    def report(self) -> str:
        """Return what is held and why, for people."""
        lengths = np.linalg.norm(self.given_up[:3]) * 1e6, np.linalg.norm(self.given_up[3:]) * 1e6
        moved = "{:.2f} µm and {:.2f} µrad".format(*lengths)
        if not self.held:
            text = "The readings show where the machine stands as a whole; the model moves the tool there by " + moved
        elif self.held == len(self.part):
            text = "The readings do not show where the machine stands as a whole, so it stays where it is: there the "
            text += f"model moves the tool by nothing. Not held, it would move it by {moved}"
        else:
            text = (
                f"Of six ways to shift and turn the whole machine the readings do not show {self.held}; in these the "
            )
            text += f"model moves the tool there by nothing. Not held, it would move it by {moved}"
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
    """Refuse a datum, ``pose_platform_in_base``, where the machine cannot be.

    Raises
    ------
    CalibrationError
        A limit of the machine forbids the pose.
    """
    refusal = geometry.refusal(pose.position, pose.rotation, strut_lengths(Structure.of(geometry), pose))
    if refusal is not None:
        raise CalibrationError("datum", f"is a pose that the machine cannot take: {refusal}")


def hold(
    geometry: HexapodGeometry, model: MachineModel, pose: Pose, part: np.ndarray
) -> tuple[MachineModel, HeldDatum]:
    """Return a model that holds the tool at a pose, in a model file's digits, and what is held.

    Parameters
    ----------
    geometry, model : HexapodGeometry, MachineModel
        The machine as fitted.
    pose : Pose
        ``pose_platform_in_base``.
    part : ndarray, shape (6, 6)
        As in :class:`HeldDatum`.

    Raises
    ------
    CalibrationError
        A limit of the machine forbids the pose.
    """
    refuse_unreachable(geometry, pose)
    given_up = tool_move(geometry, model, pose)
    model = with_datum_held(geometry, model, pose, part)
    rounded = {name: getattr(model, name).round(ASSUMED.digits) for name in ("base_deviation", "base_axes_turn")}
    held = HeldDatum(pose, part, given_up)
    return replace(model, **rounded, origin=replace(model.origin, datum=held.datum)), held


def unseen_part(
    estimation: Estimation, tolerance: float, noise: np.ndarray, pose: Pose, before: np.ndarray | None = None
) -> np.ndarray:
    """Return which part of the tool's error at a pose is a motion of the whole machine that readings do not show.

    Parameters
    ----------
    estimation : Estimation
        The readings and what their instruments do not know.
    tolerance : float
        Of the structure, m.
    noise : ndarray, shape (kinds,)
        Factor on the stated standard deviation of each kind's readings.
    pose : Pose
        ``pose_platform_in_base``.
    before : ndarray, shape (6, 6), optional
        The part at this pose that earlier readings did not show either; all of it by default.

    Returns
    -------
    ndarray, shape (6, 6)
        A projection of displacement, m, and rotation, rad, in ``base``. Rotations weigh as displacements at the
        machine's characteristic length.
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
