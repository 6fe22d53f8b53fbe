"""The LinuxCNC bridge, a HAL component and a ROS node: sends LinuxCNC's axes to the compensator, and writes the
compensator's corrections to pins. LinuxCNC adds the corrections on the pins to its strut commands. Load the bridge from
a HAL file with ``loadusr -Wn hexapod_comp linuxcnc_bridge``."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, UInt64
from std_srvs.srv import Trigger

from ..compensation.guards import Sample, StampClock, StampGate
from ..core import lib
from ..errors import CommandError
from ..ros.base import (
    COMMAND_QOS,
    ERROR,
    EVENT_QOS,
    LATCHED_QOS,
    OK,
    STATE_QOS,
    WARN,
    Flow,
    MachineNode,
    Refusals,
    seconds,
    status_prefix,
)
from ..ros.messages import StrutBytes, StrutReader, stamp_of
from ..ros.parameters import Program, read_table
from ..ros.process import run
from .hal import COUNTS, METRES, HalComponent, pins, pose_from_axes

PARAMETERS = read_table("""
component | hexapod_comp |  | start | name of the HAL component
units | mm | mm, inch | start | LinuxCNC's length unit
rate | 1000.0 | 10 to 2000 Hz | start | cycles per second
states_rate | 200.0 | 1 to 2000 Hz | always | largest rate at which measured struts are published
frame_id | work |  | configure | frame_id of the commanded poses: the compensator's work_frame or base_frame
allow_several_publishers | false |  | configure | accept `strut_corrections` from several publishers
limit | 0.0005 | 1e-09 to 1 m | configure | largest correction; a larger one is refused
ramp_rate | 0.001 | 1e-06 to 1 m/s | always | largest rate of change of the corrections (0.001 is 1 µm per ms)
timeout | 0.1 | 0.001 to 3600 s | always | without an accepted correction for this time, the compensator counts as lost
on_loss | zero | zero, hold | configure | when the compensator is lost, ramp the corrections to `zero`, or `hold` them
""")

# Pins for the commanded axes, and for the tool length that is set in LinuxCNC's kinematics
AXES = ("x", "y", "z", "a", "b", "c", "tool-offset")

FEEDBACK = tuple(f"joint-fb.{n}" for n in range(6))
SWITCHES = ("machine-on", "enable")
CORRECTIONS = tuple(f"correction.{n}" for n in range(6))
FLAGS = ("compensating", "heartbeat", "stopped")
COUNTERS = ("updates", "rejected", "resets")

PINS = (
    pins("in", "float", *AXES, *FEEDBACK)
    | pins("in", "bit", *SWITCHES)
    | pins("out", "float", *CORRECTIONS, "age", "largest")
    | pins("out", "bit", *FLAGS)
    | pins("out", "s32", "status")
    | pins("out", "u32", *COUNTERS)
)

TOPICS = """
in   strut_corrections   JointState: the compensator's corrections, m
     /diagnostics        DiagnosticArray: errors of the compensator
     compensator/stopped, compensator/heartbeat
out  tool_pose_command   PoseStamped: LinuxCNC's commanded axes
     strut_states        JointState: LinuxCNC's measured struts, m
     /diagnostics
