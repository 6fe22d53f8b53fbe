"""Where a compensator's first command may be: within a step of the last known struts, or nowhere.

After its process has started, an activation, a reset; with feedback, without, and with stale feedback.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from node_helpers import HOME, closed_form_lengths, near

from hexapod_comp.compensation import guards
from hexapod_comp.ros.status import ERROR, OK, WARN

ROUNDING = 1e-12


@pytest.fixture(autouse=True)
def short_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A refusal colours the status for 0.3 s."""
    monkeypatch.setattr(guards, "SHOWN_FOR", 0.3)


NEVER = {"start_without_feedback_after": 0.0}
"""The default, which the rig changes."""


def test_a_start_waits_for_the_struts(rig):
    """Where they stand is not known, so not even home, where they may be, is commanded; that is said."""
    rig.compensator(feedback_timeout=60.0, **NEVER)
    rig.until_status(WARN, "waiting for strut_states")
    rig.send(HOME)
    text = rig.until_status(ERROR, "refusing commands: no_feedback; waiting for strut_states")["last_refusal"]
    assert text.startswith("no strut_states yet: where the struts stand is not known; a machine without feedback needs")
    assert not rig.seen["strut_commands"]
    rig.estimate(rig.feed(closed_form_lengths(HOME)))
    rig.send(near(HOME, (0.0, 0.0, 0.005)))
    rig.until_status(ERROR, "refusing commands: step")
    rig.ask(HOME)


def test_without_feedback_the_first_command_may_be_anywhere(rig):
    """Only where a parameter says after how long; what became known meanwhile counts all the same."""
    rig.compensator(start_without_feedback_after=0.01)
    rig.until_status(OK, "waiting for the first command")
    rig.ask(near(HOME, (0.05, 0.05, 0.05), 10.0))


@pytest.mark.parametrize("feedback", ["never", "stale"])
@pytest.mark.parametrize("way", ["reset", "deactivate, activate", "deactivate, cleanup, configure, activate"])
def test_without_fresh_feedback_no_start_is_further_than_a_step_from_the_last_command(rig, way, feedback):
    """Published 1 mm above home: the struts are on their way there, if not there, whatever has been forgotten."""
    rig.compensator()
    last = near(HOME, (0.0, 0.0, 0.001))
    if feedback == "stale":
        rig.estimate(rig.feed(closed_form_lengths(HOME)))
    rig.ask(HOME)
    before = rig.settle(last)
    rig.until_status(WARN, "no new command")
    if feedback == "stale":
        rig.until_status(WARN, "no new command; feedback lost")
    if way == "reset":
        assert rig.trigger("reset").success
    else:
        assert all(rig.change(transition) for transition in way.split(", "))
        rig.until(rig.matched, "discovery")
    rig.send(near(HOME, (0.0, 0.0, 0.12)))
    rig.until_status(ERROR, "refusing commands: step")
    first = rig.ask(near(last, (0.0, 0.0, 0.001)))
    assert np.abs(first.lengths - before.lengths).max() <= 2e-3 + ROUNDING
    assert [m.header.stamp for m in rig.seen["strut_commands"]][-2:] == [
        before.command.header.stamp,
        first.command.header.stamp,
    ]


def test_struts_that_were_moved_and_measured_while_the_node_was_inactive_count_when_feedback_is_stale(rig):
    rig.compensator()
    rig.ask(HOME)
    assert rig.change("deactivate")
    elsewhere, told_at = near(HOME, (0.0, 0.0, 0.05)), time.monotonic()
    rig.until(lambda: time.monotonic() > told_at + 0.1, "the time in which a drive follows")
    rig.feed(closed_form_lengths(elsewhere))
    rig.barrier()
    assert rig.change("activate")
    rig.until_status(WARN, "no new command; feedback lost")
    rig.send(HOME)
    rig.until_status(ERROR, "refusing commands: step")
    rig.ask(elsewhere)
