"""The test kit for integrators: the example of its page, and what it does with a controller that does not arrive."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from hexapod_comp import Pose
from hexapod_comp.testing.bench import Bench

PAGE = Path(__file__).resolve().parents[1] / "doc" / "testing.md"
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
exec(compile(EXAMPLE, PAGE, "exec"))  # its tests become tests of this file


def test_the_page_has_two_tests() -> None:
    assert {"test_the_tool_arrives", "test_a_stuck_strut_stops_the_machine"} <= globals().keys()


def test_a_command_from_the_test_is_answered_and_what_does_not_happen_is_named(hexapod: Bench) -> None:
    """At home the struts of the paper's machine have equal lengths, by symmetry; at the start with the encoders' 0.1
    µm."""
    hexapod.machine()
    lengths = hexapod.ask(Pose.from_angles([0.0, 0.0, 0.4], [0.0, 0.0, 0.0])).command.position
    assert len(lengths) == 6
    assert max(lengths) - min(lengths) < 1e-6
    with pytest.raises(TimeoutError, match=r"^did not happen within 0\.5 s: the tool at 395 mm"):
        hexapod.until(lambda: abs(hexapod.tool().position[2] - 0.395) < 1e-6, "the tool at 395 mm", 0.5)
