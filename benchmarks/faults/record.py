"""What the harness saw during one episode: every message with the monotonic time, s, at which it came or left."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

# Controller to compensator, compensator to drive, drive to compensator: a wire of the harness lies in each
LINKS = ("pose", "command", "feedback")
NODES = ("compensator", "strut_drive", "mover")


@dataclass
class Sent:
    """One good command of the controller."""

    sent_at: float
    answered_at: float = math.nan


@dataclass(frozen=True)
class Struts:
    """Six lengths as one message had them, m, shape (6,); NaN where it had none."""

    time: float  # when it came or was delivered, or, a command, when the compensator's middleware sent it
    lengths: np.ndarray


@dataclass(frozen=True)
class Status:
    """One diagnostics status of a node; level 0 is well, 1 a warning, 2 an error."""

    time: float
    node: str
    level: int
    message: str
    values: dict[str, str]

    def text(self) -> str:
        """Return message and values as one text to search."""
        return "\n".join([self.message, *(f"{key}={value}" for key, value in self.values.items())])


@dataclass
class Happened:
    """One fault as it happened."""

    kind: str
    began: float
    ended: float = math.nan  # when it was undone
    marks: list[float] = field(default_factory=list)  # when something wrong was delivered, where that makes it visible
    detail: str = ""  # what was drawn
    standing: list[tuple[float, float]] = field(default_factory=list)  # from when to when no command may be published
    breaches: list[str] = field(default_factory=list)  # what else was done and must not be


@dataclass
class Record:
    """One episode."""

    sent: dict[int, Sent] = field(default_factory=dict)  # good commands by stamp, ns
    commands: list[Struts] = field(default_factory=list)  # the first may be the last of the episode before
    corrections: list[Struts] = field(default_factory=list)
    measured: list[Struts] = field(default_factory=list)  # as delivered to the compensator
    # When each link delivered a message
    delivered: dict[str, list[float]] = field(default_factory=lambda: {link: [] for link in LINKS})
    statuses: list[Status] = field(default_factory=list)
    # When a node was dead or stopped, until ready; and of these outages those in which it was killed
    outages: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {node: [] for node in NODES})
    killed: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {node: [] for node in NODES})
    fresh_starts: list[float] = field(default_factory=list)  # of a compensator, from the measured struts
    faults: list[Happened] = field(default_factory=list)
    ended: float = math.inf  # what was sent just before has had no time to be answered

    def said(self, node: str) -> list[Status]:
        return [status for status in self.statuses if status.node == node]

    def continued(self) -> Record:
        """Return the record of the next episode, which knows what the last one ended with."""
        following = Record(commands=self.commands[-1:], measured=self.measured[-50:])
        following.statuses = [status for node in NODES for status in self.said(node)[-1:]]
        following.delivered = {link: times[-1:] for link, times in self.delivered.items()}
        return following


class Told:
    """What the struts were told, oldest first, to hold readings against."""

    def __init__(self, commands: list[Struts]) -> None:
        self._times = np.array([command.time for command in commands])
        self._lengths = np.array([command.lengths for command in commands]).reshape(-1, 6)

    def off(self, reading: Struts, window: float) -> float:
        """Return how far the worst strut of a reading is from all it was told in a window before it, m.

        The command in force when the window began counts too; before the first command nothing is off.
        """
        since, until = np.searchsorted(self._times, [reading.time - window, reading.time])
        told = self._lengths[max(since - 1, 0) : until]
        if not len(told):
            return 0.0
        off = float(np.maximum(told.min(axis=0) - reading.lengths, reading.lengths - told.max(axis=0)).max())
        return off if math.isfinite(off) else math.inf


def lengths_of(position: Iterable[float]) -> np.ndarray:
    """Return six lengths, m, or six NaN when there are not six numbers."""
    lengths = np.array(list(position), dtype=float)
    return lengths if lengths.shape == (6,) else np.full(6, np.nan)
