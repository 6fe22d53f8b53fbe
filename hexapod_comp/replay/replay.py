"""The replay of a recorded run: a new compensator computes the recorded answers, strut lengths and corrections, from
the journal's commands and inputs; new and recorded answers are compared bit for bit. Answers between a lost page of the
journal and the next snapshot of the compensator's state, at most half a second later, are not compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..compensation.compensator import BESIDE, Compensator, pack_pose
from ..compensation.journal import SETTERS, Entry, Snapshot, time_of
from ..errors import FrameError, HexapodError
from ..machine.geometry import HexapodGeometry
from ..machine.model import MachineModel
from .bag import Files, Recording

# Outcomes for a recorded answer: the replayed answer has the same bits; has other bits; there is none, since an earlier
# page is missing; there is none, since no snapshot precedes the recorded answer
IDENTICAL, DIFFERENT, LOST, BEFORE = range(4)

Progress = Callable[[int], object]  # takes the number of answers compared since the last call


@dataclass(frozen=True)
class Event:
    row: int  # index of the next answer
    time: int  # time at which the recorder received the entry's page, ns; at most 50 ms later than the entry
    entry: Entry


@dataclass
class Replay:
    """Result of a replay.

    Attributes
    ----------
    commands : ndarray of COMMAND
        The n recorded commands with their answers.
    outcome : ndarray of int, shape (n,)
        ``IDENTICAL``, ``DIFFERENT``, ``LOST`` or ``BEFORE``.
    lengths : ndarray, shape (n, 2, 6)
        Replayed strut commands and corrections, m; NaN where an answer was not replayed.
    refused_now : dict of int to str
        Reason of each refusal by the replay; the key is the index of the recorded answer.
    changes, refused : list of Event
        Recorded changes of inputs, and commands that the compensator refused during the recording.
    states_differ : list of int
        Indices of answers; before each of them the replayed state differs from a snapshot in the journal.
    lost : int
        Number of answers in pages of the journal that the recorder did not receive.
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
        """Whether at least one answer was compared, and all compared answers equal the recorded ones."""
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
        """Largest difference, m, between a replayed and a recorded correction of a strut."""
        return float(np.nanmax(np.abs(self.difference[self.different]), initial=0.0))


def replay_recording(
    recording: Recording, files: Files | None = None, progress: Progress = lambda commands: None
) -> Replay:
    """Compute the answers to the commands of a recording again.

    Parameters
    ----------
    recording : Recording
        Recorded run.
    files : Files, optional
        Geometries and models that the compensator used; by default the files in the recording.
    progress : callable, optional
        Called with the argument 1 after each answer.

    Raises
    ------
    InputFileError
        The geometry or the model that the compensator used is missing.
    """
    return _Run(recording, progress, files or Files(recording, {})).run()


def what_if(
    recording: Recording, geometry: HexapodGeometry, model: MachineModel, progress: Progress = lambda commands: None
) -> Replay:
    """Compute answers to the recorded commands with another model or geometry.

    The recorded changes of all inputs, such as temperatures and the tool, are repeated, except those of the model and
    of the drift. The first command is fully corrected, without a ramp.
    """
    compensator, state = Compensator(geometry, model), recording.first.state
    # the entries of the first snapshot that are valid for every geometry and model
    kept = BESIDE.keys() - {"lags", "drift"} | {"motion_sense", "enabled", "resumes", "ramp_rate"}
    fresh = compensator.snapshot() | {name: value for name, value in state.items() if name in kept}
    compensator.restore(fresh | {"motion_sense": np.nan_to_num(fresh["motion_sense"])})
    run = _Run(recording, progress, None)
    run.use(compensator)
    return run.run()


class _Run:
    """A replay in progress. Its compensator is made from the geometries and models in `files`; without `files`, it is
    always the compensator that :meth:`use` was called with.
    """

    compensator: Compensator

    def __init__(self, recording: Recording, progress: Progress, files: Files | None) -> None:
        self._recording, self._progress, self._files = recording, progress, files
        self._commands, count = recording.commands, len(recording.commands)
        self.result = Replay(self._commands, np.full(count, BEFORE), np.full((count, 2, 6), np.nan))
        self._known = files is None  # whether the compensator's state is known, so that answers are comparable
        self._in_use = "", ""  # hashes of the geometry and of the model that the compensator uses

    def use(self, compensator: Compensator) -> None:
        self.compensator = compensator
        self._frames = {name: pack_pose(pose) for name, pose in compensator.geometry.work_frames.items()}

    def run(self) -> Replay:
        row, result, otherwise, expected = 0, self.result, BEFORE, ("", 0, 0)
        for time, page in self._recording.pages:
            if self._files is not None:  # after a lost page the state is unknown until the next snapshot
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
        """Repeat a recorded change of an input; :func:`what_if` leaves out changes of the model and of the drift."""
        if self._files is None and entry.what in ("model", "drift"):
            return
        if self._files is not None and entry.what == "model":
            self.compensator.set_model(self._files.model(entry.values, self.compensator.geometry))
            self._in_use = self._in_use[0], entry.values["sha256"]
        else:
            getattr(self.compensator, SETTERS[entry.what])(*entry.values.values())

    def _step(self, row: int) -> int:
        """Pass the recorded command `row` to the compensator, as the node did, and return the outcome."""
        recorded, answer = self._commands[row], self.result.lengths[row]
        try:
            frame = self._frames.get(name := self._recording.frames[row])
            if frame is None:
                raise FrameError(f"the machine has no work frame {name!r}")
            time = time_of(int(recorded["stamp"]), bool(recorded["stamped"]))
            self.compensator.step(tuple(recorded["pose"].tolist()), time, frame, float(recorded["received"]))
        except HexapodError as error:
            self.result.refused_now[row] = f"{error.reason}: {error}"
            return DIFFERENT
        self.compensator.published(float(recorded["published"]))
        answer[0], answer[1] = self.compensator.command, self.compensator.correction
        return IDENTICAL if answer.tobytes() == recorded["lengths"].tobytes() else DIFFERENT

    def _resume(self, files: Files, snapshot: Snapshot, row: int) -> None:
        """Compare the compensator's state before answer `row` with a snapshot, then restore the snapshot."""
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
    """Return whether two snapshots have equal entries; NaN equals NaN."""
    if one.keys() != other.keys() or any(one[name] != other[name] for name in BESIDE):
        return False
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in one.keys() - BESIDE.keys())
