"""What a machine tells a compensator: measured struts and temperatures."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState, Temperature

from ..compensation.compensator import Compensator
from ..compensation.thermal import TemperatureFilter
from ..errors import HexapodError
from .compensator_status import CompensatorStatus
from .following import StrokeRange
from .messages import StrutReader
from .order import InOrder
from .runtime import EVENT_QOS, STATE_QOS, MachineNode
from .stamps import nanoseconds_of


class Feedback:
    """Subscriptions of a configured compensator to what the machine tells.

    Readings are taken while the node is inactive too: the first command after an activation must start from where the
    struts are, and know how warm the machine is.

    Parameters
    ----------
    node : MachineNode
        Subscribes and warns.
    compensator : Compensator
        Estimates poses, and takes temperatures.
    status : CompensatorStatus
        Counters and guards.
    options : dict
        The node's parameters.
    publish : callable
        Publishes a pose estimate, given the pose and the reading's stamp.
    stopped : callable
        Called when the struts are found not to follow.
    """

    def __init__(
        self,
        node: MachineNode,
        compensator: Compensator,
        status: CompensatorStatus,
        options: dict[str, Any],
        publish: Callable[[np.ndarray, Time], None],
        stopped: Callable[[], None],
    ) -> None:
        self._node, self._compensator, self._status = node, compensator, status
        self._publish, self._stopped = publish, stopped
        self._order, self._reader = InOrder("strut_states"), StrutReader()
        self._range = StrokeRange(compensator.geometry)
        self._filter = TemperatureFilter(options["temperature_time_constant_s"])
        self._subscriptions = (
            node.listen_to(JointState, "strut_states", self._on_states, STATE_QOS),
            node.listen_to(Temperature, "temperatures", self._on_temperature, EVENT_QOS),
        )

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _on_states(self, message: JointState) -> None:
        now, stamp = time.monotonic(), nanoseconds_of(message.header.stamp)
        struts = self._reader.lengths
        try:
            self._order.check(stamp, now)
            self._reader.read(message)
            self._range.check(struts)
            pose = self._compensator.estimate(struts)
        except HexapodError as error:
            self._ignore("feedback " + error.reason, error.reason, f"strut_states ignored: {error}", str(error), now)
            return
        self._status.last_known.measure(struts, now)
        self._order.passed(stamp, now)
        self._status.feedback.tick(now)
        if self._node.active:
            self._watch_following(struts, now)
            self._publish(pose, message.header.stamp)

    def _watch_following(self, measured: np.ndarray, now: float) -> None:
        """Hold the measured struts against their commands; even one reading that is off is said."""
        following = self._status.following
        known = following.problem
        following.check(measured, now)
        if following.problem and not known:
            self._stopped()
            self._status.bad_feedback.add(following.reason, following.problem, now)

    def _on_temperature(self, message: Temperature) -> None:
        # Dated by arrival: sensors need not stamp, clocks may be set, and what a transport delays a drift does not
        # notice.
        name, now = message.header.frame_id, time.monotonic()
        try:
            self._compensator.set_temperature(name, self._filter.take(name, message.temperature, now))
        except HexapodError as error:
            self._ignore("temperature", "temperature", f"temperature ignored: {error}", str(error), now)

    def _ignore(self, cause: str, reason: str, warning: str, text: str, now: float) -> None:
        """Count and say what was not usable."""
        if self._node.active:
            self._status.bad_feedback.add(reason, text, now)
            self._node.warn_of(cause, warning)
