"""Pins and messages of any content, in any order, for the LinuxCNC bridge: what LinuxCNC gets never steps.

Truth: the bridge's parameters (limit, ramp); SciPy's rotations for the poses that it commands; LinuxCNC's own
meaning of its axes, and of its tool length (doc/linuxcnc.md); IEEE 754 for what is a number.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from fuzz_rig import Rig, any_message, anything, floats, struts, struts_action, tick, transition
from fuzzing import COUNTS, cases
from hal_stand_in import StandInHal
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from hexapod_comp.linuxcnc.bridge import (
    AXES,
    CORRECTIONS,
    FEEDBACK,
    LONGEST_STEP,
    SWITCHES,
    GuardStatus,
    LinuxcncBridgeNode,
)
from hexapod_comp.machine.geometry import STRUT_NAMES

MM = 1e-3
LIMIT, RAMP = 500e-6, 10e-3
ROUNDING = 1e-15

NOW = 1e-9  # Stamp of a message that answers a command of just now, s from now; 0 would be none

corrections = st.one_of(
    st.lists(st.floats(-1.2 * LIMIT, 1.2 * LIMIT), min_size=6, max_size=6),
    st.lists(st.floats(-LIMIT, LIMIT), min_size=6, max_size=6),
    st.lists(floats, max_size=8),
)
pins = st.one_of(
    st.tuples(st.sampled_from(AXES + FEEDBACK), st.one_of(st.floats(-400.0, 400.0), floats)),
    st.tuples(st.sampled_from(SWITCHES), st.booleans()),
)
good_correction = st.lists(st.floats(-LIMIT, LIMIT), min_size=6, max_size=6).map(
    lambda values: ("struts", list(STRUT_NAMES), values, [], NOW)
)
actions_on_bridge = st.one_of(
    st.tuples(st.just("pins"), st.lists(pins, min_size=1, max_size=4)),
    struts_action(corrections),
    good_correction,
    tick,
    tick,
    tick,
    transition,
    anything,
    st.tuples(st.just("message"), st.just("strut_corrections"), any_message(JointState)),
    st.tuples(st.just("message"), st.just("diagnostics"), any_message(DiagnosticArray)),
)


class BridgeRig(Rig):
    """A bridge, and the pins that LinuxCNC would read and write."""

    def __init__(self, context: Any) -> None:
        self.hal = StandInHal()
        options = {"limit": LIMIT, "ramp_rate": RAMP, "timeout": 1.0}
        super().__init__(context, LinuxcncBridgeNode, options, hal=self.hal)

    def play(self, action: tuple) -> None:
        """Do one thing to pins or node, and check what comes of it."""
        super().play(action)
        if action[0] == "pins":
            for name, value in action[1]:
                self.hal[name] = value
        elif action[0] == "struts":
            self.deliver("strut_corrections", struts(action))
        self.check_pins()
        self.check_topics()

    def check_pins(self) -> None:
        """Check what LinuxCNC has been given since the last time."""
        for name in CORRECTIONS:
            written = [value for _, value in self.hal.pins[name].written]
            assert np.isfinite(written).all()
            assert max(map(abs, written), default=0.0) * MM <= LIMIT + ROUNDING
            assert all(abs(b - a) * MM <= RAMP * LONGEST_STEP + ROUNDING for a, b in pairwise(written))
        assert self.hal["status"] in list(GuardStatus)
        assert math.isfinite(self.hal["age"])
        assert 0.0 <= self.hal["largest"] * MM <= LIMIT + ROUNDING
        for pin in self.hal.pins.values():
            del pin.written[:-1]

    def check_topics(self) -> None:
        """Check commanded poses and measured struts against the pins."""
        axes = np.array([self.hal[name] for name in AXES])
        for pose in self.took("tool_pose_command"):
            assert np.isfinite(pose).all()
            position, rotation = expected_pose(axes)
            np.testing.assert_allclose(pose[:3], position, rtol=0.0, atol=1e-12 * (1.0 + np.abs(axes).max()))
            np.testing.assert_allclose(Rotation.from_quat(pose[3:]).as_matrix(), rotation, atol=1e-12)
        feedback = np.array([self.hal[name] for name in FEEDBACK])
        for who, position, velocity, _ in self.took("strut_states"):
            assert who == list(STRUT_NAMES)
            assert np.isfinite([position, velocity]).all()
            np.testing.assert_allclose(position, feedback * MM, rtol=1e-15)
        self.took("/diagnostics")

    def passes_on_the_next_good_correction(self) -> None:
        """Check that the bridge still lives: with good pins, it commands and passes a correction on."""
        self.activate()
        good = {**dict.fromkeys(AXES, 0.0), **dict.fromkeys(FEEDBACK, 600.0), **dict.fromkeys(SWITCHES, True)}
        self.play(("pins", list(good.items())))
        self.play(("tick",))  # shows what was passed on before
        updates = self.hal["updates"]
        self.deliver("strut_corrections", struts(("struts", list(STRUT_NAMES), [1e-4] * 6, [], NOW)))
        self.tick()
        assert self.hal["updates"] == updates + 1, self.node._refusals.last_text
        assert self.hal["status"] in (GuardStatus.RAMPING, GuardStatus.COMPENSATING)
        assert self.took("tool_pose_command")
        self.check_pins()
        self.sent.clear()


def expected_pose(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position, m, and rotation matrix that LinuxCNC's axes (mm, degrees, tool length) mean."""
    rotation = Rotation.from_euler("xyz", axes[3:6], degrees=True).as_matrix()
    along = np.array([0.0, 0.0, axes[6]])
    return (axes[:3] - along + rotation @ along) * MM, rotation


@pytest.fixture(scope="module")
def bridge(module_context: Any) -> BridgeRig:
    return BridgeRig(module_context)


@given(actions=st.lists(actions_on_bridge, min_size=1, max_size=12))
@example(actions=[("pins", [("machine-on", True), ("tool-offset", 1e308), ("joint-fb.0", 1e308)]), ("tick",)])
@cases(60, 0.05)
def test_bridge(bridge: BridgeRig, actions: list) -> None:
    COUNTS["bridge"] += 1
    for action in actions:
        bridge.play(action)
    bridge.passes_on_the_next_good_correction()
