"""Backlash: a strut's nut lags its screw by half of it in either direction; wear varies it along the stroke."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .block import Block, Draft, Facts, Linkage, StrutBlock
from .length_map import LengthMap, map_knots


class Backlash(StrutBlock):
    """b of each strut: δl = −b/2 · its direction of motion."""

    name, unit, tolerance = "backlash", "m", 5e-6

    @classmethod
    def of(cls, facts: Facts) -> Backlash:
        """Every screw may have it."""
        return cls()

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """−1/2 · direction."""
        return -0.5 * linkage.stations.sense[:, 3:, None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Negative backlash, which noise can produce, is written as zero: the fit has refused larger values."""
        draft.struts["backlash"] = np.maximum(x, 0.0)


class BacklashMap(LengthMap):
    """Variation of the backlash along a worn screw: smoother than a length map, with every second of its knots."""

    name, unit, tolerance = "backlash map", "m", 2e-6

    @classmethod
    def of(cls, facts: Facts) -> BacklashMap:
        """Every screw may wear. The backlash is a spline whose knots are every second knot of the length map; a model
        stores its values at all knots of that map, from which the same spline follows."""
        knots = map_knots(*facts.region.commands)
        block = cls(knots[np.linspace(0, len(knots) - 1, max(2, (len(knots) - 1) // 2 + 1)).round().astype(int)])
        block.model_knots = knots
        return block

    model_knots: np.ndarray  # the length map's knots, which models have

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """−1/2 · direction, where the nut stands."""
        return -0.5 * linkage.stations.sense[:, 3:, None] * self.weights(linkage.stations.commands)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Written at the length map's knots."""
        if x.any():
            draft.struts |= {
                "map_knots": self.model_knots,
                "map_backlash": x.reshape(6, -1) @ self.weights(self.model_knots).T,
            }


def without_negative(blocks: Sequence[Block], x: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and directions that mean the same machine without negative backlash.

    A nut cannot lead its screw, but an estimate can be negative: by noise, or for swapped directions. Backlash −b in
    one direction is b in the other; if it were clamped here, the fit would add it again in every step.
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
