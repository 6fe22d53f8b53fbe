"""What a client in lock-step does when a busy computer hands its pose over too late.

Truth: a stand-in for the compensator that refuses as the real one does, one step after the other; no ROS runs.
"""

from __future__ import annotations

import numpy as np
import pytest
from node_helpers import HOME

from hexapod_comp.errors import NoAnswerError
from hexapod_comp.ros.client import LoopClient, Sent
from hexapod_comp.ros.messages import pose_message
from hexapod_comp.ros.status import ADVICE, OTHERWISE


class StandIn(LoopClient):
    """A client whose poses are answered, or refused for a reason, as a list says."""

    def __init__(self, outcomes: list[str]) -> None:
        self._outcomes, self.sent, self.diagnostics = list(outcomes), {}, {"refused": "0", "last_refusal": ""}
        self.poses: list[float] = []

    def _send(self, message) -> Sent:
        self.poses.append(message.pose.position.z)
        self._entry = Sent(0.0, *self._refused(), message)
        self._entry.sent_at = 1e12  # never overdue
        return self._entry

    def _spin_once(self, timeout: float) -> None:
        outcome = self._outcomes.pop(0)
        if outcome == "answered":
            self._entry.command[:] = self._entry.correction[:] = 0.0
            return
        count, key = int(self.diagnostics["refused"]) + 1, f"refused.{outcome}"
        self.diagnostics |= {"refused": str(count), key: str(int(self.diagnostics.get(key, "0")) + 1)}
        self.diagnostics |= {"last_refusal": f"it is {outcome}", "what_to_do": ADVICE.get(outcome, OTHERWISE)}


def at(height: float):
    message = pose_message(HOME, "base")
    message.pose.position.z = height
    return message


def test_a_pose_that_came_too_late_is_sent_again_before_the_next():
    client = StandIn(["answered", "stamp_past", "stamp_past", "answered", "answered"])
    for height in (0.400, 0.401, 0.402):
        entry = client.wait_for_answer(client._send(at(height)))
        assert np.isfinite(entry.command).all()
    assert client.poses == [0.400, 0.401, 0.401, 0.401, 0.402]


def test_another_refusal_ends_it_and_says_what_to_do():
    client = StandIn(["stamp_past", "step"])
    with pytest.raises(NoAnswerError, match=r"a command was refused: it is step; go on from the last answered command"):
        client.wait_for_answer(client._send(at(0.400)))
    assert client.poses == [0.400, 0.400]
