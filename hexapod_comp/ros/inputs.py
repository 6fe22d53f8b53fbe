"""What a compensator reads: commands, as poses or struts; temperatures, loads, outside numbers, measured poses.

Each topic of readings is handled in the same way: one publisher, a minimum period, a valid message; then its handler,
which raises an error about the content. A rejected reading, or a second publisher, is counted and reported, and stops
nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped, WrenchStamped
from sensor_msgs.msg import JointState

from ..compensation.compensator import Compensator
from ..compensation.fusion import Fusion, FusionRules, PoseReading, checked_covariance
from ..compensation.guards import Guard, Sample
from ..core.batch import quaternion_of
from ..errors import CommandError, HexapodError, OutsideTableError, shorten
from ..machine.geometry import BASE
from ..machine.kinematics import Structure, forward_error, solve_poses
from ..machine.load import EARTH, Loading, wrench_on_platform
from ..machine.outside import read_numbers
from ..pose import Pose
from .base import SENSOR_QOS, seconds
from .interface import STRUTS, CompensatorState
from .messages import StrutReader, check_frame, command_stamp, message_pose, read_message, read_pose

WRENCH_PERIOD = 0.01  # A wrench that arrives sooner after the last one, s, is ignored: each ramps in, and is journalled

POSE_TOPIC = "tool_pose_measured"
POSE_MESSAGES = {"pose_with_covariance": PoseWithCovarianceStamped, "pose": PoseStamped}
FEED_PERIOD = 1.0  # Period at which the drift is passed to the compensation, s: it is slow, and each time makes a model

# ---- commands ----


class PoseInput:
    """Tool poses on ``tool_pose_command``."""

    topic, kind = "tool_pose_command", PoseStamped

    read = staticmethod(read_pose)
    """Reads a command into a sample: stamp, frame and the seven numbers of a pose; without values nothing is commanded
    yet."""

    def stamp(self, data: bytes) -> int:
        """Return the stamp of a command, ns; 0 if it has none."""
        sample = Sample(0.0)
        try:
            self.read(data, sample)
        except HexapodError:
            return 0
        return sample.stamp


class StrutInput(PoseInput):
    """Nominal strut lengths on ``strut_setpoints``, m, by name: what a controller that plans struts itself commands a
    machine without errors.

    They become the tool pose of that machine at once: limits, stamps, journal and replay only use poses. The strut
    readings that such a controller receives are nominal too.
    """

    topic, kind = "strut_setpoints", JointState

    def __init__(self, compensator: Compensator, names: list[str], frame_id: str) -> None:
        # the search for the pose starts from its last command
        self._compensator, self._frame_id = compensator, frame_id
        self._structure, self._reader = Structure.of(compensator.geometry), StrutReader(names)

    def read(self, data: bytes, sample: Sample) -> None:  # type: ignore[override]
        """As for poses; no values while all lengths are NaN: ros2_control publishes NaN until one of its controllers is
        active. A KinematicsError: no pose near the last command, nor near home, has these lengths."""
        message = read_message(data, JointState)
        sample.stamp, sample.frame_id = command_stamp(message.header.stamp), self._frame_id
        lengths = self._reader.pick(message)
        if np.isnan(lengths).all():
            return
        self._reader.check(lengths.tolist())
        guesses = [self._compensator.geometry.home]
        if np.isfinite(self._compensator.nominal).all():  # else there was no command yet
            guesses.insert(0, self._compensator.platform)
        for guess in guesses:
            solved = solve_poses(self._structure, lengths[None], guess, threads=1)
            if solved.ok[0]:
                tool = Pose(solved.positions[0], solved.rotations[0]) @ self._compensator.geometry.tool
                sample.values = (*tool.position.tolist(), *quaternion_of(tool.rotation))
                return
        raise forward_error(int(solved.outcomes[0]), float(solved.conditions[0]), self._structure.max_condition)


def command_input(node: CompensatorState) -> PoseInput:
    """Return the input selected by a node's parameters."""
    if node.options["command_input"] == STRUTS:
        return StrutInput(node.compensator, node.options["joint_names"], node.options["base_frame"])
    return PoseInput()


