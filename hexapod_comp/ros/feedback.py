"""What a machine tells a compensator: struts, temperatures, humidity, each by one node, and only what can be."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature

from ..compensation.compensator import Compensator
from ..compensation.thermal import Plausibility, Thermometers
from ..errors import CommandError, HexapodError
from ..machine.temperatures import HUMIDITY, check_part
from .command_source import CommandSource
from .compensator_status import CompensatorStatus
from .following import StrokeRange
from .messages import StrutReader, read_message
from .plausible import NoJump
from .runtime import NEWEST_QOS, SENSOR_QOS, MachineNode
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
        Estimates poses, and takes temperatures and humidity.
    status : CompensatorStatus
        Counters and guards.
    options : dict
        The node's parameters.
    publish : callable
        Publishes what follows from a reading, given the struts, the pose estimated from them, the reading's stamp, and
        what averages the readings of struts at rest.
    look : callable
        Looks again who publishes and whether commands may be obeyed: called when a publisher comes or goes, when a
        second one is heard, and when the struts are found not to follow.
    """

    def __init__(
        self,
        node: MachineNode,
        compensator: Compensator,
        status: CompensatorStatus,
        options: dict[str, Any],
        publish: Callable[[np.ndarray, np.ndarray, Time, Callable[[np.ndarray], np.ndarray]], None],
        look: Callable[[], None],
    ) -> None:
        self._node, self._compensator, self._status = node, compensator, status
        self._publish, self._look = publish, look
        self._reader, self._range = StrutReader(options["joint_names"]), StrokeRange(compensator.geometry)
        self._stamps, self._jumps = status.reading_stamps, NoJump(compensator.geometry)
        self._options, self._thermometers = options, Thermometers(*_temperature_rules(options))
        several = options["allow_several_publishers"]
        states = node.obey(JointState, "strut_states", self._on_states, look, qos=NEWEST_QOS)
        self._subscriptions = [states]
        self._measuring = CommandSource(node, states.topic_name, states.get_publisher_count, several)
        several = several or options["allow_several_thermometers"]
        self._sensing: dict[str, CommandSource] = {}
        sensors = (
            ("temperatures", Temperature, self._take_temperature),
            (HUMIDITY, RelativeHumidity, self._take_humidity),
        )
        for topic, kind, take in sensors:
            heard = node.obey(kind, topic, partial(self._on_sensor, topic, kind, take), look, qos=SENSOR_QOS)
            self._subscriptions.append(heard)
            self._sensing[topic] = CommandSource(node, heard.topic_name, heard.get_publisher_count, several)
        status.watch_readings(self._measuring, self._sensing, self._thermometers)

    def take_parameters(self) -> None:
        """Take the parameters as they are now."""
        self._thermometers.follow(*_temperature_rules(self._options))

    def close(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _on_states(self, data: bytes, number: int | None) -> None:
        now, struts = time.monotonic(), self._reader.lengths
        try:
            self._hear(self._measuring, number, now)
            header = self._reader.take(data).header
            stamp = nanoseconds_of(header.stamp)
            made = now - self._stamps.check(stamp, now)  # of late, where this node stood still
            self._range.check(struts)
            self._watch_following(struts, made, now)  # also of what cannot be: then the strut or its encoder is broken
            self._jumps.check(struts, stamp, now)
            pose = self._compensator.estimate(struts)
        except HexapodError as error:
            self._ignore("feedback " + error.reason, error.reason, f"strut_states ignored: {error}", str(error), now)
            return
        self._status.last_known.measure(struts, made)
        self._status.standing.measure(struts, now)
        self._jumps.passed(struts, stamp, now)
        self._stamps.accept(stamp, now)
        self._status.feedback.tick(now)
        if self._node.active:
            self._publish(struts, pose, header.stamp, self._status.standing.mean)

    def _hear(self, owner: CommandSource, number: int | None, now: float) -> None:
        """Take a reading's sequence number; refuse the reading while it is not clear whose it is."""
        if owner.hear(number, now):
            self._look()
        if owner.problem:
            raise CommandError(owner.reason, owner.problem)

    def _watch_following(self, measured: np.ndarray, made: float, now: float) -> None:
        """Hold the measured struts against their commands; even one reading that is off is said."""
        if not self._node.active:
            return
        following = self._status.following
        known = following.problem
        following.check(measured, made)
        if following.problem and not known:
            self._look()
            self._status.bad_feedback.add(following.reason, following.problem, now)

    def _on_sensor(
        self, topic: str, kind: type, take: Callable[[Any, float], None], data: bytes, number: int | None
    ) -> None:
        # Dated by arrival: sensors need not stamp, clocks may be set, and what a transport delays a drift does not
        # notice.
        now, what = time.monotonic(), topic.removesuffix("s")
        try:
            self._hear(self._sensing[topic], number, now)
            take(read_message(data, kind), now)
        except CommandError as error:
            self._ignore(topic, error.reason, f"{what} ignored: {error}", str(error), now)
        except HexapodError as error:
            self._ignore(what, what, f"{what} ignored: {error}", str(error), now)

    def _take_temperature(self, message: Temperature, now: float) -> None:
        name = message.header.frame_id
        check_part(name)
        self._compensator.set_temperature(name, self._thermometers.take(name, message.temperature, now), now)

    def _take_humidity(self, message: RelativeHumidity, now: float) -> None:
        humidity = self._thermometers.take(HUMIDITY, message.relative_humidity, now)
        self._compensator.set_humidity(humidity, now)

    def _ignore(self, cause: str, reason: str, warning: str, text: str, now: float) -> None:
        """Count and say what was not usable."""
        if self._node.active:
            self._status.bad_feedback.add(reason, text, now)
            self._node.warn_of(cause, warning)


def _temperature_rules(options: dict[str, Any]) -> tuple[Plausibility, float]:
    rules = Plausibility(
        rate=options["temperature_rate_limit"],
        spread=options["temperature_spread_limit"],
        timeout=options["temperature_timeout"],
        humidity_rate=options["humidity_rate_limit"],
    )
    return rules, options["temperature_time_constant_s"]
