"""What an export is worth: the tool error that a machine keeps when it is driven by the exported data.

The model is taken for the truth. Its machine is driven twice along the same random travel, with nominal
strut lengths and with what the export makes of the same commands, and the tool's error is compared. Travel
passes each point along a space diagonal, forward on all axes and then backward, so that everything that
depends on a direction has one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel, RealMachine, Temperatures
from ..machine.travel import Passes, at, drive, nominal_commands

DIAGONAL = np.ones(3)
"""Direction of travel, forward; backward is its opposite."""


@dataclass(frozen=True)
class Travel:
    """Commanded tool poses, each passed in a direction.

    Parameters
    ----------
    positions, rotations : ndarray, shape (N, 3), (N, 3, 3)
        ``pose_tool_in_work``, m.
    directions : ndarray, shape (N, 3)
        Direction of motion along the axes of ``work``; the tool does not turn.
    """

    positions: np.ndarray
    rotations: np.ndarray
    directions: np.ndarray

    def passes(self, geometry: HexapodGeometry) -> Passes:
        """Return the same of the platform in ``base``."""
        return Passes.of_tool(geometry, self.positions, self.rotations, self.directions)

    def select(self, mask: np.ndarray) -> Travel:
        """Return the rows in a mask."""
        return Travel(self.positions[mask], self.rotations[mask], self.directions[mask])


CommandsOf = Callable[[Travel], np.ndarray]
"""Returns the strut commands, shape (N, 6), m, that are sent for a travel of N rows."""


@dataclass(frozen=True)
class ToolErrors:
    """What a machine did along a travel, seen at the tool along the axes of ``work``.

    Attributes
    ----------
    displacement, rotation : ndarray, shape (N, 3)
        Actual minus commanded tool position, m, and rotation vector from commanded to actual, rad.
    field_share : ndarray, shape (N, 3)
        The part of the displacement that the model's field adds, m.
    """

    displacement: np.ndarray
    rotation: np.ndarray
    field_share: np.ndarray


@dataclass(frozen=True)
class Size:
    """How large a set of vectors is.

    Attributes
    ----------
    rms, largest : float
        Root mean square and largest length of the vectors.
    """

    rms: float
    largest: float

    @staticmethod
    def of(vectors: np.ndarray) -> Size:
        """Return the size of (N, 3) vectors."""
        lengths = np.linalg.norm(vectors, axis=1)
        return Size(float(np.sqrt((lengths**2).mean())), float(lengths.max()))


@dataclass(frozen=True)
class Comparison:
    """Errors of the tool without and with an export.

    Attributes
    ----------
    passes : int
        Poses times directions that were driven.
    before, after : Size
        3-D displacement error, m.
    before_rotation, after_rotation : Size
        Rotation error, rad.
    """

    passes: int
    before: Size
    after: Size
    before_rotation: Size
    after_rotation: Size


@dataclass(frozen=True)
class ExportCheck:
    """What one export leaves, and how large the effects are that it cannot carry.

    Attributes
    ----------
    level : Comparison
        Level tool, inside the box.
    tilted : Comparison or None
        The same places with the tool tilted; None where no such pose is within the machine's limits.
    field : Size
        Displacement of the tool by the model's error field, m.
    per_kelvin : Size or None
        Displacement of the tool when struts, base and platform are 1 K warmer, m; None for a model without
        thermal expansion.
    """

    level: Comparison
    tilted: Comparison | None
    field: Size
    per_kelvin: Size | None


def draw_travel(box: np.ndarray, count: int, seed: int, tilt: float = 0.0) -> Travel:
    """Draw positions in a box; each is passed forward and backward.

    Parameters
    ----------
    box : ndarray, shape (2, 3)
        Lowest and highest tool position in ``work``, m.
    count : int
        Positions; the travel has twice as many rows.
    seed : int
        Of the random numbers.
    tilt : float, optional
        Angle by which the tool leans, rad, about a random horizontal axis.
    """
    rng = np.random.default_rng(seed)
    positions = rng.uniform(box[0], box[1], (count, 3))
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    axes = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    rotations = Rotation.from_rotvec(tilt * axes).as_matrix()
    directions = np.repeat([DIAGONAL, -DIAGONAL], count, axis=0)
    return Travel(np.tile(positions, (2, 1)), np.tile(rotations, (2, 1, 1)), directions)


def tool_errors(machine: RealMachine, travel: Travel, commands: np.ndarray) -> ToolErrors:
    """Return what the tool does along a travel under strut commands, shape (N, 6), m.

    Raises
    ------
    KinematicsError
        The machine has no pose for a row's commands; names the row's position.
    """
    geometry = machine.geometry
    passes = travel.passes(geometry)
    driven = drive(machine, passes, commands)
    turn, tool = geometry.work.rotation, geometry.tool.position
    at_tool = driven.positions + driven.rotations @ tool
    without = driven.positions_without_field + driven.rotations_without_field @ tool
    rotation = Rotation.from_matrix(driven.rotations @ passes.rotations.transpose(0, 2, 1)).as_rotvec()
    return ToolErrors((at_tool - passes.points(tool)) @ turn, rotation @ turn, (at_tool - without) @ turn)


def refuse_unreachable(geometry: HexapodGeometry, travel: Travel) -> None:
    """Raise the error of the first row that the nominal machine may not take.

    Raises
    ------
    LimitError, KinematicsError
        Naming the position.
    """
    passes = travel.passes(geometry)
    for position, refusal in zip(passes.positions, passes.refusals(geometry), strict=True):
        if refusal is not None:
            refusal.args = (f"{at(position)}: {refusal}",)
            raise refusal


class ExportTrial:
    """A machine and the travel on which exports for it are tried; the model is taken for the truth.

    Parameters
    ----------
    geometry, model : HexapodGeometry, MachineModel
        The machine that the exports were made for, at 20 °C.
    box : ndarray, shape (2, 3)
        Lowest and highest tool position in ``work``, m.
    count, seed : int
        Positions to draw, each passed forward and backward, and the seed.
    tilt : float
        How far the tool leans in the second comparison, rad.

    Raises
    ------
    LimitError, KinematicsError
        The machine cannot reach a part of the box with a level tool.
    """

    def __init__(
        self,
        geometry: HexapodGeometry,
        model: MachineModel,
        box: np.ndarray,
        count: int = 1000,
        seed: int = 0,
        tilt: float = np.deg2rad(5.0),
    ) -> None:
        self.machine, self.level = RealMachine(geometry, model), draw_travel(box, count, seed)
        refuse_unreachable(geometry, self.level)
        leaning = draw_travel(box, count, seed, tilt)
        inside = np.array([refusal is None for refusal in leaning.passes(geometry).refusals(geometry)])
        self.tilted = leaning.select(inside)
        travels = (self.level, self.tilted) if inside.any() else (self.level,)
        nominal = [nominal_commands(geometry, travel.passes(geometry)) for travel in travels]
        self._before = [tool_errors(self.machine, *told) for told in zip(travels, nominal, strict=True)]

    def check(self, commands_of: CommandsOf) -> ExportCheck:
        """Compare the tool error without and with an export.

        Parameters
        ----------
        commands_of : callable
            What the export makes of a travel.

        Raises
        ------
        KinematicsError
            The machine has no pose for what the export commands.
        """
        commands = commands_of(self.level)
        driven = tool_errors(self.machine, self.level, commands)
        tilted = None
        if len(self._before) > 1:
            leaning = tool_errors(self.machine, self.tilted, commands_of(self.tilted))
            tilted = _comparison(self._before[1], leaning)
        warmer = _warmer(self.machine, self.level, commands, driven)
        return ExportCheck(_comparison(self._before[0], driven), tilted, Size.of(driven.field_share), warmer)


def _comparison(before: ToolErrors, after: ToolErrors) -> Comparison:
    sizes = [Size.of(v) for v in (before.displacement, after.displacement, before.rotation, after.rotation)]
    return Comparison(len(after.displacement), *sizes)


def _warmer(machine: RealMachine, travel: Travel, commands: np.ndarray, driven: ToolErrors) -> Size | None:
    """Return how far 1 K on struts, base and platform moves the tool, None without any expansion."""
    model = machine.model
    if not (model.struts.expansion.any() or model.base_expansion or model.platform_expansion):
        return None
    readings = Temperatures(dict.fromkeys(Temperatures.NAMES, 21.0))
    warm = tool_errors(RealMachine(machine.geometry, model, readings), travel, commands)
    return Size.of(warm.displacement - driven.displacement)
