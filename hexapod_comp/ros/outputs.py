"""Topics that a compensator publishes besides strut commands: pose estimate, markers, heartbeat, validity, stop,
journal."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, PoseStamped
from sensor_msgs.msg import JointState, TimeReference
from std_msgs.msg import Bool, ColorRGBA, String, UInt64
from visualization_msgs.msg import Marker, MarkerArray

from ..compensation.compensator import Compensator
from ..compensation.journal import Journal, Source, sources_text
from ..core import ffi
from ..machine.geometry import HexapodGeometry
from ..machine.kinematics import strut_lengths
from ..machine.robot_description import joint_positions, urdf
from ..pose import Pose
from .base import ACKNOWLEDGED_WITHIN, EVENT_QOS, LATCHED_QOS, STATE_QOS, profile
from .compensator_state import STRUTS, CompensatorState
from .messages import PoseBytes, StrutBytes, period, stamp_of

# Period of ~/stopped, s, which is repeated, since the middleware of a busy computer may lose a message
REPEATED_AFTER = 1.0

LAST_STAMP = 2**31 * 10**9 - 1  # Largest stamp of a ROS message, ns

# QoS of the journal: no page may be lost, and late subscribers need the last pages
JOURNAL_QOS = profile(10, latched=True)


def nominal_lengths(compensator: Compensator, measured: np.ndarray) -> np.ndarray:
    """Return the measured strut lengths minus the corrections, m, for a controller that plans nominal lengths.

    If the controller got the measured lengths, it would treat the corrections as a position error. Before the first
    command the corrections are computed from the model, or are zero if compensation is off.
    """
    if np.isfinite(compensator.correction).all():
        return measured - compensator.correction
    if not compensator.enabled:
        return measured
    tool = compensator.estimate(measured)
    pose = Pose(tool[:3], tool[3:].reshape((3, 3)))
    return strut_lengths(compensator.geometry, pose @ compensator.geometry.tool.inverse())


class Outputs:
    """Topics: pose estimate, markers, joint positions, URDF; and ~/heartbeat, ~/validity, ~/stopped for a monitor."""

    def __init__(self, node: CompensatorState) -> None:
        self._node, self._compensator = node, node.compensator
        options = node.options
        self._frame, self._names = options["base_frame"], options["joint_names"]
        self.answered = 0  # stamp of the newest answered command, ns; 0: none
        self._estimates = node.publish_on(PoseStamped, "tool_pose_estimate", STATE_QOS)
        self._markers = node.create_publisher(MarkerArray, "~/markers", EVENT_QOS)
        self._heartbeats = node.create_publisher(UInt64, "~/heartbeat", EVENT_QOS)
        self._validities = node.create_publisher(TimeReference, "~/validity", EVENT_QOS)
        self._stops = node.create_publisher(Bool, "~/stopped", LATCHED_QOS)
        self._joints = self._description = self._nominal = None
        by_struts = options["command_input"] == STRUTS
        if options["publish_description"]:
            self._joints = node.create_publisher(JointState, "joint_states", EVENT_QOS)
            self._description = node.create_publisher(String, "robot_description", LATCHED_QOS)
            self._description.publish(String(data=urdf(node.compensator.geometry, self._names, ros2_control=by_struts)))
        if by_struts:
            self._nominal = node.publish_on(JointState, "nominal_strut_states", STATE_QOS)
        self._nominal_out, self._estimate_out = StrutBytes(names=self._names), PoseBytes(self._frame)
        self._beat, self._validity = UInt64(), TimeReference(source=node.resolve_topic_name("strut_commands"))
        self._stopped: bool | None = None
        self._stop_published = 0.0  # monotonic time, s
        self.stop(True)
        node.at_rate("heartbeat_rate", self._publish_heartbeat)
        node.at_rate("marker_rate", self._publish_picture)

    def estimate(self, pose: np.ndarray, stamp: int) -> None:
        """Publish a tool pose (position, m, then rotation matrix by rows), moved by the drift that fusion estimates."""
        if self._estimates.get_subscription_count():
            instrument = self._node.instrument
            pose = pose if instrument is None else instrument.fusion.with_drift(pose)
            self._estimates.publish(self._estimate_out.encoded(pose, stamp))

    def nominal(self, stamp: int, mean: Callable[[], np.ndarray]) -> None:
        """Publish measured strut lengths minus the corrections; `mean` returns the lengths, averaged at standstill."""
        if self._nominal is not None:
            out, fastest = self._nominal_out, self._compensator.geometry.limits.speed
            lengths = np.ascontiguousarray(nominal_lengths(self._compensator, mean()))
            at = ffi.from_buffer("double[6]", lengths)
            self._nominal.publish(out.encoded(at, stamp, period(out.stamp, stamp), fastest))

    def stop(self, stopped: bool) -> None:
        """Publish, at each change and every :data:`REPEATED_AFTER`, whether commands are refused."""
        now = time.monotonic()
        if stopped != self._stopped or now - self._stop_published > REPEATED_AFTER:
            self._stopped, self._stop_published = stopped, now
            self._stops.publish(Bool(data=stopped))

    def wait(self) -> None:
        self._stops.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    def _publish_heartbeat(self) -> None:
        self._beat.data += 1
        if self._heartbeats.get_subscription_count():
            self._heartbeats.publish(self._beat)
        lasting = round(self._node.options["command_timeout"] * 1e9)
        if self.answered and lasting and self._validities.get_subscription_count():
            self._validity.header.stamp = stamp_of(self.answered)
            self._validity.time_ref = stamp_of(min(self.answered + lasting, LAST_STAMP))
            self._validities.publish(self._validity)

    def _publish_picture(self) -> None:
        if not self._node.active:
            return
        now, pose = self._node.get_clock().now().to_msg(), self._compensator.platform_estimate
        geometry = self._compensator.geometry
        if self._markers.get_subscription_count():
            before_first_command = np.isnan(self._compensator.nominal).any()
            correction = np.zeros(6) if before_first_command else self._compensator.correction
            self._markers.publish(machine_markers(geometry, *pose, correction, self._frame, now))
        if self._joints is not None and self._joints.get_subscription_count():
            positions = joint_positions(geometry, Pose(*pose), self._names)
            message = JointState(name=list(positions), position=list(positions.values()))
            message.header.stamp = now
            self._joints.publish(message)


class JournalTopics:
    """Topics for the replay of a recording: ~/journal, with the pages of :mod:`hexapod_comp.compensation.journal`, and
    ~/files, with the geometry and model file in use. The topics are latched, for a recorder that starts late."""

    def __init__(self, node: CompensatorState) -> None:
        self._sources, self._published = node.files.sources, dict[str, Source]()
        self._pages = node.create_publisher(String, "~/journal", JOURNAL_QOS)
        self._files = node.create_publisher(String, "~/files", JOURNAL_QOS)
        self._journal = Journal(node.compensator, self._sources, node.frame_ids, node.options["joint_names"])
        self.answered, self.refused = self._journal.answered, self._journal.refused
        self.tick(time.monotonic())  # so that the first page precedes the first command

    def tick(self, now: float) -> None:
        """If the journal's next page is due, publish changed geometry and model files, and then the page."""
        if not self._journal.due(now):
            return
        if self._sources != self._published:
            self._files.publish(String(data=sources_text(self._sources)))
            self._published = dict(self._sources)
        self._pages.publish(String(data=self._journal.page(now)))

    def finish(self, now: float) -> None:
        """Publish the journal's last page and wait up to 0.4 s for its arrival."""
        self._pages.publish(String(data=self._journal.page(now)))
        self._pages.wait_for_all_acked(ACKNOWLEDGED_WITHIN)


