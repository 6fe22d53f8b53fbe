"""The reachable workspace of a machine at one tool orientation: volume, boundary with its limits, and largest box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from ..core import Status
from ..core.batch import check_poses
from ..errors import GeometryError
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import over_chunks
from ..machine.passes import level_attitude
from ..pose import Pose, angles_from_rotation, rotation_from_angles

# Names of a pose's limits, in the order of :class:`~hexapod_comp.core.Status`
FINDINGS = (
    "within",
    "stroke, shortest",
    "stroke, longest",
    "base joint cone",
    "platform joint cone",
    "strut clearance",
    "condition number",
    "assembly mode",
    "not a finite number",
)

# Cells along the longest edge of the search grids; a finer grid is used if no point of a coarser one is in the reach
SEARCH_CELLS = 24, 48, 96
CELLS = (4, 200)  # cells along the longest edge; 200 cells take about 10 s and 0.5 GB
HALVINGS = 24  # bisections of a grid cell, which locate the boundary to a fraction of a nanometre


def first_limits(
    geometry: HexapodGeometry, positions: np.ndarray, rotations: np.ndarray, threads: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first limit that each of N tool poses breaks, as an index into FINDINGS, shape (N,).

    Also return the indices of up to two struts that break this limit, shape (N, 2); −1: no strut.
    """
    findings, struts = np.empty(len(positions), np.int8), np.empty((len(positions), 2), np.int8)

    def run(rows: slice) -> None:
        turned = rotations if len(rotations) == 1 else rotations[rows]
        platform = geometry.platform_poses(positions[rows], turned)
        places, turns = (np.ascontiguousarray(part) for part in platform)
        given = *geometry.kernel_joints, geometry.limit_numbers.at, places, turns
        check_poses(*given, findings[rows], struts[rows])

    over_chunks(run, len(positions), threads)
    return findings, struts


