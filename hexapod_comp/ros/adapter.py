"""The adapter node: calibrates a running machine on request, and checks its model periodically. The node starts
``adapt`` as a separate process and reads the journal that ``adapt`` writes. Run the node with ``ros2 run hexapod_comp
adapter`` or ``python -m hexapod_comp.ros.adapter``."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from ..errors import LONGEST_TEXT, HexapodError
from ..formats.adapt_journal import ENDED, IN_USE, JOURNAL, Event, Journal, has_user
from ..formats.paths import config_file
from ..machine.geometry import load_geometry
from . import end_with_parent
from .base import ACKNOWLEDGED_WITHIN, ERROR, LATCHED_QOS, OK, WARN, MachineNode
from .parameters import Program, read_table
from .process import run
from .worker import PACKAGE_ROOT, start_beside

CHILD_ENCLAVE = "/hexapod_comp/calibrator"  # SROS 2 enclave with the adapt process's access rights

IDLE, CALIBRATING, VERIFYING, FAILED = "idle", "calibrating", "verifying", "failed"
GOOD = ("in use", "proposed")  # states at the end of `adapt` if the check readings confirm its model

PARAMETERS = read_table("""
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
folder | adapted |  | configure | folder of the journal, readings and models; an interrupted run in it is continued
goal | 3.0e-6 | 1e-9 to 0.01 m | configure | largest RMS tool error accepted after calibration, with 95 % probability,
    after best-fit alignment
topic | tool_pose_true |  | configure | topic of measured tool poses in base, from a tracker or motion capture
samples | 25 | 3 to 10000 | configure | number of poses in each median; three medians are taken at each stop
reload | false |  | always | true: load each model into the compensator if
    the check readings confirm it; false: only propose it
check_every | 0.0 | 0 to 1e7 s | always | time from the end of a calibration or check to the next check, or to the
    continuation of an interrupted one; 0 = only on request
""")

TOPICS = """
out  ~/state      DiagnosticStatus, latched: idle, calibrating or verifying; after a run its result: in use, proposed,
                  changed, refused, stopped, failed; WARN: the measured tool error exceeds the model's limit
     /diagnostics
ask  ~/calibrate  Trigger: calibrate, or continue an interrupted calibration; returns at once
     ~/verify     Trigger: check the model now, and repair it if the machine has changed
     ~/stop       Trigger: brake the machine and end the calibration or check; ~/calibrate or ~/verify continues it
