"""Services and on-demand topics of a compensator: reset, on/off, change of model or tool, travel, predicted error."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from ..compensation.guards import Sample
from ..compensation.journal import IDEAL_SOURCE
from ..errors import CommandError, HexapodError
from ..machine.geometry import WORK, pose_text
from ..machine.model import MachineModel
from ..pose import Pose
from .base import CHECK_PERIOD, ERROR, EVENT_QOS, LATCHED_QOS, OK
from .compensator_state import CompensatorState
from .messages import read_message, stamp_of
from .parameters import ParameterError
from .rclpy_compat import LateAnswer
from .worker import Worker, WorkerError

LOADED_WITHIN = 30.0  # Longest time for reading a model file, s; usually 1 s, of which imports take most

PREDICTION_PERIOD = 0.2  # Period of ~/predicted_error, s
TRY_AGAIN_AFTER = 10.0  # Time from a failed prediction to the next, s

TRAVEL_PERIOD = 1.0  # Period of ~/travel, s
LONGEST_REASON = 200  # Longest text about the limit that ends the travel in one direction, characters


class Requests:
    """The services of a configured compensator, and the topics whose messages its worker process computes."""

    def __init__(self, node: CompensatorState, forget_commands: Callable[[], None]) -> None:
        self._node, self._forget_commands = node, forget_commands
        self._worker = Worker()
        node.create_logged_service(SetBool, "~/enable_compensation", self._on_enable)
        node.create_logged_service(Trigger, "~/reset", self._on_reset)
        self._reload = LateAnswer(node.create_logged_service(Trigger, "~/reload_model", self._on_reload))
        self.tools = ToolChoice(node)
        self._travel = TravelReports(node, self._worker)
        self._predicted = PredictedError(node, self._worker)

    def update(self, now: float) -> None:
        self._worker.poll(now)
        self._travel.update(now)
        self._predicted.update(now)

    def close(self) -> None:
        self._reload.answer(Trigger.Response(message="the old model stays: the node was cleaned up"))
        self._travel.close()
        self._worker.close()

    def _on_enable(self, request: SetBool.Request, _: SetBool.Response) -> SetBool.Response:
        self._node.compensator.enable(request.data)
        return SetBool.Response(success=True, message=f"compensation ramps {'in' if request.data else 'out'}")

    def _on_reset(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response:
        """Forget the last command and the following error, unless the machine moves."""
        node, now = self._node, time.monotonic()
        if moving := node.track.moving(now):
            refusal = f"refused while the machine moves: {moving}"
            node.refused_resets.add("moving", refusal, now)
            node.log_warning("reset", f"reset {refusal}")
            return Trigger.Response(message=refusal)
        self._forget_commands()
        node.track.release()
        known = "the next command may be up to one allowed step from the struts' last known positions"
        return Trigger.Response(success=True, message=known)

    # ---- the model ----

    def _on_reload(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response | None:
        if self._worker.busy("load_model"):
            return Trigger.Response(message="refused: a model is already being loaded")
        machine, files = self._node.compensator.geometry.name, self._node.files
        if files.ideal:
            return self._use_model((MachineModel(machine), IDEAL_SOURCE))
        name, place, folder = files.model_place()
        self._worker.ask(
            "load_model",
            {"name": name, "place": place, "folder": folder, "machine": machine},
            lambda found: self._reload.answer(self._use_model(found)),
            lambda error: self._reload.answer(self._keep_model(error)),
            within=LOADED_WITHIN,
            late=f"{name}: could not be read within {LOADED_WITHIN:g} s; check its disk or network",
        )
        return None

    def _use_model(self, found: tuple[MachineModel, Any]) -> Trigger.Response:
        sources = self._node.files.sources
        before = sources["model"]
        model, sources["model"] = found  # before set_model, since the journal records the source with the change
        try:
            self._node.compensator.set_model(model)
        except HexapodError as error:
            sources["model"] = before
            return self._keep_model(error)
        how = "ramps in" if self._node.compensator.enabled else "is loaded; the compensation is off"
        return Trigger.Response(success=True, message=f"model {model.name!r} {how}")

    def _keep_model(self, error: HexapodError) -> Trigger.Response:
        self._node.failed_reloads.add(error.reason, str(error), time.monotonic())
        self._node.get_logger().warning(f"the old model stays: {error}")
        return Trigger.Response(message=f"the old model stays: {error}")


class ToolChoice:
    """Changes the tool at standstill, when the parameter ``tool`` is set or a message on ``select_tool`` sets it."""

    def __init__(self, node: CompensatorState) -> None:
        self._node, self._compensator = node, node.compensator
        several = bool(node.options["allow_several_publishers"])
        self._sender = node.subscribe_exclusive(String, "select_tool", self._on_message, several)
        node.sensor_senders["select_tool"] = self._sender
        self._publisher = node.create_publisher(String, "~/tool", LATCHED_QOS)
        self._publish()

    def check(self, name: str) -> None:
        """Raise a ParameterError for an unknown tool, or for another tool while the machine moves."""
        geometry = self._compensator.geometry
        try:
            geometry.using(tool=name)
        except HexapodError as error:
            raise ParameterError(f"parameter tool: {error}") from error
        moving = self._node.track.moving(time.monotonic())
        if moving and name != geometry.tool_name:
            raise ParameterError(f"parameter tool: stays {geometry.tool_name!r} while the machine moves: {moving}")

    def apply(self) -> None:
        if (name := self._node.options["tool"]) != self._compensator.geometry.tool_name:
            self._compensator.set_tool(name)
            self._node.log_action("tool", f"tool {name!r}: the next command must be at the struts' present position")
            self._publish()

    def _on_message(self, data: bytes, sample: Sample) -> None:
        """Set the parameter `tool`. A controller whose tool was refused may still send commands for this tool; the next
        command is therefore accepted only at the struts' present position."""
        node, now = self._node, sample.now
        node.update_publishers()
        try:
            self._sender.check(sample)
            name = read_message(data, String).data
            result = node.set_parameters([Parameter("tool", value=name)])[0]
            if not result.successful:
                if set(self._sender.names) <= set(node.command_sender.names) and not node.track.moving(now):
                    self._compensator.set_tool(self._compensator.geometry.tool_name)
                raise CommandError("tool", result.reason)
        except CommandError as error:
            node.refused_tools.add(error.reason, str(error), now)
            node.log_warning("tool", f"select_tool refused: {error}")

    def _publish(self) -> None:
        self._publisher.publish(String(data=self._compensator.geometry.tool_name))


