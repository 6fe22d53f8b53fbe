"""The LinuxCNC bridge: a HAL component on one side, a ROS node on the other.

LinuxCNC's commanded axes go out as ``tool_pose_command``, its measured struts as ``strut_states``; the
compensator's ``strut_corrections`` come back, pass a :class:`~hexapod_comp.linuxcnc.guard.CorrectionGuard`, and
stand on pins that LinuxCNC adds to its strut commands. Load it from a HAL file with
``loadusr -Wn hexapod_comp linuxcnc_bridge``; doc/linuxcnc.md lists pins and parameters.

The component lives as long as the process and beats as long as its loop runs; activating and deactivating the
node only decides whether it takes part, so that deactivating ramps the corrections out like any other loss.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState

from ..errors import CommandError
from ..ros.command_source import CommandSource
from ..ros.health import OK
from ..ros.messages import StrutMessage, StrutReader
from ..ros.running import keep_discovery_local, run
from ..ros.runtime import ACKNOWLEDGED_WITHIN, COMMAND_QOS, STATE_QOS, MachineNode
from ..ros.stamps import StampClock, StampGate, nanoseconds_of, stamp_of
from .bridge_status import BridgeStatus
from .guard import CorrectionGuard, GuardStatus
from .hal import COUNTS, METRES, HalComponent, pose_from_axes
from .parameters import AXES, CORRECTIONS, COUNTERS, FEEDBACK, FLAGS, PARAMETERS, PINS, PROGRAM, SWITCHES
from .restarting import CompensatorReset
from .stop_input import StopInput

GUARDED = ("limit", "ramp_rate", "timeout", "on_loss")
"""The guard's parameters."""

CHECK_PERIOD = 0.05
"""How often the node looks whether its state has changed, s."""

NEVER = 1e9
"""What the pin ``age`` shows before the first correction, s."""

STANDING = 2e-3
"""Struts slower than this stand, m/s: no drive lags behind by more than some micrometres then."""

LARGEST_PIN = 1e6
"""No axis stands beyond this, in LinuxCNC's units or degrees; and nothing made of such numbers overflows."""

LONGEST_FAREWELL = 1.0
"""Corrections that can be ramped out within this time are, before the process ends, s."""