# ---- readings ----


class SensorTopic:
    """The subscription of one topic of readings.

    `handle` is called with each message and its time of arrival, monotonic, s; it raises a HexapodError to reject it.
    `reject` is called with that error; None: it is bad feedback. Messages within `period`, s, of the last good one are
    ignored.
    """

    def __init__(
        self,
        node: CompensatorState,
        topic: str,
        kind: type,
        handle: Callable[[Any, float], None],
        reject: Callable[[HexapodError], None] | None = None,
        period: float = 0.0,
        several: str = "allow_several_publishers",  # name of the parameter that allows a second publisher
    ) -> None:
        self._node, self._topic, self._kind, self._period = node, topic, kind, period
        self._handle, self._reject = handle, reject or self._bad_feedback
        self.last = math.nan  # time of the last good message, s; NaN before the first
        allowed = bool(node.options["allow_several_publishers"] or node.options[several])
        self._sender = node.sensing[topic] = node.subscribe_exclusive(kind, topic, self._receive, allowed, SENSOR_QOS)

    def stale(self, now: float, timeout: float) -> bool:
        """Return whether it was published before, but not for longer than a timeout, s (0: off)."""
        return 0.0 < timeout < now - self.last

    def _receive(self, data: bytes, sample: Sample) -> None:
        # Dated by arrival: sensors need no stamp, clocks may be set, and a drift is slow compared with transport
        # delays.
        try:
            self._sender.check(sample)
            if sample.now - self.last < self._period:
                return
            self._handle(read_message(data, self._kind), sample.now)
            self.last = sample.now
        except HexapodError as error:
            self._reject(error)

    def _bad_feedback(self, error: HexapodError) -> None:
        what = self._topic.removesuffix("s")
        self._node.ignore(what, error, self._node.bad_feedback, "" if isinstance(error, CommandError) else what)


