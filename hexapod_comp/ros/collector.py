"""Clients with which :func:`~hexapod_comp.measurements.collect.collect` and ``adapt`` measure a running machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, Vector3Stamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.duration import Duration
from sensor_msgs.msg import JointState, RelativeHumidity, Temperature
from std_srvs.srv import Trigger

from ..compensation.thermal import TemperatureFilter
from ..errors import CommandError, HexapodError, NoAnswerError, shorten
from ..formats.paths import folder_of
from ..machine.geometry import TOOL
from ..machine.temperatures import HUMIDITY, PARTS, Temperatures, check_part
from ..measurements.collect import Observation, RunSetUp
from ..measurements.readings import ABSOLUTE_KINDS, LEAST_NOISE, MEDIAN_TO_SIGMA, of_median
from ..measurements.set_up import KNOWN
from ..pose import Pose, middle_pose
from .base import LATCHED_QOS, NEWEST_QOS, SENSOR_QOS
from .client import FOUND_WITHIN, READY_WITHIN, Machine, MoveError, MoveState
from .instrument import SET_UP_TOPIC
from .messages import (
    StrutReader,
    check_frame,
    message_pose,
    nanoseconds_of,
    pose_message,
    pose_numbers,
    read_gravity,
    stamp_of,
)

REPEATS = 2  # Largest number of repetitions of a move after a refused command or a restart of the mover
LEAST_SAMPLES = 3  # Least number of readings in a median
PATIENCE = 2.0  # If fewer than half of a stop's readings arrive within this time, s, the beam counts as broken
ANSWERED_WITHIN = 60.0  # Longest wait for a service's answer, s; the compensator gives up loading a model after 30 s
SET_UP_WITHIN = Duration(seconds=2)  # Longest wait until the instrument has received a run's set-up


class WatchedMachine(Machine):
    """Client of a machine with a mover, a tracker on `topic`, and perhaps a laser or ball bar on topic `readings`.

    The tracker's poses are in ``base``, or in an unknown frame if `tracker_frame` is ``free``. NaN in a reading means
    that the beam is broken and the instrument has lost its zero. The given function `confirm` must not return before
    the run's instrument is set up.
    """

    def __init__(
        self,
        topic: str,
        namespace: str = "",
        samples: int = 25,
        readings: str = "",
        tracker_frame: str = KNOWN,
        confirm: Callable[[RunSetUp], object] = lambda run: None,
    ) -> None:
        self._samples, self._problem = samples, ""
        self._confirm = confirm
        self._poses, self._struts, self._reader = list[tuple[Pose, float]](), list[np.ndarray](), StrutReader()
        self._read, self._zero_lost = list[tuple[list[float], float]](), False
        # stamp, ns, of the compensator's newest estimate; stamp, ns, of its newest estimate at the start of `observe`;
        # delay, s, of the newest reading that was taken before this start
        self._estimated, self._since, self._lag = 0, 0, 0.0
        # channels of the present run that come from `readings`, and whether the run also needs poses
        self._own, self._wants_pose = tuple[str, ...](), True
        self._sensed, self._filter = Temperatures(), TemperatureFilter()
        self._gravity: tuple[float, ...] | None = None
        super().__init__(namespace)
        self._base = self.frame_id("base")
        self._frame_id = self._base if tracker_frame == KNOWN else ""  # of the tracker's poses; "": not yet known
        node = self.node
        node.create_subscription(PoseStamped, topic, self._on_pose, SENSOR_QOS)
        node.create_subscription(PoseStamped, "tool_pose_estimate", self._on_estimate, NEWEST_QOS)
        node.create_subscription(JointState, "strut_states", self._on_struts, NEWEST_QOS)
        node.create_subscription(Temperature, "temperatures", self._on_temperature, SENSOR_QOS)
        node.create_subscription(RelativeHumidity, HUMIDITY, self._on_humidity, SENSOR_QOS)
        node.create_subscription(Vector3Stamped, "gravity", self._on_gravity, SENSOR_QOS)
        self._topic, self._readings = node.resolve_topic_name(topic), ""
        if readings:
            self._readings = node.resolve_topic_name(readings)
            node.create_subscription(JointState, readings, self._on_readings, SENSOR_QOS)
            self._set_up = node.create_publisher(PoseStamped, SET_UP_TOPIC, LATCHED_QOS)

    # ---- received messages ----

    def _on_pose(self, message: PoseStamped) -> None:
        self._frame_id = self._frame_id or message.header.frame_id
        try:
            check_frame(message.header.frame_id, [self._frame_id])
            if not all(map(math.isfinite, pose_numbers(message))):
                return  # NaN: the tracker's beam is broken
            if (time := self._time_of(message)) is not None:
                self._poses.append((message_pose(message), time))
        except HexapodError as error:
            free = "; `collect --tracker-frame free` accepts any frame and writes its transformation to base"
            other_frame = self._frame_id == self._base != message.header.frame_id
            self._problem = f"{self._topic}: {error}{free if other_frame else ''}"

    def _on_readings(self, message: JointState) -> None:
        values = dict(zip(message.name, message.position, strict=False))
        if missing := [channel for channel in self._own if channel not in values]:
            self._problem = f"{self._readings}: channel {missing[0]} is not in {shorten(', '.join(message.name))}"
            return
        read = [values[channel] for channel in self._own]
        if all(map(math.isfinite, read)):
            if (time := self._time_of(message)) is not None:
                self._read.append((read, time))
        else:
            self._zero_lost = True
            self._read.clear()

    def _time_of(self, message: PoseStamped | JointState) -> float | None:
        """Return a reading's time, s (stamp 0: that of the newest estimate); None: before :meth:`observe` began."""
        stamp = nanoseconds_of(message.header.stamp) or self._estimated
        if stamp >= self._since:
            return stamp * 1e-9
        self._lag = (self._estimated - stamp) * 1e-9
        return None

    def _on_estimate(self, message: PoseStamped) -> None:
        self._estimated = nanoseconds_of(message.header.stamp)

    def _on_struts(self, message: JointState) -> None:
        with suppress(CommandError):  # ignore NaN of a lost encoder
            self._struts.append(self._reader.read(message))

    def _on_temperature(self, message: Temperature) -> None:
        with suppress(HexapodError):  # ignore an unknown part and an implausible temperature
            check_part(message.header.frame_id)
            self._sense(message.header.frame_id, message.temperature)

    def _on_humidity(self, message: RelativeHumidity) -> None:
        with suppress(HexapodError):  # ignore a humidity in percent
            self._sense(HUMIDITY, message.relative_humidity)

    def _sense(self, name: str, value: float) -> None:
        self._sensed.set(name, self._filter.update(name, value, time.monotonic()))

    def _on_gravity(self, message: Vector3Stamped) -> None:
        with suppress(HexapodError):  # ignore gravity in another frame, or not of Earth's magnitude
            self._gravity = read_gravity(message, self._base)

    # ---- called by collect ----

    def move(self, pose: Pose, *arguments: Any, **options: Any) -> MoveState:
        """Move as :meth:`.Machine.move` does; repeat the move after a refused command or a restart of the mover.

        Raise a CommandError if the tool in use before or after the move is not the geometry file's `tool`: the poses of
        a campaign are poses of this tool.
        """
        for _ in range(REPEATS):
            try:
                return self._move_tool(pose, *arguments, **options)
            except MoveError as error:
                if error.reason not in ("refusal", "restarted"):
                    raise
                self._spin(1.0)
                try:
                    self.wait(lambda: self.last.ready, READY_WITHIN, "the mover")
                except NoAnswerError:
                    raise error from None
        return self._move_tool(pose, *arguments, **options)

    def _move_tool(self, *arguments: Any, **options: Any) -> MoveState:
        self._refuse_other_tool()
        state = super().move(*arguments, **options)
        self._refuse_other_tool()
        return state

    def _refuse_other_tool(self) -> None:
        if (tool := self.last.tool) != TOOL:
            advice = f"select {TOOL!r} (ros2 param set /compensator tool {TOOL}), then repeat the command"
            raise CommandError("tool", f"the tool in use is {tool!r}, but the readings are of {TOOL!r}: {advice}")

    def set_up(self, run: RunSetUp) -> Collection[str]:
        """Publish the run's line or centre, call `confirm`, and return the run's channels that `readings` contains."""
        self._own = () if not self._readings else tuple(
            channel for channel in run.channels if channel.partition("_")[0] not in ABSOLUTE_KINDS
        )  # fmt: skip
        self._wants_pose = len(self._own) < len(run.channels)
        if self._own:
            message = pose_message(run.place, self._base)
            message.header.stamp = stamp_of(self.node.get_clock().now().nanoseconds)
            self._set_up.publish(message)
            self._set_up.wait_for_all_acked(SET_UP_WITHIN)
            self._confirm(run)
            self._spin(0.1)  # until the last readings of the previous run have arrived
        self._zero_lost = False
        return self._own

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.spin_once(0.02)

    def observe(self) -> Observation | None:
        """Return medians of the next `samples` readings, or None (broken beam) if fewer than half arrive in time."""
        wanted = [self._topic] * self._wants_pose + [self._readings] * bool(self._own)
        self.wait_until_alone(*wanted)
        for received in (self._poses, self._struts, self._read):
            received.clear()
        self._problem, self._since, self._lag = "", self._estimated, 0.0
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and not self._problem:
            self.spin_once(0.02)
            if self._enough(self._samples):
                break
        if self._problem:
            raise CommandError("instrument", self._problem)
        if not self._enough(max(LEAST_SAMPLES, self._samples // 2)):
            if self._lag > PATIENCE:
                clocks = "does the instrument repeat an old reading, or does its clock differ from the compensator's?"
                raise CommandError("instrument", f"{' or '.join(wanted)} is stamped {self._lag:.3g} s late: {clocks}")
            if silent := [topic for topic in wanted if self.node.count_publishers(topic) == 0]:
                raise NoAnswerError(f"no node publishes {silent[0]}")
            return None
        pose, uncertainty, channels = None, np.full(6, math.nan), {}
        if self._wants_pose:
            pose, off = middle_pose([pose for pose, _ in self._poses])
            uncertainty = _median(off)[1]
        if self._own:
            middle, deviation = _median(np.array([read for read, _ in self._read]))
            channels = dict(zip(self._own, zip(middle.tolist(), deviation.tolist(), strict=True), strict=True))
        lost, self._zero_lost, sensed = self._zero_lost, False, self._sensed
        return Observation(
            pose,
            uncertainty,
            # as of the pose the median, so that both are of one time if the correction ramps meanwhile
            tuple(np.median(self._struts, axis=0).tolist()) if self._struts else None,
            tuple(map(sensed.at, PARTS)) if sensed.values.keys() & set(PARTS) else None,
            (self._read if self._own else self._poses)[-1][1],
            channels,
            lost,
            self._gravity,
            sensed.values.get(HUMIDITY, math.nan),
        )

    def _enough(self, count: int) -> bool:
        return (not self._wants_pose or len(self._poses) >= count) and (not self._own or len(self._read) >= count)


class AdaptedMachine(WatchedMachine):
    """Client, for ``adapt``, of a machine with mover, compensator and tracker; brakes once `going_on()` is false."""

    def __init__(
        self,
        topic: str,
        namespace: str = "",
        samples: int = 25,
        going_on: Callable[[], bool] = lambda: True,
    ) -> None:
        super().__init__(topic, namespace, samples)
        self._going_on = going_on
        self._arrived: MoveState | None = None  # state at the arrival of the newest move
        self._targets = list[tuple[Pose, tuple[Any, ...], dict[str, Any]]]()  # arguments of the newest two moves
        services = (Trigger, "reload_model"), (SetParameters, "set_parameters"), (GetParameters, "get_parameters")
        self._reload_model, self._set, self._get = (
            self.node.create_client(kind, f"compensator/{name}") for kind, name in services
        )

    def move(self, pose: Pose, *arguments: Any, **options: Any) -> MoveState:
        """Move as a WatchedMachine does. If another client moves the tool meanwhile, wait until the tool is at rest,
        then move to the previous target and again to `pose`: backlash depends on the direction of a strut's arrival.
        """
        self._targets = [*self._targets[-1:], (pose, arguments, options)]
        try:
            return self._travel(self._targets[-1:])
        except HexapodError:
            self._targets.pop()
            raise

    def _travel(self, left: list[tuple[Pose, tuple[Any, ...], dict[str, Any]]]) -> MoveState:
        """Move to the targets in `left`, one by one; if another client moves the tool, repeat the last two targets."""
        braked = 0  # stamp, ns, of the request that was braked; a repeated move has another stamp

        def watch(state: MoveState) -> None:
            nonlocal braked
            if state.request != braked and not self._going_on():
                braked = state.request
                self._stop.call_async(Trigger.Request())

        while True:
            pose, arguments, options = left[0]
            try:
                self._arrived = super().move(pose, *arguments, **{"progress": watch, **options})
            except MoveError as error:
                if error.reason != "replaced":
                    raise
                self._wait_for_others()
                left = self._targets
            else:
                left = left[1:]
                if not left:
                    return self._arrived

    def _wait_for_others(self) -> None:
        restarted = self._arrived is not None and self.last.moves < self._arrived.moves
        what = "the mover was restarted" if restarted else "another client moves the tool"
        self.node.get_logger().warning(f"{what}: waiting until the tool is at rest")
        while not self.last.at_rest:
            if not self._going_on():
                raise MoveError("person", "stopped while another client moved the tool")
            self.spin_once(0.02)

    def observe(self) -> Observation | None:
        """Observe as a WatchedMachine does; if another client moves the tool meanwhile, move back and observe again."""
        while True:
            observation = super().observe()
            if self._arrived is None or self.last.request == self._arrived.request:
                return observation
            self._wait_for_others()
            self._travel(self._targets)

    def reload(self, path: Path) -> None:
        """Have the compensator load a model file; if it refuses, restore ``model_file`` and raise a CommandError."""
        (before,) = self._parameters("model_file")
        for client in (self._reload_model, self._set):
            self.wait(client.service_is_ready, FOUND_WITHIN, "the services of the compensator")
        wanted = str(path.resolve())
        self._set_model_file(wanted)
        try:
            self.call(self._reload_model, Trigger.Request(), ANSWERED_WITHIN)
        except CommandError as error:
            self._set_model_file(before)
            raise CommandError("reload", f"the compensator did not load {wanted}: {error}") from None

    def refuse_unreadable(self, path: Path) -> None:
        """Raise a CommandError if the compensator would refuse to read `path`, a model file that is to be written.

        A relative path in the compensator's ``model_folder`` or ``model_file`` cannot be checked, so `reload` may fail.
        """
        folder, model = self._parameters("model_folder", "model_file")
        name = folder or model
        own = Path(folder).expanduser() if folder else folder_of(model)
        if own is not None and (
            not Path(name).expanduser().is_absolute() or path.resolve().is_relative_to(own.resolve())
        ):
            return
        places = "shipped models" if own is None else f"models in {own}"
        advice = f"give it -p model_folder:=FOLDER, where FOLDER contains {path.resolve()} and its geometry file"
        raise CommandError("reload", f"the compensator reads only {places}: {advice}")

    def runs(self, path: Path) -> bool:
        """Return whether the compensator's parameter ``model_file`` names the file `path`."""
        return self._parameters("model_file") == [str(path.resolve())]

    def _parameters(self, *names: str) -> list[str]:
        self.wait(self._get.service_is_ready, FOUND_WITHIN, "the services of the compensator")
        answer = self.call(self._get, GetParameters.Request(names=names), ANSWERED_WITHIN)
        return [str(value.string_value) for value in answer.values]

    def _set_model_file(self, name: str) -> None:
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
        request = SetParameters.Request(parameters=[Parameter(name="model_file", value=value)])
        (result,) = self.call(self._set, request, ANSWERED_WITHIN).results
        if not result.successful:
            raise CommandError("reload", f"the compensator refused the parameter model_file: {result.reason}")


def _median(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the median of each column of `numbers` and the standard deviation of each median."""
    middle = np.median(numbers, axis=0)
    spread = MEDIAN_TO_SIGMA * np.median(np.abs(numbers - middle), axis=0)
    return middle, np.maximum(of_median(spread, len(numbers)), LEAST_NOISE)
