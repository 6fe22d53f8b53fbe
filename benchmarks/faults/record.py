"""What the harness saw during one episode: every message with the time at which it came or left."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

LINKS = ("pose", "command", "feedback")
"""Controller to compensator, compensator to drive, drive to compensator: a wire of the harness lies in each."""

NODES = ("compensator", "strut_drive", "mover")


@dataclass
class Sent:
    """One good command of the controller; monotonic times, s, NaN while unanswered."""

    sent_at: float
    answered_at: float = math.nan


@dataclass(frozen=True)
class Struts:
    """Six lengths as one message had them, m, shape (6,); NaN where it had none.

    Attributes
    ----------
    time : float
        When it came or was delivered, or, a command, when the compensator's middleware sent it, monotonic, s.
    """

    time: float
    lengths: np.ndarray


@dataclass(frozen=True)
class Status:
    """One diagnostics status.

    Attributes
    ----------
    time : float
        When it came, monotonic, s.
    node : str
        Who says it.
    level : int
        0 is well, 1 a warning, 2 an error.
    message : str
        What a person reads.
    values : dict of str to str
        The rest.
    """

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
    """One fault as it happened.

    Attributes
    ----------
    kind : str
        Which.
    began, ended : float
        Monotonic times, s: of doing it, and of having undone it.
    marks : list of float
        When something wrong was delivered, for the kinds whose visibility is that.
    detail : str
        What was drawn.
    standing : list of (float, float)
        From when to when no command may be published, whatever comes.
    breaches : list of str
        What else was done and must not be.
    """

    kind: str
    began: float
    ended: float = math.nan
    marks: list[float] = field(default_factory=list)
    detail: str = ""
    standing: list[tuple[float, float]] = field(default_factory=list)
    breaches: list[str] = field(default_factory=list)


@dataclass
class Record:
    """One episode.

    Attributes
    ----------
    sent : dict of int to Sent
        Good commands by stamp, ns.
    commands, corrections : list of Struts
        What the compensator published; the first may be the last of the episode before.
    measured : list of Struts
        Encoder readings as they were delivered to the compensator.
    delivered : dict of str to list of float
        When each link delivered a message.
    statuses : list of Status
        Of both nodes.
    outages : dict of str to list of (float, float)
        When a process was dead or stopped; the end of one is the moment at which it said that it is ready.
    killed : dict of str to list of (float, float)
        Those of the outages in which a process was killed: its successor does not know what it received.
    fresh_starts : list of float
        When a compensator was started or reset: its next command starts from the measured struts.
    faults : list of Happened
        What went wrong.
    ended : float
        When the record ends, monotonic, s: what was sent just before has had no time to be answered.
    """

    sent: dict[int, Sent] = field(default_factory=dict)
    commands: list[Struts] = field(default_factory=list)
    corrections: list[Struts] = field(default_factory=list)
    measured: list[Struts] = field(default_factory=list)
    delivered: dict[str, list[float]] = field(default_factory=lambda: {link: [] for link in LINKS})
    statuses: list[Status] = field(default_factory=list)
    outages: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {node: [] for node in NODES})
    killed: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {node: [] for node in NODES})
    fresh_starts: list[float] = field(default_factory=list)
    faults: list[Happened] = field(default_factory=list)
    ended: float = math.inf

    def said(self, node: str) -> list[Status]:
        """Return the statuses of a node, oldest first."""
        return [status for status in self.statuses if status.node == node]

    def continued(self) -> Record:
        """Return the record of the next episode, which knows what the last one ended with."""
        following = Record(commands=self.commands[-1:], measured=self.measured[-50:])
        following.statuses = [status for node in NODES for status in self.said(node)[-1:]]
        for link in LINKS:
            following.delivered[link] = self.delivered[link][-1:]
        return following


class Told:
    """What the struts were told, to hold readings against.

    Parameters
    ----------
    commands : list of Struts
        Oldest first.
    """

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
