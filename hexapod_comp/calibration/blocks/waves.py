"""Screw waves: a screw's error repeats with its turn, and several times a turn (harmonics)."""

from __future__ import annotations

import numpy as np

from ...machine.geometry import STRUT_NAMES
from .block import Draft, Facts, Linkage, StrutBlock


class Wave(StrutBlock):
    """A and B of each strut: δl = A·cos(nkc) + B·sin(nkc), with 2π/k the lead and c the command."""

    name, unit, tolerance, times = "wave", "m", 5e-6, 1

    def __init__(self, periods: np.ndarray) -> None:
        super().__init__(tuple(f"{s} {self.name} {part}" for s in STRUT_NAMES for part in ("cosine", "sine")))
        self._periods = periods

    @classmethod
    def of(cls, facts: Facts) -> Wave | None:
        """Only where the lead is known."""
        return cls(facts.periods) if np.isfinite(facts.periods).all() else None

    def lengthening(self, linkage: Linkage) -> np.ndarray:
        """Cosine and sine of the screw's turn."""
        phase = 2.0 * np.pi * self.times * linkage.stations.commands / self._periods
        return np.stack([np.cos(phase), np.sin(phase)], axis=-1)

    def into(self, draft: Draft, x: np.ndarray) -> None:
        """One column of the model's harmonics."""
        draft.struts["cosine"][:, self.times - 1], draft.struts["sine"][:, self.times - 1] = x.reshape(6, 2).T


class Wave2(Wave):
    """The second harmonic."""

    name, tolerance, times = "wave 2", 1e-6, 2


class Wave3(Wave):
    """The third harmonic."""

    name, tolerance, times = "wave 3", 1e-6, 3


class Wave4(Wave):
    """The fourth harmonic."""

    name, tolerance, times = "wave 4", 1e-6, 4
