"""Running a recorded run through the compensator again: the same answers, bit for bit, or the first difference.

Everything that determines an answer is in the journal, in its order. Answers after a lost page cannot be replayed; the
next snapshot, at most half a second later, gives the state to continue from, and the answers between are counted, not
compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..compensation.compensator import BESIDE_NUMBERS, PLACES, Compensator, pack_pose
from ..compensation.journal import SETTERS, Entry, Snapshot, time_of
from ..errors import FrameError, HexapodError
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from .bag import Files, Recording

# Outcome of an answer: the same bits; others; not replayed because the recorder has lost a page before it; not
# replayed because no snapshot lies before it
IDENTICAL, DIFFERENT, LOST, BEFORE = range(4)

Progress = Callable[[int], object]  # called with the number of answers just compared


@dataclass(frozen=True)
class Event:
    """An entry of the journal in its place."""

    row: int  # number of the answer that it precedes
    time: int  # when the recorder received it, ns: up to 50 ms later
    entry: Entry  # what happened


@dataclass
class Replay:
    """Result of a replay.

    Attributes
    ----------
    commands : ndarray of COMMAND
        The recorded ones, n of them.
    outcome : ndarray of int, shape (n,)
        One of the module's four constants.
    lengths : ndarray, shape (n, 2, 6)
        Replayed strut commands and corrections, m; NaN where there is none.
    refused_now : dict of int to str
        Answers whose commands the replay refuses, with its reason.
    changes, refused : list of Event
        What happened between the answered commands.
    states_differ : list of int
        Answers before which the journal's snapshot was another than the replay's.
    lost : int
        Answers that the journal counts, and whose pages the recorder has lost.
    """

    commands: np.ndarray
    outcome: np.ndarray
    lengths: np.ndarray
    refused_now: dict[int, str] = field(default_factory=dict)
    changes: list[Event] = field(default_factory=list)
    refused: list[Event] = field(default_factory=list)
    states_differ: list[int] = field(default_factory=list)
    lost: int = 0

    @property
    def compared(self) -> int:
        return int(np.isin(self.outcome, (IDENTICAL, DIFFERENT)).sum())

    @property
    def identical(self) -> bool:
        """Whether all compared answers are the same, and at least one was compared."""
        return bool((self.outcome == IDENTICAL).any()) and not (self.outcome == DIFFERENT).any()

    @property
    def difference(self) -> np.ndarray:
        """Replayed minus recorded corrections, shape (n, 6), m."""
        return self.lengths[:, 1] - self.commands["lengths"][:, 1]

    @property
    def different(self) -> np.ndarray:
        return np.flatnonzero(self.outcome == DIFFERENT)

    @property
    def largest_difference(self) -> float:
        """Of the corrections that differ, m; those of commands that are refused now do not count."""
        return float(np.nanmax(np.abs(self.difference[self.different]), initial=0.0))


def replay_recording(
    recording: Recording, files: Files | None = None, progress: Progress = lambda commands: None
) -> Replay:
    """Run a recording through the compensator again.

    Parameters
    ----------
    recording : Recording
        What was read.
    files : Files, optional
        Geometry and model in use; by default as the recording carries them.
    progress : callable, optional
        Called with the number of answers just compared.

    Raises
    ------
    InputFileError
        Geometry or model in use are not at hand.
    """
    return _Run(recording, progress, files or Files(recording, {})).run()


def what_if(
    recording: Recording, geometry: HexapodGeometry, model: MachineModel, progress: Progress = lambda commands: None
) -> Replay:
    """Run the recorded commands through another model, or another geometry."""
    # Temperatures, humidity, switching and starts are those of the recording; its own models are not. The corrections
    # begin at the other model's: nothing ramps. All answers are run; nothing is left out after lost pages. Of the
    # Of the snapshot only those parts are used that hold for another machine: directions, switches, the tool's name.
    compensator, state = Compensator(geometry, model), recording.first.state
    kept = ("temperatures", "tool", "loading", "outside", "motion_sense", "enabled", "resumes", "ramp_rate")
    fresh = compensator.snapshot() | {name: value for name, value in state.items() if name in kept}
    compensator.restore(fresh | {"motion_sense": np.nan_to_num(fresh["motion_sense"])})
    run = _Run(recording, progress, None)
    run.use(compensator)
    return run.run()


class _Run:
    """A running replay, page by page: with the recording's files, or with one compensator throughout."""

    compensator: Compensator

    def __init__(self, recording: Recording, progress: Progress, files: Files | None) -> None:
        self._recording, self._progress, self._files = recording, progress, files
        self._commands, count = recording.commands, len(recording.commands)
        self.result = Replay(self._commands, np.full(count, BEFORE), np.full((count, 2, 6), np.nan))
        self._known = files is None  # whether the compensator is in the recorded state
        self._in_use = "", ""  # hashes of its geometry and model

    def use(self, compensator: Compensator) -> None:
        self.compensator = compensator
        self._frames = {name: pack_pose(pose) for name, pose in compensator.geometry.work_frames.items()}

    def run(self) -> Replay:
        row, result, otherwise, expected = 0, self.result, BEFORE, ("", 0, 0)
        for time, page in self._recording.pages:
            if self._files is not None:  # after a lost page nothing is known until the next snapshot
                session, _, begins = expected
                self._known &= expected == (page.session, page.number, page.begins)
                if session == page.session:
                    result.lost += max(0, page.begins - begins)
                expected = page.session, page.number + 1, page.begins + len(page.commands)
            for entry in page.steps():
                if entry is None:
                    result.outcome[row] = self._step(row) if self._known else otherwise
                    row += 1
                    self._progress(1)
                elif entry.what == "refused":
                    result.refused.append(Event(row, time, entry))
                else:
                    result.changes.append(Event(row, time, entry))
                    if self._known:
                        self._change(entry)
            if self._files is not None and page.snapshot is not None:
                self._resume(self._files, page.snapshot, row)
                self._known, otherwise = True, LOST
        return result

    def _change(self, entry: Entry) -> None:
        if entry.what == "model":
            if self._files is not None:
                self.compensator.set_model(self._files.model(entry.values, self.compensator.geometry))
                self._in_use = self._in_use[0], entry.values["sha256"]
        elif entry.what != "drift" or self._files is not None:
            getattr(self.compensator, SETTERS[entry.what])(*entry.values.values())

    def _step(self, row: int) -> int:
        """Pass on the answered command as the node did; return the outcome."""
        asked, given = self._commands[row], self.result.lengths[row]
        try:
            frame = self._frames.get(name := self._recording.frames[row])
            if frame is None:
                raise FrameError(f"the machine has no work frame {name!r}")
            time = time_of(int(asked["stamp"]), bool(asked["stamped"]))
            self.compensator.step(tuple(asked["pose"].tolist()), time, frame, float(asked["received"]))
        except HexapodError as error:
            self.result.refused_now[row] = f"{error.reason}: {error}"
            return DIFFERENT
        self.compensator.published(float(asked["published"]))
        given[0], given[1] = self.compensator.command, self.compensator.correction
        return IDENTICAL if given.tobytes() == asked["lengths"].tobytes() else DIFFERENT

    def _resume(self, files: Files, snapshot: Snapshot, row: int) -> None:
        """Compare states before answer `row`, and continue from the recorded one."""
        in_use = snapshot.geometry["sha256"], snapshot.model["sha256"]
        same = in_use == self._in_use
        if not same:
            geometry = files.geometry(snapshot.geometry)
            self.use(Compensator(geometry, files.model(snapshot.model, geometry)))
        if not same or not _same_state(self.compensator.snapshot(), snapshot.state):
            self.compensator.restore(snapshot.state)
            if self._known:
                self.result.states_differ.append(row)
        self._in_use = in_use


def _same_state(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two snapshots are the same, all NaN being one number."""
    if one.keys() != other.keys() or any(one.get(name) != other.get(name) for name in BESIDE_NUMBERS):
        return False
    nowhere = np.isnan(other["nominal"]).any()  # and the platform's pose then has no meaning
    names = [name for name in one if name not in BESIDE_NUMBERS and not (nowhere and name.startswith(PLACES))]
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in names)
