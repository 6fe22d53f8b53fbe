"""Pitch: the relative error of each screw's lead."""

from __future__ import annotations

import numpy as np

from .block import Draft, Facts, Linkage, StrutBlock


class Pitch(StrutBlock):
    """Pitch error p of each strut: δl = p · (command − length at home)."""

    name, unit, tolerance = "pitch", "m/m", 100e-6

    def __init__(self, home_lengths: np.ndarray) -> None:
        super().__init__()
        self._home = home_lengths

    @classmethod
    def of(cls, facts: Facts) -> Pitch:
        return cls(facts.home_lengths)

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        return (linkage.stations.commands - self._home)[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.struts["pitch"] = x