ask  compensator/reset   Trigger, of the compensator
HAL  hexapod_comp.x … correction.0 … status: doc/linuxcnc.md lists the pins
"""

PROGRAM = Program(
    "linuxcnc_bridge",
    "Connects LinuxCNC with the compensator; load it from a HAL file: loadusr -Wn hexapod_comp linuxcnc_bridge.",
    PARAMETERS,
    TOPICS,
    "-p units:=inch",
)

ZERO = (0.0,) * 6


class GuardStatus(IntEnum):
    OFF = 0  # compensation is not enabled; the output is zero
    RAMPING = 1  # the output ramps to the newest corrections
    COMPENSATING = 2  # the output equals the newest corrections
    HOLDING = 3  # the compensator is lost; the output is held
    RETURNING = 4  # the output ramps to zero, because the compensator is lost or compensation is not enabled
    WAITING = 5  # compensation is enabled, but the output is zero, because all corrections are older than `timeout`


class CorrectionGuard:
    """Six output corrections, m, that follow the compensator's newest corrections with limited size and ramp rate."""

    def __init__(self, rules: Mapping[str, Any]) -> None:
        self._rules = rules  # the node's parameters limit, ramp_rate, timeout and on_loss
        self.output: list[float] = list(ZERO)
        self.status = GuardStatus.OFF
        self.accepted = 0  # number of accepted corrections
        self._newest: list[float] = list(ZERO)
        self._accepted_at = self._updated_at = -math.inf

    def age(self, now: float) -> float:
        return now - self._accepted_at

    def offer(self, correction: Sequence[float], now: float) -> None:
        """Let the outputs ramp to six new corrections, m; raise a CommandError if one is NaN or beyond ±`limit`."""
        limit = self._rules["limit"]
        for number, value in enumerate(correction, start=1):
            if not abs(value) <= limit:
                text = f"correction {value * 1e6:.3f} µm is larger than ±{limit * 1e6:g} µm"
                raise CommandError("correction", f"strut {number}: {text}")
        self._newest, self._accepted_at = list(correction), now
        self.accepted += 1

    def update(self, now: float, enabled: bool) -> list[float]:
        """Change the output corrections towards their target at `ramp_rate` or slower, and return them, m.

        In the first update, and in an update after the clock was set back, the output does not change.
        """
        elapsed, self._updated_at = now - self._updated_at, now
        ramp_rate = self._rules["ramp_rate"]
        allowed = ramp_rate * (min(elapsed, lib.LONGEST_RAMP_STEP) if 0.0 < elapsed < math.inf else 0.0)
        target, arrived = self._target(now, enabled)
        changes = [there - here for there, here in zip(target, self.output, strict=True)]
        largest = max(abs(change) for change in changes)
        if largest <= allowed:
            self.output, self.status = list(target), arrived
            return self.output
        share, left = allowed / largest, largest - allowed
        self.output = [here + share * change for here, change in zip(self.output, changes, strict=True)]
        if arrived is not GuardStatus.COMPENSATING:
            self.status = GuardStatus.RETURNING
        elif self.status is not GuardStatus.COMPENSATING or left > ramp_rate * lib.LONGEST_RAMP_STEP:
            self.status = GuardStatus.RAMPING  # not if a compensating output lags by less than one step
        return self.output

    def _target(self, now: float, enabled: bool) -> tuple[Sequence[float], GuardStatus]:
        """Return the target of the output corrections, and the status to report when they have reached it."""
        if not enabled:
            return ZERO, GuardStatus.OFF
        if not self.accepted:
            return ZERO, GuardStatus.WAITING
        if self.age(now) <= self._rules["timeout"]:
            return self._newest, GuardStatus.COMPENSATING
        if self._rules["on_loss"] == "hold":
            return self.output, GuardStatus.HOLDING
        return ZERO, GuardStatus.WAITING


TEXTS = {
    GuardStatus.OFF: (OK, "off"),
    GuardStatus.RAMPING: (OK, "running, corrections are ramping in"),
    GuardStatus.COMPENSATING: (OK, "running"),
    GuardStatus.HOLDING: (ERROR, "compensator lost, corrections are held"),
    GuardStatus.RETURNING: (OK, "off, corrections are ramping out"),
    GuardStatus.WAITING: (WARN, "waiting for the first correction"),
}


RESET_AFTER = 0.15  # A reset is requested `timeout` plus this time after the last correction, s
RESET_PERIOD = 0.5  # Shortest time between two requests for a reset, s
ERROR_VALID_FOR = 1.2  # Age up to which an error in the compensator's diagnostics counts, s; their period is 1 s


