"""Length map: a smooth length error along each strut's screw, as a natural cubic spline over the strut command."""

from __future__ import annotations

import numpy as np

from ...machine.geometry import STRUT_NAMES
from ...machine.struts import natural_spline
from ..assumptions import ASSUMED
from .block import Draft, Facts, Linkage, StrutBlock


def map_knots(low: float, high: float) -> np.ndarray:
    """Return equidistant knots, m, over the range `low` to `high` of strut commands."""
    span = max(high - low, ASSUMED.knot_distance)
    return np.linspace(low, low + span, int(np.ceil(span / ASSUMED.knot_distance)) + 1)


def map_root(knots: np.ndarray) -> np.ndarray:
    """Return a root (n, n) of the matrix of Matérn 5/2 correlations between the n knots of a strut."""
    d = np.sqrt(5.0) * np.abs(knots[:, None] - knots) / ASSUMED.map_correlation
    return np.linalg.cholesky((1.0 + d + d * d / 3.0) * np.exp(-d) + 1e-9 * np.eye(len(knots)))


class LengthMap(StrutBlock):
    name, unit, tolerance = "map", "m", 5e-6

    def __init__(self, knots: np.ndarray) -> None:
        self.knots = knots
        labels = tuple(f"{s} {self.name} at {1e3 * k:.0f} mm" for s in STRUT_NAMES for k in knots)
        super().__init__(labels, map_root(knots))
        self._cardinal = natural_spline(knots, np.eye(len(knots)))

    @classmethod
    def of(cls, facts: Facts) -> LengthMap:
        return cls(map_knots(*facts.region.commands))

    def weights(self, commands: np.ndarray) -> np.ndarray:
        """Return the weights (…, knots) of the knots' values at `commands` (…), m; constant beyond the end knots."""
        inside = np.clip(commands, *self.knots[[0, -1]])
        piece = np.clip(np.searchsorted(self.knots, inside, side="right") - 1, 0, len(self.knots) - 2)
        along = (inside - self.knots[piece])[..., None]
        values = self._cardinal[0][piece]
        for coefficients in self._cardinal[1:]:
            values = values * along + coefficients[piece]
        return values

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        return self.weights(linkage.stations.commands)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        if x.any():
            draft.struts |= {"map_knots": self.knots, "map_values": x.reshape(6, -1)}
