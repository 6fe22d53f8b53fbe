"""Messages and services of any content, in any order, for the simulated drive: it does not die, and keeps its stroke.

Truth: the geometry file's stroke; a reading is finite unless its encoder was told to be lost.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from fuzz_rig import (
    HOME_LENGTHS,
    Rig,
    any_message,
    anything,
    lengths,
    small_model,
    struts,
    struts_action,
    tick,
    transition,
)
from fuzzing import COUNTS, cases
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from strategies import paper_geometry

from hexapod_comp.machine.geometry import STRUT_NAMES
from hexapod_comp.ros.strut_drive import StrutDriveNode

LIMITS = paper_geometry().limits


class DriveRig(Rig):
    """A strut drive."""

    def __init__(self, context: Any, truth: str) -> None:
        super().__init__(context, StrutDriveNode, {"rate": 1000.0, "truth_file": truth})
        self.obeyed = HOME_LENGTHS

    def deliver(self, topic: str, message: Any) -> None:
        """Deliver a message, and remember commands that were obeyed: the next may be only a step away."""
        before = self.node._commands.count
        super().deliver(topic, message)
        if self.node._commands.count > before:
            told = dict(zip(message.name, message.position, strict=True))
            self.obeyed = np.array([told[name] for name in STRUT_NAMES])

    def play(self, action: tuple) -> None:
        """Do one thing to the node, and check its readings."""
        super().play(action)
        if action[0] == "struts":
            self.deliver("strut_commands", struts(action))
        lost = self.node._options["fault_encoder_lost"]
        for names, position, velocity, _ in self.took("strut_states"):
            assert names == list(STRUT_NAMES)
            there = np.ones(6, dtype=bool)
            there[lost - 1] = not lost
            assert np.isfinite([position[there], velocity[there]]).all()
            noise = 1e-6  # twenty standard deviations of the encoder's
            assert (position[there] >= LIMITS.stroke[there, 0] - noise).all()
            assert (position[there] <= LIMITS.stroke[there, 1] + noise).all()
        for pose in self.took("tool_pose_true"):
            assert np.isfinite(pose).all()
        self.took("/diagnostics")

    def follows_the_next_good_command(self) -> None:
        """Check that the node still lives: the last good command is good again, and without faults it is read."""
        self.activate()
        self.serve("set_parameters", no_faults())
        before = self.node._commands.count
        self.deliver("strut_commands", struts(("struts", list(STRUT_NAMES), self.obeyed.tolist(), [], 0.0)))
        assert self.node._commands.count == before + 1, self.node._refusals.last_text
        self.tick()
        time.sleep(2e-3)
        self.tick()
        assert self.took("strut_states")
        self.sent.clear()


def no_faults() -> Any:
    """Return the request that takes all faults back."""
    request = SetParameters.Request()
    values = {"fault_stuck_strut": 0, "fault_encoder_lost": 0, "fault_feedback_delay": 0.0, "fault_feedback_drop": 0.0}
    request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return request


@pytest.fixture(scope="module")
def drive(module_context: Any, tmp_path_factory: pytest.TempPathFactory) -> DriveRig:
    return DriveRig(module_context, small_model(tmp_path_factory))


actions_on_drive = st.one_of(
    struts_action(lengths),
    struts_action(lengths),
    tick,
    transition,
    anything,
    st.tuples(st.just("message"), st.just("strut_commands"), any_message(JointState)),
)


@given(actions=st.lists(actions_on_drive, min_size=1, max_size=12))
@cases(60, 0.05)
def test_drive(drive: DriveRig, actions: list) -> None:
    COUNTS["drive"] += 1
    for action in actions:
        drive.play(action)
    drive.follows_the_next_good_command()
