"""A recording put in order: answers with their commands, and the journal between them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .answers import Answers, gather, losses, places
from .errors import HexapodError
from .geometry import HexapodGeometry
from .journal import Entry, Page
from .kinematics import Structure, strut_lengths
from .pose import Pose
from .recording import Recording


@dataclass
class Timeline:
    """A recording put in order.

    Attributes
    ----------
    answers : Answers
        Recorded answers.
    events : dict of int to list
        Entries and pages (their snapshots) by the number of the answer that they precede.
    doubtful : ndarray of bool, shape (n,)
        The recorder has lost something around there.
    lost : int
        Answers that the journal counts and the recording lacks.
    unanswered : list of int
        Commands without answer.
    unconfirmed : int
        See :class:`Replay`.
    """

    answers: Answers
    events: dict[int, list[tuple[Entry | None, Page]]]
    doubtful: np.ndarray
    lost: int
    unanswered: list[int]
    unconfirmed: int


def put_in_order(recording: Recording, geometry: HexapodGeometry | None) -> Timeline:
    """Match answers with commands, and lay the journal between them.

    Parameters
    ----------
    recording : Recording
        What was read.
    geometry : HexapodGeometry or None
        For telling apart commands of one stamp.
    """
    topics = recording.topics
    asked, frames = topics["tool_pose_command"], recording.pages[0][1].frames

    def lengths(number: int) -> np.ndarray | None:
        if geometry is None:
            return None
        return _nominal(geometry, frames, asked.frames[number], asked.values[number])

    answers = gather(topics["strut_commands"], topics["strut_corrections"], asked, lengths)
    lying = places(recording.pages, answers)
    events: dict[int, list[tuple[Entry | None, Page]]] = defaultdict(list)
    reached = 0
    for (_, page), row in zip(recording.pages, lying, strict=True):
        for place, entry in zip(row, (*page.entries, None), strict=True):
            if place is not None:
                reached = max(reached, min(place, len(answers)))
                events[reached].append((entry, page))
    answered = set(answers.asked.tolist())
    doubtful, lost = losses(recording.pages, lying, len(answers))
    return Timeline(
        answers=answers,
        events=events,
        doubtful=doubtful,
        lost=lost,
        unanswered=[number for number in range(len(asked)) if number not in answered],
        unconfirmed=reached,
    )


def _nominal(
    geometry: HexapodGeometry, frames: Mapping[str, str], frame_id: str, numbers: np.ndarray
) -> np.ndarray | None:
    """Return the nominal lengths of a commanded pose, (6,), m; None when it is no pose or of no frame."""
    try:
        pose = Pose.from_quaternion(numbers[:3], numbers[3:])
        frame = {frames["base"]: Pose.identity(), frames["work"]: geometry.work}[frame_id]
        return strut_lengths(Structure.of(geometry), frame @ pose @ geometry.tool.inverse())
    except (HexapodError, KeyError):
        return None
