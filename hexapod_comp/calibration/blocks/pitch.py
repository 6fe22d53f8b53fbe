"""Pitch: a screw whose lead is wrong by a share lengthens its strut in proportion to the command."""

from __future__ import annotations

import numpy as np

from .block import Draft, Facts, Linkage, StrutBlock


class Pitch(StrutBlock):
    """p of each strut: δl = p · (command − length at home)."""

    name, unit, tolerance = "pitch", "m/m", 100e-6

    def __init__(self, home_lengths: np.ndarray) -> None:
        super().__init__()
        self._home = home_lengths

    @classmethod
    def of(cls, facts: Facts) -> Pitch:
        """Every machine may have it."""
        return cls(facts.home_lengths)

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """command − length at home."""
        return (linkage.stations.commands - self._home)[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """The length at home is the reference of every model."""
        draft.struts["pitch"] = x
