"""The topics of the tool's predicted error: what it would be at the last command without compensation.

It is worked out in a process of its own (:mod:`.predicting`), and only while somebody listens: its derivatives take
milliseconds and their libraries a second to import, in which no command would be answered.
"""

from __future__ import annotations

import json
import math
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import IO, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from ..compensation.compensator import Compensator
from ..compensation.journal import Source
from ..errors import HexapodError
from .machine_files import MachineFiles
from .model_loading import PACKAGE_ROOT
from .runtime import EVENT_QOS, MachineNode
from .stamps import stamp_of

PERIOD = 0.2
"""How often a prediction is asked for and published, s."""

TRY_AGAIN_AFTER = (2.0, 60.0)
"""A process that failed is started anew after this long, s: the first time, and at most, as the wait doubles."""


class PredictionError(HexapodError):
    """The process that predicts failed; the message is its own."""

    reason = "prediction"


class PredictionProcess:
    """The process, and a thread that waits for it.

    Parameters
    ----------
    setup : dict
        Its first line of input.
    """

    def __init__(self, setup: dict[str, Any]) -> None:
        self._asked: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._results: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._process: subprocess.Popen[str] | None = None
        self.busy = False
        threading.Thread(target=self._run, args=(setup,), name="predicted error", daemon=True).start()

    def ask(self, request: dict[str, Any]) -> None:
        """Hand over a pose; the process must not be busy."""
        self.busy = True
        self._asked.put(json.dumps(request) + "\n")

    def result(self) -> dict[str, Any] | None:
        """Return the result that has come, None if there is none yet.

        Raises
        ------
        PredictionError
            The process failed: it gives no more.
        """
        try:
            result = self._results.get_nowait()
        except queue.Empty:
            return None
        if "problem" in result:
            raise PredictionError(result["problem"])
        self.busy = False
        return result

    def close(self) -> None:
        """Let the process end, by force where it is at work."""
        self._asked.put(None)
        if self.busy and self._process is not None:
            self._process.kill()

    def _run(self, setup: dict[str, Any]) -> None:
        """Start the process, pass on questions and answers, and wait for its end."""
        command, pipe = [sys.executable, "-m", "hexapod_comp.ros.predicting"], subprocess.PIPE
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # the other cores are the loop's
        try:
            with subprocess.Popen(
                command, cwd=PACKAGE_ROOT, env=alone, stdin=pipe, stdout=pipe, text=True, start_new_session=True
            ) as process:  # of a session of its own, so that Ctrl-C does not interrupt it: its input ends with the node
                self._process = process
                self._talk(process.stdin, process.stdout, setup)  # type: ignore[arg-type]
        except (OSError, ValueError) as error:
            self._results.put({"problem": f"the process that predicts failed: {error}"})

    def _talk(self, into: IO[str], out: IO[str], setup: dict[str, Any]) -> None:
        """Pass on questions and answers until there are no more."""
        into.write(json.dumps(setup) + "\n")
        while (line := self._asked.get()) is not None:
            into.write(line)
            into.flush()
            line_out = out.readline()
            result = json.loads(line_out) if line_out else {"problem": "the process that predicts ended"}
            self._results.put(result)
            if "problem" in result:
                return


class PredictedErrorTopics:
    """``~/predicted_error`` and ``~/predicted_error_aligned``: see :class:`..calibration.posterior.ErrorPredictor`.

    Parameters
    ----------
    node : MachineNode
        Publishes.
    compensator : Compensator
        Says where the machine was sent last, and how it moved.
    files : MachineFiles
        What its model was made of.
    frame : str
        ``frame_id``: of the work frame, along whose axes errors are.
    stamp : callable
        Returns the last command's stamp, ns.

    Attributes
    ----------
    problem : str
        Why nothing is published though somebody listens; empty while all is well.
    """

    def __init__(
        self, node: MachineNode, compensator: Compensator, files: MachineFiles, frame: str, stamp: Callable[[], int]
    ) -> None:
        self._node, self._compensator, self._files, self._frame, self._stamp = node, compensator, files, frame, stamp
        self._topics = {
            "standing": node.create_publisher(PoseWithCovarianceStamped, "~/predicted_error", EVENT_QOS),
            "aligned": node.create_publisher(PoseWithCovarianceStamped, "~/predicted_error_aligned", EVENT_QOS),
        }
        self._process: PredictionProcess | None = None
        self._source: Source | None = None
        self._asked_for = 0
        self.problem = ""
        self._wait, self._again_at = TRY_AGAIN_AFTER[0], 0.0
        self._timer = node.every(PERIOD, self._look)

    def close(self) -> None:
        """Destroy the topics and end the process."""
        self._node.destroy_timer(self._timer)
        self._stop()
        for publisher in self._topics.values():
            self._node.destroy_publisher(publisher)

    def _look(self) -> None:
        """Publish what has been worked out, and ask for the newest pose, while somebody listens."""
        wanted = any(publisher.get_subscription_count() for publisher in self._topics.values())
        now = time.monotonic()
        if not wanted or self._source is not self._files.sources["model"]:
            self._stop()
            self._source, self.problem = self._files.sources["model"], ""
            self._wait, self._again_at = TRY_AGAIN_AFTER[0], 0.0
        if not wanted or now < self._again_at or not np.isfinite(self._compensator.nominal).all():
            return
        if self._process is None:
            self._process = PredictionProcess(self._files.handed_on())
        try:
            result = self._process.result()
        except PredictionError as error:
            self.problem = f"no predicted error: {error}"
            self._node.warn_of("predicted error", f"{self.problem}; tried again in {self._wait:g} s")
            self._stop()
            self._again_at, self._wait = now + self._wait, min(2.0 * self._wait, TRY_AGAIN_AFTER[1])
            return
        if result is not None:
            self.problem, self._wait = "", TRY_AGAIN_AFTER[0]
            self._publish(result)
        if not self._process.busy:
            self._ask(self._process)

    def _ask(self, process: PredictionProcess) -> None:
        compensator, self._asked_for = self._compensator, self._stamp()
        request = {
            "position": compensator.platform.position.tolist(),
            "rotation": compensator.platform.rotation.tolist(),
            "sense": compensator.motion.sense.tolist(),
            "tool": compensator.geometry.tool_name,
            **compensator.temperatures.snapshot(),
        }
        process.ask(request)

    def _publish(self, result: dict[str, Any]) -> None:
        """Publish both errors; of a pose that the machine with its errors cannot take there is none."""
        for name, publisher in self._topics.items():
            error = result[name]
            if error is not None and None not in error["values"]:
                publisher.publish(error_message(error["values"], error["covariance"], self._frame, self._asked_for))

    def _stop(self) -> None:
        if self._process is not None:
            self._process.close()
        self._process = None


def error_message(
    values: list[float], covariance: list[float] | None, frame: str, stamp: int
) -> PoseWithCovarianceStamped:
    """Return an error as a message: where the tool would be and how it would stand, seen from where it should.

    Parameters
    ----------
    values : list of float
        Displacement, m, and rotation vector, rad.
    covariance : list of float or None
        Its 36 numbers, row by row; None: not known, which is NaN in the message, never zero.
    frame, stamp : str, int
        ``frame_id``, and the command's stamp, ns.
    """
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = frame, stamp_of(stamp)
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = values[:3]
    half = 0.5 * math.hypot(*values[3:])
    share = 0.5 * math.sin(half) / half if half > 0.0 else 0.5
    orientation.x, orientation.y, orientation.z = (share * turn for turn in values[3:])
    orientation.w = math.cos(half)
    message.pose.covariance = [math.nan] * 36 if covariance is None else covariance
    return message
