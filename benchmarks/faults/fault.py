"""What a fault of an episode is, and when one is visible and to whom."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from .record import Happened
from .rig import Rig
from .visible import COMMAND_TIMEOUT, DRIVE_TIMEOUT, FEEDBACK_TIMEOUT


@dataclass(frozen=True)
class Meaning:
    """When a fault is visible and to whom, and what that node must say."""

    visible: str
    said: str


SILENT = {
    "pose": Meaning(f"no pose command has been delivered for {COMMAND_TIMEOUT:g} s", "compensator: no new command"),
    "command": Meaning(f"no strut command has been delivered for {DRIVE_TIMEOUT:g} s", "strut_drive: no new command"),
    "feedback": Meaning(f"no reading has been delivered for {FEEDBACK_TIMEOUT:g} s", "compensator: feedback lost"),
}


class Fault(ABC):
    """One fault of an episode: drawn at once, done and undone when it is its turn.

    Parameters
    ----------
    rng : Generator
        Of this fault alone.
    """

    kind: str
    meaning: Meaning
    touches: frozenset[str]
    """What it needs for itself: two faults that touch the same are not drawn together."""

    shortest, longest = 0.4, 1.0
    """How long it lasts, s."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.duration = float(rng.uniform(self.shortest, self.longest))
        self.detail = ""

    @abstractmethod
    def begin(self, rig: Rig, happened: Happened) -> None:
        """Do it."""

    @abstractmethod
    def end(self, rig: Rig, happened: Happened) -> None:
        """Undo it."""

    def over(self, rig: Rig) -> bool:
        """Return whether it is over after :meth:`end`: a process takes a while to start."""
        return True
