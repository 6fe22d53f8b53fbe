"""Topics that a compensator subscribes to: commands, loads, external quantities such as elevation, measured poses."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped, WrenchStamped
from sensor_msgs.msg import JointState

from ..compensation.compensator import Compensator
from ..compensation.fusion import Fusion, FusionRules, PoseReading, checked_covariance
from ..compensation.guards import Guard, Sample
from ..core.batch import quaternion_of
from ..errors import CommandError, HexapodError, ModelError, OutsideTableError, shorten
from ..machine.geometry import BASE
from ..machine.kinematics import Structure, forward_error, solve_poses
from ..machine.load import Loading, wrench_on_platform
from ..machine.outside import read_numbers
from ..pose import Pose
from .base import SENSOR_QOS, seconds
from .compensator_state import STRUTS, CompensatorState
from .messages import StrutReader, check_frame, command_stamp, message_pose, read_gravity, read_message, read_pose

WRENCH_PERIOD = 0.01  # Shortest time between accepted wrenches, s; a wrench starts a ramp and adds a journal entry

POSE_TOPIC = "tool_pose_measured"
POSE_MESSAGES = {"pose_with_covariance": PoseWithCovarianceStamped, "pose": PoseStamped}
FEED_PERIOD = 1.0  # Period, s, at which the slow drift is passed to the compensator, which then builds a new model

# ---- commands ----


class PoseInput:
    """Commands as tool poses on ``tool_pose_command``."""

    topic, kind = "tool_pose_command", PoseStamped

    read = staticmethod(read_pose)


class StrutInput(PoseInput):
    """Commands as nominal strut lengths, m, on ``strut_setpoints``, from a controller that plans lengths.

    A command is turned into the tool pose that a machine without errors reaches with the commanded lengths, since
    limits, journal and replay use poses only.
    """

    topic, kind = "strut_setpoints", JointState

    def __init__(self, compensator: Compensator, names: list[str], frame_id: str) -> None:
        self._compensator, self._frame_id = compensator, frame_id
        self._structure, self._reader = Structure.of(compensator.geometry), StrutReader(names)

    def read(self, data: bytes, sample: Sample) -> None:  # type: ignore[override]
        """Write a command's stamp, frame and tool pose into a sample; if all lengths are NaN, leave out the pose."""
        message = read_message(data, JointState)
        sample.stamp, sample.frame_id = command_stamp(message.header.stamp), self._frame_id
        lengths = self._reader.read_unchecked(message)
        if np.isnan(lengths).all():
            return
        self._reader.check(lengths.tolist())
        guesses = [self._compensator.geometry.home]
        if np.isfinite(self._compensator.nominal).all():  # NaN before the first command
            guesses.insert(0, self._compensator.platform)
        for guess in guesses:
            solved = solve_poses(self._structure, lengths[None], guess, threads=1)
            if solved.ok[0]:
                tool = Pose(solved.positions[0], solved.rotations[0]) @ self._compensator.geometry.tool
                sample.values = (*tool.position.tolist(), *quaternion_of(tool.rotation))
                return
        raise forward_error(int(solved.outcomes[0]), float(solved.conditions[0]), self._structure.max_condition)


def command_input(node: CompensatorState) -> PoseInput:
    if node.options["command_input"] == STRUTS:
        return StrutInput(node.compensator, node.options["joint_names"], node.options["base_frame"])
    return PoseInput()


# ---- readings ----


class SensorTopic:
    """Subscription to a sensor's topic; a second publisher or a bad reading does not stop the answers to commands.

    `handle` gets a message and its monotonic time of arrival, s, and raises a HexapodError to reject the message;
    `reject` gets this error. A message that arrives less than `period` seconds after the last accepted message waits
    for the next call of :meth:`process`: it may be the last one, if the sensor publishes only changes. A newer message
    replaces a waiting message.
    """

    def __init__(
        self,
        node: CompensatorState,
        topic: str,
        kind: type,
        handle: Callable[[Any, float], None],
        reject: Callable[[HexapodError], None] | None = None,
        period: float = 0.0,
        several: str = "allow_several_publishers",  # name of the parameter that allows more than one publisher
    ) -> None:
        self._node, self._topic, self._kind, self._period = node, topic, kind, period
        self._handle, self._reject = handle, reject or self._bad_feedback
        self.last = math.nan  # monotonic time of the last accepted message, s; NaN before the first
        self._waiting: bytes | None = None  # newest message, until it is handled
        allowed = bool(node.options["allow_several_publishers"] or node.options[several])
        self._sender = node.sensor_senders[topic] = node.subscribe_exclusive(
            kind, topic, self._receive, allowed, SENSOR_QOS
        )

    def stale(self, now: float, timeout: float) -> bool:
        """Return whether the last accepted message is older than `timeout` seconds; false if `timeout` is 0."""
        return 0.0 < timeout < now - self.last

    def _receive(self, data: bytes, sample: Sample) -> None:
        # The time of arrival counts: a sensor may send no stamps or have a wrong clock, and loads and temperatures
        # change little within the transport delay.
        try:
            self._sender.check(sample)
        except HexapodError as error:
            self._reject(error)
            return
        self._waiting = data
        if not sample.now - self.last < self._period:
            self.process(sample.now)

    def process(self, now: float) -> None:
        """Handle the message that waits, if there is one."""
        data, self._waiting = self._waiting, None
        if data is None:
            return
        try:
            self._handle(read_message(data, self._kind), now)
            self.last = now
        except HexapodError as error:
            self._reject(error)

    def _bad_feedback(self, error: HexapodError) -> None:
        what = self._topic.removesuffix("s")
        self._node.ignore(what, error, self._node.bad_feedback, "" if isinstance(error, CommandError) else what)


