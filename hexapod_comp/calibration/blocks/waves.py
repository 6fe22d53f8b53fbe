"""Screw waves: length errors that repeat in each turn of a screw once, or twice to four times (harmonics)."""

from __future__ import annotations

import numpy as np

from ...machine.geometry import STRUT_NAMES
from .block import Draft, Facts, Linkage, StrutBlock


class Wave(StrutBlock):
    """Amplitudes A and B of each strut: δl = A·cos(2πnc/p) + B·sin(2πnc/p), with command c, lead p, n = `times`."""

    name, unit, tolerance, times = "wave", "m", 5e-6, 1

    def __init__(self, periods: np.ndarray) -> None:
        super().__init__(tuple(f"{s} {self.name} {part}" for s in STRUT_NAMES for part in ("cosine", "sine")))
        self._periods = periods

    @classmethod
    def of(cls, facts: Facts) -> Wave | None:
        return cls(facts.periods) if np.isfinite(facts.periods).all() else None

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        phase = 2.0 * np.pi * self.times * linkage.stations.commands / self._periods
        return np.stack([np.cos(phase), np.sin(phase)], axis=-1)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        draft.struts["cosine"][:, self.times - 1], draft.struts["sine"][:, self.times - 1] = x.reshape(6, 2).T


class Wave2(Wave):
    name, tolerance, times = "wave 2", 1e-6, 2


class Wave3(Wave):
    name, tolerance, times = "wave 3", 1e-6, 3


class Wave4(Wave):
    name, tolerance, times = "wave 4", 1e-6, 4