def situation(node: CompensatorState) -> dict[str, Any]:
    """Return the present tool, temperatures, load and external quantities as arguments for the worker."""
    compensator = node.compensator
    present = compensator.geometry.tool_name, compensator.temperatures, compensator.loading, dict(compensator.outside)
    return {"now": present}


class TravelReports:
    """Topic ``~/travel`` and service ``~/get_travel``: how far the tool can move from the last commanded pose or,
    before the first command, from the last measured pose."""

    def __init__(self, node: CompensatorState, worker: Worker) -> None:
        self._node, self._worker = node, worker
        self._publisher = node.create_publisher(DiagnosticStatus, "~/travel", EVENT_QOS)
        self._late = LateAnswer(node.create_service(Trigger, "~/get_travel", self._on_request))
        self._asked, self._due = False, 0.0

    def close(self) -> None:
        self._late.answer(Trigger.Response(message="the node was cleaned up"))

    def update(self, now: float) -> None:
        if now >= self._due and not self._worker.busy("travel") and self._publisher.get_subscription_count():
            self._due = now + TRAVEL_PERIOD
            try:
                self._begin()
            except CommandError as error:
                self._report(ERROR, str(error))

    def _on_request(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response | None:
        if self._asked:
            raise CommandError("busy", "the travel is already being computed")
        if not self._worker.busy("travel"):
            self._begin()
        self._asked = True
        return None

    def _begin(self) -> None:
        node, compensator = self._node, self._node.compensator
        names = {frame_id: name for name, frame_id in node.frame_ids.items()}
        work = names.get(node.frame_id, WORK)  # frame_id is empty before the first command
        if np.isfinite(compensator.nominal).all():
            platform = compensator.platform
        elif node.feedback.count:
            platform = Pose(*compensator.platform_estimate)
        else:
            raise CommandError("no_feedback", "no command and no strut_states yet: the tool's pose is not known")
        geometry = compensator.geometry.using(work=work)
        pose = geometry.tool_pose(platform)
        where = f"tool {geometry.tool_name} in {node.frame_ids[work]} at {pose_text(pose)}"
        self._worker.ask(
            "travel",
            {"pose": pose, "work": work, "enabled": compensator.enabled, **situation(node)},
            lambda found: self._report(OK, where, *found),
            lambda error: self._report(ERROR, f"{where}: {error}"),
            node.files.worker_machine(),
        )

    def _report(self, level: bytes, text: str, table: str = "", values: dict[str, str] | None = None) -> None:
        self._asked = False
        self._late.answer(Trigger.Response(success=level == OK, message="\n".join(filter(None, (text, table)))))
        if self._publisher.get_subscription_count():
            self._publisher.publish(self._node.report("travel", level, text, values or {}, LONGEST_REASON))


class PredictedError:
    """Topics ``~/predicted_error`` and ``~/predicted_error_aligned``: the tool error that the newest command would have
    without compensation, as the model predicts it, with its covariance. Without subscribers it is not computed."""

    def __init__(self, node: CompensatorState, worker: Worker) -> None:
        self._node, self._worker = node, worker
        self._topics = {
            "absolute": node.create_publisher(PoseWithCovarianceStamped, "~/predicted_error", EVENT_QOS),
            "aligned": node.create_publisher(PoseWithCovarianceStamped, "~/predicted_error_aligned", EVENT_QOS),
        }
        self._asked_for, self._due = 0, 0.0
        self._source: Any = None

    def update(self, now: float) -> None:
        node, compensator, source = self._node, self._node.compensator, self._node.files.sources["model"]
        wanted = any(publisher.get_subscription_count() for publisher in self._topics.values())
        if not wanted or self._source is not source:
            self._source, node.prediction_problem, self._due = source, "", min(self._due, now)
        if not wanted or now < self._due or self._worker.busy("predict") or not np.isfinite(compensator.nominal).all():
            return
        # Checked every CHECK_PERIOD: half of it early, so that rounding does not delay the next one by a whole check
        self._asked_for, self._due = node.last_answered, now + PREDICTION_PERIOD - 0.5 * CHECK_PERIOD
        asked = {"platform": compensator.platform, "sense": compensator.motion.sense.copy(), **situation(node)}
        self._worker.ask("predict", asked, self._publish, self._failed, node.files.worker_machine())

    def _publish(self, result: dict[str, Any]) -> None:
        """Publish the predicted errors, except for a pose that the real machine cannot reach."""
        self._node.prediction_problem = ""
        for name, publisher in self._topics.items():
            if (error := result[name]) is not None and np.isfinite(error[0]).all():
                publisher.publish(error_message(error[0], error[1], self._node.frame_ids[WORK], self._asked_for))

    def _failed(self, error: WorkerError) -> None:
        self._due = time.monotonic() + TRY_AGAIN_AFTER
        problem = self._node.prediction_problem = f"no predicted error: {error}"
        self._node.log_warning("predicted error", f"{problem}; tried again in {TRY_AGAIN_AFTER:g} s")


def error_message(
    values: Sequence[float] | np.ndarray, covariance: np.ndarray | None, frame: str, stamp: int
) -> PoseWithCovarianceStamped:
    """Return a message with a tool error and its covariance; `values` are a displacement, m, and a rotation, rad."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = frame, stamp_of(stamp)
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = map(float, values[:3])
    half = 0.5 * math.hypot(*values[3:])
    share = 0.5 * float(np.sinc(half / math.pi))  # sin(half) / (2 · half)
    orientation.x, orientation.y, orientation.z = (share * float(turn) for turn in values[3:])
    orientation.w = math.cos(half)
    message.pose.covariance = [math.nan] * 36 if covariance is None else np.ravel(covariance).tolist()
    return message
