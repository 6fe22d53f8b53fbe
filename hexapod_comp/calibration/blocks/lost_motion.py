"""Lost motion: by how much longer a strut is when it is pulled than when it is pushed, beyond what is stated."""

from __future__ import annotations

import numpy as np

from ...machine.geometry import HexapodGeometry
from ...machine.load import Load
from .block import Draft, Facts, Linkage, StrutBlock
from .load import stated_load, tensions


class LostMotion(StrutBlock):
    """c of each strut: δl = c/2 · the sign of its tension under weight; in proportion where that is nearly none."""

    name, unit, tolerance = "lost motion", "m", 3e-6

    def __init__(self, load: Load, geometry: HexapodGeometry) -> None:
        super().__init__()
        self._load, self._geometry = load, geometry

    @classmethod
    def of(cls, facts: Facts) -> LostMotion | None:
        """Where it is stated what the struts carry; whether a force changed its sign, the settings' blocks report."""
        return cls(stated_load(facts.settings), facts.geometry) if facts.settings.load else None

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Half the sign of the struts' tensions."""
        tension = tensions(self._load, self._geometry, linkage)
        return 0.5 * np.clip(tension / self._load.take_up, -1.0, 1.0)[..., None]

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """It adds to what is stated; a small negative one is noise, and stays."""
        draft.lost_motion = draft.lost_motion + x
