"""A model as a plain table: corrections on a rectangular grid of tool positions, trilinear in between.

For controllers that know no more than a volumetric table. Each row holds one commanded position of a level
tool and one direction of travel (forward or backward along x, y and z), and gives the same correction in two
forms: six strut corrections, and the change of the commanded tool pose that the nominal machine would need to
send the same strut commands. Backlash depends on each strut's own direction, which no direction of the tool
fixes, so it has columns of its own: half of it is added to the correction of a strut that grows, and half
taken from that of one that shrinks. A pose correction cannot carry it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from ..errors import InputFileError, ModelError, OutsideFieldError
from ..formats.csv import Table, csv_text, grid_order
from ..formats.outputs import write_text
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, solve_pose
from ..machine.model import MachineModel, RealMachine
from ..machine.model_file import DIRECTIONS
from ..machine.passes import Passes, at
from ..machine.trial import model_commands
from ..pose import Pose, attitude_error, rotation_from_vector
from .carried import refuse_unknown
from .trial import DIAGONAL

POSITION = ("x", "y", "z")
CORRECTION = tuple(f"correction_L{i}" for i in range(1, 7))
BACKLASH = tuple(f"backlash_L{i}" for i in range(1, 7))
DISPLACEMENT = ("dx", "dy", "dz")
ROTATION = ("rx", "ry", "rz")
COLUMNS = (
    *(f"{name}_mm" for name in POSITION),
    "direction",
    *(f"{name}_um" for name in (*CORRECTION, *BACKLASH, *DISPLACEMENT)),
    *(f"{name}_urad" for name in ROTATION),
)
"""Header of the file."""

MOST_ROWS = 200_000  # A finer grid is refused: it would not be a table for a controller
# A screw wave with fewer steps of the grid than this to its period is left out: the grid would see noise
WAVE_STEPS = 4.0
# Nodes on the boundary of the field's box count as inside, though errors move the measured point out by µm
EDGE = 0.1e-3


@dataclass(frozen=True)
class GridTable:
    """Corrections on a grid, forward and backward."""

    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]  # Increasing coordinates of the level tool in ``work``, m
    # (2, nx, ny, nz, 6): strut correction = commanded − nominal strut length, m, forward and backward, backlash left
    # out
    struts: np.ndarray
    backlash: np.ndarray  # (2, nx, ny, nz, 6): lost motion to be made up for on reversal of a strut, m
    # (2, nx, ny, nz, 6): change of the commanded tool pose along the axes of ``work``: displacement, m, rotation
    # vector, rad
    poses: np.ndarray

    def strut_corrections(self, positions: np.ndarray, backward: np.ndarray, senses: np.ndarray) -> np.ndarray:
        """Return strut corrections, shape (N, 6), m."""
        lost = self._between(self.backlash, positions, backward)
        return self._between(self.struts, positions, backward) + 0.5 * senses * lost

    def pose_corrections(self, positions: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Return displacement, m, and rotation vector, rad, of the commanded tool pose, shape (N, 6)."""
        return self._between(self.poses, positions, backward)

    def _between(self, values: np.ndarray, positions: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Interpolate trilinearly in the grid of each row's direction."""
        corners = np.array([[n[0] for n in self.nodes], [n[-1] for n in self.nodes]])
        outside = ((positions < corners[0]) | (positions > corners[1])).any(axis=1)
        if outside.any():
            problem = f"holds positions within {(corners * 1e3).tolist()} mm only"
            raise ModelError("table", problem, (positions[outside][0] * 1e3).tolist())
        grids = [RegularGridInterpolator(self.nodes, grid)(positions) for grid in values]
        return np.where(np.asarray(backward)[:, None], grids[1], grids[0])


# Making


def make_table(
    geometry: HexapodGeometry, model: MachineModel, box: np.ndarray, step: float
) -> tuple[GridTable, list[str]]:
    """Evaluate a model on a grid."""
    refuse_unknown(model, "the table")
    nodes = _grid_nodes(box, step)
    shape = tuple(len(n) for n in nodes)
    places = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    level = np.tile(np.eye(3), (len(places), 1, 1))
    passes = Passes.of_tool(geometry, places, level, np.tile(DIAGONAL, (len(places), 1))).both_ways()
    passes.refuse_unreachable()
    carried, left_out = _without_fine_waves(model, step)
    machine = RealMachine(geometry, carried)
    if model.load.bends:
        left_out.append(
            f"the load is that of tool {geometry.tool_name} in the model's gravity: of others it is left out"
        )
    held = _outside_field(machine, passes)
    if held:
        left_out.append(f"{held} of {len(passes)} rows are outside the field's box: its boundary value is held")
    commands = []
    for sense in (0.0, 1.0, -1.0):
        senses = np.hstack([np.sign(passes.directions), np.full((len(passes), 6), sense)])
        commands.append(model_commands([machine] * len(passes), passes.poses, senses)[0])
    struts = commands[0] - passes.nominal_commands()
    values = (struts, commands[1] - commands[2], _pose_corrections(passes, struts))
    return GridTable((nodes[0], nodes[1], nodes[2]), *(v.reshape(2, *shape, 6) for v in values)), left_out


def _grid_nodes(box: np.ndarray, step: float) -> tuple[np.ndarray, ...]:
    """Return the coordinates of the nodes along x, y and z, m; refuse too many, before any is made."""
    cells = np.maximum(1.0, np.ceil(np.ptp(box, axis=0) / step - 1e-9))
    rows = 2.0 * float((cells + 1.0).prod())
    if not rows <= MOST_ROWS:
        raise ModelError("step", f"gives {rows:.6g} rows, allowed {MOST_ROWS}; take a larger one, m", step)
    return tuple(np.linspace(low, high, int(n) + 1) for (low, high), n in zip(box.T, cells, strict=True))


def _without_fine_waves(model: MachineModel, step: float) -> tuple[MachineModel, list[str]]:
    """Return the model without the screw waves that a grid cannot follow, and what was left out."""
    s = model.struts
    amplitude, period = np.hypot(s.cosine, s.sine), s.period[:, None] / s.harmonics
    fine = (amplitude > 0.0) & (period < WAVE_STEPS * step)
    if not fine.any():
        return model, []
    smooth = replace(s, cosine=np.where(fine, 0.0, s.cosine), sine=np.where(fine, 0.0, s.sine))
    text = (
        f"screw waves of {period[fine].min() * 1e3:g} mm period and up to {amplitude[fine].max() * 1e6:.2f} µm are "
        f"finer than the grid's {step * 1e3:g} mm and left out"
    )
    return replace(model, struts=smooth), [text]


def _outside_field(machine: RealMachine, passes: Passes) -> int:
    """Return how many rows have their measured point outside the field's box."""
    field = machine.model.field
    low, high = field.box + np.array([[-EDGE], [EDGE]])
    points = passes.points(field.probe)
    outside = ((points < low) | (points > high)).any(axis=1)
    if outside.any() and field.outside == "refuse":
        row, corners = int(outside.argmax()), (field.box * 1e3).tolist()
        problem = f"{at(passes.positions[row])}: the measured point is outside the field's box {corners} mm in base"
        raise OutsideFieldError(problem, points[row], field.box)
    return int(outside.sum())


def _pose_corrections(passes: Passes, corrections: np.ndarray) -> np.ndarray:
    """Return the changes of the commanded tool pose, shape (N, 6), that amount to strut corrections (N, 6)."""
    geometry, structure = passes.geometry, Structure.of(passes.geometry)
    starts = map(Pose, *passes.poses)
    lengths = passes.nominal_commands() + corrections
    poses = [solve_pose(structure, row, start) for row, start in zip(lengths, starts, strict=True)]
    at, turned = (np.array([getattr(pose, part) for pose in poses]) for part in ("position", "rotation"))
    changed = geometry.tool_poses(at, turned)
    positions, rotations, _ = passes.of_the_tool()
    return np.hstack([changed[0] - positions, attitude_error(changed[1], rotations)])


# Applying


def commands_by_struts(table: GridTable, passes: Passes) -> np.ndarray:
    """Return strut commands, shape (N, 6), m: nominal lengths plus corrections, backlash by each strut's direction."""
    positions, _, directions = passes.of_the_tool()
    corrections = table.strut_corrections(positions, directions[:, 0] < 0.0, passes.senses()[:, 3:])
    return passes.nominal_commands() + corrections


def commands_by_poses(table: GridTable, passes: Passes) -> np.ndarray:
    """Return strut commands, shape (N, 6), m: nominal lengths of the corrected tool poses."""
    positions, rotations, directions = passes.of_the_tool()
    changes = table.pose_corrections(positions, directions[:, 0] < 0.0)
    turned = rotation_from_vector(changes[:, 3:]) @ rotations
    return Passes.of_tool(passes.geometry, positions + changes[:, :3], turned, directions).nominal_commands()


# Files


def write_table(table: GridTable, path: str | Path, titles: Sequence[str]) -> None:
    """Write a table as CSV, whole or not at all; `titles` become comment lines."""
    rows: list[Sequence[str]] = [COLUMNS]
    for index in np.ndindex(*table.struts.shape[:4]):
        way, i, j, k = index
        x, y, z = (nodes[n] * 1e3 for nodes, n in zip(table.nodes, (i, j, k), strict=True))
        changes = np.concatenate([table.struts[index], table.backlash[index], table.poses[index]]) * 1e6
        place = [f"{value + 0.0:.9f}" for value in (x, y, z)]
        rows.append([*place, DIRECTIONS[way], *(f"{value:.6f}" for value in np.round(changes, 6) + 0.0)])
    comments = [f"# {' '.join(title.split())}\n" for title in titles]
    write_text(path, "".join(comments) + csv_text(rows))


def read_table(path: str | Path) -> GridTable:
    """Read a table: rows in any order, lengths and angles in any unit that the header names."""
    table = Table(path)
    positions = table.numbers(table.required(POSITION, "length"))
    struts = table.numbers(table.required(CORRECTION, "length"))
    backlash = table.numbers(table.required(BACKLASH, "length"))
    displacements = table.numbers(table.required(DISPLACEMENT, "length"))
    rotations = table.numbers(table.required(ROTATION, "angle"))
    ((column, _),) = table.required(("direction",), None)
    table.refuse_unknown()
    given = [row[column].strip() for _, row in table.rows]
    for (line, _), text in zip(table.rows, given, strict=True):
        if text not in DIRECTIONS:
            where = f"line {line}, column direction"
            raise InputFileError(path, where, f"must be one of {', '.join(DIRECTIONS)}", text)
    ways = [DIRECTIONS.index(text) for text in given]
    (directions, *places), order = grid_order(table, np.vstack([ways, positions.T]), "position and direction")
    for axis, coordinates in zip(("direction", *POSITION), (directions, *places), strict=True):
        if len(coordinates) < 2:
            raise InputFileError(path, "", f"needs at least two positions along {axis}", coordinates.tolist())
    x, y, z = places
    shape = (2, len(x), len(y), len(z))
    grids = (struts, backlash, np.hstack([displacements, rotations]))
    return GridTable((x, y, z), *(values[order].reshape(*shape, 6) for values in grids))
