"""The machine of the fault campaign: compensator and drive as processes, and a harness around both.

The harness contains the controller, the record and three wires: for pose commands to the compensator, for strut
commands to the drive, and for measured struts to the compensator.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from hexapod_comp.formats.paths import config_file
from hexapod_comp.loop.processes import NodeProcess, PrivateDomain
from hexapod_comp.machine.geometry import load_geometry
from hexapod_comp.pose import Pose
from hexapod_comp.ros.base import COMMAND_QOS, NEWEST_QOS, STATE_QOS
from hexapod_comp.ros.client import LISTENER_QOS, TRACK_QOS
from hexapod_comp.ros.messages import message_pose, nanoseconds_of, pose_message

from .controller import Controller, Mode, MoverController
from .record import Record, Sent, Status, Struts, lengths_of
from .wire import Wire

GEOMETRY, MODEL = "paper.yaml", "paper_machine.yaml"
STARTS_WITHIN = 60.0  # longest wait for a process to be ready, s
MODULES = {"compensator": "compensator", "drive": "strut_drive", "mover": "mover"}
# Topics of drive and mover are renamed; the harness carries messages between them and the compensator's topics
REMAPS = {
    "compensator": {},
    "drive": {"strut_commands": "strut_commands_delivered", "strut_states": "strut_states_measured"},
    "mover": {"tool_pose_command": "tool_pose_sent"},
}


class LogDisk:
    """A folder for ``ROS_LOG_DIR`` on its own file system of 1 MB, to be filled (if mounting is permitted)."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", "size=1m", "hexapod_comp_faults", str(folder)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            self.why_not = "" if done.returncode == 0 else done.stderr.strip() or "not permitted"
        except OSError as error:
            self.why_not = str(error)

    def fill(self) -> None:
        assert not self.why_not
        with (self.folder / "filler").open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(b"\0" * 4096)

    def clear(self) -> None:
        (self.folder / "filler").unlink(missing_ok=True)

    def close(self) -> None:
        if not self.why_not:
            subprocess.run(["umount", "--lazy", str(self.folder)], capture_output=True, check=False)


def refusal_to_mount() -> str:
    """Return why no small file system can be mounted here; "" if one can."""
    with tempfile.TemporaryDirectory() as folder:
        disk = LogDisk(Path(folder) / "try")
        disk.close()
        return disk.why_not


