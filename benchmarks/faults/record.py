"""The record of one episode: every message with the monotonic time, s, at which it was received or sent."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

# Links: controller to compensator, compensator to drive, drive to compensator; the harness has a wire for each
LINKS = ("pose", "command", "feedback")
NODES = ("compensator", "strut_drive", "mover")


@dataclass
class Sent:
    """A valid command of the controller."""

    sent_at: float
    answered_at: float = math.nan


@dataclass(frozen=True)
class Struts:
    time: float  # of delivery; of a command: when the compensator sent it
    lengths: np.ndarray  # (6,): m; NaN: missing


@dataclass(frozen=True)
class Status:
    """A node's status in diagnostics; level 0: OK, 1: warning, 2: error."""

    time: float
    node: str
    level: int
    message: str
    values: dict[str, str]

    def text(self) -> str:
        """Return message and values, a line each."""
        return "\n".join([self.message, *(f"{key}={value}" for key, value in self.values.items())])


@dataclass
class Happened:
    kind: str
    began: float
    ended: float = math.nan  # when the fault was removed
    marks: list[float] = field(default_factory=list)  # times at which wrong messages were delivered
    detail: str = ""  # drawn properties of the fault
    halts: list[tuple[float, float]] = field(default_factory=list)  # intervals in which no command may be published
    breaches: list[str] = field(default_factory=list)  # other forbidden reactions


@dataclass
class Record:
    sent: dict[int, Sent] = field(default_factory=dict)  # valid commands by stamp, ns
    commands: list[Struts] = field(default_factory=list)  # the first may be the last command of the episode before
    corrections: list[Struts] = field(default_factory=list)
    measured: list[Struts] = field(default_factory=list)  # as delivered to the compensator
    # times of delivery by link
    delivered: dict[str, list[float]] = field(default_factory=lambda: {link: [] for link in LINKS})
    statuses: list[Status] = field(default_factory=list)
    # Intervals from the death or stop of a node until it was ready; then those of killed nodes only
    outages: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {node: [] for node in NODES})
    killed: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {node: [] for node in NODES})
    fresh_starts: list[float] = field(default_factory=list)  # of the compensator, by start or reset
    faults: list[Happened] = field(default_factory=list)
    ended: float = math.inf

    def said(self, node: str) -> list[Status]:
        return [status for status in self.statuses if status.node == node]

    def continued(self) -> Record:
        """Return the next episode's record, which begins with the last messages of this record."""
        following = Record(commands=self.commands[-1:], measured=self.measured[-50:])
        following.statuses = [status for node in NODES for status in self.said(node)[-1:]]
        following.delivered = {link: times[-1:] for link, times in self.delivered.items()}
        return following


class CommandHistory:
    """Strut commands over time, for comparison with measured struts."""

    def __init__(self, commands: list[Struts]) -> None:
        self._times = np.array([command.time for command in commands])
        self._lengths = np.array([command.lengths for command in commands]).reshape(-1, 6)

    def deviation(self, reading: Struts, window: float) -> float:
        """Return the largest distance of a measured strut from the range of its commands in the last `window`, s, in m.

        The command before the window belongs to this range. Before the first command the result is 0.
        """
        since, until = np.searchsorted(self._times, [reading.time - window, reading.time])
        valid = self._lengths[max(since - 1, 0) : until]
        if not len(valid):
            return 0.0
        off = float(np.maximum(valid.min(axis=0) - reading.lengths, reading.lengths - valid.max(axis=0)).max())
        return off if math.isfinite(off) else math.inf


def lengths_of(position: Iterable[float]) -> np.ndarray:
    """Return six lengths, m; NaN unless there are exactly six numbers."""
    lengths = np.array(list(position), dtype=float)
    return lengths if lengths.shape == (6,) else np.full(6, np.nan)
