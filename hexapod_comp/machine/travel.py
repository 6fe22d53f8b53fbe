"""A machine sent through poses, each in a direction: what it is told, and where it goes.

For everything that judges models: directions of motion are given, not followed, so that any number of poses
can be tried in any order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import HexapodError, ModelError, NotConvergedError
from ..kernels.kinematics import OK
from ..kernels.model import command_one
from ..pose import Pose, rotation_from_angles
from .geometry import HexapodGeometry
from .kinematics import Structure, forward_error, strut_lengths_batch
from .model import MachineModel, RealMachine
from .motion import FOLLOWED

LEAST_SPEED = 1e-9
"""Below this share of the travel an axis or a strut stands still."""

BOTH_WAYS = (1.0, -1.0)
"""Forward, backward."""


@dataclass(frozen=True)
class Passes:
    """Platform poses that a machine is sent through, each in a direction; what a run of it starts from.

    Attributes
    ----------
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        Commanded ``pose_platform_in_base``, m.
    directions : ndarray, shape (N, 3)
        Directions of travel in ``base``; length does not matter.
    """

    positions: np.ndarray
    rotations: np.ndarray
    directions: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    @staticmethod
    def of_tool(
        geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, directions: np.ndarray
    ) -> Passes:
        """Return the passes that bring the tool to poses in the work frame.

        Parameters
        ----------
        geometry : HexapodGeometry
            With its tool and work frames.
        positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
            ``pose_tool_in_work``, m.
        directions : ndarray, shape (N, 3)
            Directions of travel in the work frame.
        """
        return Passes(*geometry.platform_poses(positions, rotations), directions @ geometry.work.rotation.T)

    def points(self, probe: np.ndarray) -> np.ndarray:
        """Return where a point of ``platform``, shape (3,), is told to be, shape (N, 3), m in ``base``."""
        return self.positions + self.rotations @ probe

    def senses(self, geometry: HexapodGeometry) -> np.ndarray:
        """Return the directions of motion of axes and struts, shape (N, 9), each −1, 0 or 1.

        An axis or a strut that does not move has none (0: the mean of both ways).
        """
        struts = self.positions[:, None] + geometry.platform_joints @ np.swapaxes(self.rotations, 1, 2)
        struts -= geometry.base_joints
        struts /= np.linalg.norm(struts, axis=2, keepdims=True)
        speeds = np.einsum("nij,nj->ni", struts, self.directions)
        moving = np.concatenate([self.directions, speeds], axis=1)
        return np.sign(moving) * (np.abs(moving) > LEAST_SPEED)

    def select(self, mask: np.ndarray) -> Passes:
        """Return those in a mask or at indices."""
        return Passes(self.positions[mask], self.rotations[mask], self.directions[mask])

    def refusals(self, geometry: HexapodGeometry) -> list[HexapodError | None]:
        """Return, for each pass, why the nominal machine may not take its pose, or None."""
        lengths = nominal_commands(geometry, self)
        return [geometry.refusal(*pose) for pose in zip(self.positions, self.rotations, lengths, strict=True)]


@dataclass(frozen=True)
class Driven:
    """Where a machine went.

    Attributes
    ----------
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        ``pose_platform_in_base``, m.
    positions_without_field, rotations_without_field : ndarray, shape (N, 3), (N, 3, 3)
        The poses that structure and struts alone would have taken.
    """

    positions: np.ndarray
    rotations: np.ndarray
    positions_without_field: np.ndarray
    rotations_without_field: np.ndarray


def nominal_commands(geometry: HexapodGeometry, passes: Passes) -> np.ndarray:
    """Return the strut lengths of the nominal machine, shape (N, 6), m: the commands without compensation."""
    return strut_lengths_batch(Structure.of(geometry), passes.positions, passes.rotations)


def model_commands(believed: RealMachine, passes: Passes) -> np.ndarray:
    """Return the strut commands of a model for some passes, shape (N, 6), m.

    :meth:`RealMachine.commands_for` without its objects: a study asks for millions.

    Raises
    ------
    NotConvergedError
        The model's field is no small correction.
    """
    senses = passes.senses(believed.geometry)
    commands = np.empty((len(passes), 6))
    low, sense = np.empty(FOLLOWED), np.empty(FOLLOWED)
    position, rotation = np.empty(3), np.empty((3, 3))
    arrays = believed.body, believed.strut_arrays, believed.field_arrays
    for n in range(len(passes)):
        low[:], sense[:] = np.nan, senses[n]  # no window yet: the direction is the one given
        at = np.ascontiguousarray(passes.positions[n]), np.ascontiguousarray(passes.rotations[n])
        solved, _ = command_one(*at, believed.thresholds, low, sense, *arrays, position, rotation, commands[n])
        if not solved:
            raise NotConvergedError("the error field is too steep to be undone at this pose")
    return commands


def drive(machine: RealMachine, passes: Passes, commands: np.ndarray) -> Driven:
    """Return where a machine goes under strut commands, shape (N, 6), m, in the directions of some passes.

    Raises
    ------
    KinematicsError
        The machine has no pose for a row's commands; names the commanded position.
    """
    count, senses = len(passes), passes.senses(machine.geometry)
    commands = np.ascontiguousarray(commands)
    modelled = passes.positions.copy(), np.array(passes.rotations)
    actual = np.empty((count, 3)), np.empty((count, 3, 3))
    for row in range(count):
        arrays = (modelled[0][row], modelled[1][row], actual[0][row], actual[1][row])
        outcome, _, condition, _ = machine.forward(commands[row], senses[row], *arrays)
        if outcome != OK:
            error = forward_error(outcome, condition, machine.structure.max_condition)
            raise type(error)(f"{at(passes.positions[row])}: {error}", error.value, error.limit)
    return Driven(*actual, *modelled)


def at(position: np.ndarray) -> str:
    """Say where the platform is, for messages; position (3,), m."""
    return "platform at ({:.3f}, {:.3f}, {:.3f}) mm".format(*(position * 1e3))


def random_passes(
    geometry: HexapodGeometry,
    box: np.ndarray,
    points: int,
    tilt: float,
    rng: np.random.Generator,
    level: np.ndarray | None = None,
) -> Passes:
    """Return passes through random points of a box of the work frame: all one way, then all back.

    Tilts start from a level tool, shape (3, 3) in the work frame; by default parallel to it.
    """
    positions = rng.uniform(box[0], box[1], (points, 3))
    directions = rng.standard_normal((points, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tilts = np.append(rng.uniform(-tilt, tilt, (points, 2)), np.zeros((points, 1)), axis=1)
    there_and_back = np.concatenate([way * directions for way in BOTH_WAYS])
    rotations = rotation_from_angles(tilts) @ (np.eye(3) if level is None else level)
    return Passes.of_tool(geometry, np.tile(positions, (2, 1)), np.tile(rotations, (2, 1, 1)), there_and_back)


def commanded_box(geometry: HexapodGeometry, model: MachineModel) -> np.ndarray:
    """Return the box of level tool positions in ``work`` for which a model was measured, shape (2, 3), m.

    It is the model's valid box of platform positions, or where its field's box of measured points lets the
    platform be. With a work frame that is turned it is the largest box of the work frame, alike in proportions to
    the one around it, that fits inside: poses outside were not measured.

    Raises
    ------
    ModelError
        The model has neither.
    """
    level = geometry.work.rotation @ geometry.tool.rotation.T  # of the platform, when the tool is level
    box = model.valid_box
    if box is None and any(family.shape[4] for family in model.field.lines):
        box = model.field.box - level @ model.field.probe
    if box is None:
        raise ModelError("valid_box", "the model has neither a valid box nor a field; give a box of tool positions")
    centre, half = geometry.tool_pose(Pose(box.mean(axis=0), level)).position, 0.5 * np.ptp(box, axis=0)
    turned = np.abs(geometry.work.rotation)
    around = turned.T @ half
    inside = around * (half / (turned @ around)).min()
    return np.array([centre - inside, centre + inside])