# ---- markers ----

STRUT_DIAMETER = 0.02
JOINT_DIAMETER = 0.035
LIFETIME = Duration(sec=1)  # Time without an update after which RViz removes the machine

GREY = ColorRGBA(r=0.5, g=0.5, b=0.55, a=1.0)
STEEL = ColorRGBA(r=0.3, g=0.35, b=0.45, a=0.9)


def machine_markers(
    geometry: HexapodGeometry,
    position: np.ndarray,
    rotation: np.ndarray,
    correction: np.ndarray,
    frame_id: str,
    stamp: Time,
) -> MarkerArray:
    """Return markers of the machine at a platform pose in ``base``, with the struts coloured by `correction`, m."""
    base = geometry.base_joints
    platform = position + geometry.platform_joints @ rotation.T
    tip = position + rotation @ geometry.tool.position + 0.1 * rotation[:, 2]
    markers: list[Marker] = []
    for kind, size, colour, points in (
        (Marker.LINE_LIST, STRUT_DIAMETER, None, [end for ends in zip(base, platform, strict=True) for end in ends]),
        (Marker.SPHERE_LIST, JOINT_DIAMETER, GREY, (*base, *platform)),
        (Marker.LINE_STRIP, STRUT_DIAMETER, STEEL, (*platform, platform[0])),
        (Marker.LINE_STRIP, STRUT_DIAMETER, GREY, (*base, base[0])),
        (Marker.ARROW, STRUT_DIAMETER, STEEL, (position, tip)),
    ):
        marker = Marker(ns="hexapod", id=len(markers), type=kind, action=Marker.ADD, lifetime=LIFETIME)
        marker.header.frame_id, marker.header.stamp = frame_id, stamp
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = size
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in np.array(points).tolist()]
        if colour is not None:
            marker.color = colour
        else:  # struts
            marker.color.a = 1.0
            marker.colors = [correction_colour(amount) for amount in correction for _ in range(2)]
        markers.append(marker)
    return MarkerArray(markers=markers)


def correction_colour(correction: float) -> ColorRGBA:
    """Return the colour of a strut's correction, m: blue for −100 µm and below, white for 0, red from +100 µm on."""
    share = max(-1.0, min(1.0, correction / 100e-6))
    rest = 1.0 - abs(share)
    return ColorRGBA(r=1.0 if share > 0 else rest, g=rest, b=1.0 if share < 0 else rest, a=1.0)
