"""Backlash: a strut's nut lags behind its screw by half the backlash in either direction of motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .block import Block, Draft, Facts, Linkage, StrutBlock
from .length_map import LengthMap, map_knots


class Backlash(StrutBlock):
    """Backlash b of each strut: δl = −b/2 · s; s = ±1: direction in which the strut moved last."""

    name, unit, tolerance = "backlash", "m", 5e-6

    @classmethod
    def of(cls, facts: Facts) -> Backlash:
        return cls()

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        return -0.5 * linkage.stations.sense[:, 3:, None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.struts["backlash"] = np.maximum(x, 0.0)  # :mod:`..fit` adds a note on a negative estimate


class BacklashMap(LengthMap):
    """Variation of the backlash along a worn screw: a spline with half as many knots as the length map."""

    name, unit, tolerance = "backlash map", "m", 2e-6

    @classmethod
    def of(cls, facts: Facts) -> BacklashMap:
        knots = map_knots(*facts.region.commands)
        block = cls(knots[np.linspace(0, len(knots) - 1, max(2, (len(knots) - 1) // 2 + 1)).round().astype(int)])
        block.model_knots = knots
        return block

    model_knots: np.ndarray  # knots of the length map, m; in a model file both maps have the same knots

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        return -0.5 * linkage.stations.sense[:, 3:, None] * self.weights(linkage.stations.commands)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the backlash map into the draft, with a value at each knot of the length map."""
        if x.any():
            draft.struts |= {
                "map_knots": self.model_knots,
                "map_backlash": x.reshape(6, -1) @ self.weights(self.model_knots).T,
            }


def without_negative(blocks: Sequence[Block], x: np.ndarray, sense: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and directions of motion that describe the same machine without a negative backlash.

    A strut with backlash −b is described by b and the opposite direction of motion. Noise or swapped directions can
    make an estimate negative; if a step of a fit set it to zero, the next step would make it negative again.
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
