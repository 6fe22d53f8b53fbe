"""The adapter node: a machine that calibrates itself on request, and checks its model periodically.

It runs ``hexapod_comp adapt`` as a process beside it, which has the machine moved and measured and computes for
minutes; the node only starts and stops it and publishes, on ``~/state``, what its journal says. Run it with
``ros2 run hexapod_comp adapter`` or ``python -m hexapod_comp.ros.adapter``.
"""

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
from ..upkeep.journal import ENDED, IN_USE, JOURNAL, Event, Journal
from . import end_with_parent
from .base import ACKNOWLEDGED_WITHIN, ERROR, LATCHED_QOS, OK, WARN, MachineNode
from .parameters import Program, read_table
from .process import run
from .worker import PACKAGE_ROOT

NICENESS = 10  # Of the process: commands come first
CHILD_ENCLAVE = "/hexapod_comp/calibrator"  # its rights, where SROS 2 is on

IDLE, CALIBRATING, VERIFYING, FAILED = "idle", "calibrating", "verifying", "failed"
GOOD = ("in use", "proposed")  # how the verb says that a model is borne out

PARAMETERS = read_table("""
autostart | true |  | start | configure and activate at the start
geometry_file | paper.yaml |  | configure | geometry file: a path or the name of a shipped one
folder | adapted |  | configure | folder of the journal, readings and models; what it has begun goes on
goal | 3.0e-6 | 1e-9 to 0.01 m | configure | RMS tool error that may be left, with 95 %, the datum aligned
topic | tool_pose_true |  | configure | poses of the tool in base, from a tracker or motion capture
samples | 25 | 3 to 10000 | configure | poses of which the median is taken, three times at each stop
reload | false |  | always | have the compensator run each model that its checks bear out; else they are proposed
check_every | 0.0 | 0 to 1e7 s | always | check the model, or go on with what was interrupted, this long after the last
    run; 0 = when it is asked for
""")

TOPICS = """
out  ~/state      DiagnosticStatus, latched: idle, calibrating, verifying; and how that ended: in use, proposed,
                  changed, refused, stopped, failed
     /diagnostics
ask  ~/calibrate  Trigger: calibrate, or go on with what was begun; returns at once
     ~/verify     Trigger: check the model now, and repair it where the machine has changed
     ~/stop       Trigger: brake the machine and end; ~/calibrate or ~/verify goes on from there
"""

PROGRAM = Program(
    "adapter",
    "Calibrates a running machine and keeps its model true.",
    PARAMETERS,
    TOPICS,
    "-p goal:=3.0e-6 -p reload:=true -p check_every:=3600.0",
)


