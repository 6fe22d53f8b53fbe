"""One process beside a node, for what must not stop its loop: loading a model, the predicted error, how far it may go.

Parsing YAML keeps Python's lock for tens of milliseconds, derivatives for as long, and a file on a dead network mount
is waited for without end: meanwhile no command would be answered. So the node asks a process, which it starts when it
first needs it: ``python -m hexapod_comp.ros.worker``. A job and its answer are each one pickle on its stdin and stdout;
jobs are done in turn. It ends with its input, so that it never outlives the node.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from ..errors import HexapodError

NICENESS = 10
"""Commands come first."""

IDLE_AFTER = 10.0
"""Without a job for this long the process is ended, s: it holds a hundred megabytes; a new one takes a second."""

PACKAGE_ROOT = Path(__file__).resolve().parents[2]
"""Where the process runs: Python also imports from the folder it runs in, which must not be just any."""


class WorkerError(HexapodError):
    """A job failed; the message is the process's, or says what became of it."""

    reason = "bad_file"


@dataclass
class Job:
    """What is asked: a function of this module and its arguments."""

    task: str
    arguments: tuple[Any, ...]
    done: Callable[[Any], None]  # called with the result, from Worker.look
    failed: Callable[[WorkerError], None]
    within: float = float("inf")  # s, from its beginning; then the process is given up
    late: str = ""  # what is said then
    began: float = float("inf")


class Worker:
    """The node's end: hands on one job at a time, and gives back what came of it when it is asked to `look`."""

    def __init__(self) -> None:
        self._waiting: deque[Job] = deque()
        self._running: Job | None = None
        self._helper: _Helper | None = None
        self._done_at = 0.0

    @property
    def pid(self) -> int | None:
        """Process id; None before it was started."""
        process = None if self._helper is None else self._helper.process
        return None if process is None else process.pid

    def ask(self, job: Job) -> None:
        """Have a job done."""
        self._waiting.append(job)
        self._next()

    def look(self, now: float) -> None:
        """Hand on what has been done, and give up what takes too long."""
        job, helper = self._running, self._helper
        if job is None or helper is None:
            if helper is not None and now - self._done_at > IDLE_AFTER:
                self._end(kill=False)
            return
        try:
            answer = helper.answers.get_nowait()
        except Empty:
            if now - job.began > job.within:
                self._end(kill=True)
                self._settle(job, WorkerError(job.late))
            return
        if isinstance(answer, WorkerError) and answer.reason == "ended":
            self._end(kill=False)
        self._settle(job, answer)

    def close(self) -> None:
        """Give up all jobs and let the process end, by force where it is at work."""
        self._waiting.clear()
        self._end(kill=self._running is not None)
        self._running = None

    def _settle(self, job: Job, answer: Any) -> None:
        self._running, self._done_at = None, time.monotonic()
        self._next()
        if isinstance(answer, WorkerError):
            job.failed(answer)
        else:
            job.done(answer)

    def _next(self) -> None:
        if self._running is None and self._waiting:
            self._running = job = self._waiting.popleft()
            if (
                self._helper is not None
                and self._helper.process is not None
                and self._helper.process.poll() is not None
            ):
                self._end(kill=False)  # it was killed while it had nothing to do
            self._helper, job.began = self._helper or _Helper(), time.monotonic()
            self._helper.jobs.put((job.task, job.arguments))

    def _end(self, kill: bool) -> None:
        helper, self._helper = self._helper, None
        if helper is not None:
            helper.jobs.put(None)
            if kill and helper.process is not None:
                helper.process.kill()


class _Helper:
    """A process, and the thread that talks with it, which keeps no lock while it waits."""

    def __init__(self) -> None:
        self.jobs: SimpleQueue[Any] = SimpleQueue()
        self.answers: SimpleQueue[Any] = SimpleQueue()
        self.process: subprocess.Popen[bytes] | None = None
        threading.Thread(target=self._run, name="worker", daemon=True).start()

    def _run(self) -> None:
        command, pipe = [sys.executable, "-m", __name__], subprocess.PIPE
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # the other cores are the loop's
        error = WorkerError("the process beside the node ended")
        try:
            with subprocess.Popen(
                command, cwd=PACKAGE_ROOT, env=alone, stdin=pipe, stdout=pipe, start_new_session=True
            ) as process:  # of a session of its own, so that Ctrl-C does not interrupt it: its input ends with the node
                self.process = process
                while (job := self.jobs.get()) is not None:
                    pickle.dump(job, process.stdin)  # type: ignore[arg-type]
                    process.stdin.flush()  # type: ignore[union-attr]
                    self.answers.put(pickle.load(process.stdout))  # type: ignore[arg-type]
        except (OSError, EOFError, pickle.PickleError) as caught:
            if not isinstance(caught, (EOFError, BrokenPipeError)):
                error = WorkerError(f"the process beside the node failed: {caught}")
        error.reason = "ended"
        self.answers.put(error)


