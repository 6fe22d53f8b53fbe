"""The largest box that a machine reaches with one orientation of its tool, and what keeps it from being larger."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from ..core import Status
from ..errors import GeometryError
from ..machine.geometry import HexapodGeometry
from .reach import FINDINGS, Examiner, Reach, home_orientation, reach

CELLS = 30
"""Of the reach's grid along its longest edge; a face is then moved to where the limit really stands."""

HALVINGS = 10
"""Of a grid cell, for each face: a thousandth of it."""

ROOM = 0.01
"""Share of its sides by which the box stays away from the limits on each side: compensation moves struts too."""

SAMPLES = 15
"""Points along each edge of a box that is examined."""

FACES = ("−x", "+x", "−y", "+y", "−z", "+z")


class ReachedBox(NamedTuple):
    """A box of tool positions that a machine reaches."""

    box: np.ndarray  # (2, 3): lowest and highest corner, m in the work frame
    rotation: np.ndarray  # (3, 3): orientation of the tool in the work frame, the same all over the box
    causes: dict[str, str]  # What stops each face, by its name as ``+x``


def largest_box(reached: Reach) -> ReachedBox:
    """Return the box of largest volume, parallel to the work frame, in the piece of a reach that home belongs to.

    Every grid point within it is within all limits; then each face moves out as far as the limits let it, and all come
    in again by :data:`ROOM`.
    """
    piece = _home_piece(reached)
    corners = _largest_cells(piece)
    if corners is None:
        raise GeometryError("limits", "leave no room for a box; the workspace is smaller than a cell of its grid")
    axes = reached.axes
    box = np.array([[axis[index] for axis, index in zip(axes, corner, strict=True)] for corner in corners])
    examiner = Examiner(reached.geometry)
    while not _fits(examiner, reached.rotation, box):  # a dent between grid points
        middle = box.mean(axis=0)
        box = middle + 0.97 * (box - middle)
    box, causes = _grown(examiner, reached, box)
    room = ROOM * np.ptp(box, axis=0)
    digit = 10.0 ** (np.floor(np.log10(np.ptp(box, axis=0).min())) - 2.0)  # of the shortest edge, the third
    inside = np.array([np.ceil((box[0] + room) / digit), np.floor((box[1] - room) / digit)]) * digit
    return ReachedBox(inside.round(12), reached.rotation, causes)


def machine_box(geometry: HexapodGeometry, cells: int = CELLS) -> ReachedBox:
    """Return the largest box in which a machine can be measured: with the tool parallel to the work frame.

    Where the tool cannot be parallel to the work frame at home, as with one that is turned by 90°, it stays as it is at
    home.
    """
    level, home = np.eye(3), home_orientation(geometry)
    tip = geometry.tool_pose(geometry.home).position
    finding, _ = Examiner(geometry).findings(tip[None], level[None])
    return largest_box(reach(geometry, level if finding[0] == Status.OK else home, cells))


def _home_piece(reached: Reach) -> np.ndarray:
    """Return the mask of the grid points that belong to the piece of the reach nearest to home."""
    pieces, count = ndimage.label(reached.within)
    if count < 2:
        return reached.within
    tip = reached.geometry.tool_pose(reached.geometry.home).position
    where = np.argwhere(reached.within)
    places = np.stack([axis[index] for axis, index in zip(reached.axes, where.T, strict=True)], axis=1)
    nearest = where[np.linalg.norm(places - tip, axis=1).argmin()]
    return np.asarray(pieces == pieces[tuple(nearest)])


def _largest_cells(within: np.ndarray) -> tuple[tuple[int, int, int], tuple[int, int, int]] | None:
    """Return the grid indices of the corners of the largest box of points that are all within; None without one.

    For all ranges along z at once, and each start along x, ranges along x grow; along y the longest run is wanted.
    """
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


def _grown(examiner: Examiner, reached: Reach, box: np.ndarray) -> tuple[np.ndarray, dict[str, str]]:
    """Move each face out until a limit stops it, at most by a cell at a time; return the box and what stops each."""
    causes = {}
    step = reached.spacing * 0.5**HALVINGS
    for name, (axis, side) in zip(FACES, ((axis, side) for axis in range(3) for side in (0, 1)), strict=True):
        way = 2.0 * side - 1.0
        inside, beyond = 0.0, reached.spacing
        while _fits(examiner, reached.rotation, _moved(box, axis, side, way * beyond)):
            inside, beyond = beyond, beyond + reached.spacing
        while beyond - inside > step:
            middle = 0.5 * (inside + beyond)
            fits = _fits(examiner, reached.rotation, _moved(box, axis, side, way * middle))
            inside, beyond = (middle, beyond) if fits else (inside, middle)
        causes[name] = _cause(examiner, reached.rotation, _moved(box, axis, side, way * beyond))
        box = _moved(box, axis, side, way * inside)
    return box, causes


def _moved(box: np.ndarray, axis: int, side: int, way: float) -> np.ndarray:
    moved = box.copy()
    moved[side, axis] += way
    return moved


def _fits(examiner: Examiner, rotation: np.ndarray, box: np.ndarray) -> bool:
    findings, _ = examiner.findings(_points(box), rotation[None])
    return bool((findings == Status.OK).all())


def _cause(examiner: Examiner, rotation: np.ndarray, box: np.ndarray) -> str:
    """Return what most of the points of a box that are not within break, with the struts concerned."""
    findings, struts = examiner.findings(_points(box), rotation[None])
    out = findings[findings != Status.OK]
    code = int(np.bincount(out).argmax())
    concerned = np.unique(struts[findings == code])
    names = ", ".join(str(strut + 1) for strut in concerned if strut >= 0)
    return FINDINGS[code] + (f", strut {names}" if names else "")


def _points(box: np.ndarray) -> np.ndarray:
    """Return points of a box, inside and on all faces, shape (N, 3)."""
    axes = [np.linspace(low, high, SAMPLES) for low, high in box.T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
