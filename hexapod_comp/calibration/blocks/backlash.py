"""Backlash: a strut's nut lags its screw by half the backlash in either direction; wear varies it along the stroke."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .block import Block, Draft, Facts, Linkage, StrutBlock
from .length_map import LengthMap, map_knots


class Backlash(StrutBlock):
    """Backlash b of each strut, which changes its length by δl = −b/2 · s, with s = ±1 its direction of motion."""

    name, unit, tolerance = "backlash", "m", 5e-6

    @classmethod
    def of(cls, facts: Facts) -> Backlash:
        return cls()

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return −1/2 · direction of motion, the derivative of each strut's length by its backlash, (M, 6, 1)."""
        return -0.5 * linkage.stations.sense[:, 3:, None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the backlashes into a model, with zero for a negative backlash (:mod:`..fit` has a note on it)."""
        draft.struts["backlash"] = np.maximum(x, 0.0)


class BacklashMap(LengthMap):
    """Variation of the backlash along a worn screw: a spline with half as many knots as the length map's."""

    name, unit, tolerance = "backlash map", "m", 2e-6

    @classmethod
    def of(cls, facts: Facts) -> BacklashMap:
        """Return the block for any machine; its knots are about every second knot of the length map."""
        knots = map_knots(*facts.region.commands)
        block = cls(knots[np.linspace(0, len(knots) - 1, max(2, (len(knots) - 1) // 2 + 1)).round().astype(int)])
        block.model_knots = knots
        return block

    model_knots: np.ndarray  # knots of the length map, m; a model file has the same knots for backlash and length map

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return −1/2 · direction of motion · spline weights at the strut command, (M, 6, knots)."""
        return -0.5 * linkage.stations.sense[:, 3:, None] * self.weights(linkage.stations.commands)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the spline's values at all knots of the length map into a model; the spline stays the same."""
        if x.any():
            draft.struts |= {
                "map_knots": self.model_knots,
                "map_backlash": x.reshape(6, -1) @ self.weights(self.model_knots).T,
            }


def without_negative(blocks: Sequence[Block], x: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and directions of motion that describe the same machine without a negative backlash.

    Noise or swapped directions can make an estimated backlash negative. A backlash −b has the same effect as a backlash
    b with the opposite direction. If the estimate were clamped to zero, the next step of the fit would be negative too.
    """
    backlash = next((block for block in blocks if isinstance(block, Backlash)), None)
    if backlash is None:
        return x, sense
    x, sense = x.copy(), sense.copy()
    turned = np.where(x[backlash.part] < 0.0, -1.0, 1.0)
    sense[:, 3:] *= turned
    for block in blocks:
        if isinstance(block, Backlash | BacklashMap):
            x[block.part] *= np.repeat(turned, len(block.labels) // 6)
    return x, sense
