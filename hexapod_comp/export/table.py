"""Export to a table of corrections on a grid of tool positions, for controllers with only volumetric compensation.

Each row is for one position of an untilted tool and one direction of travel (forward or backward along x, y and z). A
row has one correction in two forms: six strut corrections, and a change of the tool pose. At the changed tool pose, the
nominal machine has the corrected strut lengths. Backlash depends on each strut's direction of motion, so the columns of
backlash are separate: add half of it to the correction of a strut that grows, and subtract half if the strut shrinks.
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
from ..formats.schema import DIMENSIONS
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import Structure, solve_pose
from ..machine.model import MachineModel, RealMachine
from ..machine.model_file import DIRECTIONS
from ..machine.passes import Passes, at, level_attitude
from ..machine.trial import model_commands
from ..pose import Pose, attitude_error, rotation_from_vector
from .terms import refuse_unknown
from .trial import DIAGONAL

POSITION = ("x", "y", "z")
# Columns of `GridTable.struts`, `backlash` and `poses`, with their units
VALUES = (
    (tuple(f"correction_L{i}" for i in range(1, 7)), "um"),
    (tuple(f"backlash_L{i}" for i in range(1, 7)), "um"),
    (("dx", "dy", "dz"), "um"),
    (("rx", "ry", "rz"), "urad"),
)
# Columns of the file
COLUMNS = (
    *(f"{name}_mm" for name in POSITION),
    "direction",
    *(f"{name}_{unit}" for names, unit in VALUES for name in names),
)

MOST_ROWS = 200_000  # Largest number of rows; a controller cannot use a larger table
WAVE_STEPS = 4.0  # Smallest period of a screw wave that the table represents, as a multiple of the grid's step
EDGE = 0.1e-3  # A measured point that is outside the field's box by at most this distance, m, counts as inside


@dataclass(frozen=True)
class GridTable:
    """Corrections on a grid of nx × ny × nz tool positions, for forward and backward travel."""

    nodes: tuple[np.ndarray, np.ndarray, np.ndarray]  # increasing coordinates of the level tool in ``work``, m
    struts: np.ndarray  # (2, nx, ny, nz, 6): commanded − nominal strut length without backlash, m; forward, backward
    backlash: np.ndarray  # (2, nx, ny, nz, 6): change of the strut command when the strut reverses, m
    poses: np.ndarray  # (2, nx, ny, nz, 6): change of the commanded tool pose: displacement, m, rotation vector, rad

    def strut_corrections(self, positions: np.ndarray, backward: np.ndarray, senses: np.ndarray) -> np.ndarray:
        """Return strut corrections with backlash, (N, 6), m, of struts that move in the directions `senses`."""
        lost = self._interpolated(self.backlash, positions, backward)
        return self._interpolated(self.struts, positions, backward) + 0.5 * senses * lost

    def pose_corrections(self, positions: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Return the corrections of N commanded tool poses, (N, 6): displacement, m, and rotation vector, rad."""
        return self._interpolated(self.poses, positions, backward)

    def _interpolated(self, values: np.ndarray, positions: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Interpolate `values` at tool positions: those for backward travel where `backward`, else forward."""
        corners = np.array([[n[0] for n in self.nodes], [n[-1] for n in self.nodes]])
        outside = ((positions < corners[0]) | (positions > corners[1])).any(axis=1)
        if outside.any():
            problem = f"covers only positions within {(corners * 1e3).tolist()} mm"
            raise ModelError("table", problem, (positions[outside][0] * 1e3).tolist())
        grids = [RegularGridInterpolator(self.nodes, grid)(positions) for grid in values]
        return np.where(np.asarray(backward)[:, None], grids[1], grids[0])


def make_table(
    geometry: HexapodGeometry, model: MachineModel, box: np.ndarray, step: float
) -> tuple[GridTable, list[str]]:
    """Return a model's table on a grid in `box`, m in ``work``, and notes on the errors that the table omits."""
    refuse_unknown(model, "the table")
    nodes = _grid_nodes(box, step)
    shape = tuple(len(n) for n in nodes)
    places = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    level = np.tile(level_attitude(geometry), (len(places), 1, 1))
    passes = Passes.of_tool(geometry, places, level, np.tile(DIAGONAL, (len(places), 1))).both_ways()
    passes.refuse_unreachable()
    largest = round(max(float(axis[1] - axis[0]) for axis in nodes), 12)  # at most `step`
    represented, left_out = _without_fine_waves(model, largest)
    machine = RealMachine(geometry, represented)
    if model.load.bends:
        left_out.append(
            f"the table is valid only for the weight of tool {geometry.tool_name!r} and the model's gravity"
        )
    held = _outside_field(machine, passes)
    if held:
        left_out.append(f"{held} of {len(passes)} rows are outside the field's box and use the field at the box's edge")
    commands = []
    for sense in (0.0, 1.0, -1.0):
        senses = np.hstack([np.sign(passes.directions), np.full((len(passes), 6), sense)])
        commands.append(model_commands([machine] * len(passes), passes.poses, senses)[0])
    struts = commands[0] - passes.nominal_commands()
    values = (struts, commands[1] - commands[2], _pose_corrections(passes, struts))
    return GridTable((nodes[0], nodes[1], nodes[2]), *(v.reshape(2, *shape, 6) for v in values)), left_out


def _grid_nodes(box: np.ndarray, step: float) -> tuple[np.ndarray, ...]:
    """Return the node coordinates along x, y and z, m; raise ModelError if the table has more than `MOST_ROWS` rows."""
    cells = np.maximum(1.0, np.ceil(np.ptp(box, axis=0) / step - 1e-9))
    rows = 2.0 * float((cells + 1.0).prod())
    if not rows <= MOST_ROWS:
        raise ModelError("step_mm", f"gives {rows:.6g} rows, allowed {MOST_ROWS}; take a larger step", step * 1e3)
    return tuple(np.linspace(low, high, int(n) + 1) for (low, high), n in zip(box.T, cells, strict=True))


def _without_fine_waves(model: MachineModel, step: float) -> tuple[MachineModel, list[str]]:
    """Return the model without screw waves shorter than `WAVE_STEPS` grid steps, and a note on the omitted waves."""
    s = model.struts
    amplitude, period = np.hypot(s.cosine, s.sine), s.period[:, None] / s.harmonics
    fine = (amplitude > 0.0) & (period < WAVE_STEPS * step)
    if not fine.any():
        return model, []
    smooth = replace(s, cosine=np.where(fine, 0.0, s.cosine), sine=np.where(fine, 0.0, s.sine))
    periods = ", ".join(f"{one * 1e3:.6g}" for one in np.unique(period[fine].round(9)))
    text = (
        f"screw waves of {periods} mm period and up to {amplitude[fine].max() * 1e6:.2f} µm are "
        f"left out: a period must be at least {WAVE_STEPS:g} steps of the grid, and a step is {step * 1e3:g} mm"
    )
    return replace(model, struts=smooth), [text]


def _outside_field(machine: RealMachine, passes: Passes) -> int:
    """Count the rows whose measured point is outside the field's box; raise an error if the field refuses them."""
    field = machine.model.field
    low, high = field.box + np.array([[-EDGE], [EDGE]])
    points = passes.points(field.probe)
    outside = ((points < low) | (points > high)).any(axis=1)
    if outside.any() and field.outside == "refuse":
        row, corners = int(outside.argmax()), (field.box * 1e3).tolist()
        where = at(passes.geometry, passes.positions[row], passes.rotations[row])
        problem = f"{where}: the measured point is outside the field's box {corners} mm in base"
        raise OutsideFieldError(problem, points[row], field.box)
    return int(outside.sum())


def _pose_corrections(passes: Passes, corrections: np.ndarray) -> np.ndarray:
    """Return by how much tool poses must change, (N, 6), m and rad, to change nominal lengths by `corrections`, m."""
    geometry, structure = passes.geometry, Structure.of(passes.geometry)
    starts = map(Pose, *passes.poses)
    lengths = passes.nominal_commands() + corrections
    poses = [solve_pose(structure, row, start) for row, start in zip(lengths, starts, strict=True)]
    at, turned = (np.array([getattr(pose, part) for pose in poses]) for part in ("position", "rotation"))
    changed = geometry.tool_poses(at, turned)
    positions, rotations, _ = passes.of_the_tool()
    return np.hstack([changed[0] - positions, attitude_error(changed[1], rotations)])


def commands_by_struts(table: GridTable, passes: Passes) -> np.ndarray:
    """Return strut commands, shape (N, 6), m: nominal lengths plus the table's strut corrections and backlash."""
    positions, _, directions = passes.of_the_tool()
    corrections = table.strut_corrections(positions, directions[:, 0] < 0.0, passes.senses()[:, 3:])
    return passes.nominal_commands() + corrections


def commands_by_poses(table: GridTable, passes: Passes) -> np.ndarray:
    """Return strut commands, shape (N, 6), m: nominal lengths at tool poses with the table's pose corrections."""
    positions, rotations, directions = passes.of_the_tool()
    changes = table.pose_corrections(positions, directions[:, 0] < 0.0)
    turned = rotation_from_vector(changes[:, 3:]) @ rotations
    return Passes.of_tool(passes.geometry, positions + changes[:, :3], turned, directions).nominal_commands()


def write_table(table: GridTable, path: str | Path, titles: Sequence[str]) -> None:
    """Write a table as CSV with `titles` as comment lines; if writing fails, an existing file stays unchanged."""
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
    """Read a table from CSV; its rows can be in any order, and the names of its columns state their units."""
    table = Table(path)
    positions = table.numbers(table.required(POSITION, "length"))
    struts, backlash, *poses = (table.numbers(table.required(names, DIMENSIONS[unit])) for names, unit in VALUES)
    numbers = {name: number for number, name in enumerate(DIRECTIONS)}
    ways = table.meanings("direction", table.texts("direction"), numbers, f"one of {', '.join(DIRECTIONS)}")
    table.refuse_unknown()
    (directions, *places), order = grid_order(table, np.vstack([ways, positions.T]), "position and direction")
    for axis, coordinates in zip(("direction", *POSITION), (directions, *places), strict=True):
        if len(coordinates) < 2:
            raise InputFileError(path, "", f"needs at least two positions along {axis}", coordinates.tolist())
    x, y, z = places
    shape = (2, len(x), len(y), len(z))
    grids = (struts, backlash, np.hstack(poses))
    return GridTable((x, y, z), *(values[order].reshape(*shape, 6) for values in grids))
