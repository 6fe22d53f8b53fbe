"""One process beside a node, for what must not stop its loop: loading a model, the predicted error, how far it may go.

Parsing YAML keeps Python's lock for tens of milliseconds, derivatives for as long, and a file on a dead network mount
is waited for without end: meanwhile no command would be answered. So the node asks a process, which it starts when it
first needs it: ``python -m hexapod_comp.ros.worker``. Jobs and results travel pickled through a socket between the two;
jobs are done in turn. The process ends when the node's end of the socket closes, so it never outlives the node.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

import numpy as np

from ..compensation.journal import LARGEST_SOURCE, Source
from ..errors import HexapodError
from ..formats.paths import confined_file, confined_opener
from ..machine.model import MachineModel, RealMachine
from ..machine.temperatures import Temperatures
from ..pose import Pose

NICENESS = 10  # Commands come first

# Without a job for this long the process is ended, s: it holds a hundred megabytes; a new one takes a second
IDLE_AFTER = 10.0

# Where the process runs: Python also imports from the folder it runs in, which must not be just any
PACKAGE_ROOT = Path(__file__).resolve().parents[2]


class WorkerError(HexapodError):
    """A job failed; the message is the process's, or says what became of it."""

    reason = "bad_file"


@dataclass
class Job:
    """What the process is asked for."""

    task: str  # load_model, predict or travel
    arguments: dict[str, Any]
    done: Callable[[Any], None]  # called with the result, from Worker.look
    failed: Callable[[WorkerError], None]
    machine: dict[str, Any] | None = None  # which one, as Machine takes it
    within: float | None = None  # s, from its beginning; then the process is killed
    late: str = ""  # the error's text then