def bisected(
    geometry: HexapodGeometry, inside: np.ndarray, outside: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return M boundary points, each between a point inside and a point outside, and the limit broken beyond each."""
    inside, outside, rotations = inside.copy(), outside.copy(), rotation[None]
    findings, _ = first_limits(geometry, outside, rotations)
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        at_middle, _ = first_limits(geometry, middle, rotations)
        beyond = at_middle != Status.OK
        inside[~beyond], outside[beyond] = middle[~beyond], middle[beyond]
        findings[beyond] = at_middle[beyond]
    return inside, findings


@dataclass(frozen=True)
class Boundary:
    """M intersections of grid lines with the boundary of the reach."""

    positions: np.ndarray  # (M, 3): last point within the limits, m in the work frame
    findings: np.ndarray  # (M,): limit there, index into :data:`FINDINGS`
    axis: np.ndarray  # (M,): axis of the grid line, 0…2
    outward: np.ndarray  # (M,): +1 if the line, in its axis' direction, leaves the reach there, −1 if it enters it


@dataclass(frozen=True)
class Reach:
    """The reachable positions of the tool's tip at one orientation, on a grid."""

    geometry: HexapodGeometry
    rotation: np.ndarray  # (3, 3): orientation of the tool in the work frame
    axes: tuple[np.ndarray, np.ndarray, np.ndarray]  # coordinates of the grid, m, equally spaced on all axes
    findings: np.ndarray  # (X, Y, Z): limit that a grid point breaks, index into :data:`FINDINGS`
    boundary: Boundary

    @property
    def within(self) -> np.ndarray:
        return self.findings == Status.OK

    @property
    def spacing(self) -> float:
        return float(self.axes[0][1] - self.axes[0][0])

    @property
    def volume(self) -> float:
        """Volume, m³: spacing² × total length of the grid lines within reach; mean over lines along x, y and z."""
        edge = self.boundary
        here = edge.positions[np.arange(len(edge.axis)), edge.axis]
        return float((np.bincount(edge.axis, edge.outward * here, 3) * self.spacing**2).mean())

    @property
    def box(self) -> np.ndarray:
        """Smallest box around the boundary, (2, 3), m in the work frame."""
        return np.array([self.boundary.positions.min(axis=0), self.boundary.positions.max(axis=0)])

    @cached_property
    def parts(self) -> int:
        """Number of pieces of the reach; at this orientation no path leads from one piece to another."""
        return int(ndimage.label(self.within, np.ones((3, 3, 3)))[1])

    @cached_property
    def centre(self) -> np.ndarray:
        """A point of the reach, (3,), m: the centroid, or the deepest grid point if the centroid is outside."""
        points = self.points()
        centroid = points.mean(axis=0)
        finding, _ = first_limits(self.geometry, centroid[None], self.rotation[None])
        if finding[0] == Status.OK:
            return centroid
        depth = ndimage.distance_transform_edt(self.within)
        deepest = np.unravel_index(depth.argmax(), depth.shape)
        return np.array([axis[index] for axis, index in zip(self.axes, deepest, strict=True)])

    def points(self) -> np.ndarray:
        """Return the grid points within all limits, m in the work frame, shape (N, 3)."""
        return _grid_points(self.axes)[self.within.ravel()]

    def shares(self) -> dict[str, float]:
        """Return each limit's share of the boundary points by name, the largest share first."""
        codes, counts = np.unique(self.boundary.findings, return_counts=True)
        return {FINDINGS[codes[i]]: float(counts[i] / counts.sum()) for i in np.argsort(-counts, kind="stable")}


def home_orientation(geometry: HexapodGeometry) -> np.ndarray:
    """Return the tool's orientation in ``work`` at home, shape (3, 3)."""
    return geometry.tool_pose(geometry.home).rotation


def orientations(geometry: HexapodGeometry, angles: Sequence[Sequence[float]]) -> np.ndarray:
    """Return the orientation at home turned by all combinations of α, β, γ, rad, shape (M, 3, 3)."""
    grid = np.stack(np.meshgrid(*angles, indexing="ij"), axis=-1).reshape(-1, 3)
    return home_orientation(geometry) @ rotation_from_angles(grid)


def reach(geometry: HexapodGeometry, rotation: np.ndarray | None = None, cells: int = 40) -> Reach:
    """Return the reach at an orientation in ``work`` (default: home's), with `cells` grid cells on its longest edge."""
    if not CELLS[0] <= cells <= CELLS[1]:
        raise GeometryError("cells", f"must lie in {CELLS[0]}…{CELLS[1]}", cells)
    rotation = home_orientation(geometry) if rotation is None else Pose(np.zeros(3), rotation).rotation
    box = _search(geometry, rotation)
    outermost = possible_box(geometry, rotation)
    while True:
        axes, findings = _grid(geometry, rotation, box, cells)
        grown = _grown(box, findings == Status.OK, outermost)
        if np.array_equal(grown, box):
            if not (findings == Status.OK).any():
                raise GeometryError("cells", "must be larger: the workspace contains no point of this grid", cells)
            boundary = _crossings(geometry, rotation, axes, findings)
            return Reach(geometry, rotation, axes, findings, boundary)
        box = grown


def reaches(geometry: HexapodGeometry, rotations: np.ndarray, cells: int = 40) -> tuple[Reach, ...]:
    """Return the reach at each of M orientations, shape (M, 3, 3); see :func:`reach`."""
    return tuple(reach(geometry, rotation, cells) for rotation in rotations)


def possible_box(geometry: HexapodGeometry, rotation: np.ndarray) -> np.ndarray:
    """Return a box that contains all positions at which no strut is too long, shape (2, 3), m in the work frame."""
    at_origin, turned = geometry.platform_poses(np.zeros((1, 3)), rotation[None])
    struts = at_origin[0] + geometry.platform_joints @ turned[0].T - geometry.base_joints
    centres, longest = -struts @ geometry.work.rotation, geometry.limits.stroke[:, 1:]
    box = np.array([(centres - longest).max(axis=0), (centres + longest).min(axis=0)])
    if not (box[0] < box[1]).all():
        raise _empty(rotation, f"{FINDINGS[Status.STROKE_LONG]}: at every position some strut is too long")
    return box


def _search(geometry: HexapodGeometry, rotation: np.ndarray) -> np.ndarray:
    """Find the reach on a coarse grid; return a box around it, m in the work frame, with a margin of one grid cell."""
    possible = possible_box(geometry, rotation)
    for cells in SEARCH_CELLS:
        axes, findings = _grid(geometry, rotation, possible, cells)
        where = np.argwhere(findings == Status.OK)
        if len(where):
            step = axes[0][1] - axes[0][0]
            low = np.array([axis[i] for axis, i in zip(axes, where.min(axis=0), strict=True)])
            high = np.array([axis[i] for axis, i in zip(axes, where.max(axis=0), strict=True)])
            return np.array([low - step, high + step])
    codes, counts = np.unique(findings, return_counts=True)
    most = ", ".join(f"{FINDINGS[codes[i]]} at {counts[i] / counts.sum():.0%}" for i in np.argsort(-counts))
    raise _empty(rotation, f"none of the {findings.size} tested poses is within the limits; broken limits: {most}")


def _grid(
    geometry: HexapodGeometry, rotation: np.ndarray, box: np.ndarray, cells: int
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Cover `box` with a grid; return the grid's axes, m in the work frame, and the limit that each point breaks."""
    size = box[1] - box[0]
    step = size.max() / cells
    middle = box.mean(axis=0)
    counts = [math.ceil(edge / step - 1e-9) for edge in size]
    x, y, z = (m + step * (np.arange(n + 1) - n / 2) for m, n in zip(middle, counts, strict=True))
    findings, _ = first_limits(geometry, _grid_points((x, y, z)), rotation[None])
    return (x, y, z), findings.reshape(len(x), len(y), len(z))


def _grown(box: np.ndarray, within: np.ndarray, outermost: np.ndarray) -> np.ndarray:
    """Move outwards each side of a box that has grid points in the reach, unless it is already beyond `outermost`."""
    grown = box.copy()
    step = 0.1 * (box[1] - box[0]).max()
    for axis in range(3):
        for side, index, way in ((0, 0, -1.0), (1, -1, 1.0)):
            beyond = way * (box[side, axis] - outermost[side, axis]) > 0.0
            if within.take(index, axis).any() and not beyond:
                grown[side, axis] += way * step
    return grown


def _crossings(
    geometry: HexapodGeometry, rotation: np.ndarray, axes: tuple[np.ndarray, ...], findings: np.ndarray
) -> Boundary:
    """Return the boundary point on each grid edge with one end in the reach and one end outside."""
    within = findings == Status.OK
    inside, outside, axis, outward = [], [], [], []
    for k in range(3):
        before = np.take(within, np.arange(len(axes[k]) - 1), k)
        after = np.take(within, np.arange(1, len(axes[k])), k)
        for way, mask in ((1.0, before & ~after), (-1.0, after & ~before)):
            start = np.argwhere(mask)
            end = start + np.eye(3, dtype=int)[k]
            first, second = (np.stack([a[i] for a, i in zip(axes, at.T, strict=True)], 1) for at in (start, end))
            inside.append(first if way > 0 else second)
            outside.append(second if way > 0 else first)
            axis.append(np.full(len(start), k))
            outward.append(np.full(len(start), way))
    boundary = bisected(geometry, np.concatenate(inside), np.concatenate(outside), rotation)
    return Boundary(*boundary, np.concatenate(axis), np.concatenate(outward))


def _grid_points(axes: tuple[np.ndarray, ...]) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def poses_at(geometry: HexapodGeometry, points: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``pose_platform_in_base`` for each of N tool tips, m, and one tool orientation, both in the work frame."""
    positions, rotations = geometry.platform_poses(points, rotation[None])
    return positions, np.repeat(rotations, len(points), axis=0)


def _empty(rotation: np.ndarray, problem: str) -> GeometryError:
    angles = ", ".join(f"{angle:g}" for angle in np.rad2deg(angles_from_rotation(rotation)).round(6) + 0.0)
    return GeometryError("limits", f"the workspace is empty at the orientation ({angles})°: {problem}")


BOX_CELLS = 30  # along the reach's longest edge in the search for a box, whose faces then move to the limits
FACE_HALVINGS = 10  # bisections of a grid cell, which locate a face to a thousandth of a cell
ROOM = 0.01  # share of a box's sides kept free at each face, because compensation changes strut lengths
EDGE_SAMPLES = 15  # tested points along each edge of a box
FACES = ("−x", "+x", "−y", "+y", "−z", "+z")


class ReachedBox(NamedTuple):
    """A box of reachable tool positions with one orientation."""

    box: np.ndarray  # (2, 3): lowest and highest corner, m in the work frame
    rotation: np.ndarray  # (3, 3): of the tool in the work frame
    causes: dict[str, str]  # limit at each face, such as ``+x``


def largest_box(reached: Reach) -> ReachedBox:
    """Return the largest box parallel to the work frame in the piece of the reach that is nearest to home."""
    piece = _home_piece(reached)
    corners = _largest_cells(piece)
    if corners is None:
        raise GeometryError("limits", "leave no space for a box: the workspace is smaller than one grid cell")
    axes = reached.axes
    box = np.array([[axis[index] for axis, index in zip(axes, corner, strict=True)] for corner in corners])
    geometry = reached.geometry
    while not _fits(geometry, reached.rotation, box):  # points between the box's grid points may be outside the reach
        middle = box.mean(axis=0)
        box = middle + 0.97 * (box - middle)
    box, causes = _faces_moved_out(geometry, reached, box)
    room = ROOM * np.ptp(box, axis=0)
    digit = 10.0 ** (np.floor(np.log10(np.ptp(box, axis=0).min())) - 2.0)  # coordinates are rounded inwards to this
    inside = np.array([np.ceil((box[0] + room) / digit), np.floor((box[1] - room) / digit)]) * digit
    return ReachedBox(inside.round(12), reached.rotation, causes)


def machine_box(geometry: HexapodGeometry, cells: int = BOX_CELLS) -> ReachedBox:
    """Return the largest box within the reach of the level tool; see :func:`.level_attitude`."""
    return largest_box(reach(geometry, level_attitude(geometry), cells))


def _home_piece(reached: Reach) -> np.ndarray:
    """Return the mask of the grid points in that piece of the reach which is nearest to home."""
    pieces, _ = ndimage.label(reached.within)
    tip = reached.geometry.tool_pose(reached.geometry.home).position
    where = np.argwhere(reached.within)
    places = np.stack([axis[index] for axis, index in zip(reached.axes, where.T, strict=True)], axis=1)
    nearest = where[np.linalg.norm(places - tip, axis=1).argmin()]
    return np.asarray(pieces == pieces[tuple(nearest)])


def _largest_cells(within: np.ndarray) -> tuple[tuple[int, int, int], tuple[int, int, int]] | None:
    """Return the grid indices of the corners (lowest, highest) of the largest box in `within`, or None."""
    nx, ny, nz = within.shape
    ranges = [(a, b) for a in range(nz) for b in range(a + 1, nz)]
    slabs = (
        np.stack([within[:, :, a : b + 1].all(axis=2) for a, b in ranges]) if ranges else np.empty((0, nx, ny), bool)
    )
    heights = np.array([b - a for a, b in ranges])
    best, corners = 0, None
    for x in range(nx - 1):
        grown = np.logical_and.accumulate(slabs[:, x:], axis=1)
        run, longest, end = (np.zeros(grown.shape[:2], dtype=int) for _ in range(3))
        for y in range(ny):
            run = np.where(grown[:, :, y], run + 1, 0)
            better = run > longest
            longest, end = np.where(better, run, longest), np.where(better, y, end)
        volume = heights[:, None] * np.arange(grown.shape[1]) * (longest - 1)
        most = int(volume.max(initial=0))
        if most > best:
            n, wide = np.unravel_index(int(volume.argmax()), volume.shape)
            best, (low, high), y = most, ranges[n], int(end[n, wide])
            corners = (x, y - int(longest[n, wide]) + 1, low), (x + int(wide), y, high)
    return corners


def _faces_moved_out(geometry: HexapodGeometry, reached: Reach, box: np.ndarray) -> tuple[np.ndarray, dict[str, str]]:
    """Move the faces of a box outwards to the limits; return the box, and the limit at each face."""
    causes = {}
    step = reached.spacing * 0.5**FACE_HALVINGS
    for name, (axis, side) in zip(FACES, ((axis, side) for axis in range(3) for side in (0, 1)), strict=True):
        way = 2.0 * side - 1.0
        inside, beyond = 0.0, reached.spacing
        while _fits(geometry, reached.rotation, _moved(box, axis, side, way * beyond)):
            inside, beyond = beyond, beyond + reached.spacing
        while beyond - inside > step:
            middle = 0.5 * (inside + beyond)
            fits = _fits(geometry, reached.rotation, _moved(box, axis, side, way * middle))
            inside, beyond = (middle, beyond) if fits else (inside, middle)
        causes[name] = _cause(geometry, reached.rotation, _moved(box, axis, side, way * beyond))
        box = _moved(box, axis, side, way * inside)
    return box, causes


def _moved(box: np.ndarray, axis: int, side: int, way: float) -> np.ndarray:
    moved = box.copy()
    moved[side, axis] += way
    return moved


def _fits(geometry: HexapodGeometry, rotation: np.ndarray, box: np.ndarray) -> bool:
    findings, _ = first_limits(geometry, _points(box), rotation[None])
    return bool((findings == Status.OK).all())


def _cause(geometry: HexapodGeometry, rotation: np.ndarray, box: np.ndarray) -> str:
    """Name the limit that a box's points break most often, and the struts that break it."""
    findings, struts = first_limits(geometry, _points(box), rotation[None])
    out = findings[findings != Status.OK]
    code = int(np.bincount(out).argmax())
    concerned = np.unique(struts[findings == code])
    names = ", ".join(str(strut + 1) for strut in concerned if strut >= 0)
    return FINDINGS[code] + (f", strut {names}" if names else "")


def _points(box: np.ndarray) -> np.ndarray:
    """Return test points of a box, inside and on all faces, shape (N, 3)."""
    axes = [np.linspace(low, high, EDGE_SAMPLES) for low, high in box.T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