class Loads:
    """Gravity, wrench and external quantities, which are received and passed to the compensator."""

    def __init__(self, node: CompensatorState) -> None:
        self._node, self._compensator = node, node.compensator
        self._gravity: tuple[float, ...] | None = None  # newest published gravity, m/s²; None: not published
        self._wrench = Loading().wrench
        self._quantities: dict[str, float] = {}  # newest published external quantities, not all of them in use
        self.guard = Guard()  # refuses commands while a quantity is outside a table with the setting `refuse`
        self.guard.reason = OutsideTableError.reason
        self._topics = {
            "gravity": SensorTopic(node, "gravity", Vector3Stamped, self._on_gravity),
            "wrench": SensorTopic(node, "wrench", WrenchStamped, self._on_wrench, period=WRENCH_PERIOD),
            "outside": SensorTopic(node, "outside", JointState, self._on_quantities),
        }
        self.apply()

    def apply(self) -> None:
        """Pass gravity and wrench to the compensator, unless ``outside_hold`` is true."""
        if self._node.options["outside_hold"]:
            return
        stated = self._node.options["gravity"]
        gravity = self._gravity or (stated if any(stated) else None)
        self._compensator.set_load(Loading.of(gravity, self._wrench))

    def update(self, now: float) -> None:
        """Apply the newest wrench, and external quantities whose change moves the tool by over ``outside_dead_band``.

        The node calls `update` every 50 ms, not for each message, since the compensator makes a new model each time the
        external quantities change.
        """
        self._topics["wrench"].process(now)
        self._judge()
        compensator, options = self._compensator, self._node.options
        if options["outside_hold"] or self.guard.problem or self._quantities.items() <= compensator.outside.items():
            return
        table, known = compensator.model.outside, compensator.outside | self._quantities
        change = table.evaluate(known) - table.evaluate(compensator.outside)
        moved = np.linalg.norm(change[:3]) + np.linalg.norm(change[3:]) * compensator.geometry.characteristic_length
        if table.missing(compensator.outside) or moved > options["outside_dead_band"]:
            try:
                compensator.set_outside(self._quantities)
            except HexapodError as error:
                self._node.ignore("outside", error, self._node.bad_feedback, "outside")

    def _judge(self) -> None:
        """Refuse commands while a quantity is outside a table with ``beyond: refuse`` and ``outside_hold`` is false."""
        problem = ""
        if not self._node.options["outside_hold"]:
            try:
                self._compensator.model.outside.validate(self._compensator.outside | self._quantities)
            except OutsideTableError as error:
                problem = str(error)
            except ModelError:  # far outside the table of a new model; set_outside() reports it
                pass
        self.guard.problem = problem

    def stale(self, now: float) -> str:
        """Return a text with the topics whose last message is older than ``outside_timeout``."""
        timeout = self._node.options["outside_timeout"]
        return ", ".join(name for name, topic in self._topics.items() if topic.stale(now, timeout))

    def _on_gravity(self, message: Vector3Stamped, _: float) -> None:
        vector = read_gravity(message, self._node.frame_ids[BASE])
        moved = np.inf if self._gravity is None else math.dist(vector, self._gravity)
        if moved > self._node.options["gravity_dead_band"]:
            self._gravity = vector
            self.apply()

    def _on_wrench(self, message: WrenchStamped, _: float) -> None:
        parts = message.wrench.force, message.wrench.torque
        force, torque = (np.array([part.x, part.y, part.z]) for part in parts)
        self._wrench = wrench_on_platform(self._compensator.geometry, message.header.frame_id, force, torque)
        self.apply()

    def _on_quantities(self, message: JointState, _: float) -> None:
        table = self._compensator.model.outside
        if len(message.name) != len(message.position):
            problem = f"the message has {len(message.name)} names, but {len(message.position)} positions"
            raise CommandError("outside", f"outside: {problem}")
        if twice := [name for name in table.names if message.name.count(name) > 1]:
            raise CommandError("outside", f"outside: the message has {' and '.join(twice)} more than once")
        values = dict(zip(message.name, message.position, strict=True))
        numbers = read_numbers({name: values[name] for name in values if name in table.names})
        if table.names and not numbers:
            found = shorten(", ".join(message.name))
            raise CommandError("outside", f"outside: the message must name {' or '.join(table.names)}, not {found}")
        with suppress(OutsideTableError):
            table.validate(numbers)
        self._quantities |= numbers
        self._judge()

    def findings(self) -> Iterator[str]:
        table, numbers = self._compensator.model.outside, self._compensator.outside
        if missing := table.missing(numbers):
            yield f"the model's table is not applied: {missing} not received"
        elif held := table.held(numbers):
            yield f"running, outside the model's table: {held}; the value at the table's boundary is used"

    def values(self) -> dict[str, str]:
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
    """Subscription to the tool poses that an instrument measures, for the fusion filter."""

    def __init__(self, node: CompensatorState) -> None:
        self._node, self._kind = node, POSE_MESSAGES[node.options["fusion.message"]]
        geometry = node.compensator.geometry
        self._frames = {node.frame_ids[name]: pose for name, pose in geometry.work_frames.items()}
        SensorTopic(node, POSE_TOPIC, self._kind, self._on_reading, self._reject)
        self.fusion, self._fed = Fusion(node.compensator, fusion_rules(node.options)), -math.inf

    def apply_parameters(self) -> None:
        self.fusion.rules = self.fusion.filter.rules = fusion_rules(self._node.options)

    def reset(self) -> None:
        """Forget the estimated drift; the correction of the drift ramps out."""
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
        """Store the strut lengths, m, at the monotonic time `made`, s, to compare them with the instrument's poses."""
        for error in self.fusion.add_struts(struts, made):
            self._reject(error)

    def values(self, now: float) -> dict[str, str]:
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
