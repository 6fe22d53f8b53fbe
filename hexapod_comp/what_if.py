"""Recorded commands through another model: what would the corrections have been?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .compensation import Compensator
from .compensation_kernels import BUMP, CHANGED, COMMAND, CORRECTION, NOMINAL, SENSE
from .errors import HexapodError
from .geometry import HexapodGeometry
from .journal import Page
from .machine import MachineModel
from .recording import Recording
from .replaying import DIFFERENT, IDENTICAL, LOST, Replay, apply, give, packed_frames
from .timeline import Timeline


def what_if(
    recording: Recording,
    timeline: Timeline,
    geometry: HexapodGeometry,
    model: MachineModel,
    progress: Callable[[int], object] = lambda answers: None,
) -> Replay:
    """Run the recorded commands through another model, or another geometry.

    Temperatures, switching and starts are those of the recording; its own models are not. The corrections
    begin at the other model's: nothing ramps.

    Returns
    -------
    Replay
        Of which `outcome` says little: IDENTICAL where the corrections are the same bits, else DIFFERENT, or
        LOST where the recording has no command for an answer.
    """
    answers, asked = timeline.answers, recording.topics["tool_pose_command"]
    shape = len(answers), 6
    result = Replay(answers, np.full(len(answers), LOST), np.full(shape, np.nan), np.full(shape, np.nan))
    compensator = Compensator(geometry, model)
    compensator.restore(_begin(compensator, recording.pages[0][1]))
    frames = packed_frames(recording.pages[0][1], geometry)
    for row in range(len(answers)):
        for entry, _ in timeline.events.get(row, ()):
            if entry is not None and entry.what not in ("model", "refused"):
                apply(compensator, entry)
        progress(1)
        number = int(answers.asked[row])
        if number < 0:
            continue
        try:
            give(compensator, frames, asked.frames[number], asked.values[number], int(answers.stamps[row]))
        except HexapodError as error:
            result.refused_now[row] = f"{error.reason}: {error}"
            continue
        result.commands[row], result.corrections[row] = compensator.command, compensator.correction
        same = answers.corrections[row].tobytes() == compensator.correction.tobytes()
        result.outcome[row] = IDENTICAL if same else DIFFERENT
    return result


def _begin(compensator: Compensator, page: Page) -> dict[str, Any]:
    """Return a page's snapshot with no more than what another machine can take over: directions and switches."""
    fresh, state = compensator.snapshot(), np.array(page.snapshot["state"])
    if state.shape == np.shape(fresh["state"]):
        fresh["state"][SENSE:NOMINAL] = np.nan_to_num(state[SENSE:NOMINAL]).tolist()
        fresh["state"][CORRECTION:COMMAND], fresh["state"][BUMP : BUMP + 6] = [np.nan] * 6, [0.0] * 6
    switches = np.array(page.snapshot["switches"])
    if switches.shape == np.shape(fresh["switches"]):
        fresh["switches"] = switches
        fresh["switches"][CHANGED] = 0.0
    fresh["temperatures"] = page.snapshot["temperatures"]
    return fresh