class CompensatorReset:
    """A client that calls ``compensator/reset`` when the compensator reports an error and answers no command.

    A compensator that reports no error is not called, since it may have ended: after a request that nobody receives,
    DDS delays the next requests by seconds.
    """

    def __init__(self, node: MachineNode, options: dict[str, Any]) -> None:
        self._node, self._options = node, options
        self._name = status_prefix(node.get_namespace(), "compensator")
        self._requested_at = self._reported_at = -math.inf
        self._unanswered = 0
        self._pending: Future | None = None
        node.subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, EVENT_QOS)
        self._client = node.create_client(Trigger, "compensator/reset")

    @property
    def unanswered(self) -> bool:
        """Whether the reset was requested twice or more often since the last correction arrived."""
        return self._unanswered > 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == ERROR and status.name.startswith(self._name):
                self._reported_at = time.monotonic()

    def request(self, streaming_since: float, received_at: float, now: float) -> bool:
        """Request a reset if no correction has arrived for `timeout` + RESET_AFTER; return whether it was requested.

        The arguments are monotonic times, s: when the commands began, when the last correction arrived, and now.
        """
        if received_at > self._requested_at:
            self._unanswered = 0
        waited = now - max(streaming_since, received_at)
        if waited < self._options["timeout"] + RESET_AFTER or now - self._requested_at < RESET_PERIOD:
            return False
        if self._reported_at < received_at or now - self._reported_at > ERROR_VALID_FOR:
            return False
        self._requested_at = now
        if not self._client.service_is_ready():
            return False
        if self._pending is not None:
            self._client.remove_pending_request(self._pending)
        self._pending = self._client.call_async(Trigger.Request())
        self._unanswered += 1
        self._node.log_warning("reset", "the compensator refuses every command; its reset was requested")
        return True


NEVER = 1e9  # value of the pin `age` before the first correction, s
REST_SPEED = 2e-3  # Speed, m/s, below which struts count as at rest: their drives lag by only some micrometres

LARGEST_PIN = 1e6  # Largest usable number on a pin, in LinuxCNC's length unit or degrees, which causes no overflow

LONGEST_RAMP_OUT = 1.0  # Longest time for which an ending process waits until its corrections are zero, s