class AdapterNode(MachineNode):
    """Lifecycle node that runs the verb ``adapt``; arguments are those of ``rclpy`` nodes."""

    def __init__(self, **options: Any) -> None:
        super().__init__("adapter", PARAMETERS, **options)
        self._forget()

    def _forget(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._stopping = False  # it was told to end
        self._state, self._text, self._step, self._model = IDLE, "nothing was asked for yet", "", ""
        self._next = ""  # what is due when `check_every` is over: a check, or what was interrupted
        self._ended = time.monotonic()
        self._begun = self._read = 0  # bytes of the journal: of the runs before; when it was read last

    # ---- lifecycle ----

    def configure(self) -> None:
        self._forget()
        self._journal = Path(self._options["folder"]).resolve() / JOURNAL
        if (self._journal.parent / IN_USE).exists():
            self._next = VERIFYING  # of the node before this one
        self.set_hardware_id(self._options["geometry_file"])
        self._states = self.create_publisher(DiagnosticStatus, "~/state", LATCHED_QOS)
        self.create_logged_service(Trigger, "~/calibrate", lambda *_: self._start(CALIBRATING))
        self.create_logged_service(Trigger, "~/verify", lambda *_: self._start(VERIFYING))
        self.create_logged_service(Trigger, "~/stop", self._on_stop)
        self._publish_state()

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Brake the machine and end what runs."""
        self._interrupt()
        return super().on_deactivate(state)

    def unconfigure(self) -> None:
        """Let a process that still runs brake the machine and end by itself."""
        self._interrupt()

    def publish_last_status(self) -> None:
        """Stop a calibration or check that still runs, and publish `stopped` before the node ends."""
        if self._process is not None:
            self._interrupt()
            self._change("stopped", "the node ended")
            self._states.wait_for_all_acked(ACKNOWLEDGED_WITHIN)

    # ---- what is asked for ----

    def _on_stop(self, _: Trigger.Request, __: Trigger.Response) -> Trigger.Response:
        running = self._interrupt()
        return Trigger.Response(success=True, message="the machine brakes" if running else "nothing was running")

    def _start(self, state: str) -> Trigger.Response:
        """Start the process; refused while one runs."""
        if not self._active:
            return Trigger.Response(message="the node is not active")
        if self._process is not None:
            return Trigger.Response(message=f"{self._state} already: ~/stop ends it")
        options, namespace = self._options, self.get_namespace()
        words = ["adapt", "--machine", options["geometry_file"], "--folder", str(self._journal.parent)]
        words += ["--goal-um", repr(options["goal"] * 1e6), "--topic", options["topic"]]
        words += ["--samples", str(options["samples"]), *(["--reload"] if options["reload"] else [])]
        words += ["--verify"] if state == VERIFYING else []
        words += ["--namespace", namespace] if namespace != "/" else []
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": _with_package()}
        if environment.get("ROS_SECURITY_ENABLE", "").lower() == "true":
            environment["ROS_SECURITY_ENCLAVE_OVERRIDE"] = CHILD_ENCLAVE
        self._stopping, self._step = False, ""
        self._begun = self._journal.read_bytes().rfind(b"\n") + 1 if self._journal.exists() else 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "hexapod_comp", *words],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # the journal has all of it
            start_new_session=True,  # so that Ctrl-C reaches it through the node alone
            preexec_fn=partial(end_with_parent, signal.SIGINT),  # it brakes the machine when the node is killed
        )
        os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
        self._change(state, "starting")
        return Trigger.Response(success=True, message=f"{state}; ~/state says what comes of it")

    def _interrupt(self) -> bool:
        """Have the process brake the machine and end, as Ctrl-C does; return whether one runs."""
        if self._process is None:
            return False
        self._stopping = True
        self._process.send_signal(signal.SIGINT)
        return True

    # ---- state ----

    def update(self, now: float) -> None:
        if self._process is not None:
            code = self._process.poll()  # before the journal is read, which has all then that it wrote
            size = self._journal_size()
            if code is None and size == self._read:
                return
            self._read, events = size, self._events()
            if events and events[-1]["event"] not in (self._step, ENDED):
                self._step = events[-1]["event"]
                self._change(self._state, self._step)
            if code is not None:
                self._finish(code, events[-1] if events else {})
        elif self._active and self._next and 0.0 < self._options["check_every"] < now - self._ended:
            self._start(self._next)

    def findings(self, now: float) -> Iterator[tuple[bytes, str]]:
        running = self._process is not None
        yield OK if running or self._state in (IDLE, "stopped", *GOOD) else WARN, f"{self._state}: {self._text}"

    def values(self, now: float) -> dict[str, str]:
        return {"state": self._state, "step": self._step}

    def _journal_size(self) -> int:
        try:
            return self._journal.stat().st_size
        except OSError:  # it is being made
            return 0

    def _events(self) -> list[Event]:
        """Return what the process has written into the journal; it says itself what is wrong with that."""
        try:
            return Journal.read(self._journal, self._begun)
        except (HexapodError, OSError):
            return []

    def _finish(self, code: int, last: Event) -> None:
        """Publish how a process ended, by the last event that it has written."""
        begun, self._process, self._ended = self._state, None, time.monotonic()
        ended = last.get("event") == ENDED
        if ended:
            self._model = str(self._journal.parent / last["model"]) if last["model"] else ""
            self._change(last["state"], last["text"])
        elif self._stopping:
            self._change("stopped", "before anything was done")
        else:
            self._change(FAILED, f"the process ended with {code}; its last words are in the log")
        interrupted = self._state == FAILED and (ended or code < 0)  # or killed; else it would fail again
        self._next = VERIFYING if self._state in GOOD else begun if interrupted else ""

    def _change(self, state: str, text: str) -> None:
        self._state, self._text = state, text[:LONGEST_TEXT]
        if self._process is None and state not in (IDLE, "stopped", *GOOD):
            self.get_logger().warning(f"{state}: {self._text}")
        self._publish_state()

    def _publish_state(self) -> None:
        level = ERROR if self._state in ("changed", "refused", FAILED) else OK
        values = {
            "state": self._state,
            "step": self._step,
            "model": self._model,
            "running": str(self._process is not None).lower(),
        }
        self._states.publish(self.report("adapt", level, f"{self._state}: {self._text}", values))


def _with_package() -> str:
    """Return PYTHONPATH for a process that finds this package wherever it runs."""
    return os.pathsep.join([str(PACKAGE_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])


main = partial(run, AdapterNode, PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