class Loads:
    """Passes gravity, wrench and outside numbers from their single publishers to the compensator."""

    def __init__(self, node: CompensatorState) -> None:
        self._node, self._compensator = node, node.compensator
        self._gravity: tuple[float, ...] | None = None  # as published; None: the parameter's, or the model's
        self._wrench = Loading().wrench
        self._numbers: dict[str, float] = {}  # as published; the compensator has those that count
        self._table = Guard()  # of a table that refuses numbers outside
        self._table.reason = OutsideTableError.reason
        node.standing = (*node.standing, self._table)
        self._topics = {
            "gravity": SensorTopic(node, "gravity", Vector3Stamped, self._on_gravity),
            "wrench": SensorTopic(node, "wrench", WrenchStamped, self._on_wrench, period=WRENCH_PERIOD),
            "outside": SensorTopic(node, "outside", JointState, self._on_numbers),
        }
        self.apply()

    def apply(self) -> None:
        """Pass the present gravity and wrench to the compensator, unless ``outside_hold`` holds the previous ones."""
        if self._node.options["outside_hold"]:
            return
        stated = self._node.options["gravity"]
        gravity = self._gravity or (stated if any(stated) else None)
        self._compensator.set_load(Loading.of(gravity, self._wrench))

    def update(self) -> None:
        """Pass the newest outside numbers to the compensator if they move the tool by more than ``outside_dead_band``.

        It is called periodically, not by each message, since each change builds a new model.
        """
        compensator, options = self._compensator, self._node.options
        if options["outside_hold"] or self._table.problem or self._numbers.items() <= compensator.outside.items():
            return
        table, known = compensator.model.outside, compensator.outside | self._numbers
        change = table.evaluate(known) - table.evaluate(compensator.outside)
        moved = np.linalg.norm(change[:3]) + np.linalg.norm(change[3:]) * compensator.geometry.characteristic_length
        if table.missing(compensator.outside) or moved > options["outside_dead_band"]:
            try:
                compensator.set_outside(self._numbers)
            except HexapodError as error:
                self._node.ignore("outside", error, self._node.bad_feedback, "outside")

    def stale(self, now: float) -> str:
        """Return the published value, but not for longer than ``outside_timeout``."""
        timeout = self._node.options["outside_timeout"]
        return ", ".join(name for name, topic in self._topics.items() if topic.stale(now, timeout))

    def _on_gravity(self, message: Vector3Stamped, _: float) -> None:
        base = self._node.ids[BASE]
        if message.header.frame_id != base:
            problem = f"frame_id must be {base}, not {shorten(message.header.frame_id)}"
            raise CommandError("gravity", f"gravity: {problem}")
        vector = message.vector.x, message.vector.y, message.vector.z
        size = math.hypot(*vector)
        if not EARTH[0] <= size <= EARTH[1]:
            allowed = "{:g}…{:g} m/s²".format(*EARTH)
            raise CommandError("gravity", f"gravity: must be {allowed} in all, not {size:.4g}")
        moved = np.inf if self._gravity is None else math.dist(vector, self._gravity)
        if moved > self._node.options["gravity_dead_band"]:
            self._gravity = vector
            self.apply()

    def _on_wrench(self, message: WrenchStamped, _: float) -> None:
        parts = message.wrench.force, message.wrench.torque
        force, torque = (np.array([part.x, part.y, part.z]) for part in parts)
        self._wrench = wrench_on_platform(self._compensator.geometry, message.header.frame_id, force, torque)
        self.apply()

    def _on_numbers(self, message: JointState, _: float) -> None:
        table = self._compensator.model.outside
        if len(message.name) != len(message.position):
            problem = f"has {len(message.name)} names for {len(message.position)} positions"
            raise CommandError("outside", f"outside: {problem}")
        told = read_numbers({n: v for n, v in zip(message.name, message.position, strict=True) if n in table.names})
        if table.names and not told:
            found = shorten(", ".join(message.name))
            raise CommandError("outside", f"outside: must name {' or '.join(table.names)}, not {found}")
        try:
            table.validate(told)
        except OutsideTableError as error:
            self._table.problem = str(error)
            raise
        self._numbers |= told
        self._table.problem = ""

    def findings(self) -> Iterator[str]:
        """Yield warnings about the model's table of outside numbers."""
        table, numbers = self._compensator.model.outside, self._compensator.outside
        if missing := table.missing(numbers):
            yield f"the model's table does not count: not known is {missing}"
        elif held := table.held(numbers):
            yield f"running, outside the model's table, whose edge holds: {held}"

    def values(self) -> dict[str, str]:
        """Return the loads in use, as key and value of diagnostics, as far as the model uses them."""
        compensator, model = self._compensator, self._compensator.model
        values = {}
        if model.load.bends or model.outside.names:
            values["outside_hold"] = str(self._node.options["outside_hold"]).lower()
        if model.outside.names:
            error = 1e6 * model.outside.evaluate(compensator.outside)
            known = {name: value for name, value in compensator.outside.items() if name in model.outside.names}
            values["outside"] = ", ".join(model.outside.shown(*one) for one in known.items()) or "not known"
            values["outside_um"] = ", ".join(f"{value:.3f}" for value in error[:3])
            values["outside_urad"] = ", ".join(f"{value:.3f}" for value in error[3:])
        if not model.load.bends:
            return values
        gravity = compensator.loading.gravity or tuple(model.load.gravity.tolist())
        return values | {
            "gravity_m_s2": ", ".join(f"{value:.3f}" for value in gravity),
            "wrench_N_Nm": ", ".join(f"{value:.2f}" for value in compensator.loading.wrench),
            "payload": str(compensator.geometry.payload),
        }


