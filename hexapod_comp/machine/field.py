"""The error field of Mou & King: polynomials along grid lines, interpolated between the four lines around a point."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..core import Struct
from ..core.batch import field_at
from ..errors import ModelError
from .terms import term, validate_terms

COMPONENTS = ("dx", "dy", "dz", "rx", "ry", "rz")  # Order of the six error components
# Largest magnitude of each component on any line, m and rad: the arithmetic assumes small rotations
LARGEST = np.repeat([0.05, 0.1], 3)
# For lines along x, y, z: the two other axes, in the order of the node indices that name a line
CROSS_AXES = ((1, 2), (0, 2), (0, 1))
OUTSIDE_POLICIES = ("hold", "refuse")


@dataclass(frozen=True)
class GridField:
    """Error of the measured point as a function of its position in a box, for forward and for backward motion."""

    # Increasing node coordinates along x, y, z in ``base``, m, at least two each; the outer nodes bound the box
    grid: tuple[np.ndarray, np.ndarray, np.ndarray]
    # Coefficients of the lines along x, y, z, each (2, n, m, 6, K), by direction (forward, backward), node on each of
    # the two other axes, component, and power of u, which runs from −1 to 1 over the box; K = 0: no line was measured
    lines: tuple[np.ndarray, np.ndarray, np.ndarray]
    probe: np.ndarray = term("field", "mm", "position in platform of the point whose error was measured", (3,))
    outside: str = "hold"  # outside the box: ``hold`` the value at the box's boundary, or ``refuse`` the pose
    # The default is larger than the motion that backlash of the struts causes along an axis without commanded motion
    reversal_threshold: float = term(
        "field", "um", "distance that an axis moves back until its direction counts as reversed", (), 1e-5, least=0.0
    )

    def __post_init__(self) -> None:
        grid = tuple(np.array(nodes, dtype=float) for nodes in self.grid)
        lines = tuple(np.array(family, dtype=float, order="C") for family in self.lines)
        for axis, nodes in zip("xyz", grid, strict=True):
            if nodes.ndim != 1 or len(nodes) < 2 or not (np.isfinite(nodes).all() and (np.diff(nodes) > 0).all()):
                raise ModelError(f"field.grid_{axis}", "needs at least two increasing nodes", nodes.tolist())
        for axis, family, cross in zip("xyz", lines, CROSS_AXES, strict=True):
            wanted = (2, len(grid[cross[0]]), len(grid[cross[1]]), 6)
            if family.ndim != 5 or family.shape[:4] != wanted:
                raise ModelError(f"field.lines_{axis}", f"must have shape {wanted} × powers, not {family.shape}")
            if not np.isfinite(family).all():
                raise ModelError(f"field.lines_{axis}", "must be finite")
        if self.outside not in OUTSIDE_POLICIES:
            raise ModelError("field.outside", f"must be one of {', '.join(OUTSIDE_POLICIES)}", self.outside)
        object.__setattr__(self, "grid", grid)
        object.__setattr__(self, "lines", lines)
        validate_terms(self)

    @property
    def box(self) -> np.ndarray:
        """Corners of the measured box, shape (2, 3), m in ``base``."""
        return np.array([[nodes[0] for nodes in self.grid], [nodes[-1] for nodes in self.grid]])

    def evaluate(self, position: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, bool]:
        """Return the error, (6,), m and rad, at a position, (3,), m in ``base``, and whether it is outside the box."""
        error = np.empty(6)
        position = np.array(position, dtype=float)
        return error, bool(field_at(self._struct, position, np.array(sense, dtype=float), error))

    def plus(self, error: np.ndarray) -> GridField:
        """Return the field with the same error, (6,), m and rad, added at all positions."""
        axis = next((axis for axis, family in enumerate(self.lines) if family.shape[4]), 0)
        family = self.lines[axis].copy() if self.lines[axis].shape[4] else np.zeros((*self.lines[axis].shape[:4], 1))
        family[..., 0] += error
        x, y, z = (family if n == axis else other for n, other in enumerate(self.lines))
        return replace(self, lines=(x, y, z))

    @functools.cached_property
    def _struct(self) -> Struct:
        return Struct("hc_field", self.members())

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_struct"}

    def members(self) -> dict[str, Any]:
        """Return the C struct ``hc_field`` as values by member name."""
        return {
            "probe": self.probe,
            "node_count": [len(nodes) for nodes in self.grid],
            "nodes": self.grid,
            "powers": [family.shape[4] for family in self.lines],
            "lines": [family.swapaxes(3, 4) for family in self.lines],
            "refuse_outside": int(self.outside == "refuse"),
        }


def no_field() -> GridField:
    nodes = np.array([-1e3, 1e3])
    empty = np.zeros((2, 2, 2, 6, 0))
    return GridField((nodes, nodes, nodes), (empty, empty, empty))