class Worker:
    """The node's end: a thread sends one job at a time to the process; `look` calls back with the results."""

    def __init__(self) -> None:
        self._process, self._thread = _Process(), ThreadPoolExecutor(1, "worker")
        self._jobs: deque[tuple[Job, Future[Any]]] = deque()
        self._done_at = 0.0

    @property
    def process(self) -> subprocess.Popen[bytes] | None:
        """The process; None before it was started, and after it was ended."""
        return self._process.popen

    def ask(self, job: Job) -> None:
        """Have a job done."""
        self._jobs.append((job, self._thread.submit(self._process.do, job)))

    def look(self, now: float) -> None:
        """Call back with a result; end a process that is idle for IDLE_AFTER."""
        if self._jobs and self._jobs[0][1].done():
            job, future = self._jobs.popleft()
            self._done_at = time.monotonic()
            error = future.exception()
            if error is None:
                job.done(future.result())
            else:
                job.failed(error if isinstance(error, WorkerError) else WorkerError(str(error)))
        elif not self._jobs and self.process is not None and now - self._done_at > IDLE_AFTER:
            self._process.end()

    def close(self) -> None:
        """Give up all jobs and end the process, whatever it does."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._jobs.clear()
        self._process.end()


class _Process:
    """The process and the way to it; `do` waits in the worker's thread, where Python's lock is free."""

    def __init__(self) -> None:
        self.popen: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._machine: dict[str, Any] | None = None  # that it knows already

    def do(self, job: Job) -> Any:
        """Return the result of a job, or raise a WorkerError."""
        if self.popen is None or self.popen.poll() is not None:  # killed, perhaps, while it had nothing to do
            self._machine = None
        machine = None if job.machine == self._machine else job.machine
        self._machine = job.machine or self._machine
        try:
            answer = self.talk((job.task, machine, job.arguments), job.within)
        except (EOFError, ConnectionError):
            answer = "the process beside the node ended", None
        except OSError as error:
            answer = f"the process beside the node failed: {error}", None
        if answer is None or answer[0]:
            if answer is None or self.popen is None or self.popen.poll() is not None:
                self.end()
            raise WorkerError(job.late if answer is None else answer[0])
        return answer[1]

    def talk(self, request: tuple[Any, ...], within: float | None) -> tuple[str, Any] | None:
        """Return problem and result of a request, None where neither comes within a time, s."""
        if self.popen is None or self.popen.poll() is not None:
            self._start()
        connection = self._connection
        connection.send(request)  # type: ignore[union-attr]
        return connection.recv() if connection.poll(within) else None  # type: ignore[union-attr, no-any-return]

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # the other cores are the loop's
        with theirs:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", __name__, str(theirs.fileno())],
                cwd=PACKAGE_ROOT,
                env=alone,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # so that Ctrl-C does not interrupt it
            )

    def end(self) -> None:
        """End the process; a thread waits for its end, as one that waits for a dead disk cannot even be killed."""
        popen, self.popen, self._machine = self.popen, None, None
        if popen is not None:
            popen.kill()
            threading.Thread(target=popen.wait, name="end of the worker", daemon=True).start()


# ---- the process ----


def load_model(name: str, place: str, folder: str | None, machine: str) -> tuple[MachineModel, Source]:
    """Find and read a machine's model file, relative to a place, in a folder; return the model and its source, without
    the text where that is too long for the journal."""
    os.chdir(place)
    inside = None if folder is None else Path(folder)
    source = Source.read(confined_file(name, inside, "model"), confined_opener(inside))
    model = source.model(machine)
    return model, source if len(source.text or "") <= LARGEST_SOURCE else Source(source.name, None, source.sha256)


class Machine:
    """A machine and its model, made of the texts in use: what else is needed of them is made when it is."""

    def __init__(self, geometry: Source, model: Source, folder: str | None) -> None:
        self._opener = confined_opener(None if folder is None else Path(folder))
        self._source = model
        if model.text is None:  # it was too long to be kept
            self._source = Source.read(model.name, self._opener)
            if self._source.sha256 != model.sha256:
                raise WorkerError(f"{model.name}: has changed since it was loaded")
        self.geometry = geometry.geometry()
        self.model = self._source.model(self.geometry.name)
        self._fitted: Any = None
        self._at: Any = None

    def predict(self, platform: Pose, sense: np.ndarray, tool: str, warmth: Temperatures) -> dict[str, Any]:
        """Return the errors ``standing`` and ``aligned`` at a pose: values and covariance, None where not known."""
        from ..calibration.posterior import ErrorPredictor
        from ..calibration.posterior_file import load_posterior

        if self._fitted is None:
            self._fitted = load_posterior(self.model, self.geometry, self._source.name, self._opener)
        if self._at != (at := (tool, warmth.snapshot())):
            machine = RealMachine(self.geometry.using(tool=tool), self.model, warmth)
            self._predictor, self._at = ErrorPredictor(machine, self._fitted[0]), at
        errors = self._predictor.predict((platform.position[None], platform.rotation[None]), sense[None])
        found: dict[str, Any] = dict.fromkeys(("standing", "aligned"))
        for name, error in zip(found, errors, strict=True):
            if error is not None:
                found[name] = error.values[0], None if error.covariance is None else error.covariance[0]
        return found

    def travel(self, pose: Pose, tool: str, work: str, warmth: Temperatures, enabled: bool) -> tuple[str, dict]:
        """Return how far a tool may go from a pose in a frame: a text, and values by their keys."""
        from ..compensation.travel import travel, travel_text

        geometry = self.geometry.using(tool, work)
        ways = travel(RealMachine(geometry, self.model, warmth), pose, geometry.work, enabled)
        stops = {f"{one.way} stops at": str(one.error or "") for one in ways}
        return travel_text(ways), {**{one.key: f"{one.shown:.6f}" for one in ways}, **stops}


class Jobs:
    """Does one job after another; the machine that they are about stays until another is given."""

    def __init__(self) -> None:
        self._made_of: dict[str, Any] = {}
        self._machine: Machine | None = None

    def do(self, task: str, machine: dict[str, Any] | None, arguments: dict[str, Any]) -> tuple[str, Any]:
        """Return the problem, empty where there is none, and the result."""
        if machine is not None:
            self._made_of, self._machine = machine, None
        try:
            if task == "load_model":
                return "", load_model(**arguments)
            self._machine = self._machine or Machine(**self._made_of)
            return "", (self._machine.predict if task == "predict" else self._machine.travel)(**arguments)
        except (HexapodError, OSError) as error:
            return str(error), None
        except Exception as error:  # else the process would end, and nobody know why
            return f"{task}: {type(error).__name__}: {error}", None


def main() -> int:
    """Answer until the node's end closes."""
    os.nice(NICENESS)
    os.dup2(2, 1)  # what a library prints goes to the log
    jobs = Jobs()
    with Connection(int(sys.argv[1])) as connection:
        while True:
            try:
                connection.send(jobs.do(*connection.recv()))
            except (EOFError, ConnectionError):
                return 0


if __name__ == "__main__":
    sys.exit(main())