# ---- a pose instrument ----


def fusion_rules(options: dict[str, Any]) -> FusionRules:
    return FusionRules(**{one.name: options[f"fusion.{one.name}"] for one in fields(FusionRules)})


class PoseInstrument:
    """Receives the instrument's readings in a configured node; made only with ``fusion.enabled``."""

    def __init__(self, node: CompensatorState) -> None:
        self._node, self._kind = node, POSE_MESSAGES[node.options["fusion.message"]]
        geometry = node.compensator.geometry
        self._frames = {node.ids[name]: pose for name, pose in geometry.work_frames.items()}
        SensorTopic(node, POSE_TOPIC, self._kind, self._on_reading, self._reject)
        self.fusion, self._fed = Fusion(node.compensator, fusion_rules(node.options)), -math.inf

    def follow(self) -> None:
        """Apply the present parameters, from the next reading on."""
        self.fusion.rules = self.fusion.filter.rules = fusion_rules(self._node.options)

    def reset(self) -> None:
        """Forget the drift; its correction ramps out."""
        self.fusion.reset()
        self._node.pose_stamps.reset()
        self._fed = -math.inf
        self.update(time.monotonic())

    def update(self, now: float) -> None:
        if now - self._fed < FEED_PERIOD:
            return
        self._fed, self._node.drift_problem = now, ""
        try:
            self.fusion.feed(bool(self._node.options["fusion.compensate"]))
        except HexapodError as error:
            self._node.drift_problem = f"drift not compensated: {error.reason}: {error}"
            self._node.log_warning("drift", self._node.drift_problem)

    def add_struts(self, struts: Sequence[float], made: float) -> None:
        """Store struts, m, of a monotonic time, s, for the readings about them."""
        for error in self.fusion.add_struts(struts, made):
            self._reject(error)

    def weighed(self, pose: np.ndarray) -> np.ndarray:
        """Return the compensator's estimate, weighed with the readings."""
        return self.fusion.weighed(pose)

    def values(self, now: float) -> dict[str, str]:
        """Return the filter's state, as key and value of diagnostics."""
        node, fusion = self._node, self.fusion

        def micro(values: np.ndarray) -> str:
            return ", ".join(f"{1e6 * value:.2f}" for value in values)

        return {
            "fusion": "compensating" if node.options["fusion.compensate"] else "estimating",
            "measured_poses": str(fusion.count),
            "measured_pose_age_s": seconds(now - fusion.last),
            "rejected_poses": str(node.bad_poses.total),
            "last_rejected_pose": node.bad_poses.last_text,
            "innovation_chi_square": f"{fusion.filter.chi_square:.2f}",
            "drift_um": micro(fusion.drift[:3]),
            "drift_turn_urad": micro(fusion.turn),
            "drift_struts_um": micro(fusion.drift[6:]),
            "drift_deviation_um": micro(np.sqrt(np.diagonal(fusion.filter.covariance))),
            "drift_compensated_um": micro(node.compensator.drift),
        }

    def _on_reading(self, message: Any, now: float) -> None:
        sample, gate = Sample(now, command_stamp(message.header.stamp)), self._node.pose_stamps
        check_frame(frame_id := message.header.frame_id, self._frames)
        gate.check(sample)
        stated = [0.0] * 36
        if self._kind is PoseWithCovarianceStamped:
            stated, message = message.pose.covariance, message.pose
        pose, frame = message_pose(message), self._frames[frame_id]
        turn = np.kron(np.eye(2), frame.rotation)
        covariance = turn @ checked_covariance(stated, self.fusion.rules) @ turn.T
        gate.accept(sample)
        if self._node.active:
            for error in self.fusion.add(PoseReading(frame @ pose, now - sample.age, covariance)):
                self._reject(error)

    def _reject(self, error: HexapodError) -> None:
        self._node.ignore(POSE_TOPIC, error, self._node.bad_poses)
