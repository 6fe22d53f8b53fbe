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
"""The default, which the bench changes."""


def test_a_start_waits_for_the_struts(bench):
    """Where they stand is not known, so not even home, where they may be, is commanded; that is said."""
    bench.compensator(feedback_timeout=60.0, **NEVER)
    bench.until_status(WARN, "waiting for strut_states")
    bench.send(HOME)
    text = bench.until_status(ERROR, "refusing commands: no_feedback; waiting for strut_states")["last_refusal"]
    assert text.startswith("no strut_states yet: where the struts stand is not known; a machine without feedback needs")
    assert not bench.seen["strut_commands"]
    bench.estimate(bench.feed(closed_form_lengths(HOME)))
    bench.send(near(HOME, (0.0, 0.0, 0.005)))
    bench.until_status(ERROR, "refusing commands: step")
    bench.ask(HOME)


def test_without_feedback_the_first_command_may_be_anywhere(bench):
    """Only where a parameter says after how long; what became known meanwhile counts all the same."""
    bench.compensator(start_without_feedback_after=0.01)
    bench.until_status(OK, "waiting for the first command")
    bench.ask(near(HOME, (0.05, 0.05, 0.05), 10.0))


@pytest.mark.parametrize("feedback", ["never", "stale"])
@pytest.mark.parametrize("way", ["reset", "deactivate, activate", "deactivate, cleanup, configure, activate"])
def test_without_fresh_feedback_no_start_is_further_than_a_step_from_the_last_command(bench, way, feedback):
    """Published 1 mm above home: the struts are on their way there, if not there, whatever has been forgotten."""
    bench.compensator()
    last = near(HOME, (0.0, 0.0, 0.001))
    if feedback == "stale":
        bench.estimate(bench.feed(closed_form_lengths(HOME)))
    bench.ask(HOME)
    before = bench.settle(last)
    bench.until_status(WARN, "no new command")
    if feedback == "stale":
        bench.until_status(WARN, "no new command; feedback lost")
    if way == "reset":
        assert bench.trigger("reset").success
    else:
        assert all(bench.change(transition) for transition in way.split(", "))
        bench.until(bench.matched, "discovery")
    bench.send(near(HOME, (0.0, 0.0, 0.12)))
    bench.until_status(ERROR, "refusing commands: step")
    first = bench.ask(near(last, (0.0, 0.0, 0.001)))
    assert np.abs(first.lengths - before.lengths).max() <= 2e-3 + ROUNDING
    assert [m.header.stamp for m in bench.seen["strut_commands"]][-2:] == [
        before.command.header.stamp,
        first.command.header.stamp,
    ]


def test_struts_that_were_moved_and_measured_while_the_node_was_inactive_count_when_feedback_is_stale(bench):
    bench.compensator()
    bench.ask(HOME)
    assert bench.change("deactivate")
    elsewhere, told_at = near(HOME, (0.0, 0.0, 0.05)), time.monotonic()
    bench.until(lambda: time.monotonic() > told_at + 0.1, "the time in which a drive follows")
    bench.feed(closed_form_lengths(elsewhere))
    bench.barrier()
    assert bench.change("activate")
    bench.until_status(WARN, "no new command; feedback lost")
    bench.send(HOME)
    bench.until_status(ERROR, "refusing commands: step")
    bench.ask(elsewhere)
