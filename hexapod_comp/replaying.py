"""Running a recorded run through the compensator again: the same answers, bit for bit, or where they part.

Everything that decides an answer is in the recording: the commands before it, and in the journal what happened to
the compensator between them. What a recorder has lost cannot be run again; the next page of the journal, at most a
second later, gives the state to go on from, and what lies between is counted, not judged.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .answers import Answers
from .compensation import Compensator
from .compensation_kernels import pack_pose
from .errors import CommandError, HexapodError
from .geometry import HexapodGeometry
from .journal import Entry, Page
from .pose import Pose
from .recorded_files import Files
from .recording import Recording
from .timeline import Timeline

IDENTICAL, DIFFERENT, UNCERTAIN, LOST, BEFORE = range(5)
"""What came of an answer: the same bits; others; others after a loss of the recorder; not replayed because of
such a loss; not replayed because no page of the journal lies before it."""

TRIALS = 1000
"""So many unexplained commands are tried once more, to see why they were refused."""

NOT_TAKEN = "not_taken"
"""Reason of a command that nothing refuses."""


@dataclass(frozen=True)
class Refused:
    """A command without answer.

    Attributes
    ----------
    number : int
        Which of the recorded commands.
    reason, text : str
        As in diagnostics, and the sentence.
    from_journal : bool
        The compensator itself has said so; else the replay has found it.
    """

    number: int
    reason: str
    text: str
    from_journal: bool


@dataclass
class Replay:
    """What came of a replay.

    Attributes
    ----------
    answers : Answers
        The recorded ones, n of them.
    outcome : ndarray of int, shape (n,)
        One of the module's five constants.
    commands, corrections : ndarray, shape (n, 6)
        Replayed, m; NaN where there is none.
    refused : list of Refused
        Commands without answer.
    refused_now : dict of int to str
        Answers whose commands the replay refuses, with its reason.
    events : list of (int, Entry)
        Changes, each with the number of the answer that it precedes.
    states_differ : list of int
        Answers before which the journal's state was another than the replay's.
    unconfirmed : int
        First answer after the last page: what the recorder lost from there on nobody can tell.
    """

    answers: Answers
    outcome: np.ndarray
    commands: np.ndarray
    corrections: np.ndarray
    refused: list[Refused] = field(default_factory=list)
    refused_now: dict[int, str] = field(default_factory=dict)
    events: list[tuple[int, Entry]] = field(default_factory=list)
    states_differ: list[int] = field(default_factory=list)
    unconfirmed: int = 0

    @property
    def compared(self) -> int:
        """How many answers could be compared."""
        return int(np.isin(self.outcome, (IDENTICAL, DIFFERENT)).sum())

    @property
    def identical(self) -> bool:
        """Whether whatever could be compared is the same, and something could."""
        return bool((self.outcome == IDENTICAL).any()) and not (self.outcome == DIFFERENT).any()

    @property
    def difference(self) -> np.ndarray:
        """Replayed minus recorded corrections, shape (n, 6), m; commands where corrections were not recorded."""
        recorded = self.answers.corrections
        return np.where(np.isnan(recorded), self.commands - self.answers.commands, self.corrections - recorded)


class _Machine:
    """A compensator that is taken through a timeline."""

    def __init__(self, recording: Recording, files: Files) -> None:
        self._asked = recording.topics["tool_pose_command"]
        self._files = files
        self._running: tuple[str, str] | None = None
        self.compensator: Compensator | None = None
        self._frames: dict[str, np.ndarray] = {}

    def take_over(self, page: Page) -> bool:
        """Go on from a page's snapshot; return whether that is another state than the present one."""
        identity = page.geometry["sha256"], page.model["sha256"]
        if self.compensator is None or identity != self._running:
            geometry = self._files.geometry(page.geometry)
            self.compensator = Compensator(geometry, self._files.model(page.model, geometry))
            self._running = identity
            self._frames = packed_frames(page, geometry)
        elif _same_state(self.compensator.snapshot(), page.snapshot):
            return False
        self.compensator.restore(page.snapshot)
        return True

    def apply(self, entry: Entry) -> None:
        """Make a change that the journal tells of."""
        if self.compensator is None:
            return
        if entry.what == "model":
            model = self._files.model(entry.values, self.compensator.geometry)
            self.compensator.set_model(model)
            if self._running is not None:
                self._running = self._running[0], entry.values["sha256"]
            return
        apply(self.compensator, entry)

    def step(self, number: int, stamp: int) -> Compensator:
        """Give one recorded command, answered with `stamp`, ns; return the compensator with its answer."""
        if self.compensator is None:
            raise CommandError(NOT_TAKEN, "nothing is known of the compensator's state")
        give(self.compensator, self._frames, self._asked.frames[number], self._asked.values[number], stamp)
        return self.compensator

    def trial(self, number: int) -> HexapodError | None:
        """Give one command and take it back; return why it is refused, if it is."""
        if self.compensator is None:
            return None
        before = self.compensator.snapshot()
        try:
            self.step(number, int(self._asked.stamps[number]))
        except HexapodError as error:
            return error
        self.compensator.restore(before)
        return None


def apply(compensator: Compensator, entry: Entry) -> None:
    """Make a change of temperature or switching, or a start, that the journal tells of."""
    values = entry.values
    if entry.what == "temperature":
        compensator.set_temperature(values["name"], float(values["value"]))
    elif entry.what == "enable":
        compensator.enable(bool(values["on"]))
    elif entry.what == "reset":
        measured = values["measured"]
        compensator.reset(None if measured is None else np.array(measured, dtype=float))