# ---- the process ----


def load_model(name: str, place: str, folder: Path | None, machine: str) -> tuple[Any, Any]:
    """Find and read a machine's model file, relative to a place, in a folder; return the model and its source, without
    the text where that is too long for the journal."""
    from ..compensation.journal import LARGEST_SOURCE, Source
    from ..formats.paths import confined_file, confined_opener

    os.chdir(place)
    source = Source.read(confined_file(name, folder, "model"), confined_opener(folder))
    model = source.model(machine)
    return model, Source(source.name, source.text if len(source.text or "") <= LARGEST_SOURCE else None, source.sha256)


class Predicting:
    """Predictors of one model, made anew when tool or temperature change."""

    def __init__(self, geometry: Any, model: Any, folder: Path | None) -> None:
        """Take geometry and model as the :class:`Source` of each, and the folder from which files may be read."""
        from ..calibration.posterior_file import load_posterior
        from ..formats.paths import confined_opener

        self.geometry = geometry.geometry()
        self.model = model.model(self.geometry.name)
        opener = confined_opener(folder)
        self.fitted, self.unknown = load_posterior(self.model, self.geometry, model.name, opener)
        self._at: Any = None

    def result(self, asked: dict[str, Any]) -> dict[str, Any]:
        """Return the errors at a pose: ``position``, ``rotation``, ``sense``, ``tool``, ``temperatures``, ``lags``."""
        import numpy as np

        from ..calibration.posterior import ErrorPredictor
        from ..machine.model import RealMachine
        from ..machine.temperatures import Temperatures

        at = asked["tool"], asked["temperatures"], asked["lags"]
        if at != self._at:
            temperatures = Temperatures.restored(*at[1:], len(self.model.late_growth.time_constants))
            machine = RealMachine(self.geometry.using(tool=at[0]), self.model, temperatures)
            self._predictor, self._at = ErrorPredictor(machine, self.fitted), at
        pose = np.array([asked["position"]]), np.array([asked["rotation"]])
        found = zip(("standing", "aligned"), self._predictor.predict(pose, np.array([asked["sense"]])), strict=True)
        result: dict[str, Any] = {"unknown": self.unknown}
        for name, one in found:
            covariance = None if one is None or one.covariance is None else one.covariance[0].ravel().tolist()
            result[name] = None if one is None else {"values": one.values[0].tolist(), "covariance": covariance}
        return result


_predicting: dict[str, Predicting] = {}


def predict(key: str, sources: tuple[Any, Any, Path | None], asked: dict[str, Any]) -> dict[str, Any]:
    """Return what :class:`Predicting` says of a pose; another `key` names other sources."""
    if key not in _predicting:
        _predicting.clear()
        _predicting[key] = Predicting(*sources)
    return _predicting[key].result(asked)


def find_travel(geometry: Any, model: Any, temperatures: Any, pose: Any, enabled: bool) -> Any:
    """Return how far the tool may go from a pose."""
    from ..machine.model import RealMachine
    from ..workspace.travel import travel

    return travel(RealMachine(geometry, model, temperatures), pose, geometry.work, enabled)


TASKS: dict[str, Callable[..., Any]] = {task.__name__: task for task in (load_model, predict, find_travel)}


def main() -> int:
    """Answer until the input ends."""
    os.nice(NICENESS)
    jobs, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    while True:
        try:
            task, arguments = pickle.load(jobs)
        except EOFError:
            return 0
        try:
            answer = TASKS[task](*arguments)
        except (HexapodError, OSError) as error:
            answer = WorkerError(str(error))
        except Exception as error:  # else the process would end, and nobody know why
            answer = WorkerError(f"{task}: {type(error).__name__}: {error}")
        pickle.dump(answer, answers)
        answers.flush()


if __name__ == "__main__":
    from hexapod_comp.ros import worker  # under this name, by which the other end knows what is pickled

    sys.exit(worker.main())