class LinuxcncBridgeNode(MachineNode):
    """Lifecycle node around a HAL component and a :class:`CorrectionGuard`."""

    def __init__(self, hal: Any = None, **options: Any) -> None:
        super().__init__("linuxcnc_bridge", PARAMETERS, **options)
        self._metres = METRES[self._options["units"]]
        self._guard = CorrectionGuard(*(self._options[name] for name in GUARDED))
        self._status = status = BridgeStatus(self._guard)
        self._sent, self._states, self._heard = status.sent, status.states, status.heard
        self._refusals = status.refusals
        self._reader = StrutReader()
        self.clock = StampClock()  # the system's: what the bridge stamps with
        self._stamps = StampGate("correction", self.clock)
        self._streaming_since, self._moved_at = math.inf, -math.inf
        self._beat, self._last_text = False, ""
        self._reset: CompensatorReset | None = None  # while topics are open
        self._hal: HalComponent | None = HalComponent(self._options["component"], PINS, hal)
        self._open_pins(self._hal)
        self._pose_out, self._states_out = PoseStamped(), StrutMessage()
        self._stop = StopInput(self, self._options)
        self._hal.ready()
        self._loop = self.every(1.0 / self._options["rate"], self._cycle)

    def _open_pins(self, hal: HalComponent) -> None:
        self._read_axes, self._read_feedback = hal.reader(*AXES), hal.reader(*FEEDBACK)
        self._read_switches = hal.reader(*SWITCHES)
        self._write_corrections = hal.writer(*CORRECTIONS)
        self._write_state = hal.writer("status", "age", "largest", *FLAGS, *COUNTERS)
        self._write_state((GuardStatus.OFF, NEVER, 0.0, False, False, True, 0, 0, 0))

    # ---- lifecycle ----

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open topics."""
        self.on_parameters(set())
        self._pose_out.header.frame_id = self._options["frame_id"]
        with self.all_or_nothing():
            self._open_topics()
        return super().on_configure(state)

    def _open_topics(self) -> None:
        self._pose_pub = self.publish_on(PoseStamped, "tool_pose_command", COMMAND_QOS, self._options["timeout"])
        self._states_pub = self.publish_on(JointState, "strut_states", STATE_QOS)
        self.speak_for(self._options["component"])
        self._subscription = self.obey(JointState, "strut_corrections", self._on_correction, self._look_at_publishers)
        topic, count = self._subscription.topic_name, self._subscription.get_publisher_count
        self._source = CommandSource(self, topic, count, self._options["allow_several_publishers"])
        self._check = self.every(CHECK_PERIOD, self._check_state)
        self._reset = CompensatorReset(self, self._status, self._options)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to take part."""
        self._active = True
        self.get_logger().info("ready")
        return super().on_activate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close topics; the HAL component stays."""
        self._active = False
        self.destroy_timer(self._check)
        if self._reset is not None:
            self._reset.close()
            self._reset = None
        self.destroy_subscription(self._subscription)
        for publisher in (self._pose_pub, self._states_pub):
            self.destroy_publisher(publisher)
        return super().on_cleanup(state)

    def on_parameters(self, names: set[str]) -> None:
        """Take what has been set while the node runs; the rest is looked up where it is needed."""
        self._guard.follow(*(self._options[name] for name in GUARDED))

    def say_goodbye(self) -> None:
        """Ramp the corrections out if that is quick, and publish a last status."""
        self._active = False
        period, end = 1.0 / self._options["rate"], time.monotonic() + LONGEST_FAREWELL
        if max(map(abs, self._guard.output)) > self._options["ramp_rate"] * LONGEST_FAREWELL:
            self.get_logger().warning("corrections stay as they are: ramping them out would take too long")
            end = 0.0
        while any(self._guard.output) and time.monotonic() < end:
            self._cycle()
            time.sleep(period)
        if self._reset is not None:
            self._check_state()
            self._diagnostics_pub.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def destroy_node(self) -> None:
        """Leave HAL and ROS."""
        if self._hal is not None:
            self._hal.exit()
            self._hal = None
        super().destroy_node()

    # ---- the loop ----

    def _cycle(self) -> None:
        now = time.monotonic()
        status = self._status
        status.machine_on, status.enabled = self._read_switches()
        if self._active and status.machine_on:
            self._send(now)
            if self._reset is not None:
                self._reset.ask(self._streaming_since, self._heard.last, now)
        output = self._guard.update(now, self._active and status.machine_on and status.enabled)
        status.cycles.tick(now)
        self._write_corrections([value / self._metres for value in output])
        self._write_state(self._state_numbers(now, output))

    def _state_numbers(self, now: float, output: list[float]) -> tuple[float, ...]:
        guard = self._guard
        self._beat = not self._beat
        rejected = sum(self._refusals.counts.values())
        return (
            guard.status,
            min(guard.age(now), NEVER),
            max(map(abs, output)) / self._metres,
            guard.status is GuardStatus.COMPENSATING,
            self._beat,
            self._stop.stopped(now),
            guard.accepted % COUNTS,
            rejected % COUNTS,
            self._status.resets % COUNTS,
        )

    def _send(self, now: float) -> None:
        """Publish measured struts and commanded pose, each only if all its pins are usable."""
        stamp = stamp_of(time.time_ns())
        # Half a cycle less, since cycles come a little early or late.
        if self._states.age(now) >= 1.0 / self._options["states_rate"] - 0.5 / self._options["rate"]:
            feedback = self._read_feedback()
            if self._usable(FEEDBACK, feedback, now):
                self._send_states(feedback, stamp, now)
        axes = self._read_axes()
        if self._usable(AXES, axes, now):
            if self._sent.age(now) > self._options["timeout"]:
                self._streaming_since = now
            self._write_pose(axes)
            self._pose_out.header.stamp = stamp
            self._pose_pub.publish(self._pose_out)
            self._sent.tick(now)

    def _send_states(self, feedback: Sequence[float], stamp: Time, now: float) -> None:
        """Publish measured struts; while no corrections come, only when they stand.

        A compensator starts from the measured struts, and takes their way to its commands for a correction to be
        ramped out. Moving struts lag: one that starts while they move is better left without them, unless it cannot
        start where it was told to be last.
        """
        out, since = self._states_out, self._states.age(now)
        self._states.tick(now)
        followed = since < self._options["timeout"]
        out.write(np.array(feedback) * self._metres, since if followed else 0.0)
        if not followed or max(map(abs, out.velocity.tolist())) > STANDING:
            self._moved_at = now
        in_vain = self._reset is not None and self._reset.in_vain
        if self._silent(now) and now - self._moved_at < self._options["timeout"] and not in_vain:
            return
        out.message.header.stamp = stamp
        self._states_pub.publish(out.message)

    def _silent(self, now: float) -> bool:
        """Return whether the compensator has not been heard of late."""
        return self._heard.age(now) > self._options["timeout"]

    def _write_pose(self, axes: Sequence[float]) -> None:
        p, q = self._pose_out.pose.position, self._pose_out.pose.orientation
        x, y, z, q.x, q.y, q.z, q.w = pose_from_axes(*axes)
        p.x, p.y, p.z = x * self._metres, y * self._metres, z * self._metres

    def _usable(self, names: Sequence[str], values: Sequence[float], now: float) -> bool:
        bad = {name: value for name, value in zip(names, values, strict=True) if not abs(value) <= LARGEST_PIN}
        if not bad:
            return True
        which, listed = ", ".join(bad), ", ".join(f"{name} = {value}" for name, value in bad.items())
        text = f"pins that are no numbers within ±{LARGEST_PIN:g}: {listed}"
        self._status.bad_pins.add(which, text, now)
        self.warn_of(which, text)
        return False

    def _look_at_publishers(self) -> None:
        self._source.look(time.monotonic())

    def _on_correction(self, data: bytes, number: int | None) -> None:
        now = time.monotonic()
        self._heard.tick(now)
        self._source.hear(number, now)
        try:
            if self._source.problem:
                raise CommandError(self._source.reason, self._source.problem)
            stamp = nanoseconds_of(self._reader.take(data).header.stamp)
            self._check_stamp(stamp, now)
            self._guard.offer(self._reader.lengths.tolist(), now)
            self._stamps.accept(stamp, now)
        except CommandError as error:
            self._refusals.add(error.reason, str(error), now)
            self.warn_of(error.reason, f"correction refused ({error.reason}): {error}")

    def _check_stamp(self, stamp: int, now: float) -> None:
        """Refuse a correction of a command that is long past: its stamp is ours, and comes from this clock."""
        if not stamp:
            raise CommandError("stamp_past", "it has no stamp, and answers no command of ours")
        self._stamps.max_age = self._options["timeout"]
        self._status.latency = self._stamps.check(stamp, now)

    # ---- state ----

    def _check_state(self) -> None:
        if self._reset is None:
            return
        now = time.monotonic()
        self._source.look(now)
        level, text = self._status.judged(self._active, now)
        if text != self._last_text:
            self._last_text = text
            self._say(level, text)
        self.tell(level, text, lambda: self._status.values(", ".join(self._source.names), now))

    def _say(self, level: bytes, text: str) -> None:
        if level != OK:
            self.warn_of(text, text)
        elif self._throttle.passes(text) is not None:
            self.get_logger().info(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node; the entry of the executable ``linuxcnc_bridge``."""
    keep_discovery_local()
    return run(LinuxcncBridgeNode, PROGRAM, argv)


if __name__ == "__main__":
    sys.exit(main())
