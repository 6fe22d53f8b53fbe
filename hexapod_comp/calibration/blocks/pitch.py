"""Pitch: the relative error of a screw's lead lengthens its strut in proportion to the strut command."""

from __future__ import annotations

import numpy as np

from .block import Draft, Facts, Linkage, StrutBlock


class Pitch(StrutBlock):
    """Pitch error p of each strut, which changes its length by δl = p · (command − length at home)."""

    name, unit, tolerance = "pitch", "m/m", 100e-6

    def __init__(self, home_lengths: np.ndarray) -> None:
        super().__init__()
        self._home = home_lengths

    @classmethod
    def of(cls, facts: Facts) -> Pitch:
        return cls(facts.home_lengths)

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Return command − length at home, the derivative of each strut's length by its pitch error, (M, 6, 1), m."""
        return (linkage.stations.commands - self._home)[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """Write the pitch errors into a model, whose reference length is the length at home."""
        draft.struts["pitch"] = x