def packed_frames(page: Page, geometry: HexapodGeometry) -> dict[str, np.ndarray]:
    """Return the frames of commanded poses by their frame_id, packed as the compensator takes them."""
    frames = {page.frames["base"]: pack_pose(Pose.identity())}
    frames[page.frames["work"]] = pack_pose(geometry.work)
    return frames


def give(
    compensator: Compensator, frames: Mapping[str, np.ndarray], frame_id: str, numbers: np.ndarray, stamp: int
) -> None:
    """Give a recorded command as the node does, the answer's stamp (ns) for its time."""
    frame = frames.get(frame_id)
    if frame is None:
        raise CommandError("frame_id", f"frame_id must be one of {', '.join(frames)}, not {frame_id!r}")
    compensator.step(tuple(numbers.tolist()), stamp * 1e-9, frame)


def _same_state(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two snapshots are the same, all NaN being one number."""
    arrays = ("state", "poses", "switches")
    same = all(np.array_equal(np.asarray(one[name]), np.asarray(other[name]), equal_nan=True) for name in arrays)
    return same and dict(one["temperatures"]) == dict(other["temperatures"])


def replay(
    recording: Recording,
    timeline: Timeline,
    files: Files,
    progress: Callable[[int], object] = lambda answers: None,
) -> Replay:
    """Run a recording through the compensator again.

    Parameters
    ----------
    recording : Recording
        What was read.
    timeline : Timeline
        The same in order.
    files : Files
        Geometry and model in use.
    progress : callable, optional
        Called with the number of answers just compared.

    Raises
    ------
    InputFileError
        Geometry or model in use are not at hand.
    """
    run = _Run(recording, timeline, files)
    for row in range(len(timeline.answers) + 1):
        run.happen(row)
        if row < len(timeline.answers):
            run.answer(row)
            progress(1)
    run.examine(None)
    return run.result


class _Run:
    """A replay under way."""

    def __init__(self, recording: Recording, timeline: Timeline, files: Files) -> None:
        answers = timeline.answers
        self._timeline, self._machine = timeline, _Machine(recording, files)
        self._known, self._outcome_unknown = False, BEFORE
        self._unanswered = iter(timeline.unanswered)
        self._next_unanswered = next(self._unanswered, None)
        self._said = _said(recording)
        self._asked = recording.topics["tool_pose_command"]
        self._trials = 0
        shape = len(answers), 6
        self.result = Replay(answers, np.full(len(answers), BEFORE), np.full(shape, np.nan), np.full(shape, np.nan))
        self.result.unconfirmed = timeline.unconfirmed

    def happen(self, row: int) -> None:
        """Make the changes that come before an answer."""
        for entry, page in self._timeline.events.get(row, ()):
            if entry is None:
                self._turn(row, page)
            elif entry.what != "refused":
                self.result.events.append((row, entry))
                if self._known:
                    self._machine.apply(entry)

    def _turn(self, row: int, page: Page) -> None:
        """Take over a page's snapshot; that it is another state matters only where nothing was lost."""
        changed = self._machine.take_over(page)
        if changed and self._known and row and not self._timeline.doubtful[row - 1]:
            self.result.states_differ.append(row)
        self._known = True

    def answer(self, row: int) -> None:
        """Give the command that was answered, and compare."""
        result, number = self.result, int(self._timeline.answers.asked[row])
        if number >= 0:
            self.examine(number)
        if not self._known:
            result.outcome[row] = self._outcome_unknown
            return
        if number < 0:
            result.outcome[row] = LOST
            self._lose()
            return
        same = self._step(row, number)
        if same:
            result.outcome[row] = IDENTICAL
        elif self._timeline.doubtful[row]:
            result.outcome[row] = UNCERTAIN
            self._lose()
        else:
            result.outcome[row] = DIFFERENT

    def _lose(self) -> None:
        """Go on at the next page only."""
        self._known, self._outcome_unknown = False, LOST

    def _step(self, row: int, number: int) -> bool:
        answers, result = self._timeline.answers, self.result
        try:
            compensator = self._machine.step(number, int(answers.stamps[row]))
        except HexapodError as error:
            result.refused_now[row] = f"{error.reason}: {error}"
            return False
        result.commands[row], result.corrections[row] = compensator.command, compensator.correction
        return all(
            np.isnan(recorded).all() or recorded.tobytes() == replayed.tobytes()
            for recorded, replayed in (
                (answers.commands[row], compensator.command),
                (answers.corrections[row], compensator.correction),
            )
        )

    def examine(self, before: int | None) -> None:
        """Say why the commands before a number, or all that are left, have no answer."""
        while self._next_unanswered is not None and (before is None or self._next_unanswered < before):
            self.result.refused.append(self._explained(self._next_unanswered))
            self._next_unanswered = next(self._unanswered, None)

    def _explained(self, number: int) -> Refused:
        said = self._said.get(int(self._asked.stamps[number]))
        if said:
            return Refused(number, *said.pop(0), from_journal=True)
        self._trials += 1
        error = self._machine.trial(number) if self._known and self._trials <= TRIALS else None
        if error is not None:
            return Refused(number, error.reason, str(error), from_journal=False)
        text = "not active, or the command did not reach it, or the recorder lost its answer"
        return Refused(number, NOT_TAKEN, text, from_journal=False)


def _said(recording: Recording) -> dict[int, list[tuple[str, str]]]:
    """Return what the journal says about refused commands, by stamp."""
    said: dict[int, list[tuple[str, str]]] = defaultdict(list)
    for _, page in recording.pages:
        for entry in page.entries:
            if entry.what == "refused":
                stamp, reason, text = (entry.values[key] for key in ("stamp", "reason", "text"))
                said[int(stamp)].append((str(reason), str(text)))
    return said
