"""The virtual instrument node: simulates a tracker, a laser or a ball bar that measures the simulated machine.

Run the node with ``ros2 run hexapod_comp instrument`` or ``python -m hexapod_comp.ros.instrument``.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from ..errors import HexapodError
from ..formats.paths import config_file
from ..machine.geometry import load_geometry
from ..pose import Pose
from ..virtual.instruments import LIVE, TRACKER, LiveFlaws, LiveInstrument
from .base import LATCHED_QOS, NEWEST_QOS, OK, STATE_QOS, WARN, MachineNode
from .messages import check_frame, message_pose, pose_message, stamp_of
from .parameters import Program, read_table
from .process import run

SET_UP_TOPIC = "instrument_set_up"
SEEN_WITHIN = 0.5  # Largest age of a true tool pose that is measured, s

PARAMETERS = read_table(f"""
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
kind | laser | {", ".join(LIVE)} | configure | kind of instrument: a tracker publishes ~/pose, a laser or ball bar
    ~/readings
components | 5-D | 1-D, 5-D, 6-D | configure | channels of a laser on a line: 1-D displacement; 5-D also straightness,
    pitch and yaw; 6-D also roll
base_frame | base |  | configure | frame_id of the true tool pose
frame_id | '' |  | configure | frame_id of a tracker's poses; empty: base_frame
stands_at | [0.0, 0.0, 0.0] | -100 to 100 m | configure | position of the tracker in base
stands_turned | [0.0, 0.0, 0.0] | -7 to 7 rad | configure | orientation of the tracker in base: the angles α, β, γ
noise_seed | 0 | 0 to 2147483647 | configure | seed of all random numbers
rate | 100.0 | 1 to 1000 Hz | configure | readings published per second
length_noise | 1.0e-6 | 0 to 0.01 m | always | standard deviation of a length or coordinate reading
angle_noise | 1.0e-6 | 0 to 0.01 rad | always | standard deviation of an angle reading
beam_slope | 1.0e-4 | 0 to 0.1 rad | always | standard deviation of the angle between a laser's beam and its line; used
    from the next run on
centre_off | 3.0e-4 | 0 to 0.1 m | always | standard deviation of a ball bar's centre from its set-up position; used
    from the next run on
wild_share | 0.0 | 0 to 1 | always | share of readings that are outliers
wild_size | 0.001 | 0 to 1 | always | error of an outlier, m or rad
fault_break | 0.0 | 0 to 3600 s | always | each setting breaks the beam for this time: readings are NaN meanwhile, and
    start from a new zero afterwards
fault_silent | false |  | always | publish nothing, but keep the zero of the readings
fault_scale | 1.0 | -1e9 to 1e9 | always | factor of all readings: -1 reverses their sign, 1000 gives mm instead of m
fault_exchanged | false |  | always | exchange the first two channels, or a tracker's x and y
""")

TOPICS = f"""
in   tool_pose_true      PoseStamped: true pose of the tool, in base
     {SET_UP_TOPIC}   PoseStamped, latched: start of a laser's line along the pose's x axis; or centre of a ball bar
out  ~/readings          JointState of a laser or ball bar: name is the channel, position the reading, m or rad
     ~/pose              PoseStamped of a tracker: the tool in the tracker's frame
     /diagnostics
"""

PROGRAM = Program(
    "instrument",
    "Simulates a tracker, a laser or a ball bar that measures a simulated machine.",
    PARAMETERS,
    TOPICS,
    "-p kind:=tracker -p length_noise:=1.0e-5",
)


class InstrumentNode(MachineNode):
    def __init__(self, **options: Any) -> None:
        super().__init__("instrument", PARAMETERS, **options)

    def configure(self) -> None:
        options = self.options
        stands = Pose.from_angles(np.array(options["stands_at"]), np.array(options["stands_turned"]))
        geometry = load_geometry(config_file(options["geometry_file"], "geometry"))
        what, self._tracker = (options["kind"], options["components"]), options["kind"] == TRACKER
        self._instrument = LiveInstrument(geometry, *what, self._flaws(), stands, options["noise_seed"])
        self.set_hardware_id(geometry.name)
        self._seen: tuple[Pose, float] | None = None  # true tool pose and its monotonic time of arrival, s
        self._broken_until, self._published, self._problem = -math.inf, 0, ""
        kind, topic = (PoseStamped, "~/pose") if self._tracker else (JointState, "~/readings")
        self._out = self.publish_on(kind, topic, STATE_QOS)
        self.subscribe(PoseStamped, "tool_pose_true", self._on_tool, NEWEST_QOS)
        self.subscribe(PoseStamped, SET_UP_TOPIC, self._on_set_up, LATCHED_QOS)
        self.every(1.0 / options["rate"], self._publish)

    def on_parameters(self, names: set[str]) -> None:
        """Apply parameters that were set while the node runs; each time ``fault_break`` is set, the beam breaks."""
        if self.configured:
            self._instrument.flaws = self._flaws()
            if "fault_break" in names:
                self._broken_until = time.monotonic() + self.options["fault_break"]

    def _flaws(self) -> LiveFlaws:
        options = self.options
        values = {one.name: options[one.name] for one in fields(LiveFlaws) if one.name in options}
        return LiveFlaws(**values, scale=options["fault_scale"], exchanged=options["fault_exchanged"])

    # ---- messages in and out ----

    def _on_tool(self, message: PoseStamped) -> None:
        if pose := self._pose_in_base(message, "tool_pose_true"):
            self._seen = pose, time.monotonic()

    def _on_set_up(self, message: PoseStamped) -> None:
        if pose := self._pose_in_base(message, SET_UP_TOPIC):
            self._instrument.set_up(pose)
            self.log_action("set up", f"set up for {', '.join(self._instrument.channels)}")

    def _pose_in_base(self, message: PoseStamped, topic: str) -> Pose | None:
        """Return a message's pose; None, with a warning in the log, for an invalid pose or another frame."""
        try:
            check_frame(message.header.frame_id, [self.options["base_frame"]])
            pose, self._problem = message_pose(message), ""
            return pose
        except HexapodError as error:
            self._problem = f"{topic} ignored: {error}"
            self.log_warning(topic, self._problem)
            return None

    def _publish(self) -> None:
        now = time.monotonic()
        if not self._active or self.options["fault_silent"]:
            return
        if self._seen is None or now - self._seen[1] > SEEN_WITHIN:
            return
        broken, message = now < self._broken_until, None
        if self._tracker and not broken:
            message = pose_message(
                self._instrument.pose(self._seen[0]), self.options["frame_id"] or self.options["base_frame"]
            )
        elif not self._tracker:
            if broken:
                self._instrument.zero()
            nothing = dict.fromkeys(self._instrument.channels, math.nan)
            if readings := nothing if broken else self._instrument.read(self._seen[0]):
                message = JointState(name=list(readings), position=list(readings.values()))
        if message is not None:
            message.header.stamp = stamp_of(self.get_clock().now().nanoseconds)
            self._out.publish(message)
            self._published += 1

    # ---- state ----

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        if self._problem:
            yield WARN, self._problem
        elif self._seen is None or now - self._seen[1] > SEEN_WITHIN:
            yield WARN, "no tool_pose_true is received"
        elif now < self._broken_until:
            yield WARN, "the beam is broken"
        yield OK, "reading" if self._tracker or self._instrument.channels else f"waiting for {SET_UP_TOPIC}"

    def values(self, now: float) -> dict[str, str]:
        return {"channels": ", ".join(self._instrument.channels), "readings": str(self._published)}


main = partial(run, InstrumentNode, PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
