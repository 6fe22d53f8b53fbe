"""Export to LinuxCNC without this package at run time: real joints for genhexkins, compensation tables for screws.

The written files are read back in LinuxCNC's way. LinuxCNC's sources of version 2.9.0~pre1 (f1270d6ed7,
packaged by Debian 12) and of commit 5c41560ebb show these facts:

- ``src/emc/kinematics/genhexkins.c``: the command of a joint is |P + R·a − b| + lead·arcsin(n_b3·n_a2)/2π with
  n_b3 = unit(u × (n_b × u)) and n_a2 = unit(R·n_p × u). P and R = Rz(C)·Ry(B)·Rx(A) are the commanded pose, a and b the
  strut's joints on platform and base, n_p and n_b their cardan axes, u the direction of the strut; all struts have the
  same lead. ``setp`` sets the pins ``genhexkins.base.N.x`` … ``platform.N.z`` (N from 0) in machine units, ``base-n``,
  ``platform-n`` and ``screw-lead``.
- ``src/emc/motion/motion.h`` and ``command.c``: a table has at most 256 points, in increasing order; trims and slopes
  are single-precision floats.
- ``src/emc/motion/control.c``, compute_screw_comp and output_to_hal: motor command = joint command + trim. The trim is
  linear between points of the *joint command*, and constant beyond the first and the last point. LinuxCNC ignores
  BACKLASH if the joint has a table.
- ``src/emc/motion/usrmotintf.cc``, usrmotLoadComp: LinuxCNC reads a compensation file up to the first line that does
  not begin with three numbers, so comments are at the end of the file. In a file of type 1, the three numbers are
  the joint command, the trim for upward motion, and the trim for downward motion.
- ``src/libnml/inifile/inifile.cc`` (2.9): LinuxCNC reads only the first of two ini sections with the same name.
- ``src/emc/motion/homing.c``: homing to a switch sets the joint command to HOME_OFFSET. Homing to an index pulse that
  resets the encoder sets joint command + trim to HOME_OFFSET. The trim of a joint is zero until the joint first moves.

Thus genhexkins, with the real joints, converts a pose to real strut lengths, and a table converts each length to the
motor command for this length. :class:`Genhexkins` simulates both steps without the model's code.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np
from scipy.interpolate import make_lsq_spline

from ..core.batch import screw_twists, strut_commands
from ..errors import GeometryError
from ..formats.files import read_text
from ..formats.outputs import make_folder, write_text
from ..formats.schema import UNITS, in_unit
from ..machine.arrays import rms
from ..machine.geometry import STRUT_NAMES
from ..machine.model import RealMachine
from ..machine.passes import Passes, level_attitude
from .terms import refuse_unknown

MOST_POINTS = 256  # Largest number of points of a table, EMCMOT_COMP_SIZE
MARGIN = 0.003  # Points are dense over the joint commands of level poses in the box, and this much beyond, m
OUTER_POINTS = 12  # Largest number of points between the dense points and each end of the stroke
RIGHT_ANGLE_MARGIN = np.deg2rad(5.0)  # Smallest allowed |angle between a strut's two cardan axes − 90°|, rad
# Values of [TRAJ]LINEAR_UNITS, and their size, m
MACHINE_UNITS = {"mm": UNITS["length"]["mm"], "inch": UNITS["length"]["in"]}
HAL_FILE, INI_FILE = "genhexkins.hal", "comp.ini"
COMP_FILES = tuple(f"{name}.comp" for name in STRUT_NAMES)
COMP_TYPE = 1
PINS = {"base": "base_joints", "platform": "platform_joints", "base-n": "base_axes", "platform-n": "platform_axes"}
SETP = re.compile(r"^setp genhexkins\.(\S+) (\S+)$", re.MULTILINE)
SAMPLES = 16  # Number of samples of a strut's error for each point of the strut's table


@dataclass(frozen=True)
class ScrewTable:
    """The compensation table of one joint: joint commands, and the trims that LinuxCNC adds to these commands."""

    nominal: np.ndarray  # (n,): joint commands, m, increasing
    trims: np.ndarray  # (2, n): trims for upward motion and for downward motion, m

    def correction(self, joint: np.ndarray, up: np.ndarray) -> np.ndarray:
        """Return the trims, m, that LinuxCNC adds to joint commands (N,), m; where `up` is True, the command grows."""
        trims = self.trims.astype(np.float32)  # LinuxCNC stores single-precision floats
        slopes = np.append((np.diff(trims) / np.diff(self.nominal)).astype(np.float32), np.zeros((2, 1)), axis=1)
        entry = np.searchsorted(self.nominal, joint, side="right") - 1
        row, inside = np.where(up, 0, 1), np.maximum(entry, 0)
        way = np.maximum(joint - self.nominal[inside], 0.0)
        return trims[row, inside] + slopes[row, inside] * way


@dataclass(frozen=True)
class Genhexkins:
    """LinuxCNC's configuration for a machine in SI units, and a simulation of LinuxCNC with this configuration."""

    base_joints: np.ndarray  # (6, 3): in ``work``, which becomes LinuxCNC's world frame, m
    platform_joints: np.ndarray  # (6, 3): in ``tool``, which becomes LinuxCNC's moving frame, m
    base_axes: np.ndarray  # (6, 3): cardan axes of the base in ``work``, unit vectors; zeros if `lead` is 0
    platform_axes: np.ndarray  # (6, 3): cardan axes of the platform in ``tool``, unit vectors; zeros if `lead` is 0
    lead: float  # screw lead, m
    tables: tuple[ScrewTable, ...]  # compensation tables of the six joints

    def joints(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Return genhexkins' joint commands, (N, 6), m, for tool positions (N, 3), m, and rotations (N, 3, 3)."""
        struts = positions[:, None] + np.einsum("nij,kj->nki", rotations, self.platform_joints) - self.base_joints
        lengths = np.linalg.norm(struts, axis=2)
        if self.lead == 0.0:
            return lengths
        across = np.cross(struts, np.cross(self.base_axes, struts))
        moving = np.cross(np.einsum("nij,kj->nki", rotations, self.platform_axes), struts)
        sine = (across * moving).sum(axis=2) / (np.linalg.norm(across, axis=2) * np.linalg.norm(moving, axis=2))
        return lengths + self.lead * np.arcsin(sine) / (2.0 * np.pi)

    def commands(self, passes: Passes) -> np.ndarray:
        """Return LinuxCNC's motor commands, shape (N, 6), m, at the N poses and directions of travel of `passes`."""
        positions, rotations, directions = passes.of_the_tool()
        joints = self.joints(positions, rotations)
        ahead = self.joints(positions + 1e-6 * directions, rotations)
        corrections = [t.correction(joints[:, i], ahead[:, i] > joints[:, i]) for i, t in enumerate(self.tables)]
        return joints + np.stack(corrections, axis=1)


def make_genhexkins(machine: RealMachine, box: np.ndarray) -> Genhexkins:
    """Return LinuxCNC's configuration; its tables are densest at joint commands of untilted poses in `box`, m."""
    refuse_unknown(machine.model, "genhexkins", without=("load.",))
    geometry, structure = machine.geometry, machine.structure
    lead = float(geometry.screw_lead[0])
    if (geometry.screw_lead != lead).any():
        problem = "must be the same for all struts: genhexkins has one screw-lead"
        raise GeometryError("screw.lead_mm", problem, in_unit(geometry.screw_lead, "mm"))
    _, _, base_axes, platform_axes = machine.body
    # genhexkins computes a right-hand thread if a strut's axis vectors are more than 90° apart (doc/theory.md, 18)
    signs = -_axis_signs(machine, box)[:, None]
    work, tool = geometry.work, geometry.tool
    without_tables = Genhexkins(
        (structure.base_joints - work.position) @ work.rotation,
        (structure.platform_joints - tool.position) @ tool.rotation,
        base_axes @ work.rotation,
        signs * platform_axes @ tool.rotation,
        lead,
        (),
    )
    ranges = _joint_ranges(without_tables, box, level_attitude(machine.geometry))
    tables = tuple(_screw_table(machine, i, *ranges[i]) for i in range(6))
    return replace(without_tables, tables=tables)


def _axis_signs(machine: RealMachine, box: np.ndarray) -> np.ndarray:
    """Return +1 for each strut whose two cardan axis vectors are less than 90° apart, else −1, shape (6,)."""
    geometry = machine.geometry
    if not geometry.screw_lead.any():
        return np.ones(6)
    nodes = _box_nodes(box, 5)
    level = geometry.platform_poses(nodes, np.tile(level_attitude(geometry), (len(nodes), 1, 1)))
    cosines = np.cos(screw_twists(*machine.body, *(np.ascontiguousarray(part) for part in level)))
    signs = np.where(np.cos(machine.constants.view["struts"]["twist_home"]) > 0.0, 1.0, -1.0)
    nearest = (signs * cosines).min(axis=0)
    if nearest.min() < np.sin(RIGHT_ANGLE_MARGIN):
        strut = int(nearest.argmin())
        problem = (
            f"{STRUT_NAMES[strut]}: in the box, the angle between its cardan axes, seen along the strut, must differ "
            f"from 90° by {np.degrees(RIGHT_ANGLE_MARGIN):g}° or more: at 90° genhexkins' screw rotation becomes wrong"
        )
        raise GeometryError("screw.lead_mm", problem, in_unit(geometry.screw_lead[strut], "mm"))
    return signs


def _box_nodes(box: np.ndarray, count: int) -> np.ndarray:
    return np.array(np.meshgrid(*np.linspace(box[0], box[1], count).T)).reshape(3, -1).T


def _joint_ranges(without_tables: Genhexkins, box: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return each strut's shortest and longest joint command, (6, 2), m, in the box at the attitude `level`."""
    nodes = _box_nodes(box, 17)
    joints = without_tables.joints(nodes, np.tile(level, (len(nodes), 1, 1)))
    return np.stack([joints.min(axis=0), joints.max(axis=0)], axis=1)


def _screw_table(machine: RealMachine, strut: int, shortest: float, longest: float) -> ScrewTable:
    """Return the table of one strut: for each direction of motion a piecewise linear least-squares fit to the trims."""
    points = _points(machine.geometry.limits.stroke[strut], shortest - MARGIN, longest + MARGIN)
    dense = np.concatenate([np.linspace(a, b, SAMPLES, endpoint=False) for a, b in pairwise(points)])
    dense = np.append(dense, points[-1])
    knots = np.concatenate([points[:1], points, points[-1:]])
    trims = [make_lsq_spline(dense, exact_trims(machine, strut, dense, s), knots, k=1).c for s in (1.0, -1.0)]
    return ScrewTable(points, np.array(trims))


def _points(stroke: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the increasing joint commands, m, of a table over a stroke, densest between `low` and `high`, m."""
    low, high = max(low, stroke[0]), min(high, stroke[1])
    even = MOST_POINTS / (stroke[1] - stroke[0])
    below, above = (min(OUTER_POINTS, int(np.ceil(even * rest))) for rest in (low - stroke[0], stroke[1] - high))
    before = np.linspace(stroke[0], low, below, endpoint=False)
    inner = np.linspace(low, high, MOST_POINTS - below - above)
    return np.concatenate([before, inner, np.linspace(high, stroke[1], above + 1)[1:]])


def exact_trims(machine: RealMachine, strut: int, joints: np.ndarray, sense: float) -> np.ndarray:
    """Return a strut's trims (motor command − joint command), m, that the model gives for joint commands (n,), m.

    The trims include `shift`: genhexkins measures a screw's rotation from the pose in which the strut's cardan axes are
    parallel, the model measures it from home.
    """
    constants = machine.constants.view["struts"][strut]
    twist = float(constants["twist_home"])
    at_home = twist - np.pi * np.round(twist / np.pi)  # screw rotation at home that genhexkins computes, rad
    shift = float(constants["lead"]) * at_home / (2.0 * np.pi)
    return strut_commands(machine.state, strut, sense, shift, joints) - joints


def table_misfit(machine: RealMachine, genhexkins: Genhexkins, box: np.ndarray) -> np.ndarray:
    """Return each table's RMS and largest difference from the model at untilted poses in `box`, (6, 2), m."""
    misfits = []
    for strut, (low, high) in enumerate(_joint_ranges(genhexkins, box, level_attitude(machine.geometry))):
        joints = np.linspace(low, high, SAMPLES * MOST_POINTS)
        rest = np.concatenate(
            [
                genhexkins.tables[strut].correction(joints, np.full(len(joints), lengthens))
                - exact_trims(machine, strut, joints, sense)
                for sense, lengthens in ((1.0, True), (-1.0, False))
            ]
        )
        misfits.append([rms(rest), np.abs(rest).max()])
    return np.array(misfits)


def write_genhexkins(
    genhexkins: Genhexkins, folder: str | Path, unit: str, titles: list[str], misfit: np.ndarray
) -> list[Path]:
    """Write a HAL file, six compensation files and a file with ini lines to a folder; return the files.

    `unit` is LinuxCNC's machine unit. Comments in the files contain `titles` and `misfit`, a result of
    :func:`table_misfit`.
    """
    folder = Path(folder)
    make_folder(folder)
    size = MACHINE_UNITS[unit]
    titles = [" ".join(title.split()) for title in titles]  # a line break would end the comment
    bodies: dict[str, list[str]] = {HAL_FILE: _hal_lines(genhexkins, size), INI_FILE: []}
    for joint, (name, table) in enumerate(zip(COMP_FILES, genhexkins.tables, strict=True)):
        bodies[INI_FILE] += [f"[JOINT_{joint}]", f"COMP_FILE = {name}", f"COMP_FILE_TYPE = {COMP_TYPE}"]
        rows = zip(table.nominal / size, *(table.trims / size), strict=True)
        bodies[name] = [f"{nominal:.9f} {up + 0.0:.12f} {down + 0.0:.12f}" for nominal, up, down in rows]
    titles = [*titles, f"machine unit: {unit}"]
    for name, body in bodies.items():
        about = {HAL_FILE: HAL_ABOUT, INI_FILE: INI_ABOUT}.get(name) or _comp_about(misfit[COMP_FILES.index(name)])
        comments = [f"# {line}" for line in [*titles, *about]]
        lines = [*body, *comments] if name in COMP_FILES else [*comments, *body]
        write_text(folder / name, "\n".join(lines) + "\n")
    return [folder / name for name in bodies]


HAL_ABOUT = [
    "Real joints of the machine. Source this file after genhexkins is loaded, before the machine is switched on.",
    "LinuxCNC's XYZABC is then the pose of the frame `tool` of the geometry file in its frame `work`. Leave",
    "genhexkins.spindle-offset at its default, 0. Tool lengths (pin tool-offset) are measured from the frame `tool`.",
]

INI_ABOUT = [
    "Copy these lines into the [JOINT_N] sections of your ini file: LinuxCNC 2.9 reads only the first of two sections",
    "with the same name. File names are relative to the ini file's folder. LinuxCNC ignores BACKLASH of these joints.",
    "A joint's correction is zero until the joint first moves; then the correction ramps in. Keep HOME_OFFSET if",
    "homing ends at an index pulse that resets the encoder, or has no search (HOME_SEARCH_VEL = 0). If homing ends at",
    "a switch, set HOME_OFFSET so that HOME_OFFSET plus the correction at HOME_OFFSET is the encoder's length at",
    "the switch.",
]


def _comp_about(misfit: np.ndarray) -> list[str]:
    """Return the comment lines of a table; `misfit`: RMS and largest table − model, m."""
    rms, largest = misfit * 1e6
    return [
        "columns: joint command, correction while the joint grows, correction while it shrinks (COMP_FILE_TYPE = 1)",
        f"for level poses in the box, this table differs from the model by {rms:.3f} um RMS, {largest:.3f} um at most;",
        "at strut lengths that the level tool does not need in the box, the points are farther apart",
        "these comments are at the end, because LinuxCNC stops reading at the first line that is not three numbers",
    ]


def _hal_lines(genhexkins: Genhexkins, size: float) -> list[str]:
    """Return the setp lines of the HAL file; `size` is LinuxCNC's machine unit, m."""
    values: list[tuple[str, float]] = [("screw-lead", genhexkins.lead / size)]
    for pin, name in PINS.items():
        if pin.endswith("-n") and genhexkins.lead == 0.0:
            continue
        scale = 1.0 if pin.endswith("-n") else size
        for joint, vector in enumerate(getattr(genhexkins, name)):
            values += [(f"{pin}.{joint}.{axis}", v / scale) for axis, v in zip("xyz", vector, strict=True)]
    return [f"setp genhexkins.{pin} {value + 0.0:.12f}" for pin, value in values]


def read_genhexkins(folder: str | Path, unit: str) -> Genhexkins:
    """Read the files of a folder as LinuxCNC does: a table ends at the first line that is not three numbers."""
    folder, size = Path(folder), MACHINE_UNITS[unit]
    pins = {pin: float(value) for pin, value in SETP.findall(read_text(folder / HAL_FILE))}
    vectors = {}
    for pin, name in PINS.items():
        rows = [[pins.get(f"{pin}.{joint}.{axis}", 0.0) for axis in "xyz"] for joint in range(6)]
        vectors[name] = np.array(rows) * (1.0 if pin.endswith("-n") else size)
    tables = []
    for name in COMP_FILES:
        lines = (line.split() for line in read_text(folder / name).splitlines())
        points = takewhile(lambda words: len(words) == 3 and words[0] != "#", lines)
        values = np.array([list(map(float, words)) for words in points]) * size
        tables.append(ScrewTable(values[:, 0], values[:, 1:].T))
    return Genhexkins(**vectors, lead=pins["screw-lead"] * size, tables=tuple(tables))
