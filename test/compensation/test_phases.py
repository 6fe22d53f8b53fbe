"""What the next command starts from: random walks through the core keep to the table, and the page shows it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from hexapod_comp.compensation.compensator import TRANSITIONS, Compensator, Phase
from hexapod_comp.errors import HexapodError
from hexapod_comp.formats.paths import config_file
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.machine.kinematics import strut_lengths
from hexapod_comp.virtual.named import find_model

STATES = Path(__file__).resolve().parents[2] / "doc" / "states.md"


@pytest.mark.parametrize("seed", range(4))
def test_the_core_keeps_to_the_table(seed):
    """Two hundred events in any order; every accepted and refused command, too."""
    geometry = load_geometry(config_file("paper.yaml"))
    rng, seen = np.random.default_rng(seed), set()
    ideal, random = (find_model(name, geometry) for name in ("ideal", f"random:{seed}"))
    compensator = Compensator(geometry, random, 1e-4)
    home, now = geometry.tool_pose(geometry.home), 0.0
    at_home = strut_lengths(geometry, geometry.home)
    for _ in range(200):
        before, event = compensator.phase, ""
        draw = rng.integers(8)
        if draw < 3:
            now += rng.choice([0.004, 0.3])
            shifted = type(home)(
                home.position + rng.choice([0.0, 1e-4, 0.1]) * np.array([0.0, 0.0, 1.0]), home.rotation
            )
            try:
                compensator.correct(shifted, now)
                event = "ramped" if compensator.ramping else "command"
            except HexapodError:
                assert compensator.phase is before, "a refused command changes nothing"
                continue
        elif draw == 3:
            compensator.set_tool(geometry.tool_name)
            event = "tool"
        elif draw == 4:
            compensator.reset()
            event = "reset"
        elif draw == 5:
            compensator.reset(at_home)
            event = "reset to struts"
        elif draw == 6:
            compensator.set_temperature("strut_1", 20.0 + rng.uniform(1.0, 2.0), now)
            event = "change"
        else:
            compensator.set_model(ideal if compensator.model is random else random)
            event = "change"
        assert compensator.phase is TRANSITIONS[before][event], (before, event)
        seen.add((before, event))
    assert len(seen) >= 15


def test_the_page_shows_the_table():
    rows = re.findall(r"^\| ([A-Z_]+) \| ([^|]+) \|(.*)\|$", STATES.read_text(encoding="utf-8"), re.M)
    events = ("reset", "reset to struts", "tool", "change", "command", "ramped")
    shown = {
        Phase[name]: (text, {event: Phase[cell.strip()] for event, cell in zip(events, cells.split("|"), strict=True)})
        for name, text, cells in rows
    }
    assert shown == {phase: (phase.value, TRANSITIONS[phase]) for phase in Phase}