class LinuxcncBridgeNode(MachineNode):
    """Lifecycle node with a HAL component, which exists and toggles its heartbeat in every lifecycle state."""

    def __init__(self, hal: Any = None, **options: Any) -> None:
        super().__init__("linuxcnc_bridge", PARAMETERS, **options)
        self._metres = METRES[self.options["units"]]
        self._guard = CorrectionGuard(self.options)
        # of the loop's cycles, of published commands, of published measured struts, and of received corrections
        self._cycles, self._sent, self._states, self._received = Flow(), Flow(), Flow(), Flow()
        self._refusals, self._bad_pins = Refusals(), Refusals()  # of corrections, and of numbers on input pins
        self._machine_on = self._enabled = False  # values of the pins SWITCHES
        self._resets = 0  # number of requested resets of the compensator
        self._latency = 0.0  # time from a command to the receipt of its correction, s
        self._reader = StrutReader()
        self.clock = StampClock()  # the system's clock, whose time is in the bridge's stamps
        self._stamps = StampGate("correction", self.clock)
        self._streaming_since, self._moved_at = math.inf, -math.inf
        self._beat, self._last_text = False, ""
        self._reset: CompensatorReset | None = None  # None while the node is not configured
        self._hal: HalComponent | None = HalComponent(self.options["component"], PINS, hal)
        self._open_pins(self._hal)
        self._pose_out, self._states_out = PoseStamped(), StrutBytes()
        self._stopped = True  # whether the compensator refuses commands
        self._beat_at = -math.inf  # monotonic time of the compensator's last heartbeat, s
        self.subscribe(Bool, "compensator/stopped", self._on_stopped, LATCHED_QOS)
        self.subscribe(UInt64, "compensator/heartbeat", self._on_beat, EVENT_QOS)
        self._hal.ready()
        self.every(1.0 / self.options["rate"], self._cycle)

    def _open_pins(self, hal: HalComponent) -> None:
        self._read_axes, self._read_feedback = hal.reader(*AXES), hal.reader(*FEEDBACK)
        self._read_switches = hal.reader(*SWITCHES)
        self._write_corrections = hal.writer(*CORRECTIONS)
        self._write_state = hal.writer("status", "age", "largest", *FLAGS, *COUNTERS)
        self._write_state((GuardStatus.OFF, NEVER, 0.0, False, False, True, 0, 0, 0))

    # ---- lifecycle ----

    def configure(self) -> None:
        several = self.options["allow_several_publishers"]
        self._pose_out.header.frame_id = self.options["frame_id"]
        self._pose_pub = self.publish_on(PoseStamped, "tool_pose_command", COMMAND_QOS, self.options["timeout"])
        self._states_pub = self.publish_on(JointState, "strut_states", STATE_QOS)
        self.set_hardware_id(self.options["component"])
        self._source = self.subscribe_exclusive(JointState, "strut_corrections", self._on_correction, several)
        self._reset = CompensatorReset(self, self.options)

    def unconfigure(self) -> None:
        self._reset = None

    def publish_last_status(self) -> None:
        """Ramp the corrections to zero if this takes at most LONGEST_RAMP_OUT seconds; then publish a last status."""
        self._active = False
        period, end = 1.0 / self.options["rate"], time.monotonic() + LONGEST_RAMP_OUT
        if max(map(abs, self._guard.output)) > self.options["ramp_rate"] * LONGEST_RAMP_OUT:
            left = "the node ends and leaves its corrections on the pins"
            self.get_logger().warning(f"{left}: a ramp to zero would take more than {LONGEST_RAMP_OUT:g} s")
            end = 0.0
        while any(self._guard.output) and time.monotonic() < end:
            self._cycle()
            time.sleep(period)
        super().publish_last_status()

    def destroy_node(self) -> None:
        if self._hal is not None:
            self._hal.exit()
            self._hal = None
        super().destroy_node()

    def _on_stopped(self, message: Bool) -> None:
        self._stopped = message.data

    def _on_beat(self, _: UInt64) -> None:
        self._beat_at = time.monotonic()

    # ---- the loop ----

    def _cycle(self) -> None:
        now = time.monotonic()
        self._machine_on, self._enabled = self._read_switches()
        if self._active and self._machine_on:
            self._send(now)
            if self._reset is not None:
                self._resets += self._reset.request(self._streaming_since, self._received.last, now)
        output = self._guard.update(now, self._active and self._machine_on and self._enabled)
        self._cycles.tick(now)
        self._write_corrections([value / self._metres for value in output])
        self._beat = not self._beat
        self._write_state(
            (
                self._guard.status,
                min(self._guard.age(now), NEVER),
                max(map(abs, output)) / self._metres,
                self._guard.status is GuardStatus.COMPENSATING,
                self._beat,
                self._stopped or now - self._beat_at > self.options["timeout"],
                self._guard.accepted % COUNTS,
                self._refusals.total % COUNTS,
                self._resets % COUNTS,
            )
        )

    def _send(self, now: float) -> None:
        """Publish the measured struts, if they are due, and the commanded pose, unless a pin is unusable."""
        stamp = time.time_ns()
        p, q = self._pose_out.pose.position, self._pose_out.pose.orientation
        early = 0.5 / self.options["rate"]  # half a cycle, since cycles begin a little early or late
        if self._states.age(now) >= 1.0 / self.options["states_rate"] - early:
            feedback = self._read_feedback()
            if self._usable(FEEDBACK, feedback, now):
                self._send_states(feedback, stamp, now)
        axes = self._read_axes()
        if self._usable(AXES, axes, now):
            if self._sent.age(now) > self.options["timeout"]:
                self._streaming_since = now
            x, y, z, q.x, q.y, q.z, q.w = pose_from_axes(*axes)
            p.x, p.y, p.z = x * self._metres, y * self._metres, z * self._metres
            self._pose_out.header.stamp = stamp_of(stamp)
            self._pose_pub.publish(self._pose_out)
            self._sent.tick(now)

    def _send_states(self, feedback: Sequence[float], stamp: int, now: float) -> None:
        """Publish the measured struts, unless the struts move while no corrections arrive.

        A compensator that starts while the struts move would ramp out the drives' lag, commanded minus measured struts,
        as if the lag were a correction. After two requests to reset the compensator without an answer, measured struts
        are published also during motion.
        """
        out, since = self._states_out, self._states.age(now)
        self._states.tick(now)
        followed = since < self.options["timeout"]
        message = out.encoded([value * self._metres for value in feedback], stamp, since if followed else 0.0)
        if not followed or max(map(abs, out.velocity.tolist())) > REST_SPEED:
            self._moved_at = now
        unanswered = self._reset is not None and self._reset.unanswered
        silent = self._received.age(now) > self.options["timeout"]
        if silent and now - self._moved_at < self.options["timeout"] and not unanswered:
            return
        self._states_pub.publish(message)

    def _usable(self, names: Sequence[str], values: Sequence[float], now: float) -> bool:
        bad = {name: value for name, value in zip(names, values, strict=True) if not abs(value) <= LARGEST_PIN}
        if not bad:
            return True
        which, listed = ", ".join(bad), ", ".join(f"{name} = {value}" for name, value in bad.items())
        text = f"pins that are not finite or exceed ±{LARGEST_PIN:g}: {listed}"
        self._bad_pins.add(which, text, now)
        self.log_warning(which, text)
        return False

    def update_publishers(self) -> None:
        self._source.update(time.monotonic())

    def _on_correction(self, data: bytes, sample: Sample) -> None:
        self._received.tick(sample.now)
        try:
            self._source.check(sample)
            self._reader.sample(data, sample)
            if not sample.stamp:
                raise CommandError("stamp_past", "a correction needs the stamp of a command of this bridge, not zero")
            self._stamps.max_age = self.options["timeout"]  # since a correction has the stamp of its command
            self._stamps.check(sample)
            self._latency = sample.age
            self._guard.offer(sample.values or (), sample.now)
            self._stamps.accept(sample)
        except CommandError as error:
            self._refusals.add(error.reason, str(error), sample.now)
            self.log_warning(error.reason, f"correction refused ({error.reason}): {error}")

    # ---- state ----

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        level, text = self._finding(now)
        if text != self._last_text:
            self._last_text = text
            (self.log_action if level == OK else self.log_warning)(text, text)
        yield level, text

    def _finding(self, now: float) -> tuple[bytes, str]:
        status = self._guard.status
        if self._bad_pins.recent(now):
            return ERROR, f"unusable pins: {self._bad_pins.last_reason}"
        if self._refusals.recent(now):
            return ERROR, f"refusing corrections: {self._refusals.last_reason}"
        if not self._machine_on:
            return OK, "machine off"
        if self._enabled and self._guard.accepted and status is GuardStatus.WAITING:
            return ERROR, "compensator lost, corrections are zero"
        if self._enabled and status is GuardStatus.RETURNING:
            return ERROR, "compensator lost, corrections are ramping out"
        return TEXTS[status]

    def values(self, now: float) -> dict[str, str]:
        return {
            "status": self._guard.status.name.lower(),
            "machine_on": str(self._machine_on).lower(),
            "enabled": str(self._enabled).lower(),
            "cycle_rate_hz": f"{self._cycles.rate(now):.1f}",
            "command_rate_hz": f"{self._sent.rate(now):.1f}",
            "correction_rate_hz": f"{self._received.rate(now):.1f}",
            "correction_age_s": seconds(self._guard.age(now)),
            "latency_s": f"{self._latency:.6f}",
            "largest_correction_m": f"{max(map(abs, self._guard.output)):.9f}",
            "accepted": str(self._guard.accepted),
            "resets": str(self._resets),
            "compensated_by": ", ".join(self._source.names),
            "last_refusal": self._refusals.last_text,
            "last_bad_pins": self._bad_pins.last_text,
            **self._refusals.values(),
        }


main = partial(run, LinuxcncBridgeNode, PROGRAM)

if __name__ == "__main__":
    sys.exit(main())