class Rig:
    """Processes, wires, controller and record, by default in a private ROS `domain`.

    `host` has the words that run a command on another host; then the drive runs there, and compensator and drive
    exchange messages without wires. With `mover` the mover node commands the poses, otherwise the harness.
    """

    def __init__(self, seed: int = 0, domain: bool = True, host: list[str] | None = None, mover: bool = False) -> None:
        self.record = Record()
        self.geometry = load_geometry(config_file(GEOMETRY))
        self._seed, self._host, self.has_mover = seed, host, mover
        self._domain = PrivateDomain() if domain else None
        self.processes: dict[str, NodeProcess] = {}
        self._down_since: dict[str, float] = {}
        self._starting: dict[str, float] = {}
        self._reported_before: dict[str, set[tuple[int, ...]]] = {}
        self.wires: dict[str, Wire] = {}
        self._estimate: PoseStamped | None = None
        self._resetting: Iterator[None] = iter(())

    # ---- start and end ----

    def __enter__(self) -> Rig:
        self.folder = Path(tempfile.mkdtemp(prefix="hexapod_comp_faults_"))
        self.model = Path(shutil.copy(config_file(MODEL), self.folder / "model.yaml"))
        self._geometry_file = shutil.copy(config_file(GEOMETRY), self.folder / "geometry.yaml")
        self.log_disk = LogDisk(self.folder / "ros_log")
        if self._domain is not None:
            self._domain.__enter__()
        self._log_folder_before = os.environ.get("ROS_LOG_DIR")
        os.environ["ROS_LOG_DIR"] = str(self.log_disk.folder)
        try:
            self._open()
            self.start_all()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        for process in self.processes.values():
            process.send(signal.SIGCONT) if process.exit_code() is None else None
            process.stop()
        if hasattr(self, "_executor"):
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self._context)
        os.environ.pop("ROS_LOG_DIR")
        if self._log_folder_before is not None:
            os.environ["ROS_LOG_DIR"] = self._log_folder_before
        if self._domain is not None:
            self._domain.__exit__(None, None, None)
        self.log_disk.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _open(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = node = rclpy.create_node("controller", context=self._context)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(node)
        poses = node.create_publisher(PoseStamped, "tool_pose_command", COMMAND_QOS)
        node.create_subscription(JointState, "strut_commands", dated(self._on_commands), LISTENER_QOS)
        node.create_subscription(JointState, "strut_corrections", self._on_corrections, LISTENER_QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, LISTENER_QOS)
        node.create_subscription(PoseStamped, "tool_pose_estimate", lambda m: setattr(self, "_estimate", m), NEWEST_QOS)
        self.wires["pose"] = Wire(lambda message, now: self._deliver("pose", poses, message, now))
        if self._host is None:
            self._open_wires(node)
        else:
            watched = lambda m: self._deliver("feedback", None, m, time.monotonic())  # noqa: E731
            node.create_subscription(JointState, "strut_states", watched, TRACK_QOS)
        self._set_parameters = node.create_client(SetParameters, "strut_drive/set_parameters")
        self._set_clock = node.create_client(SetParameters, "compensator/set_parameters")
        self._reload = node.create_client(Trigger, "compensator/reload_model")
        self._reset = node.create_client(Trigger, "compensator/reset")
        self.controller: Controller | MoverController
        if self.has_mover:
            self.controller = MoverController(self.geometry, node, self._ask_for_reset)
            node.create_subscription(PoseStamped, REMAPS["mover"]["tool_pose_command"], self._pass_on, COMMAND_QOS)
        else:
            self.controller = Controller(self.geometry, self._send, self._ask_for_reset)

    def _open_wires(self, node: Any) -> None:
        commands = node.create_publisher(JointState, "strut_commands_delivered", COMMAND_QOS)
        states = node.create_publisher(JointState, "strut_states", STATE_QOS)
        self.wires["command"] = Wire(lambda message, now: self._deliver("command", commands, message, now))
        self.wires["feedback"] = Wire(lambda message, now: self._deliver("feedback", states, message, now))
        node.create_subscription(
            JointState, "strut_states_measured", lambda m: self.wires["feedback"].put(m, time.monotonic()), TRACK_QOS
        )

    def start(self, name: str) -> None:
        """Start a process, if necessary in place of a dead one.

        The process is ready when its output contains "ready" and its reports can be received here.
        """
        if name in self.processes:
            self.processes[name].stop()
        parameters: dict[str, object] = {} if name == "mover" else {"geometry_file": str(self._geometry_file)}
        if name == "compensator":
            parameters.update({"model_file": str(self.model), "model_folder": str(self.folder), "marker_rate": 0.0})
        elif name == "drive":
            parameters.update({"truth_file": str(config_file(MODEL).resolve()), "noise_seed": self._seed})
        remaps = REMAPS[name] if self._host is None else {}
        wrapper = self._host if name == "drive" and self._host else []
        self.processes[name] = NodeProcess(MODULES[name], parameters, remaps, wrapper)
        self._starting[name] = time.monotonic()
        self._reported_before[name] = self._reporting(MODULES[name])
        if name == "compensator":
            self.record.fresh_starts.append(time.monotonic())

    def start_all(self) -> None:
        for name in MODULES if self.has_mover else ("compensator", "drive"):
            self._down_since[name] = time.monotonic()
            self.start(name)
        self.spin(STARTS_WITHIN, lambda: not self._down_since)
        self.controller.start_over()
        self.spin(STARTS_WITHIN, self.running)
        if not self.running():
            said = "\n".join(process.output() for process in self.processes.values())
            raise RuntimeError(f"the machine does not come up:\n{said}")

    def running(self) -> bool:
        """Whether all processes run, commands are answered and the struts are measured."""
        now = time.monotonic()
        answered = any(now - s.answered_at < 0.1 for s in list(self.record.sent.values())[-50:])
        measured = bool(self.record.measured) and now - self.record.measured[-1].time < 0.1
        milling = self.controller.mode is Mode.MILL
        return not self._down_since and answered and measured and milling

    def waited(self) -> dict[int, float]:
        """Return the time for which this and each other process has waited for a processor, s, by process id."""
        ids = [os.getpid(), *(process.pid for process in self.processes.values() if process.exit_code() is None)]
        return {pid: processor_wait(pid) for pid in ids}

    # ---- faults of processes ----

    def kill(self, name: str) -> None:
        self._down_since[name] = time.monotonic()
        self.processes[name].send(signal.SIGKILL)  # without waiting for its end: the harness must not stop

    def freeze(self, name: str) -> None:
        self._down_since[name] = time.monotonic()
        self.processes[name].send(signal.SIGSTOP)

    def thaw(self, name: str) -> None:
        self.processes[name].send(signal.SIGCONT)
        self._is_up(name, time.monotonic())

    def is_starting(self, name: str) -> bool:
        return name in self._starting

    def _look_for_ready(self, now: float) -> None:
        for name in list(self._starting):
            process = self.processes[name]
            if process.exit_code() is not None:
                raise RuntimeError(f"{name} ended with {process.exit_code()}:\n{process.output()}")
            if "ready" in process.output() and self._reporting(MODULES[name]) - self._reported_before[name]:
                del self._starting[name]
                self._is_up(name, now)
                self.record.killed[MODULES[name]].append(self.record.outages[MODULES[name]][-1])

    def _reporting(self, node: str) -> set[tuple[int, ...]]:
        """Return the ids of the publishers of /diagnostics that DDS has discovered here and that belong to a node.

        DDS connects two processes up to 0.4 s after the start of the later one; no report can be received before.
        """
        infos = self.node.get_publishers_info_by_topic("/diagnostics")
        return {tuple(info.endpoint_gid) for info in infos if info.node_name == node}

    def _is_up(self, name: str, now: float) -> None:
        self.record.outages[MODULES[name]].append((self._down_since.pop(name, now), now))

    # ---- faults by service ----

    def set_drive(self, **values: float | int) -> None:
        """Set fault parameters of the drive without waiting."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        self._set_parameters.call_async(SetParameters.Request(parameters=parameters))

    def reload_model(self, then: Callable[[bool], None]) -> None:
        """Request a reload of the model; call `then` with whether the model was accepted."""
        future = self._reload.call_async(Trigger.Request())
        future.add_done_callback(lambda f: then(bool(f.result().success)))

    def simulate_time(self, then: Callable[[bool], None]) -> None:
        """Set the compensator's `use_sim_time`; call `then` with whether the setting was accepted."""
        request = SetParameters.Request(parameters=[Parameter("use_sim_time", value=True).to_parameter_msg()])
        future = self._set_clock.call_async(request)
        future.add_done_callback(lambda f: then(bool(f.result().results[0].successful)))

    def reset(self, then: Callable[[bool], None] = lambda done: None) -> None:
        """Request a reset of the compensator, like an operator; call `then` with whether it was granted."""
        asked = time.monotonic()

        def answered(future: Future) -> None:
            if future.result().success:
                self.record.fresh_starts.append(asked)
            then(bool(future.result().success))

        self._reset.call_async(Trigger.Request()).add_done_callback(answered)

    # ---- messages ----

    def _send(self, pose: Pose) -> int:
        message = pose_message(pose, "base")
        message.header.stamp = self.node.get_clock().now().to_msg()
        return self._pass_on(message)

    def _pass_on(self, message: PoseStamped) -> int:
        now, stamp = time.monotonic(), nanoseconds_of(message.header.stamp)
        self.record.sent[stamp] = Sent(now)
        self.wires["pose"].put(message, now)
        return stamp

    def _deliver(self, link: str, publisher: Any, message: Any, now: float) -> None:
        if publisher is not None:
            publisher.publish(message)
        self.record.delivered[link].append(now)
        if link == "feedback":
            self.record.measured.append(Struts(now, lengths_of(message.position)))

    def _on_commands(self, message: JointState, sent: float) -> None:
        now = time.monotonic()
        self.record.commands.append(Struts(sent, lengths_of(message.position)))  # a busy harness receives messages late
        stamp = nanoseconds_of(message.header.stamp)
        entry = self.record.sent.get(stamp)
        if entry is not None and math.isnan(entry.answered_at):
            entry.answered_at = now
        self.controller.answered(stamp, now)
        if self._host is None:
            self.wires["command"].put(message, now)

    def _on_corrections(self, message: JointState) -> None:
        self.record.corrections.append(Struts(time.monotonic(), lengths_of(message.position)))

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in array.status:
            values = {entry.key: entry.value for entry in status.values}
            node, level = status.name.split(":")[0], int.from_bytes(status.level, "little")
            self.record.statuses.append(Status(now, node, level, status.message, values))

    def _stuck(self) -> bool:
        """Whether the compensator reports that the machine is not at its commanded position."""
        said = self.record.said("compensator")
        words = said[-1].message if said else ""
        return re.search("refusing commands: .*(following|step|speed)", words) is not None

    # ---- the controller's reset ----

    def _ask_for_reset(self, then: Callable[[Pose | None], None]) -> None:
        self._resetting = self._reset_steps(then)

    def _reset_steps(self, then: Callable[[Pose | None], None]) -> Iterator[None]:
        """Reset within 0.5 s; call `then` with the first estimate from measured struts after the reset, or None."""
        end = time.monotonic() + 0.5
        future = self._reset.call_async(Trigger.Request()) if self._reset.service_is_ready() else Future()
        while not future.done() and time.monotonic() < end:
            yield
        if not (future.done() and future.result().success):
            return then(None)
        self.record.fresh_starts.append(time.monotonic())
        self._estimate = None
        while self._estimate is None and time.monotonic() < end:
            yield
        then(None if self._estimate is None else message_pose(self._estimate))

    # ---- time ----

    def spin(self, seconds: float, until: Callable[[], object] = lambda: False) -> None:
        """Run the harness for some seconds, or until a condition is true."""
        end = time.monotonic() + seconds
        looked = 0.0
        while (now := time.monotonic()) < end and not until():
            if now - looked > 0.02:
                looked = now
                self._look_for_ready(now)
            next(self._resetting, None)
            for wire in self.wires.values():
                wire.release(now)
            self.controller.tick(now, self._stuck())
            due = min(self.controller.due(), *(wire.due() for wire in self.wires.values()), end, now + 0.01)
            self._executor.spin_once(timeout_sec=max(0.0, due - time.monotonic()))

    def new_record(self) -> Record:
        self.record = self.record.continued()
        return self.record


def dated(callback: Callable[[Any, float], None]) -> Callable[..., None]:
    """Let rclpy call `callback` with a message and the monotonic time, s, at which the message was sent.

    rclpy inspects the signature; its executors call with two arguments or with a pair.
    """

    def called(*arguments: Any) -> None:
        message, info = arguments[0] if len(arguments) == 1 else arguments
        callback(message, info["source_timestamp"] * 1e-9 - (time.time() - time.monotonic()))

    called.__signature__ = inspect.signature(lambda message, info: None)  # type: ignore[attr-defined]
    return called


def processor_wait(pid: int) -> float:
    """Return the time for which a process' main thread was ready to run but had no processor, s."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
    except (OSError, IndexError):  # the process has ended, or the kernel does not measure this
        return 0.0