"""

PROGRAM = Program(
    "adapter",
    "Calibrates a running machine, and checks and repairs its model.",
    PARAMETERS,
    TOPICS,
    "-p goal:=3.0e-6 -p reload:=true -p check_every:=3600.0",
)


class AdapterNode(MachineNode):
    def __init__(self, **options: Any) -> None:
        super().__init__("adapter", PARAMETERS, **options)
        self._clear_state()

    def _clear_state(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._state, self._text, self._step, self._model = IDLE, "no calibration or check was requested yet", "", ""
        self._next = ""  # VERIFYING or CALIBRATING, to be started `check_every` after the last run; "": nothing
        self._ended = time.monotonic()
        self._stopping = False  # whether the process has been sent SIGINT
        self._applied = True  # False: at the last check the machine had a larger error than the model leaves
        self._begun = self._read = 0  # size of the journal, byte: at the start of this run, at the last reading

    # ---- lifecycle ----

    def configure(self) -> None:
        self._clear_state()
        self._journal = Path(self.options["folder"]).resolve() / JOURNAL
        if (self._journal.parent / IN_USE).exists():
            self._next = VERIFYING  # the folder holds a model from an earlier start of the node
        text = self._text
        try:
            if events := Journal.read(self._journal):
                last = events[-1]
                result = f"ended: {last['state']}, {last['text']}" if last["event"] == ENDED else "was interrupted"
                text = f"before this start of the node, the last run in the folder {result}"
        except HexapodError as error:
            text = f"every run will be refused: {error}"
        self.set_hardware_id(load_geometry(config_file(self.options["geometry_file"], "geometry")).name)
        self._states = self.create_publisher(DiagnosticStatus, "~/state", LATCHED_QOS)
        self.create_logged_service(Trigger, "~/calibrate", lambda *_: self._start(CALIBRATING))
        self.create_logged_service(Trigger, "~/verify", lambda *_: self._start(VERIFYING))
        self.create_logged_service(Trigger, "~/stop", self._on_stop)
        self._change(IDLE, text)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._interrupt()
        return super().on_deactivate(state)

    def publish_last_status(self) -> None:
        if self._process is not None:
            self._interrupt()
            self._change("stopped", "the node ended")
            self._states.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
        super().publish_last_status()

    # ---- services ----

    def _on_stop(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response:
        running = self._interrupt()
        text = "the machine brakes" if running else "no calibration or check was running"
        return Trigger.Response(success=True, message=text)

    def _start(self, state: str) -> Trigger.Response:
        if not self._active:
            return Trigger.Response(message="the node is not active")
        if self._process is not None:
            text = f"already {self._state}: call ~/stop to end it"
            stopping = f"{self._state} is being stopped: call again when ~/state reports its end"
            return Trigger.Response(message=stopping if self._stopping else text)
        if has_user(self._journal):  # its events would be taken for those of the process started here
            return Trigger.Response(message=f"another adapt works in {self._journal.parent}: stop it first")
        options, namespace = self.options, self.get_namespace()
        words = ["adapt", "--machine", options["geometry_file"], "--folder", str(self._journal.parent)]
        words += ["--goal-um", repr(options["goal"] * 1e6), "--topic", options["topic"]]
        words += ["--samples", str(options["samples"]), *(["--reload"] if options["reload"] else [])]
        words += ["--verify"] if state == VERIFYING else []
        words += ["--namespace", namespace] if namespace != "/" else []
        path = os.pathsep.join(filter(None, [str(PACKAGE_ROOT), os.environ.get("PYTHONPATH")]))
        self._stopping, self._step, self._applied = False, "", True
        self._begun = self._journal.read_bytes().rfind(b"\n") + 1 if self._journal.exists() else 0
        self._process = start_beside(
            "hexapod_comp",
            *words,
            environment={"PYTHONPATH": path, "ROS_SECURITY_ENCLAVE_OVERRIDE": CHILD_ENCLAVE},
            stdout=subprocess.DEVNULL,  # stdout repeats the journal
            preexec_fn=partial(end_with_parent, signal.SIGINT),  # the process brakes the machine if the node is killed
        )
        self._change(state, "starting")
        return Trigger.Response(success=True, message=f"{state}; ~/state reports progress and result")

    def _interrupt(self) -> bool:
        """Have a running `adapt` brake the machine and end; return whether one was running."""
        if self._process is None:
            return False
        self._stopping = True
        self._process.send_signal(signal.SIGINT)
        return True

    # ---- state ----

    def update(self, now: float) -> None:
        if self._process is not None:
            code = self._process.poll()  # read first: an ended process has written all its events
            size = self._journal_size()
            if code is None and size == self._read:
                return
            self._read, events = size, self._events()
            if events and events[-1]["event"] not in (self._step, ENDED):
                self._step = events[-1]["event"]
                self._change(self._state, self._step)
            if code is not None:
                self._finish(code, events[-1] if events else {})
        elif self._active and self._next and 0.0 < self.options["check_every"] < now - self._ended:
            self._start(self._next)

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        yield WARN if self._to_warn else OK, f"{self._state}: {self._text}"

    @property
    def _to_warn(self) -> bool:
        """Whether no run is in progress, and the last run failed or found a machine that does not follow its model."""
        return self._process is None and not (self._state in (IDLE, "stopped", *GOOD) and self._applied)

    def values(self, now: float) -> dict[str, str]:
        return {"state": self._state, "step": self._step}

    def _journal_size(self) -> int:
        try:
            return self._journal.stat().st_size
        except OSError:  # the process has not created the journal yet
            return 0

    def _events(self) -> list[Event]:
        """Return the present run's events in the journal, or [] if the journal is unreadable, which `adapt` reports."""
        try:
            return Journal.read(self._journal, self._begun)
        except HexapodError:
            return []

    def _finish(self, code: int, last: Event) -> None:
        """Publish the result of an ended process from its exit `code` and its `last` event in the journal."""
        begun, self._process, self._ended = self._state, None, time.monotonic()
        ended, self._applied = last.get("event") == ENDED, last.get("applied") is not False
        if ended:
            self._model = str(self._journal.parent / last["model"]) if last["model"] else ""
            self._change(last["state"], last["text"])
        elif self._stopping:
            self._change("stopped", "before the first step was completed")
        else:
            self._change(FAILED, f"the process `adapt` ended with exit code {code}; its last messages are in the log")
        # Run again after a failure that the journal reports or a signal caused; any other failure would recur.
        interrupted = self._state == FAILED and (ended or code < 0)
        self._next = VERIFYING if self._state in GOOD else begun if interrupted else ""

    def _change(self, state: str, text: str) -> None:
        self._state, self._text = state, text[:LONGEST_TEXT]
        if self._to_warn:
            self.get_logger().warning(f"{state}: {self._text}")
        self._publish_state()

    def _publish_state(self) -> None:
        level = ERROR if self._state in ("changed", "refused", FAILED) else OK if self._applied else WARN
        values = {
            "state": self._state,
            "step": self._step,
            "model": self._model,
            "running": str(self._process is not None).lower(),
        }
        self._states.publish(self.report("adapt", level, f"{self._state}: {self._text}", values))


main = partial(run, AdapterNode, PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
